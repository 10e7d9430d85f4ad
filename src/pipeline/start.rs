//! Where a search begins: a map that is known, or one that brings the two volumes onto each other.
//!
//! The affine part of a start is taken into the deformed volume's place, which costs no
//! interpolation; what is left of it is a field from which the search may begin. The result is then
//! followed by the affine part.

use crate::consistency::models::{AffineMotion, nearest_rigid};
use crate::consistency::pruning::Measured;
use crate::error::{FieldError, SpaceError};
use crate::matching::contrast::Relation;
use crate::matching::levels::{foreground, to_level};
use crate::matching::residual::MIN_POSITION_ERROR_VOXELS;
use crate::numerics::dense::symmetric_eigen;
use crate::numerics::sampling::nearest;
use crate::numerics::statistics::median;
use crate::numerics::symmetric3::{full, inverse};
use crate::pipeline::field::{FieldResult, lengths};
use crate::pipeline::known::{Known, StartMap};
use crate::pipeline::landmarks::MIN_LANDMARKS;
use crate::pipeline::stages::Stage;
use crate::pipeline::uncertainty;
use crate::types::space::{Matrix3, determinant, dot, length};
use crate::types::{
    AffineMap, DenseField, Grid, Landmark, Mask, MotionModel, SparseField, StartReport, VoxelPoint, Voxels, WorldPoint,
};
use rayon::prelude::*;

/// How two volumes are brought onto each other where nothing is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Alignment {
    /// The centres of both grids.
    Centre,
    /// The centres of brightness of both foregrounds.
    Moments,
    /// The same, and their principal axes, whichever way round agrees best.
    Principal,
}

/// Approximate number of places at which a start is examined.
const SAMPLED_PLACES: usize = 4000;

/// At a step in voxels of `grid`, places at which `mask` is not 0, in world mm.
fn places(grid: &Grid, mask: Option<&Mask>) -> Vec<WorldPoint> {
    let inside: Vec<usize> = (0..grid.len()).filter(|&at| mask.is_none_or(|m| m.as_slice()[at] != 0)).collect();
    inside.iter().step_by(inside.len().div_ceil(SAMPLED_PLACES).max(1)).map(|&at| grid.centre(at)).collect()
}

/// The mean of some places.
fn mean(places: impl Iterator<Item = WorldPoint>) -> [f64; 3] {
    let (sum, n) = places.fold(([0.0; 3], 0.0f64), |(s, n), p| (std::array::from_fn(|a| s[a] + p.0[a]), n + 1.0));
    sum.map(|v| v / n.max(1.0))
}

/// The affine map nearest to a start over the tissue (least squares): exactly the start where that
/// is affine.
///
/// # Errors
/// [`FieldError::Start`] where the start has no value in the tissue, or turns it inside out.
pub(crate) fn affine_part(start: &StartMap<'_>, grid: &Grid, mask: Option<&Mask>) -> Result<AffineMap, FieldError> {
    let refuse = |what: &str, hint: &str| FieldError::Start { what: format!("the start {what}"), hint: hint.into() };
    let pairs: Vec<(WorldPoint, WorldPoint)> =
        places(grid, mask).into_iter().filter_map(|x| Some((x, start(x)?))).collect();
    if pairs.is_empty() {
        return Err(refuse("has no value anywhere in the tissue", "check that it is a map from the initial volume"));
    }
    let [from, to] = [mean(pairs.iter().map(|p| p.0)), mean(pairs.iter().map(|p| p.1))];
    let (mut spread, mut cross) = ([[0.0; 3]; 3], [[0.0; 3]; 3]);
    for (x, y) in &pairs {
        let (d, e): ([f64; 3], [f64; 3]) = (x.minus(WorldPoint(from)), y.minus(WorldPoint(to)));
        (0..3).for_each(|r| (0..3).for_each(|c| spread[r][c] += d[r] * d[c]));
        (0..3).for_each(|r| (0..3).for_each(|c| cross[r][c] += e[r] * d[c]));
    }
    // Across a slice, where there is nothing to go by, nothing is stretched or turned.
    let little = 1e-9 * (spread[0][0] + spread[1][1] + spread[2][2]).max(f64::MIN_POSITIVE);
    for a in 0..3 {
        spread[a][a] += little;
        cross[a][a] += little;
    }
    let [[xx, xy, xz], [_, yy, yz], [_, _, zz]] = spread;
    let inverse = full(&inverse(&[xx, yy, zz, xy, xz, yz]).unwrap_or([0.0; 6]));
    let linear: Matrix3 =
        std::array::from_fn(|r| std::array::from_fn(|c| (0..3).map(|k| cross[r][k] * inverse[k][c]).sum()));
    if determinant(&linear) <= 0.0 {
        return Err(refuse(
            "turns the tissue inside out",
            "check its convention: a mirrored axis most often is a wrong one",
        ));
    }
    about(linear, from, to).map_err(|_| refuse("flattens the tissue", "check the file"))
}

