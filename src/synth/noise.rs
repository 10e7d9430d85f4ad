//! Smooth random functions of position: cubic B-splines with random coefficients.

use crate::numerics::random::Random;
use crate::numerics::sampling::cubic_bspline;
use crate::types::{Grid, WorldPoint};

/// Standard deviation of the function for independent unit coefficients: (151/315)^(3/2), the root
/// of the integral of the squared three-dimensional cubic B-spline.
const BSPLINE_SD: f64 = 0.331_893;

/// Coefficients along each axis of a texture, which repeats after that many cells.
const TEXTURE_COEFFICIENTS: usize = 64;

/// Coefficients along each axis of a function with at most a dozen cells in the field of view.
pub(crate) const SMOOTH_COEFFICIENTS: usize = 16;

/// N independent functions of position with mean 0 and standard deviation 1, twice continuously
/// differentiable.
///
/// Nearly all power lies below one cycle in two cells, so cells of two voxels survive sampling.
#[derive(Debug, Clone)]
pub(crate) struct SmoothNoise<const N: usize> {
    /// N for each control point, x fastest.
    coefficients: Vec<f32>,
    side: usize,
    cell: [f64; 3],
    shift: [f64; 3],
}

impl<const N: usize> SmoothNoise<N> {
    /// With control points every `cell` mm along the world axes, repeating after `side` of them.
    pub fn new(mut random: Random, cell: [f64; 3], side: usize) -> Self {
        let shift = std::array::from_fn(|_| random.uniform(0.0, side as f64));
        let pairs = (N * side.pow(3)).div_ceil(2);
        let coefficients = (0..pairs).flat_map(|_| random.normals()).map(|v| (v / BSPLINE_SD) as f32).collect();
        Self { coefficients, side, cell, shift }
    }

    /// The values at a world position (mm), to f32's precision.
    pub fn at(&self, p: [f64; 3]) -> [f64; N] {
        let mut weights = [[0.0f32; 4]; 3];
        let mut index = [[0; 4]; 3];
        for a in 0..3 {
            let q = p[a] / self.cell[a] + self.shift[a];
            let low = q.floor();
            weights[a] = cubic_bspline(q - low).map(|w| w as f32);
            index[a] = std::array::from_fn(|n| (low as i64 + n as i64 - 1).rem_euclid(self.side as i64) as usize);
        }
        let (coefficients, _) = self.coefficients.as_chunks::<N>();
        let mut sum = [0.0f32; N];
        for (&k, wz) in index[2].iter().zip(weights[2]) {
            for (&j, wy) in index[1].iter().zip(weights[1]) {
                let row = &coefficients[self.side * (j + self.side * k)..][..self.side];
                for (&i, wx) in index[0].iter().zip(weights[0]) {
                    let weight = wz * wy * wx;
                    for (s, c) in sum.iter_mut().zip(row[i]) {
                        *s += weight * c;
                    }
                }
            }
        }
        sum.map(f64::from)
    }
}

impl SmoothNoise<4> {
    /// The first three values as a vector; the fourth fills the processor's four lanes.
    pub fn vector(&self, p: [f64; 3]) -> [f64; 3] {
        let [x, y, z, _] = self.at(p);
        [x, y, z]
    }
}

/// Weights of the coarser texture cells, and how many times the finest they are.
const OCTAVES: [(f64, f64); 3] = [(1.0, 1.0), (2.3, 0.8), (5.1, 0.6)];

/// The fine texture of a body, mean 0 and deviation 1; its finest cells are two voxels.
#[derive(Debug, Clone)]
pub struct Texture([SmoothNoise<1>; 3]);

impl Texture {
    /// For volumes on `grid`.
    pub fn new(grid: &Grid, seed: u64) -> Self {
        let linear = grid.affine().linear();
        let cell: [f64; 3] = std::array::from_fn(|a| 2.0 * linear[a].iter().map(|v| v * v).sum::<f64>().sqrt());
        let noise = |n: usize| {
            SmoothNoise::new(Random::new(seed, 10 + n as u64), cell.map(|c| c * OCTAVES[n].0), TEXTURE_COEFFICIENTS)
        };
        Self(std::array::from_fn(noise))
    }

    /// The value at a world position.
    pub fn at(&self, p: WorldPoint) -> f64 {
        let norm = OCTAVES.iter().map(|o| o.1 * o.1).sum::<f64>().sqrt();
        self.0.iter().zip(OCTAVES).map(|(t, o)| t.at(p.0)[0] * o.1 / norm).sum()
    }
}
