//! VTK XML unstructured grids (`.vtu`) as VTK, meshio and palpate write them: arrays as text, in
//! base64, or appended as base64 or raw; plain or packed with zlib; one piece.

use super::edit::Edit;
use crate::io::format_error::Flaw;
use crate::io::gzip::MAX_DEFLATE_RATIO;
use crate::types::{Measured, SolidElement, SolidMesh, SolidShape, WorldPoint};
use base64::{Engine, engine::general_purpose::STANDARD};
use libdeflater::Decompressor;
use roxmltree::{Document, Node, ParsingOptions};
use std::fmt::Write;

const AGAIN: &str = "write it again with ParaView or meshio";
/// VTK's numbers for cells that are no solids: points, lines, triangles and quadrilaterals.
const FLAT: [i64; 13] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 21, 22, 23];

/// A file: the XML before any appended data, and these.
struct File<'a> {
    xml: String,
    appended: Option<&'a [u8]>,
}

/// Where the XML ends that can be parsed, and the appended data behind it.
fn split(bytes: &[u8]) -> Result<(usize, Option<&[u8]>), Flaw> {
    let find = |from: usize, what: &[u8]| bytes[from..].windows(what.len()).position(|w| w == what).map(|at| from + at);
    let Some(tag) = find(0, b"<AppendedData") else { return Ok((bytes.len(), None)) };
    let cut = || Flaw::new("is cut short within its appended data", AGAIN);
    let open = find(tag, b">").ok_or_else(cut)? + 1;
    let data = find(open, b"_").ok_or_else(cut)? + 1;
    let close = b"</AppendedData>";
    let end = bytes.windows(close.len()).rposition(|w| w == close).filter(|&e| e >= data).ok_or_else(cut)?;
    Ok((open, Some(&bytes[data..end])))
}

impl<'a> File<'a> {
    fn of(bytes: &'a [u8]) -> Result<Self, Flaw> {
        let (end, appended) = split(bytes)?;
        let head = super::text(&bytes[..end])?;
        let close = if appended.is_some() { "</AppendedData></VTKFile>" } else { "" };
        Ok(Self { xml: format!("{head}{close}"), appended })
    }
}

fn parsed(xml: &str) -> Result<Document<'_>, Flaw> {
    let options = ParsingOptions { nodes_limit: u32::MAX, ..ParsingOptions::default() };
    let document = Document::parse_with_options(xml, options)
        .map_err(|e| Flaw::new(format!("is no well-formed XML ({e})"), AGAIN))?;
    let root = document.root_element();
    let grid = root.attribute("type") == Some("UnstructuredGrid");
    match root.has_tag_name("VTKFile") && grid {
        true => Ok(document),
        false => Err(Flaw::new("is no unstructured grid of VTK", "save it in ParaView as .vtu")),
    }
}

/// The one piece of the grid.
fn piece<'a>(document: &'a Document<'_>) -> Result<Node<'a, 'a>, Flaw> {
    let mut pieces = document.descendants().filter(|n| n.has_tag_name("Piece"));
    match (pieces.next(), pieces.next()) {
        (Some(piece), None) => Ok(piece),
        (None, _) => Err(Flaw::new("holds no piece of a grid", AGAIN)),
        _ => Err(Flaw::new("holds several pieces", "merge them (ParaView: Merge Blocks)")),
    }
}

fn child<'a>(node: Node<'a, 'a>, name: &str) -> Option<Node<'a, 'a>> {
    node.children().find(|n| n.has_tag_name(name))
}

/// How arrays are stored.
struct Store<'a> {
    wide: bool,
    packed: bool,
    raw: bool,
    appended: Option<&'a [u8]>,
}

impl<'a> Store<'a> {
    fn of(document: &Document<'_>, appended: Option<&'a [u8]>) -> Result<Self, Flaw> {
        let root = document.root_element();
        if root.attribute("byte_order").is_some_and(|o| o != "LittleEndian") {
            return Err(Flaw::new("is stored big-endian", AGAIN));
        }
        let packed = match root.attribute("compressor") {
            None => false,
            Some("vtkZLibDataCompressor") => true,
            Some(other) => {
                let hint = "save it with zlib, or without compression";
                return Err(Flaw::new(format!("is packed with {other}, which is not read"), hint));
            }
        };
        let raw =
            document.descendants().any(|n| n.has_tag_name("AppendedData") && n.attribute("encoding") == Some("raw"));
        Ok(Self { wide: root.attribute("header_type") == Some("UInt64"), packed, raw, appended })
    }

