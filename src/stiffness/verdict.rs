//! The verdict on each region, and on the result as a whole.

use crate::stiffness::fem_body::Body;
use crate::stiffness::summary::{Hidden, MAX_IDENTIFIED_SD_LN, MIN_LOAD_SHARE, Moduli, Scale};
use crate::types::stiffness::{Determined, RegionStiffness};
use crate::types::{MotionModel, Trust};

/// Standard deviation of ln E per unit of |ln contrast| of a region found without labels.
struct ShapeError {
    /// With the shape that the map gave it: from six phantoms.
    cut: f64,
    /// With a redrawn shape: nine functions leave more open than labels. From bodies of an
    /// independent solver.
    redrawn: f64,
}

const SHAPE_ERROR: ShapeError = ShapeError { cut: 0.15, redrawn: 0.02 };

/// Largest change of ln E between the meshes with which the fine one resolves it.
const MAX_RESOLVED_CHANGE_LN: f64 = 0.1;
/// Misfit over the noise of a sample from which it is significant: together they are then 1.03
/// times that noise.
const MIN_MISFIT_TO_NOISE: f64 = 0.25;

/// Where the shape of a region comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shape {
    /// From labels, whose borders are open.
    Given,
    /// From the map without labels.
    Cut,
    /// Drawn anew from there, and open.
    Drawn,
}

impl Shape {
    /// Standard deviation of ln E for each unit of |ln contrast|, for what the shape is not known
    /// to (1).
    fn slope(self) -> f64 {
        match self {
            Shape::Given => 0.0,
            Shape::Cut => SHAPE_ERROR.cut,
            Shape::Drawn => SHAPE_ERROR.redrawn,
        }
    }
}

/// What the model leaves over of the field.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Misfit {
    /// Beyond the noise of a sample (mm, one component).
    pub mm: f64,
    /// The noise of a sample (mm, one component).
    pub noise_mm: f64,
    /// What the body does besides a rigid motion (mm, root mean square of one component).
    pub deformation_mm: f64,
}

impl Misfit {
    /// As a part of the deformation; 0 where it does not stand out of the noise.
    pub fn share(&self) -> f64 {
        let seen = self.mm > MIN_MISFIT_TO_NOISE * self.noise_mm;
        if seen { self.mm / self.deformation_mm.max(f64::MIN_POSITIVE) } else { 0.0 }
    }

    /// How far to rely on a model that leaves so much.
    pub fn trust(&self) -> Trust {
        Trust::of(self.share())
    }
}

/// What was found, region by region in the order of the body's.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Found<'a> {
    /// The moduli.
    pub moduli: &'a Moduli,
    /// The moduli as if the surface were known: the part of the uncertainty that more data of the
    /// same body lower.
    pub alone: &'a Moduli,
    /// Change of ln E from the coarse to the fine mesh, of which a third counts as the error of the
    /// fine one, or all of it where it is large.
    pub mesh_change: &'a [f64],
    /// `lower` or `upper` where the region could as well be rigid or empty.
    pub unseen: &'a [Option<&'static str>],
    /// Where the regions' shapes come from.
    pub shapes: &'a [Shape],
    /// Regions that the data do not show.
    pub hidden: &'a [Hidden],
    /// ln(mu / mu_reference) of labels whose modulus was given.
    pub known: &'a [(u8, f64)],
    /// The motion model of the field, where it is one that shows no difference between regions.
    pub flat_model: Option<MotionModel>,
    /// Whether the residual is too large for any verdict.
    pub misfits: bool,
    /// What sets the scale.
    pub scale: Scale,
    /// The region that ratios refer to.
    pub reference: usize,
}

/// The error of ln E on the fine mesh, of a `change` of it from the coarse to the fine one.
pub(crate) fn mesh_error(change: f64) -> f64 {
    if change.abs() < MAX_RESOLVED_CHANGE_LN { change / 3.0 } else { change }
}

/// Which side of a modulus is open.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Side {
    Lower,
    Upper,
    Any,
}

