//! Faults of the volumes themselves: slices, view, hot voxels, background.
//!
//! The truth is that of the phantom without the fault, on the grid that is left. Fails as the
//! phantom does.

use crate::error::SynthError;
use crate::numerics::random::Random;
use crate::numerics::statistics::percentile;
use crate::synth::anatomy::body;
use crate::synth::appearance::{FAT_INTENSITY, PATTERN_CONTRAST, unchanged};
use crate::synth::noise::Texture;
use crate::synth::params::PhantomParams;
use crate::synth::phantom::{Phantom, painted, phantom, phantom_on, rician};
use crate::types::{Affine, DenseField, Grid, Mask, Volume};
use std::collections::BTreeSet;

/// Intensity of a hot voxel over the largest of its volume (1).
const HOT_VOXEL_RATIO: f32 = 30.0;

/// Without `share` of the deformed volume, at its right end.
pub(super) fn cropped(base: &PhantomParams, share: f64) -> Result<Phantom, SynthError> {
    let grid = base.grid()?;
    let left = grid.shape()[0] - voxels(&grid, share);
    phantom_on(base, grid, window(&grid, 0, left.max(2))?)
}

/// With the deformed volume's view shifted to the right by `share` of its length.
pub(super) fn shifted(base: &PhantomParams, share: f64) -> Result<Phantom, SynthError> {
    let grid = base.grid()?;
    phantom_on(base, grid, window(&grid, voxels(&grid, share), grid.shape()[0])?)
}

/// `share` of a grid's length along x, in voxels.
fn voxels(grid: &Grid, share: f64) -> usize {
    (share * grid.shape()[0] as f64).round() as usize
}

/// `count` random voxels of the deformed volume at [`HOT_VOXEL_RATIO`] times its maximum; a larger
/// count keeps those of a smaller one.
pub(super) fn hot_voxels(base: &PhantomParams, count: usize) -> Result<Phantom, SynthError> {
    let mut made = phantom(base)?;
    let shown = made.deformed.as_mut_slice();
    let hot = HOT_VOXEL_RATIO * shown.iter().copied().fold(0.0, f32::max);
    let mut random = Random::new(base.seed, 81);
    let mut places = BTreeSet::new();
    while places.len() < count.min(shown.len()) {
        places.insert((random.bits() % shown.len() as u64) as usize);
    }
    places.into_iter().for_each(|at| shown[at] = hot);
    Ok(made)
}

/// A still background behind the body, `ratio` times as bright as fat, with a muscle's texture: the
/// same in both volumes, without noise and bias of its own.
pub(super) fn background(base: &PhantomParams, ratio: f64) -> Result<Phantom, SynthError> {
    let grid = base.grid()?;
    let mut made = painted(base, [grid; 2], &unchanged, &unchanged)?;
    // The same motion of a body that shows how much of a voxel it fills.
    let body = body(base.kind, &grid, base.seed);
    let clean = PhantomParams { noise: 0.0, bias: 0.0, landmarks: 0, ..base.clone() };
    let filled = painted(&clean, [grid; 2], &|p, _| body.share(p), &unchanged)?;
    let texture = Texture::new(&grid, base.seed.wrapping_add(1));
    let level = Volume::from_voxels(grid, |_, x| {
        (ratio * FAT_INTENSITY * (1.0 + PATTERN_CONTRAST * texture.at(x)).max(0.0)) as f32
    });
    for (seen, filled) in [(&mut made.initial, &filled.initial), (&mut made.deformed, &filled.deformed)] {
        let behind = level.as_slice().iter().zip(filled.as_slice());
        seen.as_mut_slice().iter_mut().zip(behind).for_each(|(v, (level, filled))| *v += level * (1.0 - filled));
    }
    Ok(made)
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
pub(super) fn thick_slices(base: &PhantomParams, thickness: f64) -> Result<Phantom, SynthError> {
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
