//! Tip models fitted to measurements: truth comes back within its deviation, and the evidence names
//! the model that the data are of.

use palpate::grasp::measured::fit;
use palpate::grasp::models::{Tilt, tip_of};
use palpate::grasp::simulate::simulate;
use palpate::io;
use palpate::types::measured::{CoursePoint, ForcePoint, Measurements, STRONG_EVIDENCE};
use palpate::types::scene::Motion;
use palpate::types::{FingertipModel, Scene};
use std::path::Path;

/// Normal deviates from SplitMix64 by Box and Muller.
struct Noise(u64);

impl Noise {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut h = self.0;
        h = (h ^ (h >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        h = (h ^ (h >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (((h ^ (h >> 31)) >> 11) as f64 + 0.5) / (1u64 << 53) as f64
    }

    fn normal(&mut self) -> f64 {
        (-2.0 * self.uniform().ln()).sqrt() * (2.0 * std::f64::consts::PI * self.uniform()).cos()
    }
}

const SD: f64 = 0.05;

/// Presses of the reference tip with another modulus and damping, of `model`, with noise of `SD` N
/// whose neighbours are alike by `alike`.
fn presses(model: FingertipModel, seed: u64, alike: f64) -> Vec<ForcePoint> {
    let mut tip = Scene::reference().fingertip;
    tip.youngs_modulus = 1.5e5;
    let springs = tip_of(&tip, model);
    let mut noise = Noise(seed);
    let mut last = noise.normal();
    let mut out = Vec::new();
    for degrees in [-30.0, -15.0, 0.0, 15.0, 30.0] {
        for step in 1..=12 {
            let (d, tilt) = (5e-4 * f64::from(step), f64::to_radians(degrees));
            let d_t = 0.2 * d * tilt.sin();
            let g = springs.gradient(d, d_t, Tilt::of(tilt));
            let along = if model == FingertipModel::Radial { g.normal } else { tilt.cos() * g.normal };
            let rate = if step % 3 == 0 { 0.02 } else { 0.0 };
            last = alike * last + (1.0 - alike * alike).sqrt() * noise.normal();
            let force = along + 12.0 * rate + SD * last;
            out.push(ForcePoint { d, tilt, force, d_t: Some(d_t), rate: Some(rate) });
        }
    }
    out
}

#[test]
fn modulus_and_damping_come_back_within_their_deviations() {
    let scene = Scene::reference();
    for (alike, band) in [(0.0, 0.9..0.99), (0.6, 0.84..0.99)] {
        let (mut inside, mut all) = (0, 0);
        for seed in 0..200 {
            let found = fit(&scene, &Measurements::Force(presses(FingertipModel::Parallel, seed, alike)));
            let best = found.models.iter().find(|m| m.model == "parallel").unwrap();
            let damping = best.damping.unwrap();
            for (estimate, truth) in [(best.youngs_modulus, 1.5e5), (damping, 12.0)] {
                inside += usize::from((estimate.value - truth).abs() < 2.0 * estimate.sd);
                all += 1;
            }
            assert!((best.youngs_modulus.value / 1.5e5 - 1.0).abs() < 0.05);
        }
        let share = inside as f64 / f64::from(all);
        assert!(band.contains(&share), "{alike}: {share} within two deviations, 0.954 for normal ones");
    }
}

#[test]
fn the_evidence_names_the_model_that_the_presses_are_of() {
    let scene = Scene::reference();
    for (_, model) in FingertipModel::ALL.iter().take(3) {
        let (mut right, mut wrong) = (0, 0);
        for seed in 0..40 {
            let found = fit(&scene, &Measurements::Force(presses(*model, 100 + seed, 0.0)));
            assert_eq!(found.models.len(), 3);
            assert!(found.models[0].log_evidence == 0.0 && found.models[1].log_evidence <= 0.0);
            let strong = found.models[1].log_evidence <= -STRONG_EVIDENCE;
            right += usize::from(found.models[0].model == model.name() && strong);
            wrong += usize::from(found.models[0].model != model.name() && strong);
        }
        assert!(right >= 38 && wrong == 0, "{}: {right} right, {wrong} wrong of 40", model.name());
    }
    // Straight presses alone do not tell them apart, and that is said.
    let mut straight = presses(FingertipModel::Radial, 1, 0.0);
    straight.retain(|p| p.tilt == 0.0);
    let found = fit(&scene, &Measurements::Force(straight));
    assert!(found.verdict().contains("do not tell"), "{}", found.verdict());
}

/// A short scene with two motions, measured every 20 ms.
fn measured_course(model: FingertipModel, seed: u64) -> (Scene, Vec<CoursePoint>) {
    let mut scene = Scene::reference();
    scene.initial.rest = 0.1;
    let motion = |a: f64, b: f64| Motion { target: [a.to_radians(), b.to_radians()], duration: 0.1, hold: 0.3 };
    scene.motions = vec![motion(6.0, 6.0), motion(12.0, -4.0)];
    let mut truth = scene.with_model(model);
    truth.fingertip.youngs_modulus = 1.6e5;
    truth.fingertip.damping = [30.0; 2];
    truth.integrator.output_every = 0.02;
    let mut noise = Noise(seed);
    let mut read = |v: f64, sd: f64| v + sd * noise.normal();
    let samples = simulate(&truth, &|_| {}).unwrap().samples;
    let points = samples.iter().map(|s| CoursePoint {
        time: s.time,
        joints: s.joints,
        pose: [read(s.pose[0], 2e-5), read(s.pose[1], 2e-5), read(s.pose[2], 1e-3)],
    });
    (scene, points.collect())
}

#[test]
fn a_course_gives_modulus_and_damping_and_the_model() {
    for (k, model) in [FingertipModel::Parallel, FingertipModel::ParallelNormal].into_iter().enumerate() {
        let (scene, points) = measured_course(model, 5 + k as u64);
        let found = fit(&scene, &Measurements::Course(points));
        assert_eq!(found.models.len(), 3, "{:?}", found.failed);
        assert_eq!(found.models[0].model, model.name(), "{:?}", found.models);
        assert!(found.joints_off < 1e-3, "{}", found.joints_off);
        if model == FingertipModel::Parallel {
            let best = &found.models[0];
            assert!(found.models[1].log_evidence < -STRONG_EVIDENCE);
            let (e, c) = (best.youngs_modulus, best.damping.unwrap());
            assert!((e.value - 1.6e5).abs() < 3.0 * e.sd && e.sd < 0.05 * e.value, "{e:?}");
            assert!((c.value - 30.0).abs() < 3.0 * c.sd && c.sd < c.value, "{c:?}");
        }
    }
}

#[test]
fn the_synthetic_example_is_of_the_parallel_model() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/synthetic_presses.csv");
    let found = fit(&Scene::reference(), &io::read_measured(path).unwrap());
    let best = &found.models[0];
    assert_eq!(best.model, "parallel");
    assert!((best.youngs_modulus.value - 2e5).abs() < 3.0 * best.youngs_modulus.sd);
    assert!((best.damping.unwrap().value - 20.0).abs() < 3.0 * best.damping.unwrap().sd);
}

#[test]
fn tables_that_cannot_be_fitted_are_refused_by_name() {
    let folder = tempfile::TempDir::new().unwrap();
    let path = folder.path().join("m.csv");
    for (text, part) in [
        ("a,b\n1,2\n", "has neither d,tilt_deg,force nor time"),
        ("d,tilt_deg,force\n0.001,0,1\n", "has 1 rows"),
        ("d,tilt_deg,force\n0.001,0,x\n", "not a finite number"),
        ("d,tilt_deg,force\n-0.001,0,1\n0.001,0,1\n", "d is -0.001"),
        ("d,tilt_deg,force,time\n0.001,0,1,2\n0.001,0,1,1\n", "time does not rise"),
        ("time,theta1_deg,theta2_deg,x,y\n0,0,0,0,0\n", "theta_deg"),
    ] {
        std::fs::write(&path, text).unwrap();
        let error = io::read_measured(&path).unwrap_err().to_string();
        assert!(error.contains("m.csv") && error.contains(part), "{error}");
    }
}
