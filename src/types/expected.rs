//! How far off a field is expected to be, and how far to rely on it.

use serde::{Deserialize, Serialize};

/// Where the error of a field comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ErrorSource {
    /// Noise where texture is weak: what the volumes leave open.
    Noise,
    /// The volumes still differ by more than noise once the deformed one is warped.
    Misfit,
    /// A smaller motion model, or tissue held at rest, stands for the free field.
    Model,
    /// The volumes do not show the tissue: it is out of view, or has no texture.
    OutOfView,
    /// Voxels beside a border may belong to the other body.
    Borders,
    /// Few features agree: the motion may be another within the range of the search.
    OtherMotions,
}

impl ErrorSource {
    /// All of them.
    pub const ALL: [Self; 6] =
        [Self::Noise, Self::Misfit, Self::Model, Self::OutOfView, Self::Borders, Self::OtherMotions];

    /// In words, to be read after "comes from".
    pub fn words(self) -> &'static str {
        match self {
            Self::Noise => "noise where texture is weak",
            Self::Misfit => "places where the volumes still differ",
            Self::Model => "the choice of the motion model",
            Self::OutOfView => "tissue out of view or without texture",
            Self::Borders => "borders between bodies",
            Self::OtherMotions => "other motions that the search could not rule out",
        }
    }
}

/// How far to rely on a field.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Trust {
    /// The expected error is under a tenth of the motion.
    High,
    /// The expected error is under a third of the motion.
    Moderate,
    /// The expected error is a third of the motion or more.
    Low,
}

impl Trust {
    /// Of an error that is expected to be this part of the motion.
    pub fn of(share: f64) -> Self {
        match share {
            s if s < 0.1 => Self::High,
            s if s < 1.0 / 3.0 => Self::Moderate,
            _ => Self::Low,
        }
    }

    /// In lower case.
    pub fn name(self) -> &'static str {
        match self {
            Self::High => "high",
            Self::Moderate => "moderate",
            Self::Low => "low",
        }
    }
}

/// The error expected within one label of the mask.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LabelError {
    /// The label.
    pub label: u8,
    /// Expected mean error (mm).
    pub expected_error_mm: f64,
    /// Mean displacement magnitude (mm).
    pub displacement_mean_mm: f64,
}

/// How far off the displacement is expected to be over the mask.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ExpectedError {
    /// Mean length of the error (mm).
    pub mean_mm: f64,
    /// Nine in ten true means lie between these (mm).
    pub interval_mm: [f64; 2],
    /// 95th percentile of the error's length (mm).
    pub p95_mm: f64,
    /// The mean displacement magnitude, or the edge of a voxel where nothing moves (mm).
    pub against_mm: f64,
    /// Each source's share of the expected squared error, greatest first; they add up to one.
    pub sources: Vec<(ErrorSource, f64)>,
    /// By label, where the mask has several.
    pub labels: Vec<LabelError>,
}

impl ExpectedError {
    /// The mean as a part of the motion, or of a voxel where nothing moves.
    pub fn share(&self) -> f64 {
        self.mean_mm / self.against_mm.max(f64::MIN_POSITIVE)
    }

    /// How far to rely on the field: by [`ExpectedError::share`] alone.
    pub fn trust(&self) -> Trust {
        Trust::of(self.share())
    }
}
