//! The soft-finger grasp simulator: two 1-DOF fingers with soft tips that hold a rectangular
//! object.
//!
//! Source: S. Hirai, "How Softness Contributes to Human Dexterity" (slides, with T. Inoue);
//! docs/reference/grasp.md has every equation and two signs of the slides that had to be settled.
//! Order: [`models`] (fingertips), [`constraints`] (where they touch), [`statics`] (equilibria),
//! [`control`], [`dynamics`] (forces), [`minimal`] and [`multipliers`] (equations of motion),
//! `relaxing` (tips that relax), `friction` and `sliding` (tips that slide), [`integrators`],
//! [`stepping`] (which step is stable), `run_checks` and `equilibrium_branch` (what can fail),
//! [`simulate`] (the loop), then the analyses: [`stability`], [`degrees_of_freedom`], [`pinch`],
//! `posture`, [`measured`].
//!
//! Promises: SI units and radians everywhere; the same bits for the same scene; the object's pose
//! is never fed back. Needs a scene that passes [`crate::types::Scene::check`]. Fails by name:
//! every [`crate::types::grasp::EventKind`] is detected in the step where it happens. A run ends
//! where contact is lost, a step is too long, or the state is not finite; else it goes on.

pub mod models;

pub mod tabulated;

pub mod constraints;

pub mod statics;

pub mod control;

pub mod dynamics;

pub mod minimal;

mod relaxing;

mod friction;

mod sliding;

pub mod multipliers;

pub mod integrators;

pub mod stepping;

mod run_checks;

mod equilibrium_branch;

pub mod simulate;

pub mod stability;

pub mod degrees_of_freedom;

pub mod pinch;

pub(crate) mod posture;

pub mod measured;
