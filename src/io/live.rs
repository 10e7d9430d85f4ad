//! What stands on the disk only while the program runs, so that one that is stopped can take it
//! away first.

use std::fs;
use std::io;
use std::mem::forget;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// A temporary file or folder, or a folder made for results, which goes if it is still empty.
#[derive(Debug, Clone, PartialEq)]
enum Entry {
    Temporary(PathBuf),
    Made(PathBuf),
}

static LIVE: Mutex<Vec<Entry>> = Mutex::new(Vec::new());

fn live() -> MutexGuard<'static, Vec<Entry>> {
    LIVE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Knows of one of them until it is dropped.
#[derive(Debug)]
pub(super) struct Live(Entry);

impl Live {
    /// Makes a temporary file or folder; `path` says where it came to stand.
    pub(super) fn temporary<T>(
        make: impl FnOnce() -> io::Result<T>,
        path: impl Fn(&T) -> &Path,
    ) -> io::Result<(T, Self)> {
        let mut live = live();
        let made = make()?;
        let entry = Entry::Temporary(path(&made).into());
        live.push(entry.clone());
        Ok((made, Self(entry)))
    }

    /// Makes a folder for results.
    pub(super) fn folder(path: &Path) -> io::Result<Self> {
        let mut live = live();
        fs::create_dir(path)?;
        let entry = Entry::Made(path.into());
        live.push(entry.clone());
        Ok(Self(entry))
    }
}

impl Drop for Live {
    fn drop(&mut self) {
        let mut live = live();
        if let Some(at) = live.iter().rposition(|e| *e == self.0) {
            live.remove(at);
        }
    }
}

/// Does `work` as a whole: [`abandon`] waits for its end. It must neither make nor drop a [`Live`].
pub(super) fn as_a_whole<R>(work: impl FnOnce() -> R) -> R {
    let _held = live();
    work()
}

/// Removes all that is unfinished, for a program that stops at once: what is being moved to its
/// final name is still moved, and nothing is made or moved after it.
pub fn abandon() {
    let live = live();
    for entry in live.iter().rev() {
        let _ = match entry {
            Entry::Temporary(path) if path.is_dir() => fs::remove_dir_all(path),
            Entry::Temporary(path) => fs::remove_file(path),
            Entry::Made(path) => fs::remove_dir(path), // refused when there is something in it
        };
    }
    forget(live);
}
