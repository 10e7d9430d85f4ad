//! `--method sparse`: matches alone make the field.

use crate::fixtures::{run as command, small_pair};
use palpate::evaluate;
use palpate::numerics::sampling::displacement;
use palpate::pipeline::dry_run;
use palpate::pipeline::field::{FieldResult, run};
use palpate::synth::{MotionKind, Phantom, PhantomKind, PhantomParams, phantom};
use palpate::types::params::{Interpolation, Method};
use palpate::types::{FieldParams, Match, MotionModel};

/// A block of `n` voxels a side, 1 mm each.
fn block(n: usize, motion: MotionKind, amplitude: f64, noise: f64) -> Phantom {
    let size = [n; 3];
    phantom(&PhantomParams { motion, amplitude, size, noise, ..PhantomParams::new(PhantomKind::Block) }).unwrap()
}

fn sparse() -> FieldParams {
    FieldParams { method: Method::Sparse, ..FieldParams::default() }
}

/// The result, and its mean error over that before registration (1).
fn measure(p: &Phantom, params: &FieldParams) -> (FieldResult, f64) {
    let result = run(&p.initial, &p.deformed, Some(&p.mask), params, &|_, _| {}).unwrap();
    let m = evaluate::metrics(&result.displacement, &p.truth, Some(&p.mask), &p.landmarks).unwrap();
    (result, m.mean_mm / m.identity_mm)
}

#[test]
fn matches_alone_measure_smooth_motions_and_presses() {
    for (motion, amplitude) in [(MotionKind::Smooth, 4.0), (MotionKind::Press, 4.0)] {
        let (result, share) = measure(&block(48, motion, amplitude, 0.01), &sparse());
        assert!(share < 0.35, "{motion:?}: {share:.3} of the motion is left");
        let s = &result.summary;
        assert_eq!((s.model, s.folds), (MotionModel::Free, 0), "{motion:?}");
        assert!(s.evidence[0].contains("--method sparse"), "{:?}", s.evidence);
        assert!(!s.seconds.iter().any(|(stage, _)| stage == "residual"), "{:?}", s.seconds);
        // All kept matches are the mesh.
        assert_eq!(s.counts.nodes, s.counts.kept, "{motion:?}");
    }
}

#[test]
fn no_motion_and_a_shift_are_found_as_such() {
    for (motion, amplitude, model) in
        [(MotionKind::None, 0.0, MotionModel::Identity), (MotionKind::Translate, 2.7, MotionModel::Rigid)]
    {
        let p = block(48, motion, amplitude, 0.03);
        let result = run(&p.initial, &p.deformed, Some(&p.mask), &sparse(), &|_, _| {}).unwrap();
        let error = evaluate::metrics(&result.displacement, &p.truth, Some(&p.mask), &[]).unwrap().mean_mm;
        assert_eq!(result.summary.model, model, "{motion:?}: {:?}", result.summary.evidence);
        assert!(error < 0.05, "{motion:?}: {error:.3} mm");
    }
}

#[test]
fn the_smooth_field_is_nearer_than_the_piecewise_linear_one() {
    let p = block(48, MotionKind::Smooth, 4.0, 0.03);
    let (_, smooth) = measure(&p, &sparse());
    let (_, linear) = measure(&p, &FieldParams { interpolation: Interpolation::Barycentric, ..sparse() });
    assert!(smooth < linear, "{smooth:.3} smooth, {linear:.3} piecewise linear");
}

#[test]
fn points_set_the_number_of_matches() {
    let p = block(48, MotionKind::Smooth, 4.0, 0.01);
    let at = |points| {
        let params = FieldParams { points, ..sparse() };
        let planned = dry_run::field(&p.initial, &p.deformed, Some(&p.mask), &params).unwrap().points;
        let (result, share) = measure(&p, &params);
        assert_eq!(planned, points);
        (result.summary.counts.kept, share)
    };
    let [few, many] = [at(100), at(800)];
    assert!((60..=100).contains(&few.0) && (400..=800).contains(&many.0), "{few:?} {many:?}");
    assert!(many.1 < few.1, "{few:?} {many:?}");
}

#[test]
fn the_result_does_not_depend_on_threads() {
    let p = block(40, MotionKind::Smooth, 3.0, 0.03);
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| measure(&p, &sparse()).0)
    };
    let [one, two] = [with(1), with(2)];
    assert!(one.displacement == two.displacement && one.matches == two.matches && one.mesh == two.mesh);
    assert!(one.uncertainty == two.uncertainty);
}

/// The fit is robust by itself, so the field hardly changes; what consistency leaves out is wrong.
#[test]
fn consistency_leaves_out_matches_that_are_wrong() {
    let calf = PhantomParams { noise: 0.05, ..PhantomParams::new(PhantomKind::Calf) };
    let calf = PhantomParams { motion: MotionKind::Smooth, amplitude: 8.0, ..calf.sized(64) };
    let cases = [phantom(&calf).unwrap(), block(48, MotionKind::Slide, 4.0, 0.03)];
    for (p, name) in cases.iter().zip(["calf", "slide"]) {
        let [(on, with), (_, without)] =
            [true, false].map(|consistency| measure(p, &FieldParams { consistency, ..sparse() }));
        let error = |m: &Match| {
            let truth = displacement(&p.truth, m.initial);
            (0..3).map(|a| (m.displacement[a] - truth[a]).powi(2)).sum::<f64>().sqrt()
        };
        let mean = |kept: bool| {
            let some: Vec<f64> = on.matches.matches.iter().filter(|m| m.kept == kept).map(error).collect();
            some.iter().sum::<f64>() / some.len() as f64
        };
        assert!(mean(false) > 1.5 * mean(true), "{name}: {:.3} {:.3} mm", mean(true), mean(false));
        assert!(with < 1.1 * without, "{name}: {with:.3} {without:.3}");
        assert!(on.summary.levels.iter().all(|l| l.energy_after <= l.energy_before), "{name}");
    }
}

#[test]
fn the_command_line_takes_the_method_by_name() {
    let folder = small_pair();
    let files = ["field", "initial.nii.gz", "deformed.nii.gz", "-o", "out", "--method"];
    let (_, err) = command(folder.path(), &[&files[..], &["spares"]].concat(), 2);
    assert!(err.contains("sparse") && err.contains("full"), "{err}");
    command(folder.path(), &[&files[..], &["sparse", "--quiet"]].concat(), 0);
    let summary = std::fs::read(folder.path().join("out/summary.json")).unwrap();
    let summary: serde_json::Value = serde_json::from_slice(&summary).unwrap();
    assert_eq!(summary["params"]["method"], "sparse");
    assert!(summary["evidence"][0].as_str().unwrap().contains("matches of features alone"), "{summary}");
    for name in ["displacement.nii.gz", "uncertainty.nii.gz", "matches.csv", "mesh.vtu", "report.html"] {
        assert!(folder.path().join("out").join(name).is_file(), "{name}");
    }
}
