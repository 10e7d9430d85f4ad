//! Cubic B-spline lattices: a smooth vector field from few coefficients, its transpose, and
//! shift-consistent sampling.
//!
//! A [`Lattice`] lies over a voxel grid with a whole number of voxels between nodes, so that the
//! basis has few phases and a field is evaluated row by row (Rueckert et al. 1999, eq. 3, here
//! separable). A side of one voxel has one node and no variation. Coefficients are planar: all
//! first components, then all second, then all third.

use crate::numerics::cubic::{self, LANES, Places};
use crate::numerics::simd::dispatch;
use crate::types::{GridVector, VoxelPoint};
use rayon::prelude::*;
use std::ops::Range;

/// Most values of cell sums along z in memory, unless the threads need more cells: 128 cells of a
/// lattice of 131 x 152 nodes a plane took 0.4 GB.
const MAX_VALUES_IN_MEMORY: usize = 1 << 22;

/// The four cubic B-spline weights at fraction `t` (0 to 1) between the second and the third node.
#[inline(always)]
pub fn weights(t: f32) -> [f32; 4] {
    let u = 1.0 - t;
    let (t2, u2) = (t * t, u * u);
    [u2 * u / 6.0, 2.0 / 3.0 - 0.5 * t2 * (2.0 - t), 2.0 / 3.0 - 0.5 * u2 * (2.0 - u), t2 * t / 6.0]
}

/// Nodes over a voxel grid.
#[derive(Debug, Clone, PartialEq)]
pub struct Lattice {
    /// Voxels of the grid below.
    pub shape: [usize; 3],
    /// Voxels between nodes.
    pub step: [usize; 3],
    /// Nodes along each axis. Node `n` lies at voxel `(n - 1) * step` (at 0 for a side of one
    /// voxel).
    pub nodes: [usize; 3],
    phases: [Vec<[f32; 4]>; 3],
    /// The first phases along x, by node.
    across: [[f32; ROW_LANES]; 4],
}

/// Voxels along x computed together.
const ROW_LANES: usize = 8;

impl Lattice {
    /// A lattice of `step` voxels over `shape`.
    pub fn new(shape: [usize; 3], step: [usize; 3]) -> Self {
        let step: [usize; 3] = std::array::from_fn(|a| if shape[a] == 1 { 1 } else { step[a].max(1) });
        let nodes = std::array::from_fn(|a| if shape[a] == 1 { 1 } else { (shape[a] - 1) / step[a] + 4 });
        let phases: [Vec<[f32; 4]>; 3] = std::array::from_fn(|a| {
            if shape[a] == 1 {
                vec![[1.0, 0.0, 0.0, 0.0]]
            } else {
                (0..step[a]).map(|i| weights(i as f32 / step[a] as f32)).collect()
            }
        });
        let across = std::array::from_fn(|m| {
            std::array::from_fn(|phase| phases[0].get(phase).map_or(0.0, |weights| weights[m]))
        });
        Self { shape, step, nodes, phases, across }
    }

    /// Number of nodes.
    pub fn len(&self) -> usize {
        self.nodes.iter().product()
    }

    /// Never true.
    pub fn is_empty(&self) -> bool {
        false
    }

    /// Where node `m` stands (voxels): the outermost nodes lie beyond the grid.
    pub fn place(&self, m: usize) -> VoxelPoint {
        let [nx, ny, _] = self.nodes;
        let index = [m % nx, m / nx % ny, m / (nx * ny)];
        VoxelPoint(std::array::from_fn(|a| (index[a] as f64 - 1.0) * self.step[a] as f64))
    }

    /// Where node `m` stands, or the nearest place of the grid to it (voxels).
    pub fn within(&self, m: usize) -> VoxelPoint {
        let at = self.place(m).0;
        VoxelPoint(std::array::from_fn(|a| at[a].clamp(0.0, (self.shape[a] - 1) as f64)))
    }

    /// How many nodes act along axis `a`: 4, or 1 for a side of one voxel.
    #[inline(always)]
    fn taps(&self, a: usize) -> usize {
        self.nodes[a].min(4)
    }

    /// First node and weights for voxel `i` of axis `a`.
    #[inline(always)]
    fn stencil(&self, a: usize, i: usize) -> (usize, &[f32; 4]) {
        (i / self.step[a], &self.phases[a][i % self.step[a]])
    }

