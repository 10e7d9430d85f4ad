//! Triquadratic displacements on the hexahedra of one level.

use crate::synth::elastic::hexahedra::{Lattice, Surfaces};
use crate::synth::elastic::quadratic::NODES;
use rayon::prelude::*;

/// Elements worked on side by side.
pub(crate) const LANES: usize = 8;

/// What each of a batch's elements gives to its nodes: `[element][node][component]`.
pub(crate) type Entries<T> = [[[T; 3]; NODES]; LANES];

/// `Entries` from `[component][node][element]`.
#[inline(always)]
pub fn entries<T: Copy + Default>(by_component: &[[[T; LANES]; NODES]; 3]) -> Entries<T> {
    let mut out = [[[T::default(); 3]; NODES]; LANES];
    for l in 0..LANES {
        for a in 0..NODES {
            for c in 0..3 {
                out[l][a][c] = by_component[c][a][l];
            }
        }
    }
    out
}

/// A finite element space: nodes, elements, and which element entries add up to which node.
#[derive(Debug, Clone)]
pub struct Space {
    /// Places at rest (mm).
    pub nodes: Vec<[f64; 3]>,
    /// Surfaces of each node.
    pub surfaces: Vec<Surfaces>,
    /// Nodes of each element, `i + 3 j + 9 k`.
    pub elements: Vec<Lattice>,
    /// Tissue region of each element.
    pub region: Vec<u8>,
    /// Entries `27 e + a` of each node, one list after the other.
    entries: Vec<u32>,
    /// Where each node's list starts.
    starts: Vec<u32>,
}

impl Space {
    /// From the halved hexahedra.
    pub fn new(nodes: Vec<[f64; 3]>, surfaces: Vec<Surfaces>, elements: Vec<Lattice>, region: Vec<u8>) -> Self {
        let mut starts = vec![0u32; nodes.len() + 1];
        elements.iter().flatten().for_each(|&n| starts[n as usize + 1] += 1);
        for n in 0..nodes.len() {
            starts[n + 1] += starts[n];
        }
        let mut next = starts.clone();
        let mut entries = vec![0u32; elements.len() * NODES];
        for (at, &n) in elements.iter().flatten().enumerate() {
            entries[next[n as usize] as usize] = at as u32;
            next[n as usize] += 1;
        }
        Self { nodes, surfaces, elements, region, entries, starts }
    }

    /// Groups of [`LANES`] elements.
    pub(crate) fn batches(&self) -> usize {
        self.elements.len().div_ceil(LANES)
    }

    /// The values at the nodes of batch `b`, by component; lanes past the last element repeat it.
    #[inline(always)]
    pub(crate) fn gather<T: Copy + Default>(&self, b: usize, x: &[[T; 3]], out: &mut [[[T; LANES]; NODES]; 3]) {
        for l in 0..LANES {
            let element = &self.elements[(b * LANES + l).min(self.elements.len() - 1)];
            for a in 0..NODES {
                let v = x[element[a] as usize];
                for c in 0..3 {
                    out[c][a][l] = v[c];
                }
            }
        }
    }

    /// Adds the element entries of each node in their order; `finish` gets the node and the sum.
    pub(crate) fn assemble<T: Copy + Default + std::ops::AddAssign + Send + Sync>(
        &self,
        parts: &[Entries<T>],
        out: &mut [[T; 3]],
        finish: impl Fn(usize, [T; 3]) -> [T; 3] + Sync,
    ) {
        const ELEMENTS_PER_CHUNK: usize = 2048;
        let parts = parts.as_flattened().as_flattened();
        out.par_chunks_mut(ELEMENTS_PER_CHUNK).enumerate().for_each(|(chunk, out)| {
            for (i, v) in out.iter_mut().enumerate() {
                let node = chunk * ELEMENTS_PER_CHUNK + i;
                let mut sum = [T::default(); 3];
                for &entry in &self.entries[self.starts[node] as usize..self.starts[node + 1] as usize] {
                    let part = &parts[entry as usize];
                    for c in 0..3 {
                        sum[c] += part[c];
                    }
                }
                *v = finish(node, sum);
            }
        });
    }
}
