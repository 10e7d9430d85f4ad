//! `palpate grasp`: a scene to a simulated grasp.

use super::Usage;
use super::console::Console;
use super::inputs::{check_distinct, name, warn_all};
use super::outputs::Target;
use super::record::{self, Recording};
use anyhow::{Context, Result, bail};
use clap::Args;
use palpate::io::{self, SceneFile, SceneOverrides};
use palpate::pipeline;
use palpate::report::record::{in_summary, on_page};
use palpate::report::{GraspReport, grasp};
use palpate::types::FingertipModel;
use palpate::types::scene::Formulation;
use std::path::{Path, PathBuf};
use std::time::Instant;

#[derive(Debug, Args)]
pub struct Options {
    /// Scene file (.toml); docs/reference/grasp.md shows one
    scene: PathBuf,
    #[command(flatten)]
    target: Target,
    #[command(flatten)]
    choices: Choices,
}

/// What replaces values of the scene file.
#[derive(Debug, Default, Args)]
pub struct Choices {
    /// parallel, parallel-normal, radial, rigid or tabulated [default: by the scene]
    #[arg(long)]
    model: Option<FingertipModel>,
    /// minimal or multipliers [default: by the scene]
    #[arg(long)]
    formulation: Option<Formulation>,
    /// Step of the integrator in s, up to 1 [default: by the scene]
    #[arg(long, value_name = "S")]
    step: Option<f64>,
}

impl Choices {
    /// The scene file, with these choices in it.
    pub fn read(&self, path: &Path) -> Result<SceneFile> {
        let Self { model, formulation, step } = *self;
        if step.is_some_and(|s| !(s > 0.0 && s <= 1.0)) {
            bail!(Usage(format!("step is {}, but must be above 0 and at most 1 s", step.unwrap_or_default())));
        }
        Ok(io::read_scene(path, &SceneOverrides { model, formulation, step })?)
    }
}

/// No result may replace the scene or its fingertip.
pub fn check_inputs(path: &Path, file: &SceneFile, target: &Target, names: &[&str]) -> Result<()> {
    let inputs: Vec<&Path> = std::iter::once(path).chain(file.fingertip_file.as_deref()).collect();
    check_distinct(&inputs, &target.files(names))
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { scene: path, target, choices } = options;
    let file = choices.read(path)?;
    let names = ["trajectory.csv", "bands.csv", "motions.csv", "sweep.csv", "summary.json", "report.html"];
    check_inputs(path, &file, target, &names)?;
    let mut folder = target.create()?;
    let inputs = record::inputs(&[("scene", Some(path)), ("fingertip", file.fingertip_file.as_ref())]);
    let record = Recording::start(console, inputs);

    let progress = console.progress();
    let name = name(path);
    let part = if file.sweep.is_empty() { 1.0 } else { 0.2 };
    let outcome = pipeline::grasp::run(&file.scene, &|s, f| progress.set(s, part * f)).with_context(|| name.clone())?;
    let started = Instant::now();
    let results = pipeline::grasp::ensemble(&file.sweep, &|s, f| progress.set(s, part + (1.0 - part) * f));
    let mut seconds = outcome.seconds;
    if !file.sweep.is_empty() {
        seconds.push(("sweep".into(), started.elapsed().as_secs_f64()));
    }

    progress.set("write", 1.0);
    let started = Instant::now();
    let run = &outcome.run;
    let notes = pipeline::grasp::notes(&file.scene, run);
    let events = run.events.iter().take(8).map(grasp::event_line);
    let warnings: Vec<String> = events.chain(notes.iter().cloned()).map(|w| format!("{name}: {w}")).collect();
    folder.write("trajectory.csv", |p| io::write_trajectory(p, &run.samples))?;
    if let Some(bands) = &outcome.bands {
        folder.write("bands.csv", |p| io::write_bands(p, bands))?;
    }
    folder.write("motions.csv", |p| io::write_motions(p, &run.motions))?;
    if !file.sweep.is_empty() {
        folder.write("sweep.csv", |p| io::write_sweep(p, &file.sweep, &results))?;
    }
    seconds.push(("write".into(), started.elapsed().as_secs_f64()));
    let without = outcome.without_tangential.map(|r| r.map_err(|e| e.to_string()));
    let sweep: Vec<_> = file.sweep.into_iter().zip(results.into_iter().map(|r| r.map_err(|e| e.to_string()))).collect();
    let report = GraspReport {
        name: &name,
        scene: &file.scene,
        run,
        without_tangential: without.as_ref(),
        stable_steps: &outcome.stable_steps,
        bands: outcome.bands.as_ref(),
        sweep: &sweep,
        seconds: &seconds,
        warnings: &notes,
    };
    let record = record.finish();
    let told = in_summary(grasp::summary(&report), &record);
    folder.write("summary.json", |p| io::write_json(p, &told))?;
    folder.write("report.html", |p| io::write_text(p, &on_page(grasp::page(&report), &record)))?;
    folder.commit()?;
    drop(progress);
    seconds.iter().for_each(|(stage, s)| console.detail(&format!("{stage}: {s:.3} s")));
    warn_all(console, &warnings);
    console.say(&format!("{}{}", grasp::text(&report), target.look()));
    Ok(())
}
