//! Moduli of bodies that are known exactly: their errors, whether two standard deviations hold
//! them, and CPU seconds.
//!
//! `cargo bench --bench stiffness [-- [bars|wrong] [SEEDS [FIRST]] [CASE ...]]`. `bars` (the
//! default): each case with several seeds (3 from 21 on), from the exact displacement, with white
//! and with correlated noise of 0.05 mm, and as `palpate field` measures it from the images.
//! `wrong`: the exact displacement with a Poisson's ratio, labels or a held patch that are wrong.
//! Cases: contrast-2, contrast-5, contrast-10, two, layers, fingertip. Nothing else may run in the
//! process, so runs are one after the other.

use palpate::numerics::random::Random;
use palpate::pipeline::compression_phantoms::Pressed;
use palpate::pipeline::{cpu, field};
use palpate::synth::degradation::{disturbed, shifted_labels};
use palpate::synth::{PhantomKind, PhantomParams};
use palpate::types::stiffness::Law;
use palpate::types::{DenseField, FieldParams, Mask, SparseField, StiffnessParams};

const CASES: [&str; 6] = ["contrast-2", "contrast-5", "contrast-10", "two", "layers", "fingertip"];
/// Noise of a field (mm).
const NOISE: f64 = 0.05;

fn body(case: &str, seed: u64) -> Result<Pressed, Box<dyn std::error::Error>> {
    let kind = match case {
        "layers" => PhantomKind::Slab,
        "fingertip" => PhantomKind::Fingertip,
        _ => PhantomKind::Inclusion,
    };
    let mut params = PhantomParams { seed, ..PhantomParams::new(kind) };
    match case.strip_prefix("contrast-") {
        Some(contrast) => params.elastic.contrast = contrast.parse()?,
        None if case == "two" => params.elastic.inclusions = 2,
        None => {}
    }
    Ok(Pressed::new(&params)?)
}

/// With normal noise of its own in each voxel.
fn white(truth: &DenseField, seed: u64) -> DenseField {
    let mut out = truth.clone();
    let mut random = Random::new(seed, 7);
    out.as_mut_slice().iter_mut().for_each(|v| *v += (NOISE * random.normals()[0]) as f32);
    out
}

/// Rows of one run: truth and what was found, region by region.
fn report(
    (case, seed, source): (&str, u64, &str),
    body: &Pressed,
    (displacement, matches): (&DenseField, Option<&SparseField>),
    labels: &Mask,
    params: &StiffnessParams,
) {
    let (found, seconds) = cpu::timed(|| body.measure(displacement, matches, labels, params));
    let result = match found {
        Ok(result) => result,
        Err(error) => return println!("{case},{seed},{source},,,,,,,,,{seconds:.1},{error}"),
    };
    let law = match result.law {
        Law::Linear => "linear",
        Law::NeoHookean => "neo-hookean",
    };
    let base = body.modulus(result.reference);
    for r in &result.regions {
        let truth = body.modulus(r.label);
        let (error, ratio) = (r.youngs_modulus / truth - 1.0, r.ratio / (truth / base) - 1.0);
        println!(
            "{case},{seed},{source},{},{truth:.2},{:.2},{:.2},{:.2},{:.2},{:.2},{},{law},{},{seconds:.1},",
            r.label,
            r.youngs_modulus,
            100.0 * error,
            200.0 * r.sd / r.youngs_modulus,
            100.0 * ratio,
            200.0 * r.ratio_sd / r.ratio,
            r.bound.unwrap_or("value"),
            result.mesh.nodes().len(),
        );
    }
}

fn bars(case: &str, seed: u64) -> Result<(), Box<dyn std::error::Error>> {
    let body = body(case, seed)?;
    let Some(labels) = body.phantom.stiffness.as_ref().map(|s| &s.labels) else { return Ok(()) };
    let params = StiffnessParams { force_n: Some(body.force_n), ..StiffnessParams::default() };
    let truth = &body.phantom.truth;
    report((case, seed, "exact"), &body, (truth, None), labels, &params);
    report((case, seed, "white"), &body, (&white(truth, seed), None), labels, &params);
    report((case, seed, "correlated"), &body, (&disturbed(truth, NOISE, seed), None), labels, &params);
    let (initial, deformed) = (&body.phantom.initial, &body.phantom.deformed);
    let tissue = Mask::from_voxels(*labels.grid(), |at, _| u8::from(labels.as_slice()[at] != 0));
    let measured = field::run(initial, deformed, Some(&tissue), &FieldParams::default(), &|_, _| {})?;
    let displacement = &measured.displacement;
    report((case, seed, "images"), &body, (displacement, Some(&measured.matches)), labels, &params);
    report((case, seed, "images-field"), &body, (displacement, None), labels, &params);
    Ok(())
}

/// The lowest three layers of voxels of a body, without the quarter of them at small x.
fn bottom_but_a_quarter(labels: &Mask) -> Mask {
    let (grid, inside) = (*labels.grid(), labels.as_slice());
    let tissue = || (0..grid.len()).filter(|&at| inside[at] != 0).map(|at| grid.voxel(at));
    let least = |a: usize| tissue().map(|v| v[a]).min().unwrap_or(0);
    let most = tissue().map(|v| v[0]).max().unwrap_or(0);
    let (low, from) = (least(2), least(0) + (most - least(0)) / 4);
    Mask::from_voxels(grid, |at, _| {
        let v = grid.voxel(at);
        u8::from(inside[at] != 0 && v[2] < low + 3 && v[0] >= from)
    })
}

fn wrong(case: &str, seed: u64) -> Result<(), Box<dyn std::error::Error>> {
    let mut body = body(case, seed)?;
    let Some(labels) = body.phantom.stiffness.as_ref().map(|s| s.labels.clone()) else { return Ok(()) };
    let truth = body.phantom.truth.clone();
    let params = StiffnessParams { force_n: Some(body.force_n), ..StiffnessParams::default() };
    for poisson in [0.48, 0.485, 0.495, 0.498] {
        let params = StiffnessParams { poisson, ..params.clone() };
        report((case, seed, &format!("nu {poisson}")), &body, (&truth, None), &labels, &params);
    }
    for voxels in [1, 2, 3] {
        let beside = shifted_labels(&labels, voxels);
        report((case, seed, &format!("labels {voxels} voxels beside")), &body, (&truth, None), &beside, &params);
    }
    body.hold_at(bottom_but_a_quarter(&labels), "three quarters of the base");
    report((case, seed, "a quarter of the held side missing"), &body, (&truth, None), &labels, &params);
    Ok(())
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let given: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect();
    let mut numbers = given.iter().filter_map(|a| a.parse::<u64>().ok());
    let (seeds, first) = (numbers.next().unwrap_or(3), numbers.next().unwrap_or(21));
    let chosen = |case: &str| given.iter().any(|a| a == case) || !given.iter().any(|a| CASES.contains(&a.as_str()));
    println!(
        "case,seed,source,region,truth_kpa,found_kpa,error_percent,two_sd_percent,ratio_error_percent,\
         ratio_two_sd_percent,kind,law,nodes,cpu_s,failure"
    );
    for case in CASES.into_iter().filter(|c| chosen(c)) {
        for seed in first..first + seeds {
            if given.iter().any(|a| a == "wrong") { wrong(case, seed)? } else { bars(case, seed)? }
        }
    }
    Ok(())
}
