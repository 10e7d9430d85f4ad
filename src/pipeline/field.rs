//! Two volumes to a dense displacement field: the main chain, in order.

use crate::error::FieldError;
use crate::field::jacobian;
pub use crate::field::spline::{FieldSpline, ScalarSpline};
use crate::matching::levels::{Aligned, to_level};
use crate::matching::pair::{Anchor, Pair, dilate};
use crate::numerics::ablation;
use crate::numerics::orientation::Orientation;
use crate::pipeline::background::{self, Cut};
use crate::pipeline::bodies::{Bodies, Given};
use crate::pipeline::body_models::{Concluded, labelled};
use crate::pipeline::clock::{Clock, noted};
use crate::pipeline::coarse_to_fine::{
    COARSE_NODE_SPACING_VOXELS, CoarseToFine, Found, WIDE_SEARCH_RATIO, around, begun_from, finest_level, search_mm,
    worked_on,
};
use crate::pipeline::contrast::{self, Common};
use crate::pipeline::field_warnings::{
    agreement, most_move, no_measurement, out_of_view, said_of_model, too_few, unreliable_search, warnings,
    why_so_many, without_texture,
};
use crate::pipeline::hypotheses::Begun;
pub use crate::pipeline::hypotheses::Start;
use crate::pipeline::input_checks::{self, Checked};
use crate::pipeline::known::{Known, Turned};
use crate::pipeline::landmarks;
use crate::pipeline::last_passes;
use crate::pipeline::level;
use crate::pipeline::local_model::Rest;
pub(crate) use crate::pipeline::match_mesh::mesh_of;
use crate::pipeline::match_mesh::{Meshed, estimated, interpolated, thinned, with_mesh, world_match};
use crate::pipeline::refinement::{uneven, unlike};
use crate::pipeline::sparse;
use crate::pipeline::stages;
pub use crate::pipeline::stages::Stage;
use crate::pipeline::start::{Begin, Halt};
use crate::pipeline::uncertainty::{self, Variances};
use crate::types::params::{BodySource, Interpolation, Method};
use crate::types::*;
use rayon::prelude::*;

/// Called with a stage's name and the fraction of the whole that is done (0 to 1); may be called
/// from any thread.
pub(crate) type Progress<'a> = &'a (dyn Fn(&str, f64) + Sync);

/// The result of `palpate field`, on the initial volume's grid.
///
/// What follows from these is made where it is wanted: `uncertainty.volume()`, the determinant by
/// [`jacobian::jacobian_determinant`], the deformed volume made to look like the initial one by
/// [`crate::field::warp::warp_image`].
#[derive(Debug, Clone, PartialEq)]
pub struct FieldResult {
    /// Displacement, initial to deformed (mm, RAS).
    pub displacement: DenseField,
    /// What it is worked out from.
    pub coefficients: FieldSpline,
    /// The field as the search left it, a start for a volume taken soon after.
    pub spline: Start,
    /// One standard deviation of the displacement (mm).
    pub uncertainty: ScalarSpline,
    /// Errors that the displacement may have, drawn at random.
    pub samples: ErrorSamples,
    /// The body of each voxel of the mask, from 1; 0 outside it.
    pub bodies: Mask,
    /// All matches with covariance.
    pub matches: SparseField,
    /// The mesh through the kept matches (initial positions).
    pub mesh: Mesh,
    /// Displacement at the mesh's nodes (mm, RAS).
    pub node_displacement: Vec<[f64; 3]>,
    /// The kept match of each node.
    pub node_matches: Vec<u32>,
    /// The field after each stage, in order; the last is the field itself.
    pub stages: Vec<Stage>,
    /// The rest.
    pub summary: FieldSummary,
}

impl FieldResult {
    /// The matches at the mesh's nodes.
    pub fn at_nodes(&self) -> Vec<&Match> {
        let kept: Vec<&Match> = self.matches.kept().collect();
        self.node_matches.iter().map(|&i| kept[i as usize]).collect()
    }

