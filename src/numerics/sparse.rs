//! Sparse symmetric systems made of element matrices: nested dissection, one symbolic
//! factorisation, many numeric ones.
//!
//! A system is a mesh of *nodes*, each with some unknowns, and *elements* that couple all their
//! nodes. Unknowns are numbered in the order of elimination, so the matrix needs no permutation.
//! The ordering is geometric nested dissection over elements (George 1973): the elements are halved
//! at the median along their longest extent, and the nodes that both halves touch are eliminated
//! last.
//!
//! The factorisation is L D L^T without pivots (faer), in single precision with solutions refined
//! in double. It exists for positive definite and for symmetric quasi-definite matrices,
//! [K B^T; B -C] with K and C positive definite, under any order (Vanderbei, SIAM J. Optim. 5,
//! 1995). Within a part of the dissection the nodes keep their order, so nodes of the second block
//! belong at the end.
//!
//! Some nodes may be eliminated after all others: where a matrix changes at these alone, its factor
//! is renewed there alone ([`Factor::renewed`]).

use crate::numerics::partial_refactorisation::Tail;
use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::ldlt::factor::LdltRegularization;
use faer::perm::PermRef;
use faer::sparse::linalg::cholesky::{
    CholeskySymbolicParams, LdltRef, SymbolicCholesky, SymmetricOrdering, factorize_symbolic_cholesky,
};
use faer::sparse::{SparseColMatRef, SymbolicSparseColMatRef};
use faer::traits::RealField;
use faer::{Conj, MatMut, Par, Side};
use rayon::prelude::*;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

/// Parts with this many nodes or fewer are not dissected further.
const MAX_LEAF_NODES: usize = 60;
/// Iterative refinement of a solution by a factor in single precision.
struct Refinement {
    /// Largest relative error of the refined solution.
    tolerance: f64,
    /// Most refinements: more cost as much as a factorisation.
    max_count: i32,
    /// Largest mean ratio of successive changes: beyond it, the factor is discarded.
    max_contraction: f64,
}

const REFINEMENT: Refinement = Refinement { tolerance: 1e-7, max_count: 16, max_contraction: 0.5 };

/// What keeps a system from being solved.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Singular;

/// The places of the non-zeros of the lower triangle, and the symbolic factorisation.
#[derive(Debug)]
pub struct Pattern {
    /// First unknown of each node.
    first: Vec<u32>,
    /// Unknowns of each node.
    width: Vec<u8>,
    unknowns: usize,
    column: Vec<usize>,
    row: Vec<u32>,
    /// For each element and each pair of its nodes (i > j as in a lower triangle), where the block
    /// starts below the diagonal block of the earlier node.
    blocks: Vec<u32>,
    elements: Vec<u32>,
    nodes_per_element: usize,
    /// Made when first needed: a pattern that is never factorised has none.
    symbolic: OnceLock<Result<SymbolicCholesky<u32>, Singular>>,
    /// The columns of the nodes that come last, if any do.
    tail: Option<Tail>,
    /// Numbers of factors that are no longer needed: fresh memory of this size takes a fifth of a
    /// factorisation's time.
    spare: Mutex<Vec<Vec<f32>>>,
}

impl Pattern {
    /// The pattern of `elements`, `per` node numbers each, where node `i` lies at `places[i]` and
    /// has `width[i]` unknowns.
    ///
    /// # Errors
    /// [`Singular`] when the symbolic factorisation does not fit in memory.
    pub fn new(elements: Vec<u32>, per: usize, places: &[[f64; 3]], width: Vec<u8>) -> Result<Self, Singular> {
        let out = Self::unfactorised(elements, per, places, width);
        out.symbolic()?;
        Ok(out)
    }

    /// The same without a symbolic factorisation until one is needed.
    pub(crate) fn unfactorised(elements: Vec<u32>, per: usize, places: &[[f64; 3]], width: Vec<u8>) -> Self {
        let order = dissection(&elements, per, places, &width);
        Self::ordered(elements, per, width, &order)
    }

