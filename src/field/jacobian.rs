//! How much a field swells or shrinks the tissue, and where it folds.
//!
//! Derivatives are central differences, one-sided at the border. In a one-slice volume nothing is
//! known of the motion's change through the slice, so that derivative is zero and the determinant
//! is that of the in-plane 2 x 2 block.

use crate::error::FieldError;
use crate::numerics::sampling::beside;
use crate::numerics::simd::dispatch;
use crate::types::{DenseField, Mask, Volume};
use rayon::prelude::*;
use std::collections::BTreeSet;

/// The Jacobian determinant of x + u(x) with respect to world mm (1): 1 = volume kept, at or below
/// 0 = folded.
///
/// ```
/// use palpate::field::jacobian::jacobian_determinant;
/// use palpate::{Affine, DenseField, Grid};
/// let grid = Grid::new([8; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let field = DenseField::from_fn(grid, |p| [0.5 * p.0[0], -0.2 * p.0[1], 0.0]);
/// let determinant = jacobian_determinant(&field);
/// assert!(determinant.as_slice().iter().all(|j| (j - 1.5 * 0.8).abs() < 1e-5));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn jacobian_determinant(field: &DenseField) -> Volume {
    Volume::by_rows(*field.grid(), |first, out| determinant_rows(field, first, out))
}

/// [`jacobian_determinant`] of whole rows of voxels, from row `first` of the grid on (`j + ny k`).
pub(crate) fn determinant_rows(field: &DenseField, first: usize, out: &mut [f32]) {
    let derivative = Derivative::new(field);
    let [nx, ny, _] = derivative.shape;
    for (row, out) in (first..).zip(out.chunks_exact_mut(nx)) {
        derivative.determinants([0, row % ny, row / ny], out);
    }
}

/// [`jacobian_determinant`] at one voxel offset (x fastest).
pub fn determinant_at(field: &DenseField, offset: usize) -> f32 {
    let mut out = [1.0];
    Derivative::new(field).determinants(field.grid().voxel(offset), &mut out);
    out[0]
}

/// How many voxels have a determinant at or below zero, within `mask` (everywhere when `None`).
///
/// # Errors
/// [`FieldError::GridMismatch`] when the mask has another shape.
///
/// ```
/// use palpate::field::jacobian::count_folds;
/// use palpate::{Affine, DenseField, Grid};
/// let grid = Grid::new([8; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let squeezed = |factor: f64| DenseField::from_fn(grid, |p| [-factor * p.0[0], 0.0, 0.0]);
/// assert_eq!(count_folds(&squeezed(0.9), None)?, 0);
/// // Past a factor of one the tissue is turned inside out.
/// assert_eq!(count_folds(&squeezed(1.1), None)?, grid.len());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn count_folds(field: &DenseField, mask: Option<&Mask>) -> Result<usize, FieldError> {
    Ok(folds(field, mask)?.len())
}

/// The offsets (x fastest) of the voxels whose determinant is at or below zero, within `mask`
/// (everywhere when `None`), in order.
///
/// # Errors
/// [`FieldError::GridMismatch`] when the mask has another shape.
pub fn folds(field: &DenseField, mask: Option<&Mask>) -> Result<Vec<usize>, FieldError> {
    let shape = field.grid().shape();
    if let Some(mask) = mask.filter(|m| m.grid().shape() != shape) {
        return Err(FieldError::GridMismatch {
            what: "the mask".into(),
            found: mask.grid().shape(),
            reference: "the field".into(),
            expected: shape,
        });
    }
    Ok(up_to(field, mask, 0.0))
}

/// The voxels whose determinant is at most `limit`, where the mask has the field's shape.
fn up_to(field: &DenseField, mask: Option<&Mask>, limit: f32) -> Vec<usize> {
    let derivative = Derivative::new(field);
    let [nx, ny, nz] = derivative.shape;
    let mask = mask.map(Mask::as_slice);
    let slice = |k: usize| -> Vec<usize> {
        let mut row = vec![1.0; nx];
        let mut found = Vec::new();
        for j in 0..ny {
            let from = nx * (j + ny * k);
            let inside = mask.map(|m| &m[from..][..nx]);
            if inside.is_some_and(|m| m.iter().all(|&m| m == 0)) {
                continue;
            }
            derivative.determinants([0, j, k], &mut row);
            found.extend((0..nx).filter(|&i| row[i] <= limit && inside.is_none_or(|m| m[i] != 0)).map(|i| from + i));
        }
        found
    };
    (0..nz).into_par_iter().flat_map_iter(slice).collect()
}

