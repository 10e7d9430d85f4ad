//! Where the search begins: with what the matches say, with stillness, or with a field known from the frame before.

use crate::matching::levels::{from_level, to_level};
use crate::matching::pair::Pair;
use crate::numerics::bspline::Lattice;
use crate::numerics::{ablation, pyramid};
use crate::pipeline::level::{self, SplineField};
use crate::types::{Counts, LevelReport};

/// A field where another search may start.
#[derive(Debug, Clone, PartialEq)]
pub struct Start {
    pub(super) field: SplineField,
    /// Voxels that a voxel of its level stands for.
    pub(super) factor: [usize; 3],
    /// Frames since the whole volume was searched; none where it never was.
    pub(super) followed: Option<usize>,
}

impl Start {
    /// Whether the whole volume was searched for this field, rather than known fields followed.
    pub fn searched_all(&self) -> bool {
        self.followed == Some(0)
    }

    /// As far again as from `before` to here: where steady motion would be next.
    pub fn extrapolated(&self, before: &Self) -> Self {
        let mut next = self.clone();
        let before = before.on(&self.field.lattice, self.factor);
        for (n, b) in next.field.coefficients.iter_mut().zip(&before.coefficients) {
            *n += *n - b;
        }
        next
    }

    /// The field on a level's lattice.
    fn on(&self, lattice: &Lattice, factor: [usize; 3]) -> SplineField {
        level::carry(&self.field, lattice.clone(), |p| to_level(from_level(p, factor), self.factor))
    }
}

/// All is searched again after so many frames, whatever confirms the field.
const FOLLOWED: usize = 5;

/// Where fewer of the features than this agree with each other, matches are sought again on the warped volume. Heads, pads
/// and small motions keep nine tenths, legs in thick slices that moved by 16 mm four.
pub(super) const AGREED: f64 = 0.75;

/// Where fewer of the features than this agree with each other, the field is held near what they say: the passes would take it
/// on by centimetres where nothing holds it. Slides and legs that move far keep 0.4 to 0.81; pads under a press, whose edges the
/// passes alone can find, all.
const LOOSE: f64 = 0.85;

/// How far a field is then taken from the search (voxels of the finest axis, along each axis): about as far as the residual of
/// smooth tissue points the way.
const FROM_SEARCH: f64 = 2.0;

/// The same from the field of the coarser level: the two voxels of that one.
const FROM_LEVEL: f64 = 4.0;

/// Whether few of the features agree.
fn is_loose(report: &LevelReport) -> bool {
    report.counts.kept_share() < LOOSE
}

/// Whether few of the features agree, or there are too few to tell.
fn is_in_doubt(report: &LevelReport) -> bool {
    is_loose(report) || report.counts.kept < ENOUGH
}

/// `held` where the field is to be held near what the matches say, else as far as the passes take it.
fn reach(report: &LevelReport, held: f64) -> f64 {
    if is_loose(report) && ablation::is_on("reach") { held } else { f64::INFINITY }
}

/// The share of features that agree when a whole volume is searched: under it, what was found is doubtful. It was 0.73 or more
/// where the motion was found (heads and legs, 3 to 20 mm), and 0.45 or less with inverted contrast.
const BORNE_OUT: f64 = 0.5;

/// Matches that must agree for their share to tell a search that found the motion from one that did not.
const ENOUGH: usize = 20;

/// Searches on the warped volume at most.
const AGAIN: usize = 3;

/// Where so many of the features agree on a motion of [`FAR`] or more under which the volumes agree better than at rest, stillness is
/// not brought to the residual beside it: over 37 pairs it never won there.
const SURE: f64 = 0.9;

/// Mean motion (voxels of the finest axis) of which that is so: smaller ones the residual finds from rest as well, or better.
const FAR: f64 = 0.5;

/// Part of the features by which those that agree must have grown in a search for another to follow: in four legs, after
/// fewer were won the next won nothing.
const GREW: f64 = 0.05;

/// What the coarsest level found.
pub(super) struct Begun {
    pub field: SplineField,
    /// Of the matches, where they were sought.
    pub report: Option<LevelReport>,
    /// Frames since the whole volume was searched.
    pub followed: usize,
}

impl Begun {
    /// Whether all was searched and few features agreed with their neighbours.
    pub fn is_unsure(&self) -> bool {
        self.report.as_ref().is_some_and(|r| r.counts.kept_share() < AGREED || r.counts.kept < ENOUGH)
    }

    /// Whether so few features agreed that the next level is to be searched as well.
    pub fn is_loose(&self) -> bool {
        self.report.as_ref().is_some_and(is_loose)
    }

