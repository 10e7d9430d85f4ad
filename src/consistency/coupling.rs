//! Coupling of local evidence through a smooth field: each place pulls with its own information
//! matrix, the bending energy of a spline lattice holds the places together.

use crate::numerics::ablation;
use crate::numerics::bending::{Coupled, Smoothness, SolveReport};
use crate::numerics::block_diagonal::Blocks;
use crate::numerics::bspline::{Lattice, Stencil};
use crate::numerics::filters;
use crate::numerics::random::Random;
use crate::numerics::symmetric3::{Symmetric3, cholesky_solve, multiply, quadratic};
use crate::types::{GridVector, VoxelPoint};
use rayon::prelude::*;

/// One Gauss-Newton step from `coefficients` `c`: the `d` that minimises
/// `1/2 d.A d - b.d + 1/2 (c + d).L (c + d)` with `A` and `L` the two parts of `matrix` (data and
/// smoothness), and its root mean square length. `rhs` is `b`.
pub fn step(
    matrix: &Coupled<'_>,
    mut rhs: Vec<f32>,
    coefficients: &[f32],
    tolerance: f64,
    limit: usize,
) -> (SolveReport, Vec<f32>, f32) {
    let n = coefficients.len() / 3;
    let mut lc = vec![0.0f32; n];
    for ((c, b), weight) in
        coefficients.chunks_exact(n).zip(rhs.chunks_exact_mut(n)).zip(matrix.weights().chunks_exact(n))
    {
        matrix.smoothness().apply(weight, c, &mut lc);
        b.iter_mut().zip(&lc).for_each(|(b, l)| *b -= l);
    }
    drop(lc);
    let mut d = vec![0.0f32; 3 * n];
    let report = matrix.solve(rhs, &mut d, tolerance, limit);
    let moved = d.iter().map(|d| f64::from(d * d)).sum::<f64>();
    (report, d, (moved / n as f64).sqrt() as f32)
}

/// Weight of the lattice's mean smoothness beside that of the local window (dimensionless).
/// Calibrated: docs/lab/2026-11-local-signal.md.
const GLOBAL_SMOOTHNESS_WEIGHT: f32 = 0.02;

/// Width of the window in which smoothness is estimated (nodes, one Gaussian standard deviation).
const SMOOTHNESS_WINDOW_NODES: f64 = 1.5;

/// The weights of the bending energy that the data support at each node and axis (planar, three
/// components).
///
/// The evidence procedure (MacKay 1992), `determined / (2 energy)`, in a Gaussian window about each
/// node under a gamma prior that draws each place and axis to the mean of all. `determined` and
/// `energy` are planar and by node, `seen` the nodes that any data inform.
pub fn supported(determined: &[f32], energy: &[f32], nodes: [usize; 3], seen: usize) -> Vec<f32> {
    let n = determined.len() / 3;
    let shared = if ablation::is_on("local-smoothness") { GLOBAL_SMOOTHNESS_WEIGHT } else { f32::MAX.sqrt() };
    let mean = |v: &[f32]| shared * v.iter().map(|v| f64::from(*v)).sum::<f64>() as f32 / (3 * seen.max(1)) as f32;
    let (all, bent) = (mean(determined).max(1e-6), mean(energy));
    let about =
        |v: &[f32]| filters::gaussian(v, nodes, nodes.map(|n| if n > 1 { SMOOTHNESS_WINDOW_NODES } else { 0.0 }));
    let axes = determined.chunks_exact(n).zip(energy.chunks_exact(n));
    axes.flat_map(|(determined, energy)| {
        let pairs = about(determined).into_iter().zip(about(energy)).collect::<Vec<_>>();
        pairs.into_iter().map(|(d, e)| 0.5 * (d.max(0.0) + all) / (e + bent).max(1e-12)).collect::<Vec<_>>()
    })
    .collect()
}

