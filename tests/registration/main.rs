//! Registration: features to fields, their errors, strain, sequences and synthetic scenes.
#![allow(clippy::unwrap_used)]

mod bodies;
mod consistency;
mod evaluate;
mod expected_error;
mod features;
mod field;
mod field_ops;
#[path = "../fixtures/mod.rs"]
mod fixtures;
mod geometry;
mod interpolation;
mod known;
mod matching;
mod numbers;
mod phantom;
mod scenes;
mod severity;
mod sparse;
mod stability;
mod storage;
mod strain;
mod synthetic_data;
#[path = "../fixtures/texture.rs"]
mod texture;
mod track;
#[path = "../fixtures/truth.rs"]
mod truth;
