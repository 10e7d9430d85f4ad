//! The search of a whole volume, on the coarsest level and, where few features agree there, on the next.

use crate::matching::pair::Pair;
use crate::numerics::bspline::Lattice;
use crate::numerics::{ablation, pyramid};
use crate::pipeline::level::{self, MatchParams, SplineField};
use crate::pipeline::start::{AGREED, Begun, Start, begin};
use crate::types::FieldParams;
use std::time::Instant;

/// Voxels of a level's mask for each feature, where a whole volume is searched; a quarter of it in one slice.
const SHARE: usize = 24;

/// The most features of the coarsest level.
pub(super) const POINTS: usize = 4000;

/// The most features of the next level, times the voxels of the finest level for each of its points. Over 29 pairs, legs above all, 1,500
/// and 600 features in the default left the same error, 400 and 190 left 0.7 and 0.9 % more.
const CLOSER_POINTS: usize = 75_000;

/// Features of the next level that are not saved on, however few points are wanted.
const CLOSER_LEAST: usize = 190;

/// Least reach of a search about a field that a search has found (the finest axis' voxels).
pub(super) const LEAST_REACH: f64 = 6.0;

/// Bending energy up to which a better agreement on the next level is believed, in that of the field from the coarsest one. Of 19 pairs
/// the 13 better fields had 0.46 to 1.45 of it; a slide that came out worse 1.8, heads turned by 36 degrees, which small patches do not
/// follow, 13.
const BENT: f64 = 1.6;

/// Share of the features of the next level that lie where the field from the coarsest one has them, from which that level is not searched. Of 106
/// pairs of which few features agreed on the coarsest level the search left 0.97 of the error in the 22 with as many (two passes more left 0.98
/// of it, at a tenth of the time) and 0.96 in the others, down to 0.68.
pub(super) const IN_PLACE: f64 = 0.9;

/// Passes more in place of that search.
pub(super) const SETTLING: usize = 2;

/// Fewest matches that a search may start from; it competes with stillness.
pub(super) const FEWEST: usize = 8;

/// How the matches of a whole level are sought within `range` (mm), with at most `most` features; `flat` of one slice.
pub(super) fn wide(params: &FieldParams, pair: &Pair<'_>, (range, flat): (f64, bool), most: usize) -> MatchParams {
    let share = if flat { SHARE / 4 } else { SHARE };
    let points = pair.inside.div_ceil(share).min(most).max(40);
    MatchParams::new(params, points, false, range, 2, 0.3)
}

/// Passes between the searches of the next level, of those of a coarse level: the next search needs a fair field, and what it ends with is brought
/// to the residual as often as any. Over 20 pairs, four of them legs that are searched so, 8 of 10 left 0.2 % more error (geometric mean) and took 1 % less
/// time in all; 6 of 10 left 0.7 % more (a leg 4 %) and took 3 % less.
fn between_searches(passes: usize) -> usize {
    passes - passes / 5
}

/// How a whole volume is searched.
#[derive(Clone, Copy)]
pub(super) struct Whole<'a> {
    pub params: &'a FieldParams,
    /// The largest motion looked for (mm).
    pub range: f64,
    /// Whether the volumes are one slice.
    pub flat: bool,
    /// Called as matching begins.
    pub matching: &'a dyn Fn(),
    /// Called after each pass with its number.
    pub tick: &'a dyn Fn(usize),
}

