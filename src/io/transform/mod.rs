//! Transforms of other programs, and ours for them.
//!
//! | program | file | holds |
//! |---|---|---|
//! | ITK, SimpleITK, ANTs | `.tfm`, `.txt` | affine kinds, a field, or a composite; LPS |
//! | ANTs | `0GenericAffine.mat` | MATLAB level 4: an affine kind with its centre; LPS |
//! | greedy, c3d_affine_tool | `.mat` | text: 4 x 4, RAS mm, fixed to moving |
//! | NiftyReg | `.txt` | the same |
//! | FSL FLIRT | `.mat` | text: 4 x 4, moving to fixed, both in FSL's scaled-voxel mm |
//! | all | images | displacement fields, see [`crate::io::field`] |
//!
//! A text of 4 x 4 numbers does not say whose it is: without a name it is taken as greedy's.

mod itk;

mod matlab;

mod matrix;

mod write;

pub use write::{AffineFormat, FieldFormat, write_affine, write_field_as};

use super::field::{FieldConvention, read_field_as};
use super::{format, source};
use crate::error::{IoError, UnknownName};
use crate::types::names::choose;
use crate::types::{Grid, Transform};
use std::path::Path;
use std::str::FromStr;

/// Whose transform a file is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TransformSource {
    /// ITK, SimpleITK, ANTs, Slicer, palpate.
    Itk,
    /// greedy, c3d_affine_tool.
    Greedy,
    /// NiftyReg.
    Niftyreg,
    /// FSL: FLIRT's matrix, or a relative warp.
    Fsl,
    /// FSL's absolute warp.
    FslAbsolute,
    /// A displacement in RAS mm.
    Ras,
}

impl FromStr for TransformSource {
    type Err = UnknownName;

    fn from_str(name: &str) -> Result<Self, UnknownName> {
        let known = [
            ("itk", Self::Itk),
            ("ants", Self::Itk),
            ("lps", Self::Itk),
            ("greedy", Self::Greedy),
            ("niftyreg", Self::Niftyreg),
            ("fsl", Self::Fsl),
            ("fsl-absolute", Self::FslAbsolute),
            ("ras", Self::Ras),
        ];
        choose("kind of transform", name, &known)
    }
}

impl TransformSource {
    /// Of its fields.
    fn convention(self) -> FieldConvention {
        match self {
            Self::Itk | Self::Greedy => FieldConvention::Lps,
            Self::Niftyreg => FieldConvention::Niftyreg,
            Self::Fsl => FieldConvention::Fsl,
            Self::FslAbsolute => FieldConvention::FslAbsolute,
            Self::Ras => FieldConvention::Ras,
        }
    }
}

/// What a file of transforms holds.
#[derive(Debug, Clone, PartialEq)]
pub struct StoredTransforms {
    /// In the order in which a point travels, initial to deformed.
    pub transforms: Vec<Transform>,
    /// Whether the file is a 4 x 4 text without a name, taken as greedy's.
    pub guessed: bool,
}

/// What a file is, by its first bytes.
enum Content {
    ItkText,
    Matlab,
    Matrix,
    Image,
}

const ITK_MAGIC: &[u8] = b"#Insight Transform File";

/// Reads the transforms of a file (or the field of a results folder of `palpate field`) as maps of
/// world points (mm, RAS), initial to deformed.
///
/// `source` says whose it is; without, the file itself must say so, and a text of 4 x 4 numbers is
/// taken as greedy's. FSL's numbers refer to the grids of the volumes that it led between: its
/// matrices need `initial` and `deformed`, its fields `deformed`.
///
/// # Errors
/// [`IoError`] when the file cannot be read, is damaged, 2-D, singular, of a kind that is not read,
/// or not what `source` says.
pub fn read_transform(
    path: impl AsRef<Path>,
    source: Option<TransformSource>,
    initial: Option<&Grid>,
    deformed: Option<&Grid>,
) -> Result<StoredTransforms, IoError> {
    let path = path.as_ref();
    let field = path.join("displacement.nii.gz");
    let path = if path.is_dir() { &field } else { path };
    let one = |transform| StoredTransforms { transforms: vec![transform], guessed: false };
    let itk = matches!(source, None | Some(TransformSource::Itk));
    match content(path)? {
        Content::ItkText | Content::Matlab if !itk => {
            let what = "is a transform of ITK, not of the program that was named";
            Err(format(path, what, "leave the name out, or write itk: before it"))
        }
        Content::ItkText => itk::read(path).map(|transforms| StoredTransforms { transforms, guessed: false }),
        Content::Matlab => matlab::read(path).map(|transforms| StoredTransforms { transforms, guessed: false }),
        Content::Matrix => {
            let matrix = matrix::read(path)?;
            let map = match source {
                Some(TransformSource::Fsl) => matrix::from_flirt(path, &matrix, initial, deformed)?,
                Some(TransformSource::FslAbsolute | TransformSource::Itk) => {
                    let what = "is a text of 4 x 4 numbers, which that program does not write";
                    return Err(format(path, what, "write greedy:, niftyreg: or fsl: before it"));
                }
                _ => matrix,
            };
            Ok(StoredTransforms { guessed: source.is_none(), ..one(Transform::Affine(map)) })
        }
        Content::Image => {
            let convention = source.map_or(FieldConvention::Lps, TransformSource::convention);
            if matches!(source, Some(TransformSource::Fsl | TransformSource::FslAbsolute)) && deformed.is_none() {
                let what = "is a field of FSL, whose numbers refer to the grid of the volume that it leads to";
                return Err(format(
                    path,
                    what,
                    "name that volume: --deformed (the field's own where both are the same)",
                ));
            }
            read_field_as(path, convention, deformed).map(|field| one(Transform::Field(field)))
        }
    }
}

/// Looks at the first bytes; refuses what is known and not read.
fn content(path: &Path) -> Result<Content, IoError> {
    let head = source::head(path, 512)?;
    let refuse = |what: &str, hint: &str| Err(format(path, what, hint));
    let text = head.iter().all(|b| b.is_ascii_graphic() || b.is_ascii_whitespace());
    let first = head.trim_ascii_start();
    if first.starts_with(ITK_MAGIC) {
        return Ok(Content::ItkText);
    }
    if head.starts_with(b"\x89HDF\r\n\x1a\n") {
        let what = "is an HDF5 transform, as ANTs writes with --write-composite-transform 1";
        let hint = "register with 0, or take it apart with CompositeTransformUtil --disassemble, and give the .mat and the \
                    warp; or save it as .tfm from SimpleITK";
        return refuse(what, hint);
    }
    if head.starts_with(b"MATLAB 5.0") {
        return refuse("is a MATLAB 5 file, not ITK's MATLAB 4", "save it with -v4, or as .tfm from SimpleITK");
    }
    if text && first.starts_with(b"(") {
        let what = "is a parameter file of elastix, which names its transform by its own rules";
        return refuse(what, "make a field with transformix -def all, and give that");
    }
    if matlab::is_matlab(&head) {
        return Ok(Content::Matlab);
    }
    let word = first.split(u8::is_ascii_whitespace).next().unwrap_or_default();
    let number = str::from_utf8(word).is_ok_and(|w| w.parse::<f64>().is_ok());
    Ok(if text && number { Content::Matrix } else { Content::Image })
}
