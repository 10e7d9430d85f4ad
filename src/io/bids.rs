//! Pairs from a folder in the Brain Imaging Data Structure (bids-specification.readthedocs.io), and
//! its derivatives: fields named as transforms (BEP 014).

use super::atomic::write_atomic;
use super::batch::make_folder;
use super::source::open;
use super::text::{list, read_json, write_json, write_text};
use super::{format, os};
use crate::error::{IoError, Shown};
use crate::types::batch::Pair;
use serde_json::json;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// The file that a data set begins with.
const DESCRIPTION: &str = "dataset_description.json";
/// The version of the specification that is written.
const VERSION: &str = "1.10.0";
/// Folder of the pairs' results beside the derivatives.
const PAIRS: &str = "pairs";

/// An anatomical image: its file, its name without the extension, and two entities of that.
#[derive(Debug, Clone)]
struct Scan {
    path: PathBuf,
    stem: String,
    session: String,
    run: String,
}

impl Scan {
    /// None of a file that is no image, or holds a mask or labels.
    fn of(path: &Path) -> Option<Self> {
        let name = path.file_name()?.to_str()?;
        let stem = name.strip_suffix(".nii.gz").or(name.strip_suffix(".nii"))?.to_string();
        let suffix = stem.rsplit('_').next().unwrap_or_default();
        if suffix.ends_with("mask") || suffix.ends_with("seg") {
            return None;
        }
        let [session, run] = ["ses-", "run-"].map(|key| entity(&stem, key).to_string());
        Some(Self { path: path.into(), stem, session, run })
    }

    /// Its place in time: session, then run, numbers as numbers. A session is a label in BIDS, a
    /// run a number: ses-1 and ses-01 are two sessions, run-1 and run-01 one run.
    fn order(&self) -> [(u64, &str); 2] {
        let [session, run] = [&self.session, &self.run].map(|l| (l.parse().unwrap_or(u64::MAX), l.as_str()));
        [session, if run.0 < u64::MAX { (run.0, "") } else { run }]
    }
}

/// What the images of a series share: subject, other entities and suffix.
type Series = BTreeMap<(String, String), Vec<Scan>>;

/// Whether a folder is a BIDS data set.
pub(crate) fn is_bids(folder: impl AsRef<Path>) -> bool {
    folder.as_ref().join(DESCRIPTION).is_file()
}

/// The pairs of a BIDS data set: of each subject the runs of one kind of anatomical image, each
/// against the first of its session; where no session has two runs, the sessions, each against the
/// first.
///
/// # Errors
/// [`IoError`] when a folder or the description cannot be read, the data set has no name, two files
/// are one image, or no subject has two runs or sessions.
pub(crate) fn read_bids(folder: impl AsRef<Path>) -> Result<Vec<Pair>, IoError> {
    let folder = folder.as_ref();
    name(folder)?;
    let mut series = Series::new();
    for subject in folders(folder, "sub-")? {
        let sessions = folders(&subject, "ses-")?;
        for place in sessions.iter().chain([&subject]).map(|p| p.join("anat")).filter(|p| p.is_dir()) {
            for scan in list(&place)?.iter().filter_map(|path| Scan::of(path)) {
                add(&mut series, scan)?;
            }
        }
    }
    let pairs: Vec<Pair> = series.into_values().flat_map(pairs).collect();
    if pairs.is_empty() {
        let what = "no subject has two runs or two sessions of one anatomical image";
        return Err(format(folder, what, "name them run-1, run-2 (or ses-1, ses-2), or give a table of pairs"));
    }
    Ok(pairs)
}

/// The name of a data set.
fn name(folder: &Path) -> Result<String, IoError> {
    let path = folder.join(DESCRIPTION);
    match read_json(&path)?["Name"].as_str() {
        Some(name) => Ok(name.into()),
        None => Err(format(&path, "has no key Name", "add it: BIDS asks for the name of the data set")),
    }
}

/// The folders in `folder` whose names begin with `key`.
fn folders(folder: &Path, key: &str) -> Result<Vec<PathBuf>, IoError> {
    let named = |p: &PathBuf| p.is_dir() && p.file_name().is_some_and(|n| n.to_string_lossy().starts_with(key));
    Ok(list(folder)?.into_iter().filter(named).collect())
}

/// The value of an entity of a name.
fn entity<'a>(stem: &'a str, key: &str) -> &'a str {
    stem.split('_').find_map(|part| part.strip_prefix(key)).unwrap_or_default()
}

fn add(series: &mut Series, scan: Scan) -> Result<(), IoError> {
    let shared = |part: &&str| !part.starts_with("ses-") && !part.starts_with("run-");
    let kind = scan.stem.split('_').filter(shared).collect::<Vec<_>>().join("_");
    let scans = series.entry((entity(&scan.stem, "sub-").into(), kind)).or_default();
    if let Some(other) = scans.iter().find(|other| other.order() == scan.order()) {
        let what = format!("is the same run as {}", other.path.shown());
        return Err(format(&scan.path, what, "give each run a label of its own, and keep one file of it"));
    }
    scans.push(scan);
    Ok(())
}

