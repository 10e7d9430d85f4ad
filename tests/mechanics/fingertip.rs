//! Finger pads reduced to springs, against closed forms, and the command.

use crate::fixtures::run as palpate;
use palpate::error::FingertipError;
use palpate::fingertip::{columns, force, profile_force, reduce};
use palpate::io;
use palpate::pipeline::fingertip::{of_map, run};
use palpate::synth::{PhantomKind, PhantomParams, phantom};
use palpate::types::fingertip::{PadModel, StiffnessFolder, StiffnessRegion};
use palpate::types::{Affine, Grid, Volume};
use std::fs;
use tempfile::TempDir;

const BONE: f32 = 15_000.0;

/// A pad that faces z-: tissue of `modulus` by position (mm), bone from z = `top` up.
fn pad(n: [usize; 3], spacing: f64, top: f64, tissue: impl Fn([f64; 3]) -> f32 + Sync) -> Volume {
    let grid = Grid::new(n, Affine::scaled([spacing; 3], [0.0; 3]).unwrap()).unwrap();
    Volume::from_voxels(grid, |_, p| if p.0[2] >= top { BONE } else { tissue(p.0) })
}

fn bone(map: &Volume) -> impl Fn(usize) -> bool + '_ {
    |o| map.as_slice()[o] == BONE
}

#[test]
fn a_hemisphere_presses_as_pi_e_d_squared() {
    let (radius, e) = (10.0, 40.0f32);
    let inside = |p: [f64; 3]| (p[0] - 12.0).powi(2) + (p[1] - 12.0).powi(2) + (p[2] - 11.0).powi(2) < radius * radius;
    let map = pad([121, 121, 60], 0.2, 11.0, |p| if inside(p) { e } else { 0.0 });
    let cut = columns(&map, bone(&map), 2, false).unwrap();
    // The surface is known to half a voxel, 0.1 mm, and so is each column's length: another 2 %.
    for d in [2.0, 3.0, 4.0] {
        let truth = |d: f64| 1e-3 * std::f64::consts::PI * f64::from(e) * d * d;
        let found = force(&cut, d);
        let range = 0.98 * truth(d - 0.1)..1.02 * truth(d + 0.1);
        assert!(range.contains(&found), "{d} mm: {found:.4} N is not in {range:.4?} N");
    }
    let out = run(&map, bone(&map), [0.0, 0.0, -1.0], Some(3.0)).unwrap();
    assert_eq!(out.pad.model, PadModel::Uniform);
    assert!((out.pad.effective_kpa - 40.0).abs() < 1e-6, "{}", out.pad.effective_kpa);
    assert!((out.pad.hemisphere_kpa / 40.0 - 1.0).abs() < 0.1, "{}", out.pad.hemisphere_kpa);
    // Half a voxel at the apex; a paraboloid over so deep a cap would give 8.5.
    assert!((out.pad.radius_mm / radius - 1.0).abs() < 0.04, "{}", out.pad.radius_mm);
}

#[test]
fn layers_add_up_in_series() {
    let map = pad([20, 20, 20], 0.5, 8.0, |p| if p[2] < 2.0 { 80.0 } else { 20.0 });
    let cut = columns(&map, bone(&map), 2, false).unwrap();
    assert_eq!(cut.len(), 400);
    for c in &cut {
        assert!((c.compliance - (2.0 / 80.0 + 6.0 / 20.0)).abs() < 1e-9 && (c.length - 8.0).abs() < 1e-9);
    }
    // A flat pad of one thickness needs no more than one modulus, whatever its layers.
    let flat = reduce(&cut, 1.0);
    assert_eq!(flat.model, PadModel::Uniform);
    assert!((flat.effective_kpa - 8.0 / 0.325).abs() < 1e-6);
    // From the other end, over bone at once: nothing to press.
    assert_eq!(columns(&map, bone(&map), 2, true).unwrap_err(), FingertipError::TooFew { found: 0, needed: 20 });
}

