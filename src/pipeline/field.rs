//! Two volumes to a dense displacement field: the main chain, in order.

use crate::error::{FieldError, MeshError};
use crate::field::spline::{FieldSpline, ScalarSpline};
use crate::field::{interpolation, jacobian, spline};
use crate::matching::levels::{Aligned, factors, foreground, from_level, to_level};
use crate::matching::pair::{Pair, dilate};
use crate::mesh::{delaunay2::delaunay2, delaunay3::delaunay3};
use crate::numerics::ablation;
use crate::numerics::bspline::Lattice;
use crate::numerics::orientation::Orientation;
use crate::numerics::statistics::quantile;
use crate::pipeline::background;
use crate::pipeline::bodies::{Bodies, Given};
use crate::pipeline::body_models::{Concluded, labelled};
use crate::pipeline::brightness::Light;
use crate::pipeline::contrast::{self, Common};
pub use crate::pipeline::hypotheses::Start;
use crate::pipeline::hypotheses::{Begun, NEAR, Search};
use crate::pipeline::input_checks::{self, Checked};
use crate::pipeline::known::{Known, StartMap, Turned};
use crate::pipeline::landmarks;
use crate::pipeline::last_passes;
use crate::pipeline::level::{self, LevelMatch, MatchParams, SplineField};
use crate::pipeline::local_model::Rest;
use crate::pipeline::refinement::{self, Explained, finer, uneven, unlike};
use crate::pipeline::sparse;
use crate::pipeline::stages::{self, Left, Stage};
use crate::pipeline::start::{self, Begin};
use crate::pipeline::uncertainty::{self, some_of};
use crate::types::params::{BodySource, Interpolation, Method};
use crate::types::points::covariance_after;
use crate::types::*;
use rayon::prelude::*;
use std::time::{Duration, Instant};

/// Called with a stage's name and the fraction of the whole that is done (0 to 1); may be called
/// from any thread.
pub type Progress<'a> = &'a (dyn Fn(&str, f64) + Sync);

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

/// Voxels about the tissue in which nothing folds either.
const BORDER: usize = 2;

/// Fewest matches that a result may rest on.
pub(super) const FEWEST: usize = 20;

/// Stage names and their wall seconds.
pub(super) struct Clock(pub(super) Vec<(String, f64)>, Instant);

impl Clock {
    /// Nothing booked yet.
    pub(super) fn start() -> Self {
        Self(Vec::new(), Instant::now())
    }

    /// Books the time since the last call to `stage`.
    pub(super) fn book(&mut self, stage: &str) {
        let seconds = self.1.elapsed().as_secs_f64();
        self.1 = Instant::now();
        self.add(stage, seconds);
    }

    /// Books `seconds` that passed before now to `stage`, and leaves them out of what is booked
    /// next.
    fn skip(&mut self, stage: &str, seconds: f64) {
        self.1 += Duration::from_secs_f64(seconds);
        self.add(stage, seconds);
    }

    fn add(&mut self, stage: &str, seconds: f64) {
        match self.0.iter_mut().find(|s| s.0 == stage) {
            Some(s) => s.1 += seconds,
            None => self.0.push((stage.into(), seconds)),
        }
    }
}

