//! Exact signs of the geometric determinants: orientation and in-sphere.
//!
//! Promises: the sign of each result is that of the exact determinant of the given floating-point
//! coordinates, as long as every coordinate is zero or between 2^-142 and 2^200 in size. A
//! floating-point value is used where its error bound proves the sign; the rest goes to Shewchuk's
//! adaptive expansions (crate `robust`).
//!
//! Source: J. R. Shewchuk, "Adaptive precision floating-point arithmetic and fast robust geometric
//! predicates", Discrete Comput. Geom. 18 (1997). The bounds here replace his permanents by
//! products of the largest difference along each axis (Melquiond and Pion, "Formally certified
//! floating-point filters", 2007).

use super::double_double::DoubleDouble;
use robust::{Coord, Coord3D};
use std::ops::{Add, Mul, Neg, Sub};

/// `(7 + 56 e) e` (Shewchuk's o3derrboundA) times 6, the number of products in the permanent; e =
/// 2^-53.
const ORIENT3D_BOUND: f64 = 4.7e-15;

/// `(16 + 224 e) e` (isperrboundA) times 72: 4 lifts of 3 squares, 6 products each.
const INSPHERE_BOUND: f64 = 1.29e-13;

/// The bound in double-double arithmetic over [`INSPHERE_BOUND`]: 72 times 41 u^2, u = 2^-53, by
/// the errors that `double_double` cites.
const DOUBLED_INSPHERE_BOUND: f64 = 3e-16;

fn coord(p: &[f64; 3]) -> Coord3D<f64> {
    Coord3D { x: p[0], y: p[1], z: p[2] }
}

