//! What docs/explanation/trust.md promises of files, limits and repeated runs: killed, stopped, out
//! of time, memory and permission.
#![cfg(target_os = "linux")]

use crate::fixtures::{run, small_pair, text};
use palpate::numerics::random::Random;
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

const FIELD: [&str; 6] = ["field", "initial.nii.gz", "deformed.nii.gz", "-o", "results", "--overwrite"];

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

/// Whether hang-ups are ignored here, and so in the program: nohup asks for that.
fn hang_ups_are_ignored() -> bool {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status.lines().find_map(|l| l.strip_prefix("SigIgn:")).map(str::trim);
    ignored.and_then(|mask| u64::from_str_radix(mask, 16).ok()).is_some_and(|mask| mask & 1 == 1)
}

#[test]
fn a_signal_stops_within_a_second_and_leaves_nothing() {
    let folder = small_pair();
    for (name, code) in [("-INT", 130), ("-TERM", 143), ("-HUP", 129), ("-QUIT", 131), ("-XCPU", 152)] {
        if name == "-HUP" && hang_ups_are_ignored() {
            continue;
        }
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

/// Each command that writes a folder, with as little work as it takes.
const WRITERS: [&str; 8] = [
    "field initial.nii.gz deformed.nii.gz --preset fast -o new/out",
    "phantom block --size 40 -o new/out",
    "strain truth.nii.gz --mask mask.nii.gz -o new/out",
    "stress --part grasp --quick -o new/out",
    "certify initial.nii.gz --mask mask.nii.gz --preset fast -o new/out",
    "chart --case . --quick -o new/out",
    "batch pairs.csv --preset fast -o new/out",
    "warp initial.nii.gz --field truth.nii.gz -o out.nii",
];

/// What stands under `folder`, hidden and deeper files too, but for the inputs.
fn left(folder: &Path) -> Vec<String> {
    let mut found = Vec::new();
    let mut open = vec![folder.join("new"), folder.join("out.nii")];
    open.extend(
        fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()).filter(|p| p.to_string_lossy().contains("/.palpate-")),
    );
    while let Some(path) = open.pop() {
        if path.is_dir() {
            open.extend(fs::read_dir(&path).unwrap().map(|e| e.unwrap().path()));
        } else if path.exists() {
            found.push(path.strip_prefix(folder).unwrap().display().to_string());
        }
    }
    found
}

fn with_pairs() -> tempfile::TempDir {
    let folder = small_pair();
    fs::write(folder.path().join("pairs.csv"), "initial,deformed\ninitial.nii.gz,deformed.nii.gz\n").unwrap();
    folder
}

/// A full disk, or a limit on the size of a file: the system would end the program by SIGXFSZ.
#[test]
fn a_file_past_its_limit_is_an_error_that_leaves_nothing_half_written() {
    let demo = "demo --size 36 --nodes 2000 --preset fast -o new/out";
    for arguments in WRITERS.into_iter().chain([demo]) {
        let folder = with_pairs();
        // Blocks of 512 bytes: less than the pictures and volumes take.
        let output = shell(folder.path(), "ulimit -f 8", arguments);
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{arguments}: {:?} {said}", output.status);
        assert!(!said.contains("panicked"), "{arguments}: {said}");
        let whole = left(folder.path());
        assert!(whole.iter().all(|f| !f.contains(".palpate-")), "{arguments}: {whole:?}");
        match arguments.split(' ').next() {
            // Steps and pairs that were done before stay, each whole.
            Some("demo" | "batch") => {}
            _ => assert!(whole.is_empty() && said.contains("cannot write"), "{arguments}: {whole:?} {said}"),
        }
    }
}

/// Files below a folder that do not tell the time, by their path.
fn deep(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let timed = ["summary.json", "report.html", "certificate.json", "batch.csv", "chart.csv", "chart.svg", "pair.json"];
    let (mut found, mut open) = (BTreeMap::new(), vec![folder.to_path_buf()]);
    while let Some(path) = open.pop() {
        for entry in fs::read_dir(&path).into_iter().flatten().map(Result::unwrap) {
            let name = entry.file_name().into_string().unwrap();
            match entry.path() {
                _ if name.starts_with('.')
                    || timed.contains(&name.as_str())
                    || name.ends_with(".log")
                    || name.ends_with(".html") => {}
                path if path.is_dir() => open.push(path),
                path => drop(
                    found.insert(path.strip_prefix(folder).unwrap().display().to_string(), fs::read(path).unwrap()),
                ),
            }
        }
    }
    found
}

/// As the fifty kills of a field run, of every command that writes a folder.
#[test]
fn every_command_that_is_killed_leaves_whole_files_and_the_next_run_none_of_the_hidden_ones() {
    let mut random = Random::new(11, 1);
    // The first one has its fifty.
    for arguments in &WRITERS[1..] {
        let folder = with_pairs();
        let (new, words) = (folder.path().join("new"), arguments.split(' ').collect::<Vec<_>>());
        let started = Instant::now();
        run(folder.path(), &words, 0);
        let (whole, usual) = (started.elapsed(), deep(&new));
        for turn in 0..2 {
            fs::remove_dir_all(&new).ok();
            fs::remove_file(folder.path().join("out.nii")).ok();
            let mut child = start(folder.path(), &words);
            sleep(whole.mul_f64(random.uniform(0.2, 1.0)));
            child.kill().unwrap();
            child.wait().unwrap();
            // The stage that a batch has begun ends by itself.
            sleep(Duration::from_secs(if words[0] == "batch" { 2 } else { 0 }));
            for (name, bytes) in deep(&new) {
                assert!(usual.get(&name) == Some(&bytes), "{arguments}, turn {turn}: {name} is not whole");
            }
            let overwrite = if words[0] == "warp" { &[][..] } else { &["--overwrite"] };
            run(folder.path(), &[&words[..], overwrite].concat(), 0);
            assert!(deep(&new) == usual, "{arguments}, turn {turn}: the next run gives something else");
            let hidden: Vec<String> = left(folder.path()).into_iter().filter(|f| f.contains(".palpate-")).collect();
            assert!(hidden.is_empty(), "{arguments}, turn {turn}: {hidden:?}");
        }
    }
}

#[test]
fn two_runs_into_one_new_folder_never_lose_one_of_them() {
    let folder = small_pair();
    for turn in 0..8 {
        let new = format!("new{turn}");
        let runs: Vec<Child> = (1..=2)
            .map(|seed| {
                let seed = seed.to_string();
                let arguments = ["phantom", "block", "--size", "48", "--seed", &seed, "-o", &new];
                start(folder.path(), &arguments)
            })
            .collect();
        let ended: Vec<Output> = runs.into_iter().map(|r| r.wait_with_output().unwrap()).collect();
        let done: Vec<usize> = (0..2).filter(|&r| ended[r].status.success()).collect();
        assert_eq!(done.len(), 1, "turn {turn}: {ended:?}");
        let told = fs::read_to_string(folder.path().join(&new).join("phantom.json")).unwrap();
        assert!(told.contains(&format!("\"seed\": {}", done[0] + 1)), "turn {turn}: {told}");
        let said = text(&ended[1 - done[0]].stderr);
        assert!(said.contains(&new) && said.contains("--output"), "{said}");
    }
}

#[test]
fn what_a_killed_run_left_goes_with_the_next_run_unless_it_is_held_or_keeps_older_results() {
    let folder = small_pair();
    let hidden = |at: &Path| -> Vec<String> {
        let names = fs::read_dir(at).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap());
        names.filter(|n| n.starts_with(".palpate-")).collect()
    };
    // Killed while it holds a folder for what it stages.
    let slow = ["phantom", "fingertip", "--size", "96", "-o", "."];
    let mut child = start(folder.path(), &[&slow[..], &["--overwrite"]].concat());
    let begun = Instant::now();
    while hidden(folder.path()).is_empty() && begun.elapsed() < Duration::from_secs(60) {
        sleep(Duration::from_millis(5));
    }
    let warp = ["warp", "initial.nii.gz", "--field", "truth.nii.gz", "-o", "w.nii"];
    run(folder.path(), &warp, 0);
    assert_eq!(hidden(folder.path()).len(), 1, "what a living run holds stays");
    child.kill().unwrap();
    child.wait().unwrap();
    let killed = hidden(folder.path());
    assert_eq!(killed.len(), 1, "{killed:?}");
    let machine = killed[0].rsplit_once('-').unwrap().0;
    // Results of before in it, and what another machine may hold.
    let kept = folder.path().join(format!("{machine}-older/earlier"));
    fs::create_dir_all(&kept).unwrap();
    fs::write(kept.join("report.html"), "old").unwrap();
    fs::write(folder.path().join(".palpate-elsewhere-x.tmp"), "theirs").unwrap();
    fs::write(folder.path().join(format!("{machine}-half.tmp")), "half").unwrap();
    run(folder.path(), &warp, 0);
    let mut left = hidden(folder.path());
    left.sort();
    let mut wanted = vec![format!("{machine}-older"), ".palpate-elsewhere-x.tmp".into()];
    wanted.sort();
    assert_eq!(left, wanted);
    assert_eq!(fs::read(kept.join("report.html")).unwrap(), b"old");
}

