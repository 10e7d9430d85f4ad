//! An elastic body before and after it is pressed.

use crate::error::{ParamError, SynthError};
use crate::synth::elastic::hexahedra::{HELD, PRESSED};
use crate::synth::elastic::locate::{Locator, Place, fill, interpolate};
use crate::synth::elastic::material::Lame;
use crate::synth::elastic::newton::{Equilibrium, Problem, equilibrium};
use crate::synth::elastic::tissue::{Region, Tissue};
use crate::synth::params::PhantomParams;
use crate::types::{DenseField, Grid, WorldPoint};
use rayon::prelude::*;
use serde::Serialize;

/// Voxels around the body into which its motion is continued.
const CONTINUATION_VOXELS: f64 = 5.0;

/// Mechanics of a phantom, as its description says them.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ElasticDescription {
    /// World axis of the held side.
    pub held: &'static str,
    /// World axis of the pressed side.
    pub load: &'static str,
    /// Whether the pressed side sticks to what presses it, or slides on it.
    pub contact: &'static str,
    /// Force on the pressed side along its axis (N).
    pub force_n: f64,
    /// Poisson's ratio.
    pub poisson: f64,
    /// Travel of the pressed side over the body's height (1).
    pub compression: f64,
    /// What it is made of.
    pub regions: Vec<Region>,
    /// How exact all this is.
    pub solution: Accuracy,
}

/// The mesh, and what refining it last has changed.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Accuracy {
    /// Triquadratic hexahedra.
    pub elements: usize,
    /// Their nodes.
    pub nodes: usize,
    /// Root mean square over the nodes of the last halving's change (mm).
    pub change_rms_mm: f64,
    /// Largest (mm).
    pub change_max_mm: f64,
    /// Change of the force by the last halving, over the force (1).
    pub force_change: f64,
    /// What is left of the displacement's error (mm, root mean square): the change times r / (1 -
    /// r), where r is the ratio of the last two changes.
    pub error_rms_mm: f64,
    /// The same for the force, over the force (1).
    pub force_error: f64,
    /// Sum of the forces on the held and the pressed side, over the force (1).
    pub imbalance: f64,
}

/// An elastic body and its displacement.
pub struct Pressed {
    tissue: Tissue,
    solved: Equilibrium,
    /// Places of the nodes after the press (mm).
    moved: Vec<[f64; 3]>,
    /// What was found.
    pub description: ElasticDescription,
}

/// Presses `tissue` by the amplitude of `params`.
///
/// # Errors
/// [`SynthError`] where there is no equilibrium at this amplitude.
pub fn press(params: &PhantomParams, tissue: Tissue, halvings: usize) -> Result<Pressed, SynthError> {
    let (amplitude, poisson) = (params.amplitude, params.elastic.poisson);
    let sticks = !tissue.slides();
    let problem = Problem {
        mesh: tissue.mesh(),
        project: &|surfaces, p| tissue.project(surfaces, p),
        lame: tissue.regions().iter().map(|r| Lame::new(r.youngs_modulus_kpa, poisson)).collect(),
        boundary: &|surfaces, _| match surfaces {
            s if s & HELD != 0 => [Some(0.0); 3],
            s if s & PRESSED != 0 && sticks => [Some(0.0), Some(0.0), Some(-amplitude)],
            _ => [None; 3],
        },
        guess: &|p| tissue.squeezed(p, amplitude),
        plate: tissue.plate(amplitude),
        halvings,
    };
    let too_far =
        ParamError { name: "amplitude", value: amplitude, range: "less for this body: no equilibrium was found" };
    let solved = equilibrium(&problem).ok_or(too_far)?;
    let moved = solved.space.nodes.iter().zip(&solved.displacement);
    let moved = moved.map(|(x, u)| std::array::from_fn(|c| x[c] + u[c])).collect();
    let [held, load] = tissue.sides();
    let description = ElasticDescription {
        held,
        load,
        contact: if sticks { "sticking" } else { "frictionless" },
        force_n: 1e-3 * solved.levels[solved.levels.len() - 1].force.abs(),
        poisson,
        compression: amplitude / tissue.height(),
        regions: tissue.regions().to_vec(),
        solution: accuracy(&solved),
    };
    Ok(Pressed { tissue, solved, moved, description })
}

