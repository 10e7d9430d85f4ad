//! A whole run: steps from border to border of the inputs, samples, and the watch over everything
//! that can fail.

use crate::error::{GraspError, SceneError, below};
use crate::grasp::control::{Phase, Schedule, TIME_TOLERANCE_S};
use crate::grasp::dynamics::{Plant, Reading};
use crate::grasp::equilibrium_branch::{BRANCH_STEP_RAD, Branch, Look};
use crate::grasp::friction::Friction;
use crate::grasp::integrators::{Form, Rk4, SemiImplicitEuler, Stepper, System, dormand_prince};
use crate::grasp::minimal::Minimal;
use crate::grasp::models::{self, Tip};
use crate::grasp::multipliers::Multipliers;
use crate::grasp::relaxing::Relaxing;
use crate::grasp::run_checks::{LASTING_EVENTS, Watch};
use crate::grasp::sliding::{self, Sliding};
use crate::grasp::stability;
use crate::grasp::statics::{Equilibrium, Lost, Statics};
use crate::grasp::stepping::{self, MAX_STABLE_GROWTH};
use crate::grasp::tabulated::Tabulated;
use crate::types::grasp::{ConstraintDrift, Event, EventKind, GraspRun, MotionRow, Sample};
use crate::types::scene::{Formulation, Integrator, Method};
use crate::types::{FingertipModel, Scene};
use std::f64::consts::PI;

/// Called with the fraction of the run that is done (0 to 1).
pub(crate) type Progress<'a> = &'a (dyn Fn(f64) + Sync);

/// Most events that are kept: a tip at the edge may begin to slip in every step.
const MAX_EVENTS: usize = 1000;

/// Simulates a scene from its pinch at rest.
///
/// The run ends early at the first event that [`EventKind::ends_run`]; what came before is given
/// back.
///
/// # Errors
/// [`GraspError`] where nothing can be simulated: a scene out of range, no stable equilibrium at
/// the start, or a step or stabilisation gain that is unstable from the start.
///
/// ```
/// use palpate::Scene;
/// use palpate::grasp::simulate::simulate;
/// let mut scene = Scene::reference();
/// scene.motions.truncate(1);
/// let run = simulate(&scene, &|_| {})?;
/// assert!(run.completed && run.outcome() == "held");
/// assert_eq!(run.motions.len(), 2);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn simulate(scene: &Scene, progress: Progress<'_>) -> Result<GraspRun, GraspError> {
    attempt(scene, progress, true)
}

/// The same; without `advice` a step that is too long is not answered with one that is not.
fn attempt(scene: &Scene, progress: Progress<'_>, advice: bool) -> Result<GraspRun, GraspError> {
    scene.check()?;
    if scene.fingers().iter().any(|f| f.upper.is_some() && !f.fixed) {
        return Err(SceneError::TwoJoints.into());
    }
    let tips = scene.fingertips();
    let stiffness = tips.map(|tip| PI * tip.youngs_modulus);
    match scene.fingertip.model {
        FingertipModel::Parallel => {
            with_tips(scene, stiffness.map(|stiffness| models::Parallel { stiffness }), progress, advice)
        }
        FingertipModel::ParallelNormal => {
            with_tips(scene, stiffness.map(|stiffness| models::ParallelNormal { stiffness }), progress, advice)
        }
        FingertipModel::Radial => {
            with_tips(scene, stiffness.map(|stiffness| models::Radial { stiffness }), progress, advice)
        }
        FingertipModel::Rigid => with_tips(scene, [models::Rigid; 2], progress, advice),
        FingertipModel::Tabulated => with_tips(scene, tips.map(Tabulated::of), progress, advice),
    }
}

fn with_tips<T: Tip + Clone>(
    scene: &Scene,
    tips: [T; 2],
    progress: Progress<'_>,
    advice: bool,
) -> Result<GraspRun, GraspError> {
    let statics = Statics::of(scene, [&tips[0], &tips[1]]);
    let start = start(scene, &statics)?;
    let plant = Plant::of(scene, tips.clone(), &start);
    let Integrator { formulation, baumgarte, rolling, .. } = scene.integrator;
    match formulation {
        Formulation::Minimal if !plant.branches.is_empty() => {
            run(scene, Relaxing(plant), &statics, start, progress, advice)
        }
        Formulation::Minimal => run(scene, Minimal(plant), &statics, start, progress, advice),
        Formulation::Multipliers => {
            run(scene, Multipliers { plant, gain: baumgarte, rolling }, &statics, start, progress, advice)
        }
    }
}