    /// The displacement, evaluated again from its coefficients.
    pub(super) fn dense(&self, interpolation: Interpolation) -> Result<DenseField, FieldError> {
        interpolated(interpolation, self.coefficients.dense()?, (&self.mesh, &self.node_displacement))
    }

    /// Puts another displacement in the place of its own, and what the summary says of it over the
    /// mask.
    pub(super) fn replace(&mut self, displacement: DenseField, mask: &Mask) -> Result<(), FieldError> {
        (self.summary.mean_mm, self.summary.max_mm, _) = lengths(&displacement, mask);
        self.summary.folds = jacobian::count_folds(&displacement, Some(mask))?;
        self.displacement = displacement;
        Ok(())
    }
}

/// Voxels around the tissue in which folds are also removed.
const UNFOLDED_MARGIN_VOXELS: usize = 2;

/// Fewest matches of a result.
pub(super) const MIN_MATCHES: usize = 20;

/// Measures the displacement from `initial` to `deformed`.
///
/// `mask` lies on the initial grid: features are taken, residuals weighed and statistics made
/// inside it. The volumes may lie on different grids. Results lie on the initial grid.
///
/// # Errors
/// [`FieldError`] when a volume is constant or not finite, the mask is empty or on another grid,
/// the two volumes do not overlap, or fewer than 20 matches survive.
///
/// ```
/// use palpate::synth::MotionKind;
/// use palpate::{FieldParams, PhantomKind, PhantomParams, evaluate, phantom, pipeline};
/// let block = PhantomParams::new(PhantomKind::Block).sized(24).moving(MotionKind::Translate);
/// let pair = phantom(&block)?;
/// let found = pipeline::field::run(
///     &pair.initial,
///     &pair.deformed,
///     Some(&pair.mask),
///     &FieldParams::default(),
///     &|_, _| {},
/// )?;
/// let m = evaluate::metrics(&found.displacement, &pair.truth, Some(&pair.mask), &[])?;
/// assert!(m.mean_mm < 0.1 * m.identity_mm);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn run(
    initial: &Voxels<'_>,
    deformed: &Voxels<'_>,
    mask: Option<&Mask>,
    params: &FieldParams,
    progress: Progress<'_>,
) -> Result<FieldResult, FieldError> {
    completed(initial, deformed, &Known::mask(mask), How { params, starts: &[], turns: true }, progress)
}

/// As [`run`], with all that is known of the pair, and with fields from which the search may start
/// beside the ones it finds itself; the agreement of the volumes decides.
///
/// # Errors
/// As [`run`], and where a start or a mask does not fit the volumes.
pub fn run_from(
    initial: &Voxels<'_>,
    deformed: &Voxels<'_>,
    known: &Known<'_>,
    params: &FieldParams,
    starts: &[Start],
    progress: Progress<'_>,
) -> Result<FieldResult, FieldError> {
    completed(initial, deformed, known, How { params, starts, turns: false }, progress)
}

/// As [`run_from`]; where the whole turned far, again with that rotation taken out.
fn completed(
    initial: &Voxels<'_>,
    deformed: &Voxels<'_>,
    known: &Known<'_>,
    how: How<'_>,
    progress: Progress<'_>,
) -> Result<FieldResult, FieldError> {
    input_checks::known(initial, deformed, known, how.params)?;
    let mut begin = Begin::of(initial.grid(), known, search_mm(initial.grid(), how.params.search_mm))?;
    loop {
        let moved = deformed.view().placed(begin.grid(deformed.grid())?)?;
        let orientations = [initial, &moved].map(|v| Orientation::of(v.grid()));
        let (first, second) = (orientations[0].turned(initial), orientations[1].turned(&moved));
        let turned = Turned::of(known, orientations);
        let how = How { turns: how.turns && !begin.is_affine(), ..how };
        let found = canonical(&first, &second, &begin.known(&turned.known(known)), how, progress);
        drop((first, second));
        match found {
            Ok(found) => return Ok(begin.end(stored(found, orientations[0], initial.grid())?, known.mask)),
            Err(Halt::Turned(map)) => begin = Begin::turned(*map, known),
            Err(Halt::Error(error)) => return Err(error),
        }
    }
}

