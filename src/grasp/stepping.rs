//! Which steps are stable: the spectral radius of one step about a state, and the largest step that
//! keeps it at 1.

use crate::grasp::control::Phase;
use crate::grasp::dynamics::Plant;
use crate::grasp::integrators::{Form, Rk4, SemiImplicitEuler, Stepper};
use crate::grasp::minimal::Minimal;
use crate::grasp::models::{Tip, tips};
use crate::grasp::multipliers::Multipliers;
use crate::grasp::relaxing::Relaxing;
use crate::grasp::statics::Equilibrium;
use crate::numerics::dense::spectral_radius;
use crate::types::Scene;
use crate::types::grasp::StableStep;
use crate::types::scene::{Formulation, Method};

/// Largest growth of a stable step: far above the rounding of the derivatives, a factor e in
/// 100,000 steps.
pub(crate) const MAX_STABLE_GROWTH: f64 = 1.0 + 1e-5;

/// Spectral radius of one step of `h` seconds about `state`, from central differences of the step
/// itself.
pub fn growth<P: Stepper, const N: usize, S: Form<N>>(system: &S, phase: &Phase, h: f64, state: &[f64; N]) -> f64 {
    let mut matrix = [[0.0; N]; N];
    for k in 0..N {
        if k == S::WORK {
            continue;
        }
        // Displacements of a thousandth of a millimetre or a rad, rates of a millimetre or a rad a
        // second.
        let delta = if (5..10).contains(&k) || k > 16 { 1e-4 } else { 1e-7 };
        let moved = |sign: f64| {
            let mut s = *state;
            s[k] += sign * delta;
            P::step(system, phase, 0.0, h, &s).0
        };
        let (up, down) = (moved(1.0), moved(-1.0));
        for row in (0..N).filter(|&row| row != S::WORK) {
            matrix[row][k] = (up[row] - down[row]) / (2.0 * delta);
        }
    }
    spectral_radius(&matrix)
}

/// How the motion's own growth is separated from that of a step.
struct MotionGrowth {
    /// Parts of a step in which that growth is first measured.
    initial_parts: f64,
    /// Most halvings of the parts.
    max_halvings: usize,
    /// Relative change of the exponent by a halving, up to which the growth is the motion's own.
    tolerance: f64,
    /// Relative error of a step's exponent with which it follows the motion: both methods are of
    /// first order at least, so it differs by less than half.
    max_exponent_error: f64,
}

const MOTION_GROWTH: MotionGrowth =
    MotionGrowth { initial_parts: 50.0, max_halvings: 24, tolerance: 0.005, max_exponent_error: 0.5 };

/// By how much the motion itself grows in `h` seconds about `state`, from parts so short that
/// halving them changes nothing; None where it does not. Longer parts would blow up by themselves,
/// and what blows up in parts excused the step that blew up as a whole.
fn own_growth<const N: usize, S: Form<N>>(system: &S, phase: &Phase, h: f64, state: &[f64; N]) -> Option<f64> {
    let mut parts = MOTION_GROWTH.initial_parts;
    let mut before = f64::NAN;
    for _ in 0..MOTION_GROWTH.max_halvings {
        let exponent = parts * growth::<Rk4, N, S>(system, phase, h / parts, state).ln();
        if exponent <= MAX_STABLE_GROWTH.ln() {
            return None;
        }
        if (exponent - before).abs() <= MOTION_GROWTH.tolerance * exponent {
            return Some(exponent.exp());
        }
        (before, parts) = (exponent, 2.0 * parts);
    }
    None
}

/// The same for a named method; 0 for the adaptive one, which finds its own steps. Where the grasp
/// itself is unstable (an object that falls, or by its control) and the step follows that growth,
/// the step is not to blame, and 1 is given back.
pub(crate) fn growth_of<const N: usize, S: Form<N>>(
    method: Method,
    system: &S,
    phase: &Phase,
    h: f64,
    state: &[f64; N],
) -> f64 {
    let found = match method {
        Method::Rk4 => growth::<Rk4, N, S>(system, phase, h, state),
        Method::SemiImplicitEuler => growth::<SemiImplicitEuler, N, S>(system, phase, h, state),
        Method::Adaptive => 0.0,
    };
    if found <= MAX_STABLE_GROWTH || !found.is_finite() {
        return found;
    }
    match own_growth(system, phase, h, state) {
        Some(own) if own.is_finite() && found <= 1.02 * own => 1.0,
        Some(own)
            if own.ln() <= 1.0 && (found.ln() - own.ln()).abs() <= MOTION_GROWTH.max_exponent_error * own.ln() =>
        {
            1.0
        }
        _ => found,
    }
}

