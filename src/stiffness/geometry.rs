//! What a voxel map or a field tells of the body's shape to a part of a voxel only: flat faces, and
//! the edge of a punch.
//!
//! A flat face along the voxels' axes lies anywhere within one voxel: 0.29 voxel, one standard
//! deviation (a curved one crosses the voxels at all heights, and is known much better). A plate
//! half a voxel away from where the mesh has it changes strain and modulus by a percent or two. So
//! each such face gets an offset of its own, with that prior, and is fitted together with moduli
//! and plates in one Gauss-Newton step on the coarse mesh.
//!
//! Where the surface beside a flat punch is free, strain under its edge is singular, and a thin
//! layer there hangs on where the edge is. A field tells that to half a voxel at best, and rounds
//! it where it was measured from images. So the edge has an offset as well, all around.

use crate::error::StiffnessError;
use crate::numerics::cholesky::within;
use crate::stiffness::border::Border;
use crate::stiffness::fem_body::Body;
use crate::stiffness::forward::Problem;
use crate::stiffness::identify::{Estimate, Setup, State, covariance, grouped_normal};
use crate::stiffness::inclusion::{Inclusion, SHAPE_FUNCTIONS};
use crate::stiffness::interface::Interface;
use crate::stiffness::observations::{Reading, find, gradient, read};
use crate::stiffness::punch_edge::Edge;
use crate::stiffness::systematic_error::Fit;
use crate::types::space::dot;
use crate::types::{Grid, VoxelPoint, WorldPoint};
use rayon::prelude::*;

/// Prior of the offsets of surfaces.
struct OffsetPrior {
    /// Standard deviation of a flat face (voxels): uniform over one voxel, 1 / sqrt(12) rounded.
    face_sd_voxels: f64,
    /// Standard deviation of the edge of a punch (voxels).
    punch_edge_sd_voxels: f64,
    /// Largest offset (standard deviations).
    max_sd: f64,
    /// The same for the walls of a hole: a channel of 12 by 10 voxels reached 1.5 voxels.
    max_wall_sd: f64,
}

const PRIOR: OffsetPrior =
    OffsetPrior { face_sd_voxels: 0.288_675, punch_edge_sd_voxels: 3.0, max_sd: 3.5, max_wall_sd: 6.0 };

/// Standard deviation of a mesh about a flat interface (voxels): calibration of the volumes moves
/// surfaces by hundredths.
const MESH_FACE_SD_VOXELS: f64 = 0.02;
/// Least part of the box's face that a flat face fills.
const MIN_BOX_FACE_FRACTION: f64 = 0.2;
/// Power of the distance from the middle with which an offset fades inwards: the outermost tenth
/// moves by two thirds or more.
const FADE_EXPONENT: i32 = 4;
/// Offset (voxels) by which forces are compared, to either side: small beside an element, and far
/// above what rounding changes.
const DIFFERENCE_VOXELS: f64 = 0.02;

/// A part of the body's shape that is known to a part of a voxel only.
#[derive(Debug, Clone)]
pub struct Part {
    /// As in summary.json; none for one of the shapes of an inclusion.
    pub name: Option<String>,
    /// One standard deviation (voxels).
    sigma: f64,
    /// The most standard deviations that it may come to.
    most: f64,
    /// How each node moves for an offset of a voxel (mm, RAS).
    movement: Vec<[f64; 3]>,
}

impl Part {
    /// The edge of a punch.
    pub fn edge(edge: &Edge, body: &Body, voxel: f64) -> Self {
        Self::of(body, Some("edge".into()), PRIOR.punch_edge_sd_voxels, |p| edge.widened(p, voxel))
    }

    /// The border between two labels, which moves along its normal as `border` says; `sigma` in
    /// voxels.
    pub fn border(border: Border, sigma: f64, voxel: f64) -> Self {
        let movement = border.normals.iter().map(|n| n.map(|v| voxel * v)).collect();
        Self { name: Some(border.name), sigma, most: PRIOR.max_sd, movement }
    }

