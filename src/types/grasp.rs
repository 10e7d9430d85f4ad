//! What the grasp simulator gives back. SI units, radians; index 0 is the left finger, 1 the right
//! one.

use crate::types::FingertipModel;
use serde::Serialize;

/// The grasp at one time.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Sample {
    /// Time (s).
    pub time: f64,
    /// Object's centre x, y (m) and angle theta (rad).
    pub pose: [f64; 3],
    /// Joint angles (rad).
    pub joints: [f64; 2],
    /// Largest normal displacement d_n of each tip (m).
    pub normal: [f64; 2],
    /// Tangential displacement d_t of each tip (m).
    pub tangential: [f64; 2],
    /// Contact force f_n along the normal (N).
    pub normal_force: [f64; 2],
    /// Contact force f_t along the face's tangent (N).
    pub tangential_force: [f64; 2],
    /// Least coefficient of friction that keeps both tips from sliding (1).
    pub required_friction: f64,
    /// Part of the friction that is not needed: 1 - required / given; 1 where none is given.
    pub friction_margin: f64,
    /// How far each tip has slid along its face (m), along +t of the object.
    pub slip: [f64; 2],
}

impl Sample {
    /// Columns of trajectory.csv.
    pub const COLUMNS: [&str; 18] = [
        "time",
        "x",
        "y",
        "theta",
        "theta1",
        "theta2",
        "dn1",
        "dn2",
        "dt1",
        "dt2",
        "fn1",
        "fn2",
        "ft1",
        "ft2",
        "required_friction",
        "friction_margin",
        "slip1",
        "slip2",
    ];

    /// One row of trajectory.csv.
    pub fn row(&self) -> [f64; 18] {
        let ([x, y, theta], [a, b]) = (self.pose, self.joints);
        let ([n1, n2], [t1, t2]) = (self.normal, self.tangential);
        let ([p1, p2], [q1, q2], [s1, s2]) = (self.normal_force, self.tangential_force, self.slip);
        let (required, margin) = (self.required_friction, self.friction_margin);
        [self.time, x, y, theta, a, b, n1, n2, t1, t2, p1, p2, q1, q2, required, margin, s1, s2]
    }
}

impl Sample {
    /// The smaller, or the larger, of each quantity by `pick`; the time stays.
    pub fn each(&self, other: &Self, pick: fn(f64, f64) -> f64) -> Self {
        let two = |a: [f64; 2], b: [f64; 2]| [pick(a[0], b[0]), pick(a[1], b[1])];
        let [a, b] = [self.pose, other.pose];
        Self {
            time: self.time,
            pose: [pick(a[0], b[0]), pick(a[1], b[1]), pick(a[2], b[2])],
            joints: two(self.joints, other.joints),
            normal: two(self.normal, other.normal),
            tangential: two(self.tangential, other.tangential),
            normal_force: two(self.normal_force, other.normal_force),
            tangential_force: two(self.tangential_force, other.tangential_force),
            required_friction: pick(self.required_friction, other.required_friction),
            friction_margin: pick(self.friction_margin, other.friction_margin),
            slip: two(self.slip, other.slip),
        }
    }
}

/// What the samples of a run may be, where the tips' moduli are known to a deviation or by bounds.
#[derive(Debug, Clone, PartialEq)]
pub struct Bands {
    /// Factors of the moduli that were run beside 1.
    pub factors: Vec<f64>,
    /// Least of each quantity at each time.
    pub low: Vec<Sample>,
    /// Largest.
    pub high: Vec<Sample>,
    /// How each of the runs went.
    pub outcomes: Vec<&'static str>,
}

/// The grasp at the end of a motion's hold.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct MotionRow {
    /// Number of the motion, from 1; 0 is the rest before the first.
    pub step: usize,
    /// Desired joint angles (rad).
    pub target: [f64; 2],
    /// What was reached.
    pub reached: Sample,
}

impl MotionRow {
    /// Columns of motions.csv.
    pub const COLUMNS: [&str; 16] = [
        "step",
        "theta1_deg",
        "theta2_deg",
        "x",
        "y",
        "theta_deg",
        "dn1",
        "dn2",
        "dt1",
        "dt2",
        "fn1",
        "fn2",
        "ft1",
        "ft2",
        "required_friction",
        "friction_margin",
    ];

