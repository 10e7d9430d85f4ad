//! What cannot be measured is refused before any work.

use crate::error::FieldError;
use crate::field::jacobian::determinant_at;
use crate::matching::levels::foreground;
use crate::numerics::filters::mean_beside;
use crate::numerics::statistics::{quantile, sampled, stands_for_all};
use crate::pipeline::background::{self, Cut, hidden};
use crate::pipeline::field::MIN_MATCHES;
use crate::pipeline::known::Known;
use crate::types::params::{BodySource, Method};
use crate::types::{DenseField, FieldParams, Grid, Mask, Volume, Voxels};
use rayon::prelude::*;

/// What a measurement works on.
pub(crate) struct Checked<'a> {
    /// The given mask or the foreground, less the voxels that are not finite.
    pub mask: Mask,
    /// The initial volume with numbers everywhere, in a range that can be squared.
    pub initial: Voxels<'a>,
    /// The deformed volume, as far as it has numbers, in such a range.
    pub deformed: Voxels<'a>,
    /// Voxels of the two that are not finite.
    pub not_finite: [usize; 2],
    /// Slices of the two that are lost, as places along an axis (mm, RAS).
    pub lost: [Vec<LostSlice>; 2],
    /// Backgrounds of the two that a cut through tissue made.
    pub cut: [Option<Cut>; 2],
}

/// A slice that holds one value throughout, with tissue going on at both its sides.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct LostSlice {
    /// Across which axis it lies.
    pub axis: usize,
    /// Its number along that axis.
    pub at: usize,
    /// Where its middle lies along that axis of the world (mm).
    pub place: f64,
}

/// Checks the two volumes (as [`tamed`] gives them) and the mask, and makes them fit to work on.
///
/// A slice inside the body that holds one value throughout is lost: left out of the mask in the
/// initial volume, not finite in the deformed one. A voxel that is not finite among ones that are
/// gets the mean of those around it; more of them in one place are 0 in the initial volume and stay
/// unseen in the deformed one, and so does the background of both where a cut through tissue made
/// that of one. Volumes whose intensities are so large, so small or so far from 0 that single
/// precision loses them are shifted and scaled by a power of two, and so is a deformed volume whose
/// spread is another than the initial one's.
///
/// # Errors
/// [`FieldError`] when a volume is constant or not finite, is a line of voxels, or the mask is
/// empty or on another grid.
pub fn inputs<'a>(
    initial: &'a Voxels<'a>,
    deformed: &'a Voxels<'a>,
    mask: Option<&Mask>,
) -> Result<Checked<'a>, FieldError> {
    let ranges = [initial, deformed].map(Range::of);
    for ((volume, v), range) in [("initial", initial), ("deformed", deformed)].into_iter().zip(&ranges) {
        let refuse = |what: &str, hint: &str| Err(FieldError::Volume { volume, what: what.into(), hint: hint.into() });
        no_line(volume, v.grid())?;
        if range.low > range.high {
            return refuse("has no finite voxel", "check how it was exported");
        }
        if range.low == range.high {
            return refuse("is constant, so nothing can be matched", "check that it is the right file");
        }
    }
    mask_grid(initial, mask)?;
    if mask.is_some_and(|m| m.as_slice().iter().all(|&v| v == 0)) {
        let (what, hint) = ("is empty".into(), "give a mask that is not 0 in the tissue, or none".into());
        return Err(FieldError::Volume { volume: "mask", what, hint });
    }
    enough_slices(initial.grid())?;
    let not_finite = ranges.each_ref().map(|r| r.not_finite);
    let lost = [initial, deformed].map(lost_slices);
    let mut empty = [(initial, &ranges[0]), (deformed, &ranges[1])].map(|(v, range)| background::empty(v, range.low));
    let cut = [(initial, empty[0]), (deformed, empty[1])].map(|(v, empty)| Cut::of(v, empty?));
    // Where one was cut, what is empty beside tissue in the other is nothing to match with.
    if cut == [None; 2] {
        empty = [None; 2];
    }
    // In one slice there are 8 around a voxel, not 26.
    let least = |volume: &Voxels<'_>| {
        if volume.grid().shape().contains(&1) { MIN_FINITE_NEIGHBOURS / 3 } else { MIN_FINITE_NEIGHBOURS }
    };
    let fill = |volume: Voxels<'a>, bad: bool| if bad { filled(&volume, least(&volume)) } else { volume };
    let hide = |volume: Voxels<'a>, empty: Option<f32>| match empty {
        Some(value) => drawn_on(hidden(volume, value)),
        None => volume,
    };
    let mut first = fill(hide(bridged(initial, &lost[0]), empty[0]), not_finite[0] > 0 || empty[0].is_some());
    let bad = not_finite[1] > 0 || !lost[1].is_empty() || empty[1].is_some();
    let second = fill(without(hide(deformed.view(), empty[1]), &lost[1]), bad);
    let mut mask = mask.cloned().unwrap_or_else(|| foreground(&first));
    if not_finite[0] > 0 || empty[0].is_some() {
        let nothing = empty[0].unwrap_or(ranges[0].low);
        first.as_mut_slice().iter_mut().filter(|v| !v.is_finite()).for_each(|v| *v = nothing);
        for (m, v) in mask.as_mut_slice().iter_mut().zip(initial.as_slice()) {
            if !v.is_finite() || Some(*v) == empty[0] {
                *m = 0;
            }
        }
    }
    for &LostSlice { axis, at, .. } in &lost[0] {
        let mask = mask.as_mut_slice();
        slice(first.grid().shape(), axis, at).for_each(|o| mask[o] = 0);
    }
    let (initial, spread) = in_range(first, None);
    let (deformed, _) = in_range(second, Some(spread));
    Ok(Checked { mask, initial, deformed, not_finite, lost, cut })
}

