//! What cannot be measured is refused before any work.

use crate::error::FieldError;
use crate::matching::levels::foreground;
use crate::types::{Mask, Volume};
use std::borrow::Cow;

/// The mask to work in: the given one or the foreground, less the voxels that are not finite.
///
/// Returns the mask, the initial volume with those voxels set to zero, and how many there were.
///
/// # Errors
/// [`FieldError`] when a volume is constant or not finite, is a line of voxels, or the mask is empty or on another grid.
pub fn inputs<'a>(
    initial: &'a Volume,
    deformed: &Volume,
    mask: Option<&Mask>,
) -> Result<(Mask, Cow<'a, Volume>, usize), FieldError> {
    for (volume, v) in [("initial", initial), ("deformed", deformed)] {
        let refuse = |what: &str, hint: &str| Err(FieldError::Volume { volume, what: what.into(), hint: hint.into() });
        if v.grid().shape().iter().filter(|&&n| n < 2).count() > 1 {
            return refuse("is a line of voxels", "give a volume or one slice");
        }
        let finite = || v.as_slice().iter().copied().filter(|x| x.is_finite());
        let (lo, hi) = finite().fold((f32::INFINITY, f32::NEG_INFINITY), |(lo, hi), x| (lo.min(x), hi.max(x)));
        if lo > hi {
            return refuse("has no finite voxel", "check how it was exported");
        }
        if lo == hi {
            return refuse("is constant, so nothing can be matched", "check that it is the right file");
        }
    }
    mask_grid(initial, mask)?;
    if mask.is_some_and(|m| m.as_slice().iter().all(|&v| v == 0)) {
        let (what, hint) = ("is empty".into(), "give a mask that is not 0 in the tissue, or none".into());
        return Err(FieldError::Volume { volume: "mask", what, hint });
    }
    let bad = initial.as_slice().iter().filter(|v| !v.is_finite()).count();
    let mut clean = Cow::Borrowed(initial);
    if bad > 0 {
        clean.to_mut().as_mut_slice().iter_mut().filter(|v| !v.is_finite()).for_each(|v| *v = 0.0);
    }
    let mut mask = mask.cloned().unwrap_or_else(|| foreground(&clean));
    if bad > 0 {
        for (m, v) in mask.as_mut_slice().iter_mut().zip(initial.as_slice()) {
            if !v.is_finite() {
                *m = 0;
            }
        }
    }
    Ok((mask, clean, bad))
}

/// The mask must lie on the initial volume's grid.
///
/// # Errors
/// [`FieldError::GridMismatch`] when it does not.
pub fn mask_grid(initial: &Volume, mask: Option<&Mask>) -> Result<(), FieldError> {
    match mask {
        Some(m) if !m.grid().same_as(initial.grid()) => Err(FieldError::GridMismatch {
            what: "the mask".into(),
            found: m.grid().shape(),
            reference: "the initial volume".into(),
            expected: initial.grid().shape(),
        }),
        _ => Ok(()),
    }
}
