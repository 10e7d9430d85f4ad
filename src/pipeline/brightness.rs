//! Whether a difference in brightness between the volumes is taken out, and the sentence about it.

use crate::matching::brightness::Brightness;
use crate::matching::levels::Aligned;
use crate::matching::pair::Pair;
use crate::numerics::ablation;
use crate::pipeline::bodies::Bodies;

/// What may be left of the difference, as a part of it, for the rest to be taken out. Of 82 pairs
/// of all kinds those without a bias kept 0.75 to 1.0 of it on the coarsest level, those with one
/// of 5 % 0.18 to 0.86 and of 15 % 0.09 to 0.56.
const LEAVES: f64 = 0.6;

/// The same at rest, before anything is found: motion shows as well. Of the same pairs a calf whose
/// halves move past each other was 12 % worse with 0.32 left taken out. Coils beside the tissue
/// leave 0.02, small presses at a bias of 15 % 0.09.
const LEAVES_AT_REST: f64 = 0.2;

/// What place and contrast may leave together, as a part of what the better one leaves alone, to be
/// taken together. Under a bias alone they leave 0.76 to 1.08 of what place does, in another
/// contrast 0.08 to 0.8; and place alone, taken out in another contrast, does harm (a thigh in a
/// cube root 0.73 -> 1.85 mm), while both under a bias alone do none.
const BOTH: f64 = 0.95;

/// The same at rest, where motion passes for contrast: a calf whose halves slide under a bias of 40
/// % was 0.87 in place of 0.67 mm off with 0.95.
const BOTH_AT_REST: f64 = 0.7;

/// What may be left of how the difference varies between neighbours ([`Brightness::uneven`]), as a
/// part of it. Of 64 pairs with a coil's profile, a bias of 5 to 40 % or another contrast those
/// under their field kept 0.03 to 0.56 (of 15 % and more 0.37 at most), those at rest that
/// [`LEAVES_AT_REST`] lets pass 0.05 to 0.34. Of 11 whose one half is 1.4 to 3 times as bright it
/// was 0.44 to 1.9, and 0.42 to 15, and smooth polynomials across the step did harm (a head turned
/// by 5 degrees 0.008 -> 0.208 mm, calves that slide 0.18 -> 0.56).
const UNEVEN: f64 = 0.4;

/// Difference in brightness (logarithm, robust standard deviation over blocks) below which it is no
/// matter.
const MATTERS: f64 = 0.005;

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
    pub fn level_within<'a>(&self, aligned: &'a Aligned<'_>, mask: &[u8], factor: [usize; 3]) -> Pair<'a> {
        self.out_of(aligned.level_within(mask, factor), factor)
    }

    fn out_of<'a>(&self, mut pair: Pair<'a>, factor: [usize; 3]) -> Pair<'a> {
        if let Some(taken) = &self.taken {
            pair.even_out(taken, factor);
        }
        pair
    }

    /// Whether no level had tissue enough to look at.
    pub fn is_unknown(&self) -> bool {
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
        self.judge(pair, (aligned, factor), motion, (LEAVES, BOTH))
    }

    /// The same before the motion is known.
    pub fn look_at_rest<'a>(
        &mut self,
        pair: &mut Pair<'a>,
        (aligned, factor): (&'a Aligned<'_>, [usize; 3]),
        still: &Bodies,
    ) -> bool {
        self.judge(pair, (aligned, factor), still, (LEAVES_AT_REST, BOTH_AT_REST))
    }

    fn judge<'a>(
        &mut self,
        pair: &mut Pair<'a>,
        (aligned, factor): (&'a Aligned<'_>, [usize; 3]),
        motion: &Bodies,
        (leaves, both): (f64, f64),
    ) -> bool {
        let before = self.taken.take();
        let was_taken = before.is_some();
        if was_taken {
            pair.put(aligned.deformed(factor));
        }
        let warped = motion.warp(pair, &pair.spans);
        let found = Brightness::measure(pair, (factor, aligned.shape()), &warped, |p| motion.at(p), both);
        let matters = |b: &Brightness| {
            ablation::is_on("brightness") && b.deviation[0] > MATTERS && explains(b, leaves) && b.uneven <= UNEVEN
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
            let step = if found.uneven > UNEVEN && explains(found, LEAVES) {
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
