//! The borders between labels, and how nodes move with one that lies further out.
//!
//! A label map has an error of its own: whoever drew it drew it too wide or too narrow all round.
//! So each border moves along its normal by an offset. Nodes around it follow by the mean of their
//! neighbours (a harmonic extension), other borders stay, and the surface of the body moves along
//! itself only.

use crate::numerics::dense::symmetric_eigen;
use crate::numerics::tetrahedron::EDGES;
use crate::stiffness::fem_body::Body;
use crate::stiffness::interface::MAX_EXAMINED;
use crate::types::space::{cross, dot, length};
use std::collections::{BTreeMap, HashMap};

/// Iteration control of the extension of offsets into the body.
struct ExtensionControl {
    /// Largest change of a node in the last sweep (parts of an offset).
    tolerance: f64,
    /// Most sweeps.
    max_sweeps: usize,
}

const EXTENSION: ExtensionControl = ExtensionControl { tolerance: 1e-3, max_sweeps: 2000 };

/// Part of the normals around a node, from which a direction is across the surface: a quarter at a
/// ridge of 120 degrees, under 0.05 on a ball of eight facets around.
const MIN_NORMAL_FRACTION: f64 = 0.1;

/// The border between two labels.
#[derive(Debug, Clone, PartialEq)]
pub struct Border {
    /// `1|2`: the labels.
    pub name: String,
    /// How each node moves for a unit of offset out of the smaller region (RAS).
    pub normals: Vec<[f64; 3]>,
}

/// The largest borders of a body between two labels.
pub fn all(body: &Body) -> Vec<Border> {
    let met = faces(body);
    let mut on: HashMap<u32, usize> = HashMap::new();
    for faces in met.values() {
        let mut nodes: Vec<u32> = faces.iter().flat_map(|f| f.0).collect();
        nodes.sort_unstable();
        nodes.dedup();
        nodes.into_iter().for_each(|n| *on.entry(n).or_default() += 1);
    }
    let around = neighbours(body);
    let surface = across(body);
    let mut largest: Vec<_> = met.iter().collect();
    let area = |faces: &[Face]| faces.iter().map(|f| length(f.1)).sum::<f64>();
    largest.sort_by(|a, b| area(b.1).total_cmp(&area(a.1)));
    largest.truncate(MAX_EXAMINED);
    largest.sort_by_key(|b| b.0);
    let one = |(&(a, b), faces): (&(u16, u16), &Vec<Face>)| {
        let [first, second] = [a, b].map(|r| body.volumes[r as usize]);
        let sign = if first <= second { 1.0 } else { -1.0 };
        let mut fixed: HashMap<u32, [f64; 3]> = on.keys().map(|&n| (n, [0.0; 3])).collect();
        let own: HashMap<u32, [f64; 3]> = faces.iter().fold(HashMap::new(), |mut sum, (nodes, n)| {
            for node in nodes {
                let v: &mut [f64; 3] = sum.entry(*node).or_default();
                (0..3).for_each(|a| v[a] += sign * n[a]);
            }
            sum
        });
        // Where three labels meet none of the borders moves.
        for (node, n) in own.into_iter().filter(|(node, _)| on[node] == 1) {
            let size = length(n).max(f64::MIN_POSITIVE);
            fixed.insert(node, n.map(|v| v / size));
        }
        let name = format!("{}|{}", body.labels[a as usize], body.labels[b as usize]);
        Border { name, normals: extended(body, &fixed, &around, &surface) }
    };
    largest.into_iter().map(one).collect()
}

/// Corners of a face, and its normal (as long as its area, mm^2).
type Face = ([u32; 3], [f64; 3]);

