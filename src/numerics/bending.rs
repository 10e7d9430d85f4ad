//! The smoothness energy of a lattice of vectors, and the sparse solve that couples data to it.
//!
//! Energy (per component): `sum over nodes of |second differences|^2 / mm^4` over all six second
//! derivatives (a P-spline penalty, Eilers & Marx 1996; bending energy of Rueckert et al. 1999). An
//! affine field costs nothing.

use crate::numerics::block_diagonal::Blocks;
use crate::numerics::multilevel::Coarse;
use crate::numerics::random::Random;
use crate::numerics::simd::dispatch;
use crate::numerics::symmetric3::inverse;
use rayon::prelude::*;
use std::ops::Range;

/// Second differences on a lattice of nodes, and what an energy of them weighs by place.
#[derive(Debug, Clone)]
pub struct Smoothness {
    nodes: [usize; 3],
    /// Node distances (mm).
    step_mm: [f64; 3],
    /// Weights of the squared differences along x, y, z and of the mixed ones xy, xz, yz (1/mm^4);
    /// 0 along a flat axis.
    scale: [f32; 6],
    /// Of a plane's nodes, 1 but on the last column; 1 but on the first and the last one.
    inner: [Vec<f32>; 2],
}

impl Smoothness {
    /// On `nodes` at distances `step_mm`.
    pub fn new(nodes: [usize; 3], step_mm: [f64; 3]) -> Self {
        let pure = |a: usize| if nodes[a] >= 3 { step_mm[a].powi(-4) } else { 0.0 };
        let mixed = |a: usize, b: usize| {
            if nodes[a].min(nodes[b]) >= 2 { 2.0 / (step_mm[a] * step_mm[b]).powi(2) } else { 0.0 }
        };
        let scale = [pure(0), pure(1), pure(2), mixed(0, 1), mixed(0, 2), mixed(1, 2)];
        let column = |first: usize| {
            let one = move |i: usize| if i >= first && i + 1 < nodes[0] { 1.0 } else { 0.0 };
            (0..nodes[1]).flat_map(|_| (0..nodes[0]).map(one)).collect()
        };
        Self { nodes, step_mm, scale: scale.map(|v| v as f32), inner: [0, 1].map(column) }
    }

    /// Number of nodes.
    pub fn len(&self) -> usize {
        self.nodes.iter().product()
    }

    /// Never true.
    pub fn is_empty(&self) -> bool {
        false
    }

    /// `out = D^T W D x` for one planar component, with `weight` (one a node) on the squared
    /// differences about each node.
    pub fn apply(&self, weight: &[f32], x: &[f32], out: &mut [f32]) {
        let plane = self.nodes[0] * self.nodes[1];
        let slab = planes_per_task(plane);
        out.par_chunks_mut(slab * plane).enumerate().for_each(|(s, out)| {
            let mut differences = Differences::new(self, weight, x, s * slab);
            for out in out.chunks_exact_mut(plane) {
                dispatch(
                    #[inline(always)]
                    || differences.transposed(out),
                );
            }
        });
    }

