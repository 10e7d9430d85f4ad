//! Matching against brute force, known motions and finite differences.

use crate::truth::{Waves, entry, normals, sampled, voxels, with_threads};
use palpate::error::FieldError;
use palpate::features::{HarrisParams, response, spread};
use palpate::matching::brightness::Brightness;
use palpate::matching::candidates::{CandidateParams, Side, candidates};
use palpate::matching::correlation::Searchable;
use palpate::matching::gain::GainField;
use palpate::matching::least_squares_matching::{self, Template};
use palpate::matching::levels::{Aligned, factors, from_level, to_level};
use palpate::matching::pair::{Pair, Spans, dilate, row_step};
use palpate::matching::residual::{normal_equations, residual_sigma};
use palpate::numerics::block_diagonal::Blocks;
use palpate::numerics::bspline::{Lattice, SmoothSampler};
use palpate::numerics::filters;
use palpate::numerics::symmetric3::{inverse, quadratic};
use palpate::types::{Affine, Candidate, Grid, Mask, Volume, VoxelPoint, WorldPoint};

/// Both volumes from functions of world position, on grids given by shape and affine rows.
fn aligned(
    initial: (Grid, &dyn Fn(WorldPoint) -> f64),
    deformed: (Grid, &dyn Fn(WorldPoint) -> f64),
) -> Result<Aligned<'static>, FieldError> {
    let volume = |(grid, f): (Grid, &dyn Fn(WorldPoint) -> f64)| {
        let values = voxels(grid.shape()).map(|[i, j, k]| f(grid.world(i, j, k)) as f32).collect();
        Volume::from_vec(grid, values).unwrap()
    };
    let (i, d) = (volume(initial), volume(deformed));
    Ok(Aligned::new(&i, &d, &Mask::filled(initial.0, 1), 10.0)?.into_owned())
}

fn grid(shape: [usize; 3], rows: [[f64; 4]; 3]) -> Grid {
    Grid::new(shape, Affine::new(rows).unwrap()).unwrap()
}

fn plain(shape: [usize; 3], spacing: [f64; 3]) -> Grid {
    let [x, y, z] = spacing;
    grid(shape, [[x, 0.0, 0.0, 0.0], [0.0, y, 0.0, 0.0], [0.0, 0.0, z, 0.0]])
}

/// A pair on one grid from voxel values.
fn pair(shape: [usize; 3], spacing: [f64; 3], fixed: &[f32], moving: &[f32]) -> Pair<'static> {
    let grid = plain(shape, spacing);
    let volume = |v: &[f32]| Volume::from_vec(grid, v.to_vec()).unwrap();
    let (fixed, moving, mask) = (volume(fixed), volume(moving), Mask::filled(grid, 1));
    Aligned::new(&fixed, &moving, &mask, 10.0).unwrap().level([1; 3]).into_owned()
}

/// The deformed volume as the initial lattice sees it, without motion.
fn unmoved(pair: &Pair<'_>) -> Vec<f32> {
    let lattice = Lattice::new(pair.shape, [4; 3]);
    pair.warp(&lattice, &vec![0.0; 3 * lattice.len()], &Spans::new(&vec![1; pair.fixed.len()], pair.shape))
}

// Correlation

/// The patch around `c`, or none where it leaves the volume.
fn patch(data: &[f32], shape: [usize; 3], c: [i64; 3], r: [usize; 3]) -> Option<Vec<f64>> {
    if (0..3).any(|a| c[a] < r[a] as i64 || c[a] + r[a] as i64 >= shape[a] as i64) {
        return None;
    }
    let size = r.map(|r| 2 * r + 1);
    let at = |o: [usize; 3]| {
        let p: [usize; 3] = std::array::from_fn(|a| c[a] as usize + o[a] - r[a]);
        f64::from(data[p[0] + shape[0] * (p[1] + shape[1] * p[2])])
    };
    Some(voxels(size).map(at).collect())
}

/// Normalised cross-correlation of two patches; NaN where one is constant or holds NaN.
fn ncc(a: &[f64], b: &[f64]) -> f64 {
    let free = |v: &[f64]| {
        let mean = v.iter().sum::<f64>() / v.len() as f64;
        v.iter().map(|x| x - mean).collect::<Vec<f64>>()
    };
    let (a, b) = (free(a), free(b));
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
    dot(&a, &b) / (dot(&a, &a) * dot(&b, &b)).sqrt()
}

#[test]
fn correlation_is_its_definition_at_every_shift() {
    for (shape, r) in [([11, 10, 9], [2, 1, 1]), ([14, 13, 1], [2, 2, 2])] {
        let n: usize = shape.iter().product();
        let (fixed, mut moving) = (normals(n, 1), normals(n, 2));
        moving[n / 2] = f32::NAN;
        let flat: [usize; 3] = std::array::from_fn(|a| if shape[a] == 1 { 0 } else { r[a] });
        let (here, there) = (Searchable::new(&fixed, shape, r), Searchable::new(&moving, shape, r));
        for centre in voxels(shape).step_by(7) {
            let c = centre.map(|v| v as i64);
            let (Some(template), Some(a)) = (here.template(centre), patch(&fixed, shape, c, flat)) else {
                assert!(here.template(centre).is_none() && patch(&fixed, shape, c, flat).is_none());
                continue;
            };
            for to in voxels(shape).map(|p| p.map(|v| v as i64)) {
                let slow = patch(&moving, shape, to, flat).map(|b| ncc(&a, &b)).filter(|v| v.is_finite());
                let fast = there.ncc(&template, to);
                assert_eq!(fast.is_some(), slow.is_some(), "{shape:?} at {to:?}");
                if let (Some(f), Some(s)) = (fast, slow) {
                    assert!((f64::from(f) - s).abs() < 1e-5, "{f} is not {s}");
                }
            }
        }
        assert_eq!(there.ncc(&here.template(shape.map(|n| n / 2)).unwrap(), [-5, 100, 0]), None);
    }
}

#[test]
fn the_search_finds_the_best_local_maxima() {
    let (shape, r, reach) = ([13, 12, 11], [1, 1, 1], [4, 3, 2]);
    let n: usize = shape.iter().product();
    let (fixed, moving) = (normals(n, 3), normals(n, 4));
    let (here, there) = (Searchable::new(&fixed, shape, r), Searchable::new(&moving, shape, r));
    for centre in [[6, 6, 5], [1, 1, 1], [11, 10, 9], [3, 9, 2]] {
        let template = here.template(centre).unwrap();
        let a = patch(&fixed, shape, centre.map(|v| v as i64), r).unwrap();
        let score = |o: [i64; 3]| -> Option<f64> {
            if (0..3).any(|d| o[d].unsigned_abs() as usize > reach[d]) {
                return None;
            }
            patch(&moving, shape, std::array::from_fn(|d| centre[d] as i64 + o[d]), r).map(|b| ncc(&a, &b))
        };
        let mut slow: Vec<([i64; 3], f64)> = voxels(reach.map(|r| 2 * r + 1))
            .map(|p| std::array::from_fn(|d| p[d] as i64 - reach[d] as i64))
            .filter_map(|o| Some((o, score(o)?)))
            .filter(|&(o, s)| {
                let near = |q: [usize; 3]| score(std::array::from_fn(|d| o[d] + q[d] as i64 - 1));
                voxels([3, 3, 3]).filter(|q| *q != [1, 1, 1]).all(|q| near(q).is_none_or(|v| v < s))
            })
            .collect();
        slow.sort_by(|a, b| b.1.total_cmp(&a.1));
        let fast = there.search(&template, centre.map(|v| v as i64), reach, 1000);
        assert_eq!(
            fast.iter().map(|p| p.offset.map(i64::from)).collect::<Vec<_>>(),
            slow.iter().map(|s| s.0).collect::<Vec<_>>()
        );
        assert!(fast.iter().zip(&slow).all(|(f, s)| (f64::from(f.ncc) - s.1).abs() < 1e-5));
        assert_eq!(there.search(&template, centre.map(|v| v as i64), reach, 3), fast[..3.min(fast.len())]);
    }
}

