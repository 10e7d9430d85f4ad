//! Whether the data support one more region.
//!
//! Three things must hold. *Discrepancy*: the present model's misfit beyond the noise must show.
//! Samples are means over voxels; with their noise n, sqrt(n^2 + misfit^2) > 1.1 n, since the noise
//! of a measured field is not known to better than that. Nor is it known to be white: with the
//! field's own roughness s (a voxel), misfit^2 > s^2 / 10. A tenth of a voxel's power that is
//! smooth over a few voxels is not seen in its roughness and does not average out. *Geometry*: the
//! misfit must exceed what a surface known to half a voxel explains, half a voxel times the strain.
//! *Evidence*: the Bayesian information criterion, by effective samples, must fall by more than 10
//! and the misfit by a fifth, and the new region's modulus must differ from the first one's by two
//! standard deviations and by a quarter.

use crate::error::StiffnessError;
use crate::stiffness::boundary_conditions::travel;
use crate::stiffness::identify::{Estimate, State};
use crate::stiffness::inclusion::SHAPE_FUNCTIONS;
use crate::stiffness::mesh_problem::{Level, MESH_ERROR_VOXELS};
use crate::stiffness::model_selection::{MIN_BIC_GAIN, bic};
use crate::stiffness::systematic_error::Fit;
use crate::types::space::dot;
use crate::types::stiffness::{Evidence, Law, LeftOver, StiffnessParams};

/// Residual over the noise of a sample from which the misfit is significant (1).
const MIN_DISCREPANCY: f64 = 1.1;
/// Power of the misfit over that of a voxel's noise from which it is significant (1).
const MIN_NOISE_POWER_FRACTION: f64 = 0.1;

/// Standard deviation of a mesh about the body's surface between voxels (voxels): 0.04 to 0.08 for
/// balls and ellipsoids.
const MESH_SURFACE_SD_VOXELS: f64 = 0.1;

/// The case for more regions, so far.
#[derive(Debug)]
pub(crate) struct Support {
    /// Roughness of a voxel and of a sample (mm).
    noise: [f64; 2],
    /// What geometry alone may do (mm).
    geometry: f64,
    /// The error of the finite elements (mm).
    floor: f64,
    /// Squares, misfit beyond the noise (mm), effective samples and parameters of the model that
    /// stands.
    squares: f64,
    misfit: f64,
    effective: f64,
    parameters: usize,
    rms: f64,
    /// What was tried.
    pub evidence: Vec<Evidence>,
}

/// Identifies labelled regions on a coarse mesh, from the state of another mesh of the body.
///
/// # Errors
/// As [`crate::stiffness::identify::Setup::run`].
pub fn identify(
    level: &Level,
    law: Law,
    params: &StiffnessParams,
    from: (&Level, &State),
) -> Result<Estimate, StiffnessError> {
    level.setup(law, params, level.largest()).run(level.carry(from.0, from.1), 12, 1e-4)
}

/// Why a model is not taken whose criterion falls by `gain`.
fn too_little(gain: f64) -> String {
    match gain >= 0.0 {
        true => format!("the criterion falls by {gain:.0} only, {MIN_BIC_GAIN} are needed"),
        false => format!("the criterion rises by {:.0}, and should fall by {MIN_BIC_GAIN}", -gain),
    }
}

impl Support {
    /// From the identification of one region; `rms` is what it leaves over (mm) with the surface
    /// where the data put it.
    pub fn new(level: &Level, e: &Estimate, rms: f64) -> Self {
        let (held, load) = (&level.patches[0], &level.patches[1]);
        let travel = travel(&level.patches);
        let apart: [f64; 3] = std::array::from_fn(|a| load.middle[a] - held.middle[a]);
        let strain = dot(travel, travel).sqrt() / dot(apart, apart).sqrt().max(1e-9);
        let (sample, noise) = (level.noise, level.noise * (level.block.max(1) as f64).powf(1.5));
        let misfit = (rms * rms - sample * sample).max(0.0).sqrt();
        let mut out = Self {
            noise: [noise, sample],
            geometry: MESH_SURFACE_SD_VOXELS * level.voxel * strain,
            floor: MESH_ERROR_VOXELS * level.voxel,
            squares: e.squares,
            misfit,
            effective: e.effective,
            parameters: e.parameters,
            rms: e.rms,
            evidence: Vec::new(),
        };
        let reason = match out.refusal() {
            Some(why) => format!("the data do not support a second region: {why}"),
            None => format!("its misfit of {misfit:.4} mm stands out of noise and geometry"),
        };
        let chosen = !out.may_hold_more();
        out.push(1, chosen, reason);
        out
    }

