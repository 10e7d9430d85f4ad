//! One stiffness map from many frames.
//!
//! Tissue keeps its moduli while it moves, so frames are measurements of the same numbers. The noise of each frame is its own:
//! means of ln E weighted by the inverse variance lower it, as a joint fit would to first order. What frames have in common
//! (mesh, interfaces, where the surface is) does not fall. Where frames differ by more than they claim, their part is raised by the root
//! of chi^2 per degree of freedom (Birge 1932).

use crate::types::stiffness::{Gain, RegionStiffness};

/// Least relative standard deviation of one frame that is believed.
const LEAST: f64 = 1e-4;

/// Combines what frames say of one region, in the order given; element 1 of `which` is the ratio, 0 the modulus. The last
/// entry holds all frames; empty where none determines the region.
pub fn combine(frames: &[&RegionStiffness], which: usize) -> Vec<Gain> {
    let value = |r: &RegionStiffness| [r.youngs_modulus, r.ratio][which];
    let seen: Vec<&&RegionStiffness> = frames.iter().filter(|r| r.identifiable && value(r) > 0.0).collect();
    (1..=seen.len()).map(|n| gain(&seen[..n], which)).collect()
}

fn gain(frames: &[&&RegionStiffness], which: usize) -> Gain {
    let one = |r: &&&RegionStiffness| {
        let (value, sd) = [(r.youngs_modulus, r.sd), (r.ratio, r.ratio_sd)][which];
        let data = r.data_sd[which].max(LEAST);
        let model = ((sd / value).powi(2) - data * data).max(0.0);
        (value.ln(), data.powi(-2), model)
    };
    let all: Vec<(f64, f64, f64)> = frames.iter().map(one).collect();
    let weight: f64 = all.iter().map(|a| a.1).sum();
    let mean = all.iter().map(|a| a.1 * a.0).sum::<f64>() / weight;
    let model = all.iter().map(|a| a.1 * a.2).sum::<f64>() / weight;
    let chi2: f64 = all.iter().map(|a| a.1 * (a.0 - mean).powi(2)).sum();
    let freedom = (all.len() - 1).max(1) as f64;
    let disagreement = if all.len() > 1 { (chi2 / freedom).sqrt() } else { 1.0 };
    let data = disagreement.max(1.0) / weight.sqrt();
    let value = mean.exp();
    Gain { frames: all.len(), value, sd: value * (data * data + model).sqrt(), data_sd: value * data, disagreement }
}
