//! Takes the folds out of a spline field: tissue cannot turn inside out.

use crate::numerics::bspline::Lattice;
use crate::numerics::simd::dispatch;
use crate::types::space::determinant;
use rayon::prelude::*;

/// Most smoothing iterations.
const MAX_ITERATIONS: usize = 20;

/// B-spline weights of the three nodes about a knot: of the value, and of the derivative per step.
const VALUE_WEIGHTS: [f32; 3] = [1.0 / 6.0, 2.0 / 3.0, 1.0 / 6.0];
const SLOPE_WEIGHTS: [f32; 3] = [-0.5, 0.0, 0.5];
/// Smoothing weights of a node and its two neighbours along an axis.
const SMOOTHING_WEIGHTS: [f32; 3] = [0.25, 0.5, 0.25];

/// Rounding of a determinant in single precision, for derivatives of about 1 or less.
const DETERMINANT_ROUNDING: f32 = 1e-4;

/// A lattice with its steps in mm.
struct Knots<'a> {
    lattice: &'a Lattice,
    per_mm: [f32; 3],
}

impl<'a> Knots<'a> {
    fn new(lattice: &'a Lattice, spacing: [f64; 3]) -> Self {
        let edge = |a: usize| (lattice.step[a] as f64 * spacing[a]) as f32;
        Self { lattice, per_mm: std::array::from_fn(|a| if lattice.nodes[a] == 1 { 0.0 } else { 1.0 / edge(a) }) }
    }

    /// Whether the node has a knot within the voxel grid.
    fn is_inner(&self, p: [usize; 3]) -> bool {
        (0..3).all(|a| self.lattice.nodes[a] == 1 || (1..=self.lattice.nodes[a] - 3).contains(&p[a]))
    }

    /// The node at `at` moved by `by` along each axis, kept on the lattice.
    fn node(&self, at: [usize; 3], by: [usize; 3]) -> usize {
        let n = self.lattice.nodes;
        let p: [usize; 3] = std::array::from_fn(|a| (at[a] + by[a]).saturating_sub(1).min(n[a] - 1));
        p[0] + n[0] * (p[1] + n[1] * p[2])
    }

    /// Jacobian determinant of x + u(x) at the knot of the node at `at`.
    fn jacobian(&self, coefficients: &[f32], at: [usize; 3]) -> f32 {
        let total = self.lattice.len();
        let mut gradient = [[0.0f32; 3]; 3];
        for k in 0..3 {
            for j in 0..3 {
                for i in 0..3 {
                    let node = self.node(at, [i, j, k]);
                    let w = [
                        SLOPE_WEIGHTS[i] * VALUE_WEIGHTS[j] * VALUE_WEIGHTS[k] * self.per_mm[0],
                        VALUE_WEIGHTS[i] * SLOPE_WEIGHTS[j] * VALUE_WEIGHTS[k] * self.per_mm[1],
                        VALUE_WEIGHTS[i] * VALUE_WEIGHTS[j] * SLOPE_WEIGHTS[k] * self.per_mm[2],
                    ];
                    for (c, row) in gradient.iter_mut().enumerate() {
                        let u = coefficients[c * total + node];
                        for (g, w) in row.iter_mut().zip(w) {
                            *g += w * u;
                        }
                    }
                }
            }
        }
        for (c, row) in gradient.iter_mut().enumerate() {
            row[c] += 1.0;
        }
        determinant(&gradient.map(|row| row.map(f64::from))) as f32
    }

    fn place(&self, node: usize) -> [usize; 3] {
        let [nx, ny, _] = self.lattice.nodes;
        [node % nx, node / nx % ny, node / (nx * ny)]
    }

    /// The nodes within `reach` of those given, in order.
    fn around(&self, nodes: &[usize], reach: usize) -> Vec<usize> {
        let n = self.lattice.nodes;
        let mut all = Vec::new();
        for &node in nodes {
            let p = self.place(node);
            let [x, y, z]: [_; 3] = std::array::from_fn(|a| p[a].saturating_sub(reach)..(p[a] + reach + 1).min(n[a]));
            for k in z {
                for j in y.clone() {
                    all.extend(x.clone().map(|i| i + n[0] * (j + n[1] * k)));
                }
            }
        }
        all.sort_unstable();
        all.dedup();
        all
    }

    /// Those of the nodes at whose knot the volume shrinks below `least`.
    fn folded(
        &self,
        coefficients: &[f32],
        nodes: impl IndexedParallelIterator<Item = usize>,
        least: f32,
    ) -> Vec<usize> {
        nodes
            .with_min_len(1024)
            .filter(|&node| {
                let p = self.place(node);
                self.is_inner(p) && self.jacobian(coefficients, p) < least
            })
            .collect()
    }

