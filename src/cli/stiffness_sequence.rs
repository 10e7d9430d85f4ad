//! `palpate stiffness --sequence`: the frames of a tracked sequence to one stiffness map.

use super::Usage;
use super::console::Console;
use super::inputs::{check_distinct, name, warn_all};
use super::record::{Read, Recording};
use super::stiffness::{FILES, FOUND, Options, Setting, common_inputs, images, patch_files, plan, strict, write};
use anyhow::{Context, Result, bail};
use palpate::error::Shown;
use palpate::error::StiffnessError;
use palpate::io::{self, OutputFolder};
use palpate::pipeline::stiffness::FieldQuality;
use palpate::pipeline::stiffness_sequence::{Sequence, motion};
use palpate::report::record::{in_summary, on_page};
use palpate::report::stiffness as report;
use palpate::types::stiffness::Forecast;
use palpate::types::{SparseField, StiffnessParams, Trust};
use std::path::{Path, PathBuf};

/// A frame: its number, its field, the force on the plate.
type Frame = (usize, PathBuf, Option<f64>);

pub fn run(options: &Options, params: &StiffnessParams, from: &Path, body: &Path, console: &Console) -> Result<()> {
    let tracked = Tracked::of(from)?;
    let frames = frames(options, from, &tracked)?;
    let patches = patch_files(options);
    let others = patches.iter().chain(&options.images).map(PathBuf::as_path);
    let given: Vec<&Path> = frames.iter().map(|f| f.1.as_path()).chain([body]).chain(others).collect();
    let files: Vec<PathBuf> = FILES.iter().chain(&["frames.csv", FOUND]).map(|f| options.output.join(f)).collect();
    check_distinct(&given, &files)?;

    let progress = console.progress();
    progress.set("read", 0.0);
    // Damaged files are reported before any work; a frame's matches are read again in its turn.
    frames.iter().try_for_each(|(_, path, _)| matches_beside(path).map(drop))?;
    let grid = *io::read_field(&frames[0].1)?.grid();
    let setting = Setting::read(options, params, body, &grid, &frames[0].1)?;
    let images = images(options, None, &grid)?;
    if options.dry_run {
        let forecast = forecast(&frames, &setting, params, body)?;
        drop(progress);
        let forces: Vec<Option<f64>> = frames.iter().map(|f| f.2).collect();
        return plan(options, params, &frames[0].1, &setting, &forces, &forecast, console);
    }
    let mut order = Vec::new();
    for (at, (_, path, _)) in frames.iter().enumerate() {
        let field = io::read_field(path)?;
        if !field.grid().same_as(&grid) {
            bail!("{}: lies on another grid than {}; take fields of one track", path.shown(), frames[0].1.shown());
        }
        order.push((at, motion(&field, &setting.labels)));
    }
    // The frame that moved most decides on the law; lost frames come last.
    let rank = |m: f64| if m.is_finite() { m } else { -1.0 };
    order.sort_by(|a, b| rank(b.1).total_cmp(&rank(a.1)).then(a.0.cmp(&b.0)));
    let mut folder = OutputFolder::create(&options.output, options.overwrite)?;
    let mut inputs: Read = vec![("sequence", from.join("summary.json"))];
    for (_, path, _) in &frames {
        inputs.push(("field", path.clone()));
        inputs.extend(matches_of(path).map(|p| ("matches", p)));
    }
    inputs.extend(common_inputs(options));
    let record = Recording::start(console, inputs);
    // Of a mask.
    folder.supersede(|file| file == FOUND)?;

    let mut sequence = Sequence::default();
    let mut by_matches = false;
    let count = order.len() as f64;
    for (done, &(at, moved)) in order.iter().enumerate() {
        let (frame, path, force_n) = &frames[at];
        let field = io::read_field(path)?;
        let part = done as f64 / count;
        let params = StiffnessParams { force_n: *force_n, ..sequence.params(params) };
        let matches = matches_beside(path)?.filter(|m| setting.holds_enough(m));
        by_matches |= matches.is_some();
        let stage = format!("frame {frame}");
        let outcome = match force_n {
            Some(0.0) => Err(StiffnessError::NoForce),
            _ => setting.run(&field, matches.as_ref(), tracked.quality(*frame), &params, &|_, f| {
                progress.set(&stage, part + f / count)
            }),
        };
        if let Err(error) = &outcome {
            console.detail(&format!("frame {frame}: {error}"));
        }
        sequence.add(*frame, moved, outcome);
    }
    let mut shared = sequence.finish(&setting.labels).with_context(|| format!("{} with {}", name(from), name(body)))?;
    shared.result.warnings.splice(0..0, setting.notes.iter().cloned());

    progress.set("write", 1.0);
    write(&mut folder, &mut shared.result)?;
    folder.write("frames.csv", |p| io::write_frames(p, &shared))?;
    let names = report::InputNames {
        field: name(from),
        body: name(body),
        matches: by_matches.then(|| "matches_<t>.csv".into()),
        held: options.held.clone(),
        load: options.load.clone(),
    };
    let mut summary = report::summary(&shared.result, &names);
    summary["sequence"] = report::sequence_summary(&shared);
    let record = record.finish();
    folder.write("summary.json", |p| io::write_json(p, &in_summary(summary, &record)))?;
    let page = report::sequence_page(&shared, &names, &report::Shown { field: None, images: &images })?;
    folder.write("report.html", |p| io::write_text(p, &on_page(page, &record)))?;
    folder.commit()?;
    drop(progress);
    warn_all(console, &shared.result.warnings);
    let page = options.output.join("report.html");
    let frames = report::sequence_text(&shared);
    console.say(&format!("{}{frames}  results      {}", report::text(&shared.result), page.shown()));
    strict(options, &shared.result)
}

