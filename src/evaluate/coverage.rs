//! Whether a stated uncertainty tells the truth.

use crate::types::{DenseField, Mask};
use rayon::prelude::*;

/// Half width of the band that holds 95 % of a normal distribution, in standard deviations.
pub(crate) const BAND: f64 = 1.959_964;

/// Squared radius of the region that holds 95 % of a normal distribution in two and in three axes,
/// in variances along an axis (chi-square's quantile).
const REGION_95_SQUARED: [f64; 2] = [5.991, 7.815];

/// The share of displacements over `mask` whose error lies in the 95 % region of `sigma` (mm, one
/// standard deviation along an axis, by voxel): a ball, or a disc for a single slice. None for an
/// empty mask.
///
/// ```
/// use palpate::evaluate::coverage::coverage;
/// use palpate::{Affine, DenseField, Grid, Mask};
/// let grid = Grid::new([8; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let (found, truth) = (DenseField::from_fn(grid, |_| [0.3, 0.0, 0.0]), DenseField::zeros(grid));
/// let mask = Mask::filled(grid, 1);
/// // 0.3 mm lie within the region of 0.2 mm along an axis, not within that of 0.1 mm.
/// assert_eq!(coverage(&found, &truth, &|_| 0.2, &mask), Some(1.0));
/// assert_eq!(coverage(&found, &truth, &|_| 0.1, &mask), Some(0.0));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn coverage(
    field: &DenseField,
    truth: &DenseField,
    sigma: &(dyn Fn(usize) -> f32 + Sync),
    mask: &Mask,
) -> Option<f64> {
    let inside = mask.as_slice();
    let region = REGION_95_SQUARED[usize::from(!field.grid().is_single_slice())];
    let (good, all) = (0..inside.len())
        .into_par_iter()
        .filter(|&at| inside[at] != 0)
        .map(|at| {
            let (u, t) = (field.at(at), truth.at(at));
            let square: f64 = (0..3).map(|c| f64::from(u[c] - t[c]).powi(2)).sum();
            (usize::from(square <= region * f64::from(sigma(at)).powi(2)), 1)
        })
        .reduce(|| (0, 0), |a, b| (a.0 + b.0, a.1 + b.1));
    (all > 0).then(|| good as f64 / all as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::numerics::random::Random;
    use crate::types::{Affine, Grid};

    #[test]
    fn normal_errors_fill_the_band_as_normal_errors_do() {
        let affine = Affine::scaled([1.0; 3], [0.0; 3]).unwrap_or_else(|e| panic!("{e}"));
        let grid = Grid::new([40, 40, 20], affine).unwrap_or_else(|e| panic!("{e}"));
        let truth = DenseField::zeros(grid);
        let mut random = Random::new(7, 0);
        let mut field = DenseField::zeros(grid);
        field.as_mut_slice().iter_mut().for_each(|v| *v = 0.5 * random.normals()[0] as f32);
        let all = Mask::filled(grid, 1);
        let share = |sigma: f32| coverage(&field, &truth, &|_| sigma, &all).unwrap_or(f64::NAN);
        assert!((share(0.5) - 0.95).abs() < 0.003, "{}", share(0.5));
        assert!((share(0.25) - 0.4179).abs() < 0.006, "{}", share(0.25));
        assert_eq!(coverage(&field, &truth, &|_| 1.0, &Mask::filled(grid, 0)), None);
    }
}
