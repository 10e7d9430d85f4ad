//! `palpate grasp-analysis`: posture force, energy surfaces, stability, degrees of freedom, push,
//! pinch map.

use super::console::Console;
use super::grasp::{Choices, check_inputs};
use super::inputs::{check_distinct, name, name as name_of, warn_all};
use super::outputs::Target;
use super::record::{self, Recording};
use anyhow::{Context, Result, bail};
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
    /// Table (.csv) of presses (d, tilt_deg, force) or of the grasp's course (time, theta1_deg,
    /// theta2_deg, x, y, theta_deg): fits modulus and damping of each tip model to it and weighs
    /// the models
    #[arg(long, value_name = "FILE")]
    measured: Option<PathBuf>,
    #[command(flatten)]
    target: Target,
}

const FILES: [&str; 8] = [
    "posture_force.csv",
    "energy.csv",
    "stability.csv",
    "pinch_map.csv",
    "push.csv",
    "measured.csv",
    "summary.json",
    "report.html",
];

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { scene: path, target, measured } = options;
    let file = Choices::default().read(path)?;
    check_inputs(path, &file, target, &FILES)?;
    let measurements = measured.as_ref().map(io::read_measured).transpose()?;
    if let Some(measured) = measured {
        check_distinct(&[measured], &target.files(&FILES))?;
    }
    let mut folder = target.create()?;
    let inputs = record::inputs(&[
        ("scene", Some(path)),
        ("fingertip", file.fingertip_file.as_ref()),
        ("measured", measured.as_ref()),
    ]);
    let record = Recording::start(console, inputs);
    let progress = console.progress();
    let name = name(path);
    let (analysis, seconds) =
        pipeline::grasp::analyse(&file.scene, &|s, f| progress.set(s, f)).with_context(|| name.clone())?;
    let fit = measurements.as_ref().map(|m| pipeline::grasp::against(&file.scene, m));
    let held = measurements.as_ref().zip(fit.as_ref());
    if let (Some(measured), Some(fit)) = (measured, &fit)
        && fit.models.is_empty()
    {
        let why = fit.failed.iter().map(|(model, why)| format!("{model}: {why}")).collect::<Vec<_>>().join("; ");
        bail!("{}: no model can be fitted: {why}", name_of(measured));
    }
    progress.set("write", 1.0);
    folder.write("posture_force.csv", |p| io::write_posture_force(p, &analysis))?;
    folder.write("energy.csv", |p| io::write_energy(p, &analysis))?;
    folder.write("stability.csv", |p| io::write_stability(p, &analysis))?;
    folder.write("pinch_map.csv", |p| io::write_pinch_map(p, &analysis))?;
    folder.write("push.csv", |p| io::write_trajectory(p, &analysis.push.samples))?;
    if let Some((measurements, fit)) = held {
        folder.write("measured.csv", |p| io::write_measured(p, measurements, fit))?;
    }
    let pushed = pipeline::grasp::pushed(&file.scene);
    let report = AnalysisReport {
        name: &name,
        scene: &file.scene,
        pushed: &pushed,
        analysis: &analysis,
        measured: held,
        seconds: &seconds,
    };
    let record = record.finish();
    let told = in_summary(grasp_analysis::summary(&report), &record);
    folder.write("summary.json", |p| io::write_json(p, &told))?;
    let page = grasp_analysis::page(&report)?;
    folder.write("report.html", |p| io::write_text(p, &on_page(page, &record)))?;
    folder.commit()?;
    drop(progress);
    let mut warnings: Vec<String> =
        analysis.lost.iter().map(|(step, why)| format!("{name}: motion {step} is not reached: {why}")).collect();
    if let Some(fit) = &fit {
        warnings.extend(fit.failed.iter().map(|(model, why)| format!("{name}: {model} is not fitted: {why}")));
        if fit.joints_off > pipeline::grasp::JOINT_TOLERANCE_RAD {
            warnings.push(format!(
                "{name}: measured joint angles are up to {:.1} degrees from those that the scene's motions give; the fit takes the scene's",
                fit.joints_off.to_degrees()
            ));
        }
    }
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
