//! Forward models against closed forms, sensitivities, and identification of fields with a closed
//! form.

use palpate::mesh::tetrahedral::{Detail, Fineness, Mesher, mesh_labels};
use palpate::numerics::random::Random;
use palpate::pipeline::compression_phantoms::Pressed;
use palpate::pipeline::dry_run;
use palpate::pipeline::stiffness::{FieldQuality, Inputs, run};
use palpate::stiffness::boundary_conditions::Place;
use palpate::stiffness::fem_body::Body;
use palpate::stiffness::forward::{Problem, Tie};
use palpate::stiffness::geometry;
use palpate::stiffness::identify::{Setup, State};
use palpate::stiffness::law::Material;
use palpate::stiffness::mesh_problem::Level;
use palpate::stiffness::observations::{find, from_field, from_matches, read};
use palpate::synth::{PhantomKind, PhantomParams};
use palpate::types::stiffness::{Contact, Evidence, Law, LawChoice, Side};
use palpate::types::{
    Affine, DenseField, Grid, Mask, Match, QuadraticMesh, SparseField, StiffnessParams, StiffnessResult, Trust,
    WorldPoint,
};
use std::collections::HashSet;

fn grid(shape: [usize; 3], spacing: f64) -> Grid {
    Grid::new(shape, Affine::scaled([spacing; 3], [0.0; 3]).unwrap()).unwrap()
}

fn labels(shape: [usize; 3], spacing: f64, f: impl Fn([f64; 3]) -> u8 + Sync) -> Mask {
    Mask::from_voxels(grid(shape, spacing), |_, p| f(p.0))
}

/// A block of 16 x 16 x 16 voxels of 1 mm in a grid of 20: faces at 1.5 and 17.5 mm.
fn block() -> Mask {
    labels([20, 20, 20], 1.0, |p| u8::from(p.iter().all(|v| (2.0..18.0).contains(v))))
}

fn body(map: &Mask, nodes: usize) -> Body {
    let volume =
        map.as_slice().iter().filter(|&&v| v > 0).count() as f64 * map.grid().spacing().iter().product::<f64>();
    Body::new(&mesh_labels(map, &Fineness::for_nodes(volume, nodes)).unwrap()).unwrap()
}

/// The same with straight edges, on which the quadrature is exact.
fn straight(map: &Mask, nodes: usize) -> Body {
    let volume = map.as_slice().iter().filter(|&&v| v > 0).count() as f64;
    let mesh = mesh_labels(map, &Fineness::for_nodes(volume, nodes)).unwrap();
    let mut places = mesh.nodes().to_vec();
    for t in mesh.tetrahedra() {
        for (k, [i, j]) in palpate::numerics::tetrahedron::EDGES.into_iter().enumerate() {
            let (p, q) = (places[t[i] as usize].0, places[t[j] as usize].0);
            places[t[4 + k] as usize] = WorldPoint(std::array::from_fn(|a| 0.5 * (p[a] + q[a])));
        }
    }
    Body::new(&QuadraticMesh::new(places, mesh.tetrahedra().to_vec(), mesh.labels().to_vec()).unwrap()).unwrap()
}

fn surface_nodes(body: &Body) -> Vec<u32> {
    let all: HashSet<u32> = body.surface.iter().flat_map(|f| f.nodes).collect();
    let mut all: Vec<u32> = all.into_iter().collect();
    all.sort_unstable();
    all
}

fn tied(body: &Body, nodes: &[u32], u: impl Fn([f64; 3]) -> [f64; 3]) -> Vec<Tie> {
    let tie = |&node: &u32| Tie { node, direction: None, target: u(body.places[node as usize]), strength: 1.0 };
    nodes.iter().map(tie).collect()
}

/// Root mean square and largest distance of a solution from `exact` (mm).
fn errors(body: &Body, x: &[f64], exact: impl Fn([f64; 3]) -> [f64; 3]) -> [f64; 2] {
    let (mut sum, mut largest) = (0.0, 0.0f64);
    for (n, p) in body.places.iter().enumerate() {
        let (u, e) = (body.displacement(x, n as u32), exact(*p));
        let d: f64 = (0..3).map(|a| (u[a] - e[a]).powi(2)).sum();
        sum += d;
        largest = largest.max(d.sqrt());
    }
    [(sum / body.places.len() as f64).sqrt(), largest]
}

fn uniform(body: &Body, e: f64, nu: f64) -> Vec<Material> {
    vec![Material::of_youngs_modulus(e, nu); body.cells.len()]
}

#[test]
fn the_patch_test_is_passed_at_any_poisson_ratio() {
    // Exact with straight edges; with curved ones the quadrature errs by a part in 10^4 of the
    // largest displacement.
    for (body, tolerance) in [(straight(&block(), 2500), 1e-8), (body(&block(), 2500), 5e-6)] {
        for nu in [0.3, 0.49, 0.499] {
            let u = |p: [f64; 3]| [1e-3 * p[0] + 2e-3 * p[1], -1e-3 * p[1] + 5e-4 * p[2], 3e-3 * p[0]];
            let ties = tied(&body, &surface_nodes(&body), u);
            let problem = Problem::new(&body, Law::Linear, uniform(&body, 10.0, nu), ties);
            let s = problem.solve(None, 1e-9).unwrap();
            let [_, largest] = errors(&body, &s.x, u);
            assert!(largest < tolerance, "nu {nu}: {largest}");
        }
    }
}

/// u = 4 (1 - nu) psi - grad(x . psi) with psi harmonic solves the equations without body force
/// (Papkovich, Neuber).
#[test]
fn polynomial_solutions_are_approached_at_third_order_up_to_incompressibility() {
    // A ball: its edges bend by the square of their length. (A block's edges are rounded by the
    // voxels, on any mesh.)
    let ball = labels([20, 20, 20], 1.0, |p| u8::from(p.iter().map(|v| (v - 9.5).powi(2)).sum::<f64>() < 64.0));
    let bodies = [1200, 8000].map(|n| body(&ball, n));
    for nu in [0.3, 0.49, 0.499] {
        // psi = (0, 0, q) with q = x^3 y - x y^3 + z (x^2 - y^2), harmonic; centred and scaled.
        let exact = |p: [f64; 3]| {
            let [x, y, z] = p.map(|v| (v - 9.5) / 8.0);
            let q = x * x * x * y - x * y * y * y + z * (x * x - y * y);
            let slope =
                [3.0 * x * x * y - y * y * y + 2.0 * x * z, x * x * x - 3.0 * x * y * y - 2.0 * y * z, x * x - y * y];
            [-z * slope[0], -z * slope[1], 4.0 * (1.0 - nu) * q - q - z * slope[2]]
        };
        let found: Vec<(f64, f64)> = bodies
            .iter()
            .map(|b| {
                let ties = tied(b, &surface_nodes(b), exact);
                let problem = Problem::new(b, Law::Linear, uniform(b, 10.0, nu), ties);
                let size = (b.volumes[0] / b.cells.len() as f64).cbrt();
                (errors(b, &problem.solve(None, 1e-9).unwrap().x, exact)[0], size)
            })
            .collect();
        let rate = (found[0].0 / found[1].0).ln() / (found[0].1 / found[1].1).ln();
        assert!(rate > 2.6, "nu {nu}: errors {found:?}, rate {rate:.2}");
    }
}

