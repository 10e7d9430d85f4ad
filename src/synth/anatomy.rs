//! What each kind of phantom is made of.
//!
//! Positions and radii are fractions of half the field of view, x to the right, y to the front, z
//! up; intensities are those of a T1-weighted image with fat at 1000. The shapes are drawn after
//! anatomy atlases by eye, not measured.

use crate::synth::body::{Body, Region, Superellipsoid, extent};
use crate::synth::params::PhantomKind;
use crate::types::Grid;

/// The body of a kind, sized to the grid's field of view. (Those of known stiffness have a form of
/// their own, see [`crate::synth::elastic`]; here they are blocks.)
pub fn body(kind: PhantomKind, grid: &Grid, seed: u64) -> Body {
    let half = extent(grid).map(|e| e / 2.0);
    let radius = 0.84 * half[0].min(half[1]);
    match kind {
        // The leg grows by a quarter over the field of view, towards the knee.
        PhantomKind::Calf => Body::new(leg([radius; 3]), grid, 0.125 / half[2], 0.02 * radius, seed),
        PhantomKind::Slice => Body::new(leg([radius; 3]), grid, 0.0, 0.02 * radius, seed),
        PhantomKind::Head => Body::new(head(half), grid, 0.0, 0.015 * radius, seed),
        PhantomKind::Block | PhantomKind::Inclusion | PhantomKind::Slab => {
            Body::new(block(half), grid, 0.0, 0.02 * radius, seed)
        }
        PhantomKind::Fingertip => Body::new(fingertip(half), grid, 0.0, 0.004 * radius, seed),
    }
}

/// A region with centre and radii in units of `unit`.
fn region(unit: [f64; 3], centre: [f64; 3], radii: [f64; 3], turn_degrees: f64, mean: f64, texture: f64) -> Region {
    let scaled = |v: [f64; 3]| std::array::from_fn(|a| v[a] * unit[a]);
    let (sin, cos) = turn_degrees.to_radians().sin_cos();
    let shape = Superellipsoid { centre: scaled(centre), radii: scaled(radii), turn: [cos, sin], power: 2 };
    Region { shape, mean, texture }
}

/// Skin, fat, deep fascia, muscles with their fasciae, tibia and fibula with cortex and marrow,
/// vessels.
fn leg(unit: [f64; 3]) -> Vec<Region> {
    let tube = |x: f64, y: f64, a: f64, b: f64, turn: f64, mean: f64, texture: f64| {
        region(unit, [x, y, 0.0], [a, b, f64::INFINITY], turn, mean, texture)
    };
    let mut out = vec![
        tube(0.0, 0.0, 1.0, 1.0, 0.0, 480.0, 0.06),
        tube(0.0, 0.0, 0.965, 0.965, 0.0, 1000.0, 0.07),
        tube(0.0, 0.01, 0.87, 0.86, 0.0, 150.0, 0.0),
        tube(0.0, 0.01, 0.85, 0.84, 0.0, 560.0, 0.15),
    ];
    // x, y, semi-axes, turn, intensity: soleus, gastrocnemius (medial, lateral), tibialis
    // posterior, flexors, tibialis anterior, extensors, peroneus.
    let muscles = [
        (0.02, -0.22, 0.60, 0.24, 4.0, 345.0),
        (-0.36, -0.52, 0.38, 0.22, -28.0, 360.0),
        (0.36, -0.50, 0.36, 0.20, 30.0, 350.0),
        (0.12, 0.14, 0.24, 0.15, 25.0, 330.0),
        (-0.36, 0.10, 0.17, 0.13, 60.0, 340.0),
        (0.16, 0.52, 0.24, 0.20, -30.0, 355.0),
        (0.44, 0.36, 0.13, 0.16, -35.0, 335.0),
        (0.66, 0.04, 0.15, 0.25, 8.0, 365.0),
    ];
    for (x, y, a, b, turn, mean) in muscles {
        out.push(tube(x, y, a, b, turn, 170.0, 0.0));
        out.push(tube(x, y, a - 0.018, b - 0.018, turn, mean, 0.16));
    }
    out.extend([
        tube(-0.22, 0.44, 0.27, 0.20, 40.0, 60.0, 0.0),
        tube(-0.22, 0.44, 0.18, 0.12, 40.0, 920.0, 0.08),
        tube(0.42, 0.08, 0.10, 0.09, 10.0, 60.0, 0.0),
        tube(0.42, 0.08, 0.055, 0.045, 10.0, 880.0, 0.08),
        tube(-0.08, 0.02, 0.04, 0.035, 0.0, 90.0, 0.0),
        tube(0.24, 0.02, 0.035, 0.035, 0.0, 110.0, 0.0),
        tube(0.28, 0.30, 0.03, 0.03, 0.0, 100.0, 0.0),
        tube(-0.72, -0.58, 0.03, 0.03, 0.0, 140.0, 0.0),
    ]);
    out
}

