//! Fingertip models behind one interface: energy as a function of normal displacement d, tangential
//! displacement d_t and tilt, with its first and second derivatives.
//!
//! Source: T. Inoue and S. Hirai, "Elastic Model of Deformable Fingertip for Soft-Fingered
//! Manipulation", IEEE Trans. Robotics 22(6), 2006, and S. Hirai's slides. The tilt is the angle
//! between the back plate and the object's face, with the sign of docs/reference/grasp.md; SI units
//! throughout.

use crate::grasp::tabulated::Tabulated;
use crate::types::{Fingertip, FingertipModel, Scene};
use std::f64::consts::PI;

/// Sine and cosine of a tilt.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tilt {
    /// Sine.
    pub sin: f64,
    /// Cosine, above 0.
    pub cos: f64,
}

impl Tilt {
    /// Of an angle (rad).
    pub fn of(angle: f64) -> Self {
        Self { sin: angle.sin(), cos: angle.cos() }
    }
}

/// First derivatives of the energy.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Gradient {
    /// dU/dd (N).
    pub normal: f64,
    /// dU/dd_t (N).
    pub tangential: f64,
    /// dU/dtilt (N m).
    pub moment: f64,
}

/// Second derivatives of the energy in (d, d_t, tilt), row by row (N/m, N, N m).
pub(crate) type Curvature = [[f64; 3]; 3];

/// A fingertip that answers to displacement with energy.
pub trait Tip: std::fmt::Debug + Sync {
    /// Whether d_n is held at 0 (rigid tips).
    fn holds_normal(&self) -> bool {
        false
    }

    /// Whether d_t is held at 0 (tips without tangential deformation).
    fn holds_tangent(&self) -> bool {
        true
    }

    /// Energy (J) at `d`, `d_t` (m).
    fn energy(&self, d: f64, d_t: f64, tilt: Tilt) -> f64;

    /// Its first derivatives.
    fn gradient(&self, d: f64, d_t: f64, tilt: Tilt) -> Gradient;

    /// Its second derivatives.
    fn curvature(&self, d: f64, d_t: f64, tilt: Tilt) -> Curvature;
}

impl<T: Tip + ?Sized> Tip for &T {
    fn holds_normal(&self) -> bool {
        (**self).holds_normal()
    }

    fn holds_tangent(&self) -> bool {
        (**self).holds_tangent()
    }

    fn energy(&self, d: f64, d_t: f64, tilt: Tilt) -> f64 {
        (**self).energy(d, d_t, tilt)
    }

    fn gradient(&self, d: f64, d_t: f64, tilt: Tilt) -> Gradient {
        (**self).gradient(d, d_t, tilt)
    }

    fn curvature(&self, d: f64, d_t: f64, tilt: Tilt) -> Curvature {
        (**self).curvature(d, d_t, tilt)
    }
}

/// Parallel distributed springs with tangential deformation:
/// U = pi E (d^3 / (3 cos^2) + d^2 d_t tan + d d_t^2).
///
/// The exact sum of linear springs that stand on the hemisphere along the back plate's normal,
/// whose feet are pressed by d and dragged by d_t (tests/grasp/grasp.rs sums them).
#[derive(Debug, Clone, Copy)]
pub struct Parallel {
    /// pi E (Pa).
    pub stiffness: f64,
}

impl Tip for Parallel {
    #[inline(always)]
    fn holds_tangent(&self) -> bool {
        false
    }

    #[inline(always)]
    fn energy(&self, d: f64, d_t: f64, tilt: Tilt) -> f64 {
        let secant = 1.0 / tilt.cos;
        let tan = tilt.sin * secant;
        self.stiffness * d * (d * d * secant * secant / 3.0 + d_t * (d * tan + d_t))
    }

    #[inline(always)]
    fn gradient(&self, d: f64, d_t: f64, tilt: Tilt) -> Gradient {
        let secant = 1.0 / tilt.cos;
        let tan = tilt.sin * secant;
        let (along, drag) = (d * secant, d * tan);
        Gradient {
            normal: self.stiffness * (along * along + d_t * (2.0 * drag + d_t)),
            tangential: self.stiffness * d * (drag + 2.0 * d_t),
            moment: self.stiffness * along * along * ((2.0 / 3.0) * drag + d_t),
        }
    }

    fn curvature(&self, d: f64, d_t: f64, tilt: Tilt) -> Curvature {
        let square = 1.0 / (tilt.cos * tilt.cos);
        let tan = tilt.sin / tilt.cos;
        let both = 2.0 * (d * tan + d_t);
        let dd = 2.0 * (d * square + d_t * tan);
        let (d_tilt, t_tilt) = (d * square * both, d * d * square);
        let tilt_tilt = d * d * square * (2.0 * d / 3.0 * (square + 2.0 * tan * tan) + 2.0 * d_t * tan);
        [[dd, both, d_tilt], [both, 2.0 * d, t_tilt], [d_tilt, t_tilt, tilt_tilt]]
            .map(|row| row.map(|v| self.stiffness * v))
    }
}

/// Parallel distributed springs, normal only: U = pi E d^3 / (3 cos^2); rolls without tangential
/// deformation.
#[derive(Debug, Clone, Copy)]
pub struct ParallelNormal {
    /// pi E (Pa).
    pub stiffness: f64,
}

