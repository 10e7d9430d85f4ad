//! The quadratic tetrahedron: ten nodes, corners then the middles of the edges (VTK's order); edges
//! may be curved.

use crate::types::space::Matrix3;

/// The edges between the corners, in the order of nodes 4 to 9.
pub const EDGES: [[usize; 2]; 6] = [[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]];

/// The ten shape functions at barycentric coordinates `l`.
pub fn shapes(l: [f64; 4]) -> [f64; 10] {
    std::array::from_fn(|k| {
        if k < 4 {
            l[k] * (2.0 * l[k] - 1.0)
        } else {
            let [i, j] = EDGES[k - 4];
            4.0 * l[i] * l[j]
        }
    })
}

/// The barycentric coordinates at which the shape functions are these.
pub(crate) fn barycentric(shapes: &[f64; 10]) -> [f64; 4] {
    let mut out = [shapes[0], shapes[1], shapes[2], shapes[3]];
    for ([i, j], s) in EDGES.into_iter().zip(&shapes[4..]) {
        out[i] += 0.5 * s;
        out[j] += 0.5 * s;
    }
    out
}

/// Derivatives of the shape functions with respect to the barycentric coordinates 1, 2 and 3.
pub fn slopes(l: [f64; 4]) -> [[f64; 3]; 10] {
    let d = |i: usize, b: usize| if i == 0 { -1.0 } else { f64::from(u8::from(i == b + 1)) };
    std::array::from_fn(|k| {
        std::array::from_fn(|b| {
            if k < 4 {
                (4.0 * l[k] - 1.0) * d(k, b)
            } else {
                let [i, j] = EDGES[k - 4];
                4.0 * (l[i] * d(j, b) + l[j] * d(i, b))
            }
        })
    })
}

/// The Jacobian matrix (mm) of the element of nodes `p` (mm): row a, column b is the derivative of
/// coordinate a with respect to barycentric coordinate b + 1. `slopes` are those at the place.
pub fn jacobian(p: &[[f64; 3]; 10], slopes: &[[f64; 3]; 10]) -> Matrix3 {
    let mut j = [[0.0; 3]; 3];
    for (q, s) in p.iter().zip(slopes) {
        for a in 0..3 {
            for b in 0..3 {
                j[a][b] += q[a] * s[b];
            }
        }
    }
    j
}
