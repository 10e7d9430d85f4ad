//! The levels of the pyramid from the coarsest to the finest: where the passes begin, the passes
//! themselves, and the matches about their field.

use crate::matching::levels::{Aligned, factors, foreground, from_level, to_level};
use crate::matching::pair::Pair;
use crate::numerics::ablation;
use crate::numerics::bspline::Lattice;
use crate::pipeline::bodies::{Bodies, Given};
use crate::pipeline::brightness::Light;
use crate::pipeline::clock::{Clock, noted};
use crate::pipeline::field::Progress;
use crate::pipeline::field_warnings::no_match;
use crate::pipeline::hypotheses::{Begun, Search, Start};
use crate::pipeline::known::{Known, StartMap};
use crate::pipeline::landmarks;
use crate::pipeline::level::{self, LevelMatch, MatchParams, SplineField};
use crate::pipeline::refinement::{self, finer};
use crate::pipeline::stages::Left;
use crate::pipeline::start::{self, Halt};
use crate::types::params::BodySource;
use crate::types::*;

/// The levels of the pyramid, from the coarsest one, and how they are worked on.
pub(super) struct CoarseToFine<'a, 'p> {
    pub aligned: &'a Aligned<'a>,
    /// Voxels that a voxel of each level stands for.
    pub factors: &'p [[usize; 3]],
    /// Whether the volumes are one slice.
    pub flat: bool,
    /// The bodies that are given.
    pub given: Option<&'p Given>,
    pub params: &'p FieldParams,
    pub starts: &'p [Start],
    /// The volumes' grid, where a large rotation ends the run, to be taken out of them.
    pub turning: Option<&'p Grid>,
    pub progress: Progress<'p>,
}

/// What the levels found.
pub(super) struct Found<'a> {
    /// On the finest level, with that level's factor and pair.
    pub bodies: Bodies,
    pub factor: [usize; 3],
    pub pair: Pair<'a>,
    /// Of that level, about the bodies' fields, with the number wanted.
    pub matches: Vec<LevelMatch>,
    pub points: usize,
    pub reports: Vec<LevelReport>,
    /// Where the passes began.
    pub begun: Begun,
    pub light: Light,
    /// The range (mm) that was searched.
    pub search: f64,
    /// What is left of the difference (intensity), and how the gain varies.
    pub left: f32,
    pub gain: f32,
    /// Voxels between nodes.
    pub apart: usize,
    /// Questions that were asked on the way, with their answers.
    pub asked: Vec<String>,
    /// The motion after each stage.
    pub stages: Vec<Left>,
}

/// One level: its place in the order, and how it is worked on.
struct Level {
    place: usize,
    last: bool,
    factor: [usize; 3],
    /// Voxels between nodes.
    apart: usize,
    lattice: Lattice,
    passes: usize,
}

impl Level {
    fn is_first(&self) -> bool {
        self.place == 0
    }
}

/// What is kept from level to level beside the motion.
struct Account {
    reports: Vec<LevelReport>,
    asked: Vec<String>,
    stages: Vec<Left>,
    light: Light,
    /// The range (mm) that is searched.
    range: f64,
    /// Seconds that this level spent in matching.
    matched: f64,
}

/// The motion that a level begins with.
struct Entry {
    bodies: Bodies,
    begun: Begun,
    /// Whether features of this level were searched for it, so that it may divide into bodies.
    sought: bool,
}

