//! Texts of any shape take at most 64 times their size of memory, little time, and short messages,
//! and slices no more memory than their bytes stand for.
#![allow(clippy::unwrap_used)]

#[path = "fixtures/slices.rs"]
mod slices;

use palpate::io::{self, SceneOverrides};
use peak_alloc::PeakAlloc;
use std::fs;
use std::path::Path;
use std::time::{Duration, Instant};
use tempfile::TempDir;

#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;

/// What a reader may take whatever the text (bytes).
const SLACK: usize = 1 << 20;
/// Characters of a message at most.
const LONGEST_MESSAGE: usize = 1500;

type Reader = fn(&Path) -> Result<(), String>;

fn told<T>(found: Result<T, impl std::fmt::Display>) -> Result<(), String> {
    found.map(drop).map_err(|e| e.to_string())
}

// One test: the memory of all threads is counted.
#[test]
fn sizes_that_are_claimed_take_no_memory() {
    texts_of_any_shape();
    slices_that_claim_to_be_large();
}

fn slices_that_claim_to_be_large() {
    let folder = TempDir::new().unwrap();
    for syntax in [slices::IMPLICIT, slices::EXPLICIT, slices::BIG_ENDIAN, slices::RLE] {
        let slice = slices::Slice { syntax, ..slices::Slice::new(0) };
        let path = folder.path().join("slice.dcm");
        fs::write(&path, slice.claiming(16_387, 32_772)).unwrap();
        let before = MEMORY.current_usage();
        MEMORY.reset_peak_usage();
        let said = io::read_volume(&path).unwrap_err().to_string();
        assert!(MEMORY.peak_usage() - before < SLACK, "{syntax}: memory is taken");
        assert!(said.contains("slice.dcm") && said.contains("1074069528 bytes for the voxels"), "{said}");
    }
}

fn texts_of_any_shape() {
    let folder = TempDir::new().unwrap();
    let long = |piece: &str, bytes: usize| piece.repeat(bytes / piece.len());
    let readers: [(&str, Reader); 9] = [
        ("pairs.csv", |p| told(io::read_pairs(p))),
        ("points.csv", |p| told(io::read_points(p))),
        ("points.mrk.json", |p| told(io::read_points(p))),
        ("points.fcsv", |p| told(io::read_points(p))),
        ("matrix.mat", |p| told(io::read_transform(p, None, None, None))),
        ("config.json", |p| told(io::read_config(p))),
        ("config.toml", |p| told(io::read_config(p))),
        ("scene.toml", |p| told(io::read_scene(p, &SceneOverrides::default()))),
        ("skin.toml", |p| told(io::read_skin_scene(p))),
    ];
    // One line; one name; many cells; many lines; many keys; deep and wide lists.
    let mb = 1 << 20;
    let texts = [
        long("a", 4 * mb),
        long("a,", 4 * mb),
        long(",", 4 * mb),
        long("\n", 4 * mb),
        long("a\n", 4 * mb),
        format!("initial,deformed\n{}", long("a,b\n", 4 * mb)),
        format!("x,y,z\n{}", long("1,2,3\n", 4 * mb)),
        format!("x,y,z,{}\n1,2,3,{}\n", long("a", 2 * mb), long("b", 2 * mb)),
        format!("{} = 1\n", long("k", 2 * mb)),
        format!("{{\"{}\": 1}}", long("k", 2 * mb)),
        format!("[load]\n{} = 1\n", long("k", 2 * mb)),
        format!("points = [{}]", long("1,", mb)),
        format!("points = [{}]", long("[],", mb)),
        format!("{{\"points\": [{}1]}}", long("1,", mb)),
        format!("{{\"markups\": [{}1]}}", long("[],", mb)),
        (0..mb / 16).map(|k| format!("k{k} = {k}\n")).collect(),
        format!("{{{}\"z\": 1}}", (0..mb / 16).map(|k| format!("\"{k}\": 1,")).collect::<String>()),
        long("[", mb),
        long("[[a]]\n", mb),
        long("1 2 3 4\n", 4 * mb),
        format!("# columns = {}", long("a,", 4 * mb)),
    ];
    let mut wrong = Vec::new();
    for (name, read) in readers {
        for (number, text) in texts.iter().enumerate() {
            let path = folder.path().join(name);
            fs::write(&path, text).unwrap();
            let before = MEMORY.current_usage();
            MEMORY.reset_peak_usage();
            let started = Instant::now();
            let found = read(&path);
            let (taken, most) = (MEMORY.peak_usage() - before, 64 * text.len() + SLACK);
            let ratio = taken as f64 / text.len() as f64;
            if taken > most {
                wrong.push(format!("{name}, text {number}: {ratio:.0} times its size"));
            }
            if started.elapsed() > Duration::from_secs(20) {
                wrong.push(format!("{name}, text {number}: {:?}", started.elapsed()));
            }
            let said = found.err().unwrap_or_default();
            let shown: String = said.chars().take(200).collect();
            if said.chars().count() > LONGEST_MESSAGE {
                wrong.push(format!("{name}, text {number}: {} bytes: {shown}", said.len()));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}
