//! What a user knows of a pair: starts, masks, landmarks, other contrasts. Each scene has an exact
//! truth.

use crate::texture::Texture;
use palpate::error::FieldError;
use palpate::numerics::random::Random;
use palpate::pipeline::field::{FieldResult, run, run_from};
use palpate::pipeline::known::Known;
use palpate::pipeline::start::{Alignment, aligned};
use palpate::types::{
    Affine, AffineMap, DenseField, FieldParams, Grid, Landmark, Mask, MotionModel, Volume, Voxels, WorldPoint,
};

const SHAPE: [usize; 3] = [52, 48, 44];

fn grid(shape: [usize; 3]) -> Grid {
    Grid::new(shape, Affine::scaled([1.0; 3], [-20.0, -30.0, 10.0]).unwrap()).unwrap()
}

/// A bulge of `most` mm about the middle, smooth.
fn bulge(most: f64) -> impl Fn([f64; 3]) -> [f64; 3] + Sync + Copy {
    move |p| {
        let d = [p[0] - 6.0, p[1] + 6.0, p[2] - 32.0];
        let near = (-(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]) / (2.0 * 14.0 * 14.0)).exp();
        [most * near, 0.5 * most * near, -0.4 * most * near]
    }
}

/// A textured egg in air. `moved` is the displacement on the initial grid, `tone` what the deformed
/// volume shows of a brightness; `texture` (0 to 1) scales the texture by place.
struct Scene {
    initial: Volume,
    deformed: Volume,
    truth: DenseField,
    mask: Mask,
}

impl Scene {
    fn new(
        seed: u64,
        moved: impl Fn([f64; 3]) -> [f64; 3] + Sync,
        tone: impl Fn(f64) -> f64,
        texture: impl Fn([f64; 3]) -> f64 + Sync,
    ) -> Self {
        let grid = grid(SHAPE);
        let waves = Texture::new(seed);
        let inside = |p: [f64; 3]| {
            let d = [(p[0] - 5.5) / 21.0, (p[1] + 6.5) / 19.0, (p[2] - 31.5) / 17.0];
            d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
        };
        let brightness = |p: [f64; 3]| {
            let edge = 1.0 / (1.0 + (12.0 * (inside(p) - 1.0)).exp());
            edge * 500.0 * (1.0 + 0.3 * texture(p) * waves.at(p)).max(0.2)
        };
        // The content is fixed to the initial volume, so the deformed one asks where its tissue
        // came from.
        let origin = |y: [f64; 3]| {
            let mut x = y;
            for _ in 0..40 {
                let u = moved(x);
                x = std::array::from_fn(|a| y[a] - u[a]);
            }
            x
        };
        let noisy = |stream: u64, value: &(dyn Fn([f64; 3]) -> f64 + Sync)| {
            let mut random = Random::new(seed, stream);
            let of = |at: usize| (value(grid.centre(at).0) + 10.0 * random.normals()[0]) as f32;
            Volume::from_vec(grid, (0..grid.len()).map(of).collect()).unwrap()
        };
        let (initial, tone) = (noisy(1, &|p| brightness(p)), &tone);
        let values: Vec<f64> = (0..grid.len()).map(|at| tone(brightness(origin(grid.centre(at).0)))).collect();
        let mut random = Random::new(seed, 2);
        let deformed = values.into_iter().map(|v| (v + 10.0 * random.normals()[0]) as f32).collect();
        let deformed = Volume::from_vec(grid, deformed).unwrap();
        let truth = DenseField::from_fn(grid, |p| moved(p.0));
        let mask = Mask::from_voxels(grid, |_, p| u8::from(inside(p.0) < 0.9));
        Self { initial, deformed, truth, mask }
    }