/// A long search looks at every second row first; what fits best of all must not slip through.
#[test]
fn a_long_search_finds_the_best_place_of_all() {
    let (shape, r, reach) = ([34, 30, 28], [2, 2, 2], [9, 8, 7]);
    let (fixed, mut moving) = shifted(shape);
    for (v, noise) in moving.iter_mut().zip(normals(fixed.len(), 11)) {
        *v += 0.1 * noise;
    }
    let (here, there) = (Searchable::new(&fixed, shape, r), Searchable::new(&moving, shape, r));
    let centres = voxels([4, 3, 3]).map(|p| [4 + 8 * p[0], 4 + 10 * p[1], 4 + 9 * p[2]]);
    for centre in centres.chain([[31, 27, 25], [2, 2, 2]]) {
        let c = centre.map(|v| v as i64);
        let a = patch(&fixed, shape, c, r).unwrap();
        let score = |o: [i64; 3]| patch(&moving, shape, std::array::from_fn(|d| c[d] + o[d]), r).map(|b| ncc(&a, &b));
        let best = voxels(reach.map(|r| 2 * r + 1))
            .map(|p| std::array::from_fn(|d| p[d] as i64 - reach[d] as i64))
            .filter_map(|o| Some((o, score(o)?)))
            .max_by(|a, b| a.1.total_cmp(&b.1))
            .unwrap();
        let found = there.search(&here.template(centre).unwrap(), c, reach, 4);
        assert_eq!(found[0].offset.map(i64::from), best.0, "{centre:?}");
        for (at, peak) in found.iter().enumerate() {
            let slow = score(peak.offset.map(i64::from)).unwrap();
            assert!((f64::from(peak.ncc) - slow).abs() < 1e-5, "{centre:?}: {} is not {slow}", peak.ncc);
            assert!(found[..at].iter().all(|f| f.offset != peak.offset && f.ncc >= peak.ncc));
        }
    }
}

#[test]
fn correlation_does_not_see_gain_and_offset() {
    let shape = [12, 12, 12];
    let data = normals(1728, 5);
    let changed: Vec<f32> = data.iter().map(|v| 37.0 * v + 900.0).collect();
    let (here, there) = (Searchable::new(&data, shape, [2; 3]), Searchable::new(&changed, shape, [2; 3]));
    let template = here.template([6, 5, 6]).unwrap();
    let best = there.search(&template, [6, 5, 6], [3; 3], 1)[0];
    assert_eq!(best.offset, [0; 3]);
    assert!((best.ncc - 1.0).abs() < 1e-4, "{}", best.ncc);
    let inverted: Vec<f32> = data.iter().map(|v| -2.0 * v).collect();
    let found = Searchable::new(&inverted, shape, [2; 3]).ncc(&template, [6, 5, 6]).unwrap();
    assert!((found + 1.0).abs() < 1e-4, "{found}");
    assert!(Searchable::new(&[5.0; 1728], shape, [2; 3]).template([6, 5, 6]).is_none());
}

// Candidates

const REACH: CandidateParams = CandidateParams { reach_mm: 9.0, keep: 6, partners: 16, min_ncc: 0.3 };

/// Texture, and the same moved by (3, -2, 1) voxels.
fn shifted(shape: [usize; 3]) -> (Vec<f32>, Vec<f32>) {
    let wide = shape.map(|n| n + 8);
    let data = filters::gaussian(&normals(wide.iter().product(), 6), wide, [0.8; 3]);
    let cut = |o: [usize; 3]| {
        voxels(shape)
            .map(|p| data[p[0] + o[0] + wide[0] * (p[1] + o[1] + wide[1] * (p[2] + o[2]))])
            .collect::<Vec<f32>>()
    };
    (cut([4, 4, 4]), cut([1, 6, 3]))
}

fn corners(data: &[f32], shape: [usize; 3], spacing: [f64; 3], wanted: usize) -> Vec<VoxelPoint> {
    let r = response(data, shape, spacing, HarrisParams::default());
    spread(&r, shape, spacing, None, wanted, 0.0).iter().map(|c| c.voxel).collect()
}

fn right(c: &Candidate, spacing: [f64; 3]) -> bool {
    (0..3).all(|a| (c.displacement.0[a] - [3.0, -2.0, 1.0][a] * spacing[a]).abs() < 0.6 * spacing[a])
}

#[test]
fn candidates_hold_the_motion() {
    let (shape, spacing) = ([30, 28, 26], [1.0, 1.2, 2.0]);
    let (fixed, moving) = shifted(shape);
    let (a, b) = (corners(&fixed, shape, spacing, 150), corners(&moving, shape, spacing, 400));
    let (here, there) = (Searchable::new(&fixed, shape, [3; 3]), Searchable::new(&moving, shape, [3; 3]));
    let list = || {
        candidates(
            &Side { volume: &here, origin: [0.0; 3], features: &a },
            &Side { volume: &there, origin: [0.0; 3], features: &b },
            spacing,
            REACH,
        )
    };
    let lists = list();
    assert_eq!(lists.len(), a.len());
    let mut seen = 0;
    for (p, list) in a.iter().zip(&lists) {
        assert!(list.len() <= 2 * REACH.keep && list.windows(2).all(|w| w[0].ncc >= w[1].ncc));
        assert!(list.iter().all(|c| c.ncc >= REACH.min_ncc));
        // Places whose patch and whose partner's patch lie inside.
        let q: [f64; 3] = std::array::from_fn(|d| p.0[d] + [3.0, -2.0, 1.0][d]);
        let fits = |p: &[f64; 3]| (0..3).all(|d| p[d] >= 4.0 && p[d] <= shape[d] as f64 - 5.0);
        if fits(&p.0) && fits(&q) {
            seen += 1;
            assert!(right(&list[0], spacing) && list[0].ncc > 0.99, "{p:?}: {:?}", list[0]);
        }
        for (i, x) in list.iter().enumerate() {
            let twin =
                |y: &Candidate| (0..3).all(|d| (x.displacement.0[d] - y.displacement.0[d]).abs() < 0.9 * spacing[d]);
            assert!(!list[..i].iter().any(twin), "the same place twice: {list:?}");
        }
    }
    assert!(seen > 20, "{seen}");
    let many = lists.iter().filter(|l| l.len() > 1).count();
    assert!(many * 2 > lists.len(), "{many} of {} places have more than one candidate", lists.len());
    assert_eq!(lists, with_threads(1, list));
}

