//! `palpate demo`: the whole chain on a synthetic finger pad, every stage scored against its truth,
//! on one page.

use super::Cli;
use super::console::Console;
use super::field::Tuning;
use super::inputs::name;
use super::record::{self, Recording};
use anyhow::{Context, Result, bail};
use clap::{Args, Parser};
use palpate::error::Shown;
use palpate::evaluate;
use palpate::grasp::simulate::simulate;
use palpate::io::{self, OutputFolder, SceneOverrides};
use palpate::pipeline::fingertip;
use palpate::report::chain::{Part, Row, page, text};
use palpate::report::record::{in_summary, on_page};
use palpate::types::Volume;
use palpate::types::fingertip::{StiffnessFolder, StiffnessRegion};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// The grasp that the pad is put to.
const SCENE: &str = include_str!("../../examples/finger_pad.toml");
/// Parts of the chain, each in a folder or file of its own.
const FILES: [&str; 10] = [
    "phantom",
    "field",
    "stiffness",
    "fingertip.toml",
    "scene.toml",
    "exact.toml",
    "exact-scene.toml",
    "grasp",
    "chain.csv",
    "report.html",
];
/// How far the plate goes in (mm).
const AMPLITUDE: &str = "1.5";

#[derive(Debug, Args)]
pub struct Options {
    /// Folder for the results; those of an earlier demo are replaced
    #[arg(short, long, value_name = "DIR", default_value = "palpate-demo")]
    output: PathBuf,
    /// Write into a folder that is not empty
    #[arg(long, alias = "force")]
    overwrite: bool,
    /// Voxels of the phantom along x; the field of view stays
    #[arg(long, value_name = "N")]
    size: Option<usize>,
    /// Nodes of the stiffness mesh, about
    #[arg(long, value_name = "N", default_value_t = 8000)]
    nodes: usize,
    #[command(flatten)]
    tuning: Tuning,
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { output, overwrite, size, nodes, tuning } = options;
    let params = tuning.params()?;
    let earlier = ["phantom", "summary.json"].iter().all(|f| output.join(f).exists());
    let used = io::list(output).is_ok_and(|files| !files.is_empty());
    if used && !earlier && !overwrite {
        bail!("{}: is not empty; choose another folder, or write into it with --overwrite", output.shown());
    }
    // Held from here on: no other run comes between the steps.
    let mut folder = OutputFolder::create(output, true)?;
    let at = |part: &str| output.join(part).to_string_lossy().into_owned();
    let record = Recording::start(console, record::inputs(&[("config", tuning.config())]));
    let step = |words: &[&str]| -> Result<()> {
        console.say(&format!("\n$ palpate {}", words.join(" ")));
        let Cli { command, .. } = Cli::try_parse_from([&["palpate"], words].concat())?;
        super::dispatch(&command, &console.for_command(words))
    };
    let (seed, cells, nodes) = (params.seed.to_string(), size.map(|n| n.to_string()), nodes.to_string());
    let mut make = vec!["phantom", "fingertip", "--amplitude", AMPLITUDE, "--seed", &seed, "--overwrite", "-o"];
    let phantom = at("phantom");
    make.push(&phantom);
    if let Some(cells) = &cells {
        make.extend(["--size", cells]);
    }
    step(&make)?;
    let told = io::read_json(output.join("phantom/phantom.json"))?;
    let elastic = &told["elastic"];
    let word = |key: &str| elastic[key].as_str().unwrap_or_default().to_string();
    let (held, load, newton) = (word("held"), word("load"), elastic["force_n"].to_string());
    let regions = elastic["regions"].as_array().cloned().unwrap_or_default();
    let names: Vec<String> =
        regions.iter().map(|r| format!("{}={}", r["label"], r["name"].as_str().unwrap_or_default())).collect();

    let file = |name: &str| at(&format!("phantom/{name}"));
    let (initial, deformed, mask, labels) =
        (file("initial.nii.gz"), file("deformed.nii.gz"), file("mask.nii.gz"), file("labels.nii.gz"));
    let (field, stiffness, tip, scene, grasp) =
        (at("field"), at("stiffness"), at("fingertip.toml"), at("scene.toml"), at("grasp"));
    let mut measure = vec!["field", &initial, &deformed, "--mask", &mask, "--overwrite", "-o", &field];
    let tuned = tuning.arguments();
    measure.extend(tuned.iter().map(String::as_str));
    step(&measure)?;
    let names = names.join(",");
    step(&[
        "stiffness",
        "--field",
        &field,
        "--labels",
        &labels,
        "--names",
        &names,
        "--held",
        &held,
        "--load",
        &load,
        "--total-force",
        &newton,
        "--nodes",
        &nodes,
        "--overwrite",
        "-o",
        &stiffness,
    ])?;
    step(&["fingertip", &stiffness, "-o", &tip])?;
    io::write_text(output.join("scene.toml"), SCENE)?;
    step(&["grasp", &scene, "--overwrite", "-o", &grasp])?;

    let (mut rows, metrics) = field_rows(output)?;
    rows.extend(stiffness_rows(output, &regions)?);
    rows.extend(press_row(output, &told)?);
    exact_fingertip(output, &told, &regions)?;
    rows.extend(grasp_rows(output)?);
    let parts = [
        ("Field", "field/report.html"),
        ("Stiffness", "stiffness/report.html"),
        ("Fingertip", "fingertip.svg"),
        ("Grasp", "grasp/report.html"),
    ];
    let parts =
        parts.map(|(title, file)| io::read_text(output.join(file)).map(|content| Part { title, file, content }));
    let parts = parts.into_iter().collect::<Result<Vec<_>, _>>()?;
    let summary = json!({
        "version": env!("CARGO_PKG_VERSION"), "command": "demo", "metrics": metrics, "chain": rows, "parts": FILES,
    });
    let record = record.finish();
    folder.write("chain.csv", |p| io::write_chain(p, &rows))?;
    folder.write("summary.json", |p| io::write_json(p, &in_summary(summary, &record)))?;
    folder.write("report.html", |p| io::write_text(p, &on_page(page(&rows, &parts), &record)))?;
    folder.commit()?;
    console.say(&format!("\n{}\nLook at {}", text(&rows), output.join("report.html").shown()));
    Ok(())
}

