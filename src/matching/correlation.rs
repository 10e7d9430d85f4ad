//! Normalised cross-correlation of patches, and its exhaustive search.

use crate::numerics::filters::separable;
use crate::numerics::simd::{dispatch, dot};

/// A volume prepared for correlation with patches of one size: the patch sum of squares about the mean at each voxel.
#[derive(Debug, Clone)]
pub struct Searchable<'a> {
    data: &'a [f32],
    shape: [usize; 3],
    radius: [usize; 3],
    /// Square root of the sum of squares about the mean of the patch around each voxel; empty where it is worked out for
    /// each place that is asked for.
    norm: Vec<f32>,
}

/// A patch of the other volume, mean free and of norm one.
#[derive(Debug, Clone)]
pub struct Template {
    values: Vec<f32>,
    /// The same, each row along x filled up with zeros; empty where rows are wider.
    padded: Vec<[f32; WIDTH]>,
    radius: [usize; 3],
}

/// Shifts worked out together.
const LANES: usize = 16;

/// Widest patch along x whose sums are made on the spot.
const WIDTH: usize = 8;

/// A place found: offset from the centre of the search in voxels, and the correlation there (-1 to 1).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Peak {
    /// Offset (voxels).
    pub offset: [i32; 3],
    /// Normalised cross-correlation.
    pub ncc: f32,
}

/// Patch radius for a shape: none along a side of one voxel.
pub fn patch_radius(shape: [usize; 3], radius: [usize; 3]) -> [usize; 3] {
    std::array::from_fn(|a| if shape[a] == 1 { 0 } else { radius[a] })
}

impl<'a> Searchable<'a> {
    /// Prepares `data` for patches of `2 radius + 1` voxels. NaN voxels make every patch that holds them unmatched.
    pub fn new(data: &'a [f32], shape: [usize; 3], radius: [usize; 3]) -> Self {
        let radius = patch_radius(shape, radius);
        let kernels = radius.map(|r| vec![1.0 / (2 * r + 1) as f32; r + 1]);
        let box_mean = |v: &[f32]| separable(v, shape, [&kernels[0], &kernels[1], &kernels[2]]);
        let count = radius.iter().map(|r| 2 * r + 1).product::<usize>() as f32;
        // Squares about the volume's own mean, so that a large offset does not cost precision.
        let (sum, n) =
            data.iter().filter(|v| v.is_finite()).fold((0.0f64, 0usize), |(s, n), v| (s + f64::from(*v), n + 1));
        let level = (sum / n.max(1) as f64) as f32;
        let centred: Vec<f32> = data.iter().map(|v| v - level).collect();
        let squares: Vec<f32> = centred.iter().map(|v| v * v).collect();
        let (mean, square) = (box_mean(&centred), box_mean(&squares));
        let norm = mean.iter().zip(&square).map(|(m, s)| (count * (s - m * m)).max(0.0).sqrt()).collect();
        Self { data, shape, radius, norm }
    }

    /// As [`Searchable::new`] for few places and short searches: nothing is prepared. Patches wider than 8 voxels along x
    /// are prepared all the same.
    pub fn near(data: &'a [f32], shape: [usize; 3], radius: [usize; 3]) -> Self {
        let radius = patch_radius(shape, radius);
        if 2 * radius[0] + 1 > WIDTH {
            return Self::new(data, shape, radius);
        }
        Self { data, shape, radius, norm: Vec::new() }
    }

