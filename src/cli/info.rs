//! `palpate info`: what a file is, and what can be done with it.

use super::console::Console;
use super::dry_run::times;
use super::inputs::{name, two_places};
use super::kinds;
use anyhow::{Result, bail};
use clap::Args;
use palpate::error::Shown;
use palpate::io::{self, Form, ImageKind, SceneOverrides, Series, TableKind};
use palpate::pipeline::dry_run::memory;
use palpate::report::info::{self, Facts};
use palpate::report::record::command_line;
use palpate::report::scale::{significant, thousands};
use palpate::transforms::Chain;
use palpate::types::record::RunRecord;
use serde_json::Value;
use std::path::{Path, PathBuf};

#[derive(Debug, Args)]
pub struct Options {
    /// Whatever palpate reads or writes: volumes, fields, label maps, transforms, tables, meshes,
    /// scenes, summary.json, or a folder of palpate or of a DICOM series
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// JSON instead of text
    #[arg(long)]
    json: bool,
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let (mut all, mut unread) = (Vec::new(), Vec::new());
    for path in &options.files {
        match facts(path) {
            Ok(facts) => all.push(facts),
            Err(error) => unread.push(error),
        }
    }
    // What can be read is shown, whatever stands beside it.
    if !all.is_empty() {
        let said = match options.json {
            true => serde_json::to_string_pretty(&all.iter().map(Facts::json).collect::<Vec<Value>>())?,
            false => all.iter().map(Facts::text).collect::<Vec<_>>().join("\n"),
        };
        console.say(&said);
    }
    let last = unread.pop();
    unread.iter().for_each(|error| console.error(error));
    last.map_or(Ok(()), Err)
}

fn facts(path: &Path) -> Result<Facts> {
    let called = name(path);
    let lower = called.to_lowercase();
    let mut facts = Facts::new(&called);
    if path.is_dir() {
        return of_folder(facts, path);
    }
    if lower.ends_with(".toml") {
        of_toml(&mut facts, path)?;
    } else if lower.ends_with(".json") && !lower.ends_with(".mrk.json") {
        return of_json(facts, path);
    } else if [".csv", ".fcsv", ".mrk.json"].iter().any(|e| lower.ends_with(e)) {
        return of_table(facts, path);
    } else if lower.ends_with(".log") {
        facts.is("log of a stage of palpate batch");
    } else if [".tfm", ".mat", ".txt", ".h5"].iter().any(|e| lower.ends_with(e)) && !of_elastix(path) {
        of_transform(&mut facts, path)?;
    } else {
        return of_form(facts, path);
    }
    Ok(facts)
}

fn command(summary: &Value) -> &str {
    summary.get("command").and_then(Value::as_str).unwrap_or("stiffness")
}

/// A folder: results by their summary, a phantom, a pair of a batch, or a DICOM series.
fn of_folder(mut facts: Facts, path: &Path) -> Result<Facts> {
    let told = ["summary.json", "certificate.json"].map(|file| path.join(file)).into_iter().find(|f| f.is_file());
    if let Some(told) = told {
        let summary = io::read_json(&told)?;
        facts.is(&format!("results of palpate {}", command(&summary)));
        of_summary(&mut facts, &summary, &told, path);
    } else if path.join("phantom.json").is_file() {
        facts.is("phantom of palpate");
        of_phantom(&mut facts, &io::read_json(path.join("phantom.json"))?);
        let folder = path.shown();
        if path.join("initial.nii.gz").is_file() {
            facts.does(&format!("palpate field {folder} {folder} --mask {folder} --truth {folder} -o FIELD"));
            facts.does(&format!("palpate evaluate FIELD --truth {folder} --mask {folder}"));
        } else {
            facts.does(&format!("palpate track {folder}/frame_*.nii.gz -o TRACKED"));
        }
    } else if path.join("pair.json").is_file() {
        facts.is("pair of palpate batch");
    } else {
        return of_image(facts, path);
    }
    Ok(facts)
}

