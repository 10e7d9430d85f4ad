//! Sequences: a body whose inside moves over time, exactly known at every frame.
//!
//! The first frame shows the body at rest, B(x); frame t shows B(x(y)) with y = x + u_t(x), so that
//! no frame is made by interpolation. The motions are sums of smooth presses, a bending or a
//! muscle's contraction, each growing and falling with the time s from 0 to 1; what is pressed
//! bulges. Noise is Rician, independent in each frame.

use crate::error::{ParamError, SynthError, UnknownName};
use crate::numerics::differences::{deformation_gradient, displacement_gradient};
use crate::numerics::random::Random;
use crate::numerics::statistics::percentile;
use crate::synth::anatomy::body;
use crate::synth::body::{Body, centre, extent};
use crate::synth::motion::{add, press};
use crate::synth::params::{PhantomKind, PhantomParams};
use crate::synth::phantom::{MIN_JACOBIAN, rician};
use crate::types::names::choose;
use crate::types::space::determinant;
use crate::types::space::dot;
use crate::types::{DenseField, Grid, Mask, Volume, WorldPoint};
use rayon::prelude::*;
use serde::Serialize;
use std::f64::consts::PI;
use std::str::FromStr;

/// What moves, and how.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum SequenceKind {
    /// A finger pad pressed from two sides, held and rolled, half let go.
    Pinch,
    /// A finger under three contacts that come one after the other, while it bends.
    Pen,
    /// A calf whose inner muscle shortens and thickens, then half relaxes.
    Contraction,
}

impl SequenceKind {
    /// Names and kinds.
    pub const KNOWN: [(&'static str, Self); 3] =
        [("pinch", Self::Pinch), ("pen", Self::Pen), ("contraction", Self::Contraction)];

    /// The body that moves.
    fn body(self) -> PhantomKind {
        if self == Self::Contraction { PhantomKind::Calf } else { PhantomKind::Fingertip }
    }
}

impl FromStr for SequenceKind {
    type Err = UnknownName;

    fn from_str(name: &str) -> Result<Self, UnknownName> {
        choose("sequence", name, &Self::KNOWN)
    }
}

/// All settings of a sequence.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SequenceParams {
    /// What moves, and how.
    pub kind: SequenceKind,
    /// Frames, the one at rest included; 2 to 1000.
    pub frames: usize,
    /// Largest displacement of any frame (mm), about.
    pub amplitude: f64,
    /// Voxels along x, y, z; at least 8 each.
    pub size: [usize; 3],
    /// Voxel edges (mm).
    pub spacing: [f64; 3],
    /// Of everything random.
    pub seed: u64,
    /// Standard deviation of the Rician noise, relative to the 99th percentile of the first frame
    /// (1).
    pub noise: f64,
}

impl SequenceParams {
    /// The defaults of a kind: 16 frames, seed 1, noise 3 %, and a size and amplitude that suit it.
    pub fn new(kind: SequenceKind) -> Self {
        let (size, spacing, amplitude) = match kind {
            SequenceKind::Pinch => ([56, 72, 56], [0.4; 3], 1.6),
            SequenceKind::Pen => ([56, 72, 56], [0.4; 3], 2.2),
            SequenceKind::Contraction => ([96, 96, 32], [1.5, 1.5, 5.0], 8.0),
        };
        Self { kind, frames: 16, amplitude, size, spacing, seed: 1, noise: 0.03 }
    }

    /// The same field of view with `n` voxels along x, and the other sides in proportion.
    pub fn sized(mut self, n: usize) -> Self {
        let like = PhantomParams { size: self.size, spacing: self.spacing, ..PhantomParams::new(PhantomKind::Block) };
        let like = like.sized(n);
        (self.size, self.spacing) = (like.size, like.spacing);
        self
    }

    /// The grid they ask for.
    ///
    /// # Errors
    /// [`SynthError`] when a value is out of range.
    pub fn grid(&self) -> Result<Grid, SynthError> {
        self.check()?;
        self.pair().grid()
    }

    /// What a pair has too.
    fn pair(&self) -> PhantomParams {
        let Self { size, spacing, amplitude, noise, .. } = *self;
        PhantomParams { size, spacing, amplitude, noise, ..PhantomParams::new(PhantomKind::Block) }
    }

