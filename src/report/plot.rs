//! Line plots as SVG: axes with round ticks, several lines, marks along the bottom axis, a legend
//! under it.

use crate::report::html::escape;
use crate::report::scale::short;
use maud::{Markup, PreEscaped};
use std::fmt::Write;

const WIDTH: f64 = 520.0;
const HEIGHT: f64 = 210.0;
const LEFT: f64 = 46.0;
const RIGHT: f64 = 8.0;
const TOP: f64 = 26.0;
const BOTTOM: f64 = 38.0;
/// From one row of the legend to the next.
const ROW: f64 = 17.0;
/// The stroke that stands before a name in the legend, with the room after it; what is left free
/// between two entries.
const STROKE: f64 = 21.0;
const APART: f64 = 10.0;

/// One line of a plot.
#[derive(Debug, Clone, PartialEq)]
pub struct Line {
    /// Name in the legend; lines without one are not in it.
    pub name: String,
    /// Number of its colour, 0 to 3.
    pub colour: usize,
    /// Whether it is dashed.
    pub dashed: bool,
    /// How its places are drawn.
    pub shape: Shape,
    /// Places; a value that is not finite interrupts the line.
    pub points: Vec<[f64; 2]>,
}

/// How places are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Shape {
    /// A line through them.
    #[default]
    Line,
    /// A dot at each.
    Dots,
    /// The area that they go around.
    Band,
}

impl Line {
    /// A line called `name`.
    pub fn new(name: &str, colour: usize, dashed: bool, points: Vec<[f64; 2]>) -> Self {
        Self { name: name.into(), colour, dashed, shape: Shape::Line, points }
    }

    /// Dots called `name`.
    pub(crate) fn dots(name: &str, colour: usize, points: Vec<[f64; 2]>) -> Self {
        Self { shape: Shape::Dots, ..Self::new(name, colour, false, points) }
    }

    /// The area between `low` and `high` at each place of the horizontal axis, as (place, low,
    /// high).
    pub fn band(name: &str, colour: usize, between: &[[f64; 3]]) -> Self {
        let back = between.iter().rev().map(|p| [p[0], p[1]]);
        let around = between.iter().map(|p| [p[0], p[2]]).chain(back).filter(|p| p[1].is_finite()).collect();
        Self { shape: Shape::Band, ..Self::new(name, colour, false, around) }
    }

