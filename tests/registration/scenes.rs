//! Scenes in which grey values mislead: bright tissue that does not move, a bright background, hot
//! voxels, padding. Each has an exact truth.

use palpate::evaluate;
use palpate::numerics::random::Random;
use palpate::pipeline::field::{FieldResult, run};
use palpate::synth::MotionKind;
use palpate::types::{Affine, DenseField, FieldParams, Grid, Mask, MotionModel, Volume};
use palpate::{PhantomKind, PhantomParams, phantom};

const SHAPE: [usize; 3] = [56, 56, 48];

/// A sum of plane waves of 6 to 14 voxels with random phases, of variance 1.
struct Texture(Vec<([f64; 3], f64)>);

impl Texture {
    fn new(seed: u64) -> Self {
        let mut random = Random::new(seed, 5);
        let wave = |random: &mut Random| {
            let direction = random.direction();
            let wavelength = random.uniform(6.0, 14.0);
            (direction.map(|d| 2.0 * std::f64::consts::PI * d / wavelength), random.uniform(0.0, 6.3))
        };
        Self((0..40).map(|_| wave(&mut random)).collect())
    }

    fn at(&self, p: [f64; 3]) -> f64 {
        let wave = |(k, phase): &([f64; 3], f64)| (k[0] * p[0] + k[1] * p[1] + k[2] * p[2] + phase).cos();
        self.0.iter().map(wave).sum::<f64>() * (2.0 / self.0.len() as f64).sqrt()
    }
}

/// A pair with its truth: muscle that slips along a limb's axis by 3 mm at most, inside a ring of
/// fat that does not move.
#[derive(Clone)]
struct Limb {
    initial: Volume,
    deformed: Volume,
    truth: DenseField,
    mask: Mask,
}

/// Radii of muscle and skin (voxels), about the middle of the grid.
const RADII: [f64; 2] = [19.0, 25.0];

fn radius(p: [f64; 3]) -> f64 {
    ((p[0] - 27.5).powi(2) + (p[1] - 27.5).powi(2)).sqrt()
}

/// Displacement along z (mm).
fn slip(p: [f64; 3]) -> f64 {
    let rest = 1.0 - (radius(p) / RADII[0]).powi(2);
    if rest > 0.0 { 3.0 * rest * rest } else { 0.0 }
}

/// Fat `ratio` times as bright as muscle, and `air` around.
fn limb(ratio: f64, air: f64, seed: u64) -> Limb {
    let grid = Grid::new(SHAPE, Affine::scaled([1.0; 3], [0.0; 3]).unwrap()).unwrap();
    let (muscle, fat) = (Texture::new(seed), Texture::new(seed + 100));
    let content = |p: [f64; 3]| {
        let r = radius(p);
        let step = |edge: f64| (edge - r + 0.5).clamp(0.0, 1.0);
        let inside = 300.0 * (1.0 + 0.3 * muscle.at(p)).max(0.2);
        let around = 300.0 * ratio * (1.0 + 0.15 * fat.at(p)).max(0.2);
        let body = step(RADII[0]) * inside + (1.0 - step(RADII[0])) * around;
        step(RADII[1]) * body + (1.0 - step(RADII[1])) * air
    };
    let noisy = |stream: u64, value: &dyn Fn([f64; 3]) -> f64| {
        let mut random = Random::new(seed, stream);
        let values =
            (0..grid.len()).map(|at| (value(grid.voxel(at).map(|v| v as f64)) + 6.0 * random.normals()[0]) as f32);
        Volume::from_vec(grid, values.collect()).unwrap()
    };
    let moved = |p: [f64; 3]| content([p[0], p[1], p[2] + slip(p)]);
    let tissue = |p: [f64; 3]| radius(p) < RADII[1] - 1.0 && p[2] > 2.0 && p[2] < 42.0;
    Limb {
        initial: noisy(1, &moved),
        deformed: noisy(2, &content),
        truth: DenseField::from_fn(grid, |p| [0.0, 0.0, slip(p.0)]),
        mask: Mask::from_voxels(grid, |_, v| u8::from(tissue(v.0))),
    }
}

fn measured(limb: &Limb, mask: bool) -> (FieldResult, f64) {
    let given = mask.then_some(&limb.mask);
    let result = run(&limb.initial, &limb.deformed, given, &FieldParams::default(), &|_, _| {}).unwrap();
    let error = evaluate::metrics(&result.displacement, &limb.truth, Some(&limb.mask), &[]).unwrap().mean_mm;
    (result, error)
}

