//! Surfaces along which tissue glides: there the field jumps, and a smooth one smears the jump over several nodes.
//!
//! Where a field changes by more than 0.3 mm a mm the motion of one side, taken from a few nodes away along the direction of the
//! greatest change, may explain the volumes better than the field's own. A voxel takes it when the residual about it falls by a
//! tenth, and is believed when most of the strained voxels around it do so too. That is what tells a jump from a smooth field
//! that is merely steep: of the strained voxels 0.62 to 0.78 followed a side in heads and legs cut in two halves that glide, 0.04
//! to 0.05 where the truth was smooth and moved by 20 mm. Only voxels beside a jump are changed.

use crate::matching::gain::GainField;
use crate::matching::pair::{Pair, dilate};
use crate::numerics::bspline::Lattice;
use crate::numerics::simd::dispatch;
use crate::numerics::small::{Symmetric3, eigenvalues, principal};
use crate::numerics::{filters, pyramid};
use rayon::prelude::*;
use std::ops::Range;

/// Largest stretch of the displacement (mm per mm) up to which a field is left alone.
const STRAIN: f64 = 0.3;

/// How far away a side's motion is looked for (node spacings).
const AWAY: [f64; 5] = [1.0, 1.8, 2.6, 3.6, 4.6];

/// The same in the survey.
const SURVEYED: [f64; 2] = [1.8, 3.6];

/// Part of the residual's square that must be left at most.
const LEFT: f32 = 0.9;

/// Standard deviation of the window in which residuals are compared (smallest voxel edges). Heads and thighs in two halves: 2.7
/// voxels leave a fifth more error than 1, 2 a tenth more.
const WINDOW: f64 = 1.0;

/// Voxels to which it reaches.
const REACH: usize = 3;

/// Standard deviation of the window in which voxels that follow a side are counted (node spacings).
const AROUND: f64 = 3.0;

/// Share of the strained voxels around that must follow a side.
const MOST: f32 = 0.5;

/// The same in the survey, which is content with less: over all strained voxels it was 0.28 to 0.59 where tissue glided, more in places,
/// and under 0.02 elsewhere.
const SOME: f32 = 0.3;

/// Voxels of a slab, about: with what is needed around it 0.1 to 0.3 GB.
const SLAB: usize = 5_000_000;

/// Voxels that move with one side of a surface along which tissue glides.
#[derive(Debug, Clone, PartialEq)]
pub struct Sliding {
    /// Voxel of the pair's lattice, and how far from it (voxels) the field moves as this voxel does.
    pub voxels: Vec<(u32, [f32; 3])>,
    /// Voxels at which the field is steep.
    pub strained: usize,
    /// Part of the residual's square that is left in the voxels that follow a side.
    pub left: f64,
}

/// Looks for jumps that a spline field (mm along the axes, planar coefficients) has smeared; `None` where there are none.
///
/// The field's change is its displacement gradient's greatest singular value, the direction of it the right singular vector. A
/// survey of every second voxel along each axis tells where it is worth while to look at all of them. A large volume is gone
/// through in slabs, so that no more of the field is held than one of them needs; the result does not depend on them.
pub fn sliding(pair: &Pair<'_>, lattice: &Lattice, coefficients: &[f32]) -> Option<Sliding> {
    in_slabs(pair, lattice, coefficients, SLAB)
}

/// The same, with slabs of about so many voxels.
fn in_slabs(pair: &Pair<'_>, lattice: &Lattice, coefficients: &[f32], slab: usize) -> Option<Sliding> {
    let mut fields = Fields { pair, lattice, coefficients, slab, held: None };
    if !fields.is_steep() {
        return None;
    }
    // A warped volume and a slab of the field are never held at once.
    fields.held = None;
    let gain = GainField::measure(pair, &pair.warp(lattice, coefficients, &pair.spans));
    let sparse = fields.look(&gain, &SURVEYED, 2, &pair.mask, SOME)?;
    let mut worth = vec![0u8; pair.fixed.len()];
    for (at, _) in &sparse.voxels {
        worth[*at as usize] = 1;
    }
    drop(sparse);
    fields.look(&gain, &AWAY, 1, &dilate(&worth, pair.shape, 2 + REACH), MOST)
}

/// A field that is evaluated in slabs.
struct Fields<'a> {
    pair: &'a Pair<'a>,
    lattice: &'a Lattice,
    coefficients: &'a [f32],
    /// Voxels of a slab, about.
    slab: usize,
    /// The slab that was evaluated last.
    held: Option<Planes>,
}

