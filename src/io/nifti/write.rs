//! Writing volumes, label maps and displacement fields.

use super::affine::quaternion;
use super::header::NIFTYREG;
use crate::error::IoError;
use crate::io::atomic::write_atomic;
use crate::io::format_error::Flaw;
use crate::io::gzip::{Chunk, Member, Run};
use crate::io::raw_write::{TextFormat, TextImage};
use crate::io::voxels::Kind;
use crate::numerics::simd::dispatch;
use crate::types::{DenseField, ErrorSamples, Grid, Mask, Volume};
use rayon::prelude::*;
use std::borrow::Cow;
use std::fs::File;
use std::io::Write;
use std::ops::Range;
use std::path::{Path, PathBuf};

/// NIfTI's code of numbers without a unit.
const DIMENSIONLESS: i16 = 1011;
/// NIfTI's code of a symmetric matrix a voxel.
const SYMMETRIC: i16 = 1005;
/// FSL's code of a displacement field.
const FNIRT: i16 = 2006;
/// Values packed together; fixed, so that the bytes do not depend on the number of threads.
const VALUES_PER_CHUNK: usize = 1 << 18;
/// Chunks that are held packed at a time: of few threads six for each, of many two.
const BATCH: [usize; 2] = [6, 2];
const FEW: usize = 4;
/// Bits of a float32's mantissa that a volume keeps (of 23).
const MANTISSA_BITS: u32 = 15;
/// Lengths are multiples of 2^-12 mm where no voxel edge is under a quarter of a millimetre.
const LENGTH_BITS: i32 = 12;
const COARSE: f64 = 0.25;

/// Writes a scalar volume as float32; `description` (up to 79 bytes) goes into the header.
///
/// Values are rounded to 16 significant bits (relative error at most 2^-16; whole numbers up to
/// 65,536 are exact), so that they pack.
///
/// # Errors
/// [`IoError`] when the name ends in none of `.nii`, `.nii.gz`, `.nrrd` and `.mha`, an axis of
/// NIfTI has more than 32,767 voxels or the file cannot be written.
///
/// ```
/// use palpate::{Affine, Grid, Volume, io};
/// let folder = tempfile::tempdir()?;
/// let path = folder.path().join("ramp.nii.gz");
/// let grid = Grid::new([6, 5, 4], Affine::scaled([1.0, 1.0, 2.5], [-3.0, 0.0, 8.0])?)?;
/// let ramp = Volume::from_voxels(grid, |o, _| o as f32);
/// io::write_volume(&path, &ramp, "a ramp")?;
/// assert_eq!(io::read_volume(&path)?, ramp);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn write_volume(path: impl AsRef<Path>, volume: &Volume, description: &str) -> Result<(), IoError> {
    let form = Form { description, ..Form::FLOATS };
    write(path.as_ref(), volume.grid(), form, &[volume.as_slice()], |_, v| stored(v).to_le_bytes()).map(drop)
}

/// Writes a scalar volume as float32, bit for bit.
///
/// # Errors
/// As [`write_volume`].
pub fn write_exact(path: impl AsRef<Path>, volume: &Volume, description: &str) -> Result<(), IoError> {
    let form = Form { description, ..Form::FLOATS };
    write(path.as_ref(), volume.grid(), form, &[volume.as_slice()], |_, v: f32| v.to_le_bytes()).map(drop)
}

/// Writes a label map as int32, or int64 where a label needs it.
///
/// # Errors
/// As [`write_volume`].
pub(crate) fn write_codes(
    path: impl AsRef<Path>,
    grid: &Grid,
    codes: &[i64],
    description: &str,
) -> Result<(), IoError> {
    let (path, form) = (path.as_ref(), Form { description, ..Form::FLOATS });
    match codes.iter().all(|c| i32::try_from(*c).is_ok()) {
        true => write(path, grid, Form { datatype: 8, ..form }, &[codes], |_, v| (v as i32).to_le_bytes()).map(drop),
        false => write(path, grid, Form { datatype: 1024, bits: 64, ..form }, &[codes], |_, v: i64| v.to_le_bytes())
            .map(drop),
    }
}

