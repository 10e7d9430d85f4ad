//! The source's own chain, coarse to fine (Zhang, Hirai, Endo & Morikawa 2007): corners,
//! many-to-many candidates, energy-based consistency, least-squares matching, the smooth field
//! through the matches and their Delaunay mesh.
//!
//! Each level seeks matches about the field of the one before. It then alternates: the deformed
//! volume is warped by the field, each match is measured again by least squares, and the field is
//! fitted to all of them through its bending energy. The residual of all voxels is never used.
//! Where the motion varies within a patch or between matches, that detail is lost: the full method
//! is better there.

use crate::consistency::coupling::Evidence;
use crate::consistency::energy::distance;
use crate::consistency::models::{AffineMotion, Choice, Excess, choose};
use crate::consistency::pruning::{GATE, Measured, prune};
use crate::error::FieldError;
use crate::field::jacobian;
use crate::field::spline::{FieldSpline, Spline};
use crate::matching::levels::{Aligned, from_level, to_level};
use crate::matching::pair::Pair;
use crate::matching::residual;
use crate::numerics::block_diagonal::Blocks;
use crate::numerics::fold_removal::unfold;
use crate::numerics::pyramid;
use crate::numerics::statistics::median;
use crate::numerics::symmetric3::{inverse, quadratic};
use crate::pipeline::background;
use crate::pipeline::body_models;
use crate::pipeline::clock::{Clock, noted};
use crate::pipeline::coarse_to_fine;
use crate::pipeline::field::{FieldResult, MIN_MATCHES, Progress, Start, lengths};
use crate::pipeline::field_warnings::{
    agreement, no_match, out_of_view, said_of_model, too_few, warnings, without_texture,
};
use crate::pipeline::hypotheses::{KEPT_SHARE, Search};
use crate::pipeline::input_checks::{self, Checked};
use crate::pipeline::known::Known;
use crate::pipeline::level::{self, LevelMatch, MIN_JACOBIAN, MatchParams, SplineField};
use crate::pipeline::local_model;
use crate::pipeline::match_mesh::{Meshed, estimated, with_mesh, world_match};
use crate::pipeline::refinement;
use crate::pipeline::stages::{self, Left};
use crate::pipeline::start::{self, Halt};
use crate::pipeline::uncertainty::{self, AtNodes, Variances};
use crate::types::*;
use rayon::prelude::*;

/// Search and fit of a level; pairs of values are for coarser levels and for the finest. Trade-offs
/// are of five pairs of heads and calves that move by 3 to 16 mm.
struct LevelSearch {
    /// Patch radius (voxels of the finest axis): 3 leaves 7 % more error, at more time.
    patch_radius_voxels: usize,
    /// Strain between neighbours against the field of the level before (1).
    max_strain: f64,
    /// Reach about the field of the level before (voxels of the finest axis).
    reach_voxels: [f64; 2],
    /// Warping, least-squares matching and fitting: 1 and 5 on the finest level leave 13 % more and
    /// 2 % less error.
    iterations: [usize; 2],
}

const LEVEL_SEARCH: LevelSearch =
    LevelSearch { patch_radius_voxels: 2, max_strain: 0.1, reach_voxels: [2.0, 1.0], iterations: [2, 3] };

/// Voxels of the finest axis between lattice nodes: over the same pairs 4 and 6 leave 2 % less and
/// 10 % more error.
const NODE_SPACING_VOXELS: usize = 5;

/// Error of a match beyond its covariance; trade-offs are of the same five pairs.
struct MatchError {
    /// Its own error (voxels): 0.05 leaves 2 % more error, 0.3 a third more.
    own_voxels: f64,
    /// Error in common with its neighbours (voxels) in the choice of a motion model: a brightness
    /// ramp of 15 % passes for an affine motion without it.
    common_voxels: f64,
}

const MATCH_ERROR: MatchError = MatchError { own_voxels: 0.02, common_voxels: 0.1 };

/// Voxels of tissue for each point on coarser levels: over the same pairs 12 and 48 leave equal
/// errors.
const VOXELS_PER_COARSE_POINT: usize = 24;

/// Points on the finest level over those of the full method: over the same pairs half as many leave
/// 40 % more error, twice as many the same.
const POINTS_RATIO: f64 = 2.5;