    /// The part of the features that agreed (0 to 1); nothing where none was sought.
    pub fn share(&self) -> f64 {
        self.report.as_ref().map_or(0.0, |r| r.counts.kept_share())
    }

    /// The features and those that agreed, where these are too few to go by.
    pub fn doubted(&self) -> Option<Counts> {
        self.report.as_ref().map(|r| r.counts).filter(|c| c.kept_share() < BORNE_OUT)
    }

    /// How far the passes of a finer level may take the field from the one it starts with (voxels of the finest axis).
    pub fn reach(&self) -> f64 {
        self.report.as_ref().map_or(f64::INFINITY, |r| reach(r, FROM_LEVEL))
    }

    /// Of an unsure search and a wider one the one in which more of the features agreed: the agreement of the volumes does not
    /// tell a wrong island from the truth, neighbours do. Where there are too few features to count it is all there is.
    pub fn surer(pair: &Pair<'_>, own: Self, wider: Self) -> Self {
        let counts = |s: &Self| s.report.as_ref().map(|r| r.counts).unwrap_or_default();
        let [few, many] = [&own, &wider].map(counts);
        let wider_is_surer = match (few.kept < ENOUGH, many.kept < ENOUGH) {
            (false, false) => many.kept_share() > few.kept_share(),
            (true, false) if many.kept_share() >= AGREED => true,
            _ => level::is_better(pair, &wider.field, &own.field),
        };
        if wider_is_surer { wider } else { own }
    }
}

/// The coarsest level of a search that may start from `known` fields.
///
/// `refine` brings a start to the residual within a reach (voxels of the finest axis); `search` matches the whole volume,
/// from nothing or about a field.
///
/// A known field that `is_confirmed` by the features is enough, but all is searched again every few frames. Else the matches' field,
/// stillness (with `rest`, where the matches leave room for it) and, where the matches are in doubt, the known fields compete, and the one
/// that ends at the better agreement goes on; None when there is none. A known field that goes on is refined twice: it begins with the noise of another frame.
/// Where few matches agreed, they are sought again about it for as long as clearly more of them agree each time: the agreement of
/// the volumes does not tell a wrong island there from the truth, neighbours do.
pub(super) fn begin(
    pair: &Pair<'_>,
    lattice: &Lattice,
    factor: [usize; 3],
    (known, rest): (&[Start], bool),
    refine: impl Fn(SplineField, f64) -> SplineField,
    is_confirmed: impl FnOnce(&SplineField) -> bool,
    mut search: impl FnMut(Option<&SplineField>) -> (Option<SplineField>, LevelReport),
) -> Option<Begun> {
    let better = |a, b| level::better(pair, a, b);
    let refined = |field| refine(field, f64::INFINITY);
    let course = known.iter().map(|s| s.on(lattice, factor)).reduce(better).map(refined);
    let followed = known.first().and_then(|s| s.followed).filter(|&f| f < FOLLOWED);
    if let Some((field, followed)) = course.as_ref().zip(followed)
        && is_confirmed(field)
    {
        return course.map(|field| Begun { field: refined(field), report: None, followed: followed + 1 });
    }
    let (found, mut report) = search(None);
    let still = SplineField::still(lattice.clone());
    let sure = report.counts.kept >= ENOUGH && report.counts.kept_share() >= SURE;
    let least = FAR * pyramid::finest(pair.shape, pair.spacing);
    let clear = |found: &SplineField| level::lengths(pair, found)[0] > least && level::is_better(pair, found, &still);
    let still_too = rest && ablation::is_on("second-start") && !(sure && found.as_ref().is_some_and(clear));
    let own = [found, still_too.then_some(still)]
        .into_iter()
        .flatten()
        .map(|start| refine(start, reach(&report, FROM_SEARCH)))
        .reduce(better);
    let known = course.filter(|_| is_in_doubt(&report));
    let wins = |known: &SplineField| own.as_ref().is_none_or(|own| level::is_better(pair, known, own));
    let mut field = known.filter(wins).map(refined).or(own)?;
    for _ in 0..AGAIN {
        if report.counts.kept_share() >= AGREED || !ablation::is_on("search-again") {
            break;
        }
        let (next, seen) = search(Some(&field));
        let Some(next) = next.filter(|_| seen.counts.kept > report.counts.kept) else { break };
        let won = seen.counts.kept - report.counts.kept;
        (field, report) = (refine(next, reach(&seen, FROM_SEARCH)), seen);
        if (won as f64) < GREW * report.counts.features_initial as f64 {
            break;
        }
    }
    Some(Begun { field, report: Some(report), followed: 0 })
}
