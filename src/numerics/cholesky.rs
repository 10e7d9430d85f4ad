//! Dense symmetric positive definite systems of any size.

/// The lower triangular factor of a symmetric positive definite matrix.
#[derive(Debug, Clone)]
pub(crate) struct Cholesky {
    n: usize,
    factor: Vec<f64>,
}

impl Cholesky {
    /// Factorises the `n` x `n` matrix `a` (row by row; the lower triangle is read); none when a
    /// pivot is not positive beyond rounding.
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

/// The solution of `a x = b`, `a` symmetric and positive definite (row by row), within `room`
/// (lowest, highest; zero inside): what would go past its limit stops there, and the others are
/// solved for again. None where `a` is not positive definite.
pub fn within(a: &[f64], b: &[f64], room: &[[f64; 2]]) -> Option<Vec<f64>> {
    let n = b.len();
    let mut stopped: Vec<Option<f64>> = vec![None; n];
    loop {
        let (mut left, mut x) = (a.to_vec(), b.to_vec());
        for (k, at) in stopped.iter().enumerate().filter_map(|(k, at)| at.map(|at| (k, at))) {
            for j in 0..n {
                x[j] -= a[j * n + k] * at;
                (left[k * n + j], left[j * n + k]) = (0.0, 0.0);
            }
            left[k * n + k] = 1.0;
        }
        stopped.iter().zip(&mut x).for_each(|(at, x)| *x = at.unwrap_or(*x));
        Cholesky::new(left, n)?.solve(&mut x);
        let mut all = true;
        for ((at, x), [low, high]) in stopped.iter_mut().zip(&x).zip(room) {
            if at.is_none() && !(low..=high).contains(&x) {
                (*at, all) = (Some(x.clamp(*low, *high)), false);
            }
        }
        if all {
            return Some(x);
        }
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

    /// Within its room each unknown is free of force, at a limit it is pushed outwards.
    #[test]
    fn what_would_go_too_far_stops_and_the_others_follow() {
        let a = [4.0, 1.0, 0.5, 1.0, 3.0, -0.7, 0.5, -0.7, 2.0];
        let free = [f64::NEG_INFINITY, f64::INFINITY];
        for b in [[9.0, 1.0, -2.0], [1.0, -8.0, 3.0], [0.5, 0.2, -0.1]] {
            let x = within(&a, &b, &[[-1.0, 1.5], [-1.5, 1.0], free]).unwrap();
            for (k, [low, high]) in [[-1.0, 1.5], [-1.5, 1.0], free].into_iter().enumerate() {
                let push = b[k] - (0..3).map(|j| a[3 * k + j] * x[j]).sum::<f64>();
                assert!((low..=high).contains(&x[k]), "{b:?} {x:?}");
                let stopped = (x[k] == high && push > 0.0) || (x[k] == low && push < 0.0);
                assert!(push.abs() < 1e-12 || stopped, "{b:?} {x:?} {push}");
            }
        }
        assert!(within(&[1.0, 2.0, 2.0, 1.0], &[1.0, 1.0], &[free, free]).is_none());
    }
}
