//! Steps through time: classical Runge-Kutta, semi-implicit Euler, and Dormand-Prince 5(4) with
//! step control.
//!
//! Sources: E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I (II.1,
//! II.4, II.5); E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration (I.1.2).

use crate::grasp::control::{Inputs, Phase};
use crate::grasp::dynamics::{Plant, Reading};
use crate::grasp::models::Tip;
use crate::grasp::multipliers;
use crate::grasp::relaxing;
use crate::grasp::statics::Equilibrium;
use crate::types::grasp::ConstraintDrift;

/// Equations of motion of first order. The first five entries of a state are positions, the next
/// five their rates; from 13 on follow what branches of the tips follow, slides, or in the
/// multiplier form four more positions and four more rates.
pub trait System<const N: usize> {
    /// Rates of a state, and what its contacts show.
    fn rate(&self, inputs: &Inputs, state: &[f64; N]) -> ([f64; N], Reading);

    /// Brings a state back onto constraints, where there are any to be left.
    fn settle(&self, _state: &mut [f64; N]) {}
}

/// A way to write a grasp whose tips stick.
pub trait Form<const N: usize>: System<N> {
    /// The entry that holds the work done on the grasp; nothing depends on it.
    const WORK: usize;
    /// The tips' model.
    type Tip: Tip;

    /// Forces on the grasp.
    fn plant(&self) -> &Plant<Self::Tip>;

    /// Counts d_t from `origin` (m) from now on.
    fn set_origin(&mut self, origin: [f64; 2]);

    /// The state in minimal coordinates, with what branches of its tips follow.
    fn core(&self, state: &[f64; N]) -> [f64; relaxing::STATE];

    /// The state of such coordinates.
    fn with_core(&self, core: &[f64; relaxing::STATE]) -> [f64; N];

    /// The state at rest in an equilibrium.
    fn start(&self, equilibrium: &Equilibrium) -> [f64; N];

    /// Whole energy, and its elastic and kinetic part (J).
    fn energy(&self, state: &[f64; N]) -> (f64, f64);

    /// Violations of the constraints.
    fn drift(&self, state: &[f64; N]) -> ConstraintDrift;
}

/// `s + h r`.
#[inline(always)]
fn along<const N: usize>(s: &[f64; N], h: f64, r: &[f64; N]) -> [f64; N] {
    let mut out = *s;
    for k in 0..N {
        out[k] += h * r[k];
    }
    out
}

/// A fixed-step method: the state after `h` seconds, and the contacts before them.
pub trait Stepper {
    /// One step from the time `t` (s).
    fn step<const N: usize, S: System<N>>(
        system: &S,
        phase: &Phase,
        t: f64,
        h: f64,
        state: &[f64; N],
    ) -> ([f64; N], Reading);
}

/// Classical Runge-Kutta of order 4.
#[derive(Debug, Clone, Copy)]
pub struct Rk4;

impl Stepper for Rk4 {
    #[inline(always)]
    fn step<const N: usize, S: System<N>>(
        system: &S,
        phase: &Phase,
        t: f64,
        h: f64,
        state: &[f64; N],
    ) -> ([f64; N], Reading) {
        let (k1, reading) = system.rate(&phase.inputs(t), state);
        let middle = phase.inputs(t + 0.5 * h);
        let (k2, _) = system.rate(&middle, &along(state, 0.5 * h, &k1));
        let (k3, _) = system.rate(&middle, &along(state, 0.5 * h, &k2));
        let (k4, _) = system.rate(&phase.inputs(t + h), &along(state, h, &k3));
        let mut next = *state;
        for k in 0..N {
            next[k] += h / 6.0 * (k1[k] + 2.0 * (k2[k] + k3[k]) + k4[k]);
        }
        system.settle(&mut next);
        (next, reading)
    }
}

/// Semi-implicit (symplectic) Euler: rates first, then positions with the new rates.
#[derive(Debug, Clone, Copy)]
pub struct SemiImplicitEuler;

