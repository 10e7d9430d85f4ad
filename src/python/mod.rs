//! The Python module `palpate._palpate` (feature `python`): the pipelines on arrays.
//!
//! What a user imports is the package in `src/python/palpate`, which turns images into arrays and
//! results into objects. Arrays come in Fortran order (x fastest). Volumes and displacements are
//! worked on where they lie and without the interpreter, so the caller leaves them alone meanwhile;
//! masks, label maps and matches are taken over first. Numbers are rounded as the files of the
//! command line keep them, so that both give the same bits.

mod arrays;

mod field;

mod grasp;

mod pad;

mod stiffness;

mod track;

use crate::pipeline::fingertip::NODES;
use crate::types::StiffnessParams;
use pyo3::prelude::*;
use serde_json::json;
use std::ffi::OsString;

pyo3::create_exception!(
    palpate,
    PalpateError,
    pyo3::exceptions::PyValueError,
    "What the command line would say after `error:`."
);

/// Of the command line's flags, by command, where the package's functions have them in their
/// signatures.
fn defaults(py: Python<'_>) -> PyResult<Bound<'_, PyAny>> {
    let StiffnessParams { poisson, nodes, regions, label_sd, .. } = StiffnessParams::default();
    let stiffness = json!({ "poisson": poisson, "nodes": nodes, "regions": regions, "label_sd": label_sd });
    arrays::python(py, &json!({ "stiffness": stiffness, "fingertip": { "nodes": NODES } }))
}

/// The command line: `words` with the program's name first, `own` what starts it again. Returns the
/// exit code.
#[pyfunction]
fn command_line(py: Python<'_>, words: Vec<OsString>, own: Vec<OsString>) -> u8 {
    py.detach(|| crate::cli::run(words, own))
}

/// `palpate._palpate`.
#[pymodule]
fn _palpate(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add("DEFAULTS", defaults(module.py())?)?;
    module.add("PalpateError", module.py().get_type::<PalpateError>())?;
    module.add_function(wrap_pyfunction!(arrays::read_volume, module)?)?;
    module.add_function(wrap_pyfunction!(arrays::read_series, module)?)?;
    module.add_function(wrap_pyfunction!(field::field, module)?)?;
    module.add_function(wrap_pyfunction!(command_line, module)?)?;
    module.add_function(wrap_pyfunction!(stiffness::stiffness, module)?)?;
    module.add_function(wrap_pyfunction!(pad::fingertip, module)?)?;
    module.add_function(wrap_pyfunction!(grasp::grasp, module)?)?;
    module.add_function(wrap_pyfunction!(track::track, module)?)
}
