//! `palpate.grasp`.

use super::arrays::{self, Callback, told};
use crate::io::{self, SceneOverrides};
use crate::pipeline;
use crate::report::GraspReport;
use crate::report::grasp::summary;
use crate::types::grasp::{MotionRow, Sample};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::path::PathBuf;

/// The grasp of a scene file, with what `palpate grasp` writes.
#[pyfunction]
#[pyo3(signature = (scene, model=None, formulation=None, step=None, progress=None, threads=None))]
pub fn grasp<'py>(
    py: Python<'py>,
    scene: PathBuf,
    model: Option<&str>,
    formulation: Option<&str>,
    step: Option<f64>,
    progress: Callback,
    threads: Option<i64>,
) -> PyResult<Bound<'py, PyDict>> {
    let overrides = SceneOverrides {
        model: model.map(str::parse).transpose().map_err(told)?,
        formulation: formulation.map(str::parse).transpose().map_err(told)?,
        step,
    };
    let file = io::read_scene(&scene, &overrides).map_err(told)?;
    let (outcome, results) = arrays::run(py, progress, threads, |tell| {
        (pipeline::grasp::run(&file.scene, tell), pipeline::grasp::ensemble(&file.sweep, tell))
    })?;
    let outcome = outcome.map_err(told)?;
    let name = scene.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let without = outcome.without_tangential.map(|r| r.map_err(|e| e.to_string()));
    let ended = results.into_iter().map(|r| r.map_err(|e| e.to_string()));
    let sweep: Vec<_> = file.sweep.into_iter().zip(ended).collect();
    let run = &outcome.run;
    let notes = pipeline::grasp::notes(&file.scene, run);
    let report = GraspReport {
        name: &name,
        scene: &file.scene,
        run,
        without_tangential: without.as_ref(),
        stable_steps: &outcome.stable_steps,
        bands: outcome.bands.as_ref(),
        sweep: &sweep,
        seconds: &outcome.seconds,
        warnings: &notes,
    };
    let out = PyDict::new(py);
    out.set_item("summary", arrays::python(py, &summary(&report))?)?;
    let samples: Vec<_> = run.samples.iter().map(io::stored_sample).collect();
    out.set_item("trajectory", arrays::table(py, &samples))?;
    out.set_item("trajectory_columns", Sample::COLUMNS.to_vec())?;
    let motions: Vec<_> = run.motions.iter().map(io::stored_motion).collect();
    out.set_item("motions", arrays::table(py, &motions))?;
    out.set_item("motion_columns", MotionRow::COLUMNS[1..].to_vec())?;
    Ok(out)
}
