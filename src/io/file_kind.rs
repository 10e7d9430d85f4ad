//! What a file is by its first bytes, where it is neither an image nor points.

use super::csv::{damaged, open_table};
use super::source;
use crate::error::IoError;
use std::path::Path;

/// Bytes looked at.
const EXAMINED_BYTES: u64 = 1 << 16;

/// What a file is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Form {
    /// A page (HTML).
    Page,
    /// A drawing (SVG).
    Drawing,
    /// A mesh of VTK: its points, its cells, and the names of its data.
    Mesh {
        /// Number of points.
        points: usize,
        /// Number of cells.
        cells: usize,
        /// Names of data at points and in cells, as they stand in the file.
        data: Vec<String>,
    },
    /// A model for a finite element program, by its name.
    Model(&'static str),
    /// A transform of another program, by its name.
    Transform(&'static str),
    /// Anything else, such as an image.
    Other,
}

/// Looks at the first bytes of a file.
///
/// # Errors
/// [`IoError`] when it is not there or cannot be read.
pub(crate) fn form_of(path: impl AsRef<Path>) -> Result<Form, IoError> {
    let path = path.as_ref();
    if path.is_dir() {
        return Ok(Form::Other);
    }
    let head = source::head(path, EXAMINED_BYTES)?;
    let text = String::from_utf8_lossy(&head);
    let start = text.trim_start();
    Ok(match start {
        s if s.get(..14).is_some_and(|t| t.eq_ignore_ascii_case("<!doctype html")) => Form::Page,
        s if s.starts_with("<svg") => Form::Drawing,
        s if s.starts_with("<?xml") && s.contains("<VTKFile") => mesh(s),
        s if s.starts_with("<?xml") && s.contains("<febio_spec") => Form::Model("FEBio"),
        s if s.starts_with("<?xml") && s.contains("<Node") && s.contains("<RequiredPlugin") => Form::Model("SOFA"),
        s if s.starts_with('<') && s.contains("<mujoco") => Form::Model("MuJoCo"),
        s if s.starts_with("$MeshFormat") => Form::Model("Gmsh and MuJoCo"),
        s if s.starts_with("*HEADING") => Form::Model("CalculiX and Abaqus"),
        s if s.starts_with("#Insight Transform File") => Form::Transform("ITK"),
        s if s.starts_with("(Transform ") || s.contains("\n(Transform ") => Form::Transform("elastix"),
        _ => Form::Other,
    })
}

/// The mesh whose description begins `text`.
fn mesh(text: &str) -> Form {
    let values = |key: &str| {
        let key = format!("{key}=\"");
        text.split(key.as_str()).skip(1).filter_map(|rest| rest.split('"').next()).map(String::from).collect::<Vec<_>>()
    };
    let number = |key: &str| values(key).first().and_then(|v| v.parse().ok()).unwrap_or(0);
    let structure = ["connectivity", "offsets", "types", "points", "Points"];
    let data = values(" Name").into_iter().filter(|name| !structure.contains(&name.as_str())).collect();
    Form::Mesh { points: number("NumberOfPoints"), cells: number("NumberOfCells"), data }
}

/// Names of the columns of a table, and how many lines follow them.
///
/// # Errors
/// [`IoError`] when it cannot be read or is no table of comma-separated values.
pub fn columns_of(path: impl AsRef<Path>) -> Result<(Vec<String>, usize), IoError> {
    let path = path.as_ref();
    let (header, mut reader) = open_table(path)?;
    let columns = header.iter().map(String::from).collect();
    let mut rows = 0;
    for record in reader.byte_records() {
        record.map_err(|e| damaged(path, e))?;
        rows += 1;
    }
    Ok((columns, rows))
}
