//! The Taylor-Hood tetrahedron: quadratic displacement (ten nodes, edges may be curved), linear pressure.
//!
//! Source: C. Taylor and P. Hood, Computers & Fluids 1 (1973). It satisfies the inf-sup condition, so it does not lock as
//! Poisson's ratio nears 0.5. The pressure is continuous within a region and jumps between regions, as it does where the
//! shear modulus jumps.

use crate::numerics::tetrahedron::{self, shapes, slopes};
use crate::types::space::{cross, determinant, dot};

const A: f64 = 0.585_410_196_624_968_5;
const B: f64 = 0.138_196_601_125_010_5;

/// Quadrature of degree 2: barycentric coordinates and weight (sum 1) of each of four points (Keast 1986).
pub const RULE: [([f64; 4], f64); 4] =
    [([A, B, B, B], 0.25), ([B, A, B, B], 0.25), ([B, B, A, B], 0.25), ([B, B, B, A], 0.25)];

/// Gradients of the ten shape functions (1/mm) and the Jacobian determinant (mm^3) at `l` in the element of nodes `p` (mm).
pub fn jacobian(p: &[[f64; 3]; 10], l: [f64; 4]) -> ([[f64; 3]; 10], f64) {
    let slopes = slopes(l);
    let j = tetrahedron::jacobian(p, &slopes);
    let det = determinant(&j);
    // inverse[b][a] = d(barycentric b)/d(x a)
    let inverse: [[f64; 3]; 3] = std::array::from_fn(|r| {
        std::array::from_fn(|c| {
            let (a, b) = ((c + 1) % 3, (c + 2) % 3);
            let (m, n) = ((r + 1) % 3, (r + 2) % 3);
            (j[a][m] * j[b][n] - j[a][n] * j[b][m]) / det
        })
    });
    (slopes.map(|s| std::array::from_fn(|a| (0..3).map(|b| s[b] * inverse[b][a]).sum())), det)
}

/// What an element needs at a quadrature point.
#[derive(Debug, Clone, Copy)]
pub struct Point {
    /// Gradients of the displacement's shape functions (1/mm).
    pub gradient: [[f64; 3]; 10],
    /// The pressure's shape functions.
    pub pressure: [f64; 4],
    /// Volume that the point stands for (mm^3).
    pub weight: f64,
}

/// The four quadrature points of the element of nodes `p` (mm).
pub fn points(p: &[[f64; 3]; 10]) -> [Point; 4] {
    RULE.map(|(l, w)| {
        let (gradient, det) = jacobian(p, l);
        Point { gradient, pressure: l, weight: w * det / 6.0 }
    })
}

/// Coordinates in a tetrahedron of straight edges.
#[derive(Debug, Clone, Copy)]
pub struct Straight {
    origin: [f64; 3],
    /// Gradients of the second to fourth barycentric coordinate (1/mm).
    gradient: [[f64; 3]; 3],
}

impl Straight {
    /// That of the element's corners, the first four of its nodes `p` (mm).
    pub fn of(p: &[[f64; 3]; 10]) -> Self {
        let edges = [1, 2, 3].map(|b| std::array::from_fn(|a| p[b][a] - p[0][a]));
        Self { origin: p[0], gradient: across(&edges) }
    }

    /// Barycentric coordinates of the place `x` (mm).
    pub fn at(&self, x: [f64; 3]) -> [f64; 4] {
        let d: [f64; 3] = std::array::from_fn(|a| x[a] - self.origin[a]);
        let [b, c, e] = self.gradient.map(|g| dot(g, d));
        [1.0 - b - c - e, b, c, e]
    }
}

/// Rows of the inverse of the matrix of these columns; not finite where they lie in a plane.
fn across(columns: &[[f64; 3]; 3]) -> [[f64; 3]; 3] {
    let [a, b, c] = *columns;
    let rows = [cross(b, c), cross(c, a), cross(a, b)];
    let det = dot(a, rows[0]);
    rows.map(|row| row.map(|v| v / det))
}

/// Barycentric coordinates of the place `x` (mm) in the element of nodes `p`, by Newton's method from those in the straight element;
/// none when it does not converge.
pub fn locate(p: &[[f64; 3]; 10], x: [f64; 3], straight: &Straight) -> Option<[f64; 4]> {
    let mut l = straight.at(x);
    for _ in 0..12 {
        let n = shapes(l);
        let rest: [f64; 3] = std::array::from_fn(|a| x[a] - (0..10).map(|k| n[k] * p[k][a]).sum::<f64>());
        let j = tetrahedron::jacobian(p, &slopes(l));
        let columns = std::array::from_fn(|b| std::array::from_fn(|a| j[a][b]));
        let step = across(&columns).map(|row| dot(row, rest));
        for b in 0..3 {
            l[b + 1] += step[b];
        }
        l[0] = 1.0 - l[1] - l[2] - l[3];
        // What is no number converges no more.
        if !l.iter().all(|v| v.abs() <= 4.0) {
            return None;
        }
        if step.iter().all(|v| v.abs() < 1e-11) {
            return Some(l);
        }
    }
    None
}
