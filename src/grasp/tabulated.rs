//! A fingertip whose springs are not alike: the parallel distributed model with a modulus that
//! changes from the pad's centre outwards.
//!
//! Springs stand on the hemisphere as in the closed form (stiffness E dS / L = E a dOmega), with E
//! a function of where the spring ends: of the depth a (1 - cos angle) at which a face that comes
//! straight on reaches it. The energy keeps its form,
//! `U = pi (eA d^3 / (3 cos^2) + eB d^2 d_t tan + eC d d_t^2)`, where eA, eB and eC are means of E
//! over the part that the face cuts off, weighted by the square, the first power and the zeroth
//! power of how far a spring is pressed. These means are smooth in depth and tilt and tabulated;
//! with one E they are E, and the closed form comes back.

use crate::grasp::models::{Curvature, Gradient, Tilt, Tip};
use crate::numerics::surface::{Jet, Surface};
use crate::types::Fingertip;
use std::f64::consts::PI;

/// Entries of the table along depth and tilt.
const TABLE_SIZE: [usize; 2] = [25, 17];
/// Largest tilt in the table (rad).
const MAX_TILT_RAD: f64 = 1.4;
/// Quadrature nodes along the cap's height and around it.
const QUADRATURE_NODES: [usize; 2] = [16, 16];

/// The tables of a fingertip.
#[derive(Debug, Clone)]
pub struct Tabulated {
    /// Means of E (Pa) weighted by the square, the first and the zeroth power of the springs'
    /// shortening.
    means: [Surface; 3],
}

impl Tabulated {
    /// From `modulus` (Pa) of the springs by the depth (m, 0 to `radius`) at which a face that
    /// comes straight on reaches them.
    pub fn new(radius: f64, modulus: impl Fn(f64) -> f64) -> Self {
        let step = [radius / (TABLE_SIZE[0] - 1) as f64, MAX_TILT_RAD / (TABLE_SIZE[1] - 1) as f64];
        let at = |i: usize| {
            weighted_means(radius, &modulus, (i % TABLE_SIZE[0]) as f64 * step[0], (i / TABLE_SIZE[0]) as f64 * step[1])
        };
        let all: Vec<[f64; 3]> = (0..TABLE_SIZE[0] * TABLE_SIZE[1]).map(at).collect();
        let index = |v: f64, a: usize| (v / step[a]).round() as usize;
        let surface = |k: usize| {
            Surface::new([radius, MAX_TILT_RAD], TABLE_SIZE, |d, tilt| {
                all[index(d, 0) + TABLE_SIZE[0] * index(tilt, 1)][k]
            })
        };
        Self { means: [surface(0), surface(1), surface(2)] }
    }

    /// The tables of a fingertip's profile.
    pub fn of(fingertip: &Fingertip) -> Self {
        Self::new(fingertip.radius, |depth| fingertip.modulus_at(depth))
    }

    fn jets(&self, d: f64, tilt: Tilt) -> ([Jet; 3], f64, f64) {
        let angle = tilt.sin.atan2(tilt.cos);
        let secant = 1.0 / tilt.cos;
        ([0, 1, 2].map(|k| self.means[k].at(d, angle)), secant * secant, tilt.sin * secant)
    }
}

