//! The stiffness problem and what comes out of it.

use crate::error::{ParamError, UnknownName};
use crate::types::names::choose;
use crate::types::{Mask, QuadraticMesh, Trust, Volume};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// How stress follows strain.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Law {
    /// Small strain: stress = 2 mu strain + p I, p = lambda div u.
    Linear,
    /// Compressible neo-Hookean: first Piola-Kirchhoff stress P = mu (F - F^-T) + p F^-T, p =
    /// lambda ln J.
    NeoHookean,
}

impl Law {
    /// The name used in files.
    pub fn name(self) -> &'static str {
        match self {
            Law::Linear => "linear",
            Law::NeoHookean => "neo-hookean",
        }
    }
}

/// The law that is asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, Default)]
#[serde(rename_all = "kebab-case")]
pub enum LawChoice {
    /// Linear unless strains past 5 % or the data ask for more.
    #[default]
    Auto,
    /// Always linear.
    Linear,
    /// Always neo-Hookean.
    NeoHookean,
}

impl From<Law> for LawChoice {
    fn from(law: Law) -> Self {
        match law {
            Law::Linear => Self::Linear,
            Law::NeoHookean => Self::NeoHookean,
        }
    }
}

impl FromStr for LawChoice {
    type Err = UnknownName;

    fn from_str(name: &str) -> Result<Self, UnknownName> {
        let known = [("auto", Self::Auto), ("linear", Self::Linear), ("neo-hookean", Self::NeoHookean)];
        choose("model", name, &known)
    }
}

/// A side of the body in world axes: the outward unit vector is `sign` along `axis` (0 = x, 1 = y,
/// 2 = z; RAS).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Side {
    /// 0, 1 or 2.
    pub axis: usize,
    /// Whether the side faces the positive direction.
    pub positive: bool,
}

impl Side {
    /// The outward unit vector (RAS).
    pub fn direction(self) -> [f64; 3] {
        let mut d = [0.0; 3];
        d[self.axis] = if self.positive { 1.0 } else { -1.0 };
        d
    }

    /// As on the command line: `z+`.
    pub fn name(self) -> String {
        format!("{}{}", ["x", "y", "z"][self.axis], if self.positive { '+' } else { '-' })
    }

    /// From `x-`, `z+` ...; none for anything else.
    ///
    /// ```
    /// use palpate::types::stiffness::Side;
    /// assert_eq!(Side::parse("z-").map(Side::direction), Some([0.0, 0.0, -1.0]));
    /// assert_eq!(Side::parse("z"), None);
    /// ```
    pub fn parse(text: &str) -> Option<Self> {
        let (axis, sign) = text.split_at_checked(1)?;
        let axis = ["x", "y", "z"].iter().position(|a| a.eq_ignore_ascii_case(axis))?;
        match sign {
            "+" => Some(Self { axis, positive: true }),
            "-" => Some(Self { axis, positive: false }),
            _ => None,
        }
    }
}

/// What the surface does where a plate or a base touches it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Contact {
    /// It moves with the plate as one rigid body.
    Sticking,
    /// It stays on the plate's plane and slides without friction.
    Sliding,
    /// It stays on the plate's plane, and moves along it as measured (smoothed).
    Guided,
    /// It moves as measured, smoothed by no more than its noise asks for.
    Measured,
}

impl Contact {
    /// In lower case.
    pub fn name(self) -> &'static str {
        match self {
            Contact::Sticking => "sticking",
            Contact::Sliding => "sliding",
            Contact::Guided => "guided",
            Contact::Measured => "measured",
        }
    }
}

/// Parameters of [`crate::pipeline::stiffness`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StiffnessParams {
    /// Poisson's ratio of all regions (1): 0 to below 0.5. Soft tissue is nearly incompressible;
    /// 0.49 is usual in elastography (Goenezen, Barbone, Oberai 2011).
    pub poisson: f64,
    /// Poisson's ratio of single labels, where it is not that of all.
    pub poisson_of: Vec<(u8, f64)>,
    /// Young's modulus of labels whose modulus is known (kPa): bone, or a calibrated pad, which
    /// sets the scale in place of a force.
    pub fixed: Vec<(u8, f64)>,
    /// One standard deviation of the border between two labels along its normal (voxels): 0 to 5.
    pub label_sd: f64,
    /// The law.
    pub model: LawChoice,
    /// Total force on the loaded patch (N), its magnitude; none gives ratios.
    pub force_n: Option<f64>,
    /// Nodes of the fine mesh, about (1): 500 to 500,000.
    pub nodes: usize,
    /// Regions tried without labels (1): 1 to 8.
    pub regions: usize,
}

