//! Grasp and skin: the simulator, its commands and measured data.
#![allow(clippy::unwrap_used)]

#[path = "../fixtures/mod.rs"]
mod fixtures;
mod grasp;
mod grasp_cli;
mod grasp_measured;
mod skin;
