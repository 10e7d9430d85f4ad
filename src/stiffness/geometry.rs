//! What a voxel map or a field tells of the body's shape to a part of a voxel only: flat faces, and
//! the edge of a punch.
//!
//! A flat face along the voxels' axes lies anywhere within one voxel: 0.29 voxel, one standard
//! deviation (a curved one crosses the voxels at all heights, and is known much better). A plate
//! half a voxel away from where the mesh has it changes strain and modulus by a percent or two. So
//! each such face gets an offset of its own, with that prior, and is fitted together with moduli
//! and plates in one Gauss-Newton step on the coarse mesh; its columns are differences of two
//! solutions.
//!
//! Where the surface beside a flat punch is free, strain under its edge is singular, and a thin
//! layer there hangs on where the edge is. A field tells that to half a voxel at best, and rounds
//! it where it was measured from images. So the edge has an offset as well, all around.

use crate::error::StiffnessError;
use crate::stiffness::body::Body;
use crate::stiffness::identify::{Estimate, Setup, covariance, grouped_normal};
use crate::stiffness::inclusion::{Inclusion, SHAPES};
use crate::stiffness::interface::{Interface, fade};
use crate::stiffness::observations::{find, read};
use crate::stiffness::patches::Patch;
use crate::types::space::{dot, length};
use crate::types::{Grid, VoxelPoint, WorldPoint};

/// One standard deviation of a flat face (voxels): uniform over one voxel.
const FACE: f64 = 0.288_675;
/// One standard deviation of the edge of a punch (voxels).
const EDGE: f64 = 3.0;
/// One standard deviation with which a mesh keeps to a flat interface (voxels): surfaces are moved
/// by hundredths until volumes agree.
const MESHED: f64 = 0.02;
/// Free surface beside a punch at least (voxels).
const BESIDE: f64 = 3.0;
/// Least part of the box's face that a flat face fills.
const FLAT: f64 = 0.2;
/// Samples (components) for each independent one, at least: on a body of a few hundred cubic
/// voxels' size the errors of a rounded edge reach that far.
const DILUTION: f64 = 100.0;
/// Power of the distance from the middle with which an offset fades inwards: the outermost tenth
/// moves by two thirds or more.
const FADE: i32 = 4;
/// Precision of the solutions (mm).
const PRECISION: f64 = 1e-6;

/// What has an offset.
#[derive(Debug, Clone, Copy)]
enum Part<'a> {
    /// A flat face: voxel axis, and whether it is the upper one.
    Face(usize, bool),
    /// The edge of the loaded patch.
    Edge(Edge),
    /// A flat border between two labels.
    Interface(&'a Interface),
    /// The surface of a region that was found without labels: how its shapes move the nodes (mm),
    /// which one, and one standard deviation (mm).
    Inclusion(&'a [[[f64; 3]; SHAPES]], usize, f64),
}

impl Part<'_> {
    /// One standard deviation (voxels) on voxels of `voxel` mm.
    fn sigma(self, voxel: f64) -> f64 {
        match self {
            Part::Face(..) | Part::Interface(_) => FACE,
            Part::Edge(_) => EDGE,
            Part::Inclusion(.., sigma) => sigma / voxel,
        }
    }

    /// The most standard deviations that it may come to. The mesh rounds the edges in which the
    /// walls of a hole meet, which makes it stiffer there, and the walls answer for that as well: a
    /// channel of 12 by 10 voxels came to 1.5 voxels.
    fn most(self) -> f64 {
        match self {
            Part::Interface(interface) if interface.is_wall() => 6.0,
            _ => 3.5,
        }
    }

    /// None for a shape.
    fn name(self) -> Option<String> {
        match self {
            Part::Face(axis, upper) => Some(format!("{}{axis}", if upper { '+' } else { '-' })),
            Part::Edge(_) => Some("edge".into()),
            Part::Interface(interface) => Some(interface.name()),
            Part::Inclusion(..) => None,
        }
    }

    /// The body with this part moved outwards by `offset` voxels.
    fn moved(self, body: &Body, grid: &Grid, offset: f64) -> Body {
        match self {
            Part::Face(axis, upper) => shifted(body, grid, axis, upper, offset),
            Part::Edge(edge) => {
                let wider = offset * grid.least_spacing();
                body.with_places(body.places.iter().map(|p| edge.widened(*p, wider)).collect())
            }
            Part::Interface(interface) => {
                body.with_places(body.places.iter().map(|p| interface.moved(*p, grid, offset)).collect())
            }
            Part::Inclusion(nodes, shape, _) => {
                let by = offset * grid.least_spacing();
                let place = |(p, u): (&[f64; 3], &[[f64; 3]; SHAPES])| std::array::from_fn(|a| p[a] + by * u[shape][a]);
                body.with_places(body.places.iter().zip(nodes).map(place).collect())
            }
        }
    }
}

