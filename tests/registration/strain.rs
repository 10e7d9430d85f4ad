//! Strain against closed forms, brute force and exact-truth phantoms.

use crate::fixtures::{run, small_pair};
use palpate::error::StrainError;
use palpate::io;
use palpate::numerics::random::Random;
use palpate::numerics::symmetric3::cholesky_solve;
use palpate::pipeline;
use palpate::pipeline::strain::{StrainInput, StrainParams, StrainResult};
use palpate::strain::StrainField;
use palpate::strain::deviation::{COMPONENTS, components};
use palpate::strain::directions::{Directions, Tube};
use palpate::strain::gauge::{Gauge, map_gradients};
use palpate::synth::{PhantomKind, PhantomParams, Trouble, troubled};
use palpate::types::params::ModelSource;
use palpate::types::space::Matrix3;
use palpate::types::{Affine, DenseField, ErrorSamples, FieldParams, Grid, Mask, StrainMeasure, Trust, WorldPoint};

fn grid(shape: [usize; 3]) -> Grid {
    Grid::new(shape, Affine::scaled([1.0; 3], [0.0; 3]).unwrap()).unwrap()
}

/// Oblique, flipped and anisotropic.
fn oblique() -> Grid {
    let (s, c) = 0.5f64.sin_cos();
    let rows = [[-0.8 * c, 1.1 * s, 0.0, 7.0], [-0.8 * s, -1.1 * c, 0.0, -3.0], [0.0, 0.0, 2.0, 11.0]];
    Grid::new([13, 12, 9], Affine::new(rows).unwrap()).unwrap()
}

