//! NRRD, MetaImage, Slicer's points, and fields of other programs: written by hand, read back at
//! known places.

use crate::fixtures::{palpate, small_pair, text};
use flate2::{Compression, write::GzEncoder, write::ZlibEncoder};
use palpate::io::{self, FieldConvention};
use palpate::types::{DenseField, Grid, WorldPoint};
use std::fs;
use std::io::Write;
use std::path::Path;
use tempfile::TempDir;

const SHAPE: [usize; 3] = [4, 3, 2];

fn values() -> Vec<i16> {
    (0..24).map(|i| 100 * i - 300).collect()
}

fn raw(big: bool) -> Vec<u8> {
    values().iter().flat_map(|v| if big { v.to_be_bytes() } else { v.to_le_bytes() }).collect()
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut packed = GzEncoder::new(Vec::new(), Compression::fast());
    packed.write_all(bytes).unwrap();
    packed.finish().unwrap()
}

fn zlib(bytes: &[u8]) -> Vec<u8> {
    let mut packed = ZlibEncoder::new(Vec::new(), Compression::fast());
    packed.write_all(bytes).unwrap();
    packed.finish().unwrap()
}

/// x of the voxels runs to the left, y up, z to the front; 2, 3 and 4 mm; the first voxel at R 10,
/// A 20, S 30.
const NRRD: &str = "NRRD0004\n# made by hand\ntype: short\ndimension: 3\nspace: left-posterior-superior\nsizes: 4 3 2\n\
    space directions: (2,0,0) (0, 0, 3) (0,-4,0)\nkinds: domain domain domain\nspace origin: (-10,-20,30)\nname:=not a field\n";
const META: &str = "ObjectType = Image\nNDims = 3\nBinaryData = True\nTransformMatrix = 1 0 0 0 0 1 0 -1 0\n\
    Offset = -10 -20 30\nCenterOfRotation = 0 0 0\nElementSpacing = 2 3 4\nDimSize = 4 3 2\nElementType = MET_SHORT\n";

fn write(folder: &TempDir, name: &str, parts: &[&[u8]]) -> std::path::PathBuf {
    let path = folder.path().join(name);
    fs::write(&path, parts.concat()).unwrap();
    path
}

fn check(path: &Path) {
    let volume = io::read_volume(path).unwrap();
    assert_eq!(volume.grid().shape(), SHAPE, "{}", path.display());
    let expected: Vec<f32> = values().into_iter().map(f32::from).collect();
    assert_eq!(volume.as_slice(), expected, "{}", path.display());
    let at = |i, j, k| volume.grid().world(i, j, k);
    assert_eq!(at(0, 0, 0), WorldPoint([10.0, 20.0, 30.0]), "{}", path.display());
    assert_eq!(at(1, 0, 0), WorldPoint([8.0, 20.0, 30.0]), "x runs to the left");
    assert_eq!(at(0, 1, 0), WorldPoint([10.0, 20.0, 33.0]), "y runs up");
    assert_eq!(at(0, 0, 1), WorldPoint([10.0, 24.0, 30.0]), "z runs to the front");
}

#[test]
fn nrrd_in_every_form_lies_where_it_should() {
    let folder = TempDir::new().unwrap();
    let little = "endian: little\nencoding: raw\n\n";
    check(&write(&folder, "a.nrrd", &[NRRD.as_bytes(), little.as_bytes(), &raw(false)]));
    check(&write(&folder, "b.nrrd", &[NRRD.as_bytes(), b"endian: big\nencoding: raw\n\n", &raw(true)]));
    check(&write(&folder, "c.nrrd", &[NRRD.as_bytes(), b"endian: little\nencoding: gzip\n\n", &gzip(&raw(false))]));
    let ras = NRRD
        .replace("left-posterior-superior", "RAS")
        .replace("(2,0,0) (0, 0, 3) (0,-4,0)", "(-2,0,0) (0,0,3) (0,4,0)")
        .replace("(-10,-20,30)", "(10,20,30)");
    check(&write(&folder, "d.nrrd", &[ras.as_bytes(), little.as_bytes(), &raw(false)]));
    let windows = format!("{NRRD}{little}").replace('\n', "\r\n");
    check(&write(&folder, "e.nrrd", &[windows.as_bytes(), &raw(false)]));

    write(&folder, "voxels.raw", &[b"skipped!", &raw(false)]);
    write(&folder, "voxels.raw.gz", &[&gzip(&raw(false))]);
    let beside = "endian: little\nencoding: raw\nbyte skip: 8\ndata file: voxels.raw\n";
    check(&write(&folder, "f.nhdr", &[NRRD.as_bytes(), beside.as_bytes()]));
    let last = beside.replace("skip: 8", "skip: -1");
    check(&write(&folder, "g.nhdr", &[NRRD.as_bytes(), last.as_bytes()]));
    let packed = "endian: little\nencoding: gzip\ndata file: voxels.raw.gz";
    check(&write(&folder, "h.nhdr", &[NRRD.as_bytes(), packed.as_bytes()]));
}

