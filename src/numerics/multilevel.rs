//! A multilevel preconditioner for spline lattices (Bramble, Pasciak & Xu 1990,
//! doi:10.1090/S0025-5718-1990-1023042-6).
//!
//! A smooth error cannot be seen in 3 x 3 blocks: with them alone conjugate gradients need as many
//! iterations as the lattice is wide, squared, wherever the data are weak. Each coarser lattice, of
//! twice the step, holds the same splines' smoother part exactly (two-scale relation: 1, 4, 6, 4, 1
//! eighths along each axis), so the inverse blocks of all lattices are added up.

use crate::numerics::simd::dispatch;
use crate::numerics::symmetric3::inverse;
use rayon::prelude::*;

/// Two-scale weights of the cubic B-spline: coarse node `m` stands on fine node `2 m - 1`.
const TWO_SCALE: [f32; 5] = [0.125, 0.5, 0.75, 0.5, 0.125];

/// Most nodes of an axis that is not coarsened further.
const MAX_COARSEST_NODES: usize = 6;

/// A coarser lattice with the inverse blocks of the matrix there.
pub(super) struct Coarse {
    /// Nodes of the lattice it was made from.
    fine: [usize; 3],
    nodes: [usize; 3],
    /// Inverse 3 x 3 blocks, planar: xx, yy, zz, xy, xz, yz.
    inverse: Vec<f32>,
    next: Option<Box<Coarse>>,
}

impl Coarse {
    /// For `A + D^T W D` on `fine` nodes `step_mm` apart, with `blocks` the planar blocks of `A`
    /// and `weights` (planar, three components) the diagonal of `W`; none where the lattice is too
    /// small.
    pub(super) fn new(fine: [usize; 3], step_mm: [f64; 3], weights: &[f32], blocks: &[f32]) -> Option<Box<Self>> {
        let shape = fine.map(|n| if n > 1 { vec![1.0] } else { Vec::new() });
        Self::below(fine, step_mm, weights, blocks, &shape)
    }

    /// `shape` is the lattice's basis function along each axis in coefficients of the finest
    /// lattice; empty for one node.
    fn below(
        fine: [usize; 3],
        step_mm: [f64; 3],
        weights: &[f32],
        blocks: &[f32],
        shape: &[Vec<f64>; 3],
    ) -> Option<Box<Self>> {
        let nodes = fine.map(|n| if n > MAX_COARSEST_NODES { (n + 2) / 2 + 1 } else { n });
        if nodes == fine {
            return None;
        }
        let shape: [Vec<f64>; 3] =
            std::array::from_fn(|a| if nodes[a] < fine[a] { subdivided(&shape[a]) } else { shape[a].clone() });
        let (m, n) = (fine.iter().product::<usize>(), nodes.iter().product::<usize>());
        let mut coarse = vec![0.0f32; 6 * n];
        for (from, to) in blocks.chunks_exact(m).zip(coarse.chunks_exact_mut(n)) {
            restrict(from, fine, nodes, &TWO_SCALE, to);
        }
        let energy = energy(&shape, step_mm);
        let weights = nearest(weights, fine, nodes);
        let mut inverses = vec![0.0f32; 6 * n];
        for i in 0..n {
            let mut b: [f64; 6] = std::array::from_fn(|q| f64::from(coarse[q * n + i]));
            (0..3).for_each(|c| b[c] += (f64::from(weights[c * n + i]) * energy).max(1e-12));
            let inverse = inverse(&b).unwrap_or([1.0 / b[0], 1.0 / b[1], 1.0 / b[2], 0.0, 0.0, 0.0]);
            (0..6).for_each(|q| inverses[q * n + i] = inverse[q] as f32);
        }
        let next = Self::below(nodes, step_mm, &weights, &coarse, &shape);
        Some(Box::new(Self { fine, nodes, inverse: inverses, next }))
    }