/// Measures the displacement from `initial` to `deformed`.
///
/// `mask` lies on the initial grid: features are taken, residuals weighed and statistics made
/// inside it. The volumes may lie on different grids. Results lie on the initial grid.
///
/// # Errors
/// [`FieldError`] when a volume is constant or not finite, the mask is empty or on another grid,
/// the two volumes do not overlap, or fewer than 20 matches survive.
pub fn run(
    initial: &Voxels<'_>,
    deformed: &Voxels<'_>,
    mask: Option<&Mask>,
    params: &FieldParams,
    progress: Progress<'_>,
) -> Result<FieldResult, FieldError> {
    run_from(initial, deformed, &Known::mask(mask), params, &[], progress)
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
    input_checks::known(initial, deformed, known, params)?;
    let begun = Begin::of(initial.grid(), known, search_mm(initial.grid(), params.search_mm))?;
    let moved = deformed.view().placed(begun.grid(deformed.grid())?)?;
    let orientations = [initial, &moved].map(|v| Orientation::of(v.grid()));
    let (first, second) = (orientations[0].turned(initial), orientations[1].turned(&moved));
    let turned = Turned::of(known, orientations);
    let found = canonical(&first, &second, &begun.known(&turned.known(known)), params, starts, progress)?;
    drop((first, second));
    Ok(begun.end(stored(found, orientations[0], initial.grid())?))
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
    let begun = Begin::of(initial.grid(), known, search_mm(initial.grid(), params.search_mm))?;
    let placed = *deformed.grid();
    let deformed = deformed.placed(begun.grid(&placed)?)?;
    let grids = [*initial.grid(), *deformed.grid()];
    let turns = grids.map(|g| Orientation::of(&g));
    let [initial, deformed] = [turns[0].turn(initial), turns[1].turn(deformed)];
    let turned = Turned::of(known, turns);
    let found = canonical(&initial, &deformed, &begun.known(&turned.known(known)), params, &[], progress)?;
    drop(turned);
    let found = begun.end(stored(found, turns[0], &grids[0])?);
    let back =
        |turn: Orientation, volume: Volume, grid| if turn.is_canonical() { volume } else { turn.stored(&volume, grid) };
    let deformed = back(turns[1], deformed, &grids[1]).placed(placed)?;
    Ok((found, [back(turns[0], initial, &grids[0]), deformed]))
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
    params: &FieldParams,
    starts: &[Start],
    progress: Progress<'_>,
) -> Result<FieldResult, FieldError> {
    let [initial, deformed] = known.counting(initial, deformed);
    if params.method == Method::Sparse {
        let bends = known.start.is_some_and(|start| start::bends(start::rest(start), initial.grid(), known.mask));
        if bends {
            let what = "the start bends, and --method sparse begins at an affine map".into();
            let hint = "leave --method out, or give an affine transform".into();
            return Err(FieldError::Start { what, hint });
        }
        return sparse::measure(&initial, &deformed, known, params, progress);
    }
    progress("pyramid", 0.0);
    let mut clock = Clock::start();
    let masked = known.mask.is_some();
    let [initial, deformed] = match ablation::is_on("robust-range") {
        true => [&initial, &deformed].map(input_checks::tamed),
        false => [&initial, &deformed].map(Voxels::view),
    };
    let Checked { mask, initial: clean, deformed: seen, not_finite, lost, cut } =
        input_checks::inputs(&initial, &deformed, known.mask)?;
    let not_finite = known.not_finite(not_finite, [&initial, &deformed]);
    let mask = known.counted(mask);
    let grid = *initial.grid();
    let search = search_mm(&grid, params.search_mm);
    let anchors = landmarks::anchors(known, &grid);
    let reach = TWICE * search;
    let finest = finest_level(&grid, &mask, params.finest);
    let factors = worked_on(&grid, &mask, finest, search);
    let scene = contrast::Scene {
        initial: &clean,
        deformed: &seen,
        mask: &mask,
        anchors: &anchors,
        factors: &factors,
        range: search,
        reach,
        nodes: COARSE,
        params,
    };
    let aligned = scene.aligned(&clean, &seen)?;
    let common = scene.common(&aligned)?;
    let aligned = match &common {
        Some(c) => scene.aligned(&c.initial, &c.deformed)?,
        None => aligned,
    };
    clock.book("pyramid");
    let bent = begun_from(known, &aligned, factors[0], &grid, Some(&mask));
    let starts: Vec<Start> = starts.iter().cloned().chain(bent).collect();
    // Without a mask all tissue is searched from the start.
    let tissue = || masked.then(|| around(&mask, &clean));
    let given = (params.bodies == BodySource::Given).then(|| Given::new(mask.as_slice(), grid.shape()));
    let chain = CoarseToFine {
        given: given.as_ref(),
        aligned: &aligned,
        factors: &factors,
        flat: grid.is_single_slice(),
        params,
        starts: &starts,
        progress,
    };
    let Found {
        mut bodies,
        mut factor,
        mut pair,
        matches,
        points,
        mut reports,
        begun,
        light,
        search,
        left,
        gain,
        apart,
        asked,
        stages,
    } = chain.run(search, tissue, &mut clock)?;
    let kept = matches.iter().filter(|m| m.kept).count();
    if kept < FEWEST {
        return Err(too_few(kept, &pair, (search, params), known.start.is_some()));
    }

    // The smallest motion that explains the matches, body by body.
    progress("model", 0.9);
    let flat = grid.is_single_slice();
    let is_rigid = |b: usize| given.as_ref().is_some_and(|g| params.rigid.contains(&g.names[b]));
    let asked_of = |b: usize| if is_rigid(b) { Some(MotionModel::Rigid) } else { params.model.asked() };
    let conclude = |b: usize| {
        let mut concluded = Concluded::of(&bodies, b, &pair, &matches, (asked_of(b), params.seed));
        // A bone is known to be rigid.
        concluded.choice.rejected &= !is_rigid(b);
        concluded
    };
    let concluded: Vec<Concluded> = (0..bodies.count()).map(conclude).collect();
    let found = reports.last().map_or(0, |r| r.counts.features_initial);
    let name = |b: usize| given.as_ref().map_or(b as u8 + 1, |g| g.names[b]);
    let (model, mut evidence) = Concluded::together(&concluded, &bodies, &pair, name);
    evidence.extend(background::why_unseen(cut));
    evidence.extend(light.why());
    evidence.extend(common.as_ref().map(Common::why));
    evidence.extend(asked);
    evidence.push(why_so_many(params, points, found));
    let unlike = unlike(&pair, left);
    let unseen = level::unseen(&pair, |p| bodies.at(p));
    let plain = without_texture(pair.plain());
    evidence.extend(concluded.iter().filter_map(|c| c.rest.as_ref()).map(Rest::why));
    clock.book("model");

    // What the average of voxels hides.
    let sparse = SparseField { matches: matches.iter().map(|m| world_match(&grid, m, factor)).collect() };
    let sparse = thinned(sparse, points);
    let searched = factor;
    let any_free = concluded.iter().any(|c| c.choice.motion.is_none());
    // What is concluded rests on the smooth field: what comes back brings noise with it.
    if any_free {
        bodies.twice(&pair, params.seed);
        clock.book("residual");
    }
    let next = last_passes::next_finer(&grid, finest, params).filter(|&next| any_free && next != factor);
    if let Some(next) = next {
        pair = light.level(&aligned, next);
        clock.book("pyramid");
        let tick = |p: usize| progress("residual", 0.9 + 0.02 * (p + 1) as f64 / params.finer_passes as f64);
        let nodes = last_passes::WIDEST.min(2 * apart);
        bodies = last_passes::polish((&pair, next, nodes), (&bodies, factor), params, tick);
        if let Some(given) = &given {
            bodies.relabel(given.on(pair.shape, next));
        }
        factor = next;
        evidence.push(last_passes::why(&pair, nodes, params));
        clock.book("residual");
    }
    let rejected = concluded.iter().any(|c| c.choice.rejected);
    let models: Vec<MotionModel> = concluded.iter().map(|c| c.choice.model).collect();
    let again = next.map(|_| params.seed);
    let (splines, variances) = Concluded::on_grid(concluded, &mut bodies, (&pair, factor), (searched, again), &grid);
    let labels = match &given {
        Some(given) => given.on(grid.shape(), [1; 3]),
        None => bodies.labels_on(grid.shape(), |p| to_level(p, factor)),
    };
    let labelled = labelled(&mask, &labels, name);
    let reported = |(b, model): (usize, MotionModel)| {
        let label = name(b);
        let voxels = labelled.as_slice().iter().filter(|l| **l == label).count();
        BodyReport { label, voxels, model, slides_mm: bodies.jump(&pair, b), expected_error_mm: 0.0 }
    };
    let mut body_reports: Vec<BodyReport> = models.into_iter().enumerate().map(reported).collect();
    // Where there is one body its field folds nowhere but between knots.
    let tissue = if labels.is_empty() { Vec::new() } else { dilate(mask.as_slice(), grid.shape(), BORDER) };
    let coefficients = FieldSpline::new(grid, splines, labels, tissue);
    let stages = stages::account(&grid, (&pair, factor), stages, &coefficients);
    let agreement = agreement(&pair, &bodies, model)?;
    drop(pair);
    drop(aligned);
    clock.book("uncertainty");

    // Given borders are certain.
    let jumps = if given.is_some() { Vec::new() } else { coefficients.jumps(&mask) };
    let mut variances = variances.with_borders(jumps, factor);
    let doubted = begun.doubted();
    if begun.is_unsure() && unlike.is_some() {
        variances = variances.with_other_motions(begun.share(), search);
    }
    if let Some(common) = &common {
        variances = variances.with_contrast(1.0 - common.explained());
    }
    let mut uncertainty = variances.deviation(&grid, factor);
    let told = |vague: &ScalarSpline| {
        landmarks::report(&anchors, |p| coefficients.along_axes(p), |p| vague.at_place(p).into())
    };
    let landmarks = told(&uncertainty);
    if let Some(variance) = landmarks.as_ref().and_then(landmarks::against) {
        variances = variances.with_landmarks(variance);
        uncertainty = variances.deviation(&grid, factor);
    }
    let samples = variances.samples(&grid, factor)?;
    let sparse = estimated(sparse, &grid, (&coefficients, &uncertainty));
    clock.book("uncertainty");

    // Mesh and dense field.
    progress("mesh", 0.92);
    let (mesh, source) = mesh_of(&sparse, flat)?;
    let at_nodes: Vec<&Match> = sparse.kept().collect();
    let node_displacement: Vec<[f64; 3]> = source.iter().map(|&i| at_nodes[i as usize].displacement).collect();
    clock.book("mesh");
    let smooth = coefficients.dense()?;
    let displacement = interpolated(params.interpolation, smooth, (&mesh, &node_displacement))?;
    clock.book("interpolation");
    let length = lengths(&displacement, &mask);
    // Landmarks bear out what features do not.
    if let Some(seen) = doubted.filter(|_| anchors.is_empty()) {
        no_measurement((kept, found), seen, (most_move(&displacement, &mask) > search, unlike.is_some()))?;
    }

    progress("jacobian", 0.94);
    let folds = jacobian::count_folds(&displacement, Some(&mask))?;
    clock.book("jacobian");
    progress("uncertainty", 0.95);
    let expected = variances.expected((&uncertainty, factor), (&displacement, &mask), (model, rejected));
    let of_labels = uncertainty::by_label(&uncertainty, &displacement, &labelled);
    uncertainty::tell_bodies(&mut body_reports, &of_labels, expected.mean_mm);
    clock.book("uncertainty");

    let counts = with_mesh(&mut reports, &mesh);
    let said_of_landmarks = landmarks::said_of(landmarks.as_ref());
    let summary = FieldSummary {
        counts,
        model,
        rejected,
        evidence,
        bodies: body_reports,
        levels: reports,
        stages: stages.iter().map(|s| s.report.clone()).collect(),
        folds,
        mask_voxels: length.2,
        mean_mm: length.0,
        max_mm: length.1,
        uncertainty_median_mm: uncertainty::median_inside(&uncertainty, &mask),
        expected,
        unseen,
        agreement,
        recast: common.as_ref().map(Common::recast),
        landmarks,
        start: None,
        seconds: clock.0,
        // A known field takes the search as far as it goes itself.
        warnings: warnings(counts, folds, not_finite, length.1, if starts.is_empty() { search } else { f64::INFINITY })
            .into_iter()
            .chain(common.as_ref().map(Common::said))
            .chain(said_of_landmarks)
            .chain(said_of_model(rejected))
            .chain(input_checks::said_of(&lost))
            .chain(input_checks::squeezed(&displacement, &mask))
            .chain(doubted.map(in_doubt))
            .chain(unlike)
            .chain(uneven(gain))
            .chain(plain)
            .chain(out_of_view(unseen))
            .collect(),
    };
    progress("done", 1.0);
    let spline = Start { motion: bodies.without_blocks(), factor, followed: Some(begun.followed) };
    Ok(FieldResult {
        displacement,
        coefficients,
        spline,
        uncertainty,
        samples,
        bodies: labelled,
        matches: sparse,
        mesh,
        node_displacement,
        node_matches: source,
        stages,
        summary,
    })
}

