//! NIfTI files, byte by byte: each is built here, so that what must come out is known exactly (one
//! file, as all tests share the header builder).

use palpate::io::{
    Series, count_non_finite, read_field, read_header, read_labels, read_mask, read_volume, write_by_rows, write_field,
    write_integers, write_labels, write_steps, write_volume,
};
use palpate::types::{Affine, DenseField, Grid, Mask, Volume, VoxelPoint, WorldPoint};
use proptest::prelude::*;
use std::io::Write;
use std::path::PathBuf;
use tempfile::TempDir;

/// A NIfTI-1 file in the making: 2 x 3 x 2 voxels of float32 unless changed.
#[derive(Clone)]
struct Fixture {
    big_endian: bool,
    dim: [i16; 8],
    datatype: i16,
    intent: i16,
    pixdim: [f32; 8],
    vox_offset: f32,
    slope: f32,
    inter: f32,
    units: u8,
    codes: [i16; 2],
    quatern: [f32; 6],
    srow: [[f32; 4]; 3],
    magic: [u8; 4],
    /// Everything between the header's 348 bytes and the voxels.
    extension: Vec<u8>,
    voxels: Vec<u8>,
}

fn fixture() -> Fixture {
    Fixture {
        big_endian: false,
        dim: [3, 2, 3, 2, 1, 1, 1, 1],
        datatype: 16,
        intent: 0,
        pixdim: [1.0, 1.5, 2.0, 2.5, 0.0, 0.0, 0.0, 0.0],
        vox_offset: 352.0,
        slope: 0.0,
        inter: 0.0,
        units: 2,
        codes: [0, 0],
        quatern: [0.0; 6],
        srow: [[0.0; 4]; 3],
        magic: *b"n+1\0",
        extension: vec![0; 4],
        voxels: (0..12).flat_map(|i| (i as f32).to_le_bytes()).collect(),
    }
}

impl Fixture {
    fn bytes(&self) -> Vec<u8> {
        let mut h = vec![0u8; 348];
        let ordered = |mut b: Vec<u8>| {
            if self.big_endian {
                b.reverse();
            }
            b
        };
        let mut put = |at: usize, b: Vec<u8>| h[at..at + b.len()].copy_from_slice(&b);
        let mut short = |at: usize, v: i16| put(at, ordered(v.to_le_bytes().to_vec()));
        (0..8).for_each(|i| short(40 + 2 * i, self.dim[i]));
        short(68, self.intent);
        short(70, self.datatype);
        short(252, self.codes[0]);
        short(254, self.codes[1]);
        put(0, ordered(348i32.to_le_bytes().to_vec()));
        let mut float = |at: usize, v: f32| put(at, ordered(v.to_le_bytes().to_vec()));
        (0..8).for_each(|i| float(76 + 4 * i, self.pixdim[i]));
        float(108, self.vox_offset);
        float(112, self.slope);
        float(116, self.inter);
        (0..6).for_each(|i| float(256 + 4 * i, self.quatern[i]));
        (0..12).for_each(|i| float(280 + 4 * i, self.srow[i / 4][i % 4]));
        put(123, vec![self.units]);
        put(344, self.magic.to_vec());
        [h, self.extension.clone(), self.voxels.clone()].concat()
    }

    fn datatype<const N: usize>(mut self, code: i16, values: impl IntoIterator<Item = [u8; N]>) -> Self {
        self.datatype = code;
        self.voxels = values.into_iter().flatten().collect();
        self
    }
}

/// A folder for one test.
struct Files(TempDir);

impl Files {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn put(&self, name: &str, bytes: &[u8]) -> PathBuf {
        std::fs::write(self.path(name), bytes).unwrap();
        self.path(name)
    }
}

fn gz(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}

fn read(bytes: &[u8]) -> Result<Volume, String> {
    read_volume(Files::new().put("v.nii", bytes)).map_err(|e| e.to_string())
}

/// The error, which must name the file and hold `words`.
#[track_caller]
fn refused(bytes: &[u8], words: &str) {
    let error = read(bytes).unwrap_err();
    assert!(error.contains("v.nii: ") && error.contains(words) && error.contains("; "), "{error}");
}

fn counting() -> Vec<f32> {
    (0..12).map(|i| i as f32).collect()
}

fn grid(shape: [usize; 3], rows: [[f64; 4]; 3]) -> Grid {
    Grid::new(shape, Affine::new(rows).unwrap()).unwrap()
}

/// 30 degrees about z, then 20 about x; voxels 0.8 x 0.9 x 1.2 mm, the second axis flipped.
fn oblique() -> [[f64; 4]; 3] {
    let ((s, c), (t, d)) = (30f64.to_radians().sin_cos(), 20f64.to_radians().sin_cos());
    let rotation = [[c, -s, 0.0], [d * s, d * c, -t], [t * s, t * c, d]];
    let (size, at) = ([0.8, -0.9, 1.2], [-31.5, 12.25, 7.0]);
    std::array::from_fn(|r| std::array::from_fn(|k| if k < 3 { rotation[r][k] * size[k] } else { at[r] }))
}