    /// Checks every range.
    ///
    /// # Errors
    /// [`ParamError`] names the first value out of range.
    pub fn check(&self) -> Result<(), ParamError> {
        if !(2..=1000).contains(&self.frames) {
            let range = "2 to 1000";
            return Err(ParamError { name: "frames", value: self.frames as f64, range });
        }
        if let Some(n) = self.size.iter().find(|&&n| n < 8) {
            let range = "8 to 4096 voxels a side for a sequence";
            return Err(ParamError { name: "size", value: *n as f64, range });
        }
        self.pair().check()
    }
}

/// A sequence, frame by frame; see [`Sequence::frame`].
#[derive(Debug, Clone)]
pub struct Sequence {
    params: SequenceParams,
    grid: Grid,
    body: Body,
    parts: Vec<Part>,
    /// Standard deviation of the noise (intensity).
    pub noise_sigma: f64,
    /// Tissue of the first frame, off the grid's border.
    pub mask: Mask,
    /// Which region of the body each voxel of the first frame belongs to; 0 outside.
    pub labels: Mask,
}

/// One part of a motion: a shape, and how it grows.
#[derive(Debug, Clone, Copy)]
struct Part {
    shape: Shape,
    /// Size at time s (0 to 1).
    size: fn(f64) -> f64,
    scale: f64,
}

#[derive(Debug, Clone, Copy)]
enum Shape {
    /// A blunt contact, see [`press`].
    Press { contact: [f64; 3], inward: [f64; 3], radius: f64, depth: f64 },
    /// A turn about the y axis through `centre` that grows with depth below it and fades behind
    /// `reach` mm.
    Roll { centre: [f64; 3], reach: f64 },
    /// Bending of a beam along y that is held at `root`: z changes with the square of the distance.
    Bend { root: f64, middle: f64 },
    /// A muscle along z: shortens by the strain 1 on its axis and thickens so that its volume
    /// stays.
    Shorten { centre: [f64; 3], radius: f64, half_length: f64 },
}

impl Shape {
    fn at(&self, p: [f64; 3]) -> [f64; 3] {
        match *self {
            Self::Press { contact, inward, radius, depth } => press(p, contact, inward, radius, depth),
            Self::Roll { centre, reach } => {
                let d = add(p, centre, -1.0);
                let fade = (-0.5 * (d[1] / reach).powi(2)).exp();
                [fade * d[2], 0.0, -fade * d[0]]
            }
            Self::Bend { root, middle } => {
                let y = (p[1] - root).max(0.0);
                [0.0, -y * (p[2] - middle), 0.5 * y * y]
            }
            Self::Shorten { centre, radius, half_length } => {
                let d = add(p, centre, -1.0);
                let across = (d[0] * d[0] + d[1] * d[1]) / (radius * radius);
                let along = d[2] / half_length;
                let fade = (-0.5 * (across + along * along)).exp();
                [0.5 * fade * d[0], 0.5 * fade * d[1], -fade * d[2]]
            }
        }
    }
}

/// Up in the first 40 % of the time, held, half let go in the last 30 %.
fn hold(s: f64) -> f64 {
    let smooth = |t: f64| 0.5 - 0.5 * (PI * t.clamp(0.0, 1.0)).cos();
    smooth(s / 0.4) - 0.5 * smooth((s - 0.7) / 0.3)
}

/// To one side, to the other and back while held.
fn sway(s: f64) -> f64 {
    (2.0 * PI * ((s - 0.3) / 0.6).clamp(0.0, 1.0)).sin()
}

impl Sequence {
    /// Anatomy and motion of a sequence.
    ///
    /// # Errors
    /// [`SynthError`] when a value is out of range or some frame folds at this amplitude.
    ///
    /// ```
    /// use palpate::synth::{Sequence, SequenceKind, SequenceParams};
    /// let mut params = SequenceParams::new(SequenceKind::Pinch).sized(24);
    /// params.frames = 4;
    /// let sequence = Sequence::new(&params)?;
    /// assert_eq!(sequence.frames(), 4);
    /// // The first frame is at rest.
    /// assert!(sequence.truth(0).as_slice().iter().all(|u| *u == 0.0));
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn new(params: &SequenceParams) -> Result<Self, SynthError> {
        let grid = params.grid()?;
        let body = body(params.kind.body(), &grid, params.seed);
        let imaged = Volume::from_voxels(grid, |_, x| body.sample(x));
        let mut bright: Vec<f64> = imaged.as_slice().iter().map(|v| v.0).collect();
        let shape = grid.shape();
        let inner = |at: usize| (0..3).all(|a| (1..shape[a] - 1).contains(&grid.voxel(at)[a]));
        let mask = Volume::from_voxels(grid, |at, _| u8::from(imaged.as_slice()[at].1 && inner(at)));
        let labels = Volume::from_voxels(grid, |_, x| body.region(x));
        let noise_sigma = params.noise * percentile(&mut bright, 99.0);
        let mut sequence = Self { params: params.clone(), grid, body, parts: Vec::new(), noise_sigma, mask, labels };
        sequence.parts = parts(params, &grid);
        sequence.scale()?;
        Ok(sequence)
    }

    /// Frames, the first included.
    pub fn frames(&self) -> usize {
        self.params.frames
    }

    /// Settings.
    pub fn params(&self) -> &SequenceParams {
        &self.params
    }

