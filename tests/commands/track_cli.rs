//! `palpate track` and the sequences of `palpate phantom` as a user meets them.

use crate::fixtures::{Nifti, palpate, text};
use flate2::{Compression, write::GzEncoder};
use palpate::io;
use std::fs;
use std::io::Write;
use std::path::Path;
use std::sync::LazyLock;
use tempfile::TempDir;

const FRAMES: usize = 4;

/// A folder with a small pinch sequence.
fn pinch() -> &'static Path {
    static MADE: LazyLock<TempDir> = LazyLock::new(|| {
        let folder = TempDir::new().unwrap();
        let arguments = ["phantom", "pinch", "--size", "28", "--frames", "4", "-o", "."];
        palpate(folder.path()).args(arguments).assert().success();
        folder
    });
    MADE.path()
}

fn run(arguments: &[&str], code: i32) -> (String, String) {
    let output = palpate(pinch()).args(arguments).output().unwrap();
    let (out, err) = (text(&output.stdout), text(&output.stderr));
    assert_eq!(output.status.code(), Some(code), "palpate {}\n{out}{err}", arguments.join(" "));
    assert!(!err.contains("panicked"), "{err}");
    (out, err)
}

fn frames() -> Vec<String> {
    (0..FRAMES).map(|t| format!("frame_{t:03}.nii.gz")).collect()
}

/// The frames as one file, as another program would write it: float32, a frame every 0.25 s.
fn series(pack: bool) -> Vec<u8> {
    let volumes: Vec<_> = frames().iter().map(|f| io::read_volume(pinch().join(f)).unwrap()).collect();
    let grid = *volumes[0].grid();
    let mut bytes = Nifti {
        dims: grid.shape().map(|n| n as i16),
        times: FRAMES as i16,
        datatype: 16,
        sform: grid.affine().rows().map(|row| row.map(|v| v as f32)),
        values: volumes.iter().flat_map(|v| v.as_slice().to_vec()).collect(),
    }
    .bytes();
    bytes[92..96].copy_from_slice(&250f32.to_le_bytes());
    bytes[123] = 2 + 16; // mm, ms
    if !pack {
        return bytes;
    }
    let mut packed = GzEncoder::new(Vec::new(), Compression::fast());
    packed.write_all(&bytes).unwrap();
    packed.finish().unwrap()
}

/// The table's rows without its first line.
fn rows(path: &Path) -> Vec<Vec<String>> {
    let file = fs::read_to_string(path).unwrap();
    file.lines().skip(1).map(|l| l.split(',').map(String::from).collect()).collect()
}

