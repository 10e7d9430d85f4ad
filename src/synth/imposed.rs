//! Known motions imposed on a real volume: a pair whose displacement is exact.
//!
//! The volume is taken as the deformed one; the initial one shows it at x + u(x), sampled once by a
//! cubic B-spline. So no motion has to be inverted.

use crate::numerics::random::Random;
use crate::numerics::sampling::{Interpolation, Sampler};
use crate::types::{DenseField, Grid, Mask, Volume, VoxelPoint, Voxels};
use std::f64::consts::TAU;

/// A motion across one axis in waves along another, whose length grows along a third: the star of
/// the DIC Challenge 2.0 (Reu et al. 2022, Experimental Mechanics 62:639). It shears and keeps the
/// volume.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Star {
    /// Voxel axes: that of the waves, that along which they grow, that of the motion.
    pub axes: [usize; 3],
    /// Amplitude (mm).
    pub amplitude: f64,
    /// Wavelengths at the first and the last row (mm).
    pub wavelengths: [f64; 2],
    /// The first and the last row (voxels).
    pub rows: [f64; 2],
    /// Where along the waves they are all in phase (voxels).
    pub middle: f64,
}

impl Star {
    /// Over the box of a mask, from four voxel edges along the waves to two thirds of the box.
    pub fn over(mask: &Mask, axes: [usize; 3], amplitude: f64) -> Self {
        let grid = mask.grid();
        let [low, high] = mask.bounds().unwrap_or([[0; 3]; 2]);
        let [wave, grow, _] = axes;
        let extent = (high[wave] + 1 - low[wave]) as f64 * grid.spacing()[wave];
        let shortest = 4.0 * grid.spacing()[wave];
        Self {
            axes,
            amplitude,
            wavelengths: [shortest, (extent / 1.5).max(2.0 * shortest)],
            rows: [low[grow] as f64, high[grow] as f64],
            middle: (low[wave] + high[wave]) as f64 / 2.0,
        }
    }

    /// The wavelength (mm) at a row of the axis along which they grow.
    pub fn wavelength(&self, row: f64) -> f64 {
        let [first, last] = self.rows;
        let t = ((row - first) / (last - first).max(1.0)).clamp(0.0, 1.0);
        self.wavelengths[0] * (self.wavelengths[1] / self.wavelengths[0]).powf(t)
    }

    /// The displacement along the axis of the motion (mm) at a voxel of a grid with voxels of
    /// `spacing` (mm).
    pub fn along(&self, voxel: [usize; 3], spacing: [f64; 3]) -> f64 {
        let [wave, grow, _] = self.axes;
        let from = (voxel[wave] as f64 - self.middle) * spacing[wave];
        self.amplitude * (TAU * from / self.wavelength(voxel[grow] as f64)).cos()
    }

    /// The displacement on a grid (mm, RAS).
    pub fn field(&self, grid: &Grid) -> DenseField {
        let (spacing, linear, moves) = (grid.spacing(), grid.affine().linear(), self.axes[2]);
        DenseField::from_voxels(*grid, |at, _| {
            let by = self.along(grid.voxel(at), spacing);
            std::array::from_fn(|r| by * linear[r][moves] / spacing[moves])
        })
    }
}

/// The displacement (mm, RAS) of a uniform stretch by `strain` along voxel axis `axis` about the
/// middle of a grid, which keeps the volume to first order.
///
/// ```
/// use palpate::field::jacobian::jacobian_determinant;
/// use palpate::synth::imposed::stretch;
/// use palpate::{Affine, Grid};
/// let grid = Grid::new([9; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let field = stretch(&grid, 2, 0.02);
/// assert!((field.at(grid.index(4, 4, 8))[2] - 0.08).abs() < 1e-6);
/// // The volume is kept to first order.
/// assert!((jacobian_determinant(&field).as_slice()[0] - 1.0).abs() < 1e-3);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn stretch(grid: &Grid, axis: usize, strain: f64) -> DenseField {
    let (shape, linear) = (grid.shape(), grid.affine().linear());
    let others = (0..3).filter(|&a| a != axis && shape[a] > 1).count().max(1) as f64;
    DenseField::from_voxels(*grid, |at, _| {
        let v = grid.voxel(at);
        let along = |a: usize| {
            let from = v[a] as f64 - (shape[a] - 1) as f64 / 2.0;
            from * if a == axis { strain } else { -strain / others }
        };
        std::array::from_fn(|r| (0..3).map(|a| linear[r][a] * along(a)).sum())
    })
}

/// The volume at x + u(x), on the field's grid; outside it the value of its border.
///
/// ```
/// use palpate::synth::imposed::imposed;
/// use palpate::{Affine, DenseField, Grid, Volume};
/// let grid = Grid::new([16; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let scan = Volume::from_voxels(grid, |_, p| (0.5 * p.0[0]).sin() as f32);
/// let moved = imposed(&scan, &DenseField::from_fn(grid, |_| [1.0, 0.0, 0.0]));
/// assert!(
///     (moved.as_slice()[grid.index(7, 8, 8)] - scan.as_slice()[grid.index(8, 8, 8)]).abs() < 1e-3
/// );
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn imposed(volume: &Voxels<'_>, field: &DenseField) -> Volume {
    let (grid, there) = (*field.grid(), volume.grid());
    let sampler = Sampler::new(volume, Interpolation::Cubic, 0.0);
    let most = there.shape().map(|n| (n - 1) as f64);
    Volume::from_voxels(grid, |at, place| {
        let VoxelPoint(v) = there.affine().to_voxel(place.moved(field.at(at).map(f64::from)));
        sampler.at(VoxelPoint(std::array::from_fn(|a| v[a].clamp(0.0, most[a]))))
    })
}

/// The volume with white Gaussian noise of this standard deviation.
///
/// ```
/// use palpate::synth::imposed::with_noise;
/// use palpate::{Affine, Grid, Volume};
/// let grid = Grid::new([24; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let noisy = with_noise(&Volume::filled(grid, 100.0), 5.0, 1);
/// let variance: f32 =
///     noisy.as_slice().iter().map(|v| (v - 100.0).powi(2)).sum::<f32>() / grid.len() as f32;
/// assert!((variance.sqrt() - 5.0).abs() < 0.2);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn with_noise(volume: &Voxels<'_>, sigma: f64, seed: u64) -> Volume {
    let nx = volume.grid().shape()[0];
    Volume::by_rows(*volume.grid(), |row, out| {
        let mut random = Random::new(seed, row as u64);
        let values = &volume.as_slice()[row * nx..(row + 1) * nx];
        let mut spare = None;
        for (out, v) in out.iter_mut().zip(values) {
            let e = spare.take().unwrap_or_else(|| {
                let [a, b] = random.normals();
                spare = Some(b);
                a
            });
            *out = v + (sigma * e) as f32;
        }
    })
}
