//! Regions without labels: a map of the modulus, cut into as many regions as the data support.

use crate::error::StiffnessError;
use crate::mesh::tetrahedral::mesh_labels;
use crate::pipeline::stiffness::{Inputs, Progress, coarse_fineness};
use crate::stiffness::choice::choose;
use crate::stiffness::geometry;
use crate::stiffness::identify::Estimate;
use crate::stiffness::inclusion::{Inclusion, SHAPES};
use crate::stiffness::level::Level;
use crate::stiffness::support::{Support, identify};
use crate::stiffness::{maps, unlabelled};
use crate::types::Mask;
use crate::types::stiffness::{Evidence, Law, StiffnessParams};
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
    pub seconds: f64,
}

/// The regions of `labels` with their surfaces moved to where the data put them; none where they stay.
fn redrawn(
    labels: &Mask,
    level: &Level,
    estimate: &Estimate,
    law: Law,
    poisson: f64,
) -> Result<Option<Mask>, StiffnessError> {
    let (inclusions, grid) = (Inclusion::all(labels), labels.grid());
    if inclusions.is_empty() {
        return Ok(None);
    }
    let setup = level.setup(law, poisson, level.largest());
    let Some(fit) = geometry::fit(&setup, estimate, grid, (&[], &inclusions))? else { return Ok(None) };
    if fit.shapes.iter().all(|offset| offset.abs() < STAYS) {
        return Ok(None);
    }
    let mut out = labels.clone();
    for (inclusion, offsets) in inclusions.iter().zip(fit.shapes.chunks_exact(SHAPES)) {
        inclusion.draw(&mut out, &std::array::from_fn(|k| offsets[k] * grid.least_spacing()));
    }
    Ok(Some(out))
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
    let level = |labels: &Mask| {
        let mesh = mesh_labels(labels, &fineness)?;
        Level::new(&mesh, inputs.field, inputs.matches, inputs.labels, inputs.held, inputs.load, None)
    };
    let mut one = level(inputs.labels)?;
    let choice = choose(&mut one, params.model, params.poisson, 0)?;
    let noise = maps::noise(inputs.field, inputs.labels);
    let mut support = Support::new(&one, &choice, noise);
    let mut labels = inputs.labels.clone();
    if support.may_hold_more() && params.regions == 1 {
        support.none(2, "not tried: at most one region is asked for");
    } else if support.may_hold_more() {
        progress("map", 0.2);
        let setup = one.setup(choice.law, params.poisson, 0);
        let map = unlabelled::map(&setup, &choice.estimate.state, support.target())?;
        for count in 2..=params.regions {
            progress("regions", 0.6 + 0.4 * count as f64 / (params.regions + 1) as f64);
            let Some(mut candidate) = unlabelled::regions(&map, inputs.labels, count) else {
                support.none(count, "the map does not fall into so many regions");
                break;
            };
            let mut more = level(&candidate)?;
            more.contact_like(&one);
            let mut estimate = identify(&more, choice.law, params.poisson, (&one, &choice.estimate.state))?;
            for _ in 0..REDRAWN {
                let again = || {
                    let Some(drawn) = redrawn(&candidate, &more, &estimate, choice.law, params.poisson)? else {
                        return Ok(None);
                    };
                    let mut next = level(&drawn)?;
                    next.contact_like(&one);
                    let better = identify(&next, choice.law, params.poisson, (&more, &estimate.state))?;
                    Ok::<_, StiffnessError>(Some((drawn, next, better)))
                };
                // What cannot be drawn or solved anew stays as the map has it.
                let Ok(Some((drawn, next, better))) = again() else { break };
                let gain = 1.0 - better.rms / estimate.rms;
                if gain > 0.0 {
                    (candidate, more, estimate) = (drawn, next, better);
                }
                if gain < WORTH {
                    break;
                }
            }
            if !support.accept(&more, &estimate, count) {
                break;
            }
            labels = candidate;
            if !support.may_hold_more() {
                break;
            }
        }
    }
    Ok(Found { labels, evidence: support.evidence, seconds: started.elapsed().as_secs_f64() })
}