    /// The same with some nodes eliminated after all others, in an order of their own.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub(crate) fn eliminating_last(&self, nodes: &[u32]) -> Result<Self, Singular> {
        let mut late = vec![false; self.first.len()];
        nodes.iter().for_each(|&n| late[n as usize] = true);
        let mut order: Vec<u32> = (0..late.len() as u32).collect();
        order.sort_unstable_by_key(|&n| (late[n as usize], self.first[n as usize]));
        let early = order.partition_point(|&n| !late[n as usize]);
        let mut out = Self::ordered(self.elements.clone(), self.nodes_per_element, self.width.clone(), &order);
        let columns = order[early..].iter().map(|&node| usize::from(self.width[node as usize])).sum();
        out.tail = Tail::of(out.symbolic()?, columns);
        Ok(out)
    }

    /// The pattern with its nodes in an order.
    fn ordered(elements: Vec<u32>, per: usize, width: Vec<u8>, order: &[u32]) -> Self {
        let mut first = vec![0; width.len()];
        let mut unknowns = 0;
        for &node in order {
            first[node as usize] = unknowns;
            unknowns += u32::from(width[node as usize]);
        }
        let below = adjacency(&elements, per, &first);
        let mut column = vec![0; unknowns as usize + 1];
        let mut row = Vec::new();
        for &node in order {
            let (start, w) = (first[node as usize], u32::from(width[node as usize]));
            for c in 0..w {
                column[(start + c) as usize] = row.len();
                row.extend(start + c..start + w);
                for &(_, other) in &below[node as usize] {
                    let at = first[other as usize];
                    row.extend(at..at + u32::from(width[other as usize]));
                }
            }
        }
        column[unknowns as usize] = row.len();
        let offsets: Vec<Vec<u32>> = below
            .iter()
            .map(|list| {
                let mut sum = 0;
                let before = |&(_, other): &(u32, u32)| {
                    let here = sum;
                    sum += u32::from(width[other as usize]);
                    here
                };
                list.iter().map(before).collect()
            })
            .collect();
        let mut blocks = Vec::with_capacity(elements.len() / per * per * (per - 1) / 2);
        for element in elements.chunks_exact(per) {
            for i in 1..per {
                for j in 0..i {
                    let (low, high) = earlier(&first, element[i], element[j]);
                    let list = &below[low as usize];
                    let at = list.partition_point(|&(f, _)| f < first[high as usize]);
                    blocks.push(offsets[low as usize][at]);
                }
            }
        }
        Self {
            first,
            width,
            unknowns: unknowns as usize,
            column,
            row,
            blocks,
            elements,
            nodes_per_element: per,
            symbolic: OnceLock::new(),
            tail: None,
            spare: Mutex::default(),
        }
    }

    fn symbolic(&self) -> Result<&SymbolicCholesky<u32>, Singular> {
        let make = || {
            let (n, params) = (self.unknowns, CholeskySymbolicParams::default());
            let column32: Vec<u32> = self.column.iter().map(|&c| c as u32).collect();
            let view = SymbolicSparseColMatRef::new_checked(n, n, &column32, None, &self.row);
            // faer's own identity order reads the upper triangle whatever the side.
            let same: Vec<u32> = (0..n as u32).collect();
            let unchanged = SymmetricOrdering::Custom(PermRef::new_checked(&same, &same, n));
            factorize_symbolic_cholesky(view, Side::Lower, unchanged, params).map_err(|_| Singular)
        };
        self.symbolic.get_or_init(make).as_ref().map_err(|e| *e)
    }

    /// Number of unknowns.
    pub fn unknowns(&self) -> usize {
        self.unknowns
    }

    /// Whether some nodes come last, so that a factor can be renewed there.
    pub(crate) fn renews(&self) -> bool {
        self.tail.is_some()
    }

    /// Numbers that a factor holds.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn fill(&self) -> Result<usize, Singular> {
        Ok(self.symbolic()?.len_val())
    }

    /// The rows of a column, from its own on, and where their values lie.
    pub fn below(&self, column: usize) -> (&[u32], std::ops::Range<usize>) {
        let span = self.column[column]..self.column[column + 1];
        (&self.row[span.clone()], span)
    }

    /// The first unknown of a node; its others follow.
    pub fn first(&self, node: u32) -> usize {
        self.first[node as usize] as usize
    }

    /// A matrix of zeros.
    pub fn zeros(&self) -> Vec<f64> {
        vec![0.0; self.row.len()]
    }

    /// Adds the symmetric matrix of element `e`, row by row over the unknowns of its nodes in turn.
    pub fn add(&self, values: &mut [f64], e: usize, matrix: &[f64], side: usize) {
        let per = self.nodes_per_element;
        let nodes = &self.elements[e * per..(e + 1) * per];
        let pairs = per * (per - 1) / 2;
        let blocks = &self.blocks[e * pairs..(e + 1) * pairs];
        let (mut i0, mut pair) = (0, 0);
        for i in 0..per {
            let wi = usize::from(self.width[nodes[i] as usize]);
            let mut j0 = 0;
            for j in 0..i {
                let wj = usize::from(self.width[nodes[j] as usize]);
                let swap = self.first[nodes[i] as usize] < self.first[nodes[j] as usize];
                let (low, low_width, high_width) = if swap { (nodes[i], wi, wj) } else { (nodes[j], wj, wi) };
                let start = self.first[low as usize] as usize;
                for c in 0..low_width {
                    let at = self.column[start + c] + low_width - c + blocks[pair] as usize;
                    for r in 0..high_width {
                        let (a, b) = if swap { (i0 + c, j0 + r) } else { (i0 + r, j0 + c) };
                        values[at + r] += matrix[a * side + b];
                    }
                }
                pair += 1;
                j0 += wj;
            }
            let start = self.first[nodes[i] as usize] as usize;
            for c in 0..wi {
                for r in c..wi {
                    values[self.column[start + c] + r - c] += matrix[(i0 + r) * side + i0 + c];
                }
            }
            i0 += wi;
        }
    }

    /// Adds `value` at two unknowns of one node (counted within the node).
    pub(crate) fn add_at_node(&self, values: &mut [f64], node: u32, r: usize, c: usize, value: f64) {
        let (r, c) = (r.max(c), r.min(c));
        values[self.column[self.first(node) + c] + r - c] += value;
    }

    /// The matrix times a vector.
    pub fn multiply(&self, values: &[f64], x: &[f64]) -> Vec<f64> {
        let mut y = vec![0.0; self.unknowns];
        for c in 0..self.unknowns {
            let span = self.column[c]..self.column[c + 1];
            let mut sum = 0.0;
            for (&r, &v) in self.row[span.clone()].iter().zip(&values[span]) {
                let r = r as usize;
                sum += v * x[r];
                if r != c {
                    y[r] += v * x[c];
                }
            }
            y[c] += sum;
        }
        y
    }

    /// Factorises the matrix whose lower triangle is given, as [`Self::add`] fills it.
    ///
    /// # Errors
    /// [`Singular`] when a pivot vanishes or is not finite.
    pub(crate) fn factorise(&self, matrix: Vec<f64>) -> Result<Factor<'_>, Singular> {
        self.factor(Arc::new(matrix))
    }

    fn factor(&self, matrix: Arc<Vec<f64>>) -> Result<Factor<'_>, Singular> {
        let spare = self.spare.lock().unwrap_or_else(PoisonError::into_inner).pop();
        let cleared = |mut used: Vec<f32>| {
            used.fill(0.0);
            used
        };
        let fill = self.fill()?;
        let memory = spare.map_or_else(|| vec![0.0; fill], cleared);
        let rounded: Vec<f32> = matrix.iter().map(|&v| v as f32).collect();
        match self.numeric(&rounded, memory) {
            Ok(values) => Ok(Factor::new(self, matrix, Values::Single(values))),
            Err(Singular) => self.exact_factor(matrix),
        }
    }

    fn exact_factor(&self, matrix: Arc<Vec<f64>>) -> Result<Factor<'_>, Singular> {
        let values = self.numeric(&matrix, vec![0.0; self.fill()?])?;
        Ok(Factor::new(self, matrix, Values::Double(values)))
    }

    /// Factorises into `memory`, which holds zeros.
    fn numeric<T: RealField>(&self, values: &[T], mut memory: Vec<T>) -> Result<Vec<T>, Singular> {
        let column32: Vec<u32> = self.column.iter().map(|&c| c as u32).collect();
        let n = self.unknowns;
        let places = SymbolicSparseColMatRef::new_checked(n, n, &column32, None, &self.row);
        let matrix = SparseColMatRef::new(places, values);
        let symbolic = self.symbolic()?;
        let scratch = symbolic.factorize_numeric_ldlt_scratch::<T>(Par::Seq, Default::default());
        let mut stack = MemBuffer::try_new(scratch).map_err(|_| Singular)?;
        let done = symbolic.factorize_numeric_ldlt(
            &mut memory,
            matrix,
            Side::Lower,
            LdltRegularization::default(),
            Par::Seq,
            MemStack::new(&mut stack),
            Default::default(),
        );
        done.map_err(|_| Singular)?;
        Ok(memory)
    }

    /// Solves with a factor's numbers for right-hand sides one after the other in `x`.
    fn substitute<T: RealField>(&self, factor: &[T], x: &mut [T]) -> Result<(), Singular> {
        let columns = x.len() / self.unknowns.max(1);
        let symbolic = self.symbolic()?;
        let scratch = symbolic.solve_in_place_scratch::<T>(columns, Par::Seq);
        let mut stack = MemBuffer::try_new(scratch).map_err(|_| Singular)?;
        let ldlt = LdltRef::<u32, T>::new(symbolic, factor);
        let right = MatMut::from_column_major_slice_mut(x, self.unknowns, columns);
        ldlt.solve_in_place_with_conj(Conj::No, right, Par::Seq, MemStack::new(&mut stack));
        Ok(())
    }
}

