//! `palpate invert`: the field from the deformed to the initial place.

use super::compose::FIELDS;
use super::console::Console;
use super::convention::Convention;
use super::inputs::{check_distinct, check_output_file};
use super::transform::percent;
use anyhow::{Result, bail};
use clap::Args;
use palpate::error::Shown;
use palpate::field::inverse::invert;
use palpate::io;
use palpate::numerics::inversion::residual;
use palpate::numerics::sampling::inside;
use palpate::types::DenseField;
use palpate::types::space::length;
use rayon::prelude::*;
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
    let original = convention.read(field)?;
    let inverse = invert(&original, None);
    let all = inverse.field.grid().len();
    if inverse.outside == all {
        bail!(
            "{}: the field leads away from its own grid, so its inverse there would be empty; compose it with what brings it \
             back, and name a grid: palpate compose {},-1 --reference IMAGE",
            field.shown(),
            field.shown()
        );
    }
    let undone = undone(&original, &inverse.field);
    if undone == 0 {
        bail!(
            "{}: the field has no inverse: nowhere is there one that undoes it to {RESIDUAL_MM} mm; look at its Jacobian determinant",
            field.shown()
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
    // What comes from outside the grid is undone by nothing that is known.
    let to = match undone + inverse.outside == all {
        true => format!("{:.4} mm", inverse.max_residual_mm),
        false => format!(
            "{RESIDUAL_MM} mm in {} of its voxels, to {:.4} mm at worst",
            percent(undone, all),
            inverse.max_residual_mm
        ),
    };
    let outside = match inverse.outside {
        0 => "none comes from outside its grid".into(),
        n => format!("{n} voxels ({}) come from outside its grid", percent(n, all)),
    };
    console.say(&format!("Wrote {}: undoes the field to {to}; {outside}.", output.shown()));
    Ok(())
}

/// Voxels whose place the field leads to from where the inverse says, to [`RESIDUAL_MM`].
fn undone(field: &DenseField, inverse: &DenseField) -> usize {
    let grid = *inverse.grid();
    let good = |at: &usize| {
        let [i, j, k] = grid.voxel(*at);
        let y = grid.world(i, j, k);
        let x = y.moved(inverse.at(*at).map(f64::from));
        inside(field.grid().shape(), field.grid().affine().to_voxel(x)) && length(residual(field, x, y)) <= RESIDUAL_MM
    };
    (0..grid.len()).into_par_iter().filter(good).count()
}
