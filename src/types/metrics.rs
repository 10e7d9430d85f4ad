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
    /// Mean error of doing nothing, that is the mean length of the true displacement.
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
