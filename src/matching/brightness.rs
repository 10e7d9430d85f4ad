//! Brightness that differs between the two volumes by place (a coil's profile, a bias field) or by
//! itself (another contrast), taken out of the deformed one.
//!
//! With f and w the mean brightness of a block of voxels in both volumes, under the field found so
//! far,
//!
//! ```text
//! ln f - ln w = P + Q((ln f + ln w + P) / 2)
//! ```
//!
//! P is a polynomial of the block's place in the deformed volume, Q one of its brightness (of both
//! volumes alike: of one alone what the field still misses would flatten the contrast), with Cauchy
//! weights (Holland and Welsch 1977): blocks that are off because the field is off there hardly
//! count. Either alone serves where both explain little more. What varies less smoothly is left to
//! [`crate::matching::gain`].

use crate::matching::levels::from_level;
use crate::matching::pair::Pair;
use crate::numerics::cholesky::Cholesky;
use crate::numerics::dense::dot;
use crate::numerics::exponential::{ROUND_TO_INTEGER, exp, ln};
use crate::numerics::neighbours::Neighbours;
use crate::numerics::simd::dispatch;
use crate::numerics::statistics::{noise_sigma, percentile, robust_deviation, stands_for_all};
use crate::types::{GridVector, VoxelPoint};
use rayon::prelude::*;

/// Which blocks of voxels the polynomials are fitted to.
struct BlockSelection {
    /// Edge of a block (voxels of the finest axis).
    edge_voxels: usize,
    /// Least number of blocks for each term of a polynomial.
    min_per_term: usize,
    /// Least brightness of a block over the noise: below it, the logarithm is unreliable.
    min_snr: f64,
    /// Least brightness of a deformed block over a single voxel's noise: excludes air and holes.
    /// Averaging does not lower the Rician floor of 1.25 deviations.
    min_voxel_snr: f64,
    /// Largest number of blocks: about 25 for each term.
    max_count: usize,
}

const BLOCKS: BlockSelection =
    BlockSelection { edge_voxels: 4, min_per_term: 8, min_snr: 5.0, min_voxel_snr: 3.0, max_count: 1000 };

/// Highest degree of P; it is lower where there are few blocks.
const PLACE_DEGREE: usize = 4;

/// Largest part of the values or blocks at or below zero in a volume whose brightness begins at 0.
const MAX_NONPOSITIVE_FRACTION: f64 = 0.02;

/// How the intensity at which brightness begins is estimated where it is not 0.
struct ZeroLevel {
    /// Percentile of a volume that stands for its darkest value; 100 minus it for the brightest.
    percentile: f64,
    /// Darkest over brightest value beyond which brightness may begin at the darkest value,
    /// although none is negative.
    min_darkest_ratio: f64,
    /// Approximate number of voxels from which the percentiles are taken.
    sampled_voxels: usize,
}

const ZERO_LEVEL: ZeroLevel = ZeroLevel { percentile: 0.5, min_darkest_ratio: 0.2, sampled_voxels: 100_000 };

/// Iteratively reweighted least squares for both polynomials.
struct RobustFit {
    /// Iterations, which also alternate P and Q: the two converge slowly.
    iterations: usize,
    /// Residual at which the Cauchy weight is a half (robust standard deviations).
    cauchy_tuning: f64,
}

const ROBUST_FIT: RobustFit = RobustFit { iterations: 12, cauchy_tuning: 2.0 };

/// Logarithms of brightness that differ by less than this are equal.
const LOG_TOLERANCE: f64 = 1e-6;

/// The polynomial Q of the logarithm of brightness; its argument is -1 to 1 over the tissue.
struct ToneCurve {
    /// Degree of Q.
    degree: usize,
    /// Argument beyond which Q is constant.
    max_argument: f64,
    /// Argument at which blocks are clamped in the fit.
    max_fitted_argument: f64,
    /// Steps of the table of Q.
    table_steps: usize,
    /// Fixed-point iterations that evaluate Q at the mean of both volumes' logarithms.
    fixed_point_iterations: usize,
    /// Steepest slope: a cube root has 1, a fourth root 1.2; at 2 the brightness of one volume no
    /// longer grows with that of the other.
    max_slope: f64,
}

