//! Surfaces along which tissue glides: there the field jumps, and a smooth one smears the jump over several nodes.
//!
//! Where a field changes by more than 0.3 mm a mm the motion of one side, taken from a few nodes away along the direction of the
//! greatest change, may explain the volumes better than the field's own. A voxel takes it when the residual about it falls by a
//! tenth, and is believed when most of the strained voxels around it do so too. That is what tells a jump from a smooth field
//! that is merely steep: of the strained voxels 0.62 to 0.78 followed a side in heads and legs cut in two halves that glide, 0.04
//! to 0.05 where the truth was smooth and moved by 20 mm. Only voxels beside a jump are changed.

use crate::matching::gain::GainField;
use crate::matching::pair::{Pair, dilate};
use crate::numerics::bspline::Lattice;
use crate::numerics::simd::dispatch;
use crate::numerics::small::{Symmetric3, eigenvalues, principal};
use crate::numerics::{filters, pyramid};
use rayon::prelude::*;

/// Largest stretch of the displacement (mm per mm) up to which a field is left alone.
const STRAIN: f64 = 0.3;

/// How far away a side's motion is looked for (node spacings).
const AWAY: [f64; 5] = [1.0, 1.8, 2.6, 3.6, 4.6];

/// The same in the survey.
const SURVEYED: [f64; 2] = [1.8, 3.6];

/// Part of the residual's square that must be left at most.
const LEFT: f32 = 0.9;

/// Standard deviation of the window in which residuals are compared (smallest voxel edges). Heads and thighs in two halves: 2.7
/// voxels leave a fifth more error than 1, 2 a tenth more.
const WINDOW: f64 = 1.0;

/// Voxels to which it reaches.
const REACH: usize = 3;

/// Standard deviation of the window in which voxels that follow a side are counted (node spacings).
const AROUND: f64 = 3.0;

/// Share of the strained voxels around that must follow a side.
const MOST: f32 = 0.5;

/// The same in the survey, which is content with less: over all strained voxels it was 0.28 to 0.59 where tissue glided, more in places,
/// and under 0.02 elsewhere.
const SOME: f32 = 0.3;

/// Voxels that move with one side of a surface along which tissue glides.
#[derive(Debug, Clone, PartialEq)]
pub struct Sliding {
    /// Voxel of the pair's lattice, and how far from it (voxels) the field moves as this voxel does.
    pub voxels: Vec<(u32, [f32; 3])>,
    /// Voxels at which the field is steep.
    pub strained: usize,
    /// Part of the residual's square that is left in the voxels that follow a side.
    pub left: f64,
}

/// Looks for jumps that a spline field (mm along the axes, planar coefficients) has smeared; `None` where there are none.
///
/// The field's change is its displacement gradient's greatest singular value, the direction of it the right singular vector. A
/// survey of every second voxel along each axis tells where it is worth while to look at all of them.
pub fn sliding(pair: &Pair<'_>, lattice: &Lattice, coefficients: &[f32]) -> Option<Sliding> {
    let field = lattice.evaluate(coefficients);
    let steep = Steepness { pair, field: &field };
    if !is_steep(&steep) {
        return None;
    }
    let residual = Residual::new(pair, lattice, coefficients);
    let step = (0..3).map(|a| lattice.step[a] as f64 * pair.spacing[a]).fold(f64::INFINITY, f64::min);
    let sparse = look(&steep, &residual, step, &SURVEYED, 2, &pair.mask, SOME)?;
    let mut worth = vec![0u8; pair.fixed.len()];
    for (at, _) in &sparse.voxels {
        worth[*at as usize] = 1;
    }
    look(&steep, &residual, step, &AWAY, 1, &dilate(&worth, pair.shape, 2 + REACH), MOST)
}

/// Whether any of every second voxel along each axis is strained.
fn is_steep(steep: &Steepness<'_>) -> bool {
    let mask = &steep.pair.mask;
    (0..mask.len())
        .into_par_iter()
        .any(|at| mask[at] != 0 && place(steep.pair, at).iter().all(|v| v % 2 == 0) && steep.is_over(at, STRAIN))
}