    /// Correlation with the patch around voxel `at`, which lies inside; not finite where there is none.
    #[inline(always)]
    fn direct(&self, template: &Template, at: [usize; 3]) -> f32 {
        let [rx, ry, rz] = self.radius;
        let width = 2 * rx + 1;
        let [nx, ny, _] = self.shape;
        let centre = self.data[at[0] + nx * (at[1] + ny * at[2])];
        let [mut cross, mut sum, mut square] = [[0.0f32; WIDTH]; 3];
        for (row, t) in template.padded.iter().enumerate() {
            let (j, k) = (at[1] + row % (2 * ry + 1) - ry, at[2] + row / (2 * ry + 1) - rz);
            let rest = &self.data[at[0] - rx + nx * (j + ny * k)..];
            let mut v = [centre; WIDTH];
            match rest.first_chunk::<WIDTH>() {
                // Past the patch stand the next voxels of the row: they do not count.
                Some(row) => (0..WIDTH).for_each(|l| v[l] = if l < width { row[l] } else { centre }),
                None => v[..width].copy_from_slice(&rest[..width]),
            }
            for l in 0..WIDTH {
                let d = v[l] - centre;
                cross[l] += t[l] * d;
                sum[l] += d;
                square[l] += d * d;
            }
        }
        let [cross, sum, square] = [cross, sum, square].map(|lanes| lanes.iter().sum::<f32>());
        cross / (square - sum * sum / template.values.len() as f32).sqrt()
    }

    /// The patch around a voxel; none where it leaves the volume, holds NaN, or is constant.
    pub fn template(&self, centre: [usize; 3]) -> Option<Template> {
        let [rx, ry, rz] = self.radius;
        if (0..3).any(|a| centre[a] < self.radius[a] || centre[a] + self.radius[a] >= self.shape[a]) {
            return None;
        }
        let mut values = Vec::with_capacity((2 * rx + 1) * (2 * ry + 1) * (2 * rz + 1));
        for k in centre[2] - rz..=centre[2] + rz {
            for j in centre[1] - ry..=centre[1] + ry {
                let from = centre[0] - rx + self.shape[0] * (j + self.shape[1] * k);
                values.extend_from_slice(&self.data[from..from + 2 * rx + 1]);
            }
        }
        let mean = values.iter().sum::<f32>() / values.len() as f32;
        values.iter_mut().for_each(|v| *v -= mean);
        let norm = dot(&values, &values).sqrt();
        if !(norm.is_finite() && norm > 1e-6 * mean.abs() && norm > 0.0) {
            return None;
        }
        values.iter_mut().for_each(|v| *v /= norm);
        let width = 2 * rx + 1;
        let mut padded = Vec::new();
        if width <= WIDTH {
            padded.extend(values.chunks_exact(width).map(|row| {
                let mut wide = [0.0; WIDTH];
                wide[..width].copy_from_slice(row);
                wide
            }));
        }
        Some(Template { values, padded, radius: self.radius })
    }

    /// Correlation with the patch around a voxel; none where that leaves the volume or holds NaN.
    pub fn ncc(&self, template: &Template, centre: [i64; 3]) -> Option<f32> {
        self.search(template, centre, [0; 3], 1).first().map(|p| p.ncc)
    }

