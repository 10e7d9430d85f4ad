//! What a user knows of a pair: starts, masks and landmarks.

use super::console::Console;
use super::inputs::{Part, read_landmarks, read_mask, resampled, standing_for};
use super::transform::{Given, read_chain};
use anyhow::{Result, bail};
use clap::Args;
use palpate::error::Shown;
use palpate::error::UnknownName;
use palpate::io;
use palpate::pipeline::known::{Known, StartMap};
use palpate::pipeline::start::{Alignment, Compared, aligned};
use palpate::types::{Landmark, Mask, Voxels, WorldPoint};
use std::path::{Path, PathBuf};

/// What `field`, `track` and `batch` share.
#[derive(Debug, Args)]
pub struct Knowledge {
    /// Where the search begins: centre, moments or principal (the volumes brought onto each other),
    /// or transforms from the initial to the deformed volume, in the order that a point takes
    #[arg(id = "start", long = "initial", value_name = "T", num_args = 1.., value_parser = transform)]
    start: Vec<String>,
    /// What counts of the deformed volume: a mask on its grid, 0 elsewhere
    #[arg(long, value_name = "M", value_parser = standing_for(Part::Mask))]
    deformed_mask: Option<PathBuf>,
    /// What does not count of the initial volume (implants, artefacts): a mask, 0 elsewhere; of the
    /// deformed one where the mask lies on that one's grid alone; may be given several times
    #[arg(long, value_name = "M", value_parser = standing_for(Part::Mask))]
    ignore: Vec<PathBuf>,
    /// Places known in both volumes: CSV with columns fx,fy,fz (initial) and mx,my,mz (deformed),
    /// world mm, RAS; or two files of points (.csv, .fcsv, .mrk.json), initial and deformed; of a
    /// sequence one CSV with a column frame, counted from 0
    #[arg(long, value_name = "L", num_args = 1..=2, value_parser = standing_for(Part::Landmarks))]
    landmarks: Vec<PathBuf>,
    /// Standard deviation of a landmark along an axis [default: one voxel]
    #[arg(long, value_name = "MM", requires = "landmarks")]
    landmark_sd: Option<f64>,
}

/// What was read.
#[derive(Default)]
pub struct KnownInputs {
    mask: Option<Mask>,
    initial_counts: Option<Mask>,
    deformed_counts: Option<Mask>,
    start: Option<Box<StartMap<'static>>>,
    landmarks: Vec<Landmark>,
    landmark_sd_mm: f64,
}

impl Knowledge {
    /// Whether nothing is known.
    pub fn is_empty(&self) -> bool {
        self.start.is_empty() && self.deformed_mask.is_none() && self.ignore.is_empty() && self.landmarks.is_empty()
    }

