//! How far off a field may be: the variance that each source of error leaves at the nodes of a
//! lattice, and what they add up to over the mask.
//!
//! The posterior of the coupled field says what noise and smoothness leave open. It is widened
//! where the volumes differ by more than noise, by the departure of the stated motion from the free
//! field, where tissue is out of view or without texture, at borders between bodies, and by motions
//! that the search could not rule out. One calibration ([`CALIBRATION`]) is fitted on half of the
//! scenes: docs/lab/2026-11-expected-error.md.

use crate::consistency::coupling::Posterior;
use crate::error::SpaceError;
use crate::field::spline::{self, ScalarSpline};
use crate::matching::levels::to_level;
use crate::numerics::bspline::Lattice;
use crate::numerics::statistics::{median, quantile};
use crate::pipeline::bodies::Bodies;
use crate::types::{
    BodyReport, DenseField, ErrorSamples, ErrorSource, ExpectedError, Grid, LabelError, Mask, MotionModel, VoxelPoint,
};
use rayon::prelude::*;

/// Calibration on half of the scenes of docs/lab/2026-11-expected-error.md.
struct Calibration {
    /// Standard deviation over the posterior's for which the 95 % region contains 95 % of the
    /// errors (1).
    region: f32,
    /// Mean error over that of normal errors of the stated deviation (1): most places are better
    /// than the deviation that contains 95 % of them.
    mean_length: f64,
    /// Factor around the expected error that contains the true mean error in nine of ten scenes
    /// (1).
    interval: f64,
}

const CALIBRATION: Calibration = Calibration { region: 1.05, mean_length: 0.63, interval: 2.0 };

/// Errors that the posterior does not contain.
struct SourceErrors {
    /// Position error of interpolation and a voxel's extent (voxels, one axis): affine motions
    /// without noise come out 0.005 to 0.03 voxels off.
    interpolation_voxels: f64,
    /// Deviation of tissue out of view or without texture over what smoothness says (1).
    /// Calibrated: docs/lab/2026-11-expected-error.md.
    extrapolation: f32,
    /// Deviation along an axis at a border between bodies over the jump there (1): one in ten such
    /// voxels follows the wrong side (13 scenes).
    side_fraction: f32,
    /// Relative widening of the deviation per unexplained part of the variance between two
    /// contrasts (1): 16 scenes, docs/lab/2026-11-inputs.md.
    contrast: f64,
}

const SOURCE: SourceErrors =
    SourceErrors { interpolation_voxels: 0.015, extrapolation: 3.0, side_fraction: 0.18, contrast: 5.0 };

/// Approximate number of voxels from which means over the mask are taken.
pub(super) const SAMPLED_VOXELS: usize = 25_000;

/// What one body's data say at the nodes of its lattice.
pub(super) struct AtNodes<'a> {
    /// What the data leave open of the free field.
    pub posterior: &'a Posterior,
    /// Mean square of the residual over the noise's (1).
    pub misfit: &'a [f32],
    /// Departure of the stated motion from the free field (mm).
    pub departure: &'a [f32],
    /// Part of the deviation that is left where tissue is at rest (1).
    pub narrowed: &'a [f32],
    /// Whether the volumes show nothing of what is there.
    pub hidden: &'a [bool],
}

/// Variance along an axis (mm^2) by source of the error, at the nodes of a lattice.
pub(super) struct Variances {
    lattice: Lattice,
    /// In the order of [`ErrorSource::ALL`].
    parts: [Vec<f32>; 6],
    /// Draws of the free field's error (coefficients, mm, planar), and their variance (mm^2).
    free: Vec<f32>,
    draws: Vec<Vec<f32>>,
}

