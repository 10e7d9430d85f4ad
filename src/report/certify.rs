//! report.html, certificate.json and the short summary of `palpate certify`.

use crate::error::ReportError;
use crate::report::colormap::ColorMap;
use crate::report::field::Values;
use crate::report::html::{card, document, header, tiles, titled, warned};
use crate::report::json::{grid, seconds};
use crate::report::panels::{Panel, gray_range};
use crate::report::plot::{Line, Plot};
use crate::report::scale::{Scale, percent, significant};
use crate::report::section::Section;
use crate::report::statistics::{quantile, sample};
use crate::report::tables::{facts, table};
use crate::types::{Certificate, FieldParams, Mask, VoxelPoint, Voxels};
use maud::{Markup, html};
use serde_json::{Value, json};
use std::fmt::Write;

/// A certificate with the scan that it is about.
#[derive(Clone, Copy)]
pub(crate) struct CertifyReport<'a> {
    /// The scan and the second one (empty without), as they are called.
    pub names: [&'a str; 2],
    /// The scan.
    pub initial: &'a Voxels<'a>,
    /// Where there is tissue.
    pub tissue: &'a Mask,
    /// What was asked for.
    pub params: &'a FieldParams,
    /// Smallest displacement detected above noise (mm).
    pub detectable: Values<'a>,
    /// The numbers.
    pub certificate: &'a Certificate,
}

/// The result in a sentence.
pub fn headline(c: &Certificate) -> String {
    // A crest is half as wide as its wave is long.
    let smoothed = match c.wavelength_90_mm {
        Some(w) => format!("features smaller than {} mm are smoothed away", significant(w / 2.0)),
        None => "no feature that fits into the tissue comes back whole".into(),
    };
    let blind = format!("{} % of the tissue is blind", percent(c.blind_share));
    if c.wavelength_50_mm.is_none() {
        return format!("Strain cannot be measured: no wave comes back to half of its amplitude, and {blind}.");
    }
    if c.blind_share > 0.5 {
        return format!("Strain cannot be measured: {blind} to a motion of {} mm.", significant(c.amplitude_mm));
    }
    format!("Strain to ± {} % at a gauge of {} mm; {smoothed}.", percent(c.strain_noise), significant(c.gauge_mm))
}

/// The keys are those of docs/reference/file-formats.md.
pub(crate) fn summary(report: &CertifyReport<'_>) -> Value {
    let c = report.certificate;
    let mut out = json!({
        "version": env!("CARGO_PKG_VERSION"),
        "command": "certify",
        "headline": headline(c),
        "inputs": { "initial": report.names[0], "second": Some(report.names[1]).filter(|n| !n.is_empty()) },
        "grid": grid(report.initial.grid()),
        "params": report.params,
    });
    if let (Value::Object(out), Ok(Value::Object(numbers))) = (&mut out, serde_json::to_value(c)) {
        out.extend(numbers);
    }
    out["seconds"] = json!(seconds(&c.seconds));
    out
}

/// From which wavelength on so much comes back.
fn comes_back(level: &str, from: Option<f64>) -> String {
    match from {
        Some(w) => format!("{level} come back at a wavelength of {} mm", significant(w)),
        None => format!("no wave comes back to {level}"),
    }
}

/// What was found, a few lines.
pub(crate) fn text(report: &CertifyReport<'_>) -> String {
    let c = report.certificate;
    let mut out = format!("{}\n", headline(c));
    let from = match c.image_noise_from {
        "repeat" => "from the repeat scan",
        _ => "estimated from the scan alone",
    };
    let _ = writeln!(out, "  image noise  {} ({from})", significant(c.image_noise));
    let _ = writeln!(out, "  displacement ± {} mm by noise along an axis", significant(c.displacement_noise_mm));
    if let Some(moved) = c.rest_mm {
        let _ = writeln!(out, "  at rest      {} mm between the two scans", significant(moved));
    }
    let _ = writeln!(
        out,
        "  waves        {}, {}",
        comes_back("90 %", c.wavelength_90_mm),
        comes_back("50 %", c.wavelength_50_mm)
    );
    let gauges: Vec<String> = c
        .strain_noise_by_gauge
        .iter()
        .map(|g| format!("± {} % at {} mm", percent(g.noise), significant(g.gauge_mm)))
        .collect();
    let _ = writeln!(out, "  strain       {}", gauges.join(", "));
    let _ = writeln!(
        out,
        "  blind        {:.1} % of the tissue: a motion of {} mm does not rise above noise there",
        100.0 * c.blind_share,
        significant(c.amplitude_mm)
    );
    for i in &c.imposed {
        let _ = writeln!(
            out,
            "  {:<12} error {} mm of {} mm, {} mm expected",
            i.motion,
            significant(i.error_mm),
            significant(i.motion_mm),
            significant(i.expected_mm)
        );
    }
    let _ = writeln!(out, "  time         {:.1} s, {} runs", c.seconds.iter().map(|t| t.1).sum::<f64>(), c.runs);
    out
}

