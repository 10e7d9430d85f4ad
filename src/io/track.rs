//! Tables of a tracked sequence.

use super::csv::{decimal, read_table, write_table};
use crate::error::IoError;
use crate::types::{Match, SparseField, StrainRow, Trajectory, WorldPoint};
use std::collections::BTreeMap;
use std::path::Path;

/// Writes a row for each point and frame in which its place is known: point, frame, time_s (empty
/// when not known), x, y, z and sigma (world mm, RAS), state (measured, carried or outside). In the
/// `reference` frame a point is where it was found, with sigma 0.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub fn write_trajectories(
    path: impl AsRef<Path>,
    trajectories: &[Trajectory],
    reference: usize,
    step_s: Option<f64>,
) -> Result<(), IoError> {
    let rows = trajectories.iter().enumerate().flat_map(|(point, t)| {
        t.known(reference).map(move |(frame, place)| {
            let [x, y, z] = place.position.0.map(decimal);
            let sigma = decimal(f64::from(place.sigma));
            vec![point.to_string(), frame.to_string(), time(frame, step_s), x, y, z, sigma, place.state.name().into()]
        })
    });
    write_table(path.as_ref(), &["point", "frame", "time_s", "x", "y", "z", "sigma", "state"], rows)
}

/// Reads the points that were measured in each frame, as matches from the reference frame's places.
///
/// # Errors
/// [`IoError`] when the file cannot be read, a column is missing, a value is not a finite number,
/// or a point or frame no whole one.
pub fn read_trajectories(path: impl AsRef<Path>, reference: usize) -> Result<BTreeMap<usize, SparseField>, IoError> {
    let path = path.as_ref();
    let table = read_table(path, ["point", "frame", "x", "y", "z", "sigma"])?;
    let state = table.other_columns.iter().position(|c| c.eq_ignore_ascii_case("state"));
    let whole = |v: f64| v >= 0.0 && v.fract() == 0.0;
    if let Some(row) = table.numbers.iter().position(|n| !whole(n[0]) || !whole(n[1])) {
        let [point, frame, ..] = table.numbers[row];
        let what = format!("point is {point} and frame {frame} in row {}: both are counted from 0", row + 1);
        return Err(super::format(path, what, "give whole numbers, as palpate track writes them"));
    }
    let mut start = BTreeMap::new();
    for &[point, frame, x, y, z, _] in &table.numbers {
        if frame as usize == reference {
            start.insert(point as usize, [x, y, z]);
        }
    }
    let mut out: BTreeMap<usize, SparseField> = BTreeMap::new();
    for (&[point, frame, x, y, z, sigma], rest) in table.numbers.iter().zip(&table.others) {
        let measured = state.is_none_or(|s| rest[s] == "measured");
        let Some(&from) = start.get(&(point as usize)).filter(|_| measured && frame as usize != reference) else {
            continue;
        };
        let to = [x, y, z];
        out.entry(frame as usize).or_default().matches.push(Match {
            initial: WorldPoint(from),
            displacement: std::array::from_fn(|a| to[a] - from[a]),
            ncc: 1.0,
            covariance: [sigma * sigma, sigma * sigma, sigma * sigma, 0.0, 0.0, 0.0],
            kept: true,
            raw: None,
        });
    }
    Ok(out)
}

/// Writes a row for each frame and label: mean principal strains e1 (largest) to e3, the 98th
/// percentile of e1 and the 2nd of e3 as peaks, mean and 98th percentile of the largest shear, mean
/// change of volume (1).
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub(crate) fn write_strain(path: impl AsRef<Path>, rows: &[StrainRow], step_s: Option<f64>) -> Result<(), IoError> {
    const COLUMNS: [&str; 12] = [
        "frame",
        "time_s",
        "label",
        "voxels",
        "mean_e1",
        "mean_e2",
        "mean_e3",
        "peak_e1",
        "peak_e3",
        "mean_shear",
        "peak_shear",
        "volume_change",
    ];
    let rows = rows.iter().map(|r| {
        let numbers = [&r.mean[..], &r.peak, &r.shear, &[r.volume_change]].concat();
        let mut row = vec![r.frame.to_string(), time(r.frame, step_s), r.label.to_string(), r.voxels.to_string()];
        row.extend(numbers.into_iter().map(decimal));
        row
    });
    write_table(path.as_ref(), &COLUMNS, rows)
}

/// The time of a frame (s), empty when not known.
fn time(frame: usize, step_s: Option<f64>) -> String {
    step_s.map(|step| decimal(step * frame as f64)).unwrap_or_default()
}
