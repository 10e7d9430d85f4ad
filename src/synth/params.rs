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
    /// A block with one or two balls of another stiffness, or none, pressed by a plate.
    Inclusion,
    /// Skin, fat and muscle under a punch.
    Slab,
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
    /// A blunt indenter: a push that decays with depth, with a bulge around it; a fingertip is
    /// pressed on a flat plate.
    Press,
    /// As elasticity has it: held on one side, pressed on the other (fingertip, inclusion and slab
    /// only).
    Elastic,
    /// The two sides of a plane glide in opposite directions, with a little smooth motion on top.
    Slide,
    /// Bands compressed and stretched in turn along a random axis; the amplitude is the largest
    /// strain in per cent.
    Wave,
}

impl PhantomKind {
    /// Names and kinds.
    pub const KNOWN: [(&'static str, Self); 7] = [
        ("calf", Self::Calf),
        ("slice", Self::Slice),
        ("head", Self::Head),
        ("block", Self::Block),
        ("fingertip", Self::Fingertip),
        ("inclusion", Self::Inclusion),
        ("slab", Self::Slab),
    ];

    /// The motion that is taken if none is asked for.
    fn usual_motion(self) -> MotionKind {
        match self {
            Self::Fingertip | Self::Inclusion | Self::Slab => MotionKind::Elastic,
            _ => MotionKind::Smooth,
        }
    }

    /// The amplitude that is taken if none is asked for (mm, degrees for a rotation, per cent for a
    /// wave).
    fn usual_amplitude(self, motion: MotionKind) -> f64 {
        match (self, motion) {
            (_, MotionKind::Wave) => 20.0,
            (Self::Fingertip, MotionKind::Elastic) => 0.8,
            (Self::Fingertip, _) => 1.5,
            (Self::Calf | Self::Slice, _) => 6.0,
            (Self::Head, _) => 8.0,
            (Self::Block, _) => 3.0,
            (Self::Inclusion, _) => 1.8,
            (Self::Slab, _) => 1.6,
        }
    }
}

impl MotionKind {
    /// Names and motions.
    pub const KNOWN: [(&'static str, Self); 9] = [
        ("none", Self::None),
        ("translate", Self::Translate),
        ("rotate", Self::Rotate),
        ("affine", Self::Affine),
        ("smooth", Self::Smooth),
        ("press", Self::Press),
        ("slide", Self::Slide),
        ("elastic", Self::Elastic),
        ("wave", Self::Wave),
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

/// Settings of an elastic phantom.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ElasticParams {
    /// Young's modulus of a single inclusion over the background's.
    pub contrast: f64,
    /// Inclusions: none, one, or two (of 0.5 and 4 times the background's modulus).
    pub inclusions: usize,
    /// Poisson's ratio of every region.
    pub poisson: f64,
}

/// All settings of a phantom. The body fills the field of view, so size times spacing is also its
/// scale.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PhantomParams {
    /// What is imaged.
    pub kind: PhantomKind,
    /// How it moves.
    pub motion: MotionKind,
    /// Largest displacement over the body's outline at rest (mm); for a rotation its angle
    /// (degrees), for a wave its largest strain (per cent).
    pub amplitude: f64,
    /// Voxels along x, y, z; each 1 or at least 8, at most one of them 1.
    pub size: [usize; 3],
    /// Voxel edges (mm).
    pub spacing: [f64; 3],
    /// Of everything random.
    pub seed: u64,
    /// Standard deviation of the Rician noise, relative to the 99th percentile of the clean
    /// deformed image (1).
    pub noise: f64,
    /// Largest logarithm of the deformed image's multiplicative bias (1); 0.15 is about 15 %.
    pub bias: f64,
    /// Landmarks wanted; fewer come where there is no room for them.
    pub landmarks: usize,
    /// Of an elastic motion.
    #[serde(skip)]
    pub elastic: ElasticParams,
}

impl PhantomParams {
    /// The defaults of a kind: seed 1, noise 3 %, bias 15 %, 200 landmarks, and a size, spacing and
    /// motion that suit it.
    pub fn new(kind: PhantomKind) -> Self {
        let (size, spacing) = match kind {
            PhantomKind::Calf => ([96, 96, 40], [1.5, 1.5, 5.0]),
            PhantomKind::Slice => ([160, 160, 1], [0.9, 0.9, 5.0]),
            PhantomKind::Head => ([96, 112, 96], [2.0; 3]),
            PhantomKind::Block => ([64; 3], [1.0; 3]),
            PhantomKind::Fingertip => ([64, 80, 60], [0.35; 3]),
            PhantomKind::Inclusion | PhantomKind::Slab => ([96, 96, 64], [0.5; 3]),
        };
        Self {
            kind,
            motion: MotionKind::None,
            amplitude: 0.0,
            size,
            spacing,
            seed: 1,
            noise: 0.03,
            bias: 0.15,
            landmarks: 200,
            elastic: ElasticParams { contrast: 5.0, inclusions: 1, poisson: 0.49 },
        }
        .moving(kind.usual_motion())
    }

    /// With another motion, by the amplitude that suits it.
    pub fn moving(self, motion: MotionKind) -> Self {
        Self { motion, amplitude: self.kind.usual_amplitude(motion), ..self }
    }

    /// The same field of view with `n` voxels along x, and the other sides in proportion.
    ///
    /// ```
    /// use palpate::{PhantomKind, PhantomParams};
    /// let head = PhantomParams::new(PhantomKind::Head).sized(48);
    /// assert_eq!((head.size, head.spacing), ([48, 56, 48], [4.0; 3]));
    /// ```
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

    /// The grid they ask for: axis-aligned, its middle near the world's origin but on no voxel
    /// centre.
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
        within("amplitude", self.amplitude, 0.0, 1000.0, "0 to 1000 (mm, degrees for rotate, per cent for wave)")?;
        within("noise", self.noise, 0.0, 1.0, "0 to 1")?;
        within("bias", self.bias, 0.0, 2.0, "0 to 2")?;
        if self.motion == MotionKind::Elastic {
            self.check_elastic()?;
        }
        let single = self.size.iter().filter(|&&n| n == 1).count();
        for a in 0..3 {
            within("spacing", self.spacing[a], 1e-3, 1e3, "0.001 to 1000 mm")?;
            let ok = (8..=4096).contains(&self.size[a]) || (self.size[a] == 1 && single == 1);
            if !ok {
                let range = "8 to 4096 voxels a side (one side may be 1)";
                let name = ["size", "size along y", "size along z"][a];
                return Err(ParamError { name, value: self.size[a] as f64, range });
            }
        }
        Ok(())
    }

    fn check_elastic(&self) -> Result<(), ParamError> {
        let refuse = |name, value, range| Err(ParamError { name, value, range });
        let ElasticParams { contrast, inclusions, poisson } = self.elastic;
        if self.amplitude <= 0.0 {
            return refuse("amplitude", self.amplitude, "over 0 for an elastic motion (mm)");
        }
        if !(0.01..=1000.0).contains(&contrast) {
            return refuse("contrast", contrast, "0.01 to 1000");
        }
        if inclusions > 2 {
            return refuse("inclusions", inclusions as f64, "0, 1 or 2");
        }
        if !(0.0..=0.499).contains(&poisson) {
            return refuse("poisson", poisson, "0 to 0.499");
        }
        if self.size.contains(&1) {
            return refuse("size", 1.0, "8 to 4096 voxels along every side for an elastic motion");
        }
        Ok(())
    }
}
