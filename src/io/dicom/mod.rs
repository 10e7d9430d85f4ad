//! A DICOM series as a volume: slices in files of their own (PS3.3 C.7.6.2), a file of many frames
//! (C.7.6.16), or a Siemens mosaic.
//!
//! One number a voxel; slices are put in order by where they lie. A file stands for its series: the
//! others of it are looked for in the same folder. Several series in a folder, several volumes at
//! one place, gaps and tilted stacks are errors that name the files. Which transfer syntaxes are
//! read says [`pixels`].

mod data_elements;

mod mosaic;

mod pixels;

use super::format_error::Flaw;
use super::image::Stored;
use super::memory::fits;
use super::raw::grid_from_lps;
use super::{os, source};
use crate::error::{IoError, Shown};
use crate::types::names::cut;
use crate::types::space::{cross, dot, length};
use data_elements::{Elements, Tag};
use mosaic::Mosaic;
use pixels::{CONVERT, Pixels, Source, text};
use std::fs;
use std::path::{Path, PathBuf};

/// A file of a series is never larger (bytes).
const MAX_FILE_BYTES: u64 = 1 << 30;
/// Bytes of the preamble and of DICOM's mark behind it.
pub(super) const PREAMBLE_AND_MARK_BYTES: usize = 132;

const SERIES_NAME: Tag = (0x0008, 0x103e);
const SERIES: Tag = (0x0020, 0x000e);
const POSITION: Tag = (0x0020, 0x0032);
const ORIENTATION: Tag = (0x0020, 0x0037);
const SPACING: Tag = (0x0028, 0x0030);
const THICKNESS: Tag = (0x0018, 0x0050);
const BETWEEN: Tag = (0x0018, 0x0088);
const INTERCEPT: Tag = (0x0028, 0x1052);
const SLOPE: Tag = (0x0028, 0x1053);
/// Functional groups of a file of many frames: those of all frames, and of each.
const SHARED: Tag = (0x5200, 0x9229);
const PER_FRAME: Tag = (0x5200, 0x9230);
const PLACE_GROUP: Tag = (0x0020, 0x9113);
const ORIENTATION_GROUP: Tag = (0x0020, 0x9116);
const MEASURES_GROUP: Tag = (0x0028, 0x9110);
const VALUES_GROUP: Tag = (0x0028, 0x9145);
/// Slices that are this near lie at one place (mm).
const SAME_POSITION_MM: f64 = 1e-3;

/// Whether a file begins as DICOM does.
pub(super) fn is_dicom(head: &[u8]) -> bool {
    head.get(128..PREAMBLE_AND_MARK_BYTES) == Some(b"DICM")
}

/// One slice: where it lies, and which part of which file it is.
#[derive(Debug, Clone)]
struct Slice {
    file: usize,
    frame: usize,
    /// Number of its tile in a mosaic.
    tile: Option<usize>,
    shape: [usize; 2],
    scaling: (f64, f64),
    position: [f64; 3],
    /// Along a row and down a column (LPS, unit vectors).
    axes: [[f64; 3]; 2],
    /// Between columns and between rows (mm).
    spacing: [f64; 2],
    /// From this slice to the next where there is no other (mm).
    thickness: f64,
}

/// A file of a series.
struct File {
    path: PathBuf,
    series: String,
    /// What the series is called.
    called: String,
    pixels: Pixels,
    slices: Vec<Slice>,
}

/// Numbers of a text element, `1\0\0`; none where it is not there or odd.
fn numbers<const N: usize>(elements: &Elements<'_>, tag: Tag) -> Option<[f64; N]> {
    let clean = |part: &str| part.trim_matches([' ', '\0']).parse().ok().filter(|v: &f64| v.is_finite());
    let values = String::from_utf8_lossy(elements.get(tag)?).split('\\').map(clean).collect::<Option<Vec<f64>>>();
    values?.try_into().ok()
}

/// The attributes of a frame: in its functional groups, in those of all frames, or of the whole
/// file.
struct Said<'e> {
    groups: Vec<&'e Elements<'e>>,
    object: &'e Elements<'e>,
}

