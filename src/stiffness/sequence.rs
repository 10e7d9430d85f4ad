//! One stiffness map from many frames.
//!
//! Tissue keeps its moduli while it moves, so frames are measurements of the same numbers. The
//! noise of each frame is its own: means of ln E weighted by the inverse variance lower it, as a
//! joint fit would to first order. What frames have in common (mesh, interfaces, where the surface
//! is) does not fall, and counts for more in frames that move less. Where frames differ by more
//! than both explain, their own part is raised by the root of chi^2 per degree of freedom (Birge
//! 1932).

use crate::types::stiffness::{Gain, RegionStiffness};

/// Least relative standard deviation of one frame.
const MIN_RELATIVE_SD: f64 = 1e-4;

/// Common errors that differ by less than this factor are equal: each is known to about a tenth,
/// and the frame with the least would count alone.
const EQUAL_ERROR_RATIO: f64 = 1.1;

/// What a frame says of a region, and its mean motion (mm).
pub(crate) type Said<'a> = (&'a RegionStiffness, f64);

/// Combines what frames say of one region, in the order given; element 1 of `which` is the ratio, 0
/// the modulus. The last entry holds all frames; empty where none determines the region.
pub(crate) fn combine(frames: &[Said<'_>], which: usize) -> Vec<Gain> {
    let value = |r: &RegionStiffness| [r.youngs_modulus, r.ratio][which];
    let one = |&(r, motion): &Said<'_>| {
        let (value, sd) = [(r.youngs_modulus, r.sd), (r.ratio, r.ratio_sd)][which];
        let data = r.data_sd[which].max(MIN_RELATIVE_SD);
        let model = ((sd / value).powi(2) - data * data).max(0.0).sqrt();
        Frame { log: value.ln(), data, model, weighed_as: model, motion }
    };
    let mut seen: Vec<Frame> = frames.iter().filter(|(r, _)| r.identifiable && value(r) > 0.0).map(one).collect();
    even_out(&mut seen);
    (1..=seen.len()).map(|n| gain(&seen[..n])).collect()
}

/// Puts what the common parts are by the frames' motion in the place of what each frame claims: a
/// power of it from -1 (errors in mm) to 0 (errors in per cent) by least squares of
/// logarithms, and the same for frames that differ by [`EQUAL_ERROR_RATIO`].
fn even_out(frames: &mut [Frame]) {
    let is_known = |v: f64| v.is_finite() && v > 0.0;
    let known: Vec<[f64; 2]> = frames
        .iter()
        .filter(|f| is_known(f.model) && is_known(f.motion))
        .map(|f| [f.motion.ln(), f.model.ln()])
        .collect();
    let mean = |a: usize| known.iter().map(|k| k[a]).sum::<f64>() / known.len().max(1) as f64;
    let middle = [mean(0), mean(1)];
    let moment = |a: usize| known.iter().map(|k| (k[0] - middle[0]) * (k[a] - middle[a])).sum::<f64>();
    let power = (moment(1) / moment(0).max(f64::MIN_POSITIVE)).clamp(-1.0, 0.0);
    for f in frames.iter_mut().filter(|f| is_known(f.model) && is_known(f.motion)) {
        f.model = (middle[1] + power * (f.motion.ln() - middle[0])).exp();
    }
    let least = frames.iter().fold(f64::INFINITY, |m, f| m.min(f.model));
    frames.iter_mut().for_each(|f| f.weighed_as = least.max(f.model / EQUAL_ERROR_RATIO));
}

fn gain(frames: &[Frame]) -> Gain {
    let weights = weights(frames);
    let sum = |f: &dyn Fn(&Frame) -> f64| frames.iter().zip(&weights).map(|(frame, w)| w * f(frame)).sum::<f64>();
    let (log, model) = (sum(&|f| f.log), sum(&|f| f.model));
    let own = frames.iter().zip(&weights).map(|(f, w)| (w * f.data).powi(2)).sum::<f64>();
    // The mean of frames has a part of each one's noise, and what is common moves frames apart
    // where it weighs more in one than in another.
    let off = |f: &Frame, w: f64| {
        let others = (own - (w * f.data).powi(2)).max(0.0);
        let expected = (f.data * (1.0 - w)).powi(2) + others + (f.model - model).powi(2);
        // A frame that is the mean tells nothing of how far it is from it.
        (expected > 1e-6 * f.data * f.data).then(|| (f.log - log).powi(2) / expected)
    };
    let root = |least: f64| {
        let counted: Vec<f64> =
            frames.iter().zip(&weights).filter(|(_, w)| **w >= least).filter_map(|(f, w)| off(f, *w)).collect();
        if counted.is_empty() { 1.0 } else { (counted.iter().sum::<f64>() / counted.len() as f64).sqrt() }
    };
    // Frames that do not count in the mean do not widen it.
    let (disagreement, among) = (root(0.0), root(f64::MIN_POSITIVE));
    let (value, data) = (log.exp(), among.max(1.0) * own.sqrt());
    let weighed = weights.iter().filter(|w| **w > 0.0).count();
    Gain { frames: frames.len(), weighed, value, sd: value * data.hypot(model), data_sd: value * data, disagreement }
}

/// What one frame says of ln E.
#[derive(Clone)]
struct Frame {
    log: f64,
    /// Standard deviation by its own noise, and by what frames have in common (1).
    data: f64,
    model: f64,
    /// The latter as it counts for weights.
    weighed_as: f64,
    /// Mean motion (mm).
    motion: f64,
}

