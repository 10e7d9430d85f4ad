//! Splines, smoothness energy, filters and small algebra against closed forms and slow, obvious
//! sums.

use crate::truth::{Dense, dense, entry, invert, normals, random_blocks, sampled, voxels, with_threads};
use palpate::numerics::bending::{Coupled, Smoothness};
use palpate::numerics::block_diagonal::Blocks;
use palpate::numerics::bspline::{Lattice, SmoothSampler, weights};
use palpate::numerics::dense::symmetric_eigen;
use palpate::numerics::neighbours::Neighbours;
use palpate::numerics::random::Random;
use palpate::numerics::{filters, pyramid, statistics, symmetric3};
use palpate::{GridVector, VoxelPoint};

/// Shapes and steps: step dividing the shape or not, larger than it, one slice, a line.
const LATTICES: [([usize; 3], [usize; 3]); 9] = [
    ([13, 11, 9], [4, 5, 4]),
    ([12, 12, 12], [3, 4, 6]),
    ([7, 20, 5], [1, 2, 3]),
    ([17, 14, 1], [4, 3, 4]),
    ([21, 1, 1], [5, 1, 1]),
    ([5, 6, 4], [9, 16, 4]),
    ([30, 9, 5], [8, 3, 2]),
    ([43, 6, 1], [7, 4, 1]),
    ([40, 5, 4], [10, 4, 3]),
];

fn f64s(v: &[f32]) -> impl Iterator<Item = f64> {
    v.iter().map(|v| f64::from(*v))
}

fn largest_difference(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len());
    f64s(a).zip(f64s(b)).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

// Spline lattices

/// `D x` for a block-diagonal `D`.
fn apply_blocks(blocks: &[[f32; 6]], x: &[f32], out: &mut [f32]) {
    let n = blocks.len();
    for (i, a) in blocks.iter().enumerate() {
        let v = [x[i], x[n + i], x[2 * n + i]];
        out[i] = a[0] * v[0] + a[3] * v[1] + a[4] * v[2];
        out[n + i] = a[3] * v[0] + a[1] * v[1] + a[5] * v[2];
        out[2 * n + i] = a[4] * v[0] + a[5] * v[1] + a[2] * v[2];
    }
}

#[test]
fn spline_weights_are_the_cubic_b_spline() {
    for i in 0..=20 {
        let t = f64::from(i) / 20.0;
        let exact = [
            (1.0 - t).powi(3) / 6.0,
            (3.0 * t.powi(3) - 6.0 * t * t + 4.0) / 6.0,
            (-3.0 * t.powi(3) + 3.0 * t * t + 3.0 * t + 1.0) / 6.0,
            t.powi(3) / 6.0,
        ];
        for (w, e) in weights(t as f32).iter().zip(exact) {
            assert!((f64::from(*w) - e).abs() < 1e-6, "t {t}: {w} is not {e}");
        }
    }
}

#[test]
fn a_lattice_reproduces_affine_fields() {
    let affine = |p: [f64; 3]| [3.0 + 0.5 * p[0] - 0.25 * p[1], -1.0 + 0.1 * p[2], 0.3 * p[0] + 0.2 * p[1] - p[2]];
    for (shape, step) in LATTICES {
        let lattice = Lattice::new(shape, step);
        let field = lattice.evaluate(&lattice.fit(|p| GridVector(affine(p.0))));
        let total = field.len() / 3;
        for (i, p) in voxels(shape).enumerate() {
            let exact = affine(p.map(|v| v as f64));
            for c in 0..3 {
                let error = f64::from(field[c * total + i]) - exact[c];
                assert!(error.abs() < 1e-5 * 20.0, "{shape:?} step {step:?} at {p:?}: {error}");
            }
        }
    }
}

#[test]
fn the_basis_sums_to_one_everywhere() {
    let mut random = Random::new(3, 0);
    for (shape, step) in LATTICES {
        let lattice = Lattice::new(shape, step);
        let ones = vec![1.0f32; 3 * lattice.len()];
        assert!(lattice.evaluate(&ones).iter().all(|v| (v - 1.0).abs() < 1e-6));
        for _ in 0..50 {
            let p = shape.map(|n| random.uniform(-2.0, n as f64 + 1.0));
            let mut sum = 0.0f32;
            lattice.for_each_tap(VoxelPoint(p), |_, w| {
                assert!(w >= 0.0);
                sum += w;
            });
            assert!((sum - 1.0).abs() < 1e-6, "{shape:?} at {p:?}: {sum}");
        }
    }
}

#[test]
fn a_point_of_a_lattice_is_the_evaluated_voxel() {
    for (shape, step) in LATTICES {
        let lattice = Lattice::new(shape, step);
        let c = normals(3 * lattice.len(), 5);
        let field = lattice.evaluate(&c);
        let total = field.len() / 3;
        for (i, p) in voxels(shape).enumerate() {
            let GridVector(u) = lattice.at(&c, VoxelPoint(p.map(|v| v as f64)));
            for a in 0..3 {
                assert!((u[a] - f64::from(field[a * total + i])).abs() < 2e-6, "{shape:?} step {step:?} at {p:?}");
            }
        }
    }
}

