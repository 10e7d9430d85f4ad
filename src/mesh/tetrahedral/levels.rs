//! Smooth level functions of a label map: where the body and each of its parts ends, to a fraction
//! of a voxel.
//!
//! A voxel map has stairs; `rounding` takes them out of the body and of each part.
//!
//! All positions here are in *grid millimetres*: voxel index times voxel size.

use super::rounding::signed_distance;
use crate::types::Mask;

/// Largest shift of a surface (voxels) that corrects a volume.
const MAX_SHIFT_VOXELS: f64 = 0.5;
/// Voxels around the body's box.
const PADDING_VOXELS: usize = 6;

/// The body and its parts.
#[derive(Debug, Clone)]
pub struct Levels {
    shape: [usize; 3],
    spacing: [f64; 3],
    /// Voxel index of the first voxel kept.
    first: [i64; 3],
    body: Vec<f32>,
    /// The labels, ascending, and the signed distance of each (none for a body of one part).
    labels: Vec<u8>,
    parts: Vec<Vec<f32>>,
    /// Added to the body's level.
    shift: f64,
    /// Added to each part's.
    shifts: Vec<f64>,
    /// Labels of the voxels kept, 0 outside the body.
    map: Vec<u8>,
}

impl Levels {
    /// Of the parts of `labels` that are not 0; none when there is no such voxel.
    pub fn new(labels: &Mask) -> Option<Self> {
        let grid = labels.grid();
        let (n, values) = (grid.shape(), labels.as_slice());
        let (mut low, mut high) = ([usize::MAX; 3], [0; 3]);
        for o in (0..values.len()).filter(|&o| values[o] > 0) {
            let v = grid.voxel(o);
            for a in 0..3 {
                low[a] = low[a].min(v[a]);
                high[a] = high[a].max(v[a]);
            }
        }
        if low[0] == usize::MAX {
            return None;
        }
        let shape: [usize; 3] = std::array::from_fn(|a| high[a] - low[a] + 1 + 2 * PADDING_VOXELS);
        let first: [i64; 3] = std::array::from_fn(|a| low[a] as i64 - PADDING_VOXELS as i64);
        let mut map = vec![0u8; shape.iter().product()];
        for k in low[2]..=high[2] {
            for j in low[1]..=high[1] {
                let from = grid.index(low[0], j, k);
                let to = PADDING_VOXELS
                    + shape[0] * (j - low[1] + PADDING_VOXELS + shape[1] * (k - low[2] + PADDING_VOXELS));
                let run = high[0] - low[0] + 1;
                map[to..to + run].copy_from_slice(&values[from..from + run]);
            }
        }
        assert!(n.iter().all(|&s| s > 0));
        let mut seen = [false; 256];
        map.iter().for_each(|&v| seen[v as usize] = true);
        let present: Vec<u8> = (1..=255).filter(|&v| seen[v as usize]).collect();
        let body = signed_distance(&map.iter().map(|&v| v > 0).collect::<Vec<_>>(), shape);
        let mut parts = Vec::new();
        if present.len() > 1 {
            let filled = fill(&map, shape);
            for &label in &present {
                parts.push(signed_distance(&filled.iter().map(|&v| v == label).collect::<Vec<_>>(), shape));
            }
        }
        let shifts = vec![0.0; present.len()];
        Some(Self { shape, spacing: grid.spacing(), first, body, labels: present, parts, shift: 0.0, shifts, map })
    }

    /// The labels, ascending.
    pub fn labels(&self) -> &[u8] {
        &self.labels
    }

    /// The box of the body's voxels (grid mm): their outer faces.
    pub fn bounds(&self) -> [[f64; 3]; 2] {
        let low = std::array::from_fn(|a| ((self.first[a] + PADDING_VOXELS as i64) as f64 - 0.5) * self.spacing[a]);
        let size = |a: usize| (self.shape[a] - 2 * PADDING_VOXELS) as f64 * self.spacing[a];
        [low, std::array::from_fn(|a| low[a] + size(a))]
    }

    /// Volume of each part's voxels (mm^3).
    pub fn volumes(&self) -> Vec<f64> {
        let voxel: f64 = self.spacing.iter().product();
        let count = |label: &u8| self.map.iter().filter(|v| *v == label).count() as f64;
        self.labels.iter().map(|l| voxel * count(l)).collect()
    }

    /// Moves the surfaces outwards: that of the body by `body` mm, that of each part by `parts` mm.
    pub fn grow(&mut self, body: f64, parts: &[f64]) {
        let voxel = self.voxel();
        self.shift = (self.shift + body / voxel).clamp(-MAX_SHIFT_VOXELS, MAX_SHIFT_VOXELS);
        for (s, d) in self.shifts.iter_mut().zip(parts) {
            *s = (*s + d / voxel).clamp(-MAX_SHIFT_VOXELS, MAX_SHIFT_VOXELS);
        }
    }

    /// Least voxel size (mm).
    pub fn voxel(&self) -> f64 {
        self.spacing.iter().fold(f64::INFINITY, |m, &v| m.min(v))
    }

