//! Reading volumes, label maps and displacement fields.

use super::affine::affine;
use super::flaw::Flaw;
use super::header::{Header, LONGEST};
use crate::error::IoError;
use crate::io::{gzip, os};
use crate::types::{DenseField, Grid, Mask, Volume};
use rayon::prelude::*;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

/// Reads a scalar volume: (nx, ny, nz), in the file's intensity unit after its scaling.
///
/// Axes past the third must have length 1. Values that are not finite are given as they are (see
/// [`count_non_finite`]); float64 beyond float32 becomes infinite.
///
/// # Errors
/// [`IoError`] when the file cannot be read, is cut short or damaged, or is not a scalar volume of numbers.
pub fn read_volume(path: impl AsRef<Path>) -> Result<Volume, IoError> {
    let (grid, values) = load(path.as_ref(), scalar_layout)?;
    Volume::from_vec(grid, values).map_err(|e| Flaw::new(e.to_string(), "export it again").at(path.as_ref()))
}

/// Reads a label map: whole numbers 0 to 255, stored as any type.
///
/// # Errors
/// As [`read_volume`]; also when a value is anything else.
pub fn read_labels(path: impl AsRef<Path>) -> Result<Mask, IoError> {
    let path = path.as_ref();
    let volume = read_volume(path)?;
    let grid = *volume.grid();
    let odd = volume.as_slice().iter().position(|&v| !(0.0..=255.0).contains(&v) || v.fract() != 0.0);
    if let Some(at) = odd {
        let [nx, ny, _] = grid.shape();
        let (v, i, j, k) = (volume.as_slice()[at], at % nx, at / nx % ny, at / nx / ny);
        let what = format!("voxel ({i}, {j}, {k}) is {v}, but labels are whole numbers from 0 to 255");
        return Err(Flaw::new(what, "give a mask or label map, resampled with nearest neighbour").at(path));
    }
    let labels = volume.into_vec().into_iter().map(|v| v as u8).collect();
    Mask::from_vec(grid, labels).map_err(|e| Flaw::new(e.to_string(), "export it again").at(path))
}

/// Reads a mask: 0 is outside, 1 to 255 inside (labels are kept).
///
/// # Errors
/// As [`read_labels`].
pub fn read_mask(path: impl AsRef<Path>) -> Result<Mask, IoError> {
    read_labels(path)
}

/// Reads a displacement field (mm): (nx, ny, nz, 1, 3), intent 1007 or 1006, LPS components on disk, RAS in memory.
///
/// The components are millimetres whatever `xyzt_units` says, as ITK takes them.
///
/// # Errors
/// [`IoError`] when the file cannot be read, is cut short or damaged, or is not such a field.
pub fn read_field(path: impl AsRef<Path>) -> Result<DenseField, IoError> {
    let (grid, mut values) = load(path.as_ref(), field_layout)?;
    values[..2 * grid.len()].iter_mut().for_each(|v| *v = -*v);
    DenseField::from_vec(grid, values).map_err(|e| Flaw::new(e.to_string(), "export it again").at(path.as_ref()))
}

/// Voxels that are NaN or infinite.
pub fn count_non_finite(volume: &Volume) -> usize {
    volume.as_slice().iter().filter(|v| !v.is_finite()).count()
}

/// A scalar volume has one component.
fn scalar_layout(h: &Header, axes: [usize; 7]) -> Result<usize, Flaw> {
    if axes[4] == 3 && axes[3] == 1 {
        let what = format!("is a vector field (dim {:?}, intent {}), not a scalar volume", axes, h.intent);
        return Err(Flaw::new(what, "give an image here; fields go to --field or to `palpate warp`"));
    }
    match axes[3..].iter().product::<usize>() {
        1 => Ok(1),
        n => Err(Flaw::new(
            format!("is a series of {n} volumes (dim {:?}), one is needed", &axes[..h.dim[0] as usize]),
            "take one volume out of it (for example fslroi IN OUT 0 1, or nibabel's slicer)",
        )),
    }
}

/// A displacement field has three.
fn field_layout(h: &Header, axes: [usize; 7]) -> Result<usize, Flaw> {
    let hint = "give a displacement field as palpate, ANTs or ITK write it";
    if axes[3..] != [1, 3, 1, 1] {
        let dim = &axes[..h.dim[0] as usize];
        return Err(Flaw::new(format!("is not a displacement field: dim {dim:?} instead of (x, y, z, 1, 3)"), hint));
    }
    match h.intent {
        1006 | 1007 => Ok(3),
        code => Err(Flaw::new(format!("is not a displacement field: intent {code} instead of 1007 (vector)"), hint)),
    }
}

type Layout = fn(&Header, [usize; 7]) -> Result<usize, Flaw>;

/// A regular file, its size and its first bytes, at most [`LONGEST`].
pub(super) fn open(path: &Path) -> Result<(File, u64, Vec<u8>), IoError> {
    let mut file = File::open(path).map_err(os(path, "read"))?;
    let metadata = file.metadata().map_err(os(path, "read"))?;
    if !metadata.is_file() {
        return Err(Flaw::new("is not a regular file", "give a .nii or .nii.gz").at(path));
    }
    let mut head = Vec::new();
    file.by_ref().take(LONGEST as u64).read_to_end(&mut head).map_err(os(path, "read"))?;
    Ok((file, metadata.len(), head))
}

