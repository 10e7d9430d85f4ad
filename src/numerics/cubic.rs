//! Cubic B-spline sampling of whole rows: sixteen places at once.
//!
//! A displacement varies slowly, so neighbouring voxels of a row mostly fall into neighbouring cells of the sampled
//! volume. Such a run needs no gather: each of the 64 taps is one load of consecutive values.

use crate::numerics::bspline::weights;

/// Places treated at once.
pub const LANES: usize = 16;

/// Sixteen places: the cell that holds each (the index below it along each axis) and the fraction inside the cell.
#[derive(Debug, Clone, Copy)]
pub struct Places {
    /// Cell along x, y, z (voxels).
    pub cell: [[i32; LANES]; 3],
    /// Fraction inside the cell along x, y, z, 0 to 1.
    pub fraction: [[f32; LANES]; 3],
}

impl Places {
    /// All at the origin.
    pub const ORIGIN: Self = Self { cell: [[0; LANES]; 3], fraction: [[0.0; LANES]; 3] };

    /// Sets places `p` (voxels) along axis `a`. NaN and places beyond 2^31 go to cell `i32::MIN` or `i32::MAX`.
    #[inline(always)]
    pub fn set(&mut self, a: usize, p: &[f32; LANES]) {
        for l in 0..LANES {
            let floor = p[l].floor();
            self.cell[a][l] = floor as i32;
            self.fraction[a][l] = p[l] - floor;
        }
    }

    /// As [`Places::set`] in double precision.
    #[inline(always)]
    pub fn set_f64(&mut self, a: usize, p: &[f64; LANES]) {
        for l in 0..LANES {
            let floor = p[l].floor();
            self.cell[a][l] = floor as i32;
            self.fraction[a][l] = (p[l] - floor) as f32;
        }
    }
}

/// Samples `data` (x fastest) with the cubic B-spline kernel, without prefilter, at the first `count` places.
///
/// `edge(lane)` gives the value of a place whose 64 taps do not all lie inside; sides of one voxel always count so.
/// The same code runs for runs of any length, so a value does not depend on its neighbours.
#[inline(always)]
pub fn sample(
    data: &[f32],
    shape: [usize; 3],
    places: &Places,
    count: usize,
    out: &mut [f32],
    mut edge: impl FnMut(usize) -> f32,
) {
    let [nx, ny, _] = shape;
    let Places { cell: [cx, cy, cz], fraction } = places;
    let mut w = [[[0.0f32; LANES]; 4]; 3];
    for a in 0..3 {
        for l in 0..LANES {
            let v = weights(fraction[a][l]);
            for m in 0..4 {
                w[a][m][l] = v[m];
            }
        }
    }
    let n = shape.map(|n| n as i32);
    let inside = |c: i32, a: usize| c >= 1 && c < n[a] - 2;
    let mut start = 0;
    while start < count {
        let first = [cx[start], cy[start], cz[start]];
        let place = (0..3).all(|a| inside(first[a], a)).then(|| {
            // Index of the first tap of lane 0, were it in this run.
            let tap = (first[1] - 1) as usize * nx + (first[2] - 1) as usize * nx * ny + (first[0] - 1) as usize;
            tap.checked_sub(start)
        });
        let span = 3 * nx * ny + 3 * nx + LANES + 3;
        let Some(Some(base)) = place.filter(|b| b.is_some_and(|b| b + span <= data.len())) else {
            out[start] = if place.is_some() {
                single(data, shape, first, [0, 1, 2].map(|a| fraction[a][start]))
            } else {
                edge(start)
            };
            start += 1;
            continue;
        };
        let mut end = start + 1;
        while end < count
            && cx[end] - first[0] == (end - start) as i32
            && cx[end] < n[0] - 2
            && cy[end] == first[1]
            && cz[end] == first[2]
        {
            end += 1;
        }
        let data = &data[base..base + span];
        let mut sum = [0.0f32; LANES];
        for c in 0..4 {
            let mut plane = [0.0f32; LANES];
            for b in 0..4 {
                let at = nx * (b + ny * c);
                let row: &[f32] = &data[at..at + LANES + 3];
                for l in 0..LANES {
                    let along = w[0][0][l] * row[l]
                        + w[0][1][l] * row[l + 1]
                        + w[0][2][l] * row[l + 2]
                        + w[0][3][l] * row[l + 3];
                    plane[l] += w[1][b][l] * along;
                }
            }
            for l in 0..LANES {
                sum[l] += w[2][c][l] * plane[l];
            }
        }
        out[start..end].copy_from_slice(&sum[start..end]);
        start = end;
    }
}

/// One place whose taps lie inside, in the same order of operations as a run.
#[inline(always)]
fn single(data: &[f32], [nx, ny, _]: [usize; 3], cell: [i32; 3], fraction: [f32; 3]) -> f32 {
    let w = fraction.map(weights);
    let base = cell.map(|c| (c - 1) as usize);
    let mut sum = 0.0;
    for c in 0..4 {
        let mut plane = 0.0;
        for b in 0..4 {
            let at = base[0] + nx * (base[1] + b + ny * (base[2] + c));
            let row = &data[at..at + 4];
            plane += w[1][b] * (w[0][0] * row[0] + w[0][1] * row[1] + w[0][2] * row[2] + w[0][3] * row[3]);
        }
        sum += w[2][c] * plane;
    }
    sum
}
