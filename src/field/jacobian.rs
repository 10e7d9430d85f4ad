//! How much a field swells or shrinks the tissue, and where it folds.
//!
//! Derivatives are those of [`crate::numerics::differences`]. In a one-slice volume nothing is known of the motion's
//! change through the slice, so that derivative is zero and the determinant is that of the in-plane 2 x 2 block.

use crate::error::FieldError;
use crate::numerics::differences::{deformation_gradient, displacement_gradient};
use crate::types::space::determinant;
use crate::types::{DenseField, Mask, Volume};

/// The Jacobian determinant of x + u(x) with respect to world mm (1): 1 = volume kept, at or below 0 = folded.
pub fn jacobian_determinant(field: &DenseField) -> Volume {
    let grid = *field.grid();
    Volume::from_voxels(grid, |at, _| {
        determinant(&deformation_gradient(displacement_gradient(field, grid.voxel(at)))) as f32
    })
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
