//! Files in and out: the only stage that opens one.
//!
//! Promises: every error names the file, what is wrong and what to try; no header can make it
//! allocate more than the file could hold; nothing half-written ever stands under a final name
//! (each file is written under a temporary name in the same folder, then renamed; [`OutputFolder`]
//! does the same for a whole folder). Nothing here prints.

pub mod image;

pub mod field;

pub mod nifti;

mod chain_errors;

mod nrrd;

mod metaimage;

mod dicom;

mod source;

mod raw;

mod raw_write;

mod voxels;

mod format_error;

pub mod csv;

pub mod markups;

pub mod vtu;

pub mod scene;

pub mod config;

pub mod grasp;

pub mod measured;

pub mod fingertip;

pub mod skin;

pub mod track;

pub mod transform;

pub mod strain;

pub mod stiffness;

mod simulators;

pub mod sofa;

pub mod mujoco;

pub mod solid;

pub mod speed_accuracy;

pub mod batch;

pub mod bids;

pub mod text;

pub mod output;

pub mod scratch;

mod temporary_files;

mod file_kind;

pub mod memory;

mod atomic;

mod deflate;

mod digest;

mod gzip;

pub use batch::{make_folder, read_pairs, stamp, write_rows};
pub use bids::{describe_derivative, is_bids, read_bids, write_derivative};
pub use chain_errors::write_chain;
pub use config::read_config;
pub use csv::{
    PointTable, TableKind, read_landmark_frames, read_landmark_pair, read_landmarks, read_matches, read_points,
    stored_matches, table_kind, write_landmarks, write_matches, write_points,
};
pub use dicom::{Series as DicomSeries, series_in};
pub use digest::{digest, files_of};
pub use field::{FieldConvention, read_field, read_field_as, read_samples};
pub use file_kind::{Form, columns_of, form_of};
pub use fingertip::{read_fingertip_modulus, read_fingertip_press, read_stiffness, stiffness_folder, write_fingertip};
pub use grasp::{
    stored_motion, stored_sample, write_bands, write_energy, write_motions, write_pinch_map, write_posture_force,
    write_stability, write_sweep, write_trajectory,
};
pub use image::{
    ImageKind, Stored, WHOLE, count_non_finite, labels_of, read_header, read_integers, read_labels, read_mask,
    read_volume, read_volume_header,
};
pub use markups::{is_slicer, write_markups};
pub use measured::{read_measured, write_measured};
pub use memory::memory_left;
pub use mujoco::{write_mjcf, write_msh};
pub use nifti::{
    PackedField, STRAIN_BITS, Series, length_bits, stored, stored_length, stored_steps, write_by_rows, write_codes,
    write_exact, write_field, write_field_series, write_integers, write_labels, write_samples, write_series_field,
    write_steps, write_tensor_deviations, write_tensors, write_vectors, write_volume,
};
pub use output::{OutputFolder, hold};
pub use scene::{SceneFile, SceneOverrides, read_scene};
pub use scratch::Scratch;
pub use skin::{read_skin_scene, write_response};
pub use sofa::write_sofa;
pub use solid::{SolidFile, write_boundary, write_element_moduli};
pub use speed_accuracy::{write_stress, write_trials};
pub use stiffness::{KnownMaterial, read_materials, write_feb, write_frames, write_inp, write_plan, write_regions};
pub use strain::write_region_strains;
pub use temporary_files::{Hold, abandon};
pub use text::{copy, list, read_json, read_text, write_bytes, write_json, write_text};
pub use track::{read_trajectories, write_strain, write_trajectories};
pub use transform::{
    AffineFormat, FieldFormat, StoredTransforms, TransformSource, read_transform, write_affine, write_field_as,
};
pub use vtu::{write_match_mesh, write_quadratic_mesh, write_tet_mesh, write_tri_mesh};

use crate::error::IoError;
use std::path::Path;

/// For `map_err`: what the operating system refused to do to `path`.
fn os(path: &Path, action: &'static str) -> impl FnOnce(std::io::Error) -> IoError {
    move |source| IoError::Os { path: path.into(), action, source }
}

/// What is wrong with a file's content, and what to try.
fn format(path: &Path, what: impl Into<String>, hint: impl Into<String>) -> IoError {
    let mut what = what.into();
    if let Some((at, _)) = what.char_indices().nth(LONGEST_REASON) {
        what.truncate(at);
        what.push_str("...");
    }
    IoError::Format { path: path.into(), what, hint: hint.into() }
}

/// Characters of a reason that a message shows at most, whatever a file holds.
const LONGEST_REASON: usize = 1000;
