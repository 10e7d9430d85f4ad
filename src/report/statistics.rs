//! Quantiles and histograms of many values.

use crate::types::Mask;

/// Numbers taken at most: enough for a picture (a part of them is known to 0.2 %), cheap for any
/// volume.
const MAX_SAMPLES: usize = 50_000;

/// Offsets of the voxels inside `mask` (all of `len` without one), evenly thinned to at most
/// 50,000.
pub fn sample(len: usize, mask: Option<&Mask>) -> Vec<usize> {
    match mask.map(Mask::as_slice) {
        Some(mask) => {
            let inside = mask.iter().filter(|m| **m > 0).count();
            let offsets = mask.iter().enumerate().filter(|(_, m)| **m > 0).map(|(at, _)| at);
            offsets.step_by(inside.div_ceil(MAX_SAMPLES).max(1)).collect()
        }
        None => (0..len).step_by(len.div_ceil(MAX_SAMPLES).max(1)).collect(),
    }
}

/// The value below which the fraction `q` (0 to 1) of the finite `values` lies; 0 when there is
/// none.
///
/// ```
/// use palpate::report::statistics::quantile;
/// assert_eq!(quantile([4.0, 1.0, f64::NAN, 3.0], 0.5), 3.0);
/// ```
pub fn quantile(values: impl IntoIterator<Item = f64>, q: f64) -> f64 {
    let mut v: Vec<f64> = values.into_iter().filter(|x| x.is_finite()).collect();
    if v.is_empty() {
        return 0.0;
    }
    let at = (q.clamp(0.0, 1.0) * (v.len() - 1) as f64).round() as usize;
    *v.select_nth_unstable_by(at, f64::total_cmp).1
}

/// Counts in equal bins between `low` and `high`; what lies outside counts in the end bins, NaN
/// nowhere.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Histogram {
    /// Lower edge of the first bin.
    pub low: f64,
    /// Upper edge of the last bin.
    pub high: f64,
    /// How many values fell in each.
    pub counts: Vec<usize>,
}

impl Histogram {
    /// Counts `values` in `bins` bins.
    pub fn new(values: impl IntoIterator<Item = f64>, low: f64, high: f64, bins: usize) -> Self {
        let mut counts = vec![0; bins.max(1)];
        let (last, width) = (counts.len() - 1, (high - low).max(f64::MIN_POSITIVE));
        for v in values.into_iter().filter(|v| !v.is_nan()) {
            let bin = (v - low) / width * (last + 1) as f64;
            counts[(bin.max(0.0) as usize).min(last)] += 1;
        }
        Self { low, high, counts }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_of_a_known_list() {
        let v = || (0..=100).rev().map(f64::from);
        assert_eq!(quantile(v(), 0.5), 50.0);
        assert_eq!(quantile(v(), 0.99), 99.0);
        assert_eq!(quantile([f64::NAN, 3.0], 1.0), 3.0);
        assert_eq!(quantile([], 0.5), 0.0);
    }

    #[test]
    fn every_finite_value_is_counted_once() {
        let h = Histogram::new([-5.0, 0.0, 0.49, 0.5, 1.0, 9.0, f64::NAN], 0.0, 1.0, 2);
        assert_eq!(h.counts, vec![3, 3]);
    }

    #[test]
    fn thinning_keeps_the_whole_range() {
        let s = sample(1_000_000, None);
        assert!(s.len() <= MAX_SAMPLES && s.len() > MAX_SAMPLES / 2 && s[s.len() - 1] > 990_000);
    }
}
