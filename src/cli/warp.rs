//! `palpate warp`: images, labels and points carried along a field.

use super::Usage;
use super::console::Console;
use super::convention::Convention;
use super::inputs::{check_distinct, check_output_file};
use anyhow::{Result, bail};
use clap::Args;
use palpate::error::IoError;
use palpate::field::warp::{warp_image, warp_labels, warp_points};
use palpate::io;
use palpate::numerics::sampling::Interpolation;
use palpate::types::{DenseField, Grid, WorldPoint};
use std::path::{Path, PathBuf};

/// The largest whole number up to which single precision has all.
const WHOLE: f32 = 16_777_216.0;

#[derive(Debug, Args)]
#[command(
    after_help = "An image is read at x + u(x), so the deformed volume comes to look like the initial one. A point \
                        moves to p + u(p), from its initial to its deformed place. Use --interpolation nearest for \
                        labels and masks. With --reference and no --field nothing moves: the image comes onto that grid."
)]
pub struct Options {
    /// Image, label map or mask (.nii, .nii.gz, .nrrd, .nhdr, .mha, .mhd)
    #[arg(required_unless_present = "points")]
    image: Option<PathBuf>,
    /// Points to move instead: CSV with columns x,y,z (world mm, RAS), other columns are kept; or
    /// Slicer's .mrk.json, .fcsv
    #[arg(long, value_name = "P", conflicts_with_all = ["image", "reference", "interpolation"])]
    points: Option<PathBuf>,
    /// Displacement field (5-D NIfTI, .nrrd or .mha; LPS mm, as `palpate field` writes it)
    #[arg(long, value_name = "F", required_unless_present = "reference")]
    field: Option<PathBuf>,
    /// File to write
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Take the grid of this image or field instead of the field's
    #[arg(long, value_name = "R")]
    reference: Option<PathBuf>,
    /// nearest, linear or cubic
    #[arg(long, default_value = "linear")]
    interpolation: Interpolation,
    #[command(flatten)]
    convention: Convention,
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { image, points, field, output, reference, interpolation, convention } = options;
    let given = [image, points, reference].into_iter().flatten().chain(field).map(PathBuf::as_path);
    check_distinct(&given.collect::<Vec<_>>(), std::slice::from_ref(output))?;
    match (image, points) {
        (_, Some(points)) => {
            check_output_file(output, &[".csv", ".mrk.json"])?;
            let Some(field) = field else { bail!(Usage("--points needs --field".into())) };
            move_points(points, &convention.read(field)?, output, console)
        }
        (Some(image), None) => {
            check_output_file(output, &[".nii", ".nii.gz"])?;
            let grid = reference.as_deref().map(|path| grid_of(path, convention)).transpose()?;
            let field = match (field, grid) {
                (Some(field), _) => convention.read(field)?,
                (None, Some(grid)) => DenseField::zeros(grid),
                (None, None) => bail!(Usage("give --field, --reference or both".into())),
            };
            let integers = (*interpolation == Interpolation::Nearest).then(|| io::read_labels(image));
            match integers {
                Some(Ok(labels)) => {
                    io::write_labels(
                        output,
                        &warp_labels(&labels, &field, grid.as_ref(), 0),
                        "palpate: labels, warped",
                    )?;
                }
                Some(Err(error @ IoError::Os { .. })) => return Err(error.into()),
                _ => {
                    let volume = io::read_volume(image)?;
                    let exact = *interpolation == Interpolation::Nearest;
                    if let Some(v) = volume.as_slice().iter().find(|v| exact && v.is_finite() && v.abs() > WHOLE) {
                        bail!(
                            "{}: holds {v}, and numbers beyond {WHOLE} cannot be told apart in single precision; give labels smaller numbers",
                            image.display()
                        );
                    }
                    let warped = warp_image(&volume, &field, grid.as_ref(), *interpolation, 0.0);
                    // No value appears that was not there.
                    let write = if exact { io::write_exact } else { io::write_volume };
                    write(output, &warped, "palpate: warped")?;
                }
            }
            console.say(&format!("Wrote {}.", output.display()))
        }
        (None, None) => Ok(()),
    }
}

/// The grid of an image or a field.
fn grid_of(path: &Path, convention: &Convention) -> Result<Grid> {
    match io::read_volume(path) {
        Ok(volume) => Ok(*volume.grid()),
        Err(error) => convention.read(path).map(|field| *field.grid()).map_err(|_| error.into()),
    }
}

/// Points outside the field's grid keep their line in a table, with NaN for a place; a point list
/// of Slicer has none of those.
fn move_points(points: &Path, field: &DenseField, output: &Path, console: &Console) -> Result<()> {
    let mut table = io::read_points(points)?;
    let moved = warp_points(&table.points, field);
    let listed = io::is_slicer(output);
    let lost = moved.iter().filter(|p| p.is_none()).count();
    if lost > 0 {
        let became = if listed { "were left out" } else { "became NaN" };
        console.warn(&format!("{lost} of {} points lie outside the field's grid and {became}", moved.len()));
    }
    table.points = moved.into_iter().map(|p| p.unwrap_or(WorldPoint([f64::NAN; 3]))).collect();
    io::write_points(output, &table)?;
    let kept = table.points.len() - if listed { lost } else { 0 };
    console.say(&format!("Wrote {}: {kept} points.", output.display()))
}
