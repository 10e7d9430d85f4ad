//! A body as an intensity that is defined at every world position.
//!
//! Regions are painted one over the other. Each is a tapered superellipsoid with an edge two voxels
//! wide (10 to 90 %), a mean intensity, and a share of one fine texture that runs through the whole
//! body. The outlines are bent by a coarse smooth displacement, so that nothing is symmetric.
//! Texture cells are at least two voxels along each axis: the function can be sampled and
//! interpolated without much aliasing.

use crate::numerics::random::Random;
use crate::synth::noise::{SMOOTH_COEFFICIENTS, SmoothNoise, Texture};
use crate::types::space::Matrix3;
use crate::types::{Grid, WorldPoint};

/// (|x/a|^n + |y/b|^n + |z/c|^n)^(1/n) <= 1 in its own axes. A radius may be infinite: a tube.
#[derive(Debug, Clone)]
pub(crate) struct Superellipsoid {
    /// Centre (mm, in the body's frame).
    pub centre: [f64; 3],
    /// Semi-axes (mm).
    pub radii: [f64; 3],
    /// Cosine and sine of the turn about the third axis.
    pub turn: [f64; 2],
    /// The exponent n: 2 is an ellipsoid, 8 nearly a box.
    pub power: i32,
}

/// Width of a border (logistic, voxels): it rises from 10 to 90 % in two.
pub(super) const BORDER_WIDTH_VOXELS: f64 = 0.45;

/// 1 well inside a surface, 0 well outside, from the depth under it and the border's width (one
/// unit).
pub(super) fn cover(depth: f64, edge: f64) -> f64 {
    1.0 / (1.0 + (-depth / edge).exp())
}

/// A region and what it looks like.
#[derive(Debug, Clone)]
pub struct Region {
    /// Its outline.
    pub shape: Superellipsoid,
    /// Mean intensity.
    pub mean: f64,
    /// Standard deviation of its texture, relative to the mean (1).
    pub texture: f64,
}

/// A whole body.
#[derive(Debug, Clone)]
pub struct Body {
    /// Painted in this order; the first one is the body's outline.
    regions: Vec<Region>,
    /// Rotation (rows) and centre (mm) of the body's frame in the world.
    rotation: Matrix3,
    centre: [f64; 3],
    /// Voxel edges as rows of the transposed linear part: how far (mm) the world axes run in one
    /// voxel step.
    edges: Matrix3,
    /// Longest voxel edge, in space and seen along z (mm).
    edge: f64,
    edge_in_plane: f64,
    texture: Texture,
    bend: SmoothNoise<4>,
    bend_mm: f64,
    taper: f64,
}

impl Body {
    /// The body of `regions` in the middle of `grid`, turned by up to 3 degrees and shifted by 0.3
    /// to 0.7 mm or voxels, whichever is less, so that no lattice is symmetric to it.
    ///
    /// `taper` is the relative growth of all radii and offsets across the axis a mm upwards;
    /// `bend_mm` the standard deviation of the outlines' bending.
    pub fn new(regions: Vec<Region>, grid: &Grid, taper: f64, bend_mm: f64, seed: u64) -> Self {
        let mut random = Random::new(seed, 1);
        let angles: [f64; 3] = std::array::from_fn(|_| random.uniform(-3.0, 3.0).to_radians());
        let small = grid.spacing().iter().fold(1.0, |m: f64, &s| m.min(s));
        let middle = centre(grid);
        let shifted = std::array::from_fn(|a| middle[a] + small * random.uniform(0.3, 0.7));
        let linear = grid.affine().linear();
        let extent = extent(grid);
        let longest = |axes: usize| {
            let squares = |a: usize| (0..axes).map(|w| linear[w][a] * linear[w][a]).sum::<f64>();
            (0..3).map(squares).fold(0.0, f64::max).sqrt()
        };
        Self {
            edge: longest(3),
            edge_in_plane: longest(2),
            regions,
            rotation: rotation(angles),
            centre: shifted,
            edges: std::array::from_fn(|a| std::array::from_fn(|w| linear[w][a])),
            texture: Texture::new(grid, seed),
            bend: SmoothNoise::new(Random::new(seed, 20), [extent[0].max(extent[1]) / 4.0; 3], SMOOTH_COEFFICIENTS),
            bend_mm,
            taper,
        }
    }

    /// Intensity at a world position, and whether it lies in the body's outline.
    pub fn sample(&self, p: WorldPoint) -> (f64, bool) {
        let q = self.own_frame(p);
        let outline = self.outline(q);
        if outline == 0.0 {
            return (0.0, false);
        }
        let texture = self.texture.at(p);
        let painted = self.regions.iter().fold(0.0, |below, region| {
            let cover = self.cover(&region.shape, q);
            below + cover * (region.mean * (1.0 + region.texture * texture) - below)
        });
        (painted.max(0.0), outline > 0.5)
    }

