//! The report of `palpate grasp-analysis`: page, summary.json and the short summary.

use crate::error::ReportError;
use crate::report::chart::stage_times;
use crate::report::grasp::{GraspReport, degrees, event_line, fixed2, scene_table, steps_table, time_plots};
use crate::report::grasp_measured::{fitted_words, measured};
use crate::report::grasp_scene::animation;
use crate::report::grasp_surface::{pinch_map, state_colour, state_words, surface};
use crate::report::html::{document, header, listed, tiles, titled};
use crate::report::plot::{Line, Plot};
use crate::report::scale::short;
use crate::report::tables::table;
use crate::types::grasp::{
    EnergySurface, Freedom, GraspAnalysis, Hold, PinchState, PostureForce, Stability, StabilityRow,
};
use crate::types::measured::{MeasuredFit, Measurements};
use crate::types::{FingertipModel, Scene};
use maud::{Markup, PreEscaped, html};
use serde_json::{Map, Value, json};
use std::fmt::Write;

/// An analysis with what it came from.
#[derive(Debug, Clone, Copy)]
pub(crate) struct AnalysisReport<'a> {
    /// The scene file's name.
    pub name: &'a str,
    /// The scene.
    pub scene: &'a Scene,
    /// The scene of the push: joints fixed.
    pub pushed: &'a Scene,
    /// What was found.
    pub analysis: &'a GraspAnalysis,
    /// Measurements with the models fitted to them.
    pub measured: Option<(&'a Measurements, &'a MeasuredFit)>,
    /// Stage names and wall seconds.
    pub seconds: &'a [(String, f64)],
}

/// Rows of one model with one hold.
fn of(analysis: &GraspAnalysis, model: FingertipModel, hold: Hold) -> impl Iterator<Item = &StabilityRow> {
    analysis.stability.iter().filter(move |r| r.model == model && r.hold == hold)
}

/// How many rows of a model with a hold are of a class.
fn count(analysis: &GraspAnalysis, model: FingertipModel, hold: Hold, class: Stability) -> usize {
    of(analysis, model, hold).filter(|r| r.class == class).count()
}

/// What the stationary poses of a model with a hold are, in words.
fn classes(analysis: &GraspAnalysis, model: FingertipModel, hold: Hold) -> String {
    let words = [
        (Stability::Minimum, "a minimum"),
        (Stability::Neutral, "neutral"),
        (Stability::Saddle, "a saddle"),
        (Stability::Maximum, "a maximum"),
        (Stability::None, "not to be found nearby"),
    ];
    let all = of(analysis, model, hold).count();
    let some = words.into_iter().map(|(class, word)| (count(analysis, model, hold, class), word)).filter(|w| w.0 > 0);
    let parts: Vec<String> = some.map(|(n, word)| format!("{word} at {n}")).collect();
    format!("{} of {all}", parts.join(", "))
}

/// Cells of the pinch map in a state, as a part of all.
fn share(analysis: &GraspAnalysis, state: PinchState) -> f64 {
    let cells = &analysis.pinch.cells;
    cells.iter().filter(|c| c.state == state).count() as f64 / cells.len().max(1) as f64
}

/// In one sentence.
fn headline(report: &AnalysisReport<'_>) -> String {
    let a = report.analysis;
    let [parallel, radial] = [FingertipModel::Parallel, FingertipModel::Radial];
    let all = of(a, parallel, Hold::Friction).count();
    format!(
        "The parallel model has a minimum of energy at {} of {} postures; the radial one, held by friction, is {}, and without \
         friction and weight {}.",
        count(a, parallel, Hold::Friction, Stability::Minimum),
        all + a.lost.len(),
        classes(a, radial, Hold::Friction),
        classes(a, radial, Hold::Weightless)
    )
}

/// Largest turn under the push (degrees), and what is left of it at the end.
fn push_turn(analysis: &GraspAnalysis) -> (f64, f64) {
    let samples = &analysis.push.samples;
    let first = samples.first().map_or(0.0, |s| s.pose[2]);
    let off = |s: &crate::types::grasp::Sample| (s.pose[2] - first).abs().to_degrees();
    (samples.iter().map(off).fold(0.0, f64::max), samples.last().map_or(0.0, off))
}

