//! Troubled phantoms: what is made worse is made worse by as much as was asked for, and the truth
//! stays exact.
#![allow(clippy::unwrap_used)]

use palpate::numerics::differences::displacement_gradient;
use palpate::synth::severity::{disturbed, shifted_labels};
use palpate::synth::{MotionKind, Phantom, PhantomKind, PhantomParams, Trouble, phantom, troubled};
use palpate::types::{DenseField, Mask, VoxelPoint};

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
    for trouble in [Trouble::RepetitiveTexture, Trouble::NoTexture, Trouble::Crop] {
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
    for trouble in [Trouble::RepetitiveTexture, Trouble::NoTexture] {
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
