//! numerics.

pub mod differences;

pub mod sampling;

pub mod statistics;
