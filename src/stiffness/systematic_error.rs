//! Errors that are everywhere at once, which no block of one body shows: of a model that is not
//! quite right, and of the measured field.

use crate::error::StiffnessError;
use crate::numerics::cholesky::Cholesky;
use crate::stiffness::identify::{Estimate, Setup};
use crate::types::space::dot;

/// Cosine between a wrong model's residual and a modulus's sensitivity: from bodies of an
/// independent solver with other shapes, patches and laws.
const MODEL_ERROR_COSINE: f64 = 0.15;

/// By how much less data tell whose error `share` (of its squares) is everywhere at once, of so
/// many samples.
pub(crate) fn dilution(share: f64, samples: f64) -> f64 {
    MODEL_ERROR_COSINE * MODEL_ERROR_COSINE * samples * share
}

impl Setup<'_> {
    /// The part of a residual's squares (their sum in units of the observations' sigma, and root
    /// mean square in mm) that is no noise of single samples: at least the model's own error.
    fn share(&self, squares: f64, rms: f64, samples: f64) -> f64 {
        let own = self.noise.map_or(0.0, |noise| 1.0 - (noise / rms.max(f64::MIN_POSITIVE)).powi(2));
        own.max(self.floor * self.floor * samples / squares.max(f64::MIN_POSITIVE)).clamp(0.0, 1.0)
    }

    /// Samples for each independent one of an estimate.
    pub(super) fn dilution(&self, estimate: &Estimate) -> f64 {
        let samples = 3.0 * estimate.residuals.len() as f64;
        let together = dilution(self.share(estimate.squares, estimate.rms, samples), samples);
        together.max(samples / estimate.effective)
    }

    /// Variance of a weighted square, in units of the observations' sigma: that of an independent
    /// sample.
    pub(super) fn variance(&self, estimate: &Estimate) -> f64 {
        estimate.squares / (3.0 * estimate.residuals.len() as f64) * self.dilution(estimate)
    }
}

/// What a fit says of its parameters.
#[derive(Debug, Clone, Default)]
pub struct Fit {
    /// Displacement at the observations for a unit of each parameter.
    pub rows: Vec<Vec<[f64; 3]>>,
    /// Normal matrix over the variance of the residuals, without prior (row by row).
    pub information: Vec<f64>,
    /// 1 / variance and present distance of each parameter's prior.
    pub prior: Vec<(f64, f64)>,
    /// What is left over (mm, root mean square of one component).
    pub rms: f64,
    /// Its weighted squares.
    pub squares: f64,
    /// These as they were over themselves: less than 1 where no residual was taken to be smaller
    /// than the model's own error.
    pub raw: f64,
}

impl Fit {
    /// Of an estimate as it is.
    pub fn of(setup: &Setup<'_>, estimate: &Estimate) -> Self {
        Self {
            rows: estimate.rows.clone(),
            information: estimate.information.clone(),
            prior: setup.prior_terms(&estimate.state),
            rms: estimate.rms,
            squares: estimate.squares,
            raw: estimate.raw,
        }
    }

    /// What the parameters' covariance (row by row) has besides the scatter of the residuals:
    /// of what the model leaves over, `misfit` (mm, one component), and of draws of the field's
    /// error at the observations (mm, RAS).
    ///
    /// # Errors
    /// [`StiffnessError::Unsolvable`] where the data leave a parameter open.
    pub(crate) fn coherent(
        &self,
        setup: &Setup<'_>,
        estimate: &Estimate,
        misfit: f64,
        draws: &[Vec<[f64; 3]>],
    ) -> Result<Vec<f64>, StiffnessError> {
        let p = self.prior.len();
        let samples = 3.0 * estimate.residuals.len() as f64;
        let beyond = (misfit / self.rms.max(f64::MIN_POSITIVE)).powi(2) * self.raw;
        let least = setup.floor * setup.floor * samples / self.squares.max(f64::MIN_POSITIVE);
        let part = dilution(beyond.max(least), samples);
        // Data that are off together by so much know that much less, and priors hold the rest.
        let known = |weight: f64| {
            let mut a: Vec<f64> = self.information.iter().map(|v| weight * v).collect();
            self.prior.iter().enumerate().for_each(|(k, (prior, _))| a[k * p + k] += prior);
            Cholesky::new(a, p).ok_or(StiffnessError::Unsolvable)
        };
        let mut out = known(1.0 / part.max(1.0))?.inverse();
        if part < 1.0 {
            out.iter_mut().for_each(|v| *v *= part);
        }
        let factor = known(1.0)?;
        let weights = setup.weights(&estimate.residuals, setup.scale(&estimate.residuals));
        let variance = self.squares / (samples - p as f64).max(1.0);
        for draw in draws {
            let score = |row: &Vec<[f64; 3]>| {
                let all = row.iter().zip(draw).zip(&weights);
                all.map(|((row, error), w)| w * dot(*row, *error)).sum::<f64>() / variance
            };
            let mut off: Vec<f64> = self.rows.iter().map(score).collect();
            factor.solve(&mut off);
            let share = 1.0 / draws.len() as f64;
            out.iter_mut().enumerate().for_each(|(i, v)| *v += share * off[i / p] * off[i % p]);
        }
        Ok(out)
    }
}