#[track_caller]
fn assert_affine(volume: &Volume, rows: [[f64; 4]; 3], tolerance: f64) {
    let found = volume.grid().affine().rows();
    for (a, b) in found.iter().flatten().zip(rows.iter().flatten()) {
        assert!((a - b).abs() <= tolerance, "{found:?} instead of {rows:?}");
    }
}

#[test]
fn every_datatype_in_both_byte_orders() {
    macro_rules! check {
        ($code:literal, $t:ty, $values:expr) => {{
            let values: Vec<$t> = $values;
            let expected: Vec<f32> = values.iter().cycle().take(12).map(|&v| v as f32).collect();
            for big_endian in [false, true] {
                let bytes =
                    values.iter().cycle().take(12).map(|v| if big_endian { v.to_be_bytes() } else { v.to_le_bytes() });
                let file = Fixture { big_endian, ..fixture() }.datatype($code, bytes);
                let volume = read(&file.bytes()).unwrap();
                assert_eq!(volume.as_slice(), expected, "datatype {} big-endian {big_endian}", $code);
                assert_eq!(volume.grid().shape(), [2, 3, 2]);
            }
        }};
    }
    check!(2, u8, vec![0, 1, 200, 255]);
    check!(256, i8, vec![-128, -1, 0, 127]);
    check!(4, i16, vec![-32768, -1, 256, 32767]);
    check!(512, u16, vec![0, 1, 256, 65535]);
    check!(8, i32, vec![i32::MIN, -1, 65536, 16_777_215]);
    check!(768, u32, vec![0, 1, 65536, u32::MAX]);
    check!(1024, i64, vec![i64::MIN, -1, 1 << 40, 5]);
    check!(1280, u64, vec![0, 1, 1 << 40, u64::MAX]);
    check!(16, f32, vec![-1.5, 0.1, f32::MAX, f32::MIN_POSITIVE]);
    check!(64, f64, vec![-1.5, 0.1, 1e30, 1e300]);
}

#[test]
fn values_that_are_not_finite_are_given_as_they_are_and_counted() {
    let values = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY].into_iter().chain((0..9).map(|i| i as f32));
    let volume = read(&fixture().datatype(16, values.map(f32::to_le_bytes)).bytes()).unwrap();
    assert!(volume.as_slice()[0].is_nan() && volume.as_slice()[2] == f32::NEG_INFINITY);
    assert_eq!(count_non_finite(&volume), 3);
}

#[test]
fn slope_and_intercept() {
    let scaled = |slope, inter| read(&Fixture { slope, inter, ..fixture() }.bytes());
    assert_eq!(scaled(2.0, -3.0).unwrap().as_slice()[11], 19.0);
    assert_eq!(scaled(-0.5, 0.0).unwrap().as_slice()[4], -2.0);
    // 0, NaN and infinity mean "not set", whatever the intercept.
    for slope in [0.0, f32::NAN, f32::INFINITY] {
        assert_eq!(scaled(slope, 7.0).unwrap().as_slice(), counting());
        assert_eq!(scaled(slope, f32::NAN).unwrap().as_slice(), counting());
    }
    assert!(scaled(1.0, f32::NAN).unwrap_err().contains("scl_inter is NaN"));
}

#[test]
fn the_sform_wins_over_the_qform() {
    let srow = [[0.0, -2.0, 0.0, 10.0], [1.5, 0.0, 0.0, -20.0], [0.0, 0.0, -3.0, 30.0]];
    let file = Fixture { codes: [1, 2], srow, quatern: [0.0, 0.0, 0.0, 1.0, 2.0, 3.0], ..fixture() };
    assert_affine(&read(&file.bytes()).unwrap(), srow.map(|r| r.map(f64::from)), 0.0);
    let qform = [[1.5, 0.0, 0.0, 1.0], [0.0, 2.0, 0.0, 2.0], [0.0, 0.0, 2.5, 3.0]];
    // How far the two place the corner that is furthest apart.
    let files = Files::new();
    let apart =
        |codes, name| read_header(files.put(name, &Fixture { codes, ..file.clone() }.bytes())).unwrap().0.apart_mm;
    let truth = (0..12).map(|n| {
        let v = [n % 2, n / 2 % 3, n / 6].map(|i| i as f64);
        let at = |rows: [[f64; 4]; 3], r: usize| rows[r][3] + (0..3).map(|c| rows[r][c] * v[c]).sum::<f64>();
        let srow = srow.map(|r| r.map(f64::from));
        (0..3).map(|r| (at(srow, r) - at(qform, r)).powi(2)).sum::<f64>().sqrt()
    });
    assert!((apart([1, 2], "both.nii").unwrap() - truth.fold(0.0, f64::max)).abs() < 1e-9);
    assert_eq!((apart([1, 0], "qform.nii"), apart([0, 2], "sform.nii")), (None, None));
    assert_affine(&read(&Fixture { codes: [1, 0], ..file }.bytes()).unwrap(), qform, 0.0);
}