/// What the first frame that can be used would take: frames at rest are left out. A frame that
/// cannot be read is an error.
fn forecast(frames: &[Frame], setting: &Setting, params: &StiffnessParams, body: &Path) -> Result<Forecast> {
    let one = |(_, path, _): &Frame| -> Result<Result<Forecast>> {
        let found = setting.forecast(&io::read_field(path)?, params);
        Ok(found.with_context(|| format!("{} with {}", name(path), name(body))))
    };
    let mut found = one(&frames[0])?;
    for frame in &frames[1..] {
        if found.is_ok() {
            break;
        }
        found = one(frame)?;
    }
    found
}

/// What the summary of a track says.
struct Tracked {
    reference: usize,
    /// Numbers of all other frames, and whether each was measured; none in a summary that does not
    /// list them.
    others: Option<Vec<(usize, bool)>>,
    /// How far to rely on frames, where the summary says so.
    trust: Vec<(usize, Trust)>,
}

impl Tracked {
    fn of(from: &Path) -> Result<Self> {
        let path = from.join("summary.json");
        let hint = "give a folder that palpate track wrote";
        let summary = io::read_json(&path).context(hint)?;
        let reference = match summary["reference"].as_u64() {
            Some(frame) if summary["command"] == "track" => frame as usize,
            _ => bail!("{}: is not the summary of a track; {hint}", path.shown()),
        };
        let one = |f: &serde_json::Value| Some((f["frame"].as_u64()? as usize, f["lost"].is_null()));
        let others = summary["frames"].as_array().map(|all| all.iter().filter_map(one).collect());
        let trust = |f: &serde_json::Value| {
            Some((f["frame"].as_u64()? as usize, serde_json::from_value(f["trust"].clone()).ok()?))
        };
        let trust = summary["frames"].as_array().map(|all| all.iter().filter_map(trust).collect());
        Ok(Self { reference, others, trust: trust.unwrap_or_default() })
    }

    /// What is known of the error of a frame's field.
    fn quality(&self, frame: usize) -> FieldQuality<'static> {
        let trust = self.trust.iter().find(|t| t.0 == frame).map(|t| t.1);
        FieldQuality { trust, ..FieldQuality::default() }
    }

    /// Whether a field in the folder is of this track: an earlier one may have left others behind.
    fn measured(&self, frame: usize) -> bool {
        frame != self.reference && self.others.as_ref().is_none_or(|o| o.contains(&(frame, true)))
    }
}

/// The number in the name of a frame's field, as it is written.
fn number(field: &Path) -> Option<&str> {
    field.file_name()?.to_str()?.strip_prefix("displacement_")?.strip_suffix(".nii.gz")
}

/// The matches beside a frame's field, if any.
fn matches_beside(field: &Path) -> Result<Option<SparseField>> {
    Ok(matches_of(field).map(io::read_matches).transpose()?)
}

/// Where they are.
fn matches_of(field: &Path) -> Option<PathBuf> {
    number(field).map(|n| field.with_file_name(format!("matches_{n}.csv"))).filter(|p| p.is_file())
}

/// The fields of all measured frames but the reference, by frame.
fn frames(options: &Options, from: &Path, tracked: &Tracked) -> Result<Vec<Frame>> {
    let mut found: Vec<(usize, PathBuf)> = io::list(from)?
        .into_iter()
        .filter_map(|path| Some((number(&path)?.parse().ok()?, path)))
        .filter(|f: &(usize, PathBuf)| tracked.measured(f.0))
        .collect();
    found.sort();
    if found.is_empty() {
        bail!("{}: holds no displacement_<t>.nii.gz; give a folder that palpate track wrote", from.shown());
    }
    // A force for each frame, lost ones too, as they were taken.
    let here: Vec<usize> = found.iter().map(|f| f.0).collect();
    let all = tracked.others.as_ref().map_or(here, |others| others.iter().map(|f| f.0).collect());
    let forces = &options.forces;
    if !forces.is_empty() && forces.len() != all.len() {
        let text = format!(
            "--forces names {} forces for {} frames besides the reference ({}); lost ones count too",
            forces.len(),
            all.len(),
            all.iter().map(usize::to_string).collect::<Vec<_>>().join(", ")
        );
        bail!(Usage(text));
    }
    if let Some(bad) = forces.iter().find(|f| !(f.is_finite() && **f >= 0.0)) {
        bail!(Usage(format!("--forces: {bad} N is below 0; give magnitudes, without a sign (0: at rest)")));
    }
    let force = |frame: usize| all.iter().position(|f| *f == frame).and_then(|at| forces.get(at).copied());
    Ok(found.into_iter().map(|(frame, path)| (frame, path, force(frame))).collect())
}
