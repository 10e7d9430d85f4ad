//! Raw arguments to a checked plan to the pipeline; one file a subcommand.
//!
//! Results go to files, a short summary to stdout, progress and warnings to stderr. Exit codes: 0
//! done, 1 failed on this input, 2 wrong usage. A closed pipe ends the program quietly.

mod batch;

mod certify;

mod chart;

mod completions;

mod compose;

mod console;

mod convention;

mod convert;

mod demo;

mod dry_run;

mod evaluate;

mod examples;

mod field;

mod fingertip;

mod grasp;

mod grasp_analysis;

mod info;

mod inputs;

mod invert;

mod kinds;

mod known;

mod limits;

mod markups;

mod outputs;

mod own;

mod peers;

mod plan;

mod phantom;

mod record;

mod repeat;

mod sequence;

mod series;

mod skin;

mod slicer;

mod track;

mod transform;

mod mesh_option;

mod stiffness;

mod stiffness_sequence;

mod strain;

mod stress;

mod warp;

use clap::error::ErrorKind;
use clap::{Args, CommandFactory, FromArgMatches, Parser, Subcommand};
use console::Console;
use palpate::error::plain;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Measures how soft tissue deforms inside, from a pair of MR volumes.
#[derive(Debug, Parser)]
#[command(
    name = "palpate",
    version,
    max_term_width = 100,
    after_help = "Try `palpate demo` first. Positions are world mm (RAS); a displacement points from the initial to the \
                  deformed place of the same tissue."
)]
struct Cli {
    #[command(flatten)]
    common: Common,
    #[command(subcommand)]
    command: Command,
}

/// Flags of every subcommand.
#[derive(Debug, Args)]
struct Common {
    /// Threads to use [default: all cores]
    #[arg(long, global = true, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,
    /// Stop after this many seconds, with nothing half-written left [default: no limit]
    #[arg(long, global = true, value_name = "SECONDS", value_parser = seconds)]
    timeout: Option<Duration>,
    /// Which series of a DICOM folder is meant, by its UID; of several, each folder takes one that
    /// it holds, in order
    #[arg(long, global = true, value_name = "UID", value_delimiter = ',')]
    series: Vec<String>,
    /// No progress and no warnings on stderr
    #[arg(long, global = true)]
    quiet: bool,
    /// More on stderr: stages, levels, reasons
    #[arg(short, long, global = true, conflicts_with = "quiet")]
    verbose: bool,
}

impl Common {
    /// The same as command-line arguments.
    fn arguments(&self) -> Vec<String> {
        let flags = [("--quiet", self.quiet), ("--verbose", self.verbose)];
        let mut out: Vec<String> = flags.iter().filter(|f| f.1).map(|f| f.0.into()).collect();
        out.extend(self.threads.map(|n| format!("--threads={n}")));
        out.extend(self.timeout.map(|t| format!("--timeout={}", t.as_secs_f64())));
        out
    }
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Measure the displacement from an initial to a deformed volume
    Field(field::Options),
    /// Carry an image, a label map or points along displacement fields and affine transforms
    Warp(warp::Options),
    /// Turn a displacement field around: deformed to initial
    Invert(invert::Options),
    /// Join transforms into one field, or one affine transform
    Compose(compose::Options),
    /// Write a transform for another program
    Convert(convert::Options),
    /// Follow the tissue of one volume through a sequence of others
    Track(track::Options),
    /// Strain from a displacement field, with its standard deviation
    Strain(strain::Options),
    /// What a scan can measure: known motions are imposed on it and measured
    Certify(certify::Options),
    /// Young's modulus from a displacement field, region by region or without regions
    Stiffness(stiffness::Options),
    /// Which press, voxel size and noise would give a wanted deviation of each modulus, from labels
    Plan(plan::Options),
    /// Reduce a stiffness map of a finger pad to a fingertip for grasps
    Fingertip(fingertip::Options),
    /// Take a table of pairs through field, stiffness, fingertip and grasp, in parallel and
    /// resumable
    Batch(batch::Options),
    /// Simulate a soft-finger grasp from a scene file
    Grasp(grasp::Options),
    /// Analyse a grasp: posture force, energy surfaces, stability, degrees of freedom, push, pinch
    /// map
    GraspAnalysis(grasp_analysis::Options),
    /// Press, hold and let go layers of skin from a scene file
    Skin(skin::Options),
    /// Make a synthetic pair of volumes with exactly known displacement
    Phantom(phantom::Options),
    /// Score a displacement field against exact truth
    Evaluate(evaluate::Options),
    /// Chart speed against accuracy on cases with a known answer
    Chart(chart::Options),
    /// Push each part until it breaks, and see whether it says so
    Stress(stress::Options),
    /// Take a synthetic finger pad through every command, from images to a grasp, and score each
    /// step
    Demo(demo::Options),
    /// Turn matches, landmarks or points into a point list of 3D Slicer
    Markups(markups::Options),
    /// Say what a file is: grid, orientation, values, and what palpate would do with it
    Info(info::Options),
    /// Print completions for a shell
    Completions(completions::Options),
    /// Print the manual, or write it as man pages
    Man(completions::ManOptions),
}

/// A time of more than 0 and at most 10 million seconds.
fn seconds(text: &str) -> Result<Duration, String> {
    let found = text.parse::<f64>().ok().filter(|s| *s > 0.0 && *s <= 1e7);
    found.map(Duration::from_secs_f64).ok_or_else(|| format!("{text} is not a number of seconds over 0"))
}

/// The arguments do not make sense together.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
struct Usage(String);

