//! A displacement field to Young's modulus, region by region.

use crate::error::StiffnessError;
use crate::mesh::tetrahedral::{Detail, Fineness, Mesher, Wall, pieces};
use crate::numerics::sampling::nearest;
use crate::pipeline::search;
use crate::stiffness::choice::{choose, settle};
use crate::stiffness::identify::State;
use crate::stiffness::inclusion::Inclusion;
use crate::stiffness::interface::Interface;
use crate::stiffness::level::Level;
use crate::stiffness::patches::Place;
use crate::stiffness::rim::{Outline, rim};
use crate::stiffness::summary::Shape;
use crate::stiffness::turn::Turn;
use crate::stiffness::{geometry, maps, summary};
use crate::types::stiffness::{Evidence, PatchReport, StiffnessParams, StiffnessResult};
use crate::types::{Displacement, Mask, QuadraticMesh, SparseField, WorldPoint};
use std::time::Instant;

/// Called with a stage's name and the fraction of the whole that is done (0 to 1); may be called
/// from any thread.
pub type Progress<'a> = &'a (dyn Fn(&str, f64) + Sync);

/// What is given.
#[derive(Clone, Copy)]
pub struct Inputs<'a> {
    /// The displacement, on the grid of `labels`.
    pub field: &'a Displacement<'a>,
    /// Matches to use in place of the field inside the body.
    pub matches: Option<&'a SparseField>,
    /// Regions; 0 outside the body.
    pub labels: &'a Mask,
    /// Whether the labels name regions, or are a mask.
    pub labelled: bool,
    /// Where the body is held.
    pub held: &'a Place,
    /// Where it is pressed.
    pub load: &'a Place,
    /// A name for each label.
    pub names: &'a dyn Fn(u8) -> String,
}

/// Matches that a body must hold for them to be taken unasked: what an identification needs, and a
/// tenth that the mesh may leave out at the surface. Of fingertips with 104 to 134 the pulp came
/// out right within its deviation, from their fields wrong by two to five of them.
pub const ENOUGH: usize = 110;

/// Kept matches in the body.
pub fn inside(matches: &SparseField, labels: &Mask) -> usize {
    let grid = labels.grid();
    let held = |p: WorldPoint| {
        let v = grid.affine().to_voxel(p);
        nearest(grid.shape(), v).is_some_and(|o| labels.as_slice()[o] > 0)
    };
    matches.kept().filter(|m| held(m.initial)).count()
}

/// Nodes of the coarse mesh over those of the fine one.
const COARSE: f64 = 0.3;
/// Side of the mesh's cubes at the rim of a punch (voxels); nodes lie at half of it.
const RIM: f64 = 2.0;
/// Parts of the nodes that are tried for the rest of the body then.
const ELSEWHERE: [f64; 5] = [0.7, 0.4, 0.25, 0.15, 0.08];
/// Times that side, where so many nodes are not to be had.
const COARSER: [f64; 3] = [1.0, 1.5, 2.5];
/// Nodes over the limit at most, where a mesh can be had.
const OVER: f64 = 1.15;
/// Moves of a punch's edge on the fine mesh at most: the coarse one has found most of the way.
const FINE_MOVES: usize = 1;
/// Precision of forward solutions on the fine mesh (mm).
const PRECISION: f64 = 1e-5;

/// Young's modulus of each labelled region, or of the regions that the data support.
///
/// # Errors
/// [`StiffnessError`] when the input does not fit together or the equations cannot be solved.
pub fn run(
    inputs: &Inputs<'_>,
    params: &StiffnessParams,
    progress: Progress<'_>,
) -> Result<StiffnessResult, StiffnessError> {
    params.check()?;
    whole(inputs.labels)?;
    let (result, turn) = without_turn(inputs, |inputs| unturned(inputs, params, progress));
    let mut result = result?;
    result.warnings.extend(turn.map(|turn| {
        format!(
            "the body turned by {:.1} degrees as a whole; that was taken out first, and the displacements of the mesh and of the exported \
             models are without it",
            turn.degrees()
        )
    }));
    Ok(result)
}

