//! Simplicial meshes through scattered points: exact Delaunay in space and in a plane, location,
//! quality.
//!
//! Promises: every decision is taken by an exact predicate, so lattices, repeated points, thin
//! slices and points on one sphere give a valid mesh that tiles the convex hull. Needs finite
//! coordinates. Fails with a [`MeshError`](crate::error::MeshError) that says whether the points
//! are too few, on one line or in one plane.

pub mod predicates;

mod double_double;

mod normalise;

mod hilbert;

mod edge_map;

mod cells;

pub mod delaunay3;

pub mod plane;

pub mod delaunay2;

mod barycentric;

pub mod locate;

pub mod quality;

pub mod tetrahedral;

/// Stands in a neighbour table where an element has none, on the hull.
pub const NO_NEIGHBOUR: u32 = u32::MAX;

/// A Delaunay mesh with its neighbours and its relation to the points it was made from.
///
/// `N` is the number of corners of an element: 4 for [`TetMesh`](crate::types::TetMesh), 3 for
/// [`TriMesh`](crate::types::TriMesh).
#[derive(Debug, Clone, PartialEq)]
pub struct Delaunay<M, const N: usize> {
    /// Nodes (in the order of the input, repeated points left out) and elements.
    pub mesh: M,
    /// Entry `[e][i]` is the element across from corner `i` of element `e`, or [`NO_NEIGHBOUR`].
    pub neighbours: Vec<[u32; N]>,
    /// Node to input point: the first of those that coincide; ascending.
    pub source: Vec<u32>,
    /// Input point to node.
    pub node: Vec<u32>,
}
