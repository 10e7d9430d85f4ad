//! Other tools beside this one: each in a process of its own, by the script that the benchmarks
//! use.

use super::own;
use anyhow::{Context, Result, bail};
use palpate::error::Shown;
use palpate::io;
use palpate::pipeline::speed_accuracy::{Case, Variant};
use palpate::types::grasp::GraspRun;
use palpate::types::{FieldParams, Part, Trial};
use std::ffi::OsString;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

const PEERS: &str = include_str!("../../benches/frontier/peers.py");
const USAGE: &str = include_str!("../../benches/frontier/usage.py");
const MUJOCO: &str = include_str!("../../benches/grasp_mujoco.py");

/// Variants of one tool that were only tried to be fair to it would crowd the chart.
const NOT_SHOWN: [&str; 2] = ["greedy long", "elastix finer"];

/// The tool that measures no field.
const SIMULATOR: &str = "MuJoCo";

/// A tool that the script knows.
struct Tool {
    name: String,
    settings: String,
    /// What is not installed here; empty when it can be run.
    missing: String,
}

/// The tools that were found, and where their scripts lie.
pub struct Peers {
    folder: PathBuf,
    tools: Vec<Tool>,
}

/// `python3`, or what the variable PYTHON names.
fn python() -> Command {
    Command::new(std::env::var_os("PYTHON").unwrap_or_else(|| "python3".into()))
}

fn output(command: &mut Command) -> Result<Output> {
    let told = format!("cannot run {}; set PYTHON to where python3 is", command.get_program().shown());
    command.output().context(told)
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).trim().to_string()
}

/// The last line that a process has written to stderr, or how it ended.
fn reason(done: &Output) -> String {
    let said = text(&done.stderr);
    let line = said.lines().rev().map(str::trim).find(|l| !l.is_empty());
    line.map_or_else(|| format!("no word about it, {}", done.status), String::from)
}

impl Peers {
    /// Looks for installed tools; scripts and files in between go into `folder`.
    ///
    /// # Errors
    /// When Python does not run, with what to do about it.
    pub fn find(folder: &Path) -> Result<Self> {
        for (name, script) in [("peers.py", PEERS), ("usage.py", USAGE), ("grasp_mujoco.py", MUJOCO)] {
            io::write_text(folder.join(name), script)?;
        }
        let found = output(python().arg(folder.join("peers.py")).arg("list"))?;
        let tool = |line: &str| {
            let mut parts = line.split('\t').map(String::from);
            Some(Tool { name: parts.next()?, settings: parts.next()?, missing: parts.next()? })
        };
        let listed = String::from_utf8_lossy(&found.stdout);
        let tools: Vec<Tool> = listed.lines().filter_map(tool).filter(|t| !NOT_SHOWN.contains(&&*t.name)).collect();
        if !found.status.success() || tools.is_empty() {
            bail!("{} does not run the script that knows them: {}", python().get_program().shown(), reason(&found));
        }
        Ok(Self { folder: folder.into(), tools })
    }

    /// Which tools are left out and what each of them needs; `field` and `grasp` say what is
    /// charted. None when all are here.
    pub fn left_out(&self, field: bool, grasp: bool) -> Option<String> {
        let asked = |t: &&Tool| if t.name == SIMULATOR { grasp } else { field };
        let mut by_need: Vec<(&str, Vec<&str>)> = Vec::new();
        for tool in self.tools.iter().filter(asked).filter(|t| !t.missing.is_empty()) {
            match by_need.iter_mut().find(|n| n.0 == tool.missing) {
                Some(need) => need.1.push(&tool.name),
                None => by_need.push((&tool.missing, vec![&tool.name])),
            }
        }
        let words = by_need.iter().map(|(need, tools)| format!("{} (not found: {need})", tools.join(", ")));
        (!by_need.is_empty()).then(|| words.collect::<Vec<_>>().join("; "))
    }

