//! Dense symmetric positive definite systems of any size.

/// The lower triangular factor of a symmetric positive definite matrix.
#[derive(Debug, Clone)]
pub struct Cholesky {
    n: usize,
    factor: Vec<f64>,
}

impl Cholesky {
    /// Factorises the `n` x `n` matrix `a` (row by row; the lower triangle is read); none when a pivot is not positive
    /// beyond rounding.
    pub fn new(mut a: Vec<f64>, n: usize) -> Option<Self> {
        for i in 0..n {
            let (done, rest) = a.split_at_mut(i * n);
            let row = &mut rest[..n];
            for j in 0..i {
                let other = &done[j * n..j * n + j + 1];
                let sum: f64 = (0..j).map(|k| row[k] * other[k]).sum();
                row[j] = (row[j] - sum) / other[j];
            }
            let diagonal = row[i];
            let rest = diagonal - (0..i).map(|k| row[k] * row[k]).sum::<f64>();
            if rest.is_nan() || rest <= 1e-14 * diagonal.abs() || rest <= 0.0 {
                return None;
            }
            row[i] = rest.sqrt();
        }
        Some(Self { n, factor: a })
    }

    /// Solves in place.
    pub fn solve(&self, b: &mut [f64]) {
        let (n, l) = (self.n, &self.factor);
        for i in 0..n {
            let sum: f64 = (0..i).map(|k| l[i * n + k] * b[k]).sum();
            b[i] = (b[i] - sum) / l[i * n + i];
        }
        for i in (0..n).rev() {
            b[i] /= l[i * n + i];
            let v = b[i];
            (0..i).for_each(|k| b[k] -= l[i * n + k] * v);
        }
    }

    /// The inverse of the matrix, row by row.
    pub fn inverse(&self) -> Vec<f64> {
        let mut out = vec![0.0; self.n * self.n];
        for (i, row) in out.chunks_exact_mut(self.n.max(1)).enumerate() {
            row[i] = 1.0;
            self.solve(row);
        }
        out
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_system_is_solved_and_an_indefinite_one_is_not() {
        let a = [4.0, 1.0, -2.0, 1.0, 2.0, 0.0, -2.0, 0.0, 3.0];
        let inverse = Cholesky::new(a.to_vec(), 3).unwrap().inverse();
        for i in 0..3 {
            for j in 0..3 {
                let product: f64 = (0..3).map(|k| a[3 * i + k] * inverse[3 * k + j]).sum();
                assert!((product - f64::from(u8::from(i == j))).abs() < 1e-14);
            }
        }
        assert!(Cholesky::new(vec![1.0, 2.0, 2.0, 1.0], 2).is_none());
        assert!(Cholesky::new(vec![1.0, f64::NAN, f64::NAN, 1.0], 2).is_none());
    }
}
