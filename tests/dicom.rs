//! A DICOM MR series, written byte by byte, read as a volume.
#![allow(clippy::unwrap_used)]

use palpate::io;
use palpate::types::WorldPoint;
use std::fs;
use std::path::Path;
use tempfile::TempDir;

const ROWS: u16 = 3;
const COLUMNS: u16 = 4;

/// An element in explicit VR, little-endian.
fn element(group: u16, number: u16, vr: &str, value: &[u8]) -> Vec<u8> {
    let mut value = value.to_vec();
    if value.len() % 2 == 1 {
        value.push(if vr == "UI" { 0 } else { b' ' });
    }
    let mut out = [group.to_le_bytes(), number.to_le_bytes()].concat();
    out.extend(vr.as_bytes());
    if matches!(vr, "OB" | "OW" | "UN" | "SQ") {
        out.extend([0, 0]);
        out.extend((value.len() as u32).to_le_bytes());
    } else {
        out.extend((value.len() as u16).to_le_bytes());
    }
    out.extend(value);
    out
}

struct Slice {
    number: usize,
    series: &'static str,
    position: String,
    syntax: &'static str,
}

impl Slice {
    /// Rows run to the front-left of nothing: columns to the left (x+ in LPS), rows up (z+), slices to the front (y-).
    fn new(number: usize) -> Self {
        let position = format!("-10\\{}\\30", -20.0 - 4.0 * number as f64);
        Self { number, series: "1.2.3.4", position, syntax: "1.2.840.10008.1.2.1" }
    }

    fn bytes(&self) -> Vec<u8> {
        let meta = [
            element(2, 2, "UI", b"1.2.840.10008.5.1.4.1.1.4"),
            element(2, 3, "UI", format!("1.2.3.4.{}", self.number).as_bytes()),
            element(2, 0x10, "UI", self.syntax.as_bytes()),
            element(2, 0x12, "UI", b"1.2.3"),
        ]
        .concat();
        let mut out = vec![0; 128];
        out.extend(b"DICM");
        out.extend(element(2, 0, "UL", &(meta.len() as u32).to_le_bytes()));
        out.extend(meta);
        let pixels: Vec<u8> = (0..ROWS * COLUMNS).flat_map(|i| (100 * self.number as u16 + i).to_le_bytes()).collect();
        let body = [
            element(8, 0x60, "CS", b"MR"),
            element(0x18, 0x50, "DS", b"4"),
            element(0x20, 0xe, "UI", self.series.as_bytes()),
            element(0x20, 0x13, "IS", self.number.to_string().as_bytes()),
            element(0x20, 0x32, "DS", self.position.as_bytes()),
            element(0x20, 0x37, "DS", b"1\\0\\0\\0\\0\\1"),
            element(0x28, 2, "US", &1u16.to_le_bytes()),
            element(0x28, 0x10, "US", &ROWS.to_le_bytes()),
            element(0x28, 0x11, "US", &COLUMNS.to_le_bytes()),
            element(0x28, 0x30, "DS", b"3\\2"),
            element(0x28, 0x100, "US", &16u16.to_le_bytes()),
            element(0x28, 0x103, "US", &0u16.to_le_bytes()),
            element(0x28, 0x1052, "DS", b"-5"),
            element(0x28, 0x1053, "DS", b"0.5"),
            element(0x7fe0, 0x10, "OW", &pixels),
        ];
        out.extend(body.concat());
        out
    }

    /// Files are named so that their order is not that of the slices.
    fn write(&self, folder: &Path) {
        fs::write(folder.join(format!("IM{:03}", (7 * self.number) % 10)), self.bytes()).unwrap();
    }
}

fn series(slices: impl IntoIterator<Item = Slice>) -> TempDir {
    let folder = TempDir::new().unwrap();
    slices.into_iter().for_each(|s| s.write(folder.path()));
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