#[test]
fn one_modulus_layers_and_map_are_told_apart() {
    // A wedge: thin on one side, with stiff skin of one thickness. Its columns are no longer alike.
    let surface = |p: [f64; 3]| 0.12 * (p[0] - 2.0).max(0.0);
    let wedge = |p: [f64; 3], skin: f64| match p[2] - surface(p) {
        z if z < 0.0 => 0.0,
        z if z < skin => 400.0,
        _ => 10.0f32,
    };
    let map = pad([60, 30, 80], 0.25, 6.0, |p| wedge(p, 1.0));
    let out = run(&map, bone(&map), [0.0, 0.0, -1.0], Some(1.5)).unwrap();
    assert!(out.pad.residuals[1] < out.pad.residuals[0], "{:?}", out.pad.residuals);
    // Three strips of different depth, the middle one stiff: only the map knows.
    let step = |p: [f64; 3]| match ((p[0] / 5.0) as usize, p[2]) {
        (0, _) => 5.0,
        (1, z) if z >= 0.5 => 500.0,
        (2, z) if z >= 1.0 => 5.0f32,
        _ => 0.0,
    };
    let map = pad([60, 30, 40], 0.25, 6.0, step);
    let out = run(&map, bone(&map), [0.0, 0.0, -1.0], Some(2.0)).unwrap();
    assert_eq!(out.pad.model, PadModel::Map, "{:?}", out.pad.residuals);
}

#[test]
fn unlike_springs_on_a_hemisphere_give_the_pads_force() {
    // A constant profile is the closed form.
    let flat = vec![[0.0, 30.0], [1.0, 30.0], [4.0, 30.0]];
    for d in [0.5, 2.0, 3.5] {
        let truth = 1e-3 * std::f64::consts::PI * 30.0 * d * d;
        assert!((profile_force(&flat, d) / truth - 1.0).abs() < 1e-3, "{d}");
    }
    // Springs that get stiffer outwards, E = 10 + 20 s: F = pi 10 d^2 + 2 pi 20 d^3 / 6.
    let line: Vec<[f64; 2]> = (0..9).map(|k| f64::from(k) * 0.5).map(|s| [s, 10.0 + 20.0 * s]).collect();
    for d in [0.7f64, 2.0, 3.9] {
        let truth = 1e-3 * std::f64::consts::PI * (10.0 * d * d + 20.0 * d.powi(3) / 3.0);
        assert!((profile_force(&line, d) / truth - 1.0).abs() < 1e-3, "{d}");
    }
    // A flat pad is no hemisphere, and springs that are soft outside press more like it.
    let map = pad([40, 40, 24], 0.5, 10.0, |_| 25.0);
    let out = run(&map, bone(&map), [0.0, 0.0, -1.0], Some(2.0)).unwrap().pad;
    assert!(out.hemisphere_residual > 0.1 && out.profile_residual < 0.5 * out.hemisphere_residual && out.tabulated());
    assert!(out.profile[0][1] > 3.0 * out.profile.last().unwrap()[1], "{:?}", out.profile);
}

/// Springs at the first contact were as stiff or as soft as the surface's steps of a voxel made the
/// first forces.
#[test]
fn the_profile_of_a_uniform_hemisphere_is_level_from_the_first_contact() {
    // What is left is half a voxel at the foremost place: of a press of 3 mm a twelfth, a twentieth
    // and a thirtieth.
    for (spacing, most) in [(0.5, 0.7), (0.3, 0.2), (0.2, 0.3)] {
        let (radius, n) = (10.0, (24.0 / spacing) as usize);
        let inside =
            |p: [f64; 3]| (p[0] - 12.0).powi(2) + (p[1] - 12.0).powi(2) + (p[2] - 11.0).powi(2) < radius * radius;
        let map = pad([n, n, n / 2], spacing, 11.0, |p| if inside(p) { 40.0 } else { 0.0 });
        let profile = run(&map, bone(&map), [0.0, 0.0, -1.0], Some(3.0)).unwrap().pad.profile;
        assert!(profile.iter().all(|p| (p[1] / 40.0 - 1.0).abs() < most), "{spacing}: {profile:?}");
        assert_eq!(profile[0][1], profile[1][1]);
    }
}