    /// The energy about each node of one planar component, under a weight of 1.
    pub fn density(&self, x: &[f32]) -> Vec<f32> {
        let [nx, ny, nz] = self.nodes;
        let plane = nx * ny;
        let mut out = vec![0.0f32; x.len()];
        out.par_chunks_mut(plane).with_min_len(planes_per_task(plane)).enumerate().for_each(|(k, out)| {
            dispatch(
                #[inline(always)]
                || {
                    for j in 0..ny {
                        let row = |dj: usize, dk: usize| &x[nx * (j + dj + ny * (k + dk))..][..nx];
                        let here = row(0, 0);
                        let out = &mut out[nx * j..][..nx];
                        let mut add = |scale: f32, i: usize, d: f32| out[i] += scale * d * d;
                        let [xx, yy, zz, xy, xz, yz] = self.scale;
                        for i in 1..nx.saturating_sub(1) {
                            add(xx, i, here[i - 1] - 2.0 * here[i] + here[i + 1]);
                        }
                        if j > 0 && j + 1 < ny {
                            let (low, high) = (&x[nx * (j - 1 + ny * k)..][..nx], row(1, 0));
                            (0..nx).for_each(|i| add(yy, i, low[i] - 2.0 * here[i] + high[i]));
                        }
                        if k > 0 && k + 1 < nz {
                            let (low, high) = (&x[nx * (j + ny * (k - 1))..][..nx], row(0, 1));
                            (0..nx).for_each(|i| add(zz, i, low[i] - 2.0 * here[i] + high[i]));
                        }
                        if j + 1 < ny {
                            let next = row(1, 0);
                            (0..nx - 1).for_each(|i| add(xy, i, next[i + 1] - next[i] - here[i + 1] + here[i]));
                        }
                        if k + 1 < nz {
                            let above = row(0, 1);
                            (0..nx - 1).for_each(|i| add(xz, i, above[i + 1] - above[i] - here[i + 1] + here[i]));
                        }
                        if j + 1 < ny && k + 1 < nz {
                            let (next, above, far) = (row(1, 0), row(0, 1), row(1, 1));
                            (0..nx).for_each(|i| add(yz, i, far[i] - next[i] - above[i] + here[i]));
                        }
                    }
                },
            );
        });
        out
    }

    /// Each tap of each squared difference: the node that weighs it, its taps, and its scale.
    fn for_each_difference(&self, mut each: impl FnMut(usize, &[(usize, f32)], f32)) {
        let [nx, ny, nz] = self.nodes;
        let stride = [1, nx, nx * ny];
        for (k, j, i) in (0..nz).flat_map(|k| (0..ny).flat_map(move |j| (0..nx).map(move |i| (k, j, i)))) {
            let at = [i, j, k];
            let m = i + nx * (j + ny * k);
            for a in 0..3 {
                let s = stride[a];
                if self.scale[a] > 0.0 && at[a] > 0 && at[a] + 1 < self.nodes[a] {
                    each(m, &[(m - s, 1.0), (m, -2.0), (m + s, 1.0)], self.scale[a]);
                }
            }
            for (q, (a, b)) in [(0, 1), (0, 2), (1, 2)].into_iter().enumerate() {
                let (s, t) = (stride[a], stride[b]);
                if self.scale[3 + q] > 0.0 && at[a] + 1 < self.nodes[a] && at[b] + 1 < self.nodes[b] {
                    each(m, &[(m, 1.0), (m + s, -1.0), (m + t, -1.0), (m + s + t, 1.0)], self.scale[3 + q]);
                }
            }
        }
    }

    /// Diagonal of `D^T W D` for one component.
    pub fn diagonal(&self, weight: &[f32]) -> Vec<f32> {
        let mut out = vec![0.0f32; weight.len()];
        self.for_each_difference(|m, taps, scale| {
            taps.iter().for_each(|&(at, s)| out[at] += weight[m] * scale * s * s);
        });
        out
    }

    /// A random vector with covariance `D^T W D` (one planar component): the transpose of the
    /// weighted differences applied to independent standard normal numbers.
    pub fn sample(&self, weight: &[f32], random: &mut Random) -> Vec<f32> {
        let mut out = vec![0.0f32; weight.len()];
        let mut spare = None;
        self.for_each_difference(|m, taps, scale| {
            let e = spare.take().unwrap_or_else(|| {
                let [a, b] = random.normals();
                spare = Some(b);
                a
            });
            let e = (weight[m] * scale).sqrt() * e as f32;
            taps.iter().for_each(|&(at, s)| out[at] += s * e);
        });
        out
    }

    /// The energy of each component of a planar vector field, under a weight of 1.
    pub fn energy(&self, x: &[f32]) -> [f64; 3] {
        thirds(x).map(|x| self.density(x).iter().map(|v| f64::from(*v)).sum())
    }
}

