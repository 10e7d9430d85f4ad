//! report.html, summary.json and the sentences of `palpate plan`.

use crate::report::html::{document, header, tiles, titled, warned};
use crate::report::json::seconds;
use crate::report::plot::{Line, Plot};
use crate::report::scale::{percent, short, significant};
use crate::report::tables::{facts, table};
use crate::types::plan::{Expected, LARGE_STRAIN, Plan, PlanParams, PlannedRegion};
use maud::{Markup, html};
use serde_json::{Value, json};
use std::fmt::Write;

/// A plan with what it was made of.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PlanReport<'a> {
    /// The label map, as it is called.
    pub labels: &'a str,
    /// What was asked for.
    pub params: &'a PlanParams,
    /// What is to be expected.
    pub plan: &'a Plan,
}

/// Standard deviations past this (1) are drawn at the plot's upper end: nothing is known there.
const MAX_DRAWN_SD: f64 = 1.0;
/// Of a deviation the part that noise makes, under which less noise hardly helps (1).
const BY_NOISE: f64 = 0.5;

/// `region 2`, `skin and fat`, `skin, fat and bone`.
fn listed<'a>(regions: impl Iterator<Item = &'a PlannedRegion>) -> String {
    let names: Vec<&str> = regions.map(|r| r.name.as_str()).collect();
    match names.split_last() {
        Some((last, [])) => (*last).into(),
        Some((last, rest)) => format!("{} and {last}", rest.join(", ")),
        None => String::new(),
    }
}

/// A length (mm) as it was given.
fn length(mm: f64) -> String {
    if mm < 0.01 { significant(mm) } else { short(mm) }
}

/// The wanted deviation (%).
fn want(plan: &Plan) -> String {
    short(100.0 * plan.want)
}

/// A choice in words.
fn choice([press, voxel, noise]: [f64; 3]) -> String {
    let [press, voxel, noise] = [press, voxel, noise].map(length);
    format!("press {press} mm at voxels of {voxel} mm and {noise} mm of noise")
}

/// What one region takes, where no choice gives all regions as wanted.
fn own(plan: &Plan, region: &PlannedRegion) -> String {
    let want = want(plan);
    if let Some(found) = plan.choice(&[region.label]) {
        return format!("To know {} to {want} % {}.", region.name, choice(found));
    }
    let Some(best) = plan.best(region.label) else { return String::new() };
    let hint = match best.scatter < BY_NOISE * best.sd {
        true => {
            "What limits it is how well its border and faces are known: use smaller voxels or a smaller --label-sd; less noise helps little."
        }
        false => "Press more, lower the noise, or load it from another side.",
    };
    let at = choice([best.press_mm, best.voxel_mm, best.noise_mm]);
    format!("No choice gives {} to {want} %: the best is {} %, where you {at}. {hint}", region.name, percent(best.sd))
}

/// The result in sentences.
pub fn sentences(plan: &Plan) -> Vec<String> {
    let labels: Vec<u8> = plan.determined().map(|r| r.label).collect();
    let mut out = match plan.choice(&labels) {
        Some(found) => vec![format!("To know {} to {} % {}.", listed(plan.determined()), want(plan), choice(found))],
        None => plan.determined().map(|r| own(plan, r)).collect(),
    };
    let lost = plan.undetermined().count();
    if !plan.is_felt() {
        let least = length(plan.least_press_mm);
        out.push(format!("No press here stands out of the noise: press more than {least} mm, or lower the noise."));
    } else if lost > 0 {
        let (verb, it) = if lost == 1 { ("is", "it") } else { ("are", "them") };
        out.push(format!(
            "{} {verb} not determined by any of these: load {it} from another side.",
            capital(&listed(plan.undetermined()))
        ));
    }
    if !plan.regions.iter().any(|r| r.wanted) {
        out.push("There is one region, and no ratio to tell: a force gives its modulus.".into());
    }
    out
}

fn capital(text: &str) -> String {
    let mut letters = text.chars();
    letters.next().map_or_else(String::new, |first| first.to_uppercase().chain(letters).collect())
}

fn quantity(plan: &Plan) -> &'static str {
    if plan.ratios { "ratio to the largest region" } else { "Young's modulus, with the force known" }
}

