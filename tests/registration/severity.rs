//! Troubled phantoms: what is made worse is made worse by as much as was asked for, and the truth
//! stays exact.

use palpate::numerics::differences::{deformation_gradient, displacement_gradient};
use palpate::synth::degradation::{disturbed, shifted_labels};
use palpate::synth::{MotionKind, Phantom, PhantomKind, PhantomParams, Trouble, phantom, troubled};
use palpate::types::space::{Matrix3, determinant, length};
use palpate::types::{DenseField, Grid, Mask, VoxelPoint, WorldPoint};

/// A small block without noise and bias.
fn clean(motion: MotionKind, amplitude: f64) -> PhantomParams {
    let base = PhantomParams::new(PhantomKind::Block).sized(32);
    PhantomParams { motion, amplitude, noise: 0.0, bias: 0.0, ..base }
}

/// deformed(x + u(x)) by trilinear interpolation.
fn carried(p: &Phantom, at: usize) -> f64 {
    let grid = p.initial.grid();
    let [i, j, k] = grid.voxel(at);
    let there = grid.world(i, j, k).moved(p.truth.at(at).map(f64::from));
    let VoxelPoint(q) = p.deformed.grid().affine().to_voxel(there);
    let low = q.map(f64::floor);
    let mut sum = 0.0;
    for corner in 0..8 {
        let bit = |a: usize| (corner >> a) & 1;
        let index: [usize; 3] = std::array::from_fn(|a| low[a] as usize + bit(a));
        let t: [f64; 3] = std::array::from_fn(|a| q[a] - low[a]);
        let weight: f64 = (0..3).map(|a| if bit(a) == 1 { t[a] } else { 1.0 - t[a] }).product();
        let [x, y, z] = index;
        sum += weight * f64::from(p.deformed.as_slice()[p.deformed.grid().index(x, y, z)]);
    }
    sum
}

/// Root mean square of deformed(x + u(x)) - initial(x) over the mask.
fn mismatch(p: &Phantom) -> f64 {
    let inside: Vec<usize> = (0..p.mask.as_slice().len()).filter(|&at| p.mask.as_slice()[at] != 0).collect();
    assert!(inside.len() > 1000);
    let square = |&at: &usize| (carried(p, at) - f64::from(p.initial.as_slice()[at])).powi(2);
    (inside.iter().map(square).sum::<f64>() / inside.len() as f64).sqrt()
}

/// Median of |deformed(x + u(x)) - initial(x)| over the mask: the body's outline, sharper than a
/// voxel, does not count.
fn median_mismatch(p: &Phantom) -> f64 {
    let inside = (0..p.mask.as_slice().len()).filter(|&at| p.mask.as_slice()[at] != 0);
    let mut off: Vec<f64> = inside.map(|at| (carried(p, at) - f64::from(p.initial.as_slice()[at])).abs()).collect();
    off.sort_by(f64::total_cmp);
    off[off.len() / 2]
}

#[test]
fn without_motion_every_look_is_the_same_in_both_volumes() {
    let base = clean(MotionKind::None, 0.0);
    for trouble in [
        Trouble::RepetitiveTexture,
        Trouble::NoTexture,
        Trouble::Crop,
        Trouble::StillRing,
        Trouble::BrightRepetition,
        Trouble::DarkRepetition,
    ] {
        let [low, high] = trouble.range();
        for severity in [low, 0.5 * (low + high)] {
            let p = troubled(&base, trouble, severity).unwrap();
            assert!(mismatch(&p) < 1e-2, "{trouble:?} {severity}: {}", mismatch(&p));
        }
    }
}

#[test]
fn a_pattern_and_an_even_ball_move_with_the_tissue() {
    let base = clean(MotionKind::Smooth, 3.0);
    for trouble in [Trouble::RepetitiveTexture, Trouble::NoTexture, Trouble::BrightRepetition, Trouble::DarkRepetition]
    {
        let mut p = troubled(&base, trouble, 60.0).unwrap();
        assert_eq!(p.truth, phantom(&base).unwrap().truth);
        let along = median_mismatch(&p);
        p.truth = DenseField::zeros(*p.truth.grid());
        // What is left along the truth is interpolation.
        let still = median_mismatch(&p);
        assert!(along < 0.5 * still, "{trouble:?}: {along} of {still}");
    }
}

