//! `palpate strain`: a displacement field to strain, with its deviation.

use super::Usage;
use super::console::Console;
use super::convention::Convention;
use super::inputs::{
    Part, check_distinct, file_of, name, read_labels, read_mask, same_grid, some_labels, standing_for, warn_all,
};
use super::limits::strain_fits;
use super::outputs::{STRAIN_FILES, StrainMaps, Target, at_places, write_strain};
use super::record::{self, Read, Recording};
use anyhow::{Context, Result, bail};
use clap::Args;
use palpate::error::Shown;
use palpate::error::UnknownName;
use palpate::io;
use palpate::pipeline::field::mesh_of;
use palpate::pipeline::strain::{self, StrainInput, StrainParams};
use palpate::report::record::{in_summary, on_page};
use palpate::report::strain::{page, summary, text};
use palpate::strain::directions::{Directions, Tube, unit};
use palpate::types::{DenseField, ErrorSamples, Grid, Mask, SparseField, StrainMeasure, Trust, Volume, names};
use std::path::{Path, PathBuf};

#[derive(Debug, Args)]
pub struct Options {
    /// A folder of `palpate field`, or a displacement field (5-D NIfTI, LPS mm)
    field: PathBuf,
    #[command(flatten)]
    target: Target,
    /// Gauge length: the side of the cube over which one strain is taken, at least two voxels
    /// [default: the least error to expect, by the noise]
    #[arg(long, value_name = "MM", allow_negative_numbers = true)]
    gauge: Option<f64>,
    /// Which strain: green-lagrange, small or logarithmic
    #[arg(long, value_name = "NAME", value_parser = measure, default_value = "green-lagrange")]
    measure: StrainMeasure,
    /// Where there is tissue, on the field's grid, 0 outside [default: what the folder measured,
    /// everywhere of a file]
    #[arg(long, value_name = "M", value_parser = standing_for(Part::Mask))]
    mask: Option<PathBuf>,
    /// Regions whose strain is summed up: a label map on the field's grid [default: the bodies]
    #[arg(long, value_name = "L", value_parser = standing_for(Part::Labels))]
    labels: Option<PathBuf>,
    /// Fibres: vectors on the field's grid (5-D NIfTI, LPS), or LABEL=X,Y,Z (RAS), once for each
    /// label
    #[arg(long, value_name = "F")]
    fibres: Vec<String>,
    /// A label that is a tube: its radial, circumferential and axial strain
    #[arg(long, value_name = "LABEL", conflicts_with = "fibres", requires = "labels")]
    tube: Vec<u8>,
    #[command(flatten)]
    convention: Convention,
}

const MEASURES: [(&str, StrainMeasure); 3] = [
    ("green-lagrange", StrainMeasure::GreenLagrange),
    ("small", StrainMeasure::Small),
    ("logarithmic", StrainMeasure::Logarithmic),
];

fn measure(name: &str) -> Result<StrainMeasure, UnknownName> {
    names::choose("measure", name, &MEASURES)
}

/// A field with what is known of it.
struct Source {
    field: DenseField,
    bodies: Option<Mask>,
    samples: Option<ErrorSamples>,
    trust: Option<Trust>,
    image: Option<Volume>,
    matches: Option<SparseField>,
}

