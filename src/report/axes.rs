//! A panel with two axes, each linear or logarithmic, that stands alone as SVG in light and dark.

use crate::report::html::escape;
use crate::report::plot::ticks;
use crate::report::scale::short;
use std::fmt::Write;

/// Rules for one colour. No CSS variables: viewers other than browsers do not know them.
macro_rules! coloured {
    ($($k:literal $colour:literal)*) => {
        concat!($(
            ".d.k", $k, ",.n.k", $k, "{fill:", $colour, "}",
            ".l.k", $k, ",.told.k", $k, ",.broke.k", $k, ",.d.whole.k", $k, "{stroke:", $colour, "}",
        )*)
    };
}

/// Colours and fonts of all panels, for a `<style>` element.
const STYLE: &str = concat!(
    "text{font:11px system-ui,sans-serif;fill:#444}.t{font-weight:600;font-size:13px;fill:#111}.n{fill:#777}",
    ".g{stroke:#e4e6ea;fill:none}.a{stroke:#888;fill:none}.page{fill:#fff}",
    ".d{stroke:#fff;stroke-width:.7}.d.whole{stroke-width:1.8}.l{fill:none;stroke-width:1.7}",
    ".front{fill:none;stroke:#999;stroke-width:1.2}.lead{fill:none;stroke:#bbb;stroke-width:.8}",
    ".ring{fill:none;stroke:#111;stroke-width:1.3}.x{stroke:#d00000;stroke-width:1.8;fill:none}",
    ".limit{stroke:#999;stroke-dasharray:2 3;fill:none}.told{stroke-dasharray:5 3;stroke-width:1.2}.broke{stroke-width:1.2}",
    ".name{paint-order:stroke;stroke:#fff;stroke-width:3px;stroke-linejoin:round}",
    coloured!("0" "#c0392b" "1" "#2166ac" "2" "#7a7a7a" "3" "#2a7f4f" "4" "#8e44ad" "5" "#c77700"),
    ".d.whole{fill:#fff}.d:hover{stroke:#111;stroke-width:2}",
    "@media(prefers-color-scheme:dark){text{fill:#bbb}.t{fill:#eee}.n{fill:#999}.g{stroke:#333840}.page{fill:#14171c}",
    ".d{stroke:#14171c}.ring{stroke:#eee}.name{stroke:#14171c}.lead{stroke:#555}.x{stroke:#ff5050}",
    coloured!("0" "#ff7a6b" "1" "#6db3f2" "2" "#b0b0b0" "3" "#6fd39b" "4" "#c79ae0" "5" "#f0b04a"),
    ".d.whole{fill:#14171c}.d:hover{stroke:#fff}}"
);

/// One axis.
#[derive(Debug, Clone, PartialEq)]
pub struct Axis {
    /// What it shows, with its unit.
    pub name: String,
    /// Whether ratios, not differences, are even.
    pub logarithmic: bool,
    /// Values at its two ends; the first may be the greater one.
    pub ends: [f64; 2],
}

impl Axis {
    /// An axis that holds all finite (for a logarithmic one: positive) `values` with a little room.
    pub fn around(name: &str, logarithmic: bool, values: impl Iterator<Item = f64>) -> Self {
        let usable = values.filter(|v| v.is_finite() && (!logarithmic || *v > 0.0));
        let [mut low, mut high] = usable.fold([f64::INFINITY, f64::NEG_INFINITY], |r, v| [r[0].min(v), r[1].max(v)]);
        if low > high {
            [low, high] = [1.0, 10.0];
        }
        if logarithmic {
            let room = (high / low).powf(0.06).max(1.15);
            [low, high] = [low / room, high * room];
        } else {
            let room = (0.05 * (high - low)).max(1e-3 * high.abs()).max(1e-9);
            [low, high] = [low - room, high + room];
        }
        Self { name: name.into(), logarithmic, ends: [low, high] }
    }

    /// Where a value lies, 0 at the first end and 1 at the second.
    pub fn place(&self, v: f64) -> f64 {
        let f = |v: f64| if self.logarithmic { v.max(1e-300).ln() } else { v };
        (f(v) - f(self.ends[0])) / (f(self.ends[1]) - f(self.ends[0]))
    }

    /// Round values between the ends.
    pub fn ticks(&self) -> Vec<f64> {
        let (low, high) = (self.ends[0].min(self.ends[1]), self.ends[0].max(self.ends[1]));
        if !self.logarithmic {
            return ticks(low, high, 5.0);
        }
        let decades = (high / low).log10();
        if decades < 0.6 {
            return ticks(low, high, 4.0);
        }
        let steps: &[f64] = match decades {
            d if d < 1.4 => &[1.0, 2.0, 3.0, 5.0],
            d if d < 2.6 => &[1.0, 2.0, 5.0],
            d if d < 4.0 => &[1.0, 3.0],
            _ => &[1.0],
        };
        let first = low.log10().floor() as i32;
        let all = (first..=high.log10().ceil() as i32).flat_map(|e| steps.iter().map(move |s| s * 10f64.powi(e)));
        let every = (decades / 7.0).ceil().max(1.0) as usize;
        let inside = all.filter(|v| (low * 0.999..=high * 1.001).contains(v));
        if steps.len() == 1 { inside.step_by(every).collect() } else { inside.collect() }
    }
}

