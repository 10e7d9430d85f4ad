//! What a plan expects, against what simulated measurements give.

use palpate::numerics::random::Random;
use palpate::pipeline::experimental_design::{self, PlanInputs};
use palpate::pipeline::stiffness::{self, FieldQuality, Inputs};
use palpate::report::plan::sentences;
use palpate::stiffness::boundary_conditions::Place;
use palpate::types::plan::{Plan, PlanParams};
use palpate::types::stiffness::{Contact, LawChoice, Side};
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
    experimental_design::run(&inputs, params, &|_, _| {}).unwrap()
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

/// For each region: planned deviation and scatter, reported deviation, scatter and mean error over
/// `seeds` measurements (all relative). Reported is the mean over measurements that leave over no
/// more than their noise: in the others chance alone counts as a misfit of the model.
fn compared(
    labels: &Mask,
    params: &PlanParams,
    [press, noise]: [f64; 2],
    seeds: u64,
    sides: [&Place; 2],
) -> Vec<[f64; 5]> {
    let params = PlanParams { press_mm: vec![press], noise_mm: vec![noise], ..params.clone() };
    let plan = planned(labels, &params, sides);
    let [held, load] = sides;
    let inputs = PlanInputs { labels, held, load, names: &|l| format!("region {l}") };
    let truth = experimental_design::simulate(&inputs, &params, press).unwrap();
    let runs: Vec<StiffnessResult> = (0..seeds)
        .map(|s| measured(&noisy(&truth.field, labels, noise, s), labels, truth.force_n, &params, sides))
        .collect();
    let n = seeds as f64;
    plan.expected
        .iter()
        .enumerate()
        .map(|(r, e)| {
            let truth = params.modulus(e.label).unwrap();
            let logs: Vec<f64> = runs.iter().map(|run| (run.regions[r].youngs_modulus / truth).ln()).collect();
            let mean = logs.iter().sum::<f64>() / n;
            let scatter = (logs.iter().map(|l| (l - mean).powi(2)).sum::<f64>() / (n - 1.0)).sqrt();
            let sd = |run: &StiffnessResult| run.regions[r].sd / run.regions[r].youngs_modulus;
            let all = runs.iter().map(sd).sum::<f64>() / n;
            let plain: Vec<f64> = runs.iter().filter(|run| run.residual_mm <= run.noise_mm).map(sd).collect();
            let said = plain.iter().sum::<f64>() / plain.len() as f64;
            let row = [e.sd, e.scatter, said, scatter, mean];
            println!(
                "press {press} noise {noise} {}: planned {:.4} scatter {:.4}, stated {:.4} ({} of {seeds}; all {all:.4}) scatter {:.4} \
                 bias {:+.4}",
                e.name,
                row[0],
                row[1],
                row[2],
                plain.len(),
                row[3],
                row[4]
            );
            row
        })
        .collect()
}

/// Presses, noises and sides that were looked at; run with --ignored --nocapture for the table of
/// docs/lab/2026-11-plan.md.
#[test]
#[ignore = "a table that takes minutes"]
fn table() {
    let [up, down, right] = ["z-", "z+", "x+"].map(side);
    let layer = body(|p| 1 + u8::from((9.0..15.0).contains(&p[2])));
    for (what, labels, moduli, load) in [
        ("ball", ball(), [20.0, 60.0], &down),
        ("layer", layer, [20.0, 60.0], &down),
        ("soft ball from a side", ball(), [20.0, 10.0], &right),
    ] {
        println!("{what}");
        let held = if load == &right { side("x-") } else { up.clone() };
        let params = params(&[(1, moduli[0]), (2, moduli[1])]);
        for (press, noise) in [(0.4, 0.02), (0.8, 0.05), (0.8, 0.08), (1.6, 0.2)] {
            compared(&labels, &params, [press, noise], 8, [&held, load]);
        }
    }
}

/// Where noise counts, what measurements scatter by and what they state is what was planned, within
/// a factor of 1.5.
#[test]
fn deviations_are_those_of_simulated_measurements() {
    let (labels, sides) = (ball(), [side("z-"), side("z+")]);
    // The scatter of 24 is known to 15 %.
    let found = compared(&labels, &params(&[(1, 20.0), (2, 60.0)]), [0.8, 0.08], 24, [&sides[0], &sides[1]]);
    for [sd, scatter, stated, scattered, bias] in found {
        let near = |a: f64, b: f64| (1.0 / 1.5..1.5).contains(&(a / b));
        assert!(near(stated, sd), "stated {stated} for {sd}");
        assert!(near(scattered, scatter), "scatter {scattered} for {scatter}");
        assert!(bias.abs() < 2.0 * sd, "{bias} with {sd}");
    }
}

