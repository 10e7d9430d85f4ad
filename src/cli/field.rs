//! `palpate field`: two volumes to a dense displacement field.

use super::console::Console;
use super::dry_run;
use super::inputs::{
    Part, check_distinct, name, read_labels, read_mask, read_volume, same_file, standing_for, warn_all,
};
use super::known::Knowledge;
use super::limits::{cap_search, field_fits};
use super::outputs::{AFFINE_FILE, FIELD_FILES, Measured, STRAIN_FILES, Target, write_field};
use super::record::{self, Read, Recording};
use anyhow::{Context, Result, bail};
use clap::Args;
use palpate::error::Shown;
use palpate::error::{StrainError, UnknownName};
use palpate::pipeline::field::{FieldResult, Progress};
use palpate::pipeline::strain::{StrainInput, StrainParams, StrainResult};
use palpate::types::params::{BodySource, Method, ModelSource, Preset};
use palpate::types::{DenseField, FieldParams, Grid, Mask, names};
use palpate::{evaluate, io, pipeline};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::time::Instant;

#[derive(Debug, Args)]
pub struct Options {
    /// Volume before the deformation (.nii, .nii.gz, .nrrd, .nhdr, .mha, .mhd, or a folder with a
    /// DICOM series or of palpate phantom)
    #[arg(value_parser = standing_for(Part::Initial))]
    initial: PathBuf,
    /// Volume after it, on any grid
    #[arg(value_parser = standing_for(Part::Deformed))]
    deformed: PathBuf,
    #[command(flatten)]
    target: Target,
    /// Where to measure: a mask of the initial volume, 0 outside
    #[arg(long, value_name = "M", value_parser = standing_for(Part::Mask))]
    mask: Option<PathBuf>,
    /// Bodies that slide along each other: labels on the initial volume's grid, 0 outside
    /// [default: found from the volumes]
    #[arg(long, value_name = "LABELS", value_parser = standing_for(Part::Labels))]
    bodies: Option<PathBuf>,
    /// A body of --bodies that moves rigidly (a bone), by its label; may be given several times
    #[arg(long, value_name = "LABEL", requires = "bodies")]
    rigid: Vec<u8>,
    /// One body: nothing slides
    #[arg(long, conflicts_with = "bodies")]
    bonded: bool,
    /// Exact displacement on the initial volume's grid: the error after each stage is written too
    #[arg(long, value_name = "FIELD", value_parser = standing_for(Part::Truth))]
    truth: Option<PathBuf>,
    /// Write the results even where the field folds, which tissue cannot do
    #[arg(long)]
    allow_folds: bool,
    /// Write the strain too, as `palpate strain` does of the results
    #[arg(long)]
    strain: bool,
    /// Check everything, say what would be done, and write nothing
    #[arg(long)]
    dry_run: bool,
    #[command(flatten)]
    knowledge: Knowledge,
    #[command(flatten)]
    tuning: Tuning,
}

/// What `field`, `track` and `demo` share.
#[derive(Debug, Args)]
pub struct Tuning {
    /// Time against error: fast or balanced; accurate is balanced with twice the matches [default:
    /// balanced]
    #[arg(long, value_parser = preset, conflicts_with = "config")]
    preset: Option<Preset>,
    /// What makes the field: full (all voxels) or sparse (matches alone, as in the source)
    /// [default: full]
    #[arg(long, value_parser = method)]
    method: Option<Method>,
    /// Motion model of each body: identity, rigid, affine, free, or auto, the smallest that
    /// explains the volumes [default: auto]
    #[arg(long, value_parser = model)]
    model: Option<ModelSource>,
    /// Feature points in the initial volume, 20 to 2,000,000 [default: by size and texture]
    #[arg(long, value_name = "N")]
    points: Option<usize>,
    /// Largest motion to look for, up to 200 mm
    /// [default: by size, twice as far where motion reaches it]
    #[arg(long, value_name = "MM")]
    search: Option<f64>,
    /// Seed of whatever is drawn at random [default: 1]
    #[arg(long, value_name = "S")]
    seed: Option<u64>,
    /// Parameters from a file: summary.json of an earlier run, or its keys as JSON or TOML; flags
    /// go before it. A summary without inputs beside it repeats its run
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
}

