//! Tables of the grasp simulator: comma-separated, one header line, SI units.

use super::csv::write_table;
use crate::error::{GraspError, IoError};
use crate::types::grasp::{Bands, GraspAnalysis, GraspRun, MotionRow, Sample};
use crate::types::scene::SweepCase;
use std::path::Path;

/// A number as short as it can be read back without loss; `NaN` where there is none.
pub(super) fn number(v: f64) -> String {
    match v {
        0.0 => "0".into(),
        v if v.abs() < 1e-4 || v.abs() >= 1e6 => format!("{v:e}"),
        v => v.to_string(),
    }
}

/// A time to the nanosecond.
fn seconds(t: f64) -> String {
    let text = format!("{t:.9}");
    text.trim_end_matches('0').trim_end_matches('.').into()
}

fn strings(names: &[&str]) -> Vec<String> {
    names.iter().map(|n| (*n).to_string()).collect()
}

/// To nine decimals.
fn nano(v: f64) -> f64 {
    (v * 1e9).round() / 1e9
}

/// [`Sample::COLUMNS`] as trajectory.csv keeps them: the time to the nanosecond.
pub fn stored_sample(sample: &Sample) -> [f64; Sample::COLUMNS.len()] {
    let mut row = sample.row();
    row[0] = nano(row[0]);
    row
}

/// [`MotionRow::COLUMNS`] behind the step as motions.csv keeps them: desired angles as they were
/// written, without the rounding of degrees to radians and back.
pub fn stored_motion(motion: &MotionRow) -> [f64; MotionRow::COLUMNS.len() - 1] {
    let mut row = motion.row();
    row[..2].iter_mut().for_each(|v| *v = nano(*v));
    row
}

/// Writes [`Sample::COLUMNS`] (s, m, rad, N), a row a sample.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub(crate) fn write_trajectory(path: impl AsRef<Path>, samples: &[Sample]) -> Result<(), IoError> {
    let rows = samples.iter().map(|s| {
        let [time, rest @ ..] = stored_sample(s);
        std::iter::once(seconds(time)).chain(rest.map(number)).collect()
    });
    write_table(path.as_ref(), &Sample::COLUMNS, rows)
}

/// Writes the time (s) and the least and largest of each other column of [`Sample::COLUMNS`].
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub(crate) fn write_bands(path: impl AsRef<Path>, bands: &Bands) -> Result<(), IoError> {
    let names = Sample::COLUMNS[1..].iter().flat_map(|c| [format!("{c}_low"), format!("{c}_high")]);
    let header: Vec<String> = std::iter::once("time".to_string()).chain(names).collect();
    let header: Vec<&str> = header.iter().map(String::as_str).collect();
    let rows = bands.low.iter().zip(&bands.high).map(|(low, high)| {
        let ([time, low @ ..], [_, high @ ..]) = (stored_sample(low), stored_sample(high));
        let pairs = low.into_iter().zip(high).flat_map(|(a, b)| [number(a), number(b)]);
        std::iter::once(seconds(time)).chain(pairs).collect()
    });
    write_table(path.as_ref(), &header, rows)
}

fn motion_row(m: &MotionRow) -> Vec<String> {
    std::iter::once(m.step.to_string()).chain(stored_motion(m).map(number)).collect()
}

/// Writes [`MotionRow::COLUMNS`] (m, degrees, N), a row a motion.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub(crate) fn write_motions(path: impl AsRef<Path>, motions: &[MotionRow]) -> Result<(), IoError> {
    write_table(path.as_ref(), &MotionRow::COLUMNS, motions.iter().map(motion_row))
}

/// Writes an ensemble: case, its keys, how it ended (`completed`, or the kind of
/// [`GraspRun::flaw`], or the error), when (s), then [`MotionRow::COLUMNS`], a row a motion, and
/// the largest friction that the run needed; a case without motions has one row with empty places.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub(crate) fn write_sweep(
    path: impl AsRef<Path>,
    cases: &[SweepCase],
    results: &[Result<GraspRun, GraspError>],
) -> Result<(), IoError> {
    let keys: Vec<String> = cases.first().map_or(Vec::new(), |c| c.values.iter().map(|v| v.0.clone()).collect());
    let mut header = vec!["case".to_string()];
    header.extend(keys);
    header.extend(strings(&["outcome", "time"]));
    header.extend(strings(&MotionRow::COLUMNS));
    header.push("largest_required_friction".into());
    let header: Vec<&str> = header.iter().map(String::as_str).collect();
    let mut rows = Vec::new();
    for (i, (case, result)) in cases.iter().zip(results).enumerate() {
        let mut start = vec![(i + 1).to_string()];
        start.extend(case.values.iter().map(|v| v.1.clone()));
        let (outcome, time, motions) = match result {
            Ok(run) => {
                let flaw = run.flaw();
                let last = run.samples.last().map_or(0.0, |s| s.time);
                let outcome = flaw.map_or("completed", |e| e.kind.name()).to_string();
                (outcome, flaw.map_or(last, |e| e.time), &run.motions[..])
            }
            Err(error) => (error.to_string(), 0.0, &[][..]),
        };
        start.extend([outcome, seconds(time)]);
        let needed = vec![result.as_ref().map_or(String::new(), |run| number(run.required_friction))];
        if motions.is_empty() {
            start.resize(header.len() - 1, String::new());
            rows.push([start, needed].concat());
        } else {
            rows.extend(motions.iter().map(|m| [start.clone(), motion_row(m), needed.clone()].concat()));
        }
    }
    write_table(path.as_ref(), &header, rows.into_iter())
}

