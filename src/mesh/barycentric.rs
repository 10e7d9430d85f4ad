//! Barycentric weights of a point in an element of any shape.

use crate::types::space::dot;

/// Weights, not negative and of sum one, of the element's point nearest to `p`.
///
/// `parts` are the signed volumes (areas) with each corner moved to `p`. Their ratios are the
/// weights, unless rounding outweighs them, in a sliver or beyond the hull, so that the weights do
/// not lead back to within `tolerance` of `p`; then the nearest point is sought on each face of the
/// element.
pub(super) fn weights<const N: usize>(
    corners: [[f64; 3]; N],
    p: [f64; 3],
    parts: [f64; N],
    tolerance: f64,
) -> [f64; N] {
    let parts = parts.map(|v| v.max(0.0));
    let sum: f64 = parts.iter().sum();
    let mut best = parts.map(|v| v / sum);
    let mut least = distance(&corners, &best, p);
    if least <= tolerance {
        return best;
    }
    least = f64::INFINITY;
    // A set bit takes the corner in.
    for face in 1u32..1 << N {
        if let Some(weights) = foot(&corners, face, p) {
            let found = distance(&corners, &weights, p);
            if found < least {
                (best, least) = (weights, found);
            }
        }
    }
    best
}

/// How far the weights lead from `p`.
fn distance<const N: usize>(corners: &[[f64; 3]; N], weights: &[f64; N], p: [f64; 3]) -> f64 {
    let d = std::array::from_fn(|k| (0..N).map(|i| weights[i] * (corners[i][k] - p[k])).sum());
    dot(d, d).sqrt()
}

/// The weights of the foot of `p` on the flat space through a face; none if a weight is negative or
/// the face is flat.
fn foot<const N: usize>(corners: &[[f64; 3]; N], face: u32, p: [f64; 3]) -> Option<[f64; N]> {
    let members: Vec<usize> = (0..N).filter(|i| face >> i & 1 == 1).collect();
    let (&origin, rest) = members.split_first()?;
    let from = |q: [f64; 3]| -> [f64; 3] { std::array::from_fn(|k| q[k] - corners[origin][k]) };
    // Gram-Schmidt: edge k is base k plus the sum over l < k of share[k][l] base l.
    let mut bases: Vec<[f64; 3]> = Vec::new();
    let mut share = [[0.0; 3]; 3];
    for (k, &i) in rest.iter().enumerate() {
        let edge = from(corners[i]);
        let mut base = edge;
        for (l, b) in bases.iter().enumerate() {
            share[k][l] = dot(base, *b) / dot(*b, *b);
            base = std::array::from_fn(|a| base[a] - share[k][l] * b[a]);
        }
        if dot(base, base) <= 1e-20 * dot(edge, edge) {
            return None;
        }
        bases.push(base);
    }
    let offset = from(p);
    let mut weights = [0.0; N];
    let mut first = 1.0;
    for k in (0..rest.len()).rev() {
        let taken: f64 = (k + 1..rest.len()).map(|m| share[m][k] * weights[rest[m]]).sum();
        weights[rest[k]] = dot(offset, bases[k]) / dot(bases[k], bases[k]) - taken;
        first -= weights[rest[k]];
    }
    weights[origin] = first;
    // One corner alone always has a foot, itself.
    weights.iter().all(|&w| w >= 0.0).then_some(weights)
}
