//! `palpate track`: a sequence of volumes to fields, trajectories and strain over time.

use super::Usage;
use super::console::Console;
use super::dry_run;
use super::field::Tuning;
use super::inputs::{
    Part, check_distinct, name, on_grid, read_labels, read_mask, standing_for, usable, warn_all, warn_of_non_finite,
    warn_of_places, warn_of_two_places,
};
use super::known::{Knowledge, KnownInputs};
use super::limits::{cap_search, grids_fit, same_unit};
use super::outputs::Target;
use super::record::{self, Read, Recording};
use anyhow::{Result, bail};
use clap::Args;
use palpate::error::FieldError;
use palpate::error::Shown;
use palpate::field::jacobian::determinant_at;
use palpate::field::warp::warp_image;
use palpate::io::{self, OutputFolder, PackedField, Series, Stored};
use palpate::numerics::sampling::Interpolation;
use palpate::pipeline::{
    self,
    dry_run::FieldPlan,
    track::{self, Frame, Sequence},
};
use palpate::report::animation::Film;
use palpate::report::panels::{centre_of_motion, gray_range};
use palpate::report::record::{in_summary, on_page};
use palpate::report::track::{Looks, Seen, TrackReport, clock, page, summary, text, warnings as all_warnings};
use palpate::report::verdict::{Verdict, judge};
use palpate::types::{DenseField, FieldParams, Grid, Mask, Tracked, Volume, Voxels};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

#[derive(Debug, Args)]
pub struct Options {
    /// Two volumes or more in the order they were taken, or one 4-D file
    #[arg(required = true)]
    volumes: Vec<PathBuf>,
    #[command(flatten)]
    target: Target,
    /// Number of the volume that the others are measured against, counted from 0
    #[arg(long, value_name = "N", default_value_t = 0, allow_negative_numbers = true)]
    reference: usize,
    /// Where to measure: a mask on the reference's grid, 0 outside
    #[arg(long, value_name = "M", value_parser = standing_for(Part::Mask))]
    mask: Option<PathBuf>,
    /// Regions whose strain is written to strain.csv: a label map on the reference's grid
    #[arg(long, value_name = "L", value_parser = standing_for(Part::Labels))]
    labels: Option<PathBuf>,
    /// Leave each frame's field as its own volume has it, without what all frames say together
    #[arg(long)]
    frame_by_frame: bool,
    /// Check everything, say what would be done, and write nothing
    #[arg(long)]
    dry_run: bool,
    #[command(flatten)]
    knowledge: Knowledge,
    #[command(flatten)]
    tuning: Tuning,
}

