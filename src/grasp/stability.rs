//! How the energy lies about the equilibria of the scene's postures: stationary poses, Hessians,
//! their classes, and surfaces.
//!
//! Each model is judged at its own stationary pose next to the parallel model's equilibrium: with
//! friction that holds, without friction, and without friction and weight. Where there is none
//! within a radius, the result says so.

use crate::grasp::models::{Curvature, Gradient, Tilt, Tip, in_range, tips_of};
use crate::grasp::statics::{Equilibrium, Statics};
use crate::numerics::dense::solve;
use crate::types::grasp::{EnergySurface, Hold, Stability, StabilityRow};
use crate::types::{FingertipModel, Scene};

/// Eigenvalue over the largest up to which it is zero.
const ZERO_EIGENVALUE_RATIO: f64 = 1e-9;
/// Points along each side of an energy surface.
const POINTS_PER_SIDE: usize = 41;
/// Models that are compared.
pub(crate) const COMPARED_MODELS: [FingertipModel; 2] = [FingertipModel::Parallel, FingertipModel::Radial];

/// The equilibria of the pinch (step 0) and of each motion's target, on the branch from the pinch,
/// with the model `model`; where one cannot be reached, the reason.
pub fn postures(scene: &Scene, model: FingertipModel) -> Vec<(usize, [f64; 2], Result<Equilibrium, String>)> {
    let tips = tips_of(scene, model);
    let statics = Statics::of(scene, [tips[0].as_ref(), tips[1].as_ref()]);
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
///
/// ```
/// use palpate::grasp::stability::classify;
/// use palpate::types::grasp::Stability;
/// assert_eq!(classify(&[0.5, 2.0]), Stability::Minimum);
/// assert_eq!(classify(&[-0.5, 2.0]), Stability::Saddle);
/// ```
pub fn classify(eigenvalues: &[f64]) -> Stability {
    let largest = eigenvalues.iter().fold(0.0, |l: f64, v| l.max(v.abs()));
    let [low, high] = match eigenvalues {
        [] => return Stability::None,
        [one] => [*one, *one],
        [low, .., high] => [*low, *high],
    };
    let zero = ZERO_EIGENVALUE_RATIO * largest;
    match () {
        () if low > zero => Stability::Minimum,
        () if high < -zero => Stability::Maximum,
        () if low < -zero && high > zero => Stability::Saddle,
        () => Stability::Neutral,
    }
}

/// A tip on a face without friction: its springs along the face are as long as they like.
#[derive(Debug, Clone, Copy)]
struct Frictionless<'a>(&'a dyn Tip);

impl Frictionless<'_> {
    /// d_t at which the energy, at most quadratic in it, is least (m).
    fn relaxed(&self, d: f64, tilt: Tilt) -> f64 {
        let spring = self.0.curvature(d, 0.0, tilt)[1][1];
        if spring > 0.0 { -self.0.gradient(d, 0.0, tilt).tangential / spring } else { 0.0 }
    }
}

impl Tip for Frictionless<'_> {
    fn holds_tangent(&self) -> bool {
        false
    }

    fn energy(&self, d: f64, _d_t: f64, tilt: Tilt) -> f64 {
        self.0.energy(d, self.relaxed(d, tilt), tilt)
    }

    fn gradient(&self, d: f64, _d_t: f64, tilt: Tilt) -> Gradient {
        Gradient { tangential: 0.0, ..self.0.gradient(d, self.relaxed(d, tilt), tilt) }
    }

    fn curvature(&self, d: f64, _d_t: f64, tilt: Tilt) -> Curvature {
        let k = self.0.curvature(d, self.relaxed(d, tilt), tilt);
        let mut out = [[0.0; 3]; 3];
        for i in [0, 2] {
            for j in [0, 2] {
                let given = if k[1][1] > 0.0 { k[i][1] * k[1][j] / k[1][1] } else { 0.0 };
                out[i][j] = k[i][j] - given;
            }
        }
        out
    }
}

