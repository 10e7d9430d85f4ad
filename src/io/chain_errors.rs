//! The table of errors of the whole chain.

use super::csv::write_table;
use crate::error::IoError;
use serde::Serialize;
use std::path::Path;

/// Columns of chain.csv.
const COLUMNS: [&str; 7] = ["stage", "quantity", "unit", "found", "truth", "error", "bound"];

/// Writes stage, quantity, unit, found, truth, error (relative for values, absolute for errors),
/// bound (`lower`, `upper` or empty); each row serialises to these keys.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub(crate) fn write_chain(path: impl AsRef<Path>, rows: &[impl Serialize]) -> Result<(), IoError> {
    let text = |v: &serde_json::Value| match v {
        serde_json::Value::String(s) => s.clone(),
        serde_json::Value::Null => String::new(),
        other => other.to_string(),
    };
    let row = |r| {
        let value = serde_json::to_value(r).unwrap_or_default();
        COLUMNS.iter().map(|c| text(&value[*c])).collect::<Vec<_>>()
    };
    write_table(path.as_ref(), &COLUMNS, rows.iter().map(row))
}
