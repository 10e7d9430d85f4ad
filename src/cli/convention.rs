//! `--field-convention`: fields of other programs.

use anyhow::Result;
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
    /// Whether fields are taken as palpate writes them.
    pub fn is_ours(&self) -> bool {
        self.field_convention == FieldConvention::Lps
    }

    /// The field in this convention.
    pub fn read(&self, path: &Path) -> Result<DenseField> {
        let deformed = self.field_deformed.as_ref().map(io::read_header).transpose()?;
        let grid = deformed.as_ref().map(|(stored, _)| &stored.grid);
        Ok(io::read_field_as(path, self.field_convention, grid)?)
    }
}
