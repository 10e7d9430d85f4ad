//! How the energy lies about the equilibria of the scene's postures: Hessians, their classes, and
//! surfaces.
//!
//! The parallel model is judged at its own equilibria, the radial one at the same poses: without
//! tangential springs it has no equilibrium under gravity, so its gradient there is given too.

use crate::grasp::models::{in_range, tip_of};
use crate::grasp::statics::{Equilibrium, Statics};
use crate::numerics::dense::symmetric_eigen;
use crate::types::grasp::{EnergySurface, Stability, StabilityRow};
use crate::types::{FingertipModel, Scene};

/// Below this part of the largest eigenvalue an eigenvalue counts as zero.
const ZERO: f64 = 1e-9;
/// Points along each side of a surface.
const POINTS: usize = 41;
/// Models that are compared.
pub const COMPARED: [FingertipModel; 2] = [FingertipModel::Parallel, FingertipModel::Radial];

/// The equilibria of the pinch (step 0) and of each motion's target, on the branch from the pinch,
/// with the model `model`; where one cannot be reached, the reason.
pub fn postures(scene: &Scene, model: FingertipModel) -> Vec<(usize, [f64; 2], Result<Equilibrium, String>)> {
    let tip = tip_of(&scene.fingertip, model);
    let statics = Statics::new(scene, tip.as_ref());
    let pinch = statics.pinch(scene);
    let mut out = vec![(0, [0.0; 2], Ok(pinch))];
    for (i, motion) in scene.motions.iter().enumerate() {
        let found = statics.follow(&pinch, motion.target, 0.02).map_err(|(lost, last)| {
            let [a, b] = [last.q[3], last.q[4]].map(f64::to_degrees);
            format!("at joint angles {a:.2} and {b:.2} degrees {}", lost.words())
        });
        out.push((i + 1, motion.target, found));
    }
    out
}

/// What the eigenvalues of a Hessian mean, from the smallest to the largest.
pub fn classify(eigenvalues: &[f64; 3]) -> Stability {
    let largest = eigenvalues.iter().fold(0.0, |l: f64, v| l.max(v.abs()));
    let (low, high) = (eigenvalues[0], eigenvalues[2]);
    let zero = ZERO * largest;
    match () {
        () if low > zero => Stability::Minimum,
        () if high < -zero => Stability::Maximum,
        () if low < -zero && high > zero => Stability::Saddle,
        () => Stability::Neutral,
    }
}

/// Hessians of the compared models at `at`.
pub fn rows(scene: &Scene, step: usize, at: &Equilibrium) -> Vec<StabilityRow> {
    let row = |model| {
        let tip = tip_of(&scene.fingertip, model);
        let statics = Statics::new(scene, tip.as_ref());
        // No constraint is held here: the object is free, and only springs and gravity act.
        let gradient = statics.gradient(&at.q);
        let hessian = statics.hessian(&at.q, &statics.elastic_forces(&at.q));
        let eigenvalues = symmetric_eigen(&hessian).map(|pair| pair.0);
        let [d1, d2, ..] = at.displacements;
        StabilityRow {
            step,
            joints: [at.q[3], at.q[4]],
            model,
            pose: [at.q[0], at.q[1], at.q[2]],
            normal: [d1, d2],
            eigenvalues,
            residual: gradient.iter().map(|v| v * v).sum::<f64>().sqrt(),
            class: classify(&eigenvalues),
        }
    };
    COMPARED.map(row).to_vec()
}

/// Energy over (theta, y) and (theta, x) about `at`, joints and the third coordinate fixed, for the
/// compared models.
pub fn surfaces(scene: &Scene, step: usize, at: &Equilibrium) -> Vec<EnergySurface> {
    let a = scene.fingertip.radius;
    let least = at.displacements[0].min(at.displacements[1]);
    // theta to 12 degrees, y to a fifth of the radius, x until a tip leaves.
    let sides = [("y", 1, 0.2 * a), ("x", 0, (0.95 * least).min(0.2 * a))];
    let steps =
        |half: f64| -> Vec<f64> { (0..POINTS).map(|i| half * (2.0 * i as f64 / (POINTS - 1) as f64 - 1.0)).collect() };
    let mut out = Vec::new();
    for model in COMPARED {
        let tip = tip_of(&scene.fingertip, model);
        let statics = Statics::new(scene, tip.as_ref());
        let base = statics.energy(&at.q);
        for (axis, k, half) in sides {
            let (turns, moves) = (steps(12f64.to_radians()), steps(half));
            let mut energy = Vec::with_capacity(POINTS * POINTS);
            for other in &moves {
                for turn in &turns {
                    let mut q = at.q;
                    q[2] += turn;
                    q[k] += other;
                    let contact = statics.geometry.contact(&q);
                    let inside = (0..2).all(|i| in_range(a, contact.normal[i], contact.tilt(i).sin));
                    energy.push(if inside { statics.energy(&q) - base } else { f64::NAN });
                }
            }
            let theta = turns.iter().map(|t| at.q[2] + t).collect();
            let other = moves.iter().map(|o| at.q[k] + o).collect();
            out.push(EnergySurface { step, model, axis, theta, other, energy });
        }
    }
    out
}