    /// A flat face of the box of the body: voxel axis, and whether it is the upper one.
    fn face(body: &Body, grid: &Grid, axis: usize, upper: bool) -> Self {
        let name = format!("{}{axis}", if upper { '+' } else { '-' });
        let [low, high] = bounds(body, grid);
        let middle = 0.5 * (low[axis] + high[axis]);
        Self::of(body, Some(name), PRIOR.face_sd_voxels, |p| {
            let mut q = grid.affine().to_voxel(WorldPoint(p)).0;
            let part = (q[axis] - middle) / (high[axis] - middle);
            let part = if upper { part } else { -part };
            if part > 0.0 {
                q[axis] += if upper { 1.0 } else { -1.0 } * part.powi(FADE_EXPONENT);
            }
            grid.affine().to_world(VoxelPoint(q)).0
        })
    }

    /// A flat border between two labels, or the wall of a hole. The mesh rounds the edges in which
    /// the walls of a hole meet, and the walls answer for that as well.
    fn interface(interface: &Interface, body: &Body, grid: &Grid) -> Self {
        let part = Self::of(body, Some(interface.name()), PRIOR.face_sd_voxels, |p| interface.moved(p, grid, 1.0));
        Self { most: if interface.is_wall() { PRIOR.max_wall_sd } else { PRIOR.max_sd }, ..part }
    }

    /// The shapes of a region that was found without labels.
    fn inclusion(inclusion: &Inclusion, body: &Body, voxel: f64) -> Vec<Self> {
        let shapes = inclusion.shapes(&body.places);
        let one = |k: usize| {
            let movement = shapes.iter().map(|s| s[k].map(|v| voxel * v)).collect();
            Self { name: None, sigma: inclusion.prior() / voxel, most: PRIOR.max_sd, movement }
        };
        (0..SHAPE_FUNCTIONS).map(one).collect()
    }

    fn of(body: &Body, name: Option<String>, sigma: f64, moved: impl Fn([f64; 3]) -> [f64; 3]) -> Self {
        let one = |p: &[f64; 3]| {
            let q = moved(*p);
            std::array::from_fn(|a| q[a] - p[a])
        };
        Self { name, sigma, most: PRIOR.max_sd, movement: body.places.iter().map(one).collect() }
    }

    /// The penalty of an offset (voxels) under its prior: squared standard deviations.
    pub fn penalty(&self, offset: f64) -> f64 {
        (offset / self.sigma).powi(2)
    }

    /// Adds what an offset (voxels) moves to the nodes' places (mm, RAS).
    pub fn shift(&self, places: &mut [[f64; 3]], offset: f64) {
        places.iter_mut().zip(&self.movement).for_each(|(p, m)| (0..3).for_each(|a| p[a] += offset * m[a]));
    }

    /// How a place in the body moves for an offset of a voxel (mm, RAS).
    fn movement_at(&self, (element, weights): &Reading, body: &Body) -> [f64; 3] {
        let nodes = body.cells[*element as usize].iter().zip(weights);
        nodes.fold([0.0; 3], |sum, (n, w)| std::array::from_fn(|a| sum[a] + w * self.movement[*n as usize][a]))
    }

    /// What `give` tells of the problem with this part moved outwards by `offset` voxels, on the
    /// springs of `problem`.
    fn shifted<T>(
        &self,
        setup: &Setup<'_>,
        state: &State,
        problem: &Problem<'_>,
        offset: f64,
        give: impl FnOnce(&Setup<'_>, &Problem<'_>) -> T,
    ) -> T {
        let mut places = setup.body.places.clone();
        self.shift(&mut places, offset);
        let body = setup.body.with_places(places);
        let moved = Setup { body: &body, ..setup.clone() };
        let problem = Problem { springs: problem.springs.clone(), ..moved.problem(state) };
        give(&moved, &problem)
    }
}

/// What the offsets change.
#[derive(Debug, Clone, Default)]
pub struct Geometry {
    /// Faces, as `+0` ... by voxel axis, `edge`, and interfaces (`Interface::name`), and their
    /// offsets outwards or up the axis (voxels).
    pub faces: Vec<(String, f64)>,
    /// Offsets of the inclusions' shapes (voxels), one inclusion after the other.
    pub shapes: Vec<f64>,
    /// Change of all parameters, then the offsets (voxels).
    pub step: Vec<f64>,
    /// Covariance of the same, row by row.
    pub covariance: Vec<f64>,
    /// Derivative of ln force by each offset (1/voxel).
    pub force_slope: Vec<f64>,
    /// The solution's derivative by each offset (1/voxel), nodes moving along, one after the other.
    pub changes: Vec<f64>,
    /// What all parameters are known to.
    pub fit: Fit,
}

