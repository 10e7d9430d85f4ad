//! The place that a displacement field leads to a point from.
//!
//! The x with x + u(x) = y, u being trilinear. The fixed point x <- y - u(x) (Christensen and
//! Johnson 2001; Chen et al., Medical Physics 35, 2008) converges where neighbouring displacements
//! differ by less than their distance; where it is slow, a damped Newton step with the gradient of
//! the trilinear u takes over. Beyond its grid, u is held at the value of the nearest edge.

use crate::numerics::differences::deformation_gradient;
use crate::numerics::sampling::{Stencil, displacement};
use crate::types::space::{Matrix3, determinant, length};
use crate::types::{DenseField, WorldPoint};

/// From y, steps towards the x with x + u(x) = y (world mm), until x is off by less than
/// `tolerance` (mm) in y. [`residual`] tells whether it got there.
pub(crate) fn origin_of(field: &DenseField, y: WorldPoint, tolerance: f64) -> WorldPoint {
    const MAX_ITERATIONS: usize = 60;
    let mut x = y;
    let mut r = residual(field, x, y);
    let mut newton = false;
    for _ in 0..MAX_ITERATIONS {
        let before = length(r);
        if before < tolerance {
            break;
        }
        let step = if newton { newton_step(field, x, r).unwrap_or(r) } else { r };
        // Halve a step that does not help; the last, smallest one is taken so that the search
        // leaves a kink.
        let mut factor = 1.0;
        let (mut next, mut next_r) = trial(field, x, y, step, factor);
        while length(next_r) >= before && factor > 0.1 {
            factor *= 0.5;
            (next, next_r) = trial(field, x, y, step, factor);
        }
        newton = length(next_r) > 0.3 * before;
        (x, r) = (next, next_r);
    }
    x
}

fn trial(field: &DenseField, x: WorldPoint, y: WorldPoint, step: [f64; 3], factor: f64) -> (WorldPoint, [f64; 3]) {
    let next = x.moved(step.map(|s| factor * s));
    (next, residual(field, next, y))
}

/// y - x - u(x) (mm).
pub fn residual(field: &DenseField, x: WorldPoint, y: WorldPoint) -> [f64; 3] {
    y.minus(x.moved(displacement(field, x)))
}

/// The solution s of (I + grad u(x)) s = r by Cramer's rule, `None` where it is singular or
/// reverses orientation.
fn newton_step(field: &DenseField, x: WorldPoint, r: [f64; 3]) -> Option<[f64; 3]> {
    let f = deformation_gradient(trilinear_gradient(field, x));
    let det = determinant(&f);
    (det > 1e-3).then(|| {
        std::array::from_fn(|c| {
            let mut replaced = f;
            for row in 0..3 {
                replaced[row][c] = r[row];
            }
            determinant(&replaced) / det
        })
    })
}

/// The gradient of the trilinear interpolant by world mm, as
/// [`crate::numerics::differences::displacement_gradient`].
fn trilinear_gradient(field: &DenseField, x: WorldPoint) -> Matrix3 {
    let grid = field.grid();
    let (shape, p) = (grid.shape(), grid.affine().to_voxel(x));
    let mut by_voxel = [[0.0; 3]; 3];
    for a in 0..3 {
        let last = shape[a] - 1;
        if last == 0 || p.0[a] < 0.0 || p.0[a] > last as f64 {
            continue;
        }
        let (mut low, mut high) = (p, p);
        low.0[a] = p.0[a].floor().min((last - 1) as f64);
        high.0[a] = low.0[a] + 1.0;
        let (low, high) = (Stencil::new(shape, low), Stencil::new(shape, high));
        for c in 0..3 {
            by_voxel[c][a] = high.of(field.component(c)) - low.of(field.component(c));
        }
    }
    let inverse = grid.affine().inverse_linear();
    std::array::from_fn(|c| std::array::from_fn(|w| (0..3).map(|a| by_voxel[c][a] * inverse[a][w]).sum()))
}
