//! A displacement field to Young's modulus, region by region.

use crate::error::StiffnessError;
use crate::numerics::sampling::{displacement, nearest};
use crate::pipeline::body_meshes::{BodyMeshes, whole};
use crate::pipeline::clock::Clock;
use crate::pipeline::stiffness_regions;
use crate::stiffness::boundary_conditions::{Patch, Place};
use crate::stiffness::geometry::Geometry;
use crate::stiffness::identify::{Estimate, Setup, State};
use crate::stiffness::inclusion::Inclusion;
use crate::stiffness::interface::Interface;
use crate::stiffness::mesh_problem::Level;
use crate::stiffness::model_selection::{Choice, as_meshed, choose, known_moduli, settle};
use crate::stiffness::observations::Observation;
use crate::stiffness::rigid_rotation::{Affinity, Turn};
use crate::stiffness::summary::{Hidden, Moduli, Scale};
use crate::stiffness::systematic_error::Fit;
use crate::stiffness::verdict::{Found, Misfit, Shape, Verdict};
use crate::stiffness::{fields, geometry, summary};
use crate::strain::deviation::error_draws;
use crate::types::stiffness::{
    Determined, Evidence, Law, LawChoice, PatchReport, RegionStiffness, StiffnessParams, StiffnessResult,
};
use crate::types::{
    DenseField, Displacement, ErrorSamples, Mask, MotionModel, QuadraticMesh, SparseField, Trust, WorldPoint,
};

/// Called with a stage's name and the fraction of the whole that is done (0 to 1); may be called
/// from any thread.
pub(crate) type Progress<'a> = &'a (dyn Fn(&str, f64) + Sync);

/// What is given.
#[derive(Clone, Copy)]
pub struct Inputs<'a> {
    /// The displacement, on the grid of `labels`.
    pub field: &'a Displacement<'a>,
    /// Matches to use in place of the field inside the body.
    pub matches: Option<&'a SparseField>,
    /// Regions; 0 outside the body.
    pub labels: &'a Mask,
    /// Whether the labels name regions, or are a mask.
    pub labelled: bool,
    /// Where the body is held.
    pub held: &'a Place,
    /// Where it is pressed.
    pub load: &'a Place,
    /// A name for each label.
    pub names: &'a (dyn Fn(u8) -> String + Sync),
    /// What is known of the field's own error.
    pub quality: FieldQuality<'a>,
}

/// What is known of a field's own error; nothing of a field that comes alone.
#[derive(Debug, Clone, Copy, Default)]
pub struct FieldQuality<'a> {
    /// How far to rely on it.
    pub trust: Option<Trust>,
    /// The motion model that it came from.
    pub model: Option<MotionModel>,
    /// Random draws of its error.
    pub samples: Option<&'a ErrorSamples>,
}

impl FieldQuality<'_> {
    /// Its model, where that shows no difference between regions, whatever they are.
    fn flat_model(&self) -> Option<MotionModel> {
        self.model.filter(|model| *model != MotionModel::Free)
    }
}

/// Fewest matches in a body for them to be used unasked: what an identification needs, and a tenth
/// that the mesh may leave out at the surface.
pub(crate) const MIN_MATCHES_IN_BODY: usize = 110;

/// Kept matches in the body.
pub fn inside(matches: &SparseField, labels: &Mask) -> usize {
    let grid = labels.grid();
    let held = |p: WorldPoint| {
        let v = grid.affine().to_voxel(p);
        nearest(grid.shape(), v).is_some_and(|o| labels.as_slice()[o] > 0)
    };
    matches.kept().filter(|m| held(m.initial)).count()
}

/// Moves of a punch's edge on the fine mesh: the coarse mesh has found most of the way.
const MAX_FINE_MOVES: usize = 1;
/// Tolerance of forward solutions on a fine mesh (mm).
pub(super) const FORWARD_TOLERANCE_MM: f64 = 1e-5;

