//! Measurements beside the tip models: what was fitted, and how far each is off.

use crate::report::plot::{Line, Plot};
use crate::report::scale::short;
use crate::report::tables::table;
use crate::types::measured::{CoursePoint, Estimate, ForcePoint, MeasuredFit, Measurements, ModelFit};
use maud::{Markup, html};

/// Tilts that the plot of forces shows at most.
const MAX_TILTS_SHOWN: usize = 3;

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
pub(crate) fn fitted_words(model: &ModelFit) -> String {
    let damping = model.damping.map_or(String::new(), |c| format!(", c_n {} N s/m", estimate(&c, 1.0)));
    let evidence = match model.log_evidence {
        0.0 => "the best".into(),
        v => format!("log odds {v:.1}"),
    };
    format!("E {} kPa{damping}, misfit {:.2e}; {evidence}", estimate(&model.youngs_modulus, 1e-3), model.rms)
}

/// The section of a page.
pub(super) fn measured(measurements: &Measurements, fit: &MeasuredFit) -> Markup {
    let head = ["Model", "E, kPa", "c_n, N s/m", "Misfit (rms)", "Log odds against the best"];
    let (scale, unit) = if fit.kind == "force" { (1.0, "N") } else { (1e3, "mm") };
    let rows = fit.models.iter().map(|m| {
        [
            m.model.into(),
            estimate(&m.youngs_modulus, 1e-3),
            m.damping.map_or("not in the table".into(), |c| estimate(&c, 1.0)),
            format!("{} {unit}", digits(scale * m.rms)),
            format!("{:.1}", m.log_evidence),
        ]
    });
    html! {
        section {
            h2 { "Measured" }
            p.lead {
                (fit.rows) " rows, of which " (format_args!("{:.0}", fit.independent)) " numbers count as independent: "
                (fit.verdict()) ". Deviations are one standard deviation, from the misfit itself."
            }
            div.plots {
                @match measurements {
                    Measurements::Force(points) => (presses(points, fit)),
                    Measurements::Course(points) => {
                        (channel("Object's angle, degrees", 2, 1f64.to_degrees(), points, fit))
                        (channel("x, mm", 0, 1e3, points, fit))
                        (channel("y, mm", 1, 1e3, points, fit))
                    }
                }
            }
            article.wide { (table(&head, rows)) }
        }
    }
}

/// One coordinate of the pose over time, measured and fitted.
fn channel(title: &str, k: usize, scale: f64, points: &[CoursePoint], fit: &MeasuredFit) -> Markup {
    let own = Line::dots("measured", 3, points.iter().map(|p| [p.time, scale * p.pose[k]]).collect());
    let models = fit.models.iter().enumerate().map(|(i, m)| {
        let line = points.iter().zip(&m.predicted).map(|(p, v)| [p.time, scale * v[k]]).collect();
        Line::new(m.model, i, i > 0, line)
    });
    Plot { title, across: "s", marks: &[] }.shown(&models.chain([own]).collect::<Vec<_>>())
}

/// Forces over displacement at some tilts, and misfits over tilt.
fn presses(points: &[ForcePoint], fit: &MeasuredFit) -> Markup {
    let degrees = |p: &ForcePoint| p.tilt.to_degrees().abs().round();
    let mut tilts: Vec<f64> = points.iter().map(degrees).collect();
    tilts.sort_by(f64::total_cmp);
    tilts.dedup();
    let shown: Vec<f64> = if tilts.len() <= MAX_TILTS_SHOWN {
        tilts
    } else {
        vec![tilts[0], tilts[tilts.len() / 2], tilts[tilts.len() - 1]]
    };
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
    html! {
        (Plot { title: &title, across: "d, mm", marks: &[] }.shown(&lines))
        (Plot { title: "Misfit, N", across: "tilt, degrees", marks: &[] }.shown(&off))
    }
}