fn of_json(mut facts: Facts, path: &Path) -> Result<Facts> {
    let told = io::read_json(path)?;
    if told.get("markups").is_some() {
        return of_table(facts, path);
    }
    if told.get("version").is_some() && told.get("command").is_some() {
        facts.is(&format!("summary of palpate {}", command(&told)));
        of_summary(&mut facts, &told, path, path.parent().unwrap_or(Path::new("")));
    } else if told.get("noise_sigma").is_some() && told.get("mean_mm").is_some() {
        facts.is("description of a phantom");
        of_phantom(&mut facts, &told);
    } else if told["stages"].is_array() {
        facts.is("record of a pair of palpate batch");
    } else {
        bail!("{}: is JSON, but no summary of palpate; nothing can be done with it", path.shown());
    }
    Ok(facts)
}

fn of_phantom(facts: &mut Facts, told: &Value) {
    // Those of a sequence stand under `params`.
    let of = |key: &str| if told[key].is_null() { told["params"][key].clone() } else { told[key].clone() };
    for key in ["kind", "motion", "amplitude", "seed"] {
        let value = of(key);
        if !value.is_null() {
            facts.add(if key == "kind" { "body" } else { key }, value.to_string().trim_matches('"').into(), value);
        }
    }
}

fn of_summary(facts: &mut Facts, summary: &Value, path: &Path, folder: &Path) {
    if let Some(inputs) = summary.get("inputs") {
        facts.add("inputs", inputs.to_string(), inputs.clone());
    }
    for (key, words) in [("version", "version"), ("date", "date"), ("trust", "trust"), ("headline", "headline")] {
        if let Some(text) = summary[key].as_str() {
            facts.add(words, text.into(), text.into());
        }
    }
    let command = command(summary);
    if let Ok(record) = serde_json::from_value::<RunRecord>(summary.clone()) {
        facts.add("command line", command_line(&record), record.command_line.into());
        facts.does(&format!("palpate {command} --config {} -o AGAIN    # the same run", path.shown()));
    }
    if summary.get("params").is_some() {
        facts.does(&format!("palpate field INITIAL DEFORMED -o AGAIN --config {}", path.shown()));
    }
    let folder = folder.shown();
    match command {
        "field" | "demo" => {
            facts.does(&format!("palpate strain {folder} -o STRAIN"));
            facts.does(&format!("palpate stiffness --field {folder} --labels LABELS -o STIFFNESS"));
            facts.does(&format!("palpate evaluate {folder} --landmarks LANDMARKS"));
        }
        "track" => facts.does(&format!("palpate stiffness --sequence {folder} --labels LABELS -o STIFFNESS")),
        "stiffness" => facts.does(&format!("palpate fingertip {folder} -o FINGERTIP.toml")),
        _ => {}
    }
}

fn of_toml(facts: &mut Facts, path: &Path) -> Result<()> {
    let (grasp, skin) = (io::read_scene(path, &SceneOverrides::default()), io::read_skin_scene(path));
    let tip = io::read_fingertip_press(path);
    match (grasp, skin, io::read_config(path)) {
        (Ok(scene), ..) => {
            facts.is("grasp scene");
            facts.add("motions", scene.scene.motions.len().to_string(), scene.scene.motions.len().into());
            facts.add("sweep", format!("{} cases", scene.sweep.len()), scene.sweep.len().into());
            facts.does(&format!("palpate grasp {} -o GRASP", path.shown()));
            facts.does(&format!("palpate grasp-analysis {} -o ANALYSIS", path.shown()));
        }
        (_, Ok(scene), _) => {
            facts.is("skin scene");
            facts.add("layers", scene.layers.len().to_string(), scene.layers.len().into());
            facts.does(&format!("palpate skin {} -o SKIN", path.shown()));
        }
        _ if tip.is_ok() => {
            facts.is("fingertip for a grasp scene");
            let kpa = 1e-3 * io::read_fingertip_modulus(path)?;
            facts.add("modulus", format!("{} kPa", significant(kpa)), kpa.into());
            facts.does(&format!("palpate grasp SCENE.toml -o GRASP    # with [fingertip] file = \"{}\"", path.shown()));
        }
        (.., Ok(params)) => {
            facts.is("parameters of a field run");
            facts.add("params", serde_json::to_string(&params)?, serde_json::to_value(&params)?);
            facts.does(&format!("palpate field INITIAL DEFORMED -o DIR --config {}", path.shown()));
        }
        (Err(grasp), Err(skin), Err(config)) => {
            bail!(
                "{}: is neither a scene nor parameters.\n  as a grasp scene: {grasp}\n  as a skin scene: {skin}\n  as parameters: {config}",
                path.shown()
            );
        }
    }
    Ok(())
}

