//! `palpate grasp` and `palpate grasp-analysis` as a user meets them: files, exit codes, and what
//! they say to bad scenes.

use crate::fixtures::run;
use std::fs;
use std::path::Path;
use tempfile::TempDir;

const SCENE: &str = include_str!("../../examples/eight_motions.toml");

/// A folder with the reference scene, its text changed by `change`.
fn folder(change: impl Fn(&str) -> String) -> TempDir {
    let folder = TempDir::new().unwrap();
    fs::write(folder.path().join("scene.toml"), change(SCENE)).unwrap();
    folder
}

fn json(folder: &Path, name: &str) -> serde_json::Value {
    serde_json::from_str(&fs::read_to_string(folder.join(name)).unwrap()).unwrap()
}

/// Runs `palpate grasp` on a scene that must be refused with a message that holds all of `parts`,
/// and leave nothing.
fn refused(change: impl Fn(&str) -> String, parts: &[&str]) {
    let folder = folder(&change);
    let (out, err) = run(folder.path(), &["grasp", "scene.toml", "-o", "results"], 1);
    assert!(out.is_empty() && err.starts_with("error: "), "{out}{err}");
    for part in parts.iter().chain(&["scene.toml"]) {
        assert!(err.contains(part), "should say {part:?}: {err}");
    }
    assert!(!folder.path().join("results").exists());
}

#[test]
fn the_reference_scene_writes_what_is_promised() {
    let folder = folder(str::to_string);
    let (out, err) = run(folder.path(), &["grasp", "scene.toml", "-o", "results"], 0);
    assert!(out.starts_with("8 of 8 motions in 12.5 s; the grasp held throughout."), "{out}");
    assert!(out.contains("results/report.html") && err.is_empty(), "{out}{err}");
    let results = folder.path().join("results");
    let trajectory = fs::read_to_string(results.join("trajectory.csv")).unwrap();
    let mut lines = trajectory.lines();
    assert_eq!(
        lines.next().unwrap(),
        "time,x,y,theta,theta1,theta2,dn1,dn2,dt1,dt2,fn1,fn2,ft1,ft2,required_friction,friction_margin,slip1,slip2"
    );
    assert_eq!(lines.clone().count(), 1251);
    assert!(lines.all(|l| l.split(',').all(|v| v.parse::<f64>().unwrap().is_finite())));
    let motions = fs::read_to_string(results.join("motions.csv")).unwrap();
    assert!(motions.starts_with("step,theta1_deg,theta2_deg,x,y,theta_deg,dn1,dn2,dt1,dt2,fn1,fn2,ft1,ft2,required_friction,friction_margin\n0,0,0,"));
    assert_eq!(motions.lines().count(), 10);
    assert!(motions.lines().nth(3).unwrap().starts_with("2,20,-10,"), "{motions}");
    let summary = json(&results, "summary.json");
    assert_eq!((&summary["completed"], &summary["outcome"]), (&true.into(), &"held".into()));
    assert_eq!(summary["events"], serde_json::json!([]));
    assert_eq!(summary["constraint_drift"]["normal"], 0.0);
    assert!(summary["energy_drift"].as_f64().unwrap() < 1e-6);
    assert!(summary["seconds"]["simulate"].as_f64().unwrap() > 0.0);
    let page = fs::read_to_string(results.join("report.html")).unwrap();
    for part in ["requestAnimationFrame", "without tangential deformation", "Postures reached", "data-frames"] {
        assert!(page.contains(part), "{part}");
    }
    for outside in ["http://", "https://", "<script src", "<link", "@import", "NaN"] {
        assert!(!page.contains(outside), "{outside}");
    }
    for tag in ["article", "section", "div", "table", "svg", "p", "ul", "li", "b", "span", "g"] {
        let opened = page.matches(&format!("<{tag}>")).count() + page.matches(&format!("<{tag} ")).count();
        assert_eq!(opened, page.matches(&format!("</{tag}>")).count(), "<{tag}>");
    }
    assert_eq!(fs::read_dir(&results).unwrap().count(), 4);
}

