//! info, --dry-run, --config, completions and the manual.

use crate::fixtures::{run, small_pair};
use std::fs;
use std::path::Path;

fn json(folder: &Path, arguments: &[&str]) -> serde_json::Value {
    serde_json::from_str(&run(folder, arguments, 0).0).unwrap()
}

#[test]
fn every_help_ends_with_examples() {
    let folder = small_pair();
    for command in ["field", "warp", "track", "stiffness", "grasp", "info"] {
        let (out, _) = run(folder.path(), &[command, "--help"], 0);
        assert!(out.contains("Examples:\n  # ") && out.contains(&format!("\n  palpate {command} ")), "{out}");
    }
}

#[test]
fn a_mistyped_flag_or_command_is_answered_with_the_nearest() {
    let folder = small_pair();
    let (_, err) = run(folder.path(), &["field", "a", "b", "-o", "x", "--serch", "9"], 2);
    assert!(err.contains("--search"), "{err}");
    let (_, err) = run(folder.path(), &["stifness"], 2);
    assert!(err.contains("stiffness"), "{err}");
}

#[test]
fn completions_know_the_commands_and_their_flags() {
    let folder = small_pair();
    for shell in ["bash", "zsh", "fish", "powershell", "elvish"] {
        let (out, _) = run(folder.path(), &["completions", shell], 0);
        assert!(out.contains("grasp-analysis") && out.contains("field-convention"), "{shell}");
    }
    run(folder.path(), &["completions", "tcsh"], 2);
}

#[test]
fn the_manual_has_a_page_a_command() {
    let folder = small_pair();
    let (out, _) = run(folder.path(), &["man"], 0);
    assert!(out.contains(".TH PALPATE 1") && out.contains("palpate\\-field"), "{out}");
    run(folder.path(), &["man", "-o", "man"], 0);
    let page = fs::read_to_string(folder.path().join("man/palpate-stiffness.1")).unwrap();
    assert!(page.contains("\\-\\-poisson") && page.contains("palpate stiffness \\-\\-field"), "{page}");
}

#[test]
fn info_knows_what_each_file_is() {
    let folder = small_pair();
    let all = ["initial.nii.gz", "mask.nii.gz", "truth.nii.gz", "landmarks.csv"];
    let found = json(folder.path(), &[&["info", "--json"][..], &all].concat());
    let kinds: Vec<&str> = (0..4).map(|i| found[i]["kind"].as_str().unwrap()).collect();
    assert_eq!(kinds, ["volume", "label map or mask", "displacement field", "landmarks"]);
    assert_eq!(found[0]["shape"], serde_json::json!([32, 32, 32]));
    assert_eq!(found[0]["orientation"], "RAS");
    assert_eq!(found[0]["datatype"], "int16");
    let mask = palpate::io::read_mask(folder.path().join("mask.nii.gz")).unwrap();
    let inside = mask.as_slice().iter().filter(|v| **v > 0).count();
    assert_eq!(found[1]["label_1"], inside);
    let truth = palpate::io::read_field(folder.path().join("truth.nii.gz")).unwrap();
    let length = |o: usize| truth.at(o).iter().map(|v| f64::from(v * v)).sum::<f64>().sqrt();
    let most = (0..truth.grid().len()).map(length).fold(0.0, f64::max);
    assert!((found[2]["length"]["largest_mm"].as_f64().unwrap() - most).abs() < 1e-3);
    let (out, _) = run(folder.path(), &["info", "mask.nii.gz"], 0);
    assert!(out.contains("--mask mask.nii.gz") && out.contains("RAS (sform)"), "{out}");

    fs::write(folder.path().join("fast.toml"), "preset = \"fast\"\n").unwrap();
    let (out, _) = run(folder.path(), &["info", "fast.toml"], 0);
    assert!(out.contains("parameters of a field run") && out.contains("--config fast.toml"), "{out}");
    let scenes = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples");
    for (scene, kind) in [("eight_motions.toml", "grasp scene"), ("skin.toml", "skin scene")] {
        let (out, _) = run(folder.path(), &["info", scenes.join(scene).to_str().unwrap()], 0);
        assert!(out.contains(kind), "{out}");
    }
    fs::write(folder.path().join("odd.toml"), "colour = 3\n").unwrap();
    let (_, err) = run(folder.path(), &["info", "odd.toml"], 1);
    // What can be read is told beside it.
    let (out, again) = run(folder.path(), &["info", "odd.toml", "mask.nii.gz"], 1);
    assert!(out.starts_with("mask.nii.gz") && again == err, "{out}{again}");
    assert!(err.contains("odd.toml") && err.contains("unknown key 'colour'"), "{err}");
}

