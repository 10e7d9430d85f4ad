//! The rim of a flat punch on the surface around it: where the mesh must be fine, and where its
//! faces must end.
//!
//! Under the edge of a punch strain has a singularity, and what is near it (a thin skin) hangs on
//! where that edge is. So it is looked for among the surface voxels: those that moved with the
//! plate next to those that did not.

use crate::numerics::dense::solve;
use crate::numerics::statistics::percentile;
use crate::stiffness::boundary_conditions::Patch;
use crate::stiffness::observations::at_surface;
use crate::types::space::dot;
use crate::types::{Displacement, Grid, Mask, VoxelPoint, WorldPoint};
use rayon::prelude::*;
use std::f64::consts::TAU;

/// Voxels on both sides of the rim, and below it, where the mesh is fine.
const RIM_MARGIN_VOXELS: i32 = 1;
/// Fewest columns of a patch beside a punch.
const MIN_PATCH_COLUMNS: usize = 25;

/// Directions in which an outline is searched.
const DIRECTIONS: usize = 256;
/// How the outline of a punch is fitted to the way the surface beside it gives way.
struct OutlineFit {
    /// Nearest and furthest distance beside the punch that is used (voxels).
    range_voxels: [f64; 2],
    /// Half of the arc over which the median of the outline's distance is taken (voxels).
    median_half_arc_voxels: f64,
    /// Largest distance of the outline from the last voxel that moved with the punch (voxels): in
    /// noise many beside it seem to.
    max_offset_voxels: f64,
    /// Fits, each from the outline of the one before.
    iterations: usize,
    /// Largest standard deviation of an edge that is reported (voxels).
    max_sd_voxels: f64,
    /// Relative difference from the area that moved with the punch.
    max_area_difference: f64,
}

const OUTLINE_FIT: OutlineFit = OutlineFit {
    range_voxels: [1.0, 6.0],
    median_half_arc_voxels: 1.5,
    max_offset_voxels: 3.0,
    iterations: 4,
    max_sd_voxels: 0.1,
    max_area_difference: 0.15,
};

/// The rim of a flat punch.
#[derive(Debug, Clone, Default)]
pub(crate) struct Rim {
    /// Places around it (grid mm: voxel index times spacing).
    pub places: Vec<[f64; 3]>,
    /// Where it runs; none where it is not seen all around the middle of the patch.
    pub outline: Option<Outline>,
}

/// A closed curve around the middle of a punch, on the plane of two voxel axes.
#[derive(Debug, Clone)]
pub struct Outline {
    grid: Grid,
    plane: [usize; 2],
    middle: [f64; 2],
    /// Distance from the middle (mm) by direction.
    radii: Vec<f64>,
}

impl Outline {
    /// How far (mm) a place (grid mm) lies within the curve, along the ray from the middle.
    pub fn within(&self, p: [f64; 3]) -> f64 {
        let [x, y]: [f64; 2] = std::array::from_fn(|k| p[self.plane[k]] - self.middle[k]);
        let turn = (y.atan2(x) / TAU).rem_euclid(1.0) * DIRECTIONS as f64;
        let (low, part) = (turn as usize % DIRECTIONS, turn.fract());
        let radius = (1.0 - part) * self.radii[low] + part * self.radii[(low + 1) % DIRECTIONS];
        radius - x.hypot(y)
    }

    /// The same for a place in mm, RAS.
    pub fn holds(&self, p: [f64; 3]) -> bool {
        let v = self.grid.affine().to_voxel(WorldPoint(p)).0;
        let spacing = self.grid.spacing();
        self.within(std::array::from_fn(|a| v[a] * spacing[a])) > 0.0
    }

    /// Its area (mm^2).
    fn area(&self) -> f64 {
        let next = |k: usize| self.radii[(k + 1) % DIRECTIONS];
        let sine = (TAU / DIRECTIONS as f64).sin();
        (0..DIRECTIONS).map(|k| 0.5 * sine * self.radii[k] * next(k)).sum()
    }
}

