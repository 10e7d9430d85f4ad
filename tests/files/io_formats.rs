//! Tables, meshes, JSON and the output folder.

use base64::{Engine, engine::general_purpose::STANDARD};
use palpate::error::IoError;
use palpate::io::{
    OutputFolder, PointTable, read_landmarks, read_matches, read_points, read_trajectories, write_bytes, write_json,
    write_landmarks, write_matches, write_points, write_tet_mesh, write_text, write_tri_mesh,
};
use palpate::types::{Landmark, Match, SparseField, TetMesh, TriMesh, WorldPoint};
use std::collections::BTreeMap;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Barrier;
use tempfile::{TempDir, tempdir};

fn put(folder: &TempDir, name: &str, bytes: &[u8]) -> PathBuf {
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    path
}

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[track_caller]
fn refused<T: std::fmt::Debug>(result: Result<T, IoError>, words: &[&str]) {
    let error = result.unwrap_err().to_string();
    assert!(words.iter().all(|w| error.contains(w)), "{error}");
}

fn a_match(i: usize, kept: bool) -> Match {
    let i = i as f64;
    Match {
        initial: WorldPoint([i, -2.5 * i, 100.125]),
        displacement: [0.5, -0.000001, 3.0],
        ncc: 0.75,
        covariance: [0.04, 0.04, 0.04, 0.0, 0.0, 0.0],
        kept,
        raw: None,
    }
}

#[test]
fn matches_round_trip() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("matches.csv");
    let field = SparseField { matches: vec![a_match(1, true), a_match(2, false)] };
    write_matches(&path, &field).unwrap();
    let text = std::fs::read_to_string(&path).unwrap();
    assert_eq!(
        text.lines().take(2).collect::<Vec<_>>(),
        [
            "x,y,z,dx,dy,dz,ncc,sigma,kept,raw_dx,raw_dy,raw_dz,raw_sigma",
            "1.000000,-2.500000,100.125000,0.500000,-0.000001,3.000000,0.750000,0.200000,1,0.500000,-0.000001,3.000000,0.200000"
        ]
    );
    let back = read_matches(&path).unwrap();
    for (a, b) in back.matches.iter().zip(&field.matches) {
        assert_eq!((a.initial, a.displacement, a.ncc, a.kept), (b.initial, b.displacement, b.ncc, b.kept));
        assert!((a.sigma() - 0.2).abs() < 1e-12);
    }
    // An estimate goes before what was measured, which stays beside it.
    let estimated = a_match(1, true).with_estimate([0.25, 0.0, 2.5], 0.1);
    write_matches(&path, &SparseField { matches: vec![estimated] }).unwrap();
    let text = std::fs::read_to_string(&path).unwrap();
    assert!(text.contains(",0.250000,0.000000,2.500000,0.750000,0.100000,1,0.500000,-0.000001,3.000000,0.200000\n"));
    write_matches(&path, &SparseField::default()).unwrap();
    assert_eq!(read_matches(&path).unwrap(), SparseField::default());
}

#[test]
fn landmarks_round_trip() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("l.csv");
    let landmarks = [Landmark { initial: WorldPoint([1.0, 2.0, 3.0]), deformed: WorldPoint([-1.5, 2.25, 1e3]) }];
    write_landmarks(&path, &landmarks).unwrap();
    assert_eq!(std::fs::read_to_string(&path).unwrap().lines().next(), Some("fx,fy,fz,mx,my,mz"));
    assert_eq!(read_landmarks(&path).unwrap(), landmarks);
}

#[test]
fn points_keep_their_other_columns_in_any_order() {
    let folder = tempdir().unwrap();
    let path = put(&folder, "p.csv", b"\xef\xbb\xbfname, Z ,x,Y,\"a, b\"\r\nhip,3,1,2e0,u\r\nknee,-3,-1,-2,\"v\"\r\n");
    let table = read_points(&path).unwrap();
    assert_eq!(table.points, [WorldPoint([1.0, 2.0, 3.0]), WorldPoint([-1.0, -2.0, -3.0])]);
    assert_eq!(table.other_columns, ["name", "a, b"]);
    assert_eq!(table.others, [["hip", "u"], ["knee", "v"]]);
    write_points(&path, &table).unwrap();
    assert_eq!(std::fs::read_to_string(&path).unwrap().lines().nth(1), Some("1.000000,2.000000,3.000000,hip,u"));
    assert_eq!(read_points(&path).unwrap(), table);
    let bare = PointTable { points: table.points, ..PointTable::default() };
    write_points(&path, &bare).unwrap();
    assert_eq!(read_points(&path).unwrap().points, bare.points);
}

