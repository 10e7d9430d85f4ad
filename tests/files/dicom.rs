//! A DICOM MR series, written byte by byte, read as a volume.

use crate::slices::Slice;
use palpate::io;
use palpate::types::WorldPoint;
use std::fs;
use std::path::Path;
use tempfile::TempDir;

fn series(slices: impl IntoIterator<Item = Slice>) -> TempDir {
    let folder = TempDir::new().unwrap();
    // Files are named so that their order is not that of the slices.
    let name = |s: &Slice| format!("IM{:03}", (7 * s.number) % 10);
    slices.into_iter().for_each(|s| fs::write(folder.path().join(name(&s)), s.bytes()).unwrap());
    fs::write(folder.path().join("notes.txt"), "not DICOM").unwrap();
    folder
}

/// That the volume is the one of five slices.
#[track_caller]
fn check(path: &Path) {
    let volume = io::read_volume(path).unwrap();
    let grid = volume.grid();
    assert_eq!(grid.shape(), [4, 3, 5]);
    assert_eq!(grid.world(0, 0, 0), WorldPoint([10.0, 20.0, 30.0]));
    assert_eq!(grid.world(1, 0, 0), WorldPoint([8.0, 20.0, 30.0]), "columns run to the left, 2 mm");
    assert_eq!(grid.world(0, 1, 0), WorldPoint([10.0, 20.0, 33.0]), "rows run up, 3 mm");
    assert_eq!(grid.world(0, 0, 1), WorldPoint([10.0, 24.0, 30.0]), "slices run to the front, 4 mm");
    for k in 0..5 {
        for i in 0..12 {
            assert_eq!(volume.as_slice()[12 * k + i], 0.5 * (100 * k + i) as f32 - 5.0);
        }
    }
}

#[test]
fn a_series_is_a_volume_where_its_headers_say() {
    let folder = series((0..5).map(Slice::new));
    check(folder.path());
    let (stored, kind) = io::read_header(folder.path()).unwrap();
    assert_eq!((stored.format, stored.datatype, kind), ("DICOM series", "uint16", io::ImageKind::Scalar));
}

const SYNTAXES: [&str; 5] = [
    crate::slices::IMPLICIT,
    crate::slices::EXPLICIT,
    crate::slices::DEFLATED,
    crate::slices::BIG_ENDIAN,
    crate::slices::RLE,
];

#[test]
fn every_transfer_syntax_that_is_read_gives_the_same_volume() {
    for syntax in SYNTAXES {
        let folder = series((0..5).map(|n| Slice { syntax, ..Slice::new(n) }));
        check(folder.path());
    }
}

#[test]
fn a_transfer_syntax_that_is_not_read_is_named() {
    for (syntax, name) in [
        ("1.2.840.10008.1.2.4.90", "JPEG 2000 lossless"),
        ("1.2.840.10008.1.2.4.80", "JPEG-LS lossless"),
        ("1.2.840.10008.1.2.4.51", "12 bits"),
        ("1.2.3.4.5", "another one"),
    ] {
        let folder = series((0..2).map(|n| Slice { syntax, ..Slice::new(n) }));
        let error = io::read_volume(folder.path()).unwrap_err().to_string();
        assert!(error.contains(syntax) && error.contains(name) && error.contains("gdcmconv --raw"), "{error}");
    }
}

/// Written by ITK: 37 i^2 + 11 j, modulo 3000, less 500.
#[test]
fn a_slice_in_lossless_jpeg_is_read_as_it_was_written() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("lossless.dcm");
    let bytes = include_bytes!("../fixtures/lossless.dcm");
    fs::write(&path, bytes).unwrap();
    let volume = io::read_volume(&path).unwrap();
    assert_eq!(volume.grid().shape(), [9, 6, 1]);
    for (at, v) in volume.as_slice().iter().enumerate() {
        let (i, j) = (at % 9, at / 9);
        assert_eq!(*v, ((37 * i * i + 11 * j) % 3000) as f32 - 500.0, "voxel {i}, {j}");
    }
    for cut in [20, 60, 100] {
        fs::write(&path, &bytes[..bytes.len() - cut]).unwrap();
        assert!(io::read_volume(&path).is_err());
    }
}

#[test]
fn a_file_of_many_frames_is_a_volume() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("frames.dcm");
    // Frames in another order than that of their places.
    let mixed: Vec<Slice> = [3, 0, 4, 1, 2].map(Slice::new).into();
    for syntax in SYNTAXES {
        fs::write(&path, Slice::enhanced(&mixed, syntax)).unwrap();
        check(&path);
        check(folder.path());
    }
    let twice: Vec<Slice> = [0, 1, 1, 2].map(Slice::new).into();
    fs::write(&path, Slice::enhanced(&twice, crate::slices::EXPLICIT)).unwrap();
    let error = io::read_volume(&path).unwrap_err().to_string();
    assert!(error.contains("one place") && error.contains("frame 2") && error.contains("frame 3"), "{error}");
}

#[test]
fn a_siemens_mosaic_is_a_volume() {
    let folder = TempDir::new().unwrap();
    let slices: Vec<Slice> = (0..5).map(Slice::new).collect();
    let path = folder.path().join("mosaic.dcm");
    fs::write(&path, Slice::mosaic(&slices)).unwrap();
    check(&path);
    check(folder.path());
    let mut bytes = Slice::mosaic(&slices);
    let at = bytes.windows(4).position(|w| w == b"SV10").unwrap();
    bytes[at] = b'X';
    fs::write(&path, bytes).unwrap();
    let error = io::read_volume(&path).unwrap_err().to_string();
    assert!(error.contains("mosaic.dcm") && error.contains("mosaic"), "{error}");
}

