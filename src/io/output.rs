//! A folder of results that appears as a whole or not at all.

use super::temporary_files::{EARLIER, Hold, Live, TEMPORARY, as_a_whole, prefix, sweep};
use super::{format, os};
use crate::error::IoError;
use std::fs;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// Where a command puts its results.
///
/// Files are first written into a hidden folder inside the target (same file system, so that moving
/// them is a rename) and moved by [`OutputFolder::commit`]. Dropped without a commit, it leaves the
/// target as it was; folders that it had created are removed again. A killed process may leave the
/// hidden folder, which the next run removes unless earlier results are in it. The target is held
/// meanwhile: no other run can write into it.
#[derive(Debug)]
pub struct OutputFolder {
    path: PathBuf,
    staging: Option<(TempDir, Live)>,
    names: Vec<String>,
    /// Files of an earlier run, which go unless they are written anew.
    earlier: Vec<String>,
    /// Folders made here, outermost first.
    created: Vec<(PathBuf, Live)>,
    held: Option<Hold>,
}

impl OutputFolder {
    /// Checks that results can be written to `path`, and creates the folder (and those above it)
    /// where needed.
    ///
    /// # Errors
    /// [`IoError`] when `path` is a file, cannot be created or written, or holds files and `force`
    /// is not set.
    ///
    /// ```
    /// use palpate::io::{OutputFolder, write_text};
    /// let parent = tempfile::tempdir()?;
    /// let path = parent.path().join("results");
    /// let mut folder = OutputFolder::create(&path, false)?;
    /// folder.write("note.txt", |file| write_text(file, "done"))?;
    /// folder.commit()?;
    /// assert!(path.join("note.txt").is_file());
    /// // A folder that holds something is not written over.
    /// assert!(OutputFolder::create(&path, false).is_err());
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn create(path: impl AsRef<Path>, force: bool) -> Result<Self, IoError> {
        let path = path.as_ref();
        Self::check(path, force)?;
        let missing = |p: &&Path| !p.as_os_str().is_empty() && !p.exists();
        let mut folder = Self {
            path: path.into(),
            staging: None,
            names: Vec::new(),
            earlier: Vec::new(),
            created: Vec::new(),
            held: None,
        };
        let mut to_create: Vec<&Path> = path.ancestors().take_while(missing).collect();
        while let Some(next) = to_create.pop() {
            match Live::folder(next) {
                Ok(live) => folder.created.push((next.into(), live)),
                // Another run has made it meanwhile: it is not ours to remove.
                Err(_) if next.is_dir() => {}
                Err(error) => return Err(os(next, "create the folder")(error)),
            }
        }
        folder.held = Some(hold(path).inspect_err(|_| folder.created.clear())?);
        // What another run has written meanwhile counts.
        Self::check(path, force)?;
        sweep(path);
        let staging = || tempfile::Builder::new().prefix(prefix()).tempdir_in(path);
        let staging = Live::temporary(staging, |made| made.path());
        folder.staging = Some(staging.map_err(os(path, "write into the folder"))?);
        Ok(folder)
    }

    /// Checks what can be checked without writing: that `path` is no file, and holds none unless
    /// `force` is set.
    ///
    /// # Errors
    /// [`IoError`] when it is, does, or cannot be read.
    pub fn check(path: impl AsRef<Path>, force: bool) -> Result<(), IoError> {
        let path = path.as_ref();
        if path.exists() && !path.is_dir() {
            return Err(format(path, "is a file, but a folder is needed for the results", "choose another --output"));
        }
        if path.is_dir() && !force {
            let ours = |e: &fs::DirEntry| e.file_name().to_string_lossy().starts_with(TEMPORARY);
            let mut entries = fs::read_dir(path).map_err(os(path, "read the folder"))?;
            if entries.any(|e| !e.is_ok_and(|e| ours(&e))) {
                return Err(format(
                    path,
                    "the folder is not empty",
                    "choose another --output, or let files be replaced (--overwrite)",
                ));
            }
        }
        Ok(())
    }

