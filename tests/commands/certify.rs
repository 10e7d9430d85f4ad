//! What a scan can measure, against scans of which that is known.

use crate::fixtures::{run, small_pair};
use palpate::io;
use palpate::numerics::random::Random;
use palpate::pipeline::certify::{self, Certified, CertifyInput};
use palpate::pipeline::field;
use palpate::report::certify::headline;
use palpate::synth::imposed::{Star, imposed, with_noise};
use palpate::types::params::ModelSource;
use palpate::types::{Affine, FieldParams, Grid, Mask, Volume};
use std::f64::consts::TAU;

/// A small volume: to certify one takes several registrations.
const SMALL: [usize; 3] = [36, 33, 30];

/// Waves of several lengths in every direction, which any displacement shows in; half of the volume
/// is plain where `half` holds.
fn texture(shape: [usize; 3], half: bool) -> Volume {
    let grid = Grid::new(shape, Affine::scaled([0.5; 3], [0.0; 3]).unwrap()).unwrap();
    let mut random = Random::new(9, 1);
    let waves: Vec<[f64; 4]> = (0..60)
        .map(|_| {
            let [a, b] = random.normals();
            let [c, phase] = random.normals();
            [1.1 * a, 1.1 * b, 1.1 * c, TAU * phase]
        })
        .collect();
    Volume::from_voxels(grid, |_, p| {
        let shown = if half && p.0[0] > 0.25 * shape[0] as f64 { 0.0 } else { 1.0 };
        let sum: f64 = waves.iter().map(|w| (w[0] * p.0[0] + w[1] * p.0[1] + w[2] * p.0[2] + w[3]).cos()).sum();
        (100.0 + shown * 4.0 * sum) as f32
    })
}

fn certified(initial: &Volume, second: Option<&Volume>, params: &FieldParams) -> Certified {
    let mask = Mask::filled(*initial.grid(), 1);
    let input = CertifyInput { initial, second, mask: Some(&mask), like: None };
    certify::run(input, params, &|_, _| {}).unwrap()
}

/// A repeat scan gives the noise that two scans have; the displacement noise that it states is what
/// the same settings leave of two other scans at rest.
#[test]
fn a_repeat_scan_gives_the_noise_of_two_scans() {
    let params = FieldParams::default();
    let clean = texture(SMALL, false);
    let [first, second, third] = [1, 2, 3].map(|seed| with_noise(&clean, 3.0, seed));
    let found = certified(&first, Some(&second), &params).certificate;
    assert!((found.image_noise / 3.0 - 1.0).abs() < 0.05, "{}", found.image_noise);
    let free = FieldParams { model: ModelSource::Free, ..params };
    let at_rest = field::run(&first, &third, None, &free, &|_, _| {}).unwrap();
    let squares: f64 = at_rest.displacement.as_slice().iter().map(|v| f64::from(v * v)).sum();
    let noise = (squares / at_rest.displacement.as_slice().len() as f64).sqrt();
    let ratio = found.displacement_noise_mm / noise;
    assert!((0.5..2.5).contains(&ratio), "{} mm for {noise} mm", found.displacement_noise_mm);
    // What is known of noise: less over a longer gauge, and long waves come back.
    let strain: Vec<f64> = found.strain_noise_by_gauge.iter().map(|g| g.noise).collect();
    assert!(strain.is_sorted_by(|a, b| a > b) && strain.len() > 3, "{strain:?}");
    let longest = found.gains.last().unwrap();
    assert!((0.9..1.1).contains(&longest.gain), "{longest:?}");
    assert!(found.wavelength_50_mm <= found.wavelength_90_mm, "{found:?}");
    for imposed in &found.imposed {
        assert!(imposed.error_mm < 0.25, "{imposed:?}");
        assert!(imposed.strain_held > 0.8, "{imposed:?}");
    }
}

#[test]
fn tissue_without_texture_is_blind() {
    let volume = with_noise(&texture(SMALL, true), 2.0, 1);
    let found = certified(&volume, None, &FieldParams::default());
    let grid = *volume.grid();
    let mean = |plain: bool| {
        let side =
            (0..grid.len()).filter(|&at| (grid.voxel(at)[0] > 25) == plain && !(11..25).contains(&grid.voxel(at)[0]));
        let values: Vec<f64> = side.map(|at| found.detectable.as_slice()[at].into()).collect();
        values.iter().sum::<f64>() / values.len() as f64
    };
    assert!(mean(true) > 3.0 * mean(false), "{} and {} mm", mean(true), mean(false));
    assert!((0.1..0.7).contains(&found.certificate.blind_share), "{}", found.certificate.blind_share);
}

