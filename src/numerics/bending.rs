//! The smoothness energy of a lattice of vectors, and the sparse solve that couples data to it.
//!
//! Energy (per component): `sum over nodes of |second differences|^2 / mm^4` over all six second derivatives (a P-spline
//! penalty, Eilers & Marx 1996; bending energy of Rueckert et al. 1999). An affine field costs nothing.

use crate::numerics::random::Random;
use crate::numerics::simd::dispatch;
use crate::numerics::small::{Symmetric3, inverse, multiply};
use rayon::prelude::*;

/// Second difference operators on a lattice of nodes.
#[derive(Debug, Clone)]
pub struct Smoothness {
    nodes: [usize; 3],
    /// Node distances (mm).
    step_mm: [f64; 3],
}

impl Smoothness {
    /// On `nodes` at distances `step_mm`.
    pub fn new(nodes: [usize; 3], step_mm: [f64; 3]) -> Self {
        Self { nodes, step_mm }
    }

    /// Terms `(offset list, weight)`: the penalised differences, as node strides and signs.
    fn terms(&self) -> Vec<Term> {
        let stride = [1, self.nodes[0], self.nodes[0] * self.nodes[1]];
        let h = self.step_mm;
        let mut out = Vec::new();
        for a in 0..3 {
            if self.nodes[a] >= 3 {
                let mut reach = [0; 3];
                reach[a] = 2;
                out.push(Term {
                    reach,
                    taps: vec![(0, 1.0), (stride[a], -2.0), (2 * stride[a], 1.0)],
                    weight: (1.0 / h[a].powi(4)) as f32,
                });
            }
            for b in 0..a {
                if self.nodes[a] >= 2 && self.nodes[b] >= 2 {
                    let mut reach = [0; 3];
                    (reach[a], reach[b]) = (1, 1);
                    let (s, t) = (stride[a], stride[b]);
                    let weight = (2.0 / (h[a] * h[b]).powi(2)) as f32;
                    out.push(Term { reach, taps: vec![(0, 1.0), (s, -1.0), (t, -1.0), (s + t, 1.0)], weight });
                }
            }
        }
        out
    }

    /// `out = L x` for one planar component; `x . L x` is the energy.
    ///
    /// `L` is a sum of products of the one-dimensional operators `B = D2^T D2` and `G = D1^T D1` (second and first
    /// differences), so a row of the result is a combination of 13 rows of `x` and one more filter along the row.
    pub fn apply(&self, x: &[f32], out: &mut [f32]) {
        let [nx, ny, _] = self.nodes;
        let plane = nx * ny;
        let (b, g) = (self.second(), self.first());
        let [bx, by, bz] = &b;
        let [gx, gy, gz] = &g;
        let h = self.step_mm;
        let pair = |a: usize, c: usize| (2.0 / (h[a] * h[c]).powi(2)) as f32;
        let (xy, xz, yz) = (pair(0, 1), pair(0, 2), pair(1, 2));
        out.par_chunks_mut(plane).enumerate().for_each(|(k, out)| {
            let mut cross = vec![0.0f32; nx];
            let row = |j: usize, k: usize| &x[nx * (j + ny * k)..][..nx];
            dispatch(|| {
                for (j, out) in out.chunks_exact_mut(nx).enumerate() {
                    let (vy, vz) = (&by[j], &bz[k]);
                    scale_row(vy[2] + vz[2] + yz * gy[j][1] * gz[k][1], row(j, k), out);
                    scale_row(xy * gy[j][1] + xz * gz[k][1], row(j, k), &mut cross);
                    for d in [0, 1, 3, 4] {
                        if vy[d] != 0.0 {
                            add_row(vy[d], row(j + d - 2, k), out);
                        }
                        if vz[d] != 0.0 {
                            add_row(vz[d], row(j, k + d - 2), out);
                        }
                    }
                    for d in [0, 2] {
                        if gy[j][d] != 0.0 {
                            add_row(yz * gy[j][d] * gz[k][1], row(j + d - 1, k), out);
                            add_row(xy * gy[j][d], row(j + d - 1, k), &mut cross);
                        }
                        if gz[k][d] != 0.0 {
                            add_row(yz * gy[j][1] * gz[k][d], row(j, k + d - 1), out);
                            add_row(xz * gz[k][d], row(j, k + d - 1), &mut cross);
                        }
                        for e in [0, 2] {
                            let w = yz * gy[j][d] * gz[k][e];
                            if w != 0.0 {
                                add_row(w, row(j + d - 1, k + e - 1), out);
                            }
                        }
                    }
                    banded(bx, row(j, k), out);
                    banded(gx, &cross, out);
                }
            });
        });
    }

