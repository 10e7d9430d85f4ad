//! The report of `palpate grasp`: page, summary.json and the short summary.

use crate::report::chart::stage_times;
use crate::report::grasp_scene::{animation, largest_force, moment};
use crate::report::html::{document, header, listed, tiles, titled};
use crate::report::plot::{Line, Plot};
use crate::report::scale::short;
use crate::report::tables::{facts, table};
use crate::types::Scene;
use crate::types::grasp::{Bands, Event, EventKind, GraspRun, MotionRow, Sample, StableStep};
use crate::types::scene::{Method, SweepCase};
use maud::{Markup, PreEscaped, html};
use serde_json::{Map, Value, json};
use std::fmt::Write;

/// A run with what it came from.
#[derive(Debug, Clone, Copy)]
pub struct GraspReport<'a> {
    /// The scene file's name.
    pub name: &'a str,
    /// The scene.
    pub scene: &'a Scene,
    /// What was found.
    pub run: &'a GraspRun,
    /// The same without tangential deformation, or why there is none.
    pub without_tangential: Option<&'a Result<GraspRun, String>>,
    /// Largest stable steps at the postures of the scene.
    pub stable_steps: &'a [StableStep],
    /// What the run may be, by what is known of the tips' moduli.
    pub bands: Option<&'a Bands>,
    /// The ensemble, with the error where a case has no result.
    pub sweep: &'a [(SweepCase, Result<GraspRun, String>)],
    /// Stage names and wall seconds.
    pub seconds: &'a [(String, f64)],
    /// What to know before trusting the result.
    pub warnings: &'a [String],
}

/// An event in one line: time, kind, finger, what.
pub(crate) fn event_line(e: &Event) -> String {
    let finger = e.finger.map_or(String::new(), |f| format!(" of finger {f}"));
    let until = e.until.filter(|u| *u > e.time).map_or(String::new(), |u| format!(" to {u:.3}"));
    format!("{:.3}{until} s: {}{finger}: {}", e.time, e.kind.name(), e.what)
}

/// What happened, in one sentence.
fn headline(report: &GraspReport<'_>) -> String {
    let (run, all) = (report.run, report.scene.motions.len());
    let done = run.motions.iter().filter(|m| m.step > 0).count();
    let last = run.samples.last().map_or(0.0, |s| s.time);
    let motions = match all {
        0 => format!("{} s", short(last)),
        _ => format!("{done} of {all} motions in {} s", short(last)),
    };
    let Some(flaw) = run.flaw() else { return format!("{motions}; the grasp held throughout.") };
    let of_kind = run.events.iter().filter(|e| e.kind == flaw.kind).count();
    let times = if of_kind == 1 { "once".into() } else { format!("{of_kind} times") };
    match flaw.kind {
        kind if kind.ends_run() => format!("{motions}, then the run ended: {}.", event_line(flaw)),
        EventKind::Slip => {
            let far = run.samples.iter().flat_map(|s| s.slip).fold(0.0, |m: f64, v| m.max(v.abs()));
            format!("{motions}; the grasp slipped: tips slid {times}, by up to {:.2} mm.", 1e3 * far)
        }
        EventKind::ValidityRange => format!(
            "{motions}; a tip was pressed out of the model's range {times}, first at {} s: forces from there on are \
             extrapolated.",
            short(flaw.time)
        ),
        _ => format!("{motions}; the object left its branch of equilibria {times}, first at {} s.", short(flaw.time)),
    }
}

/// The stable step of the scene's own method and formulation.
fn own_stable_step(report: &GraspReport<'_>) -> Option<f64> {
    let integrator = &report.scene.integrator;
    let own = |s: &&StableStep| s.method == integrator.method && s.formulation == integrator.formulation;
    report.stable_steps.iter().find(own).map(|s| s.step)
}

