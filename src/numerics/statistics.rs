//! Order statistics.

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
