//! What ends a run before its time: too little memory, Ctrl-C, a time limit, the end of the batch
//! that it is a part of.

use super::console::Console;
use super::inputs::name;
use anyhow::{Result, bail};
use palpate::error::Shown;
use palpate::io;
use palpate::pipeline::dry_run::{memory, phantom_memory, stiffness_memory, strain_memory};
use palpate::pipeline::robustness::Effort;
use palpate::report::scale::short;
use palpate::types::{FieldParams, Grid};
use std::path::Path;
use std::process::exit;
use std::time::Duration;

/// Bytes in words.
pub fn bytes(n: u64) -> String {
    match n as f64 / 1e6 {
        mb if mb < 1000.0 => format!("{mb:.0} MB"),
        mb => format!("{:.1} GB", mb / 1000.0),
    }
}

/// Refuses, before their voxels are read, two volumes of which one is likely in another unit, or
/// that need more memory for a field run than is left.
pub fn field_fits(initial: &Path, deformed: &Path) -> Result<()> {
    // A header that cannot be read is reported by who reads the whole.
    let (Ok((a, _)), Ok((b, _))) = (io::read_header(initial), io::read_header(deformed)) else { return Ok(()) };
    same_unit(initial, &a.grid, deformed, &b.grid)?;
    grids_fit(initial, &a.grid, deformed, &b.grid)
}

/// The longest side of a grid (mm).
fn longest(grid: &Grid) -> f64 {
    let size = grid.spacing();
    (0..3).map(|a| size[a] * grid.shape()[a] as f64).fold(0.0, f64::max)
}

/// How far the logarithm (to base 10) of a ratio of sides may be under one, that of a factor of
/// ten.
const TENFOLD_TOLERANCE_LOG10: f64 = 0.1;
/// Ratio of the numbers of voxels along a side up to which two volumes may show the same part.
const MAX_SIDE_RATIO: f64 = 2.5;

/// Refuses two volumes of about as many voxels whose longest sides differ by a factor of about 10
/// or more: their units differ, or one has lost its header.
pub fn same_unit(initial: &Path, a: &Grid, deformed: &Path, b: &Grid) -> Result<()> {
    let (small, large) =
        if longest(a) < longest(b) { ((initial, a), (deformed, b)) } else { ((deformed, b), (initial, a)) };
    let log = (longest(large.1) / longest(small.1)).log10();
    let voxels = |g: &Grid| g.shape().into_iter().max().unwrap_or(1) as f64;
    let alike = (voxels(a) / voxels(b)).max(voxels(b) / voxels(a)) <= MAX_SIDE_RATIO;
    let unit = match log.round() {
        1.0 => "centimetres",
        3.0 => "metres or micrometres",
        _ => "another unit than mm",
    };
    if !alike || log < 1.0 - TENFOLD_TOLERANCE_LOG10 {
        return Ok(());
    }
    let lost = |g: &Grid| g.spacing().iter().all(|s| (s - 1.0).abs() < 1e-6);
    let cause = match [small, large].into_iter().find(|v| lost(v.1)) {
        Some((path, _)) => format!("{} has voxels of 1 mm on every side, as where a header was lost", path.shown()),
        None => format!("one of them is likely in {unit}"),
    };
    bail!(
        "{}: its longest side is {} mm, and that of {} is {} mm, about {} times as long; {cause}; correct the voxel size \
         in its header, or crop the larger volume",
        small.0.shown(),
        short(longest(small.1)),
        large.0.shown(),
        short(longest(large.1)),
        if (log - log.round()).abs() > TENFOLD_TOLERANCE_LOG10 {
            10f64.powf(log).round()
        } else {
            10f64.powf(log.round())
        }
    );
}

/// Caps the search at the longest side of the volume at `path`, on `grid`: tissue that moves
/// farther is nowhere in it. Says so where that is less than was asked for.
pub fn cap_search(params: &mut FieldParams, grid: &Grid, path: &Path) -> Option<String> {
    let (asked, most) = (params.search_mm, longest(grid));
    (asked > most).then(|| {
        params.search_mm = most;
        format!(
            "--search {} mm is more than the longest side of {}; {} mm is taken",
            short(asked),
            name(path),
            short(most)
        )
    })
}

/// What is left, where that is less than `needed` (bytes).
fn left_under(needed: u64) -> Option<u64> {
    io::memory_left().filter(|left| needed > *left)
}

/// Refuses `what` where it needs more memory than is left (bytes); `remedy` says what needs less.
fn fits(what: &str, needed: u64, remedy: &str) -> Result<()> {
    let Some(left) = left_under(needed) else { return Ok(()) };
    let [needed, left] = [needed, left].map(bytes);
    bail!("{what} needs about {needed} of memory, but only {left} are left; close other programs, {remedy}")
}

/// The same of two volumes whose grids are known.
pub fn grids_fit(initial: &Path, a: &Grid, deformed: &Path, b: &Grid) -> Result<()> {
    let half = |g: &Grid| Grid::new(g.shape().map(|n| n.div_ceil(2)), *g.affine());
    let halved = half(a).and_then(|a| Ok(memory(&a, &half(b)?))).map(bytes).unwrap_or_default();
    fits(
        &format!("{} and {}: a field", initial.shown(), deformed.shown()),
        memory(a, b),
        &format!(
            "crop both to the tissue, or halve their resolution, which needs {halved} (the presets need the same)"
        ),
    )
}