/// Young's modulus of each labelled region, or of the regions that the data support.
///
/// # Errors
/// [`StiffnessError`] when the input does not fit together or the equations cannot be solved.
///
/// ```
/// use palpate::pipeline::experimental_design::{PlanInputs, simulate};
/// use palpate::pipeline::dry_run;
/// use palpate::pipeline::stiffness::{FieldQuality, Inputs, run};
/// use palpate::types::plan::PlanParams;
/// use palpate::types::stiffness::{LawChoice, Side};
/// use palpate::{Affine, Grid, Mask, Place, StiffnessParams};
/// // A block of 12 mm of one tissue, held at its base and pressed from above.
/// let grid = Grid::new([16; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let labels =
///     Mask::from_voxels(grid, |_, p| u8::from(p.0.iter().all(|x| (2.0..14.0).contains(x))));
/// let side = |name| Side::parse(name).map(Place::Side).ok_or("no side");
/// let (held, load) = (side("z-")?, side("z+")?);
/// let stiffness =
///     StiffnessParams { nodes: 500, model: LawChoice::Linear, ..StiffnessParams::default() };
/// let inputs =
///     PlanInputs { labels: &labels, held: &held, load: &load, names: &|_| "muscle".into() };
/// let params = PlanParams { moduli: vec![(1, 20.0)], stiffness, ..PlanParams::default() };
/// let truth = simulate(&inputs, &params, 0.5)?;
/// let names = |_: u8| "muscle".to_string();
/// let inputs = Inputs {
///     field: &truth.field,
///     matches: None,
///     labels: &labels,
///     labelled: true,
///     held: &held,
///     load: &load,
///     names: &names,
///     quality: FieldQuality::default(),
/// };
/// let params = StiffnessParams { force_n: Some(truth.force_n), ..params.stiffness };
/// let found = run(&inputs, &params, &|_, _| {})?;
/// assert!((found.regions[0].youngs_modulus / 20.0 - 1.0).abs() < 0.2);
/// // What it would take was told beforehand.
/// assert_eq!(dry_run::stiffness(&inputs, &params)?.nodes, found.mesh.nodes().len());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn run(
    inputs: &Inputs<'_>,
    params: &StiffnessParams,
    progress: Progress<'_>,
) -> Result<StiffnessResult, StiffnessError> {
    params.check()?;
    whole(inputs.labels)?;
    let (result, turn) = without_turn(inputs, |inputs| unturned(inputs, params, progress));
    let mut result = result?;
    result.warnings.extend(turn.map(|turn| {
        format!(
            "the body turned by {:.1} degrees as a whole; that was taken out first, and the displacements of the mesh and of the exported \
             models are without it",
            turn.degrees()
        )
    }));
    Ok(result)
}

/// What `then` makes of the inputs without a turn of the whole body, and that turn, if any.
pub(super) fn without_turn<R>(inputs: &Inputs<'_>, then: impl FnOnce(&Inputs<'_>) -> R) -> (R, Option<Turn>) {
    let Some(turn) = Turn::of(inputs.field, inputs.labels) else { return (then(inputs), None) };
    let (field, matches) = (turn.undone(inputs.field), inputs.matches.map(|m| turn.undone_matches(m)));
    (then(&Inputs { field: &field, matches: matches.as_ref(), ..*inputs }), Some(turn))
}

/// [`run`] for a body that did not turn.
fn unturned(
    inputs: &Inputs<'_>,
    params: &StiffnessParams,
    progress: Progress<'_>,
) -> Result<StiffnessResult, StiffnessError> {
    if inputs.labelled {
        return labelled(inputs, params, Vec::new(), progress);
    }
    let found = stiffness_regions::regions(inputs, params, &|s, f| progress(s, 0.5 * f))?;
    let (mut labels, mut evidence) = (found.labels, found.evidence);
    let mut result = loop {
        let inputs = Inputs { labels: &labels, ..*inputs };
        let result = labelled(&inputs, params, evidence.clone(), &|s, f| progress(s, 0.5 + 0.5 * f))?;
        let Some(like) = result.regions.iter().find(|r| is_like_the_first(r)) else { break result };
        (labels, evidence) = without(&labels, like.label, evidence);
    };
    if let Some(why) = found.left_over.and_then(fields::left_over) {
        // Something of another modulus may be hidden there.
        result.trust = result.trust.max(Trust::Moderate);
        result.trust_reasons.push("one modulus leaves more than noise, and no second region was made out".into());
        result.warnings.push(why);
    }
    result.left_over = found.left_over;
    result.detectable = found.detectable;
    result.found = Some(labels);
    result.seconds.insert(0, ("search".into(), found.seconds));
    Ok(result)
}

