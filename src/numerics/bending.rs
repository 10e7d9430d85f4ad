//! The smoothness energy of a lattice of vectors, and the sparse solve that couples data to it.
//!
//! Energy (per component): `sum over nodes of |second differences|^2 / mm^4` over all six second derivatives (a P-spline
//! penalty, Eilers & Marx 1996; bending energy of Rueckert et al. 1999). An affine field costs nothing.

use crate::numerics::blocks::Blocks;
use crate::numerics::multilevel::Coarse;
use crate::numerics::random::Random;
use crate::numerics::simd::dispatch;
use crate::numerics::small::inverse;
use rayon::prelude::*;
use std::ops::Range;

/// Second difference operators on a lattice of nodes.
#[derive(Debug, Clone)]
pub struct Smoothness {
    nodes: [usize; 3],
    /// Node distances (mm).
    step_mm: [f64; 3],
    bands: Bands,
}

impl Smoothness {
    /// On `nodes` at distances `step_mm`.
    pub fn new(nodes: [usize; 3], step_mm: [f64; 3]) -> Self {
        Self { nodes, step_mm, bands: Bands::new(nodes, step_mm) }
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
        let plane = self.nodes[0] * self.nodes[1];
        out.par_chunks_mut(plane).with_min_len(worthwhile(plane)).enumerate().for_each(|(k, out)| {
            let mut cross = vec![0.0f32; self.nodes[0] * self.nodes[1]];
            dispatch(
                #[inline(always)]
                || self.bands.plane(x, k, out, &mut cross),
            );
        });
    }

    /// Diagonal of `L`.
    pub fn diagonal(&self) -> Vec<f32> {
        let [nx, ny, _] = self.nodes;
        let (b, g, h) = (second(self.nodes, self.step_mm), first(self.nodes), self.step_mm);
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

    /// The energy of each component of a planar vector field.
    pub fn energy(&self, x: &[f32]) -> [f64; 3] {
        let mut lx = vec![0.0; x.len() / 3];
        thirds(x).map(|x| {
            self.apply(x, &mut lx);
            x.iter().zip(&lx).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
        })
    }
}

/// What applying `L` needs, worked out once.
#[derive(Debug, Clone)]
struct Bands {
    nodes: [usize; 3],
    /// Rows of a plane with the same weights: first, and one past the last.
    runs: Vec<(usize, usize)>,
    /// Those weights, of each plane.
    weights: Vec<Vec<Weights>>,
    /// Diagonals of the second and of the first differences along x, at each node of a plane; 0 past a row's ends.
    second: [Vec<f32>; 5],
    first: [Vec<f32>; 3],
}

/// Weights of the rows of [`REACH`].
#[derive(Debug, Clone)]
struct Weights {
    /// In the row itself.
    own: [f32; 13],
    /// In what the first differences along x are taken of.
    twist: [f32; 5],
}

impl Weights {
    /// From the rows of the second and of the first differences along y and z, and the weights of the mixed ones: xy, xz, yz.
    fn new([vy, vz]: [&[f32; 5]; 2], [wy, wz]: [&[f32; 3]; 2], [xy, xz, yz]: [f32; 3]) -> Self {
        let first = |g: &[f32; 3], d: usize| if (1..4).contains(&d) { g[d - 1] } else { 0.0 };
        let own = REACH.map(|(dj, dk)| {
            let bending = if dk == 2 { vy[dj] } else { 0.0 } + if dj == 2 { vz[dk] } else { 0.0 };
            bending + yz * first(wy, dj) * first(wz, dk)
        });
        let twist = std::array::from_fn(|n| {
            let (dj, dk) = REACH[n];
            let y = if dk == 2 { xy * first(wy, dj) } else { 0.0 };
            y + if dj == 2 { xz * first(wz, dk) } else { 0.0 }
        });
        Self { own, twist }
    }
}

impl Bands {
    /// On `nodes` at distances `h` (mm).
    fn new(nodes: [usize; 3], h: [f64; 3]) -> Self {
        let pair = |a: usize, c: usize| (2.0 / (h[a] * h[c]).powi(2)) as f32;
        let ([second, by, bz], [first, gy, gz]) = (second(nodes, h), first(nodes));
        let [nx, ny, nz] = nodes;
        let twist = [pair(0, 1), pair(0, 2), pair(1, 2)];
        // Rows two away from the border in y share their weights: they are treated as one long row.
        let (low, high) = if ny >= 5 { (2, ny - 2) } else { (ny, ny) };
        let starts = || (0..low).chain(high..ny).chain((low < high).then_some(low));
        let of_plane = |k: usize| starts().map(|j| Weights::new([&by[j], &bz[k]], [&gy[j], &gz[k]], twist)).collect();
        Self {
            nodes,
            runs: starts().map(|j| if (low..high).contains(&j) { (low, high) } else { (j, j + 1) }).collect(),
            weights: (0..nz).map(of_plane).collect(),
            second: std::array::from_fn(|d| (0..nx * ny).map(|m| second[m % nx][d]).collect()),
            first: std::array::from_fn(|d| (0..nx * ny).map(|m| first[m % nx][d]).collect()),
        }
    }

