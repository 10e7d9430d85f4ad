//! Scenes of a few bodies that slide along each other. Each has an exact truth.

use crate::texture::Texture;
use palpate::evaluate;
use palpate::numerics::random::Random;
use palpate::pipeline::field::{FieldResult, run};
use palpate::pipeline::track::Tracker;
use palpate::types::params::BodySource;
use palpate::types::{Affine, DenseField, FieldParams, Grid, Mask, MotionModel, Volume};
use std::sync::LazyLock;

const SHAPE: [usize; 3] = [52, 48, 44];
/// The middle of the volume (mm).
const MIDDLE: [f64; 3] = [26.0, 24.0, 22.0];
/// Radius of the ball that turns (mm).
const BALL_RADIUS: f64 = 13.0;

/// A pair of volumes with its truth, and the label of each voxel (1, 2, ...).
struct Scene {
    initial: Volume,
    deformed: Volume,
    truth: DenseField,
    labels: Mask,
}

impl Scene {
    /// Tissue whose place `p` belongs to the body `label(p)` and moves to `moved(p)`.
    fn new(seed: u64, label: impl Fn([f64; 3]) -> u8 + Sync, moved: impl Fn([f64; 3]) -> [f64; 3] + Sync) -> Self {
        let grid = Grid::new(SHAPE, Affine::scaled([1.0; 3], [0.0; 3]).unwrap()).unwrap();
        let texture = Texture::new(seed);
        let content = |p: [f64; 3]| 300.0 * (1.0 + 0.3 * texture.at(p)).max(0.1);
        let noisy = |stream: u64, value: &dyn Fn([f64; 3]) -> f64| {
            let mut random = Random::new(seed, stream);
            let of = |at: usize| {
                let [i, j, k] = grid.voxel(at);
                (value(grid.world(i, j, k).0) + 8.0 * random.normals()[0]) as f32
            };
            Volume::from_vec(grid, (0..grid.len()).map(of).collect()).unwrap()
        };
        let truth = DenseField::from_fn(grid, |p| {
            let q = moved(p.0);
            std::array::from_fn(|a| q[a] - p.0[a])
        });
        Self {
            initial: noisy(1, &|p| content(moved(p))),
            deformed: noisy(2, &content),
            truth,
            labels: Mask::from_voxels(grid, |_, p| label(p.0)),
        }
    }

    /// A ball about the middle that turns by `angle` (radians) inside tissue at rest, along its own
    /// wall.
    fn ball(angle: f64, seed: u64) -> Self {
        let from = |p: [f64; 3]| -> [f64; 3] { std::array::from_fn(|a| p[a] - MIDDLE[a]) };
        let inside = move |p: [f64; 3]| from(p).iter().map(|v| v * v).sum::<f64>() < BALL_RADIUS * BALL_RADIUS;
        let turned = move |p: [f64; 3]| {
            let ([x, y, _], (s, c)) = (from(p), angle.sin_cos());
            [MIDDLE[0] + c * x - s * y, MIDDLE[1] + s * x + c * y, p[2]]
        };
        Self::new(seed, move |p| 1 + u8::from(inside(p)), move |p| if inside(p) { turned(p) } else { p })
    }

    /// Two halves that move apart along an oblique plane by `mm` each.
    fn halves(mm: f64, seed: u64) -> Self {
        let above = |p: [f64; 3]| p[2] - MIDDLE[2] > 0.4 * (p[0] - MIDDLE[0]);
        let along = [1.0 / 1.16f64.sqrt(), 0.0, 0.4 / 1.16f64.sqrt()];
        let moved = move |p: [f64; 3]| {
            let by = if above(p) { mm } else { -mm };
            std::array::from_fn(|a| p[a] + by * along[a])
        };
        Self::new(seed, move |p| 1 + u8::from(above(p)), moved)
    }