impl<'a> CoarseToFine<'a, '_> {
    /// From the coarsest level to the finest: where the passes begin, the passes, and the matches
    /// about their field. `tissue` gives the mask with all tissue around it, where that is another.
    pub fn run(&self, range: f64, tissue: impl Fn() -> Option<Vec<u8>>, clock: &mut Clock) -> Result<Found<'a>, Halt> {
        let (reports, asked, stages) = (Vec::new(), Vec::new(), Vec::new());
        let mut account = Account { reports, asked, stages, light: Light::default(), range, matched: 0.0 };
        let mut coarser: Option<(Bodies, [usize; 3], Begun)> = None;
        for (place, &factor) in self.factors.iter().enumerate() {
            let mut pair = account.light.level(self.aligned, factor);
            clock.book("pyramid");
            let level = self.level(place, &pair);
            account.matched = 0.0;
            let tick = |p: usize| self.tell("residual", place, 0.1 + 0.8 * (p + 1) as f64 / level.passes as f64);
            let matching = || self.tell("matching", place, 0.0);
            let search = Search {
                params: self.params,
                range: account.range,
                flat: self.flat,
                turns: true,
                matching: &matching,
                tick: &tick,
            };
            let mut entry = match coarser.take() {
                Some(coarser) => self.carried(&search, &level, &pair, coarser, &mut account),
                None => self.begun(&search, &level, &mut pair, &tissue, &mut account),
            };
            if let Some((turn, grid)) = entry.begun.turn.filter(|_| level.is_first()).zip(self.turning) {
                return Err(Halt::turned(&turn, grid, (factor, pair.spacing)));
            }
            self.divide(&search, &level, &pair, &mut entry, &mut account);
            let Entry { mut bodies, mut begun, .. } = entry;
            if let Some(field) = begun.of_matches.take() {
                let name = if level.is_first() { "matches alone" } else { "matches of the next level" };
                account.stages.push(Left { name: name.into(), motion: field.into(), factor });
            }
            // What a coarser level saw of the brightness serves the finest one.
            let open = level.is_first() || !level.last || account.light.is_unknown();
            let more = open && account.light.look(&mut pair, (self.aligned, factor), &bodies);
            if level.last {
                if more {
                    bodies.refine(&pair, level.passes, self.params.seed, |_| ());
                }
                return Ok(self.ended(&level, pair, bodies, begun, account, clock));
            }
            clock.skip("matching", account.matched);
            clock.book("residual");
            account.stages.push(Left { name: "coarse level".into(), motion: bodies.without_blocks(), factor });
            coarser = Some((bodies, factor, begun));
        }
        Err(no_match(0, "check the mask".into()).into())
    }

    /// Tells the part of a level that is done.
    fn tell(&self, stage: &str, place: usize, part: f64) {
        (self.progress)(stage, (place as f64 + part) / (self.factors.len() as f64 + 1.0));
    }

    fn level(&self, place: usize, pair: &Pair<'_>) -> Level {
        let params = self.params;
        let last = place + 1 == self.factors.len();
        let apart = if last { refinement::apart(params.node_spacing, pair.inside) } else { COARSE_NODE_SPACING_VOXELS };
        let passes = if last { params.passes } else { params.coarse_passes };
        Level { place, last, factor: self.factors[place], apart, lattice: level::lattice(pair, apart), passes }
    }

    /// The motion of a coarser level on this one, refined; where that rests on few features, those
    /// of this level are searched too.
    fn carried(
        &self,
        search: &Search<'_>,
        level: &Level,
        pair: &Pair<'_>,
        coarser: (Bodies, [usize; 3], Begun),
        account: &mut Account,
    ) -> Entry {
        let (coarse, from, begun) = coarser;
        let mut bodies = coarse.carried(&level.lattice, |p| to_level(from_level(p, level.factor), from));
        if self.given.is_some() {
            return Entry { bodies, begun, sought: false };
        }
        bodies.refine(pair, level.passes, self.params.seed, search.tick);
        let searches_again = level.place == 1 && begun.needs_next_level();
        match searches_again.then(|| search.next_level(pair, &bodies, level.passes, &mut account.matched)).flatten() {
            Some(found) => {
                account.reports.extend(found.report.clone().map(noted));
                Entry { bodies: found.motion.clone(), begun: found, sought: !level.last }
            }
            None => Entry { bodies, begun, sought: false },
        }
    }

    /// The motion with which the coarsest level begins.
    fn begun(
        &self,
        search: &Search<'_>,
        level: &Level,
        pair: &mut Pair<'a>,
        tissue: impl Fn() -> Option<Vec<u8>>,
        account: &mut Account,
    ) -> Entry {
        let Level { factor, lattice, passes, .. } = level;
        let still = SplineField::still(lattice.clone()).into();
        account.light.look_at_rest(pair, (self.aligned, *factor), &still);
        let Account { light, range, asked, matched, .. } = account;
        let around = || tissue().map(|mask| light.level_within(self.aligned, &mask, *factor));
        let begun = self.begin(search, (pair, *factor, lattice), around, *passes, (range, asked), matched);
        account.reports.extend(begun.report.clone().map(noted));
        Entry { bodies: begun.motion.clone(), begun, sought: true }
    }

    /// Divides the motion into bodies: those that are given, or those that the matches show.
    fn divide(&self, search: &Search<'_>, level: &Level, pair: &Pair<'_>, entry: &mut Entry, account: &mut Account) {
        let Entry { bodies, begun, sought } = entry;
        let Level { factor, lattice, passes, .. } = level;
        if let Some(given) = self.given {
            let labels = given.on(pair.shape, *factor);
            if level.is_first() {
                let whole = (labels, &begun.motion);
                *bodies = self.each(search, (pair, *factor, lattice), whole, *passes, &mut account.matched);
            } else {
                bodies.relabel(labels);
                bodies.refine(pair, *passes, self.params.seed, search.tick);
            }
        } else if *sought && self.params.bodies == BodySource::Found {
            let edges = pair.spacing.into_iter().zip(*factor).map(|(s, f)| s / f as f64);
            let edge = edges.fold(f64::INFINITY, f64::min);
            let divide = |bodies: &mut Bodies, begun: &Begun| {
                bodies.divide(pair, &begun.matches, *passes, edge, self.params.seed)
            };
            let mut said = divide(bodies, begun);
            let is_open = level.is_first() && bodies.only().is_some() && begun.is_partial();
            let next = self.factors.get(level.place + 1).filter(|_| is_open && ablation::is_on("look-ahead"));
            if let Some(&next) = next {
                let finer = account.light.level(self.aligned, next);
                let search = Search { range: account.range, ..*search };
                if search.look_ahead((pair, *factor), (&finer, next), begun, *passes, &mut account.matched) {
                    *bodies = begun.motion.clone();
                    said.extend(divide(bodies, begun));
                }
            }
            account.asked.extend(said.into_iter().map(noted));
        }
    }

    /// The finest level: a closer lattice where the volumes ask for it, and the matches about the
    /// field.
    fn ended(
        &self,
        level: &Level,
        pair: Pair<'a>,
        mut bodies: Bodies,
        begun: Begun,
        account: Account,
        clock: &mut Clock,
    ) -> Found<'a> {
        let (params, factor) = (self.params, level.factor);
        let Account { mut reports, mut asked, mut stages, light, range: search, matched } = account;
        let mut apart = level.apart;
        for b in 0..bodies.count() {
            let part = bodies.part(&pair, b);
            let refine = |field: &mut SplineField, passes| level::refine(&part, field, passes, params.seed, |_| ());
            let explained = finer(&part, bodies.fields[b].clone(), level.apart, params.seed, refine);
            apart = apart.min(explained.apart);
            asked.extend(explained.said.into_iter().map(noted));
            bodies.fields[b] = explained.field;
        }
        let [left, gain] = level::misfit(&pair, &bodies.warp(&pair, &pair.spans));
        clock.skip("matching", matched);
        clock.book("residual");
        self.tell("matching", level.place, 0.9);
        let automatic = (pair.inside / params.voxels_per_point).max(MIN_POINTS);
        let points = if params.points > 0 { params.points } else { automatic };
        let near = MatchParams::near(params, &pair, points.max(MIN_POINTS), params.points > 0);
        let (matches, report) = bodies.matches(&pair, near);
        if level.is_first() {
            reports.clear();
        }
        reports.push(noted(report));
        clock.book("matching");
        stages.push(Left { name: "finest level".into(), motion: bodies.without_blocks(), factor });
        Found { bodies, factor, pair, matches, points, reports, begun, light, search, left, gain, apart, asked, stages }
    }

    /// The starts that a user gave.
    fn starts_given(&self) -> &[Start] {
        if self.starts.iter().all(Start::is_given) { self.starts } else { &[] }
    }

    /// Each given body's motion on the coarsest level: by a search of its own or that of the whole,
    /// whichever agrees better in it.
    fn each(
        &self,
        search: &Search<'_>,
        (pair, factor, lattice): (&Pair<'_>, [usize; 3], &Lattice),
        (labels, whole): (Vec<u8>, &Bodies),
        passes: usize,
        matched: &mut f64,
    ) -> Bodies {
        let count = self.given.map_or(1, |g| g.names.len());
        let field = |bodies: Bodies| bodies.fields.into_iter().next();
        let start = field(whole.clone()).unwrap_or_else(|| SplineField::still(lattice.clone()));
        let mut bodies = Bodies::given(labels, vec![start.clone(); count]);
        for b in 0..count {
            let part = bodies.part(pair, b);
            let own = search.begin((&part, factor), lattice, &[], passes, matched).motion;
            let mut whole = Bodies::from(start.clone());
            whole.refine(&part, passes, self.params.seed, |_| ());
            if let Some(better) = field(Bodies::better(&part, whole, own)) {
                bodies.fields[b] = better;
            }
        }
        bodies
    }

    /// Where the passes of the coarsest level begin: inside the mask, with all tissue `around` it
    /// if few features agree there, and twice as far if the motion reaches the range or few
    /// agree.
    fn begin(
        &self,
        search: &Search<'_>,
        (pair, factor, lattice): (&Pair<'_>, [usize; 3], &Lattice),
        around: impl Fn() -> Option<Pair<'a>>,
        passes: usize,
        (range, asked): (&mut f64, &mut Vec<String>),
        matched: &mut f64,
    ) -> Begun {
        let mut found = search.begin((pair, factor), lattice, self.starts, passes, matched);
        if let Some(tissue) = found.is_unconfirmed().then(around).flatten() {
            let wider = search.begin((&tissue, factor), lattice, self.starts_given(), passes, matched);
            found = Begun::more_consistent(pair, found, wider);
        }
        if self.params.search_mm == 0.0 && found.leaves_open(pair, search.range) {
            let far = Search { range: WIDE_SEARCH_RATIO * search.range, turns: false, ..*search };
            let wide = far.begin((pair, factor), lattice, self.starts_given(), passes, matched);
            let taken = wide.improves_on(pair, &found);
            asked.push(noted(why_farther(search.range, &found, &wide, taken)));
            if taken {
                (*range, found) = (far.range, wide);
            }
        }
        found
    }
}

/// Reach of the wide search, for few agreeing features or a motion near the end of the range
/// (ranges).
pub(super) const WIDE_SEARCH_RATIO: f64 = 2.0;

/// What a search twice as far gave, in words.
fn why_farther(range: f64, own: &Begun, wide: &Begun, taken: bool) -> String {
    let open = if own.is_partial() { "few features agree" } else { "the motion reaches its end" };
    format!(
        "search range: within {range:.1} mm {open} ({:.0} % of the features agree); within {:.1} mm {:.0} % agree, {}",
        100.0 * own.share(),
        WIDE_SEARCH_RATIO * range,
        100.0 * wide.share(),
        if taken { "taken" } else { "not taken" }
    )
}

/// Fewest points that are matched, even if fewer are asked for: the field is judged by them.
pub(super) const MIN_POINTS: usize = 200;

/// The fields that what is known suggests on the coarsest level: what is left of a start, and one
/// through the landmarks.
pub(super) fn begun_from(
    known: &Known<'_>,
    aligned: &Aligned<'_>,
    factor: [usize; 3],
    grid: &Grid,
    mask: Option<&Mask>,
) -> Vec<Start> {
    if known.start.is_none() && known.landmarks.is_empty() {
        return Vec::new();
    }
    let pair = aligned.level(factor);
    let axes = grid.axes();
    let of = |start: &StartMap<'_>| {
        let rest = start::rest(start);
        let along = |p| {
            let d = rest(grid.affine().to_world(from_level(p, factor)));
            GridVector(std::array::from_fn(|a| (0..3).map(|r| axes[r][a] * d[r]).sum()))
        };
        let field = SplineField::still(level::lattice(&pair, COARSE_NODE_SPACING_VOXELS));
        let motion = SplineField { coefficients: field.lattice.fit(along), ..field };
        start::bends(rest, grid, mask).then(|| Start { motion: Bodies::from(motion), factor, followed: None })
    };
    known.start.and_then(of).into_iter().chain(landmarks::start(&pair, factor)).collect()
}

