//! `palpate plan`: which press, voxel size and noise would give a wanted deviation of each modulus.

use super::Usage;
use super::console::Console;
use super::inputs::{Part, check_distinct, file_of, name, some_labels, standing_for, warn_all};
use super::limits::mesh_fits;
use super::outputs::Target;
use super::record::{self, Recording};
use super::stiffness::{names, number, place, put};
use anyhow::{Context, Result, bail};
use clap::Args;
use palpate::io;
use palpate::pipeline::experimental_design::{self, PlanInputs};
use palpate::report::plan::{PlanReport, page, summary, text};
use palpate::report::record::{in_summary, on_page};
use palpate::types::plan::PlanParams;
use palpate::types::stiffness::{Contact, Side};
use palpate::types::{Mask, StiffnessParams};
use std::path::{Path, PathBuf};

/// What is written.
const FILES: [&str; 3] = ["plan.csv", "summary.json", "report.html"];

#[derive(Debug, Args)]
pub struct Options {
    /// Regions: a label map, 0 outside the body
    #[arg(long, value_name = "L", value_parser = standing_for(Part::Labels))]
    labels: PathBuf,
    /// Young's modulus that you expect of each label, in kPa; may be given several times
    #[arg(long, value_name = "LABEL=KPA", value_delimiter = ',', required = true)]
    modulus: Vec<String>,
    /// Names of the labels, as 1=skin,2=fat
    #[arg(long, value_name = "NAMES")]
    names: Option<String>,
    /// Where the body is held: x-, x+ ... z+ in world axes, or a mask that covers the patch
    #[arg(long, value_name = "AXIS|FILE", default_value = "z-", allow_hyphen_values = true)]
    held: String,
    /// Where it is to be pressed, in the same way
    #[arg(long, value_name = "AXIS|FILE", default_value = "z+", allow_hyphen_values = true)]
    load: String,
    /// How a flat loaded patch touches the plate: sticking or sliding; a curved one slides
    #[arg(long, value_name = "HOW", default_value = "sticking", value_parser = contact)]
    contact: Contact,
    /// Poisson's ratio of all regions, or LABEL=NU of one; may be given several times
    /// [default: 0.49]
    #[arg(long, value_name = "NU|LABEL=NU", value_delimiter = ',', allow_hyphen_values = true)]
    poisson: Vec<String>,
    /// Wanted standard deviation of each modulus, in per cent of it
    #[arg(long, value_name = "PERCENT", default_value_t = 10.0, allow_negative_numbers = true)]
    want: f64,
    /// The force will not be measured: ratios to the largest region are what is wanted
    #[arg(long)]
    ratios: bool,
    /// How far the plate goes in, in mm [default: 0.5, 1, 2, 4 and 8 % of the body's extent along
    /// the load]
    #[arg(long, value_name = "MM", value_delimiter = ',', allow_negative_numbers = true)]
    press: Vec<f64>,
    /// Edge of a voxel, in mm [default: that of the labels]
    #[arg(long, value_name = "MM", value_delimiter = ',', allow_negative_numbers = true)]
    voxel: Vec<f64>,
    /// Standard deviation of one voxel's displacement along an axis, in mm
    /// [default: 0.05, 0.1 and 0.2 voxel]
    #[arg(long, value_name = "MM", value_delimiter = ',', allow_negative_numbers = true)]
    noise: Vec<f64>,
    /// One standard deviation of the border between two labels, in voxels
    #[arg(long, value_name = "VOXELS", default_value_t = StiffnessParams::default().label_sd)]
    label_sd: f64,
    /// Nodes of the mesh, about; 500 to 500,000
    #[arg(long, value_name = "N", default_value_t = StiffnessParams::default().nodes)]
    nodes: usize,
    #[command(flatten)]
    target: Target,
}

/// How a plate touches.
fn contact(text: &str) -> Result<Contact, String> {
    let known = [Contact::Sticking, Contact::Sliding];
    known.into_iter().find(|c| c.name() == text).ok_or_else(|| format!("{text} is neither sticking nor sliding"))
}

