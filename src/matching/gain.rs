//! Local gain and offset between two aligned volumes, so that a bias field or another contrast is
//! not taken for motion.
//!
//! In blocks of voxels the deformed volume's mean and spread are brought to the initial one's
//! (ratio of standard deviations, signed by the correlation: unlike a regression it is not biased
//! by noise or by what motion is left). A voxel counts the less the steeper the volume is there:
//! what is left of the motion shows in proportion to that (`weigh`). The sums of the blocks are
//! smoothed over their neighbours and interpolated linearly. For the passes, what smoothing
//! flattens of a bias is measured again on the corrected blocks and put back (twicing; Tukey 1977):
//! what was left of it looked like motion.

use crate::matching::pair::{Pair, row_step};
use crate::numerics::filters::gradient_rows;
use crate::numerics::pyramid;
use crate::numerics::simd::dispatch;
use crate::numerics::statistics::percentile;
use rayon::prelude::*;

/// Edge of a block (voxels).
const BLOCK_VOXELS: usize = 8;

/// Positions of the voxels between the centres of two blocks, as fractions of the distance.
const VOXEL_FRACTIONS: [f32; BLOCK_VOXELS] = {
    let mut out = [0.0; BLOCK_VOXELS];
    let mut i = 0;
    while i < BLOCK_VOXELS {
        out[i] = (i as f32 + 0.5) / BLOCK_VOXELS as f32;
        i += 1;
    }
    out
};

/// Times that the residual of the smoothed gain is smoothed and added back (twicing, Tukey 1977).
const TWICING_ITERATIONS: usize = 3;

/// How the gradient reduces the weight of a voxel, where residual motion changes the intensity.
struct VoxelWeights {
    /// Largest weight, stored in a byte.
    max: f32,
    /// Residual motion variance along an axis (voxels^2) over the part of the noise variance that
    /// smoothing leaves: 0.5^2 / 0.25. Errors change by 1 % at 0.1 and 3, by 3 % at 10.
    motion_variance_voxels: f32,
    /// Least noise variance over the mean square gradient: volumes without noise differ by
    /// interpolation.
    min_noise_fraction: f32,
    /// Approximate number of rows from which that mean is taken.
    sampled_rows: usize,
}

const WEIGHTS: VoxelWeights =
    VoxelWeights { max: 255.0, motion_variance_voxels: 1.0, min_noise_fraction: 0.03, sampled_rows: 1000 };

/// A voxel's weight in [`GainField`] in place of each that is set in `mask`, 1 to 255: the inverse
/// variance of the difference there, noise and the gradient times what is left of the motion.
/// `smooth` is the initial volume (smoothed), `noise` its noise.
pub(crate) fn weigh(mask: &mut [u8], smooth: &[f32], shape: [usize; 3], spacing: [f64; 3], noise: f32) {
    let [nx, ny, _] = shape;
    let finest = pyramid::finest(shape, spacing);
    let scale = spacing.map(|s| (finest / s) as f32);
    let squares = |row: usize, g: &mut [Vec<f32>; 4]| {
        let [gx, gy, gz, square] = g;
        dispatch(
            #[inline(always)]
            || {
                gradient_rows(smooth, shape, row % ny, row / ny, [gx, gy, gz]);
                for (((s, x), y), z) in square.iter_mut().zip(&*gx).zip(&*gy).zip(&*gz) {
                    let (x, y, z) = (scale[0] * x, scale[1] * y, scale[2] * z);
                    *s = x * x + y * y + z * z;
                }
            },
        );
    };
    let room = || std::array::from_fn(|_| vec![0.0f32; nx]);
    let rows = mask.len() / nx;
    let (mut sum, mut count, mut g) = (0.0f64, 0usize, room());
    for row in (0..rows).step_by(row_step(rows / WEIGHTS.sampled_rows, ny)) {
        squares(row, &mut g);
        for (square, _) in g[3].iter().zip(&mask[row * nx..]).filter(|(s, m)| **m != 0 && s.is_finite()) {
            (sum, count) = (sum + f64::from(*square), count + 1);
        }
    }
    let mean = (sum / count.max(1) as f64) as f32;
    let over =
        WEIGHTS.motion_variance_voxels / (noise * noise + WEIGHTS.min_noise_fraction * mean).max(f32::MIN_POSITIVE);
    mask.par_chunks_mut(nx).enumerate().for_each_init(room, |g, (row, mask)| {
        if mask.iter().all(|&m| m == 0) {
            return;
        }
        squares(row, g);
        for (m, square) in mask.iter_mut().zip(&g[3]).filter(|(m, _)| **m != 0) {
            *m = (WEIGHTS.max / (1.0 + over * square)).max(1.0) as u8;
        }
    });
}

