//! Displacements known in closed form at every world position.

use crate::numerics::random::Random;
use crate::synth::body::{centre, extent, rotation};
use crate::synth::noise::{SMOOTH_COEFFICIENTS, SmoothNoise};
use crate::types::space::{Matrix3, cross, dot, length};
use crate::types::{Grid, WorldPoint};
use rayon::prelude::*;

/// The shape of a displacement, before [`Motion`] centres and scales it.
#[derive(Debug, Clone)]
enum Law {
    /// m (p - centre) + shift.
    Linear { m: Matrix3, shift: [f64; 3] },
    /// Coarse plus a share of fine.
    Smooth { coarse: SmoothNoise<4>, fine: SmoothNoise<4> },
    /// A Gaussian of `radius` around the axis through `contact` along `inward`, decaying over
    /// `depth`.
    Press { contact: [f64; 3], inward: [f64; 3], radius: f64, depth: f64 },
    /// A flat plate moving up (+z) by `travel` into a body whose lowest point is `contact` and
    /// whose outline there rises by half `curvature` (a mm) times the squared offset along x and y.
    Plate { contact: [f64; 3], curvature: [f64; 2], travel: f64, depth: f64 },
    /// A displacement along `axis` that goes as the sine of the place along it; `wave` is 2 pi over
    /// the wavelength.
    Wave { axis: [f64; 3], wave: f64 },
    /// Half a jump along `along` on each side of the plane with `normal`, fading over `radius`
    /// across both.
    Slide { normal: [f64; 3], along: [f64; 3], across: [f64; 3], offset: f64, radius: f64, smooth: SmoothNoise<4> },
}

/// A displacement u(p) (mm), initial to deformed.
#[derive(Debug, Clone)]
pub struct Motion {
    law: Law,
    centre: [f64; 3],
    /// Taken off before scaling.
    offset: [f64; 3],
    scale: f64,
    /// Unit normal of a single slice: no motion along it.
    slice_normal: Option<[f64; 3]>,
}

impl Motion {
    fn new(law: Law, grid: &Grid) -> Self {
        let slice_normal = slice_normal(grid);
        Self { law, centre: centre(grid), offset: [0.0; 3], scale: 1.0, slice_normal }
    }

    /// No motion.
    pub fn none(grid: &Grid) -> Self {
        Self::new(Law::Linear { m: [[0.0; 3]; 3], shift: [0.0; 3] }, grid)
    }

    /// `amplitude` mm in a random direction (of the plane, for a single slice).
    pub(crate) fn translate(grid: &Grid, amplitude: f64, mut random: Random) -> Self {
        let mut motion = Self::new(Law::Linear { m: [[0.0; 3]; 3], shift: random.direction() }, grid);
        motion.scale = amplitude / length(motion.planar([0.0; 3])).max(1e-9);
        motion
    }

    /// `degrees` about a random axis through the middle, or about the normal of a single slice.
    pub fn rotate(grid: &Grid, degrees: f64, mut random: Random) -> Self {
        let axis = slice_normal(grid).unwrap_or_else(|| random.direction());
        let (sin, cos) = degrees.to_radians().sin_cos();
        // Rodrigues' formula less the identity: sin K + (1 - cos) K^2.
        let k = [[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]];
        let m = std::array::from_fn(|r| {
            std::array::from_fn(|c| {
                let squared: f64 = (0..3).map(|i| k[r][i] * k[i][c]).sum();
                sin * k[r][c] + (1.0 - cos) * squared
            })
        });
        Self::new(Law::Linear { m, shift: [0.0; 3] }, grid)
    }

    /// A random affine map, to be scaled.
    pub fn affine(grid: &Grid, mut random: Random) -> Self {
        let half = extent(grid).iter().fold(0.0f64, |m, &e| m.max(e)) / 2.0;
        let m = std::array::from_fn(|_| std::array::from_fn(|_| random.normals()[0] / half));
        Self::new(Law::Linear { m, shift: random.direction().map(|v| 0.5 * v) }, grid)
    }

    /// Random cubic B-splines with control points every `spacing` and, at 35 %, every half
    /// `spacing` mm; to be scaled.
    pub fn smooth(grid: &Grid, spacing: f64, seed: u64) -> Self {
        let noise = |stream, h| SmoothNoise::new(Random::new(seed, stream), [h; 3], SMOOTH_COEFFICIENTS);
        Self::new(Law::Smooth { coarse: noise(40, spacing), fine: noise(41, spacing / 2.0) }, grid)
    }

