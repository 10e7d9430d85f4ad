//! A folder of palpate stands for its file wherever one is asked for; scores without exact truth.

use crate::fixtures::{run, small_pair};
use serde_json::Value;
use std::fs;
use std::path::Path;
use std::sync::LazyLock;
use tempfile::TempDir;

/// A folder with `pair` (a phantom), `field`, `tracked` and `odd` (a folder of something else).
fn made() -> &'static Path {
    static MADE: LazyLock<TempDir> = LazyLock::new(|| {
        let (folder, pair) = (TempDir::new().unwrap(), small_pair());
        fs::create_dir(folder.path().join("pair")).unwrap();
        for entry in fs::read_dir(pair.path()).unwrap() {
            let entry = entry.unwrap();
            fs::copy(entry.path(), folder.path().join("pair").join(entry.file_name())).unwrap();
        }
        fs::create_dir(folder.path().join("odd")).unwrap();
        for name in ["notes.txt", "table.csv"] {
            fs::write(folder.path().join("odd").join(name), "a,b\n").unwrap();
        }
        let field = ["field", "pair", "pair", "--mask", "pair", "--truth", "pair", "--preset", "fast", "-o", "field"];
        run(folder.path(), &field, 0);
        let volumes = ["pair/initial.nii.gz", "pair/deformed.nii.gz"];
        let track = ["track", volumes[0], volumes[1], "--mask", "pair", "--preset", "fast", "-o", "tracked"];
        run(folder.path(), &track, 0);
        folder
    });
    MADE.path()
}

fn json(folder: &Path, arguments: &[&str]) -> Value {
    serde_json::from_str(&run(folder, arguments, 0).0).unwrap()
}

#[test]
fn a_folder_stands_for_its_file_in_every_command() {
    let folder = made();
    let summary: Value = serde_json::from_slice(&fs::read(folder.join("field/summary.json")).unwrap()).unwrap();
    assert_eq!(summary["inputs"]["mask"], "mask.nii.gz");
    assert_eq!(summary["inputs"]["initial"], "initial.nii.gz");
    assert!(summary["metrics"]["mean_mm"].as_f64().unwrap() < 0.5, "{}", summary["metrics"]);
    // Both ways of naming a file do the same.
    let score = |parts: [&str; 4]| {
        let [field, truth, mask, back] = parts;
        json(folder, &["evaluate", field, "--truth", truth, "--mask", mask, "--backward", back, "--json"])
    };
    let files = ["field/displacement.nii.gz", "pair/truth.nii.gz", "pair/mask.nii.gz", "pair/truth.nii.gz"];
    assert_eq!(score(["field", "pair", "pair", "pair"]), score(files));
    let warp = |field: &str, output: &str| {
        run(folder, &["warp", "pair/deformed.nii.gz", "--field", field, "-o", output], 0);
        run(folder, &["invert", field, "-o", &format!("inverse_{output}")], 0);
        ["", "inverse_"].map(|p| fs::read(folder.join(format!("{p}{output}"))).unwrap())
    };
    assert!(warp("field", "a.nii.gz") == warp("field/displacement.nii.gz", "b.nii.gz"));
    // Of a results folder, bodies are labels and a mask; of a phantom, the mask is.
    let field = ["field", "pair", "pair", "-o", "none", "--dry-run"];
    run(folder, &[&field[..], &["--bodies", "field", "--mask", "field"]].concat(), 0);
    let track = ["track", "pair/initial.nii.gz", "pair/deformed.nii.gz", "-o", "none", "--dry-run"];
    run(folder, &[&track[..], &["--mask", "pair", "--labels", "field"]].concat(), 0);
    let stiffness = ["stiffness", "--field", "field", "--held", "y-", "--load", "y+", "-o", "none", "--dry-run"];
    for body in [["--mask", "pair"], ["--labels", "field"]] {
        run(folder, &[&stiffness[..], &body, &["--matches", "field"]].concat(), 0);
    }
    run(folder, &["strain", "field", "--mask", "pair", "--labels", "field", "-o", "strain"], 0);
    run(folder, &["strain", "pair", "--mask", "pair", "-o", "strain_of_truth"], 0);
    assert!(!folder.join("none").exists());
}