/// The mask and all other tissue: what is searched when too little inside the mask agrees.
pub(super) fn around(mask: &Mask, initial: &Voxels<'_>) -> Vec<u8> {
    let tissue = foreground(initial);
    tissue.as_slice().iter().zip(mask.as_slice()).map(|(t, m)| u8::from(*t != 0 || *m != 0)).collect()
}

/// Voxels of tissue on a level.
struct LevelSize {
    /// Fewest on the coarsest level: about one in seventy is a corner, and the field needs
    /// [`MIN_MATCHES`](super::field::MIN_MATCHES).
    min_coarsest: usize,
    /// Most on the finest level of a preset that does not fix that level.
    max_finest: usize,
}

const LEVEL_VOXELS: LevelSize = LevelSize { min_coarsest: 1500, max_finest: 600_000 };

/// The reach of the search: as asked, or 15 % of the smallest side, at least 2 voxels, at most 30
/// mm.
pub(super) fn search_mm(grid: &Grid, asked: f64) -> f64 {
    let (shape, spacing) = (grid.shape(), grid.spacing());
    let thick = || (0..3).filter(|&a| shape[a] > 1);
    let side = thick().map(|a| shape[a] as f64 * spacing[a]).fold(f64::INFINITY, f64::min);
    let voxel = thick().map(|a| spacing[a]).fold(0.0, f64::max);
    if asked > 0.0 { asked } else { (0.15 * side).min(30.0).max(2.0 * voxel) }
}

