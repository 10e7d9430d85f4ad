//! One level of the pyramid: matches by features, and the passes that bring the spline field to the
//! residual.

use crate::consistency::coupling::{self, Evidence, Posterior};
use crate::consistency::energy::{EnergyParams, Graph, distance};
use crate::consistency::models::AffineMotion;
use crate::consistency::pruning::{GATE, Measured, prune};
use crate::consistency::relaxation::relax;
use crate::features::{self, Corner, HarrisParams};
use crate::matching::candidates::{CandidateParams, Side, candidates};
use crate::matching::correlation::Searchable;
use crate::matching::gain::GainField;
use crate::matching::least_squares_matching::{self, Refined, Template};
use crate::matching::levels::from_level;
use crate::matching::pair::Pair;
use crate::matching::residual::{self, Baseline, normal_equations};
use crate::numerics::bending::{Coupled, Smoothness};
use crate::numerics::block_diagonal::Blocks;
use crate::numerics::bspline::Lattice;
use crate::numerics::fold_removal::unfold;
use crate::numerics::sampling::nearest;
use crate::numerics::simd::dispatch;
use crate::numerics::statistics::median;
use crate::numerics::symmetric3::{Symmetric3, inverse, quadratic, regularized_inverse};
use crate::numerics::{ablation, filters, pyramid};
use crate::pipeline::landmarks;
use crate::types::{Candidate, Counts, FieldParams, GridVector, LevelReport, SparseField, VoxelPoint};
use rayon::prelude::*;
use std::borrow::Cow;

/// A spline field on one level, with the state of its coupling.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct SplineField {
    /// Nodes over the level's initial lattice.
    pub lattice: Lattice,
    /// Displacement (mm along the lattice's axes), planar.
    pub coefficients: Vec<f32>,
    /// Weight of the bending energy at each node and axis (planar), per mm^3 of lattice cell.
    pub smoothness: Vec<f32>,
    /// Information of the last pass (1/mm^2), one block a node.
    pub blocks: Blocks,
}

/// Iteration control of the residual passes.
struct PassControl {
    /// Largest initial weight of the bending energy per mm^3 of lattice cell: a larger one holds
    /// small moving parts to the still tissue around them.
    max_initial_smoothness: f32,
    /// Initial weight over the one that matches suggest, until the evidence sets it after two
    /// passes: a smaller one left a fifth more error on a thigh.
    initial_stiffening: f32,
    /// Part of the last step carried into the next (heavy ball, Polyak 1964; restart, O'Donoghue &
    /// Candes 2015): 0.8 leaves 1 % less error over twelve pairs, but up to 5 % more.
    momentum: f32,
    /// Root mean square step (finest voxels) below which the passes end.
    convergence_tolerance_voxels: f64,
    /// Largest displacement of a node along an axis (finest voxels): beyond it, the residual of
    /// smooth tissue does not point to the match.
    max_displacement_voxels: f64,
    /// Conjugate gradient iterations in a pass: each needs only an approximate step.
    cg_iterations: usize,
}

const PASS: PassControl = PassControl {
    max_initial_smoothness: 30.0,
    initial_stiffening: 30.0,
    momentum: 0.5,
    convergence_tolerance_voxels: 0.008,
    max_displacement_voxels: 2.0,
    cg_iterations: 10,
};

impl SplineField {
    /// The displacement at a place of the level.
    pub(crate) fn at(&self, p: VoxelPoint) -> GridVector {
        self.lattice.at(&self.coefficients, p)
    }

    /// No motion, with a bending energy to start from.
    pub fn still(lattice: Lattice) -> Self {
        let n = 3 * lattice.len();
        Self {
            lattice,
            coefficients: vec![0.0; n],
            smoothness: vec![PASS.max_initial_smoothness; n],
            blocks: Blocks::default(),
        }
    }

    /// The same without the information at its nodes.
    pub(crate) fn without_blocks(&self) -> Self {
        let Self { lattice, coefficients, smoothness, .. } = self;
        Self {
            lattice: lattice.clone(),
            coefficients: coefficients.clone(),
            smoothness: smoothness.clone(),
            blocks: Blocks::default(),
        }
    }

    /// Of matches alone, with a bending energy to start passes from.
    pub(crate) fn before_passes(mut self) -> Self {
        self.smoothness.iter_mut().for_each(|s| *s = (PASS.initial_stiffening * *s).min(PASS.max_initial_smoothness));
        self
    }
}

/// Volume of a lattice cell (mm^3), flat axes counting 1.
pub(super) fn cell_volume(lattice: &Lattice, spacing: [f64; 3]) -> f64 {
    (0..3).filter(|&a| lattice.shape[a] > 1).map(|a| lattice.step[a] as f64 * spacing[a]).product()
}

/// The bending energy over a lattice.
pub fn smoothness(lattice: &Lattice, spacing: [f64; 3]) -> Smoothness {
    Smoothness::new(lattice.nodes, std::array::from_fn(|a| lattice.step[a] as f64 * spacing[a]))
}

