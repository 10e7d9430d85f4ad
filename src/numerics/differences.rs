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
    gradient_where(values, grid, voxel, |_| true)
}

/// As [`gradient`], from the voxel and those of its neighbours (offsets, x fastest) that count:
/// one-sided beside one that does not.
#[inline]
fn gradient_where(values: &[f32], grid: &Grid, voxel: [usize; 3], counts: impl Fn(usize) -> bool) -> [f64; 3] {
    let shape = grid.shape();
    let strides = [1, shape[0], shape[0] * shape[1]];
    let at = grid.index(voxel[0], voxel[1], voxel[2]);
    let by_voxel: [f64; 3] = std::array::from_fn(|a| {
        let before = usize::from(voxel[a] > 0 && counts(at - strides[a]));
        let after = usize::from(voxel[a] + 1 < shape[a] && counts(at + strides[a]));
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

/// As [`displacement_gradient`], without differences to voxels of another body; `labels` (x
/// fastest) are 0 outside all.
#[inline]
pub fn gradient_within(field: &DenseField, labels: &[u8], voxel: [usize; 3]) -> Matrix3 {
    let own = labels[field.grid().index(voxel[0], voxel[1], voxel[2])];
    let counts = |at: usize| own == 0 || labels[at] == 0 || labels[at] == own;
    std::array::from_fn(|c| gradient_where(field.component(c), field.grid(), voxel, counts))
}

/// The deformation gradient of x + u(x) from the displacement gradient: identity + `g`.
pub fn deformation_gradient(g: Matrix3) -> Matrix3 {
    std::array::from_fn(|r| std::array::from_fn(|c| g[r][c] + f64::from(u8::from(r == c))))
}
