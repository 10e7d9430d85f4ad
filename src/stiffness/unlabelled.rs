//! A map of ln mu without labels, and the regions that it falls into.
//!
//! ln mu is trilinear on a lattice of nodes over the body. Gauss-Newton with exact sensitivities
//! minimises the misfit plus kappa times the total variation along the lattice's edges (smoothed
//! absolute differences, reweighted each iteration; Vogel and Oman 1996); kappa falls until the
//! residual is that of the noise (discrepancy principle, Morozov 1966). Total variation loses
//! contrast, so the map only tells *where*: the piece that stands out most becomes a region, whose
//! modulus is then identified as if it had been labelled, and the next map is of what is beyond it.

use crate::error::StiffnessError;
use crate::numerics::cholesky::Cholesky;
use crate::numerics::filters::gaussian;
use crate::numerics::statistics::percentile;
use crate::stiffness::boundary_conditions::Patch;
use crate::stiffness::identify::{Setup, State};
use crate::stiffness::observations::Observation;
use crate::types::Mask;
use crate::types::space::dot;
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Identification of a map of moduli with total variation.
struct MapControl {
    /// Most lattice nodes.
    max_nodes: f64,
    /// Most observations.
    max_observations: usize,
    /// Difference of ln mu between nodes up to which total variation is smoothed.
    smooth_step_ln: f64,
    /// Most iterations.
    max_iterations: usize,
}

const MAP_CONTROL: MapControl =
    MapControl { max_nodes: 420.0, max_observations: 5000, smooth_step_ln: 0.05, max_iterations: 9 };

/// How regions are found in the map.
struct Segmentation {
    /// Smoothing of a region's border (lattice steps, one Gaussian standard deviation).
    rounding_steps: f64,
    /// Percentile of the map that stands for its extreme value: a hundredth of the body may be
    /// artefacts in corners.
    extreme_percentile: f64,
    /// Most pieces of the map that are tried as the next region.
    max_pieces: usize,
    /// Value at a region's border over the extreme one: total variation flattens a region, and its
    /// border lies about there.
    edge_fraction: f64,
    /// Smallest region, as a part of the body.
    min_body_fraction: f64,
}

const SEGMENTATION: Segmentation = Segmentation {
    rounding_steps: 0.4,
    extreme_percentile: 99.0,
    max_pieces: 3,
    edge_fraction: 0.4,
    min_body_fraction: 0.004,
};

/// Columns that one thread multiplies at a time.
const PRODUCT_STRIP: usize = 48;

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
        let size = (volume / (0.6 * MAP_CONTROL.max_nodes)).cbrt();
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

    /// Places of the used nodes (mm, RAS).
    fn places(&self) -> Vec<[f64; 3]> {
        let place = |o: usize| {
            let at = [o % self.count[0], o / self.count[0] % self.count[1], o / (self.count[0] * self.count[1])];
            std::array::from_fn(|a| self.low[a] + self.size * at[a] as f64)
        };
        (0..self.number.len()).filter(|&o| self.number[o] != u32::MAX).map(place).collect()
    }

    /// The function that is 1 within a ball (mm) and 0 around it, by the means of the lattice's own
    /// functions over it; none where the ball reaches past the lattice.
    fn ball(&self, middle: [f64; 3], radius: f64) -> Option<BTreeMap<u32, f64>> {
        let volume = 4.0 / 3.0 * std::f64::consts::PI * radius.powi(3);
        let share = volume / self.size.powi(3) / BALLS.samples as f64;
        let mut out = BTreeMap::new();
        for k in 0..BALLS.samples {
            // Evenly over the ball: shells of one volume, turned by the golden angle.
            let t = (k as f64 + 0.5) / BALLS.samples as f64;
            let (height, turn) = (1.0 - 2.0 * ((k as f64 * 0.618_034).fract()), k as f64 * 2.399_963);
            let (r, flat) = (radius * t.cbrt(), (1.0 - height * height).sqrt());
            let d = [flat * turn.cos(), flat * turn.sin(), height].map(|v| r * v);
            let place: [f64; 3] = std::array::from_fn(|a| middle[a] + d[a]);
            for (node, w) in self.corners(place) {
                let number = self.number[node];
                if w > 1e-9 && number == u32::MAX {
                    return None;
                }
                *out.entry(number).or_insert(0.0) += share * w;
            }
            let past = (0..3).any(|a| {
                let q = (place[a] - self.low[a]) / self.size;
                q < 0.0 || q > (self.count[a] - 1) as f64
            });
            if past {
                return None;
            }
        }
        out.remove(&u32::MAX);
        Some(out.into_iter().map(|(node, w)| (node, w.min(1.0))).collect())
    }

    /// The function at a place.
    pub fn at(&self, values: &[f64], p: [f64; 3]) -> f64 {
        self.weights(p).iter().map(|&(n, w)| w * values[n as usize]).sum()
    }
}

