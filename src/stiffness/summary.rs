//! From an estimate to moduli with their uncertainty.

use crate::error::StiffnessError;
use crate::numerics::cholesky::Cholesky;
use crate::numerics::statistics::percentile;
use crate::stiffness::body::Body;
use crate::stiffness::choice::bic;
use crate::stiffness::geometry::Geometry;
use crate::stiffness::identify::{Estimate, Setup, State};
use crate::stiffness::law::largest_principal_strain;
use crate::types::space::dot;
use crate::types::stiffness::{Law, RegionStiffness};

/// A standard deviation of ln E beyond this says that the data do not tell (a factor of two lies
/// within two of them).
const VAGUE: f64 = 0.35;
/// What is left at surface and interfaces of a label map, as a standard deviation of ln E: this,
/// and this much more for each unit of |ln contrast| (the displacement tells less and less of a
/// stiffer inclusion). From the spread over the phantoms.
const INTERFACE: [f64; 2] = [0.006, 0.005];
/// In place of the latter where a region was found without labels and has the shape that the map
/// gave it. From six phantoms.
const CUT: f64 = 0.15;
/// The same where its shape was drawn anew: nine functions leave more of it open than labels do.
/// From bodies of an independent solver.
const DRAWN: f64 = 0.02;
/// A change of ln E with the mesh beyond this means that the fine mesh does not resolve it either.
const RESOLVED: f64 = 0.1;

/// Where the shape of a region comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shape {
    /// From labels.
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
            Shape::Given => INTERFACE[1],
            Shape::Cut => CUT,
            Shape::Drawn => DRAWN,
        }
    }
}

/// A region is looked at more closely where a modulus e times as large moves no tissue by this part
/// of the plates' motion.
const DOUBTED: f64 = 0.02;
/// It is not seen where, all moduli alike, that is less than this (two halves side by side came to
/// 0.0003, a rod along a limb to 0.001, all that is to be seen in phantoms to 0.027 and more), or
/// where it is so at the modulus found and hardly more if all are alike (a skin along a limb, which
/// the rounded rim of the mesh lets in).
const SHOWN: f64 = 0.005;
/// Part of the body that a region moves, at most.
const MOST_MOVED: f64 = 0.02;
/// Precision of the solution for that (part of the plates' motion).
const ALIKE: f64 = 0.02;
/// Part of the force from which a region that is not seen makes a bound of the others' moduli.
pub(super) const BEARS: f64 = 0.03;
/// Contrasts beyond e^this are checked against a rigid region (12).
const HIGH: f64 = 2.5;
/// Contrasts beyond e^this (50) are bounds: what such a region gives way is less than what mesh and
/// labels leave open.
const SEEN: f64 = 3.9;

/// Variance of the moduli over what the scatter over blocks says, where the misfit is not the
/// field's own noise. Errors of meshes, contacts and measured fields are everywhere at once, which
/// blocks of one body do not show: over the phantoms (three kinds, three seeds, exact fields and
/// images) moduli were off by 4 to 5 times that.
const COHERENT: f64 = 20.0;

/// By how much the variance of the data grows for misfit beyond the noise of a sample, `own` (mm,
/// one component), and beyond the floor that is counted as such already. Added to 1.
pub fn coherent(estimate: &Estimate, own: f64) -> f64 {
    let all = (estimate.rms * estimate.rms).max(f64::MIN_POSITIVE);
    (1.0 - own * own / all).max(0.0) * estimate.raw * (COHERENT - 1.0)
}

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
    /// With `by` times the covariance of `data` more.
    pub fn widened(mut self, data: &Moduli, by: f64) -> Self {
        let add = |own: &mut Vec<f64>, more: &[f64]| own.iter_mut().zip(more).for_each(|(a, b)| *a += by * b);
        add(&mut self.covariance, &data.covariance);
        add(&mut self.ratio_variance, &data.ratio_variance);
        self
    }
}

/// The moduli of an estimate; `force_n`, the whole force on the plate (N), sets the scale,
/// `geometry` corrects for the faces' offsets.
pub fn moduli(setup: &Setup<'_>, estimate: &Estimate, geometry: Option<&Geometry>, force_n: Option<f64>) -> Moduli {
    let regions = setup.body.labels.len();
    let none = vec![0.0; estimate.parameters];
    let (step, covariance) = geometry.map_or((&none, &estimate.covariance), |g| (&g.step, &g.covariance));
    let p = step.len();
    let free = setup.free();
    let mut gradient = vec![0.0; regions * p];
    for (k, &r) in free.iter().enumerate() {
        gradient[r * p + k] = 1.0;
    }
    let ratio_variance =
        (0..regions).map(|r| free.iter().position(|&f| f == r).map_or(0.0, |k| covariance[k * p + k])).collect();
    let mut shift = 0.0;
    if let Some(force) = force_n {
        let slopes = estimate.force_slope.iter().chain(geometry.iter().flat_map(|g| &g.force_slope));
        for (k, slope) in slopes.enumerate() {
            (0..regions).for_each(|r| gradient[r * p + k] -= slope);
        }
        let whole = estimate.force[0] * estimate.leaning;
        shift = (1000.0 * force / whole * 2.0 * (1.0 + setup.poisson)).ln();
    }
    let change = |r: usize| (0..p).map(|k| gradient[r * p + k] * step[k]).sum::<f64>();
    let log = (0..regions).map(|r| estimate.state.theta[r] + shift + change(r)).collect();
    let entry = |i: usize| {
        let (r, s) = (i / regions, i % regions);
        let inner = |a: usize| (0..p).map(|b| covariance[a * p + b] * gradient[s * p + b]).sum::<f64>();
        (0..p).map(|a| gradient[r * p + a] * inner(a)).sum()
    };
    Moduli { log, covariance: (0..regions * regions).map(entry).collect(), ratio_variance }
}