/// Ties of a block between two frictionless plates, with the least that keeps it from sliding away.
fn plates(body: &Body, compression: f64) -> Vec<Tie> {
    let mut ties = Vec::new();
    for n in surface_nodes(body) {
        let p = body.places[n as usize];
        let z = Some([0.0, 0.0, 1.0]);
        if p[2] < 2.1 {
            ties.push(Tie { node: n, direction: z, target: [0.0; 3], strength: 1.0 });
        } else if p[2] > 16.9 {
            ties.push(Tie { node: n, direction: z, target: [0.0, 0.0, -compression], strength: 1.0 });
        }
    }
    for tie in ties.clone() {
        ties.push(Tie { direction: None, strength: 1e-11, target: [0.0, 0.0, tie.target[2]], ..tie });
    }
    ties
}

fn pushes(problem: &Problem<'_>, x: &[f64], top: bool) -> f64 {
    let on = |t: &&Tie| (problem.body.places[t.node as usize][2] > 10.0) == top;
    problem.ties.iter().filter(on).map(|t| problem.pull(t, x)[2]).sum()
}

#[test]
fn a_bar_gives_its_modulus_back_and_forces_balance() {
    let body = body(&block(), 4000);
    for (law, nu) in [(Law::Linear, 0.3), (Law::Linear, 0.49), (Law::NeoHookean, 0.3), (Law::NeoHookean, 0.49)] {
        let (e, depth) = (10.0, 0.8);
        let problem = Problem::new(&body, law, uniform(&body, e, nu), plates(&body, depth));
        let s = problem.solve(None, 1e-9).unwrap();
        let (top, bottom) = (pushes(&problem, &s.x, true), pushes(&problem, &s.x, false));
        assert!((top + bottom).abs() < 1e-6 * top.abs(), "{top} {bottom}");
        let exact = match law {
            Law::Linear => 256.0 * e * depth / 16.0,
            Law::NeoHookean => 256.0 * uniaxial(e, nu, 1.0 - depth / 16.0),
        };
        // The mesh rounds the block's edges by a fraction of a voxel.
        assert!((-top / exact - 1.0).abs() < 0.01, "{law:?} {nu}: {top} for {exact}");
    }
}

/// Nominal pressure of a neo-Hookean bar at stretch `l`: the transverse stretch makes the side's
/// stress vanish.
fn uniaxial(e: f64, nu: f64, l: f64) -> f64 {
    let (mu, lambda) = (e / (2.0 * (1.0 + nu)), e * nu / ((1.0 + nu) * (1.0 - 2.0 * nu)));
    let side = |t: f64| mu * (t - 1.0 / t) + lambda * (l * t * t).ln() / t;
    let (mut low, mut high) = (0.5, 2.0);
    for _ in 0..80 {
        let t = 0.5 * (low + high);
        if side(t) < 0.0 { low = t } else { high = t }
    }
    -(mu * (l - 1.0 / l) + lambda * (l * low * low).ln() / l)
}

#[test]
fn neo_hookean_simple_shear_is_homogeneous_and_its_traction_exact() {
    let body = straight(&block(), 2500);
    let (e, nu, shear) = (10.0, 0.49, 0.2);
    let u = |p: [f64; 3]| [shear * (p[2] - 9.5), 0.0, 0.0];
    let problem = Problem::new(&body, Law::NeoHookean, uniform(&body, e, nu), tied(&body, &surface_nodes(&body), u));
    let s = problem.solve(None, 1e-9).unwrap();
    assert!(errors(&body, &s.x, u)[1] < 1e-6);
    // J = 1, so P = mu (F - F^-T): on the top P_xz = mu k. The work of all tractions is mu k^2
    // times the volume.
    let work: f64 = problem
        .ties
        .iter()
        .map(|t| {
            let (f, p) = (problem.pull(t, &s.x), body.places[t.node as usize]);
            f[0] * (p[2] - 9.5)
        })
        .sum();
    let volume: f64 = body.volumes.iter().sum();
    let exact = e / (2.0 * (1.0 + nu)) * shear * volume;
    assert!((work / exact - 1.0).abs() < 1e-4, "{work} for {exact}");
}

/// A hollow ball whose inner and outer surface are moved radially: u = A r + B / r^2 (Lame).
#[test]
fn a_thick_sphere_follows_lame() {
    let map = labels([26, 26, 26], 1.0, |p| {
        let r = p.iter().map(|v| (v - 12.6).powi(2)).sum::<f64>().sqrt();
        u8::from(r < 11.0 && r > 5.0)
    });
    let body = body(&map, 9000);
    let exact = |p: [f64; 3]| {
        let d = p.map(|v| v - 12.6);
        let r = d.iter().map(|v| v * v).sum::<f64>().sqrt();
        d.map(|v| v / r * (4.0 / (r * r)))
    };
    let nu = 0.49;
    let problem = Problem::new(&body, Law::Linear, uniform(&body, 10.0, nu), tied(&body, &surface_nodes(&body), exact));
    let s = problem.solve(None, 1e-9).unwrap();
    let [rms, largest] = errors(&body, &s.x, exact);
    // The displacement is 0.16 mm inside, 0.033 mm outside; the coarse shell has two elements
    // across.
    assert!(rms < 8e-4 && largest < 0.012, "{rms} {largest}");
}

/// A flat frictionless round punch on a half space: F = 2 E / (1 - nu^2) a d (Johnson, Contact
/// Mechanics, 3.36). The block is 8 radii wide and 5 deep, which stiffens it; the edge of the punch
/// is made of faces of the mesh.
#[test]
fn a_punch_needs_the_force_of_a_half_space_and_what_its_block_adds() {
    let map = labels([52, 52, 34], 1.0, |p| {
        u8::from((2.0..50.0).contains(&p[0]) && (2.0..50.0).contains(&p[1]) && (2.0..32.0).contains(&p[2]))
    });
    let (a, d, e, nu) = (6.0, 0.1, 10.0, 0.3);
    let wall = |p: [f64; 3]| a - (p[0] - 25.5).hypot(p[1] - 25.5);
    let ring = (0..52 * 52).map(|c| [f64::from(c % 52), f64::from(c / 52), 31.0]);
    let near: Vec<[f64; 3]> = ring.filter(|p| wall(*p).abs() < 1.0).collect();
    let fineness = Fineness::for_nodes(48.0 * 48.0 * 30.0, 8_000);
    let mesh =
        Mesher::new(&map).unwrap().mesh_finer(&fineness, Detail { near: &near, size: 1.0, wall: Some(&wall) }).unwrap();
    let body = Body::new(&mesh).unwrap();
    let mut ties = Vec::new();
    for f in &body.surface {
        let r = ((f.centre[0] - 25.5).powi(2) + (f.centre[1] - 25.5).powi(2)).sqrt();
        for n in f.nodes {
            if f.normal[2] > 0.9 && r < a {
                ties.push((
                    n,
                    Tie { node: n, direction: Some([0.0, 0.0, 1.0]), target: [0.0, 0.0, -d], strength: 1.0 },
                ));
            } else if f.normal[2] < -0.9 {
                ties.push((n, Tie { node: n, direction: None, target: [0.0; 3], strength: 1.0 }));
            }
        }
    }
    ties.sort_by_key(|t| t.0);
    ties.dedup_by_key(|t| t.0);
    let area: f64 = body
        .surface
        .iter()
        .filter(|f| f.normal[2] > 0.9 && ((f.centre[0] - 25.5).powi(2) + (f.centre[1] - 25.5).powi(2)).sqrt() < a)
        .map(|f| f.area)
        .sum();
    // The facets stand for a disc of their own area.
    let radius = (area / std::f64::consts::PI).sqrt();
    let problem = Problem::new(&body, Law::Linear, uniform(&body, e, nu), ties.into_iter().map(|t| t.1).collect());
    let s = problem.solve(None, 1e-9).unwrap();
    let exact = 2.0 * e / (1.0 - nu * nu) * radius * d;
    let force = -pushes(&problem, &s.x, true);
    println!("{} nodes, area {area}, {force} for {exact}", body.places.len());
    assert!((1.0..1.25).contains(&(force / exact)), "{force} for {exact}");
}

