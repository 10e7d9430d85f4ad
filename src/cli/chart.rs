//! `palpate chart`: speed against accuracy.

use super::Usage;
use super::console::Console;
use super::inputs::{read_landmarks, read_mask, same_grid, warn_all};
use super::limits::field_fits;
use super::outputs::Target;
use super::peers::Peers;
use super::record::Recording;
use super::stress::part;
use anyhow::{Context, Result, bail};
use clap::Args;
use palpate::error::Shown;
use palpate::evaluate;
use palpate::evaluate::frontier::{is_relative, standings};
use palpate::grasp::simulate::simulate;
use palpate::io;
use palpate::pipeline::compression_phantoms;
use palpate::pipeline::speed_accuracy::{self, Case, Variant};
use palpate::report::frontier::{self as report, Group};
use palpate::report::record::{in_summary, on_page};
use palpate::types::{DenseField, Part, Scene, Trial};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::time::Instant;

#[derive(Debug, Args)]
pub struct Options {
    #[command(flatten)]
    target: Target,
    /// Folder with initial and deformed volume and their truth or landmarks, as `palpate phantom`
    /// writes it; may be given several times; then only the field is charted
    /// [default: an embedded spread]
    #[arg(long, value_name = "DIR")]
    case: Vec<PathBuf>,
    /// Also run other tools that are installed: greedy, ANTs, elastix, demons, plastimatch, MuJoCo
    /// (needs python3)
    #[arg(long)]
    peers: bool,
    /// A small version: fewer and smaller cases, fewer settings
    #[arg(long)]
    quick: bool,
    /// field, stiffness or grasp; may be given several times [default: all]
    #[arg(long, value_name = "PART", value_parser = part)]
    part: Vec<Part>,
    /// Seed of the embedded cases of the field [default: 1]
    #[arg(long, value_name = "S")]
    seed: Option<u64>,
}

/// The first of these files that the folder holds.
fn one_of(folder: &Path, names: &[&str]) -> Option<PathBuf> {
    names.iter().map(|n| folder.join(n)).find(|p| p.is_file())
}

/// A case from a folder: `initial` or `fixed`, `deformed` or `moving`, `truth`, `mask`,
/// `landmarks.csv`. Warns of landmarks outside the volume.
fn read_case(folder: &Path, name: &str, warnings: &mut Vec<String>) -> Result<Case> {
    if !folder.is_dir() {
        let what = if folder.exists() { "is not a folder" } else { "does not exist" };
        bail!("{} {what}; --case takes a folder as palpate phantom writes it", folder.shown());
    }
    let needed = |names: &[&str]| {
        one_of(folder, names).with_context(|| format!("{}: holds no {}", folder.shown(), names.join(" or ")))
    };
    let reference = needed(&["initial.nii.gz", "fixed.nii.gz", "initial.nii", "fixed.nii"])?;
    let other = needed(&["deformed.nii.gz", "moving.nii.gz", "deformed.nii", "moving.nii"])?;
    field_fits(&reference, &other)?;
    let (initial, deformed) = (io::read_volume(&reference)?, io::read_volume(other)?);
    let truth = one_of(folder, &["truth.nii.gz", "truth.nii"]);
    let mask = one_of(folder, &["mask.nii.gz", "mask.nii"]);
    let landmarks = one_of(folder, &["landmarks.csv"]);
    if truth.is_none() && landmarks.is_none() {
        bail!("{}: holds neither truth.nii.gz nor landmarks.csv, so nothing can be scored", folder.shown());
    }
    let mask = mask.map(|m| read_mask(&m, initial.grid(), &reference, warnings)).transpose()?;
    let read_truth = |path: &PathBuf| -> Result<DenseField> {
        let field = io::read_field(path)?;
        same_grid(path, field.grid(), initial.grid(), &reference)?;
        evaluate::check_numbers("truth", &field, mask.as_ref()).with_context(|| path.shown())?;
        Ok(field)
    };
    let truth = truth.as_ref().map(read_truth).transpose()?;
    // Where there is a true field, it is what errors are taken against.
    let landmarks = landmarks.filter(|_| truth.is_none());
    let landmarks = read_landmarks(landmarks.as_slice(), initial.grid(), warnings)?;
    Ok(Case { name: name.into(), initial, deformed, truth, mask, landmarks })
}