/// How the push went, in words.
fn push_words(analysis: &GraspAnalysis, friction: bool) -> String {
    let (most, left) = push_turn(analysis);
    match analysis.push.events.first() {
        Some(e) => format!("turned up to {most:.2} degrees; {}", event_line(e)),
        None => {
            let slip = if friction { "without slip" } else { "(slip is not checked: no object.friction)" };
            format!("turned up to {most:.2} degrees {slip} and came back to within {left:.1e} degrees")
        }
    }
}

/// A few lines for a terminal.
pub fn text(report: &AnalysisReport<'_>) -> String {
    let a = report.analysis;
    let mut out = format!("{}\n", headline(report));
    for (step, reason) in &a.lost {
        let _ = writeln!(out, "  motion {step}     cannot be reached: {reason}");
    }
    for f in a.freedom.iter().filter(|f| f.joints == [1, 1]) {
        let _ = writeln!(
            out,
            "  {:<15} {} degrees of freedom; two joint angles set {}",
            f.model.name(),
            f.freedom,
            f.controls()
        );
    }
    let _ = writeln!(out, "  push         {}", push_words(a, report.scene.object.friction.is_some()));
    let _ = writeln!(
        out,
        "  pinch map    {:.0} % of the joint angles to {:.0} degrees hold",
        100.0 * share(a, PinchState::Good),
        a.pinch.angles.last().map_or(0.0, |v| v.to_degrees())
    );
    if let Some((_, fit)) = report.measured {
        let _ = writeln!(out, "  measured     {}", fit.verdict());
        for model in &fit.models {
            let _ = writeln!(out, "    {:<15} {}", model.model, fitted_words(model));
        }
    }
    let _ = writeln!(out, "  time         {:.2} s", report.seconds.iter().map(|s| s.1).sum::<f64>());
    out
}

/// summary.json; the keys are those of docs/reference/file-formats.md.
pub fn summary(report: &AnalysisReport<'_>) -> Value {
    let a = report.analysis;
    let seconds: Map<String, Value> = report.seconds.iter().map(|(s, t)| (s.clone(), json!(t))).collect();
    let states: Map<String, Value> =
        PinchState::ALL.iter().map(|s| (s.name().to_string(), json!(share(a, *s)))).collect();
    let freedom: Vec<Value> = a
        .freedom
        .iter()
        .map(|f| {
            let mut value = json!(f);
            value["controls"] = json!(f.controls());
            value["torque_controls"] = json!(f.torque_controls());
            value
        })
        .collect();
    let lost: Vec<Value> = a.lost.iter().map(|(step, why)| json!({ "step": step, "reason": why })).collect();
    let (most, left) = push_turn(a);
    json!({
        "version": env!("CARGO_PKG_VERSION"),
        "command": "grasp-analysis",
        "inputs": { "scene": report.name },
        "stability": a.stability,
        "lost": lost,
        "freedom": freedom,
        "pinch_map": states,
        "push": { "events": a.push.events, "turn_deg": most, "left_deg": left, "energy_drift": a.push.energy_drift },
        "measured": report.measured.map(|m| m.1),
        "stable_steps": a.stable_steps,
        "seconds": seconds,
        "scene": report.scene,
    })
}