/// A number for an axis: small and large ones as powers of ten.
pub fn label(v: f64) -> String {
    match v.abs() {
        0.0 => "0".into(),
        a if !(1e-3..1e5).contains(&a) => format!("{v:.0e}"),
        _ => short(v),
    }
}

/// A frame with axes; places in it are in its own units.
#[derive(Debug, Clone, PartialEq)]
pub struct Panel {
    /// Above it.
    pub title: String,
    /// Under the title.
    pub note: String,
    /// Left to right.
    pub across: Axis,
    /// Bottom to top.
    pub up: Axis,
    /// Whole size (px).
    pub size: [f64; 2],
}

const LEFT: f64 = 48.0;
const RIGHT: f64 = 14.0;
const TOP: f64 = 40.0;
const BOTTOM: f64 = 38.0;

impl Panel {
    /// Pixels of a pair of values.
    pub fn at(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let [width, height] = self.size;
        [
            LEFT + self.across.place(x) * (width - LEFT - RIGHT),
            height - BOTTOM - self.up.place(y) * (height - TOP - BOTTOM),
        ]
    }

    /// Left, right, top and bottom of the frame (px).
    pub fn frame(&self) -> [f64; 4] {
        [LEFT, self.size[0] - RIGHT, TOP, self.size[1] - BOTTOM]
    }

    /// Title, grid, axes, then `content`, as an SVG group at `[x, y]` (px).
    pub fn draw(&self, [x, y]: [f64; 2], content: &str) -> String {
        let [left, right, top, bottom] = self.frame();
        let mut out = format!(
            r#"<g transform="translate({x:.0} {y:.0})"><text class="t" x="0" y="14">{}</text><text class="n" x="0" y="29">{}</text>"#,
            escape(&self.title),
            escape(&self.note)
        );
        for v in self.up.ticks() {
            let [_, at] = self.at([self.across.ends[0], v]);
            let _ = write!(
                out,
                r#"<path class="g" d="M{left} {at:.1}H{right}"/><text class="n" x="{:.0}" y="{:.1}" text-anchor="end">{}</text>"#,
                left - 5.0,
                at + 4.0,
                label(v)
            );
        }
        for v in self.across.ticks() {
            let [at, _] = self.at([v, self.up.ends[0]]);
            let _ = write!(
                out,
                r#"<path class="g" d="M{at:.1} {top}V{bottom}"/><text class="n" x="{at:.1}" y="{:.0}" text-anchor="middle">{}</text>"#,
                bottom + 14.0,
                label(v)
            );
        }
        let _ = write!(
            out,
            r#"<path class="a" d="M{left} {bottom}H{right}"/><text x="{right}" y="{:.0}" text-anchor="end">{}</text>"#,
            bottom + 30.0,
            escape(&self.across.name)
        );
        let _ =
            write!(out, r#"<text x="{right}" y="29" text-anchor="end">{}</text>{content}</g>"#, escape(&self.up.name));
        out
    }
}

/// A path through pixels.
pub fn path(points: impl Iterator<Item = [f64; 2]>) -> String {
    let mut out = String::new();
    for (i, [x, y]) in points.enumerate() {
        let _ = write!(out, "{}{x:.1} {y:.1}", if i == 0 { 'M' } else { 'L' });
    }
    out
}

/// A whole SVG of `width` by `height` px around groups.
pub fn document(width: f64, height: f64, content: &str) -> String {
    format!(
        r#"<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img" class="panels"><style>{STYLE}</style><rect class="page" width="100%" height="100%"/>{content}</svg>"#
    )
}

/// Groups side by side, `columns` to a row, each of `size` px, as one SVG.
pub(crate) fn tiled(columns: usize, size: [f64; 2], panels: &[(Panel, String)]) -> String {
    let (gap, rows) = (24.0, panels.len().div_ceil(columns));
    let columns = columns.min(panels.len().max(1));
    let at = |i: usize| [gap + (i % columns) as f64 * (size[0] + gap), gap + (i / columns) as f64 * (size[1] + gap)];
    let content: String = panels.iter().enumerate().map(|(i, (panel, inner))| panel.draw(at(i), inner)).collect();
    document(gap + columns as f64 * (size[0] + gap), gap + rows as f64 * (size[1] + gap), &content)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_lie_where_the_axes_say() {
        let across = Axis { name: "s".into(), logarithmic: true, ends: [0.1, 10.0] };
        assert!((across.place(1.0) - 0.5).abs() < 1e-12);
        assert_eq!(across.ticks(), [0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0]);
        let up = Axis { name: "mm".into(), logarithmic: false, ends: [4.0, 0.0] };
        assert_eq!(up.ticks(), [0.0, 1.0, 2.0, 3.0, 4.0]);
        let panel = Panel { title: "a < b".into(), note: String::new(), across, up, size: [200.0, 150.0] };
        let [left, right, top, bottom] = panel.frame();
        assert_eq!(panel.at([0.1, 4.0]), [left, bottom]);
        assert_eq!(panel.at([10.0, 0.0]), [right, top]);
        assert!(panel.draw([0.0, 0.0], "").contains("a &lt; b"));
    }

    #[test]
    fn an_axis_without_values_is_still_one() {
        let axis = Axis::around("s", true, [f64::NAN, -1.0].into_iter());
        assert!(axis.ends[0] > 0.0 && axis.ends[1] > axis.ends[0] && !axis.ticks().is_empty());
    }
}
