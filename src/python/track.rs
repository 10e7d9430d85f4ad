//! `palpate.track`.

use super::arrays::{self, Callback, Image, told};
use super::field::{kept_field, params};
use crate::error::FieldError;
use crate::pipeline::track::{Frame, run};
use crate::types::{DenseField, Volume};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};
use serde_json::json;

/// The displacement from one volume of a sequence to each other, with strain and trajectories.
#[pyfunction]
#[pyo3(signature = (volumes, reference, mask, labels, params, progress=None, threads=None))]
pub fn track<'py>(
    py: Python<'py>,
    volumes: Vec<Image<'py>>,
    reference: usize,
    mask: Option<Image<'py>>,
    labels: Option<Image<'py>>,
    params: &str,
    progress: Callback,
    threads: Option<usize>,
) -> PyResult<Bound<'py, PyDict>> {
    let params = self::params(params)?;
    let frames = volumes.len();
    if frames < 2 || reference >= frames {
        return Err(told(format!(
            "reference is {reference}, but there are {frames} volumes (counted from 0, two at least)"
        )));
    }
    let all = volumes.iter().map(arrays::volume).collect::<PyResult<Vec<Volume>>>()?;
    let grid = *all[reference].grid();
    let mask = arrays::mask(mask.as_ref(), "mask", &grid, "the reference")?;
    let labels = arrays::mask(labels.as_ref(), "labels", &grid, "the reference")?;
    let mut fields: Vec<Option<DenseField>> = vec![None; frames];
    fields[reference] = Some(DenseField::zeros(grid));
    let tracked = arrays::run(py, progress, threads, |tell| {
        let read = |number: usize| Ok::<_, FieldError>(all[number].clone());
        let keep = |frame: Frame<'_>| {
            fields[frame.number] = Some(kept_field(frame.result.displacement.clone()));
            Ok(())
        };
        run((frames, reference), &all[reference], (mask.as_ref(), labels.as_ref()), &params, read, keep, tell)
    })?;
    let tracked = tracked.map_err(told)?;
    let out = PyDict::new(py);
    let list = PyList::empty(py);
    for field in &fields {
        match field {
            Some(field) => list.append(arrays::array4(py, field)?)?,
            None => list.append(py.None())?,
        }
    }
    out.set_item("displacement", list)?;
    out.set_item("affine", arrays::stored_rows(&grid))?;
    let points = tracked.trajectories.iter().enumerate().flat_map(|(point, t)| {
        t.places.iter().enumerate().filter_map(move |(frame, place)| {
            let p = place.as_ref()?;
            Some(json!({
                "point": point, "frame": frame, "x": p.position.0[0], "y": p.position.0[1], "z": p.position.0[2],
                "sigma": p.sigma, "state": p.state,
            }))
        })
    });
    out.set_item("trajectories", arrays::python(py, &points.collect())?)?;
    out.set_item("strain", arrays::python(py, &json!(tracked.strain))?)?;
    let summary = json!({
        "version": env!("CARGO_PKG_VERSION"), "command": "track", "reference": reference, "frames": tracked.frames,
        "points": tracked.trajectories.len(), "params": params,
    });
    out.set_item("summary", arrays::python(py, &summary)?)?;
    Ok(out)
}
