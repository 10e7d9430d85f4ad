//! Displacement arrows and matches over a section, as SVG.

use crate::report::picture::Picture;
use crate::report::scale::Scale;
use crate::report::section::Section;
use crate::types::{DenseField, Mask, Match};
use std::fmt::Write;

/// Arrows along the longer side of a picture.
const ARROWS_ACROSS: usize = 16;
/// Matches drawn at most in one picture.
const MAX_MATCHES_DRAWN: usize = 1200;

/// An SVG of the section's size in mm, with the picture behind `content`.
fn over(picture: &Picture, label: &str, content: &str) -> String {
    let [w, h] = picture.size_mm;
    format!(
        r#"<svg class="slice" viewBox="0 0 {w:.2} {h:.2}" role="img" aria-label="{label}"><image width="{w:.2}" height="{h:.2}" preserveAspectRatio="none" href="{}"/>{content}</svg>"#,
        picture.data_uri()
    )
}

/// The part of the displacement that lies in the section, as arrows `factor` times as long as in
/// truth, coloured by the whole length. `background` must be of the same section.
pub(crate) fn arrows(
    section: &Section,
    background: &Picture,
    field: &DenseField,
    mask: Option<&Mask>,
    factor: f64,
    scale: &Scale,
) -> String {
    let (nodes, step) = section.lattice(ARROWS_ACROSS);
    let width = step / 8.0;
    let mut svg =
        format!(r#"<g fill="none" stroke-width="{width:.2}" stroke-linecap="round" stroke-linejoin="round">"#);
    for offset in nodes {
        if mask.is_some_and(|m| m.as_slice()[offset] == 0) {
            continue;
        }
        let d = field.at(offset).map(f64::from);
        let [i, j, k] = field.grid().voxel(offset);
        let ([x, y], _) = section.place(field.grid().world(i, j, k));
        let [dx, dy] = section.direct(d).map(|v| v * factor);
        let colour = scale.hex(d.iter().map(|v| v * v).sum::<f64>().sqrt());
        let length = dx.hypot(dy);
        if length < 2.0 * width {
            let _ = write!(svg, r#"<path stroke="{colour}" d="M{x:.1} {y:.1}h0"/>"#);
            continue;
        }
        // The head: two strokes at 30 degrees, a third of the arrow long and no longer than half a
        // lattice step.
        let head = (length / 3.0).min(step / 2.0) / length;
        let (bx, by) = (-0.866 * head * dx, -0.866 * head * dy);
        let (sx, sy) = (-0.5 * head * dy, 0.5 * head * dx);
        let _ = write!(
            svg,
            r#"<path stroke="{colour}" d="M{x:.1} {y:.1}l{dx:.1} {dy:.1}l{:.1} {:.1}m{:.1} {:.1}l{:.1} {:.1}"/>"#,
            bx + sx,
            by + sy,
            -bx - sx,
            -by - sy,
            bx - sx,
            by - sy
        );
    }
    svg.push_str("</g>");
    over(background, &format!("displacement arrows, {} plane", section.plane.name()), &svg)
}

/// How many times longer than in truth arrows should be, so that one of `length` mm fills about two
/// lattice steps.
pub(crate) fn arrow_factor(sections: &[Section], length: f64) -> f64 {
    let step = sections.iter().map(|s| s.lattice(ARROWS_ACROSS).1).fold(f64::INFINITY, f64::min);
    let wanted = 2.0 * step / length.max(1e-6);
    [1.0, 2.0, 3.0, 5.0, 10.0, 20.0, 50.0].into_iter().rfind(|f| *f <= wanted).unwrap_or(1.0)
}

/// Matches within `slab` mm of the section: the kept ones as dots coloured by their precision, the
/// rejected ones as crosses. At most 1,200 are drawn, evenly thinned.
pub fn matches(section: &Section, background: &Picture, matches: &[Match], slab: f64, scale: &Scale) -> String {
    let near: Vec<_> =
        matches.iter().map(|m| (m, section.place(m.initial))).filter(|(_, (_, behind))| behind.abs() <= slab).collect();
    let r = background.size_mm[0].max(background.size_mm[1]) / 160.0;
    let (mut kept, mut rejected) = (String::new(), String::new());
    for (m, ([x, y], _)) in near.iter().step_by(near.len().div_ceil(MAX_MATCHES_DRAWN).max(1)) {
        let _ = if m.kept {
            write!(kept, r#"<circle cx="{x:.1}" cy="{y:.1}" r="{r:.2}" fill="{}"/>"#, scale.hex(m.sigma()))
        } else {
            let (a, b) = (0.8 * r, 1.6 * r);
            write!(rejected, "M{:.1} {:.1}l{b:.1} {b:.1}m0 -{b:.1}l-{b:.1} {b:.1}", x - a, y - a)
        };
    }
    let content = format!(
        r##"<path d="{rejected}" fill="none" stroke="#ff5a5f" stroke-opacity=".7" stroke-width="{:.2}"/>{kept}"##,
        r / 2.5
    );
    over(background, &format!("matches, {} plane", section.plane.name()), &content)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::report::colormap::ColorMap;
    use crate::types::{Affine, Grid, WorldPoint};

    fn scene() -> (Grid, Section, Picture, Scale) {
        let grid = Grid::new([56, 56, 1], Affine::scaled([1.0; 3], [0.0; 3]).unwrap()).unwrap();
        let section = Section::through(&grid, WorldPoint([0.0; 3])).remove(0);
        let picture = Picture::gray(&section, |_| 0.0, [0.0, 1.0]).unwrap();
        (grid, section, picture, Scale::from_zero(1.0, "mm", ColorMap::Viridis))
    }

    #[test]
    fn an_arrow_points_up_for_a_motion_to_the_front() {
        let (grid, section, picture, scale) = scene();
        let field = DenseField::from_fn(grid, |_| [0.0, 3.0, 0.0]);
        let svg = arrows(&section, &picture, &field, None, 1.0, &scale);
        assert_eq!(svg.matches("<path").count(), 14 * 14);
        assert!(svg.contains("l0.0 -3.0l"), "down is positive in SVG");
        let mask = Mask::filled(grid, 0);
        assert!(!arrows(&section, &picture, &field, Some(&mask), 1.0, &scale).contains("<path"));
    }

    #[test]
    fn arrows_are_never_shortened_and_grow_by_round_factors() {
        let (_, section, ..) = scene();
        // Two lattice steps are 7 mm: 14 times half a millimetre.
        assert_eq!([0.0, 0.5, 100.0].map(|l| arrow_factor(std::slice::from_ref(&section), l)), [50.0, 10.0, 1.0]);
    }

    #[test]
    fn only_matches_near_the_plane_are_drawn() {
        let (_, section, picture, scale) = scene();
        let at = |z: f64, kept| Match {
            initial: WorldPoint([10.0, 10.0, z]),
            displacement: [0.0; 3],
            ncc: 0.9,
            covariance: [0.01, 0.01, 0.01, 0.0, 0.0, 0.0],
            kept,
            raw: None,
        };
        let svg = matches(&section, &picture, &[at(0.0, true), at(0.4, false), at(3.0, true)], 0.5, &scale);
        assert_eq!(svg.matches("<circle").count(), 1);
        assert_eq!(svg.matches("m0 -").count(), 1);
    }
}