/// Largest value between `low` and `high` up to which `stable` holds, to 1 %; `low` where it does
/// not hold even there.
///
/// ```
/// use palpate::grasp::stepping::largest;
/// // Stable up to a step of 0.3.
/// let found = largest(1e-6, 1.0, |h| h < 0.3);
/// assert!((found / 0.3 - 1.0).abs() < 0.02);
/// ```
pub fn largest(low: f64, high: f64, stable: impl Fn(f64) -> bool) -> f64 {
    let (mut good, mut bad) = (low, low);
    // Upwards in factors of 1.5, so that an island of stability further up is not taken for the
    // border.
    while bad < high {
        bad *= 1.5;
        if !stable(bad) {
            break;
        }
        good = bad;
    }
    while bad / good > 1.01 {
        let middle = (good * bad).sqrt();
        if stable(middle) { good = middle } else { bad = middle }
    }
    good
}

/// Largest stable step (s) at all of the equilibria `at`, to 1 %, with the scene's gains.
pub fn stable_step(scene: &Scene, method: Method, formulation: Formulation, at: &[Equilibrium]) -> f64 {
    let (gain, tips) = (scene.integrator.baumgarte, tips(scene));
    let tips = [tips[0].as_ref(), tips[1].as_ref()];
    let stable = |h, e| growth_at(scene, tips, method, formulation, [h, gain], e) <= MAX_STABLE_GROWTH;
    largest(1e-7, 1.0, |h| at.iter().all(|e| stable(h, e)))
}

/// Largest stable gain of the constraint stabilisation (1/s) at an equilibrium, for the scene's
/// step, to 1 %.
pub(crate) fn stable_gain(scene: &Scene, at: &Equilibrium) -> f64 {
    let (method, step, tips) = (scene.integrator.method, scene.integrator.step, tips(scene));
    let tips = [tips[0].as_ref(), tips[1].as_ref()];
    largest(1e-3, 1e9, |g| growth_at(scene, tips, method, Formulation::Multipliers, [step, g], at) <= MAX_STABLE_GROWTH)
}

/// Spectral radius of one step of `h` seconds about an equilibrium of `scene` with `tips`, with the
/// gain `gain` (1/s) in the multiplier form.
pub(crate) fn growth_at(
    scene: &Scene,
    tips: [&dyn Tip; 2],
    method: Method,
    formulation: Formulation,
    [h, gain]: [f64; 2],
    at: &Equilibrium,
) -> f64 {
    let plant = Plant::of(scene, tips, at);
    let phase = Phase::hold([at.q[3], at.q[4]]);
    match formulation {
        Formulation::Minimal if !plant.branches.is_empty() => {
            let system = Relaxing(plant);
            growth_of(method, &system, &phase, h, &system.start(at))
        }
        Formulation::Minimal => {
            let system = Minimal(plant);
            growth_of(method, &system, &phase, h, &system.start(at))
        }
        Formulation::Multipliers => {
            let system = Multipliers { plant, gain, rolling: scene.integrator.rolling };
            growth_of(method, &system, &phase, h, &system.start(at))
        }
    }
}

/// Largest stable steps of both fixed-step methods in both formulations, at all of the equilibria
/// `at`.
pub fn stable_steps(scene: &Scene, at: &[Equilibrium]) -> Vec<StableStep> {
    let cases = [
        (Method::Rk4, Formulation::Minimal),
        (Method::Rk4, Formulation::Multipliers),
        (Method::SemiImplicitEuler, Formulation::Minimal),
        (Method::SemiImplicitEuler, Formulation::Multipliers),
    ];
    let step = |(method, formulation)| {
        let step = stable_step(scene, method, formulation, at);
        StableStep { method, formulation, step }
    };
    cases.map(step).to_vec()
}
