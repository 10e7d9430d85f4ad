//! Stability: each chain pushed along one axis after the other until it breaks, with what it says
//! about itself.

use crate::error::{StiffnessError, SynthError};
use crate::evaluate;
use crate::evaluate::breaking::{Breaking, Spread, breaking_point};
use crate::evaluate::coverage::{BAND, coverage};
use crate::grasp::simulate::simulate;
use crate::pipeline::compression_phantoms::Pressed;
use crate::pipeline::dry_run::{phantom_memory, stiffness_memory};
use crate::pipeline::field::{self, FieldResult};
use crate::pipeline::speed_accuracy::{exact, posture_error};
use crate::synth::degradation::{disturbed, shifted_labels};
use crate::synth::{ElasticParams, PhantomKind, PhantomParams, Trouble, troubled};
use crate::types::scene::{Formulation, Method};
use crate::types::{FieldParams, Mask, Part, Scene, StiffnessParams, StiffnessResult, StressCurve, StressRun, Trust};
use rayon::prelude::*;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Called with the fraction that is done (0 to 1); may be called from any thread.
pub(crate) type Progress<'a> = &'a (dyn Fn(f64) + Sync);

/// How thorough a search is.
#[derive(Debug, Clone, PartialEq)]
pub struct Effort {
    /// Bodies for the field.
    pub bodies: Vec<PhantomParams>,
    /// Seeds of each body.
    pub seeds: Vec<u64>,
    /// Severities over the range.
    pub coarse: usize,
    /// Halvings before the first that breaks.
    pub halvings: usize,
    /// Voxels across the body for the stiffness.
    pub side: usize,
    /// Nodes of its mesh.
    pub nodes: usize,
}

impl Effort {
    /// Three bodies with three seeds, or one small one.
    pub fn new(quick: bool) -> Self {
        let body = |kind, size| PhantomParams::new(kind).sized(size);
        if quick {
            let bodies = vec![body(PhantomKind::Block, 48)];
            return Self { bodies, seeds: vec![1], coarse: 4, halvings: 1, side: 40, nodes: 2000 };
        }
        let bodies = vec![body(PhantomKind::Block, 64), body(PhantomKind::Head, 64), body(PhantomKind::Calf, 72)];
        Self { bodies, seeds: vec![1, 2, 3], coarse: 6, halvings: 3, side: 40, nodes: 2000 }
    }

    /// Memory that its stiffness runs hold at most (bytes): the body, and the finest mesh.
    ///
    /// # Errors
    /// [`SynthError`] where the body is out of range.
    pub(crate) fn stiffness_memory(&self) -> Result<u64, SynthError> {
        let grid = PhantomParams::new(PhantomKind::Inclusion).sized(self.side).grid()?;
        Ok(phantom_memory(&grid, true) + stiffness_memory(MESH_NODES[0] as usize))
    }
}

/// Nodes of the meshes along that axis, most first.
const MESH_NODES: [f64; 2] = [8000.0, 500.0];

/// Largest errors of usable results.
struct UsableResult {
    /// Mean error of a field over the mean motion (1); trust is low beyond it.
    field_error_ratio: f64,
    /// Error of a modulus (per cent).
    modulus_error_percent: f64,
    /// Error of a posture (degrees).
    posture_error_degrees: f64,
}

const USABLE: UsableResult =
    UsableResult { field_error_ratio: 1.0 / 3.0, modulus_error_percent: 20.0, posture_error_degrees: 0.5 };

/// The field on every body along every axis of `troubles`.
pub fn field_curves(effort: &Effort, troubles: &[Trouble], progress: Progress<'_>) -> Vec<StressCurve> {
    let pairs: Vec<_> = effort.bodies.iter().flat_map(|b| troubles.iter().map(move |t| (*t, b))).collect();
    let done = AtomicUsize::new(0);
    let one = |&(trouble, body): &(Trouble, &PhantomParams)| {
        let at = |severity: f64| -> Option<Vec<StressRun>> {
            let one = |&seed: &u64| field_run(&PhantomParams { seed, ..body.clone() }, trouble, severity).ok();
            effort.seeds.par_iter().map(one).collect()
        };
        let found =
            breaking_point(trouble.range(), Spread::Linear, effort.coarse, effort.halvings, at, |r| most_break(r));
        let n = done.fetch_add(1, Ordering::Relaxed) + 1;
        progress(n as f64 / pairs.len() as f64);
        let case = format!("{:?}", body.kind).to_lowercase();
        curve(Part::Field, trouble.name(), [trouble.unit(), "mm"], case, trouble.range(), found)
    };
    pairs.par_iter().map(one).collect()
}