#[test]
fn a_folder_without_such_a_file_is_named_with_what_it_has() {
    let folder = made();
    let pair = ["pair/initial.nii.gz", "pair/deformed.nii.gz"];
    let cases: [(&[&str], &str); 16] = [
        (&["field", pair[0], pair[1], "-o", "x", "--mask", "odd"], "mask"),
        (&["field", pair[0], pair[1], "-o", "x", "--bodies", "odd"], "label map"),
        (&["field", pair[0], pair[1], "-o", "x", "--truth", "odd"], "exact displacement"),
        (&["track", pair[0], pair[1], "-o", "x", "--mask", "odd"], "mask"),
        (&["track", pair[0], pair[1], "-o", "x", "--labels", "odd"], "label map"),
        (&["strain", "odd", "-o", "x"], "displacement field"),
        (&["strain", "field", "-o", "x", "--labels", "odd"], "label map"),
        (&["certify", pair[0], "-o", "x", "--mask", "odd"], "mask"),
        (&["certify", pair[0], "-o", "x", "--like", "odd"], "displacement field"),
        (&["stiffness", "--field", "odd", "--labels", "field", "-o", "x"], "displacement field"),
        (&["stiffness", "--field", "field", "--labels", "odd", "-o", "x"], "label map"),
        (&["stiffness", "--field", "field", "--labels", "field", "--held", "odd", "-o", "x"], "mask"),
        (&["warp", pair[1], "--field", "odd", "-o", "x.nii.gz"], "displacement field"),
        (&["invert", "odd", "-o", "x.nii.gz"], "displacement field"),
        (&["evaluate", "odd", "--truth", "pair"], "displacement field"),
        (&["evaluate", "field", "--truth", "odd"], "exact displacement"),
    ];
    for (arguments, what) in cases {
        let output = crate::fixtures::palpate(folder).args(arguments).output().unwrap();
        let err = crate::fixtures::text(&output.stderr);
        assert!(matches!(output.status.code(), Some(1 | 2)), "{arguments:?}: {err}");
        for part in ["odd", what, "notes.txt, table.csv", "name the file"] {
            assert!(err.contains(part), "{arguments:?} should say {part:?}: {err}");
        }
        assert!(!folder.join("x").exists() && !folder.join("x.nii.gz").exists(), "{arguments:?}");
    }
    let (_, err) = run(folder, &["warp", pair[1], "--field", "tracked", "-o", "x.nii.gz"], 1);
    assert!(err.contains("tracked") && err.contains("displacement_001.nii.gz"), "{err}");
    let (_, err) = run(folder, &["evaluate", "field", "--truth", "pair", "--field-convention", "ras"], 2);
    assert!(err.contains("--field-convention"), "{err}");
    // What lies in a folder that is read is not overwritten.
    let (_, err) = run(folder, &["invert", "field", "-o", "field/displacement.nii.gz"], 2);
    assert!(err.contains("would be overwritten"), "{err}");
}

