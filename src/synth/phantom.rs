//! A pair of volumes and the exact displacement between them.
//!
//! With B the body's intensity and u the motion, the initial volume is B(x + u(x)) and the deformed
//! one B(y) times a slow bias, so deformed(x + u(x)) = initial(x) without any interpolation; both
//! get independent Rician noise. A press shows the body at rest in the initial volume, B(x), and
//! dented in the deformed one, B(x(y)) with y = x + u(x). The true Jacobian determinant, by
//! differences on the initial grid, stays above [`MIN_JACOBIAN`] everywhere (a slide excepted,
//! which shears along its plane); a motion that would break this is made coarser if smooth, else
//! refused.

use crate::error::{ParamError, SynthError};
use crate::numerics::differences::{deformation_gradient, displacement_gradient};
use crate::numerics::random::Random;
use crate::numerics::statistics::percentile;
use crate::synth::anatomy::{FINGERTIP_RADII, body};
use crate::synth::body::extent;
use crate::synth::elastic::tissue::Tissue;
use crate::synth::elastic::{ElasticDescription, press};
use crate::synth::landmarks::landmarks;
use crate::synth::motion::Motion;
use crate::synth::noise::{SMOOTH_COEFFICIENTS, SmoothNoise};
use crate::synth::params::{MotionKind, PhantomKind, PhantomParams};
use crate::types::space::determinant;
use crate::types::{DenseField, Grid, Landmark, Mask, Volume, VoxelPoint, WorldPoint};
use rayon::prelude::*;
use serde::Serialize;

/// The true Jacobian determinant stays above this.
pub const MIN_JACOBIAN: f64 = 0.1;

/// A pair of volumes with its truth.
#[derive(Debug, Clone, PartialEq)]
pub struct Phantom {
    /// The initial volume (fixed).
    pub initial: Volume,
    /// The deformed volume (moving).
    pub deformed: Volume,
    /// The exact displacement at the initial grid's voxel centres, rounded to f32 (mm).
    pub truth: DenseField,
    /// Tissue on the initial grid whose deformed place is at least a voxel inside the deformed
    /// grid.
    pub mask: Mask,
    /// Places with contrast inside the mask, between voxel centres, and where they go, exact.
    pub landmarks: Vec<Landmark>,
    /// What it is made of, where that is known.
    pub stiffness: Option<Stiffness>,
    /// How it was made, and what came out.
    pub description: Description,
}

/// What a phantom is made of, on the initial grid.
#[derive(Debug, Clone, PartialEq)]
pub struct Stiffness {
    /// Tissue regions, 0 outside.
    pub labels: Mask,
    /// Young's modulus (kPa), 0 outside.
    pub youngs_modulus_kpa: Volume,
}

/// Settings and figures of a phantom.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Description {
    /// What was asked for.
    #[serde(flatten)]
    pub params: PhantomParams,
    /// Control spacing of a smooth motion (mm).
    pub control_spacing_mm: Option<f64>,
    /// Standard deviation of the noise (intensity).
    pub noise_sigma: f64,
    /// Mean displacement over the mask (mm).
    pub mean_mm: f64,
    /// Largest displacement over the mask (mm).
    pub max_mm: f64,
    /// Least true Jacobian determinant over the mask (1).
    pub jacobian_min: f64,
    /// Greatest true Jacobian determinant over the mask (1).
    pub jacobian_max: f64,
    /// Voxels of the mask.
    pub mask_voxels: usize,
    /// Landmarks found.
    pub landmarks_found: usize,
    /// Mechanics of an elastic motion.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub elastic: Option<ElasticDescription>,
}

/// The phantom that `params` ask for, both volumes on [`PhantomParams::grid`].
///
/// # Errors
/// [`SynthError`] when a value is out of range or the motion folds at this amplitude.
///
/// ```
/// use palpate::evaluate::landmarks;
/// use palpate::{PhantomKind, PhantomParams, phantom};
/// let pair = phantom(&PhantomParams::new(PhantomKind::Block).sized(24))?;
/// assert_eq!(pair.initial.grid().shape(), [24, 24, 24]);
/// // The landmarks are exact; the truth at them is read between voxels.
/// assert!(landmarks(&pair.truth, &pair.landmarks).iter().all(|e| *e < 0.5));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn phantom(params: &PhantomParams) -> Result<Phantom, SynthError> {
    let grid = params.grid()?;
    phantom_on(params, grid, grid)
}

