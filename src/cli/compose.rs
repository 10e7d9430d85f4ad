//! `palpate compose`: transforms in a row as one.

use super::Usage;
use super::console::Console;
use super::inputs::{check_distinct, check_output_file, name};
use super::transform::{Given, Volumes, percent, read_chain};
use anyhow::{Result, bail};
use clap::Args;
use palpate::error::Shown;
use palpate::io::{self, AffineFormat};
use palpate::transforms::Chain;
use palpate::types::{DenseField, Grid};
use std::path::{Path, PathBuf};

/// Endings of an affine transform and of a field.
pub const AFFINES: [&str; 3] = [".txt", ".tfm", ".mat"];
pub const FIELDS: [&str; 4] = [".nii", ".nii.gz", ".nrrd", ".mha"];

#[derive(Debug, Args)]
#[command(
    after_help = "A point goes through the first transform first, as with antsApplyTransforms and greedy -r. Write fsl:, \
                        niftyreg:, greedy: or ras: before a file that is theirs, and ,-1 after one to turn it round."
)]
pub struct Options {
    /// Transforms: .tfm, .txt, .mat, a displacement field, or a folder of `palpate field`
    #[arg(required = true, value_name = "T")]
    transforms: Vec<Given>,
    /// File to write: .txt, .tfm or .mat where all are affine, else a field (.nii, .nii.gz, .nrrd,
    /// .mha)
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Take the grid of this image instead of the first field's
    #[arg(long, value_name = "R")]
    reference: Option<PathBuf>,
    /// The way back: deformed to initial
    #[arg(long)]
    inverse: bool,
    #[command(flatten)]
    volumes: Volumes,
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { transforms, output, reference, inverse, volumes } = options;
    let given = transforms.iter().map(|t| t.path.as_path()).chain(reference.as_deref()).chain(volumes.paths());
    check_distinct(&given.collect::<Vec<_>>(), std::slice::from_ref(output))?;
    check_output_file(output, &[&AFFINES[..], &FIELDS].concat())?;
    let mut chain = read_chain(transforms, &volumes.grids()?, console)?;
    if *inverse {
        chain = chain.inverse();
    }
    if is_affine(output) {
        let Some(map) = chain.affine() else {
            bail!(Usage(format!(
                "{}: the chain holds a field, so it is no affine transform; end the name in .nii.gz",
                output.shown()
            )));
        };
        io::write_affine(output, &map, AffineFormat::Itk)?;
        console.say(&format!("Wrote {}: one affine transform, as ITK has it.", output.shown()));
        return Ok(());
    }
    let reference = reference.as_ref().map(io::read_header).transpose()?;
    let grid = reference.as_ref().map(|(stored, _)| &stored.grid).or(chain.grid()).copied();
    let Some(grid) = grid else {
        bail!(Usage(
            "all transforms are affine, so none brings a grid: give --reference, or end the output in .txt, .tfm or .mat"
                .into()
        ));
    };
    io::write_field(output, &joined(&chain, &grid, console)?)?;
    console.say(&format!("Wrote {}: one field for {} transforms.", output.shown(), chain.0.len()));
    Ok(())
}

/// Whether the name is that of an affine transform.
pub fn is_affine(output: &Path) -> bool {
    AFFINES.iter().any(|e| name(output).to_lowercase().ends_with(e))
}

/// The chain as a field; says where it has none.
///
/// # Errors
/// When it has none anywhere.
pub fn joined(chain: &Chain, grid: &Grid, console: &Console) -> Result<DenseField> {
    let field = chain.to_field(grid);
    let lost = field.component(0).iter().filter(|v| !v.is_finite()).count();
    if lost == grid.len() {
        bail!(
            "the transforms lead nowhere from this grid: a field among them lies elsewhere; check their order, and that each is \
             the right way round (,-1 turns one)"
        );
    }
    if lost > 0 {
        let share = percent(lost, grid.len());
        console
            .say(&format!("{share} of the voxels lead out of a field of the chain, and have NaN for a displacement."));
    }
    Ok(field)
}
