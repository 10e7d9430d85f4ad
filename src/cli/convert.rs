//! `palpate convert`: a transform as another program reads it.

use super::Usage;
use super::compose::{AFFINES, FIELDS, is_affine, joined};
use super::console::Console;
use super::inputs::{check_distinct, check_output_file};
use super::transform::{Given, Volumes, read_chain};
use anyhow::{Result, bail};
use clap::Args;
use palpate::error::Shown;
use palpate::error::UnknownName;
use palpate::io::{self, AffineFormat, FieldFormat};
use palpate::types::names::choose;
use palpate::types::{AffineMap, DenseField, Grid, Transform};
use std::path::{Path, PathBuf};
use std::str::FromStr;

#[derive(Debug, Args)]
#[command(
    after_help = "Write fsl:, niftyreg:, greedy: or ras: before a file that is theirs, and ,-1 after it to turn it round. \
                        A matrix of FSL refers to the grids of two volumes: give --initial and --deformed. A field of FSL \
                        refers to its own grid and to that of --deformed."
)]
pub struct Options {
    /// Transform: .tfm, .txt, .mat, a displacement field, or a folder of `palpate field`
    #[arg(value_name = "T")]
    transform: Given,
    /// itk, fsl, niftyreg, greedy, or voxels (displacement in voxels of the field's own grid)
    #[arg(long, value_name = "NAME")]
    to: Target,
    /// File to write: .txt, .tfm or .mat of an affine transform, else a field
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    #[command(flatten)]
    volumes: Volumes,
}

/// For whom.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Target {
    Itk,
    Fsl,
    Niftyreg,
    Greedy,
    Voxels,
}

impl FromStr for Target {
    type Err = UnknownName;

    fn from_str(name: &str) -> Result<Self, UnknownName> {
        let known = [
            ("itk", Self::Itk),
            ("fsl", Self::Fsl),
            ("niftyreg", Self::Niftyreg),
            ("greedy", Self::Greedy),
            ("voxels", Self::Voxels),
        ];
        choose("target", name, &known)
    }
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { transform, to, output, volumes } = options;
    let given: Vec<&Path> = std::iter::once(transform.path.as_path()).chain(volumes.paths()).collect();
    check_distinct(&given, std::slice::from_ref(output))?;
    check_output_file(output, &[&AFFINES[..], &FIELDS].concat())?;
    let grids = volumes.grids()?;
    let chain = read_chain(std::slice::from_ref(transform), &grids, console)?;
    // What is turned round leads from the deformed volume to the initial one.
    let grids = if transform.inverse { [grids[1], grids[0]] } else { grids };
    match (chain.affine(), &chain.0[..]) {
        (Some(map), _) => affine(output, &map, *to, &grids)?,
        (None, [Transform::Field(found)]) => field(output, found, *to, &grids)?,
        (None, [Transform::Inverse(found)]) => field(output, &joined(&chain, found.grid(), console)?, *to, &grids)?,
        _ => bail!(Usage(format!(
            "{} holds several transforms; make one field of them first with palpate compose",
            transform.path.shown()
        ))),
    }
    console.say(&format!("Wrote {}.", output.shown()));
    Ok(())
}

fn affine(output: &Path, map: &AffineMap, to: Target, grids: &[Option<Grid>; 2]) -> Result<()> {
    if !is_affine(output) {
        bail!(Usage(format!(
            "{}: an affine transform is no field: end the name in {}, or make a field with palpate compose --reference",
            output.shown(),
            AFFINES.join(" or ")
        )));
    }
    let format = match (to, grids) {
        (Target::Itk, _) => AffineFormat::Itk,
        (Target::Greedy | Target::Niftyreg, _) => AffineFormat::Matrix,
        (Target::Fsl, [Some(initial), Some(deformed)]) => AffineFormat::Flirt { initial, deformed },
        (Target::Fsl, _) => bail!(Usage(
            "a matrix of FSL refers to the grids of two volumes: give --initial (the fixed one) and --deformed".into()
        )),
        (Target::Voxels, _) => bail!(Usage("--to voxels takes a field, and this transform is affine".into())),
    };
    Ok(io::write_affine(output, map, format)?)
}

fn field(output: &Path, field: &DenseField, to: Target, grids: &[Option<Grid>; 2]) -> Result<()> {
    if is_affine(output) {
        let endings = FIELDS.join(" or ");
        bail!(Usage(format!("{}: the transform is a field: end the name in {endings}", output.shown())));
    }
    let format = match (to, &grids[1]) {
        (Target::Itk | Target::Greedy, _) => FieldFormat::Itk,
        (Target::Niftyreg, _) => FieldFormat::Niftyreg,
        (Target::Fsl, Some(deformed)) => FieldFormat::Fsl { deformed },
        (Target::Fsl, None) => bail!(Usage(
            "a field of FSL refers to the grid of the volume that it leads to: give --deformed (--initial where the field is \
             turned round)"
                .into()
        )),
        (Target::Voxels, _) => FieldFormat::Voxels,
    };
    Ok(io::write_field_as(output, field, format)?)
}