/// A lattice whose nodes are `step` of the finest axis' voxels apart along every axis (in mm).
pub fn lattice(pair: &Pair<'_>, step: usize) -> Lattice {
    Lattice::new(pair.shape, pair.in_voxels(step))
}

/// Information per voxel that noise correlated by the spline filter leaves: 1 / (2 along each
/// axis).
pub(super) fn independent(pair: &Pair<'_>) -> f32 {
    (0..3).filter(|&a| pair.shape[a] > 1).fold(1.0, |v, _| v / least_squares_matching::NOISE_CORRELATION_VOXELS as f32)
}

/// Nodes of a lattice from which memory is saved at the cost of time: systems are solved one by
/// one, and the warped volume is not kept.
const MEMORY_SAVING_NODES: usize = 500_000;

/// Least Jacobian determinant of tissue; a field below it is smoothed.
pub(super) const MIN_JACOBIAN: f32 = 0.1;

/// Passes: warp, measure gain and residual, couple; the weight of the bending energy follows the
/// evidence by place and axis ([`coupling::supported`]). No node ends further than two voxels of
/// the finest axis from where it began, along each axis. Calls `tick` after each pass.
pub fn refine(pair: &Pair<'_>, field: &mut SplineField, passes: usize, seed: u64, tick: impl Fn(usize)) {
    let begun = field.coefficients.clone();
    refine_from(pair, field, &begun, passes, seed, tick);
}

/// As [`refine`], where earlier passes began at the coefficients `begun`.
pub(super) fn refine_from(
    pair: &Pair<'_>,
    field: &mut SplineField,
    begun: &[f32],
    passes: usize,
    seed: u64,
    tick: impl Fn(usize),
) {
    advance(pair, field, begun, Held::Whole, passes, seed, tick);
}

/// Passes of [`twicing`]: one leaves waves of 20 to 30 voxels 1 % lower, and twelve pairs with 2 %
/// more error.
const TWICING_PASSES: usize = 2;

/// Passes from a settled field in which the bending energy holds the change alone (twicing; Tukey
/// 1977): what it flattened of long waves comes back, and short ones stay out.
pub(crate) fn twicing(pair: &Pair<'_>, field: &mut SplineField, seed: u64) {
    let begun = field.coefficients.clone();
    advance(pair, field, &begun, Held::Change, TWICING_PASSES, seed, |_| ());
}

/// What the bending energy is counted of.
#[derive(Clone, Copy, PartialEq)]
enum Held {
    /// The field, with weights that follow the evidence.
    Whole,
    /// What it has changed by since passes began, with the weights as they are.
    Change,
}

/// The passes of [`refine`] and [`twicing`].
fn advance(
    pair: &Pair<'_>,
    field: &mut SplineField,
    begun: &[f32],
    held: Held,
    passes: usize,
    seed: u64,
    tick: impl Fn(usize),
) {
    let energy = smoothness(&field.lattice, pair.spacing);
    let cell = cell_volume(&field.lattice, pair.spacing);
    let active = pair.spans.grown(1);
    let weight = independent(pair);
    let finest = pyramid::finest(pair.shape, pair.spacing);
    // Landmarks hold what texture does not.
    let reach = (PASS.max_displacement_voxels * finest).max(landmarks::reach(pair, field)) as f32;
    let mut before = field.coefficients.clone();
    let mut probe = coupling::Probe::new(field.lattice.len(), seed);
    let large = field.lattice.len() >= MEMORY_SAVING_NODES;
    let mut warped = Vec::new();
    for pass in 0..passes {
        // Those of the pass before serve nobody any more.
        field.blocks = Blocks::default();
        if warped.is_empty() {
            warped = pair.unseen();
        }
        pair.warp_again(&field.lattice, &field.coefficients, &active, &mut warped);
        let gain = GainField::sharpened(pair, &warped);
        let mut equations = normal_equations(pair, &warped, &gain, &field.lattice, 1e-3 * pair.noise);
        equations.scale(weight);
        let to_come = passes - 1 - pass;
        landmarks::pull(pair, field, &mut equations, to_come);
        let information = equations.information();
        let weights: Vec<f32> = field.smoothness.iter().map(|s| s * cell as f32).collect();
        if large {
            warped = Vec::new();
        }
        let settled = held == Held::Whole && (pass % 2 == 1 || pass + 1 == passes);
        let limit = if pass < 2 { 20 } else { 10 };
        let matrix = Coupled::new(&energy, &weights, &equations.blocks, false);
        let bent: Cow<'_, [f32]> = match held {
            Held::Whole => field.coefficients[..].into(),
            Held::Change => field.coefficients.iter().zip(begun).map(|(c, begun)| c - begun).collect(),
        };
        let rhs = equations.rhs;
        let step = || coupling::step(&matrix, rhs, &bent, 0.02, PASS.cg_iterations);
        // From the last pass's solution a few iterations suffice, though the blocks and weights
        // have changed.
        let informed = || Coupled::new(&energy, &weights, &information, false);
        let mut determine = || settled.then(|| probe.determined(&informed(), limit));
        // Neither needs the other, and the planes of a small lattice are not worth sharing out;
        // those of a large one are, and only one of the two then needs its vectors.
        let ((_, step, length), determined) = if large { (step(), determine()) } else { rayon::join(step, determine) };
        for (((c, d), before), begun) in field.coefficients.iter_mut().zip(step).zip(&mut before).zip(begun) {
            let last = *c - std::mem::replace(before, *c);
            let carried = if d * last > 0.0 { PASS.momentum * last } else { 0.0 };
            *c = (*c + d + carried).clamp(begun - reach, begun + reach);
        }
        if ablation::is_on("unfold") {
            unfold(&field.lattice, pair.spacing, &mut field.coefficients, MIN_JACOBIAN);
        }
        field.blocks = information;
        if let Some(determined) = determined {
            let n = field.lattice.len();
            let bent: Vec<f32> =
                field.coefficients.chunks_exact(n).flat_map(|component| energy.density(component)).collect();
            let seen = field.blocks.iter().filter(|b| b[0] + b[1] + b[2] > 0.0).count();
            let target = coupling::supported(&determined, &bent, field.lattice.nodes, seen);
            for (smoothness, target) in field.smoothness.iter_mut().zip(target) {
                *smoothness = (target / cell as f32).clamp(*smoothness / 5.0, *smoothness * 5.0).clamp(1e-6, 1e9);
            }
        }
        tick(pass);
        if f64::from(length) < PASS.convergence_tolerance_voxels * finest
            && pass >= 3
            && landmarks::are_settled(pair, to_come)
        {
            break;
        }
    }
}

