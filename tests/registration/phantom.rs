//! Phantoms against what they promise.

use palpate::field::jacobian::jacobian_determinant;
use palpate::field::warp::warp_image;
use palpate::numerics::sampling::{Interpolation, displacement};
use palpate::synth::{MIN_JACOBIAN, MotionKind, Phantom, PhantomKind, PhantomParams, phantom, phantom_on};
use palpate::types::{Affine, DenseField, Grid};

fn small(kind: PhantomKind) -> PhantomParams {
    PhantomParams::new(kind).sized(match kind {
        PhantomKind::Slice => 96,
        PhantomKind::Inclusion | PhantomKind::Slab => 30,
        PhantomKind::Fingertip => 25,
        _ => 40,
    })
}

fn clean(mut params: PhantomParams) -> Phantom {
    (params.noise, params.bias) = (0.0, 0.0);
    phantom(&params).unwrap()
}

/// Over the mask: root-mean-square difference of deformed(x + f u) and initial(x), as a share of
/// that for f = 0.
fn unexplained(p: &Phantom, factor: f32) -> f64 {
    let difference = |factor: f32| {
        let scaled = p.truth.as_slice().iter().map(|u| factor * u).collect();
        let field = DenseField::from_vec(*p.truth.grid(), scaled).unwrap();
        let warped = warp_image(&p.deformed, &field, None, Interpolation::Cubic, 0.0);
        let pairs = warped.as_slice().iter().zip(p.initial.as_slice()).zip(p.mask.as_slice());
        pairs.filter(|v| *v.1 != 0).map(|((w, i), _)| f64::from(w - i).powi(2)).sum::<f64>().sqrt()
    };
    difference(factor) / difference(0.0)
}

/// What is left is the interpolation of thin layers; a motion a tenth too small or too large leaves
/// more.
fn assert_explains(p: &Phantom, name: &str) {
    let shares = [0.9, 1.0, 1.1].map(|factor| unexplained(p, factor));
    assert!(shares[1] < 0.15 && shares[1] < 0.8 * shares[0].min(shares[2]), "{name}: {shares:.3?}");
}

#[test]
fn the_truth_explains_every_kind_to_interpolation_error() {
    for (name, kind) in PhantomKind::KNOWN {
        let p = clean(small(kind));
        assert_explains(&p, name);
        assert!(p.description.mask_voxels > p.initial.grid().len() / 8, "{name}: {}", p.description.mask_voxels);
    }
}

#[test]
fn the_truth_explains_every_motion() {
    // Elastic motions have tests of their own, in phantom_elastic.rs.
    for (name, motion) in MotionKind::KNOWN.into_iter().filter(|m| m.1 != MotionKind::Elastic) {
        let p = clean(PhantomParams { motion, ..small(PhantomKind::Block) });
        match motion {
            MotionKind::None => assert_eq!(p.initial, p.deformed),
            _ => assert_explains(&p, name),
        }
        let jacobian = jacobian_determinant(&p.truth);
        if motion != MotionKind::Slide {
            assert!(jacobian.as_slice().iter().all(|&j| f64::from(j) > MIN_JACOBIAN), "{name}");
        }
    }
}

#[test]
fn translation_and_rotation_are_what_was_asked_for() {
    let mut params = PhantomParams { motion: MotionKind::Translate, amplitude: 2.5, ..small(PhantomKind::Block) };
    let p = phantom(&params).unwrap();
    let u = p.truth.at(0);
    assert!((0..p.initial.grid().len()).all(|at| p.truth.at(at) == u));
    assert!((u.iter().map(|c| f64::from(*c).powi(2)).sum::<f64>().sqrt() - 2.5).abs() < 1e-6);

    (params.motion, params.amplitude) = (MotionKind::Rotate, 10.0);
    let p = phantom(&params).unwrap();
    let g = *p.initial.grid();
    // Distances stay, and the trace of the rotation is 1 + 2 cos(10 degrees).
    let place = |v: [usize; 3]| {
        let x = g.world(v[0], v[1], v[2]);
        x.moved(p.truth.at(g.index(v[0], v[1], v[2])).map(f64::from))
    };
    let corner = place([0, 0, 0]);
    let mut trace = 0.0;
    for a in 0..3 {
        let mut v = [0; 3];
        v[a] = g.shape()[a] - 1;
        let length = g.spacing()[a] * v[a] as f64;
        let edge = place(v).minus(corner);
        assert!((edge.iter().map(|c| c * c).sum::<f64>().sqrt() - length).abs() < 1e-4);
        trace += edge[a] / length;
    }
    assert!((trace - 1.0 - 2.0 * 10f64.to_radians().cos()).abs() < 1e-5, "{trace}");
}

