//! Text, JSON and page of a stiffness result.

use crate::error::ReportError;
use crate::report::colormap::ColorMap;
use crate::report::field::Values;
use crate::report::html::{card, document, header, tiles, warned};
use crate::report::panels::{Panel, gray_range, length};
use crate::report::plot::{Line, Plot};
use crate::report::scale::{Scale, short, thousands};
use crate::report::section::Section;
use crate::report::statistics::{quantile, sample};
use crate::report::tables::table;
use crate::report::verdict::short2;
use crate::report::viewer::{Bounds, Layer, Moment, Viewer};
use crate::report::{chart, json};
use crate::types::stiffness::{
    Detectable, Determined, Evidence, FrameStiffness, Gain, LeftOver, PatchReport, RegionStiffness, SharedStiffness,
    StiffnessResult,
};
use crate::types::{DenseField, Mask, Volume, WorldPoint};
use maud::{Markup, html};
use serde_json::{Map, Value, json};
use std::fmt::Write;

/// Names of what was given.
#[derive(Debug, Clone, PartialEq)]
pub struct InputNames {
    /// The field.
    pub field: String,
    /// Mask or labels.
    pub body: String,
    /// Matches.
    pub matches: Option<String>,
    /// As on the command line.
    pub held: String,
    /// As on the command line.
    pub load: String,
}

/// A modulus with its uncertainty, or the bound.
fn modulus(r: &RegionStiffness, absolute: bool) -> String {
    let unit = if absolute { " kPa" } else { "" };
    let value = digits(r.youngs_modulus);
    match (r.state, r.bound) {
        (Determined::Unknown, _) => "unknown".into(),
        (Determined::Given, _) => format!("{value}{unit} (given)"),
        (Determined::Bound, Some("lower")) => format!("at least {value}{unit} (a bound)"),
        (Determined::Bound, _) => format!("at most {value}{unit} (a bound)"),
        (Determined::Determined, _) if r.sd == 0.0 => format!("{value}{unit} (reference)"),
        (Determined::Determined, _) => format!("{value} +- {}{unit}", digits(r.sd)),
    }
}

fn digits(v: f64) -> String {
    match v.abs() {
        a if !a.is_finite() => "unknown".into(),
        a if a >= 100.0 => format!("{v:.0}"),
        a if a >= 10.0 => format!("{v:.1}"),
        a if a >= 1.0 => format!("{v:.2}"),
        _ => format!("{v:.3}"),
    }
}

/// What was found, in plain words.
pub fn verdict(result: &StiffnessResult) -> String {
    let seen = result.regions.iter().filter(|r| r.identifiable).count();
    let count = result.regions.len();
    let mut out = match (count, result.labelled) {
        (1, false) if asks_for_more(result) => {
            "One modulus does not explain the field, and no second region was accepted (the evidence says why)."
                .to_string()
        }
        (1, false) => one_region(result.left_over),
        (n, false) => format!("The data support {n} regions."),
        (1, true) => "One region.".into(),
        (n, true) if seen == n => format!("All {n} regions are determined by the data."),
        (n, true) => format!("{seen} of {n} regions are determined by the data."),
    };
    out.push_str(&limit(&result.detectable));
    if !result.absolute {
        out.push_str(" No force or modulus was given, so moduli are ratios.");
    }
    let _ = write!(out, " Trust {}: {}.", result.trust.name(), result.trust_reasons.join("; "));
    out
}

/// Which balls would have been seen.
fn limit(balls: &[Detectable]) -> String {
    let said = |ball: &Detectable| {
        let softer = ball.softer.map(|c| format!("at most {c:.2}"));
        let stiffer = ball.stiffer.map(|c| format!("at least {c:.1}"));
        let seen: Vec<String> = softer.into_iter().chain(stiffer).collect();
        let seen = if seen.is_empty() { "no contrast".into() } else { seen.join(" or ") + " times the modulus" };
        format!("{:.1} mm: {seen}", ball.diameter_mm)
    };
    match balls {
        [] => String::new(),
        _ => format!(
            " A single ball would be seen from these on: {}.",
            balls.iter().map(said).collect::<Vec<_>>().join("; ")
        ),
    }
}

