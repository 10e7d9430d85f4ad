//! Mid-edge nodes: on the surface where the edge lies on one, else in the middle.

use super::cutting::{Cut, distance};
use super::faces;
use super::levels::Levels;
use crate::numerics::tetrahedron::{EDGES, jacobian, slopes};
use crate::types::space::determinant;
use std::collections::HashMap;

/// Largest bend of an edge, over its length.
const MAX_BEND_FRACTION: f64 = 0.2;
/// Least Jacobian determinant over that of the straight element.
const MIN_JACOBIAN_RATIO: f64 = 0.12;

/// Places of all nodes (corners first) and the ten nodes of each element.
pub fn quadratic(cut: &Cut, part: &[u8], levels: &Levels) -> (Vec<[f64; 3]>, Vec<[u32; 10]>) {
    let mut places = cut.places.clone();
    let mut number: HashMap<(u32, u32), u32> = HashMap::new();
    let mut cells = Vec::with_capacity(cut.cells.len());
    let mut ends = Vec::new();
    for c in &cut.cells {
        let mut cell = [c[0], c[1], c[2], c[3], 0, 0, 0, 0, 0, 0];
        for (k, [i, j]) in EDGES.into_iter().enumerate() {
            let key = (c[i].min(c[j]), c[i].max(c[j]));
            cell[4 + k] = *number.entry(key).or_insert_with(|| {
                let [p, q] = [key.0, key.1].map(|v| cut.places[v as usize]);
                places.push(std::array::from_fn(|a| 0.5 * (p[a] + q[a])));
                ends.push(key);
                places.len() as u32 - 1
            });
        }
        cells.push(cell);
    }
    bend(cut, part, levels, &number, &mut places);
    straighten(&cells, &ends, cut.places.len(), &mut places);
    (places, cells)
}

/// Which level function an edge lies on: the body's surface, or between two parts.
#[derive(Clone, Copy)]
enum Surface {
    Body,
    Between(u8, u8),
}

fn bend(cut: &Cut, part: &[u8], levels: &Levels, number: &HashMap<(u32, u32), u32>, places: &mut [[f64; 3]]) {
    let mut on: HashMap<(u32, u32), Surface> = HashMap::new();
    for (f, [a, b]) in faces(&cut.cells) {
        let edges = [(f[0], f[1]), (f[1], f[2]), (f[0], f[2])];
        if b == u32::MAX {
            on.extend(edges.map(|e| (e, Surface::Body)));
        } else if part[a as usize] != part[b as usize] {
            let (k, m) = (part[a as usize].min(part[b as usize]), part[a as usize].max(part[b as usize]));
            for e in edges {
                let kept = on.get(&e).is_some_and(|s| match *s {
                    Surface::Body => true,
                    Surface::Between(i, j) => (i, j) <= (k, m),
                });
                if !kept {
                    on.insert(e, Surface::Between(k, m));
                }
            }
        }
    }
    for (edge, surface) in on {
        let node = number[&edge] as usize;
        let reach = MAX_BEND_FRACTION * distance(places[edge.0 as usize], places[edge.1 as usize]);
        let level = |p: [f64; 3]| match surface {
            Surface::Body => levels.body(p),
            Surface::Between(k, m) => levels.between(k as usize, m as usize, p),
        };
        if let Some(p) = foot(level, places[node], reach, 0.5 * levels.voxel()) {
            places[node] = p;
        }
    }
}

/// The zero of `level` nearest to `p` along its gradient, within `reach` (mm).
fn foot(level: impl Fn([f64; 3]) -> f64, p: [f64; 3], reach: f64, step: f64) -> Option<[f64; 3]> {
    let shifted = |a: usize, d: f64| {
        let mut q = p;
        q[a] += d;
        level(q)
    };
    let gradient: [f64; 3] = std::array::from_fn(|a| shifted(a, step) - shifted(a, -step));
    let length = gradient.iter().map(|g| g * g).sum::<f64>().sqrt();
    if length < 1e-3 {
        return None;
    }
    let value = level(p);
    let along = |t: f64| std::array::from_fn(|a| p[a] - value.signum() * t * gradient[a] / length);
    if value.abs() < 1e-6 {
        return Some(p);
    }
    let crossed = |t: f64| level(along(t)) * value <= 0.0;
    let high = (1..=8).map(|k| reach * f64::from(k) / 8.0).find(|&t| crossed(t))?;
    let (mut low, mut high) = (high - reach / 8.0, high);
    for _ in 0..20 {
        let middle = 0.5 * (low + high);
        if crossed(middle) { high = middle } else { low = middle }
    }
    Some(along(high))
}

/// Unbends edges of elements whose Jacobian determinant gets too small.
fn straighten(cells: &[[u32; 10]], ends: &[(u32, u32)], corners: usize, places: &mut [[f64; 3]]) {
    for round in 0..6 {
        let mut bad = vec![false; places.len()];
        let mut any = false;
        for cell in cells {
            if least_determinant(cell.map(|n| places[n as usize])) < MIN_JACOBIAN_RATIO {
                cell[4..].iter().for_each(|&n| bad[n as usize] = true);
                any = true;
            }
        }
        if !any {
            return;
        }
        for n in (corners..places.len()).filter(|&n| bad[n]) {
            let (p, q) = (places[ends[n - corners].0 as usize], places[ends[n - corners].1 as usize]);
            let keep = if round < 4 { 0.5 } else { 0.0 };
            places[n] = std::array::from_fn(|a| {
                let middle = 0.5 * (p[a] + q[a]);
                middle + keep * (places[n][a] - middle)
            });
        }
    }
}

/// The least Jacobian determinant at the nodes, over that of the element with straight edges.
pub fn least_determinant(p: [[f64; 3]; 10]) -> f64 {
    let straight = 6.0 * super::cutting::volume([p[0], p[1], p[2], p[3]]);
    if straight <= 0.0 {
        return f64::NEG_INFINITY;
    }
    let mut least = f64::INFINITY;
    for n in 0..10 {
        let mut l = [0.0; 4];
        if n < 4 {
            l[n] = 1.0;
        } else {
            EDGES[n - 4].iter().for_each(|&i| l[i] = 0.5);
        }
        least = least.min(determinant_at(&p, l));
    }
    least / straight
}

/// Volume (mm^3) of a curved element: the determinant is of degree three, and Keast's five points
/// integrate that exactly.
pub fn volume(p: [[f64; 3]; 10]) -> f64 {
    let at = |l: [f64; 4]| determinant_at(&p, l);
    let sixth = 1.0 / 6.0;
    let corners: f64 = (0..4)
        .map(|i| {
            let mut l = [sixth; 4];
            l[i] = 0.5;
            at(l)
        })
        .sum();
    (0.45 * corners - 0.8 * at([0.25; 4])) / 6.0
}

fn determinant_at(p: &[[f64; 3]; 10], l: [f64; 4]) -> f64 {
    determinant(&jacobian(p, &slopes(l)))
}