#[test]
fn metaimage_in_every_form_lies_where_it_should() {
    let folder = TempDir::new().unwrap();
    let little = "BinaryDataByteOrderMSB = False\nElementDataFile = LOCAL\n";
    check(&write(&folder, "a.mha", &[META.as_bytes(), little.as_bytes(), &raw(false)]));
    let big = "BinaryDataByteOrderMSB = True\nCompressedData = False\nElementDataFile = LOCAL\n";
    check(&write(&folder, "b.mha", &[META.as_bytes(), big.as_bytes(), &raw(true)]));
    let packed = format!("CompressedData = True\nCompressedDataSize = {}\n{little}", zlib(&raw(false)).len());
    check(&write(&folder, "c.mha", &[META.as_bytes(), packed.as_bytes(), &zlib(&raw(false))]));
    write(&folder, "voxels.raw", &[b"skipped!", &raw(false)]);
    let beside = "HeaderSize = 8\nElementDataFile = voxels.raw\n";
    check(&write(&folder, "d.mhd", &[META.as_bytes(), beside.as_bytes()]));
    check(&write(&folder, "e.mhd", &[META.as_bytes(), b"HeaderSize = -1\nElementDataFile = voxels.raw"]));
}

#[test]
fn headers_with_flaws_are_named_and_allocate_nothing() {
    let folder = TempDir::new().unwrap();
    let nrrd = format!("{NRRD}endian: little\nencoding: raw\n\n");
    let meta = format!("{META}ElementDataFile = LOCAL\n");
    let cases: [(&str, String, &str); 18] = [
        ("a.nrrd", nrrd.replace("4 3 2", "40000 30000 20000"), "voxels"),
        ("b.nrrd", nrrd.replace("4 3 2", "1000 1000 1000"), "needs 2000000000 bytes"),
        ("c.nrrd", nrrd.replace("4 3 2", "4 3"), "sizes"),
        ("d.nrrd", nrrd.replace("4 3 2", "4 3 0"), "sizes"),
        ("e.nrrd", nrrd.replace("short", "block"), "block"),
        ("f.nrrd", nrrd.replace("left-posterior-superior", "scanner-xyz"), "scanner-xyz"),
        ("g.nrrd", nrrd.replace("encoding: raw", "encoding: hex"), "hex"),
        ("h.nrrd", nrrd.replace("(2,0,0)", "(0,0,3)"), "singular"),
        ("i.nrrd", nrrd.replace("(2,0,0)", "(2,0,nan)"), "space directions"),
        ("j.nrrd", nrrd.replace("endian: little\n", ""), "endian"),
        ("k.nrrd", "NRRD0004\ntype: short\n\n".into(), "sizes"),
        ("l.nrrd", nrrd.replace("\n\n", "\ndata file: LIST\n\n"), "several files"),
        ("m.mha", meta.replace("4 3 2", "1000 1000 1000"), "needs 2000000000 bytes"),
        ("n.mha", meta.replace("DimSize = 4 3 2\n", ""), "DimSize"),
        ("o.mha", meta.replace("MET_SHORT", "MET_STRING"), "MET_STRING"),
        ("p.mha", meta.replace("ElementDataFile = LOCAL\n", ""), "ElementDataFile"),
        ("q.mha", meta.replace("BinaryData = True", "BinaryData = False"), "BinaryData"),
        ("r.mha", meta.replace("NDims = 3", "NDims = 4"), "NDims"),
    ];
    for (name, header, message) in cases {
        let path = write(&folder, name, &[header.as_bytes(), &raw(false)]);
        let error = io::read_volume(&path).unwrap_err().to_string();
        assert!(error.contains(name) && error.contains(message), "{name}: {error}");
    }
    let short = write(&folder, "short.nrrd", &[nrrd.as_bytes(), &raw(false)[..40]]);
    assert!(io::read_volume(&short).unwrap_err().to_string().contains("cut short"));
    let gz = nrrd.replace("encoding: raw", "encoding: gzip");
    let packed = gzip(&raw(false));
    let damaged = write(&folder, "damaged.nrrd", &[gz.as_bytes(), &packed[..packed.len() / 2]]);
    assert!(io::read_volume(&damaged).unwrap_err().to_string().contains("damaged.nrrd"));
    let none =
        write(&folder, "none.nhdr", &[NRRD.as_bytes(), b"endian: little\nencoding: raw\ndata file: absent.raw\n"]);
    assert!(io::read_volume(&none).unwrap_err().to_string().contains("absent.raw"));
}

