//! Arrays in and out, errors, progress and threads.

use crate::error::IoError;
use crate::field::warp::labels_onto;
use crate::io;
use crate::python::PalpateError;
use crate::types::{
    Affine, DenseField, Displacement, ErrorSamples, Grid, Mask, Match, Mesh, SparseField, Volume, Voxels, WorldPoint,
};
use ndarray::{Array2, Array3, Array4, Array5, Dimension, ShapeBuilder};
use numpy::{
    IntoPyArray, PyArray2, PyArray3, PyArray4, PyArray5, PyReadonlyArray, PyReadonlyArray2, PyReadonlyArray3,
    PyReadonlyArray4, PyReadonlyArray5, PyUntypedArrayMethods,
};
use pyo3::exceptions::PyUserWarning;
use pyo3::prelude::*;
use serde_json::Value;
use std::ffi::CString;
use std::path::Path;
use std::sync::Mutex;

/// The upper rows of a voxel-to-world matrix (mm, RAS).
pub type Rows = [[f64; 4]; 3];
/// A scalar volume and its affine.
pub type Image<'py> = (PyReadonlyArray3<'py, f32>, Rows);
/// Samples of a field's error, and the affine of their nodes.
pub type Samples<'py> = (PyReadonlyArray5<'py, f32>, Rows);
/// Volumes, their affine, and the time between them (s).
pub type Series<'py> = (Vec<Bound<'py, PyArray3<f32>>>, Rows, Option<f64>);
/// A callable of a stage's name and the part that is done (0 to 1).
pub type Callback = Option<Py<PyAny>>;

/// The message of an error with its causes, each once, as the command line says it.
pub fn told(error: impl std::fmt::Display) -> PyErr {
    PalpateError::new_err(error.to_string())
}

/// `shape` placed by `rows`.
pub fn grid(shape: &[usize], rows: Rows) -> PyResult<Grid> {
    let [x, y, z] = shape[..3] else { return Err(told("a volume has three axes")) };
    Grid::new([x, y, z], Affine::new(rows).map_err(told)?).map_err(told)
}

/// The values of an array in Fortran order, x fastest, where they lie.
fn values<'a, D: Dimension>(array: &'a PyReadonlyArray<'_, f32, D>) -> PyResult<&'a [f32]> {
    if !array.is_fortran_contiguous() {
        return Err(told("an array must lie in Fortran order"));
    }
    array.as_slice().map_err(told)
}

/// A volume on the memory of its array.
pub fn volume<'a>(image: &'a Image<'_>) -> PyResult<Voxels<'a>> {
    let (array, rows) = image;
    Voxels::lent(grid(array.shape(), *rows)?, values(array)?).map_err(told)
}

/// A label map or mask, called `name`.
pub fn labels(image: &Image<'_>, name: &str) -> PyResult<Mask> {
    io::labels_of(&volume(image)?, Path::new(name)).map_err(told)
}

/// The same if it is there, on the grid of `reference`, which is called `of`: resampled, with a
/// warning, where it lies on another.
pub fn mask(image: Option<&Image<'_>>, name: &str, reference: &Grid, of: &str) -> PyResult<Option<Mask>> {
    let Some(image) = image else { return Ok(None) };
    let (mask, note) = labels_onto(labels(image, name)?, reference, [name, of]).map_err(told)?;
    if let Some(note) = note.and_then(|n| CString::new(n).ok()) {
        let py = image.0.py();
        PyErr::warn(py, &py.get_type::<PyUserWarning>(), &note, 1)?;
    }
    Ok(Some(mask))
}

/// A displacement, (nx, ny, nz, 3), mm, RAS, on the memory of its array.
pub fn displacement<'a>(array: &'a PyReadonlyArray4<'_, f32>, rows: Rows) -> PyResult<Displacement<'a>> {
    if array.shape()[3] != 3 {
        return Err(told("a displacement has three components, on the last axis"));
    }
    Displacement::lent(grid(array.shape(), rows)?, values(array)?).map_err(told)
}

/// Errors that a field may have, (nx, ny, nz, n, 3), and the affine of their nodes, as the file
/// keeps them.
pub fn samples<'py>(py: Python<'py>, samples: &ErrorSamples) -> PyResult<(Bound<'py, PyArray5<f32>>, Rows)> {
    let ([x, y, z], n) = (samples.nodes().shape(), samples.nodes().len());
    let parts = (0..3).flat_map(|c| samples.values().iter().map(move |s| &s[c * n..(c + 1) * n]));
    let all: Vec<f32> = parts.flatten().map(|v| io::stored(*v)).collect();
    let array = Array5::from_shape_vec((x, y, z, samples.values().len(), 3).f(), all).map_err(told)?;
    Ok((array.into_pyarray(py), stored_rows(samples.nodes())))
}

/// The same the other way.
pub fn error_samples(samples: &Samples<'_>) -> PyResult<ErrorSamples> {
    let (array, rows) = samples;
    let [.., count, 3] = array.shape()[..] else { return Err(told("samples of an error have three components")) };
    let (nodes, all) = (grid(array.shape(), *rows)?, values(array)?);
    let n = nodes.len();
    let one = |k: usize| (0..3).flat_map(|c| all[(c * count + k) * n..][..n].iter().copied()).collect();
    ErrorSamples::new(nodes, (0..count).map(one).collect()).map_err(told)
}