    fn error(&self, found: &DenseField, inside: impl Fn(WorldPoint) -> bool) -> f64 {
        let grid = *self.mask.grid();
        let some: Vec<usize> =
            (0..grid.len()).filter(|&at| self.mask.as_slice()[at] != 0 && inside(grid.centre(at))).collect();
        let error = |&at: &usize| {
            let (u, t) = (found.at(at), self.truth.at(at));
            (0..3).map(|c| f64::from(u[c] - t[c]).powi(2)).sum::<f64>().sqrt()
        };
        some.iter().map(error).sum::<f64>() / some.len() as f64
    }

    fn known(&self) -> Known<'_> {
        Known::mask(Some(&self.mask))
    }
}

fn measured(initial: &Voxels<'_>, deformed: &Voxels<'_>, known: &Known<'_>) -> Result<FieldResult, FieldError> {
    run_from(initial, deformed, known, &FieldParams::default(), &[], &|_, _| ())
}

fn same(v: f64) -> f64 {
    v
}

/// The volume as it lies after an affine map of the world.
fn placed(volume: &Volume, map: &AffineMap) -> Volume {
    let grid = map.grid(volume.grid()).unwrap();
    volume.clone().placed(grid).unwrap()
}

/// The largest distance of `found` from `map` after `beyond` (mm), over the mask.
fn furthest(found: &FieldResult, map: &AffineMap, beyond: &FieldResult, mask: &Mask) -> f64 {
    let grid = *mask.grid();
    let inside = (0..grid.len()).filter(|&at| mask.as_slice()[at] != 0);
    let off = |at: usize| {
        let x = grid.centre(at);
        let there = map.at(x.moved(beyond.displacement.at(at).map(f64::from)));
        let own = x.moved(found.displacement.at(at).map(f64::from));
        own.minus(there).iter().map(|v| v * v).sum::<f64>().sqrt()
    };
    inside.map(off).fold(0.0, f64::max)
}

/// 35 degrees about an oblique axis, 8 % larger, and 60 mm away.
fn far() -> AffineMap {
    let (axis, angle) = ([0.6, 0.0, 0.8], 0.61f64);
    let (s, c) = angle.sin_cos();
    let k = [[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]];
    let shift = [60.0, -25.0, 12.0];
    let entry = |r: usize, j: usize| {
        let square: f64 = (0..3).map(|m| k[r][m] * k[m][j]).sum();
        1.08 * (f64::from(u8::from(r == j)) + s * k[r][j] + (1.0 - c) * square)
    };
    AffineMap::new(std::array::from_fn(|r| [entry(r, 0), entry(r, 1), entry(r, 2), shift[r]])).unwrap()
}

/// The affine part of a start costs nothing: the result is that of the pair without it, followed by
/// it, in every file that a run writes.
#[test]
fn an_affine_start_is_taken_out_and_put_back() {
    let scene = Scene::new(3, bulge(3.0), same, |_| 1.0);
    let (near, map) = (measured(&scene.initial, &scene.deformed, &scene.known()).unwrap(), far());
    let there = placed(&scene.deformed, &map);
    let start = |p: WorldPoint| Some(map.at(p));
    let found = measured(&scene.initial, &there, &Known { start: Some(&start), ..scene.known() }).unwrap();
    assert!(furthest(&found, &map, &near, &scene.mask) < 2e-3);
    for at in [1000, 50_000, 90_000] {
        let (x, own) = (scene.mask.grid().centre(at), found.displacement.at(at).map(f64::from));
        let stated = found.coefficients.at(at);
        assert!((0..3).all(|c| (stated[c] - own[c]).abs() < 1e-3), "{x:?} {own:?} {stated:?}");
    }
    for (a, b) in found.matches.kept().zip(near.matches.kept()) {
        let expected = map.at(b.initial.moved(b.displacement)).minus(b.initial);
        assert!((0..3).all(|c| (a.displacement[c] - expected[c]).abs() < 5e-3));
    }
    let start = found.summary.start.unwrap();
    assert_eq!(start.model_beyond, MotionModel::Free);
    assert!(start.affine_ras.iter().flatten().zip(map.rows().iter().flatten()).all(|(a, b)| (a - b).abs() < 1e-6));
    assert!((found.summary.expected.share() - near.summary.expected.share()).abs() < 0.02);
    assert!((found.uncertainty.at(50_000) / near.uncertainty.at(50_000) - 1.08).abs() < 0.02);
}