/// Fits the offsets about an estimate; none when the body has no flat face, no punch and no
/// `interfaces` or `inclusions` whose place or shape is open.
///
/// # Errors
/// As [`Setup::run`].
pub fn fit(
    setup: &Setup<'_>,
    estimate: &Estimate,
    grid: &Grid,
    interfaces: &[Interface],
    inclusions: &[Inclusion],
) -> Result<Option<Geometry>, StiffnessError> {
    let (body, voxel) = (setup.body, grid.least_spacing());
    let mut fixed = flat_faces(body, grid);
    fixed.extend(inclusions.iter().flat_map(|i| Part::inclusion(i, body, voxel)));
    fixed.extend(interfaces.iter().map(|i| Part::interface(i, body, grid)));
    let open = setup.open.iter().map(|(p, moved)| (p, *moved));
    let all: Vec<(&Part, f64)> = fixed.iter().map(|part| (part, 0.0)).chain(open).collect();
    offsets(setup, estimate, &all)
}

/// What the offsets of the open parts of the shape change, and how well each is known beforehand.
#[derive(Debug, Clone, Default)]
pub struct Open {
    /// Change of the displacement at the observations for an offset (mm/voxel), one row an offset.
    pub rows: Vec<Vec<[f64; 3]>>,
    /// Derivative of ln force by each offset (1/voxel).
    pub force_slope: Vec<f64>,
    /// One standard deviation of each offset before anything is measured (voxels).
    pub sigma: Vec<f64>,
}

/// What the offsets that [`fit`] seeks change about an estimate: none where nothing is open.
///
/// # Errors
/// As [`Setup::run`].
pub fn open(
    setup: &Setup<'_>,
    estimate: &Estimate,
    grid: &Grid,
    interfaces: &[Interface],
) -> Result<Open, StiffnessError> {
    let mut fixed = flat_faces(setup.body, grid);
    fixed.extend(interfaces.iter().map(|i| Part::interface(i, setup.body, grid)));
    let parts: Vec<(&Part, f64)> = fixed.iter().chain(setup.open.iter().map(|o| &o.0)).map(|p| (p, 0.0)).collect();
    let Some(x) = estimate.state.x.as_deref().filter(|_| !parts.is_empty()) else { return Ok(Open::default()) };
    let (rows, force_slope, _) = columns(setup, estimate, x, &parts)?;
    Ok(Open { rows, force_slope, sigma: parts.iter().map(|p| p.0.sigma).collect() })
}

/// A step of moduli, plates and the open parts of the shape together.
#[derive(Debug, Clone)]
pub(crate) struct JointStep {
    /// How much further outwards each open part lies (voxels), for all that the data say.
    pub offsets: Vec<f64>,
    /// Change of the moduli and the plates.
    parameters: Vec<f64>,
    changes: Vec<f64>,
}

impl JointStep {
    /// The step from an estimate; none where nothing is open.
    ///
    /// # Errors
    /// As [`Setup::run`].
    pub fn of(setup: &Setup<'_>, estimate: &Estimate) -> Result<Option<Self>, StiffnessError> {
        let parts: Vec<(&Part, f64)> = setup.open.iter().map(|(p, moved)| (p, *moved)).collect();
        let one = |g: Geometry| {
            let (parameters, offsets) = g.step.split_at(g.step.len() - parts.len());
            Self { offsets: offsets.to_vec(), parameters: parameters.to_vec(), changes: g.changes }
        };
        Ok(offsets(setup, estimate, &parts)?.map(one))
    }

    /// The same with no offset larger than `most` (voxels).
    pub fn limited(self, most: f64) -> Self {
        Self { offsets: self.offsets.iter().map(|s| s.clamp(-most, most)).collect(), ..self }
    }

    /// The state that a part of the step leads to, to first order.
    pub fn state(&self, setup: &Setup<'_>, estimate: &Estimate, part: f64) -> State {
        let Some(x) = estimate.state.x.as_deref() else { return estimate.state.clone() };
        let step: Vec<f64> = self.parameters.iter().chain(&self.offsets).map(|s| part * s).collect();
        let columns = [&estimate.columns[..], &self.changes].concat();
        setup.advanced(&estimate.state, x, &columns, &step)
    }
}