impl Tuning {
    /// The same as command-line arguments.
    pub fn arguments(&self) -> Vec<String> {
        let mut out = Vec::new();
        out.extend(self.config.iter().flat_map(|c| ["--config".into(), c.to_string_lossy().into_owned()]));
        out.extend(self.preset.iter().flat_map(|p| ["--preset".into(), preset_name(*p)]));
        out.extend(self.method.iter().flat_map(|m| ["--method".into(), method_name(*m)]));
        out.extend(self.model.iter().flat_map(|m| ["--model".into(), model_name(*m)]));
        out.extend(self.seed.iter().flat_map(|s| ["--seed".into(), s.to_string()]));
        out.extend(self.points.iter().flat_map(|p| ["--points".into(), p.to_string()]));
        out.extend(self.search.iter().flat_map(|s| ["--search".into(), s.to_string()]));
        out
    }

    /// The file of parameters, where one is given.
    pub fn config(&self) -> Option<&PathBuf> {
        self.config.as_ref()
    }

    /// Says so where the run that --config names had a mask and this one has none.
    pub fn mask_left_out(&self, masked: bool) -> Vec<String> {
        let Some(file) = self.config.as_ref().filter(|_| !masked) else { return Vec::new() };
        let summary = io::read_json(file).unwrap_or_default();
        let files = summary["files"].as_array().into_iter().flatten();
        let full = files.filter(|f| f["role"] == "mask").find_map(|f| f["path"].as_str());
        let mask = full.or(summary["inputs"]["mask"].as_str()).filter(|m| !m.is_empty());
        let said = |mask| format!("{}: its run had the mask {mask}, this one has none; add --mask", file.shown());
        mask.map(said).into_iter().collect()
    }

    /// Says so where the run that --config names had one of these and this one, with `known`, has
    /// not.
    pub fn known_left_out(&self, known: &Knowledge) -> Option<String> {
        let file = self.config.as_ref()?;
        let summary = io::read_json(file).unwrap_or_default();
        let earlier: Vec<&str> = summary["command_line"].as_array()?.iter().filter_map(|a| a.as_str()).collect();
        let had =
            |flag: &str| earlier.iter().any(|a| *a == flag || a.strip_prefix(flag).is_some_and(|r| r.starts_with('=')));
        let missing: Vec<&str> = known.left_out().into_iter().filter(|flag| had(flag)).collect();
        (!missing.is_empty()).then(|| {
            format!("{}: its run had {}, this one has not; give that again", file.shown(), missing.join(" and "))
        })
    }

    /// Parameters in range.
    pub fn params(&self) -> Result<FieldParams> {
        let mut params = match &self.config {
            Some(file) => io::read_config(file)?,
            None => FieldParams::preset(self.preset.unwrap_or_default()),
        };
        params.method = self.method.unwrap_or(params.method);
        params.model = self.model.unwrap_or(params.model);
        params.seed = self.seed.unwrap_or(params.seed);
        params.points = self.points.unwrap_or(params.points);
        params.search_mm = self.search.unwrap_or(params.search_mm);
        params.check()?;
        Ok(params)
    }
}

const PRESETS: [(&str, Preset); 3] =
    [("fast", Preset::Fast), ("balanced", Preset::Balanced), ("accurate", Preset::Accurate)];

fn preset_name(preset: Preset) -> String {
    PRESETS.iter().find(|p| p.1 == preset).map_or_else(String::new, |p| p.0.into())
}

fn preset(name: &str) -> Result<Preset, UnknownName> {
    names::choose("preset", name, &PRESETS)
}

const METHODS: [(&str, Method); 2] = [("full", Method::Full), ("sparse", Method::Sparse)];

fn method_name(method: Method) -> String {
    METHODS.iter().find(|m| m.1 == method).map_or_else(String::new, |m| m.0.into())
}

fn method(name: &str) -> Result<Method, UnknownName> {
    names::choose("method", name, &METHODS)
}

