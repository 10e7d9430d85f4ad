//! The grasp simulator against closed forms, springs summed one by one, convergence rates and
//! symmetries; and every named failure is found.

use palpate::error::GraspError;
use palpate::grasp::constraints::Geometry;
use palpate::grasp::control::{Inputs, Phase};
use palpate::grasp::dynamics::Plant;
use palpate::grasp::integrators::{Form, Rk4, SemiImplicitEuler, Stepper, System};
use palpate::grasp::minimal::Minimal;
use palpate::grasp::models::{Parallel, Tilt, Tip, exact_radial_energy, tip_of};
use palpate::grasp::multipliers::Multipliers;
use palpate::grasp::simulate::simulate;
use palpate::grasp::statics::{Lost, Statics};
use palpate::grasp::{degrees_of_freedom, pinch, stability, stepping};
use palpate::pipeline;
use palpate::types::grasp::{EventKind, GraspRun, Hold, PinchState, Sample, Stability};
use palpate::types::scene::{Formulation, Integrator, Method, Motion, Push, Rolling, Second, SweepCase};
use palpate::types::{FingertipModel, Scene};
use std::f64::consts::PI;

const E: f64 = 2.0e5;
const A: f64 = 0.020;

/// Numbers that look random, between -1 and 1, from SplitMix64.
fn noise(state: &mut u64) -> f64 {
    *state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let mut h = *state;
    h = (h ^ (h >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    h = (h ^ (h >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((h ^ (h >> 31)) >> 11) as f64 / (1u64 << 52) as f64 - 1.0
}

/// Nodes and weights of Gauss and Legendre on (-1, 1), by Newton's method.
fn gauss(n: usize) -> Vec<(f64, f64)> {
    (0..n)
        .map(|i| {
            let mut x = (PI * (i as f64 + 0.75) / (n as f64 + 0.5)).cos();
            let mut slope = 1.0;
            for _ in 0..50 {
                let (mut p0, mut p1) = (1.0, x);
                for k in 2..=n {
                    (p0, p1) = (p1, ((2 * k - 1) as f64 * x * p1 - (k - 1) as f64 * p0) / k as f64);
                }
                slope = n as f64 * (x * p1 - p0) / (x * x - 1.0);
                x -= p1 / slope;
            }
            (x, 2.0 / ((1.0 - x * x) * slope * slope))
        })
        .collect()
}

/// Energy of linear springs (stiffness E dS / L each) that stand on a hemisphere's back plate along
/// `axis` and are pressed by `d` against a face with the outward direction `normal` (from the tip
/// to the face), their feet dragged by `d_t` along `tangent`; all in the world frame, summed over
/// the cap that the face cuts off.
fn summed_springs(axis: [f64; 2], normal: [f64; 2], tangent: [f64; 2], d: f64, d_t: f64) -> f64 {
    summed_unlike_springs(axis, normal, tangent, d, d_t, &|_| E)
}

/// The same where Young's modulus depends on how far (m) a spring ends behind the foremost one,
/// along the axis.
fn summed_unlike_springs(
    axis: [f64; 2],
    normal: [f64; 2],
    tangent: [f64; 2],
    d: f64,
    d_t: f64,
    modulus: &impl Fn(f64) -> f64,
) -> f64 {
    let dot = |a: [f64; 2], b: [f64; 2]| a[0] * b[0] + a[1] * b[1];
    let side = [-normal[1], normal[0]];
    let (turns, rim) = (24, 1.0 - d / A);
    let mut energy = 0.0;
    for (x, weight) in gauss(12) {
        // Cosine of the angle from the normal, over the cap.
        let c = rim + 0.5 * (1.0 - rim) * (1.0 + x);
        let s = (1.0 - c * c).sqrt();
        for k in 0..turns {
            let turn = 2.0 * PI * f64::from(k) / f64::from(turns);
            // A point of the sphere; its third coordinate plays no part, as all motion is in the
            // plane.
            let u = [normal[0] * c + side[0] * s * turn.cos(), normal[1] * c + side[1] * s * turn.cos()];
            assert!(dot(u, axis) > 0.0, "a spring without length");
            let pressed = (A * dot(u, normal) - (A - d)) / dot(axis, normal);
            let foot = [d_t * tangent[0] - pressed * axis[0], d_t * tangent[1] - pressed * axis[1]];
            // dS / L = A dOmega, whatever the tilt.
            let solid_angle = 0.5 * (1.0 - rim) * weight * 2.0 * PI / f64::from(turns);
            energy += 0.5 * modulus(A * (1.0 - dot(u, axis))) * A * dot(foot, foot) * solid_angle;
        }
    }
    energy
}

fn relative(a: f64, b: f64) -> f64 {
    (a - b).abs() / b.abs().max(1e-300)
}

#[test]
fn closed_forms_are_the_exact_sums_of_springs() {
    let tip = Parallel { stiffness: PI * E };
    for d in [1e-4, 1.5e-3, 4e-3, 8e-3] {
        for tilt in [-0.5f64, -0.2, 0.0, 0.1, 0.35, 0.6] {
            if d >= A * (1.0 - tilt.sin().abs()) {
                continue;
            }
            for d_t in [-2e-3, 0.0, 1e-4, 1.5e-3] {
                // A back plate along x, and a face turned so that axis . tangent = -sin(tilt).
                let normal = [tilt.cos(), tilt.sin()];
                let tangent = [-normal[1], normal[0]];
                let summed = summed_springs([1.0, 0.0], normal, tangent, d, d_t);
                let closed = tip.energy(d, d_t, Tilt::of(tilt));
                assert!(relative(closed, summed) < 1e-10, "d {d}, d_t {d_t}, tilt {tilt}: {closed}, {summed}");
            }
        }
    }
}

#[test]
fn the_radial_energy_is_the_first_term_of_the_exact_one() {
    // Springs along radii: stiffness E dA / a on the cap's surface elements dA, pressed by a - (a -
    // d) / cos.
    for d in [1e-4, 1e-3, 4e-3] {
        let rim = 1.0 - d / A;
        let summed: f64 = gauss(40)
            .into_iter()
            .map(|(x, weight)| {
                let c = rim + 0.5 * (1.0 - rim) * (1.0 + x);
                let pressed = A - (A - d) / c;
                0.5 * E * A * pressed * pressed * 2.0 * PI * 0.5 * (1.0 - rim) * weight
            })
            .sum();
        let exact = exact_radial_energy(A, E, d);
        assert!(relative(exact, summed) < 1e-9, "{exact}, {summed}");
        let first = tip_of(&Scene::reference().fingertip, FingertipModel::Radial).energy(d, 0.0, Tilt::of(0.3));
        assert!(relative(first, exact) < 0.6 * d / A, "{d}: {first}, {exact}");
    }
}

/// A pose and joint angles near the middle of the reference scene.
fn some_coordinates(seed: &mut u64) -> [f64; 5] {
    let mut at = |middle: f64, spread: f64| middle + spread * noise(seed);
    [at(0.0, 4e-3), at(-0.058, 3e-3), at(0.0, 0.2), at(0.1, 0.15), at(0.1, 0.15)]
}

#[test]
fn springs_in_the_world_frame_settle_the_sign_of_the_tilt() {
    let geometry = Geometry::of(&Scene::reference());
    let tip = Parallel { stiffness: PI * E };
    let (mut seed, mut seen, mut worst_flipped) = (7, 0, 0.0f64);
    while seen < 200 {
        let q = some_coordinates(&mut seed);
        let contact = geometry.contact(&q);
        let (n, t) = ([q[2].cos(), q[2].sin()], [-q[2].sin(), q[2].cos()]);
        let axes = [[q[3].cos(), q[3].sin()], [-q[4].cos(), q[4].sin()]];
        let outward = [n, [-n[0], -n[1]]];
        for i in 0..2 {
            let (d, d_t, tilt) = (contact.normal[i], contact.tangential[i], contact.tilt(i));
            if !palpate::grasp::models::in_range(A, d, tilt.sin) || d < 1e-3 {
                continue;
            }
            seen += 1;
            let summed = summed_springs(axes[i], outward[i], t, d, d_t);
            let closed = tip.energy(d, d_t, tilt);
            assert!(relative(closed, summed) < 1e-10, "finger {}: {closed}, {summed}", i + 1);
            let flipped = tip.energy(d, d_t, Tilt { sin: -tilt.sin, ..tilt });
            worst_flipped = worst_flipped.max(relative(flipped, summed));
        }
    }
    assert!(worst_flipped > 0.1, "the sign would not matter: {worst_flipped}");
}

#[test]
fn a_face_that_moves_along_its_tangent_drags_both_tips_with_it() {
    let geometry = Geometry::of(&Scene::reference());
    let q = [0.0, -0.060, 0.0, 0.0, 0.0];
    let up = geometry.contact(&[0.0, -0.060 + 1e-4, 0.0, 0.0, 0.0]);
    assert!(up.tangential.iter().all(|d| (d - 1e-4).abs() < 1e-17), "{:?}", up.tangential);
    let closed = geometry.contact(&[0.0, -0.060, 0.0, 0.05, 0.05]);
    assert!((0..2).all(|i| closed.normal[i] > geometry.contact(&q).normal[i]), "positive angles close both fingers");
}

#[test]
fn derivatives_of_the_models_are_those_of_their_energies() {
    let scene = Scene::reference();
    let h = 1e-6;
    for (name, model) in FingertipModel::ALL {
        let tip = tip_of(&scene.fingertip, model);
        for (d, d_t, tilt) in [(3e-3, 1e-3, 0.3), (5e-3, -2e-3, -0.4), (1.5e-3, -2.6e-4, 0.0)] {
            let at = |k: usize, sign: f64| {
                let mut x = [d, d_t, tilt];
                x[k] += sign * h * [A, A, 1.0][k];
                x
            };
            let step = |k: usize| 2.0 * h * [A, A, 1.0][k];
            let g = |x: [f64; 3]| {
                let g = tip.gradient(x[0], x[1], Tilt::of(x[2]));
                [g.normal, g.tangential, g.moment]
            };
            let (gradient, curvature) = (g([d, d_t, tilt]), tip.curvature(d, d_t, Tilt::of(tilt)));
            let scale = [PI * E * d * d, PI * E * d * d, PI * E * d * d * A];
            for k in 0..3 {
                let energy = |x: [f64; 3]| tip.energy(x[0], x[1], Tilt::of(x[2]));
                let slope = (energy(at(k, 1.0)) - energy(at(k, -1.0))) / step(k);
                let held = k == 1 && tip.holds_tangent();
                if !held {
                    assert!((slope - gradient[k]).abs() < 1e-7 * scale[k], "{name} {k}: {slope}, {}", gradient[k]);
                }
                for m in (0..3).filter(|&m| !tip.holds_tangent() || (k != 1 && m != 1)) {
                    let slope = (g(at(k, 1.0))[m] - g(at(k, -1.0))[m]) / step(k);
                    let size = scale[m] / [A, A, 1.0][k];
                    assert!((slope - curvature[m][k]).abs() < 1e-6 * size.max(1e-12) * 10.0, "{name} {m}{k}");
                }
            }
        }
    }
}

#[test]
fn displacements_satisfy_the_constraints_of_the_source() {
    let scene = Scene::reference();
    let (geometry, half_width) = (Geometry::of(&scene), 0.03);
    let mut seed = 3;
    for _ in 0..50 {
        let q @ [x, y, theta, t1, t2] = some_coordinates(&mut seed);
        let contact = geometry.contact(&q);
        let (s, c) = theta.sin_cos();
        let o1 = [-0.0485 + 0.06 * t1.sin(), -0.06 * t1.cos()];
        let o2 = [0.0485 - 0.06 * t2.sin(), -0.06 * t2.cos()];
        let h1 = -(x - o1[0]) * c - (y - o1[1]) * s + (A - contact.normal[0]) + half_width;
        let h2 = (x - o2[0]) * c + (y - o2[1]) * s + (A - contact.normal[1]) + half_width;
        let s1 = -(o1[0] - x) * s + (o1[1] - y) * c;
        let s2 = -(o2[0] - x) * s + (o2[1] - y) * c;
        let n1 = s1 + A * (t1 - theta) + contact.tangential[0];
        let n2 = s2 + A * (t2 + theta) + contact.tangential[1];
        assert!([h1, h2, n1, n2].iter().all(|v| v.abs() < 1e-15), "{h1} {h2} {n1} {n2}");
        let tips = geometry.tips([t1, t2]);
        assert!((0..2).all(|k| (tips[0][k] - o1[k]).abs() < 1e-16 && (tips[1][k] - o2[k]).abs() < 1e-16));
    }
}

#[test]
fn jacobian_and_its_rate_are_derivatives_of_the_displacements() {
    let geometry = Geometry::of(&Scene::reference());
    let (mut seed, h) = (11, 1e-6);
    for _ in 0..20 {
        let q = some_coordinates(&mut seed);
        let v: [f64; 5] = std::array::from_fn(|_| noise(&mut seed));
        let contact = geometry.contact(&q);
        let rows = contact.jacobian();
        for k in 0..5 {
            let moved = |sign: f64| {
                let mut p = q;
                p[k] += sign * h;
                geometry.contact(&p).displacements()
            };
            let (up, down) = (moved(1.0), moved(-1.0));
            for row in 0..4 {
                assert!((rows[row][k] - (up[row] - down[row]) / (2.0 * h)).abs() < 1e-9, "{row} {k}");
            }
        }
        // Along the motion q + v s the second derivative is J' v.
        let h = 1e-4;
        let along = |s: f64| geometry.contact(&std::array::from_fn(|k| q[k] + s * v[k])).displacements();
        let (rates, bias) = (contact.rates(&v), contact.acceleration_bias(&v));
        for row in 0..4 {
            let by_rows: f64 = (0..5).map(|k| rows[row][k] * v[k]).sum();
            assert!((rates[row] - by_rows).abs() < 1e-15);
            let second = (along(h)[row] - 2.0 * along(0.0)[row] + along(-h)[row]) / (h * h);
            assert!((bias[row] - second).abs() < 1e-6, "{row}: {}, {second}", bias[row]);
        }
    }
}

#[test]
fn the_hessian_is_the_second_derivative_of_the_energy() {
    let scene = Scene::reference();
    let tip = tip_of(&scene.fingertip, FingertipModel::Parallel);
    let statics = Statics::new(&scene, tip.as_ref());
    let q = [2e-3, -0.057, 0.1, 0.15, 0.08];
    let hessian = statics.hessian(&q, &statics.elastic_forces(&q));
    for k in 0..3 {
        let scale = [1.0, 1.0, 1.0 / A][k];
        let moved = |sign: f64| {
            let mut p = q;
            p[k] += sign * 1e-6 * scale;
            statics.gradient(&p)
        };
        let (up, down) = (moved(1.0), moved(-1.0));
        for m in 0..3 {
            let slope = (up[m] - down[m]) / 2e-6;
            assert!((slope - hessian[m][k]).abs() < 1e-4 * hessian[2][2], "{m} {k}: {slope}, {}", hessian[m][k]);
        }
        let energy = |sign: f64| {
            let mut p = q;
            p[k] += sign * 1e-6 * scale;
            statics.energy(&p)
        };
        let slope = (energy(1.0) - energy(-1.0)) / 2e-6;
        assert!((slope - statics.gradient(&q)[k]).abs() < 1e-6, "{k}: {slope}");
    }
}

/// A short scene: a rest and one motion.
fn short() -> Scene {
    let mut scene = Scene::reference();
    scene.initial.rest = 0.05;
    scene.motions = vec![Motion { target: [8f64.to_radians(), 2f64.to_radians()], duration: 0.2, hold: 0.15 }];
    scene
}

fn run(scene: &Scene) -> GraspRun {
    let run = simulate(scene, &|_| {}).unwrap();
    assert!(run.samples.iter().all(|s| s.row().iter().all(|v| v.is_finite())), "a sample that is not finite");
    run
}

/// Largest difference in pose and joint angles (m, rad).
fn apart(a: &[Sample], b: &[Sample]) -> f64 {
    assert_eq!(a.len(), b.len());
    let pairs = a.iter().zip(b).map(|(a, b)| (a.row(), b.row()));
    pairs.flat_map(|(a, b)| (1..6).map(move |k| (a[k] - b[k]).abs())).fold(0.0, f64::max)
}

#[test]
fn the_run_starts_in_the_closed_form_and_stays_there() {
    let scene = Scene::reference();
    let (d, weight) = (scene.initial.normal_displacement, 0.10 * 9.81);
    let y = -0.06 - weight / (4.0 * PI * E * d);
    let tip = tip_of(&scene.fingertip, FingertipModel::Parallel);
    let statics = Statics::new(&scene, tip.as_ref());
    let mut guess = statics.pinch(&scene);
    assert!((guess.q[1] - y).abs() < 1e-15);
    (guess.q[0], guess.q[1], guess.q[2]) = (3e-4, y + 5e-4, 0.01);
    let found = statics.equilibrium([0.0; 2], &guess).unwrap();
    assert!(found.q[0].abs() < 1e-12 && (found.q[1] - y).abs() < 1e-12 && found.q[2].abs() < 1e-12, "{:?}", found.q);
    assert!((0..2).all(|i| (found.forces[2 + i].abs() - 0.5 * weight).abs() < 1e-9));
    assert!((0..2).all(|i| (found.displacements[2 + i] - (y + 0.06)).abs() < 1e-12));
    let rest = run(&Scene { motions: Vec::new(), ..scene });
    for s in &rest.samples {
        assert!((s.pose[1] - y).abs() < 1e-12 && s.pose[0].abs() < 1e-12 && s.pose[2].abs() < 1e-12);
    }
    assert!(rest.completed && rest.samples.len() == 51);
}

#[test]
fn the_eight_motions_reach_the_equilibria_of_their_joint_angles() {
    let scene = Scene::reference();
    let result = run(&scene);
    assert!(result.completed && result.events.is_empty() && result.motions.len() == 9, "{:?}", result.events);
    for (step, _, found) in stability::postures(&scene, FingertipModel::Parallel) {
        let (reached, found) = (result.motions[step].reached, found.unwrap());
        for k in 0..3 {
            assert!((reached.pose[k] - found.q[k]).abs() < 2e-5, "motion {step}: {:?}, {:?}", reached.pose, found.q);
        }
    }
}

#[test]
fn mirrored_motions_mirror_each_other() {
    let one = short();
    let mut other = one.clone();
    other.motions[0].target.reverse();
    for (model, formulation) in [
        (FingertipModel::Parallel, Formulation::Minimal),
        (FingertipModel::Parallel, Formulation::Multipliers),
        (FingertipModel::ParallelNormal, Formulation::Minimal),
    ] {
        let with = |s: &Scene| {
            let mut s = s.clone();
            (s.fingertip.model, s.integrator.formulation) = (model, formulation);
            run(&s)
        };
        let (a, b) = (with(&one), with(&other));
        assert!(a.samples.iter().any(|s| s.pose[2].abs() > 0.05), "the object must turn");
        for (a, b) in a.samples.iter().zip(&b.samples) {
            let off = [a.pose[0] + b.pose[0], a.pose[1] - b.pose[1], a.pose[2] + b.pose[2], a.normal[0] - b.normal[1]];
            assert!(off.iter().all(|v| v.abs() < 1e-12), "{off:?}");
        }
    }
    // Motions 2 and 4, 5 and 6 of the source, at rest.
    let postures = stability::postures(&Scene::reference(), FingertipModel::Parallel);
    for (a, b) in [(2, 4), (5, 6)] {
        let [p, q] = [a, b].map(|i: usize| postures[i].2.as_ref().unwrap().q);
        assert!((p[0] + q[0]).abs() < 1e-12 && (p[1] - q[1]).abs() < 1e-12 && (p[2] + q[2]).abs() < 1e-12);
    }
}

#[test]
fn orders_of_the_integrators() {
    let mut exact = short();
    exact.integrator.method = Method::Adaptive;
    exact.integrator.tolerance = 1e-13;
    for formulation in [Formulation::Minimal, Formulation::Multipliers] {
        exact.integrator.formulation = formulation;
        let reference = run(&exact).samples;
        for (method, order, steps) in
            [(Method::Rk4, 4.0, [5e-4, 2.5e-4, 1.25e-4]), (Method::SemiImplicitEuler, 1.0, [5e-4, 2.5e-4, 1.25e-4])]
        {
            let errors = steps.map(|step| {
                let mut scene = exact.clone();
                (scene.integrator.method, scene.integrator.step) = (method, step);
                apart(&run(&scene).samples, &reference)
            });
            for pair in errors.windows(2) {
                let measured = (pair[0] / pair[1]).log2();
                assert!((measured - order).abs() < 0.25, "{} {}: {errors:?}", method.name(), formulation.name());
            }
        }
    }
}

#[test]
fn undamped_energy_is_kept() {
    for fixed in [true, false] {
        let mut scene = Scene::reference();
        scene.motions.clear();
        scene.initial.joints = [6f64.to_radians(); 2];
        scene.initial.rest = 5.0;
        scene.fingertip.damping = [0.0; 2];
        scene.finger.fixed = fixed;
        (scene.finger.gains.kd, scene.finger.gains.ki) = (0.0, 0.0);
        scene.integrator.step = 2.5e-4;
        scene.pushes = vec![Push { start: 0.0, duration: 0.02, force: [4.0, 0.0], at: [0.0, -0.03] }];
        let result = run(&scene);
        let moved = result.samples.iter().map(|s| s.pose[2].abs()).fold(0.0, f64::max);
        assert!(result.completed && moved > 2e-3, "{moved}");
        assert!(result.energy_drift < 1e-4, "{}", result.energy_drift);
        assert!(result.energy_drift > 0.0);
    }
}

#[test]
fn the_two_formulations_agree() {
    // At a state that satisfies the constraints, the accelerations are the same to rounding.
    let scene = Scene::reference();
    let tip = Parallel { stiffness: PI * E };
    let start = Statics::new(&scene, &tip).pinch(&scene);
    let plant = Plant::new(&scene, tip, &start);
    let minimal = Minimal(plant.clone());
    let multipliers = Multipliers { plant, gain: 100.0, rolling: Rolling::Integrated };
    let inputs = Inputs { desired: [0.1, 0.05], rates: [0.2, -0.1], force: [1.0, 2.0], moment: [0.02, 0.01] };
    let mut seed = 5;
    for _ in 0..50 {
        let mut small = [0.0; 13];
        small[..5].copy_from_slice(&some_coordinates(&mut seed));
        (0..7).for_each(|k| small[5 + k] = 0.1 * noise(&mut seed));
        let contact = Geometry::of(&scene).contact(&std::array::from_fn(|k| small[k]));
        let mut large = [0.0; 21];
        large[..13].copy_from_slice(&small);
        large[13..17].copy_from_slice(&contact.displacements());
        large[17..].copy_from_slice(&contact.rates(&std::array::from_fn(|k| small[5 + k])));
        let (a, b) = (minimal.rate(&inputs, &small).0, multipliers.rate(&inputs, &large).0);
        assert!((0..13).all(|k| (a[k] - b[k]).abs() <= 1e-12 * a[k].abs().max(1.0)), "{a:?} {b:?}");
    }
    // Over the whole reference scene: with error control, and with a fixed step that resolves it.
    for (method, step) in [(Method::Adaptive, 1e-3), (Method::Rk4, 2.5e-4)] {
        let with = |formulation| {
            let mut scene = Scene::reference();
            (scene.integrator.method, scene.integrator.step) = (method, step);
            scene.integrator.formulation = formulation;
            run(&scene)
        };
        let (a, b) = (with(Formulation::Minimal), with(Formulation::Multipliers));
        assert!(a.completed && b.completed);
        let off = apart(&a.samples, &b.samples);
        assert!(off < 1e-10 && off > 0.0, "{}: {off}", method.name());
    }
}

#[test]
fn constraints_hold_with_a_proper_gain_and_drift_with_an_improper_one() {
    let with = |gain: f64, rolling: Rolling| {
        let mut scene = Scene::reference();
        scene.integrator = Integrator {
            formulation: Formulation::Multipliers,
            step: 2.5e-4,
            baumgarte: gain,
            rolling,
            ..scene.integrator
        };
        run(&scene).constraint_drift
    };
    let proper = with(100.0, Rolling::Integrated);
    assert!(proper.normal < 1e-12 && proper.rolling < 1e-12, "{proper:?}");
    // Too low to bring back what is lost, and so high that it feeds the steps' own error.
    for gain in [1e-3, 8000.0] {
        let improper = with(gain, Rolling::Integrated);
        assert!(improper.rolling > 30.0 * proper.rolling, "{gain}: {improper:?}");
    }
    // Stabilised at velocity level alone, the rate is kept, but what the integral has lost it never
    // gets back: it adds up over the motions, where the integrated form forgets.
    let longer = |rolling: Rolling, rounds: usize| {
        let mut scene = Scene::reference();
        scene.motions = scene.motions.repeat(rounds);
        scene.integrator = Integrator { formulation: Formulation::Multipliers, rolling, ..scene.integrator };
        run(&scene).constraint_drift
    };
    let [once, often] = [1, 8].map(|rounds| longer(Rolling::Velocity, rounds));
    assert!(once.rolling_velocity < 1e-8 && often.rolling > 4.0 * once.rolling, "{once:?} {often:?}");
    let [once, often] = [1, 8].map(|rounds| longer(Rolling::Integrated, rounds));
    assert!(often.rolling < 1.5 * once.rolling, "{once:?} {often:?}");
}

#[test]
fn held_constraints_do_not_drift_in_the_minimal_form() {
    for model in [FingertipModel::ParallelNormal, FingertipModel::Radial, FingertipModel::Rigid] {
        let mut scene = short();
        scene.fingertip.model = model;
        let result = run(&scene);
        assert!(result.completed, "{:?}", result.events);
        let drift = result.constraint_drift;
        assert!(drift.normal.max(drift.rolling) < 1e-15 && drift.rolling_velocity < 1e-14, "{drift:?}");
        assert!(result.samples.iter().all(|s| s.tangential.iter().all(|d| d.abs() < 1e-15)));
    }
}

#[test]
fn joint_torques_do_not_know_the_pose() {
    let scene = Scene::reference();
    let tip = Parallel { stiffness: PI * E };
    let start = Statics::new(&scene, &tip).pinch(&scene);
    let plant = Plant::new(&scene, tip, &start);
    let torques = |pose: [f64; 3]| {
        let (q, v) = ([pose[0], pose[1], pose[2], 0.1, 0.2], [0.3, -0.2, 1.0, 0.1, 0.2]);
        let contact = plant.geometry.contact(&q);
        let mut f = [1.0, 2.0, 0.5, 0.1];
        let inputs = Inputs { desired: [0.12, 0.15], ..Inputs::default() };
        plant.accelerations(&inputs, &contact, &q, &v, &[1e-3, 2e-3], &mut f, &[0.0; 2], 0.0).1
    };
    assert_eq!(torques([0.0, -0.06, 0.0]), torques([0.01, -0.05, 0.3]));
    // -kp e - kd (rate) - ki (integral), beside the preload.
    let [a, b] = start.torques;
    let wanted = [a + 100.0 * 0.02 - 0.1 - 2000.0 * 1e-3, b - 100.0 * 0.05 - 0.2 - 2000.0 * 2e-3];
    let found = torques([0.0, -0.06, 0.0]);
    assert!((0..2).all(|i| (found[i] - wanted[i]).abs() < 1e-12), "{found:?}, {wanted:?}");
}

#[test]
fn a_push_turns_the_object_and_it_comes_back() {
    let scene = pipeline::grasp::pushed(&Scene::reference());
    let result = run(&scene);
    let first = result.samples[0].pose;
    let turn = result.samples.iter().map(|s| (s.pose[2] - first[2]).abs()).fold(0.0, f64::max);
    assert!(result.completed && result.events.is_empty() && turn > 1f64.to_radians(), "{turn} {:?}", result.events);
    let last = result.samples.last().unwrap();
    assert!((0..3).all(|k| (last.pose[k] - first[k]).abs() < 1e-9));
    assert!(result.samples.iter().all(|s| s.joints == result.samples[0].joints), "the joints are locked");
    // A push to the right below the centre turns the object counter-clockwise.
    let most = result.samples.iter().max_by(|a, b| a.pose[2].abs().total_cmp(&b.pose[2].abs())).unwrap();
    assert!(most.pose[2] > 0.0 && most.pose[0] > 0.0);
}

/// The first event that ends the run of the reference scene with these motions (degrees).
fn ends_with(motions: &[[f64; 2]], change: impl Fn(&mut Scene)) -> (EventKind, f64, Option<usize>, GraspRun) {
    let mut scene = Scene::reference();
    scene.motions =
        motions.iter().map(|m| Motion { target: m.map(f64::to_radians), duration: 0.5, hold: 1.0 }).collect();
    change(&mut scene);
    let result = run(&scene);
    assert!(!result.completed);
    let event = result.events.iter().find(|e| e.kind.ends_run()).unwrap().clone();
    let last = result.samples.last().unwrap().time;
    assert!(last <= event.time && event.last_valid.time <= event.time, "{event:?}");
    assert!(event.last_valid.normal.iter().all(|d| *d > 0.0), "{event:?}");
    (event.kind, event.time, event.finger, result)
}

#[test]
fn contact_loss_is_found_with_its_finger() {
    // Finger 1 is pulled away sideways by a push to the right; with both opened slowly the object
    // falls first.
    let push = |force: f64| {
        move |s: &mut Scene| {
            s.pushes = vec![Push { start: 0.1, duration: 0.2, force: [force, 0.0], at: [0.0, 0.0] }];
        }
    };
    let (kind, time, finger, _) = ends_with(&[], push(40.0));
    assert_eq!((kind, finger), (EventKind::ContactLoss, Some(1)));
    assert!(time > 0.1 && time < 0.3, "{time}");
    let (kind, _, finger, _) = ends_with(&[], push(-40.0));
    assert_eq!((kind, finger), (EventKind::ContactLoss, Some(2)));
    let (kind, ..) = ends_with(&[[-10.0, -10.0]], |_| {});
    assert!(matches!(kind, EventKind::ContactLoss | EventKind::Fold), "{kind:?}");
}

/// The reference scene with these motions (degrees) and a change.
fn with_motions(motions: &[[f64; 2]], change: impl Fn(&mut Scene)) -> GraspRun {
    let mut scene = Scene::reference();
    scene.motions =
        motions.iter().map(|m| Motion { target: m.map(f64::to_radians), duration: 0.5, hold: 1.0 }).collect();
    change(&mut scene);
    run(&scene)
}

#[test]
fn the_validity_range_is_found_and_the_run_goes_on() {
    let result = with_motions(&[[6.0, 6.0], [-15.0, 25.0], [6.0, 6.0]], |s| {
        s.fingertip.model = FingertipModel::ParallelNormal;
    });
    let event = result.flaw().unwrap();
    assert_eq!((event.kind, event.finger), (EventKind::ValidityRange, Some(2)));
    assert!(result.completed && result.outcome() == "validity-range" && result.motions.len() == 4);
    // It leaves the range on the way to the second motion and comes back on the way to the third.
    assert!(event.time > 2.0 && event.until.unwrap() > 3.5, "{event:?}");
}

#[test]
fn slip_is_found_and_the_run_goes_on() {
    let mut scene = Scene::reference();
    scene.object.friction = None;
    let free = run(&scene);
    assert!(free.events.is_empty() && free.samples.iter().all(|s| s.friction_margin == 1.0 && s.slip == [0.0; 2]));
    // Motion 7 needs the most: a little more than the largest is as good as no limit.
    let most = free.required_friction;
    assert!(most > 0.6 && most < 0.7, "{most}");
    scene.object.friction = Some(1.001 * most);
    let held = run(&scene);
    assert!(held.events.is_empty() && held.outcome() == "held");
    assert_eq!(apart(&held.samples, &free.samples), 0.0);
    // At the pinch |f_t / f_n| is 0.34; motions 2 and 7 need 0.56 and 0.65.
    scene.object.friction = Some(0.5);
    let result = run(&scene);
    assert!(result.completed && result.motions.len() == 9 && result.outcome() == "slip", "{:?}", result.events);
    assert!(result.events.iter().all(|e| e.kind == EventKind::Slip));
    assert!(result.events.iter().any(|e| e.time > 2.0 && e.time < 2.5));
    assert!(result.samples.iter().all(|s| s.required_friction <= 0.5 + 1e-12 && s.friction_margin >= -1e-12));
    scene.object.friction = Some(0.3);
    let falls = run(&scene);
    assert_eq!(falls.events[0].time, 0.0);
    assert_eq!(falls.outcome(), "contact-loss", "nothing holds it up");
}

#[test]
fn the_branch_folds_for_narrow_objects_on_the_way_to_motion_7() {
    for width in [0.050, 0.045] {
        let result = run(&Scene::reference().with_width(width));
        let event = result.events.iter().find(|e| e.kind == EventKind::Fold).unwrap();
        assert_eq!(event.finger, None);
        // Motion 7 starts at 9.5 s; motions 1 to 6 are done.
        assert!(event.time > 9.5 && event.time < 11.0, "{}", event.time);
        println!(
            "width {width}: {:?}",
            result.events.iter().map(|e| (e.kind, e.time, e.until, &e.what)).collect::<Vec<_>>()
        );
        let postures = stability::postures(&Scene::reference().with_width(width), FingertipModel::Parallel);
        assert!(postures[7].2.is_err() && postures[6].2.is_ok());
    }
    let wide = run(&Scene::reference().with_width(0.055));
    assert!(wide.completed && wide.events.is_empty());
    // The smallest eigenvalue falls towards the fold.
    let scene = Scene::reference().with_width(0.050);
    let tip = tip_of(&scene.fingertip, FingertipModel::Parallel);
    let statics = Statics::new(&scene, tip.as_ref());
    let pinch = statics.pinch(&scene);
    let folds = [0.05, 0.02, 0.005].map(|stride| {
        let (lost, last) = statics.follow(&pinch, [-15f64.to_radians(), 25f64.to_radians()], stride).unwrap_err();
        assert_eq!(lost, Lost::Fold);
        assert!(last.smallest_eigenvalue > 0.0 && last.smallest_eigenvalue < 0.01 * pinch.smallest_eigenvalue);
        last.q[4]
    });
    // Where it is does not depend on the stride.
    assert!(folds.iter().all(|at| (at - folds[0]).abs() < 1e-5), "{folds:?}");
}

/// Joints that open a little for 40 ms pass angles without an equilibrium, and the static criterion
/// ended the run at 0.14 s; by the equations of motion the tips keep their hold.
#[test]
fn a_fold_that_is_passed_quickly_does_not_end_a_run() {
    let mut scene = Scene::reference();
    scene.initial.rest = 0.1;
    scene.object.friction = None;
    let motion = |t: f64, duration: f64, hold: f64| Motion { target: [t.to_radians(); 2], duration, hold };
    scene.motions = vec![motion(-1.0, 0.04, 0.0), motion(3.0, 0.1, 1.0)];
    let result = run(&scene);
    let least = result.samples.iter().flat_map(|s| s.normal).fold(f64::INFINITY, f64::min);
    assert!(result.completed && result.motions.len() == 3, "{:?}", result.events);
    assert!(least > 1e-4, "{least}");
    let fold = result.flaw().unwrap();
    assert_eq!((fold.kind, result.outcome()), (EventKind::Fold, "fold"));
    assert!(fold.time < fold.until.unwrap() && fold.until.unwrap() < 0.3, "{fold:?}");
    // The same by the reference integrator.
    (scene.integrator.method, scene.integrator.tolerance) = (Method::Adaptive, 1e-12);
    assert!(apart(&result.samples, &run(&scene).samples) < 1e-6);
}

/// A rest between fingers that are locked, with friction `mu`, until `end` (s).
fn locked(mu: f64, end: f64) -> Scene {
    let mut scene = Scene::reference();
    (scene.finger.fixed, scene.object.friction) = (true, Some(mu));
    (scene.initial.rest, scene.motions) = (end, Vec::new());
    scene
}

#[test]
fn a_sliding_object_falls_as_coulomb_says() {
    // f_n = pi E (d^2 + d_t^2) and f_t = 2 pi E d d_t = mu f_n on each side: d_t, and with it the
    // fall, is constant once the tips have given way.
    let mu = 0.2;
    let scene = locked(mu, 0.1);
    let (d, weight) = (scene.initial.normal_displacement, 0.10 * 9.81);
    let drag = d * (1.0 - (1.0 - mu * mu).sqrt()) / mu;
    let fall = (weight - 2.0 * mu * PI * E * (d * d + drag * drag)) / 0.10;
    assert!(fall > 1.0);
    for formulation in [Formulation::Minimal, Formulation::Multipliers] {
        let mut scene = scene.clone();
        (scene.integrator.formulation, scene.integrator.step) = (formulation, 2.5e-4);
        scene.integrator.output_every = 0.005;
        let samples = run(&scene).samples;
        assert!(samples.len() > 15, "{}", samples.len());
        for three in samples.windows(3).filter(|w| w[0].time > 0.07) {
            let second = (three[0].pose[1] - 2.0 * three[1].pose[1] + three[2].pose[1]) / (0.005f64 * 0.005);
            assert!((second + fall).abs() < 2e-3 * fall, "{}: {second}, {fall}", three[1].time);
            assert!((three[1].tangential[0] + drag).abs() < 1e-3 * drag);
            assert!((three[1].required_friction - mu).abs() < 1e-12);
            // What the face has moved is what the tips have given and slid.
            let slid = three[1].slip[0] + three[1].tangential[0] - samples[0].tangential[0];
            assert!((slid - (three[1].pose[1] - samples[0].pose[1])).abs() < 1e-12);
        }
    }
}

/// A vertical tug on an object between locked fingers, at small steps of its own: one height, one
/// d_t, and the law that a tip without mass slides by what friction does not hold.
fn tugged(scene: &Scene, steps: usize) -> Vec<[f64; 3]> {
    let Push { start, duration, force, .. } = scene.pushes[0];
    let (d, k, mu) = (scene.initial.normal_displacement, PI * E, scene.object.friction.unwrap());
    let (mass, c) = (scene.object.mass, scene.fingertip.damping[1]);
    let end = scene.duration();
    let h = end / steps as f64;
    let rate = |t: f64, [_, v, d_t, _]: [f64; 4]| {
        let f_n = k * (d * d + d_t * d_t);
        let stick = 2.0 * k * d * d_t + c * v;
        let f_t = stick.clamp(-mu * f_n, mu * f_n);
        let inside = t > start && t < start + duration;
        let pulse = if inside { force[1] * (PI * (t - start) / duration).sin() } else { 0.0 };
        let slide = (stick - f_t) / c;
        [v, (pulse - 2.0 * f_t) / mass + scene.gravity, v - slide, slide]
    };
    let d_t = scene.gravity * mass / (4.0 * k * d);
    let mut s = [0.0, 0.0, d_t, 0.0];
    let mut out = vec![[s[0], s[2], s[3]]];
    for n in 0..steps {
        let t = n as f64 * h;
        let along = |r: [f64; 4], f: f64| std::array::from_fn(|i| s[i] + f * h * r[i]);
        let k1 = rate(t, s);
        let k2 = rate(t + 0.5 * h, along(k1, 0.5));
        let k3 = rate(t + 0.5 * h, along(k2, 0.5));
        let k4 = rate(t + h, along(k3, 1.0));
        (0..4).for_each(|i| s[i] += h / 6.0 * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i]));
        out.push([s[0], s[2], s[3]]);
    }
    out
}

#[test]
fn a_tug_makes_the_tips_slide_and_stick_again() {
    let mut scene = locked(0.6, 0.6);
    scene.pushes = vec![Push { start: 0.1, duration: 0.2, force: [0.0, 3.4], at: [0.0; 2] }];
    let truth = tugged(&scene, 600_000);
    let slid = truth[600_000][2];
    assert!(slid > 1e-4, "the tug must make the tips slide: {slid}");
    let off = |scene: &Scene| {
        let result = run(scene);
        assert!(result.completed && result.outcome() == "slip");
        assert!(result.events.iter().all(|e| e.until.is_some()), "they stick again: {:?}", result.events);
        let at = |s: &Sample| truth[(s.time * 1e6).round() as usize];
        let y = result.samples[0].pose[1];
        let one = |s: &Sample| {
            let [dy, d_t, slip] = at(s);
            (s.pose[1] - y - dy).abs().max((s.tangential[0] - d_t).abs()).max((s.slip[1] - slip).abs())
        };
        (result.samples.iter().map(one).fold(0.0, f64::max), result.energy_drift)
    };
    // A kink of the rates costs a step's square; between kinks the order is the method's.
    let errors = [1e-3, 1.25e-4].map(|step| {
        scene.integrator.step = step;
        off(&scene).0
    });
    assert!(errors[0] < 1e-3 * slid && errors[1] < 0.1 * errors[0], "{errors:?} of {slid}");
    scene.integrator.formulation = Formulation::Multipliers;
    assert!(off(&scene).0 < 1e-4 * slid);
    scene.integrator.formulation = Formulation::Minimal;
    (scene.integrator.method, scene.integrator.tolerance) = (Method::Adaptive, 1e-10);
    let (error, drift) = off(&scene);
    assert!(error < 1e-5 * slid && drift < 1e-5, "{error} of {slid}, drift {drift}");
    scene.integrator.method = Method::SemiImplicitEuler;
    assert!(off(&scene).0 < 0.02 * slid);
}

#[test]
fn tips_without_damping_slide_too() {
    let mut scene = locked(0.6, 0.6);
    scene.pushes = vec![Push { start: 0.1, duration: 0.2, force: [0.0, 3.4], at: [0.0; 2] }];
    let slid = |c: f64, step: f64| {
        let mut scene = scene.clone();
        (scene.fingertip.damping, scene.integrator.step) = ([20.0, c], step);
        let result = run(&scene);
        let required = result.samples.iter().map(|s| s.required_friction).fold(0.0, f64::max);
        assert!((required - 0.6).abs() < 1e-9, "{required}");
        result.samples.last().unwrap().slip[0]
    };
    // Damped by what the spring takes up in half a step: the shorter, the less.
    let [coarse, middle, fine] = [4e-4, 1e-4, 2.5e-5].map(|step| slid(0.0, step));
    assert!(fine > 1e-4 && (middle - fine).abs() < 0.05 * fine, "{coarse} {middle} {fine}");
    assert!((middle - fine).abs() < 0.5 * (coarse - fine).abs(), "{coarse} {middle} {fine}");
}

#[test]
fn a_centre_of_mass_beside_the_plane_takes_of_the_friction() {
    // The ellipsoid (f_t / (mu f_n))^2 + (m / (mu f_n r))^2 = 1 with r = 8 c / 15, summed here over
    // the pressure of springs under a sphere: p = 1 - (rho / c)^2.
    let (mut force, mut torsion) = (0.0, 0.0);
    for i in 0..100_000 {
        let rho = (f64::from(i) + 0.5) / 1e5;
        let p = 1.0 - rho * rho;
        (force, torsion) = (force + p * rho, torsion + p * rho * rho);
    }
    assert!((torsion / force - 8.0 / 15.0).abs() < 1e-9);
    let mut scene = locked(1.0, 0.05);
    scene.object.offset = 0.004;
    let first = run(&scene).samples[0];
    let (d, weight) = (scene.initial.normal_displacement, 0.10 * 9.81);
    let radius = (d * (2.0 * A - d)).sqrt();
    let f_n = first.normal_force[0];
    let ellipse = |mu: f64| {
        let [along, spin] = [0.5 * weight / (mu * f_n), 0.5 * weight * 0.004 / (mu * f_n * 8.0 / 15.0 * radius)];
        along * along + spin * spin
    };
    assert!((ellipse(first.required_friction) - 1.0).abs() < 1e-9, "{}", first.required_friction);
    let plain = 0.5 * weight / f_n;
    assert!(first.required_friction > 1.2 * plain);
    // It holds just above that, and slides just below.
    for (part, outcome) in [(1.01, "held"), (0.98, "slip")] {
        scene.object.friction = Some(part * first.required_friction);
        assert_eq!(run(&scene).outcome(), outcome, "{part}");
    }
}

#[test]
fn an_object_that_slides_out_of_the_grasp_is_lost_at_the_end_of_its_face() {
    let mut scene = locked(0.2, 2.0);
    scene.object.height = 0.02;
    let result = run(&scene);
    let event = result.flaw().unwrap();
    assert_eq!((event.kind, result.completed), (EventKind::ContactLoss, false));
    assert!(event.what.contains("from the middle of its face"), "{}", event.what);
    let fallen = result.samples[0].pose[1] - event.last_valid.pose[1];
    assert!((fallen - 0.01).abs() < 1e-3, "{fallen}");
}

#[test]
fn tips_without_a_law_for_sliding_say_so() {
    for model in [FingertipModel::Radial, FingertipModel::ParallelNormal] {
        let mut scene = short();
        (scene.fingertip.model, scene.object.friction) = (model, Some(0.3));
        let result = run(&scene);
        let event = result.flaw().unwrap();
        assert!(event.kind == EventKind::Slip && event.what.contains("no law for sliding"), "{}", event.what);
        assert!(result.completed && result.outcome() == "slip");
    }
}

#[test]
fn a_step_that_is_too_long_is_refused_with_the_stable_one() {
    for (method, formulation) in [
        (Method::Rk4, Formulation::Minimal),
        (Method::SemiImplicitEuler, Formulation::Minimal),
        (Method::Rk4, Formulation::Multipliers),
        (Method::SemiImplicitEuler, Formulation::Multipliers),
    ] {
        let mut scene = short();
        scene.integrator = Integrator { method, formulation, step: 0.008, ..scene.integrator };
        let Err(GraspError::BadStep { stable, growth, .. }) = simulate(&scene, &|_| {}) else {
            panic!("{} {}", method.name(), formulation.name())
        };
        assert!(growth > 1.0 && stable < 0.008, "{growth} {stable}");
        // Just under the limit it runs; just above it is refused.
        scene.integrator.step = 0.98 * stable;
        assert!(simulate(&scene, &|_| {}).is_ok());
        // It is that of all postures; the start alone may bear a little more.
        scene.integrator.step = 1.3 * stable;
        let refused = match simulate(&scene, &|_| {}) {
            Err(error) => matches!(error, GraspError::BadStep { .. }),
            Ok(run) => run.events.iter().any(|e| e.kind == EventKind::BadStep),
        };
        assert!(refused, "{} {}", method.name(), formulation.name());
    }
}

/// Steps of the reference plant from a slightly disturbed pinch, without any watch: how far the
/// last state is from rest.
fn disturbed<P: Stepper>(step: f64, steps: usize) -> f64 {
    let scene = Scene::reference();
    let tip = Parallel { stiffness: PI * E };
    let start = Statics::new(&scene, &tip).pinch(&scene);
    let system = Minimal(Plant::new(&scene, tip, &start));
    let rest = system.start(&start);
    let mut state = rest;
    (0..5).for_each(|k| state[k] += 1e-9);
    for _ in 0..steps {
        state = P::step(&system, &Phase::hold([0.0; 2]), 0.0, step, &state).0;
    }
    let off = (0..5).map(|k| (state[k] - rest[k]).abs());
    off.fold(0.0, |m, v| if v.is_finite() { v.max(m) } else { f64::INFINITY })
}

#[test]
fn the_stable_step_is_where_disturbances_begin_to_grow() {
    let scene = Scene::reference();
    let tip = tip_of(&scene.fingertip, FingertipModel::Parallel);
    let pinch = Statics::new(&scene, tip.as_ref()).pinch(&scene);
    let limit = |method| stepping::stable_step(&scene, method, Formulation::Minimal, &[pinch]);
    let (rk4, euler) = (limit(Method::Rk4), limit(Method::SemiImplicitEuler));
    assert!(disturbed::<Rk4>(0.97 * rk4, 2000) < 1e-9);
    assert!(disturbed::<Rk4>(1.06 * rk4, 150) > 1e-7);
    assert!(disturbed::<SemiImplicitEuler>(0.97 * euler, 2000) < 1e-9);
    assert!(disturbed::<SemiImplicitEuler>(1.06 * euler, 150) > 1e-7);
}

#[test]
fn control_that_is_unstable_itself_is_not_blamed_on_the_step() {
    let mut scene = short();
    // kp kd / inertia = 1000 < ki: the integral wins.
    scene.finger.gains.kd = 0.01;
    let result = run(&scene);
    assert!(result.step_growth <= 1.0, "{}", result.step_growth);
    assert!(result.events.iter().all(|e| e.kind != EventKind::BadStep), "{:?}", result.events);
}

/// What blows up in each fiftieth of a step as well was taken for the grasp's own growth: 0.3 s
/// passed as stable, and so did 1 ms with fingers that need 0.014.
#[test]
fn steps_far_beyond_the_limit_are_refused_too() {
    for step in [5e-3, 0.05, 0.3, 1.0] {
        for method in [Method::Rk4, Method::SemiImplicitEuler] {
            let mut scene = short();
            (scene.integrator.step, scene.integrator.output_every, scene.integrator.method) = (step, 1.0, method);
            let result = simulate(&scene, &|_| {});
            assert!(matches!(result, Err(GraspError::BadStep { .. })), "{step} {method:?}");
        }
    }
    let mut light = short();
    (light.finger.inertia, light.integrator.step) = (5e-6, 1e-3);
    let Err(GraspError::BadStep { stable, .. }) = simulate(&light, &|_| {}) else { panic!() };
    assert!(stable < 1e-4, "{stable}");
    let mut tight = short();
    (tight.integrator.formulation, tight.integrator.baumgarte) = (Formulation::Multipliers, 3e5);
    assert!(matches!(simulate(&tight, &|_| {}), Err(GraspError::BadGain { .. })));
}

/// A tip whose springs are not alike began where alike ones would rest, and sank from there.
#[test]
fn a_tabulated_tip_begins_in_equilibrium() {
    let mut scene = short();
    scene.motions.clear();
    scene.fingertip.model = FingertipModel::Tabulated;
    scene.fingertip.profile = vec![[0.0, 0.25 * E], [1e-3, 0.5 * E], [2e-3, 2.0 * E]];
    scene.initial.rest = 0.5;
    let result = run(&scene);
    let [first, last] = [result.samples[0], result.samples[result.samples.len() - 1]];
    let half = 0.5 * scene.object.mass * scene.gravity;
    for i in 0..2 {
        assert!((first.tangential_force[i].abs() / half.abs() - 1.0).abs() < 1e-9, "{first:?}");
        assert!((first.pose[i] - last.pose[i]).abs() < 1e-9, "{first:?} {last:?}");
    }
    // Where springs are too soft all through, it is refused as tips of one modulus are.
    scene.fingertip.profile = vec![[0.0, 0.02 * E], [2e-3, 0.02 * E]];
    assert!(matches!(simulate(&scene, &|_| {}), Err(GraspError::NoStart { .. })));
}

#[test]
fn joints_that_stay_behind_and_profiles_that_end_or_are_not_used_are_said() {
    let mut scene = short();
    assert_eq!(pipeline::grasp::notes(&scene, &run(&scene)), Vec::<String>::new());
    scene.finger.gains.ki = 0.0;
    scene.finger.gains.kp = 2.0;
    let notes = pipeline::grasp::notes(&scene, &run(&scene));
    assert!(notes.len() == 1 && notes[0].contains("was told to be at"), "{notes:?}");
    let mut scene = short();
    scene.fingertip.model = FingertipModel::Tabulated;
    scene.fingertip.profile = vec![[0.0, E], [1e-3, E]];
    let notes = pipeline::grasp::notes(&scene, &run(&scene));
    assert!(notes.len() == 1 && notes[0].contains("ends at 1.00 mm"), "{notes:?}");
    // A profile that the model does not use was ignored without a word.
    scene.fingertip.model = FingertipModel::Parallel;
    let notes = pipeline::grasp::notes(&scene, &run(&scene));
    assert!(notes.len() == 1 && notes[0].contains("this one is parallel, of one modulus"), "{notes:?}");
}

#[test]
fn a_step_that_becomes_too_long_on_the_way_is_found() {
    // Stiff tips, light object, little damping: stable at the pinch, not when pressed more.
    let change = |s: &mut Scene| {
        s.fingertip.youngs_modulus = 2e6;
        s.fingertip.damping = [2.0; 2];
        s.object.friction = None;
        let tip = tip_of(&s.fingertip, FingertipModel::Parallel);
        let statics = Statics::new(s, tip.as_ref());
        let pinch = statics.pinch(s);
        let pressed = statics.follow(&pinch, [6f64.to_radians(); 2], 0.02).unwrap();
        let [loose, tight] =
            [pinch, pressed].map(|e| stepping::stable_step(s, Method::Rk4, Formulation::Minimal, &[e]));
        assert!(tight < 0.8 * loose, "{tight} {loose}");
        s.integrator.step = (tight * loose).sqrt();
    };
    let (kind, time, _, _) = ends_with(&[[6.0, 6.0]], change);
    assert_eq!(kind, EventKind::BadStep);
    assert!(time > 0.5, "{time}");
}

/// A step of 1.25e-4 s was advised, of the start alone and rounded up, and then failed.
#[test]
fn advice_in_refusals_works_when_it_is_followed() {
    let digits = |text: &str, after: &str| -> f64 {
        let rest = &text[text.find(after).unwrap_or_else(|| panic!("{after}: {text}")) + after.len()..];
        rest.trim_start().split([' ', ',', ';', ')']).next().unwrap().parse().unwrap()
    };
    for (modulus, damping, step) in [(2e5, 20.0, 5e-3), (2e6, 2.0, 5e-3), (5e6, 5.0, 2e-3), (2e5, 0.0, 1e-2)] {
        for method in [Method::Rk4, Method::SemiImplicitEuler] {
            let mut scene = Scene::reference();
            scene.motions.truncate(3);
            (scene.fingertip.youngs_modulus, scene.fingertip.damping) = (modulus, [damping; 2]);
            (scene.integrator.method, scene.integrator.step) = (method, step);
            let text = match simulate(&scene, &|_| {}) {
                Err(error) => error.to_string(),
                Ok(run) => run.flaw().unwrap().what.clone(),
            };
            scene.integrator.step = digits(&text, "integrator.step at or under");
            let followed = simulate(&scene, &|_| {}).unwrap().outcome();
            assert_ne!(followed, "bad-step", "{text}");
        }
    }
    let mut scene = short();
    (scene.integrator.formulation, scene.integrator.baumgarte) = (Formulation::Multipliers, 4321.0);
    let text = simulate(&scene, &|_| {}).unwrap_err().to_string();
    scene.integrator.baumgarte = digits(&text, "integrator.baumgarte at or under");
    assert!(simulate(&scene, &|_| {}).is_ok(), "{text}");
    // Too heavy: either way that is named holds it.
    let mut heavy = short();
    heavy.object.mass = 3.0;
    let text = simulate(&heavy, &|_| {}).unwrap_err().to_string();
    let mut stiffer = heavy.clone();
    stiffer.fingertip.youngs_modulus = digits(&text, "fingertip.youngs_modulus to");
    let mut deeper = heavy.clone();
    deeper.initial.normal_displacement = digits(&text, "initial.normal_displacement to");
    deeper.finger.half_span = 0.05 - deeper.initial.normal_displacement;
    for scene in [&mut stiffer, &mut deeper] {
        scene.integrator.step = 1e-4;
        assert!(simulate(scene, &|_| {}).is_ok(), "{text}");
    }
}

#[test]
fn a_stabilisation_gain_that_is_too_high_is_refused_with_the_stable_one() {
    let mut scene = short();
    scene.integrator.formulation = Formulation::Multipliers;
    scene.integrator.baumgarte = 5000.0;
    let Err(GraspError::BadGain { stable, .. }) = simulate(&scene, &|_| {}) else { panic!() };
    // A double pole at -g: RK4 is stable to g h = 2.785.
    assert!((stable * scene.integrator.step - 2.785).abs() < 0.05, "{stable}");
    scene.integrator.baumgarte = 0.97 * stable;
    assert!(simulate(&scene, &|_| {}).is_ok());
    scene.integrator.baumgarte = 1.04 * stable;
    assert!(matches!(simulate(&scene, &|_| {}), Err(GraspError::BadGain { .. })));
}

#[test]
fn extreme_scenes_end_by_name_and_soon() {
    let mut seed = 21;
    for _ in 0..60 {
        let mut scene = short();
        let factor = |seed: &mut u64| 10f64.powf(1.5 * noise(seed));
        scene.fingertip.youngs_modulus *= factor(&mut seed);
        scene.object.mass *= factor(&mut seed);
        scene.object.inertia *= factor(&mut seed);
        scene.finger.inertia *= factor(&mut seed);
        scene.finger.gains.kp *= factor(&mut seed);
        scene.motions[0].target = [0.4 * noise(&mut seed), 0.4 * noise(&mut seed)];
        scene.integrator.step *= factor(&mut seed).min(9.0);
        let (_, model) = FingertipModel::ALL[(seed % 4) as usize];
        scene.fingertip.model = model;
        scene.integrator.output_every = scene.integrator.step.max(0.01);
        match simulate(&scene, &|_| {}) {
            Ok(result) => {
                assert!(result.samples.iter().all(|s| s.row().iter().all(|v| v.is_finite())));
                assert!(result.completed || result.events.iter().any(|e| e.kind.ends_run()));
            }
            Err(error) => assert!(!error.to_string().contains("NaN"), "{error}"),
        }
    }
}

#[test]
fn energies_are_minima_for_parallel_tips_and_neutral_or_saddles_for_radial_ones() {
    let scene = Scene::reference();
    for (step, _, found) in stability::postures(&scene, FingertipModel::Parallel) {
        let at = found.unwrap();
        let rows = stability::rows(&scene, step, &at);
        let row = |model, hold| rows.iter().find(|r| r.model == model && r.hold == hold).unwrap();
        let parallel = row(FingertipModel::Parallel, Hold::Friction);
        assert!(parallel.class == Stability::Minimum && parallel.distance.unwrap() < 1e-9);
        for r in &rows {
            // Every pose that is given is stationary; without friction nothing carries the weight.
            assert_eq!(r.class == Stability::None, r.hold == Hold::Frictionless, "{r:?}");
            assert!(r.hold != Hold::Weightless || r.class == Stability::Neutral, "{r:?}");
            assert!(r.hold != Hold::Friction || r.class == Stability::Minimum, "{r:?}");
            assert!(r.residual.is_none_or(|left| left < 1e-8), "{r:?}");
        }
        let surfaces = stability::surfaces(&scene, step, &at);
        assert_eq!(surfaces.len(), 4);
        let lowest = |k: usize| surfaces[k].energy.iter().filter(|e| e.is_finite()).copied().fold(0.0, f64::min);
        assert_eq!(lowest(0), 0.0, "the parallel model's energy is least at its equilibrium");
        assert!(lowest(2) < 0.0, "the radial model's is not");
    }
}

#[test]
fn degrees_of_freedom_by_rank() {
    let table = degrees_of_freedom::table(&Scene::reference());
    let row = |model, fingers| table.iter().find(|f| f.model == model && f.fingers == fingers).unwrap();
    let found = |model, fingers| {
        let f = row(model, fingers);
        (f.coordinates, f.rank, f.freedom, f.object_freedom, f.controls())
    };
    assert_eq!(found(FingertipModel::Parallel, 2), (9, 4, 5, 3, "grasp and posture"));
    assert_eq!(found(FingertipModel::Parallel, 1), (8, 4, 4, 3, "grasp or posture, not both"));
    assert_eq!(found(FingertipModel::Rigid, 2), (5, 4, 1, 0, "posture"));
    assert_eq!(found(FingertipModel::Rigid, 1), (4, 4, 0, 0, "neither"));
    assert_eq!(found(FingertipModel::Radial, 2).2, 3);
}

/// The source's cases: rigid and soft tips on fingers of 1+1 and 1+2 joints.
#[test]
fn a_finger_of_two_joints_gives_rigid_tips_what_soft_ones_have_with_one() {
    let table = degrees_of_freedom::table(&Scene::reference());
    let row = |model, joints| table.iter().find(|f| f.model == model && f.joints == joints).unwrap();
    let (rigid, soft) = (FingertipModel::Rigid, FingertipModel::Parallel);
    // One more joint is one more freedom, whatever the tips.
    for (_, model) in FingertipModel::ALL {
        assert_eq!(row(model, [1, 2]).freedom, row(model, [1, 1]).freedom + 1, "{}", model.name());
        assert_eq!(row(model, [1, 2]).rank, 4);
        assert!(row(model, [1, 1]).stable);
    }
    // By angles rigid tips have no grip to set; by torques they have, beside their motion.
    assert_eq!((row(rigid, [1, 1]).freedom, row(rigid, [1, 2]).freedom), (1, 2));
    assert_eq!((row(rigid, [1, 1]).controls(), row(rigid, [1, 2]).controls()), ("posture", "posture"));
    assert_eq!(row(rigid, [1, 1]).torque_controls(), "grasp and posture");
    assert_eq!(row(soft, [1, 1]).controls(), "grasp and posture");
    assert_eq!(row(soft, [1, 2]).controls(), "grasp and posture");
    assert_eq!((row(rigid, [1, 1]).contact_forces, row(soft, [1, 1]).contact_forces), (4, 6));
}

/// Fingers that are written as two and are alike move as one that is written once; fingers that
/// differ rest where forces and moments balance.
#[test]
fn fingers_may_differ() {
    let base = short();
    let mut twice = base.clone();
    twice.second = Some(Second { fingertip: base.fingertip.clone(), finger: base.finger.clone() });
    assert!(apart(&run(&base).samples, &run(&twice).samples) < 1e-9);
    // A thumb: thicker, softer, on a shorter link.
    let mut thumb = twice.clone();
    let second = thumb.second.as_mut().unwrap();
    (second.fingertip.radius, second.fingertip.youngs_modulus) = (0.025, 1.2e5);
    (second.finger.link, second.finger.half_span, second.finger.lift) = (0.045, 0.0485 + 0.005, -0.015);
    thumb.check().unwrap();
    let result = run(&thumb);
    assert!(result.completed && result.events.is_empty(), "{:?}", result.events);
    let first = result.samples[0];
    let weight = 0.10 * 9.81;
    assert!((first.tangential_force[0] + first.tangential_force[1] + weight).abs() < 1e-5, "{first:?}");
    assert!((first.normal_force[0] - first.normal_force[1]).abs() < 0.05 * first.normal_force[0], "{first:?}");
    assert!(first.normal[1] > 1.2 * first.normal[0], "the softer tip gives more: {first:?}");
    // It begins at rest.
    let still = run(&Scene { motions: Vec::new(), ..thumb.clone() }).samples;
    assert!(apart(&still[..1], &still[still.len() - 1..]) < 1e-9);
    // Both forms agree on it, and mirrored it moves as its mirror image.
    let mut other = thumb.clone();
    other.integrator.formulation = Formulation::Multipliers;
    assert!(apart(&result.samples, &run(&other).samples) < 1e-8);
    let mut mirrored = thumb.clone();
    let was = std::mem::replace(
        mirrored.second.as_mut().unwrap(),
        Second { fingertip: thumb.fingertip.clone(), finger: thumb.finger.clone() },
    );
    (mirrored.fingertip, mirrored.finger) = (was.fingertip, was.finger);
    mirrored.motions[0].target.reverse();
    for (a, b) in result.samples.iter().zip(&run(&mirrored).samples) {
        assert!((a.pose[0] + b.pose[0]).abs() < 1e-10 && (a.pose[1] - b.pose[1]).abs() < 1e-10, "{a:?} {b:?}");
        assert!((a.pose[2] + b.pose[2]).abs() < 1e-9 && (a.normal_force[0] - b.normal_force[1]).abs() < 1e-6);
    }
}

#[test]
fn the_pinch_map_is_symmetric_and_agrees_with_the_motions() {
    let scene = Scene::reference();
    let map = pinch::map(&scene, FingertipModel::Parallel, 30f64.to_radians(), 61, &|_| {});
    let side = map.angles.len();
    let at = |a: f64, b: f64| {
        let place = |v: f64| ((v + 30.0).round() as usize).min(side - 1);
        &map.cells[place(b) * side + place(a)]
    };
    for j in 0..side {
        for i in 0..j {
            let (one, other) = (&map.cells[j * side + i], &map.cells[i * side + j]);
            assert_eq!(one.state, other.state, "{i} {j}");
            if one.state == PinchState::Good {
                assert!((one.sample.pose[2] + other.sample.pose[2]).abs() < 1e-9);
            }
        }
    }
    assert_eq!(at(0.0, 0.0).state, PinchState::Good);
    for [a, b] in palpate::types::scene::EIGHT_MOTIONS {
        assert_eq!(at(a, b).state, PinchState::Good, "{a} {b}");
    }
    assert_eq!(at(30.0, 30.0).state, PinchState::Unreached);
    assert!(map.cells.iter().any(|c| c.state == PinchState::OutOfRange));
    // Less friction can only take away.
    let mut rough = scene.clone();
    rough.object.friction = Some(0.5);
    let slippery = pinch::map(&rough, FingertipModel::Parallel, 30f64.to_radians(), 61, &|_| {});
    let good = |m: &palpate::types::grasp::PinchMap| m.cells.iter().filter(|c| c.state == PinchState::Good).count();
    assert!(good(&slippery) < good(&map) && good(&slippery) > 0);
    assert!(slippery.cells.iter().zip(&map.cells).all(|(s, m)| s.state != PinchState::Good || m.state == s.state));
}

#[test]
fn an_ensemble_is_the_same_for_any_number_of_threads() {
    let case = |mass: f64| {
        let mut scene = short();
        scene.object.mass = mass;
        SweepCase { values: vec![("object.mass".into(), mass.to_string())], scene }
    };
    let cases: Vec<SweepCase> = (1..=12).map(|i| case(0.02 * f64::from(i))).collect();
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| pipeline::grasp::ensemble(&cases, &|_, _| {}))
    };
    let (one, four) = (with(1), with(4));
    assert_eq!(one, four);
    // Each is the run of its own scene, and heavier objects hang lower.
    let lone = run(&cases[4].scene);
    assert_eq!(one[4].as_ref().unwrap().motions, lone.motions);
    let hang = |r: &Result<GraspRun, GraspError>| r.as_ref().unwrap().motions[0].reached.pose[1];
    assert!(one.windows(2).all(|pair| hang(&pair[1]) < hang(&pair[0])));
}