    /// Whether a world position lies in the body's outline.
    pub fn contains(&self, p: WorldPoint) -> bool {
        self.share(p) > 0.5
    }

    /// How much of a voxel at a world position the body fills, 0 to 1.
    pub fn share(&self, p: WorldPoint) -> f64 {
        self.outline(self.own_frame(p))
    }

    /// The region that shows at a world position, counted from 1; 0 outside the body.
    pub fn region(&self, p: WorldPoint) -> u8 {
        let q = self.own_frame(p);
        if self.outline(q) <= 0.5 {
            return 0;
        }
        self.regions.iter().rposition(|r| self.cover(&r.shape, q) > 0.5).map_or(0, |at| at as u8 + 1)
    }

    fn outline(&self, q: [f64; 3]) -> f64 {
        self.regions.first().map_or(0.0, |r| self.cover(&r.shape, q))
    }

    /// World position to the body's frame: turned, bent, with the taper undone.
    fn own_frame(&self, p: WorldPoint) -> [f64; 3] {
        let bend = self.bend.vector(p.0);
        let d: [f64; 3] = std::array::from_fn(|a| p.0[a] - self.centre[a] + self.bend_mm * bend[a]);
        let q: [f64; 3] = std::array::from_fn(|r| (0..3).map(|c| self.rotation[r][c] * d[c]).sum());
        let scale = (1.0 + self.taper * q[2]).max(0.2);
        [q[0] / scale, q[1] / scale, q[2]]
    }

    /// How much of a voxel at `q` (body frame) the shape fills, 0 to 1; exactly 0 far outside.
    fn cover(&self, shape: &Superellipsoid, q: [f64; 3]) -> f64 {
        /// Beyond this number of voxels outside, the logistic is under 1e-9.
        const CUTOFF_VOXELS: f64 = 9.5;
        let d: [f64; 3] = std::array::from_fn(|a| q[a] - shape.centre[a]);
        // The voxel's extent in the plane is all that counts for a tube.
        let reach = shape.radii[0].max(shape.radii[1])
            + CUTOFF_VOXELS * if shape.radii[2].is_finite() { self.edge } else { self.edge_in_plane };
        if d[0] * d[0] + d[1] * d[1] > reach * reach {
            return 0.0;
        }
        let (value, gradient) = shape.level(d);
        // Rate of change a voxel step; the body's turn of a few degrees is left out, as it hardly
        // changes the width.
        let rate = self.edges.iter().map(|e| (0..3).map(|w| e[w] * gradient[w]).sum::<f64>().powi(2)).sum::<f64>();
        let voxels = (1.0 - value) / rate.sqrt().max(1e-12);
        if voxels < -CUTOFF_VOXELS { 0.0 } else { cover(voxels, BORDER_WIDTH_VOXELS) }
    }
}

impl Superellipsoid {
    /// The level function (1 on the outline, less inside) and its gradient (a mm) at `d` mm from
    /// the centre.
    fn level(&self, d: [f64; 3]) -> (f64, [f64; 3]) {
        let [cos, sin] = self.turn;
        let own = [cos * d[0] + sin * d[1], cos * d[1] - sin * d[0], d[2]];
        let s: [f64; 3] = std::array::from_fn(|a| own[a] / self.radii[a]);
        let (level, shares) = if self.power == 2 {
            let level = (s[0] * s[0] + s[1] * s[1] + s[2] * s[2]).sqrt().max(1e-6);
            (level, s.map(|v| v / level))
        } else {
            let sum: f64 = s.iter().map(|v| v.abs().powi(self.power)).sum();
            let level = sum.powf(1.0 / f64::from(self.power)).max(1e-6);
            (level, s.map(|v| v.signum() * (v.abs() / level).powi(self.power - 1)))
        };
        let slope: [f64; 3] = std::array::from_fn(|a| shares[a] / self.radii[a]);
        (level, [cos * slope[0] - sin * slope[1], sin * slope[0] + cos * slope[1], slope[2]])
    }
}

/// The middle of a grid (mm).
pub fn centre(grid: &Grid) -> [f64; 3] {
    grid.affine().to_world(crate::types::VoxelPoint(grid.shape().map(|n| (n - 1) as f64 / 2.0))).0
}

/// Sides (mm) of the axis-aligned box around a grid's voxels.
pub fn extent(grid: &Grid) -> [f64; 3] {
    let (linear, shape) = (grid.affine().linear(), grid.shape());
    std::array::from_fn(|w| (0..3).map(|a| linear[w][a].abs() * shape[a] as f64).sum())
}

/// Rotation about x, then y, then z (radians).
pub fn rotation([x, y, z]: [f64; 3]) -> Matrix3 {
    let ((sx, cx), (sy, cy), (sz, cz)) = (x.sin_cos(), y.sin_cos(), z.sin_cos());
    [
        [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx],
        [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx],
        [-sy, cy * sx, cy * cx],
    ]
}