/// Volumes that do not overlap, or lie askew, are brought onto each other.
#[test]
fn volumes_that_lie_apart_are_aligned() {
    let scene = Scene::new(4, bulge(2.0), same, |_| 1.0);
    let away = AffineMap::new([[1.0, 0.0, 0.0, 60.0], [0.0, 1.0, 0.0, 5.0], [0.0, 0.0, 1.0, -40.0]]).unwrap();
    let there = placed(&scene.deformed, &away);
    let error = measured(&scene.initial, &there, &scene.known()).unwrap_err();
    assert!(error.to_string().contains("--initial centre"), "{error}");
    for (how, there, map) in [
        (Alignment::Centre, placed(&scene.deformed, &away), away),
        (Alignment::Moments, placed(&scene.deformed, &away), away),
        (Alignment::Principal, placed(&scene.deformed, &far()), far()),
    ] {
        let begin = aligned(&scene.initial, &there, how).unwrap();
        let start = |p: WorldPoint| Some(begin.at(p));
        let known = Known { start: Some(&start), ..Known::default() };
        let found = measured(&scene.initial, &there, &known).unwrap();
        let truth = |p: [f64; 3]| {
            let (x, u) = (WorldPoint(p), bulge(2.0)(p));
            map.at(x.moved(u)).minus(x)
        };
        let moved = Scene {
            truth: DenseField::from_fn(grid(SHAPE), |p| truth(p.0)),
            ..Scene::new(4, bulge(2.0), same, |_| 1.0)
        };
        let error = moved.error(&found.displacement, |_| true);
        assert!(error < 0.35, "{how:?}: {error}");
    }
}

/// A start that is more than affine is a hypothesis: a right one is taken, and a wrong one does no
/// harm.
#[test]
fn a_field_is_a_start_and_no_constraint() {
    let scene = Scene::new(5, bulge(3.0), same, |_| 1.0);
    let plain = scene.error(&measured(&scene.initial, &scene.deformed, &scene.known()).unwrap().displacement, |_| true);
    for (factor, what) in [(1.0, "right"), (-1.0, "turned round"), (0.0, "still")] {
        let start = |p: WorldPoint| Some(p.moved(bulge(3.0 * factor)(p.0)));
        let found = measured(&scene.initial, &scene.deformed, &Known { start: Some(&start), ..scene.known() }).unwrap();
        let error = scene.error(&found.displacement, |_| true);
        assert!(error < 1.15 * plain + 0.01, "{what}: {error} for {plain}");
    }
    let nowhere = |_: WorldPoint| None;
    let error =
        measured(&scene.initial, &scene.deformed, &Known { start: Some(&nowhere), ..scene.known() }).unwrap_err();
    assert!(error.to_string().contains("no value anywhere"), "{error}");
    let mirrored = |p: WorldPoint| Some(WorldPoint([-p.0[0], p.0[1], p.0[2]]));
    let error =
        measured(&scene.initial, &scene.deformed, &Known { start: Some(&mirrored), ..scene.known() }).unwrap_err();
    assert!(error.to_string().contains("inside out"), "{error}");
}

