//! Where the passes begin: with what a search of the volume says, with a field known from the frame
//! before, or at rest.

use crate::consistency::models::nearest_rigid;
use crate::matching::levels::{from_level, to_level};
use crate::matching::pair::Pair;
use crate::numerics::ablation;
use crate::numerics::bspline::Lattice;
use crate::pipeline::bodies::Bodies;
use crate::pipeline::landmarks;
use crate::pipeline::level::{self, LevelMatch, MatchParams, SplineField};
use crate::types::{Counts, FieldParams, LevelReport};
use std::time::Instant;

/// A motion where another search may start.
#[derive(Debug, Clone, PartialEq)]
pub struct Start {
    pub(super) motion: Bodies,
    /// Voxels that a voxel of its level stands for.
    pub(super) factor: [usize; 3],
    /// Frames since the whole volume was searched; none where it never was: a start that was given.
    pub(super) followed: Option<usize>,
}

impl Start {
    /// Whether the whole volume was searched for this motion, rather than known ones followed.
    pub fn searched_all(&self) -> bool {
        self.followed == Some(0)
    }

    /// Whether it was given, not measured in another frame.
    pub(super) fn is_given(&self) -> bool {
        self.followed.is_none()
    }

    /// As far again as from `before` to here: where steady motion would be next.
    pub fn extrapolated(&self, before: &Self) -> Self {
        let mut next = self.clone();
        for field in &mut next.motion.fields {
            // Where the frame before had other bodies, this one's own places tell how it moved.
            let moved = field.lattice.fit(|p| before.motion.at(to_level(from_level(p, self.factor), before.factor)));
            field.coefficients.iter_mut().zip(&moved).for_each(|(n, b)| *n += *n - b);
        }
        next
    }

    /// The motion on a level's lattice.
    fn on(&self, lattice: &Lattice, factor: [usize; 3]) -> Bodies {
        self.motion.carried(lattice, |p| to_level(from_level(p, factor), self.factor))
    }
}

/// Frames after which all is searched again, whatever confirms the field.
const FOLLOWED: usize = 5;

/// Voxels of a level's mask for each feature, where a whole volume is searched; a quarter of it in
/// one slice.
const SHARE: usize = 24;

/// The most features of the coarsest level.
const POINTS: usize = 4000;

/// The most features of the next level, times the voxels of the finest level for each of its
/// points. Over 29 pairs, legs above all, 1,500 and 600 features in the default left the same
/// error, 400 and 190 left 0.7 and 0.9 % more.
const CLOSER_POINTS: usize = 75_000;

/// Features of the next level that are not saved on, however few points are wanted.
const CLOSER_LEAST: usize = 190;

/// Part of the search range within which the next level is searched about the coarsest one's field.
const CLOSER: f64 = 0.25;

/// Fewest matches that a search may start from.
const FEWEST: usize = 8;

/// Where fewer of the features than this agree with each other, more is sought: about a rigid
/// motion and outside the mask. Heads, pads and small motions keep nine tenths, legs in thick
/// slices that moved by 16 mm four tenths.
pub(super) const AGREED: f64 = 0.75;

/// The same for a search of the next level. Slides and legs that move far keep 0.4 to 0.81.
const LOOSE: f64 = 0.85;

/// The share of features that agree when a whole volume is searched: under it, what was found is
/// doubtful. It was 0.73 or more where the motion was found (heads and legs, 3 to 20 mm), and 0.45
/// or less with inverted contrast.
const BORNE_OUT: f64 = 0.5;

/// Matches that must agree for their share to tell a search that found the motion from one that did
/// not.
const ENOUGH: usize = 20;

/// Share of the features under which those that agree may do so on a part of what moved past the
/// range: a core that slid by 28 mm in a head had 0.56 to 0.6 under a texture of its own, and was
/// found to reach 7 mm (of 20 small pairs whose motion lies in the range none had less than 0.75).
const FEW: f64 = 0.65;

/// Part of the search range from which motion is called near the end of it.
pub(super) const NEAR: f64 = 0.9;

/// Share of the features that agree in a search twice as far, in that of the nearer one, from which
/// its better agreement of the volumes is believed. Of 39 pairs whose motion reached the range the
/// nine that it took on had 0.83 to 1.15 of it and 0.32 to 1.06 of the error; six with 0.6 to 0.66
/// of it had 1.00 to 1.7.
const HARDLY_FEWER: f64 = 0.8;

/// Searches about a rigid motion at most, and the part of the features agreed before that each must
/// keep for another.
const TURNS: usize = 3;
const KEPT: f64 = 0.9;

