//! Normalised cross-correlation of patches, and its exhaustive search.

use crate::numerics::filters::separable;
use crate::numerics::simd::{dispatch, dot};

/// A volume prepared for correlation with patches of one size: the patch sum of squares about the
/// mean at each voxel.
#[derive(Debug, Clone)]
pub struct Searchable<'a> {
    data: &'a [f32],
    shape: [usize; 3],
    radius: [usize; 3],
    /// Square root of the sum of squares about the mean of the patch around each voxel; empty where
    /// it is worked out for each place that is asked for.
    norm: Vec<f32>,
}

/// A patch of the other volume, mean free and of norm one.
#[derive(Debug, Clone)]
pub struct Template {
    values: Vec<f32>,
    /// The same, each row along x filled up with zeros; empty where rows are wider.
    padded: Vec<[f32; MAX_DIRECT_WIDTH_VOXELS]>,
}

/// Shifts whose correlation is computed together, or twice as many.
const LANES: usize = 16;

/// Reach along y or z (voxels) from which the first search visits every second shift only.
const STRIDED_SEARCH_REACH_VOXELS: usize = 4;

/// Peaks of that search about which all shifts are then visited, for each candidate that is kept.
const COARSE_PEAKS_PER_CANDIDATE: usize = 2;

/// Widest patch along x (voxels) whose sums are computed directly.
const MAX_DIRECT_WIDTH_VOXELS: usize = 8;

/// A place found: offset from the centre of the search in voxels, and the correlation there (-1 to
/// 1).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Peak {
    /// Offset (voxels).
    pub offset: [i32; 3],
    /// Normalised cross-correlation.
    pub ncc: f32,
}

/// Patch radius for a shape: none along a side of one voxel.
pub(crate) fn patch_radius(shape: [usize; 3], radius: [usize; 3]) -> [usize; 3] {
    std::array::from_fn(|a| if shape[a] == 1 { 0 } else { radius[a] })
}

impl<'a> Searchable<'a> {
    /// Prepares `data` for patches of `2 radius + 1` voxels. NaN voxels make every patch that holds
    /// them unmatched.
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

    /// As [`Searchable::new`] for few places and short searches: nothing is prepared. Patches wider
    /// than 8 voxels along x are prepared all the same.
    pub fn near(data: &'a [f32], shape: [usize; 3], radius: [usize; 3]) -> Self {
        let radius = patch_radius(shape, radius);
        if 2 * radius[0] + 1 > MAX_DIRECT_WIDTH_VOXELS {
            return Self::new(data, shape, radius);
        }
        Self { data, shape, radius, norm: Vec::new() }
    }

    /// Correlation with the patch around voxel `at`, which lies inside; not finite where there is
    /// none.
    #[inline(always)]
    fn direct(&self, template: &Template, at: [usize; 3]) -> f32 {
        let [rx, ry, rz] = self.radius;
        let width = 2 * rx + 1;
        let [nx, ny, _] = self.shape;
        let centre = self.data[at[0] + nx * (at[1] + ny * at[2])];
        let [mut cross, mut sum, mut square] = [[0.0f32; MAX_DIRECT_WIDTH_VOXELS]; 3];
        for (row, t) in template.padded.iter().enumerate() {
            let (j, k) = (at[1] + row % (2 * ry + 1) - ry, at[2] + row / (2 * ry + 1) - rz);
            let rest = &self.data[at[0] - rx + nx * (j + ny * k)..];
            let mut v = [centre; MAX_DIRECT_WIDTH_VOXELS];
            match rest.first_chunk::<MAX_DIRECT_WIDTH_VOXELS>() {
                // Past the patch stand the next voxels of the row: they do not count.
                Some(row) => (0..MAX_DIRECT_WIDTH_VOXELS).for_each(|l| v[l] = if l < width { row[l] } else { centre }),
                None => v[..width].copy_from_slice(&rest[..width]),
            }
            for l in 0..MAX_DIRECT_WIDTH_VOXELS {
                let d = v[l] - centre;
                cross[l] += t[l] * d;
                sum[l] += d;
                square[l] += d * d;
            }
        }
        let [cross, sum, square] = [cross, sum, square].map(|lanes| lanes.iter().sum::<f32>());
        cross / (square - sum * sum / template.values.len() as f32).sqrt()
    }

    /// Sums of products with the patches around the voxels from `at` on along x, as many as `line`
    /// holds (a multiple of [`LANES`]). What lies past the volume's last voxel is not summed.
    #[inline(always)]
    fn line(&self, template: &Template, at: [usize; 3], line: &mut [f32]) {
        let (wide, rest) = line.as_chunks_mut::<{ 2 * LANES }>();
        for (b, sums) in wide.iter_mut().enumerate() {
            self.sums(template, [at[0] + b * 2 * LANES, at[1], at[2]], sums);
        }
        if let Some(sums) = rest.first_chunk_mut::<LANES>() {
            self.sums(template, [at[0] + wide.len() * 2 * LANES, at[1], at[2]], sums);
        }
    }

