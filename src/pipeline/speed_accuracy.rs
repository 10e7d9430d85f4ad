//! Speed against accuracy: each chain with many settings on cases with a known answer, one run at a
//! time, timed by the CPU time of this process.

use crate::error::{FieldError, GraspError, SynthError};
use crate::evaluate::{self, mean};
use crate::grasp::simulate::simulate;
use crate::numerics::statistics::percentile;
use crate::pipeline::{cpu, field};
use crate::synth::{MotionKind, Phantom, PhantomKind, PhantomParams, phantom};
use crate::types::grasp::GraspRun;
use crate::types::params::{Interpolation, Method as FieldMethod, Preset};
use crate::types::scene::{Formulation, Method};
use crate::types::space::length;
use crate::types::{DenseField, FieldParams, Landmark, Mask, Part, Scene, Trial, Volume};

/// A pair of volumes with a known answer.
#[derive(Debug, Clone, PartialEq)]
pub struct Case {
    /// Its name.
    pub name: String,
    /// Volume before the deformation.
    pub initial: Volume,
    /// Volume after it.
    pub deformed: Volume,
    /// The exact displacement on the initial grid.
    pub truth: Option<DenseField>,
    /// Where errors count; never given to a method.
    pub mask: Option<Mask>,
    /// Known places; they are the truth where no field is, all of them, whatever the mask.
    pub landmarks: Vec<Landmark>,
}

/// A setting of the field pipeline.
#[derive(Debug, Clone, PartialEq)]
pub struct Variant {
    /// What is varied.
    pub varied: &'static str,
    /// Short name.
    pub method: String,
    /// All that sets it apart from the default, in words.
    pub settings: String,
    /// The parameters.
    pub params: FieldParams,
}

impl Variant {
    fn new(varied: &'static str, method: &str, settings: &str, change: impl Fn(&mut FieldParams)) -> Self {
        let mut params = FieldParams::default();
        change(&mut params);
        Self { varied, method: method.into(), settings: settings.into(), params }
    }

    /// The steps between speed and accuracy: the field from matches alone, and the presets. That
    /// called accurate writes more matches of the field that balanced makes.
    pub fn steps() -> Vec<Self> {
        let preset = |name: &str, preset| {
            Self::new("preset", name, &format!("--preset {name}"), |p| *p = FieldParams::preset(preset))
        };
        let sparse = Self::new("preset", "sparse", "--method sparse", |p| p.method = FieldMethod::Sparse);
        vec![sparse, preset("fast", Preset::Fast), preset("balanced", Preset::Balanced)]
    }

    /// Presets, point budgets and changes of single stages of the balanced preset; fewer when
    /// `quick`.
    pub fn all(quick: bool) -> Vec<Self> {
        let mut out = Self::steps();
        let budgets: &[usize] = if quick { &[500] } else { &[200, 1000, 5000, 25_000] };
        for &points in budgets {
            let name = format!("{points} points");
            out.push(Self::new("points", &name, &format!("--points {points}"), |p| p.points = points));
        }
        let stage =
            |name: &str, settings: &str, change: &dyn Fn(&mut FieldParams)| Self::new("stage", name, settings, change);
        out.push(stage("piecewise linear", "linear in the tetrahedra of the matches", &|p| {
            p.interpolation = Interpolation::Barycentric;
        }));
        out.push(stage("no consistency", "each feature takes its best correlation, none is cast out", &|p| {
            p.consistency = false;
        }));
        if quick {
            return out;
        }
        for k in [1, 3, 20] {
            out.push(stage(&format!("K = {k}"), &format!("{k} candidates a source, not 8"), &|p| p.candidates = k));
        }
        out.push(stage("whole voxels", "matches are not refined (the time for it is still spent)", &|p| {
            p.sub_voxel = false;
        }));
        out.push(stage("linear, no consistency", "linear in the tetrahedra, best correlations", &|p| {
            (p.interpolation, p.consistency) = (Interpolation::Barycentric, false);
        }));
        out.push(stage("linear, whole voxels", "linear in the tetrahedra, matches not refined", &|p| {
            (p.interpolation, p.sub_voxel) = (Interpolation::Barycentric, false);
        }));
        for (nodes, name) in [(2, "nodes 2"), (8, "nodes 8")] {
            out.push(stage(name, &format!("spline nodes every {nodes} voxels"), &|p| p.node_spacing = nodes));
        }
        for passes in [2, 24] {
            let settings = format!("{passes} residual passes on the finest level, not 6");
            out.push(stage(&format!("{passes} passes"), &settings, &|p| p.passes = passes));
        }
        out
    }
}