#[test]
fn an_even_ball_holds_its_share_and_missing_tissue_leaves_the_mask() {
    let base = clean(MotionKind::Smooth, 3.0);
    let whole = phantom(&base).unwrap();
    let count = |m: &Mask| m.as_slice().iter().filter(|&&v| v != 0).count() as f64;
    let gone = troubled(&base, Trouble::MissingTissue, 30.0).unwrap();
    let left = count(&gone.mask) / count(&whole.mask);
    assert!((left - 0.7).abs() < 0.05, "{left}");
    let bright = |p: &Phantom| p.deformed.as_slice().iter().filter(|&&v| v > 100.0).count() as f64;
    let seen = bright(&gone) / bright(&whole);
    assert!((seen - 0.7).abs() < 0.05 && gone.initial == whole.initial, "{seen}");
    let even = troubled(&base, Trouble::NoTexture, 50.0).unwrap();
    let mut values: Vec<f32> = even.deformed.as_slice().to_vec();
    values.sort_by(f32::total_cmp);
    // Half of the tissue is of one grey: the densest tenth of the bright values is hardly wide at
    // all.
    let tissue: Vec<f32> = values.into_iter().filter(|v| *v > 100.0).collect();
    let width = |w: &[f32]| w[w.len() - 1] - w[0];
    let narrowest = tissue.windows(tissue.len() / 4).map(width).fold(f32::INFINITY, f32::min);
    assert!(narrowest < 20.0, "{narrowest}");
}

#[test]
fn a_wave_has_the_strain_that_was_asked_for() {
    for percent in [10.0, 50.0] {
        let p = troubled(&clean(MotionKind::None, 0.0), Trouble::Strain, percent).unwrap();
        let grid = *p.truth.grid();
        let largest = (0..grid.len())
            .map(|at| displacement_gradient(&p.truth, grid.voxel(at)))
            .map(|g| g.as_flattened().iter().map(|v| v * v).sum::<f64>().sqrt())
            .fold(0.0, f64::max);
        // Differences over two voxels flatten the crest of a wave of 16 voxels by 3 %.
        assert!((largest / (percent / 100.0) - 1.0).abs() < 0.05, "{percent}: {largest}");
        assert!(p.description.jacobian_min > 0.45);
    }
}

#[test]
fn thick_slices_are_means_of_thin_ones_with_the_truth_at_their_middle() {
    let base = clean(MotionKind::Smooth, 3.0);
    let [thin, thick] = [2.0, 8.0].map(|mm| troubled(&base, Trouble::SliceThickness, mm).unwrap());
    let (fine, coarse) = (*thin.initial.grid(), *thick.initial.grid());
    assert_eq!((fine.shape()[2], coarse.shape()[2]), (32, 8));
    assert!((coarse.spacing()[2] - 8.0).abs() < 1e-9);
    for [i, j, k] in [[12, 9, 3], [20, 22, 5]] {
        let at = coarse.index(i, j, k);
        let thin_at = |s: usize| fine.index(i, j, 4 * k + s);
        let mean = (0..4).map(|s| thin.initial.as_slice()[thin_at(s)]).sum::<f32>() / 4.0;
        assert!((thick.initial.as_slice()[at] - mean).abs() < 1e-2);
        for c in 0..3 {
            let middle = 0.5 * (thin.truth.at(thin_at(1))[c] + thin.truth.at(thin_at(2))[c]);
            assert!((thick.truth.at(at)[c] - middle).abs() < 1e-5);
            let place = 0.5 * (fine.world(i, j, 4 * k + 1).0[c] + fine.world(i, j, 4 * k + 2).0[c]);
            assert!((coarse.world(i, j, k).0[c] - place).abs() < 1e-9);
        }
    }
}

