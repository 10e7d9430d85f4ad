//! What a scan can measure: known motions are imposed on it, and the same settings as of a run
//! measure them.

use crate::error::{FieldError, StrainError};
use crate::evaluate::coverage::BAND;
use crate::evaluate::metrics;
use crate::evaluate::waves::{Row, cut_off, gains, rows};
use crate::field::jacobian::count_folds;
use crate::matching::levels::foreground;
use crate::numerics::statistics::{noise_sigma, robust_deviation};
use crate::pipeline::clock::Clock;
use crate::pipeline::field::{self, FieldResult, Progress};
use crate::pipeline::input_checks;
use crate::pipeline::strain::{self, StrainInput, StrainParams};
use crate::strain::StrainField;
use crate::strain::gauge::Gauge;
use crate::synth::imposed::{Star, imposed, stretch, with_noise};
use crate::types::params::ModelSource;
use crate::types::{
    Certificate, DenseField, FieldParams, FieldSummary, Gain, GaugeNoise, Grid, Imposed, Mask, StrainMeasure, Volume,
    Voxels,
};
use rayon::prelude::*;

/// What a certificate is made of.
#[derive(Debug, Clone, Copy)]
pub struct CertifyInput<'a> {
    /// The scan.
    pub initial: &'a Voxels<'a>,
    /// A second scan at rest, on the same grid.
    pub second: Option<&'a Voxels<'a>>,
    /// Where there is tissue; what stands out of the background without.
    pub mask: Option<&'a Mask>,
    /// A measured motion to impose beside the others, on the scan's grid.
    pub like: Option<&'a DenseField>,
}

/// A certificate, with the smallest displacement above noise at each voxel (mm).
#[derive(Debug, Clone, PartialEq)]
pub struct Certified {
    /// The numbers.
    pub certificate: Certificate,
    /// Smallest displacement along an axis detected above noise, 95 % of the time (mm).
    pub detectable: Volume,
    /// Where there is tissue.
    pub tissue: Mask,
}

/// The known motions of a certificate.
struct ImposedMotion {
    /// Amplitude of the waves (voxels of the finest axis): that of the DIC Challenge 2.0.
    wave_amplitude_voxels: f64,
    /// Uniform strain (1).
    uniform_strain: f64,
}

const IMPOSED: ImposedMotion = ImposedMotion { wave_amplitude_voxels: 0.5, uniform_strain: 0.02 };

/// Gauge lengths whose noise is reported, in units of the shortest.
const GAUGE_MULTIPLES: [usize; 7] = [1, 2, 3, 4, 6, 8, 12];

/// Gauge length over a wavelength: a mean over a quarter of a wave keeps 90 % of its amplitude.
const GAUGE_PER_WAVELENGTH: f64 = 0.25;

/// Makes the pairs: a volume with a known motion, and a scan with noise of its own.
struct Pairs<'a> {
    input: CertifyInput<'a>,
    noise: f64,
    seed: u64,
}

impl Pairs<'_> {
    /// A pair whose displacement is `motion`; `draw` (0 or 1) gives it other noise.
    ///
    /// Of two scans one shows the motion and the other none, and the other way round: their noise
    /// is real. Of one scan both have noise added.
    fn of(&self, motion: &DenseField, draw: u64) -> [Volume; 2] {
        let initial = self.input.initial;
        match self.input.second {
            Some(second) => {
                let (moved, still) = if draw == 0 { (initial, second) } else { (second, initial) };
                [imposed(moved, motion), still.view().into_volume()]
            }
            None => {
                let seed = 1 + 2 * draw + 1000 * self.seed;
                [with_noise(&imposed(initial, motion), self.noise, seed), with_noise(initial, self.noise, seed + 1)]
            }
        }
    }

    /// What the difference of two draws is over their noise: with two scans the errors are each
    /// other's opposite.
    fn apart(&self) -> f64 {
        if self.input.second.is_some() { 2.0 } else { 2f64.sqrt() }
    }
}

