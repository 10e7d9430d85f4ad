//! What a press would tell of assumed moduli, before anything is measured.
//!
//! The forward model of `stiffness` gives the field of a press. The field is read as a measured one
//! would be, and the sensitivities of moduli, plates and open parts of the shape give the
//! information of its samples. Press, voxel size and noise scale that information; its inverse is
//! the covariance that `stiffness` would state. All is under the linear law.

use crate::error::{ParamError, StiffnessError};
use crate::mesh::tetrahedral::Mesher;
use crate::numerics::cholesky::Cholesky;
use crate::numerics::dense;
use crate::numerics::neighbours::Neighbours;
use crate::numerics::random::Random;
use crate::numerics::tetrahedron::shapes;
use crate::pipeline::body_meshes::{BodyMeshes, evenly_meshed, whole};
use crate::pipeline::clock::Clock;
use crate::pipeline::field::Progress;
use crate::pipeline::stiffness::{FORWARD_TOLERANCE_MM, FieldQuality, Inputs};
use crate::stiffness::boundary_conditions::{self, Patch, Place, SurfaceMotion, least_travel};
use crate::stiffness::elements::Mapping;
use crate::stiffness::fem_body::Body;
use crate::stiffness::fields;
use crate::stiffness::geometry::{self, Geometry, Open};
use crate::stiffness::identify::{Estimate, Setup, State};
use crate::stiffness::interface::Interface;
use crate::stiffness::mesh_problem::{Level, MIN_OBSERVATIONS, plate_prior};
use crate::stiffness::observations::{SURFACE_REACH_VOXELS, block_for, find, read};
use crate::stiffness::summary::{self, MAX_IDENTIFIED_CONTRAST_LN, MAX_IDENTIFIED_SD_LN, MIN_LOAD_SHARE, Scale};
use crate::stiffness::systematic_error::dilution;
use crate::stiffness::verdict::mesh_error;
use crate::types::plan::{Expected, LARGE_STRAIN, Plan, PlanParams, PlannedRegion, Press};
use crate::types::space::dot;
use crate::types::stiffness::{Contact, Law, LawChoice, StiffnessParams};
use crate::types::{DenseField, Mask};

/// What is planned for.
#[derive(Clone, Copy)]
pub struct PlanInputs<'a> {
    /// The regions; 0 outside the body.
    pub labels: &'a Mask,
    /// Where the body is to be held.
    pub held: &'a Place,
    /// Where it is to be pressed.
    pub load: &'a Place,
    /// A name for each label.
    pub names: &'a (dyn Fn(u8) -> String + Sync),
}

/// What a press does to a body of the assumed moduli.
#[derive(Debug, Clone)]
pub struct Simulated {
    /// The displacement on the labels' grid (mm, RAS), without noise; 0 outside the body.
    pub field: DenseField,
    /// Force of the plate on the body (N).
    pub force_n: f64,
    /// Largest principal strain (1), 95th percentile over the body.
    pub strain: f64,
}

/// Deepest press over the body's extent along the load: a linear law does not hold beyond.
const MAX_PRESS_FRACTION: f64 = 0.5;

/// The body with its plates, before it is pressed.
struct Bench<'a> {
    inputs: &'a PlanInputs<'a>,
    params: &'a PlanParams,
    body: Body,
    /// Outward unit vector of the loaded side (RAS).
    outward: [f64; 3],
    /// Surface nodes that the plate moves as a whole; none where the side is curved.
    flat: Option<Vec<u32>>,
    /// Extent of the body along the load (mm).
    extent: f64,
}

impl<'a> Bench<'a> {
    fn new(inputs: &'a PlanInputs<'a>, params: &'a PlanParams) -> Result<Self, StiffnessError> {
        params.check()?;
        whole(inputs.labels)?;
        let labels = inputs.labels.as_slice();
        if let Some(&label) = labels.iter().find(|l| **l > 0 && params.modulus(**l).is_none()) {
            let range = "a label with an assumed modulus: give one for every label, as 1=20,2=100 (kPa)";
            return Err(ParamError { name: "modulus: label", value: f64::from(label), range }.into());
        }
        let mesher = Mesher::new(inputs.labels)?;
        let (volume, nodes) = (fields::volume(inputs.labels), params.stiffness.nodes as f64);
        let mesh = evenly_meshed(&mesher, volume, nodes)?;
        let body = Body::new(&mesh)?;
        let mut out = Self { inputs, params, body, outward: [0.0; 3], flat: None, extent: 0.0 };
        out.place_plate()?;
        Ok(out)
    }

