//! Sampling, warping, Jacobian, inverse and composition against closed forms.

use palpate::field::composition::compose;
use palpate::field::inverse::invert;
use palpate::field::jacobian::{count_folds, determinant_at, jacobian_determinant};
use palpate::field::warp::{warp_image, warp_labels, warp_points};
use palpate::numerics::sampling::{Interpolation, Sampler, nearest};
use palpate::types::space::{Matrix3, determinant};
use palpate::types::{Affine, DenseField, Grid, Mask, Volume, VoxelPoint, WorldPoint};

/// An oblique, anisotropic, left-handed grid.
fn oblique(shape: [usize; 3]) -> Grid {
    let rows = [[-0.96, 0.30, 0.4, 11.0], [0.28, 1.10, -0.3, -7.0], [0.1, 0.2, 2.4, 3.0]];
    Grid::new(shape, Affine::new(rows).unwrap()).unwrap()
}

fn cube(n: usize, side_mm: f64) -> Grid {
    let h = side_mm / n as f64;
    Grid::new([n; 3], Affine::scaled([h; 3], [0.5 * h; 3]).unwrap()).unwrap()
}

fn image(grid: Grid, f: impl Fn([f64; 3]) -> f64 + Sync) -> Volume {
    Volume::from_voxels(grid, |_, p| f(p.0) as f32)
}

/// A band-limited function of world position (mm).
fn waves(p: [f64; 3]) -> f64 {
    100.0
        + 20.0 * (0.31 * p[0] + 0.2 * p[1]).sin()
        + 15.0 * (0.27 * p[1] - 0.15 * p[2]).cos()
        + 10.0 * (0.2 * p[2]).sin()
}

fn swirl(p: WorldPoint) -> [f64; 3] {
    let [x, y, z] = p.0;
    [1.6 * (0.21 * y).sin(), 1.2 * (0.17 * z + 0.1 * x).cos(), 0.9 * (0.19 * x).sin()]
}

fn linear(m: Matrix3, t: [f64; 3]) -> impl Fn(WorldPoint) -> [f64; 3] {
    move |p| std::array::from_fn(|r| (0..3).map(|c| m[r][c] * p.0[c]).sum::<f64>() + t[r])
}

const M: Matrix3 = [[0.05, -0.08, 0.02], [0.11, -0.04, 0.03], [-0.02, 0.06, 0.09]];

#[test]
fn samples_are_reproduced_by_every_interpolation() {
    let v = image(oblique([7, 6, 5]), |p| waves(p.map(|c| 3.0 * c)));
    for how in ["nearest", "linear", "cubic"] {
        let sampler = Sampler::new(&v, how.parse().unwrap(), -1.0);
        for at in 0..v.grid().len() {
            let p = VoxelPoint(v.grid().voxel(at).map(|c| c as f64));
            assert!((sampler.at(p) - v.as_slice()[at]).abs() < 1e-3, "{how} at {p:?}");
        }
    }
}

/// One voxel without a number made nearly all of a warped volume NaN: the prefilter of cubic
/// interpolation carried it along every axis.
#[test]
fn a_voxel_without_a_number_spoils_its_neighbours_alone() {
    let whole = image(cube(12, 12.0), waves);
    let mut holed = whole.clone();
    let g = *whole.grid();
    holed.as_mut_slice()[g.index(5, 6, 7)] = f32::NAN;
    holed.as_mut_slice()[g.index(0, 0, 0)] = f32::INFINITY;
    let still = DenseField::from_fn(g, |_| [0.3, -0.2, 0.4]);
    let [a, b] = [&whole, &holed].map(|v| warp_image(v, &still, None, Interpolation::Cubic, 0.0));
    let linear = warp_image(&holed, &still, None, Interpolation::Linear, 0.0);
    let mut lost = 0;
    for (at, (a, b)) in a.as_slice().iter().zip(b.as_slice()).enumerate() {
        let v = g.voxel(at);
        assert_eq!(b.is_finite(), linear.as_slice()[at].is_finite(), "{v:?}");
        lost += usize::from(!b.is_finite());
        // What was filled in reaches as far as the spline does.
        let far = |hole: [usize; 3]| (0..3).any(|a| v[a].abs_diff(hole[a]) > 6);
        assert!(!(far([5, 6, 7]) && far([0, 0, 0])) || (a - b).abs() < 0.05, "{v:?}: {a} {b}");
    }
    assert!((8..=16).contains(&lost), "{lost}");
    let centres = Sampler::owning(holed, 0.0).at_centres();
    assert_eq!(centres.iter().filter(|v| !v.is_finite()).count(), 2);
}

