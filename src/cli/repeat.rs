//! `palpate COMMAND --config SUMMARY -o DIR` without inputs: the run that the summary tells of,
//! again.

use super::{Common, Usage, whole};
use anyhow::{Context, Result, bail};
use clap::Parser;
use palpate::error::Shown;
use palpate::io;
use palpate::types::record::{InputFile, RunRecord};
use serde_json::Value;
use std::ffi::OsString;
use std::path::{Path, PathBuf, absolute};

/// What may stand beside the summary.
#[derive(Debug, Parser)]
#[command(disable_help_flag = true, disable_version_flag = true)]
struct Again {
    command: String,
    #[arg(long)]
    config: PathBuf,
    #[arg(short, long)]
    output: PathBuf,
    #[arg(long, alias = "force")]
    overwrite: bool,
    #[arg(long)]
    dry_run: bool,
    #[command(flatten)]
    common: Common,
}

/// Flags that are not those of the run: the message.
const SAID: [&str; 4] = ["--quiet", "--verbose", "-v", "--dry-run"];

/// The flag with which a command writes into a folder that is not empty.
const OVERWRITE: &str = "--overwrite";

/// A run to be made again.
pub struct Repeated {
    /// All arguments, the command first.
    pub arguments: Vec<String>,
    pub matches: clap::ArgMatches,
    pub warning: Option<String>,
}

/// The run that `arguments` (with the program's name) ask to repeat; none where they ask for
/// something else. From here on relative paths count from where that run was started.
///
/// # Errors
/// When the summary does not tell how to repeat it, or an input is gone or has changed.
pub fn repeated(arguments: &[OsString]) -> Result<Option<Repeated>> {
    let Ok(again) = Again::try_parse_from(arguments) else { return Ok(None) };
    let (config, shown) = (&again.config, again.config.shown());
    let summary = match io::read_json(config) {
        Ok(summary) if summary["command"].is_string() => summary,
        Err(error) if config.extension().is_some_and(|e| e == "json") => return Err(error.into()),
        _ => return Ok(None),
    };
    if summary["command"] != again.command.as_str() {
        let command = summary["command"].as_str().unwrap_or_default();
        bail!(Usage(format!(
            "{shown}: is the summary of palpate {command}; repeat it with palpate {command} --config"
        )));
    }
    let record: RunRecord = serde_json::from_value(summary.clone())
        .with_context(|| format!("{shown}: does not tell the command line of its run; name the inputs too"))?;
    check(&record.files).with_context(|| format!("{shown}: its run cannot be repeated"))?;

    let output = absolute(&again.output).unwrap_or(again.output);
    let mut arguments = record.command_line.clone();
    // Its old name is that of a force where there is one.
    let overwrites = |a: &str| a == OVERWRITE || a == "--force" && again.command != "stiffness";
    arguments.retain(|a| !overwrites(a) && !SAID.contains(&a.as_str()));
    arguments.push(format!("--output={}", output.to_string_lossy()));
    if again.overwrite {
        arguments.push(OVERWRITE.into());
    }
    if again.dry_run {
        arguments.push("--dry-run".into());
    }
    arguments.extend(again.common.arguments());
    let folder = Path::new(&record.working_folder);
    std::env::set_current_dir(folder).with_context(|| {
        format!("{shown}: paths of its run count from {}, which cannot be entered; name the inputs", folder.shown())
    })?;
    // What comes later goes before.
    let parser = whole().mut_subcommand(&again.command, |c| c.args_override_self(true));
    let words = std::iter::once("palpate").chain(arguments.iter().map(String::as_str));
    let matches = parser.try_get_matches_from(words).map_err(|error| {
        let told = error.to_string();
        let first = told.lines().next().unwrap_or_default().trim_start_matches("error: ").to_string();
        anyhow::anyhow!("{shown}: this version does not take the arguments of its run ({first}); name the inputs too")
    })?;
    Ok(Some(Repeated { arguments, matches, warning: other_version(&shown, &summary) }))
}

/// Says so where another version has made the run.
fn other_version(shown: &str, summary: &Value) -> Option<String> {
    let (then, now) = (summary["version"].as_str().unwrap_or("unknown"), env!("CARGO_PKG_VERSION"));
    (then != now).then(|| format!("{shown}: its run was made by palpate {then}, this is {now}; results may differ"))
}

/// Whether every input is still what it was.
fn check(files: &[InputFile]) -> Result<()> {
    let mut flaws = Vec::new();
    for InputFile { role, path, sha256, .. } in files {
        match io::digest(path) {
            Ok((_, found)) if found == *sha256 => {}
            Ok(_) => flaws.push(format!("{path} ({role}) has changed since")),
            Err(_) => flaws.push(format!("{path} ({role}) is missing or cannot be read")),
        }
    }
    if !flaws.is_empty() {
        bail!("{}; put back what it was, or name the inputs too", flaws.join("; "));
    }
    Ok(())
}