#[test]
fn volumes_and_a_series_give_the_same() {
    let folder = TempDir::new().unwrap();
    let out = |name: &str| folder.path().join(name).to_str().unwrap().to_string();
    let frames = frames();
    let listed: Vec<&str> = frames.iter().map(String::as_str).collect();
    let from_files = [&["track"], &listed[..], &["--mask", "mask.nii.gz", "--labels", "labels.nii.gz", "-o"]].concat();
    let (said, _) = run(&[&from_files[..], &[&out("files")]].concat(), 0);
    assert!(said.starts_with("3 of 3 frames measured against frame 0"), "{said}");
    let (said, _) = run(&["track", listed[0], listed[1], "-o", &out("two")], 0);
    assert!(said.starts_with("1 of 1 frames measured against frame 0 (each by a search of all)"), "{said}");
    for (name, pack) in [("series.nii", false), ("series.nii.gz", true)] {
        fs::write(folder.path().join(name), series(pack)).unwrap();
        let arguments = ["--mask", "mask.nii.gz", "--labels", "labels.nii.gz", "-o", &out("series"), "--force"];
        run(&[&["track", &out(name)], &arguments[..]].concat(), 0);
        for t in 0..FRAMES {
            let field = |from: &str| {
                io::read_field(folder.path().join(from).join(format!("displacement_{t:03}.nii.gz"))).unwrap()
            };
            assert!(field("files") == field("series"), "{name}, frame {t}");
        }
    }

    let results = folder.path().join("series");
    let summary: serde_json::Value =
        serde_json::from_str(&fs::read_to_string(results.join("summary.json")).unwrap()).unwrap();
    assert_eq!((&summary["step_s"], summary["reference"].as_u64()), (&serde_json::json!(0.25), Some(0)));
    assert_eq!(summary["frames"].as_array().unwrap().len(), 3);
    let strain = rows(&results.join("strain.csv"));
    assert!(
        strain.iter().all(|r| r.len() == 12) && strain.iter().any(|r| r[..3] == ["3", "0.750000", "2"]),
        "{strain:?}"
    );
    let points = rows(&results.join("trajectories.csv"));
    assert!(points.iter().all(|r| r.len() == 8 && ["measured", "carried", "outside"].contains(&r[7].as_str())));
    // NIfTI asks for the rows of a symmetric matrix.
    let tensors = fs::read(results.join("strain_003.nii.gz")).unwrap();
    let mut head = [0; 70];
    std::io::Read::read_exact(&mut flate2::read::GzDecoder::new(&tensors[..]), &mut head).unwrap();
    assert_eq!((head[56..60].try_into().map(f32::from_le_bytes).unwrap(), head[68..70].to_vec()), (3.0, vec![237, 3]));
    // What it wrote it knows again.
    for (name, is) in [
        ("displacement.nii.gz", "series of displacement fields"),
        ("displacement_003.nii.gz", "displacement field"),
        ("strain_003.nii.gz", "symmetric tensors"),
    ] {
        let (said, _) = run(&["info", results.join(name).to_str().unwrap()], 0);
        assert!(said.contains(is) && !said.contains("does not read"), "{said}");
    }
    // Each point stands once in the reference, where it was found, and its frame's own matches lie
    // beside.
    let start: Vec<_> = points.iter().filter(|r| r[1] == "0").collect();
    let numbers: std::collections::HashSet<_> = points.iter().map(|r| &r[0]).collect();
    assert!(start.len() == numbers.len() && start.iter().all(|r| r[6] == "0.000000" && r[7] == "measured"));
    let matches = io::read_matches(results.join("matches_003.csv")).unwrap();
    assert!(matches.kept().count() >= 20);
    let page = fs::read_to_string(results.join("report.html")).unwrap();
    // Each frame states its expected error, and the sequence is trusted as its frames are.
    let told: serde_json::Value =
        serde_json::from_str(&fs::read_to_string(results.join("summary.json")).unwrap()).unwrap();
    let frames = told["frames"].as_array().unwrap();
    assert!(frames.iter().all(|f| f["expected_error_mm"].as_f64().unwrap() > 0.0 && f["trust"].is_string()));
    assert!(page.contains(&format!("Trust is {}", told["trust"].as_str().unwrap())));
    assert!(page.contains("<canvas>") && !page.contains("http"));

    // The whole series holds each frame's field, unpacked to the same bytes.
    let packed = fs::read(results.join("displacement.nii.gz")).unwrap();
    let mut all = Vec::new();
    std::io::Read::read_to_end(&mut flate2::read::GzDecoder::new(&packed[..]), &mut all).unwrap();
    let dim: Vec<i16> = (0..6).map(|i| i16::from_le_bytes([all[40 + 2 * i], all[41 + 2 * i]])).collect();
    let n = dim[1..4].iter().map(|&d| d as usize).product::<usize>();
    assert_eq!((dim[0], dim[4], dim[5]), (5, FRAMES as i16, 3));
    assert_eq!(all.len(), 352 + 4 * n * 3 * FRAMES);
    for t in 0..FRAMES {
        let field = io::read_field(results.join(format!("displacement_{t:03}.nii.gz"))).unwrap();
        for (c, sign) in [-1.0, -1.0, 1.0].into_iter().enumerate() {
            let from = 352 + 4 * n * (c * FRAMES + t);
            let same = |at: usize| {
                let v = f32::from_le_bytes(*all[from + 4 * at..].first_chunk().unwrap());
                v == sign * field.component(c)[at]
            };
            assert!((0..n).all(same), "frame {t}, component {c}");
        }
    }
}

#[test]
fn the_reference_may_be_any_frame() {
    let folder = TempDir::new().unwrap();
    let out = folder.path().join("out");
    let frames = frames();
    let listed: Vec<&str> = frames.iter().map(String::as_str).collect();
    run(&[&["track"], &listed[..], &["--reference", "2", "-o", out.to_str().unwrap()]].concat(), 0);
    let still = io::read_field(out.join("displacement_002.nii.gz")).unwrap();
    assert!(still.as_slice().iter().all(|&u| u == 0.0));
    assert!(out.join("strain_003.nii.gz").exists() && !out.join("strain_002.nii.gz").exists());
}

