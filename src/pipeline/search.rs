//! Regions without labels: a map of the modulus, cut into as many regions as the data support.

use crate::error::StiffnessError;
use crate::mesh::tetrahedral::{Fineness, mesh_labels};
use crate::numerics::statistics::noise_sigma;
use crate::pipeline::stiffness::{COARSE, Inputs, Progress};
use crate::stiffness::choice::choose;
use crate::stiffness::level::Level;
use crate::stiffness::support::{Support, identify};
use crate::stiffness::{maps, unlabelled};
use crate::types::Mask;
use crate::types::stiffness::{Evidence, StiffnessParams};
use std::time::Instant;

/// Regions and why these.
pub(super) struct Found {
    pub labels: Mask,
    pub evidence: Vec<Evidence>,
    pub seconds: f64,
}

/// One region, then two ... as long as each more is supported.
pub(super) fn regions(
    inputs: &Inputs<'_>,
    params: &StiffnessParams,
    progress: Progress<'_>,
) -> Result<Found, StiffnessError> {
    let started = Instant::now();
    progress("one region", 0.0);
    let fineness = Fineness::for_nodes(maps::volume(inputs.labels), (COARSE * params.nodes as f64) as usize);
    let level = |labels: &Mask| {
        let mesh = mesh_labels(labels, &fineness)?;
        Level::new(&mesh, inputs.field, inputs.matches, inputs.labels, inputs.held, inputs.load, None)
    };
    let mut one = level(inputs.labels)?;
    let choice = choose(&mut one, params.model, params.poisson, 0)?;
    let noise = maps::noise(inputs.field, inputs.labels, |d, s, k| f64::from(noise_sigma(d, s, k)));
    let mut support = Support::new(&one, &choice, noise);
    let mut labels = inputs.labels.clone();
    if support.may_hold_more() {
        progress("map", 0.2);
        let setup = one.setup(choice.law, params.poisson, 0);
        let map = unlabelled::map(&setup, &choice.estimate.state, support.target())?;
        for count in 2..=params.regions {
            progress("regions", 0.6 + 0.4 * count as f64 / (params.regions + 1) as f64);
            let Some(candidate) = unlabelled::regions(&map, inputs.labels, count) else {
                support.none(count);
                break;
            };
            let mut more = level(&candidate)?;
            more.contact_like(&one);
            let estimate = identify(&more, choice.law, params.poisson)?;
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