/// Degrees of freedom that the data of the last pass determine.
pub fn determined(pair: &Pair<'_>, field: &SplineField, seed: u64) -> f64 {
    let energy = smoothness(&field.lattice, pair.spacing);
    let cell = cell_volume(&field.lattice, pair.spacing) as f32;
    let weights: Vec<f32> = field.smoothness.iter().map(|s| s * cell).collect();
    let matrix = Coupled::new(&energy, &weights, &field.blocks, false);
    coupling::determined(&matrix, seed, 30).iter().sum::<f64>().max(12.0)
}

/// Voxels of the finest axis between the places at which motion models are compared with the free
/// field: 8, 12 and 16 leave the same errors over 24 pairs.
const MODEL_NODE_SPACING_VOXELS: usize = 12;

/// The places about which a map is compared with the free field.
pub fn windows(pair: &Pair<'_>) -> Lattice {
    lattice(pair, MODEL_NODE_SPACING_VOXELS)
}

/// The excess misfit of a map against the free field about each of [`windows`], which adds up to
/// that of the whole; from every fourth slice of a thick volume, every eighth of a very thick one,
/// with the information that correlated noise leaves.
pub fn excess<'a>(
    pair: &'a Pair<'a>,
    field: &'a SplineField,
    windows: &'a Lattice,
) -> impl Fn(&AffineMotion) -> Vec<f32> + 'a {
    let every = match pair.shape.into_iter().min().unwrap_or(1) {
        0..48 => 1,
        48..256 => 4,
        _ => 8,
    };
    // Of the slices between nothing is held.
    let some = pair.within(pair.spans.slices(|k| k % every == every / 2));
    let free = Baseline::new(&some, some.warp_sparsely(&field.lattice, &field.coefficients));
    let weight = every as f32 * independent(pair);
    move |motion| {
        let map = field.lattice.fit(|p| motion.on_grid(p, some.spacing));
        let warped = some.warp_sparsely(&field.lattice, &map);
        let mut by_place = residual::excess_by_place(&some, &warped, &free, windows);
        by_place.iter_mut().for_each(|v| *v *= weight);
        landmarks::add_excess(pair, field, motion, windows, &mut by_place);
        by_place
    }
}

/// Random vectors from which the posterior deviation is estimated.
const POSTERIOR_DRAWS: usize = 6;

/// What the data of the last pass leave open and what they determine, at the field's own nodes.
pub fn posterior(field: &SplineField, spacing: [f64; 3], seed: u64) -> Posterior {
    let energy = smoothness(&field.lattice, spacing);
    let cell = cell_volume(&field.lattice, spacing) as f32;
    let weights: Vec<f32> = field.smoothness.iter().map(|s| s * cell).collect();
    coupling::posterior(&energy, &weights, &field.blocks, field.lattice.nodes, POSTERIOR_DRAWS, seed)
}

/// By how much the misfit shrinks from one warp to another, with the information that correlated
/// noise leaves.
pub(crate) fn gained(pair: &Pair<'_>, from: &[f32], to: Vec<f32>) -> f64 {
    residual::excess(pair, from, &Baseline::new(pair, to)) * f64::from(independent(pair))
}

