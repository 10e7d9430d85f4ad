//! The command line, from end to end.
#![allow(clippy::unwrap_used)]

mod batch;
mod certify;
mod cli;
mod examples;
#[path = "../fixtures/mod.rs"]
mod fixtures;
mod known_cli;
mod repeat;
mod slicer;
mod stiffness_cli;
mod track_cli;
mod trust;
mod viewer;
