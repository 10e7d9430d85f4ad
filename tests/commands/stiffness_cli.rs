//! `palpate stiffness` as a user meets it: files, exit codes, what it says to bad input, and other
//! programs on its models.

use crate::fixtures::run;
use palpate::io;
use palpate::types::{Affine, DenseField, Grid, Mask, Match, SparseField, Volume};
use std::fs;
use std::path::Path;
use tempfile::TempDir;

fn grid(shape: [usize; 3]) -> Grid {
    Grid::new(shape, Affine::scaled([1.0; 3], [-3.0, 5.0, 1.0]).unwrap()).unwrap()
}

/// A block squeezed by 3 % between frictionless plates, and its label map of two halves, one on the
/// other: of halves side by side nothing but the mean would be seen.
fn folder() -> TempDir {
    let folder = TempDir::new().unwrap();
    let g = grid([16, 16, 16]);
    let inside = |i: usize| (2..14).contains(&i);
    let block = |o: usize| g.voxel(o).into_iter().all(inside);
    let labels = Mask::from_voxels(g, |o, _| if block(o) { 1 + u8::from(g.voxel(o)[2] > 7) } else { 0 });
    let middle = g.world(0, 0, 0).moved([7.5; 3]).0;
    let field = DenseField::from_fn(g, |p| {
        let d: [f64; 3] = std::array::from_fn(|a| p.0[a] - middle[a]);
        [0.49 * 0.03 * d[0], 0.49 * 0.03 * d[1], -0.03 * d[2]]
    });
    let at = |name: &str| folder.path().join(name);
    io::write_field(at("field.nii.gz"), &field).unwrap();
    io::write_labels(at("labels.nii.gz"), &labels, "").unwrap();
    folder
}

const BASE: [&str; 9] =
    ["stiffness", "--field", "field.nii.gz", "--labels", "labels.nii.gz", "--nodes", "1500", "-o", "results"];

/// Runs with more arguments; must end with `code`, say all of `parts` and leave nothing.
fn refused(folder: &Path, more: &[&str], code: i32, parts: &[&str]) {
    let (out, err) = run(folder, &[&BASE, more].concat(), code);
    assert!(out.is_empty(), "{out}");
    for part in parts {
        assert!(err.contains(part), "should say {part:?}: {err}");
    }
    assert!(!folder.join("results").exists());
}

#[test]
fn everything_promised_is_written() {
    let folder = folder();
    let (out, _) =
        run(folder.path(), &[&BASE[..], &["--total-force", "0.1", "--names", "1=lower,2=upper"]].concat(), 0);
    assert!(out.contains("All 2 regions are determined by the data.") && out.contains("lower"), "{out}");
    let results = folder.path().join("results");
    let table = fs::read_to_string(results.join("regions.csv")).unwrap();
    assert!(
        table.starts_with("label,name,youngs_modulus_kpa,sd_kpa,ratio,identifiable,state,bound\n1,lower,"),
        "{table}"
    );
    let summary: serde_json::Value =
        serde_json::from_str(&fs::read_to_string(results.join("summary.json")).unwrap()).unwrap();
    assert_eq!(summary["absolute"], true);
    // E = F / (A strain) = 0.1 N / (144 mm^2 x 0.03).
    for r in summary["regions"].as_array().unwrap() {
        let [e, sd] = ["youngs_modulus", "sd"].map(|k| r[k].as_f64().unwrap());
        // Halves side by side of so small a body are told apart badly, and that is said.
        assert!((e - 23.148).abs() < 2.0 * sd && sd < 4.0, "{e} +- {sd}");
    }
    for key in ["residual_mm", "evidence", "patches", "correlation", "seconds", "mesh", "verdict"] {
        assert!(!summary[key].is_null(), "{key}");
    }
    let map = io::read_volume(results.join("stiffness.nii.gz")).unwrap();
    assert!(map.as_slice()[0] == 0.0 && map.as_slice()[map.grid().index(7, 7, 7)] > 15.0);
    let page = fs::read_to_string(results.join("report.html")).unwrap();
    let stages = summary["seconds"].as_object().unwrap();
    for stage in stages.keys() {
        assert_eq!(page.matches(&format!("</i>{stage} <b>")).count(), 1, "{stage} is booked twice");
    }
    assert!(stages.contains_key("read") && stages.contains_key("mesh"), "{stages:?}");
    assert!(page.contains("<h3>Distributions</h3>"));
    assert!(page.contains("lower") && !page.contains("NaN") && !page.contains("http"));
    for file in [
        "stiffness_sd.nii.gz",
        "residual.nii.gz",
        "mesh.vtu",
        "model.feb",
        "model.inp",
        "model.scn",
        "model.xml",
        "model.msh",
    ] {
        assert!(fs::metadata(results.join(file)).unwrap().len() > 500, "{file}");
    }
    check_febio(&fs::read_to_string(results.join("model.feb")).unwrap());
}