#[test]
fn candidates_know_where_the_volumes_start() {
    // The deformed volume starts at voxel (5, 3, 2) of the initial lattice.
    let (shape, spacing) = ([30, 28, 26], [1.0; 3]);
    let (fixed, moving) = shifted(shape);
    let (small, start) = ([22, 21, 20], [5, 3, 2]);
    let cut: Vec<f32> =
        voxels(small).map(|p| moving[p[0] + start[0] + 30 * (p[1] + start[1] + 28 * (p[2] + start[2]))]).collect();
    let (here, there) = (Searchable::new(&fixed, shape, [3; 3]), Searchable::new(&cut, small, [3; 3]));
    let a = [VoxelPoint([13.0, 14.0, 12.0]), VoxelPoint([14.3, 13.6, 11.2])];
    let b = corners(&cut, small, spacing, 100);
    let origin = start.map(|v| v as f64);
    let lists = candidates(
        &Side { volume: &here, origin: [0.0; 3], features: &a },
        &Side { volume: &there, origin, features: &b },
        spacing,
        REACH,
    );
    for list in &lists {
        assert!(right(&list[0], spacing) && list[0].ncc > 0.99, "{list:?}");
    }
}

#[test]
fn either_side_alone_finds_the_motion() {
    let (shape, spacing) = ([30, 28, 26], [1.0; 3]);
    let (fixed, moving) = shifted(shape);
    let (here, there) = (Searchable::new(&fixed, shape, [3; 3]), Searchable::new(&moving, shape, [3; 3]));
    let find = |a: &[VoxelPoint], b: &[VoxelPoint]| {
        let side = |volume, features| Side { volume, origin: [0.0; 3], features };
        candidates(&side(&here, a), &side(&there, b), spacing, REACH)
    };
    // No feature in the deformed volume: search alone.
    let list = &find(&[VoxelPoint([14.0, 14.0, 12.0])], &[])[0];
    assert!(right(&list[0], spacing), "{list:?}");
    // No patch around the initial feature (at the border): the deformed feature is found back
    // beside it.
    let list = &find(&[VoxelPoint([2.0, 14.0, 12.0])], &[VoxelPoint([6.0, 12.0, 13.0])])[0];
    assert!(right(&list[0], spacing), "{list:?}");
}

// Least-squares matching

const D: [f64; 3] = [0.37, -0.21, 0.44];

/// A band-limited texture, and the same moved by `D` voxels, of standard deviation 100 about 500.
fn texture(shape: [usize; 3], shortest: f64, seed: u64) -> (Vec<f32>, Vec<f32>) {
    let waves = Waves::new(60, shortest, 3.0 * shortest, seed);
    let fixed = sampled(shape, |p| 500.0 + 100.0 * waves.at(p));
    let moving = sampled(shape, |p| 500.0 + 100.0 * waves.at(std::array::from_fn(|a| p[a] - D[a])));
    (fixed, moving)
}

#[test]
fn least_squares_matching_is_sub_voxel() {
    let (shape, spacing) = ([26, 25, 24], [0.8, 1.0, 1.5]);
    let (fixed, moving) = texture(shape, 8.0, 1);
    let smooth = filters::bspline(&fixed, shape);
    // Another gain and offset must not matter.
    let moving: Vec<f32> = moving.iter().map(|v| 0.4 * v + 70.0).collect();
    let sampler = SmoothSampler { data: &moving, shape };
    let template = Template { data: &smooth, shape, spacing, radius: [3; 3], noise: 0.0 };
    for centre in voxels([3, 3, 3]).map(|p| p.map(|v| 8 + 4 * v)) {
        let sample = |o: [f32; 3]| sampler.at(std::array::from_fn(|a| centre[a] as f32 + o[a]));
        let found = least_squares_matching::refine(
            &template,
            centre,
            least_squares_matching::pointwise([3; 3], sample),
            12,
            2.0,
        )
        .unwrap();
        for a in 0..3 {
            let error = found.shift.0[a] / spacing[a] - D[a];
            assert!(error.abs() < 0.02, "{centre:?} axis {a}: {error} voxels");
        }
        assert!(found.ncc > 0.999, "{}", found.ncc);
    }
}

#[test]
fn least_squares_matching_refuses_what_it_cannot_measure() {
    let shape = [20, 20, 20];
    let (fixed, moving) = texture(shape, 8.0, 2);
    let smooth = filters::bspline(&fixed, shape);
    let sampler = SmoothSampler { data: &moving, shape };
    let refine = |data: &[f32], centre: [usize; 3], limit: f64| {
        let template = Template { data, shape, spacing: [1.0; 3], radius: [3; 3], noise: 1.0 };
        let sample = |o: [f32; 3]| sampler.at(std::array::from_fn(|a| centre[a] as f32 + o[a]));
        least_squares_matching::refine(&template, centre, least_squares_matching::pointwise([3; 3], sample), 6, limit)
    };
    assert!(refine(&smooth, [10; 3], 2.0).is_some());
    assert!(refine(&smooth, [10; 3], 0.1).is_none(), "further than the limit");
    assert!(refine(&smooth, [3, 10, 10], 2.0).is_none(), "at the border");
    let plane = sampled(shape, |p| 100.0 * (p[0] / 3.0).sin());
    assert!(refine(&plane, [10; 3], 2.0).is_none(), "no texture along y and z");
    assert!(refine(&[7.0; 8000], [10; 3], 2.0).is_none(), "constant");
}

#[test]
fn one_slice_is_matched_in_its_plane() {
    let shape = [40, 40, 1];
    let waves = Waves::new(40, 8.0, 24.0, 3);
    let fixed = sampled(shape, |p| 100.0 * waves.at(p));
    let moving = sampled(shape, |p| 100.0 * waves.at([p[0] - D[0], p[1] - D[1], 0.0]));
    let smooth = filters::bspline(&fixed, shape);
    let sampler = SmoothSampler { data: &moving, shape };
    let template = Template { data: &smooth, shape, spacing: [1.0, 1.0, 6.0], radius: [4; 3], noise: 1.0 };
    let sample = |o: [f32; 3]| sampler.at([20.0 + o[0], 20.0 + o[1], o[2]]);
    let found = least_squares_matching::refine(
        &template,
        [20, 20, 0],
        least_squares_matching::pointwise([4, 4, 0], sample),
        12,
        2.0,
    )
    .unwrap();
    assert!((found.shift.0[0] - D[0]).abs() < 0.02 && (found.shift.0[1] - D[1]).abs() < 0.02, "{found:?}");
    assert_eq!((found.shift.0[2], found.covariance[2], found.covariance[4], found.covariance[5]), (0.0, 0.0, 0.0, 0.0));
}

