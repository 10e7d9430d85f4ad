//! A displacement field from two volumes, in the fewest lines.
//!
//!     cargo run --release --example own_pair -- [INITIAL DEFORMED]
//!
//! Without files the calf of data-synthetic/ is measured.

use palpate::{io, pipeline, types::FieldParams};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut files = std::env::args().skip(1);
    let data = concat!(env!("CARGO_MANIFEST_DIR"), "/data-synthetic/calf-press");
    let initial = io::read_volume(files.next().unwrap_or_else(|| format!("{data}/initial.nii.gz")))?;
    let deformed = io::read_volume(files.next().unwrap_or_else(|| format!("{data}/deformed.nii.gz")))?;

    let result = pipeline::field::run(&initial, &deformed, None, &FieldParams::default(), &|_, _| {})?;

    let summary = &result.summary;
    println!("{} matches, model {:?}, {} folds", summary.counts.kept, summary.model, summary.folds);
    println!("mean {:.2} mm, largest {:.2} mm", summary.mean_mm, summary.max_mm);
    for warning in &summary.warnings {
        println!("warning: {warning}");
    }
    // Where did the tissue at the middle voxel go, and how sure is that?
    let grid = result.displacement.grid();
    let [i, j, k] = grid.shape().map(|n| n / 2);
    let at = grid.index(i, j, k);
    let u = result.displacement.at(at).map(f64::from);
    let (x, sigma) = (grid.world(i, j, k), result.uncertainty.at(at));
    println!("{:.2?} mm lies at {:.2?} mm, give or take {sigma:.2} mm", x.0, x.moved(u).0);

    std::fs::create_dir_all("out")?;
    io::write_field("out/displacement.nii.gz", &result.displacement)?;
    Ok(())
}
