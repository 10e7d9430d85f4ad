//! The coarse-to-fine pyramid: both volumes on one lattice at several voxel sizes.

use crate::error::{FieldError, SpaceError};
use crate::matching::gain::weigh;
use crate::matching::pair::{Anchor, Pair, Spans, about_mean};
use crate::numerics::sampling::Sampler;
use crate::numerics::statistics::{noise_sigma, quantile};
use crate::numerics::{ablation, filters, pyramid};
use crate::types::{Affine, Grid, Mask, Volume, VoxelPoint, Voxels};
use rayon::prelude::*;
use std::borrow::Cow;

/// Both volumes at full resolution on lattices with the same axes and voxel size.
#[derive(Debug, Clone)]
pub struct Aligned<'a> {
    shape: [usize; 3],
    spacing: [f64; 3],
    fixed: Cow<'a, [f32]>,
    mask: Cow<'a, [u8]>,
    moving_shape: [usize; 3],
    moving_origin: [f64; 3],
    moving: Cow<'a, [f32]>,
    anchors: Vec<Anchor>,
}

impl<'a> Aligned<'a> {
    /// Puts the deformed volume on the initial volume's axes. Where its axes and voxel size are the
    /// same already (whatever its origin and shape) its values are taken as they are, else it is
    /// resampled once (cubic) over its own extent, cut to the initial volume's box widened by
    /// `reach_mm`.
    ///
    /// # Errors
    /// [`FieldError::NoOverlap`] when the two boxes, widened by `reach_mm`, do not meet.
    pub fn new(
        initial: &'a Voxels<'a>,
        deformed: &'a Voxels<'a>,
        mask: &'a Mask,
        reach_mm: f64,
    ) -> Result<Self, FieldError> {
        let g = initial.grid();
        let OnAxes { values, shape, origin } = OnAxes::of(g, deformed, reach_mm)?;
        Ok(Self {
            shape: g.shape(),
            spacing: g.spacing(),
            fixed: initial.as_slice().into(),
            mask: mask.as_slice().into(),
            moving_shape: shape,
            moving_origin: origin,
            moving: values,
            anchors: Vec::new(),
        })
    }

    /// With landmarks, in voxels of the initial grid.
    #[must_use]
    pub(crate) fn with_anchors(self, anchors: Vec<Anchor>) -> Self {
        Self { anchors, ..self }
    }

    /// The same, with its own copy of the volumes.
    pub fn into_owned(self) -> Aligned<'static> {
        Aligned {
            fixed: self.fixed.into_owned().into(),
            mask: self.mask.into_owned().into(),
            moving: self.moving.into_owned().into(),
            ..self
        }
    }

    /// The pair with blocks of `factor` voxels averaged.
    pub fn level(&self, factor: [usize; 3]) -> Pair<'_> {
        self.level_within(&self.mask, factor)
    }

    /// Voxels of the initial volume.
    pub fn shape(&self) -> [usize; 3] {
        self.shape
    }

    /// The deformed volume of that level.
    pub fn deformed(&self, factor: [usize; 3]) -> Cow<'_, [f32]> {
        pyramid::reduce(&self.moving, self.moving_shape, factor)
    }

    /// The same inside another mask on the initial volume's grid.
    pub(crate) fn level_within(&self, mask: &[u8], factor: [usize; 3]) -> Pair<'_> {
        let shape = pyramid::reduced_shape(self.shape, factor);
        let fixed = pyramid::reduce(&self.fixed, self.shape, factor);
        let mut mask = pyramid::reduce_mask(mask, self.shape, factor).into_owned();
        let moving = self.deformed(factor);
        let spacing = std::array::from_fn(|a| self.spacing[a] * factor[a] as f64);
        let noise = noise_sigma(&fixed, shape, |i| mask[i] != 0);
        let fixed_smooth = filters::bspline(&fixed, shape);
        weigh(&mut mask, &fixed_smooth, shape, spacing, noise);
        Pair {
            shape,
            centres: [&fixed, &moving].map(|v| about_mean(v)),
            inside: mask.iter().filter(|&&m| m != 0).count(),
            spans: Spans::new(&mask, shape),
            noise,
            spacing,
            fixed_smooth: fixed_smooth.into(),
            fixed,
            mask: mask.into(),
            moving_shape: pyramid::reduced_shape(self.moving_shape, factor),
            moving_origin: std::array::from_fn(|a| self.moving_origin[a] / factor[a] as f64),
            moving,
            anchors: self.anchors.iter().map(|a| Anchor { at: to_level(a.at, factor), ..*a }).collect(),
        }
    }
}