/// Force against displacement, and against tilt.
fn force_plots(f: &PostureForce) -> Markup {
    let across = f.tilts.len();
    let tilt_at = |degrees: f64| (0..across).min_by_key(|&i| ((f.tilts[i].to_degrees() - degrees).abs() * 1e6) as u64);
    let mut against_d = Vec::new();
    let mut against_tilt = Vec::new();
    for (colour, degrees) in [0.0, 20.0, 40.0].into_iter().enumerate() {
        let Some(i) = tilt_at(degrees) else { continue };
        let points = |values: &[f64]| -> Vec<[f64; 2]> {
            (0..f.displacements.len()).map(|j| [1e3 * f.displacements[j], values[j * across + i]]).collect()
        };
        against_d.push(Line::new(&format!("{degrees} deg"), colour, false, points(&f.parallel)));
        if colour == 0 {
            continue;
        }
        against_d.push(Line::new("", colour, true, points(&f.radial)));
    }
    for (colour, row) in [10, 20, 30].into_iter().filter(|r| *r < f.displacements.len()).enumerate() {
        let name = format!("{} mm", short(1e3 * f.displacements[row]));
        let points = |values: &[f64]| -> Vec<[f64; 2]> {
            (0..across).map(|i| [f.tilts[i].to_degrees(), values[row * across + i]]).collect()
        };
        against_tilt.push(Line::new(&name, colour, false, points(&f.parallel)));
        against_tilt.push(Line::new("", colour, true, points(&f.radial)));
    }
    html! {
        (Plot { title: "Force against displacement, N", across: "d, mm", marks: &[] }.shown(&against_d))
        (Plot { title: "Force against tilt, N", across: "tilt, degrees", marks: &[] }.shown(&against_tilt))
    }
}

/// Stationary poses and Hessians as a table.
fn stability_table(rows: &[StabilityRow]) -> Markup {
    let head = [
        "Posture",
        "theta 1, 2, deg",
        "Along the face",
        "Model",
        "Stationary pose, mm from the parallel equilibrium",
        "Eigenvalues, N/m",
        "Force left, N",
        "It is",
    ];
    let cells = |r: &StabilityRow| {
        let [a, b] = r.joints.map(degrees);
        let eigenvalues: Vec<String> = r.eigenvalues.iter().map(|v| short((v * 10.0).round() / 10.0)).collect();
        [
            if r.step == 0 { "pinch".into() } else { r.step.to_string() },
            format!("{a}, {b}"),
            r.hold.name().replace("-weightless", ", weightless"),
            r.model.name().into(),
            r.distance.map_or("none within a radius".into(), |d| fixed2(1e3 * d)),
            eigenvalues.join(", "),
            r.residual.map_or("-".into(), |v| format!("{v:.0e}")),
            if r.class == Stability::None { "-".into() } else { r.class.name().into() },
        ]
    };
    table(&head, rows.iter().map(cells))
}

fn freedom_table(rows: &[Freedom]) -> Markup {
    let head = [
        "Tips",
        "Joints that move",
        "Coordinates",
        "Rank",
        "Degrees of freedom",
        "of the object, joints locked",
        "Contact forces",
        "Stays at locked joints",
        "Joint angles set",
        "Joint torques set",
    ];
    let cells = |f: &Freedom| {
        let numbers = [f.coordinates, f.rank, f.freedom, f.object_freedom, f.contact_forces];
        let mut row = vec![f.model.name().to_string(), f.hand()];
        row.extend(numbers.map(|n| n.to_string()));
        row.extend([if f.stable { "yes" } else { "no" }, f.controls(), f.torque_controls()].map(String::from));
        row
    };
    table(&head, rows.iter().map(cells))
}

/// The table of the source: rigid against soft tips on fingers of 1+1 and 1+2 joints.
fn short_freedom_table(rows: &[Freedom]) -> Markup {
    let head = ["Tips, joints", "Grasp stable", "Posture and grasp by angles", "by torques"];
    let yes = |v: bool| if v { "yes" } else { "no" }.to_string();
    let shown = [FingertipModel::Rigid, FingertipModel::Parallel]
        .into_iter()
        .flat_map(|m| rows.iter().filter(move |f| f.model == m && f.fingers == 2));
    let cells = |f: &Freedom| {
        let name = if f.model == FingertipModel::Rigid { "rigid" } else { "soft" };
        [format!("{name}, {}", f.hand()), yes(f.stable), yes(f.both_rank == 2), yes(f.torque_rank == 2)]
    };
    table(&head, shown.map(cells))
}

/// The energy of both models at a posture along an axis, and the largest there is (J).
fn energies<'a>(a: &'a GraspAnalysis, step: usize, axis: &str) -> (Vec<&'a EnergySurface>, f64) {
    let both: Vec<_> = a.surfaces.iter().filter(|s| s.step == step && s.axis == axis).collect();
    let finite = both.iter().flat_map(|s| &s.energy).filter(|e| e.is_finite());
    let largest = finite.fold(1e-12, |l: f64, e| l.max(e.abs()));
    (both, largest)
}

