//! What the field pipeline gives back.

use crate::types::{ExpectedError, TetMesh, TriMesh};
use serde::{Deserialize, Serialize};
use std::fmt;

/// The mesh through the kept matches: tetrahedra, or triangles for one slice.
#[derive(Debug, Clone, PartialEq)]
pub enum Mesh {
    /// In space.
    Tetrahedra(TetMesh),
    /// In the plane of a slice.
    Triangles(TriMesh),
}

/// The smallest motion that explains the matches.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MotionModel {
    /// Nothing moves.
    Identity,
    /// One rotation and one translation.
    Rigid,
    /// One affine map.
    Affine,
    /// A free field.
    Free,
}

impl MotionModel {
    /// How many numbers it has, all for a free field.
    pub fn parameters(self) -> usize {
        match self {
            Self::Identity => 0,
            Self::Rigid => 6,
            Self::Affine => 12,
            Self::Free => usize::MAX,
        }
    }

    /// Its name in files and messages.
    pub fn name(self) -> &'static str {
        match self {
            Self::Identity => "identity",
            Self::Rigid => "rigid",
            Self::Affine => "affine",
            Self::Free => "free",
        }
    }
}

/// How well two volumes agree, whatever their contrast: the part of one's variance that the other's
/// intensity explains (correlation ratio, 0 to 1).
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Agreement {
    /// Where nothing moves; from the start, where there is one.
    pub at_rest: f64,
    /// Under the displacement.
    pub found: f64,
}

/// Where a search began.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct StartReport {
    /// Rows of the affine part (world mm, RAS, initial to deformed).
    pub affine_ras: [[f64; 4]; 3],
    /// The model of the motion beyond it. The expected error of a given start is compared with
    /// that motion.
    pub model_beyond: MotionModel,
    /// Whether a search found it, rather than that it was given.
    pub found: bool,
}

/// What became of the landmarks in the fit.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LandmarkReport {
    /// How many there are.
    pub count: usize,
    /// Standard deviation of each along an axis (mm).
    pub sd_mm: f64,
    /// Mean distance of their deformed places from where the field takes them (mm).
    pub mean_mm: f64,
    /// Numbers, from 1, of those that the field contradicts.
    pub wrong: Vec<usize>,
    /// Each one's distance (mm), in the order of the file.
    pub distances_mm: Vec<f64>,
}

/// How many of what (at full resolution).
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Counts {
    /// Features in the initial volume.
    pub features_initial: usize,
    /// Features in the deformed volume.
    pub features_deformed: usize,
    /// Candidate matches, many to many.
    pub candidates: usize,
    /// Matches kept by consistency.
    pub kept: usize,
    /// Mesh nodes.
    pub nodes: usize,
    /// Tetrahedra (triangles for one slice).
    pub tetrahedra: usize,
}

impl Counts {
    /// The share of the initial volume's features whose matches were kept.
    pub fn kept_share(&self) -> f64 {
        self.kept as f64 / self.features_initial.max(1) as f64
    }
}

/// One level of the coarse-to-fine pyramid.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct LevelReport {
    /// Voxel size on this level (mm).
    pub spacing_mm: [f64; 3],
    /// Counts on this level.
    pub counts: Counts,
    /// Consistency energy of the best-correlation assignment, before relaxation (1).
    pub energy_before: f64,
    /// The same energy after relaxation (1).
    pub energy_after: f64,
    /// Median distance of the kept matches to the coupled field (mm).
    pub residual_mm: f64,
}

impl fmt::Display for LevelReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { spacing_mm, counts, energy_before, energy_after, residual_mm } = self;
        let Counts { candidates, kept, .. } = counts;
        write!(f, "level {spacing_mm:.2?} mm: {candidates} candidates, {kept} kept, ")?;
        write!(f, "energy {energy_before:.4} -> {energy_after:.4}, residual {residual_mm:.3} mm")
    }
}

