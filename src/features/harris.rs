//! The 3D corner measure (Harris & Stephens 1988; Foerstner & Guelch 1987; Rohr 1997 for volumes).

use crate::numerics::filters::{gaussian, gaussian_kernel, gradient_rows, separable};
use crate::numerics::simd::dispatch;
use rayon::prelude::*;

/// Scales of the structure tensor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HarrisParams {
    /// Smoothing before the gradient (voxels of the finest axis); 0.5 to 2, default 0.7.
    pub derivative_sigma: f64,
    /// Window of the structure tensor (voxels of the finest axis); 1 to 4, default 1.5.
    pub integration_sigma: f64,
}

impl Default for HarrisParams {
    fn default() -> Self {
        Self { derivative_sigma: 0.7, integration_sigma: 1.5 }
    }
}

/// Slices worked on at once: bounds the memory of the six products.
const SLAB: usize = 24;

/// Foerstner's measure `det M / trace(adj M) = 1 / trace(M^-1)` at each voxel, (intensity/mm)^2.
///
/// `M = G * (grad I grad I^T)` with gradients per mm and windows of the same width in mm along each axis, so
/// anisotropic voxels weigh right. The measure is the inverse of the variance with which the place can be matched
/// (Foerstner & Guelch 1987), needs no constant `k`, and is low on edges and planes. For one slice the in-plane 2 x 2
/// form is used.
pub fn response(data: &[f32], shape: [usize; 3], spacing: [f64; 3], params: HarrisParams) -> Vec<f32> {
    let [nx, ny, nz] = shape;
    let plane = nx * ny;
    let finest = (0..3).filter(|&a| shape[a] > 1).map(|a| spacing[a]).fold(f64::INFINITY, f64::min);
    let sigma = |s: f64| -> [f64; 3] { std::array::from_fn(|a| s * finest / spacing[a]) };
    let (ds, is) = (sigma(params.derivative_sigma), sigma(params.integration_sigma));
    let kernels = is.map(gaussian_kernel);
    let halo = (3.0 * ds[2]).ceil() as usize + kernels[2].len() + 1;
    let flat = shape.contains(&1);
    let per_mm: [f32; 3] = std::array::from_fn(|a| (1.0 / spacing[a]) as f32);
    let mut out = vec![0.0f32; data.len()];
    for start in (0..nz).step_by(SLAB) {
        let end = (start + SLAB).min(nz);
        let (lo, hi) = (start.saturating_sub(halo), (end + halo).min(nz));
        let part = [nx, ny, hi - lo];
        let smooth = gaussian(&data[lo * plane..hi * plane], part, ds);
        let mut products: [Vec<f32>; 6] = std::array::from_fn(|_| vec![0.0; smooth.len()]);
        let [xx, yy, zz, xy, xz, yz] = &mut products;
        let chunks = (xx.par_chunks_mut(plane), yy.par_chunks_mut(plane), zz.par_chunks_mut(plane));
        let cross = (xy.par_chunks_mut(plane), xz.par_chunks_mut(plane), yz.par_chunks_mut(plane));
        (chunks, cross).into_par_iter().enumerate().for_each(|(k, ((xx, yy, zz), (xy, xz, yz)))| {
            let (mut gx, mut gy, mut gz) = (vec![0.0; nx], vec![0.0; nx], vec![0.0; nx]);
            dispatch(|| {
                for j in 0..ny {
                    gradient_rows(&smooth, part, j, k, [&mut gx, &mut gy, &mut gz]);
                    for i in 0..nx {
                        let (x, y, z) = (gx[i] * per_mm[0], gy[i] * per_mm[1], gz[i] * per_mm[2]);
                        let at = j * nx + i;
                        (xx[at], yy[at], zz[at]) = (x * x, y * y, z * z);
                        (xy[at], xz[at], yz[at]) = (x * y, x * z, y * z);
                    }
                }
            });
        });
        let m = products.map(|p| separable(&p, part, [&kernels[0], &kernels[1], &kernels[2]]));
        let skip = (start - lo) * plane;
        out[start * plane..end * plane].par_chunks_mut(plane).enumerate().for_each(|(k, out)| {
            let at = skip + k * plane;
            let [xx, yy, zz, xy, xz, yz] = std::array::from_fn(|q| &m[q][at..at + plane]);
            dispatch(|| {
                for (o, out) in out.iter_mut().enumerate() {
                    *out = foerstner([xx[o], yy[o], zz[o], xy[o], xz[o], yz[o]], flat);
                }
            });
        });
    }
    out
}

/// `det / trace(adj)` of `[xx, yy, zz, xy, xz, yz]`; with a flat axis (all its entries are zero) the 2 x 2 form.
#[inline(always)]
fn foerstner(m: [f32; 6], flat: bool) -> f32 {
    let [a, b, c, d, e, f] = m;
    let (bc, ac, ab) = (b * c - f * f, a * c - e * e, a * b - d * d);
    let minors = bc + ac + ab;
    let trace = a + b + c;
    let det = a * bc - d * (d * c - f * e) + e * (d * f - b * e);
    let value = if flat { minors / trace } else { det / minors };
    // A plane's second eigenvalue is rounding: nothing to divide by.
    if minors > 1e-5 * trace * trace { value.max(0.0) } else { 0.0 }
}