/// Where the frames come from.
enum Source<'a> {
    Files(&'a [PathBuf], Vec<Stored>),
    Series(&'a Path, Box<Series>),
}

impl<'a> Source<'a> {
    fn open(volumes: &'a [PathBuf]) -> Result<Self> {
        let [one] = volumes else {
            // A missing file, or no single volume, is reported before any work.
            let headers = volumes.iter().map(io::read_volume_header).collect::<Result<_, _>>()?;
            return Ok(Self::Files(volumes, headers));
        };
        let series = Series::open(one)?;
        if series.frames() < 2 {
            bail!(Usage(format!("{}: is one volume; give two or more, or a 4-D file", one.shown())));
        }
        Ok(Self::Series(one, Box::new(series)))
    }

    fn frames(&self) -> usize {
        match self {
            Self::Files(files, _) => files.len(),
            Self::Series(_, series) => series.frames(),
        }
    }

    fn grid(&self, frame: usize) -> &Grid {
        match self {
            Self::Files(_, headers) => &headers[frame].grid,
            Self::Series(_, series) => series.grid(),
        }
    }

    fn path(&self, frame: usize) -> &'a Path {
        match self {
            Self::Files(files, _) => &files[frame],
            Self::Series(file, _) => file,
        }
    }

    fn step_s(&self) -> Option<f64> {
        match self {
            Self::Files(..) => None,
            Self::Series(_, series) => series.step_s(),
        }
    }

    fn name(&self, frame: usize) -> String {
        match self {
            Self::Files(files, _) => name(&files[frame]),
            Self::Series(file, _) => format!("{}[{frame}]", name(file)),
        }
    }

    fn read(&mut self, frame: usize, warnings: &mut Vec<String>) -> Result<(Volume, String)> {
        match self {
            Self::Files(files, headers) => {
                let path = &files[frame];
                warn_of_places(path, &headers[frame], warnings);
                Ok((io::read_volume(path)?, path.shown()))
            }
            Self::Series(_, series) => {
                let volume = series.read(frame)?;
                Ok((volume, self.name(frame)))
            }
        }
    }

    /// A volume in which something can be found.
    fn read_usable(&mut self, frame: usize, warnings: &mut Vec<String>) -> Result<Volume> {
        let (volume, path) = self.read(frame, warnings)?;
        usable(volume, &path, warnings)
    }

    /// A volume among others: a blank one is lost, and they go on without it.
    fn read_frame(&mut self, frame: usize, warnings: &mut Vec<String>) -> Result<Volume> {
        if self.frames() == 2 {
            return self.read_usable(frame, warnings);
        }
        let (volume, path) = self.read(frame, warnings)?;
        warn_of_non_finite(&volume, &path, warnings);
        Ok(volume)
    }
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { volumes, target, reference: origin, mask, labels, knowledge, tuning, .. } = options;
    let (mut params, origin) = (tuning.params()?, *origin);
    let mut source = Source::open(volumes)?;
    let frames = source.frames();
    let inputs = checked(options, &source)?;

    let started = Instant::now();
    let progress = console.progress();
    progress.set("read", 0.0);
    let mut warnings = tuning.mask_left_out(mask.is_some());
    if let Source::Series(file, _) = &source {
        warn_of_two_places(file, &mut warnings);
    }
    let reference = source.read_usable(origin, &mut warnings)?;
    let grid = *reference.grid();
    let first = source.path(origin);
    warnings.extend(cap_search(&mut params, &grid, first));
    let inside = mask.as_ref().map(|m| read_mask(m, &grid, first, &mut warnings)).transpose()?;
    let regions = labels.as_ref().map(|l| read_labels(l, &grid, first, &mut warnings)).transpose()?;
    let known = match knowledge.is_empty() {
        true => KnownInputs::of_mask(inside),
        false => {
            let next = order(frames, origin).next().unwrap_or(origin);
            let frame = source.read_usable(next, &mut Vec::new())?;
            knowledge.read((&reference, &frame), [first, source.path(next)], inside, console, &mut warnings)?
        }
    };
    let landmarks = knowledge.by_frame(known.known().landmarks, frames, origin)?;
    let inside = known.mask();
    warnings.extend(out_of_order(volumes));
    warnings.extend(inside.zip(regions.as_ref()).and_then(|(mask, labels)| outside_the_mask(mask, labels)));
    if options.dry_run {
        drop(progress);
        let plan = plan(&mut source, origin, &reference, inside, &params, &mut warnings)?;
        warn_all(console, &warnings);
        let files = files(frames, origin);
        console.say(&dry_run::track(first, &grid, frames, origin, &plan, &params, target, &files)?);
        return Ok(());
    }
    let (mut folder, record) = (target.create()?, Recording::start(console, inputs));
    folder.supersede(of_a_frame)?;
    let (step_s, shown) = (source.step_s(), inside.or(regions.as_ref()));
    let mut kept = Kept::new(folder, frames, &reference, shown, step_s);
    let mut reading = started.elapsed();

    let mut seen = vec![false; frames];
    let read = |frame: usize| -> Result<Volume> {
        let started = Instant::now();
        // What the first reading had to say is not said again.
        let mut again = Vec::new();
        let said = if std::mem::replace(&mut seen[frame], true) { &mut again } else { &mut warnings };
        let volume = source.read_frame(frame, said);
        reading += started.elapsed();
        volume
    };
    let sequence = Sequence {
        frames,
        origin,
        reference: &reference,
        known: known.known(),
        landmarks: &landmarks,
        labels: regions.as_ref(),
        params: &params,
        together: !options.frame_by_frame,
    };
    let tracked = track::run(&sequence, read, |frame| kept.keep(frame), &|s, f| progress.set(s, f))
        .map_err(|error| if error.is::<FieldError>() { none_against(error, &source.name(origin)) } else { error })?;

    progress.set("write", 1.0);
    let Kept { mut folder, film, looks, judged, writing, .. } = kept.end(&tracked, origin)?;
    let measuring = tracked.frames.iter().map(|f| f.seconds).sum();
    let seconds = [("read", reading.as_secs_f64()), ("measure", measuring), ("write", writing.as_secs_f64())];
    let seconds = seconds.map(|(stage, s)| (stage.to_string(), s));
    let names: Vec<String> = (0..frames).map(|f| source.name(f)).collect();
    let called = [mask, labels].map(|p| p.as_deref().map(name).unwrap_or_default());
    let film = film.unwrap_or_else(|| start_film(&reference, &DenseField::zeros(grid), shown, gray_range(&reference)));
    let report = TrackReport {
        names: &names,
        reference: origin,
        step_s,
        grid: &grid,
        regions: [&called[0], &called[1]],
        params: &params,
        tracked: &tracked,
        film: &film,
        look: Some((&looks, &reference, shown)),
        judged: &judged,
        warnings: &warnings,
        seconds: &seconds,
    };
    let record = record.finish();
    folder.write("report.html", |p| io::write_text(p, &on_page(page(&report), &record)))?;
    folder.write("summary.json", |p| io::write_json(p, &in_summary(summary(&report), &record)))?;
    folder.commit()?;
    drop(progress);
    warn_all(console, &all_warnings(&report));
    console.say(&format!("{}{}", text(&report), target.look()));
    Ok(())
}

