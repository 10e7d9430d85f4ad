//! Scores of small fields, worked out by hand.

use palpate::evaluate::labels::{label_scores, overlap};
use palpate::evaluate::{inverse_consistency, landmarks, metrics, target_error};
use palpate::numerics::statistics::percentile;
use palpate::types::{Affine, DenseField, Grid, Landmark, Mask, Volume, WorldPoint};

fn grid(shape: [usize; 3], spacing: [f64; 3]) -> Grid {
    Grid::new(shape, Affine::scaled(spacing, [0.0; 3]).unwrap()).unwrap()
}

fn close(a: f64, b: f64) {
    assert!((a - b).abs() < 1e-6, "{a} is not {b}");
}

#[test]
fn percentiles_interpolate_as_numpy_does() {
    let mut v = [4.0, 1.0, 3.0, 2.0];
    close(percentile(&mut v, 50.0), 2.5);
    close(percentile(&mut v, 95.0), 3.85);
    close(percentile(&mut v, 0.0), 1.0);
    close(percentile(&mut v, 100.0), 4.0);
    assert!(percentile(&mut [], 50.0).is_nan());
}

#[test]
fn errors_are_over_the_mask_only() {
    let g = grid([4, 1, 1], [1.0; 3]);
    let truth = DenseField::from_fn(g, |_| [3.0, 4.0, 0.0]);
    // Errors 0, 1, 2 in the mask and 99 outside.
    let field = DenseField::from_fn(g, |p| [3.0, 4.0, if p.0[0] < 2.5 { p.0[0] } else { 99.0 }]);
    let mask = Mask::from_vec(g, vec![1, 1, 2, 0]).unwrap();
    let m = metrics(&field, &truth, Some(&mask), &[]).unwrap();
    assert_eq!(m.voxels, 3);
    close(m.mean_mm, 1.0);
    close(m.median_mm, 1.0);
    close(m.p95_mm, 1.9);
    close(m.max_mm, 2.0);
    close(m.identity_mm, 5.0);
    assert_eq!((m.still_mm, m.landmarks_mm), (None, None));
    // d(uz)/dx of the field: 1, 1, (99 - 1) / 2.
    close(m.grad_err, 1.0);
    close(m.grad_err_p95, 1.0 + 0.9 * 48.0);
    close(m.folds, 0.0);
}

#[test]
fn gradients_are_by_millimetre_and_folds_are_counted() {
    let g = grid([6, 5, 4], [2.0, 1.0, 0.5]);
    let field = DenseField::from_fn(g, |p| [-1.5 * p.0[0], 0.0, 0.2 * p.0[1]]);
    let m = metrics(&field, &DenseField::zeros(g), None, &[]).unwrap();
    close(m.grad_err, (1.5f64 * 1.5 + 0.04).sqrt());
    close(m.grad_err_p95, m.grad_err);
    close(m.folds, 1.0);
    close(m.identity_mm, 0.0);
}

#[test]
fn still_tissue_is_scored_when_there_is_more_than_a_thousand_voxels_of_it() {
    for (n, expected) in [(1000, None), (1001, Some(0.5))] {
        let g = grid([n + 50, 1, 1], [1.0; 3]);
        let truth = DenseField::from_fn(g, |p| if p.0[0] < n as f64 { [0.05, 0.0, 0.0] } else { [2.0, 0.0, 0.0] });
        let field = DenseField::from_fn(g, |p| if p.0[0] < n as f64 { [0.55, 0.0, 0.0] } else { [9.0, 0.0, 0.0] });
        let still = metrics(&field, &truth, None, &[]).unwrap().still_mm;
        assert_eq!(still.map(|v| (v * 1e6).round() / 1e6), expected);
    }
}

#[test]
fn landmarks_are_read_trilinearly_and_held_at_the_edge() {
    let g = grid([5, 5, 5], [1.0; 3]);
    let field = DenseField::from_fn(g, |p| [p.0[0], 0.0, 0.0]);
    let mark = |x: f64, to: f64| Landmark { initial: WorldPoint([x, 1.5, 2.5]), deformed: WorldPoint([to, 1.5, 2.5]) };
    // u(1.25) = 1.25 exactly; beyond the edge at 4, u stays 4.
    let errors = landmarks(&field, &[mark(1.25, 2.5), mark(6.0, 10.5)]);
    close(errors[0], 0.0);
    close(errors[1], 0.5);
    let m = metrics(&field, &field, None, &[mark(1.25, 2.5), mark(6.0, 10.5)]).unwrap();
    close(m.landmarks_mm.unwrap(), 0.25);
    close(m.max_mm, 0.0);
}