/// How many degrees of freedom the data determine along each axis: `tr((A + L)^-1 A)` of its
/// component (MacKay 1992).
///
/// The trace is estimated with one random sign vector `z` (Hutchinson 1990): `z.C^T (A + L)^-1 C z`
/// with `C C^T = A`, which is good to about one part in the root of half of what it finds.
pub fn determined(matrix: &Coupled<'_>, seed: u64, limit: usize) -> [f64; 3] {
    let by_node = Probe::new(matrix.blocks().len(), seed).determined(matrix, limit);
    total(&by_node)
}

/// The sum of each component of a planar vector.
pub fn total(planar: &[f32]) -> [f64; 3] {
    let n = (planar.len() / 3).max(1);
    std::array::from_fn(|c| planar[c * n..(c + 1) * n].iter().map(|v| f64::from(*v)).sum())
}

/// The random sign vector of [`determined`] and its last solution, from which the next one starts:
/// while a field settles, a few iterations a time suffice.
#[derive(Debug, Clone)]
pub struct Probe {
    signs: Vec<i8>,
    solution: Vec<f32>,
}

impl Probe {
    /// For `nodes` nodes.
    pub fn new(nodes: usize, seed: u64) -> Self {
        let mut random = Random::new(seed, 77);
        let signs = (0..3 * nodes).map(|_| if random.bits() >> 63 == 0 { 1 } else { -1 }).collect();
        Self { signs, solution: vec![0.0; 3 * nodes] }
    }

    /// What each node and axis contributes to [`determined`] (planar); at most `limit` more
    /// iterations.
    ///
    /// With `b = C z` and `M = A + L` the sum is the greatest `(b.x)^2 / x.M x`: what the
    /// iterations are short of shows only squared, and it is neither negative nor more than there
    /// is.
    pub fn determined(&mut self, matrix: &Coupled<'_>, limit: usize) -> Vec<f32> {
        let blocks = matrix.blocks();
        let n = blocks.len();
        let mut pulls = vec![0.0f32; 3 * n];
        for (i, block) in blocks.iter().enumerate() {
            let signs = std::array::from_fn(|c| f64::from(self.signs[c * n + i]));
            for (c, v) in cholesky_times(&block, signs).into_iter().enumerate() {
                pulls[c * n + i] = v as f32;
            }
        }
        let x = &mut self.solution;
        matrix.solve(pulls.clone(), x, 1e-2, limit);
        let at = |v: &[f32], i: usize| -> [f64; 3] { std::array::from_fn(|c| f64::from(v[c * n + i])) };
        let (mut bx, mut xmx) = (vec![0.0f32; 3 * n], vec![0.0f32; 3 * n]);
        for c in 0..3 {
            let density = matrix.smoothness().density(&x[c * n..(c + 1) * n]);
            let weighted = density.iter().zip(&matrix.weights()[c * n..]).map(|(e, w)| e * w);
            xmx[c * n..].iter_mut().zip(weighted).for_each(|(v, e)| *v = e);
        }
        for (i, block) in blocks.iter().enumerate() {
            let (b, x) = (at(&pulls, i), at(x, i));
            let ax = multiply(&block.map(f64::from), x);
            for c in 0..3 {
                bx[c * n + i] = (b[c] * x[c]) as f32;
                xmx[c * n + i] += (ax[c] * x[c]) as f32;
            }
        }
        let sum = |v: &[f32]| total(v).iter().sum::<f64>();
        let length = (sum(&bx) / sum(&xmx).max(f64::MIN_POSITIVE)) as f32;
        bx.iter().zip(&xmx).map(|(b, m)| length * (2.0 * b - length * m)).collect()
    }
}

/// A measured displacement with its information, at a place of the lattice's grid.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Evidence {
    /// Where, on the lattice's grid.
    pub at: VoxelPoint,
    /// Displacement.
    pub displacement: GridVector,
    /// Information, the inverse covariance (1/mm^2).
    pub information: Symmetric3,
}

/// Largest rounding of `lambda L c` over the gradient of the data term.
const MAX_ROUNDING_FRACTION: f64 = 0.1;

