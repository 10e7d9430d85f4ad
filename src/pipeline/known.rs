//! What is known of a pair beside its volumes: where to look, what counts, where to begin, and places
//! that were marked in both.

use crate::numerics::orientation::Orientation;
use crate::types::{Landmark, Mask, WorldPoint};

/// A map from the initial to the deformed volume (world mm, RAS); none where it has no value.
pub type StartMap<'a> = dyn Fn(WorldPoint) -> Option<WorldPoint> + Sync + 'a;

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
}

/// The masks of [`Known`], turned as the volumes are; none where one is right as it lies.
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
