//! Dense displacement fields: interpolation from a mesh, Jacobian, inverse, composition, warping.

pub mod interpolation;

pub(crate) mod spline;

pub mod jacobian;

pub mod inverse;

pub mod composition;

pub mod warp;
