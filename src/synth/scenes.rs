//! Scenes: bodies that move as a limb, an organ or a joint does.
//!
//! A ring and a joint are bodies of their own, with shapes sized to half the shorter side of the
//! field of view across z (or the slice). Displacements are in closed form; nothing overlaps and
//! nothing parts. Fails when a motion folds or is larger than its organ.

use crate::error::{ParamError, SynthError};
use crate::numerics::random::Random;
use crate::synth::anatomy::body;
use crate::synth::appearance::{PATTERN_CONTRAST, distance};
use crate::synth::body::{BORDER_WIDTH_VOXELS, centre, cover, extent, rotation};
use crate::synth::motion::{Motion, add};
use crate::synth::noise::Texture;
use crate::synth::params::{MotionKind, PhantomParams};
use crate::synth::phantom::{Phantom, motion, staged};
use crate::types::space::{Matrix3, dot, length};
use crate::types::{Grid, WorldPoint};
use std::f64::consts::PI;

/// A limb of muscle in a still ring.
struct Limb {
    /// Radius of the limb (half sides of the field of view).
    radius: f64,
    /// Radius of the muscle (half sides).
    muscle_radius: f64,
    /// Width over which the muscle's motion fades to rest at its ring (muscle radii).
    muscle_fade: f64,
}

const LIMB: Limb = Limb { radius: 0.84, muscle_radius: 0.65, muscle_fade: 0.6 };

/// An organ with a wall.
struct Organ {
    /// Radius (half sides).
    radius: f64,
    /// Brightness over what lies around it (1).
    gain: f64,
    /// What the wall subtracts from the brightness (1).
    wall_darkening: f64,
}

const ORGAN_SHAPE: Organ = Organ { radius: 0.45, gain: 1.3, wall_darkening: 0.5 };

/// Mean intensities of tissue (fat is at 1000).
struct Intensity {
    /// Of muscle.
    muscle: f64,
    /// Of a bone's cortex.
    cortex: f64,
    /// Of its marrow.
    marrow: f64,
}

const INTENSITY: Intensity = Intensity { muscle: 350.0, cortex: 60.0, marrow: 900.0 };

/// A jointed limb; lengths in half sides of the field of view.
struct Joint {
    /// Radius of the limb.
    limb_radius: f64,
    /// Distance of the joint's axis from the middle.
    axis_offset: f64,
    /// Radius of the bones.
    bone_radius: f64,
    /// Radius of the bone's round end.
    end_radius: f64,
    /// Gap of the joint.
    gap: f64,
    /// Thickness of the cortex.
    cortex: f64,
    /// Half the length of the round end along the joint's axis.
    end_half_length: f64,
}

const JOINT: Joint = Joint {
    limb_radius: 0.55,
    axis_offset: 0.25,
    bone_radius: 0.1,
    end_radius: 0.18,
    gap: 0.16,
    cortex: 0.05,
    end_half_length: 0.3,
};

/// 0 up to 0 and 1 from 1 on, twice continuously differentiable.
fn step(t: f64) -> f64 {
    let t = t.clamp(0.0, 1.0);
    t * t * t * (10.0 + t * (6.0 * t - 15.0))
}

/// The axis of a single slice, or z; and half the shorter side across it (mm).
fn plane(grid: &Grid) -> (usize, f64) {
    let normal = grid.shape().iter().position(|&n| n == 1).unwrap_or(2);
    let sides = extent(grid);
    let shorter = (0..3).filter(|&a| a != normal).map(|a| sides[a]).fold(f64::INFINITY, f64::min);
    (normal, shorter / 2.0)
}