fn pairs(mut scans: Vec<Scan>) -> Vec<Pair> {
    scans.sort_by(|a, b| a.order().cmp(&b.order()));
    let of = |group: &[Scan]| -> Vec<Pair> { group.iter().skip(1).map(|second| pair(&group[0], second)).collect() };
    let within: Vec<Pair> = scans.chunk_by(|a, b| a.session == b.session).flat_map(of).collect();
    if within.is_empty() { of(&scans) } else { within }
}

fn pair(initial: &Scan, deformed: &Scan) -> Pair {
    Pair {
        name: deformed.stem.clone(),
        folder: format!("{PAIRS}/{}", deformed.stem),
        subject: entity(&deformed.stem, "sub-").into(),
        session: deformed.session.clone(),
        initial: initial.path.clone(),
        deformed: deformed.path.clone(),
        ..Pair::default()
    }
}

/// Writes what makes a folder of results a BIDS derivative of the data set `source`; its own files
/// and folders, other than subjects, are left to `.bidsignore`.
///
/// # Errors
/// [`IoError`] when a file cannot be written.
pub(crate) fn describe_derivative(output: impl AsRef<Path>, source: impl AsRef<Path>) -> Result<(), IoError> {
    let (output, source) = (output.as_ref(), source.as_ref());
    let description = json!({
        "Name": format!("palpate: {}", name(source)?),
        "BIDSVersion": VERSION,
        "DatasetType": "derivative",
        "GeneratedBy": [{ "Name": "palpate", "Version": env!("CARGO_PKG_VERSION") }],
        "SourceDatasets": [{ "URL": fs::canonicalize(source).map_err(os(source, "read"))?.to_string_lossy() }],
    });
    write_json(output.join(DESCRIPTION), &description)?;
    let readme = output.join("README.md");
    let about = "Displacement fields by palpate. sub-*/ holds them as BIDS transforms; the folders in pairs/ hold all results \
                  and their reports.\n";
    // Who works with the folder may have written more.
    if !readme.exists() {
        write_text(readme, about)?;
    }
    let ours = "pairs\npairs/**\nbatch.csv\nregions.csv\nsummary.json\nreport.html\n*_xfm.*\n";
    write_text(output.join(".bidsignore"), ours)
}

/// Places the field of a pair among the derivatives of `output`, as the transform that takes the
/// deformed image to the initial one's space, with a sidecar. Without a `result`, one of an earlier
/// run is removed.
///
/// # Errors
/// [`IoError`] when a file cannot be written.
pub(crate) fn write_derivative(
    output: impl AsRef<Path>,
    source: impl AsRef<Path>,
    pair: &Pair,
    result: bool,
) -> Result<(), IoError> {
    let (output, source) = (output.as_ref(), source.as_ref());
    let Some((first, second)) = Scan::of(&pair.initial).zip(Scan::of(&pair.deformed)) else { return Ok(()) };
    let one_session = first.session == second.session;
    let label = |scan: &Scan| match one_session {
        true => format!("run{}", scan.run),
        false => format!("ses{}", scan.session),
    };
    let shared = |part: &&str| !part.starts_with("run-") && (one_session || !part.starts_with("ses-"));
    let mut parts: Vec<&str> = first.stem.split('_').filter(shared).collect();
    let suffix = parts.pop().unwrap_or_default();
    let entities = parts.join("_");
    let name = format!("{entities}_from-{}_to-{}_mode-image_desc-{suffix}_xfm", label(&second), label(&first));

    let mut folder = output.join(format!("sub-{}", pair.subject));
    if one_session && !first.session.is_empty() {
        folder.push(format!("ses-{}", first.session));
    }
    folder.push("anat");
    let [field, sidecar] = ["nii.gz", "json"].map(|end| folder.join(format!("{name}.{end}")));
    // A link or a copy does not follow a field that is measured again.
    for path in [&field, &sidecar].into_iter().filter(|path| path.exists()) {
        fs::remove_file(path).map_err(os(path, "remove"))?;
    }
    if !result {
        return Ok(());
    }
    make_folder(&folder)?;
    let made = output.join(&pair.folder).join("field/displacement.nii.gz");
    // Without links a copy takes its room again.
    if fs::hard_link(&made, &field).is_err() {
        let mut whole = open(&made)?;
        write_atomic(&field, |file| std::io::copy(&mut whole, file).map(drop))?;
    }
    let at = |path: &Path| {
        let inside = path.strip_prefix(source).unwrap_or(path);
        format!("bids:raw:{}", inside.to_string_lossy())
    };
    let about = json!({
        "Description": "Displacement from the image before to the image after the deformation (mm, LPS), on the grid of the former",
        "Sources": [at(&pair.initial), at(&pair.deformed)],
        "Units": "mm",
    });
    write_json(sidecar, &about)
}
