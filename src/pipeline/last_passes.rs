//! The last passes of a preset that works on averages of voxels: on the next finer level, where the
//! same tissue shows more.
//!
//! Features, the choice of the model, jumps and warnings stay with the coarser level; what averages
//! hide of the motion is small, smooth and in place, and a few passes find it.

use crate::matching::levels::{factors, from_level, to_level};
use crate::matching::pair::Pair;
use crate::pipeline::bodies::Bodies;
use crate::pipeline::level;
use crate::types::{FieldParams, Grid};

/// Most voxels between nodes. On five pairs of 160 x 192 x 160 voxels 6 leaves errors as 5 does,
/// and gradients 4 % smaller.
pub(super) const MAX_NODE_SPACING_VOXELS: usize = 6;

/// The level below the one that `finest` asks for; none where that is full resolution, or no passes
/// are wanted there.
pub(super) fn next_finer(grid: &Grid, finest: usize, params: &FieldParams) -> Option<[usize; 3]> {
    let wanted = params.finer_passes > 0 && finest > 1;
    wanted.then(|| factors(grid.shape(), grid.spacing(), finest / 2, 0.0)[0])
}

/// The fields of a level of factor `from` brought to the residual on `pair`, of `factor`, with so
/// many voxels between nodes.
pub(super) fn polish(
    (pair, factor, nodes): (&Pair<'_>, [usize; 3], usize),
    (bodies, from): (&Bodies, [usize; 3]),
    params: &FieldParams,
    tick: impl Fn(usize),
) -> Bodies {
    let mut finer = bodies.carried(&level::lattice(pair, nodes), |p| to_level(from_level(p, factor), from));
    finer.refine(pair, params.finer_passes, params.seed, tick);
    finer
}

/// What was done, in words.
pub(super) fn why(pair: &Pair<'_>, nodes: usize, params: &FieldParams) -> String {
    let edges = pair.spacing.map(|s| format!("{s:.3}").trim_end_matches('0').trim_end_matches('.').to_string());
    format!(
        "finer passes: {} more at {} mm voxels, nodes every {nodes} of them; features, model and jumps are of the level before",
        params.finer_passes,
        edges.join(" x ")
    )
}