/// The rim of `patch`; empty for a patch on a curved surface, and where the whole side is pressed.
///
/// A voxel's motion is read from those within `reach` (voxels), and is that of the plate within
/// `tolerance` (mm).
pub fn rim(patch: &Patch, field: &Displacement<'_>, labels: &Mask, tolerance: f64, reach: f64) -> Rim {
    if patch.curved() {
        return Rim::default();
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
    // For each column the outermost voxel of the body, and by how much it moved otherwise than the
    // plate (mm).
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
    let mut places = Vec::new();
    for (c, here) in columns.iter().enumerate() {
        let Some((top, true)) = *here else { continue };
        let (i, j) = ((c % width) as i32, (c / width) as i32);
        let next = |n: usize| columns[n].is_some_and(|(other, _)| beside[n] && other.abs_diff(top) < 3);
        if !around(c, columns.len(), width, 1).any(next) {
            continue;
        }
        for (di, dj) in (-RIM_MARGIN_VOXELS..=RIM_MARGIN_VOXELS)
            .flat_map(|di| (-RIM_MARGIN_VOXELS..=RIM_MARGIN_VOXELS).map(move |dj| (di, dj)))
        {
            for down in 0..=RIM_MARGIN_VOXELS {
                let mut at = [0.0; 3];
                at[axis] = top as f64 + f64::from(if up { -down } else { down });
                (at[u], at[v]) = (f64::from(i + di), f64::from(j + dj));
                places.push(std::array::from_fn(|a| at[a] * spacing[a]));
            }
        }
    }
    if places.is_empty() {
        return Rim::default();
    }
    let lag = |c: usize| {
        let at = index(columns[c]?.0, c % width, c / width);
        let place = grid.world(at[0], at[1], at[2]).0;
        let (moved, plate) = (field.at(grid.index(at[0], at[1], at[2])), patch.motion(place));
        Some(dot(std::array::from_fn(|a| f64::from(moved[a]) - plate[a]), patch.normal)).filter(|v| v.is_finite())
    };
    let face = Face {
        width,
        spacing: [spacing[u], spacing[v]],
        with: columns.iter().map(|c| c.is_some_and(|(_, with)| with)).collect(),
        lag: (0..columns.len()).map(lag).collect(),
    };
    let middle = grid.affine().to_voxel(WorldPoint(patch.middle)).0;
    let outline = face.outline([middle[u], middle[v]]).map(|radii| Outline {
        grid: *grid,
        plane: [u, v],
        middle: [middle[u] * spacing[u], middle[v] * spacing[v]],
        radii,
    });
    let seen = face.with.iter().filter(|w| **w).count() as f64 * spacing[u] * spacing[v];
    let outline = outline.filter(|o| (o.area() / seen - 1.0).abs() < OUTLINE_FIT.max_area_difference);
    Rim { places, outline }
}

/// A side of the body, column by column.
struct Face {
    width: usize,
    spacing: [f64; 2],
    /// Which moved with the punch.
    with: Vec<bool>,
    /// By how much the outermost voxel stays behind it (mm); none outside the body.
    lag: Vec<Option<f64>>,
}

impl Face {
    /// Distance of the punch's edge from `middle` (columns) in each direction (mm); none where the
    /// middle is not below it.
    ///
    /// Beside the edge of a punch the surface gives way as the root of the distance (Johnson,
    /// Contact Mechanics, 1985, sec. 2.8), so the square of that begins as a straight line where
    /// the punch ends; a parabola takes up the bend further out. It is fitted to each direction by
    /// itself, and where noise leaves the edge open to those over an arc at once.
    fn outline(&self, middle: [f64; 2]) -> Option<Vec<f64>> {
        let step = 0.5 * self.spacing[0].min(self.spacing[1]);
        let voxel = 2.0 * step;
        let at = |k: usize, r: f64| {
            let (sin, cos) = (TAU * k as f64 / DIRECTIONS as f64).sin_cos();
            [middle[0] + r * cos / self.spacing[0], middle[1] + r * sin / self.spacing[1]]
        };
        let with = |k: usize| {
            let clear = |r: &f64| self.nearest(at(k, *r)).is_none_or(|c| !self.with[c]);
            (0..).map(|n| f64::from(n) * step).find(clear).filter(|last| *last > 0.0)
        };
        let last: Vec<f64> = (0..DIRECTIONS).map(with).collect::<Option<_>>()?;
        // Where the body ends before the punch does, there is no edge.
        let ended = |k: usize| self.nearest(at(k, last[k])).is_none_or(|c| self.lag[c].is_none());
        let ended: Vec<bool> = (0..DIRECTIONS).map(ended).collect();
        let arc = |r: f64| {
            ((OUTLINE_FIT.median_half_arc_voxels * voxel / r / TAU * DIRECTIONS as f64) as usize).min(DIRECTIONS / 8)
        };
        let medians = |raw: &[f64]| -> Vec<f64> {
            let median = |k: usize| {
                let half = arc(raw[k]);
                let mut near: Vec<f64> =
                    (0..=2 * half).map(|n| raw[(k + DIRECTIONS + n - half) % DIRECTIONS]).collect();
                percentile(&mut near, 50.0)
            };
            (0..DIRECTIONS).map(median).collect()
        };
        let mut edges = last.clone();
        for _ in 0..OUTLINE_FIT.iterations {
            // Samples of several directions only tell where all of their edges lie together.
            edges = medians(&edges);
            let samples: Vec<Vec<[f64; 2]>> = (0..DIRECTIONS)
                .map(|k| {
                    let places = (0..).map(|n| edges[k] + OUTLINE_FIT.range_voxels[0] * voxel + f64::from(n) * step);
                    let places =
                        places.take_while(|r| !ended[k] && *r < edges[k] + OUTLINE_FIT.range_voxels[1] * voxel);
                    places.map_while(|r| self.read(at(k, r)).map(|lag| [r - edges[k], lag * lag.abs()])).collect()
                })
                .collect();
            let next = |k: usize| {
                let mut half = 0;
                loop {
                    let near: Vec<[f64; 2]> = (0..=2 * half)
                        .flat_map(|n| samples[(k + DIRECTIONS + n - half) % DIRECTIONS].iter().copied())
                        .collect();
                    let found = zero(&near);
                    match found {
                        Some((end, open)) if open < OUTLINE_FIT.max_sd_voxels * voxel || half >= DIRECTIONS / 8 => {
                            return edges[k] + end;
                        }
                        None if half >= DIRECTIONS / 8 => return edges[k],
                        _ => half = (2 * half).clamp(arc(edges[k]).max(1), DIRECTIONS / 8),
                    }
                }
            };
            edges = (0..DIRECTIONS)
                .map(|k| if ended[k] { last[k] } else { next(k) })
                .zip(&last)
                .map(|(edge, last)| {
                    edge.clamp(
                        (last - OUTLINE_FIT.max_offset_voxels * voxel).max(step),
                        last + OUTLINE_FIT.max_offset_voxels * voxel,
                    )
                })
                .collect();
        }
        let raw: Vec<f64> = (0..DIRECTIONS)
            .map(|k| if ended[k] { last[k] + OUTLINE_FIT.max_offset_voxels * voxel } else { edges[k] })
            .collect();
        Some(medians(&raw))
    }

    fn nearest(&self, at: [f64; 2]) -> Option<usize> {
        let [i, j] = at.map(|v| v.round());
        let high = (self.lag.len() / self.width) as f64;
        ((0.0..self.width as f64).contains(&i) && (0.0..high).contains(&j))
            .then(|| i as usize + self.width * j as usize)
    }

    /// How far the surface stays behind, between the columns.
    fn read(&self, at: [f64; 2]) -> Option<f64> {
        let (low, part) = (at.map(f64::floor), at.map(|v| v - v.floor()));
        let corner = |k: usize| {
            let to = [k & 1, k >> 1];
            let weight: f64 = (0..2).map(|a| if to[a] == 1 { part[a] } else { 1.0 - part[a] }).product();
            let column = self.nearest(std::array::from_fn(|a| low[a] + to[a] as f64))?;
            Some(weight * self.lag[column]?)
        };
        (0..4).map(corner).sum()
    }
}

/// Where the parabola through `samples` (place from about there, value) is 0 and rises, next to 0,
/// and how far that is open: one standard deviation, as if all samples were independent.
fn zero(samples: &[[f64; 2]]) -> Option<(f64, f64)> {
    if samples.len() < 6 {
        return None;
    }
    let (mut m, mut right, mut squares) = ([[0.0; 3]; 3], [0.0; 3], 0.0);
    for &[x, y] in samples {
        let row = [1.0, x, x * x];
        for i in 0..3 {
            right[i] += row[i] * y;
            (0..3).for_each(|j| m[i][j] += row[i] * row[j]);
        }
        squares += y * y;
    }
    let [c, b, a] = solve(&m, &right)?;
    let under = b * b - 4.0 * a * c;
    if under < 0.0 || b <= 0.0 {
        return None;
    }
    let end = -2.0 * c / (b + under.sqrt());
    let row = [1.0, end, end * end];
    let spread: f64 = solve(&m, &row)?.iter().zip(&row).map(|(v, r)| v * r).sum();
    let left = (squares - (0..3).map(|i| [c, b, a][i] * right[i]).sum::<f64>()).max(0.0) / (samples.len() - 3) as f64;
    Some((end, (left * spread).sqrt() / under.sqrt().max(f64::MIN_POSITIVE)))
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

/// Columns that a punch leaves free: in patches that are wide and stay well behind it. A corner
/// that is badly read, or noise that hangs together, is neither.
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
        if patch.len() >= MIN_PATCH_COLUMNS && mean > 2.0 * tolerance {
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

    /// The outline that is found of a punch whose edge lies `far` (columns) beyond a place on a
    /// face of 60 by 50 columns of 0.5 by 0.6 mm; the surface gives way as the root of that, and a
    /// little less further away.
    fn outline(far: impl Fn([f64; 2]) -> f64, noise: f64) -> Vec<f64> {
        outline_of(far, noise, 0.3)
    }

    /// The same where columns up to `with` beyond the edge count as moving with the punch.
    fn outline_of(far: impl Fn([f64; 2]) -> f64, noise: f64, with: f64) -> Vec<f64> {
        let mut random = crate::numerics::random::Random::new(5, 0);
        let width = 60;
        let lag = |c: usize| {
            let d = far([(c % width) as f64, (c / width) as f64]).max(0.0);
            Some(0.15 * (d * (1.0 - 0.01 * d)).sqrt())
        };
        let lag: Vec<Option<f64>> = (0..50 * width).map(|c| lag(c).map(|v| v + noise * random.normals()[0])).collect();
        let with = (0..50 * width).map(|c| far([(c % width) as f64, (c / width) as f64]) < with).collect();
        Face { width, spacing: [0.5, 0.6], with, lag }.outline([30.4, 24.7]).unwrap_or_default()
    }

    #[test]
    fn the_outline_of_a_round_punch_is_told_to_a_part_of_a_voxel() {
        for (noise, bar, part) in [(0.0, 0.08, 0.01), (0.02, 0.5, 0.05)] {
            // 8.2 mm around a middle beside the one from which it is looked for.
            let far = |[i, j]: [f64; 2]| ((0.5 * (i - 29.1)).hypot(0.6 * (j - 25.2)) - 8.2) / 0.5;
            let radii = outline(far, noise);
            assert_eq!(radii.len(), DIRECTIONS);
            let off = |(k, r): (usize, &f64)| {
                let (sin, cos) = (TAU * k as f64 / DIRECTIONS as f64).sin_cos();
                far([30.4 + r * cos / 0.5, 24.7 + r * sin / 0.6])
            };
            let square = radii.iter().enumerate().map(|r| off(r).powi(2)).sum::<f64>() / DIRECTIONS as f64;
            assert!(square.sqrt() < bar, "{noise} {}", square.sqrt());
            let area = 0.5 * radii.iter().map(|r| r * r).sum::<f64>() * TAU / DIRECTIONS as f64;
            let exact = 0.5 * TAU * 8.2 * 8.2;
            assert!((area / exact - 1.0).abs() < part, "{noise} {area} {exact}");
        }
    }

    /// In many directions no edge was seen, and what counted as moving with the punch was kept: the
    /// area was 30 % too large here.
    #[test]
    fn noise_does_not_widen_the_outline_of_a_punch() {
        let far = |[i, j]: [f64; 2]| ((0.5 * (i - 29.1)).hypot(0.6 * (j - 25.2)) - 8.2) / 0.5;
        let radii = outline_of(far, 0.05, 2.5);
        let area = 0.5 * radii.iter().map(|r| r * r).sum::<f64>() * TAU / DIRECTIONS as f64;
        let exact = 0.5 * TAU * 8.2 * 8.2;
        assert!((area / exact - 1.0).abs() < 0.1, "{area} {exact}");
    }

    #[test]
    fn the_outline_of_a_punch_of_a_voxel_or_two_is_finite_and_positive() {
        // An edge put two voxels further in was at or past the middle, and its arc without end.
        for radius in [0.2, 0.35, 0.6, 1.0, 1.6] {
            let far = |[i, j]: [f64; 2]| ((0.5 * (i - 30.4)).hypot(0.6 * (j - 24.7)) - radius) / 0.5;
            let radii = outline(far, 0.03);
            assert!(radii.iter().all(|r| *r > 0.0 && *r < radius + 2.0), "{radius} {radii:?}");
        }
    }

    #[test]
    fn the_outline_of_a_square_punch_has_its_area() {
        // Turned by half a radian, sides of 13 and 17 mm.
        let far = |[i, j]: [f64; 2]| {
            let (x, y) = (0.5 * (i - 30.9), 0.6 * (j - 24.1));
            let (sin, cos) = 0.5f64.sin_cos();
            let [a, b] = [(cos * x + sin * y).abs() - 6.5, (cos * y - sin * x).abs() - 8.5];
            if a > 0.0 && b > 0.0 { a.hypot(b) / 0.5 } else { a.max(b) / 0.5 }
        };
        let radii = outline(far, 0.0);
        let area = 0.5 * radii.iter().map(|r| r * r).sum::<f64>() * TAU / DIRECTIONS as f64;
        assert!((area / 221.0 - 1.0).abs() < 0.02, "{area}");
    }
}
