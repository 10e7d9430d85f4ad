//! CPU seconds of the Delaunay tetrahedralisation of random points, and of the interpolation on a grid.
//!
//! `cargo bench --bench delaunay [-- POINTS ...]`; the least of some runs is printed.

use palpate::mesh::delaunay3::delaunay3;
use palpate::types::WorldPoint;
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

/// CPU seconds of this thread so far; wall seconds where the system does not tell.
fn cpu_seconds(start: Instant) -> f64 {
    let told = std::fs::read_to_string("/proc/thread-self/schedstat").ok();
    let spent = told.and_then(|s| s.split_whitespace().next()?.parse::<f64>().ok());
    spent.map_or_else(|| start.elapsed().as_secs_f64(), |ns| ns * 1e-9)
}

fn main() {
    let wanted: Vec<usize> = std::env::args().filter_map(|a| a.parse().ok()).collect();
    let sizes = if wanted.is_empty() { vec![10_000, 30_000, 100_000, 1_000_000] } else { wanted };
    let start = Instant::now();
    println!("{:>9} {:>11} {:>9}", "points", "tetrahedra", "CPU s");
    for n in sizes {
        let points = random_points(n);
        let runs = (300_000 / n).clamp(1, 10);
        let mut best = (f64::INFINITY, 0);
        for _ in 0..runs {
            let before = cpu_seconds(start);
            let tetrahedra = delaunay3(&points).map_or(0, |d| d.mesh.tetrahedra().len());
            best = (best.0.min(cpu_seconds(start) - before), tetrahedra);
        }
        println!("{n:>9} {:>11} {:>9.3}", best.1, best.0);
    }
}
