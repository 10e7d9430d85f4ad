//! Measurements beside the tip models: what was fitted, and how far each is off.

use crate::report::html::escape;
use crate::report::plot::{Line, Plot};
use crate::report::scale::short;
use crate::report::tables::table;
use crate::types::measured::{Estimate, ForcePoint, MeasuredFit, Measurements, ModelFit};

/// Tilts that the plot of forces shows at most.
const TILTS: usize = 3;

/// Three significant digits.
fn digits(v: f64) -> String {
    if v == 0.0 || !v.is_finite() {
        return short(v);
    }
    let place = 2 - v.abs().log10().floor() as i32;
    let scale = 10f64.powi(place);
    let rounded = (v * scale).round() / scale;
    if place > 0 { format!("{rounded:.*}", place as usize) } else { format!("{rounded:.0}") }
}

fn estimate(e: &Estimate, scale: f64) -> String {
    format!("{} ± {}", digits(scale * e.value), digits(scale * e.sd))
}

/// What was fitted of one model, in a line.
pub fn fitted_words(model: &ModelFit) -> String {
    let damping = model.damping.map_or(String::new(), |c| format!(", c_n {} N s/m", estimate(&c, 1.0)));
    let evidence = match model.log_evidence {
        0.0 => "the best".into(),
        v => format!("log odds {v:.1}"),
    };
    format!("E {} kPa{damping}, misfit {:.2e}; {evidence}", estimate(&model.youngs_modulus, 1e-3), model.rms)
}

/// The section of a page.
pub fn measured(measurements: &Measurements, fit: &MeasuredFit) -> String {
    let head = ["Model", "E, kPa", "c_n, N s/m", "Misfit (rms)", "Log odds against the best"];
    let unit = if fit.kind == "force" { (1.0, "N") } else { (1e3, "mm") };
    let rows: Vec<Vec<String>> = fit
        .models
        .iter()
        .map(|m| {
            vec![
                m.model.into(),
                estimate(&m.youngs_modulus, 1e-3),
                m.damping.map_or("not in the table".into(), |c| estimate(&c, 1.0)),
                format!("{} {}", digits(unit.0 * m.rms), unit.1),
                format!("{:.1}", m.log_evidence),
            ]
        })
        .collect();
    let plots = match measurements {
        Measurements::Force(points) => presses(points, fit),
        Measurements::Course(points) => {
            let channel = |title: &str, k: usize, scale: f64| {
                let own = Line::dots("measured", 3, points.iter().map(|p| [p.time, scale * p.pose[k]]).collect());
                let models = fit.models.iter().enumerate().map(|(i, m)| {
                    let line = points.iter().zip(&m.predicted).map(|(p, v)| [p.time, scale * v[k]]).collect();
                    Line::new(m.model, i, i > 0, line)
                });
                let lines: Vec<Line> = models.chain([own]).collect();
                Plot { title, across: "s", marks: &[] }.draw(&lines)
            };
            channel("Object's angle, degrees", 2, 1f64.to_degrees())
                + &channel("x, mm", 0, 1e3)
                + &channel("y, mm", 1, 1e3)
        }
    };
    format!(
        "<section><h2>Measured</h2><p class=\"lead\">{} rows, of which {:.0} numbers count as independent: {}. Deviations are one \
         standard deviation, from the misfit itself.</p><div class=\"plots\">{plots}</div><article class=\"wide\">{}</article></section>",
        fit.rows,
        fit.independent,
        escape(&fit.verdict()),
        table(&head, &rows)
    )
}

/// Forces over displacement at some tilts, and misfits over tilt.
fn presses(points: &[ForcePoint], fit: &MeasuredFit) -> String {
    let degrees = |p: &ForcePoint| p.tilt.to_degrees().abs().round();
    let mut tilts: Vec<f64> = points.iter().map(degrees).collect();
    tilts.sort_by(f64::total_cmp);
    tilts.dedup();
    let shown: Vec<f64> =
        if tilts.len() <= TILTS { tilts } else { vec![tilts[0], tilts[tilts.len() / 2], tilts[tilts.len() - 1]] };
    let mut lines = Vec::new();
    for (colour, tilt) in shown.iter().enumerate() {
        let mut at: Vec<usize> = (0..points.len()).filter(|&i| degrees(&points[i]) == *tilt).collect();
        at.sort_by(|a, b| points[*a].d.total_cmp(&points[*b].d));
        let place = |i: &usize, force: f64| [1e3 * points[*i].d, force];
        lines.push(Line::dots(&format!("{tilt} deg"), colour, at.iter().map(|i| place(i, points[*i].force)).collect()));
        for (k, model) in fit.models.iter().take(2).enumerate() {
            let line = at.iter().map(|i| place(i, model.predicted[*i][0])).collect();
            lines.push(Line::new("", colour, k > 0, line));
        }
    }
    let names: Vec<&str> = fit.models.iter().take(2).map(|m| m.model).collect();
    let title = match names[..] {
        [best, next] => format!("Force, N: measured (dots), {best}, {next} (dashed)"),
        _ => "Force, N: measured (dots) and fitted".into(),
    };
    let off: Vec<Line> = fit
        .models
        .iter()
        .enumerate()
        .map(|(k, m)| {
            let off = points.iter().zip(&m.predicted).map(|(p, v)| [p.tilt.to_degrees(), p.force - v[0]]);
            Line::dots(m.model, k, off.collect())
        })
        .collect();
    Plot { title: &title, across: "d, mm", marks: &[] }.draw(&lines)
        + &Plot { title: "Misfit, N", across: "tilt, degrees", marks: &[] }.draw(&off)
}
