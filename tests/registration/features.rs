//! Corners against analytic volumes, closed forms and counts.

use crate::truth::{normals, sampled, voxels, with_threads};
use palpate::features::{Corner, HarrisParams, block_response, corners, response, spread};
use palpate::numerics::{filters, pyramid};

const CUBE: [usize; 3] = [32, 32, 32];
const MM: [f64; 3] = [1.0; 3];

fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

fn top(response: &[f32], shape: [usize; 3]) -> ([usize; 3], f32) {
    let best = (0..response.len()).max_by(|&a, &b| response[a].total_cmp(&response[b])).unwrap();
    (voxels(shape).nth(best).unwrap(), response[best])
}

/// A bright octant with its corner at `c` (voxels).
fn octant(shape: [usize; 3], c: [f64; 3]) -> Vec<f32> {
    sampled(shape, |p| 100.0 * (0..3).map(|a| sigmoid(2.0 * (p[a] - c[a]))).product::<f64>())
}

/// A Gaussian blob of `sigma` mm centred at `c` (voxels).
fn blob(shape: [usize; 3], spacing: [f64; 3], c: [f64; 3], sigma: f64) -> Vec<f32> {
    sampled(shape, |p| {
        let r2: f64 = (0..3).map(|a| ((p[a] - c[a]) * spacing[a]).powi(2)).sum();
        100.0 * (-0.5 * r2 / (sigma * sigma)).exp()
    })
}

#[test]
fn the_response_peaks_at_a_corner() {
    let c = [15.3, 16.0, 14.6];
    let r = response(&octant(CUBE, c), CUBE, MM, HarrisParams::default());
    let found = spread(&r, CUBE, MM, None, 1, 0.0);
    // The measure's top lies a little inside the bright octant, where the window holds all three
    // faces.
    for a in 0..3 {
        assert!((0.0..2.0).contains(&(found[0].voxel.0[a] - c[a])), "{found:?}");
    }
    // The three axes are alike: the corner is off by the same along each.
    let off: Vec<f64> = (0..3).map(|a| found[0].voxel.0[a] - c[a]).collect();
    assert!((off[0] - off[1]).abs() < 0.15 && (off[0] - off[2]).abs() < 0.15, "{off:?}");
}

#[test]
fn planes_and_edges_do_not_answer() {
    let corner = top(&response(&octant(CUBE, [16.0; 3]), CUBE, MM, HarrisParams::default()), CUBE).1;
    let plane = sampled(CUBE, |p| 100.0 * sigmoid(0.8 * (0.6 * p[0] - 0.48 * p[1] + 0.64 * p[2] - 12.0)));
    let edge = sampled(CUBE, |p| 100.0 * sigmoid(2.0 * (p[0] - 15.7)) * sigmoid(2.0 * (p[1] - 16.2)));
    // A slanted plane on a lattice has a little texture along itself.
    for (data, most) in [(plane, 1e-2), (edge, 1e-6)] {
        let r = response(&data, CUBE, MM, HarrisParams::default());
        let worst = top(&r, CUBE).1 / corner;
        assert!(worst < most, "{worst} of a corner's response");
        assert!(r.iter().all(|v| *v >= 0.0));
    }
}

/// Foerstner's measure straight from its definition, in double precision.
fn slow(data: &[f32], shape: [usize; 3], spacing: [f64; 3], params: HarrisParams) -> Vec<f64> {
    let thick: Vec<usize> = (0..3).filter(|&a| shape[a] > 1).collect();
    let finest = thick.iter().map(|&a| spacing[a]).fold(f64::INFINITY, f64::min);
    let sigma = |s: f64| spacing.map(|v| s * finest / v);
    let smooth = filters::gaussian(data, shape, sigma(params.derivative_sigma));
    let stride = [1, shape[0], shape[0] * shape[1]];
    let derivative = |a: usize| -> Vec<f64> {
        voxels(shape)
            .enumerate()
            .map(|(i, p)| {
                let (lo, hi) = (p[a].saturating_sub(1), (p[a] + 1).min(shape[a] - 1));
                let at = |q: usize| f64::from(smooth[i + q * stride[a] - p[a] * stride[a]]);
                (at(hi) - at(lo)) / ((hi - lo) as f64 * spacing[a])
            })
            .collect()
    };
    let g: Vec<Vec<f64>> = thick.iter().map(|&a| derivative(a)).collect();
    let m: Vec<Vec<Vec<f32>>> = g
        .iter()
        .map(|x| {
            let product = |y: &Vec<f64>| x.iter().zip(y).map(|(x, y)| (x * y) as f32).collect::<Vec<f32>>();
            g.iter().map(|y| filters::gaussian(&product(y), shape, sigma(params.integration_sigma))).collect()
        })
        .collect();
    (0..data.len())
        .map(|i| {
            let dense: crate::truth::Dense = m.iter().map(|r| r.iter().map(|v| f64::from(v[i])).collect()).collect();
            1.0 / crate::truth::invert(&dense).iter().enumerate().map(|(a, row)| row[a]).sum::<f64>()
        })
        .collect()
}

