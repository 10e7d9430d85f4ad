//! Symmetric positive definite band matrices.

/// The lower band of a symmetric matrix: entry (i, j) for `i - width <= j <= i`.
#[derive(Debug, Clone)]
pub(crate) struct Band {
    width: usize,
    rows: Vec<f64>,
}

impl Band {
    /// All zero; `width` is the number of diagonals below the main one.
    pub fn new(size: usize, width: usize) -> Self {
        Self { width, rows: vec![0.0; size * (width + 1)] }
    }

    /// Rows.
    pub fn size(&self) -> usize {
        self.rows.len() / (self.width + 1)
    }

    fn at(&self, i: usize, j: usize) -> usize {
        i * (self.width + 1) + self.width + j - i
    }

    /// Adds to entry (i, j), and so to (j, i); entries above the diagonal are left to their mirror
    /// images.
    pub fn add(&mut self, i: usize, j: usize, value: f64) {
        if j <= i {
            let at = self.at(i, j);
            self.rows[at] += value;
        }
    }

    /// Fixes the unknowns that `fixed` gives a value: their rows and columns become those of the
    /// identity, and what they did to the others goes to the right-hand side.
    pub(crate) fn fix(&mut self, rhs: &mut [f64], fixed: &[Option<f64>]) {
        for i in 0..self.size() {
            for j in i.saturating_sub(self.width)..i {
                let at = self.at(i, j);
                match (fixed[i], fixed[j]) {
                    (None, Some(v)) => rhs[i] -= self.rows[at] * v,
                    (Some(v), None) => rhs[j] -= self.rows[at] * v,
                    (None, None) => continue,
                    (Some(_), Some(_)) => {}
                }
                self.rows[at] = 0.0;
            }
        }
        for (i, v) in fixed.iter().enumerate().filter_map(|(i, v)| Some((i, (*v)?))) {
            let at = self.at(i, i);
            (self.rows[at], rhs[i]) = (1.0, v);
        }
    }

    /// Solves in place by Cholesky's factorisation; false when the matrix is not positive definite.
    pub fn solve(mut self, rhs: &mut [f64]) -> bool {
        let (n, w) = (self.size(), self.width);
        for i in 0..n {
            let first = i.saturating_sub(w);
            for j in first..=i {
                let from = first.max(j.saturating_sub(w));
                let (a, b) = (self.at(i, from), self.at(j, from));
                let length = j - from;
                let sum: f64 = self.rows[a..a + length].iter().zip(&self.rows[b..b + length]).map(|(x, y)| x * y).sum();
                let at = self.at(i, j);
                let rest = self.rows[at] - sum;
                if i == j {
                    let positive = rest > 0.0;
                    if !positive {
                        return false;
                    }
                    self.rows[at] = rest.sqrt();
                } else {
                    self.rows[at] = rest / self.rows[self.at(j, j)];
                }
            }
        }
        for i in 0..n {
            let first = i.saturating_sub(w);
            let row = self.at(i, first);
            let sum: f64 = self.rows[row..row + i - first].iter().zip(&rhs[first..i]).map(|(l, x)| l * x).sum();
            rhs[i] = (rhs[i] - sum) / self.rows[self.at(i, i)];
        }
        for i in (0..n).rev() {
            rhs[i] /= self.rows[self.at(i, i)];
            for j in i.saturating_sub(w)..i {
                rhs[j] -= self.rows[self.at(i, j)] * rhs[i];
            }
        }
        true
    }
}
