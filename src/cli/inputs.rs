//! Reading inputs, and the checks that can be made before any work.

use super::Usage;
use super::console::Console;
use anyhow::{Result, anyhow, bail};
use clap::builder::{PathBufValueParser, TypedValueParser};
use palpate::error::FieldError;
use palpate::error::Shown;
use palpate::evaluate;
use palpate::field::warp::{labels_onto, warp_image};
use palpate::io::{self, ImageKind, Stored};
use palpate::numerics::sampling::Interpolation;
use palpate::types::{DenseField, Grid, Landmark, Mask, Volume, Voxels};
use std::path::{Path, PathBuf};

/// The last part of a path, for messages and reports.
pub fn name(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).shown()
}

/// Whether two paths name one existing file.
pub fn same_file(a: &Path, b: &Path) -> bool {
    matches!((a.canonicalize(), b.canonicalize()), (Ok(a), Ok(b)) if a == b)
}

/// What is asked for where a folder may stand for one of its files.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    Initial,
    Deformed,
    Field,
    Truth,
    Labels,
    Mask,
    Matches,
    Landmarks,
}

impl Part {
    /// What it is called, and the files of palpate that hold it, the first that is there.
    fn files(self) -> (&'static str, &'static [&'static str]) {
        match self {
            Self::Initial => ("initial volume", &["initial.nii.gz"]),
            Self::Deformed => ("deformed volume", &["deformed.nii.gz"]),
            Self::Field => ("displacement field", &["displacement.nii.gz", "truth.nii.gz"]),
            Self::Truth => ("exact displacement", &["truth.nii.gz", "displacement.nii.gz"]),
            Self::Labels => ("label map", &["labels.nii.gz", "regions.nii.gz", "bodies.nii.gz"]),
            Self::Mask => ("mask", &["mask.nii.gz", "bodies.nii.gz", "regions.nii.gz", "labels.nii.gz"]),
            Self::Matches => ("table of matches", &["matches.csv"]),
            Self::Landmarks => ("table of landmarks", &["landmarks.csv"]),
        }
    }

    /// Whether a folder with a DICOM series can be it.
    fn can_be_dicom(self) -> bool {
        matches!(self, Self::Initial | Self::Deformed | Self::Labels | Self::Mask)
    }

    /// The file that `path` stands for: itself, or the one of a folder that holds this part.
    ///
    /// # Errors
    /// When the folder has no such file; says what it has. The path is not named.
    fn of(self, path: &Path) -> Result<PathBuf, String> {
        if !path.is_dir() {
            return Ok(path.into());
        }
        let (what, names) = self.files();
        if let Some(found) = names.iter().map(|name| path.join(name)).find(|file| file.is_file()) {
            return match io::read_header(&found) {
                Ok((_, ImageKind::Fields)) => Err(format!(
                    "holds the fields of a sequence in {}; name that of one frame, such as displacement_001.nii.gz",
                    name(&found)
                )),
                _ => Ok(found),
            };
        }
        let volume = matches!(self, Self::Initial | Self::Deformed);
        if volume || (self.can_be_dicom() && io::read_header(path).is_ok()) {
            return Ok(path.into());
        }
        let all = io::list(path).map_err(|e| e.to_string())?;
        let shown: Vec<String> = all.iter().take(MAX_FILES_SHOWN).map(|file| name(file)).collect();
        let holds = match all.len() {
            0 => "it is empty".into(),
            n if n > MAX_FILES_SHOWN => format!("it has {}, and {} more", shown.join(", "), n - MAX_FILES_SHOWN),
            _ => format!("it has {}", shown.join(", ")),
        };
        Err(format!("is a folder without a {what} ({}); {holds}; name the file", names.join(" or ")))
    }
}

/// Files of a folder that a message lists at most.
const MAX_FILES_SHOWN: usize = 12;

/// The file that `path` stands for where `part` is asked for: itself, or that of a folder which
/// palpate wrote. A folder with a DICOM series stands for itself.
///
/// # Errors
/// When the folder has no such file; says what it has.
pub fn file_of(path: &Path, part: Part) -> Result<PathBuf> {
    part.of(path).map_err(|why| anyhow!("{}: {why}", path.shown()))
}

/// The same for an argument of the command line.
pub fn standing_for(part: Part) -> impl TypedValueParser<Value = PathBuf> {
    PathBufValueParser::new().try_map(move |path| part.of(&path))
}

/// Whether writing `output` would replace `input`, or a file of the folder `input`.
fn replaces(output: &Path, input: &Path) -> bool {
    let beside = || output.is_file() && output.parent().is_some_and(|folder| same_file(input, folder));
    same_file(input, output) || (input.is_dir() && beside())
}

/// An output must not replace an input.
pub fn check_distinct(inputs: &[&Path], outputs: &[PathBuf]) -> Result<()> {
    for output in outputs {
        if let Some(input) = inputs.iter().find(|input| replaces(output, input)) {
            bail!(Usage(format!("{} is an input and would be overwritten; choose another --output", input.shown())));
        }
    }
    Ok(())
}

/// One output file: its folder must be there, and its name end in one of `endings`.
pub fn check_output_file(path: &Path, endings: &[&str]) -> Result<()> {
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    if !folder.is_dir() {
        let what = if folder.exists() { "is not a folder" } else { "does not exist" };
        bail!(
            "{}: cannot be written, because {} {what}; create it or choose another --output",
            path.shown(),
            folder.shown()
        );
    }
    if path.is_dir() {
        bail!(Usage(format!("{} is a folder; give --output the name of a file", path.shown())));
    }
    if !endings.iter().any(|e| name(path).to_lowercase().ends_with(e)) {
        bail!(Usage(format!("{}: the name must end in {}", path.shown(), endings.join(" or "))));
    }
    Ok(())
}

/// Says so where a header places its volume in two ways that are a tenth of a voxel apart or more.
pub fn two_places(stored: &Stored) -> Option<String> {
    let edge = stored.grid.least_spacing();
    let apart = stored.apart_mm.filter(|a| *a > 0.1 * edge)?;
    Some(format!("its sform and qform disagree by up to {apart:.2} mm; the sform is used"))
}

/// The same of a file or a folder, as a warning that names it.
pub fn warn_of_two_places(path: &Path, warnings: &mut Vec<String>) {
    if let Ok((stored, _)) = io::read_header(path) {
        warn_of_places(path, &stored, warnings);
    }
}

/// The same of what is known to be stored there.
pub fn warn_of_places(path: &Path, stored: &Stored, warnings: &mut Vec<String>) {
    warnings.extend(two_places(stored).map(|w| format!("{}: {w}", path.shown())));
}

/// A volume to measure on; warns of two placements and about single voxels without a number and
/// refuses a volume without any.
pub fn read_volume(path: &Path, warnings: &mut Vec<String>) -> Result<Volume> {
    warn_of_two_places(path, warnings);
    usable(io::read_volume(path)?, &path.shown(), warnings)
}

/// Warns of single voxels of `volume`, called `path`, that are no number.
pub fn warn_of_non_finite(volume: &Volume, path: &str, warnings: &mut Vec<String>) {
    let (bad, all) = (io::count_non_finite(volume), volume.grid().len());
    if (1..all).contains(&bad) {
        let short = name(Path::new(path));
        warnings.push(format!("{short}: {bad} of {all} voxels are NaN or infinite and are not used"));
    }
}

/// `volume`, called `path`, if something can be found in it.
pub fn usable(volume: Volume, path: &str, warnings: &mut Vec<String>) -> Result<Volume> {
    warn_of_non_finite(&volume, path, warnings);
    let mut finite = volume.as_slice().iter().filter(|v| v.is_finite());
    let Some(first) = finite.next() else {
        bail!("{path}: every voxel is NaN or infinite; export it again");
    };
    if finite.all(|v| v == first) {
        bail!("{path}: every voxel has the same value, so nothing can be found in it; check the file");
    }
    Ok(volume)
}

/// The volume as it is, or resampled where it lies on another grid.
pub fn on_grid<'a>(volume: Voxels<'a>, grid: &Grid) -> Voxels<'a> {
    match volume.grid() == grid {
        true => volume,
        false => warp_image(&volume, &DenseField::zeros(*grid), None, Interpolation::Linear, 0.0),
    }
}

