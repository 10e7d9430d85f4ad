//! report.html, summary.json and the short summary of `palpate track`.

use crate::report::animation::Film;
use crate::report::chart;
use crate::report::colormap::ColorMap;
use crate::report::field::Values;
use crate::report::html::{document, header, tiles, trusted, warned};
use crate::report::json::{grid, seconds};
use crate::report::panels::{centre_of_motion, gray_range, length};
use crate::report::plot::{Line, Plot};
use crate::report::scale::{Scale, thousands};
use crate::report::statistics::{quantile, sample};
use crate::report::tables::table;
use crate::report::verdict::{Verdict, judge_frames, named, short2};
use crate::report::viewer::{Layer, Moment, PackedMoment, Viewer, elements};
use crate::report::views::{Scales, matched};
use crate::types::{
    DenseField, FieldParams, FrameSummary, Grid, Mask, Mesh, MotionModel, PointState, SparseField, StrainRow, Tracked,
    Voxels, WorldPoint,
};
use maud::{Markup, html};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::fmt::Write;

/// A tracked sequence.
pub(crate) struct TrackReport<'a> {
    /// What the volumes are called, by number.
    pub names: &'a [String],
    /// Number of the reference.
    pub reference: usize,
    /// Time between frames (s), where it is known.
    pub step_s: Option<f64>,
    /// The reference's grid.
    pub grid: &'a Grid,
    /// Mask and label map, as they are called; empty without.
    pub regions: [&'a str; 2],
    /// What was asked for.
    pub params: &'a FieldParams,
    /// What was found.
    pub tracked: &'a Tracked,
    /// Sections of the frames.
    pub film: &'a Film,
    /// Frames to look at, with the reference and where it was measured.
    pub look: Option<(&'a Looks, &'a Voxels<'a>, Option<&'a Mask>)>,
    /// Frames that were measured and how each is judged as a pair.
    pub judged: &'a [(usize, Verdict)],
    /// What the user should know of the volumes; what each frame is warned of is with the frames.
    pub warnings: &'a [String],
    /// Stage names and wall seconds.
    pub seconds: &'a [(String, f64)],
}

/// The time of a frame in words, `step_s` seconds from one to the next.
pub fn clock(frame: usize, step_s: Option<f64>) -> String {
    match step_s {
        Some(step) => format!("frame {frame}, {} s", short2(step * frame as f64)),
        None => format!("frame {frame}"),
    }
}

impl TrackReport<'_> {
    /// The time of a frame in words.
    fn clock(&self, frame: usize) -> String {
        clock(frame, self.step_s)
    }

    /// Horizontal position of a frame in plots.
    fn time(&self, frame: usize) -> f64 {
        self.step_s.unwrap_or(1.0) * frame as f64
    }

    fn measured(&self) -> impl Iterator<Item = &FrameSummary> {
        self.tracked.frames.iter().filter(|f| f.lost.is_none())
    }

    fn headline(&self) -> String {
        let all = self.tracked.frames.len();
        let largest = self.tracked.frames.iter().map(|f| f.max_mm).fold(0.0, f64::max);
        let (measured, searched) = (self.measured().count(), self.measured().filter(|f| f.searched).count());
        let lost = match all - measured {
            0 => String::new(),
            n => format!("; {n} lost"),
        };
        let how = match searched {
            n if n == measured => "each by a search of all".to_string(),
            n => format!("{n} by a search of all, the others by the frames before"),
        };
        format!(
            "{measured} of {all} frames measured against frame {}{lost} ({how}): tissue moved {} mm at most, {} points followed.",
            self.reference,
            short2(largest),
            thousands(self.tracked.trajectories.len())
        )
    }
}

/// A frame is looked at anew when it moves this many times further than the one before.
const WORTH_A_LOOK: f64 = 1.1;

/// The frames that the viewer holds: as many as the page has room for, evenly spread, and the one
/// that moves most.
pub(crate) struct Looks {
    frames: usize,
    room: usize,
    held: Vec<Look>,
}

struct Look {
    frame: usize,
    mean_mm: f64,
    centre: WorldPoint,
    moment: PackedMoment,
    histograms: Markup,
}

