//! The elastic solver against closed forms and itself, and the phantoms made with it.

use palpate::synth::elastic::blocks::{Ball, block_with_balls, dome};
use palpate::synth::elastic::hexahedra::{HELD, PRESSED, Surfaces};
use palpate::synth::elastic::material::Lame;
use palpate::synth::elastic::newton::{Equilibrium, Problem, equilibrium};
use palpate::synth::elastic::press;
use palpate::synth::elastic::tissue::Tissue;
use palpate::synth::{ElasticParams, MotionKind, Phantom, PhantomKind, PhantomParams, phantom};
use palpate::types::WorldPoint;

const SIDES: [f64; 3] = [12.0, 10.0, 8.0];

fn ball() -> Ball {
    Ball { centre: [5.5, 5.2, 3.8], radius: 2.0 }
}

fn project(surfaces: Surfaces, p: [f64; 3]) -> [f64; 3] {
    let ball = ball();
    let d: [f64; 3] = std::array::from_fn(|a| p[a] - ball.centre[a]);
    let r = d.iter().map(|v| v * v).sum::<f64>().sqrt();
    if surfaces & 4 != 0 { std::array::from_fn(|a| ball.centre[a] + ball.radius / r * d[a]) } else { p }
}

/// A block with a ball of `moduli[1]` in one of `moduli[0]` (kPa), nu 0.49.
fn solved(
    moduli: [f64; 2],
    halvings: usize,
    boundary: &dyn Fn(Surfaces, [f64; 3]) -> [Option<f64>; 3],
    guess: &dyn Fn([f64; 3]) -> [f64; 3],
) -> Equilibrium {
    let problem = Problem {
        mesh: block_with_balls([0.0; 3], SIDES, &[ball()]),
        project: &project,
        lame: moduli.map(|e| Lame::new(e, 0.49)).to_vec(),
        boundary,
        guess,
        plate: None,
        halvings,
    };
    equilibrium(&problem).unwrap()
}

/// The side, 0 or 1, of the block along `axis` that a place lies on.
fn on(p: [f64; 3], axis: usize) -> Option<usize> {
    [0.0, SIDES[axis]].iter().position(|v| (p[axis] - v).abs() < 1e-9)
}

fn furthest(solved: &Equilibrium, exact: impl Fn([f64; 3]) -> [f64; 3]) -> f64 {
    let nodes = solved.space.nodes.iter().zip(&solved.displacement);
    nodes
        .flat_map(|(x, u)| (0..3).map(move |c| (*x, *u, c)))
        .map(|(x, u, c)| (u[c] - exact(x)[c]).abs())
        .fold(0.0, f64::max)
}

#[test]
fn a_patch_of_distorted_elements_keeps_a_finite_affine_motion() {
    let m = [[0.03, 0.05, -0.02], [0.01, -0.04, 0.06], [-0.05, 0.02, -0.06]];
    let affine = |x: [f64; 3]| std::array::from_fn(|r| (0..3).map(|c| m[r][c] * x[c]).sum());
    let outside = |_: Surfaces, x: [f64; 3]| {
        let held = (0..3).any(|a| on(x, a).is_some());
        affine(x).map(|u: f64| held.then_some(u))
    };
    // From nothing inside, so that the solver has something to do.
    let s = solved([20.0, 20.0], 1, &outside, &|x| affine(x).map(|u: f64| 0.9 * u));
    assert!(furthest(&s, affine) < 1e-5, "{}", furthest(&s, affine));
}

