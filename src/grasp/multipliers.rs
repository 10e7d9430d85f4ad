//! The source's equations of motion: Lagrange multipliers with constraint stabilisation (J.
//! Baumgarte, Comput. Methods Appl. Mech. Eng. 1, 1972).
//!
//! Displacements d and their rates w are coordinates of their own, tied to pose and joint angles by
//! C = D(q) - d = 0. Tips have no mass, so their own equations say that the multipliers are the
//! contact forces (lambda_H = -f_n, lambda_N = f_t); with these the object's and joints' equations
//! give q'', and C'' + 2 g C' + g^2 C = 0 gives w'. The 13 x 13 system is block triangular and
//! solved by substitution.

use crate::grasp::control::Inputs;
use crate::grasp::dynamics::{Plant, Reading};
use crate::grasp::integrators::{Form, System};
use crate::grasp::minimal;
use crate::grasp::models::Tip;
use crate::grasp::relaxing;
use crate::grasp::statics::Equilibrium;
use crate::types::grasp::ConstraintDrift;
use crate::types::scene::Rolling;

/// Entries of a state: those of the minimal form, then d_n1, d_n2, d_t1, d_t2 (m) and their rates
/// (m/s).
pub(crate) const STATE: usize = 21;

/// The multiplier form of a plant.
#[derive(Debug, Clone)]
pub struct Multipliers<T> {
    /// Forces.
    pub plant: Plant<T>,
    /// Gain g of the stabilisation (1/s).
    pub gain: f64,
    /// Whether the rolling constraint's integral is stabilised too.
    pub rolling: Rolling,
}

/// q, v, d and w of a state.
#[inline(always)]
fn parts(s: &[f64; STATE]) -> ([f64; 5], [f64; 5], [f64; 4], [f64; 4]) {
    (
        [s[0], s[1], s[2], s[3], s[4]],
        [s[5], s[6], s[7], s[8], s[9]],
        [s[13], s[14], s[15], s[16]],
        [s[17], s[18], s[19], s[20]],
    )
}

impl<T: Tip> System<STATE> for Multipliers<T> {
    #[inline(always)]
    fn rate(&self, inputs: &Inputs, s: &[f64; STATE]) -> ([f64; STATE], Reading) {
        let (plant, g) = (&self.plant, self.gain);
        let (q, v, d, w) = parts(s);
        let contact = plant.geometry.contact(&q);
        let (mut f, moments) = plant.contact_forces(&contact, &d, &w);
        let integral = [s[10], s[11]];
        let (a, torques) = plant.accelerations(inputs, &contact, &q, &v, &integral, &mut f, &moments, g);
        let power = plant.power(inputs, &contact, &v, &torques, &w);
        let mut rate = [0.0; STATE];
        rate[..5].copy_from_slice(&v);
        rate[5..10].copy_from_slice(&a);
        (rate[10], rate[11]) = (q[3] - inputs.desired[0], q[4] - inputs.desired[1]);
        rate[12] = power;
        let (whole, speed, second) = (contact.displacements(), contact.rates(&v), contact.rates(&a));
        let bias = contact.acceleration_bias(&v);
        for k in 0..4 {
            if !plant.holds(k) {
                let position = if k >= 2 && self.rolling == Rolling::Velocity { 0.0 } else { g * g };
                rate[13 + k] = w[k];
                rate[17 + k] = second[k] + bias[k] + 2.0 * g * (speed[k] - w[k]) + position * (whole[k] - d[k]);
            }
        }
        let sin_tilt = [contact.tilt(0).sin, contact.tilt(1).sin];
        (rate, Reading { displacements: d, forces: f, sin_tilt, places: contact.places() })
    }
}

impl<T: Tip> Form<STATE> for Multipliers<T> {
    const WORK: usize = 12;
    type Tip = T;

    fn plant(&self) -> &Plant<T> {
        &self.plant
    }

    fn set_origin(&mut self, origin: [f64; 2]) {
        self.plant.geometry.origin = origin;
    }

    fn core(&self, s: &[f64; STATE]) -> [f64; relaxing::STATE] {
        let mut core = [0.0; relaxing::STATE];
        core[..minimal::STATE].copy_from_slice(&s[..minimal::STATE]);
        core
    }

    fn with_core(&self, core: &[f64; relaxing::STATE]) -> [f64; STATE] {
        let (q, v) = (std::array::from_fn(|k| core[k]), std::array::from_fn(|k| core[5 + k]));
        let contact = self.plant.geometry.contact(&q);
        let (d, w) = (contact.displacements(), contact.rates(&v));
        let mut s = [0.0; STATE];
        s[..minimal::STATE].copy_from_slice(&core[..minimal::STATE]);
        for k in (0..4).filter(|&k| !self.plant.holds(k)) {
            (s[13 + k], s[17 + k]) = (d[k], w[k]);
        }
        s
    }

    fn start(&self, e: &Equilibrium) -> [f64; STATE] {
        let mut s = [0.0; STATE];
        s[..5].copy_from_slice(&e.q);
        for k in (0..4).filter(|&k| !self.plant.holds(k)) {
            s[13 + k] = e.displacements[k];
        }
        s
    }

    fn energy(&self, s: &[f64; STATE]) -> (f64, f64) {
        let (q, v, d, _) = parts(s);
        self.plant.energy(&self.plant.geometry.contact(&q), &q, &v, &d)
    }

    fn drift(&self, s: &[f64; STATE]) -> ConstraintDrift {
        let (q, v, d, w) = parts(s);
        let contact = self.plant.geometry.contact(&q);
        let (whole, speed) = (contact.displacements(), contact.rates(&v));
        let apart = |k: usize, x: &[f64; 4], y: &[f64; 4]| (x[k] - y[k]).abs().max((x[k + 1] - y[k + 1]).abs());
        ConstraintDrift {
            normal: apart(0, &whole, &d),
            rolling_velocity: apart(2, &speed, &w),
            rolling: apart(2, &whole, &d),
        }
    }
}
