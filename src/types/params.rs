//! Parameters of the field pipeline: default, range, unit and source of each.

use crate::error::ParamError;
use crate::types::MotionModel;
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
    /// As balanced, with twice the matches; the field is the same to a few hundredths.
    Accurate,
}

/// Which stages make the field.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, Default)]
#[serde(rename_all = "lowercase")]
pub enum Method {
    /// Matches find the motion, the residual of all voxels makes the field.
    #[default]
    Full,
    /// Matches alone: many-to-many candidates, energy-based consistency, least-squares matching and
    /// the field through them, coarse to fine (Zhang, Hirai, Endo & Morikawa 2007).
    Sparse,
}

/// Which bodies a scene has: parts that slide along each other, each with a motion of its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, Default)]
#[serde(rename_all = "lowercase")]
pub enum BodySource {
    /// As many as the volumes ask for; most scenes have one.
    #[default]
    Found,
    /// One: nothing slides.
    Bonded,
    /// The labels of the mask.
    Given,
}

/// Which motion model stands for each body.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, Default)]
#[serde(rename_all = "lowercase")]
pub enum ModelSource {
    /// The smallest that explains the volumes.
    #[default]
    Auto,
    /// Nothing moves.
    Identity,
    /// One rotation and one translation.
    Rigid,
    /// One affine map.
    Affine,
    /// A free field, also where nothing seems to move.
    Free,
}

impl ModelSource {
    /// The model that was asked for; none where the volumes choose.
    pub fn asked(self) -> Option<MotionModel> {
        match self {
            Self::Auto => None,
            Self::Identity => Some(MotionModel::Identity),
            Self::Rigid => Some(MotionModel::Rigid),
            Self::Affine => Some(MotionModel::Affine),
            Self::Free => Some(MotionModel::Free),
        }
    }
}

/// How the dense field is made from the measured places.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Interpolation {
    /// The coupled spline field, brought to the last residual of the two volumes.
    Spline,
    /// Piecewise linear in the tetrahedra (triangles) of the kept matches, as in the source; the
    /// spline outside.
    Barycentric,
}

/// Parameters of [`crate::pipeline::field`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FieldParams {
    /// Preset that the other values came from.
    pub preset: Preset,
    /// Which stages make the field.
    pub method: Method,
    /// Feature points wanted in the initial volume at full resolution (the deformed one gets up to
    /// five times as many, as in the source); 0 = one for each `voxels_per_point` voxels of the
    /// mask.
    pub points: usize,
    /// Voxels of the mask for each automatic point (1); 27 to 1000. Measured: more points than one
    /// in 64 voxels gain nothing, since their patches overlap.
    pub voxels_per_point: usize,
    /// Largest motion looked for (mm); 0 = 15 % of the volume's smallest side, 2 voxels to 30 mm,
    /// and twice as far where the motion reaches that.
    pub search_mm: f64,
    /// Finest level worked on: 1 = full resolution, 2 = half; 0 = the finest with at most 600,000
    /// voxels of tissue.
    pub finest: usize,
    /// Voxels between the nodes of the spline lattice on the finest level (1); 2 to 16, or 0 = by
    /// the size of the tissue, and closer by evidence.
    pub node_spacing: usize,
    /// Residual passes on the finest level; 1 to 40.
    pub passes: usize,
    /// Residual passes on each coarser level; 1 to 60.
    pub coarse_passes: usize,
    /// Residual passes on the level that is twice as fine as the finest one worked on, where that
    /// is not full resolution, for a field that is free; 0 to 100.
    pub finer_passes: usize,
    /// How the dense field is made.
    pub interpolation: Interpolation,
    /// Candidates kept from each source of matches on the coarsest level, at most 3 on the finest;
    /// 1 to 20.
    pub candidates: usize,
    /// Whether neighbours choose among the candidates and cast out those that fit nowhere; without,
    /// the best correlation counts. Only for comparisons.
    pub consistency: bool,
    /// Whether matches are refined to a fraction of a voxel. Only for comparisons.
    pub sub_voxel: bool,
    /// Which motion model stands for each body.
    pub model: ModelSource,
    /// Which bodies there are.
    pub bodies: BodySource,
    /// Labels of the given bodies that move rigidly.
    pub rigid: Vec<u8>,
    /// Seed of whatever is drawn at random.
    pub seed: u64,
}

