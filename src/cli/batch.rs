//! `palpate batch`: a table of pairs, each through field, stiffness, fingertip and grasp, in
//! parallel and resumable.
//!
//! Each stage is a process of its own: a pair that fails, or is killed for memory, takes nothing
//! else with it. What was run, with the size and time of every input, is kept in the pair's
//! `pair.json`; a stage whose record still holds is not run again.

use super::Usage;
use super::console::Console;
use super::field::Tuning;
use super::inputs::{name, read_labels, read_mask};
use super::limits::ATTENDED;
use super::own;
use super::record::{self, Recording};
use anyhow::{Result, bail};
use clap::Args;
use palpate::error::Shown;
use palpate::io::{self, read_header};
use palpate::pipeline::dry_run;
use palpate::report::batch as report;
use palpate::report::record::{in_summary, on_page};
use palpate::types::batch::{Pair, PairOutcome, Status};
use palpate::types::record::RunRecord;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

/// Part of the free memory that is taken unasked.
const MEMORY_FRACTION: f64 = 0.8;
/// What stands for a batch in a folder.
const TABLE: &str = "batch.csv";
/// What is known of a pair's stages, in its folder.
const RECORD: &str = "pair.json";

#[derive(Debug, Args)]
pub struct Options {
    /// Table of pairs (CSV): initial, deformed, and as wanted mask, start, deformed_mask, ignore,
    /// landmarks, labels, names, held, load, force_n, scene, name, subject, session; paths count
    /// from the table's folder. Or a BIDS data set, whose runs of a session, else whose sessions,
    /// are pairs
    table: PathBuf,
    /// Folder for the results; those that are there already are not made again
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Write into a folder that holds something else
    #[arg(long, alias = "force")]
    overwrite: bool,
    /// Pairs at a time at most [default: as many as threads]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    jobs: Option<u16>,
    /// Memory for all pairs at a time, in GB [default: 80 % of what is free]
    #[arg(long, value_name = "GB")]
    memory: Option<f64>,
    /// Nodes of the stiffness meshes, about; 500 to 500,000
    #[arg(long, value_name = "N", default_value_t = 20_000)]
    nodes: usize,
    /// Measure nothing: gather the tables and the report from the results that are there
    #[arg(long)]
    collect: bool,
    #[command(flatten)]
    tuning: Tuning,
}

/// One command on one pair.
struct Stage {
    name: &'static str,
    /// Without threads.
    arguments: Vec<String>,
    inputs: Vec<PathBuf>,
    /// There when the stage is done.
    marker: PathBuf,
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { table, output, overwrite, jobs, memory, nodes, collect, tuning } = options;
    tuning.params()?;
    palpate::types::StiffnessParams { nodes: *nodes, ..Default::default() }.check()?;
    if memory.is_some_and(|gb| !(gb.is_finite() && gb > 0.0)) {
        bail!(Usage("--memory takes a number of GB above 0".into()));
    }
    let bids = io::is_bids(table);
    let pairs = if bids { io::read_bids(table)? } else { io::read_pairs(table)? };
    let used = io::list(output).is_ok_and(|files| !files.is_empty());
    if used && !overwrite && !collect && !output.join(TABLE).exists() {
        bail!("{}: holds something that is not a batch; choose another --output, or add --overwrite", output.shown());
    }
    io::make_folder(output)?;
    let _held = io::hold(output)?;
    // What each stage has read is in its own summary.
    let listed = if bids { table.join("dataset_description.json") } else { table.clone() };
    let record = Recording::start(console, record::inputs(&[("table", Some(&listed)), ("config", tuning.config())]));
    let outcomes: Vec<PairOutcome> = match collect {
        true => pairs.iter().map(|pair| collected(pair, output, tuning)).collect(),
        false => {
            let free = io::memory_left();
            let budget = memory.map(|gb| (1e9 * gb) as u64).or(free.map(|b| (MEMORY_FRACTION * b as f64) as u64));
            // Where memory is not known, one at a time.
            let jobs = if budget.is_none() { 1 } else { jobs.map_or(rayon::current_num_threads(), usize::from) };
            let batch = Batch { options, pairs: &pairs, budget: budget.unwrap_or(u64::MAX), console };
            batch.run(jobs.min(pairs.len()))?
        }
    };
    write(output, &outcomes, &record.finish())?;
    if bids {
        io::describe_derivative(output, table)?;
        for (pair, outcome) in pairs.iter().zip(&outcomes) {
            io::write_derivative(output, table, pair, outcome.status != Status::Failed)?;
        }
    }
    for o in outcomes.iter().filter(|o| o.status == Status::Failed) {
        console.warn(&format!("{} failed at {}: {}", o.name, o.stage, o.reason));
    }
    console.say(&format!(
        "{}: {}\n  table        {}\n  results      {}",
        name(table),
        report::verdict(&outcomes),
        output.join(TABLE).shown(),
        output.join("report.html").shown()
    ));
    let failed = outcomes.iter().filter(|o| o.status == Status::Failed).count();
    if failed > 0 {
        bail!(
            "{failed} of {} pairs failed; {} says why, and the next run tries them again",
            pairs.len(),
            output.join(TABLE).shown()
        );
    }
    Ok(())
}

