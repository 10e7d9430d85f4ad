//! Phantoms made worse in one respect, by a severity: what a measurement can be pushed with until
//! it breaks.
//!
//! Each [`Trouble`] has a range from harmless to hopeless. All else stays as in the phantom it
//! starts from, but for a still ring and a joint, which are bodies of their own. Changes of what
//! the body looks like are made to the body itself, before motion, bias and noise, so that the
//! truth stays exact. Fails when a severity is outside the range of its trouble, or the motion
//! folds.

use crate::error::{ParamError, SynthError};
use crate::numerics::filters;
use crate::numerics::random::Random;
use crate::synth::params::{MotionKind, PhantomParams};
use crate::synth::phantom::{Phantom, phantom};
use crate::synth::{appearance, scenes, volume_faults};
use crate::types::{DenseField, Mask};
use rayon::prelude::*;

/// What goes wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Trouble {
    /// Standard deviation of the Rician noise, per cent of the brightest tissue.
    Noise,
    /// Largest displacement of a smooth motion (mm).
    Motion,
    /// Largest strain (per cent) of bands that are compressed and stretched in turn.
    Strain,
    /// Angle of a rotation (degrees).
    Rotation,
    /// Largest change of brightness across the deformed volume (per cent).
    Bias,
    /// Thickness of slices, each the mean of thin ones (mm).
    SliceThickness,
    /// Share of a pattern that repeats every six voxels in what the tissue shows (per cent).
    RepetitiveTexture,
    /// Share of the tissue in a ball that shows one even grey (per cent).
    NoTexture,
    /// Share of the tissue in a ball that is gone from the deformed volume (per cent).
    MissingTissue,
    /// Exponent to whose root the deformed volume's intensities are taken (1): 2 is the square
    /// root.
    ContrastChange,
    /// Share of the inverted contrast in the deformed volume (per cent): at 50 nothing is left, 100
    /// is inverted.
    ContrastInversion,
    /// Largest displacement of two halves that glide along each other (mm).
    Sliding,
    /// Share of the deformed volume cut off at its right end (per cent).
    Crop,
    /// Shift of the deformed volume's field of view against the initial one's (per cent of its
    /// length); at 100 and above the two have nothing in common.
    NoOverlap,
    /// Brightness of a still ring round a muscle that moves, over the muscle's (ratio).
    StillRing,
    /// Single voxels of the deformed volume at thirty times its maximum (voxels).
    HotVoxels,
    /// Brightness of a still textured background in both volumes, over fat's, the brightest tissue
    /// (ratio).
    Background,
    /// Largest displacement (mm) of a ball that turns inside its own wall, on top of the motion of
    /// everything.
    CurvedSliding,
    /// Angle by which one of two bones turns about their joint (degrees).
    Joint,
    /// Share of the inverted contrast in the right half of the deformed volume (per cent); it fades
    /// to none over the middle fifth.
    LocalContrast,
    /// Share of the repeating pattern in bright tissue beside dark tissue (per cent).
    BrightRepetition,
    /// Share of the repeating pattern in dark tissue beside bright tissue (per cent).
    DarkRepetition,
}

impl Trouble {
    /// All of them with name, unit and range of severities.
    pub const ALL: [(Self, &'static str, &'static str, [f64; 2]); 22] = [
        (Self::Noise, "noise", "%", [0.0, 20.0]),
        (Self::Motion, "motion", "mm", [1.0, 30.0]),
        (Self::Strain, "strain", "%", [5.0, 50.0]),
        (Self::Rotation, "rotation", "degrees", [1.0, 45.0]),
        (Self::Bias, "bias", "%", [0.0, 80.0]),
        (Self::SliceThickness, "slice thickness", "mm", [1.0, 8.0]),
        (Self::RepetitiveTexture, "repetitive texture", "%", [0.0, 100.0]),
        (Self::NoTexture, "no texture", "%", [0.0, 95.0]),
        (Self::MissingTissue, "missing tissue", "%", [0.0, 60.0]),
        (Self::ContrastChange, "contrast change", "exponent", [1.0, 8.0]),
        (Self::ContrastInversion, "contrast inversion", "%", [0.0, 100.0]),
        (Self::Sliding, "sliding", "mm", [1.0, 20.0]),
        (Self::Crop, "crop", "%", [0.0, 90.0]),
        (Self::NoOverlap, "no overlap", "%", [0.0, 120.0]),
        (Self::StillRing, "still ring", "ratio", [1.0, 5.0]),
        (Self::HotVoxels, "hot voxels", "voxels", [0.0, 100.0]),
        (Self::Background, "bright background", "ratio", [1.0, 40.0]),
        (Self::CurvedSliding, "curved sliding", "mm", [1.0, 20.0]),
        (Self::Joint, "joint", "degrees", [1.0, 40.0]),
        (Self::LocalContrast, "local contrast", "%", [0.0, 100.0]),
        (Self::BrightRepetition, "bright repetition", "%", [0.0, 100.0]),
        (Self::DarkRepetition, "dark repetition", "%", [0.0, 100.0]),
    ];