/// A volume on the axes of another grid.
pub(super) struct OnAxes<'a> {
    /// Intensities, x fastest.
    pub values: Cow<'a, [f32]>,
    /// Voxels along each axis.
    pub shape: [usize; 3],
    /// Place of the first voxel, in voxels of the other grid.
    pub origin: [f64; 3],
}

impl<'a> OnAxes<'a> {
    /// The deformed volume on the axes of the initial grid `g`, as [`Aligned::new`] says.
    pub fn of(g: &Grid, deformed: &'a Voxels<'a>, reach_mm: f64) -> Result<Self, FieldError> {
        let (m, spacing) = (deformed.grid(), g.spacing());
        let [lo, hi] = overlap(g, m, reach_mm)?;
        let same_axes = (0..3)
            .all(|r| (0..3).all(|c| (g.affine().linear()[r][c] - m.affine().linear()[r][c]).abs() < 1e-4 * spacing[c]));
        if same_axes {
            let origin = g.affine().to_voxel(m.affine().origin()).0;
            return Ok(Self { values: deformed.as_slice().into(), shape: m.shape(), origin });
        }
        // A slice stays one, whatever rounding has made of its place.
        let flat = |a: usize| g.shape()[a] == 1;
        let origin = std::array::from_fn(|a| if flat(a) { 0.0 } else { lo[a].floor() });
        let extent = |a: usize| (hi[a] - origin[a]).ceil().max(0.0) as usize + 1;
        let shape = std::array::from_fn(|a| if flat(a) { 1 } else { extent(a) });
        Ok(Self { values: resample(deformed, g, origin, shape)?.into(), shape, origin })
    }
}

/// Position on a level of `factor` of a full-resolution voxel position.
#[inline(always)]
pub fn to_level(VoxelPoint(p): VoxelPoint, factor: [usize; 3]) -> VoxelPoint {
    VoxelPoint(std::array::from_fn(|a| (p[a] + 0.5) / factor[a] as f64 - 0.5))
}

/// Full-resolution voxel position of a position on a level of `factor`.
#[inline(always)]
pub fn from_level(VoxelPoint(p): VoxelPoint, factor: [usize; 3]) -> VoxelPoint {
    VoxelPoint(std::array::from_fn(|a| (p[a] + 0.5) * factor[a] as f64 - 0.5))
}

/// Reduction factors from coarse to fine. The finest is `finest` times the smallest voxel edge,
/// each coarser one about twice as coarse, up to voxels of about `coarsest_mm`; a coarse axis
/// (thick slices) is left alone until the others have caught up, and no axis is reduced below 12
/// voxels.
pub fn factors(shape: [usize; 3], spacing: [f64; 3], finest: usize, coarsest_mm: f64) -> Vec<[usize; 3]> {
    let smallest = pyramid::finest(shape, spacing);
    let mut out: Vec<[usize; 3]> = Vec::new();
    let mut scale = finest.max(1) as f64;
    loop {
        let target = smallest * scale;
        let f = std::array::from_fn(|a| {
            let most = (shape[a] / 12).max(1);
            ((target / spacing[a]).round() as usize).clamp(1, most)
        });
        if out.last() != Some(&f) {
            out.push(f);
        }
        if target * 1.5 > coarsest_mm || scale > 64.0 {
            break;
        }
        scale *= 2.0;
    }
    out.reverse();
    out
}

