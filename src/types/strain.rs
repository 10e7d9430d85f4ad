//! What a strain run gives.

use crate::types::expected::Trust;
use serde::Serialize;

/// Which strain.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Default)]
#[serde(rename_all = "kebab-case")]
pub enum StrainMeasure {
    /// Green-Lagrange.
    #[default]
    GreenLagrange,
    /// Small (linear, Cauchy's).
    Small,
    /// Logarithmic (Hencky's), on the initial configuration.
    Logarithmic,
}

impl StrainMeasure {
    /// As files and options have it.
    pub fn name(self) -> &'static str {
        match self {
            Self::GreenLagrange => "green-lagrange",
            Self::Small => "small",
            Self::Logarithmic => "logarithmic",
        }
    }
}

/// A gauge that was tried.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct GaugeTrial {
    /// Gauge length (mm).
    pub gauge_mm: f64,
    /// Standard deviation of a normal strain (1).
    pub noise: f64,
    /// Error to expect of a normal strain, what is smoothed away included (1).
    pub error: f64,
}

/// One component of the strain in one region.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct RegionStrain {
    /// The label.
    pub label: u8,
    /// Voxels of it that have the component.
    pub voxels: usize,
    /// Which component.
    pub component: &'static str,
    /// Mean, standard deviation, 5th and 95th percentile over its voxels (1).
    pub values: [f64; 4],
    /// Standard deviation of each of those by the field's error (1); NaN when not known.
    pub errors: [f64; 4],
}

/// What a strain run found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StrainSummary {
    /// Which strain.
    pub measure: StrainMeasure,
    /// Gauge length (mm).
    pub gauge_mm: f64,
    /// The side of the gauge along each voxel axis (mm).
    pub gauge_axes_mm: [f64; 3],
    /// Whether the gauge was asked for.
    pub gauge_asked: bool,
    /// Gauges that were tried.
    pub gauges: Vec<GaugeTrial>,
    /// Median standard deviation of a normal strain over the tissue (1).
    pub noise: f64,
    /// Root mean square normal strain over the tissue (1).
    pub strain: f64,
    /// Whether the deviation holds all errors of the field, by draws of them.
    pub drawn: bool,
    /// Where the deviation comes from.
    pub deviation_from: &'static str,
    /// Regions, component by component.
    pub regions: Vec<RegionStrain>,
    /// How far to rely on it: the worse of the field's trust and that of the noise over the strain.
    pub trust: Trust,
    /// Why.
    pub trust_reasons: Vec<String>,
    /// Stage names and wall seconds.
    pub seconds: Vec<(String, f64)>,
    /// What the user should know.
    pub warnings: Vec<String>,
}