#[test]
fn the_covariance_of_a_match_is_calibrated() {
    let (shape, sigma) = ([60, 60, 60], 10.0f32);
    let (mut fixed, mut moving) = texture(shape, 12.0, 4);
    let noise = normals(2 * fixed.len(), 5);
    let (a, b) = noise.split_at(fixed.len());
    fixed.iter_mut().zip(a).for_each(|(v, n)| *v += sigma * n);
    moving.iter_mut().zip(b).for_each(|(v, n)| *v += sigma * n);
    let smooth = filters::bspline(&fixed, shape);
    let sampler = SmoothSampler { data: &moving, shape };
    let template = Template { data: &smooth, shape, spacing: [1.0; 3], radius: [3; 3], noise: 0.0 };
    let (mut sum, mut count) = (0.0, 0);
    for centre in voxels([6, 6, 6]).map(|p| p.map(|v| 9 + 8 * v)) {
        let sample = |o: [f32; 3]| sampler.at(std::array::from_fn(|a| centre[a] as f32 + o[a]));
        let Some(found) = least_squares_matching::refine(
            &template,
            centre,
            least_squares_matching::pointwise([3; 3], sample),
            12,
            2.0,
        ) else {
            continue;
        };
        let e = std::array::from_fn(|a| found.shift.0[a] - D[a]);
        sum += quadratic(&inverse(&found.covariance).unwrap(), e);
        count += 1;
    }
    let mean = sum / f64::from(count);
    assert!(count > 200, "{count}");
    assert!((2.1..3.9).contains(&mean), "mean chi-square {mean} with 3 degrees of freedom");
}

// Texture

#[test]
fn what_is_noise_alone_counts_as_plain() {
    // Slabs of texture under noise of a tenth of it, the first `even` of eight noise alone, in
    // cubes and in thick slices.
    for spacing in [[1.0; 3], [1.0, 1.0, 3.5]] {
        let shape = [56, 42, 28];
        let (textured, _) = texture(shape, 6.0, 8);
        let mean = textured.iter().sum::<f32>() / textured.len() as f32;
        let noise = normals(textured.len(), 9);
        for even in [0, 2, 5, 8] {
            let value = |at: usize| if at % 56 < 7 * even { mean } else { textured[at] };
            let fixed: Vec<f32> = (0..textured.len()).map(|at| value(at) + 10.0 * noise[at]).collect();
            let found = pair(shape, spacing, &fixed, &fixed).plain();
            assert!((found - even as f64 / 8.0).abs() < 0.02, "{found:.3} of {even} eighths, {spacing:?}");
        }
    }
}

// Gain

#[test]
fn the_gain_field_undoes_gain_and_offset() {
    let shape = [40, 33, 26];
    let (fixed, _) = texture(shape, 8.0, 6);
    for (gain, offset) in [(0.5f32, 120.0f32), (2.5, -300.0), (-1.5, 1000.0)] {
        let moving: Vec<f32> = fixed.iter().map(|v| (v - offset) / gain).collect();
        let pair = pair(shape, [1.0; 3], &fixed, &moving);
        let field = GainField::measure(&Pair { noise: 0.0, ..pair.clone() }, &unmoved(&pair));
        assert!((field.variation(&pair) - 1.0).abs() < 1e-3, "{}", field.variation(&pair));
        let (mut a, mut b) = ([0.0; 40], [0.0; 40]);
        for (j, k) in [(0, 0), (16, 13), (32, 25)] {
            field.row(j, k, &mut a, &mut b);
            for i in 0..40 {
                assert!((a[i] / gain - 1.0).abs() < 1e-3, "{} is not {gain}", a[i]);
                assert!((b[i] - offset).abs() < 1.0, "{} is not {offset}", b[i]);
            }
        }
    }
}

#[test]
fn the_gain_field_follows_a_slow_bias() {
    let shape = [64, 40, 32];
    let (fixed, _) = texture(shape, 6.0, 7);
    let bias = |i: usize| 0.7 + 0.6 * i as f32 / 63.0;
    let moving: Vec<f32> = fixed.iter().enumerate().map(|(at, v)| v / bias(at % 64)).collect();
    let pair = pair(shape, [1.0; 3], &fixed, &moving);
    let warped = unmoved(&pair);
    let field = GainField::measure(&Pair { noise: 1.0, ..pair.clone() }, &warped);
    let (mut a, mut b) = ([0.0; 64], [0.0; 64]);
    let (mut before, mut after) = (0.0, 0.0);
    for (j, k) in voxels([40, 32, 1]).map(|p| (p[0], p[1])) {
        field.row(j, k, &mut a, &mut b);
        for i in 0..64 {
            let at = i + 64 * (j + 40 * k);
            before += f64::from(pair.fixed_smooth[at] - warped[at]).powi(2);
            after += f64::from(pair.fixed_smooth[at] - (a[i] * warped[at] + b[i])).powi(2);
        }
    }
    assert!(after < 0.05 * before, "{after} of {before} left");
    // From its tenth to its 90th percentile 0.76 to 1.24.
    let variation = field.variation(&pair);
    assert!((1.55..1.7).contains(&variation), "{variation}");
}

#[test]
fn a_gain_that_changes_its_sign_varies_beyond_all_bounds() {
    let shape = [64, 40, 32];
    let (fixed, _) = texture(shape, 6.0, 7);
    let moving: Vec<f32> = fixed.iter().enumerate().map(|(at, v)| if at % 64 < 32 { *v } else { -v }).collect();
    let pair = pair(shape, [1.0; 3], &fixed, &moving);
    let field = GainField::measure(&Pair { noise: 1.0, ..pair.clone() }, &unmoved(&pair));
    assert!(field.variation(&pair).is_infinite());
}

/// What an edge that is not in place yet leaves was taken for gain, most of all in the few voxels
/// of a block at the skin: motion of a plate of 1.5 mm was found to 1.2.
#[test]
fn an_edge_that_moved_is_not_taken_for_gain() {
    let shape = [64, 40, 40];
    let (waves, _) = texture(shape, 12.0, 7);
    let tissue = |edge: usize| -> Vec<f32> {
        waves.iter().enumerate().map(|(at, v)| if at % 64 < edge { *v } else { 0.2 * v }).collect()
    };
    let weighted = Pair { noise: 10.0, ..pair(shape, [1.0; 3], &tissue(36), &tissue(35)) };
    let mut alike = weighted.clone();
    assert!(weighted.mask.iter().all(|&m| m > 0) && weighted.mask.iter().any(|&m| m < 10));
    alike.mask.to_mut().fill(255);
    // How far both volumes' own intensity is changed away from the edge, where nothing is to be
    // changed.
    let changed = |pair: &Pair<'_>| {
        let (warped, mut sum) = (unmoved(pair), 0.0);
        let gain = GainField::sharpened(pair, &warped);
        let (mut a, mut b) = ([0.0; 64], [0.0; 64]);
        for (j, k) in voxels([40, 40, 1]).map(|p| (p[0], p[1])) {
            gain.row(j, k, &mut a, &mut b);
            for i in (20..32).chain(40..50) {
                let v = warped[i + 64 * (j + 40 * k)];
                sum += f64::from(a[i] * v + b[i] - v).powi(2);
            }
        }
        sum.sqrt()
    };
    let ratio = changed(&weighted) / changed(&alike);
    assert!(ratio < 0.5, "{ratio}");
}