/// What it means that a second region was not looked for.
fn one_region(left: Option<LeftOver>) -> String {
    let Some(left) = left else {
        return "The data do not support a second region: one modulus explains the field.".into();
    };
    let but = match left.may_be_surface() {
        true => "which a surface a tenth of a voxel off may do as well as something softer or stiffer in it",
        false => "in which something softer or stiffer may be hidden",
    };
    format!(
        "The data do not support a second region, but one modulus leaves {:.4} mm beyond the noise, {but}.",
        left.misfit_mm
    )
}

/// Whether a misfit stands out of noise and geometry with one region, by the evidence.
fn asks_for_more(result: &StiffnessResult) -> bool {
    result.evidence.iter().any(|e| e.question == "regions" && e.model != "1")
}

/// The short summary for stdout.
pub fn text(result: &StiffnessResult) -> String {
    let mut out = format!("{}\n", verdict(result));
    for r in &result.regions {
        let ratio = if r.state == Determined::Unknown { String::new() } else { format!(", ratio {}", digits(r.ratio)) };
        let _ = writeln!(out, "  {:12} {}{ratio}", r.name, modulus(r, result.absolute));
    }
    let (held, load) = (&result.patches[0], &result.patches[1]);
    let _ = writeln!(
        out,
        "  model        {}, Poisson's ratio {}, held {} ({}), loaded {} ({})",
        result.law.name(),
        result.poisson,
        held.name,
        held.contact.name(),
        load.name,
        load.contact.name()
    );
    for e in &result.evidence {
        let _ = writeln!(out, "  evidence     {e}");
    }
    let _ = writeln!(
        out,
        "  residual     {:.4} mm, roughness of the field {:.4} mm, {} samples, effective sample size {:.0}",
        result.residual_mm,
        result.noise_mm,
        thousands(result.samples[0] as usize),
        result.samples[1]
    );
    out
}

/// Residual (mm) and criterion of a model; empty where it was not tried.
fn figures(e: &Evidence) -> [String; 2] {
    let shown = |v: f64, digits: usize| if v.is_finite() { format!("{v:.digits$}") } else { String::new() };
    [shown(e.residual_mm, 4), shown(e.bic, 0)]
}

/// summary.json; the keys are those of docs/reference/file-formats.md.
pub fn summary(result: &StiffnessResult, inputs: &InputNames) -> Value {
    let seconds: Map<String, Value> = result.seconds.iter().map(|(s, t)| (s.clone(), json!(t))).collect();
    let regions: Vec<Value> = result
        .regions
        .iter()
        .zip(&result.mesh_change)
        .map(|(r, change)| {
            let mut v = json!(r);
            v["mesh_change"] = json!(change.exp_m1());
            v["poisson"] = json!(result.poisson_of(r.label));
            v
        })
        .collect();
    json!({
        "version": env!("CARGO_PKG_VERSION"),
        "command": "stiffness",
        "inputs": {
            "field": inputs.field, "body": inputs.body, "matches": inputs.matches, "held": inputs.held, "load": inputs.load,
        },
        "grid": json::grid(result.map.grid()),
        "absolute": result.absolute,
        "unit": if result.absolute { "kPa" } else { "ratio to the reference region" },
        "labelled": result.labelled,
        "verdict": verdict(result),
        "trust": result.trust,
        "trust_reasons": result.trust_reasons,
        "regions": regions,
        "region_count": result.regions.len(),
        "reference": result.reference,
        "correlation": result.correlation,
        "model": result.law.name(),
        "poisson": result.poisson,
        "poisson_of": result.poisson_of.iter().map(|(l, nu)| (l.to_string(), json!(nu))).collect::<Map<String, Value>>(),
        "label_sd_voxels": result.label_sd,
        "force_n": result.force_n,
        "strain_p95": result.strain,
        "residual_mm": result.residual_mm,
        "noise_mm": result.noise_mm,
        "samples": result.samples[0],
        "effective_samples": result.samples[1],
        "evidence": result.evidence,
        "left_over": result.left_over,
        "detectable": result.detectable,
        "patches": { "held": result.patches[0], "loaded": result.patches[1], "cut": result.patches.get(2) },
        "face_offsets_voxels": result.faces.iter().map(|(n, v)| (n.clone(), json!(v))).collect::<Map<String, Value>>(),
        "mesh": { "nodes": result.mesh.nodes().len(), "elements": result.mesh.tetrahedra().len() },
        "seconds": seconds,
        "warnings": result.warnings,
    })
}

