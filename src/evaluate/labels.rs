//! Two label maps compared through a displacement field: overlap and distances between surfaces.
//!
//! A surface is the centres of the voxels of a label that have a face to another label, to the
//! background or to the outside of the grid; an axis of one voxel has no such faces. Distances are
//! Euclidean in world mm, from each surface voxel to the nearest of the other map, both ways
//! pooled: their mean is the symmetric mean surface distance (Heimann et al. 2009), their 95th
//! percentile the 95th percentile Hausdorff distance.

use crate::error::FieldError;
use crate::numerics::neighbours::Neighbours;
use crate::numerics::sampling::{beside, displacement, inside, nearest};
use crate::numerics::statistics::percentile;
use crate::types::space::length;
use crate::types::{DenseField, Grid, LabelScore, LabelScores, Mask, Overlap, WorldPoint};
use rayon::prelude::*;

/// Compares `initial` with `deformed`, warped by `field` to the grid of `initial` by nearest
/// neighbour, and with `deformed` as stored. All three may lie on grids of their own; beyond its
/// grid the field's edge value counts.
///
/// # Errors
/// [`FieldError::Volume`] when the maps share no label, or the field is no number where the initial
/// map lies.
///
/// ```
/// use palpate::evaluate::labels::label_scores;
/// use palpate::{Affine, DenseField, Grid, Mask};
/// let grid = Grid::new([12; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let cube = |from: f64| {
///     Mask::from_voxels(grid, |_, p| u8::from(p.0.iter().all(|x| (from..from + 5.0).contains(x))))
/// };
/// let field = DenseField::from_fn(grid, |_| [2.0; 3]);
/// let scores = label_scores(&field, &cube(2.0), &cube(4.0))?;
/// assert_eq!(scores.dice_mean, 1.0);
/// assert!(scores.dice_mean_before < 0.3);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn label_scores(field: &DenseField, initial: &Mask, deformed: &Mask) -> Result<LabelScores, FieldError> {
    let grid = initial.grid();
    let place = |at: usize| {
        let [i, j, k] = grid.voxel(at);
        grid.world(i, j, k)
    };
    let there = |p: WorldPoint| {
        let found = nearest(deformed.grid().shape(), deformed.grid().affine().to_voxel(p));
        found.map_or(0, |at| deformed.as_slice()[at])
    };
    let moved = |at: usize| {
        let x = place(at);
        let u = displacement(field, x);
        u.iter().all(|c| c.is_finite()).then(|| there(x.moved(u)))
    };
    let warped: Option<Vec<u8>> = (0..grid.len()).into_par_iter().map(moved).collect();
    let Some(warped) = warped else {
        return Err(FieldError::Volume {
            volume: "measured",
            what: "is NaN or infinite where the initial labels lie".into(),
            hint: "cut the label map to where the field is known".into(),
        });
    };
    let still: Vec<u8> = (0..grid.len()).into_par_iter().map(|at| there(place(at))).collect();
    let [a, b] = [initial, deformed].map(|m| counts(m.as_slice()));
    let shared: Vec<u8> = (1..=255).filter(|&l| a[usize::from(l)] > 0 && b[usize::from(l)] > 0).collect();
    if shared.is_empty() {
        return Err(FieldError::Volume {
            volume: "deformed",
            what: "shares no label with the initial one".into(),
            hint: "give maps in which the same number stands for the same tissue".into(),
        });
    }
    let values = initial.as_slice();
    let each: Vec<LabelScore> = shared
        .iter()
        .map(|&label| LabelScore {
            label,
            voxels: a[usize::from(label)],
            after: overlap(grid, values, &warped, label),
            before: overlap(grid, values, &still, label),
        })
        .collect();
    let mean = |of: fn(&LabelScore) -> f64| each.iter().map(of).sum::<f64>() / each.len() as f64;
    let beyond = |at: &usize| {
        let p = field.grid().affine().to_voxel(place(*at));
        values[*at] != 0 && !inside(field.grid().shape(), p)
    };
    let labelled: usize = a[1..].iter().sum();
    let alone = |one: &[usize], other: &[usize]| -> Vec<u8> {
        (1..=255).filter(|&l| one[usize::from(l)] > 0 && other[usize::from(l)] == 0).collect()
    };
    Ok(LabelScores {
        dice_mean: mean(|s| s.after.dice),
        dice_mean_before: mean(|s| s.before.dice),
        only_initial: alone(&a, &b),
        only_deformed: alone(&b, &a),
        outside: (0..grid.len()).into_par_iter().filter(beyond).count() as f64 / labelled as f64,
        each,
    })
}

/// Voxels of each label.
fn counts(labels: &[u8]) -> Vec<usize> {
    let mut out = vec![0usize; 256];
    labels.iter().for_each(|&l| out[usize::from(l)] += 1);
    out
}

/// How well `label` coincides in two maps on `grid` (x fastest).
pub fn overlap(grid: &Grid, one: &[u8], other: &[u8], label: u8) -> Overlap {
    let both = one.iter().zip(other).filter(|(a, b)| **a == label && **b == label).count();
    let all = [one, other].map(|map| map.iter().filter(|l| **l == label).count());
    let surfaces = [surface(grid, one, label), surface(grid, other, label)];
    let known = surfaces.iter().all(|s| !s.is_empty());
    let mut distances = if known {
        let mut out = to_nearest(&surfaces[0], &surfaces[1]);
        out.extend(to_nearest(&surfaces[1], &surfaces[0]));
        out
    } else {
        Vec::new()
    };
    let mean = super::mean(&distances);
    Overlap {
        dice: 2.0 * both as f64 / (all[0] + all[1]) as f64,
        surface_mean_mm: known.then_some(mean),
        hausdorff95_mm: known.then(|| percentile(&mut distances, 95.0)),
    }
}

/// The centres (world mm) of the surface voxels of `label`.
fn surface(grid: &Grid, labels: &[u8], label: u8) -> Vec<[f64; 3]> {
    let shape = grid.shape();
    let neighbours = 2 * shape.iter().filter(|n| **n > 1).count();
    let at_surface =
        |at: &usize| labels[*at] == label && beside(shape, *at).filter(|&n| labels[n] == label).count() < neighbours;
    let centre = |at: usize| {
        let [i, j, k] = grid.voxel(at);
        grid.world(i, j, k).0
    };
    (0..labels.len()).into_par_iter().filter(at_surface).map(centre).collect()
}

/// The distance from each of `from` to the nearest of `to` (mm), which is not empty.
fn to_nearest(from: &[[f64; 3]], to: &[[f64; 3]]) -> Vec<f64> {
    let tree = Neighbours::new(to);
    let apart = |p: &[f64; 3], q: &[f64; 3]| length([p[0] - q[0], p[1] - q[1], p[2] - q[2]]);
    let nearest = |p: &[f64; 3]| match tree.within(*p, f64::INFINITY, 1).first() {
        Some(&at) => apart(p, &to[at]),
        // Without a tree the answer is the same, only slower.
        None => to.iter().map(|q| apart(p, q)).fold(f64::INFINITY, f64::min),
    };
    from.par_iter().map(nearest).collect()
}