impl Variances {
    /// Of one body.
    pub fn of(lattice: Lattice, spacing: [f64; 3], nodes: &AtNodes<'_>) -> Self {
        let thick = || (0..3).filter(|&a| lattice.shape[a] > 1);
        let axes = thick().count().max(1) as f64;
        let edges = thick().map(|a| spacing[a].powi(2)).sum::<f64>();
        let interpolation = (SOURCE.interpolation_voxels * SOURCE.interpolation_voxels * edges / axes) as f32;
        let mut parts: [Vec<f32>; 6] = std::array::from_fn(|_| vec![0.0; lattice.len()]);
        for m in 0..lattice.len() {
            let narrowed = (CALIBRATION.region * nodes.narrowed[m]).powi(2);
            let free = narrowed * nodes.posterior.deviation[m].powi(2);
            let model = narrowed * nodes.departure[m].powi(2) / axes as f32;
            let noise = free + interpolation;
            let misfit = free * (nodes.misfit[m] - 1.0).max(0.0);
            let more = if nodes.hidden[m] { SOURCE.extrapolation * SOURCE.extrapolation - 1.0 } else { 0.0 };
            let all = [noise, misfit, model, more * (noise + misfit + model), 0.0, 0.0];
            all.into_iter().zip(&mut parts).for_each(|(v, part)| part[m] = v);
        }
        let mut draws = nodes.posterior.draws.clone();
        // Across a slice there is no motion.
        for flat in (0..3).filter(|&a| lattice.shape[a] == 1) {
            let n = lattice.len();
            draws.iter_mut().for_each(|draw| draw[flat * n..(flat + 1) * n].fill(0.0));
        }
        Self { free: variance_of(&lattice, &draws), lattice, parts, draws }
    }

    /// On the closest lattice of all bodies, each node's from the body there.
    pub(crate) fn by_place(mut all: Vec<Self>, bodies: &Bodies) -> Self {
        if all.len() == 1 {
            return all.remove(0);
        }
        let closest = (0..all.len()).max_by_key(|&b| all[b].lattice.len()).unwrap_or(0);
        let lattice = all[closest].lattice.clone();
        let n = lattice.len();
        let at = |values: &dyn Fn(&Self) -> &[f32], m: usize| {
            let place = lattice.within(m);
            let own = &all[bodies.label_near(place)];
            if own.lattice == lattice { values(own)[m] } else { own.lattice.stencil_near(place).gather(values(own)) }
        };
        let each = |values: &dyn Fn(&Self) -> &[f32]| (0..n).map(|m| at(values, m)).collect::<Vec<f32>>();
        let parts = std::array::from_fn(|part| each(&|own| &own.parts[part]));
        let free = each(&|own| &own.free);
        let component = |d: usize, c: usize| {
            each(&|own| {
                let n = own.lattice.len();
                &own.draws[d][c * n..(c + 1) * n]
            })
        };
        let draw = |d: usize| (0..3).flat_map(|c| component(d, c)).collect();
        let draws = (0..all[closest].draws.len()).map(draw).collect();
        Self { lattice, parts, free, draws }
    }

    fn part(&mut self, source: ErrorSource) -> &mut Vec<f32> {
        &mut self.parts[source as usize]
    }

    /// Adds the doubt beside borders between bodies: voxels of the full-resolution grid with
    /// the jump there (mm). The lattice lies on a level of `factor`.
    pub(crate) fn add_borders(&mut self, jumps: Vec<([usize; 3], f32)>, factor: [usize; 3]) {
        let lattice = self.lattice.clone();
        let cell: usize = (0..3).filter(|&a| lattice.shape[a] > 1).map(|a| lattice.step[a] * factor[a]).product();
        let borders = self.part(ErrorSource::Borders);
        for (voxel, jump) in jumps {
            let square = (SOURCE.side_fraction * jump).powi(2) / cell as f32;
            lattice.for_each_tap(to_level(VoxelPoint::of(voxel), factor), |node, w| borders[node] += w * square);
        }
    }

    /// Adds what other motions within the range of the search leave open (mm), where only this part
    /// of the features agree on the one that was found: the rest may be anywhere in that ball.
    pub(crate) fn set_other_motions(&mut self, agreeing: f64, range: f64) {
        let variance = ((1.0 - agreeing) * range * range / 5.0) as f32;
        self.part(ErrorSource::OtherMotions).fill(variance);
    }

    /// Adds the variance along an axis (mm^2) that landmarks show where most contradict the field.
    pub(crate) fn add_landmarks(&mut self, variance: f64) {
        self.part(ErrorSource::OtherMotions).iter_mut().for_each(|v| *v += variance as f32);
    }