#[test]
fn qform_with_rotation_and_qfac() {
    // A quarter turn about z: (a, b, c, d) = (cos 45, 0, 0, sin 45). x -> y, y -> -x.
    let half = 0.5f32.sqrt();
    for (qfac, sign) in [(1.0, 1.0), (-1.0, -1.0), (0.0, 1.0)] {
        let mut file = Fixture { codes: [1, 0], quatern: [0.0, 0.0, half, 5.0, 6.0, 7.0], ..fixture() };
        file.pixdim[0] = qfac;
        let rows = [[0.0, -2.0, 0.0, 5.0], [1.5, 0.0, 0.0, 6.0], [0.0, 0.0, sign * 2.5, 7.0]];
        assert_affine(&read(&file.bytes()).unwrap(), rows, 1e-6);
    }
    // A half turn about x, whose a is 0 and whose b may come out a little past 1.
    let file = Fixture { codes: [1, 0], quatern: [1.0 + 1e-7, 0.0, 0.0, 0.0, 0.0, 0.0], ..fixture() };
    let rows = [[1.5, 0.0, 0.0, 0.0], [0.0, -2.0, 0.0, 0.0], [0.0, 0.0, -2.5, 0.0]];
    assert_affine(&read(&file.bytes()).unwrap(), rows, 1e-6);
}

#[test]
fn without_sform_and_qform_the_voxel_size_is_used() {
    let rows = [[1.5, 0.0, 0.0, 0.0], [0.0, 2.0, 0.0, 0.0], [0.0, 0.0, 2.5, 0.0]];
    assert_affine(&read(&fixture().bytes()).unwrap(), rows, 0.0);
    for bad in [0.0, -1.0, f32::NAN] {
        let mut file = fixture();
        file.pixdim[2] = bad;
        refused(&file.bytes(), "pixdim[2]");
    }
    // The size across a single slice may be unset.
    let mut file = fixture();
    file.dim = [2, 4, 3, 0, 0, 0, 0, 0];
    file.pixdim[3] = 0.0;
    assert_eq!(read(&file.bytes()).unwrap().grid().shape(), [4, 3, 1]);
}