#[test]
fn flags_replace_what_the_scene_says() {
    let folder = folder(str::to_string);
    let flags = ["--model", "parallel-normal", "--formulation", "multipliers", "--step", "0.0005"];
    let (_, err) = run(folder.path(), &[&["grasp", "scene.toml", "-o", "r"][..], &flags].concat(), 0);
    // Without tangential deformation motion 7 presses a tip too far.
    assert!(err.contains("validity-range of finger 2") && err.contains("--quiet silences"), "{err}");
    let summary = json(&folder.path().join("r"), "summary.json");
    assert_eq!(summary["model"], "parallel-normal");
    assert_eq!(summary["formulation"], "multipliers");
    assert_eq!(summary["step"], 0.0005);
    let event = &summary["events"][0];
    assert_eq!((&event["kind"], &event["finger"]), (&"validity-range".into(), &2.into()));
    assert!(event["time"].as_f64().unwrap() > 9.5);
    assert_eq!((&summary["completed"], &summary["outcome"]), (&true.into(), &"validity-range".into()));
    assert_eq!(summary["motions_finished"], 8);
    let page = fs::read_to_string(folder.path().join("r/report.html")).unwrap();
    assert!(page.contains("out of range") && page.contains("validity-range of finger 2"));
}

#[test]
fn wrong_usage_exits_with_2() {
    let folder = folder(str::to_string);
    let cases: [(&[&str], &str); 6] = [
        (&["grasp", "scene.toml"], "--output"),
        (&["grasp", "scene.toml", "-o", "x", "--model", "paralel"], "did you mean 'parallel'"),
        (&["grasp", "scene.toml", "-o", "x", "--formulation", "lagrange"], "multipliers"),
        (&["grasp", "scene.toml", "-o", "x", "--step", "0"], "step is 0"),
        (&["grasp", "scene.toml", "-o", "x", "--step", "nan"], "step is NaN"),
        (&["grasp-analysis", "-o", "x"], "SCENE"),
    ];
    for (arguments, message) in cases {
        let (_, err) = run(folder.path(), arguments, 2);
        assert!(err.contains(message), "{arguments:?}: {err}");
        assert!(!folder.path().join("x").exists());
    }
}

#[test]
fn bad_scenes_are_refused_with_a_hint() {
    let replaced = |from: &'static str, to: &'static str| {
        move |s: &str| {
            assert!(s.contains(from), "{from}");
            s.replacen(from, to, 1)
        }
    };
    refused(replaced("width = 0.060", "wdith = 0.060"), &["[object]", "'wdith'", "did you mean 'width'"]);
    refused(replaced("[integrator]", "[intergrator]"), &["'intergrator'", "did you mean 'integrator'"]);
    refused(replaced("kd = 1.0", "kq = 1.0"), &["finger.gains", "'kq'"]);
    refused(replaced("theta = [6.0, 6.0]", "tehta = [6.0, 6.0]"), &["[[motion]]", "did you mean 'theta'"]);
    refused(replaced("mass = 0.10", "mass = -0.10"), &["object.mass is -0.1", "above 0 kg"]);
    refused(replaced("mass = 0.10", "mass = nan"), &["object.mass is NaN"]);
    refused(replaced("mass = 0.10", "mass = \"heavy\""), &["mass"]);
    refused(replaced("mass = 0.10", ""), &["mass"]);
    refused(replaced("link = 0.060", "link = "), &["line 10"]);
    refused(replaced("model = \"parallel\"", "model = \"paralel\""), &["did you mean 'parallel'"]);
    refused(replaced("half_span = 0.0485", "half_span = 0.0480"), &["do not go together", "leave one of the two out"]);
    refused(replaced("[20.0, -10.0]", "[120.0, -10.0]"), &["motion.theta is 120", "degrees"]);
    refused(replaced("[20.0, -10.0]", "[20.0]"), &["theta"]);
    refused(replaced("step = 1.0e-3", "step = 1.0e-9"), &["more than 2e9 steps"]);
    refused(replaced("output_every = 0.01", "output_every = 0.0001"), &["output_every", "at least integrator.step"]);
    refused(|s| s.replace("[[motion]]", "[[motions]]"), &["'motions'", "did you mean 'motion'"]);
    refused(|s| s.replacen("[object]", "[finger]", 1), &["line 15", "duplicate"]);
    refused(|s| s.replacen("[object]", "[[object]]", 1), &["object is not a table"]);
    refused(|s| format!("{s}\n[[sweep]]\nkey = \"object.mas\"\nvalues = [1]\n"), &["did you mean 'mass'"]);
    refused(|s| format!("{s}\n[[sweep]]\nkey = \"thing.mass\"\nvalues = [1]\n"), &["no table 'thing'"]);
    refused(|s| format!("{s}\n[[sweep]]\nkey = \"motion.9.hold\"\nvalues = [1]\n"), &["'9'"]);
    refused(|s| format!("{s}\n[[sweep]]\nkey = \"object.mass\"\nvalues = []\n"), &["no values"]);
    refused(
        |s| format!("{s}\n[[sweep]]\nkey = \"fingertip.file\"\nvalues = [\"a\"]\n"),
        &["fingertip.file", "is read once"],
    );
    refused(|s| format!("{s}\n[[sweep]]\nkey = \"object.mass\"\nvalues = [0.1, -1]\n"), &["object.mass is -1"]);
    // A key of the wrong table, and no file at all.
    let folder = folder(str::to_string);
    let (_, err) = run(folder.path(), &["grasp", "absent.toml", "-o", "results"], 1);
    assert!(err.contains("absent.toml: cannot read"), "{err}");
}