/// A name for each folder: its own, with as many of those above it as tell them apart.
///
/// # Errors
/// When one folder is given twice.
fn case_names(folders: &[PathBuf]) -> Result<Vec<String>> {
    let whole: Vec<PathBuf> = folders.iter().map(|f| f.canonicalize().unwrap_or_else(|_| f.clone())).collect();
    if let Some(i) = (1..whole.len()).find(|&i| whole[..i].contains(&whole[i])) {
        bail!(Usage(format!("--case {} is given twice", folders[i].shown())));
    }
    let short = |path: &PathBuf, parts: usize| {
        let all: Vec<_> = path.iter().map(|p| p.to_string_lossy()).collect();
        all[all.len().saturating_sub(parts)..].join("/")
    };
    let deepest = whole.iter().map(|p| p.iter().count()).max().unwrap_or(1);
    let named = (1..=deepest).map(|parts| whole.iter().map(|p| short(p, parts)).collect::<Vec<_>>());
    let apart = |names: &Vec<String>| names.iter().collect::<BTreeSet<_>>().len() == names.len();
    Ok(named.into_iter().find(apart).unwrap_or_default())
}

/// Sides of the heads that show cost against size (voxels).
const SIDES: [usize; 4] = [32, 48, 80, 128];
/// Nodes that are tried for the stiffness, the default last.
const NODES: [usize; 5] = [1000, 2000, 4000, 8000, 20_000];
/// Voxels across the pressed bodies: a third less, and the punch on the layers is too small to be
/// found on coarse meshes.
const PRESSED_BODY_VOXELS: usize = 48;

/// What the flags ask for that cannot be had together.
fn check(options: &Options, wanted: impl Fn(Part) -> bool, warnings: &mut Vec<String>) -> Result<()> {
    let Options { case, peers, seed, .. } = options;
    if !case.is_empty() && !wanted(Part::Field) {
        bail!(Usage(
            "--case holds volumes, of which only the field is charted; leave --part out, or give --part field".into()
        ));
    }
    let embedded = case.is_empty() && wanted(Part::Field);
    if seed.is_some() && !embedded {
        warnings.push("--seed changes nothing here: only the embedded cases of the field have one".into());
    }
    if *peers && !wanted(Part::Field) && !wanted(Part::Grasp) {
        warnings.push("--peers changes nothing here: no other tool that is known measures stiffness".into());
    }
    Ok(())
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { target, case, peers, quick, part, seed } = options;
    let wanted = |p: Part| if part.is_empty() { case.is_empty() || p == Part::Field } else { part.contains(&p) };
    let mut warnings = Vec::new();
    check(options, wanted, &mut warnings)?;
    target.check()?;
    let names = case_names(case)?;
    // All of them before any work.
    for (folder, name) in case.iter().zip(&names) {
        read_case(folder, name, &mut warnings)?;
    }
    warn_all(console, &warnings);
    let mut folder = target.create()?;
    let record = Recording::start(console, case.iter().map(|c| ("case", c.clone())).collect());
    let started = Instant::now();
    let between = io::Scratch::new()?;
    let found = if *peers { find_peers(between.path(), &wanted, console) } else { None };
    let progress = console.progress();
    let (mut trials, mut groups) = (Vec::new(), Vec::new());
    if wanted(Part::Field) {
        let variants = Variant::all(*quick);
        let spread = if case.is_empty() { speed_accuracy::spread(*quick, seed.unwrap_or(1)) } else { Vec::new() };
        let count = (spread.len() + case.len()) as f64;
        let given = case.iter().zip(&names).map(|(c, name)| read_case(c, name, &mut Vec::new()));
        let cases = spread.iter().map(|p| Ok(Case::embedded(p)?)).chain(given);
        for (i, case) in cases.enumerate() {
            let (case, i) = (case?, i as f64);
            let own = if found.is_some() { 0.5 } else { 1.0 };
            for (k, variant) in variants.iter().enumerate() {
                progress.set("field", (i + own * k as f64 / variants.len() as f64) / count);
                trials.push(case.run(variant));
            }
            if let Some(peers) = &found {
                let told = |done: f64| progress.set("other tools", (i + own + (1.0 - own) * done) / count);
                trials.extend(peers.run(&case, &told)?);
            }
        }
        let group = |title: &str, whole| {
            let some = || trials.iter().filter(|t| t.whole == whole);
            let unit = if is_relative(some()) { "% of the motion left" } else { "mm" };
            Group { part: Part::Field, title: title.into(), unit, standings: standings(some()) }
        };
        groups.push(group("Displacement field", false));
        if found.is_some() {
            groups.push(group("Beside other tools, whole commands", true));
        }
        if case.is_empty() {
            let sides = if *quick { &SIDES[..2] } else { &SIDES[..] };
            trials.extend(speed_accuracy::sizes(sides, &|f| progress.set("size", f))?);
        }
    }
    if wanted(Part::Stiffness) {
        let nodes = if *quick { &NODES[..2] } else { &NODES[..] };
        let found =
            compression_phantoms::stiffness_trials(PRESSED_BODY_VOXELS, nodes, &|f| progress.set("stiffness", f))?;
        groups.push(Group {
            part: Part::Stiffness,
            title: "Stiffness".into(),
            unit: "% of the moduli",
            standings: standings(&found),
        });
        trials.extend(found);
    }
    if wanted(Part::Grasp) {
        let mut runs = speed_accuracy::grasp_trials(if *quick { 0.01 } else { 0.3 }, &|f| progress.set("grasp", f))?;
        if let Some(peers) = &found {
            match peers.mujoco(&simulate(&speed_accuracy::exact(&Scene::reference()), &|_| {})?) {
                Ok(nearest) => runs.extend(nearest),
                Err(e) => console.warn(&format!("left out: {e:#}")),
            }
        }
        let (unit, title) = ("degrees", "Grasp: object angle over eight motions".into());
        groups.push(Group { part: Part::Grasp, title, unit, standings: standings(&runs) });
        trials.extend(runs);
    }
    warn_of_failures(&trials, console)?;
    progress.set("write", 1.0);
    folder.write("chart.csv", |p| io::write_trials(p, &trials))?;
    folder.write("chart.svg", |p| io::write_text(p, &report::svg(&groups, &trials)))?;
    let seconds = started.elapsed().as_secs_f64();
    let record = record.finish();
    folder.write("summary.json", |p| io::write_json(p, &in_summary(report::summary(&groups, seconds), &record)))?;
    folder.write("chart.html", |p| io::write_text(p, &on_page(report::page(&groups, &trials), &record)))?;
    folder.commit()?;
    drop(progress);
    let look = target.output.join("chart.html");
    console.say(&format!("{}  results      {}", report::text(&groups), look.shown()));
    Ok(())
}