    /// First node and weights at a fractional voxel position, clamped to the grid.
    #[inline(always)]
    fn stencil_at(&self, a: usize, p: f64) -> (usize, [f32; 4]) {
        if self.nodes[a] == 1 {
            return (0, [1.0, 0.0, 0.0, 0.0]);
        }
        let q = p.clamp(0.0, (self.shape[a] - 1) as f64) / self.step[a] as f64;
        let cell = (q as usize).min(self.nodes[a] - 4);
        (cell, weights((q - cell as f64) as f32))
    }

    /// Calls `tap(node, weight)` for each of the at most 64 nodes that act at a fractional voxel
    /// position.
    #[inline(always)]
    pub fn for_each_tap(&self, VoxelPoint(p): VoxelPoint, mut tap: impl FnMut(usize, f32)) {
        let s: [(usize, [f32; 4]); 3] = std::array::from_fn(|a| self.stencil_at(a, p[a]));
        for c in 0..self.taps(2) {
            for b in 0..self.taps(1) {
                let row = self.nodes[0] * (s[1].0 + b + self.nodes[1] * (s[2].0 + c));
                let w = s[1].1[b] * s[2].1[c];
                for a in 0..self.taps(0) {
                    tap(row + s[0].0 + a, w * s[0].1[a]);
                }
            }
        }
    }

    /// The nodes that act at a fractional voxel position (clamped to the grid), to be used many
    /// times.
    pub(crate) fn stencil_near(&self, VoxelPoint(p): VoxelPoint) -> Stencil {
        let s: [(usize, [f32; 4]); 3] = std::array::from_fn(|a| self.stencil_at(a, p[a]));
        let stride = [1, self.nodes[0], self.nodes[0] * self.nodes[1]];
        let base = (0..3).map(|a| s[a].0 * stride[a]).sum();
        Stencil { base, stride, taps: std::array::from_fn(|a| self.taps(a)), weights: s.map(|s| s.1) }
    }

    /// The displacement at a fractional voxel position (clamped to the grid).
    pub fn at(&self, coefficients: &[f32], p: VoxelPoint) -> GridVector {
        let n = self.len();
        let mut sum = [0.0f32; 3];
        self.for_each_tap(p, |node, w| {
            for c in 0..3 {
                sum[c] += w * coefficients[c * n + node];
            }
        });
        GridVector(sum.map(f64::from))
    }

    /// The node planes that act on slice `k`, combined: three planar components of nodes_x by
    /// nodes_y.
    pub fn slice(&self, coefficients: &[f32], k: usize) -> Vec<f32> {
        let (n, plane) = (self.len(), self.nodes[0] * self.nodes[1]);
        let (first, w) = self.stencil(2, k);
        let mut out = vec![0.0f32; 3 * plane];
        for (c, out) in out.chunks_exact_mut(plane).enumerate() {
            for m in 0..self.taps(2) {
                let from = c * n + (first + m) * plane;
                for (o, v) in out.iter_mut().zip(&coefficients[from..from + plane]) {
                    *o += w[m] * v;
                }
            }
        }
        out
    }

    /// One component of a row of vectors, from a combined slice.
    #[inline(always)]
    pub fn row(&self, slice: &[f32], component: usize, j: usize, nodes: &mut [f32], out: &mut [f32]) {
        let plane = self.nodes[0] * self.nodes[1];
        let (first, w) = self.stencil(1, j);
        nodes.fill(0.0);
        for m in 0..self.taps(1) {
            let from = component * plane + (first + m) * self.nodes[0];
            for (o, v) in nodes.iter_mut().zip(&slice[from..from + self.nodes[0]]) {
                *o += w[m] * v;
            }
        }
        self.along(nodes, out);
    }

    /// The values at the voxels of a row along x between nodes that are combined along the other
    /// axes.
    #[inline(always)]
    fn along(&self, nodes: &[f32], out: &mut [f32]) {
        if self.nodes[0] == 1 {
            out.fill(nodes[0]);
            return;
        }
        // Whole vectors: what one cell has too many the next writes over.
        let (step, [w0, w1, w2, w3]) = (self.step[0], &self.across);
        let whole = if step <= ROW_LANES && out.len() >= ROW_LANES { (out.len() - ROW_LANES) / step + 1 } else { 0 };
        for cell in 0..whole {
            let c = &nodes[cell..cell + 4];
            let out = &mut out[cell * step..][..ROW_LANES];
            for l in 0..ROW_LANES {
                out[l] = w0[l] * c[0] + w1[l] * c[1] + w2[l] * c[2] + w3[l] * c[3];
            }
        }
        for (cell, out) in out.chunks_mut(step).enumerate().skip(whole) {
            let c = &nodes[cell..cell + 4];
            for (o, w) in out.iter_mut().zip(&self.phases[0]) {
                *o = w[0] * c[0] + w[1] * c[1] + w[2] * c[2] + w[3] * c[3];
            }
        }
    }

