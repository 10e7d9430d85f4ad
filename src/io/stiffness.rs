//! Tables and simulation models of a stiffness result: regions.csv, FEBio (`.feb`), Abaqus and
//! CalculiX (`.inp`).
//!
//! The models repeat the identified problem: the same quadratic tetrahedra, one material a region
//! (or a class of modulus), the held and loaded nodes with their displacements. Units: mm, N, MPa
//! (both programs take any consistent set).

use super::atomic::write_atomic;
use super::csv::{read_table, write_table};
use super::format;
use crate::error::IoError;
use crate::types::plan::Plan;
use crate::types::space::{cross, dot};
use crate::types::stiffness::{Determined, Law, Prescribed, RegionStiffness, SharedStiffness, StiffnessResult};
use std::io::{self, Write};
use std::path::Path;

/// Columns of regions.csv.
const COLUMNS: [&str; 8] = ["label", "name", "youngs_modulus_kpa", "sd_kpa", "ratio", "identifiable", "state", "bound"];

/// Writes a row for each frame and region: frame, motion_mm (mean), residual_mm, label, name, value
/// (kPa, or the ratio without a force), sd, identifiable; a frame that tells nothing has one row
/// with the reason in `why`.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub(crate) fn write_frames(path: impl AsRef<Path>, shared: &SharedStiffness) -> Result<(), IoError> {
    const COLUMNS: [&str; 9] =
        ["frame", "motion_mm", "residual_mm", "label", "name", "value", "sd", "identifiable", "why"];
    let number = |v: f64| if v.is_finite() { format!("{v:.6}") } else { String::new() };
    let absolute = shared.result.absolute;
    let rows = shared.frames.iter().flat_map(|f| {
        let start = [f.frame.to_string(), number(f.motion_mm), number(f.residual_mm)];
        match &f.regions {
            Err(why) => vec![[&start[..], &vec![String::new(); 5], std::slice::from_ref(why)].concat()],
            Ok(regions) => regions
                .iter()
                .map(|r| {
                    let [value, sd] = if absolute { [r.youngs_modulus, r.sd] } else { [r.ratio, r.ratio_sd] };
                    let seen = u8::from(r.identifiable).to_string();
                    let rest = [r.label.to_string(), r.name.clone(), number(value), number(sd), seen, String::new()];
                    [&start[..], &rest].concat()
                })
                .collect(),
        }
    });
    write_table(path.as_ref(), &COLUMNS, rows)
}

/// Writes a row for each choice of a plan and region: press, voxel and noise (mm), label, name,
/// expected standard deviation and the scatter by noise alone (%), determined and enough (1 or 0).
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub(crate) fn write_plan(path: impl AsRef<Path>, plan: &Plan) -> Result<(), IoError> {
    const COLUMNS: [&str; 9] = [
        "press_mm",
        "voxel_mm",
        "noise_mm",
        "label",
        "name",
        "expected_sd_percent",
        "scatter_percent",
        "determined",
        "enough",
    ];
    let rows = plan.expected.iter().map(|e| {
        let lengths = [e.press_mm, e.voxel_mm, e.noise_mm].map(|v| format!("{v:.6}"));
        let sds = [e.sd, e.scatter].map(|v| format!("{:.4}", 100.0 * v));
        let said = [e.determined, e.enough].map(|v| u8::from(v).to_string());
        let named = [e.label.to_string(), e.name.clone()];
        lengths.into_iter().chain(named).chain(sds).chain(said).collect()
    });
    write_table(path.as_ref(), &COLUMNS, rows)
}

