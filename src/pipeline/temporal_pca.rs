//! What the frames of a sequence say together: the few temporal modes that their motion is made
//! of.
//!
//! Each frame's field has its own noise, and all of them have that of the reference. Motion has far
//! fewer courses than there are frames: in displacements u_t(x) = sum_k (a_k(t) - a_k(0)) m_k(x) a
//! frame's noise is that of the few numbers a_k(t), and the reference's differs from motion as
//! well, for it is one frame among the others, whose displacement is known to be 0. The courses are
//! the principal components of the coefficients of all frames' splines (Jolliffe, Principal
//! Component Analysis, 2002), each coefficient in units of its noise; as few are taken as leave
//! what is noise: without a course of its own, white in time, and no more than a frame alone is
//! uncertain by. Where a block's leftover is more than that in some frame, that frame keeps its own
//! field there.

use crate::field::spline::{FieldSpline, ScalarSpline, Spline};
use crate::numerics::bspline::Lattice;
use crate::numerics::dense::dot;
use crate::numerics::eigen::symmetric;
use crate::numerics::statistics::median;
use crate::types::VoxelPoint;
use rayon::prelude::*;
use std::borrow::Cow;

/// Fewest frames beside the reference: with fewer, a temporal mode has as many numbers as the
/// frames.
const MIN_FRAMES: usize = 5;

/// Variance of a mode over the mean of those after it, from which it counts: noise alone reaches 3
/// (5 of 24 consecutive frames).
const MIN_MODE_VARIANCE_RATIO: f64 = 4.0;

/// What a number of modes may leave; beyond, another mode is taken.
struct ResidualLimits {
    /// Least change of the residual between frames over that of white noise (1): motion changes
    /// less.
    min_whiteness: f64,
    /// Largest residual in the frames' stated variances, which include smoothing: noise has 0.01 to
    /// 0.05.
    max_level: f64,
    /// Largest part of the nodes that keep their own field.
    max_own_fraction: f64,
}

const RESIDUAL_LIMITS: ResidualLimits = ResidualLimits { min_whiteness: 0.75, max_level: 0.08, max_own_fraction: 0.12 };

/// Where a block of two nodes along each axis keeps a frame's own field.
struct OwnField {
    /// Residual of the frame over the noise there, beyond which the frame keeps it.
    frame_ratio: f32,
    /// Mean residual over the median of all blocks, beyond which all frames keep it.
    block_ratio: f32,
}

const OWN_FIELD: OwnField = OwnField { frame_ratio: 4.0, block_ratio: 6.0 };

/// Least noise variance of a coefficient over the mean one.
const MIN_COEFFICIENT_VARIANCE: f64 = 0.1;

/// A measured frame.
pub(super) struct Frame<'a> {
    pub number: usize,
    pub field: &'a FieldSpline,
    /// One standard deviation (mm).
    pub uncertainty: &'a ScalarSpline,
}

/// The courses that were found.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Modes {
    /// How many there are.
    pub count: usize,
    /// Why this number, in words.
    pub why: String,
    lattice: Lattice,
    /// What is to be taken from each frame's coefficients, on `lattice`.
    corrections: Vec<Vec<f32>>,
}

