//! What the tissue shows: repeating patterns, even or missing parts, another contrast.
//!
//! Painted on the body, so that it moves with it, or on the deformed volume before its bias and
//! noise. Fails as the phantom does.

use crate::error::SynthError;
use crate::numerics::random::Random;
use crate::numerics::statistics::percentile;
use crate::synth::anatomy::body;
use crate::synth::body::{BORDER_WIDTH_VOXELS, centre, cover, extent};
use crate::synth::params::PhantomParams;
use crate::synth::phantom::{Phantom, painted};
use crate::types::space::length;
use crate::types::{Grid, Mask, WorldPoint};
use rayon::prelude::*;
use std::f64::consts::TAU;

/// Contrast of the repeating pattern: that of a muscle's own texture.
pub(super) const PATTERN_CONTRAST: f64 = 0.3;

/// Mean intensity of fat, the brightest tissue.
pub(super) const FAT_INTENSITY: f64 = 1000.0;

/// Intensity of dark tissue over that of bright tissue beside it (1).
const DARK_INTENSITY_RATIO: f64 = 0.25;

/// Width of the border between two contrasts (logistic, part of the field of view).
const CONTRAST_BORDER_WIDTH: f64 = 0.05;

/// What the body shows by itself.
pub(super) fn unchanged(_: WorldPoint, seen: (f64, bool)) -> f64 {
    seen.0
}

/// `share` of a pattern that repeats every six voxels in what the tissue shows. `by_place` gives
/// what part of the share a place has, and a factor for what it shows.
pub(super) fn repetitive(
    base: &PhantomParams,
    share: f64,
    by_place: &(dyn Fn(WorldPoint) -> [f64; 2] + Sync),
) -> Result<Phantom, SynthError> {
    let grid = base.grid()?;
    let level = Tissue::of(base, &grid).level;
    let wave = grid.spacing().map(|s| TAU / (6.0 * s));
    let both = |p: WorldPoint, (v, inside): (f64, bool)| {
        let pattern: f64 = (0..3).map(|a| (wave[a] * p.0[a]).sin()).sum::<f64>() / 1.5f64.sqrt();
        let [part, factor] = by_place(p);
        let shown = if inside { level * (1.0 + PATTERN_CONTRAST * pattern) } else { 0.0 };
        factor * (v + share * part * (shown - v))
    };
    painted(base, [grid; 2], &both, &unchanged)
}

/// The same in one half of the body: the bright one, to the right, or the dark one beside it.
pub(super) fn repetitive_beside(base: &PhantomParams, share: f64, bright: bool) -> Result<Phantom, SynthError> {
    let grid = base.grid()?;
    let right = right_half(&grid, BORDER_WIDTH_VOXELS * grid.spacing()[0]);
    repetitive(base, share, &|p| {
        let right = right(p);
        [if bright { right } else { 1.0 - right }, DARK_INTENSITY_RATIO + (1.0 - DARK_INTENSITY_RATIO) * right]
    })
}

/// 1 to the right of the plane across x through the middle, 0 to its left, going over within some
/// `edge` (mm).
fn right_half(grid: &Grid, edge: f64) -> impl Fn(WorldPoint) -> f64 + Sync + use<> {
    let middle = centre(grid)[0];
    move |p| cover(p.0[0] - middle, edge)
}

/// One even grey in a ball that holds `share` of the tissue.
pub(super) fn even_ball(base: &PhantomParams, share: f64) -> Result<Phantom, SynthError> {
    let grid = base.grid()?;
    let tissue = Tissue::of(base, &grid);
    let ball = tissue.ball(share, base.seed);
    let edge = 0.1 * ball.radius;
    let both = |p: WorldPoint, (v, inside): (f64, bool)| {
        if inside { v + ball.cover(p, edge) * (tissue.level - v) } else { v }
    };
    painted(base, [grid; 2], &both, &unchanged)
}

