//! A folder for files in between, removed when it is dropped.

use super::live::Live;
use super::os;
use crate::error::IoError;
use std::path::Path;
use tempfile::TempDir;

/// A folder of its own under the system's folder for temporary files.
#[derive(Debug)]
pub struct Scratch(TempDir, #[expect(dead_code, reason = "held for its drop")] Live);

impl Scratch {
    /// Makes it.
    ///
    /// # Errors
    /// [`IoError`] when it cannot be created.
    pub fn new() -> Result<Self, IoError> {
        let made = Live::temporary(tempfile::tempdir, |made| made.path());
        made.map(|(folder, live)| Self(folder, live)).map_err(os(&std::env::temp_dir(), "create a folder in"))
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        self.0.path()
    }
}