/// Refuses a field whose strain needs more memory than is left.
pub fn strain_fits(field: &Path) -> Result<()> {
    let Ok((stored, _)) = io::read_header(field) else { return Ok(()) };
    let strain = format!("{}: its strain", field.shown());
    fits(&strain, strain_memory(&stored.grid), "or crop the field to the tissue")
}

/// Refuses a mesh that needs more memory than is left.
pub fn mesh_fits(nodes: usize) -> Result<()> {
    let needed = stiffness_memory(nodes);
    let Some(left) = left_under(needed) else { return Ok(()) };
    let most = (1..).map(|n| 500 * n).take_while(|&n| stiffness_memory(n) <= left).last();
    let instead = most.map_or("or take fewer --nodes".into(), |n| format!("or take --nodes {n}, which fits"));
    fits(&format!("a mesh of {nodes} nodes"), needed, &instead)
}

/// Refuses a phantom that needs more memory than is left.
pub fn phantom_fits(grid: &Grid, elastic: bool) -> Result<()> {
    let [x, y, z] = grid.shape();
    fits(&format!("a phantom of {x} x {y} x {z} voxels"), phantom_memory(grid, elastic), "or lower --size")
}

/// Refuses stress runs that need more memory than is left: one field for each thread, or one
/// stiffness after the other.
pub fn stress_fits(effort: &Effort, field: bool, stiffness: bool) -> Result<()> {
    let mut needed = 0;
    if field {
        for body in &effort.bodies {
            let grid = body.grid()?;
            needed = needed.max(phantom_memory(&grid, false) + memory(&grid, &grid));
        }
        needed *= rayon::current_num_threads() as u64;
    }
    if stiffness {
        needed = needed.max(effort.stiffness_memory()?);
    }
    fits("this stress test", needed, "or take one --part, --quick or fewer --threads")
}

/// Ends the program at once, with nothing half-written left behind.
fn stop(console: &Console, why: &str, code: i32) -> ! {
    io::abandon();
    console.error(&anyhow::anyhow!("{why}; nothing half-written is left"));
    exit(code)
}

/// In the environment of a process that is to end when its standard input does: whoever started it
/// holds the other end, however that one ends.
pub const ATTENDED: &str = "PALPATE_ATTENDED";

/// Watches for Ctrl-C and the like (exit code 128 + the signal's number, as shells have it), for
/// the end of `limit` and for that of whoever attends to this process (exit code 1).
pub fn watch(console: Console, limit: Option<Duration>) {
    let run_out = console.clone();
    let attended = console.clone();
    #[cfg(unix)]
    catch_signals(console);
    if std::env::var_os(ATTENDED).is_some() {
        let _ = std::thread::Builder::new().name("attended".into()).spawn(move || {
            let _ = std::io::copy(&mut std::io::stdin(), &mut std::io::sink());
            stop(&attended, "the run that this is a part of has ended", 1);
        });
    }
    if let Some(limit) = limit {
        let _ = std::thread::Builder::new().name("timeout".into()).spawn(move || {
            std::thread::sleep(limit);
            let seconds = limit.as_secs_f64();
            stop(&run_out, &format!("not done after {seconds} s, which --timeout allows"), 1);
        });
    }
}

/// Ends the program in its own way on the signals that end one; they are caught when this returns,
/// so before anything is made. Without a thread for it they end the program in the system's way. A
/// file past the limit of its size (`ulimit -f`) is an error of who writes it, not the end.
#[cfg(unix)]
fn catch_signals(console: Console) {
    use signal_hook::consts::{SIGHUP, SIGINT, SIGQUIT, SIGTERM, SIGXCPU, SIGXFSZ};
    let _ = signal_hook::flag::register(SIGXFSZ, std::sync::Arc::default());
    let mut wanted = vec![SIGINT, SIGTERM, SIGQUIT, SIGXCPU];
    // Started by nohup it stays ignored.
    if !is_ignored(SIGHUP) {
        wanted.push(SIGHUP);
    }
    let (waiting, caught) = std::sync::mpsc::channel::<()>();
    let _ = std::thread::Builder::new().name("signals".into()).spawn(move || {
        let Ok(mut signals) = signal_hook::iterator::Signals::new(wanted) else { return };
        drop(waiting);
        if let Some(signal) = signals.forever().next() {
            let why = match signal {
                SIGINT => "stopped by Ctrl-C",
                SIGHUP => "stopped: its terminal was closed",
                SIGXCPU => "stopped: its CPU time is used up (ulimit -t)",
                _ => "stopped by a signal",
            };
            stop(&console, why, 128 + signal);
        }
    });
    // Comes back once the other end is dropped.
    let _ = caught.recv();
}

/// Whether the process was started with the signal ignored, as far as the system tells.
#[cfg(unix)]
fn is_ignored(signal: i32) -> bool {
    let status = io::read_text("/proc/self/status").unwrap_or_default();
    let mask =
        status.lines().find_map(|l| l.strip_prefix("SigIgn:")).and_then(|m| u64::from_str_radix(m.trim(), 16).ok());
    mask.is_some_and(|m| m >> (signal - 1) & 1 == 1)
}