    /// All nodes at whose knot the volume may shrink below `least`, in order: the same determinants
    /// by whole rows and in single precision, with room for their rounding.
    fn suspects(&self, coefficients: &[f32], least: f32) -> Vec<usize> {
        let [nx, ny, nz] = self.lattice.nodes;
        let total = self.lattice.len();
        if nx == 1 {
            return (0..total).collect();
        }
        let inner = |n: usize| if n == 1 { 0..1 } else { 1..n - 2 };
        let near = |p: usize, n: usize| if n == 1 { [0; 3] } else { [p - 1, p, p + 1] };
        let in_plane = |k: usize| -> Vec<usize> {
            // Of each component what its derivatives along x, y and z are made of along a row, and
            // the room that a node has.
            let mut sums: [[Vec<f32>; 3]; 3] = std::array::from_fn(|_| std::array::from_fn(|_| vec![0.0; nx]));
            let mut room = vec![0.0f32; nx - 3];
            let mut found = Vec::new();
            for j in inner(ny) {
                dispatch(
                    #[inline(always)]
                    || {
                        for (c, sums) in sums.iter_mut().enumerate() {
                            sums.iter_mut().for_each(|s| s.fill(0.0));
                            let [x, y, z] = sums.each_mut().map(|s| &mut s[..nx]);
                            for (c_z, k) in near(k, nz).into_iter().enumerate() {
                                for (c_y, j) in near(j, ny).into_iter().enumerate() {
                                    let row = &coefficients[c * total + nx * (j + ny * k)..][..nx];
                                    let [wx, wy, wz] = [
                                        VALUE_WEIGHTS[c_y] * VALUE_WEIGHTS[c_z] * self.per_mm[0],
                                        SLOPE_WEIGHTS[c_y] * VALUE_WEIGHTS[c_z] * self.per_mm[1],
                                        VALUE_WEIGHTS[c_y] * SLOPE_WEIGHTS[c_z] * self.per_mm[2],
                                    ];
                                    for i in 0..nx {
                                        x[i] += wx * row[i];
                                        y[i] += wy * row[i];
                                        z[i] += wz * row[i];
                                    }
                                }
                            }
                        }
                        let [[ux, uy, uz], [vx, vy, vz], [wx, wy, wz]] =
                            sums.each_ref().map(|s| s.each_ref().map(|s| &s[..nx]));
                        for (i, room) in room.iter_mut().enumerate() {
                            let slope = |s: &[f32]| SLOPE_WEIGHTS[0] * s[i] + SLOPE_WEIGHTS[2] * s[i + 2];
                            let value = |s: &[f32]| {
                                VALUE_WEIGHTS[0] * s[i] + VALUE_WEIGHTS[1] * s[i + 1] + VALUE_WEIGHTS[2] * s[i + 2]
                            };
                            let [a, b, c] = [slope(ux), value(uy), value(uz)];
                            let [d, e, f] = [slope(vx), value(vy), value(vz)];
                            let [g, h, l] = [slope(wx), value(wy), value(wz)];
                            let square = a * a + b * b + c * c + d * d + e * e + f * f + g * g + h * h + l * l;
                            let (a, e, l) = (1.0 + a, 1.0 + e, 1.0 + l);
                            let volume = a * (e * l - f * h) - b * (d * l - f * g) + c * (d * h - e * g);
                            *room = volume - least - DETERMINANT_ROUNDING * (1.0 + square * square);
                        }
                    },
                );
                // What is not a number is looked at as well.
                let tight = room.iter().enumerate().filter(|(_, room)| room.is_nan() || **room < 0.0);
                found.extend(tight.map(|(i, _)| i + 1 + nx * (j + ny * k)));
            }
            found
        };
        inner(nz).into_par_iter().flat_map_iter(in_plane).collect()
    }

    /// Smooths the coefficients (planar) of some nodes.
    fn smooth(&self, coefficients: &mut [f32], nodes: &[usize]) {
        for values in coefficients.chunks_exact_mut(self.lattice.len()) {
            let smooth: Vec<f32> =
                nodes.par_iter().with_min_len(256).map(|&node| self.smoothed(values, node)).collect();
            for (&node, v) in nodes.iter().zip(smooth) {
                values[node] = v;
            }
        }
    }

