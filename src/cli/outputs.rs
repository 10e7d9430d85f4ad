//! The files of a field run.

use anyhow::Result;
use palpate::field::warp::warp_image;
use palpate::io::{self, OutputFolder};
use palpate::numerics::sampling::Interpolation;
use palpate::report::{FieldReport, html, json};
use palpate::types::{DenseField, FieldParams, FieldResult, Mask, Mesh, Metrics, Volume};
use std::borrow::Cow;
use std::time::Instant;

/// Names of what [`write_field`] writes.
pub const FIELD_FILES: [&str; 8] = [
    "displacement.nii.gz",
    "warped.nii.gz",
    "jacobian.nii.gz",
    "uncertainty.nii.gz",
    "matches.csv",
    "mesh.vtu",
    "summary.json",
    "report.html",
];

/// A measured pair, as the outputs need it.
pub struct Measured<'a> {
    pub command: &'a str,
    pub names: [&'a str; 3],
    pub initial: &'a Volume,
    pub deformed: &'a Volume,
    pub mask: Option<&'a Mask>,
    pub params: &'a FieldParams,
    pub truth: Option<(&'a DenseField, &'a Metrics)>,
}

/// Stages all files, adds the time of writing to the summary, and gives the short summary for stdout back.
pub fn write_field(folder: &mut OutputFolder, measured: &Measured<'_>, result: &mut FieldResult) -> Result<String> {
    let started = Instant::now();
    let (initial, deformed) = (measured.initial, measured.deformed);
    let still = if deformed.grid() == initial.grid() {
        Cow::Borrowed(deformed)
    } else {
        Cow::Owned(warp_image(deformed, &DenseField::zeros(*initial.grid()), None, Interpolation::Linear, 0.0))
    };
    // The page is made while the volumes are packed and written.
    let (written, page) =
        rayon::join(|| write_volumes(folder, result), || html::page(&describe(measured, &still, result)));
    written?;
    let page = page?;
    folder.write("report.html", |p| io::write_text(p, &page))?;
    result.summary.seconds.push(("write".into(), started.elapsed().as_secs_f64()));
    let report = describe(measured, &still, result);
    folder.write("summary.json", |p| io::write_json(p, &json::field_summary(&report)))?;
    Ok(palpate::report::text::field_summary(&report))
}

/// `still` is the deformed volume on the initial grid.
fn describe<'a>(measured: &Measured<'a>, still: &'a Volume, result: &'a FieldResult) -> FieldReport<'a> {
    let Measured { command, names, initial, deformed, mask, params, truth } = *measured;
    let deformed_grid = deformed.grid();
    FieldReport { command, names, initial, deformed: still, deformed_grid, mask, params, result, truth }
}

fn write_volumes(folder: &mut OutputFolder, result: &FieldResult) -> Result<()> {
    folder.write("displacement.nii.gz", |p| io::write_field(p, &result.displacement))?;
    folder.write("warped.nii.gz", |p| io::write_volume(p, &result.warped, "palpate: deformed at x + u(x)"))?;
    folder.write("jacobian.nii.gz", |p| io::write_steps(p, &result.jacobian, "palpate: Jacobian determinant", 13))?;
    folder.write("uncertainty.nii.gz", |p| io::write_steps(p, &result.uncertainty, "palpate: 1 sigma of u, mm", 12))?;
    folder.write("matches.csv", |p| io::write_matches(p, &result.matches))?;
    folder.write("mesh.vtu", |p| match &result.mesh {
        Mesh::Tetrahedra(mesh) => io::write_tet_mesh(p, mesh, &result.node_displacement, &[]),
        Mesh::Triangles(mesh) => io::write_tri_mesh(p, mesh, &result.node_displacement, &[]),
    })?;
    Ok(())
}
