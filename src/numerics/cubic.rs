//! Cubic B-spline sampling of whole rows: sixteen places at once.
//!
//! A displacement varies slowly, so neighbouring voxels of a row mostly fall into neighbouring
//! cells of the sampled volume. Such a run needs no gather: each of the 64 taps is one load of
//! consecutive values.

use crate::numerics::bspline::weights;

/// Positions processed together.
pub(crate) const LANES: usize = 16;

/// Most adjacent positions computed together: most runs are shorter where tissue is strained.
const MAX_RUN: usize = 8;

/// Sixteen places: the cell that holds each (the index below it along each axis) and the fraction
/// inside the cell.
#[derive(Debug, Clone, Copy)]
pub struct Places {
    /// Cell along x, y, z (voxels).
    pub cell: [[i32; LANES]; 3],
    /// Fraction inside the cell along x, y, z, 0 to 1.
    pub fraction: [[f32; LANES]; 3],
}

impl Places {
    /// All at the origin.
    pub(crate) const ORIGIN: Self = Self { cell: [[0; LANES]; 3], fraction: [[0.0; LANES]; 3] };

    /// Sets places `p` (voxels) along axis `a`. Places beyond 2^31 go to cell `i32::MIN` or
    /// `i32::MAX`, NaN to 0 with a fraction that is NaN.
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
    pub(crate) fn set_f64(&mut self, a: usize, p: &[f64; LANES]) {
        for l in 0..LANES {
            let floor = p[l].floor();
            self.cell[a][l] = floor as i32;
            self.fraction[a][l] = (p[l] - floor) as f32;
        }
    }
}

/// Samples `data` (x fastest) with the cubic B-spline kernel, without prefilter, at the first
/// `count` places.
///
/// `edge(lane)` gives the value of a place whose 64 taps do not all lie inside; sides of one voxel
/// always count so. The same code runs for runs of any length, so a value does not depend on its
/// neighbours.
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
        if !(0..3).all(|a| inside(first[a], a)) {
            out[start] = edge(start);
            start += 1;
            continue;
        }
        let lane = start.min(LANES - MAX_RUN);
        let mut end = start + 1;
        while end < count.min(lane + MAX_RUN)
            && cx[end] - first[0] == (end - start) as i32
            && cx[end] < n[0] - 2
            && cy[end] == first[1]
            && cz[end] == first[2]
        {
            end += 1;
        }
        // The first tap of the run's first place.
        let tap = (first[1] - 1) as usize * nx + (first[2] - 1) as usize * nx * ny + (first[0] - 1) as usize;
        match tap.checked_sub(start - lane).and_then(|base| run(data, shape, base, &w, lane)) {
            Some(values) => out[start..end].copy_from_slice(&values[start - lane..end - lane]),
            None => {
                for (l, out) in (start..end).zip(&mut out[start..end]) {
                    *out = single(data, shape, tap + l - start, [0, 1, 2].map(|a| fraction[a][l]));
                }
            }
        }
        start = end;
    }
}

/// What the taps from `base` on give for the places of the lanes from `lane` on, were they one run;
/// none where that would read past the end. Spelled out in arrays of eight, which the compiler
/// keeps in registers.
#[inline(always)]
fn run(
    data: &[f32],
    [nx, ny, _]: [usize; 3],
    base: usize,
    w: &[[[f32; LANES]; 4]; 3],
    lane: usize,
) -> Option<[f32; MAX_RUN]> {
    let data = data.get(base..base + 3 * nx * ny + 3 * nx + MAX_RUN + 3)?;
    let weight = |a: usize, m: usize| eight(&w[a][m][lane..]);
    let x = [weight(0, 0), weight(0, 1), weight(0, 2), weight(0, 3)];
    let mut sum = [0.0; MAX_RUN];
    for c in 0..4 {
        let mut plane = [0.0; MAX_RUN];
        for b in 0..4 {
            let row = &data[nx * (b + ny * c)..][..MAX_RUN + 3];
            let mut along = [0.0; MAX_RUN];
            for m in 0..4 {
                add_product(&mut along, x[m], eight(&row[m..]));
            }
            add_product(&mut plane, weight(1, b), along);
        }
        add_product(&mut sum, weight(2, c), plane);
    }
    Some(sum)
}

/// The first eight of a slice of that many or more.
#[inline(always)]
fn eight(v: &[f32]) -> [f32; MAX_RUN] {
    let v = &v[..MAX_RUN];
    std::array::from_fn(|l| v[l])
}

/// `sum += a * b`, lane by lane.
#[inline(always)]
fn add_product(sum: &mut [f32; MAX_RUN], a: [f32; MAX_RUN], b: [f32; MAX_RUN]) {
    for l in 0..MAX_RUN {
        sum[l] += a[l] * b[l];
    }
}

/// One place whose taps lie inside, the first of them at `tap`, in the same order of operations as
/// a run.
#[inline(always)]
fn single(data: &[f32], [nx, ny, _]: [usize; 3], tap: usize, fraction: [f32; 3]) -> f32 {
    let w = fraction.map(weights);
    let mut sum = 0.0;
    for c in 0..4 {
        let mut plane = 0.0;
        for b in 0..4 {
            let at = tap + nx * (b + ny * c);
            let row = &data[at..at + 4];
            plane += w[1][b] * (w[0][0] * row[0] + w[0][1] * row[1] + w[0][2] * row[2] + w[0][3] * row[3]);
        }
        sum += w[2][c] * plane;
    }
    sum
}
