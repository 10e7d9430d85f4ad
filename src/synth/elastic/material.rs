//! Energy, forces and tangent of compressible neo-Hookean tissue without locking.
//!
//! The energy of an element is the integral of
//! `mu/2 (tr F^T F - 3 - 2 ln J) + lambda/2 (ln J projected)^2` over its rest state, so that
//! `P = mu (F - F^-T) + p F^-T` with the pressure-like `p = lambda` times ln J's L2 projection on
//! linear functions of the element. With triquadratic displacements this is the Q2/P1 pair, stable
//! to Poisson's ratio 0.5 (Brezzi and Fortin 1991, VI.3), and symmetric.

use crate::synth::elastic::quadratic::{GAUSS, NODES, Nodal, Tables, divergence, gradient, line, weight};
use crate::synth::elastic::space::{Entries, LANES, Space, entries};
use crate::synth::elastic::tangent::Batch;
use crate::types::space::{Matrix3, determinant, matmul};
use rayon::prelude::*;

/// Lame's constants (kPa).
#[derive(Debug, Clone, Copy)]
pub struct Lame {
    /// Shear modulus.
    pub mu: f64,
    /// First constant.
    pub lambda: f64,
}

impl Lame {
    /// From Young's modulus (kPa) and Poisson's ratio.
    pub fn new(youngs_modulus: f64, poisson: f64) -> Self {
        let mu = youngs_modulus / (2.0 * (1.0 + poisson));
        Self { mu, lambda: 2.0 * mu * poisson / (1.0 - 2.0 * poisson) }
    }
}

/// Energy (kPa mm^3 = mN mm) and nodal forces (mN) at a displacement.
pub struct State {
    /// Stored energy; infinite when an element is turned inside out.
    pub energy: f64,
    /// Gradient of the energy, a node.
    pub forces: Vec<[f64; 3]>,
    /// The tangent's data.
    pub batches: Vec<Batch>,
}

/// Inverse of `m` times its determinant, and the determinant.
#[inline(always)]
fn adjugate(m: &Matrix3) -> (Matrix3, f64) {
    let adjugate = std::array::from_fn(|r| {
        std::array::from_fn(|c| {
            let (a, b, p, q) = ((c + 1) % 3, (c + 2) % 3, (r + 1) % 3, (r + 2) % 3);
            m[a][p] * m[b][q] - m[a][q] * m[b][p]
        })
    });
    (adjugate, determinant(m))
}

/// A pressure p (kPa) that is linear in an element: at the world's origin, and its slopes (a mm).
pub(crate) type Pressure = [f64; 4];

/// An orthonormal basis of the linear functions on an element.
struct Basis {
    /// Values at the Gauss points.
    values: [[f64; NODES]; 4],
    /// Each as a linear function of the place.
    functions: [Pressure; 4],
}

impl Basis {
    /// With weights `w` at the places `x`.
    fn new(x: &[[f64; 3]; NODES], w: &[f64; NODES]) -> Self {
        let volume: f64 = w.iter().sum();
        let middle: [f64; 3] = std::array::from_fn(|a| (0..NODES).map(|q| w[q] * x[q][a]).sum::<f64>() / volume);
        let (mut values, mut functions) = ([[0.0; NODES]; 4], [[0.0; 4]; 4]);
        for k in 0..4 {
            let mut v: [f64; NODES] = std::array::from_fn(|q| if k == 0 { 1.0 } else { x[q][k - 1] - middle[k - 1] });
            let mut f = [0.0; 4];
            f[k] = 1.0;
            if k > 0 {
                f[0] = -middle[k - 1];
            }
            for b in 0..k {
                let along: f64 = (0..NODES).map(|q| w[q] * v[q] * values[b][q]).sum();
                (0..NODES).for_each(|q| v[q] -= along * values[b][q]);
                (0..4).for_each(|j| f[j] -= along * functions[b][j]);
            }
            let norm = (0..NODES).map(|q| w[q] * v[q] * v[q]).sum::<f64>().sqrt();
            values[k] = v.map(|v| v / norm);
            functions[k] = f.map(|f| f / norm);
        }
        Self { values, functions }
    }

