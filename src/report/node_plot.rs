//! The source's picture: the displacement magnitude at every mesh node, in space.

use crate::report::figure::{colour_bar, stand_alone};
use crate::report::html::escape;
use crate::report::scale::Scale;
use crate::types::WorldPoint;
use std::fmt::Write;

/// Nodes drawn at most; more are evenly thinned.
const MAX_NODES_DRAWN: usize = 4000;
const WIDTH: f64 = 560.0;
const HEIGHT: f64 = 440.0;

/// Parallel projection: seen from behind and the left, a little from above. Right, up, and away
/// from the eye.
fn project(p: [f64; 3]) -> [f64; 3] {
    let (turn, tilt) = (35f64.to_radians(), 22f64.to_radians());
    let (right, away) = (p[0] * turn.cos() - p[1] * turn.sin(), p[0] * turn.sin() + p[1] * turn.cos());
    [right, p[2] * tilt.cos() + away * tilt.sin(), away * tilt.cos() - p[2] * tilt.sin()]
}

/// An SVG of the nodes (mm, RAS) coloured by the length of their displacement (mm), in their
/// bounding box.
pub fn scatter(nodes: &[WorldPoint], displacement: &[[f64; 3]], scale: &Scale) -> String {
    let bound = |f: fn(f64, f64) -> f64, start: f64| -> [f64; 3] {
        std::array::from_fn(|a| nodes.iter().map(|p| p.0[a]).fold(start, f))
    };
    let (low, high) = (bound(f64::min, f64::INFINITY), bound(f64::max, f64::NEG_INFINITY));
    let corner = |c: usize| -> [f64; 3] { std::array::from_fn(|a| if c >> a & 1 == 1 { high[a] } else { low[a] }) };
    let corners: Vec<[f64; 3]> = if nodes.is_empty() { vec![] } else { (0..8).map(|c| project(corner(c))).collect() };
    let extent = |a: usize| {
        let range = |f: fn(f64, f64) -> f64, start| corners.iter().map(|c| c[a]).fold(start, f);
        [range(f64::min, f64::INFINITY), range(f64::max, f64::NEG_INFINITY)]
    };
    let ([x0, x1], [y0, y1]) = (extent(0), extent(1));
    let zoom = ((WIDTH - 200.0) / (x1 - x0).max(1e-9)).min((HEIGHT - 60.0) / (y1 - y0).max(1e-9));
    let screen =
        |q: [f64; 3]| [WIDTH / 2.0 + zoom * (q[0] - (x0 + x1) / 2.0), HEIGHT / 2.0 - zoom * (q[1] - (y0 + y1) / 2.0)];

    let mut svg = format!(
        r#"<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="displacement at the mesh nodes"><g class="frame">"#
    );
    for (a, &p) in corners.iter().enumerate() {
        for axis in (0..3).map(|k| 1 << k).filter(|k| a & k == 0) {
            let ([px, py], [qx, qy]) = (screen(p), screen(corners[a | axis]));
            let _ = write!(svg, r#"<path d="M{px:.1} {py:.1}L{qx:.1} {qy:.1}"/>"#);
        }
    }
    svg.push_str("</g>");

    let mut points: Vec<([f64; 3], f64)> = nodes
        .iter()
        .zip(displacement)
        .step_by(nodes.len().div_ceil(MAX_NODES_DRAWN).max(1))
        .map(|(p, d)| (project(p.0), d.iter().map(|v| v * v).sum::<f64>().sqrt()))
        .collect();
    points.sort_by(|a, b| b.0[2].total_cmp(&a.0[2]));
    let r = (70.0 / (points.len().max(1) as f64).sqrt()).clamp(1.6, 5.0);
    for (q, length) in points {
        let [x, y] = screen(q);
        let _ = write!(svg, r#"<circle cx="{x:.1}" cy="{y:.1}" r="{r:.1}" fill="{}"/>"#, scale.hex(length));
    }
    // Each axis is named at the middle of an edge of the outline, and measured.
    for (axis, name) in ["L to R", "P to A", "I to S"].iter().enumerate().filter(|_| !corners.is_empty()) {
        let from = [0b000, 0b000, 0b001][axis];
        let ([px, py], [qx, qy]) = (screen(corners[from]), screen(corners[from | 1 << axis]));
        let (dx, dy, anchor) = [(6.0, 18.0, "start"), (-6.0, 18.0, "end"), (10.0, 4.0, "start")][axis];
        let (x, y) = ((px + qx) / 2.0 + dx, (py + qy) / 2.0 + dy);
        let _ = write!(
            svg,
            r#"<text x="{x:.1}" y="{y:.1}" text-anchor="{anchor}">{name}, {:.0} mm</text>"#,
            high[axis] - low[axis]
        );
    }
    svg.push_str("</svg>");
    svg
}

/// [`scatter`] with a title and a colour bar, as an SVG file that stands alone.
pub fn figure(title: &str, nodes: &[WorldPoint], displacement: &[[f64; 3]], scale: &Scale) -> String {
    let chart = scatter(nodes, displacement, scale);
    let chart = chart.replacen("<svg", &format!(r#"<svg y="50" width="{WIDTH}" height="{HEIGHT}""#), 1);
    let bar = colour_bar(scale, 0, [WIDTH + 10.0, 90.0], 160.0);
    let title = format!(r#"<text x="24" y="34" class="title">{}</text>"#, escape(title));
    stand_alone([WIDTH + 90.0, HEIGHT + 60.0], &format!("{title}{chart}{bar}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::colormap::ColorMap;

    #[test]
    fn every_node_is_drawn_once_and_inside_the_picture() {
        let nodes: Vec<_> =
            (0..60).map(|i| WorldPoint([f64::from(i % 5) * 9.0, f64::from(i / 5 % 4), f64::from(i / 20)])).collect();
        let d: Vec<_> = (0..60).map(|i| [f64::from(i), 0.0, 0.0]).collect();
        let svg = scatter(&nodes, &d, &Scale::from_zero(60.0, "mm", ColorMap::Viridis));
        assert_eq!(svg.matches("<circle").count(), 60);
        assert_eq!(svg.matches("<path").count(), 12);
        let inside = |key: &str, limit: f64| {
            svg.split(key)
                .skip(1)
                .filter_map(|s| s.split('"').next()?.parse::<f64>().ok())
                .all(|v| v > 0.0 && v < limit)
        };
        assert!(inside("cx=\"", WIDTH) && inside("cy=\"", HEIGHT));
        assert!(!scatter(&[], &[], &Scale::from_zero(1.0, "mm", ColorMap::Viridis)).contains("NaN"));
    }

    #[test]
    fn the_figure_stands_alone_with_one_colour_bar() {
        let nodes = [WorldPoint([0.0; 3]), WorldPoint([9.0, 4.0, 2.0])];
        let svg =
            figure("a < b", &nodes, &[[0.0; 3], [3.0, 4.0, 0.0]], &Scale::from_zero(5.0, "mm", ColorMap::Viridis));
        assert!(svg.starts_with(r#"<svg xmlns="http://www.w3.org/2000/svg""#) && svg.contains("a &lt; b"));
        assert_eq!((svg.matches("<circle").count(), svg.matches("<linearGradient").count()), (2, 1));
        assert!(svg.contains(">5 mm<") && svg.matches("<svg").count() == svg.matches("</svg>").count());
    }

    #[test]
    fn many_nodes_are_thinned() {
        let nodes = vec![WorldPoint([1.0, 2.0, 3.0]); 9000];
        let svg = scatter(&nodes, &vec![[0.0; 3]; 9000], &Scale::from_zero(1.0, "mm", ColorMap::Viridis));
        assert!((2000..=MAX_NODES_DRAWN).contains(&svg.matches("<circle").count()));
    }
}
