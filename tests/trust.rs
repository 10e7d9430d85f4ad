//! What docs/explanation/trust.md promises of files, limits and repeated runs: killed, stopped, out of time,
//! memory and permission.
#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used)]

mod fixtures;

use fixtures::{run, small_pair, text};
use palpate::numerics::random::Random;
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

const FIELD: [&str; 6] = ["field", "initial.nii.gz", "deformed.nii.gz", "-o", "results", "--force"];

fn start(folder: &Path, arguments: &[&str]) -> Child {
    let program = assert_cmd::cargo::cargo_bin!("palpate");
    let mut command = Command::new(program);
    command.current_dir(folder).args(arguments).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command.spawn().unwrap()
}

/// Runs the program from a shell after `first`.
fn shell(folder: &Path, first: &str, arguments: &str) -> Output {
    let program = assert_cmd::cargo::cargo_bin!("palpate");
    let script = format!("{first}; exec '{}' {arguments}", program.display());
    Command::new("sh").current_dir(folder).args(["-c", &script]).output().unwrap()
}

/// The files of a folder by name; hidden ones with `hidden`.
fn files(folder: &Path, hidden: bool) -> BTreeMap<String, Vec<u8>> {
    let entries = fs::read_dir(folder).into_iter().flatten().map(Result::unwrap);
    let named = entries.map(|e| (e.file_name().into_string().unwrap(), e.path()));
    named.filter(|(n, _)| hidden || !n.starts_with('.')).map(|(n, p)| (n, fs::read(p).unwrap_or_default())).collect()
}

/// Without what tells the time.
fn timeless(mut files: BTreeMap<String, Vec<u8>>) -> BTreeMap<String, Vec<u8>> {
    files.remove("summary.json");
    files.remove("report.html");
    files
}

fn signal(child: &Child, name: &str) {
    assert!(Command::new("kill").args([name, &child.id().to_string()]).status().unwrap().success());
}

#[test]
fn killed_at_50_random_times_results_are_whole_or_the_earlier_ones() {
    let folder = small_pair();
    let started = Instant::now();
    run(folder.path(), &FIELD, 0);
    let whole = started.elapsed();
    let results = folder.path().join("results");
    let usual = timeless(files(&results, false));
    // An earlier result that can be told from a new one.
    let earlier: BTreeMap<String, Vec<u8>> =
        files(&results, false).into_keys().map(|n| (n, b"earlier".into())).collect();
    let mut random = Random::new(5, 1);
    let (mut cut, mut done) = (0, 0);
    for turn in 0..50 {
        let with_earlier = turn % 2 == 1;
        fs::remove_dir_all(&results).ok();
        if with_earlier {
            fs::create_dir(&results).unwrap();
            earlier.iter().for_each(|(n, bytes)| fs::write(results.join(n), bytes).unwrap());
        }
        let mut child = start(folder.path(), &FIELD);
        sleep(whole.mul_f64(random.uniform(0.0, 1.2)));
        child.kill().unwrap();
        child.wait().unwrap();
        let left = files(&results, false);
        for (name, bytes) in timeless(left.clone()) {
            assert!(bytes == b"earlier" || bytes == usual[&name], "turn {turn}: {name} is neither whole nor earlier");
        }
        if with_earlier {
            assert_eq!(left.len(), earlier.len(), "turn {turn}: a result is gone");
        }
        let new = left.values().filter(|b| *b != b"earlier").count();
        if new == earlier.len() { done += 1 } else { cut += 1 }
    }
    assert!(cut > 5 && done > 0, "{cut} cut short, {done} done");
}

#[test]
fn a_signal_stops_within_a_second_and_leaves_nothing() {
    let folder = small_pair();
    for (name, code) in [("-INT", 130), ("-TERM", 143)] {
        let slow = ["phantom", "fingertip", "--size", "96", "-o", "new/slow"];
        let mut child = start(folder.path(), &slow);
        // Until the folder for the results is there.
        let begun = Instant::now();
        while !folder.path().join("new/slow").exists() && begun.elapsed() < Duration::from_secs(60) {
            sleep(Duration::from_millis(5));
        }
        signal(&child, name);
        let asked = Instant::now();
        let status = child.wait().unwrap();
        assert!(asked.elapsed() < Duration::from_secs(1), "{:?} after {name}", asked.elapsed());
        assert_eq!(status.code(), Some(code));
        assert!(!folder.path().join("new").exists(), "{name} left the folder");
    }
}

