//! How far off a strain may be, from random draws of the displacement's error.

use super::gauge::{Gauge, map_gradients};
use super::measure;
use crate::error::SpaceError;
use crate::numerics::bspline::weights;
use crate::numerics::filters::gaussian;
use crate::numerics::sampling::Stencil;
use crate::numerics::symmetric3::{Symmetric3, eigenvalues, quadratic};
use crate::types::space::Matrix3;
use crate::types::{Affine, DenseField, ErrorSamples, Grid, StrainMeasure, WorldPoint};
use rayon::prelude::*;

/// Places at a fixed step in voxels of a field, with random draws of its error there.
#[derive(Debug, Clone)]
pub struct Draws {
    step: [usize; 3],
    grid: Grid,
    field: DenseField,
    bodies: Vec<u8>,
    errors: Vec<DenseField>,
}

/// Draws of a field's error (mm, RAS), on a grid half as wide as the nodes of the samples; `full`
/// is the field's own.
///
/// # Errors
/// [`SpaceError`] when the places have no grid.
pub(crate) fn error_draws(full: &Grid, samples: &ErrorSamples) -> Result<Vec<DenseField>, SpaceError> {
    errors_on(&thinned(full, samples)?.1, samples)
}

fn errors_on(grid: &Grid, samples: &ErrorSamples) -> Result<Vec<DenseField>, SpaceError> {
    drawn(grid, samples).map(|values| DenseField::from_vec(*grid, values)).collect()
}

/// Step in voxels of a grid: places half as far apart as the nodes of the samples.
fn thinned(full: &Grid, samples: &ErrorSamples) -> Result<([usize; 3], Grid), SpaceError> {
    let (shape, spacing) = (full.shape(), full.spacing());
    // The nodes may run along other axes: the closest along any counts for all.
    let nodes = samples.nodes();
    let thick = (0..3).filter(|&a| nodes.shape()[a] > 1);
    let apart = thick.map(|a| nodes.spacing()[a]).fold(f64::INFINITY, f64::min);
    let step: [usize; 3] = std::array::from_fn(|a| ((apart / (2.0 * spacing[a])) as usize).clamp(1, shape[a]));
    let (linear, WorldPoint(origin)) = (full.affine().linear(), full.affine().origin());
    let row = |r: usize| {
        let [x, y, z] = std::array::from_fn(|a| linear[r][a] * step[a] as f64);
        [x, y, z, origin[r]]
    };
    let affine = Affine::new(std::array::from_fn(row))?;
    Ok((step, Grid::new(std::array::from_fn(|a| (shape[a] - 1) / step[a] + 1), affine)?))
}

/// Displacement gradients by place: as measured, then with each draw of the error; none outside the
/// bodies.
pub(crate) type Gradients = Vec<Vec<Option<Matrix3>>>;

impl Draws {
    /// Places half as far apart as the nodes of the samples.
    ///
    /// # Errors
    /// [`SpaceError`] when the places have no grid.
    pub fn new(field: &DenseField, bodies: &[u8], samples: &ErrorSamples) -> Result<Self, SpaceError> {
        let full = *field.grid();
        let (step, grid) = thinned(&full, samples)?;
        let at = |place: usize| offset(&grid, step, &full, place);
        let thinned = DenseField::from_voxels(grid, |o, _| field.at(at(o)).map(f64::from));
        let labels = if bodies.is_empty() { Vec::new() } else { (0..grid.len()).map(|o| bodies[at(o)]).collect() };
        Ok(Self { step, grid, field: thinned, bodies: labels, errors: errors_on(&grid, samples)? })
    }

    /// Where the places are.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// The offset of a place on the field's own grid.
    pub fn offset(&self, full: &Grid, place: usize) -> usize {
        offset(&self.grid, self.step, full, place)
    }