    /// As [`Searchable::line`], for as many as keep the sums in registers.
    #[inline(always)]
    fn sums<const N: usize>(&self, template: &Template, at: [usize; 3], sums: &mut [f32; N]) {
        let [rx, ry, rz] = self.radius;
        let [nx, ny, _] = self.shape;
        let width = 2 * rx + 1;
        let last = at[0] - rx + nx * (at[1] + ry + ny * (at[2] + rz));
        if last + N + width - 1 > self.data.len() {
            self.last_sums(template, at, sums);
            return;
        }
        let mut sum = [0.0f32; N];
        let mut rows = template.values.chunks_exact(width);
        for k in at[2] - rz..=at[2] + rz {
            for j in at[1] - ry..=at[1] + ry {
                let Some(t) = rows.next() else { continue };
                let source = &self.data[at[0] - rx + nx * (j + ny * k)..][..N + width - 1];
                for (&w, v) in t.iter().zip(source.windows(N)) {
                    let Some(v) = v.first_chunk::<N>() else { continue };
                    for l in 0..N {
                        sum[l] += w * v[l];
                    }
                }
            }
        }
        *sums = sum;
    }

    /// As [`Searchable::sums`] at the end of the volume.
    fn last_sums(&self, template: &Template, at: [usize; 3], sums: &mut [f32]) {
        let [rx, ry, rz] = self.radius;
        let [nx, ny, _] = self.shape;
        sums.fill(0.0);
        for (r, t) in template.values.chunks_exact(2 * rx + 1).enumerate() {
            let (j, k) = (at[1] + r % (2 * ry + 1) - ry, at[2] + r / (2 * ry + 1) - rz);
            for (o, w) in t.iter().enumerate() {
                let source = self.data.get(at[0] - rx + nx * (j + ny * k) + o..).unwrap_or_default();
                for (s, v) in sums.iter_mut().zip(source) {
                    *s += w * v;
                }
            }
        }
    }

    /// Sum of products with the patch around voxel `at`, which lies inside.
    #[inline(always)]
    fn cross(&self, template: &Template, at: [usize; 3]) -> f32 {
        let [rx, ry, rz] = self.radius;
        let [nx, ny, _] = self.shape;
        let width = 2 * rx + 1;
        let mut cross = [0.0f32; MAX_DIRECT_WIDTH_VOXELS];
        let mut t = template.padded.iter();
        for k in at[2] - rz..=at[2] + rz {
            for j in at[1] - ry..=at[1] + ry {
                let Some(t) = t.next() else { continue };
                let rest = &self.data[at[0] - rx + nx * (j + ny * k)..];
                // Past the patch stand the next voxels of the row, and zeros in the template.
                let mut v = [0.0; MAX_DIRECT_WIDTH_VOXELS];
                match rest.first_chunk::<MAX_DIRECT_WIDTH_VOXELS>() {
                    Some(row) => (0..MAX_DIRECT_WIDTH_VOXELS).for_each(|l| v[l] = if l < width { row[l] } else { 0.0 }),
                    None => v[..width].copy_from_slice(&rest[..width]),
                }
                (0..MAX_DIRECT_WIDTH_VOXELS).for_each(|l| cross[l] += t[l] * v[l]);
            }
        }
        cross.iter().sum()
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
        if width <= MAX_DIRECT_WIDTH_VOXELS {
            padded.extend(values.chunks_exact(width).map(|row| {
                let mut wide = [0.0; MAX_DIRECT_WIDTH_VOXELS];
                wide[..width].copy_from_slice(row);
                wide
            }));
        }
        Some(Template { values, padded })
    }

    /// Correlation with the patch around a voxel; none where that leaves the volume or holds NaN.
    pub fn ncc(&self, template: &Template, centre: [i64; 3]) -> Option<f32> {
        self.search(template, centre, [0; 3], 1).first().map(|p| p.ncc)
    }