    /// One body, bent by `mm` at most.
    fn smooth(mm: f64, seed: u64) -> Self {
        let wave = move |v: f64| (2.0 * std::f64::consts::PI * (v + 7.0 * seed as f64) / 60.0).sin();
        let moved = move |p: [f64; 3]| [p[0] + mm * wave(p[1]), p[1], p[2] + 0.5 * mm * wave(p[0])];
        Self::new(seed, |_| 1, moved)
    }

    fn measured(&self, mask: Option<&Mask>, params: &FieldParams) -> FieldResult {
        run(&self.initial, &self.deformed, mask, params, &|_, _| {}).unwrap()
    }

    /// Mean error (mm) over the voxels of one label at least four voxels away from the volume's
    /// faces.
    fn error(&self, found: &FieldResult, label: u8) -> f64 {
        let mut part = self.labels.clone();
        let grid = *part.grid();
        for (at, l) in part.as_mut_slice().iter_mut().enumerate() {
            let inner = (0..3).all(|a| (4..SHAPE[a] - 4).contains(&grid.voxel(at)[a]));
            *l = u8::from(*l == label && inner);
        }
        evaluate::metrics(&found.displacement, &self.truth, Some(&part), &[]).unwrap().mean_mm
    }

    /// Dice's coefficient of a true label and the body that shares most with it.
    fn dice(&self, found: &FieldResult, label: u8) -> f64 {
        let pairs = || self.labels.as_slice().iter().zip(found.bodies.as_slice());
        let count = |holds: &dyn Fn(u8, u8) -> bool| pairs().filter(|(a, b)| holds(**a, **b)).count() as f64;
        let with = |body: u8| {
            2.0 * count(&|a, b| a == label && b == body) / (count(&|a, _| a == label) + count(&|_, b| b == body))
        };
        found.summary.bodies.iter().map(|b| with(b.label)).fold(0.0, f64::max)
    }
}

/// A ball that has turned, and what is found of it.
fn turned() -> &'static (Scene, FieldResult) {
    static MEASURED: LazyLock<(Scene, FieldResult)> = LazyLock::new(|| {
        let scene = Scene::ball(0.35, 3);
        let two = rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap();
        let found = two.install(|| scene.measured(None, &FieldParams::default()));
        (scene, found)
    });
    &MEASURED
}

/// A smooth field across the wall lost the ball's motion: 2.9 of 3.4 mm.
#[test]
fn a_ball_that_turns_in_its_wall_is_a_body_of_its_own() {
    let (scene, found) = turned();
    assert_eq!(found.summary.bodies.len(), 2, "{:?}", found.summary.evidence);
    assert!(scene.dice(found, 1) > 0.9 && scene.dice(found, 2) > 0.9, "{:?}", found.summary.bodies);
    assert_eq!(found.summary.folds, 0);
    let bonded = FieldParams { bodies: BodySource::Bonded, ..FieldParams::default() };
    let one = scene.measured(None, &bonded);
    assert_eq!(one.summary.bodies.len(), 1);
    let [own, rest] = [2, 1].map(|label| scene.error(found, label));
    assert!(own < 0.4 && own < scene.error(&one, 2) / 3.0, "{own} for {}", scene.error(&one, 2));
    assert!(rest < scene.error(&one, 1), "{rest} for {}", scene.error(&one, 1));
}

#[test]
fn given_bodies_are_taken_as_they_are_and_may_be_rigid() {
    let scene = Scene::ball(0.35, 2);
    let given = FieldParams { bodies: BodySource::Given, ..FieldParams::default() };
    let mut named = scene.labels.clone();
    named.as_mut_slice().iter_mut().for_each(|l| *l = if *l == 2 { 7 } else { 3 });
    let free = scene.measured(Some(&named), &given);
    assert!(free.bodies == named, "the labels come back");
    let labels = |r: &FieldResult| r.summary.bodies.iter().map(|b| b.label).collect::<Vec<_>>();
    assert_eq!(labels(&free), [3, 7]);
    assert!(scene.error(&free, 2) < 0.2 && scene.error(&free, 1) < 0.1, "{}", scene.error(&free, 2));
    let rigid = scene.measured(Some(&named), &FieldParams { rigid: vec![7], ..given });
    assert_eq!(rigid.summary.bodies[1].model, MotionModel::Rigid);
    assert!(scene.error(&rigid, 2) < 0.05, "{}", scene.error(&rigid, 2));
}