/// Some planes of a dense field.
struct Planes {
    range: Range<usize>,
    /// Displacement (mm along the axes), planar.
    field: Vec<f32>,
}

/// A strained voxel that would move with a side: number, offset (voxels), and the squares of what is left before and after.
struct Follower {
    at: u32,
    offset: [f32; 3],
    squares: [f32; 2],
}

impl Fields<'_> {
    /// Planes of which a slab consists, every `every`th counted.
    fn thickness(&self, every: usize) -> usize {
        let [nx, ny, nz] = self.pair.shape;
        let most = nz.div_ceil(every);
        if nx * ny * nz <= self.slab { most } else { (self.slab / (nx * ny * every)).clamp(1, most) }
    }

    /// The field on planes `range` and maybe more.
    fn steepness(&mut self, range: Range<usize>) -> Steepness<'_> {
        let covers = |p: &Planes| p.range.start <= range.start && range.end <= p.range.end;
        let held = self.held.take().filter(covers);
        let Fields { pair, lattice, coefficients, .. } = *self;
        let evaluate = || Planes { field: lattice.evaluate_planes(coefficients, range.clone()), range: range.clone() };
        let planes = self.held.insert(held.unwrap_or_else(evaluate));
        Steepness { pair, planes }
    }

    /// Whether any of every second voxel along each axis is strained.
    fn is_steep(&mut self) -> bool {
        let pair = self.pair;
        let [nx, ny, nz] = pair.shape;
        let thick = self.thickness(1);
        (0..nz).step_by(thick).any(|k| {
            let end = (k + thick).min(nz);
            let steep = self.steepness(k.saturating_sub(1)..(end + 1).min(nz));
            let even = |at: usize| place(pair.shape, at).iter().all(|v| v % 2 == 0);
            let voxels = nx * ny * k..nx * ny * end;
            voxels.into_par_iter().any(|at| pair.mask[at] != 0 && even(at) && steep.is_over(at, STRAIN))
        })
    }

    /// Which voxels `within` move with a side, from every `every`th voxel along each axis.
    fn look(&mut self, gain: &GainField, away: &[f64], every: usize, within: &[u8], most: f32) -> Option<Sliding> {
        let Fields { pair, lattice, .. } = *self;
        let step = (0..3).map(|a| lattice.step[a] as f64 * pair.spacing[a]).fold(f64::INFINITY, f64::min);
        let finest = pyramid::finest(pair.shape, pair.spacing);
        let sparse = Sparse::new(pair, every);
        let spacing: [f64; 3] = std::array::from_fn(|a| pair.spacing[a] * sparse.every[a] as f64);
        let window: [f64; 3] = spacing.map(|s| WINDOW * finest / s);
        // Around a slab: what the window reaches, then what is strained near that, or as far as a side is looked for.
        let border = filters::gaussian_kernel(window[2]).len() - 1;
        let reach = REACH.div_ceil(sparse.every[0]);
        let furthest = away.iter().copied().fold(0.0, f64::max) * step / pair.spacing[2];
        let margin = (furthest.ceil() as usize + 2).max(reach * sparse.every[2] + 1);

        let plane = sparse.shape[0] * sparse.shape[1];
        let n = plane * sparse.shape[2];
        let mut marks = vec![0u8; n];
        let mut followers = Vec::new();
        let thick = self.thickness(sparse.every[2]);
        for from in (0..sparse.shape[2]).step_by(thick) {
            let own = from..(from + thick).min(sparse.shape[2]);
            let around = own.start.saturating_sub(border)..(own.end + border).min(sparse.shape[2]);
            let near = around.start.saturating_sub(reach)..(around.end + reach).min(sparse.shape[2]);
            let worth = |i: usize| pair.mask[sparse.full(i)] != 0 && within[sparse.full(i)] != 0;
            if !(near.start * plane..near.end * plane).into_par_iter().any(worth) {
                continue;
            }
            let planes = (around.start * sparse.every[2]).saturating_sub(margin)
                ..(around.end * sparse.every[2] + margin).min(pair.shape[2]);
            let steep = self.steepness(planes);
            let slab = Slab { sparse: &sparse, steep, gain, window };
            slab.follow(away, step, [own, around, near], worth, &mut marks, &mut followers);
        }
        // The whole field serves again; one slab of many only takes room.
        if thick < sparse.shape[2] {
            self.held = None;
        }
        believed(&sparse, &marks, &followers, spacing.map(|s| AROUND * step / s), most)
    }
}

/// Marks of [`Slab::follow`].
const STRAINED: u8 = 1;
const FOLLOWS: u8 = 2;