    /// The gauge in places.
    fn thinned(&self, gauge: Gauge) -> Gauge {
        let half = |a: usize| match gauge.half[a] {
            0 => 0,
            h => ((h as f64 / self.step[a] as f64).round() as usize).max(1),
        };
        Gauge { half: std::array::from_fn(half) }
    }

    /// The displacement gradient at each place of a body: as measured, then with each draw of the
    /// error, `most` of them.
    pub fn gradients(&self, gauge: Gauge, most: usize) -> Gradients {
        let gauge = self.thinned(gauge);
        let of = |field: &DenseField| map_gradients(field, &self.bodies, gauge, |_, g| Some(*g));
        let own = of(&self.field);
        let with = |error: &DenseField| {
            let plus = |(g, d): (&Option<Matrix3>, Option<Matrix3>)| {
                let (g, d) = ((*g)?, d?);
                Some(std::array::from_fn(|r| std::array::from_fn(|c| g[r][c] + d[r][c])))
            };
            own.iter().zip(of(error)).map(plus).collect()
        };
        let drawn: Vec<Vec<Option<Matrix3>>> = self.errors.iter().take(most).map(with).collect();
        [own].into_iter().chain(drawn).collect()
    }
}

/// The offset on the `full` grid of a place of `grid`, which has every `step`-th voxel of it.
fn offset(grid: &Grid, step: [usize; 3], full: &Grid, place: usize) -> usize {
    let v = grid.voxel(place);
    full.index(v[0] * step[0], v[1] * step[1], v[2] * step[2])
}

/// Each sample at the places of a grid (mm, RAS, planar).
fn drawn(grid: &Grid, samples: &ErrorSamples) -> impl Iterator<Item = Vec<f32>> {
    let (n, nodes) = (grid.len(), samples.nodes().len());
    let all: Vec<Vec<f32>> = (0..n)
        .into_par_iter()
        .map(|at| {
            let taps = taps(samples.nodes(), grid.centre(at));
            let of = |component: &[f32]| taps.iter().map(|&(node, w)| w * component[node]).sum::<f32>();
            samples.values().iter().flat_map(|s| s.chunks_exact(nodes).map(of)).collect()
        })
        .collect();
    (0..samples.values().len())
        .map(move |s| (0..3).flat_map(|c| all.iter().map(move |values| values[3 * s + c])).collect())
}

/// What each sample says the error is at a place (mm, RAS).
pub(crate) fn errors_at(samples: &ErrorSamples, place: WorldPoint) -> Vec<[f64; 3]> {
    let nodes = samples.nodes().len();
    let taps = taps(samples.nodes(), place);
    let of = |component: &[f32]| taps.iter().map(|&(node, w)| f64::from(w * component[node])).sum::<f64>();
    let each = |sample: &Vec<f32>| std::array::from_fn(|c| of(&sample[c * nodes..(c + 1) * nodes]));
    samples.values().iter().map(each).collect()
}

/// The at most 64 nodes that act at a place (mm), with their weights.
fn taps(nodes: &Grid, place: WorldPoint) -> Vec<(usize, f32)> {
    let shape = nodes.shape();
    let at = nodes.affine().to_voxel(place).0;
    let axis = |a: usize| match shape[a] {
        0..4 => (0, [1.0, 0.0, 0.0, 0.0], 1),
        n => {
            let first = (at[a].floor() - 1.0).clamp(0.0, (n - 4) as f64);
            (first as usize, weights((at[a] - 1.0 - first).clamp(0.0, 1.0) as f32), 4)
        }
    };
    let [x, y, z] = [0, 1, 2].map(axis);
    let tap = |i: usize, j: usize, k: usize| {
        (x.0 + i + shape[0] * (y.0 + j + shape[1] * (z.0 + k)), x.1[i] * y.1[j] * z.1[k])
    };
    (0..z.2)
        .flat_map(|k| (0..y.2).flat_map(move |j| (0..x.2).map(move |i| (i, j, k))))
        .map(|(i, j, k)| tap(i, j, k))
        .collect()
}

