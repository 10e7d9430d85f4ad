//! A map of ln mu without labels, and the regions that it falls into.
//!
//! ln mu is trilinear on a lattice of nodes over the body. Gauss-Newton with exact sensitivities
//! minimises the misfit plus kappa times the total variation along the lattice's edges (smoothed
//! absolute differences, reweighted each iteration; Vogel and Oman 1996); kappa falls until the
//! residual is that of the noise (discrepancy principle, Morozov 1966). Total variation loses
//! contrast, so the map only tells *where*: it is cut into connected regions, whose moduli are then
//! identified as if they had been labelled.

use crate::error::StiffnessError;
use crate::numerics::cholesky::Cholesky;
use crate::numerics::filters::gaussian;
use crate::stiffness::identify::{Setup, State};
use crate::stiffness::observations::Observation;
use crate::types::space::dot;
use crate::types::{Mask, VoxelPoint};
use rayon::prelude::*;

/// Lattice nodes at most.
const NODES: f64 = 420.0;
/// Observations used for the map.
const SAMPLES: usize = 5000;
/// Differences of ln mu under this count as smooth.
const SMOOTH: f64 = 0.05;
/// Iterations at most.
const ITERATIONS: usize = 9;
/// Standard deviation of the Gaussian that rounds regions (lattice steps).
const ROUND: f64 = 0.4;
/// Parts of the body smaller than this are no region of their own.
const SMALLEST: f64 = 0.004;

/// A trilinear function on a lattice (grid of `count` nodes from `low`, `size` mm apart; mm, RAS).
#[derive(Debug, Clone)]
pub struct Lattice {
    low: [f64; 3],
    size: f64,
    count: [usize; 3],
    /// Number of each lattice node among those that are used.
    number: Vec<u32>,
    used: usize,
    /// Pairs of neighbours.
    pairs: Vec<(u32, u32)>,
}

impl Lattice {
    /// Over places with a volume.
    pub fn new(places: &[[f64; 3]], volume: f64) -> Self {
        let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for p in places {
            for a in 0..3 {
                low[a] = low[a].min(p[a]);
                high[a] = high[a].max(p[a]);
            }
        }
        // The outer layer adds nodes: aim lower inside.
        let size = (volume / (0.6 * NODES)).cbrt();
        let count = std::array::from_fn(|a| ((high[a] - low[a]) / size).ceil() as usize + 1);
        let low = std::array::from_fn(|a| 0.5 * (low[a] + high[a]) - 0.5 * size * (count[a] - 1) as f64);
        let mut out =
            Self { low, size, count, number: vec![u32::MAX; count.iter().product()], used: 0, pairs: Vec::new() };
        for p in places {
            for (node, w) in out.corners(*p) {
                if w > 1e-9 {
                    out.number[node] = 0;
                }
            }
        }
        for n in &mut out.number {
            if *n == 0 {
                *n = out.used as u32;
                out.used += 1;
            }
        }
        let stride = [1, count[0], count[0] * count[1]];
        for o in 0..out.number.len() {
            let at = [o % count[0], o / count[0] % count[1], o / (count[0] * count[1])];
            for a in 0..3 {
                if at[a] + 1 < count[a] {
                    let (i, j) = (out.number[o], out.number[o + stride[a]]);
                    if i != u32::MAX && j != u32::MAX {
                        out.pairs.push((i, j));
                    }
                }
            }
        }
        out
    }

    fn corners(&self, p: [f64; 3]) -> [(usize, f64); 8] {
        let mut base = [0; 3];
        let mut t = [0.0; 3];
        for a in 0..3 {
            let q = ((p[a] - self.low[a]) / self.size).clamp(0.0, (self.count[a] - 1) as f64);
            base[a] = (q as usize).min(self.count[a].saturating_sub(2));
            t[a] = q - base[a] as f64;
        }
        std::array::from_fn(|c| {
            let up = [c & 1, c >> 1 & 1, c >> 2];
            let at = |a: usize| (base[a] + up[a]).min(self.count[a] - 1);
            let weight = (0..3).map(|a| if up[a] == 1 { t[a] } else { 1.0 - t[a] }).product();
            (at(0) + self.count[0] * (at(1) + self.count[1] * at(2)), weight)
        })
    }