/// The surfaces of one posture: parallel and radial side by side.
fn surface_card(a: &GraspAnalysis, step: usize) -> Result<Markup, ReportError> {
    let title = match a.stability.iter().find(|r| r.step == step) {
        Some(r) if step > 0 => {
            let [p, q] = r.joints.map(degrees);
            format!("Motion {step}: {p} and {q} degrees")
        }
        _ => "Pinch".into(),
    };
    let classes: Vec<String> = a
        .stability
        .iter()
        .filter(|r| r.step == step && r.hold == Hold::Friction)
        .map(|r| {
            let lowest = r.eigenvalues.first().map_or("none".into(), |v| format!("{} N/m", fixed2(*v)));
            format!("{}: {} ({lowest})", r.model.name(), r.class.name())
        })
        .collect();
    Ok(html! {
        article {
            h3 { (title) }
            p { "With friction, smallest eigenvalue at the equilibrium of each model: " (classes.join("; ")) "." }
            div.surfaces {
                @for (both, largest) in ["y", "x"].map(|axis| energies(a, step, axis)) {
                    @for s in both {
                        div {
                            (PreEscaped(surface(s, largest)?))
                            span { (s.model.name()) ", to " (short(1e3 * largest)) " mJ" }
                        }
                    }
                }
            }
        }
    })
}

/// The pinch and the scene's motions, with their joint angles (rad).
fn postures(scene: &Scene) -> Vec<(usize, [f64; 2])> {
    let motions = scene.motions.iter().enumerate().map(|(i, m)| (i + 1, m.target));
    std::iter::once((0, [0.0; 2])).chain(motions).collect()
}

/// The first screen: the push with joints fixed, the energy of both models at one posture, rigid
/// against soft tips, and the pinch map.
fn at_a_glance(report: &AnalysisReport<'_>) -> Result<Markup, ReportError> {
    let a = report.analysis;
    let samples = &a.push.samples;
    let first = samples.first().map_or(0.0, |s| s.pose[2]);
    let turn = samples.iter().map(|s| [s.time, (s.pose[2] - first).to_degrees()]).collect();
    let marks: Vec<(f64, bool)> =
        report.pushed.pushes.iter().flat_map(|p| [(p.start, false), (p.start + p.duration, false)]).collect();
    let push = Plot { title: "Turn under the push, degrees", across: "s", marks: &marks }
        .shown(&[Line::new("theta", 0, false, turn)]);
    // Where both models have the most of their range in view, of two that have the same the later.
    let seen = |step: usize| {
        let of = a.surfaces.iter().filter(|s| s.step == step && s.axis == "y");
        of.flat_map(|s| &s.energy).filter(|e| e.is_finite()).count()
    };
    let step = a.surfaces.iter().map(|s| s.step).max_by_key(|step| seen(*step)).unwrap_or(0);
    let (both, largest) = energies(a, step, "y");
    Ok(html! {
        section {
            div.glance {
                article {
                    h3 { "A push with both joints fixed" }
                    (push)
                    p { "The object " (push_words(a, report.scene.object.friction.is_some())) "." }
                }
                article {
                    h3 { "Energy about " @if step == 0 { "the pinch" } @else { "motion " (step) } }
                    div.surfaces {
                        @for s in both { div { (PreEscaped(surface(s, largest)?)) span { (s.model.name()) } } }
                    }
                }
                article { h3 { "Rigid and soft tips" } (short_freedom_table(&a.freedom)) }
                article {
                    h3 { "Which joint angles hold" }
                    (PreEscaped(pinch_map(&a.pinch, &postures(report.scene))))
                }
            }
        }
    })
}

