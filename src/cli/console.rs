//! stdout and stderr.

use indicatif::{ProgressBar, ProgressStyle};
use palpate::error::plain;
use std::io::{self, ErrorKind, IsTerminal, Write, stderr, stdout};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Instant;

/// What was typed, and how much to print. Output cannot steer a terminal, whatever names and
/// files hold.
#[derive(Debug, Clone)]
pub struct Console {
    quiet: bool,
    verbose: bool,
    /// Progress as XML on stdout.
    xml: bool,
    arguments: Arc<[String]>,
    warned: Arc<AtomicBool>,
    /// Why stdout takes no more.
    lost: Arc<OnceLock<io::Error>>,
}

impl Console {
    /// `arguments` are those of the program, the command first.
    pub fn new(quiet: bool, verbose: bool, arguments: &[String]) -> Self {
        Self { quiet, verbose, xml: false, arguments: arguments.into(), warned: Arc::default(), lost: Arc::default() }
    }

    /// The same with progress as XML on stdout, as 3D Slicer reads it.
    pub fn with_xml(self, xml: bool) -> Self {
        Self { xml, ..self }
    }

    /// The same for a command that this one runs.
    pub fn for_command(&self, arguments: &[&str]) -> Self {
        Self { arguments: arguments.iter().map(|a| a.to_string()).collect(), ..self.clone() }
    }

    /// The arguments of the program, the command first.
    pub fn arguments(&self) -> &[String] {
        &self.arguments
    }

    /// Results, on stdout. What it does not take is reported by [`Console::lost`] at the end: the
    /// work goes on.
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

    /// Shows what the library logs, with --verbose. A process that has a logger keeps it.
    pub fn listen(&self) {
        if self.verbose && log::set_logger(&Details).is_ok() {
            log::set_max_level(log::LevelFilter::Debug);
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

    /// How far a command is: a bar where stderr is a terminal, a line a stage where it is not, none
    /// with --quiet.
    pub fn progress(&self) -> Progress {
        let shown = match () {
            _ if self.xml => Shown::Xml,
            _ if self.quiet => Shown::Nothing,
            _ if stderr().is_terminal() && !self.verbose => Shown::Bar(bar()),
            _ => Shown::Lines(Instant::now()),
        };
        Progress { shown, last: Mutex::default() }
    }
}

/// The reasons and stages that the library logs, on stderr.
struct Details;

impl log::Log for Details {
    fn enabled(&self, metadata: &log::Metadata<'_>) -> bool {
        metadata.target().starts_with("palpate")
    }

    fn log(&self, record: &log::Record<'_>) {
        if self.enabled(record.metadata()) {
            let _ = writeln!(stderr(), "{}", plain(&record.args().to_string()));
        }
    }

    fn flush(&self) {}
}

fn bar() -> ProgressBar {
    let bar = ProgressBar::new(1000);
    if let Ok(style) = ProgressStyle::with_template("{msg:16} {bar:40} {percent:>3} %  {elapsed}") {
        bar.set_style(style);
    }
    bar
}

/// Running progress; a bar is wiped when it is dropped.
pub struct Progress {
    shown: Shown,
    /// The stage and the percent that were shown last.
    last: Mutex<(String, u64)>,
}

enum Shown {
    Nothing,
    Bar(ProgressBar),
    /// Since when.
    Lines(Instant),
    Xml,
}

impl Progress {
    /// Shows the stage and the fraction of the whole (0 to 1).
    pub fn set(&self, stage: &str, fraction: f64) {
        let percent = (100.0 * fraction.clamp(0.0, 1.0)) as u64;
        let mut last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
        let is_new = last.0 != stage;
        match &self.shown {
            Shown::Nothing => {}
            Shown::Bar(bar) => {
                if is_new {
                    bar.set_message(stage.to_string());
                }
                bar.set_position((1000.0 * fraction.clamp(0.0, 1.0)) as u64);
            }
            // What is done within a second needs no word.
            Shown::Lines(since) if is_new && since.elapsed().as_secs_f64() > 1.0 => {
                let _ = writeln!(stderr(), "{percent:>3} %  {stage}");
            }
            Shown::Lines(_) => {}
            Shown::Xml => {
                let mut out = stdout().lock();
                if is_new {
                    let _ = writeln!(out, "<filter-comment>{stage}</filter-comment>");
                }
                if is_new || percent != last.1 {
                    let _ = writeln!(out, "<filter-progress>{:.2}</filter-progress>", percent as f64 / 100.0);
                    let _ = out.flush();
                }
            }
        }
        if is_new {
            last.0 = stage.to_string();
        }
        last.1 = percent;
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        if let Shown::Bar(bar) = &self.shown {
            bar.finish_and_clear();
        }
    }
}

/// [`plain`] text between tabs, which stay.
fn plain_cells(line: &str) -> String {
    line.split('\t').map(plain).collect::<Vec<_>>().join("\t")
}