/// The same with the volumes on given grids (oblique, flipped, different ...); size and spacing of
/// `params` play no part. The body fills the axis-aligned box around the initial grid.
///
/// # Errors
/// As [`phantom`].
///
/// ```
/// use palpate::synth::phantom_on;
/// use palpate::{Affine, Grid, PhantomKind, PhantomParams};
/// let params = PhantomParams::new(PhantomKind::Block).sized(24);
/// let initial = params.grid()?;
/// // The deformed volume in thick slices.
/// let thick =
///     Grid::new([24, 24, 8], Affine::scaled([2.7, 2.7, 8.0], initial.affine().origin().0)?)?;
/// let pair = phantom_on(&params, initial, thick)?;
/// assert_eq!(pair.deformed.grid().shape(), [24, 24, 8]);
/// assert_eq!(pair.truth.grid(), &initial);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn phantom_on(params: &PhantomParams, initial: Grid, deformed: Grid) -> Result<Phantom, SynthError> {
    params.check()?;
    Ok(imaged(params, pair(params, initial, deformed)?, initial, deformed))
}

/// What a body shows: from a place in it, its intensity there and whether it is tissue, to what is
/// imaged.
pub(super) type Paint<'a> = &'a (dyn Fn(WorldPoint, (f64, bool)) -> f64 + Sync);

/// As [`phantom_on`] for a motion in closed form, with the body painted over: by `both` in either
/// volume, then by `after` in the deformed one alone.
///
/// # Errors
/// As [`phantom`]; [`SynthError::NotElastic`] for an elastic motion.
pub(super) fn painted(
    params: &PhantomParams,
    [initial, deformed]: [Grid; 2],
    both: Paint<'_>,
    after: Paint<'_>,
) -> Result<Phantom, SynthError> {
    params.check()?;
    if params.motion == MotionKind::Elastic {
        return Err(SynthError::NotElastic);
    }
    let body = body(params.kind, &initial, params.seed);
    let sample = |p| {
        let seen = body.sample(p);
        (both(p, seen), seen.1)
    };
    let pair = moved_pair(params, initial, deformed, &sample, &|p| body.contains(p), after)?;
    Ok(imaged(params, pair, initial, deformed))
}

/// As [`phantom_on`] for a body that shows `sample` at a place in it and moves by `motion` (mm), on
/// one grid; with `jumps` neighbouring places may part.
///
/// # Errors
/// [`SynthError`] when the motion folds without `jumps`.
pub(super) fn staged(
    params: &PhantomParams,
    grid: Grid,
    sample: &(dyn Fn(WorldPoint) -> (f64, bool) + Sync),
    motion: impl Fn(WorldPoint) -> [f64; 3] + Sync + 'static,
    jumps: bool,
) -> Result<Phantom, SynthError> {
    let truth = DenseField::from_voxels(grid, |_, x| motion(x));
    if !jumps && jacobian_range(&truth, |_| true).0 <= MIN_JACOBIAN {
        return Err(folds(params.amplitude).into());
    }
    let before = Volume::from_voxels(grid, |at, x| sample(x.moved(truth.at(at).map(f64::from))));
    let after = Volume::from_voxels(grid, |_, y| sample(y));
    let displacements = Box::new(move |points: &[WorldPoint]| points.iter().map(|&p| motion(p)).collect());
    let pair = Pair { before, after, truth, displacements, control_spacing_mm: None, stiffness: None, elastic: None };
    Ok(imaged(params, pair, grid, grid))
}

