//! `--field-convention`: fields of other programs.

use super::Usage;
use super::inputs::{Part, file_of};
use anyhow::{Result, bail};
use clap::Args;
use palpate::io::{self, FieldConvention};
use palpate::types::DenseField;
use std::path::{Path, PathBuf};

#[derive(Debug, Args)]
pub struct Convention {
    /// Whose numbers the field holds: lps (ITK, ANTs, greedy, Slicer, palpate), ras, fsl,
    /// fsl-absolute or niftyreg
    #[arg(long, value_name = "NAME", default_value = "lps")]
    field_convention: FieldConvention,
    /// The volume that an FSL field leads to, where its grid is not the field's
    #[arg(long, value_name = "IMAGE")]
    field_deformed: Option<PathBuf>,
}

impl Convention {
    /// The volume that `--field-deformed` names.
    pub fn deformed(&self) -> Option<&PathBuf> {
        self.field_deformed.as_ref()
    }

    /// The field in this convention: of a file, or of a results folder, which is palpate's own.
    ///
    /// # Errors
    /// When it cannot be read, or a folder comes with another convention than LPS.
    pub fn read(&self, path: &Path) -> Result<DenseField> {
        if path.is_dir() && self.field_convention != FieldConvention::Lps {
            bail!(Usage("--field-convention: a folder of palpate holds LPS; leave it out, or name a file".into()));
        }
        let deformed = self.field_deformed.as_ref().map(io::read_header).transpose()?;
        let grid = deformed.as_ref().map(|(stored, _)| &stored.grid);
        Ok(io::read_field_as(file_of(path, Part::Field)?, self.field_convention, grid)?)
    }
}