#[test]
fn what_cannot_be_simulated_exits_with_1_and_says_what_to_try() {
    refused(|s| s.replace("step = 1.0e-3", "step = 5.0e-3"), &["at time 0", "integrator.step at or under"]);
    let gain = "step = 1.0e-3\nformulation = \"multipliers\"\nbaumgarte = 4000.0";
    refused(|s| s.replace("step = 1.0e-3", gain), &["at time 0", "integrator.baumgarte at or under 2"]);
    // Too soft to carry its object at the pinch.
    refused(|s| s.replace("mass = 0.10", "mass = 10.0"), &["at time 0", "not stable", "press more"]);
}

#[test]
fn the_fold_of_a_narrow_object_is_named() {
    let narrow = |s: &str| s.replace("width = 0.060", "width = 0.050").replace("half_span = 0.0485\n", "");
    let folder = folder(narrow);
    let (out, err) = run(folder.path(), &["grasp", "scene.toml", "-o", "r"], 0);
    assert!(out.contains("fold: the branch of equilibria ends at"), "{out}");
    assert!(err.contains("warning: scene.toml:") && err.contains("fold"), "{err}");
    let summary = json(&folder.path().join("r"), "summary.json");
    assert_eq!(summary["events"][0]["kind"], "fold");
    assert_eq!(summary["events"][0]["finger"], serde_json::Value::Null);
    let (_, err) = run(folder.path(), &["grasp", "scene.toml", "-o", "q", "--quiet"], 0);
    assert!(err.is_empty(), "{err}");
    // The analysis finds the same motion out of reach.
    let (out, _) = run(folder.path(), &["grasp-analysis", "scene.toml", "-o", "a", "--quiet"], 0);
    assert!(out.contains("motion 7     cannot be reached: at joint angles"), "{out}");
}

#[test]
fn a_fingertip_from_its_own_file() {
    let folder = TempDir::new().unwrap();
    let start = SCENE.find("[fingertip]").unwrap();
    let end = SCENE.find("[finger]").unwrap();
    let scene = format!("{}[fingertip]\nfile = \"tip.toml\"\n\n{}", &SCENE[..start], &SCENE[end..]);
    fs::create_dir(folder.path().join("scenes")).unwrap();
    fs::write(folder.path().join("scenes/scene.toml"), &scene).unwrap();
    let tip = "radius = 0.020\nyoungs_modulus = 2.0e5\ndamping = [20.0, 20.0]\n[source]\nfrom = \"elsewhere\"\n";
    fs::write(folder.path().join("scenes/tip.toml"), tip).unwrap();
    run(folder.path(), &["grasp", "scenes/scene.toml", "-o", "one"], 0);
    fs::write(folder.path().join("scenes/tip.toml"), format!("[fingertip]\n{tip}")).unwrap();
    run(folder.path(), &["grasp", "scenes/scene.toml", "-o", "two"], 0);
    fs::write(folder.path().join("whole.toml"), SCENE).unwrap();
    run(folder.path(), &["grasp", "whole.toml", "-o", "three"], 0);
    let motions = |r: &str| fs::read(folder.path().join(r).join("motions.csv")).unwrap();
    assert_eq!(motions("one"), motions("three"));
    assert_eq!(motions("two"), motions("three"));
    fs::write(folder.path().join("scenes/tip.toml"), "radios = 0.020\n").unwrap();
    let (_, err) = run(folder.path(), &["grasp", "scenes/scene.toml", "-o", "four"], 1);
    assert!(err.contains("tip.toml") && err.contains("did you mean 'radius'"), "{err}");
    fs::remove_file(folder.path().join("scenes/tip.toml")).unwrap();
    let (_, err) = run(folder.path(), &["grasp", "scenes/scene.toml", "-o", "four"], 1);
    assert!(err.contains("tip.toml: cannot read"), "{err}");
}