/// Writes a scalar volume as float32, each value rounded to a multiple of 2^-`bits`, so that it
/// packs well.
///
/// # Errors
/// As [`write_volume`].
pub fn write_steps(path: impl AsRef<Path>, volume: &Volume, description: &str, bits: i32) -> Result<(), IoError> {
    let form = Form { description, ..Form::FLOATS };
    let step = stored_steps(bits);
    write(path.as_ref(), volume.grid(), form, &[volume.as_slice()], |_, v| step(v).to_le_bytes()).map(drop)
}

/// As [`write_volume`], or as [`write_steps`] where `bits` are named, of values that are worked out
/// while they are written: `rows` gives those of whole rows from row `first` of the grid on
/// (`j + ny k`). Of a large volume no more than some rows are ever held.
///
/// # Errors
/// As [`write_volume`].
pub fn write_by_rows(
    path: impl AsRef<Path>,
    grid: &Grid,
    description: &str,
    bits: Option<i32>,
    rows: &(dyn Fn(usize, &mut [f32]) + Sync),
) -> Result<(), IoError> {
    let nx = grid.shape()[0];
    let made = |_: usize, range: Range<usize>| {
        let (first, end) = (range.start / nx, range.end.div_ceil(nx));
        let mut values = vec![0.0f32; nx * (end - first)];
        rows(first, &mut values);
        values.truncate(range.end - nx * first);
        values.drain(..range.start - nx * first);
        Cow::Owned(values)
    };
    let form = Form { description, ..Form::FLOATS };
    let step = bits.map(stored_steps);
    let kept = |_: usize, v: f32| match step {
        Some(step) => step(v).to_le_bytes(),
        None => stored(v).to_le_bytes(),
    };
    write_made(path.as_ref(), grid, form, 1, made, kept).map(drop)
}

/// Writes a volume as int16, each value rounded to the nearest whole number: half the size of
/// [`write_volume`].
///
/// # Errors
/// As [`write_volume`]; also when a value is not finite or does not fit.
pub fn write_integers(path: impl AsRef<Path>, volume: &Volume, description: &str) -> Result<(), IoError> {
    let fits = |v: f32| (f32::from(i16::MIN)..=f32::from(i16::MAX)).contains(&v.round_ties_even());
    if let Some(v) = volume.as_slice().iter().find(|&&v| !fits(v)) {
        let what = format!("the value {v} does not fit in 16 bits");
        return Err(Flaw::new(what, "scale the intensities, or write float32").at(path.as_ref()));
    }
    let form = Form { datatype: 4, bits: 16, description, ..Form::FLOATS };
    write(path.as_ref(), volume.grid(), form, &[volume.as_slice()], |_, v| (v.round_ties_even() as i16).to_le_bytes())
        .map(drop)
}

/// Writes a mask or label map as uint8.
///
/// # Errors
/// As [`write_volume`].
///
/// ```
/// use palpate::{Affine, Grid, Mask, io};
/// let folder = tempfile::tempdir()?;
/// let path = folder.path().join("labels.nii.gz");
/// let grid = Grid::new([6; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let labels = Mask::from_voxels(grid, |_, p| if p.0[0] < 3.0 { 0 } else { 7 });
/// io::write_labels(&path, &labels, "two halves")?;
/// assert_eq!(io::read_labels(&path)?, labels);
/// // A mask is what is not 0.
/// assert!(
///     io::read_mask(&path)?
///         .as_slice()
///         .iter()
///         .zip(labels.as_slice())
///         .all(|(m, l)| (*m != 0) == (*l != 0))
/// );
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn write_labels(path: impl AsRef<Path>, labels: &Mask, description: &str) -> Result<(), IoError> {
    let form = Form { datatype: 2, bits: 8, description, ..Form::FLOATS };
    write(path.as_ref(), labels.grid(), form, &[labels.as_slice()], |_, v: u8| [v]).map(drop)
}