    /// Share of each function in `v`.
    fn shares(&self, v: &[f64; NODES], w: &[f64; NODES]) -> [f64; 4] {
        self.values.map(|b| (0..NODES).map(|q| w[q] * b[q] * v[q]).sum())
    }
}

/// Local derivatives of a vector: `[component][local axis][point][lane]`.
type Derivatives = [[Nodal<f64, LANES>; 3]; 3];

#[inline(always)]
fn derivatives(t: &Tables<f64>, x: &[Nodal<f64, LANES>; 3]) -> Derivatives {
    [gradient(t, &x[0]), gradient(t, &x[1]), gradient(t, &x[2])]
}

#[inline(always)]
fn at(d: &Derivatives, q: usize, l: usize) -> Matrix3 {
    std::array::from_fn(|r| std::array::from_fn(|c| d[r][c][q][l]))
}

/// Adds the element in lane `l` with places at rest `x`; the energy, and the stress that
/// [`divergence`] sums up.
#[inline(always)]
fn element(
    rest: &Derivatives,
    moved: &Derivatives,
    x: &[Nodal<f64, LANES>; 3],
    l: usize,
    Lame { mu, lambda }: Lame,
    pressure: &Pressure,
    stress: &mut Derivatives,
    batch: &mut Batch,
) -> f64 {
    let zero = [[0.0; 3]; 3];
    let (mut local, mut back, mut strain) = ([zero; NODES], [zero; NODES], [zero; NODES]);
    let (mut w, mut log) = ([0.0; NODES], [0.0; NODES]);
    let mut energy = 0.0;
    for q in 0..NODES {
        let ((cut, rest_volume), (cut_moved, moved_volume)) = (adjugate(&at(rest, q, l)), adjugate(&at(moved, q, l)));
        local[q] = cut.map(|r| r.map(|v| v / rest_volume));
        back[q] = cut_moved.map(|r| r.map(|v| v / moved_volume));
        strain[q] = matmul(&at(moved, q, l), &local[q]);
        w[q] = weight(q) * rest_volume;
        let j = moved_volume / rest_volume;
        if rest_volume <= 0.0 || j <= 0.0 {
            return f64::INFINITY;
        }
        log[q] = j.ln();
        let trace: f64 = strain[q].iter().flatten().map(|v| v * v).sum();
        energy += w[q] * mu * (0.5 * (trace - 3.0) - log[q]);
    }
    let places = std::array::from_fn(|q| interpolated(x, q, l));
    let basis = Basis::new(&places, &w);
    let share = basis.shares(&log, &w);
    energy += 0.5 * lambda * share.iter().map(|s| s * s).sum::<f64>();
    for q in 0..NODES {
        let p: f64 = lambda * (0..4).map(|k| share[k] * basis.values[k][q]).sum::<f64>();
        for r in 0..3 {
            for c in 0..3 {
                let shear: f64 = (0..3).map(|i| strain[q][r][i] * local[q][c][i]).sum();
                stress[r][c][q][l] = w[q] * (mu * shear + (p - mu) * back[q][c][r]);
            }
        }
        let turning = pressure[0] + (0..3).map(|a| pressure[a + 1] * places[q][a]).sum::<f64>();
        let shares = basis.values.map(|b| lambda.sqrt() * w[q] * b[q]);
        batch.points[q].set(l, w[q] * mu, &local[q], &back[q], w[q] * (mu - turning), shares);
    }
    energy
}

/// Place at rest of Gauss point `q`.
#[inline(always)]
fn interpolated(x: &[Nodal<f64, LANES>; 3], q: usize, l: usize) -> [f64; 3] {
    let value = |a: usize, n: usize| line(GAUSS[a])[0][n];
    let weights: [f64; NODES] =
        std::array::from_fn(|n| value(q % 3, n % 3) * value(q / 3 % 3, n / 3 % 3) * value(q / 9, n / 9));
    std::array::from_fn(|c| (0..NODES).map(|n| weights[n] * x[c][n][l]).sum())
}

