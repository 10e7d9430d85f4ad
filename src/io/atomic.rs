//! Writing a file so that it is either there as a whole or not at all.
//!
//! The temporary file stands in the same folder, so that the rename cannot cross file systems; it
//! is removed when anything fails. There is no fsync: a power cut may lose the file, a full disk or
//! a crash cannot tear it.

use super::temporary_files::{Live, as_a_whole, prefix, sweep};
use super::{format, os};
use crate::error::IoError;
use std::io::{self, BufWriter, Write};
use std::path::Path;
use tempfile::Builder;

/// Creates or replaces `path` with what `write` writes.
pub(super) fn write_atomic(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<&mut std::fs::File>) -> io::Result<()>,
) -> Result<(), IoError> {
    if path.exists() && !path.is_file() {
        return Err(format(path, "exists and is not a regular file", "choose another name for the output"));
    }
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    sweep(folder);
    let mut builder = Builder::new();
    builder.prefix(prefix()).suffix(".tmp");
    // Without this a temporary file is readable by its owner only, and keeps that after the rename.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    let (mut file, live) =
        Live::temporary(|| builder.tempfile_in(folder), |file| file.path()).map_err(os(path, "create"))?;
    let mut buffer = BufWriter::with_capacity(1 << 18, file.as_file_mut());
    write(&mut buffer).and_then(|()| buffer.flush()).map_err(os(path, "write"))?;
    drop(buffer);
    let moved = as_a_whole(|| file.persist(path).map(drop));
    drop(live);
    moved.map_err(|e| os(path, "create")(e.error))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect()
    }

    #[test]
    fn a_write_that_fails_half_way_leaves_nothing_and_keeps_the_old_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.txt");
        let fail = |w: &mut BufWriter<&mut std::fs::File>| {
            w.write_all(&[7; 1 << 20])?;
            Err(io::Error::from(io::ErrorKind::StorageFull))
        };
        let error = write_atomic(&path, fail).unwrap_err().to_string();
        assert!(error.contains("a.txt") && error.contains("cannot write"), "{error}");
        assert!(names(folder.path()).is_empty());

        write_atomic(&path, |w| w.write_all(b"old")).unwrap();
        write_atomic(&path, fail).unwrap_err();
        assert_eq!(std::fs::read(&path).unwrap(), b"old");
        assert_eq!(names(folder.path()), ["a.txt"]);
    }

    #[cfg(unix)]
    #[test]
    fn the_file_has_the_usual_permissions() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let (ours, usual) = (folder.path().join("ours"), folder.path().join("usual"));
        write_atomic(&ours, |w| w.write_all(b"x")).unwrap();
        std::fs::write(&usual, b"x").unwrap();
        let mode = |p: &Path| std::fs::metadata(p).unwrap().permissions().mode();
        assert_eq!(mode(&ours), mode(&usual));
    }
}