/// Whether the modulus of a region that was found is within two deviations of the first one's.
fn is_like_the_first(r: &RegionStiffness) -> bool {
    r.label > 1 && r.state == Determined::Determined && r.ratio.ln().abs() < 2.0 * r.ratio_sd / r.ratio
}

/// Labels with one region given back to the first, and the evidence for that.
fn without(labels: &Mask, label: u8, mut evidence: Vec<Evidence>) -> (Mask, Vec<Evidence>) {
    let lower = |l: u8| if l == label { 1 } else { l - u8::from(l > label) };
    let out = Mask::from_voxels(*labels.grid(), |o, _| lower(labels.as_slice()[o]));
    let count = labels.as_slice().iter().copied().max().unwrap_or(1);
    for e in evidence.iter_mut().filter(|e| e.question == "regions") {
        e.chosen = e.model == (count - 1).to_string();
        if e.model == count.to_string() {
            e.reason = "on the fine mesh its modulus is within two deviations of the first one's".into();
        }
    }
    (out, evidence)
}

/// The chain for labelled regions; `tried` is the evidence that led to them.
fn labelled(
    inputs: &Inputs<'_>,
    params: &StiffnessParams,
    tried: Vec<Evidence>,
    progress: Progress<'_>,
) -> Result<StiffnessResult, StiffnessError> {
    let mut clock = Clock::start();
    let (solved, mesh) = solved(inputs, params, progress, &mut clock)?;
    progress("uncertainty", 0.9);
    let setup = solved.fine.setup(solved.choice.law, params, solved.reference);
    let deviation = Deviation::of(inputs, params, &solved, &setup)?;
    let (regions, no_contrast) = regions(inputs, &solved, &deviation);
    clock.book("uncertainty");
    let touched = setup.touching(&deviation.state);
    let patches = patch_reports(&solved.fine, touched.as_ref());
    let is_affine = Affinity::of(inputs.field, inputs.labels).is_some_and(|a| a.is_all_of(inputs.field, inputs.labels));
    let verdict = Verdict::of(&deviation.misfit, inputs.quality.trust, is_affine, &regions);

    let Solved { fine, choice, estimate, hidden, reference, .. } = &solved;
    let Deviation { moduli, state, misfit, mesh_change, .. } = &deviation;
    let mut warnings = fields::unfit(inputs.field, inputs.labels, misfit);
    warnings.extend(fields::one_map(is_affine, regions.len()));
    warnings.extend(choice.warnings.iter().cloned());
    let pressed = patches.get(1).map_or(0.0, |p| p.area);
    warnings.extend(fields::warnings(fine, inputs.labels, &regions, mesh_change, pressed, params));
    warnings.extend(params.force_n.and_then(|force| fields::leaning(force, estimate.leaning)));
    warnings.extend(fields::not_shown(hidden, &regions, *reference));
    warnings.extend(no_contrast);
    warnings.dedup();
    let of_region = |f: &dyn Fn(usize) -> f64| fields::by_label(inputs.labels, &fine.body.labels, f);
    let (map, map_sd) = (of_region(&|r| regions[r].youngs_modulus), of_region(&|r| regions[r].sd));
    let residual = fields::residual(inputs.labels, &fine.observations, &estimate.residuals, fine.block);
    let kpa = moduli.log[*reference].exp() / (2.0 * (1.0 + setup.poisson[*reference]));
    let touching = [None, touched.as_ref().map(|t| t.0.as_slice())];
    let displacement = fields::node_displacement(&fine.body, state);
    let prescribed = fields::prescribed(&setup, state, &touching);
    let element_modulus = fine.body.region.iter().map(|&r| moduli.log[r as usize].exp()).collect();
    let strain = summary::strain(&setup, state);
    clock.book("maps");
    Ok(StiffnessResult {
        correlation: summary::correlation(&moduli.covariance, fine.body.labels.len()),
        absolute: deviation.scale != Scale::Ratio,
        law: choice.law,
        poisson: params.poisson,
        poisson_of: params.poisson_of.clone(),
        force_n: params.force_n,
        label_sd: if inputs.labelled { params.label_sd } else { 0.0 },
        reference: fine.body.labels[*reference],
        residual_mm: estimate.rms,
        noise_mm: fine.noise * (fine.block.max(1) as f64).powf(1.5),
        evidence: tried.into_iter().chain(choice.evidence.iter().cloned()).collect(),
        patches,
        map,
        map_sd,
        residual,
        element_modulus,
        displacement,
        prescribed,
        model_force: estimate.force[0] * estimate.leaning * kpa / 1000.0,
        strain,
        warnings,
        seconds: clock.0,
        samples: [3.0 * estimate.residuals.len() as f64, estimate.effective],
        labelled: inputs.labelled,
        left_over: None,
        detectable: Vec::new(),
        found: None,
        trust: verdict.trust,
        trust_reasons: verdict.reasons,
        regions,
        mesh: fine.moved(mesh)?,
        faces: deviation.geometry.map(|g| g.faces).unwrap_or_default(),
        mesh_change: deviation.mesh_change,
    })
}