#[test]
fn an_ensemble_runs_every_combination_and_is_the_same_for_any_number_of_threads() {
    let sweep = "\n[[sweep]]\nkey = \"object.mass\"\nvalues = [0.05, 0.2]\n\n[[sweep]]\nkey = \"fingertip.model\"\n\
                 values = [\"parallel\", \"radial\"]\n\n[[sweep]]\nkey = \"motion.1.theta\"\nvalues = [[20, -10], [10, -5], [0, 0]]\n";
    let folder = folder(|s| format!("{s}{sweep}"));
    let (out, _) = run(folder.path(), &["grasp", "scene.toml", "-o", "one", "--threads", "1", "--quiet"], 0);
    assert!(out.contains("12 scenes, 12 ran to their end"), "{out}");
    run(folder.path(), &["grasp", "scene.toml", "-o", "two", "--threads", "2", "--quiet"], 0);
    for name in ["trajectory.csv", "motions.csv", "sweep.csv"] {
        let read = |r: &str| fs::read_to_string(folder.path().join(r).join(name)).unwrap();
        assert_eq!(read("one"), read("two"), "{name}");
    }
    let table = fs::read_to_string(folder.path().join("one/sweep.csv")).unwrap();
    let mut lines = table.lines();
    let header = "case,object.mass,fingertip.model,motion.1.theta,outcome,time,step,theta1_deg";
    assert!(lines.next().unwrap().starts_with(header), "{table}");
    // The last table's values go fastest; parallel tips finish, radial ones leave their range at
    // motion 7.
    let first = lines.next().unwrap();
    assert!(first.starts_with("1,0.05,\"\"\"parallel\"\"\",\"[20, -10]\",completed,12.5,0,0,0,"), "{first}");
    assert!(table.lines().any(|l| l.starts_with("12,0.2,\"\"\"radial\"\"\",\"[0, 0]\",validity-range,9.")), "{table}");
    let summary = json(&folder.path().join("one"), "summary.json");
    assert_eq!(summary["sweep"].as_array().unwrap().len(), 12);
}

#[test]
fn the_analysis_writes_what_is_promised() {
    let folder = folder(str::to_string);
    let (out, err) = run(folder.path(), &["grasp-analysis", "scene.toml", "-o", "r"], 0);
    assert!(out.starts_with("The parallel model has a minimum of energy at 9 of 9 postures"), "{out}");
    assert!(err.is_empty(), "{err}");
    let results = folder.path().join("r");
    let rows = |name: &str| fs::read_to_string(results.join(name)).unwrap();
    assert_eq!(rows("pinch_map.csv").lines().count(), 61 * 61 + 1);
    assert_eq!(rows("stability.csv").lines().count(), 6 * 9 + 1);
    assert_eq!(rows("energy.csv").lines().count(), 9 * 4 * 41 * 41 + 1);
    assert!(rows("posture_force.csv").starts_with("d,tilt_deg,parallel_n,radial_n\n0,-40,0,0\n"));
    assert!(rows("push.csv").starts_with("time,x,y,theta,"));
    let summary = json(&results, "summary.json");
    assert_eq!(summary["freedom"][0]["controls"], "grasp and posture");
    assert!(summary["pinch_map"]["good"].as_f64().unwrap() > 0.2);
    assert!(summary["push"]["turn_deg"].as_f64().unwrap() > 1.0);
    let page = rows("report.html");
    for outside in ["http://", "https://", "<script src", "<link", "@import", "NaN"] {
        assert!(!page.contains(outside), "{outside}");
    }
    assert_eq!(fs::read_dir(&results).unwrap().count(), 7);
    // A folder with results is not written into again.
    let (_, err) = run(folder.path(), &["grasp-analysis", "scene.toml", "-o", "r"], 1);
    assert!(err.contains("--overwrite"), "{err}");
    let (_, err) = run(folder.path(), &["grasp-analysis", "scene.toml", "-o", "."], 1);
    assert!(err.contains("not empty"), "{err}");
}

