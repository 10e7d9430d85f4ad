//! How this program starts itself again: as its own binary, or through Python.

use std::ffi::OsString;
use std::sync::OnceLock;

static OWN: OnceLock<Vec<OsString>> = OnceLock::new();

/// Remembers the words that start this program.
pub fn remember(words: Vec<OsString>) {
    let _ = OWN.set(words);
}

/// The words that start this program: the file to run, and what stands before its arguments.
pub fn words() -> Vec<OsString> {
    OWN.get().filter(|words| !words.is_empty()).cloned().unwrap_or_else(|| vec!["palpate".into()])
}
