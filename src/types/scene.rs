//! A grasp scene: two 1-DOF fingers with soft tips that hold a rectangular object between them.
//!
//! SI units, planar, x right, y up. Angles are in radians and counter-clockwise, except the second
//! joint angle, which is clockwise, so that a positive angle closes either finger:
//!
//! ```text
//!      (-half_span, 0)          (+half_span, 0)
//!            o                        o            bases
//!           /                          \
//!          / link                       \
//!         /      +--------------+        \
//!        (O1     |   (x, y)     |     O2)           tips, object at (x, y, theta)
//!                +--------------+
//! ```

use crate::error::{ParamError, SceneError, UnknownName};
use crate::types::fingertip::{Fingertip, FingertipModel, at_least_zero, positive};
use crate::types::names;
use serde::{Deserialize, Serialize};
use std::str::FromStr;

/// PID gains of a joint: torque = -kp e - kd e' - ki (integral of e), with e = angle - desired
/// angle.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Gains {
    /// N m/rad.
    pub kp: f64,
    /// N m s/rad.
    pub kd: f64,
    /// N m/(rad s).
    pub ki: f64,
}

/// A finger; both, where they are alike.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Finger {
    /// Length l from the last joint to the centre of the tip (m).
    pub link: f64,
    /// Length of a first link, from the base to a second joint (m); none for a finger of one joint.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub upper: Option<f64>,
    /// Distance L_b of the joint from the middle between fingers that are alike (m): its place is
    /// (-L_b, lift) for the left finger, (L_b, lift) for the right one.
    pub half_span: f64,
    /// Height of the joint (m).
    pub lift: f64,
    /// Moment of inertia about the joint (kg m^2).
    pub inertia: f64,
    /// Joint control.
    pub gains: Gains,
    /// Whether the joint is locked at its first angle; then nothing is controlled.
    pub fixed: bool,
}

/// A right finger that is not like the left one.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Second {
    /// Its tip, of the same model.
    pub fingertip: Fingertip,
    /// Its link and joint.
    pub finger: Finger,
}

/// The object: a rigid rectangle.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Object {
    /// Side W across the grasp (m).
    pub width: f64,
    /// Side H along the faces (m).
    pub height: f64,
    /// Mass (kg).
    pub mass: f64,
    /// Moment of inertia about the centre (kg m^2).
    pub inertia: f64,
    /// Coefficient of friction of the tips; none = they never slide.
    pub friction: Option<f64>,
    /// Distance of the centre of mass from the fingers' plane (m): its moment about the face's
    /// normal takes a part of the friction.
    pub offset: f64,
}

/// The start: at rest in an equilibrium.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Initial {
    /// Normal displacement d_0 of both tips at joint angles 0 (m); equals radius + width / 2 -
    /// half_span.
    pub normal_displacement: f64,
    /// Joint angles at the start (rad), usually 0.
    pub joints: [f64; 2],
    /// Time before the first motion (s).
    pub rest: f64,
}

/// Which coordinates the equations of motion are written in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, Default)]
#[serde(rename_all = "kebab-case")]
pub enum Formulation {
    /// Pose and joint angles alone; displacements follow from them. Nothing can drift.
    #[default]
    Minimal,
    /// Displacements as coordinates of their own, Lagrange multipliers, and constraint
    /// stabilisation (the source's).
    Multipliers,
}

impl Formulation {
    /// Both, by the names used in files.
    pub const ALL: [(&'static str, Self); 2] = [("minimal", Self::Minimal), ("multipliers", Self::Multipliers)];

    /// The name used in files.
    pub fn name(self) -> &'static str {
        Self::ALL.iter().find(|(_, m)| *m == self).map_or("", |(name, _)| name)
    }
}

impl FromStr for Formulation {
    type Err = UnknownName;

