//! SHA-256 of inputs: tells whether a file is still the same.

use super::image::others;
use super::{os, source};
use crate::error::IoError;
use sha2::{Digest, Sha256};
use std::io::Read;
use std::path::{Path, PathBuf};

/// Bytes read at a time.
const BYTES_PER_READ: usize = 1 << 18;

/// Size in bytes and SHA-256 (64 hexadecimal digits) of a file. Of a folder, those of the files in
/// it, one after the other by name; folders in it do not count.
///
/// # Errors
/// [`IoError`] when it is not there, cannot be read, or is neither a file nor a folder.
pub fn digest(path: impl AsRef<Path>) -> Result<(u64, String), IoError> {
    let path = path.as_ref();
    let (mut hash, mut bytes) = (Sha256::new(), 0);
    let files: Vec<PathBuf> = match path.is_dir() {
        true => super::list(path)?.into_iter().filter(|file| file.is_file()).collect(),
        false => vec![path.into()],
    };
    let mut piece = vec![0; BYTES_PER_READ];
    for file in files {
        let mut source = source::open(&file)?;
        loop {
            match source.read(&mut piece).map_err(os(&file, "read"))? {
                0 => break,
                n => {
                    hash.update(&piece[..n]);
                    bytes += n as u64;
                }
            }
        }
    }
    let digits = hash.finalize().iter().map(|byte| std::format!("{byte:02x}")).collect();
    Ok((bytes, digits))
}

/// All files that reading `path` reads: itself, and the others that it names or is a part of.
pub fn files_of(path: impl AsRef<Path>) -> Vec<PathBuf> {
    let path = path.as_ref();
    std::iter::once(path.to_path_buf()).chain(others(path)).collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn the_hash_is_that_of_the_standard() {
        let folder = tempfile::TempDir::new().unwrap();
        let at = |name: &str| folder.path().join(name);
        std::fs::write(at("b"), "c").unwrap();
        std::fs::write(at("a"), "ab").unwrap();
        std::fs::write(at("z"), "abc").unwrap();
        // FIPS 180-2, appendix B.1.
        let abc = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(digest(at("z")).unwrap(), (3, abc.into()));
        std::fs::remove_file(at("z")).unwrap();
        assert_eq!(digest(folder.path()).unwrap(), (3, abc.into()));
        let long = vec![b'a'; 1_000_000];
        std::fs::write(at("long"), long).unwrap();
        let million = "cdc76e5c9914fb9281a1c7e284d73e67f1809a48a497200e046d39ccc7112cd0";
        assert_eq!(digest(at("long")).unwrap(), (1_000_000, million.into()));
        assert!(digest(at("absent")).unwrap_err().to_string().contains("absent"));
    }
}