/// How a pair is measured.
#[derive(Clone, Copy)]
struct How<'a> {
    params: &'a FieldParams,
    /// Fields from which the search may start.
    starts: &'a [Start],
    /// Whether a large rotation of the whole is taken out first.
    turns: bool,
}

/// As [`run`], of volumes that are lent and come back: where their axes run otherwise they are
/// turned meanwhile, so that none is held twice.
///
/// # Errors
/// As [`run`].
pub fn run_lent(
    initial: Volume,
    deformed: Volume,
    known: &Known<'_>,
    params: &FieldParams,
    progress: Progress<'_>,
) -> Result<(FieldResult, [Volume; 2]), FieldError> {
    input_checks::known(&initial, &deformed, known, params)?;
    let mut begin = Begin::of(initial.grid(), known, search_mm(initial.grid(), params.search_mm))?;
    let (mut initial, mut deformed) = (initial, deformed);
    let placed = *deformed.grid();
    let back = |turn: Orientation, volume: Volume, grid: &Grid| {
        if turn.is_canonical() { volume } else { turn.stored(&volume, grid) }
    };
    loop {
        deformed = deformed.placed(begin.grid(&placed)?)?;
        let grids = [*initial.grid(), *deformed.grid()];
        let axes = grids.map(|g| Orientation::of(&g));
        [initial, deformed] = [axes[0].turn(initial), axes[1].turn(deformed)];
        let turned = Turned::of(known, axes);
        let how = How { params, starts: &[], turns: !begin.is_affine() };
        let found = match canonical(&initial, &deformed, &begin.known(&turned.known(known)), how, progress) {
            Ok(found) => Ok(stored(found, axes[0], &grids[0])?),
            Err(Halt::Turned(map)) => Err(Begin::turned(*map, known)),
            Err(Halt::Error(error)) => return Err(error),
        };
        drop(turned);
        [initial, deformed] = [back(axes[0], initial, &grids[0]), back(axes[1], deformed, &grids[1]).placed(placed)?];
        match found {
            Ok(found) => return Ok((begin.end(found, known.mask), [initial, deformed])),
            Err(next) => begin = next,
        }
    }
}

/// A result on the grid that the initial volume is stored on.
fn stored(found: FieldResult, here: Orientation, grid: &Grid) -> Result<FieldResult, FieldError> {
    if here.is_canonical() {
        return Ok(found);
    }
    Ok(FieldResult {
        displacement: here.stored_field(found.displacement, grid)?,
        coefficients: found.coefficients.stored_on(*grid, here),
        uncertainty: found.uncertainty.stored_on(*grid, here),
        bodies: here.stored(&found.bodies, grid),
        stages: found.stages.into_iter().map(|s| Stage { field: s.field.stored_on(*grid, here), ..s }).collect(),
        ..found
    })
}