#[test]
fn one_file_of_a_series_stands_for_all_of_it() {
    let folder = series((0..5).map(Slice::new));
    for n in 0..3 {
        let other = Slice { series: "9.9", ..Slice::new(n) };
        fs::write(folder.path().join(format!("other{n}.dcm")), other.bytes()).unwrap();
    }
    let error = io::read_volume(folder.path()).unwrap_err().to_string();
    for part in ["2 DICOM series", "1.2.3.4", "9.9", "T1 axial", "5 files", "3 files", "other0.dcm"] {
        assert!(error.contains(part), "{part} is missing in {error}");
    }
    // Each folder takes the series that is named, in order.
    let found = io::series_in(folder.path()).unwrap();
    assert_eq!(found.iter().map(|s| (s.uid.as_str(), s.files)).collect::<Vec<_>>(), [("1.2.3.4", 5), ("9.9", 3)]);
    crate::fixtures::run(folder.path(), &["info", ".", "--series", "9.9"], 0)
        .0
        .contains("4 x 3 x 3")
        .then_some(())
        .unwrap();
    let warp = ["warp", ".", "--reference", ".", "-o", "w.nii", "--series", "9.9,1.2.3.4"];
    crate::fixtures::run(folder.path(), &warp, 0);
    assert_eq!(io::read_volume(folder.path().join("w.nii")).unwrap().grid().shape(), [4, 3, 5]);
    let (_, err) = crate::fixtures::run(folder.path(), &["info", ".", "--series=8.8"], 2);
    assert!(err.contains("8.8") && err.contains("1.2.3.4, 9.9"), "{err}");
    let (one, other) = (folder.path().join("IM007"), folder.path().join("other1.dcm"));
    check(&one);
    assert_eq!(io::read_volume(&other).unwrap().grid().shape(), [4, 3, 3]);
    // All of them count as what was read.
    assert_eq!(io::files_of(&one).len(), 5);
    assert_eq!(io::read_volume_header(&one).unwrap().axes, [4, 3, 5]);
    // A broken neighbour of another series does not matter to it, one of its own does.
    fs::write(folder.path().join("other2.dcm"), &Slice::new(0).bytes()[..200]).unwrap();
    check(&one);
}

#[test]
fn gaps_and_copies_name_their_files_and_places() {
    let refused = |folder: &TempDir, parts: &[&str]| {
        let error = io::read_volume(folder.path()).unwrap_err().to_string();
        parts.iter().for_each(|part| assert!(error.contains(part), "{part} is missing in {error}"));
    };
    refused(
        &series((0..5).filter(|n| *n != 2).map(Slice::new)),
        &["gap of 8.00 mm", "IM007", "IM001", "24.00", "32.00"],
    );
    let folder = series((0..5).map(Slice::new));
    fs::copy(folder.path().join("IM004"), folder.path().join("copy")).unwrap();
    refused(&folder, &["one place", "IM004", "copy", "(10.00, 28.00, 30.00)"]);
    let folder = series((0..5).map(|n| match n {
        2 => Slice { position: "-9\\-28\\30".into(), ..Slice::new(n) },
        _ => Slice::new(n),
    }));
    refused(&folder, &["evenly", "IM004", "1.00 mm off"]);
}

/// Twelve bits of sixteen: what stands in the other four is no part of the number.
#[test]
fn bits_that_are_not_used_do_not_count() {
    for (bits, less) in
        [((true, 12, 0), 250), ((true, 12, 0xffff), 250), ((false, 12, 0xa5a5), 0), ((true, 16, 0), 250)]
    {
        let folder = series((0..5).map(|n| Slice { bits, less, ..Slice::new(n) }));
        let volume = io::read_volume(folder.path()).unwrap();
        let wanted = |k: usize, i: usize| 0.5 * ((100 * k + i) as f32 - f32::from(less)) - 5.0;
        for (o, v) in volume.as_slice().iter().enumerate() {
            assert_eq!(*v, wanted(o / 12, o % 12), "{bits:?}, voxel {o}");
        }
    }
}

#[test]
fn folders_with_flaws_are_named() {
    let refused = |folder: &TempDir, message: &str| {
        let error = io::read_volume(folder.path()).unwrap_err().to_string();
        assert!(error.contains(message), "should say {message:?}: {error}");
    };
    refused(&series([]), "without DICOM files");
    refused(
        &series((0..5).map(|n| Slice { series: if n == 2 { "9.9" } else { "1.2.3.4" }, ..Slice::new(n) })),
        "2 DICOM series",
    );
    refused(&series((0..2).map(|n| Slice { position: "0\\0\\0".into(), ..Slice::new(n) })), "one place");
    refused(&series((0..2).map(|n| Slice { syntax: "1.2.840.10008.1.2.4.70", ..Slice::new(n) })), "packed image");
    refused(&series((0..2).map(|n| Slice { position: "0\\0".into(), ..Slice::new(n) })), "ImagePositionPatient");
    let folder = series((0..3).map(Slice::new));
    let whole = Slice::new(1).bytes();
    fs::write(folder.path().join("IM007"), &whole[..whole.len() - 8]).unwrap();
    assert!(io::read_volume(folder.path()).is_err());
}

#[test]
fn no_bytes_make_the_reader_panic() {
    let folder = series((0..2).map(Slice::new));
    let whole = Slice::new(1).bytes();
    let mut state = 3u64;
    for _ in 0..500 {
        let mut bytes = whole.clone();
        for _ in 0..3 {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            let at = 132 + (state >> 33) as usize % (bytes.len() - 132);
            bytes[at] = (state >> 20) as u8;
        }
        fs::write(folder.path().join("IM007"), bytes).unwrap();
        let _ = io::read_volume(folder.path());
    }
}
