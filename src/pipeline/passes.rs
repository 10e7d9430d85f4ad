//! The passes that bring a spline field to the residual of the two volumes.

use crate::consistency::coupling;
use crate::matching::gain::GainField;
use crate::matching::pair::Pair;
use crate::matching::residual::normal_equations;
use crate::numerics::bending::Coupled;
use crate::numerics::blocks::Blocks;
use crate::numerics::pyramid;
use crate::numerics::unfold::unfold;
use crate::pipeline::level::{self, SplineField, cell_volume, independent, smoothness};

/// How much of the last step is carried into the next: the block diagonal is an upper bound, so plain steps are short.
const MOMENTUM: f32 = 0.5;

/// Steps shorter than this fraction of the finest voxel edge (root mean square) end the passes.
const SETTLED: f64 = 0.004;

/// Conjugate gradient iterations a pass: each pass needs only a fair step.
const ITERATIONS: usize = 15;

/// Nodes of a lattice from which memory goes before time: one system is solved after the other in place of beside it, and the warped
/// volume is not kept meanwhile.
const LARGE: usize = 500_000;

/// What tissue is left of its volume at least; below it, the field is smoothed.
const LEAST_VOLUME: f32 = 0.1;

/// As many passes as `passes` says from a field on ([`Passes`]); no node ends further than `reach` (voxels of the finest axis, along each
/// axis) from where it began. Calls `tick` after each pass.
pub fn refine(
    pair: &Pair<'_>,
    field: &mut SplineField,
    (passes, reach): (usize, f64),
    seed: u64,
    tick: impl Fn(usize),
) {
    Passes::new(pair, field, (passes, reach), seed).run(pair, field, passes, tick);
}

/// Passes after which one of several starts goes on alone. Of 206 contests between what a search found and stillness all but two ended within
/// 530 of each other in misfit (they begin thousands apart), and in those two four passes told which.
const TRIAL: usize = 4;

/// Of several starts the one that agrees best after a few passes, brought to the residual as by [`refine`].
pub fn refine_best(
    pair: &Pair<'_>,
    starts: impl IntoIterator<Item = SplineField>,
    (passes, reach): (usize, f64),
    seed: u64,
    tick: impl Fn(usize),
) -> Option<SplineField> {
    let begin = |field| (Passes::new(pair, &field, (passes, reach), seed), field);
    let mut all: Vec<(Passes, SplineField)> = starts.into_iter().map(begin).collect();
    if all.len() > 1 {
        all.iter_mut().for_each(|(own, field)| own.run(pair, field, TRIAL, &tick));
    }
    let (mut own, mut field) = all.into_iter().reduce(|a, b| if level::is_better(pair, &b.1, &a.1) { b } else { a })?;
    own.run(pair, &mut field, passes, tick);
    Some(field)
}

/// Passes that bring a field to the residual: warp, measure gain and residual, couple; the weight of the bending energy follows the evidence
/// (MacKay 1992): `lambda = determined / (2 energy)` along each axis. They may be halted, and go on as if they had not been.
pub struct Passes {
    /// Coefficients at the start, and before the last pass.
    begun: Vec<f32>,
    before: Vec<f32>,
    /// How far from the start a node may end (mm along each axis).
    reach: f32,
    probe: coupling::Probe,
    /// Passes made, and all there may be.
    made: usize,
    all: usize,
    settled: bool,
}

impl Passes {
    /// From `field` on, `all` at most.
    pub fn new(pair: &Pair<'_>, field: &SplineField, (all, reach): (usize, f64), seed: u64) -> Self {
        let begun = field.coefficients.clone();
        Self {
            before: begun.clone(),
            begun,
            reach: (reach * pyramid::finest(pair.shape, pair.spacing)) as f32,
            probe: coupling::Probe::new(field.lattice.len(), seed),
            made: 0,
            all,
            settled: false,
        }
    }

