//! Drawings of a grasp: fingers, tips, object and contact forces; one moment, or an animation that
//! runs in the page.
//!
//! Millimetres, y up. A finger is drawn once, hanging from its joint, and turned by its joint
//! angle.

use crate::types::Scene;
use crate::types::grasp::Sample;
use maud::{Markup, PreEscaped, html};
use std::fmt::Write;

/// Frames of an animation at most.
const MAX_FRAMES: usize = 500;
/// Length of the arrow for the largest force (mm).
const LONGEST_ARROW_MM: f64 = 26.0;

/// Lengths of a scene in mm; index 0 is the left finger.
struct Lengths {
    radius: [f64; 2],
    link: [f64; 2],
    base: [[f64; 2]; 2],
    width: f64,
    height: f64,
}

fn lengths(scene: &Scene) -> Lengths {
    let mm = |v: f64| 1e3 * v;
    Lengths {
        radius: scene.fingertips().map(|tip| mm(tip.radius)),
        link: scene.fingers().map(|f| mm(f.upper.unwrap_or(0.0) + f.link)),
        base: scene.bases().map(|b| b.map(mm)),
        width: mm(scene.object.width),
        height: mm(scene.object.height),
    }
}

/// The largest contact force over samples (N), at least 1e-9.
pub(crate) fn largest_force(samples: &[Sample]) -> f64 {
    let force = |s: &Sample| (0..2).map(|i| s.normal_force[i].hypot(s.tangential_force[i])).fold(0.0, f64::max);
    samples.iter().map(force).filter(|f| f.is_finite()).fold(1e-9, f64::max)
}

/// Forces on the object as arrows from the contacts (mm), the largest over the run `largest` (N).
fn arrows(scene: &Scene, s: &Sample, largest: f64) -> [[f64; 4]; 2] {
    let Lengths { radius, link, base, .. } = lengths(scene);
    let (sin, cos) = s.pose[2].sin_cos();
    [0, 1].map(|i| {
        let side = if i == 0 { 1.0 } else { -1.0 };
        let (js, jc) = s.joints[i].sin_cos();
        let (ox, oy) = (base[i][0] + side * link[i] * js, base[i][1] - link[i] * jc);
        let reach = side * (radius[i] - 1e3 * s.normal[i]);
        let (n, t) = (
            side * s.normal_force[i] * LONGEST_ARROW_MM / largest,
            -s.tangential_force[i] * LONGEST_ARROW_MM / largest,
        );
        [ox + reach * cos, oy + reach * sin, n * cos - t * sin, n * sin + t * cos]
    })
}

/// An arrow as a path.
fn arrow([x, y, dx, dy]: [f64; 4]) -> String {
    let length = dx.hypot(dy);
    if length < 0.3 {
        return format!("M{x:.1} {y:.1}h0");
    }
    let head = (0.35 * length).min(4.5) / length;
    let (bx, by) = (-0.87 * head * dx, -0.87 * head * dy);
    let (sx, sy) = (-0.5 * head * dy, 0.5 * head * dx);
    let (tx, ty) = (x + dx, y + dy);
    format!(
        "M{x:.1} {y:.1}L{tx:.1} {ty:.1}M{:.1} {:.1}L{tx:.1} {ty:.1}L{:.1} {:.1}",
        tx + bx + sx,
        ty + by + sy,
        tx + bx - sx,
        ty + by - sy
    )
}

