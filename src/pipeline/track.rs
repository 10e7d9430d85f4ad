//! A sequence of volumes: the displacement from one of them to each other, frame by frame.
//!
//! Every frame is measured against the reference itself, so that errors do not add up; the search
//! starts from where the tissue was in the frame before and where steady motion would take it,
//! beside the starts that a pair of volumes has. Then what all frames say together takes from each
//! what is its own noise and the reference's (`pipeline::temporal_pca`). Of volumes only the
//! reference, the frame at hand and the one before are held, and of fields one; the others as their
//! coefficients.

use crate::error::FieldError;
use crate::matching::levels::foreground;
use crate::numerics::orientation::Orientation;
use crate::numerics::sampling::{displacement, inside};
use crate::pipeline::field::{FieldResult, Progress, Start, run_from};
use crate::pipeline::known::Known;
use crate::pipeline::temporal_outliers::{Course, OutOfLine};
use crate::pipeline::temporal_pca::{self, Modes};
use crate::strain::StrainField;
use crate::strain::gauge::Gauge;
use crate::strain::statistics::StrainStatistics;
use crate::types::params::Interpolation;
use crate::types::*;
use rayon::prelude::*;
use std::borrow::Cow;
use std::collections::HashMap;
use std::time::Instant;

/// Follows the tissue of one volume through others that were taken one after the other.
#[derive(Clone)]
pub struct Tracker<'a> {
    reference: &'a Voxels<'a>,
    known: Known<'a>,
    params: &'a FieldParams,
    /// Of the frame before, and of the one before that.
    past: [Option<Start>; 2],
}

impl<'a> Tracker<'a> {
    /// `mask` lies on the reference's grid.
    pub fn new(reference: &'a Voxels<'a>, mask: Option<&'a Mask>, params: &'a FieldParams) -> Self {
        Self::knowing(reference, Known::mask(mask), params)
    }

    /// With more that is known of the reference and of each frame.
    pub fn knowing(reference: &'a Voxels<'a>, known: Known<'a>, params: &'a FieldParams) -> Self {
        Self { reference, known, params, past: [None, None] }
    }

    /// Forgets the frames so far: the next one again comes right after (or before) the reference.
    pub fn restart(&mut self) {
        self.past = [None, None];
    }

    /// Measures the displacement from the reference to the next frame.
    ///
    /// # Errors
    /// As [`crate::pipeline::field::run`]; the tracker then goes on from the frames before.
    pub fn next(&mut self, frame: &Voxels<'_>, progress: Progress<'_>) -> Result<FieldResult, FieldError> {
        let [last, before] = &self.past;
        let steady = last.as_ref().zip(before.as_ref()).map(|(l, b)| l.extrapolated(b));
        let starts: Vec<Start> = last.iter().cloned().chain(steady).collect();
        let result = run_from(self.reference, frame, &self.known, self.params, &starts, progress)?;
        self.past.swap(0, 1);
        self.past[0] = Some(result.spline.clone());
        Ok(result)
    }
}

/// A frame that was measured, as the caller of [`run`] gets it to keep what it wants.
#[derive(Debug, Clone, Copy)]
pub struct Frame<'a> {
    /// Its number, from 0.
    pub number: usize,
    /// Its image.
    pub volume: &'a Voxels<'a>,
    /// Its displacement and all that goes with it.
    pub result: &'a FieldResult,
    /// Its strain.
    pub strain: &'a StrainField,
}

/// A sequence, and how it is measured.
#[derive(Clone, Copy)]
pub struct Sequence<'a> {
    /// Number of volumes.
    pub frames: usize,
    /// Number of the volume that the others are measured against, from 0.
    pub origin: usize,
    /// That volume.
    pub reference: &'a Voxels<'a>,
    /// What is known of the reference and of each frame.
    pub known: Known<'a>,
    /// The landmarks of each frame by its number, in the place of those that are known of every
    /// frame; empty where there are none.
    pub landmarks: &'a [Vec<Landmark>],
    /// Regions whose strain is worked out (on the reference's grid; 0 is left out). Without them
    /// the mask is one, and without either what stands out of the background.
    pub labels: Option<&'a Mask>,
    /// The parameters of each pair.
    pub params: &'a FieldParams,
    /// Whether each field is what all frames say of it; not so where a start is known.
    pub together: bool,
}

