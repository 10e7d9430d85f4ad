//! `palpate invert`: the field from the deformed to the initial place.

use super::compose::FIELDS;
use super::console::Console;
use super::convention::Convention;
use super::inputs::{check_distinct, check_output_file};
use anyhow::{Result, bail};
use clap::Args;
use palpate::field::inverse::invert;
use palpate::io;
use std::path::PathBuf;

/// An inverse that is off by more than this somewhere is worth a warning (mm).
const RESIDUAL_MM: f64 = 0.1;

#[derive(Debug, Args)]
pub struct Options {
    /// Displacement field (5-D NIfTI, LPS mm)
    field: PathBuf,
    /// File to write (.nii, .nii.gz, .nrrd, .mha)
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    #[command(flatten)]
    convention: Convention,
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { field, output, convention } = options;
    check_distinct(&[field], std::slice::from_ref(output))?;
    check_output_file(output, &FIELDS)?;
    let inverse = invert(&convention.read(field)?, None);
    if inverse.outside == inverse.field.grid().len() {
        bail!(
            "{}: the field leads away from its own grid, so its inverse there would be empty; compose it with what brings it \
             back, and name a grid: palpate compose {},-1 --reference IMAGE",
            field.display(),
            field.display()
        );
    }
    io::write_field(output, &inverse.field)?;
    if inverse.folds > 0 {
        console.warn(&format!(
            "the field folds in {} voxels, so it has no inverse there or more than one; look at its Jacobian determinant",
            inverse.folds
        ));
    } else if inverse.max_residual_mm > RESIDUAL_MM {
        console.warn("the field is too steep somewhere for an exact inverse; look at its Jacobian determinant");
    }
    if inverse.not_finite > 0 {
        console.warn(&format!(
            "{} voxels of the field hold no finite displacement; what would come from there has none in the inverse",
            inverse.not_finite
        ));
    }
    console.say(&format!(
        "Wrote {}: undoes the field to {:.4} mm; {} voxels come from outside its grid.",
        output.display(),
        inverse.max_residual_mm,
        inverse.outside
    ))
}
