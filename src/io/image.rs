//! Volumes, label maps and fields from any format that is read: NIfTI, NRRD, MetaImage, and a
//! folder with a DICOM series.
//!
//! The format is known by the first bytes, and by the name only for MetaImage, which has no magic.
//! Everything comes to RAS: NRRD says which space it is in, MetaImage and DICOM are LPS.

use super::format_error::Flaw;
use super::raw::RawImage;
use super::{dicom, format, metaimage, nifti, nrrd, source};
use crate::error::IoError;
use crate::types::{Grid, Mask, Volume, Voxels};
use std::path::{Path, PathBuf};

/// Formats by their first bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Format {
    Nifti,
    Nrrd,
    MetaImage,
    /// A folder with a series, or a file of one.
    Dicom,
}

impl Format {
    /// Of the file or folder at `path`.
    pub(super) fn of(path: &Path) -> Result<Self, IoError> {
        if path.is_dir() {
            return Ok(Self::Dicom);
        }
        let whole = source::head(path, dicom::PREAMBLE_AND_MARK_BYTES as u64)?;
        if dicom::is_dicom(&whole) {
            return Ok(Self::Dicom);
        }
        let head = &whole[..whole.len().min(64)];
        if let Some((name, command)) = source::packing(head) {
            return Err(format(
                path,
                format!("is packed with {name}, which is not read"),
                format!("unpack it: {command}"),
            ));
        }
        let name = path.to_string_lossy().to_lowercase();
        let text = head.iter().all(|b| b.is_ascii_graphic() || b.is_ascii_whitespace());
        let meta = [".mha", ".mhd"].iter().any(|e| name.ends_with(e)) && text && head.contains(&b'=');
        Ok(match head.starts_with(b"NRRD000") {
            true => Self::Nrrd,
            false if meta => Self::MetaImage,
            false => Self::Nifti,
        })
    }
}

/// How an image is stored.
#[derive(Debug, Clone, PartialEq)]
pub struct Stored {
    /// As `NIfTI-1, gzip`.
    pub format: &'static str,
    /// As `int16`.
    pub datatype: &'static str,
    /// Lengths of all axes.
    pub axes: Vec<usize>,
    /// Where the position in space comes from.
    pub placed: &'static str,
    /// How far two placements in one header are apart at a corner of the volume, where there are
    /// two (mm).
    pub apart_mm: Option<f64>,
    /// The first three axes.
    pub grid: Grid,
    /// Whether the header says that it is a label map (NIfTI's intent 1002).
    pub labels: bool,
    /// Size of the file with the voxels.
    pub bytes: u64,
    /// What the header says the image is; empty where it says nothing.
    pub description: String,
}

/// What an image file holds, by its header alone.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ImageKind {
    /// One number a voxel.
    Scalar,
    /// Three numbers a voxel.
    Field,
    /// Volumes one after the other.
    Series,
    /// Displacement fields one after the other, as `palpate track` writes them.
    Fields,
    /// Symmetric tensors, as `palpate track` writes strain.
    Tensors,
    /// Something that palpate does not read.
    Other,
}

/// Reads only the header of an image.
///
/// # Errors
/// [`IoError`] when the file cannot be read or its header is damaged.
pub fn read_header(path: impl AsRef<Path>) -> Result<(Stored, ImageKind), IoError> {
    let path = path.as_ref();
    match Format::of(path)? {
        Format::Nifti => {
            let (stored, intent) = nifti::read::header(path)?;
            let kind = match stored.axes.get(3..).unwrap_or(&[]) {
                rest if rest.iter().all(|&n| n == 1) => ImageKind::Scalar,
                [1, 3, ..] => ImageKind::Field,
                [3] if intent == 2006 => ImageKind::Field,
                [_] => ImageKind::Series,
                [_, 3] if intent == 1007 => ImageKind::Fields,
                [1, 6] if intent == 1005 => ImageKind::Tensors,
                _ => ImageKind::Other,
            };
            Ok((stored, kind))
        }
        Format::Dicom => {
            let (stored, _) = dicom::series(path, false)?;
            Ok((stored, ImageKind::Scalar))
        }
        format => {
            let image = raw(path, format)?;
            let kind = match image.components {
                1 => ImageKind::Scalar,
                3 => ImageKind::Field,
                _ => ImageKind::Other,
            };
            Ok((image.stored(), kind))
        }
    }
}

/// Reads only the header of a scalar volume: a file, or a DICOM series.
///
/// # Errors
/// [`IoError`] where [`read_volume`] would refuse by the header and the file's size: no file, no
/// scalar volume, or more voxels than the file can hold.
pub fn read_volume_header(path: impl AsRef<Path>) -> Result<Stored, IoError> {
    let path = path.as_ref();
    match Format::of(path)? {
        Format::Nifti => nifti::read::volume_header(path),
        Format::Dicom => dicom::series(path, false).map(|(stored, _)| stored),
        format => scalar(path, format).and_then(|image| image.check_size().map(|()| image.stored())),
    }
}

/// The header of a NRRD or MetaImage with one number a voxel.
fn scalar(path: &Path, format: Format) -> Result<RawImage, IoError> {
    let image = raw(path, format)?;
    if image.components != 1 {
        let what = format!("has {} numbers a voxel, not one", image.components);
        return Err(Flaw::new(what, "give an image here; fields go to --field or to `palpate warp`").at(path));
    }
    Ok(image)
}

/// The header of a NRRD or MetaImage.
fn raw(path: &Path, format: Format) -> Result<RawImage, IoError> {
    match format {
        Format::Nrrd => nrrd::header(path),
        _ => metaimage::header(path),
    }
}