/// Makes a certificate with the settings of a run; the motion model is always free, so that what
/// the scan cannot tell is not hidden by a smaller one.
///
/// # Errors
/// [`StrainError`] as [`field::run`] and [`crate::pipeline::strain::run`], or when grids differ.
///
/// ```no_run
/// use palpate::pipeline::certify::{CertifyInput, run};
/// use palpate::{FieldParams, io};
/// let scan = io::read_volume("scan.nii.gz")?;
/// let input = CertifyInput { initial: &scan, second: None, mask: None, like: None };
/// let found = run(input, &FieldParams::default(), &|_, _| {})?;
/// println!("displacement noise {:.3} mm", found.certificate.displacement_noise_mm);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// ```
/// use palpate::pipeline::certify::{CertifyInput, run};
/// use palpate::{Affine, FieldParams, Grid, Volume};
/// let affine = Affine::scaled([1.0; 3], [0.0; 3])?;
/// let [scan, other] = [16, 12].map(|n| Grid::new([n; 3], affine).map(|g| Volume::filled(g, 1.0)));
/// let (scan, other) = (scan?, other?);
/// // A second scan lies on the same grid.
/// let input = CertifyInput { initial: &scan, second: Some(&other), mask: None, like: None };
/// assert!(run(input, &FieldParams::default(), &|_, _| {}).is_err());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn run(input: CertifyInput<'_>, params: &FieldParams, progress: Progress<'_>) -> Result<Certified, StrainError> {
    let CertifyInput { initial, second, mask, like } = input;
    let grid = *initial.grid();
    let mut clock = Clock::start();
    let params = FieldParams { model: ModelSource::Free, ..params.clone() };
    let (tissue, noise) = checked(&input)?;
    let pairs = Pairs { input, noise, seed: params.seed };
    let stars = stars(&tissue);
    let total = (2 * stars.len() + 2 + usize::from(like.is_some()) + usize::from(second.is_some())) as f64;
    let mut runs = 0usize;
    let mut measure = |[a, b]: [Volume; 2]| -> Result<FieldResult, FieldError> {
        let before = runs as f64;
        runs += 1;
        field::run(&a, &b, mask, &params, &|stage, part| progress(stage, (before + part) / total))
    };

    // Waves of each length, along and across each axis; two draws of the noise.
    let (mut waves, mut differences): (Vec<Row>, Vec<DenseField>) = (Vec::new(), Vec::new());
    let mut variances = Volume::filled(grid, 0.0f32);
    for star in &stars {
        let truth = star.field(&grid);
        let FieldResult { displacement: first, uncertainty, .. } = measure(pairs.of(&truth, 0))?;
        let again = measure(pairs.of(&truth, 1))?.displacement;
        let variance = |at: usize| uncertainty.at(at).powi(2) / stars.len() as f32;
        variances.as_mut_slice().par_iter_mut().enumerate().for_each(|(at, v)| *v += variance(at));
        waves.extend(rows(&[&first, &again], &truth, &tissue, star.axes, |row| star.wavelength(row)));
        differences.push(scaled_difference(&first, &again, pairs.apart()));
    }
    clock.book("waves");
    let by_wavelength = gains(&waves);
    let [wavelength_90_mm, wavelength_50_mm] = [0.9, 0.5].map(|level| cut_off(&by_wavelength, level));
    let displacement_noise_mm = axis_deviation(&differences, &tissue);
    let by_gauge = noise_by_gauge(&differences, &tissue);
    let longest = by_wavelength.last().map_or(0.0, |g| g[0]);
    let wanted = GAUGE_PER_WAVELENGTH * wavelength_90_mm.unwrap_or(longest);
    let fallback = GaugeNoise { gauge_mm: 0.0, noise: 0.0, detectable: 0.0 };
    let chosen =
        by_gauge.iter().find(|g| g.gauge_mm >= wanted * 0.999).or(by_gauge.last()).copied().unwrap_or(fallback);
    clock.book("noise");

    // Rest, a uniform strain, and a motion such as was measured.
    let still = DenseField::zeros(grid);
    let at_rest = measure(pairs.of(&still, 0))?;
    let edge = grid.least_spacing();
    let detectable = Volume::from_voxels(grid, |at, _| match tissue.as_slice()[at] {
        0 => 0.0,
        // In waves: a field at rest is held smooth, and is sure of what it would not see.
        _ => BAND as f32 * variances.as_slice()[at].sqrt(),
    });
    let inside: Vec<usize> = (0..grid.len()).filter(|&at| tissue.as_slice()[at] != 0).collect();
    let blind = inside
        .iter()
        .filter(|&&at| f64::from(detectable.as_slice()[at]) > IMPOSED.wave_amplitude_voxels * edge)
        .count();
    let thick = (0..3).filter(|&a| grid.shape()[a] > 1).max_by_key(|&a| grid.shape()[a]).unwrap_or(0);
    let uniform = stretch(&grid, thick, IMPOSED.uniform_strain);
    let mut known = vec![(format!("uniform strain of {:.0} %", 100.0 * IMPOSED.uniform_strain), uniform)];
    known.extend(like.map(|like| ("the motion that was given".to_string(), like.clone())));
    let mut imposed = vec![compared("none (at rest)".into(), &at_rest, &still, &tissue, chosen.gauge_mm)?];
    for (motion, truth) in known {
        let found = measure(pairs.of(&truth, 0))?;
        imposed.push(compared(motion, &found, &truth, &tissue, chosen.gauge_mm)?);
    }
    // The two scans as they are: what moved between them is not noise alone.
    let as_they_are = |second: &Voxels<'_>| measure([initial.view().into_volume(), second.view().into_volume()]);
    let between = second.map(as_they_are).transpose()?.map(|found| found.summary);
    let rest_mm = between.as_ref().map(|s| s.mean_mm);
    let moved = between.filter(|s| s.mean_mm > s.expected.interval_mm[1]);
    clock.book("motions");
    let warnings = warnings(&by_wavelength, wavelength_90_mm, moved.as_ref());
    Ok(Certified {
        certificate: Certificate {
            image_noise: noise,
            image_noise_from: if second.is_some() { "repeat" } else { "estimated" },
            displacement_noise_mm,
            rest_mm,
            gauge_mm: chosen.gauge_mm,
            strain_noise: chosen.noise,
            strain_noise_by_gauge: by_gauge,
            amplitude_mm: IMPOSED.wave_amplitude_voxels * edge,
            gains: by_wavelength.iter().map(|&[wavelength_mm, gain]| Gain { wavelength_mm, gain }).collect(),
            wavelength_90_mm,
            wavelength_50_mm,
            blind_share: blind as f64 / inside.len().max(1) as f64,
            imposed,
            runs,
            seconds: clock.0,
            warnings,
        },
        detectable,
        tissue,
    })
}

