//! What drives the grasp from outside: desired joint angles along quintics, and pushes on the
//! object.
//!
//! The joints are controlled by a PID law on their own angles alone; the object's pose is never fed
//! back.

use crate::types::Scene;
use crate::types::scene::{Motion, Push};
use std::f64::consts::PI;

/// Inputs at one time.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Inputs {
    /// Desired joint angles (rad).
    pub desired: [f64; 2],
    /// Their rates (rad/s).
    pub rates: [f64; 2],
    /// Sum of the pushes (N), world frame.
    pub force: [f64; 2],
    /// Their moment about the centre is `moment[0] cos theta - moment[1] sin theta` (N m).
    pub moment: [f64; 2],
}

/// Part of the time in which one polynomial and the same pushes act.
#[derive(Debug, Clone)]
pub struct Phase {
    from: [f64; 2],
    delta: [f64; 2],
    start: f64,
    /// 0 while the angles are held.
    inverse_duration: f64,
    pushes: Vec<Push>,
}

impl Phase {
    /// Angles `at` (rad) held for ever, without pushes.
    pub fn hold(at: [f64; 2]) -> Self {
        Self { from: at, delta: [0.0; 2], start: 0.0, inverse_duration: 0.0, pushes: Vec::new() }
    }

    /// The phase of `scene` around the time `t` (s), which is not at a border of one.
    pub fn at(scene: &Scene, t: f64) -> Self {
        let mut begin = scene.initial.rest;
        let mut from = scene.initial.joints;
        let mut phase = Self::hold(from);
        for Motion { target, duration, hold } in &scene.motions {
            if t < begin {
                break;
            }
            let moving = t < begin + duration;
            phase.from = if moving { from } else { *target };
            phase.delta = if moving { [target[0] - from[0], target[1] - from[1]] } else { [0.0; 2] };
            phase.start = begin;
            phase.inverse_duration = if moving { 1.0 / duration } else { 0.0 };
            from = *target;
            begin += duration + hold;
        }
        phase.pushes = scene.pushes.iter().filter(|p| t > p.start && t < p.start + p.duration).copied().collect();
        phase
    }

    /// Inputs at the time `t` (s) within the phase.
    #[inline(always)]
    pub fn inputs(&self, t: f64) -> Inputs {
        let u = ((t - self.start) * self.inverse_duration).clamp(0.0, 1.0);
        let way = u * u * u * (10.0 + u * (6.0 * u - 15.0));
        let speed = 30.0 * u * u * (1.0 - u) * (1.0 - u) * self.inverse_duration;
        let mut inputs = Inputs {
            desired: [self.from[0] + self.delta[0] * way, self.from[1] + self.delta[1] * way],
            rates: [self.delta[0] * speed, self.delta[1] * speed],
            ..Inputs::default()
        };
        for push in &self.pushes {
            let pulse = (PI * (t - push.start) / push.duration).sin();
            let ([fx, fy], [ax, ay]) = (push.force.map(|f| f * pulse), push.at);
            inputs.force[0] += fx;
            inputs.force[1] += fy;
            inputs.moment[0] += ax * fy - ay * fx;
            inputs.moment[1] += ax * fx + ay * fy;
        }
        inputs
    }
}

/// Times closer than this are equal (s).
pub(crate) const TIME_TOLERANCE_S: f64 = 1e-9;

/// The times of a run (s).
#[derive(Debug, Clone)]
pub(crate) struct Schedule {
    /// Rising from 0: where motions, holds and pushes begin and end, and samples; between them the
    /// inputs are smooth.
    pub times: Vec<f64>,
    /// Ends of the rest and of each hold, with the number of the motion (0 for the rest) and its
    /// target (rad).
    pub ends: Vec<(f64, usize, [f64; 2])>,
    /// The end.
    pub duration: f64,
}

impl Schedule {
    /// Of a scene.
    pub fn of(scene: &Scene) -> Self {
        let mut t = scene.initial.rest;
        let mut times = vec![0.0, t];
        let mut ends = vec![(t, 0, scene.initial.joints)];
        for (i, Motion { target, duration, hold }) in scene.motions.iter().enumerate() {
            times.push(t + duration);
            t += duration + hold;
            times.push(t);
            ends.push((t, i + 1, *target));
        }
        times.extend(scene.pushes.iter().flat_map(|p| [p.start, p.start + p.duration]));
        let (duration, every) = (scene.duration(), scene.integrator.output_every);
        let samples = (duration / every + TIME_TOLERANCE_S).floor() as usize;
        times.extend((1..=samples).map(|k| k as f64 * every));
        times.sort_by(f64::total_cmp);
        times.dedup_by(|a, b| *a - *b < TIME_TOLERANCE_S);
        // Without a rest its end is the start, which no interval ends at.
        ends.retain(|end| end.0 > TIME_TOLERANCE_S);
        Self { times, ends, duration }
    }
}