/// What a map is made from.
struct Basis {
    lattice: Lattice,
    /// Nodes and weights at the middle of each element.
    weights: Vec<Vec<(u32, f64)>>,
    /// Observations that are used.
    picked: Vec<Observation>,
}

impl Basis {
    fn new(setup: &Setup<'_>) -> Self {
        let body = setup.body;
        let middle = |c: &[u32; 10]| -> [f64; 3] {
            std::array::from_fn(|a| (0..4).map(|i| body.places[c[i] as usize][a]).sum::<f64>() / 4.0)
        };
        let lattice = Lattice::new(&body.places, body.volumes.iter().sum());
        let weights = body.cells.iter().map(|c| lattice.weights(middle(c))).collect();
        let step = setup.observations.len().div_ceil(MAP_CONTROL.max_observations).max(1);
        let picked = setup.observations.iter().step_by(step).cloned().collect();
        Self { lattice, weights, picked }
    }
}

/// Balls whose detection limit is reported.
struct Balls {
    /// Diameters over the body's least extent.
    diameter_fractions: [f64; 3],
    /// Places in a ball over which the lattice's functions are averaged.
    samples: usize,
}

const BALLS: Balls = Balls { diameter_fractions: [0.25, 0.35, 0.5], samples: 200 };

/// For balls of some diameters (mm): what one moves, the plates fitted again, for a unit of ln mu
/// (mm, root mean square of one component), where it moves less than in three of four places.
///
/// # Errors
/// As [`Setup::run`].
pub(crate) fn shown_by_balls(setup: &Setup<'_>, identified: &State) -> Result<Vec<(f64, f64)>, StiffnessError> {
    let Basis { lattice, weights, picked } = Basis::new(setup);
    let problem = setup.problem(identified);
    let solution = problem.solve(identified.x.as_deref(), 1e-4)?;
    let all = jacobian(setup, &problem, &solution, &weights, &picked, lattice.used)?;
    let (rows, used) = (3 * picked.len(), lattice.used);
    let column = |k: usize| &all[k * rows..(k + 1) * rows];
    let plates = orthonormal((used..all.len() / rows).map(|k| column(k).to_vec()));
    let extent = (0..3).map(|a| {
        let at = setup.body.places.iter().map(|p| p[a]);
        at.clone().fold(f64::NEG_INFINITY, f64::max) - at.fold(f64::INFINITY, f64::min)
    });
    let least = extent.fold(f64::INFINITY, f64::min);
    let of = |diameter: f64| {
        let moved = |middle: [f64; 3]| {
            let parts = lattice.ball(middle, 0.5 * diameter)?;
            let mut sum = vec![0.0; rows];
            for (node, w) in parts {
                sum.iter_mut().zip(column(node as usize)).for_each(|(s, v)| *s += w * v);
            }
            for plate in &plates {
                let along: f64 = sum.iter().zip(plate).map(|(s, p)| s * p).sum();
                sum.iter_mut().zip(plate).for_each(|(s, p)| *s -= along * p);
            }
            Some((sum.iter().map(|v| v * v).sum::<f64>() / rows as f64).sqrt())
        };
        let mut found: Vec<f64> = lattice.places().into_par_iter().filter_map(moved).collect();
        (!found.is_empty()).then(|| (diameter, percentile(&mut found, 25.0)))
    };
    Ok(BALLS.diameter_fractions.into_iter().filter_map(|part| of(part * least)).collect())
}

