//! Results as text, JSON, SVG and HTML: pure functions from data to strings and bytes.
//!
//! Pictures show the grid in the nearest canonical orientation (right of the picture = right or
//! front of the patient, top = front or head), with true proportions in mm. Nothing here opens a
//! file or prints. Volumes given together must lie on one grid; where they do not, pictures are of
//! what lies at the same offsets.

pub mod colormap;

pub mod scale;

pub mod statistics;

pub(crate) mod section;

mod picture;

mod drawing;

pub mod node_plot;

pub(crate) mod batch;

pub(crate) mod chain;

mod chart;

pub mod figure;

pub(crate) mod verdict;

pub(crate) mod panels;

mod views;

pub mod viewer;

pub mod field;

mod tables;

pub mod html;

pub(crate) mod record;

pub(crate) mod text;

pub(crate) mod json;

pub mod plot;

pub mod skin;

pub mod info;

pub(crate) mod animation;

pub mod track;

mod grasp_measured;

mod grasp_scene;

pub mod grasp;

mod grasp_surface;

pub(crate) mod grasp_analysis;

pub mod strain;

pub mod certify;

pub mod plan;

pub mod stiffness;

mod axes;

pub mod frontier;

pub mod robustness;

pub(crate) use field::FieldReport;
pub use grasp::GraspReport;