/// What the coarsest level found.
pub(super) struct Begun {
    pub motion: Bodies,
    /// The field of the matches alone, where there were enough.
    pub of_matches: Option<SplineField>,
    /// Of the matches, where they were sought.
    pub report: Option<LevelReport>,
    pub matches: Vec<LevelMatch>,
    /// Frames since the whole volume was searched.
    pub followed: usize,
}

impl Begun {
    fn counts(&self) -> Option<Counts> {
        self.report.as_ref().map(|r| r.counts)
    }

    /// Whether all was searched and few features agreed with their neighbours.
    pub fn is_unsure(&self) -> bool {
        self.counts().is_some_and(|c| c.kept_share() < AGREED || c.kept < ENOUGH)
    }

    /// Whether so few features agreed that the next level is to be searched as well.
    pub fn is_loose(&self) -> bool {
        self.counts().is_some_and(|c| c.kept_share() < LOOSE)
    }

    /// The features and those that agreed, where these are too few to go by.
    pub fn doubted(&self) -> Option<Counts> {
        self.counts().filter(|c| c.kept_share() < BORNE_OUT)
    }

    /// The part of the features that agreed (0 to 1); nothing where none was sought.
    pub fn share(&self) -> f64 {
        self.counts().map_or(0.0, |c| c.kept_share())
    }

    /// Whether few of the features that were sought agree.
    pub fn agrees_on_few(&self) -> bool {
        self.counts().is_some_and(|c| c.kept_share() < FEW)
    }

    /// Whether a search within `range` (mm) leaves open what lies past it.
    pub fn leaves_open(&self, pair: &Pair<'_>, range: f64) -> bool {
        self.agrees_on_few() || self.report.is_some() && level::lengths(pair, |p| self.motion.at(p))[1] > NEAR * range
    }

    /// Whether a search twice as far found what the nearer one, `own`, did not: the volumes agree
    /// better, and hardly fewer features.
    pub fn outdoes(&self, pair: &Pair<'_>, own: &Self) -> bool {
        self.share() >= HARDLY_FEWER * own.share() && self.motion.agree_better(pair, &own.motion)
    }

    /// Of an unsure search and a wider one the one in which more of the features agreed: the
    /// agreement of the volumes does not tell a wrong island from the truth, neighbours do. Where
    /// there are too few features to count it is all there is.
    pub fn surer(pair: &Pair<'_>, own: Self, wider: Self) -> Self {
        let [few, many] = [&own, &wider].map(|s| s.counts().unwrap_or_default());
        let wider_is_surer = match (few.kept < ENOUGH, many.kept < ENOUGH) {
            (false, false) => many.kept_share() > few.kept_share(),
            (true, false) if many.kept_share() >= AGREED => true,
            _ => wider.motion.agree_better(pair, &own.motion),
        };
        if wider_is_surer { wider } else { own }
    }
}

/// How a whole volume is searched.
#[derive(Clone, Copy)]
pub(super) struct Search<'a> {
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