    fn voxel(&self) -> f64 {
        self.inputs.labels.grid().least_spacing()
    }

    /// The surface motion of nodes that go in by `depth` (mm) along `along`, the others at rest.
    fn motion(&self, depth: impl Fn(u32) -> f64, along: impl Fn(u32) -> [f64; 3]) -> SurfaceMotion {
        let mut displacement = vec![None; self.body.places.len()];
        for n in self.body.nodes_on(0..self.body.surface.len()) {
            displacement[n as usize] = Some(along(n).map(|v| -depth(n) * v));
        }
        SurfaceMotion {
            sharp: displacement.clone(),
            displacement,
            error: 0.0,
            sharp_error: 0.0,
            near: SURFACE_REACH_VOXELS,
        }
    }

    fn find(&self, motion: &SurfaceMotion) -> Result<Vec<Patch>, StiffnessError> {
        let PlanInputs { labels, held, load, .. } = *self.inputs;
        let mut found = boundary_conditions::find(&self.body, motion, held, load, None, labels.grid())?;
        // Where the body ends with the volume it is left free.
        found.truncate(2);
        Ok(found)
    }

    /// Which way the load goes, and what it moves.
    fn place_plate(&mut self) -> Result<(), StiffnessError> {
        let body = &self.body;
        match self.inputs.load {
            Place::Side(side) => {
                self.outward = side.direction();
                let (facets, is_flat) = boundary_conditions::end_facets(body, *side, self.voxel());
                self.flat = is_flat.then(|| body.nodes_on(facets));
            }
            Place::Mask(..) => {
                // A push all over tells which surface the masks cover.
                let mut normals = vec![[0.0; 3]; body.places.len()];
                for f in &body.surface {
                    f.nodes.iter().for_each(|&n| (0..3).for_each(|a| normals[n as usize][a] += f.area * f.normal[a]));
                }
                let unit = |n: u32| {
                    let v = normals[n as usize];
                    let length = dot(v, v).sqrt().max(f64::MIN_POSITIVE);
                    v.map(|c| c / length)
                };
                let loaded = self.find(&self.motion(|_| self.voxel(), unit))?.swap_remove(1);
                (self.outward, self.flat) = (loaded.normal, Some(loaded.nodes));
            }
        }
        let all = self.body.places.iter().map(|p| dot(*p, self.outward));
        let [low, high] = all.fold([f64::INFINITY, f64::NEG_INFINITY], |r, v| [r[0].min(v), r[1].max(v)]);
        self.extent = high - low;
        Ok(())
    }

    /// How the loaded patch touches.
    fn contact(&self) -> Contact {
        if self.flat.is_some() { self.params.contact } else { Contact::Sliding }
    }

    /// The patches with the loaded one moved in by `press` mm.
    fn pressed(&self, press: f64) -> Result<Vec<Patch>, StiffnessError> {
        let height = |n: u32| dot(self.body.places[n as usize], self.outward);
        let end = (0..self.body.places.len() as u32).map(height).fold(f64::NEG_INFINITY, f64::max);
        let depth = |n: u32| match &self.flat {
            Some(nodes) => {
                if nodes.binary_search(&n).is_ok() {
                    press
                } else {
                    0.0
                }
            }
            None => (height(n) - (end - press)).max(0.0),
        };
        let mut found = self.find(&self.motion(depth, |_| self.outward))?;
        found[1].contact = self.contact();
        Ok(found)
    }

    /// ln of the shear moduli of a body's regions over the `reference`'s.
    fn theta(&self, body: &Body, reference: usize) -> Vec<f64> {
        let mu = |label: u8| {
            let e = self.params.modulus(label).unwrap_or(1.0);
            e / (2.0 * (1.0 + self.params.stiffness.poisson_of(label)))
        };
        body.labels.iter().map(|&l| (mu(l) / mu(body.labels[reference])).ln()).collect()
    }

