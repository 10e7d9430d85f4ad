//! Many pairs as tables and one page: what failed and why, moduli over all, and what to look at
//! twice.

use crate::report::html::{document, escape};
use crate::report::plot::ticks;
use crate::report::scale::short;
use crate::report::statistics::quantile;
use crate::report::tables::table;
use crate::types::batch::{PairOutcome, Status};
use maud::{Markup, PreEscaped, html};
use serde_json::{Value, json};
use std::fmt::Write;

/// Columns of batch.csv.
pub const COLUMNS: [&str; 21] = [
    "name",
    "subject",
    "session",
    "status",
    "stage",
    "reason",
    "seconds",
    "voxels",
    "kept",
    "model",
    "displacement_mean_mm",
    "displacement_max_mm",
    "uncertainty_median_mm",
    "folds",
    "verdict",
    "fingertip_kpa",
    "grasp_completed",
    "flags",
    "expected_error_mm",
    "expected_error_p95_mm",
    "trust",
];

/// Columns of regions.csv over all pairs.
pub(crate) const REGION_COLUMNS: [&str; 11] =
    ["name", "subject", "session", "label", "region", "youngs_modulus", "sd", "unit", "identifiable", "bound", "state"];

/// A value as text; nothing where there is none.
fn text(v: &Value) -> String {
    match v {
        Value::Null => String::new(),
        Value::String(s) => s.clone(),
        other => other.to_string(),
    }
}

fn list(v: &Value) -> &[Value] {
    v.as_array().map_or(&[], Vec::as_slice)
}

/// What to look at twice in a pair's results.
pub fn flags(o: &PairOutcome) -> Vec<String> {
    let mut out = Vec::new();
    let folds = o.field["folds"].as_u64().unwrap_or(0);
    if folds > 0 {
        out.push(format!("{folds} voxels folded"));
    }
    for (stage, summary) in [("field", &o.field), ("stiffness", &o.stiffness)] {
        out.extend(list(&summary["warnings"]).iter().map(|w| format!("{stage}: {}", text(w))));
    }
    let unseen = list(&o.stiffness["regions"]).iter().filter(|r| r["identifiable"] == false);
    let known = |r: &Value| if r["bound"] == "unknown" { "not seen" } else { "only a bound" };
    out.extend(unseen.map(|r| format!("{} is {}", text(&r["name"]), known(r))));
    if o.grasp["completed"] == false {
        out.push("the grasp ended early".into());
    }
    if list(&o.grasp["events"]).iter().any(|e| e["kind"] == "slip") {
        out.push("the grasp slips".into());
    }
    out
}

/// The line of batch.csv.
pub fn row(o: &PairOutcome) -> Vec<String> {
    let f = &o.field;
    let keys = ["model", "displacement_mean_mm", "displacement_max_mm", "uncertainty_median_mm", "folds"];
    let mut out = vec![
        o.name.clone(),
        o.subject.clone(),
        o.session.clone(),
        o.status.name().into(),
        o.stage.into(),
        o.reason.clone(),
        format!("{:.2}", o.seconds),
        text(&f["mask_voxels"]),
        text(&f["counts"]["kept"]),
    ];
    out.extend(keys.map(|k| text(&f[k])));
    out.push(text(&o.stiffness["verdict"]));
    out.push(o.fingertip_kpa.map_or_else(String::new, |e| e.to_string()));
    out.extend([text(&o.grasp["completed"]), flags(o).join("; ")]);
    out.extend(["expected_error_mm", "expected_error_p95_mm", "trust"].map(|k| text(&f[k])));
    out
}

/// Its lines of regions.csv.
pub(crate) fn region_rows(o: &PairOutcome) -> Vec<Vec<String>> {
    let one = |r: &Value| {
        let mut row = vec![o.name.clone(), o.subject.clone(), o.session.clone()];
        row.extend(["label", "name", "youngs_modulus", "sd"].map(|k| text(&r[k])));
        row.push(if o.stiffness["absolute"] == true { "kPa".into() } else { "ratio".into() });
        row.extend([u8::from(r["identifiable"] == true).to_string(), text(&r["bound"]), text(&r["state"])]);
        row
    };
    list(&o.stiffness["regions"]).iter().map(one).collect()
}

/// How many ended how.
fn count(outcomes: &[PairOutcome], status: Status) -> usize {
    outcomes.iter().filter(|o| o.status == status).count()
}

/// In a sentence.
pub fn verdict(outcomes: &[PairOutcome]) -> String {
    let [done, skipped, failed] = [Status::Done, Status::Skipped, Status::Failed].map(|s| count(outcomes, s));
    let of = outcomes.len();
    let earlier = if skipped > 0 { format!(", {skipped} were there already") } else { String::new() };
    match failed {
        0 => format!("All of {of} pairs have results: {done} measured{earlier}."),
        n => format!("{n} of {of} pairs failed; {done} measured{earlier}."),
    }
}