/// `x -> linear (x - from) + to`.
fn about(linear: Matrix3, from: [f64; 3], to: [f64; 3]) -> Result<AffineMap, SpaceError> {
    let row = |r: usize| {
        let [a, b, c] = linear[r];
        [a, b, c, to[r] - (a * from[0] + b * from[1] + c * from[2])]
    };
    AffineMap::new([row(0), row(1), row(2)])
}

/// Landmarks with the deformed places mapped by `map`.
fn landmarks_before(map: &AffineMap, landmarks: &[Landmark]) -> Vec<Landmark> {
    let back = map.inverse();
    landmarks.iter().map(|l| Landmark { deformed: back.at(l.deformed), ..*l }).collect()
}

/// The map that brings the initial volume's tissue onto the deformed volume's.
///
/// # Errors
/// [`FieldError`] when a volume is of one value, so that it has no centre of brightness.
///
/// ```
/// use palpate::pipeline::start::{Alignment, aligned};
/// use palpate::{Affine, Grid, Volume, WorldPoint};
/// let at = |x: f64| -> Result<Volume, Box<dyn std::error::Error>> {
///     let grid = Grid::new([16; 3], Affine::scaled([1.0; 3], [x, 0.0, 0.0])?)?;
///     Ok(Volume::from_voxels(grid, |o, _| (o % 7) as f32))
/// };
/// // The second volume has its middle 40 mm further right.
/// let map = aligned(&at(0.0)?, &at(40.0)?, Alignment::Centre)?;
/// assert_eq!(map.at(WorldPoint([1.0, 2.0, 3.0])), WorldPoint([41.0, 2.0, 3.0]));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn aligned(initial: &Voxels<'_>, deformed: &Voxels<'_>, how: Alignment) -> Result<AffineMap, FieldError> {
    let identity = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    let volumes = [initial, deformed];
    if how == Alignment::Centre {
        let [from, to] = volumes.map(|v| middle(v.grid()));
        return Ok(about(identity, from, to)?);
    }
    let [first, second] = [Moments::of(initial, "initial")?, Moments::of(deformed, "deformed")?];
    if how == Alignment::Moments {
        return Ok(about(identity, first.centre, second.centre)?);
    }
    let flips = [[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]];
    let turned = flips.map(|flip| {
        let product = |r: usize, c: usize| (0..3).map(|k| second.axes[k][r] * flip[k] * first.axes[k][c]).sum();
        std::array::from_fn(|r| std::array::from_fn(|c| product(r, c)))
    });
    // Of a round body the axes say nothing, and a slice is not turned over.
    let [own, other] = volumes.map(|v| normal(v.grid()));
    let over = |turn: &Matrix3| {
        let normal: [f64; 3] = std::array::from_fn(|r| dot(turn[r], own.unwrap_or([0.0; 3])));
        other.is_some_and(|other| dot(normal, other) < 0.0)
    };
    let turns = turned.into_iter().filter(|turn| !over(turn)).chain([identity]);
    let maps: Result<Vec<AffineMap>, _> = turns.map(|turn| about(turn, first.centre, second.centre)).collect();
    let compared = Compared::of(initial);
    let agreement = |map: &AffineMap| compared.agreement(deformed, |p| map.at(p));
    let best = maps?.into_iter().map(|m| (agreement(&m), m)).max_by(|a, b| a.0.total_cmp(&b.0));
    best.map(|b| b.1).ok_or(FieldError::NoOverlap { hint: "check both volumes".into() })
}

/// The unit normal of a slice; none of a volume.
fn normal(grid: &Grid) -> Option<[f64; 3]> {
    let flat = (0..3).find(|&a| grid.shape()[a] == 1)?;
    let axis: [f64; 3] = std::array::from_fn(|r| grid.affine().linear()[r][flat]);
    Some(axis.map(|v| v / length(axis)))
}

