//! A solid mesh of the user, and what was measured at its nodes.

use crate::error::MeshError;
use crate::types::space::WorldPoint;
use std::collections::HashMap;

/// Shape of an element. Nodes are in the order of VTK, Abaqus and FEBio, which is the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SolidShape {
    /// 4 nodes.
    Tetrahedron,
    /// 10 nodes.
    QuadraticTetrahedron,
    /// 8 nodes.
    Hexahedron,
    /// 20 nodes.
    QuadraticHexahedron,
}

/// Faces of a tetrahedron: corners, then middles of edges.
const TETRAHEDRON: [&[usize]; 4] = [&[0, 2, 1, 6, 5, 4], &[0, 1, 3, 4, 8, 7], &[1, 2, 3, 5, 9, 8], &[2, 0, 3, 6, 7, 9]];
/// Faces of a hexahedron: corners, then middles of edges.
const HEXAHEDRON: [&[usize]; 6] = [
    &[0, 3, 2, 1, 11, 10, 9, 8],
    &[4, 5, 6, 7, 12, 13, 14, 15],
    &[0, 1, 5, 4, 8, 17, 12, 16],
    &[1, 2, 6, 5, 9, 18, 13, 17],
    &[2, 3, 7, 6, 10, 19, 14, 18],
    &[3, 0, 4, 7, 11, 16, 15, 19],
];

impl SolidShape {
    /// How many nodes it has.
    pub fn nodes(self) -> usize {
        match self {
            Self::Tetrahedron => 4,
            Self::QuadraticTetrahedron => 10,
            Self::Hexahedron => 8,
            Self::QuadraticHexahedron => 20,
        }
    }

    /// How many of them are corners, which come first.
    pub fn corners(self) -> usize {
        match self {
            Self::Tetrahedron | Self::QuadraticTetrahedron => 4,
            Self::Hexahedron | Self::QuadraticHexahedron => 8,
        }
    }

    /// The places of each face's nodes in the element, corners first; how many corners.
    fn faces(self) -> (&'static [&'static [usize]], usize) {
        match self.corners() {
            4 => (&TETRAHEDRON, 3),
            _ => (&HEXAHEDRON, 4),
        }
    }
}

/// One element.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SolidElement {
    /// Its number in the file.
    pub number: u64,
    /// Its shape.
    pub shape: SolidShape,
    /// Its nodes, by their place in the list of nodes.
    pub nodes: Vec<u32>,
}

/// A mesh of tetrahedra and hexahedra, linear or quadratic.
#[derive(Debug, Clone, PartialEq)]
pub struct SolidMesh {
    nodes: Vec<WorldPoint>,
    numbers: Vec<u64>,
    elements: Vec<SolidElement>,
    sets: Vec<(String, Vec<u32>)>,
}

impl SolidMesh {
    /// From nodes (mm, RAS) with their numbers in the file, elements, and named sets of nodes.
    ///
    /// # Errors
    /// [`MeshError`] when a coordinate is not finite, an index is out of range, or there are not as
    /// many numbers as nodes.
    pub fn new(
        nodes: Vec<WorldPoint>,
        numbers: Vec<u64>,
        elements: Vec<SolidElement>,
        sets: Vec<(String, Vec<u32>)>,
    ) -> Result<Self, MeshError> {
        if numbers.len() != nodes.len() {
            return Err(MeshError::Length { expected: nodes.len(), found: numbers.len() });
        }
        super::mesh::check(&nodes, elements.iter().flat_map(|e| &e.nodes).chain(sets.iter().flat_map(|s| &s.1)))?;
        match elements.iter().find(|e| e.nodes.len() != e.shape.nodes()) {
            Some(e) => Err(MeshError::Length { expected: e.shape.nodes(), found: e.nodes.len() }),
            None => Ok(Self { nodes, numbers, elements, sets }),
        }
    }

    /// Node places (mm, RAS).
    pub fn nodes(&self) -> &[WorldPoint] {
        &self.nodes
    }

    /// The nodes' numbers in the file.
    pub fn numbers(&self) -> &[u64] {
        &self.numbers
    }

    /// The elements.
    pub fn elements(&self) -> &[SolidElement] {
        &self.elements
    }

    /// Named sets of nodes.
    pub fn sets(&self) -> &[(String, Vec<u32>)] {
        &self.sets
    }

    /// The nodes of faces that belong to one element only, ascending.
    pub fn surface(&self) -> Vec<u32> {
        let mut seen: HashMap<[u32; 4], usize> = HashMap::new();
        let key = |element: &SolidElement, face: &[usize], corners: usize| {
            let mut key = [u32::MAX; 4];
            key.iter_mut().zip(&face[..corners]).for_each(|(k, &i)| *k = element.nodes[i]);
            key.sort_unstable();
            key
        };
        let all = || {
            self.elements.iter().flat_map(|element| {
                let (faces, corners) = element.shape.faces();
                faces.iter().map(move |face| (element, *face, key(element, face, corners)))
            })
        };
        all().for_each(|(.., key)| *seen.entry(key).or_default() += 1);
        let outer = all().filter(|(.., key)| seen[key] == 1);
        let mut out: Vec<u32> =
            outer.flat_map(|(element, face, _)| face.iter().filter_map(|&i| element.nodes.get(i).copied())).collect();
        out.sort_unstable();
        out.dedup();
        out
    }

    /// The mean of an element's corners (mm, RAS).
    pub fn centroid(&self, element: &SolidElement) -> WorldPoint {
        let corners = &element.nodes[..element.shape.corners()];
        let sum = |a: usize| corners.iter().map(|&n| self.nodes[n as usize].0[a]).sum::<f64>();
        WorldPoint(std::array::from_fn(|a| sum(a) / corners.len() as f64))
    }
}

/// What was measured at a node.
#[derive(Debug, Clone, PartialEq)]
pub struct MeasuredNode {
    /// The node, by its place in the list of nodes.
    pub node: u32,
    /// Name of the set that it is in; `surface` where none was asked for.
    pub patch: String,
    /// The displacement (mm, RAS).
    pub displacement: [f64; 3],
    /// Covariance of its error (mm^2, RAS): xx, xy, xz, yy, yz, zz; none where the field tells
    /// none.
    pub covariance: Option<[f64; 6]>,
}

/// What an element is made of.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ElementModulus {
    /// Label of the region that its centroid lies in.
    pub label: u8,
    /// Young's modulus (kPa, or the ratio to the reference region where no force is known).
    pub modulus: f64,
    /// Poisson's ratio that the modulus goes with.
    pub poisson: f64,
}

/// What is written on a mesh of the user.
#[derive(Debug, Clone, PartialEq)]
pub struct Measured {
    /// Prescribed nodes, by set and then by node.
    pub nodes: Vec<MeasuredNode>,
    /// What each element is made of; none where it lies outside the map.
    pub elements: Vec<Option<ElementModulus>>,
}
