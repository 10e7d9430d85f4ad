//! `palpate evaluate`: a field against exact truth, landmarks, label maps, or a field that leads
//! back.

use super::console::Console;
use super::convention::Convention;
use super::inputs::{Part, name, read_landmarks, read_mask, some_labels, standing_for, warn_all};
use anyhow::{Context, Result};
use clap::Args;
use palpate::report::text;
use palpate::{evaluate, io};
use serde::Serialize;
use serde_json::{Map, Value};
use std::path::PathBuf;

#[derive(Debug, Args)]
pub struct Options {
    /// Displacement field (5-D NIfTI, LPS mm), or a folder of palpate field
    field: PathBuf,
    /// The true displacement, on the same grid
    #[arg(
        long,
        value_name = "T",
        required_unless_present_any = ["backward", "landmarks", "labels"],
        value_parser = standing_for(Part::Truth)
    )]
    truth: Option<PathBuf>,
    /// The field of a run from the deformed to the initial volume: how far points come back from
    /// where they started
    #[arg(long, value_name = "B", visible_alias = "inverse")]
    backward: Option<PathBuf>,
    /// Where to compare with --truth and --backward, 0 outside [default: everywhere]
    #[arg(long, value_name = "M", value_parser = standing_for(Part::Mask))]
    mask: Option<PathBuf>,
    /// Known places: CSV with columns fx,fy,fz (initial) and mx,my,mz (deformed), world mm, RAS; or
    /// two files of points (.csv, .fcsv, .mrk.json), initial and deformed
    #[arg(long, value_name = "L", num_args = 1..=2, value_parser = standing_for(Part::Landmarks))]
    landmarks: Vec<PathBuf>,
    /// Label maps of the initial and the deformed volume, each on any grid: overlap and distances
    /// between surfaces, by the field and without
    #[arg(long, value_names = ["INITIAL", "DEFORMED"], num_args = 2, value_parser = standing_for(Part::Labels))]
    labels: Vec<PathBuf>,
    /// JSON instead of text
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    convention: Convention,
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { field, truth, backward, mask, landmarks, labels, json, convention } = options;
    let measured = convention.read(field)?;
    let exact = truth.as_ref().map(io::read_field).transpose()?;
    let (grid, of) = match (&exact, truth) {
        (Some(exact), Some(truth)) => (exact.grid(), truth),
        _ => (measured.grid(), field),
    };
    let mut warnings = Vec::new();
    if mask.is_some() && truth.is_none() && backward.is_none() {
        warnings.push("--mask changes nothing without --truth or --backward".into());
    }
    let mask = mask.as_ref().map(|m| read_mask(m, grid, of, &mut warnings)).transpose()?;
    let marks = read_landmarks(landmarks, grid, &mut warnings)?;
    let (mut told, mut values) = (String::new(), Map::new());
    if let Some((exact, truth)) = exact.as_ref().zip(truth.as_ref()) {
        let metrics = evaluate::metrics(&measured, exact, mask.as_ref(), &marks)
            .with_context(|| format!("{} against {}", name(field), name(truth)))?;
        told += &text::metrics(&metrics);
        values.extend(json_of(&metrics)?);
    }
    if let [file, ..] = &landmarks[..] {
        let found =
            evaluate::target_error(&measured, &marks).with_context(|| format!("{} at {}", name(field), name(file)))?;
        told += &text::target_error(&found);
        values.insert("landmarks_mm".into(), found.after.mean_mm.into());
        values.insert("landmarks".into(), serde_json::to_value(&found)?);
    }
    if let [first, second] = &labels[..] {
        let maps = [some_labels(first)?, some_labels(second)?];
        let found = evaluate::labels::label_scores(&measured, &maps[0], &maps[1])
            .with_context(|| format!("{} and {} by {}", name(first), name(second), name(field)))?;
        if found.outside > 0.0 {
            warnings.push(format!(
                "{}: {:.1} % of its labelled voxels lie outside the field, and the field's edge stands for it",
                name(first),
                100.0 * found.outside
            ));
        }
        told += &text::label_scores(&found);
        values.insert("labels".into(), serde_json::to_value(&found)?);
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
    warn_all(console, &warnings);
    console.say(&if *json { serde_json::to_string_pretty(&values)? } else { told });
    Ok(())
}

/// The keys and values of a struct.
fn json_of(value: &impl Serialize) -> Result<Map<String, Value>> {
    match serde_json::to_value(value)? {
        Value::Object(map) => Ok(map),
        other => Ok([("value".to_string(), other)].into_iter().collect()),
    }
}