/// A scene with a tabulated fingertip.
fn tabulated(profile: Vec<[f64; 2]>) -> Scene {
    let mut scene = Scene::reference();
    scene.fingertip.model = FingertipModel::Tabulated;
    scene.fingertip.profile = profile;
    scene
}

#[test]
fn a_uniform_table_is_the_closed_form() {
    let closed = Parallel { stiffness: PI * E };
    for profile in [Vec::new(), vec![[0.0, E], [0.004, E], [0.02, E]]] {
        let mut fingertip = tabulated(profile).fingertip;
        (fingertip.radius, fingertip.youngs_modulus) = (A, E);
        let table = tip_of(&fingertip, FingertipModel::Tabulated);
        for (d, d_t, tilt) in [(3e-3, 1e-3, 0.3), (5e-3, -2e-3, -0.4), (1e-4, 2e-6, 0.0), (8e-3, 1e-3, 0.5)] {
            let tilt = Tilt::of(tilt);
            assert!(relative(table.energy(d, d_t, tilt), closed.energy(d, d_t, tilt)) < 1e-9);
            let [g, h] = [table.gradient(d, d_t, tilt), closed.gradient(d, d_t, tilt)];
            let size = PI * E * d * d;
            assert!((g.normal - h.normal).abs() < 1e-6 * size && (g.tangential - h.tangential).abs() < 1e-6 * size);
            assert!((g.moment - h.moment).abs() < 1e-6 * size * d);
            let [g, h] = [table.curvature(d, d_t, tilt), closed.curvature(d, d_t, tilt)];
            for (i, j) in (0..3).flat_map(|i| (0..3).map(move |j| (i, j))) {
                assert!((g[i][j] - h[i][j]).abs() < 1e-6 * PI * E * d, "{i}{j}: {} {}", g[i][j], h[i][j]);
            }
        }
    }
    // And so is a whole run.
    let mut scene = short();
    let closed = simulate(&scene, &|_| {}).unwrap();
    scene.fingertip.model = FingertipModel::Tabulated;
    let table = simulate(&scene, &|_| {}).unwrap();
    assert_eq!(closed.samples.len(), table.samples.len());
    for (a, b) in closed.samples.iter().zip(&table.samples) {
        for (a, b) in a.row().iter().zip(b.row()) {
            assert!((a - b).abs() < 1e-6 * a.abs().max(1.0), "{a} {b}");
        }
    }
}

