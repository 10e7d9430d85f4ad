//! stdout and stderr.

use indicatif::{ProgressBar, ProgressStyle};
use std::io::{ErrorKind, Write, stderr, stdout};
use std::sync::Arc;

/// What was typed, and how much to say.
#[derive(Debug, Clone)]
pub struct Console {
    quiet: bool,
    verbose: bool,
    arguments: Arc<[String]>,
}

impl Console {
    /// `arguments` are those of the program, the command first.
    pub fn new(quiet: bool, verbose: bool, arguments: &[String]) -> Self {
        Self { quiet, verbose, arguments: arguments.into() }
    }

    /// The same for a command that this one runs.
    pub fn for_command(&self, arguments: &[&str]) -> Self {
        Self { arguments: arguments.iter().map(|a| a.to_string()).collect(), ..self.clone() }
    }

    /// The arguments of the program, the command first.
    pub fn arguments(&self) -> &[String] {
        &self.arguments
    }

    /// Results, on stdout.
    pub fn say(&self, text: &str) -> anyhow::Result<()> {
        let mut out = stdout().lock();
        writeln!(out, "{}", text.trim_end())?;
        Ok(out.flush()?)
    }

    /// Something to know before trusting the result.
    pub fn warn(&self, text: &str) {
        if !self.quiet {
            let _ = writeln!(stderr(), "warning: {text}; --quiet silences");
        }
    }

    /// Something for who wants to know more.
    pub fn detail(&self, text: &str) {
        if self.verbose {
            let _ = writeln!(stderr(), "{text}");
        }
    }

    /// Why it ends here, each cause once.
    pub fn error(&self, error: &anyhow::Error) {
        let mut said = error.to_string();
        for cause in error.chain().skip(1).map(ToString::to_string) {
            if !said.contains(&cause) {
                said = format!("{said}: {cause}");
            }
        }
        let _ = writeln!(stderr(), "error: {said}");
    }

    /// A bar on stderr: hidden when that is no terminal, or with --quiet.
    pub fn progress(&self) -> Progress {
        let bar = if self.quiet { ProgressBar::hidden() } else { ProgressBar::new(1000) };
        if let Ok(style) = ProgressStyle::with_template("{msg:16} {bar:40} {percent:>3} %  {elapsed}") {
            bar.set_style(style);
        }
        Progress(bar)
    }
}

/// A running bar; it is wiped when dropped.
pub struct Progress(ProgressBar);

impl Progress {
    /// Shows the stage and the fraction of the whole (0 to 1).
    pub fn set(&self, stage: &str, fraction: f64) {
        if self.0.message() != stage {
            self.0.set_message(stage.to_string());
        }
        self.0.set_position((1000.0 * fraction.clamp(0.0, 1.0)) as u64);
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.0.finish_and_clear();
    }
}

/// Whether whoever read stdout has left, as `head` does.
pub fn is_closed_pipe(error: &anyhow::Error) -> bool {
    error.downcast_ref::<std::io::Error>().is_some_and(|e| e.kind() == ErrorKind::BrokenPipe)
}
