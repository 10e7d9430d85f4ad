//! The program as a user meets it: exit codes, help, outputs, and what it says to bad input.

use crate::fixtures::{Nifti, run, small_pair, text};
use assert_cmd::Command;
use serde_json::Value;
use std::fs;
use tempfile::TempDir;

#[test]
fn help_names_every_subcommand_and_exits_with_0() {
    let folder = TempDir::new().unwrap();
    let (out, _) = run(folder.path(), &["--help"], 0);
    let commands = ["field", "warp", "invert", "grasp", "grasp-analysis", "phantom", "evaluate", "demo"];
    for command in commands {
        assert!(out.contains(&format!("\n  {command}")), "{command} is missing in\n{out}");
        let (own, _) = run(folder.path(), &[command, "--help"], 0);
        for flag in ["--threads", "--quiet", "--verbose"] {
            assert!(own.contains(flag), "{command} --help does not name {flag}");
        }
    }
    let (version, _) = run(folder.path(), &["--version"], 0);
    assert_eq!(version.trim(), format!("palpate {}", env!("CARGO_PKG_VERSION")));
}

#[test]
fn reasons_come_while_the_run_goes_on() {
    let folder = small_pair();
    let field = ["field", "initial.nii.gz", "deformed.nii.gz", "-o", "f"];
    let (_, silent) = run(folder.path(), &field, 0);
    let (_, said) = run(folder.path(), &[&field[..], &["-v", "--overwrite"]].concat(), 0);
    let at = |line: &str| said.lines().position(|l| l.starts_with(line)).unwrap_or_else(|| panic!("{line}: {said}"));
    // A level, the evidence for the motion model, and the stages in the order in which they end.
    assert!(at("level [") < at("free: ") && at("free: ") < at("model: ") && at("model: ") < at("uncertainty: "));
    assert!(!silent.contains("level [") && !silent.contains("uncertainty: "), "{silent}");
}

#[test]
fn wrong_usage_exits_with_2_and_writes_nothing() {
    let folder = small_pair();
    let cases: [(&[&str], &str); 14] = [
        (&[], "Usage"),
        (&["fiedl"], "field"),
        (&["field", "initial.nii.gz", "deformed.nii.gz"], "--output"),
        (&["field", "initial.nii.gz", "-o", "x"], "DEFORMED"),
        (&["field", "initial.nii.gz", "deformed.nii.gz", "-o", "x", "--preset", "acurate"], "did you mean 'accurate'"),
        (&["field", "initial.nii.gz", "deformed.nii.gz", "-o", "x", "--points", "5"], "points is 5"),
        (&["field", "initial.nii.gz", "deformed.nii.gz", "-o", "x", "--search", "500"], "200 mm"),
        (&["field", "initial.nii.gz", "deformed.nii.gz", "-o", "x", "--threads", "0"], "threads"),
        (&["warp", "--field", "truth.nii.gz", "-o", "x.nii"], "IMAGE"),
        (&["warp", "initial.nii.gz", "--points", "p.csv", "--field", "truth.nii.gz", "-o", "x.csv"], "cannot be used"),
        (&["warp", "initial.nii.gz", "--field", "truth.nii.gz", "-o", "x.png"], ".nii.gz"),
        (&["invert", "truth.nii.gz", "-o", "truth.nii.gz"], "would be overwritten"),
        (&["phantom", "fingertips", "-o", "x"], "did you mean 'fingertip'"),
        (&["phantom", "block", "-o", "x", "--size", "3"], "size is 3"),
    ];
    for (arguments, message) in cases {
        let before = fs::read_dir(folder.path()).unwrap().count();
        let (_, err) = run(folder.path(), arguments, 2);
        assert!(err.contains(message), "{arguments:?} should say {message:?}:\n{err}");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), before, "{arguments:?} left something");
    }
}

/// Runs `palpate field` on a bad initial volume: it must fail, name the file and say `message`, and
/// leave nothing.
fn refused(name: &str, bytes: &[u8], message: &str) {
    let folder = small_pair();
    fs::write(folder.path().join(name), bytes).unwrap();
    let (out, err) = run(folder.path(), &["field", name, "deformed.nii.gz", "-o", "results"], 1);
    assert!(out.is_empty(), "{out}");
    assert!(err.starts_with("error: ") && err.contains(name), "{err}");
    assert!(err.to_lowercase().contains(&message.to_lowercase()), "should say {message:?}: {err}");
    assert!(!folder.path().join("results").exists());
}

#[test]
fn a_missing_file() {
    let folder = small_pair();
    let (_, err) = run(folder.path(), &["field", "initial.nii.gz", "absent.nii.gz", "-o", "results"], 1);
    assert!(err.contains("absent.nii.gz: cannot read"), "{err}");
    assert!(!folder.path().join("results").exists());
}

#[test]
fn a_folder_as_input() {
    let folder = small_pair();
    fs::create_dir(folder.path().join("volume.nii")).unwrap();
    let (_, err) = run(folder.path(), &["field", "volume.nii", "deformed.nii.gz", "-o", "results"], 1);
    assert!(err.contains("volume.nii"), "{err}");
}

