//! Meshes of FEBio 3 and 4 (`.feb`): `Nodes`, `Elements` and `NodeSet` of the section `Mesh`.

use super::edit::Edit;
use crate::io::format_error::Flaw;
use crate::types::{Measured, MeasuredNode, SolidElement, SolidMesh, SolidShape, WorldPoint};
use roxmltree::{Document, Node, ParsingOptions};
use std::collections::HashMap;
use std::fmt::Write;

/// What to try with a file that FEBio would not take either.
const AGAIN: &str = "save it in FEBio Studio as version 3 or 4";
const AXES: [&str; 3] = ["x", "y", "z"];

/// The file as XML, and its version.
fn document(text: &str) -> Result<(Document<'_>, u32), Flaw> {
    let options = ParsingOptions { nodes_limit: u32::MAX, ..ParsingOptions::default() };
    let document = Document::parse_with_options(text, options)
        .map_err(|e| Flaw::new(format!("is no well-formed XML ({e})"), AGAIN))?;
    let root = document.root_element();
    if root.tag_name().name() != "febio_spec" {
        return Err(Flaw::new("is no file of FEBio (its first element is not febio_spec)", "give a .feb file"));
    }
    let version = root.attribute("version").unwrap_or_default();
    match version.split('.').next().and_then(|v| v.parse().ok()) {
        Some(major @ 3..=4) => Ok((document, major)),
        _ => Err(Flaw::new(format!("is version {version:?} of FEBio's format"), AGAIN)),
    }
}

/// The section of this name.
fn section<'a>(document: &'a Document<'_>, name: &str) -> Option<Node<'a, 'a>> {
    document.root_element().children().find(|n| n.has_tag_name(name))
}

fn numbers<T: std::str::FromStr>(text: &str, what: &str) -> Result<Vec<T>, Flaw> {
    let parts = text.split([',', ' ', '\t', '\n', '\r']).filter(|p| !p.is_empty());
    let bad = |p: &str| Flaw::new(format!("{what}: {p:?} is no number that fits there"), AGAIN);
    parts.map(|p| p.parse().map_err(|_| bad(p))).collect()
}

/// The number that an element of the file has.
fn id(node: Node<'_, '_>, what: &str) -> Result<u64, Flaw> {
    let found = node.attribute("id").and_then(|v| v.trim().parse().ok());
    found.ok_or_else(|| Flaw::new(format!("{what} has no id that is a number"), AGAIN))
}

/// Reads the mesh.
pub(super) fn read(text: &str) -> Result<SolidMesh, Flaw> {
    let (document, _) = document(text)?;
    let Some(mesh) = section(&document, "Mesh") else {
        return Err(Flaw::new("has no section Mesh", AGAIN));
    };
    let (mut places, mut own, mut of) = (Vec::new(), Vec::new(), HashMap::new());
    for node in mesh.children().filter(|n| n.has_tag_name("Nodes")).flat_map(|n| n.children()) {
        if !node.has_tag_name("node") {
            continue;
        }
        let number = id(node, "a node")?;
        let place: Vec<f64> = numbers(node.text().unwrap_or_default(), "a node")?;
        let Ok(place) = <[f64; 3]>::try_from(place) else {
            return Err(Flaw::new(format!("node {number} has not three coordinates"), AGAIN));
        };
        if of.insert(number, places.len() as u32).is_some() {
            return Err(Flaw::new(format!("node {number} is given twice"), AGAIN));
        }
        places.push(WorldPoint(place));
        own.push(number);
    }
    let place = |number: &u64| {
        let missing = || Flaw::new(format!("node {number} is named and not there"), AGAIN);
        of.get(number).copied().ok_or_else(missing)
    };
    let elements = elements(mesh, &place)?;
    let mut sets = Vec::new();
    for set in mesh.children().filter(|n| n.has_tag_name("NodeSet")) {
        sets.push((set.attribute("name").unwrap_or_default().to_string(), members(set, &place)?));
    }
    super::assembled(SolidMesh::new(places, own, elements, sets))
}

/// The solid elements; shells are left out.
fn elements(mesh: Node<'_, '_>, place: &dyn Fn(&u64) -> Result<u32, Flaw>) -> Result<Vec<SolidElement>, Flaw> {
    let mut out = Vec::new();
    for part in mesh.children().filter(|n| n.has_tag_name("Elements")) {
        let Some(shape) = shape(part.attribute("type").unwrap_or_default())? else { continue };
        for element in part.children().filter(|n| n.has_tag_name("elem")) {
            let number = id(element, "an element")?;
            let nodes: Vec<u64> = numbers(element.text().unwrap_or_default(), "an element")?;
            if nodes.len() != shape.nodes() {
                let what = format!("element {number} has {} nodes for {}", nodes.len(), shape.nodes());
                return Err(Flaw::new(what, AGAIN));
            }
            let nodes = nodes.iter().map(place).collect::<Result<_, _>>()?;
            out.push(SolidElement { number, shape, nodes });
        }
    }
    Ok(out)
}

