//! Parameters of the field pipeline: default, range, unit and source of each.

use crate::error::ParamError;
use serde::{Deserialize, Serialize};

/// How much time to spend.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, Default)]
#[serde(rename_all = "lowercase")]
pub enum Preset {
    /// Least time.
    Fast,
    /// The default.
    #[default]
    Balanced,
    /// Least error.
    Accurate,
}

/// Parameters of [`crate::pipeline::field`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FieldParams {
    /// Preset that the other values came from.
    pub preset: Preset,
    /// Feature points wanted in the initial volume at full resolution (the deformed one gets up to five times as
    /// many, as in the source); 0 = as many as the volume's texture and size ask for.
    pub points: usize,
    /// Largest motion looked for (mm); 0 = a fifth of the volume's smallest side, at most 40 mm.
    pub search_mm: f64,
    /// Seed of whatever is drawn at random.
    pub seed: u64,
}

impl Default for FieldParams {
    fn default() -> Self {
        Self::preset(Preset::Balanced)
    }
}

impl FieldParams {
    /// The values of a preset.
    pub fn preset(preset: Preset) -> Self {
        Self { preset, points: 0, search_mm: 0.0, seed: 1 }
    }

    /// Checks every range.
    ///
    /// # Errors
    /// [`ParamError`] names the first value out of range, the range, and the unit.
    pub fn check(&self) -> Result<(), ParamError> {
        if !(self.search_mm.is_finite() && (0.0..=200.0).contains(&self.search_mm)) {
            return Err(ParamError { name: "search", value: self.search_mm, range: "0 (automatic) to 200 mm" });
        }
        if self.points > 2_000_000 || (self.points > 0 && self.points < 20) {
            return Err(ParamError {
                name: "points",
                value: self.points as f64,
                range: "0 (automatic), or 20 to 2,000,000",
            });
        }
        Ok(())
    }
}