/// Least and largest of a quantity over samples.
fn range(samples: &[Sample], value: impl Fn(&Sample) -> f64) -> [f64; 2] {
    samples.iter().map(value).fold([f64::INFINITY, f64::NEG_INFINITY], |r, v| [r[0].min(v), r[1].max(v)])
}

/// What the deviation and the bounds of the moduli come to at the end, in words.
fn bands_words(report: &GraspReport<'_>) -> Option<String> {
    let bands = report.bands?;
    let (low, high) = (bands.low.last()?, bands.high.last()?);
    let [least, most] = bands.factors.iter().fold([1.0f64; 2], |r, f| [r[0].min(*f), r[1].max(*f)]);
    let lost = bands.outcomes.iter().filter(|o| **o != "held").count();
    let lost = match lost {
        0 => String::new(),
        n => format!("; {n} of {} runs with such moduli do not hold", bands.outcomes.len()),
    };
    Some(format!(
        "{:+.0} to {:+.0} %: at the end the object stands at {:.2} to {:.2} degrees, gripped by {:.2} to {:.2} N{lost}",
        100.0 * (least - 1.0),
        100.0 * (most - 1.0),
        low.pose[2].to_degrees(),
        high.pose[2].to_degrees(),
        0.5 * (low.normal_force[0] + low.normal_force[1]),
        0.5 * (high.normal_force[0] + high.normal_force[1])
    ))
}

/// A few lines for a terminal.
pub fn text(report: &GraspReport<'_>) -> String {
    let (scene, run) = (report.scene, report.run);
    let i = &scene.integrator;
    let mut out = format!("{}\n", headline(report));
    let step = match (i.method, own_stable_step(report)) {
        (Method::Adaptive, _) => format!("tolerance {:e}", i.tolerance),
        (_, Some(stable)) => format!("step {} ms, stable to {:.2} ms", short(1e3 * i.step), 1e3 * stable),
        _ => format!("step {} ms", short(1e3 * i.step)),
    };
    let _ = writeln!(
        out,
        "  model        {}, {} form, {}, {step}",
        scene.fingertip.model.name(),
        i.formulation.name(),
        i.method.name()
    );
    let [low, high] = range(&run.samples, |s| s.pose[2].to_degrees());
    let _ = writeln!(out, "  object       turned {low:.2} to {high:.2} degrees");
    let _ = writeln!(out, "  force        up to {:.2} N at a contact", largest_force(&run.samples));
    if let Some(words) = bands_words(report) {
        let _ = writeln!(out, "  moduli       {words}");
    }
    let drift = run.constraint_drift;
    let _ = writeln!(
        out,
        "  drift        energy {}, constraints {} m",
        tiny(run.energy_drift),
        tiny(drift.normal.max(drift.rolling))
    );
    for e in run.events.iter().take(8) {
        let _ = writeln!(out, "  event        {}", event_line(e));
    }
    if !report.sweep.is_empty() {
        let done = report.sweep.iter().filter_map(|(_, r)| r.as_ref().ok()).filter(|r| r.completed);
        let slips = |r: &GraspRun| r.flaw().is_some_and(|e| e.kind == EventKind::Slip);
        let (all, slipped) = done.fold((0, 0), |(all, slipped), r| (all + 1, slipped + usize::from(slips(r))));
        let held = report.sweep.iter().filter(|(_, r)| r.as_ref().is_ok_and(|r| r.flaw().is_none())).count();
        let scenes = report.sweep.len();
        let _ = writeln!(
            out,
            "  sweep        {scenes} scenes, {all} ran to their end, {slipped} of them with slip; {held} held throughout"
        );
    }
    let _ = writeln!(out, "  time         {:.3} s", report.seconds.iter().map(|s| s.1).sum::<f64>());
    out
}

/// Events for summary.json.
pub fn events(run: &GraspRun) -> Value {
    json!(run.events)
}