/// The largest weight of the bending energy in single precision: of an affine field `L c` is zero
/// but for rounding, and that must not outweigh the evidence.
fn max_smoothness(smoothness: &Smoothness, evidence: &[Evidence]) -> f32 {
    let pull = evidence.iter().map(|e| e.information[..3].iter().sum::<f64>() / 3.0).sum::<f64>();
    let rounded = smoothness.diagonal(&vec![1.0; smoothness.len()]).iter().map(|&v| f64::from(v)).sum::<f64>()
        * f64::from(f32::EPSILON);
    ((MAX_ROUNDING_FRACTION * pull / rounded.max(f64::MIN_POSITIVE)) as f32).clamp(1.0, 1e9)
}

/// The smooth field nearest to scattered evidence, robustly.
///
/// Minimises `sum_i rho(e_i . A_i e_i) + lambda c . L c` with `e_i = u(x_i) - d_i` by reweighted
/// conjugate gradients: every place pulls only along the directions that its patch determines, so a
/// match that slid along an edge does no harm (aperture). `rho` is Geman & McClure's, its scale
/// falling from `start` to 3 standard deviations. `lambda` (per mm^3 of lattice cell) is set in
/// each round from the evidence as in [`determined`], one for all axes: of an axis alone a few
/// dozen matches tell too little. Where nothing bends, the evidence asks for ever more of it, up to
/// what single precision bears.
pub fn fit(lattice: &Lattice, smoothness: &Smoothness, evidence: &[Evidence], rounds: usize) -> (Vec<f32>, f32) {
    fit_from(lattice, smoothness, evidence, None, rounds)
}

/// As [`fit`], from coefficients (mm, planar) and a weight (per lattice cell) that are nearly
/// right: a few rounds of few iterations then suffice, the scale of `rho` starts low enough to end
/// at 3 standard deviations, and `lambda` is set once.
pub(crate) fn fit_from(
    lattice: &Lattice,
    smoothness: &Smoothness,
    evidence: &[Evidence],
    start: Option<(&[f32], f32)>,
    rounds: usize,
) -> (Vec<f32>, f32) {
    let n = lattice.len();
    let most = max_smoothness(smoothness, evidence);
    // A first guess of lambda: second derivatives of 0.01 / mm.
    let (mut c, mut lambda, mut scale) = match start {
        Some((c, lambda)) => (c.to_vec(), lambda.clamp(1e-2, most), 9.0 * f64::from(1u32 << rounds.clamp(1, 8)) / 2.0),
        None => (vec![0.0f32; 3 * n], most.min(1e4), 400.0),
    };
    let stencils: Vec<Stencil> = evidence.iter().map(|e| lattice.stencil_near(e.at)).collect();
    let mut probe = Probe::new(n, 0);
    for round in 0..rounds {
        let mut blocks = vec![[0.0f32; 6]; n];
        let mut rhs = vec![0.0f32; 3 * n];
        let weights: Vec<f64> = evidence
            .par_iter()
            .map(|e| {
                let u = lattice.at(&c, e.at);
                let q = quadratic(&e.information, u.minus(e.displacement).0);
                if round == 0 && start.is_none() { 1.0 } else { (scale / (scale + q)).powi(2) }
            })
            .collect();
        for (e, w) in evidence.iter().zip(&weights) {
            let pull = multiply(&e.information, e.displacement.0).map(|v| (w * v) as f32);
            let info = e.information.map(|v| (w * v) as f32);
            lattice.for_each_tap(e.at, |node, b| {
                for q in 0..6 {
                    blocks[node][q] += b * info[q];
                }
                for a in 0..3 {
                    rhs[a * n + node] += b * pull[a];
                }
            });
        }
        let operator = |x: &[f32], out: &mut [f32]| {
            out.fill(0.0);
            let pulls: Vec<[f32; 3]> = evidence
                .par_iter()
                .zip(&stencils)
                .zip(&weights)
                .map(|((e, s), w)| {
                    let u = [0, 1, 2].map(|a| f64::from(s.gather(&x[a * n..(a + 1) * n])));
                    multiply(&e.information, u).map(|v| (w * v) as f32)
                })
                .collect();
            out.par_chunks_mut(n).enumerate().for_each(|(a, out)| {
                for (s, p) in stencils.iter().zip(&pulls) {
                    s.scatter(p[a], out);
                }
            });
        };
        // Early rounds only sort the evidence; the last two settle the field.
        let early = start.is_some() || round + 2 < rounds;
        let (tolerance, limit) = if early { (3e-2, 15) } else { (1e-2, 60) };
        let blocks = Blocks::from(&blocks[..]);
        let weights = vec![lambda; 3 * n];
        let matrix = Coupled::new(smoothness, &weights, &blocks, true);
        matrix.solve_with(operator, rhs, &mut c, tolerance, limit);
        scale = (scale * 0.5f64).max(9.0);
        // A weight that is nearly right is set once.
        if start.is_some() && round + 1 < rounds {
            continue;
        }
        let gamma = total(&probe.determined(&matrix, if round < 2 { 30 } else { 15 }));
        let [gamma, energy] = [gamma, smoothness.energy(&c)].map(|v| v.iter().sum::<f64>());
        // Half way on the logarithm: whole steps swing to and fro.
        let target = (lambda * (0.5 * gamma.max(1.0) / energy.max(1e-9)) as f32).sqrt();
        lambda = target.clamp(lambda / 10.0, lambda * 10.0).clamp(1e-2, most);
    }
    (c, lambda)
}

