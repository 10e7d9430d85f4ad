//! Least-squares matching: a candidate brought to sub-voxel precision, with its covariance.
//!
//! Gauss-Newton on the patch with gain and offset (Ackermann 1984; Gruen 1985; Zhang, Hirai & Endo
//! for MR volumes). The patch's own gradients serve in every step (the compositional form of Baker
//! & Matthews 2004), so the 3 x 3 matrix is built once; what gain and offset explain as well is
//! taken from it, so a mere ramp has no information. The patch is not warped here: the deformed
//! volume is handed in already warped by the field known so far, so only the rest of the motion is
//! sought.

use crate::numerics::simd::{self, dispatch};
use crate::numerics::symmetric3::{Symmetric3, inverse, multiply};
use crate::types::GridVector;

/// Voxels per independent sample along an axis: the cubic B-spline correlates the noise of
/// neighbours. 1 / sum(k^2) of its kernel.
pub(crate) const NOISE_CORRELATION_VOXELS: f64 = 2.0;

/// A match found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Refined {
    /// What has to be added to the start, along the lattice's axes.
    pub shift: GridVector,
    /// Covariance of the displacement (mm^2).
    pub covariance: Symmetric3,
    /// Correlation of the patches at the end.
    pub ncc: f32,
}

/// The initial volume's side of a match.
#[derive(Clone, Copy)]
pub struct Template<'a> {
    /// Initial volume, smoothed by the cubic B-spline, x fastest.
    pub data: &'a [f32],
    /// Its voxels.
    pub shape: [usize; 3],
    /// Voxel edges (mm).
    pub spacing: [f64; 3],
    /// Patch radius (voxels).
    pub radius: [usize; 3],
    /// Standard deviation of the noise in either volume after smoothing (intensity): bounds the
    /// covariance from below.
    pub noise: f64,
}

impl Template<'_> {
    /// Patch radius, none along a side of one voxel.
    fn reach(&self) -> [usize; 3] {
        std::array::from_fn(|a| if self.shape[a] == 1 { 0 } else { self.radius[a] })
    }
}

/// What [`refine`] needs of the deformed volume, from its value at single places: `sample(offset)`
/// with the offset from the patch's centre (voxels).
pub fn pointwise(radius: [usize; 3], sample: impl Fn([f32; 3]) -> f32) -> impl Fn([f32; 3], &mut [f32]) {
    let width = radius.map(|r| 2 * r + 1);
    move |shift, out| {
        for (n, o) in out.iter_mut().enumerate() {
            let at = [n % width[0], n / width[0] % width[1], n / (width[0] * width[1])];
            *o = sample(std::array::from_fn(|a| at[a] as f32 - radius[a] as f32 + shift[a]));
        }
    }
}