/// Refuses what few features support: if few of the features `seen` agreed in the search of the
/// whole and few of the matches survive, `kept` of `found`; past the range of the search (`far`)
/// either will do, the first one where the volumes stay `unlike`.
fn no_measurement((kept, found): (usize, usize), seen: Counts, (far, unlike): (bool, bool)) -> Result<(), FieldError> {
    let survived = (kept, "matches survive", found.div_ceil(5));
    let agreed = (
        seen.kept,
        "features agree with their neighbours in the search of the whole volume",
        seen.features_initial.div_ceil(3),
    );
    let [few_survived, few_agreed] = [survived, agreed].map(|f| f.0 < f.2);
    let refused = match () {
        _ if few_survived && (few_agreed || far) => survived,
        _ if few_agreed && far && unlike => agreed,
        _ => return Ok(()),
    };
    let (found, what, needed) = refused;
    let hint = "check that both volumes show the same tissue; where its motion is known in part, give --initial or --landmarks".into();
    Err(FieldError::TooFew { found, what, needed, hint })
}

/// Part of the variance by which a displacement may leave the volumes less alike than at rest.
const NO_WORSE: f64 = 0.01;

/// How well the volumes agree at rest and under the bodies' fields.
///
/// # Errors
/// [`FieldError::Worse`] where they agree less under the fields.
pub(super) fn agreement(pair: &Pair<'_>, bodies: &Bodies, model: MotionModel) -> Result<Agreement, FieldError> {
    let found = contrast::agreement(pair, bodies);
    let Agreement { at_rest, found: now } = found;
    if model != MotionModel::Identity && now < at_rest - NO_WORSE {
        let hint = "check that both volumes show the same tissue, or say more: --initial, --landmarks, --mask".into();
        return Err(FieldError::Worse { at_rest, found: now, hint });
    }
    Ok(found)
}