/// Fewest voxels of tissue for each point asked for; with fewer, the next finer level is used.
const MIN_VOXELS_PER_POINT: usize = 24;

/// The finest level worked on: the coarsest with room for the points asked for, or the one with at
/// most 600,000 voxels of tissue.
pub(super) fn finest_level(grid: &Grid, mask: &Mask, params: &FieldParams) -> usize {
    let automatic = coarse_to_fine::finest_level(grid, mask, 0).max(params.finest);
    let tissue = coarse_to_fine::inside(mask);
    let room = |f: usize| {
        let factor = coarse_to_fine::worked_on(grid, mask, f, 0.0);
        tissue / factor.last().map_or(1, |f| f.iter().product::<usize>()) >= MIN_VOXELS_PER_POINT * params.points
    };
    [8, 4, 2, 1]
        .into_iter()
        .filter(|&f| f <= automatic && f >= params.finest)
        .find(|&f| room(f))
        .unwrap_or(params.finest.max(1))
}

/// Points wanted on a finest level with `inside` voxels of tissue.
pub(super) fn points(params: &FieldParams, inside: usize) -> usize {
    match params.points {
        0 => ((POINTS_RATIO * inside as f64 / params.voxels_per_point as f64) as usize).max(200),
        asked => asked,
    }
}

/// The levels of the pyramid, from the coarsest one, and how they are worked on.
struct Levels<'a> {
    aligned: &'a Aligned<'a>,
    /// Voxels that a voxel of each level stands for.
    factors: &'a [[usize; 3]],
    /// Whether the volumes are one slice.
    flat: bool,
    /// The range (mm) that is searched.
    search: f64,
    params: &'a FieldParams,
    /// The volumes' grid, where a large rotation ends the run, to be taken out of them.
    turning: Option<&'a Grid>,
    progress: Progress<'a>,
}

/// What the finest level found, with its pair and factor, and what all levels did.
struct Finest<'a> {
    found: Found,
    pair: Pair<'a>,
    factor: [usize; 3],
    reports: Vec<LevelReport>,
    left: Vec<Left>,
}