/// Without a ball of `share` of the tissue in the deformed volume.
pub(super) fn missing(base: &PhantomParams, share: f64) -> Result<Phantom, SynthError> {
    let grid = base.grid()?;
    let ball = Tissue::of(base, &grid).ball(share, base.seed);
    let edge = grid.least_spacing() / 4.0;
    let gone = |p: WorldPoint, (v, _): (f64, bool)| v * (1.0 - ball.cover(p, edge));
    let mut made = painted(base, [grid; 2], &unchanged, &gone)?;
    let Phantom { mask, truth, .. } = &mut made;
    let stays = |at: usize, x: WorldPoint| ball.cover(x.moved(truth.at(at).map(f64::from)), edge) < 0.5;
    *mask = Mask::from_voxels(grid, |at, x| if stays(at, x) { mask.as_slice()[at] } else { 0 });
    Ok(made)
}

/// The `exponent`-th root of the deformed volume's intensities; fat keeps its own.
pub(super) fn root(base: &PhantomParams, exponent: f64) -> Result<Phantom, SynthError> {
    let after = |_: WorldPoint, (v, _): (f64, bool)| FAT_INTENSITY * (v / FAT_INTENSITY).powf(1.0 / exponent);
    painted(base, [base.grid()?; 2], &unchanged, &after)
}

/// The deformed volume's tissue with a `share` of the inverted contrast, by place.
pub(super) fn inverted(
    base: &PhantomParams,
    share: &(dyn Fn(WorldPoint) -> f64 + Sync),
) -> Result<Phantom, SynthError> {
    let after = |y: WorldPoint, (v, inside): (f64, bool)| {
        if inside { (v + share(y) * (1.2 * FAT_INTENSITY - 2.0 * v)).max(0.0) } else { v }
    };
    painted(base, [base.grid()?; 2], &unchanged, &after)
}

/// The same with `share` in the right half alone, fading to none over the middle fifth.
pub(super) fn inverted_on_the_right(base: &PhantomParams, share: f64) -> Result<Phantom, SynthError> {
    let grid = base.grid()?;
    let right = right_half(&grid, CONTRAST_BORDER_WIDTH * extent(&grid)[0]);
    inverted(base, &|y| share * right(y))
}

/// Places and brightness of a body's tissue.
struct Tissue {
    places: Vec<WorldPoint>,
    level: f64,
}

/// A ball in the body.
struct Ball {
    centre: WorldPoint,
    radius: f64,
}

impl Tissue {
    fn of(params: &PhantomParams, grid: &Grid) -> Self {
        let body = body(params.kind, grid, params.seed);
        let seen: Vec<(WorldPoint, f64)> = (0..grid.len())
            .into_par_iter()
            .step_by(7)
            .filter_map(|at| {
                let [i, j, k] = grid.voxel(at);
                let p = grid.world(i, j, k);
                let (v, inside) = body.sample(p);
                inside.then_some((p, v))
            })
            .collect();
        let level = seen.iter().map(|s| s.1).sum::<f64>() / seen.len().max(1) as f64;
        Self { places: seen.into_iter().map(|s| s.0).collect(), level }
    }

    /// A ball about a random place that holds `share` of the tissue.
    fn ball(&self, share: f64, seed: u64) -> Ball {
        let pick = Random::new(seed, 80).uniform(0.0, self.places.len() as f64) as usize;
        let centre = self.places.get(pick).copied().unwrap_or(WorldPoint([0.0; 3]));
        let mut distances: Vec<f64> = self.places.iter().map(|p| distance(*p, centre)).collect();
        let radius = if share > 0.0 { percentile(&mut distances, 100.0 * share) } else { 0.0 };
        Ball { centre, radius }
    }
}

impl Ball {
    /// 1 inside, 0 outside, going over within some `edge` (mm) of the surface; 0 everywhere for a
    /// ball of no size.
    fn cover(&self, p: WorldPoint, edge: f64) -> f64 {
        if self.radius == 0.0 {
            return 0.0;
        }
        cover(self.radius - distance(p, self.centre), edge)
    }
}

/// Distance of two places (mm).
pub(super) fn distance(a: WorldPoint, b: WorldPoint) -> f64 {
    length(a.minus(b))
}
