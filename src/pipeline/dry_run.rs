//! What a run would do or take, worked out before any of it is done.

use crate::error::{FieldError, StiffnessError};
use crate::matching::levels::{Aligned, overlap};
use crate::numerics::orientation::Orientation;
use crate::pipeline::body_meshes::{BodyMeshes, whole};
use crate::pipeline::coarse_to_fine::{finest_level, inside, search_mm, worked_on};
use crate::pipeline::input_checks::{self, Checked};
use crate::pipeline::stiffness::{Inputs, without_turn};
use crate::pipeline::{last_passes, sparse};
use crate::stiffness::fem_body::MAX_DIRECT_NODES;
use crate::stiffness::mesh_problem::Level;
use crate::stiffness::model_selection::has_rivals;
use crate::types::params::Method;
use crate::types::stiffness::{Forecast, Law, StiffnessParams};
use crate::types::{FieldParams, Grid, Mask, Voxels};
use std::time::Instant;

/// What [`crate::pipeline::field::run`] would choose for itself.
#[derive(Debug, Clone, PartialEq)]
pub struct FieldPlan {
    /// Largest motion looked for (mm).
    pub search_mm: f64,
    /// Voxels of tissue.
    pub mask_voxels: usize,
    /// Shape of the initial volume on each level, coarse to fine, with the one of the finer passes
    /// where there are any.
    pub levels: Vec<[usize; 3]>,
    /// Feature points wanted on the finest level.
    pub points: usize,
    /// Largest memory that the whole command holds (bytes), see [`memory`].
    pub memory: u64,
}

/// Memory that a command holds for strain on a grid (bytes): 174 a voxel were measured from 80 to
/// 120 voxels a side, and 12 MB besides.
pub(crate) fn strain_memory(grid: &Grid) -> u64 {
    180 * grid.len() as u64 + 12_000_000
}

/// Memory of a phantom on a grid (bytes): 85 a voxel and 14 MB, measured on blocks, heads and
/// calves of 0.3 to 8 million voxels. The finite elements of an elastic one take 60 MB more, and
/// 300 MB from 64 voxels across on, where they are halved again.
pub(crate) fn phantom_memory(grid: &Grid, elastic: bool) -> u64 {
    let fine = grid.shape().into_iter().max() >= Some(64);
    let elements = if elastic && fine { 300_000_000 } else { 60_000_000 * u64::from(elastic) };
    14_000_000 + 85 * grid.len() as u64 + elements
}

/// Makes every check of a run that needs no measuring, and tells what it would do.
///
/// # Errors
/// As [`crate::pipeline::field::run`], but for too few matches.
///
/// ```
/// use palpate::synth::MotionKind;
/// use palpate::{FieldParams, PhantomKind, PhantomParams, phantom, pipeline};
/// let block = PhantomParams::new(PhantomKind::Block).sized(24).moving(MotionKind::Translate);
/// let pair = phantom(&block)?;
/// let plan = pipeline::dry_run::field(
///     &pair.initial,
///     &pair.deformed,
///     Some(&pair.mask),
///     &FieldParams::default(),
/// )?;
/// assert_eq!(plan.mask_voxels, pair.mask.as_slice().iter().filter(|m| **m != 0).count());
/// // The finest level has all voxels.
/// assert_eq!(plan.levels.last(), Some(&[24, 24, 24]));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn field(
    initial: &Voxels<'_>,
    deformed: &Voxels<'_>,
    mask: Option<&Mask>,
    params: &FieldParams,
) -> Result<FieldPlan, FieldError> {
    params.check()?;
    let [initial, deformed] = [input_checks::tamed(initial), input_checks::tamed(deformed)];
    let Checked { mask, initial: clean, .. } = input_checks::inputs(&initial, &deformed, mask)?;
    let grid = *initial.grid();
    let search = search_mm(&grid, params.search_mm);
    Aligned::new(&clean, &deformed, &mask, search)?;
    let matches_alone = params.method == Method::Sparse;
    let finest = match params.method {
        Method::Full => finest_level(&grid, &mask, params.finest),
        Method::Sparse => sparse::finest_level(&grid, &mask, params),
    };
    let factors = worked_on(&grid, &mask, finest, search);
    let mask_voxels = inside(&mask);
    let last: usize = factors.last().map_or(1, |f| f.iter().product());
    let automatic = match params.method {
        Method::Full => (mask_voxels / last / params.voxels_per_point).max(200),
        Method::Sparse => sparse::points(params, mask_voxels / last),
    };
    let shape = grid.shape();
    Ok(FieldPlan {
        search_mm: search,
        mask_voxels,
        levels: factors
            .iter()
            .chain(&last_passes::next_finer(&grid, finest, params).filter(|_| !matches_alone))
            .map(|f| std::array::from_fn(|a| shape[a].div_ceil(f[a])))
            .collect(),
        points: if params.points > 0 { params.points } else { automatic },
        memory: memory(&grid, deformed.grid()),
    })
}

/// Makes the checks of [`field`] that the two grids are enough for: both volumes have two axes or
/// more, and overlap as far as the search reaches. A slice for a volume is refused too, and so are
/// two to four: nothing is found in them that could be matched in space.
///
/// # Errors
/// [`FieldError::Volume`], [`FieldError::TooFew`] and [`FieldError::NoOverlap`].
pub fn grids(initial: &Grid, deformed: &Grid, params: &FieldParams) -> Result<(), FieldError> {
    input_checks::no_line("initial", initial)?;
    input_checks::no_line("deformed", deformed)?;
    let slice = |grid: &Grid| grid.shape().contains(&1);
    if slice(deformed) && !slice(initial) {
        let (what, hint) =
            ("is one slice, the initial volume is more".into(), "give volumes only, or slices only".into());
        return Err(FieldError::Volume { volume: "deformed", what, hint });
    }
    input_checks::enough_slices(initial)?;
    overlap(initial, deformed, search_mm(initial, params.search_mm)).map(drop)
}