#[test]
fn sensitivities_are_those_of_finite_differences() {
    let map = labels([20, 20, 20], 1.0, |p| {
        let inside = p.iter().all(|v| (2.0..18.0).contains(v));
        let ball = p.iter().map(|v| (v - 9.7).powi(2)).sum::<f64>() < 25.0;
        if inside { 1 + u8::from(ball) } else { 0 }
    });
    let body = body(&map, 2500);
    for law in [Law::Linear, Law::NeoHookean] {
        let problem = |theta: f64| {
            let m = body.region.iter().map(|&r| Material { mu: (f64::from(r) * theta).exp(), poisson: 0.49 }).collect();
            Problem { springs: vec![1e7; body.places.len()], ..Problem::new(&body, law, m, plates(&body, 1.0)) }
        };
        let (theta, h) = (0.8, 1e-3);
        let at = problem(theta);
        let s = at.solve(None, 1e-11).unwrap();
        let mut y: Vec<f64> =
            at.residual_by_modulus(&s.x, |e| body.region[e] == 1).unwrap().into_iter().map(|v| -v).collect();
        at.factorise(&s.x).unwrap().solve(&mut y, None).unwrap();
        let [low, high] = [-h, h].map(|d| problem(theta + d).solve(None, 1e-11).unwrap().x);
        let size = y.iter().fold(0.0, |m: f64, v| m.max(v.abs()));
        for i in 0..y.len() {
            let difference = (high[i] - low[i]) / (2.0 * h);
            assert!((difference - y[i]).abs() < 1e-4 * size, "{law:?}: {} for {difference}", y[i]);
        }
    }
}

/// A pressed body on a mesh of about `nodes` nodes, with what `field` shows of it.
fn meshed(body: &Pressed, field: &DenseField, nodes: usize, sides: [&str; 2]) -> Level {
    let map = &body.phantom.stiffness.as_ref().unwrap().labels;
    let volume = palpate::stiffness::fields::volume(map);
    let mesh = mesh_labels(map, &Fineness::for_nodes(volume, nodes)).unwrap();
    let [held, load] = sides.map(|side| Place::Side(Side::parse(side).unwrap()));
    Level::new(&mesh, field, None, map, &held, &load, None).unwrap()
}

#[test]
fn sensitivities_to_a_plate_on_a_curved_body_are_those_of_finite_differences() {
    let params = PhantomParams { seed: 5, ..PhantomParams::new(PhantomKind::Fingertip) }.sized(32);
    let body = Pressed::new(&params).unwrap();
    let mut level = meshed(&body, &body.phantom.truth, 2500, ["z+", "z-"]);
    assert!(level.patches[1].curved());
    level.patches[1].contact = Contact::Sliding;
    let setup = level.setup(Law::NeoHookean, &StiffnessParams::default(), level.largest());
    // Far from what the data say, so that the run ends where it starts, with the derivatives there.
    let here = setup.run(setup.start(), 0, 1e-9).unwrap();
    assert_eq!(here.state.theta, setup.start().theta);
    assert!((here.force[0] / here.force[1] - 1.0).abs() < 1e-3, "{:?}", here.force);
    // A modulus, how far the plate goes in, and how it is tilted.
    let (first, h) = (setup.free().len() + setup.patches[0].parameters(), 1e-4);
    for k in [0, first, first + 1, first + 2] {
        let moved = |by: f64| {
            let mut state = State { x: None, ..here.state.clone() };
            match k.checked_sub(first) {
                None => state.theta[setup.free()[k]] += by,
                Some(own) => state.plates[1][own] += by,
            }
            let problem = setup.problem(&state);
            let x = problem.solve(here.state.x.as_deref(), 1e-10).unwrap().x;
            let ties = setup.patches[0].ties(&level.body, &state.plates[0]);
            let along = |t: &Tie| (0..3).map(|a| problem.pull(t, &x)[a] * setup.patches[1].normal[a]).sum::<f64>();
            (ties.iter().map(along).sum::<f64>(), x)
        };
        let [(least, low), (most, high)] = [-h, h].map(moved);
        let column = &here.columns[k * low.len()..(k + 1) * low.len()];
        let of_node = |n: usize| level.body.pattern.first(n as u32)..level.body.pattern.first(n as u32) + 3;
        let all: Vec<usize> = (0..level.body.places.len()).flat_map(of_node).collect();
        let size = all.iter().fold(0.0, |m: f64, &i| m.max(column[i].abs()));
        for &i in &all {
            let difference = (high[i] - low[i]) / (2.0 * h);
            assert!((difference - column[i]).abs() < 5e-3 * size, "{k}: {} for {difference} of {size}", column[i]);
        }
        let slope = (most / least).ln() / (2.0 * h);
        let bound = 5e-3 * here.force_slope[k].abs().max(0.1);
        assert!((slope - here.force_slope[k]).abs() < bound, "{k}: {} for {slope}", here.force_slope[k]);
    }
}

#[test]
fn what_an_offset_of_the_shape_changes_is_what_solutions_of_moved_bodies_differ_by() {
    let params = PhantomParams { seed: 64, ..PhantomParams::new(PhantomKind::Inclusion) }.sized(24);
    let body = Pressed::new(&params).unwrap();
    let mut level = meshed(&body, &body.phantom.truth, 2500, ["z-", "z+"]);
    level.open_borders(0.5);
    let setup = level.setup(Law::NeoHookean, &StiffnessParams::default(), level.largest());
    let mut state = setup.start();
    state.theta[1] = 1.6;
    let here = setup.run(state, 0, 1e-9).unwrap();
    let found = geometry::open(&setup, &here, &level.grid, &[]).unwrap();
    // The border of the inclusion is open, and comes last.
    let (part, _) = setup.open.last().unwrap();
    let (row, slope) = (found.rows.last().unwrap(), found.force_slope.last().unwrap());
    let places: Vec<[f64; 3]> = setup.observations.iter().map(|o| o.place).collect();
    let h = 0.01;
    let moved = |by: f64| {
        let mut nodes = level.body.places.clone();
        part.shift(&mut nodes, by);
        let moved = level.body.with_places(nodes);
        let setup = Setup { body: &moved, ..setup.clone() };
        let problem = setup.problem(&here.state);
        let x = problem.solve(here.state.x.as_deref(), 1e-10).unwrap().x;
        let read = |r: Option<_>| r.map(|r| read(&[r], &moved, &x));
        let seen: Vec<Option<[f64; 3]>> = find(&moved, &places).into_iter().map(read).collect();
        (setup.forces(&problem, &here.state, &x)[0], seen)
    };
    let [(least, low), (most, high)] = [-h, h].map(moved);
    let size = row.iter().flatten().fold(0.0, |m: f64, v| m.max(v.abs()));
    assert!(size > 0.02, "{size} mm a voxel");
    // Where strain jumps, at the border itself, a step has the mean of both sides.
    let mut far = Vec::new();
    for ((row, low), high) in row.iter().zip(low).zip(high) {
        let Some((low, high)) = low.zip(high) else { continue };
        far.extend((0..3).map(|a| ((high[a] - low[a]) / (2.0 * h) - row[a]).abs() / size));
    }
    assert!(far.len() > 1000);
    far.sort_unstable_by(f64::total_cmp);
    let part = |q: f64| far[(q * (far.len() - 1) as f64) as usize];
    assert!(part(0.5) < 1e-4 && part(0.95) < 5e-3, "{} {} {}", part(0.5), part(0.95), part(1.0));
    let by_force = (most / least).ln() / (2.0 * h);
    assert!((slope - by_force).abs() < 1e-3 * by_force.abs(), "{slope} for {by_force}");
}