/// What the offsets of some parts change at the observations (mm/voxel), of ln force (1/voxel), and
/// of the solution.
///
/// A node that moves by m for an offset takes its displacement along. With the forces r(x, s) of
/// the displacement x and the offset s, equilibrium asks for dx/ds = -K^-1 dr/ds, and a place that
/// stays sees dx/ds less m along the gradient of x.
fn columns(
    setup: &Setup<'_>,
    estimate: &Estimate,
    x: &[f64],
    parts: &[(&Part, f64)],
) -> Result<(Vec<Vec<[f64; 3]>>, Vec<f64>, Vec<f64>), StiffnessError> {
    let (body, h) = (setup.body, DIFFERENCE_VOXELS);
    let problem = setup.problem(&estimate.state);
    let factor = problem.factorise(x)?;
    let side = |(part, _): &(&Part, f64)| {
        let forces = |by| part.shifted(setup, &estimate.state, &problem, by, |_, problem| problem.residual(x));
        let (out, back) = forces(h).zip(forces(-h))?;
        Some(out.into_iter().zip(back).map(|(o, b)| (b - o) / (2.0 * h)).collect())
    };
    let sides: Vec<Option<Vec<f64>>> = parts.par_iter().map(side).collect();
    // A shape that turns elements inside out gives nothing.
    let whole: Vec<bool> = sides.iter().map(Option::is_some).collect();
    let mut changes: Vec<f64> = sides.into_iter().flat_map(|s| s.unwrap_or_else(|| vec![0.0; x.len()])).collect();
    factor.sensitivities(&mut changes, None).map_err(|_| StiffnessError::Unsolvable)?;

    let places: Vec<[f64; 3]> = setup.observations.iter().map(|o| o.place).collect();
    // What an offset changes is smooth: it is read in the middle of a block.
    let readings = find(body, &places);
    let gradients: Vec<Option<[[f64; 3]; 3]>> =
        readings.par_iter().map(|r| r.as_ref().map(|r| gradient(r, body, x))).collect();
    let column = |((part, _), change, whole): (&(&Part, f64), &[f64], &bool)| {
        if !whole {
            return (vec![[0.0; 3]; places.len()], 0.0);
        }
        let at = |(reading, gradient): (&Option<Reading>, &Option<[[f64; 3]; 3]>)| {
            let Some((reading, gradient)) = reading.as_ref().zip(gradient.as_ref()) else { return [0.0; 3] };
            let (own, moved) = (read(&[*reading], body, change), part.movement_at(reading, body));
            std::array::from_fn(|a| own[a] - dot(gradient[a], moved))
        };
        let row: Vec<[f64; 3]> = readings.iter().zip(&gradients).map(at).collect();
        let force = |by: f64| {
            let y: Vec<f64> = x.iter().zip(change).map(|(x, c)| x + by * c).collect();
            let of = |moved: &Setup<'_>, problem: &Problem<'_>| moved.forces(problem, &estimate.state, &y)[0];
            part.shifted(setup, &estimate.state, &problem, by, of)
        };
        let slope = (force(h) / force(-h)).ln() / (2.0 * h);
        (row, slope)
    };
    let (rows, slopes) = (parts, changes.par_chunks_exact(x.len()), &whole).into_par_iter().map(column).unzip();
    Ok((rows, slopes, changes))
}

/// A covariance (row by row) of `p` parameters, those from `first` on offsets, with what the mesh
/// is off by in each, however well the data tell the place: all else follows it as it would another
/// place. `voxel` is that of the image over the one that offsets count in.
pub(crate) fn with_mesh(by_data: Vec<f64>, p: usize, first: usize, voxel: f64) -> Vec<f64> {
    let mut out = by_data.clone();
    for k in first..p {
        let follows: Vec<f64> =
            (0..p).map(|i| MESH_FACE_SD_VOXELS * voxel * by_data[i * p + k] / by_data[k * p + k]).collect();
        out.iter_mut().enumerate().for_each(|(at, v)| *v += follows[at / p] * follows[at % p]);
    }
    out
}