/// Other files that reading the image at `path` reads: the voxels that a `.nhdr` or `.mhd` names,
/// the other one of a `.hdr`/`.img` pair, the other slices of a DICOM file; none of a folder, or
/// where the header cannot be read.
pub(super) fn others(path: &Path) -> Vec<PathBuf> {
    let mut found: Vec<PathBuf> = match Format::of(path) {
        _ if path.is_dir() => Vec::new(),
        Ok(Format::Dicom) => dicom::files(path),
        Ok(Format::Nifti) => {
            let other = |from, to| nifti::read::beside(path, from, to);
            other("hdr", "img").or_else(|| other("img", "hdr")).into_iter().collect()
        }
        Ok(format) => raw(path, format).into_iter().map(|image| image.file).collect(),
        Err(_) => Vec::new(),
    };
    found.retain(|file| file != path);
    found
}

/// Reads a scalar volume, in the file's intensity unit after its scaling: a file, or
/// a DICOM series.
///
/// Axes past the third must have length 1. Values that are not finite are given as they are (see
/// [`count_non_finite`]); float64 beyond float32 becomes infinite.
///
/// # Errors
/// [`IoError`] when the file cannot be read, is cut short or damaged, or is not a scalar volume of
/// numbers.
///
/// ```
/// use palpate::{IoError, io};
/// let folder = tempfile::tempdir()?;
/// let missing = io::read_volume(folder.path().join("missing.nii.gz"));
/// assert!(missing.is_err_and(|e: IoError| e.to_string().contains("missing.nii.gz")));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn read_volume(path: impl AsRef<Path>) -> Result<Volume, IoError> {
    let path = path.as_ref();
    let (grid, values) = match Format::of(path)? {
        Format::Nifti => nifti::read::volume(path)?,
        Format::Dicom => {
            let (stored, values) = dicom::series(path, true)?;
            (stored.grid, values)
        }
        format => {
            let image = scalar(path, format)?;
            (image.grid, image.load()?)
        }
    };
    Volume::from_vec(grid, values).map_err(|e| Flaw::new(e.to_string(), "export it again").at(path))
}

/// Reads a scalar volume of whole numbers as they are stored, which single precision has only up to
/// 2^24; none where it may have fractions, or is a DICOM series.
///
/// # Errors
/// As [`read_volume`].
pub(crate) fn read_integers(path: impl AsRef<Path>) -> Result<Option<Vec<i64>>, IoError> {
    let path = path.as_ref();
    match Format::of(path)? {
        Format::Nifti => nifti::read::integers(path).map(|(_, values)| values),
        Format::Dicom => Ok(None),
        format => scalar(path, format)?.integers(),
    }
}

/// Reads a label map: whole numbers 0 to 255, stored as any type.
///
/// # Errors
/// As [`read_volume`]; also when a value is anything else.
pub fn read_labels(path: impl AsRef<Path>) -> Result<Mask, IoError> {
    let (path, volume) = (path.as_ref(), read_volume(path.as_ref())?);
    labels_of(&volume, path).map_err(|error| match volume.as_slice().iter().any(|v| v.abs() >= WHOLE) {
        // The number as it is stored: single precision has lost its last digits.
        true => {
            match read_integers(path).ok().flatten().and_then(|all| all.into_iter().find(|v| !(0..256).contains(v))) {
                Some(v) => {
                    format(path, format!("holds the label {v}, but labels are whole numbers from 0 to 255"), LABELS)
                }
                None => error,
            }
        }
        false => error,
    })
}

/// From here on single precision has not all whole numbers.
pub(crate) const WHOLE: f32 = 16_777_216.0;

const LABELS: &str = "give a mask or label map, resampled with nearest neighbour";

/// `volume`, called `path` in errors, as a label map.
///
/// # Errors
/// [`IoError`] when a value is no whole number from 0 to 255.
pub(crate) fn labels_of(volume: &Voxels<'_>, path: &Path) -> Result<Mask, IoError> {
    let grid = *volume.grid();
    let odd = volume.as_slice().iter().position(|&v| !(0.0..=255.0).contains(&v) || v.fract() != 0.0);
    if let Some(at) = odd {
        let [nx, ny, _] = grid.shape();
        let (v, i, j, k) = (volume.as_slice()[at], at % nx, at / nx % ny, at / nx / ny);
        let what = format!("voxel ({i}, {j}, {k}) is {v}, but labels are whole numbers from 0 to 255");
        return Err(Flaw::new(what, LABELS).at(path));
    }
    let labels = volume.as_slice().iter().map(|&v| v as u8).collect();
    Mask::from_vec(grid, labels).map_err(|e| Flaw::new(e.to_string(), "export it again").at(path))
}

/// Reads a mask: 0 is outside, 1 to 255 inside (labels are kept).
///
/// # Errors
/// As [`read_labels`].
pub fn read_mask(path: impl AsRef<Path>) -> Result<Mask, IoError> {
    read_labels(path)
}

/// Voxels that are NaN or infinite.
pub fn count_non_finite(volume: &Volume) -> usize {
    volume.as_slice().iter().filter(|v| !v.is_finite()).count()
}

/// The three components of a NRRD or MetaImage field, one after the other, as they are stored.
pub(super) fn raw_field(path: &Path, format: Format) -> Result<(Grid, Vec<f32>), IoError> {
    let image = raw(path, format)?;
    if image.components != 3 {
        let what = format!("is not a displacement field: {} numbers a voxel instead of 3", image.components);
        return Err(Flaw::new(what, "give a displacement field as ITK, Slicer or plastimatch write it").at(path));
    }
    image.kind.check_signed().map_err(|flaw| flaw.at(path))?;
    let values = image.load()?;
    Ok((image.grid, values))
}
