//! Chains of transforms against their definition, and the readers and writers of transforms against
//! truth by hand and by the programs' own numbers.

use crate::fixtures::{palpate, run, small_pair, text};
use palpate::field::warp::warp_points;
use palpate::io::{self, AffineFormat, FieldFormat, TransformSource};
use palpate::numerics::label_detection::is_label_map;
use palpate::numerics::random::Random;
use palpate::numerics::sampling::{Interpolation, displacement};
use palpate::transforms::Chain;
use palpate::transforms::resample::resample;
use palpate::types::space::length;
use palpate::types::{Affine, AffineMap, DenseField, Grid, Mask, Transform, Volume, VoxelPoint, WorldPoint};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// A grid about the origin, `extent` mm wide: oblique, and flipped half of the time.
fn grid_about(random: &mut Random, shape: [usize; 3], extent: f64) -> Grid {
    let [a, b, c] = [0, 1, 2].map(|_| random.uniform(-0.4, 0.4));
    let flip = if random.uniform(0.0, 1.0) < 0.5 { -1.0 } else { 1.0 };
    let axes = [[flip * a.cos(), -a.sin(), b], [flip * a.sin(), a.cos(), c], [flip * -b, c, 1.0]];
    let mut rows = [[0.0; 4]; 3];
    for r in 0..3 {
        for c in 0..3 {
            rows[r][c] = axes[r][c] * extent / shape[c] as f64;
            rows[r][3] -= 0.5 * rows[r][c] * (shape[c] - 1) as f64;
        }
    }
    Grid::new(shape, Affine::new(rows).unwrap()).unwrap()
}

/// An affine map near the identity.
fn affine(random: &mut Random) -> AffineMap {
    AffineMap::new(std::array::from_fn(|r| {
        std::array::from_fn(|c| match c {
            3 => random.uniform(-1.0, 1.0),
            c => f64::from(u8::from(r == c)) + random.uniform(-0.08, 0.08),
        })
    }))
    .unwrap()
}

/// A smooth field whose displacements differ by less than their distance.
fn field(random: &mut Random) -> DenseField {
    let grid = grid_about(random, [9, 8, 10], 50.0);
    let waves: [[f64; 4]; 3] = std::array::from_fn(|_| {
        let k: [f64; 3] = std::array::from_fn(|_| random.uniform(-0.15, 0.15));
        [k[0], k[1], k[2], random.uniform(0.3, 1.2)]
    });
    DenseField::from_fn(grid, |p| waves.map(|w| w[3] * (w[0] * p.0[0] + w[1] * p.0[1] + w[2] * p.0[2]).sin()))
}

fn random_transform(random: &mut Random) -> Transform {
    match (random.uniform(0.0, 3.0) as usize, random.uniform(0.0, 1.0) < 0.5) {
        (0, false) => Transform::Affine(affine(random)),
        (0, true) => Transform::Affine(affine(random).inverse()),
        (1, _) => Transform::Field(field(random)),
        _ => Transform::Inverse(field(random)),
    }
}

/// Where one transform takes a point, by its definition.
fn by_definition(transform: &Transform, p: WorldPoint) -> Option<WorldPoint> {
    match transform {
        Transform::Affine(map) => {
            let rows = map.rows();
            Some(WorldPoint(rows.map(|r| r[0] * p.0[0] + r[1] * p.0[1] + r[2] * p.0[2] + r[3])))
        }
        Transform::Field(field) => warp_points(&[p], field)[0],
        Transform::Inverse(field) => {
            let start = p;
            let x = (0..300).fold(start, |x, _| p.moved(displacement(field, x).map(|v| -v)));
            warp_points(&[x], field)[0].map(|_| x)
        }
    }
}

#[test]
fn composed_chains_agree_with_their_parts_one_by_one() {
    let mut random = Random::new(56, 0);
    let (mut known, mut lost, mut worst) = (0, 0, 0.0f64);
    for _ in 0..500 {
        let count = 1 + random.uniform(0.0, 4.0) as usize;
        let chain = Chain((0..count).map(|_| random_transform(&mut random)).collect());
        let out = grid_about(&mut random, [4, 3, 5], 52.0);
        let whole = chain.to_field(&out);
        let back = chain.clone().inverse();
        for at in 0..out.len() {
            let x = out.centre(at);
            let expected = chain.0.iter().try_fold(x, |p, t| by_definition(t, p));
            let found = whole.at(at).map(f64::from);
            let Some(y) = expected else {
                assert!(found.iter().all(|v| v.is_nan()), "{found:?} where a field says nothing");
                lost += 1;
                continue;
            };
            known += 1;
            (0..3).for_each(|c| worst = worst.max((x.moved(found).0[c] - y.0[c]).abs()));
            assert!(length(chain.held_at(x).minus(y)) < 1e-7);
            let again = back.at(y).unwrap();
            assert!(length(again.minus(x)) < 1e-6, "{x:?} comes back as {again:?}");
        }
    }
    assert!(worst < 1e-6, "{worst} mm");
    assert!(known > 20_000 && lost > 500, "{known} places known, {lost} lost: too few to tell");
}

#[test]
fn affine_chains_are_one_affine() {
    let mut random = Random::new(57, 0);
    for _ in 0..100 {
        let maps: Vec<AffineMap> = (0..4).map(|_| affine(&mut random)).collect();
        let chain = Chain(maps.iter().map(|m| Transform::Affine(*m)).collect());
        let whole = chain.affine().unwrap();
        let p = WorldPoint([0, 1, 2].map(|_| random.uniform(-100.0, 100.0)));
        let y = maps.iter().fold(p, |p, m| by_definition(&Transform::Affine(*m), p).unwrap());
        assert!(length(whole.at(p).minus(y)) < 1e-10);
        assert!(length(whole.inverse().at(y).minus(p)) < 1e-10);
    }
    assert_eq!(Chain::default().affine(), Some(AffineMap::IDENTITY));
    assert_eq!(Chain(vec![Transform::Field(field(&mut random))]).affine(), None);
}

