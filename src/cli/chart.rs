//! `palpate chart`: speed against accuracy.

use super::console::Console;
use super::inputs::name;
use super::outputs::Target;
use super::peers::Peers;
use super::stress::part;
use anyhow::{Context, Result, bail};
use clap::Args;
use palpate::error::FieldError;
use palpate::evaluate::frontier::standings;
use palpate::grasp::simulate::simulate;
use palpate::io;
use palpate::pipeline::pressed;
use palpate::pipeline::trials::{self, Case, Variant};
use palpate::report::frontier::{self as report, Group};
use palpate::types::{Part, Scene, Trial};
use std::path::{Path, PathBuf};
use std::time::Instant;

#[derive(Debug, Args)]
pub struct Options {
    #[command(flatten)]
    target: Target,
    /// Folder with initial and deformed volume and their truth or landmarks, as `palpate phantom` writes it; may be given
    /// several times; then only the field is charted [default: an embedded spread]
    #[arg(long, value_name = "DIR")]
    case: Vec<PathBuf>,
    /// Also run other tools that are installed: greedy, ANTs, elastix, demons, plastimatch, MuJoCo (needs python3)
    #[arg(long)]
    peers: bool,
    /// A small version: fewer and smaller cases, fewer settings
    #[arg(long)]
    quick: bool,
    /// field, stiffness or grasp; may be given several times [default: all]
    #[arg(long, value_name = "PART", value_parser = part)]
    part: Vec<Part>,
    /// Seed of the embedded cases
    #[arg(long, value_name = "S", default_value_t = 1)]
    seed: u64,
}

/// The first of these files that the folder holds.
fn one_of(folder: &Path, names: &[&str]) -> Option<PathBuf> {
    names.iter().map(|n| folder.join(n)).find(|p| p.is_file())
}

/// A case from a folder: `initial` or `fixed`, `deformed` or `moving`, `truth`, `mask`, `landmarks.csv`.
fn read_case(folder: &Path) -> Result<Case> {
    let needed = |names: &[&str]| {
        one_of(folder, names).with_context(|| format!("{}: holds no {}", folder.display(), names.join(" or ")))
    };
    let initial = io::read_volume(needed(&["initial.nii.gz", "fixed.nii.gz", "initial.nii", "fixed.nii"])?)?;
    let deformed = io::read_volume(needed(&["deformed.nii.gz", "moving.nii.gz", "deformed.nii", "moving.nii"])?)?;
    let truth = one_of(folder, &["truth.nii.gz", "truth.nii"]).map(io::read_field).transpose()?;
    let mask = one_of(folder, &["mask.nii.gz", "mask.nii"]).map(io::read_mask).transpose()?;
    let landmarks = one_of(folder, &["landmarks.csv"]).map(io::read_landmarks).transpose()?.unwrap_or_default();
    let grids = [truth.as_ref().map(|t| ("the truth", t.grid())), mask.as_ref().map(|m| ("the mask", m.grid()))];
    for (what, grid) in grids.into_iter().flatten() {
        if !grid.same_as(initial.grid()) {
            bail!(FieldError::GridMismatch {
                what: format!("{}: {what}", folder.display()),
                found: grid.shape(),
                reference: "the initial volume".into(),
                expected: initial.grid().shape(),
            });
        }
    }
    if truth.is_none() && landmarks.is_empty() {
        bail!("{}: holds neither truth.nii.gz nor landmarks.csv, so nothing can be scored", folder.display());
    }
    Ok(Case { name: name(folder), initial, deformed, truth, mask, landmarks })
}

