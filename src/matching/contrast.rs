//! How the intensities of two volumes go together, whatever their contrast.
//!
//! From the joint histogram of voxels that show the same tissue: the mean of one volume's intensity
//! where the other has a given one explains a part of its variance, the correlation ratio (Roche et
//! al. 1998). Of two volumes in one contrast that mean is a rising line, whatever gain and offset.
//! Where it is not, the mean itself brings one volume to the other's contrast.

use crate::numerics::filters;
use crate::numerics::statistics::quantile;

/// Intensity bins of each volume in the joint histogram.
const INTENSITY_BINS: usize = 48;

/// Quantiles of the intensities at the first and the last bin.
const RANGE_QUANTILES: [f64; 2] = [0.005, 0.995];

/// Least number of voxels for each intensity bin.
const MIN_VOXELS_PER_BIN: usize = 8;

/// The joint histogram of two volumes.
#[derive(Debug, Clone)]
pub(crate) struct Relation {
    /// Share of the voxels with each pair of intensities, those of the first volume fastest.
    joint: Vec<f64>,
    /// Lowest and highest intensity of the two.
    ranges: [[f32; 2]; 2],
}

/// Which volume is brought to the other's contrast.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Side {
    /// The initial one.
    Initial,
    /// The deformed one.
    Deformed,
}

impl Side {
    fn other(self) -> Self {
        if self == Self::Initial { Self::Deformed } else { Self::Initial }
    }
}

impl Relation {
    /// From the intensities of the two volumes at the same tissue; those that are not finite are
    /// left out. None where there are too few, or all alike.
    pub fn of(pairs: impl Iterator<Item = [f32; 2]>) -> Option<Self> {
        let pairs: Vec<[f32; 2]> = pairs.filter(|p| p[0].is_finite() && p[1].is_finite()).collect();
        if pairs.len() < MIN_VOXELS_PER_BIN * INTENSITY_BINS {
            return None;
        }
        let range = |c: usize| {
            let mut values: Vec<f32> = pairs.iter().map(|p| p[c]).collect();
            RANGE_QUANTILES.map(|q| quantile(&mut values, q))
        };
        let ranges = [range(0), range(1)];
        if ranges.iter().any(|[low, high]| high.partial_cmp(low) != Some(std::cmp::Ordering::Greater)) {
            return None;
        }
        let mut counts = vec![0.0f32; INTENSITY_BINS * INTENSITY_BINS];
        for pair in &pairs {
            let [a, b] = std::array::from_fn(|c| bin(ranges[c], pair[c]).round() as usize);
            counts[a + INTENSITY_BINS * b] += 1.0;
        }
        let smooth = filters::gaussian(&counts, [INTENSITY_BINS, INTENSITY_BINS, 1], [1.0, 1.0, 0.0]);
        let all: f64 = smooth.iter().map(|v| f64::from(*v)).sum();
        Some(Self { joint: smooth.iter().map(|v| f64::from(*v) / all).collect(), ranges })
    }

    /// The share of the voxels with each of the intensities of the volume that tells, and the mean
    /// of the other one there.
    fn means(&self, explained: Side) -> ([f64; INTENSITY_BINS], [f64; INTENSITY_BINS]) {
        let (mut share, mut mean) = ([0.0; INTENSITY_BINS], [0.0; INTENSITY_BINS]);
        for (at, p) in self.joint.iter().enumerate() {
            let (first, second) = (at % INTENSITY_BINS, at / INTENSITY_BINS);
            let (from, to) = if explained == Side::Initial { (second, first) } else { (first, second) };
            share[from] += p;
            mean[from] += p * to as f64;
        }
        for (m, s) in mean.iter_mut().zip(share) {
            *m /= s.max(f64::MIN_POSITIVE);
        }
        (share, mean)
    }

    /// The part of the initial volume's variance that the deformed one explains, and the other way
    /// round (0 to 1).
    pub fn explained(&self) -> [f64; 2] {
        let variance = |share: &[f64; INTENSITY_BINS], values: &[f64; INTENSITY_BINS]| {
            let moment = |power: i32| share.iter().zip(values).map(|(s, v)| s * v.powi(power)).sum::<f64>();
            moment(2) - moment(1).powi(2)
        };
        let bins = std::array::from_fn(|i| i as f64);
        [Side::Initial, Side::Deformed].map(|side| {
            let ((share, mean), (own, _)) = (self.means(side), self.means(side.other()));
            variance(&share, &mean) / variance(&own, &bins).max(f64::MIN_POSITIVE)
        })
    }