/// The middle of a grid (world mm).
fn middle(grid: &Grid) -> [f64; 3] {
    grid.affine().to_world(VoxelPoint(grid.shape().map(|n| (n - 1) as f64 / 2.0))).0
}

/// Centre of brightness of a volume's foreground and its principal axes (world mm).
struct Moments {
    centre: [f64; 3],
    axes: Matrix3,
}

impl Moments {
    fn of(volume: &Voxels<'_>, name: &'static str) -> Result<Self, FieldError> {
        let tissue = foreground(volume);
        let (grid, values) = (volume.grid(), volume.as_slice());
        let inside: Vec<usize> =
            (0..grid.len()).filter(|&at| tissue.as_slice()[at] != 0 && values[at].is_finite()).collect();
        let low = inside.iter().map(|&at| values[at]).fold(f32::INFINITY, f32::min);
        let weight = |at: usize| f64::from(values[at] - low);
        let all: f64 = inside.iter().map(|&at| weight(at)).sum();
        if all <= 0.0 {
            let (what, hint) = ("is constant, so it has no centre".into(), "check that it is the right file".into());
            return Err(FieldError::Volume { volume: name, what, hint });
        }
        let mut centre = [0.0; 3];
        for &at in &inside {
            let p = grid.centre(at).0;
            (0..3).for_each(|a| centre[a] += weight(at) / all * p[a]);
        }
        let mut spread = [[0.0; 3]; 3];
        for &at in &inside {
            let d = grid.centre(at).minus(WorldPoint(centre));
            (0..3).for_each(|r| (0..3).for_each(|c| spread[r][c] += weight(at) / all * d[r] * d[c]));
        }
        let mut axes = symmetric_eigen(&spread).map(|e| e.1);
        if determinant(&axes) < 0.0 {
            axes[2] = axes[2].map(|v| -v);
        }
        Ok(Self { centre, axes })
    }
}

/// The initial volume's tissue at places to compare with a deformed volume.
pub(crate) struct Compared(Vec<(WorldPoint, f32)>);

impl Compared {
    /// From foreground voxels at a fixed step.
    pub fn of(initial: &Voxels<'_>) -> Self {
        let grid = initial.grid();
        let tissue = foreground(initial);
        let inside: Vec<usize> = (0..grid.len()).filter(|&at| tissue.as_slice()[at] != 0).collect();
        let some = inside.iter().step_by(inside.len().div_ceil(10 * SAMPLED_PLACES).max(1));
        Self(some.map(|&at| (grid.centre(at), initial.as_slice()[at])).collect())
    }

    /// How well a deformed volume agrees under a map, whatever its contrast (0 to 1): the part of
    /// one's variance that the other explains, less where less of the tissue is seen.
    pub fn agreement(&self, deformed: &Voxels<'_>, map: impl Fn(WorldPoint) -> WorldPoint) -> f64 {
        let grid = deformed.grid();
        let seen = |x: WorldPoint| {
            let there = grid.affine().to_voxel(map(x));
            nearest(grid.shape(), there).map_or(f32::NAN, |at| deformed.as_slice()[at])
        };
        let pairs: Vec<[f32; 2]> = self.0.iter().map(|&(x, value)| [value, seen(x)]).collect();
        let finite = pairs.iter().filter(|p| p[0].is_finite() && p[1].is_finite()).count();
        let share = finite as f64 / pairs.len().max(1) as f64;
        share * Relation::of(pairs.into_iter()).map_or(0.0, |r| r.most())
    }
}

/// Why a run ends before its result.
pub(super) enum Halt {
    Error(FieldError),
    /// The whole turned so far that patches are hardly alike: a rigid motion to begin again from.
    Turned(Box<AffineMap>),
}

impl<E: Into<FieldError>> From<E> for Halt {
    fn from(error: E) -> Self {
        Self::Error(error.into())
    }
}

impl Halt {
    /// For a motion (mm) along the axes of a level of `grid`, with its factor and spacing.
    pub fn turned(motion: &AffineMotion, grid: &Grid, (factor, spacing): ([usize; 3], [f64; 3])) -> Self {
        let moved = |x: WorldPoint| {
            let d = motion.on_grid(to_level(grid.affine().to_voxel(x), factor), spacing);
            Some(x.moved(grid.vector_to_world(d)))
        };
        affine_part(&moved, grid, None).map_or_else(Self::Error, |map| Self::Turned(Box::new(map)))
    }
}

