//! `--dry-run`: the checked plan in words.

use super::inputs::name;
use super::limits::bytes;
use super::outputs::Target;
use anyhow::Result;
use palpate::error::Shown;
use palpate::pipeline::dry_run::FieldPlan;
use palpate::report::scale::{short, thousands};
use palpate::types::stiffness::Forecast;
use palpate::types::{FieldParams, Grid, Mask, StiffnessParams};
use std::path::{Path, PathBuf};

/// Axes as `64 x 75 x 64`.
pub fn times(shape: [usize; 3]) -> String {
    shape.map(|n| n.to_string()).join(" x ")
}

/// Voxels and their size.
pub fn grid(grid: &Grid) -> String {
    let size = grid.spacing().map(|v| short((v * 1e4).round() / 1e4)).join(" x ");
    format!("{} voxels of {size} mm", times(grid.shape()))
}

fn line(out: &mut String, key: &str, value: &str) {
    out.push_str(&format!("  {key:<12} {value}\n"));
}

fn end(out: &mut String, folder: &Path, files: &[impl AsRef<str>]) {
    let files: Vec<&str> = files.iter().map(AsRef::as_ref).collect();
    let shown = match &files[..] {
        [first @ .., last] if first.len() > 12 => {
            format!("{}, ... {last} ({} in all)", first[..6].join(", "), files.len())
        }
        all => all.join(", "),
    };
    line(out, "into", &folder.shown());
    line(out, "files", &shown);
    out.push_str("Nothing was written.");
}

fn measuring(out: &mut String, plan: &FieldPlan, params: &FieldParams) {
    let automatic = |given: bool| if given { "" } else { " (by size)" };
    let preset = format!("{:?}", params.preset).to_lowercase();
    line(out, "preset", &format!("{preset}, seed {}", params.seed));
    line(out, "search", &format!("{} mm{}", short(plan.search_mm), automatic(params.search_mm > 0.0)));
    line(out, "tissue", &format!("{} voxels", thousands(plan.mask_voxels)));
    line(out, "points", &format!("{}{}", thousands(plan.points), automatic(params.points > 0)));
    line(out, "levels", &plan.levels.iter().map(|l| times(*l)).collect::<Vec<_>>().join(", "));
    line(out, "memory", &format!("about {}", bytes(plan.memory)));
}

/// The plan of `palpate field`.
pub fn field(
    volumes: &[(&PathBuf, &Grid); 2],
    plan: &FieldPlan,
    params: &FieldParams,
    target: &Target,
    files: &[&str],
) -> Result<String> {
    target.check()?;
    let mut out = String::from("Would measure the displacement:\n");
    for ((path, g), key) in volumes.iter().zip(["initial", "deformed"]) {
        line(&mut out, key, &format!("{}: {}", name(path), grid(g)));
    }
    measuring(&mut out, plan, params);
    end(&mut out, &target.output, files);
    Ok(out)
}

/// The plan of `palpate track`.
pub fn track(
    first: &Path,
    reference: &Grid,
    frames: usize,
    origin: usize,
    plan: &FieldPlan,
    params: &FieldParams,
    target: &Target,
    files: &[String],
) -> Result<String> {
    target.check()?;
    let mut out = format!("Would measure {} volumes against number {origin}:\n", frames - 1);
    line(&mut out, "reference", &format!("{}: {}", name(first), grid(reference)));
    measuring(&mut out, plan, params);
    end(&mut out, &target.output, files);
    Ok(out)
}

/// The labels and their voxels, or of a mask that regions will be looked for.
fn body(labels: &Mask, labelled: bool, most: usize) -> (&'static str, String) {
    let mut voxels = [0usize; 256];
    labels.as_slice().iter().for_each(|&l| voxels[usize::from(l)] += 1);
    if !labelled {
        let sought = if most > 1 { format!("up to {most} regions are looked for") } else { "one region".into() };
        return ("mask", format!("{} voxels; {sought}", thousands(voxels[1..].iter().sum())));
    }
    let known = (1..256).filter(|&l| voxels[l] > 0);
    let regions: Vec<String> = known.map(|l| format!("{l} ({} voxels)", thousands(voxels[l]))).collect();
    ("labels", regions.join(", "))
}

/// Seconds to two digits.
fn rounded(seconds: f64) -> f64 {
    let unit = 10f64.powf(seconds.max(1e-3).log10().floor() - 1.0);
    (seconds / unit).round() * unit
}

/// The plan of `palpate stiffness` for labels, or a mask where not `labelled`; `frames` are the
/// forces of a sequence, whose first field `path` is.
pub fn stiffness(
    path: &Path,
    (labels, labelled): (&Mask, bool),
    params: &StiffnessParams,
    [held, load]: [&str; 2],
    frames: &[Option<f64>],
    forecast: &Forecast,
    output: &Path,
    files: &[&str],
) -> String {
    let mut out = String::from("Would look for Young's modulus:\n");
    let field = format!("{}: {}", name(path), grid(labels.grid()));
    match frames.len() {
        0 => line(&mut out, "field", &field),
        n => line(&mut out, "fields", &format!("{field}, and {} more; one map for all", n - 1)),
    }
    let (what, shown) = body(labels, labelled, params.regions);
    line(&mut out, what, &shown);
    line(&mut out, "held", held);
    line(&mut out, "loaded", load);
    let known: Vec<f64> = frames.iter().flatten().copied().collect();
    let (least, most) = known.iter().fold((f64::INFINITY, 0.0f64), |(a, b), f| (a.min(*f), b.max(*f)));
    let force = match params.force_n {
        _ if !known.is_empty() => format!("{least} to {most} N over the frames: moduli in kPa"),
        Some(force) => format!("{force} N: moduli in kPa"),
        None => "none: moduli as ratios".into(),
    };
    line(&mut out, "force", &force);
    line(&mut out, "law", &format!("{:?}, Poisson's ratio {}", params.model, params.poisson).to_lowercase());
    line(&mut out, "mesh", &format!("{} nodes", thousands(forecast.nodes)));
    line(&mut out, "memory", &format!("about {}", bytes(forecast.memory)));
    if let Some(seconds) = forecast.seconds {
        let each = if frames.is_empty() { "" } else { " for each field" };
        line(&mut out, "time", &format!("about {} s of one core{each}", short(rounded(seconds))));
    }
    end(&mut out, output, files);
    out
}