#[test]
fn deviations_of_tissue_reach_the_tip() {
    // Skin of 80 kPa over pulp of 20: in series, so that the pulp decides.
    let map = pad([20, 20, 20], 0.5, 8.0, |p| if p[2] < 2.0 { 80.0 } else { 20.0 });
    let known = |name: &str, youngs_modulus: f64, sd: f64| StiffnessRegion {
        name: name.into(),
        youngs_modulus,
        bound: None,
        sd,
        poisson: None,
    };
    let mut folder = StiffnessFolder {
        map,
        absolute: true,
        poisson: 0.49,
        regions: vec![known("skin", 80.0, 0.0), known("pulp", 20.0, 2.0), known("bone", 15_000.0, 0.0)],
        load: "z-".into(),
        held: "z+".into(),
        force_n: None,
        travel_mm: Some(1.0),
        translation: [[0.0; 3]; 2],
    };
    let tip = |folder: &StiffnessFolder| of_map(folder, 0, &|_, _| ()).unwrap().pad;
    // Compliance 2 / 80 + 6 / 20: ten per cent of the pulp's are 0.3 / 0.325 of that.
    let found = tip(&folder).deviation;
    assert!((found - 0.1 * 0.3 / 0.325).abs() < 0.003, "{found}");
    // Scaled to a measured force, what is left is that of the press.
    folder.force_n = Some(0.5);
    let found = tip(&folder).deviation;
    assert!((found - 0.03).abs() < 0.005, "{found}");
    // Of skin that is only a bound the tip has bounds: at most as if the skin were rigid.
    folder.force_n = None;
    folder.regions[0].bound = Some("lower".into());
    let [low, high] = tip(&folder).bounds.unwrap();
    assert!((low - 1.0).abs() < 1e-9 && (high - 0.325 / 0.3).abs() < 0.01, "{low} {high}");
}

#[test]
fn what_is_no_pad_is_refused() {
    let map = pad([20, 20, 20], 0.5, 100.0, |_| 20.0);
    assert_eq!(run(&map, bone(&map), [0.0, 0.0, -1.0], None).unwrap_err(), FingertipError::NoBone);
    let map = pad([20, 20, 20], 0.5, 8.0, |_| 20.0);
    let askew = run(&map, bone(&map), [0.0, 0.6, -0.8], None).unwrap_err();
    assert!(matches!(askew, FingertipError::Askew { degrees } if (degrees - 36.87).abs() < 0.1), "{askew:?}");
}

/// A folder as `palpate stiffness` leaves it.
fn stiffness_folder(absolute: bool, bone_name: &str) -> TempDir {
    let folder = TempDir::new().unwrap();
    let radius = 8.0;
    let inside = |p: [f64; 3]| (p[0] - 9.0).powi(2) + (p[1] - 9.0).powi(2) + (p[2] - 9.0).powi(2) < radius * radius;
    let hard = if bone_name == "bone" { BONE } else { 60.0 };
    let grid = Grid::new([46, 46, 30], Affine::scaled([0.4; 3], [0.0; 3]).unwrap()).unwrap();
    let map = Volume::from_voxels(grid, |_, p| match p.0[2] {
        z if z >= 9.0 => hard,
        _ if inside(p.0) => 40.0,
        _ => 0.0f32,
    });
    let out = folder.path().join("stiffness");
    fs::create_dir(&out).unwrap();
    io::write_volume(out.join("stiffness.nii.gz"), &map, "").unwrap();
    let summary = serde_json::json!({
        "command": "stiffness", "absolute": absolute, "force_n": 0.3,
        "inputs": { "load": "z-" },
        "regions": [
            { "name": "pulp", "youngs_modulus": 40.0, "bound": null },
            { "name": bone_name, "youngs_modulus": hard, "bound": null },
        ],
        "patches": { "held": { "translation": [0.0, 0.0, 0.0] }, "loaded": { "translation": [0.0, 0.0, 1.2] } },
    });
    io::write_json(out.join("summary.json"), &summary).unwrap();
    folder
}