#[test]
fn an_empty_file() {
    refused("bad.nii", &[], "bad.nii");
}

#[test]
fn a_truncated_file() {
    let whole = Nifti::ramp([12, 12, 12]).bytes();
    refused("bad.nii", &whole[..whole.len() - 100], "bad.nii");
}

#[test]
fn a_truncated_header() {
    refused("bad.nii", &Nifti::ramp([12, 12, 12]).bytes()[..200], "bad.nii");
}

#[test]
fn a_truncated_gzip_stream() {
    let folder = small_pair();
    let whole = fs::read(folder.path().join("initial.nii.gz")).unwrap();
    refused("bad.nii.gz", &whole[..whole.len() / 2], "bad.nii.gz");
}

#[test]
fn a_damaged_gzip_stream() {
    let folder = small_pair();
    let mut whole = fs::read(folder.path().join("initial.nii.gz")).unwrap();
    let middle = whole.len() / 2;
    whole[middle..middle + 20].fill(0x55);
    refused("bad.nii.gz", &whole, "bad.nii.gz");
}

#[test]
fn a_wrong_magic() {
    let mut bytes = Nifti::ramp([12, 12, 12]).bytes();
    bytes[344..348].copy_from_slice(b"abcd");
    refused("bad.nii", &bytes, "bad.nii");
}

#[test]
fn a_text_file_called_nii() {
    refused("bad.nii", "This is not a volume. ".repeat(40).as_bytes(), "bad.nii");
}

#[test]
fn another_ending() {
    refused("bad.mha", &Nifti::ramp([12, 12, 12]).bytes(), ".nii");
}

#[test]
fn dimensions_larger_than_the_file() {
    let mut forged = Nifti::ramp([12, 12, 12]);
    forged.dims = [30_000, 30_000, 30_000];
    refused("bad.nii", &forged.bytes(), "bad.nii");
}

#[test]
fn negative_dimensions() {
    let mut forged = Nifti::ramp([12, 12, 12]);
    forged.dims[1] = -12;
    refused("bad.nii", &forged.bytes(), "bad.nii");
}

#[test]
fn zero_dimensions() {
    let mut forged = Nifti::ramp([12, 12, 12]);
    forged.dims[2] = 0;
    refused("bad.nii", &forged.bytes(), "bad.nii");
}

#[test]
fn several_time_points() {
    let mut series = Nifti::ramp([12, 12, 12]);
    series.times = 3;
    series.values = series.values.repeat(3);
    refused("bad.nii", &series.bytes(), "bad.nii");
}

#[test]
fn rgb_voxels() {
    let mut rgb = Nifti::ramp([12, 12, 12]);
    rgb.datatype = 128;
    refused("bad.nii", &rgb.bytes(), "rgb");
}

#[test]
fn complex_voxels() {
    let mut complex = Nifti::ramp([12, 12, 12]);
    complex.datatype = 32;
    refused("bad.nii", &complex.bytes(), "complex");
}

#[test]
fn an_unknown_data_type() {
    let mut unknown = Nifti::ramp([12, 12, 12]);
    unknown.datatype = 9999;
    refused("bad.nii", &unknown.bytes(), "bad.nii");
}

#[test]
fn a_singular_affine() {
    let mut flat = Nifti::ramp([12, 12, 12]);
    flat.sform[1] = flat.sform[0];
    refused("bad.nii", &flat.bytes(), "singular");
}

#[test]
fn an_affine_that_is_not_finite() {
    let mut broken = Nifti::ramp([12, 12, 12]);
    broken.sform[0][0] = f32::NAN;
    refused("bad.nii", &broken.bytes(), "finite");
}

#[test]
fn nan_everywhere() {
    let mut nan = Nifti::ramp([12, 12, 12]);
    nan.values.fill(f32::NAN);
    refused("bad.nii", &nan.bytes(), "every voxel is NaN");
}

#[test]
fn a_constant_volume() {
    let mut constant = Nifti::ramp([12, 12, 12]);
    constant.values.fill(7.0);
    refused("bad.nii", &constant.bytes(), "same value");
}

#[test]
fn a_line_of_voxels() {
    refused("bad.nii", &Nifti::ramp([1, 1, 64]).bytes(), "");
}

#[test]
fn too_few_features() {
    let folder = small_pair();
    let ramp = Nifti::ramp([20, 20, 20]).bytes();
    fs::write(folder.path().join("plain.nii"), ramp).unwrap();
    let (_, err) = run(folder.path(), &["field", "plain.nii", "plain.nii", "-o", "results", "--quiet"], 1);
    assert!(err.starts_with("error: ") && !err.contains("under construction"), "{err}");
    assert!(!folder.path().join("results").exists());
}

#[test]
fn volumes_that_do_not_overlap() {
    let folder = small_pair();
    let mut far = Nifti::ramp([20, 20, 20]);
    far.sform[0][3] = 5000.0;
    fs::write(folder.path().join("far.nii"), far.bytes()).unwrap();
    let (_, err) = run(folder.path(), &["field", "initial.nii.gz", "far.nii", "-o", "results"], 1);
    assert!(err.contains("overlap"), "{err}");
    assert!(!folder.path().join("results").exists());
}