fn accuracy(solved: &Equilibrium) -> Accuracy {
    let levels = &solved.levels;
    let last = levels[levels.len() - 1];
    let force = last.force.abs().max(f64::MIN_POSITIVE);
    let step = |n: usize| {
        let (level, before) = (levels.get(levels.len().wrapping_sub(n)), levels.get(levels.len().wrapping_sub(n + 1)));
        level.zip(before).map(|(a, b)| (a.force - b.force).abs() / force)
    };
    // Without two changes, a halving is taken to halve the error; no faith is put in more than a
    // quarter.
    let left = |change: f64, before: Option<f64>| {
        let ratio = before.map_or(0.5, |b| change / b.max(f64::MIN_POSITIVE)).clamp(0.25, 0.8);
        change * ratio / (1.0 - ratio)
    };
    let before = (levels.len() > 2).then(|| levels[levels.len() - 2].change[0]);
    let force_change = step(1).unwrap_or(f64::NAN);
    let outer = solved.space.surfaces.iter().zip(&solved.forces).filter(|(s, _)| *s & (HELD | PRESSED) != 0);
    let sum = outer.fold([0.0; 3], |s: [f64; 3], (_, f)| std::array::from_fn(|c| s[c] + f[c]));
    Accuracy {
        elements: last.elements,
        nodes: last.nodes,
        change_rms_mm: last.change[0],
        change_max_mm: last.change[1],
        force_change,
        error_rms_mm: left(last.change[0], before),
        force_error: left(force_change, step(2)),
        imbalance: sum.iter().map(|v| v * v).sum::<f64>().sqrt() / force,
    }
}

impl Pressed {
    /// The body at rest.
    pub fn tissue(&self) -> &Tissue {
        &self.tissue
    }

    /// How the last halving and those before went.
    pub fn solved(&self) -> &Equilibrium {
        &self.solved
    }

    /// The displacement at the voxels of `grid` (mm), continued around the body.
    pub fn field(&self, grid: Grid) -> DenseField {
        let space = &self.solved.space;
        let places = Locator::new(&grid, &space.nodes, &space.elements, CONTINUATION_VOXELS).voxels(grid.shape());
        let mut u: Vec<Option<[f64; 3]>> = places.into_par_iter().map(|p| p.map(|p| self.displacement(&p))).collect();
        fill(&mut u, grid.shape());
        DenseField::from_voxels(grid, |at, _| u[at].unwrap_or_default())
    }

    /// Where the tissue at each voxel of `grid` was at rest; none away from the body.
    pub fn origins(&self, grid: &Grid) -> Vec<Option<WorldPoint>> {
        let space = &self.solved.space;
        let places = Locator::new(grid, &self.moved, &space.elements, CONTINUATION_VOXELS).voxels(grid.shape());
        let rest = |p: Place| WorldPoint(interpolate(&space.nodes, &space.elements[p.element as usize], p.local));
        places.into_par_iter().map(|p| p.map(rest)).collect()
    }

    /// The displacements of some world positions (mm); none away from the body.
    pub fn at(&self, grid: &Grid, points: &[WorldPoint]) -> Vec<Option<[f64; 3]>> {
        let space = &self.solved.space;
        let locator = Locator::new(grid, &space.nodes, &space.elements, CONTINUATION_VOXELS);
        let find = |p: &WorldPoint| locator.point(grid.affine().to_voxel(*p).0).map(|p| self.displacement(&p));
        points.par_iter().map(find).collect()
    }

    fn displacement(&self, place: &Place) -> [f64; 3] {
        let lattice = &self.solved.space.elements[place.element as usize];
        interpolate(&self.solved.displacement, lattice, place.local)
    }
}