    /// The numbers of an array.
    fn numbers(&self, array: Node<'_, '_>) -> Result<Vec<f64>, Flaw> {
        let name = array.attribute("Name").unwrap_or("Points");
        let cut = || Flaw::new(format!("the array {name:?} is cut short or damaged"), AGAIN);
        let kind = array.attribute("type").unwrap_or_default();
        let bytes = match array.attribute("format").unwrap_or("ascii") {
            "ascii" => {
                let parts = array.text().unwrap_or_default().split_ascii_whitespace();
                return parts.map(|v| v.parse().map_err(|_| cut())).collect();
            }
            "binary" => {
                let text: Vec<u8> =
                    array.text().unwrap_or_default().bytes().filter(|b| !b.is_ascii_whitespace()).collect();
                self.base64_bytes(&text)
            }
            "appended" => {
                let offset = array.attribute("offset").and_then(|o| o.parse::<usize>().ok());
                let data = offset.and_then(|o| self.appended?.get(o..)).ok_or_else(cut)?;
                if self.raw { self.raw_bytes(data) } else { self.base64_bytes(data) }
            }
            other => return Err(Flaw::new(format!("the array {name:?} is stored as {other:?}"), AGAIN)),
        };
        typed(&bytes.ok_or_else(cut)?, kind)
            .ok_or_else(|| Flaw::new(format!("the array {name:?} holds {kind:?}"), AGAIN))
    }

    fn word(&self) -> usize {
        if self.wide { 8 } else { 4 }
    }

    fn header(&self, bytes: &[u8], at: usize) -> Option<usize> {
        let part = bytes.get(at * self.word()..(at + 1) * self.word())?;
        let value = part.iter().rev().fold(0u64, |sum, b| sum << 8 | u64::from(*b));
        usize::try_from(value).ok()
    }

    /// Bytes of an array that follow on their header.
    fn raw_bytes(&self, data: &[u8]) -> Option<Vec<u8>> {
        let first = self.header(data, 0)?;
        if !self.packed {
            return Some(data.get(self.word()..self.word().checked_add(first)?)?.to_vec());
        }
        let words = first.checked_add(3)?;
        let header = data.get(..words.checked_mul(self.word())?)?;
        self.unpack(header, data.get(header.len()..)?)
    }

    /// The same in base64, where a packed array's header stands by itself.
    fn base64_bytes(&self, data: &[u8]) -> Option<Vec<u8>> {
        let decode = |from: usize, bytes: usize| {
            let length = bytes.div_ceil(3).checked_mul(4)?;
            STANDARD.decode(data.get(from..from.checked_add(length)?)?).ok()
        };
        let first = self.header(&decode(0, self.word())?, 0)?;
        if !self.packed {
            // VTK closes the header with padding of its own, meshio does not.
            let apart = self.word().div_ceil(3) * 4;
            if data.get(apart - 1) == Some(&b'=') {
                return decode(apart, first);
            }
            let all = decode(0, first.checked_add(self.word())?)?;
            return all.get(self.word()..self.word() + first).map(<[u8]>::to_vec);
        }
        let words = first.checked_add(3)?;
        let header = decode(0, words.checked_mul(self.word())?)?;
        let sizes = (0..first).try_fold(0usize, |sum, b| sum.checked_add(self.header(&header, 3 + b)?))?;
        self.unpack(&header, &decode(header.len().div_ceil(3) * 4, sizes)?)
    }

    /// The blocks of a packed array; none where the header claims more than they can hold.
    fn unpack(&self, header: &[u8], data: &[u8]) -> Option<Vec<u8>> {
        let [blocks, size, last] = [0, 1, 2].map(|i| self.header(header, i));
        let (blocks, size, last) = (blocks?, size?, last?);
        let (mut out, mut at) = (Vec::new(), 0usize);
        for block in 0..blocks {
            let end = at.checked_add(self.header(header, 3 + block)?)?;
            let part = data.get(at..end)?;
            let length = if block + 1 == blocks && last > 0 { last } else { size };
            if length > (MAX_DEFLATE_RATIO as usize).checked_mul(part.len())? {
                return None;
            }
            let start = out.len();
            out.resize(start + length, 0);
            let found = Decompressor::new().zlib_decompress(part, &mut out[start..]).ok()?;
            if found != length {
                return None;
            }
            at = end;
        }
        Some(out)
    }
}