/// summary.json; the keys are those of docs/reference/file-formats.md.
pub fn summary(report: &GraspReport<'_>) -> Value {
    let (scene, run) = (report.scene, report.run);
    let seconds: Map<String, Value> = report.seconds.iter().map(|(s, t)| (s.clone(), json!(t))).collect();
    let sweep: Vec<Value> = report
        .sweep
        .iter()
        .map(|(case, result)| {
            let values: Map<String, Value> = case.values.iter().map(|(k, v)| (k.clone(), json!(v))).collect();
            match result {
                Ok(run) => json!({
                    "values": values, "completed": run.completed, "outcome": run.outcome(),
                    "required_friction": run.required_friction, "events": events(run),
                }),
                Err(error) => json!({ "values": values, "completed": false, "error": error }),
            }
        })
        .collect();
    json!({
        "version": env!("CARGO_PKG_VERSION"),
        "command": "grasp",
        "inputs": { "scene": report.name },
        "model": scene.fingertip.model,
        "formulation": scene.integrator.formulation,
        "method": scene.integrator.method,
        "step": scene.integrator.step,
        "completed": run.completed,
        "outcome": run.outcome(),
        "required_friction": run.required_friction,
        "moduli": report.bands.map(|b| json!({
            "factors": b.factors, "outcomes": b.outcomes, "end_low": b.low.last(), "end_high": b.high.last(),
        })),
        "simulated_seconds": run.samples.last().map_or(0.0, |s| s.time),
        "steps": run.steps,
        "motions_finished": run.motions.iter().filter(|m| m.step > 0).count(),
        "motions": scene.motions.len(),
        "events": events(run),
        "energy_drift": run.energy_drift,
        "constraint_drift": run.constraint_drift,
        "step_growth": run.step_growth,
        "stable_steps": report.stable_steps,
        "sweep": sweep,
        "seconds": seconds,
        "warnings": report.warnings,
        "scene": scene,
    })
}

/// Lines of one quantity of both fingers, and of the run without tangential deformation dashed.
fn both(report: &GraspReport<'_>, values: &[(&str, &dyn Fn(&Sample) -> f64)]) -> Vec<Line> {
    let mut lines = Vec::new();
    if let Some(bands) = report.bands {
        let step = bands.low.len().div_ceil(400).max(1);
        for (colour, (_, value)) in values.iter().enumerate() {
            let both = bands.low.iter().zip(&bands.high).step_by(step);
            let between: Vec<[f64; 3]> = both.map(|(l, h)| [l.time, value(l), value(h)]).collect();
            lines.push(Line::band("", colour, &between));
        }
    }
    let other = report.without_tangential.and_then(|r| r.as_ref().ok());
    for (dashed, run) in [(true, other), (false, Some(report.run))] {
        let Some(run) = run else { continue };
        let step = run.samples.len().div_ceil(1500).max(1);
        for (colour, (name, value)) in values.iter().enumerate() {
            let points = run.samples.iter().step_by(step).map(|s| [s.time, value(s)]).collect();
            lines.push(Line::new(if dashed { "" } else { name }, colour, dashed, points));
        }
    }
    lines
}