impl Tip for ParallelNormal {
    #[inline(always)]
    fn energy(&self, d: f64, _d_t: f64, tilt: Tilt) -> f64 {
        self.stiffness * d * d * d / (3.0 * tilt.cos * tilt.cos)
    }

    #[inline(always)]
    fn gradient(&self, d: f64, _d_t: f64, tilt: Tilt) -> Gradient {
        let along = d / tilt.cos;
        let normal = self.stiffness * along * along;
        Gradient { normal, tangential: 0.0, moment: normal * (2.0 / 3.0) * d * tilt.sin / tilt.cos }
    }

    fn curvature(&self, d: f64, _d_t: f64, tilt: Tilt) -> Curvature {
        Parallel { stiffness: self.stiffness }.curvature(d, 0.0, tilt).map_entries(|i, j| i != 1 && j != 1)
    }
}

/// Radially distributed springs as the source has them: f = pi E d^2, U = pi E d^3 / 3, whatever
/// the posture.
#[derive(Debug, Clone, Copy)]
pub struct Radial {
    /// pi E (Pa).
    pub stiffness: f64,
}

impl Tip for Radial {
    #[inline(always)]
    fn energy(&self, d: f64, _d_t: f64, _tilt: Tilt) -> f64 {
        self.stiffness * d * d * d / 3.0
    }

    #[inline(always)]
    fn gradient(&self, d: f64, _d_t: f64, _tilt: Tilt) -> Gradient {
        Gradient { normal: self.stiffness * d * d, tangential: 0.0, moment: 0.0 }
    }

    fn curvature(&self, d: f64, _d_t: f64, _tilt: Tilt) -> Curvature {
        [[2.0 * self.stiffness * d, 0.0, 0.0], [0.0; 3], [0.0; 3]]
    }
}

/// No deformation, no energy: d and d_t are held at 0.
#[derive(Debug, Clone, Copy)]
pub struct Rigid;

impl Tip for Rigid {
    #[inline(always)]
    fn holds_normal(&self) -> bool {
        true
    }

    fn energy(&self, _d: f64, _d_t: f64, _tilt: Tilt) -> f64 {
        0.0
    }

    #[inline(always)]
    fn gradient(&self, _d: f64, _d_t: f64, _tilt: Tilt) -> Gradient {
        Gradient::default()
    }

    fn curvature(&self, _d: f64, _d_t: f64, _tilt: Tilt) -> Curvature {
        [[0.0; 3]; 3]
    }
}

trait MapEntries {
    fn map_entries(self, keep: impl Fn(usize, usize) -> bool) -> Self;
}

impl MapEntries for Curvature {
    /// Entries that are not kept become 0.
    fn map_entries(mut self, keep: impl Fn(usize, usize) -> bool) -> Self {
        for i in 0..3 {
            for j in 0..3 {
                if !keep(i, j) {
                    self[i][j] = 0.0;
                }
            }
        }
        self
    }
}

/// The model that a fingertip names.
pub fn tip(fingertip: &Fingertip) -> Box<dyn Tip> {
    tip_of(fingertip, fingertip.model)
}

/// The tips of a scene.
pub fn tips(scene: &Scene) -> [Box<dyn Tip>; 2] {
    tips_of(scene, scene.fingertip.model)
}

/// The tips of a scene with another model.
pub(crate) fn tips_of(scene: &Scene, model: FingertipModel) -> [Box<dyn Tip>; 2] {
    scene.fingertips().map(|tip| tip_of(tip, model))
}

/// Another model of the same fingertip.
pub fn tip_of(fingertip: &Fingertip, model: FingertipModel) -> Box<dyn Tip> {
    let stiffness = PI * fingertip.youngs_modulus;
    match model {
        FingertipModel::Parallel => Box::new(Parallel { stiffness }),
        FingertipModel::ParallelNormal => Box::new(ParallelNormal { stiffness }),
        FingertipModel::Radial => Box::new(Radial { stiffness }),
        FingertipModel::Rigid => Box::new(Rigid),
        FingertipModel::Tabulated => Box::new(Tabulated::of(fingertip)),
    }
}

/// Exact energy of springs along the radii of a hemisphere of radius `a` (m) that is pressed flat
/// by `d` (m): pi E a^3 (1 - c^2 + 2 c ln c) with c = 1 - d / a (J). [`Radial`] is its first term
/// in d / a.
///
/// ```
/// use palpate::grasp::models::exact_radial_energy;
/// // For a small press the first term is left: pi E d^3 / 3.
/// let (radius, e, d) = (0.01, 30e3, 1e-5);
/// let first = std::f64::consts::PI * e * d * d * d / 3.0;
/// assert!((exact_radial_energy(radius, e, d) / first - 1.0).abs() < 1e-2);
/// ```
pub fn exact_radial_energy(radius: f64, youngs_modulus: f64, d: f64) -> f64 {
    let part = d / radius;
    // 1 - c^2 and ln c without the difference to 1.
    PI * youngs_modulus * radius.powi(3) * (part * (2.0 - part) + 2.0 * (1.0 - part) * (-part).ln_1p())
}

/// Where the closed forms hold: 0 < d < a (1 - |sin tilt|), so that neither the face nor the back
/// plate cuts the rim.
#[inline(always)]
pub fn in_range(radius: f64, d: f64, sin_tilt: f64) -> bool {
    d > 0.0 && d < radius * (1.0 - sin_tilt.abs())
}
