//! The smallest model, place by place: where nothing says that tissue moves otherwise than as the
//! whole does, the field is that motion.
//!
//! Smoothness that varies by place still leaves what stays at rest free to follow the noise. About
//! every place the excess misfit of stillness, or of one rigid motion, against the free field is
//! compared with the degrees of freedom that the data determine there, as
//! [`crate::consistency::models`] does for the whole.

use crate::consistency::coupling::Posterior;
use crate::consistency::models::{AffineMotion, nearest_rigid};
use crate::consistency::pruning::Measured;
use crate::matching::pair::Pair;
use crate::numerics::bspline::Lattice;
use crate::numerics::filters;
use crate::numerics::sampling::nearest;
use crate::numerics::symmetric3::inverse;
use crate::pipeline::level::SplineField;
use crate::types::{GridVector, MotionModel, VoxelPoint};

/// When tissue is at rest or follows one rigid motion. The misfits are calibrated:
/// docs/lab/2026-11-expected-error.md.
struct RestTest {
    /// Excess misfit per degree of freedom up to which tissue is at rest, and from which the free
    /// field applies (1).
    misfit_range: [f32; 2],
    /// Excess misfit per degree of freedom from which tissue at rest is as uncertain as the free
    /// field (1).
    uncertain_misfit: f32,
    /// Least uncertainty at rest over the free field's: how small a motion would show is not known
    /// better.
    min_uncertainty_ratio: f32,
    /// Least part of the tissue at rest for it to be held there: 0 to 0.11 in 34 of 37 pairs that
    /// moved smoothly or slid, 0.32 to 0.87 in 22 of 23 pressed ones.
    min_fraction: f64,
    /// Tissue at rest under a rigid motion over that under none, from which the rigid motion is
    /// taken.
    min_rigid_gain: f64,
    /// Refits of a rigid motion to the tissue at rest under the one before.
    rigid_refits: usize,
}

const REST: RestTest = RestTest {
    misfit_range: [0.85, 2.2],
    uncertain_misfit: 1.7,
    min_uncertainty_ratio: 1.0 / 3.0,
    min_fraction: 0.15,
    min_rigid_gain: 1.25,
    rigid_refits: 2,
};

/// What windows around a place add to its misfit and degrees of freedom.
struct Neighbourhood {
    /// Weight: they decide only where the data determine little.
    weight: f32,
    /// Width (windows, one Gaussian standard deviation).
    width_windows: f64,
}

const NEIGHBOURHOOD: Neighbourhood = Neighbourhood { weight: 0.02, width_windows: 3.0 };

/// A map that was compared with the free field.
pub(super) struct Tried {
    pub model: MotionModel,
    pub motion: AffineMotion,
    /// Excess misfit about each of the windows.
    pub excess: Vec<f32>,
}

/// Least degrees of freedom of a place that contradicts a model: with fewer, chance decides.
const MIN_LOCAL_DEGREES_OF_FREEDOM: f32 = 5.0;

/// What each of the windows holds.
pub(super) struct Places {
    nodes: [usize; 3],
    /// Voxels of tissue.
    tissue: Vec<f32>,
    /// Degrees of freedom that the data determine, those of the neighbourhood lent in.
    determined: Vec<f32>,
}

impl Places {
    /// From the posterior of a field.
    pub fn new(pair: &Pair<'_>, windows: &Lattice, nodes: &Lattice, posterior: &Posterior) -> Self {
        let mut determined = vec![0.0f32; windows.len()];
        for (m, &part) in posterior.determined.iter().enumerate() {
            windows.stencil_near(nodes.place(m)).scatter(part, &mut determined);
        }
        let tissue = windows.accumulate::<1>(|j, k, [row]| {
            let span = pair.spans.row(j, k);
            let from = pair.shape[0] * (j + pair.shape[1] * k);
            for i in span.clone() {
                row[i] = f32::from(pair.mask[from + i] != 0);
            }
            span
        });
        Self { nodes: windows.nodes, tissue, determined: with_neighbours(determined, windows.nodes) }
    }

    /// Excess misfit for each degree of freedom about each of the windows.
    pub fn ratio(&self, excess: &[f32]) -> Vec<f32> {
        let excess = with_neighbours(excess.to_vec(), self.nodes);
        excess.iter().zip(&self.determined).map(|(q, d)| q / d.max(1e-9)).collect()
    }

    /// The greatest of them, where there is as much tissue as in the windows on average.
    pub fn worst(&self, excess: &[f32]) -> f64 {
        let filled = self.tissue.iter().filter(|&&t| t > 0.0).count().max(1);
        let least = self.tissue.iter().sum::<f32>() / filled as f32;
        let excess = with_neighbours(excess.to_vec(), self.nodes);
        let ratios = excess.iter().zip(&self.determined).map(|(q, d)| q / d.max(MIN_LOCAL_DEGREES_OF_FREEDOM));
        let held = ratios.zip(&self.tissue).filter(|(_, t)| **t >= least);
        held.map(|(r, _)| f64::from(r)).fold(0.0, f64::max)
    }
}

/// Tissue that moves as a whole does.
pub(super) struct Rest {
    model: MotionModel,
    motion: AffineMotion,
    windows: Lattice,
    /// How much of the free field stands about each of the windows (0 to 1).
    free: Vec<f32>,
    /// Excess misfit for each degree of freedom about each of the windows.
    ratio: Vec<f32>,
    /// Part of the tissue that is at rest.
    share: f64,
    spacing: [f64; 3],
}

