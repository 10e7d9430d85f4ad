//! ITK's transforms as MATLAB level 4 matrices: `0GenericAffine.mat` of ANTs.
//!
//! Each matrix has five 32-bit numbers (type, rows, columns, imaginary, length of the name), its
//! name and its values. One named after the kind holds the parameters, the next, `fixed`, the
//! centre. Thousands of the type are 1 where bytes are big-endian; its tens are 1 for float32.

use super::itk::{Block, chain};
use crate::error::IoError;
use crate::io::format_error::Flaw;
use crate::io::source;
use crate::types::Transform;
use std::path::Path;

/// No file of affine transforms is longer (bytes).
const MAX_FILE_BYTES: u64 = 1 << 20;
const EXPORT: &str = "copy it again, or save it as .tfm from SimpleITK";

/// Bytes of the numbers before the name.
const HEADER_BYTES: usize = 20;

/// One matrix as it is stored.
struct Matrix<'a> {
    name: String,
    values: Vec<f64>,
    rest: &'a [u8],
}

/// Whether the bytes start as a matrix of level 4 does: a known type, no imaginary part and a name.
pub(super) fn is_matlab(head: &[u8]) -> bool {
    layout(head).is_some() && head.get(HEADER_BYTES).is_some_and(u8::is_ascii_alphabetic)
}

/// Reads the transform of a file, initial to deformed.
pub(super) fn read(path: &Path) -> Result<Vec<Transform>, IoError> {
    let bytes = source::bytes(path, MAX_FILE_BYTES)?;
    blocks(&bytes).and_then(chain).map_err(|flaw| flaw.at(path))
}

fn blocks(bytes: &[u8]) -> Result<Vec<Block>, Flaw> {
    let (mut blocks, mut rest): (Vec<Block>, &[u8]) = (Vec::new(), bytes);
    while !rest.is_empty() {
        let number = 2 * blocks.len() + 1;
        let cut = || Flaw::new(format!("is cut short or damaged in matrix {number}"), EXPORT);
        let kind = matrix(rest).ok_or_else(cut)?;
        let fixed = matrix(kind.rest).filter(|m| m.name == "fixed").ok_or_else(cut)?;
        if kind.values.iter().chain(&fixed.values).any(|v| !v.is_finite()) {
            return Err(Flaw::new(format!("matrix {number} holds a value that is not finite"), EXPORT));
        }
        let place = format!("matrix {number}");
        blocks.push(Block { name: kind.name, parameters: kind.values, fixed: fixed.values, place });
        rest = fixed.rest;
    }
    Ok(blocks)
}

/// Whether bytes are big-endian, whether values are float32, and rows, columns and length of the
/// name.
fn layout(bytes: &[u8]) -> Option<(bool, bool, [usize; 3])> {
    let word = |at: usize| bytes.get(4 * at..)?.first_chunk::<4>().copied();
    let little = i32::from_le_bytes(word(0)?);
    let big_endian = !(0..1000).contains(&little);
    let int = |at: usize| word(at).map(if big_endian { i32::from_be_bytes } else { i32::from_le_bytes });
    let kind = int(0)?;
    let (order, precision) = (kind / 1000, kind / 10 % 10);
    let known = order == i32::from(big_endian) && matches!(precision, 0 | 1) && kind % 10 == 0 && int(3)? == 0;
    let count = |at: usize| int(at).and_then(|n| usize::try_from(n).ok());
    known.then_some((big_endian, precision == 1, [count(1)?, count(2)?, count(4)?]))
}

/// The matrix at the start of `bytes`; none when it is not all there.
fn matrix(bytes: &[u8]) -> Option<Matrix<'_>> {
    let (big_endian, single, [rows, columns, length]) = layout(bytes)?;
    let (name, data) = bytes.get(HEADER_BYTES..)?.split_at_checked(length)?;
    let size = if single { 4 } else { 8 };
    let (data, rest) = data.split_at_checked(rows.checked_mul(columns)?.checked_mul(size)?)?;
    let value = |b: &[u8]| -> Option<f64> {
        match (single, big_endian) {
            (true, false) => b.first_chunk().map(|b| f64::from(f32::from_le_bytes(*b))),
            (true, true) => b.first_chunk().map(|b| f64::from(f32::from_be_bytes(*b))),
            (false, false) => b.first_chunk().map(|b| f64::from_le_bytes(*b)),
            (false, true) => b.first_chunk().map(|b| f64::from_be_bytes(*b)),
        }
    };
    let values = data.chunks_exact(size).map(value).collect::<Option<_>>()?;
    let name = String::from_utf8_lossy(name).trim_end_matches('\0').to_string();
    Some(Matrix { name, values, rest })
}
