//! What a run was asked for and has read is kept, and the run is made again from it.

use crate::fixtures::{palpate, run, small_pair};
use serde_json::Value;
use std::fs;
use std::path::Path;
use tempfile::TempDir;

fn json(path: impl AsRef<Path>) -> Value {
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

/// A folder with `data`, a phantom, in it.
fn data() -> TempDir {
    let (folder, pair) = (TempDir::new().unwrap(), small_pair());
    fs::create_dir(folder.path().join("data")).unwrap();
    for entry in fs::read_dir(pair.path()).unwrap() {
        let entry = entry.unwrap();
        fs::copy(entry.path(), folder.path().join("data").join(entry.file_name())).unwrap();
    }
    folder
}

/// What differs between two runs of the same: times, dates, and where results went.
fn without_times(mut summary: Value) -> Value {
    for key in ["seconds", "date", "command_line"] {
        summary.as_object_mut().unwrap().remove(key);
    }
    for frame in summary["frames"].as_array_mut().into_iter().flatten() {
        frame.as_object_mut().unwrap().remove("seconds");
    }
    summary
}

/// All files of two folders are the same, byte for byte; summaries but for times; pages are left
/// out.
fn same_results(one: &Path, two: &Path) {
    let names = |folder: &Path| {
        let mut names: Vec<String> =
            fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    };
    assert_eq!(names(one), names(two));
    for name in names(one) {
        match name.as_str() {
            "report.html" => {}
            "summary.json" | "certificate.json" => {
                assert_eq!(without_times(json(one.join(&name))), without_times(json(two.join(&name))), "{name}");
            }
            _ => assert!(fs::read(one.join(&name)).unwrap() == fs::read(two.join(&name)).unwrap(), "{name} differs"),
        }
    }
}

const FIELD: [&str; 10] = [
    "field",
    "data/initial.nii.gz",
    "data/deformed.nii.gz",
    "--mask=data/mask.nii.gz",
    "--preset",
    "fast",
    "--seed",
    "5",
    "-o",
    "one",
];

#[test]
fn a_field_is_repeated_from_its_summary_alone_from_any_folder() {
    let folder = data();
    run(folder.path(), &FIELD, 0);
    let (one, again) = (folder.path().join("one"), TempDir::new().unwrap());
    let config = one.join("summary.json");
    let repeat = ["field", "--config", config.to_str().unwrap(), "-o", "two", "--threads", "1"];
    let (out, err) = run(again.path(), &repeat, 0);
    assert!(out.contains("results") && !err.contains("warning: one"), "{out}{err}");
    same_results(&one, &again.path().join("two"));

    // The record says what was asked for and read.
    let summary = json(&config);
    assert_eq!(summary["command_line"], serde_json::json!(FIELD));
    let date = summary["date"].as_str().unwrap();
    assert!(date.len() == 20 && date.starts_with("20") && date.ends_with('Z') && &date[10..11] == "T", "{date}");
    let files = summary["files"].as_array().unwrap();
    let roles: Vec<&str> = files.iter().map(|f| f["role"].as_str().unwrap()).collect();
    assert_eq!(roles, ["initial", "deformed", "mask"]);
    for file in files {
        let path = Path::new(file["path"].as_str().unwrap());
        assert!(path.is_absolute());
        let (bytes, sha256) = palpate::io::digest(path).unwrap();
        assert_eq!((file["bytes"].as_u64().unwrap(), file["sha256"].as_str().unwrap()), (bytes, sha256.as_str()));
    }
    let page = fs::read_to_string(one.join("report.html")).unwrap();
    for part in ["--mask=data/mask.nii.gz", date, files[2]["path"].as_str().unwrap()] {
        assert!(page.contains(part), "{part} is not in the report");
    }
    let digits = &files[0]["sha256"].as_str().unwrap();
    assert!(page.contains(&digits[..12]) && !page.contains(&digits[..13]));

    // What was repeated can be repeated; a folder that is full is not written over unasked.
    let config = again.path().join("two/summary.json");
    let twice = ["field", "--config", config.to_str().unwrap(), "-o"];
    run(folder.path(), &[&twice[..], &["three"]].concat(), 0);
    same_results(&one, &folder.path().join("three"));
    let (_, err) = run(folder.path(), &[&twice[..], &["three"]].concat(), 1);
    assert!(err.contains("not empty"), "{err}");
    run(folder.path(), &[&twice[..], &["three", "--force"]].concat(), 0);
    let (out, _) = run(folder.path(), &[&twice[..], &["four", "--dry-run"]].concat(), 0);
    assert!(out.contains("fast, seed 5") && !folder.path().join("four").exists(), "{out}");
}

#[test]
fn a_changed_or_missing_input_is_named_and_nothing_is_run() {
    let folder = data();
    run(folder.path(), &FIELD, 0);
    let at = |name: &str| folder.path().join("data").join(name);
    let repeat = ["field", "--config", "one/summary.json", "-o", "two"];
    let mut mask = palpate::io::read_labels(at("mask.nii.gz")).unwrap();
    mask.as_mut_slice()[0] = 1 - mask.as_slice()[0];
    palpate::io::write_labels(at("mask.nii.gz"), &mask, "palpate phantom: tissue").unwrap();
    fs::rename(at("deformed.nii.gz"), at("moved.nii.gz")).unwrap();
    let (_, err) = run(folder.path(), &repeat, 1);
    assert!(err.contains("mask.nii.gz (mask) has changed"), "{err}");
    assert!(err.contains("deformed.nii.gz (deformed) is missing"), "{err}");
    run(folder.path(), &["field", "--config", "one/summary.json", "-o", "two", "--dry-run"], 1);
    assert!(!err.contains("initial.nii.gz") && !folder.path().join("two").exists(), "{err}");
}

#[test]
fn other_commands_are_repeated_in_the_same_way() {
    let folder = data();
    run(folder.path(), &FIELD, 0);
    run(folder.path(), &["phantom", "fingertip", "--size", "28", "--seed", "2", "--amplitude", "1.5", "-o", "pad"], 0);
    let commands: [&[&str]; 3] = [
        // --force has a value here.
        &["stiffness", "--field", "pad", "--labels", "pad", "--nodes", "1500", "--force", "1.5"],
        &["strain", "one", "--labels", "one", "--gauge", "9"],
        &["track", "data/initial.nii.gz", "data/deformed.nii.gz", "--mask", "data", "--preset", "fast"],
    ];
    for arguments in commands {
        let name = arguments[0];
        run(folder.path(), &[arguments, &["-o", name]].concat(), 0);
        let (config, other) = (format!("{name}/summary.json"), format!("{name}_again"));
        run(folder.path(), &[name, "--config", &config, "-o", &other], 0);
        same_results(&folder.path().join(name), &folder.path().join(&other));
    }
    let summary = json(folder.path().join("strain/summary.json"));
    let files = summary["files"].as_array().unwrap();
    let read = |name: &str| files.iter().any(|f| f["path"].as_str().unwrap().ends_with(name));
    assert!(
        ["one/displacement.nii.gz", "one/posterior.nii.gz", "one/bodies.nii.gz"].into_iter().all(read),
        "{files:?}"
    );
    let (_, err) = run(folder.path(), &["track", "--config", "strain/summary.json", "-o", "x"], 2);
    assert!(err.contains("palpate strain"), "{err}");
}

#[test]
fn a_summary_that_does_not_say_how_is_refused_in_words() {
    let folder = data();
    fs::write(folder.path().join("old.json"), r#"{"version": "0.1.0", "command": "field", "params": {}}"#).unwrap();
    let (_, err) = run(folder.path(), &["field", "--config", "old.json", "-o", "x"], 1);
    assert!(err.contains("old.json: does not tell the command line"), "{err}");
    let (_, err) = run(folder.path(), &["strain", "--config", "gone.json", "-o", "x"], 1);
    assert!(err.contains("gone.json: cannot read"), "{err}");
    // Parameters alone are no run.
    fs::write(folder.path().join("fast.toml"), "preset = \"fast\"\n").unwrap();
    let (_, err) = run(folder.path(), &["field", "--config", "fast.toml", "-o", "x"], 2);
    assert!(err.contains("<INITIAL>"), "{err}");
    let (_, err) = run(folder.path(), &["field", "--config", "old.json", "--seed", "3", "-o", "x"], 2);
    assert!(err.contains("<INITIAL>"), "{err}");
}

#[test]
fn a_mask_is_not_dropped_in_silence() {
    let folder = data();
    run(folder.path(), &FIELD, 0);
    let pair = ["field", "data", "data", "--config", "one/summary.json", "--dry-run", "-o", "two"];
    let (_, err) = run(folder.path(), &pair, 0);
    assert!(err.contains("its run had the mask") && err.contains("mask.nii.gz"), "{err}");
    let (_, err) = run(folder.path(), &[&pair[..], &["--mask", "data"]].concat(), 0);
    assert!(!err.contains("its run had the mask"), "{err}");
}

#[test]
fn the_summaries_of_all_commands_say_what_was_run() {
    let folder = data();
    let scenes = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples");
    let skin = scenes.join("skin.toml").to_str().unwrap().to_string();
    run(folder.path(), &["skin", &skin, "-o", "skin"], 0);
    let summary = json(folder.path().join("skin/summary.json"));
    assert_eq!(summary["files"][0]["role"], "scene");
    run(folder.path(), &["skin", "--config", "skin/summary.json", "-o", "again"], 0);
    same_results(&folder.path().join("skin"), &folder.path().join("again"));
    fs::write(folder.path().join("table.csv"), "initial,deformed\ndata/initial.nii.gz,data/deformed.nii.gz\n").unwrap();
    palpate(folder.path()).args(["batch", "table.csv", "-o", "batch", "--preset", "fast"]).assert().success();
    let summary = json(folder.path().join("batch/summary.json"));
    assert_eq!((&summary["files"][0]["role"], &summary["command_line"][0]), (&"table".into(), &"batch".into()));
    let stage = json(folder.path().join("batch/pair-2/field/summary.json"));
    assert_eq!(stage["files"].as_array().unwrap().len(), 2);
}
