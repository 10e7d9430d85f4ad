//! report.html: one page that stands alone, offline, in light and dark.

use crate::error::ReportError;
use crate::report::colormap::ColorMap;
use crate::report::field::{FieldReport, Values};
use crate::report::node_plot;
use crate::report::panels::{Panel, length};
use crate::report::picture::Picture;
use crate::report::scale::{Scale, short, thousands};
use crate::report::section::Plane;
use crate::report::statistics::{Histogram, sample};
use crate::report::verdict::{short2, verdict};
use crate::report::viewer::{Layer, Moment, Viewer, elements};
use crate::report::views::Views;
use crate::report::{chart, strain, tables};
use crate::types::Mesh;
use std::fmt::Write;

const STYLE: &str = include_str!("style.css");

/// Text as HTML.
///
/// ```
/// use palpate::report::html::escape;
/// assert_eq!(escape("a < b & c"), "a &lt; b &amp; c");
/// ```
pub fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// The page for a field.
///
/// # Errors
/// [`ReportError`] when a picture cannot be encoded.
pub fn page(report: &FieldReport<'_>) -> Result<String, ReportError> {
    let views = Views::of(report)?;
    let mut body = head(report);
    body.push_str(&score(report, &views));

    body.push_str(&look(report, &views));

    let [x, y, z] = views.centre.0.map(|v| short((v * 10.0).round() / 10.0));
    let _ = write!(
        body,
        "<section><h2>Alignment</h2><p class=\"lead\">Planes through the centre of motion, x {x}, y {y}, z {z} mm. \
         <span class=\"neuro\">The right of a picture is the patient's right</span><span class=\"radio\">The left of a picture is the \
         patient's right</span>; of a sagittal one the right is the front.</p><div class=\"grid\">"
    );
    views.volumes.iter().for_each(|p| body.push_str(&card(p)));
    body.push_str(&blink(&views.volumes));
    views.differences.iter().for_each(|p| body.push_str(&card(p)));
    body.push_str("</div></section><section><h2>Displacement</h2><div class=\"grid\">");
    body.push_str(&card(&views.magnitude));
    let planes: Vec<(Plane, [f64; 2])> = views.magnitude.pictures.iter().map(|p| (p.plane, p.size_mm)).collect();
    let lengths = views.magnitude.scale.as_ref();
    let (arrows, factor) = &views.arrows;
    let note = format!(
        "The part in the plane, initial to deformed, {}. Colour is the whole length.",
        if *factor == 1.0 { "true to scale".into() } else { format!("drawn {} times as long", short(*factor)) }
    );
    body.push_str(&drawn("Arrows", &note, &planes, arrows, lengths));
    if let Some(scale) = lengths {
        let mesh_nodes = match report.mesh {
            Mesh::Tetrahedra(m) => m.nodes(),
            Mesh::Triangles(m) => m.nodes(),
        };
        let note = format!("Length at the {} mesh nodes.", thousands(mesh_nodes.len()));
        let drawing = node_plot::scatter(mesh_nodes, report.node_displacement, scale);
        let _ = write!(body, "<article><h3>Mesh nodes</h3><p>{note}</p>{drawing}{}</article>", legend(Some(scale)));
    }
    body.push_str(&card(&views.jacobian));
    if let Some(bodies) = &views.bodies {
        body.push_str(&card(bodies));
    }
    body.push_str("</div></section>");
    if let Some(strain) = &report.strain {
        body.push_str(&strain::section(strain)?);
    }
    body.push_str("<section><h2>How far to trust it</h2><div class=\"grid\">");
    body.push_str(&card(&views.uncertainty));
    let (dots, slab, precision) = &views.matches;
    let note = format!(
        "Matches within {} mm of the plane. Dots are kept, coloured by one standard deviation; red crosses are rejected.",
        short2(*slab)
    );
    body.push_str(&drawn("Matches", &note, &planes, dots, Some(precision)));
    let _ = write!(
        body,
        "<article class=\"wide\"><h3>Distributions</h3><div class=\"charts\">{}</div></article>",
        histograms(report, &views)
    );
    let _ = write!(
        body,
        "</div></section><section><h2>Numbers</h2><div class=\"grid\"><article><h3>Counts</h3>{}</article><article><h3>Inputs</h3>{}</article>",
        tables::counts(report),
        tables::inputs(report)
    );
    if let Some(landmarks) = tables::landmarks(report) {
        let _ = write!(body, "<article><h3>Landmarks</h3>{landmarks}</article>");
    }
    let evidence: String = report.summary.evidence.iter().map(|e| format!("<li>{}</li>", escape(e))).collect();
    let _ = write!(
        body,
        "<article class=\"wide\"><h3>Stages</h3>{}</article><article class=\"wide\"><h3>Coarse to fine</h3>{}</article><article><h3>Bodies</h3>{}</article><article><h3>Motion model</h3><ul>{evidence}</ul></article><article><h3>Time</h3>{}</article></div></section>",
        tables::stages(report),
        tables::levels(report),
        tables::bodies(report),
        chart::stage_times(&report.summary.seconds)
    );
    let title = format!("{} to {}", escape(report.names[0]), escape(report.names[1]));
    body.push_str(footer());
    Ok(document(&title, &body))
}