/// Whether a file is a transform of elastix, which is known but not read.
fn of_elastix(path: &Path) -> bool {
    matches!(io::form_of(path), Ok(Form::Transform("elastix")))
}

/// Affine transforms, and chains of them and of fields.
fn of_transform(facts: &mut Facts, path: &Path) -> Result<()> {
    let found = io::read_transform(path, None, None, None)?;
    let (shown, count, chain) = (path.shown(), found.transforms.len(), Chain(found.transforms));
    facts.is(if count > 1 { "transforms in a row" } else { "transform" });
    facts.add("transforms", count.to_string(), count.into());
    if let Some(map) = chain.affine() {
        let rows = map.rows().map(|row| row.map(|v| format!("{v:.5}")).join(" ")).join("; ");
        facts.add("affine", format!("{rows} (world mm, RAS, initial to deformed)"), serde_json::to_value(map.rows())?);
    }
    if found.guessed {
        let note = "4 x 4 numbers do not say whose they are: read as greedy's or NiftyReg's; write fsl: before FLIRT's";
        facts.add("note", note.into(), note.into());
    }
    facts.does(&format!("palpate warp DEFORMED --transform {shown} --reference INITIAL -o BACK.nii.gz"));
    facts.does(&format!("palpate convert {shown} --to greedy -o FOR_GREEDY.mat"));
    Ok(())
}

fn of_table(mut facts: Facts, path: &Path) -> Result<Facts> {
    let shown = path.shown();
    let slicer = io::is_slicer(path);
    if slicer {
        facts.add("format", "point list of 3D Slicer".into(), "Slicer".into());
    } else {
        let (columns, rows) = io::columns_of(path)?;
        let known = kinds::table(&columns);
        if known.is_some() || io::table_kind(path).is_err() {
            let (kind, command) = known.unwrap_or(("table", ""));
            facts.is(kind);
            facts.add("lines", thousands(rows), rows.into());
            facts.add("columns", columns.join(", "), columns.into());
            if !command.is_empty() {
                facts.does(&command.replace("FILE", &shown.to_string()));
            }
            return Ok(facts);
        }
    }
    match io::table_kind(path)? {
        TableKind::Matches => {
            facts.is("matches");
            let matches = io::read_matches(path)?;
            let kept: Vec<_> = matches.kept().map(|m| m.initial).collect();
            let of = format!("{} of {}", thousands(kept.len()), thousands(matches.matches.len()));
            facts.add("kept", of, kept.len().into());
            facts.bounds(&kept);
            facts.does(&format!("palpate stiffness --field FIELD --matches {shown} --labels LABELS -o STIFFNESS"));
            facts.does(&format!("palpate markups {shown} -o MATCHES.mrk.json"));
        }
        TableKind::Landmarks => {
            facts.is("landmarks");
            let initial: Vec<_> = io::read_landmarks(path)?.iter().map(|l| l.initial).collect();
            facts.bounds(&initial);
            facts.does(&format!("palpate evaluate FIELD --landmarks {shown}"));
            facts.does(&format!("palpate markups {shown} -o LANDMARKS.mrk.json"));
        }
        TableKind::Points => {
            facts.is("points");
            facts.bounds(&io::read_points(path)?.points);
            facts.does(&format!("palpate warp --points {shown} --field FIELD -o MOVED.csv"));
        }
    }
    Ok(facts)
}

/// Files that are known by their first bytes; what is left is an image.
fn of_form(mut facts: Facts, path: &Path) -> Result<Facts> {
    match io::form_of(path)? {
        Form::Page => facts.is("page, for a browser"),
        Form::Drawing => facts.is("drawing, for a browser"),
        Form::Mesh { points, cells, data } => {
            let modulus = data.iter().any(|name| name == "youngs_modulus");
            let matches = data.iter().any(|name| name == "raw_displacement");
            facts.is(match (modulus, matches) {
                (true, _) => "mesh of a stiffness map",
                (_, true) => "mesh of a field's matches",
                _ => "mesh of VTK",
            });
            facts.add("points", thousands(points), points.into());
            facts.add("cells", thousands(cells), cells.into());
            facts.add("data", data.join(", "), data.into());
        }
        Form::Model(program) => facts.is(&format!("finite element model for {program}")),
        Form::Transform(program) => facts.is(&format!("transform of {program}")),
        Form::Other => return of_image(facts, path),
    }
    Ok(facts)
}

