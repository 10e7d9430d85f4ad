//! Elastic phantoms: a body of known Young's modulus, pressed, with its displacement solved.
//!
//! The solver shares nothing with the one that identifies stiffness: triquadratic hexahedra with a
//! linear pressure, fitted to the regions and refined until the change from one level to the next
//! is a few micrometres; a matrix-free Newton method with multigrid. The displacement is that of
//! the elements, everywhere; images are drawn through its inverse. Fails where the body is pressed
//! too far to find an equilibrium.

pub mod blocks;

mod coarse;

pub mod hexahedra;

mod locate;

pub mod material;

mod multigrid;

pub mod newton;

mod press;

pub mod quadratic;

pub mod space;

mod tangent;

pub mod tissue;

mod transfer;

mod vectors;

pub use press::{ElasticDescription, Pressed, press};
