//! What was measured inside the body: places with a displacement, and how a solution is read there.

use crate::numerics::sampling::displacement;
use crate::numerics::tetrahedron::{barycentric, shapes};
use crate::stiffness::elements::{Mapping, jacobian};
use crate::stiffness::fem_body::Body;
use crate::types::{Displacement, Mask, Match, SparseField, VoxelPoint, WorldPoint};
use rayon::prelude::*;

/// Barycentric coordinates above minus this are inside an element.
const BARYCENTRIC_TOLERANCE: f64 = 1e-6;

/// Least barycentric coordinate in the straight element of a place that may lie in the curved one.
const MIN_STRAIGHT_BARYCENTRIC: f64 = -0.3;
/// Most samples of a dense field: blocks of voxels are averaged to stay below.
const MAX_DENSE_SAMPLES: usize = 60_000;
/// Samples of a match's patch along each axis.
const PATCH_SAMPLES_PER_AXIS: usize = 3;
/// Samples of a match's patch.
const PATCH_SAMPLES: usize = PATCH_SAMPLES_PER_AXIS * PATCH_SAMPLES_PER_AXIS * PATCH_SAMPLES_PER_AXIS;
/// Every other corner of a cube.
const CUBE_CORNERS: [[f64; 3]; 4] = [[-1.0, -1.0, -1.0], [1.0, 1.0, -1.0], [1.0, -1.0, 1.0], [-1.0, 1.0, 1.0]];

/// An element and the weights of its nodes.
pub type Reading = (u32, [f64; 10]);

/// A measured displacement: at a place, or the mean over a block of voxels or a match's patch about
/// it.
#[derive(Debug, Clone, PartialEq)]
pub struct Observation {
    /// Where (mm, RAS); the middle of the block or patch.
    pub place: [f64; 3],
    /// Places whose mean is that over the block or patch, to second order; none for a single place.
    pub around: Vec<[f64; 3]>,
    /// The elements that hold the places, and the shape functions there.
    pub readings: Vec<Reading>,
    /// Measured displacement (mm, RAS).
    pub displacement: [f64; 3],
    /// Its standard deviation (mm, a component), up to a common factor.
    pub sigma: f64,
}

impl Observation {
    /// The displacement of a vector of unknowns at this place (mm).
    #[inline]
    pub fn read(&self, body: &Body, x: &[f64]) -> [f64; 3] {
        read(&self.readings, body, x)
    }

    fn places(&self) -> &[[f64; 3]] {
        if self.around.is_empty() { std::slice::from_ref(&self.place) } else { &self.around }
    }
}

/// The displacement of a vector of unknowns by elements and weights (mm).
#[inline]
pub fn read(readings: &[Reading], body: &Body, x: &[f64]) -> [f64; 3] {
    let mut u = [0.0; 3];
    for (element, weights) in readings {
        for (&n, &w) in body.cells[*element as usize].iter().zip(weights) {
            let at = body.pattern.first(n);
            for a in 0..3 {
                u[a] += w * x[at + a];
            }
        }
    }
    u
}

/// The gradient of the displacement of a vector of unknowns where it is read so: each component by
/// each coordinate.
pub fn gradient((element, weights): &Reading, body: &Body, x: &[f64]) -> [[f64; 3]; 3] {
    let cell = body.cells[*element as usize];
    let (by_node, _) = jacobian(&cell.map(|n| body.places[n as usize]), barycentric(weights));
    let mut out = [[0.0; 3]; 3];
    for (n, slope) in cell.iter().zip(by_node) {
        let u = body.displacement(x, *n);
        (0..3).for_each(|a| (0..3).for_each(|b| out[a][b] += u[a] * slope[b]));
    }
    out
}

/// How each observation is read in a body; none where a part of it lies outside.
pub(crate) fn readings(body: &Body, observations: &[Observation]) -> Vec<Option<Vec<Reading>>> {
    let places: Vec<[f64; 3]> = observations.iter().flat_map(Observation::places).copied().collect();
    let mut rest = find(body, &places).into_iter();
    let one = |o: &Observation| {
        // All of them are taken, whether or not one is outside.
        let found: Vec<Option<Reading>> = rest.by_ref().take(o.places().len()).collect();
        found.into_iter().collect::<Option<Vec<Reading>>>().map(|found| mean(&found))
    };
    observations.iter().map(one).collect()
}

