//! Node displacements of a mesh to a dense field: barycentric (piecewise linear), by filling each
//! element.
//!
//! Promises: every voxel whose centre lies in the mesh gets a value, voxels on a shared facet get
//! the same from either side up to rounding, a linear field comes back to f32 rounding, and the
//! result does not depend on the number of threads. Voxels outside the mesh keep zero, and the mask
//! says which those are. Time grows with the number of elements and the voxels they hold.
//!
//! Elements are filled in voxel coordinates, where any affine grid is the unit lattice and
//! barycentric weights are what they were. One that is flat up to rounding is left to its
//! neighbours, which hold the same voxels.

use crate::error::MeshError;
use crate::types::space::{cross, dot};
use crate::types::{DenseField, Grid, Mask, TetMesh, TriMesh, Volume, WorldPoint};
use rayon::prelude::*;

/// Voxel centres this far (voxels) outside an element are also filled, so that rounding leaves no
/// gaps.
const FILL_TOLERANCE_VOXELS: f64 = 1e-9;

/// Rounding error of a determinant, per unit of the coordinates that it is computed from.
const DETERMINANT_ROUNDING: f64 = 1e-15;

/// Up to this number of rows, intersecting each with the faces costs less than first finding the
/// rows that an element reaches in a slice.
const MAX_ROWS_UNSECTIONED: usize = 6;

/// Slices filled by one task.
const SLICES_PER_TASK: usize = 16;

/// A field inside of a mesh.
#[derive(Debug, Clone, PartialEq)]
pub struct Interpolated {
    /// Displacement (mm, RAS); zero outside of the mesh.
    pub displacement: DenseField,
    /// 1 where the voxel's centre lies in the mesh.
    pub inside: Mask,
}

/// The displacement at the voxel centres of `grid` inside the tetrahedra, from one displacement
/// (mm) a node.
///
/// # Errors
/// [`MeshError::Length`] when there are not as many displacements as nodes.
///
/// ```
/// use palpate::field::interpolation::interpolate_tetrahedra;
/// use palpate::mesh::delaunay3::delaunay3;
/// use palpate::{Affine, Grid, WorldPoint};
/// let grid = Grid::new([9; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let corners: Vec<WorldPoint> =
///     (0..8).map(|i| WorldPoint([0, 1, 2].map(|a| 6.0 * f64::from(i >> a & 1)))).collect();
/// let mesh = delaunay3(&corners)?.mesh;
/// // A stretch along x is linear, so it comes back as it is.
/// let at_nodes: Vec<[f64; 3]> = corners.iter().map(|p| [0.5 * p.0[0], 0.0, 0.0]).collect();
/// let found = interpolate_tetrahedra(&mesh, &at_nodes, &grid)?;
/// assert_eq!(found.displacement.at(grid.index(4, 2, 3)), [2.0, 0.0, 0.0]);
/// assert_eq!(found.inside.as_slice()[grid.index(8, 2, 3)], 0);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
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
/// [`MeshError::Length`] as above; [`MeshError::NotOneSlice`] when the grid is thicker than one
/// voxel along every axis.
///
/// ```
/// use palpate::field::interpolation::interpolate_triangles;
/// use palpate::mesh::delaunay2::delaunay2;
/// use palpate::{Affine, Grid, WorldPoint};
/// let slice = Grid::new([9, 9, 1], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let corners =
///     [[0.0, 0.0], [8.0, 0.0], [8.0, 8.0], [0.0, 8.0]].map(|[x, y]| WorldPoint([x, y, 0.0]));
/// let mesh = delaunay2(&corners)?.mesh;
/// let at_nodes = corners.map(|p| [0.0, 0.25 * p.0[1], 0.0]);
/// let found = interpolate_triangles(&mesh, &at_nodes, &slice)?;
/// assert_eq!(found.displacement.at(slice.index(3, 4, 0)), [0.0, 1.0, 0.0]);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
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

/// The gradient of each barycentric weight, over the common determinant that comes second (six
/// times the volume).
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