#[test]
fn where_a_field_does_not_lead_its_inverse_says_nothing() {
    let grid = Grid::new([21, 21, 3], Affine::scaled([1.0; 3], [-10.0, -10.0, -1.0]).unwrap()).unwrap();
    let mut shift = DenseField::from_fn(grid, |_| [5.0, 0.0, 0.0]);
    let back = Chain(vec![Transform::Field(shift.clone())]).inverse();
    // The grid ends at -10.5 and 10.5, so the field leads to -5.5 to 15.5.
    assert_eq!(back.at(WorldPoint([-6.0, 0.0, 0.0])), None);
    assert_eq!(back.at(WorldPoint([16.0, 0.0, 0.0])), None);
    for x in [-5.0, 0.0, 15.0] {
        assert_eq!(back.at(WorldPoint([x, 0.0, 0.0])), Some(WorldPoint([x - 5.0, 0.0, 0.0])));
    }
    shift.as_mut_slice().fill(f32::NAN);
    let nowhere = Chain(vec![Transform::Field(shift)]);
    assert_eq!(nowhere.clone().inverse().at(WorldPoint([0.0; 3])), None);
    assert_eq!(nowhere.at(WorldPoint([0.0; 3])), None);
}

// Readers.

fn put(folder: &TempDir, name: &str, content: impl AsRef<[u8]>) -> PathBuf {
    let path = folder.path().join(name);
    std::fs::write(&path, content).unwrap();
    path
}

fn read(path: &Path) -> Chain {
    Chain(io::read_transform(path, None, None, None).unwrap().transforms)
}

fn itk_text(blocks: &[(&str, &str, &str)]) -> String {
    let block = |(n, (name, p, fixed)): (usize, &(&str, &str, &str))| {
        format!("#Transform {n}\nTransform: {name}\nParameters: {p}\nFixedParameters: {fixed}\n")
    };
    format!("#Insight Transform File V1.0\n{}", blocks.iter().enumerate().map(block).collect::<String>())
}

/// Kind, parameters, fixed parameters, and where ITK takes (10, -20, 30), LPS.
const KINDS: [(&str, &str, &str, [f64; 3]); 10] = [
    ("Euler3DTransform", "0.1 -0.2 0.3 4 5 6", "1 2 3 0", [15.604559637769, -15.585242408191, 34.912354973106]),
    ("Euler3DTransform", "0.1 -0.2 0.3 4 5 6", "1 2 3 1", [16.010143298223, -15.32917333896, 34.965068121445]),
    ("VersorRigid3DTransform", "0.1 -0.2 0.3 4 5 6", "1 2 3", [16.385668438919, -14.2, 35.73811052036]),
    ("VersorTransform", "0.1 -0.2 0.3", "1 2 3", [12.385668438919, -19.2, 29.73811052036]),
    ("Similarity3DTransform", "0.1 -0.2 0.3 4 5 6 1.5", "1 2 3", [22.078502658378, -24.8, 49.107165780541]),
    ("ScaleVersor3DTransform", "0.1 -0.2 0.3 4 5 6 1.1 0.9 1.2", "1 2 3", [17.285668438919, -12.0, 41.13811052036]),
    ("ScaleTransform", "1.1 0.9 1.2", "1 2 3", [10.9, -17.8, 35.4]),
    ("TranslationTransform", "1.1 0.9 1.2", "", [11.1, -19.1, 31.2]),
    ("AffineTransform", "1.1 0.1 -0.2 0.3 0.9 0.1 0.05 -0.1 1.2 4 5 6", "1 2 3", [7.3, -7.4, 44.05]),
    // Longer than 1: ITK shortens it.
    ("VersorRigid3DTransform", "0.9 -0.7 0.3 4 5 6", "0 0 0", [35.438489060075, -7.230791599293, -10.187314245242]),
];

fn goes(chain: &Chain, from_lps: [f64; 3], to_lps: [f64; 3]) {
    let ras = |p: [f64; 3]| WorldPoint([-p[0], -p[1], p[2]]);
    let found = chain.at(ras(from_lps)).unwrap();
    assert!(length(found.minus(ras(to_lps))) < 1e-9, "{found:?} instead of LPS {to_lps:?}");
}

#[test]
fn itk_text_of_every_kind_goes_where_itk_says() {
    let folder = TempDir::new().unwrap();
    for (kind, parameters, fixed, to) in KINDS {
        for precision in ["double", "float"] {
            let name = format!("{kind}_{precision}_3_3");
            let path = put(&folder, "t.tfm", itk_text(&[(&name, parameters, fixed)]));
            goes(&read(&path), [10.0, -20.0, 30.0], to);
        }
    }
    let crlf = itk_text(&[("TranslationTransform_double_3_3", "1 2 3", "")]).replace('\n', "\r\n");
    goes(&read(&put(&folder, "crlf.txt", crlf)), [0.0; 3], [1.0, 2.0, 3.0]);
}

