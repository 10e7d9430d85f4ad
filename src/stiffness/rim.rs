//! The rim of a flat punch on the surface around it: where the mesh must be fine.
//!
//! Under the edge of a punch strain has a singularity, and what is near it (a thin skin) hangs on where that edge is. So it is
//! looked for among the surface voxels: those that moved with the plate next to those that did not.

use crate::stiffness::observations::at_surface;
use crate::stiffness::patches::Patch;
use crate::types::space::dot;
use crate::types::{DenseField, Mask, VoxelPoint};
use rayon::prelude::*;

/// Voxels around a surface voxel that are read for its motion.
const REACH: f64 = 1.8;
/// Voxels on both sides of the rim, and below it, where the mesh is fine.
const AROUND: i32 = 1;

/// Places (grid mm: voxel index times spacing) around the rim of `patch`; empty for a patch on a curved surface, and where the
/// whole side is pressed.
pub fn rim(patch: &Patch, field: &DenseField, labels: &Mask, tolerance: f64) -> Vec<[f64; 3]> {
    if patch.bend() > 0.0 {
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
    // For each column the outermost voxel of the body, and whether it moved with the plate.
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
        let (moved, _) = at_surface(field, labels, place, REACH)?;
        let plate = patch.motion(place);
        let short: f64 = dot(std::array::from_fn(|a| moved[a] - plate[a]), patch.normal);
        Some((top, short.abs() < tolerance))
    };
    let columns: Vec<Option<(usize, bool)>> = (0..width * shape[v]).into_par_iter().map(column).collect();
    let columns: Vec<Option<(usize, bool)>> = (0..columns.len()).map(|c| voted(&columns, c, width)).collect();
    let mut found = Vec::new();
    for (c, here) in columns.iter().enumerate() {
        let Some((top, true)) = *here else { continue };
        let (i, j) = ((c % width) as i32, (c / width) as i32);
        let beside = [(-1, 0), (1, 0), (0, -1), (0, 1)].iter().any(|&(di, dj)| {
            let (i, j) = (i + di, j + dj);
            let within = (0..width as i32).contains(&i) && (0..shape[v] as i32).contains(&j);
            let next = within.then(|| columns[(i + width as i32 * j) as usize]).flatten();
            // A face that ends there has no rim on it.
            next.is_some_and(|(other, with)| !with && other.abs_diff(top) < 3)
        });
        if !beside {
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

/// A column with what most of the 25 around it say: noise makes no rim.
fn voted(columns: &[Option<(usize, bool)>], c: usize, width: usize) -> Option<(usize, bool)> {
    let (top, _) = columns[c]?;
    let (i, j) = ((c % width) as i32, (c / width) as i32);
    let (mut with, mut all) = (0, 0);
    for (i, j) in (-2..=2).flat_map(|di| (-2..=2).map(move |dj| (i + di, j + dj))) {
        let within = (0..width as i32).contains(&i) && (0..(columns.len() / width) as i32).contains(&j);
        if let Some((_, moved)) = within.then(|| columns[(i + width as i32 * j) as usize]).flatten() {
            with += u32::from(moved);
            all += 1;
        }
    }
    Some((top, 2 * with > all))
}