/// What is wrong with a command line that names a summary in place of inputs.
const MISSING: [ErrorKind; 2] = [ErrorKind::MissingRequiredArgument, ErrorKind::UnknownArgument];

/// The command line with an example after each help.
fn whole() -> clap::Command {
    examples::with_examples(Cli::command())
}

/// The whole program; returns its exit code. `typed` are the words of the command line, the
/// program's name first; `own` are those that start this program again.
pub fn run(mut typed: Vec<OsString>, own: Vec<OsString>) -> u8 {
    own::remember(own);
    named_for_command(&mut typed);
    if let Some(description) = slicer::description(&typed, whole) {
        Console::new(false, false, &[]).say(&description);
        return 0;
    }
    let prepared = slicer::Asked::taken(&mut typed).and_then(|asked| Ok((asked, series::chosen(typed)?)));
    let (asked, typed) = match prepared {
        Ok(prepared) => prepared,
        Err(error) => return failed(&Console::new(false, false, &[]), &error),
    };
    let words: Vec<String> = typed.iter().skip(1).map(|word| word.to_string_lossy().into_owned()).collect();
    let (matches, words, warning) = match whole().try_get_matches_from(&typed) {
        Ok(matches) => (matches, words, None),
        Err(error) if MISSING.contains(&error.kind()) => match repeat::repeated(&typed) {
            Ok(Some(again)) => (again.matches, again.arguments, again.warning),
            Ok(None) => complain(&error, &words),
            Err(error) => return failed(&Console::new(false, false, &words), &error),
        },
        Err(error) => complain(&error, &words),
    };
    let Cli { common, command } = Cli::from_arg_matches(&matches).unwrap_or_else(|e| e.format(&mut whole()).exit());
    let console = Console::new(common.quiet, common.verbose, &words).with_xml(asked.progress);
    warning.iter().for_each(|text| console.warn(text));
    console.listen();
    limits::watch(console.clone(), common.timeout);
    // Everything runs inside the pool: work that starts on a thread of its own would wake the pool
    // for each small step.
    let pool = rayon::ThreadPoolBuilder::new().num_threads(common.threads.unwrap_or(0).into()).build();
    let results = matches.subcommand().and_then(|(_, m)| m.try_get_one::<PathBuf>("output").ok().flatten());
    let work = || dispatch(&command, &console).and_then(|()| asked.hand_over(results.map(PathBuf::as_path)));
    let done = match pool {
        Ok(pool) => pool.install(work),
        Err(error) => Err(anyhow::anyhow!("no thread could be started: {error}; try fewer with --threads")),
    };
    match done {
        Ok(()) => match console.lost() {
            None => 0,
            Some(lost) => {
                let said = "all is done and every file is written, but stdout did not take the whole summary";
                failed(&console, &anyhow::anyhow!("{said}: {lost}"))
            }
        },
        Err(error) => failed(&console, &error),
    }
}

/// Puts the command first where the program is called by a link named for it, as palpate-field: 3D
/// Slicer knows one module a program.
fn named_for_command(typed: &mut Vec<OsString>) {
    let name = typed.first().and_then(|word| Path::new(word).file_stem()).map(|n| n.to_string_lossy().into_owned());
    if let Some(command) = name.as_deref().and_then(|n| n.strip_prefix("palpate-"))
        && whole().find_subcommand(command).is_some()
    {
        typed.insert(1, command.into());
    }
}

/// Says what is wrong with the command line, or the help: of words that would steer a terminal,
/// what would be wrong with them escaped.
fn complain(error: &clap::Error, words: &[String]) -> ! {
    let safe: Vec<String> = words.iter().map(|word| plain(word)).collect();
    if safe == words {
        error.exit();
    }
    match whole().try_get_matches_from(std::iter::once("palpate".to_string()).chain(safe)) {
        Err(again) => again.exit(),
        Ok(_) => {
            Console::new(false, false, &[]).error(&anyhow::anyhow!("{error}"));
            std::process::exit(error.exit_code());
        }
    }
}

/// Says why, and with which code the program ends.
fn failed(console: &Console, error: &anyhow::Error) -> u8 {
    console.error(error);
    let usage = error.is::<Usage>() || error.is::<palpate::error::ParamError>();
    if usage { 2 } else { 1 }
}

/// Runs one command.
fn dispatch(command: &Command, console: &Console) -> anyhow::Result<()> {
    match command {
        Command::Field(options) => field::run(options, console),
        Command::Warp(options) => warp::run(options, console),
        Command::Invert(options) => invert::run(options, console),
        Command::Compose(options) => compose::run(options, console),
        Command::Convert(options) => convert::run(options, console),
        Command::Track(options) => track::run(options, console),
        Command::Strain(options) => strain::run(options, console),
        Command::Certify(options) => certify::run(options, console),
        Command::Stiffness(options) => stiffness::run(options, console),
        Command::Plan(options) => plan::run(options, console),
        Command::Fingertip(options) => fingertip::run(options, console),
        Command::Batch(options) => batch::run(options, console),
        Command::Grasp(options) => grasp::run(options, console),
        Command::GraspAnalysis(options) => grasp_analysis::run(options, console),
        Command::Skin(options) => skin::run(options, console),
        Command::Phantom(options) => phantom::run(options, console),
        Command::Evaluate(options) => evaluate::run(options, console),
        Command::Chart(options) => chart::run(options, console),
        Command::Stress(options) => stress::run(options, console),
        Command::Demo(options) => demo::run(options, console),
        Command::Markups(options) => markups::run(options, console),
        Command::Info(options) => info::run(options, console),
        Command::Completions(options) => completions::run(options, whole(), console),
        Command::Man(options) => completions::run_man(options, whole(), console),
    }
}
