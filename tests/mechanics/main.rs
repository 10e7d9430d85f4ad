//! Meshes, solvers, stiffness and fingertips.
#![allow(clippy::unwrap_used)]

mod delaunay;
mod fingertip;
#[path = "../fixtures/mod.rs"]
mod fixtures;
mod numerics;
mod phantom_elastic;
mod plan;
mod solid_mesh;
mod solver;
mod stiffness;
mod stiffness_mesh;
#[path = "../fixtures/truth.rs"]
mod truth;