#[test]
fn the_response_is_its_definition() {
    // More than two slabs of slices, one slice in any plane, thick slices.
    let cases = [
        ([9, 10, 55], [1.0, 1.0, 1.0]),
        ([12, 11, 8], [0.8, 1.0, 2.5]),
        ([20, 15, 1], [0.7, 1.1, 5.0]),
        ([1, 14, 13], [3.0, 1.0, 1.2]),
    ];
    for (shape, spacing) in cases {
        let data: Vec<f32> = normals(shape.iter().product(), 3).iter().map(|v| 200.0 + 20.0 * v).collect();
        let fast = response(&data, shape, spacing, HarrisParams::default());
        let exact = slow(&data, shape, spacing, HarrisParams::default());
        for (i, (f, e)) in fast.iter().zip(&exact).enumerate() {
            assert!((f64::from(*f) - e).abs() < 2e-3 * e, "{shape:?} voxel {i}: {f} is not {e}");
        }
    }
}

#[test]
fn the_response_counts_in_millimetres() {
    // The same blob on cubes and on thick slices; a window that holds all of it.
    let params = HarrisParams { derivative_sigma: 1.0, integration_sigma: 4.0 };
    let at = |shape: [usize; 3], spacing: [f64; 3]| {
        let c = shape.map(|n| (n / 2) as f64);
        let r = response(&blob(shape, spacing, c, 3.0), shape, spacing, params);
        let (place, value) = top(&r, shape);
        assert_eq!(place, shape.map(|n| n / 2), "the top of a blob is its centre");
        value
    };
    let cubes = at([41, 41, 41], [1.0, 1.0, 1.0]);
    let slices = at([41, 41, 21], [1.0, 1.0, 2.0]);
    let sagittal = at([21, 41, 41], [2.0, 1.0, 1.0]);
    assert!((slices / cubes - 1.0).abs() < 0.1, "{slices} and {cubes}");
    assert!((sagittal / slices - 1.0).abs() < 1e-3, "{sagittal} and {slices}");
    // Twice the voxel at twice the size of everything: gradients a mm are halved, the measure goes
    // with their square.
    let shape = [41, 41, 41];
    let double = response(&blob(shape, [2.0; 3], [20.0; 3], 6.0), shape, [2.0; 3], params);
    assert!((4.0 * top(&double, shape).1 / cubes - 1.0).abs() < 1e-3);
}

#[test]
fn places_are_sub_voxel() {
    for c in [[15.3, 16.45, 14.8], [16.0, 15.5, 15.25], [14.9, 16.1, 15.7]] {
        let r = response(&blob(CUBE, MM, c, 1.5), CUBE, MM, HarrisParams::default());
        let found = spread(&r, CUBE, MM, None, 1, 0.0);
        for a in 0..3 {
            assert!((found[0].voxel.0[a] - c[a]).abs() < 0.1, "{:?} is not {c:?}", found[0].voxel);
        }
    }
}

/// Maxima at every fourth voxel, no two equal, a hundred times stronger in one octant.
fn crowded() -> Vec<f32> {
    let mut r = vec![0.0; 32 * 32 * 32];
    for (i, p) in voxels(CUBE).enumerate() {
        if p.iter().all(|v| v % 4 == 2) {
            r[i] = (1.0 + i as f32 * 1e-5) * if p.iter().all(|v| *v < 16) { 100.0 } else { 1.0 };
        }
    }
    r
}

fn counts(corners: &[Corner]) -> [usize; 64] {
    let mut counts = [0; 64];
    for c in corners {
        let [i, j, k] = c.centre.map(|v| v / 8);
        counts[i + 4 * (j + 4 * k)] += 1;
    }
    counts
}

#[test]
fn places_spread_evenly_whatever_their_strength() {
    let r = crowded();
    for (wanted, each) in [(64, 1), (512, 8)] {
        let found = spread(&r, CUBE, MM, None, wanted, 0.0);
        assert_eq!(found.len(), wanted);
        assert_eq!(counts(&found), [each; 64]);
    }
    // Of each cell the strongest.
    let found = spread(&r, CUBE, MM, None, 64, 0.0);
    assert!(found.iter().all(|c| c.centre.iter().all(|v| v % 8 == 6)), "{found:?}");
}