/// Mirrors the pictures across the patient's left and right, by the style sheet alone.
const CONVENTION: &str = "<label class=\"convention\"><input type=\"checkbox\" id=\"radiological\"> radiological: \
                          patient's right on the left</label>";

/// A page around `body`; `title` is HTML already.
pub(super) fn document(title: &str, body: &str) -> String {
    let convention = if body.contains("<figure class=\"lr\"") { CONVENTION } else { "" };
    format!(
        "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width,initial-scale=1\"><meta name=\"color-scheme\" content=\"light dark\"><title>{title}</title><style>{STYLE}</style></head><body><main>{convention}{body}</main></body></html>\n"
    )
}

/// The viewer, with the scales of the pictures.
fn look(report: &FieldReport<'_>, views: &Views) -> String {
    let (range, [before, after]) = views.gray;
    let scale = |gain: f32| {
        let [low, high] = range.map(|r| r / f64::from(gain));
        Scale { low, high, unit: "", map: ColorMap::Gray }
    };
    let initial = report.initial.as_slice();
    let initial: Values<'_> = &|o| initial[o];
    let images = [("initial", initial, 1.0), ("deformed", report.deformed, before), ("warped", report.warped, after)]
        .map(|(name, values, gain)| Layer { name, values, scale: scale(gain) });
    let coloured =
        |name: &'static str, panel: &Panel, values| panel.scale.clone().map(|scale| Layer { name, values, scale });
    let overlays: Vec<Layer<'_>> = [
        coloured("Jacobian determinant", &views.jacobian, report.jacobian),
        coloured("Uncertainty", &views.uncertainty, report.uncertainty),
    ]
    .into_iter()
    .flatten()
    .collect();
    let grid = report.initial.grid();
    let moment = Moment {
        name: None,
        images: &[],
        overlays: &overlays,
        displacement: views.magnitude.scale.clone().map(|scale| (report.displacement, scale)),
        matches: Some((&report.matches.matches, views.matches.2.clone())),
        mesh: Some(elements(report.mesh)),
    };
    let (centre, mask, moments) = (views.centre, report.mask, &[&moment.pack(grid)]);
    let viewer = Viewer { grid, centre, mask, images: &images, shown: None, moments, first: 0 };
    format!("<section><h2>Look</h2>{LOOK}<article class=\"wide\">{}</article></section>", viewer.html())
}

const LOOK: &str = "<p class=\"lead\">Click or drag in a picture to move the planes, scroll to go through the slices. Numbers \
                    are those at the cross.</p>";

/// The warnings, where there are any.
pub(super) fn warned(warnings: &[String]) -> String {
    if warnings.is_empty() {
        return String::new();
    }
    let items: String = warnings.iter().map(|w| format!("<li>{}</li>", escape(w))).collect();
    format!("<article class=\"warnings\"><h3>Warnings</h3><ul>{items}</ul></article>")
}