impl Default for StiffnessParams {
    fn default() -> Self {
        Self {
            poisson: 0.49,
            poisson_of: Vec::new(),
            fixed: Vec::new(),
            label_sd: 0.5,
            model: LawChoice::Auto,
            force_n: None,
            nodes: 20_000,
            regions: 4,
        }
    }
}

impl StiffnessParams {
    /// Poisson's ratio of a label.
    pub fn poisson_of(&self, label: u8) -> f64 {
        self.poisson_of.iter().find(|p| p.0 == label).map_or(self.poisson, |p| p.1)
    }

    /// The first label with a ratio or a modulus of its own that no voxel of `labels` has.
    pub fn label_not_in(&self, labels: &Mask) -> Option<u8> {
        let mut given = self.poisson_of.iter().chain(&self.fixed).map(|known| known.0);
        given.find(|label| !labels.as_slice().contains(label))
    }

    /// Checks every range.
    ///
    /// # Errors
    /// [`ParamError`] names the first value out of range.
    ///
    /// ```
    /// use palpate::StiffnessParams;
    /// let params = StiffnessParams { force_n: Some(3.6), ..StiffnessParams::default() };
    /// assert!(params.check().is_ok());
    /// // No stiffness matrix of a displacement method holds exactly incompressible tissue.
    /// assert!(StiffnessParams { poisson: 0.5, ..params }.check().is_err());
    /// ```
    pub fn check(&self) -> Result<(), ParamError> {
        let ratios = self.poisson_of.iter().map(|p| p.1).chain([self.poisson]);
        if let Some(value) = ratios.into_iter().find(|nu| !(0.0..0.5).contains(nu)) {
            let range = "0 or more and below 0.5 (exactly incompressible tissue has no stiffness matrix; try 0.499)";
            return Err(ParamError { name: "poisson", value, range });
        }
        if let Some(&(_, value)) = self.fixed.iter().find(|f| !(f.1 > 0.0 && f.1.is_finite())) {
            return Err(ParamError { name: "fixed", value, range: "above 0 kPa" });
        }
        if !(0.0..=5.0).contains(&self.label_sd) {
            return Err(ParamError { name: "label-sd", value: self.label_sd, range: "0 to 5 voxels" });
        }
        if let Some(force) = self.force_n
            && !(force > 0.0 && force.is_finite())
        {
            let range = "above 0 N: give the magnitude of the total force on the loaded patch, without a sign";
            return Err(ParamError { name: "force", value: force, range });
        }
        if !(500..=500_000).contains(&self.nodes) {
            return Err(ParamError { name: "nodes", value: self.nodes as f64, range: "500 to 500,000" });
        }
        if !(1..=8).contains(&self.regions) {
            return Err(ParamError { name: "regions", value: self.regions as f64, range: "1 to 8" });
        }
        Ok(())
    }
}

/// What the data say of a region's modulus.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Determined {
    /// They determine it, within its standard deviation.
    Determined,
    /// They exclude one side: it lies beyond the value that is given.
    Bound,
    /// They say nothing of it.
    Unknown,
    /// It was given.
    Given,
}

impl Determined {
    /// As in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Determined => "determined",
            Self::Bound => "bound",
            Self::Unknown => "unknown",
            Self::Given => "given",
        }
    }
}

/// Young's modulus of one region.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RegionStiffness {
    /// Its label.
    pub label: u8,
    /// Its name.
    pub name: String,
    /// Young's modulus: kPa where a force or a modulus is known, else over that of the reference
    /// region. Of a bound its value; NaN where it is unknown.
    pub youngs_modulus: f64,
    /// One standard deviation, in the same unit; infinite where not identifiable.
    pub sd: f64,
    /// Over the reference region's modulus.
    pub ratio: f64,
    /// One standard deviation of the ratio.
    pub ratio_sd: f64,
    /// Whether the data determine it, or it was given.
    pub identifiable: bool,
    /// What the data say of it.
    pub state: Determined,
    /// `lower` or `upper` where it is not: the modulus lies beyond `youngs_modulus`; `unknown`
    /// where it may be any.
    pub bound: Option<&'static str>,
    /// Volume (mm^3).
    pub volume: f64,
    /// The part of the relative standard deviation of the modulus that more data lower, and of the
    /// ratio (1).
    #[serde(skip)]
    pub data_sd: [f64; 2],
}

