//! Two volumes to a dense displacement field.

use crate::error::FieldError;
use crate::types::{FieldParams, FieldResult, Mask, Volume};

/// Called with a stage's name and the fraction of the whole that is done (0 to 1); may be called from any thread.
pub type Progress<'a> = &'a (dyn Fn(&str, f64) + Sync);

/// Measures the displacement from `initial` to `deformed`.
///
/// `mask` lies on the initial grid: features are taken and statistics are made inside it.
///
/// # Errors
/// [`FieldError`] when a volume has no texture, the two do not overlap, or too few matches survive.
pub fn run(
    _initial: &Volume,
    _deformed: &Volume,
    _mask: Option<&Mask>,
    params: &FieldParams,
    progress: Progress<'_>,
) -> Result<FieldResult, FieldError> {
    params.check()?;
    progress("features", 0.0);
    Err(FieldError::TooFew { found: 0, what: "stages are built", needed: 1, hint: "under construction".into() })
}
