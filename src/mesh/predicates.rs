//! Exact signs of the geometric determinants: orientation and in-sphere.
//!
//! Promises: the sign of each result is that of the exact determinant of the given floating-point coordinates, as long
//! as every coordinate is zero or between 2^-142 and 2^200 in size. A floating-point value is used where its error
//! bound proves the sign; the rest goes to Shewchuk's adaptive expansions (crate `robust`).
//!
//! Source: J. R. Shewchuk, "Adaptive precision floating-point arithmetic and fast robust geometric predicates",
//! Discrete Comput. Geom. 18 (1997). The bounds here replace his permanents by products of the largest difference along
//! each axis (Melquiond and Pion, "Formally certified floating-point filters", 2007).

use robust::{Coord, Coord3D};

/// `(7 + 56 e) e` (Shewchuk's o3derrboundA) times 6, the number of products in the permanent; e = 2^-53.
const ORIENT3D_BOUND: f64 = 4.7e-15;

/// `(16 + 224 e) e` (isperrboundA) times 72: 4 lifts of 3 squares, 6 products each.
const INSPHERE_BOUND: f64 = 1.29e-13;

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

/// Positive where `a`, `b`, `c` turn counter-clockwise, negative where clockwise, zero where collinear.
pub fn orient2d(a: [f64; 2], b: [f64; 2], c: [f64; 2]) -> f64 {
    let [a, b, c] = [a, b, c].map(|p| Coord { x: p[0], y: p[1] });
    robust::orient2d(a, b, c)
}

/// The sign of `det(b - a, c - a, d - a)`: positive for a positively oriented tetrahedron, zero where coplanar.
#[inline]
pub fn orient3d(a: &[f64; 3], b: &[f64; 3], c: &[f64; 3], d: &[f64; 3]) -> f64 {
    let [u, v, w] = [minus(b, a), minus(c, a), minus(d, a)];
    let det =
        u[2] * (v[0] * w[1] - w[0] * v[1]) + v[2] * (w[0] * u[1] - u[0] * w[1]) + w[2] * (u[0] * v[1] - v[0] * u[1]);
    let size = |k: usize| larger(larger(u[k].abs(), v[k].abs()), w[k].abs());
    let (x, y, z) = (size(0), size(1), size(2));
    let (least, most) = (smaller(smaller(x, y), z), larger(larger(x, y), z));
    // Inside this range neither the determinant nor the bound can underflow or overflow.
    if least > 1e-97 && most < 1e102 && det.abs() > ORIENT3D_BOUND * x * y * z {
        return det;
    }
    exact_orient3d(a, b, c, d, least)
}

#[cold]
fn exact_orient3d(a: &[f64; 3], b: &[f64; 3], c: &[f64; 3], d: &[f64; 3], least: f64) -> f64 {
    if least == 0.0 {
        return 0.0;
    }
    // Shewchuk's sign is the opposite one, hence the exchange.
    robust::orient3d(coord(b), coord(a), coord(c), coord(d))
}

/// Positive where `e` lies strictly inside the sphere through the positively oriented tetrahedron `a b c d`, zero where
/// on it.
#[inline]
pub fn insphere(a: &[f64; 3], b: &[f64; 3], c: &[f64; 3], d: &[f64; 3], e: &[f64; 3]) -> f64 {
    let [p, q, r, s] = [minus(a, e), minus(b, e), minus(c, e), minus(d, e)];
    let minor = |u: &[f64; 3], v: &[f64; 3]| u[0] * v[1] - v[0] * u[1];
    let (pq, qr, rs, sp, pr, qs) =
        (minor(&p, &q), minor(&q, &r), minor(&r, &s), minor(&s, &p), minor(&p, &r), minor(&q, &s));
    let pqr = p[2] * qr - q[2] * pr + r[2] * pq;
    let qrs = q[2] * rs - r[2] * qs + s[2] * qr;
    let rsp = r[2] * sp + s[2] * pr + p[2] * rs;
    let spq = s[2] * pq + p[2] * qs + q[2] * sp;
    let lift = |u: &[f64; 3]| u[0] * u[0] + u[1] * u[1] + u[2] * u[2];
    let det = (lift(&p) * qrs - lift(&q) * rsp) + (lift(&r) * spq - lift(&s) * pqr);
    let size = |k: usize| larger(larger(p[k].abs(), q[k].abs()), larger(r[k].abs(), s[k].abs()));
    let (x, y, z) = (size(0), size(1), size(2));
    let (least, most) = (smaller(smaller(x, y), z), larger(larger(x, y), z));
    if least > 1e-58 && most < 1e61 && det.abs() > INSPHERE_BOUND * x * y * z * (most * most) {
        return det;
    }
    exact_insphere(a, b, c, d, e)
}

#[cold]
fn exact_insphere(a: &[f64; 3], b: &[f64; 3], c: &[f64; 3], d: &[f64; 3], e: &[f64; 3]) -> f64 {
    robust::insphere(coord(b), coord(a), coord(c), coord(d), coord(e))
}