/// Time plots, with motions and events marked.
pub(super) fn time_plots(report: &GraspReport<'_>) -> Markup {
    let mut marks: Vec<(f64, bool)> = report.run.motions.iter().map(|m| (m.reached.time, false)).collect();
    marks.extend(report.run.events.iter().map(|e| (e.time, true)));
    let plot = |title: &str, lines: &[Line]| Plot { title, across: "s", marks: &marks }.shown(lines);
    let mm = |v: f64| 1e3 * v;
    let pose: [(&str, &[(&str, &dyn Fn(&Sample) -> f64)]); 2] = [
        ("Object's angle, degrees", &[("theta", &|s| s.pose[2].to_degrees())]),
        (
            "Object's place, mm",
            &[("x", &|s| mm(s.pose[0])), ("y + link", &|s| mm(s.pose[1] + report.scene.finger.link))],
        ),
    ];
    let of_fingers: [(&str, &dyn Fn(&Sample, usize) -> f64); 5] = [
        ("Joint angles, degrees", &|s, i| s.joints[i].to_degrees()),
        ("Normal displacement, mm", &|s, i| mm(s.normal[i])),
        ("Tangential displacement, mm", &|s, i| mm(s.tangential[i])),
        ("Normal force, N", &|s, i| s.normal_force[i]),
        ("Tangential force, N", &|s, i| s.tangential_force[i]),
    ];
    let fingers = |value: &dyn Fn(&Sample, usize) -> f64| {
        both(report, &[("finger 1", &|s| value(s, 0)), ("finger 2", &|s| value(s, 1))])
    };
    let mut friction = both(report, &[("needed", &|s| s.required_friction)]);
    if let (Some(given), Some(last)) = (report.scene.object.friction, report.run.samples.last()) {
        friction.push(Line::new("given", 1, false, vec![[0.0, given], [last.time, given]]));
    }
    html! {
        @for (title, values) in pose { (plot(title, &both(report, values))) }
        @for (title, value) in of_fingers { (plot(title, &fingers(value))) }
        (plot("Coefficient of friction", &friction))
        @if report.run.samples.iter().any(|s| s.slip != [0.0; 2]) {
            (plot("Slip along the face, mm", &fingers(&|s, i| mm(s.slip[i]))))
        }
    }
}

/// The table of motions.
fn motions(run: &GraspRun) -> Markup {
    let head = [
        "Motion",
        "theta 1, deg",
        "theta 2, deg",
        "x, mm",
        "y, mm",
        "theta, deg",
        "d_n1, mm",
        "d_n2, mm",
        "d_t1, mm",
        "d_t2, mm",
        "f_n1, N",
        "f_n2, N",
        "f_t1, N",
        "f_t2, N",
    ];
    let row = |m: &MotionRow| {
        let s = &m.reached;
        let mut row = vec![if m.step == 0 { "rest".into() } else { m.step.to_string() }];
        row.extend(m.target.map(degrees));
        let ([x, y, theta], [n1, n2], [t1, t2]) = (s.pose, s.normal, s.tangential);
        row.extend([1e3 * x, 1e3 * y, theta.to_degrees()].map(fixed2));
        row.extend([n1, n2, t1, t2].map(|v| fixed3(1e3 * v)));
        row.extend(s.normal_force.into_iter().chain(s.tangential_force).map(fixed2));
        row
    };
    table(&head, run.motions.iter().map(row))
}

/// A joint angle (rad) in degrees, as it was given.
pub(super) fn degrees(v: f64) -> String {
    short((v.to_degrees() * 1e6).round() / 1e6)
}

/// A small number by its size.
fn tiny(v: f64) -> String {
    if v == 0.0 { "0".into() } else { format!("{v:.0e}") }
}

/// Two digits after the point, no minus before zero.
pub(super) fn fixed2(v: f64) -> String {
    let s = format!("{v:.2}");
    if s == "-0.00" { "0.00".into() } else { s }
}

fn fixed3(v: f64) -> String {
    let s = format!("{v:.3}");
    if s == "-0.000" { "0.000".into() } else { s }
}

/// Largest stable steps as a table.
pub(super) fn steps_table(steps: &[StableStep]) -> Markup {
    let row = |s: &StableStep| [s.method.name().into(), s.formulation.name().into(), format!("{:.2}", 1e3 * s.step)];
    table(&["Integrator", "Form", "Largest stable step, ms"], steps.iter().map(row))
}