impl<'a> Levels<'a> {
    /// The matches and the field of each level, from the coarsest to the finest.
    ///
    /// # Errors
    /// Where too few matches survive.
    fn run(&self, known: &Known<'_>, clock: &mut Clock) -> Result<Finest<'a>, Halt> {
        let Self { params, flat, search: range, .. } = *self;
        let (mut reports, mut left) = (Vec::new(), Vec::new());
        let mut state: Option<(Found, Pair<'_>, [usize; 3])> = None;
        for (l, &factor) in self.factors.iter().enumerate() {
            let pair = self.aligned.level(factor);
            clock.book("pyramid");
            (self.progress)("matching", 0.9 * l as f64 / self.factors.len() as f64);
            let lattice = level::lattice(&pair, NODE_SPACING_VOXELS);
            let begun = match &state {
                None => {
                    let search = Search { params, range, flat, turns: true, matching: &|| (), tick: &|_| () };
                    let (field, turn) = search.by_matches(&pair, &lattice);
                    if let Some((turn, grid)) = turn.zip(self.turning) {
                        return Err(Halt::turned(&turn, grid, (factor, pair.spacing)));
                    }
                    field
                }
                Some((found, _, from)) => {
                    level::carry(&found.field, lattice, |p| to_level(from_level(p, factor), *from))
                }
            };
            let found = on_level(&pair, begun, l + 1 == self.factors.len(), params);
            reports.push(noted(found.report.clone()));
            let motion = found.field.without_blocks().into();
            left.push(Left { name: "matches of a level".into(), motion, factor });
            state = Some((found, pair, factor));
            clock.book("matching");
        }
        let (found, pair, factor) = state.ok_or_else(|| no_match(0, "check the mask".into()))?;
        let kept = found.matches.iter().filter(|m| m.kept).count();
        if kept < MIN_MATCHES {
            return Err(too_few(kept, &pair, range, params, known.start.is_some()).into());
        }
        Ok(Finest { found, pair, factor, reports, left })
    }
}

/// The smallest motion that explains the matches, with the evidence for it.
fn chosen(
    pair: &Pair<'_>,
    field: &SplineField,
    matches: &[LevelMatch],
    params: &FieldParams,
    cut: [Option<background::Cut>; 2],
    reports: &[LevelReport],
) -> Choice {
    let corners = reports.last().map_or(0, |r| r.counts.features_initial);
    let mut choice = smallest(matches, pair, field, params.seed);
    if let Some(model) = params.model.asked() {
        choice = choice.asked(model, &local_model::shown(pair, field, |_| true));
    }
    choice.evidence.insert(0, MADE_BY.into());
    choice.evidence.extend(background::why_unseen(cut));
    choice.evidence.push(why_so_many(params, points(params, pair.inside), corners));
    choice.evidence = choice.evidence.into_iter().map(noted).collect();
    choice
}

/// The chosen motion on the full grid, and the variance of its error by source; `warped` is the
/// deformed volume under the field.
fn variances(
    pair: &Pair<'_>,
    field: &SplineField,
    warped: &[f32],
    choice: &Choice,
    factor: [usize; 3],
    grid: &Grid,
    seed: u64,
) -> (Spline, Variances) {
    let posterior = level::posterior(field, pair.spacing, seed);
    let misfit = residual::misfit_by_place(pair, warped, &field.lattice);
    let hidden = body_models::hidden(pair, field);
    let full = body_models::full_lattice(grid, field, factor, (choice, factor));
    let departure = body_models::departure(&full, field, factor, choice.rejected);
    let narrowed = vec![1.0; departure.len()];
    let nodes =
        AtNodes { posterior: &posterior, misfit: &misfit, departure: &departure, narrowed: &narrowed, hidden: &hidden };
    let variances = Variances::of(field.lattice.clone(), pair.spacing, &nodes);
    (full, variances)
}

/// What one level found.
struct Found {
    /// Fitted to the matches, with the information that the kept ones give at each node.
    field: SplineField,
    matches: Vec<LevelMatch>,
    report: LevelReport,
}

/// Refuses a start that is no affine map.
fn refuse_bent(known: &Known<'_>, grid: &Grid) -> Result<(), FieldError> {
    if known.start.is_some_and(|start| start::bends(start::rest(start), grid, known.mask)) {
        let what = "the start bends, and --method sparse begins at an affine map".into();
        let hint = "leave --method out, or give an affine transform".into();
        return Err(FieldError::Start { what, hint });
    }
    Ok(())
}

/// Measures the displacement of two volumes whose axes run right, anterior and superior, by matches
/// alone.
///
/// # Errors
/// As [`crate::pipeline::field::run`].
pub(super) fn measure(
    initial: &Voxels<'_>,
    deformed: &Voxels<'_>,
    known: &Known<'_>,
    params: &FieldParams,
    turns: bool,
    progress: Progress<'_>,
) -> Result<FieldResult, Halt> {
    refuse_bent(known, initial.grid())?;
    progress("pyramid", 0.0);
    let mut clock = Clock::start();
    let [initial, deformed] = [initial, deformed].map(input_checks::tamed);
    let Checked { mask, initial: clean, deformed: seen, not_finite, lost, cut } =
        input_checks::inputs(&initial, &deformed, known.mask)?;
    let not_finite = known.not_finite(not_finite, [&initial, &deformed]);
    let mask = known.counted(mask);
    let grid = *initial.grid();
    let search = coarse_to_fine::search_mm(&grid, params.search_mm);
    let aligned = Aligned::new(&clean, &seen, &mask, search)?;
    let factors = coarse_to_fine::worked_on(&grid, &mask, finest_level(&grid, &mask, params), search);
    let (flat, turning) = (grid.is_single_slice(), turns.then_some(&grid));
    let levels = Levels { aligned: &aligned, factors: &factors, flat, search, params, turning, progress };
    let Finest { found, pair, factor, mut reports, left } = levels.run(known, &mut clock)?;
    let Found { mut field, matches, .. } = found;
    progress("model", 0.9);
    let choice = chosen(&pair, &field, &matches, params, cut, &reports);
    let unseen = level::unseen(&pair, |p| field.at(p));
    clock.book("model");
    let warped = pair.warp(&field.lattice, &field.coefficients, &pair.spans);
    let (full, mut variances) = variances(&pair, &field, &warped, &choice, factor, &grid, params.seed);
    let unlike = refinement::unlike(&pair, level::misfit(&pair, &warped)[0]);
    let searched = reports.first().map_or(1.0, |r| r.counts.kept_share());
    if searched < KEPT_SHARE.confirmed && unlike.is_some() {
        variances.set_other_motions(searched, search);
    }
    let coefficients = FieldSpline::new(grid, vec![full], Vec::new(), Vec::new());
    let uncertainty = variances.deviation(&grid, factor);
    let samples = variances.samples(&grid, factor)?;
    let agreement = agreement(&pair, &field.without_blocks().into(), choice.model)?;
    let stages = stages::account(&grid, (&pair, factor), left, &coefficients);
    let measured = SparseField { matches: matches.iter().map(|m| world_match(&grid, m, factor)).collect() };
    let sparse = estimated(measured, &grid, &coefficients, &uncertainty);
    clock.book("uncertainty");
    progress("mesh", 0.92);
    let meshed = Meshed::of(&sparse, &coefficients, params.interpolation, flat, &mut clock)?;
    let displacement = &meshed.displacement;
    let (mean_mm, max_mm, mask_voxels) = lengths(displacement, &mask);
    let folds = jacobian::count_folds(displacement, Some(&mask))?;
    clock.book("jacobian");
    let expected = variances.expected((&uncertainty, factor), (displacement, &mask), (choice.model, choice.rejected));
    clock.book("uncertainty");

    let counts = with_mesh(&mut reports, &meshed.mesh);
    let mut warnings = warnings(counts, folds, not_finite, max_mm, search);
    warnings.extend(said_of_model(choice.rejected).into_iter().chain(input_checks::said_of(&lost)));
    warnings.extend(input_checks::squeezed(displacement, &mask).into_iter().chain(unlike));
    warnings.extend(without_texture(pair.plain()).into_iter().chain(out_of_view(unseen)));
    let (model, expected_error_mm) = (choice.model, expected.mean_mm);
    let body = BodyReport { label: 1, voxels: mask_voxels, model, slides_mm: 0.0, expected_error_mm };
    let summary = FieldSummary {
        counts,
        model,
        rejected: choice.rejected,
        evidence: choice.evidence,
        bodies: vec![body],
        levels: reports,
        stages: stages.iter().map(|s| s.report.clone()).collect(),
        folds,
        mask_voxels,
        mean_mm,
        max_mm,
        uncertainty_median_mm: uncertainty::median_inside(&uncertainty, &mask),
        expected,
        unseen,
        agreement,
        recast: None,
        landmarks: None,
        start: None,
        seconds: clock.0,
        warnings,
    };
    progress("done", 1.0);
    // A search that starts from the field needs no information at its nodes.
    field.blocks = Blocks::default();
    let Meshed { mesh, node_displacement, node_matches, displacement } = meshed;
    Ok(FieldResult {
        displacement,
        coefficients,
        spline: Start { motion: field.into(), factor, followed: None },
        uncertainty,
        samples,
        bodies: body_models::labelled(&mask, &[], |_| 1),
        matches: sparse,
        mesh,
        node_displacement,
        node_matches,
        stages,
        summary,
    })
}

/// What the summary says first.
const MADE_BY: &str =
    "field: fitted to the matches of features alone (--method sparse); the other voxels were not used";

/// Where the number of points comes from.
fn why_so_many(params: &FieldParams, wanted: usize, found: usize) -> String {
    let source = match params.points {
        0 => format!("{POINTS_RATIO} for {} voxels of tissue", params.voxels_per_point),
        _ => "as asked".into(),
    };
    let limit = if found < wanted { "; no more corners stand out of the noise" } else { "" };
    format!("points: {found} of {wanted} wanted, {source}{limit}")
}

/// What a level finds about the field it begins with.
fn on_level(pair: &Pair<'_>, begun: SplineField, last: bool, params: &FieldParams) -> Found {
    let which = usize::from(last);
    let wanted = if last { points(params, pair.inside) } else { (pair.inside / VOXELS_PER_COARSE_POINT).max(200) };
    let near = MatchParams {
        reach_mm: LEVEL_SEARCH.reach_voxels[which] * pyramid::finest(pair.shape, pair.spacing),
        strain: LEVEL_SEARCH.max_strain,
        patch: LEVEL_SEARCH.patch_radius_voxels,
        ..MatchParams::near(params, pair, wanted, last && params.points > 0)
    };
    let (matches, _, report) = level::matches(pair, Some(&begun), near);
    let places: Vec<VoxelPoint> = matches.iter().map(|m| m.voxel).collect();
    let mut found = coupled(pair, &begun, matches, report, params);
    // Comparisons without sub-voxel matching have no use for it.
    let rounds = if params.sub_voxel { LEVEL_SEARCH.iterations[which] } else { 0 };
    for _ in 0..rounds {
        let matches = level::follow(pair, &found.field, places.par_iter().copied(), LEVEL_SEARCH.patch_radius_voxels);
        found = coupled(pair, &found.field, matches, found.report, params);
    }
    found
}

/// The smooth field through matches, from one that is nearly right, and which of them agree with it
/// and with their neighbours.
fn coupled(
    pair: &Pair<'_>,
    known: &SplineField,
    mut matches: Vec<LevelMatch>,
    mut report: LevelReport,
    params: &FieldParams,
) -> Found {
    let radius = pair.in_voxels(LEVEL_SEARCH.patch_radius_voxels);
    let measured = matches.iter().map(LevelMatch::seen);
    let (mut field, evidence) = level::couple(pair, measured, (&radius, MATCH_ERROR.own_voxels), Some(known));
    unfold(&field.lattice, pair.spacing, &mut field.coefficients, MIN_JACOBIAN);
    let at = |m: &LevelMatch| field.at(m.voxel).0;
    let mut measured: Vec<Measured> = matches.iter().map(|m| Measured { field: at(m), ..m.measured }).collect();
    let kept = match params.consistency {
        true => prune(&measured, 0.2 * pyramid::finest(pair.shape, pair.spacing), GATE),
        false => vec![true; measured.len()],
    };
    level::calibrate(&mut measured, &kept);
    for ((m, measured), kept) in matches.iter_mut().zip(measured).zip(kept) {
        (m.measured, m.kept) = (measured, kept);
    }
    let kept = || matches.iter().filter(|m| m.kept);
    let mut apart: Vec<f32> = kept().map(|m| distance(m.measured.displacement, m.measured.field) as f32).collect();
    report.counts.kept = apart.len();
    report.residual_mm = if apart.is_empty() { 0.0 } else { f64::from(median(&mut apart)) };
    let kept = evidence.iter().zip(&matches).filter(|(_, m)| m.kept).map(|(e, _)| e);
    informed(&mut field, kept);
    Found { field, matches, report }
}

/// Sets the information that the evidence gives at each node (1/mm^2), of which the posterior is
/// made.
fn informed<'a>(field: &mut SplineField, evidence: impl Iterator<Item = &'a Evidence>) {
    let mut blocks = vec![[0.0f32; 6]; field.lattice.len()];
    for e in evidence {
        field.lattice.for_each_tap(e.at, |node, weight| {
            for (b, i) in blocks[node].iter_mut().zip(e.information) {
                *b += weight * i as f32;
            }
        });
    }
    field.blocks = Blocks::from(&blocks[..]);
}

/// What the matches alone say against a map: squared distances from it in standard deviations, less
/// those from the field.
fn smallest(matches: &[LevelMatch], pair: &Pair<'_>, field: &SplineField, seed: u64) -> Choice {
    let measured: Vec<Measured> = matches.iter().filter(|m| m.kept).map(|m| m.measured).collect();
    let finest = pyramid::finest(pair.shape, pair.spacing);
    let off = |m: &Measured, u: [f64; 3]| {
        let mut c = m.covariance;
        c[..3].iter_mut().for_each(|v| *v += (MATCH_ERROR.common_voxels * finest).powi(2));
        inverse(&c).map_or(0.0, |i| quadratic(&i, std::array::from_fn(|a| m.displacement[a] - u[a])))
    };
    let excess = |_, motion: &AffineMotion| {
        let total = measured.iter().map(|m| off(m, motion.displacement(m.place)) - off(m, m.field)).sum();
        Excess { total, worst: 0.0 }
    };
    choose(&measured, excess, level::determined(pair, field, seed), 0.02 * finest)
}