/// Most lost slices in a row: more of one value lie between two bodies.
const MAX_LOST_SLICES: usize = 4;

/// The voxels of slice `at` across an axis, in the order of memory.
fn slice(shape: [usize; 3], axis: usize, at: usize) -> impl Iterator<Item = usize> {
    let stride = [1, shape[0], shape[0] * shape[1]];
    let [u, v] = [usize::from(axis == 0), 2 - usize::from(axis == 2)];
    (0..shape[v]).flat_map(move |j| (0..shape[u]).map(move |i| at * stride[axis] + j * stride[v] + i * stride[u]))
}

/// Slices across each axis that hold one value throughout while the slices next to them that do not
/// show tissue in the same places: an acquisition or a conversion that dropped them.
fn lost_slices(volume: &Voxels<'_>) -> Vec<LostSlice> {
    let (grid, values) = (volume.grid(), volume.as_slice());
    let shape = grid.shape();
    let across = |axis: usize| {
        let value = |at: usize| slice(shape, axis, at).next().map_or(f32::NAN, |first| values[first]);
        let constant = |at: usize| {
            let first = value(at);
            slice(shape, axis, at).all(|o| values[o] == first)
        };
        let varies: Vec<bool> = (0..shape[axis]).into_par_iter().map(|at| !constant(at)).collect();
        let between = |at: usize| {
            let below = varies[..at].iter().rposition(|v| *v)?;
            let above = at + varies[at..].iter().position(|v| *v)?;
            if above - below > MAX_LOST_SLICES + 1 {
                return None;
            }
            let background = value(at);
            let shown = |other: usize| slice(shape, axis, other).map(move |o| values[o] != background);
            let [mut both, mut either] = [0, 0];
            for (a, b) in shown(below).zip(shown(above)) {
                (both, either) = (both + usize::from(a && b), either + usize::from(a || b));
            }
            let [x, y, z] = std::array::from_fn(|a| if a == axis { at } else { shape[a] / 2 });
            let lost = LostSlice { axis, at, place: grid.world(x, y, z).0[axis] };
            (2 * both > either).then_some(lost)
        };
        (0..shape[axis]).filter(|&at| !varies[at]).filter_map(between).collect::<Vec<_>>()
    };
    (0..3).filter(|&a| shape[a] > 2).flat_map(across).collect()
}

/// The volume with lost slices drawn over linearly from the ones next to them, so that no edge
/// stands where nothing is measured.
fn bridged<'a>(volume: &'a Voxels<'a>, lost: &[LostSlice]) -> Voxels<'a> {
    let mut out = volume.view();
    let shape = volume.grid().shape();
    let stride = [1, shape[0], shape[0] * shape[1]];
    for &LostSlice { axis, at, .. } in lost {
        let good = |other: &usize| !lost.iter().any(|l| (l.axis, l.at) == (axis, *other));
        let (Some(below), Some(above)) = ((0..at).rev().find(good), (at..shape[axis]).find(good)) else { continue };
        let part = (at - below) as f32 / (above - below) as f32;
        let [down, up] = [at - below, above - at].map(|n| n * stride[axis]);
        let (values, new) = (volume.as_slice(), out.as_mut_slice());
        for o in slice(shape, axis, at) {
            new[o] = (1.0 - part) * values[o - down] + part * values[o + up];
        }
    }
    out
}

