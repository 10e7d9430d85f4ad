//! The bodies of a scene: parts of the tissue that slide along each other, each with a spline field
//! of its own.
//!
//! Most scenes have one. Another is tried where two motions explain the matches better than one
//! ([`grouping`]): passes within each body and sharing out of the voxels alternate, and it stays if
//! what it explains of the misfit is worth its degrees of freedom.

use crate::consistency::energy::distance;
use crate::consistency::grouping;
use crate::consistency::models::MIN_DEGREES_OF_FREEDOM;
use crate::consistency::pruning::{GATE, Measured};
use crate::matching::gain::GainField;
use crate::matching::pair::{Pair, Spans};
use crate::matching::residual::{self, CAUCHY_TUNING};
use crate::numerics::bspline::Lattice;
use crate::numerics::sampling::beside;
use crate::numerics::statistics::median;
use crate::numerics::{ablation, filters, pyramid};
use crate::pipeline::landmarks;
use crate::pipeline::level::{self, LevelMatch, MatchParams, SplineField};
use crate::types::{GridVector, LevelReport, VoxelPoint};
use rayon::prelude::*;
use std::ops::Range;

/// How voxels are assigned to bodies; trade-offs are of 12 sliding scenes.
struct SegmentationControl {
    /// Passes between two updates of the segmentation.
    passes: usize,
    /// Window of the residuals (finest voxels, one Gaussian standard deviation): 0.6 to 1.4 change
    /// errors by 5 %.
    residual_window_voxels: f64,
    /// Log odds of a voxel whose whole neighbourhood belongs to a body: 3 to 12 change errors by
    /// 2 %.
    coherence_weight: f32,
    /// Width of that neighbourhood (finest voxels, one Gaussian standard deviation): 1 to 2.2
    /// change errors by 2 %.
    coherence_window_voxels: f64,
    /// Parts of a body below this fraction of its largest connected part join the body around them.
    max_island_fraction: f64,
    /// Mean-field iterations that balance each voxel's shares with its neighbourhood's.
    iterations: usize,
}

const SEGMENTATION: SegmentationControl = SegmentationControl {
    passes: 2,
    residual_window_voxels: 0.8,
    coherence_weight: 5.0,
    coherence_window_voxels: 1.2,
    max_island_fraction: 0.1,
    iterations: 5,
};

/// How a further body is tested.
struct TrialControl {
    /// Segmentations in a trial; then the body must explain more than its degrees of freedom cost.
    rounds: usize,
    /// A trial ends unless its first round reduces the initial loss to this part: of 22 scenes
    /// those with one body kept 0.31 to 0.97, those with more 0.13 at most.
    max_loss_ratio: f64,
    /// Misfit that each further degree of freedom must explain (Akaike 1974): twice what chance
    /// gives.
    min_gain_per_degree_of_freedom: f64,
    /// Fewest matches of a body.
    min_matches: usize,
    /// Least median jump of the motion at its border (voxels of the initial volume).
    min_jump_voxels: f64,
    /// Most bodies.
    max_bodies: usize,
}

const TRIAL: TrialControl = TrialControl {
    rounds: 2,
    max_loss_ratio: 0.25,
    min_gain_per_degree_of_freedom: 2.0,
    min_matches: 6,
    min_jump_voxels: 1.0,
    max_bodies: 8,
};

/// Tissue shared out among bodies, with their motions.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Bodies {
    /// The body of each voxel of the level; empty where there is one.
    labels: Vec<u8>,
    /// Whether the labels stay as they are.
    fixed: bool,
    /// Their fields, each on a lattice over the whole level.
    pub fields: Vec<SplineField>,
}

/// Bodies that are given as labels at full resolution.
pub(super) struct Given {
    /// The label of each body, rising.
    pub names: Vec<u8>,
    /// The body of each voxel; outside the labels that of the nearest labelled voxel.
    labels: Vec<u8>,
    shape: [usize; 3],
}

