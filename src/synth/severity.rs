//! Phantoms made worse in one respect, by a severity: what a measurement can be pushed with until
//! it breaks.
//!
//! Each [`Trouble`] has a range from harmless to hopeless; all else stays as in the phantom it
//! starts from. Changes of what the body looks like are made to the body itself, before motion,
//! bias and noise, so that the truth stays exact. Fails when a severity is outside the range of its
//! trouble, or the motion folds.

use crate::error::{ParamError, SynthError};
use crate::numerics::filters;
use crate::numerics::random::Random;
use crate::numerics::statistics::percentile;
use crate::synth::anatomy::body;
use crate::synth::params::{MotionKind, PhantomParams};
use crate::synth::phantom::{Phantom, painted, phantom, phantom_on, rician};
use crate::types::{Affine, DenseField, Grid, Mask, Volume, WorldPoint};
use rayon::prelude::*;
use std::f64::consts::TAU;

/// What goes wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Trouble {
    /// Standard deviation of the Rician noise, per cent of the brightest tissue.
    Noise,
    /// Largest displacement of a smooth motion (mm).
    Motion,
    /// Largest strain (per cent) of bands that are compressed and stretched in turn.
    Strain,
    /// Angle of a rotation (degrees).
    Rotation,
    /// Largest change of brightness across the deformed volume (per cent).
    Bias,
    /// Thickness of slices, each the mean of thin ones (mm).
    SliceThickness,
    /// Share of a pattern that repeats every six voxels in what the tissue shows (per cent).
    RepetitiveTexture,
    /// Share of the tissue in a ball that shows one even grey (per cent).
    NoTexture,
    /// Share of the tissue in a ball that is gone from the deformed volume (per cent).
    MissingTissue,
    /// Exponent to whose root the deformed volume's intensities are taken (1): 2 is the square
    /// root.
    ContrastChange,
    /// Share of the inverted contrast in the deformed volume (per cent): at 50 nothing is left, 100
    /// is inverted.
    ContrastInversion,
    /// Largest displacement of two halves that glide along each other (mm).
    Sliding,
    /// Share of the deformed volume cut off at its right end (per cent).
    Crop,
    /// Shift of the deformed volume's field of view against the initial one's (per cent of its
    /// length); at 100 and above the two have nothing in common.
    NoOverlap,
}

impl Trouble {
    /// All of them with name, unit and range of severities.
    pub const ALL: [(Self, &'static str, &'static str, [f64; 2]); 14] = [
        (Self::Noise, "noise", "%", [0.0, 20.0]),
        (Self::Motion, "motion", "mm", [1.0, 30.0]),
        (Self::Strain, "strain", "%", [5.0, 50.0]),
        (Self::Rotation, "rotation", "degrees", [1.0, 45.0]),
        (Self::Bias, "bias", "%", [0.0, 80.0]),
        (Self::SliceThickness, "slice thickness", "mm", [1.0, 8.0]),
        (Self::RepetitiveTexture, "repetitive texture", "%", [0.0, 100.0]),
        (Self::NoTexture, "no texture", "%", [0.0, 95.0]),
        (Self::MissingTissue, "missing tissue", "%", [0.0, 60.0]),
        (Self::ContrastChange, "contrast change", "exponent", [1.0, 8.0]),
        (Self::ContrastInversion, "contrast inversion", "%", [0.0, 100.0]),
        (Self::Sliding, "sliding", "mm", [1.0, 20.0]),
        (Self::Crop, "crop", "%", [0.0, 90.0]),
        (Self::NoOverlap, "no overlap", "%", [0.0, 120.0]),
    ];

    /// The row of [`Trouble::ALL`].
    fn row(self) -> &'static (Self, &'static str, &'static str, [f64; 2]) {
        Self::ALL.iter().find(|t| t.0 == self).unwrap_or(&Self::ALL[0])
    }

    /// As in files and charts.
    pub fn name(self) -> &'static str {
        self.row().1
    }

    /// Unit of the severity.
    pub fn unit(self) -> &'static str {
        self.row().2
    }

    /// Least and greatest severity that is of interest.
    pub fn range(self) -> [f64; 2] {
        self.row().3
    }
}

/// Contrast of the repeating pattern, as that of a muscle's own texture.
const PATTERN: f64 = 0.3;

/// Mean intensity of fat, the brightest tissue.
const BRIGHTEST: f64 = 1000.0;

