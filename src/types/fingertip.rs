//! A soft fingertip: a hemisphere on a hard back plate.

use crate::error::{ParamError, UnknownName};
use crate::types::{Volume, names};
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
    /// Springs towards the centre, without posture and without tangential deformation: the tip
    /// rolls, d_t = 0.
    Radial,
    /// No deformation: d_n = d_t = 0.
    Rigid,
    /// As `Parallel`, with springs that are not alike: their modulus changes outwards as the
    /// profile says.
    Tabulated,
}

impl FingertipModel {
    /// All of them, from the fullest to the simplest, by the names used in files.
    pub const ALL: [(&'static str, Self); 5] = [
        ("parallel", Self::Parallel),
        ("parallel-normal", Self::ParallelNormal),
        ("radial", Self::Radial),
        ("rigid", Self::Rigid),
        ("tabulated", Self::Tabulated),
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

/// Maxwell branches of a fingertip at most.
pub(crate) const MAX_BRANCHES: usize = 3;

/// Least Young's modulus of a fingertip (Pa): brain and fat, the softest tissues, have about 1 kPa.
pub(crate) const MIN_YOUNGS_MODULUS_PA: f64 = 1e3;

/// A hemispherical soft fingertip.
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
    /// Maxwell branches beside the springs: modulus (Pa) and dashpot (Pa s) of each, as in layered
    /// skin; none for a tip that does not relax.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub maxwell: Vec<[f64; 2]>,
    /// Depth (m) by which the modulus of springs grows e-fold, of tabulated tips; none where it
    /// does not.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stiffening: Option<f64>,
    /// Standard deviation of its moduli, over them (1); 0 where it is not known.
    #[serde(skip_serializing_if = "is_zero")]
    pub deviation: f64,
    /// Least and largest value that its moduli may have, over them (1), where only bounds of a
    /// tissue are known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bounds: Option<[f64; 2]>,
    /// Depth (m) at which a face that comes straight on reaches springs, and their modulus (Pa), by
    /// rising depth; linear between, constant beyond. Of tabulated tips only; empty is
    /// `youngs_modulus` everywhere.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub profile: Vec<[f64; 2]>,
}

impl Fingertip {
    /// A fingertip with values in range: `radius` (m) and `youngs_modulus` (Pa) above 0, `damping`
    /// (N s/m) not negative.
    ///
    /// # Errors
    /// [`ParamError`] names the first value out of range.
    ///
    /// ```
    /// use palpate::{Fingertip, FingertipModel};
    /// let tip = Fingertip::new(0.01, 30e3, [5.0, 5.0], FingertipModel::Parallel)?;
    /// assert_eq!(tip.modulus_at(0.002), 30e3);
    /// // Ten is a radius in millimetres; metres are asked for.
    /// assert!(Fingertip::new(10.0, 30e3, [5.0, 5.0], FingertipModel::Parallel).is_err());
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn new(radius: f64, youngs_modulus: f64, damping: [f64; 2], model: FingertipModel) -> Result<Self, ParamError> {
        let tip = Self {
            radius,
            youngs_modulus,
            damping,
            model,
            maxwell: Vec::new(),
            stiffening: None,
            deviation: 0.0,
            bounds: None,
            profile: Vec::new(),
        };
        tip.check()?;
        Ok(tip)
    }

    /// Checks every range.
    ///
    /// # Errors
    /// [`ParamError`] names the first value out of range.
    pub fn check(&self) -> Result<(), ParamError> {
        positive("fingertip.radius", self.radius, 1.0, "above 0 and at most 1 m (SI units: is it in mm?)")?;
        if !(self.youngs_modulus >= MIN_YOUNGS_MODULUS_PA && self.youngs_modulus <= 1e12) {
            let range = "1000 to 1e12 Pa, from the softest tissues up (SI units: is it in kPa?)";
            return Err(ParamError { name: "fingertip.youngs_modulus", value: self.youngs_modulus, range });
        }
        self.damping.iter().try_for_each(|&c| at_least_zero("fingertip.damping", c, "0 or more N s/m"))?;
        if self.maxwell.len() > MAX_BRANCHES {
            let range = "up to 3 pairs [Pa, Pa s]";
            return Err(ParamError {
                name: "fingertip.maxwell, number of pairs",
                value: self.maxwell.len() as f64,
                range,
            });
        }
        self.maxwell
            .iter()
            .flatten()
            .try_for_each(|v| positive("fingertip.maxwell", *v, 1e15, "pairs of numbers above 0 (Pa, Pa s)"))?;
        if let Some(depth) = self.stiffening {
            // Over the radius the modulus would grow by e^20 and more.
            let range = "at least a twentieth of fingertip.radius";
            if !(depth >= 0.05 * self.radius && depth.is_finite()) {
                return Err(ParamError { name: "fingertip.stiffening", value: depth, range });
            }
        }
        at_least_zero("fingertip.youngs_modulus_sd", self.deviation, "0 or more Pa")?;
        if let Some([low, high]) = self.bounds
            && !(low > 0.0 && low <= 1.0 && high >= 1.0 && high.is_finite())
        {
            let range = "[low, high] in Pa, around youngs_modulus";
            return Err(ParamError {
                name: "fingertip.youngs_modulus_bounds",
                value: low * self.youngs_modulus,
                range,
            });
        }
        for pair in self.profile.windows(2) {
            positive("fingertip.profile_depth", pair[1][0] - pair[0][0], 1.0, "rising depths in m")?;
        }
        self.profile.iter().try_for_each(|p| {
            at_least_zero("fingertip.profile_depth", p[0], "0 or more m")?;
            positive("fingertip.profile_modulus", p[1], 1e12, "above 0 and at most 1e12 Pa")
        })
    }

    /// The same with all moduli times `factor`, which are then known.
    pub fn scaled(&self, factor: f64) -> Self {
        let profile = self.profile.iter().map(|[d, e]| [*d, e * factor]).collect();
        let maxwell = self.maxwell.iter().map(|b| b.map(|v| v * factor)).collect();
        Self {
            maxwell,
            youngs_modulus: self.youngs_modulus * factor,
            deviation: 0.0,
            bounds: None,
            profile,
            ..self.clone()
        }
    }

    /// Each Maxwell branch: its modulus over the springs' (1) and its time (s).
    pub fn branches(&self) -> Vec<[f64; 2]> {
        self.maxwell.iter().map(|[e, c]| [e / self.youngs_modulus, c / e]).collect()
    }

    /// Young's modulus (Pa) of the springs that a face coming straight on reaches at `depth` (m).
    pub fn modulus_at(&self, depth: f64) -> f64 {
        self.stiffening.map_or(1.0, |by| (depth / by).exp()) * self.measured_at(depth)
    }

    /// The same as the profile has it.
    fn measured_at(&self, depth: f64) -> f64 {
        let after = self.profile.partition_point(|p| p[0] < depth);
        match (after.checked_sub(1).map(|i| self.profile[i]), self.profile.get(after)) {
            (Some([d0, e0]), Some([d1, e1])) => e0 + (e1 - e0) * (depth - d0) / (d1 - d0),
            (Some([_, e]), None) | (None, Some(&[_, e])) => e,
            (None, None) => self.youngs_modulus,
        }
    }
}

/// What a fingertip is made from: a stiffness map with what its summary says.
#[derive(Debug, Clone)]
pub struct StiffnessFolder {
    /// Young's modulus (kPa where absolute; 0 outside).
    pub map: Volume,
    /// Whether it is in kPa.
    pub absolute: bool,
    /// Poisson's ratio of regions that have none of their own.
    pub poisson: f64,
    /// Name, modulus and bound (`lower`, `upper` or none) of each region.
    pub regions: Vec<StiffnessRegion>,
    /// The pressed side as it was called, `z-` say.
    pub load: String,
    /// The held side, so called; empty where it is not known.
    pub held: String,
    /// Force on it (N), where it was given.
    pub force_n: Option<f64>,
    /// How far inwards the pressed patch went (mm), where the folder says so.
    pub travel_mm: Option<f64>,
    /// How the pressed and the held patch moved (mm, RAS).
    pub translation: [[f64; 3]; 2],
}

/// One region of a stiffness folder.
#[derive(Debug, Clone, Deserialize)]
pub struct StiffnessRegion {
    /// Its name.
    pub name: String,
    /// Young's modulus, or the bound; NaN where it is unknown.
    #[serde(deserialize_with = "or_nan")]
    pub youngs_modulus: f64,
    /// `lower` or `upper` where it is not identifiable.
    pub bound: Option<String>,
    /// Poisson's ratio; that of the folder where none is given.
    #[serde(default)]
    pub poisson: Option<f64>,
    /// Its standard deviation, in the unit of the modulus; NaN or 0 where it is unknown.
    #[serde(default, deserialize_with = "or_nan")]
    pub sd: f64,
}

fn is_zero(v: &f64) -> bool {
    *v == 0.0
}

/// A number, or NaN for null.
fn or_nan<'de, D: serde::Deserializer<'de>>(from: D) -> Result<f64, D::Error> {
    Ok(Option::<f64>::deserialize(from)?.unwrap_or(f64::NAN))
}

/// A column of tissue between a pad's surface and its back plate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Column {
    /// Across the contact (mm).
    pub place: [f64; 2],
    /// Cross section (mm^2).
    pub area: f64,
    /// How far its surface lies behind the foremost one (mm).
    pub gap: f64,
    /// Length (mm).
    pub length: f64,
    /// Sum of its layers' thickness over modulus (mm/kPa).
    pub compliance: f64,
}

/// How much of a stiffness map a pad's force needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum PadModel {
    /// One modulus.
    Uniform,
    /// A layer of one compliance over a uniform rest.
    Layered,
    /// Every column its own.
    Map,
}

