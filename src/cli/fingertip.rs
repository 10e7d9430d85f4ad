//! `palpate fingertip`: a stiffness map of a finger pad to a fingertip file for grasps.

use super::console::Console;
use super::inputs::{check_output_file, name, warn_all};
use super::limits::mesh_fits;
use anyhow::{Context, Result};
use clap::Args;
use palpate::error::Shown;
use palpate::fingertip::profile_force;
use palpate::io;
use palpate::pipeline::fingertip::{NODES, PadOutcome, check_nodes, of_map};
use palpate::report::figure::sheet;
use palpate::report::plot::{Line, Plot};
use palpate::types::fingertip::PadModel;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub struct Options {
    /// Folder that `palpate stiffness` wrote, with the bone as a region of its own
    stiffness: PathBuf,
    /// Fingertip file to write (.toml); a picture goes beside it (.svg)
    #[arg(short, long, value_name = "FINGERTIP.toml")]
    output: PathBuf,
    /// Nodes of the finite elements of the map, about; 0 for the columns alone
    #[arg(long, value_name = "N", default_value_t = NODES)]
    nodes: usize,
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { stiffness, output, nodes } = options;
    check_output_file(output, &[".toml"])?;
    check_nodes(*nodes)?;
    mesh_fits(*nodes)?;
    let folder = io::read_stiffness(stiffness)?;
    let from = name(stiffness);
    let progress = console.progress();
    let outcome = of_map(&folder, *nodes, &|s, f| progress.set(s, f)).with_context(|| stiffness.shown())?;
    drop(progress);
    let PadOutcome { pad, at_press, .. } = &outcome;
    let (radius, calibration) = (outcome.radius_mm(), outcome.calibration(folder.force_n));
    io::write_fingertip(output, pad, radius, calibration, &from)?;
    io::write_text(output.with_extension("svg"), &picture(&outcome, folder.force_n))?;

    let [uniform, layered, _] = pad.residuals;
    let enough = match pad.model {
        PadModel::Uniform => "one modulus is enough",
        PadModel::Layered => "one modulus is not enough, layers are",
        PadModel::Map => "the whole map is needed",
    };
    let mut text = format!(
        "{from}: E {:.1} kPa in the pad's own shape; {enough} (forces off by {:.1} % with one, {:.1} % with layers).\n  \
         columns      {} of tissue over bone, {:.2} mm thick, surface radius {radius:.2} mm\n  hemisphere   E {:.1} kPa (forces off by {:.1} %)\n",
        pad.effective_kpa,
        100.0 * uniform,
        100.0 * layered,
        pad.columns,
        pad.thickness_mm,
        pad.hemisphere_kpa,
        100.0 * pad.hemisphere_residual,
    );
    if let Some(plate) = &pad.plate {
        let [deepest, force] = plate.curve.last().copied().unwrap_or_default();
        text += &format!(
            "  elements     {} nodes: {force:.3} N at {deepest:.2} mm; the columns give that times {:.3}, then are off by {:.1} %\n",
            plate.nodes,
            1.0 / plate.factor,
            100.0 * plate.residual
        );
    }
    if let (Some([depth, force]), Some(measured)) = (at_press, folder.force_n) {
        let (model, columns) = match (&pad.plate, outcome.columns_at_press()) {
            (Some(_), Some(columns)) => ("elements", format!("columns {columns:.3} N, ")),
            _ => ("columns", String::new()),
        };
        text += &format!(
            "  press        {depth:.2} mm: {columns}{model} {force:.3} N, measured {measured:.3} N; the hemisphere gets E {:.1} kPa\n",
            calibration * pad.hemisphere_kpa
        );
    }
    text += &match pad.tabulated() {
        true => format!(
            "  grasp        springs of different moduli, a table (forces off by {:.1} %)\n",
            100.0 * pad.profile_residual
        ),
        false => "  grasp        the hemisphere of one modulus\n".into(),
    };
    warn_all(console, &outcome.warnings(&folder));
    console.say(&format!("{text}  results      {}", output.shown()));
    Ok(())
}

/// Force over indentation of the map's finite elements, of its columns, of one modulus and of the
/// hemispheres.
fn picture(outcome: &PadOutcome, force_n: Option<f64>) -> String {
    let pad = &outcome.pad;
    let line = |name: &str, colour: usize, dashed: bool, f: &dyn Fn(&[f64; 3]) -> f64| {
        let points = std::iter::once([0.0, 0.0]).chain(pad.curve.iter().map(|c| [c[0], f(c)])).collect();
        Line::new(name, colour, dashed, points)
    };
    let square = |c: &[f64; 3]| 1e-3 * std::f64::consts::PI * pad.hemisphere_kpa * c[0] * c[0];
    let columns = line("columns", 1, false, &|c| c[1]);
    let (mut map, mut tip) = (Vec::new(), Vec::new());
    if let Some(plate) = &pad.plate {
        let points: Vec<[f64; 2]> = std::iter::once([0.0, 0.0]).chain(plate.curve.iter().copied()).collect();
        map.push(Line::new("elements", 0, false, points.clone()));
        map.push(line(&format!("columns x {:.2}", plate.factor), 1, true, &|c| plate.factor * c[1]));
        tip.push(Line::new("elements", 0, false, points));
    } else {
        tip.push(columns.clone());
    }
    map.extend([columns, line("one E", 2, true, &|c| c[2])]);
    tip.push(line("hemisphere", 2, true, &square));
    tip.push(line("table", 3, true, &|c| profile_force(&pad.profile, c[0])));
    let marks: Vec<(f64, bool)> = outcome.at_press.iter().map(|p| (p[0], false)).collect();
    if let (Some([depth, _]), Some(force)) = (outcome.at_press, force_n) {
        let arm = 0.02 * pad.curve.last().map_or(1.0, |c| c[0]);
        tip.push(Line::new("measured", 1, false, vec![[depth - arm, force], [depth + arm, force]]));
    }
    let draw = |title, lines: &[Line]| Plot { title, across: "mm", marks: &marks }.draw(lines);
    let plots = [
        draw("Force of a flat plate on the map, N, over indentation", &map),
        draw("Hemispheres fitted to that, N, over indentation", &tip),
    ];
    sheet("Finger pad as a fingertip", &plots, 2)
}
