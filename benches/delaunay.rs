//! CPU seconds of the Delaunay tetrahedralisation of random points, and of the interpolation to a
//! grid.
//!
//! `cargo bench --bench delaunay [-- POINTS ...]`; the least of some runs is printed.

use palpate::field::interpolation::interpolate_tetrahedra;
use palpate::mesh::delaunay3::delaunay3;
use palpate::types::{Affine, Grid, WorldPoint};
use std::time::Instant;

/// Points in the unit cube from SplitMix64.
fn random_points(n: usize) -> Vec<WorldPoint> {
    let mut state = 1u64;
    let mut next = || {
        state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut h = state;
        h = (h ^ (h >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        h = (h ^ (h >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((h ^ (h >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    };
    (0..n).map(|_| WorldPoint([next(), next(), next()])).collect()
}

/// CPU seconds of all threads so far; wall seconds where the system does not tell.
fn cpu_seconds(start: Instant) -> f64 {
    let spent = |thread: std::fs::DirEntry| -> Option<f64> {
        let told = std::fs::read_to_string(thread.path().join("schedstat")).ok()?;
        Some(told.split_whitespace().next()?.parse::<f64>().ok()? * 1e-9)
    };
    let threads = std::fs::read_dir("/proc/self/task").into_iter().flatten().flatten();
    threads.map(spent).sum::<Option<f64>>().filter(|&s| s > 0.0).unwrap_or_else(|| start.elapsed().as_secs_f64())
}

/// Least CPU seconds of `runs` calls.
fn least_seconds(runs: usize, mut call: impl FnMut()) -> f64 {
    let start = Instant::now();
    let one = |_| {
        let before = cpu_seconds(start);
        call();
        cpu_seconds(start) - before
    };
    (0..runs).map(one).fold(f64::INFINITY, f64::min)
}

fn main() {
    let wanted: Vec<usize> = std::env::args().filter_map(|a| a.parse().ok()).collect();
    let sizes = if wanted.is_empty() { vec![10_000, 30_000, 100_000, 1_000_000] } else { wanted };
    println!("{:>9} {:>11} {:>9} {:>24}", "points", "tetrahedra", "CPU s", "to 5 M voxels, CPU s");
    for n in sizes {
        let points = random_points(n);
        let runs = (1_000_000 / n).clamp(1, 30);
        let Ok(d) = delaunay3(&points) else { continue };
        let meshing = least_seconds(runs, || drop(delaunay3(&points)));
        let side = 171;
        let Ok(affine) = Affine::scaled([1.0 / (side - 1) as f64; 3], [0.0; 3]) else { continue };
        let Ok(grid) = Grid::new([side; 3], affine) else { continue };
        let displacement: Vec<[f64; 3]> = points.iter().map(|p| p.0.map(|v| v * v)).collect();
        let filling = least_seconds(runs.min(5), || drop(interpolate_tetrahedra(&d.mesh, &displacement, &grid)));
        println!("{n:>9} {:>11} {meshing:>9.3} {filling:>24.3}", d.mesh.tetrahedra().len());
    }
}
