//! `palpate stress`: where each part breaks, and whether it says so.

use super::Usage;
use super::console::Console;
use super::limits::stress_fits;
use super::outputs::Target;
use super::record::Recording;
use anyhow::{Result, bail};
use clap::Args;
use palpate::error::Shown;
use palpate::error::UnknownName;
use palpate::evaluate::stated::stated;
use palpate::io;
use palpate::pipeline::robustness::{self, Effort, GraspAxis, StiffnessAxis};
use palpate::report::record::{in_summary, on_page};
use palpate::report::robustness as report;
use palpate::synth::Trouble;
use palpate::types::{Part, names};
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
    #[arg(long, value_name = "AXIS", help = axis_help())]
    axis: Vec<String>,
}

/// A part by its name.
pub fn part(name: &str) -> Result<Part, UnknownName> {
    names::choose("part", name, &Part::ALL)
}

/// Axes of the field by name.
fn field_axes() -> [(&'static str, Trouble); 22] {
    Trouble::ALL.map(|t| (t.1, t.0))
}

/// Names of a part's axes.
fn axis_names(part: Part) -> Vec<&'static str> {
    match part {
        Part::Field => field_axes().iter().map(|a| a.0).collect(),
        Part::Stiffness => StiffnessAxis::ALL.iter().map(|a| a.0).collect(),
        Part::Grasp => GraspAxis::ALL.iter().map(|a| a.0).collect(),
    }
}

/// Whether `typed` is the axis called `name`, which may have spaces.
fn is_axis(typed: &str, name: &str) -> bool {
    typed.replace('-', " ").eq_ignore_ascii_case(name)
}

fn axis_help() -> String {
    let typed = |part: Part| axis_names(part).iter().map(|n| n.replace(' ', "-")).collect::<Vec<_>>().join(", ");
    let all = Part::ALL.map(|(name, part)| format!("{name}: {}", typed(part))).join("; ");
    format!("One axis alone; may be given several times [default: all]. {all}")
}

/// Those of `all` that `asked` names, all of them when it is empty.
fn picked<T: Copy>(asked: &[String], all: &[(&'static str, T)]) -> Vec<T> {
    let named = |name: &str| asked.is_empty() || asked.iter().any(|typed| is_axis(typed, name));
    all.iter().filter(|a| named(a.0)).map(|a| a.1).collect()
}

/// Every axis that is asked for must be one of a part that runs.
fn check_axes(asked: &[String], wanted: impl Fn(Part) -> bool) -> Result<()> {
    let parts = || Part::ALL.iter().map(|p| p.1);
    for typed in asked {
        let holders: Vec<Part> = parts().filter(|p| axis_names(*p).iter().any(|name| is_axis(typed, name))).collect();
        if holders.is_empty() {
            let mut known: Vec<(&str, ())> = parts().flat_map(axis_names).map(|name| (name, ())).collect();
            known.sort_unstable();
            known.dedup();
            names::choose("axis", &typed.replace('-', " "), &known).map_err(|e| Usage(e.to_string()))?;
        }
        if !holders.iter().any(|p| wanted(*p)) {
            let of: Vec<&str> = holders.iter().map(|p| p.name()).collect();
            bail!(Usage(format!("--axis {typed} is one of {}, which --part leaves out", of.join(" and "))));
        }
    }
    Ok(())
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { target, quick, part, axis } = options;
    let wanted = |p: Part| part.is_empty() || part.contains(&p);
    check_axes(axis, wanted)?;
    let effort = Effort::new(*quick);
    stress_fits(&effort, wanted(Part::Field), wanted(Part::Stiffness))?;
    let mut folder = target.create()?;
    let record = Recording::start(console, Vec::new());
    let started = Instant::now();
    let progress = console.progress();
    let mut curves = Vec::new();
    let troubles = picked(axis, &field_axes());
    if wanted(Part::Field) && !troubles.is_empty() {
        curves.extend(robustness::field_curves(&effort, &troubles, &|f| progress.set("field", f)));
    }
    let axes = picked(axis, &StiffnessAxis::ALL);
    if wanted(Part::Stiffness) && !axes.is_empty() {
        curves.extend(robustness::stiffness_curves(&effort, *quick, &axes, &|f| progress.set("stiffness", f))?);
    }
    let axes = picked(axis, &GraspAxis::ALL);
    if wanted(Part::Grasp) && !axes.is_empty() {
        curves.extend(robustness::grasp_curves(&effort, &axes, &|f| progress.set("grasp", f)));
    }
    let of_field = || curves.iter().filter(|c| c.part == Part::Field).flat_map(|c| &c.runs);
    let field = of_field().next().map(|_| stated(of_field()));
    progress.set("write", 1.0);
    folder.write("stress.csv", |p| io::write_stress(p, &curves))?;
    folder.write("stress.svg", |p| io::write_text(p, &report::svg(&curves)))?;
    let seconds = started.elapsed().as_secs_f64();
    let record = record.finish();
    let told = in_summary(report::summary(&curves, field.as_ref(), seconds), &record);
    folder.write("summary.json", |p| io::write_json(p, &told))?;
    let page = on_page(report::page(&curves, field.as_ref()), &record);
    folder.write("stress.html", |p| io::write_text(p, &page))?;
    folder.commit()?;
    drop(progress);
    let look = target.output.join("stress.html");
    console.say(&format!("{}  results      {}", report::text(&curves, field.as_ref()), look.shown()));
    Ok(())
}