/// Largest number of sweeps over the folded voxels.
const MAX_ITERATIONS: usize = 500;

/// Jacobian determinant below which a voxel is a fold, and the one that it is raised to: both
/// exceed the rounding of a file.
const FOLD_DETERMINANTS: [f32; 2] = [0.01, 0.02];

/// Moves the voxels about each fold at the voxels that `count` (all where it is empty) by as little
/// as opens it, until none is left or after 500 rounds.
///
/// Each step is the shortest along which the determinant, linear in the displacement of the voxels
/// on both sides, rises to a little above zero (Kaczmarz's method on one constraint after another).
pub(crate) fn unfold(field: &mut DenseField, count: &[u8]) {
    let counts = |at: usize| count.get(at).is_none_or(|c| *c != 0);
    let mut folds: Vec<usize> = up_to(field, None, FOLD_DETERMINANTS[0]).into_iter().filter(|&at| counts(at)).collect();
    let shape = field.grid().shape();
    let inverse = *field.grid().affine().inverse_linear();
    let stride = [1, shape[0], shape[0] * shape[1]];
    let n = field.grid().len();
    for _ in 0..MAX_ITERATIONS {
        if folds.is_empty() {
            break;
        }
        let mut near = BTreeSet::new();
        for at in folds {
            let v = field.grid().voxel(at);
            let sides: [[usize; 2]; 3] = std::array::from_fn(|a| {
                let before = if v[a] > 0 { at - stride[a] } else { at };
                [before, if v[a] + 1 < shape[a] { at + stride[a] } else { at }]
            });
            // Along the axis of a single slice nothing is known.
            let per: [f64; 3] = std::array::from_fn(|a| match sides[a][1] - sides[a][0] {
                0 => 0.0,
                apart => stride[a] as f64 / apart as f64,
            });
            let values = field.as_mut_slice();
            let d = |c: usize, a: usize| per[a] * f64::from(values[c * n + sides[a][1]] - values[c * n + sides[a][0]]);
            let g: [[f64; 3]; 3] = std::array::from_fn(|c| std::array::from_fn(|a| d(c, a)));
            let f: [[f64; 3]; 3] = std::array::from_fn(|c| {
                std::array::from_fn(|r| {
                    f64::from(u8::from(c == r)) + (0..3).map(|a| g[c][a] * inverse[a][r]).sum::<f64>()
                })
            });
            let cofactor: [[f64; 3]; 3] = std::array::from_fn(|c| {
                let [p, q] = [(c + 1) % 3, (c + 2) % 3];
                std::array::from_fn(|r| {
                    let [s, t] = [(r + 1) % 3, (r + 2) % 3];
                    f[p][s] * f[q][t] - f[p][t] * f[q][s]
                })
            });
            let determinant: f64 = (0..3).map(|r| f[0][r] * cofactor[0][r]).sum();
            let short = f64::from(FOLD_DETERMINANTS[1]) - determinant;
            if short <= 0.0 {
                continue;
            }
            // How the determinant grows with the displacement of the voxel after, and falls with
            // that of the one before.
            let slope = |c: usize, a: usize| per[a] * (0..3).map(|r| cofactor[c][r] * inverse[a][r]).sum::<f64>();
            let slopes: [[f64; 3]; 3] = std::array::from_fn(|c| std::array::from_fn(|a| slope(c, a)));
            let square: f64 = 2.0 * slopes.iter().flatten().map(|s| s * s).sum::<f64>();
            for (c, slopes) in slopes.iter().enumerate() {
                for (slope, [before, after]) in slopes.iter().zip(sides) {
                    let step = (short * slope / square.max(1e-12)) as f32;
                    values[c * n + after] += step;
                    values[c * n + before] -= step;
                }
            }
            for side in sides.into_iter().flatten() {
                near.insert(side);
                near.extend(beside(shape, side));
            }
        }
        let near: Vec<usize> = near.into_iter().filter(|&at| counts(at)).collect();
        folds = near.into_par_iter().filter(|&at| determinant_at(field, at) <= FOLD_DETERMINANTS[0]).collect();
    }
}

