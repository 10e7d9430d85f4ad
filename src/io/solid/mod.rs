//! A solid mesh of the user with measured displacements: read, and written again in its own format.
//!
//! Nothing of the file is changed: what is new is put in between. Formats: VTK XML unstructured
//! grids (`.vtu`), Abaqus and CalculiX (`.inp`), FEBio 3 and 4 (`.feb`).

mod abaqus;
mod edit;
mod febio;
mod vtu;

use super::atomic::write_atomic;
use super::csv::write_table;
use super::format_error::Flaw;
use super::memory::fits;
use super::{format, os, source};
use crate::error::IoError;
use crate::types::{Measured, SolidMesh};
use std::io::Write;
use std::path::Path;

/// Bytes of memory that a byte of a file takes while it is read, about.
const BYTES_PER_FILE_BYTE: u64 = 12;

/// A format that a mesh can be in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Format {
    Vtu,
    Abaqus,
    Febio,
}

impl Format {
    /// By the ending of a name.
    fn of(path: &Path) -> Option<Self> {
        match path.extension()?.to_str()?.to_ascii_lowercase().as_str() {
            "vtu" => Some(Self::Vtu),
            "inp" => Some(Self::Abaqus),
            "feb" => Some(Self::Febio),
            _ => None,
        }
    }
}

/// A mesh with the file that it came in.
#[derive(Debug, Clone)]
pub struct SolidFile {
    mesh: SolidMesh,
    bytes: Vec<u8>,
    format: Format,
}

impl SolidFile {
    /// Reads a mesh of tetrahedra and hexahedra (mm, RAS); its format by the ending of its name.
    /// Other solid elements are refused, shells and lines are left out.
    ///
    /// # Errors
    /// [`IoError`] when it cannot be read, is damaged, or holds no mesh that can be used.
    pub fn read(path: impl AsRef<Path>) -> Result<Self, IoError> {
        let path = path.as_ref();
        let Some(kind) = Format::of(path) else {
            let what = "is no mesh by its name";
            return Err(format(path, what, "give a .vtu, an .inp of Abaqus or CalculiX, or a .feb of FEBio"));
        };
        let bytes = whole(path)?;
        let mesh = match kind {
            Format::Vtu => vtu::read(&bytes),
            Format::Abaqus => text(&bytes).and_then(abaqus::read),
            Format::Febio => text(&bytes).and_then(febio::read),
        };
        let mesh = mesh.and_then(usable).map_err(|flaw| flaw.at(path))?;
        Ok(Self { mesh, bytes, format: kind })
    }

    /// The mesh.
    pub fn mesh(&self) -> &SolidMesh {
        &self.mesh
    }

    /// How the name of what [`Self::write`] writes must end.
    pub fn ending(&self) -> &'static str {
        match self.format {
            Format::Vtu => "vtu",
            Format::Abaqus => "inp",
            Format::Febio => "feb",
        }
    }

    /// Writes the file again with what was measured: prescribed displacements (mm), and each
    /// element's modulus (MPa) where the format has a place for it.
    ///
    /// # Errors
    /// [`IoError`] when the file has no room for it or cannot be written.
    pub fn write(&self, path: impl AsRef<Path>, measured: &Measured) -> Result<(), IoError> {
        let path = path.as_ref();
        let edits = match self.format {
            Format::Vtu => vtu::edits(&self.bytes, &self.mesh, measured),
            Format::Abaqus => text(&self.bytes).map(|t| abaqus::edits(t, &self.mesh, measured)),
            Format::Febio => text(&self.bytes).and_then(|t| febio::edits(t, &self.mesh, measured)),
        };
        let out = edit::apply(&self.bytes, edits.map_err(|flaw| flaw.at(path))?);
        write_atomic(path, |w| w.write_all(&out))
    }
}

/// The bytes of a regular file that memory holds.
fn whole(path: &Path) -> Result<Vec<u8>, IoError> {
    let size = source::open(path)?.metadata().map_err(os(path, "read"))?.len();
    fits(BYTES_PER_FILE_BYTE.saturating_mul(size)).map_err(|flaw| flaw.at(path))?;
    source::bytes(path, size)
}

fn text(bytes: &[u8]) -> Result<&str, Flaw> {
    let bad =
        |e: std::str::Utf8Error| Flaw::new(format!("byte {} is no text (UTF-8)", e.valid_up_to()), "save it as text");
    std::str::from_utf8(bytes).map_err(bad)
}

/// A mesh must have solid elements.
fn usable(mesh: SolidMesh) -> Result<SolidMesh, Flaw> {
    match mesh.elements().is_empty() {
        true => Err(Flaw::new(
            "holds no tetrahedron and no hexahedron",
            "export the volume mesh: 4 or 10 nodes a tetrahedron, 8 or 20 a hexahedron",
        )),
        false => Ok(mesh),
    }
}

/// Columns of boundary.csv.
const NODE_COLUMNS: [&str; 14] =
    ["node", "x", "y", "z", "ux", "uy", "uz", "cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz", "patch"];
/// Columns of elements.csv.
const ELEMENT_COLUMNS: [&str; 6] = ["element", "x", "y", "z", "label", "youngs_modulus"];

/// Writes a row for each prescribed node: number in the file, place and displacement (mm, RAS),
/// covariance (mm^2; empty where it is not known), and patch.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub fn write_boundary(path: impl AsRef<Path>, mesh: &SolidMesh, measured: &Measured) -> Result<(), IoError> {
    let rows = measured.nodes.iter().map(|m| {
        let at = m.node as usize;
        let mut row = vec![mesh.numbers()[at].to_string()];
        row.extend(mesh.nodes()[at].0.iter().chain(&m.displacement).map(|v| format!("{v:.6}")));
        match &m.covariance {
            Some(c) => row.extend(c.iter().map(|v| format!("{v:.6e}"))),
            None => row.extend(vec![String::new(); 6]),
        }
        row.push(m.patch.clone());
        row
    });
    write_table(path.as_ref(), &NODE_COLUMNS, rows)
}

/// Writes a row for each element: number in the file, centroid (mm, RAS), label of its region and
/// Young's modulus (kPa, or a ratio without a force); empty outside the map.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub fn write_element_moduli(path: impl AsRef<Path>, mesh: &SolidMesh, measured: &Measured) -> Result<(), IoError> {
    let rows = mesh.elements().iter().zip(&measured.elements).map(|(element, found)| {
        let mut row = vec![element.number.to_string()];
        row.extend(mesh.centroid(element).0.iter().map(|v| format!("{v:.6}")));
        let label = found.map_or(String::new(), |f| f.label.to_string());
        let modulus = found.filter(|f| f.modulus.is_finite()).map_or(String::new(), |f| format!("{:.6}", f.modulus));
        row.extend([label, modulus]);
        row
    });
    write_table(path.as_ref(), &ELEMENT_COLUMNS, rows)
}

/// What is made of the parts of a mesh; `hint` says what to try with one that does not fit
/// together.
fn assembled(made: Result<SolidMesh, crate::error::MeshError>) -> Result<SolidMesh, Flaw> {
    made.map_err(|e| Flaw::new(e.to_string(), "export the mesh again"))
}
