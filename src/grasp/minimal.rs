//! Equations of motion in minimal coordinates q = (x, y, theta, theta_1, theta_2): M q'' = -dU/dq -
//! J^T diag(c_n, c_n, c_t, c_t) J q' + gravity + torques + pushes, M constant and diagonal.
//!
//! Nothing can drift. Rows that a model holds at 0 are kept by multipliers, and the coordinates are
//! brought back onto them after each step.

use crate::grasp::control::Inputs;
use crate::grasp::dynamics::{Plant, Reading};
use crate::grasp::integrators::{Form, System};
use crate::grasp::models::Tip;
use crate::grasp::relaxing;
use crate::grasp::statics::Equilibrium;
use crate::types::grasp::ConstraintDrift;

/// Entries of a state: q, q', integral of the joint errors (rad s), work done on the grasp (J).
pub(crate) const STATE: usize = 13;

/// The minimal form of a plant.
#[derive(Debug, Clone)]
pub struct Minimal<T>(pub Plant<T>);

impl<T: Tip> System<STATE> for Minimal<T> {
    #[inline(always)]
    fn rate(&self, inputs: &Inputs, s: &[f64; STATE]) -> ([f64; STATE], Reading) {
        let plant = &self.0;
        let (q, v) = ([s[0], s[1], s[2], s[3], s[4]], [s[5], s[6], s[7], s[8], s[9]]);
        let contact = plant.geometry.contact(&q);
        let (d, w) = (contact.displacements(), contact.rates(&v));
        let (mut f, moments) = plant.contact_forces(&contact, &d, &w);
        let integral = [s[10], s[11]];
        let (a, torques) = plant.accelerations(inputs, &contact, &q, &v, &integral, &mut f, &moments, 0.0);
        let power = plant.power(inputs, &contact, &v, &torques, &w);
        let errors = [q[3] - inputs.desired[0], q[4] - inputs.desired[1]];
        let rate = [v[0], v[1], v[2], v[3], v[4], a[0], a[1], a[2], a[3], a[4], errors[0], errors[1], power];
        let sin_tilt = [contact.tilt(0).sin, contact.tilt(1).sin];
        (rate, Reading { displacements: d, forces: f, sin_tilt, places: contact.places() })
    }

    #[inline(always)]
    fn settle(&self, s: &mut [f64; STATE]) {
        if self.0.holds_any() {
            let (mut q, mut v) = ([s[0], s[1], s[2], s[3], s[4]], [s[5], s[6], s[7], s[8], s[9]]);
            self.0.settle(&mut q, &mut v);
            s[..5].copy_from_slice(&q);
            s[5..10].copy_from_slice(&v);
        }
    }
}

impl<T: Tip> Form<STATE> for Minimal<T> {
    const WORK: usize = 12;
    type Tip = T;

    fn plant(&self) -> &Plant<T> {
        &self.0
    }

    fn set_origin(&mut self, origin: [f64; 2]) {
        self.0.geometry.origin = origin;
    }

    fn core(&self, s: &[f64; STATE]) -> [f64; relaxing::STATE] {
        let mut core = [0.0; relaxing::STATE];
        core[..STATE].copy_from_slice(s);
        core
    }

    fn with_core(&self, core: &[f64; relaxing::STATE]) -> [f64; STATE] {
        std::array::from_fn(|k| core[k])
    }

    fn start(&self, e: &Equilibrium) -> [f64; STATE] {
        let mut s = [0.0; STATE];
        s[..5].copy_from_slice(&e.q);
        s
    }

    fn energy(&self, s: &[f64; STATE]) -> (f64, f64) {
        let (q, v) = ([s[0], s[1], s[2], s[3], s[4]], [s[5], s[6], s[7], s[8], s[9]]);
        let contact = self.0.geometry.contact(&q);
        self.0.energy(&contact, &q, &v, &contact.displacements())
    }

    fn drift(&self, s: &[f64; STATE]) -> ConstraintDrift {
        let (q, v) = ([s[0], s[1], s[2], s[3], s[4]], [s[5], s[6], s[7], s[8], s[9]]);
        let contact = self.0.geometry.contact(&q);
        self.0.drift(&contact.displacements(), &contact.rates(&v))
    }
}
