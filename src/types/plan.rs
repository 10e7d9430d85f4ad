//! A stiffness measurement before it is made: what is asked, and what is to be expected.

use crate::error::ParamError;
use crate::types::stiffness::{Contact, StiffnessParams};
use serde::Serialize;

/// Parameters of [`crate::pipeline::experimental_design`].
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PlanParams {
    /// Assumed Young's modulus of each label (kPa).
    pub moduli: Vec<(u8, f64)>,
    /// Wanted standard deviation of each modulus over the modulus (1).
    pub want: f64,
    /// How far the plate goes in (mm); empty for [`Self::DEFAULT_PRESSES`] of the body's extent.
    pub press_mm: Vec<f64>,
    /// Edge of a voxel (mm, the finest axis); empty for that of the labels.
    pub voxel_mm: Vec<f64>,
    /// Standard deviation of the displacement of one voxel along an axis (mm); empty for
    /// [`Self::DEFAULT_NOISES`] of each voxel size.
    pub noise_mm: Vec<f64>,
    /// How a flat loaded patch touches its plate: sticking or sliding. A curved one always slides.
    pub contact: Contact,
    /// Whether the force stays unknown, so that ratios to the largest region are what is wanted.
    pub ratios: bool,
    /// Poisson's ratios, deviation of the borders, number of nodes: as the measurement takes them.
    pub stiffness: StiffnessParams,
}

impl Default for PlanParams {
    fn default() -> Self {
        Self {
            moduli: Vec::new(),
            want: 0.1,
            press_mm: Vec::new(),
            voxel_mm: Vec::new(),
            noise_mm: Vec::new(),
            contact: Contact::Sticking,
            ratios: false,
            stiffness: StiffnessParams::default(),
        }
    }
}

impl PlanParams {
    /// Presses that are tried, over the body's extent along the load (1): from what shows at all to
    /// what the linear law bears.
    pub const DEFAULT_PRESSES: [f64; 5] = [0.005, 0.01, 0.02, 0.04, 0.08];
    /// Noise that is tried, over the edge of a voxel (1): of correlation on good images to poor
    /// ones.
    pub const DEFAULT_NOISES: [f64; 3] = [0.05, 0.1, 0.2];
    /// Largest number of presses, voxel sizes or noises.
    pub(crate) const MAX_CHOICES: usize = 20;

    /// Assumed Young's modulus of a label (kPa).
    pub fn modulus(&self, label: u8) -> Option<f64> {
        self.moduli.iter().find(|m| m.0 == label).map(|m| m.1)
    }

    /// Checks every range.
    ///
    /// # Errors
    /// [`ParamError`] names the first value out of range.
    pub fn check(&self) -> Result<(), ParamError> {
        self.stiffness.check()?;
        let positive = |v: f64| v > 0.0 && v.is_finite();
        if let Some(m) = self.moduli.iter().find(|m| !positive(m.1)) {
            return Err(ParamError {
                name: "modulus",
                value: m.1,
                range: "above 0 kPa; give the value that you expect",
            });
        }
        if !(0.001..=1.0).contains(&self.want) {
            let range = "0.1 to 100 per cent: the deviation that you want of each modulus, 10 say";
            return Err(ParamError { name: "want", value: 100.0 * self.want, range });
        }
        for (name, values) in [("press", &self.press_mm), ("voxel", &self.voxel_mm), ("noise", &self.noise_mm)] {
            if let Some(&value) = values.iter().find(|v| !positive(**v)) {
                return Err(ParamError { name, value, range: "above 0 mm; give lengths in mm, as 0.5,1,2" });
            }
            if values.len() > Self::MAX_CHOICES {
                let value = values.len() as f64;
                return Err(ParamError { name, value, range: "a list of 20 values at most; leave some out" });
            }
        }
        Ok(())
    }
}

/// What one choice of press, voxel size and noise gives of one region.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Expected {
    /// How far the plate goes in (mm).
    pub press_mm: f64,
    /// Edge of a voxel (mm).
    pub voxel_mm: f64,
    /// Standard deviation of the displacement of one voxel along an axis (mm).
    pub noise_mm: f64,
    /// The region's label.
    pub label: u8,
    /// Its name.
    pub name: String,
    /// Expected standard deviation of the modulus (or ratio) over it (1).
    pub sd: f64,
    /// By how much measurements of the same body scatter by noise alone, over the modulus (1).
    pub scatter: f64,
    /// Whether the press stands out of the noise; `stiffness` refuses one that does not.
    pub felt: bool,
    /// Whether the modulus is determined, and not just a bound of it.
    pub determined: bool,
    /// Whether it is known as well as wanted.
    pub enough: bool,
}