    /// The field of a press of `press` mm.
    fn simulate(&self, press: f64) -> Result<Simulated, StiffnessError> {
        if press > MAX_PRESS_FRACTION * self.extent {
            let range = "half of the body's extent along the load at most; press less";
            return Err(ParamError { name: "press", value: press, range }.into());
        }
        let mut body = self.body.clone();
        let patches = self.pressed(press)?;
        if let Some(nodes) = patches[1].near_contact(&body) {
            body.eliminate_last(&nodes)?;
        }
        let poisson: Vec<f64> = body.labels.iter().map(|&l| self.params.stiffness.poisson_of(l)).collect();
        let theta = self.theta(&body, 0);
        let setup = Setup {
            body: &body,
            law: Law::Linear,
            poisson,
            patches,
            observations: &[],
            reference: 0,
            plate_prior: 1.0,
            floor: 1.0,
            noise: None,
            open: &[],
            settled: false,
            pinned: Vec::new(),
        };
        let mut state = State { theta, ..setup.start() };
        let (problem, solution) = setup.solve(&state, FORWARD_TOLERANCE_MM)?;
        let force = setup.forces(&problem, &state, &solution.x)[0] * setup.leaning(&problem, &state, &solution.x);
        let e = self.params.modulus(body.labels[0]).unwrap_or(1.0);
        let kpa = e / (2.0 * (1.0 + setup.poisson[0]));
        let field = on_grid(&body, &solution.x, self.inputs.labels);
        state.x = Some(solution.x);
        Ok(Simulated { field, force_n: force * kpa / 1000.0, strain: summary::strain(&setup, &state) })
    }

    /// Error of the motion read at a surface node over the noise of a voxel (1).
    fn reading(&self) -> f64 {
        let grid = *self.inputs.labels.grid();
        let mut random = Random::new(1, 0);
        let noise = (0..3 * grid.len()).map(|_| random.normals()[0]).collect::<Vec<f64>>();
        let field = DenseField::from_voxels(grid, |o, _| std::array::from_fn(|a| noise[3 * o + a]));
        SurfaceMotion::new(&self.body, &field, self.inputs.labels).error
    }

    /// The parameters of a measurement of a press with the force `force` (N).
    fn measurement(&self, force: f64) -> StiffnessParams {
        let fixed = Vec::new();
        StiffnessParams { model: LawChoice::Linear, force_n: Some(force.abs()), fixed, ..self.params.stiffness.clone() }
    }
}

/// The displacement at the voxels of the labels; that of the nearest element where a voxel's centre
/// lies just outside the mesh.
fn on_grid(body: &Body, x: &[f64], labels: &Mask) -> DenseField {
    let grid = *labels.grid();
    let inside: Vec<usize> = (0..grid.len()).filter(|&o| labels.as_slice()[o] > 0).collect();
    let world = |o: usize| {
        let at = grid.voxel(o).map(|v| v as f64);
        grid.affine().to_world(crate::types::VoxelPoint(at)).0
    };
    let places: Vec<[f64; 3]> = inside.iter().map(|&o| world(o)).collect();
    let near = Neighbours::new(&body.places);
    let mut holder = vec![0u32; body.places.len()];
    for (e, nodes) in body.cells.iter().enumerate() {
        nodes.iter().for_each(|&n| holder[n as usize] = e as u32);
    }
    let beside = |p: [f64; 3]| {
        let &n = near.within(p, f64::INFINITY, 1).first()?;
        let nodes = body.cells[holder[n] as usize].map(|m| body.places[m as usize]);
        // One whose shape leads far away is not gone by.
        let l = Mapping::of(&nodes).locate(p).filter(|l| l.iter().all(|v| *v > -1.0));
        Some(match l {
            Some(l) => read(&[(holder[n], shapes(l))], body, x),
            None => body.displacement(x, n as u32),
        })
    };
    let mut values = vec![[0.0; 3]; grid.len()];
    for ((o, p), found) in inside.iter().zip(&places).zip(find(body, &places)) {
        values[*o] = match found {
            Some(reading) => read(&[reading], body, x),
            None => beside(*p).unwrap_or_default(),
        };
    }
    DenseField::from_voxels(grid, |o, _| values[o])
}

