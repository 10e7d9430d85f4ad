//! Points scaled by a power of two, so that the exact predicates can neither overflow nor
//! underflow.

use crate::error::MeshError;
use crate::types::WorldPoint;

/// Coordinates smaller than this part of the largest count as zero (2^-142).
const MIN_RELATIVE_COORDINATE: f64 = 1.793662034335766e-43;

/// The points with their largest coordinate brought to between 1/2 and 2.
///
/// A power of two keeps every bit, so all exact signs stay what they were (but for coordinates
/// under [`MIN_RELATIVE_COORDINATE`]).
///
/// # Errors
/// [`MeshError::NotFinite`] names the first point with NaN or infinity.
pub(super) fn normalise(points: &[WorldPoint]) -> Result<Vec<[f64; 3]>, MeshError> {
    let mut largest = 0.0_f64;
    for (node, p) in points.iter().enumerate() {
        if p.0.iter().any(|v| !v.is_finite()) {
            return Err(MeshError::NotFinite { node });
        }
        largest = p.0.iter().fold(largest, |m, v| m.max(v.abs()));
    }
    // Two factors, since one alone may lie outside f64 for very small or large points.
    let exponent = if largest > 0.0 { -largest.log2().floor() as i32 } else { 0 };
    let (first, second) = (2f64.powi(exponent / 2), 2f64.powi(exponent - exponent / 2));
    let scaled = |v: f64| {
        let s = v * first * second;
        if s.abs() < MIN_RELATIVE_COORDINATE { 0.0 } else { s }
    };
    Ok(points.iter().map(|p| p.0.map(scaled)).collect())
}
