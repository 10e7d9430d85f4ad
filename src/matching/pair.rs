//! The two volumes on one lattice, as the matching works on them.

use crate::matching::brightness::Brightness;
use crate::numerics::bspline::{Lattice, SmoothSampler};
use crate::numerics::pyramid;
use crate::numerics::sampling::beside;
use crate::numerics::simd::dispatch;
use crate::types::{GridVector, VoxelPoint};
use rayon::prelude::*;
use std::borrow::Cow;
use std::ops::Range;

/// Edge of the blocks in which texture is measured (finest voxels).
const TEXTURE_BLOCK_VOXELS: usize = 7;

/// Least standard deviation in a block over the noise for it to have texture; that of noise alone
/// varies by 4 % (343 voxels).
const MIN_TEXTURE_SNR: f32 = 1.25;

/// A place that is known in both volumes, with how well.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Anchor {
    /// Place on the initial lattice.
    pub at: VoxelPoint,
    /// Displacement.
    pub displacement: GridVector,
    /// Standard deviation along an axis (mm).
    pub sd: f64,
}

/// An initial and a deformed volume whose voxels have the same axes and size; the second may start
/// elsewhere.
#[derive(Debug, Clone)]
pub struct Pair<'a> {
    /// Voxels of the initial volume.
    pub shape: [usize; 3],
    /// Voxel edges (mm).
    pub spacing: [f64; 3],
    /// Initial intensities.
    pub fixed: Cow<'a, [f32]>,
    /// The same, smoothed by the cubic B-spline (see [`SmoothSampler`]).
    pub fixed_smooth: Cow<'a, [f32]>,
    /// Where matches are wanted (not 0), on the initial lattice; the value is the voxel's weight in
    /// the local gain (`crate::matching::gain::weigh`).
    pub mask: Cow<'a, [u8]>,
    /// Voxels of the mask.
    pub inside: usize,
    /// The mask's extent in each row.
    pub spans: Spans,
    /// Standard deviation of the initial volume's noise inside the mask (intensity).
    pub noise: f32,
    /// About the mean of each volume (intensity), taken off before squares are summed.
    pub centres: [f32; 2],
    /// Voxels of the deformed volume.
    pub moving_shape: [usize; 3],
    /// Initial-lattice position of the deformed volume's first voxel (voxels).
    pub moving_origin: [f64; 3],
    /// Deformed intensities.
    pub moving: Cow<'a, [f32]>,
    /// Landmarks.
    pub anchors: Cow<'a, [Anchor]>,
}

