//! What is concluded of each body once its field is found: the smallest motion that explains it,
//! where it stays at rest, and how sure it is.

use crate::consistency::coupling::Posterior;
use crate::consistency::energy::distance;
use crate::consistency::models::{AffineMotion, Choice, Excess, choose};
use crate::consistency::pruning::Measured;
use crate::field::spline::Spline;
use crate::matching::levels::{from_level, to_level};
use crate::matching::pair::Pair;
use crate::matching::residual;
use crate::numerics::bspline::Lattice;
use crate::numerics::{ablation, pyramid};
use crate::pipeline::bodies::Bodies;
use crate::pipeline::landmarks;
use crate::pipeline::level::{self, LevelMatch, SplineField};
use crate::pipeline::local_model::{self, Places, Rest, Tried};
use crate::pipeline::uncertainty::{self, AtNodes, Variances};
use crate::types::{Grid, GridVector, Mask, MotionModel, VoxelPoint};
use rayon::prelude::*;

/// The mask with the `name` of each voxel's body; `labels` (bodies from 0) may be empty where there
/// is one.
pub(super) fn labelled(mask: &Mask, labels: &[u8], name: impl Fn(usize) -> u8) -> Mask {
    let mut out = mask.clone();
    for (at, voxel) in out.as_mut_slice().iter_mut().enumerate().filter(|(_, v)| **v != 0) {
        *voxel = name(labels.get(at).copied().unwrap_or(0).into());
    }
    out
}

/// What is concluded of one body.
pub(super) struct Concluded {
    pub choice: Choice,
    pub rest: Option<Rest>,
    /// At the nodes of its field.
    posterior: Posterior,
}

impl Concluded {
    /// The smallest motion that explains a body's matches, or that of the model that is `asked`
    /// for, where it stays at rest, and what its data leave open.
    pub fn of(
        bodies: &Bodies,
        body: usize,
        pair: &Pair<'_>,
        matches: &[LevelMatch],
        asked: Option<MotionModel>,
        seed: u64,
    ) -> Self {
        let (pair, field) = (bodies.part(pair, body), &bodies.fields[body]);
        let own = matches.iter().filter(|m| m.kept && bodies.label_near(m.voxel) == body);
        let measured: Vec<Measured> = own.map(|m| m.measured).chain(landmarks::measured(&pair, field)).collect();
        let windows = level::windows(&pair);
        let by_place = level::excess(&pair, field, &windows);
        let posterior = level::posterior(field, pair.spacing, seed);
        let places_of = Places::new(&pair, &windows, &field.lattice, &posterior);
        let (mut choice, tried) = smallest(&measured, &pair, field, &by_place, &places_of, seed);
        if let Some(model) = asked {
            choice = choice.asked(model, &local_model::shown(&pair, field, |_| true));
        }
        let free = choice.motion.is_none() && asked.is_none() && ablation::is_on("rest");
        let rest = free.then(|| Rest::find(&pair, field, &windows, &places_of, &tried, &by_place)).flatten();
        drop(by_place);
        Self { choice, rest, posterior }
    }

    /// The model of the whole, and the evidence for each body's; `name` gives a body's label.
    pub fn together(
        concluded: &[Self],
        bodies: &Bodies,
        pair: &Pair<'_>,
        name: impl Fn(usize) -> u8,
    ) -> (MotionModel, Vec<String>) {
        if let [Self { choice, .. }] = concluded {
            return (choice.model, choice.evidence.clone());
        }
        let of = |(b, Self { choice, .. }): (usize, &Self)| {
            let share = 100.0 * bodies.part(pair, b).inside as f64 / pair.inside.max(1) as f64;
            let head = format!("body {}: {}, {share:.0} % of the tissue", name(b), choice.model.name());
            let why = choice.evidence.iter().map(|e| format!("body {}: {e}", name(b)));
            [head].into_iter().chain(why).collect::<Vec<_>>()
        };
        (MotionModel::Free, concluded.iter().enumerate().flat_map(of).collect())
    }