    /// Goes on until so many passes are made, or the field is settled.
    pub fn run(&mut self, pair: &Pair<'_>, field: &mut SplineField, until: usize, tick: impl Fn(usize)) {
        let energy = smoothness(&field.lattice, pair.spacing);
        let cell = cell_volume(&field.lattice, pair.spacing);
        let active = pair.spans.grown(1);
        let weight = independent(pair);
        let finest = pyramid::finest(pair.shape, pair.spacing);
        let reach = self.reach;
        let large = field.lattice.len() >= LARGE;
        let mut warped = Vec::new();
        while self.made < until.min(self.all) && !self.settled {
            let pass = self.made;
            // Those of the pass before serve nobody any more.
            field.blocks = Blocks::default();
            if warped.is_empty() {
                warped = pair.unseen();
            }
            pair.warp_again(&field.lattice, &field.coefficients, &active, &mut warped);
            let gain = GainField::sharpened(pair, &warped);
            let mut equations = normal_equations(pair, &warped, &gain, &field.lattice, 1e-3 * pair.noise);
            for v in equations.blocks.planar_mut().iter_mut().chain(&mut equations.rhs) {
                *v *= weight;
            }
            let lambda = field.lambda.map(|l| (l * cell) as f32);
            if large {
                warped = Vec::new();
            }
            let weighed = pass % 2 == 1 || pass + 1 == self.all;
            let limit = if pass < 2 { 20 } else { 10 };
            let matrix = Coupled::new(&energy, lambda, &equations.blocks, false);
            let (rhs, coefficients) = (equations.rhs, &field.coefficients);
            let step = || coupling::step(&matrix, rhs, coefficients, 0.02, ITERATIONS);
            // From the last pass's solution a few iterations suffice, though the blocks and weights have changed.
            let probe = &mut self.probe;
            let mut determine = || weighed.then(|| probe.determined(&matrix, limit));
            // Neither needs the other, and the planes of a small lattice are not worth sharing out; those of a large one are, and only one
            // of the two then needs its vectors.
            let ((_, step, length), determined) =
                if large { (step(), determine()) } else { rayon::join(step, determine) };
            for (((c, d), before), begun) in
                field.coefficients.iter_mut().zip(step).zip(&mut self.before).zip(&self.begun)
            {
                let last = std::mem::replace(before, *c);
                *c = (*c + d + MOMENTUM * (*c - last)).max(begun - reach).min(begun + reach);
            }
            unfold(&field.lattice, pair.spacing, &mut field.coefficients, LEAST_VOLUME);
            field.blocks = equations.blocks;
            if let Some(determined) = determined {
                let target = coupling::supported(determined, energy.energy(&field.coefficients));
                for (lambda, target) in field.lambda.iter_mut().zip(target) {
                    *lambda = (target / cell).clamp(*lambda / 5.0, *lambda * 5.0).clamp(1e-6, 1e9);
                }
            }
            field.coupled_at = lambda;
            tick(pass);
            self.made += 1;
            self.settled = f64::from(length) < SETTLED * finest && self.made > 3;
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::matching::levels::Aligned;
    use crate::numerics::random::Random;
    use crate::types::{Affine, Grid, Mask, Volume};

    const EDGE: usize = 24;

    /// Waves, and the same moved by up to `most` voxels along x, with noise in both.
    fn moved(most: f64) -> [Volume; 2] {
        let grid = Grid::new([EDGE; 3], Affine::scaled([1.0; 3], [0.0; 3]).unwrap()).unwrap();
        let wave = |p: [f64; 3]| 100.0 * ((0.9 * p[0]).sin() + (0.7 * p[1] + 0.2 * p[0]).cos() + (0.8 * p[2]).sin());
        let bump = |p: [f64; 3]| most * (0.13 * p[1]).sin() * (0.13 * p[2]).sin();
        let mut random = Random::new(3, 1);
        let mut volume = |of: &dyn Fn([f64; 3]) -> f64| {
            let voxel = |o: usize| grid.voxel(o).map(|v| v as f64);
            let values = (0..grid.len()).map(|o| (of(voxel(o)) + random.normals()[0]) as f32).collect();
            Volume::from_vec(grid, values).unwrap()
        };
        [volume(&wave), volume(&|p| wave([p[0] - bump(p), p[1], p[2]]))]
    }

    fn on_pair(most: f64, test: impl Fn(&Pair<'_>, SplineField)) {
        let [initial, deformed] = moved(most);
        let mask = Mask::filled(*initial.grid(), 1);
        let aligned = Aligned::new(&initial, &deformed, &mask, 10.0).unwrap();
        let pair = aligned.level([1; 3]);
        let still = SplineField::still(level::lattice(&pair, 4));
        test(&pair, still);
    }

    #[test]
    fn passes_that_were_halted_go_on_as_if_they_had_not_been() {
        on_pair(1.5, |pair, still| {
            let (mut whole, mut parts) = (still.clone(), still.clone());
            refine(pair, &mut whole, (9, f64::INFINITY), 5, |_| ());
            let mut passes = Passes::new(pair, &parts, (9, f64::INFINITY), 5);
            for until in [1, 4, 4, 9, 12] {
                passes.run(pair, &mut parts, until, |_| ());
            }
            assert_eq!(whole, parts);
            assert!(level::is_better(pair, &whole, &still));
        });
    }

    #[test]
    fn of_several_starts_the_best_goes_on_as_if_it_were_alone() {
        on_pair(1.5, |pair, still| {
            let mut far = still.clone();
            let nodes = far.lattice.len();
            far.coefficients[..nodes].fill(6.0);
            let mut alone = still.clone();
            refine(pair, &mut alone, (9, f64::INFINITY), 5, |_| ());
            for starts in [vec![still.clone(), far.clone()], vec![far, still]] {
                assert_eq!(refine_best(pair, starts, (9, f64::INFINITY), 5, |_| ()).as_ref(), Some(&alone));
            }
            assert_eq!(refine_best(pair, [], (9, f64::INFINITY), 5, |_| ()), None);
        });
    }

    #[test]
    fn no_node_ends_beyond_its_reach_however_often_passes_are_halted() {
        on_pair(2.0, |pair, still| {
            let mut field = still.clone();
            let mut passes = Passes::new(pair, &field, (8, 0.25), 5);
            (1..=8).for_each(|until| passes.run(pair, &mut field, until, |_| ()));
            let most = field.coefficients.iter().fold(0.0f32, |m, v| m.max(v.abs()));
            assert!((0.2..0.2501).contains(&most), "{most}");
        });
    }
}
