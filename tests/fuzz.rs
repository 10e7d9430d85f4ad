//! Readers against changed bytes: no panic, no more memory than the file could honestly need, no
//! wrong voxels from a file that checks itself.
//!
//! Two seconds for all in a usual run;
//! `PALPATE_FUZZ_SECONDS=3600 cargo test --release --test fuzz -- --nocapture` takes that long for
//! each reader, or ten million cases where they come first, and prints their number.
//! `PALPATE_FUZZ_KINDS=v.nii,v.mha` takes those files alone.
#![allow(clippy::unwrap_used)]

#[path = "fixtures/slices.rs"]
mod slices;

use flate2::{Compression, write::GzEncoder, write::ZlibEncoder};
use palpate::io::{self, SceneOverrides};
use palpate::numerics::random::Random;

use palpate::types::{Affine, DenseField, FieldParams, Grid, TetMesh, Transform, Volume, WorldPoint};
use peak_alloc::PeakAlloc;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use tempfile::TempDir;

#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;

/// What a reader may take whatever the file: buffers, tables of the unpacker, messages (bytes).
const SLACK: usize = 3 << 20;
/// Cases after which a reader has been tried enough.
const ENOUGH: u64 = 10_000_000;

/// One kind of file: its name, a good one, and a reader that says how many numbers it gave.
struct Kind {
    name: &'static str,
    good: Vec<u8>,
    read: fn(&Path) -> Option<Vec<f32>>,
    /// Bytes of memory for a byte of the file.
    ratio: usize,
    /// Whether a change that is not noticed must not change what is read.
    checked: bool,
    /// Files that lie in the same folder.
    beside: Vec<(&'static str, Vec<u8>)>,
}

fn volume(path: &Path) -> Option<Vec<f32>> {
    io::read_volume(path).ok().map(Volume::into_vec)
}

fn nothing<T>(found: Result<T, impl std::fmt::Display>) -> Option<Vec<f32>> {
    // A message must come without a panic too.
    found.map_err(|e| e.to_string()).ok().map(|_| Vec::new())
}

fn transform(path: &Path) -> Option<Vec<f32>> {
    nothing(io::read_transform(path, None, None, None))
}

fn write(path: &Path, bytes: &[u8]) -> PathBuf {
    fs::write(path, bytes).unwrap();
    path.into()
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut out = GzEncoder::new(Vec::new(), Compression::default());
    out.write_all(bytes).unwrap();
    out.finish().unwrap()
}

fn kinds() -> Vec<Kind> {
    let folder = TempDir::new().unwrap();
    let at = |name: &str| folder.path().join(name);
    let rows = [[0.9, 0.1, 0.0, 3.0], [-0.1, 0.9, 0.0, -4.0], [0.0, 0.0, 2.0, 5.0]];
    let grid = Grid::new([7, 6, 5], Affine::new(rows).unwrap()).unwrap();
    let small = Volume::from_voxels(grid, |n, _| (n * 37 % 101) as f32);
    io::write_volume(at("v.nii"), &small, "").unwrap();
    io::write_field(at("f.nii"), &DenseField::from_fn(grid, |p| p.0.map(|x| 0.01 * x))).unwrap();
    let [nifti, field] = ["v.nii", "f.nii"].map(|n| fs::read(at(n)).unwrap());
    let raw: Vec<u8> = small.as_slice().iter().flat_map(|v| v.to_le_bytes()).collect();
    // NIfTI-2 by hand: sizes, type, shape, spacing, offset, codes.
    let mut second = vec![0u8; 544];
    let mut put = |at: usize, bytes: &[u8]| second[at..at + bytes.len()].copy_from_slice(bytes);
    put(0, &540i32.to_le_bytes());
    put(4, b"n+2\0\r\n\x1a\n");
    put(12, &16i16.to_le_bytes());
    put(14, &32i16.to_le_bytes());
    [3i64, 7, 6, 5, 1, 1, 1, 1].iter().enumerate().for_each(|(i, d)| put(16 + 8 * i, &d.to_le_bytes()));
    (0..8).for_each(|i| put(104 + 8 * i, &1f64.to_le_bytes()));
    put(168, &544i64.to_le_bytes());
    second.extend(&raw);
    let nrrd = b"NRRD0004\ntype: float\ndimension: 3\nspace: left-posterior-superior\nsizes: 7 6 5\n\
        space directions: (1,0,0) (0,1,0) (0,0,2)\nkinds: domain domain domain\nendian: little\nencoding: raw\n\
        space origin: (1,2,3)\n\n";
    let meta = b"ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\nOffset = 1 2 3\n\
        ElementSpacing = 1 1 2\nDimSize = 7 6 5\nElementType = MET_FLOAT\nElementDataFile = LOCAL\n";
    let points = "x,y,z\n1,2,3\n-4.5,5e1,6\n7,8,9\n";
    let landmarks = "fx,fy,fz,mx,my,mz\n1,2,3,1.5,2,3\n4,5,6,4,5,7\n";
    let markups = r#"{"markups":[{"type":"Fiducial","coordinateSystem":"LPS","controlPoints":[{"label":"a","position":[1,2,3]}]}]}"#;
    let fcsv = "# Markups fiducial file version = 4.11\n# CoordinateSystem = LPS\n# columns = id,x,y,z\n1,2,3,4\n";
    let config = serde_json::to_vec(&serde_json::json!({ "params": FieldParams::default() })).unwrap();
    let scene = include_bytes!("../examples/eight_motions.toml").to_vec();
    let skin = include_bytes!("../examples/skin.toml").to_vec();
    let mut zlib = ZlibEncoder::new(Vec::new(), Compression::default());
    zlib.write_all(&raw).unwrap();
    let zlib = zlib.finish().unwrap();
    let text = |v: &[u8]| String::from_utf8(v.to_vec()).unwrap();
    let packed_nrrd = text(nrrd).replace("encoding: raw", "encoding: gzip").into_bytes();
    let packed_meta = format!("CompressedData = True\nCompressedDataSize = {}\nElementDataFile", zlib.len());
    let packed_meta = text(meta).replace("ElementDataFile", &packed_meta).into_bytes();
    let matches = "x,y,z,dx,dy,dz,ncc,sigma,kept\n1,2,3,0.5,0,0,0.9,0.1,1\n4,5,6,0,0.25,0,0.8,0.2,1\n";
    let table = "initial,deformed,mask,force_n,subject\na.nii,b.nii,,2.5,01\nc.nii,d.nii,m.nii,,02\n";
    let paths = "point,frame,time_s,x,y,z,sigma,state\n0,0,0,1,2,3,0.1,measured\n0,1,0.1,1.5,2,3,0.1,measured\n";
    let told =
        br#"{"command":"stiffness","absolute":true,"poisson":0.49,"force_n":2.5,"inputs":{"load":"z-","held":"z+"},
        "regions":[{"id":1,"name":"pulp","youngs_modulus":30,"sd":2,"identifiable":true,"voxels":9,"bound":null}],
        "patches":{"held":{"translation":[0,0,0]},"loaded":{"translation":[0,0,1],"travel_mm":1}}}"#;
    let fingertip = b"youngs_modulus = 1e4\n[pad]\ncalibration = 1.02\nfinite_element_nodes = 2500\n";
    let slices = [0, 1, 2].map(|n| slices::Slice::new(n).bytes());
    let in_syntax = |syntax| slices::Slice { syntax, ..slices::Slice::new(1) }.bytes();
    let three = [0, 1, 2].map(slices::Slice::new);
    let mut pair = nifti[..348].to_vec();
    pair[344..348].copy_from_slice(b"ni1\0");
    pair[108..112].fill(0);
    let units = r#"{"markups":[{"coordinateUnits":["cm","cm","cm"],"controlPoints":[{"position":[1,2,3]}]}]}"#;
    let itk = "#Insight Transform File V1.0\n#Transform 0\nTransform: CompositeTransform_double_3_3\n#Transform 1\n\
        Transform: Euler3DTransform_double_3_3\nParameters: 0.1 0.2 0.3 4 5 6\nFixedParameters: 1 2 3 0\n#Transform 2\n\
        Transform: DisplacementFieldTransform_double_3_3\nParameters: 1 2 3 4 5 6\n\
        FixedParameters: 2 1 1 0 0 0 1 1 1 1 0 0 0 1 0 0 0 1\n";
    let matrix = "1.1 0.1 -0.2 4\n0.3 0.9 0.1 5\n0.05 -0.1 1.2 6\n0 0 0 1\n";
    let map = io::read_transform(write(&at("m.mat"), matrix.as_bytes()), None, None, None).unwrap().transforms;
    let [Transform::Affine(map)] = map[..] else { panic!("no affine map") };
    io::write_affine(at("ants.mat"), &map, io::AffineFormat::Itk).unwrap();
    let ants = fs::read(at("ants.mat")).unwrap();
    let corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(WorldPoint).to_vec();
    let tetrahedron = TetMesh::new(corners, vec![[0, 1, 2, 3]]).unwrap();
    io::write_tet_mesh(at("body.vtu"), &tetrahedron, &[[0.0; 3]; 4], &[]).unwrap();
    let vtu = fs::read(at("body.vtu")).unwrap();
    let inp = "*NODE, NSET=ALL\n1, 0, 0, 0\n2, 1, 0, 0\n3, 0, 1, 0\n4, 0, 0, 1\n*ELEMENT, TYPE=C3D4\n7, 1, 2, 3, 4\n\
        *NSET, NSET=HELD, GENERATE\n1, 3, 2\n";
    let feb = "<febio_spec version=\"4.0\"><Mesh><Nodes><node id=\"1\">0,0,0</node><node id=\"2\">1,0,0</node>\
        <node id=\"3\">0,1,0</node><node id=\"4\">0,0,1</node></Nodes><Elements type=\"tet4\"><elem id=\"1\">1,2,3,4</elem>\
        </Elements><NodeSet name=\"held\">1,3</NodeSet></Mesh></febio_spec>";
    let solid = |path: &Path| nothing(io::SolidFile::read(path));
    let kind = |name, good, read, ratio, checked| Kind { name, good, read, ratio, checked, beside: Vec::new() };
    vec![
        kind("v.nii", nifti.clone(), volume as fn(&Path) -> Option<Vec<f32>>, 2, false),
        kind("v.nii.gz", gzip(&nifti), volume, 2 * 1032, true),
        kind("second.nii", second.clone(), volume, 2, false),
        kind("second.nii.gz", gzip(&second), volume, 2 * 1032, true),
        kind("field.nii.gz", gzip(&field), |p| io::read_field(p).ok().map(|f| f.as_slice().to_vec()), 2 * 1032, true),
        kind("v.nrrd", [&nrrd[..], &raw].concat(), volume, 2, false),
        kind("v.mha", [&meta[..], &raw].concat(), volume, 2, false),
        kind("points.csv", points.into(), |p| nothing(io::read_points(p)), 64, false),
        kind("landmarks.csv", landmarks.into(), |p| nothing(io::read_landmarks(p)), 64, false),
        kind("points.mrk.json", markups.into(), |p| nothing(io::read_points(p)), 64, false),
        kind("points.fcsv", fcsv.into(), |p| nothing(io::read_points(p)), 64, false),
        kind("config.json", config, |p| nothing(io::read_config(p)), 64, false),
        kind("scene.toml", scene, |p| nothing(io::read_scene(p, &SceneOverrides::default())), 64, false),
        kind("skin.toml", skin, |p| nothing(io::read_skin_scene(p)), 64, false),
        kind("packed.nrrd", [packed_nrrd, gzip(&raw)].concat(), volume, 2 * 1032, false),
        kind("packed.mha", [packed_meta, zlib].concat(), volume, 2 * 1032, false),
        kind("matches.csv", matches.into(), |p| nothing(io::read_matches(p)), 64, false),
        kind("pairs.csv", table.into(), |p| nothing(io::read_pairs(p)), 64, false),
        kind("trajectories.csv", paths.into(), |p| nothing(io::read_trajectories(p, 0)), 64, false),
        kind("fingertip.toml", fingertip.to_vec(), |p| nothing(io::read_fingertip_press(p)), 64, false),
        kind("chain.tfm", itk.into(), transform, 64, false),
        kind("matrix.mat", matrix.into(), transform, 64, false),
        kind("0GenericAffine.mat", ants, transform, 64, false),
        kind("body.inp", inp.into(), solid, 64, false),
        kind("body.feb", feb.into(), solid, 64, false),
        // A byte of a packed array becomes a number of eight.
        kind("body.vtu", vtu, solid, 10 * 1032, false),
        Kind {
            beside: vec![("stiffness.nii.gz", gzip(&nifti))],
            ..kind("summary.json", told.to_vec(), |p| nothing(io::read_stiffness(p.parent()?)), 64, false)
        },
        Kind {
            beside: vec![("0", slices[0].clone()), ("2", slices[2].clone())],
            ..kind("slice.dcm", slices[1].clone(), |p| volume(p.parent()?), 64, false)
        },
        kind("big.dcm", in_syntax(slices::BIG_ENDIAN), volume, 64, false),
        // A byte of these unpacks to many, of which each pair becomes a number of four.
        kind("deflated.dcm", in_syntax(slices::DEFLATED), volume, 8 * 1032, false),
        kind("rle.dcm", in_syntax(slices::RLE), volume, 8 * 64, false),
        kind("jpeg.dcm", include_bytes!("fixtures/lossless.dcm").to_vec(), volume, 8 * 512, false),
        kind("frames.dcm", slices::Slice::enhanced(&three, slices::EXPLICIT), volume, 64, false),
        kind("frames_rle.dcm", slices::Slice::enhanced(&three, slices::RLE), volume, 8 * 64, false),
        kind("mosaic.dcm", slices::Slice::mosaic(&three), volume, 64, false),
        Kind { beside: vec![("p.img", raw.clone())], ..kind("p.hdr", pair, volume, 64, false) },
        kind("units.mrk.json", units.into(), |p| nothing(io::read_points(p)), 64, false),
    ]
}