/// What the page shows beside its maps, all on their grid.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Shown<'a> {
    /// The displacement that the moduli came from.
    pub field: Option<&'a DenseField>,
    /// Volumes with what they are called, the first behind the maps.
    pub images: &'a [(String, Volume)],
}

/// Voxels from one stripe of a hatching to the next.
const STRIPE_SPACING_VOXELS: usize = 3;

/// What a region's modulus is: the value itself (0), a lower bound of it (1) or an upper one (2).
fn bound(region: &RegionStiffness) -> u8 {
    match (region.state, region.bound) {
        (Determined::Bound, Some("lower")) => 1,
        (Determined::Bound, _) => 2,
        _ => 0,
    }
}

/// Maps, displacement and mesh over the images in a viewer, with the scales of the pictures.
fn look(
    result: &StiffnessResult,
    inside: &Mask,
    shown: &Shown<'_>,
    maps: [(Values<'_>, &Panel); 3],
    bound_at: Bounds<'_>,
) -> Markup {
    let overlays: Vec<Layer<'_>> = maps
        .into_iter()
        .filter_map(|(values, panel)| Some(Layer { name: &panel.title, values, scale: panel.scale.clone()? }))
        .collect();
    let body = |o: usize| f32::from(inside.as_slice()[o]);
    let gray = |[low, high]: [f64; 2]| Scale { low, high, unit: "", map: ColorMap::Gray };
    let volumes: Vec<_> = shown.images.iter().map(|(_, v)| |o: usize| v.as_slice()[o]).collect();
    let mut images: Vec<Layer<'_>> = shown
        .images
        .iter()
        .zip(&volumes)
        .map(|((name, v), values)| Layer { name, values, scale: gray(gray_range(v)) })
        .collect();
    if images.is_empty() {
        images.push(Layer { name: "body", values: &body, scale: gray([0.0, 2.0]) });
    }
    let displacement = shown.field.map(|field| {
        let lengths = (0..field.grid().len()).step_by(7).filter(|&o| inside.as_slice()[o] > 0);
        let most = quantile(lengths.map(|o| f64::from(length(field, o))), 0.998);
        (field, Scale::from_zero(most, "mm", ColorMap::Viridis))
    });
    let corners: Vec<u32> = result.mesh.tetrahedra().iter().flat_map(|e| e[..4].to_vec()).collect();
    let grid = result.map.grid();
    let moment = Moment {
        name: None,
        images: &[],
        overlays: &overlays,
        bounds: Some(bound_at),
        displacement,
        matches: None,
        mesh: Some((result.mesh.nodes(), corners, 4)),
    };
    let (centre, mask, moments) = (centre(&result.map), Some(inside), &[&moment.pack(grid)]);
    Viewer { grid, centre, mask, images: &images, shown: Some(0), moments, first: 0 }.html()
}

/// The page.
///
/// # Errors
/// [`ReportError`] when a picture cannot be encoded.
pub(crate) fn page(result: &StiffnessResult, inputs: &InputNames, shown: &Shown<'_>) -> Result<String, ReportError> {
    page_with(result, inputs, shown, &Markup::default())
}

/// The page of a map that the frames of a sequence share.
///
/// # Errors
/// As [`page`].
pub(crate) fn sequence_page(
    shared: &SharedStiffness,
    inputs: &InputNames,
    shown: &Shown<'_>,
) -> Result<String, ReportError> {
    page_with(&shared.result, inputs, shown, &sequence_section(shared))
}

/// The head of the page: what was found, and how far to rely on it.
fn head(result: &StiffnessResult, body: &str) -> Markup {
    let total: f64 = result.seconds.iter().map(|s| s.1).sum();
    html! {
        (header(format_args!("Stiffness of {body}"), &verdict(result), ""))
        (tiles([
            (result.regions.len().to_string(), "", "regions"),
            (format!("{:.4}", result.residual_mm), "mm", "residual"),
            (format!("{:.1}", 100.0 * result.strain), "%", "strain, 95th percentile"),
            (thousands(result.mesh.nodes().len()), "", "mesh nodes"),
            (format!("{total:.1}"), "s", "total runtime"),
        ]))
        (warned(&result.warnings))
    }
}

/// The models that were tried, the patches, the correlations and the time; then what all moduli
/// assume.
fn evidence(result: &StiffnessResult) -> Markup {
    html! {
        section {
            h2 { "Evidence" }
            div.grid {
                article.wide { h3 { "Models tried" } (evidence_table(result)) }
                article { h3 { "Patches" } (patch_table(result)) }
                article { h3 { "Correlation of ln E" } (correlation_table(result)) }
                article { h3 { "Time" } (chart::stage_times(&result.seconds)) }
            }
        }
        footer {
            p {
                "Moduli hold for a Poisson's ratio of " (result.poisson) ", the same in all regions,"
                @if let Some(force) = result.force_n { " under a total force of " (short(force)) " N" }
                " and for an isotropic elastic body whose skin is free but for the two patches. Positions are world mm, RAS."
            }
        }
    }
}

fn page_with(
    result: &StiffnessResult,
    inputs: &InputNames,
    shown: &Shown<'_>,
    extra: &Markup,
) -> Result<String, ReportError> {
    let grid = *result.map.grid();
    let inside = Mask::from_vec(grid, result.map.as_slice().iter().map(|&v| u8::from(v > 0.0)).collect());
    let Ok(inside) = inside else { return Ok(String::new()) };
    let sections = Section::through(&grid, centre(&result.map));
    let black = shown.images.is_empty().then(|| Volume::filled(grid, 0.0f32));
    let image = shown.images.first().map(|(_, v)| v);
    let base = image.or(black.as_ref()).map(|v| (v, image.map_or([0.0, 1.0], gray_range)));
    let Some(base) = base else { return Ok(String::new()) };
    let unit = if result.absolute { "kPa" } else { "" };
    let [map, sd, rest] = [&result.map, &result.map_sd, &result.residual].map(|v| v.as_slice());
    let within = |o: usize, value: f32| if inside.as_slice()[o] > 0 { value } else { f32::NAN };
    let moduli: Values<'_> = &|o| within(o, map[o]);
    let deviations: Values<'_> = &|o| within(o, sd[o]);
    // Matches leave most voxels without one.
    let residuals: Values<'_> = &|o| within(o, if rest[o] > 0.0 { rest[o] } else { f32::NAN });
    let top = |value: Values<'_>, q: f64| {
        quantile((0..grid.len()).map(|o| f64::from(value(o))).filter(|v| v.is_finite()), q).max(1e-9)
    };
    let panel = |title: &str, value: Values<'_>, scale: Scale, note: &str| {
        Panel::coloured(title, &sections, base, Some(&inside), scale, value).map(|p| p.with_note(note))
    };
    let seen = result.regions.iter().filter(|r| r.identifiable).map(|r| r.youngs_modulus).fold(0.0, f64::max);
    let seen = if seen > 0.0 { seen } else { top(moduli, 1.0) };
    let bounds: Vec<(f32, u8)> =
        result.regions.iter().map(|r| (r.youngs_modulus as f32, bound(r))).filter(|b| b.1 > 0).collect();
    let bound_at = |o: usize| bounds.iter().find(|b| b.0 == map[o]).map_or(0, |b| b.1);
    // Stripes along a diagonal of the voxels show on sections along every axis.
    let striped = |o: usize| bound_at(o) > 0 && grid.voxel(o).iter().sum::<usize>() % STRIPE_SPACING_VOXELS == 0;
    let hatched: Values<'_> = &|o| if striped(o) { f32::NAN } else { moduli(o) };
    let map_panel = panel(
        "Young's modulus",
        hatched,
        Scale::from_zero(seen, unit, ColorMap::Viridis),
        "One value per region. Hatched: the value is a bound, at the end of the scale if beyond. Without colour: unknown.",
    )?;
    let sd = panel(
        "Standard deviation",
        deviations,
        Scale::from_zero(top(deviations, 1.0), unit, ColorMap::Magma),
        "From the residuals, counted by blocks of the body, and the change with the mesh. Without colour: not identifiable.",
    )?;
    let rest = panel(
        "Residual",
        residuals,
        Scale::from_zero(top(residuals, 0.995), "mm", ColorMap::Magma),
        "Length of measured less modelled displacement, where one was taken. Structure here means that the model misses \
         something.",
    )?;
    let maps = [(moduli, &map_panel), (deviations, &sd), (residuals, &rest)];
    let some = sample(grid.len(), Some(&inside));
    let body = html! {
        (head(result, &inputs.body))
        section {
            h2 { "Regions" }
            div.grid { article.wide { h3 { "Moduli" } (region_table(result)) } }
        }
        (extra)
        section { h2 { "Look" } article.wide { (look(result, &inside, shown, maps, &bound_at)) } }
        section {
            h2 { "Maps" }
            div.grid {
                @for (_, panel) in maps { (card(panel)) }
                article.wide {
                    h3 { "Distributions" }
                    div.charts {
                        @for (values, panel) in maps {
                            @if let Some(scale) = &panel.scale {
                                (chart::distribution(&panel.title, values, scale, &some))
                            }
                        }
                    }
                }
            }
        }
        (evidence(result))
    };
    Ok(document(&format!("Stiffness of {}", inputs.body), &body))
}

