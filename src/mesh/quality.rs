//! Shape of tetrahedra and volume of a mesh.

use super::{Delaunay, NO_NEIGHBOUR};
use crate::types::space::{cross, dot};
use crate::types::{TetMesh, WorldPoint};

/// Measures of one tetrahedron's shape.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Quality {
    /// Signed volume (mm^3), positive for positive orientation.
    pub volume: f64,
    /// Circumradius over the shortest edge (1): 0.612 for a regular tetrahedron, larger is worse.
    pub radius_edge_ratio: f64,
    /// Least angle between two faces (radians): 1.231 for a regular tetrahedron, near zero for
    /// slivers.
    pub min_dihedral_angle: f64,
}

/// Signed volume of a tetrahedron (mm^3).
pub fn volume([a, b, c, d]: [WorldPoint; 4]) -> f64 {
    dot(b.minus(a), cross(c.minus(a), d.minus(a))) / 6.0
}

/// The measures of one tetrahedron. Of a flat one the ratio is infinite or NaN.
///
/// Source: J. R. Shewchuk, "What is a good linear finite element?" (2002).
///
/// ```
/// use palpate::WorldPoint;
/// use palpate::mesh::quality::quality;
/// let regular =
///     [[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, -1.0, 1.0], [-1.0, 1.0, -1.0]].map(WorldPoint);
/// let q = quality(regular);
/// assert!((q.volume - 8.0 / 3.0).abs() < 1e-12);
/// assert!((q.min_dihedral_angle - (1.0f64 / 3.0).acos()).abs() < 1e-9);
/// ```
pub fn quality(corners: [WorldPoint; 4]) -> Quality {
    let [a, b, c, d] = corners;
    let (u, v, w) = (b.minus(a), c.minus(a), d.minus(a));
    let volume = volume(corners);
    // Inward area vectors (doubled) of the faces across from a, b, c and d.
    let faces = [cross(d.minus(b), c.minus(b)), cross(v, w), cross(w, u), cross(u, v)];
    let lifted: [f64; 3] =
        std::array::from_fn(|k| dot(u, u) * faces[1][k] + dot(v, v) * faces[2][k] + dot(w, w) * faces[3][k]);
    let radius = dot(lifted, lifted).sqrt() / (12.0 * volume.abs());
    let (mut shortest, mut angle) = (f64::INFINITY, f64::INFINITY);
    for i in 0..4 {
        for j in 0..i {
            let edge = corners[i].minus(corners[j]);
            shortest = shortest.min(dot(edge, edge));
            // The angle inside is the supplement of the one between the vectors.
            let crossed = cross(faces[i], faces[j]);
            angle = angle.min(dot(crossed, crossed).sqrt().atan2(-dot(faces[i], faces[j])));
        }
    }
    Quality { volume, radius_edge_ratio: radius / shortest.sqrt(), min_dihedral_angle: angle }
}

/// The measures of every tetrahedron.
pub fn qualities(mesh: &TetMesh) -> Vec<Quality> {
    elements(mesh).map(quality).collect()
}

/// Sum of the volumes of all tetrahedra (mm^3).
pub fn total_volume(mesh: &TetMesh) -> f64 {
    elements(mesh).map(volume).sum()
}

/// The volume inside the mesh's surface (mm^3), from its outer facets alone by the divergence
/// theorem.
pub fn hull_volume(delaunay: &Delaunay<TetMesh, 4>) -> f64 {
    let nodes = delaunay.mesh.nodes();
    let Some(&origin) = nodes.first() else { return 0.0 };
    let tetrahedra = delaunay.mesh.tetrahedra().iter().zip(&delaunay.neighbours);
    tetrahedra
        .flat_map(|(t, across)| (0..4).filter(|&i| across[i] == NO_NEIGHBOUR).map(move |i| (t, i)))
        .map(|(t, i)| {
            let mut corners = t.map(|v| nodes[v as usize]);
            corners[i] = origin;
            volume(corners)
        })
        .sum()
}

fn elements(mesh: &TetMesh) -> impl Iterator<Item = [WorldPoint; 4]> {
    mesh.tetrahedra().iter().map(|t| t.map(|v| mesh.nodes()[v as usize]))
}
