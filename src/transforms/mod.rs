//! Transforms one after the other, and images carried along them in one interpolation.
//!
//! A transform maps a world point (mm, RAS) of the initial (fixed) volume to the deformed (moving)
//! one, so an image is pulled by it and a point pushed. A chain lists its transforms in the order
//! in which a point travels: the first listed comes first, as in `antsApplyTransforms` and
//! `greedy -r`.

mod chain;

pub mod resample;

pub use chain::Chain;