/// The part of row `j` that is filled.
fn part(j: usize, nx: usize) -> std::ops::Range<usize> {
    if j % 3 == 2 && nx > 4 { 2..nx - 1 } else { 0..nx }
}

#[test]
fn accumulation_is_the_transpose_of_evaluation() {
    for (shape, step) in LATTICES {
        let lattice = Lattice::new(shape, step);
        let (nx, ny) = (shape[0], shape[1]);
        let total: usize = shape.iter().product();
        let (c, y) = (normals(3 * lattice.len(), 1), normals(3 * total, 2));
        // One row is left out by `fill`: it must count as zeros.
        let skipped = if ny > 1 { (ny - 1, shape[2] - 1) } else { (1, 0) };
        let sums = lattice.accumulate::<3>(|j, k, rows| {
            for (q, row) in rows.iter_mut().enumerate() {
                let from = q * total + nx * (j + ny * k);
                row.copy_from_slice(&y[from..from + nx]);
            }
            // All of a row, nothing of it, or a part: what lies outside the part counts as zero.
            if (j, k) == skipped { 0..0 } else { part(j, nx) }
        });
        let field = lattice.evaluate(&c);
        let row_of = |i: usize| (i % total / nx % ny, i % total / (nx * ny));
        let counts = |i: usize| row_of(i) != skipped && part(row_of(i).0, nx).contains(&(i % total % nx));
        let left: f64 = (0..3 * total).filter(|&i| counts(i)).map(|i| f64::from(field[i]) * f64::from(y[i])).sum();
        let right: f64 = f64s(&c).zip(f64s(&sums)).map(|(a, b)| a * b).sum();
        let scale = (f64s(&c).map(|v| v * v).sum::<f64>() * f64s(&sums).map(|v| v * v).sum::<f64>()).sqrt();
        assert!((left - right).abs() <= 1e-6 * scale, "{shape:?} step {step:?}: {left} is not {right}");
    }
}

#[test]
fn fitting_converges_with_the_fourth_order() {
    let shape = [65, 33, 1];
    let wave = |p: [f64; 3]| [(p[0] / 9.0).sin() * (p[1] / 8.0).cos(), (p[1] / 9.0 + 1.0).sin(), 0.0];
    let error = |step: usize| {
        let lattice = Lattice::new(shape, [step; 3]);
        let c = lattice.fit(|p| GridVector(wave(p.0)));
        voxels(shape)
            .map(|p| p.map(|v| v as f64))
            .map(|p| {
                let (GridVector(u), e) = (lattice.at(&c, VoxelPoint(p)), wave(p));
                (0..2).map(|a| (u[a] - e[a]).abs()).fold(0.0, f64::max)
            })
            .fold(0.0, f64::max)
    };
    let errors = [8, 4, 2].map(error);
    for pair in errors.windows(2) {
        let order = (pair[0] / pair[1]).log2();
        assert!((3.5..4.5).contains(&order), "order {order} from {errors:?}");
    }
}

#[test]
fn fitting_is_exact_for_cubics() {
    let shape = [33, 1, 1];
    let lattice = Lattice::new(shape, [4, 1, 1]);
    let cubic = |p: [f64; 3]| [1e-4 * (p[0] - 11.0).powi(3) - 0.01 * p[0] * p[0], 0.0, 0.0];
    let field = lattice.evaluate(&lattice.fit(|p| GridVector(cubic(p.0))));
    for i in 0..shape[0] {
        let exact = cubic([i as f64, 0.0, 0.0])[0];
        assert!((f64::from(field[i]) - exact).abs() < 1e-5, "voxel {i}: {} is not {exact}", field[i]);
    }
}

#[test]
fn lattices_give_the_same_bits_for_any_number_of_threads() {
    let lattice = Lattice::new([23, 19, 17], [4, 3, 5]);
    let c = normals(3 * lattice.len(), 9);
    let run = || {
        let field = lattice.evaluate(&c);
        let back = lattice.accumulate::<1>(|j, k, rows| {
            let from = 23 * (j + 19 * k);
            rows[0].copy_from_slice(&field[from..from + 23]);
            0..23
        });
        (field, back)
    };
    assert_eq!(with_threads(1, run), with_threads(3, run));
}

#[test]
fn smooth_sampling_at_voxels_is_the_filter() {
    for shape in [[9, 8, 7], [12, 5, 1], [6, 1, 1], [3, 2, 4]] {
        let data = normals(shape.iter().product(), 4);
        let filtered = filters::bspline(&data, shape);
        let sampler = SmoothSampler { data: &data, shape };
        for (i, p) in voxels(shape).enumerate() {
            let v = sampler.at(p.map(|v| v as f32));
            assert!((v - filtered[i]).abs() < 2e-6, "{shape:?} at {p:?}: {v} is not {}", filtered[i]);
        }
    }
}

