//! The 3D corner measure (Harris & Stephens 1988; Foerstner & Guelch 1987; Rohr 1997 for volumes).

use crate::numerics::filters::{HalfKernel, gaussian, gaussian_kernel, gradient_rows, separable};
use crate::numerics::pyramid::{self, reduced_shape};
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

/// Slices processed together: bounds the memory of the six gradient products.
const MAX_SLICES_PER_SLAB: usize = 24;
/// Values of one gradient product in memory where slices are large.
const MAX_VALUES_PER_SLAB: usize = 5 << 20;

/// Foerstner's measure `det M / trace(adj M) = 1 / trace(M^-1)` at each voxel, (intensity/mm)^2.
///
/// `M = G * (grad I grad I^T)` with gradients per mm and windows of the same width in mm along each
/// axis, so anisotropic voxels weigh right. The measure is the inverse of the variance with which
/// the place can be matched (Foerstner & Guelch 1987), needs no constant `k`, and is low on edges
/// and planes. For one slice the in-plane 2 x 2 form is used.
///
/// ```
/// use palpate::features::{HarrisParams, response};
/// // A bright octant has one corner, at the middle of the volume.
/// let shape = [16, 16, 16];
/// let octant: Vec<f32> = (0..4096usize)
///     .map(|o| f32::from(u8::from([o % 16, o / 16 % 16, o / 256].iter().all(|&v| v >= 8))))
///     .collect();
/// let measure = response(&octant, shape, [1.0; 3], HarrisParams::default());
/// let (best, _) = measure.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1)).ok_or("empty")?;
/// assert!([best % 16, best / 16 % 16, best / 256].iter().all(|&v| (6..=10).contains(&v)));
/// // A constant volume has none.
/// assert!(
///     response(&[3.0; 4096], shape, [1.0; 3], HarrisParams::default()).iter().all(|&v| v == 0.0)
/// );
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn response(data: &[f32], shape: [usize; 3], spacing: [f64; 3], params: HarrisParams) -> Vec<f32> {
    let finest = pyramid::finest(shape, spacing);
    let smooth = gaussian(data, shape, spacing.map(|s| params.derivative_sigma * finest / s));
    block_response(&smooth, shape, spacing, params.integration_sigma, [1; 3])
}

/// As [`response`], of a volume that is smooth already, for blocks of `step` voxels: the products
/// of the gradients are averaged over each block and the window is applied there.
/// `integration_sigma` is in voxels of the finest axis.
///
/// The result has [`reduced_shape`] of `step`; block `b` is centred at `(b + 0.5) * step - 0.5`
/// voxels. Not finite voxels make their neighbours' response zero.
pub fn block_response(
    smooth: &[f32],
    shape: [usize; 3],
    spacing: [f64; 3],
    integration_sigma: f64,
    step: [usize; 3],
) -> Vec<f32> {
    let mut out = Vec::with_capacity(reduced_shape(shape, step).iter().product());
    slabs(smooth, shape, spacing, integration_sigma, step, |_, slab| out.extend_from_slice(slab));
    out
}

