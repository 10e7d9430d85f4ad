//! Iterations against factors: the same solutions, forces and moduli.

use palpate::mesh::tetrahedral::{Fineness, mesh_labels};
use palpate::numerics::random::Random;
use palpate::pipeline::compression_phantoms::Pressed;
use palpate::stiffness::boundary_conditions::Place;
use palpate::stiffness::fem_body::Body;
use palpate::stiffness::fields::volume;
use palpate::stiffness::forward::{Problem, Tie};
use palpate::stiffness::identify::Setup;
use palpate::stiffness::law::Material;
use palpate::stiffness::mesh_problem::Level;
use palpate::synth::{PhantomKind, PhantomParams};
use palpate::types::stiffness::{Contact, Law, Side};
use palpate::types::{Affine, Grid, Mask, StiffnessParams};

/// A block of 16 voxels a side with a ball and a layer in it, of three labels.
fn body(nodes: usize, random: &mut Random) -> Body {
    let grid = Grid::new([20; 3], Affine::scaled([1.0; 3], [0.0; 3]).unwrap()).unwrap();
    let middle: [f64; 3] = std::array::from_fn(|_| random.uniform(7.5, 11.5));
    let (radius, floor) = (random.uniform(3.0, 5.0), random.uniform(4.0, 6.0));
    let map = Mask::from_voxels(grid, |_, p| match p.0 {
        p if p.iter().any(|v| !(2.0..18.0).contains(v)) => 0,
        p if (0..3).map(|a| (p[a] - middle[a]).powi(2)).sum::<f64>() < radius * radius => 2,
        p if p[2] < floor => 3,
        _ => 1,
    });
    Body::new(&mesh_labels(&map, &Fineness::for_nodes(4096.0, nodes)).unwrap()).unwrap()
}

/// Held below, and pressed above: sticking, sliding along the plane or as measured.
fn ties(body: &Body, contact: usize) -> Vec<Tie> {
    let mut out = Vec::new();
    for node in body.nodes_on(0..body.surface.len()) {
        let p = body.places[node as usize];
        let up = Some([0.0, 0.0, 1.0]);
        let target = [[0.02, 0.0, -0.8], [0.0, 0.0, -0.8], [0.0, 0.1 * (0.4 * p[0]).sin(), -0.5 - 0.02 * p[0]]];
        if p[2] < 1.6 {
            out.push(Tie { node, direction: None, target: [0.0; 3], strength: 1.0 });
        } else if p[2] > 17.4 {
            let direction = up.filter(|_| contact == 1);
            out.push(Tie { node, direction, target: target[contact], strength: 1.0 });
        }
    }
    out
}

/// Work of the ties on a linear push of their nodes: a force.
fn force(problem: &Problem<'_>, x: &[f64]) -> f64 {
    problem.ties.iter().filter(|t| t.target[2] != 0.0).map(|t| problem.pull(t, x)[2]).sum()
}

#[test]
fn iterations_give_the_factors_solution() {
    let mut random = Random::new(41, 0);
    for (k, nu) in [0.3, 0.45, 0.495, 0.3, 0.45, 0.495].into_iter().enumerate() {
        let direct = body(2500, &mut random);
        let iterated = direct.clone().iterated().unwrap();
        for contact in 0..3 {
            let contrast = [1.0, random.uniform(0.0, 600f64.ln()).exp(), 600f64.powf(random.uniform(-1.0, 1.0))];
            let of = |r: &u16| Material::of_youngs_modulus(5.0 * contrast[*r as usize], nu);
            let materials: Vec<Material> = direct.region.iter().map(of).collect();
            let law = if k < 3 { Law::Linear } else { Law::NeoHookean };
            let solved = |body: &Body| {
                let problem = Problem::new(body, law, materials.clone(), ties(body, contact));
                let s = problem.solve(None, 1e-6).unwrap();
                let u: Vec<f64> = (0..body.places.len()).flat_map(|n| body.displacement(&s.x, n as u32)).collect();
                (force(&problem, &s.x), u)
            };
            let (one, two) = (solved(&direct), solved(&iterated));
            let off = one.1.iter().zip(&two.1).fold(0.0, |m: f64, (a, b)| m.max((a - b).abs()));
            assert!(
                off < 1e-5 && (two.0 / one.0 - 1.0).abs() < 1e-5,
                "nu {nu}, {contrast:?}, contact {contact}: {off}"
            );
        }
    }
}

#[test]
fn iterations_give_the_factors_moduli() {
    let of = |kind| Pressed::new(&PhantomParams { seed: 5, ..PhantomParams::new(kind) }.sized(24)).unwrap();
    let (ball, fingertip) = (of(PhantomKind::Inclusion), of(PhantomKind::Fingertip));
    let cases = [
        (&ball, ["z-", "z+"], Contact::Sticking, Law::Linear),
        (&ball, ["z-", "z+"], Contact::Guided, Law::NeoHookean),
        (&fingertip, ["z+", "z-"], Contact::Sliding, Law::NeoHookean),
    ];
    for (pressed, sides, contact, law) in cases {
        let map = &pressed.phantom.stiffness.as_ref().unwrap().labels;
        let mesh = mesh_labels(map, &Fineness::for_nodes(volume(map), 2500)).unwrap();
        let [held, load] = sides.map(|side| Place::Side(Side::parse(side).unwrap()));
        let mut level = Level::new(&mesh, &pressed.phantom.truth, None, map, &held, &load, None).unwrap();
        level.patches[1].contact = contact;
        let setup = level.setup(law, &StiffnessParams::default(), level.largest());
        let iterated = level.body.clone().iterated().unwrap();
        let [one, two] = [&level.body, &iterated].map(|body| {
            let setup = Setup { body, ..setup.clone() };
            setup.run(setup.start(), 12, 1e-5).unwrap()
        });
        let off = one.state.theta.iter().zip(&two.state.theta).fold(0.0, |m: f64, (a, b)| m.max((a - b).abs()));
        assert!(off < 1e-3, "{contact:?}: {:?} {:?}", one.state.theta, two.state.theta);
        assert!((one.force[0] / two.force[0] - 1.0).abs() < 1e-3, "{contact:?}: {:?} {:?}", one.force, two.force);
        let deviation = |e: &palpate::stiffness::identify::Estimate| e.covariance[0].sqrt();
        assert!((deviation(&one) / deviation(&two) - 1.0).abs() < 0.02, "{contact:?}");
    }
}

#[test]
fn iterations_do_not_depend_on_the_number_of_threads() {
    let mut random = Random::new(42, 0);
    let body = body(1500, &mut random).iterated().unwrap();
    let materials = body.region.iter().map(|r| Material::of_youngs_modulus(1.0 + f64::from(*r), 0.49)).collect();
    let problem = Problem::new(&body, Law::Linear, materials, ties(&body, 0));
    let solved = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let s = problem.solve(None, 1e-6).unwrap();
            let mut sides = problem.residual_by_modulus(&s.x, |e| body.region[e] == 1).unwrap().repeat(11);
            s.factor.sensitivities(&mut sides, None).unwrap();
            (s.x, sides)
        })
    };
    assert!(solved(1) == solved(4));
}