const TONE_CURVE: ToneCurve = ToneCurve {
    degree: 3,
    max_argument: 2.5,
    max_fitted_argument: 1.2,
    table_steps: 256,
    fixed_point_iterations: 40,
    max_slope: 1.5,
};

/// How far beyond its measured values P is extrapolated (logarithm).
const PLACE_MARGIN_LOG: f64 = 0.1;

/// How the difference in brightness is compared between neighbours.
struct NeighbourComparison {
    /// Blocks whose median stands for the difference at a block.
    median_blocks: usize,
    /// Neighbouring blocks with which that median is compared.
    compared: usize,
}

const NEIGHBOURS: NeighbourComparison = NeighbourComparison { median_blocks: 12, compared: 6 };

/// The deformed volume's way to the initial one's brightness.
#[derive(Debug, Clone, PartialEq)]
pub struct Brightness {
    zero: Zero,
    /// The initial volume's voxels, which are mapped to -1 to 1.
    shape: [usize; 3],
    /// P: powers along each axis, and the term's coefficient.
    place: Vec<([usize; 3], f64)>,
    /// Q for logarithms of the deformed volume's brightness (P in it) evenly over `tones`; none
    /// where place alone explains it.
    tone: Vec<f64>,
    tones: [f64; 2],
    /// Lowest and highest P where it was measured.
    range: [f64; 2],
    /// The blocks' robust standard deviation of the logarithm as it is, and of what is left.
    pub deviation: [f64; 2],
    /// What is left of how the logarithm varies between neighbours, as a part of it: by how much
    /// they differ (median), each the middle of the blocks about it. The local gain takes what is
    /// the same nearby; a polynomial across a step trades that for a slope.
    pub uneven: f64,
    /// By what factor P varies over the tissue, from the tenth to the 90th percentile.
    pub variation: f64,
}

/// Where brightness begins in the initial and in the deformed volume, and whether it grows with the
/// values (1) or against them (-1).
#[derive(Debug, Clone, Copy, PartialEq)]
struct Zero {
    at: [f64; 2],
    sign: f64,
}

impl Zero {
    /// What may be it: 0 where hardly a value lies below, else the volumes' darkest or brightest
    /// values.
    fn of(pair: &Pair<'_>) -> Vec<Self> {
        let sample = |v: &[f32]| -> Vec<f64> {
            v.iter()
                .step_by((v.len() / ZERO_LEVEL.sampled_voxels).max(1))
                .filter(|v| v.is_finite())
                .map(|v| f64::from(*v))
                .collect()
        };
        let mut samples = [sample(&pair.fixed), sample(&pair.moving)];
        let positive =
            |s: &Vec<f64>| s.iter().filter(|v| **v < 0.0).count() as f64 <= MAX_NONPOSITIVE_FRACTION * s.len() as f64;
        let all = samples.iter().all(positive);
        let [darkest, brightest] = [ZERO_LEVEL.percentile, 100.0 - ZERO_LEVEL.percentile]
            .map(|q| samples.each_mut().map(|s| percentile(s, q)));
        let zero = Self { at: [0.0; 2], sign: 1.0 };
        let from_darkest = Self { at: darkest, sign: 1.0 };
        match all {
            true if darkest.iter().zip(brightest).all(|(low, high)| *low > ZERO_LEVEL.min_darkest_ratio * high) => {
                vec![zero, from_darkest]
            }
            true => vec![zero],
            false => vec![from_darkest, Self { at: brightest, sign: -1.0 }],
        }
    }
}

/// A block of voxels under a field.
struct Block {
    /// Place in the deformed volume, on the full initial lattice.
    at: VoxelPoint,
    /// Logarithm of the brightness in both volumes.
    log: [f64; 2],
    weight: f64,
}

impl Block {
    /// By how much the initial volume is brighter (logarithm).
    fn difference(&self) -> f64 {
        self.log[0] - self.log[1]
    }
}