#[test]
fn a_bar_and_a_confined_block_follow_their_closed_forms() {
    let Lame { mu, lambda } = Lame::new(20.0, 0.49);
    let stretch = 0.92;
    let base = SIDES[0] * SIDES[1];
    let stress = |z: f64, t: f64| mu * (z - 1.0 / z) + lambda * (z * t * t).ln() / z;
    // The bar's width: mu (t^2 - 1) + lambda ln(z t^2) = 0, by bisection.
    let (mut low, mut high) = (1.0, 1.2);
    for _ in 0..60 {
        let t: f64 = (low + high) / 2.0;
        let pull = mu * (t * t - 1.0) + lambda * (stretch * t * t).ln();
        if pull > 0.0 { high = t } else { low = t }
    }
    for (confined, width) in [(false, low), (true, 1.0)] {
        let boundary = |_: Surfaces, x: [f64; 3]| {
            let side = |a: usize| on(x, a).filter(|&high| high == 0 || confined).map(|_| 0.0);
            [side(0), side(1), on(x, 2).map(|high| high as f64 * (stretch - 1.0) * SIDES[2])]
        };
        let exact = |x: [f64; 3]| [(width - 1.0) * x[0], (width - 1.0) * x[1], (stretch - 1.0) * x[2]];
        let s = solved([20.0, 20.0], 1, &boundary, &|x| [0.0, 0.0, (stretch - 1.0) * x[2]]);
        assert!(furthest(&s, exact) < 2e-5, "{confined}: {}", furthest(&s, exact));
        let force = s.levels[1].force;
        assert!((force / (base * stress(stretch, width)) - 1.0).abs() < 1e-5, "{confined}: {force}");
    }
}

/// Held below, pressed by `travel` above, stuck at both.
fn stuck(travel: f64, halvings: usize) -> Equilibrium {
    let boundary = move |s: Surfaces, _: [f64; 3]| match s {
        s if s & HELD != 0 => [Some(0.0); 3],
        s if s & PRESSED != 0 => [Some(0.0), Some(0.0), Some(-travel)],
        _ => [None; 3],
    };
    solved([20.0, 100.0], halvings, &boundary, &move |x| [0.0, 0.0, -travel * x[2] / SIDES[2]])
}

#[test]
fn the_force_is_the_slope_of_the_energy_and_balanced() {
    let (low, middle, high) = (stuck(0.55, 1), stuck(0.56, 1), stuck(0.57, 1));
    let slope = (high.energy - low.energy) / 0.02;
    let force = -middle.levels[1].force;
    assert!((force / slope - 1.0).abs() < 1e-4, "{force} {slope}");
    let on_side = |side: Surfaces| {
        let pairs = middle.space.surfaces.iter().zip(&middle.forces).filter(|(s, _)| **s & side != 0);
        pairs.map(|(_, f)| f[2]).sum::<f64>()
    };
    assert!((on_side(HELD) + on_side(PRESSED)).abs() < 1e-4 * force, "{} {}", on_side(HELD), on_side(PRESSED));
}

#[test]
fn halving_the_elements_brings_the_solution_nearer_at_the_rate_of_quadratic_ones() {
    // The gradient of a harmonic polynomial is a solution of linear elasticity at any Poisson's
    // ratio; at strains of 1e-4 neo-Hookean tissue is as good as linear. It is a cubic, which
    // quadratic elements do not hold.
    let harmonic = |x: [f64; 3]| {
        let [a, b, c] = [0, 1, 2].map(|n| x[n] - SIDES[n] / 2.0);
        let scale = 1e-6;
        [
            scale * (a * a * a - 3.0 * a * b * b),
            scale * (2.0 * b * b * b - 3.0 * b * (a * a + c * c)),
            scale * (c * c * c - 3.0 * c * b * b),
        ]
    };
    let outside = |_: Surfaces, x: [f64; 3]| harmonic(x).map(|u| (0..3).any(|a| on(x, a).is_some()).then_some(u));
    let error = |halvings: usize| {
        let s = solved([20.0, 20.0], halvings, &outside, &harmonic);
        let squares = s.space.nodes.iter().zip(&s.displacement);
        let sum: f64 = squares.map(|(x, u)| (0..3).map(|c| (u[c] - harmonic(*x)[c]).powi(2)).sum::<f64>()).sum();
        (sum / s.space.nodes.len() as f64).sqrt()
    };
    let errors = [0, 1, 2].map(error);
    // Order 2.8 and more over the two halvings.
    assert!(errors[0] / errors[1] > 4.0 && errors[0] / errors[2] > 49.0, "{errors:?}");
    // Stuck to a plate, rims are singular: less than that, but ever nearer.
    let s = stuck(0.56, 2);
    let [a, b] = [s.levels[1], s.levels[2]];
    assert!(b.change[0] < 0.45 * a.change[0], "{} {}", a.change[0], b.change[0]);
    assert!((b.force / a.force - 1.0).abs() < 0.004, "{} {}", a.force, b.force);
}