impl<'a> Pair<'a> {
    /// The same, with its own copy of the volumes.
    pub fn into_owned(self) -> Pair<'static> {
        Pair {
            fixed: self.fixed.into_owned().into(),
            fixed_smooth: self.fixed_smooth.into_owned().into(),
            mask: self.mask.into_owned().into(),
            moving: self.moving.into_owned().into(),
            anchors: self.anchors.into_owned().into(),
            ..self
        }
    }

    /// The same without copies of the volumes, where only `spans` are looked at.
    pub fn within(&self, spans: Spans) -> Pair<'_> {
        Pair {
            fixed: Cow::Borrowed(&self.fixed),
            fixed_smooth: Cow::Borrowed(&self.fixed_smooth),
            mask: Cow::Borrowed(&self.mask),
            moving: Cow::Borrowed(&self.moving),
            anchors: Cow::Borrowed(&self.anchors),
            spans,
            ..*self
        }
    }

    /// Puts `deformed` in the place of the deformed volume.
    pub fn put(&mut self, deformed: Cow<'a, [f32]>) {
        self.centres[1] = about_mean(&deformed);
        self.moving = deformed;
    }

    /// Brings the deformed volume of this level of `factor` to the initial one's brightness.
    pub fn even_out(&mut self, light: &Brightness, factor: [usize; 3]) {
        light.even_out(self.moving.to_mut(), self.moving_shape, self.moving_origin, factor);
        self.centres[1] = about_mean(&self.moving);
    }

    /// Position in the deformed volume's own voxels.
    #[inline(always)]
    pub fn to_moving(&self, VoxelPoint(p): VoxelPoint) -> [f32; 3] {
        std::array::from_fn(|a| (p[a] - self.moving_origin[a]) as f32)
    }

    /// About as far along every axis (mm) as `n` of the finest axis' voxels, in voxels of each: at
    /// least one.
    pub(crate) fn in_voxels(&self, n: usize) -> [usize; 3] {
        let finest = pyramid::finest(self.shape, self.spacing);
        self.spacing.map(|s| ((n as f64 * finest / s).round() as usize).max(1))
    }

    /// The part of the mask where nothing stands out of the noise: blocks of about seven of the
    /// finest voxels along each axis in which the initial volume's standard deviation is hardly
    /// more than the noise. How that moves only its surroundings tell.
    pub fn plain(&self) -> f64 {
        let plain = self.blocks().into_iter().filter(|(textured, _)| !textured);
        plain.map(|(_, inside)| inside).sum::<usize>() as f64 / self.inside.max(1) as f64
    }

    /// Whether a place lies in such a block, with none that has texture beside it.
    pub(crate) fn is_plain(&self) -> impl Fn(VoxelPoint) -> bool + Sync + use<> {
        let side = self.in_voxels(TEXTURE_BLOCK_VOXELS);
        let [nx, ny, nz] = std::array::from_fn(|a| self.shape[a].div_ceil(side[a]));
        let textured: Vec<bool> = self.blocks().into_iter().map(|(textured, inside)| textured && inside > 0).collect();
        move |VoxelPoint(p)| {
            let [i, j, k] = std::array::from_fn(|a| p[a].round().max(0.0) as usize / side[a]);
            let own = i + nx * (j + ny * k);
            !textured[own] && beside([nx, ny, nz], own).all(|block| !textured[block])
        }
    }

    /// Of each block of [`Pair::plain`] (x fastest), whether it has texture, and its voxels of the
    /// mask.
    fn blocks(&self) -> Vec<(bool, usize)> {
        let [nx, ny, nz] = self.shape;
        let side = self.in_voxels(TEXTURE_BLOCK_VOXELS);
        let least = f64::from(MIN_TEXTURE_SNR * self.noise).powi(2);
        let corners = |n: usize, a: usize| (0..n).step_by(side[a]);
        let in_slab = |k: usize| -> Vec<(bool, usize)> {
            let blocks = corners(ny, 1).flat_map(|j| corners(nx, 0).map(move |i| self.block([i, j, k], side)));
            blocks.map(|(variance, inside)| (variance > least, inside)).collect()
        };
        let slabs: Vec<usize> = corners(nz, 2).collect();
        slabs.into_par_iter().map(in_slab).collect::<Vec<_>>().concat()
    }

    /// The initial volume's variance over a block that ends at the volume's faces, and the block's
    /// voxels of the mask.
    fn block(&self, first: [usize; 3], side: [usize; 3]) -> (f64, usize) {
        let [xs, ys, zs]: [Range<usize>; 3] =
            std::array::from_fn(|a| first[a]..(first[a] + side[a]).min(self.shape[a]));
        let (mut sums, mut inside) = ([0.0f64; 2], 0);
        for (j, k) in zs.clone().flat_map(|k| ys.clone().map(move |j| (j, k))) {
            let from = self.shape[0] * (j + self.shape[1] * k);
            let row = from + xs.start..from + xs.end;
            inside += self.mask[row.clone()].iter().filter(|&&m| m != 0).count();
            for v in self.fixed[row].iter().map(|v| f64::from(v - self.centres[0])) {
                sums = [sums[0] + v, sums[1] + v * v];
            }
        }
        let n = (xs.len() * ys.len() * zs.len()) as f64;
        // Of one value only rounding is left.
        let (square, mean) = (sums[1] / n, sums[0] / n);
        let variance = square - mean * mean;
        (if variance > 1e-9 * square { variance } else { 0.0 }, inside)
    }

    /// The deformed volume as a sampler.
    pub fn sampler(&self) -> SmoothSampler<'_> {
        SmoothSampler { data: &self.moving, shape: self.moving_shape }
    }

    /// The deformed volume sampled at `x + u(x)`: smoothed like `fixed_smooth`, NaN where it was
    /// not seen and outside `spans`. `coefficients` are mm along the lattice's axes.
    pub fn warp(&self, lattice: &Lattice, coefficients: &[f32], spans: &Spans) -> Vec<f32> {
        let mut out = self.unseen();
        self.warp_again(lattice, coefficients, spans, &mut out);
        out
    }

    /// The deformed volume sampled within the pair's own spans. The rest is 0 and takes no memory;
    /// nothing may be read there.
    pub(crate) fn warp_sparsely(&self, lattice: &Lattice, coefficients: &[f32]) -> Vec<f32> {
        let mut out = vec![0.0; self.fixed.len()];
        self.warp_again(lattice, coefficients, &self.spans, &mut out);
        out
    }

    /// A volume of which nothing was seen yet: NaN.
    pub fn unseen(&self) -> Vec<f32> {
        vec![f32::NAN; self.fixed.len()]
    }

    /// As [`Pair::warp`], into `out`; what lies outside `spans` stays as it is there.
    pub(crate) fn warp_again(&self, lattice: &Lattice, coefficients: &[f32], spans: &Spans, out: &mut [f32]) {
        let [nx, ny, _] = self.shape;
        let sampler = self.sampler();
        let scale: [f32; 3] = std::array::from_fn(|a| (1.0 / self.spacing[a]) as f32);
        let origin = self.moving_origin.map(|o| o as f32);
        out.par_chunks_mut(nx * ny).enumerate().for_each(|(k, plane)| {
            if (0..ny).all(|j| spans.row(j, k).is_empty()) {
                return;
            }
            let slice = lattice.slice(coefficients, k);
            let mut nodes = vec![0.0; lattice.nodes[0]];
            let mut d: [Vec<f32>; 3] = std::array::from_fn(|_| vec![0.0; nx]);
            for (j, row) in plane.chunks_exact_mut(nx).enumerate() {
                let span = spans.row(j, k);
                if span.is_empty() {
                    continue;
                }
                dispatch(
                    #[inline(always)]
                    || {
                        for (c, d) in d.iter_mut().enumerate() {
                            lattice.row(&slice, c, j, &mut nodes, d);
                        }
                        let start = [span.start as f32, j as f32, k as f32];
                        let d: [&[f32]; 3] = std::array::from_fn(|a| &d[a][span.clone()]);
                        sampler.row(start, d, scale, origin, &mut row[span.clone()]);
                    },
                );
            }
        });
    }
}