/// The volume with lost slices as voxels that are not finite.
fn without<'a>(mut volume: Voxels<'a>, lost: &[LostSlice]) -> Voxels<'a> {
    let shape = volume.grid().shape();
    for &LostSlice { axis, at, .. } in lost {
        let new = volume.as_mut_slice();
        slice(shape, axis, at).for_each(|o| new[o] = f32::NAN);
    }
    volume
}

/// Whether soft tissue keeps its volume.
struct VolumeCheck {
    /// Volume over the initial volume; a smaller ratio or a larger inverse earns a warning.
    min_ratio: f64,
    /// Approximate number of voxels at which it is measured.
    sampled_voxels: usize,
}

const VOLUME_CHECK: VolumeCheck = VolumeCheck { min_ratio: 0.75, sampled_voxels: 5000 };

/// What to say where the tissue as a whole does not keep its volume: most often a header is wrong.
/// Nothing of one slice.
pub(super) fn squeezed(field: &DenseField, mask: &Mask) -> Option<String> {
    let inside = || (0..mask.as_slice().len()).filter(|&o| mask.as_slice()[o] != 0);
    let share = VOLUME_CHECK.sampled_voxels as f64 / inside().count().max(1) as f64;
    let some = inside().enumerate().filter(|(i, _)| stands_for_all(*i, share));
    let volumes: Vec<f64> = some.map(|(_, o)| f64::from(determinant_at(field, o))).filter(|v| v.is_finite()).collect();
    let volume = volumes.iter().sum::<f64>() / volumes.len().max(1) as f64;
    let kept = field.grid().is_single_slice()
        || volumes.is_empty()
        || (VOLUME_CHECK.min_ratio..=1.0 / VOLUME_CHECK.min_ratio).contains(&volume);
    (!kept).then(|| {
        format!(
            "the tissue as a whole comes out at {volume:.2} of its volume, which soft tissue keeps: check the voxel sizes in both headers \
             (palpate info), and that both volumes show the same tissue"
        )
    })
}

/// What to say of lost slices.
pub(crate) fn said_of(lost: &[Vec<LostSlice>; 2]) -> Vec<String> {
    let of = |(lost, volume): (&Vec<LostSlice>, &str)| {
        let first = lost.first()?;
        let (what, holds) = if lost.len() == 1 { ("slice", "holds") } else { ("slices", "hold") };
        Some(format!(
            "{} {what} of the {volume} volume {holds} one value throughout while tissue goes on at both sides ({} = {:.1} mm{}): left \
             out as lost; export the volume again, or image it again",
            lost.len(),
            ["x", "y", "z"][first.axis],
            first.place,
            if lost.len() > 1 { " and others" } else { "" }
        ))
    };
    lost.iter().zip(["initial", "deformed"]).filter_map(of).collect()
}

/// A volume, "initial" or "deformed", has at least two axes.
///
/// # Errors
/// [`FieldError::Volume`] when it has not.
pub(crate) fn no_line(volume: &'static str, grid: &Grid) -> Result<(), FieldError> {
    match grid.shape().iter().filter(|&&n| n < 2).count() {
        0 | 1 => Ok(()),
        _ => {
            let (what, hint) = ("is a line of voxels".into(), "give a volume or one slice".into());
            Err(FieldError::Volume { volume, what, hint })
        }
    }
}

/// Voxels along an axis that the smallest patch and its surroundings need.
const MIN_SLICES: usize = 5;

/// A volume has one slice, which is measured in its plane, or enough of them for a patch.
///
/// # Errors
/// [`FieldError::TooFew`] when there are two to four along an axis: no match can be found.
pub(crate) fn enough_slices(grid: &Grid) -> Result<(), FieldError> {
    let shape = grid.shape();
    let Some(a) = (0..3).find(|&a| (2..MIN_SLICES).contains(&shape[a])) else { return Ok(()) };
    let hint = format!(
        "there are {} voxels along {}, and a patch needs {MIN_SLICES}: give more slices, or one alone, which is measured in its plane",
        shape[a],
        ['x', 'y', 'z'][a]
    );
    Err(FieldError::TooFew { found: 0, what: "matches survive", needed: MIN_MATCHES, hint })
}

/// What a volume's voxels reach.
struct Range {
    /// Of the finite voxels.
    low: f32,
    high: f32,
    not_finite: usize,
}

