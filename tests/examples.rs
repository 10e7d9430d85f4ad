//! Every example runs, and says a number that is right.
#![allow(clippy::unwrap_used)]

use std::path::Path;
use std::process::Command;
use tempfile::TempDir;

/// Runs an example in an empty folder; its output comes back, and the folder.
fn example(name: &str, arguments: &[&str]) -> (String, TempDir) {
    let folder = TempDir::new().unwrap();
    let manifest = concat!(env!("CARGO_MANIFEST_DIR"), "/Cargo.toml");
    let mut command = Command::new(env!("CARGO"));
    command.args(["run", "--quiet", "--manifest-path", manifest, "--example", name, "--"]).args(arguments);
    let output = command.current_dir(&folder).output().unwrap();
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{name}: {out}{err}");
    (out.into_owned(), folder)
}

/// The number in front of `word`.
fn before(text: &str, word: &str) -> f64 {
    let head = text.split(word).next().unwrap().trim_end();
    head.rsplit([' ', '\n']).next().unwrap().parse().unwrap_or_else(|_| panic!("no number before {word:?} in {text}"))
}

#[test]
fn every_example_has_a_test() {
    let mut names: Vec<String> = std::fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("examples"))
        .unwrap()
        .map(|e| e.unwrap().path().file_stem().unwrap().to_string_lossy().into_owned())
        .collect();
    names.sort();
    assert_eq!(names, ["own_pair", "seed"]);
}

#[test]
fn seed_meshes_the_matches_and_draws_every_node() {
    let (out, folder) = example("seed", &["--quick"]);
    let rows: Vec<Vec<&str>> = out.lines().map(|l| l.split_whitespace().collect()).collect();
    for (row, points) in rows[1..4].iter().zip(["200", "400", "800"]) {
        assert_eq!(row[0], points);
        // "energy a -> b" takes three columns, "error of nothing" the next three.
        let number = |i: usize| row[i].parse::<f64>().unwrap();
        let (nodes, elements) = (number(5), number(6));
        assert!(elements > nodes, "{out}");
        assert!(number(9) <= number(7), "the energy must not grow: {out}");
        assert!(number(10) < 0.5 * number(12), "{out}");
    }
    let picture = std::fs::read_to_string(folder.path().join("out/seed.svg")).unwrap();
    assert_eq!(picture.matches("<circle").count().to_string(), rows[1][5]);
}

#[test]
fn own_pair_measures_the_press() {
    let (out, folder) = example("own_pair", &[]);
    let largest: f64 = out.split("largest ").nth(1).unwrap().split(' ').next().unwrap().parse().unwrap();
    assert!((largest - 6.0).abs() < 1.5, "{out}");
    assert_eq!(before(&out, " folds"), 0.0, "{out}");
    assert!(folder.path().join("out/displacement.nii.gz").is_file());
}