/// The other tools; says which are left out, and goes on without any where they cannot be looked
/// for.
fn find_peers(between: &Path, wanted: &impl Fn(Part) -> bool, console: &Console) -> Option<Peers> {
    let [field, grasp] = [Part::Field, Part::Grasp].map(wanted);
    if !field && !grasp {
        return None;
    }
    match Peers::find(between) {
        Ok(peers) => {
            if let Some(words) = peers.left_out(field, grasp) {
                console.warn(&format!("other tools left out: {words}"));
            }
            Some(peers)
        }
        Err(e) => {
            console.warn(&format!("no other tool is run: {e:#}"));
            None
        }
    }
}

/// Says how many runs have no result, other than those that a step too long for its method ends.
///
/// # Errors
/// When no run has one.
fn warn_of_failures(trials: &[Trial], console: &Console) -> Result<()> {
    let failed: Vec<&Trial> = trials.iter().filter(|t| !t.error.is_finite() && t.part != Part::Grasp).collect();
    let Some(first) = failed.first() else { return Ok(()) };
    let why = first.failure.as_deref().unwrap_or("no error was found");
    let said = format!("{}, {}: {why}", first.method, first.case);
    if trials.iter().all(|t| !t.error.is_finite()) {
        bail!("none of the {} runs has a result ({said})", trials.len());
    }
    console.warn(&format!("{} of {} runs have no result ({said}); chart.html lists them", failed.len(), trials.len()));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cases_of_one_name_are_told_apart_and_one_given_twice_is_refused() {
        let names = |paths: &[&str]| case_names(&paths.iter().map(PathBuf::from).collect::<Vec<_>>());
        assert_eq!(names(&["/none/a/case", "/none/b/case"]).unwrap_or_default(), ["a/case", "b/case"]);
        assert_eq!(names(&["/none/a", "/none/b"]).unwrap_or_default(), ["a", "b"]);
        assert!(names(&["/none/a", "/none/b", "/none/a"]).is_err());
        let here = names(&["."]).unwrap_or_default();
        assert!(here.len() == 1 && here[0] != "." && !here[0].is_empty(), "{here:?}");
    }
}