    /// One row of motions.csv, without the step.
    pub fn row(&self) -> [f64; 15] {
        let s = &self.reached;
        let [a, b] = self.target.map(f64::to_degrees);
        let ([x, y, theta], [n1, n2], [t1, t2], [p1, p2]) = (s.pose, s.normal, s.tangential, s.normal_force);
        let ([q1, q2], required, margin) = (s.tangential_force, s.required_friction, s.friction_margin);
        [a, b, x, y, theta.to_degrees(), n1, n2, t1, t2, p1, p2, q1, q2, required, margin]
    }
}

/// What went out of the model's reach.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum EventKind {
    /// A tip left the object: d_n at or below 0 (rigid tips: f_n at or below 0), or past an end of
    /// its face.
    ContactLoss,
    /// d_n at or above a (1 - |sin tilt|): the back plate's rim would touch.
    ValidityRange,
    /// A tip slides: more is asked along the face than friction holds.
    Slip,
    /// The branch of equilibria that a run came along ends before its joint angles, or the object
    /// rests on another one.
    Fold,
    /// The step is too long for the stiffness and damping.
    BadStep,
    /// The gain of the constraint stabilisation is too high for the step.
    BadGain,
    /// The state is no longer finite, with a step that is short enough.
    NotFinite,
}

impl EventKind {
    /// As in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::ContactLoss => "contact-loss",
            Self::ValidityRange => "validity-range",
            Self::Slip => "slip",
            Self::Fold => "fold",
            Self::BadStep => "bad-step",
            Self::BadGain => "bad-gain",
            Self::NotFinite => "not-finite",
        }
    }

    /// Whether nothing after it is worth having, so that the run ends there.
    pub fn ends_run(self) -> bool {
        matches!(self, Self::ContactLoss | Self::BadStep | Self::BadGain | Self::NotFinite)
    }
}

/// Something that happened at a time.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Event {
    /// What.
    pub kind: EventKind,
    /// When it begins (s).
    pub time: f64,
    /// When it is over (s); none where it lasts, or is of a moment.
    pub until: Option<f64>,
    /// Which finger: 1 left, 2 right; none where both take part.
    pub finger: Option<usize>,
    /// In words, with numbers.
    pub what: String,
    /// The state before it, the last one that the model holds for.
    pub last_valid: Sample,
}

/// Largest violations of the constraints over a run.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct ConstraintDrift {
    /// Normal (holonomic) constraint (m).
    pub normal: f64,
    /// Rolling constraint at velocity level (m/s).
    pub rolling_velocity: f64,
    /// Rolling constraint, integrated (m).
    pub rolling: f64,
}

impl ConstraintDrift {
    /// The larger of both, one by one.
    pub fn worse(self, other: Self) -> Self {
        Self {
            normal: self.normal.max(other.normal),
            rolling_velocity: self.rolling_velocity.max(other.rolling_velocity),
            rolling: self.rolling.max(other.rolling),
        }
    }
}

/// A whole run.
#[derive(Debug, Clone, PartialEq)]
pub struct GraspRun {
    /// Samples at `output_every`, the first at time 0.
    pub samples: Vec<Sample>,
    /// One row for the rest and for each motion that was finished.
    pub motions: Vec<MotionRow>,
    /// What went wrong, in order of time.
    pub events: Vec<Event>,
    /// Largest difference between the change of energy and the work done on the grasp, over the
    /// largest energy (1).
    pub energy_drift: f64,
    /// Largest violations of the constraints.
    pub constraint_drift: ConstraintDrift,
    /// Spectral radius of one step about the start (1); above 1 a step is unstable.
    pub step_growth: f64,
    /// Steps taken.
    pub steps: u64,
    /// Largest coefficient of friction that was needed (1).
    pub required_friction: f64,
    /// Whether the run came to its end.
    pub completed: bool,
}

impl GraspRun {
    /// The worst that happened: what ended the run, or else the first slip, or else the first time
    /// out of the model's range, or else the first fold. None where the grasp held throughout.
    pub fn flaw(&self) -> Option<&Event> {
        let worst = |e: &&Event| match e.kind {
            kind if kind.ends_run() => 0,
            EventKind::Slip => 1,
            EventKind::ValidityRange => 2,
            _ => 3,
        };
        self.events.iter().min_by_key(worst)
    }

