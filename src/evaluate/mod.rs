//! A displacement field against exact truth, landmarks, label maps or a field that leads back.
//!
//! Field and truth lie on one grid; gradients are those of [`crate::numerics::differences`],
//! percentiles interpolate linearly, landmarks are read off trilinearly with the edge value beyond
//! the grid. Nothing is compared where the mask is zero. Fails when grids differ or the mask is
//! empty.

pub mod breaking;

pub mod coverage;

pub mod frontier;

pub mod labels;

pub(crate) mod stated;

pub(crate) mod waves;

use crate::error::FieldError;
use crate::numerics::differences::{deformation_gradient, displacement_gradient};
use crate::numerics::sampling::{displacement, inside};
use crate::numerics::statistics::percentile;
use crate::types::space::{determinant, length};
use crate::types::{
    DenseField, Distances, Grid, InverseConsistency, Landmark, LandmarkError, Mask, Metrics, TargetError,
};
use rayon::prelude::*;

/// Truth moves less than this in still tissue (mm).
const STILL_MM: f64 = 0.1;

/// More still voxels than this are needed for [`Metrics::still_mm`].
const STILL_VOXELS: usize = 1000;

/// Scores `field` against `truth` over `mask` (everywhere when `None`) and at `landmarks` (none
/// when empty).
///
/// # Errors
/// [`FieldError::GridMismatch`] when the three do not share one grid, [`FieldError::Volume`] when
/// the mask is empty, or the truth or the field has voxels in it that are no number.
///
/// ```
/// use palpate::{Affine, DenseField, Grid, evaluate};
/// let grid = Grid::new([8; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let truth = DenseField::from_fn(grid, |_| [3.0, 0.0, 4.0]);
/// let found = DenseField::from_fn(grid, |_| [3.0, 0.5, 4.0]);
/// let m = evaluate::metrics(&found, &truth, None, &[])?;
/// assert_eq!((m.mean_mm, m.identity_mm, m.voxels), (0.5, 5.0, 512));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn metrics(
    field: &DenseField,
    truth: &DenseField,
    mask: Option<&Mask>,
    landmarks: &[Landmark],
) -> Result<Metrics, FieldError> {
    let grid = truth.grid();
    check("the field", field.grid(), grid)?;
    if let Some(mask) = mask {
        check("the mask", mask.grid(), grid)?;
    }
    let used = |at: &usize| mask.is_none_or(|m| m.as_slice()[*at] != 0);
    let voxels: Vec<VoxelError> =
        (0..grid.len()).into_par_iter().filter(used).map(|at| VoxelError::new(field, truth, at)).collect();
    if voxels.is_empty() {
        return Err(FieldError::Volume {
            volume: "mask",
            what: "has no voxel set".into(),
            hint: "give one that covers the tissue".into(),
        });
    }
    for (volume, field) in [("truth", truth), ("measured", field)] {
        check_numbers(volume, field, mask)?;
    }
    let mut error: Vec<f64> = voxels.iter().map(|v| v.error).collect();
    // Beside voxels outside the mask that are no number there is no gradient.
    let mut gradient: Vec<f64> = voxels.iter().map(|v| v.gradient).filter(|g| g.is_finite()).collect();
    let still: Vec<f64> = voxels.iter().filter(|v| v.motion < STILL_MM).map(|v| v.error).collect();
    let truths: Vec<f64> = voxels.iter().map(|v| v.motion).collect();
    let at_landmarks = self::landmarks(field, landmarks);
    Ok(Metrics {
        voxels: voxels.len(),
        mean_mm: mean(&error),
        median_mm: percentile(&mut error, 50.0),
        p95_mm: percentile(&mut error, 95.0),
        max_mm: percentile(&mut error, 100.0),
        identity_mm: mean(&truths),
        still_mm: (still.len() > STILL_VOXELS).then(|| mean(&still)),
        grad_err: percentile(&mut gradient, 50.0),
        grad_err_p95: percentile(&mut gradient, 95.0),
        folds: voxels.iter().filter(|v| v.folded).count() as f64 / voxels.len() as f64,
        landmarks_mm: (!at_landmarks.is_empty()).then(|| mean(&at_landmarks)),
    })
}

