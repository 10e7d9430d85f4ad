//! The triquadratic element (27 nodes, 27 Gauss points) by products of one-dimensional tables.

use std::ops::{AddAssign, Mul};

/// Nodes, and Gauss points, of an element.
pub const NODES: usize = 27;

/// sqrt(3 / 5).
const SQRT_3_5: f64 = 0.774_596_669_241_483_4;

/// Gauss points on [-1, 1].
pub(crate) const GAUSS: [f64; 3] = [-SQRT_3_5, 0.0, SQRT_3_5];

/// Their weights.
const GAUSS_WEIGHTS: [f64; 3] = [5.0 / 9.0, 8.0 / 9.0, 5.0 / 9.0];

/// A table, row by Gauss point (or node, transposed).
pub type Table<T> = [[T; 3]; 3];

/// Values and derivatives of the three quadratic polynomials of -1, 0, 1 at `t`.
#[inline(always)]
pub fn line(t: f64) -> [[f64; 3]; 2] {
    [[t * (t - 1.0) / 2.0, 1.0 - t * t, t * (t + 1.0) / 2.0], [t - 0.5, -2.0 * t, t + 0.5]]
}

/// Weight of a Gauss point in the unit cell [-1, 1]^3.
pub fn weight(point: usize) -> f64 {
    GAUSS_WEIGHTS[point % 3] * GAUSS_WEIGHTS[point / 3 % 3] * GAUSS_WEIGHTS[point / 9]
}

/// Values and derivatives at the Gauss points and their transposes.
#[derive(Debug, Clone, Copy)]
pub struct Tables<T> {
    value: Table<T>,
    slope: Table<T>,
    value_transposed: Table<T>,
    slope_transposed: Table<T>,
}

impl<T: Copy> Tables<T> {
    /// With numbers made by `real`.
    pub fn new(real: impl Fn(f64) -> T) -> Self {
        let at = |d: usize, q: usize, n: usize| real(line(GAUSS[q])[d][n]);
        Self {
            value: std::array::from_fn(|q| std::array::from_fn(|n| at(0, q, n))),
            slope: std::array::from_fn(|q| std::array::from_fn(|n| at(1, q, n))),
            value_transposed: std::array::from_fn(|n| std::array::from_fn(|q| at(0, q, n))),
            slope_transposed: std::array::from_fn(|n| std::array::from_fn(|q| at(1, q, n))),
        }
    }
}

/// `L` elements side by side.
pub(crate) type Nodal<T, const L: usize> = [[T; L]; NODES];

/// `out[.. q ..] += sum_n table[q][n] x[.. n ..]` along the axis of `stride` 1, 3 or 9.
#[inline(always)]
fn along<T: Copy + Mul<Output = T> + AddAssign, const L: usize>(
    stride: usize,
    table: &Table<T>,
    x: &Nodal<T, L>,
    out: &mut Nodal<T, L>,
) {
    for line in 0..9 {
        let start = line % stride + line / stride * 3 * stride;
        for q in 0..3 {
            for n in 0..3 {
                for l in 0..L {
                    out[start + q * stride][l] += table[q][n] * x[start + n * stride][l];
                }
            }
        }
    }
}

/// Derivatives along the three local axes at the Gauss points, from values at the nodes.
#[inline(always)]
pub fn gradient<T: Copy + Default + Mul<Output = T> + AddAssign, const L: usize>(
    t: &Tables<T>,
    x: &Nodal<T, L>,
) -> [Nodal<T, L>; 3] {
    let zero = [[T::default(); L]; NODES];
    let (mut v, mut s) = (zero, zero);
    along(1, &t.value, x, &mut v);
    along(1, &t.slope, x, &mut s);
    let (mut vv, mut vs, mut sv) = (zero, zero, zero);
    along(3, &t.value, &v, &mut vv);
    along(3, &t.slope, &v, &mut vs);
    along(3, &t.value, &s, &mut sv);
    let mut out = [zero; 3];
    along(9, &t.value, &sv, &mut out[0]);
    along(9, &t.value, &vs, &mut out[1]);
    along(9, &t.slope, &vv, &mut out[2]);
    out
}

/// The transpose of [`gradient`].
#[inline(always)]
pub(crate) fn divergence<T: Copy + Default + Mul<Output = T> + AddAssign, const L: usize>(
    t: &Tables<T>,
    g: &[Nodal<T, L>; 3],
) -> Nodal<T, L> {
    let zero = [[T::default(); L]; NODES];
    let (mut vv, mut vs, mut sv) = (zero, zero, zero);
    along(9, &t.value_transposed, &g[0], &mut sv);
    along(9, &t.value_transposed, &g[1], &mut vs);
    along(9, &t.slope_transposed, &g[2], &mut vv);
    let (mut v, mut s) = (zero, zero);
    along(3, &t.value_transposed, &vv, &mut v);
    along(3, &t.slope_transposed, &vs, &mut v);
    along(3, &t.value_transposed, &sv, &mut s);
    let mut out = zero;
    along(1, &t.value_transposed, &v, &mut out);
    along(1, &t.slope_transposed, &s, &mut out);
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gradients_of_a_quadratic_are_exact_and_divergence_is_the_transpose() {
        let t = Tables::new(|v| v);
        let f = |p: [f64; 3]| p[0] * p[0] * p[1] - 2.0 * p[1] * p[2] * p[2] + p[0] * p[2];
        let node = |n: usize| [n % 3, n / 3 % 3, n / 9].map(|i| i as f64 - 1.0);
        let x: Nodal<f64, 1> = std::array::from_fn(|n| [f(node(n))]);
        let g = gradient(&t, &x);
        for q in 0..27 {
            let [a, b, c] = [q % 3, q / 3 % 3, q / 9].map(|i| GAUSS[i]);
            let exact = [2.0 * a * b + c, a * a - 2.0 * c * c, -4.0 * b * c + a];
            (0..3).for_each(|d| assert!((g[d][q][0] - exact[d]).abs() < 1e-14));
        }
        let h: [Nodal<f64, 1>; 3] = std::array::from_fn(|d| std::array::from_fn(|q| [(q * q + 5 * d) as f64 * 0.01]));
        let left: f64 = (0..3).flat_map(|d| (0..27).map(move |q| (d, q))).map(|(d, q)| g[d][q][0] * h[d][q][0]).sum();
        let y = divergence(&t, &h);
        let right: f64 = (0..27).map(|n| y[n][0] * x[n][0]).sum();
        assert!((left - right).abs() < 1e-11, "{left} {right}");
        assert!((0..27).map(weight).sum::<f64>() - 8.0 < 1e-14);
    }
}