/// The field against the exact displacement.
fn field_rows(output: &Path) -> Result<(Vec<Row>, palpate::types::Metrics)> {
    let truth = io::read_field(output.join("phantom/truth.nii.gz"))?;
    let found = io::read_field(output.join("field/displacement.nii.gz"))?;
    let mask = io::read_mask(output.join("phantom/mask.nii.gz"))?;
    let landmarks = io::read_landmarks(output.join("phantom/landmarks.csv"))?;
    let metrics = evaluate::metrics(&found, &truth, Some(&mask), &landmarks).with_context(|| name(output))?;
    let rows = vec![Row::error("field", "mean error of the displacement", "mm", metrics.mean_mm, metrics.identity_mm)];
    Ok((rows, metrics))
}

/// Moduli against those of the phantom.
fn stiffness_rows(output: &Path, truth: &[Value]) -> Result<Vec<Row>> {
    let folder = io::read_stiffness(output.join("stiffness"))?;
    let row = |(r, t): (&StiffnessRegion, &Value)| {
        let exact = t["youngs_modulus_kpa"].as_f64().unwrap_or(f64::NAN);
        let what = format!("Young's modulus of {}", r.name);
        Row::value("stiffness", &what, "kPa", r.youngs_modulus, exact).bounded(r.bound.clone())
    };
    Ok(folder.regions.iter().zip(truth).map(row).collect())
}

/// The fingertip of the exact map and the scene with it, in files beside the measured ones.
fn exact_fingertip(output: &Path, told: &Value, regions: &[Value]) -> Result<()> {
    let map: Volume = io::read_volume(output.join("phantom/youngs_modulus.nii.gz"))?;
    let elastic = &told["elastic"];
    let number = |v: &Value| v.as_f64().unwrap_or(f64::NAN);
    let word = |key: &str| elastic[key].as_str().unwrap_or_default().to_string();
    let region = |r: &Value| StiffnessRegion {
        name: r["name"].as_str().unwrap_or_default().into(),
        youngs_modulus: number(&r["youngs_modulus_kpa"]),
        bound: None,
        poisson: None,
        sd: 0.0,
    };
    let exact = StiffnessFolder {
        map,
        absolute: true,
        poisson: number(&elastic["poisson"]),
        regions: regions.iter().map(region).collect(),
        load: word("load"),
        held: word("held"),
        force_n: elastic["force_n"].as_f64(),
        travel_mm: told["amplitude"].as_f64(),
        translation: [[0.0; 3]; 2],
    };
    let outcome = fingertip::of_map(&exact, fingertip::NODES, &|_, _| ())?;
    let calibration = outcome.calibration(exact.force_n);
    io::write_fingertip(output.join("exact.toml"), &outcome.pad, outcome.radius_mm(), calibration, "the exact map")?;
    Ok(io::write_text(output.join("exact-scene.toml"), &SCENE.replace("fingertip.toml", "exact.toml"))?)
}

/// The plate's force by the finite elements of the measured map, against the phantom's.
fn press_row(output: &Path, told: &Value) -> Result<Option<Row>> {
    let (elements, calibration) = io::read_fingertip_press(output.join("fingertip.toml"))?;
    let force = told["elastic"]["force_n"].as_f64().filter(|_| elements);
    Ok(force.map(|f| Row::value("fingertip", "force of the plate by finite elements", "N", f / calibration, f)))
}

/// The fingertip and the grasp against those of the exact map. The measured tip is taken as its map
/// gives it: the force of the press, by which its file scales it, is the phantom's own.
fn grasp_rows(output: &Path) -> Result<Vec<Row>> {
    let run = |scene: &str, calibration: f64| {
        let scene =
            io::read_scene(output.join(scene), &SceneOverrides::default())?.scene.with_moduli(1.0 / calibration);
        let run = simulate(&scene, &|_| {})?;
        let last = run.samples.last();
        let turn = last.map_or(f64::NAN, |s| s.pose[2].to_degrees());
        let grip = last.map_or(f64::NAN, |s| 0.5 * (s.normal_force[0] + s.normal_force[1]));
        let held = f64::from(u8::from(run.outcome() == "held"));
        Ok::<_, anyhow::Error>([1e-3 * scene.fingertip.youngs_modulus, grip, run.required_friction, turn, held])
    };
    let (_, calibration) = io::read_fingertip_press(output.join("fingertip.toml"))?;
    let (found, truth) = (run("scene.toml", calibration)?, run("exact-scene.toml", 1.0)?);
    let rows = [
        ("fingertip", "Young's modulus of the hemisphere", "kPa"),
        ("grasp", "grip force at the end", "N"),
        ("grasp", "friction needed", ""),
        ("grasp", "turn of the object at the end (geometry alone)", "degrees"),
        ("grasp", "held throughout (1)", ""),
    ];
    let row = |(k, (stage, what, unit)): (usize, (&'static str, &str, &'static str))| {
        Row::value(stage, what, unit, found[k], truth[k])
    };
    Ok(rows.into_iter().enumerate().map(row).collect())
}