/// One slab of the result: `SLICES_PER_TASK` slices of each component and of the mask.
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
        let (weights, determinant) = gradients(&x);
        if is_flat(&x, &weights, determinant) { 0..0 } else { voxel_range(extent(&x, 2), shape[2]) }
    });
    let mut displacements = DenseField::zeros(*grid);
    let mut inside = Volume::filled(*grid, 0u8);
    let (n, plane) = (grid.len(), SLICES_PER_TASK * shape[0] * shape[1]);
    let (right, rest) = displacements.as_mut_slice().split_at_mut(n);
    let (front, up) = rest.split_at_mut(n);
    let parts = right.par_chunks_mut(plane).zip(front.par_chunks_mut(plane)).zip(up.par_chunks_mut(plane));
    parts.zip(inside.as_mut_slice().par_chunks_mut(plane)).zip(&queues).enumerate().for_each(
        |(s, ((((right, front), up), inside), queue))| {
            let mut slab = Slab { components: [right, front, up], inside, first: s * SLICES_PER_TASK, shape };
            for &e in queue {
                let values = elements[e as usize].map(|v| displacement[v as usize]);
                let x = corners(e);
                let (weights, determinant) = gradients(&x);
                slab.fill(&x, &values, &weights.map(|g| g.map(|v| v / determinant)));
            }
        },
    );
    Interpolated { displacement: displacements, inside }
}

/// Whether an element is so thin, or so nearly so up to rounding, that all of it lies within the
/// tolerance of its neighbours. `weights` are the gradients over the determinant: the least height
/// is the determinant over the largest.
fn is_flat<const N: usize>(x: &[[f64; 3]; N], weights: &[[f64; 3]; N], determinant: f64) -> bool {
    let norm = |v: [f64; 3]| dot(v, v).sqrt();
    let steepest = weights.iter().map(|&g| norm(g)).fold(0.0, f64::max);
    let reach = x.iter().map(|&p| norm(p)).fold(0.0, f64::max);
    let length = norm(std::array::from_fn(|k| extent(x, k)[1] - extent(x, k)[0]));
    determinant.abs() <= FILL_TOLERANCE_VOXELS * steepest + DETERMINANT_ROUNDING * reach * length.powi(N as i32 - 2)
}

/// The elements that touch each slab, in the mesh's order; `slices` gives those of an element.
fn queues(elements: usize, depth: usize, slices: impl Fn(u32) -> std::ops::Range<usize>) -> Vec<Vec<u32>> {
    let mut queues = vec![Vec::new(); depth.div_ceil(SLICES_PER_TASK)];
    for e in 0..elements as u32 {
        let range = slices(e);
        if !range.is_empty() {
            queues[range.start / SLICES_PER_TASK..=(range.end - 1) / SLICES_PER_TASK]
                .iter_mut()
                .for_each(|queue| queue.push(e));
        }
    }
    queues
}