#[test]
fn a_pad_becomes_a_tip_that_a_grasp_reads() {
    let folder = stiffness_folder(true, "bone");
    let (out, _) = palpate(folder.path(), &["fingertip", "stiffness", "-o", "tip.toml"], 0);
    assert!(out.contains("one modulus is enough") && out.contains("1.20 mm"), "{out}");
    let file: toml::Table = fs::read_to_string(folder.path().join("tip.toml")).unwrap().parse().unwrap();
    let pad = file["pad"].as_table().unwrap();
    assert!((pad["effective_kpa"].as_float().unwrap() - 40.0).abs() < 1e-3);
    // The hemisphere gives the measured force at the measured press.
    let e = file["youngs_modulus"].as_float().unwrap();
    let force = std::f64::consts::PI * e * 1.2e-3f64.powi(2);
    assert!((force / 0.3 - 1.0).abs() < 0.1, "{force}");
    assert!(fs::read_to_string(folder.path().join("tip.svg")).unwrap().contains("hemisphere"));

    let scene = include_str!("../../examples/eight_motions.toml")
        .lines()
        .filter(|l| !["radius", "youngs_modulus", "half_span"].iter().any(|k| l.starts_with(k)))
        .collect::<Vec<_>>()
        .join("\n")
        .replace("[fingertip]", "[fingertip]\nfile = \"tip.toml\"");
    fs::write(folder.path().join("scene.toml"), scene).unwrap();
    let (out, err) = palpate(folder.path(), &["grasp", "scene.toml", "-o", "grasp"], 0);
    assert!(out.contains("grasp/report.html"), "{out}{err}");
}

/// A map as `palpate stiffness` leaves it: tissue of `modulus` by position (mm) under bone from z =
/// `top` up, pressed from z-.
fn pad_folder(map: Volume, poisson: f64, travel: f64, force: Option<f64>) -> StiffnessFolder {
    let known = |name: &str, youngs_modulus| StiffnessRegion {
        name: name.into(),
        youngs_modulus,
        bound: None,
        sd: 0.0,
        poisson: None,
    };
    StiffnessFolder {
        map,
        absolute: true,
        poisson,
        regions: vec![known("pulp", 40.0), known("bone", f64::from(BONE))],
        load: "z-".into(),
        held: "z+".into(),
        force_n: force,
        travel_mm: Some(travel),
        translation: [[0.0; 3]; 2],
    }
}

#[test]
fn a_plate_presses_the_elements_of_a_block_by_the_neo_hookean_law() {
    // Without a Poisson's ratio a block stays as wide as it is: P = mu (l - 1 / l), mu = E / 2.
    let (e, height, side) = (40.0f32, 6.0, 10.0);
    let map = pad([40, 40, 32], 0.25, height, |_| e);
    let out = of_map(&pad_folder(map, 0.0, 1.5, None), 1500, &|_, _| ()).unwrap();
    assert_eq!(out.failure, None);
    let plate = out.pad.plate.as_ref().unwrap();
    assert_eq!(plate.curve.len(), 12);
    for [d, f] in &plate.curve {
        let l = 1.0 - d / height;
        let truth = 1e-3 * side * side * 0.5 * f64::from(e) * (1.0 / l - l);
        // The mesh rounds the block's edges by part of a voxel: 5 % of its face, less as they come
        // into touch.
        let bound = if *d < 1.0 { 0.06 } else { 0.03 };
        assert!((f / truth - 1.0).abs() < bound, "{d} mm: {f} N, not {truth}");
    }
    // Columns without Poisson's ratio are the linear law of the same springs.
    assert!((plate.factor - 1.0).abs() < 0.2, "{}", plate.factor);
    assert!((out.at_press.unwrap()[1] / plate.at(1.5).unwrap() - 1.0).abs() < 1e-12);
    assert!(plate.at(3.0).is_none());
}