/// Writes d (m), tilt_deg, parallel_n, radial_n.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub(crate) fn write_posture_force(path: impl AsRef<Path>, analysis: &GraspAnalysis) -> Result<(), IoError> {
    let f = &analysis.force;
    let rows = (0..f.parallel.len()).map(|k| {
        let (d, tilt) = (f.displacements[k / f.tilts.len()], f.tilts[k % f.tilts.len()]);
        [d, tilt.to_degrees().round(), f.parallel[k], f.radial[k]].map(number).to_vec()
    });
    write_table(path.as_ref(), &["d", "tilt_deg", "parallel_n", "radial_n"], rows)
}

/// Writes step, model, axis, theta_deg, value (m, of the axis), energy (J), row by row.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub(crate) fn write_energy(path: impl AsRef<Path>, analysis: &GraspAnalysis) -> Result<(), IoError> {
    let rows = analysis.surfaces.iter().flat_map(|s| {
        (0..s.energy.len()).map(move |k| {
            let (theta, other) = (s.theta[k % s.theta.len()], s.other[k / s.theta.len()]);
            let mut row = vec![s.step.to_string(), s.model.name().to_string(), s.axis.to_string()];
            row.extend([theta.to_degrees(), other, s.energy[k]].map(number));
            row
        })
    });
    write_table(path.as_ref(), &["step", "model", "axis", "theta_deg", "value", "energy"], rows)
}

/// Writes step, joint angles, model, the stationary pose, displacements there, eigenvalues (N/m),
/// residual (N), class, what holds the object along its faces, and the distance from the parallel
/// model's equilibrium (m); places of what does not exist are empty.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub(crate) fn write_stability(path: impl AsRef<Path>, analysis: &GraspAnalysis) -> Result<(), IoError> {
    let columns = [
        "step",
        "theta1_deg",
        "theta2_deg",
        "model",
        "x",
        "y",
        "theta_deg",
        "dn1",
        "dn2",
        "lambda1",
        "lambda2",
        "lambda3",
        "residual",
        "class",
        "hold",
        "distance",
    ];
    let cell = |v: Option<f64>| v.map_or(String::new(), number);
    let rows = analysis.stability.iter().map(|r| {
        let mut row = vec![r.step.to_string()];
        row.extend(r.joints.map(|v| number(v.to_degrees())));
        row.push(r.model.name().into());
        row.extend([0, 1, 2].map(|k| cell(r.pose.map(|p| if k == 2 { p[k].to_degrees() } else { p[k] }))));
        row.extend([0, 1].map(|k| cell(r.normal.map(|d| d[k]))));
        row.extend([0, 1, 2].map(|k| cell(r.eigenvalues.get(k).copied())));
        row.extend([cell(r.residual), r.class.name().into(), r.hold.name().into(), cell(r.distance)]);
        row
    });
    write_table(path.as_ref(), &columns, rows)
}

/// Writes theta1_deg, theta2_deg, state, and for what was reached x, y, theta_deg, displacements,
/// forces and the smallest eigenvalue (N/m).
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub(crate) fn write_pinch_map(path: impl AsRef<Path>, analysis: &GraspAnalysis) -> Result<(), IoError> {
    let columns = [
        "theta1_deg",
        "theta2_deg",
        "state",
        "x",
        "y",
        "theta_deg",
        "dn1",
        "dn2",
        "dt1",
        "dt2",
        "fn1",
        "fn2",
        "ft1",
        "ft2",
        "smallest_eigenvalue",
    ];
    let rows = analysis.pinch.cells.iter().map(|c| {
        let s = &c.sample;
        let mut row: Vec<String> = s.joints.map(|v| number((v.to_degrees() * 1e9).round() / 1e9)).to_vec();
        row.push(c.state.name().into());
        if c.smallest_eigenvalue.is_nan() {
            row.resize(columns.len(), String::new());
        } else {
            let [_, x, y, theta, _, _, rest @ ..] = s.row();
            row.extend([x, y, theta.to_degrees()].map(number));
            row.extend(rest[..8].iter().copied().map(number));
            row.push(number(c.smallest_eigenvalue));
        }
        row
    });
    write_table(path.as_ref(), &columns, rows)
}
