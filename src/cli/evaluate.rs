//! `palpate evaluate`: a field against exact truth, or against one that leads back.

use super::console::Console;
use super::convention::Convention;
use super::inputs::{name, read_landmarks, read_mask, warn_all};
use anyhow::{Context, Result};
use clap::Args;
use palpate::report::text;
use palpate::{evaluate, io};
use serde::Serialize;
use serde_json::{Map, Value};
use std::path::PathBuf;

#[derive(Debug, Args)]
pub struct Options {
    /// Displacement field (5-D NIfTI, LPS mm)
    field: PathBuf,
    /// The true displacement, on the same grid
    #[arg(long, value_name = "T", required_unless_present = "backward")]
    truth: Option<PathBuf>,
    /// The field of a run from the deformed to the initial volume: how far points come back from
    /// where they started
    #[arg(long, value_name = "B")]
    backward: Option<PathBuf>,
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
    let Options { field, truth, backward, mask, landmarks, json, convention } = options;
    let measured = convention.read(field)?;
    let exact = truth.as_ref().map(io::read_field).transpose()?;
    let (grid, of) = match (&exact, truth) {
        (Some(exact), Some(truth)) => (exact.grid(), truth),
        _ => (measured.grid(), field),
    };
    let mask = mask.as_ref().map(|m| read_mask(m, grid, of)).transpose()?;
    let mut warnings = Vec::new();
    let landmarks = read_landmarks(landmarks, grid, &mut warnings)?;
    warn_all(console, &warnings);
    let (mut told, mut values) = (String::new(), Map::new());
    if let Some((exact, truth)) = exact.as_ref().zip(truth.as_ref()) {
        let metrics = evaluate::metrics(&measured, exact, mask.as_ref(), &landmarks)
            .with_context(|| format!("{} against {}", name(field), name(truth)))?;
        told += &text::metrics(&metrics);
        values.extend(json_of(&metrics)?);
    }
    if let Some(path) = backward {
        let back = convention.read(path)?;
        let found = evaluate::inverse_consistency(&measured, &back, mask.as_ref())
            .with_context(|| format!("{} and back by {}", name(field), name(path)))?;
        told += &text::inverse_consistency(&found);
        // Voxels are those compared with the truth, where there is one.
        for (key, value) in json_of(&found)? {
            values.entry(key).or_insert(value);
        }
    }
    console.say(&if *json { serde_json::to_string_pretty(&values)? } else { told })
}

/// The keys and values of a struct.
fn json_of(value: &impl Serialize) -> Result<Map<String, Value>> {
    match serde_json::to_value(value)? {
        Value::Object(map) => Ok(map),
        other => Ok([("value".to_string(), other)].into_iter().collect()),
    }
}