/// The edge of a flat punch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Edge {
    middle: [f64; 3],
    normal: [f64; 3],
    /// Of the punch (mm): of a round one, or between the half side and the half diagonal of a
    /// square one.
    radius: f64,
    /// Distance from the edge over which the surface beside it gives way (mm).
    beside: f64,
}

impl Edge {
    /// None where a patch is curved, or reaches to the end of its side. `voxel` is the least voxel
    /// size (mm).
    pub fn of(patch: &Patch, body: &Body, voxel: f64) -> Option<Self> {
        if patch.curved() {
            return None;
        }
        let mut edge =
            Self { middle: patch.middle, normal: patch.normal, radius: 2f64.sqrt() * patch.radius, beside: 0.0 };
        let upright = body.surface.iter().filter(|f| dot(f.normal, patch.normal).abs() < 0.5);
        let near = |p: &[f64; 3]| edge.apart(*p).1.abs() < edge.radius;
        let places = upright.flat_map(|f| f.nodes).map(|n| body.places[n as usize]).filter(near);
        let end = places.map(|p| length(edge.apart(p).0)).fold(f64::INFINITY, f64::min);
        edge.beside = (end - edge.radius).min(edge.radius);
        (edge.beside > BESIDE * voxel).then_some(edge)
    }

    /// Of the punch (mm).
    pub fn radius(&self) -> f64 {
        self.radius
    }

    /// Across and along the normal from the middle of the patch (mm).
    fn apart(&self, p: [f64; 3]) -> ([f64; 3], f64) {
        let d: [f64; 3] = std::array::from_fn(|a| p[a] - self.middle[a]);
        let height = dot(d, self.normal);
        (std::array::from_fn(|a| d[a] - height * self.normal[a]), height)
    }

    /// Where `p` comes to lie when the punch is wider by `offset` (mm) all around: what is below
    /// moves less and less.
    pub fn widened(&self, p: [f64; 3], offset: f64) -> [f64; 3] {
        let (across, height) = self.apart(p);
        let beyond = ((length(across) - self.radius) / self.beside).max(0.0);
        let below = (height.abs() / self.radius).min(1.0);
        let part = fade(beyond) * (1.0 - below).powi(2);
        std::array::from_fn(|a| p[a] + offset * part * across[a] / self.radius)
    }
}

/// What the offsets change.
#[derive(Debug, Clone, Default)]
pub struct Geometry {
    /// Faces, as `+0` ... by voxel axis, `edge`, and interfaces ([`Interface::name`]), and their
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
    (interfaces, inclusions): (&[Interface], &[Inclusion]),
) -> Result<Option<Geometry>, StiffnessError> {
    let mut parts = flat_faces(setup.body, grid);
    parts.extend(setup.edge.map(|(edge, _)| Part::Edge(edge)));
    let moving: Vec<_> = inclusions.iter().map(|i| (i.shapes(&setup.body.places), i.prior())).collect();
    parts.extend(moving.iter().flat_map(|(nodes, sigma)| (0..SHAPES).map(|k| Part::Inclusion(nodes, k, *sigma))));
    let without = parts.len();
    let (walls, borders): (Vec<_>, Vec<_>) = interfaces.iter().partition(|i| i.is_wall());
    parts.extend(borders.into_iter().map(Part::Interface));
    let without_walls = parts.len();
    parts.extend(walls.into_iter().map(Part::Interface));
    // Labels that are wrong by more than a voxel do not take the faces with them, nor walls the
    // labels.
    let mut counts = vec![parts.len(), without_walls, without];
    counts.dedup();
    for count in counts {
        if let Some(found) = offsets(setup, estimate, grid, &parts[..count])? {
            return Ok(Some(found));
        }
    }
    Ok(None)
}