/// Runs `palpate field` with a mask that must be refused.
fn mask_refused(mask: &Nifti, message: &str) {
    let folder = small_pair();
    fs::write(folder.path().join("m.nii"), mask.bytes()).unwrap();
    let arguments = ["field", "initial.nii.gz", "deformed.nii.gz", "--mask", "m.nii", "-o", "results"];
    let (_, err) = run(folder.path(), &arguments, 1);
    assert!(err.contains("m.nii") && err.contains(message), "{err}");
    assert!(!folder.path().join("results").exists());
}

#[test]
fn a_mask_on_another_grid() {
    let mut mask = Nifti::filled([9, 9, 9], 1.0);
    mask.sform[0][3] = 900.0;
    mask_refused(&mask, "does not overlap initial.nii.gz");
}

#[test]
fn an_empty_mask() {
    mask_refused(
        &Nifti { sform: crate::fixtures::block_sform(), ..Nifti::filled(crate::fixtures::BLOCK, 0.0) },
        "empty",
    );
}

#[test]
fn a_mask_with_fractions() {
    mask_refused(
        &Nifti { sform: crate::fixtures::block_sform(), ..Nifti::filled(crate::fixtures::BLOCK, 0.5) },
        "whole",
    );
}

#[test]
fn an_output_that_is_a_file() {
    let folder = small_pair();
    fs::write(folder.path().join("results"), "mine").unwrap();
    let (_, err) = run(folder.path(), &["field", "initial.nii.gz", "deformed.nii.gz", "-o", "results"], 1);
    assert!(err.contains("results") && err.contains("file"), "{err}");
    assert_eq!(fs::read_to_string(folder.path().join("results")).unwrap(), "mine");
}

#[test]
fn an_output_inside_a_file() {
    let folder = small_pair();
    fs::write(folder.path().join("file"), "mine").unwrap();
    let (_, err) = run(folder.path(), &["field", "initial.nii.gz", "deformed.nii.gz", "-o", "file/results"], 1);
    assert!(err.contains("file"), "{err}");
    let (_, err) = run(folder.path(), &["invert", "truth.nii.gz", "-o", "file/inverse.nii.gz"], 1);
    assert!(err.contains("is not a folder"), "{err}");
}

#[test]
fn an_output_folder_that_is_not_empty() {
    let folder = small_pair();
    fs::create_dir(folder.path().join("results")).unwrap();
    fs::write(folder.path().join("results/mine.txt"), "mine").unwrap();
    let (_, err) = run(folder.path(), &["phantom", "block", "--size", "16", "-o", "results"], 1);
    assert!(err.contains("--overwrite"), "{err}");
    assert_eq!(fs::read_dir(folder.path().join("results")).unwrap().count(), 1);
    run(folder.path(), &["phantom", "block", "--size", "16", "-o", "results", "--force"], 0);
    assert_eq!(fs::read_to_string(folder.path().join("results/mine.txt")).unwrap(), "mine");
}

#[cfg(target_os = "linux")]
#[test]
fn an_output_folder_that_cannot_be_written() {
    let folder = small_pair();
    let (_, err) = run(folder.path(), &["field", "initial.nii.gz", "deformed.nii.gz", "-o", "/proc/results"], 1);
    assert!(err.contains("/proc/results"), "{err}");
}

/// A file size limit stands for a full disk: each write past it fails.
#[cfg(target_os = "linux")]
#[test]
fn a_failed_write_leaves_nothing() {
    let folder = small_pair();
    let program = assert_cmd::cargo::cargo_bin!("palpate");
    let script = format!("trap '' XFSZ; ulimit -f 1; exec '{}' phantom block --size 16 -o results", program.display());
    let output = Command::new("sh").current_dir(&folder).args(["-c", &script]).output().unwrap();
    assert_eq!(output.status.code(), Some(1), "{}", text(&output.stderr));
    assert!(text(&output.stderr).contains("results/"), "{}", text(&output.stderr));
    assert!(!folder.path().join("results").exists());
}

#[test]
fn an_input_that_would_be_overwritten() {
    let folder = small_pair();
    fs::copy(folder.path().join("deformed.nii.gz"), folder.path().join("warped.nii.gz")).unwrap();
    let (_, err) = run(folder.path(), &["field", "initial.nii.gz", "warped.nii.gz", "-o", ".", "--force"], 2);
    assert!(err.contains("would be overwritten"), "{err}");
}

#[test]
fn a_volume_in_place_of_a_field() {
    let folder = small_pair();
    let (_, err) = run(folder.path(), &["invert", "initial.nii.gz", "-o", "x.nii.gz"], 1);
    assert!(err.contains("initial.nii.gz") && err.contains("field"), "{err}");
    assert!(!folder.path().join("x.nii.gz").exists());
}

