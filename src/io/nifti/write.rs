//! Writing volumes, label maps and displacement fields.

use super::affine::quaternion;
use super::flaw::Flaw;
use crate::error::IoError;
use crate::io::atomic::write_atomic;
use crate::io::gzip::{Chunk, Member};
use crate::numerics::simd::dispatch;
use crate::types::{DenseField, Grid, Mask, Volume};
use rayon::prelude::*;
use std::io::Write;
use std::path::Path;

/// Values packed together; fixed, so that the bytes do not depend on the number of threads.
const CHUNK: usize = 1 << 18;
/// Chunks that are held packed at a time.
const BATCH: usize = 32;
/// Bits of a float32's mantissa that a volume keeps (of 23).
const MANTISSA_BITS: u32 = 15;
/// Displacements are multiples of 1 / this (mm): 2^-12 mm.
const STEPS_PER_MM: f32 = 4096.0;

/// Writes a scalar volume as float32; `description` (up to 79 bytes) goes into the header.
///
/// Values are rounded to 16 significant bits (relative error at most 2^-16; whole numbers up to 65,536 are exact), so
/// that they pack.
///
/// # Errors
/// [`IoError`] when the name ends in neither `.nii` nor `.nii.gz`, an axis has more than 32,767 voxels or the file
/// cannot be written.
pub fn write_volume(path: impl AsRef<Path>, volume: &Volume, description: &str) -> Result<(), IoError> {
    let form = Form { datatype: 16, bits: 32, vector: false, description };
    write(path.as_ref(), volume.grid(), form, &[volume.as_slice()], |_, v| shortened(v).to_le_bytes())
}

/// Writes a scalar volume as float32, each value rounded to a multiple of 2^-`bits`, so that it packs well.
///
/// # Errors
/// As [`write_volume`].
pub fn write_steps(path: impl AsRef<Path>, volume: &Volume, description: &str, bits: i32) -> Result<(), IoError> {
    let form = Form { datatype: 16, bits: 32, vector: false, description };
    let (up, down) = (2f32.powi(bits), 2f32.powi(-bits));
    write(path.as_ref(), volume.grid(), form, &[volume.as_slice()], |_, v| {
        ((v * up).round_ties_even() * down + 0.0).to_le_bytes()
    })
}

/// Writes a volume as int16, each value rounded to the nearest whole number: half the size of [`write_volume`].
///
/// # Errors
/// As [`write_volume`]; also when a value is not finite or does not fit.
pub fn write_integers(path: impl AsRef<Path>, volume: &Volume, description: &str) -> Result<(), IoError> {
    let fits = |v: f32| (f32::from(i16::MIN)..=f32::from(i16::MAX)).contains(&v.round_ties_even());
    if let Some(v) = volume.as_slice().iter().find(|&&v| !fits(v)) {
        let what = format!("the value {v} does not fit in 16 bits");
        return Err(Flaw::new(what, "scale the intensities, or write float32").at(path.as_ref()));
    }
    let form = Form { datatype: 4, bits: 16, vector: false, description };
    write(path.as_ref(), volume.grid(), form, &[volume.as_slice()], |_, v| (v.round_ties_even() as i16).to_le_bytes())
}

/// Writes a mask or label map as uint8.
///
/// # Errors
/// As [`write_volume`].
pub fn write_labels(path: impl AsRef<Path>, labels: &Mask, description: &str) -> Result<(), IoError> {
    let form = Form { datatype: 2, bits: 8, vector: false, description };
    write(path.as_ref(), labels.grid(), form, &[labels.as_slice()], |_, v: u8| [v])
}

/// Writes a displacement field (mm) as ITK, ANTs and Slicer read it: (nx, ny, nz, 1, 3), intent 1007, float32, LPS.
///
/// Components are rounded to multiples of 2^-12 mm (error at most 2^-13 mm, 0.12 um), so that they pack.
///
/// # Errors
/// As [`write_volume`].
pub fn write_field(path: impl AsRef<Path>, field: &DenseField) -> Result<(), IoError> {
    let form = Form { datatype: 16, bits: 32, vector: true, description: "displacement, initial to deformed, LPS mm" };
    let components = [field.component(0), field.component(1), field.component(2)];
    write(path.as_ref(), field.grid(), form, &components, |c, v| {
        let lps = if c < 2 { -v } else { v };
        // Adding 0 turns -0 into 0.
        ((lps * STEPS_PER_MM).round_ties_even() / STEPS_PER_MM + 0.0).to_le_bytes()
    })
}

/// The nearest number with [`MANTISSA_BITS`] bits, ties to even; NaN and infinity stay.
fn shortened(v: f32) -> f32 {
    if !v.is_finite() {
        return v;
    }
    let (bits, cut) = (v.to_bits(), 23 - MANTISSA_BITS);
    let half = (1 << (cut - 1)) - 1 + (bits >> cut & 1);
    let near = f32::from_bits((bits + half) & !((1 << cut) - 1));
    if near.is_finite() { near } else { v }
}