#[test]
fn smooth_sampling_ends_half_a_voxel_outside() {
    let shape = [6, 5, 1];
    let data = vec![2.0; 30];
    let sampler = SmoothSampler { data: &data, shape };
    for p in [[-0.5, 0.0, 0.0], [5.5, 4.5, 0.5], [2.3, -0.5, -0.5], [5.49, 4.49, 0.2]] {
        assert!((sampler.at(p) - 2.0).abs() < 1e-5, "{p:?}");
    }
    for p in [[-0.51, 0.0, 0.0], [5.51, 0.0, 0.0], [0.0, 4.6, 0.0], [0.0, 0.0, 0.6], [f32::NAN, 0.0, 0.0]] {
        assert!(sampler.at(p).is_nan(), "{p:?}");
    }
}

/// A wave sampled with a shift looks like the filtered wave at the shifted place, for any fraction
/// of a voxel.
#[test]
fn smooth_sampling_does_not_depend_on_the_fraction() {
    let (shape, k) = ([40, 1, 1], std::f64::consts::TAU / 8.0);
    let wave = |x: f64| (k * x + 0.3).cos();
    // The kernel's transfer function at the frequency.
    let loss = (0.5 * k).sin().powi(4) / (0.5 * k).powi(4);
    for shift in [0.0, 0.13, 0.5, 0.77] {
        let data = sampled(shape, |p| wave(p[0] - shift));
        let sampler = SmoothSampler { data: &data, shape };
        for i in 5..34 {
            let v = f64::from(sampler.at([(f64::from(i) + shift) as f32, 0.0, 0.0]));
            let exact = loss * wave(f64::from(i));
            assert!((v - exact).abs() < 1.5e-3, "shift {shift}, voxel {i}: {v} is not {exact}");
        }
    }
}

// Smoothness

/// The energy straight from its definition.
fn energy(nodes: [usize; 3], h: [f64; 3], x: &[f64]) -> f64 {
    let at = |p: [usize; 3]| x[p[0] + nodes[0] * (p[1] + nodes[1] * p[2])];
    let ahead = |p: [usize; 3], a: usize, by: usize| -> Option<[usize; 3]> {
        (p[a] + by < nodes[a]).then(|| std::array::from_fn(|d| p[d] + if d == a { by } else { 0 }))
    };
    let mut sum = 0.0;
    for p in voxels(nodes) {
        for a in 0..3 {
            if let (Some(q), Some(r)) = (ahead(p, a, 1), ahead(p, a, 2)) {
                sum += ((at(p) - 2.0 * at(q) + at(r)) / (h[a] * h[a])).powi(2);
            }
            for b in 0..3 {
                if b == a {
                    continue;
                }
                if let (Some(q), Some(r)) = (ahead(p, a, 1), ahead(p, b, 1))
                    && let Some(s) = ahead(q, b, 1)
                {
                    sum += ((at(s) - at(q) - at(r) + at(p)) / (h[a] * h[b])).powi(2);
                }
            }
        }
    }
    sum
}

/// The energy's matrix by polarisation.
fn energy_matrix(nodes: [usize; 3], h: [f64; 3]) -> Dense {
    let n: usize = nodes.iter().product();
    let of = |i: usize, j: Option<usize>| {
        let mut x = vec![0.0; n];
        x[i] += 1.0;
        if let Some(j) = j {
            x[j] += 1.0;
        }
        energy(nodes, h, &x)
    };
    let single: Vec<f64> = (0..n).map(|i| of(i, None)).collect();
    (0..n).map(|i| (0..n).map(|j| 0.5 * (of(i, Some(j)) - single[i] - single[j])).collect()).collect()
}

const SMOOTHNESSES: [([usize; 3], [f64; 3]); 5] = [
    ([4, 5, 4], [1.0, 1.5, 2.0]),
    ([4, 4, 1], [2.0, 1.0, 1.0]),
    ([6, 1, 1], [0.5, 1.0, 1.0]),
    ([3, 2, 4], [1.0; 3]),
    ([11, 6, 3], [1.0, 2.0, 1.5]),
];

#[test]
fn the_smoothness_matrix_is_that_of_the_energy() {
    for (nodes, h) in SMOOTHNESSES {
        let smoothness = Smoothness::new(nodes, h);
        let n: usize = nodes.iter().product();
        let exact = energy_matrix(nodes, h);
        let top = exact.iter().flatten().fold(0.0f64, |m, v| m.max(v.abs()));
        let fast = dense(n, |x| {
            let mut out = vec![f32::NAN; n];
            smoothness.apply(&vec![1.0; n], x, &mut out);
            out
        });
        let diagonal = smoothness.diagonal(&vec![1.0; n]);
        for r in 0..n {
            for c in 0..n {
                assert!((fast[r][c] - exact[r][c]).abs() < 1e-6 * top, "{nodes:?} ({r}, {c})");
                assert!((fast[r][c] - fast[c][r]).abs() < 1e-6 * top, "not symmetric at ({r}, {c})");
            }
            assert!((f64::from(diagonal[r]) - exact[r][r]).abs() < 1e-6 * top, "{nodes:?} diagonal {r}");
        }
        for seed in 0..20 {
            let x = normals(3 * n, seed);
            let e = smoothness.energy(&x);
            let component = |c: usize| energy(nodes, h, &f64s(&x[c * n..(c + 1) * n]).collect::<Vec<_>>());
            for (c, e) in e.into_iter().enumerate() {
                let slow = component(c);
                assert!(e >= 0.0 && (e - slow).abs() < 1e-5 * slow, "{nodes:?}, component {c}: {e} is not {slow}");
            }
        }
    }
}