/// A mesh found the tip of a finger curved and the next one flat: the flat one's few ties along its
/// normal left no equilibrium, and the pair failed.
#[test]
fn meshes_of_a_body_agree_on_what_is_curved_as_the_finer_sees_it() {
    let params = PhantomParams { seed: 5, ..PhantomParams::new(PhantomKind::Fingertip) }.sized(32);
    let body = Pressed::new(&params).unwrap();
    let level = |nodes: usize, part: f32| {
        let mut field = body.phantom.truth.clone();
        field.as_mut_slice().iter_mut().for_each(|v| *v *= part);
        let mut level = meshed(&body, &field, nodes, ["z+", "z-"]);
        level.patches[1].contact = Contact::Sliding;
        level
    };
    let slides = |level: &Level| {
        let patch = &level.patches[1];
        (patch.plate(&level.body, &[0.0; 3], |_| 1.0).is_some(), patch.ties(&level.body, &[0.0; 3]).len())
    };
    // Pressed by a tenth, it bends by less than can be seen.
    for (coarse, fine) in [(0.1, 1.0), (1.0, 0.1)] {
        let (mut few, mut many) = (level(2500, coarse), level(10_000, fine));
        assert!(few.patches[1].curved() != many.patches[1].curved());
        assert!(few.patches[1].nodes.len() < many.patches[1].nodes.len());
        few.agree_on_shape(&mut many).unwrap();
        for level in [&few, &many] {
            let expected = if fine == 1.0 { (true, 0) } else { (false, level.patches[1].nodes.len()) };
            assert_eq!(slides(level), expected);
        }
    }
}

/// The field of a homogeneous block between frictionless plates, linear: closed form, whatever the
/// modulus.
fn squeezed(strain: f64, nu: f64) -> DenseField {
    DenseField::from_fn(grid([20, 20, 20], 1.0), |p: WorldPoint| {
        [nu * strain * (p.0[0] - 9.5), nu * strain * (p.0[1] - 9.5), -strain * (p.0[2] - 1.5)]
    })
}

fn identify(map: &Mask, field: &DenseField, params: &StiffnessParams) -> StiffnessResult {
    identify_held(&Place::Side(Side::parse("z-").unwrap()), map, field, params)
}

/// Pressed from z+.
fn identify_held(held: &Place, map: &Mask, field: &DenseField, params: &StiffnessParams) -> StiffnessResult {
    let load = Place::Side(Side::parse("z+").unwrap());
    let names = |l: u8| format!("region {l}");
    let inputs = Inputs {
        field,
        matches: None,
        labels: map,
        labelled: true,
        held,
        load: &load,
        names: &names,
        quality: FieldQuality::default(),
    };
    run(&inputs, params, &|_, _| {}).unwrap()
}

#[test]
fn a_homogeneous_block_in_two_labels_has_one_modulus_and_the_right_one() {
    let halves =
        labels(
            [20, 20, 20],
            1.0,
            |p| {
                if p.iter().all(|v| (2.0..18.0).contains(v)) { 1 + u8::from(p[2] > 9.0) } else { 0 }
            },
        );
    let (e, strain) = (25.0, 0.03);
    let force = e * 256.0 * strain / 1000.0;
    let params = StiffnessParams { model: LawChoice::Auto, force_n: Some(force), nodes: 4000, ..Default::default() };
    let result = identify(&halves, &squeezed(strain, 0.49), &params);
    assert_eq!(result.patches[1].contact, Contact::Sliding);
    assert_eq!(result.law, Law::Linear, "{:?}", result.evidence);
    // Where the faces lie within a voxel is worth some percent of 16 voxels; it is said so, and
    // does not touch the ratio.
    for r in &result.regions {
        assert!(r.identifiable && r.sd < 0.06 * e, "{r:?}");
        assert!((r.youngs_modulus - e).abs() < 2.0 * r.sd, "{r:?}");
        assert!((r.ratio - 1.0).abs() < 0.03, "{r:?}");
    }
    assert!((result.model_force / force - 1.0).abs() < 0.05);
}

/// The first frame's bound once scaled the exported models when a later frame determined the
/// region.
#[test]
fn a_shared_map_and_its_models_hold_the_same_moduli() {
    let halves =
        labels([20; 3], 1.0, |p| if p.iter().all(|v| (2.0..18.0).contains(v)) { 1 + u8::from(p[2] > 9.0) } else { 0 });
    let params = StiffnessParams { model: LawChoice::Linear, force_n: Some(0.192), nodes: 1000, ..Default::default() };
    let result = identify(&halves, &squeezed(0.03, 0.49), &params);
    let mut bounded = result.clone();
    (bounded.regions[1].identifiable, bounded.regions[1].bound) = (false, Some("lower"));
    bounded.regions[1].youngs_modulus *= 0.4;
    let mut sequence = palpate::pipeline::stiffness_sequence::Sequence::default();
    sequence.add(2, 0.3, Ok(bounded));
    sequence.add(1, 0.2, Ok(result));
    let shared = sequence.finish(&halves).unwrap().result;
    for region in &shared.regions {
        assert!(region.identifiable);
        for (label, e) in shared.mesh.labels().iter().zip(&shared.element_modulus).filter(|l| *l.0 == region.label) {
            assert!((e / region.youngs_modulus - 1.0).abs() < 1e-9, "region {label}: {e}, {}", region.youngs_modulus);
        }
    }
}

/// Side by side between plates without friction every ratio leads to one field: both halves bear
/// the force, in parts that nothing shows.
#[test]
fn of_halves_side_by_side_only_the_mean_is_claimed() {
    let halves = |p: [f64; 3]| if p.iter().all(|v| (2.0..18.0).contains(v)) { 1 + u8::from(p[0] > 9.0) } else { 0 };
    let (mean, strain) = (30.0, 0.03);
    for force_n in [Some(mean * 256.0 * strain / 1000.0), None] {
        let params = StiffnessParams { model: LawChoice::Linear, force_n, nodes: 3000, ..Default::default() };
        let result = identify(&labels([20, 20, 20], 1.0, halves), &squeezed(strain, 0.49), &params);
        let said = |what: &str| result.warnings.iter().any(|w| w.contains(what));
        assert!(
            said("whatever the modulus of region 1") || said("whatever the modulus of region 2"),
            "{:?}",
            result.warnings
        );
        for r in &result.regions {
            match force_n {
                // One half could bear it all.
                Some(_) => {
                    assert_eq!((r.identifiable, r.bound), (false, Some("upper")), "{r:?}");
                    assert!((r.youngs_modulus / (2.0 * mean) - 1.0).abs() < 0.15, "{r:?}");
                }
                None => assert!(r.label == result.reference || r.bound == Some("unknown"), "{r:?}"),
            }
        }
    }
}

/// A press that turns the body as a whole is the same press.
#[test]
fn a_turn_of_the_whole_body_changes_no_modulus() {
    let (strain, angle) = (0.03, 15f64.to_radians());
    let (c, s) = (angle.cos(), angle.sin());
    let upright = squeezed(strain, 0.49);
    let turned = DenseField::from_fn(*upright.grid(), |p: WorldPoint| {
        let [x, y, z] = p.0;
        let q = [x + 0.49 * strain * (x - 9.5), y + 0.49 * strain * (y - 9.5), z - strain * (z - 1.5)];
        let r = [q[0], c * q[1] - s * q[2], s * q[1] + c * q[2]];
        std::array::from_fn(|a| r[a] - p.0[a] + [2.0, -1.0, 3.0][a])
    });
    let force_n = Some(25.0 * 256.0 * strain / 1000.0);
    let params = StiffnessParams { model: LawChoice::Linear, force_n, nodes: 1500, ..Default::default() };
    let [one, other] = [&upright, &turned].map(|field| identify(&block(), field, &params));
    assert!(!one.warnings.iter().any(|w| w.contains("turned")), "{:?}", one.warnings);
    assert!(other.warnings.iter().any(|w| w.contains("turned by 15.0 degrees")), "{:?}", other.warnings);
    let [a, b] = [&one, &other].map(|r| (r.regions[0].youngs_modulus, r.patches[1].contact));
    assert!((a.0 / b.0 - 1.0).abs() < 1e-3 && a.1 == b.1, "{a:?} {b:?}");
}

