//! `palpate stress`: error against severity, where it breaks and where the program says so.

use crate::report::axes::{Axis, Panel, path, tiled};
use crate::report::html::{document, escape, header};
use crate::report::scale::significant;
use crate::report::tables::table;
use crate::types::{Part, Stated, StressCurve, StressRun};
use maud::{PreEscaped, html};
use serde_json::{Value, json};
use std::fmt::Write;

const SIZE: [f64; 2] = [330.0, 250.0];

/// Curves of one part and axis, in the order in which they come.
fn grouped(curves: &[StressCurve]) -> Vec<Vec<&StressCurve>> {
    let mut out: Vec<Vec<&StressCurve>> = Vec::new();
    for c in curves {
        match out.iter_mut().find(|g| g[0].part == c.part && g[0].axis == c.axis) {
            Some(group) => group.push(c),
            None => out.push(vec![c]),
        }
    }
    out
}

/// All panels as one SVG.
pub fn svg(curves: &[StressCurve]) -> String {
    let panels: Vec<(Panel, String)> = grouped(curves).iter().map(|g| panel(g)).collect();
    tiled(4, SIZE, &panels)
}

/// Error over limit at one severity: the median of the runs that have one.
fn median_error(runs: &[StressRun]) -> Option<f64> {
    let mut errors: Vec<f64> = runs.iter().map(|r| r.error / r.limit).filter(|e| e.is_finite()).collect();
    errors.sort_by(f64::total_cmp);
    errors.get(errors.len() / 2).copied()
}

