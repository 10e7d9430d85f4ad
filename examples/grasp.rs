//! The eight joint-angle motions of the source, from the scene file beside this one: how the object
//! stands after each, with and without tangential deformation of the tips.
//!
//! `cargo run --release --example grasp`; look at `out/grasp.html` afterwards.

use palpate::report::{GraspReport, grasp};
use palpate::types::FingertipModel;
use palpate::{io, pipeline};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/eight_motions.toml");
    let scene = io::read_scene(path, &io::SceneOverrides::default())?.scene;
    assert_eq!(scene.fingertip.model, FingertipModel::Parallel);
    let outcome = pipeline::grasp::run(&scene, &|_, _| {})?;
    let without = outcome.without_tangential.map(|r| r.map_err(|e| e.to_string()));

    println!(
        "{:>6} {:>9} {:>9} {:>12} {:>16} {:>8}",
        "motion", "theta 1", "theta 2", "turn, deg", "without d_t", "f_n, N"
    );
    for motion in &outcome.run.motions {
        let other = without.as_ref().and_then(|r| r.as_ref().ok()).and_then(|r| r.motions.get(motion.step));
        println!(
            "{:>6} {:>9.1} {:>9.1} {:>12.3} {:>16} {:>8.2}",
            motion.step,
            motion.target[0].to_degrees(),
            motion.target[1].to_degrees(),
            motion.reached.pose[2].to_degrees(),
            other.map_or("-".into(), |m| format!("{:.3}", m.reached.pose[2].to_degrees())),
            motion.reached.normal_force[0]
        );
    }
    let report = GraspReport {
        name: "eight_motions.toml",
        scene: &scene,
        run: &outcome.run,
        without_tangential: without.as_ref(),
        stable_steps: &outcome.stable_steps,
        bands: outcome.bands.as_ref(),
        sweep: &[],
        seconds: &outcome.seconds,
        warnings: &[],
    };
    std::fs::create_dir_all("out")?;
    io::write_text("out/grasp.html", &grasp::page(&report))?;
    Ok(())
}
