//! The energy that a choice of candidates is judged by.
//!
//! `E = sum_i (1 - ncc_i) + lambda sum_(i,j) min(1, (|d_i - d_j| / (s0 + s |x_i - x_j|))^2)`
//!
//! over the graph of each place's nearest neighbours. The pair term is bounded, so one false match
//! costs its neighbours no more than a constant (truncated quadratic, Blake & Zisserman 1987).

use crate::numerics::neighbours::Neighbours;
use crate::types::Candidate;
use rayon::prelude::*;

/// Constants of the energy.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EnergyParams {
    /// Weight of a pair against the correlations; divided by the number of neighbours. Default 1.
    pub lambda: f64,
    /// Precision of a candidate (mm); about a voxel of the level.
    pub precision_mm: f64,
    /// Difference of displacement allowed per distance (1): a strain; default 0.3.
    pub strain: f64,
    /// Neighbours of each place; default 16.
    pub neighbours: usize,
}

impl EnergyParams {
    /// The defaults, for candidates as precise as `precision_mm`.
    pub fn new(precision_mm: f64) -> Self {
        Self { lambda: 1.0, precision_mm, strain: 0.3, neighbours: 16 }
    }
}

/// Places and the neighbours of each, with the displacement difference `s0 + s |x_i - x_j|` (mm) at
/// which a pair counts as contradicting.
#[derive(Debug, Clone)]
pub struct Graph {
    /// For each place: neighbour and allowed difference (mm).
    pub edges: Vec<Vec<(usize, f64)>>,
    /// Weight of one pair.
    pub pair_weight: f64,
}

impl Graph {
    /// The k-nearest-neighbour graph of `places` (mm, in any frame: only distances count).
    ///
    /// ```
    /// use palpate::consistency::energy::{EnergyParams, Graph};
    /// let places = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [9.0, 0.0, 0.0]];
    /// let params = EnergyParams { lambda: 1.0, precision_mm: 0.5, strain: 0.25, neighbours: 1 };
    /// let graph = Graph::new(&places, params);
    /// // The nearest neighbour of the first place lies 1 mm away: 0.5 + 0.25 mm are allowed.
    /// assert_eq!(graph.edges[0], [(1, 0.75)]);
    /// ```
    pub fn new(places: &[[f64; 3]], params: EnergyParams) -> Self {
        let tree = Neighbours::new(places);
        let edges = places
            .par_iter()
            .enumerate()
            .map(|(i, &x)| {
                let near = tree.within(x, f64::INFINITY, params.neighbours + 1);
                let allowed = |j: usize| params.precision_mm + params.strain * distance(x, places[j]);
                near.into_iter().filter(|&j| j != i).map(|j| (j, allowed(j))).collect()
            })
            .collect();
        Self { edges, pair_weight: params.lambda / params.neighbours.max(1) as f64 }
    }

    /// The energy of `chosen` (one candidate number a place; places without candidates are left
    /// out), per place.
    pub fn energy(&self, candidates: &[Vec<Candidate>], chosen: &[usize]) -> f64 {
        let pick = |i: usize| candidates[i].get(chosen[i]);
        let (mut sum, mut places) = (0.0, 0usize);
        for (i, edges) in self.edges.iter().enumerate() {
            let Some(c) = pick(i) else { continue };
            places += 1;
            sum += 1.0 - f64::from(c.ncc);
            for &(j, allowed) in edges {
                if let Some(o) = pick(j) {
                    sum += self.pair_weight * penalty(c.displacement.0, o.displacement.0, allowed);
                }
            }
        }
        sum / places.max(1) as f64
    }
}

/// Distance of two vectors.
pub fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f64>().sqrt()
}

/// The bounded pair term, 0 to 1.
#[inline(always)]
pub fn penalty(a: [f64; 3], b: [f64; 3], allowed: f64) -> f64 {
    let d2: f64 = (0..3).map(|c| (a[c] - b[c]).powi(2)).sum();
    (d2 / (allowed * allowed)).min(1.0)
}
