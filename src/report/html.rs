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
use crate::types::{Mesh, Trust};
use maud::{DOCTYPE, Markup, PreEscaped, Render, html};

/// Text as HTML, for drawings; templates escape by themselves.
///
/// ```
/// use palpate::report::html::escape;
/// assert_eq!(escape("a < b & c"), "a &lt; b &amp; c");
/// ```
pub fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// A page around `body`. Where pictures show left and right, a box mirrors them by the style sheet
/// alone.
pub(super) fn document(title: &str, body: &Markup) -> String {
    let sided = body.0.contains("<figure class=\"lr\"");
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width,initial-scale=1";
                meta name="color-scheme" content="light dark";
                title { (title) }
                style { (PreEscaped(include_str!("style.css"))) }
            }
            body {
                main {
                    @if sided {
                        label.convention {
                            input type="checkbox" id="radiological";
                            " radiological: patient's right on the left"
                        }
                    }
                    (body)
                }
            }
        }
        "\n"
    };
    page.into_string()
}

/// The head of a page: what it is about, what was found, and what more there is to say.
pub(super) fn header(heading: impl Render, verdict: &str, more: impl Render) -> Markup {
    html! {
        header {
            p.brand { "palpate " (env!("CARGO_PKG_VERSION")) }
            h1 { (heading) }
            p.verdict { (verdict) }
            (more)
        }
    }
}

/// A heading of a file's name and what was made of it.
pub(super) fn titled(name: &str, kind: &str) -> Markup {
    html! { (name) " " span { (kind) } }
}

/// How far to trust a result, and why.
pub(super) fn trusted(trust: Trust, reasons: &[String]) -> Markup {
    let trust = trust.name();
    html! { p class={ "trust " (trust) } { b { "Trust is " (trust) } " " (reasons.join("; ")) "." } }
}

/// Key numbers with their units and names.
pub(super) fn tiles<'a>(all: impl IntoIterator<Item = (String, &'a str, &'a str)>) -> Markup {
    html! {
        div.tiles {
            @for (value, unit, name) in all {
                div { b { (value) small { " " (unit) } } span { (name) } }
            }
        }
    }
}

/// The warnings, where there are any.
pub(super) fn warned(warnings: &[String]) -> Markup {
    listed("Warnings", warnings)
}

/// What a reader is to know first, where there is anything.
pub(super) fn listed(title: &str, all: &[String]) -> Markup {
    html! {
        @if !all.is_empty() {
            article.warnings {
                h3 { (title) }
                ul { @for one in all { li { (one) } } }
            }
        }
    }
}

/// The page for a field.
///
/// # Errors
/// [`ReportError`] when a picture cannot be encoded.
pub(crate) fn page(report: &FieldReport<'_>) -> Result<String, ReportError> {
    let views = Views::of(report)?;
    let body = html! {
        (head(report))
        (score(report, &views))
        (look(report, &views))
        (alignment(&views))
        (displacement(report, &views))
        @if let Some(strain) = &report.strain { (strain::section(strain)?) }
        (certainty(report, &views))
        (numbers(report))
        footer {
            p {
                "The displacement is defined on the initial volume: the tissue at x lies at x + u(x) in the deformed one. \
                 Positions are world mm, RAS. On disk the components of displacement.nii.gz are LPS, as ITK, ANTs and \
                 Slicer read them. Image similarity is no proof of accuracy: where there is no texture, only the \
                 uncertainty map tells."
            }
        }
    };
    Ok(document(&format!("{} to {}", report.names[0], report.names[1]), &body))
}

/// Verdict, key numbers, warnings.
fn head(report: &FieldReport<'_>) -> Markup {
    let (s, v) = (report.summary, verdict(report));
    let [initial, deformed, _] = report.names;
    let more = html! { (trusted(v.trust, &v.reasons)) p.next { b { "Next" } " " (v.next) "." } };
    html! {
        (header(html! { (initial) " " span { "→" } " " (deformed) }, &v.headline, more))
        (tiles([
            (format!("{:.2}", s.expected.mean_mm), "mm", "expected error"),
            (format!("{:.2}", s.mean_mm), "mm", "mean motion"),
            (format!("{:.2}", s.max_mm), "mm", "largest motion"),
            (thousands(s.counts.kept), "", "matches kept"),
            (thousands(s.folds), "", "voxels folded"),
            (format!("{:.1}", s.seconds.iter().map(|t| t.1).sum::<f64>()), "s", "total runtime"),
        ]))
        (warned(&s.warnings))
    }
}