impl Source {
    /// Of a folder of `palpate field`, or of a file alone.
    fn read(path: &Path, convention: &Convention, warnings: &mut Vec<String>) -> Result<Self> {
        if !path.is_dir() {
            let field = convention.read(path)?;
            return Ok(Self { field, bodies: None, samples: None, trust: None, image: None, matches: None });
        }
        let file = |name: &str| path.join(name);
        let there = |name: &str| Some(file(name)).filter(|p| p.is_file());
        for (part, lost) in [
            ("posterior.nii.gz", "the deviation of strain is that of noise between neighbouring voxels alone"),
            ("bodies.nii.gz", "strain is taken of the air too; give --mask"),
            ("summary.json", "how far to trust the field is not known"),
        ] {
            if there(part).is_none() {
                warnings.push(format!("{}: {part} is missing: {lost}", path.shown()));
            }
        }
        let field = convention.read(path)?;
        let bodies = there("bodies.nii.gz").map(|p| own_bodies(&p, field.grid(), path)).transpose()?;
        let summary = there("summary.json").map(io::read_json).transpose()?;
        let trust = summary.and_then(|mut s| serde_json::from_value(s.get_mut("trust")?.take()).ok());
        let image = there("warped.nii.gz").map(io::read_volume).transpose()?;
        Ok(Self {
            samples: there("posterior.nii.gz").map(io::read_samples).transpose()?,
            image: image.filter(|i| i.grid().same_as(field.grid())),
            matches: there("matches.csv").map(io::read_matches).transpose()?,
            field,
            bodies,
            trust,
        })
    }

    /// Where there is tissue: what was measured, of that what lies in the mask.
    fn tissue(&self, mask: Option<Mask>) -> Mask {
        match (&self.bodies, mask) {
            (None, None) => Mask::filled(*self.field.grid(), 1),
            (None, Some(mask)) => Mask::from_voxels(*mask.grid(), |at, _| u8::from(mask.as_slice()[at] != 0)),
            (Some(bodies), None) => bodies.clone(),
            (Some(bodies), Some(mask)) => Mask::from_voxels(*mask.grid(), |at, _| match mask.as_slice()[at] {
                0 => 0,
                _ => bodies.as_slice()[at],
            }),
        }
    }
}

/// The bodies of a results folder. On another grid than its field they are those of another run.
fn own_bodies(file: &Path, grid: &Grid, folder: &Path) -> Result<Mask> {
    let bodies = some_labels(file)?;
    same_grid(file, bodies.grid(), grid, folder)?;
    Ok(bodies)
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { field: path, target, gauge, measure, mask, labels, fibres, tube, convention } = options;
    let files: Vec<&str> = STRAIN_FILES.iter().copied().chain(["mesh.vtu", "summary.json", "report.html"]).collect();
    let vectors = fibres.iter().map(Path::new);
    let given: Vec<&Path> = [path].into_iter().chain(mask).chain(labels).map(PathBuf::as_path).chain(vectors).collect();
    check_distinct(&given, &target.files(&files))?;
    if path.is_dir() && path.canonicalize().ok() == target.output.canonicalize().ok() {
        bail!(Usage(format!("{}: its summary would be overwritten; choose another --output", path.shown())));
    }
    target.check()?;
    strain_fits(&file_of(path, Part::Field).unwrap_or_else(|_| path.clone()))?;
    let mut inputs: Read = parts(path).into_iter().map(|p| ("field", p)).collect();
    inputs.extend(record::inputs(&[("mask", mask.as_ref()), ("labels", labels.as_ref())]));
    inputs.extend(fibres.iter().filter(|f| !f.contains('=')).map(|f| ("fibres", PathBuf::from(f))));
    inputs.extend(convention.deformed().map(|p| ("field_deformed", p.clone())));

    let progress = console.progress();
    progress.set("read", 0.0);
    let mut warnings = Vec::new();
    let source = Source::read(path, convention, &mut warnings)?;
    let grid = *source.field.grid();
    let tissue = source.tissue(mask.as_ref().map(|m| read_mask(m, &grid, path, &mut warnings)).transpose()?);
    let labels = labels.as_ref().map(|l| read_labels(l, &grid, path, &mut warnings)).transpose()?;
    let directions = directions(fibres, tube, labels.as_ref().unwrap_or(&tissue), &grid)?;
    let mut folder = target.create()?;
    let record = Recording::start(console, inputs);
    let params = StrainParams { gauge_mm: *gauge, measure: *measure, directions };
    let input = StrainInput {
        field: &source.field,
        bodies: &tissue,
        labels: labels.as_ref(),
        samples: source.samples.as_ref(),
        trust: source.trust,
    };
    let set = |stage: &str, part| progress.set(stage, part);
    let mut result = strain::run(input, &params, &set).with_context(|| name(path))?;
    result.summary.warnings.extend(warnings);

    progress.set("write", 1.0);
    write_strain(&mut folder, &result, &tissue)?;
    if let Some(matches) = &source.matches {
        let (mesh, nodes) = mesh_of(matches, grid.is_single_slice())?;
        let kept: Vec<_> = matches.kept().collect();
        let nodes: Vec<_> = nodes.iter().map(|&n| kept[n as usize]).collect();
        let strained = at_places(&result.strain, nodes.iter().map(|m| m.initial));
        folder.write("mesh.vtu", |p| io::write_match_mesh(p, &mesh, &nodes, Some(&strained)))?;
    }
    let maps = StrainMaps::of(&result);
    let called = name(path);
    let report = maps.report(&called, &source.field, &tissue, source.image.as_ref());
    let html = page(&report)?;
    let record = record.finish();
    folder.write("report.html", |p| io::write_text(p, &on_page(html, &record)))?;
    folder.write("summary.json", |p| io::write_json(p, &in_summary(summary(&report), &record)))?;
    folder.commit()?;
    drop(progress);
    warn_all(console, &result.summary.warnings);
    console.say(&format!("{}{}", text(&report), target.look()));
    Ok(())
}