/// Numbers of a factor.
#[derive(Debug)]
enum Values {
    Single(Vec<f32>),
    Double(Vec<f64>),
}

/// A matrix, and a factor of it or of one nearby.
///
/// The factor is kept in single precision, which takes half the memory and half the time, and the
/// solution is refined with the matrix in double precision (Wilkinson, Rounding Errors in Algebraic
/// Processes, 1963; Carson and Higham, SIAM J. Sci. Comput. 40, 2018). Where that does not
/// contract, a better factor is made: of the matrix itself, then in double precision.
#[derive(Debug)]
pub struct Factor<'a> {
    pattern: &'a Pattern,
    matrix: Arc<Vec<f64>>,
    /// The matrix that it is the factor of: that one, or one nearby.
    of: Arc<Vec<f64>>,
    values: Values,
    /// The better factor, where one was needed.
    better: OnceLock<Result<Box<Factor<'a>>, Singular>>,
}

impl Drop for Factor<'_> {
    fn drop(&mut self) {
        self.release();
    }
}

impl<'a> Factor<'a> {
    fn new(pattern: &'a Pattern, matrix: Arc<Vec<f64>>, values: Values) -> Self {
        Self { pattern, of: Arc::clone(&matrix), matrix, values, better: OnceLock::new() }
    }

    /// Leaves its memory to the next factor.
    fn release(&mut self) {
        if let Values::Single(values) = &mut self.values
            && !values.is_empty()
        {
            let values = std::mem::take(values);
            self.pattern.spare.lock().unwrap_or_else(PoisonError::into_inner).push(values);
        }
    }