#[test]
fn other_grids_and_empty_masks_are_refused() {
    let (g, shifted) = (grid([4; 3], [1.0; 3]), Affine::scaled([1.0; 3], [0.1, 0.0, 0.0]).unwrap());
    let other = Grid::new([4; 3], shifted).unwrap();
    let truth = DenseField::zeros(g);
    let error = metrics(&DenseField::zeros(other), &truth, None, &[]).unwrap_err().to_string();
    assert!(error.contains("another grid"), "{error}");
    assert!(metrics(&truth, &truth, Some(&Volume::filled(other, 1)), &[]).is_err());
    let error = metrics(&truth, &truth, Some(&Volume::filled(g, 0)), &[]).unwrap_err().to_string();
    assert!(error.contains("mask"), "{error}");
}

#[test]
fn voxels_that_are_no_number_are_refused_where_errors_count_and_passed_over_elsewhere() {
    let g = grid([6, 4, 4], [1.0; 3]);
    let truth = DenseField::zeros(g);
    let holed = DenseField::from_fn(g, |p| if p.0[0] < 0.5 { [f64::NAN, 0.0, 0.0] } else { [0.0; 3] });
    let error = metrics(&holed, &truth, None, &[]).unwrap_err().to_string();
    assert!(error.contains("measured volume has 16 voxels that are NaN or infinite"), "{error}");
    let error = metrics(&truth, &holed, None, &[]).unwrap_err().to_string();
    assert!(error.contains("truth volume has 16 voxels"), "{error}");
    let mask = Volume::from_voxels(g, |_, p| u8::from(p.0[0] > 0.5));
    let m = metrics(&holed, &truth, Some(&mask), &[]).unwrap();
    assert!(m.voxels == 80 && m.mean_mm == 0.0 && m.grad_err_p95 == 0.0, "{m:?}");
}

#[test]
fn landmarks_outside_the_volume_are_found() {
    let g = grid([5, 5, 5], [2.0; 3]);
    let mark = |p: [f64; 3]| Landmark { initial: WorldPoint(p), deformed: WorldPoint([0.0; 3]) };
    let marks =
        [mark([0.0; 3]), mark([-0.9, 0.0, 0.0]), mark([-1.1, 0.0, 0.0]), mark([4.0, 4.0, 8.9]), mark([4.0, 9.1, 4.0])];
    assert_eq!(palpate::evaluate::beyond(&g, &marks), [2, 4]);
}

/// A stretch and its inverse lead back; what leaves the second grid is counted apart.
#[test]
fn there_and_back_again_is_no_motion() {
    let (here, there) = (grid([10, 4, 3], [1.0; 3]), grid([21, 5, 4], [1.0; 3]));
    let forward = DenseField::from_fn(here, |p| [p.0[0], 0.0, 0.0]);
    let back = |shift: f64| DenseField::from_fn(there, |p| [-0.5 * p.0[0] + shift, 0.0, 0.0]);
    let exact = inverse_consistency(&forward, &back(0.0), None).unwrap();
    assert_eq!((exact.voxels, exact.outside), (120, 0.0));
    assert!(exact.inverse_max_mm < 1e-6, "{exact:?}");
    let off = inverse_consistency(&forward, &back(0.25), None).unwrap();
    close(off.inverse_mean_mm, 0.25);
    close(off.inverse_p95_mm, 0.25);
    // Of the first grid the outer half ends past one of 10 voxels.
    let small = DenseField::from_fn(here, |p| [-0.5 * p.0[0], 0.0, 0.0]);
    close(inverse_consistency(&forward, &small, None).unwrap().outside, 0.5);
    let mask = Mask::from_voxels(here, |_, v| u8::from(v.0[0] > 6.0));
    assert!(inverse_consistency(&forward, &small, Some(&mask)).unwrap_err().to_string().contains("backward"));
}

#[test]
fn target_error_is_worked_out_by_hand() {
    let g = grid([9, 9, 9], [1.0; 3]);
    let field = DenseField::from_fn(g, |_| [1.0, 0.0, 0.0]);
    let mark = |x: f64, to: [f64; 3]| Landmark { initial: WorldPoint([x, 2.0, 2.0]), deformed: WorldPoint(to) };
    // Errors 0, 1, 4; before 1, 2, 5.
    let marks = [mark(1.0, [2.0, 2.0, 2.0]), mark(2.0, [4.0, 2.0, 2.0]), mark(3.0, [8.0, 2.0, 2.0])];
    let found = target_error(&field, &marks).unwrap();
    assert_eq!((found.count, found.each.len()), (3, 3));
    close(found.after.mean_mm, 5.0 / 3.0);
    close(found.after.median_mm, 1.0);
    close(found.after.p95_mm, 1.0 + 0.9 * 3.0);
    close(found.after.max_mm, 4.0);
    close(found.before.mean_mm, 8.0 / 3.0);
    close(found.before.max_mm, 5.0);
    close(found.each[1].error_mm, 1.0);
    close(found.each[1].before_mm, 2.0);
    assert!(target_error(&field, &[]).is_err());
    let holed = DenseField::from_fn(g, |p| if p.0[0] > 3.5 { [f64::NAN; 3] } else { [0.0; 3] });
    let error = target_error(&holed, &marks).unwrap_err().to_string();
    assert!(error.contains("at landmark 3"), "{error}");
}