const MODELS: [(&str, ModelSource); 5] = [
    ("auto", ModelSource::Auto),
    ("identity", ModelSource::Identity),
    ("rigid", ModelSource::Rigid),
    ("affine", ModelSource::Affine),
    ("free", ModelSource::Free),
];

fn model_name(model: ModelSource) -> String {
    MODELS.iter().find(|m| m.1 == model).map_or_else(String::new, |m| m.0.into())
}

fn model(name: &str) -> Result<ModelSource, UnknownName> {
    names::choose("model", name, &MODELS)
}

/// The parameters of a run; flags that contradict each other are an error.
fn parameters(options: &Options) -> Result<FieldParams> {
    let Options { bodies, bonded, tuning, .. } = options;
    let mut params = tuning.params()?;
    if *bonded {
        params.bodies = BodySource::Bonded;
    }
    if bodies.is_none() && params.bodies == BodySource::Given {
        let config = tuning.config().map(|c| c.shown()).unwrap_or_default();
        bail!("{config}: its run was made with --bodies; give the label map again");
    }
    if bodies.is_some() && params.method == Method::Sparse {
        bail!("--bodies: --method sparse fits one field to the matches; leave --method out");
    }
    Ok(params)
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { initial, deformed, target, mask, bodies, rigid, truth, strain, knowledge, tuning, .. } = options;
    let mut params = parameters(options)?;
    let inputs = inputs(options);
    let given: Vec<&Path> = inputs.iter().map(|(_, path)| path.as_path()).collect();
    let files: Vec<&str> = FIELD_FILES.iter().chain(STRAIN_FILES.iter().filter(|_| *strain)).copied().collect();
    check_distinct(&given, &target.files(&files))?;

    field_fits(initial, deformed)?;

    let started = Instant::now();
    let mut warnings = tuning.mask_left_out(mask.is_some());
    warnings.extend(tuning.known_left_out(knowledge));
    if same_file(initial, deformed) {
        warnings.push("the initial and the deformed volume are the same file".into());
    }
    let progress = console.progress();
    progress.set("read", 0.0);
    let (mut first, mut second) = (Vec::new(), Vec::new());
    let (fixed, moving) = rayon::join(|| read_volume(initial, &mut first), || read_volume(deformed, &mut second));
    let (fixed, moving) = (fixed?, moving?);
    warnings.extend(first.into_iter().chain(second).chain(cap_search(&mut params, fixed.grid(), initial)));
    let mut inside = mask.as_ref().map(|m| read_mask(m, fixed.grid(), initial, &mut warnings)).transpose()?;
    if let Some(path) = bodies {
        let labels = read_labels(path, fixed.grid(), initial, &mut warnings)?;
        inside = Some(bodies_of(path, labels, inside.as_ref(), rigid)?);
        (params.bodies, params.rigid) = (BodySource::Given, rigid.clone());
    }
    let truth = truth.as_ref().map(|path| read_truth(path, fixed.grid(), initial)).transpose()?;
    let known = knowledge.read((&fixed, &moving), [initial, deformed], inside, console, &mut warnings)?;
    if options.dry_run {
        drop(progress);
        let plan = pipeline::dry_run::field(&fixed, &moving, known.mask(), &params)?;
        warn_all(console, &warnings);
        let volumes = [(initial, fixed.grid()), (deformed, moving.grid())];
        console.say(&dry_run::field(&volumes, &plan, &params, target, &files)?);
        return Ok(());
    }
    let mut folder = target.create()?;
    folder.supersede(|file| file == AFFINE_FILE)?;
    let record = Recording::start(console, inputs);
    let read = started.elapsed().as_secs_f64();

    let names = [name(initial), name(deformed), mask.as_deref().map(name).unwrap_or_default()];
    let set = |stage: &str, part| progress.set(stage, part);
    let (mut result, [fixed, moving]) = pipeline::field::run_lent(fixed, moving, &known.known(), &params, &set)
        .with_context(|| format!("{} to {}", names[0], names[1]))?;
    if result.summary.folds > 0 && !options.allow_folds {
        bail!(
            "{} to {}: the field folds in {} voxels, which tissue cannot do; check that both show the same tissue, give --mask or \
             --bodies, or write it all the same with --allow-folds",
            names[0],
            names[1],
            result.summary.folds
        );
    }
    result.summary.seconds.insert(0, ("read".into(), read));
    result.summary.warnings.splice(0..0, warnings);

    let metrics = truth.as_ref().map(|truth| {
        let measured = Some(&result.bodies);
        result.summary.stages = result.stages.iter().map(|stage| stage.scored(truth, measured)).collect();
        evaluate::metrics(&result.displacement, truth, measured, &[])
    });
    let metrics = metrics.transpose().with_context(|| format!("{} to {}", names[0], names[1]))?;

    let strain = strain.then(|| strain_of(&result, known.mask(), &set));
    let strain = strain.transpose().with_context(|| format!("{} to {}", names[0], names[1]))?;
    progress.set("write", 1.0);
    let measured = Measured {
        command: "field",
        names: [&names[0], &names[1], &names[2]],
        initial: &fixed,
        deformed: moving,
        mask: known.mask(),
        params: &params,
        truth: truth.as_ref().zip(metrics.as_ref()),
        strain: strain.as_ref(),
        record,
    };
    let summary = write_field(&mut folder, measured, &mut result)?;
    folder.commit()?;
    drop(progress);
    warn_all(console, &result.summary.warnings);
    console.say(&format!("{summary}{}", target.look()));
    Ok(())
}