/// At least half of the runs break.
fn most_break(runs: &[StressRun]) -> bool {
    2 * runs.iter().filter(|r| r.broken()).count() >= runs.len()
}

/// A curve from what a search has found.
fn curve(
    part: Part,
    axis: &str,
    [unit, error_unit]: [&'static str; 2],
    case: String,
    range: [f64; 2],
    found: Breaking<Vec<StressRun>>,
) -> StressCurve {
    let told = |runs: &[StressRun]| 2 * runs.iter().filter(|r| r.told()).count() >= runs.len();
    let first = found.tried.iter().position(|t| told(&t.1));
    let told_at = first.map(|i| found.tried[i].0);
    let quiet_at = found.tried[..first.unwrap_or(found.tried.len())].last().map(|t| t.0);
    let Breaking { tried, breaks_at, holds_at } = found;
    let runs = tried.into_iter().flat_map(|t| t.1).collect();
    StressCurve { part, axis: axis.into(), unit, error_unit, case, range, runs, breaks_at, holds_at, told_at, quiet_at }
}

/// One phantom in trouble, measured without a mask and scored over the tissue that both volumes
/// show.
///
/// # Errors
/// [`SynthError`] when there is no such phantom.
pub fn field_run(body: &PhantomParams, trouble: Trouble, severity: f64) -> Result<StressRun, SynthError> {
    let p = troubled(body, trouble, severity)?;
    let measured = field::run(&p.initial, &p.deformed, None, &FieldParams::default(), &|_, _| {});
    Ok(match measured {
        Err(e) => StressRun {
            severity,
            error: f64::NAN,
            limit: USABLE.field_error_ratio * p.description.mean_mm,
            refused: Some(e.to_string()),
            said: Vec::new(),
            inside: None,
            expected: None,
        },
        Ok(result) => {
            let scored = evaluate::metrics(&result.displacement, &p.truth, Some(&p.mask), &[]).ok();
            let sigma = |at: usize| result.uncertainty.at(at);
            StressRun {
                severity,
                error: scored.as_ref().map_or(f64::NAN, |m| m.mean_mm),
                limit: USABLE.field_error_ratio * scored.as_ref().map_or(0.0, |m| m.identity_mm),
                refused: None,
                said: distrusted(&result).into_iter().collect(),
                inside: coverage(&result.displacement, &p.truth, &sigma, &p.mask),
                expected: Some(result.summary.expected.mean_mm),
            }
        }
    })
}

/// The warning about a field of low trust.
fn distrusted(result: &FieldResult) -> Option<String> {
    let expected = &result.summary.expected;
    let low = expected.trust() == Trust::Low;
    low.then(|| format!("trust is low: the expected error is {:.0} % of the motion", 100.0 * expected.share()))
}

/// What makes a stiffness worse.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum StiffnessAxis {
    /// Noise of the displacement (per cent of the mean motion).
    Noise,
    /// Contrast of the ball.
    Contrast,
    /// Poisson's ratio that is assumed.
    Poisson,
    /// Labels beside their place (voxels).
    Labels,
    /// Nodes of the mesh.
    Mesh,
}

