//! File formats and what is told of files.
#![allow(clippy::unwrap_used)]

mod dicom;
#[path = "../fixtures/mod.rs"]
mod fixtures;
mod folders;
mod formats;
mod info;
mod io_formats;
mod nifti;
#[path = "../fixtures/slices.rs"]
mod slices;
mod transforms;
