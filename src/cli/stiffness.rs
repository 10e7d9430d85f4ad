//! `palpate stiffness`: a displacement field to Young's modulus.

use super::Usage;
use super::console::Console;
use super::inputs::{check_distinct, name, read_mask, warn_all};
use anyhow::{Context, Result, bail};
use clap::Args;
use palpate::io::{self, OutputFolder};
use palpate::pipeline;
use palpate::pipeline::stiffness::Inputs;
use palpate::report::stiffness as report;
use palpate::stiffness::patches::Place;
use palpate::types::stiffness::{LawChoice, Side};
use palpate::types::{Grid, Mask, StiffnessParams, StiffnessResult};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// What is written.
const FILES: [&str; 9] = [
    "stiffness.nii.gz",
    "stiffness_sd.nii.gz",
    "residual.nii.gz",
    "regions.csv",
    "mesh.vtu",
    "model.feb",
    "model.inp",
    "summary.json",
    "report.html",
];

#[derive(Debug, Args)]
pub struct Options {
    /// Displacement field, initial to deformed (5-D NIfTI, LPS mm)
    #[arg(long, value_name = "F")]
    field: PathBuf,
    /// Use these matches inside the body, with their precision, in place of the field (matches.csv)
    #[arg(long, value_name = "M.csv")]
    matches: Option<PathBuf>,
    /// The body: a mask on the field's grid; regions are then looked for
    #[arg(long, value_name = "M", conflicts_with = "labels", required_unless_present = "labels")]
    mask: Option<PathBuf>,
    /// Regions: a label map on the field's grid, 0 outside
    #[arg(long, value_name = "L")]
    labels: Option<PathBuf>,
    /// Names of the labels, as 1=skin,2=fat
    #[arg(long, value_name = "NAMES", requires = "labels")]
    names: Option<String>,
    /// Where the body is held: x-, x+ ... z+ in world axes, or a mask that covers the patch
    #[arg(long, value_name = "AXIS|FILE", default_value = "z-", allow_hyphen_values = true)]
    held: String,
    /// Where it is pressed, in the same way
    #[arg(long, value_name = "AXIS|FILE", default_value = "z+", allow_hyphen_values = true)]
    load: String,
    /// Total force on the loaded patch in N, its magnitude; without, moduli are ratios
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    force: Option<f64>,
    /// Poisson's ratio of all regions
    #[arg(long, value_name = "NU", default_value_t = 0.49, allow_negative_numbers = true)]
    poisson: f64,
    /// linear, neo-hookean, or auto: linear unless the data ask for more
    #[arg(long, default_value = "auto")]
    model: LawChoice,
    /// Nodes of the mesh, about; 500 to 500,000
    #[arg(long, value_name = "N", default_value_t = 20_000)]
    nodes: usize,
    /// Regions to try at most without labels, 1 to 8
    #[arg(long, value_name = "N", default_value_t = 4)]
    regions: usize,
    /// Folder for the results
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Write into a folder that is not empty
    #[arg(long)]
    overwrite: bool,
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { poisson, model, force, nodes, regions, .. } = *options;
    let params = StiffnessParams { poisson, model, force_n: force, nodes, regions };
    params.check()?;
    let body = options.labels.as_ref().or(options.mask.as_ref());
    let Some(body) = body else { bail!(Usage("give --labels or --mask".into())) };
    let places = [&options.held, &options.load].map(|t| Side::parse(t).is_none().then(|| PathBuf::from(t)));
    let given: Vec<&Path> = [Some(&options.field), Some(body), options.matches.as_ref()]
        .into_iter()
        .chain(places.iter().map(Option::as_ref))
        .flatten()
        .map(PathBuf::as_path)
        .collect();
    check_distinct(&given, &FILES.map(|f| options.output.join(f)))?;

    let started = Instant::now();
    let progress = console.progress();
    progress.set("read", 0.0);
    let field = io::read_field(&options.field)?;
    let mut labels = read_mask(body, field.grid(), &options.field)?;
    if options.labels.is_none() {
        labels.as_mut_slice().iter_mut().for_each(|v| *v = u8::from(*v > 0));
    }
    let matches = options.matches.as_ref().map(io::read_matches).transpose()?;
    let held = place(&options.held, field.grid(), &options.field, "--held")?;
    let load = place(&options.load, field.grid(), &options.field, "--load")?;
    let names = names(options.names.as_deref(), &labels)?;
    let mut folder = OutputFolder::create(&options.output, options.overwrite)?;
    let read = started.elapsed().as_secs_f64();

