//! The bodies that are pressed: what they are made of, where, and how they look.

use crate::numerics::random::Random;
use crate::synth::body::{BORDER_WIDTH_VOXELS, centre, cover, extent};
use crate::synth::elastic::blocks::{Ball, block_with_balls, dome, layered_block};
use crate::synth::elastic::hexahedra::{CURVED, HexMesh, Surfaces};
use crate::synth::noise::Texture;
use crate::synth::params::{PhantomKind, PhantomParams};
use crate::types::space::length;
use crate::types::{Grid, WorldPoint};
use serde::Serialize;

/// A tissue region.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Region {
    /// Its number in the label map.
    pub label: u8,
    /// What it is.
    pub name: &'static str,
    /// Young's modulus (kPa).
    pub youngs_modulus_kpa: f64,
    /// Mean intensity, and the texture's deviation as a part of it.
    #[serde(skip)]
    look: [f64; 2],
}

/// Where the regions are; lengths in mm.
#[derive(Debug, Clone)]
enum Shape {
    /// Balls in a block.
    Balls { low: [f64; 3], high: [f64; 3], balls: Vec<Ball> },
    /// Layers of a block from the top down, with the rectangle of the punch.
    Layers { low: [f64; 3], high: [f64; 3], waves: Vec<Wave>, punch: [[f64; 2]; 2] },
    /// Half ellipsoids that hang from a flat face.
    Dome { centre: [f64; 3], radii: Vec<[f64; 3]> },
}

/// The height of a layer's lower side: a mean and two sines.
#[derive(Debug, Clone, Copy)]
struct Wave {
    mean: f64,
    height: f64,
    /// Radians a mm along x and y, and at the origin.
    along: [[f64; 3]; 2],
}

impl Wave {
    fn at(&self, x: f64, y: f64) -> f64 {
        self.mean + self.along.iter().map(|[a, b, c]| self.height * (a * x + b * y + c).sin()).sum::<f64>()
    }
}

/// An elastic body.
#[derive(Debug, Clone)]
pub struct Tissue {
    regions: Vec<Region>,
    shape: Shape,
    texture: Texture,
    /// Longest voxel edge (mm): the image's edges are two of them wide (10 to 90 %).
    voxel: f64,
}

impl Tissue {
    /// The body of a kind in the field of view of `grid`.
    pub fn new(params: &PhantomParams, grid: &Grid) -> Self {
        let mut random = Random::new(params.seed, 80);
        let half = extent(grid).map(|e| e / 2.0);
        let voxel = grid.spacing().iter().fold(0.0, |m: f64, &s| m.max(s));
        // Off the lattice, so that no voxel centre lies on a flat side.
        let middle = centre(grid).map(|c| c + voxel * random.uniform(0.3, 0.7));
        let low = std::array::from_fn(|a| middle[a] - 0.84 * half[a]);
        let high = std::array::from_fn(|a| middle[a] + 0.84 * half[a]);
        let (regions, shape) = match params.kind {
            PhantomKind::Slab => layers(low, high, &mut random),
            PhantomKind::Fingertip => fingertip(middle, half, &mut random),
            _ => inclusions(params, low, high, &mut random),
        };
        Self { regions, shape, texture: Texture::new(grid, params.seed), voxel }
    }

    /// What it is made of, by region of the mesh.
    pub fn regions(&self) -> &[Region] {
        &self.regions
    }

    /// Height of the body between its held and its pressed side (mm).
    pub fn height(&self) -> f64 {
        match &self.shape {
            Shape::Balls { low, high, .. } | Shape::Layers { low, high, .. } => high[2] - low[2],
            Shape::Dome { radii, .. } => radii[0][2],
        }
    }

    /// World axes of the held and the pressed side.
    pub fn sides(&self) -> [&'static str; 2] {
        match self.shape {
            Shape::Dome { .. } => ["z+", "z-"],
            _ => ["z-", "z+"],
        }
    }

    /// Whether the pressed side slides on a plate (else it sticks to it).
    pub fn slides(&self) -> bool {
        matches!(self.shape, Shape::Dome { .. })
    }

    /// Depth under the body's outline (mm), negative outside; exact near the outline.
    fn depth(&self, p: [f64; 3]) -> f64 {
        match &self.shape {
            Shape::Balls { low, high, .. } | Shape::Layers { low, high, .. } => {
                let inside = |a: usize| (p[a] - low[a]).min(high[a] - p[a]);
                let nearest = (0..3).map(inside).fold(f64::INFINITY, f64::min);
                let outside: f64 = (0..3).map(|a| inside(a).min(0.0).powi(2)).sum();
                if nearest < 0.0 { -outside.sqrt() } else { nearest }
            }
            Shape::Dome { centre, .. } => self.within(0, p).min(centre[2] - p[2]),
        }
    }