/// The tables and the report.
fn write(output: &Path, outcomes: &[PairOutcome], record: &RunRecord) -> Result<()> {
    io::write_rows(
        output.join("regions.csv"),
        &report::REGION_COLUMNS,
        outcomes.iter().flat_map(report::region_rows).collect(),
    )?;
    io::write_json(output.join("summary.json"), &in_summary(report::summary(outcomes), record))?;
    io::write_text(output.join("report.html"), &on_page(report::page(outcomes), record))?;
    Ok(io::write_rows(output.join(TABLE), &report::COLUMNS, outcomes.iter().map(report::row).collect())?)
}

/// The last error that a stage's log holds.
fn reason(log: &str) -> Option<String> {
    log.lines().rev().find_map(|l| l.strip_prefix("error: ")).map(str::to_string)
}

/// The summaries of `folder`, put into `outcome`.
fn gather(folder: &Path, outcome: &mut PairOutcome) {
    let read = |stage: &str| io::read_json(folder.join(stage).join("summary.json")).unwrap_or_default();
    (outcome.field, outcome.stiffness, outcome.grasp) = (read("field"), read("stiffness"), read("grasp"));
    outcome.fingertip_kpa = io::read_fingertip_modulus(folder.join("fingertip.toml")).ok().map(|pa| 1e-3 * pa);
}

/// A pair whose results someone else has made.
fn collected(pair: &Pair, output: &Path, tuning: &Tuning) -> PairOutcome {
    let folder = output.join(&pair.folder);
    let mut outcome = PairOutcome { status: Status::Done, ..PairOutcome::waiting(pair) };
    // Made by a batch, a stage counts where its record stands: one that failed when it was run
    // again has left older results.
    let earlier = io::read_json(folder.join(RECORD)).unwrap_or_default();
    outcome.seconds = took(&earlier);
    let recorded = earlier["stages"].as_array().map(Vec::len);
    for (k, stage) in stages(pair, &folder, tuning, 0).into_iter().enumerate() {
        if !stage.marker.exists() || recorded.is_some_and(|n| n <= k) {
            let log = io::read_text(folder.join(format!("{}.log", stage.name))).unwrap_or_default();
            outcome.status = Status::Failed;
            outcome.stage = stage.name;
            outcome.reason = reason(&log).unwrap_or_else(|| match stage.marker.exists() {
                true => format!("{} was made from other inputs; run the batch again", stage.marker.shown()),
                false => format!("there is no {}", stage.marker.shown()),
            });
            break;
        }
    }
    gather(&folder, &mut outcome);
    outcome
}

