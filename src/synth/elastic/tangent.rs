//! The tangent stiffness, applied without being assembled: eight elements side by side in single
//! precision.
//!
//! With G the local derivatives of a displacement, B the inverse of the moved element's Jacobian
//! and A that of the element at rest, the local stress is `mu G A A^T + (mu - p) (B G B)^T + q B^T`
//! times the point's volume, where q is lambda times the projected trace of `G B`.

use crate::numerics::simd::dispatch;
use crate::synth::elastic::quadratic::{GAUSS, NODES, Nodal, Tables, divergence, gradient, line};
use crate::synth::elastic::space::{Entries, LANES, Space, entries};
use crate::types::space::Matrix3;
use rayon::prelude::*;
use std::sync::{Mutex, PoisonError};

type Lanes = [f32; LANES];

/// A Gauss point of eight elements.
#[derive(Debug, Clone, Copy, Default)]
pub struct Point {
    /// Volume times mu times A A^T: 00, 11, 22, 01, 02, 12.
    metric: [Lanes; 6],
    /// B, row by row.
    back: [Lanes; 9],
    /// Volume times (mu - p).
    twist: Lanes,
    /// Volume times root lambda times the linear basis.
    pressure: [Lanes; 4],
}

/// Eight elements.
#[derive(Debug, Clone)]
pub struct Batch {
    /// Their Gauss points.
    pub points: [Point; NODES],
}

impl Default for Batch {
    fn default() -> Self {
        Self { points: [Point::default(); NODES] }
    }
}

impl Point {
    /// Fills lane `l`; `mu` and `twist` come multiplied by the point's volume.
    pub fn set(&mut self, l: usize, mu: f64, local: &Matrix3, back: &Matrix3, twist: f64, pressure: [f64; 4]) {
        for (m, (r, c)) in self.metric.iter_mut().zip([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]) {
            m[l] = (mu * (0..3).map(|i| local[r][i] * local[c][i]).sum::<f64>()) as f32;
        }
        for n in 0..9 {
            self.back[n][l] = back[n / 3][n % 3] as f32;
        }
        self.twist[l] = twist as f32;
        for k in 0..4 {
            self.pressure[k][l] = pressure[k] as f32;
        }
    }

    /// Turns the local derivatives `g[component][axis][q]` into the local stress; `share` is the
    /// sum over all points of pressure times trace.
    #[inline(always)]
    fn stress(&self, g: &mut [[Nodal<f32, LANES>; 3]; 3], q: usize, share: &[Lanes; 4]) {
        let m = &self.metric;
        let metric = [[&m[0], &m[3], &m[4]], [&m[3], &m[1], &m[5]], [&m[4], &m[5], &m[2]]];
        let mut p = [0.0; LANES];
        for k in 0..4 {
            add_product(&mut p, &share[k], &self.pressure[k]);
        }
        // (G B), component by component.
        let mut t = [[[0.0f32; LANES]; 3]; 3];
        for i in 0..3 {
            for j in 0..3 {
                for a in 0..3 {
                    add_product(&mut t[i][j], &g[i][a][q], &self.back[3 * a + j]);
                }
            }
        }
        for i in 0..3 {
            let row = [g[i][0][q], g[i][1][q], g[i][2][q]];
            for a in 0..3 {
                let mut out = [0.0; LANES];
                for j in 0..3 {
                    add_product(&mut out, &self.back[3 * a + j], &t[j][i]);
                }
                out = product(&out, &self.twist);
                for b in 0..3 {
                    add_product(&mut out, &row[b], metric[b][a]);
                }
                add_product(&mut out, &p, &self.back[3 * a + i]);
                g[i][a][q] = out;
            }
        }
    }
}

/// `sum += a b`, lane by lane.
#[inline(always)]
fn add_product(sum: &mut Lanes, a: &Lanes, b: &Lanes) {
    for l in 0..LANES {
        sum[l] += a[l] * b[l];
    }
}

#[inline(always)]
fn product(a: &Lanes, b: &Lanes) -> Lanes {
    std::array::from_fn(|l| a[l] * b[l])
}

/// The stiffness of a level with some components of the displacement held.
pub struct Stiffness<'a> {
    space: &'a Space,
    batches: Vec<Batch>,
    tables: Tables<f32>,
    /// Entries of the elements before they are added up, kept from one product to the next.
    parts: Mutex<Vec<Entries<f32>>>,
}

