//! A folder for files in between, removed when it is dropped.

use super::os;
use super::temporary_files::{Live, prefix, sweep};
use crate::error::IoError;
use std::path::Path;
use tempfile::{Builder, TempDir};

/// A folder of its own under the system's folder for temporary files.
#[derive(Debug)]
pub(crate) struct Scratch(TempDir, #[expect(dead_code, reason = "held for its drop")] Live);

impl Scratch {
    /// Makes it.
    ///
    /// # Errors
    /// [`IoError`] when it cannot be created.
    pub fn new() -> Result<Self, IoError> {
        let folder = std::env::temp_dir();
        sweep(&folder);
        let made = Live::temporary(|| Builder::new().prefix(prefix()).tempdir_in(&folder), |made| made.path());
        made.map(|(made, live)| Self(made, live)).map_err(os(&folder, "create a folder in"))
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        self.0.path()
    }
}