/// What is to be run for a pair: each stage as far as the table's columns go.
fn stages(pair: &Pair, folder: &Path, tuning: &Tuning, nodes: usize) -> Vec<Stage> {
    let text = |p: &Path| p.to_string_lossy().into_owned();
    let at = |part: &str| text(&folder.join(part));
    let flag = |key: &str, value: Option<String>| value.map(|v| format!("--{key}={v}"));
    let files = |list: &[Option<&PathBuf>]| list.iter().flatten().map(|p| (*p).clone()).collect::<Vec<_>>();
    let owned = |words: &[&str]| words.iter().map(|w| w.to_string()).collect::<Vec<_>>();

    let mut field = owned(&["field", &text(&pair.initial), &text(&pair.deformed), "--overwrite", "-o", &at("field")]);
    field.extend(flag("mask", pair.mask.as_deref().map(text)));
    field.extend(flag("deformed-mask", pair.deformed_mask.as_deref().map(text)));
    field.extend(pair.ignore.iter().filter_map(|m| flag("ignore", Some(text(m)))));
    if !pair.landmarks.is_empty() {
        field.push("--landmarks".into());
        field.extend(pair.landmarks.iter().map(|l| text(l)));
    }
    if !pair.start.is_empty() {
        field.push("--initial".into());
        field.extend(pair.start.iter().cloned());
    }
    field.extend(tuning.arguments());
    let mut out = vec![Stage {
        name: "field",
        arguments: field,
        inputs: files(&[
            Some(&pair.initial),
            Some(&pair.deformed),
            pair.mask.as_ref(),
            pair.deformed_mask.as_ref(),
            tuning.config(),
        ])
        .into_iter()
        .chain(pair.ignore.iter().chain(&pair.landmarks).cloned())
        .collect(),
        marker: folder.join("field/summary.json"),
    }];
    let Some(labels) = &pair.labels else { return out };
    let mut stiffness = owned(&["stiffness", "--field", &at("field"), "--overwrite", "-o", &at("stiffness")]);
    stiffness.extend([format!("--labels={}", text(labels)), format!("--nodes={nodes}")]);
    stiffness.extend(flag("names", pair.names.clone()));
    stiffness.extend(flag("held", pair.held.clone()));
    stiffness.extend(flag("load", pair.load.clone()));
    stiffness.extend(flag("total-force", pair.force_n.map(|f| f.to_string())));
    let inputs = std::iter::once(labels.clone()).chain(patches(pair)).collect();
    out.push(Stage { name: "stiffness", arguments: stiffness, inputs, marker: folder.join("stiffness/summary.json") });
    let Some(scene) = &pair.scene else { return out };
    out.push(Stage {
        name: "fingertip",
        arguments: owned(&["fingertip", &at("stiffness"), "-o", &at("fingertip.toml")]),
        inputs: Vec::new(),
        marker: folder.join("fingertip.toml"),
    });
    // The scene is copied beside the fingertip that it names.
    out.push(Stage {
        name: "grasp",
        arguments: owned(&["grasp", &at("scene.toml"), "--overwrite", "-o", &at("grasp")]),
        inputs: vec![scene.clone()],
        marker: folder.join("grasp/summary.json"),
    });
    out
}

/// Masks that say where a body is held or pressed.
fn patches(pair: &Pair) -> impl Iterator<Item = PathBuf> {
    [&pair.held, &pair.load].into_iter().flatten().map(PathBuf::from).filter(|p| p.is_file())
}

/// What is kept of the stages of a pair: what each was run on, and how long it took (s).
fn kept(records: &[Value], seconds: &[f64]) -> Value {
    json!({ "stages": records, "seconds": seconds })
}

/// How long the results of a pair took, by what is kept of its stages (s).
fn took(kept: &Value) -> f64 {
    kept["seconds"].as_array().into_iter().flatten().filter_map(Value::as_f64).sum()
}

/// What may run at a time.
struct Free {
    waiting: Vec<usize>,
    memory: u64,
}

struct Batch<'a> {
    options: &'a Options,
    pairs: &'a [Pair],
    budget: u64,
    console: &'a Console,
}