#[inline(always)]
fn minus(a: &[f64; 3], b: &[f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

// Without the NaN rules of `f64::max`, which cost an instruction each.
#[inline(always)]
fn larger(a: f64, b: f64) -> f64 {
    if a > b { a } else { b }
}

#[inline(always)]
fn smaller(a: f64, b: f64) -> f64 {
    if a < b { a } else { b }
}

/// Positive where `a`, `b`, `c` turn counter-clockwise, negative where clockwise, zero where
/// collinear.
pub fn orient2d(a: [f64; 2], b: [f64; 2], c: [f64; 2]) -> f64 {
    let [a, b, c] = [a, b, c].map(|p| Coord { x: p[0], y: p[1] });
    robust::orient2d(a, b, c)
}

/// What is known of all points together, so that most signs need no more than the plain
/// determinant.
#[derive(Debug, Clone, Copy)]
pub(super) struct StaticBounds {
    /// A determinant larger than this has the right sign.
    orient3d: f64,
    insphere: f64,
    /// Among differences up to this size the plain determinant is exact.
    orient3d_exact: f64,
    insphere_exact: f64,
}

impl StaticBounds {
    /// Of no points.
    const NONE: Self =
        Self { orient3d: f64::INFINITY, insphere: f64::INFINITY, orient3d_exact: 0.0, insphere_exact: 0.0 };

    /// Of normalised points. On a lattice, all numbers in a determinant of near points are whole
    /// multiples of the lattice's unit, and small enough to have no rounding: 6 d^3 or 72 d^5 stays
    /// under 2^53.
    pub(super) fn new(points: &[[f64; 3]]) -> Self {
        let size = [0, 1, 2].map(|k| {
            let range = |[l, h]: [f64; 2], p: &[f64; 3]| [smaller(l, p[k]), larger(h, p[k])];
            let [low, high] = points.iter().fold([f64::INFINITY, f64::NEG_INFINITY], range);
            // Differences may round up.
            1.01 * (high - low)
        });
        let unit = points.iter().flatten().filter(|v| **v != 0.0).map(|v| last_bit(*v)).min().unwrap_or(0);
        let (orient3d, insphere) = bounds(size);
        let exact = |units: i32| 2f64.powi(unit + units);
        Self { orient3d, insphere, orient3d_exact: exact(16), insphere_exact: exact(9) }
    }
}

/// The exponent of the last bit of a normal number that is set.
fn last_bit(v: f64) -> i32 {
    let bits = v.to_bits();
    let mantissa = bits & ((1 << 52) - 1) | 1 << 52;
    (bits >> 52 & 0x7ff) as i32 - 1075 + mantissa.trailing_zeros() as i32
}

/// Bounds for differences of the given sizes along each axis; infinite where they could underflow
/// or overflow.
#[inline]
fn bounds([x, y, z]: [f64; 3]) -> (f64, f64) {
    let (least, most) = (smaller(smaller(x, y), z), larger(larger(x, y), z));
    if least > 1e-58 && most < 1e61 {
        let volume = x * y * z;
        (ORIENT3D_BOUND * volume, INSPHERE_BOUND * volume * (most * most))
    } else {
        (f64::INFINITY, f64::INFINITY)
    }
}

/// The sign of `det(b - a, c - a, d - a)`: positive for a positively oriented tetrahedron, zero
/// where coplanar.
///
/// ```
/// use palpate::mesh::predicates::orient3d;
/// let [a, b, c] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
/// assert!(orient3d(&a, &b, &c, &[0.0, 0.0, 1e-300]) > 0.0);
/// assert_eq!(orient3d(&a, &b, &c, &[0.3, 0.3, 0.0]), 0.0);
/// ```
pub fn orient3d(a: &[f64; 3], b: &[f64; 3], c: &[f64; 3], d: &[f64; 3]) -> f64 {
    orient3d_bounded(&StaticBounds::NONE, [a, b, c, d])
}

/// [`orient3d`], faster for points within the box that `bounds` are for.
#[inline(always)]
pub(super) fn orient3d_bounded(bounds: &StaticBounds, [a, b, c, d]: [&[f64; 3]; 4]) -> f64 {
    let [u, v, w] = [minus(b, a), minus(c, a), minus(d, a)];
    let det =
        u[2] * (v[0] * w[1] - w[0] * v[1]) + v[2] * (w[0] * u[1] - u[0] * w[1]) + w[2] * (u[0] * v[1] - v[0] * u[1]);
    if det.abs() > bounds.orient3d { det } else { close_orient3d(bounds, det, [a, b, c, d]) }
}

/// A determinant near zero: bounded by its own differences, or exactly.
#[inline(never)]
fn close_orient3d(known: &StaticBounds, det: f64, [a, b, c, d]: [&[f64; 3]; 4]) -> f64 {
    let size = |k: usize| larger(larger((b[k] - a[k]).abs(), (c[k] - a[k]).abs()), (d[k] - a[k]).abs());
    let size = [size(0), size(1), size(2)];
    if size.contains(&0.0) {
        return 0.0;
    }
    if det.abs() > bounds(size).0 || size.iter().all(|&v| v <= known.orient3d_exact) {
        return det;
    }
    // Shewchuk's sign is the opposite one, hence the exchange.
    robust::orient3d(coord(b), coord(a), coord(c), coord(d))
}

/// Positive where `e` lies strictly inside the sphere through the positively oriented tetrahedron
/// `a b c d`, zero where on it.
pub fn insphere(a: &[f64; 3], b: &[f64; 3], c: &[f64; 3], d: &[f64; 3], e: &[f64; 3]) -> f64 {
    insphere_bounded(&StaticBounds::NONE, [a, b, c, d], e)
}

/// [`insphere`], faster for points within the box that `bounds` are for.
#[inline(always)]
pub(super) fn insphere_bounded(bounds: &StaticBounds, corners: [&[f64; 3]; 4], e: &[f64; 3]) -> f64 {
    let [a, b, c, d] = corners;
    let x = [a[0] - e[0], b[0] - e[0], c[0] - e[0], d[0] - e[0]];
    let y = [a[1] - e[1], b[1] - e[1], c[1] - e[1], d[1] - e[1]];
    let z = [a[2] - e[2], b[2] - e[2], c[2] - e[2], d[2] - e[2]];
    let det = insphere_determinant(x, y, z);
    if det.abs() > bounds.insphere { det } else { close_insphere(bounds, det, corners, e) }
}

/// The determinant from the corners' offsets, one lane a corner for vector instructions.
#[inline(always)]
fn insphere_determinant<T>(x: [T; 4], y: [T; 4], z: [T; 4]) -> T
where
    T: Copy + Add<Output = T> + Sub<Output = T> + Mul<Output = T> + Neg<Output = T>,
{
    let minor = |i: usize, j: usize| x[i] * y[j] - x[j] * y[i];
    let side = [minor(0, 1), minor(1, 2), minor(2, 3), minor(3, 0)];
    let (ac, bd) = (minor(0, 2), minor(1, 3));
    let skip = [-ac, -bd, ac, bd];
    let volume = |i: usize, j: usize, k: usize| z[i] * side[j] + z[j] * skip[i] + z[k] * side[i];
    let lift = |i: usize| x[i] * x[i] + y[i] * y[i] + z[i] * z[i];
    (lift(0) * volume(1, 2, 3) - lift(1) * volume(2, 3, 0)) + (lift(2) * volume(3, 0, 1) - lift(3) * volume(0, 1, 2))
}

/// A determinant near zero: bounded by its own differences, exact on a lattice, in doubled
/// precision, or in any.
#[inline(never)]
fn close_insphere(known: &StaticBounds, det: f64, corners: [&[f64; 3]; 4], e: &[f64; 3]) -> f64 {
    let size = [0, 1, 2].map(|k| corners.iter().fold(0.0, |m, p| larger(m, (p[k] - e[k]).abs())));
    let bound = bounds(size).1;
    if det.abs() > bound || size.iter().all(|&v| v <= known.insphere_exact) {
        return det;
    }
    let [x, y, z] = [0, 1, 2].map(|k| corners.map(|p| DoubleDouble::difference(p[k], e[k])));
    let det = insphere_determinant(x, y, z).rounded();
    // So that nothing underflows in the low parts.
    let least = size.iter().fold(f64::INFINITY, |m, &v| smaller(m, v));
    if least > 1e-45 && det.abs() > DOUBLED_INSPHERE_BOUND * bound {
        return det;
    }
    let [a, b, c, d] = corners.map(coord);
    robust::insphere(b, a, c, d, coord(e))
}