/// One solution serves all presses; more press and less noise tell more, and so do more voxels.
#[test]
fn what_is_known_grows_with_press_and_falls_with_noise() {
    let (labels, sides) = (ball(), [side("z-"), side("z+")]);
    let mut asked = params(&[(1, 20.0), (2, 60.0)]);
    asked.stiffness.nodes = 1500;
    (asked.press_mm, asked.noise_mm, asked.voxel_mm) = (vec![0.1, 0.4], vec![0.01, 0.04], vec![0.5, 1.0]);
    let plan = planned(&labels, &asked, [&sides[0], &sides[1]]);
    assert_eq!(plan.expected.len(), 2 * 2 * 2 * 2);
    let sd = |press: f64, voxel: f64, noise: f64, label: u8| {
        let same = |e: &&palpate::types::plan::Expected| [e.press_mm, e.voxel_mm, e.noise_mm] == [press, voxel, noise];
        plan.of(label).find(same).map(|e| e.sd).unwrap()
    };
    for label in [1, 2] {
        assert!(sd(0.4, 1.0, 0.04, label) < sd(0.1, 1.0, 0.04, label));
        assert!(sd(0.1, 1.0, 0.01, label) < sd(0.1, 1.0, 0.04, label));
        assert!(sd(0.1, 0.5, 0.04, label) < sd(0.1, 1.0, 0.04, label));
    }
    asked.press_mm = vec![0.1];
    let alone = planned(&labels, &asked, [&sides[0], &sides[1]]);
    let [one, other] = [&alone, &plan].map(|p| p.of(2).find(|e| e.press_mm == 0.1).unwrap().sd);
    assert!((one / other - 1.0).abs() < 0.03, "{one} {other}");
    // The force that a plate needs is linear in the press.
    let force = |p: &Plan| p.presses[0].force_n;
    assert!((force(&alone) / force(&plan) - 1.0).abs() < 1e-3);
}

/// A press that the measurement would refuse is none.
#[test]
fn a_press_within_the_noise_is_said_to_be_lost() {
    let (labels, sides) = (ball(), [side("z-"), side("z+")]);
    let mut asked = params(&[(1, 20.0), (2, 60.0)]);
    (asked.stiffness.nodes, asked.press_mm, asked.noise_mm) = (1500, vec![0.4], vec![0.1]);
    let plan = planned(&labels, &asked, [&sides[0], &sides[1]]);
    assert!(!plan.is_felt() && plan.expected.iter().all(|e| !e.determined));
    let said = sentences(&plan);
    assert!(
        said.len() == 1 && said[0].starts_with("No press here stands out of the noise: press more than 0."),
        "{said:?}"
    );
    // So it is: the same field is refused.
    let [held, load] = [&sides[0], &sides[1]];
    let inputs = PlanInputs { labels: &labels, held, load, names: &|l| format!("region {l}") };
    let truth = experimental_design::simulate(&inputs, &asked, 0.4).unwrap();
    let field = noisy(&truth.field, &labels, 0.1, 3);
    let names = |l: u8| format!("region {l}");
    let quality = FieldQuality::default();
    let inputs =
        Inputs { field: &field, matches: None, labels: &labels, labelled: true, held, load, names: &names, quality };
    let found = stiffness::run(&inputs, &asked.stiffness, &|_, _| {});
    assert!(matches!(found, Err(palpate::error::StiffnessError::NoLoad { .. })), "{found:?}");
}

/// Bone in soft tissue moves as a whole: no press tells its modulus, and the plan says so.
#[test]
fn what_no_choice_determines_is_said() {
    let (labels, sides) = (ball(), [side("z-"), side("z+")]);
    let mut asked = params(&[(1, 20.0), (2, 15_000.0)]);
    (asked.stiffness.nodes, asked.noise_mm) = (1500, vec![0.02]);
    let plan = planned(&labels, &asked, [&sides[0], &sides[1]]);
    let lost: Vec<u8> = plan.undetermined().map(|r| r.label).collect();
    assert_eq!(lost, [2], "{:?}", plan.expected);
    let said = sentences(&plan);
    assert!(said[0].starts_with("To know region 1 to 10 % press "), "{said:?}");
    assert_eq!(said[1], "Region 2 is not determined by any of these: load it from another side.");
    // The deepest of the usual presses passes what a linear law bears.
    assert!(plan.warnings.iter().any(|w| w.contains("linear")), "{:?}", plan.warnings);
}

