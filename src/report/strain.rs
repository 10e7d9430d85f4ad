//! report.html, summary.json and the short summary of `palpate strain`, and its part of a field's
//! page.

use crate::error::ReportError;
use crate::report::colormap::ColorMap;
use crate::report::field::Values;
use crate::report::html::{card, document, header, tiles, titled, trusted, warned};
use crate::report::json::{grid, seconds};
use crate::report::panels::{Panel, centre_of_motion, gray_range};
use crate::report::scale::{Scale, percent, significant, thousands};
use crate::report::section::Section;
use crate::report::statistics::{quantile, sample};
use crate::report::tables::table;
use crate::types::{DenseField, Mask, RegionStrain, StrainSummary, Voxels};
use maud::{Markup, html};
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;
use std::fmt::Write;

/// Strain with what it was taken from, all on one grid.
#[derive(Clone, Copy)]
pub(crate) struct StrainReport<'a> {
    /// The field, as it is called.
    pub name: &'a str,
    /// The displacement (mm, RAS).
    pub displacement: &'a DenseField,
    /// An image of the tissue, where there is one.
    pub image: Option<&'a Voxels<'a>>,
    /// The body of each voxel; 0 outside.
    pub bodies: &'a Mask,
    /// Largest principal strain (1).
    pub largest: Values<'a>,
    /// Smallest principal strain (1).
    pub smallest: Values<'a>,
    /// Largest shear (1).
    pub shear: Values<'a>,
    /// Relative change of volume (1).
    pub volume: Values<'a>,
    /// Standard deviation of a normal strain (1).
    pub deviation: Values<'a>,
    /// The rest.
    pub summary: &'a StrainSummary,
}