#[test]
fn a_dry_run_checks_and_writes_nothing() {
    let folder = small_pair();
    let before = fs::read_dir(folder.path()).unwrap().count();
    let field = ["field", "initial.nii.gz", "deformed.nii.gz", "-o", "results", "--dry-run"];
    let (out, _) = run(folder.path(), &[&field[..], &["--search", "7"]].concat(), 0);
    for part in ["32 x 32 x 32 voxels", "balanced, seed 1", "7 mm", "about 15 MB", "mesh.vtu", "Nothing was written."] {
        assert!(out.contains(part), "{part} is missing in\n{out}");
    }
    let track = ["track", "initial.nii.gz", "deformed.nii.gz", "-o", "results", "--dry-run", "--preset", "fast"];
    let (out, _) = run(folder.path(), &track, 0);
    assert!(out.contains("1 volumes against number 0") && out.contains("displacement_001.nii.gz"), "{out}");
    let stiffness = ["stiffness", "--field", "truth.nii.gz", "--mask", "mask.nii.gz", "-o", "results", "--dry-run"];
    // The pair's motion is no press; between these sides it looks like one.
    let (out, _) =
        run(folder.path(), &[&stiffness[..], &["--total-force", "2", "--held", "y-", "--load", "y+"]].concat(), 0);
    assert!(out.contains("2 N: moduli in kPa") && out.contains("  memory       about "), "{out}");
    let mesh = out.lines().find_map(|l| l.trim().strip_prefix("mesh")?.strip_suffix(" nodes"));
    let nodes: f64 = mesh.unwrap().trim().replace(',', "").parse().unwrap();
    assert!((nodes / 20_000.0 - 1.0).abs() < 0.3, "{out}");
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), before);

    // It fails where the run would.
    fs::create_dir(folder.path().join("full")).unwrap();
    fs::write(folder.path().join("full/mine.txt"), "mine").unwrap();
    let (_, err) = run(folder.path(), &["field", "initial.nii.gz", "deformed.nii.gz", "-o", "full", "--dry-run"], 1);
    assert!(err.contains("not empty"), "{err}");
    fs::write(folder.path().join("far.nii"), {
        let mut far = crate::fixtures::Nifti::ramp([20, 20, 20]);
        far.sform[0][3] = 5000.0;
        far.bytes()
    })
    .unwrap();
    let (_, err) = run(folder.path(), &["field", "initial.nii.gz", "far.nii", "-o", "results", "--dry-run"], 1);
    assert!(err.contains("overlap"), "{err}");
}

#[test]
fn the_plan_says_what_the_run_does() {
    let folder = small_pair();
    let files = ["field", "initial.nii.gz", "deformed.nii.gz", "--mask", "mask.nii.gz", "-o", "results"];
    let (plan, _) = run(folder.path(), &[&files[..], &["--dry-run"]].concat(), 0);
    run(folder.path(), &[&files[..], &["--quiet"]].concat(), 0);
    let summary = fs::read_to_string(folder.path().join("results/summary.json")).unwrap();
    let summary: serde_json::Value = serde_json::from_str(&summary).unwrap();
    let evidence = summary["evidence"].to_string();
    let points = plan.lines().find(|l| l.contains("points")).unwrap().split_whitespace().nth(1).unwrap();
    assert!(evidence.contains(&format!("of {} wanted", points.replace(',', ""))), "{plan}{evidence}");
    let levels = plan.lines().find(|l| l.contains("levels")).unwrap().matches(" x ").count() / 2;
    assert_eq!(levels.min(2), summary["levels"].as_array().unwrap().len().min(2), "{plan}");
    assert!(plan.contains(&summary["mask_voxels"].as_u64().map(|n| format!("{},{:03}", n / 1000, n % 1000)).unwrap()));
}