    /// The target folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Stages the file `name` (no folders in it): `write` gets the path to write to, which ends in
    /// `name`.
    ///
    /// # Errors
    /// Those of `write`, with the file's final path.
    pub fn write(&mut self, name: &str, write: impl FnOnce(&Path) -> Result<(), IoError>) -> Result<(), IoError> {
        let target = self.path.join(name);
        if target.is_dir() {
            return Err(format(
                &target,
                "is a folder, but a file is to be written",
                "remove it or choose another --output",
            ));
        }
        let Some((staging, _)) = &self.staging else { return Ok(()) };
        write(&staging.path().join(name)).map_err(|error| match error {
            IoError::Os { action, source, .. } => IoError::Os { path: target, action, source },
            IoError::Format { what, hint, .. } => IoError::Format { path: target, what, hint },
        })?;
        if !self.names.iter().any(|n| n == name) {
            self.names.push(name.into());
        }
        Ok(())
    }

    /// Names the files in the folder that results of this kind consist of: those that an earlier
    /// run left and this one does not write would pass for results of this one, and are removed by
    /// [`OutputFolder::commit`].
    ///
    /// # Errors
    /// [`IoError`] when the folder cannot be read.
    pub fn supersede(&mut self, ours: impl Fn(&str) -> bool) -> Result<(), IoError> {
        for entry in fs::read_dir(&self.path).map_err(os(&self.path, "read the folder"))? {
            let entry = entry.map_err(os(&self.path, "read the folder"))?;
            let file = entry.file_type().is_ok_and(|t| t.is_file());
            self.earlier.extend(entry.file_name().into_string().ok().filter(|name| file && ours(name)));
        }
        Ok(())
    }

    /// Moves all files to their final names, and returns these in the order of writing. What stood
    /// under them goes only when all are there.
    ///
    /// # Errors
    /// [`IoError`] when a rename is refused; then all stands as it did before.
    pub fn commit(mut self) -> Result<Vec<PathBuf>, IoError> {
        let Some((staging, _)) = &self.staging else { return Ok(Vec::new()) };
        let targets: Vec<PathBuf> = self.names.iter().map(|name| self.path.join(name)).collect();
        let earlier = staging.path().join(EARLIER);
        let gone = self.earlier.iter().filter(|name| !self.names.contains(name));
        as_a_whole(|| {
            let mut back = Vec::new();
            let new = self.names.iter().map(|name| (name, true)).chain(gone.map(|name| (name, false)));
            for (name, new) in new {
                let (staged, target) = (staging.path().join(name), self.path.join(name));
                if let Err(error) = replace(new.then_some(&staged), &target, &earlier.join(name), &mut back) {
                    for (from, to) in back.iter().rev() {
                        let _ = fs::rename(from, to);
                    }
                    return Err(os(&target, "create")(error));
                }
            }
            Ok(())
        })?;
        self.created.clear();
        Ok(targets)
    }
}

/// Holds a folder for results for one run.
///
/// # Errors
/// [`IoError`] when another run holds it, or it is gone.
pub fn hold(path: impl AsRef<Path>) -> Result<Hold, IoError> {
    let path = path.as_ref();
    Hold::of(path).map_err(|error| match error.kind() {
        std::io::ErrorKind::WouldBlock => {
            format(path, "another run is writing into the folder", "wait until it ends, or choose another --output")
        }
        _ => os(path, "write into the folder")(error),
    })
}

/// Moves `new`, if there is any, to `target`, what stands there to `earlier` first; `back` gets the
/// renames that undo it, in order.
fn replace(
    new: Option<&PathBuf>,
    target: &Path,
    earlier: &Path,
    back: &mut Vec<(PathBuf, PathBuf)>,
) -> std::io::Result<()> {
    if target.exists() {
        if let Some(folder) = earlier.parent() {
            fs::create_dir_all(folder)?;
        }
        fs::rename(target, earlier)?;
        back.push((earlier.into(), target.into()));
    }
    if let Some(new) = new {
        fs::rename(new, target)?;
        back.push((target.into(), new.clone()));
    }
    Ok(())
}

impl Drop for OutputFolder {
    fn drop(&mut self) {
        self.staging = None; // removes the hidden folder
        for (folder, _) in self.created.iter().rev() {
            let _ = fs::remove_dir(folder); // refused when someone else has put something there
        }
    }
}
