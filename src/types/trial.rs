//! Runs with a known answer: what charts of speed against accuracy and of breaking points are made
//! of.

use serde::Serialize;

/// Which chain was run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Part {
    /// Two volumes to a displacement.
    Field,
    /// A displacement to Young's moduli.
    Stiffness,
    /// A scene to a grasp.
    Grasp,
}

impl Part {
    /// All, in the order of the work.
    pub const ALL: [(&'static str, Self); 3] =
        [("field", Self::Field), ("stiffness", Self::Stiffness), ("grasp", Self::Grasp)];

    /// As in files.
    pub fn name(self) -> &'static str {
        Self::ALL.iter().find(|p| p.1 == self).map_or("", |p| p.0)
    }
}

/// One method with one setting on one case.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Trial {
    /// The chain.
    pub part: Part,
    /// What is varied: `preset`, `points`, `stage`, `size`, `nodes`, `step`, `other tool` ...
    pub varied: &'static str,
    /// Short name of the setting.
    pub method: String,
    /// All that sets it apart, in words.
    pub settings: String,
    /// What it was run on.
    pub case: String,
    /// Mean error: mm (field), per cent of the moduli (stiffness), degrees (grasp); NaN where it
    /// failed.
    pub error: f64,
    /// Its 95th percentile, where there is one.
    pub error_p95: Option<f64>,
    /// Median error of the displacement's gradient (1).
    pub gradient_error: Option<f64>,
    /// Error before registration, where that means something.
    pub nothing: Option<f64>,
    /// Voxels, nodes or steps.
    pub size: usize,
    /// CPU seconds of all threads.
    pub cpu_s: f64,
    /// Whether that is a whole command, with its start and its files, or the work alone.
    pub whole: bool,
    /// Why there is no result.
    pub failure: Option<String>,
}

/// A method over all its cases.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Standing {
    /// What is varied.
    pub varied: &'static str,
    /// Short name.
    pub method: String,
    /// All that sets it apart.
    pub settings: String,
    /// Per cent that is left of the error before registration (geometric mean) where all cases have
    /// that, else the mean error; NaN without any result.
    pub error: f64,
    /// Mean CPU seconds of the runs with a result; NaN without any.
    pub cpu_s: f64,
    /// Cases.
    pub cases: usize,
    /// Of these, without a result.
    pub failures: usize,
    /// Whether no other is both faster and more exact.
    pub on_front: bool,
}

/// One run at one severity.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StressRun {
    /// How bad it was made.
    pub severity: f64,
    /// Error against the truth, in the unit of the curve; NaN where there is none.
    pub error: f64,
    /// Beyond this the result is of no use.
    pub limit: f64,
    /// Why there is no result.
    pub refused: Option<String>,
    /// What the program itself said about its result; empty when it saw nothing wrong.
    pub said: Vec<String>,
    /// Share of the errors inside the stated 95 % region, where one is stated.
    pub inside: Option<f64>,
    /// The error that the program expects, in the unit of the curve, where it states one.
    pub expected: Option<f64>,
}

/// Part of the limit under which an error is small: warnings about it are false alarms (1).
const SMALL_ERROR_FRACTION: f64 = 0.3;

impl StressRun {
    /// Whether there is no result, or one of no use.
    pub fn broken(&self) -> bool {
        self.error.is_nan() || self.error > self.limit
    }

    /// Whether the program refused or warned.
    pub fn told(&self) -> bool {
        self.refused.is_some() || !self.said.is_empty()
    }

    /// Broken silently: no warning and no error.
    pub fn silent(&self) -> bool {
        self.broken() && !self.told()
    }

    /// Whether the error is under three tenths of the limit: of a field, a tenth of the motion.
    pub fn is_small(&self) -> bool {
        self.error < SMALL_ERROR_FRACTION * self.limit
    }

    /// Warned of although the error is small.
    pub fn false_alarm(&self) -> bool {
        self.told() && self.is_small()
    }
}

/// What a set of runs states of its errors, against the truth.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Stated {
    /// Runs.
    pub runs: usize,
    /// Of these, with no result or one of no use.
    pub broken: usize,
    /// Of the broken ones, those that nothing was said against.
    pub silent: usize,
    /// Runs whose error is small (`StressRun::false_alarm`).
    pub small: usize,
    /// Of these, those that something was said against.
    pub false_alarms: usize,
    /// Rank correlation of expected and true error over the runs that state one.
    pub rank_correlation: Option<f64>,
    /// Share of these whose expected error lies within a factor of 1.5 and of 2 of the true one.
    pub within: [f64; 2],
}

/// One part pushed along one axis until it breaks.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StressCurve {
    /// The chain.
    pub part: Part,
    /// What was made worse.
    pub axis: String,
    /// Unit of the severity.
    pub unit: &'static str,
    /// Unit of the error.
    pub error_unit: &'static str,
    /// What it was done to.
    pub case: String,
    /// Severities looked at, harmless first (which may be the greatest number).
    pub range: [f64; 2],
    /// All runs, harmless first, several a severity.
    pub runs: Vec<StressRun>,
    /// Severity at which at least half of the runs break; none within the range.
    pub breaks_at: Option<f64>,
    /// The last severity tried before that holds; the breaking point lies between the two.
    pub holds_at: Option<f64>,
    /// First severity at which at least half of the runs say that something is wrong.
    pub told_at: Option<f64>,
    /// The last severity tried before that, where they do not; it first says so between the two.
    pub quiet_at: Option<f64>,
}

impl StressCurve {
    /// Runs that broke silently.
    pub fn silent(&self) -> impl Iterator<Item = &StressRun> {
        self.runs.iter().filter(|r| r.silent())
    }

    /// The runs of each severity, harmless first.
    pub fn severities(&self) -> impl Iterator<Item = &[StressRun]> {
        self.runs.chunk_by(|a, b| a.severity == b.severity)
    }
}
