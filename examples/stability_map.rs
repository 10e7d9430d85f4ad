//! The largest stable step of each integrator and formulation over the stiffness of the tips, the
//! object's mass, the damping, and the gain of the stabilisation: the map of
//! docs/reference/grasp.md.
//!
//! `cargo run --release --example stability_map [-- --quick]` prints a table and writes
//! `out/stability-map.svg`.

use palpate::grasp::{stability, stepping};
use palpate::io;
use palpate::report::figure;
use palpate::report::plot::{Line, Plot};
use palpate::types::Scene;
use palpate::types::scene::{Formulation, Method, rectangle_inertia};

/// What is varied, in factors of the reference scene's value, and how.
const VARIED: [(&str, fn(&mut Scene, f64)); 4] = [
    ("Stiffness E of the tips", |s, f| s.fingertip.youngs_modulus *= f),
    ("Mass of the object", |s, f| {
        s.object.mass *= f;
        s.object.inertia = rectangle_inertia(s.object.mass, s.object.width, s.object.height);
    }),
    ("Damping c_n and c_t of the tips", |s, f| s.fingertip.damping = s.fingertip.damping.map(|c| c * f)),
    ("Gain of the stabilisation", |s, f| s.integrator.baumgarte *= f),
];
const CASES: [(&str, Method, Formulation); 4] = [
    ("rk4", Method::Rk4, Formulation::Minimal),
    ("semi-implicit", Method::SemiImplicitEuler, Formulation::Minimal),
    ("rk4, multipliers", Method::Rk4, Formulation::Multipliers),
    ("semi-implicit, multipliers", Method::SemiImplicitEuler, Formulation::Multipliers),
];

const TITLE: &str = "log10 of the largest stable step in ms, reference scene; dashed: multiplier form";

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let points = if std::env::args().any(|a| a == "--quick") { 5 } else { 25 };
    println!("{:>34} {:>8} {:>10} {:>34} {:>10}", "varied", "factor", "postures", "integrator", "step, ms");
    let mut plots = Vec::new();
    for (title, change) in VARIED {
        let mut lines: Vec<Line> = CASES
            .iter()
            .enumerate()
            .map(|(i, (name, _, form))| {
                let dashed = *form == Formulation::Multipliers;
                Line::new(if dashed { "" } else { name }, i % 2, dashed, Vec::new())
            })
            .collect();
        for i in 0..points {
            // From a hundredth to a hundred times.
            let power = 4.0 * f64::from(i) / f64::from(points - 1) - 2.0;
            let mut scene = Scene::reference();
            change(&mut scene, 10f64.powf(power));
            let postures = stability::postures(&scene, scene.fingertip.model).into_iter();
            let at: Vec<_> = postures.filter_map(|p| p.2.ok()).filter(|e| e.smallest_eigenvalue > 0.0).collect();
            for ((name, method, formulation), line) in CASES.iter().zip(&mut lines) {
                let step =
                    if at.is_empty() { f64::NAN } else { stepping::stable_step(&scene, *method, *formulation, &at) };
                let factor = 10f64.powf(power);
                println!("{title:>34} {factor:>8.3} {:>10} {name:>34} {:>10.3}", at.len(), 1e3 * step);
                line.points.push([power, (1e3 * step).log10()]);
            }
        }
        let plot = Plot { title, across: "log10 of the factor", marks: &[] };
        plots.push(plot.draw(&lines));
    }
    std::fs::create_dir_all("out")?;
    io::write_text("out/stability-map.svg", &figure::sheet(TITLE, &plots, 2))?;
    Ok(())
}
