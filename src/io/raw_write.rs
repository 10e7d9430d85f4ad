//! NRRD and MetaImage out: `.nrrd` (gzip) and `.mha` (plain), in one file, LPS, as ITK reads them.

use super::atomic::write_atomic;
use super::gzip::{Chunk, Member};
use super::voxels::Kind;
use crate::error::IoError;
use crate::types::Grid;
use rayon::prelude::*;
use std::io::Write;
use std::ops::Range;
use std::path::Path;

/// Voxels that are packed together; fixed, so that bytes do not depend on the number of threads.
const VOXELS_PER_CHUNK: usize = 1 << 18;

/// A format whose header is text.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum TextFormat {
    Nrrd,
    MetaImage,
}

impl TextFormat {
    /// By the name of the file, in small letters.
    pub(super) fn of(name: &str) -> Option<Self> {
        let known = [(".nrrd", Self::Nrrd), (".mha", Self::MetaImage)];
        known.into_iter().find(|(ending, _)| name.ends_with(ending)).map(|(_, format)| format)
    }
}

/// What the header says.
pub(super) struct TextImage<'a> {
    pub(super) format: TextFormat,
    pub(super) grid: &'a Grid,
    pub(super) kind: Kind,
    /// Numbers a voxel, which lie together.
    pub(super) components: usize,
    pub(super) description: &'a str,
}

impl TextImage<'_> {
    /// Writes the image; `bytes` gives those (little-endian) of a range of voxels of a component.
    pub(super) fn write(
        &self,
        path: &Path,
        bytes: impl Fn(usize, Range<usize>) -> Vec<u8> + Sync,
    ) -> Result<(), IoError> {
        let all = self.grid.len();
        let ranges: Vec<Range<usize>> =
            (0..all).step_by(VOXELS_PER_CHUNK).map(|from| from..(from + VOXELS_PER_CHUNK).min(all)).collect();
        let size = self.kind.size();
        let together = |range: &Range<usize>| -> Vec<u8> {
            let parts: Vec<Vec<u8>> = (0..self.components).map(|c| bytes(c, range.clone())).collect();
            let of = |at: usize| parts.iter().flat_map(move |p| &p[at * size..(at + 1) * size]);
            (0..range.len()).flat_map(of).copied().collect()
        };
        let batches = || ranges.chunks(2 * rayon::current_num_threads());
        write_atomic(path, |w| {
            w.write_all(self.header().as_bytes())?;
            if self.format == TextFormat::MetaImage {
                return batches().try_for_each(|batch| {
                    let ready: Vec<Vec<u8>> = batch.par_iter().map(together).collect();
                    ready.iter().try_for_each(|bytes| w.write_all(bytes))
                });
            }
            let mut member = Member::start(w)?;
            for batch in batches() {
                let ready: Vec<Chunk> = batch.par_iter().map(|range| Chunk::new(&together(range))).collect();
                ready.iter().try_for_each(|chunk| member.add(chunk))?;
            }
            member.finish()
        })
    }

    fn header(&self) -> String {
        let (rows, shape, sign) = (self.grid.affine().rows(), self.grid.shape(), [-1.0, -1.0, 1.0]);
        let column = |c: usize| -> [f64; 3] { std::array::from_fn(|r| sign[r] * rows[r][c] + 0.0) };
        let join = |v: &[f64], by: &str| v.iter().map(f64::to_string).collect::<Vec<_>>().join(by);
        let sizes = shape.map(|n| n.to_string()).join(" ");
        let many = self.components > 1;
        match self.format {
            TextFormat::Nrrd => {
                let kind = self.kind.name().replace("float32", "float");
                let (rank, count, none, vector) = if many {
                    (4, format!("{} ", self.components), "none ", "vector ")
                } else {
                    (3, String::new(), "", "")
                };
                let steps = [0, 1, 2].map(|c| format!("({})", join(&column(c), ","))).join(" ");
                format!(
                    "NRRD0004\n# {}\ntype: {kind}\ndimension: {rank}\nspace: left-posterior-superior\n\
                     sizes: {count}{sizes}\nspace directions: {none}{steps}\nkinds: {vector}domain domain domain\n\
                     endian: little\nencoding: gzip\nspace origin: ({})\n\n",
                    self.description.replace(['\n', '\r'], " "),
                    join(&column(3), ",")
                )
            }
            TextFormat::MetaImage => {
                let spacing = self.grid.spacing();
                let kind = match self.kind {
                    Kind::U8 => "MET_UCHAR",
                    Kind::I16 => "MET_SHORT",
                    Kind::I32 => "MET_INT",
                    Kind::I64 => "MET_LONG_LONG",
                    _ => "MET_FLOAT",
                };
                let directions = [0, 1, 2].map(|c| join(&column(c).map(|v| v / spacing[c] + 0.0), " ")).join(" ");
                let channels =
                    if many { format!("ElementNumberOfChannels = {}\n", self.components) } else { String::new() };
                format!(
                    "ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\n\
                     CompressedData = False\nTransformMatrix = {directions}\nOffset = {}\n\
                     CenterOfRotation = 0 0 0\nElementSpacing = {}\nDimSize = {sizes}\n{channels}\
                     ElementType = {kind}\nElementDataFile = LOCAL\n",
                    join(&column(3), " "),
                    join(&spacing, " ")
                )
            }
        }
    }
}
