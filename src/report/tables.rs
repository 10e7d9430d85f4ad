//! Tables of the page.

use crate::report::field::FieldReport;
use crate::report::scale::{short, thousands};
use crate::types::{BodyReport, Grid, Metrics, MotionModel, StageReport};
use maud::{Markup, Render, html};

/// A table from a head (may be empty) and rows; the first column is text, the others are numbers.
pub(super) fn table<R: IntoIterator<Item: Render>>(head: &[&str], rows: impl IntoIterator<Item = R>) -> Markup {
    html! {
        div.scroll {
            table {
                @if !head.is_empty() {
                    thead { tr { @for name in head { th { (name) } } } }
                }
                tbody {
                    @for row in rows { tr { @for cell in row { td { (cell) } } } }
                }
            }
        }
    }
}

/// A table of names with their values.
pub(super) fn facts<'a>(rows: impl IntoIterator<Item = (&'a str, String)>) -> Markup {
    table(&[], rows.into_iter().map(|(name, value)| [name.to_string(), value]))
}

fn triple(v: [f64; 3]) -> String {
    v.map(short).join(" × ")
}

/// What was counted.
pub(super) fn counts(report: &FieldReport<'_>) -> Markup {
    let (s, c) = (report.summary, report.summary.counts);
    let model = match s.model {
        MotionModel::Identity => "none",
        MotionModel::Rigid => "rigid",
        MotionModel::Affine => "affine",
        MotionModel::Free => "free",
    };
    let agreement = [s.agreement.at_rest, s.agreement.found].map(|part| format!("{:.1} %", 100.0 * part));
    let [at_rest, found] = agreement;
    let rows = [
        ("Features in the initial volume", thousands(c.features_initial)),
        ("Features in the deformed volume", thousands(c.features_deformed)),
        ("Candidate matches", thousands(c.candidates)),
        ("Matches kept", thousands(c.kept)),
        ("Mesh nodes", thousands(c.nodes)),
        ("Mesh elements", thousands(c.tetrahedra)),
        ("Voxels measured", thousands(s.mask_voxels)),
        ("Voxels folded", thousands(s.folds)),
        ("Motion model", model.into()),
        (if s.start.is_some() { "Variance explained at the start" } else { "Variance explained at rest" }, at_rest),
        ("Variance explained under the field", found),
    ];
    facts(rows)
}

/// The bodies of the scene.
pub(super) fn bodies(report: &FieldReport<'_>) -> Markup {
    let row = |b: &BodyReport| {
        let share = 100.0 * b.voxels as f64 / report.summary.mask_voxels.max(1) as f64;
        let model = b.model.name();
        [
            b.label.to_string(),
            thousands(b.voxels),
            format!("{share:.1}"),
            model.into(),
            format!("{:.2}", b.slides_mm),
            format!("{:.3}", b.expected_error_mm),
        ]
    };
    let head = ["Label", "Voxels", "of the tissue, %", "Motion model", "Slides by, mm", "Expected error, mm"];
    table(&head, report.summary.bodies.iter().map(row))
}

/// Landmarks drawn at most, the furthest first, and the length of its bar (em).
const MAX_LANDMARKS_SHOWN: usize = 20;
const BAR: f64 = 10.0;

/// How far the deformed place of each landmark is from where the field leads, as bars; red where
/// the field contradicts it.
pub(super) fn landmarks(report: &FieldReport<'_>) -> Option<Markup> {
    let l = report.summary.landmarks.as_ref()?;
    let mut order: Vec<usize> = (0..l.distances_mm.len()).collect();
    order.sort_by(|&a, &b| l.distances_mm[b].total_cmp(&l.distances_mm[a]));
    let most = order.first().map_or(0.0, |&i| l.distances_mm[i]).max(f64::MIN_POSITIVE);
    let row = |&i: &usize| {
        let (mm, colour) = (l.distances_mm[i], if l.wrong.contains(&(i + 1)) { "#d1495b" } else { "#2e86ab" });
        let width = BAR * mm / most;
        let style = format!("width:{width:.2}em;min-width:2px;height:.7em;background:{colour}");
        [html! { "number " (i + 1) }, html! { (format_args!("{mm:.2} mm")) }, html! { div style=(style) {} }]
    };
    Some(html! {
        p {
            "Distance of " (l.count) " landmarks from where the field leads: " (format_args!("{:.2}", l.mean_mm))
            " mm on average, for a deviation of " (short(l.sd_mm)) " mm along each axis."
        }
        (table(&[], order.iter().take(MAX_LANDMARKS_SHOWN).map(row)))
    })
}

