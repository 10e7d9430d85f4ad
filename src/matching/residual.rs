//! What is left of the difference between two volumes, as normal equations for a spline field.
//!
//! With `r = f - (a w + b)` (initial, gain, warped, offset) and `g` the mean of both images'
//! gradients (the symmetric Gauss-Newton step of Benhimane & Malis 2004), every node of the lattice
//! gets the information `A = sum_x B(x) rho(x) g g^T / sigma^2` and the right-hand side
//! `sum_x B(x) rho(x) g r / sigma^2`. The sum of the basis functions is one, so the block diagonal
//! `A` bounds the true Gauss-Newton matrix from above (each step cannot overshoot) and no pair of
//! nodes needs to be stored. Noise has a gradient too, which tells nothing of motion: less that,
//! `A` is the information that the data give. `rho` is Cauchy's weight, `sigma` the robust spread
//! of `r`, to which what interpolation leaves unsure adds in proportion to `g`: contrast beyond
//! that tells no more.

use crate::matching::gain::GainField;
use crate::matching::pair::{Pair, row_step};
use crate::numerics::block_diagonal::Blocks;
use crate::numerics::bspline::Lattice;
use crate::numerics::simd::dispatch;
use crate::numerics::statistics::median;
use crate::numerics::symmetric3::eigenvalues;
use crate::numerics::{ablation, filters, pyramid};
use crate::types::VoxelPoint;
use rayon::prelude::*;

/// Cauchy's tuning constant (standard deviations): 95 % efficiency for Gaussian noise (Holland &
/// Welsch 1977).
pub(crate) const CAUCHY_TUNING: f32 = 2.385;

/// Position error that interpolation leaves at any voxel, however steep (finest voxels): affine
/// motions without noise come out 0.005 to 0.03 voxels off.
pub(crate) const MIN_POSITION_ERROR_VOXELS: f64 = 0.02;

/// Gradient variance of white noise along an axis (voxel^-2) over that of the residual: smoothing
/// by (1, 4, 1) / 6 correlates voxels two apart by 1/18; then (1 - 1/18) / 2 / 4.
const NOISE_GRADIENT_VARIANCE: f32 = 17.0 / 144.0;

/// Variance of unit white noise after smoothing by (1, 4, 1) / 6 along an axis.
const SMOOTHED_NOISE_VARIANCE: f32 = 0.5;

/// Residual at which a voxel's misfit is clipped (robust standard deviations).
const RESIDUAL_CLIP_SD: f32 = 5.0;

/// Mean square of the residual about each node of `lattice`, over the robust variance of the whole
/// (1): squares of 5 deviations at most, and 1 where no tissue is near. `warped` is the deformed
/// volume, warped.
pub(crate) fn misfit_by_place(pair: &Pair<'_>, warped: &[f32], lattice: &Lattice) -> Vec<f32> {
    let gain = GainField::sharpened(pair, warped);
    let scale = 1.0 / residual_sigma(pair, warped, &gain).max(f32::MIN_POSITIVE);
    let [nx, ny, _] = pair.shape;
    let sums = lattice.accumulate::<2>(|j, k, [squares, counts]| {
        let span = pair.spans.row(j, k);
        let from = nx * (j + ny * k);
        // The two rows hold gain and offset until they are overwritten.
        gain.row(j, k, squares, counts);
        for i in span.clone() {
            let r = scale * (pair.fixed_smooth[from + i] - (squares[i] * warped[from + i] + counts[i]));
            let good = pair.mask[from + i] != 0 && r.is_finite();
            (squares[i], counts[i]) =
                if good { ((r * r).min(RESIDUAL_CLIP_SD * RESIDUAL_CLIP_SD), 1.0) } else { (0.0, 0.0) };
        }
        span
    });
    let width = lattice.nodes.map(|n| if n > 1 { 1.0 } else { 0.0 });
    let about = |v: &[f32]| filters::gaussian(v, lattice.nodes, width);
    let (squares, counts) = sums.split_at(lattice.len());
    let one = |(s, c): (f32, f32)| if c > 1.0 { s / c } else { 1.0 };
    about(squares).into_iter().zip(about(counts)).map(one).collect()
}

/// Normal equations of one pass.
#[derive(Debug, Clone)]
pub struct NormalEquations {
    /// Bound of the Gauss-Newton matrix at each node (1/mm^2).
    pub blocks: Blocks,
    /// Right-hand side (1/mm), planar.
    pub rhs: Vec<f32>,
    /// Robust standard deviation of the residual (intensity).
    pub sigma: f32,
    /// Sum of the weights at each node (intensity^-2), and what noise adds to a block for each of
    /// them (intensity^2 / mm^2, by axis).
    noise: (Vec<f32>, [f32; 3]),
}

