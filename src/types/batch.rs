//! Many pairs: what is to be done with each, and what came of it.

use serde_json::Value;
use std::path::PathBuf;

/// One line of a table of pairs. Paths are as they can be opened.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Pair {
    /// Unique, and fit to name a folder.
    pub name: String,
    /// The folder of its results, from that of the batch.
    pub folder: String,
    /// Who was measured, where the table says so.
    pub subject: String,
    /// When, where the table says so.
    pub session: String,
    /// The volume before the deformation.
    pub initial: PathBuf,
    /// The volume after it.
    pub deformed: PathBuf,
    /// Where to measure, on the initial grid.
    pub mask: Option<PathBuf>,
    /// Where the search begins: the name of an alignment, or transforms in the order a point takes.
    pub start: Vec<String>,
    /// What counts of the deformed volume.
    pub deformed_mask: Option<PathBuf>,
    /// What does not count.
    pub ignore: Vec<PathBuf>,
    /// Places known in both volumes: one table, or two lists.
    pub landmarks: Vec<PathBuf>,
    /// Regions on the initial grid; with them moduli are looked for.
    pub labels: Option<PathBuf>,
    /// Names of the labels, as `1=skin,2=fat`.
    pub names: Option<String>,
    /// The held side, as `z-`, or a mask file.
    pub held: Option<String>,
    /// The pressed side, as `z+`, or a mask file.
    pub load: Option<String>,
    /// Total force on the pressed side (N).
    pub force_n: Option<f64>,
    /// A grasp scene that takes its fingertip from `fingertip.toml`.
    pub scene: Option<PathBuf>,
}

/// How a pair ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Status {
    /// Not yet looked at.
    Waiting,
    /// Measured in this run.
    Done,
    /// Measured by an earlier run, of the same inputs.
    Skipped,
    /// No result.
    Failed,
}

impl Status {
    /// The name used in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Waiting => "waiting",
            Self::Done => "done",
            Self::Skipped => "skipped",
            Self::Failed => "failed",
        }
    }
}

/// What came of a pair. Summaries are the `summary.json` of its stages, null where there is none.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct PairOutcome {
    /// The pair's name.
    pub name: String,
    /// The folder of its results, from that of the batch.
    pub folder: String,
    /// Who was measured.
    pub subject: String,
    /// When.
    pub session: String,
    /// How it ended.
    pub status: Status,
    /// The stage that failed; empty where none did.
    pub stage: &'static str,
    /// Why; empty where none did.
    pub reason: String,
    /// Wall time that its results took, in this run or an earlier one (s).
    pub seconds: f64,
    /// Of `palpate field`.
    pub field: Value,
    /// Of `palpate stiffness`.
    pub stiffness: Value,
    /// Young's modulus of the fingertip (kPa).
    pub fingertip_kpa: Option<f64>,
    /// Of `palpate grasp`.
    pub grasp: Value,
}

impl PairOutcome {
    /// Of `pair`, before anything is done.
    pub fn waiting(pair: &Pair) -> Self {
        Self {
            name: pair.name.clone(),
            folder: pair.folder.clone(),
            subject: pair.subject.clone(),
            session: pair.session.clone(),
            status: Status::Waiting,
            stage: "",
            reason: String::new(),
            seconds: 0.0,
            field: Value::Null,
            stiffness: Value::Null,
            fingertip_kpa: None,
            grasp: Value::Null,
        }
    }
}