    /// One component at all voxels of the grid along `axis` through one of them. `nodes` is working
    /// memory.
    pub fn line(&self, component: &[f32], axis: usize, voxel: [usize; 3], nodes: &mut Vec<f32>, out: &mut [f32]) {
        let stride = [1, self.nodes[0], self.nodes[0] * self.nodes[1]];
        let [b, c] = [[1, 2], [0, 2], [0, 1]][axis];
        let ((first_b, w_b), (first_c, w_c)) = (self.stencil(b, voxel[b]), self.stencil(c, voxel[c]));
        nodes.clear();
        nodes.resize(self.nodes[axis], 0.0);
        dispatch(
            #[inline(always)]
            || {
                for (m, l) in (0..self.taps(c)).flat_map(|m| (0..self.taps(b)).map(move |l| (m, l))) {
                    let from = (first_b + l) * stride[b] + (first_c + m) * stride[c];
                    let (w, values) = (w_b[l] * w_c[m], &component[from..]);
                    if axis == 0 {
                        for (o, v) in nodes.iter_mut().zip(values) {
                            *o += w * v;
                        }
                    } else {
                        for (o, v) in nodes.iter_mut().zip(values.iter().step_by(stride[axis])) {
                            *o += w * v;
                        }
                    }
                }
                if axis == 0 {
                    return self.along(nodes, out);
                }
                if self.nodes[axis] == 1 {
                    return out.fill(nodes[0]);
                }
                for (cell, out) in out.chunks_mut(self.step[axis]).enumerate() {
                    let c = &nodes[cell..cell + 4];
                    for (o, w) in out.iter_mut().zip(&self.phases[axis]) {
                        *o = w[0] * c[0] + w[1] * c[1] + w[2] * c[2] + w[3] * c[3];
                    }
                }
            },
        );
    }

    /// Evaluates the field at every voxel: three planar components.
    pub fn evaluate(&self, coefficients: &[f32]) -> Vec<f32> {
        self.evaluate_planes(coefficients, 0..self.shape[2])
    }

    /// The same for some planes: three planar components.
    pub(crate) fn evaluate_planes(&self, coefficients: &[f32], planes: Range<usize>) -> Vec<f32> {
        let [nx, ny, _] = self.shape;
        let total = nx * ny * planes.len();
        let mut out = vec![0.0f32; 3 * total];
        for (c, volume) in out.chunks_exact_mut(total.max(1)).enumerate() {
            volume.par_chunks_mut(nx * ny).zip(planes.clone()).for_each(|(plane, k)| {
                let slice = self.slice(coefficients, k);
                let mut nodes = vec![0.0; self.nodes[0]];
                dispatch(
                    #[inline(always)]
                    || {
                        for (j, row) in plane.chunks_exact_mut(nx).enumerate() {
                            self.row(&slice, c, j, &mut nodes, row);
                        }
                    },
                );
            });
        }
        out
    }

