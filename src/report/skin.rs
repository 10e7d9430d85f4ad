//! report.html, summary.json and the short summary of `palpate skin`.

use crate::report::html::{document, header, legend, tiles, titled, warned};
use crate::report::json::seconds;
use crate::report::plot::{Line, Plot};
use crate::report::scale::{Scale, short};
use crate::report::tables::table;
use crate::types::skin::{BlockRun, BlockShape, SkinSample, SkinScene};
use maud::{Markup, PreEscaped, html};
use serde_json::{Value, json};
use std::fmt::Write;

/// What a skin scene gave.
pub(crate) struct SkinReport<'a> {
    /// The scene file.
    pub name: &'a str,
    /// The scene.
    pub scene: &'a SkinScene,
    /// The column of layers.
    pub column: &'a [SkinSample],
    /// One layer in place of all.
    pub single: Option<&'a [SkinSample]>,
    /// The block of layers.
    pub block: Option<&'a BlockRun>,
    /// The block of one layer.
    pub single_block: Option<&'a BlockRun>,
    /// Strain that stays after all time, by the impulse.
    pub residual: &'a [Option<f64>],
    /// Stage names and wall seconds.
    pub seconds: &'a [(String, f64)],
    /// What the user should know.
    pub warnings: &'a [String],
}

/// Largest stress (Pa), stress at the end of the hold (Pa), depth that is left at the end (m).
fn figures(samples: &[SkinSample], scene: &SkinScene) -> [f64; 3] {
    let unload = scene.load.ramp + scene.load.hold;
    let held = samples.iter().rfind(|s| s.time <= unload * (1.0 + 1e-12) && s.stress > 0.0).map_or(0.0, |s| s.stress);
    let left = samples.last().map_or(0.0, |s| s.displacement);
    [samples.iter().map(|s| s.stress).fold(0.0, f64::max), held, left]
}

/// The keys are those of docs/reference/file-formats.md.
pub(crate) fn summary(report: &SkinReport<'_>) -> Value {
    let figures = |samples: Option<&[SkinSample]>| {
        samples.map(|s| {
            let [peak, held, left] = figures(s, report.scene);
            json!({ "peak_stress_pa": peak, "held_stress_pa": held, "final_displacement_m": left })
        })
    };
    let strain = report.column.last().map(|s| s.strain.clone()).unwrap_or_default();
    let layers: Vec<Value> = report
        .scene
        .layers
        .iter()
        .zip(strain)
        .zip(report.residual)
        .map(|((l, e), r)| json!({ "name": l.name, "final_strain": e, "residual_strain": r }))
        .collect();
    json!({
        "version": env!("CARGO_PKG_VERSION"),
        "command": "skin",
        "inputs": { "scene": report.name },
        "scene": report.scene,
        "column": figures(Some(report.column)),
        "single": figures(report.single),
        "block": figures(report.block.map(|b| b.samples.as_slice())),
        "single_block": figures(report.single_block.map(|b| b.samples.as_slice())),
        "impulse_pa_s": report.column.last().map(|s| s.impulse),
        "layers": layers,
        "seconds": seconds(report.seconds),
        "warnings": report.warnings,
    })
}

fn headline(report: &SkinReport<'_>) -> String {
    let [peak, held, left] = figures(report.column, report.scene);
    format!(
        "{} layers, {} mm thick, pressed by {} mm: stress up to {} kPa, {} kPa at the end of the hold; {} mm left at the end.",
        report.scene.layers.len(),
        short(1e3 * report.scene.thickness()),
        short(1e3 * report.scene.load.displacement),
        short(peak / 1e3),
        short(held / 1e3),
        short(1e3 * left)
    )
}

/// What was found, a few lines.
pub(crate) fn text(report: &SkinReport<'_>) -> String {
    let mut out = format!("{}\n", headline(report));
    let end = report.column.last();
    if let Some(single) = report.single {
        let [peak, held, left] = figures(single, report.scene);
        let _ = writeln!(
            out,
            "  one layer    stress up to {} kPa, {} kPa at the end of the hold; {} mm left at the end",
            short(peak / 1e3),
            short(held / 1e3),
            short(1e3 * left)
        );
    }
    for (at, layer) in report.scene.layers.iter().enumerate() {
        let strain = end.map_or(0.0, |s| s.strain[at]);
        let stays = report.residual[at].map_or(String::new(), |r| format!(", {} permanent", short(r)));
        let _ = writeln!(out, "  {:<12} strain {} at the end{stays}", layer.name, short(strain));
    }
    out
}

/// The page.
pub(crate) fn page(report: &SkinReport<'_>) -> String {
    let scene = report.scene;
    let [peak, held, left] = figures(report.column, scene);
    let rows = scene.layers.iter().enumerate().map(|(at, l)| {
        let strain =
            |time: f64| report.column.iter().rfind(|s| s.time <= time * (1.0 + 1e-12)).map_or(0.0, |s| s.strain[at]);
        [
            l.name.clone(),
            short(1e3 * l.thickness),
            serde_json::to_value(l.element).ok().and_then(|v| v.as_str().map(String::from)).unwrap_or_default(),
            short(strain(scene.load.ramp)),
            short(strain(scene.load.end)),
            report.residual[at].map_or("0, in time".into(), short),
        ]
    });
    let head = ["Layer", "Thickness, mm", "Element", "Strain after the ramp", "Strain at the end", "Permanent strain"];
    let body = html! {
        (header(titled(report.name, "skin"), &headline(report), ""))
        (tiles([
            (short(peak / 1e3), "kPa", "largest stress"),
            (short(held / 1e3), "kPa", "stress at the end of the hold"),
            (short(1e3 * left), "mm", "left at the end"),
            (short(100.0 * left / scene.load.displacement), "%", "of the indentation"),
        ]))
        (warned(report.warnings))
        section {
            h2 { "Over time" }
            p.lead { "The column is exact; the block has a punch and free skin beside it. " (one_layer(report)) }
            div.grid { (curves(report)) }
        }
        (shapes(report))
        section { h2 { "Layers" } article.wide { (table(&head, rows)) } }
    };
    document(report.name, &body)
}