/// Writes a displacement field (mm) as ITK, ANTs and Slicer read it: (nx, ny, nz, 1, 3), intent
/// 1007, float32, LPS.
///
/// Components are rounded to multiples of 2^-12 mm (error at most 2^-13 mm, 0.12 um), or of a
/// thousandth of the finest voxel edge where that is less ([`stored_length`]), so that they pack.
///
/// # Errors
/// As [`write_volume`].
///
/// ```
/// use palpate::{Affine, DenseField, Grid, io};
/// let folder = tempfile::tempdir()?;
/// let path = folder.path().join("displacement.nii.gz");
/// let grid = Grid::new([6; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let field = DenseField::from_fn(grid, |p| [0.25 * p.0[0], 0.0, -0.5]);
/// io::write_field(&path, &field)?;
/// // On disk the components are LPS, in memory RAS.
/// assert_eq!(io::read_field(&path)?, field);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn write_field(path: impl AsRef<Path>, field: &DenseField) -> Result<(), IoError> {
    write_series_field(path, field).map(drop)
}

/// As [`write_field`]; what is given back puts the field into a series (see
/// [`write_field_series`]).
///
/// # Errors
/// As [`write_volume`].
pub(crate) fn write_series_field(path: impl AsRef<Path>, field: &DenseField) -> Result<PackedField, IoError> {
    let form = Form { description: DISPLACEMENT, ..Form::VECTORS };
    let stored = stored_length(field.grid());
    let components = [field.component(0), field.component(1), field.component(2)];
    let runs = write(path.as_ref(), field.grid(), form, &components, |c, v| {
        let lps = if c < 2 { -v } else { v };
        stored(lps).to_le_bytes()
    })?;
    Ok(PackedField { path: path.as_ref().into(), runs })
}

/// Fields whose numbers are not LPS mm.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::io) enum ForeignField {
    /// FSL's relative warp: (nx, ny, nz, 3), FNIRT's intent, scaled-voxel mm.
    Fsl,
    /// NiftyReg's displacement, RAS mm.
    Niftyreg,
    /// Voxels of the field's grid along its axes.
    Voxels,
}

/// Writes a field whose numbers are those of another convention already, as float32, bit for bit.
pub(in crate::io) fn write_foreign_field(path: &Path, field: &DenseField, whose: ForeignField) -> Result<(), IoError> {
    let form = match whose {
        ForeignField::Fsl => {
            Form { flat: true, intent: FNIRT, description: "FSL relative warp, scaled-voxel mm", ..Form::VECTORS }
        }
        ForeignField::Niftyreg => {
            Form { niftyreg: true, description: "NiftyReg displacement, RAS mm", ..Form::VECTORS }
        }
        ForeignField::Voxels => Form { description: "displacement in voxels of this grid", ..Form::VECTORS },
    };
    let components = [field.component(0), field.component(1), field.component(2)];
    write(path, field.grid(), form, &components, |_, v: f32| v.to_le_bytes()).map(drop)
}

/// What the header of a field says.
const DISPLACEMENT: &str = "displacement, initial to deformed, LPS mm";

/// A field as it stands packed in a file.
#[derive(Debug)]
pub(crate) struct PackedField {
    path: PathBuf,
    runs: Vec<Run>,
}

/// Joins fields on one grid into a series over time, (nx, ny, nz, nt, 3), intent 1007, LPS mm,
/// without packing them again; a frame without a field is NaN. `step_s` is the time between frames
/// (s; 0 when not known).
///
/// # Errors
/// [`IoError`] when a frame's file cannot be read any more, or as [`write_volume`].
pub(crate) fn write_field_series(
    path: impl AsRef<Path>,
    grid: &Grid,
    frames: &[Option<PackedField>],
    step_s: f64,
) -> Result<(), IoError> {
    let path = path.as_ref();
    let form = Form { frames: frames.len(), step_s, description: DISPLACEMENT, ..Form::VECTORS };
    let header = header(grid, &form).map_err(|flaw| flaw.at(path))?;
    let missing = |voxels: usize| Chunk::new(&f32::NAN.to_le_bytes().repeat(voxels));
    write_atomic(path, |w| {
        let mut member = Member::start(w)?;
        member.add(&Chunk::new(&header))?;
        for component in 0..3 {
            for frame in frames {
                match frame.as_ref().and_then(|f| Some((&f.path, f.runs.get(component)?))) {
                    Some((file, run)) => member.copy(&mut File::open(file)?, run)?,
                    None => {
                        for from in (0..grid.len()).step_by(VALUES_PER_CHUNK) {
                            member.add(&missing(VALUES_PER_CHUNK.min(grid.len() - from)))?;
                        }
                    }
                }
            }
        }
        member.finish()
    })
}