/// The embedded spread of field cases: bodies, motions, thick slices and one slice; three small
/// ones when `quick`.
pub fn spread(quick: bool, seed: u64) -> Vec<PhantomParams> {
    let case = |kind, motion, size| PhantomParams { seed, ..PhantomParams::new(kind).moving(motion).sized(size) };
    if quick {
        return vec![
            case(PhantomKind::Block, MotionKind::Smooth, 32),
            case(PhantomKind::Head, MotionKind::Press, 36),
            case(PhantomKind::Calf, MotionKind::Smooth, 48),
        ];
    }
    vec![
        case(PhantomKind::Block, MotionKind::Smooth, 64),
        case(PhantomKind::Head, MotionKind::Smooth, 64),
        case(PhantomKind::Head, MotionKind::Press, 64),
        case(PhantomKind::Calf, MotionKind::Smooth, 72),
        case(PhantomKind::Calf, MotionKind::Slide, 72),
        case(PhantomKind::Fingertip, MotionKind::Press, 64),
        case(PhantomKind::Slice, MotionKind::Smooth, 128),
    ]
}

impl Case {
    /// A phantom as a case.
    ///
    /// # Errors
    /// As [`phantom()`].
    pub fn embedded(params: &PhantomParams) -> Result<Self, SynthError> {
        let Phantom { initial, deformed, truth, mask, landmarks, .. } = phantom(params)?;
        let words = |v: &dyn std::fmt::Debug| format!("{v:?}").to_lowercase();
        let name = format!("{} {} seed {}", words(&params.kind), words(&params.motion), params.seed);
        Ok(Self { name, initial, deformed, truth: Some(truth), mask: Some(mask), landmarks })
    }

    /// The trial of a field that some method has measured in `cpu_s` seconds.
    ///
    /// # Errors
    /// [`FieldError`] when the field is on another grid than the truth, or no number where errors
    /// count.
    pub fn score(&self, variant: &Variant, measured: &DenseField, cpu_s: f64) -> Result<Trial, FieldError> {
        let mut trial = self.trial(variant, cpu_s);
        if let Some(truth) = &self.truth {
            let m = evaluate::metrics(measured, truth, self.mask.as_ref(), &[])?;
            (trial.error, trial.error_p95, trial.gradient_error) = (m.mean_mm, Some(m.p95_mm), Some(m.grad_err));
            return Ok(trial);
        }
        let mut errors = evaluate::landmarks(measured, &self.landmarks);
        if errors.iter().any(|e| !e.is_finite()) {
            return Err(FieldError::Volume {
                volume: "measured",
                what: "is NaN or infinite at landmarks".into(),
                hint: "leave these landmarks out".into(),
            });
        }
        (trial.error, trial.error_p95) = (mean(&errors), Some(percentile(&mut errors, 95.0)));
        Ok(trial)
    }

    /// Error before registration (mm): the mean motion where errors count, or the landmarks' mean
    /// distance.
    pub fn nothing(&self) -> f64 {
        let Some(truth) = &self.truth else {
            return mean(&self.landmarks.iter().map(|l| length(l.initial.minus(l.deformed))).collect::<Vec<_>>());
        };
        let inside = |at: &usize| self.mask.as_ref().is_none_or(|m| m.as_slice()[*at] != 0);
        let motion = |at: usize| length(truth.at(at).map(f64::from));
        mean(&(0..truth.grid().len()).filter(inside).map(motion).collect::<Vec<_>>())
    }

    /// A trial without a result yet.
    pub(crate) fn trial(&self, variant: &Variant, cpu_s: f64) -> Trial {
        Trial {
            part: Part::Field,
            varied: variant.varied,
            method: variant.method.clone(),
            settings: variant.settings.clone(),
            case: self.name.clone(),
            error: f64::NAN,
            error_p95: None,
            gradient_error: None,
            nothing: Some(self.nothing()),
            size: self.initial.grid().len(),
            cpu_s,
            whole: false,
            failure: None,
        }
    }

    /// Runs the pipeline with `variant`, without a mask.
    pub fn run(&self, variant: &Variant) -> Trial {
        let work = || field::run(&self.initial, &self.deformed, None, &variant.params, &|_, _| {});
        let (result, cpu_s) = cpu::timed(work);
        let scored = result.and_then(|r| self.score(variant, &r.displacement, cpu_s));
        scored.unwrap_or_else(|e| Trial { failure: Some(e.to_string()), ..self.trial(variant, cpu_s) })
    }
}