/// The middle of what is stiffer or softer than the median, else of the body (mm, RAS).
fn centre(map: &Volume) -> WorldPoint {
    let values = map.as_slice();
    let inside: Vec<usize> = (0..values.len()).filter(|&o| values[o] > 0.0).collect();
    let median = quantile(inside.iter().map(|&o| f64::from(values[o])), 0.5) as f32;
    let special: Vec<usize> = inside.iter().copied().filter(|&o| (values[o] / median).ln().abs() > 0.05).collect();
    let chosen = if special.is_empty() { &inside } else { &special };
    let mut sum = [0.0; 3];
    for &o in chosen {
        let [i, j, k] = map.grid().voxel(o);
        let p = map.grid().world(i, j, k).0;
        (0..3).for_each(|a| sum[a] += p[a]);
    }
    WorldPoint(sum.map(|s| s / chosen.len().max(1) as f64))
}

fn region_table(result: &StiffnessResult) -> Markup {
    let rows = result.regions.iter().zip(&result.mesh_change).map(|(r, change)| {
        [
            r.name.clone(),
            r.label.to_string(),
            modulus(r, result.absolute).replace("+-", "±"),
            digits(r.ratio),
            format!("{:.1} %", 100.0 * change.exp_m1()).replace("-0.0", "0.0"),
            thousands(r.volume as usize),
        ]
    });
    table(&["Region", "Label", "Young's modulus", "Ratio", "Change with the mesh", "Volume, mm³"], rows)
}