#[test]
fn a_ball_on_a_plate_neither_pierces_it_nor_sticks_to_it() {
    let radius = 9.0;
    let problem = Problem {
        mesh: dome([0.0; 3], &[[radius; 3]]),
        project: &|s, p| {
            let r = p.iter().map(|v| v * v).sum::<f64>().sqrt();
            if s & 4 != 0 { p.map(|v| v * radius / r) } else { p }
        },
        lame: vec![Lame::new(20.0, 0.49)],
        boundary: &|s, _| if s & HELD != 0 { [Some(0.0); 3] } else { [None; 3] },
        guess: &|p| [0.0, 0.0, -0.6 * p[2] / radius],
        plate: Some(0.6 - radius),
        halvings: 1,
    };
    let s = equilibrium(&problem).unwrap();
    let largest = s.forces.iter().map(|f| f[2]).fold(0.0, f64::max);
    let (mut touching, mut width) = (0, 0.0f64);
    for n in 0..s.space.nodes.len() {
        if s.space.surfaces[n] & (PRESSED | HELD) == PRESSED {
            let gap = s.space.nodes[n][2] + s.displacement[n][2] - (0.6 - radius);
            assert!(gap > -1e-3 && s.forces[n][2] > -1e-2 * largest, "{gap} {}", s.forces[n][2]);
            if gap < 1e-9 {
                touching += 1;
                width = width.max(s.space.nodes[n][0].hypot(s.space.nodes[n][1]));
            } else {
                assert!(s.forces[n][2].abs() < 1e-4 * largest);
            }
        }
    }
    // Hertz (1881): a^2 = R d. The base is near and stiff, so the force is above his 4/3 E* (R
    // d^3)^(1/2), but not far.
    let hertz = 4.0 / 3.0 * 20.0 / (1.0 - 0.49f64.powi(2)) * (radius * 0.6f64.powi(3)).sqrt();
    let force = s.levels[1].force;
    assert!(touching > 20 && (width / (radius * 0.6).sqrt() - 1.0).abs() < 0.25, "{touching} {width}");
    assert!((0.95..1.35).contains(&(force / hertz)), "{force} {hertz}");
}

fn small(kind: PhantomKind, n: usize) -> PhantomParams {
    PhantomParams { noise: 0.0, bias: 0.0, ..PhantomParams::new(kind).sized(n) }
}

#[test]
fn images_and_truth_are_inverse_to_each_other() {
    let params = small(PhantomKind::Slab, 24);
    let grid = params.grid().unwrap();
    let pressed = press(&params, Tissue::new(&params, &grid), 1).unwrap();
    let origins = pressed.origins(&grid);
    let inside = |x: &WorldPoint| pressed.tissue().region(*x).is_some();
    let (places, found): (Vec<usize>, Vec<WorldPoint>) =
        origins.iter().enumerate().filter_map(|(at, x)| x.filter(inside).map(|x| (at, x))).step_by(7).unzip();
    assert!(found.len() > 500);
    for ((at, x), u) in places.iter().zip(&found).zip(pressed.at(&grid, &found)) {
        let [i, j, k] = grid.voxel(*at);
        let miss = grid.world(i, j, k).minus(x.moved(u.unwrap()));
        assert!(miss.iter().all(|m| m.abs() < 1e-5), "{miss:?}");
    }
    // The field at the voxels is that of the places, to f32.
    let field = pressed.field(grid);
    let centres: Vec<WorldPoint> =
        (0..grid.len()).step_by(11).map(|at| grid.voxel(at)).map(|[i, j, k]| grid.world(i, j, k)).collect();
    let exact = pressed.at(&grid, &centres);
    for ((x, u), at) in centres.iter().zip(exact).zip((0..grid.len()).step_by(11)).filter(|((x, _), _)| inside(x)) {
        let u = u.unwrap();
        assert!((0..3).all(|c| (f64::from(field.at(at)[c]) - u[c]).abs() < 1e-6), "{x:?}");
    }
}

