//! What the models for SOFA and MuJoCo share: linear tetrahedra, nodal masses, prescribed axes.
//!
//! Both programs solve linear tetrahedra only. Each quadratic one becomes eight, so that no node is
//! lost. Units: m, Pa, kg; places are world RAS.

use super::stiffness::{components, pins};
use crate::types::QuadraticMesh;
use crate::types::space::{cross, dot};
use crate::types::stiffness::StiffnessResult;
use std::collections::BTreeMap;

/// Metres in a millimetre.
pub(super) const METRES_PER_MM: f64 = 1e-3;
/// Pascals in a kilopascal.
pub(super) const PASCALS_PER_KPA: f64 = 1e3;
/// Density of soft tissue (kg/m^3): that of water. It changes motion in time and no rest.
pub(super) const TISSUE_DENSITY: f64 = 1000.0;

/// The tetrahedra at the corners of a quadratic one, by its ten nodes.
const CORNERS: [[usize; 4]; 4] = [[0, 4, 6, 7], [4, 1, 5, 8], [6, 5, 2, 9], [7, 8, 9, 3]];
/// The three ways to divide the octahedron between them, one for each diagonal.
const INNER: [[[usize; 4]; 4]; 3] = [
    [[4, 9, 5, 6], [4, 9, 6, 7], [4, 9, 7, 8], [4, 9, 8, 5]],
    [[5, 7, 4, 6], [5, 7, 6, 9], [5, 7, 9, 8], [5, 7, 8, 4]],
    [[6, 8, 4, 5], [6, 8, 5, 9], [6, 8, 9, 7], [6, 8, 7, 4]],
];
/// Linear tetrahedra that a quadratic one gives.
pub(super) const LINEAR_PER_QUADRATIC: usize = 8;

/// Six times the volume (mm^3), positive where the corners are in order.
fn six_volumes(mesh: &QuadraticMesh, t: &[u32; 4]) -> f64 {
    let [a, b, c, d] = t.map(|n| mesh.nodes()[n as usize]);
    dot(cross(b.minus(a), c.minus(a)), d.minus(a))
}

/// The corners in positive order.
fn ordered(mesh: &QuadraticMesh, [a, b, c, d]: [u32; 4]) -> [u32; 4] {
    if six_volumes(mesh, &[a, b, c, d]) < 0.0 { [a, b, d, c] } else { [a, b, c, d] }
}

/// [`LINEAR_PER_QUADRATIC`] linear tetrahedra for each quadratic one, in order, all positively
/// oriented. The octahedron is divided along the diagonal that leaves the largest smallest part.
pub(super) fn linear(mesh: &QuadraticMesh) -> Vec<[u32; 4]> {
    let mut out = Vec::with_capacity(LINEAR_PER_QUADRATIC * mesh.tetrahedra().len());
    for t in mesh.tetrahedra() {
        let of = |part: &[usize; 4]| ordered(mesh, part.map(|i| t[i]));
        let least =
            |parts: &[[usize; 4]; 4]| parts.iter().map(|p| six_volumes(mesh, &of(p))).fold(f64::INFINITY, f64::min);
        out.extend(CORNERS.iter().map(of));
        let inner = INNER.iter().max_by(|a, b| least(a).total_cmp(&least(b)));
        out.extend(inner.into_iter().flatten().map(of));
    }
    out
}

/// Mass of each node (kg): a quarter of that of each tetrahedron around it.
pub(super) fn masses(mesh: &QuadraticMesh, tetrahedra: &[[u32; 4]]) -> Vec<f64> {
    let mut out = vec![0.0; mesh.nodes().len()];
    for t in tetrahedra {
        let part = six_volumes(mesh, t).max(0.0) / 24.0 * METRES_PER_MM.powi(3) * TISSUE_DENSITY;
        t.iter().for_each(|&n| out[n as usize] += part);
    }
    out
}

/// The displacement (mm) that is prescribed along each axis of each such node.
pub(super) fn prescribed(result: &StiffnessResult) -> BTreeMap<u32, [Option<f64>; 3]> {
    let mut out: BTreeMap<u32, [Option<f64>; 3]> = BTreeMap::new();
    for p in &result.prescribed {
        let axes = out.entry(p.node).or_default();
        components(p).into_iter().for_each(|(a, v)| axes[a] = Some(v));
    }
    for (node, a) in pins(result) {
        out.entry(node).or_default()[a] = Some(result.displacement[node as usize][a]);
    }
    out
}

/// Labels of the regions, ascending, with the modulus (Pa) of each.
pub(super) fn moduli(result: &StiffnessResult) -> BTreeMap<u8, f64> {
    let each = result.mesh.labels().iter().zip(&result.element_modulus);
    each.map(|(&label, e)| (label, e * PASCALS_PER_KPA)).collect()
}
