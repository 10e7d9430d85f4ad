//! A folder with one DICOM series of slices (PS3.3 C.7.6.2, the image plane).
//!
//! Uncompressed, little-endian, one number a voxel, one frame a file; slices are put in order by
//! where they lie. Several series, several volumes at one place, gaps, tilted stacks and compressed
//! or multi-frame files are errors that say what to do. The elements are walked by
//! [`super::elements`]: no length in a file makes it allocate.

use super::elements::{Elements, Tag};
use super::flaw::Flaw;
use super::image::Stored;
use super::os;
use super::raw::grid_from_lps;
use super::voxels::{Kind, decode};
use crate::error::IoError;
use crate::types::space::{cross, dot};
use std::fs::{self, File};
use std::io::Read;
use std::ops::Range;
use std::path::{Path, PathBuf};

/// A file with one slice is never larger (bytes).
const LARGEST: u64 = 1 << 29;

const SERIES: Tag = (0x0020, 0x000e);
const POSITION: Tag = (0x0020, 0x0032);
const ORIENTATION: Tag = (0x0020, 0x0037);
const SPACING: Tag = (0x0028, 0x0030);
const THICKNESS: Tag = (0x0018, 0x0050);
const SAMPLES: Tag = (0x0028, 0x0002);
const FRAMES: Tag = (0x0028, 0x0008);
const ROWS: Tag = (0x0028, 0x0010);
const COLUMNS: Tag = (0x0028, 0x0011);
const BITS: Tag = (0x0028, 0x0100);
const BITS_STORED: Tag = (0x0028, 0x0101);
const HIGH_BIT: Tag = (0x0028, 0x0102);
const SIGNED: Tag = (0x0028, 0x0103);
const INTERCEPT: Tag = (0x0028, 0x1052);
const SLOPE: Tag = (0x0028, 0x1053);
const PIXELS: Tag = (0x7fe0, 0x0010);
const CONVERT: &str = "convert it with dcm2niix";

/// The header of one file.
struct Slice {
    path: PathBuf,
    series: String,
    shape: [usize; 2],
    kind: Kind,
    /// Highest bits of a number that are none of it (PS3.5, 8.1.1): whatever stands there.
    unused: usize,
    scaling: (f64, f64),
    position: [f64; 3],
    /// Along a row and down a column (LPS, unit vectors).
    axes: [[f64; 3]; 2],
    /// Between columns and between rows (mm).
    spacing: [f64; 2],
    thickness: f64,
    /// Bytes of the file with the voxels.
    pixels: Range<usize>,
}

/// Whether the file has DICOM's mark after its preamble.
fn is_dicom(path: &Path) -> bool {
    let mut head = Vec::new();
    let read = File::open(path).and_then(|f| f.take(132).read_to_end(&mut head));
    read.is_ok() && head.ends_with(b"DICM") && head.len() == 132
}

/// All of a file of sensible size.
fn whole(path: &Path) -> Result<Vec<u8>, IoError> {
    let mut bytes = Vec::new();
    File::open(path).and_then(|f| f.take(LARGEST).read_to_end(&mut bytes)).map_err(os(path, "read"))?;
    Ok(bytes)
}

/// `N` numbers of a text element, `1\0\0`.
fn numbers<const N: usize>(elements: &Elements<'_>, tag: Tag, name: &str) -> Result<[f64; N], Flaw> {
    let text = elements.get(tag).map(String::from_utf8_lossy);
    let clean = |part: &str| part.trim_matches([' ', '\0']).parse().ok().filter(|v: &f64| v.is_finite());
    let values = text.and_then(|t| t.split('\\').map(clean).collect::<Option<Vec<f64>>>());
    values
        .and_then(|v| v.try_into().ok())
        .ok_or_else(|| Flaw::new(format!("has no {name} ({:04x},{:04x}), or an odd one", tag.0, tag.1), CONVERT))
}

/// A binary 16-bit number.
fn count(elements: &Elements<'_>, tag: Tag) -> Option<usize> {
    elements.get(tag).and_then(|v| Some(u16::from_le_bytes(*v.first_chunk()?).into()))
}