#[test]
fn labels_moduli_and_description_say_the_same() {
    let p = phantom(&small(PhantomKind::Inclusion, 28)).unwrap();
    let (stiffness, elastic) = (p.stiffness.as_ref().unwrap(), p.description.elastic.as_ref().unwrap());
    assert_eq!((elastic.held, elastic.load), ("z-", "z+"));
    assert!(elastic.force_n > 1.0 && elastic.solution.imbalance < 1e-4, "{elastic:?}");
    assert!((0.05..0.08).contains(&elastic.compression));
    for (at, &label) in stiffness.labels.as_slice().iter().enumerate() {
        let modulus = stiffness.youngs_modulus_kpa.as_slice()[at];
        match elastic.regions.iter().find(|r| r.label == label) {
            Some(region) => assert_eq!(modulus, region.youngs_modulus_kpa as f32),
            None => assert_eq!((label, modulus), (0, 0.0)),
        }
        assert_eq!(p.mask.as_slice()[at] != 0, label != 0);
    }
    assert_eq!(elastic.regions[1].youngs_modulus_kpa, 100.0);
    // As the plate says: its tissue moves by the amplitude along z alone.
    let g = p.truth.grid();
    let top: Vec<usize> = (0..g.len())
        .filter(|&at| {
            p.mask.as_slice()[at] != 0 && p.mask.as_slice()[(at + g.shape()[0] * g.shape()[1]).min(g.len() - 1)] == 0
        })
        .collect();
    let mean = top.iter().map(|&at| f64::from(p.truth.at(at)[2])).sum::<f64>() / top.len() as f64;
    assert!((mean + 1.8).abs() < 0.12, "{mean}");
}

#[test]
fn one_two_or_no_inclusions_as_asked() {
    for (inclusions, moduli) in [(0, vec![20.0]), (2, vec![20.0, 10.0, 80.0])] {
        let elastic = ElasticParams { contrast: 5.0, inclusions, poisson: 0.45 };
        let p: Phantom = phantom(&PhantomParams { elastic, ..small(PhantomKind::Inclusion, 24) }).unwrap();
        let found = p.description.elastic.unwrap();
        assert_eq!(found.regions.iter().map(|r| r.youngs_modulus_kpa).collect::<Vec<_>>(), moduli);
        let labels = p.stiffness.unwrap().labels;
        assert!((1..=moduli.len() as u8).all(|l| labels.as_slice().contains(&l)));
    }
}

#[test]
fn the_same_seed_gives_the_same_elastic_bytes_for_any_number_of_threads() {
    let params = PhantomParams::new(PhantomKind::Slab).sized(20);
    let with = |threads: usize| {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(|| phantom(&params).unwrap())
    };
    assert_eq!(with(1), with(3));
}

#[test]
fn what_elasticity_cannot_do_is_refused_with_a_reason() {
    let message = |p: PhantomParams| phantom(&p).unwrap_err().to_string();
    let with = |elastic| PhantomParams { elastic, ..small(PhantomKind::Inclusion, 24) };
    let usual = ElasticParams { contrast: 5.0, inclusions: 1, poisson: 0.49 };
    assert!(message(with(ElasticParams { poisson: 0.5, ..usual })).contains("poisson is 0.5"));
    assert!(message(with(ElasticParams { contrast: -2.0, ..usual })).contains("contrast is -2"));
    assert!(message(with(ElasticParams { inclusions: 3, ..usual })).contains("0, 1 or 2"));
    let calf = PhantomParams::new(PhantomKind::Calf).moving(MotionKind::Elastic);
    assert!(message(calf).contains("needs fingertip, inclusion or slab"));
    assert!(message(PhantomParams { amplitude: 0.0, ..small(PhantomKind::Slab, 24) }).contains("over 0"));
    assert!(message(PhantomParams { amplitude: 30.0, ..small(PhantomKind::Slab, 24) }).contains("no equilibrium"));
}