/// What ITK 5.4 makes of headers whose lines say one thing under several names, or twice: spacing,
/// origin and directions as SimpleITK gives them (LPS).
#[test]
fn metaimage_headers_are_read_as_itk_reads_them() {
    let folder = TempDir::new().unwrap();
    const TURNED: &str = "0 1 0 -1 0 0 0 0 1";
    const OTHER: &str = "1 0 0 0 0 1 0 -1 0";
    // First and second axis of TURNED and of OTHER.
    let (turned, other, none) =
        ([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]], [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]);
    let at = [0.0; 3];
    let cases: Vec<(String, [f64; 3], [f64; 3], [[f64; 3]; 2])> = vec![
        ("ElementSize = 2 2 3".into(), [2.0, 2.0, 3.0], at, none),
        ("ElementSize = 2 2 3\nElementSpacing = 1 1 5".into(), [1.0, 1.0, 5.0], at, none),
        ("ElementSpacing = 1 1 5\nElementSize = 2 2 3".into(), [1.0, 1.0, 5.0], at, none),
        ("ElementSpacing = 1 2 3\nElementSpacing = 4 5 6".into(), [4.0, 5.0, 6.0], at, none),
        ("Position = 4 5 6".into(), [1.0; 3], [4.0, 5.0, 6.0], none),
        ("Position = 4 5 6\nOffset = 1 2 3".into(), [1.0; 3], [1.0, 2.0, 3.0], none),
        ("Offset = 1 2 3\nPosition = 4 5 6".into(), [1.0; 3], [1.0, 2.0, 3.0], none),
        ("Origin = 7 8 9\nOffset = 1 2 3".into(), [1.0; 3], [7.0, 8.0, 9.0], none),
        ("Offset = 1 2 3\nOffset = 4 5 6".into(), [1.0; 3], [4.0, 5.0, 6.0], none),
        (format!("Rotation = {TURNED}"), [1.0; 3], at, turned),
        (format!("Orientation = {TURNED}"), [1.0; 3], at, turned),
        (format!("Orientation = {OTHER}\nTransformMatrix = {TURNED}"), [1.0; 3], at, turned),
        (format!("Orientation = {TURNED}\nRotation = {OTHER}"), [1.0; 3], at, other),
        ("DistanceUnits = mm".into(), [1.0; 3], at, none),
    ];
    for (lines, spacing, origin, axes) in cases {
        let header = format!("NDims = 3\n{lines}\nDimSize = 4 3 2\nElementType = MET_SHORT\nElementDataFile = LOCAL\n");
        let volume = io::read_volume(write(&folder, "a.mha", &[header.as_bytes(), &raw(false)])).unwrap();
        let grid = volume.grid();
        let lps = |p: WorldPoint| [-p.0[0], -p.0[1], p.0[2]];
        let first = lps(grid.world(0, 0, 0));
        assert_eq!(first, origin, "{lines}");
        for (a, next) in [(0, grid.world(1, 0, 0)), (1, grid.world(0, 1, 0))] {
            let step: Vec<f64> = lps(next).iter().zip(first).map(|(n, f)| n - f).collect();
            assert_eq!(step, axes[a].map(|v| v * spacing[a]), "{lines}, axis {a}");
        }
        assert_eq!(grid.spacing(), spacing, "{lines}");
    }
    for unit in ["cm", "um"] {
        let header = format!("{META}DistanceUnits = {unit}\nElementDataFile = LOCAL\n");
        let error =
            io::read_volume(write(&folder, "u.mha", &[header.as_bytes(), &raw(false)])).unwrap_err().to_string();
        assert!(error.contains(unit) && error.contains("mm"), "{error}");
    }
}

#[test]
fn lengths_in_a_stated_unit_come_to_millimetres() {
    let folder = TempDir::new().unwrap();
    let nrrd = |units: &str| format!("{NRRD}space units: {units}\nendian: little\nencoding: raw\n\n");
    let tenth = NRRD.replace("(2,0,0) (0, 0, 3) (0,-4,0)", "(0.2,0,0) (0, 0, 0.3) (0,-0.4,0)");
    let tenth = tenth.replace("(-10,-20,30)", "(-1,-2,3)");
    let cm = format!("{tenth}space units: \"cm\" \"cm\" \"cm\"\nendian: little\nencoding: raw\n\n");
    check(&write(&folder, "mm.nrrd", &[nrrd("\"mm\" \"mm\" \"mm\"").as_bytes(), &raw(false)]));
    check(&write(&folder, "cm.nrrd", &[cm.as_bytes(), &raw(false)]));
    let error = io::read_volume(write(&folder, "s.nrrd", &[nrrd("\"s\" \"mm\" \"mm\"").as_bytes(), &raw(false)]));
    assert!(error.unwrap_err().to_string().contains("space units"));
    let points = |units: &str| {
        let json = format!(
            "{{\"markups\": [{{\"coordinateSystem\": \"RAS\", {units} \"controlPoints\": [{{\"position\": [1, 2, 3]}}]}}]}}"
        );
        io::read_points(write(&folder, "p.mrk.json", &[json.as_bytes()]))
    };
    for (units, mm) in [
        ("", 1.0),
        ("\"coordinateUnits\": \"mm\",", 1.0),
        ("\"coordinateUnits\": \"cm\",", 10.0),
        ("\"coordinateUnits\": \"m\",", 1000.0),
        ("\"coordinateUnits\": [\"um\", \"um\", \"um\"],", 0.001),
    ] {
        assert_eq!(points(units).unwrap().points, [WorldPoint([mm, 2.0 * mm, 3.0 * mm])], "{units}");
    }
    for units in
        ["\"coordinateUnits\": \"s\",", "\"coordinateUnits\": [\"mm\", \"cm\", \"mm\"],", "\"coordinateUnits\": 3,"]
    {
        let error = points(units).unwrap_err().to_string();
        assert!(error.contains("p.mrk.json") && error.contains("coordinateUnits"), "{units}: {error}");
    }
}