#[test]
fn halves_that_slide_keep_their_jump_and_fold_nowhere() {
    for seed in [3, 4] {
        let scene = Scene::halves(3.0, seed);
        let found = scene.measured(None, &FieldParams::default());
        assert_eq!(found.summary.bodies.len(), 2, "{:?}", found.summary.evidence);
        assert_eq!(found.summary.folds, 0);
        let slides = found.summary.bodies[0].slides_mm;
        assert!((slides - 6.0).abs() < 0.6, "{slides}");
        for label in [1, 2] {
            assert!(scene.error(&found, label) < 0.15, "{}", scene.error(&found, label));
        }
    }
}

/// Smooth motion, small and large, with noise, is one body: none of these is split.
#[test]
fn one_body_is_not_split() {
    for seed in 0..12 {
        let scene = Scene::smooth([0.0, 0.6, 2.0, 4.0][seed as usize % 4], seed);
        let found = scene.measured(None, &FieldParams::default());
        assert_eq!(found.summary.bodies.len(), 1, "seed {seed}: {:?}", found.summary.evidence);
    }
}

#[test]
fn bodies_are_the_same_whatever_the_number_of_threads_and_the_order_of_storage() {
    let (scene, two) = turned();
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let one = one.install(|| scene.measured(None, &FieldParams::default()));
    assert_eq!(one.summary.bodies.len(), 2);
    assert!(one.displacement == two.displacement && one.bodies == two.bodies);
    // The same volumes stored from right to left.
    let flipped = |v: &Volume| {
        let [nx, _, _] = SHAPE;
        let rows = [[-1.0, 0.0, 0.0, (nx - 1) as f64], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
        let grid = Grid::new(SHAPE, Affine::new(rows).unwrap()).unwrap();
        let other = |at: usize| at / nx * nx + nx - 1 - at % nx;
        Volume::from_vec(grid, (0..grid.len()).map(|at| v.as_slice()[other(at)]).collect()).unwrap()
    };
    let [first, second] = [&scene.initial, &scene.deformed].map(flipped);
    let turned = run(&first, &second, None, &FieldParams::default(), &|_, _| {}).unwrap();
    let nx = SHAPE[0];
    let same = (0..turned.bodies.as_slice().len())
        .all(|at| turned.bodies.as_slice()[at] == one.bodies.as_slice()[at / nx * nx + nx - 1 - at % nx]);
    assert!(same);
}

/// Voxels shared out wrongly at the wall passed for crusts of bodies of their own.
#[test]
fn a_wall_makes_no_further_bodies() {
    for seed in [1, 4, 9] {
        let found = Scene::ball(0.35, seed).measured(None, &FieldParams::default());
        assert_eq!(found.summary.bodies.len(), 2, "seed {seed}: {:?}", found.summary.evidence);
    }
}

/// A frame that starts from the frame before keeps its bodies.
#[test]
fn frames_of_a_sequence_hand_their_bodies_on() {
    let angles = [0.15, 0.25, 0.35];
    // Turned backwards, the deformed volume is that of rest and the initial one the frame.
    let back = angles.map(|angle| Scene::ball(-angle, 3));
    let params = FieldParams::default();
    let mut tracker = Tracker::new(&back[0].deformed, None, &params);
    for (angle, frame) in angles.into_iter().zip(&back) {
        let found = tracker.next(&frame.initial, &|_, _| {}).unwrap();
        assert_eq!(found.summary.bodies.len(), 2, "{angle}: {:?}", found.summary.evidence);
        let error = Scene::ball(angle, 3).error(&found, 2);
        assert!(error < 0.3, "{angle}: {error}");
    }
}
