//! The forward problem: displacement and pressure of a body whose surface is held and pressed in
//! places.
//!
//! Prescribed displacements are ties, springs 10^6 times as stiff as the tissue around them (a tied
//! node misses its place by about 10^-6 of an element's size times the strain; stiffer ones would
//! leave nothing of the tissue in single precision); the rest of the surface is free of traction.
//! Newton's method on the mixed residual; the linear law takes one step.

use crate::error::StiffnessError;
use crate::stiffness::contact::Plate;
use crate::stiffness::fem_body::{Body, ELEMENT_UNKNOWNS};
use crate::stiffness::law::{Material, residual, residual_by_modulus, tangent};
use crate::stiffness::tangent::{Matrix, Tangent};
use crate::types::stiffness::Law;
use rayon::prelude::*;

/// Stiffness of a tie over that of the tissue around it.
const TIE_STIFFNESS_RATIO: f64 = 1e6;
/// Most Newton steps for one load.
const MAX_NEWTON_STEPS: usize = 25;
/// How long a tangent is kept; distances are from a solution, over the largest displacement.
struct TangentReuse {
    /// Largest step over the one before.
    max_contraction: f64,
    /// Distance up to which it serves for derivatives: about their relative error.
    derivative_distance: f64,
    /// Distance up to which its factor still refines solutions quickly.
    refinable_distance: f64,
}

const TANGENT_REUSE: TangentReuse =
    TangentReuse { max_contraction: 0.4, derivative_distance: 0.01, refinable_distance: 0.2 };

/// Elements computed together.
const ELEMENTS_PER_CHUNK: usize = 256;

/// A node whose displacement is prescribed along a direction, or wholly.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tie {
    /// The node.
    pub node: u32,
    /// The unit vector along which it is prescribed; none for all three components.
    pub direction: Option<[f64; 3]>,
    /// The displacement (mm).
    pub target: [f64; 3],
    /// Spring constant over that of a firm tie (1): 1 to prescribe, far less to hold a body that
    /// would else slip away.
    pub strength: f64,
}

impl Tie {
    /// The part of component `b` of a pull that acts along component `a`.
    pub fn along(&self, a: usize, b: usize) -> f64 {
        self.direction.map_or(f64::from(u8::from(a == b)), |n| n[a] * n[b])
    }
}

/// A solution: unknowns, and the tangent factorised at (or just before) it.
#[derive(Debug)]
pub struct Solution<'a> {
    /// Displacements and pressures (see [`Body::displacement`]).
    pub x: Vec<f64>,
    /// The factorised tangent.
    pub factor: Tangent<'a>,
    /// Factorisations that it took.
    pub factorisations: usize,
}

/// One forward problem.
#[derive(Debug, Clone)]
pub struct Problem<'a> {
    /// The body.
    pub body: &'a Body,
    /// The law.
    pub law: Law,
    /// The material of each element.
    pub materials: Vec<Material>,
    /// Prescribed displacements.
    pub ties: Vec<Tie>,
    /// Spring constant of a firm tie to each node (kPa mm).
    pub springs: Vec<f64>,
    /// A plate that nothing goes through.
    pub plate: Option<Plate>,
}

impl<'a> Problem<'a> {
    /// A problem with the spring constants that go with the element size and the stiffest element
    /// at each node.
    pub fn new(body: &'a Body, law: Law, materials: Vec<Material>, ties: Vec<Tie>) -> Self {
        let mut springs = vec![0.0f64; body.places.len()];
        for (cell, material) in body.cells.iter().zip(&materials) {
            let spring = TIE_STIFFNESS_RATIO * material.mu * body.element_size();
            cell.iter().for_each(|&n| springs[n as usize] = springs[n as usize].max(spring));
        }
        Self { body, law, materials, ties, springs, plate: None }
    }

    fn spring(&self, tie: &Tie) -> f64 {
        self.springs[tie.node as usize] * tie.strength
    }

    /// Brings its plate to a height (mm).
    pub(crate) fn lowered(&mut self, height: f64) -> &Self {
        self.plate.iter_mut().for_each(|p| p.height = height);
        self
    }