/// A region of the body that is planned for.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PlannedRegion {
    /// Its label.
    pub label: u8,
    /// Its name.
    pub name: String,
    /// Assumed Young's modulus (kPa).
    pub youngs_modulus: f64,
    /// Volume (mm^3).
    pub volume: f64,
    /// Whether its modulus is wanted: all are, but for the one that ratios refer to.
    pub wanted: bool,
}

/// What a press does to the body.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Press {
    /// How far the plate goes in (mm).
    pub press_mm: f64,
    /// Largest principal strain (1), 95th percentile over the body.
    pub strain: f64,
    /// Force of the plate on the body (N).
    pub force_n: f64,
}

/// A planned measurement.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Plan {
    /// Wanted standard deviation over the modulus (1).
    pub want: f64,
    /// Whether ratios are what is wanted.
    pub ratios: bool,
    /// The regions, by label.
    pub regions: Vec<PlannedRegion>,
    /// Where it is held and pressed.
    pub sides: [String; 2],
    /// How the loaded patch touches.
    pub contact: Contact,
    /// Extent of the body along the load (mm).
    pub extent_mm: f64,
    /// Edge of a voxel of the labels (mm).
    pub label_voxel_mm: f64,
    /// What each press does, ascending.
    pub presses: Vec<Press>,
    /// The least press that stands out of the least noise that was tried (mm).
    pub least_press_mm: f64,
    /// Voxel sizes that were tried (mm), ascending.
    pub voxel_mm: Vec<f64>,
    /// Every choice and region: by voxel size, noise, press, label.
    pub expected: Vec<Expected>,
    /// What to know before going by it.
    pub warnings: Vec<String>,
    /// Stage names and wall seconds.
    pub seconds: Vec<(String, f64)>,
}

/// Largest principal strain (1) past which a planned press is warned of: the plan's law is linear,
/// and leaves out of a deviation about as much as the strain.
pub(crate) const LARGE_STRAIN: f64 = 0.1;

impl Plan {
    /// The expectations of a region.
    pub fn of(&self, label: u8) -> impl Iterator<Item = &Expected> {
        self.expected.iter().filter(move |e| e.label == label)
    }

    /// Whether any choice stands out of its noise.
    pub fn is_felt(&self) -> bool {
        self.expected.iter().any(|e| e.felt)
    }

    /// Largest principal strain at a press (1).
    pub fn strain(&self, press_mm: f64) -> f64 {
        self.presses.iter().find(|p| p.press_mm == press_mm).map_or(0.0, |p| p.strain)
    }

    /// Wanted regions that no choice determines.
    pub fn undetermined(&self) -> impl Iterator<Item = &PlannedRegion> {
        self.regions.iter().filter(|r| r.wanted && self.of(r.label).all(|e| !e.determined))
    }

    /// Wanted regions that some choice determines.
    pub fn determined(&self) -> impl Iterator<Item = &PlannedRegion> {
        self.regions.iter().filter(|r| r.wanted && self.of(r.label).any(|e| e.determined))
    }

    /// The least demanding choice (press, voxel, noise; mm) that gives all of `labels` as wanted:
    /// small strain first, then the most noise, the largest voxels, the smallest press.
    pub fn choice(&self, labels: &[u8]) -> Option<[f64; 3]> {
        let all = |e: &&Expected| {
            let same = |o: &&Expected| [o.press_mm, o.voxel_mm, o.noise_mm] == [e.press_mm, e.voxel_mm, e.noise_mm];
            labels.iter().all(|l| self.of(*l).filter(same).any(|o| o.enough))
        };
        let demand = |e: &Expected| {
            let strain = f64::from(u8::from(self.strain(e.press_mm) > LARGE_STRAIN));
            [strain, -e.noise_mm, -e.voxel_mm, e.press_mm]
        };
        let less =
            |a: &&Expected, b: &&Expected| demand(a).partial_cmp(&demand(b)).unwrap_or(std::cmp::Ordering::Equal);
        let found =
            self.expected.iter().filter(|e| !labels.is_empty() && labels.contains(&e.label)).filter(all).min_by(less);
        found.map(|e| [e.press_mm, e.voxel_mm, e.noise_mm])
    }

    /// The choice that tells a region best, of those that determine it.
    pub fn best(&self, label: u8) -> Option<&Expected> {
        self.of(label).filter(|e| e.determined).min_by(|a, b| a.sd.total_cmp(&b.sd))
    }
}