impl Stepper for SemiImplicitEuler {
    #[inline(always)]
    fn step<const N: usize, S: System<N>>(
        system: &S,
        phase: &Phase,
        t: f64,
        h: f64,
        state: &[f64; N],
    ) -> ([f64; N], Reading) {
        let (rate, reading) = system.rate(&phase.inputs(t), state);
        let mut next = along(state, h, &rate);
        for k in 0..5 {
            next[k] = state[k] + h * next[5 + k];
        }
        if N == multipliers::STATE {
            for k in 13..17 {
                next[k] = state[k] + h * next[4 + k];
            }
        }
        system.settle(&mut next);
        (next, reading)
    }
}

/// Dormand and Prince's coefficients (Hairer et al., table II.5.2); the last stage holds the
/// weights of order 5.
struct DormandPrince {
    /// Times of the stages, in steps.
    nodes: [f64; 7],
    /// Weights of the rates before each stage.
    stages: [[f64; 6]; 6],
    /// Weights of the error estimate.
    error: [f64; 7],
}

const DORMAND_PRINCE: DormandPrince = DormandPrince {
    nodes: [0.0, 0.2, 0.3, 0.8, 8.0 / 9.0, 1.0, 1.0],
    stages: [
        [0.2, 0.0, 0.0, 0.0, 0.0, 0.0],
        [3.0 / 40.0, 9.0 / 40.0, 0.0, 0.0, 0.0, 0.0],
        [44.0 / 45.0, -56.0 / 15.0, 32.0 / 9.0, 0.0, 0.0, 0.0],
        [19372.0 / 6561.0, -25360.0 / 2187.0, 64448.0 / 6561.0, -212.0 / 729.0, 0.0, 0.0],
        [9017.0 / 3168.0, -355.0 / 33.0, 46732.0 / 5247.0, 49.0 / 176.0, -5103.0 / 18656.0, 0.0],
        [35.0 / 384.0, 0.0, 500.0 / 1113.0, 125.0 / 192.0, -2187.0 / 6784.0, 11.0 / 84.0],
    ],
    error: [71.0 / 57600.0, 0.0, -71.0 / 16695.0, 71.0 / 1920.0, -17253.0 / 339200.0, 22.0 / 525.0, -1.0 / 40.0],
};

/// Size below which a coordinate's error is relative to this (m, rad, and their rates).
const MIN_ERROR_SCALE: f64 = 1e-3;
/// Shortest step that is tried (s).
pub(crate) const MIN_STEP_S: f64 = 1e-8;

/// A step with control from `state`, whose rates are `first`: the state, the step taken and the one
/// to try next (s). None where no step down to [`MIN_STEP_S`] meets the tolerance.
pub(crate) fn dormand_prince<const N: usize, S: System<N>>(
    system: &S,
    phase: &Phase,
    t: f64,
    trial: f64,
    tolerance: f64,
    state: &[f64; N],
    first: [f64; N],
) -> Option<([f64; N], f64, f64)> {
    let mut h = trial;
    loop {
        let mut rates = [first; 7];
        let mut next = *state;
        for stage in 0..6 {
            next = *state;
            for (weight, rate) in DORMAND_PRINCE.stages[stage].iter().zip(&rates).take(stage + 1) {
                next = along(&next, h * weight, rate);
            }
            rates[stage + 1] = system.rate(&phase.inputs(t + DORMAND_PRINCE.nodes[stage + 1] * h), &next).0;
        }
        let mut error: f64 = 0.0;
        for k in 0..N {
            let off: f64 = h * (0..7).map(|i| DORMAND_PRINCE.error[i] * rates[i][k]).sum::<f64>();
            let part = off.abs() / (tolerance * state[k].abs().max(next[k].abs()).max(MIN_ERROR_SCALE));
            error = if part.is_nan() { f64::INFINITY } else { error.max(part) };
        }
        let factor = if error.is_finite() { (0.9 * error.powf(-0.2)).clamp(0.2, 5.0) } else { 0.1 };
        if error <= 1.0 {
            system.settle(&mut next);
            return Some((next, h, h * factor));
        }
        h *= factor.min(0.9);
        if h < MIN_STEP_S {
            return None;
        }
    }
}
