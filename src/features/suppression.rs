//! From a response volume to points: local maxima, an even spread, sub-voxel positions.

use crate::features::harris;
use crate::numerics::pyramid::reduced_shape;
use crate::types::VoxelPoint;
use rayon::prelude::*;

/// A corner in voxels of the volume it was found in.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Corner {
    /// Sub-voxel position.
    pub voxel: VoxelPoint,
    /// The voxel it was found at.
    pub centre: [usize; 3],
    /// Response, (intensity/mm)^2.
    pub response: f32,
}

/// At most `wanted` local maxima of `response` above `least`, spread evenly.
///
/// The volume is cut into cubes (in mm) of the size at which `wanted` of them fill the mask; each
/// cube gives its best maximum, then its second best, and so on until there are enough (Brown,
/// Szeliski & Winder 2005 have the same aim). Global ranking would crowd the points on the
/// brightest structure: measured, five times fewer usable points. Positions are refined by a
/// parabola along each axis. The result's order does not depend on threads.
///
/// ```
/// use palpate::features::spread;
/// // Two maxima, the second one next to a high neighbour.
/// let mut response = vec![0.0f32; 512];
/// let at = |x: usize| x + 8 * (4 + 8 * 4);
/// (response[at(2)], response[at(5)], response[at(6)]) = (1.0, 3.0, 2.0);
/// let corners = spread(&response, [8; 3], [1.0; 3], None, 10, 0.5);
/// assert_eq!(corners.len(), 2);
/// let x: Vec<f64> = corners.iter().map(|c| c.voxel.0[0]).collect();
/// assert!(x.contains(&2.0) && x.iter().any(|x| *x > 5.0 && *x < 5.5));
/// ```
pub fn spread(
    response: &[f32],
    shape: [usize; 3],
    spacing: [f64; 3],
    mask: Option<&[u8]>,
    wanted: usize,
    least: f32,
) -> Vec<Corner> {
    let cells = Cells::new(shape, spacing, mask, wanted);
    let found = maxima(response, shape, 0, mask, least);
    cells.best(found, wanted)
}

/// The corners of a smoothed volume, the same as [`spread`] finds in its
/// [`harris::block_response`], of which only some slices are held at a time. `mask` is on the
/// blocks; places are in blocks.
pub fn corners(
    smooth: &[f32],
    (shape, spacing): ([usize; 3], [f64; 3]),
    (integration_sigma, step): (f64, [usize; 3]),
    mask: Option<&[u8]>,
    wanted: usize,
    least: f32,
) -> Vec<Corner> {
    let blocks = reduced_shape(shape, step);
    let cells = Cells::new(blocks, std::array::from_fn(|a| spacing[a] * step[a] as f64), mask, wanted);
    let plane = blocks[0] * blocks[1];
    let mut found = Vec::new();
    // The last two slices of the slab before go first: a maximum is known once the slice after it
    // is.
    let mut window: Vec<f32> = Vec::new();
    harris::slabs(smooth, shape, spacing, integration_sigma, step, |first, slab| {
        let held = window.len() / plane;
        window.drain(..plane * held.saturating_sub(2));
        let from = first - window.len() / plane;
        window.extend_from_slice(slab);
        let part = [blocks[0], blocks[1], window.len() / plane];
        // One slice is a volume without neighbours only where there is no other.
        if part[2] > 1 || blocks[2] == 1 {
            found.extend(maxima(&window, part, from, mask, least));
        }
    });
    cells.best(found, wanted)
}

/// The cubes that a volume is cut into.
struct Cells {
    edge: [usize; 3],
    shape: [usize; 3],
}

impl Cells {
    /// `wanted` of them fill the mask.
    fn new(shape: [usize; 3], spacing: [f64; 3], mask: Option<&[u8]>, wanted: usize) -> Self {
        let all: usize = shape.iter().product();
        let area = mask.map_or(all, |m| m.iter().filter(|&&v| v != 0).count());
        let thick: Vec<usize> = (0..3).filter(|&a| shape[a] > 1).collect();
        let volume = area as f64 * thick.iter().map(|&a| spacing[a]).product::<f64>();
        let side = (volume / wanted.max(1) as f64).powf(1.0 / thick.len().max(1) as f64);
        let edge: [usize; 3] = std::array::from_fn(|a| (side / spacing[a]).ceil().max(1.0) as usize);
        Self { edge, shape: std::array::from_fn(|a| shape[a].div_ceil(edge[a])) }
    }