/// Gain and offset at block centres.
#[derive(Debug, Clone)]
pub struct GainField {
    blocks: [usize; 3],
    /// Gain and offset of each block.
    values: Vec<[f32; 2]>,
}

/// Sums of a block: weight, f, w, ff, ww, fw, with f and w less the volumes' means so that no
/// precision is lost.
type Sums = [f64; 6];

impl GainField {
    /// From the initial volume (smoothed) and the warped one, inside the mask; smooth enough to
    /// judge by how well the two agree.
    pub fn measure(pair: &Pair<'_>, warped: &[f32]) -> Self {
        Self::of(pair, &block_sums(pair, warped), 0)
    }

    /// As [`GainField::measure`], with what its smoothing flattened put back: little of a bias is
    /// then taken for motion, but it takes up more of another contrast as well.
    pub fn sharpened(pair: &Pair<'_>, warped: &[f32]) -> Self {
        Self::of(pair, &block_sums(pair, warped), TWICING_ITERATIONS)
    }

    /// [`GainField::measure`] and [`GainField::sharpened`] from one look at the volumes.
    pub fn both(pair: &Pair<'_>, warped: &[f32]) -> [Self; 2] {
        let sums = block_sums(pair, warped);
        [0, TWICING_ITERATIONS].map(|again| Self::of(pair, &sums, again))
    }

    /// From the sums of the blocks, with the remainder put back `again` times.
    fn of(pair: &Pair<'_>, sums: &[Sums], again: usize) -> Self {
        let blocks = blocks(pair);
        let centre = pair.centres.map(f64::from);
        let total = sums.iter().fold([0.0; 6], add);
        let noise = f64::from(pair.noise);
        let global = gain(&total, noise, centre, [1.0, 0.0]);
        let mut values: Vec<[f64; 2]> = smooth(sums, blocks).iter().map(|s| gain(s, noise, centre, global)).collect();
        for _ in 0..again {
            let left: Vec<Sums> = sums.iter().zip(&values).map(|(s, v)| corrected(s, *v, centre)).collect();
            for (v, s) in values.iter_mut().zip(smooth(&left, blocks)) {
                let [g, o] = gain(&s, noise, [centre[0]; 2], [1.0, 0.0]);
                *v = [g * v[0], g * v[1] + o];
            }
        }
        Self { blocks, values: values.into_iter().map(|v| v.map(|v| v as f32)).collect() }
    }

    /// By what factor the gain varies across the tissue (its 90th percentile over its tenth, on
    /// every other voxel along each axis); infinite where it changes its sign, 1 without tissue.
    pub fn variation(&self, pair: &Pair<'_>) -> f32 {
        let [nx, ny, nz] = pair.shape;
        let (mut gain, mut offset) = (vec![0.0; nx], vec![0.0; nx]);
        let mut all = Vec::new();
        for (k, j) in (0..nz).step_by(2).flat_map(|k| (0..ny).step_by(2).map(move |j| (k, j))) {
            self.row(j, k, &mut gain, &mut offset);
            let mask = &pair.mask[nx * (j + ny * k)..][..nx];
            all.extend(gain.iter().zip(mask).step_by(2).filter(|(_, m)| **m != 0).map(|(g, _)| f64::from(*g)));
        }
        let [low, high] = [10.0, 90.0].map(|q| percentile(&mut all, q));
        match () {
            _ if all.is_empty() => 1.0,
            _ if low * high <= 0.0 => f32::INFINITY,
            _ => (high / low).max(low / high) as f32,
        }
    }