/// Verdict, key numbers, warnings.
fn head(report: &FieldReport<'_>) -> String {
    let (s, v) = (report.summary, verdict(report));
    let [initial, deformed, _] = report.names.map(escape);
    let tile = |value: String, unit: &str, name: &str| {
        format!("<div><b>{value}<small> {unit}</small></b><span>{name}</span></div>")
    };
    let seconds: f64 = s.seconds.iter().map(|t| t.1).sum();
    let mut out = format!(
        "<header><p class=\"brand\">palpate {}</p><h1>{initial} <span>→</span> {deformed}</h1>\
         <p class=\"verdict\">{}</p><p class=\"trust {trust}\"><b>Trust is {trust}</b> {}.</p><p class=\"next\"><b>Next</b> {}.</p></header><div class=\"tiles\">{}{}{}{}{}{}</div>",
        env!("CARGO_PKG_VERSION"),
        escape(&v.headline),
        escape(&v.reasons.join("; ")),
        escape(&v.next),
        tile(format!("{:.2}", s.expected.mean_mm), "mm", "expected error"),
        tile(format!("{:.2}", s.mean_mm), "mm", "mean motion"),
        tile(format!("{:.2}", s.max_mm), "mm", "largest motion"),
        tile(thousands(s.counts.kept), "", "matches kept"),
        tile(thousands(s.folds), "", "voxels folded"),
        tile(format!("{seconds:.1}"), "s", "total runtime"),
        trust = v.trust.name()
    );
    out.push_str(&warned(&s.warnings));
    out
}

/// The score against exact truth and where the error lies.
fn score(report: &FieldReport<'_>, views: &Views) -> String {
    let (Some((_, m)), Some(error)) = (report.truth, &views.error) else { return String::new() };
    format!(
        "<div class=\"grid\"><article class=\"score\"><h3>Against exact truth</h3><p>Mean error <b>{:.3} mm</b>; {:.3} mm before \
         registration.</p>{}</article>{}</div>",
        m.mean_mm,
        m.identity_mm,
        tables::metrics(m),
        card(error)
    )
}

/// A picture or drawing with its sides named.
pub(super) fn figure(plane: Plane, size: [f64; 2], content: &str) -> String {
    let [l, r, t, b] = plane.labels();
    let class = if l == "L" { " class=\"lr\"" } else { "" };
    format!(
        "<figure{class} style=\"flex:{:.2}\">{content}<i class=\"l\">{l}</i><i class=\"r\">{r}</i><i class=\"t\">{t}</i><i class=\"b\">{b}</i></figure>",
        size[0]
    )
}

fn image(picture: &Picture, class: &str, name: &str) -> String {
    let [w, h] = picture.size_mm;
    format!(
        "<img class=\"{class}\" style=\"aspect-ratio:{w:.2}/{h:.2}\" alt=\"{}, {} plane\" src=\"{}\">",
        escape(name),
        picture.plane.name(),
        picture.data_uri()
    )
}

/// A colour bar with three values.
pub(super) fn legend(scale: Option<&Scale>) -> String {
    let Some(scale) = scale else { return String::new() };
    let [low, middle, high] = scale.ticks();
    format!(
        "<div class=\"bar\"><i style=\"background:linear-gradient(90deg,{})\"></i><span>{low}</span><span>{middle}</span><span>{high} {}</span></div>",
        scale.stops().join(","),
        scale.unit
    )
}

pub(super) fn card(panel: &Panel) -> String {
    let figures: String =
        panel.pictures.iter().map(|p| figure(p.plane, p.size_mm, &image(p, "", &panel.title))).collect();
    let note = if panel.note.is_empty() { String::new() } else { format!("<p>{}</p>", escape(&panel.note)) };
    format!(
        "<article><h3>{}</h3>{note}<div class=\"planes\">{figures}</div>{}</article>",
        escape(&panel.title),
        legend(panel.scale.as_ref())
    )
}

