//! Where the passes begin: with what a search of the volume says, with a field known from the frame
//! before, or at rest.

use crate::consistency::models::{AffineMotion, nearest_rigid};
use crate::consistency::pruning::Measured;
use crate::matching::levels::{from_level, to_level};
use crate::matching::pair::Pair;
use crate::numerics::ablation;
use crate::numerics::bspline::Lattice;
use crate::pipeline::bodies::Bodies;
use crate::pipeline::landmarks;
use crate::pipeline::level::{self, LevelMatch, MatchParams, SplineField};
use crate::types::space::length;
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
    pub(crate) fn extrapolated(&self, before: &Self) -> Self {
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

/// The search of a whole volume.
struct WholeSearch {
    /// Frames after which it is repeated, even if the features confirm the field.
    max_frames_followed: usize,
    /// Voxels of a level's mask for each feature; a quarter of it in one slice.
    voxels_per_feature: usize,
    /// Most features of the coarsest level.
    max_features: usize,
    /// Fewest matches from which a search may start.
    min_matches: usize,
}

const WHOLE_SEARCH: WholeSearch =
    WholeSearch { max_frames_followed: 5, voxels_per_feature: 24, max_features: 4000, min_matches: 8 };

/// The search of the level after the coarsest.
struct NextLevelSearch {
    /// Most features times the finest level's voxels per point: over 29 pairs 1,500 and 600
    /// features left the same error, 190 left 0.9 % more.
    features_times_voxels_per_point: usize,
    /// Fewest features, even if few points are asked for.
    min_features: usize,
    /// Reach about the coarsest level's field over the search range.
    range_fraction: f64,
}

const NEXT_LEVEL: NextLevelSearch =
    NextLevelSearch { features_times_voxels_per_point: 75_000, min_features: 190, range_fraction: 0.25 };

/// Shares of the features that agree with their neighbours, below which a search is not trusted.
pub(super) struct KeptShare {
    /// Below it, the search goes on about a rigid motion and outside the mask: heads, pads and
    /// small motions keep nine tenths, legs in thick slices 0.4.
    pub confirmed: f64,
    /// Below it, the next level is searched too: slides and legs that move far keep 0.4 to 0.81.
    next_level: f64,
    /// Below it, a whole search is unreliable: 0.73 or more where the motion was found, 0.45 or
    /// less with inverted contrast.
    reliable: f64,
    /// Below it, features may agree on a part of a motion beyond the range: 0.56 to 0.6 in a core
    /// that slid by 28 mm, 0.75 or more in 20 pairs within the range.
    in_range: f64,
}

pub(super) const KEPT_SHARE: KeptShare = KeptShare { confirmed: 0.75, next_level: 0.85, reliable: 0.5, in_range: 0.65 };

/// Fewest matches for their share to tell whether a search found the motion.
const MIN_COUNTED_MATCHES: usize = 20;

/// Part of the search range beyond which motion is near the end of it.
pub(super) const NEAR_RANGE_FRACTION: f64 = 0.9;

/// Agreeing share of a wide search over the near one's, from which its better similarity counts: it
/// had 0.83 to 1.15 in nine pairs it improved, 0.6 to 0.66 in six it did not.
const MIN_WIDE_SHARE_RATIO: f64 = 0.8;

/// Repeated searches about a rigid motion.
struct RigidSearch {
    /// Most searches.
    max_count: usize,
    /// Agreeing features over the search before; below it, no further one follows.
    min_kept_ratio: f64,
}

const RIGID_SEARCH: RigidSearch = RigidSearch { max_count: 3, min_kept_ratio: 0.9 };

/// Searches about rotations of the whole (docs/lab/2026-11-rotations.md).
struct RotationSearch {
    /// Step in one slice (degrees): half of it is found from the nearest start.
    slice_degrees: f64,
    /// Angle to either side about each axis of a volume (degrees), where more is found.
    volume_degrees: f64,
    /// Features of each: two shares that differ by 0.07 are distinguished.
    features: usize,
    /// Rotation (degrees) from which a patch is hardly like itself, so that it is taken out of the
    /// deformed volume's axes.
    taken_out_degrees: f64,
}

const ROTATION_SEARCH: RotationSearch =
    RotationSearch { slice_degrees: 20.0, volume_degrees: 40.0, features: 100, taken_out_degrees: 30.0 };

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
    /// The rigid motion of the matches, where it turns by so much that it is to be taken out.
    pub turn: Option<AffineMotion>,
}