/// Contact, law, shape and moduli, chosen on the coarse mesh and identified on the fine one.
struct Solved {
    coarse: Level,
    fine: Level,
    choice: Choice,
    estimate: Estimate,
    /// Regions that the data do not show.
    hidden: Vec<Hidden>,
    /// The region that ratios refer to.
    reference: usize,
}

fn solved(
    inputs: &Inputs<'_>,
    params: &StiffnessParams,
    progress: Progress<'_>,
    clock: &mut Clock,
) -> Result<(Solved, QuadraticMesh), StiffnessError> {
    progress("mesh", 0.0);
    let BodyMeshes { mut coarse, mut fine, mesh } = BodyMeshes::new(inputs, params)?;
    let reference = fine.largest();
    clock.book("mesh");

    progress("coarse", 0.1);
    let mut hidden = Vec::new();
    let mut choice = chosen(&mut coarse, params, reference, &mut hidden)?;
    clock.book("coarse");

    progress("fine", 0.4);
    let mut estimate = identified(&coarse, &mut fine, &choice, params, reference, MAX_FINE_MOVES);
    if is_unsolved(&estimate) {
        // What the shape changes stays to first order then.
        fine.move_back();
        estimate = as_meshed(&mut coarse, choice.law, params, reference, &choice.estimate).and_then(|again| {
            choice.estimate = again;
            identified(&coarse, &mut fine, &choice, params, reference, 0)
        });
    }
    if is_unsolved(&estimate) && params.model == LawChoice::Auto && choice.law == Law::NeoHookean {
        [&mut coarse, &mut fine].into_iter().for_each(Level::move_back);
        let linear = StiffnessParams { model: LawChoice::Linear, ..params.clone() };
        let again = chosen(&mut coarse, &linear, reference, &mut hidden)?;
        choice = Choice { evidence: without_large_strain(choice.evidence), ..again };
        choice.warnings.push(
            "the neo-Hookean law found no equilibrium on the fine mesh, and the linear one is taken, which is an approximation: check \
             the field, the labels and the patches"
                .into(),
        );
        estimate = identified(&coarse, &mut fine, &choice, &linear, reference, MAX_FINE_MOVES);
    }
    let estimate = estimate?;
    clock.book("fine");
    Ok((Solved { coarse, fine, choice, estimate, hidden, reference }, mesh))
}

