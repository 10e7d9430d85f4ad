//! `palpate fingertip`: a stiffness map of a finger pad to a fingertip file for grasps.

use super::console::Console;
use super::inputs::{check_output_file, name};
use anyhow::{Context, Result, bail};
use clap::Args;
use palpate::error::FingertipError;
use palpate::fingertip::profile_force;
use palpate::io::{self, StiffnessFolder};
use palpate::pipeline::fingertip::{PadOutcome, run as reduce};
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
}

/// A region that is so many times stiffer than the softest holds as a back plate.
const HARD: f64 = 20.0;

/// Names of hard parts.
const BONE: [&str; 4] = ["bone", "plate", "phalanx", "nail"];

/// The unit vector out of the pressed side.
fn outward(folder: &StiffnessFolder) -> [f64; 3] {
    let mut out = [0.0; 3];
    if let Some((axis, sign)) = folder.load.split_at_checked(1)
        && let (Some(axis), "+" | "-") = (["x", "y", "z"].iter().position(|a| *a == axis), sign)
    {
        out[axis] = if sign == "+" { 1.0 } else { -1.0 };
        return out;
    }
    // A patch given as a mask: against the way it went.
    let [moved, held] = folder.translation;
    let d: [f64; 3] = std::array::from_fn(|a| held[a] - moved[a]);
    let length = d.iter().map(|v| v * v).sum::<f64>().sqrt().max(1e-12);
    d.map(|v| v / length)
}

/// Moduli that stand for bone or a back plate: by name, by a lower bound, or by being far stiffer than the softest.
fn hard(folder: &StiffnessFolder) -> Vec<f64> {
    let named = |n: &str| BONE.iter().any(|b| n.to_lowercase().contains(b));
    let known = |r: &&io::StiffnessRegion| named(&r.name) || r.bound.as_deref() == Some("lower");
    // A bound says nothing of how soft the softest is.
    let tissue = folder.regions.iter().filter(|r| !known(r) && r.bound.is_none());
    let softest = tissue.map(|r| r.youngs_modulus).fold(f64::INFINITY, f64::min);
    let is_hard = |r: &&io::StiffnessRegion| known(r) || r.youngs_modulus >= HARD * softest;
    folder.regions.iter().filter(is_hard).map(|r| r.youngs_modulus).collect()
}

pub fn run(options: &Options, console: &Console) -> Result<()> {
    let Options { stiffness, output } = options;
    check_output_file(output, &[".toml"])?;
    let folder = io::read_stiffness(stiffness)?;
    let from = name(stiffness);
    if !folder.absolute {
        bail!(anyhow::Error::new(FingertipError::NotAbsolute).context(stiffness.display().to_string()));
    }
    let (bones, values) = (hard(&folder), folder.map.as_slice());
    // Files keep 16 bits of a number.
    let bone = |o: usize| bones.iter().any(|b| (f64::from(values[o]) / b - 1.0).abs() < 1e-4);
    let side = outward(&folder);
    let [moved, held] = folder.translation;
    let along = |u: [f64; 3]| (0..3).map(|a| u[a] * side[a]).sum::<f64>();
    // Of a curved pad that is pressed flat the middle goes less far than the plate.
    let indentation = folder.travel_mm.unwrap_or(-along(moved)) + along(held);
    let outcome =
        reduce(&folder.map, bone, side, Some(indentation)).with_context(|| stiffness.display().to_string())?;
    let PadOutcome { pad, at_press } = &outcome;
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
    if let (Some([depth, force]), Some(measured)) = (at_press, folder.force_n) {
        text += &format!(
            "  press        {depth:.2} mm: columns {force:.3} N, measured {measured:.3} N; the hemisphere gets E {:.1} kPa\n",
            calibration * pad.hemisphere_kpa
        );
    }
    text += &match pad.tabulated() {
        true => format!(
            "  grasp        springs of unlike modulus, a table (forces off by {:.1} %)\n",
            100.0 * pad.profile_residual
        ),
        false => "  grasp        the hemisphere of one modulus\n".into(),
    };
    if radius > 2.0 * pad.thickness_mm {
        console.warn("the pad is flat: a hemisphere is a poor picture of it");
    }
    console.say(&format!("{text}  results      {}", output.display()))
}

/// Force over indentation of the map, of one modulus and of the hemisphere.
fn picture(outcome: &PadOutcome, force_n: Option<f64>) -> String {
    let pad = &outcome.pad;
    let line = |name: &str, colour: usize, dashed: bool, f: &dyn Fn(&[f64; 3]) -> f64| {
        let points = std::iter::once([0.0, 0.0]).chain(pad.curve.iter().map(|c| [c[0], f(c)])).collect();
        Line::new(name, colour, dashed, points)
    };
    let square = |c: &[f64; 3]| 1e-3 * std::f64::consts::PI * pad.hemisphere_kpa * c[0] * c[0];
    let mut lines = vec![
        line("columns", 0, false, &|c| c[1]),
        line("one E", 1, true, &|c| c[2]),
        line("hemisphere", 2, true, &square),
        line("table", 3, false, &|c| profile_force(&pad.profile, c[0])),
    ];
    let marks: Vec<(f64, bool)> = outcome.at_press.iter().map(|p| (p[0], false)).collect();
    if let (Some([depth, _]), Some(force)) = (outcome.at_press, force_n) {
        let arm = 0.02 * pad.curve.last().map_or(1.0, |c| c[0]);
        lines.push(Line::new("measured", 1, false, vec![[depth - arm, force], [depth + arm, force]]));
    }
    let plot = Plot { title: "Force on the pad, N, over indentation", across: "mm", marks: &marks }.draw(&lines);
    sheet("Finger pad as a fingertip", &[plot], 1)
}