impl Default for FieldParams {
    fn default() -> Self {
        Self::preset(Preset::Balanced)
    }
}

impl FieldParams {
    /// Names of all parameters, as files have them.
    pub const KEYS: [&str; 18] = [
        "preset",
        "method",
        "points",
        "voxels_per_point",
        "search_mm",
        "finest",
        "node_spacing",
        "passes",
        "coarse_passes",
        "finer_passes",
        "interpolation",
        "candidates",
        "consistency",
        "sub_voxel",
        "model",
        "bodies",
        "rigid",
        "seed",
    ];

    /// The values of a preset (docs/explanation/accuracy.md has the measurements behind them).
    ///
    /// ```
    /// use palpate::FieldParams;
    /// use palpate::types::params::Preset;
    /// let [fast, accurate] = [Preset::Fast, Preset::Accurate].map(FieldParams::preset);
    /// // Fewer voxels for each point are more points.
    /// assert!(fast.voxels_per_point > accurate.voxels_per_point);
    /// ```
    pub fn preset(preset: Preset) -> Self {
        let balanced = Self {
            preset,
            method: Method::Full,
            points: 0,
            voxels_per_point: 125,
            search_mm: 0.0,
            finest: 1,
            node_spacing: 0,
            passes: 8,
            coarse_passes: 10,
            finer_passes: 0,
            interpolation: Interpolation::Spline,
            candidates: 8,
            consistency: true,
            sub_voxel: true,
            model: ModelSource::Auto,
            bodies: BodySource::Found,
            rigid: Vec::new(),
            seed: 1,
        };
        match preset {
            Preset::Fast => {
                Self { finest: 0, passes: 5, coarse_passes: 8, finer_passes: 3, voxels_per_point: 1000, ..balanced }
            }
            Preset::Balanced => balanced,
            // 12 and 16 passes leave 1 % less error over 35 pairs, at a quarter more time: only the
            // matches are more.
            Preset::Accurate => Self { voxels_per_point: 64, ..balanced },
        }
    }

    /// Checks every range.
    ///
    /// # Errors
    /// [`ParamError`] names the first value out of range, the range, and the unit.
    ///
    /// ```
    /// use palpate::FieldParams;
    /// assert!(FieldParams::default().check().is_ok());
    /// let wrong = FieldParams { passes: 0, ..FieldParams::default() };
    /// let error = wrong.check().unwrap_err();
    /// assert_eq!((error.name, error.range), ("passes", "1 to 100"));
    /// ```
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
        let whole = [
            ("voxels_per_point", self.voxels_per_point, 8, 100_000, "8 to 100,000"),
            ("finest", self.finest, 0, 8, "0 (automatic), 1 (full resolution) to 8"),
            ("passes", self.passes, 1, 100, "1 to 100"),
            ("coarse_passes", self.coarse_passes, 1, 100, "1 to 100"),
            ("finer_passes", self.finer_passes, 0, 100, "0 to 100"),
            ("candidates", self.candidates, 1, 20, "1 to 20"),
        ];
        if self.node_spacing > 16 || self.node_spacing == 1 {
            let value = self.node_spacing as f64;
            return Err(ParamError { name: "node_spacing", value, range: "0 (automatic), or 2 to 16 voxels" });
        }
        for (name, value, low, high, range) in whole {
            if !(low..=high).contains(&value) {
                return Err(ParamError { name, value: value as f64, range });
            }
        }
        Ok(())
    }
}
