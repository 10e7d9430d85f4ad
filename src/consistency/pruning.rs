//! Survivors: matches that agree with the coupled field and with a robust local affine fit of their
//! neighbours.

use crate::numerics::neighbours::Neighbours;
use crate::numerics::symmetric3::{Symmetric3, cholesky_solve, inverse, quadratic};
use rayon::prelude::*;

/// A match as pruning sees it. All its vectors are in one frame, whose axes are at right angles:
/// that of a lattice, or world mm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measured {
    /// Place (mm along the lattice's axes).
    pub place: [f64; 3],
    /// Displacement (mm).
    pub displacement: [f64; 3],
    /// Covariance (mm^2).
    pub covariance: Symmetric3,
    /// What the coupled field says there (mm).
    pub field: [f64; 3],
}

/// 99.9 % quantile of chi-square with three degrees of freedom: a match with a larger squared
/// Mahalanobis distance is an outlier.
pub const GATE: f64 = 16.27;

/// Which matches to keep.
///
/// Two tests, both with the match's own covariance enlarged by `model_mm` (what a smooth field or
/// an affine fit may miss): the squared Mahalanobis distance to the coupled field, and that to the
/// affine map fitted to the (at most 24) nearest matches with weights from their distance to the
/// field, must not pass `gate` (the 99.9 % point of chi-square with 3 degrees of freedom is 16.3).
///
/// ```
/// use palpate::consistency::pruning::{GATE, Measured, prune};
/// let at = |i: usize, displacement| Measured {
///     place: [(i % 3) as f64, (i / 3 % 3) as f64, (i / 9) as f64],
///     displacement,
///     covariance: [0.01, 0.01, 0.01, 0.0, 0.0, 0.0],
///     field: [1.0, 0.0, 0.0],
/// };
/// let mut matches: Vec<Measured> = (0..27).map(|i| at(i, [1.0, 0.0, 0.0])).collect();
/// matches[13] = at(13, [-2.0, 0.0, 0.0]);
/// let kept = prune(&matches, 0.1, GATE);
/// assert!(!kept[13] && kept.iter().filter(|k| **k).count() == 26);
/// ```
pub fn prune(matches: &[Measured], model_mm: f64, gate: f64) -> Vec<bool> {
    let places: Vec<[f64; 3]> = matches.iter().map(|m| m.place).collect();
    let tree = Neighbours::new(&places);
    let apart = |a: [f64; 3], b: [f64; 3]| -> [f64; 3] { std::array::from_fn(|c| a[c] - b[c]) };
    let distance2 = |m: &Measured, e: [f64; 3]| {
        let mut c = m.covariance;
        for v in &mut c[..3] {
            *v += model_mm * model_mm;
        }
        inverse(&c).map_or(f64::INFINITY, |i| quadratic(&i, e))
    };
    let to_field: Vec<f64> = matches.par_iter().map(|m| distance2(m, apart(m.displacement, m.field))).collect();
    matches
        .par_iter()
        .enumerate()
        .map(|(i, m)| {
            if to_field[i] > gate {
                return false;
            }
            let near: Vec<usize> = tree.within(m.place, f64::INFINITY, 25).into_iter().filter(|&j| j != i).collect();
            if near.len() < 8 {
                return true;
            }
            let Some(predicted) = affine_at(matches, &to_field, &near, m.place, gate) else { return true };
            distance2(m, apart(m.displacement, predicted)) <= 2.0 * gate
        })
        .collect()
}

/// The displacement at `place` of the weighted affine fit to `near`; none when they are degenerate.
fn affine_at(matches: &[Measured], to_field: &[f64], near: &[usize], place: [f64; 3], gate: f64) -> Option<[f64; 3]> {
    let radius2 = near.iter().map(|&j| square(matches[j].place, place)).fold(0.0, f64::max);
    let mut a = [[0.0; 4]; 4];
    let mut b = [[0.0; 4]; 3];
    for &j in near {
        let m = &matches[j];
        let w = (1.0 + to_field[j] / gate).powi(-2) / (m.covariance[0] + m.covariance[1] + m.covariance[2] + 1e-6);
        let x = [1.0, m.place[0] - place[0], m.place[1] - place[1], m.place[2] - place[2]];
        for r in 0..4 {
            for c in 0..4 {
                a[r][c] += w * x[r] * x[c];
            }
            for c in 0..3 {
                b[c][r] += w * x[r] * m.displacement[c];
            }
        }
    }
    // A whisper of ridge on the gradient keeps planar neighbourhoods solvable.
    for r in 1..4 {
        a[r][r] += 1e-3 * a[0][0] * radius2;
    }
    let mut out = [0.0; 3];
    for c in 0..3 {
        out[c] = cholesky_solve(a, b[c])?[0];
    }
    Some(out)
}

fn square(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|c| (a[c] - b[c]).powi(2)).sum()
}