/// Mean and largest length over the mask (mm) of the displacement `at` a place, from every third
/// voxel along each axis.
pub fn lengths(pair: &Pair<'_>, at: impl Fn(VoxelPoint) -> GridVector) -> [f64; 2] {
    let [nx, ny, nz] = pair.shape;
    let (mut sum, mut count, mut largest) = (0.0, 0usize, 0.0f64);
    for (j, k) in (0..nz).step_by(3).flat_map(|k| (0..ny).step_by(3).map(move |j| (j, k))) {
        for i in (0..nx).step_by(3).filter(|i| pair.mask[i + nx * (j + ny * k)] != 0) {
            let length = distance(at(VoxelPoint::of([i, j, k])).0, [0.0; 3]);
            (sum, count, largest) = (sum + length, count + 1, largest.max(length));
        }
    }
    [sum / count.max(1) as f64, largest]
}

/// Whether the deformed volume shows what is at `p` in the initial one and moves by `u`.
pub fn sees(pair: &Pair<'_>, VoxelPoint(p): VoxelPoint, GridVector(u): GridVector) -> bool {
    let shape = pair.moving_shape;
    let along = |a: usize| p[a] + u[a] / pair.spacing[a] - pair.moving_origin[a];
    let there = VoxelPoint(std::array::from_fn(|a| if shape[a] > 1 { along(a) } else { 0.0 }));
    nearest(shape, there).is_some_and(|at| pair.moving[at].is_finite())
}

/// The part of the mask that the deformed volume does not show (1), from every third voxel along
/// each axis; `at` gives the displacement at a place.
pub fn unseen(pair: &Pair<'_>, at: impl Fn(VoxelPoint) -> GridVector + Sync) -> f64 {
    let [nx, ny, nz] = pair.shape;
    let in_plane = |k: usize| -> [usize; 2] {
        let every = (0..ny).step_by(3).flat_map(|j| (0..nx).step_by(3).map(move |i| [i, j, k]));
        let inside = every.filter(|[i, j, k]| pair.mask[i + nx * (j + ny * k)] != 0);
        inside.fold([0; 2], |[out, all], v| {
            let p = VoxelPoint::of(v);
            [out + usize::from(!sees(pair, p, at(p))), all + 1]
        })
    };
    let planes: Vec<usize> = (0..nz).step_by(3).collect();
    let [out, all] = planes.into_par_iter().map(in_plane).reduce(|| [0; 2], |a, b| [a[0] + b[0], a[1] + b[1]]);
    out as f64 / all.max(1) as f64
}

/// How the two volumes differ once the deformed one is warped: the robust standard deviation of
/// what is left (intensity), and by what factor the gain varies ([`GainField::variation`]).
pub fn misfit(pair: &Pair<'_>, warped: &[f32]) -> [f32; 2] {
    let [gain, sharpened] = GainField::both(pair, warped);
    [residual::residual_sigma(pair, warped, &gain), sharpened.variation(pair)]
}

/// The field of a coarser level on this level's lattice; `from_here` maps voxels of this level to
/// that one's.
pub fn carry(
    coarse: &SplineField,
    lattice: Lattice,
    from_here: impl Fn(VoxelPoint) -> VoxelPoint + Sync,
) -> SplineField {
    let coefficients = lattice.fit(|p| coarse.at(from_here(p)));
    let smoothness = resampled(&coarse.lattice, &coarse.smoothness, &lattice, &from_here);
    SplineField { lattice, coefficients, smoothness, blocks: Blocks::default() }
}

/// Values at the nodes of one lattice (planar, three components) at those of another; `place` maps
/// the voxels of `to` to those of `from`. Positive values stay so.
fn resampled(
    from: &Lattice,
    values: &[f32],
    to: &Lattice,
    place: impl Fn(VoxelPoint) -> VoxelPoint + Sync,
) -> Vec<f32> {
    let n = to.len();
    let at: Vec<[f64; 3]> = (0..n).into_par_iter().map(|m| from.at(values, place(to.place(m))).0).collect();
    (0..3).flat_map(|c| at.iter().map(move |v| v[c] as f32)).collect()
}

/// What the feature stages need to know.
#[derive(Debug, Clone, Copy)]
pub(crate) struct MatchParams {
    /// Features wanted in the initial volume; up to five times as many in the deformed one.
    pub points: usize,
    /// Whether the number was asked for: then corners are sought voxel by voxel even where there
    /// is room for blocks.
    pub thorough: bool,
    /// Reach of the search about the known field (mm).
    pub reach_mm: f64,
    /// Patch radius (voxels of the finest axis).
    pub patch: usize,
    /// Strain that neighbours may show against the known field.
    pub strain: f64,
    /// Candidates kept from each source, at most 3 about a known field.
    pub candidates: usize,
    /// Whether neighbours choose among candidates, and those that fit nowhere are cast out.
    pub consistency: bool,
    /// Whether places are refined to a fraction of a voxel.
    pub sub_voxel: bool,
}

impl MatchParams {
    /// In the order of the fields; how matches are chosen is as `params` say.
    pub fn new(params: &FieldParams, points: usize, thorough: bool, reach_mm: f64, patch: usize, strain: f64) -> Self {
        let FieldParams { candidates, consistency, sub_voxel, .. } = *params;
        Self { points, thorough, reach_mm, patch, strain, candidates, consistency, sub_voxel }
    }