#[test]
fn a_table_is_the_sum_of_its_unlike_springs() {
    let modulus = |depth: f64| E * (1.0 + 40.0 * depth + 3.0 * (depth / 0.01).powi(2));
    let table = palpate::grasp::tabulated::Tabulated::new(A, modulus);
    for (d, d_t, tilt) in [(1.5e-3, 0.0, 0.0), (4e-3, 1e-3, 0.2), (6e-3, -1.5e-3, -0.35), (9e-3, 5e-4, 0.5)] {
        let (normal, tangent) = ([f64::cos(tilt), f64::sin(tilt)], [-f64::sin(tilt), f64::cos(tilt)]);
        let summed = summed_unlike_springs([1.0, 0.0], normal, tangent, d, d_t, &modulus);
        let energy = table.energy(d, d_t, Tilt::of(tilt));
        assert!(relative(energy, summed) < 2e-3, "d {d}, d_t {d_t}, tilt {tilt}: {energy}, {summed}");
    }
    // Derivatives are those of the energy.
    let (h, at) = (1e-6, (4e-3, 1e-3, 0.2));
    let energy = |d: f64, t: f64, a: f64| table.energy(d, t, Tilt::of(a));
    let g = table.gradient(at.0, at.1, Tilt::of(at.2));
    let size = PI * E * at.0 * at.0;
    let slope = (energy(at.0 + h * A, at.1, at.2) - energy(at.0 - h * A, at.1, at.2)) / (2.0 * h * A);
    assert!((slope - g.normal).abs() < 1e-6 * size, "{slope} {}", g.normal);
    let slope = (energy(at.0, at.1, at.2 + h) - energy(at.0, at.1, at.2 - h)) / (2.0 * h);
    assert!((slope - g.moment).abs() < 1e-6 * size * A, "{slope} {}", g.moment);
    let moment = |a: f64| table.gradient(at.0, at.1, Tilt::of(a)).moment;
    let bend = (moment(at.2 + h) - moment(at.2 - h)) / (2.0 * h);
    let curvature = table.curvature(at.0, at.1, Tilt::of(at.2));
    assert!((bend - curvature[2][2]).abs() < 1e-5 * size * A, "{bend} {}", curvature[2][2]);
    let normal = |d: f64| table.gradient(d, at.1, Tilt::of(at.2)).normal;
    let bend = (normal(at.0 + h * A) - normal(at.0 - h * A)) / (2.0 * h * A);
    assert!((bend - curvature[0][0]).abs() < 1e-5 * size / A, "{bend} {}", curvature[0][0]);
}