/// Which voxels `within` move with a side, from every `every`th voxel along each axis.
fn look(
    steep: &Steepness<'_>,
    residual: &Residual<'_>,
    step: f64,
    away: &[f64],
    every: usize,
    within: &[u8],
    most: f32,
) -> Option<Sliding> {
    let pair = steep.pair;
    let finest = pyramid::finest(pair.shape, pair.spacing);
    let every: [usize; 3] = pair.shape.map(|n| every.min(n));
    let shape: [usize; 3] = std::array::from_fn(|a| pair.shape[a].div_ceil(every[a]));
    let spacing: [f64; 3] = std::array::from_fn(|a| pair.spacing[a] * every[a] as f64);
    let full = |i: usize| {
        let v = [i % shape[0], i / shape[0] % shape[1], i / (shape[0] * shape[1])];
        v[0] * every[0] + pair.shape[0] * (v[1] * every[1] + pair.shape[1] * v[2] * every[2])
    };
    let n = shape.iter().product();
    let inside = |i: usize| pair.mask[full(i)] != 0 && within[full(i)] != 0;
    let strained: Vec<u8> =
        (0..n).into_par_iter().map(|i| u8::from(inside(i) && steep.is_over(full(i), STRAIN))).collect();
    let count = strained.iter().filter(|&&s| s != 0).count();
    let near = dilate(&strained, shape, REACH.div_ceil(every[0]));
    let seen: Vec<(u32, [f32; 3])> = (0..n)
        .into_par_iter()
        .filter(|&i| near[i] != 0 && inside(i))
        .map(|i| (i as u32, steep.direction(full(i))))
        .collect();

    // The square of what is left under the field and under each side's motion.
    let window: [f64; 3] = spacing.map(|s| WINDOW * finest / s);
    let smooth = |values: &[f32]| {
        let mut volume = vec![0.0; n];
        for ((at, _), v) in seen.iter().zip(values) {
            volume[*at as usize] = *v;
        }
        filters::gaussian(&volume, shape, window)
    };
    let own: Vec<f32> = seen.par_iter().map(|&(i, _)| residual.own(full(i as usize))).collect();
    let base = smooth(&own);
    let mut best: Vec<f32> = base.iter().map(|b| LEFT * b).collect();
    let mut taken = vec![0.0f32; n];
    for away in away.iter().flat_map(|a| [-a * step, a * step]) {
        let mut other = vec![0.0; seen.len()];
        other.par_chunks_mut(512).zip(seen.par_chunks(512)).zip(own.par_chunks(512)).for_each(
            |((other, seen), own)| {
                dispatch(
                    #[inline(always)]
                    || {
                        for ((other, &(i, direction)), own) in other.iter_mut().zip(seen).zip(own) {
                            let at = full(i as usize);
                            let there = steep.sample(place(pair, at), offset(pair, direction, away));
                            let square = residual.square(at, there);
                            *other = if square.is_finite() { square } else { *own };
                        }
                    },
                );
            },
        );
        let cost = smooth(&other);
        for (i, _) in &seen {
            let i = *i as usize;
            if strained[i] != 0 && cost[i] < best[i] {
                (best[i], taken[i]) = (cost[i], away as f32);
            }
        }
    }

    // Believed where most of those around agree.
    let wide: [f64; 3] = spacing.map(|s| AROUND * step / s);
    let followed: Vec<f32> = taken.iter().map(|t| if *t != 0.0 { 1.0 } else { 0.0 }).collect();
    let all: Vec<f32> = strained.iter().map(|&s| f32::from(s)).collect();
    let [followed, all] = [followed, all].map(|v| filters::gaussian(&v, shape, wide));
    let (mut before, mut after) = (0.0, 0.0);
    let mut voxels = Vec::new();
    for &(i, direction) in &seen {
        let i = i as usize;
        let keep = if every[0] > 1 { strained[i] != 0 } else { taken[i] != 0.0 };
        if keep && followed[i] > most * all[i] {
            voxels.push((full(i) as u32, offset(pair, direction, f64::from(taken[i]))));
            (before, after) = (before + f64::from(base[i]), after + f64::from(best[i]));
        }
    }
    (!voxels.is_empty()).then(|| Sliding { voxels, strained: count, left: after / before.max(f64::MIN_POSITIVE) })
}

/// Voxels of a place of the pair's lattice.
fn place(pair: &Pair<'_>, at: usize) -> [usize; 3] {
    let [nx, ny, _] = pair.shape;
    [at % nx, at / nx % ny, at / (nx * ny)]
}

/// `away` mm along a direction, in voxels.
fn offset(pair: &Pair<'_>, direction: [f32; 3], away: f64) -> [f32; 3] {
    std::array::from_fn(|a| (f64::from(direction[a]) * away / pair.spacing[a]) as f32)
}

/// A dense field and its gradient.
struct Steepness<'a> {
    pair: &'a Pair<'a>,
    /// Displacement (mm along the axes), planar.
    field: &'a [f32],
}