/// Weights that differ from node to node stand on the differences about each node: the matrix is
/// that of the weighted density.
#[test]
fn weights_by_place_make_the_matrix_of_the_weighted_density() {
    for (nodes, h) in SMOOTHNESSES {
        let smoothness = Smoothness::new(nodes, h);
        let n: usize = nodes.iter().product();
        let weight: Vec<f32> = normals(n, 31).iter().map(|v| 0.1 + v * v).collect();
        let diagonal = smoothness.diagonal(&weight);
        for seed in 0..5 {
            let (x, y) = (normals(n, seed), normals(n, 50 + seed));
            let (mut wx, mut wy) = (vec![f32::NAN; n], vec![f32::NAN; n]);
            smoothness.apply(&weight, &x, &mut wx);
            smoothness.apply(&weight, &y, &mut wy);
            let dot = |a: &[f32], b: &[f32]| f64s(a).zip(f64s(b)).map(|(a, b)| a * b).sum::<f64>();
            let density: f64 = f64s(&smoothness.density(&x)).zip(f64s(&weight)).map(|(e, w)| e * w).sum();
            let size = density.max(1e-3);
            assert!((dot(&x, &wx) - density).abs() < 1e-4 * size, "{nodes:?}: {} is not {density}", dot(&x, &wx));
            assert!((dot(&y, &wx) - dot(&x, &wy)).abs() < 1e-3 * size, "{nodes:?}: not symmetric");
        }
        for i in 0..n {
            let (unit, mut out): (Vec<f32>, _) = ((0..n).map(|j| f32::from(u8::from(i == j))).collect(), vec![0.0; n]);
            smoothness.apply(&weight, &unit, &mut out);
            assert!(
                (out[i] - diagonal[i]).abs() <= 1e-5 * diagonal[i].abs(),
                "{nodes:?}: {} is not {}",
                diagonal[i],
                out[i]
            );
        }
    }
}

/// One weight a component, at every node.
fn even(lambda: [f32; 3], n: usize) -> Vec<f32> {
    lambda.iter().flat_map(|l| vec![*l; n]).collect()
}

#[test]
fn affine_coefficients_cost_nothing_and_a_quadratic_its_curvature() {
    let (nodes, h) = ([7, 6, 5], [2.0, 1.0, 4.0]);
    let smoothness = Smoothness::new(nodes, h);
    let field = |f: &dyn Fn([f64; 3]) -> f64| {
        let one = sampled(nodes, |p| f(std::array::from_fn(|a| p[a] * h[a])));
        [one.clone(), one.clone(), one].concat()
    };
    let flat = field(&|p| 1.0 + 2.0 * p[0] - 3.0 * p[1] + 0.5 * p[2]);
    let each = |x: &[f32], expected: f64| {
        for e in smoothness.energy(x) {
            assert!((e - expected).abs() <= 1e-6 + 1e-3 * expected, "{e} is not {expected}");
        }
    };
    each(&flat, 0.0);
    // x^2: second derivative 2, on (7 - 2) * 6 * 5 places.
    each(&field(&|p| p[0] * p[0]), 4.0 * 150.0);
    // y z: mixed derivative 1, counted twice, on 7 * 5 * 4 places.
    each(&field(&|p| p[1] * p[2]), 2.0 * 140.0);
}

/// `D + lambda L` for planar vectors, a weight for each component.
fn system(smoothness: &Dense, lambda: [f32; 3], blocks: &[[f32; 6]]) -> Dense {
    let n = blocks.len();
    let mut m = vec![vec![0.0; 3 * n]; 3 * n];
    for a in 0..3 {
        for i in 0..n {
            for j in 0..n {
                m[a * n + i][a * n + j] += f64::from(lambda[a]) * smoothness[i][j];
            }
            for b in 0..3 {
                m[a * n + i][b * n + i] += entry(&blocks[i], a, b);
            }
        }
    }
    m
}

#[test]
fn solving_gives_the_dense_solution() {
    let (nodes, h, lambda) = ([4, 4, 4], [1.0, 2.0, 1.5], [0.7f32, 0.2, 3.0]);
    let smoothness = Smoothness::new(nodes, h);
    let n = 64;
    let mut blocks = random_blocks(n, 8);
    // Places without data: the energy alone carries them.
    for i in (0..n).step_by(3) {
        blocks[i] = [0.0; 6];
    }
    let b = normals(3 * n, 6);
    let inverse = invert(&system(&energy_matrix(nodes, h), lambda, &blocks));
    let exact: Vec<f64> = inverse.iter().map(|row| row.iter().zip(f64s(&b)).map(|(a, b)| a * b).sum()).collect();
    let top = exact.iter().fold(0.0f64, |m, v| m.max(v.abs()));
    let planar = Blocks::from(&blocks[..]);
    let weights = even(lambda, n);
    let run = || {
        let mut x = vec![0.0f32; 3 * n];
        let data = |x: &[f32], out: &mut [f32]| apply_blocks(&blocks, x, out);
        let matrix = Coupled::new(&smoothness, &weights, &planar, true);
        let report = matrix.solve_with(data, b.clone(), &mut x, 1e-7, 500);
        (x, report)
    };
    let (x, report) = run();
    assert!(report.residual <= 1e-7 && report.iterations < 500, "{report:?}");
    for (i, (x, e)) in f64s(&x).zip(&exact).enumerate() {
        assert!((x - e).abs() < 1e-5 * top, "{i}: {x} is not {e}");
    }
    assert_eq!(with_threads(1, run), with_threads(3, run));

    let mut x = vec![0.0f32; 3 * n];
    let report = Coupled::new(&smoothness, &weights, &planar, false).solve(b.clone(), &mut x, 1e-7, 2000);
    assert!(report.residual <= 1e-7, "{report:?}");
    for (i, (x, e)) in f64s(&x).zip(&exact).enumerate() {
        assert!((x - e).abs() < 1e-5 * top, "blocks alone, {i}: {x} is not {e}");
    }
}