    fn from_str(name: &str) -> Result<Self, UnknownName> {
        names::choose("formulation", name, &Self::ALL)
    }
}

/// How to step through time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, Default)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// Classical Runge-Kutta, order 4, fixed step.
    #[default]
    Rk4,
    /// Velocities first, then positions with the new velocities; order 1, fixed step.
    SemiImplicitEuler,
    /// Dormand-Prince 5(4) with step control, for reference.
    Adaptive,
}

impl Method {
    /// All of them, by the names used in files.
    pub const ALL: [(&'static str, Self); 3] =
        [("rk4", Self::Rk4), ("semi-implicit-euler", Self::SemiImplicitEuler), ("adaptive", Self::Adaptive)];

    /// The name used in files.
    pub fn name(self) -> &'static str {
        Self::ALL.iter().find(|(_, m)| *m == self).map_or("", |(name, _)| name)
    }
}

impl FromStr for Method {
    type Err = UnknownName;

    fn from_str(name: &str) -> Result<Self, UnknownName> {
        names::choose("integrator", name, &Self::ALL)
    }
}

/// Up to which level the rolling constraint is stabilised in the multiplier form.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, Default)]
#[serde(rename_all = "kebab-case")]
pub enum Rolling {
    /// Its integral too (it is integrable), like the normal constraint.
    #[default]
    Integrated,
    /// Its velocity alone, as in the source; its integral drifts.
    Velocity,
}

impl FromStr for Rolling {
    type Err = UnknownName;

    fn from_str(name: &str) -> Result<Self, UnknownName> {
        names::choose("rolling", name, &[("integrated", Self::Integrated), ("velocity", Self::Velocity)])
    }
}

/// Time stepping and what is written.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Integrator {
    /// How.
    pub method: Method,
    /// Step (s); the first step of the adaptive method.
    pub step: f64,
    /// Time between samples of the trajectory (s).
    pub output_every: f64,
    /// Coordinates.
    pub formulation: Formulation,
    /// Gain of the constraint stabilisation, multiplier form only (1/s): C'' + 2 g C' + g^2 C = 0.
    pub baumgarte: f64,
    /// Stabilisation of the rolling constraint, multiplier form only.
    pub rolling: Rolling,
    /// Tolerance of the adaptive method, relative to the size of each coordinate (1).
    pub tolerance: f64,
}

/// One joint-angle motion: a quintic to `target` and a hold.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Motion {
    /// Joint angles to reach (rad).
    pub target: [f64; 2],
    /// Time of the quintic (s).
    pub duration: f64,
    /// Time to hold (s).
    pub hold: f64,
}

/// A push on the object: a half-sine pulse.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Push {
    /// When it begins (s).
    pub start: f64,
    /// How long it lasts (s).
    pub duration: f64,
    /// Largest force (N), in the world frame.
    pub force: [f64; 2],
    /// Where it acts (m), in the object's frame from its centre.
    pub at: [f64; 2],
}

/// Everything that a run needs.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Scene {
    /// Both tips, or the left one.
    pub fingertip: Fingertip,
    /// Both fingers, or the left one.
    pub finger: Finger,
    /// The right finger, where it is not like the left one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub second: Option<Second>,
    /// What they hold.
    pub object: Object,
    /// The start.
    pub initial: Initial,
    /// Acceleration of gravity along y (m/s^2), -9.81 on earth.
    pub gravity: f64,
    /// Time stepping.
    pub integrator: Integrator,
    /// Motions one after the other.
    pub motions: Vec<Motion>,
    /// Pushes, at any time.
    pub pushes: Vec<Push>,
}

