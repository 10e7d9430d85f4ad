//! `palpate skin`: layers of skin pressed, held and let go.

use super::console::Console;
use super::inputs::{check_distinct, name, warn_all};
use super::outputs::Target;
use super::record::{self, Recording};
use anyhow::{Context, Result, bail};
use clap::Args;
use palpate::error::Shown;
use palpate::io;
use palpate::pipeline;
use palpate::report::record::{in_summary, on_page};
use palpate::report::skin::{SkinReport, page, summary, text};
use palpate::types::skin::SkinSample;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub struct Options {
    /// Scene file (.toml); docs/reference/skin.md shows one
    scene: PathBuf,
    #[command(flatten)]
    target: Target,
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { scene: path, target } = options;
    let scene = io::read_skin_scene(path)?;
    pipeline::skin::check(&scene).with_context(|| path.shown())?;
    check_distinct(&[path], &target.files(&["response.csv", "summary.json", "report.html"]))?;
    let mut folder = target.create()?;
    let record = Recording::start(console, record::inputs(&[("scene", Some(path))]));
    let progress = console.progress();
    progress.set("skin", 0.0);
    let outcome = pipeline::skin::run(&scene);
    let finite = |s: &SkinSample| s.strain.iter().chain([&s.stress, &s.displacement]).all(|v| v.is_finite());
    if !outcome.column.iter().all(finite) {
        bail!("{}: the response is no finite number: its values lie too far apart; correct them", path.shown());
    }
    let name = name(path);
    let warnings: Vec<String> =
        pipeline::skin::notes(&scene, &outcome).into_iter().map(|w| format!("{name}: {w}")).collect();
    let report = SkinReport {
        name: &name,
        scene: &scene,
        column: &outcome.column,
        single: outcome.single.as_ref().map(|s| s.1.as_slice()),
        block: outcome.block.as_ref(),
        single_block: outcome.single_block.as_ref(),
        residual: &outcome.residual,
        seconds: &outcome.seconds,
        warnings: &warnings,
    };
    folder.write("response.csv", |p| io::write_response(p, &scene, &outcome.column))?;
    let record = record.finish();
    folder.write("summary.json", |p| io::write_json(p, &in_summary(summary(&report), &record)))?;
    folder.write("report.html", |p| io::write_text(p, &on_page(page(&report), &record)))?;
    folder.commit()?;
    drop(progress);
    warn_all(console, &warnings);
    console.say(&format!("{}{}", text(&report), target.look()));
    Ok(())
}