/// The mean over some readings, one an element.
fn mean(found: &[Reading]) -> Vec<Reading> {
    let mut out = Vec::<Reading>::new();
    for (element, weights) in found {
        let weights = weights.map(|w| w / found.len() as f64);
        match out.iter_mut().find(|r| r.0 == *element) {
            Some((_, sum)) => sum.iter_mut().zip(weights).for_each(|(s, w)| *s += w),
            None => out.push((*element, weights)),
        }
    }
    out
}

/// The element that holds each place (mm, RAS) and the shape functions there; none outside the
/// body.
pub fn find(body: &Body, places: &[[f64; 3]]) -> Vec<Option<Reading>> {
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for p in &body.places {
        for a in 0..3 {
            low[a] = low[a].min(p[a]);
            high[a] = high[a].max(p[a]);
        }
    }
    let volume: f64 = (0..3).map(|a| (high[a] - low[a]).max(1e-9)).product();
    let size = (8.0 * volume / places.len().max(8) as f64).cbrt();
    let count: [usize; 3] = std::array::from_fn(|a| ((high[a] - low[a]) / size) as usize + 1);
    let cell = |p: &[f64; 3]| -> [usize; 3] {
        std::array::from_fn(|a| (((p[a] - low[a]) / size).max(0.0) as usize).min(count[a] - 1))
    };
    let key = |c: [usize; 3]| c[0] + count[0] * (c[1] + count[1] * c[2]);
    let mut start = vec![0u32; count.iter().product::<usize>() + 1];
    places.iter().for_each(|p| start[key(cell(p)) + 1] += 1);
    (1..start.len()).for_each(|i| start[i] += start[i - 1]);
    let mut fill = start.clone();
    let mut sorted = vec![0u32; places.len()];
    for (i, p) in places.iter().enumerate() {
        let at = &mut fill[key(cell(p))];
        sorted[*at as usize] = i as u32;
        *at += 1;
    }
    let search = |e: usize| {
        let nodes = body.cells[e].map(|n| body.places[n as usize]);
        let (mut l, mut h) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for p in &nodes {
            for a in 0..3 {
                l[a] = l[a].min(p[a]);
                h[a] = h[a].max(p[a]);
            }
        }
        let mapping = Mapping::of(&nodes);
        let (c0, c1) = (cell(&l), cell(&h));
        let mut found = Vec::new();
        for z in c0[2]..=c1[2] {
            for y in c0[1]..=c1[1] {
                for x in c0[0]..=c1[0] {
                    let k = key([x, y, z]);
                    for &i in &sorted[start[k] as usize..start[k + 1] as usize] {
                        let p = places[i as usize];
                        let is_beside = (0..3).any(|a| p[a] < l[a] - 0.1 || p[a] > h[a] + 0.1);
                        if is_beside || mapping.straight(p).iter().any(|&v| v < MIN_STRAIGHT_BARYCENTRIC) {
                            continue;
                        }
                        if let Some(b) = mapping.locate(p).filter(|b| b.iter().all(|&v| v >= -BARYCENTRIC_TOLERANCE)) {
                            found.push((i, shapes(b)));
                        }
                    }
                }
            }
        }
        found
    };
    let per: Vec<Vec<(u32, [f64; 10])>> = (0..body.cells.len()).into_par_iter().map(search).collect();
    let mut out = vec![None; places.len()];
    for (e, list) in per.into_iter().enumerate() {
        for (i, w) in list {
            out[i as usize].get_or_insert((e as u32, w));
        }
    }
    out
}

/// Those observations that lie in the body, ready to be read.
fn located(body: &Body, observations: Vec<Observation>) -> Vec<Observation> {
    let found = readings(body, &observations);
    let join = |(o, f): (Observation, Option<_>)| f.map(|readings| Observation { readings, ..o });
    observations.into_iter().zip(found).filter_map(join).collect()
}

