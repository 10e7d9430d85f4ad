//! Strain measures of a displacement gradient.

use crate::numerics::dense::symmetric_eigen;
use crate::numerics::symmetric3::{Symmetric3, eigenvalues, full};
use crate::types::StrainMeasure;
use crate::types::space::{Matrix3, cross};

/// The Green-Lagrange strain E = (G + G^T + G^T G) / 2 of a displacement gradient G (rows:
/// components; 1), that is (F^T F - I) / 2: free of rotation, on the initial configuration
/// (Holzapfel 2000, eq. 2.69).
///
/// ```
/// use palpate::strain::measure::green_lagrange;
/// // A rotation is no strain, however large.
/// let (s, c) = 0.8f64.sin_cos();
/// let turn = [[c - 1.0, -s, 0.0], [s, c - 1.0, 0.0], [0.0; 3]];
/// assert!(green_lagrange(&turn).iter().all(|e| e.abs() < 1e-12));
/// // A stretch of 1.2 gives (1.2^2 - 1) / 2.
/// let stretch = [[0.2, 0.0, 0.0], [0.0; 3], [0.0; 3]];
/// assert!((green_lagrange(&stretch)[0] - 0.22).abs() < 1e-12);
/// ```
pub fn green_lagrange(g: &Matrix3) -> Symmetric3 {
    let e = |r: usize, c: usize| 0.5 * (g[r][c] + g[c][r] + (0..3).map(|k| g[k][r] * g[k][c]).sum::<f64>());
    [e(0, 0), e(1, 1), e(2, 2), e(0, 1), e(0, 2), e(1, 2)]
}

/// A strain of a displacement gradient (1).
///
/// Small: (G + G^T) / 2. Logarithmic: ln(U) = ln(I + 2 E) / 2 with U the right stretch (Hencky; on
/// the initial configuration, Holzapfel 2000, section 2.5).
pub fn tensor(measure: StrainMeasure, g: &Matrix3) -> Symmetric3 {
    match measure {
        StrainMeasure::GreenLagrange => green_lagrange(g),
        StrainMeasure::Small => {
            let e = |r: usize, c: usize| 0.5 * (g[r][c] + g[c][r]);
            [e(0, 0), e(1, 1), e(2, 2), e(0, 1), e(0, 2), e(1, 2)]
        }
        StrainMeasure::Logarithmic => logarithm(&green_lagrange(g)),
    }
}

/// ln(I + 2 E) / 2.
fn logarithm(e: &Symmetric3) -> Symmetric3 {
    let pairs = symmetric_eigen(&full(e)).map(|(value, v)| (0.5 * (1.0 + 2.0 * value).max(f64::EPSILON).ln(), v));
    let h = |r: usize, c: usize| pairs.iter().map(|(value, v)| value * v[r] * v[c]).sum::<f64>();
    [h(0, 0), h(1, 1), h(2, 2), h(0, 1), h(0, 2), h(1, 2)]
}

/// Unit vectors along the principal strains, largest first; their signs are arbitrary, the third
/// completes a right-handed frame.
pub fn directions(strain: &Symmetric3) -> Matrix3 {
    let mut pairs = symmetric_eigen(&full(strain));
    pairs.sort_by(|a, b| b.0.total_cmp(&a.0));
    let [(_, first), (_, second), _] = pairs;
    [first, second, cross(first, second)]
}

/// Largest shear: half the difference of the largest and the smallest principal strain (1).
///
/// ```
/// use palpate::strain::measure::largest_shear;
/// assert!((largest_shear(&[0.03, -0.01, 0.0, 0.0, 0.0, 0.0]) - 0.02).abs() < 1e-12);
/// ```
pub fn largest_shear(strain: &Symmetric3) -> f64 {
    let [high, _, low] = eigenvalues(strain);
    (high - low) / 2.0
}

/// Relative change of volume, det F - 1 (1): exact for Green-Lagrange and logarithmic strain, to
/// first order for small strain.
///
/// ```
/// use palpate::StrainMeasure;
/// use palpate::strain::measure::{tensor, volume_change};
/// let g = [[0.1, 0.0, 0.0], [0.0, -0.05, 0.0], [0.0; 3]];
/// let measure = StrainMeasure::GreenLagrange;
/// assert!((volume_change(measure, &tensor(measure, &g)) - (1.1 * 0.95 - 1.0)).abs() < 1e-12);
/// ```
pub fn volume_change(measure: StrainMeasure, strain: &Symmetric3) -> f64 {
    let trace = strain[0] + strain[1] + strain[2];
    match measure {
        StrainMeasure::GreenLagrange => {
            eigenvalues(strain).iter().map(|e| 1.0 + 2.0 * e).product::<f64>().max(0.0).sqrt() - 1.0
        }
        StrainMeasure::Small => trace,
        StrainMeasure::Logarithmic => trace.exp_m1(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn near(a: &[f64], b: &[f64], tolerance: f64) {
        assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < tolerance), "{a:?} for {b:?}");
    }

    /// A stretch of 1.2 along x, .9 along y, and a rotation by 30 degrees about z after it.
    #[test]
    fn a_rotated_stretch_has_its_closed_form() {
        let (s, c) = 30f64.to_radians().sin_cos();
        let g = [[1.2 * c - 1.0, -0.9 * s, 0.0], [1.2 * s, 0.9 * c - 1.0, 0.0], [0.0; 3]];
        let e = tensor(StrainMeasure::GreenLagrange, &g);
        near(&e, &[(1.44 - 1.0) / 2.0, (0.81 - 1.0) / 2.0, 0.0, 0.0, 0.0, 0.0], 1e-12);
        let h = tensor(StrainMeasure::Logarithmic, &g);
        near(&h, &[1.2f64.ln(), 0.9f64.ln(), 0.0, 0.0, 0.0, 0.0], 1e-12);
        let volumes = [(StrainMeasure::GreenLagrange, e), (StrainMeasure::Logarithmic, h)];
        near(&volumes.map(|(m, e)| volume_change(m, &e)), &[0.08, 0.08], 1e-12);
        near(&directions(&e)[0].map(f64::abs), &[1.0, 0.0, 0.0], 1e-9);
        near(&[largest_shear(&e)], &[(0.22 + 0.095) / 2.0], 1e-12);
    }

    #[test]
    fn all_measures_agree_where_strain_is_small() {
        let g = [[1e-5, 2e-5, 0.0], [0.0, -3e-5, 1e-5], [2e-5, 0.0, 1e-5]];
        let small = tensor(StrainMeasure::Small, &g);
        for measure in [StrainMeasure::GreenLagrange, StrainMeasure::Logarithmic] {
            near(&tensor(measure, &g), &small, 2e-9);
            assert!((volume_change(measure, &small) + 1e-5).abs() < 1e-8);
        }
    }
}
