//! Small versions of `palpate chart` and `palpate stress` on synthetic data, held against stored
//! figures: worse than those by more than the seed-to-seed spread fails.

use crate::fixtures::{palpate, text};
use palpate::pipeline::robustness::{Effort, GraspAxis, field_curves, field_run, grasp_curves};
use palpate::pipeline::speed_accuracy::{Case, Variant, posture_error};
use palpate::synth::{PhantomKind, PhantomParams, Trouble};
use palpate::types::{Part, StressRun};
use rayon::prelude::*;
use std::fs;
use tempfile::TempDir;

/// The small bodies: which, voxels across.
const BODIES: [(PhantomKind, usize); 2] = [(PhantomKind::Block, 40), (PhantomKind::Head, 40)];
const SEEDS: u64 = 3;

fn runs(kind: PhantomKind, size: usize, trouble: Trouble, severity: f64) -> Vec<StressRun> {
    let run = |seed| {
        let body = PhantomParams { seed, ..PhantomParams::new(kind).sized(size) };
        field_run(&body, trouble, severity).unwrap()
    };
    (1..=SEEDS).into_par_iter().map(run).collect()
}

/// Mean and standard deviation.
fn spread(values: &[f64]) -> [f64; 2] {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let square = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (values.len() - 1) as f64;
    [mean, square.sqrt()]
}

/// Trouble, severity, then for each body the mean error (mm) and its spread over the seeds, as
/// measured.
const STORED: [(Trouble, f64, [[f64; 2]; 2]); 7] = [
    (Trouble::Noise, 3.0, [[0.432, 0.078], [1.715, 0.211]]),
    (Trouble::Noise, 10.0, [[0.538, 0.085], [2.050, 0.180]]),
    (Trouble::Motion, 6.0, [[0.806, 0.103], [1.337, 0.204]]),
    (Trouble::Rotation, 15.0, [[0.037, 0.044], [0.848, 0.481]]),
    (Trouble::Bias, 40.0, [[0.560, 0.090], [2.243, 0.433]]),
    (Trouble::NoTexture, 30.0, [[0.584, 0.075], [2.093, 0.107]]),
    (Trouble::MissingTissue, 15.0, [[0.806, 0.247], [3.040, 0.885]]),
];

#[test]
fn errors_in_trouble_are_no_worse_than_stored() {
    let (mut worse, mut measured) = (Vec::new(), String::new());
    for (trouble, severity, stored) in STORED {
        let now = BODIES.map(|(kind, size)| {
            let errors: Vec<f64> = runs(kind, size, trouble, severity).iter().map(|r| r.error).collect();
            spread(&errors)
        });
        measured += &format!("    (Trouble::{trouble:?}, {severity:?}, {now:.3?}),\n");
        for ((body, now), stored) in BODIES.iter().zip(now).zip(stored) {
            // A refusal has no error: NaN.
            if now[0].is_nan() || now[0] > stored[0] + stored[1] {
                worse.push(format!("{trouble:?} {severity} {:?}: {now:.3?}, stored {stored:.3?}", body.0));
            }
        }
    }
    assert!(worse.is_empty(), "{worse:#?}\nmeasured:\n{measured}");
}

#[test]
fn what_cannot_be_measured_is_not_passed_over_in_silence() {
    let hopeless = [
        (Trouble::NoOverlap, 110.0),
        (Trouble::ContrastInversion, 100.0),
        (Trouble::Motion, 20.0),
        (Trouble::Crop, 90.0),
        (Trouble::NoTexture, 95.0),
    ];
    for (trouble, severity) in hopeless {
        for (kind, size) in BODIES {
            let runs = runs(kind, size, trouble, severity);
            let silent: Vec<_> = runs.iter().filter(|r| r.silent()).collect();
            assert!(silent.is_empty(), "{trouble:?} {severity} {kind:?}: {silent:#?}");
        }
    }
}

#[test]
fn the_stated_band_holds_most_errors_where_there_is_texture() {
    let mut inside = Vec::new();
    for (trouble, severity) in [(Trouble::Noise, 3.0), (Trouble::Bias, 30.0), (Trouble::Sliding, 1.0)] {
        for (kind, size) in BODIES {
            inside.extend(runs(kind, size, trouble, severity).iter().filter_map(|r| r.inside));
        }
    }
    let mean = inside.iter().sum::<f64>() / inside.len() as f64;
    assert!(mean >= 0.9 && inside.len() == 18, "{mean}: {inside:.2?}");
}

