//! Choice of one candidate for each place by mean-field relaxation.
//!
//! Each place holds a probability over its candidates; in every round it becomes
//! `exp(-beta (1 - ncc + expected pair terms))`, normalised (relaxation labelling, Rosenfeld,
//! Hummel & Zucker 1976; mean field annealing, Geiger & Girosi 1991), while `beta` grows. All
//! places are updated from the round before, so the result does not depend on order or threads. A
//! local minimum: the energy is given before and after.

use crate::consistency::energy::{Graph, penalty};
use crate::types::Candidate;
use rayon::prelude::*;

/// What relaxation gives.
#[derive(Debug, Clone, PartialEq)]
pub struct Relaxed {
    /// Chosen candidate of each place (0 where there is none).
    pub chosen: Vec<usize>,
    /// Its probability (0 where there is none).
    pub confidence: Vec<f64>,
    /// Energy a place of the best correlations.
    pub energy_before: f64,
    /// Energy a place of the choice.
    pub energy_after: f64,
}

/// Inverse temperature of each iteration: the assignment goes from undecided to decided.
const INVERSE_TEMPERATURES: [f64; 12] = [4.0, 4.0, 6.0, 6.0, 9.0, 9.0, 13.0, 13.0, 20.0, 20.0, 30.0, 30.0];

/// Probability below which a candidate does not influence its neighbours.
const MIN_PROBABILITY: f64 = 1e-6;

/// Relaxes the candidates (each list best correlation first).
///
/// ```
/// use palpate::consistency::energy::{EnergyParams, Graph};
/// use palpate::consistency::relaxation::relax;
/// use palpate::{Candidate, GridVector};
/// let places: Vec<[f64; 3]> = (0..8).map(|i| [f64::from(i), 0.0, 0.0]).collect();
/// let graph = Graph::new(
///     &places,
///     EnergyParams { lambda: 1.5, precision_mm: 1.0, strain: 0.3, neighbours: 4 },
/// );
/// let to = |x, ncc| Candidate { displacement: GridVector([x, 0.0, 0.0]), ncc };
/// // Everything moves by 2 mm; the third place has a false candidate that correlates better.
/// let mut candidates = vec![vec![to(2.0, 0.9)]; 8];
/// candidates[3] = vec![to(-7.0, 0.95), to(2.0, 0.9)];
/// let relaxed = relax(&graph, &candidates);
/// assert_eq!(relaxed.chosen[3], 1);
/// assert!(relaxed.energy_after < relaxed.energy_before);
/// ```
pub fn relax(graph: &Graph, candidates: &[Vec<Candidate>]) -> Relaxed {
    let mut q: Vec<Vec<f64>> =
        candidates.iter().map(|list| softmax(list.iter().map(|c| -8.0 * (1.0 - f64::from(c.ncc))))).collect();
    for beta in INVERSE_TEMPERATURES {
        // Most places have one or two candidates left after a few rounds.
        let likely: Vec<Vec<([f64; 3], f64)>> = candidates
            .iter()
            .zip(&q)
            .map(|(list, q)| {
                list.iter().zip(q).filter(|(_, p)| **p > MIN_PROBABILITY).map(|(c, p)| (c.displacement.0, *p)).collect()
            })
            .collect();
        q = candidates
            .par_iter()
            .zip(&graph.edges)
            .map(|(list, edges)| {
                softmax(list.iter().map(|c| {
                    let pairs: f64 = edges
                        .iter()
                        .map(|&(j, allowed)| {
                            likely[j].iter().map(|(o, p)| p * penalty(c.displacement.0, *o, allowed)).sum::<f64>()
                        })
                        .sum();
                    // Each pair stands in two sums of the energy.
                    -beta * (1.0 - f64::from(c.ncc) + 2.0 * graph.pair_weight * pairs)
                }))
            })
            .collect();
    }
    let best = |p: &Vec<f64>| (0..p.len()).max_by(|&a, &b| p[a].total_cmp(&p[b]).then(b.cmp(&a))).unwrap_or(0);
    let mut chosen: Vec<usize> = q.iter().map(best).collect();
    let first = vec![0; chosen.len()];
    let energy_before = graph.energy(candidates, &first);
    let mut energy_after = graph.energy(candidates, &chosen);
    if energy_after > energy_before {
        (chosen, energy_after) = (first, energy_before);
    }
    let confidence = chosen.iter().zip(&q).map(|(&c, q)| q.get(c).copied().unwrap_or(0.0)).collect();
    Relaxed { chosen, confidence, energy_before, energy_after }
}

fn softmax(logs: impl Iterator<Item = f64>) -> Vec<f64> {
    let logs: Vec<f64> = logs.collect();
    let top = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let raw: Vec<f64> = logs.iter().map(|l| (l - top).exp()).collect();
    let sum: f64 = raw.iter().sum();
    raw.iter().map(|v| v / sum).collect()
}
