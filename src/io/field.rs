//! Displacement fields in the conventions of the programs that write them.
//!
//! | convention | components | source |
//! |---|---|---|
//! | `lps` | displacement, mm, LPS | ITK, ANTs, greedy, Slicer, plastimatch |
//! | `ras` | displacement, mm, RAS | - |
//! | `fsl` | displacement, FSL's scaled-voxel mm | FNIRT user guide; `applywarp --rel` |
//! | `fsl-absolute` | place, FSL's scaled-voxel mm | the same; `applywarp --abs` |
//! | `niftyreg` | displacement or place, mm, RAS | `reg_transform -disp`, `-def` |
//!
//! The header of a field of NiftyReg says which of both it holds.
//!
//! FSL's coordinates are voxels times the voxel size, with x counted from the far end where the
//! affine has a positive determinant.

use super::format_error::Flaw;
use super::image::{Format, raw_field};
use super::nifti;
use crate::error::{IoError, UnknownName};
use crate::types::names::choose;
use crate::types::{DenseField, ErrorSamples, Grid, VoxelPoint, WorldPoint};
use std::path::Path;
use std::str::FromStr;

/// What the numbers of a field stand for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum FieldConvention {
    /// Displacement in mm, LPS: ITK, ANTs, greedy, Slicer, and palpate.
    #[default]
    Lps,
    /// Displacement in mm, RAS.
    Ras,
    /// FSL's relative warp.
    Fsl,
    /// FSL's absolute warp.
    FslAbsolute,
    /// NiftyReg's displacement or deformation field.
    Niftyreg,
}

impl FromStr for FieldConvention {
    type Err = UnknownName;

    fn from_str(name: &str) -> Result<Self, UnknownName> {
        let known = [
            ("lps", Self::Lps),
            ("ras", Self::Ras),
            ("fsl", Self::Fsl),
            ("fsl-absolute", Self::FslAbsolute),
            ("niftyreg", Self::Niftyreg),
        ];
        choose("field convention", name, &known)
    }
}

/// Reads a displacement field (mm): NIfTI (nx, ny, nz, 1, 3) with intent 1007 or 1006, or NRRD or
/// MetaImage with three numbers a voxel; LPS components on disk, RAS in memory.
///
/// The components are millimetres whatever `xyzt_units` says, as ITK takes them.
///
/// # Errors
/// [`IoError`] when the file cannot be read, is cut short or damaged, or is not such a field.
pub fn read_field(path: impl AsRef<Path>) -> Result<DenseField, IoError> {
    read_field_as(path, FieldConvention::Lps, None)
}