#[test]
fn a_truth_on_another_grid() {
    let folder = small_pair();
    run(folder.path(), &["phantom", "block", "--size", "16", "-o", "other"], 0);
    let (_, err) = run(folder.path(), &["evaluate", "truth.nii.gz", "--truth", "other/truth.nii.gz"], 1);
    assert!(err.contains("another grid"), "{err}");
}

#[test]
fn tables_with_flaws() {
    let folder = small_pair();
    let cases = [
        ("a,b,c\n1,2,3\n", "no column"),
        ("x,y,z\n1,two,3\n", "two"),
        ("x,y,z\n1,2\n", "line 2"),
        ("x,y,z\n", "no row"),
    ];
    for (table, message) in cases {
        fs::write(folder.path().join("p.csv"), table).unwrap();
        let arguments = ["warp", "--points", "p.csv", "--field", "truth.nii.gz", "-o", "moved.csv"];
        let (_, err) = run(folder.path(), &arguments, 1);
        assert!(err.contains("p.csv") && err.contains(message), "{table:?}: {err}");
        assert!(!folder.path().join("moved.csv").exists());
    }
}

#[test]
fn a_phantom_scores_zero_against_its_own_truth() {
    let folder = small_pair();
    let arguments = ["evaluate", "truth.nii.gz", "--truth", "truth.nii.gz", "--mask", "mask.nii.gz"];
    let (out, _) = run(folder.path(), &[&arguments[..], &["--landmarks", "landmarks.csv", "--json"]].concat(), 0);
    let score: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert_eq!(score["max_mm"], 0.0);
    assert!(score["identity_mm"].as_f64().unwrap() > 0.1);
    let (words, _) = run(folder.path(), &arguments, 0);
    assert!(words.starts_with("Mean error 0.000 mm"), "{words}");
    run(folder.path(), &["invert", "truth.nii.gz", "-o", "back.nii.gz"], 0);
    let arguments = ["evaluate", "truth.nii.gz", "--backward", "back.nii.gz", "--mask", "mask.nii.gz"];
    let (words, _) = run(folder.path(), &arguments, 0);
    assert!(words.starts_with("Inverse consistency: mean 0.0"), "{words}");
    let (out, _) = run(folder.path(), &[&arguments[..], &["--json"]].concat(), 0);
    let score: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert!(score["inverse_mean_mm"].as_f64().unwrap() < 0.05, "{score}");
    let (_, err) = run(folder.path(), &["evaluate", "truth.nii.gz"], 2);
    assert!(err.contains("--truth"), "{err}");
}

#[test]
fn warping_with_the_truth_brings_the_deformed_volume_back() {
    let folder = TempDir::new().unwrap();
    run(folder.path(), &["phantom", "block", "--size", "32", "--noise", "0", "--bias", "0", "-o", "."], 0);
    let arguments = ["deformed.nii.gz", "--field", "truth.nii.gz", "--interpolation", "cubic", "-o", "back.nii.gz"];
    run(folder.path(), &[&["warp"][..], &arguments].concat(), 0);
    let volume = |name: &str| palpate::io::read_volume(folder.path().join(name)).unwrap();
    let mask = palpate::io::read_mask(folder.path().join("mask.nii.gz")).unwrap();
    let (initial, deformed, back) = (volume("initial.nii.gz"), volume("deformed.nii.gz"), volume("back.nii.gz"));
    let difference = |v: &palpate::types::Volume| -> f64 {
        let all = initial.as_slice().iter().zip(v.as_slice()).zip(mask.as_slice());
        all.filter(|(_, m)| **m > 0).map(|((a, b), _)| f64::from((a - b).abs())).sum()
    };
    let (after, before) = (difference(&back), difference(&deformed));
    assert!(after < 0.35 * before, "{after} against {before}");
}

#[test]
fn labels_keep_their_values_and_points_their_columns() {
    let folder = small_pair();
    let arguments = ["warp", "mask.nii.gz", "--field", "truth.nii.gz", "--interpolation", "nearest", "-o", "m.nii.gz"];
    run(folder.path(), &arguments, 0);
    let labels = palpate::io::read_labels(folder.path().join("m.nii.gz")).unwrap();
    assert!(labels.as_slice().iter().all(|v| *v <= 1));

    let table = "name,x,y,z\ninside,0,0,0\noutside,900,0,0\n";
    fs::write(folder.path().join("p.csv"), table).unwrap();
    let arguments = ["warp", "--points", "p.csv", "--field", "truth.nii.gz", "-o", "moved.csv"];
    let (_, err) = run(folder.path(), &arguments, 0);
    assert!(err.starts_with("warning: 1 of 2 points") && err.contains("--quiet"), "{err}");
    let moved = fs::read_to_string(folder.path().join("moved.csv")).unwrap();
    assert!(moved.contains("inside") && moved.contains("NaN,NaN,NaN,outside"), "{moved}");
    let (_, err) = run(folder.path(), &[&arguments[..], &["--quiet"]].concat(), 0);
    assert!(err.is_empty(), "{err}");
}