#[test]
fn bad_tables_are_refused_with_their_line() {
    let folder = tempdir().unwrap();
    let points = |text: &[u8]| read_points(put(&folder, "p.csv", text));
    refused(points(b"x,y,z\n1,2,3\n1,two,3\n"), &["p.csv", "line 3", "y is \"two\""]);
    refused(points(b"x,y,z\n1,2,NaN\n"), &["line 2", "z is \"NaN\""]);
    refused(points(b"x,y,z\n1,inf,1\n"), &["line 2", "finite"]);
    refused(points(b"x,y,z\n1,2,3\n4,5\n"), &["line 3", "2 values", "has 3"]);
    refused(points(b"x;y;z\n1;2;3\n"), &["line 1", "\"x\"", "separated by commas"]);
    refused(points(b"x,y\n1,2\n"), &["line 1", "no column \"z\""]);
    refused(points(b"x,y,z\n1,2,\xff\n"), &["line 2", "UTF-8"]);
    refused(points(b"x,y,z\n"), &["no row"]);
    refused(points(b""), &["line 1"]);
    refused(read_landmarks(put(&folder, "l.csv", b"fx,fy,fz,mx,my,mz\n")), &["l.csv", "no row"]);
    refused(read_matches(put(&folder, "m.csv", b"x,y,z\n1,2,3\n")), &["m.csv", "\"dx\""]);
    for kept in ["0.5", "-1", "2"] {
        let table = format!("x,y,z,dx,dy,dz,ncc,sigma,kept\n1,2,3,0,0,0,1,0.1,1\n1,2,3,0,0,0,1,0.1,{kept}\n");
        refused(read_matches(put(&folder, "m.csv", table.as_bytes())), &["m.csv", "kept", "match 2"]);
    }
    for place in ["0,-1", "0,1.5", "-2,1", "0.5,0"] {
        let table = format!("point,frame,x,y,z,sigma\n0,0,1,2,3,0.1\n{place},1,2,3,0.1\n");
        refused(read_trajectories(put(&folder, "t.csv", table.as_bytes()), 0), &["t.csv", "row 2", "from 0"]);
    }
    refused(read_points(folder.path().join("none.csv")), &["none.csv: cannot read", "check the spelling"]);
}

#[test]
fn a_quote_never_takes_the_rest_of_a_table_for_one_cell() {
    let folder = tempdir().unwrap();
    let points = |text: &str| read_points(put(&folder, "p.csv", text.as_bytes()));
    refused(points("x,y,z,n\n1,2,3,\"a\n4,5,6,b\n"), &["p.csv", "line 2", "never closed"]);
    refused(points("x,y,z,n\n1,2,3,a\n4,5,6,\""), &["line 3", "never closed"]);
    refused(points("x,y,z,n\n1,2,3,\"a\n4,5,6,\"b\"\n"), &["line 3", "line 2", "closes"]);
    refused(points("x,y,z,\"n\n1,2,3,a\n"), &["line 1", "never closed"]);
    refused(points("\"x,y,z,n\n1,2,3,a\n"), &["line 1", "never closed"]);
    // What the rules allow.
    let names = |text: &str| -> Vec<String> { points(text).unwrap().others.concat() };
    assert_eq!(
        names("x,y,z,n\n1,2,3,\"a, b\"\n4,5,6,\"c \"\"d\"\"\"\r\n7,8,9,6\" nail\n"),
        ["a, b", "c \"d\"", "6\" nail"]
    );
    assert_eq!(names("\u{feff}\"x\",y,z,n\n\n1,2,3,\"two\nlines\"\n1,2,3,\"\""), ["two\nlines", ""]);
    let pairs = put(&folder, "pairs.csv", b"initial,deformed,name\na.nii,b.nii,\"one\nc.nii,d.nii,two\n");
    refused(palpate::io::read_pairs(&pairs), &["pairs.csv", "line 2", "never closed"]);
    refused(palpate::io::columns_of(&pairs), &["pairs.csv", "line 2", "never closed"]);
}