/// One model that was tried, with how well it explains the data.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Evidence {
    /// What was varied.
    pub question: &'static str,
    /// The model.
    pub model: String,
    /// Free parameters.
    pub parameters: usize,
    /// Root mean square residual (mm, one component); infinite where it was not tried.
    pub residual_mm: f64,
    /// Bayesian information criterion, by the effective number of samples; lower is better.
    /// Infinite where it was not tried.
    pub bic: f64,
    /// Whether it was chosen.
    pub chosen: bool,
    /// Why, in words.
    pub reason: String,
}

impl fmt::Display for Evidence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { question, model, residual_mm, bic, reason, .. } = self;
        let mark = if self.chosen { "chosen" } else { "not chosen" };
        write!(f, "{question}: {model}: ")?;
        if bic.is_finite() {
            write!(f, "residual {residual_mm:.4} mm, criterion {bic:.0}, ")?;
        }
        write!(f, "{mark} ({reason})")
    }
}

/// What a run would take, told before it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Forecast {
    /// Nodes of the fine mesh.
    pub nodes: usize,
    /// Largest memory (bytes).
    pub memory: u64,
    /// CPU time (s), as fast as this machine is now; none without labels, and where equations are
    /// solved by iterations.
    pub seconds: Option<f64>,
}

/// From which contrast on a ball would be found without labels, in three of four places.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Detectable {
    /// Its diameter (mm).
    pub diameter_mm: f64,
    /// Its modulus over that around it, where it is stiffer; none where not even a rigid one is
    /// seen.
    pub stiffer: Option<f64>,
    /// The same where it is softer; none where not even a hole is seen.
    pub softer: Option<f64>,
}

/// What one modulus leaves over of a field in which no second region was found.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LeftOver {
    /// Root mean square misfit beyond the noise of a sample (mm, one component).
    pub misfit_mm: f64,
    /// What a surface known to a tenth of a voxel explains (mm).
    pub surface_mm: f64,
}

impl LeftOver {
    /// Whether a badly known surface may be all of it.
    pub fn may_be_surface(&self) -> bool {
        self.misfit_mm <= self.surface_mm
    }
}

/// A patch of the surface that a plate or base holds.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PatchReport {
    /// `z-` or a file's name.
    pub name: String,
    /// Area in contact (mm^2).
    pub area: f64,
    /// Nodes in contact.
    pub nodes: usize,
    /// How it touches.
    pub contact: Contact,
    /// Translation of the patch's middle (mm, RAS).
    pub translation: [f64; 3],
    /// How far inwards its foremost place went (mm), which is the plate's travel also where a
    /// curved surface is pressed flat.
    pub travel_mm: f64,
    /// Root mean square distance of the measured displacement from that of the plate (mm).
    pub residual_mm: f64,
}