/// Width over which statistics of a few draws are smoothed (nodes, one Gaussian standard
/// deviation).
pub(crate) const DRAW_SMOOTHING_NODES: f64 = 1.5;

/// Standard deviation of a strain by place.
#[derive(Debug, Clone, PartialEq)]
pub enum StrainDeviation {
    /// From draws of the error, on a grid of places: variances of the six components (planar).
    Drawn(Box<Grid>, Vec<Vec<f32>>),
    /// The same everywhere, from the noise of the displacement between neighbouring voxels alone.
    White(f64),
}

impl StrainDeviation {
    /// From the gradients of [`Draws::gradients`].
    pub fn drawn(draws: &Draws, gradients: &Gradients, measure: StrainMeasure) -> Self {
        let (shape, n) = (draws.grid.shape(), draws.grid.len());
        let mut squares = vec![vec![0.0f32; n]; 6];
        let mut counts = vec![0.0f32; n];
        let [own, drawn @ ..] = &gradients[..] else { return Self::White(0.0) };
        for at in 0..n {
            let Some(g) = own[at] else { continue };
            counts[at] = 1.0;
            let e = measure::tensor(measure, &g);
            for other in drawn.iter().filter_map(|d| d[at]) {
                let apart = measure::tensor(measure, &other);
                (0..6).for_each(|c| squares[c][at] += ((apart[c] - e[c]).powi(2) / drawn.len() as f64) as f32);
            }
        }
        let smooth =
            |values: &[f32]| gaussian(values, shape, shape.map(|n| if n > 1 { DRAW_SMOOTHING_NODES } else { 0.0 }));
        let share = smooth(&counts);
        let averaged = |values: Vec<f32>| smooth(&values).iter().zip(&share).map(|(v, s)| v / s.max(1e-6)).collect();
        Self::Drawn(Box::new(draws.grid), squares.into_iter().map(averaged).collect())
    }

    /// Of each component (xx, yy, zz, xy, xz, yz; 1) at a place (mm).
    pub fn at(&self, place: WorldPoint) -> Symmetric3 {
        match self {
            Self::White(normal) => {
                let shear = normal / 2f64.sqrt();
                [*normal, *normal, *normal, shear, shear, shear]
            }
            Self::Drawn(grid, variances) => {
                let stencil = Stencil::new(grid.shape(), grid.affine().to_voxel(place));
                std::array::from_fn(|c| stencil.of(&variances[c]).max(0.0).sqrt())
            }
        }
    }
}

/// Mean square of the normal strains of `gradients` less those of `others`, over the places of a
/// body (1).
pub fn apart(gradients: &[Option<Matrix3>], others: &[Option<Matrix3>]) -> f64 {
    let square = |(a, b): (&Option<Matrix3>, &Option<Matrix3>)| {
        a.zip(*b).map(|(a, b)| (0..3).map(|c| (a[c][c] - b[c][c]).powi(2)).sum::<f64>())
    };
    let squares: Vec<f64> = gradients.iter().zip(others).filter_map(square).collect();
    squares.iter().sum::<f64>() / (3 * squares.len().max(1)) as f64
}

/// Names of the components of a strain that every voxel has.
pub const COMPONENTS: [&str; 11] = ["xx", "yy", "zz", "xy", "xz", "yz", "e1", "e2", "e3", "shear", "volume"];

/// The [`COMPONENTS`] of a strain, then those along up to three directions (NaN without).
pub fn components(measure: StrainMeasure, e: &Symmetric3, frame: Option<&Matrix3>) -> [f64; 14] {
    let mut out = [f64::NAN; 14];
    out[..6].copy_from_slice(e);
    out[6..9].copy_from_slice(&eigenvalues(e));
    out[9] = measure::largest_shear(e);
    out[10] = measure::volume_change(measure, e);
    if let Some(frame) = frame {
        (0..3).for_each(|k| out[11 + k] = quadratic(e, frame[k]));
    }
    out
}