/// The faces between each pair of regions, with normals out of the first of them.
fn faces(body: &Body) -> BTreeMap<(u16, u16), Vec<Face>> {
    let mut seen: HashMap<[u32; 3], u16> = HashMap::with_capacity(2 * body.cells.len());
    let mut out: BTreeMap<(u16, u16), Vec<Face>> = BTreeMap::new();
    for (cell, &region) in body.cells.iter().zip(&body.region) {
        for left_out in 0..4 {
            let corners: [u32; 3] = std::array::from_fn(|i| cell[(left_out + 1 + i) % 4]);
            let mut key = corners;
            key.sort_unstable();
            let Some(other) = seen.insert(key, region).filter(|other| *other != region) else { continue };
            let place = |n: u32| body.places[n as usize];
            let to = |p: [f64; 3], q: [f64; 3]| -> [f64; 3] { std::array::from_fn(|a| q[a] - p[a]) };
            let [p, q, r] = corners.map(place);
            let n = cross(to(p, q), to(p, r)).map(|v| 0.5 * v);
            // Out of this element, or into it where this one is of the second region.
            let outwards = if dot(n, to(place(cell[left_out]), p)) > 0.0 { 1.0 } else { -1.0 };
            let sign = if region < other { outwards } else { -outwards };
            out.entry((region.min(other), region.max(other))).or_default().push((corners, n.map(|v| sign * v)));
        }
    }
    out
}

/// Corners that share an edge with each corner, ascending; empty for the other nodes.
fn neighbours(body: &Body) -> Vec<Vec<u32>> {
    let mut out = vec![Vec::new(); body.places.len()];
    for cell in &body.cells {
        for [i, j] in EDGES {
            out[cell[i] as usize].push(cell[j]);
            out[cell[j] as usize].push(cell[i]);
        }
    }
    for list in &mut out {
        list.sort_unstable();
        list.dedup();
    }
    out
}

/// For each corner on the surface, the directions in which it may not move.
fn across(body: &Body) -> BTreeMap<u32, Vec<[f64; 3]>> {
    let mut sums: BTreeMap<u32, ([[f64; 3]; 3], f64)> = BTreeMap::new();
    for facet in &body.surface {
        for n in &facet.nodes[..3] {
            let (m, area) = sums.entry(*n).or_default();
            for a in 0..3 {
                (0..3).for_each(|b| m[a][b] += facet.area * facet.normal[a] * facet.normal[b]);
            }
            *area += facet.area;
        }
    }
    let directions = |(m, area): ([[f64; 3]; 3], f64)| {
        symmetric_eigen(&m).into_iter().filter(|e| e.0 > MIN_NORMAL_FRACTION * area).map(|e| e.1).collect()
    };
    sums.into_iter().map(|(n, sum)| (n, directions(sum))).collect()
}

/// The displacement of all nodes that takes the `fixed` ones along.
fn extended(
    body: &Body,
    fixed: &HashMap<u32, [f64; 3]>,
    around: &[Vec<u32>],
    surface: &BTreeMap<u32, Vec<[f64; 3]>>,
) -> Vec<[f64; 3]> {
    let along = |n: u32, mut v: [f64; 3]| {
        for d in surface.get(&n).into_iter().flatten() {
            let part = dot(v, *d);
            (0..3).for_each(|a| v[a] -= part * d[a]);
        }
        v
    };
    let mut out = vec![[0.0; 3]; body.places.len()];
    for (&n, &v) in fixed {
        out[n as usize] = along(n, v);
    }
    let free: Vec<u32> =
        (0..out.len() as u32).filter(|n| !around[*n as usize].is_empty() && !fixed.contains_key(n)).collect();
    for _ in 0..EXTENSION.max_sweeps {
        let mut most = 0.0f64;
        for &n in &free {
            let near = &around[n as usize];
            let sum = near.iter().fold([0.0; 3], |s, &m| std::array::from_fn(|a| s[a] + out[m as usize][a]));
            let next = along(n, sum.map(|v| v / near.len() as f64));
            let old = std::mem::replace(&mut out[n as usize], next);
            most = (0..3).fold(most, |m, a| m.max((next[a] - old[a]).abs()));
        }
        if most < EXTENSION.tolerance {
            break;
        }
    }
    for cell in &body.cells {
        for (k, [i, j]) in EDGES.into_iter().enumerate() {
            let [p, q] = [i, j].map(|i| out[cell[i] as usize]);
            out[cell[4 + k] as usize] = std::array::from_fn(|a| 0.5 * (p[a] + q[a]));
        }
    }
    out
}