/// A muscle that moves by at most the amplitude of `base`, fading to rest at a still ring of the
/// same tissue that is `ratio` times as bright.
pub(super) fn still_ring(base: &PhantomParams, ratio: f64) -> Result<Phantom, SynthError> {
    let grid = base.grid()?;
    let (along, half) = plane(&grid);
    let (middle, muscle, edge) = (centre(&grid), LIMB.muscle_radius * half, BORDER_WIDTH_VOXELS * grid.least_spacing());
    let from_axis = move |p: WorldPoint| {
        let squares = (0..3).filter(|&a| a != along).map(|a| (p.0[a] - middle[a]).powi(2));
        squares.sum::<f64>().sqrt()
    };
    let texture = Texture::new(&grid, base.seed);
    let look = |p: WorldPoint| {
        let radius = from_axis(p);
        let gain = ratio + (1.0 - ratio) * cover(muscle - radius, edge);
        let shown = INTENSITY.muscle * (1.0 + PATTERN_CONTRAST * texture.at(p)).max(0.0);
        (gain * shown * cover(LIMB.radius * half - radius, edge), radius < LIMB.radius * half)
    };
    let places: Vec<WorldPoint> = (0..grid.len())
        .map(|at| grid.voxel(at))
        .map(|[i, j, k]| grid.world(i, j, k))
        .filter(|&p| from_axis(p) < muscle)
        .collect();
    let smooth = Motion::smooth(&grid, 2.0 * muscle, base.seed).scaled(1.0, &places);
    let faded = move |x: WorldPoint| {
        let share = step((muscle - from_axis(x)) / (LIMB.muscle_fade * muscle));
        smooth.at(x).map(|u| share * u)
    };
    let largest = places.iter().map(|&x| length(faded(x))).fold(1e-12, f64::max);
    let amplitude = if base.motion == MotionKind::None { 0.0 } else { base.amplitude };
    // The noise is measured by the ring, which is the brightest; it stays that of the muscle.
    let noise = base.noise / ratio;
    let params = PhantomParams { motion: MotionKind::Smooth, amplitude, noise, ..base.clone() };
    staged(&params, grid, &look, move |x| faded(x).map(|u| u * amplitude / largest), false)
}

/// The body of `base`, moved as it is, with a ball inside that turns about its centre by up to `mm`
/// at its wall.
pub(super) fn organ(base: &PhantomParams, mm: f64) -> Result<Phantom, SynthError> {
    let grid = base.grid()?;
    if base.motion == MotionKind::Elastic {
        return Err(SynthError::NotElastic);
    }
    let (_, half) = plane(&grid);
    let radius = ORGAN_SHAPE.radius * half;
    if mm > 2.0 * radius {
        return Err(ParamError { name: "severity", value: mm, range: "up to the organ's diameter" }.into());
    }
    let body = body(base.kind, &grid, base.seed);
    let (carried, _, _) = motion(base, &|p| body.contains(p), grid)?;
    let angle = 2.0 * (0.5 * mm / radius).asin();
    let middle = centre(&grid);
    let turn = Motion::rotate(&grid, angle.to_degrees(), Random::new(base.seed, 82)).about(middle);
    let spacing = grid.spacing();
    let depth = move |p: WorldPoint| radius - distance(p, WorldPoint(middle));
    let look = |p: WorldPoint| {
        let (v, inside) = body.sample(p);
        let across = p.minus(WorldPoint(middle));
        let voxel = length(std::array::from_fn(|a| spacing[a] * across[a])) / length(across).max(1e-9);
        let depth = depth(p);
        let wall = ORGAN_SHAPE.wall_darkening * (-(depth / voxel).powi(2)).exp();
        (v * (1.0 + (ORGAN_SHAPE.gain - 1.0) * cover(depth, BORDER_WIDTH_VOXELS * voxel)) * (1.0 - wall), inside)
    };
    let moved = move |x: WorldPoint| {
        let u = carried.at(x);
        let y = x.moved(u);
        if depth(y) > 0.0 { add(u, turn.at(y), 1.0) } else { u }
    };
    staged(base, grid, &look, moved, true)
}

/// A limb with two bones; the second turns by `degrees` about the first one's round end, and the
/// tissue between goes along by a part of the angle.
pub(super) fn joint(base: &PhantomParams, degrees: f64) -> Result<Phantom, SynthError> {
    let grid = base.grid()?;
    let hinge = Hinge::new(&grid, degrees.to_radians(), base.seed);
    let texture = Texture::new(&grid, base.seed);
    let edge = BORDER_WIDTH_VOXELS * grid.least_spacing();
    let look = |y: WorldPoint| {
        let q = hinge.own(y);
        let q = hinge.turned(q, hinge.angle_before(q));
        let (bone, skin) = (hinge.depth(q), JOINT.limb_radius * hinge.half - q[0].hypot(q[2]));
        let grain = PATTERN_CONTRAST * texture.at(hinge.world(q));
        let soft = INTENSITY.muscle * (1.0 + grain).max(0.0) * cover(skin, edge);
        let marrow = cover(bone - JOINT.cortex * hinge.half, edge);
        let inner = INTENSITY.cortex + marrow * (INTENSITY.marrow * (1.0 + grain / 3.0).max(0.0) - INTENSITY.cortex);
        (soft + cover(bone, edge) * (inner - soft), skin > 0.0)
    };
    let moved = move |x: WorldPoint| {
        let q = hinge.own(x);
        let there = hinge.turned(q, hinge.angle_after(q));
        hinge.vector(add(there, q, -1.0))
    };
    let params = PhantomParams { motion: MotionKind::Rotate, amplitude: degrees, ..base.clone() };
    staged(&params, grid, &look, moved, false)
}