/// Weighted differences of one component, plane by plane upwards. Each is zero where it has no
/// taps, so rows follow one another without a seam.
struct Differences<'a> {
    of: &'a Smoothness,
    weight: &'a [f32],
    x: &'a [f32],
    /// The plane whose transpose is next.
    k: usize,
    /// Second differences along z about the plane below, the plane itself and the one above.
    along: [Vec<f32>; 3],
    /// Mixed differences xz and yz that start on the plane below and on the plane itself.
    tilted: [[Vec<f32>; 2]; 2],
    /// Differences within the plane: xx, yy, xy.
    flat: [Vec<f32>; 3],
}

impl<'a> Differences<'a> {
    fn new(of: &'a Smoothness, weight: &'a [f32], x: &'a [f32], k: usize) -> Self {
        let [nx, ny, _] = of.nodes;
        let room = || vec![0.0f32; nx * ny];
        let mut out = Self {
            of,
            weight,
            x,
            k,
            along: std::array::from_fn(|_| room()),
            tilted: std::array::from_fn(|_| std::array::from_fn(|_| room())),
            flat: std::array::from_fn(|_| room()),
        };
        if k > 0 {
            out.fill_along(k - 1, 1);
            out.fill_tilted(k - 1);
        }
        out.fill_along(k, 2);
        out
    }

    /// Second differences along z about plane `k`, where there are any.
    #[inline(always)]
    fn fill_along(&mut self, k: usize, slot: usize) {
        let plane = self.along[0].len();
        let out = &mut self.along[slot];
        if k == 0 || k + 1 >= self.of.nodes[2] {
            return out.fill(0.0);
        }
        let at = |k: usize| &self.x[k * plane..][..plane];
        let (low, here, high, weight) = (at(k - 1), at(k), at(k + 1), &self.weight[k * plane..][..plane]);
        let scale = self.of.scale[2];
        for i in 0..plane {
            out[i] = scale * weight[i] * ((low[i] - here[i]) + (high[i] - here[i]));
        }
    }

    /// Mixed differences with z that start on plane `k`, where there are any.
    #[inline(always)]
    fn fill_tilted(&mut self, k: usize) {
        let [nx, ny, nz] = self.of.nodes;
        let plane = nx * ny;
        let [xz, yz] = &mut self.tilted[1];
        if k + 1 >= nz {
            xz.fill(0.0);
            return yz.fill(0.0);
        }
        let (here, above) = (&self.x[k * plane..][..plane], &self.x[(k + 1) * plane..][..plane]);
        let weight = &self.weight[k * plane..][..plane];
        let [.., a, b] = self.of.scale;
        let n = plane - 1;
        let (h, u, h1, u1) = (&here[..n], &above[..n], &here[1..], &above[1..]);
        let (xz, w, inner) = (&mut xz[..n], &weight[..n], &self.of.inner[0][..n]);
        for i in 0..n {
            xz[i] = a * inner[i] * w[i] * ((u1[i] - u[i]) - (h1[i] - h[i]));
        }
        let n = plane - nx;
        let (h, u, h1, u1) = (&here[..n], &above[..n], &here[nx..], &above[nx..]);
        let (yz, w) = (&mut yz[..n], &weight[..n]);
        for i in 0..n {
            yz[i] = b * w[i] * ((u1[i] - u[i]) - (h1[i] - h[i]));
        }
    }