/// Smoothing flattens a bias that curves, and what it left of one was taken for motion.
#[test]
fn the_gain_field_follows_a_bias_that_curves() {
    let shape = [64, 48, 48];
    let (fixed, _) = texture(shape, 6.0, 7);
    let bias = |i: usize| (0.3 * (std::f32::consts::TAU * i as f32 / 48.0).sin()).exp();
    let moving: Vec<f32> = fixed.iter().enumerate().map(|(at, v)| v / bias(at % 64)).collect();
    let pair = pair(shape, [1.0; 3], &fixed, &moving);
    let field = GainField::sharpened(&Pair { noise: 1.0, ..pair.clone() }, &unmoved(&pair));
    let (mut a, mut b) = ([0.0; 64], [0.0; 64]);
    let (mut along, mut all) = (0.0, 0.0);
    for (j, k) in voxels([48, 48, 1]).map(|p| (p[0], p[1])).filter(|p| p.0 > 7 && p.0 < 40 && p.1 > 7 && p.1 < 40) {
        field.row(j, k, &mut a, &mut b);
        for (i, a) in a.iter().enumerate().take(56).skip(8) {
            along += f64::from(a.ln() * bias(i).ln());
            all += f64::from(bias(i).ln().powi(2));
        }
    }
    // 0.82; measured once, 0.64.
    let share = along / all;
    assert!((share - 1.0).abs() < 0.25, "{share} of the bias is seen");
}

// Brightness

/// A pair of texture about 200 whose deformed volume is as bright as `seen` says of a brightness
/// and a place.
fn lit(shape: [usize; 3], spacing: [f64; 3], seen: impl Fn(f64, [f64; 3]) -> f64) -> Pair<'static> {
    let (f, _) = texture(shape, 12.0, 7);
    let g = plain(shape, spacing);
    let f: Vec<f32> = f.iter().map(|v| 200.0 * (0.004 * (v - 500.0)).exp()).collect();
    let m: Vec<f32> =
        f.iter().enumerate().map(|(at, v)| seen(f64::from(*v), g.voxel(at).map(|v| v as f64)) as f32).collect();
    pair(shape, spacing, &f, &m)
}

/// A lattice and coefficients of a motion along x (mm).
fn moved(pair: &Pair<'_>, mm: f32) -> (Lattice, Vec<f32>) {
    let lattice = Lattice::new(pair.shape, [4; 3]);
    let n = lattice.len();
    (lattice, (0..3 * n).map(|i| if i < n { mm } else { 0.0 }).collect())
}

fn brightness(pair: &Pair<'_>) -> Option<Brightness> {
    under(pair, ([1; 3], pair.shape), 0.0)
}

/// Under a motion along x (mm).
fn under(pair: &Pair<'_>, level: ([usize; 3], [usize; 3]), mm: f32) -> Option<Brightness> {
    let (lattice, c) = moved(pair, mm);
    let warped = pair.warp(&lattice, &c, &pair.spans);
    Brightness::measure(pair, level, &warped, |p| lattice.at(&c, p), 0.95)
}

/// How far the deformed volume is from the initial one when it is evened out: the median of the
/// logarithms' distances.
fn uneven(pair: &Pair<'_>, found: &Brightness) -> f32 {
    let mut even = pair.moving.to_vec();
    found.even_out(&mut even, pair.shape, [0.0; 3], [1; 3]);
    let mut off: Vec<f32> = even.iter().zip(&*pair.fixed).map(|(e, f)| (e / f).ln().abs()).collect();
    palpate::numerics::statistics::median(&mut off)
}

#[test]
fn brightness_by_place_and_by_contrast_is_found_and_taken_out() {
    for (shape, spacing) in [([48, 40, 44], [1.0; 3]), ([64, 60, 1], [0.5; 3]), ([48, 48, 14], [1.0, 1.0, 4.0])] {
        let curve = |p: [f64; 3]| {
            let [x, y, z]: [f64; 3] = std::array::from_fn(|a| p[a] / (shape[a].max(2) - 1) as f64);
            (0.8 * x * x - 0.5 * x * y + 0.3 * z * (1.0 - z) + 0.4 * y.powi(3)).exp()
        };
        let root = |v: f64| 30.0 * v.sqrt();
        for (place, tone) in [(true, false), (false, true), (true, true)] {
            let seen = |v: f64, p| (if tone { root(v) } else { v }) / (if place { curve(p) } else { 1.0 });
            let pair = lit(shape, spacing, seen);
            let found = brightness(&pair).unwrap();
            let [before, after] = found.deviation;
            assert!(before > 0.05 && after < 0.2 * before, "{shape:?} {place} {tone} {before} {after}");
            // Blocks mix what differs, so that another contrast is found to a few hundredths.
            let off = uneven(&pair, &found);
            assert!(off < if tone { 0.03 } else { 0.005 }, "{shape:?} {place} {tone} {off}");
            assert!(!tone || found.is_of_tone(), "{shape:?} {place} {tone}");
            assert!(!place || found.is_of_place(), "{shape:?} {place} {tone}");
        }
    }
}

#[test]
fn what_a_volume_is_scaled_by_is_no_matter_for_its_contrast() {
    for scale in [1e-3, 1.0, 1e4] {
        let pair = lit([48, 40, 44], [1.0; 3], |v, p| scale * v.sqrt() / (0.01 * p[0]).exp());
        let found = brightness(&pair).unwrap();
        let [before, after] = found.deviation;
        assert!(found.is_of_tone() && found.is_of_place() && after < 0.1 * before, "{scale} {before} {after}");
        assert!(uneven(&pair, &found) < 0.03, "{scale} {}", uneven(&pair, &found));
    }
}