/// The field after each stage.
pub(super) fn stages(report: &FieldReport<'_>) -> Markup {
    let row = |s: &StageReport| {
        let mut row = vec![
            s.name.clone(),
            triple(s.spacing_mm),
            format!("{:.3}", s.moved_mm),
            format!("{:.1}", 100.0 * s.unexplained),
        ];
        row.extend(s.error_mm.map(|error| format!("{error:.3}")));
        row
    };
    let mut head = vec!["Field after", "Voxel, mm", "Changed by, mm", "Variance unexplained, %"];
    if report.summary.stages.iter().any(|s| s.error_mm.is_some()) {
        head.push("Mean error, mm");
    }
    table(&head, report.summary.stages.iter().map(row))
}

/// The levels, coarse to fine.
pub(super) fn levels(report: &FieldReport<'_>) -> Markup {
    let rows = report.summary.levels.iter().map(|l| {
        [
            triple(l.spacing_mm),
            thousands(l.counts.features_initial),
            thousands(l.counts.candidates),
            thousands(l.counts.kept),
            format!("{:.4}", l.energy_before),
            format!("{:.4}", l.energy_after),
            format!("{:.3}", l.residual_mm),
        ]
    });
    table(&["Voxel, mm", "Features", "Candidates", "Kept", "Energy before", "after", "Residual, mm"], rows)
}

/// The two volumes and what was asked for.
pub(super) fn inputs(report: &FieldReport<'_>) -> Markup {
    let [initial, deformed, mask] = report.names;
    let volume = |name: &str, g: &Grid| {
        let shape = g.shape().map(|n| n.to_string()).join(" × ");
        html! { (name) br; (shape) " voxels of " (triple(g.spacing())) " mm" }
    };
    let text = |text: String| html! { (text) };
    let automatic = |v: f64, unit: &str| text(if v == 0.0 { "automatic".into() } else { short(v) + unit });
    let p = report.params;
    let rows = [
        ("Initial volume", volume(initial, report.initial.grid())),
        ("Deformed volume", volume(deformed, report.deformed_grid)),
        ("Mask", text(if report.mask.is_some() { mask } else { "none given" }.into())),
        ("Preset", text(format!("{:?}", p.preset).to_lowercase())),
        ("Points", automatic(p.points as f64, "")),
        ("Search", automatic(p.search_mm, " mm")),
        ("Seed", text(p.seed.to_string())),
    ];
    table(&[], rows.map(|(name, value)| [text(name.into()), value]))
}

/// The score against exact truth.
pub(super) fn metrics(m: &Metrics) -> Markup {
    let mm = |v: f64| format!("{v:.3} mm");
    let mut rows = vec![
        ("Mean error", mm(m.mean_mm)),
        ("Mean error before registration", mm(m.identity_mm)),
        ("Median error", mm(m.median_mm)),
        ("95th percentile", mm(m.p95_mm)),
        ("Largest error", mm(m.max_mm)),
        ("Median error of the gradient", format!("{:.4}", m.grad_err)),
    ];
    rows.extend(m.still_mm.map(|v| ("Mean error where nothing moves", mm(v))));
    rows.extend(m.landmarks_mm.map(|v| ("Mean error at the landmarks", mm(v))));
    facts(rows)
}
