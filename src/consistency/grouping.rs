//! Matches that two motions explain where one does not: the seeds of bodies that slide along each
//! other.
//!
//! About every match the affine motion of its neighbours is fitted and grown over all that agree
//! with it (sequential consensus, Fischler & Bolles 1981; layers of affine motion, Wang & Adelson
//! 1994). The motion that explains most of what a known one leaves open splits the matches in two;
//! neighbours in space draw each other to the same side.

use crate::consistency::energy::distance;
use crate::consistency::pruning::{GATE, Measured};
use crate::numerics::neighbours::Neighbours;
use crate::numerics::symmetric3::{Symmetric3, cholesky_solve, inverse, quadratic};
use rayon::prelude::*;

/// How an affine motion grows from the neighbours of a match.
struct MotionFit {
    /// Neighbours of a match from which its motion is first fitted.
    neighbours: usize,
    /// Largest difference of displacement between neighbours of one body: a part of the voxel, and
    /// a strain.
    max_neighbour_difference: [f64; 2],
    /// Error of the motion beyond a match's covariance (voxels), in each iteration of its growth.
    model_error_voxels: [f64; 3],
    /// Fewest matches of a motion, before it grows and after.
    min_matches: [usize; 2],
    /// Ridge weight on the motion's gradient, as a part of the places' spread.
    ridge_weight: f64,
    /// Most motions that are fitted.
    max_seeds: usize,
}

const MOTION_FIT: MotionFit = MotionFit {
    neighbours: 8,
    max_neighbour_difference: [0.5, 0.5],
    model_error_voxels: [0.09, 0.06, 0.03],
    min_matches: [5, 6],
    ridge_weight: 0.01,
    max_seeds: 300,
};

/// How each match is assigned to one of two motions.
struct Labelling {
    /// Weight of the neighbours' assignment against the match's own cost (log odds where all
    /// agree).
    neighbour_weight: f64,
    /// Mean-field iterations.
    iterations: usize,
}

const LABELLING: Labelling = Labelling { neighbour_weight: 3.0, iterations: 10 };

/// When two motions explain matches better than one.
struct SplitTest {
    /// Whole matches more that the second motion must explain.
    min_matches_explained: f64,
    /// Mean squared distance that it must take from each of its matches: the three degrees of
    /// freedom of one.
    min_mean_chi2: f64,
}

const SPLIT_TEST: SplitTest = SplitTest { min_matches_explained: 3.0, min_mean_chi2: 3.0 };

/// The second side of each split of `matches` that two motions explain better than one: at most
/// two, the first against what is known of them ([`Measured::field`]), the other against the affine
/// motion that explains most of them. `voxel` is the level's finest edge (mm).
pub(crate) fn splits(matches: &[Measured], voxel: f64) -> Vec<Vec<bool>> {
    let places: Vec<[f64; 3]> = matches.iter().map(|m| m.place).collect();
    let tree = Neighbours::new(&places);
    let near: Vec<Vec<usize>> =
        places.par_iter().map(|&p| tree.within(p, f64::INFINITY, MOTION_FIT.neighbours + 1)).collect();
    let every = matches.len().div_ceil(MOTION_FIT.max_seeds).max(1);
    let tried: Vec<usize> = (0..matches.len()).step_by(every).collect();
    let informed = Informed::new(matches, voxel);
    let motions: Vec<Vec<f64>> =
        tried.into_par_iter().filter_map(|i| informed.grown(&matches[i], &near[i], voxel)).collect();
    let best = |base: &[f64]| {
        let left = |costs: &Vec<f64>| costs.iter().zip(base).map(|(a, b)| a.min(*b)).sum::<f64>();
        motions.iter().map(|costs| (left(costs), costs)).min_by(|a, b| a.0.total_cmp(&b.0))
    };
    let known = informed.costs(MOTION_FIT.model_error_voxels.len() - 1, |m| m.field);
    let commonest = best(&vec![GATE; matches.len()]).map(|(_, costs)| costs.clone());
    let mut found: Vec<Vec<bool>> = Vec::new();
    for base in [known].into_iter().chain(commonest) {
        let Some((left, other)) = best(&base) else { continue };
        if base.iter().sum::<f64>() - left < SPLIT_TEST.min_matches_explained * GATE {
            continue;
        }
        let second = sides(&base, other, &near);
        let count = second.iter().filter(|s| **s).count();
        let own = base.iter().zip(other).zip(&second).filter(|(_, s)| **s).map(|((a, b), _)| a - b).sum::<f64>();
        if own < SPLIT_TEST.min_mean_chi2 * count as f64 {
            continue;
        }
        if count.min(matches.len() - count) >= MOTION_FIT.min_matches[1] && !found.contains(&second) {
            found.push(second);
        }
    }
    found
}