/// Inverse consistency of `forward` and `backward` over `mask` on the first one's grid (everywhere
/// when `None`): |u(x) + v(x + u(x))|, with `v` read off trilinearly on a grid of its own.
///
/// # Errors
/// [`FieldError::GridMismatch`] when the mask lies on another grid, [`FieldError::Volume`] when a
/// field is no number where it counts, or no voxel of the mask ends within the second grid.
///
/// ```
/// use palpate::evaluate::inverse_consistency;
/// use palpate::field::inverse::invert;
/// use palpate::{Affine, DenseField, Grid};
/// let grid = Grid::new([16; 3], Affine::scaled([1.0; 3], [-7.5; 3])?)?;
/// let forward = DenseField::from_fn(grid, |p| [-0.1 * p.0[0], -0.1 * p.0[1], 0.0]);
/// let backward = invert(&forward, None).field;
/// assert!(inverse_consistency(&forward, &backward, None)?.inverse_mean_mm < 0.02);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn inverse_consistency(
    forward: &DenseField,
    backward: &DenseField,
    mask: Option<&Mask>,
) -> Result<InverseConsistency, FieldError> {
    let grid = forward.grid();
    if let Some(mask) = mask {
        check("the mask", mask.grid(), grid)?;
    }
    check_numbers("forward", forward, mask)?;
    check_numbers("backward", backward, None)?;
    let used = |at: &usize| mask.is_none_or(|m| m.as_slice()[*at] != 0);
    let there = backward.grid();
    // None where the place lies outside the second grid.
    let distance = |at: usize| {
        let [i, j, k] = grid.voxel(at);
        let u = forward.at(at).map(f64::from);
        let end = grid.world(i, j, k).moved(u);
        let v = inside(there.shape(), there.affine().to_voxel(end)).then(|| displacement(backward, end))?;
        Some(length([u[0] + v[0], u[1] + v[1], u[2] + v[2]]))
    };
    let all: Vec<Option<f64>> = (0..grid.len()).into_par_iter().filter(used).map(distance).collect();
    let mut distances: Vec<f64> = all.iter().flatten().copied().collect();
    if distances.is_empty() {
        return Err(FieldError::Volume {
            volume: "backward",
            what: "holds none of the places where the forward field ends".into(),
            hint: "give the field of a run from the deformed to the initial volume".into(),
        });
    }
    Ok(InverseConsistency {
        voxels: distances.len(),
        outside: 1.0 - distances.len() as f64 / all.len() as f64,
        inverse_mean_mm: distances.iter().sum::<f64>() / distances.len() as f64,
        inverse_p95_mm: percentile(&mut distances, 95.0),
        inverse_max_mm: percentile(&mut distances, 100.0),
    })
}

/// The error at each landmark: |initial + u(initial) - deformed| (mm), in the order given.
///
/// ```
/// use palpate::{Affine, DenseField, Grid, Landmark, WorldPoint, evaluate};
/// let grid = Grid::new([8; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let field = DenseField::from_fn(grid, |_| [1.0, 0.0, 0.0]);
/// let mark =
///     Landmark { initial: WorldPoint([2.0, 2.0, 2.0]), deformed: WorldPoint([3.0, 2.0, 4.0]) };
/// assert_eq!(evaluate::landmarks(&field, &[mark]), [2.0]);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn landmarks(field: &DenseField, landmarks: &[Landmark]) -> Vec<f64> {
    let error = |l: &Landmark| length(l.initial.moved(displacement(field, l.initial)).minus(l.deformed));
    landmarks.iter().map(error).collect()
}

/// Mean, median, 95th percentile and largest of `values` (mm), which are reordered.
///
/// ```
/// use palpate::evaluate::distances;
/// let d = distances(&mut [3.0, 1.0, 2.0, 6.0]);
/// assert_eq!((d.mean_mm, d.median_mm, d.max_mm), (3.0, 2.5, 6.0));
/// ```
pub fn distances(values: &mut [f64]) -> Distances {
    Distances {
        mean_mm: mean(values),
        median_mm: percentile(values, 50.0),
        p95_mm: percentile(values, 95.0),
        max_mm: percentile(values, 100.0),
    }
}