/// The score against exact truth and where the error lies.
fn score(report: &FieldReport<'_>, views: &Views) -> Markup {
    let (Some((_, m)), Some(error)) = (report.truth, &views.error) else { return Markup::default() };
    html! {
        div.grid {
            article.score {
                h3 { "Against exact truth" }
                p {
                    "Mean error " b { (format_args!("{:.3}", m.mean_mm)) " mm" } "; "
                    (format_args!("{:.3}", m.identity_mm)) " mm before registration."
                }
                (tables::metrics(m))
            }
            (card(error))
        }
    }
}

/// The viewer, with the scales of the pictures.
fn look(report: &FieldReport<'_>, views: &Views) -> Markup {
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
        bounds: None,
        displacement: views.magnitude.scale.clone().map(|scale| (report.displacement, scale)),
        matches: Some((&report.matches.matches, views.matches.2.clone())),
        mesh: Some(elements(report.mesh)),
    };
    let (centre, mask, moments) = (views.centre, report.mask, &[&moment.pack(grid)]);
    let viewer = Viewer { grid, centre, mask, images: &images, shown: None, moments, first: 0 };
    html! {
        section {
            h2 { "Look" }
            p.lead {
                "Click or drag in a picture to move the planes, scroll to go through the slices. Numbers are those at the \
                 cross."
            }
            article.wide { (viewer.html()) }
        }
    }
}

/// The volumes and their differences.
fn alignment(views: &Views) -> Markup {
    let [x, y, z] = views.centre.0.map(|v| short((v * 10.0).round() / 10.0));
    html! {
        section {
            h2 { "Alignment" }
            p.lead {
                "Planes through the centre of motion, x " (x) ", y " (y) ", z " (z) " mm. "
                span.neuro { "The right of a picture is the patient's right" }
                span.radio { "The left of a picture is the patient's right" }
                "; of a sagittal one the right is the front."
            }
            div.grid {
                @for panel in &views.volumes { (card(panel)) }
                (blink(&views.volumes))
                @for panel in &views.differences { (card(panel)) }
            }
        }
    }
}

/// Where the pictures of a quantity are cut, and how large they are (mm).
fn planes(panel: &Panel) -> Vec<(Plane, [f64; 2])> {
    panel.pictures.iter().map(|p| (p.plane, p.size_mm)).collect()
}

/// Lengths, arrows, nodes and changes of volume.
fn displacement(report: &FieldReport<'_>, views: &Views) -> Markup {
    let lengths = views.magnitude.scale.as_ref();
    let (arrows, factor) = &views.arrows;
    let drawn = if *factor == 1.0 { "true to scale".into() } else { format!("drawn {} times as long", short(*factor)) };
    let note = format!("The part in the plane, initial to deformed, {drawn}. Colour is the whole length.");
    let nodes = match report.mesh {
        Mesh::Tetrahedra(m) => m.nodes(),
        Mesh::Triangles(m) => m.nodes(),
    };
    html! {
        section {
            h2 { "Displacement" }
            div.grid {
                (card(&views.magnitude))
                (drawings("Arrows", &note, &planes(&views.magnitude), arrows, lengths))
                @if let Some(scale) = lengths {
                    article {
                        h3 { "Mesh nodes" }
                        p { "Length at the " (thousands(nodes.len())) " mesh nodes." }
                        (PreEscaped(node_plot::scatter(nodes, report.node_displacement, scale)))
                        (legend(lengths))
                    }
                }
                (card(&views.jacobian))
                @if let Some(bodies) = &views.bodies { (card(bodies)) }
            }
        }
    }
}

/// Uncertainty, matches and how the quantities are distributed.
fn certainty(report: &FieldReport<'_>, views: &Views) -> Markup {
    let (dots, slab, precision) = &views.matches;
    let note = format!(
        "Matches within {} mm of the plane. Dots are kept, coloured by one standard deviation; red crosses are rejected.",
        short2(*slab)
    );
    html! {
        section {
            h2 { "How far to trust it" }
            div.grid {
                (card(&views.uncertainty))
                (drawings("Matches", &note, &planes(&views.magnitude), dots, Some(precision)))
                article.wide { h3 { "Distributions" } div.charts { (histograms(report, views)) } }
            }
        }
    }
}

