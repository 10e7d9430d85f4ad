//! Solves the equations of displacement and pressure, [A B^T; B -C], of meshes that are too large
//! for a factor: minimal residuals, made fast by a block triangular preconditioner (Elman,
//! Silvester and Wathen, Finite Elements and Fast Iterative Solvers, 2014, ch. 4).
//!
//! - A: a cycle of two levels. Gauss-Seidel sweeps, node by node, take what changes from node to
//!   node; linear displacements of the same elements, whose matrix is factorised, take the rest.
//! - Pressure: its mass matrix over 2 mu and lambda, which the Schur complement C + B A^-1 B^T is
//!   within a bounded factor of whatever the mesh and Poisson's ratio.
//!
//! The preconditioner and the Krylov spaces are in single precision, and solutions are refined in
//! double precision.

use crate::numerics::simd::dispatch;
use crate::numerics::sparse::{Factor, Pattern, Singular};
use crate::numerics::tetrahedron::EDGES;
use crate::stiffness::fem_body::ELEMENT_UNKNOWNS;
use crate::stiffness::forward::Tie;
use crate::stiffness::krylov::{self, Block};
use crate::types::space::dot;
use rayon::prelude::*;

/// Right-hand sides in lockstep: as many as a vector register of AVX2 holds.
const LANES: usize = 8;
/// Iteration control of the mixed-precision solution.
struct KrylovControl {
    /// Least error of one Krylov space over the error before it: the resolution of single
    /// precision.
    min_error_ratio: f64,
    /// Goal of a Krylov space over the error allowed: it leaves a part for the refined solution.
    goal_fraction: f64,
    /// Most Krylov spaces for one right-hand side.
    max_spaces: usize,
}

const KRYLOV: KrylovControl = KrylovControl { min_error_ratio: 1e-5, goal_fraction: 0.5, max_spaces: 12 };

/// Strength of a tie beyond which its node hardly moves under the tissue's forces.
const FIRM_TIE_STRENGTH: f64 = 1e-3;
/// What belongs to a mesh: the linear elements of its corners, and its pressures.
#[derive(Debug)]
pub struct TwoLevel {
    coarse: Pattern,
    pressure: Pattern,
    /// In the order of elimination: the first unknown of a node, and the first ones of the corners
    /// that it lies between on the coarse level (twice the same for a corner).
    nodes: Vec<(u32, [u32; 2])>,
    /// The unknown of each pressure, and its unknown among pressures alone.
    pressures: Vec<[u32; 2]>,
    /// Unknowns that begin with each one: three for a node, one for a pressure.
    width: Vec<u8>,
    /// An element that holds a node, and where among its ten.
    holder: Vec<(u32, u8)>,
}

/// The corners (numbers in an element) that node `k` of an element lies between.
fn parents(k: usize) -> [usize; 2] {
    if k < 4 { [k, k] } else { EDGES[k - 4] }
}

impl TwoLevel {
    /// Of elements with ten nodes each at `places` and four pressures each, numbered after the
    /// nodes, in a pattern of all.
    ///
    /// # Errors
    /// [`Singular`] where the factors would not fit in memory.
    pub fn new(
        cells: &[[u32; 10]],
        pressures: &[[u32; 4]],
        places: &[[f64; 3]],
        pattern: &Pattern,
    ) -> Result<Self, Singular> {
        let mut number = vec![u32::MAX; places.len()];
        cells.iter().for_each(|c| (0..4).for_each(|k| number[c[k] as usize] = 0));
        let corners: Vec<usize> = (0..places.len()).filter(|&n| number[n] == 0).collect();
        corners.iter().enumerate().for_each(|(i, &n)| number[n] = i as u32);
        let corner_places: Vec<[f64; 3]> = corners.iter().map(|&n| places[n]).collect();
        let elements = cells.iter().flat_map(|c| [0, 1, 2, 3].map(|k| number[c[k] as usize])).collect();
        let coarse = Pattern::new(elements, 4, &corner_places, vec![3; corners.len()])?;
        let from = places.len() as u32;
        let count = pressures.iter().flatten().fold(from, |m, &p| m.max(p + 1)) - from;
        let mut pressure_places = vec![[0.0; 3]; count as usize];
        let mut holder = vec![(0, 0); places.len()];
        let mut between = vec![[0; 2]; places.len()];
        for (e, (cell, own)) in cells.iter().zip(pressures).enumerate() {
            for k in 0..10 {
                holder[cell[k] as usize] = (e as u32, k as u8);
                between[cell[k] as usize] = parents(k).map(|p| coarse.first(number[cell[p] as usize]) as u32);
            }
            (0..4).for_each(|i| pressure_places[(own[i] - from) as usize] = places[cell[i] as usize]);
        }
        let elements = pressures.iter().flatten().map(|p| p - from).collect();
        let pressure = Pattern::new(elements, 4, &pressure_places, vec![1; count as usize])?;
        let mut nodes: Vec<_> = (0..places.len()).map(|n| (pattern.first(n as u32) as u32, between[n])).collect();
        nodes.sort_unstable();
        let pressures: Vec<_> =
            (0..count).map(|p| [pattern.first(from + p) as u32, pressure.first(p) as u32]).collect();
        let mut width = vec![0; pattern.unknowns()];
        nodes.iter().for_each(|n| width[n.0 as usize] = 3);
        pressures.iter().for_each(|p| width[p[0] as usize] = 1);
        Ok(Self { coarse, pressure, nodes, pressures, width, holder })
    }

