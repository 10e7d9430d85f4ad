//! Measured displacements at the nodes of a user's mesh, with the covariance of their error.
//!
//! The displacement at a node is an affine fit to the voxels of the body around it, as at the
//! surface of our own meshes: nothing outside of the body is read. `uncertainty.nii.gz` gives the
//! size of the covariance, and the draws of `posterior.nii.gz` its directions.

use crate::numerics::sampling::{Stencil, nearest};
use crate::stiffness::observations::{SURFACE_REACH_VOXELS, at_surface};
use crate::strain::deviation::{DRAW_SMOOTHING_NODES, errors_at};
use crate::types::{
    DenseField, ElementModulus, ErrorSamples, Mask, MeasuredNode, SolidMesh, StiffnessResult, Volume, VoxelPoint,
    WorldPoint,
};
use rayon::prelude::*;

/// What is known of the motion.
#[derive(Debug, Clone, Copy)]
pub struct Known<'a> {
    /// The displacement (mm, RAS).
    pub field: &'a DenseField,
    /// The body, on the field's grid; 0 outside.
    pub body: &'a Mask,
    /// One standard deviation along an axis (mm), on the field's grid.
    pub deviation: Option<&'a Volume>,
    /// Draws of the field's error.
    pub draws: Option<&'a ErrorSamples>,
}

/// What was measured at `nodes` of a mesh, in that order, under the name `patch`. Nodes more than a
/// voxel outside of the body, or where the field gives nothing, are left out.
///
/// ```
/// use palpate::pipeline::boundary::{Known, at_nodes};
/// use palpate::types::SolidMesh;
/// use palpate::{Affine, DenseField, Grid, Mask, WorldPoint};
/// let grid = Grid::new([16; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let field = DenseField::from_fn(grid, |_| [0.0, 0.0, -1.5]);
/// let body = Mask::filled(grid, 1);
/// let mesh = SolidMesh::new(
///     vec![WorldPoint([8.0; 3]), WorldPoint([99.0; 3])],
///     vec![1, 2],
///     Vec::new(),
///     Vec::new(),
/// )?;
/// let known = Known { field: &field, body: &body, deviation: None, draws: None };
/// let found = at_nodes(&known, &mesh, &[0, 1], "top");
/// // The second node lies outside the body.
/// assert_eq!(found.len(), 1);
/// assert!((found[0].displacement[2] + 1.5).abs() < 1e-6);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn at_nodes(known: &Known<'_>, mesh: &SolidMesh, nodes: &[u32], patch: &str) -> Vec<MeasuredNode> {
    let one = |&node: &u32| {
        let place = mesh.nodes()[node as usize];
        let (displacement, _) = beside_body(known.body, place)
            .then(|| at_surface(known.field, known.body, place.0, SURFACE_REACH_VOXELS))??;
        Some(MeasuredNode { node, patch: patch.into(), displacement, covariance: covariance(known, place) })
    };
    nodes.par_iter().filter_map(one).collect()
}

/// Whether a place lies in a voxel of the body or in one that touches it.
fn beside_body(body: &Mask, place: WorldPoint) -> bool {
    let at = body.grid().affine().to_voxel(place).0;
    let steps = [-1.0, 0.0, 1.0];
    let around = steps.into_iter().flat_map(|i| steps.into_iter().flat_map(move |j| steps.map(|k| [i, j, k])));
    let mut voxels = around.map(|d| VoxelPoint(std::array::from_fn(|a| at[a] + d[a])));
    voxels.any(|v| nearest(body.grid().shape(), v).is_some_and(|o| body.as_slice()[o] > 0))
}

/// Covariance of the error at a place (mm^2): xx, xy, xz, yy, yz, zz.
fn covariance(known: &Known<'_>, place: WorldPoint) -> Option<[f64; 6]> {
    let map = known.deviation?;
    let grid = map.grid();
    let sigma = Stencil::new(grid.shape(), grid.affine().to_voxel(place)).of(map.as_slice());
    if !(sigma.is_finite() && sigma >= 0.0) {
        return None;
    }
    let round = [1.0, 0.0, 0.0, 1.0, 0.0, 1.0];
    let directions = known.draws.and_then(|draws| directions(draws, place)).unwrap_or(round);
    Some(directions.map(|d| d * sigma * sigma))
}

/// The covariance of the draws around a place, scaled to a mean variance of 1.
fn directions(draws: &ErrorSamples, place: WorldPoint) -> Option<[f64; 6]> {
    let nodes = draws.nodes();
    let steps = |a: usize| if nodes.shape()[a] > 1 { -1..=1 } else { 0..=0 };
    let at = nodes.affine().to_voxel(place).0;
    let mut sum = [0.0; 6];
    for k in steps(2) {
        for j in steps(1) {
            for i in steps(0) {
                let step = [i, j, k].map(f64::from);
                let near = nodes.affine().to_world(VoxelPoint(std::array::from_fn(|a| at[a] + step[a])));
                let apart: f64 = step.iter().map(|s| s * s).sum();
                let weight = (-0.5 * apart / (DRAW_SMOOTHING_NODES * DRAW_SMOOTHING_NODES)).exp();
                for [x, y, z] in errors_at(draws, near) {
                    let products = [x * x, x * y, x * z, y * y, y * z, z * z];
                    sum.iter_mut().zip(products).for_each(|(s, p)| *s += weight * p);
                }
            }
        }
    }
    let mean = (sum[0] + sum[3] + sum[5]) / 3.0;
    (mean > 0.0 && mean.is_finite()).then(|| sum.map(|s| s / mean))
}

/// What the elements of a mesh are made of, by the voxel that each centroid lies in; `labels` name
/// the regions. None outside of the body.
pub fn moduli(mesh: &SolidMesh, labels: &Mask, result: &StiffnessResult) -> Vec<Option<ElementModulus>> {
    let grid = labels.grid();
    let one = |element| {
        let at = nearest(grid.shape(), grid.affine().to_voxel(mesh.centroid(element)))?;
        let label = labels.as_slice()[at];
        let modulus = f64::from(result.map.as_slice()[at]);
        (label > 0).then(|| ElementModulus { label, modulus, poisson: result.poisson_of(label) })
    };
    mesh.elements().iter().map(one).collect()
}