#[test]
fn colours_are_no_vectors_and_no_grey_values() {
    let folder = TempDir::new().unwrap();
    let bytes = [0u8; 72];
    let nrrd = |kind: &str, number: &str| {
        NRRD.replace("short", number)
            .replace("dimension: 3", "dimension: 4")
            .replace("4 3 2", "3 4 3 2")
            .replace("(2,0,0)", "none (2,0,0)")
            .replace("kinds: ", &format!("kinds: {kind} "))
            + "endian: little\nencoding: raw\n\n"
    };
    let refused = |name: &str, header: &str, message: &str| {
        let path = write(&folder, name, &[header.as_bytes(), &bytes]);
        let error = io::read_field(&path).unwrap_err().to_string();
        assert!(error.contains(name) && error.contains(message), "{error}");
        assert!(io::read_volume(&path).is_err());
    };
    for kind in ["RGB-color", "HSV-color", "XYZ-color", "3-color"] {
        refused("c.nrrd", &nrrd(kind, "uchar"), "colours");
    }
    refused("v.nrrd", &nrrd("vector", "uchar"), "uint8");
    let meta = META.replace("MET_SHORT", "MET_UCHAR") + "ElementNumberOfChannels = 3\nElementDataFile = LOCAL\n";
    refused("c.mha", &meta, "uint8");
    let grid = *io::read_volume(write(&folder, "a.mha", &[META.as_bytes(), b"ElementDataFile = LOCAL\n", &raw(false)]))
        .unwrap()
        .grid();
    io::write_field(folder.path().join("f.nii"), &DenseField::zeros(grid)).unwrap();
    let mut nifti = fs::read(folder.path().join("f.nii")).unwrap();
    nifti[70..74].copy_from_slice(&[2, 0, 8, 0]); // uint8
    let error = io::read_field(write(&folder, "f.nii", &[&nifti])).unwrap_err().to_string();
    assert!(error.contains("uint8"), "{error}");
}

#[test]
fn a_packing_that_is_not_read_is_named_with_its_command() {
    let folder = TempDir::new().unwrap();
    for (name, head, program) in [
        ("a.nii.zst", &b"\x28\xb5\x2f\xfd\0\0"[..], "zstd -d"),
        ("a.nii.bz2", b"BZh91AY&SY", "bzip2 -dk"),
        ("a.nii.xz", b"\xfd7zXZ\0\0\x04", "xz -dk"),
        ("a.nii.lz4", b"\x04\x22\x4d\x18rest", "lz4 -d"),
        ("a.zip", b"PK\x03\x04rest", "unzip"),
        ("a.csv", b"\x28\xb5\x2f\xfd\xff\xff", "zstd -d"),
    ] {
        let path = write(&folder, name, &[head]);
        let error = match name {
            "a.csv" => io::read_text(&path).unwrap_err().to_string(),
            _ => io::read_volume(&path).unwrap_err().to_string(),
        };
        assert!(error.contains(name) && error.contains(program), "{error}");
    }
}

