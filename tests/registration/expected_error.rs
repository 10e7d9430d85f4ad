//! The error that a field states of itself, held against the truth.

use palpate::evaluate;
use palpate::evaluate::coverage::coverage;
use palpate::pipeline::field::{FieldResult, run};
use palpate::synth::{MotionKind, Phantom, PhantomKind, PhantomParams, Trouble, phantom, troubled};
use palpate::types::params::ModelSource;
use palpate::types::{FieldParams, Mask, MotionModel, Trust};
use rayon::prelude::*;

fn measured(p: &Phantom, mask: Option<&Mask>, params: &FieldParams) -> FieldResult {
    run(&p.initial, &p.deformed, mask, params, &|_, _| {}).unwrap()
}

/// Kinds of trouble that do not make a field useless at once.
const SCENES: [(PhantomKind, Trouble, f64); 12] = [
    (PhantomKind::Block, Trouble::Noise, 3.0),
    (PhantomKind::Block, Trouble::Noise, 20.0),
    (PhantomKind::Block, Trouble::Strain, 20.0),
    (PhantomKind::Block, Trouble::CurvedSliding, 5.0),
    (PhantomKind::Block, Trouble::Joint, 15.0),
    (PhantomKind::Block, Trouble::StillRing, 4.0),
    (PhantomKind::Block, Trouble::NoTexture, 30.0),
    (PhantomKind::Head, Trouble::Noise, 10.0),
    (PhantomKind::Head, Trouble::Motion, 8.0),
    (PhantomKind::Head, Trouble::Rotation, 10.0),
    (PhantomKind::Head, Trouble::Bias, 40.0),
    (PhantomKind::Calf, Trouble::Motion, 12.0),
];

/// Places of values in order, from 0.
fn ranks(values: &[f64]) -> Vec<f64> {
    values.iter().map(|v| values.iter().filter(|w| *w < v).count() as f64).collect()
}

/// The stated deviation, the expected error and trust hold over scenes that did not choose them.
#[test]
fn a_field_knows_how_far_it_is_off() {
    let one = |&(kind, trouble, severity): &(PhantomKind, Trouble, f64)| {
        let p = troubled(&PhantomParams::new(kind).sized(44), trouble, severity).unwrap();
        let result = measured(&p, None, &FieldParams::default());
        let m = evaluate::metrics(&result.displacement, &p.truth, Some(&p.mask), &[]).unwrap();
        let held = coverage(&result.displacement, &p.truth, &|at| result.uncertainty.at(at), &p.mask).unwrap();
        let expected = result.summary.expected.clone();
        let name = format!("{} {severity} of {kind:?}", trouble.name());
        // A wrong field must not be trusted, nor a good one distrusted.
        let share = m.mean_mm / m.identity_mm;
        assert!(share < 1.0 / 3.0 || expected.trust() != Trust::High, "{name}: {share:.2} of the motion, high");
        assert!(share > 0.1 || expected.trust() != Trust::Low, "{name}: {share:.2} of the motion, low");
        let ratio = expected.mean_mm / m.mean_mm;
        assert!((0.4..5.0).contains(&ratio), "{name}: {:.3} mm for {:.3}", expected.mean_mm, m.mean_mm);
        assert!(held > 0.75, "{name}: {held:.2} in the 95 % region");
        (held, m.mean_mm, expected.mean_mm)
    };
    let all: Vec<(f64, f64, f64)> = SCENES.par_iter().map(one).collect();
    let mean = all.iter().map(|a| a.0).sum::<f64>() / all.len() as f64;
    assert!(mean > 0.92, "{mean:.3} in the 95 % region");
    let of = |pick: &dyn Fn(&(f64, f64, f64)) -> f64| ranks(&all.iter().map(pick).collect::<Vec<_>>());
    let (truth, expected) = (of(&|a| a.1), of(&|a| a.2));
    let middle = (all.len() - 1) as f64 / 2.0;
    let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - middle) * (b - middle)).sum::<f64>();
    let correlation = product(&truth, &expected) / product(&truth, &truth);
    assert!(correlation > 0.8, "rank correlation {correlation:.2} of {all:.3?}");
}

/// "Nothing moved" comes with how much motion would not have shown.
#[test]
fn stillness_has_an_error_bar() {
    let still = PhantomParams { motion: MotionKind::None, ..PhantomParams::new(PhantomKind::Head).sized(44) };
    let at = |noise: f64| {
        let p = phantom(&PhantomParams { noise, ..still.clone() }).unwrap();
        let summary = measured(&p, None, &FieldParams::default()).summary;
        assert_eq!(summary.model, MotionModel::Identity, "{:?}", summary.evidence);
        summary.expected
    };
    let [quiet, noisy] = [0.02, 0.1].map(at);
    assert!(quiet.mean_mm > 0.0 && noisy.mean_mm > 1.5 * quiet.mean_mm, "{quiet:?} {noisy:?}");
    assert!(quiet.p95_mm > quiet.mean_mm && quiet.interval_mm[0] < quiet.mean_mm);
    // The edge of a voxel takes the place of the motion.
    assert!(quiet.against_mm > 1.0 && quiet.trust() == Trust::High, "{quiet:?}");
}

