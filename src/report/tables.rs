//! Tables of the page.

use crate::report::field::FieldReport;
use crate::report::html::escape;
use crate::report::scale::{short, thousands};
use crate::types::{BodyReport, Metrics, MotionModel, StageReport};
use std::fmt::Write;

/// A table from a head (may be empty) and rows; the first column is text, the others are numbers.
pub(super) fn table(head: &[&str], rows: &[Vec<String>]) -> String {
    let mut out = String::from("<div class=\"scroll\"><table>");
    if !head.is_empty() {
        let cells: String = head.iter().map(|h| format!("<th>{h}</th>")).collect();
        let _ = write!(out, "<thead><tr>{cells}</tr></thead>");
    }
    out.push_str("<tbody>");
    for row in rows {
        let cells: String = row.iter().map(|c| format!("<td>{c}</td>")).collect();
        let _ = write!(out, "<tr>{cells}</tr>");
    }
    out.push_str("</tbody></table></div>");
    out
}

fn triple(v: [f64; 3]) -> String {
    v.map(short).join(" × ")
}

/// What was counted.
pub fn counts(report: &FieldReport<'_>) -> String {
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
    table(&[], &rows.map(|(name, value)| vec![name.into(), value]))
}

/// The bodies of the scene.
pub fn bodies(report: &FieldReport<'_>) -> String {
    let row = |b: &BodyReport| {
        let share = 100.0 * b.voxels as f64 / report.summary.mask_voxels.max(1) as f64;
        let model = b.model.name();
        vec![
            b.label.to_string(),
            thousands(b.voxels),
            format!("{share:.1}"),
            model.into(),
            format!("{:.2}", b.slides_mm),
            format!("{:.3}", b.expected_error_mm),
        ]
    };
    let rows: Vec<_> = report.summary.bodies.iter().map(row).collect();
    table(&["Label", "Voxels", "of the tissue, %", "Motion model", "Slides by, mm", "Expected error, mm"], &rows)
}

/// Landmarks drawn at most, the furthest first, and the length of its bar (em).
const LANDMARKS: usize = 20;
const BAR: f64 = 10.0;

/// How far the deformed place of each landmark is from where the field leads, as bars; red where
/// the field contradicts it.
pub fn landmarks(report: &FieldReport<'_>) -> Option<String> {
    let l = report.summary.landmarks.as_ref()?;
    let mut order: Vec<usize> = (0..l.distances_mm.len()).collect();
    order.sort_by(|&a, &b| l.distances_mm[b].total_cmp(&l.distances_mm[a]));
    let most = order.first().map_or(0.0, |&i| l.distances_mm[i]).max(f64::MIN_POSITIVE);
    let row = |&i: &usize| {
        let (mm, colour) = (l.distances_mm[i], if l.wrong.contains(&(i + 1)) { "#d1495b" } else { "#2e86ab" });
        let width = BAR * mm / most;
        let bar = format!("<div style=\"width:{width:.2}em;min-width:2px;height:.7em;background:{colour}\"></div>");
        vec![format!("number {}", i + 1), format!("{mm:.2} mm"), bar]
    };
    let rows: Vec<_> = order.iter().take(LANDMARKS).map(row).collect();
    let note = format!(
        "Distance of {} landmarks from where the field leads: {:.2} mm on average, for a deviation of {} mm along each axis.",
        l.count,
        l.mean_mm,
        short(l.sd_mm)
    );
    Some(format!("<p>{note}</p>{}", table(&[], &rows)))
}

/// The field after each stage.
pub fn stages(report: &FieldReport<'_>) -> String {
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
    let rows: Vec<_> = report.summary.stages.iter().map(row).collect();
    let mut head = vec!["Field after", "Voxel, mm", "Changed by, mm", "Variance unexplained, %"];
    if report.summary.stages.iter().any(|s| s.error_mm.is_some()) {
        head.push("Mean error, mm");
    }
    table(&head, &rows)
}

/// The levels, coarse to fine.
pub fn levels(report: &FieldReport<'_>) -> String {
    let rows: Vec<_> = report
        .summary
        .levels
        .iter()
        .map(|l| {
            vec![
                triple(l.spacing_mm),
                thousands(l.counts.features_initial),
                thousands(l.counts.candidates),
                thousands(l.counts.kept),
                format!("{:.4}", l.energy_before),
                format!("{:.4}", l.energy_after),
                format!("{:.3}", l.residual_mm),
            ]
        })
        .collect();
    table(&["Voxel, mm", "Features", "Candidates", "Kept", "Energy before", "after", "Residual, mm"], &rows)
}

/// The two volumes and what was asked for.
pub fn inputs(report: &FieldReport<'_>) -> String {
    let [initial, deformed, mask] = report.names.map(escape);
    let grid = |g: &crate::types::Grid| {
        format!("{} voxels of {} mm", g.shape().map(|n| n.to_string()).join(" × "), triple(g.spacing()))
    };
    let automatic = |v: f64, unit: &str| if v == 0.0 { "automatic".into() } else { format!("{}{unit}", short(v)) };
    let p = report.params;
    let rows = [
        ("Initial volume", format!("{initial}<br>{}", grid(report.initial.grid()))),
        ("Deformed volume", format!("{deformed}<br>{}", grid(report.deformed_grid))),
        ("Mask", if report.mask.is_some() { mask } else { "none given".into() }),
        ("Preset", format!("{:?}", p.preset).to_lowercase()),
        ("Points", automatic(p.points as f64, "")),
        ("Search", automatic(p.search_mm, " mm")),
        ("Seed", p.seed.to_string()),
    ];
    table(&[], &rows.map(|(name, value)| vec![name.into(), value]))
}

/// The score against exact truth.
pub fn metrics(m: &Metrics) -> String {
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
    table(&[], &rows.into_iter().map(|(name, value)| vec![name.into(), value]).collect::<Vec<_>>())
}