/// Strains are multiples of 2^-18, four microstrain.
pub(crate) const STRAIN_BITS: i32 = 18;
/// Component of ours, and its sign in LPS, for each one of a tensor on disk.
const ON_DISK: [(usize, f32); 6] = [(0, 1.0), (3, 1.0), (1, 1.0), (4, -1.0), (5, -1.0), (2, 1.0)];

/// Writes a symmetric tensor a voxel as NIfTI's intent 1005 has it: (nx, ny, nz, 1, 6), the lower
/// triangle row by row, with axes in LPS. `tensors` are xx, yy, zz, xy, xz, yz in RAS, x fastest;
/// rounded to multiples of 2^-18.
///
/// # Errors
/// As [`write_volume`].
pub fn write_tensors(
    path: impl AsRef<Path>,
    grid: &Grid,
    tensors: &[[f32; 6]],
    description: &str,
) -> Result<(), IoError> {
    let step = stored_steps(STRAIN_BITS);
    let form = Form { components: 6, intent: SYMMETRIC, description, ..Form::FLOATS };
    write(path.as_ref(), grid, form, &[tensors; 6], |c, t: [f32; 6]| {
        let (component, sign) = ON_DISK[c];
        step(sign * t[component]).to_le_bytes()
    })
    .map(drop)
}

/// Writes standard deviations of the six components of a tensor as [`write_tensors`] does the
/// tensor; they have no sign.
///
/// # Errors
/// As [`write_volume`].
pub(crate) fn write_tensor_deviations(
    path: impl AsRef<Path>,
    grid: &Grid,
    deviations: &[[f32; 6]],
    description: &str,
) -> Result<(), IoError> {
    let form = Form { components: 6, intent: SYMMETRIC, description, ..Form::FLOATS };
    let step = stored_steps(STRAIN_BITS);
    let kept = |c: usize, d: [f32; 6]| step(d[ON_DISK[c].0]).to_le_bytes();
    write(path.as_ref(), grid, form, &[deviations; 6], kept).map(drop)
}

/// Writes several numbers a voxel, (nx, ny, nz, 1, N), rounded to multiples of 2^-`bits`.
///
/// # Errors
/// As [`write_volume`].
pub fn write_vectors<const N: usize>(
    path: impl AsRef<Path>,
    grid: &Grid,
    vectors: &[[f32; N]],
    description: &str,
    bits: i32,
) -> Result<(), IoError> {
    let form = Form { components: N as i16, intent: DIMENSIONLESS, description, ..Form::FLOATS };
    let step = stored_steps(bits);
    write(path.as_ref(), grid, form, &vec![vectors; N], |c, v: [f32; N]| step(v[c]).to_le_bytes()).map(drop)
}

/// Writes samples of a field's error as B-spline coefficients (mm): (nodes along x, y, z, samples,
/// 3), intent 1007, float32, LPS.
///
/// # Errors
/// As [`write_volume`].
pub fn write_samples(path: impl AsRef<Path>, samples: &ErrorSamples) -> Result<(), IoError> {
    let (n, frames) = (samples.nodes().len(), samples.values().len());
    let form = Form { frames, description: "samples of the error of u: cubic B-splines, LPS mm", ..Form::VECTORS };
    let parts: Vec<&[f32]> =
        (0..3).flat_map(|c| samples.values().iter().map(move |s| &s[c * n..(c + 1) * n])).collect();
    let kept = |part: usize, v: f32| stored(if part < 2 * frames { -v } else { v } + 0.0).to_le_bytes();
    write(path.as_ref(), samples.nodes(), form, &parts, kept).map(drop)
}

/// A length (mm) as [`write_field`] keeps it on `grid`: of 10 um voxels 2^-12 mm would be 2 %.
pub fn stored_length(grid: &Grid) -> impl Fn(f32) -> f32 + Copy + Sync + use<> {
    stored_steps(length_bits(grid))
}

/// The same as a number of bits (see [`write_steps`]).
pub(crate) fn length_bits(grid: &Grid) -> i32 {
    let shape = grid.shape();
    let edges = (0..3).filter(|&a| shape[a] > 1).map(|a| grid.spacing()[a]);
    let finer = (COARSE / edges.fold(f64::INFINITY, f64::min)).log2().ceil();
    LENGTH_BITS + finer.clamp(0.0, 24.0) as i32
}