#[test]
fn the_last_of_a_composite_comes_first() {
    let folder = TempDir::new().unwrap();
    let (affine, euler) = (KINDS[8], KINDS[1]);
    let names = [affine.0, euler.0].map(|k| format!("{k}_double_3_3"));
    let blocks =
        [("CompositeTransform_double_3_3", "", ""), (&names[0], affine.1, affine.2), (&names[1], euler.1, euler.2)];
    let path = put(&folder, "c.tfm", itk_text(&blocks));
    goes(&read(&path), [10.0, -20.0, 30.0], [13.38522666986, -0.896706203453, 49.841506244541]);
    let error = io::read_transform(put(&folder, "two.tfm", itk_text(&blocks[1..])), None, None, None).unwrap_err();
    assert!(error.to_string().contains("line 7: a second transform"), "{error}");
}

#[test]
fn an_itk_field_in_text_lies_on_its_grid() {
    let folder = TempDir::new().unwrap();
    // 2 x 1 x 1 voxels of 2 mm, from LPS (10, 20, 30) on; its first axis runs along +y.
    let fixed = "2 1 1 10 20 30 2 3 4 0 -1 0 1 0 0 0 0 1";
    let path = put(&folder, "f.tfm", itk_text(&[("DisplacementFieldTransform_double_3_3", "1 2 3 5 6 7", fixed)]));
    goes(&read(&path), [10.0, 20.0, 30.0], [11.0, 22.0, 33.0]);
    goes(&read(&path), [10.0, 21.0, 30.0], [13.0, 25.0, 35.0]);
    assert_eq!(read(&path).at(WorldPoint([-10.0, -25.0, 30.0])), None);
}

fn matlab(big: bool, single: bool, parts: &[(&str, &[f64])]) -> Vec<u8> {
    let mut out = Vec::new();
    for (name, values) in parts {
        let kind = 1000 * i32::from(big) + 10 * i32::from(single);
        for n in [kind, values.len() as i32, 1, 0, name.len() as i32 + 1] {
            out.extend(if big { n.to_be_bytes() } else { n.to_le_bytes() });
        }
        out.extend(name.bytes().chain([0]));
        for v in *values {
            match (single, big) {
                (false, false) => out.extend(v.to_le_bytes()),
                (false, true) => out.extend(v.to_be_bytes()),
                (true, false) => out.extend((*v as f32).to_le_bytes()),
                (true, true) => out.extend((*v as f32).to_be_bytes()),
            }
        }
    }
    out
}

#[test]
fn matlab_files_of_both_byte_orders_and_precisions() {
    let folder = TempDir::new().unwrap();
    let p = [1.0, 0.25, -0.5, 0.0, 0.75, 0.125, 0.0, -0.25, 1.25, 4.0, 5.0, 6.0];
    let centre = [8.0, -2.0, 3.0];
    // M (x - c) + c + t with x = (10, -20, 30): x - c = (2, -18, 27).
    let to = [2.0 - 4.5 - 13.5 + 12.0, -13.5 + 3.375 + 3.0, 4.5 + 33.75 + 9.0];
    for (big, single) in [(false, false), (true, false), (false, true), (true, true)] {
        for kind in ["AffineTransform_double_3_3", "MatrixOffsetTransformBase_double_3_3"] {
            let path = put(&folder, "0GenericAffine.mat", matlab(big, single, &[(kind, &p), ("fixed", &centre)]));
            goes(&read(&path), [10.0, -20.0, 30.0], to);
        }
    }
    let whole = matlab(false, false, &[("AffineTransform_double_3_3", &p), ("fixed", &centre)]);
    for end in 21..whole.len() {
        let error = io::read_transform(put(&folder, "cut.mat", &whole[..end]), None, None, None).unwrap_err();
        assert!(error.to_string().contains("cut.mat") && error.to_string().contains("cut short"), "{end}: {error}");
    }
}

const RAS: &str = "1.1 0.1 -0.2 4\n0.3 0.9 0.1 5\n 0.05\t-0.1 1.2 6\n0 0 0 1\n";

#[test]
fn four_by_four_text_is_ras_mm_unless_it_is_fsl() {
    let folder = TempDir::new().unwrap();
    let path = put(&folder, "a.mat", RAS);
    let found = io::read_transform(&path, None, None, None).unwrap();
    assert!(found.guessed);
    let p = WorldPoint([10.0, -20.0, 30.0]);
    let to = WorldPoint([11.0 - 2.0 - 6.0 + 4.0, 3.0 - 18.0 + 3.0 + 5.0, 0.5 + 2.0 + 36.0 + 6.0]);
    assert!(length(Chain(found.transforms).at(p).unwrap().minus(to)) < 1e-12);
    for source in [TransformSource::Greedy, TransformSource::Niftyreg, TransformSource::Ras] {
        let found = io::read_transform(&path, Some(source), None, None).unwrap();
        assert!(!found.guessed);
        assert!(length(Chain(found.transforms).at(p).unwrap().minus(to)) < 1e-12);
    }
    let error = io::read_transform(&path, Some(TransformSource::Fsl), None, None).unwrap_err().to_string();
    assert!(error.contains("--initial") && error.contains("--deformed"), "{error}");
}

/// Oblique rows with a determinant of the sign of `flip`.
fn placed(shape: [usize; 3], flip: f64, offset: f64) -> Grid {
    let rows = [[1.92 * flip, -0.84, 0.0, 5.0 + offset], [0.56 * flip, 2.88, 0.0, -7.0], [0.0, 0.0, 1.5, 3.0 - offset]];
    Grid::new(shape, Affine::new(rows).unwrap()).unwrap()
}

