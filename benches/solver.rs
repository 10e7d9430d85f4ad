//! Time and memory of one forward solution and its sensitivities against the size of a mesh.
//!
//! `cargo bench --bench solver -- direct|iterative NODES ...`. A process for each number of nodes
//! tells its own peak of memory. A ball of ten times the modulus in a block that is pressed by a
//! plate, Poisson's ratio 0.49, both laws.

use palpate::mesh::tetrahedral::{Fineness, mesh_labels};
use palpate::pipeline::cpu;
use palpate::stiffness::fem_body::Body;
use palpate::stiffness::forward::{Problem, Tie};
use palpate::stiffness::law::Material;
use palpate::types::stiffness::Law;
use palpate::types::{Affine, Grid, Mask};

fn body(nodes: usize) -> Result<Body, Box<dyn std::error::Error>> {
    // Two voxels for each distance of nodes.
    let side = (2.0 * (nodes as f64).cbrt()).ceil();
    let grid = Grid::new([side as usize + 4; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
    let (low, high, middle) = (1.5, 1.5 + side, 1.5 + 0.5 * side);
    let map = Mask::from_voxels(grid, |_, p| {
        let inside = p.0.iter().all(|v| (low..high).contains(v));
        let ball = p.0.iter().map(|v| (v - middle).powi(2)).sum::<f64>() < (0.3 * side).powi(2);
        if inside { 1 + u8::from(ball) } else { 0 }
    });
    Ok(Body::new(&mesh_labels(&map, &Fineness::for_nodes(side.powi(3), nodes))?)?)
}

fn ties(body: &Body) -> Vec<Tie> {
    let ends = |a: fn(f64, f64) -> f64, from: f64| body.places.iter().map(|p| p[2]).fold(from, a);
    let (low, high) = (ends(f64::min, f64::INFINITY), ends(f64::max, f64::NEG_INFINITY));
    let all = body.nodes_on(0..body.surface.len()).into_iter();
    let tie = |node: u32| {
        let part = (body.places[node as usize][2] - low) / (high - low);
        let target = [0.0, 0.0, if part > 0.5 { -0.05 * (high - low) } else { 0.0 }];
        (!(0.01..0.99).contains(&part)).then_some(Tie { node, direction: None, target, strength: 1.0 })
    };
    all.filter_map(tie).collect()
}

/// Largest memory of the process so far (MB).
fn peak() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:")).unwrap_or("0");
    line.split_whitespace().next().and_then(|v| v.parse::<f64>().ok()).unwrap_or(0.0) / 1024.0
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let given: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect();
    let direct = given.iter().any(|a| a == "direct");
    println!("solver,law,nodes,unknowns,solution_cpu_s,sensitivities_cpu_s,peak_mb");
    for nodes in given.iter().filter_map(|a| a.parse::<usize>().ok()) {
        let whole = body(nodes)?;
        let body = if direct { Body { levels: None, ..whole } } else { whole.iterated()? };
        for law in [Law::Linear, Law::NeoHookean] {
            let materials = body.region.iter().map(|r| Material::of_youngs_modulus(10f64.powi((*r).into()), 0.49));
            let problem = Problem::new(&body, law, materials.collect(), ties(&body));
            let (solution, seconds) = cpu::timed(|| problem.solve(None, 1e-5));
            let solution = solution?;
            let mut sides = problem.residual_by_modulus(&solution.x, |e| body.region[e] == 1)?.repeat(14);
            let (solved, more) = cpu::timed(|| solution.factor.sensitivities(&mut sides, None));
            solved.map_err(|_| "no sensitivities")?;
            println!(
                "{},{law:?},{},{},{seconds:.2},{more:.2},{:.0}",
                if direct { "direct" } else { "iterative" },
                body.places.len(),
                body.pattern.unknowns(),
                peak()
            );
        }
    }
    Ok(())
}