/// As SPM writes them: header and voxels apart.
#[test]
fn a_pair_of_header_and_voxels_is_read_by_either_name() {
    let folder = TempDir::new().unwrap();
    let grid = *io::read_volume(write(&folder, "a.mha", &[META.as_bytes(), b"ElementDataFile = LOCAL\n", &raw(false)]))
        .unwrap()
        .grid();
    let volume = palpate::types::Volume::from_voxels(grid, |at, _| f32::from(values()[at]));
    io::write_volume(folder.path().join("one.nii"), &volume, "").unwrap();
    let one = fs::read(folder.path().join("one.nii")).unwrap();
    let head = |offset: f32| {
        let mut head = one[..348].to_vec();
        head[344..348].copy_from_slice(b"ni1\0");
        head[108..112].copy_from_slice(&offset.to_le_bytes());
        head
    };
    write(&folder, "p.hdr", &[&head(0.0)]);
    write(&folder, "p.img", &[&one[352..]]);
    write(&folder, "later.HDR", &[&head(16.0)]);
    write(&folder, "later.IMG", &[&[7; 16], &one[352..]]);
    write(&folder, "packed.hdr.gz", &[&gzip(&head(0.0))]);
    write(&folder, "packed.img.gz", &[&gzip(&one[352..])]);
    for name in ["p.hdr", "p.img", "later.HDR", "later.IMG", "packed.hdr.gz", "packed.img.gz"] {
        check(&folder.path().join(name));
        let other = io::files_of(folder.path().join(name));
        assert_eq!(other.len(), 2, "{name}: a change of either counts, {other:?}");
    }
    let (stored, _) = io::read_header(folder.path().join("packed.img.gz")).unwrap();
    assert_eq!(stored.format, "NIfTI-1 pair, gzip");
    // The same in NIfTI's other form, as a series.
    let mut series = io::Series::open(folder.path().join("packed.hdr.gz")).unwrap();
    assert_eq!(series.read(0).unwrap().as_slice(), volume.as_slice());
    assert_eq!(series.read(0).unwrap().as_slice(), volume.as_slice());
    let alone = write(&folder, "alone.hdr", &[&head(0.0)]);
    assert!(io::read_volume(alone).unwrap_err().to_string().contains(".img is not there"));
    let short = write(&folder, "p.img", &[&one[352..380]]);
    assert!(io::read_volume(short).unwrap_err().to_string().contains("cut short"));
    // Before NIfTI there was no telling left from right.
    let mut old = head(0.0);
    old[344..348].fill(0);
    write(&folder, "old.hdr", &[&old]);
    let old = write(&folder, "old.img", &[&one[352..]]);
    assert!(io::read_volume(old).unwrap_err().to_string().contains("ANALYZE"));
}

#[test]
fn no_bytes_make_the_readers_panic() {
    let folder = TempDir::new().unwrap();
    let nrrd = [format!("{NRRD}endian: little\nencoding: gzip\n\n").as_bytes(), &gzip(&raw(false))[..]].concat();
    let meta =
        [format!("{META}CompressedData = True\nElementDataFile = LOCAL\n").as_bytes(), &zlib(&raw(false))[..]].concat();
    for (name, whole) in [("x.nrrd", nrrd), ("x.mha", meta)] {
        for end in (0..whole.len()).step_by(5) {
            let _ = io::read_volume(write(&folder, name, &[&whole[..end]]));
        }
        let mut state = 7u64;
        for _ in 0..400 {
            let mut bytes = whole.clone();
            for _ in 0..3 {
                state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                let at = (state >> 33) as usize % bytes.len();
                bytes[at] = (state >> 20) as u8;
            }
            let _ = io::read_volume(write(&folder, name, &[&bytes]));
        }
    }
}

fn small_field() -> (TempDir, DenseField) {
    let folder = small_pair();
    let field = io::read_field(folder.path().join("truth.nii.gz")).unwrap();
    (folder, field)
}

fn close(a: &DenseField, b: &DenseField, tolerance: f32) {
    assert!(a.grid().same_as(b.grid()));
    let most = a.as_slice().iter().zip(b.as_slice()).map(|(x, y)| (x - y).abs()).fold(0.0, f32::max);
    assert!(most < tolerance, "{most}");
    assert!(a.as_slice().iter().any(|v| v.abs() > 0.5), "nothing moves, so nothing is tested");
}

/// The three numbers of each voxel that `f` gives.
fn numbers(grid: &Grid, f: impl Fn([usize; 3], usize) -> [f64; 3]) -> Vec<[f32; 3]> {
    (0..grid.len()).map(|o| f(grid.voxel(o), o).map(|v| v as f32)).collect()
}

#[test]
fn an_itk_field_as_nrrd_or_metaimage_is_the_same_field() {
    let (folder, field) = small_field();
    let grid = field.grid();
    let lps = numbers(grid, |_, o| {
        let [x, y, z] = field.at(o).map(f64::from);
        [-x, -y, z]
    });
    let bytes: Vec<u8> = lps.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
    let (s, size) = (grid.shape(), grid.spacing());
    let [ox, oy, oz] = grid.world(0, 0, 0).0;
    let header = format!(
        "NRRD0005\ntype: float\ndimension: 4\nspace: left-posterior-superior\nsizes: 3 {} {} {}\nspace directions: none \
         ({},0,0) (0,{},0) (0,0,{})\nkinds: vector domain domain domain\nendian: little\nencoding: raw\nspace origin: \
         ({},{},{oz})\n\n",
        s[0], s[1], s[2], -size[0], -size[1], size[2], -ox, -oy
    );
    close(&io::read_field(write(&folder, "f.nrrd", &[header.as_bytes(), &bytes])).unwrap(), &field, 1e-5);
    let header = format!(
        "NDims = 3\nBinaryData = True\nTransformMatrix = -1 0 0 0 -1 0 0 0 1\nOffset = {} {} {oz}\nElementSpacing = {} {} {}\n\
         DimSize = {} {} {}\nElementNumberOfChannels = 3\nElementType = MET_FLOAT\nElementDataFile = LOCAL\n",
        -ox, -oy, size[0], size[1], size[2], s[0], s[1], s[2]
    );
    let path = write(&folder, "f.mha", &[header.as_bytes(), &bytes]);
    close(&io::read_field(&path).unwrap(), &field, 1e-5);
    assert!(io::read_volume(&path).unwrap_err().to_string().contains("3 numbers a voxel"));
}