    /// About a field that has most features within a voxel of the finest axis already.
    pub fn near(params: &FieldParams, pair: &Pair<'_>, points: usize, thorough: bool) -> Self {
        Self::new(params, points, thorough, pyramid::finest(pair.shape, pair.spacing), SparseField::PATCH, 0.05)
    }
}

/// One feature's match on a level.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LevelMatch {
    /// Place on the level's initial lattice.
    pub voxel: VoxelPoint,
    /// Displacement, covariance and the coupled field's displacement (mm along the lattice's axes).
    pub measured: Measured,
    /// Correlation.
    pub ncc: f32,
    /// Survived consistency.
    pub kept: bool,
}

impl LevelMatch {
    /// What a field is coupled to ([`couple`]).
    pub(super) fn seen(&self) -> (VoxelPoint, GridVector, Symmetric3) {
        (self.voxel, GridVector(self.measured.displacement), self.measured.covariance)
    }
}

/// Features of both volumes, many-to-many candidates, relaxation, least-squares matching, coupling,
/// pruning.
///
/// With `known`, the deformed volume is first warped by that field and only the rest is sought; the
/// field itself then serves as the coupled one. Without, the search is over the deformed volume as
/// it is, and a coupled field is fitted: it is returned, on a lattice of its own.
pub fn matches(
    pair: &Pair<'_>,
    known: Option<&SplineField>,
    params: MatchParams,
) -> (Vec<LevelMatch>, Option<SplineField>, LevelReport) {
    let spacing = pair.spacing;
    let radius = pair.in_voxels(params.patch);
    let warped = known.map(|k| pair.warp(&k.lattice, &k.coefficients, &pair.spans.grown(radius[0] + 3)));
    let Sought { initial, starts, deformed, list, origin } = sought(pair, warped.as_deref(), &params);
    let mm: Vec<[f64; 3]> = starts.iter().map(|p| p.in_mm(spacing)).collect();
    let (chosen, [energy_before, energy_after]) = assigned(pair, &mm, &list, &params);

    // Sub-voxel position and covariance of each choice.
    let template = template(pair, radius);
    let place = |i: usize| {
        let start = list[i].get(chosen[i])?.displacement;
        let centre = initial[i].centre;
        let VoxelPoint(at) = VoxelPoint::of(centre).moved(start, spacing);
        let at = std::array::from_fn(|a| at[a] - origin[a]);
        let mut found = refined(pair, warped.as_deref(), &template, centre, at, radius)?;
        if !params.sub_voxel {
            found.shift = GridVector::ZERO;
        }
        Some((i, start, found))
    };
    let refined: Vec<Option<(usize, GridVector, Refined)>> = (0..initial.len()).into_par_iter().map(place).collect();
    let refined: Vec<_> = refined.into_iter().flatten().collect();

    // The coupled field: the known one, or one fitted to all matches with their information.
    let fitted = known.is_none().then(|| fit(pair, &starts, &refined, &radius));
    let field = known.or(fitted.as_ref());
    let measured = |(i, start, r): &(usize, GridVector, Refined)| {
        let u = field.map_or(GridVector::ZERO, |f| f.at(starts[*i]));
        let base = if known.is_some() { u } else { GridVector::ZERO };
        let displacement = base.plus(start.plus(r.shift)).0;
        Measured { place: mm[*i], displacement, covariance: r.covariance, field: u.0 }
    };
    let mut measured: Vec<Measured> = refined.iter().map(measured).collect();
    let floor = 0.2 * pyramid::finest(pair.shape, spacing);
    let kept = if is_consistent(&params) { prune(&measured, floor, GATE) } else { vec![true; measured.len()] };
    calibrate(&mut measured, &kept);
    let distances = measured.iter().zip(&kept).filter(|(_, k)| **k);
    let mut residual: Vec<f32> = distances.map(|(m, _)| distance(m.displacement, m.field) as f32).collect();
    let counts = Counts {
        features_initial: initial.len(),
        features_deformed: deformed,
        candidates: list.iter().map(Vec::len).sum(),
        kept: residual.len(),
        ..Counts::default()
    };
    let residual_mm = if residual.is_empty() { 0.0 } else { f64::from(median(&mut residual)) };
    let report = LevelReport { spacing_mm: spacing, counts, energy_before, energy_after, residual_mm };
    let matches = refined.iter().zip(measured).zip(kept).map(|(((i, _, r), measured), kept)| LevelMatch {
        voxel: starts[*i],
        measured,
        ncc: r.ncc,
        kept,
    });
    (matches.collect(), fitted, report)
}

/// Whether matches must agree with their neighbours.
fn is_consistent(params: &MatchParams) -> bool {
    params.consistency && ablation::is_on("consistency")
}

/// Features of both volumes with their candidate matches.
struct Sought {
    initial: Vec<Corner>,
    /// The places of the initial features.
    starts: Vec<VoxelPoint>,
    /// Number of features in the deformed volume.
    deformed: usize,
    list: Vec<Vec<Candidate>>,
    /// The place of the deformed volume's first voxel (voxels).
    origin: [f64; 3],
}