/// The arrays of a .vtu, unpacked by the rules of the VTK file formats guide.
fn vtu_arrays(path: &Path) -> BTreeMap<String, Vec<u8>> {
    let text = std::fs::read_to_string(path).unwrap();
    let data = text.split_once("<AppendedData encoding=\"base64\">\n_").unwrap().1.split('\n').next().unwrap();
    let value = |tag: &str, name: &str| -> String {
        tag.split_once(&format!(" {name}=\"")).unwrap().1.split('"').next().unwrap().to_string()
    };
    let unpack = |tag: &str| {
        let at: usize = value(tag, "offset").parse().unwrap();
        let u64s = |n: usize| -> Vec<usize> {
            let text = &data[at..at + (8 * n).div_ceil(3) * 4];
            let bytes = STANDARD.decode(text).unwrap();
            bytes.chunks_exact(8).map(|b| u64::from_le_bytes(b.try_into().unwrap()) as usize).collect()
        };
        let first: usize = {
            let bytes = STANDARD.decode(&data[at..at + 12]).unwrap();
            u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize
        };
        let header = u64s(3 + first);
        let start = at + (8 * header.len()).div_ceil(3) * 4;
        let length: usize = header[3..].iter().sum();
        let packed = STANDARD.decode(&data[start..start + length.div_ceil(3) * 4]).unwrap();
        let (mut out, mut from) = (Vec::new(), 0);
        for (block, &size) in header[3..].iter().enumerate() {
            let before = out.len();
            flate2::read::ZlibDecoder::new(&packed[from..from + size]).read_to_end(&mut out).unwrap();
            let last = block + 1 == first && header[2] > 0;
            assert_eq!(out.len() - before, if last { header[2] } else { header[1] });
            from += size;
        }
        out
    };
    text.lines().filter(|l| l.starts_with("<DataArray")).map(|l| (value(l, "Name"), unpack(l))).collect()
}

fn f32s(bytes: &[u8]) -> Vec<f32> {
    bytes.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect()
}

fn i64s(bytes: &[u8]) -> Vec<i64> {
    bytes.chunks_exact(8).map(|b| i64::from_le_bytes(b.try_into().unwrap())).collect()
}

#[test]
fn a_tetrahedral_mesh_is_a_vtu() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("mesh.vtu");
    // More than one block of data.
    let n = 200_000;
    let nodes: Vec<WorldPoint> = (0..n).map(|i| WorldPoint([i as f64, (i % 7) as f64, -0.5])).collect();
    let cells: Vec<[u32; 4]> = (0..n as u32 - 3).map(|i| [i, i + 1, i + 2, i + 3]).collect();
    let displacement: Vec<[f64; 3]> = (0..n).map(|i| [3.0, 4.0 * (i % 2) as f64, 0.0]).collect();
    let modulus: Vec<f32> = (0..cells.len()).map(|i| i as f32).collect();
    let mesh = TetMesh::new(nodes, cells).unwrap();
    write_tet_mesh(&path, &mesh, &displacement, &[("youngs_modulus", &modulus)]).unwrap();
    let arrays = vtu_arrays(&path);
    assert_eq!(f32s(&arrays["Points"])[3..6], [1.0, 1.0, -0.5]);
    assert_eq!(arrays["Points"].len(), 12 * n);
    assert_eq!(f32s(&arrays["displacement"])[..6], [3.0, 0.0, 0.0, 3.0, 4.0, 0.0]);
    assert_eq!(f32s(&arrays["magnitude"])[..2], [3.0, 5.0]);
    assert_eq!(f32s(&arrays["youngs_modulus"]), modulus);
    assert_eq!(i64s(&arrays["connectivity"])[4..8], [1, 2, 3, 4]);
    assert_eq!(i64s(&arrays["offsets"]).last(), Some(&(4 * (n as i64 - 3))));
    assert!(arrays["types"].iter().all(|&t| t == 10));
}

#[test]
fn a_triangle_mesh_is_a_vtu_even_when_empty() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("mesh.vtu");
    let nodes = [[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0]].map(WorldPoint).to_vec();
    let mesh = TriMesh::new(nodes, vec![[0, 1, 2]]).unwrap();
    write_tri_mesh(&path, &mesh, &[[0.0, 0.0, 2.0]; 3], &[]).unwrap();
    let arrays = vtu_arrays(&path);
    assert_eq!((i64s(&arrays["offsets"]), arrays["types"].clone()), (vec![3], vec![5]));
    assert_eq!(f32s(&arrays["magnitude"]), [2.0; 3]);
    write_tri_mesh(&path, &TriMesh::default(), &[], &[]).unwrap();
    assert!(vtu_arrays(&path).values().all(Vec::is_empty));
    refused(write_tri_mesh(&path, &mesh, &[], &[]), &["mesh.vtu", "0 values of displacement for 3"]);
    refused(write_tri_mesh(&path, &mesh, &[[0.0; 3]; 3], &[("e", &[1.0, 2.0])]), &["2 values of e for 1"]);
}