/// Writes label, name, Young's modulus (kPa), standard deviation (kPa; empty where not
/// identifiable), ratio to the reference region, identifiable (1 or 0), state (determined, bound,
/// unknown or given) and, of a bound, lower or upper. Without a force the kPa columns are empty.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub(crate) fn write_regions(
    path: impl AsRef<Path>,
    regions: &[RegionStiffness],
    absolute: bool,
) -> Result<(), IoError> {
    let number = |v: f64| if v.is_finite() { format!("{v:.6}") } else { String::new() };
    let kpa = |v: f64| if absolute { number(v) } else { String::new() };
    let row = |r: &RegionStiffness| {
        vec![
            r.label.to_string(),
            r.name.clone(),
            kpa(r.youngs_modulus),
            kpa(r.sd),
            number(r.ratio),
            u8::from(r.identifiable).to_string(),
            r.state.name().into(),
            r.bound.filter(|_| r.state == Determined::Bound).unwrap_or_default().into(),
        ]
    };
    write_table(path.as_ref(), &COLUMNS, regions.iter().map(row))
}

/// What is known of a label's material.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct KnownMaterial {
    /// The label.
    pub label: u8,
    /// Its Poisson's ratio, where it is given.
    pub poisson: Option<f64>,
    /// Its Young's modulus (kPa), where it is given.
    pub youngs_modulus: Option<f64>,
}

/// Reads a table by label: the columns `label`, and `poisson` or `youngs_modulus_kpa` or both,
/// where an empty field is open; other columns are left alone.
///
/// # Errors
/// [`IoError`] names the line that cannot be read, and a table without these columns.
pub(crate) fn read_materials(path: impl AsRef<Path>) -> Result<Vec<KnownMaterial>, IoError> {
    let path = path.as_ref();
    let table = read_table(path, ["label"])?;
    let column = |name: &str| table.other_columns.iter().position(|c| c.eq_ignore_ascii_case(name));
    let [poisson, modulus] = [column("poisson"), column("youngs_modulus_kpa")];
    if poisson.is_none() && modulus.is_none() {
        return Err(format(path, "has no column poisson or youngs_modulus_kpa", "name one of them in the first line"));
    }
    let mut out: Vec<KnownMaterial> = Vec::new();
    for (row, (&[label], rest)) in table.numbers.iter().zip(&table.others).enumerate() {
        let wrong = |what: String| format(path, format!("row {}: {what}", row + 1), "correct or remove that row");
        if !(1.0..=255.0).contains(&label) || label.fract() != 0.0 {
            return Err(wrong(format!("label is {label}, not a whole number from 1 to 255")));
        }
        let label = label as u8;
        if out.iter().any(|m| m.label == label) {
            return Err(wrong(format!("label {label} is there twice")));
        }
        let number = |column: Option<usize>| match column.map(|c| rest[c].trim()) {
            None | Some("") => Ok(None),
            Some(text) => text.parse().map(Some).map_err(|_| wrong(format!("{text:?} is not a number"))),
        };
        out.push(KnownMaterial { label, poisson: number(poisson)?, youngs_modulus: number(modulus)? });
    }
    Ok(out)
}

/// Elements of one material: its number of region, modulus (MPa) and elements.
fn materials(result: &StiffnessResult) -> Vec<(u8, f64, Vec<usize>)> {
    let mut out: Vec<(u8, f64, Vec<usize>)> = Vec::new();
    for (e, &label) in result.mesh.labels().iter().enumerate() {
        match out.iter_mut().find(|m| m.0 == label) {
            Some(m) => m.2.push(e),
            None => out.push((label, result.element_modulus[e] / 1000.0, vec![e])),
        }
    }
    out.sort_by_key(|m| m.0);
    out
}

/// Sides of the coordinate axis along which a prescribed direction lies, where it lies along one.
fn axis_of(p: &Prescribed) -> Option<usize> {
    p.direction.and_then(|d| (0..3).find(|&a| d[a].abs() > 0.999))
}

/// The displacement components that are prescribed at a node.
pub(super) fn components(p: &Prescribed) -> Vec<(usize, f64)> {
    match (p.direction, axis_of(p)) {
        (None, _) => (0..3).map(|a| (a, p.displacement[a])).collect(),
        (Some(d), Some(a)) => {
            let along: f64 = (0..3).map(|b| d[b] * p.displacement[b]).sum();
            vec![(a, along / d[a])]
        }
        // A slanted plane has no single component; the model keeps the node where it was found.
        (Some(_), None) => (0..3).map(|a| (a, p.displacement[a])).collect(),
    }
}

