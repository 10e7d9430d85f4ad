//! Coupling of local evidence through a smooth field: each place pulls with its own information matrix, the bending
//! energy of a spline lattice holds the places together.

use crate::numerics::bending::{Smoothness, SolveReport, apply_blocks, solve};
use crate::numerics::random::Random;

/// One Gauss-Newton step: adds to `coefficients` the `d` that minimises
/// `1/2 d.A d - b.d + lambda/2 (c + d).L (c + d)`.
pub fn step(
    smoothness: &Smoothness,
    lambda: f32,
    blocks: &[[f32; 6]],
    rhs: &[f32],
    coefficients: &mut [f32],
    tolerance: f64,
    limit: usize,
) -> (SolveReport, f32) {
    let n = blocks.len();
    let mut b = rhs.to_vec();
    let mut lc = vec![0.0f32; n];
    for (c, b) in coefficients.chunks_exact(n).zip(b.chunks_exact_mut(n)) {
        smoothness.apply(c, &mut lc);
        for (b, l) in b.iter_mut().zip(&lc) {
            *b -= lambda * l;
        }
    }
    let mut d = vec![0.0f32; 3 * n];
    let report = solve(smoothness, lambda, |x, out| apply_blocks(blocks, x, out), blocks, &b, &mut d, tolerance, limit);
    let mut moved = 0.0f64;
    for (c, d) in coefficients.iter_mut().zip(&d) {
        *c += d;
        moved += f64::from(d * d);
    }
    (report, (moved / n as f64).sqrt() as f32)
}

/// How many degrees of freedom the data determine: `3 n - lambda tr((A + lambda L)^-1 L)` with a free rank of the
/// energy (`L` costs nothing for an affine field) counted as determined.
///
/// The trace is estimated with one random sign vector (Hutchinson 1990), which is exact to about one part in the root
/// of the number of nodes.
pub fn determined(smoothness: &Smoothness, lambda: f32, blocks: &[[f32; 6]], seed: u64, limit: usize) -> f64 {
    let n = blocks.len();
    let mut random = Random::new(seed, 77);
    let z: Vec<f32> = (0..3 * n).map(|_| if random.bits() >> 63 == 0 { 1.0 } else { -1.0 }).collect();
    let mut x = vec![0.0f32; 3 * n];
    solve(smoothness, lambda, |x, out| apply_blocks(blocks, x, out), blocks, &z, &mut x, 1e-2, limit);
    let mut lx = vec![0.0f32; n];
    let mut trace = 0.0;
    for (x, z) in x.chunks_exact(n).zip(z.chunks_exact(n)) {
        smoothness.apply(x, &mut lx);
        trace += lx.iter().zip(z).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>();
    }
    3.0 * n as f64 - f64::from(lambda) * trace
}