#[test]
fn the_report_shows_the_tissue_behind_the_maps() {
    let folder = folder();
    let at = |name: &str| folder.path().join(name);
    fs::create_dir(at("measured")).unwrap();
    fs::copy(at("field.nii.gz"), at("measured/displacement.nii.gz")).unwrap();
    fs::write(at("measured/summary.json"), "{}").unwrap();
    let g = grid([16, 16, 16]);
    let wavy = Volume::from_voxels(g, |_, p| p.0.iter().map(|x| x.sin() as f32).sum());
    io::write_volume(at("measured/warped.nii.gz"), &wavy, "").unwrap();
    let coarse = Grid::new([8; 3], Affine::scaled([2.0; 3], [-3.0, 5.0, 1.0]).unwrap()).unwrap();
    io::write_volume(at("scan.nii.gz"), &Volume::from_voxels(coarse, |o, _| o as f32), "").unwrap();
    let page = |field: &str, more: &[&str]| {
        let base = ["stiffness", "--field", field, "--labels", "labels.nii.gz", "--nodes", "500", "-o", "results"];
        run(folder.path(), &[&base, more, &["--overwrite", "--quiet"]].concat(), 0);
        fs::read_to_string(at("results/report.html")).unwrap()
    };
    assert!(page("measured", &[]).contains("\"warped\""));
    assert!(page("field.nii.gz", &[]).contains("\"body\""));
    let asked = page("measured", &["--image", "scan.nii.gz", "--image", "measured/warped.nii.gz"]);
    assert!(asked.contains("\"scan.nii.gz\"") && asked.contains("\"warped.nii.gz\"") && !asked.contains("\"body\""));
    // What was not asked for may be damaged; what was is refused.
    fs::write(at("measured/warped.nii.gz"), "no volume").unwrap();
    assert!(page("measured", &[]).contains("\"body\""));
    fs::remove_dir_all(at("results")).unwrap();
    refused(folder.path(), &["--image", "measured/warped.nii.gz"], 1, &["measured/warped.nii.gz"]);
    refused(folder.path(), &["--image", "nowhere.nii.gz"], 1, &["nowhere.nii.gz"]);
    let far = Grid::new([8; 3], Affine::scaled([2.0; 3], [500.0; 3]).unwrap()).unwrap();
    io::write_volume(at("far.nii.gz"), &Volume::from_voxels(far, |o, _| o as f32), "").unwrap();
    refused(folder.path(), &["--image", "far.nii.gz"], 1, &["far.nii.gz", "shows nothing where the field lies"]);
}

#[test]
fn calculix_solves_our_model_to_our_displacements() {
    let folder = folder();
    run(folder.path(), &[&BASE[..], &["--total-force", "0.1"]].concat(), 0);
    let results = folder.path().join("results");
    let summary = serde_json::from_str(&fs::read_to_string(results.join("summary.json")).unwrap()).unwrap();
    run_calculix(&results, &summary);
}

/// Of a plate that sticks and moves sideways as well, what acts across it was taken for the whole
/// force: moduli were 12 % too high.
#[test]
fn the_force_that_was_given_is_the_whole_one() {
    let folder = TempDir::new().unwrap();
    let g = grid([16, 16, 16]);
    let block = |o: usize| g.voxel(o).into_iter().all(|i| (2..14).contains(&i));
    let base = g.world(0, 0, 1).0[2] + 0.5;
    let field = DenseField::from_fn(g, |p| [0.8, 0.3, -0.4].map(|v| v * (p.0[2] - base) / 12.0));
    io::write_field(folder.path().join("field.nii.gz"), &field).unwrap();
    io::write_labels(folder.path().join("labels.nii.gz"), &Mask::from_voxels(g, |o, _| u8::from(block(o))), "")
        .unwrap();
    let (out, err) = run(
        folder.path(),
        &[&BASE[..], &["--total-force", "0.1", "--model", "linear", "--poisson", "0.3"]].concat(),
        0,
    );
    assert!(err.contains("the plate pushes sideways as well"), "{out}{err}");
    let results = folder.path().join("results");
    if std::process::Command::new("ccx").arg("model").current_dir(&results).output().is_err() {
        println!("ccx is not installed: model.inp was not run");
        return;
    }
    let printed = fs::read_to_string(results.join("model.dat")).unwrap();
    let total = printed.split("total force").nth(1).unwrap();
    let force: Vec<f64> = total.lines().flat_map(str::split_whitespace).filter_map(|v| v.parse().ok()).collect();
    let [x, y, z] = force[force.len() - 3..] else { panic!("{printed}") };
    let whole = (x * x + y * y + z * z).sqrt();
    println!("CalculiX: {force:?} N, {whole:.4} N in all");
    // The moduli hold the faces' offsets and the exported mesh does not, which is worth a tenth of
    // a field that no body has; taken for the part across the plate 0.1 N made 0.111 N in all.
    assert!((0.088..0.104).contains(&whole) && z.abs() < 0.08, "{force:?}");
}