/// The fields that what is known suggests on the coarsest level: what is left of a start, and one
/// through the landmarks.
fn begun_from(
    known: &Known<'_>,
    aligned: &Aligned<'_>,
    factor: [usize; 3],
    grid: &Grid,
    mask: Option<&Mask>,
) -> Vec<Start> {
    if known.start.is_none() && known.landmarks.is_empty() {
        return Vec::new();
    }
    let pair = aligned.level(factor);
    let axes = spline::axes(grid);
    let of = |start: &StartMap<'_>| {
        let rest = start::rest(start);
        let along = |p: [f64; 3]| {
            let d = rest(grid.affine().to_world(VoxelPoint(from_level(p, factor))));
            std::array::from_fn(|a| (0..3).map(|r| axes[r][a] * d[r]).sum())
        };
        let field = SplineField::still(level::lattice(&pair, COARSE));
        let motion = SplineField { coefficients: field.lattice.fit(along), ..field };
        start::bends(rest, grid, mask).then(|| Start { motion: Bodies::from(motion), factor, followed: None })
    };
    known.start.and_then(of).into_iter().chain(landmarks::start(&pair, factor)).collect()
}

/// The levels of the pyramid, from the coarsest one, and how they are worked on.
struct CoarseToFine<'a, 'p> {
    aligned: &'a Aligned<'a>,
    /// Voxels that a voxel of each level stands for.
    factors: &'p [[usize; 3]],
    /// Whether the volumes are one slice.
    flat: bool,
    /// The bodies that are given.
    given: Option<&'p Given>,
    params: &'p FieldParams,
    starts: &'p [Start],
    progress: Progress<'p>,
}

/// What the levels found.
struct Found<'a> {
    /// On the finest level, with that level's factor and pair.
    bodies: Bodies,
    factor: [usize; 3],
    pair: Pair<'a>,
    /// Of that level, about the bodies' fields, with the number wanted.
    matches: Vec<LevelMatch>,
    points: usize,
    reports: Vec<LevelReport>,
    /// Where the passes began.
    begun: Begun,
    light: Light,
    /// The range (mm) that was searched.
    search: f64,
    /// What is left of the difference (intensity), and how the gain varies.
    left: f32,
    gain: f32,
    /// Voxels between nodes.
    apart: usize,
    /// Questions that were asked on the way, with their answers.
    asked: Vec<String>,
    /// The motion after each stage.
    stages: Vec<Left>,
}

