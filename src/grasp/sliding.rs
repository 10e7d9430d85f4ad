//! The minimal form with tips that slide where friction does not hold them.
//!
//! A tip has no mass, so its own equation says how it slides. Where the force along the face of a
//! tip that sticks, dU/dd_t + c_t d_t' and what its branches carry, would be over the limit of
//! [`Friction`], the force is that limit, and the rest of it moves the tip's surface along the
//! face: c_t s' = excess. So s' is continuous, sticking is s' = 0, and nothing has to be switched.

use crate::grasp::constraints::{Coordinates, Geometry};
use crate::grasp::control::Inputs;
use crate::grasp::dynamics::{Plant, Reading};
use crate::grasp::friction::Friction;
use crate::grasp::integrators::System;
use crate::grasp::minimal;
use crate::grasp::models::Tip;
use crate::grasp::relaxing;

/// Entries of a state: those of the form with branches, then the places from which d_t is counted
/// (m).
pub(crate) const STATE: usize = relaxing::STATE + 2;
/// The first of these places.
const ORIGIN: usize = relaxing::STATE;

/// A plant whose tips may slide.
#[derive(Debug, Clone, Copy)]
pub struct Sliding<'a, T> {
    /// Forces.
    pub plant: &'a Plant<T>,
    /// What holds the tips.
    pub friction: &'a Friction,
    /// Step of the integrator (s). Tips of less damping than their spring takes up in half of one
    /// are damped by that while they slide, to which both methods are stable; the force is the
    /// limit anyway.
    pub step: f64,
}

impl<T: Tip> System<STATE> for Sliding<'_, T> {
    fn rate(&self, inputs: &Inputs, s: &[f64; STATE]) -> ([f64; STATE], Reading) {
        let plant = self.plant;
        let q: Coordinates = std::array::from_fn(|k| s[k]);
        let v: Coordinates = std::array::from_fn(|k| s[5 + k]);
        let geometry = Geometry { origin: [s[ORIGIN], s[ORIGIN + 1]], ..plant.geometry };
        let contact = geometry.contact(&q);
        let (d, w) = (contact.displacements(), contact.rates(&v));
        let (springs, mut moments) = plant.contact_forces(&contact, &d, &[0.0; 4]);
        let carried = relaxing::carried(plant, &springs, &moments, &relaxing::followed(s));
        let mut f: [f64; 4] =
            std::array::from_fn(|k| springs[k] + carried.forces[k] + plant.damping[k % 2][k / 2] * w[k]);
        (moments[0], moments[1]) = (moments[0] + carried.forces[4], moments[1] + carried.forces[5]);
        let along = self.friction.along(&f, &d);
        let (mut slide, mut kept) = ([0.0; 2], 0.0);
        for i in 0..2 {
            let (wanted, limit) = (f[2 + i], Friction::limit(along, &f, i));
            if wanted.abs() > limit {
                let more: f64 = 1.0 + plant.branches.iter().map(|b| b[0]).sum::<f64>();
                let spring = more * plant.tips[i].curvature(d[i], d[2 + i], contact.tilt(i))[1][1];
                f[2 + i] = limit.copysign(wanted);
                slide[i] = (wanted - f[2 + i]) / plant.damping[i][1].max(0.5 * spring * self.step);
            }
            // What the face gives, less what the spring takes up; damping and branches are counted
            // below.
            let counted = plant.damping[i][1] * w[2 + i] * w[2 + i] + carried.forces[2 + i] * w[2 + i];
            kept += f[2 + i] * w[2 + i] - springs[2 + i] * (w[2 + i] - slide[i]) - counted;
        }
        let integral = [s[10], s[11]];
        let (a, torques) = plant.accelerations(inputs, &contact, &q, &v, &integral, &mut f, &moments, 0.0);
        let power = plant.power(inputs, &contact, &v, &torques, &w) - relaxing::taken(&carried.forces, &w, &v) - kept;
        let mut rate = [0.0; STATE];
        rate[..5].copy_from_slice(&v);
        rate[5..10].copy_from_slice(&a);
        (rate[10], rate[11]) = (q[3] - inputs.desired[0], q[4] - inputs.desired[1]);
        rate[12] = power;
        rate[minimal::STATE..ORIGIN].copy_from_slice(&carried.rates);
        (rate[ORIGIN], rate[ORIGIN + 1]) = (slide[0], slide[1]);
        let sin_tilt = [contact.tilt(0).sin, contact.tilt(1).sin];
        (rate, Reading { displacements: d, forces: f, sin_tilt, places: contact.places() })
    }
}

/// A state with the places from which d_t is counted.
pub fn joined(core: &[f64; relaxing::STATE], origin: [f64; 2]) -> [f64; STATE] {
    let mut s = [0.0; STATE];
    s[..ORIGIN].copy_from_slice(core);
    s[ORIGIN..].copy_from_slice(&origin);
    s
}

/// Both parts of it.
pub(crate) fn parted(s: &[f64; STATE]) -> ([f64; relaxing::STATE], [f64; 2]) {
    (std::array::from_fn(|k| s[k]), [s[ORIGIN], s[ORIGIN + 1]])
}
