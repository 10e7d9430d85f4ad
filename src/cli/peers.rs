//! Other tools beside this one: each in a process of its own, by the script that the benchmarks use.

use anyhow::{Context, Result, bail};
use palpate::io;
use palpate::pipeline::trials::{Case, Variant};
use palpate::types::{FieldParams, Part, Trial};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

const PEERS: &str = include_str!("../../benches/frontier/peers.py");
const USAGE: &str = include_str!("../../benches/frontier/usage.py");
const MUJOCO: &str = include_str!("../../benches/grasp_mujoco.py");

/// The tools that were found, and where their scripts lie.
pub struct Peers {
    folder: PathBuf,
    /// Names of the registration methods that can be run.
    pub methods: Vec<String>,
}

/// `python3`, or what the variable PYTHON names.
fn python() -> Command {
    Command::new(std::env::var_os("PYTHON").unwrap_or_else(|| "python3".into()))
}

fn output(command: &mut Command) -> Result<Output> {
    let told = || "cannot run python3, which the other tools need; set PYTHON to where it is".to_string();
    command.output().with_context(told)
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).trim().to_string()
}

impl Peers {
    /// Looks for installed tools; scripts and files in between go into `folder`.
    pub fn find(folder: &Path) -> Result<Self> {
        for (name, script) in [("peers.py", PEERS), ("usage.py", USAGE), ("grasp_mujoco.py", MUJOCO)] {
            io::write_text(folder.join(name), script)?;
        }
        let found = output(python().arg(folder.join("peers.py")).arg("list"))?;
        // Variants of one tool that were only tried to be fair to it would crowd the chart.
        let shown = |name: &&str| !["", "greedy long", "elastix finer"].contains(name);
        let methods = text(&found.stdout).lines().filter(shown).map(String::from).collect();
        Ok(Self { folder: folder.into(), methods })
    }

    /// Runs every method and this program's presets on `case`, each as a whole command with two threads.
    pub fn run(&self, case: &Case) -> Result<Vec<Trial>> {
        let [fixed, moving] = ["fixed.nii.gz", "moving.nii.gz"].map(|n| self.folder.join(n));
        io::write_volume(&fixed, &case.initial, "palpate chart")?;
        io::write_volume(&moving, &case.deformed, "palpate chart")?;
        let own = std::env::current_exe().context("this program cannot find itself")?;
        let mut out = Vec::new();
        for preset in Variant::presets() {
            let results = self.folder.join(format!("own-{}", preset.method));
            let mut command = vec![own.clone().into_os_string(), "field".into()];
            command.extend([fixed.as_os_str(), moving.as_os_str(), "-o".as_ref(), results.as_os_str()].map(Into::into));
            let flags = ["--force", "--quiet", "--threads", "2", "--preset", preset.method.as_str()];
            command.extend(flags.map(Into::into));
            let method = format!("palpate {}", preset.method);
            let variant = Variant { varied: "whole command", method, ..preset };
            out.push(self.trial(case, &variant, &command, &results.join("displacement.nii.gz"))?);
        }
        for method in &self.methods {
            let field = self.folder.join("field.nii.gz");
            let script = [python().get_program().to_owned(), self.folder.join("peers.py").into_os_string()];
            let files = [&fixed, &moving, &field].map(|p| p.clone().into_os_string());
            let command: Vec<_> = script.into_iter().chain([method.into()]).chain(files).collect();
            let settings = "settings of benches/frontier/peers.py, 2 threads".into();
            let params = FieldParams::default();
            let variant = Variant { varied: "other tool", method: method.clone(), settings, params };
            out.push(self.trial(case, &variant, &command, &field)?);
        }
        Ok(out)
    }

    /// One command under the watch of usage.py, and the score of the field that it leaves.
    fn trial(&self, case: &Case, variant: &Variant, command: &[std::ffi::OsString], field: &Path) -> Result<Trial> {
        let done = output(python().arg(self.folder.join("usage.py")).args(command))?;
        let told = text(&done.stdout);
        let numbers: Vec<f64> = told.split_whitespace().filter_map(|v| v.parse().ok()).collect();
        let [code, cpu_s, ..] = numbers[..] else { bail!("{}: {}", variant.method, text(&done.stderr)) };
        let mut trial = match io::read_field(field) {
            Ok(measured) if code == 0.0 => case.score(variant, &measured, cpu_s)?,
            _ => Trial { failure: Some(text(&done.stderr)), ..case.trial(variant, cpu_s) },
        };
        trial.whole = true;
        Ok(trial)
    }

    /// MuJoCo on the reference scene against `postures` (degrees); nothing where it is not installed.
    pub fn mujoco(&self, postures: &[f64]) -> Result<Vec<Trial>> {
        let wanted: Vec<String> = postures.iter().map(|v| format!("{v:.9}")).collect();
        let script = self.folder.join("grasp_mujoco.py");
        let done = output(python().arg(script).args(["--postures", &wanted.join(",")]))?;
        let row = |line: &str| {
            let parts: Vec<&str> = line.split_whitespace().collect();
            let [time, cone, impratio, cpu_s, error] = parts[..] else { return None };
            Some(Trial {
                part: Part::Grasp,
                varied: "other tool",
                method: format!("MuJoCo {time} {cone} {impratio}"),
                settings: format!("implicitfast at 1e-3 s, contacts {time} s, {cone}, impratio {impratio}"),
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
        Ok(text(&done.stdout).lines().filter_map(row).collect())
    }
}
