//! `--series UID`: which series of a DICOM folder is meant. A file of a series stands for all of
//! it, so the folder's name is replaced by that of such a file before anything else is done.

use super::Usage;
use anyhow::{Result, bail};
use palpate::error::{Shown, plain};
use palpate::io;
use std::ffi::OsString;
use std::path::Path;

/// The arguments, with a file in place of each folder that holds one of the series that they name,
/// the first one that no folder before it took.
///
/// # Errors
/// When no folder among them holds a series that is named.
pub fn chosen(typed: Vec<OsString>) -> Result<Vec<OsString>> {
    let (mut wanted, mut out): (Vec<(String, bool)>, Vec<OsString>) = (Vec::new(), typed);
    let words: Vec<String> = out.iter().map(|word| word.to_string_lossy().into_owned()).collect();
    for (at, word) in words.iter().enumerate() {
        let value =
            if word == "--series" { words.get(at + 1).map(String::as_str) } else { word.strip_prefix("--series=") };
        wanted.extend(value.into_iter().flat_map(|v| v.split(',')).map(|uid| (uid.trim().to_string(), false)));
    }
    let mut held = Vec::new();
    let looked = if wanted.is_empty() { 0 } else { out.len() };
    for word in out.iter_mut().take(looked).skip(1) {
        let folder = Path::new(word.as_os_str());
        if !folder.is_dir() {
            continue;
        }
        let found = io::series_in(folder).unwrap_or_default();
        let file_of = |uid: &str| found.iter().find(|s| s.uid == uid).map(|s| s.file.clone());
        let mut here: Vec<&mut (String, bool)> = wanted.iter_mut().filter(|w| file_of(&w.0).is_some()).collect();
        here.sort_by_key(|w| w.1);
        if let Some(first) = here.first_mut() {
            first.1 = true;
            *word = file_of(&first.0).map_or_else(|| word.clone(), Into::into);
        } else if !found.is_empty() {
            let uids: Vec<&str> = found.iter().map(|s| s.uid.as_str()).collect();
            held.push(format!("{} holds {}", folder.shown(), plain(&uids.join(", "))));
        }
    }
    if let Some((uid, _)) = wanted.iter().find(|w| !w.1) {
        let holds = if held.is_empty() { "name the folder that holds it".into() } else { held.join("; ") };
        bail!(Usage(format!("--series {}: no folder that is named holds it; {holds}", plain(uid))));
    }
    Ok(out)
}