/// A region of whose modulus the data show nothing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hidden {
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
pub fn least_seen(setup: &Setup<'_>, estimate: &Estimate) -> Option<Hidden> {
    let travel = setup.travel();
    let found = shown(setup, estimate);
    if found.iter().all(|moved| *moved > DOUBTED * travel) {
        return None;
    }
    let equal = Setup { law: Law::Linear, ..setup.clone() };
    let start = State { theta: vec![0.0; estimate.state.theta.len()], ..estimate.state.clone() };
    let estimate = equal.run(start, 0, ALIKE * travel).ok()?;
    let shown = shown(&equal, &estimate);
    let nothing = |&k: &usize| shown[k] < SHOWN * travel || (found[k] < SHOWN * travel && shown[k] < DOUBTED * travel);
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
        percentile(&mut all, 100.0 * (1.0 - part.min(MOST_MOVED)))
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
    if !setup.free().contains(&r) || (variance.sqrt() < VAGUE && theta.abs() < HIGH) {
        return Ok(None);
    }
    let side = if theta >= 0.0 { "lower" } else { "upper" };
    if variance.sqrt() > VAGUE || theta.abs() > SEEN {
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

/// Everything about the regions. `alone` are the moduli as if the surface were known: the part of
/// the uncertainty that more data of the same body lower. `mesh_change` is the change of ln E from
/// the coarse to the fine mesh, of which a third counts as the error of the fine one, or all of it
/// where it is large. `shapes` says where each region's came from.
///
/// What is `hidden` can bear anything from none to all of its share of the force, where one is
/// known (`absolute`): so much are all moduli at most.
pub fn regions(
    body: &Body,
    [moduli, alone]: [&Moduli; 2],
    names: &dyn Fn(u8) -> String,
    [mesh_change, ratio_change]: [&[f64]; 2],
    unseen: &[Option<&'static str>],
    shapes: &[Shape],
    hidden: &[Hidden],
    absolute: bool,
    reference: usize,
) -> Vec<RegionStiffness> {
    let count = body.labels.len();
    let borne = hidden.iter().map(|h| h.share).sum::<f64>().min(1.0);
    let one = |r: usize| {
        let mesh = |change: f64| if change.abs() < RESOLVED { change / 3.0 } else { change };
        let slope = shapes[r].slope();
        let interface = INTERFACE[0] + slope * (moduli.log[r] - moduli.log[reference]).abs();
        let data = moduli.covariance[r * count + r].max(0.0);
        let model = if data > 0.0 { interface * interface } else { 0.0 };
        let sd = (data + mesh(mesh_change[r]).powi(2) + model).sqrt();
        let between = if r == reference { 0.0 } else { mesh(ratio_change[r]).powi(2) + interface * interface };
        let ratio_sd = (moduli.ratio_variance[r] + between).sqrt();
        let hides = hidden.iter().find(|h| h.label == body.labels[r]);
        let at_most = match hides {
            Some(h) => Some(h.share),
            None => (absolute && borne > BEARS).then_some(1.0 - borne),
        };
        let unknown = hides.is_some_and(|h| !absolute || h.share < BEARS) || at_most.is_some_and(|share| share < BEARS);
        let limited = at_most.map(|_| if unknown { "unknown" } else { "upper" });
        let unseen = limited.or(unseen[r]).or((sd > VAGUE).then_some(if moduli.log[r] >= moduli.log[reference] {
            "lower"
        } else {
            "upper"
        }));
        let value = match unseen {
            None | Some("unknown") => moduli.log[r],
            Some(_) if limited.is_some() => {
                moduli.log[r] - at_most.unwrap_or(1.0).ln()
                    + 2.0 * moduli.covariance[reference * count + reference].max(0.0).sqrt()
            }
            // Two standard deviations from the estimate, towards the side that the data exclude.
            // What is all but rigid moves in proportion to its compliance, what is all but empty to
            // its modulus: there the deviation of the logarithm is a relative one.
            Some("lower") => moduli.log[r] - (2.0 * sd).ln_1p(),
            Some(_) => moduli.log[r] + (2.0 * sd).ln_1p(),
        };
        let e = value.exp();
        // The force bounds moduli, not ratios: those of regions that are seen stand.
        let ratio = match limited {
            Some(_) if hides.is_some() => f64::INFINITY,
            Some(_) => (moduli.log[r] - moduli.log[reference]).exp(),
            None => (value - moduli.log[reference]).exp(),
        };
        let seen = unseen.is_none();
        RegionStiffness {
            label: body.labels[r],
            name: names(body.labels[r]),
            youngs_modulus: e,
            sd: if seen { e * sd } else { f64::INFINITY },
            ratio,
            ratio_sd: if seen { ratio * ratio_sd } else { f64::INFINITY },
            identifiable: seen,
            bound: unseen,
            volume: body.volumes[r],
            data_sd: [alone.covariance[r * count + r], alone.ratio_variance[r]].map(|v| v.max(0.0).sqrt()),
        }
    };
    (0..count).map(one).collect()
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
