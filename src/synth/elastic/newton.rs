//! Equilibrium by Newton's method, from coarse to fine.

use crate::synth::elastic::hexahedra::{HELD, HexMesh, PRESSED, Project, Surfaces};
use crate::synth::elastic::material::{Lame, Pressure, State, predicted, state};
use crate::synth::elastic::multigrid::Multigrid;
use crate::synth::elastic::space::Space;
use crate::synth::elastic::tangent::Stiffness;
use crate::synth::elastic::transfer::Transfer;
use crate::synth::elastic::vectors::{Nodal, norm};

/// What is to be solved.
pub struct Problem<'a> {
    /// The coarsest hexahedra.
    pub mesh: HexMesh,
    /// Brings a place onto all of the given surfaces.
    pub project: &'a Project<'a>,
    /// Moduli by region (kPa).
    pub lame: Vec<Lame>,
    /// The displacement (mm) of the components that are held or pressed, from a node's surfaces and
    /// place.
    pub boundary: &'a dyn Fn(Surfaces, [f64; 3]) -> [Option<f64>; 3],
    /// Where to start from.
    pub guess: &'a dyn Fn([f64; 3]) -> [f64; 3],
    /// A frictionless plate that lets no pressed node below this height (mm).
    pub plate: Option<f64>,
    /// Times the hexahedra are halved.
    pub halvings: usize,
}

/// How one level went.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LevelReport {
    /// Triquadratic elements.
    pub elements: usize,
    /// Nodes.
    pub nodes: usize,
    /// Newton steps.
    pub steps: usize,
    /// Conjugate gradient iterations in all.
    pub iterations: usize,
    /// Force on the pressed face along z (mN), positive where the tissue is pushed up.
    pub force: f64,
    /// Root mean square and largest change of a node against the level before (mm).
    pub change: [f64; 2],
}

/// A displacement in equilibrium.
pub struct Equilibrium {
    /// The finest level.
    pub space: Space,
    /// Displacement of each node (mm).
    pub displacement: Vec<[f64; 3]>,
    /// Stored energy (mN mm).
    pub energy: f64,
    /// Force on each node from outside (mN); zero but for held and pressed ones, to the tolerance.
    pub forces: Vec<[f64; 3]>,
    /// Coarse to fine.
    pub levels: Vec<LevelReport>,
}

/// Iteration control of Newton's method with contact.
struct NewtonControl {
    /// Norm of the free forces over that of all forces: on the finest level and on coarser ones.
    tolerance: [f64; 2],
    /// The same, from which the nodes that touch the plate are updated.
    contact_tolerance: f64,
    /// Penetration (mm), and pull over the largest nodal force, that are accepted.
    contact_slack: f64,
    /// Most Newton steps.
    max_steps: usize,
    /// Most conjugate gradient iterations in a step.
    max_iterations: usize,
}

const NEWTON: NewtonControl = NewtonControl {
    tolerance: [2e-6, 1e-4],
    contact_tolerance: 1e-2,
    contact_slack: 2e-4,
    max_steps: 60,
    max_iterations: 400,
};