/// The pose next to `from` at which the energy of an object between faces without friction is
/// stationary. Along the face the energy has no springs, so Newton's method goes across it and
/// around. None where it goes further than a radius, or a force along the face is left.
fn stationary(statics: &Statics<'_>, from: &Equilibrium) -> Option<Equilibrium> {
    let a = statics.geometry.scale();
    let mut q = from.q;
    for _ in 0..60 {
        let h = statics.hessian(&q, &statics.elastic_forces(&q));
        let g = statics.gradient(&q);
        let basis = [[q[2].cos(), q[2].sin(), 0.0], [0.0, 0.0, 1.0]];
        let product = |u: &[f64; 3], v: &[f64; 3]| -> f64 {
            (0..3).map(|i| (0..3).map(|j| u[i] * h[i][j] * v[j]).sum::<f64>()).sum()
        };
        let matrix = basis.map(|u| basis.map(|v| product(&u, &v)));
        let right = basis.map(|u| -(0..3).map(|k| u[k] * g[k]).sum::<f64>());
        let [across, turn] = solve(&matrix, &right)?;
        let length = across.hypot(turn);
        let part = if length > 0.05 * a { 0.05 * a / length } else { 1.0 };
        q[0] += part * across * basis[0][0];
        q[1] += part * across * basis[0][1];
        q[2] += part * turn / a;
        let away = [q[0] - from.q[0], q[1] - from.q[1], a * (q[2] - from.q[2])];
        if !away.iter().all(|v| v.abs() < a) {
            return None;
        }
        if length < 1e-13 * a {
            break;
        }
    }
    let left = statics.gradient(&q).iter().map(|v| v * v).sum::<f64>().sqrt();
    let rests = left <= 1e-9 * from.forces[0].abs().max(1e-9) && statics.out_of_range(&q).is_none();
    let displacements = statics.geometry.contact(&q).displacements();
    rests.then(|| Equilibrium { displacements, q, ..Equilibrium::default() })
}

/// The stationary poses next to `at` of the compared models with each hold, and what they are.
pub fn rows(scene: &Scene, step: usize, at: &Equilibrium) -> Vec<StabilityRow> {
    let row = |model, hold| {
        let tips = tips_of(scene, model);
        let bare = [tips[0].as_ref(), tips[1].as_ref()];
        let smooth = bare.map(Frictionless);
        let mut statics = match hold {
            Hold::Friction => Statics::of(scene, bare),
            _ => Statics::of(scene, [&smooth[0], &smooth[1]]),
        };
        if hold == Hold::Weightless {
            statics.weight = 0.0;
        }
        let found = match hold {
            Hold::Friction => statics.equilibrium([at.q[3], at.q[4]], at),
            _ => stationary(&statics, at),
        };
        let mut row = StabilityRow {
            step,
            joints: [at.q[3], at.q[4]],
            model,
            hold,
            pose: None,
            normal: None,
            distance: None,
            eigenvalues: Vec::new(),
            residual: None,
            class: Stability::None,
        };
        if let Some(e) = found {
            let forces = if hold == Hold::Friction { e.forces } else { statics.elastic_forces(&e.q) };
            let away = [e.q[0] - at.q[0], e.q[1] - at.q[1], statics.geometry.scale() * (e.q[2] - at.q[2])];
            row.pose = Some([e.q[0], e.q[1], e.q[2]]);
            row.normal = Some([e.displacements[0], e.displacements[1]]);
            row.distance = Some(away.iter().map(|v| v * v).sum::<f64>().sqrt());
            row.residual = Some(statics.residual(&e.q, &forces));
            row.eigenvalues = statics.free_eigenvalues(&e.q, &forces);
            row.class = classify(&row.eigenvalues);
        }
        row
    };
    Hold::ALL.iter().flat_map(|hold| COMPARED_MODELS.map(|model| row(model, *hold))).collect()
}

/// Energy over (theta, y) and (theta, x) about `at`, joints and the third coordinate fixed, for the
/// compared models.
pub fn surfaces(scene: &Scene, step: usize, at: &Equilibrium) -> Vec<EnergySurface> {
    let radius = scene.fingertips().map(|tip| tip.radius);
    let a = radius[0];
    let least = at.displacements[0].min(at.displacements[1]);
    // theta to 12 degrees, y to a fifth of the radius, x until a tip leaves.
    let sides = [("y", 1, 0.2 * a), ("x", 0, (0.95 * least).min(0.2 * a))];
    let steps = |half: f64| -> Vec<f64> {
        (0..POINTS_PER_SIDE).map(|i| half * (2.0 * i as f64 / (POINTS_PER_SIDE - 1) as f64 - 1.0)).collect()
    };
    let mut out = Vec::new();
    for model in COMPARED_MODELS {
        let tips = tips_of(scene, model);
        let statics = Statics::of(scene, [tips[0].as_ref(), tips[1].as_ref()]);
        let base = statics.energy(&at.q);
        for (axis, k, half) in sides {
            let (turns, moves) = (steps(12f64.to_radians()), steps(half));
            let mut energy = Vec::with_capacity(POINTS_PER_SIDE * POINTS_PER_SIDE);
            for other in &moves {
                for turn in &turns {
                    let mut q = at.q;
                    q[2] += turn;
                    q[k] += other;
                    let contact = statics.geometry.contact(&q);
                    let inside = (0..2).all(|i| in_range(radius[i], contact.normal[i], contact.tilt(i).sin));
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