impl Steepness<'_> {
    /// `gradient[c][a]`: change of component `c` per mm along axis `a`.
    fn gradient(&self, at: usize) -> [[f64; 3]; 3] {
        let Pair { shape, spacing, .. } = self.pair;
        let n = self.pair.fixed.len();
        let v = place(self.pair, at);
        let stride = [1, shape[0], shape[0] * shape[1]];
        std::array::from_fn(|c| {
            let u = &self.field[c * n..(c + 1) * n];
            std::array::from_fn(|a| {
                let [low, high] = [v[a].min(1), (shape[a] - 1 - v[a]).min(1)];
                let steps = (low + high).max(1) as f64 * spacing[a];
                f64::from(u[at + high * stride[a]] - u[at - low * stride[a]]) / steps
            })
        })
    }

    /// `G^T G` of the gradient.
    fn squares(&self, at: usize) -> Symmetric3 {
        let g = self.gradient(at);
        [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)].map(|(a, b)| (0..3).map(|c| g[c][a] * g[c][b]).sum())
    }

    /// Whether the greatest singular value exceeds `strain`.
    fn is_over(&self, at: usize, strain: f64) -> bool {
        let s = self.squares(at);
        // The trace bounds the greatest eigenvalue.
        s[0] + s[1] + s[2] > strain * strain && eigenvalues(&s)[0] > strain * strain
    }

    /// Unit vector along which the field changes most.
    fn direction(&self, at: usize) -> [f32; 3] {
        principal(&self.squares(at)).map(|v| v as f32)
    }

    /// The field at a voxel and an offset (voxels), trilinear, the border's value beyond it.
    #[inline(always)]
    fn sample(&self, voxel: [usize; 3], offset: [f32; 3]) -> [f32; 3] {
        let shape = self.pair.shape;
        let n = self.pair.fixed.len();
        let mut low = [0; 3];
        let mut t = [0.0; 3];
        let mut next = [0; 3];
        let stride = [1, shape[0], shape[0] * shape[1]];
        for a in 0..3 {
            let p = (voxel[a] as f32 + offset[a]).clamp(0.0, (shape[a] - 1) as f32);
            low[a] = p as usize;
            t[a] = p - low[a] as f32;
            next[a] = if low[a] + 1 < shape[a] { stride[a] } else { 0 };
        }
        let base = low[0] + stride[1] * low[1] + stride[2] * low[2];
        std::array::from_fn(|c| {
            let u = &self.field[c * n..(c + 1) * n];
            let line = |o: usize| u[base + o] + t[0] * (u[base + o + next[0]] - u[base + o]);
            let face = |o: usize| line(o) + t[1] * (line(o + next[1]) - line(o));
            face(0) + t[2] * (face(next[2]) - face(0))
        })
    }
}

/// What is left between the initial volume and the deformed one.
struct Residual<'a> {
    pair: &'a Pair<'a>,
    warped: Vec<f32>,
    /// Gain and offset of each voxel under the field.
    gain: Vec<[f32; 2]>,
}

impl<'a> Residual<'a> {
    fn new(pair: &'a Pair<'a>, lattice: &Lattice, coefficients: &[f32]) -> Self {
        let warped = pair.warp(lattice, coefficients, &pair.spans);
        let field = GainField::measure(pair, &warped);
        let [nx, ny, _] = pair.shape;
        let mut gain = vec![[0.0; 2]; warped.len()];
        gain.par_chunks_mut(nx).enumerate().for_each(|(row, gain)| {
            let (mut a, mut b) = (vec![0.0; nx], vec![0.0; nx]);
            field.row(row % ny, row / ny, &mut a, &mut b);
            for ((gain, a), b) in gain.iter_mut().zip(a).zip(b) {
                *gain = [a, b];
            }
        });
        Self { pair, warped, gain }
    }

    /// Its square under the field itself, 0 where the deformed volume was not seen.
    fn own(&self, at: usize) -> f32 {
        let square = self.of(at, self.warped[at]);
        if square.is_finite() { square } else { 0.0 }
    }

    /// Its square under a displacement (mm along the axes), NaN where the deformed volume was not seen.
    #[inline(always)]
    fn square(&self, at: usize, displacement: [f32; 3]) -> f32 {
        let voxel = place(self.pair, at);
        let target = std::array::from_fn(|a| voxel[a] as f64 + f64::from(displacement[a]) / self.pair.spacing[a]);
        self.of(at, self.pair.sampler().at(self.pair.to_moving(target)))
    }

    #[inline(always)]
    fn of(&self, at: usize, seen: f32) -> f32 {
        let [gain, offset] = self.gain[at];
        (self.pair.fixed_smooth[at] - (gain * seen + offset)).powi(2)
    }
}