#[test]
fn grasps_break_where_they_should_and_say_so() {
    let curves = grasp_curves(&Effort::new(true), &GraspAxis::ALL.map(|a| a.1), &|_| {});
    assert_eq!(curves.iter().flat_map(|c| c.silent()).count(), 0);
    let of = |axis: &str, case: &str| {
        let curve = curves.iter().find(|c| c.axis == axis && c.case.starts_with(case)).unwrap();
        (curve.holds_at.unwrap(), curve.breaks_at.unwrap())
    };
    // Runge and Kutta's method is stable to 2.785 over the largest eigenvalue, the semi-implicit
    // one to about 2 over it.
    let (rk4, euler) = (of("step", "rk4, minimal"), of("step", "semi-implicit-euler, minimal"));
    assert!(rk4.0 > euler.0 && rk4.0 > 1.5e-3 && rk4.1 < 5e-3, "{rk4:?} {euler:?}");
    let friction = of("friction", "rk4");
    assert!(friction.0 > friction.1 && friction.1 > 0.3, "{friction:?}");
}

#[test]
fn dearer_steps_are_no_worse_and_a_still_field_does_nothing() {
    let params = PhantomParams::new(PhantomKind::Calf).sized(56);
    let case = Case::embedded(&params).unwrap();
    let [sparse, fast, balanced]: [_; 3] =
        Variant::steps().iter().map(|v| case.run(v)).collect::<Vec<_>>().try_into().unwrap();
    assert!(balanced.error < 0.6 * balanced.nothing.unwrap(), "{balanced:?}");
    assert!(balanced.error <= 1.1 * fast.error && fast.error <= 1.1 * sparse.error, "{sparse:?} {fast:?} {balanced:?}");
    // Other tests run in this process, so that its CPU time cannot be compared here.
    assert!(sparse.cpu_s > 0.0 && fast.cpu_s > 0.0 && balanced.cpu_s > 0.0);
    let still = palpate::types::DenseField::zeros(*case.initial.grid());
    let nothing = case.score(&Variant::steps()[0], &still, 1.0).unwrap();
    assert!((nothing.error - nothing.nothing.unwrap()).abs() < 1e-9 && nothing.part == Part::Field);
    // Without a true field, landmarks are the truth.
    let real = Case { truth: None, ..case };
    let by_landmarks = real.score(&Variant::steps()[0], &still, 1.0).unwrap();
    assert!((by_landmarks.error - by_landmarks.nothing.unwrap()).abs() < 1e-9 && by_landmarks.error > 0.0);
}

#[test]
fn a_run_that_ends_early_has_no_posture_error() {
    use palpate::{grasp::simulate::simulate, types::Scene};
    let run = simulate(&Scene::reference(), &|_| {}).unwrap();
    let mut short = run.clone();
    short.samples.pop();
    assert_eq!(posture_error(&run, &run), 0.0);
    assert!(posture_error(&short, &run).is_nan());
}

#[test]
fn the_commands_write_their_files_and_results_do_not_depend_on_threads() {
    let folder = TempDir::new().unwrap();
    let stress = |threads: &str, out: &str| {
        let arguments = ["stress", "--quick", "--part", "field", "--axis", "no-overlap", "--axis", "noise"];
        let done = palpate(folder.path()).args(arguments).args(["--threads", threads, "-o", out]).assert().success();
        assert!(text(&done.get_output().stdout).contains("no overlap"));
        fs::read_to_string(folder.path().join(out).join("stress.csv")).unwrap()
    };
    let table = stress("1", "one");
    assert_eq!(table, stress("2", "two"));
    assert!(table.lines().count() >= 9 && table.contains(",1,1,,"), "{table}");
    for file in ["stress.svg", "stress.html", "summary.json"] {
        assert!(folder.path().join("one").join(file).is_file(), "{file}");
    }
    let chart = ["chart", "--quick", "--part", "grasp", "-o", "chart"];
    let done = palpate(folder.path()).args(chart).assert().success();
    assert!(text(&done.get_output().stdout).contains("what no other setting beats"));
    let page = fs::read_to_string(folder.path().join("chart/chart.html")).unwrap();
    let table = fs::read_to_string(folder.path().join("chart/chart.csv")).unwrap();
    assert_eq!(table.lines().count(), 29);
    assert!(page.contains("method rk4, formulation minimal, step") && page.contains("on the front"));
    // A case folder without truth and landmarks cannot be scored.
    palpate(folder.path()).args(["phantom", "block", "--size", "24", "-o", "case"]).assert().success();
    fs::remove_file(folder.path().join("case/truth.nii.gz")).unwrap();
    let real = ["chart", "--quick", "--case", "case", "-o", "real"];
    palpate(folder.path()).args(real).assert().success();
    let table = fs::read_to_string(folder.path().join("real/chart.csv")).unwrap();
    assert!(table.lines().skip(1).all(|l| l.starts_with("field,")), "{table}");
    fs::remove_file(folder.path().join("case/landmarks.csv")).unwrap();
    let failed = palpate(folder.path()).args(["chart", "--case", "case", "-o", "none"]).assert().code(1);
    assert!(text(&failed.get_output().stderr).contains("neither truth.nii.gz nor landmarks.csv"));
    assert!(!folder.path().join("none").exists());
}

