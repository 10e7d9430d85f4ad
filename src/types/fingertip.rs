//! A soft fingertip: a hemisphere on a hard back plate.

use crate::error::{ParamError, UnknownName};
use crate::types::names;
use serde::{Deserialize, Serialize};
use std::str::FromStr;

/// How a fingertip answers to being pressed and dragged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, Default)]
#[serde(rename_all = "kebab-case")]
pub enum FingertipModel {
    /// Springs parallel to the back plate's normal, with tangential deformation (Inoue and Hirai).
    #[default]
    Parallel,
    /// The same springs without tangential deformation: the tip rolls, d_t = 0.
    ParallelNormal,
    /// Springs towards the centre, without posture and without tangential deformation: the tip rolls, d_t = 0.
    Radial,
    /// No deformation: d_n = d_t = 0.
    Rigid,
}

impl FingertipModel {
    /// All of them, from the fullest to the simplest, by the names used in files.
    pub const ALL: [(&'static str, Self); 4] = [
        ("parallel", Self::Parallel),
        ("parallel-normal", Self::ParallelNormal),
        ("radial", Self::Radial),
        ("rigid", Self::Rigid),
    ];

    /// The name used in files.
    pub fn name(self) -> &'static str {
        Self::ALL.iter().find(|(_, m)| *m == self).map_or("", |(name, _)| name)
    }
}

impl FromStr for FingertipModel {
    type Err = UnknownName;

    fn from_str(name: &str) -> Result<Self, UnknownName> {
        names::choose("fingertip model", name, &Self::ALL)
    }
}

/// A hemispherical soft fingertip; both fingers have the same.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Fingertip {
    /// Radius a (m).
    pub radius: f64,
    /// Young's modulus E (Pa).
    pub youngs_modulus: f64,
    /// Damping c_n along the normal and c_t along the tangent of the contact (N s/m).
    pub damping: [f64; 2],
    /// How it answers.
    pub model: FingertipModel,
}

impl Fingertip {
    /// A fingertip with values in range: `radius` (m) and `youngs_modulus` (Pa) above 0, `damping` (N s/m) not negative.
    ///
    /// # Errors
    /// [`ParamError`] names the first value out of range.
    pub fn new(radius: f64, youngs_modulus: f64, damping: [f64; 2], model: FingertipModel) -> Result<Self, ParamError> {
        let tip = Self { radius, youngs_modulus, damping, model };
        tip.check()?;
        Ok(tip)
    }

    /// Checks every range.
    ///
    /// # Errors
    /// [`ParamError`] names the first value out of range.
    pub fn check(&self) -> Result<(), ParamError> {
        positive("fingertip.radius", self.radius, 1.0, "above 0 and at most 1 m")?;
        positive("fingertip.youngs_modulus", self.youngs_modulus, 1e12, "above 0 and at most 1e12 Pa")?;
        self.damping.iter().try_for_each(|&c| at_least_zero("fingertip.damping", c, "0 or more N s/m"))
    }
}

/// `value` must be a number above 0, to `most`.
pub(super) fn positive(name: &'static str, value: f64, most: f64, range: &'static str) -> Result<(), ParamError> {
    if value > 0.0 && value <= most { Ok(()) } else { Err(ParamError { name, value, range }) }
}

/// `value` must be a number at or above 0.
pub(super) fn at_least_zero(name: &'static str, value: f64, range: &'static str) -> Result<(), ParamError> {
    if value >= 0.0 && value.is_finite() { Ok(()) } else { Err(ParamError { name, value, range }) }
}
