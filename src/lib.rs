//! `palpate` measures how soft tissue deforms inside from a pair of MR volumes, and simulates
//! soft-finger grasps.
//!
//! The modules stand in the order of the pipeline.

// `cli` uses what any other program would.
extern crate self as palpate;

pub mod error;

pub mod types;

pub mod numerics;

pub mod io;

pub mod features;

pub mod matching;

pub mod consistency;

pub mod mesh;

pub mod field;

pub mod transforms;

pub mod strain;

pub mod stiffness;

pub mod fingertip;

pub mod grasp;

pub mod skin;

pub mod synth;

pub mod evaluate;

pub mod report;

pub mod pipeline;

#[doc(hidden)]
pub mod cli;

#[cfg(feature = "python")]
mod python;