/// Where voxels lie askew to a flat base the mesh rounds its rims, and 28 % of it was let go: 27.0
/// and 104 of 25 and 100 kPa.
#[test]
fn a_base_askew_to_the_voxels_is_held_nearly_whole() {
    let (half, strain) = ([20.0, 18.0, 15.0], 0.04);
    // 35 degrees about (1, 2, 0.5), voxels of 1 x 0.8 x 1.3 mm.
    let axis = [1.0, 2.0, 0.5f64].map(|v| v / 5.25f64.sqrt());
    let (s, c) = 35f64.to_radians().sin_cos();
    let turn = |r: usize, q: usize| {
        let cross = [[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]];
        c * f64::from(u8::from(r == q)) + (1.0 - c) * axis[r] * axis[q] + s * cross[r][q]
    };
    let (spacing, shape) = ([1.0, 0.8, 1.3], [66usize, 72, 46]);
    let rows = [0, 1, 2].map(|r| {
        let along = [0, 1, 2].map(|q| turn(r, q) * spacing[q]);
        let middle: f64 = (0..3).map(|q| along[q] * (shape[q] as f64 - 1.0) / 2.0).sum();
        [along[0], along[1], along[2], -middle]
    });
    let grid = Grid::new(shape, Affine::new(rows).unwrap()).unwrap();
    let map = Mask::from_voxels(grid, |_, p| u8::from((0..3).all(|a| p.0[a].abs() < half[a])));
    let field = DenseField::from_fn(grid, |p: WorldPoint| {
        [0.49 * strain * p.0[0], 0.49 * strain * p.0[1], -strain * (p.0[2] + half[2])]
    });
    let force_n = Some(1e-3 * 30.0 * strain * 4.0 * half[0] * half[1]);
    let params = StiffnessParams { model: LawChoice::Linear, force_n, nodes: 8000, ..Default::default() };
    let found = identify(&map, &field, &params);
    let area = |k: usize| found.patches[k].area / (4.0 * half[0] * half[1]);
    assert!((0.8..1.15).contains(&area(0)) && (0.8..1.15).contains(&area(1)), "{} {}", area(0), area(1));
    let e = found.regions[0].youngs_modulus;
    assert!((e / 30.0 - 1.0).abs() < 0.06, "{e}");
}

#[test]
fn a_body_that_ends_with_the_volume_is_warned_of() {
    let params = StiffnessParams { model: LawChoice::Linear, nodes: 1500, ..Default::default() };
    let cut =
        labels([20, 20, 20], 1.0, |p| u8::from(p[1] < 18.0 && [p[0], p[2]].iter().all(|v| (2.0..18.0).contains(v))));
    let said = |map: &Mask| {
        let found = identify(map, &squeezed(0.03, 0.49), &params);
        found.warnings.into_iter().find(|w| w.contains("border"))
    };
    assert!(said(&cut).is_some_and(|w| w.contains("(first y along")));
    assert_eq!(said(&block()), None);
}

/// On a coarse mesh the rounded rim of a cylinder's face lies millimetres below it, and more of its
/// nodes than not lay off the plane of all.
#[test]
fn a_flat_face_is_found_though_its_rim_is_rounded() {
    for (radius, half) in [(30.0, 24.0), (24.0, 20.0)] {
        let side = |r: f64| 2 * r as usize + 12;
        let shape = [side(radius), side(radius), side(half)];
        let middle = shape.map(|n| (n as f64 - 1.0) / 2.0);
        let centred = |p: [f64; 3]| -> [f64; 3] { std::array::from_fn(|a| p[a] - middle[a]) };
        let cylinder = |p: [f64; 3]| {
            let q = centred(p);
            u8::from(q[0].hypot(q[1]) < radius && q[2].abs() < half)
        };
        let field = DenseField::from_fn(grid(shape, 1.0), |p: WorldPoint| {
            let q = centred(p.0);
            [0.49 * 0.02 * q[0], 0.49 * 0.02 * q[1], -0.02 * (q[2] + half)]
        });
        let (held, load) = (Place::Side(Side::parse("z-").unwrap()), Place::Side(Side::parse("z+").unwrap()));
        let (map, names) = (labels(shape, 1.0, cylinder), |l: u8| format!("region {l}"));
        for nodes in [3_000, 8_000, 20_000] {
            let (field, labels) = (&field, &map);
            let inputs = Inputs {
                field,
                matches: None,
                labels,
                labelled: true,
                held: &held,
                load: &load,
                names: &names,
                quality: FieldQuality::default(),
            };
            dry_run::stiffness(&inputs, &StiffnessParams { nodes, ..Default::default() }).unwrap();
        }
    }
}

#[test]
fn results_do_not_depend_on_the_number_of_threads() {
    let map =
        labels(
            [20, 20, 20],
            1.0,
            |p| {
                if p.iter().all(|v| (2.0..18.0).contains(v)) { 1 + u8::from(p[0] > 9.0) } else { 0 }
            },
        );
    let params = StiffnessParams { model: LawChoice::Linear, nodes: 1500, ..Default::default() };
    let [one, two] = [1, 3].map(|n| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
        pool.install(|| identify(&map, &squeezed(0.05, 0.49), &params))
    });
    // As text: what is unknown is not a number.
    assert_eq!(format!("{:?}", one.regions), format!("{:?}", two.regions));
    assert_eq!(one.displacement, two.displacement);
}

/// A phantom and its moduli from the exact displacement on a coarse mesh.
fn phantom_moduli(kind: PhantomKind, size: usize, nodes: usize) -> (Pressed, StiffnessResult) {
    let mut params = PhantomParams { seed: 21, ..PhantomParams::new(kind) };
    let from = params.size;
    params.size = from.map(|n| n * size / from[0]);
    params.spacing = params.spacing.map(|s| s * from[0] as f64 / size as f64);
    let body = Pressed::new(&params).unwrap();
    let labels = body.phantom.stiffness.as_ref().unwrap().labels.clone();
    let params = StiffnessParams { force_n: Some(body.force_n), nodes, ..Default::default() };
    let result = body.measure(&body.phantom.truth, None, &labels, &params).unwrap();
    (body, result)
}

#[test]
fn layers_under_a_punch_are_told_though_the_edge_is_known_to_a_voxel_only() {
    // Before the mesh was cut along the edge the skin was up to 18 % off on a finer grid, and 50 on
    // a mesh that is not fine there.
    let (body, result) = phantom_moduli(PhantomKind::Slab, 48, 15_000);
    assert_eq!(result.law, Law::NeoHookean, "{:?}", result.evidence);
    for (r, bar) in result.regions.iter().zip([0.1, 0.04, 0.02]) {
        let off = r.youngs_modulus / body.modulus(r.label) - 1.0;
        assert!(r.identifiable && off.abs() < bar, "{} {off}", r.name);
    }
}