/// The page.
///
/// # Errors
/// [`ReportError`] when a picture cannot be encoded.
pub fn page(report: &AnalysisReport<'_>) -> Result<String, ReportError> {
    let a = report.analysis;
    let (most, left) = push_turn(a);
    let minima = count(a, FingertipModel::Parallel, Hold::Friction, Stability::Minimum);
    let lost: Vec<String> = a.lost.iter().map(|(n, why)| format!("Motion {n}: {why}")).collect();
    let body = html! {
        (header(titled(report.name, "grasp analysis"), &headline(report), ""))
        (tiles([
            (minima.to_string(), "", "stable postures, parallel tips"),
            (format!("{:.0}", 100.0 * share(a, PinchState::Good)), "%", "of the pinch map holds"),
            (format!("{most:.2}"), "°", "turn under the push"),
            (format!("{left:.0e}"), "°", "left after it"),
        ]))
        (listed("Not reached from the pinch", &lost))
        (at_a_glance(report)?)
        @if let Some((measurements, fit)) = report.measured { (measured(measurements, fit)) }
        section {
            h2 { "Force depends on posture" }
            p.lead {
                "Along the back plate's normal. Lines: springs in parallel; dashed: springs along radii, which do not depend on posture."
            }
            div.plots { (force_plots(&a.force)) }
        }
        section {
            h2 { "Energy about the postures" }
            p.lead {
                "Joints fixed, tips and gravity, less the energy at the posture (the cross). Red is more, blue is less, in \
                 bands even in the square root; gray is out of the model's range. Eigenvalues belong to (x, y, radius times theta)."
            }
            div.grid {
                article.wide {
                    details {
                        summary { "Stationary poses and Hessians of both models, with friction and without" }
                        (stability_table(&a.stability))
                    }
                }
                @for row in of(a, FingertipModel::Parallel, Hold::Friction) { (surface_card(a, row.step)?) }
            }
        }
        (holding(report))
        (push(report))
        section {
            h2 { "Numbers" }
            div.grid {
                article {
                    h3 { "Stable steps" }
                    p { "At the pinch and at all postures of the scene." }
                    (steps_table(&a.stable_steps))
                }
                article { h3 { "Time" } (stage_times(report.seconds)) }
            }
        }
        footer {
            p {
                "Each model is judged at its own stationary pose next to the parallel model's equilibrium. Without friction \
                 nothing carries the weight: both faces push along one line, so there is no such pose unless the weight is left \
                 out too."
            }
        }
    };
    Ok(document(&format!("{} grasp analysis", report.name), &body))
}

/// Which postures hold, and what the joints can set.
fn holding(report: &AnalysisReport<'_>) -> Markup {
    let a = report.analysis;
    html! {
        section {
            h2 { "Which postures hold" }
            div.grid {
                article {
                    h3 { "Pinch map" }
                    p { "Reached from the pinch step by step; numbers are the scene's motions." }
                    (PreEscaped(pinch_map(&a.pinch, &postures(report.scene))))
                    ul.legend {
                        @for s in PinchState::ALL {
                            li {
                                i style={ "background:" (state_colour(s)) } {}
                                (state_words(s)) " " b { (format_args!("{:.0} %", 100.0 * share(a, s))) }
                            }
                        }
                    }
                }
                article {
                    h3 { "Rigid and soft tips" }
                    p {
                        "Degrees of freedom by the rank of the constraints at the pinch; what joint angles can set by the rank \
                         of d(theta, grip force)/d(joint angles)."
                    }
                    (freedom_table(&a.freedom))
                }
            }
        }
    }
}

/// The push with both joints fixed.
fn push(report: &AnalysisReport<'_>) -> Markup {
    let a = report.analysis;
    let pushed = GraspReport {
        name: report.name,
        scene: report.pushed,
        run: &a.push,
        without_tangential: None,
        stable_steps: &a.stable_steps,
        bands: None,
        sweep: &[],
        seconds: report.seconds,
        warnings: &[],
    };
    html! {
        section {
            h2 { "A push with both joints fixed" }
            p.lead { "The object " (push_words(a, report.scene.object.friction.is_some())) "." }
            div.grid {
                article { (animation(report.pushed, &a.push.samples)) }
                article { h3 { "Scene" } (scene_table(report.scene)) }
            }
            div.plots { (time_plots(&pushed)) }
        }
    }
}