#[test]
fn the_inverse_undoes_the_field() {
    let folder = small_pair();
    let (out, _) = run(folder.path(), &["invert", "truth.nii.gz", "-o", "inverse.nii.gz"], 0);
    assert!(out.contains("undoes the field"), "{out}");
    // At a voxel centre of the inverse nothing is interpolated on the way there, and the way back
    // is the field's own.
    let start = palpate::io::read_volume(folder.path().join("deformed.nii.gz")).unwrap().grid().world(14, 17, 19).0;
    fs::write(folder.path().join("p.csv"), format!("x,y,z\n{},{},{}\n", start[0], start[1], start[2])).unwrap();
    run(folder.path(), &["warp", "--points", "p.csv", "--field", "inverse.nii.gz", "-o", "q.csv"], 0);
    run(folder.path(), &["warp", "--points", "q.csv", "--field", "truth.nii.gz", "-o", "r.csv"], 0);
    let point = |name: &str| palpate::io::read_points(folder.path().join(name)).unwrap().points[0];
    let apart = |d: [f64; 3]| d.iter().map(|v| v * v).sum::<f64>().sqrt();
    assert!(apart(point("q.csv").minus(point("p.csv"))) > 0.05);
    assert!(apart(point("r.csv").minus(point("p.csv"))) < 1e-3);
}

#[test]
fn a_reader_that_leaves_early_is_no_error() {
    let folder = small_pair();
    let mut child = std::process::Command::new(assert_cmd::cargo::cargo_bin!("palpate"))
        .current_dir(&folder)
        .args(["evaluate", "truth.nii.gz", "--truth", "truth.nii.gz"])
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    assert!(output.stderr.is_empty(), "{}", text(&output.stderr));
}

#[test]
fn a_field_run_writes_everything_and_the_same_with_any_number_of_threads() {
    let folder = small_pair();
    let field = |output: &str, threads: &str| {
        let files = ["field", "initial.nii.gz", "deformed.nii.gz", "--mask", "mask.nii.gz"];
        run(folder.path(), &[&files[..], &["--quiet", "--threads", threads, "-o", output]].concat(), 0)
    };
    let (out, err) = field("one", "1");
    field("two", "2");
    assert!(out.contains("matches") && out.contains("one/report.html"), "{out}");
    assert!(err.is_empty(), "{err}");
    let volumes = ["displacement.nii.gz", "warped.nii.gz", "jacobian.nii.gz", "uncertainty.nii.gz"];
    for name in volumes.into_iter().chain(["posterior.nii.gz", "matches.csv", "mesh.vtu"]) {
        let read = |run: &str| fs::read(folder.path().join(run).join(name)).unwrap();
        assert!(read("one") == read("two"), "{name} depends on the number of threads");
    }
    let summary = fs::read_to_string(folder.path().join("one/summary.json")).unwrap();
    let summary: serde_json::Value = serde_json::from_str(&summary).unwrap();
    for key in ["version", "command", "inputs", "grid", "model", "folds", "evidence", "levels", "warnings", "params"] {
        assert!(!summary[key].is_null(), "{key}");
    }
    for key in ["features_initial", "features_deformed", "candidates", "kept", "nodes", "tetrahedra"] {
        assert!(summary["counts"][key].as_u64().unwrap() > 0, "{key}");
    }
    assert!(summary["seconds"]["read"].as_f64().unwrap() >= 0.0);
    let page = fs::read_to_string(folder.path().join("one/report.html")).unwrap();
    assert!(page.contains("Trust is") && !page.contains("://"));
    assert_eq!(fs::read_dir(folder.path().join("one")).unwrap().count(), 10);
}

#[test]
fn bodies_are_given_as_labels_or_refused_by_name() {
    let folder = small_pair();
    let field = |more: &[&str], status: i32| {
        let files = ["field", "initial.nii.gz", "deformed.nii.gz", "--quiet"];
        run(folder.path(), &[&files[..], more].concat(), status)
    };
    field(&["--bodies", "mask.nii.gz", "--rigid", "1", "-o", "given"], 0);
    let summary = fs::read_to_string(folder.path().join("given/summary.json")).unwrap();
    let summary: serde_json::Value = serde_json::from_str(&summary).unwrap();
    assert_eq!(summary["bodies"][0]["model"], "rigid");
    assert_eq!((&summary["params"]["bodies"], &summary["params"]["rigid"][0]), (&"given".into(), &1.into()));
    let (_, said) = field(&["--bodies", "mask.nii.gz", "--rigid", "4", "-o", "no"], 1);
    assert!(said.contains("mask.nii.gz: --rigid 4 is no body") && said.contains("there are 1"), "{said}");
    let (_, said) = field(&["--bodies", "nothing.nii.gz", "-o", "no"], 1);
    assert!(said.contains("nothing.nii.gz"), "{said}");
    let (_, said) = field(&["--bodies", "mask.nii.gz", "--method", "sparse", "-o", "no"], 1);
    assert!(said.contains("--bodies") && said.contains("--method"), "{said}");
    let (_, said) = field(&["--config", "given/summary.json", "-o", "no"], 1);
    assert!(said.contains("made with --bodies"), "{said}");
    field(&["--rigid", "1", "-o", "no"], 2);
    field(&["--bodies", "mask.nii.gz", "--bonded", "-o", "no"], 2);
    assert!(!folder.path().join("no").exists());
}

