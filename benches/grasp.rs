//! Simulated seconds per CPU second on the reference scene, for each integrator and formulation;
//! one thread.
//!
//! `cargo bench --bench grasp [-- REPEATS]`; the best of some runs is printed, with the largest
//! error of the object's angle at the end of a hold, against the adaptive integrator at a tolerance
//! of 1e-12. `benches/grasp_mujoco.py` runs this and MuJoCo side by side.

use palpate::grasp::simulate::simulate;
use palpate::types::scene::{Formulation, Method, Scene};
use std::time::Instant;

/// CPU seconds of all threads so far; wall seconds where the system does not tell.
fn cpu_seconds(start: Instant) -> f64 {
    let spent = |thread: std::fs::DirEntry| -> Option<f64> {
        let told = std::fs::read_to_string(thread.path().join("schedstat")).ok()?;
        Some(told.split_whitespace().next()?.parse::<f64>().ok()? * 1e-9)
    };
    let threads = std::fs::read_dir("/proc/self/task").into_iter().flatten().flatten();
    threads.map(spent).sum::<Option<f64>>().filter(|&s| s > 0.0).unwrap_or_else(|| start.elapsed().as_secs_f64())
}

fn main() {
    let repeats: usize = std::env::args().filter_map(|a| a.parse().ok()).next().unwrap_or(20);
    let start = Instant::now();
    let mut exact = Scene::reference();
    exact.integrator.method = Method::Adaptive;
    exact.integrator.tolerance = 1e-12;
    let exact = match simulate(&exact, &|_| {}) {
        Ok(run) => run.motions,
        Err(error) => return println!("{error}"),
    };
    let angles: Vec<String> = exact.iter().map(|m| format!("{:.9}", m.reached.pose[2].to_degrees())).collect();
    println!("postures, degrees: {}", angles.join(" "));
    println!(
        "{:>20} {:>12} {:>8} {:>10} {:>14} {:>16}",
        "method", "form", "step, s", "CPU s", "simulated s/s", "angle error, deg"
    );
    let cases = [
        (Method::Rk4, Formulation::Minimal),
        (Method::SemiImplicitEuler, Formulation::Minimal),
        (Method::Rk4, Formulation::Multipliers),
        (Method::SemiImplicitEuler, Formulation::Multipliers),
        (Method::Adaptive, Formulation::Minimal),
    ];
    for (method, formulation) in cases {
        let mut scene = Scene::reference();
        scene.integrator.method = method;
        scene.integrator.formulation = formulation;
        // Several runs in one measurement: the clock of the scheduler ticks in milliseconds.
        let runs = 10;
        let (mut best, mut error) = (f64::INFINITY, 0.0f64);
        for _ in 0..repeats {
            let before = cpu_seconds(start);
            for _ in 0..runs {
                match simulate(&scene, &|_| {}) {
                    Ok(run) if run.completed => {
                        let off = run.motions.iter().zip(&exact).map(|(a, b)| a.reached.pose[2] - b.reached.pose[2]);
                        error = off.fold(0.0, |e, v| v.abs().max(e)).to_degrees();
                    }
                    Ok(run) => return println!("{}: {:?}", method.name(), run.events),
                    Err(error) => return println!("{}: {error}", method.name()),
                };
            }
            best = best.min((cpu_seconds(start) - before) / f64::from(runs));
        }
        let rate = scene.duration() / best;
        println!(
            "{:>20} {:>12} {:>8} {best:>10.5} {rate:>14.0} {error:>16.1e}",
            method.name(),
            formulation.name(),
            scene.integrator.step
        );
    }
}
