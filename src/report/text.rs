//! The short summaries for a terminal.

use crate::report::field::FieldReport;
use crate::report::scale::thousands;
use crate::report::strain;
use crate::report::verdict::verdict;
use crate::types::{BodyReport, Distances, InverseConsistency, LabelScore, LabelScores, Metrics, Overlap, TargetError};
use std::fmt::Write;

/// What a field run found, a few lines.
pub(crate) fn field_summary(report: &FieldReport<'_>) -> String {
    let (s, v) = (report.summary, verdict(report));
    let c = s.counts;
    let mut out = format!("{}\n", v.headline);
    let _ = writeln!(
        out,
        "  matches      {} kept of {} candidates, from {} and {} features",
        thousands(c.kept),
        thousands(c.candidates),
        thousands(c.features_initial),
        thousands(c.features_deformed)
    );
    if let [first, .., last] | [first @ last] = s.levels.as_slice() {
        let _ = writeln!(
            out,
            "  energy       {:.4} -> {:.4} at the coarsest level, {:.4} -> {:.4} at the finest",
            first.energy_before, first.energy_after, last.energy_before, last.energy_after
        );
    }
    let _ = writeln!(
        out,
        "  motion       mean {:.2} mm, largest {:.2} mm over {} voxels",
        s.mean_mm,
        s.max_mm,
        thousands(s.mask_voxels)
    );
    if let [_, _, ..] = s.bodies.as_slice() {
        let of = |b: &BodyReport| {
            let share = 100.0 * b.voxels as f64 / s.mask_voxels.max(1) as f64;
            let model = b.model.name();
            format!("{} ({share:.0} %, {model}, slides by {:.1} mm)", b.label, b.slides_mm)
        };
        let bodies: Vec<String> = s.bodies.iter().map(of).collect();
        let _ = writeln!(out, "  bodies       {}", bodies.join(", "));
    }
    if let Some(l) = &s.landmarks {
        let wrong = match l.wrong.len() {
            0 => String::new(),
            1 => "; one disagrees".into(),
            n => format!("; {n} disagree"),
        };
        let most = l.distances_mm.iter().copied().fold(0.0, f64::max);
        let _ = writeln!(
            out,
            "  landmarks    {}, on average {:.2} mm from where the field takes them, at most {most:.2} mm{wrong}",
            l.count, l.mean_mm
        );
    }
    if let Some((_, m)) = report.truth {
        let _ = writeln!(out, "  true error   mean {:.3} mm, 95th percentile {:.3} mm", m.mean_mm, m.p95_mm);
    }
    if let Some(strain) = &report.strain {
        let _ = writeln!(out, "  strain       {}", strain::headline(strain));
    }
    let _ = writeln!(out, "  mesh         {} nodes, {} elements", thousands(c.nodes), thousands(c.tetrahedra));
    let _ = writeln!(out, "  folds        {}", thousands(s.folds));
    let _ = writeln!(out, "  trust        {}: {}", v.trust.name(), v.reasons.join("; "));
    let _ = writeln!(out, "  next         {}", v.next);
    let _ = writeln!(out, "  time         {:.1} s", s.seconds.iter().map(|t| t.1).sum::<f64>());
    out
}

/// A score against truth, a few lines.
pub fn metrics(m: &Metrics) -> String {
    let mut out = format!(
        "Mean error {:.3} mm over {} voxels, {:.3} mm before registration.\n",
        m.mean_mm,
        thousands(m.voxels),
        m.identity_mm
    );
    let _ = writeln!(
        out,
        "  error        median {:.3} mm, 95th percentile {:.3} mm, largest {:.3} mm",
        m.median_mm, m.p95_mm, m.max_mm
    );
    if let Some(v) = m.landmarks_mm {
        let _ = writeln!(out, "  landmarks    {v:.3} mm");
    }
    if let Some(v) = m.still_mm {
        let _ = writeln!(out, "  still tissue {v:.3} mm");
    }
    let _ = writeln!(out, "  gradient     median error {:.4}, 95th percentile {:.4}", m.grad_err, m.grad_err_p95);
    let _ = writeln!(out, "  folds        {:.2e} of the voxels", m.folds);
    out
}

/// How far points come back from where they started, in a line.
pub fn inverse_consistency(c: &InverseConsistency) -> String {
    let outside = match c.outside {
        0.0 => String::new(),
        share => format!("; {:.1} % of the voxels end outside the second field", 100.0 * share),
    };
    format!(
        "Inverse consistency: mean {:.3} mm, 95th percentile {:.3} mm, largest {:.3} mm over {} voxels{outside}.\n",
        c.inverse_mean_mm,
        c.inverse_p95_mm,
        c.inverse_max_mm,
        thousands(c.voxels)
    )
}

/// Target registration error, a few lines.
pub fn target_error(t: &TargetError) -> String {
    let mut out = format!(
        "Target registration error: mean {:.3} mm over {} landmarks, {:.3} mm before registration.\n",
        t.after.mean_mm,
        thousands(t.count),
        t.before.mean_mm
    );
    let row = |d: &Distances| {
        format!("median {:.3} mm, 95th percentile {:.3} mm, largest {:.3} mm", d.median_mm, d.p95_mm, d.max_mm)
    };
    let _ = writeln!(out, "  after        {}", row(&t.after));
    let _ = writeln!(out, "  before       {}", row(&t.before));
    out
}

/// Overlap and surface distances of labels, a line a label; in brackets, before registration.
pub fn label_scores(s: &LabelScores) -> String {
    let mut out = format!(
        "Labels: mean Dice {:.3} over {} {}, {:.3} before registration.\n",
        s.dice_mean,
        s.each.len(),
        if s.each.len() == 1 { "label" } else { "labels" },
        s.dice_mean_before
    );
    let mm = |v: Option<f64>| v.map_or_else(|| "none".into(), |v| format!("{v:.3}"));
    let pair = |of: &dyn Fn(&Overlap) -> String, l: &LabelScore| format!("{} ({})", of(&l.after), of(&l.before));
    for l in &s.each {
        let _ = writeln!(
            out,
            "  label {:<6} Dice {}, surface distance mean {} mm, 95th percentile Hausdorff {} mm",
            l.label,
            pair(&|o| format!("{:.3}", o.dice), l),
            pair(&|o| mm(o.surface_mean_mm), l),
            pair(&|o| mm(o.hausdorff95_mm), l)
        );
    }
    for (labels, map) in [(&s.only_initial, "initial"), (&s.only_deformed, "deformed")] {
        if !labels.is_empty() {
            let named: Vec<String> = labels.iter().map(u8::to_string).collect();
            let _ = writeln!(out, "  not compared {}: in the {map} map alone", named.join(", "));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::field::tests::Case;

    #[test]
    fn the_summary_is_short_and_holds_the_counts() {
        let text = field_summary(&Case::new([8, 8, 8], [1.0; 3]).report());
        assert!(text.lines().count() <= 9, "{text}");
        for part in [
            "13,020 kept of 160,000",
            "900.0000 -> 300.0000",
            "expected error 0.12 mm (0.06 to 0.24)",
            "mean 1.50 mm",
            "trust        high: the expected error is 8 % of the motion",
        ] {
            assert!(text.contains(part), "{part} is missing in\n{text}");
        }
    }

    #[test]
    fn a_score_names_what_doing_nothing_gives() {
        let text = metrics(&Metrics { mean_mm: 0.25, identity_mm: 2.0, voxels: 1000, ..Metrics::default() });
        assert!(text.starts_with("Mean error 0.250 mm over 1,000 voxels, 2.000 mm before registration."));
        assert!(!text.contains("landmarks"));
    }
}
