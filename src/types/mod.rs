//! Data only: geometry, volumes, points, fields, meshes, parameters, metrics.
//!
//! Every constructor checks what it is given, so that a value that exists is valid. Nothing here computes more than
//! its own geometry, opens a file or prints. Frames: a [`VoxelPoint`] counts voxels (centre of the first voxel =
//! `(0, 0, 0)`), a [`WorldPoint`] is in millimetres, RAS (x to the right, y to the front, z up), as in NIfTI.

pub mod space;

pub mod volume;

pub mod points;

pub mod field;

pub mod mesh;

pub mod params;

pub mod metrics;

pub mod result;

pub mod names;

pub use field::DenseField;
pub use mesh::{TetMesh, TriMesh};
pub use metrics::Metrics;
pub use params::FieldParams;
pub use points::{FeaturePoint, Landmark, Match, SparseField};
pub use result::{Counts, FieldResult, FieldSummary, LevelReport, Mesh, MotionModel};
pub use space::{Affine, Grid, VoxelPoint, WorldPoint};
pub use volume::{Mask, Volume};
