//! Landmarks: matches of known deviation in the same fit as the voxels.
//!
//! Each pulls the field by its distance from it over its variance, with Cauchy's weight, so that
//! one that most others and the volumes speak against hardly pulls.

use crate::consistency::energy::distance;
use crate::consistency::models::AffineMotion;
use crate::consistency::pruning::{GATE, Measured};
use crate::matching::pair::{Anchor, Pair};
use crate::matching::residual::{MIN_POSITION_ERROR_VOXELS, NormalEquations};
use crate::numerics::bspline::Lattice;
use crate::numerics::statistics::median;
use crate::pipeline::bodies::Bodies;
use crate::pipeline::hypotheses::Start;
use crate::pipeline::known::Known;
use crate::pipeline::level::{self, SplineField};
use crate::types::{Grid, GridVector, Landmark, LandmarkReport, VoxelPoint};

/// Graduated non-convexity of the landmarks' weights (Blake and Zisserman 1987).
struct Annealing {
    /// Squared distance over the variance at which the final weight is a half: three standard
    /// deviations, as for matches.
    final_scale_squared: f64,
    /// Factor by which that scale falls from pass to pass.
    decay: f64,
    /// Passes at the end in which it holds.
    final_passes: usize,
}

const ANNEALING: Annealing = Annealing { final_scale_squared: 9.0, decay: 4.0, final_passes: 3 };

/// Landmarks from which a motion of their own may start the search: an affine map takes four.
pub(super) const MIN_LANDMARKS: usize = 4;

/// The landmarks on the initial volume's grid.
pub(super) fn anchors(known: &Known<'_>, grid: &Grid) -> Vec<Anchor> {
    let sd = if known.landmark_sd_mm > 0.0 { known.landmark_sd_mm } else { voxel(grid) };
    // Of no place more is known than interpolation leaves sure.
    let sd = sd.max(MIN_POSITION_ERROR_VOXELS * voxel(grid));
    let axes = grid.axes();
    let of = |l: &Landmark| {
        let d = l.deformed.minus(l.initial);
        let along = |a: usize| (0..3).map(|r| axes[r][a] * d[r]).sum();
        Anchor { at: grid.affine().to_voxel(l.initial), displacement: GridVector(std::array::from_fn(along)), sd }
    };
    known.landmarks.iter().map(of).collect()
}

/// Edge of a cube of a voxel's volume (mm): the deviation of a landmark that is not told.
fn voxel(grid: &Grid) -> f64 {
    grid.spacing().iter().product::<f64>().cbrt()
}

/// Each landmark's squared distance from a motion `at` a place, over its variance.
fn squares(anchors: &[Anchor], at: impl Fn(VoxelPoint) -> GridVector) -> Vec<f64> {
    anchors.iter().map(|a| (distance(at(a.at).0, a.displacement.0) / a.sd).powi(2)).collect()
}

/// The squared scale of the weights, by the passes `to_come` after this one, as [`ANNEALING`] says:
/// at first all landmarks pull.
fn scale(to_come: usize) -> f64 {
    ANNEALING.final_scale_squared
        * ANNEALING.decay.powi(to_come.saturating_sub(ANNEALING.final_passes - 1).min(20) as i32)
}

/// How far the field is from most landmarks (mm, twice the median).
pub(super) fn reach(pair: &Pair<'_>, field: &SplineField) -> f64 {
    let far = |a: &Anchor| distance(field.at(a.at).0, a.displacement.0) as f32;
    let mut all: Vec<f32> = pair.anchors.iter().map(far).collect();
    if all.is_empty() { 0.0 } else { 2.0 * f64::from(median(&mut all)) }
}

/// Whether the passes may end with `to_come` left: the weights are final.
pub(super) fn are_settled(pair: &Pair<'_>, to_come: usize) -> bool {
    pair.anchors.is_empty() || to_come < ANNEALING.final_passes
}

/// Adds what the landmarks pull with to a pass with `to_come` passes after it.
pub(super) fn pull(pair: &Pair<'_>, field: &SplineField, equations: &mut NormalEquations, to_come: usize) {
    let scale = scale(to_come);
    for (anchor, q) in pair.anchors.iter().zip(squares(&pair.anchors, |p| field.at(p))) {
        let weight = scale / (scale + q) / (anchor.sd * anchor.sd);
        let pull = anchor.displacement.minus(field.at(anchor.at)).0.map(|d| (weight * d) as f32);
        equations.add(&field.lattice, anchor.at, weight as f32, pull);
    }
}

/// What a squared distance over the variance costs: the logarithm of its density (Cauchy).
fn cost(q: f64) -> f64 {
    ANNEALING.final_scale_squared * (q / ANNEALING.final_scale_squared).ln_1p()
}