/// Mean of the finite values among at most about 100,000.
pub(crate) fn about_mean(values: &[f32]) -> f32 {
    let sample = values.iter().step_by((values.len() / 100_000).max(1)).filter(|v| v.is_finite());
    let (sum, n) = sample.fold((0.0, 0usize), |(s, n), v| (s + f64::from(*v), n + 1));
    (sum / n.max(1) as f64) as f32
}

/// Step of at least `wanted` (and 1) through the rows `(j, k)` of a volume of `ny` rows a slice, as
/// they lie in memory, that meets every `j` alike: it has no divisor in common with `ny`, which
/// else could give the same few rows of each slice.
pub fn row_step(wanted: usize, ny: usize) -> usize {
    let divisor = |mut a: usize, mut b: usize| {
        while b > 0 {
            (a, b) = (b, a % b);
        }
        a
    };
    (wanted.max(1)..).find(|&step| divisor(step, ny) == 1).unwrap_or(1)
}

/// One run of voxels along each row of a volume, wide enough for all that matters there.
#[derive(Debug, Clone, PartialEq)]
pub struct Spans {
    rows: Vec<[u32; 2]>,
    shape: [usize; 3],
}

impl Spans {
    /// From the first to the last voxel of each row inside the mask.
    pub fn new(mask: &[u8], shape: [usize; 3]) -> Self {
        let span = |row: &[u8]| match row.iter().position(|&m| m != 0) {
            Some(first) => [first as u32, (row.len() - row.iter().rev().take_while(|&&m| m == 0).count()) as u32],
            None => [0, 0],
        };
        Self { rows: mask.par_chunks(shape[0]).map(span).collect(), shape }
    }