#[test]
fn a_time_limit_stops_with_a_reason() {
    let folder = small_pair();
    let slow = ["phantom", "fingertip", "--size", "96", "-o", "slow", "--timeout", "0.3"];
    let (out, err) = run(folder.path(), &slow, 1);
    assert!(out.is_empty() && err.contains("--timeout") && err.contains("0.3 s"), "{out}{err}");
    assert!(!folder.path().join("slow").exists());
    for wrong in ["0", "-3", "soon", "NaN"] {
        run(folder.path(), &["info", "initial.nii.gz", "--timeout", wrong], 2);
    }
    run(folder.path(), &["info", "initial.nii.gz", "--timeout", "600"], 0);
}

#[test]
fn too_little_memory_is_refused_before_the_voxels_are_read() {
    let folder = small_pair();
    let stiffness = "stiffness --field truth.nii.gz --mask mask.nii.gz --nodes 400000 -o stiff";
    let output = shell(folder.path(), "ulimit -v 6000000", stiffness);
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("of memory") && said.contains("--nodes "), "{said}");
    assert!(!folder.path().join("stiff").exists());
    // The nodes that it names do fit.
    let nodes: usize = said.split("--nodes ").nth(1).unwrap().split(',').next().unwrap().parse().unwrap();
    assert!((500..400_000).contains(&nodes), "{said}");

    run(folder.path(), &["phantom", "block", "--size", "160", "-o", "large"], 0);
    let field = "field large/initial.nii.gz large/deformed.nii.gz -o results --threads 1";
    let output = shell(folder.path(), "ulimit -v 150000", field);
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("initial.nii.gz") && said.contains("of memory") && said.contains("halve"), "{said}");
    assert!(!folder.path().join("results").exists());
}

#[test]
fn a_rename_that_is_refused_leaves_the_earlier_results() {
    let folder = small_pair();
    run(folder.path(), &FIELD, 0);
    let results = folder.path().join("results");
    // A folder in the place of the last file cannot be replaced by it.
    fs::remove_file(results.join("report.html")).unwrap();
    fs::create_dir(results.join("report.html")).unwrap();
    let before = files(&results, true);
    let (_, err) = run(folder.path(), &[&FIELD[..], &["--seed", "2"]].concat(), 1);
    assert!(err.contains("report.html"), "{err}");
    assert_eq!(files(&results, true), before);
}

#[test]
fn repeated_runs_any_threads_and_plain_instructions_give_the_same_bytes() {
    let folder = small_pair();
    let usual = |extra: &[&str], simd: &str| {
        let program = assert_cmd::cargo::cargo_bin!("palpate");
        let mut command = Command::new(program);
        command.current_dir(&folder).args(FIELD).args(extra).env("PALPATE_SIMD", simd);
        assert!(command.output().unwrap().status.success());
        timeless(files(&folder.path().join("results"), false))
    };
    let first = usual(&[], "");
    assert!(first.len() >= 6);
    for (threads, simd) in [("1", ""), ("2", ""), ("8", ""), ("8", ""), ("2", "scalar")] {
        let again = usual(&["--threads", threads], simd);
        for (name, bytes) in &first {
            assert!(again[name] == *bytes, "{name} differs with {threads} threads, instructions: {simd:?}");
        }
    }
}

#[test]
fn names_with_spaces_accents_dots_and_links_are_taken_as_they_are() {
    let folder = small_pair();
    let odd = folder.path().join("größe v1.2 – après");
    fs::create_dir(&odd).unwrap();
    fs::rename(folder.path().join("initial.nii.gz"), odd.join("vor dem.druck.nii.gz")).unwrap();
    std::os::unix::fs::symlink(folder.path().join("deformed.nii.gz"), odd.join("-nach.nii.gz")).unwrap();
    // Results inside the folder of the inputs, one of them a link.
    let arguments = ["field", "vor dem.druck.nii.gz", "./-nach.nii.gz", "-o", "er gebnis.d/a b"];
    run(&odd, &arguments, 0);
    assert!(odd.join("er gebnis.d/a b/displacement.nii.gz").exists());
    // The same file twice is measured, with a warning.
    let (_, err) = run(&odd, &["field", "vor dem.druck.nii.gz", "vor dem.druck.nii.gz", "-o", "same"], 0);
    assert!(err.contains("same file"), "{err}");
    // A pipe is no volume.
    let pipe = odd.join("pipe.nii");
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    let (_, err) = run(&odd, &["field", "vor dem.druck.nii.gz", "pipe.nii", "-o", "piped", "--timeout", "20"], 1);
    assert!(err.contains("pipe.nii") && !err.contains("--timeout"), "{err}");
}