/// A start as a run takes it: its affine part apart, and what is known with that taken out.
pub(super) struct Begin<'a> {
    affine: Option<AffineMap>,
    /// Whether a search found the affine part, rather than that it was given.
    found: bool,
    rest: Option<Box<StartMap<'a>>>,
    landmarks: Vec<Landmark>,
}

impl<'a> Begin<'a> {
    /// Where no start is given and landmarks lie further apart than the `range` of the search (mm),
    /// it is the rigid motion nearest to them.
    ///
    /// # Errors
    /// As [`affine_part`].
    pub fn of(grid: &Grid, known: &Known<'a>, range: f64) -> Result<Self, FieldError> {
        let Some(start) = known.start else {
            let affine = far_apart(known.landmarks, range);
            let landmarks = affine.map_or_else(Vec::new, |map| landmarks_before(&map, known.landmarks));
            return Ok(Self { affine, found: false, rest: None, landmarks });
        };
        let affine = affine_part(start, grid, known.mask)?;
        let back = affine.inverse();
        let rest = move |x: WorldPoint| start(x).map(|y| back.at(y));
        let landmarks = landmarks_before(&affine, known.landmarks);
        Ok(Self { affine: Some(affine), found: false, rest: Some(Box::new(rest)), landmarks })
    }

    /// At a motion that a search found.
    pub fn turned(map: AffineMap, known: &Known<'a>) -> Self {
        let landmarks = landmarks_before(&map, known.landmarks);
        Self { affine: Some(map), found: true, rest: None, landmarks }
    }

    /// Whether it begins anywhere but at rest.
    pub(crate) fn is_affine(&self) -> bool {
        self.affine.is_some()
    }

    /// The deformed volume's grid with the affine part taken out.
    ///
    /// # Errors
    /// [`SpaceError`] when it has no place there.
    pub fn grid(&self, deformed: &Grid) -> Result<Grid, SpaceError> {
        self.affine.as_ref().map_or(Ok(*deformed), |map| map.inverse().grid(deformed))
    }

    /// What is known, with the affine part taken out.
    pub fn known<'b>(&'b self, known: &Known<'b>) -> Known<'b> {
        match &self.rest {
            Some(rest) => Known { start: Some(&**rest), landmarks: &self.landmarks, ..*known },
            None if self.affine.is_some() => Known { landmarks: &self.landmarks, ..*known },
            None => *known,
        }
    }

    /// The result with the affine part. An error is compared with the motion beyond a start that
    /// was given, and with all of the motion where a search found the affine part.
    pub fn end(&self, found: FieldResult, mask: Option<&Mask>) -> FieldResult {
        let Some(map) = &self.affine else { return found };
        let model_beyond = found.summary.model;
        let mut found = found.followed_by(map);
        found.summary.start = Some(StartReport { affine_ras: map.rows(), model_beyond, found: self.found });
        found.summary.evidence.push(said_of(map, self.found));
        if self.found {
            uncertainty::compare_with(&mut found.summary.expected, &found.displacement, mask.unwrap_or(&found.bodies));
        }
        found
    }
}

/// The displacement (mm, RAS) of a start at a place of the initial volume's world; 0 where it has
/// none.
pub(super) fn rest<'a>(start: &'a StartMap<'a>) -> impl Fn(WorldPoint) -> [f64; 3] + Sync + 'a {
    move |x| start(x).map_or([0.0; 3], |y| y.minus(x))
}

/// Whether a start whose affine part was taken out is more than that, by what interpolation leaves
/// unsure of any place.
pub(super) fn bends(rest: impl Fn(WorldPoint) -> [f64; 3], grid: &Grid, mask: Option<&Mask>) -> bool {
    places(grid, mask).into_iter().any(|x| length(rest(x)) > MIN_POSITION_ERROR_VOXELS * grid.least_spacing())
}

impl FieldResult {
    /// The same, followed by an affine map of the world: what was measured from a start that had
    /// that map taken out.
    pub(super) fn followed_by(mut self, map: &AffineMap) -> Self {
        let linear = map.rows().map(|[a, b, c, _]| [a, b, c]);
        let scale = determinant(&linear).cbrt();
        follow(&mut self.displacement, map);
        (self.summary.mean_mm, self.summary.max_mm, _) = lengths(&self.displacement, &self.bodies);
        self.coefficients = self.coefficients.followed_by(map);
        self.uncertainty = self.uncertainty.scaled(scale as f32);
        self.samples = self.samples.turned(&linear);
        self.matches = SparseField { matches: self.matches.matches.iter().map(|m| m.followed_by(map)).collect() };
        let nodes: Vec<[f64; 3]> = self.at_nodes().iter().map(|m| m.displacement).collect();
        self.node_displacement = nodes;
        let stage = |s: Stage| Stage { field: s.field.followed_by(map), ..s };
        self.stages = self.stages.into_iter().map(stage).collect();
        let own = model_of(map);
        let larger = |m: MotionModel| if m.parameters() < own.parameters() { own } else { m };
        self.summary.model = larger(self.summary.model);
        self.summary.bodies.iter_mut().for_each(|b| b.model = larger(b.model));
        self
    }
}

