//! What an evaluation gives back.

use serde::Serialize;

/// A field against exact truth, over the mask (mm unless said otherwise).
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Metrics {
    /// Voxels compared.
    pub voxels: usize,
    /// Mean end-point error.
    pub mean_mm: f64,
    /// Median end-point error.
    pub median_mm: f64,
    /// 95th percentile of the end-point error.
    pub p95_mm: f64,
    /// Largest end-point error.
    pub max_mm: f64,
    /// Mean error before registration: the mean magnitude of the true displacement.
    pub identity_mm: f64,
    /// Mean error where the truth moves less than 0.1 mm; none with fewer than 1,000 such voxels.
    pub still_mm: Option<f64>,
    /// Median Frobenius norm of grad(u) - grad(truth) (1).
    pub grad_err: f64,
    /// 95th percentile of the same (1).
    pub grad_err_p95: f64,
    /// Fraction of voxels with a Jacobian determinant at or below zero (1).
    pub folds: f64,
    /// Mean error at the landmarks, where there are any.
    pub landmarks_mm: Option<f64>,
}

/// How far a point comes back from where it started, by a field and one that leads back (mm unless
/// said otherwise).
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct InverseConsistency {
    /// Voxels that lie within the second field's grid once they moved.
    pub voxels: usize,
    /// Share of the mask that does not (1).
    pub outside: f64,
    /// Mean distance from the start.
    pub inverse_mean_mm: f64,
    /// 95th percentile of the distance.
    pub inverse_p95_mm: f64,
    /// Largest distance.
    pub inverse_max_mm: f64,
}

/// A summary of distances (mm); NaN of nothing.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Distances {
    /// Mean.
    pub mean_mm: f64,
    /// Median.
    pub median_mm: f64,
    /// 95th percentile.
    pub p95_mm: f64,
    /// Largest.
    pub max_mm: f64,
}

/// One landmark (places in world mm, RAS; errors in mm).
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LandmarkError {
    /// Its place in the initial volume.
    pub initial: [f64; 3],
    /// Its place in the deformed volume.
    pub deformed: [f64; 3],
    /// Distance between the place that the field leads to and the true one.
    pub error_mm: f64,
    /// Distance between its two places, which is the error without registration.
    pub before_mm: f64,
}

/// Target registration error at landmarks.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TargetError {
    /// Landmarks compared.
    pub count: usize,
    /// By the field.
    #[serde(flatten)]
    pub after: Distances,
    /// Without registration.
    pub before: Distances,
    /// Each landmark, in the order given.
    pub each: Vec<LandmarkError>,
}

/// How well one label of two maps coincides.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Overlap {
    /// Dice coefficient: twice the shared volume over the sum of both (1).
    pub dice: f64,
    /// Mean distance from each surface voxel of one map to the nearest of the other, both ways
    /// (mm); none where one map lacks the label.
    pub surface_mean_mm: Option<f64>,
    /// 95th percentile of the same distances, the 95th percentile Hausdorff distance (mm).
    pub hausdorff95_mm: Option<f64>,
}

/// A label that both maps hold.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LabelScore {
    /// The label.
    pub label: u8,
    /// Its voxels in the initial map.
    pub voxels: usize,
    /// With the deformed map warped by the field.
    pub after: Overlap,
    /// With the deformed map resampled where it lies.
    pub before: Overlap,
}

/// Two label maps compared on the grid of the initial one.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LabelScores {
    /// Mean Dice coefficient over the labels that both maps hold, by the field (1).
    pub dice_mean: f64,
    /// The same without registration (1).
    pub dice_mean_before: f64,
    /// Each label that both maps hold, in order.
    pub each: Vec<LabelScore>,
    /// Labels of the initial map alone.
    pub only_initial: Vec<u8>,
    /// Labels of the deformed map alone.
    pub only_deformed: Vec<u8>,
    /// Share of the initial map's labelled voxels that lie outside the field's grid (1).
    pub outside: f64,
}