/// Measures a sequence against its reference: forward from it to the last volume, then backward to
/// the first.
///
/// `read` gives a volume by its number, twice each; `keep` gets each result once all are measured.
/// A frame that cannot be measured is reported as lost, and the next one starts from the frames
/// before it.
///
/// # Errors
/// Those of `read` and `keep`, and [`FieldError`] when no frame at all can be measured.
///
/// ```
/// use palpate::FieldParams;
/// use palpate::error::FieldError;
/// use palpate::pipeline::known::Known;
/// use palpate::pipeline::track::{Frame, Sequence, run};
/// use palpate::synth::{self, SequenceKind, SequenceParams};
/// let mut params = SequenceParams::new(SequenceKind::Pinch).sized(24);
/// params.frames = 2;
/// let made = synth::Sequence::new(&params)?;
/// let (reference, field) = (made.frame(0), FieldParams::default());
/// let sequence = Sequence {
///     frames: 2,
///     origin: 0,
///     reference: &reference,
///     known: Known::mask(Some(&made.mask)),
///     landmarks: &[],
///     labels: None,
///     params: &field,
///     together: false,
/// };
/// let mut measured = Vec::new();
/// let keep = |frame: Frame<'_>| {
///     measured.push(frame.number);
///     Ok::<_, FieldError>(())
/// };
/// run(&sequence, |t| Ok(made.frame(t)), keep, &|_, _| {})?;
/// assert_eq!(measured, [1]);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn run<'v, E: From<FieldError>>(
    sequence: &Sequence<'_>,
    mut read: impl FnMut(usize) -> Result<Voxels<'v>, E>,
    mut keep: impl FnMut(Frame<'_>) -> Result<(), E>,
    progress: Progress<'_>,
) -> Result<Tracked, E> {
    let Sequence { frames, origin, reference, known, landmarks, labels, params, together } = *sequence;
    let mask = known.mask;
    // Without a mask it is tissue that counts, not air.
    let tissue = mask.map_or_else(|| Cow::Owned(foreground(reference)), Cow::Borrowed);
    let regions = regions(reference, if labels.is_some() { mask } else { Some(&*tissue) }, labels);
    let mut tracker = Tracker::knowing(reference, known, params);
    let mut tracked = Tracked::default();
    let mut refused = None;
    let mut course = Course::new(reference, &tissue, origin);
    let mut said: Vec<(usize, OutOfLine)> = Vec::new();
    let mut held: Vec<Held> = Vec::new();
    let order = (origin + 1..frames).chain((0..origin).rev());
    for (done, number) in order.enumerate() {
        if number + 1 == origin {
            tracker.restart();
            said.extend(course.end());
        }
        if let Some(own) = landmarks.get(number) {
            tracker.known.landmarks = own;
        }
        let volume = read(number)?;
        let started = Instant::now();
        let part = |stage: &str, f: f64| progress(stage, (done as f64 + f) / (frames - 1) as f64);
        match tracker.next(&volume, &part) {
            Ok(mut result) => {
                let sigma = |at| result.uncertainty.at(at);
                said.extend(course.add(number, &result.displacement, &sigma, volume));
                // The field takes far more room than what it is worked out from.
                let one = one_voxel(reference.grid())?;
                result.displacement = DenseField::zeros(one);
                // Where nothing slides the bodies say no more than the mask.
                if result.summary.bodies.len() < 2 {
                    result.bodies = Mask::filled(one, 1);
                }
                held.push(Held { number, result, seconds: started.elapsed().as_secs_f64() });
            }
            Err(error) => {
                tracked.frames.push(lost(number, &error));
                refused = Some(error);
            }
        }
    }
    said.extend(course.end());
    drop((course, tracker));

    progress("together", 1.0);
    // A start that all frames share would pass for the reference's noise.
    if together && known.start.is_none() && params.interpolation == Interpolation::Spline && frames > 2 {
        tracked.together = Some(take_together(&mut held, origin, &tissue));
    }
    let mut points = Points::new(frames);
    for Held { number, mut result, seconds } in held {
        let volume = read(number)?;
        let displacement = result.dense(params.interpolation)?;
        if tracked.together.as_ref().is_some_and(|t| t.modes.is_some()) {
            result.replace(displacement, &tissue)?;
        } else {
            result.displacement = displacement;
        }
        let bodies = if result.summary.bodies.len() < 2 { &[] } else { result.bodies.as_slice() };
        let gauge = Gauge::shortest(result.displacement.grid());
        let strain = StrainField::of(&result.displacement, bodies, gauge, StrainMeasure::GreenLagrange);
        points.add(number, &result, volume.grid());
        for (label, offsets) in &regions {
            let StrainStatistics { voxels, mean, peak, shear, volume_change } =
                StrainStatistics::over(&strain, offsets);
            tracked.strain.push(StrainRow { frame: number, label: *label, voxels, mean, peak, shear, volume_change });
        }
        let mut summary = summary(number, &result, seconds);
        if labels.is_some() {
            summary.warnings.extend(out_of_view(&regions, &result.displacement, volume.grid()));
        }
        if let Some((_, out)) = said.iter().find(|s| s.0 == number) {
            summary.out_of_line = out.share;
            summary.warnings.push(out.why());
        }
        tracked.frames.push(summary);
        keep(Frame { number, volume: &volume, result: &result, strain: &strain })?;
    }
    if let Some(error) = refused.filter(|_| tracked.frames.iter().all(|f| f.lost.is_some())) {
        return Err(error.into());
    }
    tracked.frames.sort_by_key(|f| f.frame);
    tracked.strain.sort_by_key(|s| (s.frame, s.label));
    tracked.trajectories = points.list;
    Ok(tracked)
}