#[test]
fn json_is_indented_and_numbers_that_are_not_finite_are_null() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("s.json");
    write_json(&path, &serde_json::json!({ "b": [1, 2.5], "a": f64::NAN })).unwrap();
    assert_eq!(std::fs::read_to_string(&path).unwrap(), "{\n  \"b\": [\n    1,\n    2.5\n  ],\n  \"a\": null\n}\n");
    let keys_that_are_lists: BTreeMap<Vec<u8>, u8> = [(vec![1], 1)].into();
    refused(write_json(folder.path().join("t.json"), &keys_that_are_lists), &["t.json"]);
    assert_eq!(names(folder.path()), ["s.json"]);
}

#[test]
fn a_file_is_not_written_over_a_folder_or_into_a_missing_one() {
    let folder = tempdir().unwrap();
    refused(write_text(folder.path(), "x"), &["not a regular file"]);
    refused(write_bytes(folder.path().join("no/such/a.png"), b"x"), &["cannot create", "check"]);
    assert!(names(folder.path()).is_empty());
}

#[test]
fn results_appear_at_commit_only() {
    let folder = tempdir().unwrap();
    let target = folder.path().join("a/b/results");
    let mut output = OutputFolder::create(&target, false).unwrap();
    output.write("one.txt", |p| write_text(p, "1")).unwrap();
    output.write("sub.01.txt", |p| write_text(p, "2")).unwrap();
    output.write("one.txt", |p| write_text(p, "3")).unwrap();
    assert!(names(&target).iter().all(|n| n.starts_with(".palpate-")));
    assert_eq!(output.commit().unwrap(), [target.join("one.txt"), target.join("sub.01.txt")]);
    assert_eq!(names(&target), ["one.txt", "sub.01.txt"]);
    assert_eq!(std::fs::read_to_string(target.join("one.txt")).unwrap(), "3");
}

#[test]
fn a_failed_run_leaves_nothing() {
    let folder = tempdir().unwrap();
    let target = folder.path().join("a/b");
    let mut output = OutputFolder::create(&target, false).unwrap();
    output.write("one.txt", |p| write_text(p, "1")).unwrap();
    // The error names the final path, not the hidden one.
    let failed =
        output.write("two.nii", |p| Err(IoError::Format { path: p.into(), what: "w".into(), hint: "h".into() }));
    assert_eq!(failed.unwrap_err().to_string(), format!("{}: w; h", target.join("two.nii").display()));
    drop(output);
    assert!(names(folder.path()).is_empty());

    // A folder that was there stays, and what someone else puts into a new one stays too.
    std::fs::create_dir_all(&target).unwrap();
    drop(OutputFolder::create(&target, false).unwrap());
    assert!(names(&target).is_empty());
    let output = OutputFolder::create(target.join("c"), false).unwrap();
    std::fs::write(target.join("c/theirs"), "x").unwrap();
    drop(output);
    assert_eq!(names(&target.join("c")), ["theirs"]);
}

#[test]
fn of_runs_that_make_one_folder_at_once_one_gets_it_and_the_others_say_why() {
    let folder = tempdir().unwrap();
    for turn in 0..200 {
        let target = folder.path().join(format!("{turn}/a/b"));
        let together = Barrier::new(4);
        let made: Vec<_> = std::thread::scope(|scope| {
            let create = || {
                together.wait();
                OutputFolder::create(&target, false)
            };
            let threads: Vec<_> = (0..4).map(|_| scope.spawn(create)).collect();
            threads.into_iter().map(|t| t.join().unwrap()).collect()
        });
        assert_eq!(made.iter().filter(|m| m.is_ok()).count(), 1, "turn {turn}: {made:?}");
        for other in made.into_iter().filter(Result::is_err) {
            refused(other, &["another run", "--output"]);
        }
    }
}