    /// Makes the asked amplitude the largest displacement in the tissue, and refuses folds.
    fn scale(&mut self) -> Result<(), SynthError> {
        let inside: Vec<usize> = (0..self.grid.len()).filter(|&at| self.mask.as_slice()[at] != 0).collect();
        let mut largest = 0.0f64;
        for t in 1..self.frames() {
            let length = |&at: &usize| self.displacement(t, self.world(at)).iter().map(|v| v * v).sum::<f64>().sqrt();
            largest = largest.max(inside.par_iter().map(length).reduce(|| 0.0, f64::max));
        }
        let factor = if largest > 0.0 { self.params.amplitude / largest } else { 0.0 };
        self.parts.iter_mut().for_each(|p| p.scale *= factor);
        for t in 1..self.frames() {
            let truth = self.truth(t);
            let least = (0..self.grid.len())
                .into_par_iter()
                .map(|at| determinant(&deformation_gradient(displacement_gradient(&truth, self.grid.voxel(at)))))
                .reduce(|| f64::INFINITY, f64::min);
            if least < MIN_JACOBIAN {
                let range = "less for this motion: the Jacobian determinant of the truth falls to 0.1";
                return Err(ParamError { name: "amplitude", value: self.params.amplitude, range }.into());
            }
        }
        Ok(())
    }

    /// u_t at a world position of the first frame (mm, RAS).
    pub fn displacement(&self, t: usize, p: WorldPoint) -> [f64; 3] {
        let s = t as f64 / (self.frames() - 1) as f64;
        self.parts.iter().fold([0.0; 3], |u, part| add(u, part.shape.at(p.0), part.scale * (part.size)(s)))
    }

    /// u_t at the voxel centres of the first frame (mm, RAS).
    pub fn truth(&self, t: usize) -> DenseField {
        DenseField::from_voxels(self.grid, |_, x| self.displacement(t, x))
    }

    /// The image at time t.
    pub fn frame(&self, t: usize) -> Volume {
        let clean = Volume::from_voxels(self.grid, |_, y| self.body.sample(self.origin_of(t, y)).0 as f32);
        rician(&clean, self.noise_sigma, self.params.seed, 100 + t as u64)
    }

    fn world(&self, at: usize) -> WorldPoint {
        let [i, j, k] = self.grid.voxel(at);
        self.grid.world(i, j, k)
    }

    /// The x with x + u_t(x) = y, by fixed point to 1e-9 mm.
    fn origin_of(&self, t: usize, y: WorldPoint) -> WorldPoint {
        let mut x = y;
        for _ in 0..200 {
            let r = y.minus(x.moved(self.displacement(t, x)));
            x = x.moved(r);
            if dot(r, r) < 1e-18 {
                break;
            }
        }
        x
    }
}

/// The parts of a motion, to be scaled together.
fn parts(params: &SequenceParams, grid: &Grid) -> Vec<Part> {
    let (c, e) = (centre(grid), extent(grid));
    let mut random = Random::new(params.seed, 30);
    let mut jitter = |size: f64| size * random.uniform(-1.0, 1.0);
    let at = |f: [f64; 3]| -> [f64; 3] { std::array::from_fn(|a| c[a] + 0.5 * f[a] * e[a]) };
    let press = |place: [f64; 3], inward: [f64; 3]| Shape::Press {
        contact: at(place),
        inward,
        radius: 0.2 * e[0],
        depth: 0.28 * e[0],
    };
    let part = |shape, size, scale| Part { shape, size, scale };
    match params.kind {
        SequenceKind::Pinch => vec![
            part(press([-0.8, 0.1 + jitter(0.1), -0.2], [1.0, 0.0, 0.0]), hold as fn(f64) -> f64, 1.0),
            part(press([0.8, 0.1 + jitter(0.1), -0.2], [-1.0, 0.0, 0.0]), hold, 1.0),
            part(Shape::Roll { centre: at([0.0, 0.1, 0.3]), reach: 0.3 * e[1] }, sway, 0.3 / (0.5 * e[2])),
        ],
        SequenceKind::Pen => {
            let around = |degrees: f64| {
                let (s, c) = degrees.to_radians().sin_cos();
                ([0.8 * c, 0.8 * s], [-c, 0.0, -s])
            };
            let contact = |degrees: f64, y: f64| {
                let ([x, z], inward) = around(degrees);
                press([x, y, z], inward)
            };
            vec![
                part(contact(-150.0, jitter(0.15)), |s| hold((s / 0.8).min(1.0)), 1.0),
                part(contact(-30.0, 0.25 + jitter(0.15)), |s| hold(((s - 0.1) / 0.8).clamp(0.0, 1.0)), 1.0),
                part(contact(90.0, -0.2 + jitter(0.15)), |s| hold(((s - 0.2) / 0.8).clamp(0.0, 1.0)), 0.6),
                part(
                    Shape::Bend { root: c[1] - 0.4 * e[1], middle: c[2] },
                    |s| (PI * s).sin() + 0.3 * s,
                    1.2 / (0.5 * (0.8 * e[1]).powi(2)),
                ),
            ]
        }
        SequenceKind::Contraction => vec![part(
            Shape::Shorten {
                centre: at([-0.3 + jitter(0.05), -0.4 + jitter(0.05), jitter(0.1)]),
                radius: 0.16 * e[0],
                half_length: 0.3 * e[2],
            },
            hold,
            1.0,
        )],
    }
}
