//! Writing transforms for other programs.

use super::matrix::to_flirt;
use crate::error::IoError;
use crate::io::field::Scaled;
use crate::io::format_error::Flaw;
use crate::io::nifti::{ForeignField, write_field, write_foreign_field};
use crate::io::{write_bytes, write_text};
use crate::types::{AffineMap, DenseField, Grid};
use std::path::Path;

/// How to write an affine map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum AffineFormat<'a> {
    /// ITK's, ANTs's: text, or MATLAB level 4 where the name ends in `.mat`; LPS.
    Itk,
    /// greedy's, NiftyReg's: 4 x 4 text, RAS mm, fixed to moving.
    Matrix,
    /// FLIRT's: 4 x 4 text, moving to fixed, in the scaled voxels of two volumes.
    Flirt {
        /// Grid of the fixed volume, FLIRT's `-ref`.
        initial: &'a Grid,
        /// Grid of the moving volume, FLIRT's `-in`.
        deformed: &'a Grid,
    },
}

/// How to write a displacement field.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum FieldFormat<'a> {
    /// LPS mm: ITK's, ANTs's, greedy's, ours; `.nii`, `.nii.gz`, `.nrrd` or `.mha`.
    Itk,
    /// FSL's relative warp, scaled-voxel mm to the grid of the moving volume; NIfTI.
    Fsl {
        /// Grid of the moving volume.
        deformed: &'a Grid,
    },
    /// NiftyReg's displacement, RAS mm; NIfTI.
    Niftyreg,
    /// Displacement along the axes of the field's grid, in voxels of it.
    Voxels,
}

/// Writes an affine map (world mm, RAS, initial to deformed) as another program reads it, with all
/// digits.
///
/// # Errors
/// [`IoError`] when the file cannot be written, or a grid lies absurdly far off.
///
/// ```
/// use palpate::AffineMap;
/// use palpate::io::{AffineFormat, TransformSource, read_transform, write_affine};
/// use palpate::types::Transform;
/// let folder = tempfile::tempdir()?;
/// let path = folder.path().join("affine.txt");
/// let map = AffineMap::new([[1.0, 0.0, 0.0, 4.0], [0.0, 1.0, 0.0, -2.0], [0.0, 0.0, 1.0, 0.0]])?;
/// write_affine(&path, &map, AffineFormat::Itk)?;
/// let stored = read_transform(&path, Some(TransformSource::Itk), None, None)?;
/// assert_eq!(stored.transforms, [Transform::Affine(map)]);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn write_affine(path: impl AsRef<Path>, map: &AffineMap, format: AffineFormat<'_>) -> Result<(), IoError> {
    let path = path.as_ref();
    let matrix = match format {
        AffineFormat::Itk => return write_itk(path, map),
        AffineFormat::Matrix => *map,
        AffineFormat::Flirt { initial, deformed } => to_flirt(path, map, initial, deformed)?,
    };
    let lines = matrix.rows().map(|row| joined(&row) + "\n").concat();
    write_text(path, &(lines + "0 0 0 1\n"))
}

/// Parameters as ITK has them: the matrix row by row and the shift, in LPS, about the origin.
fn write_itk(path: &Path, map: &AffineMap) -> Result<(), IoError> {
    const NAME: &str = "AffineTransform_double_3_3";
    let sign = [-1.0, -1.0, 1.0];
    let rows = map.rows();
    let mut parameters = [0.0; 12];
    for r in 0..3 {
        (0..3).for_each(|c| parameters[3 * r + c] = sign[r] * sign[c] * rows[r][c] + 0.0);
        parameters[9 + r] = sign[r] * rows[r][3] + 0.0;
    }
    if path.to_string_lossy().to_lowercase().ends_with(".mat") {
        let matrix = |name: &str, values: &[f64]| -> Vec<u8> {
            let head = [0, values.len() as i32, 1, 0, name.len() as i32 + 1];
            let values = values.iter().flat_map(|v| v.to_le_bytes());
            head.iter().flat_map(|n| n.to_le_bytes()).chain(name.bytes()).chain([0]).chain(values).collect()
        };
        return write_bytes(path, &[matrix(NAME, &parameters), matrix("fixed", &[0.0; 3])].concat());
    }
    let text = format!(
        "#Insight Transform File V1.0\n#Transform 0\nTransform: {NAME}\nParameters: {}\nFixedParameters: 0 0 0\n",
        joined(&parameters)
    );
    write_text(path, &text)
}

fn joined(values: &[f64]) -> String {
    values.iter().map(f64::to_string).collect::<Vec<_>>().join(" ")
}

/// Writes a displacement field (mm, RAS, initial to deformed) as another program reads it.
///
/// # Errors
/// [`IoError`] when the name's ending does not go with the format, an axis is too long for NIfTI
/// or the file cannot be written.
pub fn write_field_as(path: impl AsRef<Path>, field: &DenseField, format: FieldFormat<'_>) -> Result<(), IoError> {
    let (path, grid) = (path.as_ref(), field.grid());
    let name = path.to_string_lossy().to_lowercase();
    let nifti = name.ends_with(".nii") || name.ends_with(".nii.gz");
    if matches!(format, FieldFormat::Fsl { .. } | FieldFormat::Niftyreg) && !nifti {
        return Err(Flaw::new("FSL and NiftyReg read NIfTI alone", "end the name in .nii or .nii.gz").at(path));
    }
    let u = |at: usize| field.at(at).map(f64::from);
    match format {
        FieldFormat::Itk => write_field(path, field),
        FieldFormat::Niftyreg => write_foreign_field(path, field, ForeignField::Niftyreg),
        FieldFormat::Fsl { deformed } => {
            let (from, to) = (Scaled::of(grid), Scaled::of(deformed));
            let warp = DenseField::from_voxels(*grid, |at, x| {
                let (start, end) = (from.place(x), to.place(x.moved(u(at))));
                std::array::from_fn(|a| end[a] - start[a])
            });
            write_foreign_field(path, &warp, ForeignField::Fsl)
        }
        FieldFormat::Voxels => {
            let voxels = DenseField::from_voxels(*grid, |at, _| grid.affine().vector_to_voxel(u(at)));
            write_foreign_field(path, &voxels, ForeignField::Voxels)
        }
    }
}