    /// The options that are not given.
    pub fn left_out(&self) -> Vec<&'static str> {
        let given = [
            ("--initial", self.start.is_empty()),
            ("--deformed-mask", self.deformed_mask.is_none()),
            ("--ignore", self.ignore.is_empty()),
            ("--landmarks", self.landmarks.is_empty()),
        ];
        given.into_iter().filter(|g| g.1).map(|g| g.0).collect()
    }

    /// Whether landmarks are two lists of points, which belong to one pair.
    pub fn has_point_lists(&self) -> bool {
        self.landmarks.len() > 1
    }

    /// The landmarks of each frame of a sequence against `origin`, by the table's column `frame`;
    /// nothing of a pair, which takes them all.
    pub fn by_frame(&self, all: &[Landmark], frames: usize, origin: usize) -> Result<Vec<Vec<Landmark>>> {
        let Some(path) = self.landmarks.first().filter(|_| frames > 2) else { return Ok(Vec::new()) };
        let mut by_frame = vec![Vec::new(); frames];
        for (&frame, &landmark) in io::read_landmark_frames(path)?.iter().zip(all) {
            if frame >= frames || frame == origin {
                bail!(
                    "{}: has landmarks of frame {frame}; the frames are 0 to {}, without the reference {origin}; correct its \
                     column frame",
                    path.shown(),
                    frames - 1
                );
            }
            by_frame[frame].push(landmark);
        }
        Ok(by_frame)
    }

    /// The files among them, with what each is to the run.
    pub fn inputs(&self) -> Vec<(&'static str, PathBuf)> {
        let transforms = self.transforms().into_iter().map(|t| ("initial transform", t.path));
        let masks = self.deformed_mask.iter().map(|m| ("deformed mask", m.clone()));
        let ignored = self.ignore.iter().map(|m| ("ignored", m.clone()));
        let landmarks = self.landmarks.iter().map(|l| ("landmarks", l.clone()));
        transforms.chain(masks).chain(ignored).chain(landmarks).collect()
    }

    /// The transforms of --initial; none where volumes are brought onto each other.
    fn transforms(&self) -> Vec<Given> {
        let names = self.start.iter().filter(|t| alignment(t).is_none());
        names.filter_map(|t| t.parse().ok()).collect()
    }

    /// Reads what there is for a pair of volumes called `names`. `mask` is where to measure.
    pub fn read(
        &self,
        (initial, deformed): (&Voxels<'_>, &Voxels<'_>),
        names: [&Path; 2],
        mask: Option<Mask>,
        console: &Console,
        warnings: &mut Vec<String>,
    ) -> Result<KnownInputs> {
        if self.landmark_sd.is_some_and(|sd| !(0.001..=100.0).contains(&sd)) {
            bail!("--landmark-sd takes a standard deviation of 0.001 to 100 mm");
        }
        let grids = [initial.grid(), deformed.grid()];
        let deformed_mask = self.deformed_mask.as_ref();
        let mut deformed_counts = deformed_mask.map(|m| read_mask(m, grids[1], names[1], warnings)).transpose()?;
        let mut initial_counts = None;
        for path in &self.ignore {
            let ignored = io::read_mask(path)?;
            let of_deformed = ignored.grid().same_as(grids[1]) && !grids[0].same_as(grids[1]);
            let side = usize::from(of_deformed);
            let ignored = resampled(path, ignored, grids[side], names[side], warnings)?;
            let counts = if of_deformed { &mut deformed_counts } else { &mut initial_counts };
            let counts = counts.get_or_insert_with(|| Mask::filled(*grids[side], 1));
            let left_out = counts.as_mut_slice().iter_mut().zip(ignored.as_slice()).filter(|(_, i)| **i != 0);
            left_out.for_each(|(c, _)| *c = 0);
            if counts.as_slice().iter().all(|c| *c == 0) {
                bail!("{}: nothing is left that counts; give a mask that is 0 in the tissue", path.shown());
            }
        }
        Ok(KnownInputs {
            mask,
            initial_counts,
            deformed_counts,
            start: self.begin(initial, deformed, console, warnings)?,
            landmarks: read_landmarks(&self.landmarks, grids[0], warnings)?,
            landmark_sd_mm: self.landmark_sd.unwrap_or(0.0),
        })
    }

    /// The start, with a warning where the volumes agree less there than where they lie.
    fn begin(
        &self,
        initial: &Voxels<'_>,
        deformed: &Voxels<'_>,
        console: &Console,
        warnings: &mut Vec<String>,
    ) -> Result<Option<Box<StartMap<'static>>>> {
        let start: Box<StartMap<'static>> = match &self.start[..] {
            [] => return Ok(None),
            [one] if alignment(one).is_some() => {
                let how = alignment(one).unwrap_or(Alignment::Centre);
                let map = aligned(initial, deformed, how)?;
                return Ok(Some(Box::new(move |p| Some(map.at(p)))));
            }
            several if several.iter().any(|t| alignment(t).is_some()) => {
                bail!("--initial: centre, moments and principal stand alone; give one of them, or transforms")
            }
            _ => {
                let grids = [Some(*initial.grid()), Some(*deformed.grid())];
                let chain = read_chain(&self.transforms(), &grids, console)?;
                Box::new(move |p| chain.at(p))
            }
        };
        let at = |p: WorldPoint| start(p).unwrap_or(p);
        let compared = Compared::of(initial);
        let [there, here] = [compared.agreement(deformed, at), compared.agreement(deformed, |p| p)];
        if there < here {
            warnings.push(format!(
                "--initial: the volumes agree less at this start ({there:.2}; 1 is best) than where they lie ({here:.2}). A start leads from the \
                 initial to the deformed volume; ,-1 after a name turns it round"
            ));
        }
        Ok(Some(start))
    }
}

/// The way to bring two volumes onto each other that an argument names.
fn alignment(argument: &str) -> Option<Alignment> {
    match argument.to_lowercase().as_str() {
        "centre" | "center" => Some(Alignment::Centre),
        "moments" => Some(Alignment::Moments),
        "principal" => Some(Alignment::Principal),
        _ => None,
    }
}

/// An argument of --initial.
fn transform(argument: &str) -> Result<String, UnknownName> {
    if alignment(argument).is_none() {
        argument.parse::<Given>()?;
    }
    Ok(argument.into())
}

impl KnownInputs {
    /// Only where to measure.
    pub fn of_mask(mask: Option<Mask>) -> Self {
        Self { mask, ..Self::default() }
    }

    /// What a run takes.
    pub fn known(&self) -> Known<'_> {
        Known {
            mask: self.mask.as_ref(),
            initial_counts: self.initial_counts.as_ref(),
            deformed_counts: self.deformed_counts.as_ref(),
            start: self.start.as_deref().map(|s| s as &StartMap<'_>),
            landmarks: &self.landmarks,
            landmark_sd_mm: self.landmark_sd_mm,
        }
    }

    /// Where to measure.
    pub fn mask(&self) -> Option<&Mask> {
        self.mask.as_ref()
    }
}