impl NormalEquations {
    /// Multiplies all information by `factor`.
    pub fn scale(&mut self, factor: f32) {
        let all = self.blocks.planar_mut().iter_mut().chain(&mut self.rhs).chain(&mut self.noise.0);
        all.for_each(|v| *v *= factor);
    }

    /// Adds a place that pulls with `pull` (1/mm) under the information `weight` (1/mm^2, the same
    /// along every axis), as it acts on the nodes of `lattice`.
    pub fn add(&mut self, lattice: &Lattice, at: VoxelPoint, weight: f32, pull: [f32; 3]) {
        let n = lattice.len();
        let thick: [bool; 3] = lattice.shape.map(|s| s > 1);
        lattice.for_each_tap(at, |node, b| {
            for c in (0..3).filter(|&c| thick[c]) {
                self.blocks.planar_mut()[c * n + node] += b * weight;
                self.rhs[c * n + node] += b * pull[c];
            }
        });
    }

    /// Information of each node (1/mm^2): its block without what the gradient of the noise adds.
    pub fn information(&self) -> Blocks {
        let (weights, noise) = &self.noise;
        let n = weights.len();
        let mut planar = self.blocks.planar().to_vec();
        for (i, weight) in weights.iter().enumerate() {
            let mut block = self.blocks.at(i);
            (0..3).for_each(|a| block[a] -= weight * noise[a]);
            let least = if is_positive(&block) { 0.0 } else { eigenvalues(&block.map(f64::from))[2].min(0.0) as f32 };
            // Across a slice there is neither motion nor information.
            (0..3).filter(|&a| noise[a] > 0.0).for_each(|a| block[a] -= least);
            block.into_iter().enumerate().for_each(|(q, v)| planar[q * n + i] = v);
        }
        Blocks::from_planar(planar)
    }
}

/// Whether no eigenvalue of a symmetric block is negative, by its leading minors.
fn is_positive(&[xx, yy, zz, xy, xz, yz]: &[f32; 6]) -> bool {
    let determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz);
    xx >= 0.0 && xx * yy >= xy * xy && determinant >= 0.0
}

/// Least number of rows that are worth another thread.
const MIN_ROWS_PER_TASK: usize = 64;

/// Robust spread of `f - (a w + b)` over the mask (1.4826 MAD), from at most about 200,000 voxels.
pub fn residual_sigma(pair: &Pair<'_>, warped: &[f32], gain: &GainField) -> f32 {
    let [nx, ny, nz] = pair.shape;
    let rows = ny * nz;
    let stride = row_step(pair.fixed.len() / 200_000, ny);
    let in_row = |row: usize| -> Vec<f32> {
        let (j, k) = (row % ny, row / ny);
        if pair.spans.row(j, k).is_empty() {
            return Vec::new();
        }
        let (mut a, mut b) = (vec![0.0; nx], vec![0.0; nx]);
        gain.row(j, k, &mut a, &mut b);
        let here = row * nx..(row + 1) * nx;
        let values = pair.fixed_smooth[here.clone()].iter().zip(&warped[here.clone()]).zip(a.iter().zip(&b));
        let left = values.zip(&pair.mask[here]).filter(|(_, m)| **m != 0).map(|(((f, w), (a, b)), _)| f - (a * w + b));
        left.filter(|v| v.is_finite()).map(f32::abs).collect()
    };
    let some: Vec<usize> = (0..rows).step_by(stride).collect();
    let mut r: Vec<f32> = some.into_par_iter().with_min_len(MIN_ROWS_PER_TASK).flat_map_iter(in_row).collect();
    if r.is_empty() { 0.0 } else { 1.4826 * median(&mut r) }
}

