//! What a sequence of volumes gives.

use crate::types::space::WorldPoint;
use crate::types::{Counts, MotionModel, Trust};
use serde::Serialize;

/// How a point's place in a frame is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum PointState {
    /// It was matched in that frame, and the match was kept.
    Measured,
    /// It was not; the field around it says where it is.
    Carried,
    /// It lies outside that frame's volume.
    Outside,
}

impl PointState {
    /// In lower case.
    pub fn name(self) -> &'static str {
        match self {
            Self::Measured => "measured",
            Self::Carried => "carried",
            Self::Outside => "outside",
        }
    }
}

/// Where a point is in one frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// World mm (RAS).
    pub position: WorldPoint,
    /// One standard deviation (mm).
    pub sigma: f32,
    /// How it is known.
    pub state: PointState,
}

/// A feature of the reference volume through the frames.
#[derive(Debug, Clone, PartialEq)]
pub struct Trajectory {
    /// In the reference volume, world mm (RAS).
    pub initial: WorldPoint,
    /// One a frame; none before it was first matched, in frames that could not be measured, and in
    /// the reference.
    pub places: Vec<Option<Place>>,
}

impl Trajectory {
    /// The frames in which its place is known, and that place; in the `reference` it is where it
    /// was found, with sigma 0.
    pub fn known(&self, reference: usize) -> impl Iterator<Item = (usize, Place)> + '_ {
        let start = Place { position: self.initial, sigma: 0.0, state: PointState::Measured };
        let place = move |(frame, place): (usize, &Option<Place>)| {
            let place = if frame == reference { Some(start) } else { *place };
            place.map(|place| (frame, place))
        };
        self.places.iter().enumerate().filter_map(place)
    }
}

/// The strain of a region in a frame: Green-Lagrange, on the reference configuration (1).
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StrainRow {
    /// Number of the frame, from 0.
    pub frame: usize,
    /// Number of the region in the label map; 1 for the mask.
    pub label: u8,
    /// Its voxels.
    pub voxels: usize,
    /// Mean principal strains, largest first.
    pub mean: [f64; 3],
    /// 98th percentile of the largest principal strain, 2nd of the smallest.
    pub peak: [f64; 2],
    /// Mean and 98th percentile of the largest shear, half the difference of the largest and the
    /// smallest.
    pub shear: [f64; 2],
    /// Mean relative change of volume.
    pub volume_change: f64,
}

/// What is known of a frame beside its field.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FrameSummary {
    /// Number of the frame, from 0.
    pub frame: usize,
    /// Why it could not be measured; then all else is empty.
    pub lost: Option<String>,
    /// Whether the whole volume was searched, rather than the frames before followed.
    pub searched: bool,
    /// Counts at full resolution.
    pub counts: Counts,
    /// The smallest motion that explains the matches.
    pub model: Option<MotionModel>,
    /// Mean and largest displacement over the mask (mm).
    pub mean_mm: f64,
    /// See `mean_mm`.
    pub max_mm: f64,
    /// Median distance of the kept matches to the field (mm).
    pub residual_mm: f64,
    /// Median uncertainty over the mask (mm, 1 sigma).
    pub uncertainty_median_mm: f64,
    /// Expected mean error over the mask (mm); 0 where the frame is lost.
    pub expected_error_mm: f64,
    /// How far to rely on it; none where the frame is lost.
    pub trust: Option<Trust>,
    /// Voxels of the mask that fold.
    pub folds: usize,
    /// Part of the tissue (1) that lies elsewhere than the frames before and after have it, without
    /// its image bearing that out.
    pub out_of_line: f64,
    /// Wall seconds of the measurement.
    pub seconds: f64,
    /// What the user should know.
    pub warnings: Vec<String>,
}

/// What the frames of a sequence say together.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Together {
    /// Temporal modes that the motion of all frames is made of; none where each frame's field is
    /// its own.
    pub modes: Option<usize>,
    /// Why, in words.
    pub why: String,
}

/// Everything but the fields.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Tracked {
    /// By frame; the reference has none.
    pub frames: Vec<FrameSummary>,
    /// In the order in which they were first matched.
    pub trajectories: Vec<Trajectory>,
    /// By frame, then by label.
    pub strain: Vec<StrainRow>,
    /// What all frames say together; none where it was not asked.
    pub together: Option<Together>,
}