/// Both volumes with bias and noise, and what is known of them.
fn imaged(params: &PhantomParams, pair: Pair, initial: Grid, deformed: Grid) -> Phantom {
    let Pair { before, after, truth, displacements, .. } = &pair;
    let clean = intensities(before);
    let mut values: Vec<f64> = after.as_slice().iter().map(|v| v.0).collect();
    let noise_sigma = params.noise * percentile(&mut values, 99.0);
    let mask = mask(before, truth, &deformed);
    let landmarks = landmarks(&clean, &mask, params.landmarks, Random::new(params.seed, 50), displacements);
    let inside = || (0..initial.len()).filter(|&at| mask.as_slice()[at] != 0);
    let lengths: Vec<f64> = inside().map(|at| length(truth.at(at))).collect();
    let (jacobian_min, jacobian_max) = jacobian_range(truth, |at| mask.as_slice()[at] != 0);
    let description = Description {
        params: PhantomParams { size: initial.shape(), spacing: initial.spacing(), ..params.clone() },
        control_spacing_mm: pair.control_spacing_mm,
        noise_sigma,
        mean_mm: lengths.iter().sum::<f64>() / lengths.len().max(1) as f64,
        max_mm: lengths.iter().copied().fold(0.0, f64::max),
        jacobian_min,
        jacobian_max,
        mask_voxels: lengths.len(),
        landmarks_found: landmarks.len(),
        elastic: pair.elastic.clone(),
    };
    let biased = biased(after, params);
    Phantom {
        initial: rician(&clean, noise_sigma, params.seed, 60),
        deformed: rician(&biased, noise_sigma, params.seed, 61),
        truth: pair.truth,
        mask,
        landmarks,
        stiffness: pair.stiffness,
        description,
    }
}

/// Both images without noise and bias, and what is known of them.
struct Pair {
    before: Imaged,
    after: Imaged,
    truth: DenseField,
    /// Displacements of world positions (mm).
    displacements: Box<dyn Fn(&[WorldPoint]) -> Vec<[f64; 3]>>,
    control_spacing_mm: Option<f64>,
    stiffness: Option<Stiffness>,
    elastic: Option<ElasticDescription>,
}

fn pair(params: &PhantomParams, initial: Grid, deformed: Grid) -> Result<Pair, SynthError> {
    let stiffness_known = matches!(params.kind, PhantomKind::Inclusion | PhantomKind::Slab);
    if params.motion == MotionKind::Elastic {
        return match stiffness_known || params.kind == PhantomKind::Fingertip {
            true => elastic_pair(params, initial, deformed),
            false => Err(SynthError::NotElastic),
        };
    }
    if stiffness_known {
        let tissue = Tissue::new(params, &initial);
        let inside = |p| tissue.region(p).is_some();
        return moved_pair(params, initial, deformed, &|p| tissue.sample(p), &inside, &|_, seen| seen.0);
    }
    let body = body(params.kind, &initial, params.seed);
    moved_pair(params, initial, deformed, &|p| body.sample(p), &|p| body.contains(p), &|_, seen| seen.0)
}

/// A motion in closed form; `paint` goes over the deformed volume.
fn moved_pair(
    params: &PhantomParams,
    initial: Grid,
    deformed: Grid,
    sample: &(dyn Fn(WorldPoint) -> (f64, bool) + Sync),
    inside: &(dyn Fn(WorldPoint) -> bool + Sync),
    paint: Paint<'_>,
) -> Result<Pair, SynthError> {
    let (motion, truth, control_spacing_mm) = motion(params, inside, initial)?;
    let rest_first = params.motion == MotionKind::Press;
    let before =
        Volume::from_voxels(initial, |at, x| sample(if rest_first { x } else { x.moved(truth.at(at).map(f64::from)) }));
    let after = Volume::from_voxels(deformed, |_, y| {
        let p = if rest_first { motion.origin_of(y) } else { y };
        let seen = sample(p);
        (paint(p, seen), seen.1)
    });
    let displacements = Box::new(move |points: &[WorldPoint]| points.iter().map(|&p| motion.at(p)).collect());
    Ok(Pair { before, after, truth, displacements, control_spacing_mm, stiffness: None, elastic: None })
}