    /// Depth (mm) in region `n`, were it not for the regions in it; negative outside.
    fn within(&self, n: usize, p: [f64; 3]) -> f64 {
        match &self.shape {
            Shape::Balls { .. } | Shape::Layers { .. } if n == 0 => f64::INFINITY,
            Shape::Balls { balls, .. } => balls[n - 1].radius - length(difference(p, balls[n - 1].centre)),
            Shape::Layers { waves, .. } => waves[n - 1].at(p[0], p[1]) - p[2],
            Shape::Dome { centre, radii } => {
                let d = difference(p, *centre);
                let level = length(std::array::from_fn(|a| d[a] / radii[n][a]));
                let slope = length(std::array::from_fn(|a| d[a] / radii[n][a].powi(2))) / level.max(1e-9);
                (1.0 - level) / slope.max(1e-9)
            }
        }
    }

    /// The region at a world position, none outside.
    pub fn region(&self, p: WorldPoint) -> Option<usize> {
        let inside = self.depth(p.0) > 0.0;
        inside.then(|| (1..self.regions.len()).rev().find(|&n| self.within(n, p.0) > 0.0).unwrap_or(0))
    }

    /// Intensity at a world position, and whether it lies in the body.
    pub fn sample(&self, p: WorldPoint) -> (f64, bool) {
        let outline = self.depth(p.0);
        // The logistic is under 1e-9 there.
        if outline < -9.5 * self.voxel {
            return (0.0, false);
        }
        let texture = self.texture.at(p);
        let painted = self.regions.iter().enumerate().fold(0.0, |below, (n, region)| {
            let [mean, deviation] = region.look;
            below + self.cover(self.within(n, p.0)) * (mean * (1.0 + deviation * texture) - below)
        });
        ((painted * self.cover(outline)).max(0.0), outline > 0.0)
    }

    /// How much of a voxel lies inside, at `depth` mm.
    fn cover(&self, depth: f64) -> f64 {
        cover(depth, BORDER_WIDTH_VOXELS * self.voxel)
    }

    /// Coarse hexahedra fitted to the regions.
    pub fn mesh(&self) -> HexMesh {
        match &self.shape {
            Shape::Balls { low, high, balls } => block_with_balls(*low, *high, balls),
            Shape::Layers { low, high, waves, punch } => {
                layered_block(*low, *high, waves.len() + 1, |n, x, y| waves[n].at(x, y), *punch)
            }
            Shape::Dome { centre, radii } => dome(*centre, radii),
        }
    }

    /// Brings a place onto the surfaces.
    pub fn project(&self, surfaces: Surfaces, p: [f64; 3]) -> [f64; 3] {
        let mut q = p;
        for n in (0..self.regions.len()).filter(|n| surfaces & (CURVED << n) != 0) {
            q = match &self.shape {
                Shape::Balls { balls, .. } => {
                    let d = difference(q, balls[n].centre);
                    let scale = balls[n].radius / length(d);
                    std::array::from_fn(|a| balls[n].centre[a] + scale * d[a])
                }
                Shape::Layers { waves, .. } => [q[0], q[1], waves[n].at(q[0], q[1])],
                Shape::Dome { centre, radii } => {
                    let d = difference(q, *centre);
                    let scale = length(std::array::from_fn(|a| d[a] / radii[n][a])).recip();
                    std::array::from_fn(|a| centre[a] + scale * d[a])
                }
            };
        }
        q
    }

    /// The height of the plate when it has pressed by `amplitude` mm, if there is one.
    pub fn plate(&self, amplitude: f64) -> Option<f64> {
        match &self.shape {
            Shape::Dome { centre, radii } => Some(centre[2] - radii[0][2] + amplitude),
            _ => None,
        }
    }

    /// A displacement to start from (mm).
    pub fn squeezed(&self, p: [f64; 3], amplitude: f64) -> [f64; 3] {
        match &self.shape {
            Shape::Balls { low, high, .. } | Shape::Layers { low, high, .. } => {
                [0.0, 0.0, -amplitude * (p[2] - low[2]) / (high[2] - low[2])]
            }
            Shape::Dome { centre, radii } => {
                // The bone stays; what is around it moves the more the nearer it is to the skin,
                // and the lower.
                let below = (-self.within(radii.len() - 1, p)).max(0.0);
                let share = below / (below + self.within(0, p).max(0.0)).max(1e-9);
                [0.0, 0.0, amplitude * share * (centre[2] - p[2]) / radii[0][2]]
            }
        }
    }
}

