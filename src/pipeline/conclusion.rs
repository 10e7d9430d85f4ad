//! What is concluded of each body once its field is found: the smallest motion that explains it,
//! where it stays at rest, and how sure it is.

use crate::consistency::coupling::Posterior;
use crate::consistency::models::{AffineMotion, Choice, Excess, choose, nearest_rigid};
use crate::consistency::pruning::Measured;
use crate::field::spline::Spline;
use crate::matching::levels::to_level;
use crate::matching::pair::Pair;
use crate::numerics::bspline::Lattice;
use crate::numerics::{ablation, pyramid};
use crate::pipeline::bodies::Bodies;
use crate::pipeline::level::{self, LevelMatch, SplineField};
use crate::pipeline::rest::{self, Places, Rest, Tried};
use crate::types::{Grid, Mask, MotionModel};
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
    /// On a lattice twice as coarse as the field's own.
    posterior: (Lattice, Posterior),
}

impl Concluded {
    /// The smallest motion that explains a body's matches, where it stays at rest, and what its
    /// data leave open. `rigid` says that it moves rigidly, whatever the evidence.
    pub fn of(
        bodies: &Bodies,
        body: usize,
        pair: &Pair<'_>,
        matches: &[LevelMatch],
        (rigid, seed): (bool, u64),
    ) -> Self {
        let (pair, field) = (bodies.part(pair, body), &bodies.fields[body]);
        let own = matches.iter().filter(|m| m.kept && bodies.label_near(m.voxel) == body);
        let measured: Vec<Measured> = own.map(|m| m.measured).collect();
        let windows = level::windows(&pair);
        let by_place = level::excess(&pair, field, &windows);
        let posterior = level::posterior(field, pair.spacing, seed);
        let places_of = Places::new(&pair, &windows, &posterior);
        let (mut choice, tried) = smallest(&measured, &pair, field, &by_place, &places_of, seed);
        if rigid {
            let motion = nearest_rigid(&rest::shown(&pair, field, |_| true));
            choice.evidence.push("rigid: as asked".into());
            choice = Choice { model: MotionModel::Rigid, motion: Some(motion), ..choice };
        }
        let free = choice.motion.is_none() && ablation::is_on("rest");
        let rest = free.then(|| Rest::find((&pair, field), &windows, &places_of, &tried, &by_place)).flatten();
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
    /// on `pair`, a level of `factor`; `judged` maps its places to those of the level on which this
    /// was concluded. With a seed the posterior is made again.
    pub fn on_grid(
        all: Vec<Self>,
        bodies: &mut Bodies,
        (pair, factor): (&Pair<'_>, [usize; 3]),
        (judged, again): (impl Fn([f64; 3]) -> [f64; 3] + Sync, Option<u64>),
        grid: &Grid,
    ) -> (Vec<Spline>, Stated) {
        let (mut splines, mut stated) = (Vec::new(), Vec::new());
        for (b, Self { choice, rest, posterior }) in all.into_iter().enumerate() {
            let field = &mut bodies.fields[b];
            let (coarse, mut posterior) = match again {
                Some(seed) => level::posterior(field, pair.spacing, seed),
                None => posterior,
            };
            let rest = rest.filter(Rest::is_taken);
            if let Some(rest) = &rest {
                rest.bring(field, &judged);
            }
            splines.push(full_lattice(grid, field, factor, &choice));
            let hidden = hidden(pair, field, &coarse);
            if let Some(rest) = rest {
                let seen = posterior.deviation.iter_mut().enumerate().filter(|&(m, _)| !hidden[m]);
                seen.for_each(|(m, v)| *v *= rest.narrowed(judged(coarse.within(m))));
            }
            stated.push(Stated { coarse, deviation: posterior.deviation, hidden });
        }
        (splines, Stated::by_place(stated, bodies))
    }
}

/// Standard deviations at the nodes of a lattice (mm), and which of these the deformed volume does
/// not show.
pub(super) struct Stated {
    pub coarse: Lattice,
    pub deviation: Vec<f32>,
    pub hidden: Vec<bool>,
}

impl Stated {
    /// On the closest lattice of all bodies, each node's from the body there.
    fn by_place(mut all: Vec<Self>, bodies: &Bodies) -> Self {
        let closest = (0..all.len()).max_by_key(|&b| all[b].coarse.len()).unwrap_or(0);
        let lattice = all[closest].coarse.clone();
        let at = |m: usize| {
            let place = lattice.within(m);
            let Self { coarse, deviation, hidden } = &all[bodies.label_near(place)];
            if *coarse == lattice {
                return (deviation[m], hidden[m]);
            }
            let stencil = coarse.stencil_near(place);
            let mut nearest = (0.0, 0);
            coarse.for_each_tap(place, |node, w| nearest = if w > nearest.0 { (w, node) } else { nearest });
            (stencil.gather(deviation), hidden[nearest.1])
        };
        if all.len() == 1 {
            return all.remove(0);
        }
        let (deviation, hidden) = (0..lattice.len()).map(at).unzip();
        Self { deviation, hidden, coarse: lattice }
    }
}

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
    let excess = |model, motion: &AffineMotion| {
        let excess = by_place(motion);
        let found = Excess { total: excess.iter().map(|&v| f64::from(v)).sum(), worst: places.worst(&excess) };
        tried.push(Tried { model, motion: *motion, excess });
        found
    };
    let choice = choose(measured, excess, level::determined(pair, field, seed), 0.02 * finest);
    (choice, tried)
}

/// The chosen motion on a lattice over the full-resolution grid.
pub(super) fn full_lattice(
    grid: &Grid,
    field: &SplineField,
    factor: [usize; 3],
    choice: &Choice,
) -> (Lattice, Vec<f32>) {
    let step = std::array::from_fn(|a| field.lattice.step[a] * factor[a]);
    let lattice = Lattice::new(grid.shape(), step);
    let spacing = grid.spacing();
    let coefficients = match &choice.motion {
        Some(motion) => lattice.fit(|p| {
            motion.displacement(std::array::from_fn(|a| to_level(p, factor)[a] * spacing[a] * factor[a] as f64))
        }),
        None if factor == [1; 3] => field.coefficients.clone(),
        None => lattice.fit(|p| field.lattice.at(&field.coefficients, to_level(p, factor))),
    };
    (lattice, coefficients)
}

/// Of each node of a lattice over the initial volume, whether the deformed volume does not show
/// what is there.
pub(super) fn hidden(pair: &Pair<'_>, field: &SplineField, lattice: &Lattice) -> Vec<bool> {
    let sees = |m: usize| {
        let p = lattice.within(m);
        level::sees(pair, p, field.lattice.at(&field.coefficients, p))
    };
    (0..lattice.len()).into_par_iter().map(|m| !sees(m)).collect()
}
