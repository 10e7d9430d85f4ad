//! Feature points, matches and sparse displacement fields.

use crate::types::space::{GridVector, Matrix3, VoxelPoint, WorldPoint};
use crate::types::transform::AffineMap;

/// A corner-like place of a volume (3D Harris).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FeaturePoint {
    /// Sub-voxel position in the volume it was found in.
    pub voxel: VoxelPoint,
    /// The same in world mm (RAS).
    pub world: WorldPoint,
    /// Corner response; larger is more distinct. Its unit is intensity^2 / mm^2 (Foerstner) or as
    /// the measure says.
    pub response: f32,
}

/// One of several places where the tissue of an initial feature may have gone.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// Displacement along the initial grid's axes.
    pub displacement: GridVector,
    /// Normalised cross-correlation of the two patches, -1 to 1; or another similarity, at most 1.
    pub ncc: f32,
}

/// One correspondence: the tissue at `initial` is found at `initial + displacement` in the deformed
/// volume.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Match {
    /// Place in the initial volume, world mm (RAS).
    pub initial: WorldPoint,
    /// Initial to deformed, world mm.
    pub displacement: [f64; 3],
    /// Normalised cross-correlation of the two patches, -1 to 1.
    pub ncc: f32,
    /// Covariance of the displacement (mm^2): xx, yy, zz, xy, xz, yz.
    pub covariance: [f64; 6],
    /// Whether the consistency stage kept it.
    pub kept: bool,
    /// What least-squares matching alone measured there, where a field was fitted to it later.
    pub raw: Option<RawMatch>,
}

/// A match before the field of all voxels was estimated.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RawMatch {
    /// Initial to deformed, world mm.
    pub displacement: [f64; 3],
    /// One number for the precision: the root of a third of the covariance's trace (mm).
    pub sigma: f64,
}

impl Match {
    /// The same with what the final estimate says there: displacement (mm, RAS) and standard
    /// deviation along an axis (mm); what was measured stays as [`Match::raw`].
    #[must_use]
    pub fn with_estimate(self, displacement: [f64; 3], deviation: f64) -> Self {
        let raw = self.raw.or(Some(RawMatch { displacement: self.displacement, sigma: self.sigma() }));
        let variance = deviation * deviation;
        Self { displacement, covariance: [variance, variance, variance, 0.0, 0.0, 0.0], raw, ..self }
    }

    /// The same, followed by an affine map of the world (mm, RAS).
    #[must_use]
    pub fn followed_by(&self, map: &AffineMap) -> Self {
        let moved = |d: [f64; 3]| map.at(self.initial.moved(d)).minus(self.initial);
        let covariance = covariance_after(&map.rows().map(|[x, y, z, _]| [x, y, z]), &self.covariance);
        let raw = self.raw.map(|raw| RawMatch { displacement: moved(raw.displacement), ..raw });
        Self { displacement: moved(self.displacement), covariance, raw, ..*self }
    }

    /// One number for the precision: the root of a third of the covariance's trace (mm).
    ///
    /// ```
    /// use palpate::{Match, WorldPoint};
    /// let m = Match {
    ///     initial: WorldPoint([0.0; 3]),
    ///     displacement: [1.0, 0.0, 0.0],
    ///     ncc: 0.9,
    ///     covariance: [0.04, 0.04, 0.04, 0.0, 0.0, 0.0],
    ///     kept: true,
    ///     raw: None,
    /// };
    /// assert!((m.sigma() - 0.2).abs() < 1e-12);
    /// ```
    pub fn sigma(&self) -> f64 {
        ((self.covariance[0] + self.covariance[1] + self.covariance[2]) / 3.0).max(0.0).sqrt()
    }
}

/// A covariance (xx, yy, zz, xy, xz, yz) after a linear map.
pub(crate) fn covariance_after(linear: &Matrix3, [xx, yy, zz, xy, xz, yz]: &[f64; 6]) -> [f64; 6] {
    let c = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]];
    let after = |r: usize, s: usize| -> f64 {
        (0..3).map(|a| (0..3).map(|b| linear[r][a] * c[a][b] * linear[s][b]).sum::<f64>()).sum()
    };
    [after(0, 0), after(1, 1), after(2, 2), after(0, 1), after(0, 2), after(1, 2)]
}

/// Matches of one pair of volumes.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SparseField {
    /// Kept and rejected ones, in a fixed order.
    pub matches: Vec<Match>,
}

impl SparseField {
    /// Voxels of the finest axis between the middle one of a match's patch and its outermost ones:
    /// a match tells the mean over 7 x 7 x 7 (over fewer along the normal of thick slices, at least
    /// 3).
    pub(crate) const PATCH: usize = 3;

    /// The matches that consistency kept.
    ///
    /// ```
    /// use palpate::{Match, SparseField, WorldPoint};
    /// let at = |x, kept| Match {
    ///     initial: WorldPoint([x, 0.0, 0.0]),
    ///     displacement: [0.5, 0.0, 0.0],
    ///     ncc: 0.9,
    ///     covariance: [0.01, 0.01, 0.01, 0.0, 0.0, 0.0],
    ///     kept,
    ///     raw: None,
    /// };
    /// let field = SparseField { matches: vec![at(0.0, true), at(1.0, false), at(2.0, true)] };
    /// let places: Vec<f64> = field.kept().map(|m| m.initial.0[0]).collect();
    /// assert_eq!(places, [0.0, 2.0]);
    /// ```
    pub fn kept(&self) -> impl Iterator<Item = &Match> {
        self.matches.iter().filter(|m| m.kept)
    }
}

/// A place known in both volumes, from an expert or from exact truth (world mm, RAS).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Landmark {
    /// Place in the initial volume.
    pub initial: WorldPoint,
    /// The same tissue in the deformed volume.
    pub deformed: WorldPoint,
}
