//! What the numbers mean, in plain words.

use crate::report::field::FieldReport;
use crate::report::scale::{short, thousands};
use crate::report::statistics::sample;
use crate::types::{FieldSummary, FrameSummary, Grid, Mask, MotionModel};

/// How far to rely on a field.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
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

const MEDIAN: &str = "median uncertainty";

/// The part of the tissue outside the deformed volume from which trust is low: what is carried over
/// so far is off by millimetres.
const UNSEEN: f64 = 0.25;

/// Judges a result. With the edge of a cube of a voxel's volume as measure, trust is low with under
/// 100 matches, folds in more than one voxel of a thousand, a median uncertainty above that edge,
/// or one above the mean motion of a free field, and where more than a quarter of the tissue moves
/// out of the deformed volume or the field is in doubt; high when nothing folds, the median
/// uncertainty is under half an edge, under a tenth of the voxels are uncertain by more than an
/// edge, and nothing is warned of.
pub fn verdict(report: &FieldReport<'_>) -> Verdict {
    judge(report.initial.grid(), report.mask, report.uncertainty, report.summary)
}

/// As [`verdict`], from the initial volume's grid, the mask, the uncertainty by voxel (mm) and the
/// summary alone.
pub fn judge(grid: &Grid, mask: Option<&Mask>, uncertainty: &dyn Fn(usize) -> f32, s: &FieldSummary) -> Verdict {
    let edge = grid.spacing().iter().product::<f64>().cbrt();
    let motion = match s.model {
        MotionModel::Identity => "Nothing moved beyond the noise".to_string(),
        MotionModel::Rigid => format!("One rigid motion, {} mm on average", short2(s.mean_mm)),
        MotionModel::Affine => format!("One affine motion, {} mm on average", short2(s.mean_mm)),
        MotionModel::Free => {
            let bodies = match s.bodies.len() {
                0 | 1 => String::new(),
                n => format!(", in {n} bodies that slide along each other"),
            };
            format!("Tissue moved {} mm on average and {} mm at most{bodies}", short2(s.mean_mm), short2(s.max_mm))
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
    if s.unseen > UNSEEN {
        low.push(format!("{:.0} % of the tissue is not in the deformed volume", 100.0 * s.unseen));
    }
    if s.in_doubt {
        low.push(
            "features do not bear each other out, and the volumes stay different: another tissue, or another motion"
                .into(),
        );
    }
    let weak = format!(
        "{} % of the voxels are uncertain by more than a voxel ({} mm){side}",
        short1(100.0 * share),
        short2(edge)
    );
    let precise = s.uncertainty_median_mm <= edge / 2.0 && share < 0.1;
    let median = format!("{MEDIAN} {} mm (1 sigma)", short2(s.uncertainty_median_mm));
    let (trust, mut reasons) = match (low.is_empty(), precise && s.folds == 0 && s.warnings.is_empty()) {
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
    match s.warnings.len() {
        0 => {}
        1 => reasons.push("there is a warning".into()),
        n => reasons.push(format!("there are {n} warnings")),
    }
    Verdict { headline, trust, reasons }
}

/// Judges a sequence by its worst frames, which the reasons name: `judged` has the number of each measured frame and what
/// [`judge`] says of it. Trust in the sequence is low where more than
/// half of the frames are lost or of low trust, high where each frame is of high trust, else moderate. A frame in which more than a quarter of the
/// tissue is out of line with the frames beside it is of low trust.
pub fn judge_frames(frames: &[FrameSummary], judged: &[(usize, Verdict)]) -> (Trust, Vec<String>) {
    let of = |f: &FrameSummary| judged.iter().find(|j| j.0 == f.frame).map(|j| &j.1);
    let trust = |f: &FrameSummary| match (&f.lost, of(f).map_or(Trust::High, |v| v.trust)) {
        (Some(_), _) => Trust::Low,
        (None, _) if f.out_of_line > UNSEEN => Trust::Low,
        (None, Trust::High) if !f.warnings.is_empty() => Trust::Moderate,
        (None, trust) => trust,
    };
    let numbers = |pick: &dyn Fn(&FrameSummary) -> bool| frames.iter().filter(|f| pick(f)).map(|f| f.frame).collect();
    let lost: Vec<usize> = numbers(&|f| f.lost.is_some());
    let low: Vec<usize> = numbers(&|f| f.lost.is_none() && trust(f) == Trust::Low);
    let warned: Vec<usize> = numbers(&|f| f.lost.is_none() && trust(f) != Trust::Low && !f.warnings.is_empty());
    let vague: Vec<usize> = numbers(&|f| trust(f) == Trust::Moderate && f.warnings.is_empty());

    let median = frames.iter().map(|f| f.uncertainty_median_mm).fold(0.0, f64::max);
    let mut reasons = vec![format!("{MEDIAN} at most {} mm in any frame", short2(median))];
    for (which, what) in [(lost, "lost"), (low, "of low trust"), (warned, "warned of"), (vague, "of moderate trust")] {
        if let Some(names) = named(&which) {
            reasons.push(format!("{names} {} {what}", if which.len() == 1 { "is" } else { "are" }));
        }
    }
    let share = |f: &FrameSummary| f.uncertainty_median_mm / f.mean_mm.max(1e-6);
    let worse = |a: &&FrameSummary, b: &&FrameSummary| trust(a).cmp(&trust(b)).then(share(a).total_cmp(&share(b)));
    let worst = frames.iter().filter(|f| f.lost.is_none() && trust(f) != Trust::High).max_by(worse);
    if let Some(f) = worst {
        let said = of(f).filter(|v| v.trust != Trust::High).map(|v| v.reasons.as_slice()).unwrap_or_default();
        let why: String = said.iter().filter(|r| !r.starts_with(MEDIAN)).map(|r| format!(", {r}")).collect();
        reasons.push(format!(
            "the worst, frame {}, is uncertain by {} mm (median) where tissue moved {} mm on average{}",
            f.frame,
            short2(f.uncertainty_median_mm),
            short2(f.mean_mm),
            why
        ));
    }
    let bad = frames.iter().filter(|f| trust(f) == Trust::Low).count();
    let whole = match frames.iter().map(trust).max() {
        _ if 2 * bad > frames.len() => Trust::Low,
        Some(Trust::Low | Trust::Moderate) => Trust::Moderate,
        _ => Trust::High,
    };
    (whole, reasons)
}

/// Runs of frames that are named one by one.
const RUNS: usize = 6;

/// Frames in words, "frames 1, 3 to 5 and 9"; none without any. `which` rises.
pub(super) fn named(which: &[usize]) -> Option<String> {
    let mut runs: Vec<[usize; 2]> = Vec::new();
    for &frame in which {
        match runs.last_mut() {
            Some(run) if run[1] + 1 == frame => run[1] = frame,
            _ => runs.push([frame; 2]),
        }
    }
    let word = |run: &[usize; 2]| match run[1] - run[0] {
        0 => run[0].to_string(),
        1 => format!("{}, {}", run[0], run[1]),
        _ => format!("{} to {}", run[0], run[1]),
    };
    let shown: Vec<String> = runs.iter().take(RUNS).map(word).collect();
    let left: usize = runs.iter().skip(RUNS).map(|r| r[1] - r[0] + 1).sum();
    let more = if left > 0 { format!(" and {left} more") } else { String::new() };
    let noun = if which.len() == 1 { "frame" } else { "frames" };
    (!which.is_empty()).then(|| format!("{noun} {}{more}", shown.join(", ")))
}

/// The share of voxels uncertain by more than `limit` mm, and in words where they lie, when they
/// lie to one side.
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
        let warned = verdict(&case.report());
        assert_eq!((warned.trust, warned.reasons[1].as_str()), (Trust::Moderate, "there is a warning"));
        case.summary.warnings.clear();
        let good = verdict(&case.report());
        assert_eq!(good.trust, Trust::High, "{:?}", good.reasons);
        assert!(good.headline.contains("13,020 matches, median residual 0.12 mm"), "{}", good.headline);
        case.summary.uncertainty_median_mm = 2.5;
        let vague = verdict(&case.report());
        assert_eq!(vague.trust, Trust::Low);
        assert!(vague.reasons[0].contains("2.5 mm"));
        case.summary.uncertainty_median_mm = 0.2;
        case.summary.in_doubt = true;
        assert_eq!(verdict(&case.report()).trust, Trust::Low);
        case.summary.in_doubt = false;
        case.summary.unseen = 0.4;
        let gone = verdict(&case.report());
        assert_eq!((gone.trust, gone.reasons[0].contains("40 %")), (Trust::Low, true));
    }

    #[test]
    fn folds_and_few_matches_are_named() {
        let mut case = Case::new([20, 20, 20], [1.0; 3]);
        case.summary.folds = 100;
        case.summary.counts.kept = 31;
        let v = verdict(&case.report());
        assert_eq!((v.trust, v.reasons.len()), (Trust::Low, 3));
    }

    /// Frames of a sequence with so much median uncertainty and mean motion (mm).
    fn frames(all: &[[f64; 2]]) -> Vec<FrameSummary> {
        let frame = |(at, &[uncertainty_median_mm, mean_mm]): (usize, &[f64; 2])| FrameSummary {
            frame: at + 1,
            lost: None,
            searched: true,
            counts: Default::default(),
            model: Some(MotionModel::Free),
            mean_mm,
            max_mm: 2.0 * mean_mm,
            residual_mm: 0.0,
            uncertainty_median_mm,
            folds: 0,
            out_of_line: 0.0,
            seconds: 0.0,
            warnings: Vec::new(),
        };
        all.iter().enumerate().map(frame).collect()
    }

    #[test]
    fn a_sequence_is_judged_by_its_worst_frames() {
        let mut all = frames(&[[0.05, 0.4], [0.13, 0.11], [0.2, 0.44], [0.3, 1.2]]);
        let high =
            |frame| (frame, Verdict { headline: String::new(), trust: Trust::High, reasons: vec!["fine".into()] });
        let mut judged: Vec<(usize, Verdict)> = (1..=4).map(high).collect();
        let (trust, reasons) = judge_frames(&all, &judged);
        assert_eq!((trust, reasons.len()), (Trust::High, 1), "{reasons:?}");
        // What is warned of is not of high trust, however small its uncertainty.
        (1..3).for_each(|at| all[at].warnings.push("the mean error to expect is about half of the mean motion".into()));
        let (trust, reasons) = judge_frames(&all, &judged);
        assert_eq!((trust, reasons[1].as_str()), (Trust::Moderate, "frames 2, 3 are warned of"));
        assert!(reasons[2].starts_with("the worst, frame 2, is uncertain by 0.13 mm"), "{reasons:?}");
        judged[3].1.trust = Trust::Low;
        judged[3].1.reasons = vec!["only 40 matches carry the field".into()];
        all[0].lost = Some("no overlap".into());
        let (trust, reasons) = judge_frames(&all, &judged);
        assert_eq!(
            (trust, reasons[1].as_str(), reasons[2].as_str()),
            (Trust::Moderate, "frame 1 is lost", "frame 4 is of low trust")
        );
        assert!(
            reasons[4].starts_with("the worst, frame 4") && reasons[4].ends_with("only 40 matches carry the field")
        );
        judged[2].1.trust = Trust::Low;
        assert_eq!(judge_frames(&all, &judged).0, Trust::Low);
    }

    #[test]
    fn frames_are_named_by_their_runs() {
        let found = [&[7][..], &[1, 2, 4, 5, 6, 9], &[1, 3, 5, 7, 9, 11, 13, 14]].map(|w| named(w).unwrap_or_default());
        assert_eq!(found, ["frame 7", "frames 1, 2, 4 to 6, 9", "frames 1, 3, 5, 7, 9, 11 and 2 more"]);
        assert_eq!(named(&[]), None);
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