/// The page.
///
/// # Errors
/// [`ReportError`] when a picture cannot be encoded.
pub(crate) fn page(report: &CertifyReport<'_>) -> Result<String, ReportError> {
    let c = report.certificate;
    let wave = |length: Option<f64>, name| match length {
        Some(w) => (significant(w), "mm", name),
        None => ("none".into(), "", name),
    };
    let at_gauge = format!("noise of strain at {} mm", significant(c.gauge_mm));
    let gauges =
        c.strain_noise_by_gauge.iter().map(|g| [significant(g.gauge_mm), percent(g.noise), percent(g.detectable)]);
    let imposed = c.imposed.iter().map(|i| {
        let [motion, error, expected] = [i.motion_mm, i.error_mm, i.expected_mm].map(significant);
        [i.motion.clone(), motion, error, expected, percent(i.strain_error), format!("{:.1}", 100.0 * i.strain_held)]
    });
    let head = ["Motion", "Mean, mm", "Error, mm", "Expected error, mm", "Error of strain, %", "In the 95 % band, %"];
    let body = html! {
        (header(titled(report.names[0], "certificate"), &headline(c), ""))
        (tiles([
            (significant(c.displacement_noise_mm), "mm", "noise of a displacement along an axis"),
            (percent(c.strain_noise), "%", &at_gauge),
            wave(c.wavelength_90_mm, "wave that comes back to 90 %"),
            wave(c.wavelength_50_mm, "wave that comes back to 50 %"),
            (percent(c.blind_share), "%", "of the tissue is blind"),
        ]))
        (warned(&c.warnings))
        section {
            h2 { "Resolution and noise" }
            p.lead {
                "Waves of " (significant(c.amplitude_mm)) " mm were imposed on the scan, noise was added, and the same \
                 settings as those of a run measured them."
            }
            div.grid {
                article { (gain(c)) }
                article { (strain(c)) }
                article {
                    h3 { "Strain by gauge" }
                    (table(&["Gauge, mm", "Noise, %", "Smallest strain seen, %"], gauges))
                }
                (blind(report)?)
                article { h3 { "Settings" } (settings(report)) }
                article.wide { h3 { "Known motions" } (table(&head, imposed)) }
            }
        }
        footer {
            p {
                "A gauge is the side of the cube over which displacements give one strain. Waves are shears that keep the \
                 volume; a feature of half a wavelength is as wide as one crest. What moves during a scan, and what changes \
                 from scan to scan beside noise, is not in this certificate."
            }
        }
    };
    Ok(document(&format!("Certificate of {}", report.names[0]), &body))
}

/// Share of a wave that comes back, by its length.
fn gain(c: &Certificate) -> Markup {
    let gains: Vec<[f64; 2]> = c.gains.iter().map(|g| [g.wavelength_mm, g.gain]).collect();
    let whole = gains.iter().map(|g| [g[0], 1.0]).collect();
    let marks: Vec<(f64, bool)> =
        [c.wavelength_50_mm, c.wavelength_90_mm].into_iter().flatten().map(|w| (w, false)).collect();
    Plot { title: "Share of a wave's amplitude that comes back", across: "wavelength, mm", marks: &marks }
        .shown(&[Line::new("measured", 0, false, gains), Line::new("whole", 1, true, whole)])
}

/// Noise of strain, by the gauge.
fn strain(c: &Certificate) -> Markup {
    let noise = c.strain_noise_by_gauge.iter().map(|g| [g.gauge_mm, 100.0 * g.noise]).collect();
    Plot { title: "Noise of a normal strain, %", across: "gauge, mm", marks: &[(c.gauge_mm, false)] }
        .shown(&[Line::new("one standard deviation", 0, false, noise)])
}

/// Where the noise comes from and what was asked for.
fn settings(report: &CertifyReport<'_>) -> Markup {
    let c = report.certificate;
    let noise = match c.image_noise_from {
        "repeat" => format!("{} (from {})", significant(c.image_noise), report.names[1]),
        _ => format!("{} (estimated from the scan alone, added to both volumes)", significant(c.image_noise)),
    };
    let at_rest = c.rest_mm.map(|moved| ("Motion between the two scans", format!("{} mm", significant(moved))));
    let rows = [
        ("Noise of the image", noise),
        ("Amplitude of the waves", format!("{} mm", significant(c.amplitude_mm))),
        ("Preset", format!("{:?}", report.params.preset).to_lowercase()),
        ("Motion model", "free".into()),
        ("Runs of field", c.runs.to_string()),
    ];
    facts(rows.into_iter().chain(at_rest))
}

/// The map of the smallest displacement above noise.
fn blind(report: &CertifyReport<'_>) -> Result<Markup, ReportError> {
    let grid = report.initial.grid();
    let inside = sample(grid.len(), Some(report.tissue));
    let mut middle = [0.0; 3];
    for &at in &inside {
        let v = grid.voxel(at);
        (0..3).for_each(|a| middle[a] += v[a] as f64 / inside.len() as f64);
    }
    let sections = Section::through(grid, grid.affine().to_world(VoxelPoint(middle)));
    let most = quantile(inside.iter().map(|&o| f64::from((report.detectable)(o))), 0.98);
    let scale = Scale::from_zero(most, "mm", ColorMap::Magma);
    let base = (report.initial, gray_range(report.initial));
    let panel = Panel::coloured(
        "Smallest displacement above noise",
        &sections,
        base,
        Some(report.tissue),
        scale,
        report.detectable,
    )?;
    Ok(card(&panel.with_note("Along an axis, 95 % of the time. Bright: the tissue has little texture of its own.")))
}