/// The chain test: a finger pad through every command, ending in a stable grasp; each stage has its
/// truth and error.
#[test]
fn the_demo_takes_a_finger_pad_from_two_volumes_to_a_grasp() {
    let folder = TempDir::new().unwrap();
    let command = ["demo", "--chain", "--preset", "fast", "--size", "48", "--nodes", "4000", "--quiet"];
    let (out, _) = run(folder.path(), &command, 0);
    println!("{out}");
    let demo = folder.path().join("palpate-demo");
    let summary: Value = serde_json::from_str(&fs::read_to_string(demo.join("summary.json")).unwrap()).unwrap();
    let row = |quantity: &str| {
        let all = summary["chain"].as_array().unwrap();
        let found = all.iter().find(|r| r["quantity"].as_str().unwrap().contains(quantity)).unwrap();
        ["found", "truth", "error"].map(|k| found[k].as_f64().unwrap())
    };
    let [error, nothing, _] = row("displacement");
    assert!(error < 0.35 * nothing, "{error} mm of {nothing}");
    assert!(row("of pulp")[2].abs() < 0.25, "{:?}", row("of pulp"));
    let skin = summary["chain"].as_array().unwrap().iter().find(|r| r["quantity"].as_str().unwrap().contains("skin"));
    let skin = skin.unwrap();
    assert!(!skin["bound"].is_null() || skin["error"].as_f64().unwrap().abs() < 0.4, "{skin}");
    // The field shows the plate's travel 10 % short, and force goes with its square.
    assert!(row("hemisphere")[2].abs() < 0.4, "{:?}", row("hemisphere"));
    // The force is what the moduli were scaled by: their elements must give it back. A low bound in
    // place of the skin's modulus makes the map softer, never stiffer.
    let softer = if skin["bound"].is_null() { 0.1 } else { 0.25 };
    // Where skin is determined, they err by no more than its modulus does.
    let stiffer = skin["error"].as_f64().map_or(0.1, |error| error.max(0.1));
    assert!((-softer..stiffer).contains(&row("finite elements")[2]), "{:?}", row("finite elements"));
    let [turn, exact, _] = row("turn");
    assert!((turn - exact).abs() < 0.5, "{turn} degrees, not {exact}");
    assert_eq!(row("held throughout")[0], 1.0);
    // Of the map alone, without the force of the press, which is the truth's: as far off as that.
    assert!(row("grip force")[2].abs() < 0.4, "{:?}", row("grip force"));
    assert_eq!(fs::read_to_string(demo.join("chain.csv")).unwrap().lines().count(), 11);
    let page = fs::read_to_string(demo.join("report.html")).unwrap();
    assert!(page.matches("srcdoc").count() == 3 && page.contains("<svg"));
    // Again into the same folder it may; into one that holds something else it may not.
    fs::remove_file(demo.join("summary.json")).unwrap();
    let (_, err) = run(folder.path(), &command, 1);
    assert!(err.contains("palpate-demo") && err.contains("--overwrite"), "{err}");
}

#[test]
fn the_first_demo_scores_displacement_and_strain() {
    let folder = TempDir::new().unwrap();
    run(folder.path(), &["demo", "--size", "44", "--quiet"], 0);
    let demo = folder.path().join("palpate-demo");
    let summary: Value = serde_json::from_str(&fs::read_to_string(demo.join("summary.json")).unwrap()).unwrap();
    let rows = summary["chain"].as_array().unwrap();
    let of = |k: usize| ["found", "truth"].map(|key| rows[k][key].as_f64().unwrap());
    assert_eq!([rows[0]["stage"].as_str(), rows[1]["stage"].as_str()], [Some("field"), Some("strain")]);
    for [error, nothing] in [of(0), of(1)] {
        assert!(error < 0.6 * nothing, "{error} of {nothing}");
    }
    let page = fs::read_to_string(demo.join("report.html")).unwrap();
    assert!(page.matches("srcdoc").count() == 2 && page.contains("Displacement and strain of a calf"));
}