impl Given {
    /// From labels, 0 where there is no tissue.
    pub fn new(labels: &[u8], shape: [usize; 3]) -> Self {
        let mut seen = [false; 256];
        labels.iter().for_each(|l| seen[usize::from(*l)] = true);
        let names: Vec<u8> = (1..=255).filter(|l| seen[usize::from(*l)]).collect();
        let body = |l: &u8| names.binary_search(l).map_or(u8::MAX, |b| b as u8);
        let mut labels: Vec<u8> = labels.iter().map(body).collect();
        let mut front: Vec<usize> = (0..labels.len()).filter(|&at| labels[at] != u8::MAX).collect();
        while !front.is_empty() {
            let mut next = Vec::new();
            for at in front {
                for other in beside(shape, at) {
                    if labels[other] == u8::MAX {
                        labels[other] = labels[at];
                        next.push(other);
                    }
                }
            }
            front = next;
        }
        Self { names, labels, shape }
    }

    /// The body of each voxel of a level of `shape`: the commonest among those it stands for, the
    /// first of several.
    pub fn on(&self, shape: [usize; 3], factor: [usize; 3]) -> Vec<u8> {
        if factor == [1; 3] {
            return self.labels.clone();
        }
        let common = |at: usize| {
            let v = [at % shape[0], at / shape[0] % shape[1], at / (shape[0] * shape[1])];
            let [x, y, z]: [Range<usize>; 3] = std::array::from_fn(|a| {
                (v[a] * factor[a]).min(self.shape[a] - 1)..((v[a] + 1) * factor[a]).min(self.shape[a])
            });
            let mut counts = vec![0usize; self.names.len()];
            for (k, j) in z.flat_map(|k| y.clone().map(move |j| (k, j))) {
                let row = self.shape[0] * (j + self.shape[1] * k);
                self.labels[row + x.start..row + x.end].iter().for_each(|l| counts[usize::from(*l)] += 1);
            }
            (0..counts.len()).fold(0, |best, b| if counts[b] > counts[best] { b } else { best }) as u8
        };
        (0..shape.iter().product()).into_par_iter().map(common).collect()
    }
}

/// A trial of one body more: what it explains.
pub(super) struct Trial {
    bodies: Bodies,
    /// Misfit explained, in units of noise.
    gain: f64,
    /// Degrees of freedom more.
    more: f64,
    /// Jump of the motion at its border (mm, median).
    jump: f64,
}

impl From<SplineField> for Bodies {
    fn from(field: SplineField) -> Self {
        Self { labels: Vec::new(), fixed: false, fields: vec![field] }
    }
}

impl Bodies {
    /// One body at rest.
    pub(super) fn still(pair: &Pair<'_>) -> Self {
        SplineField::still(level::windows(pair)).into()
    }

    /// With labels that stay as they are, one field each.
    pub(super) fn given(labels: Vec<u8>, fields: Vec<SplineField>) -> Self {
        Self { labels, fixed: true, fields }
    }

    /// Puts the labels of this level in the place of those carried over.
    pub(super) fn relabel(&mut self, labels: Vec<u8>) {
        self.labels = labels;
    }

    /// The same without the information at the nodes, from which no search starts.
    pub(crate) fn without_blocks(&self) -> Self {
        let fields = self.fields.iter().map(SplineField::without_blocks).collect();
        Self { labels: self.labels.clone(), fixed: self.fixed, fields }
    }

    /// How many there are.
    pub fn count(&self) -> usize {
        self.fields.len()
    }

    /// The field of all, where there is one body.
    pub fn only(&self) -> Option<&SplineField> {
        self.fields.first().filter(|_| self.count() == 1)
    }

    /// The body of a voxel of the level.
    pub fn label(&self, voxel: usize) -> usize {
        self.labels.get(voxel).copied().unwrap_or(0).into()
    }

    /// The body at a place of the level, or the nearest to it.
    pub(crate) fn label_near(&self, p: VoxelPoint) -> usize {
        if self.labels.is_empty() {
            return 0;
        }
        self.label(voxel_near(self.fields[0].lattice.shape, p))
    }

    /// The displacement at a place of the level.
    pub fn at(&self, p: VoxelPoint) -> GridVector {
        self.fields[self.label_near(p)].at(p)
    }