    /// Writes gain and offset along row `(j, k)`.
    #[inline(always)]
    pub fn row(&self, j: usize, k: usize, gain: &mut [f32], offset: &mut [f32]) {
        let [bx, by, bz] = self.blocks;
        let split = |i: usize, n: usize| {
            let p = ((i as f32 + 0.5) / BLOCK_VOXELS as f32 - 0.5).clamp(0.0, (n - 1) as f32);
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
        // Half a block before the first centre, whole blocks between centres, half a block after
        // the last.
        let (first, rest) = gain.split_at_mut((BLOCK_VOXELS / 2).min(gain.len()));
        let (first_offset, rest_offset) = offset.split_at_mut(first.len());
        let mut lo = at(0);
        first.fill(lo[0]);
        first_offset.fill(lo[1]);
        let between = rest.chunks_mut(BLOCK_VOXELS).zip(rest_offset.chunks_mut(BLOCK_VOXELS));
        for (b, (gain, offset)) in between.enumerate() {
            let hi = at((b + 1).min(bx - 1));
            let step = [hi[0] - lo[0], hi[1] - lo[1]];
            for ((g, o), t) in gain.iter_mut().zip(offset).zip(VOXEL_FRACTIONS) {
                (*g, *o) = (lo[0] + t * step[0], lo[1] + t * step[1]);
            }
            lo = hi;
        }
    }
}

/// Blocks along each axis.
fn blocks(pair: &Pair<'_>) -> [usize; 3] {
    pair.shape.map(|n| n.div_ceil(BLOCK_VOXELS))
}

/// The sums of all blocks.
fn block_sums(pair: &Pair<'_>, warped: &[f32]) -> Vec<Sums> {
    let [nx, ny, _] = pair.shape;
    let blocks = blocks(pair);
    let (bx, by) = (blocks[0], blocks[1]);
    let centre = pair.centres;
    let mut sums = vec![[0.0f64; 6]; blocks.iter().product()];
    sums.par_chunks_mut(bx).enumerate().for_each(|(row, sums)| {
        // One partial sum for each column of a block.
        let mut lanes = vec![[[0.0f32; BLOCK_VOXELS]; 6]; bx];
        let (from, to) = ([row % by, row / by].map(|b| b * BLOCK_VOXELS), [ny, pair.shape[2]]);
        for k in from[1]..(from[1] + BLOCK_VOXELS).min(to[1]) {
            for j in from[0]..(from[0] + BLOCK_VOXELS).min(to[0]) {
                let span = pair.spans.row(j, k);
                if span.is_empty() {
                    continue;
                }
                let at = nx * (j + ny * k);
                dispatch(
                    #[inline(always)]
                    || {
                        for b in span.start / BLOCK_VOXELS..span.end.div_ceil(BLOCK_VOXELS) {
                            let part = at + b * BLOCK_VOXELS..at + ((b + 1) * BLOCK_VOXELS).min(nx);
                            let (mut f, mut w, mut m) =
                                ([0.0f32; BLOCK_VOXELS], [f32::NAN; BLOCK_VOXELS], [0u8; BLOCK_VOXELS]);
                            f[..part.len()].copy_from_slice(&pair.fixed_smooth[part.clone()]);
                            w[..part.len()].copy_from_slice(&warped[part.clone()]);
                            m[..part.len()].copy_from_slice(&pair.mask[part]);
                            add_columns(&mut lanes[b], &f, &w, &m, centre);
                        }
                    },
                );
            }
        }
        for (s, lanes) in sums.iter_mut().zip(&lanes) {
            *s = lanes.map(|l| l.iter().map(|v| f64::from(*v)).sum());
        }
    });
    sums
}

/// Adds one row of a block: a voxel counts by its weight where the warp saw it.
#[inline(always)]
fn add_columns(
    lanes: &mut [[f32; BLOCK_VOXELS]; 6],
    f: &[f32; BLOCK_VOXELS],
    w: &[f32; BLOCK_VOXELS],
    m: &[u8; BLOCK_VOXELS],
    centre: [f32; 2],
) {
    for l in 0..BLOCK_VOXELS {
        let good = (f[l] + w[l]).is_finite();
        let (m, f, w) =
            if good { (f32::from(m[l]) / WEIGHTS.max, f[l] - centre[0], w[l] - centre[1]) } else { (0.0, 0.0, 0.0) };
        let (mf, mw) = (m * f, m * w);
        lanes[0][l] += m;
        lanes[1][l] += mf;
        lanes[2][l] += mw;
        lanes[3][l] += mf * f;
        lanes[4][l] += mw * w;
        lanes[5][l] += mf * w;
    }
}

/// A block's sums with `g w + o` in place of `w`, about the mean of f.
fn corrected([n, f, w, ff, ww, fw]: &Sums, [g, o]: [f64; 2], centre: [f64; 2]) -> Sums {
    let o = g * centre[1] + o - centre[0];
    [*n, *f, g * w + o * n, *ff, g * g * ww + 2.0 * g * o * w + o * o * n, g * fw + o * f]
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

/// Gain and offset from sums; where there is too little (few voxels, hardly more spread than noise)
/// the `fallback` gain with the local mean.
fn gain(s: &Sums, noise: f64, centre: [f64; 2], fallback: [f64; 2]) -> [f64; 2] {
    let n = s[0];
    if n < 16.0 {
        return fallback;
    }
    let (f, w) = (s[1] / n, s[2] / n);
    let (vf, vw, cov) = (s[3] / n - f * f, s[4] / n - w * w, s[5] / n - f * w);
    let floor = noise * noise;
    let strong = vf > 4.0 * floor && vw > 0.0 && n > 200.0;
    // A clear negative correlation means inverted contrast; anything else is taken as the same
    // contrast.
    let sign = if cov < -0.5 * (vf * vw).sqrt() { -1.0 } else { 1.0 };
    let g = if strong { sign * ((vf + floor) / (vw + floor)).sqrt().clamp(0.1, 10.0) } else { fallback[0] };
    [g, f + centre[0] - g * (w + centre[1])]
}