#[test]
fn coarser_lattices_carry_sparse_data_in_few_iterations() {
    let nodes = [24, 22, 20];
    let n: usize = nodes.iter().product();
    let smoothness = Smoothness::new(nodes, [4.0; 3]);
    let mut blocks = vec![[0.0f32; 6]; n];
    let mut b = vec![0.0f32; 3 * n];
    for (i, v) in normals(n, 3).iter().enumerate().filter(|(i, _)| i % 97 == 0) {
        blocks[i] = [9.0, 9.0, 9.0, 0.0, 0.0, 0.0];
        (0..3).for_each(|c| b[c * n + i] = 9.0 * v);
    }
    let data = |x: &[f32], out: &mut [f32]| apply_blocks(&blocks, x, out);
    let planar = Blocks::from(&blocks[..]);
    let weights = even([1000.0; 3], n);
    let solved = |limit: usize, multilevel: bool| {
        let mut x = vec![0.0f32; 3 * n];
        let matrix = Coupled::new(&smoothness, &weights, &planar, multilevel);
        if multilevel {
            matrix.solve_with(data, b.clone(), &mut x, 1e-9, limit);
        } else {
            matrix.solve(b.clone(), &mut x, 1e-9, limit);
        }
        x
    };
    let exact = solved(2000, true);
    let norm = |v: &[f32]| f64s(v).map(|v| v * v).sum::<f64>().sqrt();
    let error = |x: Vec<f32>| norm(&x.iter().zip(&exact).map(|(a, b)| a - b).collect::<Vec<_>>()) / norm(&exact);
    let (few, many) = (error(solved(30, true)), error(solved(300, false)));
    assert!(few < 0.02 && few < 0.5 * many, "30 iterations leave {few}, 300 without coarser lattices {many}");
}

#[test]
fn a_row_is_sampled_as_its_places_are() {
    let shape = [37, 21, 18];
    let data = normals(shape.iter().product(), 4);
    let sampler = SmoothSampler { data: &data, shape };
    // Slow and fast displacements, some out of the volume.
    for scale in [0.0f32, 0.05, 0.7] {
        let d: [Vec<f32>; 3] =
            std::array::from_fn(|a| (0..37).map(|i| scale * 9.0 * ((i + 7 * a) as f32 * scale).sin() + 0.3).collect());
        for (j, k) in [(0, 0), (10, 9), (20, 17), (3, 16)] {
            let mut row = vec![0.0f32; 37];
            let start = [0.0, j as f32, k as f32];
            sampler.row(start, [&d[0], &d[1], &d[2]], [1.0; 3], [0.25, 0.0, -0.5], &mut row);
            for (i, v) in row.iter().enumerate() {
                let p = [i as f32 + d[0][i] - 0.25, start[1] + d[1][i], start[2] + d[2][i] + 0.5];
                let w = sampler.at(p);
                assert!((v - w).abs() < 1e-5 || (v.is_nan() && w.is_nan()), "{p:?}: {v} is not {w}");
            }
        }
    }
}

#[test]
fn a_solve_that_starts_at_the_solution_stays() {
    let smoothness = Smoothness::new([4, 4, 1], [1.0; 3]);
    let blocks = random_blocks(16, 2);
    let mut x = vec![0.0f32; 48];
    let data = |x: &[f32], out: &mut [f32]| apply_blocks(&blocks, x, out);
    let planar = Blocks::from(&blocks[..]);
    let report = Coupled::new(&smoothness, &[1.0; 48], &planar, true).solve_with(data, vec![0.0; 48], &mut x, 1e-6, 50);
    assert_eq!((report.iterations, report.residual), (0, 0.0));
    assert!(x.iter().all(|v| *v == 0.0));
}

