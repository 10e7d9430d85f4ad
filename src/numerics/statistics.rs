//! Order statistics and robust spread.

/// The value at fraction `q` (0 to 1) of the sorted order (nearest rank); NaN for no values.
/// Reorders its input.
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

/// The finite ones of at most about 100,000 of the values, evenly.
pub fn sampled(values: &[f32]) -> Vec<f32> {
    values.iter().step_by(values.len() / 100_000 + 1).copied().filter(|v| v.is_finite()).collect()
}

/// Standard deviation of all values, 0 for none.
pub fn deviation(values: impl Iterator<Item = f32> + Clone) -> f64 {
    let count = values.clone().count().max(1) as f64;
    let mean = values.clone().map(f64::from).sum::<f64>() / count;
    (values.map(|v| (f64::from(v) - mean).powi(2)).sum::<f64>() / count).sqrt()
}

/// Robust standard deviation (1.4826 times the median distance from the median); NaN for no values.
pub(crate) fn robust_deviation(values: impl Iterator<Item = f64>) -> f64 {
    let mut off: Vec<f32> = values.map(|v| v as f32).collect();
    let middle = median(&mut off);
    off.iter_mut().for_each(|v| *v = (*v - middle).abs());
    1.4826 * f64::from(median(&mut off))
}

/// Whether number `i` is among the `share` (1) that stands for all: multiples of the golden ratio,
/// which meet rows and slices alike.
pub(crate) fn stands_for_all(i: usize, share: f64) -> bool {
    const GOLDEN: f64 = 0.618_033_988_749_894_9;
    (i as f64 * GOLDEN).fract() < share
}

/// The `q`-th percentile (0 to 100) with linear interpolation between order statistics, as numpy
/// does by default.
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

/// Spearman's rank correlation of two lists of one length (-1 to 1); equal values share their mean
/// rank. None of fewer than two, or where a list holds one value.
pub(crate) fn rank_correlation(a: &[f64], b: &[f64]) -> Option<f64> {
    let ranks = |v: &[f64]| -> Vec<f64> {
        let below = |x: f64| v.iter().filter(|w| **w < x).count() as f64;
        let equal = |x: f64| v.iter().filter(|w| **w == x).count() as f64;
        let middle = (v.len() as f64 - 1.0) / 2.0;
        v.iter().map(|&x| below(x) + (equal(x) - 1.0) / 2.0 - middle).collect()
    };
    let (a, b) = (ranks(a), ranks(b));
    let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let size = (product(&a, &a) * product(&b, &b)).sqrt();
    (size > 0.0).then(|| product(&a, &b) / size)
}

/// Standard deviation of white noise in a volume, from second differences along every thick axis at
/// once.
///
/// The median absolute value of the `(1, -2, 1)` products over 0.6745 times their norm (Immerkaer
/// 1996, with the median for robustness): smooth structure and straight edges drop out. At most
/// about 300,000 places are read.
pub fn noise_sigma(data: &[f32], shape: [usize; 3], keep: impl Fn(usize) -> bool) -> f32 {
    let stride = [1, shape[0], shape[0] * shape[1]];
    let thick: Vec<usize> = (0..3).filter(|&a| shape[a] > 2).collect();
    let stencil = second_differences(&thick, &stride);
    let reach = thick.iter().map(|&a| stride[a]).sum::<usize>();
    let every = (data.len() / 300_000).max(1) | 1;
    let inner = |a: usize| if shape[a] > 2 { 1..shape[a] - 1 } else { 0..shape[a] };
    let rows = inner(2).flat_map(|k| inner(1).map(move |j| k * stride[2] + j * stride[1]));
    let voxels = rows.flat_map(|row| {
        let (first, end) = (row + inner(0).start, row + inner(0).end);
        (first.next_multiple_of(every)..end).step_by(every)
    });
    let mut d: Vec<f32> = voxels
        .filter(|&i| keep(i))
        .map(|i| {
            let from = &data[i - reach..=i + reach];
            stencil.iter().map(|&(at, weight)| weight * from[at]).sum::<f32>().abs()
        })
        .filter(|v| v.is_finite())
        .collect();
    if d.is_empty() { 0.0 } else { median(&mut d) / (0.6745 * 6f32.sqrt().powi(thick.len() as i32)) }
}

/// `(1, -2, 1)` along each of `axes`: places from the first to the last, and their weights.
fn second_differences(axes: &[usize], stride: &[usize; 3]) -> Vec<(usize, f32)> {
    axes.iter().fold(vec![(0, 1.0)], |all, &a| {
        let along = [(0, 1.0), (stride[a], -2.0), (2 * stride[a], 1.0)];
        all.iter().flat_map(|&(at, weight)| along.map(|(step, w)| (at + step, w * weight))).collect()
    })
}
