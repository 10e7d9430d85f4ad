//! `palpate grasp-analysis`: posture force, energy surfaces, stability, degrees of freedom, push,
//! pinch map.

use super::console::Console;
use super::grasp::{Choices, check_inputs};
use super::inputs::{name, warn_all};
use super::outputs::Target;
use super::record::{self, Recording};
use anyhow::{Context, Result};
use clap::Args;
use palpate::io;
use palpate::pipeline;
use palpate::report::grasp_analysis::{self, AnalysisReport};
use palpate::report::record::{in_summary, on_page};
use palpate::types::FingertipModel;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub struct Options {
    /// Scene file (.toml); its motions are the postures that are looked at
    scene: PathBuf,
    #[command(flatten)]
    target: Target,
}

const FILES: [&str; 7] =
    ["posture_force.csv", "energy.csv", "stability.csv", "pinch_map.csv", "push.csv", "summary.json", "report.html"];

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { scene: path, target } = options;
    let file = Choices::default().read(path)?;
    check_inputs(path, &file, target, &FILES)?;
    let mut folder = target.create()?;
    let inputs = record::inputs(&[("scene", Some(path)), ("fingertip", file.fingertip_file.as_ref())]);
    let record = Recording::start(console, inputs);
    let progress = console.progress();
    let name = name(path);
    let (analysis, seconds) =
        pipeline::grasp::analyse(&file.scene, &|s, f| progress.set(s, f)).with_context(|| name.clone())?;
    progress.set("write", 1.0);
    folder.write("posture_force.csv", |p| io::write_posture_force(p, &analysis))?;
    folder.write("energy.csv", |p| io::write_energy(p, &analysis))?;
    folder.write("stability.csv", |p| io::write_stability(p, &analysis))?;
    folder.write("pinch_map.csv", |p| io::write_pinch_map(p, &analysis))?;
    folder.write("push.csv", |p| io::write_trajectory(p, &analysis.push.samples))?;
    let pushed = pipeline::grasp::pushed(&file.scene);
    let report =
        AnalysisReport { name: &name, scene: &file.scene, pushed: &pushed, analysis: &analysis, seconds: &seconds };
    let record = record.finish();
    let told = in_summary(grasp_analysis::summary(&report), &record);
    folder.write("summary.json", |p| io::write_json(p, &told))?;
    let page = grasp_analysis::page(&report)?;
    folder.write("report.html", |p| io::write_text(p, &on_page(page, &record)))?;
    folder.commit()?;
    drop(progress);
    let mut warnings: Vec<String> =
        analysis.lost.iter().map(|(step, why)| format!("{name}: motion {step} is not reached: {why}")).collect();
    if file.scene.fingertip.model != FingertipModel::Parallel {
        warnings.push(format!("{name}: the analysis is of parallel and radial tips, whatever fingertip.model says"));
    }
    if !file.sweep.is_empty() {
        warnings.push(format!("{name}: the analysis is of the scene itself; [[sweep]] plays no part"));
    }
    seconds.iter().for_each(|(stage, s)| console.detail(&format!("{stage}: {s:.3} s")));
    warn_all(console, &warnings);
    console.say(&format!("{}{}", grasp_analysis::text(&report), target.look()));
    Ok(())
}