/// All [steps](Variant::steps) on heads of the same field of view with `sides` voxels across.
///
/// # Errors
/// As [`phantom()`].
pub fn sizes(sides: &[usize], progress: &dyn Fn(f64)) -> Result<Vec<Trial>, SynthError> {
    let mut out = Vec::new();
    for (i, &side) in sides.iter().enumerate() {
        let case = Case::embedded(&PhantomParams::new(PhantomKind::Head).sized(side))?;
        for mut variant in Variant::steps() {
            variant.varied = "size";
            out.push(case.run(&variant));
        }
        progress((i + 1) as f64 / sides.len() as f64);
    }
    Ok(out)
}

/// Largest difference of the object's angle from `exact` at any sample (degrees); NaN where samples
/// are missing.
pub fn posture_error(run: &GraspRun, exact: &GraspRun) -> f64 {
    if run.samples.len() != exact.samples.len() {
        return f64::NAN;
    }
    let off = run.samples.iter().zip(&exact.samples).map(|(a, b)| a.pose[2] - b.pose[2]);
    off.fold(0.0, |e: f64, v| e.max(v.abs())).to_degrees()
}

/// The scene with the adaptive integrator at a tolerance of 1e-12.
pub fn exact(scene: &Scene) -> Scene {
    let mut scene = scene.clone();
    (scene.integrator.method, scene.integrator.formulation) = (Method::Adaptive, Formulation::Minimal);
    scene.integrator.tolerance = 1e-12;
    scene
}

/// The reference scene's eight motions with every integrator, formulation and a range of steps or
/// tolerances; each run is repeated for at least `least_s` CPU seconds. Errors are of the object's
/// angle, in degrees, against [`exact`].
///
/// # Errors
/// [`GraspError`] when the exact run cannot be made.
pub(crate) fn grasp_trials(least_s: f64, progress: &dyn Fn(f64)) -> Result<Vec<Trial>, GraspError> {
    let truth = simulate(&exact(&Scene::reference()), &|_| {})?;
    let steps = [4e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4];
    let fixed = [Method::Rk4, Method::SemiImplicitEuler]
        .into_iter()
        .flat_map(|m| Formulation::ALL.map(|(_, f)| (m, f)))
        .flat_map(|(m, f)| steps.map(|s| (m, f, s)));
    let adaptive = [1e-4, 1e-6, 1e-8, 1e-10].map(|t| (Method::Adaptive, Formulation::Minimal, t));
    let cases: Vec<_> = fixed.chain(adaptive).collect();
    let mut out = Vec::new();
    for (i, &(method, formulation, fine)) in cases.iter().enumerate() {
        let mut scene = Scene::reference();
        (scene.integrator.method, scene.integrator.formulation) = (method, formulation);
        let what = if method == Method::Adaptive { "tolerance" } else { "step" };
        match method {
            Method::Adaptive => scene.integrator.tolerance = fine,
            _ => scene.integrator.step = fine,
        }
        let (mut result, mut spent) = cpu::timed(|| simulate(&scene, &|_| {}));
        let mut runs = 1.0;
        // A failure is found at once and is not worth timing.
        while spent < least_s && result.as_ref().is_ok_and(|r| r.completed) {
            let more = cpu::timed(|| simulate(&scene, &|_| {}));
            (result, spent, runs) = (more.0, spent + more.1, runs + 1.0);
        }
        let failure = match &result {
            Err(e) => Some(e.to_string()),
            Ok(r) => r.events.iter().find(|e| e.kind.ends_run()).map(|e| format!("{}: {}", e.kind.name(), e.what)),
        };
        let unit = if what == "step" { " s" } else { "" };
        out.push(Trial {
            part: Part::Grasp,
            varied: "step",
            method: format!("{}, {}, {fine:.0e}", method.name(), formulation.name()),
            settings: format!("method {}, formulation {}, {what} {fine:.0e}{unit}", method.name(), formulation.name()),
            case: "eight motions".into(),
            error: result.as_ref().map_or(f64::NAN, |r| posture_error(r, &truth)),
            error_p95: None,
            gradient_error: None,
            nothing: None,
            size: result.as_ref().map_or(0, |r| r.steps as usize),
            cpu_s: spent / runs,
            whole: false,
            failure,
        });
        progress((i + 1) as f64 / cases.len() as f64);
    }
    Ok(out)
}
