//! What a scan can measure.

use serde::Serialize;

/// The share of a wave's amplitude that comes back.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Gain {
    /// Wavelength (mm).
    pub wavelength_mm: f64,
    /// Share of the amplitude (1).
    pub gain: f64,
}

/// The noise of strain over a gauge.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct GaugeNoise {
    /// Gauge length (mm).
    pub gauge_mm: f64,
    /// Standard deviation of a normal strain (1).
    pub noise: f64,
    /// The smallest normal strain detected above noise, 95 % of the time (1).
    pub detectable: f64,
}

/// How a known motion came back.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Imposed {
    /// Which motion, in words.
    pub motion: String,
    /// Mean displacement magnitude (mm).
    pub motion_mm: f64,
    /// Mean length of the error (mm).
    pub error_mm: f64,
    /// The error that the field expected of itself (mm).
    pub expected_mm: f64,
    /// Root mean square error of a normal strain over the gauge of the certificate (1).
    pub strain_error: f64,
    /// Share of the errors of strain in the 95 % band that was stated (1).
    pub strain_held: f64,
}

/// What a scan can measure, by known motions that were imposed on it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Certificate {
    /// Standard deviation of the noise in the volume (intensity), and where it comes from.
    pub image_noise: f64,
    /// "repeat" scan or "estimated".
    pub image_noise_from: &'static str,
    /// Standard deviation of a displacement along an axis by noise (mm).
    pub displacement_noise_mm: f64,
    /// Mean displacement found between the two scans at rest (mm); none without a second one.
    pub rest_mm: Option<f64>,
    /// The gauge that the first line speaks of (mm).
    pub gauge_mm: f64,
    /// Standard deviation of a normal strain over it (1).
    pub strain_noise: f64,
    /// Noise by gauge length.
    pub strain_noise_by_gauge: Vec<GaugeNoise>,
    /// Amplitude of the waves (mm).
    pub amplitude_mm: f64,
    /// Gain by wavelength.
    pub gains: Vec<Gain>,
    /// Wavelength at which 90 % of the amplitude come back (mm); none: it never does.
    pub wavelength_90_mm: Option<f64>,
    /// The same of 50 %.
    pub wavelength_50_mm: Option<f64>,
    /// Part of the tissue where a wave of that amplitude is not told from noise (1).
    pub blind_share: f64,
    /// Known motions and how they came back.
    pub imposed: Vec<Imposed>,
    /// Runs of the field.
    pub runs: usize,
    /// Stage names and wall seconds.
    pub seconds: Vec<(String, f64)>,
    /// What the user should know.
    pub warnings: Vec<String>,
}
