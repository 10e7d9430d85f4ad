//! The two meshes of a body whose stiffness is found: a coarse one, on which models are selected,
//! and a fine one, on which moduli are found.

use crate::error::StiffnessError;
use crate::mesh::tetrahedral::{Detail, Fineness, Mesher, Wall, pieces};
use crate::pipeline::stiffness::Inputs;
use crate::stiffness::fields;
use crate::stiffness::indenter_outline::{Outline, Rim, rim};
use crate::stiffness::mesh_problem::Level;
use crate::types::stiffness::StiffnessParams;
use crate::types::{Mask, QuadraticMesh};

/// Size of the coarse mesh, on which models are selected.
struct CoarseMesh {
    /// Nodes over those of the fine mesh.
    node_fraction: f64,
    /// Most nodes asked for (edges of a punch and thin layers take more): the noise of the data
    /// decides a choice long before the mesh does.
    max_nodes: f64,
}

const COARSE_MESH: CoarseMesh = CoarseMesh { node_fraction: 0.3, max_nodes: 3_000.0 };

/// The mesh at the rim of a punch.
struct RimMesh {
    /// Edge of the cubes (voxels); nodes lie at half of it.
    edge_voxels: f64,
    /// Fractions of the nodes that are tried for the rest of the body.
    elsewhere_fractions: [f64; 5],
    /// Factors on the edge that are tried if the nodes do not suffice for it.
    coarsening: [f64; 3],
}

const RIM_MESH: RimMesh =
    RimMesh { edge_voxels: 2.0, elsewhere_fractions: [0.7, 0.4, 0.25, 0.15, 0.08], coarsening: [1.0, 1.5, 2.5] };

/// Most nodes of a mesh over the requested number.
const MAX_NODE_EXCESS: f64 = 1.15;

/// How fine the mesh is on which all is chosen.
pub(super) fn coarse_fineness(labels: &Mask, params: &StiffnessParams) -> Fineness {
    Fineness::for_nodes(fields::volume(labels), coarse_nodes(params) as usize)
}

/// Nodes of the mesh on which all is chosen.
fn coarse_nodes(params: &StiffnessParams) -> f64 {
    (COARSE_MESH.node_fraction * params.nodes as f64).min(COARSE_MESH.max_nodes)
}

/// A body on the mesh on which all is chosen, and on the one that counts.
pub(super) struct BodyMeshes {
    /// Where all is chosen.
    pub coarse: Level,
    /// Where moduli are found.
    pub fine: Level,
    /// The fine mesh.
    pub mesh: QuadraticMesh,
}

impl BodyMeshes {
    pub fn new(inputs: &Inputs<'_>, params: &StiffnessParams) -> Result<Self, StiffnessError> {
        let mesher = Mesher::new(inputs.labels)?;
        let level = |mesh: &QuadraticMesh, outline: Option<&Outline>| {
            Level::new(mesh, inputs.field, inputs.matches, inputs.labels, inputs.held, inputs.load, outline)
        };
        let mut coarse = level(&mesher.mesh(&coarse_fineness(inputs.labels, params))?, None)?;
        let rim = rim(&coarse.patches[1], inputs.field, inputs.labels, coarse.tolerance(), coarse.near);
        let volume = fields::volume(inputs.labels);
        let mesh = meshed(&mesher, volume, &rim, coarse.voxel, params.nodes as f64, RIM_MESH.edge_voxels)?;
        let outline = rim.outline.as_ref();
        if !rim.places.is_empty() {
            let nodes = coarse_nodes(params);
            coarse = level(&meshed(&mesher, volume, &rim, coarse.voxel, nodes, 2.0 * RIM_MESH.edge_voxels)?, outline)?;
        }
        let mut fine = level(&mesh, outline)?;
        coarse.agree_on_shape(&mut fine)?;
        if inputs.labelled {
            coarse.open_borders(params.label_sd);
            fine.open_borders(params.label_sd);
        }
        Ok(Self { coarse, fine, mesh })
    }
}

/// A mesh of about `nodes` nodes, as fine everywhere; `volume` of the body in mm^3.
pub(super) fn evenly_meshed(mesher: &Mesher, volume: f64, nodes: f64) -> Result<QuadraticMesh, StiffnessError> {
    let mesh = mesher.mesh(&Fineness::for_nodes(volume, nodes as usize))?;
    let count = mesh.nodes().len() as f64;
    // Thin layers and a rough surface take more than a block does.
    match count <= MAX_NODE_EXCESS * nodes {
        true => Ok(mesh),
        false => Ok(mesher.mesh(&Fineness::for_nodes(volume, (nodes * nodes / count) as usize))?),
    }
}

/// A mesh of about `nodes` nodes, finer along the rim of a punch: cubes of `size` voxels there.
fn meshed(
    mesher: &Mesher,
    volume: f64,
    rim: &Rim,
    voxel: f64,
    nodes: f64,
    size: f64,
) -> Result<QuadraticMesh, StiffnessError> {
    if rim.places.is_empty() {
        return evenly_meshed(mesher, volume, nodes);
    }
    let within = rim.outline.as_ref().map(|o| |p| o.within(p));
    let wall = within.as_ref().map(|w| w as Wall<'_>);
    let detail = |size: f64| Detail { near: &rim.places, size: size * voxel, wall };
    // How many nodes the rim takes hangs on how the cubes come to halve: of a few meshes the
    // finest within the limit.
    let mut best: Option<(f64, Fineness, Detail<'_>)> = None;
    for coarser in RIM_MESH.coarsening {
        for elsewhere in RIM_MESH.elsewhere_fractions {
            let fineness = Fineness::for_nodes(volume, (elsewhere * nodes) as usize);
            let detail = detail(coarser * size);
            let Some(count) = mesher.nodes(&fineness, detail) else { continue };
            let count = count as f64 / nodes;
            let rank = if count <= MAX_NODE_EXCESS { -count } else { count };
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
    Ok(mesher.mesh_finer(&fineness, detail)?)
}

/// The body must have three dimensions and hang together.
pub(super) fn whole(labels: &Mask) -> Result<(), StiffnessError> {
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
