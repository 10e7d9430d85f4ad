//! A search twice as far, where the motion reaches the end of what was looked over or few features agree on it.

use crate::matching::levels::{Aligned, from_level, to_level};
use crate::matching::pair::Pair;
use crate::numerics::ablation;
use crate::numerics::bspline::Lattice;
use crate::pipeline::level;
use crate::pipeline::light::Light;
use crate::pipeline::start::Begun;
use crate::pipeline::whole::{POINTS, Whole};

/// Part of the range from which motion is called near the end of it.
pub(super) const NEAR: f64 = 0.9;

/// Times as far.
pub(super) const TWICE: f64 = 2.0;

/// Share of the features that agree in the wider search, in that of the narrow one, from which its better agreement of the volumes is
/// believed. Of 39 pairs whose motion reached the range (cores that slide by 13 to 28 mm, halves, joints, bands of shear, smooth), the nine
/// that it took on had 0.83 to 1.15 of it and 0.32 to 1.06 of the error; six with 0.6 to 0.66 of it had 1.00 to 1.7.
const BORNE: f64 = 0.8;

/// Share of the features under which those that agree may do so on a part of what moved past the range: a core that slid by 28 mm in a head had 0.56
/// to 0.6 under a texture of its own, and was found to reach 7 mm (of 20 small pairs whose motion lies in the range none had less than 0.75).
const FEW: f64 = 0.65;

/// Why what was found (or nothing was) leaves the question open what lies past the range.
pub(super) fn is_open(pair: &Pair<'_>, range: f64, found: Option<&Begun>) -> Option<&'static str> {
    let Some(found) = found.filter(|_| ablation::is_on("farther")) else { return found.is_none().then_some("in vain") };
    found.report.as_ref()?;
    if level::lengths(pair, &found.field)[1] > NEAR * range {
        return Some("which the motion reaches");
    }
    (found.share() < FEW).then_some("where few agree")
}

/// What is found with twice the range on the levels `factors`, from the coarsest one that such a range needs to that of `pair` and
/// `lattice`; None where `own` is to be kept. The volumes decide, on that level, and the features: on a coarser one fewer are seen, and
/// neighbours that agree less than before are an island.
pub(super) fn farther(
    whole: &Whole<'_>,
    (aligned, light): (&Aligned<'_>, &Light),
    (factors, pair, lattice): (&[[usize; 3]], &Pair<'_>, &Lattice),
    own: Option<&Begun>,
    passes: usize,
    seconds: &mut f64,
) -> Option<Begun> {
    let far = Whole { range: TWICE * whole.range, ..*whole };
    let mut found: Option<Begun> = None;
    let last = factors.len() - 1;
    for (l, &factor) in factors.iter().enumerate() {
        let (coarser, coarse_lattice);
        let (pair, lattice) = if l == last {
            (pair, lattice)
        } else {
            coarser = light.level(aligned, factor);
            coarse_lattice = level::lattice(&coarser, 3);
            (&coarser, &coarse_lattice)
        };
        found = Some(match found {
            None => far.begin((pair, factor), lattice, (&[], false), (passes, POINTS), seconds)?,
            Some(mut found) => {
                let from = factors[l - 1];
                found.field = level::carry(&found.field, lattice.clone(), |p| to_level(from_level(p, factor), from));
                let reach = found.reach();
                level::refine(pair, &mut found.field, (passes, reach), whole.params.seed, whole.tick);
                found
            }
        });
    }
    let found = found?;
    let believed =
        |own: &Begun| found.share() >= BORNE * own.share() && level::is_better(pair, &found.field, &own.field);
    own.is_none_or(believed).then_some(found)
}

/// What was done, in words.
pub(super) fn why(range: f64, open: &str, own: Option<&Begun>, wide: Option<&Begun>) -> String {
    let twice = TWICE * range;
    let agreed = |b: &Begun| format!("{:.0} % of the features agree", 100.0 * b.share());
    let before = own.map_or("nothing was found".into(), agreed);
    let after = wide.map_or("nothing better".into(), |w| format!("{}, taken", agreed(w)));
    format!("search range: {range:.1} mm was looked over, {open} ({before}); over {twice:.1} mm: {after}")
}
