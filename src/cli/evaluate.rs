//! `palpate evaluate`: a field against exact truth.

use super::console::Console;
use super::inputs::{name, read_mask};
use anyhow::{Context, Result};
use clap::Args;
use palpate::report::text;
use palpate::{evaluate, io};
use std::path::PathBuf;

#[derive(Debug, Args)]
pub struct Options {
    /// Displacement field (5-D NIfTI, LPS mm)
    field: PathBuf,
    /// The true displacement, on the same grid
    #[arg(long, value_name = "T")]
    truth: PathBuf,
    /// Where to compare, on the same grid, 0 outside [default: everywhere]
    #[arg(long, value_name = "M")]
    mask: Option<PathBuf>,
    /// Known places: CSV with columns fx,fy,fz (initial) and mx,my,mz (deformed), world mm, RAS
    #[arg(long, value_name = "L")]
    landmarks: Option<PathBuf>,
    /// JSON instead of text
    #[arg(long)]
    json: bool,
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { field, truth, mask, landmarks, json } = options;
    let measured = io::read_field(field)?;
    let exact = io::read_field(truth)?;
    let mask = mask.as_ref().map(|m| read_mask(m, exact.grid(), truth)).transpose()?;
    let landmarks = landmarks.as_ref().map(io::read_landmarks).transpose()?.unwrap_or_default();
    let metrics = evaluate::metrics(&measured, &exact, mask.as_ref(), &landmarks)
        .with_context(|| format!("{} against {}", name(field), name(truth)))?;
    console.say(&if *json { serde_json::to_string_pretty(&metrics)? } else { text::metrics(&metrics) })
}
