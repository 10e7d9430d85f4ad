//! As many nodes as the volumes ask for: from a wide lattice to closer ones while each explains more than chance.

use crate::matching::pair::Pair;
use crate::numerics::statistics::deviation;
use crate::pipeline::level::{self, SplineField};

/// Residual (in standard deviations of the noise) beyond which a closer lattice is tried in any case. The spline filter leaves noise alone at
/// about 0.5. Same tissue at 3 % noise: 0.5 to 0.75 where the motion was found, 0.95 at most where not; brains of two people,
/// 1.4 to 12.
const NOISY: f32 = 1.1;

/// Misfit per degree of freedom that a closer lattice must explain. Past the spacing that a scene asks for lattices explained .3 to .75 of noise
/// and interpolation (docs/lab/2026-11-local-signal.md).
const WORTH: f64 = 0.8;

/// Misfit per degree of freedom from which the next closer lattice is tried: a step gains about half of the one before, so where less was
/// gained the next would not be worth it.
const NEXT: f64 = 2.0 * WORTH;

/// Degrees of freedom that a closer lattice counts for at least: with fewer, what a few passes more explain would decide.
const FEWEST: f64 = 40.0;

/// Passes on each closer lattice, and again where it is taken and leaves more than noise.
pub(super) const TRIAL: usize = 4;

/// Residual, as a part of the standard deviation of the initial volume's tissue, up to which it is no matter.
const UNLIKE: f32 = 0.05;

/// Variation of the gain beyond which it is warned of. In phantoms of a block, a head and a calf (two sizes, two to five seeds) it is 1.01 to 1.02 without
/// bias, 1.10 to 1.19 at 15 % and 1.26 to 1.49 at 40, where the error is larger by 19 to 31 %; in 14 pairs made from scans (15 %) 1.10 to 1.19. Between
/// the second and the 98th percentile one of those, in thick slices, had 1.55.
const UNEVEN: f32 = 1.25;

/// Voxels between nodes, from the widest lattice to the closest.
pub(super) const SPACINGS: [usize; 7] = [10, 8, 6, 5, 4, 3, 2];

/// Nodes at most, to bound memory.
const NODES: usize = 4_000_000;

/// Brings the field to ever closer nodes, from `spacing`, for as long as each lattice explains more than chance for each degree of
/// freedom that it adds: that field, the voxels between its nodes, and what was tried, in words. `refine` brings a field to the residual.
pub(super) fn finer(
    pair: &Pair<'_>,
    field: SplineField,
    spacing: usize,
    seed: u64,
    refine: impl Fn(&mut SplineField),
) -> (SplineField, usize, Vec<String>) {
    let (mut best, mut chosen, mut said) = (field, spacing, Vec::new());
    for closer in SPACINGS.into_iter().filter(|&s| s < spacing) {
        let lattice = level::lattice(pair, closer);
        if lattice.len() > NODES || lattice == best.lattice {
            break;
        }
        let mut next = level::carry(&best, lattice, |p| p);
        refine(&mut next);
        let gain = level::gained(pair, &best, &next);
        let [few, many] = [&best, &next].map(|f| level::determined(pair, f, seed));
        let worth = gain / (many - few).max(FEWEST);
        let taken = gain > 0.0 && worth > WORTH;
        said.push(format!(
            "nodes every {closer} voxels: {}; {:.0} degrees of freedom more explain {worth:.2} of the misfit each (chance: up to {WORTH})",
            if taken { "taken" } else { "not taken" },
            many - few
        ));
        if taken {
            (best, chosen) = (next, closer);
            if is_noisy(pair, &best) {
                refine(&mut best);
            }
        }
        // What is left beyond noise may be finer than any lattice so far.
        if worth < NEXT && !is_noisy(pair, &best) {
            break;
        }
    }
    (best, chosen, said)
}

/// Whether a field leaves more than noise of the difference.
fn is_noisy(pair: &Pair<'_>, field: &SplineField) -> bool {
    times(level::misfit(pair, field)[0], pair.noise) > NOISY
}

/// A residual in standard deviations of the noise.
fn times(left: f32, noise: f32) -> f32 {
    left / noise.max(f32::MIN_POSITIVE)
}

/// Says so where what is `left` of the difference is more than noise, and not next to nothing in the tissue's contrast.
pub(super) fn unlike(pair: &Pair<'_>, left: f32) -> Option<String> {
    let tissue =
        pair.fixed_smooth.iter().zip(&pair.mask[..]).filter(|(v, m)| **m != 0 && v.is_finite()).map(|(v, _)| *v);
    let (times, part) = (times(left, pair.noise), left / deviation(tissue) as f32);
    (times > NOISY && part > UNLIKE).then(|| {
        format!(
            "what is left of the difference is {times:.1} times the noise ({:.0} % of the contrast in the tissue): the volumes differ \
             by more than motion (contrast, brightness, missing tissue, another person), and the field may follow that; look at warped.nii.gz",
            100.0 * part
        )
    })
}

/// Says so where the gain varies by so much that a part of it is taken for motion.
pub(super) fn uneven(gain: f32) -> Option<String> {
    let how = match gain {
        g if g.is_infinite() => "changes its sign".into(),
        g => format!("varies by a factor of {g:.2} from its tenth to its 90th percentile"),
    };
    (gain > UNEVEN).then(|| {
        format!(
            "the gain between the two volumes {how} in the tissue (a bias field, or another contrast): a part of it is taken for motion, and errors \
             grow by a fifth and more; take the bias out of both volumes first (N4, say)"
        )
    })
}
