//! `palpate evaluate`: a field against exact truth.

use super::console::Console;
use super::convention::Convention;
use super::inputs::{name, read_landmarks, read_mask, warn_all};
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
    /// Known places: CSV with columns fx,fy,fz (initial) and mx,my,mz (deformed), world mm, RAS; or
    /// two files of points (.csv, .fcsv, .mrk.json), initial and deformed
    #[arg(long, value_name = "L", num_args = 1..=2)]
    landmarks: Vec<PathBuf>,
    /// JSON instead of text
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    convention: Convention,
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { field, truth, mask, landmarks, json, convention } = options;
    let measured = convention.read(field)?;
    let exact = io::read_field(truth)?;
    let mask = mask.as_ref().map(|m| read_mask(m, exact.grid(), truth)).transpose()?;
    let mut warnings = Vec::new();
    let landmarks = read_landmarks(landmarks, exact.grid(), &mut warnings)?;
    warn_all(console, &warnings);
    let metrics = evaluate::metrics(&measured, &exact, mask.as_ref(), &landmarks)
        .with_context(|| format!("{} against {}", name(field), name(truth)))?;
    console.say(&if *json { serde_json::to_string_pretty(&metrics)? } else { text::metrics(&metrics) })
}
