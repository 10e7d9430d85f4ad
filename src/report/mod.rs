//! Results as text, JSON, SVG and HTML: pure functions from data to strings and bytes.
//!
//! Pictures show the grid in the nearest canonical orientation (right of the picture = right or
//! front of the patient, top = front or head), with true proportions in mm. Nothing here opens a
//! file or prints. Volumes given together must lie on one grid; where they do not, pictures are of
//! what lies at the same offsets.

pub mod colormap;

pub mod scale;

pub mod statistics;

pub mod section;

pub mod picture;

pub mod drawing;

pub mod node_plot;

pub mod batch;

pub mod chain;

mod chart;

pub mod figure;

pub mod verdict;

pub mod panels;

pub mod views;

pub mod viewer;

pub mod field;

mod tables;

pub mod html;

pub mod record;

pub mod text;

pub mod json;

pub mod plot;

pub mod skin;

pub mod info;

pub mod animation;

pub mod track;

pub mod grasp_measured;

pub mod grasp_scene;

pub mod grasp;

pub mod grasp_surface;

pub mod grasp_analysis;

pub mod strain;

pub mod certify;

pub mod plan;

pub mod stiffness;

pub mod axes;

pub mod frontier;

pub mod robustness;

pub use field::FieldReport;
pub use grasp::GraspReport;