/// The means of E over the cap that a face at `tilt`, pressed in by `d`, cuts off a hemisphere,
/// weighted by the square, the first and the zeroth power of the springs' shortening.
fn weighted_means(radius: f64, modulus: &impl Fn(f64) -> f64, d: f64, tilt: f64) -> [f64; 3] {
    let part = (d / radius).max(1e-6);
    let (sin, cos) = tilt.sin_cos();
    let (mut sum, mut total) = ([0.0; 3], [0.0; 3]);
    for i in 0..QUADRATURE_NODES[0] {
        // Midpoints in the root of the height resolve the middle of the cap, where the face first
        // touches.
        let root = (i as f64 + 0.5) / QUADRATURE_NODES[0] as f64;
        let height = part * (1.0 - root * root);
        let c: f64 = 1.0 - part + height;
        let s = (1.0 - c * c).max(0.0).sqrt();
        let turn = |k: usize| PI * (k as f64 + 0.5) / QUADRATURE_NODES[1] as f64;
        let around = |k| modulus(radius * (1.0 - (c * cos + s * sin * f64::cos(turn(k))).clamp(0.0, 1.0)));
        let mean = (0..QUADRATURE_NODES[1]).map(around).sum::<f64>() / QUADRATURE_NODES[1] as f64;
        for (k, power) in [2, 1, 0].into_iter().enumerate() {
            let weight = root * height.powi(power);
            sum[k] += weight * mean;
            total[k] += weight;
        }
    }
    std::array::from_fn(|k| sum[k] / total[k])
}

impl Tip for Tabulated {
    fn holds_tangent(&self) -> bool {
        false
    }

    fn energy(&self, d: f64, d_t: f64, tilt: Tilt) -> f64 {
        let ([a, b, c], square, tan) = self.jets(d, tilt);
        PI * d * (a.value * d * d * square / 3.0 + d_t * (b.value * d * tan + c.value * d_t))
    }

    fn gradient(&self, d: f64, d_t: f64, tilt: Tilt) -> Gradient {
        let ([a, b, c], square, tan) = self.jets(d, tilt);
        let (dd, ddd) = (d * d, d * d * d);
        let normal = (a.slope[0] * ddd + 3.0 * a.value * dd) * square / 3.0
            + (b.slope[0] * dd + 2.0 * b.value * d) * tan * d_t
            + (c.slope[0] * d + c.value) * d_t * d_t;
        let moment = ddd / 3.0 * square * (a.slope[1] + 2.0 * a.value * tan)
            + dd * d_t * (b.slope[1] * tan + b.value * square)
            + d * d_t * d_t * c.slope[1];
        let tangential = b.value * dd * tan + 2.0 * c.value * d * d_t;
        Gradient { normal: PI * normal, tangential: PI * tangential, moment: PI * moment }
    }

    fn curvature(&self, d: f64, d_t: f64, tilt: Tilt) -> Curvature {
        let ([a, b, c], square, tan) = self.jets(d, tilt);
        let (dd, ddd) = (d * d, d * d * d);
        let normal = (a.bend[0] * ddd + 6.0 * a.slope[0] * dd + 6.0 * a.value * d) * square / 3.0
            + (b.bend[0] * dd + 4.0 * b.slope[0] * d + 2.0 * b.value) * tan * d_t
            + (c.bend[0] * d + 2.0 * c.slope[0]) * d_t * d_t;
        let shear = (b.slope[0] * dd + 2.0 * b.value * d) * tan + 2.0 * (c.slope[0] * d + c.value) * d_t;
        let turn = (a.bend[1] * ddd + 3.0 * a.slope[1] * dd) * square / 3.0
            + (a.slope[0] * ddd + 3.0 * a.value * dd) * 2.0 * square * tan / 3.0
            + d_t * ((b.bend[1] * dd + 2.0 * b.slope[1] * d) * tan + (b.slope[0] * dd + 2.0 * b.value * d) * square)
            + (c.bend[1] * d + c.slope[1]) * d_t * d_t;
        let drag = 2.0 * c.value * d;
        let shear_turn = dd * (b.slope[1] * tan + b.value * square) + 2.0 * c.slope[1] * d * d_t;
        let moment =
            ddd / 3.0 * square * (a.bend[2] + 4.0 * a.slope[1] * tan + 2.0 * a.value * (square + 2.0 * tan * tan))
                + dd * d_t * (b.bend[2] * tan + 2.0 * b.slope[1] * square + 2.0 * b.value * square * tan)
                + d * d_t * d_t * c.bend[2];
        [[normal, shear, turn], [shear, drag, shear_turn], [turn, shear_turn, moment]].map(|row| row.map(|v| PI * v))
    }
}