/// As [`run_from`], for volumes whose axes run right, anterior and superior, nearly: then the way
/// in which voxels are stored changes nothing.
fn canonical(
    initial: &Voxels<'_>,
    deformed: &Voxels<'_>,
    known: &Known<'_>,
    How { params, starts, turns }: How<'_>,
    progress: Progress<'_>,
) -> Result<FieldResult, Halt> {
    let [initial, deformed] = known.counting(initial, deformed);
    if params.method == Method::Sparse {
        return sparse::measure(&initial, &deformed, known, params, turns, progress);
    }
    progress("pyramid", 0.0);
    let mut clock = Clock::start();
    let [initial, deformed] = match ablation::is_on("robust-range") {
        true => [&initial, &deformed].map(input_checks::tamed),
        false => [&initial, &deformed].map(Voxels::view),
    };
    let Checked { mask, initial: clean, deformed: seen, not_finite, lost, cut } =
        input_checks::inputs(&initial, &deformed, known.mask)?;
    let not_finite = known.not_finite(not_finite, [&initial, &deformed]);
    let mask = known.counted(mask);
    let grid = *initial.grid();
    let range = search_mm(&grid, params.search_mm);
    let anchors = landmarks::anchors(known, &grid);
    let finest = finest_level(&grid, &mask, params.finest);
    let factors = worked_on(&grid, &mask, finest, range);
    let scene = contrast::Scene {
        initial: &clean,
        deformed: &seen,
        mask: &mask,
        anchors: &anchors,
        factors: &factors,
        range,
        reach: WIDE_SEARCH_RATIO * range,
        nodes: COARSE_NODE_SPACING_VOXELS,
        params,
    };
    let aligned = scene.aligned(&clean, &seen)?;
    let common = scene.common(&aligned)?;
    let aligned = match &common {
        Some(c) => scene.aligned(&c.initial, &c.deformed)?,
        None => aligned,
    };
    clock.book("pyramid");
    let given = (params.bodies == BodySource::Given).then(|| Given::new(mask.as_slice(), grid.shape()));
    let task = Task {
        grid,
        mask: &mask,
        known,
        params,
        given,
        anchors: &anchors,
        common: common.as_ref(),
        cut,
        finest,
        turns,
        progress,
    };
    let found = task.searched(&aligned, &clean, &factors, range, starts, &mut clock)?;
    let mut concluded = task.concluded(&aligned, found, &mut clock)?;
    drop(aligned);
    let estimated = task.estimated(&mut concluded, &mut clock)?;
    let damage = input_checks::said_of(&lost);
    Ok(task.result(concluded, estimated, not_finite, damage, starts.is_empty(), clock)?)
}

/// What a run works on, beside the volumes.
struct Task<'a> {
    grid: Grid,
    mask: &'a Mask,
    known: &'a Known<'a>,
    params: &'a FieldParams,
    given: Option<Given>,
    anchors: &'a [Anchor],
    common: Option<&'a Common<'a>>,
    /// Whether each volume has a background that a cut made.
    cut: [Option<Cut>; 2],
    /// The finest level that may be worked on, in voxels.
    finest: usize,
    /// Whether a large rotation ends the run, to be taken out.
    turns: bool,
    progress: Progress<'a>,
}

/// What the volumes and the matches say of the motion.
struct Conclusion {
    coefficients: FieldSpline,
    bodies: Bodies,
    /// Of the level that `bodies` are on.
    factor: [usize; 3],
    variances: Variances,
    /// The body of each voxel.
    labelled: Mask,
    body_reports: Vec<BodyReport>,
    model: MotionModel,
    rejected: bool,
    evidence: Vec<String>,
    sparse: SparseField,
    kept: usize,
    stages: Vec<Stage>,
    agreement: Agreement,
    reports: Vec<LevelReport>,
    begun: Begun,
    /// The range (mm) that was searched.
    search: f64,
    gain: f32,
    unseen: f64,
    /// Warnings about volumes that differ, and about tissue without texture.
    unlike: Option<String>,
    plain: Option<String>,
}

/// How far off the field may be.
struct Estimated {
    uncertainty: ScalarSpline,
    samples: ErrorSamples,
    landmarks: Option<LandmarkReport>,
}