#[test]
fn fingers_that_differ_are_read_and_drawn() {
    let folder = TempDir::new().unwrap();
    let scene = include_str!("../../examples/thumb_and_index.toml");
    fs::write(folder.path().join("scene.toml"), scene).unwrap();
    let (out, err) = run(folder.path(), &["grasp", "scene.toml", "-o", "r"], 0);
    assert!(out.contains("held throughout") && err.is_empty(), "{out}{err}");
    let summary = json(&folder.path().join("r"), "summary.json");
    assert_eq!(summary["scene"]["fingertip"]["radius"], 0.013);
    assert_eq!(summary["scene"]["second"]["fingertip"]["radius"], 0.009);
    let page = fs::read_to_string(folder.path().join("r/report.html")).unwrap();
    assert!(page.contains("13 mm and 9 mm") && page.contains("data-bases=\"[[-26.200,-10.000],[22.200,0.000]]\""));
    run(folder.path(), &["grasp-analysis", "scene.toml", "-o", "a"], 0);
    // The same in pairs, as far as they go.
    let pairs = SCENE.replacen("radius = 0.020", "radius = [0.020, 0.022]", 1).replace("half_span = 0.0485\n", "");
    fs::write(folder.path().join("pairs.toml"), pairs).unwrap();
    run(folder.path(), &["grasp", "pairs.toml", "-o", "p"], 0);
    assert_eq!(json(&folder.path().join("p"), "summary.json")["scene"]["second"]["fingertip"]["radius"], 0.022);
    // Two joints are for the analysis.
    let two = scene.replacen("link = 0.045", "links = [0.025, 0.020]", 1);
    fs::write(folder.path().join("two.toml"), two).unwrap();
    let (_, err) = run(folder.path(), &["grasp", "two.toml", "-o", "t"], 1);
    assert!(err.contains("fingers of two joints are not simulated"), "{err}");
    run(folder.path(), &["grasp-analysis", "two.toml", "-o", "t"], 0);
    let rows = json(&folder.path().join("t"), "summary.json")["freedom"].as_array().unwrap().clone();
    assert!(rows.iter().any(|r| r["joints"] == serde_json::json!([2, 1])), "{rows:?}");
    let refused = |text: String, part: &str| {
        fs::write(folder.path().join("bad.toml"), text).unwrap();
        let (_, err) = run(folder.path(), &["grasp", "bad.toml", "-o", "b"], 1);
        assert!(err.contains("bad.toml") && err.contains(part), "{err}");
    };
    refused(scene.replacen("inertia = 2.0e-4\n", "", 1), "one [[finger]] has inertia, the other has not");
    refused(scene.replacen("link = 0.045", "lnik = 0.045", 1), "did you mean 'link'");
    refused(format!("{scene}\n[[finger]]\nlink = 0.05\n"), "3 [[finger]] tables");
    refused(SCENE.replacen("radius = 0.020", "radius = [0.020, 0.022, 0.024]", 1), "[left, right]");
    refused(SCENE.replacen("youngs_modulus = 2.0e5", "youngs_modulus = 200", 1), "is it in kPa?");
    refused(SCENE.replacen("radius = 0.020", "radius = 20", 1), "is it in mm?");
    refused(
        SCENE.replacen("model = \"parallel\"", "stiffening = 0.002", 1),
        "fingertip.stiffening is of tabulated tips",
    );
}

#[test]
fn what_is_known_of_the_modulus_is_drawn_as_bands() {
    let folder = folder(|s| s.replacen("model = ", "youngs_modulus_sd = 2.0e4\nmodel = ", 1));
    let (out, _) = run(folder.path(), &["grasp", "scene.toml", "-o", "r"], 0);
    assert!(out.contains("moduli       -10 to +11 %: at the end the object stands at"), "{out}");
    let bands = fs::read_to_string(folder.path().join("r/bands.csv")).unwrap();
    assert!(bands.starts_with("time,x_low,x_high,y_low,y_high,theta_low,theta_high,"), "{bands:.100}");
    assert_eq!(bands.lines().count(), 1252);
    let page = fs::read_to_string(folder.path().join("r/report.html")).unwrap();
    assert!(page.contains("class=\"band c0\"") && page.contains("Shaded: moduli of the tips"));
}