/// Target registration error of `field` (on any grid) at `marks` (world mm, RAS), and the same
/// without registration. Beyond its grid the field's edge value counts.
///
/// # Errors
/// [`FieldError::TooFew`] without a landmark, [`FieldError::Volume`] when the field is no number at
/// one.
///
/// ```
/// use palpate::{Affine, DenseField, FieldError, Grid, evaluate};
/// let field = DenseField::zeros(Grid::new([8; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?);
/// assert!(matches!(
///     evaluate::target_error(&field, &[]),
///     Err(FieldError::TooFew { found: 0, .. })
/// ));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn target_error(field: &DenseField, marks: &[Landmark]) -> Result<TargetError, FieldError> {
    if marks.is_empty() {
        return Err(FieldError::TooFew { found: 0, what: "landmarks", needed: 1, hint: "give one at least".into() });
    }
    let mut errors = landmarks(field, marks);
    if let Some(at) = errors.iter().position(|e| !e.is_finite()) {
        return Err(FieldError::Volume {
            volume: "measured",
            what: format!("is NaN or infinite at landmark {}", at + 1),
            hint: "leave that landmark out".into(),
        });
    }
    let each: Vec<LandmarkError> = marks
        .iter()
        .zip(&errors)
        .map(|(l, &error_mm)| LandmarkError {
            initial: l.initial.0,
            deformed: l.deformed.0,
            error_mm,
            before_mm: length(l.initial.minus(l.deformed)),
        })
        .collect();
    let mut before: Vec<f64> = each.iter().map(|e| e.before_mm).collect();
    Ok(TargetError { count: marks.len(), after: distances(&mut errors), before: distances(&mut before), each })
}

/// Numbers of the landmarks whose initial place lies more than half a voxel outside `grid`, where
/// the field is not known.
pub fn beyond(grid: &Grid, landmarks: &[Landmark]) -> Vec<usize> {
    let within = |l: &Landmark| inside(grid.shape(), grid.affine().to_voxel(l.initial));
    (0..landmarks.len()).filter(|&i| !within(&landmarks[i])).collect()
}

/// Whether a field, called `volume` in the message, is a number wherever errors count.
///
/// # Errors
/// [`FieldError::Volume`] tells how many voxels of `mask` are not (of all when `None`).
pub(crate) fn check_numbers(volume: &'static str, field: &DenseField, mask: Option<&Mask>) -> Result<(), FieldError> {
    let used = |at: &usize| mask.is_none_or(|m| m.as_slice()[*at] != 0);
    let bad = |at: &usize| used(at) && field.at(*at).iter().any(|c| !c.is_finite());
    match (0..field.grid().len()).into_par_iter().filter(bad).count() {
        0 => Ok(()),
        n => Err(FieldError::Volume {
            volume,
            what: format!("has {n} voxels that are NaN or infinite where errors count"),
            hint: "give a mask that leaves them out".into(),
        }),
    }
}

/// What is measured at one voxel.
struct VoxelError {
    /// |u - truth| (mm).
    error: f64,
    /// |truth| (mm).
    motion: f64,
    /// Frobenius norm of the difference of the displacement gradients (1).
    gradient: f64,
    /// Whether the determinant of I + grad u is at or below zero.
    folded: bool,
}

impl VoxelError {
    fn new(field: &DenseField, truth: &DenseField, at: usize) -> Self {
        let voxel = truth.grid().voxel(at);
        let (u, t) = (field.at(at).map(f64::from), truth.at(at).map(f64::from));
        let (gu, gt) = (displacement_gradient(field, voxel), displacement_gradient(truth, voxel));
        let difference = gu.as_flattened().iter().zip(gt.as_flattened()).map(|(a, b)| (a - b).powi(2));
        Self {
            error: length([u[0] - t[0], u[1] - t[1], u[2] - t[2]]),
            motion: length(t),
            gradient: difference.sum::<f64>().sqrt(),
            folded: determinant(&deformation_gradient(gu)) <= 0.0,
        }
    }
}

fn check(what: &str, found: &Grid, expected: &Grid) -> Result<(), FieldError> {
    match expected.same_as(found) {
        true => Ok(()),
        false => Err(FieldError::GridMismatch {
            what: what.into(),
            found: found.shape(),
            reference: "the truth".into(),
            expected: expected.shape(),
        }),
    }
}

/// NaN of nothing.
pub(crate) fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}
