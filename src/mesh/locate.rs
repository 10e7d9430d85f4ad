//! Which element of a Delaunay mesh holds a point, and with which weights.
//!
//! Promises: exact signs choose the way, and the element found holds the point or lies within 1e-9
//! of the mesh's size of it; a point farther than twice that outside the hull is in none. Needs the
//! mesh of a convex hull with its neighbour table, as the Delaunay functions give it.
//!
//! Source: O. Devillers, S. Pion, M. Teillaud, "Walking in a triangulation", Int. J. Found. Comput.
//! Sci. 13 (2002).

use super::barycentric::weights;
use super::plane::Plane;
use super::predicates::{orient2d, orient3d};
use super::{Delaunay, NO_NEIGHBOUR};
use crate::error::MeshError;
use crate::types::space::{cross, dot};
use crate::types::{TetMesh, TriMesh, WorldPoint};

/// Distance outside the hull, over the mesh's size, up to which a point is on it.
const HULL_TOLERANCE: f64 = 1e-9;

/// An element and the barycentric weights of a point in it: not negative, of sum one, in the order
/// of its corners.
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
    bounds: Bounds,
}

impl<'a> TetrahedronLocator<'a> {
    /// Over a Delaunay mesh.
    pub fn new(delaunay: &'a Delaunay<TetMesh, 4>) -> Self {
        let bounds = Bounds::around(delaunay.mesh.nodes().iter().map(|p| p.0));
        Self { mesh: &delaunay.mesh, neighbours: &delaunay.neighbours, bounds }
    }

    /// The tetrahedron that holds `p` (world mm, RAS), walking from tetrahedron `hint` (any; a near
    /// one is faster). None outside the hull or where `p` is not finite.
    ///
    /// ```
    /// use palpate::WorldPoint;
    /// use palpate::mesh::delaunay3::delaunay3;
    /// use palpate::mesh::locate::TetrahedronLocator;
    /// let corners: Vec<WorldPoint> =
    ///     (0..8).map(|i| WorldPoint([0, 1, 2].map(|a| f64::from(i >> a & 1)))).collect();
    /// let delaunay = delaunay3(&corners)?;
    /// let locator = TetrahedronLocator::new(&delaunay);
    /// let found = locator.locate(WorldPoint([0.3, 0.2, 0.6]), 0).ok_or("outside")?;
    /// assert!((found.weights.iter().sum::<f64>() - 1.0).abs() < 1e-12);
    /// assert!(locator.locate(WorldPoint([1.5, 0.2, 0.6]), 0).is_none());
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn locate(&self, p: WorldPoint, hint: u32) -> Option<Located<4>> {
        if !self.bounds.hold(p.0) {
            return None;
        }
        let nodes = self.mesh.nodes();
        let corners = |e: usize| self.mesh.tetrahedra()[e].map(|v| &nodes[v as usize].0);
        // Six times the volume of the element with corner `i` moved to `p`.
        let part = |p: &[f64; 3], e: usize, i: usize| {
            let mut q = corners(e);
            q[i] = p;
            orient3d(q[0], q[1], q[2], q[3])
        };
        let facet = |e: usize, i: usize| {
            let q = corners(e);
            let [a, b, c] = [1, 2, 3].map(|k| WorldPoint(*q[(i + k) % 4]));
            let normal = cross(b.minus(a), c.minus(a));
            dot(normal, normal).sqrt()
        };
        let far = |e: usize, i: usize, part: f64| part < -self.bounds.tolerance * facet(e, i);
        let inner = self.bounds.inwards(p.0);
        let element = walk(self.neighbours, hint, |e, i| part(&inner, e, i), far)?;
        let e = element as usize;
        let parts = std::array::from_fn(|i| part(&p.0, e, i));
        Some(Located { element, weights: weights(corners(e).map(|q| *q), p.0, parts, 1e-3 * self.bounds.tolerance) })
    }
}

