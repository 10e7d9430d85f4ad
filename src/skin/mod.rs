//! Layered skin: rheological elements in a column, and in a block under a punch.
//!
//! [`mod@column`] is exact: the laws are linear between the corners of the load, so the matrix
//! exponential solves them, however stiff. [`block`] is a plane-strain finite element model with
//! the same laws; `single` is one layer in place of several that are not alike.

pub mod block;

pub mod column;

pub(crate) mod single;

mod exponential;
