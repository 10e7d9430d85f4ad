//! Moving vertices to the middle of their neighbours where that improves the worst shape around
//! them.

use super::cutting::{Cut, distance, volume};

/// Passes over all inner vertices: more changed the worst angle by under half a degree.
const SMOOTHING_PASSES: usize = 4;

/// Shape of a tetrahedron, 1 for a regular one, 0 for a flat one: volume over the cube of the root
/// mean square edge.
pub(super) fn shape(p: [[f64; 3]; 4]) -> f64 {
    let mut square = 0.0;
    for i in 0..4 {
        for j in 0..i {
            square += distance(p[i], p[j]).powi(2);
        }
    }
    6.0 * std::f64::consts::SQRT_2 * volume(p) / (square / 6.0).powf(1.5)
}

/// Moves vertices on no surface towards their neighbours' mean, where the worst shape around gets
/// better.
pub fn smooth(cut: &mut Cut) {
    let mut around: Vec<Vec<u32>> = vec![Vec::new(); cut.places.len()];
    for (e, c) in cut.cells.iter().enumerate() {
        c.iter().for_each(|&v| around[v as usize].push(e as u32));
    }
    for _ in 0..SMOOTHING_PASSES {
        for v in 0..cut.places.len() {
            if cut.surfaces[v] != 0 {
                continue;
            }
            let worst = |cut: &Cut| {
                let one = |&e: &u32| shape(cut.cells[e as usize].map(|n| cut.places[n as usize]));
                around[v].iter().map(one).fold(f64::INFINITY, f64::min)
            };
            let mut near: Vec<u32> = around[v].iter().flat_map(|&e| cut.cells[e as usize]).collect();
            near.sort_unstable();
            near.dedup();
            near.retain(|&n| n as usize != v);
            let mean = |a: usize| near.iter().map(|&n| cut.places[n as usize][a]).sum::<f64>() / near.len() as f64;
            let (old, mean) = (cut.places[v], [mean(0), mean(1), mean(2)]);
            let before = worst(cut);
            for part in [1.0, 0.5] {
                cut.places[v] = std::array::from_fn(|a| old[a] + part * (mean[a] - old[a]));
                if worst(cut) > before {
                    break;
                }
                cut.places[v] = old;
            }
        }
    }
}