/// What is exported at the matches is the final estimate, and how many are asked for changes that
/// alone.
#[test]
fn matches_carry_the_final_estimate() {
    let p = phantom(&PhantomParams::new(PhantomKind::Head).sized(56)).unwrap();
    let usual = measured(&p, Some(&p.mask), &FieldParams::default());
    let few = measured(&p, Some(&p.mask), &FieldParams { points: 20, ..FieldParams::default() });
    assert_eq!(few.matches.matches.len(), 20);
    assert_eq!(few.displacement, usual.displacement);
    let grid = *p.truth.grid();
    let in_region = |m: &&palpate::types::Match| {
        let [i, j, k] = grid.affine().to_voxel(m.initial).0.map(|x| x.round().max(0.0) as usize);
        let truth = p.truth.at(i + grid.shape()[0] * (j + grid.shape()[1] * k));
        let square: f64 = (0..3).map(|c| (m.displacement[c] - f64::from(truth[c])).powi(2)).sum();
        square <= 7.815 * m.sigma().powi(2)
    };
    let kept = usual.matches.kept().count() as f64;
    let held = usual.matches.kept().filter(in_region).count() as f64 / kept;
    assert!(held > 0.85, "{held:.2} of the matches lie in their 95 % region");
    assert!(usual.matches.matches.iter().all(|m| m.raw.is_some()));
    for (node, m) in usual.node_displacement.iter().zip(usual.at_nodes()) {
        assert_eq!(*node, m.displacement);
    }
}

/// The account of the stages begins with the matches and ends with the field itself.
#[test]
fn stages_tell_what_each_of_them_did() {
    let p = phantom(&PhantomParams::new(PhantomKind::Block).sized(44)).unwrap();
    let result = measured(&p, Some(&p.mask), &FieldParams::default());
    let m = evaluate::metrics(&result.displacement, &p.truth, Some(&p.mask), &[]).unwrap();
    let scored: Vec<_> = result.stages.iter().map(|s| s.scored(&p.truth, Some(&p.mask))).collect();
    let (first, last) = (&scored[0], &scored[scored.len() - 1]);
    assert_eq!((first.name.as_str(), last.name.as_str()), ("matches alone", "final"));
    let [before, after] = [first, last].map(|s| s.error_mm.unwrap());
    assert!((after - m.mean_mm).abs() < 0.02 * m.mean_mm && after < before, "{before} {after} {}", m.mean_mm);
    assert!(last.unexplained < first.unexplained && first.moved_mm > 0.0);
    assert_eq!(result.summary.stages.len(), scored.len());
}

/// Errors are told by label where the mask has several.
#[test]
fn each_label_has_its_expected_error() {
    let p = phantom(&PhantomParams::new(PhantomKind::Block).sized(44)).unwrap();
    let n = p.mask.grid().len() / 2;
    let mut labels = p.mask.clone();
    labels.as_mut_slice()[..n].iter_mut().filter(|l| **l != 0).for_each(|l| *l = 7);
    let expected = measured(&p, Some(&labels), &FieldParams::default()).summary.expected;
    let names: Vec<u8> = expected.labels.iter().map(|l| l.label).collect();
    assert_eq!(names, [1, 7]);
    let mean = expected.labels.iter().map(|l| l.expected_error_mm).sum::<f64>() / 2.0;
    assert!((mean / expected.mean_mm - 1.0).abs() < 0.1, "{expected:?}");
    let sum: f64 = expected.sources.iter().map(|s| s.1).sum();
    assert!((sum - 1.0).abs() < 1e-9);
}

/// A model that was asked for and does not explain the volumes warns, and what it leaves out is its
/// error; one that does not contradict them is taken as it is. Two scans at rest give noise.
#[test]
fn a_model_that_was_asked_for_knows_what_it_leaves_out() {
    let p = troubled(&PhantomParams::new(PhantomKind::Head).sized(44), Trouble::Motion, 5.0).unwrap();
    for (model, named) in [
        (ModelSource::Identity, MotionModel::Identity),
        (ModelSource::Rigid, MotionModel::Rigid),
        (ModelSource::Affine, MotionModel::Affine),
        (ModelSource::Free, MotionModel::Free),
    ] {
        let found = measured(&p, None, &FieldParams { model, ..FieldParams::default() });
        let m = evaluate::metrics(&found.displacement, &p.truth, Some(&p.mask), &[]).unwrap();
        let (s, expected) = (&found.summary, &found.summary.expected);
        assert_eq!(s.model, named);
        assert_eq!(s.rejected, model != ModelSource::Free, "{:?}", s.evidence);
        assert_eq!(s.rejected, s.warnings.iter().any(|w| w.contains("asked for")), "{:?}", s.warnings);
        if s.rejected {
            let ratio = expected.mean_mm / m.mean_mm;
            assert!((0.7..1.5).contains(&ratio), "{named:?}: {:.2} mm for {:.2}", expected.mean_mm, m.mean_mm);
            assert!(m.mean_mm < 0.5 * m.identity_mm || expected.trust() == Trust::Low, "{named:?}: {expected:?}");
        }
    }
    let still = PhantomParams { motion: MotionKind::None, ..PhantomParams::new(PhantomKind::Head).sized(44) };
    let rest = phantom(&still).unwrap();
    let free = measured(&rest, None, &FieldParams { model: ModelSource::Free, ..FieldParams::default() });
    let m = evaluate::metrics(&free.displacement, &rest.truth, Some(&rest.mask), &[]).unwrap();
    assert!(m.mean_mm > 0.0 && free.summary.expected.interval_mm[1] > m.mean_mm, "{} mm", m.mean_mm);
}