/// Checks what can be checked without the voxels, and lists everything that is read.
fn checked(options: &Options, source: &Source<'_>) -> Result<Read> {
    let Options { volumes, target, reference: origin, mask, labels, knowledge, tuning, .. } = options;
    let (frames, origin) = (source.frames(), *origin);
    if origin >= frames {
        bail!(Usage(format!("--reference is {origin}, but there are {frames} volumes (counted from 0)")));
    }
    if knowledge.has_point_lists() && frames > 2 {
        bail!(Usage("--landmarks: two lists of points belong to one pair; give one table with a column frame".into()));
    }
    let mut inputs: Read = volumes.iter().map(|v| ("volume", v.clone())).collect();
    inputs.extend(record::inputs(&[("mask", mask.as_ref()), ("labels", labels.as_ref()), ("config", tuning.config())]));
    inputs.extend(knowledge.inputs());
    let given: Vec<&Path> = inputs.iter().map(|(_, path)| path.as_path()).collect();
    check_distinct(&given, &target.files(&files(frames, origin)))?;

    for t in order(frames, origin) {
        same_unit(source.path(origin), source.grid(origin), source.path(t), source.grid(t))?;
    }
    // The largest of the others is what has to fit.
    let others = order(frames, origin).map(|t| (source.path(t), source.grid(t)));
    if let Some((path, grid)) = others.max_by_key(|o| o.1.len()) {
        grids_fit(source.path(origin), source.grid(origin), path, grid)?;
    }
    Ok(inputs)
}

/// What is written and shown of the frames, as they come.
struct Kept<'a> {
    folder: OutputFolder,
    packed: Vec<Option<PackedField>>,
    film: Option<Film>,
    looks: Looks,
    judged: Vec<(usize, Verdict)>,
    writing: Duration,
    reference: &'a Volume,
    /// Where the film and the pictures show colour.
    shown: Option<&'a Mask>,
    range: [f64; 2],
    step_s: Option<f64>,
}

impl<'a> Kept<'a> {
    fn new(
        folder: OutputFolder,
        frames: usize,
        reference: &'a Volume,
        shown: Option<&'a Mask>,
        step_s: Option<f64>,
    ) -> Self {
        Self {
            folder,
            packed: (0..frames).map(|_| None).collect(),
            film: None,
            looks: Looks::new(frames, reference.grid()),
            judged: Vec::new(),
            writing: Duration::ZERO,
            reference,
            shown,
            range: gray_range(reference),
            step_s,
        }
    }

    /// Writes the field of a frame, whole and packed for the series of all.
    fn put(&mut self, number: usize, field: &DenseField) -> Result<()> {
        let packed = &mut self.packed[number];
        self.folder.write(&format!("displacement_{number:03}.nii.gz"), |p| {
            *packed = Some(io::write_series_field(p, field)?);
            Ok(())
        })?;
        Ok(())
    }