/// The field of one press on the assumed moduli, without noise.
///
/// # Errors
/// As [`run`].
///
/// ```
/// use palpate::pipeline::experimental_design::{PlanInputs, simulate};
/// use palpate::types::plan::PlanParams;
/// use palpate::types::stiffness::{LawChoice, Side};
/// use palpate::{Affine, Grid, Mask, Place, StiffnessParams};
/// // A block of 12 mm of one tissue, held at its base and pressed from above.
/// let grid = Grid::new([16; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let labels =
///     Mask::from_voxels(grid, |_, p| u8::from(p.0.iter().all(|x| (2.0..14.0).contains(x))));
/// let side = |name| Side::parse(name).map(Place::Side).ok_or("no side");
/// let (held, load) = (side("z-")?, side("z+")?);
/// let stiffness =
///     StiffnessParams { nodes: 500, model: LawChoice::Linear, ..StiffnessParams::default() };
/// let inputs =
///     PlanInputs { labels: &labels, held: &held, load: &load, names: &|_| "muscle".into() };
/// let params = PlanParams { moduli: vec![(1, 20.0)], stiffness, ..PlanParams::default() };
/// let press = simulate(&inputs, &params, 0.5)?;
/// // The pressed face moves down by half a millimetre, and the block resists.
/// assert!((press.field.at(grid.index(8, 8, 13))[2] + 0.5).abs() < 0.1);
/// assert!(press.force_n > 0.0);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn simulate(inputs: &PlanInputs<'_>, params: &PlanParams, press_mm: f64) -> Result<Simulated, StiffnessError> {
    Bench::new(inputs, params)?.simulate(press_mm)
}

/// The information of one solved press, and what it takes to scale it.
struct Solved {
    /// The press that was solved for (mm).
    press: f64,
    /// Largest principal strain there (1).
    strain: f64,
    /// Force there (N).
    force: f64,
    /// Free moduli, and plate parameters after them; offsets follow.
    counts: [usize; 2],
    /// Sum over the samples of the products of the parameters' columns (mm^2), row by row.
    information: Vec<f64>,
    /// 1 / variance of each parameter's prior, on voxels of the labels' size.
    prior: Vec<f64>,
    /// Derivative of ln force by each parameter.
    force_slope: Vec<f64>,
    /// For each region its number among the free moduli.
    free: Vec<Option<usize>>,
    /// Error of ln E (and of ln of its ratio) by the mesh, for each region.
    mesh: Vec<[f64; 2]>,
    /// What the mesh leaves over (mm, root mean square of one component).
    rest: f64,
    /// The error of the finite elements (mm).
    floor: f64,
    /// The plates' prior without noise (mm), on voxels of the labels' size.
    plate_prior: f64,
    /// Voxels of the body, voxels along the edge of a block, samples.
    sampled: (usize, usize, f64),
    /// Regions that the field shows nothing of.
    hidden: Vec<bool>,
    /// Whether those bear so much force that others are bounds.
    hidden_load: bool,
    /// Regions so far from the reference that they are as good as rigid or empty.
    far: Vec<bool>,
    /// The region that ratios refer to.
    reference: usize,
}

impl Solved {
    fn new(bench: &Bench<'_>, press: f64) -> Result<Self, StiffnessError> {
        let Simulated { field, force_n, strain } = bench.simulate(press)?;
        let PlanInputs { labels, held, load, names } = *bench.inputs;
        let quality = FieldQuality::default();
        let inputs = Inputs { field: &field, matches: None, labels, labelled: true, held, load, names, quality };
        let params = bench.measurement(force_n);
        let mut level = BodyMeshes::new(&inputs, &params)?.coarse;
        level.patches[0].contact = Contact::Sticking;
        level.patches[1].contact = bench.contact();
        level.settle_shape()?;
        Self::of(bench, &level, &params, press, force_n, strain)
    }