/// Voxels of the mask.
pub(super) fn inside(mask: &Mask) -> usize {
    mask.as_slice().iter().filter(|&&m| m != 0).count()
}

/// Reduction factors of the levels, coarse to fine: none but the finest with less tissue than
/// [`LEVEL_VOXELS`] says.
pub(super) fn worked_on(grid: &Grid, mask: &Mask, finest: usize, search: f64) -> Vec<[usize; 3]> {
    let inside = inside(mask);
    let mut all = factors(grid.shape(), grid.spacing(), finest, search / 6.0);
    let too_coarse =
        all.iter().take_while(|f| inside / f.iter().product::<usize>() < LEVEL_VOXELS.min_coarsest).count();
    all.drain(..too_coarse.min(all.len() - 1));
    all
}

/// Voxels between the nodes of the lattice on all levels but the finest.
pub(super) const COARSE_NODE_SPACING_VOXELS: usize = 3;

/// The finest level: as asked, or the first of 1, 2, 4, 8 at which the voxels of tissue are few
/// enough, see [`LEVEL_VOXELS`].
pub(super) fn finest_level(grid: &Grid, mask: &Mask, asked: usize) -> usize {
    if asked > 0 {
        return asked;
    }
    let inside = inside(mask);
    let left = |f: usize| {
        let factor = factors(grid.shape(), grid.spacing(), f, 0.0)[0];
        inside / factor.iter().product::<usize>()
    };
    [1, 2, 4].into_iter().find(|&f| left(f) <= LEVEL_VOXELS.max_finest).unwrap_or(8)
}
