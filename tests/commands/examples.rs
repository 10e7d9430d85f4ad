//! Every example runs, and says a number that is right.

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
    // The cohort is run by tests/python/test_cohort.py, scenes and tables of the grasp by
    // tests/grasp/grasp.rs, grasp_cli.rs and grasp_measured.rs.
    let known = [
        "cohort",
        "eight_motions",
        "finger_pad",
        "grasp",
        "human_fingertip",
        "initial_field",
        "own_matches",
        "own_pair",
        "own_similarity",
        "seed",
        "seed_chain",
        "sequence",
        "skin",
        "stability_map",
        "synthetic_presses",
        "thumb_and_index",
    ];
    assert_eq!(names, known);
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
        assert!(number(10) < 0.6 * number(12), "{out}");
        assert!(number(13) < 0.6 * number(15), "piecewise linear: {out}");
    }
    assert!(before(&out, " matches kept") >= 20.0, "{out}");
    let picture = std::fs::read_to_string(folder.path().join("out/seed.svg")).unwrap();
    assert_eq!(picture.matches("<circle").count().to_string(), rows[1][5]);
}

/// The words before and after `word`, as numbers.
fn beside(text: &str, word: &str) -> [f64; 2] {
    let after = text.split(word).nth(1).unwrap().split_whitespace().next().unwrap();
    [before(text, word), after.parse().unwrap()]
}

#[test]
fn seed_chain_measures_most_of_the_motion() {
    let (out, _) = example("seed_chain", &[]);
    assert!(before(&out, " voxels in the mesh") > 10_000.0, "{out}");
    let [error, motion] = beside(&out, " mm of a motion of ");
    assert!(error < 0.5 * motion, "{out}");
}

#[test]
fn own_similarity_sees_through_a_contrast_that_is_the_other_way_round() {
    let (out, _) = example("own_similarity", &[]);
    let right: Vec<f64> = out.lines().map(|line| before(line, " right of ")).collect();
    assert!(right[1] > 4.0 * right[0] && right[1] > 100.0, "{out}");
}

#[test]
fn own_matches_make_a_field_and_its_strain() {
    let (out, _) = example("own_matches", &[]);
    let [error, motion] = beside(&out, " mm of a motion of ");
    assert!(error < 0.5 * motion, "{out}");
    let strain: f64 = out.split("principal strain ").nth(1).unwrap().trim().parse().unwrap();
    assert!((0.1..1.5).contains(&strain), "{out}");
}

#[test]
fn an_initial_field_of_matches_reaches_where_the_search_does_not() {
    let (out, _) = example("initial_field", &[]);
    let [error, motion] = beside(&out, " mm of a motion of ");
    assert!(motion > 39.0 && error < 0.3, "{out}");
}

#[test]
fn own_pair_measures_the_press() {
    let (out, folder) = example("own_pair", &[]);
    let largest: f64 = out.split("largest ").nth(1).unwrap().split(' ').next().unwrap().parse().unwrap();
    assert!((largest - 6.0).abs() < 1.5, "{out}");
    assert_eq!(before(&out, " folds"), 0.0, "{out}");
    assert!(folder.path().join("out/displacement.nii.gz").is_file());
}

#[test]
fn sequence_follows_a_pinch() {
    let (out, _) = example("sequence", &["pinch", "3", "32"]);
    let rows: Vec<Vec<f64>> =
        out.lines().skip(1).take(2).map(|l| l.split_whitespace().map(|v| v.parse().unwrap()).collect()).collect();
    assert_eq!(rows.iter().map(|r| r[0]).collect::<Vec<_>>(), [1.0, 2.0], "{out}");
    // All frames together, followed, and alone.
    assert!(rows.iter().all(|r| r.len() == 6 && r[2..5].iter().all(|e| *e < 0.5 * r[1])), "{out}");
    assert!(
        out.lines().any(|l| l.trim_start().starts_with("mean ")) && out.contains("\ntogether: each frame by itself"),
        "{out}"
    );
}

#[test]
fn grasp_makes_the_eight_motions() {
    let (out, folder) = example("grasp", &[]);
    let rows: Vec<Vec<f64>> =
        out.lines().skip(1).map(|l| l.split_whitespace().map(|v| v.parse().unwrap_or(f64::NAN)).collect()).collect();
    assert_eq!(rows.len(), 9, "{out}");
    // Motions 2 and 4 mirror each other.
    assert!((rows[2][3] + rows[4][3]).abs() < 2e-3 && rows[2][3] < -10.0, "{out}");
    assert!(std::fs::read_to_string(folder.path().join("out/grasp.html")).unwrap().contains("8 of 8 motions"));
}

#[test]
fn the_stability_map_falls_with_stiffness() {
    let (out, folder) = example("stability_map", &["--quick"]);
    let step = |factor: &str, name: &str| -> f64 {
        let row = out.lines().find(|l| l.contains("Stiffness") && l.contains(factor) && l.contains(name)).unwrap();
        row.split_whitespace().last().unwrap().parse().unwrap()
    };
    // Frequencies grow with the root of the stiffness: a hundredfold E takes about a tenth of the
    // step.
    let fall = step(" 1.000", " rk4 ") / step(" 100.000", " rk4 ");
    assert!(fall > 2.0 && fall < 12.0, "{fall}: {out}");
    assert!(step(" 1.000", "semi-implicit ") < step(" 1.000", " rk4 "), "{out}");
    assert!(folder.path().join("out/stability-map.svg").is_file());
}