    fn keep(&mut self, frame: Frame<'_>) -> Result<()> {
        let started = Instant::now();
        let Frame { number, volume, result, strain } = frame;
        let (field, grid) = (&result.displacement, self.reference.grid());
        self.put(number, field)?;
        self.folder.write(&format!("matches_{number:03}.csv"), |p| io::write_matches(p, &result.matches))?;
        self.folder.write(&format!("strain_{number:03}.nii.gz"), |p| {
            io::write_tensors(p, grid, strain.tensors(), "palpate: Green-Lagrange strain, LPS axes")
        })?;
        self.film(number, volume, field, &|o| strain.principal(o)[0] as f32)?;
        self.judged.push((number, judge(&result.bodies, &|o| result.uncertainty.at(o), &result.summary)));
        let mean = result.summary.mean_mm;
        if self.looks.wants(number, mean) {
            let there = on_grid(volume.view(), grid);
            let warped = warp_image(volume, field, None, Interpolation::Linear, 0.0);
            self.looks.add(&Seen {
                frame: number,
                name: &clock(number, self.step_s),
                mean_mm: mean,
                volumes: [self.reference, &there, &warped],
                mask: self.shown,
                displacement: field,
                matches: &result.matches,
                mesh: &result.mesh,
                strain: &|o| strain.principal(o)[0] as f32,
                jacobian: &|o| determinant_at(field, o),
                uncertainty: &|o| result.uncertainty.at(o),
            });
        }
        self.writing += started.elapsed();
        Ok(())
    }

    /// Adds a frame to the film, whose planes cross where the first measured one moves most.
    fn film(
        &mut self,
        number: usize,
        volume: &Voxels<'_>,
        field: &DenseField,
        strain: &(dyn Fn(usize) -> f32 + Sync),
    ) -> Result<()> {
        let start = || start_film(self.reference, field, self.shown, self.range);
        add_to(self.film.get_or_insert_with(start), number, volume, field, strain)
    }

    /// Writes what is of all frames together.
    fn end(mut self, tracked: &Tracked, origin: usize) -> Result<Self> {
        let started = Instant::now();
        let (reference, step_s) = (self.reference, self.step_s);
        let grid = *reference.grid();
        let still = DenseField::zeros(grid);
        self.put(origin, &still)?;
        let packed = &self.packed;
        let step = step_s.unwrap_or(0.0);
        self.folder.write("displacement.nii.gz", |p| io::write_field_series(p, &grid, packed, step))?;
        self.folder.write("trajectories.csv", |p| io::write_trajectories(p, &tracked.trajectories, origin, step_s))?;
        self.folder.write("strain.csv", |p| io::write_strain(p, &tracked.strain, step_s))?;
        self.film(origin, reference, &still, &|_| 0.0)?;
        self.writing += started.elapsed();
        Ok(self)
    }
}

/// Says so where files come in the order of their letters but not of their numbers: a shell lists
/// frame_10 before frame_2.
fn out_of_order(volumes: &[PathBuf]) -> Option<String> {
    let names: Vec<String> = volumes.iter().map(|v| name(v)).collect();
    let (first, second) = names.iter().zip(&names[1..]).find(|(a, b)| numbers(a) > numbers(b))?;
    names.is_sorted().then(|| {
        format!(
            "{first} comes before {second}: volumes count in the order they are given, and this is that of letters, not of numbers; is it \
             that of time? (ls -v sorts by numbers)"
        )
    })
}

/// A name in parts, with numbers as numbers.
fn numbers(name: &str) -> Vec<(String, u64)> {
    let mut parts = vec![(String::new(), 0u64)];
    let mut in_number = false;
    for c in name.chars() {
        if in_number && !c.is_ascii_digit() {
            parts.push((String::new(), 0));
        }
        in_number = c.is_ascii_digit();
        if let Some((text, number)) = parts.last_mut() {
            match c.to_digit(10) {
                Some(d) => *number = number.saturating_mul(10).saturating_add(d.into()),
                None => text.push(c),
            }
        }
    }
    parts
}

/// Part of a label outside the mask that earns a warning.
const OUTSIDE: f64 = 0.1;