impl Finger {
    /// Checks every range.
    ///
    /// # Errors
    /// [`ParamError`] names the first value out of range.
    pub fn check(&self) -> Result<(), ParamError> {
        positive("finger.link", self.link, 10.0, "above 0 and at most 10 m (SI units: is it in mm?)")?;
        if let Some(upper) = self.upper {
            positive("finger.links", upper, 10.0, "above 0 and at most 10 m (SI units: is it in mm?)")?;
        }
        positive("finger.half_span", self.half_span, 10.0, "above 0 and at most 10 m")?;
        if self.lift.is_nan() || self.lift.abs() > 10.0 {
            return Err(ParamError { name: "finger.base", value: self.lift, range: "-10 to 10 m" });
        }
        positive("finger.inertia", self.inertia, 1e6, "above 0 kg m^2")?;
        at_least_zero("finger.gains.kp", self.gains.kp, "0 or more N m/rad")?;
        at_least_zero("finger.gains.kd", self.gains.kd, "0 or more N m s/rad")?;
        at_least_zero("finger.gains.ki", self.gains.ki, "0 or more N m/(rad s)")
    }
}

/// The eight motions of the source (degrees).
pub const EIGHT_MOTIONS: [[f64; 2]; 8] =
    [[6.0, 6.0], [20.0, -10.0], [-2.0, 13.0], [-10.0, 20.0], [-7.0, 17.0], [17.0, -7.0], [-15.0, 25.0], [5.0, 5.0]];

/// Most steps and most samples of one run, so that a slip of the pen does not run for days or fill
/// the memory.
const MAX_STEPS: f64 = 2e9;
const MAX_SAMPLES: f64 = 2e6;

impl Scene {
    /// Half the distance between the joints (m).
    pub fn half_span(&self) -> f64 {
        let [left, right] = self.bases();
        0.5 * (right[0] - left[0])
    }

    /// Both fingers, the left one first.
    pub fn fingers(&self) -> [&Finger; 2] {
        [&self.finger, self.second.as_ref().map_or(&self.finger, |s| &s.finger)]
    }

    /// Both tips, the left one first.
    pub fn fingertips(&self) -> [&Fingertip; 2] {
        [&self.fingertip, self.second.as_ref().map_or(&self.fingertip, |s| &s.fingertip)]
    }

    /// Places of both joints (m). Rigid tips cannot be pressed in, so their joints stand apart
    /// until they just touch.
    pub fn bases(&self) -> [[f64; 2]; 2] {
        let ([one, two], [a, b]) = (self.fingers(), self.fingertips());
        let span = |finger: &Finger, tip: &Fingertip| match tip.model {
            FingertipModel::Rigid => tip.radius + 0.5 * self.object.width,
            _ => finger.half_span,
        };
        [[-span(one, a), one.lift], [span(two, b), two.lift]]
    }

    /// The same with all moduli of the tips times `factor`.
    pub fn with_moduli(&self, factor: f64) -> Self {
        let mut scene = self.clone();
        scene.fingertip = scene.fingertip.scaled(factor);
        if let Some(second) = &mut scene.second {
            second.fingertip = second.fingertip.scaled(factor);
        }
        scene
    }

    /// The same with tips of another model; only tabulated ones stiffen.
    pub fn with_model(&self, model: FingertipModel) -> Self {
        let mut scene = self.clone();
        let tips = std::iter::once(&mut scene.fingertip).chain(scene.second.as_mut().map(|s| &mut s.fingertip));
        for tip in tips {
            tip.model = model;
            tip.stiffening = tip.stiffening.filter(|_| model == FingertipModel::Tabulated);
        }
        scene
    }

