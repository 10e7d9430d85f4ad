//! Tables of strain.

use super::csv::{decimal, write_table};
use crate::error::IoError;
use crate::types::RegionStrain;
use std::path::Path;

/// Writes a row for each region and component: mean, standard deviation, 5th and 95th percentile
/// over its voxels, then the standard deviation of each of those by the field's error (1; empty
/// when not known), and voxels.
///
/// # Errors
/// [`IoError`] when the file cannot be written.
pub(crate) fn write_region_strains(path: impl AsRef<Path>, regions: &[RegionStrain]) -> Result<(), IoError> {
    const COLUMNS: [&str; 11] =
        ["label", "component", "mean", "sd", "p5", "p95", "mean_sd", "sd_sd", "p5_sd", "p95_sd", "voxels"];
    let number = |v: f64| if v.is_finite() { decimal(v) } else { String::new() };
    let row = |r: &RegionStrain| {
        let mut row = vec![r.label.to_string(), r.component.into()];
        row.extend(r.values.iter().chain(&r.errors).map(|v| number(*v)));
        row.push(r.voxels.to_string());
        row
    };
    write_table(path.as_ref(), &COLUMNS, regions.iter().map(row))
}