impl Found<'_> {
    /// Everything about the regions.
    pub fn regions(&self, body: &Body, names: &dyn Fn(u8) -> String) -> Vec<RegionStiffness> {
        (0..body.labels.len()).map(|r| self.region(r, body, names)).collect()
    }

    /// Whether the field cannot tell regions apart, whatever they are.
    fn shows_no_contrast(&self) -> bool {
        self.flat_model.is_some() && self.moduli.log.len() > 1
    }

    fn region(&self, r: usize, body: &Body, names: &dyn Fn(u8) -> String) -> RegionStiffness {
        let (label, count) = (body.labels[r], body.labels.len());
        let [sd, ratio_sd] = self.deviations(r);
        let given = self.is_given(label, r);
        let (side, log) = if given { (None, self.moduli.log[r]) } else { self.open(label, r, sd) };
        let state = match side {
            _ if given => Determined::Given,
            None => Determined::Determined,
            Some(Side::Any) => Determined::Unknown,
            Some(_) => Determined::Bound,
        };
        let seen = matches!(state, Determined::Determined | Determined::Given);
        let e = if state == Determined::Unknown { f64::NAN } else { log.exp() };
        // The force bounds moduli, not ratios: those of regions that are seen stand.
        let hides = self.hides(label).is_some();
        let by_force = self.at_most(label).is_some() && !hides;
        let between = if by_force { self.moduli.log[r] } else { log };
        let ratio = match state {
            Determined::Unknown => f64::NAN,
            Determined::Bound if hides => f64::INFINITY,
            _ => (between - self.moduli.log[self.reference]).exp(),
        };
        RegionStiffness {
            label,
            name: names(label),
            youngs_modulus: e,
            sd: match state {
                Determined::Given => 0.0,
                Determined::Determined => e * sd,
                _ => f64::INFINITY,
            },
            ratio,
            ratio_sd: if seen { ratio * ratio_sd } else { f64::INFINITY },
            identifiable: seen,
            state,
            bound: side.map(|side| match side {
                Side::Lower => "lower",
                Side::Upper => "upper",
                Side::Any => "unknown",
            }),
            volume: body.volumes[r],
            data_sd: [self.alone.covariance[r * count + r], self.alone.ratio_variance[r]].map(|v| v.max(0.0).sqrt()),
        }
    }

    fn is_given(&self, label: u8, r: usize) -> bool {
        self.known.iter().any(|k| k.0 == label) || matches!(self.scale, Scale::Known(known, _) if known == r)
    }

    /// Standard deviation of ln E and of ln of the ratio to the reference.
    fn deviations(&self, r: usize) -> [f64; 2] {
        let (count, reference) = (self.moduli.log.len(), self.reference);
        let shape = self.shapes[r].slope() * (self.moduli.log[r] - self.moduli.log[reference]).abs();
        let data = self.moduli.covariance[r * count + r].max(0.0);
        let sd = (data + mesh_error(self.mesh_change[r]).powi(2) + shape * shape).sqrt();
        let between = match r == reference {
            true => 0.0,
            false => mesh_error(self.mesh_change[r] - self.mesh_change[reference]).powi(2) + shape * shape,
        };
        [sd, (self.moduli.ratio_variance[r] + between).sqrt()]
    }

    fn hides(&self, label: u8) -> Option<&Hidden> {
        self.hidden.iter().find(|h| h.label == label)
    }

    /// The part of the force that a region bears at most, where regions that are not seen make that
    /// all that is known of it: those can bear anything from none to all of their share.
    fn at_most(&self, label: u8) -> Option<f64> {
        let hidden_share = self.hidden.iter().map(|h| h.share).sum::<f64>().min(1.0);
        match self.hides(label) {
            Some(h) => Some(h.share),
            None => {
                (matches!(self.scale, Scale::Force(_)) && hidden_share > MIN_LOAD_SHARE).then_some(1.0 - hidden_share)
            }
        }
    }

    /// Which side is open, if any, and ln E: the estimate, or the bound.
    fn open(&self, label: u8, r: usize, sd: f64) -> (Option<Side>, f64) {
        let (count, reference) = (self.moduli.log.len(), self.reference);
        let log = self.moduli.log[r];
        if self.misfits || self.shows_no_contrast() {
            return (Some(Side::Any), log);
        }
        if let Some(share) = self.at_most(label) {
            let by_force = matches!(self.scale, Scale::Force(_));
            if !by_force || share < MIN_LOAD_SHARE {
                return (Some(Side::Any), log);
            }
            let sd = self.moduli.covariance[reference * count + reference].max(0.0).sqrt();
            return (Some(Side::Upper), log - share.ln() + 2.0 * sd);
        }
        let against = log - self.moduli.log[reference];
        let vague = (sd > MAX_IDENTIFIED_SD_LN).then_some(if against >= 0.0 { "lower" } else { "upper" });
        // Two standard deviations from the estimate, towards the side that the data exclude. What
        // is all but rigid moves in proportion to its compliance, what is all but empty to its
        // modulus: there the deviation of the logarithm is a relative one.
        let beyond = (2.0 * sd).ln_1p();
        match self.unseen[r].or(vague) {
            None => (None, log),
            // What does not even tell stiffer from softer is no bound.
            Some(_) if r == reference || beyond > against.abs() => (Some(Side::Any), log),
            Some("lower") => (Some(Side::Lower), log - beyond),
            Some(_) => (Some(Side::Upper), log + beyond),
        }
    }

    /// Says so where the field cannot tell regions apart.
    pub(crate) fn no_contrast(&self) -> Option<String> {
        let model = self.flat_model.filter(|_| self.shows_no_contrast())?;
        Some(format!(
            "the field is one {} motion of the whole body (its model says), which shows no difference between regions whatever they are: \
             measure a free field, with more texture, less noise or --model free",
            model.name()
        ))
    }
}

/// How far to rely on a result, and why.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Verdict {
    /// The worst of what is known.
    pub trust: Trust,
    /// Why.
    pub reasons: Vec<String>,
}

impl Verdict {
    /// From what the model leaves over, how far to rely on the field, and the regions.
    /// `is_affine` says whether the field is one affine map.
    pub fn of(misfit: &Misfit, field: Option<Trust>, is_affine: bool, regions: &[RegionStiffness]) -> Self {
        let percent = 100.0 * misfit.share();
        let mut reasons = vec![match misfit.share() {
            0.0 => "the model leaves over no more than noise".to_string(),
            _ => format!("the model leaves over {percent:.1} % of the deformation"),
        }];
        reasons.extend(field.map(|t| format!("trust in the field is {}", t.name())));
        let known = regions.iter().filter(|r| r.identifiable).count();
        let flat = is_affine && regions.len() > 1;
        let own = if known == 0 || flat { Trust::Low } else { Trust::High };
        if known == 0 {
            reasons.push("no modulus is determined".into());
        }
        if flat {
            reasons.push("the field is one affine map, which shows no contrast between regions".into());
        }
        let trust = [Some(misfit.trust()), field, Some(own)].into_iter().flatten().max().unwrap_or(own);
        Self { trust, reasons }
    }
}
