//! Opening files to read, the same for all of them.
//!
//! Only regular files are opened: opening a pipe waits for who writes into it. A file is read whole
//! only up to a bound, and a longer one is refused, not cut.

use super::{format, os};
use crate::error::IoError;
use std::fs::{self, File};
use std::io::Read;
use std::path::Path;

/// No table and no file of numbers as text is longer (bytes).
pub(super) const MAX_TEXT_BYTES: u64 = 1 << 28;

/// No scene and no set of parameters has more values.
pub(super) const MAX_VALUES: usize = 1 << 16;

/// Opens a regular file.
pub(super) fn open(path: &Path) -> Result<File, IoError> {
    let kind = fs::metadata(path).map_err(os(path, "read"))?;
    match (kind.is_file(), kind.is_dir()) {
        (true, _) => File::open(path).map_err(os(path, "read")),
        (_, true) => Err(format(path, "is a folder, not a file", "name the file in it")),
        _ => Err(format(path, "is not a regular file", "a pipe or device cannot be read: save it to a file first")),
    }
}

/// The first bytes, at most `most`.
pub(super) fn head(path: &Path, most: u64) -> Result<Vec<u8>, IoError> {
    let mut head = Vec::new();
    open(path)?.take(most).read_to_end(&mut head).map_err(os(path, "read"))?;
    Ok(head)
}

/// All bytes of a file of at most `most`.
pub(super) fn bytes(path: &Path, most: u64) -> Result<Vec<u8>, IoError> {
    let all = head(path, most.saturating_add(1))?;
    match all.len() as u64 > most {
        true => Err(format(path, format!("has more than {most} bytes"), "check which file it is")),
        false => Ok(all),
    }
}

/// All of a text of at most `most` bytes.
pub(super) fn text(path: &Path, most: u64) -> Result<String, IoError> {
    String::from_utf8(bytes(path, most)?).map_err(|e| {
        let (at, packing) = (e.utf8_error().valid_up_to(), packing(e.as_bytes()));
        match packing {
            Some((name, command)) => format(path, format!("is packed with {name}"), format!("unpack it: {command}")),
            None => format(path, format!("is no text (UTF-8) at byte {at}"), "check which file it is"),
        }
    })
}

/// All of a text of at most `most` bytes with keys and values, before it is parsed: each value
/// takes some hundred bytes of memory, whatever it takes of the text.
pub(super) fn keyed(path: &Path, most: u64, values: usize) -> Result<String, IoError> {
    let text = text(path, most)?;
    let found = text.bytes().filter(|b| b",=[{".contains(b)).count();
    match found > values {
        true => Err(format(path, format!("holds more than {values} values"), "check which file it is")),
        false => Ok(text),
    }
}

/// The program that packed a file, by its first bytes, and how to unpack it; gzip aside, which
/// images are read from.
pub(super) fn packing(head: &[u8]) -> Option<(&'static str, &'static str)> {
    let known: [(&[u8], _, _); 7] = [
        (b"\x28\xb5\x2f\xfd", "Zstandard", "zstd -d FILE"),
        (b"BZh", "bzip2", "bzip2 -dk FILE"),
        (b"\xfd7zXZ\0", "xz", "xz -dk FILE"),
        (b"\x04\x22\x4d\x18", "lz4", "lz4 -d FILE"),
        (b"\x1f\x9d", "compress", "uncompress FILE"),
        (b"PK\x03\x04", "zip", "unzip FILE"),
        (b"7z\xbc\xaf\x27\x1c", "7-Zip", "7z x FILE"),
    ];
    known.into_iter().find(|k| head.starts_with(k.0)).map(|k| (k.1, k.2))
}