/// A dome is met by a plate that slides, and touches more of it the deeper it goes.
#[test]
fn a_curved_side_is_pressed_flat() {
    let labels = body(|p| {
        let r2 = (p[0] - 14.0f64).powi(2) + (p[1] - 14.0f64).powi(2);
        u8::from(p[2] < 21.0 - r2 / 24.0)
    });
    let sides = [side("z-"), side("z+")];
    let mut asked = params(&[(1, 20.0)]);
    (asked.stiffness.nodes, asked.press_mm) = (1500, vec![0.8, 1.6]);
    let plan = planned(&labels, &asked, [&sides[0], &sides[1]]);
    assert_eq!(plan.contact, Contact::Sliding);
    let force: Vec<f64> = plan.presses.iter().map(|p| p.force_n).collect();
    // Of a ball on a plate the force grows as the press to the power of 1.5 (Hertz).
    assert!(force.len() == 2 && force[1] > 2.3 * force[0], "{force:?} {:?}", plan.warnings);
}

#[test]
fn the_command_writes_what_it_says_and_refuses_what_it_cannot_plan() {
    let folder = tempfile::TempDir::new().unwrap();
    let at = folder.path();
    palpate::io::write_labels(at.join("labels.nii.gz"), &ball(), "test").unwrap();
    let usual = ["plan", "--labels", "labels.nii.gz", "--nodes", "1500"];
    let with = |more: &[&str], code: i32| crate::fixtures::run(at, &[&usual[..], more].concat(), code);
    let (out, _) =
        with(&["--modulus", "1=20,2=60", "--names", "2=lump", "--want", "8", "--noise", "0.05", "-o", "p"], 0);
    for part in ["To know region 1 and lump to 8 % press ", "sticking", "mm of 20.", "report.html"] {
        assert!(out.contains(part), "{part} is missing in\n{out}");
    }
    let rows = std::fs::read_to_string(at.join("p/plan.csv")).unwrap();
    assert_eq!(rows.lines().count(), 1 + 5 * 2);
    assert!(rows.starts_with("press_mm,voxel_mm,noise_mm,label,name,expected_sd_percent,"), "{rows}");
    let summary = std::fs::read_to_string(at.join("p/summary.json")).unwrap();
    let summary: serde_json::Value = serde_json::from_str(&summary).unwrap();
    assert_eq!(summary["command"], "plan");
    assert!(summary["choice"]["press_mm"].as_f64().unwrap() > 0.0 && summary["regions"][1]["name"] == "lump");
    let page = std::fs::read_to_string(at.join("p/report.html")).unwrap();
    assert_eq!(page.matches("expected deviation, %").count(), 4, "a title and its label for each region");

    for (more, code, message) in [
        (&["--modulus", "1=20"][..], 2, "holds label 2, of which no modulus is assumed; add --modulus 2=20"),
        (&["--modulus", "1=20,2=60,3=5"], 2, "--modulus: labels.nii.gz holds no label 3"),
        (&["--modulus", "1=20,2"], 2, "not of the form 2=100"),
        (&["--modulus", "1=20,2=-5"], 2, "modulus is -5, but must be above 0 kPa"),
        (&["--modulus", "1=20,2=60", "--press", "0"], 2, "press is 0, but must be above 0 mm"),
        (&["--modulus", "1=20,2=60", "--press", "15"], 1, "press is 15, but must be half of the body's extent"),
        (&["--modulus", "1=20,2=60", "--voxel", "9"], 1, "voxel is 9, but must be small enough"),
        (&["--modulus", "1=20,2=60", "--want", "0"], 2, "want is 0, but must be 0.1 to 100 per cent"),
        (&["--modulus", "1=20,2=60", "--poisson", "0.5"], 2, "poisson is 0.5"),
        (&["--modulus", "1=20,2=60", "--contact", "glued"], 2, "neither sticking nor sliding"),
        (&["--modulus", "1=20,2=60", "--load", "z-"], 1, "is the held one"),
        (&["--modulus", "1=20,2=60", "--load", "up"], 1, "--load up: is neither a side"),
    ] {
        let (_, err) = with(&[more, &["-o", "q"]].concat(), code);
        assert!(err.contains(message), "{more:?}: {err}");
        assert!(!at.join("q/plan.csv").exists());
    }
}