fn measure(report: &StrainReport<'_>) -> &'static str {
    match report.summary.measure.name() {
        "green-lagrange" => "Green-Lagrange strain",
        "small" => "small strain",
        _ => "logarithmic strain",
    }
}

/// The result in a sentence.
pub(crate) fn headline(report: &StrainReport<'_>) -> String {
    let s = report.summary;
    if !s.drawn {
        return format!(
            "Strain over a gauge of {} mm, {} % on root mean square; noise between neighbouring voxels alone leaves ± {} %.",
            significant(s.gauge_mm),
            percent(s.strain),
            percent(s.noise)
        );
    }
    format!(
        "Strain over a gauge of {} mm is known to ± {} % (one standard deviation of a normal strain); its root mean square is {} %.",
        significant(s.gauge_mm),
        percent(s.noise),
        percent(s.strain)
    )
}

/// Where the gauge comes from.
fn gauge(s: &StrainSummary) -> String {
    let sides = s.gauge_axes_mm.map(significant).join(" x ");
    let why = if s.gauge_asked { "as asked" } else { "the least error to expect" };
    format!("{} mm ({sides} along the voxel axes), {why}", significant(s.gauge_mm))
}

/// The keys are those of docs/reference/file-formats.md.
pub(crate) fn summary(report: &StrainReport<'_>) -> Value {
    let s = report.summary;
    let mut regions: BTreeMap<String, Map<String, Value>> = BTreeMap::new();
    for r in &s.regions {
        let [mean, sd, p5, p95] = r.values;
        let known = |v: f64| if v.is_finite() { json!(v) } else { Value::Null };
        let [mean_sd, sd_sd, p5_sd, p95_sd] = r.errors.map(known);
        let value = json!({
            "mean": mean, "sd": sd, "p5": p5, "p95": p95,
            "mean_sd": mean_sd, "sd_sd": sd_sd, "p5_sd": p5_sd, "p95_sd": p95_sd, "voxels": r.voxels,
        });
        regions.entry(r.label.to_string()).or_default().insert(r.component.into(), value);
    }
    json!({
        "version": env!("CARGO_PKG_VERSION"),
        "command": "strain",
        "inputs": { "field": report.name },
        "grid": grid(report.displacement.grid()),
        "measure": s.measure,
        "gauge_mm": s.gauge_mm,
        "gauge_axes_mm": s.gauge_axes_mm,
        "gauge_asked": s.gauge_asked,
        "gauges": s.gauges,
        "noise": s.noise,
        "strain_rms": s.strain,
        "deviation_from": s.deviation_from,
        "regions": regions,
        "trust": s.trust.name(),
        "trust_reasons": s.trust_reasons,
        "seconds": seconds(&s.seconds),
        "warnings": s.warnings,
    })
}

/// What is shown of a region on the console and in the table.
const SHOWN: [&str; 9] = ["e1", "e2", "e3", "shear", "volume", "fibre", "radial", "circumferential", "axial"];

/// The rows of the regions: label, component and the four numbers in percent.
fn rows(regions: &[RegionStrain]) -> Vec<Vec<String>> {
    let shown = regions.iter().filter(|r| SHOWN.contains(&r.component));
    let with = |v: f64, error: f64| match error.is_finite() {
        true => format!("{} ± {}", percent(v), percent(error)),
        false => percent(v),
    };
    let row = |r: &RegionStrain| {
        let numbers = (0..4).map(|k| with(r.values[k], r.errors[k]));
        [r.label.to_string(), r.component.to_string()].into_iter().chain(numbers).chain([thousands(r.voxels)]).collect()
    };
    shown.map(row).collect()
}

/// What was found, a few lines.
pub(crate) fn text(report: &StrainReport<'_>) -> String {
    let s = report.summary;
    let mut out = format!("{}\n", headline(report));
    let _ = writeln!(out, "  measure      {}", measure(report));
    let _ = writeln!(out, "  gauge        {}", gauge(s));
    let _ = writeln!(out, "  deviation    from {}", s.deviation_from);
    let mut labels: Vec<u8> = s.regions.iter().map(|r| r.label).collect();
    labels.dedup();
    for label in labels.iter().take(8) {
        let mean = |component: &str| {
            let found = s.regions.iter().find(|r| r.label == *label && r.component == component)?;
            let error =
                if found.errors[0].is_finite() { format!(" ± {}", percent(found.errors[0])) } else { "".into() };
            Some(format!("{component} {}{error} %", percent(found.values[0])))
        };
        let means: Vec<String> = SHOWN.iter().filter_map(|c| mean(c)).collect();
        let _ = writeln!(out, "  {:<12} {}", format!("label {label}"), means.join(", "));
    }
    let _ = writeln!(out, "  trust        {}: {}", s.trust.name(), s.trust_reasons.join("; "));
    out
}

/// Pictures, regions and gauges, with the result in a sentence.
///
/// # Errors
/// [`ReportError`] when a picture cannot be encoded.
pub(super) fn section(report: &StrainReport<'_>) -> Result<Markup, ReportError> {
    pictures(report, &format!("{} ", headline(report)))
}

/// The same after other words.
fn pictures(report: &StrainReport<'_>, lead: &str) -> Result<Markup, ReportError> {
    let s = report.summary;
    let grid = report.displacement.grid();
    let centre = centre_of_motion(report.displacement, Some(report.bodies));
    let sections = Section::through(grid, centre);
    let blank = Voxels::filled(*grid, 0.0f32);
    let image = report.image.unwrap_or(&blank);
    let base = (image, gray_range(image));
    let inside = sample(grid.len(), Some(report.bodies));
    let most = |values: Values<'_>| quantile(inside.iter().map(|&o| 100.0 * f64::from(values(o)).abs()), 0.98);
    let panel = |title: &str, values: Values<'_>, scale: Scale, note: &str| {
        let shown = |o: usize| 100.0 * values(o);
        Ok(card(&Panel::coloured(title, &sections, base, Some(report.bodies), scale, shown)?.with_note(note)))
    };
    let about = |values: Values<'_>| Scale::about(0.0, most(values), "%");
    let from_zero = |values: Values<'_>, map| Scale::from_zero(most(values), "%", map);
    let pictures = [
        panel(
            "Largest principal strain",
            report.largest,
            about(report.largest),
            "Red: how much the tissue is stretched, the way it is stretched most.",
        )?,
        panel(
            "Smallest principal strain",
            report.smallest,
            about(report.smallest),
            "Blue: how much it is shortened, the way it is shortened most.",
        )?,
        panel("Largest shear", report.shear, from_zero(report.shear, ColorMap::Viridis), "")?,
        panel(
            "Change of volume",
            report.volume,
            about(report.volume),
            "Muscle keeps its volume: what departs from 0 is error, or fluid.",
        )?,
        panel(
            "Standard deviation",
            report.deviation,
            from_zero(report.deviation, ColorMap::Magma),
            "Of a normal strain, in the same places.",
        )?,
    ];
    let gauges = s.gauges.iter().map(|g| [significant(g.gauge_mm), percent(g.noise), percent(g.error)]);
    let head = ["Label", "Component", "Mean, %", "Spread, %", "5th percentile, %", "95th percentile, %", "Voxels"];
    Ok(html! {
        section {
            h2 { "Strain" }
            p.lead { (lead) "Gauge " (gauge(s)) ". Deviation from " (s.deviation_from) "." }
            div.grid {
                @for picture in &pictures { (picture) }
                @if !s.gauges.is_empty() {
                    article {
                        h3 { "Gauges that were tried" }
                        p { "The error holds what a longer gauge smooths away." }
                        (table(&["Gauge, mm", "Noise, %", "Error to expect, %"], gauges))
                    }
                }
                article.wide { h3 { "Regions" } (table(&head, rows(&s.regions))) }
            }
        }
    })
}

/// The page.
///
/// # Errors
/// [`ReportError`] when a picture cannot be encoded.
pub(crate) fn page(report: &StrainReport<'_>) -> Result<String, ReportError> {
    let s = report.summary;
    let voxels = report.bodies.as_slice().iter().filter(|l| **l != 0).count();
    let body = html! {
        (header(titled(report.name, "strain"), &headline(report), trusted(s.trust, &s.trust_reasons)))
        (tiles([
            (percent(s.noise), "%", "deviation of a normal strain"),
            (percent(s.strain), "%", "root mean square strain"),
            (significant(s.gauge_mm), "mm", "gauge length"),
            (thousands(voxels), "", "voxels"),
        ]))
        (warned(&s.warnings))
        (pictures(report, "")?)
        footer {
            p {
                "Strain is on the initial volume, axes right, anterior, superior. A gauge is the side of the cube over which \
                 displacements give one strain: what is finer is smoothed away."
            }
        }
    };
    Ok(document(&format!("Strain of {}", report.name), &body))
}