/// How far from the middle of a block of voxels, along each axis and in voxels, lie four corners of
/// a cube that have the block's mean and second moments.
fn spread(block: usize) -> f64 {
    ((block * block - 1) as f64 / 12.0).sqrt()
}

/// Voxels along the edge of the blocks that a body of `voxels` voxels is averaged over.
pub(crate) fn block_for(voxels: usize) -> usize {
    (1..6).find(|b| voxels / (b * b * b) <= MAX_DENSE_SAMPLES).unwrap_or(6)
}

/// Samples of a dense field: means over blocks of voxels that lie in the mask as a whole. The
/// second value is the number of voxels along a block's edge. The model's mean is taken as well:
/// where strain changes, that is not the displacement at the middle.
pub fn from_field(body: &Body, field: &Displacement<'_>, mask: &Mask) -> (Vec<Observation>, usize) {
    let grid = field.grid();
    let [nx, ny, nz] = grid.shape();
    let inside = mask.as_slice();
    let voxels = inside.iter().filter(|&&v| v > 0).count();
    let block = block_for(voxels);
    let middle = 0.5 * (block - 1) as f64;
    let parts: [&[f32]; 3] = std::array::from_fn(|c| field.component(c));
    let row = |k: usize| {
        let mut out = Vec::new();
        for j in (0..ny.saturating_sub(block - 1)).step_by(block) {
            'next: for i in (0..nx.saturating_sub(block - 1)).step_by(block) {
                let mut sum = [0.0; 3];
                for c in 0..block * block * block {
                    let o = grid.index(i + c % block, j + c / block % block, k + c / (block * block));
                    if inside[o] == 0 {
                        continue 'next;
                    }
                    for a in 0..3 {
                        sum[a] += f64::from(parts[a][o]);
                    }
                }
                let world = |[x, y, z]: [f64; 3]| {
                    grid.affine().to_world(VoxelPoint([i as f64 + x, j as f64 + y, k as f64 + z])).0
                };
                let corners = || CUBE_CORNERS.map(|side| world(side.map(|s| middle + s * spread(block))));
                let mean = sum.map(|s| s / (block * block * block) as f64);
                if mean.iter().all(|v| v.is_finite()) {
                    out.push(Observation {
                        place: world([middle; 3]),
                        around: if block > 1 { corners().to_vec() } else { Vec::new() },
                        readings: Vec::new(),
                        displacement: mean,
                        sigma: 1.0,
                    });
                }
            }
        }
        out
    };
    let layers: Vec<usize> = (0..nz.saturating_sub(block - 1)).step_by(block).collect();
    let raw: Vec<_> = layers.into_par_iter().map(row).collect::<Vec<_>>().concat();
    (located(body, raw), block)
}

/// The kept matches that lie in the body, as means over their patches.
///
/// A match is sought in the deformed volume warped by the field, so it is the field at its place
/// and the mean over its patch of what the field is short of. With the field's mean over the patch
/// in place of the field at its place it is the mean of the displacement, which a model's mean is
/// compared with. Of a patch that reaches past the body only what lies in it counts.
pub fn from_matches(body: &Body, field: &Displacement<'_>, matches: &SparseField) -> Vec<Observation> {
    let grid = field.grid();
    let finest = grid.least_spacing();
    // Equally far apart, with the second moments of a patch's voxels.
    let apart = grid.spacing().map(|s| {
        let radius = ((SparseField::PATCH as f64 * finest / s).round() as usize).max(1);
        1.5f64.sqrt() * spread(2 * radius + 1)
    });
    let patch = |m: &Match| -> [[f64; 3]; PATCH_SAMPLES] {
        let middle = grid.affine().to_voxel(m.initial).0;
        std::array::from_fn(|n| {
            let at = [
                n % PATCH_SAMPLES_PER_AXIS,
                n / PATCH_SAMPLES_PER_AXIS % PATCH_SAMPLES_PER_AXIS,
                n / (PATCH_SAMPLES_PER_AXIS * PATCH_SAMPLES_PER_AXIS),
            ];
            let voxel = std::array::from_fn(|a| middle[a] + (at[a] as f64 - 1.0) * apart[a]);
            grid.affine().to_world(VoxelPoint(voxel)).0
        })
    };
    let kept: Vec<&Match> = matches.kept().collect();
    let places: Vec<[f64; 3]> = kept.iter().flat_map(|m| patch(m)).collect();
    let found = find(body, &places);
    let one = |((m, places), found): ((&&Match, &[[f64; 3]]), &[Option<Reading>])| {
        // The one in the middle is the match's own.
        let own = found[PATCH_SAMPLES / 2]?;
        let here = displacement(field, m.initial);
        let (mut around, mut readings, mut rest) = (Vec::new(), Vec::new(), [0.0; 3]);
        for (place, reading) in places.iter().zip(found).filter_map(|(p, f)| f.map(|f| (p, f))) {
            let there = displacement(field, WorldPoint(*place));
            let more: [f64; 3] = std::array::from_fn(|a| there[a] - here[a]);
            if more.iter().all(|v| v.is_finite()) {
                around.push(*place);
                readings.push(reading);
                (0..3).for_each(|a| rest[a] += more[a]);
            }
        }
        // Where the field has no number the match stands for its place alone.
        if around.is_empty() {
            readings.push(own);
        }
        let count = readings.len() as f64;
        Some(Observation {
            place: m.initial.0,
            around,
            readings: mean(&readings),
            displacement: std::array::from_fn(|a| m.displacement[a] + rest[a] / count),
            sigma: m.sigma().max(1e-4),
        })
    };
    let patches = kept.iter().zip(places.chunks_exact(PATCH_SAMPLES)).zip(found.chunks_exact(PATCH_SAMPLES));
    patches.filter_map(one).collect()
}

