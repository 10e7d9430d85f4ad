//! `palpate chart`: error against CPU time, cost against size, as SVG, page, JSON and text.

use crate::report::axes::{Axis, Panel, label, path, tiled};
use crate::report::html::{document, escape};
use crate::report::tables::table;
use crate::types::{Part, Standing, Trial};
use serde_json::{Value, json};
use std::fmt::Write;

/// The methods of one panel over the same cases.
#[derive(Debug, Clone, PartialEq)]
pub struct Group {
    /// The chain.
    pub part: Part,
    /// Its title.
    pub title: String,
    /// Unit of its errors.
    pub unit: &'static str,
    /// Its methods.
    pub standings: Vec<Standing>,
}

/// Colour of what is varied.
fn colour(varied: &str) -> usize {
    match varied {
        "preset" | "size" | "whole command" => 0,
        "points" | "nodes" => 1,
        "stage" => 2,
        "step" => 4,
        _ => 3,
    }
}

const SIZE: [f64; 2] = [520.0, 360.0];

/// All panels as one SVG; pointing at a place shows its settings.
pub fn svg(groups: &[Group], trials: &[Trial]) -> String {
    let mut panels: Vec<(Panel, String)> = groups.iter().map(against_time).collect();
    panels.extend(against_size(trials));
    tiled(2, SIZE, &panels)
}

