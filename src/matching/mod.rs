//! Correspondence: which place of the deformed volume shows the tissue of a place of the initial
//! one.
//!
//! [`correlation`] searches by normalised cross-correlation, [`candidates`] joins searches and
//! feature pairs into many-to-many candidates, [`least_squares_matching`] brings a candidate to
//! sub-voxel precision with a covariance, and [`residual`] turns the whole remaining difference of
//! the two volumes into normal equations for a spline field.
//!
//! Positions are voxels of one common lattice (the initial volume's axes on the level at hand);
//! displacements are millimetres along those axes unless a name says voxels. What leads on to a
//! field is a [`GridVector`](crate::types::GridVector). Fails quietly where
//! there is no texture: the information matrices are then near zero and the coupling decides.

pub mod pair;

pub mod levels;

pub mod correlation;

pub mod candidates;

pub mod least_squares_matching;

pub mod brightness;

pub(crate) mod contrast;

pub mod gain;

pub mod residual;
