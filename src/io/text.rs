//! JSON, text (HTML, SVG) and bytes (PNG).

use super::atomic::write_atomic;
use super::{format, os, source};
use crate::error::IoError;
use serde::Serialize;
use serde_json::Value;
use std::io::Write;
use std::path::{Path, PathBuf};

/// Reads a JSON file of at most 16 MB and a million values.
///
/// # Errors
/// [`IoError`] when the file cannot be read or is no JSON.
pub fn read_json(path: impl AsRef<Path>) -> Result<Value, IoError> {
    let path = path.as_ref();
    let text = source::keyed(path, 1 << 24, 1 << 20)?;
    serde_json::from_str(&text).map_err(|e| format(path, format!("is no JSON ({e})"), "check which file it is"))
}

/// Reads a text file of at most 256 MB.
///
/// # Errors
/// [`IoError`] when the file cannot be read or is no UTF-8.
pub fn read_text(path: impl AsRef<Path>) -> Result<String, IoError> {
    source::text(path.as_ref(), source::MAX_TEXT_BYTES)
}

/// The files and folders in a folder, sorted.
///
/// # Errors
/// [`IoError`] when the folder cannot be read.
pub fn list(folder: impl AsRef<Path>) -> Result<Vec<PathBuf>, IoError> {
    let folder = folder.as_ref();
    let entries = std::fs::read_dir(folder).map_err(os(folder, "read the folder"))?;
    let mut found: Vec<PathBuf> = entries.filter_map(|e| Some(e.ok()?.path())).collect();
    found.sort();
    Ok(found)
}

/// Writes `value` as indented JSON with a newline at the end. Numbers that are not finite become
/// `null`.
///
/// # Errors
/// [`IoError`] when the file cannot be written or the value cannot be put in JSON (a map with keys
/// that are not text).
pub fn write_json(path: impl AsRef<Path>, value: &impl Serialize) -> Result<(), IoError> {
    write_atomic(path.as_ref(), |w| {
        serde_json::to_writer_pretty(&mut *w, value)?;
        w.write_all(b"\n")
    })
}

/// Writes text as UTF-8.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub fn write_text(path: impl AsRef<Path>, text: &str) -> Result<(), IoError> {
    write_bytes(path, text.as_bytes())
}

/// Copies a file.
///
/// # Errors
/// [`IoError`] when one cannot be read, or the other not written.
pub fn copy(from: impl AsRef<Path>, to: impl AsRef<Path>) -> Result<(), IoError> {
    let from = from.as_ref();
    let mut file = source::open(from)?;
    write_atomic(to.as_ref(), |w| std::io::copy(&mut file, w).map(drop))
}

/// Writes bytes as they are.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub fn write_bytes(path: impl AsRef<Path>, bytes: &[u8]) -> Result<(), IoError> {
    write_atomic(path.as_ref(), |w| w.write_all(bytes))
}
