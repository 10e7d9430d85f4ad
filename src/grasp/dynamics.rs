//! Forces on the grasp and the accelerations they give; shared by both formulations.

use crate::grasp::constraints::{Contact, Coordinates, Geometry};
use crate::grasp::control::Inputs;
use crate::grasp::models::{Gradient, Tip};
use crate::grasp::statics::Equilibrium;
use crate::numerics::dense;
use crate::types::Scene;
use crate::types::grasp::{ConstraintDrift, Sample};
use crate::types::scene::Gains;

/// Fingers, tips and object of a scene, with tips of one model.
#[derive(Debug, Clone)]
pub struct Plant<T> {
    /// Lengths.
    pub geometry: Geometry,
    /// The tips, of one model.
    pub tips: [T; 2],
    /// Diagonal of the mass matrix (kg, kg m^2).
    pub mass: Coordinates,
    /// Its inverse; 0 for locked joints.
    pub inverse_mass: Coordinates,
    /// Gravity on the object along y (N).
    weight: f64,
    /// c_n and c_t of each tip (N s/m); 0 where the model holds the row.
    pub damping: [[f64; 2]; 2],
    gains: [Gains; 2],
    /// Maxwell branches of both tips: modulus over the springs' (1) and time (s).
    pub branches: Vec<[f64; 2]>,
    /// Torque that holds the first equilibrium: the preload of each controller's integral (N m).
    preload: [f64; 2],
}

/// What a contact shows from outside.
#[derive(Debug, Clone, Copy, Default)]
pub struct Reading {
    /// d_n1, d_n2, d_t1, d_t2 (m).
    pub displacements: [f64; 4],
    /// f_n1, f_n2, f_t1, f_t2 (N).
    pub forces: [f64; 4],
    /// Sines of the tilts.
    pub sin_tilt: [f64; 2],
    /// Where the tips touch along the face (m), from the middle of the object's side.
    pub places: [f64; 2],
}

impl Reading {
    /// As a sample at `time` with the coordinates `q`, of a grasp that has not slipped.
    pub fn sample(&self, time: f64, q: &Coordinates) -> Sample {
        let ([d1, d2, t1, t2], [f1, f2, g1, g2]) = (self.displacements, self.forces);
        Sample {
            time,
            pose: [q[0], q[1], q[2]],
            joints: [q[3], q[4]],
            normal: [d1, d2],
            tangential: [t1, t2],
            normal_force: [f1, f2],
            tangential_force: [g1, g2],
            ..Sample::default()
        }
    }
}

impl<T: Tip + Clone> Plant<T> {
    /// Of a scene that starts at `start`, with tips that are alike.
    pub fn new(scene: &Scene, tip: T, start: &Equilibrium) -> Self {
        Self::of(scene, [tip.clone(), tip], start)
    }
}

impl<T: Tip> Plant<T> {
    /// Of a scene that starts at `start`.
    pub fn of(scene: &Scene, tips: [T; 2], start: &Equilibrium) -> Self {
        let object = &scene.object;
        let [one, two] = scene.fingers();
        let mass = [object.mass, object.mass, object.inertia, one.inertia, two.inertia];
        let free = [one, two].map(|f| if f.fixed { 0.0 } else { 1.0 / f.inertia });
        let [n, t] = [tips[0].holds_normal(), tips[0].holds_tangent()];
        let kept = |[c_n, c_t]: [f64; 2]| [if n { 0.0 } else { c_n }, if t { 0.0 } else { c_t }];
        Self {
            geometry: Geometry::of(scene),
            tips,
            mass,
            inverse_mass: [1.0 / object.mass, 1.0 / object.mass, 1.0 / object.inertia, free[0], free[1]],
            weight: object.mass * scene.gravity,
            damping: scene.fingertips().map(|tip| kept(tip.damping)),
            gains: [one.gains, two.gains],
            branches: scene.fingertip.branches(),
            preload: start.torques,
        }
    }

    /// Whether row `k` (d_n1, d_n2, d_t1, d_t2) is held at 0 by the model.
    #[inline(always)]
    pub fn holds(&self, k: usize) -> bool {
        if k < 2 { self.tips[0].holds_normal() } else { self.tips[0].holds_tangent() }
    }

    /// Whether any row is.
    #[inline(always)]
    pub(crate) fn holds_any(&self) -> bool {
        self.tips[0].holds_normal() || self.tips[0].holds_tangent()
    }

    /// Forces of the displacements `d` at the rates `w` (N), and moments on the tilts (N m); held
    /// rows give none.
    #[inline(always)]
    pub fn contact_forces(&self, contact: &Contact, d: &[f64; 4], w: &[f64; 4]) -> ([f64; 4], [f64; 2]) {
        let gradient = |i: usize| -> Gradient { self.tips[i].gradient(d[i], d[2 + i], contact.tilt(i)) };
        let (a, b) = (gradient(0), gradient(1));
        let [[n1, t1], [n2, t2]] = self.damping;
        let forces = [a.normal + n1 * w[0], b.normal + n2 * w[1], a.tangential + t1 * w[2], b.tangential + t2 * w[3]];
        (forces, [a.moment, b.moment])
    }