/// A motion solved from elasticity.
fn elastic_pair(params: &PhantomParams, initial: Grid, deformed: Grid) -> Result<Pair, SynthError> {
    let pressed = press(params, Tissue::new(params, &initial), halvings(params, &initial))?;
    let tissue = pressed.tissue();
    let truth = pressed.field(initial);
    let before = Volume::from_voxels(initial, |_, x| tissue.sample(x));
    let origins = pressed.origins(&deformed);
    let after = Volume::from_voxels(deformed, |at, _| origins[at].map_or((0.0, false), |x| tissue.sample(x)));
    let (stiffness, elastic) = (Some(stiffness(tissue, initial)), Some(pressed.description.clone()));
    let displacements = Box::new(move |points: &[WorldPoint]| {
        pressed.at(&initial, points).into_iter().map(Option::unwrap_or_default).collect()
    });
    Ok(Pair { before, after, truth, displacements, control_spacing_mm: None, stiffness, elastic })
}

/// Times the hexahedra are halved: fewer for coarse images, and as far as a minute allows.
fn halvings(params: &PhantomParams, grid: &Grid) -> usize {
    let most = if params.kind == PhantomKind::Inclusion { 3 } else { 2 };
    let across = grid.shape()[0].max(grid.shape()[1]);
    if across >= 64 {
        most
    } else if across >= 32 {
        most - 1
    } else {
        1
    }
}

/// Labels and moduli at the voxel centres in the body.
fn stiffness(tissue: &Tissue, grid: Grid) -> Stiffness {
    let region = Volume::from_voxels(grid, |_, x| tissue.region(x).map(|n| n as u8 + 1).unwrap_or_default());
    let of = |n: u8| n.checked_sub(1).map(|n| &tissue.regions()[usize::from(n)]);
    Stiffness {
        labels: Volume::from_voxels(grid, |at, _| of(region.as_slice()[at]).map_or(0, |r| r.label)),
        youngs_modulus_kpa: Volume::from_voxels(grid, |at, _| {
            of(region.as_slice()[at]).map_or(0.0, |r| r.youngs_modulus_kpa as f32)
        }),
    }
}

/// A motion that folds at this amplitude.
fn folds(amplitude: f64) -> ParamError {
    let range = "less for this motion: the Jacobian determinant of the truth falls to 0.1";
    ParamError { name: "amplitude", value: amplitude, range }
}

/// The motion asked for, its field on `grid`, and the control spacing (mm) if it is smooth; an
/// error when it folds.
pub(super) fn motion(
    params: &PhantomParams,
    inside: &(dyn Fn(WorldPoint) -> bool + Sync),
    grid: Grid,
) -> Result<(Motion, DenseField, Option<f64>), SynthError> {
    let centres = (0..grid.len()).into_par_iter().map(|at| {
        let [i, j, k] = grid.voxel(at);
        grid.world(i, j, k)
    });
    let tissue: Vec<WorldPoint> = centres.filter(|&p| inside(p)).collect();
    let (seed, amplitude) = (params.seed, params.amplitude);
    let random = Random::new(seed, 30);
    let half = extent(&grid).map(|e| e / 2.0);
    let truth = |motion: &Motion| DenseField::from_voxels(grid, |_, x| motion.at(x));
    let unfolded = |motion: &Motion, truth: &DenseField| {
        motion.is_discontinuous() || jacobian_range(truth, |_| true).0 > MIN_JACOBIAN
    };
    if params.motion == MotionKind::Smooth {
        let largest = 2.0 * half.iter().fold(0.0, |m: f64, &h| m.max(h));
        let mut spacing = largest / 6.0;
        while spacing < 2.0 * largest {
            let motion = Motion::smooth(&grid, spacing, seed).scaled(amplitude, &tissue);
            let field = truth(&motion);
            if unfolded(&motion, &field) {
                return Ok((motion, field, Some(spacing)));
            }
            spacing *= 1.08;
        }
        return Err(folds(amplitude).into());
    }
    let motion = match params.motion {
        MotionKind::None | MotionKind::Smooth | MotionKind::Elastic => Motion::none(&grid),
        MotionKind::Translate => Motion::translate(&grid, amplitude, random),
        MotionKind::Rotate => Motion::rotate(&grid, amplitude, random),
        MotionKind::Wave => Motion::wave(&grid, amplitude, random),
        MotionKind::Affine => Motion::affine(&grid, random).scaled(amplitude, &tissue),
        MotionKind::Press if params.kind == PhantomKind::Fingertip => {
            Motion::plate(&grid, std::array::from_fn(|a| half[a] * FINGERTIP_RADII[a]), amplitude)
        }
        MotionKind::Press => Motion::press(&grid, random).scaled(amplitude, &tissue),
        MotionKind::Slide => Motion::slide(&grid, seed).scaled(amplitude, &tissue),
    };
    let field = truth(&motion);
    match unfolded(&motion, &field) {
        true => Ok((motion, field, None)),
        false => Err(folds(amplitude).into()),
    }
}

