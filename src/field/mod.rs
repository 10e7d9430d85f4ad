//! field.

pub mod composition;

pub mod inverse;

pub mod jacobian;

pub mod warp;
