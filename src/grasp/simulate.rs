//! A whole run: steps from border to border of the inputs, samples, and the watch over everything that can fail.

use crate::error::GraspError;
use crate::grasp::control::{Phase, borders};
use crate::grasp::integrators::{Rk4, SemiImplicitEuler, Stepper, System, dormand_prince};
use crate::grasp::minimal::Minimal;
use crate::grasp::models::{self, Tip};
use crate::grasp::multipliers::Multipliers;
use crate::grasp::plant::{Plant, Reading};
use crate::grasp::statics::{Equilibrium, Lost, Statics};
use crate::grasp::stepping::{self, LIMIT};
use crate::types::grasp::{ConstraintDrift, Event, EventKind, GraspRun, MotionRow, Sample};
use crate::types::scene::{Formulation, Integrator, Method};
use crate::types::{FingertipModel, Scene};
use std::f64::consts::PI;

/// Called with the fraction of the run that is done (0 to 1).
pub type Progress<'a> = &'a (dyn Fn(f64) + Sync);

/// Stride along the branch of equilibria when it is checked (rad).
const STRIDE: f64 = 0.05;
/// Slower than this the object rests (m/s, and rad/s times the tip's radius).
const REST: f64 = 1e-4;
/// A resting object further than this from the followed branch has left it (m).
const APART: f64 = 1e-4;

/// Simulates a scene from its pinch at rest.
///
/// The run ends early at the first event that [`EventKind::ends_run`]; what came before is given back.
///
/// # Errors
/// [`GraspError`] where nothing can be simulated: a scene out of range, no stable equilibrium at the start, or a step or
/// stabilisation gain that is unstable from the start.
pub fn simulate(scene: &Scene, progress: Progress<'_>) -> Result<GraspRun, GraspError> {
    scene.check()?;
    let stiffness = PI * scene.fingertip.youngs_modulus;
    match scene.fingertip.model {
        FingertipModel::Parallel => with_tip(scene, models::Parallel { stiffness }, progress),
        FingertipModel::ParallelNormal => with_tip(scene, models::ParallelNormal { stiffness }, progress),
        FingertipModel::Radial => with_tip(scene, models::Radial { stiffness }, progress),
        FingertipModel::Rigid => with_tip(scene, models::Rigid, progress),
    }
}

fn with_tip<T: Tip + Clone>(scene: &Scene, tip: T, progress: Progress<'_>) -> Result<GraspRun, GraspError> {
    let statics = Statics::new(scene, &tip);
    let start = start(scene, &statics)?;
    let plant = Plant::new(scene, tip.clone(), &start);
    let Integrator { formulation, baumgarte, rolling, .. } = scene.integrator;
    match formulation {
        Formulation::Minimal => run(scene, &Minimal(plant), &statics, start, progress),
        Formulation::Multipliers => {
            run(scene, &Multipliers { plant, gain: baumgarte, rolling }, &statics, start, progress)
        }
    }
}

/// The equilibrium that a run starts in: the pinch, followed to the first joint angles.
///
/// # Errors
/// [`GraspError::NoStart`] where the pinch is not stable or not in the model's range, or the branch does not reach so far.
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
            hint: "widen object.width, stiffen fingertip.youngs_modulus or press more (initial.normal_displacement)"
                .into(),
        });
    }
    if scene.initial.joints == [0.0; 2] {
        return Ok(start);
    }
    statics.follow(&start, scene.initial.joints, STRIDE).map_err(|(lost, last)| GraspError::NoStart {
        what: format!(
            "initial.theta cannot be reached from the pinch: at joint angles {:.2} and {:.2} degrees {}",
            last.q[3].to_degrees(),
            last.q[4].to_degrees(),
            lost.words()
        ),
        hint: "choose other angles in initial.theta".into(),
    })
}

/// What is looked at in every step.
struct Watch {
    radius: f64,
    friction: f64,
    rigid: bool,
    slipping: [bool; 2],
}