    /// Volume of the body's voxels (mm^3).
    pub fn volume(&self) -> f64 {
        self.map.iter().filter(|&&v| v > 0).count() as f64 * self.spacing.iter().product::<f64>()
    }

    /// Every voxel of the body: its label and its centre (grid mm).
    pub fn voxels(&self) -> impl Iterator<Item = (u8, [f64; 3])> + '_ {
        self.map.iter().enumerate().filter(|(_, v)| **v > 0).map(|(o, &v)| {
            let at = [o % self.shape[0], o / self.shape[0] % self.shape[1], o / (self.shape[0] * self.shape[1])];
            (v, std::array::from_fn(|a| (self.first[a] + at[a] as i64) as f64 * self.spacing[a]))
        })
    }

    fn sample(&self, values: &[f32], p: [f64; 3]) -> f64 {
        let (mut base, mut t) = ([0; 3], [0.0; 3]);
        for a in 0..3 {
            let q = (p[a] / self.spacing[a] - self.first[a] as f64).clamp(0.0, (self.shape[a] - 1) as f64);
            base[a] = (q as usize).min(self.shape[a] - 2);
            t[a] = q - base[a] as f64;
        }
        let (sx, sxy) = (self.shape[0], self.shape[0] * self.shape[1]);
        let at = base[0] + sx * base[1] + sxy * base[2];
        let v = |o: usize| f64::from(values[at + o]);
        let along = |o: usize| v(o) + t[0] * (v(o + 1) - v(o));
        let face = |o: usize| along(o) + t[1] * (along(o + sx) - along(o));
        face(0) + t[2] * (face(sxy) - face(0))
    }

    /// Positive inside the body.
    pub fn body(&self, p: [f64; 3]) -> f64 {
        self.sample(&self.body, p) + self.shift
    }

    /// Positive in part `k` (by the order of [`Levels::labels`]), negative in the others.
    pub fn part(&self, k: usize, p: [f64; 3]) -> f64 {
        let (mut own, mut other) = (0.5, f64::NEG_INFINITY);
        for (i, values) in self.parts.iter().enumerate() {
            let v = self.sample(values, p) + self.shifts[i];
            if i == k { own = v } else { other = other.max(v) }
        }
        if other == f64::NEG_INFINITY { 0.5 } else { own - other }
    }

    /// Positive on the side of part `k`, negative on that of part `m`.
    pub fn between(&self, k: usize, m: usize, p: [f64; 3]) -> f64 {
        match (self.parts.get(k), self.parts.get(m)) {
            (Some(a), Some(b)) => self.sample(a, p) + self.shifts[k] - self.sample(b, p) - self.shifts[m],
            _ => 0.5,
        }
    }

    /// Twice the distance (mm) of the part's innermost voxels from another part or the outside, for
    /// each part; the thickness of a layer, the diameter of a ball. The thickest hundredth of the
    /// voxels decides.
    pub fn thickness(&self) -> Vec<f64> {
        let least = self.voxel();
        let mut depth: Vec<u16> = vec![0; self.map.len()];
        let stride = [1, self.shape[0], self.shape[0] * self.shape[1]];
        // Distances by peeling: a voxel's is one more than that of its outermost face neighbour.
        let inside: Vec<usize> = (0..self.map.len()).filter(|&o| self.map[o] > 0).collect();
        let mut front: Vec<usize> = Vec::new();
        for &o in &inside {
            if stride.iter().any(|&s| self.map[o + s] != self.map[o] || self.map[o - s] != self.map[o]) {
                depth[o] = 1;
                front.push(o);
            }
        }
        let mut level = 1;
        while !front.is_empty() {
            level += 1;
            let mut next = Vec::new();
            for &o in &front {
                for s in stride {
                    for q in [o + s, o - s] {
                        if self.map[q] > 0 && depth[q] == 0 {
                            depth[q] = level;
                            next.push(q);
                        }
                    }
                }
            }
            front = next;
        }
        self.labels
            .iter()
            .map(|&label| {
                let mut depths: Vec<u16> =
                    inside.iter().filter(|&&o| self.map[o] == label).map(|&o| depth[o]).collect();
                let at = depths.len() - 1 - depths.len() / 100;
                let deep = *depths.select_nth_unstable(at).1;
                (2.0 * f64::from(deep) - 1.0).max(1.0) * least
            })
            .collect()
    }
}

/// Labels carried outwards over the whole box, nearest first.
fn fill(map: &[u8], shape: [usize; 3]) -> Vec<u8> {
    let mut out = map.to_vec();
    let stride = [1, shape[0], shape[0] * shape[1]];
    let mut front: Vec<usize> = (0..map.len()).filter(|&o| map[o] > 0).collect();
    while !front.is_empty() {
        let mut next = Vec::new();
        for &o in &front {
            let at = [o % shape[0], o / shape[0] % shape[1], o / (shape[0] * shape[1])];
            for a in 0..3 {
                let up = (at[a] + 1 < shape[a]).then(|| o + stride[a]);
                let down = (at[a] > 0).then(|| o - stride[a]);
                for q in up.into_iter().chain(down) {
                    if out[q] == 0 {
                        out[q] = out[o];
                        next.push(q);
                    }
                }
            }
        }
        front = next;
    }
    out
}
