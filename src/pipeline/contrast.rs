//! Two volumes in different contrasts brought to one, where the volumes show that they differ.
//!
//! In one contrast the mean of one volume's intensity is a rising line over the other's, however
//! little the two agree at rest. Where it is not, that mean itself serves as the volume in the
//! other's contrast: it is taken at rest, then under the motion that it leads to, coarse to fine.

use crate::error::FieldError;
use crate::matching::contrast::{Relation, Side};
use crate::matching::levels::{Aligned, from_level, to_level};
use crate::matching::pair::{Anchor, Pair};
use crate::numerics::ablation;
use crate::pipeline::bodies::Bodies;
use crate::pipeline::hypotheses::Search;
use crate::pipeline::level;
use crate::types::{Agreement, FieldParams, Mask, Voxels};

/// Part of the variance left by a gain and an offset that a free relation must explain for the
/// contrasts to differ (1). Calibrated: docs/lab/2026-11-inputs.md.
const MIN_NONLINEAR_FRACTION: f64 = 0.36;

/// Estimates of the intensity relation on each level.
const ITERATIONS_PER_LEVEL: usize = 3;

/// What the search works on in place of volumes of different contrasts.
pub(super) struct Common<'a> {
    pub initial: Voxels<'a>,
    pub deformed: Voxels<'a>,
    relation: Relation,
    side: Side,
    /// Part of the variance that a gain and an offset explain at rest.
    by_gain: f64,
}

/// What the search for a common contrast needs to know.
pub(super) struct Scene<'a> {
    pub initial: &'a Voxels<'a>,
    pub deformed: &'a Voxels<'a>,
    pub mask: &'a Mask,
    pub anchors: &'a [Anchor],
    pub factors: &'a [[usize; 3]],
    /// Range of the search (mm), and how far the deformed volume is looked at.
    pub range: f64,
    pub reach: f64,
    /// Voxels between the nodes of the lattice.
    pub nodes: usize,
    pub params: &'a FieldParams,
}

/// The relation of the intensities in the mask, under a warp.
fn relation(pair: &Pair<'_>, warped: &[f32]) -> Option<Relation> {
    let inside = pair.fixed_smooth.iter().zip(warped).zip(&pair.mask[..]).filter(|(_, m)| **m != 0);
    Relation::of(inside.map(|((f, w), _)| [*f, *w]))
}

/// How well the volumes agree at rest and under `motion`, whatever their contrast; from every
/// second slice.
pub(super) fn agreement(pair: &Pair<'_>, motion: &Bodies) -> Agreement {
    let some = pair.spans.slices(|k| k % 2 == 0);
    let still = Bodies::still(pair);
    let of = |motion: &Bodies| relation(pair, &motion.warp(pair, &some)).map_or(0.0, |r| r.most());
    Agreement { at_rest: of(&still), found: of(motion) }
}

impl<'a> Scene<'a> {
    /// The volumes in one contrast; none where they are, or where nothing tells.
    ///
    /// # Errors
    /// As [`Aligned::new`].
    pub fn common(&self, aligned: &Aligned<'_>) -> Result<Option<Common<'a>>, FieldError> {
        let pair = aligned.level(self.factors[0]);
        let still = Bodies::still(&pair);
        let at_rest = relation(&pair, &still.warp(&pair, &pair.spans));
        let Some(at_rest) = at_rest.filter(|r| differs(r) && ablation::is_on("contrast")) else { return Ok(None) };
        let mut found = at_rest.clone();
        let mut motion: Option<(Bodies, [usize; 3])> = None;
        for &factor in self.factors {
            let pair = aligned.level(factor);
            for _ in 0..ITERATIONS_PER_LEVEL {
                let (initial, deformed) = self.recast(&found);
                let recast = self.aligned(&initial, &deformed)?;
                let moved = self.motion(&recast.level(factor), factor, motion.take());
                if let Some(next) = relation(&pair, &moved.warp(&pair, &pair.spans)) {
                    found = next;
                }
                motion = Some((moved, factor));
            }
        }
        let (initial, deformed) = self.recast(&found);
        let (side, by_gain) = (found.side(), at_rest.explained_by_gain().max(0.0));
        Ok(Some(Common { initial, deformed, side, relation: found, by_gain }))
    }

    /// Both volumes on one lattice.
    ///
    /// # Errors
    /// As [`Aligned::new`].
    pub fn aligned<'b>(&self, initial: &'b Voxels<'b>, deformed: &'b Voxels<'b>) -> Result<Aligned<'b>, FieldError>
    where
        'a: 'b,
    {
        Ok(Aligned::new(initial, deformed, self.mask, self.reach)?.with_anchors(self.anchors.to_vec()))
    }

    /// The motion on a level: searched for on the coarsest one, then refined.
    fn motion(&self, pair: &Pair<'_>, factor: [usize; 3], before: Option<(Bodies, [usize; 3])>) -> Bodies {
        let lattice = level::lattice(pair, self.nodes);
        let passes = self.params.coarse_passes;
        match before {
            Some((coarse, from)) => {
                let mut motion = coarse.carried(&lattice, |p| to_level(from_level(p, factor), from));
                motion.refine(pair, passes, self.params.seed, |_| ());
                motion
            }
            None => {
                let flat = pair.shape.contains(&1);
                let search = Search {
                    params: self.params,
                    range: self.range,
                    flat,
                    turns: false,
                    matching: &|| (),
                    tick: &|_| (),
                };
                search.begin((pair, factor), &lattice, &[], passes, &mut 0.0).motion
            }
        }
    }

    /// The two volumes as `relation` brings them to one contrast.
    fn recast(&self, relation: &Relation) -> (Voxels<'a>, Voxels<'a>) {
        let (mut initial, mut deformed) = (self.initial.view(), self.deformed.view());
        let side = relation.side();
        let recast = if side == Side::Initial { &mut initial } else { &mut deformed };
        relation.recast(side, recast.as_mut_slice());
        (initial, deformed)
    }
}

/// Whether the intensities go together otherwise than in one contrast.
fn differs(relation: &Relation) -> bool {
    let (any, by_gain) = (relation.most(), relation.explained_by_gain());
    any - by_gain.max(0.0) > MIN_NONLINEAR_FRACTION * (1.0 - by_gain.max(0.0))
}

impl Common<'_> {
    /// The part of the variance that the relation explains under the motion (0 to 1).
    pub fn explained(&self) -> f64 {
        self.relation.most()
    }

    /// The name of the volume that was brought to the other's contrast.
    pub fn recast(&self) -> &'static str {
        if self.side == Side::Initial { "initial" } else { "deformed" }
    }

    /// What was done, in words.
    pub fn why(&self) -> String {
        let [own, other] = if self.side == Side::Initial { ["initial", "deformed"] } else { ["deformed", "initial"] };
        format!(
            "contrast: the volumes have different ones (at rest a gain explains {:.0} % of the variance, under the motion any relation {:.0} %); \
             the {own} volume was brought to the {other} one's",
            100.0 * self.by_gain,
            100.0 * self.explained()
        )
    }

    /// What to tell of it.
    pub fn said(&self) -> String {
        format!(
            "the two volumes have different contrasts, and the relation of their intensities explains {:.0} % of the variance. Expect a less \
             accurate field than in one contrast, most of all where two tissues look alike",
            100.0 * self.explained()
        )
    }
}