/// Posterior draws computed in parallel: each holds six lattice vectors in memory.
const PARALLEL_DRAWS: usize = 2;

/// What the data leave open and what they determine, by node of a lattice.
#[derive(Debug, Clone, PartialEq)]
pub struct Posterior {
    /// Standard deviation of the coupled field along an axis (mm, root of the mean of the
    /// covariance's diagonal over the axes that there are data of).
    pub deviation: Vec<f32>,
    /// Degrees of freedom that the data determine there, the node's part of `tr((A + L)^-1 A)` (see
    /// [`determined`]).
    pub determined: Vec<f32>,
    /// Draws of the error, coefficients (mm, planar).
    pub draws: Vec<Vec<f32>>,
}

/// Deviation and degrees of freedom of the coupled field at each node.
///
/// The covariance is `(A + L)^-1` with `L` the weighted energy; random vectors with just that
/// covariance are drawn by solving for right-hand sides with covariance `A + L` (perturb and
/// optimise, Papandreou & Yuille 2010), and their squares (those under `A` too) averaged over
/// `draws`, those of the deviation over neighbouring nodes as well. Each solution starts from the
/// affine one: where nothing bends, `lambda L` outweighs the data by so much that iterations would
/// leave out all that an affine motion is uncertain by.
pub fn posterior(
    smoothness: &Smoothness,
    weights: &[f32],
    blocks: &Blocks,
    nodes: [usize; 3],
    draws: usize,
    seed: u64,
) -> Posterior {
    let n = blocks.len();
    let affine = Affine::new(nodes, blocks);
    let matrix = Coupled::new(smoothness, weights, blocks, true);
    let draw = |draw: usize| {
        let mut random = Random::new(seed, 1000 + draw as u64);
        let mut b: Vec<f32> = weights.chunks_exact(n).flat_map(|w| smoothness.sample(w, &mut random)).collect();
        let mut pulls = vec![[0.0f32; 3]; n];
        for (i, (a, pull)) in blocks.iter().zip(&mut pulls).enumerate() {
            let (e, f) = (random.normals(), random.normals());
            *pull = cholesky_times(&a, [e[0], e[1], f[0]]).map(|v| v as f32);
            (0..3).for_each(|c| b[c * n + i] += pull[c]);
        }
        // Of the rest an affine motion feels nothing.
        let mut x = affine.solve(&pulls);
        matrix.solve(b, &mut x, 1e-2, 200);
        x
    };
    // Across a slice there is neither motion nor data.
    let seen: Vec<usize> = (0..3).filter(|&c| blocks.iter().any(|b| b[c] > 0.0)).collect();
    let share = 1.0 / (seen.len().max(1) * draws) as f32;
    let mut squares = vec![0.0f32; n];
    let mut determined = vec![0.0f32; n];
    let mut drawn = Vec::with_capacity(draws);
    for first in (0..draws).step_by(PARALLEL_DRAWS) {
        let some: Vec<Vec<f32>> = (first..(first + PARALLEL_DRAWS).min(draws)).into_par_iter().map(draw).collect();
        for x in some {
            for (i, (s, d)) in squares.iter_mut().zip(&mut determined).enumerate() {
                *s += share * seen.iter().map(|c| x[c * n + i] * x[c * n + i]).sum::<f32>();
                let at = std::array::from_fn(|c| f64::from(x[c * n + i]));
                *d += quadratic(&blocks.at(i).map(f64::from), at) as f32 / draws as f32;
            }
            drawn.push(x);
        }
    }
    let smooth = filters::gaussian(&squares, nodes, [1.0; 3]);
    Posterior { deviation: smooth.iter().map(|v| v.sqrt()).collect(), determined, draws: drawn }
}

