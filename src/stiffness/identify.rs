//! Gauss-Newton on the logarithms of the regions' shear moduli and on the motion of the plates.
//!
//! Unknowns are theta_r = ln(mu_r / mu_reference) and six (sliding: three) numbers for each plate.
//! The misfit is the sum of Huber's rho over the observations, (H u - d) / sigma. One factorisation
//! an iteration gives all sensitivities exactly: A y = -dR/dtheta for a modulus, A y = K b for a
//! plate's motion b tied by springs K; the rows of the Jacobian are H y.

use crate::error::StiffnessError;
use crate::numerics::cholesky::{Cholesky, within};
use crate::numerics::statistics::percentile;
use crate::stiffness::boundary_conditions::{Patch, travel};
use crate::stiffness::fem_body::Body;
use crate::stiffness::forward::{Problem, Solution, Tie};
use crate::stiffness::geometry::Part;
use crate::stiffness::law::Material;
use crate::stiffness::observations::Observation;
use crate::stiffness::tangent::Tangent;
use crate::types::space::{dot, length};
use crate::types::stiffness::{Contact, Law};

/// Iteration control of the identification; moduli in ln E or ln mu.
struct StepControl {
    /// Largest step (and plate motion over its travel) that is taken to first order: that omits
    /// 0.1 %.
    max_linear: f64,
    /// Largest change of a modulus with which a tangent serves: about the relative error of
    /// sensitivities.
    same_tangent: f64,
    /// The same under the linear law, where the tangent's factor only refines exact solutions.
    linear_tangent: f64,
    /// Least relative reduction of the squares (a third of a standard deviation): otherwise moduli
    /// that the data do not determine drift.
    min_gain: f64,
    /// Largest change of a modulus in one step: contrasts of 0.02 to 600 converged from 1, in fewer
    /// steps than with half of it.
    max_change: f64,
    /// Change of a modulus beyond which forward solutions may be coarse.
    coarse_change: f64,
    /// Tolerance of a coarse forward solution over the final one.
    coarse_tolerance_ratio: f64,
    /// Largest contrast to the reference (ln 200): a region beyond is as good as rigid or empty.
    max_log_contrast: f64,
}

const STEP: StepControl = StepControl {
    max_linear: 0.03,
    same_tangent: 0.05,
    linear_tangent: 0.2,
    min_gain: 1e-4,
    max_change: 3.0,
    coarse_change: 0.3,
    coarse_tolerance_ratio: 30.0,
    max_log_contrast: 5.3,
};

/// Huber's constant (Huber 1981: 95 % efficiency for normal errors), in root mean square lengths of
/// three components.
const HUBER_THRESHOLD: f64 = 1.345;
/// Prior standard deviation of ln mu: weak, it only holds moduli that the data do not determine.
const PRIOR_SD_LN: f64 = 5.0;
/// Blocks of the body over which the covariance sums residuals.
const COVARIANCE_BLOCKS: f64 = 160.0;
/// Median length of a vector of three independent unit normal numbers.
const MAXWELL_MEDIAN: f64 = 1.538;

/// What is to be identified, on one mesh.
#[derive(Debug, Clone)]
pub struct Setup<'a> {
    /// The body.
    pub body: &'a Body,
    /// The law.
    pub law: Law,
    /// Poisson's ratio of each region.
    pub poisson: Vec<f64>,
    /// Held and loaded patch, then the others.
    pub patches: Vec<Patch>,
    /// What was measured.
    pub observations: &'a [Observation],
    /// The region whose modulus is 1.
    pub reference: usize,
    /// Standard deviation of the prior of the plates' motion about the fitted one (mm).
    pub plate_prior: f64,
    /// The model's own error (in units of the observations' sigma): no residual is taken to be
    /// smaller.
    pub floor: f64,
    /// Noise of an observation (mm, one component), where it is known apart from what the model
    /// leaves over.
    pub noise: Option<f64>,
    /// Parts of the shape that are open, and how far each has been moved outwards (voxels).
    pub open: &'a [(Part, f64)],
    /// Whether moving them further was found to explain the data worse.
    pub settled: bool,
    /// Regions whose ln(mu / mu_reference) is not free, and its values.
    pub pinned: Vec<(usize, f64)>,
}

