//! What the numbers mean, in plain words.

use crate::report::field::FieldReport;
use crate::report::scale::{short, thousands};
use crate::report::statistics::{quantile, sample};
pub use crate::types::Trust;
use crate::types::{ErrorSource, FieldSummary, FrameSummary, Mask, MotionModel};

/// A judgement with its reasons.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Verdict {
    /// What was found, one or two sentences.
    pub headline: String,
    /// How far to rely on it.
    pub trust: Trust,
    /// Why, one sentence each; never empty.
    pub reasons: Vec<String>,
    /// What to do next, in words without a full stop.
    pub next: String,
}

/// The uncertainty of the worst tenth over that of the middle from which the place is named: of a
/// field with one uncertainty everywhere it is 1.
const MIN_UNEVENNESS: f64 = 1.5;

/// A source of error is named from this share of the expected squared error on.
const MIN_NAMED_SHARE: f64 = 0.2;

/// Judges a result: trust follows from the expected error alone ([`Trust::of`]).
pub fn verdict(report: &FieldReport<'_>) -> Verdict {
    judge(report.bodies, report.uncertainty, report.summary)
}

/// As [`verdict`], from the bodies (0 where nothing was measured), the uncertainty by voxel (mm)
/// and the summary alone.
pub(crate) fn judge(bodies: &Mask, uncertainty: &dyn Fn(usize) -> f32, s: &FieldSummary) -> Verdict {
    let edge = bodies.grid().spacing().iter().product::<f64>().cbrt();
    let motion = match s.model {
        MotionModel::Identity if s.rejected => "Held still, as asked, though the volumes show motion".into(),
        MotionModel::Identity => format!("Nothing moved by more than about {} mm", short2(s.expected.p95_mm)),
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
    let headline = format!("{motion}; expected error {}.", expected(s));
    let trust = s.expected.trust();
    let mut reasons = vec![format!("the expected error is {}", relative(s))];
    let named = s.expected.sources.iter().filter(|(_, share)| *share >= MIN_NAMED_SHARE);
    let named: Vec<String> =
        named.map(|(source, share)| format!("{} ({:.0} %)", source.words(), 100.0 * share)).collect();
    if !named.is_empty() {
        reasons.push(format!("the squared error comes from {}", named.join(", ")));
    }
    let (share, side) = uncertain(bodies, uncertainty, edge);
    if share >= 0.01 {
        reasons.push(format!(
            "{} % of the voxels are uncertain by more than a voxel ({} mm){side}",
            short1(100.0 * share),
            short2(edge)
        ));
    }
    reasons.extend(least_sure(bodies, uncertainty));
    if s.folds > 0 {
        reasons.push(format!("{} voxels fold", thousands(s.folds)));
    }
    match s.warnings.len() {
        0 => {}
        1 => reasons.push("there is a warning".into()),
        n => reasons.push(format!("there are {n} warnings")),
    }
    let next = match s.warnings.is_empty() && trust == Trust::High {
        true => "measure strain (palpate strain) or stiffness (palpate stiffness) from this field".into(),
        false => advice(s),
    };
    Verdict { headline, trust, reasons, next }
}

/// What would lower the expected error most.
fn advice(s: &FieldSummary) -> String {
    let largest = s.expected.sources.iter().max_by(|a, b| a.1.total_cmp(&b.1)).map(|s| s.0);
    let what = match largest {
        _ if s.rejected => "leave --model out: the model that was asked for does not explain the volumes",
        Some(ErrorSource::Noise) => {
            "image finer or with less noise, or leave tissue without texture out with --mask; palpate certify tells what the scan \
             can show"
        }
        Some(ErrorSource::Misfit) => {
            "watch the initial and the warped volume in turns in the report: where parts slide give --bodies, where tissue changed its look \
             leave it out with --ignore"
        }
        Some(ErrorSource::Model) => {
            "compare with --model free: the motion model that was chosen may leave some motion out"
        }
        Some(ErrorSource::OutOfView) => "leave tissue out of view out with --mask, or image a larger field of view",
        Some(ErrorSource::Borders) => "give the parts that slide as a label map with --bodies",
        Some(ErrorSource::OtherMotions) => {
            "check in the report that both volumes show the same tissue; then give --landmarks or --initial"
        }
        None => "watch the initial and the warped volume in turns in the report",
    };
    what.into()
}

/// How unsure the worst tenth of the tissue is, and where it lies; nothing where all is alike.
fn least_sure(bodies: &Mask, uncertainty: &dyn Fn(usize) -> f32) -> Option<String> {
    let picked = sample(bodies.grid().len(), Some(bodies));
    let at = |part: f64| quantile(picked.iter().map(|&o| f64::from(uncertainty(o))), part);
    let (middle, worst) = (at(0.5), at(0.9));
    let (_, side) = uncertain(bodies, uncertainty, worst);
    (worst > MIN_UNEVENNESS * middle).then(|| {
        format!(
            "a tenth of the tissue is uncertain by ± {} mm or more{side}, half by ± {}",
            short2(worst),
            short2(middle)
        )
    })
}

/// The expected error with its interval.
fn expected(s: &FieldSummary) -> String {
    let e = &s.expected;
    let [low, high] = e.interval_mm;
    format!("{} mm ({} to {})", short2(e.mean_mm), short2(low), short2(high))
}

/// The expected error as a part of the motion, or of a voxel where nothing moves.
fn relative(s: &FieldSummary) -> String {
    let given = s.start.filter(|start| !start.found);
    let beyond = given.map_or(s.model, |start| start.model_beyond);
    let what = match () {
        _ if beyond == MotionModel::Identity && !s.rejected => "a voxel",
        _ if given.is_some() => "the motion beyond the start",
        _ => "the motion",
    };
    format!("{} % of {what}", short1(100.0 * s.expected.share()))
}

/// Part of the tissue out of line with the frames beside it from which trust in a frame is low (1).
const OUT_OF_LINE: f64 = 0.25;

/// Judges a sequence by its worst frames, which the reasons name: `judged` has the number of each
/// measured frame and what [`judge`] says of it.
///
/// Trust in the sequence is low where more than half of the frames are lost or of low trust, high
/// where each frame is of high trust, else moderate. A frame in which more than a quarter of the
/// tissue is out of line with the frames beside it is of low trust.
pub(crate) fn judge_frames(frames: &[FrameSummary], judged: &[(usize, Verdict)]) -> (Trust, Vec<String>) {
    let of = |f: &FrameSummary| judged.iter().find(|j| j.0 == f.frame).map(|j| &j.1);
    let trust = |f: &FrameSummary| match f.trust {
        Some(trust) if f.out_of_line <= OUT_OF_LINE => trust,
        _ => Trust::Low,
    };
    let numbers = |pick: &dyn Fn(&FrameSummary) -> bool| frames.iter().filter(|f| pick(f)).map(|f| f.frame).collect();
    let lost: Vec<usize> = numbers(&|f| f.lost.is_some());
    let low: Vec<usize> = numbers(&|f| f.lost.is_none() && trust(f) == Trust::Low);
    let vague: Vec<usize> = numbers(&|f| trust(f) == Trust::Moderate);
    let warned: Vec<usize> = numbers(&|f| f.lost.is_none() && !f.warnings.is_empty());

    let largest = frames.iter().map(|f| f.expected_error_mm).fold(0.0, f64::max);
    let mut reasons = vec![format!("expected error at most {} mm in any frame", short2(largest))];
    for (which, what) in [(lost, "lost"), (low, "of low trust"), (vague, "of moderate trust"), (warned, "warned of")] {
        if let Some(names) = named(&which) {
            reasons.push(format!("{names} {} {what}", if which.len() == 1 { "is" } else { "are" }));
        }
    }
    let share = |f: &FrameSummary| f.expected_error_mm / f.mean_mm.max(1e-6);
    let worse = |a: &&FrameSummary, b: &&FrameSummary| trust(a).cmp(&trust(b)).then(share(a).total_cmp(&share(b)));
    let worst = frames.iter().filter(|f| f.lost.is_none() && trust(f) != Trust::High).max_by(worse);
    if let Some(f) = worst {
        let said = of(f).filter(|v| v.trust != Trust::High).map(|v| v.reasons.as_slice()).unwrap_or_default();
        let why: String = said.iter().skip(1).map(|r| format!(", {r}")).collect();
        reasons.push(format!(
            "the worst, frame {}, has an expected error of {} mm where tissue moved {} mm on average{}",
            f.frame,
            short2(f.expected_error_mm),
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

/// The share of the voxels measured that are uncertain by more than `limit` mm, and in words where
/// they lie, when they lie to one side.
fn uncertain(bodies: &Mask, uncertainty: &dyn Fn(usize) -> f32, limit: f64) -> (f64, String) {
    let grid = bodies.grid();
    let picked = sample(grid.len(), Some(bodies));
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
    fn trust_follows_from_the_expected_error_alone() {
        let mut case = Case::new([20, 20, 20], [1.0; 3]);
        let mut of = |error: f64| {
            case.summary.expected.mean_mm = error;
            verdict(&case.report())
        };
        // The tissue moves by 1.5 mm.
        let [high, moderate, low] = [0.14, 0.16, 0.51].map(&mut of);
        assert_eq!([high.trust, moderate.trust, low.trust], [Trust::High, Trust::Moderate, Trust::Low]);
        assert!(low.headline.contains("expected error 0.51 mm"), "{}", low.headline);
        assert_eq!(low.reasons[0], "the expected error is 34 % of the motion");
        assert_eq!(low.reasons[1], "the squared error comes from noise where texture is weak (90 %)");
        case.summary.folds = 100;
        case.summary.warnings.push("one more".into());
        case.summary.expected.mean_mm = 0.14;
        let folded = verdict(&case.report());
        assert_eq!(folded.trust, Trust::High);
        assert!(folded.reasons.iter().any(|r| r == "100 voxels fold"), "{:?}", folded.reasons);
    }

    #[test]
    fn air_does_not_count_as_uncertain_tissue() {
        let mut case = Case::new([20, 20, 20], [1.0; 3]);
        case.uncertainty = Box::new(|o| if o < 4000 { 9.0 } else { 0.2 });
        case.bodies.as_mut_slice()[..4000].fill(0);
        let v = verdict(&case.report());
        assert!(!v.reasons.iter().any(|r| r.contains("uncertain by more than")), "{:?}", v.reasons);
    }

    #[test]
    fn where_nothing_moves_a_voxel_is_the_measure() {
        let mut case = Case::new([20, 20, 20], [2.0; 3]);
        case.summary.model = MotionModel::Identity;
        (case.summary.mean_mm, case.summary.expected.against_mm) = (0.0, 2.0);
        let still = verdict(&case.report());
        assert_eq!((still.trust, still.reasons[0].as_str()), (Trust::High, "the expected error is 6 % of a voxel"));
        assert!(still.headline.starts_with("Nothing moved by more than about 0.5 mm"), "{}", still.headline);
    }

    /// Frames of a sequence with so much expected error and mean motion (mm).
    fn frames(all: &[[f64; 2]]) -> Vec<FrameSummary> {
        let frame = |(at, &[expected_error_mm, mean_mm]): (usize, &[f64; 2])| FrameSummary {
            frame: at + 1,
            lost: None,
            searched: true,
            counts: Default::default(),
            model: Some(MotionModel::Free),
            mean_mm,
            max_mm: 2.0 * mean_mm,
            residual_mm: 0.0,
            uncertainty_median_mm: expected_error_mm,
            expected_error_mm,
            trust: Some(Trust::of(expected_error_mm / mean_mm)),
            folds: 0,
            out_of_line: 0.0,
            seconds: 0.0,
            warnings: Vec::new(),
        };
        all.iter().enumerate().map(frame).collect()
    }

    #[test]
    fn a_sequence_is_judged_by_its_worst_frames() {
        let mut all = frames(&[[0.03, 0.4], [0.01, 0.11], [0.04, 0.44], [0.1, 1.2]]);
        let high = |frame| {
            (
                frame,
                Verdict {
                    headline: String::new(),
                    trust: Trust::High,
                    reasons: vec!["fine".into()],
                    next: String::new(),
                },
            )
        };
        let mut judged: Vec<(usize, Verdict)> = (1..=4).map(high).collect();
        let (trust, reasons) = judge_frames(&all, &judged);
        assert_eq!((trust, reasons.len()), (Trust::High, 1), "{reasons:?}");
        // Warnings are named and change no trust.
        (1..3).for_each(|at| all[at].warnings.push("out of view".into()));
        let (trust, reasons) = judge_frames(&all, &judged);
        assert_eq!((trust, reasons[1].as_str()), (Trust::High, "frames 2, 3 are warned of"));
        all[3].trust = Some(Trust::Low);
        judged[3].1.trust = Trust::Low;
        judged[3].1.reasons = vec!["the expected error is 50 % of the motion".into(), "it is noisy".into()];
        (all[0].lost, all[0].trust) = (Some("no overlap".into()), None);
        let (trust, reasons) = judge_frames(&all, &judged);
        assert_eq!(
            (trust, reasons[1].as_str(), reasons[2].as_str()),
            (Trust::Moderate, "frame 1 is lost", "frame 4 is of low trust")
        );
        let worst =
            "the worst, frame 4, has an expected error of 0.1 mm where tissue moved 1.2 mm on average, it is noisy";
        assert_eq!(reasons.last().map(String::as_str), Some(worst));
        all[2].out_of_line = 0.3;
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
        let named = |r: &&String| r.starts_with("20 % of the voxels") && r.ends_with("upper side");
        assert_eq!(v.reasons.iter().filter(named).count(), 1, "{:?}", v.reasons);
    }
}