    /// The transpose of evaluation: sums `Q` quantities of every voxel, times each basis function,
    /// at the nodes.
    ///
    /// `fill(j, k, rows)` writes the `Q` quantities of row `(j, k)` into `rows` and returns the
    /// voxels it wrote; all others count as zero. The result has `Q` planar quantities of
    /// [`Lattice::len`] values. Cells of the lattice along z run in parallel and are added in a
    /// fixed order.
    pub fn accumulate<const Q: usize>(
        &self,
        fill: impl Fn(usize, usize, &mut [Vec<f32>; Q]) -> Range<usize> + Sync,
    ) -> Vec<f32> {
        let [nx, ny, nz] = self.shape;
        let [mx, my, mz] = self.nodes;
        let (plane, total) = (mx * my, self.len());
        let (taps_y, taps_z) = (self.taps(1), self.taps(2));
        let of_cell = |cell: usize| -> Vec<f32> {
            let mut slab = vec![0.0f32; taps_z * Q * plane];
            let mut rows: [Vec<f32>; Q] = std::array::from_fn(|_| vec![0.0; nx]);
            let mut sums = vec![0.0f32; Q * plane];
            // Voxel rows weighed for the node rows that act on them; each node row is reduced along
            // x only once.
            let mut ring: Vec<NodeRow> = (0..taps_y).map(|_| NodeRow::new(Q, nx)).collect();
            let mut nodes = vec![0.0f32; mx + 3];
            for k in cell * self.step[2]..((cell + 1) * self.step[2]).min(nz) {
                sums.fill(0.0);
                let mut any = false;
                for j in 0..ny {
                    let (first, w) = self.stencil(1, j);
                    if j > 0 && j % self.step[1] == 0 && taps_y > 1 {
                        self.flush::<Q>(&mut ring[(first - 1) % taps_y], first - 1, &mut nodes, &mut sums);
                    }
                    let span = fill(j, k, &mut rows);
                    if span.is_empty() {
                        continue;
                    }
                    any = true;
                    dispatch(
                        #[inline(always)]
                        || {
                            for m in 0..taps_y {
                                ring[(first + m) % taps_y].add(w[m], &rows, span.clone());
                            }
                        },
                    );
                }
                for m in 0..taps_y {
                    let node = self.stencil(1, ny - 1).0 + m;
                    self.flush::<Q>(&mut ring[node % taps_y], node, &mut nodes, &mut sums);
                }
                if any {
                    let (_, w) = self.stencil(2, k);
                    for (m, slab) in slab.chunks_exact_mut(Q * plane).enumerate() {
                        for (s, v) in slab.iter_mut().zip(&sums) {
                            *s += w[m] * v;
                        }
                    }
                }
            }
            slab
        };
        // A few cells at a time, from the last to the first: each node plane sums them in that
        // order, however many these are.
        let most = (MAX_VALUES_IN_MEMORY / (taps_z * Q * plane)).max(2 * rayon::current_num_threads());
        let mut out = vec![0.0f32; Q * total];
        let mut end = nz.div_ceil(self.step[2]);
        while end > 0 {
            let start = end.saturating_sub(most);
            let cells: Vec<Vec<f32>> = (start..end).into_par_iter().map(of_cell).collect();
            for (q, out) in out.chunks_exact_mut(total).enumerate() {
                let touched = out.par_chunks_mut(plane).enumerate().skip(start).take(end - start + taps_z - 1);
                touched.for_each(|(z, out)| {
                    for (m, cell) in (0..taps_z).filter_map(|m| z.checked_sub(m + start).map(|c| (m, c))) {
                        if let Some(slab) = cells.get(cell) {
                            let at = (m * Q + q) * plane;
                            for (o, v) in out.iter_mut().zip(&slab[at..at + plane]) {
                                *o += v;
                            }
                        }
                    }
                });
            }
            end = start;
        }
        assert_eq!(out.len(), Q * mx * my * mz);
        out
    }

    /// Reduces a node row along x, adds it to row `node` of each quantity's plane, and empties it.
    fn flush<const Q: usize>(&self, row: &mut NodeRow, node: usize, nodes: &mut [f32], sums: &mut [f32]) {
        let [mx, my, _] = self.nodes;
        let span = std::mem::replace(&mut row.span, 0..0);
        if span.is_empty() {
            return;
        }
        // Whole cells only.
        let step = self.step[0];
        let cells = span.start / step..span.end.div_ceil(step);
        dispatch(
            #[inline(always)]
            || {
                for q in 0..Q {
                    let values = &mut row.values[q * self.shape[0]..(q + 1) * self.shape[0]];
                    let sums = &mut sums[(q * my + node) * mx..][..mx];
                    if self.nodes[0] == 1 {
                        sums[0] += values[0];
                    } else {
                        nodes.fill(0.0);
                        for cell in cells.clone() {
                            let values = &values[cell * step..((cell + 1) * step).min(self.shape[0])];
                            let mut s = [0.0f32; 4];
                            for (v, w) in values.iter().zip(&self.phases[0]) {
                                for m in 0..4 {
                                    s[m] += w[m] * v;
                                }
                            }
                            for (n, s) in nodes[cell..cell + 4].iter_mut().zip(s) {
                                *n += s;
                            }
                        }
                        for (s, v) in sums.iter_mut().zip(&*nodes) {
                            *s += v;
                        }
                    }
                    values[span.clone()].fill(0.0);
                }
            },
        );
    }