    /// `held`, or the name of [`GraspRun::flaw`]'s kind.
    pub fn outcome(&self) -> &'static str {
        self.flaw().map_or("held", |e| e.kind.name())
    }
}

/// How the energy lies about an equilibrium.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Stability {
    /// All eigenvalues positive.
    Minimum,
    /// Some positive, some negative.
    Saddle,
    /// The smallest is zero within rounding.
    Neutral,
    /// All negative.
    Maximum,
    /// There is no stationary pose nearby.
    None,
}

impl Stability {
    /// In lower case.
    pub fn name(self) -> &'static str {
        match self {
            Self::Minimum => "minimum",
            Self::Saddle => "saddle",
            Self::Neutral => "neutral",
            Self::Maximum => "maximum",
            Self::None => "none",
        }
    }
}

/// What holds the object along its faces.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Hold {
    /// Friction that never gives: tips deform along the face, or roll where they cannot.
    Friction,
    /// Nothing: tips slide.
    Frictionless,
    /// Nothing, and the object has no weight.
    Weightless,
}

impl Hold {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Friction, Self::Frictionless, Self::Weightless];

    /// As in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Friction => "friction",
            Self::Frictionless => "frictionless",
            Self::Weightless => "frictionless-weightless",
        }
    }
}

/// The stationary pose of one model with one hold next to a posture, and its Hessian.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StabilityRow {
    /// Number of the motion, 0 for the pinch.
    pub step: usize,
    /// Joint angles (rad).
    pub joints: [f64; 2],
    /// The model.
    pub model: FingertipModel,
    /// What holds the object along its faces.
    pub hold: Hold,
    /// Pose x, y (m), theta (rad) at which the energy is stationary; none where there is no such
    /// pose within a radius of the parallel model's equilibrium.
    pub pose: Option<[f64; 3]>,
    /// Normal displacements there (m).
    pub normal: Option<[f64; 2]>,
    /// Distance from the parallel model's equilibrium in (x, y, a theta) (m).
    pub distance: Option<f64>,
    /// Eigenvalues of the Hessian in (x, y, a theta) along what the contact leaves free, rising
    /// (N/m).
    pub eigenvalues: Vec<f64>,
    /// Length of the force that is left there in (x, y, a theta) (N).
    pub residual: Option<f64>,
    /// What they mean.
    pub class: Stability,
}

/// Energy over two coordinates of the object about a posture, joints fixed.
#[derive(Debug, Clone, PartialEq)]
pub struct EnergySurface {
    /// Number of the motion, 0 for the pinch.
    pub step: usize,
    /// The model.
    pub model: FingertipModel,
    /// "y" or "x": the coordinate beside theta.
    pub axis: &'static str,
    /// Values of theta (rad), columns.
    pub theta: Vec<f64>,
    /// Values of the other coordinate (m), rows.
    pub other: Vec<f64>,
    /// Energy less that at the posture (J), row by row; NaN outside the model's range.
    pub energy: Vec<f64>,
}

/// Force along the normal against displacement and tilt, for two models.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct PostureForce {
    /// Tilts (rad), columns.
    pub tilts: Vec<f64>,
    /// Displacements (m), rows.
    pub displacements: Vec<f64>,
    /// Parallel model: force along the back plate's normal (N), row by row; NaN outside its range.
    pub parallel: Vec<f64>,
    /// Radial model (N).
    pub radial: Vec<f64>,
}

/// Degrees of freedom of one kind of tip with one or two moving fingers.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Freedom {
    /// The model of the tips.
    pub model: FingertipModel,
    /// Fingers that move; with one, the other is locked.
    pub fingers: usize,
    /// Joints of the left and of the right finger that move.
    pub joints: [usize; 2],
    /// Components of force and moment that both contacts carry; three of them are balanced by the
    /// object.
    pub contact_forces: usize,
    /// Coordinates: pose, joints, and the displacements that the tips allow.
    pub coordinates: usize,
    /// Rank of the constraints' Jacobian.
    pub rank: usize,
    /// Coordinates less rank.
    pub freedom: usize,
    /// Of those, how many the object has left when the joints are locked.
    pub object_freedom: usize,
    /// Rank of d(theta)/d(joint angles): 1 when the joints can turn the object.
    pub posture_rank: usize,
    /// Rank of d(grip force)/d(joint angles).
    pub grasp_rank: usize,
    /// Rank of d(theta, grip force)/d(joint angles): 2 when both can be set at once.
    pub both_rank: usize,
    /// The same for joint torques: rigid tips answer to them by their grip where to angles they
    /// cannot.
    pub torque_rank: usize,
    /// Whether the object stays where it is with the joints locked, held by constraints or in a
    /// minimum of energy.
    pub stable: bool,
}

