//! The minimal form with tips that relax: Maxwell branches beside the springs, as in layered skin.
//!
//! The branches follow the springs' force, area and all (quasi-linear viscoelasticity; Y. C. Fung,
//! Biomechanics, 1993). With f the springs' forces and moments at a contact, branch i carries
//! `g_i (f - p_i)` with `p_i' = (f - p_i) / tau_i`, g_i its modulus over the springs' and tau_i its
//! dashpot over its modulus. At rest p = f, so that equilibria are those of the springs alone.

use crate::grasp::constraints::Coordinates;
use crate::grasp::control::Inputs;
use crate::grasp::dynamics::{Plant, Reading};
use crate::grasp::integrators::{Form, System};
use crate::grasp::minimal;
use crate::grasp::models::Tip;
use crate::grasp::statics::Equilibrium;
use crate::types::grasp::ConstraintDrift;

/// Most branches of a tip.
pub(crate) const MAX_BRANCHES: usize = 3;
/// Forces and moments that a branch follows: d_n and d_t of both tips, and their tilts.
const BRANCH_ENTRIES: usize = 6;
/// Entries of a state: those of the minimal form, then what each branch follows.
pub(crate) const STATE: usize = minimal::STATE + MAX_BRANCHES * BRANCH_ENTRIES;

/// What the branches carry at a contact, and how they go on.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Carried {
    /// Forces (N) and moments (N m) of all branches together.
    pub forces: [f64; BRANCH_ENTRIES],
    /// Rates of what they follow.
    pub rates: [f64; MAX_BRANCHES * BRANCH_ENTRIES],
}

/// The branches of `plant`, which follow `p`, where the springs give the forces `f` (N) and
/// `moments` (N m).
#[inline(always)]
pub fn carried<T: Tip>(
    plant: &Plant<T>,
    f: &[f64; 4],
    moments: &[f64; 2],
    p: &[f64; MAX_BRANCHES * BRANCH_ENTRIES],
) -> Carried {
    let all = [f[0], f[1], f[2], f[3], moments[0], moments[1]];
    let mut out = Carried { forces: [0.0; BRANCH_ENTRIES], rates: [0.0; MAX_BRANCHES * BRANCH_ENTRIES] };
    for (i, [share, time]) in plant.branches.iter().enumerate() {
        for k in 0..BRANCH_ENTRIES {
            let behind = all[k] - p[i * BRANCH_ENTRIES + k];
            out.rates[i * BRANCH_ENTRIES + k] = behind / time;
            // A row that is held has no spring for a branch to stand beside.
            if k >= 4 || !plant.holds(k) {
                out.forces[k] += share * behind;
            }
        }
    }
    out
}

/// Power that goes into the branches at the rates `w` of the displacements and the velocity `v`
/// (W).
#[inline(always)]
pub fn taken(forces: &[f64; BRANCH_ENTRIES], w: &[f64; 4], v: &Coordinates) -> f64 {
    let tilts = [v[2] - v[3], -(v[2] + v[4])];
    (0..4).map(|k| forces[k] * w[k]).sum::<f64>() + forces[4] * tilts[0] + forces[5] * tilts[1]
}

/// What the branches of a state follow.
pub fn followed<const N: usize>(s: &[f64; N]) -> [f64; MAX_BRANCHES * BRANCH_ENTRIES] {
    std::array::from_fn(|k| s[minimal::STATE + k])
}

/// The minimal form of a plant whose tips relax.
#[derive(Debug, Clone)]
pub(crate) struct Relaxing<T>(pub Plant<T>);

impl<T: Tip> System<STATE> for Relaxing<T> {
    fn rate(&self, inputs: &Inputs, s: &[f64; STATE]) -> ([f64; STATE], Reading) {
        let plant = &self.0;
        let q: Coordinates = std::array::from_fn(|k| s[k]);
        let v: Coordinates = std::array::from_fn(|k| s[5 + k]);
        let contact = plant.geometry.contact(&q);
        let (d, w) = (contact.displacements(), contact.rates(&v));
        let (elastic, springs) = plant.contact_forces(&contact, &d, &[0.0; 4]);
        let carried = carried(plant, &elastic, &springs, &followed(s));
        let (mut f, _) = plant.contact_forces(&contact, &d, &w);
        (0..4).for_each(|k| f[k] += carried.forces[k]);
        let moments = [springs[0] + carried.forces[4], springs[1] + carried.forces[5]];
        let integral = [s[10], s[11]];
        let (a, torques) = plant.accelerations(inputs, &contact, &q, &v, &integral, &mut f, &moments, 0.0);
        let power = plant.power(inputs, &contact, &v, &torques, &w) - taken(&carried.forces, &w, &v);
        let mut rate = [0.0; STATE];
        rate[..5].copy_from_slice(&v);
        rate[5..10].copy_from_slice(&a);
        (rate[10], rate[11]) = (q[3] - inputs.desired[0], q[4] - inputs.desired[1]);
        rate[12] = power;
        rate[minimal::STATE..].copy_from_slice(&carried.rates);
        let sin_tilt = [contact.tilt(0).sin, contact.tilt(1).sin];
        (rate, Reading { displacements: d, forces: f, sin_tilt, places: contact.places() })
    }

    fn settle(&self, s: &mut [f64; STATE]) {
        if self.0.holds_any() {
            let (mut q, mut v) = (std::array::from_fn(|k| s[k]), std::array::from_fn(|k| s[5 + k]));
            self.0.settle(&mut q, &mut v);
            s[..5].copy_from_slice(&q);
            s[5..10].copy_from_slice(&v);
        }
    }
}

impl<T: Tip> Form<STATE> for Relaxing<T> {
    const WORK: usize = 12;
    type Tip = T;

    fn plant(&self) -> &Plant<T> {
        &self.0
    }

    fn set_origin(&mut self, origin: [f64; 2]) {
        self.0.geometry.origin = origin;
    }

    fn core(&self, s: &[f64; STATE]) -> [f64; STATE] {
        *s
    }

    fn with_core(&self, core: &[f64; STATE]) -> [f64; STATE] {
        *core
    }

    fn start(&self, e: &Equilibrium) -> [f64; STATE] {
        let mut s = [0.0; STATE];
        s[..5].copy_from_slice(&e.q);
        let contact = self.0.geometry.contact(&e.q);
        let (f, moments) = self.0.contact_forces(&contact, &contact.displacements(), &[0.0; 4]);
        let rest = [f[0], f[1], f[2], f[3], moments[0], moments[1]];
        for branch in s[minimal::STATE..].chunks_exact_mut(BRANCH_ENTRIES) {
            branch.copy_from_slice(&rest);
        }
        s
    }

    fn energy(&self, s: &[f64; STATE]) -> (f64, f64) {
        let (q, v) = (std::array::from_fn(|k| s[k]), std::array::from_fn(|k| s[5 + k]));
        let contact = self.0.geometry.contact(&q);
        self.0.energy(&contact, &q, &v, &contact.displacements())
    }

    fn drift(&self, s: &[f64; STATE]) -> ConstraintDrift {
        let (q, v): (Coordinates, Coordinates) = (std::array::from_fn(|k| s[k]), std::array::from_fn(|k| s[5 + k]));
        let contact = self.0.geometry.contact(&q);
        self.0.drift(&contact.displacements(), &contact.rates(&v))
    }
}