/// Where an identification starts or ends.
#[derive(Debug, Clone, Default)]
pub struct State {
    /// ln(mu / mu_reference) of each region.
    pub theta: Vec<f64>,
    /// Change of the plates' motion from the fitted one (mm).
    pub plates: Vec<Vec<f64>>,
    /// The solution.
    pub x: Option<Vec<f64>>,
}

/// What was identified.
#[derive(Debug, Clone)]
pub struct Estimate {
    /// Moduli, plates, solution.
    pub state: State,
    /// Number of parameters: moduli, then the held plate's, then the loaded plate's.
    pub parameters: usize,
    /// Their covariance (row by row), with residuals that hang together counted as such.
    pub covariance: Vec<f64>,
    /// Normal matrix J^T W J over the variance of the residuals, without prior.
    pub information: Vec<f64>,
    /// Measured less modelled displacement of each observation (mm).
    pub residuals: Vec<[f64; 3]>,
    /// Root mean square residual of one component (mm).
    pub rms: f64,
    /// Sum of the weighted squares (in units of the observations' sigma).
    pub squares: f64,
    /// The squares as they were over these: less than 1 where no residual was taken to be smaller
    /// than the model's own error.
    pub raw: f64,
    /// How many independent samples (components) the data are worth.
    pub effective: f64,
    /// Force across the loaded and across the held plate for a reference shear modulus of 1 kPa
    /// (kPa mm^2).
    pub force: [f64; 2],
    /// By how many times the whole force on the loaded plate is more than that, which is its part
    /// across the plate (1 at least).
    pub leaning: f64,
    /// Derivative of the logarithm of the force on the loaded plate by each parameter.
    pub force_slope: Vec<f64>,
    /// The solution's derivative by each parameter, one after the other.
    pub columns: Vec<f64>,
    /// Displacement at the observations for a unit of each parameter.
    pub rows: Vec<Vec<[f64; 3]>>,
    /// Iterations.
    pub iterations: usize,
    /// Factorisations.
    pub factorisations: usize,
}