/// What does not count is not matched, in either volume: a bright object that stays where it is
/// while the tissue about it moves.
#[test]
fn what_does_not_count_does_not_pull() {
    let scene = Scene::new(6, |_| [2.5, 0.0, 0.0], same, |_| 1.0);
    let near = |p: WorldPoint| {
        let d = p.minus(WorldPoint([6.0, -6.0, 32.0]));
        d.iter().map(|v| v * v).sum::<f64>() < 81.0
    };
    let spoilt = |volume: &Volume| {
        let values = (0..volume.grid().len()).map(|at| match near(volume.grid().centre(at)) {
            true => 900.0 + 300.0 * ((at % 7) as f32 - 3.0) / 3.0,
            false => volume.as_slice()[at],
        });
        Volume::from_vec(*volume.grid(), values.collect()).unwrap()
    };
    let (initial, deformed) = (spoilt(&scene.initial), spoilt(&scene.deformed));
    let counts = Mask::from_voxels(grid(SHAPE), |_, p| u8::from(!near(p)));
    let outside = |p: WorldPoint| !near(p);
    let off = |known: Known<'_>| scene.error(&measured(&initial, &deformed, &known).unwrap().displacement, outside);
    let spoilt = off(scene.known());
    let both = Known { initial_counts: Some(&counts), deformed_counts: Some(&counts), ..scene.known() };
    let kept = off(both);
    assert!(kept < 0.05 && kept < 0.5 * spoilt, "{kept} for {spoilt}");
    // Nothing is said of voxels that were left out on purpose.
    let found = measured(&initial, &deformed, &both).unwrap();
    assert!(!found.summary.warnings.iter().any(|w| w.contains("not finite")), "{:?}", found.summary.warnings);
    let smaller = Mask::filled(grid([40, 40, 40]), 1);
    let error = measured(&initial, &deformed, &Known { deformed_counts: Some(&smaller), ..scene.known() }).unwrap_err();
    assert!(error.to_string().contains("the deformed mask"), "{error}");
}

/// Landmarks where texture hardly stands out of the noise: many halve the error.
#[test]
fn landmarks_help_where_texture_is_poor() {
    let scene = Scene::new(7, bulge(9.0), same, |_| 0.015);
    let axes = [[-8.0, 1.0, 10.0, 19.0], [-16.0, -9.0, -2.0, 5.0], [22.0, 28.0, 34.0, 40.0]];
    let place = |n: usize| [axes[0][n % 4], axes[1][n / 4 % 4], axes[2][n / 16]];
    let landmark = |p: [f64; 3]| Landmark { initial: WorldPoint(p), deformed: WorldPoint(p).moved(bulge(9.0)(p)) };
    let mut landmarks: Vec<Landmark> = (0..64).map(|n| landmark(place(n))).collect();
    let with = |landmarks: &[Landmark]| {
        let known = Known { landmarks, landmark_sd_mm: 0.5, ..scene.known() };
        measured(&scene.initial, &scene.deformed, &known).unwrap()
    };
    let plain = measured(&scene.initial, &scene.deformed, &scene.known());
    // Where nothing is measured without them, that is what they are held against.
    let still = DenseField::zeros(grid(SHAPE));
    let plain = scene.error(plain.as_ref().map_or(&still, |found| &found.displacement), |_| true);
    let right = with(&landmarks);
    let error = scene.error(&right.displacement, |_| true);
    assert!(error < 0.5 * plain, "{error} for {plain}: {:?} {:?}", right.summary.landmarks, right.summary.evidence);
    let report = right.summary.landmarks.unwrap();
    assert!(report.wrong.is_empty() && report.count == 64 && report.mean_mm < 1.0, "{report:?}");

    // One that is 15 mm off pulls hardly at all, and is named.
    landmarks[25].deformed = landmarks[25].deformed.moved([0.0, 15.0, 0.0]);
    let wrong = with(&landmarks);
    let spoilt = scene.error(&wrong.displacement, |_| true);
    assert!(spoilt < error + 0.2 * plain, "{spoilt} for {error}, {plain} without");
    assert_eq!(wrong.summary.landmarks.as_ref().unwrap().wrong, [26]);
    assert!(wrong.summary.warnings.iter().any(|w| w.contains("number 26")), "{:?}", wrong.summary.warnings);
}