/// A mask on `grid`, which is that of `reference`, by [`resampled`].
pub fn read_mask(path: &Path, grid: &Grid, reference: &Path, warnings: &mut Vec<String>) -> Result<Mask> {
    resampled(path, some_mask(path)?, grid, reference, warnings)
}

/// A mask on its own grid that is not empty.
pub fn some_mask(path: &Path) -> Result<Mask> {
    let mask = io::read_mask(path)?;
    if mask.as_slice().iter().all(|v| *v == 0) {
        bail!("{}: the mask is empty; give one that is 1 in the tissue", path.shown());
    }
    Ok(mask)
}

/// A label map on `grid`, which is that of `reference`, by [`resampled`].
pub fn read_labels(path: &Path, grid: &Grid, reference: &Path, warnings: &mut Vec<String>) -> Result<Mask> {
    resampled(path, some_labels(path)?, grid, reference, warnings)
}

/// A label map on its own grid, with a label at least.
pub fn some_labels(path: &Path) -> Result<Mask> {
    let labels = io::read_labels(path)?;
    if labels.as_slice().iter().all(|v| *v == 0) {
        bail!("{}: no voxel has a label; give a label map that is 1 or more in each region", path.shown());
    }
    Ok(labels)
}

/// What was read from `path`, on `grid`: resampled by nearest neighbour, with a note, where it lies
/// on another one.
pub fn resampled(path: &Path, labels: Mask, grid: &Grid, reference: &Path, warnings: &mut Vec<String>) -> Result<Mask> {
    let elsewhere = |_| FieldError::Elsewhere { what: path.shown(), reference: reference.shown() };
    let (placed, note) = labels_onto(labels, grid, [&name(path), &name(reference)]).map_err(elsewhere)?;
    warnings.extend(note);
    Ok(placed)
}

