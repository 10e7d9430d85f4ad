//! The rim of a flat punch on the surface around it: where the mesh must be fine.
//!
//! Under the edge of a punch strain has a singularity, and what is near it (a thin skin) hangs on where that edge is. So it is
//! looked for among the surface voxels: those that moved with the plate next to those that did not.

use crate::stiffness::observations::at_surface;
use crate::stiffness::patches::Patch;
use crate::types::space::dot;
use crate::types::{Displacement, Mask, VoxelPoint};
use rayon::prelude::*;

/// Voxels on both sides of the rim, and below it, where the mesh is fine.
const AROUND: i32 = 1;
/// Columns of a patch beside a punch at least.
const WIDE: usize = 25;

/// Places (grid mm: voxel index times spacing) around the rim of `patch`; empty for a patch on a curved surface, and where the
/// whole side is pressed.
///
/// A voxel's motion is read from those within `reach` (voxels), and is that of the plate within `tolerance` (mm).
pub fn rim(patch: &Patch, field: &Displacement<'_>, labels: &Mask, tolerance: f64, reach: f64) -> Vec<[f64; 3]> {
    if patch.curved() {
        return Vec::new();
    }
    let grid = labels.grid();
    let (shape, spacing, inside) = (grid.shape(), grid.spacing(), labels.as_slice());
    // The voxel axis nearest to the normal, and the way out along it.
    let out: [f64; 3] = std::array::from_fn(|a| {
        let [p, q] = [[0.0; 3], std::array::from_fn(|b| if a == b { 1.0 / spacing[a] } else { 0.0 })]
            .map(|v| grid.affine().to_world(VoxelPoint(v)).0);
        (0..3).map(|b| (q[b] - p[b]) * patch.normal[b]).sum()
    });
    let axis = (0..3).fold(0, |m, a| if out[a].abs() > out[m].abs() { a } else { m });
    let up = out[axis] > 0.0;
    let [u, v] = [(axis + 1) % 3, (axis + 2) % 3];
    let index = |a: usize, i: usize, j: usize| {
        let mut at = [0; 3];
        (at[axis], at[u], at[v]) = (a, i, j);
        at
    };
    let width = shape[u];
    // For each column the outermost voxel of the body, and by how much it moved otherwise than the plate (mm).
    let column = |c: usize| {
        let (i, j) = (c % width, c / width);
        let mut all = 0..shape[axis];
        let tissue = |a: &usize| {
            let [x, y, z] = index(*a, i, j);
            inside[grid.index(x, y, z)] > 0
        };
        let top = if up { all.rev().find(tissue) } else { all.find(tissue) }?;
        let at = index(top, i, j);
        let place = grid.world(at[0], at[1], at[2]).0;
        let (moved, _) = at_surface(field, labels, place, reach)?;
        let plate = patch.motion(place);
        let short: f64 = dot(std::array::from_fn(|a| moved[a] - plate[a]), patch.normal);
        Some((top, short.abs()))
    };
    let short: Vec<Option<(usize, f64)>> = (0..width * shape[v]).into_par_iter().map(column).collect();
    let columns: Vec<Option<(usize, bool)>> = (0..short.len()).map(|c| voted(&short, c, width, tolerance)).collect();
    let beside = clear_of(&columns, &short, width, tolerance);
    let mut found = Vec::new();
    for (c, here) in columns.iter().enumerate() {
        let Some((top, true)) = *here else { continue };
        let (i, j) = ((c % width) as i32, (c / width) as i32);
        let next = |n: usize| columns[n].is_some_and(|(other, _)| beside[n] && other.abs_diff(top) < 3);
        if !around(c, columns.len(), width, 1).any(next) {
            continue;
        }
        for (di, dj) in (-AROUND..=AROUND).flat_map(|di| (-AROUND..=AROUND).map(move |dj| (di, dj))) {
            for down in 0..=AROUND {
                let mut at = [0.0; 3];
                at[axis] = top as f64 + f64::from(if up { -down } else { down });
                (at[u], at[v]) = (f64::from(i + di), f64::from(j + dj));
                found.push(std::array::from_fn(|a| at[a] * spacing[a]));
            }
        }
    }
    found
}

/// Columns within `reach` along both axes, with the one itself.
fn around(c: usize, all: usize, width: usize, reach: i32) -> impl Iterator<Item = usize> {
    let (i, j) = ((c % width) as i32, (c / width) as i32);
    let (wide, high) = (width as i32, (all / width) as i32);
    let steps = (-reach..=reach).flat_map(move |di| (-reach..=reach).map(move |dj| (i + di, j + dj)));
    steps
        .filter(move |(i, j)| (0..wide).contains(i) && (0..high).contains(j))
        .map(move |(i, j)| (i + wide * j) as usize)
}

/// Whether a column moved with the plate, as most of the 25 around it say: noise makes no rim.
fn voted(short: &[Option<(usize, f64)>], c: usize, width: usize, tolerance: f64) -> Option<(usize, bool)> {
    let (top, _) = short[c]?;
    let (mut with, mut all) = (0, 0);
    for (_, short) in around(c, short.len(), width, 2).filter_map(|n| short[n]) {
        with += u32::from(short < tolerance);
        all += 1;
    }
    Some((top, 2 * with > all))
}

/// Columns that a punch leaves free: in patches that are wide and stay well behind it. A corner that is badly read, or noise
/// that hangs together, is neither.
fn clear_of(
    columns: &[Option<(usize, bool)>],
    short: &[Option<(usize, f64)>],
    width: usize,
    tolerance: f64,
) -> Vec<bool> {
    let mut clear = vec![false; columns.len()];
    let mut seen = vec![false; columns.len()];
    let free = |c: usize| columns[c].is_some_and(|(_, with)| !with);
    for first in 0..columns.len() {
        if seen[first] || !free(first) {
            continue;
        }
        let mut patch = vec![first];
        seen[first] = true;
        for at in 0.. {
            let Some(&c) = patch.get(at) else { break };
            for n in around(c, columns.len(), width, 1) {
                if free(n) && !std::mem::replace(&mut seen[n], true) {
                    patch.push(n);
                }
            }
        }
        let mean = patch.iter().filter_map(|&c| short[c]).map(|s| s.1).sum::<f64>() / patch.len() as f64;
        if patch.len() >= WIDE && mean > 2.0 * tolerance {
            patch.iter().for_each(|&c| clear[c] = true);
        }
    }
    clear
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What is clear of the punch on a face of 20 by 20 columns.
    fn clear(short: impl Fn(usize, usize) -> f64) -> usize {
        let width = 20;
        let short: Vec<_> = (0..400).map(|c| Some((9, short(c % width, c / width)))).collect();
        let columns: Vec<_> = (0..400).map(|c| voted(&short, c, width, 0.075)).collect();
        clear_of(&columns, &short, width, 0.075).iter().filter(|c| **c).count()
    }

    #[test]
    fn a_badly_read_corner_is_no_rim() {
        assert_eq!(clear(|i, j| if i < 3 && j < 3 { 0.5 } else { 0.0 }), 0);
    }

    #[test]
    fn noise_that_hangs_together_is_no_rim() {
        assert_eq!(clear(|i, _| if i < 8 { 0.09 } else { 0.01 }), 0);
    }

    #[test]
    fn the_face_beside_a_punch_is_clear_of_it() {
        assert_eq!(clear(|i, _| if i < 8 { 0.3 } else { 0.0 }), 160);
    }
}