#[test]
fn volumes_in_unlike_units_are_refused_before_any_work() {
    let folder = small_pair();
    let put = |name: &str, size: f32, dims: [i16; 3]| {
        let mut file = Nifti::ramp(dims);
        (0..3).for_each(|a| file.sform[a][a] = size);
        fs::write(folder.path().join(name), file.bytes()).unwrap();
    };
    put("mm.nii", 2.0, [20, 22, 18]);
    put("m.nii", 0.002, [20, 22, 18]);
    put("cm.nii", 0.2, [20, 20, 20]);
    put("fine.nii", 0.1, [20, 20, 20]);
    put("lost.nii", 1.0, [20, 20, 20]);
    put("crop.nii", 2.0, [4, 4, 4]);
    put("um.nii", 0.0015, [20, 20, 20]);
    let cases = [
        ("mm.nii", "m.nii", "44 mm, about 1000 times as long; one of them is likely in metres or micrometres"),
        ("cm.nii", "mm.nii", "about 10 times as long; one of them is likely in centimetres"),
        ("um.nii", "mm.nii", "0.03 mm, and that of mm.nii is 44 mm, about 1467 times as long"),
        ("fine.nii", "lost.nii", "lost.nii has voxels of 1 mm on every side, as where a header was lost"),
    ];
    for (initial, deformed, message) in cases {
        let (_, err) = run(folder.path(), &["field", initial, deformed, "-o", "out"], 1);
        assert!(err.contains(message) && err.contains(initial) && err.contains(deformed), "{message}: {err}");
        let (_, err) = run(folder.path(), &["track", initial, deformed, "-o", "out"], 1);
        assert!(err.contains(message), "{message}: {err}");
    }
    // A part of the other volume has as large voxels, but fewer.
    run(folder.path(), &["field", "mm.nii", "crop.nii", "-o", "out", "--dry-run"], 0);
    assert!(!folder.path().join("out").exists());
}

#[test]
fn a_search_beyond_the_volume_is_capped_and_said() {
    let folder = small_pair();
    let volume = palpate::io::read_volume(folder.path().join("initial.nii.gz")).unwrap();
    let side = (0..3).map(|a| volume.grid().shape()[a] as f64 * volume.grid().spacing()[a]).fold(0.0, f64::max);
    let pair = ["field", "initial.nii.gz", "deformed.nii.gz", "-o", "out", "--dry-run", "--search"];
    let (out, err) = run(folder.path(), &[&pair[..], &["180"]].concat(), 0);
    assert!(err.contains("--search 180 mm is more than the longest side of initial.nii.gz"), "{err}");
    assert!(out.contains(&format!("search       {side} mm")), "{out}");
    let (_, err) = run(folder.path(), &[&pair[..], &["7"]].concat(), 0);
    assert!(!err.contains("longest side"), "{err}");
}

/// A result of which nothing is left is an error, one of which a part is left says how much.
#[test]
fn an_empty_result_is_an_error_and_a_part_is_told_with_its_share() {
    let folder = small_pair();
    let at = |name: &str| folder.path().join(name);
    let truth = palpate::io::read_field(at("truth.nii.gz")).unwrap();
    let grid = *truth.grid();
    let write = |name: &str, u: &dyn Fn([f64; 3]) -> [f64; 3]| {
        let n = grid.len();
        let mut values = vec![0f32; 3 * n];
        for o in 0..n {
            let v = u(grid.voxel(o).map(|i| i as f64));
            (0..3).for_each(|c| values[c * n + o] = v[c] as f32);
        }
        palpate::io::write_field(at(name), &palpate::types::DenseField::from_vec(grid, values).unwrap()).unwrap();
    };
    write("far.nii", &|_| [1e30; 3]);
    write("lost.nii", &|_| [f64::NAN; 3]);
    write("steep.nii", &|v| [1e30 * v[0], 0.0, 0.0]);
    write("half.nii", &|v| if v[0] < 16.0 { [1e30, 0.0, 0.0] } else { [0.0; 3] });
    fs::write(at("beyond.csv"), "x,y,z\n9000,9000,9000\n").unwrap();
    fs::write(at("none.csv"), "x,y,z,dx,dy,dz,ncc,sigma,kept\n1,2,3,0,0,0,1,0.1,0\n").unwrap();
    let empty: [&[&str]; 8] = [
        &["warp", "initial.nii.gz", "--field", "far.nii", "-o", "x.nii"],
        &["warp", "initial.nii.gz", "--field", "lost.nii", "-o", "x.nii"],
        &["warp", "mask.nii.gz", "--field", "far.nii", "-o", "x.nii"],
        &["invert", "far.nii", "-o", "x.nii"],
        &["invert", "lost.nii", "-o", "x.nii"],
        &["warp", "--points", "beyond.csv", "--field", "truth.nii.gz", "-o", "x.csv"],
        &["warp", "--points", "beyond.csv", "--field", "truth.nii.gz", "-o", "x.mrk.json"],
        &["markups", "none.csv", "-o", "x.mrk.json"],
    ];
    for arguments in empty {
        let (out, _) = run(folder.path(), arguments, 1);
        assert!(out.is_empty(), "{arguments:?}: {out}");
        for name in ["x.nii", "x.csv", "x.mrk.json"] {
            assert!(!at(name).exists(), "{arguments:?} wrote {name}");
        }
    }
    for name in ["steep.nii", "half.nii"] {
        let (out, err) = run(folder.path(), &["invert", name, "-o", "x.nii"], 0);
        let share = [" % of its voxels, to ", " %) come from outside its grid"];
        assert!(share.iter().any(|s| out.contains(s)) && err.contains("Jacobian"), "{name}: {out}{err}");
        let (out, _) = run(folder.path(), &["warp", "initial.nii.gz", "--field", name, "-o", "w.nii"], 0);
        assert!(out.contains("% of the voxels come from outside"), "{name}: {out}");
    }
    let (out, _) = run(folder.path(), &["invert", "truth.nii.gz", "-o", "x.nii"], 0);
    assert!(!out.contains("of its voxels"), "{out}");
}