/// A frame to look at. All on the reference's grid.
pub(crate) struct Seen<'a> {
    /// Its number.
    pub frame: usize,
    /// What it is called.
    pub name: &'a str,
    /// Its motion (mm), on the mean.
    pub mean_mm: f64,
    /// The reference, the frame as it came, and warped back.
    pub volumes: [&'a Voxels<'a>; 3],
    /// Where it was measured.
    pub mask: Option<&'a Mask>,
    /// Displacement, reference to frame (mm, RAS).
    pub displacement: &'a DenseField,
    /// Matches with covariance.
    pub matches: &'a SparseField,
    /// The mesh through the kept ones.
    pub mesh: &'a Mesh,
    /// Largest principal strain (Green-Lagrange).
    pub strain: Values<'a>,
    /// Jacobian determinant of x + u(x).
    pub jacobian: Values<'a>,
    /// One standard deviation of the displacement (mm).
    pub uncertainty: Values<'a>,
}

impl Looks {
    /// None yet of `frames` frames on the reference's grid.
    pub fn new(frames: usize, grid: &Grid) -> Self {
        Self { frames, room: Moment::room(grid, 2, 3), held: Vec::new() }
    }

    /// Whether this one is held whatever it shows; one place is kept for the one that moves most.
    fn regular(&self, frame: usize) -> bool {
        let before = |n: usize| n * (self.room - 1) / self.frames;
        self.room >= self.frames || before(frame + 1) > before(frame)
    }

    /// Whether a frame of so much motion (mm, mean) is to be added.
    pub(crate) fn wants(&self, frame: usize, mean_mm: f64) -> bool {
        self.regular(frame) || self.held.iter().all(|l| mean_mm > WORTH_A_LOOK * l.mean_mm)
    }