    /// Rows of `B = D2^T D2 / h^4` along each axis: five diagonals.
    fn second(&self) -> [Vec<[f32; 5]>; 3] {
        std::array::from_fn(|a| {
            let n = self.nodes[a];
            let scale = (1.0 / self.step_mm[a].powi(4)) as f32;
            let mut rows = vec![[0.0f32; 5]; n];
            for s in 0..n.saturating_sub(2) {
                for (p, v) in [1.0, -2.0, 1.0].into_iter().enumerate() {
                    for (q, w) in [1.0, -2.0, 1.0].into_iter().enumerate() {
                        rows[s + p][q + 2 - p] += scale * v * w;
                    }
                }
            }
            rows
        })
    }

    /// Rows of `G = D1^T D1` along each axis: three diagonals.
    fn first(&self) -> [Vec<[f32; 3]>; 3] {
        std::array::from_fn(|a| {
            let n = self.nodes[a];
            let mut rows = vec![[0.0f32; 3]; n];
            for s in 0..n.saturating_sub(1) {
                rows[s][1] += 1.0;
                rows[s + 1][1] += 1.0;
                rows[s][2] -= 1.0;
                rows[s + 1][0] -= 1.0;
            }
            rows
        })
    }

    /// Diagonal of `L`.
    pub fn diagonal(&self) -> Vec<f32> {
        let [nx, ny, _] = self.nodes;
        let (b, g, h) = (self.second(), self.first(), self.step_mm);
        (0..self.nodes.iter().product())
            .map(|m| {
                let at = [m % nx, m / nx % ny, m / (nx * ny)];
                let bending: f32 = (0..3).map(|a| b[a][at[a]][2]).sum();
                let twist = |a: usize, c: usize| (2.0 / (h[a] * h[c]).powi(2)) as f32 * g[a][at[a]][1] * g[c][at[c]][1];
                bending + twist(0, 1) + twist(0, 2) + twist(1, 2)
            })
            .collect()
    }

    /// A random vector with covariance `L` (one planar component): the transpose of the differences applied to
    /// independent standard normal numbers.
    pub fn sample(&self, random: &mut Random) -> Vec<f32> {
        let [nx, ny, nz] = self.nodes;
        let mut out = vec![0.0f32; nx * ny * nz];
        for t in self.terms() {
            let scale = t.weight.sqrt();
            let mut spare = None;
            for k in 0..nz - t.reach[2] {
                for j in 0..ny - t.reach[1] {
                    for i in 0..nx - t.reach[0] {
                        let anchor = i + nx * (j + ny * k);
                        let e = match spare.take() {
                            Some(e) => e,
                            None => {
                                let [a, b] = random.normals();
                                spare = Some(b);
                                a
                            }
                        };
                        for &(o, s) in &t.taps {
                            out[anchor + o] += scale * s * e as f32;
                        }
                    }
                }
            }
        }
        out
    }

    /// The energy of a planar three-component vector field.
    pub fn energy(&self, x: &[f32]) -> f64 {
        let n = x.len() / 3;
        let mut lx = vec![0.0; n];
        x.chunks_exact(n)
            .map(|x| {
                self.apply(x, &mut lx);
                x.iter().zip(&lx).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>()
            })
            .sum()
    }
}

/// `out = w row`.
#[inline(always)]
fn scale_row(w: f32, row: &[f32], out: &mut [f32]) {
    for (o, v) in out.iter_mut().zip(row) {
        *o = w * v;
    }
}

/// `out += w row`.
#[inline(always)]
fn add_row(w: f32, row: &[f32], out: &mut [f32]) {
    for (o, v) in out.iter_mut().zip(row) {
        *o += w * v;
    }
}

/// `out += M row` for a banded matrix of `2 R + 1` diagonals whose inner rows are all alike.
#[inline(always)]
fn banded<const W: usize>(matrix: &[[f32; W]], row: &[f32], out: &mut [f32]) {
    let (n, r) = (row.len(), W / 2);
    let edge = |i: usize, out: &mut [f32]| {
        for (d, w) in matrix[i].iter().enumerate() {
            if *w != 0.0 {
                out[i] += w * row[i + d - r];
            }
        }
    };
    // The first and last `W - 1 - r` rows feel the border.
    let border = W - 1;
    if n <= 2 * border {
        (0..n).for_each(|i| edge(i, out));
        return;
    }
    (0..border).chain(n - border..n).for_each(|i| edge(i, out));
    let m = matrix[border];
    for (i, o) in out[border..n - border].iter_mut().enumerate() {
        let window = &row[i + border - r..i + border - r + W];
        let mut s = 0.0;
        for d in 0..W {
            s += m[d] * window[d];
        }
        *o += s;
    }
}

