//! The matrix exponential.

/// `exp(a h)` of an `n` x `n` matrix (rows): balanced, scaled to norm 1/2, Taylor to degree 18
/// (error below 1e-22), squared back (Moler & Van Loan 2003, method 3).
pub(super) fn exponential(a: &[f64], n: usize, h: f64) -> Vec<f64> {
    let (size, balanced) = balanced(a, n, h);
    let norm = norm(&balanced, n);
    let squarings = if norm > 0.5 { (norm / 0.5).log2().ceil() as i32 } else { 0 };
    let scaled: Vec<f64> = balanced.iter().map(|v| v / 2f64.powi(squarings)).collect();
    let mut sum = identity(n);
    for k in (1..=18).rev() {
        // Horner: 1 + x/k (...).
        let mut next = product(&scaled, &sum, n);
        next.iter_mut().for_each(|v| *v /= f64::from(k));
        (0..n).for_each(|i| next[i * n + i] += 1.0);
        sum = next;
    }
    for _ in 0..squarings {
        sum = product(&sum, &sum, n);
    }
    (0..n * n).map(|at| sum[at] * size[at / n] / size[at % n]).collect()
}

/// Part of all by which rounding alone may be off in `exp(a h)`: each squaring doubles it.
pub(super) fn rounding(a: &[f64], n: usize, h: f64) -> f64 {
    f64::EPSILON * norm(&balanced(a, n, h).1, n).max(1.0)
}

/// `a h` in quantities of [`balance`]d sizes, and these sizes.
fn balanced(a: &[f64], n: usize, h: f64) -> (Vec<f64>, Vec<f64>) {
    let scaled: Vec<f64> = a.iter().map(|v| v * h).collect();
    let size = balance(&scaled, n);
    let balanced = (0..n * n).map(|at| scaled[at] * size[at % n] / size[at / n]).collect();
    (size, balanced)
}

fn norm(a: &[f64], n: usize) -> f64 {
    a.chunks_exact(n).map(|row| row.iter().map(|v| v.abs()).sum::<f64>()).fold(0.0, f64::max)
}

/// Size to which a row or column without a counterpart is scaled: an integral, which nothing
/// depends on, or a constant.
const UNCOUPLED_SIZE: f64 = 0.0625;

/// Sizes (powers of two) of the quantities for which rows and columns of `a` are about as large as
/// each other (Parlett & Reinsch 1969): else stresses of gigapascals over layers of micrometres set
/// the number of squarings, and rates that matter are lost in rounding.
fn balance(a: &[f64], n: usize) -> Vec<f64> {
    let mut size = vec![1.0f64; n];
    for _ in 0..60 {
        let mut changed = false;
        for i in 0..n {
            let others = || (0..n).filter(move |&j| j != i);
            let row: f64 = others().map(|j| (a[i * n + j] * size[j] / size[i]).abs()).sum();
            let column: f64 = others().map(|j| (a[j * n + i] * size[i] / size[j]).abs()).sum();
            let factor = match (row > 0.0, column > 0.0) {
                (true, true) => (row / column).sqrt(),
                (true, false) => row / UNCOUPLED_SIZE,
                (false, true) => UNCOUPLED_SIZE / column,
                (false, false) => 1.0,
            };
            let power = factor.log2().round();
            if power != 0.0 && power.is_finite() {
                size[i] *= power.clamp(-200.0, 200.0).exp2();
                changed = true;
            }
        }
        if !changed {
            break;
        }
    }
    size
}

fn identity(n: usize) -> Vec<f64> {
    (0..n * n).map(|i| f64::from(u8::from(i % (n + 1) == 0))).collect()
}

fn product(a: &[f64], b: &[f64], n: usize) -> Vec<f64> {
    let mut out = vec![0.0; n * n];
    for (row, out) in a.chunks_exact(n).zip(out.chunks_exact_mut(n)) {
        for (v, b) in row.iter().zip(b.chunks_exact(n)) {
            out.iter_mut().zip(b).for_each(|(o, b)| *o += v * b);
        }
    }
    out
}