/// Landmarks that moved further than is searched bring the volumes together.
#[test]
fn landmarks_far_apart_are_a_start() {
    let scene = Scene::new(3, bulge(3.0), same, |_| 1.0);
    let (near, map) = (measured(&scene.initial, &scene.deformed, &scene.known()).unwrap(), far());
    let places = [[0.0, -10.0, 25.0], [12.0, -6.0, 30.0], [4.0, 4.0, 36.0], [6.0, -14.0, 40.0], [2.0, 0.0, 22.0]];
    let landmark = |p: [f64; 3]| {
        let p = WorldPoint(p);
        Landmark { initial: p, deformed: map.at(p.moved(bulge(3.0)(p.0))) }
    };
    let landmarks = places.map(landmark);
    let known = Known { landmarks: &landmarks, ..scene.known() };
    let found = measured(&scene.initial, &placed(&scene.deformed, &map), &known).unwrap();
    assert!(furthest(&found, &map, &near, &scene.mask) < 0.6);
    assert!(found.summary.landmarks.unwrap().wrong.is_empty());
}

/// Landmarks that contradict the field widen its error.
#[test]
fn landmarks_that_contradict_the_field_count_against_it() {
    let scene = Scene::new(4, bulge(2.0), same, |_| 1.0);
    let landmark = |x: f64| {
        let p = WorldPoint([x, -6.0, 32.0]);
        Landmark { initial: p, deformed: p.moved([0.0, 0.0, 5.0]) }
    };
    let landmarks = [landmark(2.0), landmark(8.0), landmark(14.0)];
    let found = measured(&scene.initial, &scene.deformed, &Known { landmarks: &landmarks, ..scene.known() }).unwrap();
    assert!(scene.error(&found.displacement, |_| true) < 0.5);
    assert!(found.summary.expected.mean_mm > 2.0, "{}", found.summary.expected.mean_mm);
}

/// A slice stays one under a start, whatever rounding makes of its place, and is not turned over.
#[test]
fn a_slice_is_aligned_in_its_plane() {
    let scene = Scene::new(12, bulge(1.5), same, |_| 1.0);
    let slice = |volume: &Volume| {
        let grid = volume.grid();
        let [nx, ny, _] = grid.shape();
        let flat = Grid::new([nx, ny, 1], Affine::scaled([1.0; 3], grid.world(0, 0, 22).0).unwrap()).unwrap();
        let from = grid.index(0, 0, 22);
        Volume::from_vec(flat, volume.as_slice()[from..from + nx * ny].to_vec()).unwrap()
    };
    let (initial, still) = (slice(&scene.initial), slice(&scene.initial));
    for angle in [0.02f64, 0.3, 0.7] {
        let (s, c) = angle.sin_cos();
        let map = AffineMap::new([[c, -s, 0.0, 8.0], [s, c, 0.0, -5.0], [0.0, 0.0, 1.0, 3.0]]).unwrap();
        let there = placed(&still, &map);
        for how in [Alignment::Moments, Alignment::Principal] {
            let begin = aligned(&initial, &there, how).unwrap();
            if how == Alignment::Moments && angle > 0.1 {
                continue;
            }
            let start = |p: WorldPoint| Some(begin.at(p));
            let found = measured(&initial, &there, &Known { start: Some(&start), ..Known::default() }).unwrap();
            let grid = *initial.grid();
            let off = |at: usize| {
                let x = grid.centre(at);
                map.at(x)
                    .minus(x.moved(found.displacement.at(at).map(f64::from)))
                    .iter()
                    .map(|v| v * v)
                    .sum::<f64>()
                    .sqrt()
            };
            let worst = (0..grid.len()).filter(|&at| found.bodies.as_slice()[at] != 0).map(off).fold(0.0, f64::max);
            assert!(worst < 0.5, "{angle} {how:?}: {worst}");
        }
    }
}