    /// Used nodes and weights at a place.
    fn weights(&self, p: [f64; 3]) -> Vec<(u32, f64)> {
        let all =
            self.corners(p).into_iter().map(|(n, w)| (self.number[n], w)).filter(|c| c.0 != u32::MAX && c.1 > 0.0);
        let kept: Vec<(u32, f64)> = all.collect();
        let sum: f64 = kept.iter().map(|c| c.1).sum();
        kept.into_iter().map(|(n, w)| (n, w / sum.max(1e-12))).collect()
    }

    /// The function at a place.
    pub fn at(&self, values: &[f64], p: [f64; 3]) -> f64 {
        self.weights(p).iter().map(|&(n, w)| w * values[n as usize]).sum()
    }
}

/// The map: lattice and ln mu at its nodes, mean zero.
#[derive(Debug)]
pub struct Map {
    /// The lattice.
    pub lattice: Lattice,
    /// ln mu.
    pub values: Vec<f64>,
    /// Root mean square residual with it (mm, one component).
    pub rms: f64,
}

/// Finds the map from a homogeneous state. `target` (mm, one component) is the residual that ends
/// the search.
///
/// # Errors
/// As [`Setup::run`].
pub fn map(setup: &Setup<'_>, homogeneous: &State, target: f64) -> Result<Map, StiffnessError> {
    let body = setup.body;
    let centres: Vec<[f64; 3]> = body
        .cells
        .iter()
        .map(|c| std::array::from_fn(|a| (0..4).map(|i| body.places[c[i] as usize][a]).sum::<f64>() / 4.0))
        .collect();
    let lattice = Lattice::new(&body.places, body.volumes.iter().sum());
    let weights: Vec<Vec<(u32, f64)>> = centres.iter().map(|&c| lattice.weights(c)).collect();
    let used = lattice.used;
    let step = setup.observations.len().div_ceil(SAMPLES).max(1);
    let picked: Vec<Observation> = setup.observations.iter().step_by(step).cloned().collect();
    let plates = setup.patches[0].parameters() + setup.patches[1].parameters();
    let p = used + plates;
    let mut values = vec![0.0; used];
    let mut state = homogeneous.clone();
    let (mut kappa, mut best): (f64, Option<(f64, Vec<f64>)>) = (0.0, None);
    for iteration in 0..ITERATIONS {
        let mut problem = setup.problem(&state);
        for (m, w) in problem.materials.iter_mut().zip(&weights) {
            m.mu = w.iter().map(|&(n, w)| w * values[n as usize]).sum::<f64>().exp();
        }
        let solution = problem.solve(state.x.as_deref(), 1e-4)?;
        let residuals: Vec<[f64; 3]> = picked
            .iter()
            .map(|o| {
                let u = o.read(body, &solution.x);
                std::array::from_fn(|a| o.displacement[a] - u[a])
            })
            .collect();
        let rms = (residuals.iter().map(|r| dot(*r, *r)).sum::<f64>() / (3.0 * residuals.len() as f64)).sqrt();
        if best.as_ref().is_none_or(|b| rms < b.0) {
            best = Some((rms, values.clone()));
        }
        if rms <= target || iteration + 1 == ITERATIONS {
            break;
        }
        let jacobian = jacobian(setup, &problem, &solution, &weights, &picked, used)?;
        let variance = target * target;
        let rows = 3 * picked.len();
        let flat = faer::MatRef::from_column_major_slice(&jacobian, rows, p);
        let mut normal = faer::Mat::<f64>::zeros(p, p);
        faer::linalg::matmul::matmul(
            normal.as_mut(),
            faer::Accum::Replace,
            flat.transpose(),
            flat,
            1.0 / variance,
            faer::Par::Seq,
        );
        let right: Vec<f64> = (0..p)
            .into_par_iter()
            .map(|k| {
                let column = &jacobian[k * rows..(k + 1) * rows];
                column.iter().zip(residuals.as_flattened()).map(|(a, b)| a * b).sum::<f64>() / variance
            })
            .collect();
        let mean = (0..used).map(|k| normal[(k, k)]).sum::<f64>() / used as f64;
        if iteration == 0 {
            // A step of one in ln mu across an edge weighs as much as what one node can explain.
            kappa = 0.3 * mean * SMOOTH.max(0.1);
        } else {
            kappa *= 0.4;
        }
        let mut a: Vec<f64> = (0..p * p).map(|i| normal[(i / p, i % p)]).collect();
        let mut b = right;
        for &(i, j) in &lattice.pairs {
            let (i, j) = (i as usize, j as usize);
            let difference = values[i] - values[j];
            let w = kappa / (difference * difference + SMOOTH * SMOOTH).sqrt();
            a[i * p + i] += w;
            a[j * p + j] += w;
            a[i * p + j] -= w;
            a[j * p + i] -= w;
            b[i] -= w * difference;
            b[j] += w * difference;
        }
        for k in 0..used {
            // ln mu is known up to a constant: keep it near zero.
            a[k * p + k] += 1e-5 * mean;
            b[k] -= 1e-5 * mean * values[k];
        }
        let prior = setup.plate_prior.powi(-2);
        let now: Vec<f64> = state.plates.iter().flatten().copied().collect();
        for k in 0..plates {
            a[(used + k) * p + used + k] += prior;
            b[used + k] -= prior * now[k];
        }
        let Some(factor) = Cholesky::new(a, p) else { break };
        factor.solve(&mut b);
        let longest = b[..used].iter().fold(0.0, |m: f64, v| m.max(v.abs()));
        let part = if longest > 1.0 { 1.0 / longest } else { 1.0 };
        values.iter_mut().zip(&b).for_each(|(v, s)| *v = (*v + part * s).clamp(-5.0, 5.0));
        for (c, s) in state.plates.iter_mut().flatten().zip(&b[used..]) {
            *c += part * s;
        }
        let shift = values.iter().sum::<f64>() / used as f64;
        values.iter_mut().for_each(|v| *v -= shift);
        state.x = Some(solution.x);
    }
    let (rms, values) = best.unwrap_or((f64::INFINITY, values));
    Ok(Map { lattice, values, rms })
}