/// The page.
pub fn page(report: &GraspReport<'_>) -> String {
    let (scene, run) = (report.scene, report.run);
    let (class, word) = match run.flaw().map(|e| e.kind) {
        None => ("high", "held"),
        Some(kind) if kind.ends_run() => ("low", "ended early"),
        Some(EventKind::Slip) => ("low", "slipped"),
        Some(EventKind::ValidityRange) => ("moderate", "out of range"),
        Some(_) => ("moderate", "off its branch"),
    };
    let held = html! { p class={ "trust " (class) } { b { (word) } } };
    let [low, high] = range(&run.samples, |s| s.pose[2].to_degrees());
    let simulated = run.samples.last().map_or(0.0, |s| s.time);
    let stable = own_stable_step(report).map_or("-".into(), |s| format!("{:.1}", 1e3 * s));
    let events = run.events.iter().map(event_line).chain(report.warnings.iter().cloned());
    let body = html! {
        (header(titled(report.name, "grasp"), &headline(report), held))
        (tiles([
            (short(simulated), "s", "simulated"),
            (format!("{low:.0} to {high:.0}"), "deg", "turn of the object"),
            (format!("{:.1}", largest_force(&run.samples)), "N", "largest contact force"),
            (tiny(run.energy_drift), "", "energy drift"),
            (tiny(run.constraint_drift.normal.max(run.constraint_drift.rolling)), "m", "constraint drift"),
            (stable, "ms", "largest stable step"),
        ]))
        (listed("Events and warnings", &events.take(40).collect::<Vec<_>>()))
        @if !report.sweep.is_empty() { (ensemble(report.sweep)) }
        section {
            h2 { "The grasp" }
            p.lead {
                "Arrows are the contact forces on the object; the line is the path of its centre."
            }
            div.grid {
                article { (animation(scene, &run.samples)) }
                article {
                    h3 { "Postures reached" }
                    p { "At the end of each hold, with the desired joint angles." }
                    (postures(scene, run))
                }
            }
        }
        section {
            h2 { "Over time" }
            p.lead {
                (beside(report))
                @if let Some(words) = bands_words(report) { " Shaded: moduli of the tips " (words) "." }
                " Upright lines: ends of motions; red: events."
            }
            div.plots { (time_plots(report)) }
        }
        section {
            h2 { "Numbers" }
            div.grid {
                article.wide { h3 { "Motions" } (motions(run)) }
                article { h3 { "Scene" } (scene_table(scene)) }
                article {
                    h3 { "Stable steps" }
                    p { "At the start and at all postures of the scene." }
                    (steps_table(report.stable_steps))
                }
                article { h3 { "Time" } (stage_times(report.seconds)) }
            }
        }
        footer {
            p {
                "SI units; angles counter-clockwise but for joint 2, so that a positive angle closes either finger. d_n and d_t \
                 are the displacements of a tip along the face's normal and tangent. The object's pose is never fed back to the \
                 joints."
            }
        }
    };
    document(&format!("{} grasp", report.name), &body)
}

/// Drawings of the grasp at the end of each motion.
fn postures(scene: &Scene, run: &GraspRun) -> Markup {
    let largest = largest_force(&run.samples);
    html! {
        div.postures {
            @for m in &run.motions {
                @let [a, b] = m.target.map(degrees);
                div {
                    (PreEscaped(moment(scene, &m.reached, largest, &[])))
                    span { @if m.step == 0 { "rest" } @else { (m.step) ": " (a) "°, " (b) "°" } }
                }
            }
        }
    }
}

/// How the scene without tangential deformation went, where that was asked for.
fn beside(report: &GraspReport<'_>) -> String {
    match report.without_tangential {
        Some(Ok(other)) => match other.events.iter().find(|e| e.kind.ends_run()) {
            Some(e) => {
                format!("Dashed: the same scene without tangential deformation; that run ended at {}.", event_line(e))
            }
            None => "Dashed: the same scene without tangential deformation.".into(),
        },
        Some(Err(error)) => format!("Without tangential deformation the scene has no result: {error}."),
        None => String::new(),
    }
}

/// One case of an ensemble with its result.
type Case = (SweepCase, Result<GraspRun, String>);

/// Cases that the table shows at most.
const SHOWN: usize = 200;
/// Bars of a histogram.
const BARS: usize = 30;