/// A value as [`write_steps`] keeps it.
pub fn stored_steps(bits: i32) -> impl Fn(f32) -> f32 + Copy + Sync {
    let (up, down) = (2f32.powi(bits), 2f32.powi(-bits));
    // Adding 0 turns -0 into 0.
    move |v| (v * up).round_ties_even() * down + 0.0
}

/// A value as [`write_volume`] keeps it: the nearest number with 16 significant bits, ties to even;
/// NaN and infinity stay.
pub fn stored(v: f32) -> f32 {
    if !v.is_finite() {
        return v;
    }
    let (bits, cut) = (v.to_bits(), 23 - MANTISSA_BITS);
    let half = (1 << (cut - 1)) - 1 + (bits >> cut & 1);
    let near = f32::from_bits((bits + half) & !((1 << cut) - 1));
    if near.is_finite() { near } else { v }
}

#[derive(Clone, Copy)]
struct Form<'a> {
    datatype: i16,
    bits: i16,
    /// On the fifth axis; a scalar volume has one and no such axis.
    components: i16,
    intent: i16,
    /// On the fourth axis.
    frames: usize,
    /// From frame to frame (s), 0 when not known.
    step_s: f64,
    description: &'a str,
    /// Whether components are on the fourth axis, as FSL has them.
    flat: bool,
    /// Whether NiftyReg is to take it for a displacement of its own.
    niftyreg: bool,
}

impl Form<'_> {
    const FLOATS: Self = Self {
        datatype: 16,
        bits: 32,
        components: 1,
        intent: 0,
        frames: 1,
        step_s: 0.0,
        description: "",
        flat: false,
        niftyreg: false,
    };
    const VECTORS: Self = Self { components: 3, intent: 1007, ..Self::FLOATS };
}

/// Header, then the parts one after the other; `stored` turns a value of a part (by its number)
/// into bytes. Gives the place of each part in a packed file.
fn write<T: Copy + Sync, const N: usize>(
    path: &Path,
    grid: &Grid,
    form: Form<'_>,
    parts: &[&[T]],
    stored: impl Fn(usize, T) -> [u8; N] + Sync,
) -> Result<Vec<Run>, IoError> {
    write_made(path, grid, form, parts.len(), |part, range| Cow::Borrowed(&parts[part][range]), stored)
}

