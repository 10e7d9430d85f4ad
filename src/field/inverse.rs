//! The field that undoes a field.
//!
//! For each y the inverse v solves v = -u(y + v), u being trilinear: see
//! `crate::numerics::inversion`. Beyond its grid, u is held at the value of the nearest edge.
//! Where u folds there is no inverse or more than one: folds are counted, since each y may still
//! have an x that leads to it.

use crate::field::jacobian::count_folds;
use crate::numerics::inversion::{origin_of, residual};
use crate::numerics::sampling::inside;
use crate::types::space::length;
use crate::types::{DenseField, Grid};
use rayon::prelude::*;

/// Convergence tolerance (mm): under the resolution of single precision on a metre-sized grid.
const CONVERGENCE_TOLERANCE_MM: f64 = 1e-5;

/// An inverse field and how good it is.
#[derive(Debug, Clone, PartialEq)]
pub struct Inverse {
    /// Displacement from deformed to initial places (mm, RAS).
    pub field: DenseField,
    /// Largest |v(y) + u(y + v(y))| over the voxels whose initial place is on the field's grid
    /// (mm).
    pub max_residual_mm: f64,
    /// Voxels of the field that fold or turn inside out: what lies there has no inverse, or more
    /// than one.
    pub folds: usize,
    /// Voxels of the field without a finite displacement: what would come from there has no
    /// inverse.
    pub not_finite: usize,
    /// Voxels whose initial place lies off the field's grid, where v rests on the edge values.
    pub outside: usize,
}

/// The inverse of `field` on `grid` (the field's own when `None`).
///
/// ```
/// use palpate::field::inverse::invert;
/// use palpate::{Affine, DenseField, Grid};
/// let grid = Grid::new([24; 3], Affine::scaled([1.0; 3], [-11.5; 3])?)?;
/// // y = 1.25 x has the inverse x = 0.8 y.
/// let stretch = DenseField::from_fn(grid, |p| [0.25 * p.0[0], 0.0, 0.0]);
/// let inverse = invert(&stretch, None);
/// let at = grid.index(16, 12, 12);
/// assert!((f64::from(inverse.field.at(at)[0]) + 0.2 * grid.centre(at).0[0]).abs() < 1e-4);
/// assert_eq!(inverse.folds, 0);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn invert(field: &DenseField, grid: Option<&Grid>) -> Inverse {
    let target = *grid.unwrap_or(field.grid());
    let inverse = DenseField::from_voxels(target, |_, y| origin_of(field, y, CONVERGENCE_TOLERANCE_MM).minus(y));
    let (max_residual_mm, outside) = (0..target.len())
        .into_par_iter()
        .map(|at| {
            let [i, j, k] = target.voxel(at);
            let y = target.world(i, j, k);
            let x = y.moved(inverse.at(at).map(f64::from));
            match inside(field.grid().shape(), field.grid().affine().to_voxel(x)) {
                true => (length(residual(field, x, y)), 0),
                false => (0.0, 1),
            }
        })
        .reduce(|| (0.0, 0), |a, b| (f64::max(a.0, b.0), a.1 + b.1));
    let folds = count_folds(field, None).unwrap_or(0);
    let not_finite = (0..field.grid().len()).filter(|&at| field.at(at).iter().any(|v| !v.is_finite())).count();
    Inverse { field: inverse, max_residual_mm, folds, not_finite, outside }
}
