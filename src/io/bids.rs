//! Pairs from a folder in the Brain Imaging Data Structure (bids-specification.readthedocs.io), and
//! its derivatives: fields named as transforms (BEP 014).

use super::batch::make_folder;
use super::text::{list, read_json, write_json, write_text};
use super::{format, os};
use crate::error::IoError;
use crate::types::batch::Pair;
use serde_json::json;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// The file that a data set begins with.
const DESCRIPTION: &str = "dataset_description.json";
/// The version of the specification that is written.
const VERSION: &str = "1.10.0";

/// An anatomical image: its file, and the entities of its name.
#[derive(Debug, Clone)]
struct Scan {
    path: PathBuf,
    session: String,
    run: String,
}

/// What the images of a series share: subject, other entities and suffix.
type Series = BTreeMap<(String, String), Vec<Scan>>;

/// Whether a folder is a BIDS data set.
pub fn is_bids(folder: impl AsRef<Path>) -> bool {
    folder.as_ref().join(DESCRIPTION).is_file()
}

/// The pairs of a BIDS data set: of each subject the runs of one kind of anatomical image, each
/// against the first of its session; where no session has two runs, the sessions, each against the
/// first.
///
/// # Errors
/// [`IoError`] when a folder cannot be read, or no subject has two runs or sessions.
pub fn read_bids(folder: impl AsRef<Path>) -> Result<Vec<Pair>, IoError> {
    let folder = folder.as_ref();
    let mut series = Series::new();
    for subject in folders(folder, "sub-")? {
        let sessions = folders(&subject, "ses-")?;
        for place in sessions.iter().chain([&subject]).map(|p| p.join("anat")).filter(|p| p.is_dir()) {
            list(&place)?.into_iter().for_each(|path| add(&mut series, path));
        }
    }
    let pairs: Vec<Pair> = series.values().flat_map(|scans| pairs(scans)).collect();
    if pairs.is_empty() {
        let what = "no subject has two runs or two sessions of one anatomical image";
        return Err(format(folder, what, "name them run-1, run-2 (or ses-1, ses-2), or give a table of pairs"));
    }
    Ok(pairs)
}

/// The folders in `folder` whose names begin with `key`.
fn folders(folder: &Path, key: &str) -> Result<Vec<PathBuf>, IoError> {
    let named = |p: &PathBuf| p.is_dir() && p.file_name().is_some_and(|n| n.to_string_lossy().starts_with(key));
    Ok(list(folder)?.into_iter().filter(named).collect())
}

/// The name of an image without its folder and extension.
fn stem(path: &Path) -> Option<String> {
    let name = path.file_name()?.to_str()?;
    Some(name.strip_suffix(".nii.gz").or(name.strip_suffix(".nii"))?.to_string())
}

/// The value of an entity of a name.
fn entity<'a>(stem: &'a str, key: &str) -> &'a str {
    stem.split('_').find_map(|part| part.strip_prefix(key)).unwrap_or_default()
}

fn add(series: &mut Series, path: PathBuf) {
    let Some(stem) = stem(&path) else { return };
    let [session, run] = ["ses-", "run-"].map(|key| entity(&stem, key).to_string());
    let shared = |part: &&str| !part.starts_with("ses-") && !part.starts_with("run-");
    let kind = stem.split('_').filter(shared).collect::<Vec<_>>().join("_");
    series.entry((entity(&stem, "sub-").into(), kind)).or_default().push(Scan { path, session, run });
}

/// A run's or session's place in the order: numbers count as numbers.
fn order(label: &str) -> (u64, &str) {
    (label.parse().unwrap_or(u64::MAX), label)
}

fn pairs(scans: &[Scan]) -> Vec<Pair> {
    let mut scans = scans.to_vec();
    scans.sort_by(|a, b| (order(&a.session), order(&a.run)).cmp(&(order(&b.session), order(&b.run))));
    let of =
        |group: &[&Scan]| -> Vec<Pair> { group.iter().skip(1).filter_map(|second| pair(group[0], second)).collect() };
    let mut sessions: BTreeMap<(u64, &str), Vec<&Scan>> = BTreeMap::new();
    scans.iter().for_each(|scan| sessions.entry(order(&scan.session)).or_default().push(scan));
    let within: Vec<Pair> = sessions.values().flat_map(|runs| of(runs)).collect();
    if within.is_empty() { of(&scans.iter().collect::<Vec<_>>()) } else { within }
}

