//! A scene to a run, an ensemble of runs, or an analysis.

use crate::error::GraspError;
use crate::grasp::models;
use crate::grasp::simulate::{self, simulate};
use crate::grasp::statics::Statics;
use crate::grasp::{degrees_of_freedom, measured, pinch, posture, stability, stepping};
use crate::types::grasp::{Bands, GraspAnalysis, GraspRun, MotionRow, Sample, StableStep};
use crate::types::measured::{MeasuredFit, Measurements};
use crate::types::scene::{Push, SweepCase};
use crate::types::{FingertipModel, Scene};
use rayon::prelude::*;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

/// Called with a stage's name and the fraction of the whole that is done (0 to 1); may be called
/// from any thread.
pub(crate) type Progress<'a> = &'a (dyn Fn(&str, f64) + Sync);

/// The map of pinch equilibria.
struct PinchMap {
    /// Largest joint angle (degrees).
    max_degrees: f64,
    /// Joint angles along each side.
    angles: usize,
}

const PINCH_MAP: PinchMap = PinchMap { max_degrees: 30.0, angles: 61 };

/// A run with what it is shown beside.
#[derive(Debug, Clone, PartialEq)]
pub struct GraspOutcome {
    /// The run.
    pub run: GraspRun,
    /// The same scene without tangential deformation, where the scene's tips have it.
    pub without_tangential: Option<Result<GraspRun, GraspError>>,
    /// Largest stable steps at the start and at each motion's target.
    pub stable_steps: Vec<StableStep>,
    /// What the run may be, where the tips' moduli have a deviation or bounds.
    pub bands: Option<Bands>,
    /// Stage names and wall seconds.
    pub seconds: Vec<(String, f64)>,
}

/// Runs `scene`, the same without tangential deformation, and finds the stable steps.
///
/// # Errors
/// [`GraspError`] where nothing can be simulated; see [`simulate()`].
///
/// ```
/// use palpate::{Scene, pipeline};
/// let mut scene = Scene::reference();
/// scene.motions.truncate(1);
/// let found = pipeline::grasp::run(&scene, &|_, _| {})?;
/// assert_eq!(found.run.outcome(), "held");
/// // The same scene without tangential deformation stands beside it.
/// assert!(found.without_tangential.is_some());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn run(scene: &Scene, progress: Progress<'_>) -> Result<GraspOutcome, GraspError> {
    let started = Instant::now();
    let run = simulate(scene, &|f| progress("simulate", 0.7 * f))?;
    let mut seconds = vec![("simulate".into(), started.elapsed().as_secs_f64())];
    let started = Instant::now();
    progress("compare", 0.7);
    let without_tangential = (scene.fingertip.model == FingertipModel::Parallel)
        .then(|| simulate(&scene.with_model(FingertipModel::ParallelNormal), &|_| {}));
    seconds.push(("compare".into(), started.elapsed().as_secs_f64()));
    let started = Instant::now();
    progress("bands", 0.8);
    let bands = bands(scene, &run)?;
    if bands.is_some() {
        seconds.push(("bands".into(), started.elapsed().as_secs_f64()));
    }
    let started = Instant::now();
    progress("stable steps", 0.9);
    let stable_steps = stable_steps(scene);
    seconds.push(("stable steps".into(), started.elapsed().as_secs_f64()));
    Ok(GraspOutcome { run, without_tangential, stable_steps, bands, seconds })
}

/// The run with moduli a deviation up and down, and at their bounds: the least and the largest of
/// each quantity. None where neither is known.
///
/// # Errors
/// [`GraspError`] where the scene has no start with one of these moduli.
fn bands(scene: &Scene, run: &GraspRun) -> Result<Option<Bands>, GraspError> {
    let tip = &scene.fingertip;
    let mut factors = Vec::new();
    if tip.deviation > 0.0 {
        factors.extend([(-tip.deviation).exp(), tip.deviation.exp()]);
    }
    factors.extend(tip.bounds.into_iter().flatten().filter(|f| *f != 1.0));
    if factors.is_empty() {
        return Ok(None);
    }
    let runs: Vec<GraspRun> =
        factors.par_iter().map(|f| simulate(&scene.with_moduli(*f), &|_| {})).collect::<Result<_, _>>()?;
    let among = |pick: fn(f64, f64) -> f64| -> Vec<Sample> {
        let at = |k: usize, s: &Sample| {
            let others = runs.iter().filter_map(|r| r.samples.get(k)).filter(|o| (o.time - s.time).abs() < 1e-9);
            others.fold(*s, |all, o| all.each(o, pick))
        };
        run.samples.iter().enumerate().map(|(k, s)| at(k, s)).collect()
    };
    let outcomes = runs.iter().map(GraspRun::outcome).collect();
    Ok(Some(Bands { low: among(f64::min), high: among(f64::max), factors, outcomes }))
}

/// Largest distance of a joint from its target at the end of a hold (rad): half a degree.
pub(crate) const JOINT_TOLERANCE_RAD: f64 = 0.5 * std::f64::consts::PI / 180.0;

/// Deepest press of a tabulated tip over the end of its profile.
const MAX_PROFILE_EXTRAPOLATION: f64 = 1.02;