impl<'a> CoarseToFine<'a, '_> {
    /// From the coarsest level to the finest: where the passes begin, the passes, and the matches
    /// about their field. `tissue` gives the mask with all tissue around it, where that is another.
    fn run(
        &self,
        range: f64,
        tissue: impl Fn() -> Option<Vec<u8>>,
        clock: &mut Clock,
    ) -> Result<Found<'a>, FieldError> {
        let Self { aligned, params, progress, .. } = *self;
        let (mut reports, mut asked, mut light, mut range) = (Vec::new(), Vec::new(), Light::default(), range);
        let mut state: Option<(Bodies, [usize; 3], Begun)> = None;
        let mut stages = Vec::new();
        for (l, &factor) in self.factors.iter().enumerate() {
            let (first, last) = (l == 0, l + 1 == self.factors.len());
            let mut pair = light.level(aligned, factor);
            clock.book("pyramid");
            let done = |part: f64| (l as f64 + part) / (self.factors.len() as f64 + 1.0);
            let apart = if last { refinement::apart(params.node_spacing, pair.inside) } else { COARSE };
            let lattice = level::lattice(&pair, apart);
            let passes = if last { params.passes } else { params.coarse_passes };
            let tick = |p: usize| progress("residual", done(0.1 + 0.8 * (p + 1) as f64 / passes as f64));
            let matching = || progress("matching", done(0.0));
            let search = Search { params, range, flat: self.flat, matching: &matching, tick: &tick };
            let mut matched = 0.0;
            let (mut bodies, mut begun, sought) = match state.take() {
                Some((coarse, from, begun)) if self.given.is_some() => {
                    (coarse.carried(&lattice, |p| to_level(from_level(p, factor), from)), begun, false)
                }
                Some((coarse, from, mut begun)) => {
                    let mut bodies = coarse.carried(&lattice, |p| to_level(from_level(p, factor), from));
                    bodies.refine(&pair, passes, params.seed, tick);
                    let loose = l == 1 && begun.is_loose();
                    let found = loose.then(|| search.closer(&pair, &bodies, passes, &mut matched)).flatten();
                    let sought = found.is_some() && !last;
                    if let Some(found) = found {
                        bodies = found.motion.clone();
                        reports.extend(found.report.clone());
                        begun = found;
                    }
                    (bodies, begun, sought)
                }
                None => {
                    light.look_at_rest(&mut pair, (aligned, factor), &SplineField::still(lattice.clone()).into());
                    let level = (&pair, factor, &lattice);
                    let around = || tissue().map(|mask| light.level_within(aligned, &mask, factor));
                    let begun = self.begin(&search, level, around, passes, (&mut range, &mut asked), &mut matched);
                    reports.extend(begun.report.clone());
                    (begun.motion.clone(), begun, true)
                }
            };
            if let Some(given) = self.given {
                let labels = given.on(pair.shape, factor);
                if first {
                    bodies =
                        self.each(&search, (&pair, factor, &lattice), (labels, &begun.motion), passes, &mut matched);
                } else {
                    bodies.relabel(labels);
                    bodies.refine(&pair, passes, params.seed, tick);
                }
            } else if sought && params.bodies == BodySource::Found {
                let edge =
                    pair.spacing.into_iter().zip(factor).map(|(s, f)| s / f as f64).fold(f64::INFINITY, f64::min);
                asked.extend(bodies.divide(&pair, &begun.matches, (passes, edge), params.seed));
            }
            if let Some(field) = begun.of_matches.take() {
                let name = if first { "matches alone" } else { "matches of the next level" };
                stages.push(Left { name: name.into(), motion: field.into(), factor });
            }
            // What a coarser level saw of the brightness serves the finest one.
            let open = first || !last || light.is_unknown();
            let more = open && light.look(&mut pair, (aligned, factor), &bodies);
            if more && last {
                bodies.refine(&pair, passes, params.seed, |_| ());
            }
            if !last {
                clock.skip("matching", matched);
                clock.book("residual");
                stages.push(Left { name: "coarse level".into(), motion: bodies.without_blocks(), factor });
                state = Some((bodies, factor, begun));
                continue;
            }
            let mut closest = apart;
            for b in 0..bodies.count() {
                let part = bodies.part(&pair, b);
                let refine = |field: &mut SplineField, passes| level::refine(&part, field, passes, params.seed, |_| ());
                let Explained { field, apart, said } =
                    finer(&part, bodies.fields[b].clone(), apart, params.seed, refine);
                closest = closest.min(apart);
                asked.extend(said);
                bodies.fields[b] = field;
            }
            let [left, gain] = level::misfit(&pair, &bodies.warp(&pair, &pair.spans));
            clock.skip("matching", matched);
            clock.book("residual");
            progress("matching", done(0.9));
            let automatic = (pair.inside / params.voxels_per_point).max(LEAST_POINTS);
            let points = if params.points > 0 { params.points } else { automatic };
            let near = MatchParams::near(params, &pair, points.max(LEAST_POINTS), params.points > 0);
            let (matches, report) = bodies.matches(&pair, near);
            if first {
                reports.clear();
            }
            reports.push(report);
            clock.book("matching");
            let (search, apart) = (range, closest);
            stages.push(Left { name: "finest level".into(), motion: bodies.without_blocks(), factor });
            return Ok(Found {
                bodies,
                factor,
                pair,
                matches,
                points,
                reports,
                begun,
                light,
                search,
                left,
                gain,
                apart,
                asked,
                stages,
            });
        }
        Err(no_match(0, "check the mask".into()))
    }

    /// The starts that a user gave.
    fn starts_given(&self) -> &[Start] {
        if self.starts.iter().all(Start::is_given) { self.starts } else { &[] }
    }

    /// Each given body's motion on the coarsest level: by a search of its own or that of the whole,
    /// whichever agrees better in it.
    fn each(
        &self,
        search: &Search<'_>,
        (pair, factor, lattice): (&Pair<'_>, [usize; 3], &Lattice),
        (labels, whole): (Vec<u8>, &Bodies),
        passes: usize,
        matched: &mut f64,
    ) -> Bodies {
        let count = self.given.map_or(1, |g| g.names.len());
        let field = |bodies: Bodies| bodies.fields.into_iter().next();
        let start = field(whole.clone()).unwrap_or_else(|| SplineField::still(lattice.clone()));
        let mut bodies = Bodies::given(labels, vec![start.clone(); count]);
        for b in 0..count {
            let part = bodies.part(pair, b);
            let own = search.begin((&part, factor), lattice, &[], passes, matched).motion;
            let mut whole = Bodies::from(start.clone());
            whole.refine(&part, passes, self.params.seed, |_| ());
            if let Some(better) = field(Bodies::better(&part, whole, own)) {
                bodies.fields[b] = better;
            }
        }
        bodies
    }

    /// Where the passes of the coarsest level begin: inside the mask, with all tissue `around` it
    /// if few features agree there, and twice as far if the motion reaches the range or few
    /// agree.
    fn begin(
        &self,
        search: &Search<'_>,
        (pair, factor, lattice): (&Pair<'_>, [usize; 3], &Lattice),
        around: impl Fn() -> Option<Pair<'a>>,
        passes: usize,
        (range, asked): (&mut f64, &mut Vec<String>),
        matched: &mut f64,
    ) -> Begun {
        let mut found = search.begin((pair, factor), lattice, self.starts, passes, matched);
        if let Some(tissue) = found.is_unsure().then(around).flatten() {
            let wider = search.begin((&tissue, factor), lattice, self.starts_given(), passes, matched);
            found = Begun::surer(pair, found, wider);
        }
        if self.params.search_mm == 0.0 && found.leaves_open(pair, search.range) {
            let far = Search { range: TWICE * search.range, ..*search };
            let wide = far.begin((pair, factor), lattice, self.starts_given(), passes, matched);
            let taken = wide.outdoes(pair, &found);
            asked.push(why_farther(search.range, &found, &wide, taken));
            if taken {
                (*range, found) = (far.range, wide);
            }
        }
        found
    }
}

/// How far is searched if few features agree or the motion reaches the range, in ranges.
const TWICE: f64 = 2.0;

/// What a search twice as far gave, in words.
fn why_farther(range: f64, own: &Begun, wide: &Begun, taken: bool) -> String {
    let open = if own.agrees_on_few() { "few features agree" } else { "the motion reaches its end" };
    format!(
        "search range: within {range:.1} mm {open} ({:.0} % of the features agree); within {:.1} mm {:.0} % agree, {}",
        100.0 * own.share(),
        TWICE * range,
        100.0 * wide.share(),
        if taken { "taken" } else { "not taken" }
    )
}

/// Points that are matched at least, however few are asked for: a field is judged by them.
const LEAST_POINTS: usize = 200;

/// Voxels of tissue that a level to start from needs: about one in seventy is a corner, and
/// [`FEWEST`] must be left.
const LEAST_SEARCHED: usize = 1500;

/// The reach of the search: as asked, or 15 % of the smallest side, at least 2 voxels, at most 30
/// mm.
pub(super) fn search_mm(grid: &Grid, asked: f64) -> f64 {
    let (shape, spacing) = (grid.shape(), grid.spacing());
    let thick = || (0..3).filter(|&a| shape[a] > 1);
    let side = thick().map(|a| shape[a] as f64 * spacing[a]).fold(f64::INFINITY, f64::min);
    let voxel = thick().map(|a| spacing[a]).fold(0.0, f64::max);
    if asked > 0.0 { asked } else { (0.15 * side).min(30.0).max(2.0 * voxel) }
}

/// Voxels of the mask.
pub(super) fn inside(mask: &Mask) -> usize {
    mask.as_slice().iter().filter(|&&m| m != 0).count()
}

/// Reduction factors of the levels, coarse to fine: none but the finest with less tissue than
/// [`LEAST_SEARCHED`].
pub(super) fn worked_on(grid: &Grid, mask: &Mask, finest: usize, search: f64) -> Vec<[usize; 3]> {
    let inside = inside(mask);
    let mut all = factors(grid.shape(), grid.spacing(), finest, search / 6.0);
    let too_coarse = all.iter().take_while(|f| inside / f.iter().product::<usize>() < LEAST_SEARCHED).count();
    all.drain(..too_coarse.min(all.len() - 1));
    all
}

/// Voxels of the mask that a preset without a fixed finest level works on at most.
const WORKED_ON: usize = 600_000;

/// Voxels between the nodes of the lattice on levels above the finest.
const COARSE: usize = 3;

/// The finest level: as asked, or the first of 1, 2, 4, 8 at which no more than [`WORKED_ON`]
/// voxels of tissue are left.
pub(super) fn finest_level(grid: &Grid, mask: &Mask, asked: usize) -> usize {
    if asked > 0 {
        return asked;
    }
    let inside = inside(mask);
    let left = |f: usize| {
        let factor = factors(grid.shape(), grid.spacing(), f, 0.0)[0];
        inside / factor.iter().product::<usize>()
    };
    [1, 2, 4].into_iter().find(|&f| left(f) <= WORKED_ON).unwrap_or(8)
}

/// The mask and all other tissue: what is searched when too little inside the mask agrees.
fn around(mask: &Mask, initial: &Voxels<'_>) -> Vec<u8> {
    let tissue = foreground(initial);
    tissue.as_slice().iter().zip(mask.as_slice()).map(|(t, m)| u8::from(*t != 0 || *m != 0)).collect()
}

fn in_doubt(counts: Counts) -> String {
    let Counts { kept, features_initial: all, .. } = counts;
    format!(
        "only {kept} of {all} features agreed with their neighbours when the whole volume was searched: the motion may be \
         another; check that both volumes show the same tissue with the same contrast, and look at warped.nii.gz"
    )
}

/// Part of the tissue without texture from which that is why few matches survive.
const MOSTLY: f64 = 0.5;

/// Part of the variance that the volumes explain of each other at rest under which they show
/// nothing of the same.
const STRANGERS: f64 = 0.1;

/// Refuses a run with too few matches, with what was measured of the volumes and the one thing to
/// try. Nothing is advised that was asked for already.
pub(super) fn too_few(
    found: usize,
    pair: &Pair<'_>,
    (search, params): (f64, &FieldParams),
    started: bool,
) -> FieldError {
    let (plain, agreement) = (pair.plain(), contrast::agreement(pair, &Bodies::still(pair)).at_rest);
    // Volumes of cells are under a millimetre.
    let search = format!("{search:.*}", if search < 1.0 { 3 } else { 0 });
    let hint = match () {
        _ if plain > MOSTLY => format!(
            "{:.0} % of the tissue shows no texture that stands out of the noise: image finer or with less noise, or give --landmarks",
            100.0 * plain
        ),
        _ if agreement < STRANGERS && started => format!(
            "at the start one volume explains {:.0} % of the other's variance: check its direction (,-1 after a name turns it round), or \
             try --initial principal",
            100.0 * agreement
        ),
        _ if agreement < STRANGERS => format!(
            "at rest one volume explains {:.0} % of the other's variance: check that both show the same tissue; where they lie apart, \
             begin with --initial centre",
            100.0 * agreement
        ),
        _ if params.search_mm == 0.0 => {
            format!("the search range was {search} mm: if the tissue moved further, widen --search")
        }
        _ => format!("the search range was {search} mm: give --landmarks, or a start with --initial"),
    };
    no_match(found, hint)
}

pub(super) fn no_match(found: usize, hint: String) -> FieldError {
    FieldError::TooFew { found, what: "matches survive", needed: FEWEST, hint }
}

/// Where the number of points comes from.
fn why_so_many(params: &FieldParams, wanted: usize, found: usize) -> String {
    let source = match params.points {
        0 => format!("one for {} voxels of tissue", params.voxels_per_point),
        _ => "as asked".into(),
    };
    if found > wanted {
        return format!("points: {wanted} of the {found} that were matched are written, {source}");
    }
    let limit = if found < wanted { "; no more corners stand out of the noise" } else { "" };
    format!("points: {found} of {wanted} wanted, {source}{limit}")
}

/// Says so where a model that was asked for is smaller than the motion.
pub(super) fn said_of_model(rejected: bool) -> Option<String> {
    rejected.then(|| {
        "the motion model that was asked for does not explain the volumes (see the evidence): what it leaves out is an error; leave \
         --model out, or take free"
            .into()
    })
}

/// A level's match in world mm (RAS).
pub(super) fn world_match(grid: &Grid, m: &LevelMatch, factor: [usize; 3]) -> Match {
    let axes = spline::axes(grid);
    Match {
        initial: grid.affine().to_world(VoxelPoint(from_level(m.voxel, factor))),
        displacement: std::array::from_fn(|r| (0..3).map(|a| axes[r][a] * m.measured.displacement[a]).sum()),
        ncc: m.ncc,
        covariance: covariance_after(&axes, &m.measured.covariance),
        kept: m.kept,
        raw: None,
    }
}

/// Matches with what the final estimate says at their places.
pub(super) fn estimated(
    mut sparse: SparseField,
    grid: &Grid,
    (coefficients, deviation): (&FieldSpline, &ScalarSpline),
) -> SparseField {
    let of = |m: &mut Match| {
        let VoxelPoint(place) = grid.affine().to_voxel(m.initial);
        *m = m.with_estimate(coefficients.at_place(place), f64::from(deviation.at_place(place)));
    };
    sparse.matches.par_iter_mut().for_each(of);
    sparse
}

/// At most `wanted` of the matches, evenly.
fn thinned(sparse: SparseField, wanted: usize) -> SparseField {
    let count = sparse.matches.len();
    let every = |i: &usize| (i + 1) * wanted / count.max(1) > i * wanted / count.max(1);
    let matches = sparse.matches.into_iter().enumerate().filter(|(i, _)| wanted >= count || every(i));
    SparseField { matches: matches.map(|(_, m)| m).collect() }
}

/// The Delaunay mesh of the kept matches, and the kept match of each node.
///
/// # Errors
/// [`FieldError`] when they do not span the space, or the plane of a `flat` volume.
pub fn mesh_of(sparse: &SparseField, flat: bool) -> Result<(Mesh, Vec<u32>), FieldError> {
    let places: Vec<WorldPoint> = sparse.kept().map(|m| m.initial).collect();
    if !flat {
        match delaunay3(&places) {
            Ok(d) => return Ok((Mesh::Tetrahedra(d.mesh), d.source)),
            Err(MeshError::Coplanar) => {}
            Err(e) => return Err(e.into()),
        }
    }
    let d = delaunay2(&places)?;
    Ok((Mesh::Triangles(d.mesh), d.source))
}

/// Adds the mesh to the counts of the last level: these.
pub(super) fn with_mesh(reports: &mut [LevelReport], mesh: &Mesh) -> Counts {
    let mut nothing = Counts::default();
    let counts = reports.last_mut().map_or(&mut nothing, |r| &mut r.counts);
    (counts.nodes, counts.tetrahedra) = match mesh {
        Mesh::Tetrahedra(m) => (m.nodes().len(), m.tetrahedra().len()),
        Mesh::Triangles(m) => (m.nodes().len(), m.triangles().len()),
    };
    *counts
}

/// The field as asked for: `smooth`, or from the mesh inside it.
pub(super) fn interpolated(
    interpolation: Interpolation,
    smooth: DenseField,
    (mesh, nodes): (&Mesh, &[[f64; 3]]),
) -> Result<DenseField, FieldError> {
    match interpolation {
        Interpolation::Spline => Ok(smooth),
        Interpolation::Barycentric => {
            let mut field = barycentric(mesh, nodes, smooth)?;
            jacobian::unfold(&mut field, &[]);
            Ok(field)
        }
    }
}

/// Piecewise linear inside the mesh, `outside` elsewhere.
fn barycentric(mesh: &Mesh, nodes: &[[f64; 3]], mut outside: DenseField) -> Result<DenseField, FieldError> {
    let filled = match mesh {
        Mesh::Tetrahedra(m) => interpolation::interpolate_tetrahedra(m, nodes, outside.grid())?,
        Mesh::Triangles(m) => interpolation::interpolate_triangles(m, nodes, outside.grid())?,
    };
    let inside = filled.inside.as_slice();
    let (n, values) = (inside.len(), filled.displacement.as_slice());
    for (i, v) in outside.as_mut_slice().iter_mut().enumerate() {
        if inside[i % n] != 0 {
            *v = values[i];
        }
    }
    Ok(outside)
}

/// Length (mm) that all but a twentieth of the mask move at most, from at most about 25,000 of its
/// voxels. A neck that shows in one volume alone goes anywhere; of the tissues that are not each
/// other's (legs, heads, necks, upside down or noise) it was 1.1 to 2 times the search range, of
/// two people 0.4 to 0.7.
fn most_move(field: &DenseField, mask: &Mask) -> f64 {
    let parts = [0, 1, 2].map(|c| field.component(c));
    let length = |at: usize| parts.iter().map(|part| part[at] * part[at]).sum::<f32>().sqrt();
    let mut lengths: Vec<f32> = some_of(mask).map(length).collect();
    f64::from(quantile(&mut lengths, 0.95))
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

/// Part of the tissue without texture that earns a warning: pairs made from scans of heads, legs and a spine
/// have 0 to 8 %, legs in slices four times as thick as their voxels are wide 10.
const PLAIN: f64 = 0.1;

/// Says so where much of the tissue shows nothing that could be seen to move.
pub(super) fn without_texture(share: f64) -> Option<String> {
    (share > PLAIN).then(|| {
        format!(
            "{:.0} % of the tissue shows no texture that stands out of the noise: there the field is carried in from around, smooth, \
             and its uncertainty says too little; leave such parts out with --mask, or image finer or with less noise",
            100.0 * share
        )
    })
}

/// Part of the tissue outside the deformed volume that earns a warning.
const OUT_OF_VIEW: f64 = 0.05;

/// Says so where much of the tissue is not in the deformed volume.
pub(super) fn out_of_view(share: f64) -> Option<String> {
    (share > OUT_OF_VIEW).then(|| {
        format!(
            "{:.0} % of the tissue moves out of the deformed volume, or to where that shows nothing (not finite, or cut off): there the field is carried over from \
             what is in view, and may be off by more than its uncertainty says; leave such parts out with --mask",
            100.0 * share
        )
    })
}

/// What a user should know.
pub(super) fn warnings(counts: Counts, folds: usize, not_finite: [usize; 2], max_mm: f64, search: f64) -> Vec<String> {
    let mut out = Vec::new();
    for (count, volume) in not_finite.into_iter().zip(["initial", "deformed"]) {
        if count > 0 {
            out.push(format!("{count} voxels of the {volume} volume are not finite; they were left out"));
        }
    }
    if folds > 0 {
        out.push(format!("{folds} voxels fold (Jacobian at or below zero); do not trust strains there"));
    }
    if max_mm > NEAR * search {
        let at = if max_mm > search { "past" } else { "near" };
        out.push(format!(
            "the motion reaches {max_mm:.1} mm, {at} the search range of {search:.1} mm: where it goes further, it was not found; try a wider --search"
        ));
    }
    if counts.features_initial > 0 && counts.kept * 4 < counts.features_initial {
        let (kept, all) = (counts.kept, counts.features_initial);
        out.push(format!("only {kept} of {all} features found a consistent match; look at uncertainty.nii.gz"));
    }
    out
}
