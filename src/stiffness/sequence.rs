//! One stiffness map from many frames.
//!
//! Tissue keeps its moduli while it moves, so frames are measurements of the same numbers. The noise of each frame is its own:
//! means of ln E weighted by the inverse variance lower it, as a joint fit would to first order. What frames have in common
//! (mesh, interfaces, where the surface is) does not fall, and counts for more in frames that move less. Where frames differ by more than they claim, their part is raised by the root
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
        let model = ((sd / value).powi(2) - data * data).max(0.0).sqrt();
        Frame { log: value.ln(), data, model }
    };
    let all: Vec<Frame> = frames.iter().map(one).collect();
    let weight: f64 = all.iter().map(|f| f.data.powi(-2)).sum();
    let by_noise = all.iter().map(|f| f.data.powi(-2) * f.log).sum::<f64>() / weight;
    let chi2: f64 = all.iter().map(|f| ((f.log - by_noise) / f.data).powi(2)).sum();
    let freedom = (all.len() - 1).max(1) as f64;
    let disagreement = if all.len() > 1 { (chi2 / freedom).sqrt() } else { 1.0 };
    let weights = weights(&all);
    let sum = |f: &dyn Fn(&Frame) -> f64| all.iter().zip(&weights).map(|(frame, w)| w * f(frame)).sum::<f64>();
    let data = disagreement.max(1.0) * all.iter().zip(&weights).map(|(f, w)| (w * f.data).powi(2)).sum::<f64>().sqrt();
    let value = sum(&|f| f.log).exp();
    let model = sum(&|f| f.model);
    Gain { frames: all.len(), value, sd: value * data.hypot(model), data_sd: value * data, disagreement }
}

/// What one frame says of ln E.
struct Frame {
    log: f64,
    /// Standard deviation by its own noise, and by what frames have in common (1).
    data: f64,
    model: f64,
}

/// Weights (sum 1, none below 0) of the mean with the least variance when noise is each frame's own and the rest is common:
/// `(D + m m^T)^-1 1` (Sherman & Morrison 1950). A frame that moves less knows the common part worse (a voxel at a face is more of its
/// motion), and may be worth nothing beside the others: so no further frame makes the mean worse.
fn weights(frames: &[Frame]) -> Vec<f64> {
    let mut taken = vec![true; frames.len()];
    loop {
        let over = |f: &dyn Fn(&Frame) -> f64| {
            let of =
                frames.iter().zip(&taken).filter(|(_, t)| **t).map(|(frame, _)| f(frame) / (frame.data * frame.data));
            of.sum::<f64>()
        };
        let common = over(&|f| f.model) / (1.0 + over(&|f| f.model * f.model));
        let mut out: Vec<f64> = frames
            .iter()
            .zip(&taken)
            .map(|(f, t)| if *t { (1.0 - common * f.model) / (f.data * f.data) } else { 0.0 })
            .collect();
        let least = (0..out.len()).min_by(|&a, &b| out[a].total_cmp(&out[b]));
        match least.filter(|&k| out[k] < 0.0) {
            Some(k) => taken[k] = false,
            None => {
                let sum: f64 = out.iter().sum();
                out.iter_mut().for_each(|w| *w /= sum);
                return out;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::numerics::random::Random;

    fn variance(frames: &[Frame], weights: &[f64]) -> f64 {
        let own: f64 = frames.iter().zip(weights).map(|(f, w)| (w * f.data).powi(2)).sum();
        own + frames.iter().zip(weights).map(|(f, w)| w * f.model).sum::<f64>().powi(2)
    }

    #[test]
    fn weights_are_the_best_that_are_not_negative() {
        let mut random = Random::new(3, 1);
        for _ in 0..200 {
            let mut number = || random.normals()[0].abs() + 0.01;
            let frames: Vec<Frame> = (0..3).map(|_| Frame { log: 0.0, data: number(), model: number() }).collect();
            let found = weights(&frames);
            assert!((found.iter().sum::<f64>() - 1.0).abs() < 1e-12 && found.iter().all(|w| *w >= 0.0), "{found:?}");
            // By brute force on a triangle of weights.
            let steps = 60;
            let tried = (0..=steps).flat_map(|a| (0..=steps - a).map(move |b| [a, b, steps - a - b]));
            let least =
                tried.map(|w| variance(&frames, &w.map(|v| v as f64 / steps as f64))).fold(f64::INFINITY, f64::min);
            assert!(variance(&frames, &found) <= 1.0001 * least, "{} for {least}", variance(&frames, &found));
        }
    }

    #[test]
    fn frames_that_move_less_do_not_widen_what_is_known() {
        // Own noise and common part grow as the motion shrinks; the first frame moved most.
        let frames: Vec<RegionStiffness> = (1..6)
            .map(|k| RegionStiffness {
                label: 1,
                name: String::new(),
                youngs_modulus: 30.0,
                sd: 30.0 * 0.05 * f64::from(k),
                ratio: 1.0,
                ratio_sd: 0.0,
                identifiable: true,
                bound: None,
                volume: 1.0,
                data_sd: [0.01 * f64::from(k), 0.0],
            })
            .collect();
        let gains = combine(&frames.iter().collect::<Vec<_>>(), 0);
        assert!(gains.windows(2).all(|g| g[1].sd <= g[0].sd * (1.0 + 1e-12)), "{gains:?}");
    }
}