/// The volume is sampled where the motion says, so a free field finds it.
#[test]
fn an_imposed_motion_is_the_truth() {
    let volume = texture([48, 44, 40], false);
    let grid = *volume.grid();
    let star = Star::over(&Mask::filled(grid, 1), [0, 1, 2], 0.25);
    assert_eq!(star.wavelength(0.0), 2.0);
    assert!((star.wavelength(43.0) - 16.0).abs() < 1e-9);
    let truth = star.field(&grid);
    let moved = imposed(&volume, &truth);
    // Sampled by a cubic spline it is that of the texture itself, away from the faces.
    let exact = texture([48, 44, 40], false);
    let inner = |at: &usize| (0..3).all(|a| (4..grid.shape()[a] - 4).contains(&grid.voxel(*at)[a]));
    let still = imposed(&volume, &palpate::types::DenseField::zeros(grid));
    for at in (0..grid.len()).filter(inner) {
        assert!((still.as_slice()[at] - exact.as_slice()[at]).abs() < 1e-2);
        assert!(moved.as_slice()[at].is_finite());
    }
}

#[test]
fn the_command_writes_a_certificate_and_refuses_other_grids() {
    let folder = small_pair();
    let arguments =
        ["certify", "initial.nii.gz", "--mask", "mask.nii.gz", "--like", "truth.nii.gz", "-o", "c", "--quiet"];
    let (out, _) = run(folder.path(), &arguments, 0);
    assert!(out.starts_with("Strain to ± ") && out.contains(" features smaller than "), "{out}");
    let found = io::read_json(folder.path().join("c/certificate.json")).unwrap();
    for key in ["displacement_noise_mm", "strain_noise_by_gauge", "gauge_mm", "wavelength_50_mm", "blind_share"] {
        assert!(!found[key].is_null(), "{key}");
    }
    assert_eq!(found["imposed"].as_array().unwrap().len(), 3);
    assert!(folder.path().join("c/report.html").is_file() && folder.path().join("c/detectable.nii.gz").is_file());
    run(folder.path(), &["phantom", "block", "--size", "24", "-o", "other", "--quiet"], 0);
    let (_, error) = run(folder.path(), &["certify", "initial.nii.gz", "other/initial.nii.gz", "-o", "d"], 1);
    assert!(error.contains("other/initial.nii.gz is on another grid"), "{error}");
    assert!(!folder.path().join("d").exists());
}

/// A slice is certified in its plane, where its rows are short; noise alone is said to measure
/// nothing.
#[test]
fn a_slice_is_certified_and_noise_is_not() {
    let (grid, deep) = (
        Grid::new([SMALL[0], SMALL[1], 1], Affine::scaled([0.5; 3], [0.0; 3]).unwrap()).unwrap(),
        texture(SMALL, false),
    );
    let slice = Volume::from_voxels(grid, |at, _| deep.as_slice()[at]);
    let found = certified(&with_noise(&slice, 1.0, 3), None, &FieldParams::default()).certificate;
    assert!(found.wavelength_50_mm.is_some() && found.gains.len() > 4, "{:?}", found.gains);
    assert!(found.imposed.iter().all(|i| i.strain_held > 0.7), "{:?}", found.imposed);
    let noise = with_noise(&Volume::filled(*deep.grid(), 100.0), 10.0, 4);
    let found = certified(&noise, None, &FieldParams::default()).certificate;
    assert!(found.blind_share > 0.9 && found.wavelength_90_mm.is_none(), "{found:?}");
    assert!(headline(&found).starts_with("Strain cannot be measured: "), "{}", headline(&found));
}

#[test]
fn scans_that_are_one_or_not_at_rest_are_told() {
    let volume = with_noise(&texture(SMALL, false), 2.0, 1);
    let mask = Mask::filled(*volume.grid(), 1);
    let of = |second: &Volume, like: Option<&palpate::types::DenseField>| {
        let input = CertifyInput { initial: &volume, second: Some(second), mask: Some(&mask), like };
        certify::run(input, &FieldParams::default(), &|_, _| {})
    };
    assert!(of(&volume, None).unwrap_err().to_string().contains("is the same as the first"));
    let by = palpate::types::DenseField::from_fn(*volume.grid(), |p| [0.6 * (0.3 * p.0[1]).sin(), 0.0, 0.5]);
    let moved = with_noise(&imposed(&texture(SMALL, false), &by), 2.0, 5);
    let said = of(&moved, None).unwrap().certificate.warnings;
    assert!(said.iter().any(|w| w.contains("they are not at rest")), "{said:?}");
    let folds = palpate::types::DenseField::from_fn(*volume.grid(), |p| [-2.0 * (p.0[0] - 9.0).max(0.0), 0.0, 0.0]);
    let other = with_noise(&texture(SMALL, false), 2.0, 6);
    assert!(of(&other, Some(&folds)).unwrap_err().to_string().contains("folds in"));
}