impl Watch {
    /// Whether all is as the model assumes, in one glance.
    #[inline(always)]
    fn fine(&self, r: &Reading) -> bool {
        let one = |i: usize| {
            let (d, f_n, f_t) = (r.displacements[i], r.forces[i], r.forces[2 + i]);
            let touching = if self.rigid { f_n > 0.0 } else { models::in_range(self.radius, d, r.sin_tilt[i]) };
            touching && f_t.abs() <= self.friction * f_n && !self.slipping[i]
        };
        one(0) && one(1)
    }

    /// What is wrong: an event that ends the run, and tips that begin to slip.
    fn flaw(&mut self, r: &Reading) -> (Option<(EventKind, usize, String)>, Vec<(usize, String)>) {
        let mut slips = Vec::new();
        for i in 0..2 {
            let (d, f_n, f_t) = (r.displacements[i], r.forces[i], r.forces[2 + i]);
            if !(d.is_finite() && f_n.is_finite() && f_t.is_finite()) {
                return (Some((EventKind::BadStep, i, "the state is no longer finite".into())), slips);
            }
            if self.rigid && f_n <= 0.0 {
                return (Some((EventKind::ContactLoss, i, format!("f_n is {f_n:.3} N"))), slips);
            }
            if !self.rigid && d <= 0.0 {
                return (Some((EventKind::ContactLoss, i, format!("d_n is {:.3} mm", 1e3 * d))), slips);
            }
            let most = self.radius * (1.0 - r.sin_tilt[i].abs());
            if !self.rigid && d >= most {
                let what = format!("d_n is {:.3} mm, the model holds under {:.3} mm", 1e3 * d, 1e3 * most);
                return (Some((EventKind::ValidityRange, i, what)), slips);
            }
            let slips_now = f_t.abs() > self.friction * f_n;
            if slips_now && !self.slipping[i] {
                slips.push((i, format!("|f_t| is {:.3} N and f_n {f_n:.3} N, friction {}", f_t.abs(), self.friction)));
            }
            self.slipping[i] = slips_now;
        }
        (None, slips)
    }
}

/// A run in progress.
struct Run<'a, const N: usize, S: System<N>> {
    scene: &'a Scene,
    system: &'a S,
    watch: Watch,
    state: [f64; N],
    /// State of the step before, with its time.
    before: ([f64; N], f64),
    result: GraspRun,
    /// Next trial step of the adaptive method.
    trial: f64,
}

impl<const N: usize, S: System<N>> Run<'_, N, S> {
    /// Contacts of a state.
    fn sample(&self, phase: &Phase, t: f64, state: &[f64; N]) -> (Sample, Reading) {
        let reading = self.system.rate(&phase.inputs(t), state).1;
        let q = std::array::from_fn(|k| state[k]);
        (reading.sample(t, &q), reading)
    }

    /// Looks at the contacts of the state at `t`; true where the run goes on.
    #[inline(always)]
    fn goes_on(&mut self, phase: &Phase, t: f64, reading: &Reading, state: &[f64; N]) -> bool {
        self.watch.fine(reading) || self.record_flaw(phase, t, reading, state)
    }

    #[cold]
    fn record_flaw(&mut self, phase: &Phase, t: f64, reading: &Reading, state: &[f64; N]) -> bool {
        let (fatal, slips) = self.watch.flaw(reading);
        for (i, what) in slips {
            let q = std::array::from_fn(|k| state[k]);
            let last_valid = reading.sample(t, &q);
            let event = Event { kind: EventKind::Slip, time: t, finger: Some(i + 1), what, last_valid };
            self.result.events.push(event);
        }
        let Some((kind, finger, what)) = fatal else { return true };
        let (before, time) = self.before;
        let (last_valid, _) = self.sample(phase, time, &before);
        let kind = self.cause(phase, &before).unwrap_or(kind);
        self.result.events.push(Event { kind, time: t, finger: Some(finger + 1), what, last_valid });
        false
    }

    /// Whether the step or the gain is to blame at `state`.
    fn cause(&self, phase: &Phase, state: &[f64; N]) -> Option<EventKind> {
        let Integrator { method, step, .. } = self.scene.integrator;
        let growth = stepping::growth_of(method, self.system, phase, step, state);
        if growth <= LIMIT {
            return None;
        }
        let here = Equilibrium { q: std::array::from_fn(|k| state[k]), ..Equilibrium::default() };
        let minimal = stepping::growth_at(self.scene, method, Formulation::Minimal, step, 0.0, &here);
        let gain = self.scene.integrator.formulation == Formulation::Multipliers && minimal <= LIMIT;
        Some(if gain { EventKind::BadGain } else { EventKind::BadStep })
    }

    /// Steps of a fixed length from `t0` to `t1`; true where the run goes on.
    fn fixed<P: Stepper>(&mut self, phase: &Phase, t0: f64, t1: f64) -> bool {
        let count = ((t1 - t0) / self.scene.integrator.step - 1e-9).ceil().max(1.0);
        let h = (t1 - t0) / count;
        let mut state = self.state;
        for k in 0..count as u64 {
            let t = t0 + k as f64 * h;
            let (next, reading) = P::step(self.system, phase, t, h, &state);
            if !self.goes_on(phase, t, &reading, &state) {
                return false;
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
            let Some((next, reading, taken, proposed)) =
                dormand_prince(self.system, phase, t, trial, tolerance, &state)
            else {
                let (last_valid, _) = self.sample(phase, t, &state);
                let what = "no step meets integrator.tolerance; loosen it".into();
                self.result.events.push(Event { kind: EventKind::BadStep, time: t, finger: None, what, last_valid });
                return false;
            };
            if !self.goes_on(phase, t, &reading, &state) {
                return false;
            }
            self.before = (state, t);
            // The last step of an interval is cut short; it says little about the next one.
            self.trial = if last && taken == trial { self.trial.max(proposed) } else { proposed };
            t = if last && taken == trial { t1 } else { t + taken };
            self.state = next;
            self.result.steps += 1;
        }
        true
    }
}