/// Matches from the columns of matches.csv.
pub fn matches(array: &PyReadonlyArray2<'_, f64>) -> PyResult<SparseField> {
    let rows = array.as_array();
    if rows.ncols() != 9 {
        return Err(told("matches have the nine columns x, y, z, dx, dy, dz, ncc, sigma, kept"));
    }
    let one = |r: ndarray::ArrayView1<'_, f64>| Match {
        initial: WorldPoint([r[0], r[1], r[2]]),
        displacement: [r[3], r[4], r[5]],
        ncc: r[6] as f32,
        covariance: [r[7] * r[7], r[7] * r[7], r[7] * r[7], 0.0, 0.0, 0.0],
        kept: r[8] != 0.0,
        raw: None,
    };
    Ok(SparseField { matches: rows.rows().into_iter().map(one).collect() })
}

/// The columns of matches.csv.
pub fn match_rows<'py>(py: Python<'py>, field: &SparseField) -> Bound<'py, PyArray2<f64>> {
    let all = &field.matches;
    let rows = Array2::from_shape_fn((all.len(), 9), |(i, c)| match c {
        0..3 => all[i].initial.0[c],
        3..6 => all[i].displacement[c - 3],
        6 => f64::from(all[i].ncc),
        7 => all[i].sigma(),
        _ => f64::from(u8::from(all[i].kept)),
    });
    rows.into_pyarray(py)
}

/// A volume as an (nx, ny, nz) array, without a copy.
pub fn array3<'py, T: numpy::Element + Clone>(py: Python<'py>, volume: Volume<T>) -> PyResult<Bound<'py, PyArray3<T>>> {
    let [x, y, z] = volume.grid().shape();
    Ok(Array3::from_shape_vec((x, y, z).f(), volume.into_vec()).map_err(told)?.into_pyarray(py))
}

/// A displacement as an (nx, ny, nz, 3) array, mm, RAS, without a copy.
pub fn array4(py: Python<'_>, field: DenseField) -> PyResult<Bound<'_, PyArray4<f32>>> {
    let [x, y, z] = field.grid().shape();
    Ok(Array4::from_shape_vec((x, y, z, 3).f(), field.into_vec()).map_err(told)?.into_pyarray(py))
}

/// Rows of `N` numbers.
pub fn table<'py, T: numpy::Element + Copy, const N: usize>(
    py: Python<'py>,
    rows: &[[T; N]],
) -> Bound<'py, PyArray2<T>> {
    Array2::from_shape_fn((rows.len(), N), |(i, c)| rows[i][c]).into_pyarray(py)
}

/// Nodes (mm, RAS) and elements of a mesh.
pub fn mesh<'py>(py: Python<'py>, mesh: &Mesh) -> (Bound<'py, PyArray2<f64>>, Bound<'py, PyArray2<u32>>) {
    let nodes = |nodes: &[WorldPoint]| table(py, &nodes.iter().map(|p| p.0).collect::<Vec<_>>());
    match mesh {
        Mesh::Tetrahedra(m) => (nodes(m.nodes()), table(py, m.tetrahedra())),
        Mesh::Triangles(m) => (nodes(m.nodes()), table(py, m.triangles())),
    }
}

/// The affine as files keep it, in single precision.
pub fn stored_rows(grid: &Grid) -> Rows {
    grid.affine().rows().map(|row| row.map(|v| f64::from(v as f32)))
}

/// JSON as Python's own dict and list.
pub fn python<'py>(py: Python<'py>, value: &Value) -> PyResult<Bound<'py, PyAny>> {
    py.import("json")?.call_method1("loads", (value.to_string(),))
}

/// Most threads that can be asked for, as on the command line.
const MAX_THREADS: i64 = 1024;

/// Runs `work` without the interpreter, on `threads` threads (all cores without a number), and
/// tells `callback` how far it is. What the callback raises is raised when the work is done.
pub fn run<R: Send>(
    py: Python<'_>,
    callback: Callback,
    threads: Option<i64>,
    work: impl FnOnce(&(dyn Fn(&str, f64) + Sync)) -> R + Send,
) -> PyResult<R> {
    if let Some(n) = threads.filter(|n| !(1..=MAX_THREADS).contains(n)) {
        return Err(told(format!("threads is {n}, but must be 1 to {MAX_THREADS}")));
    }
    let raised: Mutex<Option<PyErr>> = Mutex::new(None);
    let tell = |stage: &str, part: f64| {
        let Some(callback) = &callback else { return };
        Python::attach(|py| {
            if let Err(error) = callback.call1(py, (stage, part))
                && let Ok(mut first) = raised.lock()
            {
                first.get_or_insert(error);
            }
        });
    };
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads.unwrap_or(0) as usize).build().map_err(told)?;
    let result = py.detach(|| pool.install(|| work(&tell)));
    match raised.into_inner() {
        Ok(Some(error)) => Err(error),
        _ => Ok(result),
    }
}

/// A volume from a file of any format that is read, as an array and its affine.
#[pyfunction]
pub fn read_volume<'py>(py: Python<'py>, path: std::path::PathBuf) -> PyResult<(Bound<'py, PyArray3<f32>>, Rows)> {
    let volume = py.detach(|| io::read_volume(&path)).map_err(told)?;
    let rows = volume.grid().affine().rows();
    Ok((array3(py, volume)?, rows))
}

/// A series of volumes, their affine, and the time between them (s) where the file gives it.
#[pyfunction]
pub fn read_series(py: Python<'_>, path: std::path::PathBuf) -> PyResult<Series<'_>> {
    let read = || -> Result<_, IoError> {
        let mut file = io::Series::open(&path)?;
        let frames = (0..file.frames()).map(|t| file.read(t)).collect::<Result<Vec<_>, _>>()?;
        Ok((frames, file.grid().affine().rows(), file.step_s()))
    };
    let (frames, rows, step_s) = py.detach(read).map_err(told)?;
    let frames = frames.into_iter().map(|v| array3(py, v)).collect::<PyResult<Vec<_>>>()?;
    Ok((frames, rows, step_s))
}
