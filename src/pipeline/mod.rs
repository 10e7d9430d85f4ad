//! The chains of stages that a library user calls.
//!
//! [`field`] is the page to read first: it calls the stages in order and times them. `level`
//! holds what is done on one level of the pyramid, `input_checks` what is refused before any
//! work, [`dry_run`] what a run would do; [`grasp`] is the grasp simulator's page.

pub mod field;

mod level;

mod input_checks;

pub mod known;

pub mod start;

mod stages;

pub mod dry_run;

pub mod grasp;

pub mod fingertip;

pub mod skin;

pub mod track;

pub mod strain;

pub mod certify;

pub mod stiffness;

pub mod stiffness_sequence;

pub mod boundary;

pub mod experimental_design;

pub mod cpu;

pub mod speed_accuracy;

pub mod compression_phantoms;

pub mod robustness;

mod background;
mod bodies;
mod body_meshes;
mod body_models;
mod brightness;
mod clock;
mod coarse_to_fine;
mod contrast;
mod field_warnings;
mod hypotheses;
mod landmarks;
mod last_passes;
mod local_model;
mod match_mesh;
mod refinement;
mod sparse;
mod stiffness_regions;
mod temporal_outliers;
mod temporal_pca;
mod uncertainty;