/// A found bug: small strain, which is not the law in the end, made a guided patch of a punch (from
/// images a skin of 80 kPa came out as 101).
#[test]
fn a_skin_under_a_punch_lies_within_its_deviation_whatever_contact_is_taken() {
    let body = Pressed::new(&PhantomParams { seed: 3, ..PhantomParams::new(PhantomKind::Slab) }.sized(40)).unwrap();
    let labels = &body.phantom.stiffness.as_ref().unwrap().labels;
    let params = StiffnessParams { force_n: Some(body.force_n), nodes: 10_000, ..Default::default() };
    let result = body.measure(&body.phantom.truth, None, labels, &params).unwrap();
    let chosen = result.evidence.iter().filter(|e| e.question == "contact" && e.chosen).count();
    assert_eq!(chosen, 1, "{:?}", result.evidence);
    for r in &result.regions {
        let off = r.youngs_modulus / body.modulus(r.label) - 1.0;
        assert!(
            !r.identifiable || off.abs() < 3.0 * r.sd / r.youngs_modulus,
            "{} {off} {} {:?}",
            r.name,
            r.sd / r.youngs_modulus,
            result.patches[1].contact
        );
    }
}

#[test]
fn a_fingertip_touches_the_plate_where_it_would_go_through_it() {
    // With the contact as the field shows it the skin was 21 % off and the pulp 5.
    let (body, result) = phantom_moduli(PhantomKind::Fingertip, 48, 5_000);
    for (r, bar) in result.regions.iter().zip([0.12, 0.08]) {
        let off = r.youngs_modulus / body.modulus(r.label) - 1.0;
        assert!(r.identifiable && off.abs() < bar, "{} {off}", r.name);
    }
    let bone = &result.regions[2];
    assert_eq!(bone.bound, Some("lower"), "{bone:?}");
    assert!(bone.youngs_modulus < body.modulus(bone.label));
}

/// A body pressed from above that is held where a mask says so.
fn held_where(
    held: impl Fn([f64; 3]) -> bool + Sync,
    map: &Mask,
    field: &DenseField,
    params: &StiffnessParams,
) -> StiffnessResult {
    let mask = Mask::from_voxels(*map.grid(), |_, p| u8::from(held(p.0)));
    identify_held(&Place::Mask(Box::new(mask), "held.nii.gz".into()), map, field, params)
}

/// A mask of the held side that leaves out a quarter of it made moduli 20 % too high without a
/// word.
#[test]
fn a_held_side_that_its_mask_covers_in_part_is_warned_of() {
    let map = labels([20, 20, 20], 1.0, |p| u8::from(p.iter().all(|v| (2.0..18.0).contains(v))));
    // Held as a plate below, pressed above, with a bulge between.
    let field = DenseField::from_fn(grid([20, 20, 20], 1.0), |p: WorldPoint| {
        let (h, bulge) = ((p.0[2] - 1.5) / 16.0, 0.2 * (1.0 - ((p.0[2] - 9.5) / 8.0).powi(2)));
        [bulge * (p.0[0] - 9.5) / 8.0, bulge * (p.0[1] - 9.5) / 8.0, -0.8 * h]
    });
    let params = StiffnessParams { nodes: 3000, ..Default::default() };
    for (part, warned) in [(18.0, false), (14.0, true)] {
        let result = held_where(|p| p[2] < 3.0 && p[0] < part, &map, &field, &params);
        let said = result.warnings.iter().any(|w| w.contains("beside the held patch"));
        assert_eq!(said, warned, "{:?}", result.warnings);
    }
}

/// One modulus for a body with a ball ten times as stiff in it came out 18 % too high, and noise
/// hid what it left over.
#[test]
fn what_one_label_hides_is_warned_of_though_there_is_noise() {
    let body = inclusion(10.0, 41, 40);
    let known = &body.phantom.stiffness.as_ref().unwrap().labels;
    let one = Mask::from_voxels(*known.grid(), |at, _| u8::from(known.as_slice()[at] > 0));
    let params = StiffnessParams { force_n: Some(body.force_n), nodes: 3000, ..Default::default() };
    for noise in [0.0, 0.02] {
        let field = noisy(&body.phantom.truth, noise, 5);
        for (labels, warned) in [(known, false), (&one, true)] {
            let result = identify(labels, &field, &params);
            let said = result.warnings.iter().any(|w| w.contains("the model leaves over"));
            assert_eq!(said, warned, "{noise} mm: {:?}", result.warnings);
        }
    }
}

/// `--held` and `--load` the other way round: the body is then held at a small plate and pressed
/// all over its base.
#[test]
fn a_body_held_at_a_tenth_of_what_is_pressed_is_asked_about() {
    let map = labels([20, 20, 20], 1.0, |p| u8::from(p.iter().all(|v| (2.0..18.0).contains(v))));
    let params = StiffnessParams { nodes: 2000, ..Default::default() };
    for (side, warned) in [(16.0, false), (4.0, true)] {
        let held = |p: [f64; 3]| p[2] < 3.0 && (0..2).all(|a| (p[a] - 9.5).abs() < 0.5 * side);
        let result = held_where(held, &map, &squeezed(0.05, 0.45), &params);
        assert_eq!(result.warnings.iter().any(|w| w.contains("the other way round")), warned, "{:?}", result.warnings);
    }
}

#[test]
fn a_mean_over_a_block_of_a_curved_displacement_is_read_as_a_mean() {
    // 56^3 voxels are averaged over blocks of two, 80^3 over three.
    for (voxels, block) in [(56, 2), (80, 3)] {
        let side = voxels as f64;
        let map = labels([voxels + 4; 3], 1.0, |p| u8::from(p.iter().all(|v| (2.0..side + 2.0).contains(v))));
        let body = straight(&map, 1500);
        let curved = |p: [f64; 3]| [1e-3 * p[0] * p[0], 1e-3 * p[2] * (p[1] - p[2]), -1e-3 * p[0] * p[1]];
        let field = DenseField::from_fn(*map.grid(), |p| curved(p.0));
        let mut x = vec![0.0; body.pattern.unknowns()];
        for (n, p) in body.places.iter().enumerate() {
            let at = body.pattern.first(n as u32);
            x[at..at + 3].copy_from_slice(&curved(*p));
        }
        let (observations, found) = from_field(&body, &field, &map);
        assert_eq!(found, block);
        assert!(observations.len() > 15_000, "{}", observations.len());
        let mut middle: f64 = 0.0;
        for o in &observations {
            let (u, at) = (o.read(&body, &x), curved(o.place));
            for a in 0..3 {
                assert!((u[a] - o.displacement[a]).abs() < 2e-6, "{:?}: {u:?}, {:?}", o.place, o.displacement);
                middle = middle.max((at[a] - o.displacement[a]).abs());
            }
        }
        // What it would have been off by.
        assert!(middle > 1e-4, "{middle}");
    }
}

