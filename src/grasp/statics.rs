//! Equilibria of the object at given joint angles, and the branch of them that starts at the pinch.

use crate::grasp::constraints::{Contact, Coordinates, Geometry};
use crate::grasp::models::{Tip, in_range};
use crate::numerics::dense::{self, Square, symmetric_eigen};
use crate::types::grasp::Sample;
use crate::types::{FingertipModel, Scene};
use std::f64::consts::PI;

/// Energy of the object between two tips, joints fixed.
#[derive(Debug, Clone, Copy)]
pub struct Statics<'a> {
    /// Lengths.
    pub geometry: Geometry,
    /// The tips, of one model.
    pub tips: [&'a dyn Tip; 2],
    /// Gravity on the object along y (N).
    pub weight: f64,
}

/// An equilibrium.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Equilibrium {
    /// Pose and joint angles (m, rad).
    pub q: Coordinates,
    /// Displacements d_n1, d_n2, d_t1, d_t2 (m).
    pub displacements: [f64; 4],
    /// Contact forces f_n1, f_n2, f_t1, f_t2 (N).
    pub forces: [f64; 4],
    /// Joint torques that hold it (N m).
    pub torques: [f64; 2],
    /// Smallest eigenvalue of the Hessian in (x, y, a theta) along what the tips leave free (N/m).
    pub smallest_eigenvalue: f64,
}

impl Equilibrium {
    /// As a sample at `time` (s).
    pub fn sample(&self, time: f64) -> Sample {
        let ([d1, d2, t1, t2], [f1, f2, g1, g2]) = (self.displacements, self.forces);
        Sample {
            time,
            pose: [self.q[0], self.q[1], self.q[2]],
            joints: [self.q[3], self.q[4]],
            normal: [d1, d2],
            tangential: [t1, t2],
            normal_force: [f1, f2],
            tangential_force: [g1, g2],
            ..Sample::default()
        }
    }
}

/// Why a branch of equilibria could not be followed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Lost {
    /// The smallest eigenvalue is not positive, or there is no equilibrium nearby any more.
    Fold,
    /// A tip (0 or 1) has left the object.
    Contact(usize),
    /// A tip (0 or 1) is out of the model's range.
    Range(usize),
}

impl Lost {
    /// In words, after "at these angles".
    pub fn words(self) -> String {
        match self {
            Self::Fold => "the branch of stable equilibria ends".into(),
            Self::Contact(i) => format!("finger {} leaves the object", i + 1),
            Self::Range(i) => format!("finger {} leaves the model's range", i + 1),
        }
    }
}

impl<'a> Statics<'a> {
    /// Of a scene, with tips that are alike.
    pub fn new(scene: &Scene, tip: &'a dyn Tip) -> Self {
        Self::of(scene, [tip; 2])
    }

