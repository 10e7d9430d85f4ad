//! `palpate chart`: error against CPU time, cost against size, as SVG, page, JSON and text.

use crate::report::axes::{Axis, Panel, path, tiled};
use crate::report::html::{document, escape, header};
use crate::report::scale::significant;
use crate::report::tables::table;
use crate::types::{Part, Standing, Trial};
use maud::{PreEscaped, html};
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

/// Smaller errors are drawn here.
const MIN_DRAWN_ERROR: f64 = 1e-9;

/// All panels as one SVG; pointing at a place shows its settings.
pub fn svg(groups: &[Group], trials: &[Trial]) -> String {
    let mut panels: Vec<(Panel, String)> = groups.iter().map(against_time).collect();
    panels.extend(against_size(trials));
    panels.extend(against_nodes(trials));
    tiled(2, SIZE, &panels)
}

/// Error against CPU time with the front.
fn against_time(group: &Group) -> (Panel, String) {
    let shown: Vec<&Standing> = group.standings.iter().filter(|s| s.error.is_finite() && s.cpu_s > 0.0).collect();
    let cases = shown.iter().map(|s| s.cases).max().unwrap_or(0);
    let mut note = format!("{} settings, {cases} case{}", shown.len(), if cases == 1 { "" } else { "s" });
    if shown.len() < group.standings.len() {
        let _ = write!(note, "; {} without any result", group.standings.len() - shown.len());
    }
    if shown.iter().any(|s| s.error < MIN_DRAWN_ERROR) {
        let _ = write!(note, "; errors below {MIN_DRAWN_ERROR:.0e} at it");
    }
    let panel = Panel {
        title: group.title.clone(),
        note,
        across: Axis::around("CPU time, s", true, shown.iter().map(|s| s.cpu_s)),
        up: Axis::around(&format!("error, {}", group.unit), true, shown.iter().map(|s| s.error.max(MIN_DRAWN_ERROR))),
        size: SIZE,
    };
    let mut front: Vec<[f64; 2]> =
        shown.iter().filter(|s| s.on_front).map(|s| [s.cpu_s, s.error.max(MIN_DRAWN_ERROR)]).collect();
    front.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let mut out = format!(r#"<path class="front" d="{}"/>"#, path(front.iter().map(|&p| panel.at(p))));
    let mut taken: Vec<[f64; 4]> = shown
        .iter()
        .map(|s| {
            let [x, y] = panel.at([s.cpu_s, s.error.max(MIN_DRAWN_ERROR)]);
            [x - 5.0, x + 5.0, y - 5.0, y + 5.0]
        })
        .collect();
    // Presets and what is on the front find room for their names first, and lie on top.
    let mut order: Vec<&Standing> = shown;
    order.sort_by_key(|s| (s.varied != "preset", !s.on_front));
    let place = |s: &Standing| panel.at([s.cpu_s, s.error.max(MIN_DRAWN_ERROR)]);
    let mut names = String::new();
    for s in &order {
        let (name, [x, y]) = (name(s), place(s));
        let Some(([left, base], lead)) = room(&panel, [x, y], name.chars().count(), &mut taken) else { continue };
        if let Some([a, b]) = lead {
            let _ = write!(out, r#"<path class="lead" d="M{x:.1} {y:.1}L{a:.1} {b:.1}"/>"#);
        }
        let _ = write!(names, r#"<text class="name" x="{left:.1}" y="{base:.1}">{}</text>"#, escape(&name));
    }
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
    out.push_str(&names);
    (panel, out)
}

/// With how many of the cases it has a result on, where that is not all.
fn name(s: &Standing) -> String {
    match s.failures {
        0 => s.method.clone(),
        n => format!("{} ({} of {} cases)", s.method, s.cases - n, s.cases),
    }
}

/// Where a name of `letters` beside a dot begins, and the end of a line that leads to it where it
/// is not close by; none where there is no room, pointing at the dot still tells.
fn room(
    panel: &Panel,
    [x, y]: [f64; 2],
    letters: usize,
    taken: &mut Vec<[f64; 4]>,
) -> Option<([f64; 2], Option<[f64; 2]>)> {
    let (width, [left, right, top, bottom]) = (6.4 * letters as f64, panel.frame());
    let beside =
        [[7.0, 4.0], [-7.0 - width, 4.0], [-width / 2.0, -8.0], [-width / 2.0, 16.0], [7.0, -7.0], [7.0, 15.0]];
    let away = [15.0, 27.0, 40.0].into_iter().flat_map(|far| {
        let [up, down] = [4.0 - far, 4.0 + far];
        [[far, up], [far, down], [-far - width, up], [-far - width, down]]
    });
    let mut places = beside.into_iter().map(|p| (p, false)).chain(away.map(|p| (p, true)));
    let (found, far) = places.find_map(|([a, b], far)| {
        let (a, b) = (x + a, y + b);
        let own = [a - 2.0, a + width + 2.0, b - 9.0, b + 2.0];
        let free = |t: &[f64; 4]| own[1] < t[0] || own[0] > t[1] || own[3] < t[2] || own[2] > t[3];
        let inside = a >= left && a + width <= right && own[2] >= top && b <= bottom;
        (inside && taken.iter().all(free)).then_some(([a, b], far))
    })?;
    taken.push([found[0], found[0] + width, found[1] - 9.0, found[1] + 2.0]);
    let end = if found[0] > x { found[0] - 2.0 } else { found[0] + width + 2.0 };
    Some((found, far.then_some([end, found[1] - 4.0])))
}

fn hover(s: &Standing, unit: &str) -> String {
    let failed = if s.failures > 0 { format!(", {} without a result", s.failures) } else { String::new() };
    let plural = if s.cases == 1 { "" } else { "s" };
    let front = if s.on_front { "; on the front" } else { "" };
    format!(
        "{}: {}\nerror {} {unit}, {} s of CPU time over {} case{plural}{failed}{front}",
        s.method,
        s.settings,
        significant(s.error),
        significant(s.cpu_s),
        s.cases
    )
}

/// CPU time against voxels, a line a preset; none where sizes were not varied.
fn against_size(trials: &[Trial]) -> Option<(Panel, String)> {
    let lines = lines(trials.iter().filter(|t| t.varied == "size"), |t| &t.method);
    let all = || lines.iter().flat_map(|l| &l.1);
    all().next()?;
    let panel = Panel {
        title: "Cost against size".into(),
        note: "one head, finer and finer voxels".into(),
        across: Axis::around("voxels", true, all().map(|t| t.size as f64)),
        up: Axis::around("CPU time, s", true, all().map(|t| t.cpu_s)),
        size: SIZE,
    };
    let told = |name: &str, t: &Trial| {
        let left = t.nothing.map_or(f64::NAN, |n| 100.0 * t.error / n);
        format!("{name}, {} voxels: {} s, {} % left", t.size, significant(t.cpu_s), significant(left))
    };
    let out = drawn(&panel, &lines, |t| [t.size as f64, t.cpu_s], told);
    Some((panel, out))
}

/// Error of the moduli against the nodes that the mesh has, a line a body; none where nodes were
/// not varied.
fn against_nodes(trials: &[Trial]) -> Option<(Panel, String)> {
    let lines = lines(trials.iter().filter(|t| t.varied == "nodes"), |t| &t.case);
    let all = || lines.iter().flat_map(|l| &l.1);
    all().next()?;
    let panel = Panel {
        title: "Stiffness: error against nodes".into(),
        note: "nodes of the mesh, which may be more than were asked for".into(),
        across: Axis::around("nodes", true, all().map(|t| t.size as f64)),
        up: Axis::around("error, % of the moduli", true, all().map(|t| t.error.max(MIN_DRAWN_ERROR))),
        size: SIZE,
    };
    let told = |name: &str, t: &Trial| {
        let [error, seconds] = [t.error, t.cpu_s].map(significant);
        format!("{name}, {}: {} nodes, error {error} %, {seconds} s of CPU time", t.method, t.size)
    };
    let out = drawn(&panel, &lines, |t| [t.size as f64, t.error.max(MIN_DRAWN_ERROR)], told);
    Some((panel, out))
}

/// Trials with a result by what they have in common, in the order in which they come.
fn lines<'a>(
    trials: impl Iterator<Item = &'a Trial>,
    name: impl Fn(&'a Trial) -> &'a String,
) -> Vec<(&'a str, Vec<&'a Trial>)> {
    let mut out: Vec<(&str, Vec<&Trial>)> = Vec::new();
    for t in trials.filter(|t| t.error.is_finite()) {
        match out.iter_mut().find(|l| l.0 == name(t)) {
            Some(line) => line.1.push(t),
            None => out.push((name(t), vec![t])),
        }
    }
    out
}

/// Lines with their dots and a legend, at the top where it is freer.
fn drawn(
    panel: &Panel,
    lines: &[(&str, Vec<&Trial>)],
    place: impl Fn(&Trial) -> [f64; 2],
    told: impl Fn(&str, &Trial) -> String,
) -> String {
    let mut out = String::new();
    let [left, right, top, _] = panel.frame();
    let at = |t: &Trial| panel.at(place(t));
    // Lines that fall leave the right free.
    let falls = lines.iter().any(|l| l.1.first().zip(l.1.last()).is_some_and(|(a, b)| at(a)[1] < at(b)[1]));
    let from = if falls { right - 110.0 } else { left + 10.0 };
    for (k, (name, line)) in lines.iter().enumerate() {
        let (k, down) = (k % 6, 15.0 * k as f64);
        let _ = write!(out, r#"<path class="l k{k}" d="{}"/>"#, path(line.iter().map(|t| at(t))));
        for t in line {
            let ([x, y], title) = (at(t), escape(&told(name, t)));
            let _ = write!(
                out,
                r#"<circle class="d k{k}" cx="{x:.1}" cy="{y:.1}" r="3.6"><title>{title}</title></circle>"#
            );
        }
        let _ = write!(
            out,
            r#"<path class="l k{k}" d="M{from:.0} {:.0}h18"/><text x="{:.0}" y="{:.0}">{}</text>"#,
            top + 12.0 + down,
            from + 23.0,
            top + 16.0 + down,
            escape(name)
        );
    }
    out
}

/// Three digits, or a dash where there is none.
fn number(v: f64) -> String {
    if v.is_finite() { significant(v) } else { "-".into() }
}

/// The page.
pub fn page(groups: &[Group], trials: &[Trial]) -> String {
    let row = |s: &Standing| {
        let failures = if s.failures > 0 { s.failures.to_string() } else { String::new() };
        let front = if s.on_front { "front" } else { "" };
        let [error, seconds] = [s.error, s.cpu_s].map(number);
        [s.method.clone(), s.settings.clone(), error, seconds, s.cases.to_string(), failures, front.into()]
    };
    let failed = |t: &Trial| t.failure.as_ref().map(|f| [t.method.clone(), t.case.clone(), f.clone()]);
    let failures: Vec<_> = trials.iter().filter_map(failed).collect();
    let verdict = "The line joins the settings that no other beats in both. Point at a place to see its settings. Hollow \
                   places are whole commands, with their start and their files; all others are the work alone. A method that \
                   has no result on some case is not on the line: there it counts as no registration, and its time is that of \
                   the others.";
    let body = html! {
        (header("Speed against accuracy", verdict, ""))
        article.wide { (PreEscaped(svg(groups, trials))) }
        @for group in groups {
            @let error = format!("Error, {}", group.unit);
            section {
                h2 { (group.title) }
                div.two {
                    (table(
                        &["Method", "Settings", &error, "CPU, s", "Cases", "No result", ""],
                        group.standings.iter().map(row)
                    ))
                }
            }
        }
        @if !failures.is_empty() {
            section {
                h2 { "Without a result" }
                div.two.words { (table(&["Method", "Case", "Why"], failures)) }
            }
        }
    };
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
        let mut front: Vec<&Standing> = group.standings.iter().filter(|s| s.on_front).collect();
        front.sort_by(|a, b| a.cpu_s.total_cmp(&b.cpu_s));
        let what = if front.is_empty() { "none has a result on every case" } else { "what no other setting beats" };
        let _ = writeln!(out, "{}: {what}", group.title);
        let width = front.iter().map(|s| s.method.chars().count()).max().unwrap_or(0).max(28);
        for s in front {
            let [seconds, error] = [s.cpu_s, s.error].map(significant);
            let _ = writeln!(out, "  {:width$} {seconds:>9} s  {error:>9} {}", s.method, group.unit);
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
    fn a_method_without_a_result_is_told_and_not_drawn() {
        let mut failed = standing("fails", f64::NAN, f64::NAN, false);
        failed.failures = 2;
        let mut once = standing("once", 30.0, 1.5, false);
        once.failures = 1;
        let standings = vec![standing("a", 10.0, 1.0, true), failed, once];
        let group = Group { part: Part::Field, title: "Field".into(), unit: "% left", standings };
        let svg = svg(std::slice::from_ref(&group), &[]);
        assert_eq!(svg.matches("<circle").count(), 2);
        assert!(svg.contains("2 settings, 2 cases; 1 without any result") && svg.contains("once (1 of 2 cases)"));
        let page = page(std::slice::from_ref(&group), &[]);
        assert!(page.contains("<td>-</td><td>-</td><td>2</td><td>2</td>") && !page.contains("NaN"));
        assert!(summary(&[group], 1.0)["groups"][0]["standings"][1]["error"].is_null());
    }
}