    /// The same factor for a matrix near the one that it is of.
    pub fn near(mut self, matrix: Vec<f64>) -> Self {
        (self.matrix, self.better) = (Arc::new(matrix), OnceLock::new());
        self
    }

    /// Whether it is of a matrix nearby.
    fn is_nearby(&self) -> bool {
        !Arc::ptr_eq(&self.of, &self.matrix)
    }

    /// A factor for another matrix with the same pattern. The columns of the nodes that come last
    /// are worked out anew alone where the matrix changed there alone, or is `near` the one of the
    /// factor elsewhere; else all of them. Where none come last, a factor serves for a matrix near
    /// its own as it is.
    ///
    /// # Errors
    /// [`Singular`] when a pivot vanishes or is not finite.
    pub(crate) fn renewed(mut self, matrix: Vec<f64>, near: bool) -> Result<Self, Singular> {
        let pattern = self.pattern;
        if let Some(Ok(better)) = self.better.take() {
            self = *better;
        }
        if near && pattern.tail.is_none() {
            return Ok(self.near(matrix));
        }
        if let (Some(tail), Values::Single(values)) = (&pattern.tail, &mut self.values) {
            let begin = pattern.column[tail.first()];
            let same = matrix[..begin] == self.of[..begin];
            let columns = tail.first()..pattern.unknowns;
            let spans = columns.flat_map(|c| (pattern.column[c]..pattern.column[c + 1]).map(move |at| (at, c)));
            let changes = spans.map(|(at, c)| (pattern.row[at] as usize, c, (matrix[at] - self.of[at]) as f32));
            let changes = changes.filter(|change| change.2 != 0.0);
            if (same || near) && tail.renew(pattern.symbolic()?, values, changes).is_ok() {
                let mut out = self.near(matrix);
                if same {
                    out.of = Arc::clone(&out.matrix);
                } else {
                    Arc::make_mut(&mut out.of)[begin..].copy_from_slice(&out.matrix[begin..]);
                }
                return Ok(out);
            }
        }
        // Its memory is the next one's.
        drop(self);
        pattern.factorise(matrix)
    }

    /// Solves for several right-hand sides in place, one after the other in `x`. Relative error
    /// (2-norm over all unknowns of a right-hand side): 10^-7 at most, about 10^-12 where the
    /// factor is of the matrix itself.
    ///
    /// # Errors
    /// [`Singular`] when the solution is not finite.
    pub fn solve(&self, x: &mut [f64]) -> Result<(), Singular> {
        let solved = match &self.values {
            Values::Single(values) => self.refined(values, x),
            Values::Double(_) if self.is_nearby() => None,
            Values::Double(values) => {
                self.pattern.substitute(values, x)?;
                return if x.iter().all(|v| v.is_finite()) { Ok(()) } else { Err(Singular) };
            }
        };
        let Some(solved) = solved else { return self.better()?.solve(x) };
        x.copy_from_slice(&solved);
        Ok(())
    }

    /// As [`Factor::solve`]; a factor of a matrix nearby that does not serve is replaced, not kept
    /// beside the better one.
    ///
    /// # Errors
    /// As [`Factor::solve`].
    pub(crate) fn solve_or_replace(&mut self, x: &mut [f64]) -> Result<(), Singular> {
        if let (Values::Single(values), true) = (&self.values, self.is_nearby()) {
            if let Some(solved) = self.refined(values, x) {
                x.copy_from_slice(&solved);
                return Ok(());
            }
            self.release();
            *self = self.pattern.factor(Arc::clone(&self.matrix))?;
        }
        self.solve(x)
    }

    /// As [`Factor::solve`] without refinement, for steps whose residual is worked out anew: to
    /// about five digits, or as far as the matrix nearby goes.
    ///
    /// # Errors
    /// [`Singular`] when the solution is not finite.
    pub fn step(&self, x: &mut [f64]) -> Result<(), Singular> {
        match &self.values {
            Values::Single(values) => {
                let mut step: Vec<f32> = x.iter().map(|&v| v as f32).collect();
                self.pattern.substitute(values, &mut step)?;
                x.iter_mut().zip(step).for_each(|(x, step)| *x = f64::from(step));
            }
            Values::Double(values) => self.pattern.substitute(values, x)?,
        }
        if x.iter().all(|v| v.is_finite()) { Ok(()) } else { Err(Singular) }
    }

    /// A factor of the matrix itself, for many right-hand sides: of a matrix nearby, each takes
    /// several refinements more.
    ///
    /// # Errors
    /// [`Singular`] when a pivot vanishes or is not finite.
    pub fn whole(&self) -> Result<&Self, Singular> {
        if self.is_nearby() { self.better() } else { Ok(self) }
    }

    fn better(&self) -> Result<&Self, Singular> {
        let matrix = || Arc::clone(&self.matrix);
        let make =
            || if self.is_nearby() { self.pattern.factor(matrix()) } else { self.pattern.exact_factor(matrix()) };
        self.better.get_or_init(|| make().map(Box::new)).as_deref().map_err(|e| *e)
    }