impl Freedom {
    /// What the joint angles can set, in words.
    pub fn controls(&self) -> &'static str {
        match (self.posture_rank, self.grasp_rank, self.both_rank) {
            (_, _, 2..) => "grasp and posture",
            (1.., 1.., _) => "grasp or posture, not both",
            (1.., 0, _) => "posture",
            (0, 1.., _) => "grasp",
            _ => "neither",
        }
    }

    /// What the joint torques can set, in words.
    pub fn torque_controls(&self) -> &'static str {
        match (self.torque_rank, self.posture_rank, self.grasp_rank) {
            (2.., ..) => "grasp and posture",
            (1, 0, 0) => "grasp",
            _ => self.controls(),
        }
    }

    /// The joints as they are written, such as `1+2`; a locked finger has 0.
    pub fn hand(&self) -> String {
        format!("{}+{}", self.joints[0], self.joints[1])
    }
}

/// What holds at one pair of joint angles.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum PinchState {
    /// Reached from the pinch, stable, without slip, in the model's range.
    Good,
    /// Reached, but |f_t / f_n| is above the coefficient of friction.
    Slip,
    /// Reached, but out of the model's range.
    OutOfRange,
    /// A tip has left the object.
    ContactLost,
    /// The branch of stable equilibria ends before.
    Unstable,
    /// Not connected to the pinch through postures that hold.
    Unreached,
}

impl PinchState {
    /// All, best first.
    pub const ALL: [Self; 6] =
        [Self::Good, Self::Slip, Self::OutOfRange, Self::ContactLost, Self::Unstable, Self::Unreached];

    /// As in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Good => "good",
            Self::Slip => "slip",
            Self::OutOfRange => "out-of-range",
            Self::ContactLost => "contact-lost",
            Self::Unstable => "unstable",
            Self::Unreached => "unreached",
        }
    }
}

/// One cell of the pinch map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PinchCell {
    /// What holds.
    pub state: PinchState,
    /// The equilibrium; all zero but the joints where there is none.
    pub sample: Sample,
    /// Smallest eigenvalue of the Hessian in (x, y, a theta) (N/m); NaN where there is no
    /// equilibrium.
    pub smallest_eigenvalue: f64,
}

/// The pinch map: joint angle 1 along columns, joint angle 2 along rows.
#[derive(Debug, Clone, PartialEq)]
pub struct PinchMap {
    /// Angles along both sides (rad), rising.
    pub angles: Vec<f64>,
    /// Cells row by row.
    pub cells: Vec<PinchCell>,
}

/// All that `palpate grasp-analysis` finds.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct GraspAnalysis {
    /// Force against displacement and tilt.
    pub force: PostureForce,
    /// Energy surfaces.
    pub surfaces: Vec<EnergySurface>,
    /// Hessians.
    pub stability: Vec<StabilityRow>,
    /// Postures of the scene that could not be reached on the branch from the pinch, with the
    /// reason.
    pub lost: Vec<(usize, String)>,
    /// Degrees of freedom.
    pub freedom: Vec<Freedom>,
    /// The map.
    pub pinch: PinchMap,
    /// Response to the push with both joints fixed.
    pub push: GraspRun,
    /// Largest stable step of each fixed-step method and formulation at the pinch (s).
    pub stable_steps: Vec<StableStep>,
}

/// The largest stable step of one method.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct StableStep {
    /// Integrator.
    pub method: crate::types::scene::Method,
    /// Coordinates.
    pub formulation: crate::types::scene::Formulation,
    /// Step (s), to 1 %.
    pub step: f64,
}
