//! From a response volume to points: local maxima, an even spread, sub-voxel positions.

use rayon::prelude::*;

/// A corner in voxels of the volume it was found in.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Corner {
    /// Sub-voxel position.
    pub voxel: [f64; 3],
    /// The voxel it was found at.
    pub centre: [usize; 3],
    /// Response, (intensity/mm)^2.
    pub response: f32,
}

/// At most `wanted` local maxima of `response` above `least`, spread evenly.
///
/// The volume is cut into cubes (in mm) of the size at which `wanted` of them fill the mask; each cube gives its best
/// maximum, then its second best, and so on until there are enough (Brown, Szeliski & Winder 2005 have the same aim).
/// Global ranking would crowd the points on the brightest structure: measured, five times fewer usable points.
/// Positions are refined by a parabola along each axis. The result's order does not depend on threads.
pub fn spread(
    response: &[f32],
    shape: [usize; 3],
    spacing: [f64; 3],
    mask: Option<&[u8]>,
    wanted: usize,
    least: f32,
) -> Vec<Corner> {
    let [nx, ny, _] = shape;
    let inside = |i: usize| mask.is_none_or(|m| m[i] != 0);
    let area = response.len().min(mask.map_or(response.len(), |m| m.iter().filter(|&&v| v != 0).count()));
    let thick: Vec<usize> = (0..3).filter(|&a| shape[a] > 1).collect();
    let volume = area as f64 * thick.iter().map(|&a| spacing[a]).product::<f64>();
    let edge = (volume / wanted.max(1) as f64).powf(1.0 / thick.len().max(1) as f64);
    let cell: [usize; 3] = std::array::from_fn(|a| (edge / spacing[a]).ceil().max(1.0) as usize);
    let cells: [usize; 3] = std::array::from_fn(|a| shape[a].div_ceil(cell[a]));
    let mut maxima: Vec<(usize, Corner)> = (0..shape[2])
        .into_par_iter()
        .flat_map_iter(|k| {
            let mut found = Vec::new();
            for j in 0..ny {
                for i in 0..nx {
                    let at = i + nx * (j + ny * k);
                    if response[at] > least && inside(at) && is_maximum(response, shape, [i, j, k]) {
                        let cell = i / cell[0] + cells[0] * (j / cell[1] + cells[1] * (k / cell[2]));
                        let corner = Corner {
                            voxel: refine(response, shape, [i, j, k]),
                            centre: [i, j, k],
                            response: response[at],
                        };
                        found.push((cell, corner));
                    }
                }
            }
            found
        })
        .collect();
    maxima.sort_by(|a, b| a.0.cmp(&b.0).then(b.1.response.total_cmp(&a.1.response)));
    // Rank within the cell, then response: the first of every cell before the second of any.
    let mut ranked: Vec<(usize, Corner)> = Vec::with_capacity(maxima.len());
    let (mut last, mut rank) = (usize::MAX, 0);
    for (cell, corner) in maxima {
        rank = if cell == last { rank + 1 } else { 0 };
        last = cell;
        ranked.push((rank, corner));
    }
    ranked.sort_by(|a, b| a.0.cmp(&b.0).then(b.1.response.total_cmp(&a.1.response)));
    ranked.truncate(wanted);
    ranked.into_iter().map(|(_, c)| c).collect()
}

/// Whether a voxel exceeds its 26 neighbours (ties go to the later voxel); border voxels of a thick axis do not count.
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

/// The top of a parabola through the three values along each axis.
fn refine(v: &[f32], shape: [usize; 3], at: [usize; 3]) -> [f64; 3] {
    let stride = [1, shape[0], shape[0] * shape[1]];
    let index = at[0] + stride[1] * at[1] + stride[2] * at[2];
    std::array::from_fn(|a| {
        let centre = at[a] as f64;
        if shape[a] == 1 {
            return centre;
        }
        let [l, m, r] = [v[index - stride[a]], v[index], v[index + stride[a]]].map(f64::from);
        let curvature = l - 2.0 * m + r;
        if curvature < 0.0 { centre + (0.5 * (l - r) / curvature).clamp(-0.5, 0.5) } else { centre }
    })
}