/// A frame that was measured, without its dense field.
struct Held {
    number: usize,
    result: FieldResult,
    seconds: f64,
}

/// A grid to stand where there is no field.
fn one_voxel(grid: &Grid) -> Result<Grid, FieldError> {
    Ok(Grid::new([1; 3], *grid.affine())?)
}

/// Takes from each frame what is noise by all of them, and says how.
fn take_together(held: &mut [Held], origin: usize, tissue: &Mask) -> Together {
    let frames: Vec<temporal_pca::Frame<'_>> = held
        .iter()
        .map(|h| temporal_pca::Frame {
            number: h.number,
            field: &h.result.coefficients,
            uncertainty: &h.result.uncertainty,
        })
        .collect();
    let turned = Orientation::of(tissue.grid()).turned(tissue);
    let found = Modes::find(&frames, origin, |[i, j, k]| turned.as_slice()[turned.grid().index(i, j, k)] != 0);
    drop(frames);
    match found {
        Ok(modes) => {
            held.iter_mut().enumerate().for_each(|(at, h)| modes.apply(at, &mut h.result.coefficients));
            Together { modes: Some(modes.count), why: modes.why }
        }
        Err(why) => Together { modes: None, why },
    }
}

/// The offsets of each region's voxels: by label, or of the whole mask as label 1.
fn regions(reference: &Voxels<'_>, mask: Option<&Mask>, labels: Option<&Mask>) -> Vec<(u8, Vec<usize>)> {
    let inside = |at: usize| mask.is_none_or(|m| m.as_slice()[at] != 0);
    let all = (0..reference.grid().len()).filter(|&at| inside(at));
    let Some(labels) = labels else { return vec![(1, all.collect())] };
    let mut by_label: Vec<(u8, Vec<usize>)> = (0..=255).map(|label| (label, Vec::new())).collect();
    all.for_each(|at| by_label[usize::from(labels.as_slice()[at])].1.push(at));
    by_label.into_iter().skip(1).filter(|(_, offsets)| !offsets.is_empty()).collect()
}

/// Part of a label out of view that earns a warning.
const WARN_OUT_OF_VIEW_FRACTION: f64 = 0.2;

