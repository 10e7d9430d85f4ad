//! `palpate.fingertip`.

use super::arrays::{self, Image, told};
use crate::io;
use crate::pipeline::fingertip::{PadOutcome, of_map};
use pyo3::prelude::*;
use serde_json::{Value, json};
use std::path::PathBuf;

/// A stiffness map reduced to a fingertip.
#[pyclass(frozen)]
pub struct Pad {
    outcome: PadOutcome,
    force_n: Option<f64>,
    warnings: Vec<String>,
}

#[pymethods]
impl Pad {
    /// What the fingertip file says, as a dict.
    fn summary<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let pad = &self.outcome.pad;
        let calibration = self.outcome.calibration(self.force_n);
        let mut out: Value = json!(pad);
        out["radius"] = json!(1e-3 * self.outcome.radius_mm());
        out["youngs_modulus"] = json!(1e3 * calibration * pad.hemisphere_kpa);
        out["calibration"] = json!(calibration);
        out["tabulated"] = json!(pad.tabulated());
        out["warnings"] = json!(self.warnings);
        arrays::python(py, &out)
    }

    /// Writes the fingertip file that `palpate fingertip` would write.
    fn write(&self, path: PathBuf, source: &str) -> PyResult<()> {
        let (radius, calibration) = (self.outcome.radius_mm(), self.outcome.calibration(self.force_n));
        io::write_fingertip(path, &self.outcome.pad, radius, calibration, source).map_err(told)
    }
}

/// Reduces a stiffness result, its map (kPa) and its summary as JSON, to a fingertip.
#[pyfunction]
pub fn fingertip(py: Python<'_>, map: Image<'_>, summary: &str, nodes: usize) -> PyResult<Pad> {
    let folder = io::stiffness_folder(arrays::volume(&map)?.into_volume(), summary).map_err(told)?;
    let outcome = py.detach(|| of_map(&folder, nodes, &|_, _| ())).map_err(told)?;
    let warnings = outcome.warnings(&folder);
    Ok(Pad { outcome, force_n: folder.force_n, warnings })
}