    /// Nothing on both levels, for [`Self::add`]; `stiffness` (kPa mm) of the tissue at each node.
    pub fn zeros(&self, stiffness: Vec<f64>) -> Levels {
        Levels { coarse: self.coarse.zeros(), mass: self.pressure.zeros(), ties: Vec::new(), stiffness }
    }

    /// Adds the tangent of element `e` with this Poisson's ratio.
    pub fn add(&self, levels: &mut Levels, e: usize, tangent: &[f64], poisson: f64) {
        let mut linear = [0.0; 144];
        for (i, k) in (0..10).flat_map(|i| (0..10).map(move |k| (i, k))) {
            for (p, q) in parents(i).into_iter().flat_map(|p| parents(k).map(|q| (p, q))) {
                for (r, c) in (0..3).flat_map(|r| (0..3).map(move |c| (r, c))) {
                    linear[(3 * p + r) * 12 + 3 * q + c] += 0.25 * tangent[(3 * i + r) * ELEMENT_UNKNOWNS + 3 * k + c];
                }
            }
        }
        self.coarse.add(&mut levels.coarse, e, &linear, 12);
        // 1 / lambda to 1 / (2 mu) + 1 / lambda.
        let over = -(1.0 - poisson) / (1.0 - 2.0 * poisson);
        let mass: [f64; 16] = std::array::from_fn(|i| over * tangent[(30 + i / 4) * ELEMENT_UNKNOWNS + 30 + i % 4]);
        self.pressure.add(&mut levels.mass, e, &mass, 4);
    }

    /// Adds a tie of stiffness `spring` (kPa mm) to the node's displacement.
    pub fn tie(&self, levels: &mut Levels, tie: &Tie, first: usize, spring: f64) {
        let (e, k) = self.holder[tie.node as usize];
        let mut linear = [0.0; 144];
        for (p, q) in parents(k.into()).into_iter().flat_map(|p| parents(k.into()).map(|q| (p, q))) {
            for (r, c) in (0..3).flat_map(|r| (0..3).map(move |c| (r, c))) {
                linear[(3 * p + r) * 12 + 3 * q + c] += 0.25 * spring * tie.along(r, c);
            }
        }
        self.coarse.add(&mut levels.coarse, e as usize, &linear, 12);
        if tie.strength > FIRM_TIE_STRENGTH {
            levels.ties.push((first, *tie));
        }
    }
}

/// The numbers of a matrix on both levels.
#[derive(Debug)]
pub struct Levels {
    coarse: Vec<f64>,
    mass: Vec<f64>,
    /// Firm ties, and the first unknown of the node of each.
    ties: Vec<(usize, Tie)>,
    /// Stiffness of the tissue at each node (kPa mm).
    stiffness: Vec<f64>,
}

/// A matrix in blocks of its nodes, in single precision.
#[derive(Debug, Default)]
struct Blocks {
    /// Of each node: its block and the inverse.
    own: Vec<[[f32; 9]; 2]>,
    /// Where the blocks of each node's later neighbours begin.
    start: Vec<u32>,
    /// The first unknown of a neighbour, and the block in its rows.
    later: Vec<(u32, [f32; 9])>,
    /// First unknown of a node, a pressure, and what couples them.
    couplings: Vec<(u32, u32, [f32; 3])>,
    /// Two pressures, the same or the second later, and their entry.
    compliances: Vec<(u32, u32, f32)>,
}

