//! field.

pub mod interpolation;