    fn of(
        bench: &Bench<'_>,
        level: &Level,
        params: &StiffnessParams,
        press: f64,
        force: f64,
        strain: f64,
    ) -> Result<Self, StiffnessError> {
        let reference = level.largest();
        let mut setup = level.setup(Law::Linear, params, reference);
        let theta = bench.theta(&level.body, reference);
        let mut estimate = true_state(&setup, &theta)?;
        // A region that the data do not show counts as known for the others.
        let (mut hidden, mut hidden_load) = (vec![false; theta.len()], 0.0);
        while let Some(found) = summary::least_seen(&setup, &estimate) {
            let Some(r) = level.body.labels.iter().position(|l| *l == found.label) else { break };
            (hidden[r], hidden_load) = (true, hidden_load + found.share);
            setup.pinned.push((r, theta[r]));
            estimate = true_state(&setup, &theta)?;
        }
        let interfaces = Interface::all(bench.inputs.labels);
        let Open { rows, force_slope, sigma } = geometry::open(&setup, &estimate, &level.grid, &interfaces)?;
        let left = Geometry {
            step: last_step(&setup, &estimate)?,
            covariance: vec![0.0; estimate.parameters * estimate.parameters],
            ..Geometry::default()
        };
        let found = summary::moduli(&setup, &estimate, Some(&left), Scale::Force(force.abs())).log;
        let change = |r: usize| bench.params.modulus(level.body.labels[r]).unwrap_or(1.0).ln() - found[r];
        let mesh =
            (0..theta.len()).map(|r| [mesh_error(change(r)), mesh_error(change(r) - change(reference))]).collect();
        let all: Vec<&Vec<[f64; 3]>> = estimate.rows.iter().chain(&rows).collect();
        let product = |i: usize| {
            let (a, b) = (all[i / all.len()], all[i % all.len()]);
            a.iter().zip(b).map(|(u, v)| dot(*u, *v)).sum::<f64>()
        };
        let mut prior: Vec<f64> = setup.prior_terms(&estimate.state).iter().map(|p| p.0).collect();
        prior.extend(sigma.iter().map(|s| s.powi(-2)));
        let free = setup.free();
        let inside = bench.inputs.labels.as_slice().iter().filter(|l| **l > 0).count();
        Ok(Self {
            press,
            strain,
            force,
            counts: [free.len(), estimate.parameters],
            information: (0..all.len() * all.len()).map(product).collect(),
            prior,
            force_slope: estimate.force_slope.iter().chain(&force_slope).copied().collect(),
            free: (0..theta.len()).map(|r| free.iter().position(|f| *f == r)).collect(),
            mesh,
            rest: estimate.rms,
            floor: setup.floor,
            plate_prior: setup.plate_prior,
            sampled: (inside, level.block.max(1), estimate.residuals.len() as f64),
            hidden,
            hidden_load: hidden_load > MIN_LOAD_SHARE,
            far: theta.iter().map(|t| t.abs() > MAX_IDENTIFIED_CONTRAST_LN).collect(),
            reference,
        })
    }