impl Range {
    fn of(volume: &Voxels<'_>) -> Self {
        let none = || Self { low: f32::INFINITY, high: f32::NEG_INFINITY, not_finite: 0 };
        let of_part = |part: &[f32]| {
            let or = |v: &f32, other: f32| if v.is_finite() { *v } else { other };
            Self {
                low: part.iter().fold(f32::INFINITY, |low, v| low.min(or(v, f32::INFINITY))),
                high: part.iter().fold(f32::NEG_INFINITY, |high, v| high.max(or(v, f32::NEG_INFINITY))),
                not_finite: part.iter().filter(|v| !v.is_finite()).count(),
            }
        };
        let both = |a: Self, b: Self| Self {
            low: a.low.min(b.low),
            high: a.high.max(b.high),
            not_finite: a.not_finite + b.not_finite,
        };
        volume.as_slice().par_chunks(1 << 14).map(of_part).reduce(none, both)
    }
}

/// Finite neighbours from which a single non-finite voxel is filled.
const MIN_FINITE_NEIGHBOURS: usize = 13;

/// Voxels by which tissue is extended past a cut, for patches beside it. On five cut pairs 1 to 3
/// left similar errors; without any, small bodies keep too few matches.
const CUT_PADDING_VOXELS: usize = 2;

/// The volume with what shows drawn on a little into what does not.
pub(super) fn drawn_on(mut volume: Voxels<'_>) -> Voxels<'_> {
    for _ in 0..CUT_PADDING_VOXELS {
        volume = filled(&volume, 1);
    }
    volume
}

/// With the mean of the finite voxels around it in each that has no number and at least `least` of
/// them.
fn filled(volume: &Voxels<'_>, least: usize) -> Volume {
    let (values, shape) = (volume.as_slice(), volume.grid().shape());
    let mut out = volume.clone().into_volume();
    out.as_mut_slice().par_iter_mut().enumerate().filter(|(_, v)| !v.is_finite()).for_each(|(at, v)| {
        *v = mean_beside(values, shape, at).filter(|m| m.1 >= least).map_or(f32::NAN, |m| m.0);
    });
    out
}

/// Intensities that are used as they are.
struct UnscaledIntensities {
    /// Their robust spread.
    spreads: std::ops::Range<f64>,
    /// Their largest absolute value, in spreads.
    max_offset: f64,
}

const UNSCALED: UnscaledIntensities = UnscaledIntensities { spreads: 1e-3..1e7, max_offset: 100.0 };

/// Which voxels are hot.
struct HotVoxels {
    /// Quantiles of a volume's intensities that span its robust range.
    robust_quantiles: [f64; 2],
    /// Distance beyond the robust range, in widths of that range.
    margin: f32,
    /// Most extreme neighbours that are ignored in a comparison: hot voxels come in short runs.
    ignored_extremes: usize,
}

const HOT_VOXELS: HotVoxels = HotVoxels { robust_quantiles: [0.001, 0.999], margin: 3.0, ignored_extremes: 3 };

/// The range of some intensities without far outliers (hot voxels, spikes); none where they are all
/// alike.
fn robust_range(sample: &mut [f32]) -> Option<[f32; 2]> {
    let [low, high] = HOT_VOXELS.robust_quantiles.map(|q| quantile(sample, q));
    (high > low).then_some([low, high])
}

/// The volume with padding that lies far from its intensities as the darkest of these, lone far
/// outliers as the median of their neighbours, and others drawn in to the end of the range.
pub(crate) fn tamed<'a>(volume: &'a Voxels<'a>) -> Voxels<'a> {
    let reached = Range::of(volume);
    let mut sample = sampled(volume.as_slice());
    let padding = [reached.low, reached.high].map(|v| background::filled_with(&sample, v).then_some(v));
    sample.retain(|v| !padding.contains(&Some(*v)));
    let Some([low, high]) = robust_range(&mut sample) else { return volume.view() };
    let width = high - low;
    let (least, most) = (low - HOT_VOXELS.margin * width, high + HOT_VOXELS.margin * width);
    if least <= reached.low && reached.high <= most {
        return volume.view();
    }
    let far = |v: f32| v.is_finite() && !(least..=most).contains(&v);
    let (values, shape) = (volume.as_slice(), volume.grid().shape());
    let other = |at: usize| {
        if padding.contains(&Some(values[at])) {
            return low;
        }
        let mut beside = neighbours(values, shape, at);
        beside.sort_by(f32::total_cmp);
        let lone = beside.len() > 2 * HOT_VOXELS.ignored_extremes
            && !far(beside[HOT_VOXELS.ignored_extremes])
            && !far(beside[beside.len() - 1 - HOT_VOXELS.ignored_extremes]);
        if lone { beside[beside.len() / 2] } else { values[at].clamp(least, most) }
    };
    let outliers: Vec<(usize, f32)> =
        (0..values.len()).into_par_iter().filter(|&at| far(values[at])).map(|at| (at, other(at))).collect();
    let mut out = volume.view();
    if !outliers.is_empty() {
        let values = out.as_mut_slice();
        outliers.into_iter().for_each(|(at, v)| values[at] = v);
    }
    out
}

/// The finite values next to a voxel, at most 26.
fn neighbours(values: &[f32], [nx, ny, nz]: [usize; 3], at: usize) -> Vec<f32> {
    let near = |v: usize, n: usize| v.saturating_sub(1)..(v + 2).min(n);
    let (i, j, k) = (at % nx, at / nx % ny, at / (nx * ny));
    let rows = near(k, nz).flat_map(|k| near(j, ny).map(move |j| nx * (j + ny * k)));
    let all = rows.flat_map(|row| near(i, nx).map(move |i| row + i));
    all.filter(|&other| other != at && values[other].is_finite()).map(|other| values[other]).collect()
}

/// With intensities that can be squared and summed in single precision, and with their spread,
/// which comes near to `like`: gains between the volumes are bounded, and noise is measured in the
/// initial one alone.
fn in_range<'a>(mut volume: Voxels<'a>, like: Option<f64>) -> (Voxels<'a>, f64) {
    let reached = || {
        let Range { low, high, .. } = Range::of(&volume);
        [low, high]
    };
    let [low, high] = robust_range(&mut sampled(volume.as_slice())).unwrap_or_else(reached).map(f64::from);
    let spread = high - low;
    let furthest = low.abs().max(high.abs());
    let alike = like.is_none_or(|l| (l / spread).log2().abs() < 0.5);
    if UNSCALED.spreads.contains(&spread) && furthest <= UNSCALED.max_offset * spread && alike {
        return (volume, spread);
    }
    let scale = (like.unwrap_or(1000.0) / spread).log2().round().exp2();
    for v in volume.as_mut_slice().iter_mut().filter(|v| v.is_finite()) {
        *v = ((f64::from(*v) - low) * scale) as f32;
    }
    (volume, spread * scale)
}