/// A finger pad as a fingertip model.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PadReduction {
    /// The smallest model whose forces are the map's, to 2 %.
    pub model: PadModel,
    /// The one modulus that in this shape gives the map's forces best (kPa).
    pub effective_kpa: f64,
    /// The modulus of the hemisphere whose force, pi E d^2, is nearest to the map's (kPa).
    pub hemisphere_kpa: f64,
    /// Relative distance of that force from the map's (1).
    pub hemisphere_residual: f64,
    /// Radius of the surface about its foremost place (mm).
    pub radius_mm: f64,
    /// Thickness of the tissue there (mm).
    pub thickness_mm: f64,
    /// Relative distance of the forces of one modulus, of layers and of the map from the map's (1).
    pub residuals: [f64; 3],
    /// Indentation (mm), force of the map and of one modulus (N).
    pub curve: Vec<[f64; 3]>,
    /// Depth (mm) and Young's modulus (kPa) of unlike springs on a hemisphere whose force is
    /// nearest to the map's.
    pub profile: Vec<[f64; 2]>,
    /// Relative distance of that force from the map's (1).
    pub profile_residual: f64,
    /// Columns.
    pub columns: usize,
    /// Standard deviation of the hemisphere's modulus, over it (1): what those of the tissue and of
    /// the press come to; 0 where none is known.
    pub deviation: f64,
    /// Least and largest modulus of the hemisphere over its own (1), where only a bound of a tissue
    /// is known.
    pub bounds: Option<[f64; 2]>,
    /// The forces of the map's finite elements, where they were solved; the hemispheres are then
    /// fitted to these.
    pub plate: Option<PlateCurve>,
}

