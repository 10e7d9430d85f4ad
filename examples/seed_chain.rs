//! The source's own chain, step by step against the library: 3D Harris features, many-to-many
//! candidates by correlation, energy-based consistency, sparse displacements, a Delaunay mesh and
//! the dense field on it.
//!
//!     cargo run --release --example seed_chain
//!
//! Its matches are true to a voxel. `seed.rs` runs the finished form, coarse to fine and with
//! sub-voxel matching.

use palpate::consistency::energy::{EnergyParams, Graph};
use palpate::consistency::relaxation::relax;
use palpate::evaluate;
use palpate::features::detect;
use palpate::field::interpolation::{Interpolated, interpolate_tetrahedra};
use palpate::matching::candidates::{CandidateParams, between};
use palpate::mesh::delaunay3::delaunay3;
use palpate::{Mask, PhantomKind, PhantomParams, Volume, WorldPoint, phantom};
use std::error::Error;

/// Features wanted in the initial and in the deformed volume.
const WANTED: [usize; 2] = [1_000, 5_000];

/// Largest displacement that is sought (mm).
const REACH_MM: f64 = 8.0;

/// Least probability of a choice that is kept.
const SURE: f64 = 0.5;

/// The displacement of the tissue inside the mesh of the matches (mm, RAS).
pub fn chain(initial: &Volume, deformed: &Volume, mask: &Mask) -> Result<Interpolated, Box<dyn Error>> {
    let grid = initial.grid();
    let here = detect(initial, Some(mask), WANTED[0])?;
    let there = detect(deformed, None, WANTED[1])?;
    let candidates = between(initial, deformed, [&here, &there], CandidateParams::within(REACH_MM))?;

    // Of each feature's candidates the one that its neighbours agree with.
    let places: Vec<[f64; 3]> = here.iter().map(|f| f.world.0).collect();
    let graph = Graph::new(&places, EnergyParams::new(grid.least_spacing()));
    let relaxed = relax(&graph, &candidates);
    let mut matches: Vec<(WorldPoint, [f64; 3])> = Vec::new();
    for (i, feature) in here.iter().enumerate().filter(|(i, _)| relaxed.confidence[*i] > SURE) {
        let chosen = candidates[i][relaxed.chosen[i]];
        // Candidates run along the grid's axes, fields are in world mm.
        matches.push((feature.world, grid.vector_to_world(chosen.displacement)));
    }

    let places: Vec<WorldPoint> = matches.iter().map(|m| m.0).collect();
    let delaunay = delaunay3(&places)?;
    let at_nodes: Vec<[f64; 3]> = delaunay.source.iter().map(|&i| matches[i as usize].1).collect();
    Ok(interpolate_tetrahedra(&delaunay.mesh, &at_nodes, grid)?)
}

fn main() -> Result<(), Box<dyn Error>> {
    let pair = phantom(&PhantomParams { amplitude: 6.0, ..PhantomParams::new(PhantomKind::Block) })?;
    let found = chain(&pair.initial, &pair.deformed, &pair.mask)?;
    let metrics = evaluate::metrics(&found.displacement, &pair.truth, Some(&found.inside), &[])?;
    println!("{} voxels in the mesh", metrics.voxels);
    println!("mean error {:.3} mm of a motion of {:.3} mm", metrics.mean_mm, metrics.identity_mm);
    Ok(())
}
