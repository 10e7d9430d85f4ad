//! `palpate demo`: displacement and strain of a synthetic calf, or the whole chain on a synthetic
//! finger pad. Every stage is scored against its truth, on one page.

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
use palpate::types::fingertip::{StiffnessFolder, StiffnessRegion};
use palpate::types::{Metrics, Volume};
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
/// The same without --chain.
const FIRST_FILES: [&str; 6] = ["phantom", "field", "strain", "exact-strain", "chain.csv", "report.html"];
/// How far the plate goes in (mm).
const AMPLITUDE: &str = "1.5";

#[derive(Debug, Args)]
pub struct Options {
    /// Folder for the results; those of an earlier demo are replaced
    #[arg(short, long, value_name = "DIR", default_value = "palpate-demo")]
    output: PathBuf,
    /// Every command in turn, from two volumes of a finger pad to a grasp (about 90 CPU seconds)
    #[arg(long)]
    chain: bool,
    /// Write into a folder that is not empty
    #[arg(long, alias = "force")]
    overwrite: bool,
    /// Voxels of the phantom along x; the field of view stays
    #[arg(long, value_name = "N")]
    size: Option<usize>,
    /// With --chain: nodes of the stiffness mesh, about
    #[arg(long, value_name = "N", default_value_t = 8000)]
    nodes: usize,
    #[command(flatten)]
    tuning: Tuning,
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { output, overwrite, tuning, .. } = options;
    tuning.params()?;
    let earlier = ["phantom", "summary.json"].iter().all(|f| output.join(f).exists());
    let used = io::list(output).is_ok_and(|files| !files.is_empty());
    if used && !earlier && !overwrite {
        bail!("{}: is not empty; choose another folder, or write into it with --overwrite", output.shown());
    }
    // Held from here on: no other run comes between the steps.
    let mut folder = OutputFolder::create(output, true)?;
    let record = Recording::start(console, record::inputs(&[("config", tuning.config())]));
    let Scored { title, about, rows, metrics, parts, files } =
        if options.chain { chain(options, console)? } else { first(options, console)? };
    let parts = parts
        .iter()
        .map(|&(title, file)| io::read_text(output.join(file)).map(|content| Part { title, file, content }));
    let parts = parts.collect::<Result<Vec<_>, _>>()?;
    let summary = json!({
        "version": env!("CARGO_PKG_VERSION"), "command": "demo", "metrics": metrics, "chain": rows, "parts": files,
    });
    let record = record.finish();
    folder.write("chain.csv", |p| io::write_chain(p, &rows))?;
    folder.write("summary.json", |p| io::write_json(p, &in_summary(summary, &record)))?;
    folder.write("report.html", |p| io::write_text(p, &on_page(page(title, about, &rows, &parts), &record)))?;
    folder.commit()?;
    console.say(&format!("\n{}\nLook at {}", text(&rows), output.join("report.html").shown()));
    Ok(())
}

/// What a demo came to.
struct Scored {
    title: &'static str,
    about: &'static str,
    rows: Vec<Row>,
    metrics: Metrics,
    /// Title and file of each part of the page.
    parts: &'static [(&'static str, &'static str)],
    files: &'static [&'static str],
}

/// A part of the demo as an argument of a command.
fn path(output: &Path, part: &str) -> String {
    output.join(part).to_string_lossy().into_owned()
}

/// Runs one command of the program, and says which.
fn step(words: &[&str], console: &Console) -> Result<()> {
    console.say(&format!("\n$ palpate {}", words.join(" ")));
    let Cli { command, .. } = Cli::try_parse_from([&["palpate"], words].concat())?;
    super::dispatch(&command, &console.for_command(words))
}

/// Makes a phantom, and measures its displacement.
fn measured(kind: &[&str], options: &Options, console: &Console) -> Result<()> {
    let Options { output, size, tuning, .. } = options;
    let at = |part: &str| path(output, part);
    let (seed, cells) = (tuning.params()?.seed.to_string(), size.map(|n| n.to_string()));
    let phantom = at("phantom");
    let mut make = [&["phantom"], kind, &["--seed", &seed, "--overwrite", "-o", &phantom]].concat();
    if let Some(cells) = &cells {
        make.extend(["--size", cells]);
    }
    step(&make, console)?;
    let [initial, deformed, mask, field] =
        ["phantom/initial.nii.gz", "phantom/deformed.nii.gz", "phantom/mask.nii.gz", "field"].map(at);
    let mut measure = vec!["field", &initial, &deformed, "--mask", &mask, "--overwrite", "-o", &field];
    let tuned = tuning.arguments();
    measure.extend(tuned.iter().map(String::as_str));
    step(&measure, console)
}