impl Brightness {
    /// From a level of `factor`, the deformed volume `warped` by a field and its displacement at
    /// a place; `shape` is the full initial volume's. P and Q are taken together where they leave
    /// less than `both` of what the better one leaves alone. None where there are too few blocks
    /// for it.
    pub fn measure(
        pair: &Pair<'_>,
        (factor, shape): ([usize; 3], [usize; 3]),
        warped: &[f32],
        displacement: impl Fn(VoxelPoint) -> GridVector + Sync,
        both: f64,
    ) -> Option<Self> {
        let seen = seen_blocks(pair, warped, displacement);
        let noise = noise_sigma(&pair.moving, pair.moving_shape, |_| true);
        let above = (factor.iter().product::<usize>() as f64).sqrt() * BLOCKS.min_voxel_snr;
        let least = [f64::from(pair.noise) * BLOCKS.min_snr, f64::from(noise) * above.max(BLOCKS.min_snr)];
        let found = Zero::of(pair).into_iter().filter_map(|zero| {
            let blocks = blocks(&seen, (zero, least), factor)?;
            Self::of(&blocks, shape, (zero, both))
        });
        let left = |b: &Self| b.deviation[1] / b.deviation[0].max(LOG_TOLERANCE);
        found.min_by(|a, b| left(a).total_cmp(&left(b)))
    }

    /// From blocks of brightness from `zero` on.
    fn of(blocks: &[Block], shape: [usize; 3], (zero, both): (Zero, f64)) -> Option<Self> {
        let room = blocks.len() / BLOCKS.min_per_term;
        let powers =
            (0..=PLACE_DEGREE).rev().map(|d| powers(shape, d)).find(|p| room >= p.len() + TONE_CURVE.degree)?;
        let mut differences: Vec<f64> = blocks.iter().map(Block::difference).collect();
        let usual = percentile(&mut differences, 50.0);
        let before = robust_deviation(differences.into_iter());
        let mut logs: Vec<f64> = blocks.iter().map(|b| 0.5 * (b.log[0] + b.log[1] + usual)).collect();
        let [low, high] = [2.0, 98.0].map(|q| percentile(&mut logs, q));
        let scale = [0.5 * (low + high), (0.5 * (high - low)).max(LOG_TOLERANCE)];
        let fitted = |place: bool, tone: bool| {
            let powers = if place { powers.clone() } else { vec![[0; 3]] };
            let n = powers.len();
            let by_place = |b: &Block| powers.iter().map(|p| monomial(scaled(shape, b.at), *p)).collect();
            let (terms, left) = robust(blocks, by_place, usual, tone.then_some(scale))?;
            if steepest(&terms[n..]) > TONE_CURVE.max_slope * scale[1] {
                return None;
            }
            let mut values: Vec<f64> = blocks.iter().map(|b| dot(&by_place(b), &terms[..n])).collect();
            let range = values.iter().fold([f64::INFINITY, f64::NEG_INFINITY], |r, v| [r[0].min(*v), r[1].max(*v)]);
            let [low, high] = [10.0, 90.0].map(|q| percentile(&mut values, q));
            let [tone_low, tone_high] = [-TONE_CURVE.max_argument, TONE_CURVE.max_argument]
                .map(|t| scale[0] + t * scale[1] - of_tone(&terms[n..], t) / 2.0);
            let step = (tone_high - tone_low) / TONE_CURVE.table_steps as f64;
            let tone = (0..=TONE_CURVE.table_steps).map(|i| tone_from(&terms[n..], scale, tone_low + i as f64 * step));
            Some(Self {
                zero,
                shape,
                place: powers.iter().copied().zip(terms.iter().copied()).collect(),
                tone: if terms.len() > n { tone.collect() } else { Vec::new() },
                tones: [tone_low, tone_high],
                range,
                deviation: [before, left],
                uneven: 1.0,
                variation: (high - low).exp(),
            })
        };
        let (place, tone, all) = (fitted(true, false)?, fitted(false, true), fitted(true, true));
        let alone = tone.filter(|tone| tone.deviation[1] < place.deviation[1]).unwrap_or(place);
        let best = all.filter(|all| all.deviation[1] <= both * alone.deviation[1]).unwrap_or(alone);
        let tone = Tone::of(&best);
        let left = |b: &Block| b.difference() - best.logarithm(tone.as_ref(), scaled(shape, b.at), b.log[1]);
        let [as_it_is, left] = between_neighbours(blocks, [&Block::difference, &left]);
        Some(Self { uneven: left / as_it_is.max(LOG_TOLERANCE), ..best })
    }

