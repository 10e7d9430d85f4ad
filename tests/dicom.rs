//! A DICOM MR series, written byte by byte, read as a volume.
#![allow(clippy::unwrap_used)]

#[path = "fixtures/slices.rs"]
mod slices;

use palpate::io;
use palpate::types::WorldPoint;
use slices::Slice;
use std::fs;
use tempfile::TempDir;

fn series(slices: impl IntoIterator<Item = Slice>) -> TempDir {
    let folder = TempDir::new().unwrap();
    // Files are named so that their order is not that of the slices.
    let name = |s: &Slice| format!("IM{:03}", (7 * s.number) % 10);
    slices.into_iter().for_each(|s| fs::write(folder.path().join(name(&s)), s.bytes()).unwrap());
    fs::write(folder.path().join("notes.txt"), "not DICOM").unwrap();
    folder
}

#[test]
fn a_series_is_a_volume_where_its_headers_say() {
    let folder = series((0..5).map(Slice::new));
    let volume = io::read_volume(folder.path()).unwrap();
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
    let (stored, kind) = io::read_header(folder.path()).unwrap();
    assert_eq!((stored.format, stored.datatype, kind), ("DICOM series", "uint16", io::ImageKind::Scalar));
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
    refused(&series((0..5).filter(|n| *n != 2).map(Slice::new)), "evenly");
    refused(&series((0..2).map(|n| Slice { position: "0\\0\\0".into(), ..Slice::new(n) })), "one place");
    refused(&series((0..2).map(|n| Slice { syntax: "1.2.840.10008.1.2.4.70", ..Slice::new(n) })), "compressed");
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
