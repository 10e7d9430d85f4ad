//! `palpate warp`: images, labels and points carried along transforms.

use super::Usage;
use super::compose::FIELDS;
use super::console::Console;
use super::convention::Convention;
use super::inputs::{check_distinct, check_output_file};
use super::transform::{Given, Volumes, percent, read_chain};
use anyhow::{Result, bail};
use clap::Args;
use palpate::error::Shown;
use palpate::io;
use palpate::numerics::label_detection::is_label_map;
use palpate::numerics::sampling::Interpolation;
use palpate::transforms::Chain;
use palpate::transforms::resample::{Resampled, resample};
use palpate::types::{Grid, Transform, Volume, WorldPoint};
use rayon::prelude::*;
use std::path::{Path, PathBuf};

#[derive(Debug, Args)]
#[command(
    after_help = "An image is read at x + u(x), so the deformed volume comes to look like the initial one. A point \
                        moves to p + u(p), from its initial to its deformed place. Of several transforms the first listed \
                        comes first, as with antsApplyTransforms and greedy -r, and all are one interpolation. Write fsl:, \
                        niftyreg:, greedy: or ras: before a file that is theirs, and ,-1 after one to turn it round. With \
                        --reference and no transform nothing moves: the image comes onto that grid."
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
    #[arg(long, value_name = "F", required_unless_present_any = ["reference", "transform"])]
    field: Option<PathBuf>,
    /// Transforms, the first listed first: .tfm, .txt, .mat, a displacement field, or a folder of
    /// `palpate field`
    #[arg(short, long, value_name = "T", num_args = 1.., conflicts_with_all = ["field", "field_convention", "field_deformed"])]
    transform: Vec<Given>,
    /// The way back along all transforms: deformed to initial
    #[arg(long, conflicts_with = "field")]
    inverse: bool,
    /// File to write (.nii, .nii.gz, .nrrd, .mha; .csv or .mrk.json of points)
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Take the grid of this image or field instead of the first field's
    #[arg(long, value_name = "R")]
    reference: Option<PathBuf>,
    /// nearest, linear, cubic or label (the label with most weight) [default: nearest for what
    /// looks like a label map, else linear]
    #[arg(long)]
    interpolation: Option<Interpolation>,
    #[command(flatten)]
    convention: Convention,
    #[command(flatten)]
    volumes: Volumes,
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { image, points, field, transform, output, reference, volumes, .. } = options;
    let given = [image, points, reference, field].into_iter().flatten().map(PathBuf::as_path);
    let given = given.chain(transform.iter().map(|t| t.path.as_path())).chain(volumes.paths());
    check_distinct(&given.collect::<Vec<_>>(), std::slice::from_ref(output))?;
    match (image, points) {
        (_, Some(points)) => {
            check_output_file(output, &[".csv", ".mrk.json"])?;
            let chain = chain(options, &volumes.grids()?, console)?;
            if chain.0.is_empty() {
                bail!(Usage("--points needs --field or --transform".into()));
            }
            move_points(points, &chain, output, console)
        }
        (Some(image), None) => {
            check_output_file(output, &FIELDS)?;
            move_image(image, options, console)
        }
        (None, None) => Ok(()),
    }
}

/// The transforms of the command line; none where there are none.
fn chain(options: &Options, grids: &[Option<Grid>; 2], console: &Console) -> Result<Chain> {
    let Options { field, transform, inverse, convention, .. } = options;
    let chain = match field {
        Some(field) => Chain(vec![Transform::Field(convention.read(field)?)]),
        None => read_chain(transform, grids, console)?,
    };
    Ok(if *inverse { chain.inverse() } else { chain })
}