/// Reach (voxels) within which the motion at a place of the surface is read.
pub(crate) const SURFACE_REACH_VOXELS: f64 = 3.0;

/// The field and its standard error (mm, a component) at a place of the surface: an affine fit to
/// the voxels of the mask within `reach` voxels, so that nothing outside the body is read and noise
/// is averaged.
pub(crate) fn at_surface(field: &Displacement<'_>, mask: &Mask, p: [f64; 3], reach: f64) -> Option<([f64; 3], f64)> {
    let grid = field.grid();
    let (shape, at) = (grid.shape(), grid.affine().to_voxel(WorldPoint(p)).0);
    let range = |a: usize| {
        let low = (at[a] - reach).ceil().max(0.0) as usize;
        let high = ((at[a] + reach).floor() as i64).clamp(-1, shape[a] as i64 - 1) + 1;
        low..high.max(0) as usize
    };
    let mut normal = [[0.0; 4]; 4];
    let mut right = [[0.0; 4]; 3];
    let mut square = [0.0; 3];
    let (mut total, mut count) = (0.0, 0);
    for k in range(2) {
        for j in range(1) {
            for i in range(0) {
                let o = grid.index(i, j, k);
                let d = [i as f64 - at[0], j as f64 - at[1], k as f64 - at[2]];
                let r2 = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]) / (reach * reach);
                if mask.as_slice()[o] == 0 || r2 > 1.0 {
                    continue;
                }
                let w = (1.0 - r2).powi(2) + 1e-3;
                let row = [1.0, d[0], d[1], d[2]];
                total += w;
                count += 1;
                for a in 0..4 {
                    for b in 0..4 {
                        normal[a][b] += w * row[a] * row[b];
                    }
                }
                let u = field.at(o);
                for c in 0..3 {
                    square[c] += w * f64::from(u[c]).powi(2);
                    for a in 0..4 {
                        right[c][a] += w * row[a] * f64::from(u[c]);
                    }
                }
            }
        }
    }
    if count < 8 {
        return None;
    }
    let inverse = crate::numerics::dense::solve(&normal, &[1.0, 0.0, 0.0, 0.0])?;
    let mut out = [0.0; 3];
    let mut rest = 0.0;
    for c in 0..3 {
        let fit = crate::numerics::dense::solve(&normal, &right[c])?;
        out[c] = fit[0];
        rest += (square[c] - (0..4).map(|a| fit[a] * right[c][a]).sum::<f64>()).max(0.0) / total / 3.0;
    }
    out.iter().all(|v| v.is_finite()).then(|| (out, (rest * total * inverse[0]).max(0.0).sqrt()))
}