#[test]
fn flirt_maps_moving_to_fixed_in_scaled_voxels_with_x_turned_where_the_determinant_is_positive() {
    let folder = TempDir::new().unwrap();
    // FLIRT: from the moving volume (x, y, z) to (y + 3, -x + 40, z - 2) in the fixed one.
    let path = put(&folder, "flirt.mat", "0 1 0 3\n-1 0 0 40\n0 0 1 -2\n0 0 0 1\n");
    for (one, two) in [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)] {
        let (initial, deformed) = (placed([20, 30, 10], one, 0.0), placed([25, 22, 14], two, 11.0));
        let found = io::read_transform(&path, Some(TransformSource::Fsl), Some(&initial), Some(&deformed)).unwrap();
        let chain = Chain(found.transforms);
        for voxel in [[0.0, 0.0, 0.0], [7.0, 11.0, 4.0], [19.0, 3.5, 9.0]] {
            // Sizes are 2, 3 and 1.5 mm.
            let x = if one > 0.0 { 19.0 - voxel[0] } else { voxel[0] };
            let [x, y, z] = [2.0 * x, 3.0 * voxel[1], 1.5 * voxel[2]];
            let moving = [40.0 - y, x - 3.0, z + 2.0];
            let mut there = [moving[0] / 2.0, moving[1] / 3.0, moving[2] / 1.5];
            if two > 0.0 {
                there[0] = 24.0 - there[0];
            }
            let expected = deformed.affine().to_world(VoxelPoint(there));
            let found = chain.at(initial.affine().to_world(VoxelPoint(voxel))).unwrap();
            assert!(length(found.minus(expected)) < 1e-9, "{one} {two}: {found:?} {expected:?}");
        }
        // And back.
        let out = folder.path().join("again.mat");
        let format = AffineFormat::Flirt { initial: &initial, deformed: &deformed };
        io::write_affine(&out, &chain.affine().unwrap(), format).unwrap();
        let numbers: Vec<f64> =
            std::fs::read_to_string(&out).unwrap().split_whitespace().map(|w| w.parse().unwrap()).collect();
        let truth = [0.0, 1.0, 0.0, 3.0, -1.0, 0.0, 0.0, 40.0, 0.0, 0.0, 1.0, -2.0, 0.0, 0.0, 0.0, 1.0];
        assert!(numbers.iter().zip(truth).all(|(a, b)| (a - b).abs() < 1e-9), "{numbers:?}");
    }
}

#[test]
fn written_affines_come_back() {
    let folder = TempDir::new().unwrap();
    let mut random = Random::new(58, 0);
    for name in ["a.txt", "a.tfm", "a.mat"] {
        let map = affine(&mut random);
        let path = folder.path().join(name);
        io::write_affine(&path, &map, AffineFormat::Itk).unwrap();
        assert_eq!(read(&path).affine(), Some(map), "{name}");
        io::write_affine(&path, &map, AffineFormat::Matrix).unwrap();
        assert_eq!(read(&path).affine().unwrap().rows(), map.rows(), "{name}");
    }
}