/// What a user should know of a run beside its events: joints that do not come to where they are
/// told to, and tips that are pressed in further than their profile was measured.
pub fn notes(scene: &Scene, run: &GraspRun) -> Vec<String> {
    let mut out = Vec::new();
    let off = |row: &MotionRow, i: usize| (row.reached.joints[i] - row.target[i]).abs();
    let all =
        run.motions.iter().flat_map(|row| [(row, 0), (row, 1)]).filter(|&(row, i)| off(row, i) > JOINT_TOLERANCE_RAD);
    if let Some((row, i)) = all.reduce(|a, b| if off(b.0, b.1) > off(a.0, a.1) { b } else { a }) {
        let [reached, target] = [row.reached.joints[i], row.target[i]].map(f64::to_degrees);
        let when = if row.step == 0 { "the rest".into() } else { format!("the hold of motion {}", row.step) };
        out.push(format!(
            "at the end of {when} joint {} is at {reached:.2} degrees and was told to be at {target:.2}: finger.gains are too weak for the load, or \
             the hold is too short (motions.csv has what was ordered)",
            i + 1
        ));
    }
    let tip = &scene.fingertip;
    if !tip.profile.is_empty() && tip.model != FingertipModel::Tabulated {
        out.push(format!(
            "fingertip.profile_depth and profile_modulus are of tabulated tips; this one is {}, of one modulus ({} Pa): give model = \"tabulated\" to \
             have them used, or leave them out",
            tip.model.name(),
            tip.youngs_modulus
        ));
    }
    let deepest = run.samples.iter().flat_map(|s| s.normal).fold(0.0, f64::max);
    if let Some([end, _]) = tip
        .profile
        .last()
        .filter(|p| tip.model == FingertipModel::Tabulated && deepest > MAX_PROFILE_EXTRAPOLATION * p[0])
    {
        out.push(format!(
            "a tip is pressed in by {:.2} mm, and fingertip.profile_depth ends at {:.2} mm: further in its last modulus is taken, which nothing was \
             measured for",
            1e3 * deepest,
            1e3 * end
        ));
    }
    out
}

/// Runs all cases of an ensemble in parallel; results are in the order of the cases.
pub fn ensemble(cases: &[SweepCase], progress: Progress<'_>) -> Vec<Result<GraspRun, GraspError>> {
    let done = AtomicUsize::new(0);
    let one = |case: &SweepCase| {
        let result = simulate(&case.scene, &|_| {}).map(|mut run| {
            // An ensemble keeps what was reached, not each trajectory.
            run.samples = run.samples.last().copied().into_iter().collect();
            run
        });
        let n = done.fetch_add(1, Ordering::Relaxed) + 1;
        progress("sweep", n as f64 / cases.len() as f64);
        result
    };
    cases.par_iter().map(one).collect()
}

/// Analyses the grasp of `scene`; `push` is the push on the object with both joints fixed at the
/// first motion's target.
///
/// # Errors
/// [`GraspError`] where the pinch or the posture for the push is no stable equilibrium.
pub(crate) fn analyse(
    scene: &Scene,
    progress: Progress<'_>,
) -> Result<(GraspAnalysis, Vec<(String, f64)>), GraspError> {
    scene.check()?;
    let mut clock = (Vec::new(), Instant::now());
    let mut book = |stage: &str, fraction: f64| {
        clock.0.push((stage.to_string(), clock.1.elapsed().as_secs_f64()));
        clock.1 = Instant::now();
        progress(stage, fraction);
    };
    let soft = scene.with_model(FingertipModel::Parallel);
    let tips = models::tips(&soft);
    simulate::start(&soft, &Statics::of(&soft, [tips[0].as_ref(), tips[1].as_ref()]))?;
    let force = posture::force(&soft.fingertip);
    let (mut stability, mut surfaces, mut lost) = (Vec::new(), Vec::new(), Vec::new());
    for (step, _, found) in stability::postures(&soft, FingertipModel::Parallel) {
        match found {
            Ok(at) => {
                stability.extend(stability::rows(&soft, step, &at));
                surfaces.extend(stability::surfaces(&soft, step, &at));
            }
            Err(reason) => lost.push((step, reason)),
        }
    }
    book("stability", 0.2);
    let freedom = degrees_of_freedom::table(&soft);
    book("freedom", 0.25);
    let push = simulate(&pushed(&soft), &|_| {})?;
    book("push", 0.3);
    let map = |f: f64| progress("pinch map", 0.3 + 0.6 * f);
    let pinch = pinch::map(&soft, FingertipModel::Parallel, PINCH_MAP.max_degrees.to_radians(), PINCH_MAP.angles, &map);
    book("pinch map", 0.9);
    let stable_steps = stable_steps(&soft);
    book("stable steps", 1.0);
    Ok((GraspAnalysis { force, surfaces, stability, lost, freedom, pinch, push, stable_steps }, clock.0))
}

/// The tip models fitted to measurements on the scene's tip or of its motions.
pub fn against(scene: &Scene, measured: &Measurements) -> MeasuredFit {
    measured::fit(scene, measured)
}

/// The scene's pushes, or one of 10 N below the object's centre, with both joints fixed at the
/// first motion's target.
pub fn pushed(scene: &Scene) -> Scene {
    let mut scene = scene.clone();
    scene.finger.fixed = true;
    if let Some(second) = &mut scene.second {
        second.finger.fixed = true;
    }
    scene.initial.joints = scene.motions.first().map_or(scene.initial.joints, |m| m.target);
    scene.motions.clear();
    if scene.pushes.is_empty() {
        let at = [0.0, -0.5 * scene.object.height];
        scene.pushes = vec![Push { start: 0.1, duration: 0.2, force: [10.0, 0.0], at }];
    }
    // Long enough to see it come back.
    scene.initial.rest = scene.pushes.iter().map(|p| p.start + p.duration).fold(0.0, f64::max) + 0.3;
    scene.integrator.output_every = scene.integrator.step.max(0.002);
    scene
}

/// Largest stable steps at the start and at each motion's target that can be reached.
fn stable_steps(scene: &Scene) -> Vec<StableStep> {
    let postures = stability::postures(scene, scene.fingertip.model).into_iter();
    let at: Vec<_> = postures.filter_map(|(_, _, found)| found.ok()).collect();
    stepping::stable_steps(scene, &at)
}
