//! Starts, masks and landmarks on the command line, of one pair, a sequence and a batch.

use crate::fixtures::run;
use palpate::evaluate::metrics;
use palpate::io;
use palpate::types::{DenseField, Grid, Mask, Volume};
use serde_json::Value;
use std::fs;
use std::path::Path;

/// A folder with `pair/` (a phantom that moves by 3 mm) and `far.nii.gz`, the deformed volume 60 mm
/// away.
fn pair() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let phantom = ["phantom", "block", "--size", "40", "--amplitude", "3", "--seed", "2", "-o", "pair", "--quiet"];
    run(folder.path(), &phantom, 0);
    let deformed = io::read_volume(folder.path().join("pair/deformed.nii.gz")).unwrap();
    let mut rows = deformed.grid().affine().rows();
    rows[0][3] += 60.0;
    let away = Grid::new(deformed.grid().shape(), palpate::types::Affine::new(rows).unwrap()).unwrap();
    let far = Volume::from_vec(away, deformed.as_slice().to_vec()).unwrap();
    io::write_exact(folder.path().join("far.nii.gz"), &far, "moved").unwrap();
    folder
}

fn summary(folder: &Path, results: &str) -> Value {
    io::read_json(folder.join(results).join("summary.json")).unwrap()
}

/// Mean error (mm) of the pair where it lies, with nothing known.
fn plain(folder: &Path) -> f64 {
    run(folder, &["field", "pair", "pair", "--mask", "pair", "--preset", "fast", "-o", "plain"], 0);
    error(folder, "plain", 0.0)
}

/// Mean error (mm) of a field that also moved by `shift` along x.
fn error(folder: &Path, results: &str, shift: f32) -> f64 {
    let truth = io::read_field(folder.join("pair/truth.nii.gz")).unwrap();
    let n = truth.grid().len();
    let values = truth.as_slice().iter().enumerate().map(|(at, v)| if at < n { v + shift } else { *v }).collect();
    let truth = DenseField::from_vec(*truth.grid(), values).unwrap();
    let mask = io::read_mask(folder.join("pair/mask.nii.gz")).unwrap();
    let found = io::read_field(folder.join(results).join("displacement.nii.gz")).unwrap();
    metrics(&found, &truth, Some(&mask), &[]).unwrap().mean_mm
}

/// The three alignments and each kind of file lead to the same field; a wrong one is told.
#[test]
fn a_pair_that_lies_apart_is_measured_from_any_start() {
    let folder = pair();
    let at = folder.path();
    fs::write(
        at.join("shift.tfm"),
        "#Insight Transform File V1.0\n#Transform 0\nTransform: TranslationTransform_double_3_3\nParameters: -60 0 0\nFixedParameters:\n",
    )
    .unwrap();
    fs::write(at.join("half.mat"), "1 0 0 30\n0 1 0 0\n0 0 1 0\n0 0 0 1\n").unwrap();
    let measure = |results: &str, start: &[&str]| {
        let mut arguments =
            vec!["field", "pair/initial.nii.gz", "far.nii.gz", "--mask", "pair", "--preset", "fast", "-o", results];
        if !start.is_empty() {
            arguments.push("--initial");
        }
        arguments.extend(start);
        run(at, &arguments, 0).1
    };
    let near = plain(at);
    // Within a short range nothing is found, and the start to try is named.
    let short = ["field", "pair/initial.nii.gz", "far.nii.gz", "--mask", "pair", "--search", "5", "-o", "short"];
    let (_, said) = run(at, &short, 1);
    assert!(said.contains("--initial centre"), "{said}");
    assert!(!at.join("short").exists());
    for (results, start) in [
        // Searches one about another reach it.
        ("none", vec![]),
        ("centre", vec!["centre"]),
        ("moments", vec!["moments"]),
        ("principal", vec!["principal"]),
        ("file", vec!["shift.tfm"]),
        ("chain", vec!["greedy:half.mat", "greedy:half.mat"]),
        ("folder", vec!["file"]),
    ] {
        let said = measure(results, &start);
        let off = error(at, results, 60.0);
        assert!(off < 1.1 * near, "{start:?}: {off} for {near} mm\n{said}");
        assert_eq!(summary(at, results)["start"].is_null(), start.is_empty());
    }
    let files = summary(at, "chain")["files"].to_string();
    assert!(files.contains("half.mat") && files.contains("initial transform"), "{files}");
    // The other way round the volumes do not meet.
    let arguments = ["field", "pair/initial.nii.gz", "far.nii.gz", "-o", "wrong", "--initial", "shift.tfm,-1"];
    let (_, said) = run(at, &arguments, 1);
    assert!(said.contains("do not overlap") && said.contains("--initial centre"), "{said}");
    assert!(!at.join("wrong").exists());

    // The run again, from its summary alone.
    run(at, &["field", "--config", "chain/summary.json", "-o", "again"], 0);
    for file in ["displacement.nii.gz", "uncertainty.nii.gz", "matches.csv"] {
        assert_eq!(fs::read(at.join("chain").join(file)).unwrap(), fs::read(at.join("again").join(file)).unwrap());
    }
}

