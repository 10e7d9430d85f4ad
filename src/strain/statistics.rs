//! What the strain is like over a set of voxels.

use super::{StrainField, measure};
use crate::numerics::statistics::percentile;
use rayon::prelude::*;

/// Mean and spread of the principal strains over a set of voxels.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct StrainStatistics {
    /// Voxels.
    pub voxels: usize,
    /// Mean principal strains, largest first (1).
    pub mean: [f64; 3],
    /// 98th percentile of the largest principal strain and 2nd of the smallest (1).
    pub peak: [f64; 2],
    /// Mean and 98th percentile of the largest shear (E1 - E3) / 2 (1).
    pub shear: [f64; 2],
    /// Mean relative change of volume, det F - 1 (1).
    pub volume_change: f64,
}

impl StrainStatistics {
    /// Over the voxels with these offsets.
    pub fn over(strain: &StrainField, offsets: &[usize]) -> Self {
        let principal: Vec<[f64; 3]> = offsets.par_iter().map(|&o| strain.principal(o)).collect();
        let n = principal.len().max(1) as f64;
        let mean_of = |f: &dyn Fn(&[f64; 3]) -> f64| principal.iter().map(f).sum::<f64>() / n;
        let percentile = |f: &dyn Fn(&[f64; 3]) -> f64, p: f64| {
            let mut values: Vec<f64> = principal.iter().map(f).collect();
            if values.is_empty() { 0.0 } else { percentile(&mut values, p) }
        };
        let shear = |e: &[f64; 3]| (e[0] - e[2]) / 2.0;
        let change = |&o: &usize| measure::volume_change(strain.measure(), &strain.at(o));
        Self {
            voxels: principal.len(),
            mean: std::array::from_fn(|k| mean_of(&|e| e[k])),
            peak: [percentile(&|e| e[0], 98.0), percentile(&|e| e[2], 2.0)],
            shear: [mean_of(&shear), percentile(&shear, 98.0)],
            volume_change: offsets.iter().map(change).sum::<f64>() / n,
        }
    }
}

/// Mean, standard deviation, 5th and 95th percentile of some values (1); NaN of none.
pub fn moments(mut values: Vec<f64>) -> [f64; 4] {
    if values.is_empty() {
        return [f64::NAN; 4];
    }
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let sd = (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt();
    [mean, sd, percentile(&mut values, 5.0), percentile(&mut values, 95.0)]
}