/// The displacement in equilibrium; `None` where Newton's method fails, because the tissue is
/// pressed too far.
pub fn equilibrium(problem: &Problem<'_>) -> Option<Equilibrium> {
    let (spaces, transfers) = hierarchy(problem);
    let mut multigrid = Multigrid::new(&problem.mesh, &problem.lame);
    let mut displacement: Vec<[f64; 3]> = Vec::new();
    let mut pressure: Vec<Pressure> = Vec::new();
    let mut levels = Vec::new();
    let (mut forces, mut energy) = (Vec::new(), 0.0);
    for (n, space) in spaces.iter().enumerate() {
        multigrid.push(space, &transfers[n], &problem.lame);
        let start = match n {
            0 => space.nodes.iter().map(|&x| (problem.guess)(x)).collect(),
            _ => transfers[n].refine_exactly(&displacement),
        };
        // A child starts from its parent's pressure.
        pressure = match n {
            0 => vec![[0.0; 4]; space.elements.len()],
            _ => pressure.iter().flat_map(|&p| [p; 8]).collect(),
        };
        let tolerance = NEWTON.tolerance[usize::from(n + 1 < spaces.len())];
        let mut solver = Newton::new(problem, space, &mut multigrid, start.clone(), pressure);
        let (steps, iterations) = solver.run(tolerance)?;
        let Newton { u, state, pressure: last, .. } = solver;
        pressure = last;
        let change = u.iter().zip(&start).map(|(a, b)| (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f64>());
        let rms = (change.clone().sum::<f64>() / u.len() as f64).sqrt();
        let pressed = space.surfaces.iter().zip(&state.forces).filter(|(s, _)| *s & (PRESSED | HELD) == PRESSED);
        levels.push(LevelReport {
            elements: space.elements.len(),
            nodes: space.nodes.len(),
            steps,
            iterations,
            force: pressed.map(|(_, f)| f[2]).sum(),
            change: [rms, change.fold(0.0, f64::max).sqrt()],
        });
        (displacement, forces, energy) = (u, state.forces, state.energy);
    }
    drop(multigrid);
    let space = spaces.into_iter().next_back()?;
    Some(Equilibrium { space, displacement, energy, forces, levels })
}

/// All levels, coarse to fine, and what leads up to each.
fn hierarchy(problem: &Problem<'_>) -> (Vec<Space>, Vec<Transfer>) {
    let (mut spaces, mut transfers): (Vec<Space>, Vec<Transfer>) = (Vec::new(), Vec::new());
    let mut mesh = problem.mesh.clone();
    for _ in 0..=problem.halvings {
        let (next, lattices) = mesh.refined(problem.project);
        let nodes = next.vertices.len();
        transfers.push(match spaces.last() {
            Some(coarse) => Transfer::quadratic(&coarse.elements, coarse.nodes.len(), &lattices, nodes),
            None => Transfer::linear(&mesh.hexes, mesh.vertices.len(), &lattices, nodes),
        });
        spaces.push(Space::new(next.vertices.clone(), next.surfaces.clone(), lattices, mesh.region.clone()));
        mesh = next;
    }
    (spaces, transfers)
}

/// Newton's method on one level.
struct Newton<'p, 'm, 's> {
    problem: &'p Problem<'p>,
    space: &'s Space,
    multigrid: &'m mut Multigrid<'s>,
    u: Vec<[f64; 3]>,
    /// An unknown of its own: computed from u, it would make the tangent indefinite far from the
    /// solution.
    pressure: Vec<Pressure>,
    free: Nodal,
    /// Nodes on the plate.
    touching: Vec<bool>,
    state: State,
}

impl<'p, 'm, 's> Newton<'p, 'm, 's> {
    fn new(
        problem: &'p Problem<'p>,
        space: &'s Space,
        multigrid: &'m mut Multigrid<'s>,
        mut u: Vec<[f64; 3]>,
        pressure: Vec<Pressure>,
    ) -> Self {
        let mut free = vec![[1.0; 3]; u.len()];
        for (n, (&x, &s)) in space.nodes.iter().zip(&space.surfaces).enumerate() {
            for (c, value) in (problem.boundary)(s, x).into_iter().enumerate() {
                if let Some(value) = value {
                    (u[n][c], free[n][c]) = (value, 0.0);
                }
            }
        }
        let touching = vec![false; u.len()];
        let state = State { energy: f64::INFINITY, forces: Vec::new(), batches: Vec::new() };
        Self { problem, space, multigrid, u, pressure, free, touching, state }
    }