impl Said<'_> {
    fn numbers<const N: usize>(&self, group: Tag, tag: Tag) -> Option<[f64; N]> {
        let in_group = self.groups.iter().find_map(|g| numbers(&g.items(group).next()?, tag));
        in_group.or_else(|| numbers(self.object, tag))
    }

    fn needed<const N: usize>(&self, group: Tag, tag: Tag, name: &str) -> Result<[f64; N], Flaw> {
        self.numbers(group, tag)
            .ok_or_else(|| Flaw::new(format!("has no {name} ({:04x},{:04x}), or an odd one", tag.0, tag.1), CONVERT))
    }

    fn slice(&self, frame: usize, shape: [usize; 2]) -> Result<Slice, Flaw> {
        let [down, along] = self.needed(MEASURES_GROUP, SPACING, "PixelSpacing")?;
        let [a, b, c, d, e, f] = self.needed(ORIENTATION_GROUP, ORIENTATION, "ImageOrientationPatient")?;
        let one = |group, tag, default: f64| self.numbers(group, tag).map_or(default, |[v]: [f64; 1]| v);
        Ok(Slice {
            file: 0,
            frame,
            tile: None,
            shape,
            scaling: (one(VALUES_GROUP, SLOPE, 1.0), one(VALUES_GROUP, INTERCEPT, 0.0)),
            position: self.needed(PLACE_GROUP, POSITION, "ImagePositionPatient")?,
            axes: [[a, b, c], [d, e, f]],
            spacing: [along, down],
            thickness: one(MEASURES_GROUP, THICKNESS, 1.0),
        })
    }
}

impl File {
    /// None where it holds no image.
    fn read(path: &Path) -> Result<Option<Self>, IoError> {
        let bytes = source::bytes(path, MAX_FILE_BYTES)?;
        Self::of(path, &bytes).map_err(|flaw| flaw.at(path))
    }

    fn of(path: &Path, bytes: &[u8]) -> Result<Option<Self>, Flaw> {
        let source = Source::of(bytes)?;
        let object = source.elements()?;
        let Some(pixels) = Pixels::of(&object, &source)? else { return Ok(None) };
        let shared: Vec<Elements<'_>> = object.items(SHARED).take(1).collect();
        let each: Vec<Elements<'_>> = object.items(PER_FRAME).collect();
        if pixels.frames > 1 && each.len() != pixels.frames {
            let what = format!("holds {} frames and does not say where each lies", pixels.frames);
            return Err(Flaw::new(what, CONVERT));
        }
        let said = |k: usize| Said { groups: each.get(k).into_iter().chain(&shared).collect(), object: &object };
        let slices = match Mosaic::of(&object)? {
            Some(mosaic) => tiles(&said(0).slice(0, pixels.shape)?, &mosaic, numbers(&object, BETWEEN))?,
            None => (0..pixels.frames).map(|k| said(k).slice(k, pixels.shape)).collect::<Result<_, _>>()?,
        };
        Ok(Some(Self {
            path: path.into(),
            series: object.get(SERIES).map(text).unwrap_or_default(),
            called: object.get(SERIES_NAME).map(text).unwrap_or_default(),
            pixels,
            slices,
        }))
    }

    /// Puts the numbers of its slices where `places` says: of a slice, its number in the stack.
    fn load(&self, places: &[(Slice, usize)], out: &mut [f32]) -> Result<(), IoError> {
        let bytes = source::bytes(&self.path, MAX_FILE_BYTES)?;
        let frames = Source::of(&bytes).and_then(|source| source.frames(&source.elements()?, &self.pixels));
        let frames = frames.map_err(|flaw| flaw.at(&self.path))?;
        for (slice, place) in places {
            let values = self.pixels.values(&frames[slice.frame], slice.scaling);
            let [nx, ny] = slice.shape;
            let columns = self.pixels.shape[0];
            let tiles = columns / nx;
            let (left, top) = slice.tile.map_or((0, 0), |t| (t % tiles * nx, t / tiles * ny));
            for (j, row) in out[place * nx * ny..][..nx * ny].chunks_exact_mut(nx).enumerate() {
                row.copy_from_slice(&values[(top + j) * columns + left..][..nx]);
            }
        }
        Ok(())
    }
}

/// The slices of a mosaic, whose place is that of an image with one tile in its middle.
fn tiles(image: &Slice, mosaic: &Mosaic, between: Option<[f64; 1]>) -> Result<Vec<Slice>, Flaw> {
    let side = mosaic.side();
    let [columns, rows] = image.shape;
    if columns % side != 0 || rows % side != 0 {
        let what = format!("is a mosaic of {} slices, which do not fill {columns} x {rows} voxels", mosaic.tiles);
        return Err(Flaw::new(what, CONVERT));
    }
    let shape = [columns / side, rows / side];
    let step = between.map_or(image.thickness, |[mm]| mm);
    let shift = |a: usize| (image.shape[a] - shape[a]) as f64 / 2.0 * image.spacing[a];
    let tile = |k: usize| {
        let position = std::array::from_fn(|a| {
            let first = image.position[a] + shift(0) * image.axes[0][a] + shift(1) * image.axes[1][a];
            first + k as f64 * step * mosaic.normal[a]
        });
        Slice { tile: Some(k), shape, position, thickness: step, ..image.clone() }
    };
    Ok((0..mosaic.tiles).map(tile).collect())
}