    /// The larger of the two.
    pub fn most(&self) -> f64 {
        let [initial, deformed] = self.explained();
        initial.max(deformed)
    }

    /// The part that a straight rising line explains, either way round: one contrast, whatever its
    /// gain and offset. Negative where the line falls (-1 to 1).
    pub(crate) fn explained_by_gain(&self) -> f64 {
        let mean = |v: &dyn Fn(usize) -> f64| self.joint.iter().enumerate().map(|(at, p)| p * v(at)).sum::<f64>();
        let (first, second) = (|at: usize| (at % INTENSITY_BINS) as f64, |at: usize| (at / INTENSITY_BINS) as f64);
        let (a, b) = (mean(&first), mean(&second));
        let covariance = mean(&|at| (first(at) - a) * (second(at) - b));
        let variances = [mean(&|at| (first(at) - a).powi(2)), mean(&|at| (second(at) - b).powi(2))];
        covariance * covariance.abs() / (variances[0] * variances[1]).max(f64::MIN_POSITIVE)
    }

    /// The side that the other explains more of.
    pub fn side(&self) -> Side {
        let [initial, deformed] = self.explained();
        // What tells more of the other is brought to its contrast.
        if initial > deformed { Side::Deformed } else { Side::Initial }
    }

    /// Intensities of the volume `side` as the other one has them.
    pub fn recast(&self, side: Side, values: &mut [f32]) {
        let (own, other) = match side {
            Side::Initial => (self.ranges[0], self.ranges[1]),
            Side::Deformed => (self.ranges[1], self.ranges[0]),
        };
        let (_, mean) = self.means(side.other());
        let scale = f64::from(other[1] - other[0]) / (INTENSITY_BINS - 1) as f64;
        for v in values.iter_mut().filter(|v| v.is_finite()) {
            let at = bin(own, *v);
            let low = (at as usize).min(INTENSITY_BINS - 2);
            let part = f64::from(at) - low as f64;
            let there = (1.0 - part) * mean[low] + part * mean[low + 1];
            *v = (f64::from(other[0]) + scale * there) as f32;
        }
    }
}

/// Which bin an intensity falls into.
fn bin([low, high]: [f32; 2], v: f32) -> f32 {
    ((v - low) / (high - low) * (INTENSITY_BINS - 1) as f32).clamp(0.0, (INTENSITY_BINS - 1) as f32)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::numerics::random::Random;

    fn pairs(of: impl Fn(f32) -> f32) -> Vec<[f32; 2]> {
        let mut random = Random::new(1, 1);
        let value = |_| {
            let [a, b] = random.normals();
            let v = 500.0 + 150.0 * a as f32;
            [v, of(v) + 5.0 * b as f32]
        };
        (0..20_000).map(value).collect()
    }

    #[test]
    fn a_gain_is_one_contrast_and_all_else_is_another() {
        let gain = Relation::of(pairs(|v| 3.0 * v - 200.0).into_iter()).unwrap();
        assert!(gain.explained().into_iter().all(|v| v > 0.97 && v - gain.explained_by_gain() < 0.02));
        let falling = Relation::of(pairs(|v| 2000.0 - v).into_iter()).unwrap();
        assert!(falling.explained()[0] > 0.97 && falling.explained_by_gain() < -0.96);
        let steep = Relation::of(pairs(|v| v.max(0.0).powi(4) * 1e-8).into_iter()).unwrap();
        assert!(steep.explained()[1] > steep.explained_by_gain() + 0.05);
    }

    /// Where two intensities of one volume are one of the other, the first tells the second.
    #[test]
    fn the_volume_that_tells_the_other_is_recast() {
        let folded = Relation::of(pairs(|v| (v - 500.0).abs()).into_iter()).unwrap();
        assert_eq!(folded.side(), Side::Initial);
        let mut values = [350.0, 500.0, 700.0, f32::NAN];
        folded.recast(Side::Initial, &mut values);
        for (found, wanted) in values.into_iter().zip([150.0, 0.0, 200.0]) {
            // About the width of a bin.
            assert!((found - wanted).abs() < 20.0, "{values:?}");
        }
        assert!(values[3].is_nan());
    }

    #[test]
    fn too_few_or_equal_voxels_have_no_relation() {
        assert!(Relation::of(pairs(|v| v).into_iter().take(300)).is_none());
        assert!(Relation::of(pairs(|_| 3.0).into_iter().map(|[a, _]| [a, 7.0])).is_none());
    }
}
