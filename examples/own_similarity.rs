//! A similarity of one's own in place of correlation. The deformed volume is inverted, as T1 against
//! T2: there the correlation of the right pair is near -1, and its square alike for either contrast.
//!
//!     cargo run --release --example own_similarity

use palpate::consistency::energy::{EnergyParams, Graph};
use palpate::consistency::relaxation::relax;
use palpate::features::detect;
use palpate::matching::candidates::{CandidateParams, Similarity, paired};
use palpate::numerics::sampling::displacement;
use palpate::types::space::length;
use palpate::{FeaturePoint, PhantomKind, PhantomParams, Volume, phantom};

/// The squared correlation of patches of seven voxels.
struct SquaredCorrelation<'a>([&'a Volume; 2]);

impl SquaredCorrelation<'_> {
    fn correlation(&self, initial: &FeaturePoint, deformed: &FeaturePoint) -> f32 {
        let [a, b] = [(self.0[0], initial), (self.0[1], deformed)].map(|(volume, feature)| {
            let centre = feature.voxel.0.map(|v| v.round() as usize);
            let around = |n: usize| (0..343).map(move |i| i / 7usize.pow(n as u32) % 7);
            let place = |(d, (e, f))| volume.grid().index(centre[0] + d - 3, centre[1] + e - 3, centre[2] + f - 3);
            let values = around(0).zip(around(1).zip(around(2))).map(|d| volume.as_slice()[place(d)]);
            let mean = values.clone().sum::<f32>() / 343.0;
            values.map(|v| v - mean).collect::<Vec<f32>>()
        });
        let sum = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f32>();
        sum(&a, &b) / (sum(&a, &a) * sum(&b, &b)).sqrt().max(f32::MIN_POSITIVE)
    }
}

impl Similarity for SquaredCorrelation<'_> {
    fn between(&self, initial: &FeaturePoint, deformed: &FeaturePoint) -> f32 {
        self.correlation(initial, deformed).powi(2)
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut pair = phantom(&PhantomParams::new(PhantomKind::Block).sized(48))?;
    pair.deformed.as_mut_slice().iter_mut().for_each(|v| *v = -*v);
    let grid = *pair.initial.grid();
    let inner = |f: &FeaturePoint| f.voxel.0.iter().zip(grid.shape()).all(|(v, n)| (3.0..n as f64 - 4.0).contains(v));
    let [mut here, mut there] = [detect(&pair.initial, Some(&pair.mask), 500)?, detect(&pair.deformed, None, 2_000)?];
    here.retain(inner);
    there.retain(inner);
    let places: Vec<[f64; 3]> = here.iter().map(|f| f.world.0).collect();
    let graph = Graph::new(&places, EnergyParams::new(2.0 * grid.least_spacing()));
    let own = SquaredCorrelation([&pair.initial, &pair.deformed]);
    // A closure is a similarity too.
    let signed = |a: &FeaturePoint, b: &FeaturePoint| own.correlation(a, b);
    let all = CandidateParams::within(6.0);
    let lists = [paired(&grid, [&here, &there], all, &signed), paired(&grid, [&here, &there], all, &own)];
    for (name, candidates) in ["correlation", "own"].into_iter().zip(lists) {
        let chosen = relax(&graph, &candidates).chosen;
        let error = |(i, feature): (usize, &FeaturePoint)| {
            let found = grid.vector_to_world(candidates[i].get(chosen[i])?.displacement);
            let truth = displacement(&pair.truth, feature.world);
            Some(length(std::array::from_fn(|a| found[a] - truth[a])))
        };
        let errors: Vec<f64> = here.iter().enumerate().filter_map(error).collect();
        let right = errors.iter().filter(|e| **e < 1.5).count();
        println!("{name:>12}: {right} right of {} matches, {} features", errors.len(), here.len());
    }
    Ok(())
}
