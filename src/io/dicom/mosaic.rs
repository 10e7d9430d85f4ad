//! Siemens' mosaics: the slices of a volume as tiles of one image, and what the private header says
//! of them.
//!
//! The header (CSA, "SV10") and where the tiles lie: nibabel's documentation, "Siemens format DICOM
//! with CSA header" and "DICOM mosaic".

use super::data_elements::{Elements, Tag};
use super::pixels::{CONVERT, text};
use crate::io::format_error::Flaw;

const IMAGE_TYPE: Tag = (0x0008, 0x0008);
const CREATOR: Tag = (0x0029, 0x0010);
const CSA: Tag = (0x0029, 0x1010);
const CSA_CREATOR: &str = "SIEMENS CSA HEADER";

/// What the private header says.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Mosaic {
    /// Slices; they fill the tiles row by row.
    pub(super) tiles: usize,
    /// From slice to slice (LPS, unit vector).
    pub(super) normal: [f64; 3],
}

impl Mosaic {
    /// None where the image is no mosaic.
    pub(super) fn of(elements: &Elements<'_>) -> Result<Option<Self>, Flaw> {
        let kind = elements.get(IMAGE_TYPE).map(text).unwrap_or_default();
        if !kind.split('\\').any(|k| k.trim() == "MOSAIC") {
            return Ok(None);
        }
        let ours = elements.get(CREATOR).is_some_and(|c| text(c) == CSA_CREATOR);
        let header = elements.get(CSA).filter(|_| ours);
        let found = header.and_then(|h| {
            let tiles = values(h, "NumberOfImagesInMosaic")?.first().copied().filter(|n| *n >= 1.0 && *n <= 1e6)?;
            let normal: [f64; 3] = values(h, "SliceNormalVector")?.try_into().ok()?;
            let length = normal.iter().map(|v| v * v).sum::<f64>().sqrt();
            ((length - 1.0).abs() < 1e-3).then_some(Self { tiles: tiles as usize, normal })
        });
        let what = "is a Siemens mosaic whose private header (0029,1010) does not tell its slices";
        found.map(Some).ok_or_else(|| Flaw::new(what, CONVERT))
    }

    /// Tiles along a side of the image.
    pub(super) fn side(&self) -> usize {
        (1..).find(|side| side * side >= self.tiles).unwrap_or(1)
    }
}

/// The numbers under a name of the header.
fn values(header: &[u8], wanted: &str) -> Option<Vec<f64>> {
    let number = |at: usize| Some(u32::from_le_bytes(*header.get(at..)?.first_chunk()?) as usize);
    if !header.starts_with(b"SV10") {
        return None;
    }
    let mut at = 16;
    for _ in 0..number(8)? {
        let name = header.get(at..at + 64)?.split(|b| *b == 0).next()?;
        let items = number(at + 76)?;
        at += 84;
        let mut found = Vec::new();
        for _ in 0..items {
            let length = number(at + 4)?;
            let value = header.get(at + 16..(at + 16).checked_add(length)?)?;
            found.extend(text(value.split(|b| *b == 0).next()?).parse::<f64>().ok().filter(|v| v.is_finite()));
            at = (at + 16).checked_add(length.next_multiple_of(4))?;
        }
        if name == wanted.as_bytes() {
            return Some(found);
        }
    }
    None
}