    /// Solves by refinement; none where it does not contract.
    fn refined(&self, factor: &[f32], right: &[f64]) -> Option<Vec<f64>> {
        let n = self.pattern.unknowns;
        let mut x = vec![0.0; right.len()];
        let mut step: Vec<f32> = right.iter().map(|&v| v as f32).collect();
        let mut last = 1.0;
        for round in 0..REFINEMENT.max_count {
            self.pattern.substitute(factor, &mut step).ok()?;
            let mut change = 0.0f64;
            for (x, step) in x.chunks_exact_mut(n).zip(step.chunks_exact(n)) {
                let (mut moved, mut size) = (0.0, 0.0);
                for (x, step) in x.iter_mut().zip(step) {
                    let step = f64::from(*step);
                    *x += step;
                    moved += step * step;
                    size += *x * *x;
                }
                let part = if moved == 0.0 { 0.0 } else { (moved / size).sqrt() };
                if !part.is_finite() {
                    return None;
                }
                change = change.max(part);
            }
            if change > REFINEMENT.max_contraction.powi(round) {
                return None;
            }
            // What is left is the next change and those after it: each as much smaller as this one
            // is than the last.
            if round > 0 && change * change < REFINEMENT.tolerance * last {
                return Some(x);
            }
            last = change;
            let rest = |((step, x), right): ((&mut [f32], &[f64]), &[f64])| {
                let product = self.pattern.multiply(&self.matrix, x);
                step.iter_mut().zip(right.iter().zip(product)).for_each(|(s, (r, p))| *s = (r - p) as f32);
            };
            step.par_chunks_exact_mut(n).zip(x.par_chunks_exact(n)).zip(right.par_chunks_exact(n)).for_each(rest);
        }
        None
    }
}

/// The node that is eliminated first, then the other.
fn earlier(first: &[u32], a: u32, b: u32) -> (u32, u32) {
    if first[a as usize] < first[b as usize] { (a, b) } else { (b, a) }
}

/// For each node the later nodes it shares an element with, as (first unknown, node), ascending.
fn adjacency(elements: &[u32], per: usize, first: &[u32]) -> Vec<Vec<(u32, u32)>> {
    let mut below: Vec<Vec<(u32, u32)>> = vec![Vec::new(); first.len()];
    for element in elements.chunks_exact(per) {
        for i in 1..per {
            for j in 0..i {
                let (low, high) = earlier(first, element[i], element[j]);
                below[low as usize].push((first[high as usize], high));
            }
        }
    }
    for list in &mut below {
        list.sort_unstable();
        list.dedup();
        list.shrink_to_fit();
    }
    below
}

/// Nodes in the order of elimination.
fn dissection(elements: &[u32], per: usize, places: &[[f64; 3]], width: &[u8]) -> Vec<u32> {
    let centres = elements
        .chunks_exact(per)
        .map(|e| std::array::from_fn(|a| e.iter().map(|&n| places[n as usize][a]).sum::<f64>() / per as f64))
        .collect();
    let mut part: Vec<u32> = (0..(elements.len() / per) as u32).collect();
    let mut used = vec![false; places.len()];
    elements.iter().for_each(|&n| used[n as usize] = true);
    let nodes = (0..places.len() as u32).filter(|&n| used[n as usize]).collect();
    let spans = vec![[0; 2]; places.len()];
    let mut dissection = Dissection { elements, per, centres, width, spans, order: Vec::with_capacity(places.len()) };
    dissection.divide(&mut part, nodes);
    let mut order = dissection.order;
    order.extend((0..places.len() as u32).filter(|&n| !used[n as usize]));
    order
}

/// Normals of the planes that may divide a part: the axes and the diagonals between two of them.
const CUT_DIRECTIONS: [[f64; 3]; 9] = [
    [1.0, 0.0, 0.0],
    [0.0, 1.0, 0.0],
    [0.0, 0.0, 1.0],
    [1.0, 1.0, 0.0],
    [1.0, -1.0, 0.0],
    [1.0, 0.0, 1.0],
    [1.0, 0.0, -1.0],
    [0.0, 1.0, 1.0],
    [0.0, 1.0, -1.0],
];

struct Dissection<'a> {
    elements: &'a [u32],
    per: usize,
    /// Middles of the elements.
    centres: Vec<[f64; 3]>,
    /// Unknowns of each node.
    width: &'a [u8],
    /// First and last of a part's elements, as sorted, that hold a node.
    spans: Vec<[u32; 2]>,
    order: Vec<u32>,
}

