//! Intensities of any size, sign and resolution: what the volumes show decides, not the numbers
//! they show it in.

use palpate::evaluate::metrics;
use palpate::pipeline::field::run;
use palpate::synth::{MotionKind, Phantom, PhantomKind, PhantomParams, phantom};
use palpate::types::{FieldParams, Volume};

fn pair() -> Phantom {
    let params = PhantomParams { motion: MotionKind::Smooth, amplitude: 3.0, ..PhantomParams::new(PhantomKind::Block) };
    phantom(&params.sized(40)).unwrap()
}

fn mapped(v: &Volume, f: impl Fn(f32) -> f32) -> Volume {
    Volume::from_vec(*v.grid(), v.as_slice().iter().map(|&x| f(x)).collect()).unwrap()
}

/// Mean error over the mask (mm).
fn error(p: &Phantom, initial: &Volume, deformed: &Volume) -> f64 {
    let found = run(initial, deformed, Some(&p.mask), &FieldParams::default(), &|_, _| {}).unwrap();
    metrics(&found.displacement, &p.truth, Some(&p.mask), &[]).unwrap().mean_mm
}

#[test]
fn scale_sign_offset_and_resolution_of_the_intensities() {
    let p = pair();
    let usual = error(&p, &p.initial, &p.deformed);
    let top = p.initial.as_slice().iter().copied().fold(0.0f32, f32::max);
    let sorted = {
        let mut all = p.initial.as_slice().to_vec();
        all.sort_by(f32::total_cmp);
        all
    };
    let high = sorted[sorted.len() * 9 / 10];
    type Map<'a> = Box<dyn Fn(f32) -> f32 + 'a>;
    let cases: [(&str, Map<'_>, f64); 8] = [
        ("times 1e-30", Box::new(|x| 1e-30 * x), 1.1),
        ("times 1e30", Box::new(|x| 1e30 * x), 1.1),
        ("negative", Box::new(|x| x - 2.0 * top), 1.1),
        ("upside down", Box::new(|x| -x), 1.1),
        ("far from zero", Box::new(|x| x + 300.0 * top), 1.3),
        ("8 bits", Box::new(|x| (255.0 * x / top).round().clamp(0.0, 255.0)), 1.3),
        ("4 bits", Box::new(|x| (15.0 * x / top).round().clamp(0.0, 15.0)), 2.0),
        ("a tenth saturated", Box::new(|x| x.min(high)), 2.0),
    ];
    for (name, map, factor) in cases {
        let found = error(&p, &mapped(&p.initial, &map), &mapped(&p.deformed, &map));
        assert!(found < factor * usual, "{name}: {found:.4} mm, {usual:.4} as it is");
    }
    for factor in [1e-20f32, 0.01, 0.3, 3.0, 30.0, 1000.0, 1e20] {
        let found = error(&p, &p.initial, &mapped(&p.deformed, |x| factor * (x + 70.0)));
        assert!(found < 1.1 * usual, "deformed times {factor}: {found:.4} mm, {usual:.4} as it is");
    }
}

#[test]
fn single_voxels_without_a_number_and_a_constant_half() {
    let p = pair();
    let usual = error(&p, &p.initial, &p.deformed);
    let holes = |v: &Volume, value: f32| {
        let mut out = v.clone();
        out.as_mut_slice().iter_mut().step_by(997).for_each(|x| *x = value);
        out
    };
    for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let (initial, deformed) = (holes(&p.initial, value), holes(&p.deformed, value));
        let found = run(&initial, &deformed, Some(&p.mask), &FieldParams::default(), &|_, _| {}).unwrap();
        let mean = metrics(&found.displacement, &p.truth, Some(&p.mask), &[]).unwrap().mean_mm;
        assert!(mean < 3.0 * usual, "{value}: {mean:.4} mm, {usual:.4} without");
        assert!(found.displacement.as_slice().iter().all(|d| d.is_finite()));
        let told = found.summary.warnings.iter().any(|w| w.contains("not finite"));
        assert!(told, "{:?}", found.summary.warnings);
    }
    let n = p.initial.grid().len() / 2;
    let half = |v: &Volume| {
        let mut out = v.clone();
        out.as_mut_slice()[..n].fill(100.0);
        out
    };
    let found = run(&half(&p.initial), &half(&p.deformed), Some(&p.mask), &FieldParams::default(), &|_, _| {}).unwrap();
    assert!(found.displacement.as_slice().iter().all(|d| d.is_finite()));
    // Where nothing is seen the stated uncertainty is larger.
    let mean = |part: std::ops::Range<usize>| {
        let inside: Vec<usize> = part.filter(|&at| p.mask.as_slice()[at] != 0).collect();
        inside.iter().map(|&at| f64::from(found.uncertainty.at(at))).sum::<f64>() / inside.len() as f64
    };
    // Beside the half that shows texture its motion is carried over well.
    let (blind, seen) = (mean(0..n / 2), mean(n..2 * n));
    assert!(blind > 2.0 * seen, "{blind:.3} mm blind, {seen:.3} mm seen");
}
