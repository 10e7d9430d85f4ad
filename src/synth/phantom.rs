//! A pair of volumes and the exact displacement between them.
//!
//! With B the body's intensity and u the motion, the initial volume is B(x + u(x)) and the deformed one B(y) times a
//! slow bias, so deformed(x + u(x)) = initial(x) without any interpolation; both get independent Rician noise. A press
//! shows the body at rest in the initial volume, B(x), and dented in the deformed one, B(x(y)) with y = x + u(x). The
//! true Jacobian determinant, by differences on the initial grid, stays above [`MIN_JACOBIAN`] everywhere (a slide
//! excepted, which shears along its plane); a motion that would break this is made coarser if smooth, else refused.

use crate::error::{ParamError, SynthError};
use crate::numerics::differences::{deformation_gradient, displacement_gradient};
use crate::numerics::random::Random;
use crate::numerics::statistics::percentile;
use crate::synth::anatomy::{FINGERTIP_RADII, body};
use crate::synth::body::{Body, extent};
use crate::synth::landmarks::landmarks;
use crate::synth::motion::Motion;
use crate::synth::noise::{COARSE, SmoothNoise};
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
    /// Tissue on the initial grid whose deformed place is at least a voxel inside the deformed grid.
    pub mask: Mask,
    /// Places with contrast inside the mask, between voxel centres, and where they go, exact.
    pub landmarks: Vec<Landmark>,
    /// How it was made, and what came out.
    pub description: Description,
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
}

/// The phantom that `params` ask for, both volumes on [`PhantomParams::grid`].
///
/// # Errors
/// [`SynthError`] when a value is out of range or the motion folds at this amplitude.
pub fn phantom(params: &PhantomParams) -> Result<Phantom, SynthError> {
    let grid = params.grid()?;
    phantom_on(params, grid, grid)
}

/// The same with the volumes on given grids (oblique, flipped, different ...); size and spacing of `params` play no
/// part. The body fills the axis-aligned box around the initial grid.
///
/// # Errors
/// As [`phantom`].
pub fn phantom_on(params: &PhantomParams, initial: Grid, deformed: Grid) -> Result<Phantom, SynthError> {
    params.check()?;
    let body = body(params.kind, &initial, params.seed);
    let (motion, truth, control_spacing_mm) = motion(params, &body, initial)?;
    let rest_first = params.motion == MotionKind::Press;
    let before = Volume::from_voxels(initial, |at, x| {
        body.sample(if rest_first { x } else { x.moved(truth.at(at).map(f64::from)) })
    });
    let after = Volume::from_voxels(deformed, |_, y| body.sample(if rest_first { motion.origin_of(y) } else { y }));
    let clean = intensities(&before);
    let mut values: Vec<f64> = after.as_slice().iter().map(|v| v.0).collect();
    let noise_sigma = params.noise * percentile(&mut values, 99.0);
    let mask = mask(&before, &truth, &deformed);
    let landmarks = landmarks(&clean, &mask, &motion, params.landmarks, Random::new(params.seed, 50));
    let inside = || (0..initial.len()).filter(|&at| mask.as_slice()[at] != 0);
    let lengths: Vec<f64> = inside().map(|at| length(truth.at(at))).collect();
    let (jacobian_min, jacobian_max) = jacobian_range(&truth, |at| mask.as_slice()[at] != 0);
    let description = Description {
        params: PhantomParams { size: initial.shape(), spacing: initial.spacing(), ..params.clone() },
        control_spacing_mm,
        noise_sigma,
        mean_mm: lengths.iter().sum::<f64>() / lengths.len().max(1) as f64,
        max_mm: lengths.iter().copied().fold(0.0, f64::max),
        jacobian_min,
        jacobian_max,
        mask_voxels: lengths.len(),
        landmarks_found: landmarks.len(),
    };
    let biased = biased(&after, params);
    Ok(Phantom {
        initial: rician(&clean, noise_sigma, params.seed, 60),
        deformed: rician(&biased, noise_sigma, params.seed, 61),
        truth,
        mask,
        landmarks,
        description,
    })
}

/// The motion asked for, its field on `grid`, and the control spacing (mm) if it is smooth.
fn motion(params: &PhantomParams, body: &Body, grid: Grid) -> Result<(Motion, DenseField, Option<f64>), SynthError> {
    let centres = (0..grid.len()).into_par_iter().map(|at| {
        let [i, j, k] = grid.voxel(at);
        grid.world(i, j, k)
    });
    let tissue: Vec<WorldPoint> = centres.filter(|&p| body.contains(p)).collect();
    let (seed, amplitude) = (params.seed, params.amplitude);
    let random = Random::new(seed, 30);
    let half = extent(&grid).map(|e| e / 2.0);
    let truth = |motion: &Motion| DenseField::from_voxels(grid, |_, x| motion.at(x));
    let unfolded = |motion: &Motion, truth: &DenseField| {
        motion.is_discontinuous() || jacobian_range(truth, |_| true).0 > MIN_JACOBIAN
    };
    let folds = ParamError {
        name: "amplitude",
        value: amplitude,
        range: "less for this motion: the Jacobian determinant of the truth falls to 0.1",
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
        return Err(folds.into());
    }
    let motion = match params.motion {
        MotionKind::None | MotionKind::Smooth => Motion::none(&grid),
        MotionKind::Translate => Motion::translate(&grid, amplitude, random),
        MotionKind::Rotate => Motion::rotate(&grid, amplitude, random),
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
        false => Err(folds.into()),
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

/// Tissue off the initial grid's border whose deformed place lies a voxel or more inside the deformed grid.
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

/// The clean image times exp(bias b), where b is smooth with mean 0 and largest magnitude 1 in the tissue.
fn biased(clean: &Imaged, params: &PhantomParams) -> Volume {
    let grid = *clean.grid();
    let cell = extent(&grid).iter().fold(0.0, |m: f64, &e| m.max(e)) / 2.0;
    let noise = SmoothNoise::<1>::new(Random::new(params.seed, 70), [cell; 3], COARSE);
    let slow = Volume::from_voxels(grid, |_, y| noise.at(y.0)[0]);
    let tissue: Vec<f64> = slow.as_slice().iter().zip(clean.as_slice()).filter(|v| v.1.1).map(|v| *v.0).collect();
    let mean = tissue.iter().sum::<f64>() / tissue.len().max(1) as f64;
    let largest = tissue.iter().map(|v| (v - mean).abs()).fold(1e-12, f64::max);
    Volume::from_voxels(grid, |at, _| {
        let b = (slow.as_slice()[at] - mean) / largest;
        (clean.as_slice()[at].0 * (params.bias * b).exp()) as f32
    })
}

/// Magnitude of the clean value plus complex Gaussian noise of deviation `sigma` a channel (Gudbjartsson, Patz 1995).
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