    /// The row of [`Trouble::ALL`].
    fn row(self) -> &'static (Self, &'static str, &'static str, [f64; 2]) {
        Self::ALL.iter().find(|t| t.0 == self).unwrap_or(&Self::ALL[0])
    }

    /// As in files and charts.
    pub fn name(self) -> &'static str {
        self.row().1
    }

    /// Unit of the severity.
    pub fn unit(self) -> &'static str {
        self.row().2
    }

    /// Least and greatest severity that is of interest.
    pub fn range(self) -> [f64; 2] {
        self.row().3
    }
}

/// The phantom of `base` with `trouble` of the given severity, in [`Trouble::unit`].
///
/// The mask holds the tissue that the deformed volume shows: not what is gone, cut off or shifted
/// away; it may be empty.
///
/// # Errors
/// [`SynthError`] when the severity is outside [`Trouble::range`], or as [`phantom`] has it.
///
/// ```
/// use palpate::synth::{Trouble, troubled};
/// use palpate::{PhantomKind, PhantomParams};
/// let block = PhantomParams::new(PhantomKind::Block).sized(24);
/// let [clean, noisy] = [0.0, 20.0].map(|percent| troubled(&block, Trouble::Noise, percent));
/// assert!(clean?.initial != noisy?.initial);
/// // The severity has a range.
/// assert!(troubled(&block, Trouble::Noise, 1e6).is_err());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn troubled(base: &PhantomParams, trouble: Trouble, severity: f64) -> Result<Phantom, SynthError> {
    let [low, high] = trouble.range();
    if !(low..=high).contains(&severity) {
        return Err(ParamError { name: "severity", value: severity, range: "in the range of its trouble" }.into());
    }
    let share = severity / 100.0;
    let with = |motion, amplitude| PhantomParams { motion, amplitude, ..base.clone() };
    match trouble {
        Trouble::Noise => phantom(&PhantomParams { noise: share, ..base.clone() }),
        Trouble::Motion => phantom(&with(MotionKind::Smooth, severity)),
        Trouble::Strain => phantom(&with(MotionKind::Wave, severity)),
        Trouble::Rotation => phantom(&with(MotionKind::Rotate, severity)),
        Trouble::Sliding => phantom(&with(MotionKind::Slide, severity)),
        Trouble::Bias => phantom(&PhantomParams { bias: (1.0 + share).ln(), ..base.clone() }),
        Trouble::SliceThickness => volume_faults::thick_slices(base, severity),
        Trouble::Crop => volume_faults::cropped(base, share),
        Trouble::NoOverlap => volume_faults::shifted(base, share),
        Trouble::HotVoxels => volume_faults::hot_voxels(base, severity.round() as usize),
        Trouble::Background => volume_faults::background(base, severity),
        Trouble::RepetitiveTexture => appearance::repetitive(base, share, &|_| [1.0, 1.0]),
        Trouble::BrightRepetition | Trouble::DarkRepetition => {
            appearance::repetitive_beside(base, share, trouble == Trouble::BrightRepetition)
        }
        Trouble::NoTexture => appearance::even_ball(base, share),
        Trouble::MissingTissue => appearance::missing(base, share),
        Trouble::ContrastChange => appearance::root(base, severity),
        Trouble::ContrastInversion => appearance::inverted(base, &|_| share),
        Trouble::LocalContrast => appearance::inverted_on_the_right(base, share),
        Trouble::StillRing => scenes::still_ring(base, severity),
        Trouble::CurvedSliding => scenes::organ(base, severity),
        Trouble::Joint => scenes::joint(base, severity),
    }
}

/// `truth` with errors as a measurement has them: normal with a standard deviation of `sigma` (mm)
/// along each axis, correlated over about three voxels.
///
/// ```
/// use palpate::synth::degradation::disturbed;
/// use palpate::{Affine, DenseField, Grid, evaluate};
/// let grid = Grid::new([24; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let truth = DenseField::from_fn(grid, |p| [0.1 * p.0[0], 0.0, 0.0]);
/// let error = evaluate::metrics(&disturbed(&truth, 0.2, 1), &truth, None, &[])?.mean_mm;
/// // The mean length of three normal components is 1.6 standard deviations.
/// assert!((error / (0.2 * 1.596) - 1.0).abs() < 0.15);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn disturbed(truth: &DenseField, sigma: f64, seed: u64) -> DenseField {
    let (grid, n) = (*truth.grid(), truth.grid().len());
    let mut out = truth.clone();
    for (c, component) in out.as_mut_slice().chunks_exact_mut(n).enumerate() {
        let base = Random::new(seed, 90 + c as u64).bits();
        let white: Vec<f32> =
            (0..n).into_par_iter().map(|at| Random::new(base, at as u64).normals()[0] as f32).collect();
        let smooth = filters::gaussian(&white, grid.shape(), [1.5; 3]);
        let power = smooth.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>() / n as f64;
        let scale = (sigma / power.sqrt().max(1e-12)) as f32;
        component.iter_mut().zip(&smooth).for_each(|(v, e)| *v += scale * e);
    }
    out
}

/// Labels with all borders inside the body `voxels` further along x; its outline stays.
pub fn shifted_labels(labels: &Mask, voxels: usize) -> Mask {
    let (old, grid) = (labels.as_slice(), *labels.grid());
    Mask::from_voxels(grid, |at, _| {
        let from = if grid.voxel(at)[0] >= voxels { old[at - voxels] } else { 0 };
        if old[at] == 0 || from == 0 { old[at] } else { from }
    })
}