#[test]
fn landmarks_alone_score_a_field() {
    let folder = made();
    let found = json(folder, &["evaluate", "field", "--landmarks", "pair", "--json"]);
    let marks = palpate::io::read_landmarks(folder.join("pair/landmarks.csv")).unwrap();
    let field = palpate::io::read_field(folder.join("field/displacement.nii.gz")).unwrap();
    let errors = palpate::evaluate::landmarks(&field, &marks);
    let mean = errors.iter().sum::<f64>() / errors.len() as f64;
    let told = &found["landmarks"];
    assert_eq!(told["count"], marks.len());
    assert_eq!(found["landmarks_mm"], told["mean_mm"]);
    assert!((told["mean_mm"].as_f64().unwrap() - mean).abs() < 1e-9);
    assert!(told["before"]["mean_mm"].as_f64().unwrap() > 2.0 * mean, "{}", told["before"]);
    for (each, (error, mark)) in told["each"].as_array().unwrap().iter().zip(errors.iter().zip(&marks)) {
        assert!((each["error_mm"].as_f64().unwrap() - error).abs() < 1e-9);
        assert_eq!(each["initial"], serde_json::json!(mark.initial.0));
    }
    let (out, _) = run(folder, &["evaluate", "field", "--landmarks", "pair"], 0);
    assert!(out.starts_with("Target registration error: mean ") && out.contains("before"), "{out}");
    // Beside the truth nothing that was told before is lost.
    let both = json(folder, &["evaluate", "field", "--truth", "pair", "--landmarks", "pair", "--json"]);
    assert_eq!(both["landmarks_mm"], found["landmarks_mm"]);
    assert!(both["voxels"].is_u64() && both["grad_err"].is_f64());
    let (_, err) = run(folder, &["evaluate", "field", "--landmarks", "pair", "--mask", "pair"], 0);
    assert!(err.contains("--mask changes nothing"), "{err}");
}

#[test]
fn label_maps_alone_score_a_field() {
    let folder = made();
    // Two boxes, moved by two voxels along the first axis as the field says.
    let grid = *palpate::io::read_mask(folder.join("pair/mask.nii.gz")).unwrap().grid();
    let boxes = |shift: usize| {
        palpate::types::Mask::from_voxels(grid, |at, _| {
            let [i, j, k] = grid.voxel(at);
            match i.wrapping_sub(shift) {
                6..16 if (8..20).contains(&j) && (8..20).contains(&k) => 1,
                16..24 if (8..20).contains(&j) && (8..20).contains(&k) => 2,
                _ => 0,
            }
        })
    };
    let step = grid.affine().vector_to_world([2.0, 0.0, 0.0]);
    let field = palpate::types::DenseField::from_fn(grid, |_| step);
    palpate::io::write_field(folder.join("shift.nii.gz"), &field).unwrap();
    palpate::io::write_labels(folder.join("before.nii.gz"), &boxes(0), "boxes").unwrap();
    let mut moved = boxes(2);
    // A label of its own.
    moved.as_mut_slice()[0] = 9;
    palpate::io::write_labels(folder.join("after.nii.gz"), &moved, "boxes").unwrap();
    let arguments = ["evaluate", "shift.nii.gz", "--labels", "before.nii.gz", "after.nii.gz"];
    let found = json(folder, &[&arguments[..], &["--json"]].concat());
    let labels = &found["labels"];
    assert_eq!(labels["only_deformed"], serde_json::json!([9]));
    assert_eq!((&labels["dice_mean"], &labels["dice_mean_before"]), (&1.0.into(), &0.775.into()));
    for (each, dice) in labels["each"].as_array().unwrap().iter().zip([0.8, 0.75]) {
        let number = |when: &str, key: &str| each[when][key].as_f64().unwrap();
        assert_eq!((number("after", "dice"), number("before", "dice")), (1.0, dice));
        assert_eq!((number("after", "surface_mean_mm"), number("after", "hausdorff95_mm")), (0.0, 0.0));
        let length = step.iter().map(|v| v * v).sum::<f64>().sqrt();
        assert!((number("before", "hausdorff95_mm") - length).abs() < 1e-5, "{each}");
    }
    let (out, _) = run(folder, &arguments, 0);
    for part in ["Labels: mean Dice 1.000", "label 1", "Hausdorff", "not compared 9: in the deformed map alone"] {
        assert!(out.contains(part), "{part} is missing in\n{out}");
    }
    let (_, err) = run(folder, &["evaluate", "field", "--labels", "before.nii.gz"], 2);
    assert!(err.contains("--labels"), "{err}");
    let (_, err) = run(folder, &["evaluate", "field"], 2);
    assert!(err.contains("--truth"), "{err}");
    // The same option under two names.
    let inverse = |flag: &str| json(folder, &["evaluate", "field", flag, "pair", "--json"]);
    assert_eq!(inverse("--inverse"), inverse("--backward"));
}
