//! Voxels that a text header describes: in the same file after it, or in one beside it.

use super::format_error::Flaw;
use super::gzip::{self, MAX_DEFLATE_RATIO};
use super::image::Stored;
use super::memory::fits;
use super::voxels::{Kind, count, decode, integers};
use super::{os, source};
use crate::error::IoError;
use crate::types::{Affine, Grid};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// No text header is longer (bytes).
const MAX_HEADER_BYTES: u64 = 1 << 20;

/// How the voxels are packed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Packing {
    None,
    Gzip,
    Zlib,
}

/// Where the voxels begin.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Start {
    At(u64),
    /// They end the file.
    Last,
}

/// An image by its header, checked.
#[derive(Debug, Clone)]
pub(super) struct RawImage {
    pub(super) format: &'static str,
    pub(super) placed: &'static str,
    pub(super) grid: Grid,
    pub(super) components: usize,
    /// Whether a voxel's numbers lie together.
    pub(super) interleaved: bool,
    pub(super) kind: Kind,
    pub(super) big_endian: bool,
    pub(super) packing: Packing,
    pub(super) start: Start,
    pub(super) file: PathBuf,
}

/// The first lines of a file as far as they can belong to a header (text up to the first byte that
/// is none, or 1 MiB).
pub(super) fn head(path: &Path) -> Result<Vec<u8>, IoError> {
    source::head(path, MAX_HEADER_BYTES)
}

/// A line of `bytes` from `from`, without its end, and where the next one begins; none past the
/// end.
pub(super) fn line(bytes: &[u8], from: usize) -> Option<(String, usize)> {
    let rest = bytes.get(from..).filter(|r| !r.is_empty())?;
    let end = rest.iter().position(|&b| b == b'\n')?;
    let text = String::from_utf8_lossy(&rest[..end]).trim_end_matches('\r').to_string();
    Some((text, from + end + 1))
}

/// What one of a unit of length is in mm, by its name in NRRD, Slicer (UCUM) and the like.
pub(super) fn in_mm(unit: &str) -> Option<f64> {
    Some(match unit {
        "mm" | "millimeter" | "millimetre" => 1.0,
        "cm" | "centimeter" | "centimetre" => 10.0,
        "dm" => 100.0,
        "m" | "meter" | "metre" => 1e3,
        "um" | "\u{b5}m" | "\u{3bc}m" | "micron" | "micrometer" | "micrometre" => 1e-3,
        "nm" => 1e-6,
        "[in_i]" | "in" | "inch" => 25.4,
        _ => return None,
    })
}

/// `N` numbers separated by spaces or commas.
pub(super) fn numbers(text: &str) -> Option<Vec<f64>> {
    let parts = text.split([' ', '\t', ',', '(', ')']).filter(|p| !p.is_empty());
    parts.map(|p| p.parse().ok().filter(|v: &f64| v.is_finite())).collect()
}

/// A grid from the step along each axis and the first voxel, both in LPS mm.
pub(super) fn grid_from_lps(shape: [usize; 3], steps: [[f64; 3]; 3], origin: [f64; 3]) -> Result<Grid, Flaw> {
    let sign = [-1.0, -1.0, 1.0];
    let rows =
        std::array::from_fn(|r| std::array::from_fn(|c| sign[r] * if c < 3 { steps[c][r] } else { origin[r] } + 0.0));
    let hint = "write the true voxel size and orientation into the header";
    let affine = Affine::new(rows).map_err(|e| Flaw::new(e.to_string(), hint))?;
    Grid::new(shape, affine).map_err(|e| Flaw::new(e.to_string(), hint))
}

impl RawImage {
    /// For `palpate info`.
    pub(super) fn stored(&self) -> Stored {
        let mut axes = self.grid.shape().to_vec();
        if self.components > 1 {
            axes.push(self.components);
        }
        Stored {
            format: self.format,
            datatype: self.kind.name(),
            axes,
            placed: self.placed,
            apart_mm: None,
            labels: false,
            grid: self.grid,
            bytes: self.file.metadata().map_or(0, |m| m.len()),
            description: String::new(),
        }
    }

    /// Bytes of all numbers.
    fn needed(&self) -> u64 {
        count(&[self.grid.len(), self.components, self.kind.size()]) as u64
    }

    /// The file holds at most `holds` bytes where all numbers need more.
    fn short(&self, holds: u64) -> IoError {
        let (needed, shape) = (self.needed(), self.grid.shape());
        let what = format!("needs {needed} bytes for its {shape:?} voxels but holds at most {holds}");
        Flaw::new(what, "the file is cut short or its header is damaged: copy or export it again").at(&self.file)
    }

    /// The file of the numbers and where they start in it, if it can hold them all.
    fn open(&self) -> Result<(File, u64), IoError> {
        let path = &self.file;
        let needed = self.needed();
        let file = source::open(path)?;
        let size = file.metadata().map_err(os(path, "read"))?.len();
        let start = match self.start {
            Start::At(at) => at,
            Start::Last => size.saturating_sub(needed),
        };
        let held = size.saturating_sub(start);
        let most = if self.packing == Packing::None { held } else { held.saturating_mul(MAX_DEFLATE_RATIO) };
        if needed > most { Err(self.short(most)) } else { Ok((file, start)) }
    }

    /// Whether the file can hold all numbers.
    pub(super) fn check_size(&self) -> Result<(), IoError> {
        self.open().map(drop)
    }

    /// The whole numbers of a scalar image; none where it may have fractions.
    pub(super) fn integers(&self) -> Result<Option<Vec<i64>>, IoError> {
        Ok(integers(self.kind, self.big_endian, &self.bytes()?))
    }

    /// The bytes of all numbers.
    fn bytes(&self) -> Result<Vec<u8>, IoError> {
        let path = &self.file;
        let needed = self.needed();
        let (mut file, start) = self.open()?;
        fits(needed + 4 * (self.grid.len() * self.components) as u64).map_err(|flaw| flaw.at(path))?;
        let damaged = |e: std::io::Error| {
            Flaw::new(format!("its packed voxels are damaged or cut short ({e})"), "copy or export it again").at(path)
        };
        file.seek(SeekFrom::Start(start)).map_err(os(path, "read"))?;
        let mut bytes = Vec::new();
        match self.packing {
            Packing::None => {
                file.take(needed).read_to_end(&mut bytes).map_err(os(path, "read"))?;
            }
            Packing::Gzip => {
                let mut packed = Vec::new();
                file.read_to_end(&mut packed).map_err(os(path, "read"))?;
                bytes = gzip::unpack(&packed, needed as usize).map_err(damaged)?;
                bytes.truncate(needed as usize);
            }
            Packing::Zlib => {
                flate2::read::ZlibDecoder::new(file).take(needed).read_to_end(&mut bytes).map_err(damaged)?;
            }
        }
        if (bytes.len() as u64) < needed {
            return Err(self.short(bytes.len() as u64));
        }
        Ok(bytes)
    }

    /// The numbers, component after component.
    pub(super) fn load(&self) -> Result<Vec<f32>, IoError> {
        let values = decode(self.kind, self.big_endian, (1.0, 0.0), &self.bytes()?);
        if !self.interleaved || self.components == 1 {
            return Ok(values);
        }
        let n = self.grid.len();
        let mut apart = vec![0.0; values.len()];
        for (at, voxel) in values.chunks_exact(self.components).enumerate() {
            voxel.iter().enumerate().for_each(|(c, &v)| apart[c * n + at] = v);
        }
        Ok(apart)
    }
}
