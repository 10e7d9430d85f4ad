//! The matrix exponential.

/// `exp(a h)` of an `n` x `n` matrix (rows): scaled to norm 1/2, Taylor to degree 18 (error below 1e-22), squared back
/// (Moler & Van Loan 2003, method 3).
pub(super) fn exponential(a: &[f64], n: usize, h: f64) -> Vec<f64> {
    let norm = (0..n).map(|r| a[r * n..(r + 1) * n].iter().map(|v| (v * h).abs()).sum::<f64>()).fold(0.0, f64::max);
    let squarings = if norm > 0.5 { (norm / 0.5).log2().ceil() as i32 } else { 0 };
    let scaled: Vec<f64> = a.iter().map(|v| v * h / 2f64.powi(squarings)).collect();
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
    sum
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