/// An oblique, sheared grid with voxels of three sizes.
fn oblique(shape: [usize; 3]) -> Grid {
    let rows = [[0.9, -0.35, 0.1, 3.0], [0.4, 1.2, 0.0, -2.0], [-0.1, 0.3, 2.1, 5.0]];
    Grid::new(shape, Affine::new(rows).unwrap()).unwrap()
}

/// Surface distances as they are defined, each pair of surface voxels in turn: mean and 95th
/// percentile.
fn by_definition(g: &Grid, one: &[u8], other: &[u8], label: u8) -> [f64; 2] {
    let [nx, ny, nz] = g.shape().map(|n| n as isize);
    let surface = |map: &[u8]| {
        let is = |i: isize, j: isize, k: isize| {
            let within = (0..nx).contains(&i) && (0..ny).contains(&j) && (0..nz).contains(&k);
            within && map[(i + nx * (j + ny * k)) as usize] == label
        };
        let mut out = Vec::new();
        for (k, j, i) in (0..nz).flat_map(|k| (0..ny).flat_map(move |j| (0..nx).map(move |i| (k, j, i)))) {
            let whole = is(i - 1, j, k) && is(i + 1, j, k) && is(i, j - 1, k) && is(i, j + 1, k);
            if is(i, j, k) && !(whole && is(i, j, k - 1) && is(i, j, k + 1)) {
                out.push(g.world(i as usize, j as usize, k as usize).0);
            }
        }
        out
    };
    let (a, b) = (surface(one), surface(other));
    let apart = |p: &[f64; 3], q: &[f64; 3]| (0..3).map(|c| (p[c] - q[c]).powi(2)).sum::<f64>().sqrt();
    let least = |p: &[f64; 3], all: &[[f64; 3]]| all.iter().map(|q| apart(p, q)).fold(f64::INFINITY, f64::min);
    let mut all: Vec<f64> = a.iter().map(|p| least(p, &b)).chain(b.iter().map(|p| least(p, &a))).collect();
    all.sort_by(f64::total_cmp);
    let rank = 0.95 * (all.len() - 1) as f64;
    let (low, t) = (rank as usize, rank.fract());
    let p95 = all[low] + t * (all[(low + 1).min(all.len() - 1)] - all[low]);
    [all.iter().sum::<f64>() / all.len() as f64, p95]
}

#[test]
fn surface_distances_are_those_of_the_definition() {
    for g in [oblique([11, 9, 8]), grid([12, 10, 7], [0.5, 2.0, 1.3])] {
        // A cube, a ball cut by the grid's border, and scattered voxels.
        let ball = |at: [f64; 3], r: f64| {
            let inside = move |v: [usize; 3]| (0..3).map(|c| (v[c] as f64 - at[c]).powi(2)).sum::<f64>() < r * r;
            (0..g.len()).map(|o| u8::from(inside(g.voxel(o)))).collect::<Vec<_>>()
        };
        let cube = |from: usize, to: usize| -> Vec<u8> {
            (0..g.len()).map(|o| u8::from(g.voxel(o).iter().all(|v| (from..to).contains(v)))).collect()
        };
        let scattered: Vec<u8> = (0..g.len()).map(|o| u8::from((o * 7919) % 13 == 0)).collect();
        let maps = [cube(1, 6), cube(2, 7), ball([5.0, 4.0, 3.0], 3.2), ball([0.0, 4.0, 4.0], 4.0), scattered];
        for (a, b) in maps.iter().flat_map(|a| maps.iter().map(move |b| (a, b))) {
            let found = overlap(&g, a, b, 1);
            let [mean, p95] = by_definition(&g, a, b, 1);
            close(found.surface_mean_mm.unwrap(), mean);
            close(found.hausdorff95_mm.unwrap(), p95);
            let shared = a.iter().zip(b).filter(|(x, y)| **x == 1 && **y == 1).count() as f64;
            let sum: usize = a.iter().chain(b).map(|v| usize::from(*v)).sum();
            close(found.dice, 2.0 * shared / sum as f64);
        }
    }
}

