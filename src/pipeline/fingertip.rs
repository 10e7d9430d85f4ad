//! A stiffness map of a finger pad to a fingertip model.

use crate::error::FingertipError;
use crate::fingertip::{columns, force, reduce};
use crate::types::Volume;
use crate::types::fingertip::{PadReduction, StiffnessFolder, StiffnessRegion};

/// Largest angle between the pressed side and a voxel axis (degrees).
const ASKEW: f64 = 10.0;

/// Part of the tissue's thickness to which forces are compared, where the press is not known to have gone further.
const DEPTH: f64 = 0.2;

/// What a pad was reduced to, and its force at the press that was measured.
#[derive(Debug, Clone, PartialEq)]
pub struct PadOutcome {
    /// The model.
    pub pad: PadReduction,
    /// Indentation that was measured (mm), and force of the columns there (N).
    pub at_press: Option<[f64; 2]>,
}

impl PadOutcome {
    /// Radius of the hemisphere (mm): the surface's, or the tissue's thickness where that is flat.
    pub fn radius_mm(&self) -> f64 {
        if self.pad.radius_mm.is_finite() { self.pad.radius_mm } else { self.pad.thickness_mm }
    }

    /// The measured force (N) over the columns' at the same press (1); 1 where one of them is not known.
    pub fn calibration(&self, force_n: Option<f64>) -> f64 {
        self.at_press.zip(force_n).map_or(1.0, |([_, columns], measured)| measured / columns)
    }
}

/// Reduces a map (kPa; 0 outside) that was pressed against `outward` (unit vector of the pressed side, RAS), by
/// `indentation` mm where that is known.
///
/// # Errors
/// [`FingertipError`] when the grid is askew, no bone lies under the pad, or there is hardly any tissue.
pub fn run(
    map: &Volume,
    bone: impl Fn(usize) -> bool,
    outward: [f64; 3],
    indentation: Option<f64>,
) -> Result<PadOutcome, FingertipError> {
    let (linear, spacing) = (map.grid().affine().linear(), map.grid().spacing());
    let along = |a: usize| (0..3).map(|r| linear[r][a] * outward[r]).sum::<f64>() / spacing[a];
    let axis = (1..3).fold(0, |best, a| if along(a).abs() > along(best).abs() { a } else { best });
    let degrees = along(axis).abs().min(1.0).acos().to_degrees();
    if degrees > ASKEW {
        return Err(FingertipError::Askew { degrees });
    }
    let columns = columns(map, bone, axis, along(axis) > 0.0)?;
    let thickness = columns.iter().filter(|c| c.gap == 0.0).map(|c| c.length).fold(0.0, f64::max);
    let known = indentation.filter(|d| *d > 0.0 && *d < thickness);
    let pad = reduce(&columns, known.unwrap_or(0.0).max(DEPTH * thickness));
    Ok(PadOutcome { at_press: known.map(|d| [d, force(&columns, d)]), pad })
}

/// A region that is so many times stiffer than the softest holds as a back plate.
const HARD: f64 = 20.0;

/// Names of hard parts.
const BONE: [&str; 4] = ["bone", "plate", "phalanx", "nail"];

/// The unit vector out of the pressed side.
fn outward(folder: &StiffnessFolder) -> [f64; 3] {
    let mut out = [0.0; 3];
    if let Some((axis, sign)) = folder.load.split_at_checked(1)
        && let (Some(axis), "+" | "-") = (["x", "y", "z"].iter().position(|a| *a == axis), sign)
    {
        out[axis] = if sign == "+" { 1.0 } else { -1.0 };
        return out;
    }
    // A patch given as a mask: against the way it went.
    let [moved, held] = folder.translation;
    let d: [f64; 3] = std::array::from_fn(|a| held[a] - moved[a]);
    let length = d.iter().map(|v| v * v).sum::<f64>().sqrt().max(1e-12);
    d.map(|v| v / length)
}

/// Moduli that stand for bone or a back plate: by name, by a lower bound, or by being far stiffer than the softest.
fn hard(folder: &StiffnessFolder) -> Vec<f64> {
    let named = |n: &str| BONE.iter().any(|b| n.to_lowercase().contains(b));
    let known = |r: &&StiffnessRegion| named(&r.name) || r.bound.as_deref() == Some("lower");
    // A bound says nothing of how soft the softest is.
    let tissue = folder.regions.iter().filter(|r| !known(r) && r.bound.is_none());
    let softest = tissue.map(|r| r.youngs_modulus).fold(f64::INFINITY, f64::min);
    let is_hard = |r: &&StiffnessRegion| known(r) || r.youngs_modulus >= HARD * softest;
    folder.regions.iter().filter(is_hard).map(|r| r.youngs_modulus).collect()
}

/// Reduces what `palpate stiffness` found to a fingertip, bone and pressed side as it names them.
///
/// # Errors
/// [`FingertipError`] when the moduli are ratios, and as [`run`].
pub fn of_map(folder: &StiffnessFolder) -> Result<PadOutcome, FingertipError> {
    if !folder.absolute {
        return Err(FingertipError::NotAbsolute);
    }
    let (bones, values) = (hard(folder), folder.map.as_slice());
    // Files keep 16 bits of a number.
    let bone = |o: usize| bones.iter().any(|b| (f64::from(values[o]) / b - 1.0).abs() < 1e-4);
    let side = outward(folder);
    let [moved, held] = folder.translation;
    let along = |u: [f64; 3]| (0..3).map(|a| u[a] * side[a]).sum::<f64>();
    // Of a curved pad that is pressed flat the middle goes less far than the plate.
    let indentation = folder.travel_mm.unwrap_or(-along(moved)) + along(held);
    run(&folder.map, bone, side, Some(indentation))
}