/// How much further outwards the edge of the punch lies (voxels), for all that the data say; none
/// where there is no such edge.
///
/// # Errors
/// As [`Setup::run`].
pub fn edge_step(setup: &Setup<'_>, estimate: &Estimate, grid: &Grid) -> Result<Option<f64>, StiffnessError> {
    let Some((edge, _)) = setup.edge else { return Ok(None) };
    Ok(offsets(setup, estimate, grid, &[Part::Edge(edge)])?.map(|g| g.faces[0].1))
}

/// Fits the offsets of some parts about an estimate.
fn offsets(
    setup: &Setup<'_>,
    estimate: &Estimate,
    grid: &Grid,
    parts: &[Part<'_>],
) -> Result<Option<Geometry>, StiffnessError> {
    let Some(x) = estimate.state.x.as_deref().filter(|_| !parts.is_empty()) else { return Ok(None) };
    let places: Vec<[f64; 3]> = setup.observations.iter().map(|o| o.place).collect();
    // What an offset changes is smooth: it is read in the middle of a block.
    let before = find(setup.body, &places);
    let mut rows = estimate.rows.clone();
    let factor = setup.problem(&estimate.state).factorise(x)?;
    let mut force_slope = Vec::new();
    for part in parts {
        let body = part.moved(setup.body, grid, FACE);
        let found = find(&body, &places);
        let moved = Setup { body: &body, ..setup.clone() };
        let problem = moved.problem(&estimate.state);
        let y = match problem.solve_near(x, &factor, PRECISION) {
            Some(y) => y,
            None => problem.solve(Some(x), PRECISION)?.x,
        };
        let column = before.iter().zip(&found).map(|(before, now)| match (before, now) {
            (Some(before), Some(now)) => {
                let (old, new) = (read(&[*before], setup.body, x), read(&[*now], &body, &y));
                std::array::from_fn(|a| (new[a] - old[a]) / FACE)
            }
            _ => [0.0; 3],
        });
        rows.push(column.collect());
        let force = moved.forces(&problem, &estimate.state, &y)[0];
        force_slope.push((force / estimate.force[0]).ln() / FACE);
    }
    let (p, voxel) = (rows.len(), grid.least_spacing());
    let mut prior = setup.prior_terms(&estimate.state);
    // The edge has been moved already.
    let moved = |part: &Part<'_>| if matches!(part, Part::Edge(_)) { setup.edge.map_or(0.0, |e| e.1) } else { 0.0 };
    prior.extend(parts.iter().map(|part| (part.sigma(voxel).powi(-2), moved(part))));
    let scale = setup.scale(&estimate.residuals);
    let weights = setup.weights(&estimate.residuals, scale);
    // Residuals hang together: as many independent samples as the estimate found, and no more than
    // a model that knows the surface this badly can claim.
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
    let (mut covariance, _, _) = covariance(&blocks, &prior, squares, 3.0 * rest.len() as f64)?;
    let first = p - parts.len();
    // What the mesh itself is off by, however well the data tell the place: all else follows it as
    // it would another place.
    let by_data = covariance.clone();
    for k in (first..p).filter(|k| matches!(parts[k - first], Part::Interface(_))) {
        let follows: Vec<f64> = (0..p).map(|i| MESHED * by_data[i * p + k] / by_data[k * p + k]).collect();
        covariance.iter_mut().enumerate().for_each(|(at, v)| *v += follows[at / p] * follows[at % p]);
    }
    if step[first..].iter().zip(parts).any(|(v, part)| (v + moved(part)).abs() > part.most() * part.sigma(voxel)) {
        // So far beyond what a voxel map leaves open it is not the shape that is wrong.
        return Ok(None);
    }
    let found = || parts.iter().zip(step[first..].iter().copied());
    let faces = found().filter_map(|(part, offset)| part.name().map(|name| (name, offset))).collect();
    let shapes = found().filter(|(part, _)| matches!(part, Part::Inclusion(..))).map(|(_, offset)| offset).collect();
    Ok(Some(Geometry { faces, shapes, step, covariance, force_slope }))
}

/// Box faces (voxel axis, positive side) that the surface fills by [`FLAT`] or more.
fn flat_faces(body: &Body, grid: &Grid) -> Vec<Part<'static>> {
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
                out.push(Part::Face(axis, positive));
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
