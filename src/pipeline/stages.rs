//! The stage account: the field as each stage left it.

use crate::consistency::energy::distance;
use crate::field::spline::FieldSpline;
use crate::matching::levels::{from_level, to_level};
use crate::matching::pair::Pair;
use crate::numerics::bspline::SmoothSampler;
use crate::pipeline::bodies::Bodies;
use crate::pipeline::body_models::on_full_grid;
use crate::pipeline::uncertainty::evenly;
use crate::types::{DenseField, Grid, GridVector, Mask, StageReport, VoxelPoint};
use rayon::prelude::*;

/// Approximate number of places at which stages are compared.
const SAMPLED_PLACES: usize = 5000;

/// A motion that a stage left, on a level of `factor`.
pub(super) struct Left {
    pub name: String,
    pub motion: Bodies,
    pub factor: [usize; 3],
}

/// The field after one stage.
#[derive(Debug, Clone, PartialEq)]
pub struct Stage {
    /// What it did.
    pub report: StageReport,
    /// What it left.
    pub field: FieldSpline,
}

impl Stage {
    /// The report with the mean error (mm) against `truth` over `mask`.
    pub fn scored(&self, truth: &DenseField, mask: Option<&Mask>) -> StageReport {
        let inside = |at: usize| mask.is_none_or(|m| m.as_slice()[at] != 0);
        let some: Vec<usize> = evenly(truth.grid().len(), inside, SAMPLED_PLACES).collect();
        let error = |&at: &usize| {
            let (u, t) = (self.field.at(at), truth.at(at));
            (0..3).map(|c| (u[c] - f64::from(t[c])).powi(2)).sum::<f64>().sqrt()
        };
        let sum: f64 = some.par_iter().map(error).collect::<Vec<_>>().iter().sum();
        StageReport { error_mm: Some(sum / some.len().max(1) as f64), ..self.report.clone() }
    }
}

/// The account of `left`, in their order, and of the field that is stated, on the finest level's
/// `pair` of `factor`.
pub(super) fn account(
    grid: &Grid,
    (pair, factor): (&Pair<'_>, [usize; 3]),
    left: Vec<Left>,
    stated: &FieldSpline,
) -> Vec<Stage> {
    let places = places(pair);
    let sampler = pair.sampler();
    let unexplained = |moved: &[GridVector]| unexplained(pair, &sampler, &places, moved);
    let mut before = vec![GridVector::ZERO; places.len()];
    let mut all = Vec::new();
    let mut add = |name: String, spacing_mm: [f64; 3], moved: Vec<GridVector>, field: FieldSpline| {
        let length = |(a, b): (&GridVector, &GridVector)| distance(a.0, b.0);
        let moved_mm = moved.iter().zip(&before).map(length).sum::<f64>() / places.len().max(1) as f64;
        let report = StageReport { name, spacing_mm, moved_mm, unexplained: unexplained(&moved), error_mm: None };
        before = moved;
        all.push(Stage { report, field });
    };
    for Left { name, motion, factor: own } in left {
        let spacing = std::array::from_fn(|a| grid.spacing()[a] * own[a] as f64);
        let at = |p: &VoxelPoint| motion.at(to_level(from_level(*p, factor), own));
        let moved = places.iter().map(at).collect();
        add(name, spacing, moved, on_grid(grid, &motion, own));
    }
    let at = |p: &VoxelPoint| stated.along_axes(from_level(*p, factor));
    add("final".into(), grid.spacing(), places.iter().map(at).collect(), stated.clone());
    all
}

/// Voxels of the tissue of a level, evenly.
fn places(pair: &Pair<'_>) -> Vec<VoxelPoint> {
    let [nx, ny, _] = pair.shape;
    let of = |at: usize| VoxelPoint::of([at % nx, at / nx % ny, at / (nx * ny)]);
    evenly(pair.mask.len(), |at| pair.mask[at] != 0, SAMPLED_PLACES).map(of).collect()
}

/// The part of the initial volume's variance at these places that the deformed volume, sampled
/// where they moved, does not explain linearly (0 to 1).
fn unexplained(pair: &Pair<'_>, sampler: &SmoothSampler<'_>, places: &[VoxelPoint], moved: &[GridVector]) -> f64 {
    let [nx, ny, _] = pair.shape;
    let values = |(p, u): (&VoxelPoint, &GridVector)| {
        let q = pair.to_moving(p.moved(*u, pair.spacing));
        let at = p.0.map(|v| v as usize);
        [pair.fixed_smooth[at[0] + nx * (at[1] + ny * at[2])], sampler.at(q)].map(f64::from)
    };
    let pairs: Vec<[f64; 2]> = places.par_iter().zip(moved).map(values).collect();
    let seen = || pairs.iter().filter(|v| v.iter().all(|v| v.is_finite()));
    let n = seen().count().max(1) as f64;
    let mean = [0, 1].map(|c| seen().map(|v| v[c]).sum::<f64>() / n);
    let product = |a: usize, b: usize| seen().map(|v| (v[a] - mean[a]) * (v[b] - mean[b])).sum::<f64>();
    let explained: f64 = product(0, 1).powi(2) / (product(0, 0) * product(1, 1)).max(f64::MIN_POSITIVE);
    (1.0 - explained).clamp(0.0, 1.0)
}

/// A motion of a level over the full-resolution grid.
fn on_grid(grid: &Grid, motion: &Bodies, factor: [usize; 3]) -> FieldSpline {
    let splines = motion.fields.iter().map(|field| on_full_grid(grid, field, factor)).collect();
    let labels = motion.labels_on(grid.shape(), |p| to_level(p, factor));
    FieldSpline::new(*grid, splines, labels, Vec::new())
}