impl Whole<'_> {
    /// The most features on the level after the coarsest: more where more time is to be spent.
    pub fn closer_points(&self) -> usize {
        (CLOSER_POINTS / self.params.voxels_per_point.max(1)).clamp(CLOSER_LEAST, POINTS)
    }

    /// Voxels between nodes: 0.6 of how far apart so many features lie, within 3 to 5. Over 29 pairs, legs above all, 0.5 within 3 to 6
    /// left 0.1 (default) to 0.9 % (fast) more of the error and took a tenth more time; 0.75 within 3 to 6 left 0.1 to 2 % more.
    fn nodes_for(&self, pair: &Pair<'_>, features: usize) -> usize {
        let axes = if self.flat { 2.0 } else { 3.0 };
        let apart = (pair.inside as f64 / features as f64).powf(1.0 / axes);
        ((0.6 * apart).round() as usize).clamp(3, 5)
    }

    /// What is found on a level, with at most `most` features and so many passes, from nothing or from `known` fields, and from
    /// stillness with `rest`. Adds the seconds that matching takes to `seconds`.
    pub fn begin(
        &self,
        (pair, factor): (&Pair<'_>, [usize; 3]),
        lattice: &Lattice,
        (known, rest): (&[Start], bool),
        (passes, most): (usize, usize),
        seconds: &mut f64,
    ) -> Option<Begun> {
        let wide = wide(self.params, pair, (self.range, self.flat), most);
        let refine = |mut start, reach| {
            level::refine(pair, &mut start, (passes, reach), self.params.seed, self.tick);
            start
        };
        let mut reach_mm = self.range;
        let nearest = (LEAST_REACH * pyramid::finest(pair.shape, pair.spacing)).min(self.range);
        let seek = |about: Option<&SplineField>| {
            (self.matching)();
            let started = Instant::now();
            let (fitted, report) = match about {
                None => {
                    let (_, fitted, report) = level::matches(pair, None, wide);
                    (fitted.map(|f| level::carry(&f, lattice.clone(), |p| p)), report)
                }
                Some(field) => {
                    // What is wrong by then is an island, not the whole: each time half as far.
                    reach_mm = (reach_mm / 2.0).max(nearest);
                    level::matches_again(pair, field, MatchParams { reach_mm, ..wide })
                }
            };
            *seconds += started.elapsed().as_secs_f64();
            (fitted.filter(|_| report.counts.kept >= FEWEST), report)
        };
        let mut confirming = 0.0;
        let confirmed = |field: &SplineField| self.is_borne_out(pair, field, AGREED, &mut confirming);
        let found = begin(pair, lattice, factor, (known, rest), refine, confirmed, seek);
        *seconds += confirming;
        found
    }

    /// Whether so many of the features of a level (a share of at least `least`) are found where the field has them: then it is not searched.
    /// Adds the seconds that takes to `seconds`.
    pub fn is_borne_out(&self, pair: &Pair<'_>, field: &SplineField, least: f64, seconds: &mut f64) -> bool {
        let started = Instant::now();
        let points = (pair.inside / self.params.voxels_per_point).max(CLOSER_LEAST);
        let near = MatchParams::near(self.params, pair, points, false);
        let (_, _, report) = level::matches(pair, Some(field), near);
        *seconds += started.elapsed().as_secs_f64();
        report.counts.kept_share() >= least
    }

    /// The better of a field that came down from the coarsest level and of what a search of the next level itself finds: smaller
    /// patches are distorted less, and fine texture tells a wrong island from the truth, which the coarse volumes do not. What agrees
    /// better by much more bending is not taken.
    /// None where it is the first.
    pub fn closer(
        &self,
        (pair, factor): (&Pair<'_>, [usize; 3]),
        own: &SplineField,
        passes: usize,
        seconds: &mut f64,
    ) -> Option<Begun> {
        if !ablation::is_on("next-level") {
            return None;
        }
        let features = self.closer_points();
        let lattice = level::lattice(pair, self.nodes_for(pair, features));
        let effort = (between_searches(self.params.coarse_passes), features);
        let mut found = self.begin((pair, factor), &lattice, (&[], false), effort, seconds)?;
        found.field = level::carry(&found.field, own.lattice.clone(), |p| p);
        let reach = found.reach();
        level::refine(pair, &mut found.field, (passes, reach), self.params.seed, self.tick);
        let bending = [own, &found.field].map(|f| level::bending(pair, f));
        if bending[1] > BENT * bending[0] || !level::is_better(pair, &found.field, own) {
            return None;
        }
        Some(found)
    }
}