/// The files of a results folder that are read, or the one file.
fn parts(path: &Path) -> Vec<PathBuf> {
    let beside =
        ["posterior.nii.gz", "bodies.nii.gz", "warped.nii.gz", "matches.csv", "summary.json"].map(|f| path.join(f));
    let field = file_of(path, Part::Field).unwrap_or_else(|_| path.into());
    std::iter::once(field).chain(beside.into_iter().filter(|f| f.is_file())).collect()
}

/// The directions that `--fibres` or `--tube` name.
fn directions(fibres: &[String], tubes: &[u8], labels: &Mask, grid: &Grid) -> Result<Directions> {
    if !tubes.is_empty() {
        let tube = |&label: &u8| {
            Tube::of(label, labels).with_context(|| format!("--tube {label}: no voxel has that label; check --labels"))
        };
        return Ok(Directions::Tubes(tubes.iter().map(tube).collect::<Result<_>>()?));
    }
    match fibres {
        [] => Ok(Directions::Unknown),
        [file] if !file.contains('=') => {
            let path = Path::new(file);
            let field = io::read_field(path)?;
            same_grid(path, field.grid(), grid, Path::new("the field"))?;
            Ok(Directions::Fibres(field))
        }
        each => {
            let known: Vec<(u8, [f64; 3])> = each.iter().map(|text| of_label(text)).collect::<Result<_>>()?;
            for (at, (label, _)) in known.iter().enumerate() {
                if !labels.as_slice().contains(label) {
                    bail!("--fibres {}: no voxel has label {label}; check --labels", each[at]);
                }
                if known[..at].iter().any(|k| k.0 == *label) {
                    bail!(Usage(format!("--fibres {}: label {label} has a direction already", each[at])));
                }
            }
            Ok(Directions::ByLabel(known))
        }
    }
}

/// `LABEL=X,Y,Z`.
fn of_label(text: &str) -> Result<(u8, [f64; 3])> {
    let wrong = || Usage(format!("--fibres {text}: give LABEL=X,Y,Z, such as 2=0,0,1, or one file of vectors"));
    let (label, vector) = text.split_once('=').ok_or_else(wrong)?;
    let label: u8 = label.trim().parse().map_err(|_| wrong())?;
    let numbers: Vec<f64> =
        vector.split(',').map(|v| v.trim().parse()).collect::<Result<_, _>>().map_err(|_| wrong())?;
    let vector: [f64; 3] = numbers.try_into().map_err(|_| wrong())?;
    if unit(vector).is_none() {
        bail!(Usage(format!("--fibres {text}: that direction has no length; give another")));
    }
    Ok((label, vector))
}
