//! Order statistics and robust spread.

/// The value at fraction `q` (0 to 1) of the sorted order (nearest rank); NaN for no values. Reorders its input.
pub fn quantile(values: &mut [f32], q: f64) -> f32 {
    if values.is_empty() {
        return f32::NAN;
    }
    let at = ((values.len() - 1) as f64 * q).round() as usize;
    *values.select_nth_unstable_by(at, f32::total_cmp).1
}

/// Median; NaN for no values. Reorders its input.
pub fn median(values: &mut [f32]) -> f32 {
    quantile(values, 0.5)
}

/// The `q`-th percentile (0 to 100) with linear interpolation between order statistics, as numpy does by default.
///
/// Reorders `values`; NaN sorts last. An empty slice gives NaN.
pub fn percentile(values: &mut [f64], q: f64) -> f64 {
    if values.is_empty() {
        return f64::NAN;
    }
    let rank = (q / 100.0).clamp(0.0, 1.0) * (values.len() - 1) as f64;
    let (low, t) = (rank.floor() as usize, rank.fract());
    let (_, &mut a, above) = values.select_nth_unstable_by(low, f64::total_cmp);
    match above.iter().copied().min_by(f64::total_cmp) {
        Some(b) if t > 0.0 => a + t * (b - a),
        _ => a,
    }
}

/// Standard deviation of white noise in a volume, from second differences along each row (voxels).
///
/// The median absolute value of `v[i-1] - 2 v[i] + v[i+1]` over 0.6745 sqrt(6): smooth structure drops out, edges are
/// a minority that the median ignores. At most about a million places are read.
pub fn noise_sigma(data: &[f32], shape: [usize; 3], keep: impl Fn(usize) -> bool) -> f32 {
    let nx = shape[0];
    let stride = (data.len() / 1_000_000).max(1) | 1;
    let mut d: Vec<f32> = (1..data.len().saturating_sub(1))
        .step_by(stride)
        .filter(|&i| i % nx != 0 && (i + 1) % nx != 0 && keep(i))
        .map(|i| (data[i - 1] - 2.0 * data[i] + data[i + 1]).abs())
        .filter(|v| v.is_finite())
        .collect();
    if d.is_empty() { 0.0 } else { median(&mut d) / (0.6745 * 6f32.sqrt()) }
}