/// The equilibrium that a run starts in: the pinch, followed to the first joint angles.
///
/// # Errors
/// [`GraspError::NoStart`] where the pinch is not stable or not in the model's range, or the branch
/// does not reach so far.
pub fn start(scene: &Scene, statics: &Statics<'_>) -> Result<Equilibrium, GraspError> {
    let start = statics.pinch(scene);
    let depth = scene.initial.normal_displacement * 1e3;
    if let Some(lost) = statics.out_of_range(&start.q) {
        let (what, finger) = match lost {
            Lost::Contact(i) => ("does not touch the object", i + 1),
            Lost::Range(i) => ("is pressed out of the model's range", i + 1),
            Lost::Fold => ("has no equilibrium", 1),
        };
        return Err(GraspError::NoStart {
            what: format!("finger {finger} {what} (d_n {depth:.3} mm)"),
            hint: "change initial.normal_displacement or fingertip.radius".into(),
        });
    }
    if start.smallest_eigenvalue.is_nan() || start.smallest_eigenvalue <= 0.0 {
        return Err(GraspError::NoStart {
            what: format!(
                "the pinch is not stable (smallest eigenvalue of the Hessian {:.3e} N/m)",
                start.smallest_eigenvalue
            ),
            hint: remedies(scene),
        });
    }
    if scene.initial.joints == [0.0; 2] {
        return Ok(start);
    }
    statics.follow(&start, scene.initial.joints, BRANCH_STEP_RAD).map_err(|(lost, last)| GraspError::NoStart {
        what: format!(
            "initial.theta cannot be reached from the pinch: at joint angles {:.2} and {:.2} degrees {}",
            last.q[3].to_degrees(),
            last.q[4].to_degrees(),
            lost.words()
        ),
        hint: "choose other angles in initial.theta".into(),
    })
}

/// Most steps of the trial of an advised step.
const MAX_TRIAL_STEPS: f64 = 3e5;

/// A step (s) that is stable at the start, at the postures of the motions, and, where that is soon
/// tried, all the way.
fn advised(scene: &Scene, start: Equilibrium) -> f64 {
    let Integrator { method, formulation, .. } = scene.integrator;
    let postures = stability::postures(scene, scene.fingertip.model).into_iter();
    let at: Vec<Equilibrium> = std::iter::once(start).chain(postures.filter_map(|p| p.2.ok())).collect();
    // What is found is true to 1 %.
    let mut step = 0.98 * stepping::stable_step(scene, method, formulation, &at);
    let mut trial = scene.clone();
    while scene.duration() / step < MAX_TRIAL_STEPS {
        trial.integrator.step = step;
        trial.integrator.output_every = trial.integrator.output_every.max(step);
        let blames = |run: &GraspRun| run.events.iter().any(|e| e.kind == EventKind::BadStep);
        match attempt(&trial, &|_| {}, false) {
            Ok(run) if blames(&run) => step *= 0.8,
            Err(GraspError::BadStep { .. }) => step *= 0.8,
            _ => break,
        }
    }
    step
}

/// What makes a pinch stable that is not, in words: each found by trying.
fn remedies(scene: &Scene) -> String {
    let tips = |scene: &Scene| models::tips(scene);
    let stable = |scene: &Scene| {
        let tips = tips(scene);
        let statics = Statics::of(scene, [tips[0].as_ref(), tips[1].as_ref()]);
        let pinch = statics.pinch(scene);
        pinch.smallest_eigenvalue > 0.0 && statics.out_of_range(&pinch.q).is_none()
    };
    // From a factor at which it holds, by a tenth more than is needed.
    let least = |with: &dyn Fn(f64) -> Scene| {
        let factor = (1..=80).map(|k| 1.1f64.powi(k)).find(|f| stable(&with(*f)))?;
        Some(1.1 * factor).filter(|f| stable(&with(*f)))
    };
    let depth = scene.initial.normal_displacement;
    let deeper = |factor: f64| {
        let mut scene = scene.clone();
        let more = (factor - 1.0) * depth;
        scene.initial.normal_displacement += more;
        scene.finger.half_span -= more;
        if let Some(second) = &mut scene.second {
            second.finger.half_span -= more;
        }
        scene
    };
    let mut ways = Vec::new();
    if let Some(factor) = least(&|f| scene.with_moduli(f)) {
        ways.push(format!("raise fingertip.youngs_modulus to {:.3e} Pa", factor * scene.fingertip.youngs_modulus));
    }
    if let Some(factor) = least(&deeper) {
        let wanted = factor * depth;
        ways.push(format!("press more: initial.normal_displacement to {wanted:.3e} m, with finger.half_span left out"));
    }
    ways.push("widen object.width, or take a lighter object".into());
    ways.join(", or ")
}

