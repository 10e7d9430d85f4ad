//! Layered skin: a scene to the response of the column and of the block, with and without its
//! layers.

use crate::error::SceneError;
use crate::skin::{block, column, single};
use crate::types::skin::{BlockRun, SkinSample, SkinScene};
use std::time::Instant;

/// What a skin scene gives.
#[derive(Debug, Clone, PartialEq)]
pub struct SkinOutcome {
    /// The column of layers.
    pub column: Vec<SkinSample>,
    /// One layer in place of all, of the mean of each part where elements are alike, else fitted:
    /// its scene and response. None of a scene of one layer.
    pub single: Option<(SkinScene, Vec<SkinSample>)>,
    /// The block of layers; none when a step has no solution.
    pub block: Option<BlockRun>,
    /// The block of one layer.
    pub single_block: Option<BlockRun>,
    /// Strain that stays after all time, by the impulse, for each layer without a lone spring.
    pub residual: Vec<Option<f64>>,
    /// Stage names and wall seconds.
    pub seconds: Vec<(String, f64)>,
}

/// Error of the column that earns a warning.
const WARN_COLUMN_ERROR: f64 = 1e-6;

/// Refuses a scene of whose response rounding would leave no digit.
///
/// # Errors
/// [`SceneError::Stiff`].
pub fn check(scene: &SkinScene) -> Result<(), SceneError> {
    let precision = column::precision(scene);
    match precision < 1.0 {
        true => Ok(()),
        false => Err(SceneError::Stiff { factor: precision / f64::EPSILON }),
    }
}

/// What a user should know of a scene and its response.
pub fn notes(scene: &SkinScene, outcome: &SkinOutcome) -> Vec<String> {
    let mut out = Vec::new();
    if outcome.block.is_none() {
        out.push("the block has no solution; its values are too far apart".into());
    }
    let precision = column::precision(scene);
    if precision > WARN_COLUMN_ERROR {
        out.push(format!(
            "the column may be off by {precision:.0e} of its largest values by rounding: some layer yields faster than the load lasts by a factor of \
             {:.0e}; leave out the dashpot that does so",
            precision / f64::EPSILON
        ));
    }
    for (at, layer) in scene.layers.iter().enumerate() {
        let most = outcome.column.iter().map(|s| s.strain[at]).fold(0.0, f64::max);
        if most >= 1.0 {
            out.push(format!(
                "layer '{}' is compressed by {:.0} % of its thickness: no tissue can be; the load is past what springs and dashpots describe",
                layer.name,
                100.0 * most
            ));
        }
    }
    out
}

/// Runs a checked scene.
///
/// ```
/// use palpate::pipeline::skin::{check, run};
/// use palpate::types::skin::{ElementKind, Layer, SkinBlock, SkinLoad, SkinScene};
/// let layer = Layer {
///     name: "dermis".into(),
///     thickness: 2e-3,
///     element: ElementKind::ThreeElement,
///     e0: 0.0,
///     c0: 400.0,
///     maxwell: vec![[2e4, 2e5]],
///     c_unload: Vec::new(),
/// };
/// let load = SkinLoad { displacement: 2e-4, ramp: 1.0, hold: 2.0, end: 8.0 };
/// let block = SkinBlock { width: 2e-2, indenter: 5e-3, poisson: 0.45 };
/// let scene = SkinScene { load, layers: vec![layer], block };
/// check(&scene)?;
/// let found = run(&scene);
/// // One layer needs no replacement by one layer.
/// assert!(found.single.is_none() && found.residual[0].is_some());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn run(scene: &SkinScene) -> SkinOutcome {
    let mut seconds = Vec::new();
    let mut timed = |name: &str, from: Instant| seconds.push((name.to_string(), from.elapsed().as_secs_f64()));
    let started = Instant::now();
    let column = column::respond(scene);
    let several = scene.layers.len() > 1;
    let single = several.then(|| scene.without_layers().unwrap_or_else(|| single::fitted(scene))).map(|one| {
        let response = column::respond(&one);
        (one, response)
    });
    timed("column", started);
    let started = Instant::now();
    let (block, single_block) =
        rayon::join(|| block::respond(scene), || single.as_ref().and_then(|(one, _)| block::respond(one)));
    timed("block", started);
    let impulse = column.last().map_or(0.0, |s| s.impulse);
    let residual = scene.layers.iter().map(|l| column::residual(l, impulse)).collect();
    SkinOutcome { column, single, block, single_block, residual, seconds }
}