/// Error against CPU time with the front.
fn against_time(group: &Group) -> (Panel, String) {
    let shown: Vec<&Standing> = group.standings.iter().filter(|s| s.error.is_finite() && s.cpu_s > 0.0).collect();
    let cases = shown.iter().map(|s| s.cases).max().unwrap_or(0);
    let panel = Panel {
        title: group.title.clone(),
        note: format!("{} settings, {cases} case{}", shown.len(), if cases == 1 { "" } else { "s" }),
        across: Axis::around("CPU time, s", true, shown.iter().map(|s| s.cpu_s)),
        up: Axis::around(&format!("error, {}", group.unit), true, shown.iter().map(|s| s.error.max(1e-9))),
        size: SIZE,
    };
    let mut front: Vec<[f64; 2]> = shown.iter().filter(|s| s.on_front).map(|s| [s.cpu_s, s.error.max(1e-9)]).collect();
    front.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let mut out = format!(r#"<path class="front" d="{}"/>"#, path(front.iter().map(|&p| panel.at(p))));
    let mut taken: Vec<[f64; 4]> = shown
        .iter()
        .map(|s| {
            let [x, y] = panel.at([s.cpu_s, s.error.max(1e-9)]);
            [x - 5.0, x + 5.0, y - 5.0, y + 5.0]
        })
        .collect();
    // Presets and what is on the front find room for their names first, and lie on top.
    let mut order: Vec<&Standing> = shown;
    order.sort_by_key(|s| (s.varied != "preset", !s.on_front));
    let place = |s: &Standing| panel.at([s.cpu_s, s.error.max(1e-9)]);
    for s in order.iter().rev() {
        let [x, y] = place(s);
        let k = if s.method.contains("semi-implicit") {
            5
        } else if s.method.contains("adaptive") {
            3
        } else {
            colour(s.varied)
        };
        let whole = if s.varied == "other tool" || s.varied == "whole command" { " whole" } else { "" };
        let _ = write!(
            out,
            r#"<circle class="d k{k}{whole}" cx="{x:.1}" cy="{y:.1}" r="4.2"><title>{}</title></circle>"#,
            escape(&hover(s, group.unit))
        );
    }
    for s in order {
        if let Some([left, base]) = room(&panel, place(s), s.method.chars().count(), &mut taken) {
            let _ = write!(out, r#"<text x="{left:.1}" y="{base:.1}">{}</text>"#, escape(&s.method));
        }
    }
    (panel, out)
}

/// A free place for a name of `letters` beside a dot; none where there is no room, pointing at the dot still tells.
fn room(panel: &Panel, [x, y]: [f64; 2], letters: usize, taken: &mut Vec<[f64; 4]>) -> Option<[f64; 2]> {
    let (width, [left, right, top, bottom]) = (5.9 * letters as f64, panel.frame());
    let places = [
        [x + 7.0, y + 4.0],
        [x - 7.0 - width, y + 4.0],
        [x - width / 2.0, y - 8.0],
        [x - width / 2.0, y + 16.0],
        [x + 6.0, y - 6.0],
        [x + 6.0, y + 14.0],
    ];
    let found = places.into_iter().find(|&[a, b]| {
        let own = [a, a + width, b - 9.0, b + 2.0];
        let free = |t: &[f64; 4]| own[1] < t[0] || own[0] > t[1] || own[3] < t[2] || own[2] > t[3];
        a >= left && a + width <= right && b - 9.0 >= top && b <= bottom && taken.iter().all(free)
    })?;
    taken.push([found[0], found[0] + width, found[1] - 9.0, found[1] + 2.0]);
    Some(found)
}

fn hover(s: &Standing, unit: &str) -> String {
    let failed = if s.failures > 0 { format!(", {} without a result", s.failures) } else { String::new() };
    let front = if s.on_front { "; on the front" } else { "" };
    format!(
        "{}: {}\nerror {} {unit}, {} s of CPU time over {} cases{failed}{front}",
        s.method,
        s.settings,
        label_3(s.error),
        label_3(s.cpu_s),
        s.cases
    )
}

/// Three digits that count.
fn label_3(v: f64) -> String {
    match v.abs() {
        a if a == 0.0 || !a.is_finite() => label(v),
        a if a < 1e-3 => format!("{v:.2e}"),
        a => format!("{v:.*}", (2 - a.log10().floor() as i32).max(0) as usize),
    }
}

/// CPU time against voxels, a line a preset; none where sizes were not varied.
fn against_size(trials: &[Trial]) -> Option<(Panel, String)> {
    let mut lines: Vec<(&str, Vec<&Trial>)> = Vec::new();
    for t in trials.iter().filter(|t| t.varied == "size" && t.error.is_finite()) {
        match lines.iter_mut().find(|l| l.0 == t.method) {
            Some(line) => line.1.push(t),
            None => lines.push((&t.method, vec![t])),
        }
    }
    let all = || lines.iter().flat_map(|l| &l.1);
    all().next()?;
    let panel = Panel {
        title: "Cost against size".into(),
        note: "one head, finer and finer voxels".into(),
        across: Axis::around("voxels", true, all().map(|t| t.size as f64)),
        up: Axis::around("CPU time, s", true, all().map(|t| t.cpu_s)),
        size: SIZE,
    };
    let mut out = String::new();
    for (k, (name, line)) in lines.iter().enumerate() {
        let at = |t: &&Trial| panel.at([t.size as f64, t.cpu_s]);
        let _ = write!(out, r#"<path class="l k{}" d="{}"/>"#, k % 6, path(line.iter().map(at)));
        for t in line {
            let [x, y] = at(t);
            let left = t.nothing.map_or(f64::NAN, |n| 100.0 * t.error / n);
            let title = format!("{name}, {} voxels: {} s, {} % left", t.size, label_3(t.cpu_s), label_3(left));
            let _ = write!(
                out,
                r#"<circle class="d k{}" cx="{x:.1}" cy="{y:.1}" r="3.6"><title>{}</title></circle>"#,
                k % 6,
                escape(&title)
            );
        }
        let [left, _, top, _] = panel.frame();
        let _ = write!(
            out,
            r#"<path class="l k{}" d="M{:.0} {:.0}h18"/><text x="{:.0}" y="{:.0}">{}</text>"#,
            k % 6,
            left + 10.0,
            top + 12.0 + 15.0 * k as f64,
            left + 33.0,
            top + 16.0 + 15.0 * k as f64,
            escape(name)
        );
    }
    Some((panel, out))
}

/// The page.
pub fn page(groups: &[Group], trials: &[Trial]) -> String {
    let mut body = format!(
        "<header><p class=\"brand\">palpate {}</p><h1>Speed against accuracy</h1><p class=\"verdict\">The line joins the \
         settings that no other beats in both. Point at a place to see its settings. Hollow places are whole commands, with \
         their start and their files; all others are the work alone.</p></header><article class=\"wide\">{}</article>",
        env!("CARGO_PKG_VERSION"),
        svg(groups, trials)
    );
    for group in groups {
        let row = |s: &Standing| {
            vec![
                escape(&s.method),
                escape(&s.settings),
                label_3(s.error),
                label_3(s.cpu_s),
                s.cases.to_string(),
                if s.failures > 0 { s.failures.to_string() } else { String::new() },
                if s.on_front { "front".into() } else { String::new() },
            ]
        };
        let rows: Vec<_> = group.standings.iter().map(row).collect();
        let error = format!("Error, {}", group.unit);
        let head = ["Method", "Settings", &error, "CPU, s", "Cases", "No result", ""];
        let _ = write!(body, "<section><h2>{}</h2>{}</section>", escape(&group.title), table(&head, &rows));
    }
    let failed = |t: &Trial| t.failure.as_ref().map(|f| vec![escape(&t.method), escape(&t.case), escape(f)]);
    let failures: Vec<_> = trials.iter().filter_map(failed).collect();
    if !failures.is_empty() {
        let _ = write!(
            body,
            "<section><h2>Without a result</h2>{}</section>",
            table(&["Method", "Case", "Why"], &failures)
        );
    }
    document("palpate: speed against accuracy", &body)
}

/// summary.json.
pub fn summary(groups: &[Group], seconds: f64) -> Value {
    let groups: Vec<Value> = groups
        .iter()
        .map(|g| json!({"part": g.part, "title": g.title, "unit": g.unit, "standings": g.standings}))
        .collect();
    json!({"version": env!("CARGO_PKG_VERSION"), "command": "chart", "groups": groups, "seconds": seconds})
}

/// The front of each group, for stdout.
pub fn text(groups: &[Group]) -> String {
    let mut out = String::new();
    for group in groups {
        let _ = writeln!(out, "{}: what no other setting beats", group.title);
        let mut front: Vec<&Standing> = group.standings.iter().filter(|s| s.on_front).collect();
        front.sort_by(|a, b| a.cpu_s.total_cmp(&b.cpu_s));
        for s in front {
            let _ =
                writeln!(out, "  {:28} {:>9} s  {:>9} {}", s.method, label_3(s.cpu_s), label_3(s.error), group.unit);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn standing(method: &str, error: f64, cpu_s: f64, on_front: bool) -> Standing {
        let settings = format!("--{method} \"<x>\"");
        Standing { varied: "stage", method: method.into(), settings, error, cpu_s, cases: 2, failures: 0, on_front }
    }

    #[test]
    fn every_method_can_be_pointed_at_and_the_front_is_drawn() {
        let standings =
            vec![standing("a", 10.0, 1.0, true), standing("b", 20.0, 2.0, false), standing("c", 5.0, 4.0, true)];
        let group = Group { part: Part::Field, title: "Field".into(), unit: "% left", standings };
        let svg = svg(std::slice::from_ref(&group), &[]);
        assert_eq!(svg.matches("<circle").count(), 3);
        assert!(svg.contains("--a &quot;&lt;x&gt;&quot;"));
        let front = svg.split(r#"class="front" d=""#).nth(1).and_then(|s| s.split('"').next()).unwrap_or_default();
        assert_eq!((front.matches('M').count(), front.matches('L').count()), (1, 1));
        assert!(!text(&[group]).contains("\n  b "));
    }

    #[test]
    fn numbers_keep_three_digits() {
        assert_eq!([0.012345, 12.345, 123.45, 1e-7].map(label_3), ["0.0123", "12.3", "123", "1.00e-7"]);
    }
}