impl Blocks {
    fn of(pattern: &Pattern, levels: &TwoLevel, values: &[f64]) -> Result<Self, Singular> {
        let mut out = Self { start: vec![0], ..Self::default() };
        for &(first, _) in &levels.nodes {
            let columns = [0, 1, 2].map(|c| pattern.below(first as usize + c));
            let at = |row: usize, c: usize| values[columns[c].1.start + row - c];
            let own: [f64; 9] = std::array::from_fn(|i| at((i / 3).max(i % 3), (i / 3).min(i % 3)));
            out.own.push([own, inverse(&own).ok_or(Singular)?].map(|m| m.map(|v| v as f32)));
            let rows = columns[0].0;
            let mut k = 3;
            while k < rows.len() {
                if levels.width[rows[k] as usize] == 3 {
                    out.later.push((rows[k], std::array::from_fn(|i| at(k + i / 3, i % 3) as f32)));
                    k += 3;
                } else {
                    out.couplings.push((first, rows[k], std::array::from_fn(|c| at(k, c) as f32)));
                    k += 1;
                }
            }
            out.start.push(out.later.len() as u32);
        }
        for &[pressure, _] in &levels.pressures {
            let (rows, span) = pattern.below(pressure as usize);
            let values = &values[span];
            let mut k = 0;
            while k < rows.len() {
                if levels.width[rows[k] as usize] == 3 {
                    out.couplings.push((rows[k], pressure, [0, 1, 2].map(|c| values[k + c] as f32)));
                    k += 3;
                } else {
                    out.compliances.push((pressure, rows[k], values[k] as f32));
                    k += 1;
                }
            }
        }
        Ok(out)
    }

    #[inline(always)]
    fn neighbours(&self, node: usize) -> &[(u32, [f32; 9])] {
        &self.later[self.start[node] as usize..self.start[node + 1] as usize]
    }

    /// Adds `sign` times A x to `y`.
    #[inline(always)]
    fn stiff<const L: usize>(&self, nodes: &[(u32, [u32; 2])], sign: f32, x: &[[f32; L]], y: &mut [[f32; L]]) {
        for (i, &(first, _)) in nodes.iter().enumerate() {
            let own = at(x, first).map(|v| v.map(|v| sign * v));
            let mut sum = [[0.0; L]; 3];
            product(&self.own[i][0], &own, &mut sum);
            for (other, block) in self.neighbours(i) {
                let theirs = at(x, *other).map(|v| v.map(|v| sign * v));
                transposed(block, &theirs, &mut sum);
                let mut to = at(y, *other);
                product(block, &own, &mut to);
                put(y, *other, to);
            }
            let mut to = at(y, first);
            (0..3).for_each(|r| (0..L).for_each(|l| to[r][l] += sum[r][l]));
            put(y, first, to);
        }
    }

    /// Adds `sign` times B x to the pressures of `y`.
    #[inline(always)]
    fn dilate<const L: usize>(&self, sign: f32, x: &[[f32; L]], y: &mut [[f32; L]]) {
        for (node, pressure, b) in &self.couplings {
            let (u, p) = (at(x, *node), &mut y[*pressure as usize]);
            (0..L).for_each(|l| p[l] += sign * (b[0] * u[0][l] + b[1] * u[1][l] + b[2] * u[2][l]));
        }
    }

    /// The whole matrix times a block of vectors.
    fn multiply<const L: usize>(&self, nodes: &[(u32, [u32; 2])], x: &[[f32; L]]) -> Block<L> {
        let mut y = vec![[0.0; L]; x.len()];
        dispatch(
            #[inline(always)]
            || {
                self.stiff(nodes, 1.0, x, &mut y);
                self.dilate(1.0, x, &mut y);
                for (node, pressure, b) in &self.couplings {
                    let (p, mut to) = (x[*pressure as usize], at(&y, *node));
                    (0..3).for_each(|c| (0..L).for_each(|l| to[c][l] += b[c] * p[l]));
                    put(&mut y, *node, to);
                }
                for &(p, q, value) in &self.compliances {
                    let (p, q) = (p as usize, q as usize);
                    (0..L).for_each(|l| y[q][l] += value * x[p][l]);
                    if p != q {
                        (0..L).for_each(|l| y[p][l] += value * x[q][l]);
                    }
                }
            },
        );
        y
    }
}

