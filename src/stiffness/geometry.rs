//! Flat faces that a voxel map tells to half a voxel only.
//!
//! A flat face along the voxels' axes lies anywhere within one voxel: 0.29 voxel, one standard deviation (a curved one crosses
//! the voxels at all heights, and is known much better). A plate half a voxel away from where the mesh has it changes strain
//! and modulus by a percent or two. So each such face gets an offset of its own, with that prior, and is fitted together
//! with moduli and plates in one Gauss-Newton step on the coarse mesh; its columns are differences of two solutions.

use crate::error::StiffnessError;
use crate::stiffness::body::Body;
use crate::stiffness::identify::{Estimate, Setup, covariance, grouped_normal};
use crate::stiffness::observations::find;
use crate::types::{Grid, VoxelPoint, WorldPoint};

/// One standard deviation of a flat face (voxels): uniform over one voxel.
const FACE: f64 = 0.288_675;
/// Least part of the box's face that a flat face fills.
const FLAT: f64 = 0.2;
/// Samples (components) for each independent one, at least: on a body of a few hundred cubic voxels' size the errors of a
/// rounded edge reach that far.
const DILUTION: f64 = 100.0;
/// Power of the distance from the middle with which an offset fades inwards: the outermost tenth moves by two thirds or more.
const FADE: i32 = 4;
/// Precision of the solutions (mm).
const PRECISION: f64 = 1e-6;

/// What the faces' offsets change.
#[derive(Debug, Clone, Default)]
pub struct Geometry {
    /// The faces, as `+0` ... by voxel axis, and their offsets outwards (voxels).
    pub faces: Vec<(String, f64)>,
    /// Change of all parameters, then the offsets (voxels).
    pub step: Vec<f64>,
    /// Covariance of the same, row by row.
    pub covariance: Vec<f64>,
    /// Derivative of ln force by each offset (1/voxel).
    pub force_slope: Vec<f64>,
}

/// Fits the faces' offsets about an estimate; none when the body has no flat face.
///
/// # Errors
/// As [`Setup::run`].
pub fn fit(setup: &Setup<'_>, estimate: &Estimate, grid: &Grid) -> Result<Option<Geometry>, StiffnessError> {
    let faces = flat_faces(setup.body, grid);
    let Some(x) = estimate.state.x.as_deref().filter(|_| !faces.is_empty()) else { return Ok(None) };
    let places: Vec<[f64; 3]> = setup.observations.iter().map(|o| o.place).collect();
    let mut rows = estimate.rows.clone();
    let factor = setup.problem(&estimate.state).factorise(x)?;
    let mut force_slope = Vec::new();
    for &(axis, positive) in &faces {
        let body = shifted(setup.body, grid, axis, positive, FACE);
        let found = find(&body, &places);
        let moved = Setup { body: &body, ..setup.clone() };
        let problem = moved.problem(&estimate.state);
        let y = match problem.solve_near(x, &factor, PRECISION) {
            Some(y) => y,
            None => problem.solve(Some(x), PRECISION)?.x,
        };
        let column = setup.observations.iter().zip(&found).map(|(o, f)| {
            let old = o.read(setup.body, x);
            f.map_or([0.0; 3], |(element, weights)| {
                let new = crate::stiffness::observations::Observation { element, weights, ..*o }.read(&body, &y);
                std::array::from_fn(|a| (new[a] - old[a]) / FACE)
            })
        });
        rows.push(column.collect());
        let force = moved.forces(&problem, &estimate.state, &y)[0];
        force_slope.push((force / estimate.force[0]).ln() / FACE);
    }
    let p = rows.len();
    let mut prior = setup.prior_terms(&estimate.state);
    prior.extend(faces.iter().map(|_| (FACE.powi(-2), 0.0)));
    let scale = setup.scale(&estimate.residuals);
    let weights = setup.weights(&estimate.residuals, scale);
    // Residuals hang together: as many independent samples as the estimate found, and no more than a model that knows the
    // surface this badly can claim.
    let dilution = (3.0 * estimate.residuals.len() as f64 / estimate.effective).max(DILUTION);
    let blocks = grouped_normal(setup.observations, &rows, &estimate.residuals, &weights);
    let variance = estimate.squares / (3.0 * estimate.residuals.len() as f64) * dilution;
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
    let factor = crate::numerics::cholesky::Cholesky::new(a, p).ok_or(StiffnessError::Unsolvable)?;
    factor.solve(&mut step);
    let rest: Vec<[f64; 3]> = (0..estimate.residuals.len())
        .map(|i| {
            std::array::from_fn(|c| estimate.residuals[i][c] - (0..p).map(|k| step[k] * rows[k][i][c]).sum::<f64>())
        })
        .collect();
    let blocks = grouped_normal(setup.observations, &rows, &rest, &weights);
    let squares: f64 = rest.iter().zip(&weights).map(|(r, w)| w * r.iter().map(|v| v * v).sum::<f64>()).sum();
    let (covariance, _, _) = covariance(&blocks, &prior, squares, 3.0 * rest.len() as f64)?;
    let first = p - faces.len();
    if step[first..].iter().any(|v| v.abs() > 1.0) {
        // Beyond a voxel it is not the face that is wrong.
        return Ok(None);
    }
    let name = |k: usize| format!("{}{}", if faces[k].1 { '+' } else { '-' }, faces[k].0);
    let faces = (0..faces.len()).map(|k| (name(k), step[first + k])).collect();
    Ok(Some(Geometry { faces, step, covariance, force_slope }))
}

/// Box faces (voxel axis, positive side) that the surface fills by [`FLAT`] or more.
fn flat_faces(body: &Body, grid: &Grid) -> Vec<(usize, bool)> {
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
            if flat > FLAT * area {
                out.push((axis, positive));
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

/// The body with one face moved outwards by `offset` voxels.
fn shifted(body: &Body, grid: &Grid, axis: usize, positive: bool, offset: f64) -> Body {
    let [low, high] = bounds(body, grid);
    let middle = 0.5 * (low[axis] + high[axis]);
    let place = |p: &[f64; 3]| {
        let mut q = grid.affine().to_voxel(WorldPoint(*p)).0;
        let part = (q[axis] - middle) / (high[axis] - middle);
        let part = if positive { part } else { -part };
        if part > 0.0 {
            q[axis] += if positive { offset } else { -offset } * part.powi(FADE);
        }
        grid.affine().to_world(VoxelPoint(q)).0
    };
    body.with_places(body.places.iter().map(place).collect())
}
