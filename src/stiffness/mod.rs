//! Young's modulus from a displacement field: finite elements, identification, uncertainty, choice
//! of model.
//!
//! Promises: exact sensitivities; results that do not depend on the number of threads; a region
//! that the data cannot see is marked. Needs a mesh whose elements lie in one region each, a
//! field that covers it, and two patches of the surface that move against each other. Fails with a
//! [`StiffnessError`](crate::error::StiffnessError).

pub mod elements;

pub mod law;

pub mod fem_body;

pub mod forward;

pub mod krylov;

pub mod saddle;

pub mod tangent;

pub mod observations;

pub mod boundary_conditions;

pub mod contact;

pub mod patch_motion;

pub mod indenter_outline;

pub mod identify;

pub mod mesh_problem;

pub mod model_selection;

pub mod summary;

pub mod verdict;

pub mod fields;

pub mod sequence;

pub mod unlabelled;

pub mod support;

pub mod geometry;

pub mod systematic_error;

pub mod punch_edge;

pub mod border;

pub mod inclusion;

pub mod interface;

pub mod rigid_rotation;