#[test]
fn brightness_belongs_to_places_of_the_deformed_volume_on_every_level() {
    // A deformed volume of its own shape, which starts 4 voxels before the initial one, tissue that
    // moves by 3, a brightness that stays.
    let (shape, there) = ([48, 44, 40], [56, 44, 40]);
    let (f, _) = texture([80, 44, 40], 8.0, 3);
    let at = |i: usize, j: usize, k: usize| f[i + 80 * (j + 44 * k)];
    let log = |x: f64| 0.02 * x - 0.0003 * x * x;
    let fill = |grid: Grid, value: &dyn Fn([usize; 3]) -> f32| {
        Volume::from_vec(grid, (0..grid.len()).map(|v| value(grid.voxel(v))).collect()).unwrap()
    };
    let before = [[1.0, 0.0, 0.0, -4.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
    let fixed = fill(plain(shape, [1.0; 3]), &|[i, j, k]| at(i + 10, j, k));
    let moving = fill(grid(there, before), &|[i, j, k]| at(i + 3, j, k) / log(i as f64 - 4.0).exp() as f32);
    let mask = Mask::filled(*fixed.grid(), 1);
    let both = Aligned::new(&fixed, &moving, &mask, 10.0).unwrap();
    for factor in [[1; 3], [2; 3]] {
        let pair = both.level(factor);
        let found = under(&pair, (factor, shape), 3.0).unwrap();
        for factor in [[1; 3], [2; 3]] {
            let mut pair = both.level(factor);
            pair.even_out(&found, factor);
            let (lattice, c) = moved(&pair, 3.0);
            let warped = pair.warp(&lattice, &c, &pair.spans);
            let seen = warped.iter().zip(&pair.fixed_smooth[..]).filter(|(w, _)| w.is_finite());
            let mut off: Vec<f32> = seen.map(|(w, f)| (w / f).ln().abs()).collect();
            assert!(palpate::numerics::statistics::median(&mut off) < 0.01, "{factor:?}");
        }
    }
}

#[test]
fn blocks_that_are_off_hardly_count() {
    let mut pair = lit([48; 3], [1.0; 3], |v, p| v / (0.01 * p[0]).exp());
    // An eighth of it is off by a factor of two, as where a field is wrong at strong edges.
    for (at, v) in pair.moving.to_mut().iter_mut().enumerate() {
        let p = [at % 48, at / 48 % 48, at / 2304];
        *v *= if p.iter().all(|&v| v / 8 % 2 == 0) { 2.0 } else { 1.0 };
    }
    let found = brightness(&pair).unwrap();
    assert!((found.variation / (0.01f64 * 0.8 * 44.0).exp() - 1.0).abs() < 0.05, "{}", found.variation);
    // Two volumes that are the same, one with hardly a block, and one of one brightness.
    assert!((brightness(&lit([24; 3], [1.0; 3], |v, _| v)).unwrap().variation - 1.0).abs() < 1e-3);
    assert!(brightness(&lit([9; 3], [1.0; 3], |v, _| v)).is_none());
    let even = pair_of_one_value([24; 3]);
    assert!(brightness(&even).is_none_or(|b| b.variation.is_finite() && b.deviation[0] < 1e-6));
}

/// A polynomial across a step (one half of a head 1.4 times as bright) left little of it and did
/// harm: 0.008 -> 0.208 mm.
#[test]
fn a_step_in_brightness_is_told_from_a_profile() {
    let profile = |v: f64, p: [f64; 3]| v / (0.8 * (p[0] / 47.0).powi(2) - 0.5 * p[1] / 39.0).exp();
    let uneven = brightness(&lit([48, 40, 44], [1.0; 3], profile)).unwrap().uneven;
    assert!(uneven < 0.1, "a profile: {uneven}");
    for by in [1.4, 3.0] {
        let step = brightness(&lit([48, 40, 44], [1.0; 3], |v, p| if p[0] < 24.0 { v * by } else { v })).unwrap();
        assert!(step.uneven > 1.0, "{by}: {}", step.uneven);
    }
}

/// A leg that the deformed volume does not show, or noise where a coil is far, was taken for a
/// profile: 0.000 -> 0.298 mm, 0.31 -> 1.12.
#[test]
fn what_is_dark_in_the_deformed_volume_tells_nothing_of_its_brightness() {
    let pair = lit([48; 3], [1.0; 3], |v, p| v / (0.01 * p[0]).exp());
    let mut random = palpate::numerics::random::Random::new(5, 0);
    let mut noisy = |v: &f32, sigma: f64| {
        let [a, b] = random.normals();
        (f64::from(*v) + sigma * a).hypot(sigma * b) as f32
    };
    let f: Vec<f32> = pair.fixed.iter().map(|v| noisy(v, 6.0)).collect();
    let seen = |(at, v): (usize, &f32)| if at / 2304 < 20 { noisy(&0.0, 6.0) } else { noisy(v, 6.0) };
    let m: Vec<f32> = pair.moving.iter().enumerate().map(seen).collect();
    let found = brightness(&self::pair([48; 3], [1.0; 3], &f, &m)).unwrap();
    assert!((found.variation / (0.01f64 * 0.8 * 44.0).exp() - 1.0).abs() < 0.05, "{}", found.variation);
    assert!(found.deviation[1] < 0.1 * found.deviation[0], "{:?}", found.deviation);
}

#[test]
fn a_brightness_that_falls_with_the_other_is_no_contrast() {
    for power in [0.3, 0.8, 1.0] {
        let found = brightness(&lit([48, 40, 44], [1.0; 3], |v, _| 200.0 * (v / 200.0).powf(-power))).unwrap();
        assert!(!found.is_of_tone() && found.deviation[1] > 0.6 * found.deviation[0], "{power}: {:?}", found.deviation);
    }
}

#[test]
fn brightness_below_zero_or_upside_down_is_found_too() {
    // Air in the first slices tells where brightness begins.
    let air = |v: f64, p: [f64; 3]| if p[2] < 4.0 { 0.0 } else { v / (0.01 * p[0]).exp() };
    for (sign, offset) in [(1.0, 0.0), (1.0, -500.0), (-1.0, 0.0), (1.0, 1000.0)] {
        let mut pair = lit([48; 3], [1.0; 3], air);
        let f: Vec<f32> = pair.fixed.iter().enumerate().map(|(at, v)| if at / 2304 < 4 { 0.0 } else { *v }).collect();
        let map = |v: &f32| sign * v + offset;
        pair = self::pair(
            [48; 3],
            [1.0; 3],
            &f.iter().map(map).collect::<Vec<_>>(),
            &pair.moving.iter().map(map).collect::<Vec<_>>(),
        );
        let found = brightness(&pair).unwrap();
        assert!(found.deviation[1] < 0.1 * found.deviation[0], "{sign} {offset} {:?}", found.deviation);
        let mut even = pair.moving.to_vec();
        found.even_out(&mut even, pair.shape, [0.0; 3], [1; 3]);
        let mut off: Vec<f32> = even.iter().zip(&*pair.fixed).map(|(e, f)| (e - f).abs()).collect();
        assert!(palpate::numerics::statistics::median(&mut off) < 2.0, "{sign} {offset}");
    }
}

fn pair_of_one_value(shape: [usize; 3]) -> Pair<'static> {
    let values = vec![100.0; shape.iter().product()];
    pair(shape, [1.0; 3], &values, &values)
}

// Residual

#[test]
fn the_right_hand_side_is_the_slope_of_the_misfit() {
    let (shape, spacing) = ([32, 30, 28], [1.0, 1.0, 1.5]);
    let waves = Waves::new(60, 10.0, 30.0, 8);
    // The truth beyond the field at hand: a few tenths of a voxel.
    let rest = |p: [f64; 3]| [0.10 * (p[1] / 9.0).sin(), 0.08, -0.06 * (p[0] / 8.0).cos()];
    let fixed = sampled(shape, |p| 100.0 * waves.at(p));
    let moving = sampled(shape, |p| {
        let d = rest(p);
        100.0 * waves.at(std::array::from_fn(|a| p[a] - d[a]))
    });
    let pair = pair(shape, spacing, &fixed, &moving);
    let lattice = Lattice::new(shape, [6; 3]);
    let (n, active) = (lattice.len(), Spans::new(&vec![1u8; fixed.len()], shape));
    let c = vec![0.0f32; 3 * n];
    let warped = pair.warp(&lattice, &c, &active);
    let gain = GainField::measure(&Pair { noise: 0.0, ..pair.clone() }, &warped);
    let found = normal_equations(&pair, &warped, &gain, &lattice, 5.0);
    let sigma = f64::from(found.sigma);
    // Cauchy's cost with the same gain and sigma.
    let cost = |c: &[f32]| {
        let warped = pair.warp(&lattice, c, &active);
        let (mut a, mut b) = (vec![0.0; 32], vec![0.0; 32]);
        let mut sum = 0.0;
        for row in 0..30 * 28 {
            gain.row(row % 30, row / 30, &mut a, &mut b);
            for i in 0..32 {
                let at = i + 32 * row;
                let r = f64::from(pair.fixed_smooth[at] - (a[i] * warped[at] + b[i])) / sigma;
                if r.is_finite() {
                    sum += 0.5 * 2.385f64.powi(2) * (r / 2.385).powi(2).ln_1p();
                }
            }
        }
        sum
    };
    // Nodes well inside, along each axis.
    let inner =
        voxels(lattice.nodes).enumerate().filter(|(_, p)| (0..3).all(|a| p[a] >= 3 && p[a] + 3 < lattice.nodes[a]));
    let (mut cross, mut ff, mut gg) = (0.0, 0.0, 0.0);
    for (node, _) in inner {
        for a in 0..3 {
            let h = 0.05f32;
            let moved = |by: f32| {
                let mut c = c.clone();
                c[a * n + node] += by;
                cost(&c)
            };
            let slope = (moved(-h) - moved(h)) / f64::from(2.0 * h);
            let rhs = f64::from(found.rhs[a * n + node]);
            cross += slope * rhs;
            ff += slope * slope;
            gg += rhs * rhs;
        }
    }
    let (cosine, ratio) = (cross / (ff * gg).sqrt(), (gg / ff).sqrt());
    // The mean of both images' gradients stands for the warped one's: equal but for the rest of the
    // motion.
    assert!(cosine > 0.995, "direction: {cosine}");
    assert!((0.93..1.07).contains(&ratio), "length: {ratio}");
}

/// The gradient of the noise is no information: noise alone gives next to none, and texture under
/// noise gives what it gives without.
#[test]
fn noise_adds_no_information() {
    let shape = [40, 38, 36];
    let (texture, _) = texture(shape, 6.0, 8);
    let n = texture.len();
    let mean_of = |contrast: f32| {
        let noisy = |seed: u64| -> Vec<f32> {
            texture.iter().zip(normals(n, seed)).map(|(t, e)| 500.0 + contrast * (t - 500.0) + 20.0 * e).collect()
        };
        let mut pair = Pair { noise: 20.0, ..pair(shape, [1.0; 3], &noisy(1), &noisy(2)) };
        // At the border differences are one-sided.
        for (m, p) in pair.mask.to_mut().iter_mut().zip(voxels(shape)) {
            *m = u8::from((0..3).all(|a| p[a] > 0 && p[a] + 1 < shape[a]));
        }
        let warped = unmoved(&pair);
        let gain = GainField::measure(&Pair { noise: 0.0, ..pair.clone() }, &warped);
        let found = normal_equations(&pair, &warped, &gain, &Lattice::new(shape, [6; 3]), 1.0);
        let trace = |blocks: &Blocks| blocks.iter().map(|b| f64::from(b[0] + b[1] + b[2])).sum::<f64>();
        [trace(&found.blocks), trace(&found.information())]
    };
    let [all, without] = mean_of(0.0);
    // No block may turn negative, so chance leaves a part.
    assert!(without < 0.15 * all, "{without} of {all}");
    let slope = |a: usize| {
        let step = [1, shape[0], shape[0] * shape[1]][a];
        texture.windows(2 * step + 1).map(|w| f64::from(w[2 * step] - w[0]).powi(2) / 4.0).sum::<f64>()
    };
    let clean = (0..3).map(slope).sum::<f64>();
    let [weak, strong] = [0.3, 3.0].map(|contrast| mean_of(contrast)[1] / (f64::from(contrast).powi(2) * clean));
    // Where texture is strong its own steepness counts less, so weak texture may tell more of it.
    assert!((0.9..1.4).contains(&(weak / strong)), "{weak} {strong}");
}

#[test]
fn the_blocks_are_positive_and_bound_the_curvature() {
    let shape = [24, 22, 20];
    let (fixed, moving) = texture(shape, 8.0, 9);
    let mut pair = pair(shape, [1.0; 3], &fixed, &moving);
    for (m, p) in pair.mask.to_mut().iter_mut().zip(voxels(shape)) {
        *m = u8::from(p[2] < 12);
    }
    pair.spans = Spans::new(&pair.mask, shape);
    let lattice = Lattice::new(shape, [5; 3]);
    let run = || {
        let warped = unmoved(&pair);
        let gain = GainField::measure(&Pair { noise: 0.0, ..pair.clone() }, &warped);
        normal_equations(&pair, &warped, &gain, &lattice, 1.0)
    };
    let found = run();
    assert!(found.sigma >= 1.0);
    for (node, m) in found.blocks.iter().enumerate() {
        let trace = f64::from(m[0] + m[1] + m[2]);
        for v in
            [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.6, -0.8, 0.0], [0.5, 0.5, -0.7], [-0.3, 0.9, 0.4]]
        {
            let q: f64 = (0..9).map(|e| v[e / 3] * v[e % 3] * entry(&m, e / 3, e % 3)).sum();
            assert!(q >= -1e-5 * trace, "node {node}: {q} of {trace}");
        }
        // Nodes that only reach beyond the mask know nothing.
        if node / (lattice.nodes[0] * lattice.nodes[1]) >= 7 {
            assert_eq!((m, found.rhs[node]), ([0.0; 6], 0.0));
        }
    }
    let again = with_threads(1, run);
    assert_eq!((again.blocks, again.rhs, again.sigma), (found.blocks, found.rhs, found.sigma));
}