/// The keys are those of docs/reference/file-formats.md.
pub(crate) fn summary(report: &PlanReport<'_>) -> Value {
    let plan = report.plan;
    let region = |r: &PlannedRegion| {
        let best = plan.best(r.label);
        json!({
            "label": r.label,
            "name": r.name,
            "assumed_kpa": r.youngs_modulus,
            "volume_mm3": r.volume,
            "wanted": r.wanted,
            "determined": best.is_some(),
            "best_sd_percent": best.map(|e| 100.0 * e.sd),
            "choice": plan.choice(&[r.label]).map(named),
        })
    };
    let labels: Vec<u8> = plan.determined().map(|r| r.label).collect();
    json!({
        "version": env!("CARGO_PKG_VERSION"),
        "command": "plan",
        "headline": sentences(plan).join(" "),
        "inputs": { "labels": report.labels, "held": plan.sides[0], "load": plan.sides[1] },
        "params": report.params,
        "quantity": if plan.ratios { "ratio" } else { "modulus" },
        "want_percent": 100.0 * plan.want,
        "contact": plan.contact,
        "law": "linear",
        "extent_mm": plan.extent_mm,
        "label_voxel_mm": plan.label_voxel_mm,
        "presses": plan.presses,
        "voxel_mm": plan.voxel_mm,
        "choice": plan.choice(&labels).map(named),
        "regions": plan.regions.iter().map(region).collect::<Vec<_>>(),
        "warnings": plan.warnings,
        "seconds": seconds(&plan.seconds),
    })
}

fn named([press, voxel, noise]: [f64; 3]) -> Value {
    json!({ "press_mm": press, "voxel_mm": voxel, "noise_mm": noise })
}

/// The plate and its contact, in words.
fn plate(plan: &Plan) -> String {
    let [held, load] = &plan.sides;
    let contact = plan.contact.name();
    format!("held at {held}, bonded; a rigid plate, {contact}, moves {load} in; linear law")
}

fn numbers(values: impl Iterator<Item = f64>) -> String {
    values.map(length).collect::<Vec<_>>().join(", ")
}

/// Noises that were tried, at a voxel size or at any (mm).
fn noises(plan: &Plan, voxel: Option<f64>) -> Vec<f64> {
    let at = plan.expected.iter().filter(|e| voxel.is_none_or(|v| v == e.voxel_mm));
    let mut out: Vec<f64> = at.map(|e| e.noise_mm).collect();
    out.sort_by(f64::total_cmp);
    out.dedup();
    out
}

/// What was found, a few lines.
pub(crate) fn text(report: &PlanReport<'_>) -> String {
    let plan = report.plan;
    let mut out = format!("{}\n", sentences(plan).join("\n"));
    let _ = writeln!(out, "  model        {}", plate(plan));
    let presses = numbers(plan.presses.iter().map(|p| p.press_mm));
    let deepest = plan.presses.last().map_or(0.0, |p| p.strain);
    let extent = length(plan.extent_mm);
    let _ = writeln!(out, "  press        {presses} mm of {extent} mm, strains up to {} %", percent(deepest));
    let _ = writeln!(out, "  voxel        {} mm", numbers(plan.voxel_mm.iter().copied()));
    let _ = writeln!(
        out,
        "  noise        {} mm, white, in each voxel and component",
        numbers(noises(plan, None).into_iter())
    );
    for r in plan.regions.iter().filter(|r| r.wanted) {
        let said = match plan.best(r.label) {
            Some(e) => format!(
                "{} % at best (press {} mm, voxel {} mm, noise {} mm)",
                percent(e.sd),
                length(e.press_mm),
                length(e.voxel_mm),
                length(e.noise_mm)
            ),
            None => "not determined".into(),
        };
        let _ = writeln!(out, "  {:<12} assumed {} kPa: {said}", r.name, short(r.youngs_modulus));
    }
    let _ = writeln!(out, "  time         {:.1} s", plan.seconds.iter().map(|t| t.1).sum::<f64>());
    out
}

/// The expected deviation of a region against press, a line a noise, at one voxel size.
fn plot(plan: &Plan, region: &PlannedRegion, voxel: f64) -> Markup {
    let title = format!("{}: expected deviation, %", region.name);
    let mut lines: Vec<Line> = noises(plan, Some(voxel))
        .into_iter()
        .enumerate()
        .map(|(k, noise)| {
            let at = |e: &&Expected| e.voxel_mm == voxel && e.noise_mm == noise;
            // A bound has no deviation to show.
            let value = |e: &Expected| if e.felt && e.sd <= MAX_DRAWN_SD { 100.0 * e.sd } else { f64::NAN };
            let points = plan.of(region.label).filter(at).map(|e| [e.press_mm, value(e)]).collect();
            Line::new(&format!("noise {} mm", length(noise)), k % 3, k >= 3, points)
        })
        .collect();
    let ends = plan.presses.iter().map(|p| p.press_mm);
    let wanted: Vec<[f64; 2]> = ends.map(|press| [press, 100.0 * plan.want]).collect();
    lines.push(Line::new("wanted", 3, true, wanted));
    let large = plan.presses.iter().find(|p| p.strain > LARGE_STRAIN).map(|p| (p.press_mm, true));
    let marks: Vec<(f64, bool)> = large.into_iter().collect();
    Plot { title: &title, across: "press, mm", marks: &marks }.shown(&lines)
}