fn pair(initial: &Scan, deformed: &Scan) -> Option<Pair> {
    let name = stem(&deformed.path)?;
    Some(Pair {
        subject: entity(&name, "sub-").into(),
        session: deformed.session.clone(),
        name,
        initial: initial.path.clone(),
        deformed: deformed.path.clone(),
        ..Pair::default()
    })
}

/// Writes what makes a folder of results a BIDS derivative of the data set `source`; its own files
/// and folders, other than subjects, are left to `.bidsignore`.
///
/// # Errors
/// [`IoError`] when a file cannot be written.
pub fn describe_derivative(output: impl AsRef<Path>, source: impl AsRef<Path>) -> Result<(), IoError> {
    let (output, source) = (output.as_ref(), source.as_ref());
    let name = read_json(source.join(DESCRIPTION)).ok().and_then(|d| d["Name"].as_str().map(String::from));
    let name = name.unwrap_or_else(|| "unnamed".into());
    let description = json!({
        "Name": format!("palpate: {name}"),
        "BIDSVersion": VERSION,
        "DatasetType": "derivative",
        "GeneratedBy": [{ "Name": "palpate", "Version": env!("CARGO_PKG_VERSION") }],
        "SourceDatasets": [{ "URL": fs::canonicalize(source).map_err(os(source, "read"))?.to_string_lossy() }],
    });
    write_json(output.join(DESCRIPTION), &description)?;
    let readme = "Displacement fields by palpate. sub-*/ holds them as BIDS transforms; the folders in pairs/ hold all results \
                  and their reports.\n";
    write_text(output.join("README.md"), readme)?;
    write_text(
        output.join(".bidsignore"),
        "pairs\npairs/**\nbatch.csv\nregions.csv\nsummary.json\nreport.html\n*_xfm.*\n",
    )
}

/// Places the field of a pair among the derivatives of `output`, as the transform that takes the
/// deformed image to the initial one's space, with a sidecar; `field` is the folder of its results.
///
/// # Errors
/// [`IoError`] when a file cannot be written.
pub fn write_derivative(
    output: impl AsRef<Path>,
    source: impl AsRef<Path>,
    pair: &Pair,
    field: impl AsRef<Path>,
) -> Result<PathBuf, IoError> {
    let name = stem(&pair.initial).unwrap_or_default();
    let [sessions, runs] = ["ses-", "run-"].map(|key| {
        let second = stem(&pair.deformed).unwrap_or_default();
        [&second, &name].map(|n| entity(n, key).to_string())
    });
    let one_session = sessions[0] == sessions[1];
    let label = |i: usize| if one_session { format!("run{}", runs[i]) } else { format!("ses{}", sessions[i]) };
    let shared = |part: &&str| !(part.starts_with("run-") || !one_session && part.starts_with("ses-"));
    let mut parts: Vec<&str> = name.split('_').filter(shared).collect();
    let suffix = parts.pop().unwrap_or_default();
    let kind = format!("{}_from-{}_to-{}_mode-image_desc-{suffix}_xfm", parts.join("_"), label(0), label(1));

    let mut folder = output.as_ref().join(format!("sub-{}", pair.subject));
    if one_session && !sessions[1].is_empty() {
        folder = folder.join(format!("ses-{}", sessions[1]));
    }
    let folder = folder.join("anat");
    make_folder(&folder)?;
    let target = folder.join(format!("{kind}.nii.gz"));
    let made = field.as_ref().join("displacement.nii.gz");
    let _ = fs::remove_file(&target);
    if fs::hard_link(&made, &target).is_err() {
        fs::copy(&made, &target).map_err(os(&target, "write"))?;
    }
    let at = |path: &Path| {
        let inside = path.strip_prefix(source.as_ref()).unwrap_or(path);
        format!("bids:raw:{}", inside.to_string_lossy())
    };
    let sidecar = json!({
        "Description": "Displacement from the image before to the image after the deformation (mm, LPS), on the grid of the former",
        "Sources": [at(&pair.initial), at(&pair.deformed)],
        "Units": "mm",
    });
    write_json(folder.join(format!("{kind}.json")), &sidecar)?;
    Ok(target)
}