    /// Relative standard deviation of each region's modulus and its scatter by noise alone, at
    /// `press` mm, voxels `voxel` times those of the labels, `noise` mm in each, and `surface` mm
    /// in the motion of a surface node.
    fn expected(&self, press: f64, voxel: f64, [noise, surface]: [f64; 2], ratios: bool) -> Option<Vec<[f64; 2]>> {
        let p = self.prior.len();
        let [moduli, plates] = self.counts;
        let deeper = press / self.press;
        // A unit of a plate's parameter is a mm whatever the press; moduli and offsets change what
        // the press makes.
        let is_plate = |k: usize| (moduli..plates).contains(&k);
        let factor = |k: usize| if is_plate(k) { 1.0 } else { deeper };
        let (inside, block, samples) = self.sampled;
        let voxels = inside as f64 / voxel.powi(3);
        let wide = block_for(voxels as usize) as f64;
        let count = samples * (block as f64 / (voxel * wide)).powi(3);
        if count < MIN_OBSERVATIONS as f64 {
            return None;
        }
        let model = (deeper * self.rest).max(voxel * self.floor);
        let variance = noise * noise / wide.powi(3) + model * model;
        let weight = count / samples / variance;
        let information: Vec<f64> =
            (0..p * p).map(|i| self.information[i] * factor(i / p) * factor(i % p) * weight).collect();
        // Offsets are in voxels; plates are known to a part of one, and to the noise.
        let looser = (voxel * self.plate_prior + plate_prior(0.0, surface)) / self.plate_prior;
        let prior = |k: usize| match k {
            _ if k < moduli => self.prior[k],
            _ if k < plates => self.prior[k] / (looser * looser),
            _ => self.prior[k] / (voxel * voxel),
        };
        let inverse = |dilution: f64| {
            let mut a: Vec<f64> = information.iter().map(|v| v / dilution).collect();
            (0..p).for_each(|k| a[k * p + k] += prior(k));
            Some(Cholesky::new(a, p)?.inverse())
        };
        let stated = geometry::with_mesh(inverse(1.0)?, p, plates, voxel);
        // The model's own error is everywhere at once, and offsets are fitted with samples that
        // count for less; that is what makes moduli scatter.
        let dilution = dilution(model * model / variance, 3.0 * count).max(1.0);
        let fitted = inverse(dilution)?;
        let stated: Vec<f64> = stated.iter().zip(&fitted).map(|(a, b)| a + b).collect();
        let slope = |k: usize| if is_plate(k) { self.force_slope[k] / deeper } else { self.force_slope[k] };
        let one = |r: usize| {
            let gradient: Vec<f64> = (0..p)
                .map(|k| f64::from(u8::from(self.free[r] == Some(k))) - if ratios { 0.0 } else { slope(k) })
                .collect();
            let through =
                |a: &[f64]| -> Vec<f64> { (0..p).map(|i| dense::dot(&a[i * p..(i + 1) * p], &gradient)).collect() };
            let data = dense::dot(&gradient, &through(&stated));
            let by = through(&fitted);
            let scatter: f64 = (0..p).map(|i| by[i] * dense::dot(&information[i * p..(i + 1) * p], &by)).sum::<f64>();
            let mesh = self.mesh[r][usize::from(ratios)];
            [(data.max(0.0) + mesh * mesh).sqrt(), scatter.max(0.0).sqrt() / dilution]
        };
        Some((0..self.free.len()).map(one).collect())
    }

    /// Whether a region is known, and not just a bound, with a deviation of `sd`.
    fn determines(&self, r: usize, sd: f64, ratios: bool) -> bool {
        sd <= MAX_IDENTIFIED_SD_LN && !self.hidden[r] && !self.far[r] && (ratios || !self.hidden_load)
    }
}

/// The estimate at given moduli, with the plates as the field has them.
fn true_state(setup: &Setup<'_>, theta: &[f64]) -> Result<Estimate, StiffnessError> {
    setup.run(State { theta: theta.to_vec(), ..setup.start() }, 0, FORWARD_TOLERANCE_MM)
}

/// The step of all parameters that an estimate would still take, to first order.
fn last_step(setup: &Setup<'_>, estimate: &Estimate) -> Result<Vec<f64>, StiffnessError> {
    let (p, rows) = (estimate.parameters, &estimate.rows);
    let sum = |a: &[[f64; 3]], b: &[[f64; 3]]| a.iter().zip(b).map(|(u, v)| dot(*u, *v)).sum::<f64>();
    let mut a: Vec<f64> = (0..p * p).map(|i| sum(&rows[i / p], &rows[i % p])).collect();
    let variance = estimate.rms * estimate.rms;
    let prior = setup.prior_terms(&estimate.state);
    (0..p).for_each(|k| a[k * p + k] += variance * prior[k].0);
    let mut step: Vec<f64> = rows.iter().map(|row| sum(row, &estimate.residuals)).collect();
    Cholesky::new(a, p).ok_or(StiffnessError::Unsolvable)?.solve(&mut step);
    Ok(step)
}

fn sorted(mut values: Vec<f64>) -> Vec<f64> {
    values.sort_by(f64::total_cmp);
    values.dedup();
    values
}