/// The headline said "held", the page "slipped" and the sweep "completed" of one run.
#[test]
fn headline_page_and_summary_of_a_run_agree() {
    for (friction, outcome, words) in [
        ("0.5", "slip", "the grasp slipped: tips slid"),
        ("0.2", "contact-loss", "then the run ended"),
        ("5.0", "held", "held throughout"),
    ] {
        let folder = folder(|s| s.replace("friction = 1.0", &format!("friction = {friction}")));
        let (out, _) = run(folder.path(), &["grasp", "scene.toml", "-o", "r", "--quiet"], 0);
        assert!(out.lines().next().unwrap().contains(words), "{out}");
        let summary = json(&folder.path().join("r"), "summary.json");
        assert_eq!(summary["outcome"], outcome);
        assert_eq!(summary["completed"], outcome != "contact-loss");
        let page = fs::read_to_string(folder.path().join("r/report.html")).unwrap();
        let chip = match outcome {
            "slip" => "<b>slipped</b>",
            "held" => "<b>held</b>",
            _ => "<b>ended early</b>",
        };
        assert!(page.contains(chip) && page.contains(words), "{outcome}");
    }
}

#[test]
fn measurements_are_weighed_between_the_models() {
    let folder = folder(str::to_string);
    fs::write(folder.path().join("m.csv"), include_str!("../../examples/synthetic_presses.csv")).unwrap();
    let (out, _) = run(folder.path(), &["grasp-analysis", "scene.toml", "--measured", "m.csv", "-o", "r"], 0);
    assert!(out.contains("the measurements are for parallel over"), "{out}");
    let summary = json(&folder.path().join("r"), "summary.json");
    let best = &summary["measured"]["models"][0];
    assert_eq!(best["model"], "parallel");
    assert!((best["youngs_modulus"]["value"].as_f64().unwrap() - 2e5).abs() < 1e4);
    let table = fs::read_to_string(folder.path().join("r/measured.csv")).unwrap();
    assert!(table.starts_with("d,tilt_deg,force,force_parallel,"), "{table:.100}");
    assert_eq!(table.lines().count(), 85);
    let page = fs::read_to_string(folder.path().join("r/report.html")).unwrap();
    assert!(page.contains("<h2>Measured</h2>") && !page.contains("NaN"));
    fs::write(folder.path().join("m.csv"), "d,force\n1,2\n").unwrap();
    let (_, err) = run(folder.path(), &["grasp-analysis", "scene.toml", "--measured", "m.csv", "-o", "q"], 1);
    assert!(err.contains("m.csv") && err.contains("no column \"tilt_deg\""), "{err}");
}

#[test]
fn a_scene_that_would_be_overwritten() {
    let folder = folder(str::to_string);
    fs::rename(folder.path().join("scene.toml"), folder.path().join("report.html")).unwrap();
    let (_, err) = run(folder.path(), &["grasp", "report.html", "-o", ".", "--force"], 2);
    assert!(err.contains("would be overwritten"), "{err}");
}

/// All rows said `completed` while their runs slipped; and a swept key that a flag replaced gave
/// rows named after what they were not.
#[test]
fn a_sweep_says_what_slipped_and_does_not_fight_with_flags() {
    let folder = folder(|s| format!("{s}\n[[sweep]]\nkey = \"object.friction\"\nvalues = [0.1, 5.0]\n"));
    let (out, _) = run(folder.path(), &["grasp", "scene.toml", "-o", "one"], 0);
    assert!(out.contains("2 scenes, 1 ran to their end, 0 of them with slip; 1 held throughout"), "{out}");
    let table = fs::read_to_string(folder.path().join("one/sweep.csv")).unwrap();
    let outcome = |case: &str| {
        let mut rows = table.lines().filter(|l| l.starts_with(case));
        rows.next().unwrap().split(',').nth(2).unwrap().to_string()
    };
    assert_eq!([outcome("1,"), outcome("2,")], ["contact-loss", "completed"]);
    assert!(table.lines().next().unwrap().ends_with(",friction_margin,largest_required_friction"), "{table}");
    let models = "\n[[sweep]]\nkey = \"fingertip.model\"\nvalues = [\"parallel\", \"radial\"]\n";
    fs::write(folder.path().join("scene.toml"), format!("{SCENE}{models}")).unwrap();
    let (_, err) = run(folder.path(), &["grasp", "scene.toml", "-o", "two", "--model", "radial"], 1);
    assert!(err.contains("[[sweep]] changes fingertip.model"), "{err}");
}