/// Accumulates the normal equations of `lattice` for the present warp. `floor` bounds sigma from
/// below (intensity).
pub fn normal_equations(
    pair: &Pair<'_>,
    warped: &[f32],
    gain: &GainField,
    lattice: &Lattice,
    floor: f32,
) -> NormalEquations {
    let [nx, ny, nz] = pair.shape;
    let sigma = residual_sigma(pair, warped, gain).max(floor).max(f32::MIN_POSITIVE);
    let (variance, cut) = (sigma * sigma, 1.0 / (CAUCHY_TUNING * CAUCHY_TUNING));
    let position_error = if ablation::is_on("gradient-floor") {
        MIN_POSITION_ERROR_VOXELS * pyramid::finest(pair.shape, pair.spacing)
    } else {
        0.0
    };
    let least = position_error.powi(2) as f32;
    let per_mm: [f32; 3] = std::array::from_fn(|a| (0.5 / pair.spacing[a]) as f32);
    // Of the residual no more is noise than the volumes have.
    let thick = pair.shape.iter().filter(|&&n| n > 1).count() as i32;
    let white = variance.min(2.0 * SMOOTHED_NOISE_VARIANCE.powi(thick) * pair.noise * pair.noise);
    let counts = ablation::is_on("noise-gradient");
    let noise = std::array::from_fn(|a| match pair.shape[a] > 1 && counts {
        true => NOISE_GRADIENT_VARIANCE * white / (pair.spacing[a] * pair.spacing[a]) as f32,
        false => 0.0,
    });
    // Differences over two voxels, over one at the border; none along a side of one voxel.
    let ends = |at: usize, n: usize| (at.saturating_sub(1), (at + 1).min(n - 1));
    let mut sums = lattice.accumulate::<10>(|j, k, rows| {
        let mut span = pair.spans.row(j, k);
        if nx > 1 {
            span = span.start.max(1)..span.end.min(nx - 1);
        }
        if span.start >= span.end {
            return 0..0;
        }
        let at = |j: usize, k: usize| nx * (j + ny * k) + span.start;
        let (n, here) = (span.len(), at(j, k));
        let ((j0, j1), (k0, k1)) = (ends(j, ny), ends(k, nz));
        let x = if nx > 1 { (here - 1, here + 1) } else { (here, here) };
        let sides = [x, (at(j0, k), at(j1, k)), (at(j, k0), at(j, k1))];
        let scale = [0.5 * per_mm[0], per_mm[1] / (j1 - j0).max(1) as f32, per_mm[2] / (k1 - k0).max(1) as f32];
        dispatch(
            #[inline(always)]
            || {
                // One by one: mapped arrays are functions of their own here, and took as long as
                // the sums.
                let [xx, yy, zz, xy, xz, yz, rx, ry, rz, weights] = &mut *rows;
                // The first two rows hold gain and offset until they are overwritten.
                gain.row(j, k, xx, yy);
                let (from, to) = (span.start, span.end);
                let (xx, yy, zz) = (&mut xx[from..to], &mut yy[from..to], &mut zz[from..to]);
                let (xy, xz, yz) = (&mut xy[from..to], &mut xz[from..to], &mut yz[from..to]);
                let (rx, ry, rz) = (&mut rx[from..to], &mut ry[from..to], &mut rz[from..to]);
                let weights = &mut weights[from..to];
                let f = &pair.fixed_smooth[here..][..n];
                let w = &warped[here..][..n];
                let mask = &pair.mask[here..][..n];
                let [x, y, z] = sides;
                let fixed = &pair.fixed_smooth[..];
                let (fx0, fx1) = (&fixed[x.0..][..n], &fixed[x.1..][..n]);
                let (fy0, fy1) = (&fixed[y.0..][..n], &fixed[y.1..][..n]);
                let (fz0, fz1) = (&fixed[z.0..][..n], &fixed[z.1..][..n]);
                let (wx0, wx1) = (&warped[x.0..][..n], &warped[x.1..][..n]);
                let (wy0, wy1) = (&warped[y.0..][..n], &warped[y.1..][..n]);
                let (wz0, wz1) = (&warped[z.0..][..n], &warped[z.1..][..n]);
                for i in 0..n {
                    let (a, b) = (xx[i], yy[i]);
                    let r = f[i] - (a * w[i] + b);
                    let gx = scale[0] * (fx1[i] - fx0[i] + a * (wx1[i] - wx0[i]));
                    let gy = scale[1] * (fy1[i] - fy0[i] + a * (wy1[i] - wy0[i]));
                    let gz = scale[2] * (fz1[i] - fz0[i] + a * (wz1[i] - wz0[i]));
                    let good = mask[i] != 0 && (r + gx + gy + gz).is_finite();
                    let (r, gx, gy, gz) = if good { (r, gx, gy, gz) } else { (0.0, 0.0, 0.0, 0.0) };
                    let weight = 1.0 / (variance + least * (gx * gx + gy * gy + gz * gz) + cut * r * r);
                    weights[i] = if good { weight } else { 0.0 };
                    let (hx, hy, hz) = (weight * gx, weight * gy, weight * gz);
                    (xx[i], yy[i], zz[i]) = (hx * gx, hy * gy, hz * gz);
                    (xy[i], xz[i], yz[i]) = (hx * gy, hx * gz, hy * gz);
                    (rx[i], ry[i], rz[i]) = (hx * r, hy * r, hz * r);
                }
            },
        );
        span
    });
    let weights = sums.split_off(9 * lattice.len());
    let rhs = sums.split_off(6 * lattice.len());
    sums.shrink_to_fit();
    NormalEquations { blocks: Blocks::from_planar(sums), rhs, sigma, noise: (weights, noise) }
}