    /// Force (kPa mm^2) with which a tie pulls its node.
    pub fn pull(&self, tie: &Tie, x: &[f64]) -> [f64; 3] {
        let u = self.body.displacement(x, tie.node);
        let k = self.spring(tie);
        let gap: [f64; 3] = std::array::from_fn(|a| tie.target[a] - u[a]);
        match tie.direction {
            None => gap.map(|g| k * g),
            Some(n) => {
                let along = k * (gap[0] * n[0] + gap[1] * n[1] + gap[2] * n[2]);
                n.map(|v| along * v)
            }
        }
    }

    /// Internal forces less the ties'; none where an element turns inside out.
    pub fn residual(&self, x: &[f64]) -> Option<Vec<f64>> {
        let body = self.body;
        let mut out = vec![0.0; body.pattern.unknowns()];
        let one = |e: usize| residual(self.law, &body.quadrature[e], self.materials[e], &body.gather(x, e));
        let count = body.cells.len();
        for start in (0..count).step_by(16 * ELEMENTS_PER_CHUNK) {
            let part: Vec<_> = (start..(start + 16 * ELEMENTS_PER_CHUNK).min(count)).into_par_iter().map(one).collect();
            for (e, r) in part.into_iter().enumerate() {
                body.scatter(&mut out, start + e, &r?);
            }
        }
        for tie in &self.ties {
            let (at, pull) = (body.pattern.first(tie.node), self.pull(tie, x));
            (0..3).for_each(|a| out[at + a] -= pull[a]);
        }
        if let Some(plate) = &self.plate {
            plate.push(body, x, &mut out);
        }
        Some(out)
    }

    /// The derivative of the residual with respect to ln mu of the elements of which `of` holds.
    pub fn residual_by_modulus(
        &self,
        x: &[f64],
        of: impl Fn(usize) -> bool + Sync,
    ) -> Result<Vec<f64>, StiffnessError> {
        let body = self.body;
        let mut out = vec![0.0; body.pattern.unknowns()];
        let chosen: Vec<usize> = (0..body.cells.len()).filter(|&e| of(e)).collect();
        let one = |&e: &usize| {
            residual_by_modulus(self.law, &body.quadrature[e], self.materials[e], &body.gather(x, e)).map(|r| (e, r))
        };
        for part in chosen.chunks(16 * ELEMENTS_PER_CHUNK) {
            let done: Option<Vec<(usize, [f64; ELEMENT_UNKNOWNS])>> = part.par_iter().map(one).collect();
            for (e, r) in done.ok_or(StiffnessError::InsideOut)? {
                body.scatter(&mut out, e, &r);
            }
        }
        Ok(out)
    }

    /// The tangent at `x`.
    fn tangent(&self, x: &[f64]) -> Option<Matrix> {
        let body = self.body;
        let mut values = body.pattern.zeros();
        let mut levels =
            body.levels.as_ref().map(|l| (l, l.zeros(self.springs.iter().map(|k| k / TIE_STIFFNESS_RATIO).collect())));
        let one = |e: usize| tangent(self.law, &body.quadrature[e], self.materials[e], &body.gather(x, e));
        let count = body.cells.len();
        for start in (0..count).step_by(ELEMENTS_PER_CHUNK) {
            let part: Vec<_> = (start..(start + ELEMENTS_PER_CHUNK).min(count)).into_par_iter().map(one).collect();
            for (e, k) in part.into_iter().enumerate() {
                let (e, k) = (start + e, k?);
                body.pattern.add(&mut values, e, &k[..], ELEMENT_UNKNOWNS);
                if let Some((mesh, levels)) = &mut levels {
                    mesh.add(levels, e, &k[..], self.materials[e].poisson);
                }
            }
        }
        for tie in &self.ties {
            let k = self.spring(tie);
            for (r, c) in (0..3).flat_map(|r| (0..=r).map(move |c| (r, c))) {
                body.pattern.add_at_node(&mut values, tie.node, r, c, k * tie.along(r, c));
            }
            if let Some((mesh, levels)) = &mut levels {
                mesh.tie(levels, tie, body.pattern.first(tie.node), k);
            }
        }
        if let Some(plate) = &self.plate {
            plate.stiffen(body, x, |e, k| {
                body.pattern.add(&mut values, e, k, ELEMENT_UNKNOWNS);
                if let Some((mesh, levels)) = &mut levels {
                    mesh.add(levels, e, k, 0.0);
                }
            });
        }
        Some(Matrix { values, levels: levels.map(|l| l.1) })
    }