/// A region over all pairs that see it.
struct Spread {
    region: String,
    unit: &'static str,
    /// Modulus and whether it is determined.
    values: Vec<(f64, bool)>,
}

fn spreads(outcomes: &[PairOutcome]) -> Vec<Spread> {
    let mut out: Vec<Spread> = Vec::new();
    for o in outcomes {
        let unit = if o.stiffness["absolute"] == true { "kPa" } else { "ratio" };
        for r in list(&o.stiffness["regions"]) {
            let Some(value) = r["youngs_modulus"].as_f64().filter(|v| *v > 0.0) else { continue };
            let (region, value) = (text(&r["name"]), (value, r["identifiable"] == true));
            match out.iter_mut().find(|s| s.region == region && s.unit == unit) {
                Some(spread) => spread.values.push(value),
                None => out.push(Spread { region, unit, values: vec![value] }),
            }
        }
    }
    out
}

impl Spread {
    /// Quantile of the determined values.
    fn at(&self, q: f64) -> f64 {
        quantile(self.values.iter().filter(|v| v.1).map(|v| v.0), q)
    }

    fn seen(&self) -> usize {
        self.values.iter().filter(|v| v.1).count()
    }
}

/// Number of pairs, and counts, medians and quartiles of each region; the keys are those of
/// docs/reference/file-formats.md.
pub fn summary(outcomes: &[PairOutcome]) -> Value {
    let quartile = |s: &Spread, q: f64| (s.seen() > 0).then(|| s.at(q)).filter(|v| v.is_finite());
    let spread = |s: &Spread| {
        json!({
            "region": s.region, "unit": s.unit, "pairs": s.values.len(), "identifiable": s.seen(),
            "quartile_1": quartile(s, 0.25), "median": quartile(s, 0.5), "quartile_3": quartile(s, 0.75),
        })
    };
    json!({
        "version": env!("CARGO_PKG_VERSION"),
        "command": "batch",
        "verdict": verdict(outcomes),
        "pairs": outcomes.len(),
        "done": count(outcomes, Status::Done),
        "skipped": count(outcomes, Status::Skipped),
        "failed": count(outcomes, Status::Failed),
        "regions": spreads(outcomes).iter().map(spread).collect::<Vec<_>>(),
        "seconds": outcomes.iter().map(|o| o.seconds).sum::<f64>(),
    })
}