fn shape(name: &str) -> Result<Option<SolidShape>, Flaw> {
    Ok(Some(match name.to_ascii_lowercase().as_str() {
        "tet4" => SolidShape::Tetrahedron,
        "tet10" => SolidShape::QuadraticTetrahedron,
        "hex8" => SolidShape::Hexahedron,
        "hex20" => SolidShape::QuadraticHexahedron,
        n if ["tri", "quad", "q4", "q8", "line", "truss"].iter().any(|s| n.starts_with(s)) => return Ok(None),
        _ => {
            return Err(Flaw::new(format!("elements of type {name:?} are not read"), "use tet4, tet10, hex8 or hex20"));
        }
    }))
}

/// Members of a set of nodes: a list, or in version 3 one child each.
fn members(set: Node<'_, '_>, place: &dyn Fn(&u64) -> Result<u32, Flaw>) -> Result<Vec<u32>, Flaw> {
    let children = set.children().filter(|n| n.is_element()).map(|n| id(n, "a node of a set"));
    let mut found: Vec<u64> = children.collect::<Result<_, _>>()?;
    found.extend(numbers::<u64>(set.text().unwrap_or_default(), "a set of nodes")?);
    found.iter().map(place).collect()
}

/// The nodes of each patch.
fn patches(measured: &Measured) -> Vec<(&str, Vec<&MeasuredNode>)> {
    let mut out: Vec<(&str, Vec<&MeasuredNode>)> = Vec::new();
    for m in &measured.nodes {
        match out.iter_mut().find(|p| p.0 == m.patch) {
            Some(patch) => patch.1.push(m),
            None => out.push((&m.patch, vec![m])),
        }
    }
    out
}

/// A set of nodes, its displacements and the conditions on them, for each patch; one load curve.
pub(super) fn edits(text: &str, mesh: &SolidMesh, measured: &Measured) -> Result<Vec<Edit>, Flaw> {
    let (document, version) = document(text)?;
    let controllers = document.descendants().filter(|n| n.has_tag_name("load_controller"));
    let used = controllers.filter_map(|n| n.attribute("id")?.parse::<u64>().ok()).max().unwrap_or(0);
    let curve = used + 1;
    let (mut sets, mut data, mut conditions) = (String::new(), String::new(), String::new());
    for (number, (_, nodes)) in (1..).zip(patches(measured)) {
        let name = format!("palpate{number}");
        node_set(&mut sets, version, &name, mesh, &nodes);
        for (a, axis) in AXES.into_iter().enumerate() {
            let _ = writeln!(data, "\t\t<NodeData name=\"{name}_{axis}\" node_set=\"{name}\" data_type=\"scalar\">");
            for (i, m) in (1..).zip(&nodes) {
                let _ = writeln!(data, "\t\t\t<node lid=\"{i}\">{:.9e}</node>", m.displacement[a]);
            }
            data += "\t\t</NodeData>\n";
            condition(&mut conditions, version, &name, axis, curve);
        }
    }
    let load = format!(
        "\t\t<load_controller id=\"{curve}\" type=\"loadcurve\"><interpolate>LINEAR</interpolate>\
         <points><pt>0,0</pt><pt>1,1</pt></points></load_controller>\n"
    );
    let parts = [("Mesh", sets), ("MeshData", data), ("Boundary", conditions), ("LoadData", load)];
    Ok(into_sections(text, &document, &parts))
}

fn node_set(out: &mut String, version: u32, name: &str, mesh: &SolidMesh, nodes: &[&MeasuredNode]) {
    let own = nodes.iter().map(|m| mesh.numbers()[m.node as usize]);
    let list: Vec<String> = match version {
        3 => own.map(|n| format!("<node id=\"{n}\"/>")).collect(),
        _ => own.map(|n| n.to_string()).collect(),
    };
    let _ = writeln!(out, "\t\t<NodeSet name=\"{name}\">{}</NodeSet>", list.join(if version == 3 { "" } else { "," }));
}

fn condition(out: &mut String, version: u32, name: &str, axis: &str, curve: u64) {
    let (kind, value) = if version == 3 { ("prescribe", "scale") } else { ("prescribed displacement", "value") };
    let _ = writeln!(
        out,
        "\t\t<bc name=\"{name}_{axis}\" type=\"{kind}\" node_set=\"{name}\"><dof>{axis}</dof>\
         <{value} lc=\"{curve}\" type=\"map\">{name}_{axis}</{value}><relative>0</relative></bc>"
    );
}

/// Sections of the file in FEBio's order.
const ORDER: [&str; 6] = ["Mesh", "MeshDomains", "MeshAdaptor", "MeshData", "Boundary", "LoadData"];

/// Text into the sections of these names; one that is not there is made behind those before it.
fn into_sections(source: &str, document: &Document<'_>, parts: &[(&str, String)]) -> Vec<Edit> {
    let mut edits = Vec::new();
    for (name, text) in parts {
        if let Some(node) = section(document, name) {
            edits.push(Edit::into(source, node, text));
            continue;
        }
        let before = ORDER.iter().take_while(|o| *o != name).filter_map(|o| section(document, o));
        let end = before.map(|n| n.range().end).max().unwrap_or(0);
        edits.push(Edit::insert(end, format!("\n\t<{name}>\n{text}\t</{name}>")));
    }
    edits
}
