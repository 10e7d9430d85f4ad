//! `palpate info` names whatever palpate writes.

use crate::fixtures::{Nifti, run, small_pair};
use serde_json::Value;
use std::fs;
use std::path::Path;
use tempfile::TempDir;

/// The kind that info gives each of these files.
fn kinds(folder: &Path, files: &[&str]) -> Vec<String> {
    let told: Value = serde_json::from_str(&run(folder, &[&["info", "--json"][..], files].concat(), 0).0).unwrap();
    told.as_array().unwrap().iter().map(|f| f["kind"].as_str().unwrap().to_string()).collect()
}

fn check(folder: &Path, expected: &[(&str, &str)]) {
    let files: Vec<&str> = expected.iter().map(|e| e.0).collect();
    for ((file, kind), found) in expected.iter().zip(kinds(folder, &files)) {
        assert_eq!(found, *kind, "{file}");
    }
}

/// Every file of a folder is among the names that end an entry of `expected`.
fn complete(folder: &Path, results: &str, expected: &[(&str, &str)]) {
    for entry in fs::read_dir(folder.join(results)).unwrap() {
        let name = format!("{results}/{}", entry.unwrap().file_name().to_str().unwrap());
        assert!(expected.iter().any(|e| e.0 == name), "{name} is not checked");
    }
}

#[test]
fn each_file_of_a_field_a_strain_a_track_and_a_certificate_is_named() {
    let folder = small_pair();
    let folder = folder.path();
    let pair = ["initial.nii.gz", "deformed.nii.gz", "--mask", "mask.nii.gz", "--preset", "fast"];
    run(folder, &[&["field"][..], &pair, &["--strain", "-o", "f"]].concat(), 0);
    run(folder, &["strain", "f", "--measure", "small", "-o", "s"], 0);
    run(folder, &[&["track"][..], &pair, &["-o", "t"]].concat(), 0);
    run(folder, &["certify", "initial.nii.gz", "--mask", "mask.nii.gz", "--preset", "fast", "-o", "c"], 0);
    run(folder, &["warp", "deformed.nii.gz", "--field", "f", "-o", "w.nii.gz"], 0);
    run(folder, &["warp", "mask.nii.gz", "--field", "f", "--interpolation", "nearest", "-o", "l.nii.gz"], 0);
    run(folder, &["markups", "f/matches.csv", "-o", "m.mrk.json"], 0);
    let expected = [
        ("f", "results of palpate field"),
        ("f/displacement.nii.gz", "displacement field"),
        ("f/warped.nii.gz", "deformed volume, warped to the initial one"),
        ("f/jacobian.nii.gz", "Jacobian determinant of a motion"),
        ("f/uncertainty.nii.gz", "uncertainty of a displacement, mm"),
        ("f/posterior.nii.gz", "draws of a field's error"),
        ("f/bodies.nii.gz", "bodies that a field was measured in"),
        ("f/matches.csv", "matches"),
        ("f/mesh.vtu", "mesh of a field's matches"),
        ("f/summary.json", "summary of palpate field"),
        ("f/report.html", "page, for a browser"),
        ("f/strain.nii.gz", "Green-Lagrange strain"),
        ("f/strain_sd.nii.gz", "standard deviation of strain"),
        ("f/principal.nii.gz", "principal strains, largest first"),
        ("f/directions.nii.gz", "directions of the principal strains"),
        ("f/shear.nii.gz", "largest shear strain"),
        ("f/volume_change.nii.gz", "relative change of volume"),
        ("f/regions.csv", "strain of regions"),
        ("s", "results of palpate strain"),
        ("s/strain.nii.gz", "small strain"),
        ("t", "results of palpate track"),
        ("t/displacement.nii.gz", "series of displacement fields"),
        ("t/displacement_000.nii.gz", "displacement field"),
        ("t/displacement_001.nii.gz", "displacement field"),
        ("t/matches_001.csv", "matches"),
        ("t/strain_001.nii.gz", "Green-Lagrange strain"),
        ("t/trajectories.csv", "trajectories of tracked points"),
        ("t/strain.csv", "strain of regions over time"),
        ("t/summary.json", "summary of palpate track"),
        ("t/report.html", "page, for a browser"),
        ("c", "results of palpate certify"),
        ("c/certificate.json", "summary of palpate certify"),
        ("c/detectable.nii.gz", "smallest displacement above noise, mm"),
        ("c/report.html", "page, for a browser"),
        ("w.nii.gz", "volume, warped"),
        ("l.nii.gz", "label map, warped"),
        ("m.mrk.json", "points"),
        (".", "phantom of palpate"),
        ("phantom.json", "description of a phantom"),
        ("phantom.svg", "drawing, for a browser"),
    ];
    check(folder, &expected);
    ["f", "t", "c"].into_iter().for_each(|results| complete(folder, results, &expected));
    // What a file holds counts, not what it is called.
    fs::rename(folder.join("f/posterior.nii.gz"), folder.join("x.nii.gz")).unwrap();
    fs::rename(folder.join("t/trajectories.csv"), folder.join("y.csv")).unwrap();
    check(folder, &[("x.nii.gz", "draws of a field's error"), ("y.csv", "trajectories of tracked points")]);
    let (out, _) = run(folder, &["info", "f"], 0);
    for part in ["command line palpate field initial.nii.gz", "palpate field --config f/summary.json -o AGAIN", "trust"]
    {
        assert!(out.contains(part), "{part} is missing in\n{out}");
    }
}