fn move_image(path: &Path, options: &Options, console: &Console) -> Result<()> {
    let Options { transform, output, reference, interpolation, convention, volumes, .. } = options;
    let (stored, _) = io::read_header(path)?;
    let reference = reference.as_deref().map(|path| grid_of(path, convention)).transpose()?;
    // A transform of FSL leads between the volumes of this command, if it is alone and no others
    // are named.
    let ([initial, deformed], alone) = (volumes.grids()?, transform.len() == 1);
    let grids = [initial.or(reference.filter(|_| alone)), deformed.or(alone.then_some(stored.grid))];
    let chain = chain(options, &grids, console)?;
    let Some(grid) = reference.or(chain.grid().copied()) else {
        bail!(Usage("all transforms are affine, so none brings a grid: give the initial volume as --reference".into()));
    };
    let volume = io::read_volume(path)?;
    let labels = stored.labels || is_label_map(&volume);
    let chosen = interpolation.unwrap_or(if labels { Interpolation::Nearest } else { Interpolation::Linear });
    let exact = matches!(chosen, Interpolation::Nearest | Interpolation::Label);
    let (volume, codes) = if exact { ranked(path, volume)? } else { (volume, Vec::new()) };
    check_labels(path, &volume, chosen)?;
    if labels && !exact {
        console.warn(&format!(
            "{} looks like a label map, and between two labels there is none; leave --interpolation out, or take label",
            path.shown()
        ));
    }
    let Resampled { image: warped, outside } = resample(&volume, &chain, &grid, chosen, 0.0);
    if outside == grid.len() {
        bail!(
            "{}: no voxel of the output would come from inside it; check the order of the transforms, that each is the right \
             way round (,-1 turns one, --inverse all), and whose they are (fsl:, niftyreg:)",
            path.shown()
        );
    }
    match io::labels_of(&warped, output).ok().filter(|_| exact) {
        _ if !codes.is_empty() => {
            let of: Vec<i64> = warped.as_slice().iter().map(|&rank| codes[rank as usize]).collect();
            io::write_codes(output, warped.grid(), &of, "palpate: labels, warped")?;
        }
        Some(labels) => io::write_labels(output, &labels, "palpate: labels, warped")?,
        // No value appears that was not there.
        None if exact => io::write_exact(output, &warped, "palpate: warped")?,
        None => io::write_volume(output, &warped, "palpate: warped")?,
    }
    if labels && interpolation.is_none() {
        console.say(&format!(
            "{} is a label map: each voxel takes the nearest one's label (--interpolation chooses).",
            path.shown()
        ));
    }
    if outside > 0 {
        let share = percent(outside, grid.len());
        console.say(&format!("{share} of the voxels come from outside {} and are 0.", path.shown()));
    }
    console.say(&format!("Wrote {}.", output.shown()));
    Ok(())
}

/// Labels past what single precision tells apart as their ranks, with the label of each rank; 0,
/// which stands outside, comes first. Other volumes stay as they are.
fn ranked(path: &Path, volume: Volume) -> Result<(Volume, Vec<i64>)> {
    if volume.as_slice().iter().all(|v| v.abs() < io::WHOLE) {
        return Ok((volume, Vec::new()));
    }
    let Some(all) = io::read_integers(path)? else { return Ok((volume, Vec::new())) };
    let mut codes: Vec<i64> = all.iter().copied().filter(|c| *c != 0).collect();
    codes.par_sort_unstable();
    codes.dedup();
    codes.insert(0, 0);
    if codes.len() > io::WHOLE as usize {
        bail!("{}: holds {} different numbers, more than labels", path.shown(), codes.len());
    }
    let rank = |c: &i64| if *c == 0 { 0.0 } else { 1.0 + codes[1..].partition_point(|other| other < c) as f32 };
    let ranks = all.par_iter().map(rank).collect();
    Ok((Volume::from_vec(*volume.grid(), ranks)?, codes))
}

/// Refuses numbers that cannot be distinguished where no new one may appear, and fractions as
/// labels.
fn check_labels(path: &Path, volume: &Volume, interpolation: Interpolation) -> Result<()> {
    let exact = matches!(interpolation, Interpolation::Nearest | Interpolation::Label);
    if let Some(v) = volume.as_slice().iter().find(|v| exact && v.is_finite() && v.abs() > io::WHOLE) {
        bail!(
            "{}: holds {v}, and numbers beyond {} are not distinct in single precision; give labels smaller numbers",
            path.shown(),
            io::WHOLE
        );
    }
    if let Some(v) = volume.as_slice().iter().find(|v| interpolation == Interpolation::Label && v.fract() != 0.0) {
        bail!(
            "{}: holds {v}, and labels are whole numbers; take --interpolation linear or cubic for an image",
            path.shown()
        );
    }
    Ok(())
}

/// The grid of an image or a field.
fn grid_of(path: &Path, convention: &Convention) -> Result<Grid> {
    match io::read_volume(path) {
        Ok(volume) => Ok(*volume.grid()),
        Err(error) => convention.read(path).map(|field| *field.grid()).map_err(|_| error.into()),
    }
}

/// Points for which a field says nothing keep their line in a table, with NaN for a place; a point
/// list of Slicer has none of those.
fn move_points(points: &Path, chain: &Chain, output: &Path, console: &Console) -> Result<()> {
    let mut table = io::read_points(points)?;
    let moved: Vec<Option<WorldPoint>> = table.points.iter().map(|&p| chain.at(p)).collect();
    let listed = io::is_slicer(output);
    let lost = moved.iter().filter(|p| p.is_none()).count();
    if lost == moved.len() {
        bail!(
            "{}: none of its {lost} points lies where the transforms lead; places are world mm, RAS (those in LPS have x and y with the \
             other sign)",
            points.shown()
        );
    }
    if lost > 0 {
        let became = if listed { "were left out" } else { "became NaN" };
        console.warn(&format!("{lost} of {} points lie outside the field's grid and {became}", moved.len()));
    }
    table.points = moved.into_iter().map(|p| p.unwrap_or(WorldPoint([f64::NAN; 3]))).collect();
    io::write_points(output, &table)?;
    let kept = table.points.len() - if listed { lost } else { 0 };
    console.say(&format!("Wrote {}: {kept} points.", output.shown()));
    Ok(())
}
