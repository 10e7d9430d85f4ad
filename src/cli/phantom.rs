//! `palpate phantom`: a synthetic pair with exactly known displacement.

use super::console::Console;
use super::limits::phantom_fits;
use super::{Usage, sequence};
use anyhow::{Result, bail};
use clap::Args;
use palpate::error::Shown;
use palpate::error::{SynthError, UnknownName};
use palpate::io::{self, OutputFolder};
use palpate::report::{figure, panels};
use palpate::synth::{
    self, ElasticParams, MotionKind, Phantom, PhantomKind, PhantomParams, SequenceKind, SequenceParams,
};
use palpate::types::names::choose;
use std::path::PathBuf;

/// Default of --bias.
const DEFAULT_BIAS: f64 = 0.15;

#[derive(Debug, Args)]
pub struct Options {
    /// A pair: calf, slice, head, block, fingertip, inclusion or slab; a sequence: pinch, pen or
    /// contraction
    #[arg(value_parser = kind)]
    kind: Kind,
    /// Folder for the results
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Write into a folder that is not empty
    #[arg(long, alias = "force")]
    overwrite: bool,
    /// Voxels along x; the field of view stays [default: by kind]
    #[arg(long, value_name = "N")]
    size: Option<usize>,
    /// Voxel edges in mm, one number or x,y,z; the number of voxels stays [default: by kind]
    #[arg(long, value_name = "MM", value_delimiter = ',')]
    spacing: Vec<f64>,
    /// Frames of a sequence, the one at rest included [default: 16]
    #[arg(long, value_name = "N")]
    frames: Option<usize>,
    /// Seed of anatomy, motion and noise
    #[arg(long, value_name = "S", default_value_t = 1)]
    seed: u64,
    /// none, translate, rotate, affine, smooth, press, slide, wave or elastic [default: by kind]
    #[arg(long)]
    motion: Option<MotionKind>,
    /// Largest displacement in mm, degrees for rotate, largest strain in per cent for wave
    /// [default: by kind]
    #[arg(long, value_name = "MM")]
    amplitude: Option<f64>,
    /// Inclusion: Young's modulus of one inclusion over the background's [default: 5]
    #[arg(long, value_name = "RATIO")]
    contrast: Option<f64>,
    /// Inclusion: how many, 0, 1 or 2 (of 0.5 and 4 times the background's modulus) [default: 1]
    #[arg(long, value_name = "N")]
    inclusions: Option<usize>,
    /// Elastic: Poisson's ratio [default: 0.49]
    #[arg(long, value_name = "NU")]
    poisson: Option<f64>,
    /// Standard deviation of the Rician noise, as a part of the brightest tissue
    #[arg(long, value_name = "PART", default_value_t = 0.03)]
    noise: f64,
    /// Largest change of brightness across the deformed volume, as a part
    #[arg(long, value_name = "PART", default_value_t = DEFAULT_BIAS)]
    bias: f64,
}

/// What is made.
#[derive(Debug, Clone, Copy)]
enum Kind {
    Pair(PhantomKind),
    Sequence(SequenceKind),
}

fn kind(name: &str) -> Result<Kind, UnknownName> {
    let pairs = PhantomKind::KNOWN.map(|(name, kind)| (name, Kind::Pair(kind)));
    let sequences = SequenceKind::KNOWN.map(|(name, kind)| (name, Kind::Sequence(kind)));
    choose("phantom", name, &[&pairs[..], &sequences].concat())
}

/// What has inclusions, and what has Poisson's ratio.
const INCLUSION: &str = "the phantom called inclusion";
const ELASTIC: &str = "an elastic motion (fingertip, inclusion or slab)";

/// Refuses a flag that is given and means nothing here, since it belongs `to` something else.
fn refuse<T>(given: Option<T>, flag: &str, to: &str) -> Result<()> {
    match given {
        Some(_) => bail!(Usage(format!("--{flag} belongs to {to}: leave it out"))),
        None => Ok(()),
    }
}

impl Options {
    /// Voxel edges, where they are asked for (mm).
    fn spacing(&self) -> Result<Option<[f64; 3]>> {
        match self.spacing[..] {
            [] => Ok(None),
            [v] => Ok(Some([v; 3])),
            [x, y, z] => Ok(Some([x, y, z])),
            _ => bail!(Usage("--spacing takes one number or three, as 1.5,1.5,5".into())),
        }
    }

    /// A sequence's parameters, in range.
    fn sequence(&self, kind: SequenceKind) -> Result<SequenceParams> {
        if self.motion.is_some() || self.bias != DEFAULT_BIAS {
            bail!(Usage("a sequence has a motion of its own and no bias: leave --motion and --bias out".into()));
        }
        refuse(self.contrast, "contrast", INCLUSION)?;
        refuse(self.inclusions, "inclusions", INCLUSION)?;
        refuse(self.poisson, "poisson", ELASTIC)?;
        let Self { seed, noise, .. } = *self;
        let mut p = SequenceParams { seed, noise, ..SequenceParams::new(kind) };
        p.frames = self.frames.unwrap_or(p.frames);
        if let Some(n) = self.size {
            p = p.sized(n);
        }
        p.spacing = self.spacing()?.unwrap_or(p.spacing);
        p.amplitude = self.amplitude.unwrap_or(p.amplitude);
        p.check()?;
        Ok(p)
    }