    /// The same bodies on another level, on lattices as `lattice`; `place` maps its voxels to those
    /// here.
    pub fn carried(&self, lattice: &Lattice, place: impl Fn(VoxelPoint) -> VoxelPoint + Sync) -> Self {
        let labels = self.labels_on(lattice.shape, &place);
        let fields = self.fields.iter().map(|f| level::carry(f, lattice.clone(), &place)).collect();
        Self { labels, fixed: self.fixed, fields }
    }

    /// The body of each voxel of another volume of `shape`, none where there is one body; `place`
    /// maps its voxels to those here.
    pub(crate) fn labels_on(&self, shape: [usize; 3], place: impl Fn(VoxelPoint) -> VoxelPoint + Sync) -> Vec<u8> {
        let [nx, ny, nz] = shape;
        let label = |at: usize| {
            let v = [at % nx, at / nx % ny, at / (nx * ny)];
            self.label_near(place(VoxelPoint::of(v))) as u8
        };
        let voxels = if self.labels.is_empty() { 0 } else { nx * ny * nz };
        (0..voxels).into_par_iter().map(label).collect()
    }

    /// A pair where only one body counts.
    pub fn part<'a>(&self, pair: &'a Pair<'_>, body: usize) -> Pair<'a> {
        if self.labels.is_empty() {
            return pair.within(pair.spans.clone());
        }
        let own = |(m, l): (&u8, &u8)| if usize::from(*l) == body { *m } else { 0 };
        let mask: Vec<u8> = pair.mask.iter().zip(&self.labels).map(own).collect();
        let inside = mask.iter().filter(|m| **m != 0).count();
        let spans = Spans::new(&mask, pair.shape);
        let anchors = pair.anchors.iter().filter(|a| self.label_near(a.at) == body).copied().collect();
        Pair { mask: mask.into(), inside, anchors, ..pair.within(spans) }
    }

    /// The deformed volume as all bodies together bring it back.
    pub fn warp(&self, pair: &Pair<'_>, spans: &Spans) -> Vec<f32> {
        let mut warps = self.fields.iter().map(|f| pair.warp(&f.lattice, &f.coefficients, spans));
        let first = warps.next().unwrap_or_default();
        warps.enumerate().fold(first, |mut all, (b, warp)| {
            let own = self.labels.iter().zip(warp).zip(&mut all).filter(|((l, _), _)| usize::from(**l) == b + 1);
            own.for_each(|((_, w), a)| *a = w);
            all
        })
    }

    /// Passes within each body, with voxels shared out between them.
    pub fn refine(&mut self, pair: &Pair<'_>, passes: usize, seed: u64, tick: impl Fn(usize)) {
        if let [field] = &mut self.fields[..] {
            return level::refine(pair, field, passes, seed, tick);
        }
        let begun: Vec<Vec<f32>> = self.fields.iter().map(|f| f.coefficients.clone()).collect();
        for done in (0..passes).step_by(SEGMENTATION.passes) {
            if done > 0 && !self.fixed {
                self.share_out(pair);
            }
            for b in 0..self.count() {
                let part = self.part(pair, b);
                let (field, passes) = (&mut self.fields[b], SEGMENTATION.passes.min(passes - done));
                level::refine_from(&part, field, &begun[b], passes, seed, |_| ());
            }
            tick(done);
        }
    }

    /// Brings back what the bending energy flattened of each body's field.
    pub(crate) fn twicing(&mut self, pair: &Pair<'_>, seed: u64) {
        for b in 0..self.count() {
            level::twicing(&self.part(pair, b), &mut self.fields[b], seed);
        }
    }

    /// The matches of each body about its own field, with what the level reports of all.
    pub fn matches(&self, pair: &Pair<'_>, params: MatchParams) -> (Vec<LevelMatch>, LevelReport) {
        let of = |b: usize| {
            let part = self.part(pair, b);
            let points = (params.points * part.inside).div_ceil(pair.inside.max(1)).max(1);
            let (matches, _, report) = level::matches(&part, Some(&self.fields[b]), MatchParams { points, ..params });
            (matches, report)
        };
        let all = (0..self.count()).map(of).reduce(|(mut matches, first), (more, second)| {
            matches.extend(more);
            (matches, first.with(&second))
        });
        all.unwrap_or_default()
    }