    /// Widens all where the volumes have different contrasts, of whose variance their relation
    /// leaves this part.
    pub(crate) fn add_contrast(&mut self, left: f64) {
        let more = ((1.0 + SOURCE.contrast * left).powi(2) - 1.0) as f32;
        for m in 0..self.lattice.len() {
            let all: f32 = self.parts.iter().map(|part| part[m]).sum();
            self.part(ErrorSource::Misfit)[m] += more * all;
        }
    }

    /// The standard deviation along an axis (mm) at node `m`.
    fn at_node(&self, m: usize) -> f32 {
        self.parts.iter().map(|part| part[m]).sum::<f32>().sqrt()
    }

    /// The lattice over the full-resolution `grid`, of which this one has `factor` voxels each.
    fn full(&self, grid: &Grid, factor: [usize; 3]) -> Lattice {
        Lattice::new(grid.shape(), std::array::from_fn(|a| self.lattice.step[a] * factor[a]))
    }

    /// Coefficients (planar, three components) on the lattice over the full-resolution grid.
    fn on_full(&self, full: &Lattice, coefficients: Vec<f32>, factor: [usize; 3]) -> Vec<f32> {
        match full.nodes == self.lattice.nodes {
            true => coefficients,
            false => full.fit(|p| self.lattice.at(&coefficients, to_level(p, factor))),
        }
    }

    /// The standard deviation along an axis (mm) over the full-resolution `grid`; the lattice lies
    /// on a level of `factor`.
    pub fn deviation(&self, grid: &Grid, factor: [usize; 3]) -> ScalarSpline {
        let deviation: Vec<f32> = (0..self.lattice.len()).map(|m| self.at_node(m)).collect();
        let full = self.full(grid, factor);
        let mut values = self.on_full(&full, deviation.repeat(3), factor);
        values.truncate(full.len());
        ScalarSpline::new(*grid, full, values)
    }

    /// Errors that the displacement may have (mm, RAS): draws of the free field's, each node's
    /// widened to all that it is uncertain by.
    ///
    /// # Errors
    /// [`SpaceError`] when the lattice has no place in space.
    pub fn samples(&self, grid: &Grid, factor: [usize; 3]) -> Result<ErrorSamples, SpaceError> {
        let n = self.lattice.len();
        let wider: Vec<f32> =
            (0..n).map(|m| self.at_node(m) / self.free[m].sqrt().max(f32::MIN_POSITIVE.sqrt())).collect();
        let full = self.full(grid, factor);
        let axes = grid.axes();
        let sample = |draw: &Vec<f32>| {
            let widened = draw.iter().enumerate().map(|(at, v)| v * wider[at % n]).collect();
            let along = self.on_full(&full, widened, factor);
            let n = full.len();
            let world = |r: usize, m: usize| (0..3).map(|a| axes[r][a] as f32 * along[a * n + m]).sum::<f32>();
            (0..3).flat_map(|r| (0..n).map(move |m| (r, m))).map(|(r, m)| world(r, m)).collect()
        };
        ErrorSamples::new(spline::node_grid(grid, &full)?, self.draws.iter().map(sample).collect())
    }

    /// Each source's share of the variance at these voxels, greatest first.
    fn shares(&self, voxels: impl Iterator<Item = [usize; 3]>, factor: [usize; 3]) -> Vec<(ErrorSource, f64)> {
        let mut sums = [0.0f64; 6];
        for voxel in voxels {
            let stencil = self.lattice.stencil_near(to_level(VoxelPoint::of(voxel), factor));
            let parts = sums.iter_mut().zip(&self.parts);
            parts.for_each(|(sum, part)| *sum += f64::from(stencil.gather(part).max(0.0)));
        }
        let all = sums.iter().sum::<f64>().max(f64::MIN_POSITIVE);
        let mut shares: Vec<_> = ErrorSource::ALL.into_iter().zip(sums.map(|s| s / all)).collect();
        shares.sort_by(|a, b| b.1.total_cmp(&a.1));
        shares
    }