/// Voxels of a pair, some apart along each axis.
struct Sparse {
    every: [usize; 3],
    shape: [usize; 3],
    whole: [usize; 3],
}

impl Sparse {
    fn new(pair: &Pair<'_>, every: usize) -> Self {
        let every: [usize; 3] = pair.shape.map(|n| every.min(n));
        let shape = std::array::from_fn(|a| pair.shape[a].div_ceil(every[a]));
        Self { every, shape, whole: pair.shape }
    }

    /// The number of a voxel among all.
    #[inline(always)]
    fn full(&self, i: usize) -> usize {
        let Self { every, shape, whole } = self;
        let v = place(*shape, i);
        v[0] * every[0] + whole[0] * (v[1] * every[1] + whole[1] * v[2] * every[2])
    }
}

/// Some planes of voxels, and the field around them.
struct Slab<'a> {
    sparse: &'a Sparse,
    steep: Steepness<'a>,
    gain: &'a GainField,
    /// Standard deviation of the window in which residuals are compared (voxels).
    window: [f64; 3],
}

impl Slab<'_> {
    /// Which strained voxels of the planes `own` would follow a side. Residuals are needed on those `around`, strain on those `near`.
    fn follow(
        &self,
        away: &[f64],
        step: f64,
        [own, around, near]: [Range<usize>; 3],
        worth: impl Fn(usize) -> bool + Sync,
        marks: &mut [u8],
        followers: &mut Vec<Follower>,
    ) {
        let Self { sparse, steep, window, .. } = self;
        let pair = steep.pair;
        let plane = sparse.shape[0] * sparse.shape[1];
        let shape = |planes: &Range<usize>| [sparse.shape[0], sparse.shape[1], planes.len()];
        let full = |i: usize| sparse.full(i);
        let strained: Vec<u8> = (near.start * plane..near.end * plane)
            .into_par_iter()
            .map(|i| u8::from(worth(i) && steep.is_over(full(i), STRAIN)))
            .collect();
        let close = dilate(&strained, shape(&near), REACH.div_ceil(sparse.every[0]));
        let first = near.start * plane;
        let seen: Vec<(u32, [f32; 3])> = (around.start * plane..around.end * plane)
            .into_par_iter()
            .filter(|&i| close[i - first] != 0 && worth(i))
            .map(|i| (i as u32, steep.direction(full(i))))
            .collect();
        drop(close);

        // The square of what is left under the field and under each side's motion.
        let start = around.start * plane;
        let smooth = |values: &[f32]| -> Vec<f32> {
            let mut volume = vec![0.0; plane * around.len()];
            for ((at, _), v) in seen.iter().zip(values) {
                volume[*at as usize - start] = *v;
            }
            let volume = filters::gaussian(&volume, shape(&around), *window);
            seen.iter().map(|(at, _)| volume[*at as usize - start]).collect()
        };
        let gains = self.gains(&seen);
        let squares = |away: Option<f64>| -> Vec<f32> {
            let mut out = vec![0.0; seen.len()];
            out.par_chunks_mut(512).zip(seen.par_chunks(512)).zip(gains.par_chunks(512)).for_each(
                |((out, seen), gains)| {
                    dispatch(
                        #[inline(always)]
                        || {
                            for ((out, &(i, direction)), gain) in out.iter_mut().zip(seen).zip(gains) {
                                let at = full(i as usize);
                                let offset = away.map_or([0.0; 3], |away| offset(pair, direction, away));
                                *out = steep.square(at, offset, *gain);
                            }
                        },
                    );
                },
            );
            out
        };
        let mut still = squares(None);
        still.iter_mut().filter(|v| !v.is_finite()).for_each(|v| *v = 0.0);
        let base = smooth(&still);
        let mut best: Vec<f32> = base.iter().map(|b| LEFT * b).collect();
        let mut taken = vec![0.0f32; seen.len()];
        for away in away.iter().flat_map(|a| [-a * step, a * step]) {
            let mut other = squares(Some(away));
            other.iter_mut().zip(&still).filter(|(v, _)| !v.is_finite()).for_each(|(v, still)| *v = *still);
            let cost = smooth(&other);
            for (k, (i, _)) in seen.iter().enumerate() {
                if strained[*i as usize - first] != 0 && cost[k] < best[k] {
                    (best[k], taken[k]) = (cost[k], away as f32);
                }
            }
        }
        for (k, &(i, direction)) in seen.iter().enumerate() {
            let at = i as usize;
            if !(own.start * plane..own.end * plane).contains(&at) || strained[at - first] == 0 {
                continue;
            }
            let follows = taken[k] != 0.0;
            marks[at] = if follows { STRAINED | FOLLOWS } else { STRAINED };
            // The survey counts all that are strained.
            if follows || sparse.every[0] > 1 {
                let offset = offset(pair, direction, f64::from(taken[k]));
                followers.push(Follower { at: i, offset, squares: [base[k], best[k]] });
            }
        }
    }

    /// Gain and offset at voxels, which ascend.
    fn gains(&self, seen: &[(u32, [f32; 3])]) -> Vec<[f32; 2]> {
        let [nx, ny, _] = self.steep.pair.shape;
        let mut out = vec![[0.0; 2]; seen.len()];
        let room = || (usize::MAX, vec![0.0; nx], vec![0.0; nx]);
        out.par_chunks_mut(512).zip(seen.par_chunks(512)).for_each_init(room, |(held, gain, offset), (out, seen)| {
            for (out, (i, _)) in out.iter_mut().zip(seen) {
                let at = self.sparse.full(*i as usize);
                if at / nx != *held {
                    *held = at / nx;
                    self.gain.row(*held % ny, *held / ny, gain, offset);
                }
                *out = [gain[at % nx], offset[at % nx]];
            }
        });
        out
    }
}

