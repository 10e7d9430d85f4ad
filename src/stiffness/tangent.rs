//! A tangent ready to be solved with: factorised, or where that is too large by iterations.

use crate::numerics::sparse::{Factor, Singular};
use crate::stiffness::fem_body::Body;
use crate::stiffness::saddle::{Levels, Saddle};
use rayon::prelude::*;

/// Relative errors (weighted 2-norm) of iterative solutions.
struct Tolerances {
    /// A solution.
    solution: f64,
    /// A step of Newton's method: the solution is off by this part of the last step.
    newton_step: f64,
    /// A sensitivity, which is needed to a few per cent.
    sensitivity: f64,
    /// A step whose residual is then computed exactly.
    corrected_step: f64,
}

const TOLERANCE: Tolerances = Tolerances { solution: 1e-7, newton_step: 1e-3, sensitivity: 1e-3, corrected_step: 1e-2 };

/// Right-hand sides solved together: the factor is read once for all of them.
const RHS_PER_SOLVE: usize = 32;

/// The values of a tangent in a body's pattern, and on both levels of a large body.
#[derive(Debug)]
pub struct Matrix {
    /// See [`crate::numerics::sparse::Pattern::add`].
    pub values: Vec<f64>,
    /// On both levels of a body that is solved by iterations.
    pub levels: Option<Levels>,
}

/// See [`Factor`], whose methods these are.
#[derive(Debug)]
pub enum Tangent<'a> {
    /// By a factor.
    Direct(Box<Factor<'a>>),
    /// By iterations.
    Iterative(Box<Saddle<'a>>),
}

impl<'a> Tangent<'a> {
    /// Of a matrix of the body.
    ///
    /// # Errors
    /// [`Singular`] when the body can move freely.
    pub fn new(body: &'a Body, matrix: Matrix) -> Result<Self, Singular> {
        Ok(match (&body.levels, matrix.levels) {
            (Some(levels), Some(own)) => {
                Self::Iterative(Box::new(Saddle::new(&body.pattern, levels, matrix.values, own)?))
            }
            _ => Self::Direct(Box::new(body.pattern.factorise(matrix.values)?)),
        })
    }

    /// Solves for a right-hand side; iterations begin at `start`, if one is given.
    ///
    /// # Errors
    /// [`Singular`] where the solution is not finite or not reached.
    pub fn solve(&self, x: &mut [f64], start: Option<&[f64]>) -> Result<(), Singular> {
        match self {
            Self::Direct(factor) => factor.solve(x),
            Self::Iterative(saddle) => saddle.solve(x, start, TOLERANCE.solution),
        }
    }

    /// Solves for the right-hand sides of sensitivities, one after the other in `x`; iterations
    /// begin at `start`, if one is given.
    ///
    /// # Errors
    /// As [`Self::solve`].
    pub fn sensitivities(&self, x: &mut [f64], start: Option<&[f64]>) -> Result<(), Singular> {
        match self {
            Self::Direct(factor) => factor.solve(x),
            Self::Iterative(saddle) => saddle.solve(x, start, TOLERANCE.sensitivity),
        }
    }

    /// See [`Factor::solve_or_replace`].
    ///
    /// # Errors
    /// As [`Self::solve`].
    pub(crate) fn solve_or_replace(&mut self, x: &mut [f64]) -> Result<(), Singular> {
        match self {
            Self::Direct(factor) => factor.solve_or_replace(x),
            Self::Iterative(saddle) => saddle.solve(x, None, TOLERANCE.newton_step),
        }
    }

    /// See [`Factor::step`].
    ///
    /// # Errors
    /// As [`Self::solve`].
    pub fn step(&self, x: &mut [f64]) -> Result<(), Singular> {
        match self {
            Self::Direct(factor) => factor.step(x),
            Self::Iterative(saddle) => saddle.solve(x, None, TOLERANCE.corrected_step),
        }
    }

    /// See [`Factor::near`].
    ///
    /// # Errors
    /// [`Singular`] when a node can move freely.
    pub fn near(self, matrix: Matrix) -> Result<Self, Singular> {
        Ok(match (self, matrix.levels) {
            (Self::Direct(factor), _) => Self::Direct(Box::new(factor.near(matrix.values))),
            (Self::Iterative(saddle), own) => {
                Self::Iterative(Box::new(saddle.near(matrix.values, own.ok_or(Singular)?)?))
            }
        })
    }

    /// See [`Factor::renewed`].
    ///
    /// # Errors
    /// As [`Self::new`].
    pub(crate) fn renewed(self, body: &'a Body, matrix: Matrix, near: bool) -> Result<Self, Singular> {
        match self {
            Self::Direct(factor) => Ok(Self::Direct(Box::new(factor.renewed(matrix.values, near)?))),
            Self::Iterative(_) if near => self.near(matrix),
            Self::Iterative(saddle) => {
                // Its memory is the next one's.
                drop(saddle);
                Self::new(body, matrix)
            }
        }
    }

    /// Solves for hundreds of right-hand sides, each of `n` numbers, in parallel and to about five
    /// digits.
    ///
    /// # Errors
    /// As [`Self::solve`].
    pub fn many(&self, x: &mut [f64], n: usize) -> Result<(), Singular> {
        match self {
            Self::Direct(factor) => {
                let whole = factor.whole()?;
                x.par_chunks_mut(RHS_PER_SOLVE * n).map(|part| whole.step(part)).collect()
            }
            Self::Iterative(_) => self.sensitivities(x, None),
        }
    }
}
