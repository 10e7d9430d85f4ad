//! The files of a field run.

use super::record::Recording;
use anyhow::Result;
use clap::Args;
use palpate::error::IoError;
use palpate::error::Shown;
use palpate::field::jacobian::{determinant_at, determinant_rows};
use palpate::field::warp::{warp_rows, warped_at};
use palpate::io::{self, OutputFolder};
use palpate::numerics::sampling::Sampler;
use palpate::pipeline::field::FieldResult;
use palpate::pipeline::start::affine_of;
use palpate::pipeline::strain::StrainResult;
use palpate::report::record::{in_summary, on_page};
use palpate::report::strain::StrainReport;
use palpate::report::{FieldReport, html, json};
use palpate::strain::{StrainField, measure};
use palpate::types::{AffineMap, DenseField, FieldParams, Grid, Mask, Metrics, MotionModel, Volume, WorldPoint};
use rayon::prelude::*;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Names of what [`write_field`] writes.
pub const FIELD_FILES: [&str; 10] = [
    "displacement.nii.gz",
    "warped.nii.gz",
    "jacobian.nii.gz",
    "uncertainty.nii.gz",
    "posterior.nii.gz",
    "bodies.nii.gz",
    "matches.csv",
    "mesh.vtu",
    "summary.json",
    "report.html",
];

/// Written beside them where one affine map is the motion.
pub const AFFINE_FILE: &str = "affine.txt";

/// The motion, where it is one affine map.
fn affine(result: &FieldResult) -> Option<AffineMap> {
    let one = result.summary.model != MotionModel::Free && result.summary.bodies.len() < 2;
    one.then(|| affine_of(&result.displacement).ok()).flatten()
}

/// Names of the maps and tables that [`write_strain`] writes.
pub const STRAIN_FILES: [&str; 7] = [
    "strain.nii.gz",
    "strain_sd.nii.gz",
    "principal.nii.gz",
    "directions.nii.gz",
    "shear.nii.gz",
    "volume_change.nii.gz",
    "regions.csv",
];

/// Where results go.
#[derive(Debug, Args)]
pub struct Target {
    /// Folder for the results
    #[arg(short, long, value_name = "DIR")]
    pub output: PathBuf,
    /// Write into a folder that is not empty
    #[arg(long, alias = "force")]
    overwrite: bool,
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
        Ok(OutputFolder::check(&self.output, self.overwrite)?)
    }

    /// Makes the folder ready.
    pub fn create(&self) -> Result<OutputFolder> {
        Ok(OutputFolder::create(&self.output, self.overwrite)?)
    }

    /// The last line of a summary: what to look at.
    pub fn look(&self) -> String {
        format!("  results      {}", self.output.join("report.html").shown())
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
    pub strain: Option<&'a StrainResult>,
    pub record: Recording,
}

/// Voxels of a grid up to which what is made for a file is kept for the report. Of a larger one,
/// files are made some rows at a time, and the report works out what it shows.
const MAX_KEPT_VOXELS: usize = 2_000_000;

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
        if grid.len() > MAX_KEPT_VOXELS {
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
    let Measured { command, names, initial, deformed, mask, params, truth, strain, record } = measured;
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
    if let Some(map) = affine(result) {
        folder.write(AFFINE_FILE, |p| io::write_affine(p, &map, io::AffineFormat::Itk))?;
    }
    folder.write("posterior.nii.gz", |p| io::write_samples(p, &result.samples))?;
    folder.write("bodies.nii.gz", |p| io::write_labels(p, &result.bodies, "palpate: bodies, from 1"))?;
    folder.write("matches.csv", |p| io::write_matches(p, &result.matches))?;
    let at_nodes = result.at_nodes();
    let strained = strain.map(|s| at_places(&s.strain, at_nodes.iter().map(|m| m.initial)));
    folder.write("mesh.vtu", |p| io::write_match_mesh(p, &result.mesh, &at_nodes, strained.as_deref()))?;
    if let Some(strain) = strain {
        write_strain(folder, strain, &result.bodies)?;
    }
    let mut writing = started.elapsed();

    let started = Instant::now();
    let deformed_grid = *deformed.grid();
    let sampler = Sampler::owning(deformed, 0.0);
    let rows = |first: usize, out: &mut [f32]| warp_rows(&sampler, &deformed_grid, displacement, first, out);
    let warped = Layer::new(grid, rows, |offset| warped_at(&sampler, &deformed_grid, displacement, offset));
    let mut summary = result.summary.clone();
    summary.seconds.push(("warp".into(), started.elapsed().as_secs_f64()));

    let started = Instant::now();
    let centres = (grid.len() <= MAX_KEPT_VOXELS && deformed_grid == *initial.grid()).then(|| sampler.at_centres());
    let still = |offset: usize| match &centres {
        Some(values) => values[offset],
        None => {
            let [i, j, k] = initial.grid().voxel(offset);
            sampler.at(deformed_grid.affine().to_voxel(initial.grid().world(i, j, k)))
        }
    };
    let [jacobian, uncertainty, seen] =
        [&jacobian, &uncertainty, &warped].map(|layer| |offset: usize| layer.at(offset));
    let maps = strain.map(StrainMaps::of);
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
        strain: maps.as_ref().map(|maps| maps.report(names[0], displacement, &result.bodies, Some(initial))),
    };
    let (written, page) = rayon::join(
        || folder.write("warped.nii.gz", |p| warped.write(p, "palpate: deformed at x + u(x)", None)),
        || html::page(&report),
    );
    written?;
    let record = record.finish();
    let page = on_page(page?, &record);
    folder.write("report.html", |p| io::write_text(p, &page))?;
    writing += started.elapsed();
    let mut summary = summary.clone();
    summary.seconds.push(("write".into(), writing.as_secs_f64()));
    report.summary = &summary;
    folder.write("summary.json", |p| io::write_json(p, &in_summary(json::field_summary(&report), &record)))?;
    let text = palpate::report::text::field_summary(&report);
    result.summary = summary;
    Ok(text)
}