    /// Differences within plane `k`.
    #[inline(always)]
    fn fill_flat(&mut self, k: usize) {
        let [nx, ny, _] = self.of.nodes;
        let plane = nx * ny;
        let x = &self.x[k * plane..][..plane];
        let weight = &self.weight[k * plane..][..plane];
        let [xx, yy, xy] = &mut self.flat;
        let [a, b, _, c, ..] = self.of.scale;
        if plane > 2 {
            let n = plane - 2;
            let (low, here, high) = (&x[..n], &x[1..][..n], &x[2..]);
            let (xx, w, inner) = (&mut xx[1..][..n], &weight[1..][..n], &self.of.inner[1][1..][..n]);
            for i in 0..n {
                xx[i] = a * inner[i] * w[i] * ((low[i] - here[i]) + (high[i] - here[i]));
            }
        }
        if ny > 2 {
            let n = plane - 2 * nx;
            let (low, here, high) = (&x[..n], &x[nx..][..n], &x[2 * nx..]);
            let (yy, w) = (&mut yy[nx..][..n], &weight[nx..][..n]);
            for i in 0..n {
                yy[i] = b * w[i] * ((low[i] - here[i]) + (high[i] - here[i]));
            }
        }
        if ny > 1 && nx > 1 {
            let n = plane - nx - 1;
            let (here, right, next, far) = (&x[..n], &x[1..][..n], &x[nx..][..n], &x[nx + 1..]);
            let (xy, w, inner) = (&mut xy[..n], &weight[..n], &self.of.inner[0][..n]);
            for i in 0..n {
                xy[i] = c * inner[i] * w[i] * ((far[i] - next[i]) - (right[i] - here[i]));
            }
        }
    }

    /// The next plane of `D^T W D x`.
    #[inline(always)]
    fn transposed(&mut self, out: &mut [f32]) {
        let nx = self.of.nodes[0];
        let k = self.k;
        self.along.rotate_left(1);
        self.fill_along(k + 1, 2);
        self.tilted.rotate_left(1);
        self.fill_tilted(k);
        self.fill_flat(k);
        self.k += 1;
        let [low, here, high] = &self.along;
        let [[xz0, yz0], [xz1, yz1]] = &self.tilted;
        let [xx, yy, xy] = &self.flat;
        let plane = out.len();
        let [low, here, high, xz0, xz1] = [low, here, high, xz0, xz1].map(|v| &v[..plane]);
        let [yz0, yz1, xx, yy, xy] = [yz0, yz1, xx, yy, xy].map(|v| &v[..plane]);
        for i in 0..plane {
            out[i] = low[i] - 2.0 * (here[i] + xx[i] + yy[i]) + high[i] + xy[i] + xz1[i] - xz0[i] + yz1[i] - yz0[i];
        }
        // From a column to the right, a row on, and both.
        let n = plane - 1;
        let (right, xx, xy1) = (&mut out[1..], &xx[..n], &xy[..n]);
        let (xz0, xz1) = (&xz0[..n], &xz1[..n]);
        for i in 0..n {
            right[i] += xx[i] - xy1[i] + xz0[i] - xz1[i];
        }
        let (left, xx) = (&mut out[..n], &self.flat[0][1..]);
        for i in 0..n {
            left[i] += xx[i];
        }
        let n = plane - nx;
        let (next, yy0, xy1, yz0, yz1) = (&mut out[nx..], &yy[..n], &xy[..n], &yz0[..n], &yz1[..n]);
        for i in 0..n {
            next[i] += yy0[i] - xy1[i] + yz0[i] - yz1[i];
        }
        let (before, yy) = (&mut out[..n], &yy[nx..]);
        for i in 0..n {
            before[i] += yy[i];
        }
        if plane > nx + 1 {
            let n = plane - nx - 1;
            let (far, xy) = (&mut out[nx + 1..], &xy[..n]);
            for i in 0..n {
                far[i] += xy[i];
            }
        }
    }
}

/// How a solve went.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SolveReport {
    /// Iterations used.
    pub iterations: usize,
    /// Last residual over the first (1).
    pub residual: f64,
}

/// The matrix `A + D^T W D` with its preconditioner: information `A` of the data at the nodes and
/// the weighted bending energy.
///
/// Preconditioned by its 3 x 3 blocks alone, smooth errors go slowly; with `multilevel` coarser
/// lattices take them.
pub struct Coupled<'a> {
    smoothness: &'a Smoothness,
    /// Weight of the bending energy at each node, planar by component.
    weights: &'a [f32],
    /// Nodes of a plane.
    plane: usize,
    /// Information at the nodes.
    blocks: &'a Blocks,
    /// Inverse 3 x 3 diagonal blocks of the whole matrix.
    inverse: Blocks,
    coarse: Option<Box<Coarse>>,
}