/// A mask of tissue where none is given: brighter than a tenth of the way from the dark to the
/// bright end (2nd and 98th percentile) after smoothing; everything when that leaves less than 2 %
/// of the volume. Voxels that are not finite are dark.
///
/// ```
/// use palpate::matching::levels::foreground;
/// use palpate::{Affine, Grid, Volume};
/// let grid = Grid::new([24; 3], Affine::scaled([1.0; 3], [-11.5; 3])?)?;
/// let ball =
///     |r: f64| move |p: palpate::WorldPoint| p.0.iter().map(|x| x * x).sum::<f64>() < r * r;
/// let volume = Volume::from_voxels(grid, |_, p| if ball(8.0)(p) { 100.0 } else { 0.0 });
/// let mask = foreground(&volume);
/// // All of the ball, and hardly more.
/// assert!((0..grid.len()).all(|o| mask.as_slice()[o] == 1 || !ball(7.0)(grid.centre(o))));
/// assert!((0..grid.len()).all(|o| mask.as_slice()[o] == 0 || ball(12.0)(grid.centre(o))));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn foreground(volume: &Voxels<'_>) -> Mask {
    let shape = volume.grid().shape();
    let smooth = filters::gaussian(&without_holes(volume), shape, [1.0; 3]);
    let stride = (smooth.len() / 400_000).max(1);
    let mut sample: Vec<f32> = smooth.iter().copied().step_by(stride).collect();
    let (lo, hi) = (quantile(&mut sample, 0.02), quantile(&mut sample, 0.98));
    let threshold = lo + 0.1 * (hi - lo);
    let mut inside: Vec<u8> = smooth.par_iter().map(|&v| u8::from(v > threshold)).collect();
    if inside.iter().filter(|&&m| m != 0).count() * 50 < inside.len() {
        inside.fill(1);
    }
    if ablation::is_on("enclosed") {
        inside = filled(inside, shape);
    }
    let mut out = Mask::filled(*volume.grid(), 0);
    out.as_mut_slice().copy_from_slice(&crate::matching::pair::dilate(&inside, shape, 1));
    out
}

/// The values, with the darkest of them where there is none that is finite: a filter spreads those.
fn without_holes<'a>(volume: &'a Voxels<'_>) -> Cow<'a, [f32]> {
    let values = volume.as_slice();
    if values.par_iter().all(|v| v.is_finite()) {
        return values.into();
    }
    let darkest = values.iter().copied().filter(|v| v.is_finite()).fold(f32::INFINITY, f32::min);
    values.iter().map(|v| if v.is_finite() { *v } else { darkest }).collect()
}

/// The mask with what it encloses in a slice across any axis: dark tissue inside a bright ring is
/// tissue. Sought on blocks of two voxels.
fn filled(mut mask: Vec<u8>, shape: [usize; 3]) -> Vec<u8> {
    let block = shape.map(|n| n.min(2));
    let coarse = pyramid::reduced_shape(shape, block);
    let wall = pyramid::share(&mask, shape, block, |m| m != 0);
    let stride = [1, coarse[0], coarse[0] * coarse[1]];
    let enclosed = |axis: usize| -> Vec<usize> {
        let [a, b] = [usize::from(axis == 0), 2 - usize::from(axis == 2)];
        let [na, nb] = [coarse[a], coarse[b]];
        let of_slice = |at: usize| {
            let place = |i: usize| at * stride[axis] + i % na * stride[a] + i / na * stride[b];
            let mut open: Vec<bool> = (0..na * nb).map(|i| wall[place(i)] > 0.0).collect();
            let rim = |i: usize| i.is_multiple_of(na) || (i + 1).is_multiple_of(na) || i / na == 0 || i / na + 1 == nb;
            let mut next: Vec<usize> = (0..na * nb).filter(|&i| rim(i) && !open[i]).collect();
            next.iter().for_each(|&i| open[i] = true);
            while let Some(i) = next.pop() {
                let (x, y) = (i % na, i / na);
                let beside = [
                    (x > 0, i.wrapping_sub(1)),
                    (x + 1 < na, i + 1),
                    (y > 0, i.wrapping_sub(na)),
                    (y + 1 < nb, i + na),
                ];
                for (_, other) in beside.into_iter().filter(|b| b.0) {
                    if !std::mem::replace(&mut open[other], true) {
                        next.push(other);
                    }
                }
            }
            (0..na * nb).filter(|&i| !open[i]).map(place).collect::<Vec<_>>()
        };
        (0..coarse[axis]).into_par_iter().flat_map_iter(of_slice).collect()
    };
    for hole in (0..3).flat_map(enclosed) {
        let at = [hole % stride[1], hole / stride[1] % coarse[1], hole / stride[2]];
        let [x, y, z] = std::array::from_fn(|c| at[c] * block[c]..((at[c] + 1) * block[c]).min(shape[c]));
        for (k, j) in z.flat_map(|k| y.clone().map(move |j| (k, j))) {
            mask[shape[0] * (j + shape[1] * k)..][x.clone()].fill(1);
        }
    }
    mask
}