#[test]
fn written_fields_come_back_from_every_convention() {
    let folder = TempDir::new().unwrap();
    let mut random = Random::new(59, 0);
    let far = |a: &DenseField, b: &DenseField| {
        assert!(a.grid().same_as(b.grid()));
        a.as_slice().iter().zip(b.as_slice()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    };
    for _ in 0..6 {
        let u = field(&mut random);
        let deformed = grid_about(&mut random, [7, 9, 8], 44.0);
        let formats = [
            ("u.nii", FieldFormat::Itk, TransformSource::Itk),
            ("u.nrrd", FieldFormat::Itk, TransformSource::Itk),
            ("u.mha", FieldFormat::Itk, TransformSource::Itk),
            ("u.nii.gz", FieldFormat::Niftyreg, TransformSource::Niftyreg),
            ("w.nii.gz", FieldFormat::Fsl { deformed: &deformed }, TransformSource::Fsl),
        ];
        for (name, format, source) in formats {
            let path = folder.path().join(name);
            io::write_field_as(&path, &u, format).unwrap();
            let found = io::read_transform(&path, Some(source), None, Some(&deformed)).unwrap();
            let [Transform::Field(v)] = &found.transforms[..] else { panic!("{name} is no field") };
            assert!(far(&u, v) < 2e-4, "{name}: {}", far(&u, v));
        }
        let path = folder.path().join("voxels.nii");
        io::write_field_as(&path, &u, FieldFormat::Voxels).unwrap();
        let voxels = io::read_field_as(&path, "ras".parse().unwrap(), None).unwrap();
        let back =
            DenseField::from_voxels(*u.grid(), |at, _| u.grid().affine().vector_to_world(voxels.at(at).map(f64::from)));
        assert!(far(&u, &back) < 1e-4);
        let error = io::write_field_as(folder.path().join("x.mha"), &u, FieldFormat::Niftyreg).unwrap_err();
        assert!(error.to_string().contains(".nii.gz"), "{error}");
    }
}

#[test]
fn files_with_flaws_are_named_with_what_is_wrong() {
    let folder = TempDir::new().unwrap();
    let affine = "AffineTransform_double_3_3";
    let rows = "1 0 0 0 1 0 0 0 1";
    let one = |name: &str, p: &str, fixed: &str| itk_text(&[(name, p, fixed)]);
    let cases: Vec<(&str, Vec<u8>, &str)> = vec![
        ("a.tfm", one(affine, "1 0 0 0 1 0 0 0 1 0 nan 0", "0 0 0").into(), "line 4: \"nan\""),
        ("b.tfm", one(affine, rows, "0 0 0").into(), "line 3: AffineTransform has 9 parameters"),
        ("c.tfm", one("AffineTransform_double_2_2", "1 0 0 1 0 0", "0 0").into(), "is 2-D"),
        ("d.tfm", one(affine, "1 0 0 2 0 0 0 0 1 0 0 0", "0 0 0").into(), "singular"),
        ("e.tfm", one("BSplineTransform_double_3_3", "1", "1").into(), "BSplineTransform is not read"),
        ("f.tfm", one(affine, "1 0 0 0 1 0 0 0 1 1e9 0 0", "0 0 0").into(), "1000000000"),
        ("g.tfm", one(affine, &format!("{rows} 0 0 0"), "0 0").into(), "2 fixed parameters"),
        ("h.tfm", "#Insight Transform File V1.0\n".into(), "no transform"),
        ("i.tfm", "#Insight Transform File V1.0\nParameters: 1\n".into(), "line 2 is odd"),
        (
            "j.tfm",
            one("DisplacementFieldTransform_double_3_3", "1 2 3", "90000 90000 90000 0 0 0 1 1 1 1 0 0 0 1 0 0 0 1")
                .into(),
            "3 numbers for its size",
        ),
        (
            "k.tfm",
            one("DisplacementFieldTransform_double_3_3", "1 2 3", "1 1 1 0 0 0 1 1 1 1 0 0 1 0 0 0 0 1").into(),
            "grid without extent",
        ),
        ("l.tfm", one("Quux", "1", "").into(), "\"Quux\" is no kind"),
        ("m.mat", "1 0 0 0\n0 1 0 0\n0 0 1\n0 0 0 1\n".into(), "line 3: 3 numbers instead of 4"),
        ("n.mat", "1 0 0 0\n0 1 0 0\n0 0 inf 0\n0 0 0 1\n".into(), "line 3: \"inf\""),
        ("o.mat", "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 1 1\n".into(), "not affine"),
        ("p.mat", "1 0 0 0\n0 1 0 0\n0 0 1 0\n".into(), "3 lines of numbers"),
        ("q.mat", "1 0 0 0\n0 1 0 0\n0 1 0 0\n0 0 0 1\n".into(), "singular"),
        ("r.mat", "1 0 0\n0 1 0\n0 0 1\n".into(), "2-D"),
        ("s.h5", b"\x89HDF\r\n\x1a\n...".to_vec(), "HDF5"),
        ("t.mat", b"MATLAB 5.0 MAT-file, Platform: GLNXA64".to_vec(), "MATLAB 5"),
        ("u.txt", "(Transform \"EulerTransform\")\n".into(), "transformix -def all"),
        ("v.mat", matlab(false, false, &[(affine, &[1.0, f64::NAN]), ("fixed", &[0.0])]), "not finite"),
        ("w.mat", matlab(true, false, &[(affine, &[1.0; 12]), ("fixed", &[0.0; 3])]), "singular"),
        ("x.txt", "hello".into(), "not a NIfTI"),
    ];
    for (name, content, message) in cases {
        let error = io::read_transform(put(&folder, name, content), None, None, None).unwrap_err().to_string();
        assert!(error.contains(name) && error.contains(message), "{name}: {error}");
    }
    let error = io::read_transform(folder.path().join("none.mat"), None, None, None).unwrap_err().to_string();
    assert!(error.contains("none.mat") && error.contains("cannot read"), "{error}");
    let tfm = put(&folder, "ok.tfm", one(affine, &format!("{rows} 0 0 0"), "0 0 0"));
    let error = io::read_transform(&tfm, Some(TransformSource::Fsl), None, None).unwrap_err().to_string();
    assert!(error.contains("ok.tfm") && error.contains("ITK"), "{error}");
    let matrix = put(&folder, "ok.mat", RAS);
    let error = io::read_transform(&matrix, Some(TransformSource::Itk), None, None).unwrap_err().to_string();
    assert!(error.contains("ok.mat") && error.contains("fsl:"), "{error}");
}

// Label maps.

fn cube(n: usize) -> Grid {
    Grid::new([n; 3], Affine::scaled([1.0; 3], [0.0; 3]).unwrap()).unwrap()
}

#[test]
fn label_maps_are_told_from_images() {
    let mut random = Random::new(60, 0);
    // Blocks of n voxels a side, a label of its own for each of some hundred.
    let blocks = |n: usize, labels: usize| {
        Volume::from_voxels(cube(24), |_, p| {
            let b = p.0.map(|v| v as usize / n);
            let hash = (b[0] * 73 + b[1] * 179 + b[2] * 283) % labels;
            if p.0.iter().any(|v| !(4.0..20.0).contains(v)) { 0.0 } else { (1000 + 7 * hash) as f32 }
        })
    };
    for (n, labels) in [(4, 5), (4, 60), (8, 3)] {
        assert!(is_label_map(&blocks(n, labels)), "{n} {labels}");
    }
    let map = |f: &dyn Fn([f64; 3]) -> f64| {
        Volume::from_vec(
            cube(24),
            (0..24 * 24 * 24)
                .map(|at| {
                    let [i, j, k] = cube(24).voxel(at);
                    f([i, j, k].map(|v| v as f64)) as f32
                })
                .collect(),
        )
        .unwrap()
    };
    let sheet = map(&|p| f64::from(u8::from(p[0] == 11.0)));
    assert!(is_label_map(&sheet), "a mask one voxel thin");
    // An image: smooth, with noise of two gray levels, whole numbers, a background of 0.
    let noise: Vec<f64> = (0..24 * 24 * 24).map(|_| 2.0 * random.normals()[0]).collect();
    let image = map(&|p| {
        let at = (p[0] + 24.0 * (p[1] + 24.0 * p[2])) as usize;
        let tissue = p.iter().all(|v| (4.0..20.0).contains(v));
        if tissue { (100.0 + 20.0 * (0.2 * p[0]).sin() + noise[at]).round() } else { 0.0 }
    });
    assert!(!is_label_map(&image));
    assert!(!is_label_map(&map(&|p| (0.3 * p[0]).sin())), "no whole numbers");
    assert!(!is_label_map(&map(&|_| 3.0)), "one value");
    assert!(!is_label_map(&map(&|p| p[0] + 24.0 * (p[1] + 24.0 * p[2]))), "each its own");
    let folder = small_pair();
    for (name, expected) in [("initial", false), ("deformed", false), ("mask", true)] {
        let volume = io::read_volume(folder.path().join(format!("{name}.nii.gz"))).unwrap();
        assert_eq!(is_label_map(&volume), expected, "{name}");
    }
}

#[test]
fn the_label_with_most_weight_wins() {
    // Along x: 3 3 9 9 9 9, shifted by less than half a voxel in x and y.
    let labels = Volume::from_voxels(cube(6), |_, p| if p.0[0] < 1.5 { 3.0 } else { 9.0 });
    let shift = |x: f64, y: f64| {
        let rows = [[1.0, 0.0, 0.0, x], [0.0, 1.0, 0.0, y], [0.0, 0.0, 1.0, 0.0]];
        Chain(vec![Transform::Affine(AffineMap::new(rows).unwrap())])
    };
    let row = |x, y| {
        let found = resample(&labels, &shift(x, y), &cube(6), Interpolation::Label, 0.0);
        (found.image.as_slice()[36 * 2 + 6 * 2..][..6].to_vec(), found.outside)
    };
    assert_eq!(row(0.4, 0.3), (vec![3.0, 3.0, 9.0, 9.0, 9.0, 9.0], 0));
    assert_eq!(row(0.6, 0.3), (vec![3.0, 9.0, 9.0, 9.0, 9.0, 0.0], 36));
    // A corner of 3 in a plane of 7 and 9: by weight 9, though the nearest voxel is 3.
    let grid = Grid::new([2, 2, 1], Affine::scaled([1.0; 3], [0.0; 3]).unwrap()).unwrap();
    let corner = Volume::from_vec(grid, vec![3.0, 9.0, 9.0, 7.0]).unwrap();
    let one = Grid::new([1; 3], Affine::scaled([1.0; 3], [0.0; 3]).unwrap()).unwrap();
    let at = |how| resample(&corner, &shift(0.45, 0.45), &one, how, 0.0).image.as_slice()[0];
    assert_eq!(at(Interpolation::Nearest), 3.0);
    assert_eq!(at(Interpolation::Label), 9.0);
}

// The program.

/// A folder with an image, labels, a field and affine files on oblique grids; the fixed grid is
/// `initial.nii.gz`'s.
fn workplace() -> (TempDir, Grid, DenseField) {
    let folder = TempDir::new().unwrap();
    let at = |name: &str| folder.path().join(name);
    let (fixed, moving) = (placed([16, 14, 12], 1.0, 0.0), placed([14, 16, 14], -1.0, 0.0));
    // The flipped one lies over the other but for three voxels along x.
    let mut rows = moving.affine().rows();
    (0..3).for_each(|r| rows[r][3] = fixed.affine().rows()[r][3] - 16.0 * rows[r][0]);
    let moving = Grid::new([14, 16, 14], Affine::new(rows).unwrap()).unwrap();
    let wave = |p: WorldPoint| 500.0 + 200.0 * (0.2 * p.0[0]).sin() + 100.0 * (0.15 * p.0[1] + 0.2 * p.0[2]).cos();
    io::write_exact(at("initial.nii.gz"), &Volume::from_voxels(fixed, |_, p| wave(p) as f32), "").unwrap();
    io::write_exact(at("image.nii.gz"), &Volume::from_voxels(moving, |_, p| wave(p) as f32), "").unwrap();
    let label = |p: WorldPoint| 1 + u8::from(p.0[0] > 20.0) + 2 * u8::from(p.0[1] > 10.0);
    io::write_labels(at("labels.nii.gz"), &Mask::from_voxels(moving, |_, p| label(p)), "").unwrap();
    let field = DenseField::from_fn(fixed, |p| [1.0 + 0.05 * p.0[1], -0.5, 0.04 * p.0[0]]);
    io::write_field(at("field.nii.gz"), &field).unwrap();
    std::fs::write(at("a.mat"), "1.02 0.03 0 1\n-0.03 1 0.01 -0.8\n0 -0.01 0.98 0.5\n0 0 0 1\n").unwrap();
    std::fs::write(at("far.mat"), "1 0 0 900\n0 1 0 0\n0 0 1 0\n0 0 0 1\n").unwrap();
    (folder, fixed, field)
}

#[test]
fn warp_takes_a_chain_of_files_in_one_interpolation() {
    let (folder, fixed, _) = workplace();
    let image = io::read_volume(folder.path().join("image.nii.gz")).unwrap();
    let field = io::read_field(folder.path().join("field.nii.gz")).unwrap();
    let map = read(&folder.path().join("a.mat")).affine().unwrap();
    let arguments = ["warp", "image.nii.gz", "--transform", "field.nii.gz", "greedy:a.mat,-1", "-o", "out.nii.gz"];
    let (out, err) = run(folder.path(), &arguments, 0);
    assert!(out.contains("% of the voxels come from outside image.nii.gz") && err.is_empty(), "{out}{err}");
    let warped = io::read_volume(folder.path().join("out.nii.gz")).unwrap();
    assert!(warped.grid().same_as(&fixed));
    let chain = Chain(vec![Transform::Field(field), Transform::Affine(map.inverse())]);
    let expected = resample(&image, &chain, &fixed, Interpolation::Linear, 0.0);
    let apart =
        |v: &Volume| v.as_slice().iter().zip(expected.image.as_slice()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(apart(&warped) < 0.05, "{}", apart(&warped));
    // The way back of the way back.
    let back = ["warp", "image.nii.gz", "--transform", "a.mat", "field.nii.gz,-1", "--inverse", "-o", "back.nii.gz"];
    let (_, err) = run(folder.path(), &back, 0);
    assert!(err.contains("a.mat") && err.contains("taken as greedy's") && err.contains("fsl:"), "{err}");
    assert!(apart(&io::read_volume(folder.path().join("back.nii.gz")).unwrap()) < 0.05);
    // Points.
    std::fs::write(folder.path().join("p.csv"), "x,y,z\n20,12,9\n9000,0,0\n").unwrap();
    let points = ["warp", "--points", "p.csv", "--transform", "field.nii.gz", "greedy:a.mat,-1", "-o", "q.csv"];
    let (_, err) = run(folder.path(), &points, 0);
    assert!(err.contains("1 of 2 points"), "{err}");
    let moved = io::read_points(folder.path().join("q.csv")).unwrap_err().to_string();
    assert!(moved.contains("NaN") || moved.contains("finite"), "{moved}");
    let line = std::fs::read_to_string(folder.path().join("q.csv")).unwrap();
    let first: Vec<f64> = line.lines().nth(1).unwrap().split(',').map(|v| v.parse().unwrap()).collect();
    let truth = chain.at(WorldPoint([20.0, 12.0, 9.0])).unwrap();
    assert!((0..3).all(|c| (first[c] - truth.0[c]).abs() < 1e-5), "{first:?} {truth:?}");
}

#[test]
fn label_maps_are_warped_by_nearest_neighbour_unless_asked() {
    let (folder, ..) = workplace();
    let warp = |extra: &[&str]| {
        let arguments = [&["warp", "labels.nii.gz", "--transform", "field.nii.gz", "-o", "l.nii.gz"], extra].concat();
        let (out, err) = run(folder.path(), &arguments, 0);
        let volume = io::read_volume(folder.path().join("l.nii.gz")).unwrap();
        let whole = volume.as_slice().iter().all(|v| v.fract() == 0.0 && *v <= 4.0);
        (out, err, whole, io::read_header(folder.path().join("l.nii.gz")).unwrap().0.datatype)
    };
    let (out, err, whole, datatype) = warp(&[]);
    assert!(out.contains("labels.nii.gz is a label map") && err.is_empty() && whole, "{out}{err}");
    assert_eq!(datatype, "uint8");
    let (out, err, whole, datatype) = warp(&["--interpolation", "label"]);
    assert!(!out.contains("is a label map") && err.is_empty() && whole && datatype == "uint8", "{out}{err}");
    let (_, err, whole, datatype) = warp(&["--interpolation", "linear"]);
    assert!(err.contains("looks like a label map") && !whole && datatype == "float32", "{err}");
    let arguments =
        ["warp", "image.nii.gz", "--transform", "field.nii.gz", "--interpolation", "label", "-o", "x.nii.gz"];
    let (_, err) = run(folder.path(), &arguments, 1);
    assert!(err.contains("image.nii.gz") && err.contains("whole numbers"), "{err}");
    // NIfTI's intent alone, of what does not look like one.
    let path = folder.path().join("said.nii");
    io::write_exact(&path, &Volume::from_voxels(cube(6), |at, _| at as f32), "").unwrap();
    let mut bytes = std::fs::read(&path).unwrap();
    bytes[68..70].copy_from_slice(&1002i16.to_le_bytes());
    std::fs::write(&path, bytes).unwrap();
    let (out, _) = run(folder.path(), &["warp", "said.nii", "--reference", "said.nii", "-o", "again.nii"], 0);
    assert!(out.contains("said.nii is a label map"), "{out}");
}

#[test]
fn what_would_be_empty_is_an_error_and_nothing_is_written() {
    let (folder, ..) = workplace();
    let far = "greedy:far.mat";
    let cases: [(&[&str], &str); 5] = [
        (
            &["warp", "image.nii.gz", "--transform", far, "--reference", "initial.nii.gz", "-o", "x.nii.gz"],
            "image.nii.gz: no voxel",
        ),
        (&["warp", "image.nii.gz", "--transform", far, "field.nii.gz", "-o", "x.nii.gz"], "image.nii.gz: no voxel"),
        (&["compose", far, "field.nii.gz", "-o", "x.nii.gz"], "lead nowhere"),
        (&["compose", "none.tfm", "-o", "x.tfm"], "none.tfm: cannot read"),
        (&["warp", "image.nii.gz", "--transform", "fsl:a.mat", "-o", "x.nii.gz"], "--initial"),
    ];
    for (arguments, message) in cases {
        let (_, err) = run(folder.path(), arguments, 1);
        assert!(err.contains(message), "{arguments:?}: {err}");
        assert!(!folder.path().join("x.nii.gz").exists());
    }
    let grid = cube(8);
    io::write_field(folder.path().join("away.nii"), &DenseField::from_fn(grid, |_| [90.0, 0.0, 0.0])).unwrap();
    let (_, err) = run(folder.path(), &["invert", "away.nii", "-o", "x.nii.gz"], 1);
    assert!(err.contains("away.nii") && err.contains("empty"), "{err}");
    assert!(!folder.path().join("x.nii.gz").exists());
}

#[test]
fn wrong_usage_of_transforms_is_answered_with_what_to_do() {
    let (folder, ..) = workplace();
    let cases: [(&[&str], &str); 9] = [
        (&["warp", "image.nii.gz", "--transform", "greedy:a.mat", "-o", "x.nii.gz"], "--reference"),
        (
            &["warp", "image.nii.gz", "--transform", "flirt:a.mat", "-o", "x.nii.gz"],
            "unknown kind of transform 'flirt'",
        ),
        (
            &["warp", "image.nii.gz", "--transform", "a.mat", "--field", "field.nii.gz", "-o", "x.nii.gz"],
            "cannot be used",
        ),
        (&["compose", "field.nii.gz", "-o", "x.mat"], "no affine"),
        (&["compose", "greedy:a.mat", "-o", "x.nii.gz"], "--reference"),
        (&["convert", "greedy:a.mat", "--to", "fsl", "-o", "x.mat"], "--initial"),
        (&["convert", "greedy:a.mat", "--to", "voxels", "-o", "x.mat"], "takes a field"),
        (&["convert", "field.nii.gz", "--to", "fsl", "-o", "x.nii"], "--deformed"),
        (&["convert", "field.nii.gz", "--to", "slicer", "-o", "x.nii"], "known: itk, fsl"),
    ];
    for (arguments, message) in cases {
        let (_, err) = run(folder.path(), arguments, 2);
        assert!(err.contains(message), "{arguments:?}: {err}");
    }
    let over = palpate(folder.path()).args(["compose", "greedy:a.mat", "-o", "a.mat"]).output().unwrap();
    assert!(text(&over.stderr).contains("would be overwritten"));
}

#[test]
fn compose_and_convert_write_what_was_read() {
    let (folder, fixed, field) = workplace();
    let at = |name: &str| folder.path().join(name);
    let map = read(&at("a.mat")).affine().unwrap();
    run(folder.path(), &["compose", "greedy:a.mat", "greedy:a.mat", "-o", "twice.tfm"], 0);
    let near = |a: &AffineMap, b: &AffineMap| {
        a.rows().iter().flatten().zip(b.rows().iter().flatten()).all(|(a, b)| (a - b).abs() < 1e-9)
    };
    assert!(near(&read(&at("twice.tfm")).affine().unwrap(), &map.then(&map)));
    // FLIRT's matrix there and back, and turned round, which swaps its volumes.
    let volumes = ["--initial", "initial.nii.gz", "--deformed", "image.nii.gz"];
    run(folder.path(), &[&["convert", "greedy:a.mat", "--to", "fsl", "-o", "f.mat"][..], &volumes].concat(), 0);
    run(folder.path(), &[&["convert", "fsl:f.mat", "--to", "itk", "-o", "b.txt"][..], &volumes].concat(), 0);
    assert!(near(&read(&at("b.txt")).affine().unwrap(), &map));
    run(folder.path(), &[&["convert", "fsl:f.mat,-1", "--to", "fsl", "-o", "g.mat"][..], &volumes].concat(), 0);
    let number = |name: &str| read(&at(name)).affine().unwrap();
    assert!(near(&number("g.mat"), &number("f.mat").inverse()), "FSL's own inverse is that of the numbers");
    // A FLIRT matrix in a warp leads between the volumes of the command.
    let warp = ["--reference", "initial.nii.gz", "-o"];
    run(
        folder.path(),
        &[&["warp", "image.nii.gz", "--transform", "fsl:f.mat"][..], &warp, &["one.nii.gz"]].concat(),
        0,
    );
    run(folder.path(), &[&["warp", "image.nii.gz", "--transform", "b.txt"][..], &warp, &["two.nii.gz"]].concat(), 0);
    let [one, two] = ["one.nii.gz", "two.nii.gz"].map(|n| io::read_volume(at(n)).unwrap());
    assert!(one.as_slice().iter().zip(two.as_slice()).all(|(a, b)| (a - b).abs() < 0.05));
    // Of several it is not known between which.
    let several = ["warp", "image.nii.gz", "--transform", "field.nii.gz", "fsl:f.mat", "-o", "x.nii"];
    let (_, err) = run(folder.path(), &several, 1);
    assert!(err.contains("f.mat") && err.contains("--deformed"), "{err}");
    let (out, _) = run(folder.path(), &["info", "twice.tfm", "a.mat"], 0);
    assert!(out.contains("initial to deformed") && out.contains("fsl:"), "{out}");
    // A field, and the folder of a run.
    std::fs::create_dir(at("results")).unwrap();
    std::fs::copy(at("field.nii.gz"), at("results/displacement.nii.gz")).unwrap();
    for (to, name, options) in [
        ("itk", "u.nrrd", &[][..]),
        ("greedy", "u.mha", &[]),
        ("niftyreg", "niftyreg:u.nii.gz", &[]),
        ("fsl", "fsl:w.nii.gz", &["--deformed", "image.nii.gz"]),
    ] {
        let file = name.rsplit(':').next().unwrap();
        run(folder.path(), &[&["convert", "results", "--to", to, "-o", file][..], options].concat(), 0);
        run(folder.path(), &[&["compose", name, "-o", "again.nii"][..], options].concat(), 0);
        let again = io::read_field(at("again.nii")).unwrap();
        assert!(again.grid().same_as(&fixed), "{name}");
        let apart = again.as_slice().iter().zip(field.as_slice()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(apart < 1e-3, "{name}: {apart}");
    }
}