#[test]
fn elements_of_a_finger_pad_press_as_the_phantom_does() {
    // The phantom's forces come from another solver, on hexahedra fitted to the exact shape. A
    // voxel map tells where the foremost place lies to half a voxel, so the press goes by what it
    // adds from one depth to another.
    let params = PhantomParams { amplitude: 1.5, ..PhantomParams::new(PhantomKind::Fingertip) }.sized(36);
    let body = phantom(&params).unwrap();
    let (known, told) = (body.stiffness.as_ref().unwrap(), body.description.elastic.as_ref().unwrap());
    let values = known.youngs_modulus_kpa.as_slice();
    let map = Volume::from_voxels(*body.initial.grid(), |o, _| values[o]);
    let half = 0.5 * body.initial.grid().least_spacing();
    let mut folder = pad_folder(map, told.poisson, 1.5 + half, Some(told.force_n));
    folder.regions =
        vec![StiffnessRegion { name: "bone".into(), youngs_modulus: 15_000.0, bound: None, sd: 0.0, poisson: None }];
    let out = of_map(&folder, 2000, &|_, _| ()).unwrap();
    let plate = out.pad.plate.as_ref().unwrap();
    let [low, high] = [1.5 - half, 1.5 + half].map(|d| plate.at(d).unwrap());
    assert!(low < 1.05 * told.force_n && told.force_n < 1.05 * high, "{low} to {high} N, not {}", told.force_n);
    // Columns are free to bulge: they give half.
    assert!(out.columns_at_press().unwrap() < 0.7 * told.force_n);
    // Bone that is known by a low bound only is a back plate all the same.
    let soft = Volume::from_voxels(*body.initial.grid(), |o, _| if values[o] > 1000.0 { 23.0 } else { values[o] });
    folder.map = soft;
    folder.regions[0] = StiffnessRegion {
        name: "bone".into(),
        youngs_modulus: 23.0,
        bound: Some("lower".into()),
        sd: 0.0,
        poisson: None,
    };
    let again = of_map(&folder, 2000, &|_, _| ()).unwrap();
    assert_eq!(again.pad.plate.unwrap().curve, plate.curve);
}

#[test]
fn elements_that_give_way_before_the_press_leave_the_columns_alone() {
    // A ball of 8 mm squeezed to a twentieth: the elements' forces end on the way, and a modulus
    // fitted to what there is of them must not be scaled by what the columns give at the press.
    let inside = |p: [f64; 3]| (p[0] - 9.0).powi(2) + (p[1] - 9.0).powi(2) + (p[2] - 9.0).powi(2) < 64.0;
    let map = pad([46, 46, 30], 0.4, 9.0, |p| if inside(p) { 40.0 } else { 0.0 });
    let folder = pad_folder(map, 0.49, 7.6, Some(3.0));
    let [alone, found] = [0, 500].map(|nodes| of_map(&folder, nodes, &|_, _| ()).unwrap());
    assert!(found.failure.is_some() && found.pad == alone.pad && found.at_press == alone.at_press);
    assert!(found.warnings(&folder)[0].contains("the columns stand alone"), "{:?}", found.warnings(&folder));
}

#[test]
fn without_elements_the_columns_stand_alone() {
    let folder = stiffness_folder(true, "bone");
    let args = ["fingertip", "stiffness", "-o", "tip.toml", "--nodes", "0"];
    let (out, err) = palpate(folder.path(), &args, 0);
    assert!(!out.contains("elements") && out.contains("press        1.20 mm: columns") && err.is_empty(), "{out}{err}");
    let file: toml::Table = fs::read_to_string(folder.path().join("tip.toml")).unwrap().parse().unwrap();
    assert!(!file["pad"].as_table().unwrap().contains_key("finite_element_nodes"));
    let (_, err) = palpate(folder.path(), &["fingertip", "stiffness", "-o", "tip.toml", "--nodes", "20"], 2);
    assert!(err.contains("500 to 200,000"), "{err}");
}

