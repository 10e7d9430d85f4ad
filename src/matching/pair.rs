//! The two volumes on one lattice, as the matching works on them.

use crate::numerics::bspline::{Lattice, SmoothSampler};
use crate::numerics::simd::dispatch;
use rayon::prelude::*;

/// An initial and a deformed volume whose voxels have the same axes and size; the second may start elsewhere.
#[derive(Debug, Clone)]
pub struct Pair {
    /// Voxels of the initial volume.
    pub shape: [usize; 3],
    /// Voxel edges (mm).
    pub spacing: [f64; 3],
    /// Initial intensities.
    pub fixed: Vec<f32>,
    /// The same, smoothed by the cubic B-spline (see [`SmoothSampler`]).
    pub fixed_smooth: Vec<f32>,
    /// Where matches are wanted (not 0), on the initial lattice.
    pub mask: Vec<u8>,
    /// Voxels of the deformed volume.
    pub moving_shape: [usize; 3],
    /// Initial-lattice position of the deformed volume's first voxel (voxels).
    pub moving_origin: [f64; 3],
    /// Deformed intensities.
    pub moving: Vec<f32>,
}

impl Pair {
    /// Position in the deformed volume's own voxels.
    #[inline(always)]
    pub fn to_moving(&self, p: [f64; 3]) -> [f32; 3] {
        std::array::from_fn(|a| (p[a] - self.moving_origin[a]) as f32)
    }

    /// The deformed volume as a sampler.
    pub fn sampler(&self) -> SmoothSampler<'_> {
        SmoothSampler { data: &self.moving, shape: self.moving_shape }
    }

    /// Whether any voxel of row `(j, k)` is inside the mask.
    #[inline(always)]
    pub fn row_in_mask(&self, j: usize, k: usize) -> bool {
        let from = self.shape[0] * (j + self.shape[1] * k);
        self.mask[from..from + self.shape[0]].iter().any(|&m| m != 0)
    }

    /// The deformed volume sampled at `x + u(x)`: smoothed like `fixed_smooth`, NaN where it was not seen and where
    /// `active` is 0. `coefficients` are mm along the lattice's axes.
    pub fn warp(&self, lattice: &Lattice, coefficients: &[f32], active: &[u8]) -> Vec<f32> {
        let [nx, ny, _] = self.shape;
        let mut out = vec![f32::NAN; self.fixed.len()];
        let sampler = self.sampler();
        let scale: [f32; 3] = std::array::from_fn(|a| (1.0 / self.spacing[a]) as f32);
        let origin = self.moving_origin.map(|o| o as f32);
        out.par_chunks_mut(nx * ny).enumerate().for_each(|(k, plane)| {
            let slice = lattice.slice(coefficients, k);
            let mut nodes = vec![0.0; lattice.nodes[0]];
            let mut d: [Vec<f32>; 3] = std::array::from_fn(|_| vec![0.0; nx]);
            for (j, row) in plane.chunks_exact_mut(nx).enumerate() {
                let from = nx * (j + ny * k);
                let active = &active[from..from + nx];
                if active.iter().all(|&m| m == 0) {
                    continue;
                }
                dispatch(|| {
                    for (c, d) in d.iter_mut().enumerate() {
                        lattice.row(&slice, c, j, &mut nodes, d);
                    }
                    for i in 0..nx {
                        if active[i] != 0 {
                            row[i] = sampler.at([
                                i as f32 + d[0][i] * scale[0] - origin[0],
                                j as f32 + d[1][i] * scale[1] - origin[1],
                                k as f32 + d[2][i] * scale[2] - origin[2],
                            ]);
                        }
                    }
                });
            }
        });
        out
    }
}

/// The mask grown by `radius` voxels along each axis in turn (a box).
pub fn dilate(mask: &[u8], shape: [usize; 3], radius: usize) -> Vec<u8> {
    let stride = [1, shape[0], shape[0] * shape[1]];
    let mut out = mask.to_vec();
    for a in 0..3 {
        let source = out.clone();
        let (n, s) = (shape[a], stride[a]);
        out.par_chunks_mut(stride[2]).enumerate().for_each(|(k, out)| {
            for (o, out) in out.iter_mut().enumerate() {
                let index = o + k * stride[2];
                let at = index / s % n;
                let (lo, hi) = (at.saturating_sub(radius), (at + radius).min(n - 1));
                *out = (lo..=hi).map(|p| source[index + p * s - at * s]).max().unwrap_or(0);
            }
        });
    }
    out
}