/// Names the labels of which much lies outside the mask, where nothing is measured.
fn outside_the_mask(mask: &Mask, labels: &Mask) -> Option<String> {
    let mut counts = [[0usize; 2]; 256];
    for (&label, &inside) in labels.as_slice().iter().zip(mask.as_slice()) {
        counts[usize::from(label)][usize::from(inside != 0)] += 1;
    }
    let said = |(label, [out, within]): (usize, &[usize; 2])| {
        let share = *out as f64 / (out + within).max(1) as f64;
        (share > OUTSIDE).then(|| format!("label {label} ({:.0} %)", 100.0 * share))
    };
    let named: Vec<String> = counts.iter().enumerate().skip(1).filter_map(said).collect();
    (!named.is_empty())
        .then(|| format!("outside the mask: {}; strain.csv tells of what lies inside it alone", named.join(", ")))
}

/// The frames in the order in which they are measured.
fn order(frames: usize, origin: usize) -> impl Iterator<Item = usize> {
    (origin + 1..frames).chain((0..origin).rev())
}

/// All frames are lost, this one for `error`.
fn none_against(error: anyhow::Error, reference: &str) -> anyhow::Error {
    error.context(format!("no volume can be measured against {reference}"))
}

/// What would be done, by the first frame that can be measured against the reference, which is
/// number `origin`. Warns of frames that would be lost by what their headers say.
fn plan(
    source: &mut Source<'_>,
    origin: usize,
    reference: &Volume,
    mask: Option<&Mask>,
    params: &FieldParams,
    warnings: &mut Vec<String>,
) -> Result<FieldPlan> {
    let (mut plan, mut refused) = (None, None);
    for frame in order(source.frames(), origin) {
        let met = pipeline::dry_run::grids(reference.grid(), source.grid(frame), params);
        let tried = match met {
            Ok(()) if plan.is_none() => {
                let volume = source.read_frame(frame, warnings)?;
                pipeline::dry_run::field(reference, &volume, mask, params).map(|found| plan = Some(found))
            }
            met => met,
        };
        if let Err(error) = tried {
            warnings.push(format!("frame {frame} would be lost: {error}"));
            refused = Some(error);
        }
    }
    match (plan, refused) {
        (None, Some(error)) => Err(none_against(error.into(), &source.name(origin))),
        (None, None) => bail!(Usage("give two volumes or more".into())),
        (Some(plan), _) => Ok(plan),
    }
}

/// What is written at most.
fn files(frames: usize, origin: usize) -> Vec<String> {
    let fixed = ["displacement.nii.gz", "trajectories.csv", "strain.csv", "summary.json", "report.html"];
    let each = (0..frames).map(|t| format!("displacement_{t:03}.nii.gz"));
    let rest = order(frames, origin).flat_map(|t| [format!("strain_{t:03}.nii.gz"), format!("matches_{t:03}.csv")]);
    fixed.map(String::from).into_iter().chain(each).chain(rest).collect()
}

/// Whether a file has the name of what is written for one frame.
fn of_a_frame(file: &str) -> bool {
    let number = |(before, after)| file.strip_prefix(before).and_then(|f: &str| f.strip_suffix(after));
    let kinds = [("displacement_", ".nii.gz"), ("strain_", ".nii.gz"), ("matches_", ".csv")];
    kinds.into_iter().filter_map(number).any(|n| n.len() >= 3 && n.bytes().all(|b| b.is_ascii_digit()))
}

/// A film whose planes cross where the first measured frame moves most.
fn start_film(reference: &Volume, field: &DenseField, mask: Option<&Mask>, range: [f64; 2]) -> Film {
    Film::new(reference.grid(), centre_of_motion(field, mask), mask, range)
}

/// Adds a frame, resampled where it lies on another grid.
fn add_to(
    film: &mut Film,
    number: usize,
    volume: &Voxels<'_>,
    field: &DenseField,
    strain: &(dyn Fn(usize) -> f32 + Sync),
) -> Result<()> {
    let grid: &Grid = field.grid();
    let image = on_grid(volume.view(), grid);
    let values = image.as_slice();
    Ok(film.add(number, &|o| values[o], field, strain)?)
}