/// The tissue and the deviation of the image's noise (intensity), where the input can be used.
fn checked(input: &CertifyInput<'_>) -> Result<(Mask, f64), StrainError> {
    let CertifyInput { initial, second, mask, like } = *input;
    let grid = *initial.grid();
    input_checks::mask_grid(initial, mask)?;
    same_grid(&grid, "the second scan", second.map(|s| s.grid()))?;
    same_grid(&grid, "the measured motion", like.map(|l| l.grid()))?;
    let tissue = mask.map_or_else(|| foreground(initial), |m| Mask::from_voxels(grid, |at, _| m.as_slice()[at].min(1)));
    let noise = image_noise(initial, second, &tissue);
    if second.is_some() && noise == 0.0 {
        let (what, hint) = ("is the same as the first".into(), "give another scan at rest, or one alone".into());
        return Err(FieldError::Volume { volume: "second", what, hint }.into());
    }
    match like.map(|l| count_folds(l, Some(&tissue))).transpose()?.filter(|folds| *folds > 0) {
        Some(voxels) => Err(StrainError::Folds { voxels }),
        None => Ok((tissue, noise)),
    }
}

fn same_grid(grid: &Grid, what: &str, other: Option<&Grid>) -> Result<(), FieldError> {
    match other.filter(|other| !other.same_as(grid)) {
        Some(other) => Err(FieldError::GridMismatch {
            what: what.into(),
            found: other.shape(),
            reference: "the scan".into(),
            expected: grid.shape(),
        }),
        None => Ok(()),
    }
}

/// Standard deviation of the noise in one scan: of two, that of their difference.
fn image_noise(initial: &Voxels<'_>, second: Option<&Voxels<'_>>, tissue: &Mask) -> f64 {
    let inside = |at: usize| tissue.as_slice()[at] != 0;
    let Some(second) = second else {
        return f64::from(noise_sigma(initial.as_slice(), initial.grid().shape(), inside));
    };
    let pairs = initial.as_slice().iter().zip(second.as_slice()).enumerate();
    let apart = pairs.filter(|&(at, _)| inside(at)).map(|(_, (a, b))| f64::from(a - b));
    robust_deviation(apart.filter(|d| d.is_finite())) / 2f64.sqrt()
}

/// Waves along one axis that grow along the next and move along the third, for each thick axis; in
/// a slice they move along the axis that they grow along.
fn stars(tissue: &Mask) -> Vec<Star> {
    let grid = tissue.grid();
    let amplitude = IMPOSED.wave_amplitude_voxels * grid.least_spacing();
    let thick: Vec<usize> = (0..3).filter(|&a| grid.shape()[a] > 1).collect();
    let n = thick.len();
    (0..n).map(|i| Star::over(tissue, [thick[i], thick[(i + 1) % n], thick[(i + 2) % n]], amplitude)).collect()
}

/// The difference of two fields over `by`.
fn scaled_difference(a: &DenseField, b: &DenseField, by: f64) -> DenseField {
    DenseField::from_voxels(*a.grid(), |at, _| {
        let (a, b) = (a.at(at), b.at(at));
        std::array::from_fn(|c| f64::from(a[c] - b[c]) / by)
    })
}

/// Root mean square of the fields along an axis over the tissue (mm).
fn axis_deviation(fields: &[DenseField], tissue: &Mask) -> f64 {
    let axes = (0..3).filter(|&a| tissue.grid().shape()[a] > 1).count().max(1) as f64;
    let inside: Vec<usize> = (0..tissue.grid().len()).filter(|&at| tissue.as_slice()[at] != 0).collect();
    let square = |f: &DenseField| {
        inside.par_iter().map(|&at| f.at(at).iter().map(|v| f64::from(v * v)).sum::<f64>()).sum::<f64>()
    };
    (fields.iter().map(square).sum::<f64>() / (axes * (fields.len() * inside.len()).max(1) as f64)).sqrt()
}

