//! `palpate completions` and `palpate man`: what a shell and `man` want to know.

use super::console::Console;
use anyhow::Result;
use clap::{Args, Command};
use clap_complete::Shell;
use clap_mangen::Man;
use palpate::error::Shown;
use palpate::io::{self, OutputFolder};
use std::path::PathBuf;

#[derive(Debug, Args)]
pub struct Options {
    /// Shell to complete for
    shell: Shell,
}

/// Writes the completion script to stdout.
pub fn run(options: &Options, mut command: Command, console: &Console) -> Result<()> {
    let mut script = Vec::new();
    clap_complete::generate(options.shell, &mut command, "palpate", &mut script);
    console.say(&String::from_utf8_lossy(&script));
    Ok(())
}

#[derive(Debug, Args)]
pub struct ManOptions {
    /// Folder for a page a command (palpate.1, palpate-field.1 ...); without it the main page goes
    /// to stdout
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
}

/// Writes the manual.
pub fn run_man(options: &ManOptions, mut command: Command, console: &Console) -> Result<()> {
    command.build();
    let page = |command: &Command, name: &str| -> Result<Vec<u8>> {
        let mut bytes = Vec::new();
        Man::new(command.clone()).title(name.to_uppercase()).render(&mut bytes)?;
        Ok(bytes)
    };
    let Some(output) = &options.output else {
        console.say(&String::from_utf8_lossy(&page(&command, "palpate")?));
        return Ok(());
    };
    let mut folder = OutputFolder::create(output, true)?;
    let mut put = |name: &str, command: &Command| -> Result<()> {
        let bytes = page(command, name)?;
        Ok(folder.write(&format!("{name}.1"), |p| io::write_bytes(p, &bytes))?)
    };
    put("palpate", &command)?;
    let mut pages = 1;
    for sub in command.get_subcommands().filter(|s| s.get_name() != "help") {
        let name = format!("palpate-{}", sub.get_name());
        put(&name, sub)?;
        pages += 1;
    }
    folder.commit()?;
    console.say(&format!("Wrote {pages} pages into {}.", output.shown()));
    Ok(())
}
