//! The end of a factor, renewed where its matrix changed there alone.
//!
//! Of A = L D L^T, eliminated in order, the last columns of L see the rest of A only through their
//! Schur complement S = L_t D_t L_t^T. A change of A within these columns and rows is the same
//! change of S. So S is put together from the factor, changed and factorised as a dense matrix: the
//! work of m^3 for m columns, whatever the size of A.

use crate::numerics::sparse::Singular;
use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::ldlt::factor::{cholesky_in_place, cholesky_in_place_scratch};
use faer::linalg::matmul::triangular::{BlockStructure, matmul};
use faer::sparse::linalg::cholesky::supernodal::SymbolicSupernodalCholesky;
use faer::sparse::linalg::cholesky::{SymbolicCholesky, SymbolicCholeskyRaw};
use faer::{Accum, Mat, Par};

/// Cost of a partial refactorisation over that of a whole one, beyond which the whole one is done.
const MAX_RENEWAL_COST: f64 = 0.5;

/// The last columns of a factor.
#[derive(Debug)]
pub(super) struct Tail {
    /// The first column.
    first: usize,
    /// The supernode that holds it.
    from: usize,
}

impl Tail {
    /// The last `columns` columns; none where there are none, or so large a number that the whole
    /// factor takes hardly more work, or the factor is not made of supernodes.
    pub fn of(symbolic: &SymbolicCholesky<u32>, columns: usize) -> Option<Self> {
        let supernodes = supernodes(symbolic).filter(|_| columns > 0)?;
        let whole: f64 = (0..supernodes.n_supernodes())
            .map(|s| {
                let [begin, end] = ends(supernodes, s);
                let below = supernodes.supernode(s).pattern().len();
                (begin..end).map(|column| ((end - column + below) as f64).powi(2)).sum::<f64>()
            })
            .sum();
        // Put together and factorised again, a third of the cube each.
        if 2.0 / 3.0 * (columns as f64).powi(3) > MAX_RENEWAL_COST * whole {
            return None;
        }
        let first = symbolic.ncols() - columns;
        Some(Self { first, from: supernodes.supernode_end().partition_point(|&end| end as usize <= first) })
    }

    /// The first column.
    pub fn first(&self) -> usize {
        self.first
    }

    /// Adds `changes` (row, column, value; of the lower triangle, from [`Self::first`] on) to the
    /// matrix of which `values` is the factor.
    ///
    /// # Errors
    /// [`Singular`] when a pivot vanishes; the factor is spoilt then.
    pub(crate) fn renew(
        &self,
        symbolic: &SymbolicCholesky<u32>,
        values: &mut [f32],
        changes: impl Iterator<Item = (usize, usize, f32)>,
    ) -> Result<(), Singular> {
        let supernodes = supernodes(symbolic).ok_or(Singular)?;
        let side = symbolic.ncols() - self.first;
        let mut lower = Mat::<f32>::zeros(side, side);
        self.each(supernodes, |at, row, column| lower[(row, column)] = values[at]);
        let mut scaled = lower.clone();
        for column in 0..side {
            let pivot = lower[(column, column)];
            (column + 1..side).for_each(|row| scaled[(row, column)] *= pivot);
        }
        let mut complement = Mat::<f32>::zeros(side, side);
        let (ours, theirs) = (BlockStructure::TriangularLower, BlockStructure::UnitTriangularUpper);
        matmul(&mut complement, ours, Accum::Replace, &scaled, ours, lower.transpose(), theirs, 1.0, Par::Seq);
        for (row, column, value) in changes {
            complement[(row - self.first, column - self.first)] += value;
        }
        let scratch = cholesky_in_place_scratch::<f32>(side, Par::Seq, Default::default());
        let mut stack = MemBuffer::try_new(scratch).map_err(|_| Singular)?;
        let (whole, stack) = (complement.as_mut(), MemStack::new(&mut stack));
        cholesky_in_place(whole, Default::default(), Par::Seq, stack, Default::default()).map_err(|_| Singular)?;
        self.each(supernodes, |at, row, column| values[at] = complement[(row, column)]);
        Ok(())
    }

    /// Calls `with` for each number of the tail in a factor: where it is kept, and its row and
    /// column (from the first of the tail on).
    fn each(&self, supernodes: &SymbolicSupernodalCholesky<u32>, mut with: impl FnMut(usize, usize, usize)) {
        for s in self.from..supernodes.n_supernodes() {
            let [begin, end] = ends(supernodes, s);
            // Column by column the square on the diagonal as a whole, then the rows below.
            let (below, start) = (supernodes.supernode(s).pattern(), supernodes.col_ptr_for_val()[s] as usize);
            for column in begin.max(self.first)..end {
                let at = start + (column - begin) * (end - begin + below.len());
                (column..end).for_each(|row| with(at + row - begin, row - self.first, column - self.first));
                let at = at + end - begin;
                (0..below.len()).for_each(|k| with(at + k, below[k] as usize - self.first, column - self.first));
            }
        }
    }
}

/// The first column of a supernode, and that after its last.
fn ends(supernodes: &SymbolicSupernodalCholesky<u32>, s: usize) -> [usize; 2] {
    [supernodes.supernode_begin(), supernodes.supernode_end()].map(|ends| ends[s] as usize)
}

fn supernodes(symbolic: &SymbolicCholesky<u32>) -> Option<&SymbolicSupernodalCholesky<u32>> {
    match symbolic.raw() {
        SymbolicCholeskyRaw::Supernodal(supernodes) => Some(supernodes),
        SymbolicCholeskyRaw::Simplicial(_) => None,
    }
}