/// Places after a displacement.
fn moved(space: &Space, u: &[[f64; 3]]) -> Vec<[f64; 3]> {
    space.nodes.iter().zip(u).map(|(x, u)| std::array::from_fn(|c| x[c] + u[c])).collect()
}

/// Energy, forces and tangent at displacement `u`; `lame` by region. The tangent takes the pressure
/// of its turning term from `pressure`, by element.
pub fn state(space: &Space, lame: &[Lame], u: &[[f64; 3]], pressure: &[Pressure]) -> State {
    let tables = Tables::new(|v| v);
    let moved = moved(space, u);
    let all: Vec<(f64, Entries<f64>, Batch)> = (0..space.batches())
        .into_par_iter()
        .map(|b| {
            let zero = [[[0.0; LANES]; NODES]; 3];
            let (mut x, mut y, mut stress) = (zero, zero, [zero; 3]);
            space.gather(b, &space.nodes, &mut x);
            space.gather(b, &moved, &mut y);
            let (rest, now) = (derivatives(&tables, &x), derivatives(&tables, &y));
            let mut batch = Batch::default();
            let mut energy = 0.0;
            for l in 0..LANES.min(space.elements.len() - b * LANES) {
                let e = b * LANES + l;
                let law = lame[usize::from(space.region[e])];
                energy += element(&rest, &now, &x, l, law, &pressure[e], &mut stress, &mut batch);
            }
            let forces = entries(&[0, 1, 2].map(|c| divergence(&tables, &stress[c])));
            (energy, forces, batch)
        })
        .collect();
    let energy = all.iter().map(|a| a.0).sum();
    let mut parts = Vec::with_capacity(all.len());
    let mut batches = Vec::with_capacity(all.len());
    for (_, part, batch) in all {
        parts.push(part);
        batches.push(batch);
    }
    let mut forces = vec![[0.0; 3]; u.len()];
    space.assemble(&parts, &mut forces, |_, f| f);
    State { energy, forces, batches }
}

/// The pressure of each element after a step `d` from `u`, ln J being carried on linearly.
pub(crate) fn predicted(space: &Space, lame: &[Lame], u: &[[f64; 3]], d: &[[f64; 3]]) -> Vec<Pressure> {
    let tables = Tables::new(|v| v);
    let moved = moved(space, u);
    let batches = (0..space.batches()).into_par_iter().map(|b| {
        let zero = [[[0.0; LANES]; NODES]; 3];
        let (mut x, mut y, mut step) = (zero, zero, zero);
        space.gather(b, &space.nodes, &mut x);
        space.gather(b, &moved, &mut y);
        space.gather(b, d, &mut step);
        let (rest, now, step) = (derivatives(&tables, &x), derivatives(&tables, &y), derivatives(&tables, &step));
        let one = |l: usize| -> Pressure {
            let (mut w, mut log) = ([0.0; NODES], [0.0; NODES]);
            for q in 0..NODES {
                let rest_volume = determinant(&at(&rest, q, l));
                let (cut, volume) = adjugate(&at(&now, q, l));
                let g = at(&step, q, l);
                let trace: f64 = (0..9).map(|n| g[n / 3][n % 3] * cut[n % 3][n / 3]).sum();
                w[q] = weight(q) * rest_volume;
                log[q] = (volume / rest_volume).ln() + trace / volume;
            }
            let basis = Basis::new(&std::array::from_fn(|q| interpolated(&x, q, l)), &w);
            let share = basis.shares(&log, &w);
            let lambda = lame[usize::from(space.region[b * LANES + l])].lambda;
            std::array::from_fn(|j| lambda * (0..4).map(|k| share[k] * basis.functions[k][j]).sum::<f64>())
        };
        (0..LANES.min(space.elements.len() - b * LANES)).map(one).collect::<Vec<_>>()
    });
    batches.flatten_iter().collect()
}
