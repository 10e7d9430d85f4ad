//! Parameters of the field pipeline from a file: `summary.json` of an earlier run, or its keys as
//! JSON or TOML.

use super::scene::{known_names, parse_table};
use super::{format, source};
use crate::error::IoError;
use crate::types::FieldParams;
use crate::types::params::Preset;
use serde_json::{Map, Value};
use std::path::Path;

/// No file of parameters is longer (bytes).
const MAX_FILE_BYTES: u64 = 1 << 24;

/// Reads parameters under the keys that `summary.json` has in `params`: there, or alone at the top
/// of a JSON or TOML file. Keys that are left out keep the preset's value (`balanced` without one).
///
/// # Errors
/// [`IoError`] when the file cannot be read or is neither, a key is unknown (with the nearest known
/// one), or a value is of a wrong type or out of range.
///
/// ```
/// use palpate::io;
/// let folder = tempfile::tempdir()?;
/// let path = folder.path().join("run.toml");
/// std::fs::write(&path, "preset = \"fast\"\nsearch_mm = 12.0\n")?;
/// assert_eq!(io::read_config(&path)?.search_mm, 12.0);
/// // A slip of the keyboard is answered with the nearest key.
/// std::fs::write(&path, "serch_mm = 12.0\n")?;
/// assert!(io::read_config(&path).is_err_and(|e| e.to_string().contains("search_mm")));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn read_config(path: impl AsRef<Path>) -> Result<FieldParams, IoError> {
    let path = path.as_ref();
    let text = source::keyed(path, MAX_FILE_BYTES, source::MAX_VALUES)?;
    let given = if text.trim_start().starts_with('{') { from_json(path, &text)? } else { from_toml(path, &text)? };
    let preset = match given.get("preset") {
        Some(value) => serde_json::from_value(value.clone())
            .map_err(|_| format(path, format!("preset is {value}"), "give \"fast\", \"balanced\" or \"accurate\""))?,
        None => Preset::default(),
    };
    let mut params = FieldParams::preset(preset);
    for (key, value) in given {
        params = with(&params, &key, &value).ok_or_else(|| {
            let hint = "see docs/reference/file-formats.md for what each key takes";
            format(path, format!("{key} is {value}, which it cannot be"), hint)
        })?;
    }
    params.check().map_err(|e| format(path, e.to_string(), "correct that key"))?;
    Ok(params)
}

/// `params` with one value replaced; none when it is of a wrong type.
fn with(params: &FieldParams, key: &str, value: &Value) -> Option<FieldParams> {
    let mut all = serde_json::to_value(params).ok()?;
    all.as_object_mut()?.insert(key.into(), value.clone());
    serde_json::from_value(all).ok()
}

fn from_json(path: &Path, text: &str) -> Result<Map<String, Value>, IoError> {
    let wrong = |what: String| format(path, what, "give the summary.json of a field or track run, or its params");
    let parsed: Value = serde_json::from_str(text).map_err(|e| wrong(format!("is no JSON ({e})")))?;
    let Value::Object(mut top) = parsed else { return Err(wrong("holds no keys".into())) };
    let is_summary = top.contains_key("version") && top.contains_key("command");
    let given = match top.remove("params") {
        Some(Value::Object(params)) => params,
        Some(_) => return Err(wrong("params is no object".into())),
        None if is_summary => {
            let command = top.get("command").and_then(Value::as_str).unwrap_or("another command");
            return Err(wrong(format!("is the summary of `palpate {command}`, which has no field parameters")));
        }
        None => top,
    };
    known_names(path, "the configuration", given.keys().map(String::as_str), &FieldParams::KEYS)?;
    Ok(given)
}

fn from_toml(path: &Path, text: &str) -> Result<Map<String, Value>, IoError> {
    let mut table = parse_table(path, text)?;
    if let Some(toml::Value::Table(params)) = table.remove("params") {
        known_names(path, "the configuration", table.keys().map(String::as_str), &["params"])?;
        table = params;
    }
    known_names(path, "the configuration", table.keys().map(String::as_str), &FieldParams::KEYS)?;
    let odd = |what: String| format(path, what, "write key = value, with text in quotes");
    // JSON has no such numbers and would say null.
    if let Some((key, value)) = table.iter().find(|(_, v)| v.as_float().is_some_and(|v| !v.is_finite())) {
        return Err(format(path, format!("{key} is {value}, not a finite number"), "correct that key"));
    }
    match serde_json::to_value(&table).map_err(|e| odd(e.to_string()))? {
        Value::Object(given) => Ok(given),
        _ => Err(odd("holds no keys".into())),
    }
}