#[test]
fn each_file_of_the_whole_chain_is_named() {
    let folder = TempDir::new().unwrap();
    let folder = folder.path();
    run(folder, &["demo", "--chain", "--preset", "fast", "--size", "36", "--nodes", "2000", "--quiet", "-o", "d"], 0);
    let expected = [
        ("d", "results of palpate demo"),
        ("d/phantom", "phantom of palpate"),
        ("d/field", "results of palpate field"),
        ("d/stiffness", "results of palpate stiffness"),
        ("d/grasp", "results of palpate grasp"),
        ("d/fingertip.toml", "fingertip for a grasp scene"),
        ("d/fingertip.svg", "drawing, for a browser"),
        ("d/exact.toml", "fingertip for a grasp scene"),
        ("d/scene.toml", "grasp scene"),
        ("d/exact-scene.toml", "grasp scene"),
        ("d/chain.csv", "errors of palpate demo"),
        ("d/summary.json", "summary of palpate demo"),
        ("d/report.html", "page, for a browser"),
        ("d/phantom/initial.nii.gz", "volume"),
        ("d/phantom/labels.nii.gz", "label map or mask"),
        ("d/phantom/landmarks.csv", "landmarks"),
        ("d/phantom/youngs_modulus.nii.gz", "exact Young's modulus of a phantom, kPa"),
        ("d/stiffness/stiffness.nii.gz", "Young's modulus, kPa"),
        ("d/stiffness/stiffness_sd.nii.gz", "standard deviation of Young's modulus"),
        ("d/stiffness/residual.nii.gz", "residual of a stiffness map, mm"),
        ("d/stiffness/regions.csv", "stiffness of regions"),
        ("d/stiffness/mesh.vtu", "mesh of a stiffness map"),
        ("d/stiffness/model.inp", "finite element model for CalculiX and Abaqus"),
        ("d/stiffness/model.feb", "finite element model for FEBio"),
        ("d/stiffness/model.scn", "finite element model for SOFA"),
        ("d/stiffness/model.xml", "finite element model for MuJoCo"),
        ("d/stiffness/model.msh", "finite element model for Gmsh and MuJoCo"),
        ("d/stiffness/summary.json", "summary of palpate stiffness"),
        ("d/stiffness/report.html", "page, for a browser"),
        ("d/grasp/trajectory.csv", "trajectory of a grasp"),
        ("d/grasp/bands.csv", "bands of a grasp"),
        ("d/grasp/motions.csv", "motions of a grasp"),
        ("d/grasp/summary.json", "summary of palpate grasp"),
        ("d/grasp/report.html", "page, for a browser"),
    ];
    check(folder, &expected);
    ["d", "d/stiffness", "d/grasp"].into_iter().for_each(|results| complete(folder, results, &expected));
    for field in ["palpate", "d/phantom"] {
        let (out, _) = run(folder, &["info", "d/phantom"], 0);
        assert!(out.contains(field) && out.contains("--truth d/phantom"), "{out}");
    }
}

