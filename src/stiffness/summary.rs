//! From an estimate to moduli with their uncertainty.

use crate::error::StiffnessError;
use crate::numerics::cholesky::Cholesky;
use crate::numerics::statistics::percentile;
use crate::stiffness::fem_body::Body;
use crate::stiffness::geometry::Geometry;
use crate::stiffness::identify::{Estimate, Setup, State};
use crate::stiffness::law::largest_principal_strain;
use crate::stiffness::model_selection::bic;
use crate::types::space::dot;
use crate::types::stiffness::{Law, StiffnessParams};

/// Largest standard deviation of ln E of an identified modulus: two of them are a factor of two.
pub(crate) const MAX_IDENTIFIED_SD_LN: f64 = 0.35;
/// Motion of the tissue (parts of the plates' motion) for a modulus e times as large, below which
/// the data do not show a region.
struct Visibility {
    /// Motion below which a region is examined with all moduli equal.
    suspect_motion: f64,
    /// Motion there below which it is hidden: 0.0003 for two halves side by side, 0.001 for a rod
    /// along a limb, 0.027 and more for visible regions of phantoms.
    min_motion: f64,
    /// Largest part of the body over which the motion is taken.
    max_body_fraction: f64,
    /// Tolerance of the solution with equal moduli.
    tolerance: f64,
}

const VISIBILITY: Visibility =
    Visibility { suspect_motion: 0.02, min_motion: 0.005, max_body_fraction: 0.02, tolerance: 0.02 };

/// Part of the force borne by a hidden region, from which the other moduli are bounds only.
pub(crate) const MIN_LOAD_SHARE: f64 = 0.03;
/// Contrast (ln 12) beyond which a region is compared with a rigid one.
const MAX_UNCHECKED_CONTRAST_LN: f64 = 2.5;
/// Contrast (ln 50) beyond which a modulus is a bound: mesh and labels leave more open than such a
/// region deforms.
pub(crate) const MAX_IDENTIFIED_CONTRAST_LN: f64 = 3.9;

/// ln E of each region with gradient and covariance.
#[derive(Debug, Clone)]
pub struct Moduli {
    /// ln of Young's modulus (kPa with a force, else over the reference's).
    pub log: Vec<f64>,
    /// Covariance of these, row by row.
    pub covariance: Vec<f64>,
    /// Covariance of ln of the ratio to the reference.
    pub ratio_variance: Vec<f64>,
}

impl Moduli {
    /// With the covariance of `data` more.
    #[must_use]
    pub(crate) fn widened(mut self, data: &Moduli) -> Self {
        let add = |own: &mut Vec<f64>, more: &[f64]| own.iter_mut().zip(more).for_each(|(a, b)| *a += b);
        add(&mut self.covariance, &data.covariance);
        add(&mut self.ratio_variance, &data.ratio_variance);
        self
    }
}

/// What sets the scale of the moduli.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Scale {
    /// Nothing: they are ratios to the reference region.
    Ratio,
    /// The whole force on the loaded patch (N).
    Force(f64),
    /// Young's modulus of a region (kPa).
    Known(usize, f64),
}

impl Scale {
    /// By a force where there is one, else by the first label whose modulus is given.
    pub fn of(body: &Body, params: &StiffnessParams) -> Self {
        let known = params.fixed.iter().find_map(|(label, e)| Some((body.labels.iter().position(|l| l == label)?, *e)));
        match (params.force_n, known) {
            (Some(force), _) => Self::Force(force),
            (None, Some((region, e))) => Self::Known(region, e),
            (None, None) => Self::Ratio,
        }
    }
}

/// The moduli of an estimate; `geometry` corrects for the offsets of the shape.
pub fn moduli(setup: &Setup<'_>, estimate: &Estimate, geometry: Option<&Geometry>, scale: Scale) -> Moduli {
    let covariance = geometry.map_or(&estimate.covariance, |g| &g.covariance);
    with_covariance(setup, estimate, geometry, scale, covariance)
}

