//! `palpate.track`.

use super::arrays::{self, Callback, Image, told};
use super::field::{kept_field, params};
use crate::error::FieldError;
use crate::pipeline::known::Known;
use crate::pipeline::track::{Frame, Sequence, run};
use crate::report::animation::Film;
use crate::report::track::{TrackReport, summary};
use crate::types::{DenseField, Voxels};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};
use serde_json::json;
use std::time::Instant;

/// The displacement from one volume of a sequence to each other, with strain and trajectories.
#[pyfunction]
#[pyo3(signature = (volumes, reference, mask, labels, params, names, regions, together=true, step_s=None, progress=None, threads=None))]
pub fn track<'py>(
    py: Python<'py>,
    volumes: Vec<Image<'py>>,
    reference: usize,
    mask: Option<Image<'py>>,
    labels: Option<Image<'py>>,
    params: &str,
    names: Vec<String>,
    regions: [String; 2],
    together: bool,
    step_s: Option<f64>,
    progress: Callback,
    threads: Option<i64>,
) -> PyResult<Bound<'py, PyDict>> {
    let params = self::params(params)?;
    let frames = volumes.len();
    if frames < 2 {
        let what = names.first().map_or("no volume is given".into(), |name| format!("{name}: is one volume"));
        return Err(told(format!("{what}; give two or more, or a 4-D file")));
    }
    if reference >= frames {
        return Err(told(format!("reference is {reference}, but there are {frames} volumes (counted from 0)")));
    }
    let started = Instant::now();
    let all = volumes.iter().map(arrays::volume).collect::<PyResult<Vec<Voxels<'_>>>>()?;
    let grid = *all[reference].grid();
    let mask = arrays::mask(mask.as_ref(), &regions[0], &grid, &names[reference])?;
    let labels = arrays::mask(labels.as_ref(), &regions[1], &grid, &names[reference])?;
    let reading = started.elapsed().as_secs_f64();
    let mut fields: Vec<Option<DenseField>> = vec![None; frames];
    fields[reference] = Some(DenseField::zeros(grid));
    let tracked = arrays::run(py, progress, threads, |tell| {
        let read = |number: usize| Ok::<_, FieldError>(all[number].view());
        let keep = |frame: Frame<'_>| {
            fields[frame.number] = Some(kept_field(frame.result.displacement.clone()));
            Ok(())
        };
        let sequence = Sequence {
            frames,
            origin: reference,
            reference: &all[reference],
            known: Known::mask(mask.as_ref()),
            landmarks: &[],
            labels: labels.as_ref(),
            params: &params,
            together,
        };
        run(&sequence, read, keep, tell)
    })?;
    let tracked = tracked.map_err(told)?;
    let out = PyDict::new(py);
    let list = PyList::empty(py);
    for field in fields {
        match field {
            Some(field) => list.append(arrays::array4(py, field)?)?,
            None => list.append(py.None())?,
        }
    }
    out.set_item("displacement", list)?;
    out.set_item("affine", arrays::stored_rows(&grid))?;
    let points = tracked.trajectories.iter().enumerate().flat_map(|(point, t)| {
        t.known(reference).map(move |(frame, p)| {
            json!({
                "point": point, "frame": frame, "x": p.position.0[0], "y": p.position.0[1], "z": p.position.0[2],
                "sigma": p.sigma, "state": p.state,
            })
        })
    });
    out.set_item("trajectories", arrays::python(py, &points.collect())?)?;
    out.set_item("strain", arrays::python(py, &json!(tracked.strain))?)?;
    let measuring = tracked.frames.iter().map(|f| f.seconds).sum();
    let report = TrackReport {
        names: &names,
        reference,
        step_s,
        grid: &grid,
        regions: regions.each_ref().map(String::as_str),
        params: &params,
        tracked: &tracked,
        film: &Film::new(&grid, grid.world(0, 0, 0), None, [0.0, 1.0]),
        look: None,
        judged: &[],
        warnings: &[],
        seconds: &[("read", reading), ("measure", measuring)].map(|(stage, s)| (stage.to_string(), s)),
    };
    let summary = summary(&report);
    out.set_item("summary", arrays::python(py, &summary)?)?;
    Ok(out)
}