/// The expected deviation of each modulus for every press, voxel size and noise.
///
/// # Errors
/// [`StiffnessError`] for parameters out of range, a label without a modulus, a body that is not
/// whole, patches that are not found, and equations that cannot be solved for any press.
///
/// ```
/// use palpate::pipeline::experimental_design::{PlanInputs, run};
/// use palpate::types::plan::PlanParams;
/// use palpate::types::stiffness::{LawChoice, Side};
/// use palpate::{Affine, Grid, Mask, Place, StiffnessParams};
/// // A block of 12 mm of one tissue, held at its base and pressed from above.
/// let grid = Grid::new([16; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let labels =
///     Mask::from_voxels(grid, |_, p| u8::from(p.0.iter().all(|x| (2.0..14.0).contains(x))));
/// let side = |name| Side::parse(name).map(Place::Side).ok_or("no side");
/// let (held, load) = (side("z-")?, side("z+")?);
/// let stiffness =
///     StiffnessParams { nodes: 500, model: LawChoice::Linear, ..StiffnessParams::default() };
/// let inputs =
///     PlanInputs { labels: &labels, held: &held, load: &load, names: &|_| "muscle".into() };
/// let params = PlanParams { moduli: vec![(1, 20.0)], stiffness, ..PlanParams::default() };
/// let plan = run(
///     &inputs,
///     &PlanParams { press_mm: vec![0.5], noise_mm: vec![0.05], ..params },
///     &|_, _| {},
/// )?;
/// assert_eq!(plan.of(1).count(), 1);
/// assert!(plan.is_felt());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn run(inputs: &PlanInputs<'_>, params: &PlanParams, progress: Progress<'_>) -> Result<Plan, StiffnessError> {
    let mut clock = Clock::start();
    progress("mesh", 0.0);
    let bench = Bench::new(inputs, params)?;
    let given = &params.press_mm;
    let usual = || PlanParams::DEFAULT_PRESSES.map(|part| part * bench.extent).to_vec();
    let presses = sorted(if given.is_empty() { usual() } else { given.clone() });
    let own = bench.voxel();
    let voxels = sorted(if params.voxel_mm.is_empty() { vec![own] } else { params.voxel_mm.clone() });
    clock.book("mesh");

    let mut warnings = Vec::new();
    let solved = Presses::solved(&bench, &presses, &mut warnings, progress)?;
    clock.book("presses");
    let (body, reference) = (&bench.body, solved.first.reference);
    let planned = |r: usize| PlannedRegion {
        label: body.labels[r],
        name: (inputs.names)(body.labels[r]),
        youngs_modulus: params.modulus(body.labels[r]).unwrap_or(f64::NAN),
        volume: body.volumes[r],
        wanted: !params.ratios || r != reference,
    };
    let regions: Vec<PlannedRegion> = (0..body.labels.len()).map(planned).collect();
    let options = Options { bench: &bench, params, presses: &presses, solved: &solved, regions: &regions };
    let (expected, least_press) = options.expected(&voxels, &mut warnings)?;
    let press_at = |&press: &f64| {
        let solved = solved.of(press)?;
        let deeper = press / solved.press;
        Some(Press { press_mm: press, strain: deeper * solved.strain, force_n: deeper * solved.force.abs() })
    };
    let presses: Vec<Press> = presses.iter().filter_map(press_at).collect();
    warnings.extend(large_strain(&presses));
    clock.book("options");
    Ok(Plan {
        want: params.want,
        ratios: params.ratios,
        regions,
        sides: [inputs.held.name(), inputs.load.name()],
        contact: bench.contact(),
        extent_mm: bench.extent,
        label_voxel_mm: own,
        presses,
        least_press_mm: least_press,
        voxel_mm: voxels,
        expected,
        warnings,
        seconds: clock.0,
    })
}

/// The solutions of all presses.
struct Presses {
    first: Solved,
    /// Those after the first, with their presses (mm).
    others: Vec<(f64, Solved)>,
    /// The press of the first one, where it does not serve all: of a flat patch one solution does,
    /// a curved one touches with more of itself.
    own: Option<f64>,
}

impl Presses {
    /// # Errors
    /// Where no press can be solved, or one is out of range.
    fn solved(
        bench: &Bench<'_>,
        presses: &[f64],
        warnings: &mut Vec<String>,
        progress: Progress<'_>,
    ) -> Result<Self, StiffnessError> {
        let wanted = if bench.flat.is_some() { &presses[presses.len() - 1..] } else { presses };
        let (mut solved, mut failure) = (Vec::new(), None);
        for (i, &press) in wanted.iter().enumerate() {
            progress("press", 0.1 + 0.85 * i as f64 / wanted.len() as f64);
            match Solved::new(bench, press) {
                Ok(found) => solved.push((press, found)),
                Err(error @ StiffnessError::Param(_)) => return Err(error),
                Err(error) => {
                    warnings.push(format!("a press of {press:.3} mm is left out: {error}"));
                    failure = Some(error);
                }
            }
        }
        let mut solved = solved.into_iter();
        let Some((press, first)) = solved.next() else {
            return Err(failure.unwrap_or(StiffnessError::NoEquilibrium));
        };
        Ok(Self { first, others: solved.collect(), own: bench.flat.is_none().then_some(press) })
    }