#[test]
fn a_soft_middle_on_a_stiff_rim_holds() {
    let scene = tabulated(vec![[0.0, 0.5 * E], [0.001, 0.8 * E], [0.004, 2.0 * E]]);
    let run = simulate(&scene, &|_| {}).unwrap();
    assert!(run.completed, "{:?}", run.events);
}

#[test]
fn a_modulus_that_is_off_shows_in_the_grip_and_not_in_the_turn() {
    // Why the demo scores the grip: the turn is geometry.
    let scene = Scene::reference();
    let end = |factor: f64| {
        let last = *run(&scene.with_moduli(factor)).samples.last().unwrap();
        let second = run(&scene.with_moduli(factor)).motions[2].reached;
        (0.5 * (last.normal_force[0] + last.normal_force[1]), second.pose[2])
    };
    let (grip, turn) = end(1.0);
    for factor in [0.5, 2.0] {
        let (other, turned) = end(factor);
        assert!((other / grip / factor - 1.0).abs() < 0.02, "{factor}: {other} {grip}");
        assert!((turned / turn - 1.0).abs() < 0.02, "{factor}: {turned} {turn}");
    }
}

#[test]
fn deviations_and_bounds_of_the_moduli_become_bands() {
    let mut scene = short();
    assert!(pipeline::grasp::run(&scene, &|_, _| {}).unwrap().bands.is_none());
    scene.fingertip.deviation = 0.1;
    let outcome = pipeline::grasp::run(&scene, &|_, _| {}).unwrap();
    let bands = outcome.bands.unwrap();
    assert_eq!((bands.factors.len(), bands.low.len()), (2, outcome.run.samples.len()));
    let [softer, stiffer] = [-0.1f64, 0.1].map(|f| run(&scene.with_moduli(f.exp())).samples);
    for (k, s) in outcome.run.samples.iter().enumerate() {
        let f = |s: &Sample| s.normal_force[0];
        assert_eq!(f(&bands.low[k]), f(&softer[k]).min(f(s)).min(f(&stiffer[k])));
        assert_eq!(f(&bands.high[k]), f(&softer[k]).max(f(s)).max(f(&stiffer[k])));
        assert!(f(&bands.low[k]) < f(s) && f(s) < f(&bands.high[k]));
    }
    // Bounds widen them on their side.
    scene.fingertip.bounds = Some([1.0, 3.0]);
    let wide = pipeline::grasp::run(&scene, &|_, _| {}).unwrap().bands.unwrap();
    let last = |s: &[Sample]| s.last().unwrap().normal_force[0];
    assert_eq!(last(&wide.low), last(&bands.low));
    assert!(last(&wide.high) > 2.0 * last(&bands.high));
}

