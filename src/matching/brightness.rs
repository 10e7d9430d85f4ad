//! Brightness that differs smoothly between the two volumes (a coil's profile, a bias field), taken out of the deformed one.
//!
//! The logarithm of the initial over the deformed volume's brightness, in blocks of voxels under the field found so far, is fitted by a
//! polynomial of place with Cauchy weights (Holland and Welsch 1977): blocks that are off because the field is off there hardly count. What
//! varies less smoothly is left to [`crate::matching::gain`].

use crate::matching::levels::from_level;
use crate::matching::pair::Pair;
use crate::numerics::bspline::Lattice;
use crate::numerics::cholesky::Cholesky;
use crate::numerics::statistics::{median, percentile};
use rayon::prelude::*;

/// Edge of a block (the finest axis' voxels).
const BLOCK: usize = 4;

/// Degree of the polynomial; a lower one where there are few blocks.
const DEGREE: usize = 4;

/// Blocks for each term of the polynomial at least.
const BLOCKS_A_TERM: usize = 8;

/// Brightness of a block, over the noise, from which its logarithm is believed.
const ABOVE_NOISE: f64 = 5.0;

/// Part of the blocks that may be 0 or negative, in volumes of brightness.
const NOT_POSITIVE: f64 = 0.02;

/// Rounds of weights.
const ROUNDS: usize = 12;

/// Where the Cauchy weight is a half, in deviations of what is left.
const HALF: f64 = 2.0;

/// Logarithms that differ by less are equal.
const EQUAL: f64 = 1e-6;

/// How far past the values that were measured the polynomial is followed (logarithm).
const BEYOND: f64 = 0.1;

/// Logarithm of the initial over the deformed volume's brightness, a polynomial over the places of the deformed one.
#[derive(Debug, Clone, PartialEq)]
pub struct Brightness {
    /// The initial volume's voxels, which are mapped to -1 to 1.
    shape: [usize; 3],
    /// Powers along each axis, and the term's coefficient.
    terms: Vec<([usize; 3], f64)>,
    /// Lowest and highest value where it was measured.
    range: [f64; 2],
    /// Places where it was measured.
    places: Vec<[f64; 3]>,
    /// Robust standard deviation of the blocks' logarithms as they are, and of what the polynomial leaves.
    pub deviation: [f64; 2],
}

/// A block of voxels under a field.
struct Block {
    /// Place in the deformed volume (voxels of the full initial lattice).
    at: [f64; 3],
    /// Logarithm of initial over deformed brightness.
    ratio: f64,
    weight: f64,
}

impl Brightness {
    /// From a level of `factor` under a field on it; `shape` is the full initial volume's. None where there are too few blocks for it, or
    /// values that are not of brightness (negative ones).
    pub fn measure(pair: &Pair<'_>, factor: [usize; 3], shape: [usize; 3], field: (&Lattice, &[f32])) -> Option<Self> {
        let blocks = blocks(pair, factor, field)?;
        let powers = (0..=DEGREE).rev().map(|d| powers(shape, d)).find(|p| blocks.len() >= BLOCKS_A_TERM * p.len())?;
        let basis = |at: [f64; 3]| -> Vec<f64> { powers.iter().map(|p| monomial(scaled(shape, at), *p)).collect() };
        let rows: Vec<Vec<f64>> = blocks.iter().map(|b| basis(b.at)).collect();
        let spread = |terms: &[f64]| {
            let mut left: Vec<f32> =
                rows.iter().zip(&blocks).map(|(row, b)| (b.ratio - dot(row, terms)) as f32).collect();
            let middle = median(&mut left);
            left.iter_mut().for_each(|v| *v = (*v - middle).abs());
            1.4826 * f64::from(median(&mut left))
        };
        let mut terms = vec![0.0; powers.len()];
        let before = spread(&terms);
        let mut weights: Vec<f64> = blocks.iter().map(|b| b.weight).collect();
        let mut after = before;
        for _ in 0..ROUNDS {
            terms = fit(&rows, &blocks, &weights)?;
            after = spread(&terms);
            for ((w, row), b) in weights.iter_mut().zip(&rows).zip(&blocks) {
                let off = (b.ratio - dot(row, &terms)) / (HALF * after).max(EQUAL);
                *w = b.weight / (1.0 + off * off);
            }
        }
        let values = rows.iter().map(|row| dot(row, &terms));
        Some(Self {
            shape,
            range: values.fold([f64::INFINITY, f64::NEG_INFINITY], |r, v| [r[0].min(v), r[1].max(v)]),
            terms: powers.into_iter().zip(terms).collect(),
            places: blocks.iter().map(|b| b.at).collect(),
            deviation: [before, after],
        })
    }