impl Rest {
    /// Where `field` shows no motion, or none but one rigid motion where that holds more tissue.
    /// `excess` gives the excess misfit of a map about each of the windows. None where neither map
    /// was tried.
    pub fn find(
        pair: &Pair<'_>,
        field: &SplineField,
        windows: &Lattice,
        places: &Places,
        tried: &[Tried],
        excess: impl Fn(&AffineMotion) -> Vec<f32>,
    ) -> Option<Self> {
        let tissue = &places.tissue;
        let all: f64 = tissue.iter().map(|&v| f64::from(v)).sum();
        let judged = |&Tried { model, motion, ref excess }: &Tried| {
            let ratio = places.ratio(excess);
            let free: Vec<f32> = ratio.iter().map(|&r| free_share(r)).collect();
            let share: f64 = free.iter().zip(tissue).map(|(f, t)| f64::from((1.0 - f) * t)).sum();
            Self {
                model,
                motion,
                windows: windows.clone(),
                free,
                ratio,
                share: share / all.max(1.0),
                spacing: pair.spacing,
            }
        };
        let of = |model| tried.iter().find(|t| t.model == model).map(judged);
        let (still, rigid) = (of(MotionModel::Identity), of(MotionModel::Rigid));
        // What else moves draws the first fit of the whole to itself.
        let refit = |whole: Self| {
            (0..REST.rigid_refits).fold(whole, |last, _| {
                let motion = nearest_rigid(&last.at_rest(pair, field));
                judged(&Tried { model: MotionModel::Rigid, motion, excess: excess(&motion) })
            })
        };
        let more = |rigid: &Self| still.as_ref().is_none_or(|still| rigid.share > REST.min_rigid_gain * still.share);
        rigid.filter(more).map(refit).filter(more).or(still)
    }

    /// What the field shows of the tissue at rest, at its nodes, with the information that the data
    /// give there.
    fn at_rest(&self, pair: &Pair<'_>, field: &SplineField) -> Vec<Measured> {
        shown(pair, field, |at| self.free_at(at) < 0.5)
    }

    /// How much of the free field stands at a place of the windows' grid, or at the nearest to it.
    fn free_at(&self, at: VoxelPoint) -> f32 {
        self.windows.stencil_near(at).gather(&self.free)
    }

    /// The uncertainty at a place of the level where it was judged, as a part of the free field's.
    pub(crate) fn narrowed(&self, at: VoxelPoint) -> f32 {
        (self.windows.stencil_near(at).gather(&self.ratio) / REST.uncertain_misfit)
            .clamp(REST.min_uncertainty_ratio, 1.0)
    }

    /// Whether so much is at rest that it is held there.
    pub(crate) fn is_taken(&self) -> bool {
        self.share >= REST.min_fraction
    }

    /// What was found, in words.
    pub fn why(&self) -> String {
        let how = match self.model {
            MotionModel::Identity => "stays where it is",
            _ => "follows one rigid motion",
        };
        let held = match self.is_taken() {
            true => "it is held there".to_string(),
            false => format!("too little to hold it there (at least {:.0} %)", 100.0 * REST.min_fraction),
        };
        format!("at rest: {:.0} % of the tissue {how}, as far as the data tell; {held}", 100.0 * self.share)
    }

    /// Holds `field` where tissue is at rest; `place` leads from its voxels to those in which it
    /// was judged.
    pub fn bring(&self, field: &mut SplineField, place: impl Fn(VoxelPoint) -> VoxelPoint + Sync) {
        let rest = field.lattice.fit(|p| self.motion.on_grid(place(p), self.spacing));
        let n = field.lattice.len();
        for m in 0..n {
            let free = self.free_at(place(field.lattice.within(m)));
            for i in [m, n + m, 2 * n + m] {
                field.coefficients[i] = rest[i] + free * (field.coefficients[i] - rest[i]);
            }
        }
    }
}

/// What a field shows of the tissue at its nodes where `counts` holds, with the
/// information that the data give there.
pub(super) fn shown(pair: &Pair<'_>, field: &SplineField, counts: impl Fn(VoxelPoint) -> bool) -> Vec<Measured> {
    let nodes = &field.lattice;
    let of = |(m, block): (usize, [f32; 6])| {
        let at = nodes.within(m);
        let here = nearest(pair.shape, at).is_some_and(|at| pair.mask[at] != 0);
        let covariance = if here && counts(at) { inverse(&block.map(f64::from)) } else { None }?;
        let GridVector(displacement) = field.at(at);
        Some(Measured { place: at.in_mm(pair.spacing), displacement, covariance, field: displacement })
    };
    field.blocks.iter().enumerate().filter_map(of).collect()
}

/// Values with the weighted sum of their neighbourhood, see [`NEIGHBOURHOOD`].
fn with_neighbours(mut values: Vec<f32>, nodes: [usize; 3]) -> Vec<f32> {
    let about = filters::gaussian(&values, nodes, [NEIGHBOURHOOD.width_windows; 3]);
    values.iter_mut().zip(about).for_each(|(v, about)| *v += NEIGHBOURHOOD.weight * about);
    values
}

/// Weight of the free field (0 to 1) at an excess misfit per degree of freedom: a smooth step.
fn free_share(ratio: f32) -> f32 {
    let [low, high] = REST.misfit_range;
    let t = ((ratio - low) / (high - low)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}