/// The numbers in bytes of a type of VTK.
fn typed(bytes: &[u8], kind: &str) -> Option<Vec<f64>> {
    fn each<const N: usize>(bytes: &[u8], of: impl Fn([u8; N]) -> f64) -> Option<Vec<f64>> {
        let (parts, rest) = bytes.as_chunks::<N>();
        rest.is_empty().then(|| parts.iter().map(|p| of(*p)).collect())
    }
    match kind {
        "Float32" => each(bytes, |b| f64::from(f32::from_le_bytes(b))),
        "Float64" => each(bytes, f64::from_le_bytes),
        "Int8" => each(bytes, |b| f64::from(i8::from_le_bytes(b))),
        "UInt8" => each(bytes, |b| f64::from(u8::from_le_bytes(b))),
        "Int16" => each(bytes, |b| f64::from(i16::from_le_bytes(b))),
        "UInt16" => each(bytes, |b| f64::from(u16::from_le_bytes(b))),
        "Int32" => each(bytes, |b| f64::from(i32::from_le_bytes(b))),
        "UInt32" => each(bytes, |b| f64::from(u32::from_le_bytes(b))),
        "Int64" => each(bytes, |b| i64::from_le_bytes(b) as f64),
        "UInt64" => each(bytes, |b| u64::from_le_bytes(b) as f64),
        _ => None,
    }
}

/// Reads the mesh. Nodes and elements are numbered from 0, as VTK numbers points and cells.
pub(super) fn read(bytes: &[u8]) -> Result<SolidMesh, Flaw> {
    let file = File::of(bytes)?;
    let document = parsed(&file.xml)?;
    let store = Store::of(&document, file.appended)?;
    let piece = piece(&document)?;
    let missing = |what: &str| Flaw::new(format!("holds no {what}"), AGAIN);
    let points = child(piece, "Points").and_then(|n| child(n, "DataArray")).ok_or_else(|| missing("points"))?;
    let places = store.numbers(points)?;
    let (parts, rest) = places.as_chunks::<3>();
    if !rest.is_empty() {
        return Err(Flaw::new("has points without three coordinates", AGAIN));
    }
    let nodes: Vec<WorldPoint> = parts.iter().map(|p| WorldPoint(*p)).collect();
    let cells = child(piece, "Cells").ok_or_else(|| missing("cells"))?;
    let named = |name: &str| {
        let found = cells.children().find(|n| n.attribute("Name") == Some(name));
        store.numbers(found.ok_or_else(|| missing(name))?)
    };
    let elements = elements(&named("connectivity")?, &named("offsets")?, &named("types")?)?;
    let sets = sets(piece, &store, nodes.len());
    let numbers = (0..nodes.len() as u64).collect();
    super::assembled(SolidMesh::new(nodes, numbers, elements, sets))
}

fn elements(connectivity: &[f64], offsets: &[f64], types: &[f64]) -> Result<Vec<SolidElement>, Flaw> {
    if offsets.len() != types.len() {
        return Err(Flaw::new(format!("has {} offsets for {} types of cells", offsets.len(), types.len()), AGAIN));
    }
    let (mut out, mut from) = (Vec::new(), 0usize);
    for (number, (&end, &kind)) in (0..).zip(offsets.iter().zip(types)) {
        let wrong = |what: &str| Flaw::new(format!("cell {number} {what}"), AGAIN);
        let end = end as usize;
        let own = connectivity.get(from..end).ok_or_else(|| wrong("names points that are not listed"))?;
        from = end;
        let Some(shape) = shape(kind as i64)? else { continue };
        if own.len() != shape.nodes() {
            return Err(wrong(&format!("has {} points for {}", own.len(), shape.nodes())));
        }
        let node = |v: &f64| (*v >= 0.0 && *v < f64::from(u32::MAX)).then_some(*v as u32);
        let nodes = own.iter().map(node).collect::<Option<_>>().ok_or_else(|| wrong("names a point that is none"))?;
        out.push(SolidElement { number, shape, nodes });
    }
    Ok(out)
}

