//! What is wrong with a file, before its path is known.

use super::format;
use crate::error::IoError;
use std::path::Path;

/// What is wrong, and what to try.
#[derive(Debug)]
pub(super) struct Flaw {
    what: String,
    hint: &'static str,
}

impl Flaw {
    pub(super) fn new(what: impl Into<String>, hint: &'static str) -> Self {
        Self { what: what.into(), hint }
    }

    /// The error for the file at `path`.
    pub(super) fn at(self, path: &Path) -> IoError {
        format(path, self.what, self.hint)
    }
}
