//! Young's modulus from a displacement field: finite elements, identification, uncertainty, choice
//! of model.
//!
//! Promises: exact sensitivities; results that do not depend on the number of threads; a region
//! that the data cannot see is said to be so. Needs a mesh whose elements lie in one region each, a
//! field that covers it, and two patches of the surface that move against each other. Fails with a
//! [`StiffnessError`](crate::error::StiffnessError).

pub mod elements;

pub mod law;

pub mod body;

pub mod forward;

pub mod krylov;

pub mod saddle;

pub mod tangent;

pub mod observations;

pub mod patches;

pub mod plate;

pub mod smoothed;

pub mod rim;

pub mod identify;

pub mod level;

pub mod choice;

pub mod summary;

pub mod verdict;

pub mod maps;

pub mod sequence;

pub mod unlabelled;

pub mod support;

pub mod geometry;

pub mod coherent;

pub mod edge;

pub mod border;

pub mod inclusion;

pub mod interface;

pub mod turn;
