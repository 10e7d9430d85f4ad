//! `palpate demo`: from nothing to a field, its score against truth, and a picture.

use super::console::Console;
use super::field::{Tuning, explain};
use super::inputs::warn_all;
use super::outputs::{Measured, write_field};
use super::phantom;
use anyhow::Result;
use clap::Args;
use palpate::io::OutputFolder;
use palpate::report::text;
use palpate::synth::{self, PhantomKind, PhantomParams};
use palpate::{evaluate, pipeline};
use std::path::PathBuf;

#[derive(Debug, Args)]
pub struct Options {
    /// Folder for the results; those of an earlier demo are replaced
    #[arg(short, long, value_name = "DIR", default_value = "palpate-demo")]
    output: PathBuf,
    /// Write into a folder that is not empty
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    tuning: Tuning,
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { output, force, tuning } = options;
    let params = tuning.params()?;
    let earlier = ["phantom.json", "summary.json"].iter().all(|f| output.join(f).is_file());
    let mut folder = OutputFolder::create(output, *force || earlier)?;

    let progress = console.progress();
    progress.set("phantom", 0.0);
    let pair = synth::phantom(&PhantomParams { seed: params.seed, ..PhantomParams::new(PhantomKind::Calf) })?;
    let mask = Some(&pair.mask);
    let mut result = pipeline::field::run(&pair.initial, &pair.deformed, mask, &params, &|s, f| progress.set(s, f))?;
    let metrics = evaluate::metrics(&result.displacement, &pair.truth, mask, &pair.landmarks)?;

    progress.set("write", 1.0);
    phantom::write(&mut folder, &pair)?;
    let measured = Measured {
        command: "demo",
        names: ["initial.nii.gz", "deformed.nii.gz", "mask.nii.gz"],
        initial: &pair.initial,
        deformed: pair.deformed,
        mask,
        params: &params,
        truth: Some((&pair.truth, &metrics)),
    };
    let summary = write_field(&mut folder, measured, &mut result)?;
    folder.commit()?;
    drop(progress);
    explain(console, &result.summary);
    warn_all(console, &result.summary.warnings);
    console.say(&format!(
        "A synthetic calf, measured and scored against its exact truth.\n\n{summary}\n{}\nLook at {}",
        text::metrics(&metrics),
        output.join("report.html").display()
    ))
}
