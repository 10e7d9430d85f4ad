//! What the numbers mean, in plain words.

use crate::report::field::FieldReport;
use crate::report::scale::{short, thousands};
use crate::report::statistics::sample;
use crate::types::{FieldSummary, Grid, Mask, MotionModel};

/// How far to rely on a field.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Trust {
    /// Precise everywhere, nothing odd.
    High,
    /// Usable; look at the uncertainty first.
    Moderate,
    /// Do not build on it before looking at the reasons.
    Low,
}

impl Trust {
    /// In lower case.
    pub fn name(self) -> &'static str {
        match self {
            Trust::High => "high",
            Trust::Moderate => "moderate",
            Trust::Low => "low",
        }
    }
}

/// A judgement with its reasons.
#[derive(Debug, Clone, PartialEq)]
pub struct Verdict {
    /// What was found, one or two sentences.
    pub headline: String,
    /// How far to rely on it.
    pub trust: Trust,
    /// Why, one sentence each; never empty.
    pub reasons: Vec<String>,
}

/// Judges a result. With the edge of a cube of a voxel's volume as measure, trust is low with under 100 matches, folds in
/// more than one voxel of a thousand, a median uncertainty above that edge, or one above the mean motion of a free field;
/// high when nothing folds, the median uncertainty is under half an edge, and under a tenth of the voxels are uncertain by
/// more than an edge.
pub fn verdict(report: &FieldReport<'_>) -> Verdict {
    judge(report.initial.grid(), report.mask, report.uncertainty, report.summary)
}

/// As [`verdict`], from the initial volume's grid, the mask, the uncertainty by voxel (mm) and the summary alone.
pub fn judge(grid: &Grid, mask: Option<&Mask>, uncertainty: &dyn Fn(usize) -> f32, s: &FieldSummary) -> Verdict {
    let edge = grid.spacing().iter().product::<f64>().cbrt();
    let motion = match s.model {
        MotionModel::Identity => "Nothing moved beyond the noise".to_string(),
        MotionModel::Rigid => format!("One rigid motion, {} mm on average", short2(s.mean_mm)),
        MotionModel::Affine => format!("One affine motion, {} mm on average", short2(s.mean_mm)),
        MotionModel::Free => {
            format!("Tissue moved {} mm on average and {} mm at most", short2(s.mean_mm), short2(s.max_mm))
        }
    };
    let residual =
        s.levels.last().map(|l| format!(", median residual {} mm", short2(l.residual_mm))).unwrap_or_default();
    let headline = format!("{motion}: {} matches{residual}.", thousands(s.counts.kept));

    let (share, side) = uncertain(grid, mask, uncertainty, edge);
    let mut low = Vec::new();
    if s.counts.kept < 100 {
        low.push(format!("only {} matches carry the field", s.counts.kept));
    }
    if s.folds * 1000 > s.mask_voxels {
        low.push(format!("the field folds in {} voxels, which tissue cannot do", thousands(s.folds)));
    }
    if s.uncertainty_median_mm > edge {
        low.push(format!("half of the voxels are uncertain by more than {} mm", short2(s.uncertainty_median_mm)));
    } else if s.model == MotionModel::Free && s.uncertainty_median_mm > s.mean_mm {
        low.push("the motion is smaller than its uncertainty".into());
    }
    let weak = format!(
        "{} % of the voxels are uncertain by more than a voxel ({} mm){side}",
        short1(100.0 * share),
        short2(edge)
    );
    let precise = s.uncertainty_median_mm <= edge / 2.0 && share < 0.1;
    let median = format!("median uncertainty {} mm (1 sigma)", short2(s.uncertainty_median_mm));
    let (trust, mut reasons) = match (low.is_empty(), precise && s.folds == 0) {
        (false, _) => (Trust::Low, low),
        (true, true) => (Trust::High, vec![median, "no folds".into()]),
        (true, false) => (Trust::Moderate, vec![median]),
    };
    if share >= 0.01 {
        reasons.push(weak);
    }
    if trust == Trust::Moderate && s.folds > 0 {
        reasons.push(format!("{} voxels fold", thousands(s.folds)));
    }
    Verdict { headline, trust, reasons }
}

/// The share of voxels uncertain by more than `limit` mm, and in words where they lie, when they lie to one side.
fn uncertain(grid: &Grid, mask: Option<&Mask>, uncertainty: &dyn Fn(usize) -> f32, limit: f64) -> (f64, String) {
    let picked = sample(grid.len(), mask);
    let world = |&o: &usize| {
        let [i, j, k] = grid.voxel(o);
        grid.world(i, j, k).0
    };
    let weak: Vec<usize> = picked.iter().copied().filter(|&o| f64::from(uncertainty(o)) > limit).collect();
    if weak.is_empty() {
        return (0.0, String::new());
    }
    let mean = |v: &[usize], a: usize| v.iter().map(|o| world(o)[a]).sum::<f64>() / v.len() as f64;
    let spread = |a: usize, m: f64| picked.iter().map(|o| (world(o)[a] - m).powi(2)).sum::<f64>() / picked.len() as f64;
    let mut furthest = (0.0, 0);
    for a in 0..3 {
        let m = mean(&picked, a);
        let shift = (mean(&weak, a) - m) / spread(a, m).sqrt().max(1e-9);
        if shift.abs() > f64::abs(furthest.0) {
            furthest = (shift, a);
        }
    }
    const SIDES: [[&str; 2]; 3] = [["left", "right"], ["back", "front"], ["lower", "upper"]];
    let side = SIDES[furthest.1][usize::from(furthest.0 > 0.0)];
    let side = if furthest.0.abs() > 0.7 { format!(", mostly on the {side} side") } else { String::new() };
    (weak.len() as f64 / picked.len() as f64, side)
}

/// Two digits after the point.
pub(crate) fn short2(v: f64) -> String {
    short((v * 100.0).round() / 100.0)
}

/// One digit after the point.
fn short1(v: f64) -> String {
    short((v * 10.0).round() / 10.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::field::tests::Case;

    #[test]
    fn a_precise_field_is_trusted_and_a_vague_one_is_not() {
        let mut case = Case::new([20, 20, 20], [1.0; 3]);
        let good = verdict(&case.report());
        assert_eq!(good.trust, Trust::High, "{:?}", good.reasons);
        assert!(good.headline.contains("13,020 matches, median residual 0.12 mm"), "{}", good.headline);
        case.summary.uncertainty_median_mm = 2.5;
        let vague = verdict(&case.report());
        assert_eq!(vague.trust, Trust::Low);
        assert!(vague.reasons[0].contains("2.5 mm"));
    }

    #[test]
    fn folds_and_few_matches_are_named() {
        let mut case = Case::new([20, 20, 20], [1.0; 3]);
        case.summary.folds = 100;
        case.summary.counts.kept = 31;
        let v = verdict(&case.report());
        assert_eq!((v.trust, v.reasons.len()), (Trust::Low, 2));
    }

    #[test]
    fn the_uncertain_side_is_named() {
        let mut case = Case::new([20, 20, 20], [1.0; 3]);
        case.uncertainty = Box::new(|o| if o < 20 * 20 * 16 { 0.2 } else { 3.0 });
        let v = verdict(&case.report());
        assert_eq!(v.trust, Trust::Moderate);
        assert!(
            v.reasons[1].starts_with("20 % of the voxels") && v.reasons[1].ends_with("upper side"),
            "{:?}",
            v.reasons
        );
    }
}