impl Begun {
    fn counts(&self) -> Option<Counts> {
        self.report.as_ref().map(|r| r.counts)
    }

    /// Whether all was searched and few features agreed with their neighbours.
    pub(crate) fn is_unconfirmed(&self) -> bool {
        self.counts().is_some_and(|c| c.kept_share() < KEPT_SHARE.confirmed || c.kept < MIN_COUNTED_MATCHES)
    }

    /// Whether so few features agreed that the next level is to be searched as well.
    pub(crate) fn needs_next_level(&self) -> bool {
        self.counts().is_some_and(|c| c.kept_share() < KEPT_SHARE.next_level)
    }

    /// The features and those that agreed, where these are too few to go by.
    pub(crate) fn unreliable_counts(&self) -> Option<Counts> {
        self.counts().filter(|c| c.kept_share() < KEPT_SHARE.reliable)
    }

    /// The part of the features that agreed (0 to 1); nothing where none was sought.
    pub fn share(&self) -> f64 {
        self.counts().map_or(0.0, |c| c.kept_share())
    }

    /// Whether few of the features that were sought agree.
    pub(crate) fn is_partial(&self) -> bool {
        self.counts().is_some_and(|c| c.kept_share() < KEPT_SHARE.in_range)
    }

    /// Whether a search within `range` (mm) leaves open what lies past it.
    pub(crate) fn leaves_open(&self, pair: &Pair<'_>, range: f64) -> bool {
        self.is_partial()
            || self.report.is_some() && level::lengths(pair, |p| self.motion.at(p))[1] > NEAR_RANGE_FRACTION * range
    }

    /// Whether a search twice as far found what the nearer one, `own`, did not: the volumes agree
    /// better, and hardly fewer features.
    pub(crate) fn improves_on(&self, pair: &Pair<'_>, own: &Self) -> bool {
        self.share() >= MIN_WIDE_SHARE_RATIO * own.share() && self.motion.agree_better(pair, &own.motion)
    }

    /// Of an unsure search and a wider one the one in which more of the features agreed: the
    /// agreement of the volumes does not tell a wrong island from the truth, neighbours do. Where
    /// there are too few features to count it is all there is.
    pub(crate) fn more_consistent(pair: &Pair<'_>, own: Self, wider: Self) -> Self {
        let [few, many] = [&own, &wider].map(|s| s.counts().unwrap_or_default());
        let wider_is_better = match (few.kept < MIN_COUNTED_MATCHES, many.kept < MIN_COUNTED_MATCHES) {
            (false, false) => many.kept_share() > few.kept_share(),
            (true, false) if many.kept_share() >= KEPT_SHARE.confirmed => true,
            _ => wider.motion.agree_better(pair, &own.motion),
        };
        if wider_is_better { wider } else { own }
    }
}

/// The matches of a search, their field, and what was counted.
type Matched = (Vec<LevelMatch>, Option<SplineField>, LevelReport);

/// What was measured of the matches that agree.
fn agreed(matches: &[LevelMatch]) -> Vec<Measured> {
    matches.iter().filter(|m| m.kept).map(|m| m.measured).collect()
}

/// The rigid motion of the matches, where it turns by so much that it is to be taken out.
fn far_turn(found: &Matched) -> Option<AffineMotion> {
    let (matches, _, report) = found;
    let enough = report.counts.kept >= WHOLE_SEARCH.min_matches && ablation::is_on("taken-out");
    let rigid = enough.then(|| nearest_rigid(&agreed(matches)))?;
    (rigid.angle().to_degrees() > ROTATION_SEARCH.taken_out_degrees).then_some(rigid)
}

/// The field of a rigid motion.
fn on_lattice(lattice: &Lattice, pair: &Pair<'_>, motion: &AffineMotion) -> SplineField {
    let coefficients = lattice.fit(|p| motion.on_grid(p, pair.spacing));
    SplineField { coefficients, ..SplineField::still(lattice.clone()) }
}