/// A found bias: matches were taken for the displacement in the middle of their patches, and stiff
/// balls came out 5 % too soft from images.
#[test]
fn a_match_is_read_as_the_mean_over_its_patch() {
    let map = labels([44; 3], 1.0, |p| u8::from(p.iter().all(|v| (2.0..42.0).contains(v))));
    let body = straight(&map, 1500);
    let curved = |p: [f64; 3]| [1e-3 * p[0] * p[0], 1e-3 * p[2] * (p[1] - p[2]), -1e-3 * p[0] * p[1]];
    // A field that is short of all curvature.
    let smooth = |p: [f64; 3]| [0.02 * p[0], 0.3 - 0.01 * p[2], 0.01 * p[1]];
    let field = DenseField::from_fn(*map.grid(), |p| smooth(p.0));
    let found = |p: [f64; 3]| {
        let mut mean = smooth(p);
        for n in 0..343 {
            let at = [n % 7, n / 7 % 7, n / 49].map(|v| v as f64 - 3.0);
            let at: [f64; 3] = std::array::from_fn(|a| p[a] + at[a]);
            (0..3).for_each(|a| mean[a] += (curved(at)[a] - smooth(at)[a]) / 343.0);
        }
        mean
    };
    // The last two beside a face: one of them outside.
    let places = (0..6).map(|n| [8.3 + 5.0 * n as f64, 20.6, 30.1 - 3.0 * n as f64]);
    let places: Vec<[f64; 3]> = places.chain([[20.0, 21.0, 40.8], [20.0, 21.0, 43.0]]).collect();
    let one = |p: &[f64; 3]| Match {
        initial: WorldPoint(*p),
        displacement: found(*p),
        ncc: 0.9,
        covariance: [1e-4, 1e-4, 1e-4, 0.0, 0.0, 0.0],
        kept: true,
        raw: None,
    };
    let observations = from_matches(&body, &field, &SparseField { matches: places.iter().map(one).collect() });
    assert_eq!(observations.len(), 7);
    let mut x = vec![0.0; body.pattern.unknowns()];
    for (n, p) in body.places.iter().enumerate() {
        let at = body.pattern.first(n as u32);
        x[at..at + 3].copy_from_slice(&curved(*p));
    }
    let mut middle: f64 = 0.0;
    for o in &observations[..6] {
        let (u, d) = (o.read(&body, &x), o.displacement);
        assert!((0..3).all(|a| (u[a] - d[a]).abs() < 2e-6), "{:?}: {u:?}, {d:?}", o.place);
        middle = (0..3).map(|a| (curved(o.place)[a] - found(o.place)[a]).abs()).fold(middle, f64::max);
    }
    // What they would have been off by.
    assert!(middle > 3e-3, "{middle}");
    // Of the patch beside the face a third lies outside.
    assert_eq!((observations[6].place, observations[6].around.len()), (places[6], 18));
    // A field without numbers leaves the match as it is.
    let none = DenseField::from_fn(*map.grid(), |_| [f64::NAN; 3]);
    let alone = from_matches(&body, &none, &SparseField { matches: vec![one(&places[0])] });
    assert_eq!((alone[0].displacement, alone[0].around.len()), (found(places[0]), 0));
}

/// A block with one inclusion, `size` voxels along x.
fn inclusion(contrast: f64, seed: u64, size: usize) -> Pressed {
    let mut params = PhantomParams { seed, ..PhantomParams::new(PhantomKind::Inclusion) }.sized(size);
    params.elastic.contrast = contrast;
    Pressed::new(&params).unwrap()
}

/// With normal noise (mm) of its own in each component of each voxel.
fn noisy(truth: &DenseField, noise: f64, seed: u64) -> DenseField {
    let mut out = truth.clone();
    let mut random = Random::new(seed, 7);
    out.as_mut_slice().iter_mut().for_each(|v| *v += (noise * random.normals()[0]) as f32);
    out
}

/// What is found without labels in a field of a phantom.
fn without_labels(body: &Pressed, field: &DenseField, nodes: usize) -> StiffnessResult {
    unlabelled(body, field, &unlabelled_params(body, nodes))
}

fn unlabelled_params(body: &Pressed, nodes: usize) -> StiffnessParams {
    StiffnessParams { force_n: Some(body.force_n), nodes, ..StiffnessParams::default() }
}

fn unlabelled(body: &Pressed, field: &DenseField, params: &StiffnessParams) -> StiffnessResult {
    searched(field, &body.phantom.stiffness.as_ref().unwrap().labels, params)
}

/// What is found in a field where all that is known of `known` is the body.
fn searched(field: &DenseField, known: &Mask, params: &StiffnessParams) -> StiffnessResult {
    let tissue = Mask::from_voxels(*known.grid(), |at, _| u8::from(known.as_slice()[at] != 0));
    let [held, load] = ["z-", "z+"].map(|side| Place::Side(Side::parse(side).unwrap()));
    let inputs = Inputs {
        field,
        matches: None,
        labels: &tissue,
        labelled: false,
        held: &held,
        load: &load,
        names: &|label| format!("region {label}"),
        quality: FieldQuality::default(),
    };
    run(&inputs, params, &|_, _| {}).unwrap()
}

#[test]
fn a_homogeneous_body_is_one_region_within_two_deviations() {
    // Its deviation left out what the surface is known to, and truth lay 2.3 to 2.7 of them away.
    // The box ends 0.4 voxel inside its mask along both free axes, and 0.3 outside.
    for size in [34, 42] {
        let mut params = PhantomParams { seed: 176, ..PhantomParams::new(PhantomKind::Inclusion) }.sized(size);
        params.elastic.inclusions = 0;
        let body = Pressed::new(&params).unwrap();
        let result = without_labels(&body, &body.phantom.truth, 4_000);
        let [only] = &result.regions[..] else { panic!("{:?}", result.regions) };
        let off = only.youngs_modulus - body.modulus(1);
        assert!(off.abs() < 2.0 * only.sd && only.sd < 0.03 * only.youngs_modulus, "{only:?}");
    }
}

#[test]
fn a_region_found_without_labels_is_drawn_to_its_size() {
    // As the map drew it, a fifth too small, it came out a fifth too stiff.
    let params = PhantomParams { seed: 64, ..PhantomParams::new(PhantomKind::Inclusion) }.sized(48);
    let body = Pressed::new(&params).unwrap();
    let result = without_labels(&body, &body.phantom.truth, 7_000);
    let known = &body.phantom.stiffness.as_ref().unwrap().labels;
    let drawn = |label: u8| {
        result
            .map
            .as_slice()
            .iter()
            .filter(|v| (f64::from(**v) - result.regions[label as usize - 1].youngs_modulus).abs() < 1e-3)
            .count()
    };
    let truth = known.as_slice().iter().filter(|l| **l == 2).count() as f64;
    let (size, ratio) = (drawn(2) as f64 / truth, result.regions[1].ratio / 5.0);
    assert_eq!(result.regions.len(), 2);
    assert!((size - 1.0).abs() < 0.15, "{size}");
    assert!((ratio - 1.0).abs() < 0.1, "{ratio}");
    assert!((ratio - 1.0).abs() < 2.0 * result.regions[1].ratio_sd / 5.0);
}

/// The bars of a labelled inclusion: its ratio to what is around it, and that one's modulus from
/// the force, within 3 % from the exact field and 5 % with 0.05 mm of noise, and within two
/// deviations.
fn holds_its_bars(contrast: f64, seed: u64) {
    // They are for so many voxels: with half of them a ball ten times as stiff is 5 % off.
    let body = inclusion(contrast, seed, 96);
    let labels = &body.phantom.stiffness.as_ref().unwrap().labels;
    let params = StiffnessParams { force_n: Some(body.force_n), ..StiffnessParams::default() };
    for (noise, bar) in [(0.0, 0.03), (0.05, 0.05)] {
        let result = body.measure(&noisy(&body.phantom.truth, noise, seed), None, labels, &params).unwrap();
        let [around, within] = &result.regions[..] else { panic!("{:?}", result.regions) };
        assert!(around.identifiable && within.identifiable);
        let truth = body.modulus(within.label) / body.modulus(around.label);
        let ratio = within.ratio / truth - 1.0;
        let absolute = around.youngs_modulus / body.modulus(around.label) - 1.0;
        assert!(ratio.abs() < bar && absolute.abs() < bar, "noise {noise}: {ratio:.4}, {absolute:.4}");
        let deviations =
            [ratio.abs() * truth / within.ratio_sd, absolute.abs() * body.modulus(around.label) / around.sd];
        assert!(deviations.iter().all(|d| *d < 2.0), "noise {noise}: {deviations:?} deviations");
    }
}

#[test]
#[ignore = "two to three minutes without the release profile: cargo test --release --test mechanics -- --ignored"]
fn twice_as_stiff_is_told_within_its_bars() {
    holds_its_bars(2.0, 61);
}