/// Sides of the heads that show cost against size (voxels).
const SIDES: [usize; 4] = [32, 48, 80, 128];
/// Nodes that are tried for the stiffness, the default last.
const NODES: [usize; 5] = [1000, 2000, 4000, 8000, 20_000];

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { target, case, peers, quick, part, seed } = options;
    let wanted = |p: Part| if part.is_empty() { case.is_empty() || p == Part::Field } else { part.contains(&p) };
    let mut folder = target.create()?;
    let started = Instant::now();
    let between = io::Scratch::new()?;
    let found = peers.then(|| Peers::find(between.path())).transpose()?;
    if found.as_ref().is_some_and(|f| f.methods.is_empty()) {
        console.warn("no other registration tool is installed (benches/frontier/peers.py says which are known)");
    }
    let progress = console.progress();
    let (mut trials, mut groups) = (Vec::new(), Vec::new());
    if wanted(Part::Field) {
        let variants = Variant::all(*quick);
        let spread = if case.is_empty() { trials::spread(*quick, *seed) } else { Vec::new() };
        let count = spread.len() + case.len();
        let cases = spread.iter().map(|p| Ok(Case::embedded(p)?)).chain(case.iter().map(|c| read_case(c)));
        for (i, case) in cases.enumerate() {
            let case = case?;
            for (k, variant) in variants.iter().enumerate() {
                progress.set("field", (i as f64 + k as f64 / variants.len() as f64) / count as f64);
                trials.push(case.run(variant));
            }
            if let Some(peers) = &found {
                progress.set("other tools", (i as f64 + 0.5) / count as f64);
                trials.extend(peers.run(&case)?);
            }
        }
        let group = |title: &str, whole| Group {
            part: Part::Field,
            title: title.into(),
            unit: "% of the motion left",
            standings: standings(trials.iter().filter(|t| t.whole == whole)),
        };
        groups.push(group("Displacement field", false));
        if found.is_some() {
            groups.push(group("Beside other tools, whole commands", true));
        }
        if case.is_empty() {
            let sides = if *quick { &SIDES[..2] } else { &SIDES[..] };
            trials.extend(trials::sizes(sides, &|f| progress.set("size", f))?);
        }
    }
    if wanted(Part::Stiffness) {
        let (side, nodes) = if *quick { (32, &NODES[..2]) } else { (48, &NODES[..]) };
        let found = pressed::stiffness_trials(side, nodes, &|f| progress.set("stiffness", f))?;
        groups.push(Group {
            part: Part::Stiffness,
            title: "Stiffness".into(),
            unit: "% of the moduli",
            standings: standings(&found),
        });
        trials.extend(found);
    }
    if wanted(Part::Grasp) {
        let mut runs = trials::grasp_trials(if *quick { 0.01 } else { 0.3 }, &|f| progress.set("grasp", f))?;
        if let Some(peers) = &found {
            let exact = simulate(&trials::exact(&Scene::reference()), &|_| {})?;
            let postures: Vec<f64> = exact.motions.iter().map(|m| m.reached.pose[2].to_degrees()).collect();
            runs.extend(best_mujoco(peers.mujoco(&postures)?));
        }
        let (unit, title) = ("degrees", "Grasp: object angle over eight motions".into());
        groups.push(Group { part: Part::Grasp, title, unit, standings: standings(&runs) });
        trials.extend(runs);
    }
    progress.set("write", 1.0);
    folder.write("chart.csv", |p| io::write_trials(p, &trials))?;
    folder.write("chart.svg", |p| io::write_text(p, &report::svg(&groups, &trials)))?;
    let seconds = started.elapsed().as_secs_f64();
    folder.write("summary.json", |p| io::write_json(p, &report::summary(&groups, seconds)))?;
    folder.write("chart.html", |p| io::write_text(p, &report::page(&groups, &trials)))?;
    folder.commit()?;
    drop(progress);
    let look = target.output.join("chart.html");
    console.say(&format!("{}  results      {}", report::text(&groups), look.display()))
}

/// MuJoCo's settings with the least error and with the least time.
fn best_mujoco(mut runs: Vec<Trial>) -> Vec<Trial> {
    runs.sort_by(|a, b| a.error.total_cmp(&b.error));
    let fastest = runs.iter().min_by(|a, b| a.cpu_s.total_cmp(&b.cpu_s)).cloned();
    runs.truncate(1);
    runs.extend(fastest.filter(|f| runs.first() != Some(f)));
    runs
}