    /// Divides bodies for as long as `matches` propose it and the volumes agree so much better;
    /// says of each what it explains.
    pub(crate) fn divide(
        &mut self,
        pair: &Pair<'_>,
        matches: &[LevelMatch],
        passes: usize,
        finest: f64,
        seed: u64,
    ) -> Vec<String> {
        let mut said = Vec::new();
        if self.fixed || !ablation::is_on("bodies") {
            return said;
        }
        while self.count() < TRIAL.max_bodies {
            let proposed: Vec<Self> = (0..self.count()).flat_map(|b| self.proposed(pair, matches, b)).collect();
            let proposals = proposed.len();
            let tried = proposed.into_iter().filter_map(|bodies| bodies.tried(pair, self, seed));
            let rests = |t: &Trial| {
                let own = matches.iter().filter(|m| t.bodies.label_near(m.voxel) == self.count());
                own.count() >= TRIAL.min_matches
            };
            let is_significant = |t: &Trial| {
                t.gain > TRIAL.min_gain_per_degree_of_freedom * t.more.max(MIN_DEGREES_OF_FREEDOM)
                    && t.jump > TRIAL.min_jump_voxels * finest
            };
            let Some(best) = tried.filter(|t| is_significant(t) && rests(t)).max_by(|a, b| a.gain.total_cmp(&b.gain))
            else {
                if proposals > 0 {
                    let s = if proposals == 1 { "" } else { "s" };
                    let kept = self.count();
                    said.push(format!(
                        "bodies: {kept} kept; the volumes refuse {proposals} division{s} that the matches propose"
                    ));
                }
                break;
            };
            said.push(best.why(self.count() + 1));
            *self = best.bodies;
            self.refine(pair, passes, seed, |_| ());
        }
        said
    }

    /// Each division of one body in two that the matches in it propose.
    fn proposed(&self, pair: &Pair<'_>, matches: &[LevelMatch], body: usize) -> Vec<Self> {
        let own: Vec<&LevelMatch> = matches.iter().filter(|m| self.label_near(m.voxel) == body).collect();
        let field = &self.fields[body];
        let measured = |m: &&LevelMatch| Measured { field: field.at(m.voxel).0, ..m.measured };
        let measured: Vec<Measured> = own.iter().map(measured).collect();
        let splits = grouping::splits(&measured, pyramid::finest(pair.shape, pair.spacing));
        splits.iter().map(|second| self.divided(pair, &own, second, body)).collect()
    }

    /// One body in two: voxels go with the matches around them, and each side's field is that of
    /// its matches.
    fn divided(&self, pair: &Pair<'_>, matches: &[&LevelMatch], second: &[bool], body: usize) -> Self {
        let inside = pair.mask.iter().enumerate().filter(|(at, m)| **m != 0 && self.label(*at) == body).count();
        let width = (inside as f64 / matches.len().max(1) as f64).cbrt();
        let mut votes = vec![0.0f32; pair.mask.len()];
        for (m, second) in matches.iter().zip(second) {
            votes[voxel_near(pair.shape, m.voxel)] += if *second { 1.0 } else { -1.0 };
        }
        let votes = filters::gaussian(&votes, pair.shape, pair.in_voxels(1).map(|v| width / v as f64));
        let new = self.count() as u8;
        let label = |at: usize| match self.label(at) {
            old if old == body && votes[at] > 0.0 => new,
            old => old as u8,
        };
        let labels = (0..votes.len()).map(label).collect();
        let side = |which: bool| {
            let own: Vec<_> = matches.iter().zip(second).filter(|(_, s)| **s == which).map(|(m, _)| m.seen()).collect();
            let (field, _) = level::couple(pair, own.into_iter(), (&pair.in_voxels(2), 0.3), None);
            level::carry(&field, self.fields[body].lattice.clone(), |p| p).before_passes()
        };
        let mut fields = self.fields.clone();
        fields[body] = side(false);
        fields.push(side(true));
        Self { labels, fixed: false, fields }
    }