/// What is known must fit the volumes and the parameters.
///
/// # Errors
/// [`FieldError`] that names what does not.
pub fn known(
    initial: &Voxels<'_>,
    deformed: &Voxels<'_>,
    known: &Known<'_>,
    params: &FieldParams,
) -> Result<(), FieldError> {
    params.check()?;
    mask_grid(initial, known.mask)?;
    on_grid("the mask of what counts", known.initial_counts, "the initial volume", initial.grid())?;
    on_grid("the deformed mask", known.deformed_counts, "the deformed volume", deformed.grid())?;
    let refuse = |volume, what: &str, hint: &str| FieldError::Volume { volume, what: what.into(), hint: hint.into() };
    if params.method == Method::Full && params.bodies == BodySource::Given && known.mask.is_none() {
        return Err(refuse("mask", "is missing", "give the label map of the bodies as mask"));
    }
    if params.method == Method::Sparse && !known.landmarks.is_empty() {
        let (what, hint) =
            ("--method sparse fits matches alone and takes no landmarks".into(), "leave --method out".into());
        return Err(FieldError::Start { what, hint });
    }
    Ok(())
}

/// The mask must lie on the initial volume's grid.
///
/// # Errors
/// [`FieldError::GridMismatch`] when it does not.
pub(crate) fn mask_grid(initial: &Voxels<'_>, mask: Option<&Mask>) -> Result<(), FieldError> {
    on_grid("the mask", mask, "the initial volume", initial.grid())
}

/// A mask, called `what`, must lie on the grid of a volume.
fn on_grid(what: &str, mask: Option<&Mask>, reference: &str, grid: &Grid) -> Result<(), FieldError> {
    match mask {
        Some(m) if !m.grid().same_as(grid) => Err(FieldError::GridMismatch {
            what: what.into(),
            found: m.grid().shape(),
            reference: reference.into(),
            expected: grid.shape(),
        }),
        _ => Ok(()),
    }
}