/// Beside still fat several times as bright, the muscle inside it came out as "nothing moved", with
/// high trust.
#[test]
fn a_still_bright_ring_does_not_hide_the_muscle_inside_it() {
    let (_, plain) = measured(&limb(1.2, 0.0, 3), false);
    assert!(plain < 0.15, "{plain}");
    for (ratio, worse) in [(3.0, 1.15), (5.0, 1.15), (8.0, 1.5)] {
        let limb = limb(ratio, 0.0, 3);
        for mask in [false, true] {
            let (result, error) = measured(&limb, mask);
            assert_eq!(result.summary.model, MotionModel::Free, "{ratio} {:?}", result.summary.evidence);
            assert!(error < worse * plain.max(0.1), "ratio {ratio}, mask {mask}: {error} for {plain}");
        }
    }
}

/// A background brighter than all tissue made the tissue a hole in the foreground.
#[test]
fn a_bright_background_does_not_hide_the_tissue() {
    let (_, clean) = measured(&limb(1.2, 0.0, 4), false);
    for air in [900.0, 12_000.0] {
        let (_, error) = measured(&limb(1.2, air, 4), false);
        assert!(error < 1.3 * clean.max(0.1), "background {air}: {error} for {clean}");
    }
}

/// Padding far from all intensities stretched the range in which tissue was looked for.
#[test]
fn padding_of_any_value_is_background() {
    let clean = limb(1.2, 0.0, 5);
    let (_, least) = measured(&clean, false);
    for value in [65_535.0, -32_768.0, 1e6, -1e6f32] {
        let padded = |volume: &Volume| {
            let grid = *volume.grid();
            let outside = |at: usize| radius(grid.voxel(at).map(|v| v as f64)) > RADII[1] + 1.5;
            let value = |at: usize, v: f32| if outside(at) { value } else { v };
            let values = volume.as_slice().iter().enumerate().map(|(at, &v)| value(at, v));
            Volume::from_vec(grid, values.collect()).unwrap()
        };
        let pair = Limb { initial: padded(&clean.initial), deformed: padded(&clean.deformed), ..clean.clone() };
        let (_, error) = measured(&pair, false);
        assert!(error < 1.3 * least, "{value}: {error} for {least}");
    }
}

/// One voxel at thirty times the maximum cost four times the error, and three in a row more.
#[test]
fn hot_voxels_cost_no_accuracy() {
    let clean = limb(1.2, 0.0, 6);
    let (_, least) = measured(&clean, false);
    for (count, times, run_of) in [(1, 30.0, 1), (100, 100.0, 1), (20, 10.0, 2), (20, 30.0, 3)] {
        let hot = |volume: &Volume, stream: u64| {
            let mut random = Random::new(9, stream);
            let mut values = volume.as_slice().to_vec();
            let most = values.iter().fold(0.0f32, |m, v| m.max(*v));
            for _ in 0..count {
                let at = (random.uniform(0.0, 1.0) * (values.len() - run_of) as f64) as usize;
                values[at..at + run_of].fill(times * most);
            }
            Volume::from_vec(*volume.grid(), values).unwrap()
        };
        for both in [false, true] {
            let pair = Limb {
                initial: hot(&clean.initial, 1),
                deformed: if both { hot(&clean.deformed, 2) } else { clean.deformed.clone() },
                ..clean.clone()
            };
            let (_, error) = measured(&pair, false);
            assert!(error < 1.1 * least, "{count} at {times}, {run_of} in a row: {error} for {least}");
        }
    }
}

#[test]
fn a_body_that_turned_far_is_found() {
    let turned = |kind, size, degrees| {
        let params = PhantomParams::new(kind).sized(size).moving(MotionKind::Rotate);
        let pair = phantom(&PhantomParams { amplitude: degrees, ..params }).unwrap();
        let found = run(&pair.initial, &pair.deformed, Some(&pair.mask), &FieldParams::default(), &|_, _| {}).unwrap();
        evaluate::metrics(&found.displacement, &pair.truth, Some(&pair.mask), &[]).unwrap()
    };
    for (kind, size, degrees, bar) in [
        (PhantomKind::Slice, 128, 50.0, 0.01),
        (PhantomKind::Slice, 128, 140.0, 0.01),
        (PhantomKind::Calf, 56, 45.0, 0.02),
        (PhantomKind::Calf, 56, 60.0, 0.02),
    ] {
        let score = turned(kind, size, degrees);
        assert!(score.mean_mm < bar * score.identity_mm, "{kind:?} {degrees}: {score:?}");
    }
}

#[test]
fn the_field_is_the_same_for_any_number_of_threads() {
    let limb = limb(5.0, 0.0, 7);
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| measured(&limb, false).0.displacement)
    };
    assert_eq!(on(1), on(3));
}