/// Everything that is read, for the summary.
fn inputs(options: &Options) -> Read {
    let mut all = record::inputs(&[
        ("initial", Some(&options.initial)),
        ("deformed", Some(&options.deformed)),
        ("mask", options.mask.as_ref()),
        ("bodies", options.bodies.as_ref()),
        ("truth", options.truth.as_ref()),
        ("config", options.tuning.config()),
    ]);
    all.extend(options.knowledge.inputs());
    all
}

/// The strain of a field, by the labels of the mask.
fn strain_of(result: &FieldResult, mask: Option<&Mask>, progress: Progress<'_>) -> Result<StrainResult, StrainError> {
    let input = StrainInput { labels: mask, ..StrainInput::of(result) };
    pipeline::strain::run(input, &StrainParams::default(), progress)
}

/// The exact displacement of `path`, which must lie on the initial volume's grid.
fn read_truth(path: &Path, grid: &Grid, initial: &Path) -> Result<DenseField> {
    let truth = io::read_field(path)?;
    if !truth.grid().same_as(grid) {
        bail!(
            "{}: lies on another grid than {}; give the exact displacement on the initial volume's grid",
            name(path),
            name(initial)
        );
    }
    Ok(truth)
}

/// Bodies at most: each takes passes of its own.
const MAX_BODIES: usize = 32;

/// The labels of `path` inside the mask. Each of `rigid` must be among them.
fn bodies_of(path: &Path, mut labels: Mask, mask: Option<&Mask>, rigid: &[u8]) -> Result<Mask> {
    if let Some(mask) = mask {
        let outside = labels.as_mut_slice().iter_mut().zip(mask.as_slice()).filter(|(_, m)| **m == 0);
        outside.for_each(|(l, _)| *l = 0);
    }
    let found: BTreeSet<u8> = labels.as_slice().iter().copied().filter(|l| *l != 0).collect();
    let names = || found.iter().map(u8::to_string).collect::<Vec<_>>().join(", ");
    match (found.len(), rigid.iter().find(|r| !found.contains(r))) {
        (0, _) => bail!("{}: no body lies in the mask; give labels that are 1 or more in the tissue", path.shown()),
        (n, _) if n > MAX_BODIES => {
            bail!(
                "{}: {n} bodies; give at most {MAX_BODIES} labels, one a part that slides along the others",
                path.shown()
            )
        }
        (_, Some(label)) => bail!("{}: --rigid {label} is no body of it; there are {}", path.shown(), names()),
        _ => Ok(labels),
    }
}