/// Nodes and axes that hold the body where what is prescribed leaves it free to move as a rigid
/// body (plates that slide): without force, as nothing else acts along them. Each holds what is
/// still free better than any other would.
pub(super) fn pins(result: &StiffnessResult) -> Vec<(u32, usize)> {
    let place = |p: &Prescribed| result.mesh.nodes()[p.node as usize];
    let Some(first) = result.prescribed.first().map(place) else { return Vec::new() };
    let arm = |p: &Prescribed| place(p).minus(first);
    let size = result.prescribed.iter().map(|p| dot(arm(p), arm(p))).fold(0.0, f64::max).sqrt().max(f64::MIN_POSITIVE);
    // How a component of a node moves with a translation of the body and a rotation about the first
    // node; what is left of it beside the motions that are held already (orthonormal).
    let left = |held: &[[f64; 6]], p: &Prescribed, a: usize| {
        let mut axis = [0.0; 3];
        axis[a] = 1.0;
        let turn = cross(arm(p), axis).map(|v| v / size);
        let mut row: [f64; 6] = std::array::from_fn(|i| if i < 3 { axis[i] } else { turn[i - 3] });
        for h in held {
            let along: f64 = h.iter().zip(&row).map(|(h, r)| h * r).sum();
            row.iter_mut().zip(h).for_each(|(r, h)| *r -= along * h);
        }
        (row.iter().map(|r| r * r).sum::<f64>().sqrt(), row)
    };
    let mut held: Vec<[f64; 6]> = Vec::new();
    for (p, a) in result.prescribed.iter().flat_map(|p| components(p).into_iter().map(move |c| (p, c.0))) {
        let (length, row) = left(&held, p, a);
        if length > 1e-3 && held.len() < 6 {
            held.push(row.map(|r| r / length));
        }
    }
    let mut out = Vec::new();
    while held.len() < 6 {
        let all = result.prescribed.iter().flat_map(|p| (0..3).map(move |a| (p, a)));
        let best = all.map(|(p, a)| (left(&held, p, a), p.node, a)).max_by(|x, y| x.0.0.total_cmp(&y.0.0));
        let Some(((length, row), node, a)) = best.filter(|b| b.0.0 > 1e-6) else { break };
        held.push(row.map(|r| r / length));
        out.push((node, a));
    }
    out
}