#[test]
fn a_folder_with_files_needs_force() {
    let folder = tempdir().unwrap();
    let old = put(&folder, "old.txt", b"old");
    put(&folder, "one.txt", b"old");
    refused(OutputFolder::create(folder.path(), false), &["not empty", "--overwrite"]);
    let mut output = OutputFolder::create(folder.path(), true).unwrap();
    output.write("one.txt", |p| write_text(p, "new")).unwrap();
    assert_eq!(std::fs::read(folder.path().join("one.txt")).unwrap(), b"old");
    output.commit().unwrap();
    assert_eq!(std::fs::read(folder.path().join("one.txt")).unwrap(), b"new");
    assert_eq!(std::fs::read(old).unwrap(), b"old");
    assert_eq!(names(folder.path()), ["old.txt", "one.txt"]);
}

#[test]
fn what_an_earlier_run_left_goes_with_the_commit_alone() {
    let folder = tempdir().unwrap();
    let frame = |file: &str| file.starts_with("frame_");
    for name in ["frame_0", "frame_1", "frame_2", "notes"] {
        put(&folder, name, b"old");
    }
    std::fs::create_dir(folder.path().join("frame_9")).unwrap();
    let mut output = OutputFolder::create(folder.path(), true).unwrap();
    output.supersede(frame).unwrap();
    output.write("frame_1", |p| write_text(p, "new")).unwrap();
    drop(output);
    assert_eq!(names(folder.path()), ["frame_0", "frame_1", "frame_2", "frame_9", "notes"]);
    let mut output = OutputFolder::create(folder.path(), true).unwrap();
    output.supersede(frame).unwrap();
    output.write("frame_1", |p| write_text(p, "new")).unwrap();
    output.commit().unwrap();
    assert_eq!(names(folder.path()), ["frame_1", "frame_9", "notes"]);
    assert_eq!(std::fs::read(folder.path().join("frame_1")).unwrap(), b"new");
}

#[test]
fn a_hidden_folder_of_a_killed_run_does_not_count() {
    let folder = tempdir().unwrap();
    std::fs::create_dir(folder.path().join(".palpate-killed")).unwrap();
    assert!(OutputFolder::create(folder.path(), false).is_ok());
}

#[test]
fn targets_that_cannot_be_written_are_refused_at_once() {
    let folder = tempdir().unwrap();
    let file = put(&folder, "file", b"x");
    refused(OutputFolder::create(&file, true), &["is a file", "--output"]);
    refused(OutputFolder::create(file.join("under"), false), &["under", "cannot create"]);
    std::fs::create_dir_all(folder.path().join("d/one.txt")).unwrap();
    let mut output = OutputFolder::create(folder.path().join("d"), true).unwrap();
    refused(output.write("one.txt", |p| write_text(p, "1")), &["one.txt", "is a folder"]);
    // Refused by everyone, root too.
    if Path::new("/proc/self").is_dir() {
        refused(OutputFolder::create("/proc/self/results", false), &["/proc/self/results", "cannot create"]);
    }
}

/// Runs one of the tests below in a process that may not write files past 64 kB: writes fail as on
/// a full disk.
#[cfg(unix)]
fn with_a_full_disk(test: &str, folder: &Path) {
    let me = std::env::current_exe().unwrap();
    let script = "trap '' XFSZ; ulimit -f 64 || exit 1; exec \"$0\" --exact --ignored \"$1\"";
    let out = Command::new("bash").args(["-c", script]).arg(me).arg(test).env("PALPATE_FULL", folder).output().unwrap();
    let text = String::from_utf8_lossy(&out.stdout);
    assert!(out.status.success() && text.contains("1 passed"), "{text}{}", String::from_utf8_lossy(&out.stderr));
}

#[cfg(unix)]
#[test]
fn a_full_disk_leaves_nothing_behind() {
    let folder = tempdir().unwrap();
    with_a_full_disk("io_formats::inside_a_full_disk", folder.path());
    assert!(names(folder.path()).is_empty(), "{:?}", names(folder.path()));
}

#[test]
#[ignore = "run by a_full_disk_leaves_nothing_behind under a limit"]
fn inside_a_full_disk() {
    let folder = PathBuf::from(std::env::var_os("PALPATE_FULL").unwrap());
    refused(write_bytes(folder.join("big.png"), &vec![1; 1 << 20]), &["big.png: cannot write", "; "]);
    let mut output = OutputFolder::create(folder.join("new"), false).unwrap();
    output.write("small.txt", |p| write_text(p, "fits")).unwrap();
    let big = |p: &Path| write_bytes(p, &vec![1; 1 << 20]);
    refused(output.write("big.png", big), &["new/big.png: cannot write"]);
}
