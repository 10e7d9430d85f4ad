//! What was measured on a fingertip or on a grasp, and how models fit it. SI units, radians.

use serde::Serialize;

/// One press of a tip against a plate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ForcePoint {
    /// Normal displacement d (m).
    pub d: f64,
    /// Tilt between back plate and face (rad).
    pub tilt: f64,
    /// Force along the back plate's normal (N).
    pub force: f64,
    /// Displacement of the tip's surface along the face (m), where it was measured.
    pub d_t: Option<f64>,
    /// Rate of d (m/s), where it or the time was measured.
    pub rate: Option<f64>,
}

/// The object at one time of a grasp.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CoursePoint {
    /// Time (s) from the start of the scene.
    pub time: f64,
    /// Joint angles (rad).
    pub joints: [f64; 2],
    /// Object's centre x, y (m) and angle theta (rad).
    pub pose: [f64; 3],
}

/// A table of measurements.
#[derive(Debug, Clone, PartialEq)]
pub enum Measurements {
    /// Presses of one tip.
    Force(Vec<ForcePoint>),
    /// The course of a grasp whose joints move as the scene says.
    Course(Vec<CoursePoint>),
}

impl Measurements {
    /// Rows.
    pub fn len(&self) -> usize {
        match self {
            Self::Force(points) => points.len(),
            Self::Course(points) => points.len(),
        }
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// A number with its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Estimate {
    /// The number.
    pub value: f64,
    /// Its standard deviation.
    pub sd: f64,
}

/// A model fitted to measurements.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ModelFit {
    /// The model's name.
    pub model: &'static str,
    /// Young's modulus (Pa).
    pub youngs_modulus: Estimate,
    /// Damping c_n (N s/m); none where the table says nothing of it.
    pub damping: Option<Estimate>,
    /// Root mean square of the misfit (N, or m with angles times the tip's radius).
    pub rms: f64,
    /// Log of the evidence less that of the best model (1): 0 for the best.
    pub log_evidence: f64,
    /// What the model gives for each row: a force (N), or x, y (m) and theta (rad).
    #[serde(skip)]
    pub predicted: Vec<[f64; 3]>,
}

/// Models beside measurements, the best first.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MeasuredFit {
    /// `force` or `course`.
    pub kind: &'static str,
    /// Rows of the table.
    pub rows: usize,
    /// Numbers in it that count as independent: fewer than there are where misfits follow each
    /// other.
    pub independent: f64,
    /// The models, the one with the largest evidence first.
    pub models: Vec<ModelFit>,
    /// Models that could not be fitted, with the reason.
    pub failed: Vec<(&'static str, String)>,
    /// Largest difference between measured and simulated joint angles of the best model (rad); 0
    /// for presses.
    pub joints_off: f64,
}

/// Log odds from which evidence is called strong: 20 to 1 (Kass and Raftery 1995).
pub const STRONG_EVIDENCE: f64 = 3.0;

impl MeasuredFit {
    /// What the evidence says, in one sentence.
    pub fn verdict(&self) -> String {
        let [best, next, ..] = &self.models[..] else {
            let only = self.models.first().map_or("no model can be fitted", |m| m.model);
            return format!("{only} is all that there is to fit");
        };
        match -next.log_evidence {
            odds if odds >= STRONG_EVIDENCE => format!(
                "the measurements are for {} over {} by log odds of {odds:.1} (misfits {:.2e} and {:.2e})",
                best.model, next.model, best.rms, next.rms
            ),
            odds => format!(
                "the measurements do not tell {} from {} (log odds {odds:.1}, strong from {STRONG_EVIDENCE})",
                best.model, next.model
            ),
        }
    }
}
