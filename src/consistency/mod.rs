//! Which matches agree with each other.

pub mod coupling;