/// The page.
pub(crate) fn page(report: &PlanReport<'_>) -> String {
    let plan = report.plan;
    let labels: Vec<u8> = plan.determined().map(|r| r.label).collect();
    let all = plan.choice(&labels);
    let figure = |k: usize| all.map_or_else(|| "none".into(), |c| length(c[k]));
    let presses = plan.presses.iter().map(|p| [length(p.press_mm), percent(p.strain), significant(p.force_n)]);
    let wanted = |label: u8| plan.regions.iter().any(|r| r.wanted && r.label == label);
    let rows = plan.expected.iter().filter(|e| wanted(e.label)).map(|e| {
        let said = match (e.enough, e.determined, e.felt) {
            (true, ..) => "yes",
            (_, true, _) => "no",
            (.., true) => "not determined",
            _ => "lost in noise",
        };
        let [press, voxel, noise] = [e.press_mm, e.voxel_mm, e.noise_mm].map(length);
        let [sd, scatter] = [e.sd, e.scatter].map(|v| if v <= MAX_DRAWN_SD { percent(v) } else { "over 100".into() });
        [press, voxel, noise, e.name.clone(), sd, scatter, said.into()]
    });
    let head = ["Press, mm", "Voxel, mm", "Noise, mm", "Region", "Deviation, %", "By noise alone, %", "Enough"];
    let body = html! {
        (header(titled(report.labels, "plan"), &sentences(plan).join(" "), ""))
        (tiles([
            (want(plan), "%", "wanted deviation of each modulus"),
            (figure(0), "mm", "press"),
            (figure(1), "mm", "voxel"),
            (figure(2), "mm", "noise of a displacement"),
            (plan.undetermined().count().to_string(), "", "regions not determined"),
        ]))
        (warned(&plan.warnings))
        @for &voxel in &plan.voxel_mm {
            section {
                h2 { "Voxels of " (length(voxel)) " mm" }
                p.lead {
                    "One standard deviation of the " (quantity(plan)) ". A break in a line is a press that tells nothing; \
                     the upright line is where strain passes " (short(100.0 * LARGE_STRAIN)) " %."
                }
                div.grid {
                    @for r in plan.regions.iter().filter(|r| r.wanted) { article { (plot(plan, r, voxel)) } }
                }
            }
        }
        section {
            h2 { "All choices" }
            div.grid {
                article { h3 { "Presses" } (table(&["Press, mm", "Strain, %", "Force, N"], presses)) }
                article { h3 { "Settings" } (settings(report)) }
                article.wide { h3 { "Deviations" } (table(&head, rows)) }
            }
        }
        footer {
            p {
                "The deviation is what palpate stiffness would state: noise, the borders between labels, flat faces and plates \
                 that are known to a part of a voxel, and the mesh. Not in it: a wrong Poisson's ratio, wrong labels, and \
                 moduli far from the assumed ones. Noise is white; where it hangs together over c voxels along each axis, \
                 enter c^1.5 times as much."
            }
        }
    };
    document(&format!("Plan for {}", report.labels), &body)
}

/// What the plan was made of.
fn settings(report: &PlanReport<'_>) -> Markup {
    let plan = report.plan;
    let assumed: Vec<String> =
        plan.regions.iter().map(|r| format!("{} {} kPa", r.name, short(r.youngs_modulus))).collect();
    let stiffness = &report.params.stiffness;
    facts([
        ("Model", plate(plan)),
        ("Assumed", assumed.join(", ")),
        ("Poisson's ratio", short(stiffness.poisson)),
        ("Deviation of borders", format!("{} voxel", short(stiffness.label_sd))),
        ("Extent along the load", format!("{} mm", length(plan.extent_mm))),
        ("Wanted", format!("{} % of the {}", want(plan), quantity(plan))),
    ])
}
