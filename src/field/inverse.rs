//! The field that undoes a field.
//!
//! For each y the inverse v solves v = -u(y + v), u being trilinear. The fixed point v <- -u(y + v)
//! (Christensen and Johnson 2001; Chen et al., Medical Physics 35, 2008) converges where
//! neighbouring displacements differ by less than their distance; where it is slow, a damped Newton
//! step with the gradient of the trilinear u takes over. Beyond its grid, u is held at the value of
//! the nearest edge. Where u folds there is no inverse or more than one: folds are counted, since
//! each y may still have an x that leads to it.

use crate::field::jacobian::count_folds;
use crate::numerics::differences::deformation_gradient;
use crate::numerics::sampling::{Stencil, displacement, inside};
use crate::types::space::{Matrix3, determinant, length};
use crate::types::{DenseField, Grid, WorldPoint};
use rayon::prelude::*;

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
pub fn invert(field: &DenseField, grid: Option<&Grid>) -> Inverse {
    let target = *grid.unwrap_or(field.grid());
    let inverse = DenseField::from_voxels(target, |_, y| solve(field, y));
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

/// v(y): from y, steps towards the x with x + u(x) = y.
fn solve(field: &DenseField, y: WorldPoint) -> [f64; 3] {
    /// Good enough (mm), well under f32's resolution of a millimetre-sized displacement on a
    /// metre-sized grid.
    const TOLERANCE: f64 = 1e-5;
    const STEPS: usize = 60;
    let mut x = y;
    let mut r = residual(field, x, y);
    let mut newton = false;
    for _ in 0..STEPS {
        let before = length(r);
        if before < TOLERANCE {
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
    x.minus(y)
}

fn trial(field: &DenseField, x: WorldPoint, y: WorldPoint, step: [f64; 3], factor: f64) -> (WorldPoint, [f64; 3]) {
    let next = x.moved(step.map(|s| factor * s));
    (next, residual(field, next, y))
}

/// y - x - u(x) (mm).
fn residual(field: &DenseField, x: WorldPoint, y: WorldPoint) -> [f64; 3] {
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