    /// Plane `k` of `L x`; `cross` is room for a plane.
    #[inline(always)]
    fn plane(&self, x: &[f32], k: usize, out: &mut [f32], cross: &mut [f32]) {
        let [nx, ny, nz] = self.nodes;
        for (&(j, end), weights) in self.runs.iter().zip(&self.weights[k]) {
            let length = nx * (end - j);
            // A row outside the lattice has weight zero; any other stands in for it.
            let near = |at: usize, d: usize, n: usize, height: usize| (at + d).saturating_sub(2).min(n - height);
            let rows = REACH.map(|(dj, dk)| &x[nx * (near(j, dj, ny, end - j) + ny * near(k, dk, nz, 1))..][..length]);
            let (out, cross) = (&mut out[nx * j..][..length], &mut cross[nx * j..][..length]);
            // Spelled out, so that it is made of vector instructions.
            let [r0, r1, r2, r3, r4, r5, r6, r7, r8, r9, r10, r11, r12] = rows;
            let [w0, w1, w2, w3, w4, w5, w6, w7, w8, w9, w10, w11, w12] = weights.own;
            let [t0, t1, t2, t3, t4] = weights.twist;
            for i in 0..length {
                let near = w0 * r0[i] + w1 * r1[i] + w2 * r2[i] + w3 * r3[i] + w4 * r4[i];
                let far = w5 * r5[i] + w6 * r6[i] + w7 * r7[i] + w8 * r8[i];
                out[i] = near + far + (w9 * r9[i] + w10 * r10[i] + w11 * r11[i] + w12 * r12[i]);
                cross[i] = t0 * r0[i] + t1 * r1[i] + t2 * r2[i] + t3 * r3[i] + t4 * r4[i];
            }
        }
        let x = &x[k * nx * ny..(k + 1) * nx * ny];
        banded(&self.second, x, out);
        banded(&self.first, cross, out);
    }
}

/// Rows of `B = D2^T D2 / h^4` along each axis: five diagonals.
fn second(nodes: [usize; 3], h: [f64; 3]) -> [Vec<[f32; 5]>; 3] {
    std::array::from_fn(|a| {
        let n = nodes[a];
        let scale = (1.0 / h[a].powi(4)) as f32;
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
fn first(nodes: [usize; 3]) -> [Vec<[f32; 3]>; 3] {
    std::array::from_fn(|a| {
        let n = nodes[a];
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

/// The rows that a row of `L x` is made of, as offsets in y and z plus 2; the first five alone enter the twists with x.
const REACH: [(usize, usize); 13] =
    [(2, 2), (1, 2), (3, 2), (2, 1), (2, 3), (0, 2), (4, 2), (2, 0), (2, 4), (1, 1), (3, 1), (1, 3), (3, 3)];

/// `out += M x` for a banded matrix, by its diagonals.
#[inline(always)]
fn banded<const W: usize>(diagonals: &[Vec<f32>; W], x: &[f32], out: &mut [f32]) {
    let (n, r) = (x.len(), W / 2);
    let (first, last) = (r.min(n), n.saturating_sub(r).max(r.min(n)));
    let inner = last - first;
    let shifted: [&[f32]; W] = std::array::from_fn(|d| x.get(d..d + inner).unwrap_or_default());
    let weights: [&[f32]; W] = std::array::from_fn(|d| &diagonals[d][first..last]);
    for (i, o) in out[first..last].iter_mut().enumerate() {
        let mut s = 0.0;
        for d in 0..W {
            s += weights[d][i] * shifted[d][i];
        }
        *o += s;
    }
    // Where it would reach past an end.
    for i in (0..first).chain(last..n) {
        for (d, diagonal) in diagonals.iter().enumerate().filter(|(d, _)| (r..n + r).contains(&(i + d))) {
            out[i] += diagonal[i] * x[i + d - r];
        }
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

/// The matrix `D + lambda L` with its preconditioner.
///
/// `blocks` holds (an upper bound of) the 3 x 3 diagonal blocks of `D`. Preconditioned by them alone, smooth errors go slowly, which
/// early stopping makes use of; with `multilevel` coarser lattices take them.
pub struct Coupled<'a> {
    smoothness: &'a Smoothness,
    lambda: [f32; 3],
    /// Nodes of a plane.
    plane: usize,
    /// Diagonal blocks of `D`.
    blocks: &'a Blocks,
    /// Inverse 3 x 3 diagonal blocks of the whole matrix.
    inverse: Blocks,
    /// What is smooth is left to coarser lattices, where that is wanted.
    coarse: Option<Box<Coarse>>,
}

impl<'a> Coupled<'a> {
    /// Of weights `lambda`, one an axis.
    pub fn new(smoothness: &'a Smoothness, lambda: [f32; 3], blocks: &'a Blocks, multilevel: bool) -> Self {
        let plane = smoothness.nodes[0] * smoothness.nodes[1];
        let (n, diagonal) = (blocks.len(), smoothness.diagonal());
        let mut inverses = vec![0.0; 6 * n];
        planes::<6>(&mut inverses, plane).for_each(|(k, mut out)| {
            for i in 0..out[0].len() {
                let at = k * plane + i;
                let mut m = blocks.at(at).map(f64::from);
                for (v, lambda) in m.iter_mut().zip(lambda) {
                    *v += f64::from(lambda * diagonal[at]) + 1e-12;
                }
                let inverse = inverse(&m).unwrap_or([1.0 / m[0], 1.0 / m[1], 1.0 / m[2], 0.0, 0.0, 0.0]);
                out.iter_mut().zip(inverse).for_each(|(out, v)| out[i] = v as f32);
            }
        });
        let below = || Coarse::new(smoothness.nodes, smoothness.step_mm, lambda.map(f64::from), blocks.planar());
        Self {
            smoothness,
            lambda,
            plane,
            blocks,
            coarse: multilevel.then(below).flatten(),
            inverse: Blocks::from_planar(inverses),
        }
    }

    /// The bending energy.
    pub fn smoothness(&self) -> &Smoothness {
        self.smoothness
    }

    /// Its weight along each axis.
    pub fn lambda(&self) -> [f32; 3] {
        self.lambda
    }

    /// The diagonal blocks of `D`.
    pub fn blocks(&self) -> &Blocks {
        self.blocks
    }

    /// Conjugate gradients for `(D + lambda L) x = b` (Hestenes & Stiefel 1952), `b` and `x` planar, the blocks being all of `D`.
    ///
    /// `x` holds the start and receives the result. Stops at `tolerance` (relative residual) or after `limit` iterations.
    pub fn solve(&self, b: Vec<f32>, x: &mut [f32], tolerance: f64, limit: usize) -> SolveReport {
        self.iterate(b, x, tolerance, limit, |p, ap| self.apply(p, ap, None))
    }

    /// The same where the blocks bound `D`, and `data` writes `D x` into its second (planar, three components).
    pub fn solve_with(
        &self,
        data: impl Fn(&[f32], &mut [f32]),
        b: Vec<f32>,
        x: &mut [f32],
        tolerance: f64,
        limit: usize,
    ) -> SolveReport {
        let mut values = vec![0.0f32; b.len()];
        self.iterate(b, x, tolerance, limit, |p, ap| {
            data(p, &mut values);
            self.apply(p, ap, Some(&values))
        })
    }

    /// `out = (D + lambda L) x`, with `D x` given or from the blocks; returns `x . out`. Sums go plane by plane, so that
    /// they are the same whatever the number of threads.
    fn apply(&self, x: &[f32], out: &mut [f32], data: Option<&[f32]>) -> f64 {
        let (n, bands) = (x.len() / 3, &self.smoothness.bands);
        let [x0, x1, x2] = thirds(x);
        let parts = planes(out, self.plane).map(|(k, [o0, o1, o2])| {
            let at = k * self.plane..(k + 1) * self.plane;
            let mut cross = vec![0.0f32; self.plane];
            dispatch(
                #[inline(always)]
                || {
                    bands.plane(x0, k, o0, &mut cross);
                    bands.plane(x1, k, o1, &mut cross);
                    bands.plane(x2, k, o2, &mut cross);
                    let (x, y, z) = (&x0[at.clone()], &x1[at.clone()], &x2[at.clone()]);
                    let [l0, l1, l2] = self.lambda;
                    match data {
                        Some(d) => {
                            let [d0, d1, d2] = thirds(d).map(|d| &d[at.clone()]);
                            for i in 0..x.len() {
                                o0[i] = l0 * o0[i] + d0[i];
                                o1[i] = l1 * o1[i] + d1[i];
                                o2[i] = l2 * o2[i] + d2[i];
                            }
                        }
                        None => {
                            let [xx, yy, zz, xy, xz, yz] = sixths(self.blocks.planar(), n, &at);
                            for i in 0..x.len() {
                                o0[i] = l0 * o0[i] + (xx[i] * x[i] + xy[i] * y[i] + xz[i] * z[i]);
                                o1[i] = l1 * o1[i] + (xy[i] * x[i] + yy[i] * y[i] + yz[i] * z[i]);
                                o2[i] = l2 * o2[i] + (xz[i] * x[i] + yz[i] * y[i] + zz[i] * z[i]);
                            }
                        }
                    }
                    dot(x, o0) + dot(y, o1) + dot(z, o2)
                },
            )
        });
        sum(parts.collect())
    }

    /// `z = M^-1 r`; returns `r . z`.
    fn precondition(&self, r: &[f32], z: &mut [f32]) -> f64 {
        let n = r.len() / 3;
        let below = self.coarse.as_ref().map(|c| (c, c.solve(r)));
        let parts = planes(z, self.plane).map(|(k, z)| {
            let at = k * self.plane..(k + 1) * self.plane;
            let [r0, r1, r2] = thirds(r).map(|r| &r[at.clone()]);
            let [xx, yy, zz, xy, xz, yz] = sixths(self.inverse.planar(), n, &at);
            let mut room = Vec::new();
            dispatch(
                #[inline(always)]
                || {
                    let [z0, z1, z2] = z;
                    for i in 0..self.plane {
                        z0[i] = xx[i] * r0[i] + xy[i] * r1[i] + xz[i] * r2[i];
                        z1[i] = xy[i] * r0[i] + yy[i] * r1[i] + yz[i] * r2[i];
                        z2[i] = xz[i] * r0[i] + yz[i] * r1[i] + zz[i] * r2[i];
                    }
                    if let Some((coarse, below)) = &below {
                        coarse.add_plane(below, 0, k, z0, &mut room);
                        coarse.add_plane(below, 1, k, z1, &mut room);
                        coarse.add_plane(below, 2, k, z2, &mut room);
                    }
                    dot(r0, z0) + dot(r1, z1) + dot(r2, z2)
                },
            )
        });
        sum(parts.collect())
    }

    fn iterate(
        &self,
        mut r: Vec<f32>,
        x: &mut [f32],
        tolerance: f64,
        limit: usize,
        mut operator: impl FnMut(&[f32], &mut [f32]) -> f64,
    ) -> SolveReport {
        // What the matrix makes of a direction, and by turns what the preconditioner makes of the residual.
        let mut made = vec![0.0f32; x.len()];
        if x.iter().any(|&v| v != 0.0) {
            operator(x, &mut made);
            r.iter_mut().zip(&made).for_each(|(r, a)| *r -= a);
        }
        let mut rz = self.precondition(&r, &mut made);
        let mut p = made.clone();
        let first = rz;
        let mut iterations = 0;
        while iterations < limit && rz > tolerance * tolerance * first && rz > 0.0 {
            let curvature = operator(&p, &mut made);
            if !(curvature > 0.0 && curvature.is_finite()) {
                break;
            }
            let alpha = (rz / curvature) as f32;
            planes::<3>(x, self.plane).zip(planes::<3>(&mut r, self.plane)).for_each(|((k, x), (_, r))| {
                let at = k * self.plane..(k + 1) * self.plane;
                let (p, a) = (thirds(&p).map(|p| &p[at.clone()]), thirds(&made).map(|a| &a[at.clone()]));
                dispatch(
                    #[inline(always)]
                    || {
                        for (((x, r), p), a) in x.into_iter().zip(r).zip(p).zip(a) {
                            for i in 0..self.plane {
                                x[i] += alpha * p[i];
                                r[i] -= alpha * a[i];
                            }
                        }
                    },
                );
            });
            let next = self.precondition(&r, &mut made);
            let beta = (next / rz) as f32;
            rz = next;
            dispatch(
                #[inline(always)]
                || {
                    for (p, z) in p.iter_mut().zip(&made) {
                        *p = z + beta * *p;
                    }
                },
            );
            iterations += 1;
        }
        SolveReport { iterations, residual: if first > 0.0 { (rz / first).max(0.0).sqrt() } else { 0.0 } }
    }
}

/// The three components of a planar vector.
fn thirds(v: &[f32]) -> [&[f32]; 3] {
    let n = v.len() / 3;
    [&v[..n], &v[n..2 * n], &v[2 * n..]]
}

/// Part `at` of six planar quantities of `n` values.
#[inline(always)]
fn sixths<'a>(v: &'a [f32], n: usize, at: &Range<usize>) -> [&'a [f32]; 6] {
    std::array::from_fn(|q| &v[q * n + at.start..q * n + at.end])
}

/// The node planes of `N` planar quantities with their index, to be filled in parallel.
fn planes<const N: usize>(
    v: &mut [f32],
    plane: usize,
) -> impl IndexedParallelIterator<Item = (usize, [&mut [f32]; N])> {
    let n = v.len() / N;
    let mut parts = v.chunks_exact_mut(n.max(1));
    let mut quantities: [_; N] = std::array::from_fn(|_| parts.next().unwrap_or_default().chunks_mut(plane));
    let plane_of = |_| std::array::from_fn(|q| quantities[q].next().unwrap_or_default());
    let planes: Vec<[&mut [f32]; N]> = (0..n / plane).map(plane_of).collect();
    planes.into_par_iter().with_min_len(worthwhile(plane)).enumerate()
}

/// Planes of `plane` nodes that are worth handing to another thread.
fn worthwhile(plane: usize) -> usize {
    (1 << 13) / plane.max(1) + 1
}

/// Sum of products in sixteen partial sums.
#[inline(always)]
fn dot(a: &[f32], b: &[f32]) -> f64 {
    f64::from(crate::numerics::simd::dot(a, b))
}

fn sum(parts: Vec<f64>) -> f64 {
    parts.iter().sum()
}
