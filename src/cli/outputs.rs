//! The files of a field run.

use anyhow::Result;
use clap::Args;
use palpate::error::IoError;
use palpate::field::jacobian::{determinant_at, determinant_rows};
use palpate::field::warp::{warp_rows, warped_at};
use palpate::io::{self, OutputFolder};
use palpate::numerics::sampling::Sampler;
use palpate::pipeline::field::FieldResult;
use palpate::report::{FieldReport, html, json};
use palpate::types::{DenseField, FieldParams, Grid, Mask, Metrics, Volume};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Names of what [`write_field`] writes.
pub const FIELD_FILES: [&str; 9] = [
    "displacement.nii.gz",
    "warped.nii.gz",
    "jacobian.nii.gz",
    "uncertainty.nii.gz",
    "bodies.nii.gz",
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

/// Voxels of a grid up to which what is made for a file is kept for the report. Of a larger one,
/// files are made some rows at a time, and the report works out what it shows.
const KEPT: usize = 2_000_000;

/// A scalar over the result's grid: kept, or worked out where it is asked for.
enum Layer<'a> {
    Kept(Volume),
    Made { grid: &'a Grid, rows: Box<dyn Fn(usize, &mut [f32]) + Sync + 'a>, at: Box<dyn Fn(usize) -> f32 + Sync + 'a> },
}

impl<'a> Layer<'a> {
    /// Of the values of whole rows, from a row of the grid on, and of the value at a voxel offset.
    fn new(
        grid: &'a Grid,
        rows: impl Fn(usize, &mut [f32]) + Sync + 'a,
        at: impl Fn(usize) -> f32 + Sync + 'a,
    ) -> Self {
        if grid.len() > KEPT {
            return Self::Made { grid, rows: Box::new(rows), at: Box::new(at) };
        }
        Self::Kept(Volume::by_rows(*grid, rows))
    }

    fn at(&self, offset: usize) -> f32 {
        match self {
            Self::Kept(volume) => volume.as_slice()[offset],
            Self::Made { at, .. } => at(offset),
        }
    }

    /// Writes it, rounded to multiples of 2^-`bits` where they are named.
    fn write(&self, path: &Path, description: &str, bits: Option<i32>) -> Result<(), IoError> {
        match (self, bits) {
            (Self::Kept(volume), Some(bits)) => io::write_steps(path, volume, description, bits),
            (Self::Kept(volume), None) => io::write_volume(path, volume, description),
            (Self::Made { grid, rows, .. }, bits) => io::write_by_rows(path, grid, description, bits, rows),
        }
    }
}

/// Stages all files, adds the times of warping and writing to the summary, and gives the short
/// summary for stdout back.
pub fn write_field(folder: &mut OutputFolder, measured: Measured<'_>, result: &mut FieldResult) -> Result<String> {
    let Measured { command, names, initial, deformed, mask, params, truth } = measured;
    let started = Instant::now();
    let displacement = &result.displacement;
    let grid = displacement.grid();
    folder.write("displacement.nii.gz", |p| io::write_field(p, displacement))?;
    let rows = |first: usize, out: &mut [f32]| determinant_rows(displacement, first, out);
    let jacobian = Layer::new(grid, rows, |offset| determinant_at(displacement, offset));
    folder.write("jacobian.nii.gz", |p| jacobian.write(p, "palpate: Jacobian determinant", Some(13)))?;
    let vague = &result.uncertainty;
    let uncertainty = Layer::new(grid, |first, out| vague.rows(first, out), |offset| vague.at(offset));
    let bits = io::length_bits(grid);
    folder.write("uncertainty.nii.gz", |p| uncertainty.write(p, "palpate: 1 sigma of u, mm", Some(bits)))?;
    folder.write("bodies.nii.gz", |p| io::write_labels(p, &result.bodies, "palpate: bodies, from 1"))?;
    folder.write("matches.csv", |p| io::write_matches(p, &result.matches))?;
    let at_nodes = result.at_nodes();
    folder.write("mesh.vtu", |p| io::write_match_mesh(p, &result.mesh, &at_nodes))?;
    let mut writing = started.elapsed();

    let started = Instant::now();
    let deformed_grid = *deformed.grid();
    let sampler = Sampler::owning(deformed, 0.0);
    let rows = |first: usize, out: &mut [f32]| warp_rows(&sampler, &deformed_grid, displacement, first, out);
    let warped = Layer::new(grid, rows, |offset| warped_at(&sampler, &deformed_grid, displacement, offset));
    let mut summary = result.summary.clone();
    summary.seconds.push(("warp".into(), started.elapsed().as_secs_f64()));

    let started = Instant::now();
    let centres = (grid.len() <= KEPT && deformed_grid == *initial.grid()).then(|| sampler.at_centres());
    let still = |offset: usize| match &centres {
        Some(values) => values[offset],
        None => {
            let [i, j, k] = initial.grid().voxel(offset);
            sampler.at(deformed_grid.affine().to_voxel(initial.grid().world(i, j, k)))
        }
    };
    let [jacobian, uncertainty, seen] =
        [&jacobian, &uncertainty, &warped].map(|layer| |offset: usize| layer.at(offset));
    let mut report = FieldReport {
        command,
        names,
        initial,
        deformed: &still,
        deformed_grid: &deformed_grid,
        warped: &seen,
        mask,
        params,
        displacement,
        jacobian: &jacobian,
        uncertainty: &uncertainty,
        bodies: &result.bodies,
        matches: &result.matches,
        mesh: &result.mesh,
        node_displacement: &result.node_displacement,
        summary: &summary,
        truth,
    };
    let (written, page) = rayon::join(
        || folder.write("warped.nii.gz", |p| warped.write(p, "palpate: deformed at x + u(x)", None)),
        || html::page(&report),
    );
    written?;
    let page = page?;
    folder.write("report.html", |p| io::write_text(p, &page))?;
    writing += started.elapsed();
    let mut summary = summary.clone();
    summary.seconds.push(("write".into(), writing.as_secs_f64()));
    report.summary = &summary;
    folder.write("summary.json", |p| io::write_json(p, &json::field_summary(&report)))?;
    let text = palpate::report::text::field_summary(&report);
    result.summary = summary;
    Ok(text)
}
