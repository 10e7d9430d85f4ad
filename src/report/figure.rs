//! Panels as one SVG file that stands alone: a row a quantity, a column a plane, colour bars to the
//! right.

use crate::report::html::escape;
use crate::report::panels::Panel;
use crate::report::scale::Scale;
use std::fmt::Write;

const WIDTH: f64 = 960.0;
const LEFT: f64 = 24.0;
const BAR: f64 = 90.0;
const GAP: f64 = 18.0;

/// A drawing with `title` above the panels.
pub fn figure(title: &str, panels: &[Panel]) -> String {
    let across = |p: &Panel| p.pictures.iter().map(|q| q.size_mm[0]).sum::<f64>();
    let tall = |p: &Panel| p.pictures.iter().map(|q| q.size_mm[1]).fold(0.0, f64::max);
    let widest = panels.iter().map(across).fold(1.0, f64::max);
    let columns = panels.iter().map(|p| p.pictures.len()).max().unwrap_or(1);
    let room = WIDTH - 2.0 * LEFT - BAR - GAP * columns.saturating_sub(1) as f64;
    let highest = panels.iter().map(tall).fold(1.0, f64::max);
    let zoom = (room / widest).min(420.0 / highest);
    let height = 56.0 + panels.iter().map(|p| tall(p) * zoom + 40.0).sum::<f64>();

    let mut body = format!(r#"<text x="{LEFT}" y="34" class="title">{}</text>"#, escape(title));
    let mut top = 56.0;
    for (row, panel) in panels.iter().enumerate() {
        let _ = write!(body, r#"<text x="{LEFT}" y="{:.0}" class="head">{}</text>"#, top + 14.0, escape(&panel.title));
        top += 24.0;
        let mut x = LEFT;
        for picture in &panel.pictures {
            let [w, h] = picture.size_mm.map(|v| v * zoom);
            let _ = write!(
                body,
                r#"<image x="{x:.1}" y="{top:.1}" width="{w:.1}" height="{h:.1}" preserveAspectRatio="none" href="{}"/>"#,
                picture.data_uri()
            );
            let [l, r, t, b] = picture.plane.labels();
            let (cx, cy) = (x + w / 2.0, top + h / 2.0 + 4.0);
            for (tx, ty, name) in [(x + 9.0, cy, l), (x + w - 9.0, cy, r), (cx, top + 13.0, t), (cx, top + h - 5.0, b)]
            {
                let _ = write!(body, r#"<text x="{tx:.1}" y="{ty:.1}" class="side">{name}</text>"#);
            }
            x += w + GAP;
        }
        if let Some(scale) = &panel.scale {
            body.push_str(&colour_bar(scale, row, [x, top], (tall(panel) * zoom).min(160.0)));
        }
        top += tall(panel) * zoom + 16.0;
    }
    stand_alone([WIDTH, height], &body)
}

/// Plots of [`crate::report::plot`] as one file that stands alone, `columns` beside each other.
pub fn sheet(title: &str, plots: &[String], columns: usize) -> String {
    let (wide, tall) = (560.0, 236.0);
    let rows = plots.len().div_ceil(columns.max(1));
    let mut body = format!(
        "<style>.strong{{font-weight:600;fill:#222}}.rule{{stroke:#e1e4ea}}.axis{{stroke:#5b6472;fill:none}}.mark{{stroke:#999;\
         stroke-dasharray:2 3}}.line{{fill:none;stroke:#3b6fb6;stroke-width:1.8;stroke-linejoin:round}}.c1{{stroke:#c7672b}}\
         .c2{{stroke:#2c8a5b}}.c3{{stroke:#8356b0}}.dashed{{stroke-dasharray:5 4;stroke-width:1.3}}</style>\
         <text x=\"{LEFT}\" y=\"34\" class=\"title\">{}</text>",
        escape(title)
    );
    for (i, plot) in plots.iter().enumerate() {
        let (x, y) = (LEFT + (i % columns) as f64 * wide, 56.0 + (i / columns) as f64 * tall);
        let _ = write!(body, r#"<svg x="{x}" y="{y}" width="520" height="210">{plot}</svg>"#);
    }
    stand_alone([LEFT + columns as f64 * wide, 60.0 + rows as f64 * tall], &body)
}

/// A scale from `place` (its upper left corner) down, `tall` high, with three ticks; `number` sets
/// it apart from others.
pub(super) fn colour_bar(scale: &Scale, number: usize, [x, top]: [f64; 2], tall: f64) -> String {
    let stops: String = (0..9)
        .zip(scale.stops())
        .map(|(i, c)| format!(r#"<stop offset="{:.3}" stop-color="{c}"/>"#, f64::from(i) / 8.0))
        .collect();
    let mut bar = format!(
        r#"<linearGradient id="g{number}" x1="0" y1="1" x2="0" y2="0">{stops}</linearGradient><rect x="{x:.1}" y="{top:.1}" width="12" height="{tall:.1}" fill="url(#g{number})"/>"#
    );
    for (i, tick) in scale.ticks().into_iter().enumerate() {
        let y = top + tall * (1.0 - i as f64 / 2.0) + [0.0, 4.0, 9.0][i];
        let unit = if i == 2 { format!(" {}", scale.unit) } else { String::new() };
        let _ = write!(bar, r#"<text x="{:.1}" y="{y:.1}">{tick}{unit}</text>"#, x + 18.0);
    }
    bar
}

/// A whole SVG file around `body`, on white.
pub(super) fn stand_alone([w, h]: [f64; 2], body: &str) -> String {
    format!(
        concat!(
            r#"<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {w} {h:.0}" width="{w}" height="{h:.0}">"#,
            "<style>text{{font:12px system-ui,sans-serif;fill:#444}}.title{{font-size:19px;font-weight:600;fill:#111}}",
            ".head{{font-weight:600;fill:#222}}.side{{fill:#fff;text-anchor:middle;opacity:.85;font-weight:600}}",
            ".frame{{fill:none;stroke:#bbb}}</style>",
            r##"<rect width="100%" height="100%" fill="#fff"/>{body}</svg>"##
        ),
        w = w,
        h = h,
        body = body
    )
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::report::panels::synthetic_pair;
    use crate::types::{Affine, DenseField, Grid, Volume};

    #[test]
    fn three_rows_of_three_planes_with_one_colour_bar() {
        let grid = Grid::new([6, 5, 4], Affine::scaled([1.0, 1.0, 3.0], [0.0; 3]).unwrap()).unwrap();
        let volume = Volume::filled(grid, 1.0);
        let truth = DenseField::from_fn(grid, |p| [p.0[0], 0.0, 0.0]);
        let panels = synthetic_pair(&volume, &volume, &truth, None).unwrap();
        let svg = figure("a < b", &panels);
        assert_eq!(svg.matches("<image").count(), 9);
        assert_eq!(svg.matches("<linearGradient").count(), 1);
        assert!(svg.contains("a &lt; b") && svg.contains(">5 mm<") && !svg.contains("NaN"));
        assert_eq!(svg.matches("<text").count(), svg.matches("</text>").count());
    }
}