impl Slice {
    fn read(path: &Path, bytes: &[u8]) -> Result<Self, Flaw> {
        let object =
            Elements::of(bytes).ok_or_else(|| Flaw::new("is damaged, cut short, compressed or big-endian", CONVERT))?;
        if count(&object, SAMPLES).unwrap_or(1) != 1 {
            return Err(Flaw::new("holds colours", CONVERT));
        }
        if numbers(&object, FRAMES, "").is_ok_and(|[n]: [f64; 1]| n != 1.0) {
            return Err(Flaw::new("holds several frames", CONVERT));
        }
        let side = |tag, name: &str| {
            count(&object, tag)
                .filter(|n| (1..=65535).contains(n))
                .ok_or_else(|| Flaw::new(format!("has no {name}, or an odd one"), CONVERT))
        };
        let signed = count(&object, SIGNED).unwrap_or(0) == 1;
        let kind = match (count(&object, BITS), signed) {
            (Some(8), false) => Kind::U8,
            (Some(8), true) => Kind::I8,
            (Some(16), false) => Kind::U16,
            (Some(16), true) => Kind::I16,
            (bits, _) => return Err(Flaw::new(format!("holds {} bits a voxel", bits.unwrap_or(0)), CONVERT)),
        };
        let bits = 8 * kind.size();
        let used = count(&object, BITS_STORED).unwrap_or(bits);
        if !(1..=bits).contains(&used) || count(&object, HIGH_BIT).unwrap_or(used - 1) != used - 1 {
            return Err(Flaw::new(format!("holds {used} bits in {bits} that are not the lowest ones"), CONVERT));
        }
        let [down, along] = numbers(&object, SPACING, "PixelSpacing")?;
        let [a, b, c, d, e, f] = numbers(&object, ORIENTATION, "ImageOrientationPatient")?;
        let one = |tag, default: f64| numbers(&object, tag, "").map_or(default, |[v]: [f64; 1]| v);
        let series = object.get(SERIES).map(|v| String::from_utf8_lossy(v).trim_matches([' ', '\0']).to_string());
        Ok(Self {
            path: path.into(),
            series: series.unwrap_or_default(),
            shape: [side(COLUMNS, "Columns")?, side(ROWS, "Rows")?],
            kind,
            unused: bits - used,
            scaling: (one(SLOPE, 1.0), one(INTERCEPT, 0.0)),
            position: numbers(&object, POSITION, "ImagePositionPatient")?,
            axes: [[a, b, c], [d, e, f]],
            spacing: [along, down],
            thickness: one(THICKNESS, 1.0),
            pixels: object.place(PIXELS).ok_or_else(|| Flaw::new("holds no image", CONVERT))?,
        })
    }

    fn values(&self) -> Result<Vec<f32>, IoError> {
        let needed = self.shape[0] * self.shape[1] * self.kind.size();
        let bytes = whole(&self.path)?;
        let pixels = bytes.get(self.pixels.clone()).unwrap_or_default();
        let stored = pixels.get(..needed).ok_or_else(|| {
            let what = format!("needs {needed} bytes for its voxels but holds {}", pixels.len());
            Flaw::new(what, "the file is cut short: copy or export it again").at(&self.path)
        })?;
        let mut numbers = stored.to_vec();
        let unused = self.unused;
        match self.kind {
            _ if unused == 0 => {}
            Kind::U8 => numbers.iter_mut().for_each(|b| *b = *b << unused >> unused),
            Kind::I8 => numbers.iter_mut().for_each(|b| *b = (b.cast_signed() << unused >> unused).cast_unsigned()),
            Kind::U16 => words(&mut numbers, |w| w << unused >> unused),
            _ => words(&mut numbers, |w| (w.cast_signed() << unused >> unused).cast_unsigned()),
        }
        Ok(decode(self.kind, false, self.scaling, &numbers))
    }
}

/// Changes every 16-bit number.
fn words(bytes: &mut [u8], change: impl Fn(u16) -> u16) {
    bytes.as_chunks_mut().0.iter_mut().for_each(|b| *b = change(u16::from_le_bytes(*b)).to_le_bytes());
}