/// The rigid motion nearest to landmarks most of which move further than `range` (mm).
fn far_apart(landmarks: &[Landmark], range: f64) -> Option<AffineMap> {
    let mut lengths: Vec<f32> = landmarks.iter().map(|l| length(l.deformed.minus(l.initial)) as f32).collect();
    if landmarks.len() < MIN_LANDMARKS || f64::from(median(&mut lengths)) <= range {
        return None;
    }
    let middle = mean(landmarks.iter().map(|l| l.initial));
    let measured = |l: &Landmark| Measured {
        place: l.initial.minus(WorldPoint(middle)),
        displacement: l.deformed.minus(l.initial),
        covariance: [1.0, 1.0, 1.0, 0.0, 0.0, 0.0],
        field: [0.0; 3],
    };
    let rigid = nearest_rigid(&landmarks.iter().map(measured).collect::<Vec<_>>());
    about(rigid.linear, middle, std::array::from_fn(|a| middle[a] + rigid.shift[a])).ok()
}

/// What was taken of a start, in words.
fn said_of(map: &AffineMap, found: bool) -> String {
    let rows: Vec<String> =
        map.rows().iter().map(|r| format!("[{:.4} {:.4} {:.4} {:.3}]", r[0], r[1], r[2], r[3])).collect();
    let rows = rows.join(" ");
    match found {
        true => format!(
            "start: the coarsest matches follow the rigid motion {rows} (world mm, RAS); it turns too far to be refined, so the search began again with it taken out"
        ),
        false => format!(
            "start: the search began at the affine map {rows} (world mm, RAS); models, ranges and the expected error are of the motion beyond it"
        ),
    }
}

/// The affine map that a field is (least squares over its grid).
///
/// # Errors
/// As [`affine_part`].
pub(crate) fn affine_of(field: &DenseField) -> Result<AffineMap, FieldError> {
    let grid = field.grid();
    let moved = |p: WorldPoint| {
        let at = nearest(grid.shape(), grid.affine().to_voxel(p))?;
        Some(p.moved(field.at(at).map(f64::from)))
    };
    affine_part(&moved, grid, None)
}

/// Puts `x -> map(x + u)` in the place of `x -> x + u`.
fn follow(field: &mut DenseField, map: &AffineMap) {
    let grid = *field.grid();
    let n = grid.len();
    let (x, rest) = field.as_mut_slice().split_at_mut(n);
    let (y, z) = rest.split_at_mut(n);
    x.par_iter_mut().zip(y).zip(z).enumerate().for_each(|(at, ((x, y), z))| {
        let here = grid.centre(at);
        let moved = map.at(here.moved([*x, *y, *z].map(f64::from))).minus(here);
        [*x, *y, *z] = moved.map(|v| v as f32);
    });
}

/// Difference of a linear map from a rotation, or of a map from rest (mm over a metre), up to which
/// they are equal: the rounding of a transform file in single precision.
const MOTION_TOLERANCE: f64 = 1e-6;

/// The smallest model that holds an affine map.
fn model_of(map: &AffineMap) -> MotionModel {
    let rows = map.rows();
    let gram = |r: usize, c: usize| (0..3).map(|k| rows[k][r] * rows[k][c]).sum::<f64>();
    let unit = |r: usize, c: usize| f64::from(u8::from(r == c));
    let all = |of: &dyn Fn(usize, usize) -> f64| {
        (0..3).all(|r| (0..3).all(|c| (of(r, c) - unit(r, c)).abs() < MOTION_TOLERANCE))
    };
    match () {
        _ if !all(&gram) => MotionModel::Affine,
        _ if all(&|r, c| rows[r][c]) && rows.iter().all(|row| row[3].abs() < MOTION_TOLERANCE) => MotionModel::Identity,
        _ => MotionModel::Rigid,
    }
}