    /// Coefficients whose field takes (nearly) the values of `f` at the nodes.
    ///
    /// Quasi-interpolation `c = v - (second differences of v) / 6`: exact for cubics, fourth order
    /// (de Boor 1978) up to the ends, where the second differences are continued in a straight
    /// line. `f` gets a node's voxel position, which may lie up to one step outside the grid.
    pub fn fit(&self, f: impl Fn(VoxelPoint) -> GridVector + Sync) -> Vec<f32> {
        let [mx, my, _] = self.nodes;
        let n = self.len();
        let position = |a: usize, m: usize| {
            if self.nodes[a] == 1 { 0.0 } else { (m as f64 - 1.0) * self.step[a] as f64 }
        };
        let values: Vec<[f64; 3]> = (0..n)
            .into_par_iter()
            .map(|m| f(VoxelPoint([position(0, m % mx), position(1, m / mx % my), position(2, m / (mx * my))])).0)
            .collect();
        let mut out = vec![0.0f32; 3 * n];
        for c in 0..3 {
            let mut v: Vec<f64> = values.iter().map(|d| d[c]).collect();
            for (a, stride) in [1, mx, mx * my].into_iter().enumerate() {
                if self.nodes[a] == 1 {
                    continue;
                }
                let source = v.clone();
                let last = self.nodes[a] - 1;
                let second = |m: usize| source[m - stride] - 2.0 * source[m] + source[m + stride];
                for (m, v) in v.iter_mut().enumerate() {
                    // At the ends the second difference goes on in a straight line.
                    let d = match m / stride % self.nodes[a] {
                        0 => 2.0 * second(m + stride) - second(m + 2 * stride),
                        at if at == last => 2.0 * second(m - stride) - second(m - 2 * stride),
                        _ => second(m),
                    };
                    *v -= d / 6.0;
                }
            }
            for (o, v) in out[c * n..(c + 1) * n].iter_mut().zip(v) {
                *o = v as f32;
            }
        }
        out
    }
}

/// The at most 64 nodes of a lattice that act at one place, with their weights.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Stencil {
    base: usize,
    stride: [usize; 3],
    taps: [usize; 3],
    weights: [[f32; 4]; 3],
}

impl Stencil {
    /// The value there of one planar component.
    #[inline(always)]
    pub(crate) fn gather(&self, component: &[f32]) -> f32 {
        let [wx, wy, wz] = &self.weights;
        let mut sum = 0.0;
        for c in 0..self.taps[2] {
            for b in 0..self.taps[1] {
                let row = &component[self.base + b * self.stride[1] + c * self.stride[2]..][..self.taps[0]];
                sum += wz[c] * wy[b] * row.iter().zip(wx).map(|(v, w)| v * w).sum::<f32>();
            }
        }
        sum
    }

    /// Adds `value` to one planar component, by the weights.
    #[inline(always)]
    pub fn scatter(&self, value: f32, component: &mut [f32]) {
        let [wx, wy, wz] = &self.weights;
        for c in 0..self.taps[2] {
            for b in 0..self.taps[1] {
                let row = &mut component[self.base + b * self.stride[1] + c * self.stride[2]..][..self.taps[0]];
                let v = value * (wz[c] * wy[b]);
                row.iter_mut().zip(wx).for_each(|(o, w)| *o += v * w);
            }
        }
    }
}

/// `Q` quantities of the voxels of a row, weighed for one row of nodes.
struct NodeRow {
    values: Vec<f32>,
    /// Where they are not zero.
    span: Range<usize>,
}

impl NodeRow {
    fn new(quantities: usize, nx: usize) -> Self {
        Self { values: vec![0.0; quantities * nx], span: 0..0 }
    }

    #[inline(always)]
    fn add<const Q: usize>(&mut self, weight: f32, rows: &[Vec<f32>; Q], span: Range<usize>) {
        for (values, row) in self.values.chunks_exact_mut(rows[0].len()).zip(rows) {
            for (v, r) in values[span.clone()].iter_mut().zip(&row[span.clone()]) {
                *v += weight * r;
            }
        }
        let own = &self.span;
        self.span = if own.is_empty() { span } else { own.start.min(span.start)..own.end.max(span.end) };
    }
}

/// A volume to be sampled with the cubic B-spline itself as the kernel, without prefilter.
///
/// That is a smoothing (standard deviation 0.58 voxel), the same for every fraction of a voxel, so
/// a volume filtered with [`crate::numerics::filters::bspline`] and another sampled this way look
/// alike at any shift.
#[derive(Clone, Copy)]
pub struct SmoothSampler<'a> {
    /// Values, x fastest.
    pub data: &'a [f32],
    /// Voxels along each axis.
    pub shape: [usize; 3],
}