impl<'a> Coupled<'a> {
    /// With `weights` of the bending energy, three planar components of one a node.
    pub fn new(smoothness: &'a Smoothness, weights: &'a [f32], blocks: &'a Blocks, multilevel: bool) -> Self {
        let plane = smoothness.nodes[0] * smoothness.nodes[1];
        let n = blocks.len();
        let diagonal = thirds(weights).map(|w| smoothness.diagonal(w));
        let mut inverses = vec![0.0; 6 * n];
        planes::<6>(&mut inverses, plane).for_each(|(k, mut out)| {
            for i in 0..out[0].len() {
                let at = k * plane + i;
                let mut m = blocks.at(at).map(f64::from);
                for (v, diagonal) in m.iter_mut().zip(&diagonal) {
                    *v += f64::from(diagonal[at]) + 1e-12;
                }
                let inverse = inverse(&m).unwrap_or([1.0 / m[0], 1.0 / m[1], 1.0 / m[2], 0.0, 0.0, 0.0]);
                out.iter_mut().zip(inverse).for_each(|(out, v)| out[i] = v as f32);
            }
        });
        let below = || Coarse::new(smoothness.nodes, smoothness.step_mm, weights, blocks.planar());
        Self {
            smoothness,
            weights,
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

    /// Its weight at each node, planar by component.
    pub fn weights(&self) -> &[f32] {
        self.weights
    }

    /// The information at the nodes.
    pub fn blocks(&self) -> &Blocks {
        self.blocks
    }

    /// Conjugate gradients (Hestenes & Stiefel 1952) for right-hand side `b`, `b` and `x` planar.
    ///
    /// `x` holds the start and receives the result. Stops at `tolerance` (relative residual) or
    /// after `limit` iterations.
    pub fn solve(&self, b: Vec<f32>, x: &mut [f32], tolerance: f64, limit: usize) -> SolveReport {
        self.iterate(b, x, tolerance, limit, |p, ap| self.apply(p, ap, None))
    }

    /// The same where `data` writes what the data make of its first argument into its second
    /// (planar, three components).
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

    /// `out = A x + D^T W D x`, with `A x` given or from the blocks; returns `x . out`. Sums go
    /// plane by plane, so that they are the same whatever the number of threads.
    fn apply(&self, x: &[f32], out: &mut [f32], data: Option<&[f32]>) -> f64 {
        let n = x.len() / 3;
        for ((x, out), weight) in x.chunks_exact(n).zip(out.chunks_exact_mut(n)).zip(self.weights.chunks_exact(n)) {
            self.smoothness.apply(weight, x, out);
        }
        let [x0, x1, x2] = thirds(x);
        let parts = planes(out, self.plane).map(|(k, [o0, o1, o2])| {
            let at = k * self.plane..(k + 1) * self.plane;
            let (x, y, z) = (&x0[at.clone()], &x1[at.clone()], &x2[at.clone()]);
            dispatch(
                #[inline(always)]
                || {
                    match data {
                        Some(d) => {
                            let [d0, d1, d2] = thirds(d).map(|d| &d[at.clone()]);
                            for i in 0..x.len() {
                                (o0[i], o1[i], o2[i]) = (o0[i] + d0[i], o1[i] + d1[i], o2[i] + d2[i]);
                            }
                        }
                        None => {
                            let [xx, yy, zz, xy, xz, yz] = sixths(self.blocks.planar(), n, &at);
                            for i in 0..x.len() {
                                o0[i] += xx[i] * x[i] + xy[i] * y[i] + xz[i] * z[i];
                                o1[i] += xy[i] * x[i] + yy[i] * y[i] + yz[i] * z[i];
                                o2[i] += xz[i] * x[i] + yz[i] * y[i] + zz[i] * z[i];
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
        // What the matrix makes of a direction, and by turns what the preconditioner makes of the
        // residual.
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
    planes.into_par_iter().with_min_len(planes_per_task(plane)).enumerate()
}

/// Planes of `plane` nodes that are worth handing to another thread.
fn planes_per_task(plane: usize) -> usize {
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
