//! Nodal vectors: sums in a fixed order, for any number of threads.

use rayon::prelude::*;

/// Nodes processed by one task.
const NODES_PER_TASK: usize = 4096;

/// A single-precision value a node and component.
pub(crate) type Nodal = Vec<[f32; 3]>;

/// Sum over all entries of what `term` gives for each pair.
fn summed<T: Sync>(a: &[[T; 3]], b: &[[T; 3]], term: impl Fn(&[T; 3], &[T; 3]) -> f64 + Sync) -> f64 {
    let pieces: Vec<f64> = a
        .par_chunks(NODES_PER_TASK)
        .zip(b.par_chunks(NODES_PER_TASK))
        .map(|(a, b)| a.iter().zip(b).map(|(a, b)| term(a, b)).sum::<f64>())
        .collect();
    pieces.iter().sum()
}

/// `a . b`.
pub fn dot(a: &[[f32; 3]], b: &[[f32; 3]]) -> f64 {
    summed(a, b, |a, b| (0..3).map(|c| f64::from(a[c]) * f64::from(b[c])).sum())
}

/// `|a|`.
pub fn norm(a: &[[f64; 3]]) -> f64 {
    summed(a, a, |a, _| a.iter().map(|v| v * v).sum()).sqrt()
}

/// `a = factor a + b`.
pub(crate) fn scale_add(a: &mut [[f32; 3]], factor: f32, b: &[[f32; 3]]) {
    a.par_chunks_mut(NODES_PER_TASK).zip(b.par_chunks(NODES_PER_TASK)).for_each(|(a, b)| {
        a.iter_mut().zip(b).for_each(|(a, b)| (0..3).for_each(|c| a[c] = factor * a[c] + b[c]));
    });
}

/// `a += factor b`.
pub fn add(a: &mut [[f32; 3]], factor: f32, b: &[[f32; 3]]) {
    a.par_chunks_mut(NODES_PER_TASK).zip(b.par_chunks(NODES_PER_TASK)).for_each(|(a, b)| {
        a.iter_mut().zip(b).for_each(|(a, b)| (0..3).for_each(|c| a[c] += factor * b[c]));
    });
}

/// `a = factor a + gain (d b)`, entry by entry.
pub(crate) fn scale_add_product(a: &mut [[f32; 3]], factor: f32, gain: f32, d: &[[f32; 3]], b: &[[f32; 3]]) {
    a.par_chunks_mut(NODES_PER_TASK).zip(d.par_chunks(NODES_PER_TASK)).zip(b.par_chunks(NODES_PER_TASK)).for_each(
        |((a, d), b)| {
            for ((a, d), b) in a.iter_mut().zip(d).zip(b) {
                (0..3).for_each(|c| a[c] = factor * a[c] + gain * d[c] * b[c]);
            }
        },
    );
}