    /// Of a scene, with a tip for each finger.
    pub fn of(scene: &Scene, tips: [&'a dyn Tip; 2]) -> Self {
        Self { geometry: Geometry::of(scene), tips, weight: scene.object.mass * scene.gravity }
    }

    /// Whether the tips hold d_n at 0.
    pub(crate) fn holds_normal(&self) -> bool {
        self.tips[0].holds_normal()
    }

    /// Whether the tips hold d_t at 0.
    pub fn holds_tangent(&self) -> bool {
        self.tips[0].holds_tangent()
    }

    /// Energy of tips and gravity (J) at `q`.
    pub fn energy(&self, q: &Coordinates) -> f64 {
        let contact = self.geometry.contact(q);
        let d = self.taken(&contact);
        let elastic: f64 = (0..2).map(|i| self.tips[i].energy(d[i], d[2 + i], contact.tilt(i))).sum();
        elastic - self.weight * q[1]
    }

    /// Displacements that the model knows: held ones are 0.
    fn taken(&self, contact: &Contact) -> [f64; 4] {
        let mut d = contact.displacements();
        if self.holds_normal() {
            (d[0], d[1]) = (0.0, 0.0);
        }
        if self.holds_tangent() {
            (d[2], d[3]) = (0.0, 0.0);
        }
        d
    }

    /// Forces (without multipliers) and moments at a contact.
    fn forces(&self, contact: &Contact) -> ([f64; 4], [f64; 2]) {
        let d = self.taken(contact);
        let [a, b] = [0, 1].map(|i| self.tips[i].gradient(d[i], d[2 + i], contact.tilt(i)));
        ([a.normal, b.normal, a.tangential, b.tangential], [a.moment, b.moment])
    }

    /// Forces of the springs alone (N), without multipliers and damping.
    pub fn elastic_forces(&self, q: &Coordinates) -> [f64; 4] {
        self.forces(&self.geometry.contact(q)).0
    }

    /// Gradient of the energy in (x, y, a theta) (N), joints fixed, without multipliers.
    pub fn gradient(&self, q: &Coordinates) -> [f64; 3] {
        let contact = self.geometry.contact(q);
        let (f, moments) = self.forces(&contact);
        let pull = contact.pull(&f, &moments);
        [pull[0], pull[1] - self.weight, pull[2] / self.geometry.scale()]
    }

    /// Hessian of the energy in (x, y, a theta) (N/m), joints fixed; `f` are the contact forces,
    /// multipliers included.
    pub fn hessian(&self, q: &Coordinates, f: &[f64; 4]) -> Square<3> {
        let contact = self.geometry.contact(q);
        let d = self.taken(&contact);
        let rows = contact.jacobian();
        let mut h = contact.curvature(f);
        for i in 0..2 {
            let k = self.tips[i].curvature(d[i], d[2 + i], contact.tilt(i));
            let sign = if i == 0 { 1.0 } else { -1.0 };
            let first = |r: &Coordinates| [r[0], r[1], r[2]];
            let local = [first(&rows[i]), first(&rows[2 + i]), [0.0, 0.0, sign]];
            for m in 0..3 {
                for n in 0..3 {
                    for a in 0..3 {
                        for b in 0..3 {
                            h[m][n] += local[a][m] * k[a][b] * local[b][n];
                        }
                    }
                }
            }
        }
        self.scaled(h)
    }

    /// From (x, y, theta) to (x, y, a theta).
    fn scaled(&self, mut h: Square<3>) -> Square<3> {
        for k in 0..3 {
            h[2][k] /= self.geometry.scale();
            h[k][2] /= self.geometry.scale();
        }
        h
    }

    /// Smallest eigenvalue of the Hessian along what the held constraints leave free (N/m). Without
    /// freedom: infinite.
    pub fn smallest_eigenvalue(&self, q: &Coordinates, f: &[f64; 4]) -> f64 {
        self.free_eigenvalues(q, f).first().copied().unwrap_or(f64::INFINITY)
    }

    /// Eigenvalues of the Hessian along what the held constraints leave free, rising (N/m).
    pub(crate) fn free_eigenvalues(&self, q: &Coordinates, f: &[f64; 4]) -> Vec<f64> {
        if self.holds_normal() {
            return Vec::new();
        }
        let h = self.hessian(q, f);
        if !self.holds_tangent() {
            return symmetric_eigen(&h).map(|pair| pair.0).to_vec();
        }
        // Two held rows leave one direction: their cross product.
        let rows = self.geometry.contact(q).jacobian();
        let [a, b] = [rows[2], rows[3]].map(|r| [r[0], r[1], r[2] / self.geometry.scale()]);
        let z = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
        let form: f64 = (0..3).map(|i| (0..3).map(|j| z[i] * h[i][j] * z[j]).sum::<f64>()).sum();
        vec![form / z.iter().map(|v| v * v).sum::<f64>()]
    }

    /// Length of the force that is left in (x, y, a theta) (N) under the contact forces `f`,
    /// multipliers included.
    pub fn residual(&self, q: &Coordinates, f: &[f64; 4]) -> f64 {
        let contact = self.geometry.contact(q);
        let pull = contact.pull(f, &self.forces(&contact).1);
        let left = [pull[0], pull[1] - self.weight, pull[2] / self.geometry.scale()];
        left.iter().map(|v| v * v).sum::<f64>().sqrt()
    }

    /// Whether the smallest eigenvalue is above `limit` (N/m), by the leading minors: much quicker
    /// than the value.
    pub(crate) fn stiffer_than(&self, limit: f64, q: &Coordinates, f: &[f64; 4]) -> bool {
        if self.holds_normal() || self.holds_tangent() {
            return self.smallest_eigenvalue(q, f) > limit;
        }
        let h = self.hessian(q, f);
        let [a, b, c] = [h[0][0] - limit, h[1][1] - limit, h[2][2] - limit];
        let (d, e, g) = (h[0][1], h[0][2], h[1][2]);
        a > 0.0 && a * b - d * d > 0.0 && a * (b * c - g * g) - d * (d * c - g * e) + e * (d * g - b * e) > 0.0
    }

    /// The closed form at joint angles 0 (docs/reference/grasp.md): x = theta = 0, and for tips
    /// that deform along the face y = -l - m g / (4 pi E d_0); for others y = -l. Rigid tips grip
    /// with the force that soft ones have at d_0. That of tabulated tips, and of fingers that
    /// differ, is found next to it; its eigenvalue is not a number where there is none.
    pub fn pinch(&self, scene: &Scene) -> Equilibrium {
        let d = scene.initial.normal_displacement;
        let stiffness = PI * scene.fingertip.youngs_modulus;
        let sag = if self.holds_tangent() { 0.0 } else { self.weight / (4.0 * stiffness * d) };
        let (grip, half) = (stiffness * d * d, 0.5 * self.weight);
        let forces = [grip, grip, half, half];
        let level = self.geometry.level();
        if scene.fingertip.model != FingertipModel::Tabulated && scene.second.is_none() {
            return self.at([0.0, sag + level, 0.0, 0.0, 0.0], forces);
        }
        if self.holds_normal() {
            let middle = self.at([self.middle(), level, 0.0, 0.0, 0.0], forces);
            return self
                .equilibrium([0.0; 2], &middle)
                .unwrap_or(Equilibrium { smallest_eigenvalue: f64::NAN, ..middle });
        }
        // Without a closed form: shared so that both tips press alike, and hung from the stiffness
        // along the face that they have there.
        let mut q = [self.middle(), level, 0.0, 0.0, 0.0];
        let reach = 0.99 * d;
        let (mut low, mut high) = (q[0] - reach, q[0] + reach);
        for _ in 0..60 {
            let f = self.elastic_forces(&q);
            if f[0] > f[1] {
                low = q[0]
            } else {
                high = q[0]
            }
            q[0] = 0.5 * (low + high);
        }
        let contact = self.geometry.contact(&q);
        let c = self.taken(&contact);
        let along: f64 = (0..2).map(|i| self.tips[i].curvature(c[i], 0.0, contact.tilt(i))[1][1]).sum();
        if along > 0.0 {
            q[1] += self.weight / along;
        }
        let f = self.elastic_forces(&q);
        let guess = self.at(q, [f[0], f[1], half, half]);
        self.equilibrium([0.0; 2], &guess).unwrap_or(Equilibrium { smallest_eigenvalue: f64::NAN, ..guess })
    }

    /// The place of the object at joint angles 0 at which both tips are pressed in by as much (m).
    fn middle(&self) -> f64 {
        let Geometry { base, radius, .. } = self.geometry;
        0.5 * (base[0][0] + radius[0] + base[1][0] - radius[1])
    }

    /// All that belongs to an equilibrium at `q`; `multipliers` are the forces of held rows.
    fn at(&self, q: Coordinates, multipliers: [f64; 4]) -> Equilibrium {
        let contact = self.geometry.contact(&q);
        let (mut f, moments) = self.forces(&contact);
        for k in 0..4 {
            if self.holds(k) {
                f[k] = multipliers[k];
            }
        }
        let pull = contact.pull(&f, &moments);
        Equilibrium {
            q,
            displacements: contact.displacements(),
            forces: f,
            torques: [pull[3], pull[4]],
            smallest_eigenvalue: self.smallest_eigenvalue(&q, &f),
        }
    }

    fn holds(&self, k: usize) -> bool {
        if k < 2 { self.holds_normal() } else { self.holds_tangent() }
    }

    /// The equilibrium at `joints` (rad) next to the pose and forces of `guess`: Newton's method on
    /// the energy with multipliers for held rows. None where it does not settle within a quarter of
    /// the radius.
    pub fn equilibrium(&self, joints: [f64; 2], guess: &Equilibrium) -> Option<Equilibrium> {
        let a = self.geometry.scale();
        let mut q = guess.q;
        [q[3], q[4]] = joints;
        let mut f = guess.forces;
        let mut closest = f64::INFINITY;
        for pass in 0..40 {
            let contact = self.geometry.contact(&q);
            let (elastic, moments) = self.forces(&contact);
            for k in (0..4).filter(|&k| !self.holds(k)) {
                f[k] = elastic[k];
            }
            let (pull, h, rows) = (contact.pull(&f, &moments), self.hessian(&q, &f), contact.jacobian());
            let c = contact.displacements();
            // (x, y, a theta) and a multiplier a row.
            let (mut m, mut right) = ([[0.0; 7]; 7], [0.0; 7]);
            for i in 0..3 {
                m[i][..3].copy_from_slice(&h[i]);
            }
            (right[0], right[1], right[2]) = (-pull[0], self.weight - pull[1], -pull[2] / a);
            for k in 0..4 {
                m[3 + k][3 + k] = if self.holds(k) { 0.0 } else { 1.0 };
                if self.holds(k) {
                    for (i, scale) in [1.0, 1.0, 1.0 / a].into_iter().enumerate() {
                        m[i][3 + k] = rows[k][i] * scale;
                        m[3 + k][i] = rows[k][i] * scale;
                    }
                    right[3 + k] = -c[k];
                }
            }
            let step = dense::solve(&m, &right)?;
            let length = (step[0] * step[0] + step[1] * step[1] + step[2] * step[2]).sqrt();
            let part = if length > 0.05 * a { 0.05 * a / length } else { 1.0 };
            q[0] += part * step[0];
            q[1] += part * step[1];
            q[2] += part * step[2] / a;
            for k in (0..4).filter(|&k| self.holds(k)) {
                f[k] += part * step[3 + k];
            }
            let away = (0..2).map(|k| (q[k] - guess.q[k]).abs()).fold(a * (q[2] - guess.q[2]).abs(), f64::max);
            if away.is_nan() || away >= 0.25 * a {
                return None;
            }
            // Rounding is reached when steps stop shrinking.
            if pass > 2 && length < 1e-12 * a && length >= 0.5 * closest || length == 0.0 {
                return Some(self.at(q, f));
            }
            closest = closest.min(length);
        }
        (closest < 1e-10 * a).then(|| self.at(q, f))
    }

    /// Follows the branch from `start` to `joints` (rad) in steps of at most `stride` (rad).
    ///
    /// # Errors
    /// [`Lost`] with the last equilibrium that holds, where the branch folds, or a tip leaves the
    /// object or the model's range; it never goes on to another branch.
    pub fn follow(
        &self,
        start: &Equilibrium,
        joints: [f64; 2],
        stride: f64,
    ) -> Result<Equilibrium, (Lost, Box<Equilibrium>)> {
        let mut here = *start;
        let from = [start.q[3], start.q[4]];
        let whole = (0..2).map(|i| (joints[i] - from[i]).abs()).fold(0.0, f64::max);
        if whole == 0.0 {
            return Ok(here);
        }
        let at = |done: f64| [0, 1].map(|i| from[i] + done * (joints[i] - from[i]));
        // Way of the pose (x, y, a theta) from one equilibrium to the next.
        let way = |from: &Equilibrium, to: &Equilibrium| {
            let turn = self.geometry.scale() * (to.q[2] - from.q[2]);
            [to.q[0] - from.q[0], to.q[1] - from.q[1], turn]
        };
        let length = |v: [f64; 3]| v.iter().map(|c| c * c).sum::<f64>().sqrt();
        let most = (stride / whole).min(1.0);
        let (mut done, mut part) = (0.0, most);
        // Pace here, as a way for the whole: from a tiny step, as a longer one's mean says little
        // where the branch bends.
        let tiny = 1e-6 / whole.max(1e-6);
        let pace = |here: &Equilibrium, done: f64| {
            let next = self.equilibrium(at(done + tiny), here)?;
            Some(way(here, &next).map(|v| v / tiny))
        };
        let Some(mut speed) = pace(&here, 0.0) else { return Err((Lost::Fold, Box::new(here))) };
        let mut of_here = true;
        while done < 1.0 {
            // No crumb of a step is left for the end: its way would be all rounding.
            let next = if done + part > 1.0 - 1e-6 { 1.0 } else { done + part };
            let step = next - done;
            let found = self.equilibrium(at(next), &here).filter(|e| e.smallest_eigenvalue > 0.0);
            // A branch that is followed goes on as it went: another one, or a fold ahead, shows as
            // a change of pace.
            let same = found.filter(|e| {
                let moved = way(&here, e);
                let off = std::array::from_fn(|k| moved[k] - speed[k] * step);
                length(off) <= 0.5 * step * (length(speed) + self.geometry.link[0] * whole)
            });
            let Some(equilibrium) = same else {
                if !of_here {
                    let Some(now) = pace(&here, done) else { return Err((Lost::Fold, Box::new(here))) };
                    (speed, of_here) = (now, true);
                    continue;
                }
                part = 0.5 * step;
                if part * whole < 1e-8 {
                    return Err((Lost::Fold, Box::new(here)));
                }
                continue;
            };
            if let Some(lost) = self.out_of_range(&equilibrium.q) {
                return Err((lost, Box::new(here)));
            }
            (speed, of_here) = (way(&here, &equilibrium).map(|v| v / step), false);
            here = equilibrium;
            done = next;
            part = (2.0 * step).min(most);
        }
        Ok(here)
    }

    /// The first tip that has left the object or the model's range at `q`.
    pub(crate) fn out_of_range(&self, q: &Coordinates) -> Option<Lost> {
        if self.holds_normal() {
            return None;
        }
        let contact = self.geometry.contact(q);
        (0..2).find_map(|i| match contact.normal[i] {
            d if in_range(self.geometry.radius[i], d, contact.tilt(i).sin) => None,
            d if d > 0.0 => Some(Lost::Range(i)),
            _ => Some(Lost::Contact(i)),
        })
    }
}
