//! The chains of stages that a library user calls.

pub mod field;