#[test]
fn each_file_of_the_other_commands_is_named() {
    let folder = TempDir::new().unwrap();
    let folder = folder.path();
    let scenes = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples");
    let scene = |name: &str| scenes.join(name).to_str().unwrap().to_string();
    run(folder, &["skin", &scene("skin.toml"), "-o", "skin"], 0);
    let presses = scene("synthetic_presses.csv");
    run(folder, &["grasp-analysis", &scene("eight_motions.toml"), "--measured", &presses, "-o", "a"], 0);
    run(folder, &["stress", "--quick", "--part", "field", "--axis", "no-overlap", "-o", "stress"], 0);
    run(folder, &["chart", "--quick", "--part", "grasp", "-o", "chart"], 0);
    run(folder, &["phantom", "pinch", "--size", "24", "--frames", "3", "-o", "pinch"], 0);
    run(folder, &["phantom", "block", "--size", "32", "--amplitude", "2", "-o", "pair"], 0);
    fs::write(folder.join("table.csv"), "initial,deformed\npair/initial.nii.gz,pair/deformed.nii.gz\n").unwrap();
    run(folder, &["batch", "table.csv", "--preset", "fast", "-o", "batch", "--quiet"], 0);
    fs::write(folder.join("other.csv"), "a,b\n1,2\n3,4\n").unwrap();
    fs::write(folder.join("itk.tfm"), "#Insight Transform File V1.0\n#Transform 0\nTransform: TranslationTransform_double_3_3\nParameters: 1 2 3\nFixedParameters:\n").unwrap();
    fs::write(folder.join("points.fcsv"), "# CoordinateSystem = LPS\n# columns = id,x,y,z\n1,2,3,4\n").unwrap();
    let expected = [
        ("skin", "results of palpate skin"),
        ("skin/response.csv", "response of skin"),
        ("skin/summary.json", "summary of palpate skin"),
        ("skin/report.html", "page, for a browser"),
        ("a", "results of palpate grasp-analysis"),
        ("a/posture_force.csv", "posture force of a grasp"),
        ("a/energy.csv", "energy of a grasp"),
        ("a/stability.csv", "stability of a grasp"),
        ("a/pinch_map.csv", "pinch map of a grasp"),
        ("a/push.csv", "trajectory of a grasp"),
        ("a/measured.csv", "measurements beside tip models"),
        ("a/summary.json", "summary of palpate grasp-analysis"),
        ("a/report.html", "page, for a browser"),
        ("stress", "results of palpate stress"),
        ("stress/stress.csv", "runs of palpate stress"),
        ("stress/stress.svg", "drawing, for a browser"),
        ("stress/stress.html", "page, for a browser"),
        ("stress/summary.json", "summary of palpate stress"),
        ("chart", "results of palpate chart"),
        ("chart/chart.csv", "runs of palpate chart"),
        ("chart/chart.svg", "drawing, for a browser"),
        ("chart/chart.html", "page, for a browser"),
        ("chart/summary.json", "summary of palpate chart"),
        ("pinch", "phantom of palpate"),
        ("pinch/frame_001.nii.gz", "volume"),
        ("pinch/truth_001.nii.gz", "displacement field"),
        ("batch", "results of palpate batch"),
        ("batch/batch.csv", "results of a batch"),
        ("batch/regions.csv", "stiffness of the regions of a batch"),
        ("batch/summary.json", "summary of palpate batch"),
        ("batch/report.html", "page, for a browser"),
        ("batch/pair-2", "pair of palpate batch"),
        ("batch/pair-2/pair.json", "record of a pair of palpate batch"),
        ("batch/pair-2/field.log", "log of a stage of palpate batch"),
        ("table.csv", "table of pairs"),
        ("other.csv", "table"),
        ("itk.tfm", "transform"),
        ("points.fcsv", "points"),
    ];
    check(folder, &expected);
    ["skin", "a", "stress", "chart", "batch"].into_iter().for_each(|results| complete(folder, results, &expected));
    let (out, _) = run(folder, &["info", "other.csv"], 0);
    assert!(out.contains("columns      a, b") && out.contains("lines        2"), "{out}");
}

#[test]
fn a_description_cannot_disturb_the_terminal() {
    let folder = TempDir::new().unwrap();
    let mut bytes = Nifti::ramp([8, 8, 8]).bytes();
    bytes[148..160].copy_from_slice(b"\x1b[31mred\x07\xff\0x");
    fs::write(folder.path().join("odd.nii"), bytes).unwrap();
    let (out, _) = run(folder.path(), &["info", "odd.nii"], 0);
    assert!(out.contains("[31mred") && !out.contains('\x1b') && !out.contains('\x07'), "{out:?}");
}
