//! Gradients by finite differences on a grid, with respect to world millimetres.
//!
//! Central inside, one-sided at the borders, zero along an axis of one voxel; second order inside,
//! first order at the borders. The affine may be oblique, flipped or anisotropic. These are
//! `numpy.gradient`'s differences times the inverse of the affine's linear part, so that scores
//! made elsewhere agree.

use crate::types::DenseField;
use crate::types::space::{Grid, Matrix3};

/// The gradient of `values` (x fastest, on `grid`) at a voxel: derivatives by world x, y, z (a mm).
#[inline]
pub fn gradient(values: &[f32], grid: &Grid, voxel: [usize; 3]) -> [f64; 3] {
    let shape = grid.shape();
    let strides = [1, shape[0], shape[0] * shape[1]];
    let at = grid.index(voxel[0], voxel[1], voxel[2]);
    let by_voxel: [f64; 3] = std::array::from_fn(|a| {
        let before = usize::from(voxel[a] > 0);
        let after = usize::from(voxel[a] + 1 < shape[a]);
        if before + after == 0 {
            return 0.0;
        }
        let rise = f64::from(values[at + after * strides[a]]) - f64::from(values[at - before * strides[a]]);
        rise / (before + after) as f64
    });
    let inverse = grid.affine().inverse_linear();
    std::array::from_fn(|w| (0..3).map(|a| by_voxel[a] * inverse[a][w]).sum())
}

/// The displacement gradient at a voxel: row = component of u, column = world axis (1).
#[inline]
pub fn displacement_gradient(field: &DenseField, voxel: [usize; 3]) -> Matrix3 {
    std::array::from_fn(|c| gradient(field.component(c), field.grid(), voxel))
}

/// The deformation gradient of x + u(x) from the displacement gradient: identity + `g`.
pub fn deformation_gradient(g: Matrix3) -> Matrix3 {
    std::array::from_fn(|r| std::array::from_fn(|c| g[r][c] + f64::from(u8::from(r == c))))
}
