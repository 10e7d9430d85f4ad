//! A body that turned as a whole.
//!
//! The moduli do not feel it, but plates are fitted by small turns and the linear law knows no
//! large ones: what the whole body turned by is taken out of the field first. It is the rotation of
//! the affine motion nearest to the field over the body (polar decomposition by Newton's iteration,
//! Higham, SIAM J. Sci. Stat. Comput. 7, 1986).

use crate::numerics::symmetric3::cholesky_solve;
use crate::types::space::{Matrix3, cross, determinant, dot};
use crate::types::{DenseField, Displacement, Mask, SparseField, WorldPoint};

/// Least rotation that is removed (degrees): the small-angle error of one degree is 5 micrometres
/// at 30 mm.
const MIN_ROTATION_DEGREES: f64 = 1.0;
/// Relative residual of a deformation that is entirely affine (1).
const RIGID_TOLERANCE: f64 = 1e-4;

/// A rotation about the middle of a body after its motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Turn {
    rotation: Matrix3,
    /// Mean place of the body after the motion (mm, RAS).
    middle: [f64; 3],
}

/// The affine motion nearest to a field over a body: q = after + gradient (p - before).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Affinity {
    before: [f64; 3],
    after: [f64; 3],
    gradient: Matrix3,
}

/// Places of the body (mm, RAS) before and after the motion, where the field says something.
fn moved<'a>(field: &'a Displacement<'_>, labels: &'a Mask) -> impl Iterator<Item = ([f64; 3], [f64; 3])> + 'a {
    let grid = field.grid();
    let body = (0..grid.len()).filter(|&o| labels.as_slice()[o] > 0);
    body.filter_map(|o| {
        let (p, u) = (grid.centre(o), field.at(o).map(f64::from));
        u.iter().all(|v| v.is_finite()).then(|| (p.0, p.moved(u).0))
    })
}

impl Affinity {
    /// That of a field over the body of `labels`; none where the field says nothing of it.
    pub fn of(field: &Displacement<'_>, labels: &Mask) -> Option<Self> {
        let (mut count, mut before, mut after) = (0.0, [0.0; 3], [0.0; 3]);
        for (p, q) in moved(field, labels) {
            count += 1.0;
            (0..3).for_each(|a| (before[a], after[a]) = (before[a] + p[a], after[a] + q[a]));
        }
        let [before, after] = [before, after].map(|sum| sum.map(|v| v / count));
        let (mut spread, mut with) = ([[0.0; 3]; 3], [[0.0; 3]; 3]);
        for (p, q) in moved(field, labels) {
            for r in 0..3 {
                for c in 0..3 {
                    spread[r][c] += (p[r] - before[r]) * (p[c] - before[c]);
                    with[r][c] += (q[r] - after[r]) * (p[c] - before[c]);
                }
            }
        }
        let mut gradient = [[0.0; 3]; 3];
        for (row, with) in gradient.iter_mut().zip(with) {
            *row = cholesky_solve(spread, with)?;
        }
        Some(Self { before, after, gradient })
    }

    /// Whether it is all of the field but for rounding: free registrations leave a hundredth of the
    /// deformation and more, those limited to affine maps what single precision does, 1e-6.
    pub(crate) fn is_all_of(&self, field: &Displacement<'_>, labels: &Mask) -> bool {
        let (mut left, mut whole) = (0.0, 0.0);
        for (p, q) in moved(field, labels) {
            let arm: [f64; 3] = std::array::from_fn(|a| p[a] - self.before[a]);
            for r in 0..3 {
                left += (q[r] - self.after[r] - dot(self.gradient[r], arm)).powi(2);
                whole += (q[r] - self.after[r] - arm[r]).powi(2);
            }
        }
        left < RIGID_TOLERANCE * RIGID_TOLERANCE * whole
    }
}

impl Turn {
    /// By how much the body of `labels` turned; none where that is under a degree, or the field
    /// says nothing of it.
    pub fn of(field: &Displacement<'_>, labels: &Mask) -> Option<Self> {
        let Affinity { after, gradient, .. } = Affinity::of(field, labels)?;
        let turn = Self { rotation: rotation(gradient)?, middle: after };
        (turn.degrees() > MIN_ROTATION_DEGREES).then_some(turn)
    }

    /// Its angle.
    pub fn degrees(&self) -> f64 {
        let trace: f64 = (0..3).map(|a| self.rotation[a][a]).sum();
        (0.5 * (trace - 1.0)).clamp(-1.0, 1.0).acos().to_degrees()
    }

