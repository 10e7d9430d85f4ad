//! `palpate batch`: tables with flaws, pairs that fail beside pairs that do not, and taking up
//! where a run ended.

use crate::fixtures::{palpate, run, small_pair};
use serde_json::Value;
use std::fs;
use std::path::Path;
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// A folder with a small pair and a table of these lines.
fn folder(lines: &[&str]) -> TempDir {
    let folder = small_pair();
    table(folder.path(), lines);
    folder
}

fn table(folder: &Path, lines: &[&str]) {
    fs::write(folder.join("pairs.csv"), lines.join("\n") + "\n").unwrap();
}

const FAST: [&str; 6] = ["batch", "pairs.csv", "-o", "out", "--preset", "fast"];

/// The rows of a table in `folder` by column name.
fn rows(folder: &Path, name: &str) -> Vec<std::collections::HashMap<String, String>> {
    let text = fs::read_to_string(folder.join(name)).unwrap();
    csv::Reader::from_reader(text.as_bytes()).deserialize().map(|r| r.unwrap()).collect()
}

fn statuses(folder: &Path) -> Vec<String> {
    rows(folder, "out/batch.csv").iter().map(|r| format!("{} {}", r["name"], r["status"])).collect()
}

#[test]
fn a_bids_folder_gives_pairs_by_run_or_session_and_derivatives() {
    let folder = small_pair();
    let at = |name: &str| folder.path().join(name);
    let put = |from: &str, to: &str| {
        let place = at("bids").join(to);
        fs::create_dir_all(place.parent().unwrap()).unwrap();
        fs::copy(at(from), place).unwrap();
    };
    // Runs are numbers: 10 comes after 9. A subject seen once has no pair; another kind is one of its own.
    put("initial.nii.gz", "sub-01/anat/sub-01_run-9_T1w.nii.gz");
    put("deformed.nii.gz", "sub-01/anat/sub-01_run-10_T1w.nii.gz");
    put("initial.nii.gz", "sub-01/anat/sub-01_T2w.nii.gz");
    put("initial.nii.gz", "sub-02/ses-1/anat/sub-02_ses-1_acq-hand_T2w.nii.gz");
    put("deformed.nii.gz", "sub-02/ses-2/anat/sub-02_ses-2_acq-hand_T2w.nii.gz");
    let (_, err) = run(folder.path(), &["batch", "bids", "-o", "none"], 1);
    assert!(err.contains("bids"), "{err}");
    fs::write(at("bids/dataset_description.json"), r#"{"Name": "hands", "BIDSVersion": "1.8.0"}"#).unwrap();
    run(folder.path(), &["batch", "bids", "-o", "out", "--preset", "fast"], 0);
    assert_eq!(statuses(folder.path()), ["sub-01_run-10_T1w done", "sub-02_ses-2_acq-hand_T2w done"]);
    for (name, pair) in [
        ("sub-01/anat/sub-01_from-run10_to-run9_mode-image_desc-T1w_xfm", "sub-01_run-10_T1w"),
        ("sub-02/anat/sub-02_acq-hand_from-ses2_to-ses1_mode-image_desc-T2w_xfm", "sub-02_ses-2_acq-hand_T2w"),
    ] {
        let field = fs::read(at(&format!("out/pairs/{pair}/field/displacement.nii.gz"))).unwrap();
        assert!(fs::read(at(&format!("out/{name}.nii.gz"))).unwrap() == field, "{name}");
        let sidecar = fs::read_to_string(at(&format!("out/{name}.json"))).unwrap();
        assert!(sidecar.contains("bids:raw:sub-0"), "{sidecar}");
    }
    let description = fs::read_to_string(at("out/dataset_description.json")).unwrap();
    assert!(description.contains("\"derivative\"") && description.contains("palpate: hands"), "{description}");
    let page = fs::read_to_string(at("out/report.html")).unwrap();
    assert!(page.contains("href=\"pairs/sub-01_run-10_T1w/field/report.html\""));
    run(folder.path(), &["batch", "bids", "-o", "out", "--preset", "fast"], 0);
    assert_eq!(statuses(folder.path()), ["sub-01_run-10_T1w skipped", "sub-02_ses-2_acq-hand_T2w skipped"]);

    // A field that cannot be measured any more leaves no derivative of the earlier one.
    fs::write(at("bids/sub-01/anat/sub-01_run-10_T1w.nii.gz"), "no volume").unwrap();
    run(folder.path(), &["batch", "bids", "-o", "out", "--preset", "fast"], 1);
    assert!(!at("out/sub-01/anat/sub-01_from-run10_to-run9_mode-image_desc-T1w_xfm.nii.gz").exists());
    assert!(at("out/sub-02/anat/sub-02_acq-hand_from-ses2_to-ses1_mode-image_desc-T2w_xfm.nii.gz").exists());

    // Masks are no images, and two files are no two runs.
    put("mask.nii.gz", "sub-02/ses-1/anat/sub-02_ses-1_run-1_mod-T2w_defacemask.nii.gz");
    put("mask.nii.gz", "sub-02/ses-1/anat/sub-02_ses-1_run-2_mod-T2w_defacemask.nii.gz");
    run(folder.path(), &["batch", "bids", "-o", "out", "--collect"], 1);
    assert_eq!(statuses(folder.path()), ["sub-01_run-10_T1w failed", "sub-02_ses-2_acq-hand_T2w done"]);
    assert!(rows(folder.path(), "out/batch.csv")[0]["reason"].contains("other inputs"));
    put("initial.nii.gz", "sub-01/anat/sub-01_run-09_T1w.nii.gz");
    let (_, err) = run(folder.path(), &["batch", "bids", "-o", "o"], 1);
    assert!(err.contains("sub-01_run-9_T1w.nii.gz") && err.contains("same run"), "{err}");

    // A description that is cut short, empty or without its key.
    for text in [r#"{"Name": "ha"#, "", r#"{"Nam": "hands"}"#, "[1, 2]"] {
        fs::write(at("bids/dataset_description.json"), text).unwrap();
        let (_, err) = run(folder.path(), &["batch", "bids", "-o", "o"], 1);
        assert!(err.contains("dataset_description.json"), "{err}");
        assert!(!at("o").exists());
    }
    fs::write(at("bids/dataset_description.json"), r#"{"Name": "hands"}"#).unwrap();

    // No subject with two images: said, with what to do.
    fs::create_dir_all(at("one")).unwrap();
    fs::copy(at("bids/dataset_description.json"), at("one/dataset_description.json")).unwrap();
    let (_, err) = run(folder.path(), &["batch", "one", "-o", "o"], 1);
    assert!(err.contains("no subject has two runs") && err.contains("run-1"), "{err}");
}

#[test]
fn a_pair_that_fails_stops_no_other_and_a_second_run_only_does_what_is_left() {
    let folder = folder(&[
        "name,initial,deformed,mask",
        "good,initial.nii.gz,deformed.nii.gz,mask.nii.gz",
        "lost,initial.nii.gz,nowhere.nii.gz,",
        "broken,initial.nii.gz,broken.nii.gz,",
        "plain,initial.nii.gz,deformed.nii.gz,",
    ]);
    fs::write(folder.path().join("broken.nii.gz"), "no volume").unwrap();
    let (_, err) = run(folder.path(), &FAST, 1);
    assert!(err.contains("2 of 4 pairs failed") && err.contains("nowhere.nii.gz"), "{err}");
    assert_eq!(statuses(folder.path()), ["good done", "lost failed", "broken failed", "plain done"]);
    let found = rows(folder.path(), "out/batch.csv");
    assert!(found[1]["reason"].contains("nowhere.nii.gz") && found[1]["reason"].contains("No such file"), "{found:?}");
    assert!(found[2]["reason"].contains("broken.nii.gz"), "{found:?}");
    let summary: Value =
        serde_json::from_slice(&fs::read(folder.path().join("out/good/field/summary.json")).unwrap()).unwrap();
    assert_eq!(found[0]["displacement_mean_mm"], summary["displacement_mean_mm"].to_string());
    assert_eq!(found[0]["kept"], summary["counts"]["kept"].to_string());
    let page = fs::read_to_string(folder.path().join("out/report.html")).unwrap();
    assert!(page.contains("What failed") && page.contains("nowhere.nii.gz"));

    // The same alone, bit for bit.
    let alone =
        ["field", "initial.nii.gz", "deformed.nii.gz", "--mask", "mask.nii.gz", "--preset", "fast", "-o", "alone"];
    run(folder.path(), &alone, 0);
    let bytes = |path: &str| fs::read(folder.path().join(path)).unwrap();
    assert!(bytes("alone/displacement.nii.gz") == bytes("out/good/field/displacement.nii.gz"));

    // What is done stays; what was missing is there now.
    fs::copy(folder.path().join("deformed.nii.gz"), folder.path().join("nowhere.nii.gz")).unwrap();
    fs::copy(folder.path().join("deformed.nii.gz"), folder.path().join("broken.nii.gz")).unwrap();
    let before = fs::metadata(folder.path().join("out/good/field/displacement.nii.gz")).unwrap().modified().unwrap();
    run(folder.path(), &FAST, 0);
    assert_eq!(statuses(folder.path()), ["good skipped", "lost done", "broken done", "plain skipped"]);
    let after = fs::metadata(folder.path().join("out/good/field/displacement.nii.gz")).unwrap().modified().unwrap();
    assert_eq!(before, after);

    // Another mask is another pair, other parameters make all of them anew.
    fs::copy(folder.path().join("truth.nii.gz"), folder.path().join("old.nii.gz")).unwrap();
    let mask = palpate::io::read_mask(folder.path().join("mask.nii.gz")).unwrap();
    let less = palpate::types::Mask::from_voxels(*mask.grid(), |o, _| mask.as_slice()[o] * u8::from(o % 31 < 28));
    palpate::io::write_labels(folder.path().join("mask.nii.gz"), &less, "").unwrap();
    run(folder.path(), &FAST, 0);
    assert_eq!(statuses(folder.path()), ["good done", "lost skipped", "broken skipped", "plain skipped"]);
    run(folder.path(), &[&FAST[..], &["--seed", "7"]].concat(), 0);
    assert!(statuses(folder.path()).iter().all(|s| s.ends_with(" done")));
}

#[test]
fn flaws_of_a_table_are_named_with_their_line() {
    let good = "initial.nii.gz,deformed.nii.gz";
    let cases: [(&[&str], &str); 9] = [
        (&["initial,deformd", good], "did you mean 'deformed'"),
        (&["initial,deformed,colour", &format!("{good},red")], "unknown key 'colour'"),
        (&["initial,deformed"], "no pair"),
        (&["initial,deformed,name", &format!("{good},a"), &format!("{good},a")], "line 3: a is the name of line 2 too"),
        (&["initial,deformed,force_n", &format!("{good},-3")], "line 2: force_n is \"-3\""),
        (&["initial,deformed,name", &format!("{good},a/b")], "cannot name a folder"),
        (&["initial,deformed,name", &format!("{good},batch.csv")], "line 2: \"batch.csv\" is the name of a file"),
        (&["initial,deformed", ",deformed.nii.gz"], "line 2: there is no initial volume"),
        (&["initial,deformed,mask", good], "line 2: 2 values"),
    ];
    for (lines, message) in cases {
        let folder = folder(lines);
        let (_, err) = run(folder.path(), &FAST, 1);
        assert!(err.contains("pairs.csv") && err.contains(message), "{lines:?}: {err}");
        assert!(!folder.path().join("out").exists());
    }
}

#[test]
fn names_come_from_subject_and_session_and_paths_count_from_the_table() {
    let folder = small_pair();
    fs::create_dir(folder.path().join("lists")).unwrap();
    let lines = "subject,session,initial,deformed\n01,pre,../initial.nii.gz,../deformed.nii.gz\nsub-02,,../initial.nii.gz,../deformed.nii.gz\n";
    fs::write(folder.path().join("lists/pairs.csv"), lines).unwrap();
    run(folder.path(), &["batch", "lists/pairs.csv", "-o", "out", "--preset", "fast", "--jobs", "1"], 0);
    assert_eq!(statuses(folder.path()), ["sub-01_ses-pre done", "sub-02 done"]);
    assert_eq!(rows(folder.path(), "out/batch.csv")[0]["session"], "pre");
}

#[test]
fn a_pair_past_the_memory_is_refused_and_the_others_run() {
    let folder = folder(&["initial,deformed,name", "initial.nii.gz,deformed.nii.gz,small", "big.nii,big.nii,big"]);
    let mut big = crate::fixtures::Nifti::ramp([100, 100, 60]);
    big.datatype = 16;
    fs::write(folder.path().join("big.nii"), big.bytes()).unwrap();
    let (_, err) = run(folder.path(), &[&FAST[..], &["--memory", "0.02"]].concat(), 1);
    assert!(err.contains("big failed at check: needs about"), "{err}");
    assert_eq!(statuses(folder.path()), ["small done", "big failed"]);
    run(folder.path(), &[&FAST[..], &["--memory", "-1"]].concat(), 2);
}

#[test]
fn a_folder_with_something_else_is_left_alone() {
    let folder = folder(&["initial,deformed", "initial.nii.gz,deformed.nii.gz"]);
    fs::create_dir(folder.path().join("out")).unwrap();
    fs::write(folder.path().join("out/mine.txt"), "mine").unwrap();
    let (_, err) = run(folder.path(), &FAST, 1);
    assert!(err.contains("not a batch") && err.contains("--overwrite"), "{err}");
    assert_eq!(fs::read_dir(folder.path().join("out")).unwrap().count(), 1);
    run(folder.path(), &[&FAST[..], &["--force"]].concat(), 0);
}

/// Whether a process works in `folder`, as far as the system tells.
fn worked_in(folder: &Path) -> bool {
    let Ok(processes) = fs::read_dir("/proc") else { return false };
    let folder = folder.canonicalize().unwrap();
    processes.flatten().any(|p| fs::read_link(p.path().join("cwd")).is_ok_and(|at| at == folder))
}

#[test]
fn a_killed_run_is_taken_up() {
    let lines: Vec<String> = (0..4).map(|i| format!("p{i},initial.nii.gz,deformed.nii.gz")).collect();
    let lines: Vec<&str> = std::iter::once("name,initial,deformed").chain(lines.iter().map(String::as_str)).collect();
    let folder = folder(&lines);
    let arguments = ["batch", "pairs.csv", "-o", "out", "--jobs", "1", "--quiet"];
    let program = assert_cmd::cargo::cargo_bin!("palpate");
    let mut child = std::process::Command::new(program).current_dir(folder.path()).args(arguments).spawn().unwrap();
    // After the first pair's record, before the last one's.
    let (first, last) =
        (folder.path().join("out/p0/field/summary.json"), folder.path().join("out/p3/field/summary.json"));
    let started = Instant::now();
    // Its own files in the folder are whole by then: what is killed itself cannot take its own
    // away.
    while !folder.path().join("out/p1/pair.json").exists() && started.elapsed() < Duration::from_secs(120) {
        std::thread::sleep(Duration::from_millis(2));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(first.exists() && !last.exists(), "the run was killed too early or too late");
    assert!(statuses(folder.path()).contains(&"p3 waiting".into()));
    // Its stages end with it, and leave nothing half-written.
    let killed = Instant::now();
    while worked_in(folder.path()) {
        assert!(killed.elapsed() < Duration::from_secs(2), "a stage goes on");
        std::thread::sleep(Duration::from_millis(2));
    }
    let left: Vec<_> = fs::read_dir(folder.path().join("out/p1")).unwrap().map(|f| f.unwrap().file_name()).collect();
    assert!(left.iter().all(|name| !name.to_string_lossy().starts_with('.')), "{left:?}");
    palpate(folder.path()).args(arguments).assert().success();
    let found = statuses(folder.path());
    assert_eq!((found[0].as_str(), found[3].as_str()), ("p0 skipped", "p3 done"));
    assert!(found.iter().all(|s| s.ends_with("done") || s.ends_with("skipped")), "{found:?}");
}

#[test]
fn the_whole_chain_runs_and_is_gathered() {
    let folder = TempDir::new().unwrap();
    run(folder.path(), &["phantom", "fingertip", "--size", "28", "--seed", "2", "--amplitude", "1.5", "-o", "pad"], 0);
    let told: Value = serde_json::from_slice(&fs::read(folder.path().join("pad/phantom.json")).unwrap()).unwrap();
    let elastic = &told["elastic"];
    let names: Vec<String> = elastic["regions"]
        .as_array()
        .unwrap()
        .iter()
        .map(|r| format!("{}={}", r["label"], r["name"].as_str().unwrap()))
        .collect();
    let scene = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/finger_pad.toml");
    let line = |s: &str| {
        format!(
            "{s},pad/initial.nii.gz,pad/deformed.nii.gz,pad/mask.nii.gz,pad/labels.nii.gz,{},{},{},{},{}",
            names.join(";"),
            elastic["held"].as_str().unwrap(),
            elastic["load"].as_str().unwrap(),
            elastic["force_n"],
            scene.display()
        )
    };
    let header = "subject,initial,deformed,mask,labels,names,held,load,force_n,scene";
    table(folder.path(), &[header, &line("1"), &line("2")]);
    run(folder.path(), &["batch", "pairs.csv", "-o", "out", "--nodes", "1500"], 0);
    let found = rows(folder.path(), "out/batch.csv");
    assert!(
        found.iter().all(|r| r["status"] == "done" && r["fingertip_kpa"].parse::<f64>().unwrap() > 0.0),
        "{found:?}"
    );
    let regions = rows(folder.path(), "out/regions.csv");
    assert_eq!(regions.len(), 2 * names.len());
    assert!(regions.iter().all(|r| r["unit"] == "kPa"));
    let page = fs::read_to_string(folder.path().join("out/report.html")).unwrap();
    let known = regions.iter().filter(|r| r["state"] != "unknown");
    assert_eq!(page.matches("<circle").count(), known.clone().count());
    assert!(known.clone().count() >= 4 && known.clone().all(|r| r["youngs_modulus"].parse::<f64>().unwrap() > 0.0));
    let tables = |name: &str| fs::read_to_string(folder.path().join("out").join(name)).unwrap();
    let before = tables("regions.csv");
    run(folder.path(), &["batch", "pairs.csv", "-o", "out", "--nodes", "1500", "--collect"], 0);
    assert_eq!(before, tables("regions.csv"));
    fs::remove_file(folder.path().join("out/sub-2/grasp/summary.json")).unwrap();
    let (_, err) = run(folder.path(), &["batch", "pairs.csv", "-o", "out", "--nodes", "1500", "--collect"], 1);
    assert!(err.contains("sub-2 failed at grasp: there is no "), "{err}");
    run(folder.path(), &["batch", "pairs.csv", "-o", "out", "--nodes", "1500"], 0);
    assert_eq!(statuses(folder.path()), ["sub-1 skipped", "sub-2 done"]);
}

/// Results stood for other parameters than their table asked for: a changed --config or detached
/// file of voxels was not seen.
#[test]
fn what_a_pair_was_made_from_is_seen_to_change() {
    let folder = folder(&["name,initial,deformed", "one,initial.nhdr,deformed.nii.gz"]);
    let at = |name: &str| folder.path().join(name);
    let volume = palpate::io::read_volume(at("initial.nii.gz")).unwrap();
    let raw: Vec<u8> = volume.as_slice().iter().flat_map(|v| v.to_le_bytes()).collect();
    fs::write(at("initial.raw"), &raw).unwrap();
    let (g, rows) = (volume.grid().shape(), volume.grid().affine().rows());
    let axis = |a: usize| format!("({},{},{})", rows[0][a], rows[1][a], rows[2][a]);
    let head = format!(
        "NRRD0004\ntype: float\ndimension: 3\nspace: right-anterior-superior\nsizes: {} {} {}\nspace directions: {} {} {}\n\
         endian: little\nencoding: raw\nspace origin: {}\ndata file: initial.raw\n\n",
        g[0],
        g[1],
        g[2],
        axis(0),
        axis(1),
        axis(2),
        axis(3)
    );
    fs::write(at("initial.nhdr"), head).unwrap();
    let config = |preset: &str| fs::write(at("c.toml"), format!("preset = \"{preset}\"\n")).unwrap();
    config("fast");
    let again = || {
        run(folder.path(), &["batch", "pairs.csv", "-o", "out", "--config", "c.toml"], 0);
        statuses(folder.path())
    };
    assert_eq!(again(), ["one done"]);
    assert_eq!(again(), ["one skipped"]);
    std::thread::sleep(Duration::from_millis(20));
    config("accurate");
    assert_eq!(again(), ["one done"]);
    std::thread::sleep(Duration::from_millis(20));
    fs::write(at("initial.raw"), &raw).unwrap();
    assert_eq!(again(), ["one done"]);
    // One that fails when it is run again is not done because older results stand there.
    let deformed = fs::read(at("deformed.nii.gz")).unwrap();
    fs::write(at("deformed.nii.gz"), &deformed[..deformed.len() / 2]).unwrap();
    run(folder.path(), &["batch", "pairs.csv", "-o", "out", "--config", "c.toml"], 1);
    run(folder.path(), &["batch", "pairs.csv", "-o", "out", "--config", "c.toml", "--collect"], 1);
    assert_eq!(statuses(folder.path()), ["one failed"]);
}

#[test]
fn what_a_later_stage_would_refuse_is_found_before_the_first_one_runs() {
    let folder = folder(&[
        "name,initial,deformed,labels,held,load,scene",
        "grid,initial.nii.gz,deformed.nii.gz,other.nii,,,",
        "fraction,initial.nii.gz,deformed.nii.gz,half.nii,,,",
        "empty,initial.nii.gz,deformed.nii.gz,none.nii,,,",
        "patch,initial.nii.gz,deformed.nii.gz,mask.nii.gz,other.nii,y+,",
        "scene,initial.nii.gz,deformed.nii.gz,mask.nii.gz,y-,y+,absent.toml",
    ]);
    let at = |name: &str| folder.path().join(name);
    let grid = *palpate::io::read_volume(at("initial.nii.gz")).unwrap().grid();
    let far = palpate::types::Affine::scaled([1.0; 3], [5000.0; 3]).unwrap();
    let far = palpate::types::Grid::new([20; 3], far).unwrap();
    palpate::io::write_labels(at("other.nii"), &palpate::types::Mask::filled(far, 1), "").unwrap();
    for (name, value) in [("half.nii", 0.5), ("none.nii", 0.0)] {
        palpate::io::write_volume(at(name), &palpate::types::Volume::from_voxels(grid, |_, _| value), "").unwrap();
    }
    run(folder.path(), &FAST, 1);
    for row in rows(folder.path(), "out/batch.csv") {
        assert_eq!((row["status"].as_str(), row["stage"].as_str()), ("failed", "check"), "{row:?}");
        assert!(!at("out").join(&row["name"]).exists(), "{row:?}");
    }
    let reasons: Vec<String> = rows(folder.path(), "out/batch.csv").into_iter().map(|r| r["reason"].clone()).collect();
    for (reason, part) in
        reasons.iter().zip(["other.nii: does not overlap", "0.5", "no voxel has a label", "other.nii", "absent.toml"])
    {
        assert!(reason.contains(part), "{part}: {reason}");
    }
}

#[test]
fn a_second_run_tells_the_seconds_that_the_results_took_and_their_trust() {
    let folder = folder(&["name,initial,deformed", "one,initial.nii.gz,deformed.nii.gz"]);
    run(folder.path(), &FAST, 0);
    let first = rows(folder.path(), "out/batch.csv");
    for more in [&[][..], &["--collect"]] {
        run(folder.path(), &[&FAST[..], more].concat(), 0);
        let again = rows(folder.path(), "out/batch.csv");
        assert_eq!(first[0]["seconds"], again[0]["seconds"]);
        assert_eq!(first[0]["trust"], again[0]["trust"]);
    }
    assert!(first[0]["seconds"].parse::<f64>().unwrap() > 0.0);
    assert!(["high", "moderate", "low"].contains(&first[0]["trust"].as_str()), "{first:?}");
}

#[test]
fn two_batches_do_not_write_into_one_folder_at_a_time() {
    let folder = folder(&["name,initial,deformed", "one,initial.nii.gz,deformed.nii.gz"]);
    let out = folder.path().join("out");
    fs::create_dir(&out).unwrap();
    let _held = palpate::io::hold(&out).unwrap();
    let (_, err) = run(folder.path(), &FAST, 1);
    assert!(err.contains("out") && err.contains("another run"), "{err}");
}