/// Rows of H y, column by column: lattice nodes, then plates.
fn jacobian(
    setup: &Setup<'_>,
    problem: &crate::stiffness::forward::Problem<'_>,
    solution: &crate::stiffness::forward::Solution<'_>,
    weights: &[Vec<(u32, f64)>],
    picked: &[Observation],
    used: usize,
) -> Result<Vec<f64>, StiffnessError> {
    use crate::stiffness::law::residual_by_modulus;
    let (body, n) = (setup.body, setup.body.pattern.unknowns());
    let mut sides = vec![0.0; used * n];
    for e in 0..body.cells.len() {
        let x = body.gather(&solution.x, e);
        let r = residual_by_modulus(setup.law, &body.quadrature[e], problem.materials[e], &x);
        let r = r.ok_or(StiffnessError::InsideOut)?;
        for &(node, w) in &weights[e] {
            let part = r.map(|v| -w * v);
            body.scatter(&mut sides[node as usize * n..(node as usize + 1) * n], e, &part);
        }
    }
    sides.extend(setup.plate_sides(problem, &solution.x));
    let factor = solution.factor.whole().map_err(|_| StiffnessError::Unsolvable)?;
    sides
        .par_chunks_mut(32 * n)
        .map(|part| factor.solve(part).map_err(|_| StiffnessError::Unsolvable))
        .collect::<Result<(), _>>()?;
    Ok(sides.par_chunks(n).flat_map_iter(|y| picked.iter().flat_map(move |o| o.read(body, y))).collect())
}