/// `affine.txt` is the motion where that is one map, and goes when it is none any more.
#[test]
fn a_rigid_run_writes_its_map() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    run(
        at,
        &["phantom", "block", "--motion", "rotate", "--size", "36", "--amplitude", "2", "-o", "pair", "--quiet"],
        0,
    );
    let field = |model: &str| {
        let mut arguments = vec!["field", "pair", "pair", "--mask", "pair", "--preset", "fast", "-o", "out", "--force"];
        arguments.extend(["--model", model]);
        run(at, &arguments, 0);
    };
    field("rigid");
    let grid = "pair/initial.nii.gz";
    run(at, &["compose", "out/affine.txt", "--reference", grid, "-o", "map.nii.gz"], 0);
    let [map, found] = ["map.nii.gz", "out/displacement.nii.gz"].map(|f| io::read_field(at.join(f)).unwrap());
    let off = map.as_slice().iter().zip(found.as_slice()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(off < 5e-3, "{off}");
    field("free");
    assert!(!at.join("out/affine.txt").exists());
}

/// Masks on another grid are resampled, and it is said; what leaves nothing is refused.
#[test]
fn masks_come_onto_the_grid_that_they_are_for() {
    let folder = pair();
    let at = folder.path();
    let mask = io::read_mask(at.join("pair/mask.nii.gz")).unwrap();
    let coarse = {
        let (shape, rows) = (mask.grid().shape().map(|n| n / 2), mask.grid().affine().rows());
        let rows = rows.map(|[a, b, c, o]| [2.0 * a, 2.0 * b, 2.0 * c, o + 0.5 * (a + b + c)]);
        let grid = Grid::new(shape, palpate::types::Affine::new(rows).unwrap()).unwrap();
        Mask::from_voxels(grid, |at, _| {
            let [i, j, k] = grid.voxel(at);
            mask.as_slice()[mask.grid().index(2 * i, 2 * j, 2 * k)]
        })
    };
    io::write_labels(at.join("coarse.nii.gz"), &coarse, "mask").unwrap();
    let seen = Mask::filled(*coarse.grid(), 1);
    io::write_labels(at.join("seen.nii.gz"), &seen, "mask").unwrap();
    io::write_labels(at.join("all.nii.gz"), &Mask::filled(*mask.grid(), 1), "mask").unwrap();
    let base = ["field", "pair", "pair", "--preset", "fast"];
    let with = |extra: &[&str], code: i32| run(at, &[&base[..], extra].concat(), code).1;
    let said = with(&["--mask", "coarse.nii.gz", "--deformed-mask", "seen.nii.gz", "-o", "a"], 0);
    assert_eq!(said.matches("resampled onto that by nearest neighbour").count(), 2, "{said}");
    assert!(error(at, "a", 0.0) < 1.1 * plain(at));
    let said = with(&["--ignore", "all.nii.gz", "-o", "b"], 1);
    assert!(said.contains("all.nii.gz") && said.contains("nothing is left that counts"), "{said}");
    assert!(!at.join("b").exists());
}