/// Names the labels of which much lies outside a frame: their strain there is what tissue in view
/// carries over.
fn out_of_view(regions: &[(u8, Vec<usize>)], field: &DenseField, there: &Grid) -> Option<String> {
    let grid = field.grid();
    let outside = |&at: &usize| {
        let [i, j, k] = grid.voxel(at);
        let place = grid.world(i, j, k).moved(field.at(at).map(f64::from));
        !inside(there.shape(), there.affine().to_voxel(place))
    };
    let share = |(label, offsets): &(u8, Vec<usize>)| {
        let out = offsets.par_iter().filter(|at| outside(at)).count() as f64 / offsets.len() as f64;
        (out > WARN_OUT_OF_VIEW_FRACTION).then(|| format!("label {label} ({:.0} %)", 100.0 * out))
    };
    let named: Vec<String> = regions.iter().filter_map(share).collect();
    (!named.is_empty()).then(|| {
        format!(
            "out of the frame's view: {}; the strain of what is not seen is carried over from around it",
            named.join(", ")
        )
    })
}

fn summary(frame: usize, result: &FieldResult, seconds: f64) -> FrameSummary {
    let s = &result.summary;
    FrameSummary {
        frame,
        lost: None,
        searched: result.spline.searched_all(),
        counts: s.counts,
        model: Some(s.model),
        mean_mm: s.mean_mm,
        max_mm: s.max_mm,
        residual_mm: s.levels.last().map_or(0.0, |l| l.residual_mm),
        uncertainty_median_mm: s.uncertainty_median_mm,
        expected_error_mm: s.expected.mean_mm,
        trust: Some(s.expected.trust()),
        folds: s.folds,
        out_of_line: 0.0,
        seconds,
        warnings: s.warnings.iter().map(|w| of_a_frame(w)).collect(),
    }
}

/// A warning of a pair in the words of a sequence, which has the page in the place of the pair's
/// volumes.
fn of_a_frame(warning: &str) -> String {
    ["warped.nii.gz", "uncertainty.nii.gz"]
        .iter()
        .fold(warning.to_string(), |text, file| text.replace(&format!("look at {file}"), "look at it in report.html"))
}

fn lost(frame: usize, error: &FieldError) -> FrameSummary {
    FrameSummary {
        frame,
        lost: Some(error.to_string()),
        searched: true,
        counts: Counts::default(),
        model: None,
        mean_mm: 0.0,
        max_mm: 0.0,
        residual_mm: 0.0,
        uncertainty_median_mm: 0.0,
        expected_error_mm: 0.0,
        trust: None,
        folds: 0,
        out_of_line: 0.0,
        seconds: 0.0,
        warnings: Vec::new(),
    }
}

/// The features of the reference, found again in each frame by their place.
struct Points {
    frames: usize,
    list: Vec<Trajectory>,
    known: HashMap<[u64; 3], usize>,
}

impl Points {
    fn new(frames: usize) -> Self {
        Self { frames, list: Vec::new(), known: HashMap::new() }
    }

    /// Books a frame: features matched for the first time become known, the others are measured or
    /// carried.
    fn add(&mut self, frame: usize, result: &FieldResult, there: &Grid) {
        let field = &result.displacement;
        let grid = *field.grid();
        let mut measured = vec![None; self.list.len()];
        for m in result.matches.kept() {
            let at = *self.known.entry(m.initial.0.map(f64::to_bits)).or_insert_with(|| {
                self.list.push(Trajectory { initial: m.initial, places: vec![None; self.frames] });
                measured.push(None);
                self.list.len() - 1
            });
            measured[at] = Some(m.sigma());
        }
        for (trajectory, sigma) in self.list.iter_mut().zip(measured) {
            let position = trajectory.initial.moved(displacement(field, trajectory.initial));
            let [i, j, k] = grid.affine().to_voxel(trajectory.initial).0.map(|v| v.round().max(0.0) as usize);
            let [nx, ny, nz] = grid.shape();
            let offset = grid.index(i.min(nx - 1), j.min(ny - 1), k.min(nz - 1));
            let state = match sigma {
                Some(_) => PointState::Measured,
                None if inside(there.shape(), there.affine().to_voxel(position)) => PointState::Carried,
                None => PointState::Outside,
            };
            trajectory.places[frame] = Some(Place { position, sigma: result.uncertainty.at(offset), state });
        }
    }
}
