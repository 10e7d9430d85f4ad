//! Separable filters and gradients on x-fastest volumes. Borders repeat the edge value. A side of
//! one voxel is left alone: it has no direction to smooth or differentiate along.

use crate::numerics::simd::dispatch;
use rayon::prelude::*;

/// Mean and number of the finite values among the 26 around place `at` (8 in one slice); none where
/// there is no such value.
pub(crate) fn mean_beside(data: &[f32], [nx, ny, nz]: [usize; 3], at: usize) -> Option<(f32, usize)> {
    let near = |v: usize, n: usize| v.saturating_sub(1)..(v + 2).min(n);
    let (mut sum, mut count) = (0.0, 0);
    for (j, k) in near(at / (nx * ny), nz).flat_map(|k| near(at / nx % ny, ny).map(move |j| (j, k))) {
        for v in near(at % nx, nx).map(|i| data[i + nx * (j + ny * k)]).filter(|v| v.is_finite()) {
            (sum, count) = (sum + f64::from(v), count + 1);
        }
    }
    (count > 0).then(|| ((sum / count as f64) as f32, count))
}

/// A symmetric kernel, centre first: `[c0, c1, c2 ...]` stands for `... c2 c1 c0 c1 c2 ...`.
pub(crate) type HalfKernel = Vec<f32>;

/// Sampled Gaussian of standard deviation `sigma` (voxels), cut at 3 sigma, sum 1; the identity for
/// `sigma` <= 0.
pub fn gaussian_kernel(sigma: f64) -> HalfKernel {
    if sigma <= 1e-3 {
        return vec![1.0];
    }
    let radius = (3.0 * sigma).ceil().max(1.0) as usize;
    let raw: Vec<f64> = (0..=radius).map(|i| (-0.5 * (i as f64 / sigma).powi(2)).exp()).collect();
    let sum = raw[0] + 2.0 * raw[1..].iter().sum::<f64>();
    raw.iter().map(|v| (v / sum) as f32).collect()
}

/// The cubic B-spline at integers, (1/6, 4/6, 1/6): what [`crate::numerics::bspline`] sampling does
/// at a voxel centre.
pub fn bspline_kernel() -> HalfKernel {
    vec![4.0 / 6.0, 1.0 / 6.0]
}

/// `out = sum_o kernel[|o|] * row(at + o)` for rows of `n` values, `row` clamped to `0..count`.
#[inline(always)]
fn combine_rows<'a>(kernel: &[f32], count: usize, at: usize, row: impl Fn(usize) -> &'a [f32], out: &mut [f32]) {
    let c = kernel[0];
    for (o, v) in out.iter_mut().zip(row(at)) {
        *o = c * v;
    }
    for (d, &w) in kernel.iter().enumerate().skip(1) {
        let (lo, hi) = (row(at.saturating_sub(d)), row((at + d).min(count - 1)));
        for ((o, a), b) in out.iter_mut().zip(lo).zip(hi) {
            *o += w * (a + b);
        }
    }
}

/// Filters one row along itself.
#[inline(always)]
fn filter_row(kernel: &[f32], row: &[f32], padded: &mut Vec<f32>, out: &mut [f32]) {
    let (n, r) = (row.len(), kernel.len() - 1);
    padded.clear();
    padded.resize(r, row[0]);
    padded.extend_from_slice(row);
    padded.resize(n + 2 * r, row[n - 1]);
    let c = kernel[0];
    for (o, v) in out.iter_mut().zip(&padded[r..]) {
        *o = c * v;
    }
    for (d, &w) in kernel.iter().enumerate().skip(1) {
        for ((o, a), b) in out.iter_mut().zip(&padded[r - d..]).zip(&padded[r + d..]) {
            *o += w * (a + b);
        }
    }
}

/// Filters `data` along x, y and z with a half-kernel each.
pub fn separable(data: &[f32], shape: [usize; 3], kernels: [&HalfKernel; 3]) -> Vec<f32> {
    let [nx, ny, nz] = shape;
    let plane = nx * ny;
    let mut out = vec![0.0f32; data.len()];
    out.par_chunks_mut(plane).zip(data.par_chunks(plane)).for_each(|(out, data)| {
        dispatch(
            #[inline(always)]
            || {
                let mut padded = Vec::new();
                let mut along_x = data.to_vec();
                if nx > 1 && kernels[0].len() > 1 {
                    for (o, row) in along_x.chunks_exact_mut(nx).zip(data.chunks_exact(nx)) {
                        filter_row(kernels[0], row, &mut padded, o);
                    }
                }
                if ny > 1 && kernels[1].len() > 1 {
                    for (j, o) in out.chunks_exact_mut(nx).enumerate() {
                        combine_rows(kernels[1], ny, j, |r| &along_x[r * nx..(r + 1) * nx], o);
                    }
                } else {
                    out.copy_from_slice(&along_x);
                }
            },
        );
    });
    if nz == 1 || kernels[2].len() == 1 {
        return out;
    }
    let source = out;
    let mut out = vec![0.0f32; data.len()];
    out.par_chunks_mut(plane).enumerate().for_each(|(k, o)| {
        dispatch(
            #[inline(always)]
            || combine_rows(kernels[2], nz, k, |r| &source[r * plane..(r + 1) * plane], o),
        );
    });
    out
}

/// Gaussian smoothing; `sigma` in voxels along each axis.
pub fn gaussian(data: &[f32], shape: [usize; 3], sigma: [f64; 3]) -> Vec<f32> {
    let k = sigma.map(gaussian_kernel);
    separable(data, shape, [&k[0], &k[1], &k[2]])
}

/// Smoothing with the cubic B-spline (standard deviation 0.58 voxel along each axis).
pub fn bspline(data: &[f32], shape: [usize; 3]) -> Vec<f32> {
    let k = bspline_kernel();
    separable(data, shape, [&k, &k, &k])
}

/// Central difference along x of the row at `(j, k)`, per voxel; one-sided at the ends, zero for a
/// side of one.
#[inline(always)]
pub fn gradient_rows(data: &[f32], shape: [usize; 3], j: usize, k: usize, out: [&mut [f32]; 3]) {
    let [nx, ny, nz] = shape;
    let row = |j: usize, k: usize| &data[nx * (j + ny * k)..nx * (j + ny * k) + nx];
    let [gx, gy, gz] = out;
    let centre = row(j, k);
    gx.fill(0.0);
    if nx > 1 {
        for i in 1..nx - 1 {
            gx[i] = 0.5 * (centre[i + 1] - centre[i - 1]);
        }
        gx[0] = centre[1] - centre[0];
        gx[nx - 1] = centre[nx - 1] - centre[nx - 2];
    }
    let across = |lo: &[f32], hi: &[f32], scale: f32, out: &mut [f32]| {
        for ((o, a), b) in out.iter_mut().zip(lo).zip(hi) {
            *o = scale * (b - a);
        }
    };
    let ends = |at: usize, n: usize| (at.saturating_sub(1), (at + 1).min(n - 1));
    let (a, b) = ends(j, ny);
    across(row(a, k), row(b, k), 1.0 / (b - a).max(1) as f32, gy);
    let (a, b) = ends(k, nz);
    across(row(j, a), row(j, b), 1.0 / (b - a).max(1) as f32, gz);
}