    /// The spline of each body over `grid`, and how sure they are together. The bodies' fields lie
    /// on `pair`, a level of `factor`; this was concluded on one of `judged`. With a seed the
    /// posterior is made again.
    pub(crate) fn on_grid(
        all: Vec<Self>,
        bodies: &mut Bodies,
        (pair, factor): (&Pair<'_>, [usize; 3]),
        (judged, again): ([usize; 3], Option<u64>),
        grid: &Grid,
    ) -> (Vec<Spline>, Variances) {
        let warped = bodies.warp(pair, &pair.spans);
        let place = |p| to_level(from_level(p, factor), judged);
        let (mut splines, mut variances) = (Vec::new(), Vec::new());
        for (b, Self { choice, rest, posterior }) in all.into_iter().enumerate() {
            let part = bodies.part(pair, b);
            let field = &mut bodies.fields[b];
            let posterior = again.map_or(posterior, |seed| level::posterior(field, pair.spacing, seed));
            let misfit = residual::misfit_by_place(&part, &warped, &field.lattice);
            let free = field.clone();
            let rest = rest.filter(Rest::is_taken);
            if let Some(rest) = &rest {
                rest.bring(field, place);
            }
            let lattice = free.lattice.clone();
            let stated = full_lattice(grid, field, factor, (&choice, judged));
            let departure = departure(&stated, &free, factor, choice.rejected);
            let narrowed = |m: usize| rest.as_ref().map_or(1.0, |rest| rest.narrowed(place(lattice.within(m))));
            let narrowed: Vec<f32> = (0..lattice.len()).map(narrowed).collect();
            let nodes = AtNodes {
                posterior: &posterior,
                misfit: &misfit,
                departure: &departure,
                narrowed: &narrowed,
                hidden: &hidden(&part, field),
            };
            variances.push(Variances::of(lattice, pair.spacing, &nodes));
            splines.push(stated);
        }
        (splines, Variances::by_place(variances, bodies))
    }
}

/// Least part of what a field sees that a map must see to be compared with it: of less, what is
/// not compared would decide.
const MIN_SEEN_FRACTION: f64 = 0.5;

/// Chooses the model from the kept matches and the free field; with what was tried.
fn smallest(
    measured: &[Measured],
    pair: &Pair<'_>,
    field: &SplineField,
    by_place: impl Fn(&AffineMotion) -> Vec<f32>,
    places: &Places,
    seed: u64,
) -> (Choice, Vec<Tried>) {
    let finest = pyramid::finest(pair.shape, pair.spacing);
    let mut tried = Vec::new();
    let seen_by_field = 1.0 - level::unseen(pair, |p| field.at(p));
    let excess = |model, motion: &AffineMotion| {
        let moved = |p| motion.on_grid(p, pair.spacing);
        if 1.0 - level::unseen(pair, moved) < MIN_SEEN_FRACTION * seen_by_field {
            return Excess { total: f64::INFINITY, worst: f64::INFINITY };
        }
        let excess = by_place(motion);
        let found = Excess { total: excess.iter().map(|&v| f64::from(v)).sum(), worst: places.worst(&excess) };
        tried.push(Tried { model, motion: *motion, excess });
        found
    };
    let choice = choose(measured, excess, level::determined(pair, field, seed), 0.02 * finest);
    (choice, tried)
}

/// The chosen motion on a lattice over the full-resolution grid; `field` lies on a level of
/// `factor`, and the choice was made on one of `judged`.
pub(super) fn full_lattice(
    grid: &Grid,
    field: &SplineField,
    factor: [usize; 3],
    (choice, judged): (&Choice, [usize; 3]),
) -> Spline {
    let Some(motion) = &choice.motion else { return on_full_grid(grid, field, factor) };
    let (lattice, spacing) = (over(grid, field, factor), grid.spacing());
    let coefficients = lattice.fit(|p| {
        let VoxelPoint(p) = to_level(p, judged);
        GridVector(motion.displacement(std::array::from_fn(|a| p[a] * spacing[a] * judged[a] as f64)))
    });
    (lattice, coefficients)
}

/// A field of a level of `factor` over the full-resolution grid.
pub(super) fn on_full_grid(grid: &Grid, field: &SplineField, factor: [usize; 3]) -> Spline {
    let lattice = over(grid, field, factor);
    let coefficients = match factor == [1; 3] {
        true => field.coefficients.clone(),
        false => lattice.fit(|p| field.at(to_level(p, factor))),
    };
    (lattice, coefficients)
}

/// A lattice over the full-resolution grid with the nodes of a level's field.
fn over(grid: &Grid, field: &SplineField, factor: [usize; 3]) -> Lattice {
    Lattice::new(grid.shape(), std::array::from_fn(|a| field.lattice.step[a] * factor[a]))
}

/// How far the motion that is stated over the full-resolution grid departs from a free field, at
/// the nodes of that one (mm); of a motion that the evidence rejects as [`uncertainty::left_out`].
pub(super) fn departure((full, stated): &Spline, free: &SplineField, factor: [usize; 3], rejected: bool) -> Vec<f32> {
    let lattice = &free.lattice;
    let axes = (0..3).filter(|&a| lattice.shape[a] > 1).count();
    let times = if rejected { uncertainty::left_out(axes) } else { 1.0 };
    let at = |m: usize| {
        let p = lattice.within(m);
        times * distance(full.at(stated, from_level(p, factor)).0, free.at(p).0) as f32
    };
    (0..lattice.len()).into_par_iter().map(at).collect()
}

/// Of each node of a field, whether the volumes show nothing of what is there: the deformed one
/// does not reach it, or the initial one has no texture about it.
pub(super) fn hidden(pair: &Pair<'_>, field: &SplineField) -> Vec<bool> {
    let lattice = &field.lattice;
    let is_plain = pair.is_plain();
    let shows = |m: usize| {
        let p = lattice.within(m);
        level::sees(pair, p, field.at(p)) && !is_plain(p)
    };
    (0..lattice.len()).into_par_iter().map(|m| !shows(m)).collect()
}
