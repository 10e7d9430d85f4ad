//! Displacements of a coarse level as displacements of the next finer one, and back.

use crate::synth::elastic::hexahedra::Lattice;
use crate::synth::elastic::vectors::Nodal;
use rayon::prelude::*;

/// A sparse matrix by rows.
#[derive(Debug, Clone)]
struct Rows {
    starts: Vec<u32>,
    entries: Vec<(u32, f32)>,
}

impl Rows {
    fn apply(&self, x: &[[f32; 3]], out: &mut [[f32; 3]]) {
        const NODES_PER_CHUNK: usize = 2048;
        out.par_chunks_mut(NODES_PER_CHUNK).enumerate().for_each(|(chunk, out)| {
            for (i, v) in out.iter_mut().enumerate() {
                let row = chunk * NODES_PER_CHUNK + i;
                let mut sum = [0.0f32; 3];
                for &(n, w) in &self.entries[self.starts[row] as usize..self.starts[row + 1] as usize] {
                    (0..3).for_each(|c| sum[c] += w * x[n as usize][c]);
                }
                *v = sum;
            }
        });
    }

    fn transposed(&self, columns: usize) -> Self {
        let mut starts = vec![0u32; columns + 1];
        self.entries.iter().for_each(|e| starts[e.0 as usize + 1] += 1);
        for n in 0..columns {
            starts[n + 1] += starts[n];
        }
        let mut next = starts.clone();
        let mut entries = vec![(0, 0.0); self.entries.len()];
        for row in 0..self.starts.len() - 1 {
            for &(n, w) in &self.entries[self.starts[row] as usize..self.starts[row + 1] as usize] {
                entries[next[n as usize] as usize] = (row as u32, w);
                next[n as usize] += 1;
            }
        }
        Self { starts, entries }
    }
}

/// Interpolation from a coarse level to a fine one whose spaces are nested.
#[derive(Debug, Clone)]
pub(crate) struct Transfer {
    down: Rows,
    up: Rows,
    coarse: usize,
}

/// Quadratic weights at -1, -1/2, 0, 1/2, 1.
const MIDPOINT_WEIGHTS: [[f64; 3]; 5] =
    [[1.0, 0.0, 0.0], [0.375, 0.75, -0.125], [0.0, 1.0, 0.0], [-0.125, 0.75, 0.375], [0.0, 0.0, 1.0]];

impl Transfer {
    /// From quadratic elements to the eight children of each (number `8 e + c`).
    pub fn quadratic(coarse: &[Lattice], coarse_nodes: usize, fine: &[Lattice], fine_nodes: usize) -> Self {
        let weights = |e: usize, n: usize| {
            let child = [e & 1, e >> 1 & 1, e >> 2 & 1];
            let local = [n % 3, n / 3 % 3, n / 9];
            let at: [usize; 3] = std::array::from_fn(|a| 2 * child[a] + local[a]);
            let parent = &coarse[e / 8];
            (0..27).map(move |m| {
                let w = MIDPOINT_WEIGHTS[at[0]][m % 3]
                    * MIDPOINT_WEIGHTS[at[1]][m / 3 % 3]
                    * MIDPOINT_WEIGHTS[at[2]][m / 9];
                (parent[m], w)
            })
        };
        Self::new(fine, fine_nodes, coarse_nodes, weights)
    }

    /// From trilinear to quadratic on the same hexahedra.
    pub fn linear(hexes: &[[u32; 8]], coarse_nodes: usize, fine: &[Lattice], fine_nodes: usize) -> Self {
        let weights = |e: usize, n: usize| {
            let local = [n % 3, n / 3 % 3, n / 9].map(|i| i as f64 / 2.0);
            (0..8).map(move |c| {
                let w = (0..3).map(|a| if c >> a & 1 == 1 { local[a] } else { 1.0 - local[a] }).product();
                (hexes[e][c], w)
            })
        };
        Self::new(fine, fine_nodes, coarse_nodes, weights)
    }

    fn new<W: Iterator<Item = (u32, f64)>>(
        fine: &[Lattice],
        fine_nodes: usize,
        coarse: usize,
        weights: impl Fn(usize, usize) -> W,
    ) -> Self {
        let mut owner = vec![u32::MAX; fine_nodes];
        for (at, &n) in fine.iter().flatten().enumerate() {
            owner[n as usize] = owner[n as usize].min(at as u32);
        }
        let mut rows = Rows { starts: vec![0], entries: Vec::new() };
        for at in owner {
            let at = at as usize;
            rows.entries.extend(weights(at / 27, at % 27).filter(|w| w.1 != 0.0).map(|(n, w)| (n, w as f32)));
            rows.starts.push(rows.entries.len() as u32);
        }
        Self { up: rows.transposed(coarse), down: rows, coarse }
    }

    /// The fine level's values.
    pub fn refine(&self, x: &[[f32; 3]], out: &mut [[f32; 3]]) {
        self.down.apply(x, out);
    }

    /// The same in double precision.
    pub(crate) fn refine_exactly(&self, x: &[[f64; 3]]) -> Vec<[f64; 3]> {
        let rows = self.down.starts.windows(2);
        let sum = |range: &[u32]| {
            let entries = &self.down.entries[range[0] as usize..range[1] as usize];
            entries
                .iter()
                .fold([0.0; 3], |s: [f64; 3], &(n, w)| std::array::from_fn(|c| s[c] + f64::from(w) * x[n as usize][c]))
        };
        rows.map(sum).collect()
    }

    /// Forces of the fine level gathered at the coarse nodes: the transpose.
    pub(crate) fn gather(&self, x: &[[f32; 3]]) -> Nodal {
        let mut out = vec![[0.0; 3]; self.coarse];
        self.up.apply(x, &mut out);
        out
    }
}
