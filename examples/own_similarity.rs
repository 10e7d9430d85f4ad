//! A similarity of one's own in place of correlation: pairs of features are scored by a closure.
//!
//!     cargo run --release --example own_similarity
//!
//! The deformed volume is shown in a contrast that is the other way round, as T1 against T2. There
//! the correlation of the right pair is near -1; its square is alike for either contrast.

use palpate::consistency::energy::{EnergyParams, Graph};
use palpate::consistency::relaxation::relax;
use palpate::features::detect;
use palpate::matching::candidates::{CandidateParams, paired};
use palpate::numerics::sampling::displacement;
use palpate::types::space::length;
use palpate::{FeaturePoint, PhantomKind, PhantomParams, Volume, phantom};
use std::error::Error;

/// Voxels between the middle of a patch and its faces.
const RADIUS: i64 = 3;

/// The patch about a feature, less its mean and of unit length; zeros past the volume's border.
fn patch(volume: &Volume, feature: &FeaturePoint) -> Vec<f32> {
    let (grid, centre) = (volume.grid(), feature.voxel.0.map(|v| v.round() as i64));
    let around = || -RADIUS..=RADIUS;
    let offsets = around().flat_map(|k| around().flat_map(move |j| around().map(move |i| [i, j, k])));
    let value = |d: [i64; 3]| {
        let at: [i64; 3] = std::array::from_fn(|a| centre[a] + d[a]);
        let within = (0..3).all(|a| (0..grid.shape()[a] as i64).contains(&at[a]));
        if within { volume.as_slice()[grid.index(at[0] as usize, at[1] as usize, at[2] as usize)] } else { 0.0 }
    };
    let mut values: Vec<f32> = offsets.map(value).collect();
    let mean = values.iter().sum::<f32>() / values.len() as f32;
    values.iter_mut().for_each(|v| *v -= mean);
    let norm = values.iter().map(|v| v * v).sum::<f32>().sqrt().max(f32::MIN_POSITIVE);
    values.iter_mut().for_each(|v| *v /= norm);
    values
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut pair = phantom(&PhantomParams::new(PhantomKind::Block).sized(48))?;
    let brightest = pair.deformed.as_slice().iter().copied().fold(0.0, f32::max);
    pair.deformed.as_mut_slice().iter_mut().for_each(|v| *v = brightest - *v);

    let grid = *pair.initial.grid();
    let here = detect(&pair.initial, Some(&pair.mask), 500)?;
    let there = detect(&pair.deformed, None, 2_000)?;
    let correlation = |a: &FeaturePoint, b: &FeaturePoint| -> f32 {
        patch(&pair.initial, a).iter().zip(patch(&pair.deformed, b)).map(|(x, y)| x * y).sum()
    };
    let own = |a: &FeaturePoint, b: &FeaturePoint| correlation(a, b).powi(2);

    let places: Vec<[f64; 3]> = here.iter().map(|f| f.world.0).collect();
    let graph = Graph::new(&places, EnergyParams::new(2.0 * grid.least_spacing()));
    let right = |similarity: &(dyn Fn(&FeaturePoint, &FeaturePoint) -> f32 + Sync)| {
        let candidates = paired(&grid, [&here, &there], CandidateParams::within(6.0), similarity);
        let chosen = relax(&graph, &candidates).chosen;
        let near = |(i, feature): (usize, &FeaturePoint)| {
            let candidate = candidates[i].get(chosen[i])?;
            let (u, truth) = (grid.vector_to_world(candidate.displacement), displacement(&pair.truth, feature.world));
            Some(length(std::array::from_fn(|a| u[a] - truth[a])) < 1.5)
        };
        let judged: Vec<bool> = here.iter().enumerate().filter_map(near).collect();
        (judged.iter().filter(|r| **r).count(), judged.len())
    };
    for (name, (count, matched)) in [("correlation", right(&correlation)), ("own", right(&own))] {
        println!("{name:>12}: {count} right of {matched} matches, {} features", here.len());
    }
    Ok(())
}