/// Those that most of the strained voxels around agree with; `wide` is the standard deviation of "around" (voxels), for which
/// blocks of two voxels are fine enough.
fn believed(sparse: &Sparse, marks: &[u8], followers: &[Follower], wide: [f64; 3], most: f32) -> Option<Sliding> {
    let side = sparse.shape.map(|n| n.min(2));
    let shape = pyramid::reduced_shape(sparse.shape, side);
    let wide = std::array::from_fn(|a| wide[a] / side[a] as f64);
    let around = |mark: u8| -> Vec<f32> {
        let share = filters::gaussian(&pyramid::share(marks, sparse.shape, side, |m| m & mark != 0), shape, wide);
        let block = |f: &Follower| {
            let v = place(sparse.shape, f.at as usize);
            v[0] / side[0] + shape[0] * (v[1] / side[1] + shape[1] * (v[2] / side[2]))
        };
        followers.iter().map(|f| share[block(f)]).collect()
    };
    let (followed, all) = (around(FOLLOWS), around(STRAINED));
    let (mut before, mut after) = (0.0, 0.0);
    let mut voxels = Vec::new();
    for ((f, followed), all) in followers.iter().zip(followed).zip(all) {
        if followed > most * all {
            voxels.push((sparse.full(f.at as usize) as u32, f.offset));
            (before, after) = (before + f64::from(f.squares[0]), after + f64::from(f.squares[1]));
        }
    }
    let strained = marks.iter().filter(|m| **m & STRAINED != 0).count();
    (!voxels.is_empty()).then(|| Sliding { voxels, strained, left: after / before.max(f64::MIN_POSITIVE) })
}

/// The place of a voxel by its number, x fastest.
#[inline(always)]
fn place([nx, ny, _]: [usize; 3], at: usize) -> [usize; 3] {
    [at % nx, at / nx % ny, at / (nx * ny)]
}

/// `away` mm along a direction, in voxels.
fn offset(pair: &Pair<'_>, direction: [f32; 3], away: f64) -> [f32; 3] {
    std::array::from_fn(|a| (f64::from(direction[a]) * away / pair.spacing[a]) as f32)
}

/// Some planes of a dense field and its gradient.
struct Steepness<'a> {
    pair: &'a Pair<'a>,
    planes: &'a Planes,
}