// Alignment and levels

/// Whether the deformed volume, seen through the pair, is where the initial one says it is.
fn agree(pair: &Pair<'_>, tolerance: f64) -> usize {
    let (mut worst, mut seen) = (0.0f64, 0);
    for (i, p) in voxels(pair.shape).enumerate() {
        let q = pair.to_moving(VoxelPoint(p.map(|v| v as f64)));
        // Away from the deformed volume's border, where smoothing clamps.
        let deep = |a: usize| q[a] >= 4.0 && q[a] <= pair.moving_shape[a] as f32 - 5.0;
        let inner = |a: usize| p[a] >= 2 && p[a] + 2 < pair.shape[a];
        if (0..3).all(|a| pair.shape[a] == 1 || (deep(a) && inner(a))) {
            let v = f64::from(pair.sampler().at(q));
            if v.is_finite() {
                worst = worst.max((v - f64::from(pair.fixed_smooth[i])).abs());
                seen += 1;
            }
        }
    }
    assert!(worst < tolerance, "off by {worst} of a spread of 100");
    seen
}

#[test]
fn volumes_on_any_grids_are_brought_together() {
    let waves = Waves::new(40, 14.0, 40.0, 10);
    let tissue = |p: WorldPoint| 100.0 * waves.at(p.0);
    let shape = [30, 28, 26];
    let (s, c) = 0.3f64.sin_cos();
    let oblique = [[c, -s, 0.0, -10.0], [s, c, 0.0, 4.0], [0.0, 0.0, 1.2, 7.0]];
    let initial = [plain(shape, [1.0; 3]), grid(shape, oblique)];
    for first in initial {
        let o = first.affine().to_world(VoxelPoint([3.4, -2.0, 1.25])).0;
        let linear = first.affine().linear();
        let same = std::array::from_fn(|r| [linear[r][0], linear[r][1], linear[r][2], o[r]]);
        // Flipped along x and z, from the far end.
        let far = first.affine().to_world(VoxelPoint([30.5, 0.0, 26.0])).0;
        let flipped = std::array::from_fn(|r| [-linear[r][0], linear[r][1], -linear[r][2], far[r]]);
        // Turned about z by 0.2 and with other voxels, about the same centre.
        let (s, c) = 0.2f64.sin_cos();
        let mid = first.affine().to_world(VoxelPoint([15.0, 14.0, 13.0])).0;
        let turned = [[0.9 * c, -0.8 * s, 0.0], [0.9 * s, 0.8 * c, 0.0], [0.0, 0.0, 1.1]];
        let turned: [[f64; 4]; 3] = std::array::from_fn(|r| {
            let t = turned[r];
            [t[0], t[1], t[2], mid[r] - 20.0 * t[0] - 20.0 * t[1] - 16.0 * t[2]]
        });
        for (name, second, tolerance) in [
            ("same axes", grid([29, 31, 24], same), 1.0),
            ("flipped", grid([34, 30, 30], flipped), 1.0),
            ("turned", grid([40, 40, 32], turned), 2.0),
        ] {
            let both = aligned((first, &tissue), (second, &tissue)).unwrap();
            let pair = both.level([1; 3]);
            let seen = agree(&pair, tolerance);
            assert!(seen > 3000, "{name}: {seen} voxels compared");
        }
    }
}