/// What was read from `path` must lie on `grid`, which is that of `reference`.
pub fn same_grid(path: &Path, found: &Grid, grid: &Grid, reference: &Path) -> Result<()> {
    if !grid.same_as(found) {
        bail!(FieldError::GridMismatch {
            what: path.shown(),
            found: found.shape(),
            reference: reference.shown(),
            expected: grid.shape(),
        });
    }
    Ok(())
}

/// Landmarks of one table, or of two files of points, in the volume on `grid`; warns of those that
/// lie outside it.
///
/// # Errors
/// When a file cannot be read, or all of them lie outside.
pub fn read_landmarks(files: &[PathBuf], grid: &Grid, warnings: &mut Vec<String>) -> Result<Vec<Landmark>> {
    let (file, landmarks) = match files {
        [initial, deformed] => (initial, io::read_landmark_pair(initial, deformed)?),
        [one, ..] => (one, io::read_landmarks(one)?),
        [] => return Ok(Vec::new()),
    };
    let outside = evaluate::beyond(grid, &landmarks);
    let Some(&first) = outside.first() else { return Ok(landmarks) };
    let [x, y, z] = landmarks[first].initial.0;
    let said = format!(
        "{}: {} of {} landmarks lie outside the initial volume (the first is number {}, at {x:.1}, {y:.1}, {z:.1})",
        file.shown(),
        outside.len(),
        landmarks.len(),
        first + 1
    );
    let hint = "places are world mm, RAS; those in LPS have x and y with the other sign";
    if outside.len() == landmarks.len() {
        bail!("{said}, so none can be scored; {hint}");
    }
    warnings.push(format!("{said}, and the field's edge stands for it; {hint}"));
    Ok(landmarks)
}

/// All warnings, once.
pub fn warn_all(console: &Console, warnings: &[String]) {
    warnings.iter().for_each(|w| console.warn(w));
}