/// The guarded value also after another thread has panicked.
fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Batch<'_> {
    /// All pairs, at most `jobs` at a time and as many as the memory holds; outcomes in the table's
    /// order.
    fn run(&self, jobs: usize) -> Result<Vec<PairOutcome>> {
        let output = &self.options.output;
        let outcomes = Mutex::new(self.pairs.iter().map(PairOutcome::waiting).collect::<Vec<_>>());
        io::write_rows(output.join(TABLE), &report::COLUMNS, locked(&outcomes).iter().map(report::row).collect())?;
        let needs: Vec<Result<u64>> = self.pairs.iter().map(|p| self.check(p)).collect();
        let most = needs.iter().flatten().copied().filter(|n| *n <= self.budget).max().unwrap_or(1).max(1);
        let abreast = ((self.budget / most) as usize).clamp(1, jobs.max(1));
        let threads = (rayon::current_num_threads() / abreast).max(1);
        self.console.detail(&format!(
            "{} pairs, up to {jobs} at a time in {:.1} GB, the largest needs {:.2} GB; {threads} threads each",
            self.pairs.len(),
            self.budget as f64 / 1e9,
            most as f64 / 1e9
        ));
        let free = Mutex::new(Free { waiting: (0..self.pairs.len()).collect(), memory: self.budget });
        let (ended, progress) = (Condvar::new(), self.console.progress());
        std::thread::scope(|scope| {
            for _ in 0..jobs {
                scope.spawn(|| {
                    while let Some((index, need)) = self.take(&free, &ended, &needs) {
                        let outcome = self.one(index, &needs[index], threads);
                        let mut all = locked(&outcomes);
                        self.console.detail(&format!("{}: {} {}", outcome.name, outcome.status.name(), outcome.reason));
                        all[index] = outcome;
                        let done = all.iter().filter(|o| o.status != Status::Waiting).count();
                        progress.set(&format!("{done} of {} pairs", all.len()), done as f64 / all.len() as f64);
                        // What is known so far; the end of the run says when this cannot be
                        // written.
                        let _ =
                            io::write_rows(output.join(TABLE), &report::COLUMNS, all.iter().map(report::row).collect());
                        drop(all);
                        let mut state = locked(&free);
                        state.memory += need;
                        ended.notify_all();
                    }
                });
            }
        });
        Ok(outcomes.into_inner().unwrap_or_else(PoisonError::into_inner))
    }

    /// The first waiting pair that the memory left holds, once there is one; none when nothing
    /// waits.
    fn take(&self, free: &Mutex<Free>, ended: &Condvar, needs: &[Result<u64>]) -> Option<(usize, u64)> {
        let mut state = locked(free);
        loop {
            if state.waiting.is_empty() {
                return None;
            }
            // What cannot run is reported at once and costs nothing.
            let need = |i: usize| needs[i].as_ref().ok().copied().filter(|n| *n <= self.budget).unwrap_or(0);
            if let Some(at) = state.waiting.iter().position(|&i| need(i) <= state.memory) {
                let index = state.waiting.remove(at);
                state.memory -= need(index);
                return Some((index, need(index)));
            }
            state = ended.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Checks what a stage after the first would find only then, and gives the memory that the
    /// largest one needs (bytes).
    fn check(&self, pair: &Pair) -> Result<u64> {
        let grids = [&pair.initial, &pair.deformed].map(|p| read_header(p).map(|h| h.0.grid));
        let [initial, deformed] = grids;
        let (initial, deformed) = (initial?, deformed?);
        if let Some(labels) = &pair.labels {
            read_labels(labels, &initial, &pair.initial, &mut Vec::new())?;
        }
        for patch in patches(pair) {
            read_mask(&patch, &initial, &pair.initial, &mut Vec::new())?;
        }
        if let Some(scene) = &pair.scene {
            io::read_text(scene)?;
        }
        let field = dry_run::memory(&initial, &deformed);
        Ok(field.max(if pair.labels.is_some() { dry_run::stiffness_memory(self.options.nodes) } else { 0 }))
    }

    /// One pair from start to end.
    fn one(&self, index: usize, need: &Result<u64>, threads: usize) -> PairOutcome {
        let (pair, started) = (&self.pairs[index], Instant::now());
        let folder = self.options.output.join(&pair.folder);
        let mut outcome = PairOutcome::waiting(pair);
        let problem = match need {
            Err(error) => Some(error.to_string()),
            Ok(n) if *n > self.budget => Some(format!(
                "needs about {:.1} GB, more than the {:.1} GB there are for all; raise --memory, lower --nodes, or crop the volumes",
                *n as f64 / 1e9,
                self.budget as f64 / 1e9
            )),
            Ok(_) => None,
        };
        let done = match problem {
            Some(problem) => {
                self.void_outdated(pair, &folder);
                Err(("check", problem))
            }
            None => self.stages(pair, &folder, threads),
        };
        match done {
            Ok((ran, seconds)) => {
                (outcome.status, outcome.seconds) = (if ran { Status::Done } else { Status::Skipped }, seconds);
            }
            Err((stage, reason)) => {
                (outcome.status, outcome.stage, outcome.reason) = (Status::Failed, stage, reason);
                outcome.seconds = started.elapsed().as_secs_f64();
            }
        }
        if outcome.status != Status::Failed {
            gather(&folder, &mut outcome);
        }
        outcome
    }

    /// Strikes from the record of earlier results each stage that ran on other inputs or arguments.
    fn void_outdated(&self, pair: &Pair, folder: &Path) {
        let earlier = io::read_json(folder.join(RECORD)).unwrap_or_default();
        let list = |key: &str| earlier[key].as_array().cloned().unwrap_or_default();
        let (records, seconds) = (list("stages"), list("seconds"));
        let now = stages(pair, folder, &self.options.tuning, self.options.nodes);
        let same = now.iter().zip(&records).take_while(|(s, old)| record(s).is_ok_and(|r| r == **old)).count();
        if same < records.len() {
            let seconds: Vec<f64> = seconds.iter().take(same).filter_map(Value::as_f64).collect();
            // Where this cannot be written, neither can the table: that error is reported.
            let _ = io::write_json(folder.join(RECORD), &kept(&records[..same], &seconds));
        }
    }

    /// All stages of a pair that are not done yet; whether there was one, and how long all took, in
    /// this run or an earlier one (s). An error is the stage and the reason.
    fn stages(&self, pair: &Pair, folder: &Path, threads: usize) -> Result<(bool, f64), (&'static str, String)> {
        let path = folder.join(RECORD);
        let earlier = io::read_json(&path).unwrap_or_default();
        let (mut records, mut seconds, mut ran): (Vec<Value>, Vec<f64>, bool) = (Vec::new(), Vec::new(), false);
        for (k, stage) in stages(pair, folder, &self.options.tuning, self.options.nodes).into_iter().enumerate() {
            let told = |e: &dyn std::fmt::Display| (stage.name, e.to_string());
            let record = record(&stage).map_err(|e| told(&e))?;
            if ran || !stage.marker.exists() || earlier["stages"][k] != record {
                ran = true;
                io::make_folder(folder).map_err(|e| told(&e))?;
                // From here on the old results do not count.
                io::write_json(&path, &kept(&records, &seconds)).map_err(|e| told(&e))?;
                if stage.name == "grasp"
                    && let Some(scene) = &pair.scene
                {
                    let copy = io::read_text(scene).and_then(|text| io::write_text(folder.join("scene.toml"), &text));
                    copy.map_err(|e| told(&e))?;
                }
                let started = Instant::now();
                execute(&stage, folder, threads).map_err(|e| told(&e))?;
                seconds.push(started.elapsed().as_secs_f64());
            } else {
                seconds.push(earlier["seconds"][k].as_f64().unwrap_or(0.0));
            }
            records.push(record);
            if ran {
                io::write_json(&path, &kept(&records, &seconds)).map_err(|e| told(&e))?;
            }
        }
        Ok((ran, seconds.iter().sum()))
    }
}

/// What a stage is run on: another version, other arguments or a changed input make another record.
fn record(stage: &Stage) -> Result<Value> {
    let input = |path: &PathBuf| {
        let (bytes, changed) = io::stamp(path)?;
        Ok(json!({ "path": path, "bytes": bytes, "changed": changed }))
    };
    let inputs = stage.inputs.iter().map(input).collect::<Result<Vec<Value>>>()?;
    let version = env!("CARGO_PKG_VERSION");
    Ok(json!({ "stage": stage.name, "version": version, "arguments": stage.arguments, "inputs": inputs }))
}

/// Runs a stage as a process of its own, which ends with this one; its words go to `<stage>.log` in
/// `folder`.
fn execute(stage: &Stage, folder: &Path, threads: usize) -> Result<()> {
    let own = own::words();
    let mut command = Command::new(&own[0]);
    command.args(&own[1..]).args(&stage.arguments).args(["--threads", &threads.to_string()]).env(ATTENDED, "1");
    let mut process = command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn()?;
    let _open = process.stdin.take();
    let done = process.wait_with_output()?;
    let said = String::from_utf8_lossy(&done.stderr);
    io::write_text(folder.join(format!("{}.log", stage.name)), &said)?;
    if done.status.success() {
        return Ok(());
    }
    match (reason(&said), done.status.code()) {
        (Some(reason), _) => bail!("{reason}"),
        (None, Some(code)) => bail!("ended with code {code}; see {}.log", stage.name),
        (None, None) => bail!("was killed ({}); if that was for memory, lower --jobs or --memory", done.status),
    }
}