    /// P + Q at a place (-1 to 1) and logarithm of brightness in the deformed volume; `tone` is its
    /// [`Tone::of`].
    fn logarithm(&self, tone: Option<&Tone>, at: [f64; 3], log: f64) -> f64 {
        let place: f64 = self.place.iter().map(|(p, t)| t * monomial(at, *p)).sum();
        place + tone.map_or(0.0, |t| f64::from(t.at((log + place) as f32)))
    }

    /// Whether it goes by the brightness itself: another contrast.
    pub fn is_of_tone(&self) -> bool {
        !self.tone.is_empty()
    }

    /// Whether it goes by place.
    pub fn is_of_place(&self) -> bool {
        self.place.len() > 1
    }

    /// Brings a deformed volume, on a level of `factor` where it starts at `origin` (voxels of the
    /// level's initial lattice), to the initial one's brightness.
    pub fn even_out(&self, values: &mut [f32], shape: [usize; 3], origin: [f64; 3], factor: [usize; 3]) {
        let [nx, ny, _] = shape;
        let at = |voxel: [usize; 3]| {
            let p = VoxelPoint(std::array::from_fn(|a| voxel[a] as f64 + origin[a]));
            scaled(self.shape, from_level(p, factor))
        };
        let step = if nx > 1 { (at([nx - 1, 0, 0])[0] - at([0; 3])[0]) / (nx - 1) as f64 } else { 0.0 };
        let range = [self.range[0] - PLACE_MARGIN_LOG, self.range[1] + PLACE_MARGIN_LOG].map(|v| v as f32);
        let tone = Tone::of(self);
        let one = |log: &mut Vec<f32>, (row, values): (usize, &mut [f32])| {
            let first = at([0, row % ny, row / ny]);
            let mut along = [0.0; PLACE_DEGREE + 1];
            for ([x, y, z], t) in &self.place {
                along[*x] += t * monomial(first, [0, *y, *z]);
            }
            let (along, x) = (along.map(|c| c as f32), [first[0], step].map(|x| x as f32));
            let row = Row { along, x, range, zero: self.zero };
            dispatch(
                #[inline(always)]
                || row.even_out(values, log, tone.as_ref()),
            );
        };
        values.par_chunks_mut(nx).enumerate().for_each_init(|| vec![0.0; nx], one);
    }
}

/// Q as a table, with room for indices that are not checked.
struct Tone {
    table: [f32; 2 * TONE_CURVE.table_steps],
    /// The lowest logarithm, and steps of the table for 1.
    low: f32,
    steps: f32,
}

impl Tone {
    /// None where place alone explains it.
    fn of(found: &Brightness) -> Option<Self> {
        let [low, high] = found.tones;
        let last = *found.tone.last()?;
        let table = std::array::from_fn(|i| *found.tone.get(i).unwrap_or(&last) as f32);
        Some(Self { table, low: low as f32, steps: (TONE_CURVE.table_steps as f64 / (high - low)) as f32 })
    }

    /// Of a logarithm of brightness, P in it: linear between the steps, and even past them.
    #[inline(always)]
    fn at(&self, tone: f32) -> f32 {
        let at = ((tone - self.low) * self.steps).max(0.0).min(TONE_CURVE.table_steps as f32);
        let shifted = (at - 0.5) + ROUND_TO_INTEGER;
        let i = (shifted.to_bits() & 0xffff) as usize;
        let t = at - (shifted - ROUND_TO_INTEGER);
        (1.0 - t) * self.table[i % (2 * TONE_CURVE.table_steps)]
            + t * self.table[(i + 1) % (2 * TONE_CURVE.table_steps)]
    }
}