/// How much better the landmarks agree with one motion than with another.
pub(super) fn gained(pair: &Pair<'_>, from: &Bodies, to: &Bodies) -> f64 {
    let of = |motion: &Bodies| squares(&pair.anchors, |p| motion.at(p)).into_iter().map(cost).sum::<f64>();
    of(from) - of(to)
}

/// Adds how much worse a map agrees with the landmarks than `field` does, about each of the
/// windows.
pub(super) fn add_excess(
    pair: &Pair<'_>,
    field: &SplineField,
    motion: &AffineMotion,
    windows: &Lattice,
    excess: &mut [f32],
) {
    let free = squares(&pair.anchors, |p| field.at(p));
    let map = squares(&pair.anchors, |p| motion.on_grid(p, pair.spacing));
    for ((anchor, free), map) in pair.anchors.iter().zip(free).zip(map) {
        windows.stencil_near(anchor.at).scatter((cost(map) - cost(free)) as f32, excess);
    }
}

/// The landmarks as matches beside those of the features.
pub(super) fn measured(pair: &Pair<'_>, field: &SplineField) -> Vec<Measured> {
    let of = |a: &Anchor| {
        let variance = a.sd * a.sd;
        Measured {
            place: a.at.in_mm(pair.spacing),
            displacement: a.displacement.0,
            covariance: [variance, variance, variance, 0.0, 0.0, 0.0],
            field: field.at(a.at).0,
        }
    };
    pair.anchors.iter().map(of).collect()
}

/// The field through the landmarks alone on a level of `factor`, from which a search may start.
pub(super) fn start(pair: &Pair<'_>, factor: [usize; 3]) -> Option<Start> {
    let thick: Vec<usize> = (0..3).filter(|&a| pair.shape[a] > 1).collect();
    if pair.anchors.len() < MIN_LANDMARKS {
        return None;
    }
    let of = |a: &Anchor| {
        let variance = |c: usize| if thick.contains(&c) { a.sd * a.sd } else { 0.0 };
        (a.at, a.displacement, [variance(0), variance(1), variance(2), 0.0, 0.0, 0.0])
    };
    let (field, _) = level::couple(pair, pair.anchors.iter().map(of), (&[0; 3], 0.3), None);
    Some(Start { motion: Bodies::from(field.before_passes()), factor, followed: None })
}

/// What became of the landmarks under a motion `at` a place of the full-resolution grid, of such a
/// deviation along an axis (mm).
pub(super) fn report(
    anchors: &[Anchor],
    at: impl Fn(VoxelPoint) -> GridVector,
    deviation: impl Fn(VoxelPoint) -> f64,
) -> Option<LandmarkReport> {
    let first = anchors.first()?;
    let off: Vec<f64> = anchors.iter().map(|a| distance(at(a.at).0, a.displacement.0)).collect();
    let is_wrong = |i: &usize| {
        let variance = anchors[*i].sd.powi(2) + deviation(anchors[*i].at).powi(2);
        off[*i].powi(2) / variance > GATE
    };
    let wrong: Vec<usize> = (0..anchors.len()).filter(is_wrong).collect();
    Some(LandmarkReport {
        count: anchors.len(),
        sd_mm: first.sd,
        mean_mm: off.iter().sum::<f64>() / off.len() as f64,
        wrong: wrong.iter().map(|i| i + 1).collect(),
        distances_mm: off,
    })
}

/// The variance along an axis (mm^2) of the field's error that landmarks show, where at least half
/// of them contradict it.
pub(super) fn against(report: &LandmarkReport) -> Option<f64> {
    let squares = report.wrong.iter().map(|n| report.distances_mm[n - 1].powi(2)).sum::<f64>();
    let most = 2 * report.wrong.len() >= report.count && !report.wrong.is_empty();
    most.then(|| squares / (3.0 * report.wrong.len() as f64))
}

/// Names the landmarks that the field does not go through.
pub(super) fn said_of(report: Option<&LandmarkReport>) -> Option<String> {
    let LandmarkReport { count, wrong, distances_mm, .. } = report?;
    let far = |n: &usize| format!("number {n} by {:.1} mm", distances_mm[n - 1]);
    let named: Vec<String> = wrong.iter().take(5).map(far).collect();
    let more = if wrong.len() > 5 { ", and more (see summary.json)" } else { "" };
    (!wrong.is_empty()).then(|| {
        format!(
            "{} of {count} landmarks {} with the field: {}{more}; check that each shows the same tissue in both volumes",
            wrong.len(),
            if wrong.len() == 1 { "disagrees" } else { "disagree" },
            named.join(", ")
        )
    })
}