#[test]
fn contrast_and_view_change_as_told() {
    let base = clean(MotionKind::None, 0.0);
    let plain = phantom(&base).unwrap();
    let root = troubled(&base, Trouble::ContrastChange, 2.0).unwrap();
    let turned = troubled(&base, Trouble::ContrastInversion, 100.0).unwrap();
    for at in (0..plain.mask.as_slice().len()).filter(|&at| plain.mask.as_slice()[at] != 0) {
        let v = plain.deformed.as_slice()[at];
        assert!((root.deformed.as_slice()[at] - (1000.0 * v).sqrt()).abs() < 0.1);
        assert!((turned.deformed.as_slice()[at] - (1200.0 - v).max(0.0)).abs() < 0.1);
    }
    assert_eq!(root.initial, plain.initial);
    let half = troubled(&base, Trouble::Crop, 50.0).unwrap();
    assert_eq!(half.deformed.grid().shape(), [16, 32, 32]);
    let none = troubled(&base, Trouble::NoOverlap, 100.0).unwrap();
    assert!(none.mask.as_slice().iter().all(|&v| v == 0));
    for severity in [-1.0, 20.1, f64::NAN] {
        assert!(troubled(&base, Trouble::Noise, severity).is_err());
    }
}

#[test]
fn a_disturbed_field_is_off_by_as_much_as_was_asked_for() {
    let truth = phantom(&clean(MotionKind::Smooth, 3.0)).unwrap().truth;
    let off = disturbed(&truth, 0.2, 5);
    assert_eq!(off, disturbed(&truth, 0.2, 5));
    let difference = |f: &DenseField| -> Vec<f64> {
        f.as_slice().iter().zip(truth.as_slice()).map(|(a, b)| f64::from(a - b)).collect()
    };
    let e = difference(&off);
    let power = |v: &mut dyn Iterator<Item = f64>| {
        let (sum, n) = v.fold((0.0, 0.0), |(s, n), e| (s + e * e, n + 1.0));
        f64::sqrt(sum / n)
    };
    assert!((power(&mut e.iter().copied()) - 0.2).abs() < 1e-3);
    // Neighbours share most of their error, places five voxels apart hardly any.
    let apart = |step: usize| {
        let products = e.windows(step + 1).map(|w| w[0] * w[step]);
        products.sum::<f64>() / (e.len() - step) as f64 / 0.04
    };
    assert!(apart(1) > 0.8 && apart(6).abs() < 0.1, "{} {}", apart(1), apart(6));
}

#[test]
fn shifted_labels_keep_the_outline() {
    let p = phantom(&clean(MotionKind::None, 0.0)).unwrap();
    let labels = Mask::from_voxels(*p.mask.grid(), |at, x| p.mask.as_slice()[at] * (1 + u8::from(x.0[0] > 0.0)));
    let shifted = shifted_labels(&labels, 3);
    let outline = |m: &Mask| m.as_slice().iter().map(|&v| v != 0).collect::<Vec<_>>();
    assert_eq!(outline(&labels), outline(&shifted));
    let count = |m: &Mask, label| m.as_slice().iter().filter(|&&v| v == label).count();
    assert!(count(&shifted, 1) > count(&labels, 1) && count(&shifted, 2) < count(&labels, 2));
    assert_eq!(shifted_labels(&labels, 0), labels);
}

/// Middle and half the shorter side across z of a grid's field of view (mm).
fn middle(grid: &Grid) -> ([f64; 3], f64) {
    let centre = grid.affine().to_world(VoxelPoint(grid.shape().map(|n| (n - 1) as f64 / 2.0))).0;
    let sides: [f64; 2] = std::array::from_fn(|a| grid.shape()[a] as f64 * grid.spacing()[a]);
    (centre, sides[0].min(sides[1]) / 2.0)
}