    /// The coarse lattices' part of `M^-1 r`, on this lattice's nodes.
    pub(super) fn solve(&self, r: &[f32]) -> Vec<f32> {
        let (m, n) = (self.fine.iter().product::<usize>(), self.nodes.iter().product::<usize>());
        let mut own = vec![0.0f32; 3 * n];
        for (from, to) in r.chunks_exact(m).zip(own.chunks_exact_mut(n)) {
            restrict(from, self.fine, self.nodes, &TWO_SCALE, to);
        }
        let below = self.next.as_ref().map(|next| next.solve(&own));
        let [xx, yy, zz, xy, xz, yz] = std::array::from_fn(|q| &self.inverse[q * n..(q + 1) * n]);
        let (x, rest) = own.split_at_mut(n);
        let (y, z) = rest.split_at_mut(n);
        for i in 0..n {
            let r = [x[i], y[i], z[i]];
            x[i] = xx[i] * r[0] + xy[i] * r[1] + xz[i] * r[2];
            y[i] = xy[i] * r[0] + yy[i] * r[1] + yz[i] * r[2];
            z[i] = xz[i] * r[0] + yz[i] * r[1] + zz[i] * r[2];
        }
        if let (Some(next), Some(below)) = (&self.next, &below) {
            let plane = self.nodes[0] * self.nodes[1];
            let mut room = Vec::new();
            for (k, out) in own.chunks_exact_mut(plane).enumerate() {
                let (component, k) = (k / self.nodes[2], k % self.nodes[2]);
                next.add_plane(below, component, k, out, &mut room);
            }
        }
        own
    }

    /// Adds plane `k` (of the finer lattice) of one component of a vector on this lattice. `room`
    /// is scratch.
    #[inline(always)]
    pub(super) fn add_plane(&self, coarse: &[f32], component: usize, k: usize, out: &mut [f32], room: &mut Vec<f32>) {
        let ([mx, my, mz], [nx, ny, nz]) = (self.nodes, self.fine);
        let n = mx * my * mz;
        let source = &coarse[component * n..(component + 1) * n];
        room.clear();
        room.resize(mx * my + mx + 1, 0.0);
        let (plane, row) = room.split_at_mut(mx * my);
        for (m, w) in parents(k, nz, mz) {
            add(w, &source[m * mx * my..(m + 1) * mx * my], plane);
        }
        for (j, out) in out.chunks_exact_mut(nx).enumerate() {
            row.fill(0.0);
            for (m, w) in parents(j, ny, my) {
                add(w, &plane[m * mx..(m + 1) * mx], row);
            }
            if mx == nx {
                add(1.0, &row[..nx], out);
                continue;
            }
            // Even nodes lie half way between two parents, odd ones on a parent.
            for (pair, p) in out.chunks_mut(2).zip(row.windows(3)) {
                pair[0] += 0.5 * (p[0] + p[1]);
                if let Some(odd) = pair.get_mut(1) {
                    *odd += 0.125 * (p[0] + p[2]) + 0.75 * p[1];
                }
            }
        }
    }
}

/// A planar vector of three components at the fine node nearest to each coarse one.
fn nearest(values: &[f32], fine: [usize; 3], nodes: [usize; 3]) -> Vec<f32> {
    let along = |m: usize, a: usize| match nodes[a] == fine[a] {
        true => m,
        false => (2 * m).saturating_sub(1).min(fine[a] - 1),
    };
    let ([nx, ny, nz], [mx, my, mz]) = (fine, nodes);
    let mut out = Vec::with_capacity(3 * mx * my * mz);
    for values in values.chunks_exact(nx * ny * nz) {
        for (k, j) in (0..mz).flat_map(|k| (0..my).map(move |j| (k, j))) {
            let row = &values[nx * (along(j, 1) + ny * along(k, 2))..][..nx];
            out.extend((0..mx).map(|i| row[along(i, 0)]));
        }
    }
    out
}

/// The coarse nodes that make up fine node `at` along an axis, with their weights (some may be
/// zero).
#[inline(always)]
fn parents(at: usize, fine: usize, coarse: usize) -> [(usize, f32); 3] {
    if fine == coarse {
        return [(at, 1.0), (at, 0.0), (at, 0.0)];
    }
    let m = at / 2;
    if at.is_multiple_of(2) { [(m, 0.5), (m + 1, 0.5), (m, 0.0)] } else { [(m, 0.125), (m + 1, 0.75), (m + 2, 0.125)] }
}

#[inline(always)]
fn add(w: f32, from: &[f32], to: &mut [f32]) {
    if w != 0.0 {
        to.iter_mut().zip(from).for_each(|(t, f)| *t += w * f);
    }
}

