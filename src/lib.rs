//! `palpate` measures how soft tissue deforms inside from a pair of MR volumes, and simulates
//! soft-finger grasps.
//!
//! The chain leads from two volumes to a grasp, and each step can be used alone:
//!
//! - volumes to a displacement field: [`pipeline::field::run`], with its uncertainty;
//! - a sequence to a field a frame: [`pipeline::track::run`];
//! - field to strain: [`pipeline::strain::run`], with its deviation;
//! - field to Young's modulus of each region: [`pipeline::stiffness::run`];
//! - stiffness to a fingertip, springs on a back plate: [`pipeline::fingertip::run`];
//! - fingertip to a grasp by two soft fingers: [`pipeline::grasp::run`];
//! - layered skin, and what a press leaves behind: [`pipeline::skin::run`];
//! - before the scan: [`pipeline::experimental_design::run`] chooses the press, and
//!   [`pipeline::certify::run`] states what a scan can show.
//!
//! Reasons and runtimes go to the crate `log` at the level debug, as they come.
//!
//! # Frames and units
//!
//! A [`VoxelPoint`] counts voxels, a [`WorldPoint`] is in world mm (RAS), and a [`Grid`] leads from
//! one to the other. A plain `[f64; 3]` displacement is in world mm, from the initial to the
//! deformed place. Matching works along the axes of the initial grid: its displacements are a
//! [`GridVector`], and [`Grid::vector_to_world`] converts them. Moduli of tissue are in kPa. The
//! grasp and skin scenes are in SI units.
//!
//! # Volumes to field
//!
//! [`io::read_volume`] reads a scan; here a phantom stands in, whose motion is known.
//!
//! ```
//! use palpate::synth::MotionKind;
//! use palpate::{FieldParams, PhantomKind, PhantomParams, evaluate, phantom, pipeline};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let block = PhantomParams::new(PhantomKind::Block).sized(24).moving(MotionKind::Translate);
//! let pair = phantom(&block)?;
//! let params = FieldParams::default();
//! let found =
//!     pipeline::field::run(&pair.initial, &pair.deformed, Some(&pair.mask), &params, &|_, _| {})?;
//!
//! let score = evaluate::metrics(&found.displacement, &pair.truth, Some(&pair.mask), &[])?;
//! assert!(score.mean_mm < 0.1 * score.identity_mm);
//! # Ok(())
//! # }
//! ```
//!
//! # Field to strain
//!
//! ```
//! use palpate::{Affine, DenseField, Grid, Mask, StrainInput, StrainParams, pipeline};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let grid = Grid::new([16; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
//! let field = DenseField::from_fn(grid, |p| [0.0, 0.0, -0.05 * p.0[2]]);
//! let bodies = Mask::filled(grid, 1);
//! let input =
//!     StrainInput { field: &field, bodies: &bodies, labels: None, samples: None, trust: None };
//! let strain = pipeline::strain::run(input, &StrainParams::default(), &|_, _| {})?.strain;
//! // Green-Lagrange: (0.95^2 - 1) / 2.
//! assert!((strain.principal(grid.index(8, 8, 8))[2] + 0.04875).abs() < 1e-5);
//! # Ok(())
//! # }
//! ```
//!
//! [`StrainInput::of`] takes a [`FieldResult`] with all that is known of its error.
//!
//! # Stiffness to fingertip
//!
//! ```
//! use palpate::{Affine, Grid, Volume, pipeline};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! // Eight millimetres of tissue of 40 kPa in front of a bone.
//! let grid = Grid::new([10, 10, 12], Affine::scaled([1.0; 3], [0.0; 3])?)?;
//! let map = Volume::from_voxels(grid, |_, p| if p.0[2] < 8.0 { 40.0 } else { 15_000.0 });
//! let is_bone = |offset: usize| map.as_slice()[offset] > 10_000.0;
//! let pad = pipeline::fingertip::run(&map, is_bone, [0.0, 0.0, -1.0], Some(1.0))?.pad;
//! assert!((pad.effective_kpa - 40.0).abs() < 1e-6);
//! # Ok(())
//! # }
//! ```
//!
//! # Fingertip to grasp
//!
//! ```
//! use palpate::{Fingertip, FingertipModel, Scene, pipeline};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let mut scene = Scene::reference();
//! scene.motions.truncate(1);
//! let tip = &scene.fingertip;
//! scene.fingertip = Fingertip::new(
//!     tip.radius,
//!     1.2 * tip.youngs_modulus,
//!     tip.damping,
//!     FingertipModel::Parallel,
//! )?;
//! let outcome = pipeline::grasp::run(&scene, &|_, _| {})?;
//! assert_eq!(outcome.run.outcome(), "held");
//! # Ok(())
//! # }
//! ```
//!
//! # Steps of one's own
//!
//! The stages below the pipeline are public too: [`features::detect`],
//! [`matching::candidates::between`], [`consistency::relaxation::relax`],
//! [`mesh::delaunay3::delaunay3`] and [`field::interpolation::interpolate_tetrahedra`] are the
//! source's chain. `examples/seed_chain.rs` joins them; `examples/own_similarity.rs`
//! ([`matching::candidates::Similarity`]) and `examples/own_matches.rs` replace one of them.
//! `examples/initial_field.rs` begins with one's own matches ([`pipeline::known::InitialField`]).
//!
//! The modules stand in the order of the pipeline. The errors of [`error`] say what to do.

// `cli` uses what any other program would.
extern crate self as palpate;

pub mod error;

pub mod types;

pub mod numerics;

pub mod io;

pub mod features;

pub mod matching;

pub mod consistency;

pub mod mesh;

pub mod field;

pub mod transforms;

pub mod strain;

pub mod stiffness;

pub mod fingertip;

pub mod grasp;

pub mod skin;

pub mod synth;

pub mod evaluate;

pub mod report;

pub mod pipeline;

#[doc(hidden)]
pub mod cli;

#[cfg(feature = "python")]
mod python;

pub use error::{
    FieldError, FingertipError, GraspError, IoError, MeshError, ParamError, SceneError, SpaceError, StiffnessError,
    StrainError, SynthError,
};
pub use pipeline::field::FieldResult;
pub use pipeline::strain::{StrainInput, StrainParams, StrainResult};
pub use stiffness::boundary_conditions::Place;
pub use synth::phantom::phantom;
pub use synth::{Phantom, PhantomKind, PhantomParams};
pub use types::{
    Affine, AffineMap, Candidate, DenseField, ErrorSamples, FeaturePoint, FieldParams, FieldSummary, Fingertip,
    FingertipModel, Grid, GridVector, Landmark, Mask, Match, Metrics, MotionModel, Scene, SparseField, StiffnessParams,
    StiffnessResult, StrainMeasure, TetMesh, TriMesh, Trust, Volume, VoxelPoint, Voxels, WorldPoint,
};