    /// Newton steps and conjugate gradient iterations until the free forces vanish.
    fn run(&mut self, tolerance: f64) -> Option<(usize, usize)> {
        let mut iterations = 0;
        self.state = state(self.space, &self.problem.lame, &self.u, &self.pressure);
        self.touch(NEWTON.contact_slack);
        self.multigrid.hold(&self.free);
        for steps in 0..NEWTON.max_steps {
            if !self.state.energy.is_finite() {
                return None;
            }
            let (residual, lift) = (self.residual(), self.lift());
            let relative = norm(&residual) / norm(&self.state.forces).max(f64::MIN_POSITIVE);
            let on_plate = norm(&lift) <= 1e-9;
            if relative <= tolerance.max(NEWTON.contact_tolerance) && on_plate && self.touch(-NEWTON.contact_slack) {
                self.multigrid.hold(&self.free);
                continue;
            }
            if relative <= tolerance && on_plate {
                return Some((steps, iterations));
            }
            let inner = (0.3 * tolerance / relative).clamp(1e-3, 0.02).max((0.05 * relative).min(0.02));
            iterations += self.step(&residual, &lift, inner)?;
        }
        None
    }

    /// Forces that are not in equilibrium, with their sign turned.
    fn residual(&self) -> Vec<[f64; 3]> {
        let pairs = self.state.forces.iter().zip(&self.free);
        pairs.map(|(f, free)| std::array::from_fn(|c| -f[c] * f64::from(free[c]))).collect()
    }

    /// How far the nodes that touch the plate have to move to lie on it (mm).
    fn lift(&self) -> Vec<[f64; 3]> {
        let height = self.problem.plate.unwrap_or_default();
        let up = |n: usize| if self.touching[n] { height - self.space.nodes[n][2] - self.u[n][2] } else { 0.0 };
        (0..self.u.len()).map(|n| [0.0, 0.0, up(n)]).collect()
    }

    /// One step to the tangent's solution, halved while it turns an element inside out.
    fn step(&mut self, residual: &[[f64; 3]], lift: &[[f64; 3]], inner: f64) -> Option<usize> {
        let stiffness = Stiffness::new(self.space, std::mem::take(&mut self.state.batches));
        let lifted: Nodal = lift.iter().map(|d| d.map(|v| v as f32)).collect();
        let mut answer = vec![[0.0; 3]; lift.len()];
        stiffness.apply(&lifted, &self.free, &mut answer);
        let load: Vec<[f64; 3]> =
            residual.iter().zip(&answer).map(|(r, k)| std::array::from_fn(|c| r[c] - f64::from(k[c]))).collect();
        let size = norm(&load);
        let b: Nodal = load.iter().map(|r| r.map(|v| (v / size) as f32)).collect();
        let (d, iterations) = self.multigrid.solve(&stiffness, &b, inner, NEWTON.max_iterations);
        drop(stiffness);
        let mut length = 1.0;
        while length > 1e-3 {
            let d: Vec<[f64; 3]> = d
                .iter()
                .zip(lift)
                .map(|(d, g)| std::array::from_fn(|c| length * (size * f64::from(d[c]) + g[c])))
                .collect();
            let moved: Vec<[f64; 3]> =
                self.u.iter().zip(&d).map(|(u, d)| std::array::from_fn(|c| u[c] + d[c])).collect();
            let pressure = predicted(self.space, &self.problem.lame, &self.u, &d);
            let next = state(self.space, &self.problem.lame, &moved, &pressure);
            if next.energy.is_finite() {
                (self.u, self.pressure, self.state) = (moved, pressure, next);
                return Some(iterations);
            }
            length *= 0.5;
        }
        None
    }

    /// Lets nodes less than `near` (mm) above the plate touch it, and lets go those that it would
    /// pull; whether anything changed.
    fn touch(&mut self, near: f64) -> bool {
        let Some(height) = self.problem.plate else { return false };
        let slack = NEWTON.contact_slack * self.state.forces.iter().fold(0.0, |m: f64, f| m.max(f[2]));
        let mut changed = false;
        for n in 0..self.u.len() {
            if self.space.surfaces[n] & PRESSED == 0 || self.space.surfaces[n] & HELD != 0 {
                continue;
            }
            let gap = self.space.nodes[n][2] + self.u[n][2] - height;
            // A little slack on either side, or nodes at the rim take turns for ever.
            let touches = if self.touching[n] { self.state.forces[n][2] > -slack } else { gap < near };
            changed |= touches != self.touching[n];
            self.touching[n] = touches;
            self.free[n][2] = if touches { 0.0 } else { 1.0 };
        }
        changed
    }
}