#[test]
fn metres_and_microns_become_millimetres() {
    let srow = [[1.0, 0.0, 0.0, 4.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
    for (units, factor) in [(0, 1.0), (1, 1e3), (2, 1.0), (3, 1e-3), (2 + 8, 1.0), (1 + 8, 1e3)] {
        let volume = read(&Fixture { units, codes: [0, 1], srow, ..fixture() }.bytes()).unwrap();
        assert_affine(&volume, srow.map(|r| r.map(|v| f64::from(v) * factor)), 1e-12);
    }
}

#[test]
fn bad_affines_are_refused() {
    refused(&Fixture { codes: [0, 1], ..fixture() }.bytes(), "singular");
    let mut file = Fixture { codes: [0, 1], ..fixture() };
    file.srow[1][2] = f32::NAN;
    refused(&file.bytes(), "not finite");
}

#[test]
fn trap_vox_offset_is_honoured_without_and_with_extensions() {
    for flag in [0, 1] {
        let mut extension = vec![flag, 0, 0, 0];
        extension.extend(vec![0xee; 64]);
        let file = Fixture { vox_offset: 416.0, extension, ..fixture() };
        assert_eq!(read(&file.bytes()).unwrap().as_slice(), counting());
        assert_eq!(read(&gz(&file.bytes())).unwrap().as_slice(), counting());
    }
    assert_eq!(read(&Fixture { vox_offset: 0.0, ..fixture() }.bytes()).unwrap().as_slice(), counting());
    for bad in [100.0, -1.0, 352.5, f32::NAN, f32::NEG_INFINITY] {
        refused(&Fixture { vox_offset: bad, ..fixture() }.bytes(), "vox_offset");
    }
    for far in [1e6, 1e30, f32::INFINITY] {
        refused(&Fixture { vox_offset: far, ..fixture() }.bytes(), "");
    }
}

#[test]
fn trap_gzip_of_several_members_and_whatever_the_name() {
    let bytes = fixture().bytes();
    let files = Files::new();
    for cuts in [vec![], vec![352], vec![3, 100, 347, 360], vec![0, 0, 399]] {
        let mut packed = Vec::new();
        let mut from = 0;
        for to in cuts.iter().copied().chain([bytes.len()]) {
            packed.extend(gz(&bytes[from..to]));
            from = to;
        }
        for name in ["a.nii.gz", "a.nii", "a"] {
            assert_eq!(read_volume(files.put(name, &packed)).unwrap().as_slice(), counting());
        }
        // gzip itself ignores padding after the last member.
        packed.extend([0; 512]);
        assert_eq!(read(&packed).unwrap().as_slice(), counting());
    }
    // Not packed, although the name says so.
    assert_eq!(read_volume(files.put("b.nii.gz", &bytes)).unwrap().as_slice(), counting());
}

#[test]
fn trap_names_with_dots_are_taken_as_they_are() {
    let files = Files::new();
    let other = files.put("sub.nii", b"precious");
    let volume = read(&fixture().bytes()).unwrap();
    for name in ["sub.01.nii", "sub.01.nii.gz", "a.b.c.NII.GZ", ".nii"] {
        write_volume(files.path(name), &volume, "").unwrap();
        assert_eq!(read_volume(files.path(name)).unwrap(), volume);
        let packed = std::fs::read(files.path(name)).unwrap().starts_with(&[0x1f, 0x8b]);
        assert_eq!(packed, name.to_lowercase().ends_with(".gz"));
    }
    assert_eq!(std::fs::read(other).unwrap(), b"precious");
    assert_eq!(std::fs::read_dir(files.0.path()).unwrap().count(), 5);
    let error = write_volume(files.path("a.mhd"), &volume, "").unwrap_err().to_string();
    assert!(error.contains("a.mhd") && error.contains(".nii.gz") && error.contains(".mha"), "{error}");
}

#[test]
fn trap_rgb_and_complex_are_errors_not_panics() {
    for (code, words) in [(128, "RGB"), (2304, "RGB"), (32, "complex"), (1792, "complex"), (2048, "complex")] {
        refused(&Fixture { datatype: code, voxels: vec![0; 400], ..fixture() }.bytes(), words);
    }
    for code in [1536, 0, 1, 3, -7, i16::MAX] {
        refused(&Fixture { datatype: code, voxels: vec![0; 400], ..fixture() }.bytes(), "datatype");
    }
}

#[test]
fn trap_slope_is_one_on_disk_and_values_come_back_whole() {
    let values = vec![-65536.0, 0.0, 1.0, 3.0, 4095.0, 65535.0, 0.5, -0.25, 2f32.powi(100), 7.0, 8.0, 9.0];
    let volume = Volume::from_vec(*read(&fixture().bytes()).unwrap().grid(), values).unwrap();
    let files = Files::new();
    write_volume(files.path("v.nii"), &volume, "").unwrap();
    let bytes = std::fs::read(files.path("v.nii")).unwrap();
    let float = |at: usize| f32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
    assert_eq!((float(108), float(112), float(116)), (352.0, 1.0, 0.0));
    assert_eq!(read_volume(files.path("v.nii")).unwrap(), volume);
}

/// Rows of the affine of [`nifti_2`].
const ROWS_2: [[f64; 4]; 3] = [[0.0, 2.0, 0.0, -1.0], [-3.0, 0.0, 0.0, 5.0], [0.0, 0.0, 4.0, 0.125]];

/// A NIfTI-2 file of the int16 numbers -6 to 5, which stand for half as much and 1 more.
fn nifti_2(dim: [i64; 8], big_endian: bool) -> Vec<u8> {
    let mut h = vec![0u8; 544];
    let mut put = |at: usize, mut b: Vec<u8>| {
        if big_endian {
            b.reverse();
        }
        h[at..at + b.len()].copy_from_slice(&b);
    };
    put(0, 540i32.to_le_bytes().to_vec());
    put(12, 4i16.to_le_bytes().to_vec());
    dim.iter().enumerate().for_each(|(i, v)| put(16 + 8 * i, v.to_le_bytes().to_vec()));
    put(168, 544i64.to_le_bytes().to_vec());
    put(176, 0.5f64.to_le_bytes().to_vec());
    put(184, 1f64.to_le_bytes().to_vec());
    put(348, 1i32.to_le_bytes().to_vec());
    ROWS_2.iter().flatten().enumerate().for_each(|(i, v): (usize, &f64)| put(400 + 8 * i, v.to_le_bytes().to_vec()));
    put(500, 2i32.to_le_bytes().to_vec());
    h[4..12].copy_from_slice(b"n+2\0\r\n\x1a\n");
    for v in -6..6i16 {
        h.extend(if big_endian { v.to_be_bytes() } else { v.to_le_bytes() });
    }
    h
}

#[test]
fn nifti_2_in_both_byte_orders() {
    for big_endian in [false, true] {
        let mut h = nifti_2([3, 2, 3, 2, 1, 1, 1, 1], big_endian);
        let volume = read(&h).unwrap();
        assert_eq!(volume.as_slice(), (-6..6).map(|v| v as f32 * 0.5 + 1.0).collect::<Vec<_>>());
        assert_affine(&volume, ROWS_2, 0.0);
        refused(&h[..543], "bytes");
        refused(&h[..500], "header");
        h[5] = b'!';
        refused(&h, "magic");
    }
}

#[test]
fn trailing_axes_of_one_are_fine_and_series_are_not() {
    for dim in [[4, 2, 3, 2, 1, 0, 0, 0], [7, 2, 3, 2, 1, 1, 1, 1], [5, 2, 3, 2, 0, 0, 9, 9]] {
        assert_eq!(read(&Fixture { dim, ..fixture() }.bytes()).unwrap().as_slice(), counting());
    }
    let voxels = vec![0; 4 * 12 * 3];
    refused(&Fixture { dim: [4, 2, 3, 2, 3, 1, 1, 1], voxels: voxels.clone(), ..fixture() }.bytes(), "series of 3");
    refused(&Fixture { dim: [5, 2, 3, 2, 1, 3, 1, 1], voxels, ..fixture() }.bytes(), "vector field");
}

#[test]
fn forged_dimensions_are_refused_before_anything_is_allocated() {
    let forged = |dim: [i16; 8]| Fixture { dim, ..fixture() }.bytes();
    refused(&forged([3, 32767, 32767, 1, 1, 1, 1, 1]), "needs");
    refused(&forged([3, 32767, 32767, 32767, 1, 1, 1, 1]), "2^31");
    refused(&forged([3, 2, 3, 3, 1, 1, 1, 1]), "needs 424 bytes");
    refused(&forged([3, 2, -3, 2, 1, 1, 1, 1]), "dim[2] is -3");
    refused(&forged([3, 2, 0, 2, 1, 1, 1, 1]), "dim[2] is 0");
    refused(&forged([4, 2, 3, 2, -1, 1, 1, 1]), "dim[4] is -1");
    refused(&forged([7, 32767, 32767, 32767, 32767, 32767, 32767, 32767]), "");
    for count in [0, -1, 8, 9, 255, 256, 0x0300, i16::MAX, i16::MIN] {
        refused(&forged([count, 2, 3, 2, 1, 1, 1, 1]), "dim[0]");
        let file = Fixture { big_endian: true, dim: [count, 2, 3, 2, 1, 1, 1, 1], ..fixture() };
        refused(&file.bytes(), "dim[0]");
    }
    // Packed: the file could not hold so much whatever its content, or could but does not.
    refused(&gz(&forged([3, 32767, 32767, 1, 1, 1, 1, 1])), "needs");
    refused(&gz(&forged([3, 20, 30, 20, 1, 1, 1, 1])), "needs 48352 bytes");
    // A bomb: the header is modest, a gigabyte of zeros follows.
    let mut bomb = gz(&fixture().bytes());
    let zeros = gz(&vec![0; 1 << 24]);
    (0..64).for_each(|_| bomb.extend(&zeros));
    assert_eq!(read(&bomb).unwrap().as_slice(), counting());
}

/// With 2^60 frames the number of bytes once came round to nothing, and a name was made for each
/// frame.
#[test]
fn axes_whose_product_is_past_all_numbers_are_refused() {
    let huge = i64::MAX;
    for dim in [
        [4, 2, 3, 2, 1 << 62, 1, 1, 1],
        [4, 2, 3, 2, 1 << 60, 1, 1, 1],
        [4, 2, 3, 2, 1 << 52, 1, 1, 1],
        [5, 2, 3, 2, 1 << 32, 1 << 32, 1, 1],
        [7, 2, 3, 2, huge, huge, huge, huge],
    ] {
        for bytes in [nifti_2(dim, false), gz(&nifti_2(dim, true))] {
            let files = Files::new();
            let path = files.put("v.nii", &bytes);
            assert!(Series::open(&path).is_err(), "{dim:?}");
            assert!(read_volume(&path).is_err() && read_field(&path).is_err(), "{dim:?}");
            let _ = read_header(&path);
        }
    }
}

fn series(frames: i16) -> Vec<u8> {
    let voxels = (0..12 * i32::from(frames)).flat_map(|i| (i as f32).to_le_bytes()).collect();
    Fixture { dim: [4, 2, 3, 2, frames, 1, 1, 1], voxels, ..fixture() }.bytes()
}

/// All frames of a file in order, as numbers.
fn frames(bytes: &[u8]) -> Result<Vec<f32>, String> {
    let files = Files::new();
    let mut series = Series::open(files.put("v.nii.gz", bytes)).map_err(|e| e.to_string())?;
    let all: Result<Vec<_>, _> = (0..series.frames()).map(|at| series.read(at)).collect();
    all.map(|v| v.iter().flat_map(|v| v.as_slice().to_vec()).collect()).map_err(|e| e.to_string())
}

#[test]
fn the_checksum_of_a_packed_series_is_checked() {
    let good = gz(&series(5));
    let wanted: Vec<f32> = (0..60).map(|i| i as f32).collect();
    assert_eq!(frames(&good).unwrap(), wanted);
    for at in good.len() - 8..good.len() {
        let mut bytes = good.clone();
        bytes[at] ^= 1;
        let why = frames(&bytes).unwrap_err();
        assert!(why.contains("damaged"), "byte {at}: {why}");
    }
    for end in 0..good.len() {
        assert!(frames(&good[..end]).is_err(), "cut after {end} bytes");
    }
}

#[test]
fn a_series_of_several_members_with_padding_is_read() {
    let plain = series(3);
    let mut bytes = [gz(&plain[..400]), gz(&plain[400..401]), gz(&[]), gz(&plain[401..])].concat();
    bytes.extend([0; 700]);
    let wanted: Vec<f32> = (0..36).map(|i| i as f32).collect();
    assert_eq!(frames(&bytes).unwrap(), wanted);
    let files = Files::new();
    let mut series = Series::open(files.put("v.nii.gz", &bytes)).unwrap();
    // Backwards, the last one twice.
    for at in [2, 2, 1, 0, 2] {
        assert_eq!(series.read(at).unwrap().as_slice(), &wanted[12 * at..12 * (at + 1)]);
    }
}

#[test]
fn a_file_cut_anywhere_is_refused() {
    let bytes = fixture().bytes();
    for end in 0..bytes.len() {
        assert!(read(&bytes[..end]).is_err(), "cut after {end} bytes");
        assert!(read(&gz(&bytes[..end])).is_err(), "cut after {end} bytes, then packed");
    }
    refused(&bytes[..399], "cut short");
    let packed = gz(&bytes);
    for end in 0..packed.len() {
        assert!(read(&packed[..end]).is_err(), "packed, cut after {end} of {} bytes", packed.len());
    }
    refused(&packed[..packed.len() - 1], "damaged or cut short");
}

#[test]
fn a_changed_byte_in_a_packed_file_is_noticed() {
    let packed = gz(&fixture().bytes());
    let at = packed.len() - 6; // in the checksum
    for i in [at, packed.len() / 2] {
        let mut bad = packed.clone();
        bad[i] ^= 0x10;
        assert!(read(&bad).is_err());
    }
}

#[test]
fn other_files_are_refused() {
    refused(b"", "header");
    refused(b"DICM and the like, long enough to be a header", "magic");
    refused(&[0x89; 1000], "magic");
    refused(&gz(b"text"), "magic");
    refused(&gz(b""), "header");
    refused(&Fixture { magic: *b"ni1\0", ..fixture() }.bytes(), ".hdr/.img pair");
    refused(&Fixture { magic: [0; 4], ..fixture() }.bytes(), "ANALYZE");
    refused(&Fixture { magic: *b"n+9\0", ..fixture() }.bytes(), "magic");
    let files = Files::new();
    let folder = read_volume(files.0.path()).unwrap_err().to_string();
    assert!(folder.contains("folder without DICOM files"), "{folder}");
    let missing = read_volume(files.path("none.nii")).unwrap_err().to_string();
    assert!(missing.contains("none.nii: cannot read") && missing.contains("check"), "{missing}");
}

#[test]
fn labels_are_whole_numbers_from_0_to_255() {
    let files = Files::new();
    let put = |v: f32| {
        let values = (0..11).map(|i| i as f32).chain([v]);
        files.put("l.nii", &fixture().datatype(16, values.map(f32::to_le_bytes)).bytes())
    };
    assert_eq!(read_labels(put(255.0)).unwrap().as_slice()[11], 255);
    assert_eq!(read_mask(put(0.0)).unwrap().as_slice()[11], 0);
    for bad in [0.5, -1.0, 256.0, f32::NAN, f32::INFINITY] {
        let error = read_labels(put(bad)).unwrap_err().to_string();
        assert!(error.contains("voxel (1, 2, 1)") && error.contains("l.nii"), "{error}");
    }
}

#[test]
fn volumes_labels_and_fields_come_back_on_the_same_grid() {
    let files = Files::new();
    let shear = [[1.0, 0.2, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
    let flipped = [[-1.0, 0.0, 0.0, 90.0], [0.0, -1.0, 0.0, 126.0], [0.0, 0.0, 1.0, -72.0]];
    for (rows, qform) in [(oblique(), 1), (flipped, 1), (shear, 0)] {
        let grid = grid([67, 71, 73], rows);
        let labels = Mask::from_vec(grid, (0..grid.len()).map(|i| (i / 100 % 256) as u8).collect()).unwrap();
        write_labels(files.path("l.nii.gz"), &labels, "").unwrap();
        assert_eq!(read_labels(files.path("l.nii.gz")).unwrap().as_slice(), labels.as_slice());

        let volume = Volume::from_vec(grid, (0..grid.len()).map(|i| (i as f32 * 0.37).sin() * 1e3).collect()).unwrap();
        for name in ["v.nii", "v.nii.gz"] {
            write_volume(files.path(name), &volume, "a sine").unwrap();
            let back = read_volume(files.path(name)).unwrap();
            assert!(back.grid().same_as(&grid));
            for (a, b) in back.as_slice().iter().zip(volume.as_slice()) {
                assert!((a - b).abs() <= b.abs() * 2f32.powi(-16), "{a} {b}");
            }
        }
        // The same bytes where rows are made while they are written: chunks end within rows.
        let made = |first: usize, out: &mut [f32]| out.copy_from_slice(&volume.as_slice()[67 * first..][..out.len()]);
        for (bits, name) in [(None, "v.nii"), (None, "v.nii.gz"), (Some(12), "s.nii.gz")] {
            if let Some(bits) = bits {
                write_steps(files.path(name), &volume, "a sine", bits).unwrap();
            }
            write_by_rows(files.path(&format!("rows_{name}")), &grid, "a sine", bits, &made).unwrap();
            let [a, b] = [name.into(), format!("rows_{name}")].map(|n| std::fs::read(files.path(&n)).unwrap());
            assert!(a == b, "{name}");
        }
        let raw = std::fs::read(files.path("v.nii")).unwrap();
        assert_eq!((raw[252], raw[254], raw[123]), (qform, 1, 2));
        if qform == 1 {
            let mut only_qform = raw;
            only_qform[254] = 0;
            assert_affine(&read(&only_qform).unwrap(), rows, 1e-5);
        }

        write_integers(files.path("i.nii.gz"), &volume, "").unwrap();
        let back = read_volume(files.path("i.nii.gz")).unwrap();
        assert!(back.as_slice().iter().zip(volume.as_slice()).all(|(a, b)| *a == b.round_ties_even()));

        let field = DenseField::from_fn(grid, |p| [p.0[0].sin() * 3.0, p.0[1] * 0.01 - 5.0, p.0[2].cos()]);
        write_field(files.path("f.nii.gz"), &field).unwrap();
        let back = read_field(files.path("f.nii.gz")).unwrap();
        assert!(back.grid().same_as(&grid));
        for (a, b) in back.as_slice().iter().zip(field.as_slice()) {
            assert!((a - b).abs() <= 2f32.powi(-13), "{a} {b}");
        }
    }
}

/// Steps of 2^-12 mm were a quarter of a voxel of a micrometre: a field had 20 values.
#[test]
fn a_field_of_small_voxels_keeps_a_thousandth_of_them() {
    for edge in [1e-3, 0.02, 0.2, 1.0] {
        let files = Files::new();
        let grid = Grid::new([5, 4, 3], Affine::scaled([edge, edge, 3.0 * edge], [0.0; 3]).unwrap()).unwrap();
        let field = DenseField::from_fn(grid, |p| p.0.map(|x| 0.3 * (x / edge).sin() * edge));
        write_field(files.path("f.nii.gz"), &field).unwrap();
        let back = read_field(files.path("f.nii.gz")).unwrap();
        for (a, b) in back.as_slice().iter().zip(field.as_slice()) {
            assert!(f64::from((a - b).abs()) <= 2f64.powi(-13).min(1e-3 * edge), "{edge}: {a} {b}");
        }
    }
}

#[test]
fn integers_that_do_not_fit_are_refused() {
    let grid = grid([1, 1, 2], oblique());
    for bad in [32768.0, f32::NAN, -40000.0] {
        let volume = Volume::from_vec(grid, vec![1.0, bad]).unwrap();
        let files = Files::new();
        assert!(write_integers(files.path("v.nii"), &volume, "").is_err());
        assert!(!files.path("v.nii").exists());
    }
}

#[test]
fn extreme_values_survive_the_rounding() {
    let values = vec![f32::MAX, f32::MIN, f32::INFINITY, f32::NEG_INFINITY, f32::NAN, f32::MIN_POSITIVE, 1e-45, -0.0];
    let grid = grid([2, 2, 2], oblique());
    let files = Files::new();
    write_volume(files.path("v.nii"), &Volume::from_vec(grid, values.clone()).unwrap(), "").unwrap();
    let back = read_volume(files.path("v.nii")).unwrap();
    assert!(back.as_slice()[..6].iter().zip(&values).all(|(a, b)| a.to_bits() == b.to_bits()));

    let big: Vec<f32> = (0..24).map(|i| values[i % 5]).collect();
    write_field(files.path("f.nii"), &DenseField::from_vec(grid, big).unwrap()).unwrap();
    let field = read_field(files.path("f.nii")).unwrap();
    assert!(field.as_slice()[2] == f32::INFINITY && field.as_slice()[4].is_nan());
}

#[test]
fn a_field_is_lps_on_disk_with_intent_1007() {
    let files = Files::new();
    let grid = grid([2, 1, 1], oblique());
    let field = DenseField::from_vec(grid, vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0]).unwrap();
    assert_eq!(field.at(1), [2.0, 4.0, 6.0]);
    write_field(files.path("f.nii"), &field).unwrap();
    let bytes = std::fs::read(files.path("f.nii")).unwrap();
    let short = |at: usize| i16::from_le_bytes(bytes[at..at + 2].try_into().unwrap());
    assert_eq!((0..8).map(|i| short(40 + 2 * i)).collect::<Vec<_>>(), [5, 2, 1, 1, 1, 3, 1, 1]);
    assert_eq!((short(68), short(70), short(72)), (1007, 16, 32));
    let stored: Vec<f32> = bytes[352..].chunks(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
    assert_eq!(stored, [-1.0, -2.0, -3.0, -4.0, 5.0, 6.0]);
    assert_eq!(read_field(files.path("f.nii")).unwrap().as_slice(), field.as_slice());
}

#[test]
fn what_is_not_a_field_is_refused_as_one() {
    let files = Files::new();
    let vector = Fixture { dim: [5, 2, 3, 2, 1, 3, 1, 1], intent: 1007, voxels: vec![0; 144], ..fixture() };
    assert!(read_field(files.put("f.nii", &vector.bytes())).is_ok());
    assert!(read_field(files.put("f.nii", &Fixture { intent: 1006, ..vector.clone() }.bytes())).is_ok());
    let refused = |file: Fixture, words: &str| {
        let error = read_field(files.put("f.nii", &file.bytes())).unwrap_err().to_string();
        assert!(error.contains(words) && error.contains("f.nii"), "{error}");
    };
    refused(Fixture { intent: 0, ..vector.clone() }, "intent 0");
    refused(Fixture { dim: [4, 2, 3, 2, 3, 1, 1, 1], ..vector.clone() }, "[2, 3, 2, 3]");
    refused(Fixture { dim: [5, 2, 3, 2, 1, 2, 1, 1], ..vector.clone() }, "[2, 3, 2, 1, 2]");
    refused(fixture(), "not a displacement field");
    refused(Fixture { voxels: vec![0; 143], ..vector }, "cut short");
}

#[test]
fn the_description_is_cut_at_79_bytes_between_characters() {
    let files = Files::new();
    let volume = read(&fixture().bytes()).unwrap();
    write_volume(files.path("v.nii"), &volume, &format!("{}é", "a".repeat(78))).unwrap();
    let bytes = std::fs::read(files.path("v.nii")).unwrap();
    assert_eq!(&bytes[148..228], [&[b'a'; 78][..], &[0, 0]].concat());
}

#[test]
fn an_axis_too_long_for_nifti_1_is_refused() {
    let long = Volume::filled(grid([40_000, 1, 1], oblique()), 0.0);
    let files = Files::new();
    assert!(write_volume(files.path("v.nii"), &long, "").unwrap_err().to_string().contains("32767"));
}

#[test]
fn the_bytes_do_not_depend_on_the_number_of_threads() {
    let grid = grid([100, 90, 80], oblique());
    let field = DenseField::from_fn(grid, |p| [p.0[0].sin(), p.0[1].cos(), 0.0]);
    let files = Files::new();
    let bytes = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| write_field(files.path("f.nii.gz"), &field)).unwrap();
        std::fs::read(files.path("f.nii.gz")).unwrap()
    };
    let one = bytes(1);
    assert!(one == bytes(2) && one == bytes(5));
    // One member: readers that stop after the first get everything.
    let mut first = Vec::new();
    std::io::Read::read_to_end(&mut flate2::read::GzDecoder::new(&one[..]), &mut first).unwrap();
    assert_eq!(first.len(), 352 + 12 * grid.len());
}

#[test]
fn the_nifti_crate_reads_what_is_written() {
    let grid = grid([64, 64, 64], oblique());
    let volume = Volume::from_vec(grid, (0..grid.len()).map(|i| (i % 1000) as f32).collect()).unwrap();
    let files = Files::new();
    write_volume(files.path("v.nii.gz"), &volume, "test").unwrap();
    let header = nifti::NiftiHeader::from_file(files.path("v.nii.gz")).unwrap();
    assert_eq!(header.dim().unwrap(), [64, 64, 64]);
    let world = grid.affine().to_world(VoxelPoint([0.0; 3]));
    assert_eq!(WorldPoint([header.srow_x[3], header.srow_y[3], header.srow_z[3]].map(f64::from)), world);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]
    #[test]
    fn changed_bytes_never_panic(
        changes in proptest::collection::vec((0usize..400, any::<u8>()), 1..8),
        end in 0usize..=400,
        packed: bool,
    ) {
        let mut bytes = fixture().bytes();
        changes.iter().for_each(|&(at, value)| bytes[at] = value);
        let mut bytes = if packed { gz(&bytes) } else { bytes };
        bytes.truncate(end.max(50));
        let files = Files::new();
        let path = files.put("v.nii", &bytes);
        let _ = read_field(&path);
        let _ = read_labels(&path);
        if let Ok(mut series) = Series::open(&path) {
            let _ = series.read(0);
        }
        if let Ok(volume) = read_volume(&path) {
            prop_assert!(volume.as_slice().len() <= 400);
        }
    }

    #[test]
    fn changed_bytes_of_a_gzip_stream_never_panic(changes in proptest::collection::vec((0usize..100, any::<u8>()), 1..6)) {
        let mut bytes = gz(&fixture().bytes());
        changes.iter().for_each(|&(at, value)| { let n = bytes.len(); bytes[at % n] = value; });
        let _ = read(&bytes);
    }
}