/// What is taken out along a row of voxels.
struct Row {
    /// P by powers of the place along the row.
    along: [f32; PLACE_DEGREE + 1],
    /// That place (-1 to 1) at the first voxel, and from one to the next.
    x: [f32; 2],
    /// Lowest and highest P.
    range: [f32; 2],
    zero: Zero,
}

impl Row {
    /// `log` is room for as many values as there are.
    #[inline(always)]
    fn even_out(&self, values: &mut [f32], log: &mut [f32], tone: Option<&Tone>) {
        let Zero { at, sign } = self.zero;
        let ([zero, darkest], sign) = (at.map(|v| v as f32), sign as f32);
        for (i, (value, log)) in values.iter_mut().zip(&mut *log).enumerate() {
            let x = self.x[0] + i as f32 * self.x[1];
            let mut place = 0.0;
            for c in self.along.iter().rev() {
                place = place * x + c;
            }
            *log = place.max(self.range[0]).min(self.range[1]);
            *value = sign * (*value - darkest);
        }
        if let Some(tone) = tone {
            for (value, log) in values.iter().zip(&mut *log) {
                *log += tone.at(ln(*value) + *log);
            }
        }
        for (value, log) in values.iter_mut().zip(log) {
            *value = zero + sign * (*value * exp(*log));
        }
    }
}

/// Powers of a polynomial of `degree`, none along axes of one voxel.
fn powers(shape: [usize; 3], degree: usize) -> Vec<[usize; 3]> {
    let along = |a: usize| if shape[a] > 1 { 0..=degree } else { 0..=0 };
    let all = along(2).flat_map(|z| along(1).flat_map(move |y| along(0).map(move |x| [x, y, z])));
    all.filter(|p| p.iter().sum::<usize>() <= degree).collect()
}

fn monomial(at: [f64; 3], powers: [usize; 3]) -> f64 {
    (0..3).map(|a| at[a].powi(powers[a] as i32)).product()
}

/// A place in voxels of the full initial lattice, -1 to 1 over it.
fn scaled(shape: [usize; 3], VoxelPoint(at): VoxelPoint) -> [f64; 3] {
    std::array::from_fn(|a| if shape[a] > 1 { 2.0 * at[a] / (shape[a] - 1) as f64 - 1.0 } else { 0.0 })
}

/// A logarithm of brightness, -1 to 1 over the range of the tissue, and little past it.
fn toned(scale: [f64; 2], log: f64) -> f64 {
    ((log - scale[0]) / scale[1]).clamp(-TONE_CURVE.max_argument, TONE_CURVE.max_argument)
}

/// Q at a scaled brightness; straight on past the range of the tissue.
fn of_tone(terms: &[f64], t: f64) -> f64 {
    let inside = t.clamp(-1.0, 1.0);
    let value = inside * terms.iter().rev().fold(0.0, |sum, c| sum * inside + c);
    value + slope(terms, inside) * (t - inside)
}

/// The slope of Q at a scaled brightness in the range of the tissue.
fn slope(terms: &[f64], t: f64) -> f64 {
    terms.iter().enumerate().rev().fold(0.0, |sum, (i, c)| sum * t + (i + 1) as f64 * c)
}

/// Q for a logarithm of the deformed volume's brightness: at the middle between that and the
/// initial one's that it leads to.
fn tone_from(terms: &[f64], scale: [f64; 2], log: f64) -> f64 {
    (0..TONE_CURVE.fixed_point_iterations).fold(0.0, |q, _| 0.5 * (q + of_tone(terms, toned(scale, log + q / 2.0))))
}

/// The steepest that Q is, either way, in the range of the tissue.
fn steepest(terms: &[f64]) -> f64 {
    (-10..=10).map(|t| slope(terms, f64::from(t) / 10.0).abs()).fold(0.0, f64::max)
}