/// Landmarks come from a table or from two point lists; what became of them is told.
#[test]
fn landmarks_are_read_and_told() {
    let folder = pair();
    let at = folder.path();
    let truth = io::read_field(at.join("pair/truth.nii.gz")).unwrap();
    let (mut table, mut lists) = ("fx,fy,fz,mx,my,mz\n".to_string(), ["x,y,z\n", "x,y,z\n"].map(String::from));
    for (n, [i, j, k]) in [[12, 14, 16], [20, 20, 20], [26, 18, 22], [18, 27, 14], [24, 24, 28]].into_iter().enumerate()
    {
        let offset = truth.grid().index(i, j, k);
        let (p, u) = (truth.grid().centre(offset), truth.at(offset).map(f64::from));
        let mut q = p.moved(u);
        q.0[2] += if n == 3 { 20.0 } else { 0.0 };
        let text = |v: [f64; 3]| v.map(|c| format!("{c:.4}")).join(",");
        table += &format!("{},{}\n", text(p.0), text(q.0));
        lists[0] += &format!("{}\n", text(p.0));
        lists[1] += &format!("{}\n", text(q.0));
    }
    fs::write(at.join("l.csv"), table).unwrap();
    fs::write(at.join("a.csv"), &lists[0]).unwrap();
    fs::write(at.join("b.csv"), &lists[1]).unwrap();
    let base = ["field", "pair", "pair", "--mask", "pair", "--preset", "fast"];
    for (results, landmarks) in [("one", vec!["l.csv"]), ("two", vec!["a.csv", "b.csv"])] {
        let arguments = [&base[..], &["-o", results, "--landmark-sd", "0.5", "--landmarks"], &landmarks].concat();
        let (out, said) = run(at, &arguments, 0);
        assert!(out.contains("landmarks    5") && said.contains("number 4"), "{out}{said}");
        assert_eq!(summary(at, results)["landmarks"]["wrong"], serde_json::json!([4]));
    }
    let displacement = |results: &str| fs::read(at.join(results).join("displacement.nii.gz")).unwrap();
    assert_eq!(displacement("one"), displacement("two"));
    let arguments = [&base[..], &["-o", "three", "--method", "sparse", "--landmarks", "l.csv"]].concat();
    let (_, said) = run(at, &arguments, 1);
    assert!(said.contains("--method sparse"), "{said}");
}

/// A sequence and a batch take the same.
#[test]
fn sequences_and_batches_take_what_a_pair_takes() {
    let folder = pair();
    let at = folder.path();
    let frames = ["track", "pair/initial.nii.gz", "far.nii.gz", "far.nii.gz", "--preset", "fast"];
    run(at, &[&frames[..], &["--mask", "pair", "--initial", "centre", "-o", "tracked"]].concat(), 0);
    let field = io::read_field(at.join("tracked/displacement_002.nii.gz")).unwrap();
    let n = field.grid().len();
    let mean = field.as_slice()[..n].iter().map(|v| f64::from(*v)).sum::<f64>() / n as f64;
    assert!((mean - 60.0).abs() < 2.0, "{mean}");
    fs::write(at.join("l.csv"), "fx,fy,fz,mx,my,mz\n0,0,0,60,0,0\n").unwrap();
    let tracked = |table: &str, code: i32| {
        fs::write(at.join("t.csv"), table).unwrap();
        run(
            at,
            &[&frames[..], &["--initial", "centre", "--landmarks", "t.csv", "-o", "b", "--overwrite"]].concat(),
            code,
        )
        .1
    };
    let said = tracked("fx,fy,fz,mx,my,mz\n0,0,0,60,0,0\n", 1);
    assert!(said.contains("t.csv: line 1: there is no column \"frame\""), "{said}");
    let said = tracked("frame,fx,fy,fz,mx,my,mz\n3,0,0,0,60,0,0\n", 1);
    assert!(said.contains("t.csv: has landmarks of frame 3; the frames are 0 to 2, without the reference 0"), "{said}");
    let lists = [&frames[..], &["--landmarks", "l.csv", "l.csv", "-o", "b"]].concat();
    let (_, said) = run(at, &lists, 2);
    assert!(said.contains("two lists of points belong to one pair"), "{said}");
    let said = tracked("frame,fx,fy,fz,mx,my,mz\n1.5,0,0,0,60,0,0\n", 1);
    assert!(said.contains("row 1: frame is 1.5, not a whole number"), "{said}");
    let said = tracked("frame,fx,fy,fz,mx,my,mz\n2,0,0,0,30,0,0\n", 0);
    assert!(
        said.contains("landmark") && summary(at, "b")["frames"][1]["warnings"].to_string().contains("landmark"),
        "{said}"
    );

    fs::write(
        at.join("pairs.csv"),
        "name,initial,deformed,mask,start,deformed_mask,ignore,landmarks\nnear,pair/initial.nii.gz,pair/deformed.nii.gz,pair/mask.nii.gz,,pair/mask.nii.gz,,\nfar,pair/initial.nii.gz,far.nii.gz,pair/mask.nii.gz,centre,,,l.csv\n",
    )
    .unwrap();
    run(at, &["batch", "pairs.csv", "--preset", "fast", "-o", "cohort", "--quiet"], 0);
    let far = summary(at, "cohort/far/field");
    assert_eq!(far["landmarks"]["count"], 1);
    assert!(!far["start"].is_null());
    assert!(summary(at, "cohort/near/field")["files"].to_string().contains("deformed mask"));
    assert!(error(at, "cohort/far/field", 60.0) < 1.1 * plain(at));
}
