//! Young's modulus from a displacement field: finite elements, identification, uncertainty, choice
//! of model.
//!
//! Promises: exact sensitivities; results that do not depend on the number of threads; a region
//! that the data cannot see is marked. Needs a mesh whose elements lie in one region each, a
//! field that covers it, and two patches of the surface that move against each other. Fails with a
//! [`StiffnessError`](crate::error::StiffnessError).

pub(crate) mod elements;

pub mod law;

pub mod fem_body;

pub mod forward;

mod krylov;

mod saddle;

mod tangent;

pub mod observations;

pub mod boundary_conditions;

pub(crate) mod contact;

mod patch_motion;

pub(crate) mod indenter_outline;

pub mod identify;

pub mod mesh_problem;

pub mod model_selection;

pub(crate) mod summary;

pub(crate) mod verdict;

pub mod fields;

pub(crate) mod sequence;

pub(crate) mod unlabelled;

pub(crate) mod support;

pub mod geometry;

pub(crate) mod systematic_error;

mod punch_edge;

mod border;

pub(crate) mod inclusion;

pub(crate) mod interface;

pub(crate) mod rigid_rotation;