/// Forces on a flat plate that presses the finite elements of a pad's map.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PlateCurve {
    /// Indentation (mm) and force (N), by rising indentation.
    pub curve: Vec<[f64; 2]>,
    /// The factor that brings the columns' forces nearest to these (1).
    pub factor: f64,
    /// Relative distance of the columns' forces from these, times that factor (1).
    pub residual: f64,
    /// Nodes of the mesh.
    pub nodes: usize,
}

impl PlateCurve {
    /// Force (N) at an indentation (mm): as a power of it between the points around, and for a
    /// twentieth beyond the last.
    pub fn at(&self, depth: f64) -> Option<f64> {
        let last = self.curve.len().checked_sub(1)?;
        let after = self.curve.partition_point(|p| p[0] < depth);
        if after > last && depth > 1.05 * self.curve[last][0] {
            return None;
        }
        let [d1, f1] = self.curve[after.min(last)];
        // From nothing at the surface with the square, as a hemisphere.
        let [d0, f0] = after.min(last).checked_sub(1).map_or([0.5 * d1, 0.25 * f1], |i| self.curve[i]);
        Some(f0 * (depth / d0).powf((f1 / f0).ln() / (d1 / d0).ln()))
    }
}

impl PadReduction {
    /// Whether a hemisphere of one modulus is not enough (forces off by more than 2 %) and unlike
    /// springs are nearer.
    pub fn tabulated(&self) -> bool {
        self.hemisphere_residual > 0.02 && self.profile_residual < 0.5 * self.hemisphere_residual
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
