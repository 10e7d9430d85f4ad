//! Eigenvalues of symmetric matrices of any size.

use faer::diag::Diag;
use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::evd::{ComputeEigenvectors, self_adjoint_evd, self_adjoint_evd_scratch};
use faer::{Mat, Par};

/// Eigenvalues, largest first, each with its vector of length 1, of the symmetric
/// `matrix(row, column)` of `n` rows; the lower triangle is asked for. None where it does not
/// converge (entries that are not finite).
pub fn symmetric(n: usize, matrix: impl Fn(usize, usize) -> f64) -> Option<Vec<(f64, Vec<f64>)>> {
    let a = Mat::from_fn(n, n, |i, j| matrix(i.max(j), i.min(j)));
    let (mut values, mut vectors) = (Diag::<f64>::zeros(n), Mat::<f64>::zeros(n, n));
    // One thread: the same bits whatever their number.
    let mut memory =
        MemBuffer::new(self_adjoint_evd_scratch::<f64>(n, ComputeEigenvectors::Yes, Par::Seq, Default::default()));
    let stack = MemStack::new(&mut memory);
    self_adjoint_evd(a.as_ref(), values.as_mut(), Some(vectors.as_mut()), Par::Seq, stack, Default::default()).ok()?;
    let vector = |k: usize| (0..n).map(|i| vectors[(i, k)]).collect();
    Some((0..n).rev().map(|k| (values.column_vector()[k], vector(k))).collect())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// The second differences of a line of n points have the eigenvalues 2 - 2 cos(k pi / (n + 1)).
    #[test]
    fn eigenvalues_are_those_of_a_string() {
        let n = 40;
        let a = |i: usize, j: usize| [2.0, -1.0, 0.0][i.abs_diff(j).min(2)];
        let found = symmetric(n, a).unwrap();
        for (k, (value, vector)) in found.iter().rev().enumerate() {
            let angle = (k + 1) as f64 * std::f64::consts::PI / (n + 1) as f64;
            assert!((value - (2.0 - 2.0 * angle.cos())).abs() < 1e-12, "{k}: {value}");
            assert!((vector.iter().map(|v| v * v).sum::<f64>() - 1.0).abs() < 1e-12);
            for i in 0..n {
                let product: f64 = (0..n).map(|j| a(i, j) * vector[j]).sum();
                assert!((product - value * vector[i]).abs() < 1e-12, "{k}");
            }
        }
        assert!(symmetric(3, |_, _| f64::NAN).is_none_or(|e| e.iter().any(|v| !v.0.is_finite())));
    }
}