#[test]
fn samples_scatter_with_the_matrix_of_the_energy() {
    let (nodes, h) = ([3, 3, 2], [1.0, 1.3, 0.9]);
    let smoothness = Smoothness::new(nodes, h);
    let exact = energy_matrix(nodes, h);
    let (n, draws) = (18, 20_000);
    let mut random = Random::new(11, 0);
    let mut sums = vec![vec![0.0; n]; n];
    for _ in 0..draws {
        let v = smoothness.sample(&[1.0; 18], &mut random);
        for i in 0..n {
            for j in 0..n {
                sums[i][j] += f64::from(v[i] * v[j]) / f64::from(draws);
            }
        }
    }
    for i in 0..n {
        for j in 0..n {
            let spread = ((exact[i][i] * exact[j][j] + exact[i][j].powi(2)) / f64::from(draws)).sqrt();
            let error = (sums[i][j] - exact[i][j]) / spread;
            assert!(error.abs() < 5.0, "({i}, {j}): {} is not {} ({error} sigma)", sums[i][j], exact[i][j]);
        }
    }
}

// Filters and pyramid

/// Full 3D convolution with repeated borders.
fn convolved(data: &[f32], shape: [usize; 3], kernels: [&[f32]; 3]) -> Vec<f32> {
    let reach: [i64; 3] = std::array::from_fn(|a| if shape[a] == 1 { 0 } else { kernels[a].len() as i64 - 1 });
    let weight = |a: usize, o: i64| if shape[a] == 1 { 1.0 } else { f64::from(kernels[a][o.unsigned_abs() as usize]) };
    voxels(shape)
        .map(|p| {
            let mut sum = 0.0;
            for c in -reach[2]..=reach[2] {
                for b in -reach[1]..=reach[1] {
                    for a in -reach[0]..=reach[0] {
                        let q: [usize; 3] = std::array::from_fn(|d| {
                            (p[d] as i64 + [a, b, c][d]).clamp(0, shape[d] as i64 - 1) as usize
                        });
                        let v = data[q[0] + shape[0] * (q[1] + shape[1] * q[2])];
                        sum += weight(0, a) * weight(1, b) * weight(2, c) * f64::from(v);
                    }
                }
            }
            sum as f32
        })
        .collect()
}

#[test]
fn separable_filters_are_full_convolutions() {
    let kernels = [vec![0.5, 0.3, -0.1], vec![0.4, 0.2, 0.1, 0.05], vec![0.6, 0.2]];
    for shape in [[9, 8, 7], [10, 9, 1], [2, 3, 4], [1, 6, 5], [7, 1, 3], [1, 1, 1]] {
        let data = normals(shape.iter().product(), 12);
        let fast = filters::separable(&data, shape, [&kernels[0], &kernels[1], &kernels[2]]);
        let slow = convolved(&data, shape, [&kernels[0], &kernels[1], &kernels[2]]);
        assert!(largest_difference(&fast, &slow) < 1e-5, "{shape:?}");
    }
}

#[test]
fn gaussian_kernels_have_unit_sum_and_their_variance() {
    for sigma in [0.7, 1.0, 1.5, 3.0] {
        let k = filters::gaussian_kernel(sigma);
        let sum = f64::from(k[0]) + 2.0 * f64s(&k[1..]).sum::<f64>();
        let variance = 2.0 * f64s(&k).enumerate().map(|(i, v)| v * (i * i) as f64).sum::<f64>();
        assert!((sum - 1.0).abs() < 1e-6, "{sum}");
        // Cut at 3 sigma: 2.7 % of the variance may be lost.
        assert!((0.96..1.01).contains(&(variance / (sigma * sigma))), "sigma {sigma}: variance {variance}");
    }
    assert_eq!(filters::gaussian_kernel(0.0), [1.0]);
    let k = filters::bspline_kernel();
    assert!((k[0] + 2.0 * k[1] - 1.0).abs() < 1e-7 && (2.0 * k[1] - 1.0 / 3.0).abs() < 1e-7);
}

#[test]
fn the_gradient_of_a_ramp_is_its_slope() {
    for shape in [[6, 5, 4], [5, 7, 1], [1, 4, 3], [2, 2, 2]] {
        let slope = [0.5, -2.0, 3.0];
        let data = sampled(shape, |p| (0..3).map(|a| slope[a] * p[a]).sum());
        for k in 0..shape[2] {
            for j in 0..shape[1] {
                let mut g: [Vec<f32>; 3] = std::array::from_fn(|_| vec![f32::NAN; shape[0]]);
                let [x, y, z] = &mut g;
                filters::gradient_rows(&data, shape, j, k, [x, y, z]);
                for (a, g) in g.iter().enumerate() {
                    let exact = if shape[a] == 1 { 0.0 } else { slope[a] as f32 };
                    assert!(g.iter().all(|v| *v == exact), "{shape:?} axis {a}: {g:?}");
                }
            }
        }
    }
}

#[test]
fn reduction_averages_blocks_and_what_is_left_of_them() {
    for (shape, factor) in
        [([9, 8, 7], [2, 3, 4]), ([5, 5, 1], [2, 2, 1]), ([6, 4, 2], [1, 1, 1]), ([3, 7, 5], [4, 2, 5])]
    {
        let data = normals(shape.iter().product(), 21);
        let fast = pyramid::reduce(&data, shape, factor);
        let small = pyramid::reduced_shape(shape, factor);
        let mut sums = vec![(0.0f64, 0.0f64); small.iter().product()];
        for (v, p) in f64s(&data).zip(voxels(shape)) {
            let q: [usize; 3] = std::array::from_fn(|a| p[a] / factor[a]);
            let s = &mut sums[q[0] + small[0] * (q[1] + small[1] * q[2])];
            *s = (s.0 + v, s.1 + 1.0);
        }
        let slow: Vec<f32> = sums.iter().map(|(s, n)| (s / n) as f32).collect();
        assert!(largest_difference(&fast, &slow) < 1e-6, "{shape:?} by {factor:?}");
    }
}