/// Writes the model for Abaqus and CalculiX: C3D10 elements, `*ELASTIC` or
/// `*HYPERELASTIC, NEO HOOKE`, one static step with the prescribed displacements; displacements and
/// reaction forces are printed.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub fn write_inp(path: impl AsRef<Path>, result: &StiffnessResult) -> Result<(), IoError> {
    write_atomic(path.as_ref(), |w| {
        writeln!(w, "*HEADING\npalpate {}: identified stiffness; mm, N, MPa", env!("CARGO_PKG_VERSION"))?;
        writeln!(w, "*NODE, NSET=ALL")?;
        for (n, p) in result.mesh.nodes().iter().enumerate() {
            writeln!(w, "{}, {:.9}, {:.9}, {:.9}", n + 1, p.0[0], p.0[1], p.0[2])?;
        }
        let materials = materials(result);
        for (label, _, elements) in &materials {
            writeln!(w, "*ELEMENT, TYPE=C3D10, ELSET=REGION{label}")?;
            for &e in elements {
                let t = result.mesh.tetrahedra()[e].map(|n| (n + 1).to_string());
                writeln!(w, "{}, {}", e + 1, t.join(", "))?;
            }
        }
        for (patch, name) in ["HELD", "LOADED"].iter().enumerate() {
            node_set(w, name, result.prescribed.iter().filter(|p| p.patch as usize == patch).map(|p| p.node))?;
        }
        for (label, e, _) in &materials {
            let nu = result.poisson_of(*label);
            writeln!(w, "*MATERIAL, NAME=MATERIAL{label}")?;
            match result.law {
                Law::Linear => writeln!(w, "*ELASTIC\n{e:.9e}, {nu}")?,
                Law::NeoHookean => {
                    // C10 = mu / 2, D1 = 2 / K.
                    let (mu, bulk) = (e / (2.0 * (1.0 + nu)), e / (3.0 * (1.0 - 2.0 * nu)));
                    writeln!(w, "*HYPERELASTIC, NEO HOOKE\n{:.9e}, {:.9e}", 0.5 * mu, 2.0 / bulk)?;
                }
            }
            writeln!(w, "*SOLID SECTION, ELSET=REGION{label}, MATERIAL=MATERIAL{label}")?;
        }
        match result.law {
            Law::Linear => writeln!(w, "*STEP\n*STATIC")?,
            Law::NeoHookean => writeln!(w, "*STEP, NLGEOM, INC=100\n*STATIC\n0.25, 1.0")?,
        }
        writeln!(w, "*BOUNDARY")?;
        for p in &result.prescribed {
            for (a, v) in components(p) {
                writeln!(w, "{}, {}, {}, {v:.9e}", p.node + 1, a + 1, a + 1)?;
            }
        }
        for (node, a) in pins(result) {
            writeln!(w, "{}, {}, {}, {:.9e}", node + 1, a + 1, a + 1, result.displacement[node as usize][a])?;
        }
        writeln!(
            w,
            "*NODE PRINT, NSET=ALL\nU\n*NODE PRINT, NSET=LOADED, TOTALS=ONLY\nRF\n*NODE FILE\nU\n*EL FILE\nS\n*END STEP"
        )
    })
}

fn node_set(w: &mut impl Write, name: &str, nodes: impl Iterator<Item = u32>) -> io::Result<()> {
    writeln!(w, "*NSET, NSET={name}")?;
    let all: Vec<String> = nodes.map(|n| (n + 1).to_string()).collect();
    all.chunks(12).try_for_each(|line| writeln!(w, "{},", line.join(", ")))
}