/// Seeks candidates in the deformed volume: as it is, or `warped` by a known field, where the
/// features of both volumes share one frame.
fn sought(pair: &Pair<'_>, warped: Option<&[f32]>, params: &MatchParams) -> Sought {
    let (spacing, noise) = (pair.spacing, pair.noise);
    let radius = pair.in_voxels(params.patch);
    let smooth;
    let (data, smooth_data, shape, origin) = match warped {
        Some(w) => (w, w, pair.shape, [0.0; 3]),
        None => {
            smooth = filters::bspline(&pair.moving, pair.moving_shape);
            (&pair.moving[..], smooth.as_slice(), pair.moving_shape, pair.moving_origin)
        }
    };
    let room = pair.inside as f64 / params.points as f64;
    let quick = !params.thorough && room >= BLOCKWISE_VOXELS_PER_POINT;
    let initial = corners(&pair.fixed_smooth, pair.shape, spacing, Some(&pair.mask), noise, room, quick, params.points);
    let within = warped.is_some().then_some(&pair.mask[..]);
    let room = if params.thorough && warped.is_some() { room / 5.0 } else { room };
    let deformed = corners(smooth_data, shape, spacing, within, noise, room, quick, 5 * params.points);
    let [starts, places] = [&initial, &deformed].map(|all| all.iter().map(|c| c.voxel).collect::<Vec<_>>());
    let fixed = if warped.is_some() { &pair.fixed_smooth[..] } else { &pair.fixed[..] };
    let searchable = if warped.is_some() { Searchable::near } else { Searchable::new };
    let (here, there) = (searchable(fixed, pair.shape, radius), searchable(data, shape, radius));
    let list = candidates(
        &Side { volume: &here, origin: [0.0; 3], features: &starts },
        &Side { volume: &there, origin, features: &places },
        spacing,
        CandidateParams {
            reach_mm: params.reach_mm,
            keep: if warped.is_some() { params.candidates.min(3) } else { params.candidates },
            partners: 16,
            min_ncc: 0.3,
        },
    );
    Sought { initial, starts, deformed: deformed.len(), list, origin }
}

/// One candidate for each feature (at `places`, mm): by relaxation, or the best-correlated; with
/// the energy a place of the best-correlated ones and of the choice.
fn assigned(
    pair: &Pair<'_>,
    places: &[[f64; 3]],
    list: &[Vec<Candidate>],
    params: &MatchParams,
) -> (Vec<usize>, [f64; 2]) {
    let precision_mm = pyramid::finest(pair.shape, pair.spacing);
    let energy = EnergyParams { lambda: 1.5, precision_mm, strain: params.strain, neighbours: 16 };
    let graph = Graph::new(places, energy);
    if is_consistent(params) {
        let relaxed = relax(&graph, list);
        return (relaxed.chosen, [relaxed.energy_before, relaxed.energy_after]);
    }
    let chosen = vec![0; list.len()];
    let energy = graph.energy(list, &chosen);
    (chosen, [energy; 2])
}

/// Least-squares matching of the patch about `centre`, which begins at `at` (voxels of the deformed
/// volume).
fn refined(
    pair: &Pair<'_>,
    warped: Option<&[f32]>,
    template: &Template<'_>,
    centre: [usize; 3],
    at: [f64; 3],
    radius: [usize; 3],
) -> Option<Refined> {
    let place = |o: [f32; 3]| -> [f32; 3] { std::array::from_fn(|a| at[a] as f32 + o[a]) };
    match warped {
        Some(w) => {
            let patch = |shift, out: &mut [f32]| trilinear_patch(w, pair.shape, place(shift), radius, out);
            least_squares_matching::refine(template, centre, patch, 3, 2.0)
        }
        None => {
            let patch = |shift, out: &mut [f32]| pair.sampler().patch(place(shift), radius, out);
            least_squares_matching::refine(template, centre, patch, 6, 2.0)
        }
    }
}

/// Least-squares matching alone, about a field that has each place within two voxels: what is left
/// there is measured in the deformed volume warped by it. One match a place that has one,
/// none rejected yet.
pub(super) fn follow(
    pair: &Pair<'_>,
    known: &SplineField,
    places: impl IntoParallelIterator<Item = VoxelPoint, Iter: IndexedParallelIterator>,
    patch: usize,
) -> Vec<LevelMatch> {
    let radius = pair.in_voxels(patch);
    let warped = pair.warp(&known.lattice, &known.coefficients, &pair.spans.grown(radius[0] + 3));
    let template = template(pair, radius);
    let measure = |voxel: VoxelPoint| {
        let centre = std::array::from_fn(|a| (voxel.0[a].round().max(0.0) as usize).min(pair.shape[a] - 1));
        let place = |o: [f32; 3]| std::array::from_fn(|a| centre[a] as f32 + o[a]);
        let patch = |shift, out: &mut [f32]| trilinear_patch(&warped, pair.shape, place(shift), radius, out);
        let found = least_squares_matching::refine(&template, centre, patch, 3, 2.0)?;
        let field = known.at(voxel);
        let measured = Measured {
            place: voxel.in_mm(pair.spacing),
            displacement: field.plus(found.shift).0,
            covariance: found.covariance,
            field: field.0,
        };
        Some(LevelMatch { voxel, measured, ncc: found.ncc, kept: true })
    };
    places.into_par_iter().map(measure).collect::<Vec<_>>().into_iter().flatten().collect()
}