/// All files that `path` stands for: those of a folder, or a file and the others of its series
/// beside it, where it holds one slice.
fn gather(path: &Path) -> Result<Vec<File>, IoError> {
    let alone = match path.is_dir() {
        true => None,
        false => Some(
            File::read(path)?
                .ok_or_else(|| Flaw::new("is DICOM without an image", "name a file with a slice").at(path))?,
        ),
    };
    if alone.as_ref().is_some_and(|f| f.slices.len() > 1) {
        return Ok(alone.into_iter().collect());
    }
    let folder = if path.is_dir() {
        path
    } else {
        path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
    };
    let mut names: Vec<PathBuf> = fs::read_dir(folder)
        .and_then(|entries| entries.map(|e| e.map(|e| e.path())).collect())
        .map_err(os(folder, "read the folder"))?;
    names.sort();
    let mut files = Vec::new();
    for name in names.into_iter().filter(|n| n.is_file() && n.file_name().is_none_or(|n| n != "DICOMDIR")) {
        if !is_dicom(&source::head(&name, PREAMBLE_AND_MARK_BYTES as u64).unwrap_or_default()) {
            continue;
        }
        match (File::read(&name), &alone) {
            (Ok(found), None) => files.extend(found),
            (Ok(found), Some(one)) => files.extend(found.filter(|f| f.series == one.series)),
            (Err(error), None) => return Err(error),
            // What is beside the file that was named may be of anything.
            (Err(_), Some(_)) => {}
        }
    }
    Ok(files)
}

/// Files whose content the volume at `path` rests on.
pub(super) fn files(path: &Path) -> Vec<PathBuf> {
    gather(path).map(|files| files.into_iter().map(|f| f.path).collect()).unwrap_or_default()
}

/// Stored form and values of a series; the values only when they are wanted.
pub(super) fn series(path: &Path, values: bool) -> Result<(Stored, Vec<f32>), IoError> {
    let files = gather(path)?;
    one_series(&files).map_err(|flaw| flaw.at(path))?;
    let numbered = |(at, file): (usize, &File)| {
        file.slices.iter().map(move |s| Slice { file: at, ..s.clone() }).collect::<Vec<_>>()
    };
    let mut slices: Vec<Slice> = files.iter().enumerate().flat_map(numbered).collect();
    let called = |s: &Slice| {
        let name = files[s.file].path.file_name().unwrap_or_default().shown();
        match files[s.file].slices.len() {
            1 => name,
            _ => format!("{name}, frame {}", s.tile.unwrap_or(s.frame) + 1),
        }
    };
    let (shape, steps) = stack(&mut slices, called).map_err(|flaw| flaw.at(path))?;
    let grid = grid_from_lps(shape, steps, slices[0].position).map_err(|flaw| flaw.at(path))?;
    let mut all = Vec::new();
    if values {
        files.iter().try_for_each(|f| f.pixels.held().map_err(|flaw| flaw.at(&f.path)))?;
        let largest = files.iter().map(|f| f.pixels.shape[0] * f.pixels.shape[1] * f.pixels.frames).max().unwrap_or(0);
        fits(4 * (grid.len() + 4 * largest) as u64).map_err(|flaw| flaw.at(path))?;
        all = vec![0.0; grid.len()];
        let mut places: Vec<Vec<(Slice, usize)>> = vec![Vec::new(); files.len()];
        slices.iter().enumerate().for_each(|(at, s)| places[s.file].push((s.clone(), at)));
        for (file, places) in files.iter().zip(&places) {
            file.load(places, &mut all)?;
        }
    }
    let stored = Stored {
        format: "DICOM series",
        datatype: files[0].pixels.kind.name(),
        axes: shape.to_vec(),
        placed: "ImagePositionPatient and ImageOrientationPatient",
        apart_mm: None,
        labels: false,
        grid,
        bytes: files.iter().filter_map(|f| f.path.metadata().ok()).map(|m| m.len()).sum(),
        description: files[0].called.clone(),
    };
    Ok((stored, all))
}

/// A series in a folder.
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    /// Its UID.
    pub uid: String,
    /// What it is called; empty where nothing says.
    pub called: String,
    /// How many files it has.
    pub files: usize,
    /// One of them.
    pub file: PathBuf,
}

/// The DICOM series in a folder, by their first files.
///
/// # Errors
/// [`IoError`] when the folder or a DICOM file in it cannot be read.
pub fn series_in(folder: impl AsRef<Path>) -> Result<Vec<Series>, IoError> {
    Ok(grouped(&gather(folder.as_ref())?))
}

