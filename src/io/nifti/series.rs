//! A series of volumes in one file, read one at a time.

use super::header::Header;
use super::read::{Opened, Plan, decode, open};
use crate::error::IoError;
use crate::io::format_error::Flaw;
use crate::io::gzip::{self, Members};
use crate::io::voxels::count;
use crate::io::{os, source};
use crate::types::{Grid, Volume};
use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// A 4-D NIfTI file, (nx, ny, nz, nt); a single volume is a series of one.
pub struct Series {
    path: PathBuf,
    voxels: PathBuf,
    plan: Plan,
    frames: usize,
    step_s: Option<f64>,
    source: Source,
}

/// Where the voxels come from.
enum Source {
    Plain(File),
    /// With the number of bytes that were unpacked so far.
    Packed(Box<Members<BufReader<File>>>, u64),
}

impl Source {
    /// From the file's start.
    fn packed(file: File) -> Self {
        Self::Packed(Box::new(Members::new(BufReader::with_capacity(1 << 18, file))), 0)
    }
}

impl Series {
    /// Opens a file and checks its header against its size.
    ///
    /// # Errors
    /// [`IoError`] when the file cannot be read, is cut short, or is no scalar volume or series of
    /// these.
    ///
    /// ```
    /// use palpate::{Affine, Grid, Volume, io};
    /// let folder = tempfile::tempdir()?;
    /// let path = folder.path().join("one.nii.gz");
    /// let grid = Grid::new([6; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
    /// io::write_volume(&path, &Volume::filled(grid, 2.0), "")?;
    /// let mut series = io::Series::open(&path)?;
    /// assert_eq!(series.frames(), 1);
    /// assert_eq!(series.read(0)?.as_slice()[5], 2.0);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn open(path: impl AsRef<Path>) -> Result<Self, IoError> {
        let path = path.as_ref();
        let opened = open(path)?;
        let most = opened.most();
        let Opened { file, voxels, head, packed, .. } = opened;
        let source = if packed { Source::packed(file) } else { Source::Plain(file) };
        let header = Header::parse(&head).map_err(|flaw| flaw.at(path))?;
        let plan = Plan::new(&head, layout).map_err(|flaw| flaw.at(path))?;
        plan.end_within(most).map_err(|flaw| flaw.at(path))?;
        let frames = header.axes().map_err(|flaw| flaw.at(path))?[3];
        let unit = match header.xyzt_units >> 3 & 7 {
            1 => 1.0,
            2 => 1e-3,
            3 => 1e-6,
            _ => f64::NAN,
        };
        let step_s = Some(header.pixdim[4] * unit).filter(|s| s.is_finite() && *s > 0.0);
        Ok(Self { path: path.into(), voxels, plan, frames, step_s, source })
    }

    /// How many volumes there are.
    pub fn frames(&self) -> usize {
        self.frames
    }

    /// Time from one to the next (s), where the file says.
    pub fn step_s(&self) -> Option<f64> {
        self.step_s
    }

    /// The grid of each.
    pub fn grid(&self) -> &Grid {
        &self.plan.grid
    }

    /// Volume number `at`, counted from 0. Cheap in rising order; going back unpacks a packed file
    /// from its start.
    ///
    /// # Errors
    /// [`IoError`] when there are fewer, or the file cannot be read, is damaged or cut short.
    pub fn read(&mut self, at: usize) -> Result<Volume, IoError> {
        let path = &self.path;
        if at >= self.frames {
            let what = format!("has {} frames, so there is no frame {at} (counted from 0)", self.frames);
            return Err(Flaw::new(what, "ask for one that is there").at(path));
        }
        let length = self.plan.bytes / self.frames as u64;
        let from = self.plan.start + at as u64 * length;
        let mut data = Vec::new();
        let damaged = |e: io::Error| gzip::damaged(&e).at(path);
        if matches!(self.source, Source::Packed(_, done) if done > from) {
            self.source = Source::packed(source::open(&self.voxels)?);
        }
        match &mut self.source {
            Source::Plain(file) => {
                file.seek(SeekFrom::Start(from)).map_err(os(path, "read"))?;
                file.take(length).read_to_end(&mut data).map_err(os(path, "read"))?;
            }
            Source::Packed(unpacked, done) => {
                io::copy(&mut unpacked.by_ref().take(from - *done), &mut io::sink()).map_err(damaged)?;
                unpacked.by_ref().take(length).read_to_end(&mut data).map_err(damaged)?;
                *done = from + length;
                if at + 1 == self.frames {
                    *done += gzip::check_end(unpacked.as_mut()).map_err(damaged)?;
                }
            }
        }
        if data.len() as u64 != length {
            let what = format!("ends inside frame {at}");
            return Err(Flaw::new(what, "the file is cut short: copy or export it again").at(path));
        }
        Volume::from_vec(self.plan.grid, decode(&self.plan, &data))
            .map_err(|e| Flaw::new(e.to_string(), "export it again").at(path))
    }
}

/// The frames stand where a field has its components: both are volumes one after the other.
fn layout(_: &Header, axes: [usize; 7]) -> Result<usize, Flaw> {
    match count(&axes[4..]) {
        1 => Ok(axes[3]),
        _ => Err(Flaw::new(
            format!("has axes {axes:?}: more than space and time"),
            "give a series of scalar volumes, (x, y, z, t)",
        )),
    }
}