/// The short scene with tips whose branches have these moduli (over the springs') and times (s).
fn relaxing(branches: &[[f64; 2]]) -> Scene {
    let mut scene = short();
    scene.fingertip.maxwell = branches.iter().map(|[share, time]| [share * E, share * E * time]).collect();
    scene
}

#[test]
fn relaxing_tips_follow_the_convolution_of_their_springs_force() {
    let branches = [[0.8, 0.02], [0.5, 0.3]];
    let mut scene = relaxing(&branches);
    (scene.integrator.step, scene.integrator.output_every, scene.fingertip.damping) = (2e-4, 2e-4, [0.0; 2]);
    scene.finger.gains.ki = 0.0;
    let result = run(&scene);
    assert!(result.completed && result.events.is_empty(), "{:?}", result.events);
    assert!(result.energy_drift < 1e-6, "{}", result.energy_drift);
    let tip = Parallel { stiffness: PI * E };
    // p' = (f - p) / tau, exactly for a force that is linear between samples.
    let mut p = [[0.0; 2]; 2];
    let (mut last, mut most, mut lag) = ([0.0; 2], 0.0f64, 0.0f64);
    for (n, s) in result.samples.iter().enumerate() {
        let tilts = [s.pose[2] - s.joints[0], -(s.pose[2] + s.joints[1])];
        for i in 0..2 {
            let f = tip.gradient(s.normal[i], s.tangential[i], Tilt::of(tilts[i])).normal;
            let mut whole = f;
            for (b, [share, time]) in branches.iter().enumerate() {
                let h = scene.integrator.output_every;
                let kept = (-h / time).exp();
                p[b][i] = if n == 0 {
                    f
                } else {
                    let slope = (f - last[i]) / h;
                    f - slope * time + (p[b][i] - last[i] + slope * time) * kept
                };
                whole += share * (f - p[b][i]);
            }
            last[i] = f;
            most = most.max((whole - s.normal_force[i]).abs());
            lag = lag.max((whole - f).abs());
        }
    }
    assert!(lag > 0.5 && most < 1e-5 * lag, "{most} of {lag}");
}