fn largest(a: &Matrix3, b: &Matrix3) -> f64 {
    a.iter().flatten().zip(b.iter().flatten()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

fn gradients(field: &DenseField, bodies: &[u8], half: [usize; 3]) -> Vec<Option<Matrix3>> {
    map_gradients(field, bodies, Gauge { half }, |_, g| Some(*g))
}

#[test]
fn a_linear_field_has_its_gradient_on_any_grid_in_any_body() {
    let g = [[0.1, -0.05, 0.02], [0.03, -0.08, 0.0], [0.01, 0.04, 0.06]];
    let grid = oblique();
    let field =
        DenseField::from_fn(grid, |p| std::array::from_fn(|r| 1.0 + (0..3).map(|c| g[r][c] * p.0[c]).sum::<f64>()));
    let mut random = Random::new(3, 1);
    let ragged = Mask::from_vec(grid, (0..grid.len()).map(|_| (random.bits() % 3) as u8).collect()).unwrap();
    for half in [[1, 1, 1], [2, 2, 1], [4, 3, 2], [20, 20, 20]] {
        for bodies in [&[][..], ragged.as_slice()] {
            let found = gradients(&field, bodies, half);
            let inside = |at: &usize| bodies.is_empty() || bodies[*at] != 0;
            for at in (0..grid.len()).filter(inside) {
                // A voxel with a neighbour or two of its own body spans no volume.
                let spans = bodies.is_empty() || half[0] > 1;
                assert!(!spans || largest(&found[at].unwrap(), &g) < 2e-4, "{half:?}: {:?}", found[at]);
            }
            assert!((0..grid.len()).all(|at| found[at].is_some() == inside(&at)));
        }
    }
}

/// The least-squares plane, voxel by voxel.
#[test]
fn sums_along_the_axes_are_brute_force() {
    let grid = oblique();
    let mut random = Random::new(5, 1);
    let values = (0..3 * grid.len()).map(|_| random.normals()[0] as f32).collect();
    let field = DenseField::from_vec(grid, values).unwrap();
    let bodies: Vec<u8> = (0..grid.len()).map(|at| 1 + u8::from(grid.voxel(at)[0] > 6)).collect();
    let half = [2, 3, 1];
    let found = gradients(&field, &bodies, half);
    for at in 0..grid.len() {
        let own = grid.voxel(at);
        let near: Vec<usize> = (0..grid.len())
            .filter(|&o| bodies[o] == bodies[at] && (0..3).all(|a| grid.voxel(o)[a].abs_diff(own[a]) <= half[a]))
            .collect();
        let place = |o: usize| -> [f64; 3] {
            let v = grid.voxel(o);
            grid.world(v[0], v[1], v[2]).minus(grid.world(own[0], own[1], own[2]))
        };
        let gradient: Matrix3 = std::array::from_fn(|c| {
            let (mut a, mut b) = ([[0.0; 4]; 4], [0.0; 4]);
            for &o in &near {
                let [x, y, z] = place(o);
                let (row, u) = ([1.0, x, y, z], f64::from(field.at(o)[c]));
                for r in 0..4 {
                    b[r] += row[r] * u;
                    (0..4).for_each(|k| a[r][k] += row[r] * row[k]);
                }
            }
            let [_, x, y, z] = cholesky_solve(a, b).unwrap();
            [x, y, z]
        });
        assert!(largest(&found[at].unwrap(), &gradient) < 1e-6, "{:?} is not {gradient:?}", found[at]);
    }
}

#[test]
fn no_strain_is_taken_across_a_wall_that_slides() {
    let grid = grid([20, 18, 16]);
    let bodies: Vec<u8> = (0..grid.len()).map(|at| 1 + u8::from(grid.voxel(at)[2] > 7)).collect();
    let field = DenseField::from_fn(grid, |p| [if p.0[2] > 7.5 { 3.0 } else { -3.0 }, 0.0, 0.0]);
    let most = |bodies: &[u8]| {
        let strain = StrainField::of(&field, bodies, Gauge::shortest(&grid), StrainMeasure::GreenLagrange);
        (0..grid.len()).map(|at| strain.principal(at)[0].abs()).fold(0.0, f64::max)
    };
    assert!(most(&bodies) < 1e-6 && most(&[]) > 1.0);
}

/// Strain of a field whose error is not known.
fn strain_of(field: &DenseField, params: &StrainParams) -> Result<StrainResult, StrainError> {
    let bodies = Mask::filled(*field.grid(), 1);
    let input = StrainInput { field, bodies: &bodies, labels: None, samples: None, trust: None };
    pipeline::strain::run(input, params, &|_, _| {})
}

/// White noise on a wave: the deviation is that of the slopes, and the gauge that is chosen is
/// about as good as the best of those that are tried.
#[test]
fn white_noise_chooses_the_gauge_and_gives_the_deviation() {
    let grid = grid([48, 40, 32]);
    let wave = 2.0 * std::f64::consts::PI / 40.0;
    let mut random = Random::new(7, 1);
    for (noise, low, high) in [(1e-4, 2.0, 2.0), (0.02, 4.0, 4.0), (0.1, 8.0, 8.0)] {
        let exact = |p: WorldPoint| [(wave * p.0[0]).sin(), 0.0, 0.0];
        let field = DenseField::from_fn(grid, |p| exact(p).map(|u| u + noise * random.normals()[0]));
        let found = strain_of(&field, &StrainParams { measure: StrainMeasure::Small, ..Default::default() }).unwrap();
        let gauge = found.summary.gauge_mm;
        assert!((low..=high).contains(&gauge), "{noise} mm: {gauge} mm of {:?}", found.summary.gauges);
        let inner = |at: &usize| {
            let v = grid.voxel(*at);
            (0..3).all(|a| (8..grid.shape()[a] - 8).contains(&v[a]))
        };
        // Components that the wave does not strain hold noise alone.
        let square = |at: usize| found.strain.at(at)[1].powi(2);
        let inside: Vec<usize> = (0..grid.len()).filter(inner).collect();
        let rms = (inside.iter().map(|&at| square(at)).sum::<f64>() / inside.len() as f64).sqrt();
        let stated = found.deviation.at(WorldPoint([20.0, 20.0, 16.0]))[1];
        assert!((rms / stated - 1.0).abs() < 0.25, "{noise} mm: {rms} for {stated}");
    }
}

/// The deviation that the field's posterior gives holds the errors against exact truth.
#[test]
fn the_deviation_holds_the_errors_of_phantoms() {
    let scenes = [
        (PhantomKind::Block, Trouble::Noise, 3.0),
        (PhantomKind::Block, Trouble::Noise, 15.0),
        (PhantomKind::Head, Trouble::Noise, 6.0),
        (PhantomKind::Calf, Trouble::Motion, 6.0),
        (PhantomKind::Head, Trouble::Motion, 5.0),
        (PhantomKind::Slice, Trouble::Noise, 5.0),
    ];
    let mut all = Vec::new();
    for (kind, trouble, severity) in scenes {
        let p = troubled(&PhantomParams::new(kind).sized(44), trouble, severity).unwrap();
        let found = pipeline::field::run(&p.initial, &p.deformed, None, &FieldParams::default(), &|_, _| {}).unwrap();
        let strain = pipeline::strain::run(StrainInput::of(&found), &StrainParams::default(), &|_, _| {}).unwrap();
        let grid = *found.displacement.grid();
        let gauge = Gauge::of_length(&grid, strain.summary.gauge_mm);
        let truth = StrainField::of(&p.truth, found.bodies.as_slice(), gauge, StrainMeasure::GreenLagrange);
        let (mut held, mut count) = (0, 0);
        for at in (0..grid.len()).filter(|&at| found.bodies.as_slice()[at] != 0 && p.mask.as_slice()[at] != 0) {
            let sd = strain.deviation.at(grid.centre(at));
            let (e, t) = (strain.strain.at(at), truth.at(at));
            // Across a slice there is neither strain nor deviation.
            let known = || (0..6).filter(|&c| sd[c] > 0.0 || t[c] != 0.0);
            held += known().filter(|&c| (e[c] - t[c]).abs() < 1.96 * sd[c]).count();
            count += known().count();
        }
        let share = held as f64 / count as f64;
        assert!(share > 0.8, "{} {severity} of {kind:?}: {share:.3}", trouble.name());
        all.push(share);
    }
    let mean = all.iter().sum::<f64>() / all.len() as f64;
    assert!((0.9..0.995).contains(&mean), "{mean:.3} of {all:.3?}");
}

/// A tube that widens: what it gains around it loses across.
#[test]
fn a_tube_that_widens_has_radial_and_circumferential_strain() {
    let grid = grid([48, 48, 40]);
    let from_axis = |p: WorldPoint| [p.0[0] - 23.5, p.0[1] - 23.5];
    let labels = Mask::from_voxels(grid, |_, p| {
        let [x, y] = from_axis(p);
        if (10.0..18.0).contains(&x.hypot(y)) { 4 } else { 0 }
    });
    let field = DenseField::from_fn(grid, |p| {
        let [x, y] = from_axis(p);
        let by = 0.5 * 10.0 / (x * x + y * y).max(1.0);
        [by * x, by * y, 0.02 * p.0[2]]
    });
    let tube = Tube::of(4, &labels).unwrap();
    assert!(tube.axis[2].abs() > 0.999);
    let params =
        StrainParams { directions: Directions::Tubes(vec![tube]), measure: StrainMeasure::Small, gauge_mm: Some(2.0) };
    let bodies = Mask::filled(grid, 1);
    let input = StrainInput { field: &field, bodies: &bodies, labels: Some(&labels), samples: None, trust: None };
    let found = pipeline::strain::run(input, &params, &|_, _| {}).unwrap();
    let mean = |name: &str| {
        found.summary.regions.iter().find(|r| r.label == 4 && r.component == name).map(|r| r.values[0]).unwrap()
    };
    // u = c / r: the strain is -c / r^2 across and c / r^2 around.
    let exact = |at: usize| {
        let [i, j, k] = grid.voxel(at);
        let [x, y] = from_axis(grid.world(i, j, k));
        5.0 / (x * x + y * y)
    };
    let own: Vec<usize> = (0..grid.len()).filter(|&at| labels.as_slice()[at] == 4).collect();
    let c = own.iter().map(|&at| exact(at)).sum::<f64>() / own.len() as f64;
    for (name, value) in [("radial", -c), ("circumferential", c), ("axial", 0.02), ("volume", 0.02)] {
        assert!((mean(name) - value).abs() < 0.02 * c, "{name}: {} is not {value}", mean(name));
    }
}

#[test]
fn what_has_no_strain_is_refused() {
    let grid = grid([16, 14, 12]);
    let still = DenseField::zeros(grid);
    let folding = DenseField::from_fn(grid, |p| [if p.0[0] > 8.0 { -3.0 } else { 0.0 }, 0.0, 0.0]);
    let mut broken = still.clone();
    broken.as_mut_slice()[100] = f32::NAN;
    let with = |gauge| StrainParams { gauge_mm: Some(gauge), ..Default::default() };
    assert!(matches!(strain_of(&folding, &StrainParams::default()), Err(StrainError::Folds { voxels: 1.. })));
    assert!(matches!(strain_of(&broken, &StrainParams::default()), Err(StrainError::NotFinite { voxels: 1 })));
    let sheet = Mask::from_voxels(grid, |at, _| u8::from(grid.voxel(at)[2] == 5));
    let elsewhere = Mask::from_voxels(grid, |at, _| u8::from(grid.voxel(at)[2] == 9));
    let inside = Mask::from_voxels(grid, |at, _| u8::from(grid.voxel(at)[2] < 6));
    let nodes = Grid::new([5; 3], Affine::scaled([4.0; 3], [-40.0; 3]).unwrap()).unwrap();
    let lost = ErrorSamples::new(nodes, vec![vec![0.0; 3 * nodes.len()]; 6]).unwrap();
    let of = |bodies: &Mask, labels: Option<&Mask>, samples: Option<&ErrorSamples>| {
        let input = StrainInput { field: &still, bodies, labels, samples, trust: None };
        pipeline::strain::run(input, &StrainParams::default(), &|_, _| {})
    };
    assert!(matches!(of(&sheet, None, None), Err(StrainError::Thin { voxels: 1 })));
    assert!(matches!(of(&inside, Some(&elsewhere), None), Err(StrainError::NoLabel)));
    assert!(matches!(of(&inside, None, Some(&lost)), Err(StrainError::Samples)));
    assert!(matches!(strain_of(&still, &with(1.9)), Err(StrainError::ShortGauge { .. })));
    assert!(matches!(strain_of(&still, &with(12.5)), Err(StrainError::WideGauge { .. })));
    assert!(matches!(strain_of(&still, &with(f64::NAN)), Err(StrainError::ShortGauge { .. })));
    let fibres = StrainParams { directions: Directions::Fibres(still.clone()), ..Default::default() };
    assert!(matches!(strain_of(&still, &fibres), Err(StrainError::Directions { .. })));
    assert!(strain_of(&still, &with(12.0)).is_ok());
}

/// The strain that `field --strain` writes is that which `strain` makes of its folder.
#[test]
fn strain_of_a_pair_and_of_its_folder_are_the_same() {
    let folder = small_pair();
    run(folder.path(), &["field", "initial.nii.gz", "deformed.nii.gz", "-o", "f", "--strain", "--quiet"], 0);
    let (out, _) = run(folder.path(), &["strain", "f", "-o", "s", "--quiet"], 0);
    assert!(out.starts_with("Strain over a gauge of ") && out.contains("\n  trust "), "{out}");
    let json = |path: &str| io::read_json(folder.path().join(path)).unwrap();
    let (whole, alone) = (json("f/summary.json"), json("s/summary.json"));
    assert_eq!(whole["strain"]["gauge_mm"], alone["gauge_mm"]);
    let (a, b) = (whole["strain"]["noise"].as_f64().unwrap(), alone["noise"].as_f64().unwrap());
    assert!(a > 0.0 && (a / b - 1.0).abs() < 1e-3, "{a} is not {b}");
    for file in ["regions.csv", "strain.nii.gz", "strain_sd.nii.gz", "mesh.vtu", "report.html"] {
        assert!(folder.path().join("s").join(file).is_file(), "{file}");
    }
    // Wrong usage names what is wrong.
    for (arguments, code, message) in [
        (&["strain", "f", "-o", "g", "--gauge", "0.1"][..], 1, "under two voxels"),
        (&["strain", "f", "-o", "g", "--fibres", "1=0,0,0"], 2, "has no length"),
        (&["strain", "f", "-o", "g", "--fibres", "9=1,0,0"], 1, "no voxel has label 9"),
        (&["strain", "f", "-o", "g", "--fibres", "1=1,0,0", "--fibres", "1=0,1,0"], 2, "has a direction already"),
        (&["strain", "f/principal.nii.gz", "-o", "g"], 1, "is not a displacement field"),
        (&["strain", "f", "-o", "g", "--field-convention", "ras"], 2, "--field-convention"),
        (&["strain", "f", "-o", "f"], 2, "choose another --output"),
        (&["strain", "nowhere", "-o", "g"], 1, "nowhere"),
    ] {
        let (_, error) = run(folder.path(), arguments, code);
        assert!(error.contains(message), "{error}");
        assert!(!folder.path().join("g/summary.json").exists());
    }
    // A mask may lie on another grid; bodies of the folder that do are of another run.
    let grid = *io::read_labels(folder.path().join("f/bodies.nii.gz")).unwrap().grid();
    let [nx, ny, nz] = grid.shape();
    let shorter = Mask::filled(Grid::new([nx, ny, nz - 1], *grid.affine()).unwrap(), 1);
    io::write_labels(folder.path().join("m.nii.gz"), &shorter, "").unwrap();
    let (_, said) = run(folder.path(), &["strain", "f", "-o", "m", "--mask", "m.nii.gz"], 0);
    assert!(said.contains("m.nii.gz: lies on another grid"), "{said}");
    io::write_labels(folder.path().join("f/bodies.nii.gz"), &shorter, "").unwrap();
    let (_, error) = run(folder.path(), &["strain", "f", "-o", "g"], 1);
    assert!(error.contains("bodies.nii.gz is on another grid"), "{error}");
}

/// Of tissue that is still the strain is noise: the error bars of its means say so, of principal
/// strains too, which noise alone makes positive and negative.
#[test]
fn error_bars_of_regions_hold_what_noise_adds() {
    let p = troubled(&PhantomParams::new(PhantomKind::Head).sized(44), Trouble::Noise, 10.0).unwrap();
    let params = FieldParams { model: ModelSource::Free, ..FieldParams::default() };
    let found = pipeline::field::run(&p.initial, &p.deformed, None, &params, &|_, _| {}).unwrap();
    let strain = pipeline::strain::run(StrainInput::of(&found), &StrainParams::default(), &|_, _| {}).unwrap();
    let gauge = Gauge::of_length(found.displacement.grid(), strain.summary.gauge_mm);
    let truth = StrainField::of(&p.truth, found.bodies.as_slice(), gauge, StrainMeasure::GreenLagrange);
    let inside: Vec<usize> = (0..truth.grid().len()).filter(|&at| found.bodies.as_slice()[at] != 0).collect();
    for r in &strain.summary.regions {
        let exact = |at: usize| components(StrainMeasure::GreenLagrange, &truth.at(at), None);
        let c = COMPONENTS.iter().position(|name| *name == r.component).unwrap();
        let mean = inside.iter().map(|&at| exact(at)[c]).sum::<f64>() / inside.len() as f64;
        let z = (r.values[0] - mean) / r.errors[0];
        assert!(z.abs() < 4.0, "{}: {} ± {} is not {mean}", r.component, r.values[0], r.errors[0]);
    }
}

/// Smooth errors of a field from elsewhere cannot be seen in it: it is never of high trust.
#[test]
fn a_field_without_draws_is_not_of_high_trust() {
    let field = DenseField::from_fn(grid([30, 28, 26]), |p| [2.0 * (0.15 * p.0[1]).sin(), 0.0, 0.03 * p.0[2]]);
    let found = strain_of(&field, &StrainParams::default()).unwrap().summary;
    assert!(found.noise < 1e-3 * found.strain && found.trust == Trust::Moderate && !found.drawn, "{found:?}");
}
