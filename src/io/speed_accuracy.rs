//! Tables of `palpate chart` and `palpate stress`.

use super::csv::write_table;
use super::grasp;
use crate::error::IoError;
use crate::types::{StressCurve, Trial};
use std::path::Path;

/// A number in full, or nothing where there is none.
fn number(v: Option<f64>) -> String {
    v.filter(|v| v.is_finite()).map(grasp::number).unwrap_or_default()
}

/// Writes one line a trial.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub(crate) fn write_trials(path: impl AsRef<Path>, trials: &[Trial]) -> Result<(), IoError> {
    let columns = [
        "part",
        "varied",
        "method",
        "settings",
        "case",
        "error",
        "error_p95",
        "gradient_error",
        "nothing",
        "size",
        "cpu_s",
        "whole_command",
        "failure",
    ];
    let rows = trials.iter().map(|t| {
        vec![
            t.part.name().into(),
            t.varied.into(),
            t.method.clone(),
            t.settings.clone(),
            t.case.clone(),
            number(Some(t.error)),
            number(t.error_p95),
            number(t.gradient_error),
            number(t.nothing),
            t.size.to_string(),
            number(Some(t.cpu_s)),
            u8::from(t.whole).to_string(),
            t.failure.clone().unwrap_or_default(),
        ]
    });
    write_table(path.as_ref(), &columns, rows)
}

/// Writes one line a run, curve by curve.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub(crate) fn write_stress(path: impl AsRef<Path>, curves: &[StressCurve]) -> Result<(), IoError> {
    let columns = [
        "part",
        "axis",
        "case",
        "severity",
        "unit",
        "error",
        "error_unit",
        "limit",
        "broken",
        "told",
        "inside_band",
        "refused",
        "said",
        "expected",
        "silent",
        "false_alarm",
    ];
    let rows = curves.iter().flat_map(|c| {
        c.runs.iter().map(move |r| {
            vec![
                c.part.name().into(),
                c.axis.clone(),
                c.case.clone(),
                number(Some(r.severity)),
                c.unit.into(),
                number(Some(r.error)),
                c.error_unit.into(),
                number(Some(r.limit)),
                u8::from(r.broken()).to_string(),
                u8::from(r.told()).to_string(),
                number(r.inside),
                r.refused.clone().unwrap_or_default(),
                r.said.join("; "),
                number(r.expected),
                u8::from(r.silent()).to_string(),
                u8::from(r.false_alarm()).to_string(),
            ]
        })
    });
    write_table(path.as_ref(), &columns, rows)
}
