//! The Taylor-Hood tetrahedron: quadratic displacement (ten nodes, edges may be curved), linear
//! pressure.
//!
//! Source: C. Taylor and P. Hood, Computers & Fluids 1 (1973). It satisfies the inf-sup condition,
//! so it does not lock as Poisson's ratio nears 0.5. The pressure is continuous within a region and
//! jumps between regions, as it does where the shear modulus jumps.

use crate::numerics::tetrahedron::{self, slopes};
use crate::types::space::{cross, determinant, dot};

/// (5 + 3 sqrt 5) / 20 and (5 - sqrt 5) / 20: barycentric coordinates of [`RULE`].
const KEAST_A: f64 = 0.585_410_196_624_968_5;
const KEAST_B: f64 = 0.138_196_601_125_010_5;

/// Quadrature of degree 2: barycentric coordinates and weight (sum 1) of each of four points (Keast
/// 1986).
pub(crate) const RULE: [([f64; 4], f64); 4] = [
    ([KEAST_A, KEAST_B, KEAST_B, KEAST_B], 0.25),
    ([KEAST_B, KEAST_A, KEAST_B, KEAST_B], 0.25),
    ([KEAST_B, KEAST_B, KEAST_A, KEAST_B], 0.25),
    ([KEAST_B, KEAST_B, KEAST_B, KEAST_A], 0.25),
];

/// Gradients of the ten shape functions (1/mm) and the Jacobian determinant (mm^3) at `l` in the
/// element of nodes `p` (mm).
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

/// An element's places as a polynomial of the second to fourth barycentric coordinate `l`, and the
/// straight element of its corners.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Mapping {
    origin: [f64; 3],
    /// What stands beside each `l_b`.
    linear: [[f64; 3]; 3],
    /// What stands beside `l_b^2`, doubled, on the diagonal and beside `l_b l_c` elsewhere (mm);
    /// zero where edges are straight.
    bent: [[[f64; 3]; 3]; 3],
    /// Gradients of the coordinates in the straight element (1/mm).
    gradient: [[f64; 3]; 3],
}

impl Mapping {
    /// That of the element of nodes `p` (mm).
    pub fn of(p: &[[f64; 3]; 10]) -> Self {
        // The nodes in the middle of the edges from the first corner, and of those between the
        // others.
        let from_first = [p[4], p[6], p[7]];
        let between = |b: usize, c: usize| p[[5, 8, 9][b + c - 1]];
        let each = |f: &dyn Fn(usize, usize) -> f64| [0, 1, 2].map(|b| [0, 1, 2].map(|a| f(b, a)));
        let linear = each(&|b, a| 4.0 * from_first[b][a] - 3.0 * p[0][a] - p[b + 1][a]);
        let bent = [0, 1, 2].map(|b| {
            each(&|c, a| {
                let (first, own) = (p[0][a], from_first[b][a]);
                if b == c {
                    2.0 * (2.0 * first + 2.0 * p[b + 1][a] - 4.0 * own)
                } else {
                    4.0 * (first - own - from_first[c][a] + between(b, c)[a])
                }
            })
        });
        let edges = [1, 2, 3].map(|b| std::array::from_fn(|a| p[b][a] - p[0][a]));
        Self { origin: p[0], linear, bent, gradient: across(&edges) }
    }

    /// Barycentric coordinates of the place `x` (mm) in the straight element.
    pub fn straight(&self, x: [f64; 3]) -> [f64; 4] {
        let d: [f64; 3] = std::array::from_fn(|a| x[a] - self.origin[a]);
        let [b, c, e] = self.gradient.map(|g| dot(g, d));
        [1.0 - b - c - e, b, c, e]
    }

    /// Barycentric coordinates of the place `x` (mm), by Newton's method from those in the straight
    /// element, to about 10^-10; none when it does not converge.
    pub fn locate(&self, x: [f64; 3]) -> Option<[f64; 4]> {
        let [_, mut l @ ..] = self.straight(x);
        for _ in 0..12 {
            // The polynomial is half of linear plus slope, times l.
            let slope: [[f64; 3]; 3] = std::array::from_fn(|b| {
                let [u, v, w] = &self.bent[b];
                std::array::from_fn(|a| self.linear[b][a] + l[0] * u[a] + l[1] * v[a] + l[2] * w[a])
            });
            let rest: [f64; 3] = std::array::from_fn(|a| {
                let half = |b: usize| 0.5 * l[b] * (self.linear[b][a] + slope[b][a]);
                x[a] - self.origin[a] - half(0) - half(1) - half(2)
            });
            let step = across(&slope).map(|row| dot(row, rest));
            l.iter_mut().zip(step).for_each(|(l, s)| *l += s);
            // What is no number converges no more.
            if !l.iter().all(|v| v.abs() <= 4.0) {
                return None;
            }
            // Each step squares what is left.
            if step.iter().all(|v| v.abs() < NEWTON_TOLERANCE) {
                return Some([1.0 - l[0] - l[1] - l[2], l[0], l[1], l[2]]);
            }
        }
        None
    }
}

/// Newton step (barycentric coordinates) after which a place is known to about its square.
const NEWTON_TOLERANCE: f64 = 1e-5;

/// Rows of the inverse of the matrix of these columns; not finite where they lie in a plane.
fn across(columns: &[[f64; 3]; 3]) -> [[f64; 3]; 3] {
    let [a, b, c] = *columns;
    let rows = [cross(b, c), cross(c, a), cross(a, b)];
    let det = dot(a, rows[0]);
    rows.map(|row| row.map(|v| v / det))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::numerics::random::Random;
    use crate::numerics::tetrahedron::{EDGES, shapes};

    #[test]
    fn a_place_in_a_curved_element_is_found_by_its_coordinates() {
        let mut random = Random::new(3, 0);
        let mut draw = |most: f64| most * (random.bits() as f64 / u64::MAX as f64 - 0.5);
        for bend in [0.0, 0.05, 0.3] {
            let corners = [[7.0, 3.0, -2.0], [9.0, 3.2, -2.1], [7.3, 5.0, -1.8], [7.1, 3.1, 0.2]];
            let mut nodes = [[0.0; 3]; 10];
            nodes[..4].copy_from_slice(&corners);
            for (k, [i, j]) in EDGES.into_iter().enumerate() {
                nodes[4 + k] = std::array::from_fn(|a| 0.5 * (corners[i][a] + corners[j][a]) + draw(bend));
            }
            let mapping = Mapping::of(&nodes);
            for l in
                [[0.25; 4], [0.7, 0.1, 0.05, 0.15], [0.0, 0.5, 0.5, 0.0], [0.1, 0.2, 0.3, 0.4], [1.0, 0.0, 0.0, 0.0]]
            {
                let n = shapes(l);
                let place: [f64; 3] = std::array::from_fn(|a| (0..10).map(|k| n[k] * nodes[k][a]).sum());
                let found = mapping.locate(place).unwrap();
                assert!((0..4).all(|k| (found[k] - l[k]).abs() < 1e-9), "bent by {bend}: {found:?} for {l:?}");
                if bend == 0.0 {
                    assert!((0..4).all(|k| (mapping.straight(place)[k] - l[k]).abs() < 1e-12));
                }
            }
        }
        // A place far outside has none.
        assert_eq!(Mapping::of(&[[0.0; 3]; 10]).locate([1.0; 3]), None);
    }
}