impl Setup<'_> {
    /// Regions whose modulus is free, ascending.
    pub fn free(&self) -> Vec<usize> {
        let pinned = |r: usize| self.pinned.iter().any(|p| p.0 == r);
        (0..self.body.labels.len()).filter(|&r| r != self.reference && !pinned(r)).collect()
    }

    /// The forward problem for a state.
    pub fn problem(&self, state: &State) -> Problem<'_> {
        let material = |&r: &u16| Material { mu: state.theta[r as usize].exp(), poisson: self.poisson[r as usize] };
        let materials: Vec<Material> = self.body.region.iter().map(material).collect();
        let mut ties: Vec<Tie> = Vec::new();
        for (patch, change) in self.patches.iter().zip(&state.plates) {
            ties.extend(patch.ties(self.body, change));
        }
        let slides = |p: &Patch| p.contact == Contact::Sliding;
        if self.patches.iter().all(slides) {
            // Two frictionless plates leave the body free to move along them: springs as soft as
            // the tissue, to where the surface was measured to go, hold it and pull next to
            // nothing.
            for patch in &self.patches {
                let mut guided = patch.clone();
                guided.contact = Contact::Guided;
                ties.extend(guided.ties(self.body, &[]).into_iter().map(|t| Tie { strength: 1e-7, ..t }));
            }
        }
        let plate = self.patches[1].plate(self.body, &state.plates[1], |e| materials[e].mu);
        Problem { plate, ..Problem::new(self.body, self.law, materials, ties) }
    }

    /// Nodes of the facets with which a curved body touches its plate, ascending, and the area of
    /// the contact (mm^2); none where the patch is flat or sticks.
    pub fn touching(&self, state: &State) -> Option<(Vec<u32>, f64)> {
        let x = state.x.as_deref()?;
        Some(self.problem(state).plate?.contact(self.body, x))
    }

    /// A state with equal moduli and the plates as fitted.
    pub fn start(&self) -> State {
        let plates = self.patches.iter().map(|p| vec![0.0; p.parameters()]).collect();
        State { theta: vec![0.0; self.body.labels.len()], plates, x: None }
    }

    /// Solves the forward problem for a state; `precision` (mm) ends Newton's method.
    ///
    /// # Errors
    /// [`StiffnessError`] when no equilibrium is found.
    pub(crate) fn solve(&self, state: &State, precision: f64) -> Result<(Problem<'_>, Solution<'_>), StiffnessError> {
        let problem = self.problem(state);
        // What was measured to touch is nearer to the truth than what a body as it was would touch.
        let plate = problem.plate.as_ref().filter(|_| state.x.is_none());
        let guess = plate.map(|p| p.guess(self.body, &self.patches[1].nodes));
        let solution = problem.solve(state.x.as_deref().or(guess.as_deref()), precision)?;
        Ok((problem, solution))
    }

    /// Right-hand sides of the sensitivities, one after the other.
    fn right_sides(&self, problem: &Problem<'_>, x: &[f64]) -> Result<Vec<f64>, StiffnessError> {
        let body = self.body;
        let mut out = Vec::new();
        let pushed = problem.plate.as_ref().map(|plate| {
            let mut pushed = vec![0.0; body.pattern.unknowns()];
            plate.push(body, x, &mut pushed);
            pushed
        });
        let modulus = |e: usize| problem.materials[e].mu;
        for r in self.free() {
            let within = |e: usize| body.region[e] as usize == r;
            let mut part = problem.residual_by_modulus(x, within)?;
            if let Some(pushed) = &pushed {
                // The plate is as stiff as what it touches.
                let loaded = &self.patches[1];
                let own = loaded.backing(body, |e| if within(e) { modulus(e) } else { 0.0 });
                let share = own / loaded.backing(body, modulus);
                part.iter_mut().zip(pushed).for_each(|(v, p)| *v += share * p);
            }
            out.extend(part.into_iter().map(|v| -v));
        }
        out.extend(self.plate_sides(problem, x));
        Ok(out)
    }

    /// Right-hand sides for the plates' parameters, one after the other.
    pub(crate) fn plate_sides(&self, problem: &Problem<'_>, x: &[f64]) -> Vec<f64> {
        let (body, n) = (self.body, self.body.pattern.unknowns());
        let (mut out, zero) = (Vec::new(), vec![0.0; n]);
        for (i, patch) in self.patches.iter().enumerate() {
            for k in 0..patch.parameters() {
                let mut column = match &problem.plate {
                    Some(plate) if i == 1 => plate.moved(body, x, |p| dot(patch.basis(k, p), patch.normal)),
                    _ => vec![0.0; n],
                };
                for tie in patch.ties(body, &[]) {
                    let push = Tie { target: patch.basis(k, body.places[tie.node as usize]), ..tie };
                    let force = problem.pull(&push, &zero);
                    let at = body.pattern.first(tie.node);
                    (0..3).for_each(|a| column[at + a] += force[a]);
                }
                out.extend(column);
            }
        }
        out
    }

    /// What the ties of a patch (held 0, loaded 1) pull with together (kPa mm^2).
    fn reaction(&self, problem: &Problem<'_>, state: &State, x: &[f64], patch: usize) -> [f64; 3] {
        let ties = self.patches[patch].ties(self.body, &state.plates[patch]);
        ties.iter().map(|t| problem.pull(t, x)).fold([0.0; 3], |sum, f| std::array::from_fn(|a| sum[a] + f[a]))
    }

    /// Force (kPa mm^2) of the loaded patch on the body: what all other patches hold against it
    /// where a plate presses, and its own ties' else.
    fn whole_force(&self, problem: &Problem<'_>, state: &State, x: &[f64]) -> [f64; 3] {
        let sign = if problem.plate.is_some() { -1.0 } else { 1.0 };
        let all = self.bearing(problem).map(|i| self.reaction(problem, state, x, i));
        all.fold([0.0; 3], |sum, f| std::array::from_fn(|a| sum[a] + sign * f[a]))
    }

    /// The patches whose ties tell the force on the loaded one.
    fn bearing(&self, problem: &Problem<'_>) -> impl Iterator<Item = usize> {
        let pressed = problem.plate.is_some();
        (0..self.patches.len()).filter(move |&i| (i == 1) != pressed)
    }

    /// Force (kPa mm^2) with which each plate pushes the body across it (loaded, held). That of a
    /// plate on a curved body is what the ties hold against it: linear in `x`, so it needs no
    /// better solution than that.
    pub fn forces(&self, problem: &Problem<'_>, state: &State, x: &[f64]) -> [f64; 2] {
        let n = self.patches[1].normal;
        let pushed = self.whole_force(problem, state, x);
        [-dot(pushed, n), -dot(self.reaction(problem, state, x, 0), self.patches[0].normal)]
    }

    /// By how many times the whole force on the loaded plate is more than its part across it (1 at
    /// least), told as in `forces`.
    pub(crate) fn leaning(&self, problem: &Problem<'_>, state: &State, x: &[f64]) -> f64 {
        let whole = self.whole_force(problem, state, x);
        length(whole) / dot(whole, self.patches[1].normal).abs().max(f64::MIN_POSITIVE)
    }

    /// Measured less modelled displacement (mm, RAS) of each observation.
    fn residuals(&self, x: &[f64]) -> Vec<[f64; 3]> {
        use rayon::prelude::*;
        let one = |o: &Observation| {
            let u = o.read(self.body, x);
            std::array::from_fn(|a| o.displacement[a] - u[a])
        };
        self.observations.par_iter().map(one).collect()
    }

    pub(super) fn scale(&self, residuals: &[[f64; 3]]) -> f64 {
        let mut sizes: Vec<f64> =
            residuals.iter().zip(self.observations).map(|(r, o)| dot(*r, *r).sqrt() / o.sigma).collect();
        (percentile(&mut sizes, 50.0) / MAXWELL_MEDIAN).max(self.floor)
    }

    pub(super) fn weights(&self, residuals: &[[f64; 3]], scale: f64) -> Vec<f64> {
        let limit = HUBER_THRESHOLD * scale * 3f64.sqrt();
        let one = |(r, o): (&[f64; 3], &Observation)| {
            let size = dot(*r, *r).sqrt() / o.sigma;
            let huber = if size > limit { limit / size } else { 1.0 };
            huber / (o.sigma * o.sigma)
        };
        residuals.iter().zip(self.observations).map(one).collect()
    }

    fn squares(&self, residuals: &[[f64; 3]], weights: &[f64]) -> f64 {
        residuals.iter().zip(weights).map(|(r, w)| w * dot(*r, *r)).sum()
    }

    pub(super) fn prior(&self, state: &State) -> f64 {
        let moduli: f64 = self.free().iter().map(|&r| (state.theta[r] / PRIOR_SD_LN).powi(2)).sum();
        let plates: f64 = state.plates.iter().flatten().map(|c| (c / self.plate_prior).powi(2)).sum();
        moduli + plates
    }

    /// Identifies from `start`; `most` iterations at most, `precision` (mm) of each forward
    /// solution.
    ///
    /// # Errors
    /// [`StiffnessError`] when the forward problem cannot be solved.
    pub fn run(&self, start: State, most: usize, precision: f64) -> Result<Estimate, StiffnessError> {
        let free = self.free();
        let parameters = free.len() + self.patches.iter().map(Patch::parameters).sum::<usize>();
        let mut state = start;
        self.pinned.iter().for_each(|&(r, value)| state.theta[r] = value);
        let mut factorisations = 0;
        let first = if state.x.is_none() { STEP.coarse_tolerance_ratio * precision } else { precision };
        let (mut problem, mut solution) = self.solve(&state, first)?;
        factorisations += solution.factorisations;
        let mut residuals = self.residuals(&solution.x);
        let (mut iterations, mut last) = (0, None);
        // The moduli whose tangent is factorised.
        let mut factorised = state.theta.clone();
        loop {
            iterations += 1;
            let scale = self.scale(&residuals);
            let weights = self.weights(&residuals, scale);
            let columns = self.sensitivities(&problem, &solution, last)?;
            let Solution { x, factor: tangent, .. } = solution;
            let mut tangent = Some(tangent);
            let (normal, right) = self.normal(&columns, &residuals, &weights);
            let (variance, prior) = (scale * scale, self.prior_terms(&state));
            let mut a: Vec<f64> = normal.iter().map(|v| v / variance).collect();
            let mut slope: Vec<f64> = right.iter().map(|v| v / variance).collect();
            for k in 0..parameters {
                a[k * parameters + k] += prior[k].0;
                slope[k] -= prior[k].0 * prior[k].1;
            }
            let Some(step) = within(&a, &slope, &self.room(&state)) else { return Err(StiffnessError::Unsolvable) };
            let longest = step[..free.len()].iter().fold(0.0, |m: f64, v| m.max(v.abs()));
            let mut part = 1.0;
            let plates = step[free.len()..].iter().fold(0.0, |m: f64, v| m.max(v.abs()));
            if longest < STEP.max_linear && plates < STEP.max_linear * self.travel() {
                let end = self.advanced(&state, &x, &columns, &step);
                if problem.plate.is_some() {
                    // A contact is stiff: what is left out would show as a force.
                    let (problem, solution) = self.follow(&end, tangent, problem.springs, precision)?;
                    let rest = self.residuals(&solution.x);
                    let end = State { x: Some(solution.x), ..end };
                    factorisations += solution.factorisations;
                    return self.finish(end, &problem, columns, rest, iterations, factorisations);
                }
                let rows = self.rows(&columns);
                let rest = (0..residuals.len()).map(|i| {
                    let fell = |a: usize| (0..parameters).map(|k| step[k] * rows[k][i][a]).sum::<f64>();
                    std::array::from_fn(|a| residuals[i][a] - fell(a))
                });
                let rest = rest.collect();
                return self.finish(end, &problem, columns, rest, iterations, factorisations);
            }
            // What the step would still gain, to first order.
            let gain = (0..parameters).map(|k| step[k] * slope[k]).sum::<f64>();
            if iterations > most || gain < STEP.min_gain * self.squares(&residuals, &weights) / variance {
                state.x = Some(x);
                return self.finish(state, &problem, columns, residuals, iterations, factorisations);
            }
            let before = self.squares(&residuals, &weights) / variance + self.prior(&state);
            let mut best = None;
            for _ in 0..3 {
                let shorter: Vec<f64> = step.iter().map(|s| part * s).collect();
                let trial = self.advanced(&state, &x, &columns, &shorter);
                let change = trial.theta.iter().zip(&factorised).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                // A factor that is not good enough goes before the next one is made: two take twice
                // the memory.
                tangent.take_if(|_| change > if problem.is_linear() { STEP.linear_tangent } else { STEP.same_tangent });
                let precision =
                    if change > STEP.coarse_change { STEP.coarse_tolerance_ratio * precision } else { precision };
                if let Ok((p, s)) = self.follow(&trial, tangent.take(), problem.springs.clone(), precision) {
                    factorisations += s.factorisations;
                    if s.factorisations > 0 {
                        factorised.clone_from(&trial.theta);
                    }
                    let rest = self.residuals(&s.x);
                    let after = self.squares(&rest, &weights) / variance + self.prior(&trial);
                    if after <= before * (1.0 + 1e-9) {
                        best = Some((trial, p, s, rest, after));
                        break;
                    }
                }
                part *= 0.4;
            }
            let Some((trial, p, s, rest, after)) = best else {
                state.x = Some(x);
                return self.finish(state, &problem, columns, residuals, iterations, factorisations);
            };
            let stalled = after > before * (1.0 - STEP.min_gain);
            (state, problem, solution, residuals) = (trial, p, s, rest);
            if stalled {
                let columns = self.sensitivities(&problem, &solution, Some(columns))?;
                state.x = Some(solution.x);
                return self.finish(state, &problem, columns, residuals, iterations, factorisations);
            }
            last = Some(columns);
        }
    }

    /// Solves from a state nearby, with its tangent where one is given and leads there. The ties
    /// keep the tangent's `springs`: the force is that times a gap which no step would close that
    /// is measured in mm.
    fn follow<'a>(
        &'a self,
        state: &State,
        tangent: Option<Tangent<'a>>,
        springs: Vec<f64>,
        precision: f64,
    ) -> Result<(Problem<'a>, Solution<'a>), StiffnessError> {
        if let (Some(factor), Some(x)) = (tangent, &state.x) {
            let problem = Problem { springs, ..self.problem(state) };
            if problem.is_linear() {
                let solution = problem
                    .solve_with(Some(x), |matrix| factor.near(matrix).map_err(|_| StiffnessError::Unsolvable))?;
                return Ok((problem, Solution { factorisations: 0, ..solution }));
            }
            if let Some(x) = problem.solve_near(x, &factor, precision) {
                return Ok((problem, Solution { x, factor, factorisations: 0 }));
            }
        }
        self.solve(state, precision)
    }

    /// The derivatives of a solution; those of a state nearby are begun with.
    fn sensitivities(
        &self,
        problem: &Problem<'_>,
        solution: &Solution<'_>,
        last: Option<Vec<f64>>,
    ) -> Result<Vec<f64>, StiffnessError> {
        let mut columns = self.right_sides(problem, &solution.x)?;
        solution.factor.sensitivities(&mut columns, last.as_deref()).map_err(|_| StiffnessError::Unsolvable)?;
        Ok(columns)
    }

    /// The state a step further: moduli and plates by the step, the solution to first order by its
    /// derivatives.
    pub(crate) fn advanced(&self, state: &State, x: &[f64], columns: &[f64], step: &[f64]) -> State {
        let mut out = State { x: None, ..state.clone() };
        let mut values = step.iter().copied();
        for r in self.free() {
            out.theta[r] =
                (out.theta[r] + values.next().unwrap_or(0.0)).clamp(-STEP.max_log_contrast, STEP.max_log_contrast);
        }
        out.plates.iter_mut().flatten().for_each(|c| *c += values.next().unwrap_or(0.0));
        let mut x = x.to_vec();
        for (column, s) in columns.chunks_exact(x.len()).zip(step) {
            x.iter_mut().zip(column).for_each(|(v, c)| *v += s * c);
        }
        out.x = Some(x);
        out
    }

    /// How far the plates move against each other (mm).
    pub(super) fn travel(&self) -> f64 {
        let apart = travel(&self.patches);
        dot(apart, apart).sqrt()
    }

    /// 1 / variance and present distance of each parameter's prior.
    pub(crate) fn prior_terms(&self, state: &State) -> Vec<(f64, f64)> {
        let moduli = self.free().into_iter().map(|r| (PRIOR_SD_LN.powi(-2), state.theta[r]));
        let plates = state.plates.iter().flatten().map(|&c| (self.plate_prior.powi(-2), c));
        moduli.chain(plates).collect()
    }

    /// How far each parameter may go in one step, down and up.
    fn room(&self, state: &State) -> Vec<[f64; 2]> {
        let moduli = self.free().into_iter().map(|r| {
            let at = state.theta[r];
            [
                (-STEP.max_log_contrast - at).clamp(-STEP.max_change, 0.0),
                (STEP.max_log_contrast - at).clamp(0.0, STEP.max_change),
            ]
        });
        let plates = state.plates.iter().flatten().map(|_| [f64::NEG_INFINITY, f64::INFINITY]);
        moduli.chain(plates).collect()
    }

    /// J^T W J and J^T W e.
    fn normal(&self, columns: &[f64], residuals: &[[f64; 3]], weights: &[f64]) -> (Vec<f64>, Vec<f64>) {
        let rows = self.rows(columns);
        let p = rows.len();
        let (mut normal, mut right) = (vec![0.0; p * p], vec![0.0; p]);
        for block in grouped_normal(self.observations, &rows, residuals, weights) {
            normal.iter_mut().zip(&block.normal).for_each(|(a, b)| *a += b);
            right.iter_mut().zip(&block.score).for_each(|(a, b)| *a += b);
        }
        (normal, right)
    }

    /// The sensitivities at the observations.
    fn rows(&self, columns: &[f64]) -> Vec<Vec<[f64; 3]>> {
        use rayon::prelude::*;
        let read = |y: &[f64]| self.observations.iter().map(|o| o.read(self.body, y)).collect();
        columns.par_chunks_exact(self.body.pattern.unknowns()).map(read).collect()
    }

    fn finish(
        &self,
        state: State,
        problem: &Problem<'_>,
        columns: Vec<f64>,
        residuals: Vec<[f64; 3]>,
        iterations: usize,
        factorisations: usize,
    ) -> Result<Estimate, StiffnessError> {
        let rows = self.rows(&columns);
        let p = rows.len();
        let weights = self.weights(&residuals, self.scale(&residuals));
        let blocks = grouped_normal(self.observations, &rows, &residuals, &weights);
        let samples = 3.0 * residuals.len() as f64;
        let raw = self.squares(&residuals, &weights);
        let squares = raw.max(samples * self.floor * self.floor);
        let (covariance, information, inflation) = covariance(&blocks, &self.prior_terms(&state), squares, samples)?;
        let x = state.x.as_deref().unwrap_or_default();
        let (force, leaning) = (self.forces(problem, &state, x), self.leaning(problem, &state, x));
        let force_slope = self.force_slope(problem, &columns, force[0]);
        let rms = (residuals.iter().map(|r| dot(*r, *r)).sum::<f64>() / samples).sqrt();
        Ok(Estimate {
            state,
            parameters: p,
            covariance,
            information,
            residuals,
            rms,
            squares,
            raw: raw / squares.max(f64::MIN_POSITIVE),
            effective: samples / inflation,
            force,
            leaning,
            force_slope,
            columns,
            rows,
            iterations,
            factorisations,
        })
    }

    /// Derivatives of ln(force on the loaded plate).
    fn force_slope(&self, problem: &Problem<'_>, columns: &[f64], force: f64) -> Vec<f64> {
        let n = self.body.pattern.unknowns();
        let (sign, normal) = (if problem.plate.is_some() { 1.0 } else { -1.0 }, self.patches[1].normal);
        let first = |i: usize| self.free().len() + self.patches[..i].iter().map(Patch::parameters).sum::<usize>();
        let bearing: Vec<_> =
            self.bearing(problem).map(|i| (&self.patches[i], first(i), self.patches[i].ties(self.body, &[]))).collect();
        let slope = |(k, y): (usize, &[f64])| {
            let pushed = |(patch, first, ties): &(&Patch, usize, Vec<Tie>)| -> f64 {
                let push = |tie: &Tie| {
                    let target = match k.checked_sub(*first) {
                        Some(k) if k < patch.parameters() => patch.basis(k, self.body.places[tie.node as usize]),
                        _ => [0.0; 3],
                    };
                    sign * dot(problem.pull(&Tie { target, ..*tie }, y), normal)
                };
                ties.iter().map(push).sum()
            };
            bearing.iter().map(pushed).sum::<f64>() / force
        };
        columns.chunks_exact(n).enumerate().map(slope).collect()
    }
}