/// By how much each of two values of blocks differs between neighbours (median), each the middle of
/// the blocks about it.
fn between_neighbours(blocks: &[Block], values: [&dyn Fn(&Block) -> f64; 2]) -> [f64; 2] {
    let places: Vec<[f64; 3]> = blocks.iter().map(|b| b.at.0).collect();
    let tree = Neighbours::new(&places);
    let near: Vec<Vec<usize>> =
        places.iter().map(|p| tree.within(*p, f64::INFINITY, NEIGHBOURS.median_blocks)).collect();
    values.map(|value| {
        let values: Vec<f64> = blocks.iter().map(value).collect();
        let middle = |near: &Vec<usize>| percentile(&mut near.iter().map(|&i| values[i]).collect::<Vec<_>>(), 50.0);
        let smooth: Vec<f64> = near.iter().map(middle).collect();
        let beside = near.iter().zip(&smooth).flat_map(|(near, here)| {
            let smooth = &smooth;
            near.iter().skip(1).take(NEIGHBOURS.compared).map(move |&i| (smooth[i] - here).abs())
        });
        percentile(&mut beside.collect::<Vec<_>>(), 50.0)
    })
}

/// Terms of place, then of tone where the brightness is scaled for them, with Cauchy weights; and
/// the robust standard deviation of what they leave. `usual` is the middle of the logarithms'
/// differences, where P starts.
fn robust(
    blocks: &[Block],
    by_place: impl Fn(&Block) -> Vec<f64>,
    usual: f64,
    scale: Option<[f64; 2]>,
) -> Option<(Vec<f64>, f64)> {
    let mut rows: Vec<Vec<f64>> = blocks.iter().map(by_place).collect();
    let n = rows.first()?.len();
    let mut weights: Vec<f64> = blocks.iter().map(|b| b.weight).collect();
    let mut best = (vec![0.0; n], 0.0);
    best.0[0] = usual;
    for _ in 0..ROBUST_FIT.iterations {
        for (row, b) in rows.iter_mut().zip(blocks) {
            let middle = 0.5 * (b.log[0] + b.log[1] + dot(&row[..n], &best.0[..n]));
            row.truncate(n);
            let powers = |s| {
                (1..=TONE_CURVE.degree).map(move |p| {
                    toned(s, middle)
                        .clamp(-TONE_CURVE.max_fitted_argument, TONE_CURVE.max_fitted_argument)
                        .powi(p as i32)
                })
            };
            row.extend(scale.into_iter().flat_map(powers));
        }
        let terms = fit(&rows, blocks, &weights)?;
        let left = || rows.iter().zip(blocks).map(|(row, b)| b.difference() - dot(row, &terms));
        let deviation = robust_deviation(left());
        for ((w, off), b) in weights.iter_mut().zip(left()).zip(blocks) {
            *w = b.weight / (1.0 + (off / (ROBUST_FIT.cauchy_tuning * deviation).max(LOG_TOLERANCE)).powi(2));
        }
        best = (terms, deviation);
    }
    Some(best)
}

/// Weighted least squares; a trace of ridge where blocks do not tell all terms apart.
fn fit(rows: &[Vec<f64>], blocks: &[Block], weights: &[f64]) -> Option<Vec<f64>> {
    let n = rows.first()?.len();
    let (mut a, mut b) = (vec![0.0; n * n], vec![0.0; n]);
    dispatch(
        #[inline(always)]
        || {
            for ((row, block), w) in rows.iter().zip(blocks).zip(weights) {
                for (i, (a, b)) in a.chunks_exact_mut(n).zip(&mut b).enumerate() {
                    let weighed = w * row[i];
                    *b += weighed * block.difference();
                    a.iter_mut().zip(&row[..=i]).for_each(|(a, r)| *a += weighed * r);
                }
            }
        },
    );
    let ridge = 1e-6 * weights.iter().sum::<f64>();
    (0..n).for_each(|i| a[i * n + i] += ridge);
    Cholesky::new(a, n)?.solve(&mut b);
    Some(b)
}