/// The initial volume's side of the least-squares matching on a level.
fn template<'a>(pair: &'a Pair<'_>, radius: [usize; 3]) -> Template<'a> {
    let noise = f64::from(pair.noise) * f64::from(independent(pair)).sqrt();
    Template { data: &pair.fixed_smooth, shape: pair.shape, spacing: pair.spacing, radius, noise }
}

/// The field that matches suggest once the deformed volume is warped by `field`: where that one is
/// right their patches are no longer sheared, and where it is wrong what is missing has neighbours
/// that are in place.
pub(crate) fn matches_again(
    pair: &Pair<'_>,
    field: &SplineField,
    params: MatchParams,
) -> (Vec<LevelMatch>, Option<SplineField>, LevelReport) {
    let finest = pyramid::finest(pair.shape, pair.spacing);
    let around = pair.spans.grown((params.reach_mm / finest).ceil() as usize + params.patch);
    let rest = Pair {
        moving: pair.warp(&field.lattice, &field.coefficients, &around).into(),
        moving_shape: pair.shape,
        moving_origin: [0.0; 3],
        ..pair.within(pair.spans.clone())
    };
    let lattice = &field.lattice;
    let (mut found, more, report) = matches(&rest, None, params);
    let joined = more.map(|more| {
        let coefficients = lattice.fit(|p| {
            let step = more.at(p);
            step.plus(field.at(p.moved(step, pair.spacing)))
        });
        SplineField { coefficients, ..field.clone() }
    });
    // A match leads to a place of the warped volume; the field takes it on from there.
    for m in &mut found {
        let step = GridVector(m.measured.displacement);
        m.measured.displacement = step.plus(field.at(m.voxel.moved(step, pair.spacing))).0;
    }
    (found, joined, report)
}
/// Scales all covariances so that the kept matches scatter about the coupled field as they say: by
/// the median squared Mahalanobis distance over chi-square's median, 2.366. Noise alone does not
/// tell what interpolation, strain inside a patch and contrast changes add.
pub(super) fn calibrate(measured: &mut [Measured], kept: &[bool]) {
    let mut q: Vec<f32> = measured
        .iter()
        .zip(kept)
        .filter(|(_, k)| **k)
        .filter_map(|(m, _)| {
            let e = std::array::from_fn(|a| m.displacement[a] - m.field[a]);
            Some(quadratic(&regularized_inverse(&m.covariance)?, e) as f32)
        })
        .collect();
    if q.len() < 20 {
        return;
    }
    let factor = f64::from(median(&mut q)) / 2.366;
    for m in measured {
        m.covariance = m.covariance.map(|v| v * factor.max(0.05));
    }
}

/// Voxels for each point from which corners are detected on blocks of two voxels.
const BLOCKWISE_VOXELS_PER_POINT: f64 = 100.0;

/// Corners of a smoothed volume. `room` is the number of voxels for each point wanted: with less of
/// it the window is narrower, which has more maxima. `quick` works the structure tensor out on
/// blocks of two voxels, at an eighth of the cost.
fn corners(
    smooth: &[f32],
    shape: [usize; 3],
    spacing: [f64; 3],
    mask: Option<&[u8]>,
    noise: f32,
    room: f64,
    quick: bool,
    wanted: usize,
) -> Vec<Corner> {
    let finest = pyramid::finest(shape, spacing);
    let widest = HarrisParams::default().integration_sigma;
    let sigma = (room.cbrt() / 8.0).clamp(0.7, widest);
    // Noise alone answers with about a thousandth of its variance per squared voxel where it is
    // weakest.
    let least = 0.002 * (f64::from(noise) / finest).powi(2) as f32;
    let halved = |a: usize| quick && shape[a] >= 24 && spacing[a] < 1.5 * finest;
    let step: [usize; 3] = std::array::from_fn(|a| if halved(a) { 2 } else { 1 });
    let inside = mask.map(|m| pyramid::reduce_mask(m, shape, step));
    let mut found = features::corners(smooth, (shape, spacing), (sigma, step), inside.as_deref(), wanted, least);
    for corner in &mut found {
        corner.voxel = from_level(corner.voxel, step);
        corner.centre = std::array::from_fn(|a| (corner.voxel.0[a].round().max(0.0) as usize).min(shape[a] - 1));
    }
    found
}