#[test]
fn a_pipe_is_refused_before_it_is_opened_wherever_a_file_is_named() {
    let folder = small_pair();
    let at = |name: &str| folder.path().join(name);
    for name in ["pipe", "pipe.csv", "pipe.json", "pipe.mat", "pipe.toml", "pipe.vtu", "pipe.fcsv", "raw"] {
        assert!(Command::new("mkfifo").arg(at(name)).status().unwrap().success());
    }
    let head = "NRRD0004\ntype: short\ndimension: 3\nsizes: 4 3 2\nendian: little\nencoding: raw\ndata file: raw\n";
    fs::write(at("v.nhdr"), head).unwrap();
    fs::write(at("v.mhd"), "NDims = 3\nDimSize = 4 3 2\nElementType = MET_SHORT\nElementDataFile = raw\n").unwrap();
    fs::write(at("points.csv"), "x,y,z\n1,2,3\n").unwrap();
    fs::write(at("scene.toml"), "[fingertip]\nfile = \"pipe.toml\"\n").unwrap();
    let cases: [&[&str]; 14] = [
        &["info", "v.nhdr"],
        &["info", "v.mhd"],
        &["warp", "v.nhdr", "--field", "truth.nii.gz", "-o", "x.nii"],
        &["field", "initial.nii.gz", "v.mhd", "-o", "x"],
        &["warp", "initial.nii.gz", "--field", "pipe", "-o", "x.nii"],
        &["warp", "--points", "pipe.csv", "--field", "truth.nii.gz", "-o", "x.csv"],
        &["warp", "--points", "pipe.fcsv", "--field", "truth.nii.gz", "-o", "x.csv"],
        &["warp", "initial.nii.gz", "--transform", "pipe.mat", "--reference", "initial.nii.gz", "-o", "x.nii"],
        &["field", "initial.nii.gz", "deformed.nii.gz", "--config", "pipe.json", "-o", "x"],
        &["batch", "pipe.csv", "-o", "x"],
        &["grasp", "pipe.toml", "-o", "x"],
        &["grasp", "scene.toml", "-o", "x"],
        &["skin", "pipe.toml", "-o", "x"],
        &["info", "pipe.vtu"],
    ];
    for arguments in cases {
        let (_, err) = run(folder.path(), &[arguments, &["--timeout", "20"]].concat(), 1);
        assert!(err.contains("regular file") && !err.contains("--timeout"), "{arguments:?}: {err}");
        assert!(!at("x").exists() && !at("x.nii").exists());
    }
}