/// A NIfTI-1 field on `grid` with its components on axis `axis` (4 or 5).
fn nifti(grid: &Grid, voxels: &[[f32; 3]], axis: usize, intent: i16, name: &[u8], p1: f32) -> Vec<u8> {
    let mut h = vec![0u8; 352];
    let mut put = |at: usize, bytes: &[u8]| h[at..at + bytes.len()].copy_from_slice(bytes);
    put(0, &348i32.to_le_bytes());
    let s = grid.shape().map(|n| n as i16);
    let dim = if axis == 5 { [5, s[0], s[1], s[2], 1, 3, 1, 1] } else { [4, s[0], s[1], s[2], 3, 1, 1, 1] };
    put(40, &dim.map(i16::to_le_bytes).concat());
    put(56, &p1.to_le_bytes());
    put(68, &intent.to_le_bytes());
    put(70, &16i16.to_le_bytes());
    put(72, &32i16.to_le_bytes());
    let size = grid.spacing().map(|v| v as f32);
    put(76, &[1.0, size[0], size[1], size[2], 1.0].map(f32::to_le_bytes).concat());
    put(108, &352f32.to_le_bytes());
    put(112, &1f32.to_le_bytes());
    put(123, &[2]);
    put(254, &1i16.to_le_bytes());
    put(280, &grid.affine().rows().concat().iter().flat_map(|v| (*v as f32).to_le_bytes()).collect::<Vec<u8>>());
    put(328, name);
    put(344, b"n+1\0");
    for c in 0..3 {
        h.extend(voxels.iter().flat_map(|v| v[c].to_le_bytes()));
    }
    h
}

#[test]
fn niftyreg_fields_of_both_kinds_and_what_their_header_says() {
    let (folder, field) = small_field();
    let grid = field.grid();
    let ras = numbers(grid, |_, o| field.at(o).map(f64::from));
    let there = numbers(grid, |[i, j, k], o| grid.world(i, j, k).moved(field.at(o).map(f64::from)).0);
    let shift = write(&folder, "disp.nii", &[&nifti(grid, &ras, 5, 1007, b"NREG_TRANS", 1.0)]);
    let place = write(&folder, "def.nii", &[&nifti(grid, &there, 5, 1007, b"NREG_TRANS", 0.0)]);
    let spline = write(&folder, "cpp.nii", &[&nifti(grid, &ras, 5, 1007, b"NREG_TRANS", 2.0)]);
    for path in [&shift, &place] {
        close(&io::read_field_as(path, FieldConvention::Niftyreg, None).unwrap(), &field, 2e-4);
        let error = io::read_field(path).unwrap_err().to_string();
        assert!(error.contains("--field-convention niftyreg"), "{error}");
    }
    let error = io::read_field_as(&spline, FieldConvention::Niftyreg, None).unwrap_err().to_string();
    assert!(error.contains("control points"), "{error}");
    let ours = folder.path().join("truth.nii.gz");
    assert!(io::read_field_as(&ours, FieldConvention::Niftyreg, None).is_err());
    let plain = write(&folder, "ras.nii", &[&nifti(grid, &ras, 5, 1007, b"", 0.0)]);
    close(&io::read_field_as(&plain, FieldConvention::Ras, None).unwrap(), &field, 1e-5);
}