/// The robust fit of a field to matches alone.
struct MatchFit {
    /// Iterations: the robust scale has then fallen to three standard deviations.
    iterations: usize,
    /// The same from a field that is nearly right.
    refit_iterations: usize,
    /// Voxels between nodes: over 37 pairs 3 to 6 left the same error to 0.1 %, and 6 needs an
    /// eighth of the nodes of 3.
    node_spacing_voxels: usize,
}

const MATCH_FIT: MatchFit = MatchFit { iterations: 7, refit_iterations: 3, node_spacing_voxels: 6 };

/// Couples the matches of a level into a spline field.
fn fit(
    pair: &Pair<'_>,
    starts: &[VoxelPoint],
    refined: &[(usize, GridVector, Refined)],
    radius: &[usize; 3],
) -> SplineField {
    let measured = refined.iter().map(|(i, start, r)| (starts[*i], start.plus(r.shift), r.covariance));
    couple(pair, measured, (radius, 0.3), None).0
}

/// Couples displacements measured on a level (place, displacement, covariance in mm^2) into a
/// spline field, from one that is nearly right and on its lattice where there is one; with the
/// evidence used. Each may be off by `floor` voxels beyond its covariance, and was found with a
/// patch of `radius` voxels.
pub(super) fn couple(
    pair: &Pair<'_>,
    measured: impl ExactSizeIterator<Item = (VoxelPoint, GridVector, Symmetric3)>,
    (radius, floor): (&[usize; 3], f64),
    known: Option<&SplineField>,
) -> (SplineField, Vec<Evidence>) {
    // Patches overlap: each match counts for the share of voxels that is its own.
    let inside = pair.inside.max(1) as f64;
    let patch: f64 = (0..3).filter(|&a| pair.shape[a] > 1).map(|a| (2 * radius[a] + 1) as f64).product();
    let share = (inside / (measured.len().max(1) as f64 * patch)).min(1.0);
    let finest = pyramid::finest(pair.shape, pair.spacing);
    let evidence: Vec<Evidence> = measured
        .map(|(at, displacement, mut c)| {
            for v in &mut c[..3] {
                *v += (floor * finest).powi(2);
            }
            // What has no inverse says nothing.
            let information = inverse(&c).unwrap_or([0.0; 6]).map(|v| v * share);
            Evidence { at, displacement, information }
        })
        .collect();
    let lattice = known.map_or_else(|| lattice(pair, MATCH_FIT.node_spacing_voxels), |k| k.lattice.clone());
    let energy = smoothness(&lattice, pair.spacing);
    let cell = cell_volume(&lattice, pair.spacing) as f32;
    let (coefficients, weight) = match known {
        Some(known) => {
            let start = (&known.coefficients[..], known.smoothness[0] * cell);
            coupling::fit_from(&lattice, &energy, &evidence, Some(start), MATCH_FIT.refit_iterations)
        }
        None => coupling::fit(&lattice, &energy, &evidence, MATCH_FIT.iterations),
    };
    let smoothness = vec![weight / cell; 3 * lattice.len()];
    (SplineField { lattice, coefficients, smoothness, blocks: Blocks::default() }, evidence)
}

/// Trilinear samples of the patch of `radius` about `centre` (voxels), x fastest; NaN where it
/// leaves the volume.
fn trilinear_patch(data: &[f32], shape: [usize; 3], centre: [f32; 3], radius: [usize; 3], out: &mut [f32]) {
    let stride = [1, shape[0], shape[0] * shape[1]];
    let (mut base, mut t, mut step) = (0usize, [0.0f32; 3], [0usize; 3]);
    for a in (0..3).filter(|&a| shape[a] > 1) {
        let floor = centre[a].floor();
        let first = floor as i64 - radius[a] as i64;
        if first < 0 || first + 2 * radius[a] as i64 + 2 > shape[a] as i64 {
            out.fill(f32::NAN);
            return;
        }
        (t[a], step[a]) = (centre[a] - floor, stride[a]);
        base += first as usize * stride[a];
    }
    let width: [usize; 3] = std::array::from_fn(|a| if shape[a] == 1 { 1 } else { 2 * radius[a] + 1 });
    dispatch(
        #[inline(always)]
        || {
            for (n, row) in out.chunks_exact_mut(width[0]).enumerate() {
                let from = base + stride[1] * (n % width[1]) + stride[2] * (n / width[1]);
                let line = |o: usize| &data[from + o..][..width[0]];
                let corner = |y: usize, z: usize| [line(y + z), line(y + z + step[0])];
                let [[a0, a1], [b0, b1]] = [corner(0, 0), corner(step[1], 0)];
                let [[c0, c1], [d0, d1]] = [corner(0, step[2]), corner(step[1], step[2])];
                for i in 0..width[0] {
                    let a = a0[i] + t[0] * (a1[i] - a0[i]);
                    let b = b0[i] + t[0] * (b1[i] - b0[i]);
                    let c = c0[i] + t[0] * (c1[i] - c0[i]);
                    let d = d0[i] + t[0] * (d1[i] - d0[i]);
                    let (low, high) = (a + t[1] * (b - a), c + t[1] * (d - c));
                    row[i] = low + t[2] * (high - low);
                }
            }
        },
    );
}