    /// With what was measured after `self` was taken out.
    pub fn and(self, more: Self) -> Self {
        let mut terms = self.terms;
        for (power, term) in more.terms {
            match terms.iter_mut().find(|t| t.0 == power) {
                Some(t) => t.1 += term,
                None => terms.push((power, term)),
            }
        }
        let range = std::array::from_fn(|i| self.range[i] + more.range[i]);
        Self { terms, range, places: more.places, deviation: [self.deviation[0], more.deviation[1]], ..self }
    }

    /// By what factor it varies over the tissue (from the tenth to the 90th percentile).
    pub fn variation(&self) -> f64 {
        let at = |p: &[f64; 3]| self.terms.iter().map(|(power, t)| t * monomial(scaled(self.shape, *p), *power)).sum();
        let mut values: Vec<f64> = self.places.iter().map(at).collect();
        let [low, high] = [10.0, 90.0].map(|q| percentile(&mut values, q));
        (high - low).exp()
    }

    /// Brings a deformed volume, on a level of `factor` where it starts at `origin` (voxels of the level's initial lattice), to the initial
    /// one's brightness.
    pub fn even_out(&self, values: &mut [f32], shape: [usize; 3], origin: [f64; 3], factor: [usize; 3]) {
        let [nx, ny, _] = shape;
        let full = |at: usize, a: usize| (at as f64 + origin[a] + 0.5) * factor[a] as f64 - 0.5;
        let [low, high] = [self.range[0] - BEYOND, self.range[1] + BEYOND];
        values.par_chunks_mut(nx).enumerate().for_each(|(row, values)| {
            let at = scaled(self.shape, [0.0, full(row % ny, 1), full(row / ny, 2)]);
            let mut along = [0.0; DEGREE + 1];
            for ([x, y, z], t) in &self.terms {
                along[*x] += t * monomial(at, [0, *y, *z]);
            }
            for (i, v) in values.iter_mut().enumerate() {
                let x = scaled(self.shape, [full(i, 0), 0.0, 0.0])[0];
                let log = along.iter().rev().fold(0.0, |sum, c| sum * x + c);
                *v *= log.clamp(low, high).exp() as f32;
            }
        });
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
fn scaled(shape: [usize; 3], at: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|a| if shape[a] > 1 { 2.0 * at[a] / (shape[a] - 1) as f64 - 1.0 } else { 0.0 })
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Weighted least squares; a trace of ridge where blocks do not tell all terms apart.
fn fit(rows: &[Vec<f64>], blocks: &[Block], weights: &[f64]) -> Option<Vec<f64>> {
    let n = rows.first()?.len();
    let (mut a, mut b) = (vec![0.0; n * n], vec![0.0; n]);
    for ((row, block), w) in rows.iter().zip(blocks).zip(weights) {
        for i in 0..n {
            b[i] += w * row[i] * block.ratio;
            (0..=i).for_each(|j| a[i * n + j] += w * row[i] * row[j]);
        }
    }
    let ridge = 1e-6 * weights.iter().sum::<f64>();
    (0..n).for_each(|i| a[i * n + i] += ridge);
    Cholesky::new(a, n)?.solve(&mut b);
    Some(b)
}

/// The blocks that lie in the mask by half at least and stand out of the noise; none where too many are not positive.
fn blocks(pair: &Pair<'_>, factor: [usize; 3], (lattice, coefficients): (&Lattice, &[f32])) -> Option<Vec<Block>> {
    let warped = pair.warp(lattice, coefficients, &pair.spans);
    let side = pair.in_voxels(BLOCK);
    let along = |a: usize| (0..pair.shape[a]).step_by(side[a]);
    let starts: Vec<[usize; 3]> =
        along(2).flat_map(|k| along(1).flat_map(move |j| along(0).map(move |i| [i, j, k]))).collect();
    let shown: Vec<([f64; 3], f64, [f64; 2])> =
        starts.into_par_iter().filter_map(|first| means(pair, &warped, first, side)).collect();
    let positive: Vec<_> = shown.iter().filter(|s| s.2[0] > 0.0 && s.2[1] > 0.0).collect();
    if (shown.len() - positive.len()) as f64 > NOT_POSITIVE * shown.len() as f64 {
        return None;
    }
    let least = ABOVE_NOISE * f64::from(pair.noise);
    let block = |&&(p, weight, [f, w]): &&([f64; 3], f64, [f64; 2])| {
        let u = lattice.at(coefficients, p);
        let there = std::array::from_fn(|a| p[a] + u[a] / pair.spacing[a]);
        Block { at: from_level(there, factor), ratio: (f / w).ln(), weight }
    };
    Some(positive.iter().filter(|s| s.2[0] > least).map(block).collect())
}

/// Centre (voxels), weight and mean brightness in both volumes of the block that starts at `first`; none where less than half of it is
/// tissue that both show.
fn means(pair: &Pair<'_>, warped: &[f32], first: [usize; 3], side: [usize; 3]) -> Option<([f64; 3], f64, [f64; 2])> {
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
    (2 * count >= all && sum > 0.0).then(|| (centre.map(|c| c / sum), sum, means.map(|m| m / sum)))
}