/// As [`block_response`], some slices at a time, from the first to the last: calls `each` with the
/// first of them and their values, and holds no others.
pub fn slabs(
    smooth: &[f32],
    shape: [usize; 3],
    spacing: [f64; 3],
    integration_sigma: f64,
    step: [usize; 3],
    mut each: impl FnMut(usize, &[f32]),
) {
    let [nx, ny, nz] = shape;
    let blocks = reduced_shape(shape, step);
    let plane = blocks[0] * blocks[1];
    let finest = pyramid::finest(shape, spacing);
    // A block is a window itself, of variance (step^2 - 1) / 12.
    let kernels: [HalfKernel; 3] = std::array::from_fn(|a| {
        let own = ((step[a] * step[a]) as f64 - 1.0) / 12.0;
        let wanted = (integration_sigma * finest / spacing[a]).powi(2);
        gaussian_kernel((wanted - own).max(0.0).sqrt() / step[a] as f64)
    });
    let halo = kernels[2].len();
    let flat = shape.contains(&1);
    let per_mm: [f32; 3] = std::array::from_fn(|a| (1.0 / spacing[a]) as f32);
    let slab = (MAX_VALUES_PER_SLAB / plane).clamp(1, MAX_SLICES_PER_SLAB);
    let mut out = vec![0.0f32; plane * slab.min(blocks[2])];
    for start in (0..blocks[2]).step_by(slab) {
        let end = (start + slab).min(blocks[2]);
        let (lo, hi) = (start.saturating_sub(halo), (end + halo).min(blocks[2]));
        let mut products: [Vec<f32>; 6] = std::array::from_fn(|_| vec![0.0; plane * (hi - lo)]);
        let [xx, yy, zz, xy, xz, yz] = products.each_mut().map(|p| p.par_chunks_mut(plane));
        ((xx, yy, zz), (xy, xz, yz)).into_par_iter().enumerate().for_each(|(k, ((xx, yy, zz), (xy, xz, yz)))| {
            let mut out = [xx, yy, zz, xy, xz, yz];
            let mut g: [Vec<f32>; 3] = std::array::from_fn(|_| vec![0.0; nx]);
            let mut sums: [Vec<f32>; 6] = std::array::from_fn(|_| vec![0.0; nx]);
            let slices = (lo + k) * step[2]..((lo + k + 1) * step[2]).min(nz);
            for b in 0..blocks[1] {
                let rows = b * step[1]..((b + 1) * step[1]).min(ny);
                dispatch(
                    #[inline(always)]
                    || {
                        sums.iter_mut().for_each(|s| s.fill(0.0));
                        for (k, j) in slices.clone().flat_map(|k| rows.clone().map(move |j| (k, j))) {
                            let [gx, gy, gz] = &mut g;
                            gradient_rows(smooth, shape, j, k, [gx, gy, gz]);
                            let [xx, yy, zz, xy, xz, yz] = sums.each_mut().map(|s| &mut s[..nx]);
                            let (gx, gy, gz) = (&gx[..nx], &gy[..nx], &gz[..nx]);
                            for i in 0..nx {
                                let (x, y, z) = (gx[i] * per_mm[0], gy[i] * per_mm[1], gz[i] * per_mm[2]);
                                let good = (x + y + z).is_finite();
                                let (x, y, z) = if good { (x, y, z) } else { (0.0, 0.0, 0.0) };
                                xx[i] += x * x;
                                yy[i] += y * y;
                                zz[i] += z * z;
                                xy[i] += x * y;
                                xz[i] += x * z;
                                yz[i] += y * z;
                            }
                        }
                    },
                );
                let lines = (slices.len() * rows.len()) as f32;
                for (out, sums) in out.iter_mut().zip(&sums) {
                    let out = &mut out[b * blocks[0]..(b + 1) * blocks[0]];
                    for (o, s) in out.iter_mut().zip(sums.chunks(step[0])) {
                        *o = s.iter().sum::<f32>() / (lines * s.len() as f32);
                    }
                }
            }
        });
        let part = [blocks[0], blocks[1], hi - lo];
        let m = products.map(|p| separable(&p, part, [&kernels[0], &kernels[1], &kernels[2]]));
        let skip = (start - lo) * plane;
        let out = &mut out[..plane * (end - start)];
        out.par_chunks_mut(plane).enumerate().for_each(|(k, out)| {
            let at = skip + k * plane;
            let [xx, yy, zz, xy, xz, yz] = std::array::from_fn(|q| &m[q][at..at + plane]);
            dispatch(
                #[inline(always)]
                || {
                    for (o, out) in out.iter_mut().enumerate() {
                        *out = foerstner([xx[o], yy[o], zz[o], xy[o], xz[o], yz[o]], flat);
                    }
                },
            );
        });
        each(start, out);
    }
}

/// `det / trace(adj)` of `[xx, yy, zz, xy, xz, yz]`; with a flat axis (all its entries are zero)
/// the 2 x 2 form.
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
