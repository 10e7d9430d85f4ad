//! NIfTI-1 (and reading NIfTI-2): `.nii` and `.nii.gz`, single file.
//!
//! Reading: gzip is known by its first bytes, not by the name, with any number of members; every
//! integer and float type, both byte orders, `scl_slope` and `scl_inter`, sform, qform or neither
//! (then the voxel size alone, as the standard's method 1), `xyzt_units`, extensions. RGB, complex,
//! header/image pairs and series are errors. The header's size is checked against the file's before
//! anything is allocated. The `nifti` crate parses the NIfTI-1 header; it is not used for the
//! voxels (it ignores `vox_offset` when there is no extension, stops after the first gzip member
//! and panics on RGB).
//!
//! Writing: NIfTI-1, little-endian, sform and qform (code 1, "scanner"; the qform only where the
//! affine has no shear), millimetres. The name is taken as it is; it is packed exactly when it ends
//! in `.gz`. The voxels of fields and volumes are rounded a little so that they pack: see
//! [`write_field`] and [`write_volume`].

mod affine;

mod header;

pub(super) mod read;

mod series;

mod write;

pub use series::Series;
pub(super) use write::{ForeignField, write_foreign_field};
pub(crate) use write::{
    PackedField, STRAIN_BITS, length_bits, write_codes, write_field_series, write_series_field, write_tensor_deviations,
};
pub use write::{
    stored, stored_length, stored_steps, write_by_rows, write_exact, write_field, write_integers, write_labels,
    write_samples, write_steps, write_tensors, write_vectors, write_volume,
};