#[test]
fn tips_that_relax_end_where_elastic_ones_do() {
    let mut scene = relaxing(&[[1.0, 0.005], [0.7, 0.02]]);
    scene.motions[0].hold = 2.0;
    let mut elastic = scene.clone();
    elastic.fingertip.maxwell.clear();
    let [slow, quick] = [&scene, &elastic].map(|s| run(s).motions[1].reached);
    for k in 0..3 {
        assert!((slow.pose[k] - quick.pose[k]).abs() < 1e-6, "{slow:?} {quick:?}");
    }
    assert!((slow.normal_force[0] - quick.normal_force[0]).abs() < 1e-3);
    // And slide as they do, with their energy accounted for.
    scene.object.friction = Some(0.9 * run(&scene).required_friction);
    let slid = run(&scene);
    assert_eq!(slid.outcome(), "slip");
    assert!(slid.energy_drift < 1e-4, "{}", slid.energy_drift);
    // The multiplier form has no place for branches, and says so.
    scene.integrator.formulation = Formulation::Multipliers;
    assert!(simulate(&scene, &|_| {}).unwrap_err().to_string().contains("maxwell"));
}

/// The tip of examples/human_fingertip.toml.
fn human() -> Scene {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/human_fingertip.toml");
    palpate::io::read_scene(path, &palpate::io::SceneOverrides::default()).unwrap().scene
}