/// Displacement and strain of a calf under a blunt indenter.
fn first(options: &Options, console: &Console) -> Result<Scored> {
    let output = &options.output;
    let at = |part: &str| path(output, part);
    measured(&["calf", "--motion", "press"], options, console)?;
    let (field, strain) = (at("field"), at("strain"));
    step(&["strain", &field, "--overwrite", "-o", &strain], console)?;
    let gauge = io::read_json(output.join("strain/summary.json"))?["gauge_mm"].to_string();
    let (truth, mask, exact) = (at("phantom/truth.nii.gz"), at("phantom/mask.nii.gz"), at("exact-strain"));
    step(&["strain", &truth, "--mask", &mask, "--gauge", &gauge, "--overwrite", "-o", &exact], console)?;
    let (mut rows, metrics) = field_rows(output)?;
    rows.push(strain_row(output)?);
    Ok(Scored {
        title: "Displacement and strain of a calf",
        about: "A synthetic calf before and after a blunt indenter pressed it. The displacement and the strain are compared with \
                the exact truth.",
        rows,
        metrics,
        parts: &[("Field", "field/report.html"), ("Strain", "strain/report.html")],
        files: &FIRST_FILES,
    })
}

/// The largest shear strain against that of the exact displacement over the same gauge.
fn strain_row(output: &Path) -> Result<Row> {
    let read = |name: &str| io::read_volume(output.join(name).join("shear.nii.gz"));
    let (found, exact) = (read("strain")?, read("exact-strain")?);
    let pairs = found.as_slice().iter().zip(exact.as_slice()).map(|(a, b)| [f64::from(*a), f64::from(*b)]);
    let seen: Vec<[f64; 2]> = pairs.filter(|p| p.iter().all(|v| v.is_finite()) && p[1] > 0.0).collect();
    let mean = |of: &dyn Fn(&[f64; 2]) -> f64| 100.0 * seen.iter().map(of).sum::<f64>() / seen.len().max(1) as f64;
    Ok(Row::error(
        "strain",
        "mean error of the largest shear strain",
        "%",
        mean(&|p| (p[0] - p[1]).abs()),
        mean(&|p| p[1]),
    ))
}

/// Every command in turn on a finger pad.
fn chain(options: &Options, console: &Console) -> Result<Scored> {
    let output = &options.output;
    let at = |part: &str| path(output, part);
    measured(&["fingertip", "--amplitude", AMPLITUDE], options, console)?;
    let told = io::read_json(output.join("phantom/phantom.json"))?;
    let elastic = &told["elastic"];
    let word = |key: &str| elastic[key].as_str().unwrap_or_default().to_string();
    let (held, load, newton) = (word("held"), word("load"), elastic["force_n"].to_string());
    let regions = elastic["regions"].as_array().cloned().unwrap_or_default();
    let names: Vec<String> =
        regions.iter().map(|r| format!("{}={}", r["label"], r["name"].as_str().unwrap_or_default())).collect();
    let (names, nodes) = (names.join(","), options.nodes.to_string());
    let [field, labels, stiffness, tip, scene, grasp] =
        ["field", "phantom/labels.nii.gz", "stiffness", "fingertip.toml", "scene.toml", "grasp"].map(at);
    let known = ["--labels", &labels, "--names", &names, "--held", &held, "--load", &load, "--total-force", &newton];
    let rest = ["--nodes", &nodes, "--overwrite", "-o", &stiffness];
    step(&[&["stiffness", "--field", &field][..], &known, &rest].concat(), console)?;
    step(&["fingertip", &stiffness, "-o", &tip], console)?;
    io::write_text(output.join("scene.toml"), SCENE)?;
    step(&["grasp", &scene, "--overwrite", "-o", &grasp], console)?;

    let (mut rows, metrics) = field_rows(output)?;
    rows.extend(stiffness_rows(output, &regions)?);
    rows.extend(press_row(output, &told)?);
    exact_fingertip(output, &told, &regions)?;
    rows.extend(grasp_rows(output)?);
    Ok(Scored {
        title: "From two volumes to a grasp",
        about: "A synthetic finger pad, pressed on a plate. Every command measured it in turn, and each result is compared with the \
                exact truth.",
        rows,
        metrics,
        parts: &[
            ("Field", "field/report.html"),
            ("Stiffness", "stiffness/report.html"),
            ("Fingertip", "fingertip.svg"),
            ("Grasp", "grasp/report.html"),
        ],
        files: &FILES,
    })
}

/// The field against the exact displacement.
fn field_rows(output: &Path) -> Result<(Vec<Row>, Metrics)> {
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