/// What is left out leaves the foreground what it is.
#[test]
fn a_hole_adds_no_tissue() {
    let scene = Scene::new(6, bulge(1.0), same, |_| 1.0);
    let counts = Mask::from_voxels(grid(SHAPE), |_, p| {
        u8::from(p.minus(WorldPoint([6.0, -6.0, 32.0])).iter().map(|v| v * v).sum::<f64>() > 36.0)
    });
    let left_out = counts.as_slice().iter().filter(|c| **c == 0).count();
    let voxels = |known: Known<'_>| measured(&scene.initial, &scene.deformed, &known).unwrap().summary.mask_voxels;
    let (all, less) = (voxels(Known::default()), voxels(Known { initial_counts: Some(&counts), ..Known::default() }));
    assert!(all.abs_diff(less + left_out) < all / 50, "{all} {less} {left_out}");
}

/// Landmarks alone tell the motion of tissue that shows none: no smaller model hides them.
#[test]
fn landmarks_stand_against_stillness() {
    let scene = Scene::new(8, |_| [0.0; 3], same, |_| 1.0);
    let plain = run(&scene.initial, &scene.deformed, Some(&scene.mask), &FieldParams::default(), &|_, _| ()).unwrap();
    assert_eq!(plain.summary.model, MotionModel::Identity);
    let marked = |d: [f64; 3]| {
        let p = WorldPoint([6.0, -6.0, 32.0]);
        [Landmark { initial: p, deformed: p.moved(d) }]
    };
    let landmarks = marked([0.0; 3]);
    let found = measured(&scene.initial, &scene.deformed, &Known { landmarks: &landmarks, ..scene.known() }).unwrap();
    assert_eq!(found.summary.model, MotionModel::Identity);
    // The volumes know better than one that is wrong.
    let landmarks = marked([8.0, 0.0, 0.0]);
    let found = measured(&scene.initial, &scene.deformed, &Known { landmarks: &landmarks, ..scene.known() }).unwrap();
    assert!(scene.error(&found.displacement, |_| true) < 0.1);
    assert_eq!(found.summary.landmarks.unwrap().wrong, [1]);
}

/// Inverted and folded contrasts end near the error of one contrast, or say how unsure they are; in
/// one contrast, however its gain runs, nothing is recast.
#[test]
fn other_contrasts_are_brought_to_one() {
    let moved = bulge(3.0);
    let error = |tone: &dyn Fn(f64) -> f64| {
        let scene = Scene::new(9, moved, tone, |_| 1.0);
        let found = measured(&scene.initial, &scene.deformed, &scene.known()).unwrap();
        (scene.error(&found.displacement, |_| true), found)
    };
    let (plain, found) = error(&same);
    assert_eq!(found.summary.recast, None);
    let (power, _) = error(&|v| 1000.0 * (v / 1000.0).max(0.0).powf(0.4));
    assert!(power < 1.5 * plain + 0.02, "{power} for {plain}");
    let (inverted, found) = error(&|v| 1000.0 - v);
    assert!(found.summary.recast.is_some() && inverted < 1.5 * plain + 0.02, "{inverted} for {plain}");
    assert!(found.summary.agreement.found > found.summary.agreement.at_rest);
    // What two intensities look alike in is refused, or said to be unsure.
    let scene = Scene::new(9, moved, |v| 2.0 * (v - 500.0).abs(), |_| 1.0);
    if let Ok(found) = measured(&scene.initial, &scene.deformed, &scene.known()) {
        let folded = scene.error(&found.displacement, |_| true);
        assert_eq!(found.summary.recast, Some("initial"));
        assert!(folded < 1.5 * plain + 0.02 || found.summary.expected.mean_mm > 0.5 * folded, "{folded}");
    }
}

/// Volumes that have nothing in common are refused, or said to be of no use.
#[test]
fn nothing_in_common_is_no_measurement() {
    let (a, b) = (Scene::new(10, bulge(0.0), same, |_| 1.0), Scene::new(11, bulge(0.0), |v| 1000.0 - v, |_| 1.0));
    if let Ok(found) = measured(&a.initial, &b.deformed, &a.known()) {
        let s = &found.summary;
        assert!(s.agreement.found >= s.agreement.at_rest - 0.01, "{:?}", s.agreement);
        assert_eq!(s.expected.trust().name(), "low");
    }
}