/// A block with one ball, two side by side, or none.
fn inclusions(params: &PhantomParams, low: [f64; 3], high: [f64; 3], random: &mut Random) -> (Vec<Region>, Shape) {
    const BACKGROUND_MODULUS_KPA: f64 = 20.0;
    let side: [f64; 3] = std::array::from_fn(|a| high[a] - low[a]);
    let count = params.elastic.inclusions;
    let region = |label, name, e, look| Region { label, name, youngs_modulus_kpa: e, look };
    let mut regions = vec![region(1, "background", BACKGROUND_MODULUS_KPA, [620.0, 0.3])];
    let mut balls = Vec::new();
    for n in 0..count {
        let across = if count == 1 { [0.42, 0.58] } else { [[0.25, 0.31], [0.69, 0.75]][n] };
        let share = if count == 1 { [0.23, 0.29] } else { [0.2, 0.24] };
        let centre = std::array::from_fn(|a| {
            let [from, to] = [across, [0.42, 0.58], [0.45, 0.55]][a];
            low[a] + side[a] * random.uniform(from, to)
        });
        balls.push(Ball { centre, radius: side[2].min(side[0] / 1.5) * random.uniform(share[0], share[1]) });
        let contrast = if count == 1 { params.elastic.contrast } else { [0.5, 4.0][n] };
        let look = if contrast < 1.0 { [330.0, 0.3] } else { [900.0, 0.2] };
        regions.push(region(
            n as u8 + 2,
            ["inclusion", "second inclusion"][n],
            contrast * BACKGROUND_MODULUS_KPA,
            look,
        ));
    }
    (regions, Shape::Balls { low, high, balls })
}

/// Skin, fat and muscle under a rectangular punch.
fn layers(low: [f64; 3], high: [f64; 3], random: &mut Random) -> (Vec<Region>, Shape) {
    let region = |label, name, e, look| Region { label, name, youngs_modulus_kpa: e, look };
    let regions = vec![
        region(1, "skin", 80.0, [480.0, 0.25]),
        region(2, "fat", 20.0, [1000.0, 0.18]),
        region(3, "muscle", 40.0, [380.0, 0.3]),
    ];
    let side: [f64; 3] = std::array::from_fn(|a| high[a] - low[a]);
    let mut wave = |depth: f64| {
        let mut along = || {
            let turn = random.uniform(0.0, std::f64::consts::TAU);
            let rate = std::f64::consts::TAU / (side[0] * random.uniform(0.6, 0.9));
            [rate * turn.cos(), rate * turn.sin(), random.uniform(0.0, std::f64::consts::TAU)]
        };
        Wave { mean: high[2] - depth * side[2], height: 0.009 * side[2], along: [along(), along()] }
    };
    let waves = vec![wave(0.11), wave(0.36)];
    let middle = [0, 1].map(|a| (low[a] + high[a]) / 2.0 + 0.03 * side[a] * random.uniform(-1.0, 1.0));
    let reach = [0, 1].map(|a| side[a] * random.uniform(0.21, 0.24));
    let punch = [[middle[0] - reach[0], middle[1] - reach[1]], [middle[0] + reach[0], middle[1] + reach[1]]];
    (regions, Shape::Layers { low, high, waves, punch })
}

/// Skin, pulp and bone of a finger's pad, hanging from the nail.
fn fingertip(middle: [f64; 3], half: [f64; 3], random: &mut Random) -> (Vec<Region>, Shape) {
    let region = |label, name, e, look| Region { label, name, youngs_modulus_kpa: e, look };
    let regions = vec![
        region(1, "skin", 80.0, [450.0, 0.2]),
        region(2, "pulp", 25.0, [850.0, 0.25]),
        region(3, "bone", 15_000.0, [250.0, 0.2]),
    ];
    let centre = [middle[0], middle[1], middle[2] + 0.45 * half[2]];
    let outer = [0.76 * half[0], 0.78 * half[1], 0.95 * half[2]].map(|r| r * random.uniform(0.97, 1.03));
    let skin = 0.12 * half[2] * random.uniform(0.9, 1.1);
    let pulp = outer.map(|r| r - skin);
    let bone = [0.5, 0.58, 0.5].map(|share| share * random.uniform(0.95, 1.05));
    let radii = vec![outer, pulp, std::array::from_fn(|a| bone[a] * outer[a])];
    (regions, Shape::Dome { centre, radii })
}

fn difference(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| a[i] - b[i])
}