impl Modes {
    /// Of `frames`, measured against frame `origin`; `counts` says of a voxel of the fields' own
    /// grid whether it is tissue. Else why there are none, in words.
    pub fn find(frames: &[Frame<'_>], origin: usize, counts: impl Fn([usize; 3]) -> bool) -> Result<Self, String> {
        if frames.len() < MIN_FRAMES {
            return Err(format!(
                "each frame by itself: {MIN_FRAMES} beside the reference are needed to tell courses from noise"
            ));
        }
        let fields: Option<Vec<&Spline>> = frames.iter().map(|f| f.field.only()).collect();
        let fields = fields.ok_or("each frame by itself: bodies slide along each other in one of them at least")?;
        let lattice = &fields[0].0;
        // In the order of time, the reference among them.
        let mut order: Vec<usize> = (0..frames.len()).collect();
        order.sort_by_key(|&f| frames[f].number);
        let before = order.iter().filter(|&&f| frames[f].number < origin).count();
        let still = Cow::Owned(vec![0.0; 3 * lattice.len()]);
        let mut rows: Vec<Cow<'_, [f32]>> =
            order.iter().map(|&f| carried(&fields[f].0, &fields[f].1, lattice)).collect();
        rows.insert(before, still);
        let nodes: Vec<usize> =
            (0..lattice.len()).filter(|&m| counts(lattice.within(m).0.map(|v| v.round() as usize))).collect();
        let stated: Vec<f64> = nodes
            .par_iter()
            .map(|&m| {
                let at = |f: &Frame<'_>| f64::from(f.uncertainty.at_place(lattice.within(m))).powi(2);
                frames.iter().map(at).sum::<f64>() / frames.len() as f64
            })
            .collect();
        let data = Data::new(&rows, lattice, nodes, stated).ok_or("each frame by itself: there is no motion")?;
        let most = frames.len() / 2;
        let first = data.standing_out(most);
        let mut last = None;
        for count in first..=most {
            let tried = data.left_by(count);
            if tried.is_noise() {
                return Ok(data.modes(count, &tried, lattice, &order, before, &rows));
            }
            last = Some(tried);
        }
        let said = last.map_or_else(String::new, |t| t.said());
        Err(format!("each frame by itself: beyond {most} temporal modes more than noise is left ({said})"))
    }

    /// The field of frame `at` of those that were given, by all of them.
    pub fn apply(&self, at: usize, field: &mut FieldSpline) {
        let Some((lattice, coefficients)) = field.only_mut() else { return };
        let taken = carried(&self.lattice, &self.corrections[at], lattice);
        coefficients.iter_mut().zip(taken.iter()).for_each(|(c, t)| *c -= t);
    }
}

/// Coefficients on another lattice over the same grid.
fn carried<'a>(from: &Lattice, coefficients: &'a [f32], to: &Lattice) -> Cow<'a, [f32]> {
    if from == to {
        return Cow::Borrowed(coefficients);
    }
    let inside = |VoxelPoint(p)| VoxelPoint(std::array::from_fn(|a| p[a].clamp(0.0, (from.shape[a] - 1) as f64)));
    Cow::Owned(to.fit(|p| from.at(coefficients, inside(p))))
}

/// Coefficients of the tissue's nodes, less their mean over the frames, in units of their noise.
struct Data {
    /// Of the frame `t` all that count one after the other: node by node, three components each.
    whitened: Vec<Vec<f32>>,
    /// Noise of each of them (mm).
    noise: Vec<f32>,
    /// Variances stated at each node (mm^2).
    stated: Vec<f64>,
    /// Which nodes of the lattice these are, and how many it has along each axis.
    nodes: Vec<usize>,
    sides: [usize; 3],
    gram: Vec<Vec<f64>>,
    /// Variance and course, largest first.
    courses: Vec<(f64, Vec<f64>)>,
}

/// What a number of courses leaves.
struct Left {
    /// I - the mean - the courses, among frames.
    out: Vec<Vec<f64>>,
    /// Change from frame to frame over that of white noise.
    white: f64,
    /// Median over blocks of the variance left over the stated one.
    level: f64,
    /// Whether a frame (first) keeps its own field at a node of the lattice (second).
    own: Vec<Vec<bool>>,
    kept: f64,
}

impl Left {
    fn is_noise(&self) -> bool {
        self.white >= RESIDUAL_LIMITS.min_whiteness
            && self.level <= RESIDUAL_LIMITS.max_level
            && self.kept <= RESIDUAL_LIMITS.max_own_fraction
    }

    fn said(&self) -> String {
        format!(
            "what is left changes from frame to frame by {:.2} of what white noise does, has {:.2} of the stated variance, and is more than \
             noise in {:.1} % of the nodes, which keep their own",
            self.white,
            self.level,
            100.0 * self.kept
        )
    }
}