/// The vectors made orthogonal to each other, each of length 1; those that add nothing left out.
fn orthonormal(vectors: impl Iterator<Item = Vec<f64>>) -> Vec<Vec<f64>> {
    let mut out: Vec<Vec<f64>> = Vec::new();
    for mut v in vectors {
        let whole = v.iter().map(|x| x * x).sum::<f64>().sqrt();
        for b in out.iter().chain(&out) {
            let along: f64 = v.iter().zip(b).map(|(x, y)| x * y).sum();
            v.iter_mut().zip(b).for_each(|(x, y)| *x -= along * y);
        }
        let left = v.iter().map(|x| x * x).sum::<f64>().sqrt();
        if left > 1e-6 * whole {
            out.push(v.into_iter().map(|x| x / left).collect());
        }
    }
    out
}

/// The map: lattice and ln mu at its nodes, mean zero.
#[derive(Debug)]
pub struct Map {
    /// The lattice.
    pub lattice: Lattice,
    /// ln mu.
    pub values: Vec<f64>,
}

/// Finds the map of ln mu beyond that of the regions, from the state in which these are identified.
/// `target` (mm, one component) is the residual that ends the search.
///
/// # Errors
/// As [`Setup::run`].
pub fn map(setup: &Setup<'_>, identified: &State, target: f64) -> Result<Map, StiffnessError> {
    let body = setup.body;
    let Basis { lattice, weights, picked } = Basis::new(setup);
    let used = lattice.used;
    let plates: usize = setup.patches.iter().map(Patch::parameters).sum();
    let p = used + plates;
    let mut values = vec![0.0; used];
    let mut state = identified.clone();
    let (mut kappa, mut best): (f64, Option<(f64, Vec<f64>)>) = (0.0, None);
    for iteration in 0..MAP_CONTROL.max_iterations {
        let mut problem = setup.problem(&state);
        for (m, w) in problem.materials.iter_mut().zip(&weights) {
            m.mu *= w.iter().map(|&(n, w)| w * values[n as usize]).sum::<f64>().exp();
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
        if rms <= target || iteration + 1 == MAP_CONTROL.max_iterations {
            break;
        }
        let jacobian = jacobian(setup, &problem, &solution, &weights, &picked, used)?;
        let variance = target * target;
        let rows = 3 * picked.len();
        let normal = normal_matrix(&jacobian, rows, 1.0 / variance);
        let right: Vec<f64> = (0..p)
            .into_par_iter()
            .map(|k| {
                let column = &jacobian[k * rows..(k + 1) * rows];
                column.iter().zip(residuals.as_flattened()).map(|(a, b)| a * b).sum::<f64>() / variance
            })
            .collect();
        let mean = (0..used).map(|k| normal[k * p + k]).sum::<f64>() / used as f64;
        if iteration == 0 {
            // A step of one in ln mu across an edge weighs as much as what one node can explain.
            kappa = 0.03 * mean;
        } else {
            kappa *= 0.4;
        }
        let (mut a, mut b) = (normal, right);
        for &(i, j) in &lattice.pairs {
            let (i, j) = (i as usize, j as usize);
            let difference = values[i] - values[j];
            let w = kappa / (difference * difference + MAP_CONTROL.smooth_step_ln * MAP_CONTROL.smooth_step_ln).sqrt();
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
    let values = best.map_or(values, |best| best.1);
    Ok(Map { lattice, values })
}

/// `scale` times the products of all columns of `rows` numbers with each other, row by row.
fn normal_matrix(columns: &[f64], rows: usize, scale: f64) -> Vec<f64> {
    let p = columns.len() / rows;
    let mut out = vec![0.0; p * p];
    out.par_chunks_mut(PRODUCT_STRIP * p).enumerate().for_each(|(strip, out)| {
        let (first, own) = (strip * PRODUCT_STRIP, out.len() / p);
        let of = |from: usize, to: usize| {
            faer::MatRef::from_column_major_slice(&columns[from * rows..to * rows], rows, to - from)
        };
        let last = first + own;
        let out = faer::MatMut::from_column_major_slice_mut(out, p, own).subrows_mut(0, last);
        let (left, right) = (of(0, last).transpose(), of(first, last));
        faer::linalg::matmul::matmul(out, faer::Accum::Replace, left, right, scale, faer::Par::Seq);
    });
    for r in 0..p {
        for c in r + 1..p {
            out[r * p + c] = out[c * p + r];
        }
    }
    out
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
    solution.factor.many(&mut sides, n).map_err(|_| StiffnessError::Unsolvable)?;
    Ok(sides.par_chunks(n).flat_map_iter(|y| picked.iter().flat_map(move |o| o.read(body, y))).collect())
}

/// `labels` with one region more, taken from the first one: the pieces of it in which the map lies
/// far above or below its middle value, the ones that weigh most first.
pub(crate) fn next_regions(map: &Map, labels: &Mask) -> Vec<Mask> {
    let grid = *labels.grid();
    let inside: Vec<usize> = (0..grid.len()).filter(|&o| labels.as_slice()[o] > 0).collect();
    let value = |&o: &usize| {
        let [i, j, k] = grid.voxel(o);
        map.lattice.at(&map.values, grid.world(i, j, k).0)
    };
    let values: Vec<f64> = inside.par_iter().map(value).collect();
    let middle = percentile(&mut values.clone(), 50.0);
    let mut pieces: Vec<(f64, Vec<usize>)> = Vec::new();
    for sign in [1.0, -1.0] {
        let above: Vec<f64> = values.iter().map(|v| sign * (v - middle)).collect();
        let limit = SEGMENTATION.edge_fraction * percentile(&mut above.clone(), SEGMENTATION.extreme_percentile);
        if limit <= 0.0 {
            continue;
        }
        let mut near = vec![u8::MAX; grid.len()];
        let mut weight = vec![0.0; grid.len()];
        for (&o, v) in inside.iter().zip(&above).filter(|(o, v)| labels.as_slice()[**o] == 1 && **v > limit) {
            (near[o], weight[o]) = (0, v * v);
        }
        let (piece, sizes) = connected(&near, grid.shape());
        let mut found: Vec<(f64, Vec<usize>)> = vec![(0.0, Vec::new()); sizes.len()];
        for o in inside.iter().copied().filter(|&o| near[o] == 0) {
            let own = &mut found[piece[o] as usize];
            own.0 += weight[o];
            own.1.push(o);
        }
        pieces.extend(
            found.into_iter().filter(|p| p.1.len() as f64 >= SEGMENTATION.min_body_fraction * inside.len() as f64),
        );
    }
    pieces.sort_by(|a, b| b.0.total_cmp(&a.0));
    pieces.truncate(SEGMENTATION.max_pieces);
    pieces.iter().filter_map(|(_, piece)| with_region(map, labels, piece)).collect()
}

/// `labels` with a piece of the first region as one more, rounded.
fn with_region(map: &Map, labels: &Mask, piece: &[usize]) -> Option<Mask> {
    let grid = *labels.grid();
    let next = labels.as_slice().iter().copied().max()?.checked_add(1)?;
    let mut drawn = labels.as_slice().to_vec();
    piece.iter().for_each(|&o| drawn[o] = next);
    let sigma = grid.spacing().map(|s| SEGMENTATION.rounding_steps * map.lattice.size / s);
    let round = rounded(&drawn, grid.shape(), sigma, usize::from(next));
    // The regions that are there keep their shapes.
    let kept = |(old, new): (&u8, &u8)| if *old == 1 && *new == next { next } else { *old };
    let out: Vec<u8> = labels.as_slice().iter().zip(&round).map(kept).collect();
    (out.contains(&next) && out.contains(&1)).then(|| Mask::from_vec(grid, out).ok()).flatten()
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