/// What `then` makes of the inputs without a turn of the whole body, and that turn, if any.
fn without_turn<R>(inputs: &Inputs<'_>, then: impl FnOnce(&Inputs<'_>) -> R) -> (R, Option<Turn>) {
    let Some(turn) = Turn::of(inputs.field, inputs.labels) else { return (then(inputs), None) };
    let (field, matches) = (turn.undone(inputs.field), inputs.matches.map(|m| turn.undone_matches(m)));
    (then(&Inputs { field: &field, matches: matches.as_ref(), ..*inputs }), Some(turn))
}

/// [`run`] for a body that did not turn.
fn unturned(
    inputs: &Inputs<'_>,
    params: &StiffnessParams,
    progress: Progress<'_>,
) -> Result<StiffnessResult, StiffnessError> {
    if inputs.labelled {
        return labelled(inputs, params, Vec::new(), progress);
    }
    let found = search::regions(inputs, params, &|s, f| progress(s, 0.5 * f))?;
    let inputs = Inputs { labels: &found.labels, ..*inputs };
    let mut result = labelled(&inputs, params, found.evidence, &|s, f| progress(s, 0.5 + 0.5 * f))?;
    result.warnings.extend(found.left_over.and_then(maps::left_over));
    result.left_over = found.left_over;
    result.found = Some(found.labels);
    result.seconds.insert(0, ("search".into(), found.seconds));
    Ok(result)
}

/// How fine the mesh is on which all is chosen.
pub(super) fn coarse_fineness(labels: &Mask, params: &StiffnessParams) -> Fineness {
    Fineness::for_nodes(maps::volume(labels), (COARSE * params.nodes as f64) as usize)
}

/// What [`run`] would refuse before it looks for moduli: told from a coarse mesh.
///
/// # Errors
/// As [`run`].
pub fn check(inputs: &Inputs<'_>, params: &StiffnessParams) -> Result<(), StiffnessError> {
    params.check()?;
    whole(inputs.labels)?;
    let mesh = Mesher::new(inputs.labels)?.mesh(&coarse_fineness(inputs.labels, params))?;
    let level = |i: &Inputs<'_>| Level::new(&mesh, i.field, i.matches, i.labels, i.held, i.load, None).map(|_| ());
    without_turn(inputs, level).0
}