impl StiffnessAxis {
    /// All of them by name.
    pub const ALL: [(&'static str, Self); 5] = [
        ("noise", Self::Noise),
        ("contrast", Self::Contrast),
        ("poisson", Self::Poisson),
        ("labels", Self::Labels),
        ("mesh", Self::Mesh),
    ];
}

/// The stiffness of a ball in a block from exact displacements, made worse along each of `axes`;
/// with fewer severities when `quick`.
///
/// # Errors
/// As [`Pressed::new`].
pub(crate) fn stiffness_curves(
    effort: &Effort,
    quick: bool,
    axes: &[StiffnessAxis],
    progress: Progress<'_>,
) -> Result<Vec<StressCurve>, SynthError> {
    let base = PhantomParams::new(PhantomKind::Inclusion).sized(effort.side);
    let body = Pressed::new(&base)?;
    let motion = body.phantom.description.mean_mm;
    let usual = StiffnessParams { nodes: effort.nodes, force_n: Some(body.force_n), ..StiffnessParams::default() };
    let labels = body.phantom.stiffness.as_ref().map(|s| s.labels.clone()).ok_or(SynthError::NotElastic)?;
    let search = |axis: &str, unit, range, spread, run: &(dyn Fn(f64) -> Option<StressRun> + Sync)| {
        let [coarse, halvings] = if quick { [3, 1] } else { [5, 2] };
        let found = breaking_point(range, spread, coarse, halvings, |s| Some(vec![run(s)?]), |r| most_break(r));
        curve(Part::Stiffness, axis, [unit, "%"], "inclusion".into(), range, found)
    };
    let exact = |s: f64, labels: &Mask, params: &StiffnessParams| {
        Some(stiffness_run(&body, s, body.measure(&body.phantom.truth, None, labels, params)))
    };
    let one = |axis: StiffnessAxis| match axis {
        StiffnessAxis::Noise => search("noise", "%", [0.0, 20.0], Spread::Linear, &|s| {
            let field = disturbed(&body.phantom.truth, s / 100.0 * motion, base.seed);
            Some(stiffness_run(&body, s, body.measure(&field, None, &labels, &usual)))
        }),
        StiffnessAxis::Contrast => search("contrast", "ratio", [2.0, 100.0], Spread::Ratio, &|s| {
            let elastic = ElasticParams { contrast: s, ..base.elastic };
            let body = Pressed::new(&PhantomParams { elastic, ..base.clone() }).ok()?;
            let labels = &body.phantom.stiffness.as_ref()?.labels;
            let params = StiffnessParams { force_n: Some(body.force_n), ..usual.clone() };
            Some(stiffness_run(&body, s, body.measure(&body.phantom.truth, None, labels, &params)))
        }),
        StiffnessAxis::Poisson => {
            let range = [base.elastic.poisson, 0.2];
            search("Poisson's ratio assumed", "of 0.49", range, Spread::Linear, &|s| {
                exact(s, &labels, &StiffnessParams { poisson: s, ..usual.clone() })
            })
        }
        StiffnessAxis::Labels => search("labels beside their place", "voxels", [0.0, 8.0], Spread::Whole, &|s| {
            exact(s, &shifted_labels(&labels, s as usize), &usual)
        }),
        StiffnessAxis::Mesh => search("mesh", "nodes", MESH_NODES, Spread::Ratio, &|s| {
            exact(s, &labels, &StiffnessParams { nodes: s.round() as usize, ..usual.clone() })
        }),
    };
    let mut out = Vec::new();
    for (i, axis) in axes.iter().enumerate() {
        out.push(one(*axis));
        progress((i + 1) as f64 / axes.len() as f64);
    }
    Ok(out)
}

fn stiffness_run(body: &Pressed, severity: f64, found: Result<StiffnessResult, StiffnessError>) -> StressRun {
    let result = match found {
        Ok(result) => result,
        Err(e) => {
            let refused = Some(e.to_string());
            return StressRun {
                severity,
                error: f64::NAN,
                limit: USABLE.modulus_error_percent,
                refused,
                said: Vec::new(),
                inside: None,
                expected: None,
            };
        }
    };
    let errors = body.errors(&result);
    let mut said = result.warnings.clone();
    for r in &result.regions {
        let band = 100.0 * BAND * r.sd / r.youngs_modulus;
        if !r.identifiable {
            said.push(format!("{} is not identifiable", r.name));
        } else if band > USABLE.modulus_error_percent {
            said.push(format!("the 95 % band of {} is {band:.0} % wide to either side", r.name));
        }
    }
    let inside = result.regions.iter().filter(|r| (r.youngs_modulus - body.modulus(r.label)).abs() <= BAND * r.sd);
    StressRun {
        severity,
        error: errors.iter().copied().fold(0.0, f64::max),
        limit: USABLE.modulus_error_percent,
        refused: None,
        inside: Some(inside.count() as f64 / result.regions.len() as f64),
        expected: None,
        said,
    }
}

/// What makes a grasp harder.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GraspAxis {
    /// Integrator's step (s), for each method and formulation.
    Step,
    /// Young's modulus of the tips (Pa).
    TipStiffness,
    /// Object's mass (kg).
    Mass,
    /// Object's width (m).
    Width,
    /// Coefficient of friction.
    Friction,
}