    /// The error to expect over `mask` of a field of this `deviation`.
    pub fn expected(
        &self,
        (deviation, factor): (&ScalarSpline, [usize; 3]),
        (field, mask): (&DenseField, &Mask),
        (model, rejected): (MotionModel, bool),
    ) -> ExpectedError {
        let grid = *mask.grid();
        let axes = if grid.is_single_slice() { 2 } else { 3 };
        let picked: Vec<usize> = some_of(mask).collect();
        let sigma: Vec<f32> = picked.iter().map(|&at| deviation.at(at)).collect();
        let count = picked.len().max(1) as f64;
        let motion = picked.iter().map(|&at| length(field, at)).sum::<f64>() / count;
        let mean_mm =
            CALIBRATION.mean_length * mean_length(axes) * sigma.iter().map(|&s| f64::from(s)).sum::<f64>() / count;
        ExpectedError {
            mean_mm,
            interval_mm: [mean_mm / CALIBRATION.interval, mean_mm * CALIBRATION.interval],
            p95_mm: longest(axes, sigma),
            against_mm: match (model, rejected) {
                (MotionModel::Identity, false) => edge(&grid),
                // The motion that was left out is the error.
                (MotionModel::Identity, true) => mean_mm,
                _ => motion,
            },
            sources: self.shares(picked.iter().map(|&at| grid.voxel(at)), factor),
            labels: Some(by_label(deviation, field, mask)).filter(|labels| labels.len() > 1).unwrap_or_default(),
        }
    }
}

/// The variance along an axis (mm^2) of the fields of these coefficients, at the nodes. Neighbours
/// are left out: beyond the tissue they are far more uncertain.
fn variance_of(lattice: &Lattice, draws: &[Vec<f32>]) -> Vec<f32> {
    let seen = (0..3).filter(|&a| lattice.shape[a] > 1).count().max(1);
    let square = |m: usize| {
        let stencil = lattice.stencil_near(lattice.within(m));
        let one = |draw: &Vec<f32>| draw.chunks_exact(lattice.len()).map(|c| stencil.gather(c).powi(2)).sum::<f32>();
        draws.iter().map(one).sum::<f32>() / (seen * draws.len().max(1)) as f32
    };
    (0..lattice.len()).into_par_iter().map(square).collect()
}

/// What the departure from the free field counts times where the evidence speaks against the stated
/// motion: its mean is then the mean error, and not that of a random one.
pub(super) fn left_out(axes: usize) -> f32 {
    ((axes as f64).sqrt() / (CALIBRATION.mean_length * mean_length(axes) * f64::from(CALIBRATION.region))) as f32
}

/// Displacement magnitude at a voxel (mm).
fn length(field: &DenseField, at: usize) -> f64 {
    field.at(at).iter().map(|v| f64::from(v * v)).sum::<f64>().sqrt()
}

/// The error to expect within each label of `mask`, from the least label on.
pub(super) fn by_label(deviation: &ScalarSpline, field: &DenseField, mask: &Mask) -> Vec<LabelError> {
    let axes = if mask.grid().is_single_slice() { 2 } else { 3 };
    // Voxels, their deviations and displacement magnitudes, by label.
    let mut sums = [(0usize, 0.0f64, 0.0f64); 256];
    for at in some_of(mask) {
        let (count, sigma, moved) = &mut sums[usize::from(mask.as_slice()[at])];
        *count += 1;
        *sigma += f64::from(deviation.at(at));
        *moved += length(field, at);
    }
    let of = |(label, &(count, sigma, moved)): (usize, &(usize, f64, f64))| LabelError {
        label: label as u8,
        expected_error_mm: CALIBRATION.mean_length * mean_length(axes) * sigma / count as f64,
        displacement_mean_mm: moved / count as f64,
    };
    sums.iter().enumerate().filter(|(_, s)| s.0 > 0).map(of).collect()
}

