//! Regions without labels: a map of the modulus, cut into as many regions as the data support.

use crate::error::StiffnessError;
use crate::mesh::tetrahedral::{Fineness, mesh_labels};
use crate::pipeline::stiffness::{Inputs, Progress, coarse_fineness};
use crate::stiffness::choice::choose;
use crate::stiffness::geometry;
use crate::stiffness::identify::{Estimate, State};
use crate::stiffness::inclusion::{Inclusion, SHAPES};
use crate::stiffness::level::Level;
use crate::stiffness::support::{Support, identify};
use crate::stiffness::unlabelled::Map;
use crate::stiffness::{maps, unlabelled};
use crate::types::Mask;
use crate::types::stiffness::{Evidence, Law, LeftOver, StiffnessParams};
use std::time::Instant;

/// Times that found regions are drawn anew at most.
const REDRAWN: usize = 3;
/// Surfaces that move less than this stay (voxels).
const STAYS: f64 = 0.2;
/// Part of the residual that drawing anew must take away for another time.
const WORTH: f64 = 0.005;

/// Regions and why these.
pub(super) struct Found {
    pub labels: Mask,
    pub evidence: Vec<Evidence>,
    /// What one region leaves over, where no second one was found.
    pub left_over: Option<LeftOver>,
    pub seconds: f64,
}

/// Regions with their mesh and moduli.
struct Candidate {
    labels: Mask,
    level: Level,
    estimate: Estimate,
}

/// What all candidates are made from.
struct Search<'a> {
    inputs: &'a Inputs<'a>,
    fineness: Fineness,
    law: Law,
    poisson: f64,
}

impl Search<'_> {
    fn level(&self, labels: &Mask) -> Result<Level, StiffnessError> {
        let mesh = mesh_labels(labels, &self.fineness)?;
        let i = self.inputs;
        Level::new(&mesh, i.field, i.matches, i.labels, i.held, i.load, None)
    }

    /// Identified from the state of another mesh, of which it takes the contact.
    fn candidate(&self, labels: Mask, from: (&Level, &State)) -> Result<Candidate, StiffnessError> {
        let mut level = self.level(&labels)?;
        level.contact_like(from.0)?;
        let estimate = identify(&level, self.law, self.poisson, from)?;
        Ok(Candidate { labels, level, estimate })
    }

    /// `count` regions of the map. Two that are alike are one class of moduli in two pieces: of all
    /// numbers of classes, the one that explains most.
    fn cut(&self, map: &Map, count: usize, from: (&Level, &State)) -> Result<Option<Candidate>, StiffnessError> {
        let mut best: Option<Candidate> = None;
        for classes in 2..=count {
            let Some(labels) = unlabelled::regions(map, self.inputs.labels, classes, count) else { continue };
            if best.as_ref().is_some_and(|b| b.labels.as_slice() == labels.as_slice()) {
                continue;
            }
            let next = self.candidate(labels, from)?;
            if best.as_ref().is_none_or(|b| next.estimate.rms < b.estimate.rms) {
                best = Some(next);
            }
        }
        Ok(best)
    }

    /// The regions of a candidate with their surfaces moved to where the data put them; none where
    /// they stay.
    fn redrawn(&self, old: &Candidate) -> Result<Option<Candidate>, StiffnessError> {
        let (inclusions, grid) = (Inclusion::all(&old.labels), old.labels.grid());
        if inclusions.is_empty() {
            return Ok(None);
        }
        let setup = old.level.setup(self.law, self.poisson, old.level.largest());
        let Some(fit) = geometry::fit(&setup, &old.estimate, grid, (&[], &inclusions))? else { return Ok(None) };
        if fit.shapes.iter().all(|offset| offset.abs() < STAYS) {
            return Ok(None);
        }
        let mut labels = old.labels.clone();
        for (inclusion, offsets) in inclusions.iter().zip(fit.shapes.chunks_exact(SHAPES)) {
            inclusion.draw(&mut labels, &std::array::from_fn(|k| offsets[k] * grid.least_spacing()));
        }
        self.candidate(labels, (&old.level, &old.estimate.state)).map(Some)
    }

    /// Drawn anew as long as it helps. What cannot be drawn or solved anew stays as the map has it.
    fn settled(&self, mut candidate: Candidate) -> Candidate {
        for _ in 0..REDRAWN {
            let Ok(Some(next)) = self.redrawn(&candidate) else { break };
            let gain = 1.0 - next.estimate.rms / candidate.estimate.rms;
            if gain > 0.0 {
                candidate = next;
            }
            if gain < WORTH {
                break;
            }
        }
        candidate
    }
}

/// One region, then two ... as long as each more is supported.
pub(super) fn regions(
    inputs: &Inputs<'_>,
    params: &StiffnessParams,
    progress: Progress<'_>,
) -> Result<Found, StiffnessError> {
    let started = Instant::now();
    progress("one region", 0.0);
    let fineness = coarse_fineness(inputs.labels, params);
    let mut search = Search { inputs, fineness, law: Law::Linear, poisson: params.poisson };
    let mut one = search.level(inputs.labels)?;
    one.settle_shape()?;
    let choice = choose(&mut one, params.model, params.poisson, 0)?;
    search.law = choice.law;
    let noise = maps::noise(inputs.field, inputs.labels);
    let mut support = Support::new(&one, &choice, noise);
    let mut found: Option<Mask> = None;
    if support.may_hold_more() && params.regions == 1 {
        support.none(2, "not tried: at most one region is asked for");
    } else if support.may_hold_more() {
        progress("map", 0.2);
        let setup = one.setup(choice.law, params.poisson, 0);
        let state = &choice.estimate.state;
        let map = unlabelled::map(&setup, state, support.target())?;
        for count in 2..=params.regions {
            progress("regions", 0.6 + 0.4 * count as f64 / (params.regions + 1) as f64);
            let Some(candidate) = search.cut(&map, count, (&one, state))? else {
                support.none(count, "not tried: the map does not fall into so many regions");
                break;
            };
            let candidate = search.settled(candidate);
            if !support.accept(&candidate.level, &candidate.estimate, count) {
                break;
            }
            found = Some(candidate.labels);
            if !support.may_hold_more() {
                break;
            }
        }
    }
    let left_over = if found.is_none() { support.left() } else { None };
    let labels = found.unwrap_or_else(|| inputs.labels.clone());
    Ok(Found { labels, evidence: support.evidence, left_over, seconds: started.elapsed().as_secs_f64() })
}
