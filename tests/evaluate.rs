//! Scores of small fields, worked out by hand.
#![allow(clippy::unwrap_used)]

use palpate::evaluate::{inverse_consistency, landmarks, metrics};
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