impl Options {
    fn params(&self) -> Result<PlanParams> {
        let usual = StiffnessParams::default();
        let (mut poisson, mut poisson_of, mut moduli) = (usual.poisson, Vec::new(), Vec::new());
        for text in &self.poisson {
            match text.split_once('=') {
                None => poisson = number(text, "--poisson", "0.49 or 1=0.49")?,
                Some((label, nu)) => put(&mut poisson_of, label, nu, "--poisson", "1=0.49")?,
            }
        }
        for text in &self.modulus {
            let Some((label, e)) = text.split_once('=') else {
                bail!(Usage(format!("--modulus: {text:?} is not of the form 2=100 (label, kPa)")));
            };
            put(&mut moduli, label, e, "--modulus", "2=100")?;
        }
        let (label_sd, nodes) = (self.label_sd, self.nodes);
        let stiffness = StiffnessParams { poisson, poisson_of, label_sd, nodes, ..usual };
        let params = PlanParams {
            moduli,
            want: self.want / 100.0,
            press_mm: self.press.clone(),
            voxel_mm: self.voxel.clone(),
            noise_mm: self.noise.clone(),
            contact: self.contact,
            ratios: self.ratios,
            stiffness,
        };
        params.check()?;
        Ok(params)
    }
}

/// Each label of the map needs a modulus, and each modulus and ratio a label.
fn check_labels(labels: &Mask, params: &PlanParams, path: &Path) -> Result<()> {
    let mut held = [false; 256];
    labels.as_slice().iter().filter(|l| **l > 0).for_each(|l| held[*l as usize] = true);
    let missing = |l: &u8| held[*l as usize] && params.modulus(*l).is_none();
    if let Some(label) = (1..=255u8).find(missing) {
        let example = format!("--modulus {label}=20");
        bail!(Usage(format!(
            "--modulus: {} holds label {label}, of which no modulus is assumed; add {example}",
            name(path)
        )));
    }
    for (flag, given) in [("--modulus", &params.moduli), ("--poisson", &params.stiffness.poisson_of)] {
        if let Some((label, _)) = given.iter().find(|g| !held[g.0 as usize]) {
            bail!(Usage(format!("{flag}: {} holds no label {label}; check the label or the file", name(path))));
        }
    }
    Ok(())
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let params = options.params()?;
    mesh_fits(params.stiffness.nodes)?;
    let Options { labels: path, held, load, target, .. } = options;
    let masks: Vec<(&str, PathBuf)> = [("held", held), ("load", load)]
        .into_iter()
        .filter(|(_, text)| Side::parse(text).is_none())
        .filter_map(|(role, text)| Some((role, file_of(Path::new(text), Part::Mask).ok()?)))
        .collect();
    let given: Vec<&Path> = [path.as_path()].into_iter().chain(masks.iter().map(|m| m.1.as_path())).collect();
    check_distinct(&given, &target.files(&FILES))?;
    target.check()?;
    let mut inputs = record::inputs(&[("labels", Some(path))]);
    inputs.extend(masks);
    let progress = console.progress();
    progress.set("read", 0.0);
    let labels = some_labels(path)?;
    check_labels(&labels, &params, path)?;
    let mut warnings = Vec::new();
    let named = names(options.names.as_deref(), &labels)?;
    let held = place(held, labels.grid(), path, "--held", &mut warnings)?;
    let load = place(load, labels.grid(), path, "--load", &mut warnings)?;
    let mut folder = target.create()?;
    let record = Recording::start(console, inputs);
    let names = |label: u8| named[label as usize].clone();
    let inputs = PlanInputs { labels: &labels, held: &held, load: &load, names: &names };
    let mut plan = experimental_design::run(&inputs, &params, &|stage, part| progress.set(stage, part))
        .with_context(|| name(path))?;
    plan.warnings.splice(0..0, warnings);

    progress.set("write", 1.0);
    let file = name(path);
    let report = PlanReport { labels: &file, params: &params, plan: &plan };
    folder.write("plan.csv", |p| io::write_plan(p, &plan))?;
    let record = record.finish();
    folder.write("summary.json", |p| io::write_json(p, &in_summary(summary(&report), &record)))?;
    folder.write("report.html", |p| io::write_text(p, &on_page(page(&report), &record)))?;
    folder.commit()?;
    drop(progress);
    warn_all(console, &plan.warnings);
    console.say(&format!("{}{}", text(&report), target.look()));
    Ok(())
}