/// The moduli with their covariance, from noise, shape, mesh and what no block of the data shows.
struct Deviation {
    geometry: Option<Geometry>,
    /// The solution with the shape as it was found.
    state: State,
    scale: Scale,
    misfit: Misfit,
    moduli: Moduli,
    /// As if the shape were known.
    alone: Moduli,
    /// Change of ln E from the coarse to the fine mesh.
    mesh_change: Vec<f64>,
    /// Regions of which the data give a bound alone.
    unseen: Vec<Option<&'static str>>,
    /// Labels whose shapes were found.
    drawn: Vec<u8>,
}

impl Deviation {
    fn of(
        inputs: &Inputs<'_>,
        params: &StiffnessParams,
        solved: &Solved,
        setup: &Setup<'_>,
    ) -> Result<Self, StiffnessError> {
        let Solved { coarse, fine, choice, estimate, reference, .. } = solved;
        let coarse_setup = coarse.setup(choice.law, params, *reference);
        let inclusions = if inputs.labelled { Vec::new() } else { Inclusion::all(inputs.labels) };
        // Of regions that were found the shapes are open as a whole.
        let interfaces = if inputs.labelled { Interface::all(inputs.labels) } else { Interface::walls(inputs.labels) };
        let grid = inputs.labels.grid();
        let geometry = geometry::fit(&coarse_setup, &choice.estimate, grid, &interfaces, &inclusions)?;
        let corrected = |step: &[f64]| {
            let x = estimate.state.x.as_deref().unwrap_or_default();
            setup.advanced(&estimate.state, x, &estimate.columns, step)
        };
        let state = geometry.as_ref().map_or_else(|| estimate.state.clone(), |g| corrected(&g.step));
        let scale = Scale::of(&fine.body, params);
        let misfit = fine.misfit(estimate);
        let moduli = summary::moduli(setup, estimate, geometry.as_ref(), scale);
        let alone = summary::moduli(setup, estimate, None, scale);
        let fit = geometry.as_ref().map_or_else(|| Fit::of(&coarse_setup, &choice.estimate), |g| g.fit.clone());
        let more = fit.coherent(&coarse_setup, &choice.estimate, misfit.mm, &errors_drawn(inputs, coarse))?;
        let moduli = moduli.widened(&summary::with_covariance(setup, estimate, geometry.as_ref(), scale, &more));
        let before = summary::moduli(&coarse_setup, &choice.estimate, geometry.as_ref(), scale);
        let count = fine.body.labels.len();
        let mesh_change: Vec<f64> = (0..count).map(|r| moduli.log[r] - before.log[r]).collect();
        let unseen = (0..count)
            .map(|r| summary::unseen(&coarse_setup, &choice.estimate, r, moduli.ratio_variance[r]))
            .collect::<Result<Vec<_>, _>>()?;
        let drawn = if geometry.is_some() { inclusions.iter().map(Inclusion::label).collect() } else { Vec::new() };
        Ok(Self { geometry, state, scale, misfit, moduli, alone, mesh_change, unseen, drawn })
    }
}

/// The regions' moduli with their verdicts, and the warning where none differs.
fn regions(inputs: &Inputs<'_>, solved: &Solved, deviation: &Deviation) -> (Vec<RegionStiffness>, Option<String>) {
    let Solved { fine, hidden, reference, .. } = solved;
    let shape = |label: &u8| match (inputs.labelled || *label == 1, deviation.drawn.contains(label)) {
        (true, _) => Shape::Given,
        (false, true) => Shape::Drawn,
        (false, false) => Shape::Cut,
    };
    let found = Found {
        moduli: &deviation.moduli,
        alone: &deviation.alone,
        mesh_change: &deviation.mesh_change,
        unseen: &deviation.unseen,
        shapes: &fine.body.labels.iter().map(shape).collect::<Vec<_>>(),
        hidden,
        known: &fine.known,
        flat_model: inputs.quality.flat_model(),
        misfits: deviation.misfit.trust() == Trust::Low,
        scale: deviation.scale,
        reference: *reference,
    };
    (found.regions(&fine.body, inputs.names), found.no_contrast())
}

