//! The identified model as a scene of SOFA (`.scn`).

use super::atomic::write_atomic;
use super::simulators::{LINEAR_PER_QUADRATIC, METRES_PER_MM, PASCALS_PER_KPA, linear, masses, prescribed};
use crate::error::IoError;
use crate::types::stiffness::{Law, StiffnessResult};
use std::io::{self, Write};
use std::path::Path;

/// Parts of SOFA that the scene uses, as they are named from version 22.12 on.
const PLUGINS: [&str; 8] = [
    "Sofa.Component.AnimationLoop",
    "Sofa.Component.Constraint.Projective",
    "Sofa.Component.LinearSolver.Direct",
    "Sofa.Component.Mass",
    "Sofa.Component.ODESolver.Backward",
    "Sofa.Component.SolidMechanics.FEM.Elastic",
    "Sofa.Component.StateContainer",
    "Sofa.Component.Topology.Container.Dynamic",
];

/// What stands at the head of the scene.
const ABOUT: &str = "Units: m, Pa, kg; places are world RAS; density that of water.\n     Prescribed nodes stand at their pressed \
    place from the first step on, and all others are at rest.\n     One step is long against all waves: after a few the body \
    is in balance.\n     youngModulus has one value a tetrahedron. Linear tetrahedra lock as Poisson's ratio nears 0.5: see \
    docs/reference/stiffness.md.\n     Checked by definition, not by SOFA.";

/// Writes one scene that needs no other file: linear tetrahedra, Young's modulus of each, and the
/// displacement of held and loaded nodes. The linear law gives `method="small"`, the neo-Hookean
/// one SOFA's corotational `"large"`.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub fn write_sofa(path: impl AsRef<Path>, result: &StiffnessResult) -> Result<(), IoError> {
    write_atomic(path.as_ref(), |w| {
        let tetrahedra = linear(&result.mesh);
        writeln!(w, "<?xml version=\"1.0\"?>\n<!-- palpate {}: identified stiffness.", env!("CARGO_PKG_VERSION"))?;
        writeln!(w, "     {ABOUT} -->\n<Node name=\"root\" dt=\"1\" gravity=\"0 0 0\">")?;
        PLUGINS.iter().try_for_each(|name| writeln!(w, "\t<RequiredPlugin name=\"{name}\"/>"))?;
        writeln!(w, "\t<DefaultAnimationLoop/>\n\t<Node name=\"body\">")?;
        writeln!(w, "\t\t<EulerImplicitSolver rayleighStiffness=\"0\" rayleighMass=\"0\"/>")?;
        writeln!(w, "\t\t<SparseLDLSolver template=\"CompressedRowSparseMatrixMat3x3d\"/>")?;
        write!(w, "\t\t<TetrahedronSetTopologyContainer name=\"topology\" tetrahedra=\"")?;
        tetrahedra.iter().try_for_each(|[a, b, c, d]| write!(w, "{a} {b} {c} {d} "))?;
        write!(w, "\"/>\n\t\t<MechanicalObject name=\"nodes\" template=\"Vec3\" rest_position=\"")?;
        state(w, result)?;
        let mass: f64 = masses(&result.mesh, &tetrahedra).iter().sum();
        writeln!(w, "\t\t<UniformMass totalMass=\"{mass:.9e}\"/>")?;
        material(w, result, &tetrahedra)?;
        constraints(w, result)?;
        writeln!(w, "\t</Node>\n</Node>")
    })
}

/// Places at rest, and those that the motion starts from.
fn state(w: &mut impl Write, result: &StiffnessResult) -> io::Result<()> {
    let fixed = prescribed(result);
    let place = |w: &mut dyn Write, p: [f64; 3]| {
        let [x, y, z] = p.map(|v| v * METRES_PER_MM);
        write!(w, "{x:.9} {y:.9} {z:.9} ")
    };
    result.mesh.nodes().iter().try_for_each(|p| place(w, p.0))?;
    write!(w, "\" position=\"")?;
    for (n, p) in (0u32..).zip(result.mesh.nodes()) {
        let moved = fixed.get(&n).copied().unwrap_or_default();
        place(w, std::array::from_fn(|a| p.0[a] + moved[a].unwrap_or(0.0)))?;
    }
    writeln!(w, "\"/>")
}

/// A node for each Poisson's ratio, with the tetrahedra that have it: older versions of SOFA know
/// one ratio a force field.
fn material(w: &mut impl Write, result: &StiffnessResult, tetrahedra: &[[u32; 4]]) -> io::Result<()> {
    let method = if result.law == Law::Linear { "small" } else { "large" };
    let ratio = |e: usize| result.poisson_of(result.mesh.labels()[e]);
    let mut ratios: Vec<f64> = (0..result.element_modulus.len()).map(ratio).collect();
    ratios.sort_unstable_by(f64::total_cmp);
    ratios.dedup();
    for (k, nu) in ratios.into_iter().enumerate() {
        let own: Vec<usize> = (0..result.element_modulus.len()).filter(|&e| ratio(e) == nu).collect();
        write!(w, "\t\t<Node name=\"material{}\">\n\t\t\t<TetrahedronSetTopologyContainer tetrahedra=\"", k + 1)?;
        for [a, b, c, d] in
            own.iter().flat_map(|e| &tetrahedra[LINEAR_PER_QUADRATIC * e..LINEAR_PER_QUADRATIC * (e + 1)])
        {
            write!(w, "{a} {b} {c} {d} ")?;
        }
        write!(w, "\"/>\n\t\t\t<TetrahedronFEMForceField method=\"{method}\" poissonRatio=\"{nu}\" youngModulus=\"")?;
        for e in own {
            let modulus = result.element_modulus[e] * PASCALS_PER_KPA;
            (0..LINEAR_PER_QUADRATIC).try_for_each(|_| write!(w, "{modulus:.6e} "))?;
        }
        writeln!(w, "\"/>\n\t\t</Node>")?;
    }
    Ok(())
}

/// One constraint for each set of axes that nodes are held along.
fn constraints(w: &mut impl Write, result: &StiffnessResult) -> io::Result<()> {
    let fixed = prescribed(result);
    for set in 1u8..8 {
        let axes = [0, 1, 2].map(|a| set >> a & 1);
        let these = |given: &[Option<f64>; 3]| (0..3).all(|a| given[a].is_some() == (axes[a] == 1));
        let nodes: Vec<String> = fixed.iter().filter(|f| these(f.1)).map(|f| f.0.to_string()).collect();
        if nodes.is_empty() {
            continue;
        }
        let nodes = nodes.join(" ");
        match axes {
            [1, 1, 1] => writeln!(w, "\t\t<FixedProjectiveConstraint indices=\"{nodes}\"/>")?,
            [x, y, z] => writeln!(
                w,
                "\t\t<PartialFixedProjectiveConstraint fixedDirections=\"{x} {y} {z}\" indices=\"{nodes}\"/>"
            )?,
        }
    }
    Ok(())
}