/// What the one layer is, in words.
fn one_layer(report: &SkinReport<'_>) -> &'static str {
    match (report.single, report.scene.without_layers()) {
        (None, _) => "",
        (_, Some(_)) => "One layer has the mean compliance of all.",
        _ => "One layer is of the element that comes nearest to all of them under this load.",
    }
}

fn curves(report: &SkinReport<'_>) -> Markup {
    let load = &report.scene.load;
    let marks = [(load.ramp, false), (load.ramp + load.hold, false)];
    let of = |samples: &[SkinSample], f: &dyn Fn(&SkinSample) -> f64| samples.iter().map(|s| [s.time, f(s)]).collect();
    let kinds: [(&str, Option<&[SkinSample]>, usize, bool); 4] = [
        ("column", Some(report.column), 0, false),
        ("one layer", report.single, 1, false),
        ("block", report.block.map(|b| b.samples.as_slice()), 0, true),
        ("block, one layer", report.single_block.map(|b| b.samples.as_slice()), 1, true),
    ];
    let lines = |f: &dyn Fn(&SkinSample) -> f64| -> Vec<Line> {
        let some =
            kinds.iter().filter_map(|(name, samples, colour, dashed)| Some((name, (*samples)?, *colour, *dashed)));
        some.map(|(name, samples, colour, dashed)| Line::new(name, colour, dashed, of(samples, f))).collect()
    };
    let layers = |samples: &[SkinSample]| -> Vec<Line> {
        let line = |at| of(samples, &|s| s.strain[at]);
        report.scene.layers.iter().enumerate().map(|(at, l)| Line::new(&l.name, at, false, line(at))).collect()
    };
    let draw =
        |title: &str, lines: &[Line]| html! { article { (Plot { title, across: "s", marks: &marks }.shown(lines)) } };
    html! {
        (draw("Stress, kPa", &lines(&|s| s.stress / 1e3)))
        (draw("Depth, mm", &lines(&|s| 1e3 * s.displacement)))
        (draw("Compression of each layer, column", &layers(report.column)))
        @if let Some(block) = report.block {
            (draw("Compression of each layer under the punch, block", &layers(&block.samples)))
        }
    }
}

/// The deformed blocks with and without layers, side by side.
fn shapes(report: &SkinReport<'_>) -> Markup {
    let runs: Vec<(&str, &BlockRun)> = [("With layers", report.block), ("One layer", report.single_block)]
        .into_iter()
        .filter_map(|(name, run)| Some((name, run?)))
        .collect();
    let largest =
        runs.iter().flat_map(|(_, r)| &r.shapes).flat_map(|s| &s.compression).fold(0.0f64, |m, v| m.max(v.abs()));
    if runs.is_empty() || largest <= 0.0 {
        return Markup::default();
    }
    let scale = Scale::about(0.0, largest, "");
    let times = 0..runs[0].1.shapes.len();
    let at_times =
        times.flat_map(|at| runs.iter().filter_map(move |(name, run)| Some((name, run, run.shapes.get(at)?))));
    html! {
        section {
            h2 { "The skin under the punch" }
            p.lead {
                "Cells move with the skin, true to scale. Red: pressed together. Blue: pulled apart."
            }
            div.grid {
                @for (name, run, shape) in at_times {
                    article {
                        h3 { (name) ", at " (short(shape.time)) " s" }
                        (PreEscaped(drawing(report.scene, run, shape, &scale)))
                        (legend(Some(&scale)))
                    }
                }
            }
        }
    }
}

/// Both halves of a block, with the lines between its layers.
fn drawing(scene: &SkinScene, run: &BlockRun, shape: &BlockShape, scale: &Scale) -> String {
    let (half, height) = (500.0 * scene.block.width, 1e3 * scene.thickness());
    let [nx, ny] = run.cells;
    let room = 0.12 * height;
    let mut svg = format!(
        "<svg class=\"skin\" viewBox=\"{:.3} {:.3} {:.3} {:.3}\" role=\"img\" aria-label=\"deformed skin\">",
        -half - room,
        -room,
        2.0 * (half + room),
        height + 2.0 * room
    );
    let place = |n: usize, side: f64| [side * 1e3 * shape.nodes[n][0], height - 1e3 * shape.nodes[n][1]];
    for side in [-1.0, 1.0] {
        for (cell, value) in shape.compression.iter().enumerate() {
            let (i, j) = (cell / ny, cell % ny);
            let corner = |i: usize, j: usize| place(i * (ny + 1) + j, side);
            let around = [corner(i, j), corner(i + 1, j), corner(i + 1, j + 1), corner(i, j + 1)];
            let path: Vec<String> = around.iter().map(|p| format!("{:.4} {:.4}", p[0], p[1])).collect();
            let colour = scale.hex(*value);
            let _ = write!(svg, "<path d=\"M{}Z\" fill=\"{colour}\" stroke=\"{colour}\"/>", path.join("L"));
        }
        for j in (1..ny).filter(|&j| run.layer[j] != run.layer[j - 1]) {
            let path: Vec<String> =
                (0..=nx).map(|i| place(i * (ny + 1) + j, side)).map(|p| format!("{:.4} {:.4}", p[0], p[1])).collect();
            let _ = write!(svg, "<path class=\"between\" d=\"M{}\"/>", path.join("L"));
        }
    }
    svg.push_str("</svg>");
    svg
}