#[test]
fn a_stiffening_tip_has_its_closed_form_and_what_is_published_of_fingertips() {
    let scene = human();
    let (e, by) = (scene.fingertip.youngs_modulus, scene.fingertip.stiffening.unwrap());
    let tip = tip_of(&scene.fingertip, FingertipModel::Tabulated);
    // F = 2 pi E L^2 (exp(d / L) - 1 - d / L), along the face 2 pi E L (exp(d / L) - 1).
    let closed = |d: f64| 2.0 * PI * e * by * by * ((d / by).exp_m1() - d / by);
    let (mut forces, mut drags) = (Vec::new(), Vec::new());
    for step in 2..=18 {
        let d = 2.5e-4 * f64::from(step);
        let (f, k) = (tip.gradient(d, 0.0, Tilt::of(0.0)).normal, tip.curvature(d, 0.0, Tilt::of(0.0))[1][1]);
        assert!(relative(f, closed(d)) < 0.02, "{d}: {f} {}", closed(d));
        assert!(relative(k, 2.0 * PI * e * by * (d / by).exp_m1()) < 0.03, "{d}: {k}");
        forces.push(f);
        drags.push(k);
    }
    // Exponential from 0.5 N on (Pawluk and Howe 1999): the slope of ln F changes by a fifth up to
    // 5 N.
    let slope = |a: f64, b: f64| (closed(b) / closed(a)).ln() / (b - a);
    let depth = |force: f64| {
        let (mut low, mut high) = (0.0, scene.fingertip.radius);
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            if closed(middle) < force { low = middle } else { high = middle }
        }
        low
    };
    let [a, b, c, d] = [0.5, 0.6, 4.5, 5.0].map(depth);
    assert!(slope(a, b) / slope(c, d) < 1.4 && depth(5.0) < 0.6 * scene.fingertip.radius);
    // Stiffness along the face grows in proportion to the normal force (Pataky et al. 2005); of one
    // modulus it would grow with its root.
    let ratio = |i: usize, j: usize| (drags[j] / drags[i]).ln() / (forces[j] / forces[i]).ln();
    assert!(ratio(8, 16) > 0.8, "{}", ratio(8, 16));
}