/// The grid and all values, component after component; `layout` judges the axes and gives the number of components.
fn load(path: &Path, layout: Layout) -> Result<(Grid, Vec<f32>), IoError> {
    let (mut file, size, mut head) = open(path)?;
    let packed = if gzip::is_gzip(&head) {
        file.read_to_end(&mut head).map_err(os(path, "read"))?;
        let packed = std::mem::take(&mut head);
        head = gzip::peek(&packed, LONGEST);
        Some(packed)
    } else {
        None
    };

    let plan = Plan::new(&head, layout).map_err(|flaw| flaw.at(path))?;
    let values = match packed {
        Some(packed) => {
            let most = (packed.len() as u64).saturating_mul(gzip::LARGEST_RATIO);
            let end = plan.end_within(most).map_err(|flaw| flaw.at(path))?;
            let data = gzip::unpack(&packed, end).map_err(|e| {
                Flaw::new(format!("its gzip stream is damaged or cut short ({e})"), "copy or export it again").at(path)
            })?;
            plan.end_within(data.len() as u64).map_err(|flaw| flaw.at(path))?;
            decode(&plan, &data[plan.start as usize..end])
        }
        None => {
            let end = plan.end_within(size).map_err(|flaw| flaw.at(path))?;
            let mut data = vec![0; end - plan.start as usize];
            file.seek(SeekFrom::Start(plan.start))
                .and_then(|_| file.read_exact(&mut data))
                .map_err(os(path, "read"))?;
            decode(&plan, &data)
        }
    };
    Ok((plan.grid, values))
}

/// What the header says about the voxels, checked.
pub(super) struct Plan {
    pub(super) grid: Grid,
    kind: Kind,
    big_endian: bool,
    scaling: (f64, f64),
    /// First byte and number of bytes.
    pub(super) start: u64,
    pub(super) bytes: u64,
}

impl Plan {
    pub(super) fn new(head: &[u8], layout: Layout) -> Result<Self, Flaw> {
        let header = Header::parse(head)?;
        let axes = header.axes()?;
        let kind = Kind::from_code(header.datatype)?;
        let components = layout(&header, axes)?;
        let shape = [axes[0], axes[1], axes[2]];
        let grid = Grid::new(shape, affine(&header, shape)?)
            .map_err(|e| Flaw::new(e.to_string(), "if that is not its true size, the header is damaged"))?;
        Ok(Self {
            grid,
            kind,
            big_endian: header.big_endian,
            scaling: header.scaling()?,
            start: header.data_offset()?,
            bytes: (grid.len() * components * kind.size()) as u64,
        })
    }

    /// The end of the voxels, when a file that unpacks to at most `size` bytes can hold them.
    pub(super) fn end_within(&self, size: u64) -> Result<usize, Flaw> {
        let end = self.start.saturating_add(self.bytes);
        usize::try_from(end).ok().filter(|_| end <= size).ok_or_else(|| {
            let shape = self.grid.shape();
            let what = format!("needs {end} bytes for its {shape:?} voxels but holds at most {size}");
            Flaw::new(what, "the file is cut short or its header is damaged: copy or export it again")
        })
    }
}

/// How a voxel is stored.
#[derive(Debug, Clone, Copy)]
enum Kind {
    U8,
    I8,
    U16,
    I16,
    U32,
    I32,
    U64,
    I64,
    F32,
    F64,
}

impl Kind {
    /// From a `NIFTI_TYPE_*` code.
    fn from_code(code: i16) -> Result<Self, Flaw> {
        let name = match code {
            2 => return Ok(Self::U8),
            4 => return Ok(Self::I16),
            8 => return Ok(Self::I32),
            16 => return Ok(Self::F32),
            64 => return Ok(Self::F64),
            256 => return Ok(Self::I8),
            512 => return Ok(Self::U16),
            768 => return Ok(Self::U32),
            1024 => return Ok(Self::I64),
            1280 => return Ok(Self::U64),
            32 | 1792 | 2048 => "complex numbers",
            128 | 2304 => "RGB colours",
            1536 => "float128",
            _ => return Err(Flaw::new(format!("has an unknown datatype ({code})"), "export it again as float32")),
        };
        Err(Flaw::new(
            format!("holds {name} (datatype {code})"),
            "convert it to one real number a voxel, such as float32",
        ))
    }

    fn size(self) -> usize {
        match self {
            Self::U8 | Self::I8 => 1,
            Self::U16 | Self::I16 => 2,
            Self::U32 | Self::I32 | Self::F32 => 4,
            Self::U64 | Self::I64 | Self::F64 => 8,
        }
    }
}

pub(super) fn decode(plan: &Plan, bytes: &[u8]) -> Vec<f32> {
    macro_rules! decode_as {
        ($t:ty) => {
            if plan.big_endian {
                convert(bytes, plan.scaling, |b| <$t>::from_be_bytes(b) as f64)
            } else {
                convert(bytes, plan.scaling, |b| <$t>::from_le_bytes(b) as f64)
            }
        };
    }
    match plan.kind {
        Kind::U8 => decode_as!(u8),
        Kind::I8 => decode_as!(i8),
        Kind::U16 => decode_as!(u16),
        Kind::I16 => decode_as!(i16),
        Kind::U32 => decode_as!(u32),
        Kind::I32 => decode_as!(i32),
        Kind::U64 => decode_as!(u64),
        Kind::I64 => decode_as!(i64),
        Kind::F32 => decode_as!(f32),
        Kind::F64 => decode_as!(f64),
    }
}

fn convert<const N: usize>(
    bytes: &[u8],
    (slope, intercept): (f64, f64),
    stored: impl Fn([u8; N]) -> f64 + Sync,
) -> Vec<f32> {
    let voxels = bytes.as_chunks::<N>().0;
    voxels.par_iter().with_min_len(1 << 16).map(|&b| (slope * stored(b) + intercept) as f32).collect()
}
