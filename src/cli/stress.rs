//! `palpate stress`: where each part breaks, and whether it says so.

use super::console::Console;
use super::outputs::Target;
use anyhow::Result;
use clap::Args;
use palpate::error::UnknownName;
use palpate::io;
use palpate::pipeline::field::FieldResult;
use palpate::pipeline::stress::{self, Effort};
use palpate::report::stress as report;
use palpate::report::verdict::{Trust, judge};
use palpate::synth::Trouble;
use palpate::types::{Part, Volume, names};
use std::time::Instant;

#[derive(Debug, Args)]
pub struct Options {
    #[command(flatten)]
    target: Target,
    /// A small version: one body, one seed, fewer severities
    #[arg(long)]
    quick: bool,
    /// field, stiffness or grasp; may be given several times [default: all]
    #[arg(long, value_name = "PART", value_parser = part)]
    part: Vec<Part>,
    /// For the field: one axis alone, as noise or slice-thickness; may be given several times [default: all]
    #[arg(long, value_name = "AXIS", value_parser = axis)]
    axis: Vec<Trouble>,
}

/// A part by its name.
pub fn part(name: &str) -> Result<Part, UnknownName> {
    names::choose("part", name, &Part::ALL)
}

fn axis(name: &str) -> Result<Trouble, UnknownName> {
    let spaced = name.replace('-', " ");
    names::choose("axis", &spaced, &Trouble::ALL.map(|t| (t.1, t.0)))
}

/// What `palpate field` would say against its result: its warnings, and a verdict of low trust.
fn said(initial: &Volume, result: &FieldResult) -> Vec<String> {
    let verdict = judge(initial.grid(), None, &|at| result.uncertainty.at(at), &result.summary);
    let low = (verdict.trust == Trust::Low).then(|| format!("trust is low: {}", verdict.reasons.join("; ")));
    result.summary.warnings.iter().cloned().chain(low).collect()
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { target, quick, part, axis } = options;
    let wanted = |p: Part| part.is_empty() || part.contains(&p);
    let mut folder = target.create()?;
    let started = Instant::now();
    let progress = console.progress();
    let effort = Effort::new(*quick);
    let mut curves = Vec::new();
    if wanted(Part::Field) {
        let all = Trouble::ALL.map(|t| t.0);
        let troubles = if axis.is_empty() { &all[..] } else { &axis[..] };
        curves.extend(stress::field_curves(&effort, troubles, &said, &|f| progress.set("field", f)));
    }
    if wanted(Part::Stiffness) {
        curves.extend(stress::stiffness_curves(&effort, *quick, &|f| progress.set("stiffness", f))?);
    }
    if wanted(Part::Grasp) {
        curves.extend(stress::grasp_curves(&effort, &|f| progress.set("grasp", f)));
    }
    progress.set("write", 1.0);
    folder.write("stress.csv", |p| io::write_stress(p, &curves))?;
    folder.write("stress.svg", |p| io::write_text(p, &report::svg(&curves)))?;
    let seconds = started.elapsed().as_secs_f64();
    folder.write("summary.json", |p| io::write_json(p, &report::summary(&curves, seconds)))?;
    folder.write("stress.html", |p| io::write_text(p, &report::page(&curves)))?;
    folder.commit()?;
    drop(progress);
    let look = target.output.join("stress.html");
    console.say(&format!("{}  results      {}", report::text(&curves), look.display()))
}
