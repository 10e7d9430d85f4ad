//! Histograms, and where the time went.

use crate::report::field::Values;
use crate::report::scale::{Scale, short, thousands};
use crate::report::statistics::Histogram;
use crate::types::SparseField;
use std::fmt::Write;

/// A histogram as SVG; bars take the colours of `scale` where one is given.
pub fn histogram(h: &Histogram, title: &str, unit: &str, scale: Option<&Scale>) -> String {
    let (width, height, top, base) = (320.0, 150.0, 22.0, 128.0);
    let most = h.counts.iter().copied().max().unwrap_or(0).max(1);
    let bar = width / h.counts.len() as f64;
    let mut svg = format!(
        r#"<svg class="chart" viewBox="0 0 {width} {height}" role="img" aria-label="{title}"><text x="0" y="12" class="strong">{title}</text><text x="{width}" y="12" text-anchor="end">{}</text>"#,
        thousands(h.counts.iter().sum())
    );
    for (i, &n) in h.counts.iter().enumerate().filter(|(_, n)| **n > 0) {
        let tall = ((base - top) * n as f64 / most as f64).max(0.6);
        let middle = h.low + (i as f64 + 0.5) / h.counts.len() as f64 * (h.high - h.low);
        let fill = scale.map(|s| format!(r#" style="fill:{}""#, s.hex(middle))).unwrap_or_default();
        let _ = write!(
            svg,
            r#"<rect class="bar" x="{:.1}" y="{:.1}" width="{:.1}" height="{tall:.1}"{fill}/>"#,
            i as f64 * bar + 0.4,
            base - tall,
            bar - 0.8
        );
    }
    let unit = if unit.is_empty() { String::new() } else { format!(" {unit}") };
    let _ = write!(
        svg,
        r#"<path class="axis" d="M0 {base}H{width}"/><text x="0" y="144">{}</text><text x="160" y="144" text-anchor="middle">{}{unit}</text><text x="{width}" y="144" text-anchor="end">{}</text></svg>"#,
        short(h.low),
        short((h.low + h.high) / 2.0),
        short(h.high)
    );
    svg
}

/// A histogram of a quantity over the voxels at `offsets`, in the colours of its scale.
pub fn distribution(title: &str, values: Values<'_>, scale: &Scale, offsets: &[usize]) -> String {
    let counts = Histogram::new(offsets.iter().map(|&o| f64::from(values(o))), scale.low, scale.high, 40);
    histogram(&counts, title, scale.unit, Some(scale))
}

/// A histogram of the precision of the kept matches, in the colours of its scale.
pub fn precision(matches: &SparseField, scale: &Scale) -> String {
    let sigma = Histogram::new(matches.kept().map(|m| m.sigma()), scale.low, scale.high, 40);
    histogram(&sigma, "Precision of kept matches", scale.unit, Some(scale))
}

/// Seconds by stage as one bar with a legend, in HTML.
pub fn stage_times(seconds: &[(String, f64)]) -> String {
    let total = seconds.iter().map(|s| s.1).sum::<f64>().max(1e-9);
    let (mut bar, mut legend) = (String::new(), String::new());
    for (i, (stage, s)) in seconds.iter().enumerate() {
        let colour = crate::report::colormap::ColorMap::Viridis.hex(0.15 + 0.75 * i as f64 / seconds.len() as f64);
        let _ = write!(bar, r#"<i style="flex:{:.4};background:{colour}" title="{stage}: {s:.2} s"></i>"#, s / total);
        let _ = write!(legend, r#"<li><i style="background:{colour}"></i>{stage} <b>{s:.2} s</b></li>"#);
    }
    format!(r#"<div class="times">{bar}</div><ul class="legend">{legend}</ul>"#)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bars_are_as_tall_as_their_counts() {
        let h = Histogram { low: 0.0, high: 2.0, counts: vec![10, 0, 5] };
        let svg = histogram(&h, "length", "mm", None);
        assert_eq!(svg.matches("<rect").count(), 2);
        assert!(svg.contains(r#"height="106.0""#) && svg.contains(r#"height="53.0""#));
        assert!(svg.contains(">1 mm<") && svg.contains(">15<"));
    }

    #[test]
    fn shares_of_the_time_add_up() {
        let html = stage_times(&[("features".into(), 1.0), ("matching".into(), 3.0)]);
        assert!(html.contains("flex:0.2500") && html.contains("flex:0.7500") && html.contains("<b>3.00 s</b>"));
    }
}