#[test]
fn balls_and_boxes_are_as_far_apart_as_geometry_has_it() {
    // Two balls about one centre: every distance is the difference of the radii, to a third of a
    // voxel.
    let g = grid([60, 40, 48], [0.5, 0.75, 0.625]);
    let centre = [14.75, 14.625, 14.6875];
    let ball = |r: f64| -> Vec<u8> {
        let away = |o: usize| {
            let [i, j, k] = g.voxel(o);
            let p = g.world(i, j, k).0;
            (0..3).map(|c| (p[c] - centre[c]).powi(2)).sum::<f64>().sqrt()
        };
        (0..g.len()).map(|o| u8::from(away(o) <= r)).collect()
    };
    let found = overlap(&g, &ball(9.0), &ball(12.0), 1);
    assert!((found.surface_mean_mm.unwrap() - 3.0).abs() < 0.25, "{found:?}");
    assert!((found.hausdorff95_mm.unwrap() - 3.0).abs() < 0.5, "{found:?}");
    let expected = 2.0 * 729.0 / (729.0 + 1728.0);
    assert!((found.dice - expected).abs() < 0.01, "{found:?}");
    // A row of voxels moved along itself: its ends alone are surface.
    let row = grid([20, 1, 1], [0.7, 1.0, 1.0]);
    let at = |from: usize| -> Vec<u8> { (0..20).map(|i| u8::from((from..from + 10).contains(&i))).collect() };
    let found = overlap(&row, &at(2), &at(5), 1);
    close(found.surface_mean_mm.unwrap(), 2.1);
    close(found.hausdorff95_mm.unwrap(), 2.1);
    close(found.dice, 0.7);
    // What is nowhere has no surface.
    let none = overlap(&row, &at(2), &[0; 20], 1);
    assert_eq!((none.dice, none.surface_mean_mm, none.hausdorff95_mm), (0.0, None, None));
}

#[test]
fn labels_are_warped_from_any_grid_to_that_of_the_initial_map() {
    // Tissue at x goes to x + (4, 0, 0). Grids of field, initial and deformed map all differ.
    let field = DenseField::from_fn(grid([10, 10, 10], [4.0; 3]), |_| [4.0, 0.0, 0.0]);
    let boxes = |g: &Grid, shift: f64, labels: [u8; 2]| {
        Mask::from_voxels(*g, |_, p| {
            let [x, y, z] = p.0;
            let within = (8.0..24.0).contains(&y) && (8.0..24.0).contains(&z);
            match x - shift {
                x if within && (8.0..16.0).contains(&x) => labels[0],
                x if within && (16.0..24.0).contains(&x) => labels[1],
                _ => 0,
            }
        })
    };
    // Voxel centres at odd places, so that no border runs through one.
    let fine = Grid::new([40; 3], Affine::scaled([1.0; 3], [0.5; 3]).unwrap()).unwrap();
    let coarse = Grid::new([20; 3], Affine::scaled([2.0; 3], [1.0; 3]).unwrap()).unwrap();
    let found = label_scores(&field, &boxes(&fine, 0.0, [1, 2]), &boxes(&coarse, 4.0, [1, 2])).unwrap();
    assert_eq!(found.each.iter().map(|s| (s.label, s.voxels)).collect::<Vec<_>>(), [(1, 2048), (2, 2048)]);
    for s in &found.each {
        assert_eq!((s.after.dice, s.after.surface_mean_mm, s.after.hausdorff95_mm), (1.0, Some(0.0), Some(0.0)));
        close(s.before.dice, 0.5);
        assert!(s.before.hausdorff95_mm.unwrap() > 3.9 && s.before.hausdorff95_mm.unwrap() < 4.1, "{s:?}");
    }
    close(found.dice_mean, 1.0);
    close(found.dice_mean_before, 0.5);
    assert_eq!(found.outside, 0.0);
    // Labels of one map alone are named; those that leave the grid have no surface there.
    let found = label_scores(&field, &boxes(&fine, 0.0, [1, 3]), &boxes(&coarse, 4.0, [1, 2])).unwrap();
    assert_eq!((found.only_initial, found.only_deformed, found.each.len()), (vec![3], vec![2], 1));
    let far = DenseField::from_fn(grid([10, 10, 10], [4.0; 3]), |_| [-40.0, 0.0, 0.0]);
    let gone = label_scores(&far, &boxes(&fine, 0.0, [1, 2]), &boxes(&coarse, 4.0, [1, 2])).unwrap();
    assert_eq!((gone.each[0].after.dice, gone.each[0].after.surface_mean_mm), (0.0, None));
    assert!(label_scores(&field, &boxes(&fine, 0.0, [1, 1]), &boxes(&fine, 4.0, [2, 2])).is_err());
    // A field that is smaller than the map: its edge stands for it, and the share is told.
    let small = DenseField::from_fn(grid([3, 10, 10], [4.0; 3]), |_| [4.0, 0.0, 0.0]);
    let found = label_scores(&small, &boxes(&fine, 0.0, [1, 2]), &boxes(&fine, 4.0, [1, 2])).unwrap();
    close(found.dice_mean, 1.0);
    // Of 16 mm, those past 10 mm lie beyond its last voxel.
    close(found.outside, 14.0 / 16.0);
}