fn evidence_table(result: &StiffnessResult) -> Markup {
    let row = |e: &Evidence| {
        let [residual, criterion] = figures(e);
        let (model, chosen) = (format!("{}: {}", e.question, e.model), if e.chosen { "chosen" } else { "" });
        [model, e.parameters.to_string(), residual, criterion, chosen.into(), e.reason.clone()]
    };
    table(&["Model", "Parameters", "Residual, mm", "Criterion", "", "Why"], result.evidence.iter().map(row))
}

fn patch_table(result: &StiffnessResult) -> Markup {
    let row = |(which, p): (&str, &PatchReport)| {
        let motion = p.translation.map(short2).join(", ") + " mm";
        [format!("{which} ({})", p.name), p.contact.name().into(), format!("{:.1} mm²", p.area), motion]
    };
    table(&["Patch", "Contact", "Area", "Motion"], ["held", "loaded", "cut"].into_iter().zip(&result.patches).map(row))
}

fn correlation_table(result: &StiffnessResult) -> Markup {
    let head: Vec<&str> = std::iter::once("").chain(result.regions.iter().map(|r| r.name.as_str())).collect();
    let rows = result
        .regions
        .iter()
        .zip(&result.correlation)
        .map(|(r, c)| std::iter::once(r.name.clone()).chain(c.iter().map(|v| short2(*v))));
    table(&head, rows)
}