/// Scalp, skull, fluid, cortex, white matter, deep nuclei, ventricles, cerebellum, eyes.
fn head(half: [f64; 3]) -> Vec<Region> {
    let part = |c: [f64; 3], r: [f64; 3], turn: f64, mean: f64, texture: f64| region(half, c, r, turn, mean, texture);
    vec![
        part([0.0, 0.0, 0.0], [0.80, 0.88, 0.86], 0.0, 520.0, 0.1),
        part([0.0, 0.0, 0.0], [0.775, 0.855, 0.835], 0.0, 1000.0, 0.08),
        part([0.0, -0.005, 0.01], [0.73, 0.81, 0.79], 0.0, 80.0, 0.0),
        part([0.0, -0.005, 0.01], [0.68, 0.76, 0.74], 0.0, 220.0, 0.05),
        part([0.0, 0.0, 0.02], [0.655, 0.73, 0.71], 0.0, 520.0, 0.2),
        part([0.0, 0.0, 0.03], [0.56, 0.63, 0.60], 0.0, 760.0, 0.1),
        part([-0.16, 0.06, 0.06], [0.10, 0.20, 0.13], 12.0, 580.0, 0.08),
        part([0.17, 0.05, 0.07], [0.10, 0.19, 0.13], -12.0, 580.0, 0.08),
        part([-0.09, 0.02, 0.20], [0.055, 0.28, 0.08], 8.0, 180.0, 0.0),
        part([0.10, 0.0, 0.20], [0.05, 0.26, 0.08], -8.0, 180.0, 0.0),
        part([0.0, -0.46, -0.40], [0.36, 0.22, 0.20], 0.0, 600.0, 0.22),
        part([-0.30, 0.70, -0.20], [0.12, 0.11, 0.12], 0.0, 260.0, 0.05),
        part([0.31, 0.69, -0.20], [0.12, 0.11, 0.12], 0.0, 260.0, 0.05),
    ]
}

/// A rounded box full of texture, with two inclusions.
fn block(half: [f64; 3]) -> Vec<Region> {
    let mut out = vec![
        region(half, [0.0; 3], [0.84, 0.84, 0.84], 0.0, 620.0, 0.3),
        region(half, [-0.3, 0.15, 0.1], [0.28, 0.24, 0.3], 20.0, 900.0, 0.2),
        region(half, [0.35, -0.25, -0.15], [0.24, 0.3, 0.22], -15.0, 300.0, 0.3),
    ];
    out[0].shape.power = 8;
    out
}

/// A finger along y with its tip to the front and the pulp down: skin, pulp, phalanx with marrow,
/// nail bed.
fn fingertip(half: [f64; 3]) -> Vec<Region> {
    let part = |c: [f64; 3], r: [f64; 3], mean: f64, texture: f64| region(half, c, r, 0.0, mean, texture);
    vec![
        part([0.0, -0.9, 0.0], FINGERTIP_RADII, 450.0, 0.06),
        part([0.0, -0.9, 0.0], [0.75, 1.69, 0.73], 850.0, 0.22),
        part([0.0, -0.9, 0.28], [0.30, 1.35, 0.24], 60.0, 0.0),
        part([0.0, -0.9, 0.28], [0.20, 1.22, 0.14], 700.0, 0.12),
        part([0.0, 0.10, 0.66], [0.42, 0.50, 0.06], 120.0, 0.0),
    ]
}

/// Outline of the fingertip, in half fields of view; the pulp's lowest point lies under its centre.
pub(crate) const FINGERTIP_RADII: [f64; 3] = [0.82, 1.76, 0.80];
