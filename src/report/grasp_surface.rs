//! Pictures of the grasp analysis: energy surfaces as banded maps, and the pinch map.

use crate::error::ReportError;
use crate::report::colormap::ColorMap;
use crate::report::picture::encode;
use crate::report::plot::ticks;
use crate::report::scale::short;
use crate::types::grasp::{EnergySurface, PinchMap, PinchState};
use base64::{Engine, engine::general_purpose::STANDARD};
use std::fmt::Write;

/// Pixels between two samples of a surface.
const ZOOM: usize = 6;
/// Colour bands on either side of zero.
const BANDS: usize = 11;

/// A surface as a picture with axes: theta in degrees across, the other coordinate in mm upwards.
/// Bands are even in the root of the energy, red above that at the posture and blue below, up to
/// `largest` (J); gray is out of range.
///
/// # Errors
/// [`ReportError`] when the picture cannot be encoded.
pub fn surface(s: &EnergySurface, largest: f64) -> Result<String, ReportError> {
    let (columns, rows) = (s.theta.len(), s.other.len());
    let (wide, tall) = ((columns - 1) * ZOOM + 1, (rows - 1) * ZOOM + 1);
    let at = |x: usize, y: usize| -> f64 {
        // Bilinear between samples; a corner out of range makes its cell so.
        let (i, j) = ((x / ZOOM).min(columns - 2), (y / ZOOM).min(rows - 2));
        let (u, v) = ((x - i * ZOOM) as f64 / ZOOM as f64, (y - j * ZOOM) as f64 / ZOOM as f64);
        let e = |a: usize, b: usize| s.energy[(j + b) * columns + i + a];
        (1.0 - v) * ((1.0 - u) * e(0, 0) + u * e(1, 0)) + v * ((1.0 - u) * e(0, 1) + u * e(1, 1))
    };
    let mut indices = Vec::with_capacity(wide * tall);
    for y in (0..tall).rev() {
        for x in 0..wide {
            let e = at(x, y);
            let band = (e.abs() / largest).sqrt().min(0.999_999) * BANDS as f64;
            indices.push(match e {
                e if e.is_nan() => 0,
                e if e < 0.0 => BANDS as u8 - band as u8,
                _ => BANDS as u8 + 1 + band as u8,
            });
        }
    }
    let mut palette = vec![150, 150, 150];
    for band in 0..2 * BANDS {
        palette.extend(ColorMap::Diverging.rgb((band as f64 + 0.5) / (2 * BANDS) as f64));
    }
    let png = encode(wide, tall, palette, &indices)?;
    let (left, top, w, h) = (34.0, 4.0, 200.0, 150.0);
    let (x0, x1) = (s.theta[0].to_degrees(), s.theta[columns - 1].to_degrees());
    let (y0, y1) = (1e3 * s.other[0], 1e3 * s.other[rows - 1]);
    let mut svg = format!(
        r#"<svg class="chart" viewBox="0 0 {:.0} {:.0}" role="img" aria-label="energy over theta and {}"><image x="{left}" y="{top}" width="{w}" height="{h}" preserveAspectRatio="none" href="data:image/png;base64,{}"/>"#,
        left + w + 6.0,
        top + h + 28.0,
        s.axis,
        STANDARD.encode(&png)
    );
    let (cx, cy) = (left + 0.5 * w, top + 0.5 * h);
    let _ = write!(svg, r#"<path class="axis" d="M{:.1} {cy:.1}h8M{cx:.1} {:.1}v8"/>"#, cx - 4.0, cy - 4.0);
    for v in ticks(x0, x1, 4.0) {
        let x = left + (v - x0) / (x1 - x0) * w;
        let _ = write!(svg, r#"<text x="{x:.1}" y="{:.0}" text-anchor="middle">{}</text>"#, top + h + 13.0, short(v));
    }
    for v in ticks(y0, y1, 3.0) {
        let y = top + (y1 - v) / (y1 - y0) * h;
        let _ = write!(svg, r#"<text x="{:.0}" y="{:.1}" text-anchor="end">{}</text>"#, left - 4.0, y + 4.0, short(v));
    }
    let _ = write!(
        svg,
        r#"<text x="{:.0}" y="{:.0}" text-anchor="end">theta, deg; up: {}, mm</text></svg>"#,
        left + w,
        top + h + 26.0,
        s.axis
    );
    Ok(svg)
}

/// The colour of a state in the pinch map.
pub(crate) fn state_colour(state: PinchState) -> &'static str {
    match state {
        PinchState::Good => "#3c9a5f",
        PinchState::Slip => "#e3b341",
        PinchState::OutOfRange => "#d4763b",
        PinchState::ContactLost => "#8d99ae",
        PinchState::Unstable => "#b3261e",
        PinchState::Unreached => "#d9dde3",
    }
}

/// In words, for a legend.
pub(crate) fn state_words(state: PinchState) -> &'static str {
    match state {
        PinchState::Good => "stable, no slip, in range",
        PinchState::Slip => "friction too low",
        PinchState::OutOfRange => "pressed past the model's range",
        PinchState::ContactLost => "a tip leaves the object",
        PinchState::Unstable => "no stable equilibrium",
        PinchState::Unreached => "not reached",
    }
}

/// The pinch map as SVG, theta 1 across and theta 2 upwards (degrees); `postures` are the scene's
/// joint angles (rad).
pub fn pinch_map(map: &PinchMap, postures: &[(usize, [f64; 2])]) -> String {
    let side = map.angles.len();
    let (left, top, size) = (40.0, 8.0, 380.0);
    let cell = size / side as f64;
    let mut svg = format!(
        r#"<svg class="chart" viewBox="0 0 {:.0} {:.0}" role="img" aria-label="pinch map">"#,
        left + size + 8.0,
        top + size + 34.0
    );
    for j in 0..side {
        let mut i = 0;
        while i < side {
            let state = map.cells[j * side + i].state;
            let run = (i..side).take_while(|&k| map.cells[j * side + k].state == state).count();
            let _ = write!(
                svg,
                r#"<rect x="{:.2}" y="{:.2}" width="{:.2}" height="{:.2}" fill="{}"/>"#,
                left + i as f64 * cell,
                top + (side - 1 - j) as f64 * cell,
                run as f64 * cell + 0.3,
                cell + 0.3,
                state_colour(state)
            );
            i += run;
        }
    }
    let (low, high) = (map.angles[0].to_degrees(), map.angles[side - 1].to_degrees());
    let place = |v: f64| ((v - low) / (high - low) * (side - 1) as f64 + 0.5) * cell;
    for v in ticks(low, high, 6.0) {
        let _ = write!(
            svg,
            r#"<text x="{:.1}" y="{:.0}" text-anchor="middle">{2}</text><text x="{3:.0}" y="{4:.1}" text-anchor="end">{2}</text>"#,
            left + place(v),
            top + size + 15.0,
            short(v),
            left - 5.0,
            top + size - place(v) + 4.0
        );
    }
    for (step, joints) in postures {
        let [a, b] = joints.map(f64::to_degrees);
        if a.abs() <= high && b.abs() <= high {
            let (x, y) = (left + place(a), top + size - place(b));
            let _ = write!(
                svg,
                r##"<circle cx="{x:.1}" cy="{y:.1}" r="8.5" fill="#fff" fill-opacity=".85"/><text x="{x:.1}" y="{:.1}" text-anchor="middle" style="fill:#111">{step}</text>"##,
                y + 4.0
            );
        }
    }
    let _ = write!(
        svg,
        r#"<text x="{:.0}" y="{:.0}" text-anchor="end">theta 1, deg; up: theta 2, deg</text></svg>"#,
        left + size,
        top + size + 31.0
    );
    svg
}