#[inline(always)]
fn at<const L: usize>(x: &[[f32; L]], first: u32) -> [[f32; L]; 3] {
    let x = &x[first as usize..first as usize + 3];
    [x[0], x[1], x[2]]
}

#[inline(always)]
fn put<const L: usize>(x: &mut [[f32; L]], first: u32, values: [[f32; L]; 3]) {
    x[first as usize..first as usize + 3].copy_from_slice(&values);
}

/// Adds M x to `y`.
#[inline(always)]
fn product<const L: usize>(m: &[f32; 9], x: &[[f32; L]; 3], y: &mut [[f32; L]; 3]) {
    for r in 0..3 {
        (0..L).for_each(|l| y[r][l] += m[3 * r] * x[0][l] + m[3 * r + 1] * x[1][l] + m[3 * r + 2] * x[2][l]);
    }
}

/// Adds M^T x to `y`.
#[inline(always)]
fn transposed<const L: usize>(m: &[f32; 9], x: &[[f32; L]; 3], y: &mut [[f32; L]; 3]) {
    for r in 0..3 {
        (0..L).for_each(|l| y[r][l] += m[r] * x[0][l] + m[3 + r] * x[1][l] + m[6 + r] * x[2][l]);
    }
}

fn inverse(m: &[f64; 9]) -> Option<[f64; 9]> {
    let cofactor = |i: usize| {
        let (r, c) = (i % 3, i / 3);
        let e = |r: usize, c: usize| m[3 * (r % 3) + c % 3];
        e(r + 1, c + 1) * e(r + 2, c + 2) - e(r + 1, c + 2) * e(r + 2, c + 1)
    };
    let determinant = m[0] * cofactor(0) + m[1] * cofactor(3) + m[2] * cofactor(6);
    let out: [f64; 9] = std::array::from_fn(|i| cofactor(i) / determinant);
    out.iter().all(|v| v.is_finite()).then_some(out)
}

/// A matrix and what solves its equations.
#[derive(Debug)]
pub struct Saddle<'a> {
    pattern: &'a Pattern,
    levels: &'a TwoLevel,
    values: Vec<f64>,
    /// Firm ties, and the first unknown of the node of each.
    ties: Vec<(usize, Tie)>,
    /// Weight of each unknown in the norm of an error.
    weights: Vec<f32>,
    blocks: Blocks,
    coarse: Factor<'a>,
    mass: Factor<'a>,
}

impl<'a> Saddle<'a> {
    /// For the matrix of these values in `pattern`, with its numbers on both levels.
    ///
    /// # Errors
    /// [`Singular`] where the body can move freely.
    pub fn new(pattern: &'a Pattern, levels: &'a TwoLevel, values: Vec<f64>, own: Levels) -> Result<Self, Singular> {
        let Levels { coarse, mass, ties, stiffness } = own;
        let mut weights = vec![0.0; pattern.unknowns()];
        for (n, stiffness) in stiffness.iter().enumerate() {
            weights[pattern.first(n as u32)..][..3].fill(*stiffness as f32);
        }
        for [unknown, p] in &levels.pressures {
            weights[*unknown as usize] = mass[levels.pressure.below(*p as usize).1.start] as f32;
        }
        Ok(Self {
            blocks: Blocks::of(pattern, levels, &values)?,
            coarse: levels.coarse.factorise(coarse)?,
            mass: levels.pressure.factorise(mass)?,
            pattern,
            levels,
            values,
            ties,
            weights,
        })
    }

