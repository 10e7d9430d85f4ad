//! `palpate certify`: what a scan can measure.

use super::console::Console;
use super::convention::Convention;
use super::field::Tuning;
use super::inputs::{Part, check_distinct, file_of, name, read_mask, read_volume, same_grid, standing_for, warn_all};
use super::limits::{cap_search, field_fits};
use super::outputs::Target;
use super::record::{self, Recording};
use anyhow::{Context, Result};
use clap::Args;
use palpate::io;
use palpate::pipeline::certify::{self, CertifyInput};
use palpate::report::certify::{CertifyReport, page, summary, text};
use palpate::report::record::{in_summary, on_page};
use std::path::{Path, PathBuf};

/// What is written.
const FILES: [&str; 3] = ["certificate.json", "detectable.nii.gz", "report.html"];

#[derive(Debug, Args)]
pub struct Options {
    /// The scan (.nii, .nii.gz, .nrrd, .nhdr, .mha, .mhd, or a folder with a DICOM series or of
    /// palpate phantom)
    #[arg(value_parser = standing_for(Part::Initial))]
    initial: PathBuf,
    /// A second scan at rest on the same grid: its noise is real [default: noise is estimated]
    second: Option<PathBuf>,
    #[command(flatten)]
    target: Target,
    /// Where there is tissue: a mask on the scan's grid, 0 outside
    #[arg(long, value_name = "M", value_parser = standing_for(Part::Mask))]
    mask: Option<PathBuf>,
    /// A measured field, or a folder of `palpate field`: its motion is imposed too
    #[arg(long, value_name = "FIELD")]
    like: Option<PathBuf>,
    #[command(flatten)]
    convention: Convention,
    #[command(flatten)]
    tuning: Tuning,
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { initial, second, target, mask, like, convention, tuning } = options;
    let mut params = tuning.params()?;
    let given: Vec<&Path> = [initial].into_iter().chain(second).chain(mask).chain(like).map(PathBuf::as_path).collect();
    check_distinct(&given, &target.files(&FILES))?;
    target.check()?;
    field_fits(initial, second.as_ref().unwrap_or(initial))?;
    let mut inputs =
        record::inputs(&[("initial", Some(initial)), ("second", second.as_ref()), ("mask", mask.as_ref())]);
    inputs.extend(like.as_ref().map(|p| Ok::<_, anyhow::Error>(("like", file_of(p, Part::Field)?))).transpose()?);
    inputs.extend(record::inputs(&[("field_deformed", convention.deformed()), ("config", tuning.config())]));
    let progress = console.progress();
    progress.set("read", 0.0);
    let mut warnings = tuning.mask_left_out(mask.is_some());
    let volume = read_volume(initial, &mut warnings)?;
    let grid = *volume.grid();
    warnings.extend(cap_search(&mut params, &grid, initial));
    let again = second.as_ref().map(|p| read_volume(p, &mut warnings)).transpose()?;
    if let (Some(path), Some(again)) = (second, &again) {
        same_grid(path, again.grid(), &grid, initial)?;
    }
    let inside = mask.as_ref().map(|m| read_mask(m, &grid, initial, &mut warnings)).transpose()?;
    let like = like
        .as_ref()
        .map(|path| {
            let field = convention.read(path)?;
            same_grid(path, field.grid(), &grid, initial)?;
            Ok::<_, anyhow::Error>(field)
        })
        .transpose()?;
    let mut folder = target.create()?;
    let record = Recording::start(console, inputs);
    let input = CertifyInput { initial: &volume, second: again.as_ref(), mask: inside.as_ref(), like: like.as_ref() };
    let set = |stage: &str, part| progress.set(stage, part);
    let mut found = certify::run(input, &params, &set).with_context(|| name(initial))?;
    found.certificate.warnings.splice(0..0, warnings);

    progress.set("write", 1.0);
    let names = [name(initial), second.as_deref().map(name).unwrap_or_default()];
    let report = CertifyReport {
        names: [&names[0], &names[1]],
        initial: &volume,
        tissue: &found.tissue,
        params: &params,
        detectable: &|at| found.detectable.as_slice()[at],
        certificate: &found.certificate,
    };
    let record = record.finish();
    folder.write("certificate.json", |p| io::write_json(p, &in_summary(summary(&report), &record)))?;
    let said = "palpate: smallest displacement above noise, mm";
    folder.write("detectable.nii.gz", |p| io::write_volume(p, &found.detectable, said))?;
    let html = page(&report)?;
    folder.write("report.html", |p| io::write_text(p, &on_page(html, &record)))?;
    folder.commit()?;
    drop(progress);
    warn_all(console, &found.certificate.warnings);
    console.say(&format!("{}{}", text(&report), target.look()));
    Ok(())
}
