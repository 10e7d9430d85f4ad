//! stdout and stderr.

use indicatif::{ProgressBar, ProgressStyle};
use palpate::error::plain;
use std::io::{self, ErrorKind, Write, stderr, stdout};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

/// What was typed, and how much to say. What is said cannot steer a terminal, whatever names and
/// files hold.
#[derive(Debug, Clone)]
pub struct Console {
    quiet: bool,
    verbose: bool,
    arguments: Arc<[String]>,
    warned: Arc<AtomicBool>,
    /// Why stdout takes no more.
    lost: Arc<OnceLock<io::Error>>,
}

impl Console {
    /// `arguments` are those of the program, the command first.
    pub fn new(quiet: bool, verbose: bool, arguments: &[String]) -> Self {
        Self { quiet, verbose, arguments: arguments.into(), warned: Arc::default(), lost: Arc::default() }
    }

    /// The same for a command that this one runs.
    pub fn for_command(&self, arguments: &[&str]) -> Self {
        Self { arguments: arguments.iter().map(|a| a.to_string()).collect(), ..self.clone() }
    }

    /// The arguments of the program, the command first.
    pub fn arguments(&self) -> &[String] {
        &self.arguments
    }

    /// Results, on stdout. What it does not take is told by [`Console::lost`] at the end: the work
    /// goes on.
    pub fn say(&self, text: &str) {
        let lines: Vec<String> = text.trim_end().split('\n').map(plain_cells).collect();
        let mut out = stdout().lock();
        if self.lost.get().is_none()
            && let Err(error) = writeln!(out, "{}", lines.join("\n")).and_then(|()| out.flush())
        {
            let _ = self.lost.set(error);
        }
    }

    /// Why stdout did not take all; none where it did, or whoever read it has left, as `head` does.
    pub fn lost(&self) -> Option<&io::Error> {
        self.lost.get().filter(|e| e.kind() != ErrorKind::BrokenPipe)
    }

    /// Something to know before trusting the result.
    pub fn warn(&self, text: &str) {
        if !self.quiet {
            let first = !self.warned.swap(true, Ordering::Relaxed);
            let hint = if first { " (--quiet silences warnings)" } else { "" };
            let _ = writeln!(stderr(), "warning: {}{hint}", plain(text));
        }
    }

    /// Something for who wants to know more.
    pub fn detail(&self, text: &str) {
        if self.verbose {
            let _ = writeln!(stderr(), "{}", plain(text));
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
        let _ = writeln!(stderr(), "error: {}", plain(&said));
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

/// [`plain`] text between tabs, which stay.
fn plain_cells(line: &str) -> String {
    line.split('\t').map(plain).collect::<Vec<_>>().join("\t")
}