    /// Its class in the page's style.
    fn class(&self) -> String {
        let kind = match self.shape {
            Shape::Line => "line",
            Shape::Dots => "dots",
            Shape::Band => "band",
        };
        format!("{kind} c{}{}", self.colour % 4, if self.dashed { " dashed" } else { "" })
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

/// Width of `text` in the plots' 12 px type, at most: that of a wide typeface.
fn width(text: &str) -> f64 {
    let of = |c: char| match c {
        'i' | 'j' | 'l' | ' ' | '.' | ',' | ':' | ';' | '\'' | '|' => 4.0,
        'f' | 'r' | 't' | '(' | ')' | '-' | '/' => 5.2,
        'm' | 'w' | 'M' | 'W' | '%' => 12.0,
        'a'..='z' | '0'..='9' => 7.7,
        'A' | 'B' | 'E' | 'F' | 'J' | 'L' | 'P' | 'S' | 'T' => 8.4,
        'A'..='Z' => 9.6,
        _ => 12.0,
    };
    text.chars().map(of).sum()
}

/// Where the names of a legend stand, each with its stroke: from the left and row, in as many rows
/// as it takes. The first row ends before `across`, which stands at its right.
fn legend<'a>(names: impl Iterator<Item = &'a str>, across: &str) -> Vec<[f64; 2]> {
    let (mut left, mut row, mut end) = (LEFT, 0.0, WIDTH - RIGHT - width(across) - APART);
    let place = |name: &str| {
        let wide = STROKE + width(name);
        if left > LEFT && left + wide > end {
            (left, row, end) = (LEFT, row + 1.0, WIDTH - RIGHT);
        }
        let at = [left, row];
        left += wide + APART;
        at
    };
    names.map(place).collect()
}

/// Ticks from `low` to `high`; where all `places` are whole, as the numbers of frames are, so are
/// the ticks.
fn places_ticks(low: f64, high: f64, mut places: impl Iterator<Item = f64>) -> Vec<f64> {
    let whole = |v: f64| (v - v.round()).abs() < 1e-9;
    let mut found = ticks(low, high, 6.0);
    if places.all(whole) {
        found.retain(|v| whole(*v));
    }
    found
}

/// Round numbers from at or above `low` to at or below `high`, about `wanted` of them.
///
/// ```
/// use palpate::report::plot::ticks;
/// assert_eq!(ticks(0.0, 10.0, 5.0), [0.0, 2.0, 4.0, 6.0, 8.0, 10.0]);
/// ```
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
    /// The plot with `lines`, for a page.
    pub(super) fn shown(&self, lines: &[Line]) -> Markup {
        PreEscaped(self.draw(lines))
    }

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
        let named: Vec<&Line> = lines.iter().filter(|l| !l.name.is_empty()).collect();
        let entries = legend(named.iter().map(|l| l.name.as_str()), self.across);
        let tall = HEIGHT + ROW * entries.last().map_or(0.0, |e| e[1]);
        let x = |v: f64| LEFT + (v - x0) / (x1 - x0) * (WIDTH - LEFT - RIGHT);
        let y = |v: f64| TOP + (y1 - v) / (y1 - y0) * (HEIGHT - TOP - BOTTOM);
        let base = HEIGHT - BOTTOM;
        let mut svg = format!(
            r#"<svg class="chart plot" viewBox="0 0 {WIDTH} {tall}" role="img" aria-label="{0}"><text x="0" y="12" class="strong">{0}</text>"#,
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
        for v in places_ticks(x0, x1, finite().map(|p| p[0])) {
            let name = short(v);
            let at = x(v).min(WIDTH - width(&name) / 2.0);
            let _ = write!(svg, r#"<text x="{at:.1}" y="{:.0}" text-anchor="middle">{name}</text>"#, base + 15.0);
        }
        let _ = write!(
            svg,
            r#"<text x="{:.0}" y="{:.0}" text-anchor="end">{}</text>"#,
            WIDTH - RIGHT,
            HEIGHT - 4.0,
            escape(self.across)
        );
        for line in lines {
            let class = line.class();
            let mut path = String::new();
            let mut pen = false;
            for p in &line.points {
                if p[0].is_finite() && p[1].is_finite() {
                    let _ = write!(path, "{}{:.1} {:.1}", if pen { "L" } else { "M" }, x(p[0]), y(p[1]));
                    // A place alone between two gaps is a dot.
                    path.push_str(if pen { "" } else { "h0" });
                    pen = line.shape != Shape::Dots;
                } else {
                    pen = false;
                }
            }
            let _ = write!(svg, r#"<path class="{class}" d="{path}"/>"#);
        }
        for (line, [left, row]) in named.iter().zip(&entries) {
            let class = line.class();
            let under = HEIGHT - 4.0 + ROW * row;
            let stroke = match line.shape {
                Shape::Line => format!("M{left:.0} {:.0}h16", under - 4.0),
                Shape::Dots => format!("M{:.0} {:.0}h0", left + 8.0, under - 4.0),
                Shape::Band => format!("M{left:.0} {:.0}h16v8h-16Z", under - 8.0),
            };
            let _ = write!(
                svg,
                r#"<path class="{class}" d="{stroke}"/><text x="{:.0}" y="{under:.0}">{}</text>"#,
                left + STROKE,
                escape(&line.name)
            );
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
    fn whole_places_have_whole_ticks() {
        let at = |points: &[f64]| places_ticks(points[0], points[points.len() - 1], points.iter().copied());
        assert_eq!(at(&[1.0, 2.0, 3.0, 4.0, 5.0]), [1.0, 2.0, 3.0, 4.0, 5.0]);
        assert_eq!(at(&[0.0, 1.0]), [0.0, 1.0]);
        assert_eq!(at(&[0.0, 0.5, 1.0]).len(), 6);
    }

    #[test]
    fn names_in_a_legend_do_not_overprint() {
        let names = ["E1 mean", "E1 peak", "E3 mean", "E3 peak", "volume", "a layer with a long name of its own", "W"];
        let places = legend(names.into_iter(), "time, s");
        let ends = |at: usize| places[at][0] + STROKE + width(names[at]);
        for at in 0..names.len() {
            let next = places.get(at + 1).filter(|n| n[1] == places[at][1]).map_or(WIDTH, |n| n[0]);
            assert!(ends(at) < next, "{}: ends at {:.0}, the next begins at {next:.0}", names[at], ends(at));
            assert!(places[at][1] > 0.0 || ends(at) < WIDTH - RIGHT - width("time, s"), "{}", names[at]);
        }
        let lines = names.map(|n| Line::new(n, 0, false, vec![[0.0, 1.0], [1.0, 2.0]]));
        let svg = Plot { title: "t", across: "time, s", marks: &[] }.draw(&lines);
        assert!(svg.contains("viewBox=\"0 0 520 227\""), "{svg}");
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
