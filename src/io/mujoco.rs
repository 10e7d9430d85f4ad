//! The identified model for MuJoCo: MJCF (`.xml`), and its mesh as Gmsh 2.2 (`.msh`).
//!
//! A flex of MuJoCo has one Young's modulus. So each region is a flex of its own, and all share the
//! bodies of their common nodes: the regions hold together exactly. Units: m, Pa, kg, s.

use super::atomic::write_atomic;
use super::simulators::{LINEAR_PER_QUADRATIC, METRES_PER_MM, linear, masses, moduli, prescribed};
use crate::error::IoError;
use crate::types::stiffness::StiffnessResult;
use std::collections::BTreeMap;
use std::io::{self, Write};
use std::path::Path;

/// Axes of the joints, with the letter that ends their names.
const AXES: [(&str, &str); 3] = [("x", "1 0 0"), ("y", "0 1 0"), ("z", "0 0 1")];
/// Stiffness of what moves a prescribed node, over the largest modulus times an element's side (1):
/// the node stays within a thousandth of what is prescribed.
const HOLD_STIFFNESS_RATIO: f64 = 100.0;
/// Step and Rayleigh damping (s): a choice that settles in a few hundred steps; not measured.
const STEP_AND_DAMPING_S: [f64; 2] = [0.002, 0.05];

/// What stands at the head of the model.
const ABOUT: &str = "Units: m, Pa, kg, s; places are world RAS. Needs MuJoCo 3.13 or later.\n     One flex a region, each with \
    the one Young's modulus that a flex has; regions share the bodies of their common nodes.\n     The law is MuJoCo's \
    Saint Venant-Kirchhoff: as the linear law for small strain, and not neo-Hookean past it.\n     Linear tetrahedra lock \
    as Poisson's ratio nears 0.5: see docs/reference/stiffness.md. Density and damping are choices, not measured.\n     The body \
    starts at rest. Bring ctrl up to that of the key \"pressed\" step by step; or reset to that key, which is the \
    identified state.";

/// Writes the MJCF model: a body a node, a flex a region, an actuator for each displacement that is
/// prescribed (nodes that are held still are fixed), and the key `pressed`.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub fn write_mjcf(path: impl AsRef<Path>, result: &StiffnessResult) -> Result<(), IoError> {
    write_atomic(path.as_ref(), |w| {
        let tetrahedra = linear(&result.mesh);
        let fixed = prescribed(result);
        writeln!(w, "<!-- palpate {}: identified stiffness.\n     {ABOUT} -->", env!("CARGO_PKG_VERSION"))?;
        writeln!(w, "<mujoco model=\"palpate\">")?;
        let step = STEP_AND_DAMPING_S[0];
        writeln!(
            w,
            "\t<option timestep=\"{step}\" integrator=\"discrete\" solver=\"CG\" iterations=\"1000\" gravity=\"0 0 0\"/>"
        )?;
        bodies(w, result, &tetrahedra, &fixed)?;
        writeln!(w, "\t<deformable>")?;
        moduli(result).into_iter().try_for_each(|(label, young)| flex(w, result, &tetrahedra, label, young))?;
        writeln!(w, "\t</deformable>\n\t<actuator>")?;
        let grip = grip(result, &tetrahedra);
        for (node, a, _) in pulls(&fixed) {
            writeln!(w, "\t\t<position joint=\"n{}{}\" kp=\"{grip:.6e}\"/>", node + 1, AXES[a].0)?;
        }
        write!(w, "\t</actuator>\n\t<keyframe>\n\t\t<key name=\"pressed\" ctrl=\"")?;
        pulls(&fixed).try_for_each(|(_, _, v)| write!(w, "{:.9} ", v * METRES_PER_MM))?;
        write!(w, "\" qpos=\"")?;
        for (_, u) in (0u32..).zip(&result.displacement).filter(|(n, _)| !still(fixed.get(n))) {
            write!(w, "{:.9} {:.9} {:.9} ", u[0] * METRES_PER_MM, u[1] * METRES_PER_MM, u[2] * METRES_PER_MM)?;
        }
        writeln!(w, "\"/>\n\t</keyframe>\n</mujoco>")
    })
}

/// Whether a node is held in place along all axes.
fn still(given: Option<&[Option<f64>; 3]>) -> bool {
    given.is_some_and(|axes| axes.iter().all(|v| *v == Some(0.0)))
}

/// What actuators prescribe: node, axis, displacement (mm).
fn pulls(fixed: &BTreeMap<u32, [Option<f64>; 3]>) -> impl Iterator<Item = (u32, usize, f64)> {
    let moved = fixed.iter().filter(|(_, axes)| !still(Some(axes)));
    moved.flat_map(|(&node, axes)| (0..3).filter_map(move |a| Some((node, a, axes[a]?))))
}