    /// Adds a frame, in place of the one that moved most before.
    pub fn add(&mut self, seen: &Seen<'_>) {
        let Seen { frame, name, mean_mm, volumes, mask, displacement, matches, mesh, .. } = *seen;
        let Seen { strain, jacobian, uncertainty, .. } = *seen;
        let grid = displacement.grid();
        let inside = sample(grid.len(), mask);
        let [reference, a, b] = volumes.map(|v| v.as_slice());
        let [a, b]: [Values<'_>; 2] = [&|o| a[o], &|o| b[o]];
        let range = gray_range(volumes[0]);
        let images = [("frame", a), ("warped", b)].map(|(name, values)| {
            let gain = f64::from(matched(reference, values, &inside));
            Layer { name, values, scale: gray(range.map(|r| r / gain)) }
        });
        let moved: Values<'_> = &|o| length(displacement, o);
        let Scales { length: lengths, jacobian: change, uncertainty: vague, precision } =
            Scales::of(&inside, moved, jacobian, uncertainty, matches);
        let strained = quantile(inside.iter().map(|&o| f64::from(strain(o))), 0.99);
        let overlays = [
            ("Largest principal strain", strain, Scale::from_zero(strained, "", ColorMap::Magma)),
            ("Jacobian determinant", jacobian, change),
            ("Uncertainty", uncertainty, vague),
        ]
        .map(|(name, values, scale)| Layer { name, values, scale });
        let displacements = Layer { name: "Displacement", values: moved, scale: lengths.clone() };
        let histograms = html! {
            @for l in std::iter::once(&displacements).chain(&overlays) {
                (chart::distribution(l.name, l.values, &l.scale, &inside))
            }
            (chart::precision(matches, &precision))
        };
        let moment = Moment {
            name: Some(name),
            images: &images,
            overlays: &overlays,
            bounds: None,
            displacement: Some((displacement, lengths)),
            matches: Some((&matches.matches, precision)),
            mesh: Some(elements(mesh)),
        };
        let (moment, centre) = (moment.pack(grid), centre_of_motion(displacement, mask));
        let extra = self.held.iter().position(|l| !self.regular(l.frame)).filter(|_| !self.regular(frame));
        extra.map(|at| self.held.remove(at));
        self.held.push(Look { frame, mean_mm, centre, moment, histograms });
    }

    /// The frame that moves most.
    fn first(&self) -> Option<&Look> {
        self.held.iter().max_by(|a, b| a.mean_mm.total_cmp(&b.mean_mm))
    }
}

fn gray([low, high]: [f64; 2]) -> Scale {
    Scale { low, high, unit: "", map: ColorMap::Gray }
}

/// The keys are those of docs/reference/file-formats.md.
pub(crate) fn summary(report: &TrackReport<'_>) -> Value {
    let t = report.tracked;
    let each = of_frames(t).map(|(frame, text)| format!("frame {frame}: {text}"));
    let (trust, reasons) = judge_frames(&t.frames, report.judged);
    json!({
        "version": env!("CARGO_PKG_VERSION"),
        "command": "track",
        "inputs": { "volumes": report.names, "mask": report.regions[0], "labels": report.regions[1] },
        "reference": report.reference,
        "step_s": report.step_s,
        "grid": grid(report.grid),
        "frames": t.frames,
        "points": t.trajectories.len(),
        "together": t.together,
        "trust": trust.name(),
        "trust_reasons": reasons,
        "seconds": seconds(report.seconds),
        "warnings": report.warnings.iter().cloned().chain(each).collect::<Vec<_>>(),
        "params": report.params,
    })
}

/// What was found, a few lines.
pub(crate) fn text(report: &TrackReport<'_>) -> String {
    let t = report.tracked;
    let mut out = format!("{}\n", report.headline());
    for f in &t.frames {
        let _ = match &f.lost {
            Some(why) => writeln!(out, "  frame {:<5} lost: {why}", f.frame),
            None => writeln!(
                out,
                "  frame {:<5} mean {:.2} mm, largest {:.2} mm, {} matches, uncertainty {:.2} mm",
                f.frame,
                f.mean_mm,
                f.max_mm,
                thousands(f.counts.kept),
                f.uncertainty_median_mm
            ),
        };
    }
    if let Some(together) = &t.together {
        let _ = writeln!(out, "  together     {}", together.why);
    }
    let (trust, reasons) = judge_frames(&t.frames, report.judged);
    let _ = writeln!(out, "  trust        {}: {}", trust.name(), reasons.join("; "));
    let _ = writeln!(out, "  time         {:.1} s", report.seconds.iter().map(|s| s.1).sum::<f64>());
    out
}

/// What each frame was warned of or lost for, with its number.
fn of_frames(tracked: &Tracked) -> impl Iterator<Item = (usize, &str)> {
    tracked.frames.iter().flat_map(|f| {
        let said = f.warnings.iter().map(String::as_str).chain(f.lost.as_deref());
        said.map(|text| (f.frame, text))
    })
}

/// All that a reader is to be warned of: what the volumes gave rise to, then frame by frame, where
/// what differs in its numbers alone appears once, for the first of the frames.
pub(crate) fn warnings(report: &TrackReport<'_>) -> Vec<String> {
    let wording = |text: &str| -> String { text.chars().filter(|c| !c.is_ascii_digit()).collect() };
    let mut kinds: Vec<(String, &str, Vec<usize>)> = Vec::new();
    for (frame, text) in of_frames(report.tracked) {
        let key = wording(text);
        match kinds.iter_mut().find(|k| k.0 == key) {
            Some((.., frames)) if frames.last() == Some(&frame) => {}
            Some((.., frames)) => frames.push(frame),
            None => kinds.push((key, text, vec![frame])),
        }
    }
    let said = kinds.into_iter().map(|(_, text, frames)| match named(&frames) {
        Some(names) if frames.len() > 1 => format!("{names}: {text} (frame {}; the others alike)", frames[0]),
        _ => format!("frame {}: {text}", frames[0]),
    });
    report.warnings.iter().cloned().chain(said).collect()
}

/// The page.
pub(crate) fn page(report: &TrackReport<'_>) -> String {
    let t = report.tracked;
    let (all, measured) = (t.frames.len(), report.measured().count());
    let (trust, reasons) = judge_frames(&t.frames, report.judged);
    let largest = |f: &dyn Fn(&StrainRow) -> f64| t.strain.iter().map(f).fold(0.0, f64::max);
    let clock: Vec<String> = (0..=all).map(|f| report.clock(f)).collect();
    let title = &report.names[report.reference];
    let heading = html! { (title) " " span { "and " (all) " more" } };
    let head =
        ["Frame", "Volume", "Motion", "Mean, mm", "Largest, mm", "Matches", "Residual, mm", "Uncertainty, mm", "Folds"];
    let body = html! {
        (header(heading, &report.headline(), trusted(trust, &reasons)))
        (tiles([
            (measured.to_string(), "", "frames measured"),
            (short2(t.frames.iter().map(|f| f.max_mm).fold(0.0, f64::max)), "mm", "largest motion"),
            (short2(largest(&|s| s.peak[0])), "", "peak principal strain"),
            (thousands(t.trajectories.len()), "", "points followed"),
            (format!("{:.1}", report.seconds.iter().map(|s| s.1).sum::<f64>()), "s", "total runtime"),
        ]))
        (warned(&warnings(report)))
        section {
            h2 { "The sequence" }
            p.lead {
                "Sections of each frame; the mesh moves with the tissue, its colour is the largest principal strain."
            }
            article.wide { (report.film.player(&clock)) }
        }
        (look(report))
        section {
            h2 { "Over time" }
            p.lead {
                "E1 and E3 are the largest and the smallest principal strain (Green-Lagrange), peaks their 98th and 2nd \
                 percentile; volume is its relative change."
                @if let Some(all) = &t.together { " All frames together: " (all.why) "." }
            }
            div.grid { (curves(report)) }
        }
        section {
            h2 { "Frames" }
            article.wide { (table(&head, t.frames.iter().map(|f| row(&report.names[f.frame], f)))) }
        }
    };
    document(&format!("{title} and {all} more"), &body)
}

/// The line of a frame.
fn row(name: &str, f: &FrameSummary) -> Vec<String> {
    match &f.lost {
        Some(why) => vec![f.frame.to_string(), name.into(), format!("lost: {why}")],
        None => vec![
            f.frame.to_string(),
            name.into(),
            f.model.map_or("", MotionModel::name).into(),
            short2(f.mean_mm),
            short2(f.max_mm),
            thousands(f.counts.kept),
            short2(f.residual_mm),
            short2(f.uncertainty_median_mm),
            f.folds.to_string(),
        ],
    }
}

/// The viewer, where a frame was measured.
fn look(report: &TrackReport<'_>) -> Markup {
    let Some((looks, reference, mask)) = report.look else { return Markup::default() };
    let Some(first) = looks.first() else { return Markup::default() };
    let mut held: Vec<&Look> = looks.held.iter().collect();
    held.sort_by_key(|l| l.frame);
    let values = reference.as_slice();
    let viewer = Viewer {
        grid: report.grid,
        centre: first.centre,
        mask,
        images: &[Layer { name: "reference", values: &|o| values[o], scale: gray(gray_range(reference)) }],
        shown: None,
        moments: &held.iter().map(|l| &l.moment).collect::<Vec<_>>(),
        first: held.iter().position(|l| l.frame == first.frame).unwrap_or_default(),
    };
    let (clock, measured) = (report.clock(first.frame), report.measured().count());
    let held = match held.len() {
        1 if measured > 1 => format!("The frame that moves most, {clock}."),
        n if n < measured => format!("{n} of the {measured} frames, at first the one that moves most, {clock}."),
        _ => format!("Every frame measured, at first the one that moves most, {clock}."),
    };
    html! {
        section {
            h2 { "Look" }
            p.lead {
                (held) " Click or drag in a picture to move the planes, scroll to go through the slices."
            }
            div.grid {
                article.wide { (viewer.html()) }
                article.wide { h3 { "Distributions, " (clock) } div.charts { (first.histograms) } }
            }
        }
    }
}

/// Labels whose strain is drawn in sight; that of the others is folded away below.
const IN_SIGHT: usize = 8;

/// Motion and points over time, and strain of each region.
fn curves(report: &TrackReport<'_>) -> Markup {
    let t = report.tracked;
    let across = if report.step_s.is_some() { "time, s" } else { "frame" };
    let draw = |title: &str, lines: &[Line]| html! { article { (Plot { title, across, marks: &[] }.shown(lines)) } };
    // A lost frame interrupts the lines.
    let frames = |still: f64, f: &dyn Fn(&FrameSummary) -> f64| {
        let value = |s: &FrameSummary| if s.lost.is_some() { f64::NAN } else { f(s) };
        over_time(report, still, t.frames.iter().map(|s| (s.frame, value(s))))
    };
    let displacement = [
        Line::new("mean", 0, false, frames(0.0, &|s| s.mean_mm)),
        Line::new("largest", 1, false, frames(0.0, &|s| s.max_mm)),
        Line::new("uncertainty", 2, true, frames(0.0, &|s| s.uncertainty_median_mm)),
    ];
    let state = |frame: usize, state: PointState| {
        t.trajectories.iter().filter(|p| p.places[frame].is_some_and(|p| p.state == state)).count() as f64
    };
    let all = t.trajectories.len() as f64;
    let points = [
        Line::new("measured", 0, false, frames(all, &|s| state(s.frame, PointState::Measured))),
        Line::new("carried", 1, false, frames(0.0, &|s| state(s.frame, PointState::Carried))),
    ];
    let mut by_label: BTreeMap<u8, Vec<&StrainRow>> = BTreeMap::new();
    t.strain.iter().for_each(|s| by_label.entry(s.label).or_default().push(s));
    let strain = |(label, rows): (&u8, &Vec<&StrainRow>)| {
        let of = |f: &dyn Fn(&StrainRow) -> f64| {
            let lost = t.frames.iter().filter(|f| f.lost.is_some()).map(|f| (f.frame, f64::NAN));
            over_time(report, 0.0, rows.iter().map(|s| (s.frame, f(s))).chain(lost))
        };
        let lines = [
            Line::new("E1 mean", 0, false, of(&|s| s.mean[0])),
            Line::new("E1 peak", 0, true, of(&|s| s.peak[0])),
            Line::new("E3 mean", 1, false, of(&|s| s.mean[2])),
            Line::new("E3 peak", 1, true, of(&|s| s.peak[1])),
            Line::new("volume", 2, false, of(&|s| s.volume_change)),
        ];
        draw(&format!("Strain, label {label}"), &lines)
    };
    let more = by_label.len().saturating_sub(IN_SIGHT);
    html! {
        (draw("Displacement, mm", &displacement))
        (draw("Points", &points))
        @for label in by_label.iter().take(IN_SIGHT) { (strain(label)) }
        @if more > 0 {
            details.wide {
                summary { "Strain of " (more) " more label" @if more > 1 { "s" } }
                div.grid { @for label in by_label.iter().skip(IN_SIGHT) { (strain(label)) } }
            }
        }
    }
}

/// Places of a line by frame; in the reference the value is `still`.
fn over_time(report: &TrackReport<'_>, still: f64, values: impl Iterator<Item = (usize, f64)>) -> Vec<[f64; 2]> {
    let all = values.chain([(report.reference, still)]);
    let mut points: Vec<[f64; 2]> = all.map(|(frame, value)| [report.time(frame), value]).collect();
    points.sort_by(|a, b| a[0].total_cmp(&b[0]));
    points
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::types::{Affine, Counts, Together};

    fn frame(frame: usize, lost: Option<&str>) -> FrameSummary {
        FrameSummary {
            frame,
            lost: lost.map(String::from),
            searched: true,
            counts: Counts::default(),
            model: None,
            mean_mm: 0.5 * frame as f64,
            max_mm: frame as f64,
            residual_mm: 0.1,
            uncertainty_median_mm: 0.1,
            expected_error_mm: 0.1,
            trust: Some(crate::types::Trust::Moderate),
            folds: 0,
            out_of_line: 0.0,
            seconds: 1.0,
            warnings: Vec::new(),
        }
    }

    /// Frames 1 to 4 after the reference, frame 2 lost, with as many labels.
    fn sequence(labels: u8) -> Tracked {
        let row = |frame: usize, label: u8| StrainRow {
            frame,
            label,
            voxels: 9,
            mean: [0.01, 0.0, -0.01],
            peak: [0.02, -0.02],
            shear: [0.01, 0.02],
            volume_change: 0.0,
        };
        let strain = [1, 3, 4].into_iter().flat_map(|f| (1..=labels).map(move |l| row(f, l))).collect();
        let frames = (1..5).map(|f| frame(f, (f == 2).then_some("it is blank"))).collect();
        Tracked { frames, trajectories: Vec::new(), strain, together: None }
    }

    fn told<T>(tracked: &Tracked, tell: impl Fn(&TrackReport<'_>) -> T) -> T {
        let grid = Grid::new([8; 3], Affine::scaled([1.0; 3], [0.0; 3]).unwrap()).unwrap();
        let names: Vec<String> = (0..5).map(|f| format!("frame_{f}.nii")).collect();
        tell(&TrackReport {
            names: &names,
            reference: 0,
            step_s: None,
            grid: &grid,
            regions: ["", ""],
            params: &FieldParams::default(),
            tracked,
            film: &Film::new(&grid, grid.world(4, 4, 4), None, [0.0, 1.0]),
            look: None,
            judged: &[],
            warnings: &[],
            seconds: &[],
        })
    }

    #[test]
    fn all_labels_are_drawn_and_those_past_the_eighth_folded_away() {
        let drawn = |labels: u8| told(&sequence(labels), curves).into_string();
        assert!(!drawn(8).contains("<details"));
        let many = drawn(30);
        let (open, folded) = many.split_once("<details").unwrap();
        assert_eq!([open, folded].map(|part| part.matches("class=\"strong\">Strain, label").count()), [8, 22]);
        assert!(folded.contains("Strain of 22 more labels") && folded.contains("Strain, label 30"));
        assert!(drawn(9).contains("Strain of 1 more label<"));
    }

    #[test]
    fn a_lost_frame_interrupts_the_curves_and_frames_are_whole() {
        let drawn = told(&sequence(1), curves).into_string();
        assert!(!drawn.contains("NaN") && !drawn.contains(">0.5<") && !drawn.contains(">1.5<"), "{drawn}");
        // Frame 0 to 1, and 3 to 4.
        let lines = drawn.split("class=\"line c").skip(1).map(|l| l.split('"').nth(2).unwrap_or_default());
        let drawn: Vec<&str> = lines.filter(|l| !l.contains("h16")).collect();
        assert_eq!(drawn.len(), 3 + 2 + 5);
        assert!(drawn.iter().all(|l| l.matches('M').count() == 2 && l.matches('L').count() == 2), "{drawn:?}");
    }

    #[test]
    fn warnings_that_differ_in_numbers_alone_are_said_once() {
        let mut tracked = sequence(1);
        for (at, said) in [(0, "error of 0.1 mm"), (2, "error of 0.2 mm"), (3, "error of 0.3 mm"), (3, "folds")] {
            tracked.frames[at].warnings.push(said.into());
        }
        let gathered = told(&tracked, warnings);
        assert_eq!(
            gathered,
            ["frames 1, 3, 4: error of 0.1 mm (frame 1; the others alike)", "frame 2: it is blank", "frame 4: folds"]
        );
        // All of them stay in the summary.
        assert_eq!(told(&tracked, summary)["warnings"].as_array().unwrap().len(), 5);
    }

    #[test]
    fn the_verdict_names_what_was_lost() {
        let tracked = sequence(1);
        assert!(
            told(&tracked, page)
                .contains("<b>Trust is moderate</b> expected error at most 0.1 mm in any frame; frame 2 is lost")
        );
        assert!(told(&tracked, text).contains("  trust        moderate: expected"));
    }

    #[test]
    fn what_all_frames_say_together_is_told() {
        let why = "2 courses < 4".to_string();
        let tracked = Tracked { together: Some(Together { modes: Some(2), why }), ..sequence(1) };
        assert!(told(&tracked, text).contains("\n  together     2 courses < 4\n"));
        assert!(told(&tracked, page).contains(" All frames together: 2 courses &lt; 4.</p>"));
        assert_eq!(told(&tracked, summary)["together"]["modes"], 2);
        assert!(!told(&sequence(1), text).contains("together"));
        assert!(told(&sequence(1), summary)["together"].is_null());
    }
}
