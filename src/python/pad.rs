//! `palpate.fingertip`.

use super::arrays::{self, Image, told};
use crate::io;
use crate::pipeline::fingertip::{PadOutcome, of_map};
use crate::types::fingertip::StiffnessFolder;
use pyo3::prelude::*;
use serde_json::{Value, json};
use std::path::PathBuf;

/// What a stiffness result says, from its map (kPa) and its summary as JSON.
fn folder(map: &Image<'_>, summary: &str) -> PyResult<StiffnessFolder> {
    io::stiffness_folder(arrays::volume(map)?, summary).map_err(told)
}

fn reduced(py: Python<'_>, map: &Image<'_>, summary: &str) -> PyResult<(PadOutcome, Option<f64>)> {
    let folder = folder(map, summary)?;
    let outcome = py.detach(|| of_map(&folder)).map_err(told)?;
    Ok((outcome, folder.force_n))
}

/// A stiffness map reduced to a fingertip: a dict of what the fingertip file says.
#[pyfunction]
pub fn fingertip<'py>(py: Python<'py>, map: Image<'py>, summary: &str) -> PyResult<Bound<'py, PyAny>> {
    let (outcome, force) = reduced(py, &map, summary)?;
    let calibration = outcome.calibration(force);
    let mut out: Value = json!(outcome.pad);
    out["radius"] = json!(1e-3 * outcome.radius_mm());
    out["youngs_modulus"] = json!(1e3 * calibration * outcome.pad.hemisphere_kpa);
    out["calibration"] = json!(calibration);
    out["tabulated"] = json!(outcome.pad.tabulated());
    arrays::python(py, &out)
}

/// Writes the fingertip file that `palpate fingertip` would write.
#[pyfunction]
pub fn write_fingertip(py: Python<'_>, path: PathBuf, map: Image<'_>, summary: &str, source: &str) -> PyResult<()> {
    let (outcome, force) = reduced(py, &map, summary)?;
    let (radius, calibration) = (outcome.radius_mm(), outcome.calibration(force));
    io::write_fingertip(path, &outcome.pad, radius, calibration, source).map_err(told)
}
