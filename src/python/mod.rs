//! The Python module `palpate._palpate` (feature `python`): the pipelines on arrays.
//!
//! What a user imports is the package in `src/python/palpate`, which turns images into arrays and results into objects. Arrays
//! come in Fortran order (x fastest) and are read while the interpreter is held; all work is done without it. Numbers are
//! rounded as the files of the command line keep them, so that both give the same bits.

mod arrays;

mod field;

mod grasp;

mod pad;

mod stiffness;

mod track;

use pyo3::prelude::*;

pyo3::create_exception!(
    palpate,
    PalpateError,
    pyo3::exceptions::PyValueError,
    "What the command line would say after `error:`."
);

/// `palpate._palpate`.
#[pymodule]
fn _palpate(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add("PalpateError", module.py().get_type::<PalpateError>())?;
    module.add_function(wrap_pyfunction!(arrays::read_volume, module)?)?;
    module.add_function(wrap_pyfunction!(field::field, module)?)?;
    module.add_function(wrap_pyfunction!(stiffness::stiffness, module)?)?;
    module.add_function(wrap_pyfunction!(pad::fingertip, module)?)?;
    module.add_function(wrap_pyfunction!(grasp::grasp, module)?)?;
    module.add_function(wrap_pyfunction!(track::track, module)?)
}