/// How bad a case went: what has no result first, then what ended early by its time, then the least
/// friction left.
fn badness(case: &Case) -> (u8, f64) {
    let result = &case.1;
    match result {
        Err(_) => (0, 0.0),
        Ok(run) => match run.flaw() {
            Some(e) if e.kind.ends_run() => (1, e.time),
            Some(e) => (if e.kind == EventKind::Slip { 2 } else { 3 }, -run.required_friction),
            None => (4, -run.required_friction),
        },
    }
}

/// How a case went, in words.
fn outcome_words(result: &Result<GraspRun, String>) -> String {
    match result {
        Ok(run) => run.flaw().map_or("held".into(), event_line),
        Err(error) => error.clone(),
    }
}

/// The values of a case, in words.
fn values_words(case: &SweepCase) -> String {
    case.values.iter().map(|(k, v)| format!("{k} = {v}")).collect::<Vec<_>>().join(", ")
}

/// How many cases went each way, the most frequent first.
pub fn counts(sweep: &[Case]) -> Vec<(String, usize)> {
    let mut out: Vec<(String, usize)> = Vec::new();
    for (_, result) in sweep {
        let name = result.as_ref().map_or("refused", GraspRun::outcome);
        match out.iter_mut().find(|c| c.0 == name) {
            Some(c) => c.1 += 1,
            None => out.push((name.into(), 1)),
        }
    }
    out.sort_by(|a, b| b.1.cmp(&a.1).then_with(|| a.0.cmp(&b.0)));
    out
}

/// A histogram of `value`, of the cases that held and of those that did not.
fn histogram(title: &str, across: &str, sweep: &[Case], value: impl Fn(&GraspRun) -> Option<f64>) -> Markup {
    let all: Vec<(f64, bool)> = sweep
        .iter()
        .filter_map(|(_, r)| r.as_ref().ok())
        .filter_map(|run| Some((value(run).filter(|v| v.is_finite())?, run.flaw().is_none())))
        .collect();
    let [low, high] = all.iter().fold([f64::INFINITY, f64::NEG_INFINITY], |r, v| [r[0].min(v.0), r[1].max(v.0)]);
    if all.is_empty() {
        return Markup::default();
    }
    let room = if high > low { 0.0 } else { 0.5 * high.abs().max(1e-9) };
    let (low, high) = (low - room, high + room);
    let wide = (high - low) / BARS as f64;
    let mut lines = Vec::new();
    for (name, colour, held) in [("held", 2, true), ("did not hold", 1, false)] {
        let mut bars = [0usize; BARS];
        for (v, _) in all.iter().filter(|v| v.1 == held) {
            bars[(((v - low) / wide) as usize).min(BARS - 1)] += 1;
        }
        if bars.iter().all(|n| *n == 0) {
            continue;
        }
        let steps =
            bars.iter().enumerate().flat_map(|(i, n)| [i, i + 1].map(|k| [low + k as f64 * wide, 0.0, *n as f64]));
        lines.push(Line::band(name, colour, &steps.collect::<Vec<_>>()));
    }
    Plot { title, across, marks: &[] }.shown(&lines)
}

