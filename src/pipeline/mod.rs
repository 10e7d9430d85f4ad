//! The chains of stages that a library user calls.
//!
//! [`field`] is the page to read first: it calls the stages in order and times them. [`level`]
//! holds what is done on one level of the pyramid, [`check`] what is refused before any work,
//! [`plan`] what a run would do; [`grasp`] is the grasp simulator's page.

pub mod field;

pub mod level;

pub mod check;

pub mod known;

pub mod start;

pub mod stages;

pub mod plan;

pub mod grasp;

pub mod fingertip;

pub mod skin;

pub mod track;

pub mod strain;

pub mod certify;

pub mod stiffness;

pub mod stiffness_sequence;

pub mod boundary;

pub mod planning;

pub mod cpu;

pub mod trials;

pub mod pressed;

pub mod stress;

mod background;
mod bodies;
mod conclusion;
mod contrast;
mod course;
mod finer;
mod hypotheses;
mod landmarks;
mod light;
mod modes;
mod polish;
mod rest;
mod search;
mod sparse;
mod uncertainty;