#[test]
fn fsl_warps_relative_and_absolute_on_one_grid_and_on_two() {
    let (folder, field) = small_field();
    // FSL's coordinates: voxels times their size, x from the far end where the determinant is
    // positive, as it is here.
    let scaled = |g: &Grid, p: WorldPoint| {
        let [x, y, z]: [f64; 3] = std::array::from_fn(|a| g.affine().to_voxel(p).0[a] * g.spacing()[a]);
        [(g.shape()[0] - 1) as f64 * g.spacing()[0] - x, y, z]
    };
    let grid = field.grid();
    let moved = |[i, j, k]: [usize; 3], o: usize| grid.world(i, j, k).moved(field.at(o).map(f64::from));
    let absolute = numbers(grid, |v, o| scaled(grid, moved(v, o)));
    let relative = numbers(grid, |v, o| {
        let (to, from) = (scaled(grid, moved(v, o)), scaled(grid, grid.world(v[0], v[1], v[2])));
        std::array::from_fn(|a| to[a] - from[a])
    });
    let abs = write(&folder, "abs.nii", &[&nifti(grid, &absolute, 4, 2006, b"", 0.0)]);
    let rel = write(&folder, "rel.nii", &[&nifti(grid, &relative, 4, 2006, b"", 0.0)]);
    close(&io::read_field_as(&abs, FieldConvention::FslAbsolute, None).unwrap(), &field, 2e-4);
    close(&io::read_field_as(&rel, FieldConvention::Fsl, None).unwrap(), &field, 2e-4);
    assert!(io::read_field(&rel).unwrap_err().to_string().contains("--field-convention"));

    // Into a volume on another grid.
    let other = Grid::new([20, 30, 40], palpate::types::Affine::scaled([2.0, 1.5, 1.0], [-17.0, -22.0, -9.0]).unwrap())
        .unwrap();
    let relative = numbers(grid, |v, o| {
        let (to, from) = (scaled(&other, moved(v, o)), scaled(grid, grid.world(v[0], v[1], v[2])));
        std::array::from_fn(|a| to[a] - from[a])
    });
    let two = write(&folder, "two.nii", &[&nifti(grid, &relative, 4, 2006, b"", 0.0)]);
    close(&io::read_field_as(&two, FieldConvention::Fsl, Some(&other)).unwrap(), &field, 2e-4);
    let coefficients = write(&folder, "coef.nii", &[&nifti(grid, &relative, 4, 2009, b"", 0.0)]);
    let error = io::read_field_as(&coefficients, FieldConvention::Fsl, None).unwrap_err().to_string();
    assert!(error.contains("coefficients"), "{error}");

    // On the command line.
    let warp = ["warp", "deformed.nii.gz", "--field", "rel.nii", "--field-convention", "fsl", "-o", "theirs.nii.gz"];
    palpate(folder.path()).args(warp).assert().success();
    palpate(folder.path())
        .args(["warp", "deformed.nii.gz", "--field", "truth.nii.gz", "-o", "ours.nii.gz"])
        .assert()
        .success();
    let read = |name: &str| io::read_volume(folder.path().join(name)).unwrap();
    let (ours, theirs) = (read("ours.nii.gz"), read("theirs.nii.gz"));
    let most = ours.as_slice().iter().zip(theirs.as_slice()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(most < 2.0, "{most}");
    let wrong = palpate(folder.path())
        .args(["warp", "a.nii", "--field", "b.nii", "-o", "c.nii", "--field-convention", "fls"])
        .output()
        .unwrap();
    assert!(text(&wrong.stderr).contains("did you mean 'fsl'"), "{}", text(&wrong.stderr));
}

#[test]
fn slicer_points_in_either_system_are_ras_and_come_back() {
    let folder = TempDir::new().unwrap();
    let json = |system: &str, sign: i32| {
        format!(
            "{{\"markups\": [{{\"type\": \"Fiducial\", {system} \"controlPoints\": [{{\"id\": \"1\", \"label\": \"F-1\", \"position\": \
             [{}, {}, 3.5], \"positionStatus\": \"defined\"}}, {{\"id\": \"2\", \"label\": \"F-2\", \"position\": [{}, 0, 0]}}, \
             {{\"id\": \"3\", \"label\": \"F-3\", \"positionStatus\": \"undefined\"}}]}}]}}",
            sign,
            2 * sign,
            10 * sign
        )
    };
    let expected = vec![WorldPoint([1.0, 2.0, 3.5]), WorldPoint([10.0, 0.0, 0.0])];
    for (name, content) in [
        ("a.mrk.json", json("\"coordinateSystem\": \"LPS\",", -1)),
        ("b.mrk.json", json("\"coordinateSystem\": \"RAS\",", 1)),
        ("c.mrk.json", json("", -1)),
        ("d.fcsv", "# Markups fiducial file version = 4.11\n# CoordinateSystem = LPS\n# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n1,-1,-2,3.5,0,0,0,1,1,1,0,F-1,,\n2,-10,0,0,0,0,0,1,1,1,0,F-2,,\n".into()),
        ("e.fcsv", "# CoordinateSystem = 0\n1,1,2,3.5,0,0,0,1,1,1,0,F-1,,\n2,10,0,0,0,0,0,1,1,1,0,F-2,,\n".into()),
    ] {
        let table = io::read_points(write(&folder, name, &[content.as_bytes()])).unwrap();
        assert_eq!(table.points, expected, "{name}");
        assert_eq!(table.others, [["F-1"], ["F-2"]], "{name}");
    }
    let table = io::read_points(folder.path().join("a.mrk.json")).unwrap();
    let again = folder.path().join("again.mrk.json");
    io::write_points(&again, &table).unwrap();
    assert_eq!(io::read_points(&again).unwrap(), table);
    for (name, content, message) in [
        ("x.fcsv", "# CoordinateSystem = IJK\n1,1,2,3\n", "IJK"),
        ("y.fcsv", "1,1,two,3\n", "line 1"),
        ("z.mrk.json", "{\"markups\": []}", "0 lists"),
        ("w.mrk.json", "[]", "w.mrk.json"),
    ] {
        let error = io::read_points(write(&folder, name, &[content.as_bytes()])).unwrap_err().to_string();
        assert!(error.contains(name) && error.contains(message), "{error}");
    }
}

#[test]
fn landmarks_from_two_lists_are_paired_by_label() {
    let folder = small_pair();
    let landmarks = io::read_landmarks(folder.path().join("landmarks.csv")).unwrap();
    let run = |arguments: &[&str]| {
        let output = palpate(folder.path()).args(arguments).output().unwrap();
        assert!(output.status.success(), "{}", text(&output.stderr));
        text(&output.stdout)
    };
    run(&["markups", "landmarks.csv", "-o", "initial.mrk.json"]);
    run(&["markups", "landmarks.csv", "--deformed", "-o", "deformed.mrk.json"]);
    let mut list: serde_json::Value =
        serde_json::from_str(&fs::read_to_string(folder.path().join("deformed.mrk.json")).unwrap()).unwrap();
    list["markups"][0]["controlPoints"].as_array_mut().unwrap().reverse();
    fs::write(folder.path().join("deformed.mrk.json"), list.to_string()).unwrap();
    let pair = io::read_landmark_pair(folder.path().join("initial.mrk.json"), folder.path().join("deformed.mrk.json"))
        .unwrap();
    assert_eq!(pair.len(), landmarks.len());
    for (found, expected) in pair.iter().zip(&landmarks) {
        assert!(found.initial.minus(expected.initial).iter().all(|d| d.abs() < 1e-6));
        assert!(found.deformed.minus(expected.deformed).iter().all(|d| d.abs() < 1e-6));
    }
    let score = ["evaluate", "truth.nii.gz", "--truth", "truth.nii.gz", "--json", "--landmarks"];
    let by = |files: &[&str]| -> f64 {
        let out = run(&[&score[..], files].concat());
        serde_json::from_str::<serde_json::Value>(&out).unwrap()["landmarks_mm"].as_f64().unwrap()
    };
    assert!((by(&["landmarks.csv"]) - by(&["initial.mrk.json", "deformed.mrk.json"])).abs() < 1e-5);
    let fewer = run(&["markups", "landmarks.csv", "--most", "3", "-o", "few.mrk.json"]);
    assert!(fewer.contains("few.mrk.json"));
    assert!(io::read_points(folder.path().join("few.mrk.json")).unwrap().points.len() <= 3);
    assert!(
        io::read_landmark_pair(folder.path().join("initial.mrk.json"), folder.path().join("few.mrk.json")).is_err()
    );
}

#[test]
fn a_field_run_takes_nrrd_and_gives_the_same_as_nifti() {
    let folder = small_pair();
    for name in ["initial", "deformed"] {
        let volume = io::read_volume(folder.path().join(format!("{name}.nii.gz"))).unwrap();
        let (s, size, [x, y, z]) = (volume.grid().shape(), volume.grid().spacing(), volume.grid().world(0, 0, 0).0);
        let header = format!(
            "NRRD0004\ntype: float\ndimension: 3\nspace: RAS\nsizes: {} {} {}\nspace directions: ({},0,0) (0,{},0) (0,0,{})\n\
             endian: little\nencoding: gzip\nspace origin: ({x},{y},{z})\n\n",
            s[0], s[1], s[2], size[0], size[1], size[2]
        );
        let bytes: Vec<u8> = volume.as_slice().iter().flat_map(|v| v.to_le_bytes()).collect();
        write(&folder, &format!("{name}.nrrd"), &[header.as_bytes(), &gzip(&bytes)]);
    }
    for (ending, output) in [("nii.gz", "one"), ("nrrd", "two")] {
        let files = [format!("initial.{ending}"), format!("deformed.{ending}")];
        let rest = ["--mask", "mask.nii.gz", "--quiet", "-o", output];
        palpate(folder.path()).arg("field").args(&files).args(rest).assert().success();
    }
    let read = |run: &str| io::read_field(folder.path().join(run).join("displacement.nii.gz")).unwrap();
    close(&read("one"), &read("two"), 1e-6);
    fs::create_dir(folder.path().join("empty")).unwrap();
    let folder_as_volume = palpate(folder.path()).args(["info", "empty"]).output().unwrap();
    assert_eq!(folder_as_volume.status.code(), Some(1));
}