    /// A blunt indenter at the back (-y) of the body that pushes to the front; to be scaled.
    pub fn press(grid: &Grid, mut random: Random) -> Self {
        let (c, e) = (centre(grid), extent(grid));
        let side = 0.1 * random.uniform(-1.0, 1.0);
        let contact = [c[0] + side * e[0], c[1] - 0.42 * e[1], c[2] + 0.1 * random.uniform(-1.0, 1.0) * e[2]];
        let (turn, radius) = (rotation([0.0, 0.0, 0.5 * side]), random.uniform(0.17, 0.22) * e[0].max(e[1]));
        let inward = std::array::from_fn(|a| turn[a][1]);
        Self::new(Law::Press { contact, inward, radius, depth: 0.35 * e[1] }, grid)
    }

    /// A flat plate that flattens the pulp of a fingertip with semi-axes `radii` (mm) about the
    /// point `0.9` half fields of view behind the middle, moving up by `travel` mm.
    pub fn plate(grid: &Grid, radii: [f64; 3], travel: f64) -> Self {
        let (c, e) = (centre(grid), extent(grid));
        let contact = [c[0], c[1] - 0.45 * e[1], c[2] - radii[2]];
        let curvature = [radii[2] / radii[0].powi(2), radii[2] / radii[1].powi(2)];
        Self::new(Law::Plate { contact, curvature, travel, depth: 0.9 * radii[2] }, grid)
    }

    /// A standing wave along a random axis with a largest strain of `percent`: two wavelengths in
    /// the shortest side.
    pub fn wave(grid: &Grid, percent: f64, mut random: Random) -> Self {
        let (sides, shape) = (extent(grid), grid.shape());
        let shortest = (0..3).filter(|&a| shape[a] > 1).map(|a| sides[a]).fold(f64::INFINITY, f64::min);
        let wave = 2.0 * std::f64::consts::TAU / shortest;
        let axis = random.direction();
        let axis = slice_normal(grid).map_or(axis, |n| unit(add(axis, n, -dot(axis, n))));
        let mut motion = Self::new(Law::Wave { axis, wave }, grid);
        motion.scale = percent / 100.0 / wave;
        motion
    }

    /// Two half spaces that glide along a random plane, fading far from the middle; to be scaled.
    pub fn slide(grid: &Grid, seed: u64) -> Self {
        let (mut random, e) = (Random::new(seed, 30), extent(grid));
        let flat = slice_normal(grid);
        let pick = random.direction();
        let normal = unit(match flat {
            Some(n) => cross(n, pick),
            None => [pick[0], pick[1], 0.3 * pick[2]],
        });
        let along = unit(cross(normal, flat.unwrap_or_else(|| random.direction())));
        let law = Law::Slide {
            normal,
            along,
            across: cross(normal, along),
            offset: 0.05 * e[0].min(e[1]) * random.uniform(-1.0, 1.0),
            radius: 0.45 * length(e),
            smooth: SmoothNoise::new(Random::new(seed, 31), [0.25 * e[0].max(e[1]); 3], SMOOTH_COEFFICIENTS),
        };
        Self::new(law, grid)
    }

    /// The same about another centre (mm).
    pub fn about(self, centre: [f64; 3]) -> Self {
        Self { centre, ..self }
    }

    /// Takes the mean over `tissue` off (a smooth law only) and makes `amplitude` mm the largest
    /// displacement there.
    pub fn scaled(mut self, amplitude: f64, tissue: &[WorldPoint]) -> Self {
        let raw: Vec<[f64; 3]> = tissue.par_iter().map(|p| self.planar(p.0)).collect();
        if matches!(self.law, Law::Smooth { .. }) {
            let sums = raw.iter().fold([0.0; 3], |s, &u| add(s, u, 1.0));
            self.offset = sums.map(|s| s / tissue.len().max(1) as f64);
        }
        let largest = raw.iter().map(|&u| length(add(u, self.offset, -1.0))).fold(0.0, f64::max);
        self.scale *= if largest > 0.0 { amplitude / largest } else { 0.0 };
        self
    }

