//! Delaunay triangulation of points in one plane, which may lie anywhere in space.
//!
//! Promises: the triangles tile the convex hull of the points' feet on the plane, and no foot lies
//! strictly inside the circle through any (exact on the feet; those are the coordinates themselves
//! where the plane is parallel to two axes). Seen against the plane's normal, triangles turn
//! counter-clockwise. Points that coincide in the plane become one node. Fails on fewer than three
//! points and on points of one line.

use super::delaunay3::number_nodes;
use super::normalise::normalise;
use super::plane::Plane;
use super::{Delaunay, NO_NEIGHBOUR};
use crate::error::MeshError;
use crate::types::{TriMesh, WorldPoint};
use spade::{DelaunayTriangulation, HasPosition, Point2, Triangulation};

/// A foot in the plane, and the first input point that has it.
struct Site {
    position: Point2<f64>,
    input: u32,
}

impl HasPosition for Site {
    type Scalar = f64;

    fn position(&self) -> Point2<f64> {
        self.position
    }
}

/// The Delaunay triangulation of coplanar `points` (world mm, RAS), by the crate `spade`.
///
/// # Errors
/// [`MeshError::NotFinite`]; [`MeshError::TooFew`] under three distinct points;
/// [`MeshError::Collinear`].
///
/// ```
/// use palpate::WorldPoint;
/// use palpate::mesh::delaunay2::delaunay2;
/// // The corners and the middle of a square that stands in the plane x = 3.
/// let at = |y, z| WorldPoint([3.0, y, z]);
/// let square = [at(0.0, 0.0), at(2.0, 0.0), at(2.0, 2.0), at(0.0, 2.0), at(1.0, 1.0)];
/// assert_eq!(delaunay2(&square)?.mesh.triangles().len(), 4);
/// assert!(delaunay2(&square[..2]).is_err());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn delaunay2(points: &[WorldPoint]) -> Result<Delaunay<TriMesh, 3>, MeshError> {
    let plane = Plane::through(points)?;
    let feet: Vec<WorldPoint> = points
        .iter()
        .map(|&p| {
            let [x, y] = plane.project(p);
            WorldPoint([x, y, 0.0])
        })
        .collect();
    let feet = normalise(&feet)?;

    // Points at one place stand next to each other here, the first of the input in front.
    let mut order: Vec<u32> = (0..feet.len() as u32).collect();
    let foot = |i: u32| feet[i as usize];
    order.sort_unstable_by(|&a, &b| foot(a).partial_cmp(&foot(b)).map_or_else(|| a.cmp(&b), |o| o.then(a.cmp(&b))));
    let mut place = vec![0; feet.len()];
    for group in order.chunk_by(|&a, &b| foot(a) == foot(b)) {
        for &i in group {
            place[i as usize] = group[0];
        }
    }
    let (source, node, number) = number_nodes(place);
    let sites = source.iter().map(|&i| Site { position: Point2::new(foot(i)[0], foot(i)[1]), input: i }).collect();
    // Normalised coordinates are within what spade takes, so this cannot fail.
    let triangulation = DelaunayTriangulation::<Site>::bulk_load(sites).map_err(|_| MeshError::Collinear)?;
    let faces: Vec<_> = triangulation.inner_faces().collect();
    if faces.is_empty() {
        return Err(MeshError::Collinear);
    }

    let mut element = vec![NO_NEIGHBOUR; triangulation.num_all_faces()];
    for (e, face) in faces.iter().enumerate() {
        element[face.index()] = e as u32;
    }
    let triangles = faces.iter().map(|f| f.vertices().map(|v| number[v.data().input as usize])).collect();
    // Edge i runs from corner i to the next, so the one across from corner i is i + 1.
    let across = |f: &spade::handles::FaceHandle<'_, _, Site, _, _, _>| {
        let edges = f.adjacent_edges();
        [1, 2, 0].map(|i: usize| element[edges[i].rev().face().index()])
    };
    let neighbours = faces.iter().map(across).collect();
    let nodes = source.iter().map(|&i| points[i as usize]).collect();
    Ok(Delaunay { mesh: TriMesh::new(nodes, triangles)?, neighbours, source, node })
}
