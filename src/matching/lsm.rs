//! Least-squares matching: a candidate brought to sub-voxel precision, with its covariance.
//!
//! Gauss-Newton on the patch with gain and offset (Ackermann 1984; Gruen 1985; Zhang, Hirai & Endo for MR volumes).
//! The patch's own gradients serve in every step (the compositional form of Baker & Matthews 2004), so the 3 x 3 matrix
//! is built once; what gain and offset explain as well is taken from it, so a mere ramp has no information. The patch is not warped here: the deformed volume is handed in already warped by the field known so
//! far, so only the rest of the motion is sought.

use crate::numerics::small::{Symmetric3, inverse, multiply};

/// Noise of neighbouring voxels after the cubic B-spline is alike; a patch holds that many times fewer independent
/// voxels: 1 / sum(k^2) of the kernel, 2 along each axis.
pub const CORRELATION: f64 = 2.0;

/// A match found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Refined {
    /// What has to be added to the start (mm along the lattice's axes).
    pub shift: [f64; 3],
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
    /// Standard deviation of the noise in either volume after smoothing (intensity): bounds the covariance from below.
    pub noise: f64,
}

/// Refines the match of the patch around voxel `centre`. `sample(offset)` gives the deformed volume at
/// `centre + offset` (voxels) shifted by the start; it must be smoothed alike and NaN outside.
///
/// None where the patch leaves a volume, has no texture in some direction, or the step leaves `limit` voxels.
pub fn refine(
    template: &Template<'_>,
    centre: [usize; 3],
    sample: impl Fn([f32; 3]) -> f32,
    steps: usize,
    limit: f64,
) -> Option<Refined> {
    let Template { data, shape, spacing, radius, noise } = *template;
    let margin = |a: usize| if shape[a] == 1 { 0 } else { radius[a] + 1 };
    if (0..3).any(|a| centre[a] < margin(a) || centre[a] + margin(a) >= shape[a]) {
        return None;
    }
    let radius: [usize; 3] = std::array::from_fn(|a| if shape[a] == 1 { 0 } else { radius[a] });
    let stride = [1, shape[0], shape[0] * shape[1]];
    let count = radius.iter().map(|r| 2 * r + 1).product::<usize>();
    let (mut f, mut g) = (Vec::with_capacity(count), Vec::with_capacity(count));
    let mut offsets = Vec::with_capacity(count);
    let span = |a: usize| -(radius[a] as i32)..=radius[a] as i32;
    for dz in span(2) {
        for dy in span(1) {
            for dx in span(0) {
                let o = [dx, dy, dz];
                let at = (0..3).fold(0usize, |s, a| s + stride[a] * (centre[a] as i32 + o[a]) as usize);
                let d: [f64; 3] = std::array::from_fn(|a| {
                    if shape[a] == 1 {
                        0.0
                    } else {
                        f64::from(data[at + stride[a]] - data[at - stride[a]]) / (2.0 * spacing[a])
                    }
                });
                f.push(data[at]);
                g.push(d);
                offsets.push(o.map(|v| v as f32));
            }
        }
    }
    let (mf, sf) = moments(&f);
    let mut h = without_gain_and_offset(&f, &mut g, mf, sf);
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
        let voxels: [f32; 3] = std::array::from_fn(|a| (shift[a] / spacing[a]) as f32);
        for (w, o) in w.iter_mut().zip(&offsets) {
            *w = sample(std::array::from_fn(|a| o[a] + voxels[a]));
        }
        let (mw, sw) = moments(&w);
        if !(sw > 0.0 && sf > 0.0 && sw.is_finite()) {
            return None;
        }
        let gain = sf / sw;
        let (mut b, mut rr, mut fw) = ([0.0f64; 3], 0.0, 0.0);
        for ((f, w), g) in f.iter().zip(&w).zip(&g) {
            let (f, w) = (f64::from(*f) - mf, f64::from(*w) - mw);
            let r = f - gain * w;
            rr += r * r;
            fw += f * w;
            for a in 0..3 {
                b[a] += g[a] * r;
            }
        }
        spread = rr / count as f64;
        ncc = (fw / (count as f64 * sf * sw)) as f32;
        if step == steps {
            break;
        }
        let d = multiply(&hi, b);
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
    let variance = spread.max(2.0 * noise * noise) * CORRELATION.powi(3 - flat.len() as i32);
    let mut covariance = hi.map(|v| v * variance);
    for &a in &flat {
        covariance[a] = 0.0;
        shift[a] = 0.0;
    }
    (ncc.is_finite() && covariance.iter().all(|v| v.is_finite())).then_some(Refined { shift, covariance, ncc })
}

/// Takes from the gradients what a change of offset (their mean) or of gain (their part along the patch) explains as
/// well, and returns the matrix of their products: the information with both unknown (Schur complement).
fn without_gain_and_offset(f: &[f32], g: &mut [[f64; 3]], mean: f64, deviation: f64) -> Symmetric3 {
    let n = f.len() as f64;
    let (mut gm, mut fg) = ([0.0; 3], [0.0; 3]);
    for (f, g) in f.iter().zip(&*g) {
        for a in 0..3 {
            gm[a] += g[a] / n;
            fg[a] += g[a] * (f64::from(*f) - mean) / (n * deviation * deviation);
        }
    }
    let mut h = [0.0; 6];
    for (f, g) in f.iter().zip(g) {
        let [x, y, z] = std::array::from_fn(|a| g[a] - gm[a] - fg[a] * (f64::from(*f) - mean));
        *g = [x, y, z];
        for (h, v) in h.iter_mut().zip([x * x, y * y, z * z, x * y, x * z, y * z]) {
            *h += v;
        }
    }
    h
}

/// Mean and standard deviation.
fn moments(v: &[f32]) -> (f64, f64) {
    let n = v.len() as f64;
    let mean = v.iter().map(|x| f64::from(*x)).sum::<f64>() / n;
    let variance = v.iter().map(|x| (f64::from(*x) - mean).powi(2)).sum::<f64>() / n;
    (mean, variance.sqrt())
}
