//! Matches of one's own: a mesh through them, the dense field on it, and its strain.
//!
//!     cargo run --release --example own_matches -- [VOLUME LANDMARKS]
//!
//! LANDMARKS is a table of places that are known in both volumes (see docs/reference), VOLUME gives
//! the grid. Without files the landmarks of a synthetic block are taken.

use palpate::field::interpolation::interpolate_tetrahedra;
use palpate::field::jacobian::count_folds;
use palpate::mesh::delaunay3::delaunay3;
use palpate::pipeline::strain;
use palpate::{DenseField, Grid, Landmark, PhantomKind, PhantomParams, StrainInput, StrainParams, WorldPoint};
use palpate::{evaluate, io, phantom};
use std::error::Error;

fn main() -> Result<(), Box<dyn Error>> {
    let files: Vec<String> = std::env::args().skip(1).collect();
    let (grid, matches, truth): (Grid, Vec<Landmark>, Option<DenseField>) = match &files[..] {
        [volume, landmarks] => (*io::read_volume(volume)?.grid(), io::read_landmarks(landmarks)?, None),
        [] => {
            let block = phantom(&PhantomParams::new(PhantomKind::Block).sized(48))?;
            (*block.initial.grid(), block.landmarks, Some(block.truth))
        }
        _ => return Err("give VOLUME and LANDMARKS, or nothing".into()),
    };

    // Places and displacements are in world mm, whatever the grid.
    let places: Vec<WorldPoint> = matches.iter().map(|m| m.initial).collect();
    let delaunay = delaunay3(&places)?;
    let of_node = |&match_number: &u32| {
        let m = matches[match_number as usize];
        m.deformed.minus(m.initial)
    };
    let at_nodes: Vec<[f64; 3]> = delaunay.source.iter().map(of_node).collect();
    let found = interpolate_tetrahedra(&delaunay.mesh, &at_nodes, &grid)?;
    println!("{} matches, {} tetrahedra", matches.len(), delaunay.mesh.tetrahedra().len());
    println!("{} folds in the mesh", count_folds(&found.displacement, Some(&found.inside))?);
    if let Some(truth) = truth {
        let m = evaluate::metrics(&found.displacement, &truth, Some(&found.inside), &[])?;
        println!("mean error {:.3} mm of a motion of {:.3} mm", m.mean_mm, m.identity_mm);
    }

    let input =
        StrainInput { field: &found.displacement, bodies: &found.inside, labels: None, samples: None, trust: None };
    let strain = strain::run(input, &StrainParams::default(), &|_, _| {})?.strain;
    let inside = (0..grid.len()).filter(|&o| found.inside.as_slice()[o] != 0);
    let largest = inside.map(|o| strain.principal(o)[0]).fold(f64::NEG_INFINITY, f64::max);
    println!("largest principal strain {largest:.3}");
    Ok(())
}