/// Finds triangles by walking; points are taken to their foot on the mesh's plane.
#[derive(Debug, Clone)]
pub struct TriangleLocator<'a> {
    mesh: &'a TriMesh,
    neighbours: &'a [[u32; 3]],
    plane: Plane,
    feet: Vec<[f64; 2]>,
    bounds: Bounds,
}

impl<'a> TriangleLocator<'a> {
    /// Over a Delaunay mesh.
    ///
    /// # Errors
    /// As [`Plane::through`], on a mesh that was not made by
    /// [`delaunay2`](super::delaunay2::delaunay2).
    pub fn new(delaunay: &'a Delaunay<TriMesh, 3>) -> Result<Self, MeshError> {
        let nodes = delaunay.mesh.nodes();
        let plane = Plane::through(nodes)?;
        let feet: Vec<[f64; 2]> = nodes.iter().map(|&p| plane.project(p)).collect();
        let bounds = Bounds::around(feet.iter().copied().map(lift));
        Ok(Self { mesh: &delaunay.mesh, neighbours: &delaunay.neighbours, plane, feet, bounds })
    }

    /// The triangle that holds the foot of `p` (world mm, RAS), walking from triangle `hint`.
    /// None outside the hull or where `p` is not finite.
    pub fn locate(&self, p: WorldPoint, hint: u32) -> Option<Located<3>> {
        let foot = self.plane.project(p);
        if !self.bounds.hold(lift(foot)) {
            return None;
        }
        let corners = |e: usize| self.mesh.triangles()[e].map(|v| self.feet[v as usize]);
        let part = |foot: [f64; 2], e: usize, i: usize| {
            let mut q = corners(e);
            q[i] = foot;
            orient2d(q[0], q[1], q[2])
        };
        let far = |e: usize, i: usize, part: f64| {
            let (a, b) = (corners(e)[(i + 1) % 3], corners(e)[(i + 2) % 3]);
            part < -self.bounds.tolerance * (b[0] - a[0]).hypot(b[1] - a[1])
        };
        let [x, y, _] = self.bounds.inwards(lift(foot));
        let element = walk(self.neighbours, hint, |e, i| part([x, y], e, i), far)?;
        let e = element as usize;
        let parts = std::array::from_fn(|i| part(foot, e, i));
        Some(Located {
            element,
            weights: weights(corners(e).map(lift), lift(foot), parts, 1e-3 * self.bounds.tolerance),
        })
    }
}

/// A point of the plane as one in space.
fn lift([x, y]: [f64; 2]) -> [f64; 3] {
    [x, y, 0.0]
}

/// Walks through facets that separate the element from the point (`part` negative) until there is
/// none; through the hull only where the point is `far` outside.
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

/// An axis-aligned box, the mean of the points in it, and the tolerance that goes with its size.
#[derive(Debug, Clone)]
struct Bounds {
    low: [f64; 3],
    high: [f64; 3],
    mean: [f64; 3],
    tolerance: f64,
}

impl Bounds {
    fn around(points: impl ExactSizeIterator<Item = [f64; 3]>) -> Self {
        let part = 1.0 / points.len() as f64;
        let mut mean = [0.0; 3];
        let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for p in points {
            for a in 0..3 {
                low[a] = low[a].min(p[a]);
                high[a] = high[a].max(p[a]);
                mean[a] += part * p[a];
            }
        }
        let size = (0..3).map(|a| high[a] - low[a]).fold(0.0, f64::max);
        Self { low, high, mean, tolerance: HULL_TOLERANCE * size }
    }

    /// The point moved towards the mean by up to the tolerance: off the hull, where rounding makes
    /// slivers so thin that a point beside them seems to be in one far from it.
    fn inwards(&self, p: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|a| p[a] + HULL_TOLERANCE * (self.mean[a] - p[a]))
    }

    /// Whether a point is in the box; not so where a coordinate is NaN.
    fn hold(&self, p: [f64; 3]) -> bool {
        (0..3).all(|a| p[a] >= self.low[a] - self.tolerance && p[a] <= self.high[a] + self.tolerance)
    }
}