fn numbers(report: &FieldReport<'_>) -> Markup {
    html! {
        section {
            h2 { "Numbers" }
            div.grid {
                article { h3 { "Counts" } (tables::counts(report)) }
                article { h3 { "Inputs" } (tables::inputs(report)) }
                @if let Some(landmarks) = tables::landmarks(report) {
                    article { h3 { "Landmarks" } (landmarks) }
                }
                article.wide { h3 { "Stages" } (tables::stages(report)) }
                article.wide { h3 { "Coarse to fine" } (tables::levels(report)) }
                article { h3 { "Bodies" } (tables::bodies(report)) }
                article {
                    h3 { "Motion model" }
                    ul { @for e in &report.summary.evidence { li { (e) } } }
                }
                article { h3 { "Time" } (chart::stage_times(&report.summary.seconds)) }
            }
        }
    }
}

/// A picture or drawing with its sides named.
pub(super) fn figure(plane: Plane, size: [f64; 2], content: impl Render) -> Markup {
    let [l, r, t, b] = plane.labels();
    html! {
        figure class=[(l == "L").then_some("lr")] style={ "flex:" (format_args!("{:.2}", size[0])) } {
            (content)
            i.l { (l) }
            i.r { (r) }
            i.t { (t) }
            i.b { (b) }
        }
    }
}

fn image(picture: &Picture, class: &str, name: &str) -> Markup {
    let [w, h] = picture.size_mm;
    html! {
        img class=(class) style={ "aspect-ratio:" (format_args!("{w:.2}/{h:.2}")) }
            alt={ (name) ", " (picture.plane.name()) " plane" } src=(picture.data_uri());
    }
}

/// A colour bar with three values.
pub(super) fn legend(scale: Option<&Scale>) -> Markup {
    let Some(scale) = scale else { return Markup::default() };
    let [low, middle, high] = scale.ticks();
    html! {
        div.bar {
            i style={ "background:linear-gradient(90deg," (scale.stops().join(",")) ")" } {}
            span { (low) }
            span { (middle) }
            span { (high) " " (scale.unit) }
        }
    }
}

pub(super) fn card(panel: &Panel) -> Markup {
    html! {
        article {
            h3 { (panel.title) }
            @if !panel.note.is_empty() { p { (panel.note) } }
            div.planes {
                @for p in &panel.pictures { (figure(p.plane, p.size_mm, image(p, "", &panel.title))) }
            }
            (legend(panel.scale.as_ref()))
        }
    }
}

/// The same of drawings, which are SVG already.
fn drawings(
    title: &str,
    note: &str,
    planes: &[(Plane, [f64; 2])],
    drawings: &[String],
    scale: Option<&Scale>,
) -> Markup {
    html! {
        article {
            h3 { (title) }
            p { (note) }
            div.planes {
                @for ((plane, size), svg) in planes.iter().zip(drawings) { (figure(*plane, *size, PreEscaped(svg))) }
            }
            (legend(scale))
        }
    }
}

/// Initial and warped volume in turns, in one place: what still moves is not aligned.
fn blink(volumes: &[Panel]) -> Markup {
    let [initial, _, warped] = volumes else { return Markup::default() };
    let both = |a, b| html! { (image(a, "", "initial")) (image(b, "blink", "warped")) };
    html! {
        article {
            h3 { "Initial and warped in turns" }
            p { "What still moves is not aligned. Point at it to hold it." }
            div.planes.hold {
                @for (a, b) in initial.pictures.iter().zip(&warped.pictures) {
                    (figure(a.plane, a.size_mm, both(a, b)))
                }
            }
        }
    }
}

fn histograms(report: &FieldReport<'_>, views: &Views) -> Markup {
    let inside = sample(report.initial.grid().len(), report.mask);
    let motion = |o| length(report.displacement, o);
    let panels: [(&Panel, Values<'_>, &str); 3] = [
        (&views.magnitude, &motion, "Displacement"),
        (&views.jacobian, report.jacobian, "Jacobian determinant"),
        (&views.uncertainty, report.uncertainty, "Uncertainty"),
    ];
    let ncc = Histogram::new(report.matches.kept().map(|m| f64::from(m.ncc)), 0.0, 1.0, 40);
    html! {
        @for (panel, values, title) in panels {
            @if let Some(scale) = &panel.scale { (chart::distribution(title, values, scale, &inside)) }
        }
        (chart::histogram(&ncc, "Correlation of kept matches", "", None))
        (chart::precision(report.matches, &views.matches.2))
    }
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