    /// The `keep` best local maxima of the correlation over shifts up to `reach` voxels about
    /// `centre`, best first.
    ///
    /// Shifts whose patch leaves the volume do not take part. Exhaustive where `reach` is short;
    /// along y and z, where it is not, every second shift is looked at and then all that lie beside
    /// the best of these: a patch of a smoothed volume is still like itself a voxel away.
    ///
    /// ```
    /// use palpate::matching::correlation::Searchable;
    /// // The same random texture, two voxels further along x.
    /// let texture = |x: i64, y: i64, z: i64| {
    ///     ((x * 7 + y * 101 + z * 1009) * 1_103_515_245 >> 8 & 255) as f32
    /// };
    /// let volume = |shift: i64| -> Vec<f32> {
    ///     (0..4096).map(|o| texture(o % 16 - shift, o / 16 % 16, o / 256)).collect()
    /// };
    /// let (fixed, moving) = (volume(0), volume(2));
    /// let (here, there) =
    ///     (Searchable::new(&fixed, [16; 3], [2; 3]), Searchable::new(&moving, [16; 3], [2; 3]));
    /// let template = here.template([8, 8, 8]).ok_or("no texture")?;
    /// let found = there.search(&template, [8, 8, 8], [3; 3], 1);
    /// assert_eq!(found[0].offset, [2, 0, 0]);
    /// assert!(found[0].ncc > 0.999);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn search(&self, template: &Template, centre: [i64; 3], reach: [usize; 3], keep: usize) -> Vec<Peak> {
        // Shifts whose patch lies inside, along each axis.
        let within: [[i64; 2]; 3] = std::array::from_fn(|a| {
            let (reach, radius) = (reach[a] as i64, self.radius[a] as i64);
            [(radius - centre[a]).max(-reach), (self.shape[a] as i64 - radius - 1 - centre[a]).min(reach)]
        });
        if within.iter().any(|[first, last]| first > last) {
            return Vec::new();
        }
        let rows_apart =
            |a: usize| if reach[a] >= STRIDED_SEARCH_REACH_VOXELS && !template.padded.is_empty() { 2 } else { 1 };
        let step = if self.norm.is_empty() { [1; 3] } else { [1, rows_apart(1), rows_apart(2)] };
        let count = |a: usize| (within[a][1] - within[a][0]) as usize / step[a] + 1;
        let size = [count(0), count(1), count(2)];
        let mut scores = vec![f32::NEG_INFINITY; size.iter().product()];
        let at = |i: [usize; 3]| -> [usize; 3] {
            std::array::from_fn(|a| (centre[a] + within[a][0]) as usize + step[a] * i[a])
        };
        // Room for whole blocks of shifts.
        let mut line = vec![0.0f32; size[0].next_multiple_of(LANES)];
        dispatch(
            #[inline(always)]
            || {
                for (row, scores) in scores.chunks_exact_mut(size[0]).enumerate() {
                    let at = at([0, row % size[1], row / size[1]]);
                    if self.norm.is_empty() {
                        for (i, s) in scores.iter_mut().enumerate() {
                            *s = finite(self.direct(template, [at[0] + i, at[1], at[2]]));
                        }
                        continue;
                    }
                    self.line(template, at, &mut line);
                    for ((s, l), n) in scores.iter_mut().zip(&line).zip(&self.norm[self.offset(at)..]) {
                        *s = finite(l / n);
                    }
                }
            },
        );
        let shift = |i: [usize; 3]| std::array::from_fn(|a| within[a][0] as i32 + (step[a] * i[a]) as i32);
        if step == [1; 3] {
            let whole = |(i, ncc)| Peak { offset: shift(i), ncc };
            return peaks(&scores, size, keep).into_iter().map(whole).collect();
        }
        let rough = peaks(&scores, size, COARSE_PEAKS_PER_CANDIDATE * keep);
        let mut found: Vec<Peak> = Vec::with_capacity(rough.len());
        dispatch(
            #[inline(always)]
            || {
                for &(i, ncc) in &rough {
                    let middle: [i32; 3] = shift(i);
                    let mut best = Peak { offset: middle, ncc };
                    let beside =
                        |a: usize| (middle[a] - 1).max(within[a][0] as i32)..=(middle[a] + 1).min(within[a][1] as i32);
                    for dz in beside(2) {
                        for dy in beside(1) {
                            for dx in beside(0) {
                                let offset = [dx, dy, dz];
                                let at = std::array::from_fn(|a| (centre[a] + i64::from(offset[a])) as usize);
                                let ncc = finite(self.cross(template, at) / self.norm[self.offset(at)]);
                                if ncc > best.ncc {
                                    best = Peak { offset, ncc };
                                }
                            }
                        }
                    }
                    found.push(best);
                }
            },
        );
        found.sort_by(|a, b| b.ncc.total_cmp(&a.ncc).then(a.offset.cmp(&b.offset)));
        found.dedup_by_key(|p| p.offset);
        found.truncate(keep);
        found
    }

    /// Offset of a voxel.
    #[inline(always)]
    fn offset(&self, at: [usize; 3]) -> usize {
        at[0] + self.shape[0] * (at[1] + self.shape[1] * at[2])
    }
}

/// What is not finite is worse than all else.
#[inline(always)]
fn finite(score: f32) -> f32 {
    if score.is_finite() { score } else { f32::NEG_INFINITY }
}

/// Local maxima (26 neighbours) of a block of scores and their places, the best `keep`, best first.
fn peaks(scores: &[f32], size: [usize; 3], keep: usize) -> Vec<([usize; 3], f32)> {
    let mut found: Vec<([usize; 3], f32)> = Vec::new();
    for k in 0..size[2] {
        for j in 0..size[1] {
            for i in 0..size[0] {
                let at = i + size[0] * (j + size[1] * k);
                let s = scores[at];
                if s == f32::NEG_INFINITY || (found.len() == keep && s <= found[keep - 1].1) {
                    continue;
                }
                // Most places have a better one beside them in their row.
                if (i > 0 && scores[at - 1] >= s) || (i + 1 < size[0] && scores[at + 1] > s) {
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
                    let place = found.partition_point(|p| p.1 >= s);
                    found.insert(place, ([i, j, k], s));
                    found.truncate(keep);
                }
            }
        }
    }
    found
}