    fn of(&self, press: f64) -> Option<&Solved> {
        match self.own {
            Some(own) if own != press => self.others.iter().find(|s| s.0 == press).map(|s| &s.1),
            _ => Some(&self.first),
        }
    }
}

/// What is compared: presses by voxel sizes by noises.
struct Options<'a> {
    bench: &'a Bench<'a>,
    params: &'a PlanParams,
    presses: &'a [f64],
    solved: &'a Presses,
    regions: &'a [PlannedRegion],
}

impl Options<'_> {
    /// The expected deviations, and the least press (mm) that stands out of the noise.
    ///
    /// # Errors
    /// Where the body holds too few voxels of any size.
    fn expected(&self, voxels: &[f64], warnings: &mut Vec<String>) -> Result<(Vec<Expected>, f64), StiffnessError> {
        let reading = self.bench.reading();
        let (mut expected, mut least_press, mut unfelt) = (Vec::new(), f64::INFINITY, Vec::new());
        for &voxel in voxels {
            let given = &self.params.noise_mm;
            let usual = || PlanParams::DEFAULT_NOISES.map(|part| part * voxel).to_vec();
            let noises = sorted(if given.is_empty() { usual() } else { given.clone() });
            let before = expected.len();
            for noise in noises {
                let least = least_travel(reading * noise, voxel);
                least_press = least_press.min(least);
                if self.presses[0] <= least {
                    unfelt.push(format!("{least:.3} mm at {noise:.3} mm of noise"));
                }
                for &press in self.presses {
                    expected.extend(self.of(press, voxel, [noise, reading * noise], press > least));
                }
            }
            if expected.len() == before {
                warnings.push(format!(
                    "voxels of {voxel} mm are too few in this body: {MIN_OBSERVATIONS} samples are needed; take smaller ones"
                ));
            }
        }
        if expected.is_empty() {
            let range = "small enough that the body holds 100 voxels; take smaller ones";
            return Err(ParamError { name: "voxel", value: voxels[0], range }.into());
        }
        unfelt.dedup();
        if !unfelt.is_empty() {
            let all = unfelt.join(", ");
            warnings
                .push(format!("`stiffness` refuses a press that does not stand out of the noise: it must pass {all}"));
        }
        Ok((expected, least_press))
    }

    /// Each region under one press (mm), with voxels (mm), noise inside and on the surface (mm);
    /// `felt` tells whether the press stands out of it.
    fn of(&self, press: f64, voxel: f64, noise: [f64; 2], felt: bool) -> Vec<Expected> {
        let ratios = self.params.ratios;
        let Some(solved) = self.solved.of(press) else { return Vec::new() };
        let Some(found) = solved.expected(press, voxel / self.bench.voxel(), noise, ratios) else { return Vec::new() };
        let of = |(r, (region, [sd, scatter])): (usize, (&PlannedRegion, [f64; 2]))| {
            let determined = felt && solved.determines(r, sd, ratios);
            Expected {
                press_mm: press,
                voxel_mm: voxel,
                noise_mm: noise[0],
                label: region.label,
                name: region.name.clone(),
                sd,
                scatter,
                felt,
                determined,
                enough: determined && region.wanted && sd <= self.params.want,
            }
        };
        self.regions.iter().zip(found).enumerate().map(of).collect()
    }
}

/// Warns where strains pass those of a linear law.
fn large_strain(presses: &[Press]) -> Option<String> {
    let large: Vec<String> =
        presses.iter().filter(|p| p.strain > LARGE_STRAIN).map(|p| format!("{:.3}", p.press_mm)).collect();
    (!large.is_empty()).then(|| {
        format!(
            "strains pass {:.0} % at {} mm: the plan's law is linear, and `stiffness` takes the neo-Hookean one there",
            100.0 * LARGE_STRAIN,
            large.join(", ")
        )
    })
}
