//! `palpate.field`.

use super::arrays::{self, Callback, Image, told};
use crate::error::FieldError;
use crate::field::jacobian::jacobian_determinant;
use crate::field::warp::warp_sampled;
use crate::io;
use crate::numerics::sampling::{Interpolation, Sampler};
use crate::pipeline;
use crate::report::{FieldReport, json};
use crate::types::params::Preset;
use crate::types::{DenseField, FieldParams, Volume};
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// Parameters from JSON with the keys of `params` in summary.json; `preset` first, then the others.
pub fn params(text: &str) -> PyResult<FieldParams> {
    let given: serde_json::Map<String, serde_json::Value> = serde_json::from_str(text).map_err(told)?;
    let preset = match given.get("preset") {
        Some(name) => serde_json::from_value::<Preset>(name.clone()).map_err(told)?,
        None => Preset::default(),
    };
    let mut all = serde_json::to_value(FieldParams::preset(preset)).map_err(told)?;
    if let Some(keys) = all.as_object_mut() {
        keys.extend(given);
    }
    let params: FieldParams = serde_json::from_value(all).map_err(told)?;
    params.check().map_err(told)?;
    Ok(params)
}

/// `volume` with each value as a file keeps it.
pub fn kept(mut volume: Volume, stored: impl Fn(f32) -> f32) -> Volume {
    volume.as_mut_slice().iter_mut().for_each(|v| *v = stored(*v));
    volume
}

/// The same for a displacement.
pub fn kept_field(mut field: DenseField) -> DenseField {
    let stored = io::stored_length(field.grid());
    field.as_mut_slice().iter_mut().for_each(|v| *v = stored(*v));
    field
}

/// The displacement from `initial` to `deformed`, with all that `palpate field` writes.
#[pyfunction]
#[pyo3(signature = (initial, deformed, mask, params, names, progress=None, threads=None))]
pub fn field<'py>(
    py: Python<'py>,
    initial: Image<'py>,
    deformed: Image<'py>,
    mask: Option<Image<'py>>,
    params: &str,
    names: [String; 3],
    progress: Callback,
    threads: Option<i64>,
) -> PyResult<Bound<'py, PyDict>> {
    let params = self::params(params)?;
    let (fixed, moving) = (arrays::volume(&initial)?, arrays::volume(&deformed)?);
    let mask = arrays::mask(mask.as_ref(), &names[2], fixed.grid(), &names[0])?;
    let measured = arrays::run(py, progress, threads, |tell| {
        let result = pipeline::field::run(&fixed, &moving, mask.as_ref(), &params, tell)?;
        let deformed_grid = *moving.grid();
        let warped =
            warp_sampled(&Sampler::new(&moving, Interpolation::Cubic, 0.0), &deformed_grid, &result.displacement);
        let jacobian = jacobian_determinant(&result.displacement);
        let uncertainty = result.uncertainty.volume();
        let unseen = |_: usize| 0.0;
        let report = FieldReport {
            command: "field",
            names: [&names[0], &names[1], &names[2]],
            initial: &fixed,
            deformed: &unseen,
            deformed_grid: &deformed_grid,
            warped: &unseen,
            mask: mask.as_ref(),
            params: &params,
            displacement: &result.displacement,
            jacobian: &unseen,
            uncertainty: &|at| result.uncertainty.at(at),
            bodies: &result.bodies,
            matches: &result.matches,
            mesh: &result.mesh,
            node_displacement: &result.node_displacement,
            summary: &result.summary,
            truth: None,
            strain: None,
        };
        let summary = json::field_summary(&report);
        let warped = kept(warped, io::stored);
        let jacobian = kept(jacobian, io::stored_steps(13));
        let stored = io::stored_length(uncertainty.grid());
        let uncertainty = kept(uncertainty, stored);
        let matches = io::stored_matches(&result.matches);
        Ok::<_, FieldError>((result, matches, warped, jacobian, uncertainty, summary))
    })?;
    let (result, matches, warped, jacobian, uncertainty, summary) = measured.map_err(told)?;
    let out = PyDict::new(py);
    let (samples, nodes_affine) = arrays::samples(py, &result.samples)?;
    out.set_item("posterior", samples)?;
    out.set_item("posterior_affine", nodes_affine)?;
    out.set_item("affine", arrays::stored_rows(result.displacement.grid()))?;
    let (nodes, elements) = arrays::mesh(py, &result.mesh);
    out.set_item("displacement", arrays::array4(py, kept_field(result.displacement))?)?;
    out.set_item("warped", arrays::array3(py, warped)?)?;
    out.set_item("jacobian", arrays::array3(py, jacobian)?)?;
    out.set_item("uncertainty", arrays::array3(py, uncertainty)?)?;
    out.set_item("bodies", arrays::array3(py, result.bodies)?)?;
    out.set_item("matches", arrays::match_rows(py, &matches))?;
    out.set_item("nodes", nodes)?;
    out.set_item("elements", elements)?;
    out.set_item("node_displacement", arrays::table(py, &result.node_displacement))?;
    out.set_item("summary", arrays::python(py, &summary)?)?;
    Ok(out)
}
