//! Meshes of Abaqus and CalculiX (`.inp`): `*NODE`, `*ELEMENT`, `*NSET`, one part at most.

use super::edit::Edit;
use crate::io::format_error::Flaw;
use crate::types::{ElementModulus, Measured, SolidElement, SolidMesh, SolidShape, WorldPoint};
use std::collections::{BTreeMap, HashMap};
use std::fmt::Write;

/// Numbers on a line of a list at most.
const PER_LINE: usize = 12;
/// What to try with nodes that share their numbers.
const FLAT: &str = "write the mesh as one flat file: in Abaqus/CAE, `Do not use parts and assemblies in input files`";

/// A keyword line: the keyword and its parameters, in capitals (values as they stand).
struct Keyword<'a> {
    name: String,
    parameters: Vec<(String, &'a str)>,
}

impl<'a> Keyword<'a> {
    fn of(line: &'a str) -> Option<Self> {
        let line = line.trim().strip_prefix('*').filter(|l| !l.starts_with('*'))?;
        let mut parts = line.split(',').map(str::trim);
        let name = parts.next()?.to_ascii_uppercase();
        let parameter = |p: &'a str| {
            let (key, value) = p.split_once('=').unwrap_or((p, ""));
            (key.trim().to_ascii_uppercase(), value.trim().trim_matches('"'))
        };
        Some(Self { name, parameters: parts.map(parameter).collect() })
    }

    fn get(&self, key: &str) -> Option<&'a str> {
        self.parameters.iter().find(|p| p.0 == key).map(|p| p.1)
    }
}

/// What is read so far.
#[derive(Default)]
struct Reader {
    nodes: Vec<WorldPoint>,
    numbers: Vec<u64>,
    places: HashMap<u64, u32>,
    elements: Vec<SolidElement>,
    sets: Vec<(String, Vec<u32>)>,
    /// Nodes of the element that goes on over the next line.
    open: Vec<u64>,
}

/// What the lines after a keyword hold.
enum Section {
    Nodes(Option<usize>),
    Elements(SolidShape),
    Set(usize, bool),
    Other,
}

/// Reads the mesh.
pub(super) fn read(text: &str) -> Result<SolidMesh, Flaw> {
    let mut reader = Reader::default();
    let mut section = Section::Other;
    for (number, line) in (1..).zip(text.lines()) {
        let here = |flaw: Wrong| Flaw::new(format!("line {number}: {}", flaw.0), flaw.1);
        if line.trim_start().starts_with("**") || line.trim().is_empty() {
            continue;
        }
        section = match Keyword::of(line) {
            Some(keyword) => reader.section(&keyword).map_err(here)?,
            None => {
                reader.data(line, &section).map_err(here)?;
                section
            }
        };
    }
    if !reader.open.is_empty() {
        return Err(Flaw::new("ends within an element", "export it again"));
    }
    let Reader { nodes, numbers, elements, sets, .. } = reader;
    super::assembled(SolidMesh::new(nodes, numbers, elements, sets))
}

