//! How much a soft contact holds: Coulomb's law along the face, and less of it where the contact
//! also has to keep the object from spinning about the face's normal.
//!
//! Sources: R. D. Howe and M. R. Cutkosky, "Practical Force-Motion Models for Sliding
//! Manipulation", Int. J. Robotics Res. 15(6), 1996, whose limit surface is the ellipsoid
//! `(f_t / (mu f_n))^2 + (m / (mu f_n r))^2 = 1`; r is the torsion that a pressure carries over its
//! sum. Springs under a sphere press as 1 - (rho / c)^2 over a contact of radius c, so that
//! r = 8 c / 15. In the plane nothing spins: the moment comes from a centre of mass that lies
//! beside the fingers' plane.

use crate::types::{FingertipModel, Scene};

/// Lever of the torsion of a parabolic pressure over the contact's radius (1): int (1 - s^2) s^2 ds
/// / int (1 - s^2) s ds over 0 to 1.
const TORSION_LEVER: f64 = 8.0 / 15.0;
/// Normal force below which a contact carries nothing (N), far under the rounding of a force.
const MIN_NORMAL_FORCE_N: f64 = 1e-9;

/// Friction of both tips on the object.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Friction {
    /// Coefficient mu; infinite where none is given.
    pub coefficient: f64,
    /// Moment of the weight about the face's normal (N m): m g times the distance of the centre of
    /// mass from the fingers' plane. The face's tilt, which takes up to 1 - cos of it, is left out.
    pub moment: f64,
    /// Radii of the tips (m).
    radius: [f64; 2],
    /// Whether the tips have a law for sliding: a spring along the face.
    pub slides: bool,
}

impl Friction {
    /// Of a scene.
    pub fn of(scene: &Scene) -> Self {
        let model = scene.fingertip.model;
        Self {
            coefficient: scene.object.friction.unwrap_or(f64::INFINITY),
            moment: (scene.object.mass * scene.gravity * scene.object.offset).abs(),
            radius: scene.fingertips().map(|tip| tip.radius),
            slides: matches!(model, FingertipModel::Parallel | FingertipModel::Tabulated),
        }
    }

    /// What the spin takes of the coefficient, the same for both tips (1): they share the moment as
    /// they can carry it.
    fn spin(&self, f: &[f64; 4], d: &[f64; 4]) -> f64 {
        if self.moment == 0.0 {
            return 0.0;
        }
        let lever = |i: usize| {
            let d = d[i].clamp(0.0, self.radius[i]);
            TORSION_LEVER * (d * (2.0 * self.radius[i] - d)).sqrt()
        };
        self.moment
            / (0..2)
                .map(|i| f[i].max(MIN_NORMAL_FORCE_N) * lever(i))
                .sum::<f64>()
                .max(MIN_NORMAL_FORCE_N * MIN_NORMAL_FORCE_N)
    }

    /// The coefficient that is left along the face, under the contact forces `f` (N) at the
    /// displacements `d` (m).
    #[inline(always)]
    pub fn along(&self, f: &[f64; 4], d: &[f64; 4]) -> f64 {
        if self.moment == 0.0 {
            return self.coefficient;
        }
        let spin = self.spin(f, d);
        (self.coefficient * self.coefficient - spin * spin).max(0.0).sqrt()
    }

    /// The largest force along the face that tip `i` holds (N), from the coefficient that is left.
    #[inline(always)]
    pub fn limit(along: f64, f: &[f64; 4], i: usize) -> f64 {
        along * f[i].max(0.0)
    }

    /// The least coefficient that keeps both tips from sliding (1).
    pub fn required(&self, f: &[f64; 4], d: &[f64; 4]) -> f64 {
        let spin = self.spin(f, d);
        (0..2).map(|i| (f[2 + i] / f[i].max(MIN_NORMAL_FORCE_N)).hypot(spin)).fold(0.0, f64::max)
    }
}