/// Matches with their information (1/mm^2) at each of the errors of [`MOTION_FIT`].
struct Informed<'a> {
    matches: &'a [Measured],
    information: [Vec<Option<Symmetric3>>; MOTION_FIT.model_error_voxels.len()],
}

impl<'a> Informed<'a> {
    fn new(matches: &'a [Measured], voxel: f64) -> Self {
        let with = |off: f64| {
            let of = |m: &Measured| {
                let mut c = m.covariance;
                c[..3].iter_mut().for_each(|v| *v += (off * voxel).powi(2));
                inverse(&c)
            };
            matches.iter().map(of).collect()
        };
        Self { matches, information: MOTION_FIT.model_error_voxels.map(with) }
    }

    /// Squared distance of each match from the displacement `at` it, in its own standard
    /// deviations, up to [`GATE`].
    fn costs(&self, off: usize, at: impl Fn(&Measured) -> [f64; 3]) -> Vec<f64> {
        let cost = |(m, i): (&Measured, &Option<Symmetric3>)| {
            let at = at(m);
            let apart = std::array::from_fn(|a| m.displacement[a] - at[a]);
            i.map_or(GATE, |i| quadratic(&i, apart)).min(GATE)
        };
        self.matches.iter().zip(&self.information[off]).map(cost).collect()
    }

    /// What the affine motion about a match leaves of all matches; none where too few agree.
    fn grown(&self, about: &Measured, near: &[usize], voxel: f64) -> Option<Vec<f64>> {
        let alike = |m: &&Measured| {
            let allowed = MOTION_FIT.max_neighbour_difference[0] * voxel
                + MOTION_FIT.max_neighbour_difference[1] * distance(m.place, about.place);
            distance(m.displacement, about.displacement) < allowed
        };
        let mut held: Vec<Measured> = near.iter().map(|&j| &self.matches[j]).filter(alike).copied().collect();
        let mut costs = Vec::new();
        let mut least = MOTION_FIT.min_matches[0];
        for off in 0..MOTION_FIT.model_error_voxels.len() {
            if held.len() < least {
                return None;
            }
            let motion = affine(&held, MOTION_FIT.model_error_voxels[off] * voxel)?;
            costs = self.costs(off, |m| motion(m.place));
            held = self.matches.iter().zip(&costs).filter(|(_, c)| **c < GATE).map(|(m, _)| *m).collect();
            least = MOTION_FIT.min_matches[1];
        }
        Some(costs)
    }
}