/// What is wrong on a line, and what to try.
struct Wrong(String, &'static str);

fn number<T: std::str::FromStr>(text: &str) -> Result<T, Wrong> {
    text.trim()
        .parse()
        .map_err(|_| Wrong(format!("{:?} is no number that fits here", text.trim()), "correct that line"))
}

impl Reader {
    fn section(&mut self, keyword: &Keyword<'_>) -> Result<Section, Wrong> {
        if !self.open.is_empty() {
            return Err(Wrong("an element has too few nodes".into(), "export the mesh again"));
        }
        match keyword.name.as_str() {
            "NODE" if keyword.get("INPUT").is_some() => Err(include()),
            "NODE" if keyword.get("SYSTEM").is_some_and(|s| !s.eq_ignore_ascii_case("R")) => {
                Err(Wrong("nodes are not in Cartesian coordinates".into(), "write them as x, y, z (mm, RAS)"))
            }
            "NODE" => Ok(Section::Nodes(keyword.get("NSET").map(|name| self.set(name)))),
            "ELEMENT" if keyword.get("INPUT").is_some() => Err(include()),
            "ELEMENT" => Ok(shape(keyword.get("TYPE").unwrap_or_default())?.map_or(Section::Other, Section::Elements)),
            "NSET" => {
                let Some(name) = keyword.get("NSET") else {
                    return Err(Wrong("a set of nodes has no name".into(), "add NSET=NAME"));
                };
                Ok(Section::Set(self.set(name), keyword.get("GENERATE").is_some()))
            }
            "INCLUDE" => Err(include()),
            _ => Ok(Section::Other),
        }
    }

    /// The set of this name, which is made where there is none.
    fn set(&mut self, name: &str) -> usize {
        let found = self.sets.iter().position(|s| s.0.eq_ignore_ascii_case(name));
        found.unwrap_or_else(|| {
            self.sets.push((name.into(), Vec::new()));
            self.sets.len() - 1
        })
    }

    fn data(&mut self, line: &str, section: &Section) -> Result<(), Wrong> {
        match section {
            Section::Nodes(set) => self.node(line, *set),
            Section::Elements(shape) => self.element(line, *shape),
            Section::Set(set, generate) => self.members(line, *set, *generate),
            Section::Other => Ok(()),
        }
    }

    fn node(&mut self, line: &str, set: Option<usize>) -> Result<(), Wrong> {
        let mut parts = line.split(',');
        let own: u64 = number(parts.next().unwrap_or_default())?;
        let mut place = [0.0; 3];
        for v in &mut place {
            *v = number(parts.next().filter(|p| !p.trim().is_empty()).unwrap_or("0"))?;
        }
        let at = self.nodes.len() as u32;
        if self.places.insert(own, at).is_some() {
            return Err(Wrong(format!("node {own} is given twice"), FLAT));
        }
        self.nodes.push(WorldPoint(place));
        self.numbers.push(own);
        if let Some(set) = set {
            self.sets[set].1.push(at);
        }
        Ok(())
    }

    fn element(&mut self, line: &str, shape: SolidShape) -> Result<(), Wrong> {
        for part in line.split(',').filter(|p| !p.trim().is_empty()) {
            self.open.push(number(part)?);
        }
        let needed = shape.nodes() + 1;
        if self.open.len() > needed {
            return Err(Wrong(format!("{} nodes for {}", self.open.len() - 1, shape.nodes()), "correct that element"));
        }
        if self.open.len() == needed {
            let nodes = self.open[1..].iter().map(|n| self.place(*n)).collect::<Result<_, _>>()?;
            self.elements.push(SolidElement { number: self.open[0], shape, nodes });
            self.open.clear();
        }
        Ok(())
    }

    fn place(&self, number: u64) -> Result<u32, Wrong> {
        let missing = || Wrong(format!("names node {number}, which is not there"), "give all *NODE lines before");
        self.places.get(&number).copied().ok_or_else(missing)
    }

    fn members(&mut self, line: &str, set: usize, generate: bool) -> Result<(), Wrong> {
        let mut found = self.named(line, generate)?;
        let own = &mut self.sets[set].1;
        own.append(&mut found);
        own.sort_unstable();
        own.dedup();
        Ok(())
    }

    /// The nodes that a line of a set names, some of them more than once.
    fn named(&self, line: &str, generate: bool) -> Result<Vec<u32>, Wrong> {
        let parts: Vec<&str> = line.split(',').map(str::trim).filter(|p| !p.is_empty()).collect();
        if generate {
            let bound = |i: usize| parts.get(i).map(|p| number::<u64>(p)).transpose();
            let (first, last, step) = (bound(0)?.unwrap_or(0), bound(1)?.unwrap_or(0), bound(2)?.unwrap_or(1).max(1));
            let inside = |n: &&u64| (first..=last).contains(*n) && (**n - first).is_multiple_of(step);
            return Ok(self.numbers.iter().filter(inside).map(|n| self.places[n]).collect());
        }
        let mut out = Vec::new();
        for part in parts {
            if let Ok(node) = part.parse() {
                out.push(self.place(node)?);
                continue;
            }
            let Some(other) = self.sets.iter().find(|s| s.0.eq_ignore_ascii_case(part)) else {
                return Err(Wrong(format!("names the set {part:?}, which is not there"), "give that set before"));
            };
            out.extend_from_slice(&other.1);
            // Sets named over and over must not fill memory.
            if out.len() > 2 * self.nodes.len() {
                out.sort_unstable();
                out.dedup();
            }
        }
        Ok(out)
    }
}

fn include() -> Wrong {
    Wrong("takes in another file".into(), "paste that file in its place")
}

/// The shape of a type of element; none for shells and lines, which are left out.
fn shape(name: &str) -> Result<Option<SolidShape>, Wrong> {
    let name = name.to_ascii_uppercase();
    let Some(rest) = name.strip_prefix("C3D") else { return Ok(None) };
    let nodes: String = rest.chars().take_while(char::is_ascii_digit).collect();
    match nodes.as_str() {
        "4" => Ok(Some(SolidShape::Tetrahedron)),
        "10" => Ok(Some(SolidShape::QuadraticTetrahedron)),
        "8" => Ok(Some(SolidShape::Hexahedron)),
        "20" => Ok(Some(SolidShape::QuadraticHexahedron)),
        _ => Err(Wrong(format!("elements of type {name} are not read"), "use C3D4, C3D10, C3D8 or C3D20")),
    }
}

/// What stands before a node's number: the instance that it is in, where the file has one.
fn instance(text: &str) -> String {
    let mut names = text.lines().filter_map(Keyword::of).filter(|k| k.name == "INSTANCE");
    let name = names.next().and_then(|k| k.get("NAME").map(String::from));
    name.map(|n| format!("{n}.")).unwrap_or_default()
}

/// The first byte of the first line with this keyword.
fn line_of(text: &str, keyword: &str) -> Option<usize> {
    let start = |line: &str| line.as_ptr() as usize - text.as_ptr() as usize;
    text.lines().find(|l| Keyword::of(l).is_some_and(|k| k.name == keyword)).map(start)
}

/// Prescribed displacements in the first step, or in one of their own; materials where the file has
/// none.
pub(super) fn edits(text: &str, mesh: &SolidMesh, measured: &Measured) -> Vec<Edit> {
    let before = if text.ends_with('\n') || text.is_empty() { "" } else { "\n" };
    let prefix = instance(text);
    let boundary = boundary(mesh, measured, &prefix);
    let materials = match prefix.is_empty() && line_of(text, "SOLID SECTION").is_none() {
        true => materials(mesh, measured),
        false => String::new(),
    };
    match (line_of(text, "STEP"), line_of(text, "END STEP")) {
        (Some(step), Some(end)) => vec![Edit::insert(step, materials), Edit::insert(end, boundary)],
        _ => {
            let step = format!("{before}{materials}*STEP\n*STATIC\n{boundary}*NODE FILE\nU\n*EL FILE\nS\n*END STEP\n");
            vec![Edit::insert(text.len(), step)]
        }
    }
}

fn boundary(mesh: &SolidMesh, measured: &Measured, prefix: &str) -> String {
    let mut out = String::from("** palpate: measured displacement, mm, RAS\n*BOUNDARY\n");
    for m in &measured.nodes {
        let number = mesh.numbers()[m.node as usize];
        for (axis, u) in (1..).zip(m.displacement) {
            let _ = writeln!(out, "{prefix}{number}, {axis}, {axis}, {u:.9e}");
        }
    }
    out
}

/// A set of elements, a material (MPa) and a section for each region.
fn materials(mesh: &SolidMesh, measured: &Measured) -> String {
    let mut regions: BTreeMap<u8, (ElementModulus, Vec<u64>)> = BTreeMap::new();
    for (element, found) in mesh.elements().iter().zip(&measured.elements) {
        if let Some(found) = found {
            regions.entry(found.label).or_insert((*found, Vec::new())).1.push(element.number);
        }
    }
    let mut out = String::new();
    let known = |e: &ElementModulus| e.modulus.is_finite() && e.modulus > 0.0;
    for (label, (material, elements)) in regions.into_iter().filter(|r| known(&r.1.0)) {
        let _ = writeln!(out, "** palpate: identified modulus of region {label}, MPa\n*ELSET, ELSET=PALPATE{label}");
        for line in elements.chunks(PER_LINE) {
            let line: Vec<String> = line.iter().map(u64::to_string).collect();
            let _ = writeln!(out, "{},", line.join(", "));
        }
        let (e, nu) = (material.modulus / 1000.0, material.poisson);
        let _ = writeln!(out, "*MATERIAL, NAME=PALPATE{label}\n*ELASTIC\n{e:.9e}, {nu}");
        let _ = writeln!(out, "*SOLID SECTION, ELSET=PALPATE{label}, MATERIAL=PALPATE{label}");
    }
    out
}
