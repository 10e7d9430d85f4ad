//! Histograms, and where the time went.

use crate::report::colormap::ColorMap;
use crate::report::field::Values;
use crate::report::scale::{Scale, short, thousands};
use crate::report::statistics::Histogram;
use crate::types::SparseField;
use maud::{Markup, html};

/// A histogram as SVG; bars take the colours of `scale` where one is given.
pub(super) fn histogram(h: &Histogram, title: &str, unit: &str, scale: Option<&Scale>) -> Markup {
    let (width, height, top, base) = (320.0, 150.0, 22.0, 128.0);
    let most = h.counts.iter().copied().max().unwrap_or(0).max(1);
    let bar = width / h.counts.len() as f64;
    let bars = h.counts.iter().enumerate().filter(|(_, n)| **n > 0).map(|(i, &n)| {
        let tall = ((base - top) * n as f64 / most as f64).max(0.6);
        let middle = h.low + (i as f64 + 0.5) / h.counts.len() as f64 * (h.high - h.low);
        let [x, y, wide] = [i as f64 * bar + 0.4, base - tall, bar - 0.8].map(|v| format!("{v:.1}"));
        let fill = scale.map(|s| format!("fill:{}", s.hex(middle)));
        html! { rect.bar x=(x) y=(y) width=(wide) height=(format_args!("{tall:.1}")) style=[fill] {} }
    });
    let middle = format!("{} {unit}", short((h.low + h.high) / 2.0));
    html! {
        svg.chart viewBox=(format_args!("0 0 {width} {height}")) role="img" aria-label=(title) {
            text.strong x="0" y="12" { (title) }
            text x=(width) y="12" text-anchor="end" { (thousands(h.counts.iter().sum())) }
            @for bar in bars { (bar) }
            path.axis d=(format_args!("M0 {base}H{width}")) {}
            text x="0" y="144" { (short(h.low)) }
            text x="160" y="144" text-anchor="middle" { (middle.trim_end()) }
            text x=(width) y="144" text-anchor="end" { (short(h.high)) }
        }
    }
}

/// A histogram of a quantity over the voxels at `offsets`, in the colours of its scale.
pub(super) fn distribution(title: &str, values: Values<'_>, scale: &Scale, offsets: &[usize]) -> Markup {
    let counts = Histogram::new(offsets.iter().map(|&o| f64::from(values(o))), scale.low, scale.high, 40);
    histogram(&counts, title, scale.unit, Some(scale))
}

/// A histogram of the precision of the kept matches, in the colours of its scale.
pub(super) fn precision(matches: &SparseField, scale: &Scale) -> Markup {
    let sigma = Histogram::new(matches.kept().map(|m| m.sigma()), scale.low, scale.high, 40);
    histogram(&sigma, "Precision of kept matches", scale.unit, Some(scale))
}

/// Seconds by stage as one bar with a legend, in HTML.
pub(super) fn stage_times(seconds: &[(String, f64)]) -> Markup {
    let total = seconds.iter().map(|s| s.1).sum::<f64>().max(1e-9);
    let colour = |i: usize| ColorMap::Viridis.hex(0.15 + 0.75 * i as f64 / seconds.len() as f64);
    html! {
        div.times {
            @for (i, (stage, s)) in seconds.iter().enumerate() {
                i style=(format_args!("flex:{:.4};background:{}", s / total, colour(i)))
                    title=(format_args!("{stage}: {s:.2} s")) {}
            }
        }
        ul.legend {
            @for (i, (stage, s)) in seconds.iter().enumerate() {
                li { i style={ "background:" (colour(i)) } {} (stage) " " b { (format_args!("{s:.2} s")) } }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bars_are_as_tall_as_their_counts() {
        let h = Histogram { low: 0.0, high: 2.0, counts: vec![10, 0, 5] };
        let svg = histogram(&h, "length", "mm", None).into_string();
        assert_eq!(svg.matches("<rect").count(), 2);
        assert!(svg.contains(r#"height="106.0""#) && svg.contains(r#"height="53.0""#));
        assert!(svg.contains(">1 mm<") && svg.contains(">15<"));
    }

    #[test]
    fn shares_of_the_time_add_up() {
        let html = stage_times(&[("features".into(), 1.0), ("matching".into(), 3.0)]).into_string();
        assert!(html.contains("flex:0.2500") && html.contains("flex:0.7500") && html.contains("<b>3.00 s</b>"));
    }
}