    /// u at a world position (mm).
    pub fn at(&self, p: WorldPoint) -> [f64; 3] {
        let u = self.planar(p.0);
        std::array::from_fn(|a| (u[a] - self.offset[a]) * self.scale)
    }

    /// The x with x + u(x) = y, by fixed point to 1e-9 mm; for motions whose gradient stays under
    /// 1, as a press has.
    pub(crate) fn origin_of(&self, y: WorldPoint) -> WorldPoint {
        let mut x = y;
        for _ in 0..200 {
            let r = y.minus(x.moved(self.at(x)));
            x = x.moved(r);
            if length(r) < 1e-9 {
                break;
            }
        }
        x
    }

    /// Whether neighbouring places may part (a jump, so that difference quotients are not the
    /// Jacobian).
    pub(crate) fn is_discontinuous(&self) -> bool {
        matches!(self.law, Law::Slide { .. })
    }

    fn planar(&self, p: [f64; 3]) -> [f64; 3] {
        let u = self.law.at(p, self.centre);
        match self.slice_normal {
            Some(n) => add(u, n, -dot(u, n)),
            None => u,
        }
    }
}

impl Law {
    fn at(&self, p: [f64; 3], centre: [f64; 3]) -> [f64; 3] {
        match self {
            Law::Linear { m, shift } => {
                let d = add(p, centre, -1.0);
                std::array::from_fn(|r| dot(m[r], d) + shift[r])
            }
            Law::Smooth { coarse, fine } => add(coarse.vector(p), fine.vector(p), 0.35),
            Law::Press { contact, inward, radius, depth } => press(p, *contact, *inward, *radius, *depth),
            Law::Plate { contact, curvature, travel, depth } => {
                let d = add(p, *contact, -1.0);
                let surface = 0.5 * (curvature[0] * d[0] * d[0] + curvature[1] * d[1] * d[1]);
                // A soft max(0, travel - surface): smooth at the contact's rim.
                let soft = 0.1 * travel.max(1e-9);
                let gap = (travel - surface) / soft;
                let push = soft * (gap.max(0.0) + (-gap.abs()).exp().ln_1p());
                let decay = |s: f64| (-0.5 * (s / depth).powi(2)).exp();
                [0.0, 0.0, push * decay(d[2]) / decay(surface.min(*depth))]
            }
            Law::Wave { axis, wave } => axis.map(|v| v * (wave * dot(add(p, centre, -1.0), *axis)).sin()),
            Law::Slide { normal, along, across, offset, radius, smooth } => {
                let d = add(p, centre, -1.0);
                let side = if dot(d, *normal) > *offset { 0.5 } else { -0.5 };
                let jump = side * (-(dot(d, *across) / radius).powi(2)).exp();
                add(along.map(|v| v * jump), smooth.vector(p), 0.08)
            }
        }
    }
}

/// The unit normal of a single-slice grid, `None` for any other.
fn slice_normal(grid: &Grid) -> Option<[f64; 3]> {
    let axis = grid.shape().iter().position(|&n| n == 1)?;
    let linear = grid.affine().linear();
    let edge = |a: usize| [linear[0][a % 3], linear[1][a % 3], linear[2][a % 3]];
    Some(unit(cross(edge(axis + 1), edge(axis + 2))))
}

/// A push of 1 at `contact` along the unit vector `inward`: a Gaussian of `radius` across it and
/// `depth` along it (mm), with a bulge around.
pub(super) fn press(p: [f64; 3], contact: [f64; 3], inward: [f64; 3], radius: f64, depth: f64) -> [f64; 3] {
    let d = add(p, contact, -1.0);
    let inside = dot(d, inward);
    let lateral = add(d, inward, -inside);
    let push = (-(dot(lateral, lateral) / (radius * radius) + (inside / depth).powi(2)) / 2.0).exp();
    add(inward.map(|v| v * push), lateral, 0.25 * push / radius)
}

pub(super) fn add(a: [f64; 3], b: [f64; 3], factor: f64) -> [f64; 3] {
    std::array::from_fn(|i| a[i] + factor * b[i])
}

fn unit(v: [f64; 3]) -> [f64; 3] {
    v.map(|c| c / length(v).max(1e-12))
}