impl Data {
    fn new(rows: &[Cow<'_, [f32]>], lattice: &Lattice, nodes: Vec<usize>, stated: Vec<f64>) -> Option<Self> {
        let (n, all) = (rows.len(), lattice.len());
        let mut whitened: Vec<Vec<f32>> =
            rows.iter().map(|row| nodes.iter().flat_map(|&m| [0, 1, 2].map(|c| row[c * all + m])).collect()).collect();
        let mut mean = vec![0.0f32; 3 * nodes.len()];
        for row in &whitened {
            mean.iter_mut().zip(row).for_each(|(m, v)| *m += v / n as f32);
        }
        whitened.iter_mut().for_each(|row| row.iter_mut().zip(&mean).for_each(|(v, m)| *v -= m));
        // Noise by place, from the lesser half of the courses.
        let gram = gram(&whitened);
        let courses = symmetric(n, |i, j| gram[i][j])?;
        let lesser = &courses[n / 2..n - 1];
        let mut variance = vec![0.0f32; 3 * all];
        let mut there = vec![0.0f32; all];
        for (at, &m) in nodes.iter().enumerate() {
            there[m] = 1.0;
            for c in 0..3 {
                let part = |v: &[f64]| (0..n).map(|t| v[t] * f64::from(whitened[t][3 * at + c])).sum::<f64>().powi(2);
                let sum: f64 = lesser.iter().map(|(_, v)| part(v)).sum();
                variance[c * all + m] = (sum / lesser.len() as f64) as f32;
            }
        }
        for part in variance.chunks_exact_mut(all).chain([&mut there[..]]) {
            spread(part, lattice.nodes);
        }
        let mut noise: Vec<f32> =
            nodes.iter().flat_map(|&m| [0, 1, 2].map(|c| variance[c * all + m] / there[m])).collect();
        let least =
            MIN_COEFFICIENT_VARIANCE * noise.iter().map(|&v| f64::from(v)).sum::<f64>() / noise.len().max(1) as f64;
        if !(least > 0.0 && least.is_finite()) {
            return None;
        }
        noise.iter_mut().for_each(|v| *v = f64::from(*v).max(least).sqrt() as f32);
        whitened.iter_mut().for_each(|row| row.iter_mut().zip(&noise).for_each(|(v, s)| *v /= s));
        let gram = self::gram(&whitened);
        let courses = symmetric(n, |i, j| gram[i][j])?;
        Some(Self { whitened, noise, stated, nodes, sides: lattice.nodes, gram, courses })
    }

    /// The courses up to the last one that stands out of those after it.
    fn standing_out(&self, most: usize) -> usize {
        let n = self.courses.len() - 1;
        let after = |k: usize| self.courses[k..n].iter().map(|c| c.0).sum::<f64>() / (n - k) as f64;
        (1..=most).rev().find(|&k| self.courses[k - 1].0 > MIN_MODE_VARIANCE_RATIO * after(k)).unwrap_or(0)
    }

    fn left_by(&self, count: usize) -> Left {
        let n = self.gram.len();
        let out: Vec<Vec<f64>> = (0..n)
            .map(|i| {
                let taken = |j: usize| self.courses[..count].iter().map(|(_, v)| v[i] * v[j]).sum::<f64>();
                (0..n).map(|j| f64::from(u8::from(i == j)) - 1.0 / n as f64 - taken(j)).collect()
            })
            .collect();
        let product = |a: &[f64]| -> Vec<f64> { self.gram.iter().map(|row| dot(row, a)).collect() };
        let (mut changed, mut expected, mut energy) = (0.0, 0.0, 0.0);
        for t in 0..n {
            energy += dot(&out[t], &product(&out[t]));
        }
        let free = (n - 1 - count) as f64;
        for t in 1..n {
            let change: Vec<f64> = out[t].iter().zip(&out[t - 1]).map(|(a, b)| a - b).collect();
            changed += dot(&change, &product(&change));
            expected += energy / free * dot(&change, &change);
        }
        // What is left of each frame about each node, in variances stated there.
        let all: usize = self.sides.iter().product();
        let mut there = vec![0.0f32; all];
        self.nodes.iter().for_each(|&m| there[m] = 1.0);
        let nodes = there.clone();
        block_sums(&mut there, self.sides);
        let by_frame: Vec<Vec<f32>> = (0..n)
            .into_par_iter()
            .map(|t| {
                let mut squares = vec![0.0f32; all];
                for (at, &m) in self.nodes.iter().enumerate() {
                    let part = |c: usize| {
                        let left: f64 = (0..n).map(|s| out[t][s] * f64::from(self.whitened[s][3 * at + c])).sum();
                        (left * f64::from(self.noise[3 * at + c])).powi(2)
                    };
                    let free = 3.0 * self.stated[at] * out[t][t].max(1e-3);
                    squares[m] = ([0, 1, 2].map(part).iter().sum::<f64>() / free) as f32;
                }
                block_sums(&mut squares, self.sides);
                squares.iter_mut().zip(&there).for_each(|(s, n)| *s /= n.max(1.0));
                squares
            })
            .collect();
        let mean: Vec<f32> = (0..all).map(|m| by_frame.iter().map(|f| f[m]).sum::<f32>() / n as f32).collect();
        let blocks = || (0..all).filter(|&m| there[m] > 0.0);
        let level = median(&mut blocks().map(|m| mean[m]).collect::<Vec<_>>());
        let keeps = |t: usize| -> Vec<bool> {
            let mut own = vec![false; all];
            for m in blocks() {
                let others = (mean[m] * n as f32 - by_frame[t][m]) / (n - 1) as f32;
                if mean[m] > OWN_FIELD.block_ratio * level || by_frame[t][m] > OWN_FIELD.frame_ratio * others.max(level)
                {
                    block(m, self.sides).filter(|&at| nodes[at] > 0.0).for_each(|at| own[at] = true);
                }
            }
            own
        };
        let own: Vec<Vec<bool>> = (0..n).into_par_iter().map(keeps).collect();
        let kept = own.iter().flatten().filter(|k| **k).count() as f64 / (n * self.nodes.len()).max(1) as f64;
        let level = f64::from(level);
        Left { out, white: if expected > 0.0 { changed / expected } else { 1.0 }, level, own, kept }
    }

    fn modes(
        &self,
        count: usize,
        left: &Left,
        lattice: &Lattice,
        order: &[usize],
        origin: usize,
        rows: &[Cow<'_, [f32]>],
    ) -> Modes {
        let all = lattice.len();
        // What is noise in the coefficients of a frame.
        let noise = |t: usize| -> Vec<f32> {
            let mut sum = vec![0.0f32; 3 * all];
            for (row, &w) in rows.iter().zip(&left.out[t]) {
                sum.iter_mut().zip(row.iter()).for_each(|(s, v)| *s += w as f32 * v);
            }
            for m in (0..all).filter(|&m| left.own[t][m]) {
                (0..3).for_each(|c| sum[c * all + m] = 0.0);
            }
            sum
        };
        let of_reference = noise(origin);
        let mut corrections = vec![Vec::new(); order.len()];
        let others = (0..rows.len()).filter(|&t| t != origin);
        for (t, &frame) in others.zip(order) {
            let mut taken = noise(t);
            taken.iter_mut().zip(&of_reference).for_each(|(t, r)| *t -= r);
            corrections[frame] = taken;
        }
        let total: f64 = self.courses.iter().map(|c| c.0).sum();
        let part = self.courses[..count].iter().map(|c| c.0).sum::<f64>() / total;
        let courses = if count == 1 { "course" } else { "courses" };
        let why = format!(
            "{count} {courses} over time explain {:.1} % of what {} frames moved, in units of its noise: {}",
            100.0 * part,
            order.len(),
            left.said()
        );
        Modes { count, why, lattice: lattice.clone(), corrections }
    }
}

/// Products of all rows with each other.
fn gram(rows: &[Vec<f32>]) -> Vec<Vec<f64>> {
    let product = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>();
    let n = rows.len();
    let lower: Vec<Vec<f64>> =
        rows.par_iter().enumerate().map(|(i, a)| rows[..=i].iter().map(|b| product(a, b)).collect()).collect();
    (0..n).map(|i| (0..n).map(|j| lower[i.max(j)][i.min(j)]).collect()).collect()
}

/// Sums over each node and the ones beside it.
fn spread(values: &mut [f32], nodes: [usize; 3]) {
    for (a, stride) in [1, nodes[0], nodes[0] * nodes[1]].into_iter().enumerate() {
        let before = values.to_vec();
        for (m, v) in values.iter_mut().enumerate() {
            let at = m / stride % nodes[a];
            *v += if at > 0 { before[m - stride] } else { 0.0 };
            *v += if at + 1 < nodes[a] { before[m + stride] } else { 0.0 };
        }
    }
}

/// The nodes of the block of two along each axis that begins at one.
fn block(m: usize, nodes: [usize; 3]) -> impl Iterator<Item = usize> {
    let stride = [1, nodes[0], nodes[0] * nodes[1]];
    let ends = (0..3).map(move |a| m / stride[a] % nodes[a] + 1 < nodes[a]).collect::<Vec<_>>();
    (0..8usize)
        .filter(move |corner| (0..3).all(|a| corner >> a & 1 == 0 || ends[a]))
        .map(move |corner| m + (0..3).map(|a| (corner >> a & 1) * stride[a]).sum::<usize>())
}

/// Puts the sum over the block that begins at each node in its place.
fn block_sums(values: &mut [f32], nodes: [usize; 3]) {
    for (a, stride) in [1, nodes[0], nodes[0] * nodes[1]].into_iter().enumerate() {
        for m in 0..values.len() {
            if m / stride % nodes[a] + 1 < nodes[a] {
                values[m] += values[m + stride];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::numerics::random::Random;
    use crate::types::{Affine, Grid};

    const NOISE: f64 = 0.02;

    fn lattice() -> Lattice {
        Lattice::new([40, 36, 32], [4; 3])
    }

    fn coefficients(field: &FieldSpline) -> &[f32] {
        &field.only().unwrap().1
    }

    fn field(coefficients: Vec<f32>) -> FieldSpline {
        let grid = Grid::new([40, 36, 32], Affine::scaled([1.0; 3], [0.0; 3]).unwrap()).unwrap();
        FieldSpline::new(grid, vec![(lattice(), coefficients)], Vec::new(), Vec::new())
    }

    fn white(random: &mut Random) -> Vec<f64> {
        (0..3 * lattice().len()).map(|_| random.normals()[0]).collect()
    }

    /// True coefficients of frames 0 to `frames`, that of frame 0 all 0, and measured ones of the
    /// others, with noise of their own and frame 0's.
    fn measured(frames: usize, truth: impl Fn(usize) -> Vec<f64>, seed: u64) -> (Vec<Vec<f64>>, Vec<FieldSpline>) {
        let mut random = Random::new(seed, 1);
        let noise: Vec<Vec<f64>> = (0..=frames).map(|_| white(&mut random)).collect();
        let truth: Vec<Vec<f64>> = (0..=frames).map(truth).collect();
        let seen = |t: usize| {
            let each = truth[t].iter().zip(&noise[t]).zip(&noise[0]);
            field(each.map(|((u, e), r)| (u + NOISE * (e - r)) as f32).collect())
        };
        let fields = (1..=frames).map(seen).collect();
        (truth, fields)
    }

    fn find(fields: &[FieldSpline]) -> Result<Modes, String> {
        let sigma = ScalarSpline::new(
            Grid::new([40, 36, 32], Affine::scaled([1.0; 3], [0.0; 3]).unwrap()).unwrap(),
            lattice(),
            vec![0.15; lattice().len()],
        );
        let frames: Vec<Frame<'_>> =
            fields.iter().enumerate().map(|(t, field)| Frame { number: t + 1, field, uncertainty: &sigma }).collect();
        Modes::find(&frames, 0, |_| true)
    }

    /// Two courses over 12 frames.
    fn two(t: usize) -> Vec<f64> {
        let mut random = Random::new(5, 2);
        let [a, b] = [white(&mut random), white(&mut random)];
        let s = t as f64 / 12.0;
        a.iter().zip(&b).map(|(a, b)| 0.5 * a * s + 0.3 * b * (3.0 * s).sin()).collect()
    }

    /// What is left of white noise is that of the fit of the true courses: for frame t s^2 (P_tt +
    /// P_00 - 2 P_t0), P the projector on them and on what is common to all frames.
    #[test]
    fn the_noise_of_two_courses_is_as_least_squares_have_it() {
        let (truth, fields) = measured(12, two, 7);
        let modes = find(&fields).unwrap();
        assert_eq!(modes.count, 2, "{}", modes.why);
        let course = |f: &dyn Fn(f64) -> f64| -> Vec<f64> { (0..=12).map(|t| f(f64::from(t) / 12.0)).collect() };
        let mut basis: Vec<Vec<f64>> = Vec::new();
        for mut v in [course(&|_| 1.0), course(&|s| s), course(&|s| (3.0 * s).sin())] {
            for b in &basis {
                let d = dot(&v, b);
                v.iter_mut().zip(b).for_each(|(v, b)| *v -= d * b);
            }
            let size = dot(&v, &v).sqrt();
            basis.push(v.iter().map(|v| v / size).collect());
        }
        let p = |i: usize, j: usize| basis.iter().map(|b| b[i] * b[j]).sum::<f64>();
        for t in 1..=12 {
            let mut after = fields[t - 1].clone();
            modes.apply(t - 1, &mut after);
            let error = |f: &FieldSpline| {
                let squares = coefficients(f).iter().zip(&truth[t]).map(|(c, u)| (f64::from(*c) - u).powi(2));
                squares.sum::<f64>() / truth[t].len() as f64
            };
            let expected = NOISE * NOISE * (p(t, t) + p(0, 0) - 2.0 * p(t, 0));
            assert!((error(&after) / expected - 1.0).abs() < 0.12, "{t}: {} for {expected}", error(&after));
            assert!(error(&fields[t - 1]) > 1.5 * error(&after), "{t}");
        }
    }

    #[test]
    fn frames_of_their_own_are_left_as_they_are() {
        let own = |t: usize| -> Vec<f64> {
            let mut random = Random::new(11 + t as u64, 3);
            white(&mut random).iter().map(|v| if t == 0 { 0.0 } else { 0.3 * v }).collect()
        };
        assert!(find(&measured(12, own, 8).1).is_err());
        // Too few to tell; nothing at all.
        assert!(find(&measured(4, two, 8).1).is_err());
        assert!(find(&vec![field(vec![0.0; 3 * lattice().len()]); 8]).is_err());
    }

    /// A block of 8 voxels that moves by five times the noise in one frame alone is no course of
    /// the whole.
    #[test]
    fn what_one_place_does_in_one_frame_stays() {
        let there = |m: usize| lattice().place(m).0.iter().all(|p| (8.0..16.0).contains(p));
        let twitch = |t: usize| {
            let all = lattice().len();
            let part = |at: usize| if t == 6 && there(at % all) { 0.1 } else { 0.0 };
            two(t).iter().enumerate().map(|(at, u)| u + part(at)).collect()
        };
        let (_, fields) = measured(12, twitch, 9);
        let modes = find(&fields).unwrap();
        assert_eq!(modes.count, 2, "{}", modes.why);
        let mean = |f: &FieldSpline| {
            let all = lattice().len();
            let of: Vec<f64> = (0..3 * all)
                .filter(|at| there(at % all))
                .map(|at| f64::from(coefficients(f)[at]) - two(6)[at])
                .collect();
            of.iter().sum::<f64>() / of.len() as f64
        };
        let mut after = fields[5].clone();
        modes.apply(5, &mut after);
        assert!(mean(&after) > 0.08, "{} of {}", mean(&after), mean(&fields[5]));
    }
}
