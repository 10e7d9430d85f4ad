//! How much a field swells or shrinks the tissue, and where it folds.
//!
//! Derivatives are central differences, one-sided at the border. In a one-slice volume nothing is known of the motion's
//! change through the slice, so that derivative is zero and the determinant is that of the in-plane 2 x 2 block.

use crate::error::FieldError;
use crate::numerics::filters::gradient_rows;
use crate::numerics::simd::dispatch;
use crate::types::{DenseField, Mask, Volume};
use rayon::prelude::*;

/// The Jacobian determinant of x + u(x) with respect to world mm (1): 1 = volume kept, at or below 0 = folded.
pub fn jacobian_determinant(field: &DenseField) -> Volume {
    let grid = *field.grid();
    let shape = grid.shape();
    let [nx, ny, _] = shape;
    let inverse = grid.affine().inverse_linear().map(|row| row.map(|v| v as f32));
    let components: [&[f32]; 3] = std::array::from_fn(|c| field.component(c));
    let mut out = Volume::filled(grid, 1.0f32);
    out.as_mut_slice().par_chunks_mut(nx * ny).enumerate().for_each(|(k, plane)| {
        // g[c][a]: derivative of component c by voxel index along axis a.
        let mut g: [[Vec<f32>; 3]; 3] = std::array::from_fn(|_| std::array::from_fn(|_| vec![0.0; nx]));
        dispatch(
            #[inline(always)]
            || {
                for (j, row) in plane.chunks_exact_mut(nx).enumerate() {
                    for (component, [x, y, z]) in components.iter().zip(&mut g) {
                        gradient_rows(component, shape, j, k, [x, y, z]);
                    }
                    for (i, out) in row.iter_mut().enumerate() {
                        let f = |c: usize, d: usize| {
                            let own = if c == d { 1.0 } else { 0.0 };
                            own + g[c][0][i] * inverse[0][d] + g[c][1][i] * inverse[1][d] + g[c][2][i] * inverse[2][d]
                        };
                        *out = f(0, 0) * (f(1, 1) * f(2, 2) - f(1, 2) * f(2, 1))
                            - f(0, 1) * (f(1, 0) * f(2, 2) - f(1, 2) * f(2, 0))
                            + f(0, 2) * (f(1, 0) * f(2, 1) - f(1, 1) * f(2, 0));
                    }
                }
            },
        );
    });
    out
}

/// How many voxels have a determinant at or below zero, within `mask` (everywhere when `None`).
///
/// # Errors
/// [`FieldError::GridMismatch`] when the mask has another shape.
pub fn count_folds(jacobian: &Volume, mask: Option<&Mask>) -> Result<usize, FieldError> {
    let folded = jacobian.as_slice().iter().map(|&j| j <= 0.0);
    let Some(mask) = mask else { return Ok(folded.filter(|&f| f).count()) };
    if mask.grid().shape() != jacobian.grid().shape() {
        return Err(FieldError::GridMismatch {
            what: "the mask".into(),
            found: mask.grid().shape(),
            reference: "the field".into(),
            expected: jacobian.grid().shape(),
        });
    }
    Ok(folded.zip(mask.as_slice()).filter(|&(f, &m)| f && m != 0).count())
}
