//! `palpate info`: what a file is, and what can be done with it.

use super::console::Console;
use super::dry_run::times;
use super::inputs::{name, two_places};
use anyhow::{Result, bail};
use clap::Args;
use palpate::io::{self, ImageKind, SceneOverrides, Series, TableKind};
use palpate::pipeline::plan::memory;
use palpate::report::info::{self, Facts};
use palpate::report::scale::thousands;
use palpate::transforms::Chain;
use serde_json::Value;
use std::path::{Path, PathBuf};

#[derive(Debug, Args)]
pub struct Options {
    /// Volumes, fields, label maps, transforms, tables of points, scenes, summary.json, or a folder
    /// of palpate or of a DICOM series
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
    // What can be read is told, whatever stands beside it.
    if !all.is_empty() {
        let said = match options.json {
            true => serde_json::to_string_pretty(&all.iter().map(Facts::json).collect::<Vec<Value>>())?,
            false => all.iter().map(Facts::text).collect::<Vec<_>>().join("\n"),
        };
        console.say(&said)?;
    }
    let last = unread.pop();
    unread.iter().for_each(|error| console.error(error));
    last.map_or(Ok(()), Err)
}

fn facts(path: &Path) -> Result<Facts> {
    let (called, shown) = (name(path), path.display());
    let lower = called.to_lowercase();
    let mut facts = Facts::new(&called);
    if path.is_dir() && path.join("summary.json").is_file() {
        let summary = io::read_json(path.join("summary.json"))?;
        facts.is(&format!("results of palpate {}", command(&summary)));
        of_summary(&mut facts, &summary, &path.join("summary.json"), path);
    } else if lower.ends_with(".toml") {
        of_toml(&mut facts, path)?;
    } else if lower.ends_with(".json") && !lower.ends_with(".mrk.json") {
        let summary = io::read_json(path)?;
        if summary.get("markups").is_some() {
            return of_table(facts, path);
        }
        if summary.get("version").is_none() || summary.get("command").is_none() {
            bail!("{shown}: is JSON, but no summary of palpate; nothing can be done with it");
        }
        facts.is(&format!("summary of palpate {}", command(&summary)));
        of_summary(&mut facts, &summary, path, path.parent().unwrap_or(Path::new("")));
    } else if [".csv", ".fcsv", ".mrk.json"].iter().any(|e| lower.ends_with(e)) {
        return of_table(facts, path);
    } else if [".tfm", ".mat", ".txt", ".h5"].iter().any(|e| lower.ends_with(e)) {
        of_transform(&mut facts, path)?;
    } else {
        return of_image(facts, path);
    }
    Ok(facts)
}

fn command(summary: &Value) -> &str {
    summary.get("command").and_then(Value::as_str).unwrap_or("stiffness")
}

fn of_summary(facts: &mut Facts, summary: &Value, path: &Path, folder: &Path) {
    if let Some(inputs) = summary.get("inputs") {
        facts.add("inputs", inputs.to_string(), inputs.clone());
    }
    if summary.get("params").is_some() {
        facts.does(&format!("palpate field INITIAL DEFORMED -o AGAIN --config {}", path.display()));
    }
    match command(summary) {
        "field" | "demo" => {
            let field = folder.join("displacement.nii.gz");
            facts.does(&format!("palpate strain {} -o STRAIN", folder.display()));
            facts.does(&format!("palpate stiffness --field {} --labels LABELS -o STIFFNESS", field.display()));
        }
        "stiffness" => facts.does(&format!("palpate fingertip {} -o FINGERTIP.toml", folder.display())),
        _ => {}
    }
}

fn of_toml(facts: &mut Facts, path: &Path) -> Result<()> {
    let (grasp, skin) = (io::read_scene(path, &SceneOverrides::default()), io::read_skin_scene(path));
    match (grasp, skin, io::read_config(path)) {
        (Ok(scene), ..) => {
            facts.is("grasp scene");
            facts.add("motions", scene.scene.motions.len().to_string(), scene.scene.motions.len().into());
            facts.add("sweep", format!("{} cases", scene.sweep.len()), scene.sweep.len().into());
            facts.does(&format!("palpate grasp {} -o GRASP", path.display()));
            facts.does(&format!("palpate grasp-analysis {} -o ANALYSIS", path.display()));
        }
        (_, Ok(scene), _) => {
            facts.is("skin scene");
            facts.add("layers", scene.layers.len().to_string(), scene.layers.len().into());
            facts.does(&format!("palpate skin {} -o SKIN", path.display()));
        }
        (.., Ok(params)) => {
            facts.is("parameters of a field run");
            facts.add("params", serde_json::to_string(&params)?, serde_json::to_value(&params)?);
            facts.does(&format!("palpate field INITIAL DEFORMED -o DIR --config {}", path.display()));
        }
        (Err(grasp), Err(skin), Err(config)) => {
            bail!(
                "{}: is neither a scene nor parameters.\n  as a grasp scene: {grasp}\n  as a skin scene: {skin}\n  as parameters: {config}",
                path.display()
            );
        }
    }
    Ok(())
}

/// Affine transforms, and chains of them and of fields.
fn of_transform(facts: &mut Facts, path: &Path) -> Result<()> {
    let found = io::read_transform(path, None, None, None)?;
    let (shown, count, chain) = (path.display(), found.transforms.len(), Chain(found.transforms));
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
    let shown = path.display();
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
            facts.does(&format!("palpate evaluate FIELD --truth TRUTH --landmarks {shown}"));
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

fn of_image(mut facts: Facts, path: &Path) -> Result<Facts> {
    let (stored, kind) = io::read_header(path)?;
    let shown = path.display();
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
    match kind {
        ImageKind::Scalar => {
            let volume = io::read_volume(path)?;
            facts.is(if info::looks_like_labels(&volume) { "label map or mask" } else { "volume" });
            facts.values(&volume);
            if info::looks_like_labels(&volume) {
                facts.does(&format!("palpate field INITIAL DEFORMED --mask {shown} -o DIR"));
                facts.does(&format!("palpate stiffness --field FIELD --labels {shown} -o STIFFNESS"));
                facts.does(&format!("palpate warp {shown} --field FIELD -o BACK.nii.gz"));
            } else {
                let memory = memory(&stored.grid, &stored.grid) / 1_000_000;
                facts.does(&format!(
                    "palpate field {shown} DEFORMED -o DIR    # about {memory} MB for two of this size"
                ));
                facts.does(&format!("palpate warp {shown} --field FIELD -o BACK.nii.gz"));
            }
        }
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
        ImageKind::Fields => {
            facts.is("series of displacement fields");
            let frames = stored.axes.get(3).copied().unwrap_or(1);
            facts.add("frames", frames.to_string(), frames.into());
            facts.does(
                "palpate stiffness --sequence TRACKED -o STIFFNESS    # with the folder that palpate track wrote",
            );
        }
        ImageKind::Tensors => {
            facts.is("symmetric tensors, such as strain");
            facts.add("components", "xx xy yy xz yz zz, axes LPS".into(), 6.into());
        }
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