/// A warp that others are judged against.
#[derive(Debug)]
pub struct Baseline {
    warped: Vec<f32>,
    gain: GainField,
    /// Robust spread of what is left (intensity).
    sigma: f32,
}

impl Baseline {
    /// Takes the deformed volume as it was warped.
    pub fn new(pair: &Pair<'_>, warped: Vec<f32>) -> Self {
        let gain = GainField::measure(pair, &warped);
        let sigma = residual_sigma(pair, &warped, &gain).max(f32::MIN_POSITIVE);
        Self { warped, gain, sigma }
    }
}

/// How much worse, in units of noise, the volumes agree under one warp than under another.
///
/// `sum_x [rho(r_a / sigma) - rho(r_b / sigma)]` over the voxels of the mask that both warps see,
/// with Cauchy's cost `rho(t) = c^2 ln(1 + t^2 / c^2)` (nearly `t^2`) and `sigma` the robust spread
/// under the better warp `b`.
pub fn excess(pair: &Pair<'_>, a: &[f32], b: &Baseline) -> f64 {
    let [_, ny, nz] = pair.shape;
    let compared = Compared::new(pair, a, b);
    let in_row = |row: usize| {
        let mut sum = 0.0;
        compared.row(row % ny, row / ny, |_, excess| sum += excess);
        sum
    };
    let rows: Vec<f64> = (0..ny * nz).into_par_iter().map(in_row).collect();
    rows.iter().sum()
}

/// [`excess`] by place: of each voxel times each basis function of `windows`. The functions add up
/// to one, so the places add up to the whole.
pub(crate) fn excess_by_place(pair: &Pair<'_>, a: &[f32], b: &Baseline, windows: &Lattice) -> Vec<f32> {
    let compared = Compared::new(pair, a, b);
    windows.accumulate::<1>(|j, k, [row]| {
        let span = pair.spans.row(j, k);
        row[span.clone()].fill(0.0);
        compared.row(j, k, |at, excess| row[at] += excess as f32);
        span
    })
}

/// Voxels in a row whose costs share one logarithm.
const VOXELS_PER_LOGARITHM: usize = 8;

/// Two warps side by side.
struct Compared<'a> {
    pair: &'a Pair<'a>,
    worse: (&'a [f32], GainField),
    better: &'a Baseline,
}

impl<'a> Compared<'a> {
    fn new(pair: &'a Pair<'a>, worse: &'a [f32], better: &'a Baseline) -> Self {
        Self { pair, worse: (worse, GainField::measure(pair, worse)), better }
    }

    /// Calls `sum` with the excess of a few voxels of a row at a time, and one of them that lies in
    /// the pair's spans.
    fn row(&self, j: usize, k: usize, mut sum: impl FnMut(usize, f64)) {
        let Self { pair, worse, better } = self;
        let (nx, span) = (pair.shape[0], pair.spans.row(j, k));
        if span.is_empty() {
            return;
        }
        let cut = 1.0 / (CAUCHY_TUNING * better.sigma);
        let from = nx * (j + pair.shape[1] * k);
        let (mut gain, mut offset) = (vec![0.0; nx], vec![0.0; nx]);
        let mut costs = [vec![0.0f32; nx], vec![0.0f32; nx]];
        for ((warped, field), cost) in
            [(worse.0, &worse.1), (&better.warped[..], &better.gain)].into_iter().zip(&mut costs)
        {
            field.row(j, k, &mut gain, &mut offset);
            let (f, w) = (&pair.fixed_smooth[from..from + nx], &warped[from..from + nx]);
            for i in 0..nx {
                let t = cut * (f[i] - (gain[i] * w[i] + offset[i]));
                cost[i] = 1.0 + t * t;
            }
        }
        // Logarithms of products of a few voxels, not of each: ln is dear.
        for (at, (a, b)) in costs[0].chunks(VOXELS_PER_LOGARITHM).zip(costs[1].chunks(VOXELS_PER_LOGARITHM)).enumerate()
        {
            let mask = &pair.mask[from + VOXELS_PER_LOGARITHM * at..];
            let mut ratio = 1.0f64;
            for ((a, b), m) in a.iter().zip(b).zip(mask) {
                let r = f64::from(*a) / f64::from(*b);
                ratio *= if *m != 0 && r.is_finite() { r } else { 1.0 };
            }
            let middle = VOXELS_PER_LOGARITHM * at + a.len() / 2;
            sum(middle.clamp(span.start, span.end - 1), f64::from(CAUCHY_TUNING * CAUCHY_TUNING) * ratio.ln());
        }
    }
}
