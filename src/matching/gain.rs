//! Local gain and offset between two aligned volumes, so that a bias field or another contrast is not taken for motion.
//!
//! In blocks of voxels the deformed volume's mean and spread are brought to the initial one's (ratio of standard
//! deviations, signed by the correlation: unlike a regression it is not biased by noise or by what motion is left);
//! block sums are smoothed over their neighbours and interpolated linearly.

use crate::matching::pair::Pair;
use rayon::prelude::*;

/// Edge of a block (voxels).
const BLOCK: usize = 8;

/// Gain and offset at block centres.
#[derive(Debug, Clone)]
pub struct GainField {
    blocks: [usize; 3],
    /// Gain and offset of each block.
    values: Vec<[f32; 2]>,
}

/// Sums of a block: count, f, w, ff, ww, fw.
type Sums = [f64; 6];

impl GainField {
    /// From the initial volume (smoothed) and the warped one, inside the mask. `noise` is the initial volume's noise.
    pub fn measure(pair: &Pair, warped: &[f32], noise: f32) -> Self {
        let [nx, ny, _] = pair.shape;
        let blocks = pair.shape.map(|n| n.div_ceil(BLOCK));
        let (bx, by) = (blocks[0], blocks[1]);
        let mut sums = vec![[0.0f64; 6]; blocks.iter().product()];
        sums.par_chunks_mut(bx * by).enumerate().for_each(|(bz, sums)| {
            for k in bz * BLOCK..((bz + 1) * BLOCK).min(pair.shape[2]) {
                for j in 0..ny {
                    let from = nx * (j + ny * k);
                    for b in 0..bx {
                        let mut s = [0.0f32; 6];
                        for i in from + b * BLOCK..from + ((b + 1) * BLOCK).min(nx) {
                            let (f, w) = (pair.fixed_smooth[i], warped[i]);
                            if pair.mask[i] != 0 && w.is_finite() {
                                for (s, v) in s.iter_mut().zip([1.0, f, w, f * f, w * w, f * w]) {
                                    *s += v;
                                }
                            }
                        }
                        for (t, v) in sums[b + bx * (j / BLOCK)].iter_mut().zip(s) {
                            *t += f64::from(v);
                        }
                    }
                }
            }
        });
        let total = sums.iter().fold([0.0; 6], add);
        let global = gain(&total, f64::from(noise), [1.0, 0.0]);
        let smooth = smooth(&sums, blocks);
        let values = smooth.iter().map(|s| gain(s, f64::from(noise), global).map(|v| v as f32)).collect();
        Self { blocks, values }
    }

    /// Writes gain and offset along row `(j, k)`.
    #[inline(always)]
    pub fn row(&self, j: usize, k: usize, gain: &mut [f32], offset: &mut [f32]) {
        let [bx, by, bz] = self.blocks;
        let split = |i: usize, n: usize| {
            let p = ((i as f32 + 0.5) / BLOCK as f32 - 0.5).clamp(0.0, (n - 1) as f32);
            let lo = (p as usize).min(n.saturating_sub(2));
            (lo, (lo + 1).min(n - 1), p - lo as f32)
        };
        let ((j0, j1, tj), (k0, k1, tk)) = (split(j, by), split(k, bz));
        let corners = [
            (j0, k0, (1.0 - tj) * (1.0 - tk)),
            (j1, k0, tj * (1.0 - tk)),
            (j0, k1, (1.0 - tj) * tk),
            (j1, k1, tj * tk),
        ];
        let at = |b: usize| {
            let mut v = [0.0f32; 2];
            for (jj, kk, w) in corners {
                let c = self.values[b + bx * (jj + by * kk)];
                v[0] += w * c[0];
                v[1] += w * c[1];
            }
            v
        };
        // Half a block before the first centre, whole blocks between centres, half a block after the last.
        let half = BLOCK / 2;
        let n = gain.len();
        let (mut lo, mut from) = (at(0), 0);
        for b in 0..=bx {
            let hi = at(b.min(bx - 1));
            let to = (half + b * BLOCK).min(n);
            for i in from..to {
                let t = if b == 0 { 0.0 } else { (i as f32 + 0.5 - (b as f32 - 0.5) * BLOCK as f32) / BLOCK as f32 };
                gain[i] = lo[0] + t * (hi[0] - lo[0]);
                offset[i] = lo[1] + t * (hi[1] - lo[1]);
            }
            (lo, from) = (hi, to);
        }
    }
}

fn add(mut a: Sums, b: &Sums) -> Sums {
    for (a, b) in a.iter_mut().zip(b) {
        *a += b;
    }
    a
}

/// Block sums over each block and its 26 neighbours with weights (1, 2, 1) along each axis.
fn smooth(sums: &[Sums], blocks: [usize; 3]) -> Vec<Sums> {
    let mut out = sums.to_vec();
    for (a, stride) in [1, blocks[0], blocks[0] * blocks[1]].into_iter().enumerate() {
        let source = out.clone();
        for (i, o) in out.iter_mut().enumerate() {
            let at = i / stride % blocks[a];
            let mut s = source[i].map(|v| 2.0 * v);
            if at > 0 {
                s = add(s, &source[i - stride]);
            }
            if at + 1 < blocks[a] {
                s = add(s, &source[i + stride]);
            }
            *o = s;
        }
    }
    out
}

/// Gain and offset from sums; where there is too little (few voxels, hardly more spread than noise) the `fallback`
/// gain with the local mean.
fn gain(s: &Sums, noise: f64, fallback: [f64; 2]) -> [f64; 2] {
    let n = s[0];
    if n < 16.0 {
        return fallback;
    }
    let (f, w) = (s[1] / n, s[2] / n);
    let (vf, vw, cov) = (s[3] / n - f * f, s[4] / n - w * w, s[5] / n - f * w);
    let floor = noise * noise;
    let strong = vf > 4.0 * floor && vw > 0.0 && n > 200.0;
    // A clear negative correlation means inverted contrast; anything else is taken as the same contrast.
    let sign = if cov < -0.5 * (vf * vw).sqrt() { -1.0 } else { 1.0 };
    let g = if strong { sign * ((vf + floor) / (vw + floor)).sqrt().clamp(0.1, 10.0) } else { fallback[0] };
    [g, f - g * w]
}
