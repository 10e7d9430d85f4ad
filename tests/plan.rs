//! What a plan expects, against what simulated measurements give.
#![allow(clippy::unwrap_used)]

use palpate::numerics::random::Random;
use palpate::pipeline::planning::{self, PlanInputs};
use palpate::pipeline::stiffness::{self, FieldQuality, Inputs};
use palpate::stiffness::patches::Place;
use palpate::types::plan::{Plan, PlanParams};
use palpate::types::stiffness::{LawChoice, Side};
use palpate::types::{Affine, DenseField, Grid, Mask, StiffnessParams, StiffnessResult};

/// A block of 24 x 24 x 20 mm with a ball of 5.5 mm, or a stiff layer, in voxels of 1 mm.
fn body(label: impl Fn([f64; 3]) -> u8 + Sync) -> Mask {
    let grid = Grid::new([28, 28, 24], Affine::scaled([1.0; 3], [0.0; 3]).unwrap()).unwrap();
    let inside = |p: [f64; 3]| (0..3).all(|a| (2.0..[26.0, 26.0, 22.0][a]).contains(&p[a]));
    Mask::from_voxels(grid, |_, p| if inside(p.0) { label(p.0) } else { 0 })
}

fn ball() -> Mask {
    let middle = [13.3, 14.2, 12.1];
    body(|p| 1 + u8::from((0..3).map(|a| (p[a] - middle[a]).powi(2)).sum::<f64>() < 5.5 * 5.5))
}

fn side(text: &str) -> Place {
    Place::Side(Side::parse(text).unwrap())
}

fn planned(labels: &Mask, params: &PlanParams, sides: [&Place; 2]) -> Plan {
    let [held, load] = sides;
    let inputs = PlanInputs { labels, held, load, names: &|l| format!("region {l}") };
    planning::run(&inputs, params, &|_, _| {}).unwrap()
}

fn params(moduli: &[(u8, f64)]) -> PlanParams {
    let stiffness = StiffnessParams { nodes: 3000, model: LawChoice::Linear, ..StiffnessParams::default() };
    PlanParams { moduli: moduli.to_vec(), stiffness, ..PlanParams::default() }
}

/// A measured field: `field` with white noise of `noise` mm.
fn noisy(field: &DenseField, labels: &Mask, noise: f64, seed: u64) -> DenseField {
    let mut random = Random::new(seed, 7);
    let mut out = field.clone();
    let n = labels.as_slice().len();
    for o in (0..n).filter(|&o| labels.as_slice()[o] > 0) {
        let ([a, b], [c, _]) = (random.normals(), random.normals());
        for (k, v) in [a, b, c].into_iter().enumerate() {
            out.as_mut_slice()[k * n + o] += (noise * v) as f32;
        }
    }
    out
}

fn measured(field: &DenseField, labels: &Mask, force: f64, params: &PlanParams, sides: [&Place; 2]) -> StiffnessResult {
    let [held, load] = sides;
    let names = |l: u8| format!("region {l}");
    let quality = FieldQuality::default();
    let inputs = Inputs { field, matches: None, labels, labelled: true, held, load, names: &names, quality };
    let params = StiffnessParams { force_n: Some(force), ..params.stiffness.clone() };
    stiffness::run(&inputs, &params, &|_, _| {}).unwrap()
}

/// For each region: planned deviation and scatter, mean reported deviation, scatter and mean error
/// over `seeds` measurements (all relative).
fn compared(labels: &Mask, params: &PlanParams, [press, noise]: [f64; 2], seeds: u64, sides: [&Place; 2]) -> Vec<[f64; 5]> {
    let params = PlanParams { press_mm: vec![press], noise_mm: vec![noise], ..params.clone() };
    let plan = planned(labels, &params, sides);
    let [held, load] = sides;
    let inputs = PlanInputs { labels, held, load, names: &|l| format!("region {l}") };
    let truth = planning::simulate(&inputs, &params, press).unwrap();
    let runs: Vec<StiffnessResult> =
        (0..seeds).map(|s| measured(&noisy(&truth.field, labels, noise, s), labels, truth.force_n, &params, sides)).collect();
    let n = seeds as f64;
    plan.expected
        .iter()
        .enumerate()
        .map(|(r, e)| {
            let truth = params.modulus(e.label).unwrap();
            let logs: Vec<f64> = runs.iter().map(|run| (run.regions[r].youngs_modulus / truth).ln()).collect();
            let mean = logs.iter().sum::<f64>() / n;
            let scatter = (logs.iter().map(|l| (l - mean).powi(2)).sum::<f64>() / (n - 1.0)).sqrt();
            let said = runs.iter().map(|run| run.regions[r].sd / run.regions[r].youngs_modulus).sum::<f64>() / n;
            let row = [e.sd, e.scatter, said, scatter, mean];
            println!(
                "press {press} noise {noise} {}: planned {:.3} scatter {:.3}, stated {:.3} scatter {:.3} bias {:+.3}",
                e.name, row[0], row[1], row[2], row[3], row[4]
            );
            row
        })
        .collect()
}

#[test]
fn explore() {
    let labels = ball();
    let params = params(&[(1, 20.0), (2, 60.0)]);
    let sides = [side("z-"), side("z+")];
    for (press, noise) in [(0.4, 0.02), (0.4, 0.08), (0.8, 0.2), (0.2,0.1)] {
        let t = std::time::Instant::now();
        compared(&labels, &params, [press, noise], 8, [&sides[0], &sides[1]]);
        println!("{:.1} s", t.elapsed().as_secs_f64());
    }
}