/// Stages the maps and the table of [`STRAIN_FILES`]; `bodies` are 0 outside the tissue, where the
/// maps are 0.
pub fn write_strain(folder: &mut OutputFolder, result: &StrainResult, bodies: &Mask) -> Result<(), IoError> {
    let StrainResult { strain, deviation, summary } = result;
    let grid = strain.grid();
    let axes = format!("palpate: {} strain, LPS axes", summary.measure.name());
    folder.write("strain.nii.gz", |p| io::write_tensors(p, grid, strain.tensors(), &axes))?;
    let measured = |at: usize| bodies.as_slice()[at] != 0;
    let each = |at: usize| match measured(at) {
        true => deviation.at(grid.centre(at)).map(|v| v as f32),
        false => [0.0; 6],
    };
    let vague: Vec<[f32; 6]> = (0..grid.len()).into_par_iter().map(each).collect();
    folder.write("strain_sd.nii.gz", |p| io::write_tensor_deviations(p, grid, &vague, "palpate: 1 sigma of strain"))?;
    drop(vague);
    let principal: Vec<[f32; 3]> =
        (0..grid.len()).into_par_iter().map(|at| strain.principal(at).map(|v| v as f32)).collect();
    folder.write("principal.nii.gz", |p| {
        io::write_vectors(p, grid, &principal, "palpate: principal strains", io::STRAIN_BITS)
    })?;
    drop(principal);
    let lps = |at: usize| -> [f32; 9] {
        let rows = if measured(at) { measure::directions(&strain.at(at)) } else { [[0.0; 3]; 3] };
        std::array::from_fn(|c| rows[c / 3][c % 3] as f32 * if c % 3 < 2 { -1.0 } else { 1.0 } + 0.0)
    };
    let directions: Vec<[f32; 9]> = (0..grid.len()).into_par_iter().map(lps).collect();
    let said = "palpate: principal directions, largest first, LPS";
    folder.write("directions.nii.gz", |p| io::write_vectors(p, grid, &directions, said, DIRECTION_BITS))?;
    drop(directions);
    let map = |of: &(dyn Fn(usize) -> f64 + Sync)| Volume::from_voxels(*grid, |at, _| of(at) as f32);
    let shear = map(&|at| measure::largest_shear(&strain.at(at)));
    folder.write("shear.nii.gz", |p| io::write_steps(p, &shear, "palpate: largest shear strain", io::STRAIN_BITS))?;
    let change = map(&|at| measure::volume_change(summary.measure, &strain.at(at)));
    folder.write("volume_change.nii.gz", |p| {
        io::write_steps(p, &change, "palpate: relative change of volume", io::STRAIN_BITS)
    })?;
    folder.write("regions.csv", |p| io::write_region_strains(p, &summary.regions))
}

/// Unit vectors are kept to 2^-9, a tenth of a degree.
const DIRECTION_BITS: i32 = 9;

/// The strain in the voxels nearest to these places (mm); those outside have that of the border.
pub fn at_places(strain: &StrainField, places: impl Iterator<Item = WorldPoint>) -> Vec<[f64; 6]> {
    let grid = strain.grid();
    let voxel = |p: WorldPoint| {
        let at = grid.affine().to_voxel(p).0;
        let [i, j, k] = std::array::from_fn(|a| (at[a].round().max(0.0) as usize).min(grid.shape()[a] - 1));
        grid.index(i, j, k)
    };
    places.map(|p| strain.at(voxel(p))).collect()
}

/// What a report shows of a strain, worked out where it is asked for.
pub struct StrainMaps<'a> {
    result: &'a StrainResult,
    maps: [Box<dyn Fn(usize) -> f32 + Sync + 'a>; 5],
}

impl<'a> StrainMaps<'a> {
    pub fn of(result: &'a StrainResult) -> Self {
        let StrainResult { strain, deviation, summary } = result;
        let normal = move |at: usize| {
            let d = deviation.at(strain.grid().centre(at));
            ((d[0] * d[0] + d[1] * d[1] + d[2] * d[2]) / 3.0).sqrt() as f32
        };
        let maps: [Box<dyn Fn(usize) -> f32 + Sync + 'a>; 5] = [
            Box::new(move |at| strain.principal(at)[0] as f32),
            Box::new(move |at| strain.principal(at)[2] as f32),
            Box::new(move |at| measure::largest_shear(&strain.at(at)) as f32),
            Box::new(move |at| measure::volume_change(summary.measure, &strain.at(at)) as f32),
            Box::new(normal),
        ];
        Self { result, maps }
    }

    pub fn report<'b>(
        &'b self,
        name: &'b str,
        displacement: &'b DenseField,
        bodies: &'b Mask,
        image: Option<&'b Volume>,
    ) -> StrainReport<'b> {
        let [largest, smallest, shear, volume, deviation] = &self.maps;
        StrainReport {
            name,
            displacement,
            image,
            bodies,
            largest,
            smallest,
            shear,
            volume,
            deviation,
            summary: &self.result.summary,
        }
    }
}
