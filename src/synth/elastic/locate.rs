//! Which element holds which voxel, and where in it.

use crate::synth::elastic::hexahedra::Lattice;
use crate::synth::elastic::quadratic::line;
use crate::types::space::{Matrix3, determinant};
use crate::types::{Grid, WorldPoint};
use rayon::prelude::*;

/// A place in an element by its local coordinates; outside of [-1, 1] on the linear continuation of
/// the element's side.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// The element.
    pub element: u32,
    /// Local coordinates.
    pub local: [f64; 3],
    /// How far outside the element (voxels); 0 inside.
    pub outside: f64,
}

/// Values at an element's nodes, with their derivatives, at a place (continued linearly outside).
pub(crate) fn interpolate(values: &[[f64; 3]], lattice: &Lattice, local: [f64; 3]) -> [f64; 3] {
    extended(|n| values[lattice[n] as usize], local).0
}

/// Value at `local`, the derivatives (`[component][axis]`), and how far the value lies from that at
/// the nearest inside.
#[inline(always)]
fn extended(value: impl Fn(usize) -> [f64; 3], local: [f64; 3]) -> ([f64; 3], Matrix3, f64) {
    let inside = local.map(|t| t.clamp(-1.0, 1.0));
    let t = inside.map(line);
    let (mut at, mut slope) = ([0.0; 3], [[0.0; 3]; 3]);
    for k in 0..3 {
        for j in 0..3 {
            let (vv, sv, vs) = (t[1][0][j] * t[2][0][k], t[1][1][j] * t[2][0][k], t[1][0][j] * t[2][1][k]);
            for i in 0..3 {
                let p = value(i + 3 * j + 9 * k);
                let (a, b) = (t[0][0][i], t[0][1][i]);
                for c in 0..3 {
                    at[c] += a * vv * p[c];
                    slope[c][0] += b * vv * p[c];
                    slope[c][1] += a * sv * p[c];
                    slope[c][2] += a * vs * p[c];
                }
            }
        }
    }
    let beyond: [f64; 3] = std::array::from_fn(|a| local[a] - inside[a]);
    let shift: [f64; 3] = std::array::from_fn(|c| (0..3).map(|a| slope[c][a] * beyond[a]).sum());
    (std::array::from_fn(|c| at[c] + shift[c]), slope, shift.iter().map(|s| s * s).sum::<f64>().sqrt())
}

/// Elements in the voxel frame of a grid.
pub(crate) struct Locator<'a> {
    elements: &'a [Lattice],
    /// Places of the nodes (voxels).
    nodes: Vec<[f64; 3]>,
    /// Low and high corner of the box around each element (voxels), widened where it has a free
    /// side.
    boxes: Vec<[[f64; 3]; 2]>,
    /// Whether an element has a free side.
    rim: Vec<bool>,
    reach: f64,
}

impl<'a> Locator<'a> {
    /// For nodes at `places` (world mm); elements are continued by `reach` voxels.
    pub fn new(grid: &Grid, places: &[[f64; 3]], elements: &'a [Lattice], reach: f64) -> Self {
        const FACES: [usize; 6] = [4, 10, 12, 14, 16, 22];
        let nodes: Vec<[f64; 3]> = places.iter().map(|&p| grid.affine().to_voxel(WorldPoint(p)).0).collect();
        let mut uses = vec![0u8; nodes.len()];
        elements.iter().for_each(|e| FACES.iter().for_each(|&f| uses[e[f] as usize] += 1));
        let rim: Vec<bool> = elements.iter().map(|e| FACES.iter().any(|&f| uses[e[f] as usize] == 1)).collect();
        let around = |(e, &rim): (&Lattice, &bool)| {
            // A curved side may leave the box of its nodes a little.
            let margin = if rim { reach } else { 0.5 };
            let edge = |c: usize, pick: fn(f64, f64) -> f64, start: f64| {
                e.iter().map(|&n| nodes[n as usize][c]).fold(start, pick)
            };
            let low = std::array::from_fn(|c| edge(c, f64::min, f64::INFINITY) - margin);
            [low, std::array::from_fn(|c| edge(c, f64::max, f64::NEG_INFINITY) + margin)]
        };
        let boxes = elements.iter().zip(&rim).map(around).collect();
        Self { elements, nodes, boxes, rim, reach }
    }