    /// The voxels of row `(j, k)`.
    #[inline(always)]
    pub fn row(&self, j: usize, k: usize) -> Range<usize> {
        let [from, to] = self.rows[j + self.shape[1] * k];
        from as usize..to as usize
    }

    /// Grown by `radius` voxels along each axis (the box around each voxel).
    pub fn grown(&self, radius: usize) -> Self {
        let [nx, ny, nz] = self.shape;
        let join = |from: &[[u32; 2]], rows: &mut dyn Iterator<Item = usize>| {
            rows.map(|r| from[r])
                .filter(|r| r[0] < r[1])
                .reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1])])
                .unwrap_or([0, 0])
        };
        let near = |at: usize, n: usize| at.saturating_sub(radius)..(at + radius + 1).min(n);
        let along_y: Vec<[u32; 2]> = (0..ny * nz)
            .map(|row| {
                let (j, k) = (row % ny, row / ny);
                join(&self.rows, &mut near(j, ny).map(|j| j + ny * k))
            })
            .collect();
        let rows = (0..ny * nz)
            .map(|row| {
                let (j, k) = (row % ny, row / ny);
                let [from, to] = join(&along_y, &mut near(k, nz).map(|k| j + ny * k));
                if from < to {
                    [from.saturating_sub(radius as u32), (to + radius as u32).min(nx as u32)]
                } else {
                    [0, 0]
                }
            })
            .collect();
        Self { rows, shape: self.shape }
    }

    /// Only the slices `k` for which `keep(k)` holds.
    pub fn slices(&self, keep: impl Fn(usize) -> bool) -> Self {
        let ny = self.shape[1];
        let rows = self.rows.iter().enumerate().map(|(row, &r)| if keep(row / ny) { r } else { [0, 0] }).collect();
        Self { rows, shape: self.shape }
    }
}

/// The mask grown by `radius` voxels along each axis in turn (a box).
pub fn dilate(mask: &[u8], shape: [usize; 3], radius: usize) -> Vec<u8> {
    let [nx, ny, nz] = shape;
    let plane = nx * ny;
    let grow = |out: &mut [u8], other: &[u8]| {
        for (o, v) in out.iter_mut().zip(other) {
            *o = (*o).max(*v);
        }
    };
    let mut flat = mask.to_vec();
    flat.par_chunks_mut(plane).zip(mask.par_chunks(plane)).for_each(|(out, mask)| {
        let mut wide = mask.to_vec();
        for r in 1..=radius.min(nx - 1) {
            for (wide, mask) in wide.chunks_exact_mut(nx).zip(mask.chunks_exact(nx)) {
                grow(&mut wide[r..], mask);
                grow(wide, &mask[r..]);
            }
        }
        out.copy_from_slice(&wide);
        for r in (1..=radius.min(ny - 1)).map(|r| r * nx) {
            grow(&mut out[r..], &wide);
            grow(out, &wide[r..]);
        }
    });
    let mut out = flat.clone();
    out.par_chunks_mut(plane).enumerate().for_each(|(k, out)| {
        for other in (k.saturating_sub(radius)..(k + radius + 1).min(nz)).filter(|&o| o != k) {
            grow(out, &flat[other * plane..(other + 1) * plane]);
        }
    });
    out
}
