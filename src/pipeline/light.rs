//! Whether a smooth difference in brightness between the volumes is taken out, and what is said of it.

use crate::matching::brightness::Brightness;
use crate::matching::pair::Pair;
use crate::pipeline::level::SplineField;

/// What a polynomial may leave of the difference, as a part of it, to be taken out. Of 82 pairs of kinds those without a bias kept 0.75 to
/// 1.0 of it on the coarsest level, those with one of 5 % 0.18 to 0.86 and of 15 % 0.09 to 0.56.
const LEAVES: f64 = 0.6;

/// The same at rest, before anything is found: motion shows as well. Of the same pairs a calf whose halves move past each other was 12 %
/// worse with 0.32 left, and left as it is. Coils beside the tissue leave 0.02, small presses at a bias of 15 % 0.09.
const LEAVES_AT_REST: f64 = 0.2;

/// Difference in brightness (logarithm, robust standard deviation over blocks) below which it is no matter.
const MATTERS: f64 = 0.005;

/// The difference as far as it is known.
#[derive(Default)]
pub(super) struct Light {
    taken: Option<Brightness>,
    /// What was measured first and not taken.
    left: Option<Brightness>,
}

impl Light {
    /// What is taken out of the deformed volume.
    pub fn taken(&self) -> Option<&Brightness> {
        self.taken.as_ref()
    }

    /// Looks on a level of `factor` under `field`, on it, for what is there still; `shape` is the full initial volume's. Whether more is to be
    /// taken out than before.
    pub fn look(&mut self, pair: &Pair<'_>, factor: [usize; 3], shape: [usize; 3], field: &SplineField) -> bool {
        self.judge(pair, factor, shape, field, LEAVES)
    }

    /// The same before the motion is known.
    pub fn look_at_rest(
        &mut self,
        pair: &Pair<'_>,
        factor: [usize; 3],
        shape: [usize; 3],
        still: &SplineField,
    ) -> bool {
        self.judge(pair, factor, shape, still, LEAVES_AT_REST)
    }

    fn judge(
        &mut self,
        pair: &Pair<'_>,
        factor: [usize; 3],
        shape: [usize; 3],
        field: &SplineField,
        leaves: f64,
    ) -> bool {
        let Some(found) = Brightness::measure(pair, factor, shape, (&field.lattice, &field.coefficients)) else {
            return false;
        };
        match self.taken.take() {
            Some(taken) => self.taken = Some(taken.and(found)),
            None if found.deviation[0] > MATTERS && found.deviation[1] <= leaves * found.deviation[0] => {
                self.taken = Some(found)
            }
            None => {
                self.left = Some(found);
                return false;
            }
        }
        true
    }

    /// What was done, in words.
    pub fn why(&self) -> Option<String> {
        let [before, after] = self.taken.as_ref().or(self.left.as_ref())?.deviation.map(|d| 100.0 * d);
        Some(match &self.taken {
            Some(taken) => format!(
                "brightness: it differs smoothly, by a factor of {:.2} across the tissue; taken out of the deformed volume ({before:.1} % of \
                 difference in blocks before, {after:.1} % after)",
                taken.variation()
            ),
            None => format!(
                "brightness: no smooth difference that explains more than noise and motion ({before:.1} % of difference in blocks, {after:.1} % \
                 without it); left as it is"
            ),
        })
    }
}