/// Numbers that break things.
const EDGES: [u64; 10] = [0, 1, 0x7f, 0x80, 0xff, 0x7fff, 0x8000_0000, 0x7f80_0000, 0x7fff_ffff_ffff_ffff, u64::MAX];

/// A few changes: bytes, edges, cuts, repeats, pieces moved.
fn changed(good: &[u8], random: &mut Random) -> Vec<u8> {
    let mut out = good.to_vec();
    let below = |random: &mut Random, n: usize| (random.bits() % n.max(1) as u64) as usize;
    for _ in 0..=below(random, 4) {
        let at = below(random, out.len());
        match below(random, 8) {
            0 => out.truncate(at),
            1 => out.insert(at, random.bits() as u8),
            2 => {
                let to = (at + below(random, 40)).min(out.len());
                let piece = out[at.min(to)..to].to_vec();
                let there = below(random, out.len() + 1);
                out.splice(there..there, piece);
            }
            3 => drop(out.splice(at..(at + below(random, 9)).min(out.len()), [])),
            4 => {
                let edge = EDGES[below(random, EDGES.len())];
                let width = [1, 2, 4, 8][below(random, 4)];
                let bytes =
                    if random.bits() & 1 == 0 { edge.to_le_bytes() } else { edge.rotate_right(8).to_be_bytes() };
                for (o, b) in out.iter_mut().skip(at).take(width).zip(bytes) {
                    *o = b;
                }
            }
            5 => out.extend_from_slice(&random.bits().to_le_bytes()),
            _ => {
                if let Some(o) = out.get_mut(at) {
                    *o ^= 1 << (random.bits() & 7);
                }
            }
        }
        if out.is_empty() {
            break;
        }
    }
    out
}