impl LevelReport {
    /// Of this part of a level and another: sums of the counts, and means by features and by
    /// matches.
    #[must_use]
    pub fn with(&self, other: &Self) -> Self {
        let mean = |a: f64, b: f64, [n, m]: [usize; 2]| (a * n as f64 + b * m as f64) / (n + m).max(1) as f64;
        let features = [self, other].map(|r| r.counts.features_initial);
        let kept = [self, other].map(|r| r.counts.kept);
        Self {
            spacing_mm: self.spacing_mm,
            counts: Counts {
                features_initial: features[0] + features[1],
                features_deformed: self.counts.features_deformed + other.counts.features_deformed,
                candidates: self.counts.candidates + other.counts.candidates,
                kept: kept[0] + kept[1],
                nodes: self.counts.nodes + other.counts.nodes,
                tetrahedra: self.counts.tetrahedra + other.counts.tetrahedra,
            },
            energy_before: mean(self.energy_before, other.energy_before, features),
            energy_after: mean(self.energy_after, other.energy_after, features),
            residual_mm: mean(self.residual_mm, other.residual_mm, kept),
        }
    }
}

/// What one stage did to the field.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StageReport {
    /// Which: the matches alone, a level's refinement iterations, or the final field.
    pub name: String,
    /// Voxel size of the level it worked on (mm).
    pub spacing_mm: [f64; 3],
    /// Mean length over the mask by which it changed the displacement (mm).
    pub moved_mm: f64,
    /// Part of the initial volume's variance that the warped deformed volume does not explain (1).
    pub unexplained: f64,
    /// Mean error over the mask (mm), where the truth is known.
    pub error_mm: Option<f64>,
}

/// A body of the scene: tissue that slides along the rest, or all of it where nothing slides.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct BodyReport {
    /// Its label, from 1.
    pub label: u8,
    /// Voxels of the mask that belong to it.
    pub voxels: usize,
    /// The smallest motion that explains it.
    pub model: MotionModel,
    /// How far the tissue beside it moves from where its own motion leads (mm, median along its
    /// border); 0 where it borders on none.
    pub slides_mm: f64,
    /// Expected mean error within it (mm).
    pub expected_error_mm: f64,
}

/// Everything but the volumes.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FieldSummary {
    /// Counts at full resolution.
    pub counts: Counts,
    /// The model that was chosen.
    pub model: MotionModel,
    /// Whether it was asked for and the evidence speaks against it.
    pub rejected: bool,
    /// Why: the evidence for each model tried, in words with numbers.
    pub evidence: Vec<String>,
    /// The bodies that were found: one where nothing slides.
    pub bodies: Vec<BodyReport>,
    /// Coarse to fine.
    pub levels: Vec<LevelReport>,
    /// The field after each stage, in order.
    pub stages: Vec<StageReport>,
    /// Voxels of the mask with a Jacobian determinant at or below zero.
    pub folds: usize,
    /// Voxels of the mask.
    pub mask_voxels: usize,
    /// Mean and largest displacement magnitude over the mask (mm).
    pub mean_mm: f64,
    /// Largest length over the mask (mm).
    pub max_mm: f64,
    /// Median of the uncertainty over the mask (mm, 1 sigma).
    pub uncertainty_median_mm: f64,
    /// How far off the displacement is expected to be.
    pub expected: ExpectedError,
    /// The part of the mask that lies outside the deformed volume after the motion, or where that
    /// is not finite (1).
    pub unseen: f64,
    /// How well the volumes agree, at rest and under the displacement.
    pub agreement: Agreement,
    /// The volume ("initial" or "deformed") that was brought to the other's contrast, where they
    /// have different ones.
    pub recast: Option<&'static str>,
    /// What became of the landmarks, where there are any.
    pub landmarks: Option<LandmarkReport>,
    /// Where the search began, where a start was given.
    pub start: Option<StartReport>,
    /// Stage names and wall seconds, in order.
    pub seconds: Vec<(String, f64)>,
    /// What the user should know before trusting the result.
    pub warnings: Vec<String>,
}