#[test]
fn what_cannot_be_tracked_is_refused() {
    let folder = TempDir::new().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_string();
    fs::write(path("short.nii.gz"), &series(true)[..20_000]).unwrap();
    fs::write(path("cut.nii"), &series(false)[..100_000]).unwrap();
    let flat = Nifti { times: 3, values: vec![1.0; 3 * 512], ..Nifti::filled([8, 8, 8], 1.0) };
    fs::write(path("flat.nii"), flat.bytes()).unwrap();
    let far = [[1.0, 0.0, 0.0, 5000.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
    fs::write(path("other.nii"), Nifti { sform: far, ..Nifti::filled([5, 5, 5], 1.0) }.bytes()).unwrap();
    let (a, b) = ("frame_000.nii.gz", "frame_001.nii.gz");
    let (short, cut, flat, other, out) =
        (path("short.nii.gz"), path("cut.nii"), path("flat.nii"), path("other.nii"), path("out"));
    let third = io::read_volume(pinch().join("frame_002.nii.gz")).unwrap();
    let sform = third.grid().affine().rows().map(|row| row.map(|v| v as f32));
    let zero = Nifti { sform, ..Nifti::filled(third.grid().shape().map(|n| n as i16), 0.0) };
    fs::write(path("zero.nii"), zero.bytes()).unwrap();
    fs::write(path("ended.nii"), &zero.bytes()[..1000]).unwrap();
    let (zero, ended) = (path("zero.nii"), path("ended.nii"));
    for (arguments, code, parts) in [
        (vec![a], 2, ["frame_000.nii.gz", "two or more"]),
        (vec![a, b, "--reference", "2"], 2, ["--reference is 2", "2 volumes"]),
        (vec![a, b, "--reference", "-1"], 2, ["--reference", "'-1'"]),
        (vec![a, "missing.nii"], 1, ["missing.nii", "check the spelling"]),
        (vec![a, b, "missing.nii", "--dry-run"], 1, ["missing.nii", "check the spelling"]),
        // By their headers, before anything is measured.
        (vec![a, b, &flat, "--dry-run"], 1, ["flat.nii", "is a series of 3 volumes"]),
        (vec![a, b, "truth_001.nii.gz", "--dry-run"], 1, ["truth_001.nii.gz", "not a scalar volume"]),
        (vec![a, b, &ended, "--dry-run"], 1, ["ended.nii", "cut short"]),
        (vec![a, b, "--labels", &zero], 1, ["zero.nii", "no voxel has a label"]),
        (vec![a, b, "--mask", &zero], 1, ["zero.nii", "the mask is empty"]),
        (vec![&short], 1, ["short.nii.gz", "cut short"]),
        (vec![&cut], 1, ["cut.nii", "cut short"]),
        (vec![&flat], 1, ["flat.nii", "same value"]),
        (vec![a, b, "--labels", &other], 1, ["other.nii: does not overlap", "frame_000.nii.gz"]),
        (vec!["truth_001.nii.gz"], 1, ["truth_001.nii.gz", "series of scalar volumes"]),
    ] {
        let all = [&["track"], &arguments[..], &["-o", &out]].concat();
        let (said, err) = run(&all, code);
        assert!(said.is_empty(), "{said}");
        parts.iter().for_each(|p| assert!(err.contains(p), "should say {p:?}: {err}"));
        assert!(!Path::new(&out).exists());
    }
}

#[test]
fn a_blank_file_among_others_is_lost_and_they_go_on() {
    let folder = TempDir::new().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_string();
    let [blank, nothing, out] = ["blank.nii", "nothing.nii", "out"].map(path);
    fs::write(&blank, Nifti::filled([28, 34, 26], 7.0).bytes()).unwrap();
    fs::write(&nothing, Nifti::filled([28, 34, 26], f32::NAN).bytes()).unwrap();
    let (a, b) = ("frame_000.nii.gz", "frame_001.nii.gz");
    let (said, err) = run(&["track", a, &blank, b, &nothing, "-o", &out], 0);
    assert!(said.contains("1 of 3 frames measured against frame 0; 2 lost"), "{said}");
    assert!(err.contains("frame 1: the deformed volume is constant") && err.contains("frame 3"), "{err}");
    let names = |dir: &str| fs::read_dir(dir).unwrap().map(|e| e.unwrap().file_name()).collect::<Vec<_>>();
    assert!(
        names(&out).contains(&"displacement_002.nii.gz".into()) && !names(&out).contains(&"strain_001.nii.gz".into())
    );
    let (_, err) = run(&["track", a, &blank, &nothing, "-o", &path("none")], 1);
    assert!(err.contains("no volume can be measured against frame_000.nii.gz"), "{err}");
    // Alone it is what cannot be measured, and is named; so is a reference.
    for arguments in [vec!["track", a, &blank], vec!["track", &blank, a, b]] {
        let (_, err) = run(&[&arguments[..], &["-o", &path("none")]].concat(), 1);
        assert!(err.contains("blank.nii: every voxel has the same value"), "{err}");
    }
}

#[test]
fn a_second_run_leaves_no_frame_of_the_first() {
    let folder = TempDir::new().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_string();
    let [blank, out, notes] = ["blank.nii", "out", "out/strain_notes.txt"].map(path);
    fs::write(&blank, Nifti::filled([28, 34, 26], 7.0).bytes()).unwrap();
    let (a, b, c) = ("frame_000.nii.gz", "frame_001.nii.gz", "frame_002.nii.gz");
    run(&["track", a, b, c, "-o", &out], 0);
    fs::write(&notes, "mine").unwrap();
    run(&["track", a, &blank, b, "-o", &out, "--force"], 0);
    let is_there = |name: &str| Path::new(&out).join(name).exists();
    for name in ["displacement_001.nii.gz", "strain_001.nii.gz", "matches_001.csv"] {
        assert!(!is_there(name), "{name} is of the first run");
    }
    assert!(is_there("displacement_002.nii.gz") && is_there("displacement_000.nii.gz") && is_there("strain_notes.txt"));
    run(&["track", a, b, "-o", &out, "--force"], 0);
    assert!(is_there("displacement_001.nii.gz") && !is_there("displacement_002.nii.gz"));
}

#[test]
fn a_shells_order_and_labels_outside_the_mask_are_said() {
    let folder = TempDir::new().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_string();
    let named = ["f_0.nii.gz", "f_1.nii.gz", "f_10.nii.gz", "f_2.nii.gz"].map(path);
    for (from, to) in frames().iter().zip(&named) {
        fs::copy(pinch().join(from), to).unwrap();
    }
    let out = path("out");
    let dry = |files: &[&str], more: &[&str]| run(&[&["track"], files, more, &["--dry-run", "-o", &out]].concat(), 0).1;
    let [f0, f1, f10, f2] = named.each_ref().map(String::as_str);
    assert!(dry(&[f0, f1, f10, f2], &[]).contains("f_10.nii.gz comes before f_2.nii.gz"));
    for files in [[f0, f1, f2, f10], [f10, f2, f1, f0]] {
        assert!(!dry(&files, &[]).contains("comes before"));
    }
    let labels = io::read_labels(pinch().join("labels.nii.gz")).unwrap();
    let grid = *labels.grid();
    let half = grid.shape()[0] / 2;
    let mask =
        palpate::types::Mask::from_voxels(grid, |o, _| u8::from(labels.as_slice()[o] > 0 && grid.voxel(o)[0] < half));
    let mask_file = path("mask.nii.gz");
    io::write_labels(&mask_file, &mask, "").unwrap();
    let with = |mask: &str| dry(&[f0, f1], &["--mask", mask, "--labels", "labels.nii.gz"]);
    assert!(with(&mask_file).contains("outside the mask: label 1 ("), "{}", with(&mask_file));
    assert!(!with("mask.nii.gz").contains("outside the mask"));
}

#[test]
fn a_dry_run_tells_what_would_be_lost_and_refuses_what_a_run_does() {
    let folder = TempDir::new().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_string();
    let [far, blank, slice, out] = ["far.nii", "blank.nii", "slice.nii", "out"].map(path);
    let mut away = Nifti::ramp([28, 34, 26]);
    away.sform[0][3] = 5000.0;
    fs::write(&far, away.bytes()).unwrap();
    fs::write(&blank, Nifti::filled([28, 34, 26], 7.0).bytes()).unwrap();
    let (a, b) = ("frame_000.nii.gz", "frame_001.nii.gz");
    fs::write(&slice, Nifti::ramp([28, 34, 1]).bytes()).unwrap();
    let (plan, err) = run(&["track", a, &blank, b, &far, &slice, "--dry-run", "-o", &out], 0);
    assert!(
        plan.contains("Would measure 4 volumes against number 0") && plan.contains("Nothing was written"),
        "{plan}"
    );
    let lost = [
        "frame 1 would be lost: the deformed volume is constant",
        "frame 3 would be lost: the two volumes do not overlap",
        "frame 4 would be lost: the deformed volume is one slice",
    ];
    lost.iter().for_each(|part| assert!(err.contains(part), "should say {part:?}: {err}"));
    for more in [&[][..], &["--dry-run"]] {
        let (_, err) = run(&[&["track", a, &far, &far, "-o", &out][..], more].concat(), 1);
        assert!(err.contains("no volume can be measured against frame_000.nii.gz") && err.contains("overlap"), "{err}");
    }
}

#[test]
fn a_series_in_two_places_is_said_to_be() {
    let folder = TempDir::new().unwrap();
    let (path, out) = (folder.path().join("twice.nii"), folder.path().join("out").display().to_string());
    let mut bytes = series(false);
    bytes[252..254].copy_from_slice(&1i16.to_le_bytes()); // a qform too: unturned
    bytes[268..272].copy_from_slice(&50f32.to_le_bytes()); // and 50 mm off along x
    fs::write(&path, bytes).unwrap();
    let (plan, err) = run(&["track", path.to_str().unwrap(), "-o", &out, "--dry-run"], 0);
    assert!(plan.contains("Nothing was written"), "{plan}");
    assert!(err.contains("twice.nii") && err.contains("sform and qform disagree"), "{err}");
    assert_eq!(err.matches("disagree").count(), 1, "{err}");
}

#[test]
fn a_sequence_takes_no_motion_of_a_pair() {
    let (_, err) = run(&["phantom", "pinch", "--motion", "press", "-o", "never"], 2);
    assert!(err.contains("--motion"), "{err}");
    let (_, err) = run(&["phantom", "pinhc", "-o", "never"], 2);
    assert!(err.contains("pinch") && err.contains("calf"), "{err}");
    let (_, err) = run(&["phantom", "pen", "--amplitude", "40", "-o", "never"], 1);
    assert!(err.contains("amplitude"), "{err}");
}

#[test]
fn numbers_out_of_range_are_wrong_usage_in_every_command() {
    let (a, b) = ("frame_000.nii.gz", "frame_001.nii.gz");
    for (arguments, says) in [
        (&["phantom", "pinch", "--frames", "1"][..], "frames is 1"),
        (&["phantom", "pinch", "--size", "4"], "size is 4"),
        (&["phantom", "pinch", "--noise", "2"], "noise is 2"),
        (&["phantom", "calf", "--motion", "elastic"], "fingertip, inclusion or slab"),
        (&["track", a, b, "--points", "3"], "points is 3"),
    ] {
        let (_, err) = run(&[arguments, &["-o", "never"]].concat(), 2);
        assert!(err.contains(says), "should say {says:?}: {err}");
    }
}

#[test]
fn a_phantom_refuses_flags_that_mean_nothing_for_it() {
    for (arguments, flag) in [
        (&["calf", "--frames", "5"][..], "--frames belongs to a sequence"),
        (&["pinch", "--contrast", "4"], "--contrast belongs to"),
        (&["pen", "--poisson", "0.4"], "--poisson belongs to"),
        (&["slab", "--contrast", "4"], "--contrast belongs to"),
        (&["fingertip", "--inclusions", "2"], "--inclusions belongs to"),
        (&["inclusion", "--motion", "press", "--poisson", "0.4"], "--poisson belongs to"),
        (&["inclusion", "--inclusions", "2", "--contrast", "4"], "--contrast belongs to one inclusion"),
    ] {
        let (_, err) = run(&[&["phantom"], arguments, &["-o", "never"]].concat(), 2);
        assert!(err.contains(flag), "should say {flag:?}: {err}");
    }
    let folder = TempDir::new().unwrap();
    let out = folder.path().join("pair").display().to_string();
    // What an inclusion looks like goes by its stiffness in every motion.
    let line = "phantom inclusion --size 16 --motion press --amplitude 1 --contrast 0.5 -o";
    run(&line.split(' ').chain([out.as_str()]).collect::<Vec<_>>(), 0);
}
