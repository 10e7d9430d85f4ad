//! Line plots as SVG: axes with round ticks, several lines, marks along the bottom axis.

use crate::report::html::escape;
use crate::report::scale::short;
use std::fmt::Write;

const WIDTH: f64 = 520.0;
const HEIGHT: f64 = 210.0;
const LEFT: f64 = 46.0;
const RIGHT: f64 = 8.0;
const TOP: f64 = 26.0;
const BOTTOM: f64 = 34.0;

/// One line of a plot.
#[derive(Debug, Clone, PartialEq)]
pub struct Line {
    /// Name in the legend; lines without one are not in it.
    pub name: String,
    /// Number of its colour, 0 to 3.
    pub colour: usize,
    /// Whether it is dashed.
    pub dashed: bool,
    /// Places; a value that is not finite interrupts the line.
    pub points: Vec<[f64; 2]>,
}

impl Line {
    /// A line called `name`.
    pub fn new(name: &str, colour: usize, dashed: bool, points: Vec<[f64; 2]>) -> Self {
        Self { name: name.into(), colour, dashed, points }
    }
}

/// A plot of lines over a common axis.
#[derive(Debug, Clone, PartialEq)]
pub struct Plot<'a> {
    /// Above it.
    pub title: &'a str,
    /// What the horizontal axis counts, with its unit.
    pub across: &'a str,
    /// Places on the horizontal axis with a faint upright line: (place, whether it is a warning).
    pub marks: &'a [(f64, bool)],
}

/// Round numbers from at or above `low` to at or below `high`, about `wanted` of them.
pub fn ticks(low: f64, high: f64, wanted: f64) -> Vec<f64> {
    let span = high - low;
    if !(span > 0.0 && span.is_finite()) {
        return vec![low];
    }
    let raw = span / wanted;
    let power = 10f64.powf(raw.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].into_iter().find(|s| s * power >= raw * 0.75).unwrap_or(10.0) * power;
    let first = (low / step - 1e-9).ceil() as i64;
    let last = (high / step + 1e-9).floor() as i64;
    (first..=last).map(|i| i as f64 * step).collect()
}

impl Plot<'_> {
    /// The plot with `lines`.
    pub fn draw(&self, lines: &[Line]) -> String {
        let finite = || lines.iter().flat_map(|l| &l.points).filter(|p| p[0].is_finite() && p[1].is_finite());
        let range = |k: usize| {
            finite().map(|p| p[k]).fold([f64::INFINITY, f64::NEG_INFINITY], |r, v| [r[0].min(v), r[1].max(v)])
        };
        let [x0, x1] = range(0);
        let [mut y0, mut y1] = range(1);
        // Also where there is no finite point: the range is then upside down.
        if x1 <= x0 {
            return format!(r#"<p class="none">{}: nothing to show</p>"#, escape(self.title));
        }
        // A level line is not blown up to its rounding.
        let size = y0.abs().max(y1.abs()).max(1e-9);
        let room = if y1 - y0 > 1e-4 * size { 0.06 * (y1 - y0) } else { 0.1 * size };
        (y0, y1) = (y0 - room, y1 + room);
        let x = |v: f64| LEFT + (v - x0) / (x1 - x0) * (WIDTH - LEFT - RIGHT);
        let y = |v: f64| TOP + (y1 - v) / (y1 - y0) * (HEIGHT - TOP - BOTTOM);
        let base = HEIGHT - BOTTOM;
        let mut svg = format!(
            r#"<svg class="chart plot" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{0}"><text x="0" y="12" class="strong">{0}</text>"#,
            escape(self.title)
        );
        for v in ticks(y0, y1, 4.0) {
            let at = y(v);
            let _ = write!(
                svg,
                r#"<path class="rule" d="M{LEFT} {at:.1}H{:.0}"/><text x="{:.0}" y="{:.1}" text-anchor="end">{}</text>"#,
                WIDTH - RIGHT,
                LEFT - 6.0,
                at + 4.0,
                short(v)
            );
        }
        for &(place, warning) in self.marks.iter().filter(|m| m.0 >= x0 && m.0 <= x1) {
            let class = if warning { "mark warn" } else { "mark" };
            let _ = write!(svg, r#"<path class="{class}" d="M{:.1} {TOP}V{base}"/>"#, x(place));
        }
        let _ = write!(svg, r#"<path class="axis" d="M{LEFT} {base}H{:.0}"/>"#, WIDTH - RIGHT);
        for v in ticks(x0, x1, 6.0) {
            let _ =
                write!(svg, r#"<text x="{:.1}" y="{:.0}" text-anchor="middle">{}</text>"#, x(v), base + 15.0, short(v));
        }
        let _ = write!(
            svg,
            r#"<text x="{:.0}" y="{:.0}" text-anchor="end">{}</text>"#,
            WIDTH - RIGHT,
            HEIGHT - 4.0,
            escape(self.across)
        );
        for line in lines {
            let class = format!("line c{}{}", line.colour % 4, if line.dashed { " dashed" } else { "" });
            let mut path = String::new();
            let mut pen = false;
            for p in &line.points {
                if p[0].is_finite() && p[1].is_finite() {
                    let _ = write!(path, "{}{:.1} {:.1}", if pen { 'L' } else { 'M' }, x(p[0]), y(p[1]));
                    pen = true;
                } else {
                    pen = false;
                }
            }
            let _ = write!(svg, r#"<path class="{class}" d="{path}"/>"#);
        }
        // The legend, from the left below the axis.
        let (mut left, under) = (LEFT, HEIGHT - 4.0);
        for line in lines.iter().filter(|l| !l.name.is_empty()) {
            let class = format!("line c{}{}", line.colour % 4, if line.dashed { " dashed" } else { "" });
            let _ = write!(
                svg,
                r#"<path class="{class}" d="M{left:.0} {:.0}h16"/><text x="{:.0}" y="{under:.0}">{}</text>"#,
                under - 4.0,
                left + 21.0,
                escape(&line.name)
            );
            left += 21.0 + 7.2 * line.name.chars().count() as f64 + 12.0;
        }
        svg.push_str("</svg>");
        svg
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside() {
        assert_eq!(ticks(0.0, 12.5, 6.0), [0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0]);
        assert_eq!(ticks(-0.3, 0.31, 3.0), [-0.2, 0.0, 0.2]);
        assert_eq!(ticks(1.0, 1.0, 3.0), [1.0]);
    }

    #[test]
    fn a_gap_interrupts_the_line_and_a_flat_one_is_drawn() {
        let plot = Plot { title: "a < b", across: "s", marks: &[(0.5, true), (9.0, false)] };
        let points = vec![[0.0, 1.0], [0.5, f64::NAN], [1.0, 1.0]];
        let svg = plot.draw(&[Line::new("one", 0, true, points)]);
        assert!(svg.contains("a &lt; b") && !svg.contains("NaN"));
        assert_eq!(svg.matches("mark warn").count(), 1);
        assert_eq!(svg.matches(r#"class="mark""#).count(), 0);
        let line = svg.split(r#"c0 dashed" d=""#).nth(1).unwrap_or_default();
        assert_eq!(line.split('"').next().unwrap_or_default().matches('M').count(), 2);
        assert!(plot.draw(&[]).contains("nothing to show"));
    }
}
