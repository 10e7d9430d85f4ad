//! The coarsest level: trilinear hexahedra with one pressure each, factorised.

use crate::synth::elastic::hexahedra::HexMesh;
use crate::synth::elastic::material::Lame;
use crate::types::space::{Matrix3, determinant};

/// A symmetric matrix kept from each row's first entry to its diagonal, and its Cholesky factor.
#[derive(Debug, Clone)]
pub(crate) struct Coarse {
    /// Row of each unknown `3 node + component`.
    row: Vec<usize>,
    first: Vec<usize>,
    matrix: Vec<Vec<f64>>,
    factor: Vec<Vec<f64>>,
}

/// Stiffness of one hexahedron at rest: mu times the symmetric gradients, plus lambda times the
/// mean divergence squared.
fn stiffness(corners: &[[f64; 3]; 8], Lame { mu, lambda }: Lame) -> [[f64; 24]; 24] {
    let point = 1.0 / 3f64.sqrt();
    let mut out = [[0.0; 24]; 24];
    let (mut mean, mut volume) = ([0.0; 24], 0.0);
    for q in 0..8 {
        let t: [f64; 3] = std::array::from_fn(|a| if q >> a & 1 == 1 { point } else { -point });
        let side = |c: usize, a: usize| if c >> a & 1 == 1 { 1.0 } else { -1.0 };
        let slope: [[f64; 3]; 8] = std::array::from_fn(|c| {
            std::array::from_fn(|a| {
                let others: f64 = (0..3).filter(|&b| b != a).map(|b| (1.0 + side(c, b) * t[b]) / 2.0).product();
                side(c, a) / 2.0 * others
            })
        });
        let jacobian: Matrix3 =
            std::array::from_fn(|r| std::array::from_fn(|a| (0..8).map(|c| corners[c][r] * slope[c][a]).sum()));
        let w = determinant(&jacobian);
        let inverse: Matrix3 = std::array::from_fn(|r| {
            std::array::from_fn(|c| {
                let (a, b, p, s) = ((c + 1) % 3, (c + 2) % 3, (r + 1) % 3, (r + 2) % 3);
                (jacobian[a][p] * jacobian[b][s] - jacobian[a][s] * jacobian[b][p]) / w
            })
        });
        let g: [[f64; 3]; 8] =
            std::array::from_fn(|n| std::array::from_fn(|i| (0..3).map(|a| slope[n][a] * inverse[a][i]).sum()));
        volume += w;
        for m in 0..24 {
            let (a, i) = (m / 3, m % 3);
            mean[m] += w * g[a][i];
            for n in 0..24 {
                let (b, j) = (n / 3, n % 3);
                let same = if i == j { (0..3).map(|d| g[a][d] * g[b][d]).sum() } else { 0.0 };
                out[m][n] += w * mu * (same + g[a][j] * g[b][i]);
            }
        }
    }
    for m in 0..24 {
        for n in 0..24 {
            out[m][n] += lambda / volume * mean[m] * mean[n];
        }
    }
    out
}

impl Coarse {
    /// Assembled on `mesh`, not yet factorised; `lame` by region.
    pub fn new(mesh: &HexMesh, lame: &[Lame]) -> Self {
        // Sorted along the longest side, rows reach back over a cross-section only.
        let span = |a: usize| {
            let values = || mesh.vertices.iter().map(|v| v[a]);
            values().fold(f64::MIN, f64::max) - values().fold(f64::MAX, f64::min)
        };
        let axis = (0..3).max_by(|&a, &b| span(a).total_cmp(&span(b))).unwrap_or(0);
        let mut order: Vec<usize> = (0..mesh.vertices.len()).collect();
        order.sort_by(|&a, &b| mesh.vertices[a][axis].total_cmp(&mesh.vertices[b][axis]).then(a.cmp(&b)));
        let mut row = vec![0; 3 * order.len()];
        for (place, &v) in order.iter().enumerate() {
            (0..3).for_each(|c| row[3 * v + c] = 3 * place + c);
        }
        let unknowns =
            |hex: &[u32; 8]| -> [usize; 24] { std::array::from_fn(|m| row[3 * hex[m / 3] as usize + m % 3]) };
        let mut first: Vec<usize> = (0..row.len()).collect();
        for hex in &mesh.hexes {
            let rows = unknowns(hex);
            let least = rows.iter().copied().min().unwrap_or(0);
            rows.iter().for_each(|&r| first[r] = first[r].min(least));
        }
        let mut matrix: Vec<Vec<f64>> = first.iter().enumerate().map(|(r, f)| vec![0.0; r + 1 - f]).collect();
        for (hex, &region) in mesh.hexes.iter().zip(&mesh.region) {
            let element = stiffness(&hex.map(|v| mesh.vertices[v as usize]), lame[usize::from(region)]);
            let rows = unknowns(hex);
            for m in 0..24 {
                for n in 0..24 {
                    if rows[n] <= rows[m] {
                        matrix[rows[m]][rows[n] - first[rows[m]]] += element[m][n];
                    }
                }
            }
        }
        Self { row, first, matrix, factor: Vec::new() }
    }

    /// Factorises for the components where `free` is 1 (one line a node, at least as many as there
    /// are vertices).
    pub fn hold(&mut self, free: &[[f32; 3]]) {
        let mut is_free = vec![true; self.row.len()];
        for (u, &r) in self.row.iter().enumerate() {
            is_free[r] = free[u / 3][u % 3] != 0.0;
        }
        let mut l = self.matrix.clone();
        for r in 0..l.len() {
            let from = self.first[r];
            for c in from..=r {
                if !(is_free[r] && is_free[c]) {
                    l[r][c - from] = f64::from(u8::from(r == c));
                }
            }
            for c in from..=r {
                let shared = from.max(self.first[c]);
                let (above, here) = l.split_at_mut(r);
                let line = &mut here[0];
                let other: &[f64] = if c < r { &above[c] } else { &[] };
                if c < r {
                    let (a, b) = (&line[shared - from..c - from], &other[shared - self.first[c]..c - self.first[c]]);
                    let known: f64 = a.iter().zip(b).map(|(a, b)| a * b).sum();
                    line[c - from] = (line[c - from] - known) / other[c - self.first[c]];
                } else {
                    let known: f64 = line[..c - from].iter().map(|v| v * v).sum();
                    line[c - from] = (line[c - from] - known).max(f64::MIN_POSITIVE).sqrt();
                }
            }
        }
        self.factor = l;
    }

    /// `K x = b` with held components left at 0.
    pub fn solve(&self, b: &[[f32; 3]]) -> Vec<[f32; 3]> {
        let mut x = vec![0.0f64; self.row.len()];
        for (u, &r) in self.row.iter().enumerate() {
            x[r] = f64::from(b[u / 3][u % 3]);
        }
        for r in 0..x.len() {
            let (line, from) = (&self.factor[r], self.first[r]);
            let known: f64 = line[..r - from].iter().zip(&x[from..r]).map(|(l, x)| l * x).sum();
            x[r] = (x[r] - known) / line[r - from];
        }
        for r in (0..x.len()).rev() {
            let (line, from) = (&self.factor[r], self.first[r]);
            x[r] /= line[r - from];
            let value = x[r];
            line[..r - from].iter().zip(&mut x[from..r]).for_each(|(l, x)| *x -= l * value);
        }
        (0..self.row.len() / 3).map(|n| std::array::from_fn(|c| x[self.row[3 * n + c]] as f32)).collect()
    }
}