/// Weights (sum 1, none below 0) of the mean with the least variance when noise is each frame's own
/// and the rest is common: `(D + m m^T)^-1 1` (Sherman & Morrison 1950). A frame that moves less
/// knows the common part worse (a voxel at a face is more of its motion), and may be worth nothing
/// beside the others: so no further frame makes the mean worse.
fn weights(frames: &[Frame]) -> Vec<f64> {
    let mut taken = vec![true; frames.len()];
    loop {
        let over = |f: &dyn Fn(&Frame) -> f64| {
            let of =
                frames.iter().zip(&taken).filter(|(_, t)| **t).map(|(frame, _)| f(frame) / (frame.data * frame.data));
            of.sum::<f64>()
        };
        let common = over(&|f| f.weighed_as) / (1.0 + over(&|f| f.weighed_as * f.weighed_as));
        let mut out: Vec<f64> = frames
            .iter()
            .zip(&taken)
            .map(|(f, t)| if *t { (1.0 - common * f.weighed_as) / (f.data * f.data) } else { 0.0 })
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
    use crate::types::stiffness::Determined;

    fn variance(frames: &[Frame], weights: &[f64]) -> f64 {
        let own: f64 = frames.iter().zip(weights).map(|(f, w)| (w * f.data).powi(2)).sum();
        own + frames.iter().zip(weights).map(|(f, w)| w * f.model).sum::<f64>().powi(2)
    }

    #[test]
    fn weights_are_the_best_that_are_not_negative() {
        let mut random = Random::new(3, 1);
        for _ in 0..200 {
            let mut number = || random.normals()[0].abs() + 0.01;
            let one = |_| {
                let (data, model) = (number(), number());
                Frame { log: 0.0, data, model, weighed_as: model, motion: 1.0 }
            };
            let frames: Vec<Frame> = (0..3).map(one).collect();
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

    /// A region that a frame determines to `sd`, by its own noise to `data` (1).
    fn region(value: f64, sd: f64, data: f64) -> RegionStiffness {
        RegionStiffness {
            label: 1,
            name: String::new(),
            youngs_modulus: value,
            sd: value * sd,
            ratio: 1.0,
            ratio_sd: 0.0,
            identifiable: true,
            state: Determined::Determined,
            bound: None,
            volume: 1.0,
            data_sd: [data, 0.0],
        }
    }

    fn combined(said: &[(RegionStiffness, f64)]) -> Vec<Gain> {
        combine(&said.iter().map(|(r, motion)| (r, *motion)).collect::<Vec<_>>(), 0)
    }

    #[test]
    fn frames_that_move_less_do_not_widen_what_is_known() {
        // Own noise and common part grow as the motion shrinks; the first frame moved most.
        let frame = |k: u8| (region(30.0, 0.05 * f64::from(k), 0.01 * f64::from(k)), 1.0 / f64::from(k));
        let gains = combined(&(1..6).map(frame).collect::<Vec<_>>());
        assert!(gains.windows(2).all(|g| g[1].sd <= g[0].sd * (1.0 + 1e-12)), "{gains:?}");
        assert_eq!(gains[4].weighed, 1);
    }

    /// Eight frames of one load, whose claims of the common part differed by a tenth, were those of
    /// the one that claimed the least: the own part fell from 4.2 to 3.0 % and not at all.
    #[test]
    fn frames_of_one_load_all_count() {
        let mut random = Random::new(5, 1);
        let (mut off, mut fell) = (Vec::new(), Vec::new());
        for _ in 0..200 {
            let mut frame = |_| {
                let ([a, b], [c, _]) = (random.normals(), random.normals());
                (region(100.0 * (0.04 * a).exp(), 0.2 * (0.1 * b).exp(), 0.04), 1.1 + 0.001 * c)
            };
            let gains = combined(&(0..8).map(&mut frame).collect::<Vec<_>>());
            assert_eq!((gains[7].frames, gains[7].weighed), (8, 8));
            let part = |g: &Gain| g.data_sd / g.value / g.disagreement.max(1.0);
            fell.push(part(&gains[7]) / part(&gains[0]));
            off.push((gains[7].value / 100.0).ln());
        }
        assert!(fell.iter().all(|f| (f - 8f64.powf(-0.5)).abs() < 1e-9), "{fell:?}");
        let scatter = (off.iter().map(|v| v * v).sum::<f64>() / off.len() as f64).sqrt();
        assert!((scatter / (0.04 / 8f64.sqrt()) - 1.0).abs() < 0.15, "{scatter}");
    }

    /// Two frames of a light load, off by what is common to all but weighs more in them, raised the
    /// deviation of the six before them from 1.4 to 2.1 %.
    #[test]
    fn what_is_common_is_no_disagreement() {
        let mut random = Random::new(6, 1);
        for tenths in -20..=20 {
            let common = f64::from(tenths) / 10.0;
            let mut frame = |motion: f64| {
                let (data, model) = (0.002 / motion, 0.014 / motion);
                let log = common * model + random.normals()[0] * data;
                (region(20.0 * log.exp(), data.hypot(model), data), motion)
            };
            let gains = combined(&[1.1, 1.1, 0.85, 0.85, 0.6, 0.6, 0.35, 0.35].map(&mut frame));
            assert!(gains.windows(2).all(|g| g[1].sd <= 1.05 * g[0].sd), "{gains:?}");
            assert!(gains[7].disagreement < 3.0, "{gains:?}");
            assert!((gains[7].value / 20.0).ln().abs() < 3.0 * gains[7].sd / gains[7].value, "{common} {gains:?}");
        }
    }

    #[test]
    fn frames_that_differ_by_more_than_they_claim_are_believed_less() {
        let gains = combined(&[1.0, 1.1, 0.9, 1.1].map(|v| (region(10.0 * v, 0.02, 0.01), 1.0)));
        assert!(gains[3].disagreement > 5.0 && gains[3].data_sd > 0.25, "{gains:?}");
    }
}