/// The chain for labelled regions; `tried` is the evidence that led to them.
fn labelled(
    inputs: &Inputs<'_>,
    params: &StiffnessParams,
    tried: Vec<Evidence>,
    progress: Progress<'_>,
) -> Result<StiffnessResult, StiffnessError> {
    let mut clock = Clock { seconds: Vec::new(), since: Instant::now() };
    progress("mesh", 0.0);
    let volume = maps::volume(inputs.labels);
    let mesher = Mesher::new(inputs.labels)?;
    let coarse_mesh = mesher.mesh(&coarse_fineness(inputs.labels, params))?;
    clock.book("mesh");

    progress("observe", 0.05);
    let level = |mesh: &QuadraticMesh, outline: Option<&Outline>| {
        Level::new(mesh, inputs.field, inputs.matches, inputs.labels, inputs.held, inputs.load, outline)
    };
    let mut coarse = level(&coarse_mesh, None)?;
    let rim = rim(&coarse.patches[1], inputs.field, inputs.labels, coarse.tolerance(), coarse.near);
    let outline = rim.outline.as_ref();
    let within = outline.map(|o| |p| o.within(p));
    let wall = within.as_ref().map(|w| w as Wall<'_>);
    let detail = |size: f64| Detail { near: &rim.places, size: size * coarse.voxel, wall };
    let meshed = |nodes: f64, size: f64| {
        if rim.places.is_empty() {
            let mesh = mesher.mesh(&Fineness::for_nodes(volume, nodes as usize))?;
            let count = mesh.nodes().len() as f64;
            // Thin layers and a rough surface take more than a block does.
            return match count <= OVER * nodes {
                true => Ok(mesh),
                false => mesher.mesh(&Fineness::for_nodes(volume, (nodes * nodes / count) as usize)),
            };
        }
        // How many nodes the rim takes hangs on how the cubes come to halve: of a few meshes the
        // finest within the limit.
        let mut best: Option<(f64, Fineness, Detail<'_>)> = None;
        for coarser in COARSER {
            for elsewhere in ELSEWHERE {
                let fineness = Fineness::for_nodes(volume, (elsewhere * nodes) as usize);
                let detail = detail(coarser * size);
                let Some(count) = mesher.nodes(&fineness, detail) else { continue };
                let count = count as f64 / nodes;
                let rank = if count <= OVER { -count } else { count };
                if best.as_ref().is_none_or(|(least, ..)| rank < *least) {
                    best = Some((rank, fineness, detail));
                }
            }
            if best.as_ref().is_some_and(|(rank, ..)| *rank < 0.0) {
                break;
            }
        }
        // Where none of them keeps all parts, the mesher goes on to smaller cubes.
        let plain = (Fineness::for_nodes(volume, nodes as usize), detail(size));
        let (fineness, detail) = best.map_or(plain, |(_, fineness, detail)| (fineness, detail));
        mesher.mesh_finer(&fineness, detail)
    };
    let fine_mesh = meshed(params.nodes as f64, RIM)?;
    if !rim.places.is_empty() {
        let mesh = meshed(COARSE * params.nodes as f64, 2.0 * RIM)?;
        coarse = level(&mesh, outline)?;
    }
    let mut fine = level(&fine_mesh, outline)?;
    coarse.agree_on_shape(&mut fine)?;
    let reference = fine.largest();
    clock.book("observe");

    progress("coarse", 0.1);
    let mut choice = choose(&mut coarse, params.model, params.poisson, reference)?;
    let mut hidden = Vec::new();
    while let Some(found) = summary::least_seen(&coarse.setup(choice.law, params.poisson, reference), &choice.estimate)
    {
        hidden.push(found);
        coarse.hidden.push(found.label);
        choice = choose(&mut coarse, params.model, params.poisson, reference)?;
    }
    fine.hidden.clone_from(&coarse.hidden);
    clock.book("coarse");

    progress("fine", 0.4);
    fine.touch_like(&coarse)?;
    let start = State { plates: choice.estimate.state.plates.clone(), ..fine.carry(&coarse, &choice.estimate.state) };
    let estimate = fine.setup(choice.law, params.poisson, reference).run(start, 3, PRECISION)?;
    let estimate = settle(&mut fine, choice.law, params.poisson, reference, estimate, (FINE_MOVES, PRECISION))?;
    clock.book("fine");

    progress("uncertainty", 0.9);
    let setup = fine.setup(choice.law, params.poisson, reference);
    let coarse_setup = coarse.setup(choice.law, params.poisson, reference);
    let inclusions = if inputs.labelled { Vec::new() } else { Inclusion::all(inputs.labels) };
    // Of regions that were found the shapes are open as a whole.
    let interfaces = if inputs.labelled { Interface::all(inputs.labels) } else { Interface::walls(inputs.labels) };
    let geometry = geometry::fit(&coarse_setup, &choice.estimate, inputs.labels.grid(), (&interfaces, &inclusions))?;
    let corrected = |step: &[f64]| {
        let x = estimate.state.x.as_deref().unwrap_or_default();
        setup.advanced(&estimate.state, x, &estimate.columns, step)
    };
    let state = geometry.as_ref().map_or_else(|| estimate.state.clone(), |g| corrected(&g.step));
    let noise = maps::noise(inputs.field, inputs.labels);
    let alone = summary::moduli(&setup, &estimate, None, params.force_n);
    let moduli = summary::moduli(&setup, &estimate, geometry.as_ref(), params.force_n)
        .widened(&alone, summary::coherent(&estimate, fine.sample_noise(noise)));
    let before = summary::moduli(&coarse_setup, &choice.estimate, geometry.as_ref(), params.force_n);
    let count = fine.body.labels.len();
    let mesh_change: Vec<f64> = (0..count).map(|r| moduli.log[r] - before.log[r]).collect();
    let ratio_change: Vec<f64> = (0..count).map(|r| mesh_change[r] - mesh_change[reference]).collect();
    let unseen = (0..count)
        .map(|r| summary::unseen(&coarse_setup, &choice.estimate, r, moduli.ratio_variance[r]))
        .collect::<Result<Vec<_>, _>>()?;
    let changes = [mesh_change.as_slice(), &ratio_change];
    let drawn = |label: &u8| geometry.is_some() && inclusions.iter().any(|i| i.label() == *label);
    let shape = |label: &u8| match (inputs.labelled || *label == 1, drawn(label)) {
        (true, _) => Shape::Given,
        (false, true) => Shape::Drawn,
        (false, false) => Shape::Cut,
    };
    let shapes: Vec<Shape> = fine.body.labels.iter().map(shape).collect();
    let regions = summary::regions(
        &fine.body,
        [&moduli, &alone],
        inputs.names,
        changes,
        &unseen,
        &shapes,
        &hidden,
        params.force_n.is_some(),
        reference,
    );
    clock.book("uncertainty");

    let of_region = |f: &dyn Fn(usize) -> f64| maps::by_label(inputs.labels, &fine.body.labels, f);
    let map = of_region(&|r| regions[r].youngs_modulus);
    let map_sd = of_region(&|r| regions[r].sd);
    let residual = maps::residual(inputs.labels, &fine.observations, &estimate.residuals, fine.block);
    let touching = [None, setup.touching(&state)];
    let area = |i: usize| touching[i].as_ref().map_or_else(|| fine.patches[i].area(&fine.body), |t| t.1);
    let mut warnings = maps::unfit(inputs.field, inputs.labels, &fine, &estimate, noise);
    warnings.extend(maps::warnings(&fine, inputs.labels, &regions, &mesh_change, area(1), params));
    warnings.extend(params.force_n.and_then(|force| maps::leaning(force, estimate.leaning)));
    warnings.extend(maps::not_shown(&hidden, &regions, reference));
    warnings.dedup();
    let patches = [0, 1].map(|i| {
        let p = &fine.patches[i];
        PatchReport {
            name: p.name.clone(),
            area: area(i),
            nodes: touching[i].as_ref().map_or(p.nodes.len(), |t| t.0.len()),
            contact: p.contact,
            translation: [p.rigid[0], p.rigid[1], p.rigid[2]],
            travel_mm: p.travelled(&fine.body),
            residual_mm: p.residual[0].hypot(p.residual[1]),
        }
    });
    let scale = moduli.log[reference].exp() / (2.0 * (1.0 + params.poisson));
    let element_modulus = fine.body.region.iter().map(|&r| moduli.log[r as usize].exp()).collect();
    let strain = summary::strain(&setup, &state);
    clock.book("maps");
    Ok(StiffnessResult {
        correlation: summary::correlation(&moduli.covariance, count),
        absolute: params.force_n.is_some(),
        law: choice.law,
        poisson: params.poisson,
        force_n: params.force_n,
        reference: fine.body.labels[reference],
        residual_mm: estimate.rms,
        noise_mm: noise,
        evidence: tried.into_iter().chain(choice.evidence).collect(),
        patches,
        map,
        map_sd,
        residual,
        element_modulus,
        displacement: maps::node_displacement(&fine.body, &state),
        prescribed: maps::prescribed(&setup, &state, touching.each_ref().map(|t| t.as_ref().map(|t| t.0.as_slice()))),
        faces: geometry.map(|g| g.faces).unwrap_or_default(),
        model_force: estimate.force[0] * estimate.leaning * scale / 1000.0,
        mesh_change,
        strain,
        warnings,
        seconds: clock.seconds,
        samples: [3.0 * estimate.residuals.len() as f64, estimate.effective],
        labelled: inputs.labelled,
        left_over: None,
        found: None,
        regions,
        mesh: fine.moved(fine_mesh)?,
    })
}

/// The body must have three dimensions and hang together.
fn whole(labels: &Mask) -> Result<(), StiffnessError> {
    let grid = labels.grid();
    let (mut low, mut high) = ([usize::MAX; 3], [0; 3]);
    for o in (0..grid.len()).filter(|&o| labels.as_slice()[o] > 0) {
        let at = grid.voxel(o);
        (0..3).for_each(|a| (low[a], high[a]) = (low[a].min(at[a]), high[a].max(at[a])));
    }
    if let Some(a) = (0..3).find(|&a| low[a] == high[a]) {
        return Err(StiffnessError::Flat { axis: ['x', 'y', 'z'][a] });
    }
    let found = pieces(labels);
    match found[..] {
        [largest, next, ..] => Err(StiffnessError::Disconnected {
            what: "the body (mask or labels)".into(),
            pieces: found.len(),
            largest,
            next,
        }),
        _ => Ok(()),
    }
}

struct Clock {
    seconds: Vec<(String, f64)>,
    since: Instant,
}

impl Clock {
    fn book(&mut self, stage: &str) {
        self.seconds.push((stage.into(), self.since.elapsed().as_secs_f64()));
        self.since = Instant::now();
    }
}