/// What the determinants are worked out from.
struct Derivative<'a> {
    components: [&'a [f32]; 3],
    shape: [usize; 3],
    /// Voxels for each world mm.
    inverse: [[f32; 3]; 3],
}

impl<'a> Derivative<'a> {
    fn new(field: &'a DenseField) -> Self {
        Self {
            components: std::array::from_fn(|c| field.component(c)),
            shape: field.grid().shape(),
            inverse: field.grid().affine().inverse_linear().map(|row| row.map(|v| v as f32)),
        }
    }

    /// The determinants at `out.len()` voxels of a row, from voxel `[i, j, k]` on.
    fn determinants(&self, [i, j, k]: [usize; 3], out: &mut [f32]) {
        let nx = self.shape[0];
        let (inner, end) = (i.max(1), (i + out.len()).min(nx - 1).max(i.max(1)));
        let (first, rest) = out.split_at_mut((inner - i).min(out.len()));
        let (middle, last) = rest.split_at_mut((end - inner).min(rest.len()));
        let side = nx > 1;
        self.run([i, j, k], [0, usize::from(side)], f32::from(u8::from(side)), first);
        self.run([inner, j, k], [1, 1], 0.5, middle);
        self.run([end, j, k], [1, 0], 1.0, last);
    }

    /// The same for a run with the same differences along x: over `before` and `after` voxels,
    /// times `scale`.
    fn run(&self, [i, j, k]: [usize; 3], [before, after]: [usize; 2], scale: f32, out: &mut [f32]) {
        if out.is_empty() {
            return;
        }
        let ([nx, ny, nz], n) = (self.shape, out.len());
        let at = |j: usize, k: usize| i + nx * (j + ny * k);
        let ends = |at: usize, n: usize| (at.saturating_sub(1), (at + 1).min(n - 1));
        let ((j0, j1), (k0, k1)) = (ends(j, ny), ends(k, nz));
        let sides = [(at(j, k) - before, at(j, k) + after), (at(j0, k), at(j1, k)), (at(j, k0), at(j, k1))];
        let scale = [scale, 1.0 / (j1 - j0).max(1) as f32, 1.0 / (k1 - k0).max(1) as f32];
        let ends: [[[&[f32]; 2]; 3]; 3] =
            self.components.map(|c| sides.map(|(low, high)| [&c[low..][..n], &c[high..][..n]]));
        let inverse = self.inverse;
        dispatch(
            #[inline(always)]
            || {
                let [[x0, x1, x2], [y0, y1, y2], [z0, z1, z2]] = ends;
                for l in 0..n {
                    // g[c][a]: derivative of component c by voxel index along axis a.
                    let d = |e: [&[f32]; 2], a: usize| scale[a] * (e[1][l] - e[0][l]);
                    let g = [
                        [d(x0, 0), d(x1, 1), d(x2, 2)],
                        [d(y0, 0), d(y1, 1), d(y2, 2)],
                        [d(z0, 0), d(z1, 1), d(z2, 2)],
                    ];
                    let f = |c: usize, d: usize| {
                        let own = if c == d { 1.0 } else { 0.0 };
                        own + g[c][0] * inverse[0][d] + g[c][1] * inverse[1][d] + g[c][2] * inverse[2][d]
                    };
                    out[l] = f(0, 0) * (f(1, 1) * f(2, 2) - f(1, 2) * f(2, 1))
                        - f(0, 1) * (f(1, 0) * f(2, 2) - f(1, 2) * f(2, 0))
                        + f(0, 2) * (f(1, 0) * f(2, 1) - f(1, 1) * f(2, 0));
                }
            },
        );
    }
}
