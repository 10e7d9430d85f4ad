//! Distinct places of a volume: the 3D Harris corner measure with an even spread.
//!
//! Needs texture: a constant volume has no features, which the caller must report. Positions are
//! sub-voxel.

pub mod harris;

pub mod suppression;

pub use harris::{HarrisParams, block_response, response};
pub use suppression::{Corner, corners, spread};