/// Least and greatest determinant over the voxels that `used` names.
fn jacobian_range(truth: &DenseField, used: impl Fn(usize) -> bool + Sync) -> (f64, f64) {
    let grid = truth.grid();
    (0..grid.len())
        .into_par_iter()
        .filter(|&at| used(at))
        .map(|at| determinant(&deformation_gradient(displacement_gradient(truth, grid.voxel(at)))))
        .map(|j| (j, j))
        .reduce(|| (f64::INFINITY, f64::NEG_INFINITY), |a, b| (a.0.min(b.0), a.1.max(b.1)))
}

/// Intensity and whether it is tissue, at each voxel.
type Imaged = Volume<(f64, bool)>;

fn intensities(imaged: &Imaged) -> Volume {
    Volume::from_voxels(*imaged.grid(), |at, _| imaged.as_slice()[at].0 as f32)
}

/// Tissue off the initial grid's border whose deformed place lies a voxel or more inside the
/// deformed grid.
fn mask(before: &Imaged, truth: &DenseField, deformed: &Grid) -> Mask {
    let grid = *truth.grid();
    let clear = |shape: [usize; 3], p: [f64; 3]| {
        (0..3).all(|a| shape[a] == 1 || (p[a] >= 1.0 && p[a] <= shape[a] as f64 - 2.0))
    };
    Volume::from_voxels(grid, |at, x| {
        let VoxelPoint(there) = deformed.affine().to_voxel(x.moved(truth.at(at).map(f64::from)));
        let here = grid.voxel(at).map(|v| v as f64);
        u8::from(before.as_slice()[at].1 && clear(grid.shape(), here) && clear(deformed.shape(), there))
    })
}

/// The clean image times exp(bias b), where b is smooth with mean 0 and largest magnitude 1 in the
/// tissue.
fn biased(clean: &Imaged, params: &PhantomParams) -> Volume {
    let grid = *clean.grid();
    let cell = extent(&grid).iter().fold(0.0, |m: f64, &e| m.max(e)) / 2.0;
    let noise = SmoothNoise::<1>::new(Random::new(params.seed, 70), [cell; 3], SMOOTH_COEFFICIENTS);
    let slow = Volume::from_voxels(grid, |_, y| noise.at(y.0)[0]);
    let tissue: Vec<f64> = slow.as_slice().iter().zip(clean.as_slice()).filter(|v| v.1.1).map(|v| *v.0).collect();
    let mean = tissue.iter().sum::<f64>() / tissue.len().max(1) as f64;
    let largest = tissue.iter().map(|v| (v - mean).abs()).fold(1e-12, f64::max);
    Volume::from_voxels(grid, |at, _| {
        let b = (slow.as_slice()[at] - mean) / largest;
        (clean.as_slice()[at].0 * (params.bias * b).exp()) as f32
    })
}

/// Magnitude of the clean value plus complex Gaussian noise of deviation `sigma` a channel
/// (Gudbjartsson, Patz 1995).
pub(super) fn rician(clean: &Volume, sigma: f64, seed: u64, stream: u64) -> Volume {
    let base = Random::new(seed, stream).bits();
    Volume::from_voxels(*clean.grid(), |at, _| {
        let [real, imaginary] = Random::new(base, at as u64).normals();
        (f64::from(clean.as_slice()[at]) + sigma * real).hypot(sigma * imaginary) as f32
    })
}

fn length(v: [f32; 3]) -> f64 {
    v.iter().map(|&c| f64::from(c).powi(2)).sum::<f64>().sqrt()
}