// One test: the memory of all threads is counted.
#[test]
fn changed_files_are_read_right_or_refused() {
    let seconds = std::env::var("PALPATE_FUZZ_SECONDS").ok().and_then(|s| s.parse().ok());
    let only = std::env::var("PALPATE_FUZZ_KINDS").ok();
    let kinds: Vec<Kind> =
        kinds().into_iter().filter(|k| only.as_ref().is_none_or(|o| o.split(',').any(|n| n == k.name))).collect();
    let each = Duration::from_secs_f64(seconds.unwrap_or(2.0 / kinds.len() as f64));
    let memory = Path::new("/dev/shm");
    let folder = if memory.is_dir() { TempDir::new_in(memory) } else { TempDir::new() }.unwrap();
    for Kind { name, good, read, ratio, checked, beside } in kinds {
        let own = folder.path().join(format!("of-{name}"));
        fs::create_dir(&own).unwrap();
        let path = own.join(name);
        beside.iter().for_each(|(other, bytes)| fs::write(own.join(other), bytes).unwrap());
        fs::write(&path, &good).unwrap();
        let Some(truth) = read(&path) else { panic!("{name}: the good file is refused") };
        let mut random = Random::new(u64::from(std::process::id()) * u64::from(seconds.is_some()), 3);
        let started = Instant::now();
        let (mut cases, mut accepted) = (0u64, 0u64);
        while started.elapsed() < each && cases < ENOUGH {
            let bytes = changed(&good, &mut random);
            fs::write(&path, &bytes).unwrap();
            let keep = || {
                let kept = std::env::temp_dir().join(format!("palpate-fuzz-{name}"));
                fs::write(&kept, &bytes).unwrap();
                kept
            };
            let before = MEMORY.current_usage();
            MEMORY.reset_peak_usage();
            let found = std::panic::catch_unwind(|| read(&path)).unwrap_or_else(|_| panic!("panic, see {:?}", keep()));
            let taken = MEMORY.peak_usage() - before;
            let most = ratio * bytes.len() + SLACK;
            assert!(taken <= most, "{taken} bytes of memory for {} of a file, see {:?}", bytes.len(), keep());
            if let Some(found) = found {
                accepted += 1;
                let same = found.iter().map(|v| v.to_bits()).eq(truth.iter().map(|v| v.to_bits()));
                assert!(!checked || same, "wrong numbers in silence, see {:?}", keep());
            }
            cases += 1;
        }
        println!("{name}: {cases} cases, {accepted} read");
    }
}