    /// The reference scene: eight motions of 0.5 s with 1 s of hold after 0.5 s of rest
    /// (docs/reference/grasp.md).
    ///
    /// ```
    /// use palpate::Scene;
    /// let scene = Scene::reference();
    /// assert_eq!(scene.motions.len(), 8);
    /// assert!(scene.check().is_ok());
    /// // Half a second of rest, then motions of 0.5 s with 1 s of hold each.
    /// assert!((scene.duration() - 12.5).abs() < 1e-9);
    /// ```
    pub fn reference() -> Self {
        let motion = |degrees: [f64; 2]| Motion { target: degrees.map(f64::to_radians), duration: 0.5, hold: 1.0 };
        Self {
            fingertip: Fingertip {
                radius: 0.020,
                youngs_modulus: 2.0e5,
                damping: [20.0, 20.0],
                model: FingertipModel::Parallel,
                maxwell: Vec::new(),
                stiffening: None,
                deviation: 0.0,
                bounds: None,
                profile: Vec::new(),
            },
            finger: Finger {
                link: 0.060,
                upper: None,
                half_span: 0.0485,
                lift: 0.0,
                inertia: 1.0e-3,
                gains: Gains { kp: 100.0, kd: 1.0, ki: 2000.0 },
                fixed: false,
            },
            object: Object {
                width: 0.060,
                height: 0.060,
                mass: 0.10,
                inertia: rectangle_inertia(0.10, 0.060, 0.060),
                friction: Some(1.0),
                offset: 0.0,
            },
            second: None,
            initial: Initial { normal_displacement: 0.0015, joints: [0.0; 2], rest: 0.5 },
            gravity: -9.81,
            integrator: Integrator {
                method: Method::Rk4,
                step: 1.0e-3,
                output_every: 0.01,
                formulation: Formulation::Minimal,
                baumgarte: 100.0,
                rolling: Rolling::Integrated,
                tolerance: 1e-10,
            },
            motions: EIGHT_MOTIONS.map(motion).to_vec(),
            pushes: Vec::new(),
        }
    }

    /// The same grasp of an object `width` wide (m): the joints move apart or together so that the
    /// tips keep their normal displacement, and the object keeps its density's inertia for its
    /// mass.
    pub fn with_width(mut self, width: f64) -> Self {
        self.object.width = width;
        self.object.inertia = rectangle_inertia(self.object.mass, width, self.object.height);
        self.finger.half_span = self.fingertip.radius + 0.5 * width - self.initial.normal_displacement;
        self
    }

    /// When the last motion or push is over (s).
    pub fn duration(&self) -> f64 {
        let motions: f64 = self.motions.iter().map(|m| m.duration + m.hold).sum();
        self.pushes.iter().map(|p| p.start + p.duration).fold(self.initial.rest + motions, f64::max)
    }