#[test]
fn levels_keep_places() {
    let waves = Waves::new(40, 24.0, 60.0, 11);
    let tissue = |p: WorldPoint| 100.0 * waves.at(p.0);
    let first = plain([49, 46, 30], [1.0; 3]);
    let second = grid([52, 44, 33], [[1.0, 0.0, 0.0, -3.4], [0.0, 1.0, 0.0, 2.2], [0.0, 0.0, 1.0, -1.7]]);
    let both = aligned((first, &tissue), (second, &tissue)).unwrap();
    for factor in [[1, 1, 1], [2, 2, 2], [3, 2, 1]] {
        let pair = both.level(factor);
        assert_eq!(pair.spacing, factor.map(|f| f as f64));
        assert_eq!(pair.shape, std::array::from_fn(|a| [49usize, 46, 30][a].div_ceil(factor[a])));
        assert!(agree(&pair, 1.5) > 500);
        let p = [7.3, 0.0, 28.1];
        let VoxelPoint(back) = from_level(to_level(VoxelPoint(p), factor), factor);
        assert!((0..3).all(|a| (back[a] - p[a]).abs() < 1e-12));
    }
    // The centre of the first block of two lies between its voxels.
    assert_eq!(from_level(VoxelPoint([0.0; 3]), [2, 3, 1]), VoxelPoint([0.5, 1.0, 0.0]));
}

#[test]
fn volumes_apart_are_an_error() {
    let f = |_: WorldPoint| 0.0;
    let far = grid([10, 10, 10], [[1.0, 0.0, 0.0, 500.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]);
    let found = aligned((plain([10, 10, 10], [1.0; 3]), &f), (far, &f));
    assert!(matches!(found, Err(FieldError::NoOverlap { .. })));
}

#[test]
fn reductions_go_from_coarse_to_fine() {
    assert_eq!(factors([128, 128, 128], [1.0; 3], 1, 4.0), [[4, 4, 4], [2, 2, 2], [1, 1, 1]]);
    // Thick slices wait for the others.
    assert_eq!(factors([256, 256, 40], [1.0, 1.0, 4.0], 1, 4.0), [[4, 4, 1], [2, 2, 1], [1, 1, 1]]);
    // One slice is never reduced across, and nothing below 12 voxels.
    for f in factors([200, 20, 1], [1.0, 1.0, 5.0], 2, 8.0) {
        assert!(f[2] == 1 && f[1] == 1, "{f:?}");
    }
}

/// In volumes of 448 x ny x 448 voxels the rows from which the noise was told were all the first of
/// their slice.
#[test]
fn rows_are_sampled_all_over_a_volume() {
    for ny in 1..60 {
        for wanted in 0..200 {
            let step = row_step(wanted, ny);
            assert!((wanted.max(1)..wanted.max(1) + ny).contains(&step), "{wanted} in {ny}: {step}");
            let mut met: Vec<usize> = (0..ny).map(|n| n * step % ny).collect();
            met.sort_unstable();
            assert_eq!(met, (0..ny).collect::<Vec<_>>(), "{wanted} in {ny}: {step}");
        }
    }
    let shape = [448, 4, 448];
    let inside: Vec<u8> = (0..448 * 4 * 448).map(|o| u8::from(o / 448 % 4 > 0)).collect();
    let (fixed, _) = texture(shape, 8.0, 6);
    let mut pair = pair(shape, [1.0; 3], &fixed, &fixed);
    pair.mask = inside.into();
    pair.spans = Spans::new(&pair.mask, shape);
    let noisy: Vec<f32> = pair.fixed_smooth.iter().zip(normals(fixed.len(), 5)).map(|(f, n)| f + 3.0 * n).collect();
    let sigma = residual_sigma(&pair, &noisy, &GainField::measure(&pair, &noisy));
    assert!((sigma / 3.0 - 1.0).abs() < 0.05, "{sigma}");
}

#[test]
fn dilation_grows_a_box() {
    let shape = [9, 8, 7];
    let mut mask = vec![0u8; 504];
    mask[4 + 9 * (3 + 8)] = 1;
    let grown = dilate(&mask, shape, 2);
    for (v, p) in grown.iter().zip(voxels(shape)) {
        let near = (0..3).all(|a| p[a].abs_diff([4, 3, 1][a]) <= 2);
        assert_eq!(*v != 0, near, "{p:?}");
    }
}