    /// Runs every method and this program's presets on `case`, each as a whole command with two
    /// threads. `progress` is called with the part that is done.
    ///
    /// # Errors
    /// When the volumes cannot be written; a method that fails is a trial without a result.
    pub fn run(&self, case: &Case, progress: &dyn Fn(f64)) -> Result<Vec<Trial>> {
        let [fixed, moving] = ["fixed.nii.gz", "moving.nii.gz"].map(|n| self.folder.join(n));
        io::write_volume(&fixed, &case.initial, "palpate chart")?;
        io::write_volume(&moving, &case.deformed, "palpate chart")?;
        let own = own::words();
        let pair = [&fixed, &moving].map(|p| p.clone().into_os_string());
        let steps = Variant::steps();
        let tools: Vec<&Tool> = self.tools.iter().filter(|t| t.missing.is_empty() && t.name != SIMULATOR).collect();
        let count = (steps.len() + tools.len()) as f64;
        let mut out = Vec::new();
        for step in steps {
            progress(out.len() as f64 / count);
            // A folder a run: what one leaves is not taken for another's.
            let results = io::Scratch::new()?;
            let mut command = own.clone();
            command.push("field".into());
            command.extend(pair.clone());
            command.extend(["-o".into(), results.path().into()]);
            let flags = ["--overwrite", "--quiet", "--threads", "2"].into_iter().chain(step.settings.split(' '));
            command.extend(flags.map(Into::into));
            let (method, settings) = (format!("palpate {}", step.method), format!("{}, 2 threads", step.settings));
            let variant = Variant { varied: "whole command", method, settings, ..step };
            out.push(self.trial(case, &variant, &command, &results.path().join("displacement.nii.gz"))?);
        }
        for tool in tools {
            progress(out.len() as f64 / count);
            let results = io::Scratch::new()?;
            let field = results.path().join("field.nii.gz");
            let mut command = vec![python().get_program().into(), self.folder.join("peers.py").into()];
            command.push(OsString::from(&tool.name));
            command.extend(pair.clone());
            command.push(field.clone().into());
            let (method, settings) = (tool.name.clone(), tool.settings.clone());
            let variant = Variant { varied: "other tool", method, settings, params: FieldParams::default() };
            out.push(self.trial(case, &variant, &command, &field)?);
        }
        Ok(out)
    }

    /// One command under the watch of usage.py, and the score of the field that it leaves.
    fn trial(&self, case: &Case, variant: &Variant, command: &[OsString], field: &Path) -> Result<Trial> {
        let done = output(python().arg(self.folder.join("usage.py")).args(command))?;
        let told = text(&done.stdout);
        let numbers: Vec<f64> = told.split_whitespace().filter_map(|v| v.parse().ok()).collect();
        let [code, cpu_s, ..] = numbers[..] else {
            return Ok(Trial { failure: Some(reason(&done)), whole: true, ..case.trial(variant, f64::NAN) });
        };
        let scored = if code == 0.0 {
            let measured = io::read_field(field).map_err(|e| e.to_string());
            measured.and_then(|m| case.score(variant, &m, cpu_s).map_err(|e| e.to_string()))
        } else {
            Err(match text(&done.stderr) {
                said if said.is_empty() => format!("ended with code {code}"),
                said => said,
            })
        };
        let failed = |why| Trial { failure: Some(why), ..case.trial(variant, cpu_s) };
        Ok(Trial { whole: true, ..scored.unwrap_or_else(failed) })
    }

    /// MuJoCo on the reference scene against the object's angles in `exact`, with that of its
    /// contact settings that comes nearest; nothing where it is not installed or no setting keeps
    /// hold of the object.
    ///
    /// # Errors
    /// When the samples cannot be written, or MuJoCo is there and does not run.
    pub fn mujoco(&self, exact: &GraspRun) -> Result<Option<Trial>> {
        if !self.tools.iter().any(|t| t.name == SIMULATOR && t.missing.is_empty()) {
            return Ok(None);
        }
        let mut samples = String::new();
        for s in &exact.samples {
            let _ = writeln!(samples, "{:.9} {:.9}", s.time, s.pose[2].to_degrees());
        }
        let wanted = self.folder.join("samples.txt");
        io::write_text(&wanted, &samples)?;
        let script = self.folder.join("grasp_mujoco.py");
        let done = output(python().arg(script).arg("--samples").arg(&wanted))?;
        if !done.status.success() {
            bail!("{SIMULATOR}: {}", reason(&done));
        }
        let row = |line: &str| {
            let parts: Vec<&str> = line.split_whitespace().collect();
            let [time, cone, impratio, cpu_s, error] = parts[..] else { return None };
            Some(Trial {
                part: Part::Grasp,
                varied: "other tool",
                method: SIMULATOR.into(),
                settings: format!(
                    "implicitfast at 1e-3 s, contacts of {time} s, {cone}, impratio {impratio}: the nearest of its contact settings"
                ),
                case: "eight motions".into(),
                error: error.parse().ok()?,
                error_p95: None,
                gradient_error: None,
                nothing: None,
                size: 0,
                cpu_s: cpu_s.parse().ok()?,
                whole: false,
                failure: None,
            })
        };
        let listed = text(&done.stdout);
        Ok(listed.lines().filter_map(row).min_by(|a, b| a.error.total_cmp(&b.error)))
    }
}
