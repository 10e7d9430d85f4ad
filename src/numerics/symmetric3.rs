//! Symmetric 3 x 3 algebra. A symmetric matrix is `[xx, yy, zz, xy, xz, yz]`.

use crate::numerics::dense::symmetric_eigen;
use crate::types::space::{cross, dot};

/// A symmetric 3 x 3 matrix as `[xx, yy, zz, xy, xz, yz]`.
pub(crate) type Symmetric3 = [f64; 6];

/// Determinant.
#[inline(always)]
pub fn determinant(m: &Symmetric3) -> f64 {
    let [a, b, c, d, e, f] = *m;
    a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)
}

/// Adjugate (the inverse times the determinant).
#[inline(always)]
pub(crate) fn adjugate(m: &Symmetric3) -> Symmetric3 {
    let [a, b, c, d, e, f] = *m;
    [b * c - f * f, a * c - e * e, a * b - d * d, e * f - d * c, d * f - b * e, d * e - a * f]
}

/// Inverse; none when the determinant is not positive beyond rounding (so: positive definite only).
#[inline(always)]
pub fn inverse(m: &Symmetric3) -> Option<Symmetric3> {
    let det = determinant(m);
    let scale = (m[0].abs() + m[1].abs() + m[2].abs()).powi(3);
    (det > 1e-14 * scale && det.is_finite()).then(|| adjugate(m).map(|v| v / det))
}

/// Inverse of a covariance that may be flat along an axis (one slice): a millionth of its trace is
/// added to its diagonal.
pub(crate) fn regularized_inverse(m: &Symmetric3) -> Option<Symmetric3> {
    let little = 1e-6 * (m[0] + m[1] + m[2]) + 1e-12;
    let [a, b, c, d, e, f] = *m;
    inverse(&[a + little, b + little, c + little, d, e, f])
}

/// Matrix times vector.
#[inline(always)]
pub fn multiply(m: &Symmetric3, v: [f64; 3]) -> [f64; 3] {
    [
        m[0] * v[0] + m[3] * v[1] + m[4] * v[2],
        m[3] * v[0] + m[1] * v[1] + m[5] * v[2],
        m[4] * v[0] + m[5] * v[1] + m[2] * v[2],
    ]
}

/// `v . m v`.
#[inline(always)]
pub fn quadratic(m: &Symmetric3, v: [f64; 3]) -> f64 {
    let w = multiply(m, v);
    v[0] * w[0] + v[1] * w[1] + v[2] * w[2]
}

/// Solves a dense symmetric positive definite system in place by Cholesky; none when it is not.
pub fn cholesky_solve<const N: usize>(mut a: [[f64; N]; N], mut b: [f64; N]) -> Option<[f64; N]> {
    for i in 0..N {
        for j in 0..=i {
            let mut s = a[i][j];
            for k in 0..j {
                s -= a[i][k] * a[j][k];
            }
            if i == j {
                if s.is_nan() || s <= 1e-12 * a[i][i].abs() || s <= 0.0 {
                    return None;
                }
                a[i][i] = s.sqrt();
            } else {
                a[i][j] = s / a[j][j];
            }
        }
    }
    for i in 0..N {
        for k in 0..i {
            b[i] -= a[i][k] * b[k];
        }
        b[i] /= a[i][i];
    }
    for i in (0..N).rev() {
        for k in i + 1..N {
            b[i] -= a[k][i] * b[k];
        }
        b[i] /= a[i][i];
    }
    Some(b)
}

/// Eigenvalues of a symmetric matrix, largest first, in closed form (Smith 1961, Communications of
/// the ACM 4:168).
#[inline]
pub fn eigenvalues(m: &Symmetric3) -> [f64; 3] {
    let mean = (m[0] + m[1] + m[2]) / 3.0;
    let (a, b, c) = (m[0] - mean, m[1] - mean, m[2] - mean);
    let off = m[3] * m[3] + m[4] * m[4] + m[5] * m[5];
    let size = ((a * a + b * b + c * c + 2.0 * off) / 6.0).sqrt();
    if size <= 1e-300 {
        return [mean; 3];
    }
    let unit = [a, b, c, m[3], m[4], m[5]].map(|v| v / size);
    let angle = (determinant(&unit) / 2.0).clamp(-1.0, 1.0).acos() / 3.0;
    let high = mean + 2.0 * size * angle.cos();
    let low = mean + 2.0 * size * (angle + 2.0 * std::f64::consts::FRAC_PI_3).cos();
    [high, 3.0 * mean - high - low, low]
}

/// All nine entries, row by row.
pub fn full(m: &Symmetric3) -> [[f64; 3]; 3] {
    [[m[0], m[3], m[4]], [m[3], m[1], m[5]], [m[4], m[5], m[2]]]
}

/// A unit eigenvector of the largest eigenvalue: perpendicular to the two rows of `m` less that
/// eigenvalue that span most.
pub fn principal(m: &Symmetric3) -> [f64; 3] {
    let high = eigenvalues(m)[0];
    let [x, y, z] = full(&[m[0] - high, m[1] - high, m[2] - high, m[3], m[4], m[5]]);
    let longer = |a, b| if dot(b, b) > dot(a, a) { b } else { a };
    let normal = longer(longer(cross(x, y), cross(x, z)), cross(y, z));
    // Of two eigenvalues that are nearly equal rounding decides: then by rotations.
    let (square, size) = (dot(normal, normal), m.iter().map(|v| v * v).sum::<f64>());
    if square > 1e-8 * size * size {
        return normal.map(|v| v / square.sqrt());
    }
    symmetric_eigen(&full(m))[2].1
}