#[test]
fn places_keep_to_the_mask_the_threshold_and_the_number() {
    let r = crowded();
    let mask: Vec<u8> = voxels(CUBE).map(|p| u8::from(p[0] >= 16)).collect();
    let found = spread(&r, CUBE, MM, Some(&mask), 1000, 0.0);
    assert_eq!(found.len(), 256);
    assert!(found.iter().all(|c| c.centre[0] >= 16));
    assert_eq!(spread(&r, CUBE, MM, None, 1000, 50.0).len(), 64);
    assert_eq!(spread(&r, CUBE, MM, None, 10, 0.0).len(), 10);
    assert!(spread(&r, CUBE, MM, Some(&vec![0; r.len()]), 10, 0.0).is_empty());
    assert!(spread(&r, CUBE, MM, None, 0, 0.0).is_empty());
}

#[test]
fn found_places_are_maxima_and_a_plateau_counts_once() {
    let shape = [14, 13, 12];
    let r: Vec<f32> = normals(shape.iter().product(), 9).iter().map(|v| v.abs()).collect();
    let found = spread(&r, shape, MM, None, usize::MAX / 2, 0.0);
    let inner = |p: &[usize; 3]| (0..3).all(|a| p[a] > 0 && p[a] + 1 < shape[a]);
    let value = |p: [usize; 3]| r[p[0] + 14 * (p[1] + 13 * p[2])];
    let slow = voxels(shape).filter(inner).filter(|&p| {
        voxels([3, 3, 3]).all(|o| o == [1, 1, 1] || value(std::array::from_fn(|a| p[a] + o[a] - 1)) < value(p))
    });
    let mut centres: Vec<[usize; 3]> = found.iter().map(|c| c.centre).collect();
    let mut slow: Vec<[usize; 3]> = slow.collect();
    centres.sort_unstable();
    slow.sort_unstable();
    assert_eq!(centres, slow);
    for c in &found {
        assert!((0..3).all(|a| (c.voxel.0[a] - c.centre[a] as f64).abs() <= 0.5) && c.response == value(c.centre));
    }
    let mut flat = vec![0.0; 14 * 13 * 12];
    for i in [500, 501, 514, 515] {
        flat[i] = 2.0;
    }
    assert_eq!(spread(&flat, shape, MM, None, 10, 0.0).len(), 1);
}

/// Corners are sought some slices at a time, so that the response of a large volume is never held.
#[test]
fn corners_by_slabs_are_those_of_the_whole_response() {
    let spacing = [1.0, 1.1, 1.3];
    for (deep, step) in [(1, [1; 3]), (3, [1; 3]), (23, [1; 3]), (24, [1; 3]), (25, [1; 3]), (49, [1; 3]), (97, [2; 3])]
    {
        let shape = [21, 18, deep];
        let data = filters::bspline(&normals(shape.iter().product(), 5 + deep as u64), shape);
        let blocks = pyramid::reduced_shape(shape, step);
        let mask: Vec<u8> = voxels(blocks).map(|p| u8::from(p[0] > 4)).collect();
        let r = block_response(&data, shape, spacing, 1.0, step);
        let edges = std::array::from_fn(|a| spacing[a] * step[a] as f64);
        for (mask, wanted) in [(None, 60), (Some(&mask[..]), 100_000)] {
            let whole = spread(&r, blocks, edges, mask, wanted, 1e-3);
            assert!(deep == 3 || whole.len() > if deep == 1 { 2 } else { 20 }, "{deep} slices: {}", whole.len());
            assert_eq!(corners(&data, (shape, spacing), (1.0, step), mask, wanted, 1e-3), whole, "{deep} slices");
        }
    }
}

#[test]
fn a_constant_volume_has_no_features() {
    for shape in [[16, 15, 14], [20, 20, 1]] {
        let data = vec![731.3; shape.iter().product()];
        let r = response(&data, shape, [0.9, 1.0, 1.3], HarrisParams::default());
        assert!(r.iter().all(|v| *v == 0.0));
        assert!(spread(&r, shape, MM, None, 100, 0.0).is_empty());
    }
}

#[test]
fn features_do_not_depend_on_threads() {
    let shape = [20, 18, 51];
    let data = normals(shape.iter().product(), 77);
    let run = || {
        let r = response(&data, shape, [1.0, 1.0, 1.5], HarrisParams::default());
        let found = spread(&r, shape, [1.0, 1.0, 1.5], None, 200, 0.0);
        (r, found)
    };
    assert_eq!(with_threads(1, run), with_threads(3, run));
}