/// Voxels of the mask with their places in the initial and in the deformed volume.
fn places(p: &Phantom) -> Vec<(usize, WorldPoint, WorldPoint)> {
    let grid = *p.truth.grid();
    let here = |at: usize| {
        let [i, j, k] = grid.voxel(at);
        grid.world(i, j, k)
    };
    let there = |at: usize| here(at).moved(p.truth.at(at).map(f64::from));
    (0..grid.len()).filter(|&at| p.mask.as_slice()[at] != 0).map(|at| (at, here(at), there(at))).collect()
}

fn gradient(p: &Phantom, at: usize) -> Matrix3 {
    deformation_gradient(displacement_gradient(&p.truth, p.truth.grid().voxel(at)))
}

/// How far `f` is from a rotation, and the angle of that (degrees).
fn rotation_of(f: &Matrix3) -> (f64, f64) {
    let product = |r: usize, c: usize| (0..3).map(|i| f[i][r] * f[i][c]).sum::<f64>();
    let off = (0..9).map(|n| (product(n / 3, n % 3) - f64::from(u8::from(n / 3 == n % 3))).abs()).fold(0.0, f64::max);
    (off, ((f[0][0] + f[1][1] + f[2][2] - 1.0) / 2.0).clamp(-1.0, 1.0).acos().to_degrees())
}

#[test]
fn a_ring_is_still_and_as_bright_as_asked_for_while_the_muscle_moves() {
    let base = clean(MotionKind::Smooth, 3.0);
    for ratio in [1.0, 3.0, 5.0] {
        let p = troubled(&base, Trouble::StillRing, ratio).unwrap();
        let (centre, half) = middle(p.truth.grid());
        let radius = |x: WorldPoint| (x.0[0] - centre[0]).hypot(x.0[1] - centre[1]) / half;
        let mean = |low: f64, high: f64| {
            let inside: Vec<usize> =
                places(&p).iter().filter(|v| (low..high).contains(&radius(v.1))).map(|v| v.0).collect();
            inside.iter().map(|&at| f64::from(p.deformed.as_slice()[at])).sum::<f64>() / inside.len() as f64
        };
        // The ring's texture has a mean of its own.
        let own = troubled(&base, Trouble::StillRing, 1.0).unwrap();
        for &(at, x, _) in places(&p).iter().filter(|v| radius(v.1) > 0.65) {
            assert_eq!(p.truth.at(at), [0.0; 3], "{x:?}");
            if (0.75..0.78).contains(&radius(x)) {
                let [now, then] = [&p, &own].map(|p| f64::from(p.deformed.as_slice()[at]));
                assert!((now - ratio * then).abs() <= 0.03 * now, "{now} {then}");
            }
        }
        assert!((0.7..1.4).contains(&(mean(0.7, 0.8) / mean(0.0, 0.55) / ratio)));
        assert!(p.description.jacobian_min > 0.3 && (p.description.max_mm - 3.0).abs() < 0.5);
        assert!(median_mismatch(&p) < 6.0, "{}", median_mismatch(&p));
    }
}

#[test]
fn hot_voxels_are_as_many_as_asked_for_and_the_rest_stays() {
    let base = clean(MotionKind::Smooth, 3.0);
    let plain = phantom(&base).unwrap();
    let top = plain.deformed.as_slice().iter().copied().fold(0.0, f32::max);
    let hot = |count: f64| -> Vec<usize> {
        let p = troubled(&base, Trouble::HotVoxels, count).unwrap();
        assert_eq!((&p.initial, &p.truth, &p.mask), (&plain.initial, &plain.truth, &plain.mask));
        let pairs = p.deformed.as_slice().iter().zip(plain.deformed.as_slice());
        let changed: Vec<usize> = pairs.enumerate().filter(|(_, (a, b))| a != b).map(|v| v.0).collect();
        assert!(changed.iter().all(|&at| p.deformed.as_slice()[at] == 30.0 * top));
        changed
    };
    let (few, many) = (hot(30.0), hot(100.0));
    assert_eq!((hot(0.0).len(), few.len(), many.len()), (0, 30, 100));
    assert!(few.iter().all(|at| many.contains(at)));
}

