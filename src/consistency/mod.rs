//! Which matches agree with each other.
//!
//! [`energy`] states what is minimised, [`relaxation`] chooses one candidate of each place by it,
//! [`coupling`] fits a smooth field to all of them with their own information matrices, [`pruning`]
//! drops those that the field and their neighbours contradict, and [`models`] asks for the smallest
//! motion that explains the rest. `grouping` finds matches that move as another body. Fails (and
//! says so by few survivors) where most candidates are wrong in a consistent way, as with
//! repetitive texture.

pub mod energy;

pub mod relaxation;

pub mod coupling;

pub mod pruning;

pub mod models;

pub(crate) mod grouping;