fn of_image(mut facts: Facts, path: &Path) -> Result<Facts> {
    let (stored, kind) = io::read_header(path)?;
    let shown = path.shown();
    if !stored.description.is_empty() {
        facts.add("description", stored.description.clone(), stored.description.clone().into());
    }
    facts.add("format", format!("{}, {}", stored.format, stored.datatype), stored.format.into());
    facts.add("datatype", String::new(), stored.datatype.into());
    let axes: Vec<String> = stored.axes.iter().map(ToString::to_string).collect();
    if stored.axes.len() > 3 {
        facts.add("axes", axes.join(" x "), stored.axes.clone().into());
    }
    facts.grid(&stored.grid, stored.placed);
    if let Some(note) = two_places(&stored) {
        facts.add("note", note.clone(), note.into());
    }
    let known = kinds::image(&stored.description);
    let frames = stored.axes.get(3).copied().unwrap_or(1);
    match kind {
        ImageKind::Scalar => {
            let volume = io::read_volume(path)?;
            facts.is(known.unwrap_or(if info::looks_like_labels(&volume) { "label map or mask" } else { "volume" }));
            facts.values(&volume);
            if info::looks_like_labels(&volume) {
                facts.does(&format!("palpate field INITIAL DEFORMED --mask {shown} -o DIR"));
                facts.does(&format!("palpate stiffness --field FIELD --labels {shown} -o STIFFNESS"));
                facts.does(&format!("palpate warp {shown} --field FIELD -o BACK.nii.gz"));
            } else if known.is_none() {
                let memory = memory(&stored.grid, &stored.grid) / 1_000_000;
                facts.does(&format!(
                    "palpate field {shown} DEFORMED -o DIR    # about {memory} MB for two of this size"
                ));
                facts.does(&format!("palpate warp {shown} --field FIELD -o BACK.nii.gz"));
            }
        }
        ImageKind::Field if known.is_some() => facts.is(known.unwrap_or_default()),
        ImageKind::Field => {
            facts.is("displacement field");
            match io::read_field(path) {
                Ok(field) => {
                    facts.field(&field);
                    facts.does(&format!("palpate stiffness --field {shown} --labels LABELS -o STIFFNESS"));
                    facts.does(&format!("palpate warp IMAGE --field {shown} -o BACK.nii.gz"));
                    facts.does(&format!("palpate invert {shown} -o INVERSE.nii.gz"));
                }
                Err(error) => facts.add("not as LPS", error.to_string(), error.to_string().into()),
            }
        }
        ImageKind::Series => {
            facts.is("series of volumes");
            let mut series = Series::open(path)?;
            let step = series.step_s();
            facts.add("frames", series.frames().to_string(), series.frames().into());
            facts.add("step", step.map_or("not known".into(), |s| format!("{s} s")), step.into());
            facts.values(&series.read(0)?);
            facts.does(&format!("palpate track {shown} -o TRACKED"));
        }
        ImageKind::Fields if known.is_some() => {
            facts.is(known.unwrap_or_default());
            facts.add("frames", frames.to_string(), frames.into());
        }
        ImageKind::Fields => {
            facts.is("series of displacement fields");
            facts.add("frames", frames.to_string(), frames.into());
            facts.does(
                "palpate stiffness --sequence TRACKED -o STIFFNESS    # with the folder that palpate track wrote",
            );
        }
        ImageKind::Tensors => {
            facts.is(known.unwrap_or("symmetric tensors, such as strain"));
            let words = "xx xy yy xz yz zz of symmetric tensors, axes LPS";
            facts.add("components", words.into(), 6.into());
        }
        ImageKind::Other if known.is_some() => facts.is(known.unwrap_or_default()),
        ImageKind::Other => {
            facts.is("image of another kind");
            let shape = times(stored.grid.shape());
            facts.add(
                "note",
                format!("neither a volume {shape}, a field nor a series; palpate does not read it"),
                Value::Null,
            );
        }
    }
    Ok(facts)
}