#[test]
fn a_bone_of_which_only_a_low_bound_is_known_is_still_the_bone() {
    let folder = stiffness_folder(true, "bone");
    let path = folder.path().join("stiffness");
    // Bone above 1 kPa: softer than the pulp by number, and all the same the back plate.
    let map = io::read_volume(path.join("stiffness.nii.gz")).unwrap();
    let low = Volume::from_voxels(*map.grid(), |o, _| {
        map.as_slice()[o].min(41.0) - 40.0 * f32::from(map.as_slice()[o] > 100.0)
    });
    io::write_volume(path.join("stiffness.nii.gz"), &low, "").unwrap();
    let summary = fs::read_to_string(path.join("summary.json")).unwrap();
    let mut summary: serde_json::Value = serde_json::from_str(&summary).unwrap();
    summary["regions"][1]["youngs_modulus"] = 1.0.into();
    summary["regions"][1]["bound"] = "lower".into();
    io::write_json(path.join("summary.json"), &summary).unwrap();
    let (out, _) = palpate(folder.path(), &["fingertip", "stiffness", "-o", "tip.toml"], 0);
    assert!(out.contains("E 40.0 kPa"), "{out}");
}

#[test]
fn skin_of_which_only_a_low_bound_is_known_is_no_bone() {
    let folder = stiffness_folder(true, "bone");
    let path = folder.path().join("stiffness/summary.json");
    let mut summary: serde_json::Value = serde_json::from_str(&fs::read_to_string(&path).unwrap()).unwrap();
    summary["regions"][0]["bound"] = "lower".into();
    io::write_json(&path, &summary).unwrap();
    let (out, err) = palpate(folder.path(), &["fingertip", "stiffness", "-o", "tip.toml", "--nodes", "0"], 0);
    assert!(out.contains("E 40.0 kPa") && err.contains("only a bound of pulp's modulus"), "{out}{err}");
}

/// A changed summary: a body that no modulus makes stiff.
#[test]
fn a_forged_poissons_ratio_is_refused() {
    let folder = stiffness_folder(true, "bone");
    let path = folder.path().join("stiffness/summary.json");
    let good: serde_json::Value = serde_json::from_str(&fs::read_to_string(&path).unwrap()).unwrap();
    for forged in [0.5, 0.0, -0.3, 7.0] {
        let mut summary = good.clone();
        summary["poisson"] = forged.into();
        io::write_json(&path, &summary).unwrap();
        let (_, err) = palpate(folder.path(), &["fingertip", "stiffness", "-o", "tip.toml"], 1);
        assert!(err.contains("summary.json") && err.contains("poisson"), "{err}");
        assert!(!folder.path().join("tip.toml").exists());
    }
}

#[test]
fn bad_folders_are_refused() {
    let ratios = stiffness_folder(false, "bone");
    let (_, err) = palpate(ratios.path(), &["fingertip", "stiffness", "-o", "tip.toml"], 1);
    assert!(err.contains("ratios") && err.contains("--total-force"), "{err}");
    let soft = stiffness_folder(true, "muscle");
    let (_, err) = palpate(soft.path(), &["fingertip", "stiffness", "-o", "tip.toml"], 1);
    assert!(err.contains("no bone") && err.contains("--names"), "{err}");
    assert!(!soft.path().join("tip.toml").exists());
    let (_, err) = palpate(soft.path(), &["fingertip", "nowhere", "-o", "tip.toml"], 1);
    assert!(err.contains("summary.json"), "{err}");
    let (_, err) = palpate(soft.path(), &["fingertip", "stiffness", "-o", "tip.json"], 2);
    assert!(err.contains(".toml"), "{err}");
}