fn panel(group: &[&StressCurve]) -> (Panel, String) {
    let first = group[0];
    let errors = group.iter().flat_map(|c| c.severities()).filter_map(median_error).map(|e| e.clamp(1e-3, 1e3));
    let mut up = Axis::around("error / limit", true, errors.chain([1.0, 0.3, 3.0]));
    up.ends[0] = up.ends[0].max(5e-4);
    let [a, b] = first.range;
    let logarithmic = a > 0.0 && b > 0.0 && (a / b).max(b / a) > 15.0;
    let name = if first.unit.is_empty() { first.axis.clone() } else { format!("{}, {}", first.axis, first.unit) };
    let panel = Panel {
        title: format!("{}: {}", first.part.name(), first.axis),
        note: String::new(),
        across: Axis { name, logarithmic, ends: first.range },
        up,
        size: SIZE,
    };
    let [left, right, top, bottom] = panel.frame();
    let [_, limit] = panel.at([first.range[0], 1.0]);
    let mut out = format!(r#"<path class="limit" d="M{left} {limit:.1}H{right}"/>"#);
    for (k, curve) in group.iter().enumerate() {
        let k = k % 6;
        let points: Vec<([f64; 2], &[StressRun])> = curve
            .severities()
            .map(|runs| {
                let error = median_error(runs).map_or(panel.up.ends[1], |e| e.clamp(1e-3, 1e3));
                (panel.at([runs[0].severity, error]), runs)
            })
            .collect();
        let _ = write!(out, r#"<path class="l k{k}" d="{}"/>"#, path(points.iter().map(|p| p.0)));
        for ([x, y], runs) in &points {
            let title = escape(&hover(curve, runs));
            let refused = 2 * runs.iter().filter(|r| r.refused.is_some()).count() >= runs.len();
            let class = if refused { "d whole" } else { "d" };
            let _ = write!(
                out,
                r#"<circle class="{class} k{k}" cx="{x:.1}" cy="{y:.1}" r="3.2"><title>{title}</title></circle>"#
            );
            if 2 * runs.iter().filter(|r| r.silent()).count() >= runs.len() {
                let _ = write!(
                    out,
                    r#"<path class="x" d="M{:.1} {:.1}l10 10m0 -10l-10 10"><title>{title}</title></path>"#,
                    x - 5.0,
                    y - 5.0
                );
            }
        }
        for (at, class) in [(curve.told_at, "told"), (curve.breaks_at, "broke")] {
            if let Some(v) = at {
                let [x, _] = panel.at([v, 1.0]);
                let x = x + 1.5 * k as f64;
                let _ = write!(out, r#"<path class="{class} k{k}" d="M{x:.1} {bottom}V{:.1}"/>"#, bottom - 14.0);
            }
        }
        let _ = write!(
            out,
            r#"<text class="n name k{k}" x="{:.0}" y="{:.0}">{}</text>"#,
            left + 5.0,
            top + 11.0 + 13.0 * k as f64,
            escape(&curve.case)
        );
    }
    (panel, out)
}

fn hover(curve: &StressCurve, runs: &[StressRun]) -> String {
    let mut out = format!("{}, {} {} {}", curve.case, curve.axis, digits(runs[0].severity), curve.unit);
    for r in runs {
        let error =
            if r.error.is_nan() { "no result".into() } else { format!("{} {}", digits(r.error), curve.error_unit) };
        let _ = write!(out, "\n{error}, limit {}", digits(r.limit));
        if let Some(inside) = r.inside {
            let _ = write!(out, ", {:.0} % inside the region", 100.0 * inside);
        }
        for said in r.refused.iter().chain(&r.said) {
            let _ = write!(out, "; {said}");
        }
    }
    out
}

/// Three digits that count, without zeros at the end.
fn digits(v: f64) -> String {
    let s = significant(v);
    if s.contains('.') && !s.contains('e') { s.trim_end_matches('0').trim_end_matches('.').into() } else { s }
}

/// With its unit.
fn with_unit(v: f64, c: &StressCurve) -> String {
    format!("{} {}", digits(v), c.unit).trim_end().to_string()
}

/// Where a curve breaks, in words.
fn breaks(c: &StressCurve) -> String {
    let last = c.runs.last().map(|r| r.severity);
    match (c.breaks_at, c.holds_at) {
        (Some(at), Some(low)) => format!("breaks at {} (holds at {})", with_unit(at, c), digits(low)),
        (Some(at), None) => format!("breaks at once ({})", with_unit(at, c)),
        (None, Some(v)) if last.is_some_and(|l| l == c.range[1]) => format!("holds to {}", with_unit(v, c)),
        (None, Some(v)) => format!("holds to {}, no more can be had", with_unit(v, c)),
        (None, None) => "cannot be had".into(),
    }
}

/// Where the program first says so, in words.
fn told(c: &StressCurve) -> String {
    match (c.told_at, c.quiet_at) {
        (Some(at), Some(quiet)) => format!("at {} (not at {})", with_unit(at, c), digits(quiet)),
        (Some(at), None) => format!("from {} on", with_unit(at, c)),
        (None, _) => "nowhere".into(),
    }
}

/// Share of the runs with a usable result whose 95 % band holds at least `share` of the errors.
pub(crate) fn bands_that_hold(curves: &[StressCurve], part: Part, share: f64) -> Option<f64> {
    let sound = curves.iter().filter(|c| c.part == part).flat_map(|c| &c.runs).filter(|r| !r.broken());
    let (good, all) = sound
        .filter_map(|r| r.inside)
        .fold((0usize, 0usize), |(good, all), inside| (good + usize::from(inside >= share), all + 1));
    (all > 0).then(|| good as f64 / all as f64)
}

fn row(c: &StressCurve) -> [String; 6] {
    let held: Vec<f64> = c.runs.iter().filter(|r| !r.broken()).filter_map(|r| r.inside).collect();
    let mean = held.iter().sum::<f64>() / held.len() as f64;
    let silent = c.silent().count();
    [
        format!("{}: {}", c.part.name(), c.axis),
        c.case.clone(),
        breaks(c),
        told(c),
        if silent > 0 { format!("{silent} of {}", c.runs.len()) } else { "none".into() },
        if held.is_empty() { String::new() } else { format!("{:.0} %", 100.0 * mean) },
    ]
}

const HEAD: [&str; 6] =
    ["Axis", "Body or form", "Breaking point", "First says so", "Silent failures", "Inside 95 % region"];

/// The page.
pub fn page(curves: &[StressCurve], stated: Option<&Stated>) -> String {
    let runs: usize = curves.iter().map(|c| c.runs.len()).sum();
    let silent: usize = curves.iter().map(|c| c.silent().count()).sum();
    let broken: usize = curves.iter().flat_map(|c| &c.runs).filter(|r| r.broken()).count();
    let verdict = format!("{broken} of {runs} runs have no result or one of no use; {silent} of these silently.");
    let body = html! {
        (header("Where it breaks", &verdict, ""))
        p.lead {
            "Severity grows to the right. The dotted line is the limit. On the axis, an upright stroke marks where at least \
             half of the runs break, a dashed one where at least half say that something is wrong. Hollow: refused. Red \
             crosses: broken and silent. Errors below a thousandth of the limit are drawn at that thousandth, runs without a result at \
             the top."
        }
        article.wide { (PreEscaped(svg(curves))) }
        section {
            h2 { "Table" }
            @if let Some(stated) = stated { p { (stated_in_words(stated)) } }
            div.four { (table(&HEAD, curves.iter().map(row))) }
        }
    };
    document("palpate: where it breaks", &body)
}

/// summary.json: each curve without its runs.
pub fn summary(curves: &[StressCurve], stated: Option<&Stated>, seconds: f64) -> Value {
    let one = |c: &StressCurve| {
        let inside: Vec<f64> = c.runs.iter().filter(|r| !r.broken()).filter_map(|r| r.inside).collect();
        let mean = (!inside.is_empty()).then(|| inside.iter().sum::<f64>() / inside.len() as f64);
        json!({
            "part": c.part, "axis": c.axis, "case": c.case, "unit": c.unit, "range": c.range, "breaks_at": c.breaks_at,
            "holds_at": c.holds_at, "told_at": c.told_at, "quiet_at": c.quiet_at, "runs": c.runs.len(), "silent": c.silent().count(),
            "inside_band": mean,
        })
    };
    json!({
        "version": env!("CARGO_PKG_VERSION"), "command": "stress", "curves": curves.iter().map(one).collect::<Vec<_>>(),
        "field_bands_that_hold": bands_that_hold(curves, Part::Field, 0.9), "field_stated": stated,
        "seconds": seconds,
    })
}

/// What the field's runs state of their errors, in words.
fn stated_in_words(s: &Stated) -> String {
    let ranks = s.rank_correlation.map_or_else(|| "none".into(), |r| format!("{r:.2}"));
    format!(
        "Of {} field runs {} have no result or an error of a third of the motion or more, {} of them without low trust. Of {} \
         with an error under a tenth of it {} are refused or of low trust. Expected and true error: rank correlation {ranks}, \
         within a factor of 1.5 in {:.0} %, of 2 in {:.0} %.",
        s.runs,
        s.broken,
        s.silent,
        s.small,
        s.false_alarms,
        100.0 * s.within[0],
        100.0 * s.within[1]
    )
}

/// A line a curve, for stdout.
pub fn text(curves: &[StressCurve], stated: Option<&Stated>) -> String {
    let mut out = String::from("Breaking points (harmless to hopeless), and where the program first says so:\n");
    let row = |c: &StressCurve| {
        let silent = c.silent().count();
        let silent = if silent > 0 { format!("  {silent} silent") } else { String::new() };
        [c.part.name().into(), c.axis.clone(), c.case.clone(), breaks(c), format!("says so {}{silent}", told(c))]
    };
    let rows: Vec<[String; 5]> = curves.iter().map(row).collect();
    let widths: [usize; 5] = std::array::from_fn(|k| rows.iter().map(|r| r[k].chars().count()).max().unwrap_or(0));
    for row in rows {
        let cells: String = row.iter().zip(widths).map(|(cell, w)| format!("  {cell:w$}")).collect();
        let _ = writeln!(out, "{}", cells.trim_end());
    }
    if let Some(share) = bands_that_hold(curves, Part::Field, 0.9) {
        let _ = writeln!(
            out,
            "The 95 % region holds 90 % of the errors or more in {:.0} % of the usable field runs.",
            100.0 * share
        );
    }
    if let Some(stated) = stated {
        let _ = writeln!(out, "{}", stated_in_words(stated));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(severity: f64, error: f64, said: &str) -> StressRun {
        let said = if said.is_empty() { Vec::new() } else { vec![said.to_string()] };
        StressRun { severity, error, limit: 1.0, refused: None, said, inside: Some(0.93), expected: Some(0.9) }
    }

    #[test]
    fn a_silent_failure_is_crossed_and_counted() {
        let curve = StressCurve {
            part: Part::Field,
            axis: "noise".into(),
            unit: "%",
            error_unit: "mm",
            case: "block".into(),
            range: [0.0, 20.0],
            runs: vec![run(0.0, 0.1, ""), run(10.0, 2.0, ""), run(20.0, 3.0, "folds")],
            breaks_at: Some(10.0),
            holds_at: Some(0.0),
            told_at: Some(20.0),
            quiet_at: Some(10.0),
        };
        let curves = [curve];
        assert_eq!(svg(&curves).matches(r#"class="x""#).count(), 1);
        assert!(page(&curves, None).contains("2 of 3 runs have no result or one of no use; 1 of these silently"));
        assert_eq!(summary(&curves, None, 1.0)["curves"][0]["silent"], 1);
        assert!(
            text(&curves, None).contains("breaks at 10 % (holds at 0)") && text(&curves, None).contains("1 silent")
        );
        assert!(text(&curves, None).contains("says so at 20 % (not at 10)"));
        assert_eq!(bands_that_hold(&curves, Part::Field, 0.9), Some(1.0));
    }
    #[test]
    fn breaking_points_keep_their_digits_and_say_how_far_was_tried() {
        let with = |range: [f64; 2], last: f64, breaks_at, holds_at| StressCurve {
            part: Part::Grasp,
            axis: "step".into(),
            unit: "s",
            error_unit: "degrees",
            case: "rk4".into(),
            range,
            runs: vec![run(range[0], 0.1, ""), run(last, 0.2, "")],
            breaks_at,
            holds_at,
            told_at: None,
            quiet_at: Some(last),
        };
        assert_eq!(
            breaks(&with([1e-4, 0.05], 0.05, Some(0.001_464), Some(0.0014))),
            "breaks at 0.00146 s (holds at 0.0014)"
        );
        assert_eq!(
            breaks(&with([1e-4, 0.05], 0.05, Some(0.002_8), Some(0.0027))),
            "breaks at 0.0028 s (holds at 0.0027)"
        );
        assert_eq!(breaks(&with([1.0, 30.0], 30.0, None, Some(30.0))), "holds to 30 s");
        assert_eq!(breaks(&with([1.0, 30.0], 24.0, None, Some(24.0))), "holds to 24 s, no more can be had");
        assert_eq!(breaks(&with([2e5, 2e3], 2e3, Some(26_670.0), None)), "breaks at once (26700 s)");
    }
}
