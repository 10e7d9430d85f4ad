//! Node displacements of a mesh to a dense field: barycentric (piecewise linear), by filling each element.
//!
//! Promises: every voxel whose centre lies in the mesh gets a value, voxels on a shared facet get the same from either
//! side up to rounding, a linear field comes back to f32 rounding, and the result does not depend on the number of
//! threads. Voxels outside the mesh keep zero, and the mask says which those are. Time grows with the number of
//! elements and the voxels they hold.
//!
//! Elements are filled in voxel coordinates, where any affine grid is the unit lattice and barycentric weights are what
//! they were. An element thinner than [`THIN`] yields to the others at voxels that both hold, since its gradient is all
//! rounding.

use crate::error::MeshError;
use crate::types::space::{cross, dot};
use crate::types::{DenseField, Grid, Mask, TetMesh, TriMesh, Volume, WorldPoint};
use rayon::prelude::*;

/// Voxel centres this far (voxels) outside of an element are filled too, so that rounding leaves no gaps.
const TOLERANCE: f64 = 1e-9;

/// Least height over length of an element that is not a sliver.
const THIN: f64 = 1e-6;

/// Slices filled by one task.
const SLAB: usize = 8;

/// A field inside of a mesh.
#[derive(Debug, Clone, PartialEq)]
pub struct Interpolated {
    /// Displacement (mm, RAS); zero outside of the mesh.
    pub displacement: DenseField,
    /// 1 where the voxel's centre lies in the mesh.
    pub inside: Mask,
}

/// The displacement at the voxel centres of `grid` inside the tetrahedra, from one displacement (mm) a node.
///
/// # Errors
/// [`MeshError::Length`] when there are not as many displacements as nodes.
pub fn interpolate_tetrahedra(
    mesh: &TetMesh,
    displacement: &[[f64; 3]],
    grid: &Grid,
) -> Result<Interpolated, MeshError> {
    let nodes = voxel_nodes(mesh.nodes(), displacement, grid)?;
    Ok(fill_elements(mesh.tetrahedra(), &nodes, displacement, grid, tetrahedron_gradients))
}

/// The same for triangles on a grid of one slice; nodes are taken to their foot on the slice.
///
/// # Errors
/// [`MeshError::Length`] as above; [`MeshError::NotOneSlice`] when the grid is thicker than one voxel along every axis.
pub fn interpolate_triangles(
    mesh: &TriMesh,
    displacement: &[[f64; 3]],
    grid: &Grid,
) -> Result<Interpolated, MeshError> {
    let shape = grid.shape();
    // The last such axis: a row of voxels is a slice too.
    let axis = shape.iter().rposition(|&s| s == 1).ok_or(MeshError::NotOneSlice { shape })?;
    let mut nodes = voxel_nodes(mesh.nodes(), displacement, grid)?;
    nodes.iter_mut().for_each(|p| p[axis] = 0.0);
    Ok(fill_elements(mesh.triangles(), &nodes, displacement, grid, |x| triangle_gradients(x, axis)))
}

/// Nodes in voxel coordinates.
fn voxel_nodes(nodes: &[WorldPoint], displacement: &[[f64; 3]], grid: &Grid) -> Result<Vec<[f64; 3]>, MeshError> {
    if displacement.len() != nodes.len() {
        return Err(MeshError::Length { expected: nodes.len(), found: displacement.len() });
    }
    Ok(nodes.iter().map(|&p| grid.affine().to_voxel(p).0).collect())
}

/// The gradient of each barycentric weight, over the common determinant that comes second (six times the volume).
fn tetrahedron_gradients(x: &[[f64; 3]; 4]) -> ([[f64; 3]; 4], f64) {
    let [u, v, w] = [1, 2, 3].map(|i| minus(x[i], x[0]));
    let (b, c, d) = (cross(v, w), cross(w, u), cross(u, v));
    ([std::array::from_fn(|k| -(b[k] + c[k] + d[k])), b, c, d], dot(u, b))
}

/// The same in the slice across `axis` (the determinant is twice the signed area).
fn triangle_gradients(x: &[[f64; 3]; 3], axis: usize) -> ([[f64; 3]; 3], f64) {
    let mut normal = [0.0; 3];
    normal[axis] = 1.0;
    let [u, v] = [1, 2].map(|i| minus(x[i], x[0]));
    let (b, c) = (cross(v, normal), cross(normal, u));
    ([std::array::from_fn(|k| -(b[k] + c[k])), b, c], dot(u, b))
}

/// One slab of the result: `SLAB` slices of each component and of the mask.
struct Slab<'a> {
    components: [&'a mut [f32]; 3],
    inside: &'a mut [u8],
    first: usize,
    shape: [usize; 3],
}

