//! Whether a difference in brightness between the volumes is taken out, and the sentence about it.

use crate::matching::brightness::Brightness;
use crate::matching::levels::Aligned;
use crate::matching::pair::Pair;
use crate::numerics::ablation;
use crate::pipeline::bodies::Bodies;

/// Largest residuals with which a brightness correction is accepted; `REGISTERED` under a motion,
/// `AT_REST` before the motion is known.
struct Acceptance {
    /// Residual over the whole difference: of 82 pairs those without a bias kept 0.75 to 1.0 on the
    /// coarsest level, those with 15 % 0.09 to 0.56.
    residual: f64,
    /// Residual of place and contrast together over that of the better one alone: a bias alone
    /// leaves 0.76 to 1.08, another contrast 0.08 to 0.8.
    joint: f64,
}

const REGISTERED: Acceptance = Acceptance { residual: 0.6, joint: 0.95 };

/// Stricter, as motion shows too and passes for contrast: the looser limits raised the errors of
/// sliding calves by 12 % (residual 0.32) and 30 % (joint 0.95).
const AT_REST: Acceptance = Acceptance { residual: 0.2, joint: 0.7 };

/// Largest part of the variation between neighbours ([`Brightness::uneven`]) that may remain: 0.03
/// to 0.56 for smooth fields, 0.42 to 15 for steps, whose polynomials do harm.
const MAX_STEP_RATIO: f64 = 0.4;

/// Difference in brightness below which it is ignored (logarithm, robust standard deviation over
/// blocks).
const MIN_DIFFERENCE_LOG: f64 = 0.005;

/// The difference as far as it is known.
#[derive(Default)]
pub(super) struct Light {
    taken: Option<Brightness>,
    /// Found last and not taken.
    left: Option<Brightness>,
}

impl Light {
    /// The pair of a level, with what is known taken out.
    pub fn level<'a>(&self, aligned: &'a Aligned<'_>, factor: [usize; 3]) -> Pair<'a> {
        self.out_of(aligned.level(factor), factor)
    }

    /// The same inside another mask on the initial volume's grid.
    pub(crate) fn level_within<'a>(&self, aligned: &'a Aligned<'_>, mask: &[u8], factor: [usize; 3]) -> Pair<'a> {
        self.out_of(aligned.level_within(mask, factor), factor)
    }

    fn out_of<'a>(&self, mut pair: Pair<'a>, factor: [usize; 3]) -> Pair<'a> {
        if let Some(taken) = &self.taken {
            pair.even_out(taken, factor);
        }
        pair
    }

    /// Whether no level had tissue enough to look at.
    pub(crate) fn is_unknown(&self) -> bool {
        self.taken.is_none() && self.left.is_none()
    }

    /// Looks on a level of `factor` under `motion`, on it, for what differs between the volumes as
    /// they are, and takes that out of `pair` in place of what was known before. Whether `pair` is
    /// another now.
    pub fn look<'a>(
        &mut self,
        pair: &mut Pair<'a>,
        (aligned, factor): (&'a Aligned<'_>, [usize; 3]),
        motion: &Bodies,
    ) -> bool {
        self.judge(pair, (aligned, factor), motion, &REGISTERED)
    }

    /// The same before the motion is known.
    pub(crate) fn look_at_rest<'a>(
        &mut self,
        pair: &mut Pair<'a>,
        (aligned, factor): (&'a Aligned<'_>, [usize; 3]),
        still: &Bodies,
    ) -> bool {
        self.judge(pair, (aligned, factor), still, &AT_REST)
    }

    fn judge<'a>(
        &mut self,
        pair: &mut Pair<'a>,
        (aligned, factor): (&'a Aligned<'_>, [usize; 3]),
        motion: &Bodies,
        limits: &Acceptance,
    ) -> bool {
        let before = self.taken.take();
        let was_taken = before.is_some();
        if was_taken {
            pair.put(aligned.deformed(factor));
        }
        let warped = motion.warp(pair, &pair.spans);
        let found = Brightness::measure(pair, (factor, aligned.shape()), &warped, |p| motion.at(p), limits.joint);
        let matters = |b: &Brightness| {
            ablation::is_on("brightness")
                && b.deviation[0] > MIN_DIFFERENCE_LOG
                && explains(b, limits.residual)
                && b.uneven <= MAX_STEP_RATIO
        };
        match found {
            Some(found) if matters(&found) => self.taken = Some(found),
            Some(found) => self.left = Some(found),
            None => self.taken = before,
        }
        if let Some(taken) = &self.taken {
            pair.even_out(taken, factor);
        }
        was_taken || self.taken.is_some()
    }

    /// What was done, in words.
    pub fn why(&self) -> Option<String> {
        let found = self.taken.as_ref().or(self.left.as_ref())?;
        let [before, after] = found.deviation.map(|d| 100.0 * d.exp_m1());
        if self.taken.is_none() {
            let step = if found.uneven > MAX_STEP_RATIO && explains(found, REGISTERED.residual) {
                " (it is not smooth: a step, or other tissue)"
            } else {
                ""
            };
            return Some(format!(
                "brightness: {before:.1} % of difference in blocks, {after:.1} % without what place or another contrast explains of it; left as it is{step}"
            ));
        }
        let place =
            found.is_of_place().then(|| format!("by place (a factor of {:.2} across the tissue)", found.variation));
        let tone = found.is_of_tone().then(|| "by contrast".to_string());
        let how: Vec<String> = place.into_iter().chain(tone).collect();
        Some(format!(
            "brightness: it differs {}; taken out of the deformed volume ({before:.1} % of difference in blocks before, {after:.1} % after)",
            how.join(" and ")
        ))
    }
}

/// Whether no more than a part is left of the difference.
fn explains(found: &Brightness, leaves: f64) -> bool {
    found.deviation[1] <= leaves * found.deviation[0]
}