/// Root mean square normal strain over the tissue (1).
fn normal_strain(strain: &StrainField, tissue: &Mask) -> f64 {
    let axes = (0..3).filter(|&a| tissue.grid().shape()[a] > 1).count().max(1) as f64;
    let (mut sum, mut count) = (0.0, 0usize);
    for at in (0..tissue.grid().len()).filter(|&at| tissue.as_slice()[at] != 0) {
        sum += strain.at(at)[..3].iter().map(|e| e * e).sum::<f64>();
        count += 1;
    }
    (sum / (axes * count.max(1) as f64)).sqrt()
}

/// Noise of a normal strain by gauge, from fields of noise alone.
fn noise_by_gauge(noise: &[DenseField], tissue: &Mask) -> Vec<GaugeNoise> {
    let grid = tissue.grid();
    let shortest = Gauge::shortest(grid).finest_mm(grid);
    let widest = (0..3).filter(|&a| grid.shape()[a] > 1).map(|a| grid.shape()[a] as f64 * grid.spacing()[a]);
    let widest = widest.fold(f64::INFINITY, f64::min) / 2.0;
    let of = |times: usize| {
        let gauge_mm = times as f64 * shortest;
        let gauge = Gauge::of_length(grid, gauge_mm);
        let square = |f: &DenseField| {
            normal_strain(&StrainField::of(f, tissue.as_slice(), gauge, StrainMeasure::Small), tissue).powi(2)
        };
        let noise = (noise.iter().map(square).sum::<f64>() / noise.len().max(1) as f64).sqrt();
        GaugeNoise { gauge_mm, noise, detectable: BAND * noise }
    };
    GAUGE_MULTIPLES.into_iter().filter(|&t| t == 1 || t as f64 * shortest <= widest).map(of).collect()
}

/// How a known motion came back.
fn compared(
    motion: String,
    found: &FieldResult,
    truth: &DenseField,
    tissue: &Mask,
    gauge_mm: f64,
) -> Result<Imposed, StrainError> {
    let grid = *truth.grid();
    let scored = metrics(&found.displacement, truth, Some(tissue), &[])?;
    let input = StrainInput { bodies: tissue, ..StrainInput::of(found) };
    let params = StrainParams { gauge_mm: Some(gauge_mm), ..StrainParams::default() };
    let own = strain::run(input, &params, &|_, _| {})?;
    let gauge = Gauge::of_length(&grid, gauge_mm);
    let exact = StrainField::of(truth, tissue.as_slice(), gauge, StrainMeasure::GreenLagrange);
    let (mut square, mut held, mut count) = (0.0, 0usize, 0usize);
    for at in (0..grid.len()).filter(|&at| tissue.as_slice()[at] != 0) {
        let sd = own.deviation.at(grid.centre(at));
        let (e, t) = (own.strain.at(at), exact.at(at));
        for c in (0..3).filter(|&c| sd[c] > 0.0) {
            square += (e[c] - t[c]).powi(2);
            held += usize::from((e[c] - t[c]).abs() < BAND * sd[c]);
            count += 1;
        }
    }
    let count = count.max(1) as f64;
    Ok(Imposed {
        motion,
        motion_mm: scored.identity_mm,
        error_mm: scored.mean_mm,
        expected_mm: found.summary.expected.mean_mm,
        strain_error: (square / count).sqrt(),
        strain_held: held as f64 / count,
    })
}

/// What the user should know; `moved` is what a run says of two scans that are not at rest.
fn warnings(gains: &[[f64; 2]], cut: Option<f64>, moved: Option<&FieldSummary>) -> Vec<String> {
    let mut out = Vec::new();
    match (gains.first(), gains.last(), cut) {
        (_, Some(longest), None) => out.push(format!(
            "no wave came back to 90 %, up to {:.1} mm, the longest that fits into the tissue: small features cannot be measured",
            longest[0]
        )),
        (Some(first), _, Some(cut)) if cut <= first[0] => out.push(format!(
            "even the shortest wave, {cut:.1} mm, came back to 90 %: the true limit is shorter"
        )),
        (None, ..) => out.push("the tissue is too small for any wave: the resolution is unknown".into()),
        _ => {}
    }
    if let Some(moved) = moved {
        out.push(format!(
            "between the two scans the tissue moved by {:.3} mm on average, where {:.3} mm of error is expected: they are not at rest, and \
             their difference passes for noise",
            moved.mean_mm, moved.expected.mean_mm
        ));
    }
    out
}