impl Steepness<'_> {
    /// `gradient[c][a]`: change of component `c` per mm along axis `a`.
    fn gradient(&self, at: usize) -> [[f64; 3]; 3] {
        let Pair { shape, spacing, .. } = self.pair;
        let v = place(self.pair.shape, at);
        let stride = [1, shape[0], shape[0] * shape[1]];
        let at = at - self.planes.range.start * stride[2];
        std::array::from_fn(|c| {
            let u = self.component(c);
            std::array::from_fn(|a| {
                let [low, high] = [v[a].min(1), (shape[a] - 1 - v[a]).min(1)];
                let steps = (low + high).max(1) as f64 * spacing[a];
                f64::from(u[at + high * stride[a]] - u[at - low * stride[a]]) / steps
            })
        })
    }

    /// `G^T G` of the gradient.
    fn squares(&self, at: usize) -> Symmetric3 {
        let g = self.gradient(at);
        [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)].map(|(a, b)| (0..3).map(|c| g[c][a] * g[c][b]).sum())
    }

    /// Whether the greatest singular value exceeds `strain`.
    fn is_over(&self, at: usize, strain: f64) -> bool {
        let s = self.squares(at);
        // The trace bounds the greatest eigenvalue.
        s[0] + s[1] + s[2] > strain * strain && eigenvalues(&s)[0] > strain * strain
    }

    /// Unit vector along which the field changes most.
    fn direction(&self, at: usize) -> [f32; 3] {
        principal(&self.squares(at)).map(|v| v as f32)
    }

    /// One component of the field on the planes that are held.
    #[inline(always)]
    fn component(&self, c: usize) -> &[f32] {
        let n = self.planes.field.len() / 3;
        &self.planes.field[c * n..(c + 1) * n]
    }

    /// The field at a voxel and an offset (voxels), trilinear, the border's value beyond it.
    #[inline(always)]
    fn sample(&self, voxel: [usize; 3], offset: [f32; 3]) -> [f32; 3] {
        let shape = self.pair.shape;
        let mut low = [0; 3];
        let mut t = [0.0; 3];
        let mut next = [0; 3];
        let stride = [1, shape[0], shape[0] * shape[1]];
        for a in 0..3 {
            let p = (voxel[a] as f32 + offset[a]).clamp(0.0, (shape[a] - 1) as f32);
            low[a] = p as usize;
            t[a] = p - low[a] as f32;
            next[a] = if low[a] + 1 < shape[a] { stride[a] } else { 0 };
        }
        let base = low[0] + stride[1] * low[1] + stride[2] * (low[2] - self.planes.range.start);
        std::array::from_fn(|c| {
            let u = self.component(c);
            let line = |o: usize| u[base + o] + t[0] * (u[base + o + next[0]] - u[base + o]);
            let face = |o: usize| line(o) + t[1] * (line(o + next[1]) - line(o));
            face(0) + t[2] * (face(next[2]) - face(0))
        })
    }

    /// The square of what is left between the volumes at a voxel that moves as the field does at an offset (voxels) from it; NaN
    /// where the deformed volume was not seen.
    #[inline(always)]
    fn square(&self, at: usize, offset: [f32; 3], [gain, base]: [f32; 2]) -> f32 {
        let pair = self.pair;
        let voxel = place(pair.shape, at);
        let moved = self.sample(voxel, offset);
        let target = std::array::from_fn(|a| voxel[a] as f64 + f64::from(moved[a]) / pair.spacing[a]);
        let seen = pair.sampler().at(pair.to_moving(target));
        (pair.fixed_smooth[at] - (gain * seen + base)).powi(2)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::matching::levels::Aligned;
    use crate::types::{Affine, Grid, Mask, Volume};

    #[test]
    fn slabs_leave_the_result_as_it_is() {
        let shape = [36, 40, 44];
        let grid = Grid::new(shape, Affine::scaled([1.0; 3], [0.0; 3]).expect("a scale")).expect("a grid");
        let noise = |i: usize| (i as u32).wrapping_mul(2_654_435_761).rotate_left(13).wrapping_mul(2_246_822_519) >> 8;
        let raw: Vec<f32> = (0..grid.len()).map(|i| noise(i) as f32 / 1e5).collect();
        let texture = filters::gaussian(&raw, shape, [1.2; 3]);
        let above = |k: usize| k > 21;
        let moved: Vec<f32> = (0..grid.len())
            .map(|at| {
                let [i, j, k] = grid.voxel(at);
                let i = if above(k) { (i + shape[0] - 3) % shape[0] } else { (i + 3) % shape[0] };
                texture[grid.index(i, j, k)]
            })
            .collect();
        let [initial, deformed] = [texture, moved].map(|v| Volume::from_vec(grid, v).expect("of that size"));
        let mask = Mask::filled(grid, 1);
        let aligned = Aligned::new(&initial, &deformed, &mask, 5.0).expect("one place");
        let pair = aligned.level([1; 3]);
        let lattice = Lattice::new(shape, [4; 3]);
        let smeared = lattice.fit(|p| [3.0 * ((p[2] - 21.5) / 4.0).tanh(), 0.0, 0.0]);
        let whole = in_slabs(&pair, &lattice, &smeared, usize::MAX).expect("halves glide");
        assert!(whole.voxels.len() > 2000 && whole.left < 0.5, "{} {}", whole.voxels.len(), whole.left);
        for slab in [1, 3 * 36 * 40, 10 * 36 * 40] {
            assert_eq!(in_slabs(&pair, &lattice, &smeared, slab).as_ref(), Some(&whole), "{slab}");
        }
    }
}
