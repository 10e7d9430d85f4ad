//! Files in and out: the only stage that opens one.
//!
//! Promises: every error names the file, what is wrong and what to try; no header can make it
//! allocate more than the file could hold; nothing half-written ever stands under a final name
//! (each file is written under a temporary name in the same folder, then renamed; [`OutputFolder`]
//! does the same for a whole folder). Nothing here prints.

mod image;

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

mod markups;

mod vtu;

pub mod scene;

mod config;

pub mod grasp;

pub mod measured;

pub mod fingertip;

pub mod skin;

pub mod track;

mod transform;

pub mod strain;

pub mod stiffness;

mod simulators;

mod sofa;

mod mujoco;

mod solid;

pub mod speed_accuracy;

mod batch;

mod bids;

mod text;

mod output;

mod scratch;

mod temporary_files;

mod file_kind;

mod memory;

mod atomic;

mod deflate;

mod digest;

mod gzip;

pub use batch::read_pairs;
pub(crate) use batch::{make_folder, stamp, write_rows};
pub(crate) use bids::{describe_derivative, is_bids, read_bids, write_derivative};
pub(crate) use chain_errors::write_chain;
pub use config::read_config;
pub use csv::{
    PointTable, read_landmark_frames, read_landmark_pair, read_landmarks, read_matches, read_points, stored_matches,
    write_landmarks, write_matches, write_points,
};
pub(crate) use csv::{TableKind, table_kind};
pub use dicom::{Series as DicomSeries, series_in};
pub use digest::{digest, files_of};
pub use field::{FieldConvention, read_field, read_field_as, read_samples};
pub(crate) use file_kind::form_of;
pub use file_kind::{Form, columns_of};
pub(crate) use fingertip::read_fingertip_modulus;
pub use fingertip::{read_fingertip_press, read_stiffness, stiffness_folder, write_fingertip};
pub use grasp::{stored_motion, stored_sample};
pub(crate) use grasp::{
    write_bands, write_energy, write_motions, write_pinch_map, write_posture_force, write_stability, write_sweep,
    write_trajectory,
};
pub use image::{ImageKind, count_non_finite, read_header, read_labels, read_mask, read_volume, read_volume_header};
pub(crate) use image::{Stored, WHOLE, labels_of, read_integers};
pub(crate) use markups::is_slicer;
pub use markups::write_markups;
pub use measured::read_measured;
pub(crate) use measured::write_measured;
pub(crate) use memory::memory_left;
pub use mujoco::{write_mjcf, write_msh};
pub(crate) use nifti::{
    PackedField, STRAIN_BITS, length_bits, write_codes, write_field_series, write_series_field, write_tensor_deviations,
};
pub use nifti::{
    Series, stored, stored_length, stored_steps, write_by_rows, write_exact, write_field, write_integers, write_labels,
    write_samples, write_steps, write_tensors, write_vectors, write_volume,
};
pub use output::{OutputFolder, hold};
pub(crate) use scene::SceneFile;
pub use scene::{SceneOverrides, read_scene};
pub(crate) use scratch::Scratch;
pub use skin::read_skin_scene;
pub(crate) use skin::write_response;
pub use sofa::write_sofa;
pub use solid::{SolidFile, write_boundary, write_element_moduli};
pub(crate) use speed_accuracy::{write_stress, write_trials};
pub(crate) use stiffness::{read_materials, write_frames, write_plan, write_regions};
pub use stiffness::{write_feb, write_inp};
pub(crate) use strain::write_region_strains;
pub use temporary_files::Hold;
pub(crate) use temporary_files::abandon;
pub use text::{copy, list, read_json, read_text, write_bytes, write_json, write_text};
pub(crate) use track::write_strain;
pub use track::{read_trajectories, write_trajectories};
pub use transform::{AffineFormat, FieldFormat, TransformSource, read_transform, write_affine, write_field_as};
pub(crate) use vtu::{write_match_mesh, write_quadratic_mesh};
pub use vtu::{write_tet_mesh, write_tri_mesh};

use crate::error::IoError;
use std::path::Path;

/// For `map_err`: what the operating system refused to do to `path`.
fn os(path: &Path, action: &'static str) -> impl FnOnce(std::io::Error) -> IoError {
    move |source| IoError::Os { path: path.into(), action, source }
}

/// What is wrong with a file's content, and what to try.
fn format(path: &Path, what: impl Into<String>, hint: impl Into<String>) -> IoError {
    let mut what = what.into();
    if let Some((at, _)) = what.char_indices().nth(MAX_REASON_CHARS) {
        what.truncate(at);
        what.push_str("...");
    }
    IoError::Format { path: path.into(), what, hint: hint.into() }
}

/// Characters of a reason that a message shows at most, whatever a file holds.
const MAX_REASON_CHARS: usize = 1000;