impl<'a> Stiffness<'a> {
    /// From the data at the Gauss points.
    pub fn new(space: &'a Space, batches: Vec<Batch>) -> Self {
        let parts = Mutex::new(vec![[[[0.0; 3]; NODES]; LANES]; batches.len()]);
        Self { space, batches, tables: Tables::new(|v| v as f32), parts }
    }

    /// `out = K x`, zero where `free` is; `x` must be zero there already.
    pub fn apply(&self, x: &[[f32; 3]], free: &[[f32; 3]], out: &mut [[f32; 3]]) {
        let mut parts = self.parts.lock().unwrap_or_else(PoisonError::into_inner);
        parts.par_iter_mut().enumerate().for_each(|(b, part)| {
            dispatch(
                #[inline(always)]
                || *part = self.batch(b, x),
            );
        });
        self.space.assemble(&parts, out, |n, v| std::array::from_fn(|c| v[c] * free[n][c]));
    }

    #[inline(always)]
    fn batch(&self, b: usize, x: &[[f32; 3]]) -> Entries<f32> {
        let mut w = [[[0.0f32; LANES]; NODES]; 3];
        self.space.gather(b, x, &mut w);
        let t = &self.tables;
        let mut g = [gradient(t, &w[0]), gradient(t, &w[1]), gradient(t, &w[2])];
        let points = &self.batches[b].points;
        let mut share = [[0.0f32; LANES]; 4];
        for (q, point) in points.iter().enumerate() {
            let mut trace = [0.0; LANES];
            for i in 0..3 {
                for a in 0..3 {
                    add_product(&mut trace, &g[i][a][q], &point.back[3 * a + i]);
                }
            }
            for k in 0..4 {
                add_product(&mut share[k], &point.pressure[k], &trace);
            }
        }
        for (q, point) in points.iter().enumerate() {
            point.stress(&mut g, q, &share);
        }
        entries(&[divergence(t, &g[0]), divergence(t, &g[1]), divergence(t, &g[2])])
    }

    /// The diagonal of K.
    pub fn diagonal(&self) -> Vec<[f32; 3]> {
        let slopes: [[[f64; 3]; NODES]; NODES] = std::array::from_fn(|q| {
            let t = [line(GAUSS[q % 3]), line(GAUSS[q / 3 % 3]), line(GAUSS[q / 9])];
            std::array::from_fn(|n| {
                let i = [n % 3, n / 3 % 3, n / 9];
                std::array::from_fn(|a| (0..3).map(|c| t[c][usize::from(a == c)][i[c]]).product())
            })
        });
        let parts: Vec<Entries<f32>> = self.batches.par_iter().map(|batch| diagonal_of(batch, &slopes)).collect();
        let mut out = vec![[0.0; 3]; self.space.nodes.len()];
        self.space.assemble(&parts, &mut out, |_, v| v);
        out
    }
}

fn diagonal_of(batch: &Batch, slopes: &[[[f64; 3]; NODES]; NODES]) -> Entries<f32> {
    let mut out = [[[0.0f32; LANES]; NODES]; 3];
    for n in 0..NODES {
        let mut share = [[[0.0f32; LANES]; 4]; 3];
        for (q, point) in batch.points.iter().enumerate() {
            let s = slopes[q][n].map(|v| v as f32);
            let m = &point.metric;
            for l in 0..LANES {
                let shear = s[0] * (s[0] * m[0][l] + 2.0 * (s[1] * m[3][l] + s[2] * m[4][l]))
                    + s[1] * (s[1] * m[1][l] + 2.0 * s[2] * m[5][l])
                    + s[2] * s[2] * m[2][l];
                for c in 0..3 {
                    let h = (0..3).map(|a| s[a] * point.back[3 * a + c][l]).sum::<f32>();
                    out[c][n][l] += shear + point.twist[l] * h * h;
                    for k in 0..4 {
                        share[c][k][l] += point.pressure[k][l] * h;
                    }
                }
            }
        }
        for c in 0..3 {
            for l in 0..LANES {
                out[c][n][l] += (0..4).map(|k| share[c][k][l] * share[c][k][l]).sum::<f32>();
            }
        }
    }
    entries(&out)
}