    /// Parameters in range.
    fn params(&self, kind: PhantomKind) -> Result<PhantomParams> {
        let mut p = PhantomParams { seed: self.seed, noise: self.noise, bias: self.bias, ..PhantomParams::new(kind) };
        if let Some(n) = self.size {
            p = p.sized(n);
        }
        p.spacing = self.spacing()?.unwrap_or(p.spacing);
        if let Some(motion) = self.motion {
            p = p.moving(motion);
        }
        refuse(self.frames, "frames", "a sequence (pinch, pen or contraction)")?;
        if kind != PhantomKind::Inclusion {
            refuse(self.contrast, "contrast", INCLUSION)?;
            refuse(self.inclusions, "inclusions", INCLUSION)?;
        } else if self.inclusions.is_some_and(|n| n != 1) {
            refuse(self.contrast, "contrast", "one inclusion")?;
        }
        if p.motion != MotionKind::Elastic {
            refuse(self.poisson, "poisson", ELASTIC)?;
        } else if !matches!(kind, PhantomKind::Fingertip | PhantomKind::Inclusion | PhantomKind::Slab) {
            bail!(Usage(SynthError::NotElastic.to_string()));
        }
        let usual = p.elastic;
        p.elastic = ElasticParams {
            contrast: self.contrast.unwrap_or(usual.contrast),
            inclusions: self.inclusions.unwrap_or(usual.inclusions),
            poisson: self.poisson.unwrap_or(usual.poisson),
        };
        p.amplitude = self.amplitude.unwrap_or(p.amplitude);
        p.check()?;
        Ok(p)
    }
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let picture = options.output.join("phantom.svg");
    let kind = match options.kind {
        Kind::Pair(kind) => kind,
        Kind::Sequence(kind) => {
            let params = options.sequence(kind)?;
            phantom_fits(&params.grid()?, false)?;
            let mut folder = OutputFolder::create(&options.output, options.overwrite)?;
            let summary = sequence::write(&mut folder, &params, console)?;
            folder.commit()?;
            console.say(&format!("{summary}  results      {}", picture.shown()));
            return Ok(());
        }
    };
    let params = options.params(kind)?;
    phantom_fits(&params.grid()?, params.motion == MotionKind::Elastic)?;
    let mut folder = OutputFolder::create(&options.output, options.overwrite)?;
    let phantom = synth::phantom(&params)?;
    write(&mut folder, &phantom)?;
    folder.commit()?;
    let d = &phantom.description;
    console.say(&format!(
        "{:?}, {:?} motion: mean {:.2} mm, largest {:.2} mm over {} voxels; {} landmarks.\n  results      {}",
        d.params.kind,
        d.params.motion,
        d.mean_mm,
        d.max_mm,
        d.mask_voxels,
        phantom.landmarks.len(),
        picture.shown()
    ));
    Ok(())
}

/// Stages both volumes, truth, mask, landmarks, description and picture.
pub fn write(folder: &mut OutputFolder, phantom: &Phantom) -> Result<()> {
    let Phantom { initial, deformed, truth, mask, landmarks, stiffness, description } = phantom;
    folder.write("initial.nii.gz", |p| io::write_integers(p, initial, "palpate phantom: initial"))?;
    folder.write("deformed.nii.gz", |p| io::write_integers(p, deformed, "palpate phantom: deformed"))?;
    folder.write("truth.nii.gz", |p| io::write_field(p, truth))?;
    folder.write("mask.nii.gz", |p| io::write_labels(p, mask, "palpate phantom: tissue"))?;
    folder.write("landmarks.csv", |p| io::write_landmarks(p, landmarks))?;
    if let Some(stiffness) = stiffness {
        let (labels, modulus) = (&stiffness.labels, &stiffness.youngs_modulus_kpa);
        folder.write("labels.nii.gz", |p| io::write_labels(p, labels, "palpate phantom: tissue regions"))?;
        folder.write("youngs_modulus.nii.gz", |p| {
            io::write_volume(p, modulus, "palpate phantom: Young's modulus, kPa")
        })?;
    }
    folder.write("phantom.json", |p| io::write_json(p, description))?;
    let params = &description.params;
    let title = format!("{:?}, {:?} motion, seed {}", params.kind, params.motion, params.seed);
    let picture = figure::figure(&title, &panels::synthetic_pair(initial, deformed, truth, Some(mask))?);
    folder.write("phantom.svg", |p| io::write_text(p, &picture))?;
    Ok(())
}