#[test]
#[ignore = "two to three minutes without the release profile: cargo test --release --test mechanics -- --ignored"]
fn ten_times_as_stiff_is_told_within_its_bars() {
    holds_its_bars(10.0, 61);
}

#[test]
fn one_region_by_request_is_not_called_enough() {
    let body = inclusion(5.0, 73, 48);
    let params = StiffnessParams { regions: 1, ..unlabelled_params(&body, 2_500) };
    let result = unlabelled(&body, &body.phantom.truth, &params);
    assert_eq!(result.regions.len(), 1);
    let about = |model: &str| result.evidence.iter().find(|e| e.question == "regions" && e.model == model).unwrap();
    assert!(about("1").chosen && about("1").reason.contains("stands out"), "{:?}", result.evidence);
    assert!(!about("2").chosen && about("2").reason.contains("not tried"), "{:?}", result.evidence);
    let said = palpate::report::stiffness::verdict(&result);
    assert!(said.contains("One modulus does not explain the field"), "{said}");
}

#[test]
fn under_too_much_noise_no_second_region_is_claimed() {
    let body = inclusion(5.0, 73, 48);
    let result = without_labels(&body, &noisy(&body.phantom.truth, 0.2, 73), 6_000);
    let [only] = &result.regions[..] else { panic!("{:?}", result.regions) };
    assert!(only.youngs_modulus.is_finite() && only.identifiable, "{only:?}");
    let said = |e: &&Evidence| e.question == "regions" && e.model == "1" && e.chosen;
    let reason = &result.evidence.iter().find(said).unwrap().reason;
    assert!(reason.contains("the data do not support a second region"), "{reason}");
}

#[test]
fn an_inclusion_is_found_that_stands_out_of_the_noise_of_means_and_not_of_a_voxel() {
    // Its misfit of 0.04 mm was compared with the 0.1 mm of a voxel, where means over eight of them
    // are measured.
    let body = inclusion(5.0, 73, 58);
    let found = without_labels(&body, &noisy(&body.phantom.truth, 0.1, 73), 4_500);
    let [around, within] = &found.regions[..] else { panic!("{:?}", found.evidence) };
    let truth = body.modulus(2) / body.modulus(1);
    assert!((within.ratio / truth - 1.0).abs() < 0.15 && (within.ratio - truth).abs() < 2.0 * within.ratio_sd);
    assert!((around.youngs_modulus / body.modulus(1) - 1.0).abs() < 0.03, "{around:?}");
    assert!(found.left_over.is_none() && found.warnings.is_empty(), "{:?}", found.warnings);
    // Twice the noise hides it, and that is not called one modulus that explains the field.
    let hidden = without_labels(&body, &noisy(&body.phantom.truth, 0.2, 73), 2_500);
    assert_eq!(hidden.regions.len(), 1);
    let said = palpate::report::stiffness::verdict(&hidden);
    assert!(said.contains("do not support a second region") && said.contains("beyond the noise"), "{said}");
    assert!(hidden.warnings.iter().any(|w| w.contains("softer or stiffer")), "{:?}", hidden.warnings);
    assert!(hidden.trust > Trust::High && found.trust == Trust::High, "{:?}", hidden.trust_reasons);
}

#[test]
fn noise_alone_makes_no_second_region_and_no_warning() {
    let mut params = PhantomParams { seed: 74, ..PhantomParams::new(PhantomKind::Inclusion) }.sized(58);
    params.elastic.inclusions = 0;
    let body = Pressed::new(&params).unwrap();
    for noise in [0.05, 0.2] {
        let result = without_labels(&body, &noisy(&body.phantom.truth, noise, 74), 2_500);
        assert_eq!(result.regions.len(), 1, "{noise}: {:?}", result.evidence);
        assert!(result.warnings.is_empty(), "{noise}: {:?}", result.warnings);
    }
}

/// The displacement of a block of 50 x 40 x 36 voxels of 0.8 mm with two balls of the same 5 times
/// the modulus, pressed by 5 %, by the model itself on a finer mesh; and its labels.
fn two_alike() -> (DenseField, Mask) {
    let middles = [-9.6, 9.6].map(|x| [24.0 + x, 20.0, 18.4]);
    let within = |p: [f64; 3], m: &[f64; 3]| (0..3).map(|a| (p[a] - m[a]).powi(2)).sum::<f64>() < 6.5 * 6.5;
    let g = grid([60, 50, 46], 0.8);
    let map = Mask::from_voxels(g, |at, p| {
        let [i, j, k] = g.voxel(at);
        match (5..55).contains(&i) && (5..45).contains(&j) && (5..41).contains(&k) {
            true => middles.iter().position(|m| within(p.0, m)).map_or(1, |n| n as u8 + 2),
            false => 0,
        }
    });
    let body = body(&map, 7_000);
    let moduli = body.region.iter().map(|r| Material::of_youngs_modulus([20.0, 100.0, 100.0][*r as usize], 0.49));
    let end = |z: f64| {
        let near = |n: &u32| (body.places[*n as usize][2] - z).abs() < 0.1;
        surface_nodes(&body).into_iter().filter(near).collect::<Vec<u32>>()
    };
    let mut ties = tied(&body, &end(3.6), |_| [0.0; 3]);
    ties.extend(tied(&body, &end(32.4), |_| [0.0, 0.0, -1.44]));
    let solved = Problem::new(&body, Law::Linear, moduli.collect(), ties).solve(None, 1e-8).unwrap();
    let places: Vec<[f64; 3]> = (0..g.len()).map(|at| g.voxel(at)).map(|[i, j, k]| g.world(i, j, k).0).collect();
    let found = find(&body, &places);
    let field = DenseField::from_voxels(g, |at, _| found[at].map_or([0.0; 3], |r| read(&[r], &body, &solved.x)));
    (field, map)
}

#[test]
fn two_like_inclusions_are_two_regions_beside_the_first() {
    // As many classes of moduli as regions found one of them, in two halves.
    let (field, known) = two_alike();
    let params = StiffnessParams { nodes: 3_000, regions: 3, model: LawChoice::Linear, ..StiffnessParams::default() };
    let result = searched(&field, &known, &params);
    let [_, balls @ ..] = &result.regions[..] else { panic!("{:?}", result.regions) };
    assert_eq!(balls.len(), 2, "{:?}", result.evidence);
    // Regions are known less well without labels than with them: so much stays unknown of either.
    for ball in balls {
        assert!((ball.ratio - 5.0).abs() < 2.0 * ball.ratio_sd, "{ball:?}");
        assert!((0.02 * 5f64.ln()..0.2).contains(&(ball.ratio_sd / ball.ratio)), "{ball:?}");
    }
    let found = result.found.unwrap();
    for label in [2, 3] {
        let size = |m: &Mask, l: u8| m.as_slice().iter().filter(|v| **v == l).count();
        let pairs = || found.as_slice().iter().zip(known.as_slice());
        let shared = |l: u8| pairs().filter(|(f, k)| **f == l && **k == label).count() as f64;
        let dice = [2, 3].map(|l| 2.0 * shared(l) / (size(&found, l) + size(&known, label)) as f64);
        assert!(dice[0].max(dice[1]) > 0.85, "{dice:?}");
    }
}

#[test]
fn a_model_that_was_not_tried_has_no_figures() {
    let untried = Evidence {
        question: "regions",
        model: "2".into(),
        parameters: 0,
        residual_mm: f64::INFINITY,
        bic: f64::INFINITY,
        chosen: false,
        reason: "not tried".into(),
    };
    assert_eq!(untried.to_string(), "regions: 2: not chosen (not tried)");
}