impl Dissection<'_> {
    /// The unknowns that each cut between two elements of a sorted part leaves on both sides; cut
    /// `c` comes before element `c`.
    fn cuts(&mut self, part: &[u32], nodes: &[u32]) -> Vec<i64> {
        nodes.iter().for_each(|&n| self.spans[n as usize] = [u32::MAX, 0]);
        for (rank, &e) in part.iter().enumerate() {
            for &n in &self.elements[e as usize * self.per..(e as usize + 1) * self.per] {
                let [first, last] = self.spans[n as usize];
                self.spans[n as usize] = [first.min(rank as u32), last.max(rank as u32)];
            }
        }
        let mut size = vec![0; part.len() + 1];
        for &n in nodes {
            let ([first, last], w) = (self.spans[n as usize], i64::from(self.width[n as usize]));
            size[first as usize + 1] += w;
            size[last as usize + 1] -= w;
        }
        for c in 1..size.len() {
            size[c] += size[c - 1];
        }
        size
    }

    fn divide(&mut self, part: &mut [u32], nodes: Vec<u32>) {
        if nodes.len() <= MAX_LEAF_NODES || part.len() < 2 {
            self.order.extend(nodes);
            return;
        }
        let sort = |part: &mut [u32], centres: &[[f64; 3]], d: &[f64; 3]| {
            let key = |&e: &u32| (0..3).map(|a| d[a] * centres[e as usize][a]).sum::<f64>();
            part.sort_unstable_by(|a, b| key(a).total_cmp(&key(b)).then(a.cmp(b)));
        };
        let middle = 0.5 * part.len() as f64;
        let range = (part.len() / 3).max(1)..(2 * part.len() / 3).max(2).min(part.len());
        let mut best = (f64::INFINITY, 0, part.len() / 2);
        for (direction, d) in CUT_DIRECTIONS.iter().enumerate() {
            sort(part, &self.centres, d);
            let sizes = self.cuts(part, &nodes);
            for c in range.clone() {
                let larger = c.max(part.len() - c) as f64;
                let cost = sizes[c] as f64 * larger / middle;
                if cost < best.0 {
                    best = (cost, direction, c);
                }
            }
        }
        let (_, direction, cut) = best;
        sort(part, &self.centres, &CUT_DIRECTIONS[direction]);
        self.cuts(part, &nodes);
        let spans = &self.spans;
        let pick = |keep: &dyn Fn([u32; 2]) -> bool| {
            nodes.iter().copied().filter(|&n| keep(spans[n as usize])).collect::<Vec<u32>>()
        };
        let cut32 = cut as u32;
        let only_left = pick(&|[_, last]| last < cut32);
        let only_right = pick(&|[first, _]| first >= cut32);
        let both = pick(&|[first, last]| first < cut32 && last >= cut32);
        drop(nodes);
        let (left, right) = part.split_at_mut(cut);
        self.divide(left, only_left);
        self.divide(right, only_right);
        self.order.extend(both);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::numerics::random::Random;

    /// A grid of bilinear-like elements with 3 unknowns on most nodes and 1 on the last ones,
    /// quasi-definite.
    #[test]
    fn a_quasi_definite_system_is_solved_whatever_the_widths() {
        let (nx, ny) = (9, 7);
        let mut places = Vec::new();
        for j in 0..ny {
            for i in 0..nx {
                places.push([i as f64, j as f64, 0.0]);
            }
        }
        let plain = places.len() as u32;
        let mut elements = Vec::new();
        for j in 0..ny - 1 {
            for i in 0..nx - 1 {
                let n = (i + nx * j) as u32;
                let extra = places.len() as u32;
                places.push([i as f64 + 0.5, j as f64 + 0.5, 0.0]);
                elements.extend([n, n + 1, n + nx as u32, n + nx as u32 + 1, extra]);
            }
        }
        let width: Vec<u8> = (0..places.len() as u32).map(|n| if n < plain { 3 } else { 1 }).collect();
        let pattern = Pattern::new(elements.clone(), 5, &places, width).unwrap();
        let side = 13;
        let mut random = Random::new(5, 1);
        let mut values = pattern.zeros();
        let mut dense = vec![0.0; pattern.unknowns() * pattern.unknowns()];
        for e in 0..elements.len() / 5 {
            let mut m = vec![0.0; side * side];
            for i in 0..side {
                for j in 0..i {
                    m[i * side + j] = random.uniform(-1.0, 1.0);
                    m[j * side + i] = m[i * side + j];
                }
                m[i * side + i] = if i < 12 { 20.0 } else { -2.0 };
            }
            pattern.add(&mut values, e, &m, side);
            let at: Vec<usize> = elements[5 * e..5 * e + 5]
                .iter()
                .flat_map(|&n| (0..if n < plain { 3 } else { 1 }).map(move |c| (n, c)))
                .map(|(n, c)| pattern.first(n) + c)
                .collect();
            for i in 0..side {
                for j in 0..side {
                    dense[at[i] * pattern.unknowns() + at[j]] += m[i * side + j];
                }
            }
        }
        let x: Vec<f64> = (0..2 * pattern.unknowns()).map(|_| random.uniform(-1.0, 1.0)).collect();
        let n = pattern.unknowns();
        let mut b: Vec<f64> = Vec::new();
        for column in x.chunks_exact(n) {
            let product = pattern.multiply(&values, column);
            for r in 0..n {
                let exact: f64 = (0..n).map(|c| dense[r * n + c] * column[c]).sum();
                assert!((product[r] - exact).abs() < 1e-11);
            }
            b.extend(product);
        }
        pattern.factorise(values).unwrap().solve(&mut b).unwrap();
        assert!(b.iter().zip(&x).all(|(p, q)| (p - q).abs() < 1e-10));
    }

    /// The matrix of one element of the chain.
    const LINK: [f64; 9] = [4.0, 1.0, 0.5, 1.0, 5.0, 0.2, 0.5, 0.2, 3.0];

    /// Elements of three nodes along a chain with some that reach far.
    fn chain() -> (Vec<u32>, Vec<[f64; 3]>) {
        let places: Vec<[f64; 3]> = (0..40).map(|i| [f64::from(i), f64::from(i * 7 % 5), 0.0]).collect();
        let mut random = Random::new(3, 9);
        let far = |i: u32, random: &mut Random| (i + 2 + random.uniform(0.0, 12.0) as u32).min(39);
        let elements = (0..38).flat_map(|i| [i, i + 1, far(i, &mut random)]).collect();
        (elements, places)
    }

    #[test]
    fn a_cut_leaves_the_unknowns_of_nodes_on_both_sides() {
        let (elements, places) = chain();
        let width: Vec<u8> = (0..40).map(|n| 1 + n % 3).collect();
        let centres = vec![[0.0; 3]; elements.len() / 3];
        let spans = vec![[0; 2]; places.len()];
        let mut dissection =
            Dissection { elements: &elements, per: 3, centres, width: &width, spans, order: Vec::new() };
        let part: Vec<u32> = (0..elements.len() as u32 / 3).collect();
        let nodes: Vec<u32> = (0..40).filter(|n| elements.contains(n)).collect();
        let sizes = dissection.cuts(&part, &nodes);
        for c in 1..part.len() {
            let on = |n: u32, range: std::ops::Range<usize>| elements[3 * range.start..3 * range.end].contains(&n);
            let both = nodes.iter().filter(|&&n| on(n, 0..c) && on(n, c..part.len()));
            let brute: i64 = both.map(|&n| i64::from(width[n as usize])).sum();
            assert_eq!(sizes[c], brute, "{c}");
        }
    }

    #[test]
    fn a_factor_in_memory_used_before_is_as_good_as_the_first() {
        let (elements, places) = chain();
        let pattern = Pattern::new(elements, 3, &places, vec![1; 40]).unwrap();
        let solved = |scale: f64| {
            let mut values = pattern.zeros();
            for e in 0..38 {
                pattern.add(&mut values, e, &LINK.map(|v| scale * v), 3);
            }
            let mut x = vec![1.0; pattern.unknowns()];
            pattern.factorise(values).unwrap().solve(&mut x).unwrap();
            x
        };
        let first = solved(1.0);
        let second = solved(3.0);
        assert_eq!(solved(1.0), first);
        assert!(first.iter().zip(&second).all(|(a, b)| (a - 3.0 * b).abs() < 1e-12));
    }

    /// The chain's matrix with its first nine elements `scale` times as stiff and a spring along an
    /// oblique direction of the first one's unknowns.
    fn chained(pattern: &Pattern, scale: f64, spring: f64) -> Vec<f64> {
        let mut values = pattern.zeros();
        for e in 0..38 {
            let s = if e < 9 { scale } else { 1.0 };
            pattern.add(&mut values, e, &LINK.map(|v| s * v), 3);
        }
        let along = [1.0, 0.7, 0.3];
        pattern.add(&mut values, 0, &std::array::from_fn::<f64, 9, _>(|i| spring * along[i / 3] * along[i % 3]), 3);
        values
    }

    /// Largest error of the solution of a system whose solution is known, and whether a better
    /// factor was needed.
    fn error(pattern: &Pattern, factor: &Factor<'_>, values: &[f64]) -> (f64, bool) {
        let truth: Vec<f64> = (0..pattern.unknowns()).map(|i| (1.3 * i as f64).sin()).collect();
        let mut x = [pattern.multiply(values, &truth), vec![0.0; pattern.unknowns()]].concat();
        factor.solve(&mut x).unwrap();
        let (x, zero) = x.split_at(pattern.unknowns());
        assert!(zero.iter().all(|v| *v == 0.0));
        let worst = x.iter().zip(&truth).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        (worst, factor.better.get().is_some())
    }

    #[test]
    fn the_factor_of_a_matrix_nearby_serves_and_one_too_far_away_is_replaced() {
        let (elements, places) = chain();
        let pattern = Pattern::new(elements, 3, &places, vec![1; 40]).unwrap();
        for (scale, replaced) in [(1.0, false), (1.2, false), (5.0, true)] {
            let moved = chained(&pattern, scale, 0.0);
            let factor = pattern.factorise(chained(&pattern, 1.0, 0.0)).unwrap().near(moved.clone());
            let (worst, better) = error(&pattern, &factor, &moved);
            assert!(worst < 1e-6 && better == replaced, "{scale}: {worst} {better}");
        }
    }

    #[test]
    fn what_single_precision_cannot_hold_is_factorised_in_double() {
        let (elements, places) = chain();
        let pattern = Pattern::new(elements, 3, &places, vec![1; 40]).unwrap();
        for (spring, replaced) in [(0.0, false), (1e5, false), (1e10, true)] {
            let values = chained(&pattern, 1.0, spring);
            let (worst, better) = error(&pattern, &pattern.factorise(values.clone()).unwrap(), &values);
            // Single precision alone would be off by 10^-7 times the spring.
            assert!(worst < 1e-6 && better == replaced, "{spring}: {worst} {better}");
        }
    }

    /// Cubes of eight nodes with three unknowns each, `n` along an edge.
    fn cubes(n: u32) -> (Vec<u32>, Vec<[f64; 3]>) {
        let at = |i: u32, j: u32, k: u32| i + (n + 1) * (j + (n + 1) * k);
        let corners = |c: u32| {
            let (i, j, k) = (c % n, c / n % n, c / n / n);
            (0..8u32).map(move |m| at(i + m % 2, j + m / 2 % 2, k + m / 4))
        };
        let places =
            (0..(n + 1).pow(3)).map(|p| [p % (n + 1), p / (n + 1) % (n + 1), p / (n + 1).pow(2)].map(f64::from));
        ((0..n.pow(3)).flat_map(corners).collect(), places.collect())
    }

    /// Symmetric, positive definite matrices of the cubes.
    fn stiff(pattern: &Pattern, elements: usize) -> Vec<f64> {
        let mut values = pattern.zeros();
        let mut random = Random::new(8, 2);
        for e in 0..elements {
            let mut m = vec![0.0; 24 * 24];
            for (i, j) in (0..24).flat_map(|i| (0..i).map(move |j| (i, j))) {
                m[i * 24 + j] = random.uniform(-1.0, 1.0);
                m[j * 24 + i] = m[i * 24 + j];
            }
            (0..24).for_each(|i| m[i * 25] = 14.0);
            pattern.add(&mut values, e, &m, 24);
        }
        values
    }

    #[test]
    fn a_factor_renewed_where_its_matrix_changed_is_that_of_the_new_matrix() {
        let (elements, places) = cubes(9);
        let last: Vec<u32> = (0..places.len() as u32).filter(|&n| places[n as usize][2] == 9.0).collect();
        let count = elements.len() / 8;
        let pattern = Pattern::new(elements, 8, &places, vec![3; places.len()]).unwrap();
        let pattern = pattern.eliminating_last(&last).unwrap();
        assert_eq!(last.iter().map(|&n| pattern.first(n)).min(), Some(pattern.unknowns() - 3 * last.len()));
        let before = stiff(&pattern, count);
        let pressed = |nodes: &[u32], spring: f64| {
            let mut out = before.clone();
            nodes.iter().for_each(|&n| pattern.add_at_node(&mut out, n, 2, 2, spring));
            out
        };
        let single = |factor: &Factor<'_>| match &factor.values {
            Values::Single(values) => values.clone(),
            Values::Double(_) => panic!("double precision"),
        };
        let after = pressed(&last[20..70], 300.0);
        // The tail alone, number by number.
        let whole = single(&pattern.factorise(after.clone()).unwrap());
        let mut renewed = single(&pattern.factorise(before.clone()).unwrap());
        let tail = pattern.tail.as_ref().unwrap();
        let at = |n: u32| (pattern.first(n) + 2, pattern.first(n) + 2, 300.0);
        tail.renew(pattern.symbolic().unwrap(), &mut renewed, last[20..70].iter().map(|&n| at(n))).unwrap();
        let off =
            |a: &[f32], b: &[f32]| a.iter().zip(b).fold(0.0f32, |m, (a, b)| m.max((a - b).abs() / (1.0 + b.abs())));
        assert!(off(&renewed, &whole) < 1e-5, "{}", off(&renewed, &whole));
        // Where it changed elsewhere as well all is worked out anew, and a spring that comes and
        // goes leaves nothing behind.
        for matrix in [after, pressed(&[5, last[40]], 300.0), pressed(&[], 0.0)] {
            let factor = pattern.factorise(before.clone()).unwrap();
            let factor =
                factor.renewed(pressed(&last[..50], 40.0), false).unwrap().renewed(matrix.clone(), false).unwrap();
            let (worst, better) = error(&pattern, &factor, &matrix);
            assert!(worst < 1e-9 && !better, "{worst} {better}");
            let whole = single(&pattern.factorise(matrix).unwrap());
            assert!(off(&single(&factor), &whole) < 1e-4, "{}", off(&single(&factor), &whole));
        }
        // Near elsewhere, the end is that of the new matrix and refinement does the rest; too far
        // away it is replaced.
        let truth: Vec<f64> = (0..pattern.unknowns()).map(|i| (1.3 * i as f64).sin()).collect();
        for (scale, replaced) in [(1.1, false), (8.0, true)] {
            let mut matrix: Vec<f64> = before.iter().map(|v| scale * v).collect();
            last.iter().for_each(|&n| pattern.add_at_node(&mut matrix, n, 2, 2, 300.0));
            let mut factor = pattern.factorise(before.clone()).unwrap().renewed(matrix.clone(), true).unwrap();
            assert!(factor.is_nearby());
            let mut x = pattern.multiply(&matrix, &truth);
            factor.solve_or_replace(&mut x).unwrap();
            let worst = x.iter().zip(&truth).fold(0.0, |m: f64, (a, b)| m.max((a - b).abs()));
            assert!(worst < 1e-5 && factor.is_nearby() != replaced, "{scale}: {worst}");
            let (worst, _) = error(&pattern, factor.whole().unwrap(), &matrix);
            assert!(worst < 1e-9, "{worst}");
        }
    }
}
