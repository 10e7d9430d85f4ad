//! Measurements of fingertips and grasps: comma-separated, one header line, SI units, angles in
//! degrees.

use super::csv::{read_table, write_table};
use super::format;
use super::grasp::number;
use crate::error::IoError;
use crate::types::measured::{CoursePoint, ForcePoint, MeasuredFit, Measurements};
use std::path::Path;

const FORCE: [&str; 3] = ["d", "tilt_deg", "force"];
const COURSE: [&str; 6] = ["time", "theta1_deg", "theta2_deg", "x", "y", "theta_deg"];
/// Fewest rows that say anything of a model.
const MIN_ROWS: usize = 5;

/// Reads presses (d, tilt_deg, force; dt, and rate or time where there are such columns) or the
/// course of a grasp (time, theta1_deg, theta2_deg, x, y, theta_deg).
///
/// # Errors
/// [`IoError`] when the file cannot be read, has neither set of columns, a value is not a finite
/// number, rows are too few, or times do not rise.
pub fn read_measured(path: impl AsRef<Path>) -> Result<Measurements, IoError> {
    let path = path.as_ref();
    let found = match read_table(path, COURSE) {
        Ok(table) => {
            let point = |[time, a, b, x, y, theta]: [f64; 6]| CoursePoint {
                time,
                joints: [a.to_radians(), b.to_radians()],
                pose: [x, y, theta.to_radians()],
            };
            let points: Vec<CoursePoint> = table.numbers.into_iter().map(point).collect();
            rising(path, points.iter().map(|p| p.time))?;
            Measurements::Course(points)
        }
        Err(course) => Measurements::Force(presses(path).map_err(|force| {
            // A table that is meant as a course names the object's pose.
            let text = force.to_string();
            if !text.contains("there is no column \"d\"") {
                return force;
            }
            if course.to_string().contains("there is no column \"time\"") {
                let what = format!("has neither {} nor {} in its first line", FORCE.join(","), COURSE.join(","));
                return format(path, what, "docs/reference/grasp.md shows both tables");
            }
            course
        })?),
    };
    match found.len() {
        n if n < MIN_ROWS => {
            Err(format(path, format!("has {n} rows, and {MIN_ROWS} are the fewest to fit a model to"), "measure more"))
        }
        _ => Ok(found),
    }
}

fn rising(path: &Path, times: impl Iterator<Item = f64>) -> Result<(), IoError> {
    let times: Vec<f64> = times.collect();
    match times.windows(2).position(|w| w[1] <= w[0]) {
        Some(i) => Err(format(path, format!("row {}: time does not rise", i + 2), "sort the rows by time")),
        None if times.first().is_some_and(|t| *t < 0.0) => {
            Err(format(path, "row 1: time is below 0", "count time from the start of the scene"))
        }
        None => Ok(()),
    }
}

fn presses(path: &Path) -> Result<Vec<ForcePoint>, IoError> {
    let table = read_table(path, FORCE)?;
    let column = |name: &str| -> Result<Option<Vec<f64>>, IoError> {
        let Some(at) = table.other_columns.iter().position(|c| c.eq_ignore_ascii_case(name)) else { return Ok(None) };
        let number = |(i, row): (usize, &Vec<String>)| {
            row[at].parse().ok().filter(|v: &f64| v.is_finite()).ok_or_else(|| {
                let what = format!("row {}: {name} is {:?}, not a finite number", i + 1, row[at]);
                format(path, what, "correct or remove that line")
            })
        };
        table.others.iter().enumerate().map(number).collect::<Result<_, _>>().map(Some)
    };
    let (d_t, rate, time) = (column("dt")?, column("rate")?, column("time")?);
    let rate = match (rate, time) {
        (Some(rate), _) => Some(rate),
        (None, Some(time)) => {
            rising(path, time.iter().copied())?;
            let d = |i: usize| table.numbers[i][0];
            let last = time.len().saturating_sub(1);
            let slope = |i: usize| {
                let (a, b) = (i.saturating_sub(1), (i + 1).min(last));
                if b > a { (d(b) - d(a)) / (time[b] - time[a]) } else { 0.0 }
            };
            Some((0..time.len()).map(slope).collect())
        }
        (None, None) => None,
    };
    let point = |(i, [d, tilt, force]): (usize, &[f64; 3])| {
        if *d < 0.0 || tilt.abs() >= 90.0 {
            let what = format!("row {}: d is {d} and tilt_deg {tilt}", i + 1);
            return Err(format(path, what, "d is a depth in m, 0 or more, and the tilt between -90 and 90 degrees"));
        }
        Ok(ForcePoint {
            d: *d,
            tilt: tilt.to_radians(),
            force: *force,
            d_t: d_t.as_ref().map(|c| c[i]),
            rate: rate.as_ref().map(|c| c[i]),
        })
    };
    table.numbers.iter().enumerate().map(point).collect()
}

/// Writes each measured row with what each model gives for it.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub(crate) fn write_measured(
    path: impl AsRef<Path>,
    measured: &Measurements,
    fit: &MeasuredFit,
) -> Result<(), IoError> {
    let (own, each): (&[&str], &[&str]) = match measured {
        Measurements::Force(_) => (&FORCE, &["force"]),
        Measurements::Course(_) => (&COURSE, &["x", "y", "theta_deg"]),
    };
    let mut header: Vec<String> = own.iter().map(|c| (*c).to_string()).collect();
    header.extend(fit.models.iter().flat_map(|m| each.iter().map(move |c| format!("{c}_{}", m.model))));
    let header: Vec<&str> = header.iter().map(String::as_str).collect();
    let rows = (0..measured.len()).map(|i| {
        let mut row = match measured {
            Measurements::Force(points) => vec![points[i].d, points[i].tilt.to_degrees(), points[i].force],
            Measurements::Course(points) => {
                let ([a, b], [x, y, theta]) = (points[i].joints, points[i].pose);
                vec![points[i].time, a.to_degrees(), b.to_degrees(), x, y, theta.to_degrees()]
            }
        };
        for model in &fit.models {
            let [a, b, c] = model.predicted[i];
            row.extend(if each.len() == 1 { vec![a] } else { vec![a, b, c.to_degrees()] });
        }
        row.into_iter().map(number).collect()
    });
    write_table(path.as_ref(), &header, rows)
}