    /// Whether the two volumes agree better under these than under `other`.
    pub(crate) fn agree_better(&self, pair: &Pair<'_>, other: &Self) -> bool {
        let gained = level::gained(pair, &other.warp(pair, &pair.spans), self.warp(pair, &pair.spans));
        gained + landmarks::gained(pair, other, self) > 0.0
    }

    /// Those of two under which the volumes agree better.
    pub fn better(pair: &Pair<'_>, a: Self, b: Self) -> Self {
        if b.agree_better(pair, &a) { b } else { a }
    }

    /// A few passes, and what these then explain that `fewer` do not; none where it is nothing, or
    /// soon seems so.
    fn tried(mut self, pair: &Pair<'_>, fewer: &Self, seed: u64) -> Option<Trial> {
        let before = fewer.warp(pair, &pair.spans);
        let gained = |bodies: &Self| level::gained(pair, &before, bodies.warp(pair, &pair.spans));
        let mut gain = gained(&self);
        for round in 0..TRIAL.rounds {
            let last = gain;
            self.refine(pair, SEGMENTATION.passes, seed, |_| ());
            self.share_out(pair);
            gain = gained(&self);
            if gain < last.min(0.0) * if round + 1 < TRIAL.rounds { TRIAL.max_loss_ratio } else { 0.0 } {
                return None;
            }
        }
        let determined = |bodies: &Self| -> f64 {
            let parts = bodies.fields.iter().enumerate();
            parts.map(|(b, field)| level::determined(&bodies.part(pair, b), field, seed)).sum()
        };
        let more = determined(&self) - determined(fewer);
        let jump = self.jump(pair, self.count() - 1);
        Some(Trial { bodies: self, gain, more, jump })
    }

    /// The jump of the motion (mm, median) where a body borders on others; 0 where it borders on
    /// none.
    pub fn jump(&self, pair: &Pair<'_>, body: usize) -> f64 {
        let [nx, ny, _] = pair.shape;
        let after = |at: usize| {
            let v = [at % nx, at / nx % ny, at / (nx * ny)];
            let steps = [(0, 1), (1, nx), (2, nx * ny)].into_iter().filter(move |&(a, _)| v[a] + 1 < pair.shape[a]);
            steps.map(move |(a, stride)| {
                let mut p = VoxelPoint::of(v);
                p.0[a] += 0.5;
                (at + stride, p)
            })
        };
        let mut jumps = Vec::new();
        for at in (0..self.labels.len()).filter(|&at| pair.mask[at] != 0) {
            for (other, p) in after(at).filter(|(other, _)| pair.mask[*other] != 0) {
                let sides = [self.label(at), self.label(other)];
                if sides[0] != sides[1] && sides.contains(&body) {
                    let [a, b] = sides.map(|s| self.fields[s].at(p));
                    jumps.push(distance(a.0, b.0) as f32);
                }
            }
        }
        if jumps.is_empty() { 0.0 } else { f64::from(median(&mut jumps)) }
    }

