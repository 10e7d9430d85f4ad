//! Regions without labels: a map of the modulus, cut into as many regions as the data support.

use crate::error::StiffnessError;
use crate::mesh::tetrahedral::{Fineness, mesh_labels};
use crate::pipeline::body_meshes::coarse_fineness;
use crate::pipeline::stiffness::{Inputs, Progress};
use crate::stiffness::geometry;
use crate::stiffness::identify::{Estimate, State};
use crate::stiffness::inclusion::{Inclusion, SHAPE_FUNCTIONS};
use crate::stiffness::interface::Interface;
use crate::stiffness::mesh_problem::Level;
use crate::stiffness::model_selection::choose;
use crate::stiffness::support::{Support, identify};
use crate::stiffness::unlabelled;
use crate::types::stiffness::{Detectable, Evidence, Law, LeftOver, StiffnessParams};
use crate::types::{Grid, Mask};
use rayon::prelude::*;
use std::time::Instant;

/// Iterated redrawing of regions found without labels.
struct RedrawControl {
    /// Most redraws.
    max_count: usize,
    /// Surfaces that move less than this stay (voxels).
    min_move_voxels: f64,
    /// Relative reduction of the residual, below which no further redraw follows.
    min_residual_gain: f64,
}

const REDRAW: RedrawControl = RedrawControl { max_count: 5, min_move_voxels: 0.2, min_residual_gain: 0.002 };

/// Regions and why these.
pub(super) struct Found {
    pub labels: Mask,
    pub evidence: Vec<Evidence>,
    /// What one region leaves over, where no second one was found.
    pub left_over: Option<LeftOver>,
    /// Which balls would have been seen.
    pub detectable: Vec<Detectable>,
    pub seconds: f64,
}

/// Regions with their mesh and moduli.
struct Candidate {
    labels: Mask,
    level: Level,
    estimate: Estimate,
}

impl Candidate {
    /// What the model leaves over (mm, root mean square of one component) with the surface of the
    /// body where the data put it.
    fn shaped_rms(&self, search: &Search<'_>, grid: &Grid) -> Result<f64, StiffnessError> {
        let setup = self.level.setup(search.law, search.params, self.level.largest());
        let walls = Interface::walls(&self.labels);
        let shaped = geometry::fit(&setup, &self.estimate, grid, &walls, &[])?;
        Ok(shaped.map_or(self.estimate.rms, |g| g.fit.rms.min(self.estimate.rms)))
    }
}

/// What all candidates are made from.
struct Search<'a> {
    inputs: &'a Inputs<'a>,
    fineness: Fineness,
    law: Law,
    params: &'a StiffnessParams,
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
        let estimate = identify(&level, self.law, self.params, from)?;
        Ok(Candidate { labels, level, estimate })
    }

    /// The regions of a candidate with their surfaces moved to where the data put them; none where
    /// they stay.
    fn redrawn(&self, old: &Candidate) -> Result<Option<Candidate>, StiffnessError> {
        let (inclusions, grid) = (Inclusion::all(&old.labels), old.labels.grid());
        if inclusions.is_empty() {
            return Ok(None);
        }
        let setup = old.level.setup(self.law, self.params, old.level.largest());
        let Some(fit) = geometry::fit(&setup, &old.estimate, grid, &[], &inclusions)? else { return Ok(None) };
        if fit.shapes.iter().all(|offset| offset.abs() < REDRAW.min_move_voxels) {
            return Ok(None);
        }
        let mut labels = old.labels.clone();
        for (inclusion, offsets) in inclusions.iter().zip(fit.shapes.chunks_exact(SHAPE_FUNCTIONS)) {
            inclusion.draw(&mut labels, &std::array::from_fn(|k| offsets[k] * grid.least_spacing()));
        }
        self.candidate(labels, (&old.level, &old.estimate.state)).map(Some)
    }

    /// From which contrast on balls would be seen. The strain in a ball of contrast C is 5 / (2 C +
    /// 3) of that around it (Eshelby 1957, incompressible), so that it disturbs the displacement by
    /// 5 (C - 1) / (2 C + 3) of what a unit of ln C does at C = 1.
    fn detectable(&self, one: &Candidate, support: &Support) -> Result<Vec<Detectable>, StiffnessError> {
        let setup = one.level.setup(self.law, self.params, one.level.largest());
        let least = support.least_seen();
        let limit = |(diameter_mm, moved): (f64, f64)| {
            let d = least / moved.max(f64::MIN_POSITIVE);
            Detectable {
                diameter_mm,
                stiffer: (d < 2.5).then(|| (5.0 + 3.0 * d) / (5.0 - 2.0 * d)),
                softer: (d < 5.0 / 3.0).then(|| (5.0 - 3.0 * d) / (5.0 + 2.0 * d)),
            }
        };
        Ok(unlabelled::shown_by_balls(&setup, &one.estimate.state)?.into_iter().map(limit).collect())
    }

    /// Drawn anew as long as it helps. What cannot be drawn or solved anew stays as the map has it.
    fn settled(&self, mut candidate: Candidate) -> Candidate {
        for _ in 0..REDRAW.max_count {
            let Ok(Some(next)) = self.redrawn(&candidate) else { break };
            let gain = 1.0 - next.estimate.rms / candidate.estimate.rms;
            if gain > 0.0 {
                candidate = next;
            }
            if gain < REDRAW.min_residual_gain {
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
    let mut search = Search { inputs, fineness, law: Law::Linear, params };
    let mut one = search.level(inputs.labels)?;
    one.settle_shape()?;
    let choice = choose(&mut one, params, 0)?;
    search.law = choice.law;
    let grid = inputs.labels.grid();
    let mut best = Candidate { labels: inputs.labels.clone(), level: one, estimate: choice.estimate };
    let mut support = Support::new(&best.level, &best.estimate, best.shaped_rms(&search, grid)?);
    let detectable = search.detectable(&best, &support)?;
    let mut count = 1;
    while support.may_hold_more() {
        if count == params.regions {
            if count == 1 {
                support.none(2, "not tried: at most one region is asked for");
            }
            break;
        }
        progress("map", 0.2 + 0.8 * (count - 1) as f64 / params.regions as f64);
        let setup = best.level.setup(search.law, params, best.level.largest());
        let map = unlabelled::map(&setup, &best.estimate.state, support.target())?;
        let from = (&best.level, &best.estimate.state);
        let tried = unlabelled::next_regions(&map, &best.labels).into_par_iter();
        let tried: Vec<Candidate> = tried.filter_map(|labels| search.candidate(labels, from).ok()).collect();
        let Some(next) = tried.into_iter().min_by(|a, b| a.estimate.rms.total_cmp(&b.estimate.rms)) else {
            support.none(count + 1, "not tried: no piece of the map stands out");
            break;
        };
        let next = search.settled(next);
        if !support.accept(&next.level, &next.estimate, count + 1, next.shaped_rms(&search, grid)?) {
            break;
        }
        (best, count) = (next, count + 1);
    }
    let left_over = if count == 1 { support.left() } else { None };
    let seconds = started.elapsed().as_secs_f64();
    Ok(Found { labels: best.labels, evidence: support.evidence, left_over, detectable, seconds })
}
