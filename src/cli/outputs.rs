//! The files of a field run.

use anyhow::Result;
use clap::Args;
use palpate::field::jacobian::{determinant_at, jacobian_determinant};
use palpate::field::warp::warp_sampled;
use palpate::io::{self, OutputFolder};
use palpate::numerics::sampling::Sampler;
use palpate::pipeline::field::FieldResult;
use palpate::report::{FieldReport, html, json};
use palpate::types::{DenseField, FieldParams, Mask, Mesh, Metrics, Volume};
use std::path::{Path, PathBuf};
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

/// Where results go.
#[derive(Debug, Args)]
pub struct Target {
    /// Folder for the results
    #[arg(short, long, value_name = "DIR")]
    pub output: PathBuf,
    /// Write into a folder that is not empty
    #[arg(long)]
    force: bool,
}

impl Target {
    /// The files of these names in the folder.
    pub fn files(&self, names: &[impl AsRef<Path>]) -> Vec<PathBuf> {
        names.iter().map(|name| self.output.join(name)).collect()
    }

    /// What would stand in the way of [`Target::create`].
    ///
    /// # Errors
    /// As there.
    pub fn check(&self) -> Result<()> {
        Ok(OutputFolder::check(&self.output, self.force)?)
    }

    /// Makes the folder ready.
    pub fn create(&self) -> Result<OutputFolder> {
        Ok(OutputFolder::create(&self.output, self.force)?)
    }

    /// The last line of a summary: what to look at.
    pub fn look(&self) -> String {
        format!("  results      {}", self.output.join("report.html").display())
    }
}

/// A measured pair, as the outputs need it.
pub struct Measured<'a> {
    pub command: &'a str,
    pub names: [&'a str; 3],
    pub initial: &'a Volume,
    /// Filtered in place when it is warped.
    pub deformed: Volume,
    pub mask: Option<&'a Mask>,
    pub params: &'a FieldParams,
    pub truth: Option<(&'a DenseField, &'a Metrics)>,
}

/// Stages all files, adds the times of warping and writing to the summary, and gives the short summary for stdout back.
pub fn write_field(folder: &mut OutputFolder, measured: Measured<'_>, result: &mut FieldResult) -> Result<String> {
    let Measured { command, names, initial, deformed, mask, params, truth } = measured;
    // One volume at a time: each is made where it is written, so that few are held.
    let started = Instant::now();
    let kept = write_volumes(folder, result)?;
    let mut writing = started.elapsed();
    let started = Instant::now();
    let deformed_grid = *deformed.grid();
    let sampler = Sampler::owning(deformed, 0.0);
    let warped = warp_sampled(&sampler, &deformed_grid, &result.displacement);
    result.summary.seconds.push(("warp".into(), started.elapsed().as_secs_f64()));

    let started = Instant::now();
    let still: Box<dyn Fn(usize) -> f32 + Sync> = if deformed_grid == *initial.grid() {
        let values = sampler.at_centres();
        Box::new(move |offset| values[offset])
    } else {
        Box::new(move |offset| {
            let [i, j, k] = initial.grid().voxel(offset);
            sampler.at(deformed_grid.affine().to_voxel(initial.grid().world(i, j, k)))
        })
    };
    let [swelling, vague]: [Box<dyn Fn(usize) -> f32 + Sync>; 2] = match &kept {
        Some([jacobian, uncertainty]) => [jacobian, uncertainty].map(|v| -> Box<dyn Fn(usize) -> f32 + Sync> {
            let values = v.as_slice();
            Box::new(move |offset| values[offset])
        }),
        None => {
            let (field, uncertainty) = (&result.displacement, &result.uncertainty);
            [Box::new(|offset| determinant_at(field, offset)), Box::new(|offset| uncertainty.at(offset))]
        }
    };
    let mut report = FieldReport {
        command,
        names,
        initial,
        deformed: &*still,
        deformed_grid: &deformed_grid,
        warped: &warped,
        mask,
        params,
        displacement: &result.displacement,
        jacobian: &*swelling,
        uncertainty: &*vague,
        matches: &result.matches,
        mesh: &result.mesh,
        node_displacement: &result.node_displacement,
        summary: &result.summary,
        truth,
    };
    let (written, page) = rayon::join(
        || folder.write("warped.nii.gz", |p| io::write_volume(p, &warped, "palpate: deformed at x + u(x)")),
        || html::page(&report),
    );
    written?;
    let page = page?;
    folder.write("report.html", |p| io::write_text(p, &page))?;
    let mut summary = result.summary.clone();
    writing += started.elapsed();
    summary.seconds.push(("write".into(), writing.as_secs_f64()));
    report.summary = &summary;
    folder.write("summary.json", |p| io::write_json(p, &json::field_summary(&report)))?;
    let text = palpate::report::text::field_summary(&report);
    result.summary = summary;
    Ok(text)
}

/// Voxels of a grid up to which what was made for a file is kept for the report; beyond, the report works it out where it shows it.
const KEPT: usize = 2_000_000;

/// Writes what does not depend on the volumes; Jacobian and uncertainty are given back where they are small.
fn write_volumes(folder: &mut OutputFolder, result: &FieldResult) -> Result<Option<[Volume; 2]>> {
    folder.write("displacement.nii.gz", |p| io::write_field(p, &result.displacement))?;
    let small = result.displacement.grid().len() <= KEPT;
    let jacobian = jacobian_determinant(&result.displacement);
    folder.write("jacobian.nii.gz", |p| io::write_steps(p, &jacobian, "palpate: Jacobian determinant", 13))?;
    let jacobian = small.then_some(jacobian);
    let uncertainty = result.uncertainty.volume();
    let bits = io::length_bits(uncertainty.grid());
    folder.write("uncertainty.nii.gz", |p| io::write_steps(p, &uncertainty, "palpate: 1 sigma of u, mm", bits))?;
    let kept = jacobian.map(|jacobian| [jacobian, uncertainty]);
    folder.write("matches.csv", |p| io::write_matches(p, &result.matches))?;
    folder.write("mesh.vtu", |p| match &result.mesh {
        Mesh::Tetrahedra(mesh) => io::write_tet_mesh(p, mesh, &result.node_displacement, &[]),
        Mesh::Triangles(mesh) => io::write_tri_mesh(p, mesh, &result.node_displacement, &[]),
    })?;
    Ok(kept)
}