/// The affine displacement nearest to that of `held`, by place; each counts by its mean variance
/// and that of being `off` (mm).
fn affine(held: &[Measured], off: f64) -> Option<impl Fn([f64; 3]) -> [f64; 3] + use<>> {
    let n = held.len() as f64;
    let centre: [f64; 3] = std::array::from_fn(|a| held.iter().map(|m| m.place[a]).sum::<f64>() / n);
    let from = move |p: [f64; 3]| [1.0, p[0] - centre[0], p[1] - centre[1], p[2] - centre[2]];
    let (mut a, mut b, mut spread) = ([[0.0; 4]; 4], [[0.0; 4]; 3], 0.0);
    for m in held {
        let weight = 1.0 / (m.covariance[..3].iter().sum::<f64>() / 3.0 + off * off);
        let x = from(m.place);
        for r in 0..4 {
            (0..4).for_each(|c| a[r][c] += weight * x[r] * x[c]);
            (0..3).for_each(|c| b[c][r] += weight * x[r] * m.displacement[c]);
        }
        spread += weight * distance(m.place, centre).powi(2);
    }
    (1..4).for_each(|r| a[r][r] += MOTION_FIT.ridge_weight * spread + f64::MIN_POSITIVE);
    let rows = [cholesky_solve(a, b[0])?, cholesky_solve(a, b[1])?, cholesky_solve(a, b[2])?];
    Some(move |p| rows.map(|row| row.iter().zip(from(p)).map(|(r, x)| r * x).sum()))
}

/// Which matches lie on the second side, by what either motion leaves of them and by their
/// neighbours (mean field).
fn sides(first: &[f64], second: &[f64], near: &[Vec<usize>]) -> Vec<bool> {
    let chance = |log_odds: f64| 1.0 / (1.0 + (-log_odds).exp());
    let own: Vec<f64> = first.iter().zip(second).map(|(a, b)| 0.5 * (a - b)).collect();
    let mut share: Vec<f64> = own.iter().map(|&v| chance(v)).collect();
    for _ in 0..LABELLING.iterations {
        let about = |near: &[usize]| near[1..].iter().map(|&j| share[j]).sum::<f64>() / (near.len() - 1).max(1) as f64;
        let next = near
            .iter()
            .zip(&own)
            .map(|(near, own)| chance(own + LABELLING.neighbour_weight * (2.0 * about(near) - 1.0)));
        share = next.collect();
    }
    share.into_iter().map(|s| s > 0.5).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::numerics::random::Random;

    /// Matches of a ball that turns inside tissue at rest, with noise and false matches.
    fn ball(turns: bool, seed: u64) -> (Vec<Measured>, Vec<bool>) {
        let mut random = Random::new(seed, 0);
        let mut draw = move || random.uniform(-0.5, 0.5);
        let mut inside = Vec::new();
        let matches = (0..400)
            .map(|i| {
                let place = [0; 3].map(|_| 80.0 * draw());
                let within = distance(place, [0.0; 3]) < 25.0;
                inside.push(within);
                let mut displacement = if within && turns { [-0.3 * place[1], 0.3 * place[0], 0.0] } else { [0.0; 3] };
                let noise = if i % 10 == 0 { 20.0 } else { 0.4 };
                displacement.iter_mut().for_each(|d| *d += noise * draw());
                Measured { place, displacement, covariance: [0.02, 0.02, 0.02, 0.0, 0.0, 0.0], field: [0.0; 3] }
            })
            .collect();
        (matches, inside)
    }

    #[test]
    fn a_ball_that_turns_is_told_from_its_surroundings() {
        let (matches, inside) = ball(true, 1);
        let found = splits(&matches, 2.0);
        assert!(!found.is_empty());
        for second in found {
            let same = second.iter().zip(&inside).filter(|(a, b)| a == b).count();
            assert!(same.max(400 - same) > 370, "{same}");
        }
    }

    #[test]
    fn noise_and_false_matches_propose_no_large_body() {
        for seed in 1..40 {
            for second in splits(&ball(false, seed).0, 2.0) {
                let count = second.iter().filter(|s| **s).count();
                assert!(count.min(400 - count) < 40, "{seed}: {count}");
            }
        }
    }

    #[test]
    fn too_few_matches_are_no_bodies() {
        let few = ball(true, 1).0;
        for n in [0, 1, 5, 8] {
            assert!(splits(&few[..n], 2.0).is_empty(), "{n}");
        }
    }
}