    fn show(&mut self, evidence: Evidence) {
        log::debug!("{evidence}");
        self.evidence.push(evidence);
    }

    fn push(&mut self, count: usize, chosen: bool, reason: String) {
        self.show(Evidence {
            question: "regions",
            model: count.to_string(),
            parameters: self.parameters,
            residual_mm: self.rms,
            bic: bic(self.squares, self.effective, self.parameters),
            chosen,
            reason,
        });
    }

    fn refusal(&self) -> Option<String> {
        let [voxel, sample] = self.noise;
        if !self.stands_out() {
            let shown = sample.hypot(self.misfit) / sample.max(1e-12);
            return Some(format!(
                "its misfit of {:.4} mm does not stand out of samples noisy by {sample:.4} mm ({shown:.2} times, {MIN_DISCREPANCY} needed)",
                self.misfit
            ));
        }
        let part = (self.misfit / voxel.max(1e-12)).powi(2);
        if part <= MIN_NOISE_POWER_FRACTION {
            return Some(format!(
                "its misfit of {:.4} mm stands out of samples noisy by {sample:.4} mm, but is {part:.2} of the power of what a voxel is \
                 rough by, {voxel:.4} mm ({MIN_NOISE_POWER_FRACTION} needed)",
                self.misfit
            ));
        }
        (self.misfit <= self.geometry).then(|| {
            format!(
                "its misfit of {:.4} mm is no more than the surface, known to a tenth of a voxel, explains ({:.4} mm)",
                self.misfit, self.geometry
            )
        })
    }

    fn stands_out(&self) -> bool {
        self.noise[1].hypot(self.misfit) > MIN_DISCREPANCY * self.noise[1]
    }

    /// What the model that stands leaves over of the field, where that is more than noise.
    pub fn left(&self) -> Option<LeftOver> {
        self.stands_out().then_some(LeftOver { misfit_mm: self.misfit, surface_mm: self.geometry })
    }

    /// Whether a further region is worth a search.
    pub(crate) fn may_hold_more(&self) -> bool {
        self.refusal().is_none()
    }

    /// The residual (mm, one component of a sample) at which a map explains the data.
    pub fn target(&self) -> f64 {
        self.noise[1].hypot(0.5 * self.geometry)
    }

    /// There is no estimate with this number of regions: neither a residual nor a criterion.
    pub fn none(&mut self, count: usize, why: &str) {
        self.show(Evidence {
            question: "regions",
            model: count.to_string(),
            parameters: 0,
            residual_mm: f64::INFINITY,
            bic: f64::INFINITY,
            chosen: false,
            reason: why.into(),
        });
        self.close();
    }

    /// The least misfit (mm) that would lead to a second region.
    pub(crate) fn least_seen(&self) -> f64 {
        let [voxel, sample] = self.noise;
        let noise = sample.max(self.floor);
        let stands_out = (MIN_DISCREPANCY * MIN_DISCREPANCY - 1.0).sqrt() * sample;
        let asked = MIN_BIC_GAIN + (1 + SHAPE_FUNCTIONS) as f64 * self.effective.max(2.0).ln();
        let by_criterion = noise * (asked / self.effective.max(1.0)).exp_m1().sqrt();
        [stands_out, MIN_NOISE_POWER_FRACTION.sqrt() * voxel, self.geometry, by_criterion]
            .into_iter()
            .fold(0.0, f64::max)
    }

