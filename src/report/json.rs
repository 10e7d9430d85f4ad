//! summary.json of `palpate field`.

use crate::report::field::FieldReport;
use crate::report::strain;
use crate::report::verdict::verdict;
use crate::types::Grid;
use serde_json::{Map, Value, json};

/// Shape, spacing (mm) and affine (rows of the 4 x 4 voxel-to-world matrix without the last, mm,
/// RAS) of a grid.
pub fn grid(g: &Grid) -> Value {
    json!({ "shape": g.shape(), "spacing_mm": g.spacing(), "affine_ras": g.affine().rows() })
}

/// Seconds by stage.
pub fn seconds(stages: &[(String, f64)]) -> Map<String, Value> {
    stages.iter().map(|(stage, t)| (stage.clone(), json!(t))).collect()
}

/// The keys are those of docs/reference/file-formats.md.
pub(crate) fn field_summary(report: &FieldReport<'_>) -> Value {
    let (s, judged) = (report.summary, verdict(report));
    let [initial, deformed, mask] = report.names;
    let mut out = json!({
        "version": env!("CARGO_PKG_VERSION"),
        "command": report.command,
        "inputs": { "initial": initial, "deformed": deformed, "mask": report.mask.map(|_| mask) },
        "grid": grid(report.initial.grid()),
        "deformed_grid": grid(report.deformed_grid),
        "counts": s.counts,
        "model": s.model,
        "model_rejected": s.rejected,
        "evidence": s.evidence,
        "bodies": s.bodies,
        "levels": s.levels,
        "stages": s.stages,
        "mask_voxels": s.mask_voxels,
        "folds": s.folds,
        "displacement_mean_mm": s.mean_mm,
        "displacement_max_mm": s.max_mm,
        "uncertainty_median_mm": s.uncertainty_median_mm,
        "expected_error_mm": s.expected.mean_mm,
        "expected_error_interval_mm": s.expected.interval_mm,
        "expected_error_p95_mm": s.expected.p95_mm,
        "expected_error_share": s.expected.share(),
        "expected_error_sources": s.expected.sources.iter()
            .filter_map(|(source, share)| Some((json!(source).as_str()?.to_string(), json!(share))))
            .collect::<Map<String, Value>>(),
        "expected_error_labels": s.expected.labels,
        "unseen": s.unseen,
        "agreement": s.agreement,
        "recast": s.recast,
        "landmarks": s.landmarks,
        "start": s.start,
        "trust": judged.trust.name(),
        "trust_reasons": judged.reasons,
        "next": judged.next,
        "seconds": seconds(&s.seconds),
        "warnings": s.warnings,
        "params": report.params,
    });
    if let Some((_, metrics)) = report.truth {
        out["metrics"] = json!(metrics);
    }
    if let Some(strain) = &report.strain {
        out["strain"] = strain::summary(strain);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::field::tests::Case;

    #[test]
    fn the_promised_keys_are_there() {
        let value = field_summary(&Case::new([4, 5, 6], [1.0, 1.0, 3.0]).report());
        assert_eq!(value["grid"]["shape"], json!([4, 5, 6]));
        assert_eq!(value["counts"]["kept"], 13_020);
        assert_eq!(value["model"], "free");
        assert_eq!(value["seconds"]["matching"], 2.0);
        assert_eq!(value["inputs"]["mask"], Value::Null);
        for key in [
            "version",
            "command",
            "folds",
            "levels",
            "stages",
            "evidence",
            "bodies",
            "unseen",
            "expected_error_mm",
            "expected_error_interval_mm",
            "expected_error_p95_mm",
            "expected_error_share",
            "expected_error_sources",
            "expected_error_labels",
            "trust",
            "trust_reasons",
            "warnings",
            "params",
        ] {
            assert!(!value[key].is_null(), "{key}");
        }
    }
}