    let inputs = Inputs {
        field: &field,
        matches: matches.as_ref(),
        labels: &labels,
        labelled: options.labels.is_some(),
        held: &held,
        load: &load,
        names: &|label| names[label as usize].clone(),
    };
    let result = pipeline::stiffness::run(&inputs, &params, &|s, f| progress.set(s, f));
    let mut result = result.with_context(|| format!("{} with {}", name(&options.field), name(body)))?;
    result.seconds.insert(0, ("read".into(), read));
    progress.set("write", 1.0);
    write(&mut folder, options, body, &mut result)?;
    folder.commit()?;
    drop(progress);
    result.evidence.iter().for_each(|e| console.detail(&report::evidence_line(e)));
    result.seconds.iter().for_each(|(stage, s)| console.detail(&format!("{stage}: {s:.2} s")));
    warn_all(console, &result.warnings);
    console.say(&format!("{}  results      {}", report::text(&result), options.output.join("report.html").display()))
}

fn place(text: &str, grid: &Grid, reference: &Path, flag: &str) -> Result<Place> {
    match Side::parse(text) {
        Some(side) => Ok(Place::Side(side)),
        None => {
            let path = Path::new(text);
            if !path.exists() {
                bail!("{flag} {text}: is neither a side (x-, x+, y-, y+, z-, z+) nor a file; check the spelling");
            }
            Ok(Place::Mask(Box::new(read_mask(path, grid, reference)?), name(path)))
        }
    }
}

/// A name for every label.
fn names(given: Option<&str>, labels: &Mask) -> Result<Vec<String>> {
    let mut out: Vec<String> = (0..256).map(|l| format!("region {l}")).collect();
    for pair in given.into_iter().flat_map(|g| g.split(',')) {
        let parsed = pair.split_once('=').and_then(|(l, n)| Some((l.trim().parse::<u8>().ok()?, n.trim())));
        let Some((label, text)) = parsed.filter(|p| !p.1.is_empty()) else {
            bail!(Usage(format!("--names: {pair:?} is not of the form 1=skin")));
        };
        if !labels.as_slice().contains(&label) {
            bail!(Usage(format!("--names: the label map holds no label {label}")));
        }
        out[label as usize] = text.into();
    }
    Ok(out)
}

fn write(folder: &mut OutputFolder, options: &Options, body: &Path, result: &mut StiffnessResult) -> Result<()> {
    let started = Instant::now();
    let about = match result.absolute {
        true => "palpate: Young's modulus, kPa",
        false => "palpate: Young's modulus over the reference region's (a ratio)",
    };
    folder.write("stiffness.nii.gz", |p| io::write_volume(p, &result.map, about))?;
    folder.write("stiffness_sd.nii.gz", |p| {
        io::write_volume(p, &result.map_sd, &about.replace("palpate:", "palpate: sd of"))
    })?;
    folder
        .write("residual.nii.gz", |p| io::write_volume(p, &result.residual, "palpate: length of the residual, mm"))?;
    folder.write("regions.csv", |p| io::write_regions(p, &result.regions, result.absolute))?;
    let modulus: Vec<f32> = result.element_modulus.iter().map(|&e| e as f32).collect();
    let label: Vec<f32> = result.mesh.labels().iter().map(|&l| f32::from(l)).collect();
    let data = [("youngs_modulus", modulus.as_slice()), ("label", label.as_slice())];
    folder.write("mesh.vtu", |p| io::write_quadratic_mesh(p, &result.mesh, &result.displacement, &data))?;
    folder.write("model.feb", |p| io::write_feb(p, result))?;
    folder.write("model.inp", |p| io::write_inp(p, result))?;
    result.seconds.push(("write".into(), started.elapsed().as_secs_f64()));
    let inputs = report::InputNames {
        field: name(&options.field),
        body: name(body),
        matches: options.matches.as_deref().map(name),
        held: options.held.clone(),
        load: options.load.clone(),
    };
    folder.write("summary.json", |p| io::write_json(p, &report::summary(result, &inputs)))?;
    let page = report::page(result, &inputs)?;
    folder.write("report.html", |p| io::write_text(p, &page))?;
    Ok(())
}