/// Where the body is held and pressed; `touched` are the nodes and the area (mm^2) that a plate
/// without friction touches.
fn patch_reports(fine: &Level, touched: Option<&(Vec<u32>, f64)>) -> Vec<PatchReport> {
    let of = |(i, p): (usize, &Patch)| {
        let touched = touched.filter(|_| i == 1);
        PatchReport {
            name: p.name.clone(),
            area: touched.map_or_else(|| p.area(&fine.body), |t| t.1),
            nodes: touched.map_or(p.nodes.len(), |t| t.0.len()),
            contact: p.contact,
            translation: [p.rigid[0], p.rigid[1], p.rigid[2]],
            travel_mm: p.travelled(&fine.body),
            residual_mm: p.residual[0].hypot(p.residual[1]),
        }
    };
    fine.patches.iter().enumerate().map(of).collect()
}

/// The evidence where the law that was chosen cannot be solved on the fine mesh.
fn without_large_strain(mut evidence: Vec<Evidence>) -> Vec<Evidence> {
    for e in evidence.iter_mut().filter(|e| e.question == "law") {
        e.chosen = e.model == Law::Linear.name();
        e.reason = "the neo-Hookean law found no equilibrium on the fine mesh".into();
    }
    evidence
}

/// Contact, law, shape and moduli on the coarse mesh; regions that the data do not show are left
/// out one after the other, and added to `hidden`.
fn chosen(
    coarse: &mut Level,
    params: &StiffnessParams,
    reference: usize,
    hidden: &mut Vec<Hidden>,
) -> Result<Choice, StiffnessError> {
    let mut choice = choose(coarse, params, reference)?;
    while let Some(found) = summary::least_seen(&coarse.setup(choice.law, params, reference), &choice.estimate) {
        hidden.push(found);
        coarse.hidden.push(found.label);
        choice = choose(coarse, params, reference)?;
    }
    choice.estimate = known_moduli(coarse, choice.law, params, reference, choice.estimate)?;
    Ok(choice)
}

fn is_unsolved(found: &Result<Estimate, StiffnessError>) -> bool {
    matches!(found, Err(StiffnessError::NoEquilibrium | StiffnessError::InsideOut))
}

/// The moduli on the fine mesh, from those on the coarse one, with more moves of the shape.
fn identified(
    coarse: &Level,
    fine: &mut Level,
    choice: &Choice,
    params: &StiffnessParams,
    reference: usize,
    moves: usize,
) -> Result<Estimate, StiffnessError> {
    (fine.hidden, fine.known) = (coarse.hidden.clone(), coarse.known.clone());
    fine.touch_like(coarse)?;
    let start = State { plates: choice.estimate.state.plates.clone(), ..fine.carry(coarse, &choice.estimate.state) };
    let estimate = fine.setup(choice.law, params, reference).run(start, 3, FORWARD_TOLERANCE_MM)?;
    settle(fine, choice.law, params, reference, estimate, moves, FORWARD_TOLERANCE_MM)
}

/// Draws of the field's error at the observations (mm, RAS); none where matches are taken in its
/// place, or nothing is known of it.
fn errors_drawn(inputs: &Inputs<'_>, level: &Level) -> Vec<Vec<[f64; 3]>> {
    let Some(samples) = inputs.quality.samples.filter(|_| inputs.matches.is_none()) else { return Vec::new() };
    let Ok(draws) = error_draws(inputs.field.grid(), samples) else { return Vec::new() };
    let at = |error: &DenseField, o: &Observation| {
        displacement(error, WorldPoint(o.place)).map(|v| if v.is_finite() { v } else { 0.0 })
    };
    draws.iter().map(|error| level.observations.iter().map(|o| at(error, o)).collect()).collect()
}
