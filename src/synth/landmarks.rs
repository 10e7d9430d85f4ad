//! Places where an expert would put a mark: inside the tissue, with contrast, well apart.

use crate::numerics::differences::gradient;
use crate::numerics::random::Random;
use crate::numerics::statistics::percentile;
use crate::types::{Landmark, Mask, Volume, VoxelPoint, WorldPoint};

/// Up to `wanted` random places between voxel centres, two voxels inside `mask`, where the gradient
/// of `clean` is among its upper 40 %, and four times the shortest voxel edge apart; each with its
/// place after the motion that `displacements` gives (mm).
pub fn landmarks(
    clean: &Volume,
    mask: &Mask,
    wanted: usize,
    mut random: Random,
    displacements: impl FnOnce(&[WorldPoint]) -> Vec<[f64; 3]>,
) -> Vec<Landmark> {
    let grid = *clean.grid();
    let slope = |at: usize| gradient(clean.as_slice(), &grid, grid.voxel(at)).iter().map(|g| g * g).sum::<f64>();
    let inside: Vec<(usize, f64)> =
        (0..grid.len()).filter(|&at| mask.as_slice()[at] != 0).map(|at| (at, slope(at))).collect();
    let threshold = percentile(&mut inside.iter().map(|v| v.1).collect::<Vec<_>>(), 60.0);
    let mut candidates: Vec<usize> =
        inside.into_iter().filter(|&(at, s)| s > threshold && deep(mask, at)).map(|v| v.0).collect();
    let apart = 4.0 * grid.spacing().iter().fold(f64::INFINITY, |m, &s| m.min(s));
    let mut found: Vec<WorldPoint> = Vec::new();
    while found.len() < wanted && !candidates.is_empty() {
        let pick = (random.bits() % candidates.len() as u64) as usize;
        let voxel = grid.voxel(candidates.swap_remove(pick));
        let place = std::array::from_fn(|a| {
            let shift = if grid.shape()[a] == 1 { 0.0 } else { random.uniform(-0.5, 0.5) };
            voxel[a] as f64 + shift
        });
        let p = grid.affine().to_world(VoxelPoint(place));
        if found.iter().all(|q| p.minus(*q).iter().map(|d| d * d).sum::<f64>() >= apart * apart) {
            found.push(p);
        }
    }
    let moved = displacements(&found);
    found.into_iter().zip(moved).map(|(p, u)| Landmark { initial: p, deformed: p.moved(u) }).collect()
}

/// Whether the mask goes on for two voxels each way along every axis of more than one voxel.
fn deep(mask: &Mask, at: usize) -> bool {
    let shape = mask.grid().shape();
    let (voxel, strides) = (mask.grid().voxel(at), [1, shape[0], shape[0] * shape[1]]);
    (0..3).filter(|&a| shape[a] > 1).all(|a| {
        let clear = voxel[a] >= 2 && voxel[a] + 2 < shape[a];
        clear && (1..=2).all(|n| mask.as_slice()[at - n * strides[a]] != 0 && mask.as_slice()[at + n * strides[a]] != 0)
    })
}