/// Fills all elements, slab by slab in parallel.
fn fill_elements<const N: usize>(
    elements: &[[u32; N]],
    nodes: &[[f64; 3]],
    displacement: &[[f64; 3]],
    grid: &Grid,
    gradients: impl Fn(&[[f64; 3]; N]) -> ([[f64; 3]; N], f64) + Sync,
) -> Interpolated {
    let shape = grid.shape();
    let corners = |e: u32| elements[e as usize].map(|v| nodes[v as usize]);
    let queues = queues(elements.len(), shape[2], |e| {
        let x = corners(e);
        let (_, determinant) = gradients(&x);
        let edges: [f64; 3] = std::array::from_fn(|k| extent(&x, k)[1] - extent(&x, k)[0]);
        let bound = THIN * dot(edges, edges).sqrt().powi(N as i32 - 1);
        (voxel_range(&x, 2, shape[2]), determinant.abs() <= bound)
    });
    let mut displacements = DenseField::zeros(*grid);
    let mut inside = Volume::filled(*grid, 0u8);
    let (n, plane) = (grid.len(), SLAB * shape[0] * shape[1]);
    let (right, rest) = displacements.as_mut_slice().split_at_mut(n);
    let (front, up) = rest.split_at_mut(n);
    let parts = right.par_chunks_mut(plane).zip(front.par_chunks_mut(plane)).zip(up.par_chunks_mut(plane));
    parts.zip(inside.as_mut_slice().par_chunks_mut(plane)).zip(&queues).enumerate().for_each(
        |(s, ((((right, front), up), inside), queue))| {
            let mut slab = Slab { components: [right, front, up], inside, first: s * SLAB, shape };
            for &e in queue {
                let values = elements[e as usize].map(|v| displacement[v as usize]);
                let x = corners(e);
                let (weights, determinant) = gradients(&x);
                if determinant != 0.0 {
                    slab.fill(&x, &values, &weights.map(|g| g.map(|v| v / determinant)));
                }
            }
        },
    );
    Interpolated { displacement: displacements, inside }
}

/// The elements that touch each slab: first the thin ones, then the others, each in the mesh's order. `place` gives an
/// element's slices and whether it is thin.
fn queues(elements: usize, slices: usize, place: impl Fn(u32) -> (std::ops::Range<usize>, bool)) -> Vec<Vec<u32>> {
    let mut queues = vec![[Vec::new(), Vec::new()]; slices.div_ceil(SLAB)];
    for e in 0..elements as u32 {
        let (range, thin) = place(e);
        if !range.is_empty() {
            for queue in &mut queues[range.start / SLAB..=(range.end - 1) / SLAB] {
                queue[usize::from(!thin)].push(e);
            }
        }
    }
    queues.into_iter().map(|[thin, others]| [thin, others].concat()).collect()
}

impl Slab<'_> {
    /// Fills one element with corners `x` (voxels), `values` (mm) there, and the `gradients` of its weights.
    fn fill<const N: usize>(&mut self, x: &[[f64; 3]; N], values: &[[f64; 3]; N], gradients: &[[f64; 3]; N]) {
        // Inside is where each signed distance `offset + normal . p` is at least minus the tolerance.
        let faces: [([f64; 3], f64); N] = std::array::from_fn(|i| {
            let length = dot(gradients[i], gradients[i]).sqrt();
            let normal = gradients[i].map(|v| v / length);
            (normal, TOLERANCE - dot(normal, x[(i + 1) % N]))
        });
        if faces.iter().any(|(normal, _)| !dot(*normal, *normal).is_finite()) {
            return;
        }
        let slope: [[f64; 3]; 3] = std::array::from_fn(|c| {
            std::array::from_fn(|k| (1..N).map(|i| (values[i][c] - values[0][c]) * gradients[i][k]).sum())
        });
        let range: [[f64; 2]; 3] = std::array::from_fn(|c| extent(values, c));
        let rows = voxel_range(x, 1, self.shape[1]);
        let columns = voxel_range(x, 0, self.shape[0]);
        let slices = voxel_range(x, 2, self.first + self.inside.len() / (self.shape[0] * self.shape[1]));
        for k in slices.start.max(self.first)..slices.end {
            for j in rows.clone() {
                let (mut low, mut high) = (columns.start as f64, columns.end as f64 - 1.0);
                for (normal, offset) in &faces {
                    let at = offset + normal[1] * j as f64 + normal[2] * k as f64;
                    // A face along the row cuts all of it or nothing.
                    if normal[0] > 1e-12 {
                        low = low.max(-at / normal[0]);
                    } else if normal[0] < -1e-12 {
                        high = high.min(-at / normal[0]);
                    } else if at < 0.0 {
                        high = -1.0;
                    }
                }
                if high < low {
                    continue;
                }
                let (from, to) = (low.ceil() as usize, high as usize + 1);
                if from >= to {
                    continue;
                }
                let row = self.shape[0] * (j + self.shape[1] * (k - self.first));
                self.inside[row + from..row + to].fill(1);
                for c in 0..3 {
                    let start = values[0][c] + dot(slope[c], minus([from as f64, j as f64, k as f64], x[0]));
                    let [least, most] = range[c];
                    for (i, out) in self.components[c][row + from..row + to].iter_mut().enumerate() {
                        // Between the corners' values, where rounding would leave that range in a thin element.
                        *out = (start + slope[c][0] * i as f64).max(least).min(most) as f32;
                    }
                }
            }
        }
    }
}

fn minus(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|k| a[k] - b[k])
}

/// Least and greatest of component `k`.
fn extent(vectors: &[[f64; 3]], k: usize) -> [f64; 2] {
    vectors.iter().fold([f64::INFINITY, f64::NEG_INFINITY], |[l, h], v| [l.min(v[k]), h.max(v[k])])
}

/// The voxels along axis `k`, of `count`, whose centres lie within the corners' extent.
fn voxel_range(x: &[[f64; 3]], k: usize, count: usize) -> std::ops::Range<usize> {
    let [low, high] = extent(x, k);
    // Conversions saturate, so far values stay ordered; what is below the first voxel becomes an empty range.
    let from = (low - TOLERANCE).ceil().max(0.0) as usize;
    let to = ((high + TOLERANCE).floor() + 1.0).max(0.0) as usize;
    from.min(count)..to.min(count).max(from.min(count))
}