impl GraspAxis {
    /// All of them by name.
    pub const ALL: [(&'static str, Self); 5] = [
        ("step", Self::Step),
        ("tip stiffness", Self::TipStiffness),
        ("mass", Self::Mass),
        ("width", Self::Width),
        ("friction", Self::Friction),
    ];

    fn name(self) -> &'static str {
        Self::ALL.iter().find(|a| a.1 == self).map_or("", |a| a.0)
    }

    /// Unit and range, easy end first.
    fn range(self) -> (&'static str, [f64; 2]) {
        match self {
            Self::Step => ("s", [1e-4, 0.05]),
            Self::TipStiffness => ("Pa", [2e5, 2e3]),
            Self::Mass => ("kg", [0.1, 50.0]),
            Self::Width => ("m", [0.06, 0.006]),
            Self::Friction => ("", [1.0, 0.02]),
        }
    }

    fn apply(self, scene: &mut Scene, v: f64) {
        match self {
            Self::Step => {
                let integrator = &mut scene.integrator;
                (integrator.step, integrator.output_every) = (v, integrator.output_every.max(v));
            }
            Self::TipStiffness => scene.fingertip.youngs_modulus = v,
            Self::Mass => (scene.object.inertia, scene.object.mass) = (scene.object.inertia * v / scene.object.mass, v),
            Self::Width => *scene = scene.clone().with_width(v),
            Self::Friction => scene.object.friction = Some(v),
        }
    }
}

/// The reference scene's eight motions made worse along each of `axes`: the step with every method
/// and formulation, all else with Runge and Kutta's in minimal coordinates.
pub fn grasp_curves(effort: &Effort, axes: &[GraspAxis], progress: Progress<'_>) -> Vec<StressCurve> {
    let forms: Vec<(Method, Formulation)> = [Method::Rk4, Method::SemiImplicitEuler]
        .into_iter()
        .flat_map(|m| Formulation::ALL.map(|(_, f)| (m, f)))
        .collect();
    let usual = [(Method::Rk4, Formulation::Minimal)];
    let with = |&axis: &GraspAxis| if axis == GraspAxis::Step { &forms[..] } else { &usual[..] };
    let all: Vec<_> = axes.iter().flat_map(|a| with(a).iter().map(move |form| (*a, *form))).collect();
    let done = AtomicUsize::new(0);
    let one = |&(axis, (method, formulation)): &(GraspAxis, (Method, Formulation))| {
        let friction = axis == GraspAxis::Friction;
        let run = |v: f64| {
            let mut scene = Scene::reference();
            (scene.integrator.method, scene.integrator.formulation) = (method, formulation);
            axis.apply(&mut scene, v);
            Some(vec![grasp_run(&scene, v, friction)])
        };
        let (unit, range) = axis.range();
        let found =
            breaking_point(range, Spread::Ratio, effort.coarse.max(5), effort.halvings + 2, run, |r| most_break(r));
        let n = done.fetch_add(1, Ordering::Relaxed) + 1;
        progress(n as f64 / all.len() as f64);
        let case = format!("{}, {}", method.name(), formulation.name());
        let error = if friction { "of the friction there is" } else { "degrees" };
        curve(Part::Grasp, axis.name(), [unit, error], case, range, found)
    };
    all.par_iter().map(one).collect()
}

/// One scene against the same scene by the adaptive integrator. With `friction` the error is the
/// largest share of the friction that the contacts ask for.
fn grasp_run(scene: &Scene, severity: f64, friction: bool) -> StressRun {
    let limit = if friction { 1.0 } else { USABLE.posture_error_degrees };
    let (mut error, mut refused, mut said) = (f64::NAN, None, Vec::new());
    match simulate(scene, &|_| {}) {
        Err(e) => refused = Some(e.to_string()),
        Ok(run) => {
            said = run
                .events
                .iter()
                .map(|e| format!("{} at {:.2} s: {}", e.kind.name(), e.time, e.what))
                .take(3)
                .collect();
            if friction {
                // A tip that slides asks for no more than there is: what it would ask for without a
                // limit is the error.
                let mut free = scene.clone();
                free.object.friction = None;
                let asked = simulate(&free, &|_| {}).map_or(f64::NAN, |free| free.required_friction);
                error = asked / scene.object.friction.unwrap_or(f64::INFINITY);
            } else if run.completed {
                error = simulate(&exact(scene), &|_| {}).map_or(f64::NAN, |e| posture_error(&run, &e));
            }
        }
    }
    StressRun { severity, error, limit, refused, said, inside: None, expected: None }
}