/// A block's share of the normal equations.
#[derive(Debug, Clone)]
pub(super) struct Block {
    pub normal: Vec<f64>,
    pub score: Vec<f64>,
}

/// The normal equations block by block of the body.
pub(super) fn grouped_normal(
    observations: &[Observation],
    rows: &[Vec<[f64; 3]>],
    residuals: &[[f64; 3]],
    weights: &[f64],
) -> Vec<Block> {
    use rayon::prelude::*;
    let p = rows.len();
    let one = |group: &Vec<u32>| {
        let mut block = Block { normal: vec![0.0; p * p], score: vec![0.0; p] };
        for i in group.iter().map(|&i| i as usize) {
            for a in 0..p {
                let weighted = rows[a][i].map(|v| v * weights[i]);
                block.score[a] += dot(weighted, residuals[i]);
                for b in 0..=a {
                    block.normal[a * p + b] += dot(weighted, rows[b][i]);
                }
            }
        }
        for a in 0..p {
            for b in a + 1..p {
                block.normal[a * p + b] = block.normal[b * p + a];
            }
        }
        block
    };
    grouped(observations).par_iter().map(one).collect()
}

/// Covariance with residuals that hang together within a block (the sandwich of Liang and Zeger,
/// Biometrika 73, 1986, never below the plain one), the plain information, and by how much the
/// variances grow on average.
pub(super) fn covariance(
    blocks: &[Block],
    prior: &[(f64, f64)],
    squares: f64,
    samples: f64,
) -> Result<(Vec<f64>, Vec<f64>, f64), StiffnessError> {
    let p = prior.len();
    let variance = (squares / (samples - p as f64).max(1.0)).max(1e-18);
    let mut information = vec![0.0; p * p];
    let mut meat = vec![0.0; p * p];
    for block in blocks {
        for a in 0..p {
            for b in 0..p {
                information[a * p + b] += block.normal[a * p + b] / variance;
                meat[a * p + b] += block.score[a] * block.score[b] / (variance * variance);
            }
        }
    }
    let mut a = information.clone();
    for (k, (weight, _)) in prior.iter().enumerate() {
        a[k * p + k] += weight;
    }
    let bread = Cholesky::new(a, p).ok_or(StiffnessError::Unsolvable)?.inverse();
    // With few blocks the sandwich is too small (Bell and McCaffrey 2002).
    let few = blocks.len() as f64 / (blocks.len() as f64 - p as f64).max(1.0);
    let sandwich = product(&product(&bread, &meat, p), &bread, p);
    let growth: Vec<f64> = (0..p).map(|k| (few * sandwich[k * p + k] / bread[k * p + k]).max(1.0)).collect();
    let scaled = |i: usize| {
        let (r, c) = (i / p, i % p);
        let correlation = sandwich[i] / (sandwich[r * p + r] * sandwich[c * p + c]).max(1e-300).sqrt();
        let correlation = if r == c { 1.0 } else { correlation.clamp(-1.0, 1.0) };
        correlation * (bread[r * p + r] * bread[c * p + c] * growth[r] * growth[c]).sqrt()
    };
    let out = (0..p * p).map(scaled).collect();
    Ok((out, information, growth.iter().sum::<f64>() / p.max(1) as f64))
}

fn product(a: &[f64], b: &[f64], n: usize) -> Vec<f64> {
    (0..n * n).map(|i| (0..n).map(|k| a[i / n * n + k] * b[k * n + i % n]).sum()).collect()
}

/// Numbers of the observations in each block of space.
fn grouped(observations: &[Observation]) -> Vec<Vec<u32>> {
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for o in observations {
        for a in 0..3 {
            low[a] = low[a].min(o.place[a]);
            high[a] = high[a].max(o.place[a]);
        }
    }
    let volume: f64 = (0..3).map(|a| (high[a] - low[a]).max(1e-3)).product();
    let size = (volume / COVARIANCE_BLOCKS).cbrt();
    let count: [usize; 3] = std::array::from_fn(|a| ((high[a] - low[a]) / size) as usize + 1);
    let mut out = vec![Vec::new(); count.iter().product()];
    for (i, o) in observations.iter().enumerate() {
        let c: [usize; 3] = std::array::from_fn(|a| (((o.place[a] - low[a]) / size) as usize).min(count[a] - 1));
        out[c[0] + count[0] * (c[1] + count[1] * c[2])].push(i as u32);
    }
    out.retain(|g| !g.is_empty());
    out
}
