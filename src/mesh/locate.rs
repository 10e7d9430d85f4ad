//! Which element of a Delaunay mesh holds a point, and with which weights.
//!
//! Promises: exact signs choose the way, so the element found is right up to the rounding of its corners; a point
//! farther than 1e-9 of the mesh's size outside the hull is in none. Needs the mesh of a convex hull with its
//! neighbour table, as the Delaunay functions give it.
//!
//! Source: O. Devillers, S. Pion, M. Teillaud, "Walking in a triangulation", Int. J. Found. Comput. Sci. 13 (2002).

use super::barycentric::weights;
use super::plane::Plane;
use super::predicates::{orient2d, orient3d};
use super::{Delaunay, NO_NEIGHBOUR};
use crate::error::MeshError;
use crate::types::space::{cross, dot};
use crate::types::{TetMesh, TriMesh, WorldPoint};

/// Points this part of the mesh's size outside of the hull still count as on it.
const TOLERANCE: f64 = 1e-9;

/// An element and the barycentric weights of a point in it: not negative, of sum one, in the order of its corners.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Located<const N: usize> {
    /// The element's number.
    pub element: u32,
    /// The weight of each corner.
    pub weights: [f64; N],
}

/// Finds tetrahedra by walking.
#[derive(Debug, Clone)]
pub struct TetrahedronLocator<'a> {
    mesh: &'a TetMesh,
    neighbours: &'a [[u32; 4]],
    tolerance: f64,
}

impl<'a> TetrahedronLocator<'a> {
    /// Over a Delaunay mesh.
    pub fn new(delaunay: &'a Delaunay<TetMesh, 4>) -> Self {
        let tolerance = TOLERANCE * extent(delaunay.mesh.nodes());
        Self { mesh: &delaunay.mesh, neighbours: &delaunay.neighbours, tolerance }
    }

    /// The tetrahedron that holds `p` (world mm, RAS), walking from tetrahedron `hint` (any; a near one is faster).
    /// None outside the hull or where `p` is not finite.
    pub fn locate(&self, p: WorldPoint, hint: u32) -> Option<Located<4>> {
        let nodes = self.mesh.nodes();
        let corners = |e: usize| self.mesh.tetrahedra()[e].map(|v| &nodes[v as usize].0);
        // Six times the volume of the element with corner `i` moved to `p`.
        let part = |e: usize, i: usize| {
            let mut q = corners(e);
            q[i] = &p.0;
            orient3d(q[0], q[1], q[2], q[3])
        };
        let facet = |e: usize, i: usize| {
            let q = corners(e);
            let [a, b, c] = [1, 2, 3].map(|k| WorldPoint(*q[(i + k) % 4]));
            let normal = cross(b.minus(a), c.minus(a));
            dot(normal, normal).sqrt()
        };
        let far = |e: usize, i: usize, part: f64| part < -self.tolerance * facet(e, i);
        let element = if p.0.iter().all(|v| v.is_finite()) { walk(self.neighbours, hint, part, far) } else { None }?;
        let e = element as usize;
        let parts = std::array::from_fn(|i| part(e, i));
        Some(Located { element, weights: weights(corners(e).map(|q| *q), p.0, parts, 1e-3 * self.tolerance) })
    }
}

/// Finds triangles by walking; points are taken to their foot on the mesh's plane.
#[derive(Debug, Clone)]
pub struct TriangleLocator<'a> {
    mesh: &'a TriMesh,
    neighbours: &'a [[u32; 3]],
    plane: Plane,
    feet: Vec<[f64; 2]>,
    tolerance: f64,
}

impl<'a> TriangleLocator<'a> {
    /// Over a Delaunay mesh.
    ///
    /// # Errors
    /// As [`Plane::through`], on a mesh that was not made by [`delaunay2`](super::delaunay2::delaunay2).
    pub fn new(delaunay: &'a Delaunay<TriMesh, 3>) -> Result<Self, MeshError> {
        let nodes = delaunay.mesh.nodes();
        let plane = Plane::through(nodes)?;
        let feet = nodes.iter().map(|&p| plane.project(p)).collect();
        let tolerance = TOLERANCE * extent(nodes);
        Ok(Self { mesh: &delaunay.mesh, neighbours: &delaunay.neighbours, plane, feet, tolerance })
    }

    /// The triangle that holds the foot of `p` (world mm, RAS), walking from triangle `hint`.
    /// None outside the hull or where `p` is not finite.
    pub fn locate(&self, p: WorldPoint, hint: u32) -> Option<Located<3>> {
        let foot = self.plane.project(p);
        let lift = |q: [f64; 2]| [q[0], q[1], 0.0];
        let corners = |e: usize| self.mesh.triangles()[e].map(|v| self.feet[v as usize]);
        let part = |e: usize, i: usize| {
            let mut q = corners(e);
            q[i] = foot;
            orient2d(q[0], q[1], q[2])
        };
        let far = |e: usize, i: usize, part: f64| {
            let (a, b) = (corners(e)[(i + 1) % 3], corners(e)[(i + 2) % 3]);
            part < -self.tolerance * (b[0] - a[0]).hypot(b[1] - a[1])
        };
        let element = if foot.iter().all(|v| v.is_finite()) { walk(self.neighbours, hint, part, far) } else { None }?;
        let e = element as usize;
        let parts = std::array::from_fn(|i| part(e, i));
        Some(Located { element, weights: weights(corners(e).map(lift), lift(foot), parts, 1e-3 * self.tolerance) })
    }
}

/// Walks through facets that separate the element from the point (`part` negative) until there is none; through the
/// hull only where the point is `far` outside.
fn walk<const N: usize>(
    neighbours: &[[u32; N]],
    hint: u32,
    part: impl Fn(usize, usize) -> f64,
    far: impl Fn(usize, usize, f64) -> bool,
) -> Option<u32> {
    let mut at = (hint as usize).min(neighbours.len().checked_sub(1)?);
    let mut chance = 0x9e37_79b9_u32;
    'walk: loop {
        chance = chance.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        for turn in 0..N {
            let i = ((chance >> 16) as usize + turn) % N;
            let part = part(at, i);
            if part < 0.0 {
                match neighbours[at][i] {
                    NO_NEIGHBOUR if far(at, i, part) => return None,
                    NO_NEIGHBOUR => {}
                    next => {
                        at = next as usize;
                        continue 'walk;
                    }
                }
            }
        }
        return Some(at as u32);
    }
}

/// The longest side of the box around the points (mm).
fn extent(points: &[WorldPoint]) -> f64 {
    let side = |a: usize| {
        let [low, high] =
            points.iter().fold([f64::INFINITY, f64::NEG_INFINITY], |[l, h], p| [l.min(p.0[a]), h.max(p.0[a])]);
        high - low
    };
    side(0).max(side(1)).max(side(2))
}