/// The affine motions of a lattice, which no bending energy holds, under the data alone.
struct Affine {
    nodes: [usize; 3],
    /// Normal matrix: of each of the four shapes (1, x, y, z) the three components.
    normal: [[f64; 12]; 12],
}

impl Affine {
    fn new(nodes: [usize; 3], blocks: &Blocks) -> Self {
        let mut out = Self { nodes, normal: [[0.0; 12]; 12] };
        for (i, [xx, yy, zz, xy, xz, yz]) in blocks.iter().enumerate() {
            let (shapes, block) = (out.shapes(i), [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]);
            for (r, row) in out.normal.iter_mut().enumerate() {
                for (c, v) in row.iter_mut().enumerate() {
                    *v += shapes[r / 3] * shapes[c / 3] * f64::from(block[r % 3][c % 3]);
                }
            }
        }
        // What no data see (the shapes across a slice) stays at rest.
        let most = (0..12).map(|k| out.normal[k][k]).fold(0.0, f64::max);
        (0..12).for_each(|k| out.normal[k][k] += 1e-9 * most);
        out
    }

    /// The four shapes at node `i`.
    fn shapes(&self, i: usize) -> [f64; 4] {
        let [nx, ny, _] = self.nodes;
        let at = [i % nx, i / nx % ny, i / (nx * ny)];
        let [x, y, z] = std::array::from_fn(|a| match self.nodes[a] {
            1 => 0.0,
            n => 2.0 * at[a] as f64 / (n - 1) as f64 - 1.0,
        });
        [1.0, x, y, z]
    }

    /// The motion that `pulls` at the nodes lead to (planar).
    fn solve(&self, pulls: &[[f32; 3]]) -> Vec<f32> {
        let n = pulls.len();
        let mut right = [0.0; 12];
        for (i, pull) in pulls.iter().enumerate() {
            let shapes = self.shapes(i);
            right.iter_mut().enumerate().for_each(|(k, v)| *v += shapes[k / 3] * f64::from(pull[k % 3]));
        }
        let parts = cholesky_solve(self.normal, right).unwrap_or([0.0; 12]);
        let mut x = vec![0.0f32; 3 * n];
        for i in 0..n {
            let shapes = self.shapes(i);
            for c in 0..3 {
                x[c * n + i] = (0..4).map(|m| shapes[m] * parts[3 * m + c]).sum::<f64>() as f32;
            }
        }
        x
    }
}

/// `C e` with `C C^T` the symmetric matrix `a` (zero pivots count as no information).
fn cholesky_times(a: &[f32; 6], e: [f64; 3]) -> [f64; 3] {
    let [xx, yy, zz, xy, xz, yz] = a.map(f64::from);
    let root = |v: f64| v.max(0.0).sqrt();
    let over = |v: f64, d: f64| if d > 0.0 { v / d } else { 0.0 };
    let c00 = root(xx);
    let (c10, c20) = (over(xy, c00), over(xz, c00));
    let c11 = root(yy - c10 * c10);
    let c21 = over(yz - c20 * c10, c11);
    let c22 = root(zz - c20 * c20 - c21 * c21);
    [c00 * e[0], c10 * e[0] + c11 * e[1], c20 * e[0] + c21 * e[1] + c22 * e[2]]
}