impl Search<'_> {
    /// How the matches of a level are sought within `reach_mm`, with at most `most` features.
    fn wide(&self, pair: &Pair<'_>, reach_mm: f64, most: usize) -> MatchParams {
        let share = if self.flat { SHARE / 4 } else { SHARE };
        let points = pair.inside.div_ceil(share).min(most).max(40);
        MatchParams::new(self.params, points, false, reach_mm, 2, 0.3)
    }

    fn refined(&self, pair: &Pair<'_>, mut motion: Bodies, passes: usize) -> Bodies {
        motion.refine(pair, passes, self.params.seed, self.tick);
        motion
    }

    /// What the coarsest level finds, from nothing or from `known` fields. Adds the seconds that
    /// matching takes to `seconds`.
    ///
    /// A known field that the features confirm is enough, but all is searched again every few
    /// frames. Else the field of the matches (stillness, where there are none) and, where these are
    /// unsure, the known fields compete, and the one that ends at the better agreement goes on. A
    /// known field that goes on is refined twice: it begins with the noise of another frame.
    pub fn begin(
        &self,
        (pair, factor): (&Pair<'_>, [usize; 3]),
        lattice: &Lattice,
        known: &[Start],
        passes: usize,
        seconds: &mut f64,
    ) -> Begun {
        let refined = |motion| self.refined(pair, motion, passes);
        let better = |a, b| Bodies::better(pair, a, b);
        let course = known.iter().map(|s| s.on(lattice, factor)).reduce(better).map(refined);
        let followed = known.first().and_then(|s| s.followed).filter(|&f| f < FOLLOWED);
        if let Some((motion, followed)) = course.as_ref().zip(followed)
            && timed(seconds, || self.is_confirmed(pair, motion))
        {
            return Begun {
                motion: refined(motion.clone()),
                of_matches: None,
                report: None,
                matches: Vec::new(),
                followed: followed + 1,
            };
        }
        (self.matching)();
        let (found, report, matches) = timed(seconds, || self.matched(pair, lattice));
        let counts = report.counts;
        let of_matches = found.clone();
        let own = found.map_or_else(|| SplineField::still(lattice.clone()), SplineField::to_refine);
        let own = refined(own.into());
        let in_doubt = counts.kept_share() < LOOSE || counts.kept < ENOUGH;
        let given = known.iter().any(Start::is_given);
        // If few features agree, landmarks decide.
        let marked = counts.kept_share() < BORNE_OUT && !pair.anchors.is_empty();
        let beats = |known: &Bodies| match marked {
            true => landmarks::gained(pair, &own, known) > 0.0,
            false => known.agree_better(pair, &own),
        };
        let wins = |known: &Bodies| (in_doubt || given) && beats(known);
        let motion = course.filter(wins).map_or(own, refined);
        Begun { motion, of_matches, report: Some(report), matches, followed: 0 }
    }

    /// The field of the matches of a whole volume; none where these are too few. If few features
    /// agree they are sought again about the rigid motion that most agree on, for as long as no
    /// fewer agree there: patches that turned by much are hardly alike.
    fn matched(&self, pair: &Pair<'_>, lattice: &Lattice) -> (Option<SplineField>, LevelReport, Vec<LevelMatch>) {
        let wide = self.wide(pair, self.range, POINTS);
        let agreed = |matches: &[LevelMatch]| matches.iter().filter(|m| m.kept).map(|m| m.measured).collect::<Vec<_>>();
        let (matches, field, report) = level::matches(pair, None, wide);
        let (mut kept, mut best) = (agreed(&matches), (field, report, matches));
        for _ in 0..TURNS {
            let before = best.1.counts;
            if before.kept_share() >= AGREED || kept.len() < FEWEST || !ablation::is_on("turned") {
                break;
            }
            let rigid = nearest_rigid(&kept);
            let moved = |p: [f64; 3]| rigid.displacement(std::array::from_fn(|a| p[a] * pair.spacing[a]));
            let about = SplineField { coefficients: lattice.fit(moved), ..SplineField::still(lattice.clone()) };
            let (matches, field, report) = level::matches_again(pair, &about, wide);
            kept = agreed(&matches);
            let now = report.counts.kept;
            if now > before.kept {
                best = (field, report, matches);
            } else if (now as f64) < KEPT * before.kept as f64 {
                break;
            }
        }
        let (field, report, matches) = best;
        let enough = report.counts.kept >= FEWEST;
        (field.filter(|_| enough).map(|f| level::carry(&f, lattice.clone(), |p| p)), report, matches)
    }

    /// The field of the matches of a whole volume on `lattice`; stillness where they are too few.
    pub fn by_matches(&self, pair: &Pair<'_>, lattice: &Lattice) -> SplineField {
        self.matched(pair, lattice).0.unwrap_or_else(|| SplineField::still(lattice.clone()))
    }

    /// Whether the features of a level are found where the field has them.
    fn is_confirmed(&self, pair: &Pair<'_>, motion: &Bodies) -> bool {
        let points = (pair.inside / self.params.voxels_per_point).max(CLOSER_LEAST);
        let near = MatchParams::near(self.params, pair, points, false);
        motion.matches(pair, near).1.counts.kept_share() >= AGREED
    }

    /// What a search of the next level about its field finds, if the volumes agree better there:
    /// smaller patches are distorted less, and fine texture tells a wrong island from the truth.
    pub fn closer(&self, pair: &Pair<'_>, own: &Bodies, passes: usize, seconds: &mut f64) -> Option<Begun> {
        let only = own.only().filter(|_| ablation::is_on("next-level"))?;
        let most = (CLOSER_POINTS / self.params.voxels_per_point.max(1)).clamp(CLOSER_LEAST, POINTS);
        let wide = self.wide(pair, CLOSER * self.range, most);
        (self.matching)();
        let (matches, found, report) = timed(seconds, || level::matches_again(pair, only, wide));
        let of_matches = found.filter(|_| report.counts.kept >= FEWEST)?;
        let motion = self.refined(pair, of_matches.clone().into(), passes);
        let begun = |motion| Begun { motion, of_matches: Some(of_matches), report: Some(report), matches, followed: 0 };
        motion.agree_better(pair, own).then(|| begun(motion))
    }
}

/// Adds the time that `work` takes to `seconds`.
fn timed<T>(seconds: &mut f64, work: impl FnOnce() -> T) -> T {
    let started = Instant::now();
    let out = work();
    *seconds += started.elapsed().as_secs_f64();
    out
}
