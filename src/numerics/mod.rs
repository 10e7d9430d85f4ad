//! Numerical tools that every stage may use: filters, sampling, splines, small dense algebra,
//! sparse solves.
//!
//! Everything here works on plain slices with x fastest and gives the same bits for any number of
//! threads: work is cut into pieces by the data's shape alone, and sums are taken in a fixed order.
//! Inner loops are plain multiplies and adds that the compiler vectorises for the machine at hand
//! (`simd::dispatch`).

pub(crate) mod simd;

pub mod filters;

pub mod differences;

pub mod sampling;

pub mod orientation;

pub mod pyramid;

pub mod symmetric3;

pub(crate) mod eigen;

pub mod bspline;
pub(crate) mod cubic;
mod multilevel;

pub(crate) mod ablation;

pub(crate) mod banded;

pub mod block_diagonal;

pub mod bending;

pub mod statistics;

pub(crate) mod surface;

pub mod tetrahedron;

pub mod random;

pub mod neighbours;

pub mod dense;

mod partial_refactorisation;
pub(crate) mod sparse;

pub(crate) mod cholesky;

pub(crate) mod exponential;
pub(crate) mod fold_removal;
pub(crate) mod inversion;
pub mod label_detection;
pub(crate) mod trig;