fn shape(kind: i64) -> Result<Option<SolidShape>, Flaw> {
    Ok(Some(match kind {
        10 => SolidShape::Tetrahedron,
        24 => SolidShape::QuadraticTetrahedron,
        12 => SolidShape::Hexahedron,
        25 => SolidShape::QuadraticHexahedron,
        flat if FLAT.contains(&flat) => return Ok(None),
        _ => {
            let hint = "use tetrahedra (10, 24) or hexahedra (12, 25); ParaView's Tetrahedralize makes them";
            return Err(Flaw::new(format!("cells of VTK's type {kind} are not read"), hint));
        }
    }))
}

/// A set of nodes for each array of one number a point: those where it is not 0.
fn sets(piece: Node<'_, '_>, store: &Store<'_>, nodes: usize) -> Vec<(String, Vec<u32>)> {
    let arrays = piece.children().filter(|n| n.has_tag_name("PointData")).flat_map(|n| n.children());
    let set = |array: Node<'_, '_>| {
        let name =
            array.attribute("Name").filter(|_| array.attribute("NumberOfComponents").is_none_or(|n| n == "1"))?;
        let values = store.numbers(array).ok().filter(|v| v.len() == nodes)?;
        Some((name.to_string(), (0..).zip(values).filter(|(_, v)| *v != 0.0).map(|(n, _)| n).collect()))
    };
    arrays.filter_map(set).collect()
}

/// New arrays at points and cells: `measured_displacement` (mm), `measured_covariance` (mm^2, in
/// VTK's order), `prescribed` (1 or 0) and `identified_modulus`.
pub(super) fn edits(bytes: &[u8], mesh: &SolidMesh, measured: &Measured) -> Result<Vec<Edit>, Flaw> {
    let file = File::of(bytes)?;
    let document = parsed(&file.xml)?;
    let piece = piece(&document)?;
    let cells = Store::of(&document, file.appended)?;
    let types = child(piece, "Cells").and_then(|c| c.children().find(|n| n.attribute("Name") == Some("types")));
    let count = types.map_or(Ok(0), |t| cells.numbers(t).map(|v| v.len()))?;
    let at = |name: &str, text: String| match child(piece, name) {
        Some(node) => Edit::into(&file.xml, node, &text),
        None => {
            let points = child(piece, "Points").map_or(0, |n| n.range().start);
            Edit::insert(points, format!("<{name}>\n{text}</{name}>\n"))
        }
    };
    Ok(vec![at("PointData", at_points(mesh, measured)), at("CellData", in_cells(mesh, measured, count))])
}

fn array(name: &str, kind: &str, components: usize, values: impl Iterator<Item = String>) -> String {
    let values: Vec<String> = values.collect();
    format!(
        "<DataArray type=\"{kind}\" Name=\"{name}\" NumberOfComponents=\"{components}\" format=\"ascii\">\n{}\n</DataArray>\n",
        values.join("\n")
    )
}

fn at_points(mesh: &SolidMesh, measured: &Measured) -> String {
    let mut by_node = vec![None; mesh.nodes().len()];
    measured.nodes.iter().for_each(|m| by_node[m.node as usize] = Some(m));
    let row = |values: &[f64]| {
        values.iter().fold(String::new(), |mut line, v| {
            let _ = write!(line, "{v:.9e} ");
            line
        })
    };
    let moved = by_node.iter().map(|m| row(&m.map_or([0.0; 3], |m| m.displacement)));
    let vague = by_node.iter().map(|m| {
        let [xx, xy, xz, yy, yz, zz] = m.and_then(|m| m.covariance).unwrap_or_default();
        row(&[xx, yy, zz, xy, yz, xz])
    });
    let given = by_node.iter().map(|m| u8::from(m.is_some()).to_string());
    let known = measured.nodes.iter().any(|m| m.covariance.is_some());
    let covariance = if known { array("measured_covariance", "Float64", 6, vague) } else { String::new() };
    array("measured_displacement", "Float64", 3, moved) + &covariance + &array("prescribed", "UInt8", 1, given)
}

/// Cells without a modulus have 0.
fn in_cells(mesh: &SolidMesh, measured: &Measured, cells: usize) -> String {
    let mut modulus = vec![0.0; cells];
    for (element, found) in mesh.elements().iter().zip(&measured.elements) {
        let value = found.map_or(0.0, |f| f.modulus);
        if let Some(cell) = modulus.get_mut(element.number as usize) {
            *cell = if value.is_finite() { value } else { 0.0 };
        }
    }
    array("identified_modulus", "Float64", 1, modulus.iter().map(|v| format!("{v:.9e}")))
}
