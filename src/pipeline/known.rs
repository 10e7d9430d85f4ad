//! What is known of a pair beside its volumes: where to look, what counts, where to begin, and
//! places that were marked in both.

use crate::numerics::neighbours::Neighbours;
use crate::numerics::orientation::Orientation;
use crate::pipeline::input_checks::drawn_on;
use crate::types::{Landmark, Mask, Voxels, WorldPoint};
use std::fmt;

/// A map from the initial to the deformed volume (world mm, RAS); none where it has no value.
pub(crate) type StartMap<'a> = dyn Fn(WorldPoint) -> Option<WorldPoint> + Sync + 'a;

/// Matches of one's own as a field in which the search may start ([`Known::start`]): the mean of
/// the displacements of the nearest matches, weighted by the inverse square of their distance
/// (Shepard 1968).
///
/// ```
/// use palpate::pipeline::known::{InitialField, Known};
/// use palpate::{Landmark, WorldPoint};
/// let of = |i| {
///     let initial = WorldPoint([f64::from(i), 2.0, 3.0]);
///     Landmark { initial, deformed: initial.moved([4.0, 0.0, 0.0]) }
/// };
/// let matches: Vec<Landmark> = (0..5).map(of).collect();
/// let field = InitialField::from_matches(&matches).ok_or("no match")?;
/// let start = |place| Some(field.at(place));
/// assert!((field.at(WorldPoint([1.5, 2.0, 9.0])).0[0] - 5.5).abs() < 1e-12);
/// let known = Known { start: Some(&start), ..Known::default() };
/// # assert!(known.start.is_some());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct InitialField {
    tree: Neighbours,
    matches: Vec<Landmark>,
}

/// Matches around a place that tell its displacement: one in each octant where they lie evenly.
const NEAREST_MATCHES: usize = 8;

impl fmt::Debug for InitialField {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("InitialField").field("matches", &self.matches).finish_non_exhaustive()
    }
}

impl InitialField {
    /// Through matches (world mm, RAS); nothing where there are none.
    pub fn from_matches(matches: &[Landmark]) -> Option<Self> {
        let places: Vec<[f64; 3]> = matches.iter().map(|m| m.initial.0).collect();
        (!places.is_empty()).then(|| Self { tree: Neighbours::new(&places), matches: matches.to_vec() })
    }

    /// Where the tissue at a place of the initial volume goes (world mm, RAS).
    pub fn at(&self, place: WorldPoint) -> WorldPoint {
        let near = self.tree.within(place.0, f64::INFINITY, NEAREST_MATCHES);
        let (mut sum, mut weights) = ([0.0; 3], 0.0);
        for m in near.into_iter().map(|i| &self.matches[i]) {
            let apart = m.initial.minus(place);
            let weight = 1.0 / apart.iter().map(|d| d * d).sum::<f64>().max(f64::MIN_POSITIVE);
            let displacement = m.deformed.minus(m.initial);
            (0..3).for_each(|a| sum[a] += weight * displacement[a]);
            weights += weight;
        }
        place.moved(sum.map(|s| s / weights))
    }
}

/// What a user knows of a pair. All of it is optional: `Known::default()` is nothing.
#[derive(Clone, Copy, Default)]
pub struct Known<'a> {
    /// Where to measure (not 0), on the initial volume's grid.
    pub mask: Option<&'a Mask>,
    /// Where the initial volume counts (not 0), on its grid: elsewhere the field is carried over.
    pub initial_counts: Option<&'a Mask>,
    /// Where the deformed volume counts (not 0), on its grid.
    pub deformed_counts: Option<&'a Mask>,
    /// Where the search begins. It is no constraint.
    pub start: Option<&'a StartMap<'a>>,
    /// Places that are known in both volumes.
    pub landmarks: &'a [Landmark],
    /// Standard deviation of a landmark along an axis (mm); 0: one voxel.
    pub landmark_sd_mm: f64,
}

impl<'a> Known<'a> {
    /// Only where to measure.
    pub fn mask(mask: Option<&'a Mask>) -> Self {
        Self { mask, ..Self::default() }
    }

    /// The volumes without the voxels that do not count; what does is drawn on a little past them,
    /// so that patches beside them can be matched.
    pub(super) fn counting<'b>(&self, initial: &'b Voxels<'_>, deformed: &'b Voxels<'_>) -> [Voxels<'b>; 2] {
        let of = |volume: &'b Voxels<'_>, counts: Option<&Mask>| {
            let mut out = volume.view();
            let Some(counts) = counts else { return out };
            let left_out = out.as_mut_slice().iter_mut().zip(counts.as_slice()).filter(|(_, c)| **c == 0);
            left_out.for_each(|(v, _)| *v = f32::NAN);
            drawn_on(out)
        };
        [of(initial, self.initial_counts), of(deformed, self.deformed_counts)]
    }

    /// A mask of the initial volume without the voxels that do not count.
    pub(super) fn counted(&self, mut mask: Mask) -> Mask {
        if let Some(counts) = self.initial_counts {
            let left_out = mask.as_mut_slice().iter_mut().zip(counts.as_slice()).filter(|(_, c)| **c == 0);
            left_out.for_each(|(m, _)| *m = 0);
        }
        mask
    }

    /// Voxels of the two that are not finite, of `all` those that count.
    pub(super) fn not_finite(&self, all: [usize; 2], volumes: [&Voxels<'_>; 2]) -> [usize; 2] {
        let counts = [self.initial_counts, self.deformed_counts];
        let of = |v: usize| match counts[v] {
            Some(counts) => {
                let values = volumes[v].as_slice().iter().zip(counts.as_slice());
                values.filter(|(v, c)| **c != 0 && !v.is_finite()).count()
            }
            None => all[v],
        };
        [of(0), of(1)]
    }
}

/// The masks of [`Known`], turned as the volumes are; none where one is right as stored.
pub(super) struct Turned {
    masks: [Option<Mask>; 3],
}

impl Turned {
    pub fn of(known: &Known<'_>, [here, there]: [Orientation; 2]) -> Self {
        let turned = |mask: Option<&Mask>, by: Orientation| {
            mask.filter(|_| !by.is_canonical()).map(|m| by.turned(m).into_volume())
        };
        let Known { mask, initial_counts, deformed_counts, .. } = *known;
        Self { masks: [turned(mask, here), turned(initial_counts, here), turned(deformed_counts, there)] }
    }

    /// What is known, with these masks.
    pub fn known<'b>(&'b self, known: &Known<'b>) -> Known<'b> {
        let [mask, initial, deformed] = &self.masks;
        Known {
            mask: mask.as_ref().or(known.mask),
            initial_counts: initial.as_ref().or(known.initial_counts),
            deformed_counts: deformed.as_ref().or(known.deformed_counts),
            ..*known
        }
    }
}
