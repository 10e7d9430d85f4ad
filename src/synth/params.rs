//! What can be asked of a phantom.

use crate::error::{ParamError, SynthError, UnknownName};
use crate::types::names::choose;
use crate::types::{Affine, Grid};
use serde::Serialize;
use std::str::FromStr;

/// What is imaged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum PhantomKind {
    /// A lower leg in thick slices: skin, fat, muscles with fasciae, bones, vessels.
    Calf,
    /// One slice of a lower leg.
    Slice,
    /// A head-like set of nested ellipsoids.
    Head,
    /// A textured block with two inclusions.
    Block,
    /// The end of a finger: pulp, bone, nail.
    Fingertip,
}

/// How it moves from the initial to the deformed volume.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum MotionKind {
    /// Not at all.
    None,
    /// The same way everywhere, in a random direction.
    Translate,
    /// A rotation about a random axis through the middle (about the normal of a single slice).
    Rotate,
    /// A random affine map.
    Affine,
    /// A random cubic B-spline.
    Smooth,
    /// A blunt indenter: a push that decays with depth, with a bulge around it; a fingertip is pressed on a flat plate.
    Press,
    /// The two sides of a plane glide in opposite directions, with a little smooth motion on top.
    Slide,
}

impl PhantomKind {
    /// Names and kinds.
    pub const KNOWN: [(&'static str, Self); 5] = [
        ("calf", Self::Calf),
        ("slice", Self::Slice),
        ("head", Self::Head),
        ("block", Self::Block),
        ("fingertip", Self::Fingertip),
    ];
}

impl MotionKind {
    /// Names and motions.
    pub const KNOWN: [(&'static str, Self); 7] = [
        ("none", Self::None),
        ("translate", Self::Translate),
        ("rotate", Self::Rotate),
        ("affine", Self::Affine),
        ("smooth", Self::Smooth),
        ("press", Self::Press),
        ("slide", Self::Slide),
    ];
}

impl FromStr for PhantomKind {
    type Err = UnknownName;

    fn from_str(name: &str) -> Result<Self, UnknownName> {
        choose("phantom", name, &Self::KNOWN)
    }
}

impl FromStr for MotionKind {
    type Err = UnknownName;

    fn from_str(name: &str) -> Result<Self, UnknownName> {
        choose("motion", name, &Self::KNOWN)
    }
}

/// All settings of a phantom. The body fills the field of view, so size times spacing is also its scale.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PhantomParams {
    /// What is imaged.
    pub kind: PhantomKind,
    /// How it moves.
    pub motion: MotionKind,
    /// Largest displacement over the body's outline at rest (mm); for a rotation its angle (degrees).
    pub amplitude: f64,
    /// Voxels along x, y, z; each 1 or at least 8, at most one of them 1.
    pub size: [usize; 3],
    /// Voxel edges (mm).
    pub spacing: [f64; 3],
    /// Of everything random.
    pub seed: u64,
    /// Standard deviation of the Rician noise, relative to the 99th percentile of the clean deformed image (1).
    pub noise: f64,
    /// Largest logarithm of the deformed image's multiplicative bias (1); 0.15 is about 15 %.
    pub bias: f64,
    /// Landmarks wanted; fewer come where there is no room for them.
    pub landmarks: usize,
}

impl PhantomParams {
    /// The defaults of a kind: seed 1, noise 3 %, bias 15 %, 200 landmarks, and a size, spacing and motion that suit it.
    pub fn new(kind: PhantomKind) -> Self {
        let (size, spacing, motion, amplitude) = match kind {
            PhantomKind::Calf => ([96, 96, 40], [1.5, 1.5, 5.0], MotionKind::Smooth, 6.0),
            PhantomKind::Slice => ([160, 160, 1], [0.9, 0.9, 5.0], MotionKind::Smooth, 6.0),
            PhantomKind::Head => ([96, 112, 96], [2.0, 2.0, 2.0], MotionKind::Smooth, 8.0),
            PhantomKind::Block => ([64, 64, 64], [1.0, 1.0, 1.0], MotionKind::Smooth, 3.0),
            PhantomKind::Fingertip => ([64, 80, 60], [0.35, 0.35, 0.35], MotionKind::Press, 1.5),
        };
        Self { kind, motion, amplitude, size, spacing, seed: 1, noise: 0.03, bias: 0.15, landmarks: 200 }
    }

    /// The same field of view with `n` voxels along x, and the other sides in proportion.
    pub fn sized(mut self, n: usize) -> Self {
        let factor = n as f64 / self.size[0] as f64;
        for a in 0..3 {
            if self.size[a] > 1 {
                let side = (self.size[a] as f64 * factor).round().max(1.0);
                self.spacing[a] *= self.size[a] as f64 / side;
                self.size[a] = side as usize;
            }
        }
        self
    }

    /// The grid they ask for: axis-aligned, its middle near the world's origin but on no voxel centre.
    ///
    /// # Errors
    /// [`SynthError`] when a value is out of range.
    pub fn grid(&self) -> Result<Grid, SynthError> {
        self.check()?;
        let origin = std::array::from_fn(|a| self.spacing[a] * (0.21 - self.size[a] as f64 / 2.0));
        Ok(Grid::new(self.size, Affine::scaled(self.spacing, origin)?)?)
    }

    /// Checks every range.
    ///
    /// # Errors
    /// [`ParamError`] names the first value out of range.
    pub fn check(&self) -> Result<(), ParamError> {
        let within = |name, value: f64, low: f64, high: f64, range| match (low..=high).contains(&value) {
            true => Ok(()),
            false => Err(ParamError { name, value, range }),
        };
        within("amplitude", self.amplitude, 0.0, 1000.0, "0 to 1000 (mm, or degrees for rotate)")?;
        within("noise", self.noise, 0.0, 1.0, "0 to 1")?;
        within("bias", self.bias, 0.0, 2.0, "0 to 2")?;
        let single = self.size.iter().filter(|&&n| n == 1).count();
        for a in 0..3 {
            within("spacing", self.spacing[a], 1e-3, 1e3, "0.001 to 1000 mm")?;
            let ok = (8..=4096).contains(&self.size[a]) || (self.size[a] == 1 && single == 1);
            if !ok {
                let range = "8 to 4096 voxels a side (one side may be 1)";
                return Err(ParamError { name: "size", value: self.size[a] as f64, range });
            }
        }
        Ok(())
    }
}