/// As [`write`], of parts some of whose values are made at a time: `made` gives those of a range of
/// a part.
fn write_made<'a, T: Copy + Sync + 'a, const N: usize>(
    path: &Path,
    grid: &Grid,
    form: Form<'_>,
    parts: usize,
    made: impl Fn(usize, Range<usize>) -> Cow<'a, [T]> + Sync,
    stored: impl Fn(usize, T) -> [u8; N] + Sync,
) -> Result<Vec<Run>, IoError> {
    let name = path.to_string_lossy().to_lowercase();
    let pack = name.ends_with(".nii.gz");
    let text = TextFormat::of(&name);
    if let Some(format) = text.filter(|_| form.frames == 1 && matches!(parts, 1 | 3)) {
        let Form { datatype, description, .. } = form;
        let number = match datatype {
            2 => Kind::U8,
            4 => Kind::I16,
            8 => Kind::I32,
            1024 => Kind::I64,
            _ => Kind::F32,
        };
        let image = TextImage { format, grid, kind: number, components: parts, description };
        let bytes = |part: usize, range: Range<usize>| -> Vec<u8> {
            made(part, range).iter().flat_map(|&v| stored(part, v)).collect()
        };
        return image.write(path, bytes).map(|()| Vec::new());
    }
    if !pack && !name.ends_with(".nii") {
        let flaw = match text {
            Some(_) => Flaw::new("only NIfTI can hold it", "end the name in .nii or .nii.gz"),
            None => Flaw::new("no format is known by this ending", "end the name in .nii, .nii.gz, .nrrd or .mha"),
        };
        return Err(flaw.at(path));
    }
    let header = header(grid, &form).map_err(|flaw| flaw.at(path))?;
    let all = grid.len();
    let ranges = (0..all).step_by(VALUES_PER_CHUNK).map(|from| from..(from + VALUES_PER_CHUNK).min(all));
    let chunks: Vec<(usize, Range<usize>)> = (0..parts).flat_map(|p| ranges.clone().map(move |r| (p, r))).collect();
    let bytes = |(part, range): &(usize, Range<usize>)| -> Vec<u8> {
        let (part, values) = (*part, made(*part, range.clone()));
        let mut bytes = vec![0; N * values.len()];
        dispatch(
            #[inline(always)]
            || bytes.as_chunks_mut::<N>().0.iter_mut().zip(&*values).for_each(|(b, &v)| *b = stored(part, v)),
        );
        bytes
    };
    if !pack {
        return write_atomic(path, |w| {
            w.write_all(&header)?;
            chunks.iter().try_for_each(|chunk| w.write_all(&bytes(chunk)))
        })
        .map(|()| Vec::new());
    }
    let mut runs: Vec<Run> = Vec::new();
    write_atomic(path, |w| {
        let mut member = Member::start(w)?;
        member.add(&Chunk::new(&header))?;
        let mut add = |ready: &[(usize, Chunk)]| {
            ready.iter().try_for_each(|(part, chunk)| {
                if runs.len() == *part {
                    runs.push(member.run());
                }
                member.add_to(&mut runs[*part], chunk)
            })
        };
        let mut ready = Vec::new();
        let threads = rayon::current_num_threads();
        let held = (BATCH[0] * threads.min(FEW)).max(BATCH[1] * threads);
        for batch in chunks.chunks(held) {
            let (written, packed) = rayon::join(
                || add(&ready),
                || batch.par_iter().map(|chunk| (chunk.0, Chunk::new(&bytes(chunk)))).collect(),
            );
            written?;
            ready = packed;
        }
        add(&ready)?;
        member.finish()
    })?;
    Ok(runs)
}

/// A NIfTI-1 header and four zero bytes for "no extensions" (nifti1.h; offsets in bytes).
fn header(grid: &Grid, form: &Form<'_>) -> Result<[u8; 352], Flaw> {
    let mut h = [0; 352];
    let shape = grid.shape();
    let mut dim = [if form.components > 1 { 5i16 } else { 3 }, 1, 1, 1, 1, form.components, 1, 1];
    dim[4] = i16::try_from(form.frames)
        .map_err(|_| Flaw::new(format!("{} frames: NIfTI-1 ends at 32767", form.frames), "cut the series"))?;
    if form.flat {
        (dim[0], dim[4], dim[5]) = (4, form.components, 1);
    }
    for a in 0..3 {
        dim[a + 1] = i16::try_from(shape[a]).map_err(|_| {
            Flaw::new(format!("{shape:?} voxels: NIfTI-1 ends at 32767 an axis"), "crop or resample it")
        })?;
    }
    put(&mut h, 0, &348i32.to_le_bytes());
    put(&mut h, 40, &dim.map(i16::to_le_bytes).concat());
    if form.intent == SYMMETRIC {
        put_floats(&mut h, 56, &[3.0]); // intent_p1: rows of the matrix
    }
    if form.niftyreg {
        put_floats(&mut h, 56, &[1.0]); // intent_p1: a displacement (_reg_maths.h)
        put(&mut h, 328, NIFTYREG);
    }
    put(&mut h, 68, &form.intent.to_le_bytes());
    put(&mut h, 70, &form.datatype.to_le_bytes());
    put(&mut h, 72, &form.bits.to_le_bytes());
    let (rows, size, orientation) = (grid.affine().rows(), grid.spacing(), quaternion(grid.affine()));
    let (qfac, [b, c, d]) = orientation.unwrap_or((1.0, [0.0; 3]));
    let step = if form.step_s > 0.0 { form.step_s } else { 1.0 };
    put_floats(&mut h, 76, &[qfac, size[0], size[1], size[2], step, 1.0, 1.0, 1.0]);
    put_floats(&mut h, 108, &[352.0, 1.0, 0.0]); // vox_offset, scl_slope, scl_inter
    let seconds = if form.step_s > 0.0 { 8 } else { 0 };
    put(&mut h, 123, &[2 + seconds]); // millimetres
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
