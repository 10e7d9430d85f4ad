//! The fields of a sequence to one stiffness map.

use crate::error::StiffnessError;
use crate::stiffness::fields;
use crate::stiffness::sequence::{Said, combine};
use crate::types::stiffness::{
    Determined, FrameStiffness, Gain, Law, LawChoice, RegionStiffness, SharedStiffness, StiffnessParams,
    StiffnessResult,
};
use crate::types::{Displacement, Mask};

/// Collects frames, the one that moved most first, so that a sequence is never in memory as a
/// whole.
#[derive(Debug, Default)]
pub struct Sequence {
    law: Option<Law>,
    /// The frame that determines most regions, of those that do the first, and its number.
    best: Option<(usize, StiffnessResult)>,
    frames: Vec<FrameStiffness>,
    failure: Option<StiffnessError>,
}

impl Sequence {
    /// Parameters for the next frame: those that move less are solved with the law of the first.
    pub fn params(&self, wanted: &StiffnessParams) -> StiffnessParams {
        let model = self.law.map_or(wanted.model, LawChoice::from);
        StiffnessParams { model, ..wanted.clone() }
    }

    /// Takes the outcome of a frame.
    pub fn add(&mut self, frame: usize, motion_mm: f64, outcome: Result<StiffnessResult, StiffnessError>) {
        let (residual_mm, regions) = match outcome {
            Ok(result) => {
                let regions = Ok(result.regions.clone());
                let residual = result.residual_mm;
                self.law.get_or_insert(result.law);
                let determined = |r: &StiffnessResult| r.regions.iter().filter(|r| r.identifiable).count();
                if self.best.as_ref().is_none_or(|(_, best)| determined(&result) > determined(best)) {
                    self.best = Some((frame, result));
                }
                (residual, regions)
            }
            Err(error) => {
                let why = Err(error.to_string());
                self.failure.get_or_insert(error);
                (f64::NAN, why)
            }
        };
        self.frames.push(FrameStiffness { frame, motion_mm, residual_mm, regions });
    }

    /// The shared map on the grid of `labels`.
    ///
    /// # Errors
    /// The first frame's error when no frame could be solved.
    ///
    /// ```
    /// use palpate::error::StiffnessError;
    /// use palpate::pipeline::stiffness_sequence::Sequence;
    /// use palpate::{Affine, Grid, Mask};
    /// let labels = Mask::filled(Grid::new([8; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?, 1);
    /// let mut sequence = Sequence::default();
    /// sequence.add(1, 0.4, Err(StiffnessError::NoEquilibrium));
    /// // A sequence of frames that tell nothing tells why.
    /// assert!(matches!(sequence.finish(&labels), Err(StiffnessError::NoEquilibrium)));
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn finish(self, labels: &Mask) -> Result<SharedStiffness, StiffnessError> {
        let Some((shown, mut result)) = self.best else {
            return Err(self.failure.unwrap_or(StiffnessError::NoEquilibrium));
        };
        let count = result.regions.len();
        let of = |r: usize| -> Vec<Said<'_>> {
            self.frames.iter().filter_map(|f| Some((f.regions.as_ref().ok()?.get(r)?, f.motion_mm))).collect()
        };
        let ratios: Vec<Vec<Gain>> = (0..count).map(|r| combine(&of(r), 1)).collect();
        let gains: Vec<Vec<Gain>> =
            if result.absolute { (0..count).map(|r| combine(&of(r), 0)).collect() } else { ratios.clone() };
        for ((region, gain), ratio) in result.regions.iter_mut().zip(&gains).zip(&ratios) {
            let (Some(gain), Some(ratio)) = (gain.last(), ratio.last()) else { continue };
            (region.identifiable, region.bound, region.state) = (true, None, Determined::Determined);
            (region.youngs_modulus, region.sd) = (gain.value, gain.sd);
            (region.ratio, region.ratio_sd) = (ratio.value, ratio.sd);
            let of_region = result.mesh.labels().iter().zip(&mut result.element_modulus);
            of_region.filter(|(l, _)| **l == region.label).for_each(|(_, e)| *e = gain.value);
        }
        // What one frame does not determine another may.
        let determined = |w: &String| {
            let said = |r: &&RegionStiffness| r.identifiable && w.starts_with(&fields::not_determined(&r.name));
            result.regions.iter().any(|r| said(&r))
        };
        let warnings = result.warnings.iter().filter(|w| !determined(w)).map(|w| format!("frame {shown}: {w}"));
        result.warnings = warnings.collect();
        let names: Vec<u8> = result.regions.iter().map(|r| r.label).collect();
        result.map = fields::by_label(labels, &names, &|r| result.regions[r].youngs_modulus);
        result.map_sd = fields::by_label(labels, &names, &|r| result.regions[r].sd);
        let lost = self.frames.iter().filter(|f| f.regions.is_err()).count();
        if lost > 0 {
            result.warnings.push(format!("{lost} frames tell nothing; frames.csv says why"));
        }
        for (r, (region, gain)) in result.regions.iter().zip(&gains).enumerate() {
            if let Some(last) = gain.last().filter(|g| g.disagreement > 2.0) {
                let off = |f: &FrameStiffness| {
                    let own = f.regions.as_ref().ok()?.get(r).filter(|own| own.identifiable)?;
                    let value = if result.absolute { own.youngs_modulus } else { own.ratio };
                    Some(((value / last.value).ln().abs(), f.frame))
                };
                let worst = self.frames.iter().filter_map(off).max_by(|a, b| a.0.total_cmp(&b.0)).map_or(0, |w| w.1);
                result.warnings.push(format!(
                    "{}: frames differ by {:.1} times what they claim, frame {worst} most (frames.csv): check that frame, and that --forces stand in the frames' order and count from the reference",
                    region.name, last.disagreement
                ));
            }
        }
        Ok(SharedStiffness { result, frames: self.frames, gains })
    }
}

/// Mean displacement magnitude in the body (mm), where it is finite; NaN where it is nowhere.
///
/// ```
/// use palpate::pipeline::stiffness_sequence::motion;
/// use palpate::{Affine, DenseField, Grid, Mask};
/// let grid = Grid::new([8; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let field = DenseField::from_fn(grid, |_| [0.0, 3.0, 4.0]);
/// assert_eq!(motion(&field, &Mask::filled(grid, 1)), 5.0);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn motion(field: &Displacement<'_>, labels: &Mask) -> f64 {
    let inside = labels.as_slice();
    let (mut sum, mut count) = (0.0, 0.0);
    let seen = (0..inside.len()).filter(|&o| inside[o] > 0).map(|o| field.at(o));
    for u in seen.filter(|u| u.iter().all(|v| v.is_finite())) {
        sum += u.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
        count += 1.0;
    }
    sum / count
}
