//! What stands on the disk only while the program runs: one that is stopped takes it away first,
//! and one that was killed leaves it to the next run.
//!
//! A process holds what it makes by a lock of the system (`flock`), which ends with the process.
//! The names have the machine's in them: of what another machine holds, a shared disk may not tell.

use std::fs::{self, File, TryLockError};
use std::io::{self, ErrorKind};
use std::mem::forget;
use std::path::{Path, PathBuf};
use std::sync::{LazyLock, Mutex, MutexGuard, PoisonError};

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

/// Start of the names of all temporary files and folders.
pub(super) const TEMPORARY: &str = ".palpate-";
/// Folder in a temporary one for results of before, while new ones take their place.
pub(super) const EARLIER: &str = "earlier";

/// Start of those of this machine.
pub(super) fn prefix() -> &'static str {
    static PREFIX: LazyLock<String> = LazyLock::new(|| {
        #[cfg(unix)]
        let machine = rustix::system::uname().nodename().to_string_lossy().into_owned();
        #[cfg(not(unix))]
        let machine = String::new();
        let plain: String = machine.chars().filter(char::is_ascii_alphanumeric).take(40).collect();
        format!("{TEMPORARY}{plain}-")
    });
    &PREFIX
}

/// Holds a file or folder as long as it is kept; none where the disk knows no locks.
#[derive(Debug)]
pub struct Hold(Option<File>);

impl Hold {
    /// # Errors
    /// [`ErrorKind::WouldBlock`] when another process holds it, [`ErrorKind::NotFound`] when it is
    /// gone.
    pub(super) fn of(path: &Path) -> io::Result<Self> {
        let file = match File::open(path) {
            Ok(file) => file,
            Err(error) if error.kind() == ErrorKind::NotFound => return Err(error),
            Err(_) => return Ok(Self(None)),
        };
        match file.try_lock() {
            Ok(()) if !path.exists() => Err(ErrorKind::NotFound.into()),
            Ok(()) => Ok(Self(Some(file))),
            Err(TryLockError::WouldBlock) => Err(ErrorKind::WouldBlock.into()),
            Err(TryLockError::Error(_)) => Ok(Self(None)),
        }
    }
}

/// Removes what killed runs of this machine have left in `folder`: temporary files and folders that
/// nobody holds. Those that keep results of before stay.
pub(super) fn sweep(folder: &Path) {
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let (path, kind) = (entry.path(), entry.file_type());
        let plain = kind.is_ok_and(|k| k.is_file() || k.is_dir());
        if !plain || !entry.file_name().to_string_lossy().starts_with(prefix()) || path.join(EARLIER).exists() {
            continue;
        }
        if let Ok(held) = Hold::of(&path)
            && held.0.is_some()
        {
            let _ = if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
        }
    }
}

/// Knows of one of them until it is dropped.
#[derive(Debug)]
pub(super) struct Live(Entry, #[expect(dead_code, reason = "held for its drop")] Option<Hold>);

impl Live {
    /// Makes a temporary file or folder and holds it; `path` says where it came to stand.
    pub(super) fn temporary<T>(make: impl Fn() -> io::Result<T>, path: impl Fn(&T) -> &Path) -> io::Result<(T, Self)> {
        let mut live = live();
        // Whoever sweeps may take it before it is held: then another one is made.
        let (made, hold) = loop {
            let made = make()?;
            if let Ok(hold) = Hold::of(path(&made)) {
                break (made, hold);
            }
        };
        let entry = Entry::Temporary(path(&made).into());
        live.push(entry.clone());
        Ok((made, Self(entry, Some(hold))))
    }

    /// Makes a folder for results.
    pub(super) fn folder(path: &Path) -> io::Result<Self> {
        let mut live = live();
        fs::create_dir(path)?;
        let entry = Entry::Made(path.into());
        live.push(entry.clone());
        Ok(Self(entry, None))
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
pub(crate) fn abandon() {
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