fn drawn(title: &str, note: &str, planes: &[(Plane, [f64; 2])], drawings: &[String], scale: Option<&Scale>) -> String {
    let figures: String = planes.iter().zip(drawings).map(|((plane, size), svg)| figure(*plane, *size, svg)).collect();
    format!("<article><h3>{title}</h3><p>{note}</p><div class=\"planes\">{figures}</div>{}</article>", legend(scale))
}

/// Initial and warped volume in turns, in one place: what still moves is not aligned.
fn blink(volumes: &[Panel]) -> String {
    let [initial, _, warped] = volumes else { return String::new() };
    let figures: String = initial
        .pictures
        .iter()
        .zip(&warped.pictures)
        .map(|(a, b)| figure(a.plane, a.size_mm, &(image(a, "", "initial") + &image(b, "blink", "warped"))))
        .collect();
    format!(
        "<article><h3>Initial and warped in turns</h3><p>What still moves is not aligned. Point at it to hold it.</p><div class=\"planes hold\">{figures}</div></article>"
    )
}

fn histograms(report: &FieldReport<'_>, views: &Views) -> String {
    let inside = sample(report.initial.grid().len(), report.mask);
    let motion = |o| length(report.displacement, o);
    let panels: [(&Panel, Values<'_>, &str); 3] = [
        (&views.magnitude, &motion, "Displacement"),
        (&views.jacobian, report.jacobian, "Jacobian determinant"),
        (&views.uncertainty, report.uncertainty, "Uncertainty"),
    ];
    let mut out: String = panels
        .into_iter()
        .filter_map(|(panel, values, title)| Some(chart::distribution(title, values, panel.scale.as_ref()?, &inside)))
        .collect();
    let ncc = Histogram::new(report.matches.kept().map(|m| f64::from(m.ncc)), 0.0, 1.0, 40);
    out.push_str(&chart::histogram(&ncc, "Correlation of kept matches", "", None));
    out + &chart::precision(report.matches, &views.matches.2)
}

fn footer() -> &'static str {
    "<footer><p>The displacement is defined on the initial volume: the tissue at x lies at x + u(x) in the deformed one. \
     Positions are world mm, RAS. On disk the components of displacement.nii.gz are LPS, as ITK, ANTs and Slicer read them. \
     Image similarity is no proof of accuracy: where there is no texture, only the uncertainty map tells.</p></footer>"
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::report::field::tests::Case;
    use crate::types::Metrics;

    #[test]
    fn the_page_stands_alone_and_closes_what_it_opens() {
        let case = Case::new([24, 20, 9], [1.0, 1.0, 4.0]);
        let metrics = Metrics { mean_mm: 0.25, ..Metrics::default() };
        let html = page(&FieldReport { truth: Some((&case.displacement, &metrics)), ..case.report() }).unwrap();
        for tag in ["article", "section", "figure", "div", "table", "svg", "p", "ul", "li", "b", "span", "i"] {
            let opened = html.matches(&format!("<{tag}>")).count() + html.matches(&format!("<{tag} ")).count();
            assert_eq!(opened, html.matches(&format!("</{tag}>")).count(), "<{tag}>");
        }
        // What is packed may hold any letters.
        let packed = html.find("application/json").unwrap();
        let end = packed + html[packed..].find("</script>").unwrap();
        let html = format!("{}{}", &html[..packed], &html[end..]);
        for outside in ["http://", "https://", "<script src", "<link", "@import"] {
            assert!(!html.contains(outside), "{outside}");
        }
        assert!(html.contains("prefers-color-scheme"));
        assert!(html.contains("a&lt;b&gt;.nii") && !html.contains("a<b>"));
        assert!(html.contains("two of &lt;three&gt; slices"));
        assert!(html.contains("0.250 mm"));
        assert!(!html.contains("NaN"));
    }

    #[test]
    fn a_large_volume_gives_a_small_page() {
        let case = Case::new([400, 380, 12], [0.5, 0.5, 4.0]);
        let size = page(&case.report()).unwrap().len();
        assert!(size < 4_000_000, "{size} bytes");
    }
}