/// Stored form and values of the series in a folder; the values only when they are wanted.
pub(super) fn series(path: &Path, values: bool) -> Result<(Stored, Vec<f32>), IoError> {
    let mut files: Vec<PathBuf> = fs::read_dir(path)
        .and_then(|entries| entries.map(|e| e.map(|e| e.path())).collect())
        .map_err(os(path, "read the folder"))?;
    files.retain(|f| f.is_file() && is_dicom(f) && f.file_name().is_none_or(|n| n != "DICOMDIR"));
    files.sort();
    let mut slices = Vec::with_capacity(files.len());
    for file in &files {
        slices.push(Slice::read(file, &whole(file)?).map_err(|flaw| flaw.at(file))?);
    }
    let (shape, steps) = stack(&mut slices).map_err(|flaw| flaw.at(path))?;
    let grid = grid_from_lps(shape, steps, slices[0].position).map_err(|flaw| flaw.at(path))?;
    let mut all = Vec::new();
    for slice in slices.iter().filter(|_| values) {
        all.extend(slice.values()?);
    }
    let bytes = files.iter().filter_map(|f| f.metadata().ok()).map(|m| m.len()).sum();
    let stored = Stored {
        format: "DICOM series",
        datatype: slices[0].kind.name(),
        axes: shape.to_vec(),
        placed: "ImagePositionPatient and ImageOrientationPatient",
        apart_mm: None,
        labels: false,
        grid,
        bytes,
        description: String::new(),
    };
    Ok((stored, all))
}

/// Puts the slices in order; shape and steps (LPS mm) of the stack.
fn stack(slices: &mut [Slice]) -> Result<([usize; 3], [[f64; 3]; 3]), Flaw> {
    let Some(first) = slices.first() else {
        return Err(Flaw::new("is a folder without DICOM files", "give a volume, or a folder with one series"));
    };
    let mut names: Vec<&str> = slices.iter().map(|s| s.series.as_str()).collect();
    names.sort_unstable();
    names.dedup();
    if names.len() > 1 {
        let what = format!("holds {} DICOM series", names.len());
        return Err(Flaw::new(what, "put one series into a folder of its own"));
    }
    let near = |a: &[f64], b: &[f64]| a.iter().zip(b).all(|(x, y)| (x - y).abs() < 1e-3);
    let (shape, axes, spacing) = (first.shape, first.axes, first.spacing);
    let alike =
        |s: &Slice| s.shape == shape && near(s.axes.as_flattened(), axes.as_flattened()) && near(&s.spacing, &spacing);
    if !slices.iter().all(alike) {
        return Err(Flaw::new("holds slices of different sizes or directions", "keep those of one stack"));
    }
    let normal = cross(axes[0], axes[1]);
    slices.sort_by(|a, b| dot(a.position, normal).total_cmp(&dot(b.position, normal)));
    let n = slices.len();
    let mut step = normal.map(|v| v * slices[0].thickness);
    if let [first, .., last] = &*slices {
        step = std::array::from_fn(|a| (last.position[a] - first.position[a]) / (n - 1) as f64);
        let length = dot(step, step).sqrt();
        if length < 1e-3 {
            return Err(Flaw::new("holds several slices at one place", "keep one time or echo, or use dcm2niix"));
        }
        let off = |(k, s): (usize, &Slice)| {
            let d: [f64; 3] = std::array::from_fn(|a| first.position[a] + k as f64 * step[a] - s.position[a]);
            dot(d, d).sqrt()
        };
        if slices.iter().enumerate().map(off).fold(0.0, f64::max) > 0.05 * length {
            let what = "holds slices that do not follow each other evenly (a gap, or several volumes)";
            return Err(Flaw::new(what, "add what is missing, or keep one volume"));
        }
    }
    let along = axes[0].map(|v| v * spacing[0]);
    let down = axes[1].map(|v| v * spacing[1]);
    Ok(([shape[0], shape[1], n], [along, down, step]))
}