/// Reads a displacement field in another program's convention. `deformed` is the grid of the volume
/// that the field leads to, which FSL's numbers refer to; the field's own without.
///
/// # Errors
/// As [`read_field`]; also when the header says that the field is in another convention.
pub fn read_field_as(
    path: impl AsRef<Path>,
    convention: FieldConvention,
    deformed: Option<&Grid>,
) -> Result<DenseField, IoError> {
    let path = path.as_ref();
    let fsl = matches!(convention, FieldConvention::Fsl | FieldConvention::FslAbsolute);
    let (grid, mut values, place) = match Format::of(path)? {
        Format::Nifti => {
            let (grid, values, intent) = nifti::read::field(path, fsl)?;
            if intent.niftyreg != (convention == FieldConvention::Niftyreg) {
                let flaw = match intent.niftyreg {
                    true => Flaw::new("was written by NiftyReg", "read it with --field-convention niftyreg"),
                    false => Flaw::new("was not written by NiftyReg", "leave --field-convention out, or name another"),
                };
                return Err(flaw.at(path));
            }
            // _reg_maths.h: 0 is a deformation, 1 a displacement; the others are control points and
            // velocities.
            if intent.niftyreg && ![0.0, 1.0].contains(&intent.kind) {
                let what = "holds NiftyReg's control points or velocities, not a field";
                return Err(Flaw::new(what, "make one with reg_transform -disp").at(path));
            }
            (grid, values, intent.niftyreg && intent.kind == 0.0)
        }
        Format::Dicom => {
            return Err(Flaw::new("is a folder or DICOM, not a field", "name the file of a field").at(path));
        }
        format if convention == FieldConvention::Lps || convention == FieldConvention::Ras => {
            let (grid, values) = raw_field(path, format)?;
            (grid, values, false)
        }
        _ => return Err(Flaw::new("is not NIfTI, as FSL and NiftyReg write", "leave --field-convention out").at(path)),
    };
    let n = grid.len();
    match convention {
        FieldConvention::Lps => values[..2 * n].iter_mut().for_each(|v| *v = -*v),
        FieldConvention::Ras | FieldConvention::Niftyreg if !place => {}
        FieldConvention::Ras | FieldConvention::Niftyreg => each(&grid, &mut values, |x, v| WorldPoint(v).minus(x)),
        FieldConvention::Fsl | FieldConvention::FslAbsolute => {
            let (from, to) = (Scaled::of(&grid), Scaled::of(deformed.unwrap_or(&grid)));
            let relative = convention == FieldConvention::Fsl;
            each(&grid, &mut values, |x, v| {
                let start = if relative { from.place(x) } else { [0.0; 3] };
                to.world(std::array::from_fn(|a| start[a] + v[a])).minus(x)
            });
        }
    }
    DenseField::from_vec(grid, values).map_err(|e| Flaw::new(e.to_string(), "export it again").at(path))
}

/// Reads samples of a field's error as `write_samples` leaves them.
///
/// # Errors
/// As [`read_field`].
pub fn read_samples(path: impl AsRef<Path>) -> Result<ErrorSamples, IoError> {
    let path = path.as_ref();
    let (nodes, mut values) = nifti::read::samples(path)?;
    for sample in &mut values {
        sample[..2 * nodes.len()].iter_mut().for_each(|v| *v = -*v);
    }
    if values.iter().flatten().any(|v| !v.is_finite()) {
        return Err(Flaw::new("holds a value that is not finite", "measure the field again").at(path));
    }
    ErrorSamples::new(nodes, values).map_err(|e| Flaw::new(e.to_string(), "measure the field again").at(path))
}

/// Replaces each voxel's three numbers by what `f` makes of its centre and of them.
fn each(grid: &Grid, values: &mut [f32], f: impl Fn(WorldPoint, [f64; 3]) -> [f64; 3]) {
    let n = grid.len();
    for at in 0..n {
        let [i, j, k] = grid.voxel(at);
        let d = f(grid.world(i, j, k), std::array::from_fn(|c| f64::from(values[c * n + at])));
        (0..3).for_each(|c| values[c * n + at] = d[c] as f32);
    }
}

/// FSL's coordinates of a grid: voxels times their size, x from the far end where the determinant
/// is positive.
pub(super) struct Scaled {
    grid: Grid,
    size: [f64; 3],
    /// The place of voxel 0 along x, where x is turned round.
    turned: Option<f64>,
}

impl Scaled {
    pub(super) fn of(grid: &Grid) -> Self {
        let size = grid.spacing();
        let turned = crate::types::space::determinant(grid.affine().linear()) > 0.0;
        Self { grid: *grid, size, turned: turned.then(|| (grid.shape()[0] - 1) as f64 * size[0]) }
    }

    pub(super) fn place(&self, x: WorldPoint) -> [f64; 3] {
        let v = self.grid.affine().to_voxel(x).0;
        let mut out: [f64; 3] = std::array::from_fn(|a| v[a] * self.size[a]);
        if let Some(far) = self.turned {
            out[0] = far - out[0];
        }
        out
    }

    pub(super) fn world(&self, mut place: [f64; 3]) -> WorldPoint {
        if let Some(far) = self.turned {
            place[0] = far - place[0];
        }
        self.grid.affine().to_world(VoxelPoint(std::array::from_fn(|a| place[a] / self.size[a])))
    }
}