    /// The `keep` best local maxima of the correlation over shifts up to `reach` voxels about `centre`, best first.
    ///
    /// Exhaustive; shifts whose patch leaves the volume do not take part.
    pub fn search(&self, template: &Template, centre: [i64; 3], reach: [usize; 3], keep: usize) -> Vec<Peak> {
        let size = reach.map(|r| 2 * r + 1);
        let mut scores = vec![f32::NEG_INFINITY; size.iter().product()];
        // Shifts along x whose patch lies inside.
        let first = |a: usize| (self.radius[a] as i64 - centre[a]).max(-(reach[a] as i64));
        let last = |a: usize| ((self.shape[a] - self.radius[a]) as i64 - 1 - centre[a]).min(reach[a] as i64);
        let (fx, lx) = (first(0), last(0));
        if fx > lx {
            return Vec::new();
        }
        let count = (lx - fx + 1) as usize;
        let [rx, ry, rz] = template.radius;
        let width = 2 * rx + 1;
        if self.norm.is_empty() {
            dispatch(
                #[inline(always)]
                || {
                    for dz in first(2)..=last(2) {
                        for dy in first(1)..=last(1) {
                            for dx in fx..=lx {
                                let d = [dx, dy, dz];
                                let at = std::array::from_fn(|a| (centre[a] + d[a]) as usize);
                                let [i, j, k] = std::array::from_fn(|a| (d[a] + reach[a] as i64) as usize);
                                let v = self.direct(template, at);
                                scores[i + size[0] * (j + size[1] * k)] =
                                    if v.is_finite() { v } else { f32::NEG_INFINITY };
                            }
                        }
                    }
                },
            );
            return peaks(&scores, size, reach, keep);
        }
        // Room for whole blocks of shifts.
        let mut line = vec![0.0f32; count.next_multiple_of(LANES)];
        dispatch(
            #[inline(always)]
            || {
                for dz in first(2)..=last(2) {
                    for dy in first(1)..=last(1) {
                        line.fill(0.0);
                        let at = [centre[0] + fx, centre[1] + dy, centre[2] + dz].map(|v| v as usize);
                        for (row, t) in template.values.chunks_exact(width).enumerate() {
                            let (j, k) = (at[1] + row % (2 * ry + 1) - ry, at[2] + row / (2 * ry + 1) - rz);
                            let from = at[0] - rx + self.shape[0] * (j + self.shape[1] * k);
                            // What lies past the last shift is worked out with it and left alone.
                            match self.data.get(from..from + line.len() + width - 1) {
                                Some(source) => {
                                    for (b, line) in line.as_chunks_mut::<LANES>().0.iter_mut().enumerate() {
                                        let source = &source[b * LANES..];
                                        let mut sum = *line;
                                        for (o, &w) in t.iter().enumerate() {
                                            let v = &source[o..o + LANES];
                                            for l in 0..LANES {
                                                sum[l] += w * v[l];
                                            }
                                        }
                                        *line = sum;
                                    }
                                }
                                None => {
                                    let source = &self.data[from..from + count + width - 1];
                                    for (o, &w) in t.iter().enumerate() {
                                        for (l, v) in line.iter_mut().zip(&source[o..]) {
                                            *l += w * v;
                                        }
                                    }
                                }
                            }
                        }
                        let from = at[0] + self.shape[0] * (at[1] + self.shape[1] * at[2]);
                        let to = size[0]
                            * ((dy + reach[1] as i64) as usize + size[1] * (dz + reach[2] as i64) as usize)
                            + (fx + reach[0] as i64) as usize;
                        for ((s, l), n) in scores[to..to + count].iter_mut().zip(&line).zip(&self.norm[from..]) {
                            let v = l / n;
                            *s = if v.is_finite() { v } else { f32::NEG_INFINITY };
                        }
                    }
                }
            },
        );
        peaks(&scores, size, reach, keep)
    }
}

/// Local maxima (26 neighbours) of a block of scores, the best `keep`, best first.
fn peaks(scores: &[f32], size: [usize; 3], reach: [usize; 3], keep: usize) -> Vec<Peak> {
    let mut found: Vec<Peak> = Vec::new();
    for k in 0..size[2] {
        for j in 0..size[1] {
            for i in 0..size[0] {
                let at = i + size[0] * (j + size[1] * k);
                let s = scores[at];
                if s == f32::NEG_INFINITY || (found.len() == keep && s <= found[keep - 1].ncc) {
                    continue;
                }
                let near = |a: usize, n: usize| a.saturating_sub(1)..=(a + 1).min(n - 1);
                let higher = near(k, size[2]).any(|c| {
                    near(j, size[1]).any(|b| {
                        near(i, size[0]).any(|a| {
                            let other = a + size[0] * (b + size[1] * c);
                            scores[other] > s || (scores[other] == s && other < at)
                        })
                    })
                });
                if !higher {
                    let offset = [i as i32 - reach[0] as i32, j as i32 - reach[1] as i32, k as i32 - reach[2] as i32];
                    let place = found.partition_point(|p| p.ncc >= s);
                    found.insert(place, Peak { offset, ncc: s });
                    found.truncate(keep);
                }
            }
        }
    }
    found
}