/// What a look at the contacts comes to.
enum Verdict {
    GoesOn,
    Slides,
    Ends,
}

/// A run in progress.
struct Run<'a, const N: usize, S: Form<N>> {
    scene: &'a Scene,
    system: S,
    watch: Watch,
    state: [f64; N],
    /// State of the step before, with its time.
    before: ([f64; N], f64),
    result: GraspRun,
    /// Next trial step of the adaptive method.
    trial: f64,
    /// Places from which d_t was counted at the start (m).
    origin: [f64; 2],
    /// Events that go on, by place in [`LASTING_EVENTS`] and tip, with the origin of d_t when they
    /// began.
    open: [[Option<(usize, f64)>; 2]; 2],
    /// The last that was over of each, with the length of its words before their end was added.
    over: [[Option<(usize, f64, usize)>; 2]; 2],
    /// The fold that goes on.
    fold: Option<usize>,
    /// Whether the tips have slid since the branch was told.
    moved: bool,
    /// The equilibrium of the start, and whether a step that is too long is answered with one that
    /// is not.
    start: Equilibrium,
    advice: bool,
}

impl<const N: usize, S: Form<N>> Run<'_, N, S> {
    /// Contacts of a state.
    fn sample(&self, phase: &Phase, t: f64, state: &[f64; N]) -> (Sample, Reading) {
        let reading = self.system.rate(&phase.inputs(t), state).1;
        let q = std::array::from_fn(|k| state[k]);
        let friction = &self.watch.friction;
        let mut shown = reading;
        if friction.slides {
            // A tip that slides carries what friction holds.
            let along = friction.along(&reading.forces, &reading.displacements);
            for i in 0..2 {
                let (f, limit) = (reading.forces[2 + i], Friction::limit(along, &reading.forces, i));
                shown.forces[2 + i] = if f.abs() > limit { limit.copysign(f) } else { f };
            }
        }
        let mut sample = shown.sample(t, &q);
        let required = friction.required(&shown.forces, &shown.displacements);
        let origin = self.system.plant().geometry.origin;
        sample.slip = [0, 1].map(|i| origin[i] - self.origin[i]);
        (sample.required_friction, sample.friction_margin) = (required, 1.0 - required / friction.coefficient);
        (sample, reading)
    }

    /// Looks at the contacts of the state at `t`.
    #[inline(always)]
    fn look(&mut self, phase: &Phase, t: f64, reading: &Reading, state: &[f64; N]) -> Verdict {
        if self.watch.fine(reading) { Verdict::GoesOn } else { self.look_closely(phase, t, reading, state) }
    }

    #[cold]
    fn look_closely(&mut self, phase: &Phase, t: f64, reading: &Reading, state: &[f64; N]) -> Verdict {
        let found = self.watch.findings(reading);
        for (k, i, what) in found.begins {
            // After less than a sample's time it is the same one that goes on: a tip that creeps to
            // rest sticks and slides with each swing of the object.
            let pause = self.scene.integrator.output_every;
            let last = self.over[k][i].filter(|o| self.result.events[o.0].until.is_some_and(|u| t - u <= pause));
            if let Some((at, origin, words)) = last {
                self.result.events[at].until = None;
                self.result.events[at].what.truncate(words);
                self.open[k][i] = Some((at, origin));
                continue;
            }
            if self.result.events.len() < MAX_EVENTS {
                let origin = self.system.plant().geometry.origin[i];
                self.open[k][i] = Some((self.result.events.len(), origin));
                let last_valid = self.sample(phase, t, state).0;
                self.push(Event {
                    kind: LASTING_EVENTS[k],
                    time: t,
                    until: None,
                    finger: Some(i + 1),
                    what,
                    last_valid,
                });
            }
        }
        for (k, i) in found.over {
            self.close(k, i, Some(t));
        }
        if let Some((kind, i, what)) = found.fatal {
            let kind = self.cause(phase, &self.before.0).unwrap_or(kind);
            self.end(phase, kind, t, Some(i + 1), what);
            return Verdict::Ends;
        }
        if self.watch.slipping() && self.watch.friction.slides { Verdict::Slides } else { Verdict::GoesOn }
    }

    fn push(&mut self, event: Event) {
        self.result.events.push(event);
    }

    /// An event of [`LASTING_EVENTS`] is over at `until`, or its run.
    fn close(&mut self, k: usize, i: usize, until: Option<f64>) {
        let Some((at, origin)) = self.open[k][i].take() else { return };
        let event = &mut self.result.events[at];
        event.until = until;
        self.over[k][i] = Some((at, origin, event.what.len()));
        if event.kind == EventKind::Slip {
            event.what += &if self.watch.friction.slides {
                format!("; slides by {:.3} mm", 1e3 * (self.system.plant().geometry.origin[i] - origin).abs())
            } else {
                "; these tips have no law for sliding, and go on as if they held".into()
            };
        }
    }

    /// A step of the state of a grasp whose tips may slide, by `step`.
    fn slide(
        &mut self,
        state: &[f64; N],
        step: impl FnOnce(&Sliding<'_, S::Tip>, &[f64; sliding::STATE]) -> Option<[f64; sliding::STATE]>,
    ) -> Option<[f64; N]> {
        let plant = self.system.plant();
        let system = Sliding { plant, friction: &self.watch.friction, step: self.scene.integrator.step };
        let next = step(&system, &sliding::joined(&self.system.core(state), plant.geometry.origin))?;
        let (core, origin) = sliding::parted(&next);
        self.system.set_origin(origin);
        self.moved = true;
        Some(self.system.with_core(&core))
    }

    /// Records what ends the run at `t`, with the state of the step before.
    fn end(&mut self, phase: &Phase, kind: EventKind, t: f64, finger: Option<usize>, mut what: String) {
        if kind == EventKind::BadStep && self.advice && self.scene.integrator.method != Method::Adaptive {
            let stable = below(advised(self.scene, self.start));
            what += &format!("; take integrator.step at or under {stable} s");
        }
        let (before, time) = self.before;
        let (last_valid, _) = self.sample(phase, time, &before);
        self.push(Event { kind, time: t, until: None, finger, what, last_valid });
    }

    /// Whether the step or the gain is to blame at `state`.
    fn cause(&self, phase: &Phase, state: &[f64; N]) -> Option<EventKind> {
        let Integrator { method, step, .. } = self.scene.integrator;
        let growth = stepping::growth_of(method, &self.system, phase, step, state);
        if growth <= MAX_STABLE_GROWTH {
            return None;
        }
        let here = Equilibrium { q: std::array::from_fn(|k| state[k]), ..Equilibrium::default() };
        let tips = models::tips(self.scene);
        let tips = [tips[0].as_ref(), tips[1].as_ref()];
        let minimal = stepping::growth_at(self.scene, tips, method, Formulation::Minimal, [step, 0.0], &here);
        let gain = self.scene.integrator.formulation == Formulation::Multipliers && minimal <= MAX_STABLE_GROWTH;
        Some(if gain { EventKind::BadGain } else { EventKind::BadStep })
    }

    /// Steps of a fixed length from `t0` to `t1`; true where the run goes on.
    fn fixed<P: Stepper>(&mut self, phase: &Phase, t0: f64, t1: f64) -> bool {
        let count = ((t1 - t0) / self.scene.integrator.step - 1e-9).ceil().max(1.0);
        let h = (t1 - t0) / count;
        let mut state = self.state;
        for k in 0..count as u64 {
            let t = t0 + k as f64 * h;
            let (mut next, reading) = P::step(&self.system, phase, t, h, &state);
            match self.look(phase, t, &reading, &state) {
                Verdict::GoesOn => {}
                Verdict::Ends => return false,
                Verdict::Slides => {
                    let slid = self.slide(&state, |system, s| Some(P::step(system, phase, t, h, s).0));
                    next = slid.unwrap_or(next);
                }
            }
            self.before = (state, t);
            state = next;
        }
        self.state = state;
        self.result.steps += count as u64;
        true
    }

    /// Steps under error control from `t0` to `t1`; true where the run goes on.
    fn adaptive(&mut self, phase: &Phase, t0: f64, t1: f64) -> bool {
        let tolerance = self.scene.integrator.tolerance;
        let mut t = t0;
        while t < t1 {
            let last = t1 - t <= self.trial * 1.000_001;
            let trial = if last { t1 - t } else { self.trial };
            let state = self.state;
            let (first, reading) = self.system.rate(&phase.inputs(t), &state);
            let found = match self.look(phase, t, &reading, &state) {
                Verdict::Ends => return false,
                Verdict::GoesOn => dormand_prince(&self.system, phase, t, trial, tolerance, &state, first),
                Verdict::Slides => {
                    let mut times = (0.0, 0.0);
                    let slid = self.slide(&state, |system, s| {
                        let first = system.rate(&phase.inputs(t), s).0;
                        let (next, taken, proposed) = dormand_prince(system, phase, t, trial, tolerance, s, first)?;
                        times = (taken, proposed);
                        Some(next)
                    });
                    slid.map(|next| (next, times.0, times.1))
                }
            };
            let Some((next, taken, proposed)) = found else {
                let what = "no step meets integrator.tolerance; loosen it".into();
                self.end(phase, EventKind::BadStep, t, None, what);
                return false;
            };
            self.before = (state, t);
            // The last step of an interval is cut short; it says little about the next one.
            self.trial = if last && taken == trial { self.trial.max(proposed) } else { proposed };
            t = if last && taken == trial { t1 } else { t + taken };
            self.state = next;
            self.result.steps += 1;
        }
        true
    }

    /// One interval between borders or samples; true where the run goes on.
    fn interval(&mut self, phase: &Phase, t0: f64, t1: f64) -> bool {
        match self.scene.integrator.method {
            Method::Rk4 => self.fixed::<Rk4>(phase, t0, t1),
            Method::SemiImplicitEuler => self.fixed::<SemiImplicitEuler>(phase, t0, t1),
            Method::Adaptive => self.adaptive(phase, t0, t1),
        }
    }

    /// Looks whether the state at `t` is on the branch of equilibria.
    fn look_at_branch(&mut self, branch: &mut Branch<'_>, phase: &Phase, t: f64, reading: &Reading, thorough: bool) {
        if self.watch.slipping() {
            return;
        }
        let now = self.state;
        let [q, v]: [[f64; 5]; 2] = [0, 5].map(|from| std::array::from_fn(|k| now[from + k]));
        if std::mem::take(&mut self.moved) {
            branch.slid(self.system.plant().geometry.origin, &q, &reading.forces);
        }
        let look = branch.look(&q, &v, &reading.forces, thorough);
        if let Some(at) = self.fold.filter(|_| !matches!(look, Look::Fold(_))) {
            self.result.events[at].until = Some(t);
            self.fold = None;
        }
        let (what, until) = match look {
            Look::Fold(what) if self.fold.is_none() => (what, None),
            Look::Elsewhere(what) => (what, Some(t)),
            _ => return,
        };
        if self.result.events.len() < MAX_EVENTS {
            let last_valid = self.sample(phase, t, &now).0;
            self.fold = until.is_none().then_some(self.result.events.len());
            self.push(Event { kind: EventKind::Fold, time: t, until, finger: None, what, last_valid });
        }
    }

    /// From the start to the end, or to the first event that ends the run.
    fn through(mut self, mut branch: Branch<'_>, progress: Progress<'_>) -> GraspRun {
        let scene = self.scene;
        let output_every = scene.integrator.output_every;
        let schedule = Schedule::of(scene);
        let start_energy = self.system.energy(&self.state).0;
        let mut largest_energy = 0.0f64;
        let mut ends = schedule.ends.iter().peekable();
        let mut next_output = 1.0;
        for pair in schedule.times.windows(2) {
            let [t0, t1] = [pair[0], pair[1]];
            let phase = Phase::at(scene, 0.5 * (t0 + t1));
            if !self.interval(&phase, t0, t1) {
                break;
            }
            let now = self.state;
            let (sample, reading) = self.sample(&phase, t1, &now);
            let off = !self.watch.on_faces(&reading);
            let verdict =
                if off { self.look_closely(&phase, t1, &reading, &now) } else { self.look(&phase, t1, &reading, &now) };
            if matches!(verdict, Verdict::Ends) {
                break;
            }
            let (energy, moving) = self.system.energy(&now);
            largest_energy = largest_energy.max(moving);
            self.result.energy_drift = self.result.energy_drift.max((energy - start_energy - now[S::WORK]).abs());
            self.result.constraint_drift = self.result.constraint_drift.worse(self.system.drift(&now));
            self.result.required_friction = self.result.required_friction.max(sample.required_friction);

            let end = ends.next_if(|end| t1 >= end.0 - TIME_TOLERANCE_S);
            self.look_at_branch(&mut branch, &phase, t1, &reading, end.is_some());
            if let Some(&(_, step, target)) = end {
                self.result.motions.push(MotionRow { step, target, reached: sample });
                if let Some(kind) = self.cause(&phase, &now) {
                    let what = format!("a step of {} s is no longer stable here", scene.integrator.step);
                    self.end(&phase, kind, t1, None, what);
                    break;
                }
            }
            if t1 >= next_output * output_every - TIME_TOLERANCE_S || t1 >= schedule.duration - TIME_TOLERANCE_S {
                self.result.samples.push(sample);
                next_output += 1.0;
                progress(t1 / schedule.duration);
            }
        }
        if largest_energy > 0.0 {
            self.result.energy_drift /= largest_energy;
        }
        for (k, i) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
            self.close(k, i, None);
        }
        self.result.completed = !self.result.events.iter().any(|e| e.kind.ends_run());
        self.result
    }
}