/// Writes the model for FEBio 4: tet10 elements, `isotropic elastic` or `neo-Hookean` materials,
/// prescribed displacements over one static step.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub fn write_feb(path: impl AsRef<Path>, result: &StiffnessResult) -> Result<(), IoError> {
    write_atomic(path.as_ref(), |w| {
        let materials = materials(result);
        writeln!(
            w,
            "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<febio_spec version=\"4.0\">\n\t<Module type=\"solid\"/>"
        )?;
        writeln!(
            w,
            "\t<Control>\n\t\t<analysis>STATIC</analysis>\n\t\t<time_steps>10</time_steps>\n\t\t<step_size>0.1</step_size>\n\
             \t\t<solver type=\"solid\"><symmetric_stiffness>symmetric</symmetric_stiffness></solver>\n\t</Control>\n\t<Material>"
        )?;
        for (i, (label, e, _)) in materials.iter().enumerate() {
            let kind = if result.law == Law::Linear { "isotropic elastic" } else { "neo-Hookean" };
            writeln!(
                w,
                "\t\t<material id=\"{}\" name=\"material{label}\" type=\"{kind}\"><E>{e:.9e}</E><v>{}</v></material>",
                i + 1,
                result.poisson_of(*label)
            )?;
        }
        writeln!(w, "\t</Material>\n\t<Mesh>\n\t\t<Nodes name=\"body\">")?;
        for (n, p) in result.mesh.nodes().iter().enumerate() {
            writeln!(w, "\t\t\t<node id=\"{}\">{:.9},{:.9},{:.9}</node>", n + 1, p.0[0], p.0[1], p.0[2])?;
        }
        writeln!(w, "\t\t</Nodes>")?;
        for (label, _, elements) in &materials {
            writeln!(w, "\t\t<Elements type=\"tet10\" name=\"region{label}\">")?;
            for &e in elements {
                let t = result.mesh.tetrahedra()[e].map(|n| (n + 1).to_string());
                writeln!(w, "\t\t\t<elem id=\"{}\">{}</elem>", e + 1, t.join(","))?;
            }
            writeln!(w, "\t\t</Elements>")?;
        }
        let groups = groups(result);
        for (name, group) in &groups {
            let all: Vec<String> = group.iter().map(|p| (p.node + 1).to_string()).collect();
            writeln!(w, "\t\t<NodeSet name=\"{name}\">{}</NodeSet>", all.join(","))?;
        }
        let pins = pins(result);
        for (i, (node, _)) in (1..).zip(&pins) {
            writeln!(w, "\t\t<NodeSet name=\"pin{i}\">{}</NodeSet>", node + 1)?;
        }
        writeln!(w, "\t</Mesh>\n\t<MeshDomains>")?;
        for (label, _, _) in &materials {
            writeln!(w, "\t\t<SolidDomain name=\"region{label}\" mat=\"material{label}\"/>")?;
        }
        writeln!(w, "\t</MeshDomains>\n\t<MeshData>")?;
        let names = ["x", "y", "z"];
        for (name, group) in &groups {
            for a in 0..3 {
                if !components(group[0]).iter().any(|c| c.0 == a) {
                    continue;
                }
                writeln!(w, "\t\t<NodeData name=\"{name}_{}\" node_set=\"{name}\" data_type=\"scalar\">", names[a])?;
                for (i, p) in group.iter().enumerate() {
                    let v = components(p).iter().find(|c| c.0 == a).map_or(0.0, |c| c.1);
                    writeln!(w, "\t\t\t<node lid=\"{}\">{v:.9e}</node>", i + 1)?;
                }
                writeln!(w, "\t\t</NodeData>")?;
            }
        }
        writeln!(w, "\t</MeshData>\n\t<Boundary>")?;
        for (name, group) in &groups {
            for (a, _) in components(group[0]) {
                let axis = names[a];
                writeln!(
                    w,
                    "\t\t<bc name=\"{name}_{axis}\" type=\"prescribed displacement\" node_set=\"{name}\"><dof>{axis}</dof>\
                     <value lc=\"1\" type=\"map\">{name}_{axis}</value><relative>0</relative></bc>"
                )?;
            }
        }
        for (i, (node, a)) in (1..).zip(&pins) {
            let (axis, value) = (names[*a], result.displacement[*node as usize][*a]);
            writeln!(
                w,
                "\t\t<bc name=\"pin{i}\" type=\"prescribed displacement\" node_set=\"pin{i}\"><dof>{axis}</dof>\
                 <value lc=\"1\">{value:.9e}</value><relative>0</relative></bc>"
            )?;
        }
        writeln!(
            w,
            "\t</Boundary>\n\t<LoadData>\n\t\t<load_controller id=\"1\" name=\"ramp\" type=\"loadcurve\">\n\
             \t\t\t<interpolate>LINEAR</interpolate>\n\t\t\t<extend>CONSTANT</extend>\n\
             \t\t\t<points><pt>0,0</pt><pt>1,1</pt></points>\n\t\t</load_controller>\n\t</LoadData>\n\t<Output>\n\
             \t\t<plotfile type=\"febio\"><var type=\"displacement\"/><var type=\"stress\"/></plotfile>\n\t</Output>\n</febio_spec>"
        )
    })
}

/// The prescribed nodes by patch.
fn groups(result: &StiffnessResult) -> Vec<(&'static str, Vec<&Prescribed>)> {
    let of = |patch: u8| result.prescribed.iter().filter(|p| p.patch == patch).collect::<Vec<_>>();
    [("held", of(0)), ("loaded", of(1))].into_iter().filter(|g| !g.1.is_empty()).collect()
}