/// One penalised difference.
struct Term {
    reach: [usize; 3],
    taps: Vec<(usize, f32)>,
    weight: f32,
}

/// How a solve went.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SolveReport {
    /// Iterations used.
    pub iterations: usize,
    /// Last residual over the first (1).
    pub residual: f64,
}

/// Preconditioned conjugate gradients for `(D + lambda L) x = b`, where `D` is any positive semidefinite data operator.
///
/// `data(x, out)` writes `D x` (planar, three components); `blocks` holds (an upper bound of) its 3 x 3 diagonal blocks
/// for the preconditioner; `x` holds the start and receives the result. Stops at `tolerance` (relative residual) or
/// after `limit` iterations (Hestenes & Stiefel 1952).
pub fn solve(
    smoothness: &Smoothness,
    lambda: f32,
    data: impl Fn(&[f32], &mut [f32]),
    blocks: &[[f32; 6]],
    b: &[f32],
    x: &mut [f32],
    tolerance: f64,
    limit: usize,
) -> SolveReport {
    let n = blocks.len();
    let diagonal = smoothness.diagonal();
    let preconditioner: Vec<Symmetric3> = blocks
        .par_iter()
        .zip(&diagonal)
        .map(|(a, &l)| {
            let mut m = a.map(f64::from);
            let l = f64::from(lambda * l) + 1e-12;
            for v in &mut m[..3] {
                *v += l;
            }
            inverse(&m).unwrap_or([1.0 / m[0], 1.0 / m[1], 1.0 / m[2], 0.0, 0.0, 0.0])
        })
        .collect();
    let operator = |x: &[f32], out: &mut [f32]| {
        data(x, out);
        let mut lx = vec![0.0f32; n];
        for (x, out) in x.chunks_exact(n).zip(out.chunks_exact_mut(n)) {
            smoothness.apply(x, &mut lx);
            for (o, l) in out.iter_mut().zip(&lx) {
                *o += lambda * l;
            }
        }
    };
    let precondition = |r: &[f32], z: &mut [f32]| {
        let (zx, rest) = z.split_at_mut(n);
        let (zy, zz) = rest.split_at_mut(n);
        for (i, m) in preconditioner.iter().enumerate() {
            let v = multiply(m, [r[i], r[n + i], r[2 * n + i]].map(f64::from));
            (zx[i], zy[i], zz[i]) = (v[0] as f32, v[1] as f32, v[2] as f32);
        }
    };
    let dot = |a: &[f32], b: &[f32]| -> f64 {
        // Chunked by length alone: the same sum whatever the number of threads.
        let parts: Vec<f64> = a
            .par_chunks(1 << 14)
            .zip(b.par_chunks(1 << 14))
            .map(|(a, b)| a.iter().zip(b).map(|(x, y)| f64::from(*x) * f64::from(*y)).sum())
            .collect();
        parts.iter().sum()
    };
    let mut ap = vec![0.0f32; 3 * n];
    operator(x, &mut ap);
    let mut r: Vec<f32> = b.iter().zip(&ap).map(|(b, a)| b - a).collect();
    let mut z = vec![0.0f32; 3 * n];
    precondition(&r, &mut z);
    let mut p = z.clone();
    let mut rz = dot(&r, &z);
    let first = rz;
    let mut iterations = 0;
    while iterations < limit && rz > tolerance * tolerance * first && rz > 0.0 {
        operator(&p, &mut ap);
        let curvature = dot(&p, &ap);
        if !(curvature > 0.0 && curvature.is_finite()) {
            break;
        }
        let alpha = (rz / curvature) as f32;
        for ((x, r), (p, a)) in x.iter_mut().zip(&mut r).zip(p.iter().zip(&ap)) {
            *x += alpha * p;
            *r -= alpha * a;
        }
        precondition(&r, &mut z);
        let next = dot(&r, &z);
        let beta = (next / rz) as f32;
        rz = next;
        for (p, z) in p.iter_mut().zip(&z) {
            *p = z + beta * *p;
        }
        iterations += 1;
    }
    SolveReport { iterations, residual: if first > 0.0 { (rz / first).max(0.0).sqrt() } else { 0.0 } }
}

/// `D x` for block-diagonal data.
pub fn apply_blocks(blocks: &[[f32; 6]], x: &[f32], out: &mut [f32]) {
    let n = blocks.len();
    for (i, a) in blocks.iter().enumerate() {
        let v = [x[i], x[n + i], x[2 * n + i]];
        out[i] = a[0] * v[0] + a[3] * v[1] + a[4] * v[2];
        out[n + i] = a[3] * v[0] + a[1] * v[1] + a[5] * v[2];
        out[2 * n + i] = a[4] * v[0] + a[5] * v[1] + a[2] * v[2];
    }
}