/// `to[m] = sum_d weights[d] from[2 m - 1 + d - 2]` along each coarsened axis.
fn restrict(from: &[f32], fine: [usize; 3], nodes: [usize; 3], weights: &[f32; 5], to: &mut [f32]) {
    let ([nx, ny, nz], [mx, my, mz]) = (fine, nodes);
    // Children of coarse node `m`: fine nodes and their weights.
    let children = |m: usize, coarse: usize, fine: usize| -> [(usize, f32); 5] {
        if coarse == fine {
            return std::array::from_fn(|d| (m, if d == 0 { 1.0 } else { 0.0 }));
        }
        std::array::from_fn(|d| match (2 * m + d).checked_sub(3) {
            Some(at) if at < fine => (at, weights[d]),
            _ => (0, 0.0),
        })
    };
    let heavy = (1 << 12) / (mx * my).max(1) + 1;
    to.par_chunks_exact_mut(mx * my).with_min_len(heavy).enumerate().for_each(|(k, to)| {
        let (mut plane, mut row) = (vec![0.0f32; nx * ny], vec![0.0f32; nx + 8]);
        dispatch(
            #[inline(always)]
            || {
                for (at, w) in children(k, mz, nz) {
                    add(w, &from[at * nx * ny..(at + 1) * nx * ny], &mut plane);
                }
                for (j, to) in to.chunks_exact_mut(mx).enumerate() {
                    row.fill(0.0);
                    for (at, w) in children(j, my, ny) {
                        add(w, &plane[at * nx..(at + 1) * nx], &mut row[3..nx + 3]);
                    }
                    if mx == nx {
                        to.copy_from_slice(&row[3..nx + 3]);
                        continue;
                    }
                    for (m, to) in to.iter_mut().enumerate() {
                        let r: &[f32] = &row[2 * m..2 * m + 5];
                        *to = (0..5).map(|d| weights[d] * r[d]).sum();
                    }
                }
            },
        );
    });
}

/// Coefficients on a lattice twice as fine.
fn subdivided(shape: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; 2 * shape.len() + 3];
    for (i, v) in shape.iter().enumerate() {
        for (d, w) in TWO_SCALE.iter().enumerate() {
            out[2 * i + d] += v * f64::from(*w);
        }
    }
    out
}

/// Bending energy of one basis function, away from the border.
fn energy(shape: &[Vec<f64>; 3], step_mm: [f64; 3]) -> f64 {
    let squares = |v: &[f64]| v.iter().map(|x| x * x).sum::<f64>();
    let difference = |v: &[f64]| -> Vec<f64> {
        (0..=v.len()).map(|i| v.get(i).unwrap_or(&0.0) - if i > 0 { v[i - 1] } else { 0.0 }).collect()
    };
    // Sums of squares of the function and of its first and second differences along each axis.
    let moments = shape.each_ref().map(|s| {
        if s.is_empty() {
            return [1.0, 0.0, 0.0];
        }
        let first = difference(s);
        [squares(s), squares(&first), squares(&difference(&first))]
    });
    let mut sum = 0.0;
    for a in 0..3 {
        let (b, c) = ((a + 1) % 3, (a + 2) % 3);
        sum += moments[a][2] * moments[b][0] * moments[c][0] / step_mm[a].powi(4);
        sum += 2.0 * moments[b][1] * moments[c][1] * moments[a][0] / (step_mm[b] * step_mm[c]).powi(2);
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Restriction is the transpose of prolongation, so that the preconditioner is symmetric.
    #[test]
    fn restriction_is_the_transpose_of_prolongation() {
        for fine in [[9, 12, 7], [13, 8, 1], [10, 5, 11]] {
            let n: usize = fine.iter().product();
            let Some(c) = Coarse::new(fine, [1.0; 3], &vec![1.0; 3 * n], &vec![0.0; 6 * n]) else { panic!("{fine:?}") };
            let m: usize = c.nodes.iter().product();
            let number = |i: usize| ((i * 7919 + 13) % 101) as f32 / 50.0 - 1.0;
            let (x, y): (Vec<f32>, Vec<f32>) = ((0..n).map(number).collect(), (0..m).map(|i| number(3 * i)).collect());
            let mut down = vec![0.0; m];
            restrict(&x, fine, c.nodes, &TWO_SCALE, &mut down);
            let mut up = vec![0.0; n];
            let three: Vec<f32> = y.iter().chain(&y).chain(&y).copied().collect();
            for (k, plane) in up.chunks_exact_mut(fine[0] * fine[1]).enumerate() {
                c.add_plane(&three, 1, k, plane, &mut Vec::new());
            }
            let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from(a * b)).sum::<f64>();
            let (left, right) = (dot(&down, &y), dot(&x, &up));
            assert!((left - right).abs() < 1e-4 * (1.0 + left.abs()), "{fine:?}: {left} {right}");
        }
    }
}