/// Memory of a field run on these grids (bytes): 14 MB, 18 bytes a voxel of both volumes up to 20
/// million voxels and 13 past them, and 4 for a volume whose axes do not run right, anterior and
/// superior, of which a copy is made. Measured on head phantoms of 0.6 to 313 million voxels
/// (docs/explanation/performance.md), which it meets to 8 %.
pub fn memory(initial: &Grid, deformed: &Grid) -> u64 {
    let voxels = (initial.len() + deformed.len()) as u64;
    let copy = |grid: &Grid| if Orientation::of(grid).is_canonical() { 0 } else { 4 * grid.len() as u64 };
    let copies = copy(initial) + copy(deformed);
    14_000_000 + 18 * voxels.min(20_000_000) + 13 * voxels.saturating_sub(20_000_000) + copies
}

/// Memory of a stiffness run on a mesh of `nodes` nodes (bytes), at most.
///
/// With a factor: 150 MB and 40 kB a node to 20,000, growing with the cube root past them, as the
/// factors of a sparse matrix in space do. Measured on finger pads with three labels, layers under
/// a punch and inclusions with and without labels: 0.15 to 0.23 GB at 2,000 nodes, 0.27 to 0.43 at
/// 8,000, 0.69 to 0.85 at 20,000, 1.7 to 1.9 at 40,000. With iterations: 150 MB and 10 kB a node
/// (2.8 GB at 300,000; docs/lab/2026-11-solver.md).
pub(crate) fn stiffness_memory(nodes: usize) -> u64 {
    let n = nodes as f64;
    let each = if nodes <= MAX_DIRECT_NODES { 40_000.0 * (n / 20_000.0).cbrt().max(1.0) } else { 10_000.0 };
    150_000_000 + (each * n) as u64
}

/// What a run with labels takes, by its factorisations: 15 bodies at 8,000 and 20,000 nodes.
struct Cost {
    /// Factorisations on the coarse and the fine mesh, where one contact is tried.
    one_contact: [f64; 2],
    /// The same where several are.
    contacts: [f64; 2],
    /// CPU time of a run over that of its factorisations.
    time_ratio: f64,
    /// Growth of the time of a factorisation with the numbers of the factor, as in nested
    /// dissection of a body in space.
    time_exponent: f64,
    /// Memory without factors (bytes).
    base_bytes: f64,
    /// Memory for each number of a factor (bytes).
    bytes_per_number: f64,
}

const COST: Cost = Cost {
    one_contact: [14.0, 2.3],
    contacts: [26.0, 4.0],
    time_ratio: 2.5,
    time_exponent: 4.0 / 3.0,
    base_bytes: 125e6,
    bytes_per_number: 5.7,
};

/// What [`crate::pipeline::stiffness::run`] would take. Of 30 runs, memory is within 30 % for 29,
/// time for 23 (at worst 2.1 times as long).
///
/// # Errors
/// What that would refuse before it looks for moduli.
pub fn stiffness(inputs: &Inputs<'_>, params: &StiffnessParams) -> Result<Forecast, StiffnessError> {
    params.check()?;
    whole(inputs.labels)?;
    without_turn(inputs, |inputs| {
        let BodyMeshes { coarse, fine, mesh } = BodyMeshes::new(inputs, params)?;
        let nodes = mesh.nodes().len();
        if fine.body.levels.is_some() {
            return Ok(Forecast { nodes, memory: stiffness_memory(nodes), seconds: None });
        }
        let fill = |level: &Level| level.body.pattern.fill().map_err(|_| StiffnessError::Unsolvable);
        let [small, large] = [fill(&coarse)? as f64, fill(&fine)? as f64];
        let setup = coarse.setup(Law::Linear, params, coarse.largest());
        let started = Instant::now();
        setup.problem(&setup.start()).factorise(&vec![0.0; coarse.body.pattern.unknowns()])?;
        let unit = started.elapsed().as_secs_f64();
        let [few, many] = if has_rivals(&coarse) { COST.contacts } else { COST.one_contact };
        let seconds = COST.time_ratio * unit * (few + many * (large / small).powf(COST.time_exponent));
        let memory = (COST.base_bytes + COST.bytes_per_number * (small + large)) as u64;
        Ok(Forecast { nodes, memory, seconds: inputs.labelled.then_some(seconds) })
    })
    .0
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::types::Affine;

    #[test]
    fn the_memory_is_that_of_the_measured_table() {
        let measured = [([64, 75, 64], 24.0), ([96, 112, 96], 55.0), ([128, 149, 128], 98.0), ([192, 224, 192], 308.0)];
        let large = [([256, 299, 256], 622.0), ([384, 448, 384], 1848.0), ([512, 597, 512], 4291.0)];
        for (shape, megabytes) in measured.into_iter().chain(large) {
            let grid = Grid::new(shape, Affine::scaled([1.0; 3], [0.0; 3]).unwrap()).unwrap();
            let found = memory(&grid, &grid) as f64 / 1e6;
            assert!((found / megabytes - 1.0).abs() < 0.08, "{shape:?}: {found:.0} MB, measured {megabytes}");
        }
    }
}