    /// The place of each voxel of a grid of `shape` (x fastest).
    pub fn voxels(&self, shape: [usize; 3]) -> Vec<Option<Place>> {
        let plane = shape[0] * shape[1];
        let mut out = vec![None; plane * shape[2]];
        out.par_chunks_mut(plane).enumerate().for_each(|(k, out)| {
            for e in 0..self.elements.len() {
                let [low, high] = self.boxes[e];
                if (k as f64) < low[2] || (k as f64) > high[2] {
                    continue;
                }
                let range = |a: usize| {
                    let to = (high[a].floor().min(shape[a] as f64 - 1.0) + 1.0).max(0.0) as usize;
                    (low[a].ceil().max(0.0) as usize).min(to)..to
                };
                for j in range(1) {
                    for i in range(0) {
                        self.improve(e, [i as f64, j as f64, k as f64], &mut out[i + shape[0] * j]);
                    }
                }
            }
        });
        out
    }

    /// The place of a point (voxels).
    pub fn point(&self, p: [f64; 3]) -> Option<Place> {
        let mut out = None;
        for e in 0..self.elements.len() {
            let [low, high] = self.boxes[e];
            if (0..3).all(|a| (low[a]..=high[a]).contains(&p[a])) {
                self.improve(e, p, &mut out);
            }
        }
        out
    }

    /// Takes element `e` if `p` lies in it, or nearer to it than to the one found before.
    fn improve(&self, e: usize, p: [f64; 3], found: &mut Option<Place>) {
        const INSIDE_TOLERANCE: f64 = 1e-9;
        if found.is_some_and(|f| f.outside <= INSIDE_TOLERANCE) {
            return;
        }
        let lattice = &self.elements[e];
        let mut local = [0.0; 3];
        let limit = if self.rim[e] { f64::INFINITY } else { 1.7 };
        for step in 0..30 {
            let (at, slope, outside) = extended(|n| self.nodes[lattice[n] as usize], local);
            let miss: [f64; 3] = std::array::from_fn(|c| p[c] - at[c]);
            if miss.iter().all(|m| m.abs() < 1e-7) {
                let most = if self.rim[e] { self.reach } else { 1e-6 };
                if outside <= most && found.is_none_or(|f| outside < f.outside) {
                    *found = Some(Place { element: e as u32, local, outside });
                }
                return;
            }
            let det = determinant(&slope);
            if det <= 0.0 {
                return;
            }
            for c in 0..3 {
                let (a, b) = ((c + 1) % 3, (c + 2) % 3);
                let row: f64 = (0..3)
                    .map(|r| {
                        let (s, t) = ((r + 1) % 3, (r + 2) % 3);
                        (slope[s][a] * slope[t][b] - slope[s][b] * slope[t][a]) * miss[r]
                    })
                    .sum();
                local[c] += row / det;
            }
            let far = local.iter().fold(0.0, |m: f64, t| m.max(t.abs()));
            if far.is_nan() || far > limit + if step == 0 { 0.0 } else { 2.0 } {
                return;
            }
        }
    }
}

/// Gives voxels without a value the mean of their neighbours that have one, layer by layer.
pub fn fill(values: &mut [Option<[f64; 3]>], shape: [usize; 3]) {
    let strides = [1, shape[0], shape[0] * shape[1]];
    let neighbours = |at: usize| {
        let voxel = [at % shape[0], at / shape[0] % shape[1], at / strides[2]];
        (0..3).flat_map(move |a| {
            let low = (voxel[a] > 0).then(|| at - strides[a]);
            let high = (voxel[a] + 1 < shape[a]).then(|| at + strides[a]);
            [low, high].into_iter().flatten()
        })
    };
    let mut front: Vec<usize> = (0..values.len()).filter(|&at| values[at].is_some()).collect();
    while !front.is_empty() {
        let mut next: Vec<usize> =
            front.iter().flat_map(|&at| neighbours(at)).filter(|&at| values[at].is_none()).collect();
        next.sort_unstable();
        next.dedup();
        let made: Vec<Option<[f64; 3]>> = next
            .iter()
            .map(|&at| {
                let known: Vec<[f64; 3]> = neighbours(at).filter_map(|n| values[n]).collect();
                Some(std::array::from_fn(|c| known.iter().map(|k| k[c]).sum::<f64>() / known.len() as f64))
            })
            .collect();
        next.iter().zip(made).for_each(|(&at, value)| values[at] = value);
        front = next;
    }
}