/// What a shared map adds to summary.json under `sequence`.
pub(crate) fn sequence_summary(shared: &SharedStiffness) -> Value {
    let frame = |f: &FrameStiffness| {
        let (regions, why) = match &f.regions {
            Ok(r) => (json!(r), Value::Null),
            Err(why) => (Value::Null, json!(why)),
        };
        json!({ "frame": f.frame, "motion_mm": f.motion_mm, "residual_mm": f.residual_mm, "regions": regions, "why": why })
    };
    let gains: Map<String, Value> =
        shared.result.regions.iter().zip(&shared.gains).map(|(r, g)| (r.label.to_string(), json!(g))).collect();
    json!({ "frames": shared.frames.iter().map(frame).collect::<Vec<_>>(), "gains": gains })
}

/// The lines that a shared map adds to the text.
pub(crate) fn sequence_text(shared: &SharedStiffness) -> String {
    let tells = |f: &&FrameStiffness| f.regions.as_ref().is_ok_and(|all| all.iter().any(|r| r.identifiable));
    let told = shared.frames.iter().filter(tells).count();
    let mut out = format!("  frames       {told} of {} share these moduli", shared.frames.len());
    for (r, g) in shared.result.regions.iter().zip(&shared.gains) {
        if let [first, .., last] = g.as_slice()
            && last.data_sd > 0.0
        {
            let parts = [100.0 * first.data_sd / first.value, 100.0 * last.data_sd / last.value];
            let _ = write!(out, "; {}: noise {:.2} % -> {:.2} %", r.name, parts[0], parts[1]);
            if last.weighed < last.frames {
                let _ = write!(out, " by {} that moved most", last.weighed);
            }
        }
    }
    out.push('\n');
    out
}

fn sequence_section(shared: &SharedStiffness) -> Markup {
    let row = |f: &FrameStiffness| {
        let said = match &f.regions {
            Ok(all) => all.iter().map(|r| modulus(r, shared.result.absolute)).collect::<Vec<_>>().join("; "),
            Err(why) => why.clone(),
        };
        [f.frame.to_string(), format!("{:.3}", f.motion_mm), format!("{:.4}", f.residual_mm), said]
    };
    html! {
        section {
            h2 { "Frames" }
            div.grid {
                @for (r, gains) in shared.result.regions.iter().zip(&shared.gains) { (gained(&r.name, gains)) }
                article.wide {
                    h3 { "Each alone" }
                    (table(&["Frame", "Mean motion, mm", "Residual, mm", "Moduli"], shared.frames.iter().map(row)))
                }
            }
        }
    }
}

/// What each further frame adds to what is known of a region, where frames lower its deviation.
fn gained(region: &str, gains: &[Gain]) -> Markup {
    let Some(first) = gains.first().filter(|g| g.data_sd > 1e-3 * g.value) else { return Markup::default() };
    let line = |f: &dyn Fn(&Gain) -> f64| gains.iter().map(|g| [g.frames as f64, f(g)]).collect::<Vec<_>>();
    let root = |g: &Gain| 100.0 * first.data_sd / first.value / (g.frames as f64).sqrt();
    let lines = [
        Line::new("standard deviation, %", 0, false, line(&|g| 100.0 * g.sd / g.value)),
        Line::new("its part that frames lower", 1, false, line(&|g| 100.0 * g.data_sd / g.value)),
        Line::new("first over root of frames", 2, true, line(&root)),
    ];
    let plot = Plot { title: region, across: "frames, those that move most first", marks: &[] };
    html! { article { (plot.shown(&lines)) } }
}