#[test]
fn a_bright_background_is_still_and_leaves_the_tissue() {
    let base = clean(MotionKind::Smooth, 3.0);
    let plain = phantom(&base).unwrap();
    for ratio in [1.0, 40.0] {
        let p = troubled(&base, Trouble::Background, ratio).unwrap();
        assert_eq!((&p.truth, &p.mask), (&plain.truth, &plain.mask));
        // Along the edges of the view, where the outline's soft border has all but ended.
        let at_end = |v: usize| !(2..30).contains(&v);
        let edge = |at: &usize| plain.initial.grid().voxel(*at).into_iter().filter(|&v| at_end(v)).count() >= 2;
        let behind: Vec<usize> = (0..plain.initial.grid().len()).filter(edge).collect();
        let level = 1000.0 * ratio as f32;
        for &at in &behind {
            let [a, b] = [&p.initial, &p.deformed].map(|v| v.as_slice()[at]);
            assert!((a - b).abs() <= 0.03 * level, "{a} {b}");
        }
        let mean = behind.iter().map(|&at| p.initial.as_slice()[at]).sum::<f32>() / behind.len() as f32;
        assert!((0.8..1.2).contains(&(mean / level)), "{mean}");
        let (centre, half) = middle(p.truth.grid());
        for (at, x, _) in places(&p) {
            if (0..3).all(|a| (x.0[a] - centre[a]).abs() < 0.5 * half) {
                let added = p.initial.as_slice()[at] - plain.initial.as_slice()[at];
                assert!(added < 1e-3 * level, "{added}");
            }
        }
    }
}

#[test]
fn an_organ_turns_as_one_body_inside_its_own_wall() {
    let radius = |p: &Phantom, x: WorldPoint| {
        let (centre, half) = middle(p.truth.grid());
        length(x.minus(WorldPoint(centre))) / half
    };
    for mm in [1.0, 10.0, 20.0] {
        let p = troubled(&clean(MotionKind::None, 0.0), Trouble::CurvedSliding, mm).unwrap();
        let angle = 2.0 * (0.5 * mm / (0.45 * 32.0)).asin().to_degrees();
        for (at, x, y) in places(&p) {
            let [before, after] = [x, y].map(|x| radius(&p, x));
            assert!((before - after).abs() < 1e-6 && (before < 0.45 || x == y), "{before} {after}");
            if before < 0.38 {
                let (off, turned) = rotation_of(&gradient(&p, at));
                assert!(off < 1e-4 && (turned - angle).abs() < 0.01, "{off} {turned} {angle}");
            }
        }
        assert!(p.description.max_mm <= mm && p.description.max_mm > 0.95 * mm);
        // With the motion of everything, no place changes sides and nothing folds off the wall.
        let p = troubled(&clean(MotionKind::Smooth, 3.0), Trouble::CurvedSliding, mm).unwrap();
        let carried = phantom(&clean(MotionKind::Smooth, 3.0)).unwrap();
        for (at, x, y) in places(&p) {
            let plain = radius(&p, x.moved(carried.truth.at(at).map(f64::from)));
            assert!((radius(&p, y) - plain).abs() < 1e-6);
            if (plain - 0.45).abs() > 0.1 {
                assert!(determinant(&gradient(&p, at)) > 0.1);
            }
        }
    }
}