#[test]
fn a_position_is_clamped_within_half_a_voxel_and_background_beyond() {
    let v = image(cube(6, 6.0), |p| p[0]);
    for how in [Interpolation::Nearest, Interpolation::Linear, Interpolation::Cubic] {
        let sampler = Sampler::new(&v, how, -9.0);
        assert!((sampler.at(VoxelPoint([-0.49, 2.0, 2.0])) - 0.5).abs() < 1e-4);
        assert!((sampler.at(VoxelPoint([5.49, 5.49, 2.0])) - 5.5).abs() < 1e-4);
        for outside in [[-0.51, 2.0, 2.0], [2.0, 5.51, 2.0], [2.0, 2.0, 1e300], [f64::NAN, 0.0, 0.0]] {
            assert_eq!(sampler.at(VoxelPoint(outside)), -9.0);
        }
    }
    assert_eq!(nearest([3, 4, 5], VoxelPoint([2.4, 0.6, -0.4])), Some(2 + 3));
}

#[test]
fn one_slice_and_one_voxel_volumes_can_be_sampled() {
    let slice = image(Grid::new([9, 8, 1], *oblique([9, 8, 1]).affine()).unwrap(), |p| p[0]);
    let one = Volume::filled(oblique([1, 1, 1]), 4.0);
    for how in [Interpolation::Nearest, Interpolation::Linear, Interpolation::Cubic] {
        let sampler = Sampler::new(&slice, how, -1.0);
        let (centre, off) = (sampler.at(VoxelPoint([4.3, 3.2, 0.0])), sampler.at(VoxelPoint([4.3, 3.2, 0.45])));
        assert_eq!(centre, off);
        assert_eq!(sampler.at(VoxelPoint([4.3, 3.2, 0.6])), -1.0);
        assert!((Sampler::new(&one, how, -1.0).at(VoxelPoint([0.2, -0.3, 0.1])) - 4.0).abs() < 1e-6);
    }
    let two = Volume::from_vec(Grid::new([2, 1, 1], *one.grid().affine()).unwrap(), vec![1.0, 3.0]).unwrap();
    assert!((Sampler::new(&two, Interpolation::Cubic, 0.0).at(VoxelPoint([0.5, 0.0, 0.0])) - 2.0).abs() < 1e-5);
}