#[test]
fn a_full_stdout_does_not_hide_that_the_results_are_written() {
    let folder = small_pair();
    let program = assert_cmd::cargo::cargo_bin!("palpate");
    let to = |target: &str, arguments: &str| {
        let script = format!("'{}' {arguments} {target}", program.display());
        Command::new("bash").current_dir(folder.path()).args(["-c", &script]).output().unwrap()
    };
    let output = to("> /dev/full", "phantom block --size 16 -o full");
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1));
    assert!(said.contains("every file is written") && said.contains("stdout"), "{said}");
    let names: Vec<String> = files(&folder.path().join("full"), true).into_keys().collect();
    assert!(names.contains(&"truth.nii.gz".into()) && names.iter().all(|n| !n.starts_with('.')), "{names:?}");
    // A reader that leaves is no failure, and what is said before the end does not stop the work.
    let output = to("| true; exit ${PIPESTATUS[0]}", "warp mask.nii.gz --field truth.nii.gz -o piped.nii");
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    assert!(folder.path().join("piped.nii").exists());
}

#[test]
fn nothing_that_is_said_steers_the_terminal() {
    let folder = small_pair();
    let odd = "a\u{1b}[31m\u{9b}2J\nerror: forged\u{202e}";
    let steers = |said: &str| {
        let said = said.replace('\n', "");
        said.contains(|c: char| c.is_control() || c == '\u{202e}')
    };
    fs::create_dir(folder.path().join(odd)).unwrap();
    for name in ["initial.nii.gz", "mask.nii.gz"] {
        fs::copy(folder.path().join(name), folder.path().join(odd).join(format!("{odd}{name}"))).unwrap();
    }
    let at = |name: &str| format!("{odd}/{odd}{name}");
    let table = format!("initial,deformed,\"{odd}\"\n");
    fs::write(folder.path().join("pairs.csv"), table).unwrap();
    fs::write(folder.path().join("odd.toml"), "\"a\\u001b[31m\" = 1\n").unwrap();
    let (image, mask, out) = (at("initial.nii.gz"), at("mask.nii.gz"), format!("{odd}/out"));
    let cases: [(&[&str], i32); 8] = [
        (&["info", &image], 0),
        (&["info", &at("absent.nii")], 1),
        (&["field", &image, &mask, "--mask", &mask, "-o", &out, "--dry-run"], 0),
        (&["field", odd, &image, "-o", "x"], 1),
        (&["warp", &mask, "--reference", &image, "-o", &format!("{odd}/w.nii")], 0),
        (&["warp", &mask, "--reference", &image, "-o", &format!("{odd}/w.{odd}")], 2),
        (&["batch", "pairs.csv", "-o", "x"], 1),
        (&["grasp", "odd.toml", "-o", "x"], 1),
    ];
    for (arguments, code) in cases {
        let (out, err) = run(folder.path(), arguments, code);
        assert!(!steers(&out) && !steers(&err), "{arguments:?}: {out:?} {err:?}");
        assert!(!err.lines().any(|l| l.starts_with("error: forged")), "{arguments:?}: {err}");
    }
    let (_, err) = run(folder.path(), &["field", &format!("--{odd}")], 2);
    assert!(!steers(&err), "{err:?}");
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
    let output = shell(folder.path(), "ulimit -v 3000000", stiffness);
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
    let commands = [
        ("strain large/truth.nii.gz", "large"),
        ("certify large/initial.nii.gz", "large"),
        ("chart --case large", "large"),
        ("phantom block --size 400", "--size"),
        ("demo --size 400", "--size"),
        ("stress --part stiffness --quick", "--part"),
    ];
    for (command, named) in commands {
        let output = shell(folder.path(), "ulimit -v 150000", &format!("{command} -o results --threads 1"));
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{command}: {said}");
        assert!(said.contains(named) && said.contains("of memory"), "{command}: {said}");
        assert!(!folder.path().join("results").exists(), "{command}");
    }
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
