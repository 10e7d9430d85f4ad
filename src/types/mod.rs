//! Data only: geometry, volumes, points, fields, meshes, parameters, metrics, grasp scenes.
//!
//! Every constructor checks what it is given, so that a value that exists is valid. Nothing here
//! computes more than its own geometry, opens a file or prints. Frames: a [`VoxelPoint`] counts
//! voxels (centre of the first voxel = `(0, 0, 0)`), a [`WorldPoint`] is in millimetres, RAS (x to
//! the right, y to the front, z up), as in NIfTI.

pub mod space;

pub mod volume;

pub(crate) mod points;

pub mod field;

pub mod mesh;

pub mod params;

pub mod metrics;

mod certificate;

mod expected;

pub(crate) mod record;

mod result;

mod samples;

pub mod strain;

pub mod track;

mod transform;

pub(crate) mod names;

pub mod stiffness;

mod solid;

pub mod plan;

pub mod fingertip;

pub mod scene;

pub mod grasp;

pub mod measured;

pub mod skin;

mod trial;

pub mod batch;

pub use certificate::{Certificate, Gain, GaugeNoise, Imposed};
pub use expected::{ErrorSource, ExpectedError, LabelError, Trust};
pub use field::{DenseField, Displacement};
pub use fingertip::{Fingertip, FingertipModel};
pub use mesh::{QuadraticMesh, TetMesh, TriMesh};
pub use metrics::{
    Distances, InverseConsistency, LabelScore, LabelScores, LandmarkError, Metrics, Overlap, TargetError,
};
pub use params::FieldParams;
pub use points::{Candidate, FeaturePoint, Landmark, Match, RawMatch, SparseField};
pub use result::{
    Agreement, BodyReport, Counts, FieldSummary, LandmarkReport, LevelReport, Mesh, MotionModel, StageReport,
    StartReport,
};
pub use samples::ErrorSamples;
pub use scene::Scene;
pub use solid::{ElementModulus, Measured, MeasuredNode, SolidElement, SolidMesh, SolidShape};
pub use space::{Affine, Grid, GridVector, VoxelPoint, WorldPoint};
pub use stiffness::{StiffnessParams, StiffnessResult};
pub use strain::{GaugeTrial, RegionStrain, StrainMeasure, StrainSummary};
pub use track::{FrameSummary, Place, PointState, StrainRow, Together, Tracked, Trajectory};
pub use transform::{AffineMap, Transform};
pub use trial::{Part, Standing, Stated, StressCurve, StressRun, Trial};
pub use volume::{Mask, Volume, Voxels};