// Small algebra, order statistics, neighbours

#[test]
fn three_by_three_inverses_invert() {
    for m in random_blocks(200, 31).iter().map(|m| m.map(f64::from)) {
        let inverse = symmetric3::inverse(&m).unwrap();
        for c in 0..3 {
            let unit: [f64; 3] = std::array::from_fn(|a| f64::from(u8::from(a == c)));
            let back = symmetric3::multiply(&m, symmetric3::multiply(&inverse, unit));
            for a in 0..3 {
                assert!((back[a] - unit[a]).abs() < 1e-9, "{m:?}: {back:?}");
            }
            assert!((symmetric3::quadratic(&m, unit) - m[c]).abs() < 1e-12);
        }
    }
    assert_eq!(symmetric3::inverse(&[1.0, 1.0, 0.0, 0.0, 0.0, 0.0]), None);
    assert_eq!(symmetric3::inverse(&[1.0, 1.0, -1.0, 0.0, 0.0, 0.0]), None);
    assert_eq!(symmetric3::inverse(&[f64::NAN, 1.0, 1.0, 0.0, 0.0, 0.0]), None);
}

#[test]
fn cholesky_solves_and_refuses_what_is_not_positive() {
    let g = normals(25, 41);
    let a: [[f64; 5]; 5] = std::array::from_fn(|r| {
        std::array::from_fn(|c| {
            (0..5).map(|k| f64::from(g[5 * r + k]) * f64::from(g[5 * c + k])).sum::<f64>() + f64::from(u8::from(r == c))
        })
    });
    let x = [1.0, -2.0, 0.5, 3.0, -0.25];
    let b = std::array::from_fn(|r| (0..5).map(|c| a[r][c] * x[c]).sum());
    let found = symmetric3::cholesky_solve(a, b).unwrap();
    assert!((0..5).all(|i| (found[i] - x[i]).abs() < 1e-10), "{found:?}");
    assert_eq!(symmetric3::cholesky_solve([[1.0, 2.0], [2.0, 1.0]], [1.0, 1.0]), None);
    assert_eq!(symmetric3::cholesky_solve([[0.0]], [1.0]), None);
}

#[test]
fn quantiles_are_those_of_the_sorted_values() {
    let values = normals(101, 51);
    let mut sorted = values.clone();
    sorted.sort_by(f32::total_cmp);
    for q in [0.0, 0.02, 0.25, 0.5, 0.98, 1.0] {
        assert_eq!(statistics::quantile(&mut values.clone(), q), sorted[(q * 100.0f64).round() as usize]);
    }
    assert_eq!(statistics::median(&mut values.clone()), sorted[50]);
    assert!(statistics::quantile(&mut [], 0.5).is_nan());
    assert_eq!(statistics::percentile(&mut [4.0, 1.0, 3.0, 2.0], 50.0), 2.5);
    assert!((statistics::percentile(&mut [4.0, 1.0, 3.0, 2.0], 90.0) - 3.7).abs() < 1e-12);
}

#[test]
fn noise_is_told_from_structure() {
    for (shape, sigma) in [([48, 48, 48], 7.0), ([200, 180, 1], 3.0)] {
        let smooth =
            sampled(shape, |p| 300.0 * (p[0] / 9.0).sin() * (p[1] / 11.0).cos() * (1.0 + 0.3 * (p[2] / 8.0).sin()));
        let noise = normals(smooth.len(), 61);
        let data: Vec<f32> = smooth.iter().zip(&noise).map(|(s, n)| s + sigma * n).collect();
        let found = statistics::noise_sigma(&data, shape, |_| true);
        assert!((found / sigma - 1.0).abs() < 0.05, "{found} is not {sigma}");
        // Half of the volume is louder, but is not to be looked at.
        let half = data.len() / 2;
        let louder: Vec<f32> = data.iter().enumerate().map(|(i, v)| if i < half { 10.0 * v } else { *v }).collect();
        let keep = |i: usize| i > half + 2 * shape[0] * shape[1].min(half / shape[0] / 4);
        let found = statistics::noise_sigma(&louder, shape, keep);
        assert!((found / sigma - 1.0).abs() < 0.05, "{found} is not {sigma}");
    }
    assert_eq!(statistics::noise_sigma(&[1.0; 27], [3, 3, 3], |_| false), 0.0);
}