impl Task<'_> {
    /// The label of a body.
    fn name(&self, body: usize) -> u8 {
        self.given.as_ref().map_or(body as u8 + 1, |g| g.names[body])
    }

    /// Whether a body is known to be rigid.
    fn is_rigid(&self, body: usize) -> bool {
        self.given.as_ref().is_some_and(|g| self.params.rigid.contains(&g.names[body]))
    }

    /// The levels, from the coarsest to the finest.
    fn searched<'b>(
        &self,
        aligned: &'b Aligned<'b>,
        initial: &Voxels<'_>,
        factors: &[[usize; 3]],
        range: f64,
        starts: &[Start],
        clock: &mut Clock,
    ) -> Result<Found<'b>, Halt> {
        let Self { grid, mask, known, params, .. } = self;
        let bent = begun_from(known, aligned, factors[0], grid, Some(mask));
        let starts: Vec<Start> = starts.iter().cloned().chain(bent).collect();
        // Without a mask all tissue is searched from the start.
        let tissue = || known.mask.is_some().then(|| around(mask, initial));
        let chain = CoarseToFine {
            given: self.given.as_ref(),
            aligned,
            factors,
            flat: grid.is_single_slice(),
            params,
            starts: &starts,
            turning: self.turns.then_some(grid),
            progress: self.progress,
        };
        let found = chain.run(range, tissue, clock)?;
        let kept = found.matches.iter().filter(|m| m.kept).count();
        if kept < MIN_MATCHES {
            return Err(too_few(kept, &found.pair, found.search, params, known.start.is_some()).into());
        }
        Ok(found)
    }

    /// The smallest motion that explains the matches, body by body, on the full grid.
    fn concluded(&self, aligned: &Aligned<'_>, found: Found<'_>, clock: &mut Clock) -> Result<Conclusion, FieldError> {
        (self.progress)("model", 0.9);
        let (grid, params) = (&self.grid, self.params);
        let Found { mut bodies, mut factor, mut pair, matches, points, reports, begun, light, search, .. } = found;
        let conclude = |b: usize| {
            let asked = if self.is_rigid(b) { Some(MotionModel::Rigid) } else { params.model.asked() };
            let mut concluded = Concluded::of(&bodies, b, &pair, &matches, asked, params.seed);
            // A bone is known to be rigid.
            concluded.choice.rejected &= !self.is_rigid(b);
            concluded
        };
        let concluded: Vec<Concluded> = (0..bodies.count()).map(conclude).collect();
        let kept = matches.iter().filter(|m| m.kept).count();
        let features = reports.last().map_or(0, |r| r.counts.features_initial);
        let (model, mut evidence) = Concluded::together(&concluded, &bodies, &pair, |b| self.name(b));
        evidence.extend(background::why_unseen(self.cut));
        evidence.extend(light.why());
        evidence.extend(self.common.map(Common::why));
        evidence.iter().for_each(|e| log::debug!("{e}"));
        evidence.extend(found.asked);
        evidence.push(noted(why_so_many(params, points, features)));
        let unlike = unlike(&pair, found.left);
        let unseen = level::unseen(&pair, |p| bodies.at(p));
        let plain = without_texture(pair.plain());
        evidence.extend(concluded.iter().filter_map(|c| c.rest.as_ref()).map(Rest::why).map(noted));
        clock.book("model");

        let sparse = SparseField { matches: matches.iter().map(|m| world_match(grid, m, factor)).collect() };
        let sparse = thinned(sparse, points);
        let searched = factor;
        let any_free = concluded.iter().any(|c| c.choice.motion.is_none());
        // What is concluded rests on the smooth field: what comes back brings noise with it.
        if any_free {
            bodies.twicing(&pair, params.seed);
            clock.book("residual");
        }
        // What the average of voxels hides.
        let next = last_passes::next_finer(grid, self.finest, params).filter(|&next| any_free && next != factor);
        if let Some(next) = next {
            pair = light.level(aligned, next);
            clock.book("pyramid");
            let tick = |p: usize| (self.progress)("residual", 0.9 + 0.02 * (p + 1) as f64 / params.finer_passes as f64);
            let nodes = last_passes::MAX_NODE_SPACING_VOXELS.min(2 * found.apart);
            bodies = last_passes::polish((&pair, next, nodes), (&bodies, factor), params, tick);
            if let Some(given) = &self.given {
                bodies.relabel(given.on(pair.shape, next));
            }
            factor = next;
            evidence.push(noted(last_passes::why(&pair, nodes, params)));
            clock.book("residual");
        }
        let rejected = concluded.iter().any(|c| c.choice.rejected);
        let models: Vec<MotionModel> = concluded.iter().map(|c| c.choice.model).collect();
        let again = next.map(|_| params.seed);
        let (splines, variances) = Concluded::on_grid(concluded, &mut bodies, (&pair, factor), (searched, again), grid);
        let (labels, labelled) = self.labels(&bodies, factor);
        let body_reports = self.reported(models, &labelled, &bodies, &pair);
        // Where there is one body its field folds nowhere but between knots.
        let tissue = if labels.is_empty() {
            Vec::new()
        } else {
            dilate(self.mask.as_slice(), grid.shape(), UNFOLDED_MARGIN_VOXELS)
        };
        let coefficients = FieldSpline::new(*grid, splines, labels, tissue);
        let stages = stages::account(grid, (&pair, factor), found.stages, &coefficients);
        let agreement = agreement(&pair, &bodies, model)?;
        clock.book("uncertainty");
        Ok(Conclusion {
            coefficients,
            bodies,
            factor,
            variances,
            labelled,
            body_reports,
            model,
            rejected,
            evidence,
            sparse,
            kept,
            stages,
            agreement,
            reports,
            begun,
            search,
            gain: found.gain,
            unseen,
            unlike,
            plain,
        })
    }

    /// The body of each voxel of the grid (none where there is one alone), and its label in the
    /// mask.
    fn labels(&self, bodies: &Bodies, factor: [usize; 3]) -> (Vec<u8>, Mask) {
        let labels = match &self.given {
            Some(given) => given.on(self.grid.shape(), [1; 3]),
            None => bodies.labels_on(self.grid.shape(), |p| to_level(p, factor)),
        };
        let labelled = labelled(self.mask, &labels, |b| self.name(b));
        (labels, labelled)
    }

    fn reported(&self, models: Vec<MotionModel>, labelled: &Mask, bodies: &Bodies, pair: &Pair<'_>) -> Vec<BodyReport> {
        let of = |(b, model): (usize, MotionModel)| {
            let label = self.name(b);
            let voxels = labelled.as_slice().iter().filter(|l| **l == label).count();
            BodyReport { label, voxels, model, slides_mm: bodies.jump(pair, b), expected_error_mm: 0.0 }
        };
        models.into_iter().enumerate().map(of).collect()
    }

    /// How far off the field may be, with all that puts it uncertain; the matches take the
    /// estimate.
    fn estimated(&self, concluded: &mut Conclusion, clock: &mut Clock) -> Result<Estimated, FieldError> {
        let Conclusion { coefficients, variances, begun, factor, .. } = concluded;
        let (grid, factor) = (&self.grid, *factor);
        // Given borders are certain.
        let jumps = if self.given.is_some() { Vec::new() } else { coefficients.jumps(self.mask) };
        variances.add_borders(jumps, factor);
        if begun.is_unconfirmed() && concluded.unlike.is_some() {
            variances.set_other_motions(begun.share(), concluded.search);
        }
        if let Some(common) = self.common {
            variances.add_contrast(1.0 - common.explained());
        }
        let mut uncertainty = variances.deviation(grid, factor);
        let of_landmarks = |vague: &ScalarSpline| {
            landmarks::report(self.anchors, |p| coefficients.along_axes(p), |p| vague.at_place(p).into())
        };
        let landmarks = of_landmarks(&uncertainty);
        if let Some(variance) = landmarks.as_ref().and_then(landmarks::against) {
            variances.add_landmarks(variance);
            uncertainty = variances.deviation(grid, factor);
        }
        let samples = variances.samples(grid, factor)?;
        let sparse = std::mem::take(&mut concluded.sparse);
        concluded.sparse = estimated(sparse, grid, coefficients, &uncertainty);
        clock.book("uncertainty");
        Ok(Estimated { uncertainty, samples, landmarks })
    }

    /// The mesh, the dense field and the summary.
    fn result(
        &self,
        concluded: Conclusion,
        estimated: Estimated,
        not_finite: [usize; 2],
        damage: Vec<String>,
        is_first: bool,
        mut clock: Clock,
    ) -> Result<FieldResult, FieldError> {
        let (params, mask, progress) = (self.params, self.mask, self.progress);
        let Conclusion { coefficients, sparse, mut reports, mut body_reports, begun, factor, .. } = concluded;
        let Estimated { uncertainty, samples, landmarks } = estimated;
        progress("mesh", 0.92);
        let meshed = Meshed::of(&sparse, &coefficients, params.interpolation, self.grid.is_single_slice(), &mut clock)?;
        let displacement = &meshed.displacement;
        let (mean_mm, max_mm, mask_voxels) = lengths(displacement, mask);
        let unreliable = begun.unreliable_counts();
        // Landmarks bear out what features do not.
        if let Some(seen) = unreliable.filter(|_| self.anchors.is_empty()) {
            let far = most_move(displacement, mask) > concluded.search;
            let found = reports.last().map_or(0, |r| r.counts.features_initial);
            no_measurement(concluded.kept, found, seen, far, concluded.unlike.is_some())?;
        }
        progress("jacobian", 0.94);
        let folds = jacobian::count_folds(displacement, Some(mask))?;
        clock.book("jacobian");
        progress("uncertainty", 0.95);
        let model = (concluded.model, concluded.rejected);
        let expected = concluded.variances.expected((&uncertainty, factor), (displacement, mask), model);
        let of_labels = uncertainty::by_label(&uncertainty, displacement, &concluded.labelled);
        uncertainty::tell_bodies(&mut body_reports, &of_labels, expected.mean_mm);
        clock.book("uncertainty");

        let counts = with_mesh(&mut reports, &meshed.mesh);
        // A known field takes the search as far as it goes itself.
        let range = if is_first { concluded.search } else { f64::INFINITY };
        let warnings = warnings(counts, folds, not_finite, max_mm, range)
            .into_iter()
            .chain(self.common.map(Common::said))
            .chain(landmarks::said_of(landmarks.as_ref()))
            .chain(said_of_model(concluded.rejected))
            .chain(damage)
            .chain(input_checks::squeezed(displacement, mask))
            .chain(unreliable.map(unreliable_search))
            .chain(concluded.unlike)
            .chain(uneven(concluded.gain))
            .chain(concluded.plain)
            .chain(out_of_view(concluded.unseen))
            .collect();
        let summary = FieldSummary {
            counts,
            model: concluded.model,
            rejected: concluded.rejected,
            evidence: concluded.evidence,
            bodies: body_reports,
            levels: reports,
            stages: concluded.stages.iter().map(|s| s.report.clone()).collect(),
            folds,
            mask_voxels,
            mean_mm,
            max_mm,
            uncertainty_median_mm: uncertainty::median_inside(&uncertainty, mask),
            expected,
            unseen: concluded.unseen,
            agreement: concluded.agreement,
            recast: self.common.map(Common::recast),
            landmarks,
            start: None,
            seconds: clock.0,
            warnings,
        };
        progress("done", 1.0);
        let spline = Start { motion: concluded.bodies.without_blocks(), factor, followed: Some(begun.followed) };
        let Meshed { mesh, node_displacement, node_matches, displacement } = meshed;
        Ok(FieldResult {
            displacement,
            coefficients,
            spline,
            uncertainty,
            samples,
            bodies: concluded.labelled,
            matches: sparse,
            mesh,
            node_displacement,
            node_matches,
            stages: concluded.stages,
            summary,
        })
    }
}

/// Mean and largest length over the mask (mm), and its voxels.
pub(super) fn lengths(field: &DenseField, mask: &Mask) -> (f64, f64, usize) {
    let nx = field.grid().shape()[0];
    let [x, y, z] = [0, 1, 2].map(|c| field.component(c));
    let rows: Vec<(f64, f32, usize)> = mask
        .as_slice()
        .par_chunks(nx)
        .enumerate()
        .map(|(row, mask)| {
            let from = row * nx;
            let (mut sum, mut top, mut n) = (0.0, 0.0f32, 0);
            for i in (0..mask.len()).filter(|&i| mask[i] != 0) {
                let (a, b, c) = (x[from + i], y[from + i], z[from + i]);
                let length = (a * a + b * b + c * c).sqrt();
                (sum, top, n) = (sum + f64::from(length), top.max(length), n + 1);
            }
            (sum, top, n)
        })
        .collect();
    let (sum, top, n) = rows.iter().fold((0.0, 0.0f32, 0), |a, r| (a.0 + r.0, a.1.max(r.1), a.2 + r.2));
    (sum / n.max(1) as f64, f64::from(top), n)
}