/// The drawing of one moment; `trail` are places (m) that the object's centre went through.
pub fn moment(scene: &Scene, s: &Sample, largest: f64, trail: &[Sample]) -> String {
    let Lengths { radius, link, base, width: w, height: h } = lengths(scene);
    let [x, y, theta] = [1e3 * s.pose[0], 1e3 * s.pose[1], s.pose[2].to_degrees()];
    let (left, right) = (base[0][0] - radius[0] - 12.0, base[1][0] + radius[1] + 12.0);
    let highest = base[0][1].max(base[1][1]);
    let deepest = (0..2).map(|i| link[i] - base[i][1]).fold(0.0, f64::max);
    let (wide, top) = (right - left, -highest - 12.0);
    let tall = highest + deepest + 0.5 * (w * w + h * h).sqrt() + 14.0 + 12.0;
    let mut svg = format!(
        r#"<svg class="grasp" viewBox="{left:.1} {top:.1} {wide:.1} {tall:.1}" role="img" aria-label="the grasp"><g transform="scale(1,-1)">"#
    );
    for i in 0..2 {
        let side = if i == 0 { 1.0 } else { -1.0 };
        let turn = side * s.joints[i].to_degrees();
        let sweep = if i == 0 { 0 } else { 1 };
        let plate = if i == 0 { -3.0 } else { 0.0 };
        let (a, l) = (radius[i], link[i]);
        let _ = write!(
            svg,
            r#"<g class="f{n}" transform="translate({jx:.2},{jy:.2}) rotate({turn:.3})"><path class="tip" d="M0 {lo:.2}A{a} {a} 0 0 {arc} 0 {hi:.2}Z"/><rect class="plate" x="{plate}" y="{lo:.2}" width="3" height="{two:.2}"/><path class="link" d="M0 0V{down:.2}"/><circle class="joint" r="3.4"/></g>"#,
            n = i + 1,
            jx = base[i][0],
            jy = base[i][1],
            lo = -l - a,
            hi = -l + a,
            two = 2.0 * a,
            arc = 1 - sweep,
            down = -l
        );
    }
    let _ = write!(
        svg,
        r#"<g class="object" transform="translate({x:.3},{y:.3}) rotate({theta:.4})"><rect x="{:.2}" y="{:.2}" width="{w:.2}" height="{h:.2}" rx="0.6"/><path d="M-4 0H4M0 -4V4M0 {:.2}V{:.2}"/></g>"#,
        -0.5 * w,
        -0.5 * h,
        0.5 * h - 7.0,
        0.5 * h - 2.0
    );
    if !trail.is_empty() {
        let step = trail.len().div_ceil(MAX_FRAMES).max(1);
        let mut path = String::new();
        for (i, p) in trail.iter().step_by(step).enumerate() {
            let _ = write!(path, "{}{:.2} {:.2}", if i == 0 { 'M' } else { 'L' }, 1e3 * p.pose[0], 1e3 * p.pose[1]);
        }
        let _ = write!(svg, r#"<path class="trail" d="{path}"/>"#);
    }
    for (i, f) in arrows(scene, s, largest).into_iter().enumerate() {
        let _ = write!(svg, r#"<path class="force a{}" d="{}"/>"#, i + 1, arrow(f));
    }
    svg.push_str("</g></svg>");
    svg
}

/// An animation of samples at even times, with play, pause and a slider; without scripts it shows
/// the first moment.
pub(super) fn animation(scene: &Scene, samples: &[Sample]) -> Markup {
    let Some(first) = samples.first() else { return Markup::default() };
    let largest = largest_force(samples);
    let step = samples.len().div_ceil(MAX_FRAMES).max(1);
    let mut frames = String::new();
    for s in samples.iter().step_by(step) {
        let [p, q] = arrows(scene, s, largest);
        let numbers = [
            (s.time, 3),
            (1e3 * s.pose[0], 3),
            (1e3 * s.pose[1], 3),
            (s.pose[2].to_degrees(), 3),
            (s.joints[0].to_degrees(), 3),
            (-s.joints[1].to_degrees(), 3),
        ];
        frames.push('[');
        for (v, digits) in numbers {
            let _ = write!(frames, "{v:.digits$},");
        }
        let forces: Vec<String> = p.iter().chain(&q).map(|v| format!("{v:.1}")).collect();
        let _ = write!(frames, "{}],", forces.join(","));
    }
    let [[ax, ay], [bx, by]] = lengths(scene).base;
    let last = samples.iter().step_by(step).count() - 1;
    html! {
        div.animation data-bases=(format_args!("[[{ax:.3},{ay:.3}],[{bx:.3},{by:.3}]]"))
            data-frames={ "[" (frames.trim_end_matches(',')) "]" } {
            (PreEscaped(moment(scene, first, largest, samples)))
            div.controls {
                button type="button" aria-label="play or pause" { "Play" }
                input type="range" min="0" max=(last) value="0" aria-label="time";
                output { (format_args!("{:.2} s", first.time)) }
            }
        }
        script { (PreEscaped(include_str!("grasp.js"))) }
    }
}
