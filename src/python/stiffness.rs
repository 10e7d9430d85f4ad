//! `palpate.stiffness`.

use super::arrays::{self, Callback, Image, Rows, told};
use super::field::kept;
use crate::io;
use crate::pipeline::stiffness::{FieldQuality, Inputs, MIN_MATCHES_IN_BODY, inside, run};
use crate::report::stiffness::{InputNames, summary};
use crate::stiffness::boundary_conditions::Place;
use crate::types::stiffness::{LawChoice, Side};
use crate::types::{Grid, StiffnessParams};
use numpy::{PyReadonlyArray2, PyReadonlyArray4};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::collections::{BTreeMap, HashMap};

/// A side by its name, or a mask.
#[derive(FromPyObject)]
pub enum Patch<'py> {
    /// `z-`.
    Side(String),
    /// On the field's grid.
    Mask(Image<'py>),
}

fn place(patch: &Patch<'_>, grid: &Grid, name: &str) -> PyResult<Place> {
    match patch {
        Patch::Side(text) => Side::parse(text)
            .map(Place::Side)
            .ok_or_else(|| told(format!("{name} is {text:?}, but must be a side (x-, x+, y-, y+, z-, z+) or a mask"))),
        Patch::Mask(image) => {
            let mask = arrays::mask(Some(image), name, grid, "the field")?;
            mask.map(|m| Place::Mask(Box::new(m), name.into())).ok_or_else(|| told("no mask"))
        }
    }
}

/// Young's modulus from a displacement (mm, RAS), with all that `palpate stiffness` writes but the
/// models.
#[pyfunction]
#[pyo3(signature = (displacement, affine, matches, unasked, body, labelled, names, held, load, force, poisson, poisson_of, fixed, label_sd, model, nodes, regions, field_summary, samples, called, progress=None, threads=None))]
pub fn stiffness<'py>(
    py: Python<'py>,
    displacement: PyReadonlyArray4<'py, f32>,
    affine: Rows,
    matches: Option<PyReadonlyArray2<'py, f64>>,
    unasked: bool,
    body: Image<'py>,
    labelled: bool,
    names: HashMap<u8, String>,
    held: Patch<'py>,
    load: Patch<'py>,
    force: Option<f64>,
    poisson: f64,
    poisson_of: BTreeMap<u8, f64>,
    fixed: BTreeMap<u8, f64>,
    label_sd: f64,
    model: &str,
    nodes: usize,
    regions: usize,
    field_summary: &str,
    samples: Option<arrays::Samples<'py>>,
    called: [String; 2],
    progress: Callback,
    threads: Option<i64>,
) -> PyResult<Bound<'py, PyDict>> {
    let model: LawChoice = model.parse().map_err(told)?;
    let params = StiffnessParams {
        poisson,
        poisson_of: poisson_of.into_iter().collect(),
        fixed: fixed.into_iter().collect(),
        label_sd,
        model,
        force_n: force,
        nodes,
        regions,
    };
    params.check().map_err(told)?;
    let field = arrays::displacement(&displacement, affine)?;
    let mut labels = match arrays::mask(Some(&body), &called[1], field.grid(), &called[0])? {
        Some(labels) => labels,
        None => return Err(told("give labels or a mask")),
    };
    if !labelled {
        labels.as_mut_slice().iter_mut().for_each(|v| *v = u8::from(*v > 0));
    }
    if let Some(label) = names.keys().find(|l| !labels.as_slice().contains(l)) {
        return Err(told(format!("names: the label map holds no label {label}")));
    }
    if let Some(label) = params.label_not_in(&labels) {
        return Err(told(format!("poisson and fixed: the label map holds no label {label}")));
    }
    let of_field: serde_json::Value = serde_json::from_str(field_summary).map_err(told)?;
    let samples = samples.as_ref().map(arrays::error_samples).transpose()?;
    let quality = FieldQuality {
        trust: serde_json::from_value(of_field["trust"].clone()).ok(),
        model: serde_json::from_value(of_field["model"].clone()).ok(),
        samples: samples.as_ref(),
    };
    let (held, load) = (place(&held, field.grid(), "held")?, place(&load, field.grid(), "load")?);
    // Of too few matches in the body the field itself tells more, as on the command line.
    let matches = matches.map(|m| arrays::matches(&m)).transpose()?;
    let matches = matches.filter(|m| !unasked || inside(m, &labels) >= MIN_MATCHES_IN_BODY);
    let result = arrays::run(py, progress, threads, |tell| {
        let named = |label: u8| names.get(&label).cloned().unwrap_or_else(|| format!("region {label}"));
        let inputs = Inputs {
            field: &field,
            matches: matches.as_ref(),
            labels: &labels,
            labelled,
            held: &held,
            load: &load,
            names: &named,
            quality,
        };
        run(&inputs, &params, tell)
    })?;
    let result = result.map_err(told)?;
    let inputs = InputNames {
        field: called[0].clone(),
        body: called[1].clone(),
        matches: matches.as_ref().map(|_| "matches".into()),
        held: held.name(),
        load: load.name(),
    };
    let told = summary(&result, &inputs);
    let out = PyDict::new(py);
    out.set_item("affine", arrays::stored_rows(result.map.grid()))?;
    out.set_item("summary", arrays::python(py, &told)?)?;
    let points: Vec<[f64; 3]> = result.mesh.nodes().iter().map(|p| p.0).collect();
    out.set_item("nodes", arrays::table(py, &points))?;
    out.set_item("elements", arrays::table(py, result.mesh.tetrahedra()))?;
    out.set_item("element_modulus", numpy::PyArray1::from_slice(py, &result.element_modulus))?;
    out.set_item("node_displacement", arrays::table(py, &result.displacement))?;
    out.set_item("stiffness", arrays::array3(py, kept(result.map, io::stored))?)?;
    out.set_item("stiffness_sd", arrays::array3(py, kept(result.map_sd, io::stored))?)?;
    out.set_item("residual", arrays::array3(py, kept(result.residual, io::stored))?)?;
    Ok(out)
}