    /// For another matrix near it: the factors of the coarse level serve for that as well.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn near(self, values: Vec<f64>, own: Levels) -> Result<Self, Singular> {
        let blocks = Blocks::of(self.pattern, self.levels, &values)?;
        Ok(Self { blocks, values, ties: own.ties, ..self })
    }

    /// Solves for right-hand sides one after the other in `x`, from `start` where one is given, to
    /// a relative error of `tolerance` (2-norm, weighted by the tissue's stiffness).
    ///
    /// # Errors
    /// [`Singular`] where the residual does not fall.
    pub fn solve(&self, x: &mut [f64], start: Option<&[f64]>, tolerance: f64) -> Result<(), Singular> {
        let n = self.pattern.unknowns();
        let zero = if start.is_none() { vec![0.0; x.len()] } else { Vec::new() };
        let start = start.unwrap_or(&zero);
        if x.len() <= 2 * n {
            let pairs = x.par_chunks_mut(n).zip(start.par_chunks(n));
            return pairs.map(|(x, start)| self.lockstep::<1>(x, start, tolerance)).collect();
        }
        let pairs = x.par_chunks_mut(LANES * n).zip(start.par_chunks(LANES * n));
        pairs.map(|(x, start)| self.lockstep::<LANES>(x, start, tolerance)).collect()
    }

    fn lockstep<const L: usize>(&self, right: &mut [f64], start: &[f64], tolerance: f64) -> Result<(), Singular> {
        let whole = self.goals::<L>(right, tolerance);
        let mut x = start.to_vec();
        let mut rest = self.rest(right, &x);
        self.close(&mut x, &mut rest);
        rest = self.rest(right, &x);
        for _ in 0..KRYLOV.max_spaces {
            let left = self.precondition(interleaved::<L>(&rest, self.pattern.unknowns()));
            let sizes = krylov::norms(&self.weights, &left);
            if sizes.iter().any(|v| !v.is_finite()) {
                return Err(Singular);
            }
            if (0..L).all(|l| sizes[l] <= whole[l]) {
                right.copy_from_slice(&x);
                return Ok(());
            }
            let goals =
                std::array::from_fn(|l| (KRYLOV.goal_fraction * whole[l]).max(KRYLOV.min_error_ratio * sizes[l]));
            let apply = |v: &[[f32; L]]| self.precondition(self.blocks.multiply(&self.levels.nodes, v));
            let change = krylov::solve(left, &self.weights, goals, apply);
            for (l, x) in x.chunks_mut(self.pattern.unknowns()).enumerate() {
                x.iter_mut().zip(&change).for_each(|(x, c)| *x += f64::from(c[l]));
            }
            rest = self.rest(right, &x);
            self.close(&mut x, &mut rest);
        }
        Err(Singular)
    }

    /// What solutions leave of right-hand sides.
    fn rest(&self, right: &[f64], x: &[f64]) -> Vec<f64> {
        let n = self.pattern.unknowns();
        let mut out = right.to_vec();
        for (out, x) in out.chunks_mut(n).zip(x.chunks(n)).filter(|(_, x)| x.iter().any(|v| *v != 0.0)) {
            let product = self.pattern.multiply(&self.values, x);
            out.iter_mut().zip(product).for_each(|(out, p)| *out -= p);
        }
        out
    }

    /// Errors (norms) to which solutions for these right-hand sides are wanted.
    fn goals<const L: usize>(&self, right: &[f64], tolerance: f64) -> [f64; L] {
        let first = self.precondition(interleaved::<L>(right, self.pattern.unknowns()));
        krylov::norms(&self.weights, &first).map(|v| tolerance * v)
    }

    /// Brings tied nodes to where their ties balance the rest: a residual of a tie is a force, and
    /// ties are too stiff for one to show as a displacement. What that changes in `rest` is worked
    /// out at these nodes alone.
    fn close(&self, x: &mut [f64], rest: &mut [f64]) {
        let n = self.pattern.unknowns();
        for (x, rest) in x.chunks_mut(n).zip(rest.chunks_mut(n)) {
            for (first, tie) in &self.ties {
                let own = self.own(*first);
                let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
                for n in tie.direction.as_ref().map_or(&axes[..], std::slice::from_ref) {
                    let pulled: [f64; 3] = std::array::from_fn(|a| dot([0, 1, 2].map(|b| own[3 * a + b]), *n));
                    let step = dot(*n, [0, 1, 2].map(|a| rest[first + a])) / dot(*n, pulled);
                    (0..3).for_each(|a| {
                        x[first + a] += step * n[a];
                        rest[first + a] -= step * pulled[a];
                    });
                }
            }
        }
    }

    /// The block of the node whose first unknown is given.
    fn own(&self, first: usize) -> [f64; 9] {
        let at = |row: usize, c: usize| self.values[self.pattern.below(first + c).1.start + row - c];
        std::array::from_fn(|i| at((i / 3).max(i % 3), (i / 3).min(i % 3)))
    }

    /// Solves with the preconditioner.
    fn precondition<const L: usize>(&self, mut right: Block<L>) -> Block<L> {
        let mut z = self.cycle(&mut right.clone());
        dispatch(
            #[inline(always)]
            || self.blocks.dilate(-1.0, &z, &mut right),
        );
        let (pressures, n) = (&self.levels.pressures, self.levels.pressures.len());
        let mut p = vec![0.0; L * n];
        for [unknown, own] in pressures {
            (0..L).for_each(|l| p[l * n + *own as usize] = f64::from(right[*unknown as usize][l]));
        }
        // A vector that is not finite is noticed by its norm.
        let _ = self.mass.step(&mut p);
        for [unknown, own] in pressures {
            z[*unknown as usize] = std::array::from_fn(|l| -p[l * n + *own as usize] as f32);
        }
        z
    }

    /// A symmetric cycle for A; `right` is spoilt.
    fn cycle<const L: usize>(&self, right: &mut [[f32; L]]) -> Block<L> {
        let (nodes, blocks) = (&self.levels.nodes, &self.blocks);
        let mut z = vec![[0.0; L]; right.len()];
        dispatch(
            #[inline(always)]
            || {
                for (i, &(first, _)) in nodes.iter().enumerate() {
                    let mut own = [[0.0; L]; 3];
                    product(&blocks.own[i][1], &at(right, first), &mut own);
                    put(&mut z, first, own);
                    let own = own.map(|v| v.map(|v| -v));
                    for (other, block) in blocks.neighbours(i) {
                        let mut to = at(right, *other);
                        product(block, &own, &mut to);
                        put(right, *other, to);
                    }
                }
                for (i, &(first, _)) in nodes.iter().enumerate() {
                    let mut sum = [[0.0; L]; 3];
                    for (other, block) in blocks.neighbours(i) {
                        transposed(block, &at(&z, *other), &mut sum);
                    }
                    put(right, first, sum.map(|v| v.map(|v| -v)));
                }
            },
        );
        let mut smooth = self.linear(right);
        dispatch(
            #[inline(always)]
            || {
                blocks.stiff(nodes, -1.0, &smooth, right);
                z.iter_mut().zip(&smooth).for_each(|(z, s)| (0..L).for_each(|l| z[l] += s[l]));
                for (i, &(first, _)) in nodes.iter().enumerate().rev() {
                    let (mut sum, mut own) = ([[0.0; L]; 3], [[0.0; L]; 3]);
                    for (other, block) in blocks.neighbours(i) {
                        transposed(block, &at(&smooth, *other), &mut sum);
                    }
                    let rest = at(right, first);
                    (0..3).for_each(|r| (0..L).for_each(|l| sum[r][l] = rest[r][l] - sum[r][l]));
                    product(&blocks.own[i][1], &sum, &mut own);
                    put(&mut smooth, first, own);
                    let mut to = at(&z, first);
                    (0..3).for_each(|r| (0..L).for_each(|l| to[r][l] += own[r][l]));
                    put(&mut z, first, to);
                }
            },
        );
        z
    }

    /// The linear displacement that a residual asks for.
    fn linear<const L: usize>(&self, right: &[[f32; L]]) -> Block<L> {
        let n = self.levels.coarse.unknowns();
        let mut x = vec![0.0; L * n];
        for (first, parents) in &self.levels.nodes {
            for (p, c) in parents.iter().flat_map(|p| (0..3).map(move |c| (*p as usize, c))) {
                let value = right[*first as usize + c];
                (0..L).for_each(|l| x[l * n + p + c] += 0.5 * f64::from(value[l]));
            }
        }
        // A vector that is not finite is noticed by its norm.
        let _ = self.coarse.step(&mut x);
        let mut out = vec![[0.0; L]; right.len()];
        for (first, [p, q]) in &self.levels.nodes {
            for c in 0..3 {
                let both = |l: usize| x[l * n + *p as usize + c] + x[l * n + *q as usize + c];
                out[*first as usize + c] = std::array::from_fn(|l| (0.5 * both(l)) as f32);
            }
        }
        out
    }
}

/// Vectors of `n` numbers one after the other, and zeros, beside each other.
fn interleaved<const L: usize>(x: &[f64], n: usize) -> Block<L> {
    let mut out = vec![[0.0; L]; n];
    for (l, x) in x.chunks(n).enumerate() {
        out.iter_mut().zip(x).for_each(|(out, v)| out[l] = *v as f32);
    }
    out
}