    /// Judges the estimate with `count` regions, which leaves over `rms` (mm) with the surface
    /// where the data put it; true makes it the model that stands.
    pub(crate) fn accept(&mut self, level: &Level, e: &Estimate, count: usize, rms: f64) -> bool {
        let misfit = (rms * rms - self.noise[1] * self.noise[1]).max(0.0).sqrt();
        let parameters = e.parameters + SHAPE_FUNCTIONS * (count - 1);
        let samples = self.effective.min(e.effective);
        let gain = bic(self.squares, samples, self.parameters) - bic(e.squares, samples, parameters);
        let setup = level.setup(Law::Linear, &StiffnessParams::default(), level.largest());
        let coherent = Fit::of(&setup, e).coherent(&setup, e, misfit, &[]).unwrap_or_default();
        let contrast = setup
            .free()
            .iter()
            .enumerate()
            .map(|(k, &r)| {
                let at = k * e.parameters + k;
                let sd = (e.covariance[at].max(0.0) + coherent.get(at).copied().unwrap_or(f64::INFINITY)).sqrt();
                (e.state.theta[r].abs(), sd)
            })
            // The one that stands out least.
            .fold((f64::INFINITY, 1.0), |m, c| if c.0 / c.1 < m.0 / m.1 { c } else { m });
        let why = if gain <= MIN_BIC_GAIN {
            Some(too_little(gain))
        } else if misfit > 0.8 * self.misfit {
            Some(format!("the misfit falls from {:.4} to {misfit:.4} mm only", self.misfit))
        } else if contrast.0 < (2.0 * contrast.1).max(0.22) {
            Some(format!(
                "its modulus differs by a factor of {:.2} only, known to {:.0} %",
                contrast.0.exp(),
                100.0 * contrast.1
            ))
        } else {
            None
        };
        let mut trial = Self { evidence: Vec::new(), ..*self };
        (trial.squares, trial.misfit, trial.rms, trial.parameters) = (e.squares, misfit, e.rms, parameters);
        trial.effective = samples;
        let accepted = why.is_none();
        let reason = match why {
            Some(why) => why,
            None => format!("the criterion falls by {gain:.0}, the misfit from {:.4} to {misfit:.4} mm", self.misfit),
        };
        trial.push(count, false, reason);
        self.evidence.append(&mut trial.evidence);
        if accepted {
            let evidence = std::mem::take(&mut self.evidence);
            *self = Self { evidence, ..trial };
        }
        self.close_at(if accepted { count } else { count - 1 });
        accepted
    }

    fn close(&mut self) {
        let standing = self.evidence.iter().rposition(|e| e.bic.is_finite()).unwrap_or(0);
        self.evidence.iter_mut().enumerate().for_each(|(i, e)| e.chosen = i == standing);
    }

    fn close_at(&mut self, count: usize) {
        let name = count.to_string();
        self.evidence.iter_mut().for_each(|e| e.chosen = e.model == name);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_criterion_that_rises_is_said_to_rise() {
        assert_eq!(too_little(-901.2), "the criterion rises by 901, and should fall by 10");
        assert_eq!(too_little(4.0), "the criterion falls by 4 only, 10 are needed");
    }

    /// What is said of one region with a misfit (mm) under noise of a voxel and of a sample of
    /// eight.
    fn said(noise: f64, misfit: f64) -> (bool, Option<LeftOver>) {
        let noise = [noise, noise / 8f64.sqrt()];
        let (squares, effective, parameters, rms) = (1.0, 100.0, 6, misfit);
        let floor = 0.005;
        let s = Support {
            noise,
            geometry: 0.015,
            floor,
            squares,
            misfit,
            effective,
            parameters,
            rms,
            evidence: Vec::new(),
        };
        (s.may_hold_more(), s.left())
    }

    #[test]
    fn a_misfit_must_stand_out_of_a_sample_and_be_more_than_a_trace_of_a_voxels_noise() {
        let left = |misfit_mm| Some(LeftOver { misfit_mm, surface_mm: 0.015 });
        assert_eq!(said(0.0, 0.0), (false, None));
        assert_eq!(said(0.1, 0.014), (false, None));
        assert_eq!(said(0.1, 0.03), (false, left(0.03)));
        assert_eq!(said(0.1, 0.033), (true, left(0.033)));
        // The surface may be it.
        assert_eq!(said(0.0, 0.014), (false, left(0.014)));
        assert_eq!(said(0.0, 0.016), (true, left(0.016)));
    }
}