/// The phantom of `base` with `trouble` of the given severity, in [`Trouble::unit`].
///
/// The mask holds the tissue that the deformed volume shows: not what is gone, cut off or shifted
/// away; it may be empty.
///
/// # Errors
/// [`SynthError`] when the severity is outside [`Trouble::range`], or as [`phantom`] has it.
pub fn troubled(base: &PhantomParams, trouble: Trouble, severity: f64) -> Result<Phantom, SynthError> {
    let [low, high] = trouble.range();
    if !(low..=high).contains(&severity) {
        return Err(ParamError { name: "severity", value: severity, range: "in the range of its trouble" }.into());
    }
    let share = severity / 100.0;
    let with = |motion, amplitude| PhantomParams { motion, amplitude, ..base.clone() };
    let unchanged = |_: WorldPoint, seen: (f64, bool)| seen.0;
    match trouble {
        Trouble::Noise => phantom(&PhantomParams { noise: share, ..base.clone() }),
        Trouble::Motion => phantom(&with(MotionKind::Smooth, severity)),
        Trouble::Strain => phantom(&with(MotionKind::Wave, severity)),
        Trouble::Rotation => phantom(&with(MotionKind::Rotate, severity)),
        Trouble::Sliding => phantom(&with(MotionKind::Slide, severity)),
        Trouble::Bias => phantom(&PhantomParams { bias: (1.0 + share).ln(), ..base.clone() }),
        Trouble::SliceThickness => thick_slices(base, severity),
        Trouble::Crop | Trouble::NoOverlap => {
            let grid = base.grid()?;
            let cut = (share * grid.shape()[0] as f64).round() as usize;
            let seen = match trouble {
                Trouble::Crop => window(&grid, 0, (grid.shape()[0] - cut).max(2))?,
                _ => window(&grid, cut, grid.shape()[0])?,
            };
            phantom_on(base, grid, seen)
        }
        Trouble::RepetitiveTexture => {
            let grids = [base.grid()?; 2];
            let level = Tissue::of(base, &grids[0]).level;
            let wave = grids[0].spacing().map(|s| TAU / (6.0 * s));
            let both = |p: WorldPoint, (v, inside): (f64, bool)| {
                let pattern: f64 = (0..3).map(|a| (wave[a] * p.0[a]).sin()).sum::<f64>() / 1.5f64.sqrt();
                if inside { v + share * (level * (1.0 + PATTERN * pattern) - v) } else { v * (1.0 - share) }
            };
            painted(base, grids, &both, &unchanged)
        }
        Trouble::NoTexture => {
            let grids = [base.grid()?; 2];
            let tissue = Tissue::of(base, &grids[0]);
            let ball = tissue.ball(share, base.seed);
            let edge = 0.1 * ball.radius;
            let both = |p: WorldPoint, (v, inside): (f64, bool)| {
                if inside { v + ball.cover(p, edge) * (tissue.level - v) } else { v }
            };
            painted(base, grids, &both, &unchanged)
        }
        Trouble::MissingTissue => {
            let grids = [base.grid()?; 2];
            let ball = Tissue::of(base, &grids[0]).ball(share, base.seed);
            let edge = grids[0].spacing().iter().fold(f64::INFINITY, |m: f64, &s| m.min(s)) / 4.0;
            let gone = |p: WorldPoint, (v, _): (f64, bool)| v * (1.0 - ball.cover(p, edge));
            let mut made = painted(base, grids, &unchanged, &gone)?;
            let Phantom { mask, truth, .. } = &mut made;
            let stays = |at: usize, x: WorldPoint| ball.cover(x.moved(truth.at(at).map(f64::from)), edge) < 0.5;
            *mask = Mask::from_voxels(grids[0], |at, x| if stays(at, x) { mask.as_slice()[at] } else { 0 });
            Ok(made)
        }
        Trouble::ContrastChange | Trouble::ContrastInversion => {
            let after = |_: WorldPoint, (v, inside): (f64, bool)| match trouble {
                Trouble::ContrastChange => BRIGHTEST * (v / BRIGHTEST).powf(1.0 / severity),
                _ if inside => (v + share * (1.2 * BRIGHTEST - 2.0 * v)).max(0.0),
                _ => v,
            };
            painted(base, [base.grid()?; 2], &unchanged, &after)
        }
    }
}

/// The part of a grid's x axis from voxel `first`, `count` voxels long; it may reach past the end.
fn window(grid: &Grid, first: usize, count: usize) -> Result<Grid, SynthError> {
    let [_, ny, nz] = grid.shape();
    let mut rows = grid.affine().rows();
    for row in &mut rows {
        row[3] += row[0] * first as f64;
    }
    Ok(Grid::new([count, ny, nz], Affine::new(rows)?)?)
}

