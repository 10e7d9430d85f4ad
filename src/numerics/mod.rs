//! Numerical tools that every stage may use: filters, sampling, splines, small dense algebra,
//! sparse solves.
//!
//! Everything here works on plain slices with x fastest and gives the same bits for any number of
//! threads: work is cut into pieces by the data's shape alone, and sums are taken in a fixed order.
//! Inner loops are plain multiplies and adds that the compiler vectorises for the machine at hand
//! ([`simd::dispatch`]).

pub mod simd;

pub mod filters;

pub mod differences;

pub mod sampling;

pub mod orientation;

pub mod pyramid;

pub mod symmetric3;

pub mod eigen;

pub mod bspline;
pub mod cubic;
mod multilevel;

pub mod ablation;

pub mod banded;

pub mod block_diagonal;

pub mod bending;

pub mod statistics;

pub mod surface;

pub mod tetrahedron;

pub mod random;

pub mod neighbours;

pub mod dense;

mod partial_refactorisation;
pub mod sparse;

pub mod cholesky;

pub mod exponential;
pub mod fold_removal;
pub mod inversion;
pub mod label_detection;
pub mod trig;
