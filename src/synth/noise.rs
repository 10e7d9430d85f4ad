//! Smooth random functions of position: cubic B-splines with random coefficients.

use crate::numerics::sampling::cubic_bspline;
use crate::synth::random::Random;

/// Coefficients along each axis; the function repeats after this many cells.
const SIDE: usize = 64;

/// Root of the integral of the squared three-dimensional cubic B-spline, (151/315)^(3/2): the function's deviation
/// for independent coefficients of deviation 1.
const DEVIATION: f64 = 0.331_893;

/// N independent functions of position with mean 0 and standard deviation 1, twice continuously differentiable.
///
/// Nearly all power lies below one cycle in two cells, so cells of two voxels survive sampling.
#[derive(Debug, Clone)]
pub struct SmoothNoise<const N: usize> {
    coefficients: Vec<[f32; N]>,
    cell: [f64; 3],
    shift: [f64; 3],
}

impl<const N: usize> SmoothNoise<N> {
    /// With control points every `cell` mm along the world axes.
    pub fn new(mut random: Random, cell: [f64; 3]) -> Self {
        let shift = std::array::from_fn(|_| random.uniform(0.0, SIDE as f64));
        let mut draw = || (random.normals()[0] / DEVIATION) as f32;
        let coefficients = (0..SIDE.pow(3)).map(|_| std::array::from_fn(|_| draw())).collect();
        Self { coefficients, cell, shift }
    }

    /// The values at a world position (mm).
    pub fn at(&self, p: [f64; 3]) -> [f64; N] {
        let mut weights = [[0.0; 4]; 3];
        let mut index = [[0; 4]; 3];
        for a in 0..3 {
            let q = p[a] / self.cell[a] + self.shift[a];
            let low = q.floor();
            weights[a] = cubic_bspline(q - low);
            index[a] = std::array::from_fn(|n| (low as i64 + n as i64 - 1).rem_euclid(SIDE as i64) as usize);
        }
        let mut sum = [0.0; N];
        for (&k, wz) in index[2].iter().zip(weights[2]) {
            for (&j, wy) in index[1].iter().zip(weights[1]) {
                let row = &self.coefficients[SIDE * (j + SIDE * k)..][..SIDE];
                for (&i, wx) in index[0].iter().zip(weights[0]) {
                    for (s, c) in sum.iter_mut().zip(row[i]) {
                        *s += wz * wy * wx * f64::from(c);
                    }
                }
            }
        }
        sum
    }
}