#[test]
fn curves_come_in_order_and_bracket_the_break() {
    let effort = Effort::new(true);
    let curves = field_curves(&effort, &[Trouble::NoOverlap], &|_| {});
    let curve = &curves[0];
    assert!(curve.runs.windows(2).all(|w| w[0].severity <= w[1].severity));
    let (low, high) = (curve.holds_at.unwrap(), curve.breaks_at.unwrap());
    assert!(low < high && high <= 100.0, "{low} {high}");
    assert!(curve.runs.iter().filter(|r| r.severity <= low).all(|r| !r.broken()));
}

/// A folder with the small cases `case`, `still` and `lost`.
fn cases() -> TempDir {
    let folder = TempDir::new().unwrap();
    for (name, more) in [("case", &[][..]), ("still", &["--motion", "none"]), ("lost", &[])] {
        let made = ["phantom", "block", "--size", "24", "-o", name];
        palpate(folder.path()).args(made).args(more).assert().success();
    }
    folder
}

#[test]
fn what_a_chart_cannot_score_is_refused_before_any_work() {
    let folder = cases();
    let refused = |arguments: &[&str], code: i32, word: &str| {
        let run = palpate(folder.path()).arg("chart").args(arguments).args(["-o", "out"]).assert().code(code);
        let said = text(&run.get_output().stderr);
        assert!(said.contains(word), "{said}");
        assert!(!folder.path().join("out").exists());
    };
    refused(&["--case", "case", "--case", "none"], 1, "none does not exist");
    refused(&["--case", "case", "--case", "./case"], 2, "given twice");
    refused(&["--case", "case", "--part", "grasp"], 2, "--case holds volumes");
    let at = |file: &str| folder.path().join("lost").join(file);
    // Every landmark in LPS, far away.
    fs::write(at("landmarks.csv"), "fx,fy,fz,mx,my,mz\n-900,0,0,-900,0,1\n-901,0,0,-901,0,1\n").unwrap();
    fs::remove_file(at("truth.nii.gz")).unwrap();
    refused(&["--case", "lost"], 1, "2 of 2 landmarks lie outside the initial volume");
    fs::write(at("landmarks.csv"), "fx,fy,fz,mx,my,mz\n0,0,0,0,0,1\n-901,0,0,-901,0,1\n").unwrap();
    let run = palpate(folder.path()).args(["chart", "--quick", "--case", "lost", "-o", "some"]).assert().success();
    assert!(text(&run.get_output().stderr).contains("1 of 2 landmarks lie outside"));
}

#[test]
fn a_case_without_motion_is_charted_in_millimetres_and_missing_tools_do_not_end_a_chart() {
    let folder = cases();
    let arguments = ["chart", "--quick", "--peers", "--case", "case", "--case", "still", "-o", "out"];
    let run = palpate(folder.path()).env("PYTHON", "no-such-python").args(arguments).assert().success();
    let (said, shown) = (text(&run.get_output().stderr), text(&run.get_output().stdout));
    assert!(said.contains("no other tool is run: cannot run no-such-python"), "{said}");
    assert!(shown.contains(" mm\n") && !shown.contains("% of the motion"), "{shown}");
    let summary = fs::read_to_string(folder.path().join("out/summary.json")).unwrap();
    assert!(summary.contains("\"unit\": \"mm\""), "{summary}");
}

#[test]
fn axes_of_every_part_are_picked_by_name() {
    let folder = TempDir::new().unwrap();
    let stress =
        |more: &[&str]| palpate(folder.path()).arg("stress").args(["--quick", "-o", "out"]).args(more).assert();
    let run = stress(&["--axis", "step", "--axis", "step", "--axis", "tip-stiffness"]).success();
    let shown = text(&run.get_output().stdout);
    // Four forms of the step, one of the stiffness; nothing of the other parts.
    assert_eq!(shown.lines().filter(|l| l.contains("  grasp  ")).count(), 5, "{shown}");
    assert!(!shown.contains("  field ") && !shown.contains("  stiffness  ") && !shown.contains("0.001 s"), "{shown}");
    let refused = stress(&["--force", "--part", "field", "--axis", "mass"]).code(2);
    assert!(text(&refused.get_output().stderr).contains("--axis mass is one of grasp, which --part leaves out"));
    let unknown = stress(&["--force", "--axis", "nois"]).code(2);
    assert!(text(&unknown.get_output().stderr).contains("noise"));
}
