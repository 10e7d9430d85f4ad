//! A closer lattice where the volumes still differ by more than noise, and the closer field
//! explains why.

use crate::matching::pair::Pair;
use crate::numerics::statistics::deviation;
use crate::pipeline::level::{self, SplineField};

/// When a finer lattice is tried and accepted.
struct LatticeTrial {
    /// Residual over the noise beyond which it is tried: 0.5 to 0.75 where the motion was found, up
    /// to 0.95 where not, 1.4 to 12 for brains of two people.
    min_residual_to_noise: f32,
    /// Misfit per degree of freedom that it must explain: superfluous lattices explained 0.3 to
    /// 0.75 (docs/lab/2026-11-local-signal.md).
    min_gain_per_degree_of_freedom: f64,
    /// Passes on it, and again where it is accepted.
    passes: usize,
    /// Most nodes, to bound memory.
    max_nodes: usize,
}

const TRIAL: LatticeTrial =
    LatticeTrial { min_residual_to_noise: 1.1, min_gain_per_degree_of_freedom: 0.8, passes: 4, max_nodes: 4_000_000 };

/// Node spacing of the finest level at the start. Calibrated: docs/lab/2026-11-local-signal.md.
struct InitialSpacing {
    /// Nodes in the tissue beyond which their spacing exceeds the least.
    max_nodes: f64,
    /// Least spacing (voxels).
    min_voxels: usize,
}

const INITIAL_SPACING: InitialSpacing = InitialSpacing { max_nodes: 6000.0, min_voxels: 4 };

/// Residuals that earn a warning.
struct Warnings {
    /// Residual over the standard deviation of the initial volume's tissue.
    residual: f32,
    /// Variation of the gain: 1.01 to 1.02 without a bias, 1.10 to 1.19 at 15 %, 1.26 to 1.49 at
    /// 40 %, where errors grow by 19 to 31 %.
    gain_variation: f32,
}

const WARN: Warnings = Warnings { residual: 0.05, gain_variation: 1.25 };

/// Voxels between the nodes of the finest level to begin with: as asked, or by the `inside` voxels
/// of tissue.
pub(super) fn apart(asked: usize, inside: usize) -> usize {
    let wide = (inside as f64 / INITIAL_SPACING.max_nodes).cbrt().round() as usize;
    if asked > 0 { asked } else { wide.max(INITIAL_SPACING.min_voxels) }
}

/// A field with what it leaves.
pub(super) struct Explained {
    pub field: SplineField,
    /// Voxels between its nodes.
    pub apart: usize,
    /// What was tried, in words.
    pub said: Vec<String>,
}

/// Brings the field to lattices of one voxel less between nodes, from `apart`, for as long as the
/// residual is more than noise and each explains it. `refine` brings a field to the residual in so
/// many passes.
pub(super) fn finer(
    pair: &Pair<'_>,
    field: SplineField,
    apart: usize,
    seed: u64,
    refine: impl Fn(&mut SplineField, usize),
) -> Explained {
    let warped = |field: &SplineField| pair.warp(&field.lattice, &field.coefficients, &pair.spans);
    let left = |field: &SplineField| level::misfit(pair, &warped(field))[0];
    let mut noisy = times(left(&field), pair.noise);
    let mut best = Explained { field, apart, said: Vec::new() };
    for closer in (2..apart).rev() {
        let lattice = level::lattice(pair, closer);
        if noisy < TRIAL.min_residual_to_noise || lattice.len() > TRIAL.max_nodes || lattice == best.field.lattice {
            break;
        }
        let mut next = level::carry(&best.field, lattice, |p| p);
        refine(&mut next, TRIAL.passes);
        let gain = level::gained(pair, &warped(&best.field), warped(&next));
        let [few, many] = [&best.field, &next].map(|f| level::determined(pair, f, seed));
        let gain_per_degree = gain / (many - few).max(1.0);
        let taken = gain > 0.0 && gain_per_degree > TRIAL.min_gain_per_degree_of_freedom;
        best.said.push(format!(
            "nodes every {closer} voxels: {}; the residual is {noisy:.1} times the noise, and {:.0} degrees of freedom more explain \
             {gain_per_degree:.2} of the misfit each (chance: up to {})",
            if taken { "taken" } else { "not taken" },
            many - few,
            TRIAL.min_gain_per_degree_of_freedom
        ));
        if !taken {
            break;
        }
        refine(&mut next, TRIAL.passes);
        noisy = times(left(&next), pair.noise);
        (best.field, best.apart) = (next, closer);
    }
    best
}

/// A residual in standard deviations of the noise.
fn times(left: f32, noise: f32) -> f32 {
    left / noise.max(f32::MIN_POSITIVE)
}

/// Says so where what is `left` of the difference is more than noise, and not next to nothing in
/// the tissue's contrast.
pub(super) fn unlike(pair: &Pair<'_>, left: f32) -> Option<String> {
    let tissue =
        pair.fixed_smooth.iter().zip(&pair.mask[..]).filter(|(v, m)| **m != 0 && v.is_finite()).map(|(v, _)| *v);
    let (times, part) = (times(left, pair.noise), left / deviation(tissue) as f32);
    (times > TRIAL.min_residual_to_noise && part > WARN.residual).then(|| {
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
    (gain > WARN.gain_variation).then(|| {
        format!(
            "the gain between the two volumes {how} in the tissue (a bias field, or another contrast): a part of it is taken for motion, and errors \
             grow by a fifth and more; take the bias out of both volumes first (N4, say)"
        )
    })
}