    /// Factorises the tangent at `x`.
    ///
    /// # Errors
    /// [`StiffnessError`] when an element is inside out or the body can move freely.
    pub fn factorise(&self, x: &[f64]) -> Result<Tangent<'a>, StiffnessError> {
        self.factor_of(self.tangent(x).ok_or(StiffnessError::InsideOut)?)
    }

    fn factor_of(&self, matrix: Matrix) -> Result<Tangent<'a>, StiffnessError> {
        Tangent::new(self.body, matrix).map_err(|_| StiffnessError::Unsolvable)
    }

    /// Solves, from `start` where one is given. `precision` (mm) ends Newton's method.
    ///
    /// # Errors
    /// [`StiffnessError`] when no equilibrium is found.
    pub fn solve(&self, start: Option<&[f64]>, precision: f64) -> Result<Solution<'a>, StiffnessError> {
        self.reach(start, precision, TANGENT_REUSE.derivative_distance)
    }

    /// Solves by Newton's method from a solution nearby. `precision` (mm) ends it.
    ///
    /// # Errors
    /// [`StiffnessError`] when it does not converge.
    pub fn near(&self, start: &[f64], precision: f64) -> Result<Vec<f64>, StiffnessError> {
        Ok(self.newton(start.to_vec(), precision, f64::INFINITY)?.x)
    }

    /// Whether it is one linear system: a plate that is touched here and there makes it none.
    pub(crate) fn is_linear(&self) -> bool {
        self.law == Law::Linear && self.plate.is_none()
    }

    /// Solves a linear problem with the tangent that is made for its matrix, from `start` where
    /// that saves iterations.
    ///
    /// # Errors
    /// [`StiffnessError`] when the body can move freely.
    pub(crate) fn solve_with(
        &self,
        start: Option<&[f64]>,
        factor: impl FnOnce(Matrix) -> Result<Tangent<'a>, StiffnessError>,
    ) -> Result<Solution<'a>, StiffnessError> {
        let zero = vec![0.0; self.body.pattern.unknowns()];
        let mut x = self.residual(&zero).ok_or(StiffnessError::InsideOut)?;
        x.iter_mut().for_each(|v| *v = -*v);
        let factor = factor(self.tangent(&zero).ok_or(StiffnessError::InsideOut)?)?;
        factor.solve(&mut x, start).map_err(|_| StiffnessError::Unsolvable)?;
        Ok(Solution { x, factor, factorisations: 1 })
    }

    fn reach(&self, start: Option<&[f64]>, precision: f64, stale: f64) -> Result<Solution<'a>, StiffnessError> {
        if self.is_linear() {
            return self.solve_with(start, |matrix| self.factor_of(matrix));
        }
        if let Some(done) = start.and_then(|s| self.newton(s.to_vec(), precision, stale).ok()) {
            return Ok(done);
        }
        let mut x = vec![0.0; self.body.pattern.unknowns()];
        let (mut reached, mut step) = (0.0, 1.0f64);
        loop {
            let next = (reached + step).min(1.0);
            let mut part = self.clone();
            part.ties.iter_mut().for_each(|t| t.target = t.target.map(|v| v * next));
            part.plate = self.plate.as_ref().map(|p| p.approaching(self.body, next));
            match part.newton(x.clone(), if next < 1.0 { 1e-3 } else { precision }, stale) {
                Ok(done) if next >= 1.0 => return Ok(done),
                Ok(done) => {
                    x = done.x;
                    reached = next;
                }
                Err(error) if step < 0.06 => return Err(error),
                Err(_) => step *= 0.5,
            }
        }
    }

    /// Solves from `start` by steps with the factorised tangent of a problem nearby (the chord
    /// method); none where these do not contract. `precision` (mm) ends it.
    pub(crate) fn solve_near(&self, start: &[f64], factor: &Tangent<'_>, precision: f64) -> Option<Vec<f64>> {
        let (mut x, mut last) = (start.to_vec(), f64::INFINITY);
        for _ in 0..MAX_NEWTON_STEPS {
            let mut step = self.residual(&x)?;
            step.iter_mut().for_each(|v| *v = -*v);
            factor.step(&mut step).ok()?;
            x.iter_mut().zip(&step).for_each(|(v, s)| *v += s);
            let size = self.size(&step);
            if size < precision {
                return Some(x);
            }
            if size > 0.5 * last {
                return None;
            }
            last = size;
        }
        None
    }

    /// The largest component of a displacement (mm).
    fn size(&self, x: &[f64]) -> f64 {
        let all = (0..self.body.places.len() as u32).flat_map(|n| self.body.displacement(x, n));
        all.fold(0.0, |m: f64, v| m.max(v.abs()))
    }

    /// Newton's method that keeps a factorised tangent as long as it contracts. One that is further
    /// than `stale` (of the largest displacement) from the solution is factorised again at the end.
    fn newton(&self, mut x: Vec<f64>, precision: f64, stale: f64) -> Result<Solution<'a>, StiffnessError> {
        let mut factor = Some(self.factorise(&x)?);
        let (mut factorisations, mut last, mut fresh) = (1, f64::INFINITY, true);
        // Since the tangent, and since its factor was made as a whole.
        let (mut moved, mut far) = (0.0, 0.0);
        for steps in 1..=MAX_NEWTON_STEPS {
            let Some(tangent) = &mut factor else { break };
            let mut step = self.residual(&x).ok_or(StiffnessError::InsideOut)?;
            step.iter_mut().for_each(|v| *v = -*v);
            tangent.solve_or_replace(&mut step).map_err(|_| StiffnessError::Unsolvable)?;
            let size = self.size(&step);
            // What comes into touch and goes out of it by turns is met halfway.
            let swings = self.plate.is_some() && steps > 3 && size > (0.7 * last).max(precision);
            let mut part = if swings { 0.5 } else { 1.0 };
            x = loop {
                let trial: Vec<f64> = x.iter().zip(&step).map(|(a, b)| a + part * b).collect();
                if self.residual(&trial).is_some() {
                    break trial;
                }
                part *= 0.5;
                if part < 1e-3 {
                    return Err(StiffnessError::InsideOut);
                }
            };
            (moved, far) = (moved + part * size, far + part * size);
            let done =
                part == 1.0 && (size < precision || (size < 1e-3 && size * size / last.max(1e-300) < 0.1 * precision));
            if steps > 4 && size > 2.0 * last {
                break;
            }
            // Where a contact changes, yesterday's tangent leads astray.
            let slow = part < 1.0 || self.plate.is_some() || (!fresh && size > TANGENT_REUSE.max_contraction * last);
            let stale = moved > stale * self.size(&x);
            fresh = if done { stale } else { slow };
            if fresh {
                // Another contact is another matrix, except where it alone is worked out anew.
                let near =
                    far < TANGENT_REUSE.refinable_distance * self.size(&x) && (done || self.body.pattern.renews());
                let matrix = self.tangent(&x).ok_or(StiffnessError::InsideOut)?;
                let renewed = factor.map(|f| f.renewed(self.body, matrix, near)).transpose();
                factor = renewed.map_err(|_| StiffnessError::Unsolvable)?;
                moved = 0.0;
                if !near {
                    (factorisations, far) = (factorisations + 1, 0.0);
                }
            }
            if let Some(factor) = factor.take_if(|_| done) {
                return Ok(Solution { x, factor, factorisations });
            }
            last = size;
        }
        Err(StiffnessError::NoEquilibrium)
    }
}