/// The body's voxels in `wanted` regions of like ln mu: k-means of the map at the voxels in so many
/// `classes`, then the largest connected pieces. Label 1 is the largest region. None when fewer
/// come out.
pub fn regions(map: &Map, body: &Mask, classes: usize, wanted: usize) -> Option<Mask> {
    let grid = *body.grid();
    let inside: Vec<usize> = (0..grid.len()).filter(|&o| body.as_slice()[o] > 0).collect();
    let value = |&o: &usize| {
        let [i, j, k] = grid.voxel(o);
        let p = grid.affine().to_world(VoxelPoint([i as f64, j as f64, k as f64]));
        map.lattice.at(&map.values, p.0)
    };
    let values: Vec<f64> = inside.par_iter().map(value).collect();
    let centres = means(&values, classes);
    let class =
        |v: f64| (0..centres.len()).fold(0, |m, k| if (v - centres[k]).abs() < (v - centres[m]).abs() { k } else { m });
    let mut classes = vec![u8::MAX; grid.len()];
    inside.iter().zip(&values).for_each(|(&o, &v)| classes[o] = class(v) as u8);
    let pieces = connected(&classes, grid.shape());
    let smallest = (SMALLEST * inside.len() as f64) as usize;
    let mut large: Vec<(usize, usize)> =
        pieces.1.iter().enumerate().filter(|(_, n)| **n > smallest).map(|(i, &n)| (n, i)).collect();
    large.sort_by(|a, b| b.cmp(a));
    if large.len() < wanted {
        return None;
    }
    large.truncate(wanted);
    let mut labels = vec![0u8; grid.len()];
    for &o in &inside {
        let at = large.iter().position(|l| l.1 == pieces.0[o] as usize);
        labels[o] = at.map_or(1, |k| k as u8 + 1);
    }
    let sigma = grid.spacing().map(|s| ROUND * map.lattice.size / s);
    let labels = rounded(&labels, grid.shape(), sigma, wanted);
    (1..=wanted as u8).all(|l| labels.contains(&l)).then(|| Mask::from_vec(grid, labels).ok()).flatten()
}

/// Each voxel takes the label that weighs most in a Gaussian around it: the map cannot tell spikes
/// from noise.
fn rounded(labels: &[u8], shape: [usize; 3], sigma: [f64; 3], count: usize) -> Vec<u8> {
    let mut best = vec![(0.0f32, 0u8); labels.len()];
    for label in 1..=count as u8 {
        let own: Vec<f32> = labels.iter().map(|&l| f32::from(u8::from(l == label))).collect();
        let near = gaussian(&own, shape, sigma);
        best.iter_mut().zip(near).for_each(|(b, v)| {
            if v > b.0 {
                *b = (v, label);
            }
        });
    }
    labels.iter().zip(best).map(|(&l, b)| if l == 0 { 0 } else { b.1 }).collect()
}

/// Centres of `count` classes on a line (Lloyd's iteration from even quantiles of the range).
fn means(values: &[f64], count: usize) -> Vec<f64> {
    let (low, high) = values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), &v| (l.min(v), h.max(v)));
    let mut centres: Vec<f64> = (0..count).map(|k| low + (high - low) * (k as f64 + 0.5) / count as f64).collect();
    for _ in 0..50 {
        let mut sums = vec![(0.0, 0.0); count];
        for &v in values {
            let k = (0..count).fold(0, |m, k| if (v - centres[k]).abs() < (v - centres[m]).abs() { k } else { m });
            sums[k].0 += v;
            sums[k].1 += 1.0;
        }
        for (c, s) in centres.iter_mut().zip(sums) {
            if s.1 > 0.0 {
                *c = s.0 / s.1;
            }
        }
    }
    centres
}

/// Number of each voxel's face-connected piece of one class, and their sizes.
fn connected(classes: &[u8], shape: [usize; 3]) -> (Vec<u32>, Vec<usize>) {
    let stride = [1, shape[0], shape[0] * shape[1]];
    let mut piece = vec![u32::MAX; classes.len()];
    let mut sizes = Vec::new();
    for start in 0..classes.len() {
        if classes[start] == u8::MAX || piece[start] != u32::MAX {
            continue;
        }
        let number = sizes.len() as u32;
        piece[start] = number;
        let (mut stack, mut count) = (vec![start], 0);
        while let Some(o) = stack.pop() {
            count += 1;
            let at = [o % shape[0], o / shape[0] % shape[1], o / (shape[0] * shape[1])];
            for a in 0..3 {
                let up = (at[a] + 1 < shape[a]).then(|| o + stride[a]);
                let down = (at[a] > 0).then(|| o - stride[a]);
                for q in up.into_iter().chain(down) {
                    if classes[q] == classes[o] && piece[q] == u32::MAX {
                        piece[q] = number;
                        stack.push(q);
                    }
                }
            }
        }
        sizes.push(count);
    }
    (piece, sizes)
}