struct Form<'a> {
    datatype: i16,
    bits: i16,
    /// Three components on the fifth axis.
    vector: bool,
    description: &'a str,
}

/// Header, then the parts one after the other; `stored` turns a value of a part (by its number) into bytes.
fn write<T: Copy + Sync, const N: usize>(
    path: &Path,
    grid: &Grid,
    form: Form<'_>,
    parts: &[&[T]],
    stored: impl Fn(usize, T) -> [u8; N] + Sync,
) -> Result<(), IoError> {
    let name = path.to_string_lossy().to_lowercase();
    let pack = name.ends_with(".nii.gz");
    if !pack && !name.ends_with(".nii") {
        return Err(Flaw::new("only NIfTI can be written", "end the name in .nii or .nii.gz").at(path));
    }
    let header = header(grid, &form).map_err(|flaw| flaw.at(path))?;
    let chunks: Vec<(usize, &[T])> =
        parts.iter().enumerate().flat_map(|(p, values)| values.chunks(CHUNK).map(move |c| (p, c))).collect();
    let bytes = |&(part, values): &(usize, &[T])| -> Vec<u8> {
        let mut bytes = vec![0; N * values.len()];
        dispatch(
            #[inline(always)]
            || bytes.as_chunks_mut::<N>().0.iter_mut().zip(values).for_each(|(b, &v)| *b = stored(part, v)),
        );
        bytes
    };
    if !pack {
        return write_atomic(path, |w| {
            w.write_all(&header)?;
            chunks.iter().try_for_each(|chunk| w.write_all(&bytes(chunk)))
        });
    }
    write_atomic(path, |w| {
        let mut member = Member::start(w)?;
        let mut ready = vec![Chunk::new(&header)];
        for batch in chunks.chunks(BATCH) {
            let (written, packed) = rayon::join(
                || ready.iter().try_for_each(|chunk| member.add(chunk)),
                || batch.par_iter().map(|chunk| Chunk::new(&bytes(chunk))).collect(),
            );
            written?;
            ready = packed;
        }
        ready.iter().try_for_each(|chunk| member.add(chunk))?;
        member.finish()
    })
}

/// A NIfTI-1 header and four zero bytes for "no extensions" (nifti1.h; offsets in bytes).
fn header(grid: &Grid, form: &Form<'_>) -> Result<[u8; 352], Flaw> {
    let mut h = [0; 352];
    let shape = grid.shape();
    let mut dim = [if form.vector { 5i16 } else { 3 }, 1, 1, 1, 1, if form.vector { 3 } else { 1 }, 1, 1];
    for a in 0..3 {
        dim[a + 1] = i16::try_from(shape[a]).map_err(|_| {
            Flaw::new(format!("{shape:?} voxels: NIfTI-1 ends at 32767 an axis"), "crop or resample it")
        })?;
    }
    put(&mut h, 0, &348i32.to_le_bytes());
    put(&mut h, 40, &dim.map(i16::to_le_bytes).concat());
    put(&mut h, 68, &if form.vector { 1007i16 } else { 0 }.to_le_bytes());
    put(&mut h, 70, &form.datatype.to_le_bytes());
    put(&mut h, 72, &form.bits.to_le_bytes());
    let (rows, size, orientation) = (grid.affine().rows(), grid.spacing(), quaternion(grid.affine()));
    let (qfac, [b, c, d]) = orientation.unwrap_or((1.0, [0.0; 3]));
    put_floats(&mut h, 76, &[qfac, size[0], size[1], size[2], 1.0, 1.0, 1.0, 1.0]);
    put_floats(&mut h, 108, &[352.0, 1.0, 0.0]); // vox_offset, scl_slope, scl_inter
    put(&mut h, 123, &[2]); // millimetres
    let mut end = form.description.len().min(79);
    while !form.description.is_char_boundary(end) {
        end -= 1;
    }
    put(&mut h, 148, &form.description.as_bytes()[..end]);
    put(&mut h, 252, &i16::from(orientation.is_some()).to_le_bytes()); // qform_code
    put(&mut h, 254, &1i16.to_le_bytes()); // sform_code
    put_floats(&mut h, 256, &[b, c, d, rows[0][3], rows[1][3], rows[2][3]]);
    put_floats(&mut h, 280, &rows.concat());
    put(&mut h, 344, b"n+1\0");
    Ok(h)
}

fn put(header: &mut [u8; 352], at: usize, bytes: &[u8]) {
    header[at..at + bytes.len()].copy_from_slice(bytes);
}

fn put_floats(header: &mut [u8; 352], at: usize, values: &[f64]) {
    values.iter().enumerate().for_each(|(i, &v)| put(header, at + 4 * i, &(v as f32).to_le_bytes()));
}