#[test]
fn neighbours_are_the_nearest() {
    let lattice: Vec<[f64; 3]> = voxels([6, 5, 4]).map(|p| p.map(|v| v as f64)).collect();
    let scattered: Vec<[f64; 3]> =
        normals(900, 71).chunks_exact(3).map(|c| [c[0], c[1], c[2]].map(f64::from)).collect();
    let square = |a: [f64; 3], b: [f64; 3]| (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f64>();
    for points in [&lattice, &scattered] {
        let tree = Neighbours::new(points);
        for at in [points[7], points[50], [2.5, 2.0, 1.5], [-0.3, 0.2, 9.0]] {
            let mut slow: Vec<(f64, usize)> = points.iter().enumerate().map(|(i, &p)| (square(p, at), i)).collect();
            slow.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            let all: Vec<usize> = slow.iter().map(|s| s.1).collect();
            assert_eq!(tree.within(at, f64::INFINITY, points.len()), all);
            let near = tree.within(at, 1.5, points.len());
            assert_eq!(near, slow.iter().filter(|s| s.0 <= 2.25).map(|s| s.1).collect::<Vec<_>>());
            // Of a tie at the cut either may stay: the distances are those of the nearest, and
            // nobody comes twice.
            let mut some = tree.within(at, f64::INFINITY, 13);
            let distances: Vec<f64> = some.iter().map(|&i| square(points[i], at)).collect();
            assert_eq!(distances, slow[..13].iter().map(|s| s.0).collect::<Vec<_>>());
            some.sort_unstable();
            some.dedup();
            assert_eq!(some.len(), 13);
        }
    }
}

#[test]
fn neighbours_of_awkward_points() {
    // Many points on one spot and many on one plane.
    let same = vec![[1.0, 2.0, 3.0]; 500];
    assert_eq!(Neighbours::new(&same).within([1.0, 2.0, 3.0], 0.1, 20).len(), 20);
    let plane: Vec<[f64; 3]> = voxels([40, 40, 1]).map(|p| p.map(|v| v as f64)).collect();
    assert_eq!(Neighbours::new(&plane).within([20.0, 20.0, 0.0], 1.0, 100).len(), 5);
    assert!(Neighbours::new(&[]).within([0.0; 3], 1.0, 5).is_empty());
    assert!(Neighbours::new(&same).within([f64::NAN, 0.0, 0.0], 1.0, 5).is_empty());
    assert!(Neighbours::new(&same).within([1.0, 2.0, 3.0], 1.0, 0).is_empty());
}

#[test]
fn random_numbers_are_normal_and_uniform() {
    let mut random = Random::new(1, 2);
    let draws: Vec<f64> = (0..50_000).flat_map(|_| random.normals()).collect();
    let n = draws.len() as f64;
    let moment = |p: i32| draws.iter().map(|v| v.powi(p)).sum::<f64>() / n;
    assert!(moment(1).abs() < 0.015 && (moment(2) - 1.0).abs() < 0.025 && (moment(4) - 3.0).abs() < 0.2);
    let (a, b) = (normals(5, 1), normals(5, 2));
    assert_eq!(a, normals(5, 1));
    assert_ne!(a, b);
}

/// Symmetric matrices (xx, yy, zz, xy, xz, yz) of three sizes, some diagonal or with eigenvalues
/// that are equal or nearly so.
fn symmetric_matrices() -> impl Iterator<Item = (f64, [f64; 6])> {
    let mut random = Random::new(3, 1);
    (0..3000).map(move |n| {
        let size = [1.0, 1e-8, 1e6][n % 3];
        let m: [f64; 6] = std::array::from_fn(|_| size * random.uniform(-1.0, 1.0));
        let m = match n % 7 {
            0 => [m[0], m[1], m[2], 0.0, 0.0, 0.0],
            1 => [m[0], m[0] * (1.0 + 1e-9), -m[0].abs(), 0.0, 1e-10 * m[4], 0.0],
            2 => [m[0], m[0], m[2], 0.0, 0.0, 0.0],
            3 => [m[0], m[0], m[0], 0.0, 0.0, 0.0],
            _ => m,
        };
        (size, m)
    })
}

#[test]
fn eigenvalues_agree_with_jacobi_rotations() {
    for (size, m) in symmetric_matrices() {
        let full = [[m[0], m[3], m[4]], [m[3], m[1], m[5]], [m[4], m[5], m[2]]];
        let truth = symmetric_eigen(&full).map(|p| p.0);
        let found = symmetric3::eigenvalues(&m);
        for k in 0..3 {
            assert!((found[k] - truth[2 - k]).abs() < 2e-7 * size, "{m:?}: {found:?} is not {truth:?}");
        }
    }
    assert_eq!(symmetric3::eigenvalues(&[2.0, 2.0, 2.0, 0.0, 0.0, 0.0]), [2.0; 3]);
    assert_eq!(symmetric3::eigenvalues(&[0.0; 6]), [0.0; 3]);
}

#[test]
fn the_principal_vector_is_that_of_the_largest_eigenvalue() {
    for (size, m) in symmetric_matrices() {
        let v = symmetric3::principal(&m);
        let norm = v.iter().map(|v| v * v).sum::<f64>();
        assert!((norm - 1.0).abs() < 1e-12, "{m:?}: {v:?}");
        // No unit vector has a larger quadratic form.
        let (most, found) = (symmetric3::eigenvalues(&m)[0], symmetric3::quadratic(&m, v));
        assert!((found - most).abs() < 2e-7 * size, "{m:?}: {found} is not {most}");
    }
}