/// A row a region: a dot a pair over a logarithmic axis, full where determined, hollow for a bound;
/// a bar at the median.
fn strips(spreads: &[&Spread]) -> String {
    let logs = || spreads.iter().flat_map(|s| &s.values).map(|v| v.0.log10());
    let (low, high) = (logs().fold(f64::INFINITY, f64::min) - 0.1, logs().fold(f64::NEG_INFINITY, f64::max) + 0.1);
    let (width, left, step) = (760.0, 130.0, 34.0);
    let x = |log: f64| left + (log - low) / (high - low) * (width - left - 20.0);
    let height = step * spreads.len() as f64 + 40.0;
    let mut svg = format!(
        r#"<svg class="chart" viewBox="0 0 {width} {height:.0}" role="img" aria-label="Young's modulus of each region over all pairs">"#
    );
    for tick in ticks(low, high, 6.0) {
        let at = x(tick);
        let _ = write!(
            svg,
            r#"<path class="rule" d="M{at:.1} 4V{:.0}"/><text x="{at:.1}" y="{:.0}" text-anchor="middle">{}</text>"#,
            height - 30.0,
            height - 12.0,
            short((10f64.powf(tick) * 100.0).round() / 100.0)
        );
    }
    for (row, s) in spreads.iter().enumerate() {
        let y = step * row as f64 + 20.0;
        let _ = write!(svg, r#"<text x="0" y="{:.1}">{}</text>"#, y + 4.0, escape(&s.region));
        for (i, &(value, determined)) in s.values.iter().enumerate() {
            // Spread over a few heights so that equal values stay visible.
            let dy = (i % 5) as f64 * 4.0 - 8.0;
            let fill = if determined { "#3b6fb6" } else { "none" };
            let _ = write!(
                svg,
                r##"<circle cx="{:.1}" cy="{:.1}" r="3.5" fill="{fill}" fill-opacity=".55" stroke="#3b6fb6"/>"##,
                x(value.log10()),
                y + dy
            );
        }
        let middle = s.at(0.5);
        if middle.is_finite() {
            let at = x(middle.log10());
            let _ = write!(svg, r##"<path stroke="#c7672b" stroke-width="2.5" d="M{at:.1} {:.1}v26"/>"##, y - 13.0);
        }
    }
    svg + "</svg>"
}

/// The regions of one unit, where there are any: their places and quartiles.
fn moduli(unit: &str, spreads: &[Spread]) -> Markup {
    let these: Vec<&Spread> = spreads.iter().filter(|s| s.unit == unit).collect();
    if these.is_empty() {
        return Markup::default();
    }
    let digits = |v: f64| if v.is_finite() { format!("{v:.3}") } else { "none".into() };
    let rows = these.iter().map(|s| {
        let [first, median, third] = [0.25, 0.5, 0.75].map(|q| digits(s.at(q)));
        [s.region.clone(), s.values.len().to_string(), s.seen().to_string(), first, median, third]
    });
    let head = ["Region", "Pairs", "Determined", "First quartile", "Median", "Third quartile"];
    html! {
        section {
            h2 { "Young's modulus, " (unit) }
            article.wide {
                (PreEscaped(strips(&these)))
                p { "A dot a pair; hollow where the data give only a bound. The bar is the median of those determined." }
                (table(&head, rows))
            }
        }
    }
}

/// What a pair's field says, and a link to its page.
fn pair(o: &PairOutcome) -> Vec<Markup> {
    let mm = |key: &str| o.field[key].as_f64().map_or_else(String::new, |v| format!("{v:.3}"));
    let mut cells = vec![html! { a href={ (o.folder) "/field/report.html" } { (o.name) } }];
    cells.extend(["displacement_mean_mm", "displacement_max_mm", "expected_error_mm"].map(|key| html! { (mm(key)) }));
    cells.extend([&o.field["trust"], &o.field["counts"]["kept"]].map(|v| html! { (text(v)) }));
    cells.push(html! {
        @for (i, flag) in flags(o).iter().enumerate() {
            @if i > 0 { br; }
            (flag)
        }
    });
    cells
}

/// The group report.
pub fn page(outcomes: &[PairOutcome]) -> String {
    let failed: Vec<[&str; 3]> =
        outcomes.iter().filter(|o| o.status == Status::Failed).map(|o| [o.name.as_str(), o.stage, &o.reason]).collect();
    let spreads = spreads(outcomes);
    let pairs = outcomes.iter().filter(|o| !o.field.is_null()).map(pair);
    let head = ["Pair", "Mean, mm", "Largest, mm", "Expected error, mm", "Trust", "Matches kept", "To look at"];
    let body = html! {
        header { h1 { "Cohort" } p.lead { (verdict(outcomes)) } }
        @if !failed.is_empty() {
            section {
                h2 { "What failed" }
                article.wide.words { (table(&["Pair", "Stage", "Reason"], failed)) }
            }
        }
        (moduli("kPa", &spreads))
        (moduli("ratio", &spreads))
        section { h2 { "Pairs" } article.wide.words { (table(&head, pairs)) } }
    };
    document("Cohort", &body)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn outcome(name: &str, modulus: f64) -> PairOutcome {
        let region =
            json!({ "label": 1, "name": "pulp <b>", "youngs_modulus": modulus, "sd": 1.0, "identifiable": true });
        PairOutcome {
            name: name.into(),
            folder: name.into(),
            subject: String::new(),
            session: String::new(),
            status: Status::Done,
            stage: "",
            reason: String::new(),
            seconds: 1.0,
            field: json!({ "folds": 2, "warnings": ["noisy"], "counts": { "kept": 7 }, "trust": "low" }),
            stiffness: json!({ "absolute": true, "regions": [region], "warnings": [] }),
            fingertip_kpa: None,
            grasp: Value::Null,
        }
    }

    #[test]
    fn quartiles_are_over_all_pairs_and_names_are_escaped() {
        let all: Vec<PairOutcome> = (1..=5).map(|i| outcome(&format!("p{i}"), f64::from(10 * i))).collect();
        let found = summary(&all);
        assert_eq!(found["regions"][0]["median"], 30.0);
        assert_eq!(found["regions"][0]["identifiable"], 5);
        let page = page(&all);
        assert_eq!(page.matches("<circle").count(), 5);
        assert!(page.contains("pulp &lt;b&gt;") && !page.contains("NaN") && page.contains("2 voxels folded"));
    }

    #[test]
    fn every_row_is_as_long_as_its_header() {
        let one = outcome("p", 3.0);
        assert_eq!(row(&one).len(), COLUMNS.len());
        assert!(region_rows(&one).iter().all(|r| r.len() == REGION_COLUMNS.len()));
        assert_eq!(row(&one)[17], "2 voxels folded; field: noisy");
        assert_eq!(row(&one)[20], "low");
    }
}