    fn smoothed(&self, values: &[f32], node: usize) -> f32 {
        let at = self.place(node);
        let mut sum = 0.0;
        for k in 0..3 {
            for j in 0..3 {
                for i in 0..3 {
                    sum += SMOOTHING_WEIGHTS[i]
                        * SMOOTHING_WEIGHTS[j]
                        * SMOOTHING_WEIGHTS[k]
                        * values[self.node(at, [i, j, k])];
                }
            }
        }
        sum
    }
}

/// Smooths the coefficients (planar, mm) about every knot where the volume shrinks below `least` of
/// what it was, until there is none, twenty rounds at most. `spacing` is that of the lattice's
/// voxels (mm).
pub(crate) fn unfold(lattice: &Lattice, spacing: [f64; 3], coefficients: &mut [f32], least: f32) {
    let knots = Knots::new(lattice, spacing);
    let mut folded = knots.folded(coefficients, knots.suspects(coefficients, least).into_par_iter(), least);
    for _ in 0..MAX_ITERATIONS {
        if folded.is_empty() {
            break;
        }
        let touched = knots.around(&folded, 1);
        knots.smooth(coefficients, &touched);
        folded = knots.folded(coefficients, knots.around(&touched, 1).into_par_iter(), least);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::GridVector;

    /// Least determinant at the knots.
    fn least(lattice: &Lattice, spacing: [f64; 3], coefficients: &[f32]) -> f32 {
        let knots = Knots::new(lattice, spacing);
        let all = (0..lattice.len()).filter(|&n| knots.is_inner(knots.place(n)));
        all.map(|n| knots.jacobian(coefficients, knots.place(n))).fold(f32::INFINITY, f32::min)
    }

    fn bump(lattice: &Lattice, height: f32) -> Vec<f32> {
        let mut c = vec![0.0; 3 * lattice.len()];
        let [nx, ny, nz] = lattice.nodes;
        c[nx / 2 + nx * (ny / 2 + ny * (nz / 2))] = height;
        c
    }

    #[test]
    fn the_determinant_is_that_of_an_affine_motion() {
        let lattice = Lattice::new([20, 24, 9], [4, 3, 2]);
        let spacing = [1.0, 2.0, 3.0];
        let map = [[0.1, -0.2, 0.05], [0.3, -0.3, 0.1], [0.0, 0.2, 0.2]];
        let c = lattice.fit(|p| {
            let [x, y, z] = p.in_mm([1.0, 2.0, 3.0]);
            GridVector(map.map(|r| r[0] * x + r[1] * y + r[2] * z))
        });
        // (1.1)(0.7 * 1.2 - 0.1 * 0.2) - (-0.2)(0.3 * 1.2 - 0) + 0.05 (0.3 * 0.2 - 0)
        assert!((least(&lattice, spacing, &c) - 0.977).abs() < 1e-3);
    }

    #[test]
    fn no_fold_escapes_the_quick_look() {
        use crate::numerics::random::Random;
        for (shape, size) in
            [([40, 36, 30], 6.0), ([40, 36, 30], 20.0), ([40, 36, 1], 6.0), ([1, 36, 40], 6.0), ([40, 1, 36], 9.0)]
        {
            let lattice = Lattice::new(shape, [4; 3]);
            let mut random = Random::new(7, 0);
            let c: Vec<f32> = (0..3 * lattice.len()).map(|_| size * random.normals()[0] as f32).collect();
            let knots = Knots::new(&lattice, [1.0, 1.0, 2.0]);
            let all = knots.folded(&c, (0..lattice.len()).into_par_iter(), 0.1);
            let suspects = knots.suspects(&c, 0.1);
            let few = suspects.len() <= all.len() + all.len() / 20 + 2;
            assert!(
                !all.is_empty() && (few || shape[0] == 1),
                "{shape:?} {size}: {} and {}",
                suspects.len(),
                all.len()
            );
            assert_eq!(knots.folded(&c, suspects.into_par_iter(), 0.1), all, "{shape:?}");
        }
    }

    #[test]
    fn folds_go_and_sound_fields_stay() {
        for shape in [[40, 36, 30], [40, 36, 1]] {
            let (lattice, spacing) = (Lattice::new(shape, [4; 3]), [1.0, 1.0, 2.0]);
            let (mut folded, sound) = (bump(&lattice, 40.0), bump(&lattice, 3.0));
            assert!(least(&lattice, spacing, &folded) < 0.0);
            unfold(&lattice, spacing, &mut folded, 0.1);
            assert!(least(&lattice, spacing, &folded) >= 0.1, "{}", least(&lattice, spacing, &folded));
            let mut same = sound.clone();
            unfold(&lattice, spacing, &mut same, 0.1);
            assert_eq!(same, sound);
        }
    }
}