/// The block of [`folder`] in `frames` noisy frames as `palpate track` leaves them; frame 1 is the
/// reference, the last is at rest.
///
/// Its halves lie one on the other here: side by side between plates that slide they would strain
/// alike whatever their moduli.
fn tracked(frames: usize) -> TempDir {
    let folder = folder();
    let g = grid([16, 16, 16]);
    let inside = |i: usize| (2..14).contains(&i);
    let label = |at: [usize; 3]| if at.into_iter().all(inside) { 1 + u8::from(at[2] > 7) } else { 0 };
    io::write_labels(folder.path().join("labels.nii.gz"), &Mask::from_voxels(g, |o, _| label(g.voxel(o))), "").unwrap();
    let field = io::read_field(folder.path().join("field.nii.gz")).unwrap();
    let mut random = palpate::numerics::random::Random::new(3, 1);
    for frame in (0..frames).filter(|&f| f != 1) {
        let mut noisy = DenseField::zeros(*field.grid());
        if frame + 1 < frames {
            for (v, u) in noisy.as_mut_slice().iter_mut().zip(field.as_slice()) {
                *v = u + 0.03 * random.normals()[0] as f32;
            }
        }
        io::write_field(folder.path().join(format!("displacement_{frame}.nii.gz")), &noisy).unwrap();
    }
    fs::write(folder.path().join("summary.json"), r#"{"command": "track", "reference": 1}"#).unwrap();
    folder
}

#[test]
fn a_sequence_is_read_by_the_matches_and_frames_of_its_own_track() {
    let folder = tracked(4);
    let at = |name: &str| folder.path().join(name);
    // A second track into the same folder measured frame 0, lost frame 2, and left the field of
    // frame 3 behind.
    let summary = r#"{"command": "track", "reference": 1, "frames": [{"frame": 0, "lost": null}, {"frame": 2, "lost": "noise"}]}"#;
    fs::write(at("summary.json"), summary).unwrap();
    let g = grid([16, 16, 16]);
    let field = io::read_field(at("field.nii.gz")).unwrap();
    let one = |offset: usize| Match {
        initial: g.world(g.voxel(offset)[0], g.voxel(offset)[1], g.voxel(offset)[2]),
        displacement: field.at(offset).map(f64::from),
        ncc: 1.0,
        covariance: [1e-4, 1e-4, 1e-4, 0.0, 0.0, 0.0],
        kept: true,
        raw: None,
    };
    let inside = |offset: &usize| g.voxel(*offset).into_iter().all(|i| (3..13).contains(&i));
    let matches = SparseField { matches: (0..g.len()).filter(inside).step_by(3).map(one).collect() };
    io::write_matches(at("matches_0.csv"), &matches).unwrap();
    let base = ["stiffness", "--sequence", ".", "--labels", "labels.nii.gz", "--nodes", "1000", "--model", "linear"];
    let (out, _) = run(folder.path(), &[&base[..], &["--forces", "0.1,0.2", "-o", "shared"]].concat(), 0);
    assert!(out.contains("1 of 1 share these moduli"), "{out}");
    let summary: serde_json::Value =
        serde_json::from_str(&fs::read_to_string(at("shared").join("summary.json")).unwrap()).unwrap();
    assert_eq!(summary["inputs"]["matches"], "matches_<t>.csv");
    let (_, err) = run(folder.path(), &[&base[..], &["--forces", "0.1", "-o", "none"]].concat(), 2);
    assert!(err.contains("2 frames besides the reference (0, 2)"), "{err}");
}

#[test]
fn a_damaged_table_of_matches_is_told_before_any_work() {
    let folder = tracked(4);
    fs::write(folder.path().join("matches_2.csv"), "x,y,z,dx,dy,dz,ncc,sigma,kept\n1,2,3,oops,0,0,1,0.1,1\n").unwrap();
    let base = ["stiffness", "--sequence", ".", "--labels", "labels.nii.gz", "--nodes", "1000", "-o", "results"];
    for more in [&["--dry-run"][..], &[]] {
        let (_, err) = run(folder.path(), &[&base[..], more].concat(), 1);
        assert!(err.contains("matches_2.csv") && err.contains("oops"), "{err}");
    }
    assert!(!folder.path().join("results").exists());
}

#[test]
fn labels_without_a_label_are_called_labels() {
    let folder = folder();
    io::write_labels(folder.path().join("labels.nii.gz"), &Mask::filled(grid([16; 3]), 0), "").unwrap();
    refused(folder.path(), &[], 1, &["labels.nii.gz: no voxel has a label"]);
}

#[test]
fn frames_share_a_map_and_lower_its_noise() {
    let folder = tracked(8);
    let base = ["stiffness", "--sequence", ".", "--labels", "labels.nii.gz", "--nodes", "1000", "--model", "linear"];
    let forces = ["--forces", "0.1,0.1,0.1,0.1,0.1,0.1,0.1", "-o", "shared"];
    let (plan, _) = run(folder.path(), &[&base[..], &forces, &["--dry-run"]].concat(), 0);
    assert!(plan.contains("and 6 more") && plan.contains("0.1 to 0.1 N") && plan.contains("frames.csv"), "{plan}");
    assert!(!folder.path().join("shared").exists());
    let (out, _) = run(folder.path(), &[&base[..], &forces].concat(), 0);
    assert!(out.contains("6 of 7 share these moduli"), "{out}");
    let read = |file: &str| fs::read_to_string(folder.path().join("shared").join(file)).unwrap();
    let summary: serde_json::Value = serde_json::from_str(&read("summary.json")).unwrap();
    for r in summary["regions"].as_array().unwrap() {
        let [e, sd] = ["youngs_modulus", "sd"].map(|k| r[k].as_f64().unwrap());
        assert!((e - 23.148).abs() < 2.0 * sd, "{e} +- {sd}");
        let gains = summary["sequence"]["gains"][r["label"].to_string()].as_array().unwrap();
        assert_eq!(gains.len(), 6);
        let part = |g: &serde_json::Value| g["data_sd"].as_f64().unwrap() / g["value"].as_f64().unwrap();
        // One over the root of 6 is 0.41; frames differ in what they claim and in chance.
        let fell = part(&gains[5]) / part(&gains[0]);
        assert!((0.25..0.65).contains(&fell), "{fell}");
    }
    let frames = read("frames.csv");
    assert_eq!(frames.lines().count(), 1 + 2 * 6 + 1, "{frames}");
    assert!(frames.contains("\n7,0.000000,,,,,,,"), "{frames}");
    assert!(read("report.html").contains("first over root of frames"));
}

#[test]
fn what_is_no_sequence_is_refused() {
    let folder = tracked(3);
    let base = ["stiffness", "--sequence", ".", "--labels", "labels.nii.gz", "-o", "results"];
    let (_, err) = run(folder.path(), &[&base[..], &["--forces", "0.1"]].concat(), 2);
    assert!(err.contains("1 forces for 2 frames"), "{err}");
    for forces in ["0.1,-1", "-1,0.1"] {
        let (_, err) = run(folder.path(), &[&base[..], &["--forces", forces]].concat(), 2);
        assert!(err.contains("-1") && err.contains("below 0"), "{err}");
    }
    let (_, err) = run(folder.path(), &[&base[..], &["--forces", "0,0"]].concat(), 1);
    assert!(err.contains("no force acts"), "{err}");
    // Each frame would find regions of its own, and their moduli would be averaged as if they were
    // the same ones.
    for body in [&["--mask", "labels.nii.gz"][..], &[]] {
        let (_, err) = run(folder.path(), &[&["stiffness", "--sequence", ".", "-o", "results"], body].concat(), 2);
        assert!(
            err.contains("--sequence") && err.contains(if body.is_empty() { "--labels" } else { "--mask" }),
            "{err}"
        );
    }
    fs::write(folder.path().join("summary.json"), r#"{"command": "field"}"#).unwrap();
    let (_, err) = run(folder.path(), &base, 1);
    assert!(err.contains("summary.json") && err.contains("palpate track"), "{err}");
    assert!(!folder.path().join("results").exists());
}

#[test]
fn a_dry_run_of_a_sequence_bears_frames_at_rest() {
    let folder = tracked(4);
    let base =
        ["stiffness", "--sequence", ".", "--labels", "labels.nii.gz", "--nodes", "1500", "--dry-run", "-o", "results"];
    let rest = DenseField::zeros(grid([16, 16, 16]));
    io::write_field(folder.path().join("displacement_0.nii.gz"), &rest).unwrap();
    let (out, _) = run(folder.path(), &base, 0);
    assert!(out.contains("Nothing was written"), "{out}");
    io::write_field(folder.path().join("displacement_2.nii.gz"), &rest).unwrap();
    let (_, err) = run(folder.path(), &base, 1);
    assert!(err.contains("no load"), "{err}");
    // A damaged frame is named, though the one after it could be used.
    let folder = tracked(5);
    io::write_field(folder.path().join("displacement_0.nii.gz"), &rest).unwrap();
    fs::write(folder.path().join("displacement_2.nii.gz"), "cut").unwrap();
    let (_, err) = run(folder.path(), &base, 1);
    assert!(err.contains("displacement_2.nii.gz"), "{err}");
}

/// The sections of a FEBio 4 file, in the order its manual gives, each opened and closed.
fn check_febio(text: &str) {
    assert!(text.contains("<febio_spec version=\"4.0\">"));
    let mut last = 0;
    for section in ["Control", "Material", "Mesh", "MeshDomains", "MeshData", "Boundary", "LoadData", "Output"] {
        let (open, close) = (format!("<{section}>"), format!("</{section}>"));
        assert_eq!((text.matches(&open).count(), text.matches(&close).count()), (1, 1), "{section}");
        let at = text.find(&open).unwrap();
        assert!(at > last, "{section} stands too early");
        last = at;
    }
    assert!(text.contains("<Elements type=\"tet10\" name=\"region1\">"));
    assert!(text.contains("<SolidDomain name=\"region2\" mat=\"material2\"/>"));
    // Both plates slide: a shift along each of two axes and a turn are held at single nodes.
    for (pin, count) in [("pin1", 1), ("pin2", 1), ("pin3", 1), ("pin4", 0)] {
        assert_eq!(text.matches(&format!("<NodeSet name=\"{pin}\">")).count(), count, "{pin}");
        assert_eq!(text.matches(&format!("node_set=\"{pin}\"")).count(), count, "{pin}");
    }
}

/// CalculiX solves our model to our displacements; skipped where it is not installed.
fn run_calculix(results: &Path, summary: &serde_json::Value) {
    let Ok(output) = std::process::Command::new("ccx").arg("model").current_dir(results).output() else {
        println!("ccx is not installed: model.inp was not run");
        return;
    };
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(said.contains("Job finished"), "{said}");
    let printed = fs::read_to_string(results.join("model.dat")).unwrap();
    let rows: Vec<Vec<f64>> = printed
        .lines()
        .map(|l| l.split_whitespace().map_while(|v| v.parse().ok()).collect::<Vec<f64>>())
        .filter(|r| r.len() == 4)
        .collect();
    assert_eq!(rows.len(), summary["mesh"]["nodes"].as_u64().unwrap() as usize);
    let ours = displacements(&fs::read_to_string(results.join("mesh.vtu")).unwrap());
    let size = rows.iter().map(|r| r[3].abs()).fold(0.0, f64::max);
    let mut worst = 0.0f64;
    for (theirs, ours) in rows.iter().zip(&ours) {
        (0..3).for_each(|a| worst = worst.max((theirs[a + 1] - ours[a]).abs()));
    }
    println!("CalculiX and we differ by {worst:.5} mm of {size:.3} mm");
    assert!(size > 0.1 && worst < 0.03 * size, "{worst} of {size}");
}

/// The displacement array of one of our .vtu files.
fn displacements(vtu: &str) -> Vec<[f64; 3]> {
    use base64::{Engine, engine::general_purpose::STANDARD};
    let data = vtu.split_once("<AppendedData encoding=\"base64\">\n_").unwrap().1.split('\n').next().unwrap();
    let header = STANDARD.decode(&data[..44]).unwrap();
    let word = |i: usize| u64::from_le_bytes(header[8 * i..8 * i + 8].try_into().unwrap()) as usize;
    assert_eq!(word(0), 1);
    let packed = STANDARD.decode(&data[44..44 + word(3).div_ceil(3) * 4]).unwrap();
    let mut raw = vec![0; word(2)];
    libdeflater::Decompressor::new().zlib_decompress(&packed, &mut raw).unwrap();
    let floats: Vec<f64> = raw.as_chunks::<4>().0.iter().map(|b| f64::from(f32::from_le_bytes(*b))).collect();
    floats.as_chunks::<3>().0.to_vec()
}

#[test]
fn bad_numbers_are_usage_errors_that_say_the_range() {
    let folder = folder();
    refused(folder.path(), &["--total-force", "-2"], 2, &["force", "-2", "above 0 N", "without a sign"]);
    refused(folder.path(), &["--poisson", "0.5"], 2, &["poisson", "0.5", "below 0.5", "0.499"]);
    refused(folder.path(), &["--nodes", "3"], 2, &["nodes"]);
    refused(folder.path(), &["--names", "7=skin"], 2, &["no label 7"]);
    // As a table of pairs has them: the second was taken for a part of the first one's name.
    refused(folder.path(), &["--names", "1=skin;7=fat"], 2, &["no label 7"]);
    refused(folder.path(), &["--model", "hyper"], 2, &["hyper", "neo-hookean"]);
}

#[test]
fn what_is_known_by_label_is_checked() {
    let folder = folder();
    let bad: [(&[&str], &[&str]); 6] = [
        (&["--poisson", "1=0.6"], &["poisson", "0.6", "below 0.5"]),
        (&["--poisson", "7=0.3"], &["no label 7"]),
        (&["--poisson", "soft"], &["--poisson", "soft", "1=0.49"]),
        (&["--fixed", "15000"], &["--fixed", "15000", "3=15000"]),
        (&["--fixed", "2=20,2=30"], &["label 2 is given twice"]),
        (&["--label-sd", "-1"], &["label-sd", "0 to 5"]),
    ];
    for (given, said) in bad {
        let given: Vec<String> = given.chunks(2).map(|pair| pair.join("=")).collect();
        refused(folder.path(), &given.iter().map(String::as_str).collect::<Vec<_>>(), 2, said);
    }
    fs::write(folder.path().join("m.csv"), "label,poisson\n1,0.4\n1,0.3\n").unwrap();
    refused(folder.path(), &["--materials", "m.csv"], 1, &["m.csv", "row 2", "label 1 is there twice"]);
    fs::write(folder.path().join("m.csv"), "label,name\n1,skin\n").unwrap();
    refused(folder.path(), &["--materials", "m.csv"], 1, &["m.csv", "no column poisson"]);
}

/// A block of one modulus: a label of 20 kPa makes the other one 20 kPa too, without a force.
/// SOFA, MuJoCo and a mesh of the user's had the ratio of all regions alone.
#[test]
fn each_export_has_the_ratio_of_each_region() {
    let folder = folder();
    let mesh = "*NODE\n1, 0, 8, 4\n2, 8, 8, 4\n3, 0, 16, 4\n4, 0, 8, 6\n5, 0, 8, 13\n6, 8, 8, 13\n7, 0, 16, 13\n\
                8, 0, 8, 10\n*ELEMENT, TYPE=C3D4\n1, 1, 2, 3, 4\n2, 5, 7, 6, 8\n";
    fs::write(folder.path().join("body.inp"), mesh).unwrap();
    let given = ["--force", "0.1", "--poisson", "0.3", "--poisson", "2=0.4", "--mesh", "body.inp"];
    run(folder.path(), &[&BASE[..], &given].concat(), 0);
    let text = |name: &str| fs::read_to_string(folder.path().join("results").join(name)).unwrap();
    let ratios = |name: &str, before: &str, after: char| -> Vec<String> {
        text(name).split(before).skip(1).map(|rest| rest.split(after).next().unwrap().trim().to_string()).collect()
    };
    assert_eq!(ratios("model.scn", "poissonRatio=\"", '"'), ["0.3", "0.4"]);
    assert_eq!(ratios("model.xml", " poisson=\"", '"'), ["0.3", "0.4"]);
    let materials = |name: &str| -> Vec<String> {
        let lines = ratios(name, "*ELASTIC\n", '\n');
        lines.iter().map(|l| l.rsplit(", ").next().unwrap().to_string()).collect()
    };
    assert_eq!(materials("boundary.inp"), ["0.3", "0.4"]);
    let scene = text("model.scn");
    let count = |key: &str| -> Vec<usize> {
        let parts = scene.split("<Node name=\"material").skip(1);
        parts.map(|p| p.split(key).nth(1).unwrap().split('"').next().unwrap().split_whitespace().count()).collect()
    };
    let [corners, moduli] = [" tetrahedra=\"", "youngModulus=\""].map(count);
    assert!(corners.len() == 2 && corners.iter().zip(&moduli).all(|(c, m)| *c == 4 * m && *m > 0));
}

#[test]
fn a_modulus_that_is_given_sets_the_scale() {
    let folder = folder();
    fs::write(folder.path().join("m.csv"), "label,youngs_modulus_kpa\n2,20\n1,\n").unwrap();
    run(folder.path(), &[&BASE[..], &["--materials", "m.csv", "--poisson", "1=0.49", "--strict"]].concat(), 0);
    let text = fs::read_to_string(folder.path().join("results/summary.json")).unwrap();
    let summary: serde_json::Value = serde_json::from_str(&text).unwrap();
    let [one, two] = [0, 1].map(|r| &summary["regions"][r]);
    assert!(two["state"] == "given" && (two["youngs_modulus"].as_f64().unwrap() - 20.0).abs() < 1e-9, "{two}");
    assert_eq!(two["sd"], 0.0);
    let [e, sd] = ["youngs_modulus", "sd"].map(|k| one[k].as_f64().unwrap());
    assert!(one["state"] == "determined" && (e - 20.0).abs() < 2.0 * sd && sd < 4.0, "{one}");
    assert!(summary["absolute"] == true && summary["unit"] == "kPa" && summary["trust"] != "low", "{text}");
}

/// A wave that no elastic body makes: no number, low trust, and exit code 1 where that is asked
/// for.
#[test]
fn a_field_that_no_body_makes_gives_no_number() {
    let folder = folder();
    let path = folder.path().join("field.nii.gz");
    let mut field = io::read_field(&path).unwrap();
    let g = *field.grid();
    for (o, v) in field.as_mut_slice()[..g.len()].iter_mut().enumerate() {
        *v += 0.3 * (g.voxel(o)[2] as f32).sin();
    }
    io::write_field(&path, &field).unwrap();
    let (out, err) = run(folder.path(), &[&BASE[..], &["--strict"]].concat(), 1);
    assert!(out.contains("Trust low") && err.contains("--strict"), "{out}{err}");
    let table = fs::read_to_string(folder.path().join("results/regions.csv")).unwrap();
    assert!(table.lines().skip(1).all(|row| row.ends_with(",,,,0,unknown,")), "{table}");
}

#[test]
fn a_number_of_regions_beside_labels_is_said_to_change_nothing() {
    let folder = folder();
    let (_, err) = run(folder.path(), &[&BASE[..], &["--regions", "3", "--dry-run"]].concat(), 0);
    assert!(err.contains("--regions changes nothing with --labels"), "{err}");
    let (_, err) = run(folder.path(), &[&BASE[..], &["--dry-run"]].concat(), 0);
    assert!(!err.contains("--regions"), "{err}");
}

#[test]
fn labels_on_another_grid_are_resampled_or_refused() {
    let folder = folder();
    let (path, moduli) = (folder.path().join("labels.nii.gz"), folder.path().join("results/regions.csv"));
    let (_, err) = run(folder.path(), &BASE, 0);
    assert!(!err.contains("resampled"), "{err}");
    let (own, expected) = (io::read_labels(&path).unwrap(), fs::read(&moduli).unwrap());
    // The same labels with two voxels of air around them.
    let wider = Grid::new([20; 3], Affine::scaled([1.0; 3], [-5.0, 3.0, -1.0]).unwrap()).unwrap();
    let padded = Mask::from_voxels(wider, |at, _| {
        let v = wider.voxel(at);
        let [i, j, k] = v.map(|i| i.wrapping_sub(2));
        if v.iter().all(|i| (2..18).contains(i)) { own.as_slice()[own.grid().index(i, j, k)] } else { 0 }
    });
    io::write_labels(&path, &padded, "").unwrap();
    let (_, err) = run(folder.path(), &[&BASE[..], &["--overwrite"]].concat(), 0);
    assert!(err.contains("labels.nii.gz: lies on another grid than field.nii.gz"), "{err}");
    assert_eq!(fs::read(&moduli).unwrap(), expected);
    fs::remove_dir_all(folder.path().join("results")).unwrap();
    let far = Grid::new([16; 3], Affine::scaled([1.0; 3], [90.0; 3]).unwrap()).unwrap();
    io::write_labels(&path, &Mask::filled(far, 1), "").unwrap();
    refused(folder.path(), &[], 1, &["labels.nii.gz", "does not overlap field.nii.gz", "palpate info"]);
}

#[test]
fn an_empty_held_patch_is_refused() {
    let folder = folder();
    let mut mask = Mask::filled(grid([16, 16, 16]), 0);
    mask.as_mut_slice()[0] = 1;
    io::write_labels(folder.path().join("nail.nii.gz"), &mask, "").unwrap();
    refused(folder.path(), &["--held", "nail.nii.gz"], 1, &["held", "nail.nii.gz", "is empty", "x-"]);
    refused(folder.path(), &["--held", "zz"], 1, &["--held zz", "neither a side"]);
    refused(folder.path(), &["--held", "z+"], 1, &["is the held one", "two different sides"]);
}

#[test]
fn a_body_at_rest_has_no_load() {
    let folder = folder();
    io::write_field(folder.path().join("field.nii.gz"), &DenseField::zeros(grid([16, 16, 16]))).unwrap();
    refused(folder.path(), &[], 1, &["no load", "--load"]);
}

#[test]
fn a_body_pulled_apart_is_refused_with_what_may_be_wrong() {
    let folder = folder();
    let path = folder.path().join("field.nii.gz");
    let mut field = io::read_field(&path).unwrap();
    field.as_mut_slice().iter_mut().for_each(|v| *v = -*v);
    io::write_field(&path, &field).unwrap();
    refused(folder.path(), &[], 1, &["no load", "apart", "wrong order"]);
}

#[test]
fn forces_without_a_sequence_are_refused() {
    // They went unheard: --field, which --sequence conflicts with, had lifted the requirement.
    refused(folder().path(), &["--forces", "1,2"], 2, &["--forces", "--sequence", "--total-force"]);
}

#[test]
fn a_slice_is_refused_by_a_dry_run_too() {
    let folder = folder();
    let mut labels = io::read_labels(folder.path().join("labels.nii.gz")).unwrap();
    let g = *labels.grid();
    labels.as_mut_slice().iter_mut().enumerate().for_each(|(o, l)| *l *= u8::from(g.voxel(o)[1] == 7));
    io::write_labels(folder.path().join("labels.nii.gz"), &labels, "").unwrap();
    for more in [&[][..], &["--dry-run"]] {
        refused(folder.path(), more, 1, &["labels.nii.gz", "one voxel thick", "axis y"]);
    }
    refused(self::folder().path(), &["--dry-run", "--held", "z+"], 1, &["is the held one"]);
}

#[test]
fn what_is_left_out_or_left_over_is_warned_of() {
    let folder = folder();
    let path = folder.path().join("field.nii.gz");
    let whole = io::read_field(&path).unwrap();
    let (_, err) = run(folder.path(), &BASE, 0);
    assert!(!err.contains("left"), "{err}");
    let g = *whole.grid();
    let mut holed = whole.clone();
    let n = g.len();
    holed.as_mut_slice()[n + g.index(7, 7, 7)] = f32::NAN;
    io::write_field(&path, &holed).unwrap();
    let (_, err) = run(folder.path(), &[&BASE[..], &["--overwrite"]].concat(), 0);
    assert!(err.contains("1 voxels of the body hold no finite displacement"), "{err}");
    // A wave that no elastic body between two plates makes.
    let mut waved = whole.clone();
    for (o, v) in waved.as_mut_slice()[..n].iter_mut().enumerate() {
        *v += 0.2 * (g.voxel(o)[2] as f32).sin();
    }
    io::write_field(&path, &waved).unwrap();
    let (_, err) = run(folder.path(), &[&BASE[..], &["--overwrite"]].concat(), 0);
    assert!(err.contains("the model leaves over"), "{err}");
}

#[test]
fn a_body_in_two_pieces_is_refused() {
    let folder = folder();
    let path = folder.path().join("labels.nii.gz");
    let mut labels = io::read_labels(&path).unwrap();
    let at = labels.grid().index(0, 0, 0);
    labels.as_mut_slice()[at] = 1;
    io::write_labels(&path, &labels, "").unwrap();
    refused(folder.path(), &[], 1, &["2 pieces", "keep the largest component"]);
}

#[test]
fn regions_that_are_looked_for_are_announced_and_written() {
    let folder = folder();
    let base = ["stiffness", "--field", "field.nii.gz", "--mask", "labels.nii.gz", "--nodes", "500", "-o", "results"];
    let (plan, _) = run(folder.path(), &[&base[..], &["--dry-run"]].concat(), 0);
    assert!(plan.contains("1,728 voxels; up to 4 regions are looked for") && plan.contains("regions.nii.gz"), "{plan}");
    let (plan, _) = run(folder.path(), &[&BASE[..], &["--dry-run"]].concat(), 0);
    assert!(plan.contains("1 (864 voxels), 2 (864 voxels)") && !plan.contains("regions.nii.gz"), "{plan}");
    run(folder.path(), &base, 0);
    let found = io::read_volume(folder.path().join("results/regions.nii.gz")).unwrap();
    assert_eq!(found.as_slice().iter().filter(|v| **v == 1.0).count(), 1728);
    // Of a run with labels it would be a stranger.
    run(folder.path(), &[&BASE[..], &["--overwrite"]].concat(), 0);
    assert!(!folder.path().join("results/regions.nii.gz").exists());
}