    /// The cube that holds a voxel.
    fn of(&self, [i, j, k]: [usize; 3]) -> usize {
        i / self.edge[0] + self.shape[0] * (j / self.edge[1] + self.shape[1] * (k / self.edge[2]))
    }

    /// The best of every cube, then the second best, up to `wanted`.
    fn best(&self, found: Vec<Corner>, wanted: usize) -> Vec<Corner> {
        let mut found: Vec<(usize, Corner)> = found.into_iter().map(|c| (self.of(c.centre), c)).collect();
        found.sort_by(|a, b| a.0.cmp(&b.0).then(b.1.response.total_cmp(&a.1.response)));
        // Rank within the cell, then response: the first of every cell before the second of any.
        let (mut last, mut rank) = (usize::MAX, 0);
        for (cell, _) in &mut found {
            rank = if *cell == last { rank + 1 } else { 0 };
            last = *cell;
            *cell = rank;
        }
        found.sort_by(|a, b| a.0.cmp(&b.0).then(b.1.response.total_cmp(&a.1.response)));
        found.truncate(wanted);
        found.into_iter().map(|(_, c)| c).collect()
    }
}

/// Local maxima above `least` of some slices of a volume, the first of which is its slice `from`,
/// in the order of memory. `mask` is that of the whole volume. The first and the last of more
/// slices than one have none.
fn maxima(response: &[f32], shape: [usize; 3], from: usize, mask: Option<&[u8]>, least: f32) -> Vec<Corner> {
    let [nx, ny, nz] = shape;
    let skipped = from * nx * ny;
    let in_slice = |k: usize| {
        let mut found = Vec::new();
        for j in 0..ny {
            for i in 0..nx {
                let at = i + nx * (j + ny * k);
                let inside = || mask.is_none_or(|m| m[skipped + at] != 0);
                if response[at] > least && inside() && is_maximum(response, shape, [i, j, k]) {
                    let (centre, top) = ([i, j, k + from], refine(response, shape, [i, j, k]));
                    let voxel = VoxelPoint(std::array::from_fn(|a| centre[a] as f64 + top[a]));
                    found.push(Corner { voxel, centre, response: response[at] });
                }
            }
        }
        found
    };
    (0..nz).into_par_iter().flat_map_iter(in_slice).collect()
}

/// Whether a voxel exceeds its 26 neighbours (ties go to the later voxel); border voxels of a thick
/// axis do not count.
fn is_maximum(v: &[f32], shape: [usize; 3], at: [usize; 3]) -> bool {
    let range = |a: usize| if shape[a] == 1 { 0..=0 } else { -1..=1 };
    if (0..3).any(|a| shape[a] > 1 && (at[a] == 0 || at[a] + 1 == shape[a])) {
        return false;
    }
    let index = at[0] + shape[0] * (at[1] + shape[1] * at[2]);
    for c in range(2) {
        for b in range(1) {
            for a in range(0) {
                let o = a + shape[0] as isize * (b + shape[1] as isize * c);
                let other = v[index.wrapping_add_signed(o)];
                if other > v[index] || (other == v[index] && o > 0) {
                    return false;
                }
            }
        }
    }
    true
}

/// The top of a parabola through the three values along each axis, from the voxel.
fn refine(v: &[f32], shape: [usize; 3], at: [usize; 3]) -> [f64; 3] {
    let stride = [1, shape[0], shape[0] * shape[1]];
    let index = at[0] + stride[1] * at[1] + stride[2] * at[2];
    std::array::from_fn(|a| {
        if shape[a] == 1 {
            return 0.0;
        }
        let [l, m, r] = [v[index - stride[a]], v[index], v[index + stride[a]]].map(f64::from);
        let curvature = l - 2.0 * m + r;
        if curvature < 0.0 { (0.5 * (l - r) / curvature).clamp(-0.5, 0.5) } else { 0.0 }
    })
}