/// Stiffness of the actuators (N/m).
fn grip(result: &StiffnessResult, tetrahedra: &[[u32; 4]]) -> f64 {
    let volume: f64 = masses(&result.mesh, tetrahedra).iter().sum::<f64>() / super::simulators::TISSUE_DENSITY;
    let side = (volume / tetrahedra.len().max(1) as f64).cbrt();
    HOLD_STIFFNESS_RATIO * side * moduli(result).into_values().fold(0.0, f64::max)
}

fn bodies(
    w: &mut impl Write,
    result: &StiffnessResult,
    tetrahedra: &[[u32; 4]],
    fixed: &BTreeMap<u32, [Option<f64>; 3]>,
) -> io::Result<()> {
    writeln!(w, "\t<worldbody>")?;
    for (n, (p, mass)) in (0u32..).zip(result.mesh.nodes().iter().zip(masses(&result.mesh, tetrahedra))) {
        let [x, y, z] = p.0.map(|v| v * METRES_PER_MM);
        write!(w, "\t\t<body name=\"n{}\" pos=\"{x:.9} {y:.9} {z:.9}\"", n + 1)?;
        if still(fixed.get(&n)) {
            writeln!(w, "/>")?;
            continue;
        }
        // A node cannot turn; MuJoCo asks for an inertia all the same.
        let inertia = mass * METRES_PER_MM * METRES_PER_MM;
        write!(
            w,
            "><inertial pos=\"0 0 0\" mass=\"{mass:.6e}\" diaginertia=\"{inertia:.3e} {inertia:.3e} {inertia:.3e}\"/>"
        )?;
        for (letter, axis) in AXES {
            write!(w, "<joint name=\"n{}{letter}\" type=\"slide\" axis=\"{axis}\"/>", n + 1)?;
        }
        writeln!(w, "</body>")?;
    }
    writeln!(w, "\t</worldbody>")
}

fn flex(
    w: &mut impl Write,
    result: &StiffnessResult,
    tetrahedra: &[[u32; 4]],
    label: u8,
    young: f64,
) -> io::Result<()> {
    let inside = |e: &usize| result.mesh.labels()[e / LINEAR_PER_QUADRATIC] == label;
    let own: Vec<&[u32; 4]> = (0..tetrahedra.len()).filter(inside).map(|e| &tetrahedra[e]).collect();
    let mut nodes: Vec<u32> = own.iter().copied().flatten().copied().collect();
    nodes.sort_unstable();
    nodes.dedup();
    write!(w, "\t\t<flex name=\"region{label}\" dim=\"3\" radius=\"1e-4\" body=\"")?;
    nodes.iter().try_for_each(|n| write!(w, "n{} ", n + 1))?;
    write!(w, "\" element=\"")?;
    for node in own.into_iter().flatten() {
        write!(w, "{} ", nodes.partition_point(|n| n < node))?;
    }
    let (poisson, damping) = (result.poisson_of(label), STEP_AND_DAMPING_S[1]);
    writeln!(w, "\">\n\t\t\t<elasticity young=\"{young:.6e}\" poisson=\"{poisson}\" damping=\"{damping}\"/>")?;
    writeln!(w, "\t\t\t<contact contype=\"0\" conaffinity=\"0\" selfcollide=\"none\"/>\n\t\t</flex>")
}

/// Writes the linear tetrahedra as Gmsh 2.2 (m, RAS), for Gmsh and for a flexcomp of MuJoCo, which
/// has one modulus: a physical group a region, and Young's modulus (Pa) of each element as data.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub fn write_msh(path: impl AsRef<Path>, result: &StiffnessResult) -> Result<(), IoError> {
    write_atomic(path.as_ref(), |w| {
        let tetrahedra = linear(&result.mesh);
        let regions = moduli(result);
        writeln!(w, "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$PhysicalNames\n{}", regions.len())?;
        regions.keys().try_for_each(|label| writeln!(w, "3 {label} \"region{label}\""))?;
        writeln!(w, "$EndPhysicalNames\n$Nodes\n{}", result.mesh.nodes().len())?;
        for (n, p) in (1..).zip(result.mesh.nodes()) {
            let [x, y, z] = p.0.map(|v| v * METRES_PER_MM);
            writeln!(w, "{n} {x:.9} {y:.9} {z:.9}")?;
        }
        writeln!(w, "$EndNodes\n$Elements\n{}", tetrahedra.len())?;
        for (e, t) in tetrahedra.iter().enumerate() {
            let group = result.mesh.labels()[e / LINEAR_PER_QUADRATIC];
            let [a, b, c, d] = t.map(|n| n + 1);
            writeln!(w, "{} 4 2 {group} {group} {a} {b} {c} {d}", e + 1)?;
        }
        let name = "youngs_modulus";
        writeln!(w, "$EndElements\n$ElementData\n1\n\"{name}\"\n1\n0\n3\n0\n1\n{}", tetrahedra.len())?;
        for e in 0..tetrahedra.len() {
            let young = regions.get(&result.mesh.labels()[e / LINEAR_PER_QUADRATIC]).copied().unwrap_or_default();
            writeln!(w, "{} {young:.6e}", e + 1)?;
        }
        writeln!(w, "$EndElementData")
    })
}