fn run<const N: usize, S: Form<N>>(
    scene: &Scene,
    system: S,
    statics: &Statics<'_>,
    start: Equilibrium,
    progress: Progress<'_>,
    advice: bool,
) -> Result<GraspRun, GraspError> {
    let Integrator { method, step, formulation, baumgarte, .. } = scene.integrator;
    let state = system.start(&start);
    let at_rest = Phase::hold(scene.initial.joints);
    let step_growth = stepping::growth_of(method, &system, &at_rest, step, &state);
    let result = GraspRun {
        samples: Vec::new(),
        motions: Vec::new(),
        events: Vec::new(),
        energy_drift: 0.0,
        constraint_drift: ConstraintDrift::default(),
        step_growth,
        steps: 0,
        required_friction: 0.0,
        completed: false,
    };
    let mut run = Run {
        scene,
        origin: system.plant().geometry.origin,
        system,
        watch: Watch::new(scene),
        state,
        before: (state, 0.0),
        result,
        trial: step,
        open: [[None; 2]; 2],
        over: [[None; 2]; 2],
        fold: None,
        moved: false,
        start,
        advice,
    };
    if step_growth > MAX_STABLE_GROWTH {
        let gain_to_blame = run.cause(&at_rest, &state) == Some(EventKind::BadGain);
        return Err(if gain_to_blame {
            let stable = stepping::stable_gain(scene, &start);
            GraspError::BadGain { gain: baumgarte, step, growth: step_growth, stable }
        } else {
            let method_name = format!("{}, {}", method.name(), formulation.name());
            GraspError::BadStep {
                step,
                growth: step_growth,
                method: method_name,
                stable: if advice { advised(scene, start) } else { 0.0 },
            }
        });
    }

    let (first, reading) = run.sample(&at_rest, 0.0, &state);
    run.result.samples.push(first);
    run.result.required_friction = first.required_friction;
    if matches!(run.look(&at_rest, 0.0, &reading, &state), Verdict::Ends) {
        let what = run.result.events.pop().map_or(String::new(), |e| format!("{}: {}", e.kind.name(), e.what));
        return Err(GraspError::NoStart { what, hint: "change the scene's start".into() });
    }
    Ok(run.through(Branch::new(*statics, &start), progress))
}