/// Compares an error with the mean displacement magnitude of `field` in `mask`, whole and by label.
pub(super) fn compare_with(expected: &mut ExpectedError, field: &DenseField, mask: &Mask) {
    let moved = |label: Option<u8>| {
        let here = |at: &usize| label.is_none_or(|l| mask.as_slice()[*at] == l);
        let lengths: Vec<f64> = some_of(mask).filter(here).map(|at| length(field, at)).collect();
        lengths.iter().sum::<f64>() / lengths.len().max(1) as f64
    };
    expected.against_mm = moved(None);
    expected.labels.iter_mut().for_each(|l| l.displacement_mean_mm = moved(Some(l.label)));
}

/// Gives each body the error of its label; one too small to be sampled has that of the `whole`
/// (mm).
pub(super) fn tell_bodies(bodies: &mut [BodyReport], labels: &[LabelError], whole: f64) {
    for body in bodies {
        let own = labels.iter().find(|l| l.label == body.label);
        body.expected_error_mm = own.map_or(whole, |l| l.expected_error_mm);
    }
}

/// Edge of a cube of a voxel's volume (mm).
fn edge(grid: &Grid) -> f64 {
    let shape = grid.shape();
    let thick: Vec<f64> = (0..3).filter(|&a| shape[a] > 1).map(|a| grid.spacing()[a]).collect();
    thick.iter().product::<f64>().powf(1.0 / thick.len().max(1) as f64)
}

/// Mean length of a normal error in two or three axes over its deviation along one.
fn mean_length(axes: usize) -> f64 {
    use std::f64::consts::PI;
    if axes == 2 { (PI / 2.0).sqrt() } else { (8.0 / PI).sqrt() }
}

/// Quantiles at 5, 15, ... 95 % of the length of a normal error over its deviation along an axis,
/// in two and three dimensions.
const LENGTH_QUANTILES: [[f32; 10]; 2] = [
    [0.3203, 0.5701, 0.7585, 0.9282, 1.0935, 1.2637, 1.4490, 1.6651, 1.9479, 2.4477],
    [0.5932, 0.8932, 1.1012, 1.2812, 1.4524, 1.6257, 1.8119, 2.0269, 2.3059, 2.7955],
];

/// 95th percentile of the length of normal errors of these deviations along an axis.
fn longest(axes: usize, sigma: Vec<f32>) -> f64 {
    let quantiles = LENGTH_QUANTILES[usize::from(axes == 3)];
    let mut all: Vec<f32> = sigma.iter().flat_map(|s| quantiles.map(|q| q * s)).collect();
    f64::from(quantile(&mut all, 0.95))
}

/// Voxels of the mask, evenly, at most about [`SAMPLED_VOXELS`].
pub(super) fn some_of(mask: &Mask) -> impl Iterator<Item = usize> {
    let mask = mask.as_slice();
    evenly(mask.len(), |at| mask[at] != 0, SAMPLED_VOXELS)
}

/// Of `count` voxels those that are `inside`, evenly, at most about `most`.
pub(super) fn evenly(count: usize, inside: impl Fn(usize) -> bool, most: usize) -> impl Iterator<Item = usize> {
    let step = (0..count).filter(|&at| inside(at)).count() / most;
    (0..count).filter(move |&at| inside(at)).step_by(step.max(1))
}

/// Median over the mask, from at most about [`SAMPLED_VOXELS`] of its voxels.
pub(super) fn median_inside(values: &ScalarSpline, mask: &Mask) -> f64 {
    let mut picked: Vec<f32> = some_of(mask).map(|at| values.at(at)).collect();
    f64::from(median(&mut picked))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A body that no sampled voxel lies in takes the error of the whole, not that of the next
    /// body.
    #[test]
    fn a_body_has_the_error_of_its_own_label() {
        let body =
            |label| BodyReport { label, voxels: 1, model: MotionModel::Free, slides_mm: 0.0, expected_error_mm: 0.0 };
        let error = |label, expected_error_mm| LabelError { label, expected_error_mm, displacement_mean_mm: 1.0 };
        let mut bodies = [body(1), body(4), body(7)];
        tell_bodies(&mut bodies, &[error(1, 0.1), error(7, 0.7)], 0.2);
        assert_eq!(bodies.map(|b| b.expected_error_mm), [0.1, 0.2, 0.7]);
    }
}