#[test]
fn a_joint_turns_one_bone_as_one_body_and_folds_nowhere() {
    for degrees in [1.0, 20.0, 40.0] {
        let p = troubled(&clean(MotionKind::Smooth, 3.0), Trouble::Joint, degrees).unwrap();
        let (centre, half) = middle(p.truth.grid());
        let (mut still, mut turned) = (0, 0);
        for (at, x, _) in places(&p) {
            let along = (x.0[1] - centre[1]) / half;
            // Beside the bones' common axis, which is tilted by up to 5 degrees.
            if (x.0[0] - centre[0] + 0.25 * half).hypot(x.0[2] - centre[2]) > 0.05 * half || along.abs() < 0.45 {
                continue;
            }
            let (off, angle) = rotation_of(&gradient(&p, at));
            assert!(off < 1e-4, "{along} {off}");
            if along > 0.0 {
                assert!(p.truth.at(at).iter().all(|u| u.abs() < 1e-9));
                still += 1;
            } else {
                assert!((angle - degrees).abs() < 0.01, "{angle}");
                turned += 1;
            }
        }
        assert!(still > 20 && turned > 20, "{still} {turned}");
        let least = 1.0 - degrees / 40.0 * 0.6;
        assert!(p.description.jacobian_min > least, "{degrees}: {}", p.description.jacobian_min);
        assert!(median_mismatch(&p) < 10.0, "{}", median_mismatch(&p));
    }
}

#[test]
fn contrast_turns_over_on_the_right_alone() {
    let base = clean(MotionKind::None, 0.0);
    let plain = phantom(&base).unwrap();
    for percent in [50.0, 100.0] {
        let p = troubled(&base, Trouble::LocalContrast, percent).unwrap();
        assert_eq!(p.initial, plain.initial);
        let (centre, half) = middle(p.truth.grid());
        for (at, x, _) in places(&p) {
            let (v, seen) = (plain.deformed.as_slice()[at], p.deformed.as_slice()[at]);
            let inverted = v + percent as f32 / 100.0 * (1200.0 - 2.0 * v);
            let right = (x.0[0] - centre[0]) / half;
            let expected = if right < 0.0 { v } else { inverted.max(0.0) };
            assert!(right.abs() < 0.6 || (seen - expected).abs() < 5.0, "{right}: {seen} {expected}");
        }
    }
}

#[test]
fn repetition_stays_in_the_bright_or_in_the_dark_half() {
    let base = clean(MotionKind::None, 0.0);
    let plain = phantom(&base).unwrap();
    for (trouble, bright) in [(Trouble::BrightRepetition, true), (Trouble::DarkRepetition, false)] {
        let [none, all] = [0.0, 100.0].map(|percent| troubled(&base, trouble, percent).unwrap());
        let everywhere = troubled(&base, Trouble::RepetitiveTexture, 100.0).unwrap();
        let (centre, half) = middle(none.truth.grid());
        for (at, x, _) in places(&none) {
            let right = (x.0[0] - centre[0]) / half;
            if right.abs() < 0.2 {
                continue;
            }
            let gain = if right > 0.0 { 1.0 } else { 0.25 };
            let own = gain * plain.initial.as_slice()[at];
            assert!((none.initial.as_slice()[at] - own).abs() < 1.0);
            let expected = if (right > 0.0) == bright { gain * everywhere.initial.as_slice()[at] } else { own };
            assert!((all.initial.as_slice()[at] - expected).abs() < 1.0);
        }
    }
}

#[test]
fn every_scene_can_be_had_on_every_body_and_in_one_slice() {
    for kind in [PhantomKind::Head, PhantomKind::Calf, PhantomKind::Slice] {
        let base = PhantomParams::new(kind).sized(32);
        for trouble in [Trouble::StillRing, Trouble::CurvedSliding, Trouble::Joint] {
            for severity in trouble.range() {
                let p = troubled(&base, trouble, severity).unwrap();
                let moves = p.description.mean_mm > 0.0 && p.description.mask_voxels > 200;
                assert!(
                    moves && (trouble == Trouble::CurvedSliding || p.description.jacobian_min > 0.1),
                    "{trouble:?}"
                );
                let normal = p.truth.grid().is_single_slice();
                assert!(!normal || places(&p).iter().all(|(at, ..)| p.truth.at(*at)[2].abs() < 1e-5));
            }
        }
    }
    let small = PhantomParams::new(PhantomKind::Fingertip).sized(24).moving(MotionKind::Smooth);
    assert!(troubled(&small, Trouble::CurvedSliding, 20.0).is_err());
}