#[test]
fn a_run_is_repeated_from_its_own_summary() {
    let folder = small_pair();
    let files = ["field", "initial.nii.gz", "deformed.nii.gz", "--mask", "mask.nii.gz", "--quiet"];
    let asked = ["--preset", "fast", "--points", "150", "--search", "6", "--seed", "5", "-o", "one"];
    run(folder.path(), &[&files[..], &asked].concat(), 0);
    run(folder.path(), &[&files[..], &["--config", "one/summary.json", "-o", "two"]].concat(), 0);
    run(folder.path(), &[&files[..], &["-o", "other"]].concat(), 0);
    let read = |run: &str, name: &str| fs::read(folder.path().join(run).join(name)).unwrap();
    for name in ["displacement.nii.gz", "matches.csv", "uncertainty.nii.gz"] {
        assert!(read("one", name) == read("two", name), "{name} differs");
        assert!(read("one", name) != read("other", name), "{name} does not depend on the parameters");
    }
    let params =
        |run: &str| serde_json::from_slice::<serde_json::Value>(&read(run, "summary.json")).unwrap()["params"].clone();
    assert_eq!(params("one"), params("two"));

    // The same as TOML; a flag goes before the file.
    let toml: String = params("one").as_object().unwrap().iter().map(|(k, v)| format!("{k} = {v}\n")).collect();
    fs::write(folder.path().join("run.toml"), toml).unwrap();
    run(folder.path(), &[&files[..], &["--config", "run.toml", "--seed", "6", "-o", "three"]].concat(), 0);
    let mut expected = params("one");
    expected["seed"] = 6.into();
    assert_eq!(params("three"), expected);
}

#[test]
fn the_keys_of_the_parameters_are_all_known() {
    let all = serde_json::to_value(palpate::types::FieldParams::default()).unwrap();
    let keys: Vec<&String> = all.as_object().unwrap().keys().collect();
    assert_eq!(keys, palpate::types::FieldParams::KEYS.iter().collect::<Vec<_>>());
}

#[test]
fn configurations_with_flaws() {
    let folder = small_pair();
    let cases = [
        ("c.toml", "search = 3\n", "did you mean 'search_mm'"),
        ("c.toml", "serch_mm = 3\n", "did you mean 'search_mm'"),
        ("c.toml", "preset = \"quick\"\n", "balanced"),
        ("c.toml", "points = \"many\"\n", "points is \"many\""),
        ("c.toml", "points = 5\n", "points is 5"),
        ("c.toml", "points = \n", "line 1"),
        ("c.json", "{\"params\": {\"passes\": 1000}}", "passes"),
        ("c.json", "{\"pases\": 3}", "did you mean 'passes'"),
        ("c.json", "{", "JSON"),
        ("c.json", "{\"version\": \"1\", \"command\": \"grasp\"}", "palpate grasp"),
    ];
    for (name, content, message) in cases {
        fs::write(folder.path().join(name), content).unwrap();
        let arguments = ["field", "initial.nii.gz", "deformed.nii.gz", "-o", "x", "--config", name];
        let (_, err) = run(folder.path(), &arguments, 1);
        assert!(err.contains(name) && err.contains(message), "{content:?}: {err}");
    }
    let both = ["field", "initial.nii.gz", "deformed.nii.gz", "-o", "x", "--config", "c.toml", "--preset", "fast"];
    run(folder.path(), &both, 2);
}