fn grouped(files: &[File]) -> Vec<Series> {
    let mut found: Vec<Series> = Vec::new();
    for file in files {
        match found.iter_mut().find(|s| s.uid == file.series) {
            Some(series) => series.files += 1,
            None => found.push(Series {
                uid: file.series.clone(),
                called: file.called.clone(),
                files: 1,
                file: file.path.clone(),
            }),
        }
    }
    found
}

/// Refuses none and several, which are listed with a file of each.
fn one_series(files: &[File]) -> Result<(), Flaw> {
    let found = grouped(files);
    match &found[..] {
        [] => Err(Flaw::new("is a folder without DICOM files", "give a volume, or a folder with one series")),
        [_] => Ok(()),
        _ => {
            let one = |s: &Series| {
                let name = s.file.file_name().unwrap_or_default().shown();
                format!("{} ({}, {} files, such as {name})", cut(&s.uid), cut(&s.called), s.files)
            };
            let listed: Vec<String> = found.iter().take(12).map(one).collect();
            let what = format!("holds {} DICOM series: {}", found.len(), listed.join(", "));
            Err(Flaw::new(what, "choose one with --series UID, or name one file of it, which stands for all of them"))
        }
    }
}

/// Puts the slices in order; shape and steps (LPS mm) of the stack. `called` names a slice.
fn stack(slices: &mut [Slice], called: impl Fn(&Slice) -> String) -> Result<([usize; 3], [[f64; 3]; 3]), Flaw> {
    let near = |a: &[f64], b: &[f64]| a.iter().zip(b).all(|(x, y)| (x - y).abs() < SAME_POSITION_MM);
    let (shape, axes, spacing) = (slices[0].shape, slices[0].axes, slices[0].spacing);
    let alike =
        |s: &Slice| s.shape == shape && near(s.axes.as_flattened(), axes.as_flattened()) && near(&s.spacing, &spacing);
    if let Some(other) = slices.iter().find(|s| !alike(s)) {
        let (one, other) = (called(&slices[0]), called(other));
        let what = format!("holds slices of different sizes or directions ({one} and {other})");
        return Err(Flaw::new(what, "keep those of one stack"));
    }
    let normal = cross(axes[0], axes[1]);
    slices.sort_by(|a, b| dot(a.position, normal).total_cmp(&dot(b.position, normal)));
    let n = slices.len();
    let place = |s: &Slice| {
        let [x, y, z] = s.position;
        format!("({:.2}, {:.2}, {z:.2})", -x + 0.0, -y + 0.0)
    };
    let between: Vec<f64> =
        slices.windows(2).map(|pair| dot(pair[1].position, normal) - dot(pair[0].position, normal)).collect();
    if let Some(at) = between.iter().position(|d| *d < SAME_POSITION_MM) {
        let (a, b) = (&slices[at], &slices[at + 1]);
        let what = format!("holds several slices at one place: {} and {} at {} mm", called(a), called(b), place(a));
        return Err(Flaw::new(what, "keep one time or echo, or one copy, or use dcm2niix"));
    }
    let mut step = normal.map(|v| v * slices[0].thickness);
    if let [first, .., last] = &*slices {
        let mut sorted = between.clone();
        sorted.sort_by(f64::total_cmp);
        let usual = sorted[sorted.len() / 2];
        if let Some(at) = between.iter().position(|d| *d > 1.5 * usual) {
            let (a, b) = (&slices[at], &slices[at + 1]);
            let what = format!(
                "has a gap of {:.2} mm, where slices lie {usual:.2} mm apart, between {} at {} mm and {} at {} mm",
                between[at],
                called(a),
                place(a),
                called(b),
                place(b)
            );
            return Err(Flaw::new(what, "add the slices that are missing, or keep one volume"));
        }
        step = std::array::from_fn(|a| (last.position[a] - first.position[a]) / (n - 1) as f64);
        let off = |(k, s): (usize, &Slice)| {
            let d = std::array::from_fn(|a| first.position[a] + k as f64 * step[a] - s.position[a]);
            (length(d), k)
        };
        let worst = slices.iter().enumerate().map(off).fold((0.0, 0), |a, b| if b.0 > a.0 { b } else { a });
        if worst.0 > 0.05 * length(step) {
            let what = format!(
                "holds slices that do not follow each other evenly: {} lies {:.2} mm off",
                called(&slices[worst.1]),
                worst.0
            );
            return Err(Flaw::new(what, "keep one volume, or resample it to even slices (dcm2niix)"));
        }
    }
    let along = axes[0].map(|v| v * spacing[0]);
    let down = axes[1].map(|v| v * spacing[1]);
    Ok(([shape[0], shape[1], n], [along, down, step]))
}
