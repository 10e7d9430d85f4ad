//! The source's own result by the source's own chain (`--method sparse`): 1,000 points of the
//! initial volume against 5,000 of the deformed one, a Delaunay mesh through the kept matches, and
//! the displacement magnitude at its nodes as a picture; then the fields from 10,000 and 30,000
//! points, and what energy-based consistency changes.
//!
//!     cargo run --release --example seed -- [--quick] [INITIAL DEFORMED [TRUTH [MASK]]]
//!
//! Without files a synthetic calf is measured; `--quick` takes a small block and few points.

use palpate::pipeline::field::FieldResult;
use palpate::report::colormap::ColorMap;
use palpate::report::node_plot;
use palpate::report::scale::Scale;
use palpate::synth::{PhantomKind, PhantomParams, phantom};
use palpate::types::params::{Interpolation, Method};
use palpate::types::{DenseField, FieldParams, Mask, Mesh, Volume};
use palpate::{evaluate, io, pipeline};
use std::error::Error;
use std::time::Instant;

/// Where the picture goes.
const PICTURE: &str = "out/seed.svg";

/// A pair and, where it is known, the truth.
struct Pair {
    initial: Volume,
    deformed: Volume,
    truth: Option<DenseField>,
    mask: Option<Mask>,
}

fn main() -> Result<(), Box<dyn Error>> {
    let (flags, files): (Vec<String>, Vec<String>) = std::env::args().skip(1).partition(|a| a.starts_with("--"));
    let quick = flags.iter().any(|f| f == "--quick");
    let pair = if files.is_empty() { synthetic(quick)? } else { given(&files)? };
    let counts = if quick { [200, 400, 800] } else { [1_000, 10_000, 30_000] };

    let run = |params: &FieldParams| {
        let started = Instant::now();
        let result = pipeline::field::run(&pair.initial, &pair.deformed, pair.mask.as_ref(), params, &|_, _| {});
        result.map(|result| (result, started.elapsed().as_secs_f64()))
    };
    println!(
        "points  initial  deformed  candidates  kept  nodes  elements  energy           error mm        linear mm       seconds"
    );
    for (row, &points) in counts.iter().enumerate() {
        let params = FieldParams { method: Method::Sparse, points, ..FieldParams::default() };
        let (result, seconds) = run(&params)?;
        let (linear, _) = run(&FieldParams { interpolation: Interpolation::Barycentric, ..params })?;
        let s = &result.summary;
        let energy = s.levels.last().map(|l| format!("{:.3} -> {:.3}", l.energy_before, l.energy_after));
        println!(
            "{points:6}  {:7}  {:8}  {:10}  {:4}  {:5}  {:8}  {:15}  {:14}  {:14}  {seconds:7.1}",
            s.counts.features_initial,
            s.counts.features_deformed,
            s.counts.candidates,
            s.counts.kept,
            s.counts.nodes,
            s.counts.tetrahedra,
            energy.unwrap_or_default(),
            error(&pair, &result)?,
            error(&pair, &linear)?,
        );
        if row == 0 {
            std::fs::create_dir_all("out")?;
            io::write_text(PICTURE, &picture(&result))?;
        }
    }
    for consistency in [true, false] {
        let params = FieldParams { method: Method::Sparse, points: counts[1], consistency, ..FieldParams::default() };
        let (result, _) = run(&params)?;
        let kept = result.summary.counts.kept;
        println!("consistency {consistency:5}: {kept} matches kept, error {} mm", error(&pair, &result)?);
    }
    println!("The displacement at the nodes of the first mesh: {PICTURE}");
    Ok(())
}

fn synthetic(quick: bool) -> Result<Pair, Box<dyn Error>> {
    let calf = PhantomParams::new(PhantomKind::Calf);
    let p = phantom(&if quick { PhantomParams::new(PhantomKind::Block).sized(48) } else { calf })?;
    Ok(Pair { initial: p.initial, deformed: p.deformed, truth: Some(p.truth), mask: Some(p.mask) })
}

fn given(files: &[String]) -> Result<Pair, Box<dyn Error>> {
    let [initial, deformed, rest @ ..] = files else { return Err("give INITIAL and DEFORMED".into()) };
    Ok(Pair {
        initial: io::read_volume(initial)?,
        deformed: io::read_volume(deformed)?,
        truth: rest.first().map(io::read_field).transpose()?,
        mask: rest.get(1).map(io::read_mask).transpose()?,
    })
}

/// Mean error and that before registration (mm).
fn error(pair: &Pair, result: &FieldResult) -> Result<String, Box<dyn Error>> {
    let Some(truth) = &pair.truth else { return Ok("-".into()) };
    let m = evaluate::metrics(&result.displacement, truth, pair.mask.as_ref(), &[])?;
    Ok(format!("{:.3} of {:.3}", m.mean_mm, m.identity_mm))
}

/// The displacement magnitude at each node, in space.
fn picture(result: &FieldResult) -> String {
    let (places, elements, name) = match &result.mesh {
        Mesh::Tetrahedra(m) => (m.nodes(), m.tetrahedra().len(), "tetrahedra"),
        Mesh::Triangles(m) => (m.nodes(), m.triangles().len(), "triangles"),
    };
    let length = |d: &[f64; 3]| d.iter().map(|v| v * v).sum::<f64>().sqrt();
    let most = result.node_displacement.iter().map(length).fold(0.0, f64::max);
    let title = format!("{} nodes, {elements} {name}: displacement magnitude", places.len());
    node_plot::figure(&title, places, &result.node_displacement, &Scale::from_zero(most, "mm", ColorMap::Viridis))
}