/// What a search found, or a further one about the rigid motion that most of its features agree
/// on, for as long as no fewer agree there.
fn settled(pair: &Pair<'_>, lattice: &Lattice, found: Matched, wide: MatchParams) -> Matched {
    let (mut kept, mut best) = (agreed(&found.0), found);
    for _ in 0..RIGID_SEARCH.max_count {
        let before = best.2.counts;
        if before.kept_share() >= KEPT_SHARE.confirmed
            || kept.len() < WHOLE_SEARCH.min_matches
            || !ablation::is_on("turned")
        {
            break;
        }
        let about = on_lattice(lattice, pair, &nearest_rigid(&kept));
        let found = level::matches_again(pair, &about, wide);
        kept = agreed(&found.0);
        let now = found.2.counts.kept;
        if now > before.kept {
            best = found;
        } else if (now as f64) < RIGID_SEARCH.min_kept_ratio * before.kept as f64 {
            break;
        }
    }
    best
}

/// The body diagonals of a cube.
const DIAGONALS: [[f64; 3]; 4] = [[1.0, 1.0, 1.0], [1.0, 1.0, -1.0], [1.0, -1.0, 1.0], [-1.0, 1.0, 1.0]];

/// Rotations about the centre of the tissue: all of them in one slice, to either side about each
/// axis and each body diagonal in a volume.
fn rotations(pair: &Pair<'_>) -> Vec<AffineMotion> {
    let [nx, ny, _] = pair.shape;
    let inside = (0..pair.mask.len()).filter(|&at| pair.mask[at] != 0);
    let sum = inside.fold([0.0; 3], |s, at| {
        let p = [at % nx, at / nx % ny, at / (nx * ny)];
        std::array::from_fn(|a| s[a] + p[a] as f64 * pair.spacing[a])
    });
    let centre = sum.map(|s| s / pair.inside.max(1) as f64);
    let unit = |axis: usize| std::array::from_fn(|a| f64::from(u8::from(a == axis)));
    let turned = |along: [f64; 3], degrees: f64| {
        let vector = along.map(|v| v / length(along) * degrees.to_radians());
        AffineMotion::rotation_about(vector, centre)
    };
    let RotationSearch { slice_degrees: step, volume_degrees: side, .. } = ROTATION_SEARCH;
    match (0..3).find(|&a| pair.shape[a] == 1) {
        Some(axis) => (1..(360.0 / step) as usize).map(|n| turned(unit(axis), n as f64 * step)).collect(),
        None => {
            let along = (0..3).map(unit).chain(DIAGONALS);
            along.flat_map(|along| [-side, side].map(|angle| turned(along, angle))).collect()
        }
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
    /// Whether rotations of the whole are tried if few features agree.
    pub turns: bool,
    /// Called as matching begins.
    pub matching: &'a dyn Fn(),
    /// Called after each pass with its number.
    pub tick: &'a dyn Fn(usize),
}

impl Search<'_> {
    /// How the matches of a level are sought within `reach_mm`, with at most `most` features.
    fn wide(&self, pair: &Pair<'_>, reach_mm: f64, most: usize) -> MatchParams {
        let share = if self.flat { WHOLE_SEARCH.voxels_per_feature / 4 } else { WHOLE_SEARCH.voxels_per_feature };
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
        let followed = known.first().and_then(|s| s.followed).filter(|&f| f < WHOLE_SEARCH.max_frames_followed);
        if let Some((motion, followed)) = course.as_ref().zip(followed)
            && timed(seconds, || self.is_confirmed(pair, motion))
        {
            return Begun {
                motion: refined(motion.clone()),
                of_matches: None,
                report: None,
                matches: Vec::new(),
                followed: followed + 1,
                turn: None,
            };
        }
        (self.matching)();
        let matched = timed(seconds, || self.matched(pair, lattice));
        let turn = far_turn(&matched);
        let (matches, found, report) = matched;
        let counts = report.counts;
        let of_matches = found.clone();
        let own = found.map_or_else(|| SplineField::still(lattice.clone()), SplineField::before_passes);
        let own = refined(own.into());
        let unconfirmed = counts.kept_share() < KEPT_SHARE.next_level || counts.kept < MIN_COUNTED_MATCHES;
        let given = known.iter().any(Start::is_given);
        // If few features agree, landmarks decide.
        let landmarks_decide = counts.kept_share() < KEPT_SHARE.reliable && !pair.anchors.is_empty();
        let beats = |known: &Bodies| match landmarks_decide {
            true => landmarks::gained(pair, &own, known) > 0.0,
            false => known.agree_better(pair, &own),
        };
        let wins = |known: &Bodies| (unconfirmed || given) && beats(known);
        let motion = course.filter(wins).map_or(own, refined);
        Begun { motion, of_matches, report: Some(report), matches, followed: 0, turn }
    }

    /// The field of the matches of a whole volume; none where these are too few. If few features
    /// agree, they are sought again about the rigid motion that most agree on, then about rotations
    /// of the whole: patches that turned by much are hardly alike.
    fn matched(&self, pair: &Pair<'_>, lattice: &Lattice) -> Matched {
        let wide = self.wide(pair, self.range, WHOLE_SEARCH.max_features);
        let mut best = settled(pair, lattice, level::matches(pair, None, wide), wide);
        let share = |found: &Matched| found.2.counts.kept_share();
        if self.turns && share(&best) < KEPT_SHARE.in_range && ablation::is_on("rotations") {
            let some = self.wide(pair, self.range, ROTATION_SEARCH.features);
            let tried = rotations(pair).into_iter().map(|turn| {
                let about = on_lattice(lattice, pair, &turn);
                (share(&level::matches_again(pair, &about, some)), about)
            });
            let most = tried.max_by(|a, b| a.0.total_cmp(&b.0)).filter(|turned| turned.0 > share(&best));
            let again = most.map(|(_, about)| level::matches_again(pair, &about, wide));
            if let Some(found) = again.filter(|f| f.2.counts.kept > best.2.counts.kept) {
                best = settled(pair, lattice, found, wide);
            }
        }
        let (matches, field, report) = best;
        let enough = report.counts.kept >= WHOLE_SEARCH.min_matches;
        (matches, field.filter(|_| enough).map(|f| level::carry(&f, lattice.clone(), |p| p)), report)
    }

    /// The field of the matches of a whole volume on `lattice`, stillness where they are too few;
    /// and their rigid motion, where it is to be taken out.
    pub(crate) fn by_matches(&self, pair: &Pair<'_>, lattice: &Lattice) -> (SplineField, Option<AffineMotion>) {
        let matched = self.matched(pair, lattice);
        let turn = far_turn(&matched);
        (matched.1.unwrap_or_else(|| SplineField::still(lattice.clone())), turn)
    }

    /// Searches the next level, `next`, within the same range: its smaller patches tell parts that
    /// move apart. If more of its features agree, they replace the matches (true), and their field
    /// is kept if the volumes agree better under it.
    pub(crate) fn look_ahead(
        &self,
        (pair, factor): (&Pair<'_>, [usize; 3]),
        (next, next_factor): (&Pair<'_>, [usize; 3]),
        begun: &mut Begun,
        passes: usize,
        seconds: &mut f64,
    ) -> bool {
        let wide = self.wide(next, self.range, WHOLE_SEARCH.max_features);
        (self.matching)();
        let (matches, found, report) = timed(seconds, || level::matches(next, None, wide));
        let more = report.counts.kept >= WHOLE_SEARCH.min_matches && report.counts.kept_share() > begun.share();
        let Some(found) = found.filter(|_| more) else { return false };
        let here = |m: LevelMatch| {
            let voxel = to_level(from_level(m.voxel, next_factor), factor);
            let place = voxel.in_mm(pair.spacing);
            LevelMatch { voxel, measured: Measured { place, ..m.measured }, ..m }
        };
        begun.matches = matches.into_iter().map(here).collect();
        begun.report = Some(report);
        let lattice = begun.motion.fields[0].lattice.clone();
        let field = level::carry(&found, lattice, |p| to_level(from_level(p, factor), next_factor));
        let motion = self.refined(pair, field.clone().before_passes().into(), passes);
        if motion.agree_better(pair, &begun.motion) {
            begun.motion = motion;
            begun.of_matches = Some(field);
        }
        true
    }

    /// Whether the features of a level are found where the field has them.
    fn is_confirmed(&self, pair: &Pair<'_>, motion: &Bodies) -> bool {
        let points = (pair.inside / self.params.voxels_per_point).max(NEXT_LEVEL.min_features);
        let near = MatchParams::near(self.params, pair, points, false);
        motion.matches(pair, near).1.counts.kept_share() >= KEPT_SHARE.confirmed
    }

    /// What a search of the next level about its field finds, if the volumes agree better there:
    /// smaller patches are distorted less, and fine texture tells a wrong island from the truth.
    pub(crate) fn next_level(&self, pair: &Pair<'_>, own: &Bodies, passes: usize, seconds: &mut f64) -> Option<Begun> {
        let only = own.only().filter(|_| ablation::is_on("next-level"))?;
        let most = (NEXT_LEVEL.features_times_voxels_per_point / self.params.voxels_per_point.max(1))
            .clamp(NEXT_LEVEL.min_features, WHOLE_SEARCH.max_features);
        let wide = self.wide(pair, NEXT_LEVEL.range_fraction * self.range, most);
        (self.matching)();
        let (matches, found, report) = timed(seconds, || level::matches_again(pair, only, wide));
        let of_matches = found.filter(|_| report.counts.kept >= WHOLE_SEARCH.min_matches)?;
        let motion = self.refined(pair, of_matches.clone().into(), passes);
        let of_matches = Some(of_matches);
        let begun = |motion| Begun { motion, of_matches, report: Some(report), matches, followed: 0, turn: None };
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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::matching::levels::Aligned;
    use crate::synth::{PhantomKind, PhantomParams, phantom};

    #[test]
    fn matches_of_the_next_level_lie_where_they_do_on_this_one() {
        let made = phantom(&PhantomParams::new(PhantomKind::Block).sized(48)).unwrap();
        let aligned = Aligned::new(&made.initial, &made.deformed, &made.mask, 8.0).unwrap();
        let (factor, next_factor) = ([2; 3], [1; 3]);
        let (pair, next) = (aligned.level(factor), aligned.level(next_factor));
        let params = FieldParams::default();
        let search = Search { params: &params, range: 8.0, flat: false, turns: false, matching: &|| (), tick: &|_| () };
        let still = SplineField::still(level::lattice(&pair, 3));
        let mut begun = Begun {
            motion: still.into(),
            of_matches: None,
            report: None,
            matches: Vec::new(),
            followed: 0,
            turn: None,
        };
        assert!(search.look_ahead((&pair, factor), (&next, next_factor), &mut begun, 4, &mut 0.0));
        let (grid, axes) = (made.initial.grid(), made.initial.grid().axes());
        let exact = |p| -> [f64; 3] {
            let v = from_level(p, factor).0.map(|v| v.round() as usize);
            let d = made.truth.at(grid.index(v[0], v[1], v[2])).map(f64::from);
            std::array::from_fn(|a| (0..3).map(|r| axes[r][a] * d[r]).sum())
        };
        let off = |u: [f64; 3], t: [f64; 3]| length(std::array::from_fn(|a| u[a] - t[a]));
        let kept: Vec<&LevelMatch> = begun.matches.iter().filter(|m| m.kept).collect();
        let within = kept.iter().filter(|m| off(m.measured.displacement, exact(m.voxel)) < 0.5).count();
        assert!(kept.len() > 100 && 10 * within > 9 * kept.len(), "{within} of {}", kept.len());
        let placed =
            |m: &&LevelMatch| (0..3).all(|a| (m.measured.place[a] - m.voxel.in_mm(pair.spacing)[a]).abs() < 1e-9);
        assert!(kept.iter().all(placed));
        // Their field goes on, as the volumes agree better under it than at rest.
        let field = begun.of_matches.unwrap();
        let carried = |m: &&&LevelMatch| off(field.at(m.voxel).0, m.measured.field) < 0.3;
        let carried = kept.iter().filter(carried).count();
        assert!(10 * carried > 9 * kept.len(), "{carried} of {}", kept.len());
    }
}