    /// Where something that moved from `p` by `u` lies without the turn, less `p` (mm, RAS).
    fn without(&self, p: [f64; 3], u: [f64; 3]) -> [f64; 3] {
        let arm: [f64; 3] = std::array::from_fn(|a| p[a] + u[a] - self.middle[a]);
        std::array::from_fn(|c| self.middle[c] + (0..3).map(|r| self.rotation[r][c] * arm[r]).sum::<f64>() - p[c])
    }

    /// The field without it.
    pub(crate) fn undone(&self, field: &Displacement<'_>) -> DenseField {
        DenseField::from_voxels(*field.grid(), |o, p| self.without(p.0, field.at(o).map(f64::from)))
    }

    /// The matches without it.
    pub(crate) fn undone_matches(&self, matches: &SparseField) -> SparseField {
        let mut out = matches.clone();
        for m in &mut out.matches {
            let WorldPoint(p) = m.initial;
            m.displacement = self.without(p, m.displacement);
            let [xx, yy, zz, xy, xz, yz] = m.covariance;
            let c = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]];
            let turned = |a: usize, b: usize| -> f64 {
                let column = |k: usize| [0, 1, 2].map(|r| self.rotation[r][k]);
                dot(column(a), c.map(|row| dot(row, column(b))))
            };
            m.covariance = [turned(0, 0), turned(1, 1), turned(2, 2), turned(0, 1), turned(0, 2), turned(1, 2)];
        }
        out
    }
}

/// The rotation nearest to a matrix; none where it turns something inside out.
fn rotation(mut m: Matrix3) -> Option<Matrix3> {
    for _ in 0..30 {
        let size = determinant(&m);
        if size.is_nan() || size <= 1e-6 {
            return None;
        }
        let cofactors = [cross(m[1], m[2]), cross(m[2], m[0]), cross(m[0], m[1])];
        let next: Matrix3 = std::array::from_fn(|r| std::array::from_fn(|c| 0.5 * (m[r][c] + cofactors[r][c] / size)));
        let change = (0..9).map(|k| (next[k / 3][k % 3] - m[k / 3][k % 3]).abs()).fold(0.0, f64::max);
        m = next;
        if change < 1e-14 {
            break;
        }
    }
    Some(m)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::types::{Affine, Grid, Match};

    #[test]
    fn a_turn_is_found_under_a_press_and_taken_out_with_its_covariance() {
        let grid = Grid::new([12, 10, 8], Affine::scaled([1.0, 1.5, 2.0], [-3.0, 4.0, 5.0]).unwrap()).unwrap();
        let (c, s) = (20f64.to_radians().cos(), 20f64.to_radians().sin());
        let turned = |v: [f64; 3]| [c * v[0] - s * v[1], s * v[0] + c * v[1], v[2]];
        let pressed = |p: [f64; 3]| [1.02 * p[0], 1.02 * p[1], 0.96 * p[2]];
        let field = DenseField::from_fn(grid, |p| {
            let q = turned(pressed(p.0));
            std::array::from_fn(|a| q[a] - p.0[a] + [3.0, -2.0, 1.0][a])
        });
        let labels = Mask::from_voxels(grid, |_, _| 1);
        let turn = Turn::of(&field, &labels).unwrap();
        assert!((turn.degrees() - 20.0).abs() < 1e-5, "{}", turn.degrees());
        let rest = turn.undone(&field);
        let at = |i, j, k| {
            let o = grid.index(i, j, k);
            let (p, u) = (grid.world(i, j, k).0, rest.at(o));
            [0, 1, 2].map(|a| p[a] + f64::from(u[a]))
        };
        let (a, b) = (at(0, 0, 0), at(11, 9, 7));
        for (x, (low, high)) in [11.0 * 1.02, 13.5 * 1.02, 14.0 * 0.96].into_iter().zip(a.into_iter().zip(b)) {
            assert!((high - low - x).abs() < 1e-4, "{a:?} {b:?}");
        }
        // Uncertain along x before the turn is taken out: along x and y after.
        let one = Match {
            initial: grid.world(3, 3, 3),
            displacement: [0.0; 3],
            ncc: 1.0,
            covariance: [1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
            kept: true,
            raw: None,
        };
        let [xx, yy, _, xy, ..] = turn.undone_matches(&SparseField { matches: vec![one] }).matches[0].covariance;
        for (found, exact) in [(xx, c * c), (yy, s * s), (xy, -c * s)] {
            assert!((found - exact).abs() < 1e-5, "{found} {exact}");
        }
        // The same motion without the turn.
        let plain = DenseField::from_fn(grid, |p| std::array::from_fn(|a| pressed(p.0)[a] - p.0[a]));
        assert_eq!(Turn::of(&plain, &labels), None);
    }
}