    /// Gives each voxel to the body whose motion explains it and its surroundings best, and that
    /// most of these belong to (mean field of a Potts model; the residuals' robust cost, in a
    /// window, as log likelihood).
    fn share_out(&mut self, pair: &Pair<'_>) {
        let all = self.warp(pair, &pair.spans);
        let gain = GainField::measure(pair, &all);
        let sigma = residual::residual_sigma(pair, &all, &gain).max(f32::MIN_POSITIVE);
        drop(all);
        let finest = pyramid::finest(pair.shape, pair.spacing);
        let around = |values: &[f32], width: f64| {
            filters::gaussian(
                values,
                pair.shape,
                std::array::from_fn(|a| if pair.shape[a] > 1 { width * finest / pair.spacing[a] } else { 0.0 }),
            )
        };
        // Voxels that the window stands for.
        let held: f64 = (0..3)
            .filter(|&a| pair.shape[a] > 1)
            .map(|a| (window(SEGMENTATION.residual_window_voxels) * finest / pair.spacing[a]).max(1.0))
            .product();
        let trust = 0.5 * held as f32 * level::independent(pair);
        let costs: Vec<Vec<f32>> = self
            .fields
            .iter()
            .map(|f| {
                around(
                    &cost(pair, &pair.warp(&f.lattice, &f.coefficients, &pair.spans), &gain, sigma),
                    SEGMENTATION.residual_window_voxels,
                )
            })
            .collect();
        let tissue = around(
            &pair.mask.iter().map(|m| f32::from(u8::from(*m != 0))).collect::<Vec<_>>(),
            SEGMENTATION.coherence_window_voxels,
        );
        let of = |b: usize| move |(at, l): (usize, &u8)| f32::from(pair.mask[at] != 0 && usize::from(*l) == b);
        // The shares of the last body are what those of the others leave.
        let last = self.count() - 1;
        let mut shares: Vec<Vec<f32>> =
            (0..last).map(|b| self.labels.iter().enumerate().map(of(b)).collect()).collect();
        let share_of = |all: &[Vec<f32>], whole: f32, b: usize, at: usize| match all.get(b) {
            Some(own) => own[at],
            None => whole - all.iter().map(|s| s[at]).sum::<f32>(),
        };
        for _ in 0..SEGMENTATION.iterations {
            let about: Vec<Vec<f32>> = shares.iter().map(|s| around(s, SEGMENTATION.coherence_window_voxels)).collect();
            let energy = |b: usize, at: usize| {
                trust * costs[b][at] - SEGMENTATION.coherence_weight * share_of(&about, tissue[at], b, at)
            };
            for (b, share) in shares.iter_mut().enumerate() {
                share.par_iter_mut().enumerate().filter(|(at, _)| pair.mask[*at] != 0).for_each(|(at, share)| {
                    let own = energy(b, at);
                    *share = 1.0 / (0..=last).map(|other| (own - energy(other, at)).exp()).sum::<f32>();
                });
            }
        }
        // Outside the tissue the nearest body goes on.
        let about: Vec<Vec<f32>> = shares.iter().map(|s| around(s, SEGMENTATION.coherence_window_voxels)).collect();
        self.labels.par_iter_mut().enumerate().for_each(|(at, label)| {
            let share = |b: usize| match pair.mask[at] {
                0 => share_of(&about, tissue[at], b, at),
                _ => share_of(&shares, 1.0, b, at),
            };
            let best = (0..=last).fold(usize::from(*label), |best, b| if share(b) > share(best) { b } else { best });
            *label = best as u8;
        });
        self.join_islands(pair);
    }

    /// Gives parts of a body that are small beside its largest one, and apart from it, to the body
    /// that they touch most.
    fn join_islands(&mut self, pair: &Pair<'_>) {
        let mut part = vec![usize::MAX; self.labels.len()];
        let mut parts: Vec<Vec<usize>> = Vec::new();
        for start in (0..self.labels.len()).filter(|&at| pair.mask[at] != 0) {
            if part[start] != usize::MAX {
                continue;
            }
            part[start] = parts.len();
            let mut own = vec![start];
            let mut next = 0;
            while let Some(&at) = own.get(next) {
                next += 1;
                for other in beside(pair.shape, at) {
                    if pair.mask[other] != 0 && part[other] == usize::MAX && self.labels[other] == self.labels[at] {
                        part[other] = parts.len();
                        own.push(other);
                    }
                }
            }
            parts.push(own);
        }
        let mut largest = vec![0usize; self.count()];
        parts.iter().for_each(|p| largest[self.label(p[0])] = largest[self.label(p[0])].max(p.len()));
        parts.retain(|p| (p.len() as f64) < SEGMENTATION.max_island_fraction * largest[self.label(p[0])] as f64);
        for own in &parts {
            let mut touched = vec![0usize; self.count()];
            let around = own.iter().flat_map(|&at| beside(pair.shape, at)).filter(|&o| pair.mask[o] != 0);
            around.filter(|&o| self.labels[o] != self.labels[own[0]]).for_each(|o| touched[self.label(o)] += 1);
            let most = (0..touched.len()).fold(0, |best, b| if touched[b] > touched[best] { b } else { best });
            if touched[most] > 0 {
                own.iter().for_each(|&at| self.labels[at] = most as u8);
            }
        }
    }
}