/// A block of voxels as both volumes show it under a field.
struct BlockMeans {
    /// Place in the deformed volume, on the level's initial lattice.
    at: VoxelPoint,
    weight: f64,
    /// Mean value in both volumes.
    mean: [f64; 2],
}

/// The blocks that lie in the mask by half at least.
fn seen_blocks(
    pair: &Pair<'_>,
    warped: &[f32],
    displacement: impl Fn(VoxelPoint) -> GridVector + Sync,
) -> Vec<BlockMeans> {
    let side = pair.in_voxels(BLOCKS.edge_voxels);
    let along = |a: usize| (0..pair.shape[a]).step_by(side[a]);
    let starts: Vec<[usize; 3]> =
        along(2).flat_map(|k| along(1).flat_map(move |j| along(0).map(move |i| [i, j, k]))).collect();
    let seen = |first| {
        let (p, weight, mean) = means(pair, warped, first, side)?;
        let at = p.moved(displacement(p), pair.spacing);
        Some(BlockMeans { at, weight, mean })
    };
    starts.into_par_iter().filter_map(seen).collect()
}

/// Those that stand out of the noise, thinned out; none where too many are not positive.
fn blocks(seen: &[BlockMeans], (zero, least): (Zero, [f64; 2]), factor: [usize; 3]) -> Option<Vec<Block>> {
    let bright = |s: &BlockMeans| -> [f64; 2] { std::array::from_fn(|i| zero.sign * (s.mean[i] - zero.at[i])) };
    let positive: Vec<(&BlockMeans, [f64; 2])> =
        seen.iter().map(|s| (s, bright(s))).filter(|(_, b)| b.iter().all(|v| *v > 0.0)).collect();
    if (seen.len() - positive.len()) as f64 > MAX_NONPOSITIVE_FRACTION * seen.len() as f64 {
        return None;
    }
    let clear: Vec<_> =
        positive.into_iter().filter(|(_, b)| b.iter().zip(least).all(|(b, least)| *b > least)).collect();
    let share = BLOCKS.max_count as f64 / clear.len().max(1) as f64;
    let thinned = clear.into_iter().enumerate().filter(|(i, _)| stands_for_all(*i, share));
    let block =
        |(s, b): (&BlockMeans, [f64; 2])| Block { at: from_level(s.at, factor), log: b.map(f64::ln), weight: s.weight };
    Some(thinned.map(|(_, s)| block(s)).collect())
}

/// Centre (voxels), weight and mean brightness in both volumes of the block that starts at `first`;
/// none where less than half of it is tissue that both show.
fn means(pair: &Pair<'_>, warped: &[f32], first: [usize; 3], side: [usize; 3]) -> Option<(VoxelPoint, f64, [f64; 2])> {
    let [nx, ny, _] = pair.shape;
    let last: [usize; 3] = std::array::from_fn(|a| (first[a] + side[a]).min(pair.shape[a]));
    let (mut centre, mut sum, mut means, mut count) = ([0.0; 3], 0.0, [0.0; 2], 0usize);
    for (j, k) in (first[2]..last[2]).flat_map(|k| (first[1]..last[1]).map(move |j| (j, k))) {
        let from = nx * (j + ny * k);
        for i in first[0]..last[0] {
            let (weight, f, w) = (f64::from(pair.mask[from + i]), pair.fixed_smooth[from + i], warped[from + i]);
            if weight > 0.0 && (f + w).is_finite() {
                (sum, count) = (sum + weight, count + 1);
                means = [means[0] + weight * f64::from(f), means[1] + weight * f64::from(w)];
                centre = [centre[0] + weight * i as f64, centre[1] + weight * j as f64, centre[2] + weight * k as f64];
            }
        }
    }
    let all: usize = (0..3).map(|a| last[a] - first[a]).product();
    (2 * count >= all && sum > 0.0).then(|| (VoxelPoint(centre.map(|c| c / sum)), sum, means.map(|m| m / sum)))
}