/// The same with another covariance of the parameters and offsets.
pub(crate) fn with_covariance(
    setup: &Setup<'_>,
    estimate: &Estimate,
    geometry: Option<&Geometry>,
    scale: Scale,
    covariance: &[f64],
) -> Moduli {
    let regions = setup.body.labels.len();
    let none = vec![0.0; estimate.parameters];
    let step = geometry.map_or(&none, |g| &g.step);
    let p = step.len();
    let free = setup.free();
    let mut gradient = vec![0.0; regions * p];
    for (k, &r) in free.iter().enumerate() {
        gradient[r * p + k] = 1.0;
    }
    let ratio_variance =
        (0..regions).map(|r| free.iter().position(|&f| f == r).map_or(0.0, |k| covariance[k * p + k])).collect();
    // ln of Young's modulus over the reference's shear modulus.
    let young = |r: usize| estimate.state.theta[r] + (2.0 * (1.0 + setup.poisson[r])).ln();
    let shift = match scale {
        Scale::Ratio => -young(setup.reference),
        Scale::Force(force) => {
            let slopes = estimate.force_slope.iter().chain(geometry.iter().flat_map(|g| &g.force_slope));
            for (k, slope) in slopes.enumerate() {
                (0..regions).for_each(|r| gradient[r * p + k] -= slope);
            }
            (1000.0 * force / (estimate.force[0] * estimate.leaning)).ln()
        }
        Scale::Known(known, e) => {
            let own: Vec<f64> = gradient[known * p..(known + 1) * p].to_vec();
            for row in gradient.chunks_exact_mut(p.max(1)) {
                row.iter_mut().zip(&own).for_each(|(g, own)| *g -= own);
            }
            e.ln() - young(known)
        }
    };
    let change = |r: usize| (0..p).map(|k| gradient[r * p + k] * step[k]).sum::<f64>();
    let log = (0..regions).map(|r| young(r) + shift + change(r)).collect();
    let entry = |i: usize| {
        let (r, s) = (i / regions, i % regions);
        let inner = |a: usize| (0..p).map(|b| covariance[a * p + b] * gradient[s * p + b]).sum::<f64>();
        (0..p).map(|a| gradient[r * p + a] * inner(a)).sum()
    };
    Moduli { log, covariance: (0..regions * regions).map(entry).collect(), ratio_variance }
}

/// A region of whose modulus the data show nothing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Hidden {
    /// Its label.
    pub label: u8,
    /// By how much a modulus e times as large moves the tissue where it moves it most, the others
    /// and the plates fitted again (mm).
    pub moved: f64,
    /// The part of the force that it bears if all regions are alike (1).
    pub share: f64,
}

/// The free region that the data show least of, if it is so little that they tell nothing: of
/// bodies side by side between two plates without friction every ratio leads to one field, and what
/// a fit makes of it is the model's own error at the rim.
///
/// It is looked for where all moduli are alike, under the linear law: a modulus that went astray
/// would hide itself. None as well where that cannot be solved.
pub(crate) fn least_seen(setup: &Setup<'_>, estimate: &Estimate) -> Option<Hidden> {
    let travel = setup.travel();
    let found = shown(setup, estimate);
    if found.iter().all(|moved| *moved > VISIBILITY.suspect_motion * travel) {
        return None;
    }
    let equal = Setup { law: Law::Linear, ..setup.clone() };
    let start = State { theta: vec![0.0; estimate.state.theta.len()], ..estimate.state.clone() };
    let estimate = equal.run(start, 0, VISIBILITY.tolerance * travel).ok()?;
    let shown = shown(&equal, &estimate);
    let nothing = |&k: &usize| {
        shown[k] < VISIBILITY.min_motion * travel
            || (found[k] < VISIBILITY.min_motion * travel && shown[k] < VISIBILITY.suspect_motion * travel)
    };
    let hidden = (0..shown.len()).filter(nothing).min_by(|&a, &b| shown[a].total_cmp(&shown[b]));
    hidden.map(|k| Hidden {
        label: setup.body.labels[setup.free()[k]],
        moved: shown[k],
        share: estimate.force_slope[k].clamp(0.0, 1.0),
    })
}