/// Numbers that no computation can keep are errors, not NaN, null or another number.
#[test]
fn numbers_that_would_be_lost_are_errors_and_labels_stay_whole() {
    let folder = small_pair();
    let at = |name: &str| folder.path().join(name);
    let scene =
        fs::read_to_string(std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/skin.toml")).unwrap();
    for (key, value) in [("e0", "1e300"), ("e0", "1e30"), ("c0", "1e-300"), ("maxwell", "[[1e300, 1.0e4]]")] {
        let line = scene.lines().find(|l| l.trim_start().starts_with(&format!("{key} ="))).unwrap();
        fs::write(at("s.toml"), scene.replacen(line, &format!("{key} = {value}"), 1)).unwrap();
        let (out, err) = run(folder.path(), &["skin", "s.toml", "-o", "x"], 1);
        assert!(out.is_empty() && err.contains("s.toml") && err.contains("digit"), "{key} = {value}: {out}{err}");
        assert!(!at("x").exists());
    }
    for value in ["nan", "inf", "-inf"] {
        fs::write(at("c.toml"), format!("search_mm = {value}\n")).unwrap();
        let arguments = ["field", "initial.nii.gz", "deformed.nii.gz", "-o", "x", "--config", "c.toml"];
        let (_, err) = run(folder.path(), &arguments, 1);
        assert!(err.contains(&format!("search_mm is {value}, not a finite number")), "{err}");
    }

    // A label that single precision has not, in every format.
    let mut nifti = Nifti::filled([8, 8, 8], 0.0).bytes();
    nifti[70..72].copy_from_slice(&8i16.to_le_bytes());
    let labels: Vec<i32> =
        (0..512).map(|o| if o % 8 < 4 { 16_777_217 } else { 16_777_216 * i32::from(o % 8 < 6) }).collect();
    nifti[352..].copy_from_slice(&labels.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>());
    fs::write(at("l.nii"), &nifti).unwrap();
    for (output, offset) in [("w.nii", 352), ("w.mha", 0)] {
        let arguments = ["warp", "l.nii", "--reference", "l.nii", "--interpolation", "nearest", "-o", output];
        run(folder.path(), &arguments, 0);
        let bytes = fs::read(at(output)).unwrap();
        let start = if offset == 0 { bytes.len() - 4 * 512 } else { offset };
        let found: Vec<i32> =
            bytes[start..].chunks_exact(4).map(|b| i32::from_le_bytes(b.try_into().unwrap())).collect();
        assert!(found == labels, "{output}");
    }
    let (_, err) = run(folder.path(), &["field", "initial.nii.gz", "deformed.nii.gz", "--mask", "l.nii", "-o", "x"], 1);
    assert!(err.contains("16777217"), "{err}");
}

/// Old names of options work, and the one that meant something else says what it is called now.
#[test]
fn old_names_of_options_still_work() {
    let folder = small_pair();
    let press =
        ["stiffness", "--field", "truth.nii.gz", "--mask", "mask.nii.gz", "--held", "y-", "--load", "y+", "-o", "x"];
    let (new, err) = run(folder.path(), &[&press[..], &["--total-force", "2", "--dry-run"]].concat(), 0);
    assert!(!err.contains("--total-force"), "{err}");
    for old in [&["--force", "2"][..], &["--force=2"]] {
        let (out, err) = run(folder.path(), &[&press[..], old, &["--dry-run"]].concat(), 0);
        assert_eq!(out, new);
        assert!(err.contains("--force is called --total-force now"), "{err}");
    }
    run(folder.path(), &["phantom", "block", "--size", "16", "-o", "p"], 0);
    for flag in ["--force", "--overwrite"] {
        run(folder.path(), &["phantom", "block", "--size", "16", "-o", "p", flag], 0);
    }
}

/// How to silence warnings is said with the first one alone.
#[test]
fn how_to_silence_warnings_is_said_once() {
    let folder = small_pair();
    let mut far = Nifti::ramp([12, 12, 12]);
    far.values[5] = f32::NAN;
    fs::write(folder.path().join("odd.nii"), far.bytes()).unwrap();
    let arguments = ["field", "odd.nii", "odd.nii", "-o", "x", "--search", "190", "--dry-run"];
    let output = crate::fixtures::palpate(folder.path()).args(arguments).output().unwrap();
    let err = text(&output.stderr);
    assert!(err.matches("warning: ").count() >= 2, "{err}");
    assert_eq!(err.matches("--quiet silences").count(), 1, "{err}");
    let quiet = crate::fixtures::palpate(folder.path()).args(arguments).arg("--quiet").output().unwrap();
    assert!(!text(&quiet.stderr).contains("warning"), "{}", text(&quiet.stderr));
}