impl SmoothSampler<'_> {
    /// The smoothed value at a fractional voxel position; NaN outside the volume (beyond half a
    /// voxel).
    #[inline(always)]
    pub fn at(&self, p: [f32; 3]) -> f32 {
        let [nx, ny, nz] = self.shape;
        let n = [nx, ny, nz];
        for a in 0..3 {
            if !(p[a] >= -0.5 && p[a] <= n[a] as f32 - 0.5) {
                return f32::NAN;
            }
        }
        let (ix, wx) = corner(p[0], nx);
        let (iy, wy) = corner(p[1], ny);
        let (iz, wz) = corner(p[2], nz);
        let inside = |i: i32, n: usize| i >= 0 && i as usize + 4 <= n;
        let mut sum = [0.0f32; 4];
        if inside(ix, nx) && inside(iy, ny) && inside(iz, nz) {
            let base = ix as usize + nx * (iy as usize + ny * iz as usize);
            for c in 0..4 {
                for b in 0..4 {
                    let at = base + nx * (b + ny * c);
                    let row = &self.data[at..at + 4];
                    let w = wy[b] * wz[c];
                    for a in 0..4 {
                        sum[a] += w * row[a];
                    }
                }
            }
        } else {
            let clamp = |i: i32, n: usize| i.clamp(0, n as i32 - 1) as usize;
            for c in 0..4 {
                for b in 0..4 {
                    let row = nx * (clamp(iy + b as i32, ny) + ny * clamp(iz + c as i32, nz));
                    let w = wy[b] * wz[c];
                    for a in 0..4 {
                        sum[a] += w * self.data[row + clamp(ix + a as i32, nx)];
                    }
                }
            }
        }
        sum[0] * wx[0] + sum[1] * wx[1] + sum[2] * wx[2] + sum[3] * wx[3]
    }
}

impl SmoothSampler<'_> {
    /// Samples a row of places `start + [l, 0, 0] + scale * d[l] - origin` (voxels), as
    /// [`SmoothSampler::at`] does.
    #[inline(always)]
    pub fn row(&self, start: [f32; 3], d: [&[f32]; 3], scale: [f32; 3], origin: [f32; 3], out: &mut [f32]) {
        let mut places = Places::ORIGIN;
        for (block, out) in out.chunks_mut(LANES).enumerate() {
            let (from, count) = (block * LANES, out.len());
            let mut at = [[0.0f32; LANES]; 3];
            for a in 0..3 {
                let mut v = [0.0f32; LANES];
                v[..count].copy_from_slice(&d[a][from..from + count]);
                for l in 0..LANES {
                    let base = if a == 0 { start[0] + (from + l) as f32 } else { start[a] };
                    at[a][l] = base + scale[a] * v[l] - origin[a];
                }
                places.set(a, &at[a]);
            }
            cubic::sample(self.data, self.shape, &places, count, out, |l| self.at([at[0][l], at[1][l], at[2][l]]));
        }
    }
}

impl SmoothSampler<'_> {
    /// Samples the patch of `radius` about `centre` (voxels), x fastest, as [`SmoothSampler::at`]
    /// does.
    pub fn patch(&self, centre: [f32; 3], radius: [usize; 3], out: &mut [f32]) {
        let width: [usize; 3] = std::array::from_fn(|a| if self.shape[a] == 1 { 1 } else { 2 * radius[a] + 1 });
        let still = vec![0.0; width[0]];
        dispatch(
            #[inline(always)]
            || {
                for (n, row) in out.chunks_exact_mut(width[0]).enumerate() {
                    let index = [0, n % width[1], n / width[1]];
                    let start = std::array::from_fn(|a| centre[a] + index[a] as f32 - (width[a] / 2) as f32);
                    self.row(start, [&still, &still, &still], [0.0; 3], [0.0; 3], row);
                }
            },
        );
    }
}

/// First of the four voxels that act at `p`, and their weights. A side of one voxel acts with its
/// only value.
#[inline(always)]
fn corner(p: f32, n: usize) -> (i32, [f32; 4]) {
    if n == 1 {
        return (0, [1.0, 0.0, 0.0, 0.0]);
    }
    let f = p.floor();
    (f as i32 - 1, weights(p - f))
}