/// Root-mean-square error of a warp of an analytic image over the middle third, clear of the
/// borders.
fn warp_error(n: usize, how: Interpolation) -> f64 {
    let grid = cube(n, 48.0);
    let field = DenseField::from_fn(grid, swirl);
    let warped = warp_image(&image(grid, waves), &field, None, how, 0.0);
    let inner = (0..grid.len()).filter(|&at| grid.voxel(at).iter().all(|&v| v >= n / 3 && v < n - n / 3));
    let errors: Vec<f64> = inner
        .map(|at| {
            let [i, j, k] = grid.voxel(at);
            let x = grid.world(i, j, k);
            f64::from(warped.as_slice()[at]) - waves(x.moved(swirl(x)).0)
        })
        .collect();
    (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt()
}

/// The cubic spline passes through its samples: filtering the coefficients back gives them, on axes
/// of any length.
#[test]
fn values_at_voxel_centres_are_the_volume_again() {
    for shape in [[1, 1, 1], [2, 1, 3], [7, 2, 1], [9, 8, 7], [33, 5, 2]] {
        let grid = oblique(shape);
        let value = |o: usize| ((o * 7919 + 13) % 101) as f32 - 50.0;
        let volume = Volume::from_vec(grid, (0..grid.len()).map(value).collect()).unwrap();
        for how in [Interpolation::Linear, Interpolation::Cubic] {
            let sampler = Sampler::new(&volume, how, 0.0);
            let there: Vec<f32> =
                (0..grid.len()).map(|o| sampler.at(VoxelPoint(grid.voxel(o).map(|i| i as f64)))).collect();
            let all = sampler.at_centres();
            for (o, (a, b)) in all.iter().zip(&there).enumerate() {
                assert!(
                    (a - value(o)).abs() < 2e-4 && (a - b).abs() < 2e-4,
                    "{shape:?} {o}: {a}, {b} for {}",
                    value(o)
                );
            }
        }
    }
}

#[test]
fn a_warp_converges_with_the_order_of_its_interpolation() {
    for (how, order) in [(Interpolation::Nearest, 1.0), (Interpolation::Linear, 2.0), (Interpolation::Cubic, 4.0)] {
        let rate = (warp_error(24, how) / warp_error(48, how)).log2();
        assert!((rate - order).abs() < 0.35, "{how:?}: order {rate:.2}, expected {order}");
    }
}

#[test]
fn a_warp_gives_the_same_world_result_on_any_grid() {
    // The same analytic image on three lattices, read at the same world places.
    let reference = cube(9, 12.0);
    let straight = Grid::new([40; 3], Affine::scaled([0.7; 3], [-8.0; 3]).unwrap()).unwrap();
    let flipped = Grid::new([40, 40, 24], Affine::scaled([-0.7, 0.7, 1.2], [20.0, -8.0, -8.0]).unwrap()).unwrap();
    let tilted = [[-0.62, 0.2, 0.1, 16.0], [0.25, 0.65, 0.15, -15.0], [0.1, -0.12, 0.9, -9.0]];
    let tilted = Grid::new([50, 60, 34], Affine::new(tilted).unwrap()).unwrap();
    for grid in [straight, flipped, tilted] {
        let field = DenseField::from_fn(grid, swirl);
        let out = warp_image(&image(grid, waves), &field, Some(&reference), Interpolation::Cubic, f32::NAN);
        for at in 0..reference.len() {
            let [i, j, k] = reference.voxel(at);
            let x = reference.world(i, j, k);
            let error = f64::from(out.as_slice()[at]) - waves(x.moved(swirl(x)).0);
            assert!(error.abs() < 0.15, "{grid:?}: {error}");
        }
    }
}

#[test]
fn labels_by_nearest_keep_the_label_set() {
    let grid = oblique([20, 18, 12]);
    let labels: Mask = Volume::from_voxels(grid, |at, _| [0, 3, 7, 200][at * 2654435761 % 4]);
    let out = warp_labels(&labels, &DenseField::from_fn(grid, swirl), None, 0);
    assert!(out.as_slice().iter().all(|v| [0, 3, 7, 200].contains(v)));
    assert_ne!(out, labels);
    assert_eq!(warp_labels(&labels, &DenseField::zeros(grid), None, 9), labels);
}

#[test]
fn points_move_by_the_field_and_say_when_they_are_off_it() {
    let grid = oblique([10, 11, 6]);
    let motion = linear(M, [1.0, -2.0, 0.5]);
    let field = DenseField::from_fn(grid, &motion);
    let inside = grid.affine().to_world(VoxelPoint([3.3, 7.1, 2.6]));
    let off = grid.affine().to_world(VoxelPoint([3.3, 7.1, 5.6]));
    let moved = warp_points(&[inside, off], &field);
    assert!(moved[0].unwrap().minus(inside.moved(motion(inside))).iter().all(|d| d.abs() < 1e-5));
    assert_eq!(moved[1], None);
}

#[test]
fn the_jacobian_of_an_affine_field_is_its_determinant() {
    let f: Matrix3 = std::array::from_fn(|r| std::array::from_fn(|c| M[r][c] + f64::from(u8::from(r == c))));
    let grid = oblique([9, 8, 7]);
    let jacobian = jacobian_determinant(&DenseField::from_fn(grid, linear(M, [0.3, 0.0, -0.2])));
    for j in jacobian.as_slice() {
        assert!((f64::from(*j) - determinant(&f)).abs() < 1e-6, "{j} is not {}", determinant(&f));
    }
}

#[test]
fn a_single_slice_has_the_determinant_of_its_plane() {
    let rows = [[0.8, 0.0, 0.6, 5.0], [0.0, 1.5, 0.0, 1.0], [-0.6, 0.0, 0.8, 2.0]];
    let grid = Grid::new([12, 10, 1], Affine::new(rows).unwrap()).unwrap();
    // In the plane: stretch by 1.2 along its first axis, 0.7 along its second.
    let stretch = |p: WorldPoint| {
        let d = p.minus(WorldPoint([5.0, 1.0, 2.0]));
        let along = 0.8 * d[0] - 0.6 * d[2];
        [0.2 * along * 0.8, -0.3 * d[1], 0.2 * along * -0.6]
    };
    for j in jacobian_determinant(&DenseField::from_fn(grid, stretch)).as_slice() {
        assert!((j - 0.84).abs() < 1e-5);
    }
}

#[test]
fn folds_are_counted_inside_the_mask() {
    let grid = cube(8, 8.0);
    let field = DenseField::from_fn(grid, |p| if p.0[0] > 4.0 { [-2.0 * p.0[0] + 8.0, 0.0, 0.0] } else { [0.0; 3] });
    let jacobian = jacobian_determinant(&field).into_vec();
    assert!((0..grid.len()).all(|at| determinant_at(&field, at) == jacobian[at]));
    let mask = Volume::from_voxels(grid, |_, p| u8::from(p.0[2] < 2.0));
    // x = 5, 6, 7 fold (slope -2); x = 4 has the mean of slopes -1 (from 3.5 to 4.5) and -2.
    let all = count_folds(&field, None).unwrap();
    assert_eq!(all, 4 * 64);
    assert_eq!(all, jacobian.iter().filter(|&&j| j <= 0.0).count());
    assert_eq!(count_folds(&field, Some(&mask)).unwrap(), all / 4);
    assert!(count_folds(&field, Some(&Volume::filled(cube(7, 8.0), 1))).is_err());
}

#[test]
fn the_inverse_of_a_translation_and_of_an_affine_field_is_exact() {
    let grid = oblique([14, 12, 9]);
    let inverse = invert(&DenseField::from_fn(grid, |_| [1.25, -0.5, 2.0]), None);
    assert!((0..grid.len()).all(|at| inverse.field.at(at) == [-1.25, 0.5, -2.0]));

    let motion = linear(M, [0.3, -0.4, 0.2]);
    let inverse = invert(&DenseField::from_fn(grid, &motion), None);
    assert!(inverse.max_residual_mm < 2e-5, "{}", inverse.max_residual_mm);
    // v(x + u(x)) = -u(x) where x + u(x) falls between voxels: v of an affine field is affine, so
    // linear is exact.
    let x = grid.affine().to_world(VoxelPoint([6.4, 5.7, 4.2]));
    let back = warp_points(&[x.moved(motion(x))], &inverse.field)[0].unwrap();
    assert!(back.minus(x).iter().all(|d| d.abs() < 1e-4));
}

#[test]
fn the_inverse_converges_where_the_plain_fixed_point_does_not() {
    // Slope 2.5 > 1: the fixed point diverges, the Jacobian is 3.5 and the map is invertible.
    let grid = cube(32, 32.0);
    let field = DenseField::from_fn(grid, |p| [2.5 * (p.0[0] - 16.0), 0.0, 0.0]);
    let inverse = invert(&field, None);
    assert!(inverse.max_residual_mm < 1e-4, "{}", inverse.max_residual_mm);
    let at = grid.index(23, 5, 5);
    assert!((f64::from(inverse.field.at(at)[0]) + 2.5 / 3.5 * 7.5).abs() < 1e-4);
}

/// Each y of a folding field may have an x to which it leads back, and the residual is nil.
#[test]
fn a_field_that_folds_is_said_to_though_each_place_leads_back() {
    let grid = Grid::new([40, 6, 6], Affine::scaled([1.0; 3], [0.0; 3]).unwrap()).unwrap();
    let wave = |size: f64| DenseField::from_fn(grid, move |p| [size * (p.0[0] / 2.0).sin(), 0.0, 0.0]);
    let [mild, folding] = [1.0, 6.0].map(|size| invert(&wave(size), None));
    assert_eq!((mild.folds, mild.not_finite), (0, 0));
    assert!(folding.folds > 10 * 36, "{}", folding.folds);
    let mut holed = wave(1.0);
    holed.as_mut_slice()[100] = f32::NAN;
    assert_eq!(invert(&holed, None).not_finite, 1);
}

#[test]
fn a_field_then_its_inverse_is_no_motion() {
    let grid = cube(40, 40.0);
    let field = DenseField::from_fn(grid, swirl);
    let inverse = invert(&field, None);
    assert!(inverse.max_residual_mm < 1e-4);
    let round_trip = compose(&inverse.field, &field);
    let largest = (0..grid.len())
        .filter(|&at| grid.voxel(at).iter().all(|v| (3..37).contains(v)))
        .flat_map(|at| round_trip.at(at))
        .fold(0.0f32, |m, v| m.max(v.abs()));
    assert!(largest < 1e-4, "{largest}");
}

#[test]
fn composition_applies_the_first_then_the_second() {
    let grid = oblique([12, 12, 8]);
    let (a, b) = (linear(M, [0.3, 0.1, 0.0]), linear(M.map(|r| r.map(|v| -0.7 * v)), [-0.2, 0.4, 0.1]));
    let both = compose(&DenseField::from_fn(grid, &a), &DenseField::from_fn(grid, &b));
    let [i, j, k] = [5, 6, 4];
    let x = grid.world(i, j, k);
    let expected = x.moved(a(x)).moved(b(x.moved(a(x)))).minus(x);
    let found = both.at(grid.index(i, j, k));
    assert!((0..3).all(|c| (f64::from(found[c]) - expected[c]).abs() < 1e-5));
    // Beyond the second field's grid its edge value holds.
    let far = DenseField::from_fn(grid, |_| [500.0, 0.0, 0.0]);
    let constant = DenseField::from_fn(grid, |_| [1.0, 2.0, 3.0]);
    assert_eq!(compose(&far, &constant).at(0), [501.0, 2.0, 3.0]);
}

#[test]
fn an_unknown_interpolation_is_answered_with_the_nearest_name() {
    let error = "linaer".parse::<Interpolation>().unwrap_err().to_string();
    assert_eq!(error, "unknown interpolation 'linaer', did you mean 'linear'?; known: nearest, linear, cubic, label");
    assert!(!"zzz".parse::<Interpolation>().unwrap_err().to_string().contains("did you mean"));
}
