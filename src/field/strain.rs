//! How a displacement strains the tissue.

use crate::error::FieldError;
use crate::numerics::differences::{displacement_gradient, gradient_within};
use crate::numerics::small::{Symmetric3, eigenvalues};
use crate::types::{DenseField, Grid, Mask};
use rayon::prelude::*;

/// The Green-Lagrange strain E = (G + G^T + G^T G) / 2 of a displacement gradient G (rows:
/// components; 1), that is (F^T F - I) / 2: free of rotation, on the initial configuration
/// (Holzapfel 2000, eq. 2.69).
pub fn green_lagrange(g: &[[f64; 3]; 3]) -> Symmetric3 {
    let e = |r: usize, c: usize| 0.5 * (g[r][c] + g[c][r] + (0..3).map(|k| g[k][r] * g[k][c]).sum::<f64>());
    [e(0, 0), e(1, 1), e(2, 2), e(0, 1), e(0, 2), e(1, 2)]
}

/// Green-Lagrange strain at every voxel, from central differences (one-sided at the border), axes
/// in RAS.
#[derive(Debug, Clone, PartialEq)]
pub struct StrainField {
    grid: Grid,
    /// xx, yy, zz, xy, xz, yz, one voxel after the other, x fastest.
    values: Vec<[f32; 6]>,
}

impl StrainField {
    /// Of a displacement field.
    pub fn of(field: &DenseField) -> Self {
        let grid = *field.grid();
        let strain = |at| green_lagrange(&displacement_gradient(field, grid.voxel(at))).map(|v| v as f32);
        Self { grid, values: (0..grid.len()).into_par_iter().map(strain).collect() }
    }

    /// Of a displacement field of `bodies` (labels, 0 outside them) that slide along each other: no
    /// difference is taken from one to another.
    ///
    /// # Errors
    /// [`FieldError::GridMismatch`] when the labels lie on another grid.
    pub fn of_bodies(field: &DenseField, bodies: &Mask) -> Result<Self, FieldError> {
        let grid = *field.grid();
        if !bodies.grid().same_as(&grid) {
            return Err(FieldError::GridMismatch {
                what: "the bodies".into(),
                found: bodies.grid().shape(),
                reference: "the field".into(),
                expected: grid.shape(),
            });
        }
        let labels = bodies.as_slice();
        let strain = |at| green_lagrange(&gradient_within(field, labels, grid.voxel(at))).map(|v| v as f32);
        Ok(Self { grid, values: (0..grid.len()).into_par_iter().map(strain).collect() })
    }

    /// The lattice.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// The tensors, x fastest: xx, yy, zz, xy, xz, yz (1).
    pub fn tensors(&self) -> &[[f32; 6]] {
        &self.values
    }

    /// Principal strains at a voxel offset, largest first (1).
    pub fn principal(&self, offset: usize) -> [f64; 3] {
        eigenvalues(&self.values[offset].map(f64::from))
    }
}

/// What the strain is like over a set of voxels.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct StrainStatistics {
    /// Voxels.
    pub voxels: usize,
    /// Mean principal strains, largest first (1).
    pub mean: [f64; 3],
    /// 98th percentile of the largest principal strain and 2nd of the smallest (1).
    pub peak: [f64; 2],
    /// Mean and 98th percentile of the largest shear (E1 - E3) / 2 (1).
    pub shear: [f64; 2],
    /// Mean relative change of volume, det F - 1 (1), with det F^2 = det(I + 2 E).
    pub volume_change: f64,
}

impl StrainStatistics {
    /// Over the voxels with these offsets.
    pub fn over(strain: &StrainField, offsets: &[usize]) -> Self {
        let principal: Vec<[f64; 3]> = offsets.par_iter().map(|&o| strain.principal(o)).collect();
        let n = principal.len().max(1) as f64;
        let mean_of = |f: &dyn Fn(&[f64; 3]) -> f64| principal.iter().map(f).sum::<f64>() / n;
        let percentile = |f: &dyn Fn(&[f64; 3]) -> f64, p: f64| {
            let mut values: Vec<f64> = principal.iter().map(f).collect();
            if values.is_empty() { 0.0 } else { crate::numerics::statistics::percentile(&mut values, p) }
        };
        let shear = |e: &[f64; 3]| (e[0] - e[2]) / 2.0;
        Self {
            voxels: principal.len(),
            mean: std::array::from_fn(|k| mean_of(&|e| e[k])),
            peak: [percentile(&|e| e[0], 98.0), percentile(&|e| e[2], 2.0)],
            shear: [mean_of(&shear), percentile(&shear, 98.0)],
            volume_change: mean_of(&|e| e.iter().map(|v| 1.0 + 2.0 * v).product::<f64>().max(0.0).sqrt() - 1.0),
        }
    }
}