/// The result of `palpate stiffness`.
#[derive(Debug, Clone, PartialEq)]
pub struct StiffnessResult {
    /// Region by region, by label.
    pub regions: Vec<RegionStiffness>,
    /// Correlation of the logarithms of the regions' moduli.
    pub correlation: Vec<Vec<f64>>,
    /// Whether moduli are in kPa.
    pub absolute: bool,
    /// The law that was used.
    pub law: Law,
    /// Poisson's ratio that was assumed.
    pub poisson: f64,
    /// That of single labels, where it is another.
    pub poisson_of: Vec<(u8, f64)>,
    /// The force that was given (N).
    pub force_n: Option<f64>,
    /// One standard deviation of the borders between labels (voxels).
    pub label_sd: f64,
    /// How far to rely on it: the worst of the field's trust and of what the model leaves over. At
    /// most moderate where one modulus leaves more than noise and no region was found for it.
    pub trust: Trust,
    /// Why.
    pub trust_reasons: Vec<String>,
    /// Label of the region that ratios refer to.
    pub reference: u8,
    /// Root mean square residual (mm, one component).
    pub residual_mm: f64,
    /// Noise of the data, from their own roughness (mm, one component).
    pub noise_mm: f64,
    /// Everything tried.
    pub evidence: Vec<Evidence>,
    /// Held and loaded patch, then the cut where the body ends with the volume, if it does.
    pub patches: Vec<PatchReport>,
    /// Young's modulus on the mask's grid (0 outside).
    pub map: Volume,
    /// Its standard deviation.
    pub map_sd: Volume,
    /// Length of the residual on the mask's grid (mm).
    pub residual: Volume,
    /// The mesh.
    pub mesh: QuadraticMesh,
    /// Young's modulus of each element.
    pub element_modulus: Vec<f64>,
    /// Displacement of the model at the nodes (mm, RAS).
    pub displacement: Vec<[f64; 3]>,
    /// Nodes that are held or loaded, with what is prescribed there.
    pub prescribed: Vec<Prescribed>,
    /// Flat faces of the body (side and voxel axis) and between labels, and how far outwards (up
    /// the axis) the data put them (voxels).
    pub faces: Vec<(String, f64)>,
    /// Force of the model on the loaded patch for the moduli found (N; kPa mm^2 / 1000 without a
    /// force).
    pub model_force: f64,
    /// Relative change of each region's modulus from the coarse to the fine mesh.
    pub mesh_change: Vec<f64>,
    /// Largest principal strain (1), 95th percentile over the body.
    pub strain: f64,
    /// What to know before trusting it.
    pub warnings: Vec<String>,
    /// Stage names and wall seconds.
    pub seconds: Vec<(String, f64)>,
    /// Samples used, and how many independent ones they are worth.
    pub samples: [f64; 2],
    /// Whether regions came from labels.
    pub labelled: bool,
    /// Without labels, what a single region leaves over where that is more than noise.
    pub left_over: Option<LeftOver>,
    /// Without labels, which balls would have been found.
    pub detectable: Vec<Detectable>,
    /// Without labels, the regions that were found (1 and on; 0 outside).
    pub found: Option<Mask>,
}

impl StiffnessResult {
    /// Poisson's ratio of a label.
    pub fn poisson_of(&self, label: u8) -> f64 {
        self.poisson_of.iter().find(|p| p.0 == label).map_or(self.poisson, |p| p.1)
    }
}

/// A displacement that a plate or base prescribes at a node.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prescribed {
    /// The node.
    pub node: u32,
    /// 0 held, 1 loaded, 2 the cut at the volume's border.
    pub patch: u8,
    /// The direction that is prescribed, a unit vector; none for all three components.
    pub direction: Option<[f64; 3]>,
    /// The displacement (mm, RAS), or any with the right component along the direction.
    pub displacement: [f64; 3],
}

/// What one frame of a sequence says.
#[derive(Debug, Clone)]
pub struct FrameStiffness {
    /// Number of the frame.
    pub frame: usize,
    /// Mean length of its displacement in the body (mm).
    pub motion_mm: f64,
    /// Root mean square residual (mm, one component).
    pub residual_mm: f64,
    /// Region by region; why not, where it tells nothing.
    pub regions: Result<Vec<RegionStiffness>, String>,
}

/// A modulus that the frames share, after the first frames (by motion, largest first) up to each.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Gain {
    /// Frames that determine it.
    pub frames: usize,
    /// Those that count in the mean; the others moved less, and know what all frames have in common
    /// worse.
    pub weighed: usize,
    /// The modulus, or the ratio where no force is known.
    pub value: f64,
    /// Its standard deviation.
    pub sd: f64,
    /// The part of it that more frames lower.
    pub data_sd: f64,
    /// Root of chi^2 per degree of freedom between the frames, beside what they have in common; 1
    /// where they agree as well as they claim.
    pub disagreement: f64,
}

/// The stiffness map that all frames of a sequence share.
#[derive(Debug)]
pub struct SharedStiffness {
    /// The result of the frame that moved most of those that determine most regions, with the
    /// shared moduli.
    pub result: StiffnessResult,
    /// Every frame.
    pub frames: Vec<FrameStiffness>,
    /// For each region, by how much each frame helped.
    pub gains: Vec<Vec<Gain>>,
}
