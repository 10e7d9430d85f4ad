//! The project itself: layers, habits of the command line, licences.
#![allow(clippy::unwrap_used)]

#[path = "../fixtures/mod.rs"]
mod fixtures;
mod habits;
mod layering;
mod supply;