fn run<const N: usize, S: System<N>>(
    scene: &Scene,
    system: &S,
    statics: &Statics<'_>,
    start: Equilibrium,
    progress: Progress<'_>,
) -> Result<GraspRun, GraspError> {
    let Integrator { method, step, output_every, formulation, baumgarte, .. } = scene.integrator;
    let state = system.start(&start);
    let at_rest = Phase::hold(scene.initial.joints);
    let step_growth = stepping::growth_of(method, system, &at_rest, step, &state);
    let watch = Watch {
        radius: scene.fingertip.radius,
        friction: scene.object.friction.unwrap_or(f64::INFINITY),
        rigid: scene.fingertip.model == FingertipModel::Rigid,
        slipping: [false; 2],
    };
    let result = GraspRun {
        samples: Vec::new(),
        motions: Vec::new(),
        events: Vec::new(),
        energy_drift: 0.0,
        constraint_drift: ConstraintDrift::default(),
        step_growth,
        steps: 0,
        completed: false,
    };
    let mut run = Run { scene, system, watch, state, before: (state, 0.0), result, trial: step };
    if step_growth > LIMIT {
        let gain_to_blame = run.cause(&at_rest, &state) == Some(EventKind::BadGain);
        return Err(if gain_to_blame {
            let stable = stepping::stable_gain(scene, &start);
            GraspError::BadGain { gain: baumgarte, step, growth: step_growth, stable }
        } else {
            let method_name = format!("{}, {}", method.name(), formulation.name());
            let stable = stepping::stable_step(scene, method, formulation, &[start]);
            GraspError::BadStep { step, growth: step_growth, method: method_name, stable }
        });
    }

    let duration = scene.duration();
    let mut ends = vec![(scene.initial.rest, 0, scene.initial.joints)];
    for (i, motion) in scene.motions.iter().enumerate() {
        let last = ends[i].0;
        ends.push((last + motion.duration + motion.hold, i + 1, motion.target));
    }
    let mut times = borders(scene);
    let outputs = (duration / output_every + 1e-9).floor() as usize;
    times.extend((1..=outputs).map(|k| k as f64 * output_every));
    times.sort_by(f64::total_cmp);
    times.dedup_by(|a, b| *a - *b < 1e-9);

    let e0 = system.energy(&state).0;
    let mut largest_energy = 0.0f64;
    let mut branch = start;
    let first_eigenvalue = start.smallest_eigenvalue;
    let (first, reading) = run.sample(&at_rest, 0.0, &state);
    run.result.samples.push(first);
    if !run.goes_on(&at_rest, 0.0, &reading, &state) {
        let what = run.result.events.pop().map_or(String::new(), |e| format!("{}: {}", e.kind.name(), e.what));
        return Err(GraspError::NoStart { what, hint: "change the scene's start".into() });
    }
    let mut next_end = 0;
    let mut next_output = 1;
    if ends[0].0 == 0.0 {
        next_end = 1;
    }
    for pair in times.windows(2) {
        let [t0, t1] = [pair[0], pair[1]];
        let phase = Phase::at(scene, 0.5 * (t0 + t1));
        let on = match method {
            Method::Rk4 => run.fixed::<Rk4>(&phase, t0, t1),
            Method::SemiImplicitEuler => run.fixed::<SemiImplicitEuler>(&phase, t0, t1),
            Method::Adaptive => run.adaptive(&phase, t0, t1),
        };
        if !on {
            break;
        }
        let now = run.state;
        let (sample, reading) = run.sample(&phase, t1, &now);
        if !run.goes_on(&phase, t1, &reading, &now) {
            break;
        }
        let (energy, moving) = system.energy(&now);
        largest_energy = largest_energy.max(moving);
        run.result.energy_drift = run.result.energy_drift.max((energy - e0 - now[S::WORK]).abs());
        let drift = system.drift(&now);
        let worst = &mut run.result.constraint_drift;
        worst.normal = worst.normal.max(drift.normal);
        worst.rolling = worst.rolling.max(drift.rolling);
        worst.rolling_velocity = worst.rolling_velocity.max(drift.rolling_velocity);

        let motion_ends = next_end < ends.len() && t1 >= ends[next_end].0 - 1e-9;
        let stands_alone = |run: &mut Run<'_, N, S>, branch: &mut Equilibrium| {
            let q: [f64; 5] = std::array::from_fn(|k| now[k]);
            if scene.fingertip.model == FingertipModel::Rigid {
                return true;
            }
            if !motion_ends && statics.stiffer_than(0.1 * first_eigenvalue, &q, &reading.forces) {
                return true;
            }
            let what = match statics.follow(branch, [q[3], q[4]], STRIDE) {
                Ok(found) => {
                    *branch = found;
                    let speed = now[5].hypot(now[6]).max(statics.geometry.radius * now[7].abs());
                    let apart = (found.q[0] - q[0]).hypot(found.q[1] - q[1]);
                    let apart = apart.max(statics.geometry.radius * (found.q[2] - q[2]).abs());
                    if speed > REST || apart < APART {
                        return true;
                    }
                    format!("the object rests {:.3} mm from the branch of equilibria that it came along", 1e3 * apart)
                }
                Err((Lost::Fold, last)) => format!(
                    "the branch of equilibria ends at joint angles {:.2} and {:.2} degrees (smallest eigenvalue {:.3e} N/m)",
                    last.q[3].to_degrees(),
                    last.q[4].to_degrees(),
                    last.smallest_eigenvalue
                ),
                Err(_) => return true,
            };
            let (before, time) = run.before;
            let (last_valid, _) = run.sample(&phase, time, &before);
            run.result.events.push(Event { kind: EventKind::Fold, time: t1, finger: None, what, last_valid });
            false
        };
        if !stands_alone(&mut run, &mut branch) {
            break;
        }
        if motion_ends {
            let (_, step, target) = ends[next_end];
            run.result.motions.push(MotionRow { step, target, reached: sample });
            next_end += 1;
            if let Some(kind) = run.cause(&phase, &now) {
                let what = format!("a step of {} s is no longer stable here", scene.integrator.step);
                run.result.events.push(Event { kind, time: t1, finger: None, what, last_valid: sample });
                break;
            }
        }
        if t1 >= next_output as f64 * output_every - 1e-9 || t1 >= duration - 1e-9 {
            run.result.samples.push(sample);
            next_output += 1;
            progress(t1 / duration);
        }
    }
    let mut result = run.result;
    result.completed = !result.events.iter().any(|e| e.kind.ends_run());
    if largest_energy > 0.0 {
        result.energy_drift /= largest_energy;
    }
    Ok(result)
}