    /// Checks every range, and that the values go together.
    ///
    /// # Errors
    /// [`SceneError`] names the first value out of range, or those that do not go together.
    ///
    /// ```
    /// use palpate::Scene;
    /// let mut scene = Scene::reference();
    /// scene.object.mass = -1.0;
    /// assert!(scene.check().unwrap_err().to_string().contains("mass"));
    /// ```
    pub fn check(&self) -> Result<(), SceneError> {
        let Self { fingertip, object, initial, integrator, .. } = self;
        self.fingertips().into_iter().try_for_each(Fingertip::check)?;
        self.fingers().into_iter().try_for_each(Finger::check)?;
        positive("object.width", object.width, 10.0, "above 0 and at most 10 m")?;
        positive("object.height", object.height, 10.0, "above 0 and at most 10 m")?;
        positive("object.mass", object.mass, 1e6, "above 0 kg")?;
        positive("object.inertia", object.inertia, 1e6, "above 0 kg m^2")?;
        if let Some(friction) = object.friction {
            positive("object.friction", friction, f64::MAX, "above 0; leave it out for tips that never slide")?;
        }
        if !(0.0..=10.0).contains(&object.offset) {
            return Err(ParamError { name: "object.offset", value: object.offset, range: "0 to 10 m" }.into());
        }
        let depth = initial.normal_displacement;
        if !(depth > 0.0 && depth < fingertip.radius) {
            let range = "above 0 and under the fingertip's radius";
            return Err(ParamError { name: "initial.normal_displacement", value: depth, range }.into());
        }
        at_least_zero("initial.rest", initial.rest, "0 or more s")?;
        if !(-1000.0..=1000.0).contains(&self.gravity) {
            return Err(ParamError { name: "gravity.y", value: self.gravity, range: "-1000 to 1000 m/s^2" }.into());
        }
        positive("integrator.step", integrator.step, 1.0, "above 0 and at most 1 s")?;
        if !(integrator.output_every >= integrator.step && integrator.output_every.is_finite()) {
            let range = "at least integrator.step";
            return Err(ParamError { name: "integrator.output_every", value: integrator.output_every, range }.into());
        }
        positive("integrator.baumgarte", integrator.baumgarte, 1e9, "above 0 1/s")?;
        if !(1e-14..=1e-2).contains(&integrator.tolerance) {
            let range = "1e-14 to 0.01";
            return Err(ParamError { name: "integrator.tolerance", value: integrator.tolerance, range }.into());
        }
        for angle in initial.joints {
            small_angle("initial.theta", angle)?;
        }
        for motion in &self.motions {
            positive("motion.move", motion.duration, 1e6, "above 0 s")?;
            at_least_zero("motion.hold", motion.hold, "0 or more s")?;
            for angle in motion.target {
                small_angle("motion.theta", angle)?;
            }
        }
        for push in &self.pushes {
            at_least_zero("push.start", push.start, "0 or more s")?;
            positive("push.duration", push.duration, 1e6, "above 0 s")?;
            for (name, value) in
                push.force.map(|f| ("push.force", f)).into_iter().chain(push.at.map(|p| ("push.at", p)))
            {
                if !value.is_finite() {
                    return Err(ParamError { name, value, range: "a finite number" }.into());
                }
            }
        }
        let ([a, b], [one, two]) = (self.fingertips(), self.fingers());
        let half_span = 0.5 * (one.half_span + two.half_span);
        let by_geometry = 0.5 * (a.radius + b.radius + object.width) - half_span;
        if (by_geometry - depth).abs() > 1e-9 {
            return Err(SceneError::Geometry { half_span, depth, by_geometry });
        }
        let fixed = one.fixed && two.fixed;
        if fixed && !self.motions.is_empty() {
            return Err(SceneError::FixedMotion);
        }
        let relaxes = self.fingertips().iter().any(|t| !t.maxwell.is_empty());
        if relaxes && (integrator.formulation == Formulation::Multipliers || fingertip.model == FingertipModel::Rigid) {
            return Err(SceneError::Relaxing);
        }
        if self.fingertips().iter().any(|t| t.stiffening.is_some()) && fingertip.model != FingertipModel::Tabulated {
            return Err(SceneError::Stiffening { model: fingertip.model.name() });
        }
        if fingertip.model == FingertipModel::Rigid {
            if fixed {
                return Err(SceneError::NothingMoves);
            }
            if initial.joints != [0.0; 2] {
                return Err(SceneError::RigidStart);
            }
        }
        let duration = self.duration();
        if duration / integrator.step > MAX_STEPS || duration / integrator.output_every > MAX_SAMPLES {
            return Err(SceneError::TooLong { duration });
        }
        Ok(())
    }
}

/// A joint angle (rad) must lie within a right angle.
fn small_angle(name: &'static str, angle: f64) -> Result<(), ParamError> {
    if angle.abs() < std::f64::consts::FRAC_PI_2 {
        return Ok(());
    }
    // As it was written in degrees, without the rounding of there and back.
    Err(ParamError { name, value: (angle.to_degrees() * 1e9).round() / 1e9, range: "-90 to 90 degrees" })
}

/// Moment of inertia of a rectangle about its centre (kg m^2), from its mass (kg) and sides (m).
pub fn rectangle_inertia(mass: f64, width: f64, height: f64) -> f64 {
    mass * (width * width + height * height) / 12.0
}

/// One scene of an ensemble, with the values that set it apart, as (key, value as written).
#[derive(Debug, Clone, PartialEq)]
pub struct SweepCase {
    /// Keys such as `object.mass`, with their values.
    pub values: Vec<(String, String)>,
    /// The scene with these values.
    pub scene: Scene,
}
