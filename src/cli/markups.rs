//! `palpate markups`: matches, landmarks or points as a point list of 3D Slicer.

use super::console::Console;
use super::inputs::{check_distinct, check_output_file};
use anyhow::{Result, bail};
use clap::Args;
use palpate::error::Shown;
use palpate::io::{self, TableKind};
use palpate::types::WorldPoint;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub struct Options {
    /// matches.csv of a field run (the kept ones are taken), landmarks (fx,fy,fz,mx,my,mz) or
    /// points (x,y,z)
    points: PathBuf,
    /// File to write (.mrk.json)
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Places in the deformed volume instead of the initial one
    #[arg(long)]
    deformed: bool,
    /// Points at most, evenly thinned; Slicer is slow with many
    #[arg(long, value_name = "N", default_value_t = 2000, value_parser = clap::value_parser!(u32).range(1..))]
    most: u32,
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { points: path, output, deformed, most } = options;
    check_distinct(&[path], std::slice::from_ref(output))?;
    check_output_file(output, &[".mrk.json"])?;
    let place = |initial: WorldPoint, moved: WorldPoint| if *deformed { moved } else { initial };
    let mut rows: Vec<(WorldPoint, String, String)> = match io::table_kind(path)? {
        TableKind::Matches => io::read_matches(path)?
            .kept()
            .enumerate()
            .map(|(i, m)| {
                let [x, y, z] = m.displacement;
                let about = format!("u = {x:.2}, {y:.2}, {z:.2} mm (RAS), sigma {:.2} mm, ncc {:.2}", m.sigma(), m.ncc);
                (place(m.initial, m.initial.moved(m.displacement)), format!("M{}", i + 1), about)
            })
            .collect(),
        TableKind::Landmarks => io::read_landmarks(path)?
            .iter()
            .enumerate()
            .map(|(i, l)| (place(l.initial, l.deformed), format!("L{}", i + 1), String::new()))
            .collect(),
        TableKind::Points => {
            if *deformed {
                console.warn("single points have no deformed place; use palpate warp --points");
            }
            let table = io::read_points(path)?;
            let column = table.other_columns.iter().position(|c| c.eq_ignore_ascii_case("label"));
            let label = |i: usize| column.map_or_else(|| format!("P{}", i + 1), |c| table.others[i][c].clone());
            table.points.iter().enumerate().map(|(i, p)| (*p, label(i), String::new())).collect()
        }
    };
    let all = rows.len();
    if all == 0 {
        bail!("{}: holds no match that is kept, so there is no point to write", path.shown());
    }
    let step = all.div_ceil(*most as usize).max(1);
    rows = rows.into_iter().step_by(step).collect();
    let points: Vec<WorldPoint> = rows.iter().map(|r| r.0).collect();
    let labels: Vec<String> = rows.iter().map(|r| r.1.clone()).collect();
    let about: Vec<String> = rows.iter().map(|r| r.2.clone()).collect();
    io::write_markups(output, &points, &labels, &about)?;
    console.say(&format!("Wrote {}: {} of {all} points.", output.shown(), points.len()));
    Ok(())
}