/// The ensemble: what share holds, how the results lie, and the worst case.
fn ensemble(sweep: &[Case]) -> Markup {
    let all = sweep.len();
    let held = sweep.iter().filter(|(_, r)| r.as_ref().is_ok_and(|r| r.flaw().is_none())).count();
    let most = |run: &GraspRun| run.samples.last().map(|s| 0.5 * (s.normal_force[0] + s.normal_force[1]));
    let turn = |run: &GraspRun| run.samples.last().map(|s| s.pose[2].to_degrees());
    let mut order: Vec<&Case> = sweep.iter().collect();
    order.sort_by(|a, b| badness(a).partial_cmp(&badness(b)).unwrap_or(std::cmp::Ordering::Equal));
    let worst = order.first().map_or(String::new(), |(case, result)| {
        format!("The worst: {}: {}.", values_words(case), outcome_words(result))
    });
    let counts = counts(sweep);
    let shares =
        counts.iter().take(5).map(|(name, n)| (format!("{:.1}", 100.0 * *n as f64 / all as f64), "%", &**name));
    let varied = sweep.first().map_or(&[][..], |(case, _)| &case.values);
    let mut head: Vec<&str> = varied.iter().map(|v| v.0.as_str()).collect();
    head.extend(["Outcome", "Motions", "theta, deg", "f_n, N", "f_t, N", "Friction needed"]);
    order.truncate(SHOWN);
    let rows = order.iter().map(|(case, result)| {
        let mut row: Vec<String> = case.values.iter().map(|v| v.1.to_string()).collect();
        row.push(outcome_words(result));
        let run = result.as_ref().ok();
        let last = run.and_then(|r| r.samples.last());
        let cell = |v: Option<f64>| v.map_or("-".into(), fixed2);
        row.push(run.map_or("0".into(), |r| r.motions.iter().filter(|m| m.step > 0).count().to_string()));
        row.push(cell(last.map(|s| s.pose[2].to_degrees())));
        row.push(cell(last.map(|s| s.normal_force[0].max(s.normal_force[1]))));
        row.push(cell(last.map(|s| s.tangential_force[0].abs().max(s.tangential_force[1].abs()))));
        row.push(cell(run.map(|r| r.required_friction)));
        row
    });
    html! {
        section {
            h2 { "Ensemble" }
            p.lead { (held) " of " (all) " runs held throughout. " (worst) }
            (tiles(shares))
            div.plots {
                (histogram("Object's angle at the end, runs", "degrees", sweep, turn))
                (histogram("Grip at the end, runs", "N", sweep, most))
                (histogram("Friction needed, runs", "coefficient", sweep, |r| Some(r.required_friction)))
            }
            details {
                summary { "The worst " (order.len()) " of " (all) " runs (all are in sweep.csv)" }
                (table(&head, rows))
            }
        }
    }
}

/// What the scene says.
pub(super) fn scene_table(scene: &Scene) -> Markup {
    let (tip, gains, object, i) = (&scene.fingertip, &scene.finger.gains, &scene.object, &scene.integrator);
    let mm = |v: f64| format!("{} mm", short(1e3 * v));
    // One value for fingers that are alike, both for others.
    let each = |pair: &[String; 2]| if pair[0] == pair[1] { pair[0].clone() } else { pair.join(" and ") };
    let radii = scene.fingertips().map(|t| mm(t.radius));
    let moduli = scene.fingertips().map(|t| format!("{} kPa", short(t.youngs_modulus / 1e3)));
    let links = scene.fingers().map(|f| mm(f.upper.unwrap_or(0.0) + f.link));
    let times: Vec<String> = tip.branches().iter().map(|b| format!("{} in {} s", short(b[0]), short(b[1]))).collect();
    let relaxation = if times.is_empty() { "none".into() } else { format!("parts of E: {}", times.join(", ")) };
    facts([
        ("Fingertip", format!("{}, radius {}, E {}", tip.model.name(), each(&radii), each(&moduli))),
        ("Damping", format!("{} and {} N s/m", short(tip.damping[0]), short(tip.damping[1]))),
        ("Relaxation", relaxation),
        ("Link, half span", format!("{}, {}", each(&links), mm(scene.half_span()))),
        ("Object", format!("{} x {}, {} kg", mm(object.width), mm(object.height), short(object.mass))),
        ("Friction", object.friction.map_or("without limit".into(), short)),
        ("First displacement", mm(scene.initial.normal_displacement)),
        ("Gains", format!("{}, {}, {}", short(gains.kp), short(gains.kd), short(gains.ki))),
        ("Integrator", format!("{}, {} form, step {} ms", i.method.name(), i.formulation.name(), short(1e3 * i.step))),
    ])
}