#[test]
fn the_amplitude_is_the_largest_motion_at_rest() {
    for motion in [MotionKind::Smooth, MotionKind::Affine, MotionKind::Press, MotionKind::Slide] {
        let p = phantom(&PhantomParams { motion, amplitude: 2.0, ..small(PhantomKind::Block) }).unwrap();
        assert!((p.description.max_mm - 2.0).abs() < 0.3, "{motion:?}: {}", p.description.max_mm);
    }
}

#[test]
fn a_pressed_fingertip_is_flat_where_it_touches_the_plate() {
    let params = PhantomParams::new(PhantomKind::Fingertip).moving(MotionKind::Press);
    let p = clean(params.clone());
    let g = p.initial.grid();
    let inside = |v: &palpate::types::Volume, i: usize, j: usize| {
        (0..g.shape()[2]).find(|&k| v.as_slice()[g.index(i, j, k)] > 200.0).unwrap()
    };
    // The lowest tissue under a row across the pulp, before and after.
    let rows = |v: &palpate::types::Volume| (22..42).map(|i| inside(v, i, 8)).collect::<Vec<_>>();
    let spread = |r: Vec<usize>| r.iter().max().unwrap() - r.iter().min().unwrap();
    assert!(spread(rows(&p.initial)) >= 2, "{:?}", rows(&p.initial));
    assert!(spread(rows(&p.deformed)) <= 1, "{:?}", rows(&p.deformed));
    let rise = inside(&p.deformed, 32, 8) as f64 - inside(&p.initial, 32, 8) as f64;
    assert!((rise * g.spacing()[2] - params.amplitude).abs() < 0.5, "{rise}");
}

#[test]
fn noise_is_rician_and_independent_in_the_two_volumes() {
    let params = PhantomParams { motion: MotionKind::None, bias: 0.0, ..small(PhantomKind::Head) };
    let (noisy, exact) = (phantom(&params).unwrap(), clean(params));
    let sigma = noisy.description.noise_sigma;
    let n = noisy.initial.grid().len();
    // In air the magnitude has a Rayleigh distribution: mean sigma sqrt(pi / 2), mean square 2
    // sigma^2.
    let air: Vec<f64> = (0..n)
        .filter(|&at| exact.initial.as_slice()[at] == 0.0)
        .map(|at| f64::from(noisy.initial.as_slice()[at]))
        .collect();
    assert!(air.len() > 5000);
    let mean = air.iter().sum::<f64>() / air.len() as f64;
    let square = air.iter().map(|v| v * v).sum::<f64>() / air.len() as f64;
    assert!((mean / (sigma * (std::f64::consts::PI / 2.0).sqrt()) - 1.0).abs() < 0.03);
    assert!((square / (2.0 * sigma * sigma) - 1.0).abs() < 0.05);
    // In bright tissue it is nearly Gaussian of deviation sigma, and the two volumes share none of
    // it.
    let bright: Vec<[f64; 2]> = (0..n)
        .filter(|&at| exact.initial.as_slice()[at] > 15.0 * sigma as f32)
        .map(|at| {
            let v = exact.initial.as_slice()[at];
            [noisy.initial.as_slice()[at] - v, noisy.deformed.as_slice()[at] - v].map(f64::from)
        })
        .collect();
    let moment = |f: &dyn Fn(&[f64; 2]) -> f64| bright.iter().map(f).sum::<f64>() / bright.len() as f64;
    assert!((moment(&|d| d[0] * d[0]).sqrt() / sigma - 1.0).abs() < 0.03);
    assert!((moment(&|d| d[0] * d[1]) / (sigma * sigma)).abs() < 0.03);
}

#[test]
fn bias_multiplies_the_deformed_volume_alone() {
    let params = PhantomParams { motion: MotionKind::None, noise: 0.0, ..small(PhantomKind::Block) };
    let (biased, exact) = (phantom(&params).unwrap(), clean(params));
    assert_eq!(biased.initial, exact.initial);
    let ratios: Vec<f64> = (0..exact.mask.grid().len())
        .filter(|&at| exact.mask.as_slice()[at] != 0)
        .map(|at| f64::from(biased.deformed.as_slice()[at] / exact.deformed.as_slice()[at]).ln().abs())
        .filter(|r| r.is_finite())
        .collect();
    let largest = ratios.iter().copied().fold(0.0, f64::max);
    assert!(largest > 0.1 && largest < 0.1501, "{largest}");
}