/// By how much a modulus e times as large moves the tissue, the other parameters fitted again (mm),
/// for each free region: what a volume as large as the region, but a fiftieth of the body at most,
/// is moved by and more.
fn shown(setup: &Setup<'_>, estimate: &Estimate) -> Vec<f64> {
    let (p, free) = (estimate.parameters, setup.free());
    let one = |k: usize| {
        let others: Vec<usize> = (0..p).filter(|&j| j != k).collect();
        let m = others.len();
        let mut a: Vec<f64> = others
            .iter()
            .flat_map(|&i| others.iter().map(move |&j| (i, j)))
            .map(|(i, j)| estimate.information[i * p + j])
            .collect();
        let most = (0..m).map(|i| a[i * m + i]).fold(0.0, f64::max);
        (0..m).for_each(|i| a[i * m + i] += 1e-12 * most);
        let mut with: Vec<f64> = others.iter().map(|&i| estimate.information[i * p + k]).collect();
        match Cholesky::new(a, m) {
            Some(factor) => factor.solve(&mut with),
            None => with.fill(0.0),
        }
        let moved = |i: usize| {
            let left: [f64; 3] = std::array::from_fn(|x| {
                estimate.rows[k][i][x] - others.iter().zip(&with).map(|(&o, w)| w * estimate.rows[o][i][x]).sum::<f64>()
            });
            dot(left, left).sqrt()
        };
        let mut all: Vec<f64> = (0..estimate.residuals.len()).map(moved).collect();
        let part = setup.body.volumes[free[k]] / setup.body.volumes.iter().sum::<f64>();
        percentile(&mut all, 100.0 * (1.0 - part.min(VISIBILITY.max_body_fraction)))
    };
    (0..free.len()).map(one).collect()
}

/// Whether region `r` could as well be rigid (`lower`) or empty (`upper`) for all the data say: the
/// misfit with its modulus at the bound, the others fitted again, rises by less than two standard
/// deviations (4 in -2 ln likelihood).
///
/// # Errors
/// As [`Setup::run`].
pub fn unseen(
    setup: &Setup<'_>,
    estimate: &Estimate,
    r: usize,
    variance: f64,
) -> Result<Option<&'static str>, StiffnessError> {
    let theta = estimate.state.theta[r];
    if !setup.free().contains(&r) || (variance.sqrt() < MAX_IDENTIFIED_SD_LN && theta.abs() < MAX_UNCHECKED_CONTRAST_LN)
    {
        return Ok(None);
    }
    let side = if theta >= 0.0 { "lower" } else { "upper" };
    if variance.sqrt() > MAX_IDENTIFIED_SD_LN || theta.abs() > MAX_IDENTIFIED_CONTRAST_LN {
        return Ok(Some(side));
    }
    // Far enough to be as good as rigid, near enough to be solved.
    let far = theta + theta.signum() * 2.5;
    let mut fixed = setup.clone();
    fixed.pinned.push((r, far));
    let start = State { x: None, ..estimate.state.clone() };
    let end = fixed.run(start, 4, 1e-4)?;
    let samples = estimate.effective;
    let rise = bic(end.squares, samples, 0) - bic(estimate.squares, samples, 0);
    Ok((rise < 4.0).then_some(side))
}

/// Correlation from a covariance.
pub fn correlation(covariance: &[f64], n: usize) -> Vec<Vec<f64>> {
    let sd = |i: usize| covariance[i * n + i].max(1e-300).sqrt();
    (0..n).map(|i| (0..n).map(|j| covariance[i * n + j] / (sd(i) * sd(j))).collect()).collect()
}

/// The 95th percentile over the elements of the largest principal strain (1).
pub fn strain(setup: &Setup<'_>, state: &State) -> f64 {
    let Some(x) = &state.x else { return 0.0 };
    let one = |e: usize| largest_principal_strain(&setup.body.quadrature[e][0], &setup.body.gather(x, e));
    let mut all: Vec<f64> = (0..setup.body.cells.len()).map(one).collect();
    crate::numerics::statistics::percentile(&mut all, 95.0)
}