/// The voxel at a place, or the nearest to it.
fn voxel_near(shape: [usize; 3], VoxelPoint(p): VoxelPoint) -> usize {
    let v: [usize; 3] = std::array::from_fn(|a| (p[a].round().max(0.0) as usize).min(shape[a] - 1));
    v[0] + shape[0] * (v[1] + shape[1] * v[2])
}

impl Trial {
    /// What the trial found, in words.
    fn why(&self, number: usize) -> String {
        let Self { gain, more, jump, .. } = self;
        let than = if *more < 0.0 { "fewer" } else { "more" };
        format!(
            "bodies: {number} taken; the last explains {gain:.0} of the misfit with {:.0} degrees of freedom {than} (each more must explain {}); \
             its motion differs by {jump:.1} mm from its neighbours' along their border (median)",
            more.abs(),
            TRIAL.min_gain_per_degree_of_freedom
        )
    }
}

/// Voxels along an axis that a Gaussian of this width stands for: those of a box of the same noise.
fn window(width: f64) -> f64 {
    2.0 * std::f64::consts::PI.sqrt() * width
}

/// Cauchy's cost of what is left at each voxel of the mask; much where the deformed volume does not
/// show it.
fn cost(pair: &Pair<'_>, warped: &[f32], gain: &GainField, sigma: f32) -> Vec<f32> {
    let [nx, ny, _] = pair.shape;
    let cut = 1.0 / (CAUCHY_TUNING * sigma);
    let mut out = vec![0.0f32; warped.len()];
    let room = || (vec![0.0; nx], vec![0.0; nx]);
    out.par_chunks_mut(nx).enumerate().for_each_init(room, |(a, b), (row, out)| {
        gain.row(row % ny, row / ny, a, b);
        for (i, out) in out.iter_mut().enumerate().filter(|(i, _)| pair.mask[row * nx + i] != 0) {
            let at = row * nx + i;
            let t = cut * (pair.fixed_smooth[at] - (a[i] * warped[at] + b[i]));
            *out = if t.is_finite() { CAUCHY_TUNING * CAUCHY_TUNING * (t * t).ln_1p() } else { GATE as f32 };
        }
    });
    out
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::matching::levels::Aligned;
    use crate::types::{Affine, Grid, Mask, Volume};

    #[test]
    fn given_labels_are_filled_outward_and_go_to_the_commonest_on_a_level() {
        let shape = [6, 4, 2];
        let label = |at: usize| match at % 6 {
            0 | 1 => 5,
            2 | 3 => 0,
            _ => 9,
        };
        let labels: Vec<u8> = (0..48).map(label).collect();
        let given = Given::new(&labels, shape);
        assert_eq!(given.names, [5, 9]);
        assert_eq!(given.on(shape, [1; 3])[..6], [0, 0, 0, 1, 1, 1]);
        assert_eq!(given.on([3, 2, 1], [2; 3]), [0, 0, 1, 0, 0, 1]);
    }

    #[test]
    fn islands_join_what_is_around_them_and_halves_stay() {
        let shape = [24, 12, 12];
        let grid = Grid::new(shape, Affine::scaled([1.0; 3], [0.0; 3]).unwrap()).unwrap();
        let volume = Volume::from_vec(grid, (0..grid.len()).map(|at| (at * 7919 % 101) as f32).collect()).unwrap();
        let mask = Mask::filled(grid, 1);
        let aligned = Aligned::new(&volume, &volume, &mask, 1.0).unwrap();
        let pair = aligned.level([1; 3]);
        let still = || SplineField::still(level::lattice(&pair, 4));
        // Two halves of one body to either side of the other, and a speck of it inside that one.
        let half = |at: usize| u8::from((8..16).contains(&(at % 24)));
        let mut labels: Vec<u8> = (0..grid.len()).map(half).collect();
        let speck = grid.index(12, 6, 6);
        labels[speck] = 0;
        let mut bodies = Bodies { labels, fixed: false, fields: vec![still(), still()] };
        bodies.join_islands(&pair);
        assert!((0..grid.len()).all(|at| bodies.label(at) == usize::from(half(at))));
    }
}
