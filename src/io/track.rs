//! Tables of a tracked sequence.

use super::csv::{decimal, write_table};
use crate::error::IoError;
use crate::types::{StrainRow, Trajectory};
use std::path::Path;

/// Writes a row for each point and frame in which its place is known: point, frame, time_s (empty when not known), x, y, z
/// and sigma (world mm, RAS), state (measured, carried or outside).
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub fn write_trajectories(
    path: impl AsRef<Path>,
    trajectories: &[Trajectory],
    step_s: Option<f64>,
) -> Result<(), IoError> {
    let rows = trajectories.iter().enumerate().flat_map(|(point, t)| {
        t.places.iter().enumerate().filter_map(move |(frame, place)| {
            let place = place.as_ref()?;
            let [x, y, z] = place.position.0.map(decimal);
            let sigma = decimal(f64::from(place.sigma));
            Some(vec![
                point.to_string(),
                frame.to_string(),
                time(frame, step_s),
                x,
                y,
                z,
                sigma,
                place.state.name().into(),
            ])
        })
    });
    write_table(path.as_ref(), &["point", "frame", "time_s", "x", "y", "z", "sigma", "state"], rows)
}

/// Writes a row for each frame and label: mean principal strains e1 (largest) to e3, the 98th percentile of e1 and the
/// 2nd of e3 as peaks, mean and 98th percentile of the largest shear, mean change of volume (1).
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub fn write_strain(path: impl AsRef<Path>, rows: &[StrainRow], step_s: Option<f64>) -> Result<(), IoError> {
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
