//! `palpate stiffness --sequence`: the frames of a tracked sequence to one stiffness map.

use super::Usage;
use super::console::Console;
use super::inputs::{check_distinct, name, warn_all};
use super::stiffness::{FILES, Options, Setting, images, patch_files, plan, write};
use anyhow::{Context, Result, bail};
use palpate::io::{self, OutputFolder};
use palpate::pipeline::stiffness_sequence::{Sequence, motion};
use palpate::report::stiffness as report;
use palpate::types::StiffnessParams;
use std::path::{Path, PathBuf};

/// A frame: its number, its field, the force on the plate.
type Frame = (usize, PathBuf, Option<f64>);

pub fn run(options: &Options, params: &StiffnessParams, from: &Path, body: &Path, console: &Console) -> Result<()> {
    let reference = reference(from)?;
    let frames = frames(options, from, reference)?;
    let trajectories = from.join("trajectories.csv");
    let patches = patch_files(options);
    let others = patches.iter().chain(&options.images).map(PathBuf::as_path);
    let given: Vec<&Path> = frames.iter().map(|f| f.1.as_path()).chain([body]).chain(others).collect();
    let files: Vec<PathBuf> = FILES.iter().chain(&["frames.csv"]).map(|f| options.output.join(f)).collect();
    check_distinct(&given, &files)?;

    let progress = console.progress();
    progress.set("read", 0.0);
    let grid = *io::read_field(&frames[0].1)?.grid();
    let setting = Setting::read(options, body, &grid, &frames[0].1)?;
    let images = images(options, None, &grid)?;
    if options.dry_run {
        // Frames at rest are left out: one that can be used is enough.
        let mut refused = Ok(());
        for (_, path, _) in &frames {
            refused = setting
                .check(&io::read_field(path)?, params)
                .with_context(|| format!("{} with {}", name(path), name(body)));
            if refused.is_ok() {
                break;
            }
        }
        refused?;
        drop(progress);
        let forces: Vec<Option<f64>> = frames.iter().map(|f| f.2).collect();
        return plan(options, params, &frames[0].1, &setting, &forces, console);
    }
    let points = trajectories.is_file().then(|| io::read_trajectories(&trajectories, reference)).transpose()?;
    let mut order = Vec::new();
    for (at, (_, path, _)) in frames.iter().enumerate() {
        let field = io::read_field(path)?;
        if !field.grid().same_as(&grid) {
            bail!("{}: lies on another grid than {}; take fields of one track", path.display(), frames[0].1.display());
        }
        order.push((at, motion(&field, &setting.labels)));
    }
    // The frame that moved most decides on the law; lost frames come last.
    let rank = |m: f64| if m.is_finite() { m } else { -1.0 };
    order.sort_by(|a, b| rank(b.1).total_cmp(&rank(a.1)).then(a.0.cmp(&b.0)));
    let mut folder = OutputFolder::create(&options.output, options.overwrite)?;

    let mut sequence = Sequence::default();
    let count = order.len() as f64;
    for (done, &(at, moved)) in order.iter().enumerate() {
        let (frame, path, force_n) = &frames[at];
        let field = io::read_field(path)?;
        let part = done as f64 / count;
        let params = StiffnessParams { force_n: *force_n, ..sequence.params(params) };
        let matches = points.as_ref().and_then(|p| p.get(frame));
        let stage = format!("frame {frame}");
        let outcome = setting.run(&field, matches, &params, &|_, f| progress.set(&stage, part + f / count));
        if let Err(error) = &outcome {
            console.detail(&format!("frame {frame}: {error}"));
        }
        sequence.add(*frame, moved, outcome);
    }
    let mut shared = sequence.finish(&setting.labels).with_context(|| format!("{} with {}", name(from), name(body)))?;

    progress.set("write", 1.0);
    write(&mut folder, &mut shared.result)?;
    folder.write("frames.csv", |p| io::write_frames(p, &shared))?;
    let names = report::InputNames {
        field: name(from),
        body: name(body),
        matches: points.is_some().then(|| name(&trajectories)),
        held: options.held.clone(),
        load: options.load.clone(),
    };
    let mut summary = report::summary(&shared.result, &names);
    summary["sequence"] = report::sequence_summary(&shared);
    folder.write("summary.json", |p| io::write_json(p, &summary))?;
    let page = report::sequence_page(&shared, &names, &report::Shown { field: None, images: &images })?;
    folder.write("report.html", |p| io::write_text(p, &page))?;
    folder.commit()?;
    drop(progress);
    warn_all(console, &shared.result.warnings);
    let page = options.output.join("report.html");
    let frames = report::sequence_text(&shared);
    console.say(&format!("{}{frames}  results      {}", report::text(&shared.result), page.display()))
}

/// The reference frame, from the track's summary.
fn reference(from: &Path) -> Result<usize> {
    let path = from.join("summary.json");
    let hint = "give a folder that palpate track wrote";
    let summary = io::read_json(&path).context(hint)?;
    match summary["reference"].as_u64() {
        Some(frame) if summary["command"] == "track" => Ok(frame as usize),
        _ => bail!("{}: is not the summary of a track; {hint}", path.display()),
    }
}

/// The fields of all frames but the reference, by frame.
fn frames(options: &Options, from: &Path, reference: usize) -> Result<Vec<Frame>> {
    let mut found: Vec<(usize, PathBuf)> = io::list(from)?
        .into_iter()
        .filter_map(|path| {
            let number = path.file_name()?.to_str()?.strip_prefix("displacement_")?.strip_suffix(".nii.gz")?;
            Some((number.parse().ok()?, path))
        })
        .filter(|f: &(usize, PathBuf)| f.0 != reference)
        .collect();
    found.sort();
    if found.is_empty() {
        bail!("{}: holds no displacement_<t>.nii.gz; give a folder that palpate track wrote", from.display());
    }
    let forces = &options.forces;
    if !forces.is_empty() && forces.len() != found.len() {
        let text = format!("--forces names {} forces for {} frames besides the reference", forces.len(), found.len());
        bail!(Usage(text));
    }
    if let Some(bad) = forces.iter().find(|f| !(f.is_finite() && **f > 0.0)) {
        bail!(Usage(format!("--forces: {bad} is not above 0 N; give magnitudes, without a sign")));
    }
    Ok(found.into_iter().enumerate().map(|(i, (n, path))| (n, path, forces.get(i).copied())).collect())
}