/// The analysis compares models of one scene: each must stand with what the scene says of another.
#[test]
fn every_shipped_scene_can_take_every_model() {
    for name in ["eight_motions", "human_fingertip", "thumb_and_index"] {
        let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("examples/{name}.toml"));
        let scene = palpate::io::read_scene(path, &palpate::io::SceneOverrides::default()).unwrap().scene;
        for model in [FingertipModel::Parallel, FingertipModel::ParallelNormal, FingertipModel::Radial] {
            scene.with_model(model).check().unwrap_or_else(|error| panic!("{name} as {}: {error}", model.name()));
        }
    }
}

#[test]
fn the_human_fingertip_holds_and_relaxes() {
    let result = run(&human());
    assert!(result.completed, "{:?}", result.events);
    // What is left of the force at the end of a hold of 3 s, over its peak.
    let grip = |s: &Sample| 0.5 * (s.normal_force[0] + s.normal_force[1]);
    let (peak, end) = (result.samples.iter().map(grip).fold(0.0, f64::max), grip(result.samples.last().unwrap()));
    println!(
        "grip {peak:.2} N, {end:.2} N after the hold; {:?}",
        result.events.iter().map(|e| (e.kind, e.time)).collect::<Vec<_>>()
    );
    assert!(end < 0.7 * peak && end > 0.2 * peak, "{peak} {end}");
}