/// Slices of `thickness` mm or the nearest multiple of the in-plane voxel edge: thin ones averaged,
/// then noise.
fn thick_slices(base: &PhantomParams, thickness: f64) -> Result<Phantom, SynthError> {
    let thin = base.spacing[0];
    let count = ((thickness / thin).round() as usize).max(1);
    let along = (base.size[2] as f64 * base.spacing[2] / (thin * count as f64)).floor().max(1.0) as usize;
    let size = [base.size[0], base.size[1], along * count];
    let fine = PhantomParams { size, spacing: [base.spacing[0], base.spacing[1], thin], noise: 0.0, ..base.clone() };
    let made = phantom(&fine)?;
    let grid = *made.initial.grid();
    let mut rows = grid.affine().rows();
    for row in &mut rows {
        row[3] += row[2] * (count as f64 - 1.0) / 2.0;
        row[2] *= count as f64;
    }
    let grid = Grid::new([size[0], size[1], along], Affine::new(rows)?)?;
    let plane = size[0] * size[1];
    let from = |at: usize, k: usize| at % plane + plane * (at / plane * count + k);
    let pooled = |data: &[f32], at: usize| (0..count).map(|k| data[from(at, k)]).sum::<f32>() / count as f32;
    let mut top: Vec<f64> = made.deformed.as_slice().iter().map(|&v| f64::from(v)).collect();
    let sigma = base.noise * percentile(&mut top, 99.0);
    let noisy = |volume: &Volume, stream| {
        let clean = Volume::from_voxels(grid, |at, _| pooled(volume.as_slice(), at));
        rician(&clean, sigma, base.seed, stream)
    };
    // The truth at a slice's middle: of the thin slice there, or of the two beside it.
    let middle = [(count - 1) / 2, count / 2];
    let truth = DenseField::from_voxels(grid, |at, _| {
        let [a, b] = middle.map(|k| made.truth.at(from(at, k)).map(f64::from));
        std::array::from_fn(|c| 0.5 * (a[c] + b[c]))
    });
    let edge = [0, along - 1];
    let mask = Mask::from_voxels(grid, |at, _| {
        let whole = (0..count).all(|k| made.mask.as_slice()[from(at, k)] != 0);
        u8::from(whole && (along < 3 || !edge.contains(&(at / plane))))
    });
    let mut description = made.description;
    description.noise_sigma = sigma;
    description.params = PhantomParams { size: grid.shape(), spacing: grid.spacing(), ..base.clone() };
    Ok(Phantom {
        initial: noisy(&made.initial, 60),
        deformed: noisy(&made.deformed, 61),
        truth,
        mask,
        landmarks: Vec::new(),
        stiffness: None,
        description,
    })
}

/// `truth` with errors as a measurement has them: normal with a standard deviation of `sigma` (mm)
/// along each axis, correlated over about three voxels.
pub fn disturbed(truth: &DenseField, sigma: f64, seed: u64) -> DenseField {
    let (grid, n) = (*truth.grid(), truth.grid().len());
    let mut out = truth.clone();
    for (c, component) in out.as_mut_slice().chunks_exact_mut(n).enumerate() {
        let base = Random::new(seed, 90 + c as u64).bits();
        let white: Vec<f32> =
            (0..n).into_par_iter().map(|at| Random::new(base, at as u64).normals()[0] as f32).collect();
        let smooth = filters::gaussian(&white, grid.shape(), [1.5; 3]);
        let power = smooth.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>() / n as f64;
        let scale = (sigma / power.sqrt().max(1e-12)) as f32;
        component.iter_mut().zip(&smooth).for_each(|(v, e)| *v += scale * e);
    }
    out
}

/// Labels with all borders inside the body `voxels` further along x; its outline stays.
pub fn shifted_labels(labels: &Mask, voxels: usize) -> Mask {
    let (old, grid) = (labels.as_slice(), *labels.grid());
    Mask::from_voxels(grid, |at, _| {
        let from = if grid.voxel(at)[0] >= voxels { old[at - voxels] } else { 0 };
        if old[at] == 0 || from == 0 { old[at] } else { from }
    })
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
        1.0 / (1.0 + ((distance(p, self.centre) - self.radius) / edge).exp())
    }
}

fn distance(a: WorldPoint, b: WorldPoint) -> f64 {
    a.minus(b).iter().map(|v| v * v).sum::<f64>().sqrt()
}
