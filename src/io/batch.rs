//! Tables of pairs and of their results, and what tells whether a file is still the same.

use super::csv::{damaged, open_table, write_table};
use super::scene::known_names;
use super::{format, os};
use crate::error::IoError;
use crate::types::batch::Pair;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

/// Files of a batch beside the folders of its pairs.
const RESERVED: [&str; 4] = ["batch.csv", "regions.csv", "summary.json", "report.html"];

/// Columns of a table of pairs; the first two are needed.
pub(crate) const PAIR_COLUMNS: [&str; 16] = [
    "initial",
    "deformed",
    "mask",
    "start",
    "deformed_mask",
    "ignore",
    "landmarks",
    "labels",
    "names",
    "held",
    "load",
    "force_n",
    "scene",
    "name",
    "subject",
    "session",
];

/// No table has more: each takes some hundred bytes of memory, whatever its line.
const MAX_PAIRS: usize = 100_000;

/// Reads a table of pairs: comma-separated, one header line with some of `PAIR_COLUMNS` in any
/// order, `initial` and `deformed` among them. Paths count from the table's folder. An empty place
/// is as a column left out. Without a name a pair is called `sub-<subject>_ses-<session>`, or
/// `pair-<line>` without a subject. Whether the files are there is not looked at.
///
/// # Errors
/// [`IoError`] names the line: an unknown column (with the nearest known one), no initial or
/// deformed volume, a force that is no number, a name that two pairs have or that cannot name a
/// folder; also when there is no pair.
pub fn read_pairs(path: impl AsRef<Path>) -> Result<Vec<Pair>, IoError> {
    let path = path.as_ref();
    let folder = path.parent().unwrap_or(Path::new(""));
    let (header, mut reader) = open_table(path)?;
    let header: Vec<String> = header.iter().map(str::to_lowercase).collect();
    known_names(path, "line 1", header.iter().map(String::as_str), &PAIR_COLUMNS)?;
    let mut lines = BTreeMap::new();
    let mut pairs = Vec::new();
    for record in reader.records() {
        let record = record.map_err(|e| damaged(path, e))?;
        if pairs.len() == MAX_PAIRS {
            return Err(format(path, format!("has more than {MAX_PAIRS} pairs"), "divide the table"));
        }
        let line = record.position().map_or(0, csv::Position::line);
        let flaw = |what: String, hint: &str| format(path, format!("line {line}: {what}"), hint);
        let text = |column: &str| {
            let at = header.iter().position(|h| h == column)?;
            Some(record[at].to_string()).filter(|v| !v.is_empty())
        };
        let file = |column: &str| text(column).map(|v| folder.join(v));
        let files = |column: &str| -> Vec<PathBuf> {
            text(column).map(|v| v.split(';').map(|one| folder.join(one.trim())).collect()).unwrap_or_default()
        };
        let needed = |column: &str| {
            file(column).ok_or_else(|| flaw(format!("there is no {column} volume"), "fill in that column"))
        };
        // A side of the body stays as it is, a file counts from the table.
        let side = |column: &str| {
            let at_table = |v: String| if v.len() == 2 { v } else { folder.join(v).to_string_lossy().into_owned() };
            text(column).map(at_table)
        };
        let force_n = match text("force_n") {
            None => None,
            Some(v) => Some(v.parse().ok().filter(|f: &f64| f.is_finite() && *f > 0.0).ok_or_else(|| {
                flaw(format!("force_n is {v:?}, not a number above 0"), "give the total force in N, or leave it empty")
            })?),
        };
        let (subject, session) = (text("subject").unwrap_or_default(), text("session").unwrap_or_default());
        let entity = |key: &str, v: &str| if v.starts_with(key) { v.to_string() } else { format!("{key}{v}") };
        let called = || match (subject.as_str(), session.as_str()) {
            ("", _) => format!("pair-{line}"),
            (who, "") => entity("sub-", who),
            (who, when) => format!("{}_{}", entity("sub-", who), entity("ses-", when)),
        };
        let name = text("name").unwrap_or_else(called);
        let fit = name.chars().all(|c| c.is_alphanumeric() || "-_.+".contains(c)) && !name.starts_with('.');
        if RESERVED.contains(&name.as_str()) {
            return Err(flaw(format!("{name:?} is the name of a file of the results"), "call the pair something else"));
        }
        if !fit {
            return Err(flaw(format!("{name:?} cannot name a folder"), "use letters, digits, - and _"));
        }
        if let Some(other) = lines.insert(name.clone(), line) {
            return Err(flaw(format!("{name} is the name of line {other} too"), "give each pair a name of its own"));
        }
        pairs.push(Pair {
            initial: needed("initial")?,
            deformed: needed("deformed")?,
            mask: file("mask"),
            start: text("start")
                .map(|t| t.split(';').map(|one| start(folder, one.trim())).collect())
                .unwrap_or_default(),
            deformed_mask: file("deformed_mask"),
            ignore: files("ignore"),
            landmarks: files("landmarks"),
            labels: file("labels"),
            names: text("names").map(|n| n.replace(';', ",")),
            held: side("held"),
            load: side("load"),
            force_n,
            scene: file("scene"),
            folder: name.clone(),
            name,
            subject,
            session,
        });
    }
    match pairs.is_empty() {
        true => Err(format(path, "there is no pair after the header line", "give at least one")),
        false => Ok(pairs),
    }
}

/// A start of a pair: the name of an alignment stays as it is, a file counts from the table,
/// whatever stands before its name.
fn start(folder: &Path, text: &str) -> String {
    let (source, path) = text.split_once(':').map_or(("", text), |(source, path)| (source, path));
    match (source, path) {
        ("", "centre" | "center" | "moments" | "principal") => text.to_string(),
        ("", path) => folder.join(path).to_string_lossy().into_owned(),
        (source, path) => format!("{source}:{}", folder.join(path).to_string_lossy()),
    }
}

/// Writes a table: a header line, then `rows`, which are as long.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub(crate) fn write_rows(path: impl AsRef<Path>, columns: &[&str], rows: Vec<Vec<String>>) -> Result<(), IoError> {
    write_table(path.as_ref(), columns, rows.into_iter())
}

/// Bytes and the time of the last change (whole ns since 1970) of a file, or of all files in a
/// folder together.
///
/// # Errors
/// [`IoError`] when it is not there or cannot be read.
pub(crate) fn stamp(path: impl AsRef<Path>) -> Result<(u64, u64), IoError> {
    let path = path.as_ref();
    let beside = super::image::others(path);
    let own = if path.is_dir() { super::list(path)? } else { vec![path.to_path_buf()] };
    let files: Vec<PathBuf> = own.into_iter().chain(beside).collect();
    let mut whole = (0, 0);
    for file in files {
        let meta = fs::metadata(&file).map_err(os(&file, "read"))?;
        let changed = meta.modified().ok().and_then(|t| t.duration_since(UNIX_EPOCH).ok());
        whole =
            (whole.0 + meta.len(), whole.1.max(changed.map_or(0, |d| u64::try_from(d.as_nanos()).unwrap_or(u64::MAX))));
    }
    Ok(whole)
}

/// Makes a folder and those above it.
///
/// # Errors
/// [`IoError`] when that is refused.
pub(crate) fn make_folder(path: impl AsRef<Path>) -> Result<(), IoError> {
    fs::create_dir_all(path.as_ref()).map_err(os(path.as_ref(), "create the folder"))
}
