//! What a run was asked for and has read, for its summary and its page.

use super::console::Console;
use palpate::io;
use palpate::types::record::{InputFile, RunRecord, rfc3339};
use std::path::{PathBuf, absolute};
use std::thread::{Builder, JoinHandle};
use std::time::{SystemTime, UNIX_EPOCH};

/// Read with what each is to the run.
pub type Read = Vec<(&'static str, PathBuf)>;

/// What there is of these, by role.
pub fn inputs(known: &[(&'static str, Option<&PathBuf>)]) -> Read {
    known.iter().filter_map(|(role, path)| Some((*role, (*path)?.clone()))).collect()
}

/// A record whose files are hashed while the run goes on.
pub struct Recording {
    record: RunRecord,
    inputs: Read,
    hashing: Option<JoinHandle<Vec<InputFile>>>,
}

impl Recording {
    /// Begins to hash `inputs`, which were found to be readable.
    pub fn start(console: &Console, inputs: Read) -> Self {
        let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let folder = std::env::current_dir().unwrap_or_default();
        let record = RunRecord {
            command_line: console.arguments().to_vec(),
            working_folder: folder.to_string_lossy().into_owned(),
            date: rfc3339(since.as_secs()),
            files: Vec::new(),
        };
        let own = inputs.clone();
        // Not in the pool of threads: its workers would wait for the disk.
        let hashing = Builder::new().name("hash".into()).spawn(move || hashed(&own)).ok();
        Self { record, inputs, hashing }
    }

    /// The whole record.
    pub fn finish(self) -> RunRecord {
        let done = self.hashing.and_then(|thread| thread.join().ok());
        let files = done.unwrap_or_else(|| hashed(&self.inputs));
        RunRecord { files, ..self.record }
    }
}

/// The files of `inputs`. One that is gone by now has no hash: results are not lost for that.
fn hashed(inputs: &Read) -> Vec<InputFile> {
    let of = |(role, path): &(&'static str, PathBuf)| {
        let one = |file: PathBuf| {
            let (bytes, sha256) = io::digest(&file).unwrap_or_default();
            let path = absolute(&file).unwrap_or(file).to_string_lossy().into_owned();
            InputFile { role: (*role).into(), path, bytes, sha256 }
        };
        io::files_of(path).into_iter().map(one).collect::<Vec<_>>()
    };
    inputs.iter().flat_map(of).collect()
}