/// Fits the offsets of some parts about an estimate.
fn offsets(setup: &Setup<'_>, estimate: &Estimate, parts: &[(&Part, f64)]) -> Result<Option<Geometry>, StiffnessError> {
    let Some(x) = estimate.state.x.as_deref().filter(|_| !parts.is_empty()) else { return Ok(None) };
    let (columns, force_slope, changes) = columns(setup, estimate, x, parts)?;
    let rows: Vec<Vec<[f64; 3]>> = estimate.rows.iter().cloned().chain(columns).collect();
    let p = rows.len();
    let mut prior = setup.prior_terms(&estimate.state);
    prior.extend(parts.iter().map(|(part, moved)| (part.sigma.powi(-2), *moved)));
    let scale = setup.scale(&estimate.residuals);
    let weights = setup.weights(&estimate.residuals, scale);
    let variance = setup.variance(estimate);
    let blocks = grouped_normal(setup.observations, &rows, &estimate.residuals, &weights);
    let mut a = vec![0.0; p * p];
    let mut step = vec![0.0; p];
    for block in &blocks {
        a.iter_mut().zip(&block.normal).for_each(|(v, b)| *v += b / variance);
        step.iter_mut().zip(&block.score).for_each(|(v, b)| *v += b / variance);
    }
    for (k, (weight, distance)) in prior.iter().enumerate() {
        a[k * p + k] += weight;
        step[k] -= weight * distance;
    }
    // What would go far beyond what is open stops there.
    let first = p - parts.len();
    let free = std::iter::repeat_n([f64::NEG_INFINITY, f64::INFINITY], first);
    // The open parts come last.
    let fixed = parts.len() - setup.open.len();
    let limited = parts.iter().enumerate().map(|(k, (part, moved))| {
        let most = part.most * part.sigma;
        let stays = setup.settled && k >= fixed;
        if stays { [0.0; 2] } else { [(-most - moved).min(0.0), (most - moved).max(0.0)] }
    });
    let room: Vec<[f64; 2]> = free.chain(limited).collect();
    let step = within(&a, &step, &room).ok_or(StiffnessError::Unsolvable)?;
    let rest: Vec<[f64; 3]> = (0..estimate.residuals.len())
        .map(|i| {
            std::array::from_fn(|c| estimate.residuals[i][c] - (0..p).map(|k| step[k] * rows[k][i][c]).sum::<f64>())
        })
        .collect();
    let blocks = grouped_normal(setup.observations, &rows, &rest, &weights);
    let squares: f64 = rest.iter().zip(&weights).map(|(r, w)| w * r.iter().map(|v| v * v).sum::<f64>()).sum();
    let samples = 3.0 * rest.len() as f64;
    let (raw, squares) = (squares, squares.max(samples * setup.floor * setup.floor));
    let (by_data, information, _) = covariance(&blocks, &prior, squares, samples)?;
    let covariance = with_mesh(by_data, p, first, 1.0);
    let found = || parts.iter().zip(&step[first..]).map(|((part, moved), step)| (part, moved + step));
    let faces = found().filter_map(|(part, offset)| part.name.clone().map(|name| (name, offset))).collect();
    let shapes = found().filter(|(part, _)| part.name.is_none()).map(|(_, offset)| offset).collect();
    let rms = (rest.iter().flatten().map(|r| r * r).sum::<f64>() / samples).sqrt();
    let fit = Fit { rows, information, prior, rms, squares, raw: raw / squares.max(f64::MIN_POSITIVE) };
    Ok(Some(Geometry { faces, shapes, step, covariance, force_slope, changes, fit }))
}

/// Box faces (voxel axis, positive side) that the surface fills by [`MIN_BOX_FACE_FRACTION`] or
/// more.
fn flat_faces(body: &Body, grid: &Grid) -> Vec<Part> {
    let voxel = |p: [f64; 3]| grid.affine().to_voxel(WorldPoint(p)).0;
    let [low, high] = bounds(body, grid);
    let spacing = grid.spacing();
    let mut out = Vec::new();
    for axis in 0..3 {
        let (b, c) = ((axis + 1) % 3, (axis + 2) % 3);
        let area = (high[b] - low[b]) * spacing[b] * (high[c] - low[c]) * spacing[c];
        for positive in [false, true] {
            let end = if positive { high[axis] } else { low[axis] };
            let on = |n: &u32| (voxel(body.places[*n as usize])[axis] - end).abs() < 0.3;
            let flat: f64 = body.surface.iter().filter(|f| f.nodes[..3].iter().all(on)).map(|f| f.area).sum();
            if flat > MIN_BOX_FACE_FRACTION * area {
                out.push(Part::face(body, grid, axis, positive));
            }
        }
    }
    out
}

fn bounds(body: &Body, grid: &Grid) -> [[f64; 3]; 2] {
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for p in &body.places {
        let q = grid.affine().to_voxel(WorldPoint(*p)).0;
        for a in 0..3 {
            low[a] = low[a].min(q[a]);
            high[a] = high[a].max(q[a]);
        }
    }
    [low, high]
}