#[test]
fn the_same_seed_gives_the_same_bytes_for_any_number_of_threads() {
    let params = small(PhantomKind::Calf);
    let with = |threads: usize| {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(|| phantom(&params).unwrap())
    };
    assert_eq!(with(1), with(3));
    let other = phantom(&PhantomParams { seed: 2, ..params.clone() }).unwrap();
    let first = with(2);
    assert_ne!(first.initial, other.initial);
    assert_ne!(first.truth, other.truth);
    assert_ne!(first.landmarks, other.landmarks);
}

#[test]
fn landmarks_agree_with_the_truth_between_voxels_and_lie_in_the_mask() {
    // Trilinear interpolation of a rotation is exact; of a smooth motion on voxels of 12 mm it is
    // not.
    for (motion, tolerance) in [(MotionKind::Rotate, 1e-4), (MotionKind::Smooth, 0.15)] {
        for kind in [PhantomKind::Calf, PhantomKind::Slice, PhantomKind::Head] {
            let p = phantom(&PhantomParams { motion, ..small(kind) }).unwrap();
            assert!(p.landmarks.len() >= 20, "{kind:?}: {}", p.landmarks.len());
            let g = p.mask.grid();
            let mut sum = 0.0;
            for l in &p.landmarks {
                let v = g.affine().to_voxel(l.initial).0.map(|c| c.round() as usize);
                assert_eq!(p.mask.as_slice()[g.index(v[0], v[1], v[2])], 1);
                let error = l.initial.moved(displacement(&p.truth, l.initial)).minus(l.deformed);
                sum += error.iter().map(|e| e * e).sum::<f64>().sqrt();
            }
            let mean = sum / p.landmarks.len() as f64;
            assert!(mean < tolerance, "{kind:?} {motion:?}: {mean} mm");
        }
    }
}

#[test]
fn a_single_slice_moves_in_its_plane_only() {
    for (_, motion) in MotionKind::KNOWN.into_iter().filter(|m| m.1 != MotionKind::Elastic) {
        let p = phantom(&PhantomParams { motion, ..small(PhantomKind::Slice) }).unwrap();
        assert!(p.truth.component(2).iter().all(|&u| u.abs() < 1e-6), "{motion:?}");
        assert!(p.truth.component(0).iter().any(|&u| u != 0.0) || motion == MotionKind::None, "{motion:?}");
    }
}

#[test]
fn the_volumes_may_lie_on_oblique_flipped_and_different_grids() {
    let mut params = small(PhantomKind::Block);
    (params.noise, params.bias) = (0.0, 0.0);
    let tilted = [[-1.5, 0.25, 0.1, 32.0], [0.3, 1.45, 0.2, -38.0], [0.1, -0.25, 1.6, -26.0]];
    let initial = Grid::new([44, 46, 40], Affine::new(tilted).unwrap()).unwrap();
    let deformed = Grid::new([64, 60, 70], Affine::scaled([1.4, -1.4, 1.2], [-45.0, 42.0, -42.0]).unwrap()).unwrap();
    let p = phantom_on(&params, initial, deformed).unwrap();
    assert_eq!((*p.initial.grid(), *p.deformed.grid()), (initial, deformed));
    let warped = warp_image(&p.deformed, &p.truth, None, Interpolation::Cubic, 0.0);
    let used: Vec<usize> = (0..initial.len()).filter(|&at| p.mask.as_slice()[at] != 0).collect();
    let error = used.iter().map(|&at| f64::from(warped.as_slice()[at] - p.initial.as_slice()[at]).powi(2)).sum::<f64>();
    let error = (error / used.len() as f64).sqrt();
    assert!(used.len() > 5000 && error < 25.0, "{} voxels, {error}", used.len());
}

#[test]
fn what_cannot_be_made_is_refused_with_a_reason() {
    let params = small(PhantomKind::Block);
    let message = |p: PhantomParams| phantom(&p).unwrap_err().to_string();
    assert!(message(PhantomParams { amplitude: 60.0, ..params.clone() }).contains("Jacobian"));
    assert!(
        message(PhantomParams { motion: MotionKind::Press, amplitude: 60.0, ..params.clone() }).contains("Jacobian")
    );
    assert!(message(PhantomParams { noise: f64::NAN, ..params.clone() }).contains("noise"));
    assert!(message(PhantomParams { size: [40, 3, 40], ..params.clone() }).contains("size"));
    assert!(message(PhantomParams { size: [1, 1, 40], ..params }).contains("size"));
    let unknown = "clf".parse::<PhantomKind>().unwrap_err().to_string();
    assert_eq!(
        unknown,
        "unknown phantom 'clf', did you mean 'calf'?; known: calf, slice, head, block, fingertip, inclusion, slab"
    );
    assert!("pres".parse::<MotionKind>().unwrap_err().to_string().contains("'press'"));
}
