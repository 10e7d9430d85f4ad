//! Simplicial meshes: triangles in the plane, tetrahedra in space.

use crate::error::MeshError;
use crate::types::space::WorldPoint;

/// A tetrahedral mesh. Each tetrahedron `[a, b, c, d]` is positively oriented:
/// `det(b - a, c - a, d - a) > 0`.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TetMesh {
    nodes: Vec<WorldPoint>,
    tetrahedra: Vec<[u32; 4]>,
}

impl TetMesh {
    /// From nodes (mm, RAS) and tetrahedra.
    ///
    /// # Errors
    /// [`MeshError`] when an index is out of range or a coordinate is not finite. Orientation is
    /// the maker's duty.
    ///
    /// ```
    /// use palpate::{MeshError, TetMesh, WorldPoint};
    /// let nodes = vec![
    ///     WorldPoint([0.0; 3]),
    ///     WorldPoint([1.0, 0.0, 0.0]),
    ///     WorldPoint([0.0, 1.0, 0.0]),
    ///     WorldPoint([0.0, 0.0, 1.0]),
    /// ];
    /// assert_eq!(TetMesh::new(nodes.clone(), vec![[0, 1, 2, 3]])?.tetrahedra().len(), 1);
    /// assert_eq!(
    ///     TetMesh::new(nodes, vec![[0, 1, 2, 4]]),
    ///     Err(MeshError::Index { index: 4, nodes: 4 })
    /// );
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn new(nodes: Vec<WorldPoint>, tetrahedra: Vec<[u32; 4]>) -> Result<Self, MeshError> {
        check(&nodes, tetrahedra.iter().flatten())?;
        Ok(Self { nodes, tetrahedra })
    }

    /// Node positions (mm, RAS).
    pub fn nodes(&self) -> &[WorldPoint] {
        &self.nodes
    }

    /// Node numbers of each tetrahedron.
    pub fn tetrahedra(&self) -> &[[u32; 4]] {
        &self.tetrahedra
    }
}

/// A triangle mesh of a plane that lies anywhere in space.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TriMesh {
    nodes: Vec<WorldPoint>,
    triangles: Vec<[u32; 3]>,
}

impl TriMesh {
    /// From nodes (mm, RAS) and triangles.
    ///
    /// # Errors
    /// As [`TetMesh::new`].
    pub fn new(nodes: Vec<WorldPoint>, triangles: Vec<[u32; 3]>) -> Result<Self, MeshError> {
        check(&nodes, triangles.iter().flatten())?;
        Ok(Self { nodes, triangles })
    }

    /// Node positions (mm, RAS).
    pub fn nodes(&self) -> &[WorldPoint] {
        &self.nodes
    }

    /// Node numbers of each triangle.
    pub fn triangles(&self) -> &[[u32; 3]] {
        &self.triangles
    }
}

/// A mesh of quadratic tetrahedra, each in one region.
///
/// The ten nodes of an element are its four corners, positively oriented, and then the middles of
/// the edges 01, 12, 02, 03, 13, 23 (the order of VTK, Abaqus and FEBio). Edges may be curved.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct QuadraticMesh {
    nodes: Vec<WorldPoint>,
    tetrahedra: Vec<[u32; 10]>,
    labels: Vec<u8>,
}

impl QuadraticMesh {
    /// From nodes (mm, RAS), elements and the region's label of each.
    ///
    /// # Errors
    /// As [`TetMesh::new`]; [`MeshError::Length`] when there are not as many labels as elements.
    pub fn new(nodes: Vec<WorldPoint>, tetrahedra: Vec<[u32; 10]>, labels: Vec<u8>) -> Result<Self, MeshError> {
        check(&nodes, tetrahedra.iter().flatten())?;
        if labels.len() != tetrahedra.len() {
            return Err(MeshError::Length { expected: tetrahedra.len(), found: labels.len() });
        }
        Ok(Self { nodes, tetrahedra, labels })
    }

    /// Node positions (mm, RAS).
    pub fn nodes(&self) -> &[WorldPoint] {
        &self.nodes
    }

    /// Node numbers of each element.
    pub fn tetrahedra(&self) -> &[[u32; 10]] {
        &self.tetrahedra
    }

    /// Label of each element's region.
    pub fn labels(&self) -> &[u8] {
        &self.labels
    }
}

pub(super) fn check<'a>(nodes: &[WorldPoint], mut indices: impl Iterator<Item = &'a u32>) -> Result<(), MeshError> {
    if let Some(node) = nodes.iter().position(|p| p.0.iter().any(|v| !v.is_finite())) {
        return Err(MeshError::NotFinite { node });
    }
    match indices.find(|&&i| i as usize >= nodes.len()) {
        Some(&index) => Err(MeshError::Index { index, nodes: nodes.len() }),
        None => Ok(()),
    }
}