/// Refines the match of the patch around voxel `centre`. `patch(shift, out)` gives the deformed
/// volume over the patch (x fastest), `shift` voxels beside the start; it must be smoothed alike
/// and NaN outside.
///
/// None where the patch leaves a volume, has no texture in some direction, or the step leaves
/// `limit` voxels.
pub fn refine(
    template: &Template<'_>,
    centre: [usize; 3],
    patch: impl Fn([f32; 3], &mut [f32]),
    steps: usize,
    limit: f64,
) -> Option<Refined> {
    let Template { shape, spacing, noise, .. } = *template;
    let margin = |a: usize| if shape[a] == 1 { 0 } else { template.radius[a] + 1 };
    if (0..3).any(|a| centre[a] < margin(a) || centre[a] + margin(a) >= shape[a]) {
        return None;
    }
    let (f, g, sf) = prepare(template, centre);
    let count = f.len();
    let mut h: Symmetric3 = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)].map(|(a, b)| dot(&g[a], &g[b]));
    let flat: Vec<usize> = (0..3).filter(|&a| shape[a] == 1).collect();
    for &a in &flat {
        h[a] = h[0] + h[1] + h[2];
    }
    let hi = inverse(&h)?;
    let mut shift = [0.0f64; 3];
    let mut w = vec![0.0f32; count];
    let mut spread = 0.0;
    let mut ncc = 0.0;
    for step in 0..=steps {
        patch(std::array::from_fn(|a| (shift[a] / spacing[a]) as f32), &mut w);
        let sw = centred(&mut w);
        if !(sw > 0.0 && sf > 0.0 && sw.is_finite()) {
            return None;
        }
        ncc = (dot(&f, &w) / (count as f64 * sf * sw)) as f32;
        let gain = (sf / sw) as f32;
        // From here on the residual.
        w.iter_mut().zip(&f).for_each(|(w, f)| *w = f - gain * *w);
        spread = dot(&w, &w) / count as f64;
        if step == steps {
            break;
        }
        let d = multiply(&hi, [0, 1, 2].map(|a| dot(&g[a], &w)));
        for a in 0..3 {
            shift[a] += d[a];
            if shape[a] > 1 && shift[a].abs() > limit * spacing[a] {
                return None;
            }
        }
        if (0..3).all(|a| d[a].abs() < 0.005 * spacing[a]) {
            break;
        }
    }
    let variance = spread.max(2.0 * noise * noise) * NOISE_CORRELATION_VOXELS.powi(3 - flat.len() as i32);
    let mut covariance = hi.map(|v| v * variance);
    for &a in &flat {
        covariance[a] = 0.0;
        shift[a] = 0.0;
    }
    (ncc.is_finite() && covariance.iter().all(|v| v.is_finite())).then_some(Refined {
        shift: GridVector(shift),
        covariance,
        ncc,
    })
}

/// The patch less its mean, its gradients (per mm) less what a change of offset (their mean) or of
/// gain (their part along the patch) explains as well, so that their products are the information
/// with both unknown (Schur complement), and the patch's standard deviation.
fn prepare(template: &Template<'_>, centre: [usize; 3]) -> (Vec<f32>, [Vec<f32>; 3], f64) {
    let Template { data, shape, spacing, .. } = *template;
    let radius = template.reach();
    let width = radius.map(|r| 2 * r + 1);
    let stride = [1, shape[0], shape[0] * shape[1]];
    let count = width.iter().product();
    let mut f = vec![0.0f32; count];
    let mut g: [Vec<f32>; 3] = std::array::from_fn(|_| vec![0.0f32; count]);
    let first = (0..3).map(|a| stride[a] * (centre[a] - radius[a])).sum::<usize>();
    for row in 0..width[1] * width[2] {
        let from = first + stride[1] * (row % width[1]) + stride[2] * (row / width[1]);
        let to = row * width[0]..(row + 1) * width[0];
        f[to.clone()].copy_from_slice(&data[from..from + width[0]]);
        for a in (0..3).filter(|&a| shape[a] > 1) {
            let scale = (0.5 / spacing[a]) as f32;
            let (lo, hi) = (&data[from - stride[a]..][..width[0]], &data[from + stride[a]..][..width[0]]);
            for ((g, l), h) in g[a][to.clone()].iter_mut().zip(lo).zip(hi) {
                *g = scale * (h - l);
            }
        }
    }
    let sf = centred(&mut f);
    for g in &mut g {
        centred(g);
        let along = (dot(g, &f) / (count as f64 * sf * sf)) as f32;
        if along.is_finite() {
            g.iter_mut().zip(&f).for_each(|(g, f)| *g -= along * f);
        }
    }
    (f, g, sf)
}

/// Takes off the mean and gives the standard deviation back.
fn centred(v: &mut [f32]) -> f64 {
    // About the first value, so that a large offset does not cost precision.
    let (first, n) = (v[0], v.len() as f64);
    let mean = dispatch(
        #[inline(always)]
        || {
            v.iter_mut().for_each(|x| *x -= first);
            (f64::from(simd::sum(v)) / n) as f32
        },
    );
    dispatch(
        #[inline(always)]
        || v.iter_mut().for_each(|x| *x -= mean),
    );
    (dot(v, v) / n).sqrt()
}

fn dot(a: &[f32], b: &[f32]) -> f64 {
    f64::from(dispatch(
        #[inline(always)]
        || simd::dot(a, b),
    ))
}