    /// Accelerations under the contact forces `f` and `moments`. Held rows of `f` are solved for,
    /// so that their constraints obey C'' + 2 g C' + g^2 C = 0 with the gain `g` (1/s), and put
    /// into `f`.
    #[inline(always)]
    pub fn accelerations(
        &self,
        inputs: &Inputs,
        contact: &Contact,
        q: &Coordinates,
        v: &Coordinates,
        integral: &[f64; 2],
        f: &mut [f64; 4],
        moments: &[f64; 2],
        gain: f64,
    ) -> (Coordinates, [f64; 2]) {
        let torques: [f64; 2] = [0, 1].map(|i| {
            let Gains { kp, kd, ki } = self.gains[i];
            let error = q[3 + i] - inputs.desired[i];
            self.preload[i] - kp * error - kd * (v[3 + i] - inputs.rates[i]) - ki * integral[i]
        });
        let pull = contact.pull(f, moments);
        let turn = contact.turn(inputs.moment);
        let mut force = [
            inputs.force[0] - pull[0],
            inputs.force[1] + self.weight - pull[1],
            turn - pull[2],
            torques[0] - pull[3],
            torques[1] - pull[4],
        ];
        if self.holds_any() {
            self.hold(contact, v, f, &mut force, gain);
        }
        for k in 0..5 {
            force[k] *= self.inverse_mass[k];
        }
        (force, torques)
    }

    /// Lagrange multipliers of the held rows: (A M^-1 A^T) f = A M^-1 Q + A' v + 2 g A v + g^2 C.
    fn hold(&self, contact: &Contact, v: &Coordinates, f: &mut [f64; 4], force: &mut Coordinates, gain: f64) {
        let rows = contact.jacobian();
        let (bias, rates, c) = (contact.acceleration_bias(v), contact.rates(v), contact.displacements());
        let (matrix, mut right) = (self.held_matrix(&rows), [0.0; 4]);
        for k in (0..4).filter(|&k| self.holds(k)) {
            let acceleration: f64 = (0..5).map(|j| rows[k][j] * self.inverse_mass[j] * force[j]).sum();
            right[k] = acceleration + bias[k] + 2.0 * gain * rates[k] + gain * gain * c[k];
        }
        let multipliers = dense::solve(&matrix, &right).unwrap_or([f64::NAN; 4]);
        for k in (0..4).filter(|&k| self.holds(k)) {
            f[k] = multipliers[k];
            for j in 0..5 {
                force[j] -= rows[k][j] * multipliers[k];
            }
        }
    }

    /// A M^-1 A^T over the held rows, 1 on the diagonal of the others.
    fn held_matrix(&self, rows: &[Coordinates; 4]) -> dense::Square<4> {
        let mut matrix = [[0.0; 4]; 4];
        for i in 0..4 {
            for j in 0..4 {
                if self.holds(i) && self.holds(j) {
                    matrix[i][j] = (0..5).map(|k| rows[i][k] * self.inverse_mass[k] * rows[j][k]).sum();
                }
            }
            if !self.holds(i) {
                matrix[i][i] = 1.0;
            }
        }
        matrix
    }

    /// Brings `q` and `v` back onto the held constraints, along the directions of least mass.
    pub(crate) fn settle(&self, q: &mut Coordinates, v: &mut Coordinates) {
        if !self.holds_any() {
            return;
        }
        for pass in 0..4 {
            let contact = self.geometry.contact(q);
            let rows = contact.jacobian();
            let matrix = self.held_matrix(&rows);
            // Positions in the first passes, the velocity with the last one's Jacobian.
            let wanted = if pass < 3 { contact.displacements() } else { contact.rates(v) };
            let right = std::array::from_fn(|k| if self.holds(k) { wanted[k] } else { 0.0 });
            let Some(step) = dense::solve(&matrix, &right) else { return };
            let target = if pass < 3 { &mut *q } else { &mut *v };
            for k in (0..4).filter(|&k| self.holds(k)) {
                for j in 0..5 {
                    target[j] -= self.inverse_mass[j] * rows[k][j] * step[k];
                }
            }
        }
    }

    /// Work per time that motors and pushes do, less what the tips' damping takes (W).
    #[inline(always)]
    pub fn power(&self, inputs: &Inputs, contact: &Contact, v: &Coordinates, torques: &[f64; 2], w: &[f64; 4]) -> f64 {
        let [[n1, t1], [n2, t2]] = self.damping;
        let lost = n1 * w[0] * w[0] + n2 * w[1] * w[1] + t1 * w[2] * w[2] + t2 * w[3] * w[3];
        let pushed = inputs.force[0] * v[0] + inputs.force[1] * v[1] + contact.turn(inputs.moment) * v[2];
        pushed + torques[0] * v[3] + torques[1] * v[4] - lost
    }

    /// Violations of the held rows at the displacements `d` (m) and their rates `w` (m/s).
    pub fn drift(&self, d: &[f64; 4], w: &[f64; 4]) -> ConstraintDrift {
        let held = |a: usize, x: &[f64; 4]| if self.holds(a) { x[a].abs().max(x[a + 1].abs()) } else { 0.0 };
        ConstraintDrift { normal: held(0, d), rolling_velocity: held(2, w), rolling: held(2, d) }
    }

    /// Kinetic and potential energy (J) with the displacements `d`; and the elastic and kinetic
    /// part alone.
    pub fn energy(&self, contact: &Contact, q: &Coordinates, v: &Coordinates, d: &[f64; 4]) -> (f64, f64) {
        let kinetic: f64 = (0..5).map(|k| 0.5 * self.mass[k] * v[k] * v[k]).sum();
        let elastic: f64 = (0..2).map(|i| self.tips[i].energy(d[i], d[2 + i], contact.tilt(i))).sum();
        (kinetic + elastic - self.weight * q[1], kinetic + elastic)
    }
}