/// A joint with its own frame: bone 1 along +y, bone 2 along -y, turning towards +x about z.
///
/// A place keeps its distance from the axis and its height, and turns about the axis by a share of
/// the angle. The Jacobian determinant is 1 plus the turn's derivative by the place's own angle.
#[derive(Debug, Clone, Copy)]
struct Hinge {
    /// Rows: the frame's axes in the world.
    frame: Matrix3,
    /// A place on the axis (mm).
    centre: [f64; 3],
    /// Half the shorter side of the field of view (mm).
    half: f64,
    /// Angle by which bone 2 turns (radians).
    angle: f64,
}

impl Hinge {
    fn new(grid: &Grid, angle: f64, seed: u64) -> Self {
        let (normal, half) = plane(grid);
        let mut random = Random::new(seed, 82);
        // No lattice is aligned with it; in a single slice the axis stays the normal.
        let tilt = std::array::from_fn(|a| {
            let degrees: f64 = random.uniform(-5.0, 5.0);
            if grid.is_single_slice() && a != normal { 0.0 } else { degrees.to_radians() }
        });
        let axes = rotation(tilt);
        let frame = [axes[(normal + 1) % 3], axes[(normal + 2) % 3], axes[normal]];
        Self { frame, centre: add(centre(grid), frame[0], -JOINT.axis_offset * half), half, angle }
    }

    fn own(&self, p: WorldPoint) -> [f64; 3] {
        let d = add(p.0, self.centre, -1.0);
        self.frame.map(|axis| dot(axis, d))
    }

    fn vector(&self, q: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|w| (0..3).map(|r| self.frame[r][w] * q[r]).sum())
    }

    fn world(&self, q: [f64; 3]) -> WorldPoint {
        WorldPoint(add(self.vector(q), self.centre, 1.0))
    }

    /// The same distance from the axis at another angle (radians from bone 2).
    fn turned(&self, q: [f64; 3], angle: f64) -> [f64; 3] {
        let radius = q[0].hypot(q[1]);
        [radius * angle.sin(), -radius * angle.cos(), q[2]]
    }

    /// Share of the turn (1) at a distance from the axis (mm) and an angle from bone 2 (radians).
    fn share(&self, radius: f64, angle: f64) -> f64 {
        // Wedges that hold the bones, seen from the axis.
        let (still, turning) = (
            (JOINT.bone_radius / JOINT.end_radius).asin(),
            (JOINT.bone_radius / (JOINT.end_radius + JOINT.gap)).asin(),
        );
        let between = (PI - still - angle.abs()) / (PI - still - turning);
        step((radius / self.half - JOINT.end_radius) / JOINT.gap) * step(between)
    }

    /// Angle (radians) of a place of the initial volume once it has moved.
    fn angle_after(&self, q: [f64; 3]) -> f64 {
        let angle = q[0].atan2(-q[1]);
        angle + self.angle * self.share(q[0].hypot(q[1]), angle)
    }

    /// Angle (radians) from which a place of the deformed volume has come, by bisection.
    fn angle_before(&self, q: [f64; 3]) -> f64 {
        let (radius, angle) = (q[0].hypot(q[1]), q[0].atan2(-q[1]));
        let (mut low, mut high) = (angle - self.angle, angle);
        while high - low > 1e-13 {
            let middle = 0.5 * (low + high);
            if middle + self.angle * self.share(radius, middle) > angle { high = middle } else { low = middle }
        }
        high
    }

    /// Depth (mm) in the nearer bone of a place in the unbent limb.
    fn depth(&self, q: [f64; 3]) -> f64 {
        let radius = q[0].hypot(q[1]);
        let shaft = JOINT.bone_radius * self.half - q[0].hypot(q[2]);
        let end = (JOINT.end_radius * self.half - radius).min(JOINT.end_half_length * self.half - q[2].abs());
        let first = shaft.min(q[1]).max(end);
        let second = shaft.min(-q[1]).min(radius - (JOINT.end_radius + JOINT.gap) * self.half);
        first.max(second)
    }
}