/// The box that the deformed volume's grid has in common with the initial one's, widened by
/// `reach_mm`: its lowest and its highest place, in voxels of the initial grid.
///
/// # Errors
/// [`FieldError::NoOverlap`] when they do not meet.
pub fn overlap(initial: &Grid, deformed: &Grid, reach_mm: f64) -> Result<[[f64; 3]; 2], FieldError> {
    let corners = corners(deformed).map(|c| initial.affine().to_voxel(deformed.affine().to_world(c)).0);
    let (shape, spacing) = (initial.shape(), initial.spacing());
    let (mut lo, mut hi) = ([0.0; 3], [0.0; 3]);
    for a in 0..3 {
        let reach = if shape[a] == 1 { 0.5 } else { reach_mm / spacing[a] };
        lo[a] = corners.iter().map(|c| c[a]).fold(f64::INFINITY, f64::min).max(-reach);
        hi[a] = corners.iter().map(|c| c[a]).fold(f64::NEG_INFINITY, f64::max).min((shape[a] - 1) as f64 + reach);
    }
    if (0..3).any(|a| lo[a] > hi[a]) {
        let hint = "if they show the same tissue, begin with --initial centre (or moments, principal); else check sform and qform of both files (palpate info)".into();
        return Err(FieldError::NoOverlap { hint });
    }
    Ok([lo, hi])
}

fn corners(g: &Grid) -> [VoxelPoint; 8] {
    let s = g.shape();
    std::array::from_fn(|c| VoxelPoint(std::array::from_fn(|a| if c >> a & 1 == 1 { (s[a] - 1) as f64 } else { 0.0 })))
}

/// `volume` on a lattice with `grid`'s axes that starts at `origin` (voxels of `grid`); smoothed
/// first along its axes where its voxels are finer, so that nothing aliases. NaN beyond half a
/// voxel outside it.
fn resample(volume: &Voxels<'_>, grid: &Grid, origin: [f64; 3], shape: [usize; 3]) -> Result<Vec<f32>, FieldError> {
    let affine = {
        let mut rows = grid.affine().rows();
        let start = grid.affine().to_world(VoxelPoint(origin)).0;
        for r in 0..3 {
            rows[r][3] = start[r];
        }
        Affine::new(rows)?
    };
    let target = Grid::new(shape, affine).map_err(|_| SpaceError::TooLarge { shape })?;
    // Voxel edges of the target seen along each axis of the source.
    let (fine, coarse) = (volume.grid().spacing(), grid.affine().linear());
    let sigma = std::array::from_fn(|a| {
        let axis: [f64; 3] = std::array::from_fn(|r| volume.grid().affine().linear()[r][a] / fine[a]);
        let seen = (0..3).map(|c| (0..3).map(|r| coarse[r][c] * axis[r]).sum::<f64>().powi(2)).sum::<f64>().sqrt();
        0.425 * ((seen / fine[a]).powi(2) - 1.0).max(0.0).sqrt()
    });
    let smooth = if sigma.iter().all(|&s| s < 0.2) {
        volume.clone().into_volume()
    } else {
        Volume::from_vec(*volume.grid(), filters::gaussian(volume.as_slice(), volume.grid().shape(), sigma))?
    };
    let sampler = Sampler::owning(smooth, 0.0);
    let limit: [f64; 3] = volume.grid().shape().map(|n| (n - 1) as f64);
    let mut out = vec![0.0f32; target.len()];
    out.par_chunks_mut(shape[0] * shape[1]).enumerate().for_each(|(k, plane)| {
        for (at, o) in plane.iter_mut().enumerate() {
            let p = volume.grid().affine().to_voxel(target.world(at % shape[0], at / shape[0], k)).0;
            *o = if (0..3).all(|a| p[a] >= -0.5 && p[a] <= limit[a] + 0.5) {
                sampler.at(VoxelPoint(std::array::from_fn(|a| p[a].clamp(0.0, limit[a]))))
            } else {
                f32::NAN
            };
        }
    });
    Ok(out)
}