impl Slab<'_> {
    /// Fills one element with corners `x` (voxels), `values` (mm) there, and the `gradients` of its
    /// weights.
    fn fill<const N: usize>(&mut self, x: &[[f64; 3]; N], values: &[[f64; 3]; N], gradients: &[[f64; 3]; N]) {
        // A voxel is inside where each distance from a face, `offset + normal . p`, is at least
        // minus the tolerance. Along a row that is where x is above (normal to the right) or below
        // `limit[0] + limit[1] y + limit[2] z`.
        let faces: [(bool, [f64; 3]); N] = std::array::from_fn(|i| {
            let [right, front, up] = gradients[i].map(|v| v / dot(gradients[i], gradients[i]).sqrt());
            // A face along the row is turned by less than the tolerance, to cut far away.
            let right = if right.abs() < 1e-12 { 1e-12 } else { right };
            let offset = FILL_TOLERANCE_VOXELS - dot([right, front, up], x[(i + 1) % N]);
            (right > 0.0, [-offset / right, -front / right, -up / right])
        });
        if faces.iter().any(|(_, limit)| !dot(*limit, *limit).is_finite()) {
            return;
        }
        let slope: [[f64; 3]; 3] = std::array::from_fn(|c| {
            std::array::from_fn(|k| (1..N).map(|i| (values[i][c] - values[0][c]) * gradients[i][k]).sum())
        });
        let [width, depth, _] = self.shape;
        let columns = voxel_range(extent(x, 0), width);
        let rows = voxel_range(extent(x, 1), depth);
        let slices = voxel_range(extent(x, 2), self.first + self.inside.len() / (width * depth));
        for k in slices.start.max(self.first)..slices.end {
            let z = k as f64;
            let cuts = faces.map(|(above, limit)| (above, limit[0] + limit[2] * z, limit[1]));
            let rows = if rows.len() > MAX_ROWS_UNSECTIONED { voxel_range(section(x, z), depth) } else { rows.clone() };
            for j in rows {
                let y = j as f64;
                let (mut low, mut high) = (columns.start as f64, columns.end as f64 - 1.0);
                for (above, offset, slope) in cuts {
                    let at = offset + slope * y;
                    if above {
                        low = if at > low { at } else { low };
                    } else {
                        high = if at < high { at } else { high };
                    }
                }
                if high < low {
                    continue;
                }
                let (from, to) = (round_up(low), high as u32 as usize + 1);
                if from >= to {
                    continue;
                }
                let offset = minus([from as f64, y, z], x[0]);
                let start = std::array::from_fn(|c| values[0][c] + dot(slope[c], offset));
                let step = slope.map(|s| s[0]);
                self.fill_row(width * (j + depth * (k - self.first)) + from, to - from, start, step);
            }
        }
    }

    /// Fills `count` voxels of a row from offset `at`: `start` in the first and `step` (mm) more in
    /// each that follows.
    #[inline(always)]
    fn fill_row(&mut self, at: usize, count: usize, start: [f64; 3], step: [f64; 3]) {
        let [right, front, up] = self.components.each_mut().map(|c| &mut c[at..at + count]);
        let inside = &mut self.inside[at..at + count];
        let mut along = 0.0;
        for (((right, front), up), inside) in right.iter_mut().zip(front).zip(up).zip(inside) {
            *right = (start[0] + step[0] * along) as f32;
            *front = (start[1] + step[1] * along) as f32;
            *up = (start[2] + step[2] * along) as f32;
            *inside = 1;
            along += 1.0;
        }
    }
}

/// The extent along y of an element's cut with the plane at `z`, or a little more.
fn section<const N: usize>(x: &[[f64; 3]; N], z: f64) -> [f64; 2] {
    // An edge this close to level counts from end to end.
    const LEVEL_TOLERANCE_VOXELS: f64 = 1e-6;
    let mut range = [f64::INFINITY, f64::NEG_INFINITY];
    let mut reach =
        |y: f64| range = [range[0].min(y - LEVEL_TOLERANCE_VOXELS), range[1].max(y + LEVEL_TOLERANCE_VOXELS)];
    for i in 1..N {
        for j in 0..i {
            let (p, q) = if x[i][2] < x[j][2] { (x[i], x[j]) } else { (x[j], x[i]) };
            let (below, above) = (z - p[2], q[2] - z);
            if below < -LEVEL_TOLERANCE_VOXELS || above < -LEVEL_TOLERANCE_VOXELS {
                continue;
            }
            let rise = q[2] - p[2];
            if rise < LEVEL_TOLERANCE_VOXELS {
                reach(p[1]);
                reach(q[1]);
            } else {
                reach(p[1] + (q[1] - p[1]) * (below / rise).clamp(0.0, 1.0));
            }
        }
    }
    range
}

fn minus(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|k| a[k] - b[k])
}

/// Least and greatest of component `k`.
fn extent(vectors: &[[f64; 3]], k: usize) -> [f64; 2] {
    vectors.iter().fold([f64::INFINITY, f64::NEG_INFINITY], |[l, h], v| [l.min(v[k]), h.max(v[k])])
}

/// The voxels of an axis with `count` of them whose centres lie within an extent.
fn voxel_range([low, high]: [f64; 2], count: usize) -> std::ops::Range<usize> {
    let from = round_up(low - FILL_TOLERANCE_VOXELS).min(count);
    let to = if high + FILL_TOLERANCE_VOXELS < 0.0 { 0 } else { (high + FILL_TOLERANCE_VOXELS) as u32 as usize + 1 };
    from..to.min(count).max(from)
}

/// The least number of voxels not below `v` (conversions saturate; faster than `ceil` where that is
/// a call).
#[inline(always)]
fn round_up(v: f64) -> usize {
    let n = v as u32;
    n as usize + usize::from(f64::from(n) < v)
}
