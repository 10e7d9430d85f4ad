//! Fits of the tip models to measurements: least squares for Young's modulus and damping, and the
//! evidence between models by Schwarz's criterion (Ann. Statist. 6, 1978).
//!
//! The noise is not known: it is taken from the misfit. Misfits that follow each other count for
//! fewer numbers, n (1 - r) / (1 + r) with the correlation r of neighbours (Bayley and Hammersley
//! 1946, first order), in the deviations and in the evidence.

use crate::error::GraspError;
use crate::grasp::models::{Tilt, in_range, tip_of};
use crate::grasp::simulate::simulate;
use crate::types::grasp::{GraspRun, Sample};
use crate::types::measured::{CoursePoint, Estimate, ForcePoint, MeasuredFit, Measurements, ModelFit};
use crate::types::{FingertipModel, Scene};

/// Models that are compared with measurements: with tangential deformation, without, and radial.
const COMPARED_MODELS: [FingertipModel; 3] =
    [FingertipModel::Parallel, FingertipModel::ParallelNormal, FingertipModel::Radial];
/// Largest correlation of neighbouring samples: at a larger one the effective sample size of a
/// table vanishes.
const MAX_CORRELATION: f64 = 0.98;
/// Time between samples of a run that is compared with measurements (s).
const SAMPLE_INTERVAL_S: f64 = 0.002;
/// Levenberg-Marquardt fit of the parameters' logarithms.
struct FitControl {
    /// Most iterations.
    max_iterations: usize,
    /// Step at which the fit has converged.
    tolerance: f64,
    /// Step of the central differences.
    difference_step: f64,
}

const FIT: FitControl = FitControl { max_iterations: 30, tolerance: 1e-7, difference_step: 1e-3 };

/// A fit before its evidence is known.
struct Raw {
    model: &'static str,
    modulus: Estimate,
    damping: Option<Estimate>,
    misfit: Vec<f64>,
    parameters: usize,
    predicted: Vec<[f64; 3]>,
    joints_off: f64,
}

/// Fits every model to `measured` on the tip of `scene`.
pub fn fit(scene: &Scene, measured: &Measurements) -> MeasuredFit {
    let (kind, channels) = match measured {
        Measurements::Force(_) => ("force", 1),
        Measurements::Course(_) => ("course", 3),
    };
    let (mut raws, mut failed) = (Vec::new(), Vec::new());
    for model in COMPARED_MODELS {
        let found = match measured {
            // Without d_t a table of presses does not tell the first two apart.
            Measurements::Force(points)
                if model == FingertipModel::Parallel && points.iter().all(|p| p.d_t.unwrap_or(0.0) == 0.0) =>
            {
                Err("the table has no dt, in which alone it differs from parallel-normal".to_string())
            }
            Measurements::Force(points) => presses(scene, model, points),
            Measurements::Course(points) => course(scene, model, points),
        };
        match found {
            Ok(raw) => raws.push(raw),
            Err(why) => failed.push((model.name(), why)),
        }
    }
    let squares = |raw: &Raw| raw.misfit.iter().map(|v| v * v).sum::<f64>();
    raws.sort_by(|a, b| squares(a).total_cmp(&squares(b)));
    let all = (measured.len() * channels) as f64;
    let independent = raws.first().map_or(all, |raw| all * fewer(&raw.misfit, channels));
    let evidence = |raw: &Raw| {
        let mean = (squares(raw) / all).max(f64::MIN_POSITIVE);
        // The noise is a parameter too.
        -0.5 * independent * mean.ln() - 0.5 * (raw.parameters + 1) as f64 * independent.ln()
    };
    let best = raws.iter().map(evidence).fold(f64::NEG_INFINITY, f64::max);
    raws.sort_by(|a, b| evidence(b).total_cmp(&evidence(a)));
    let joints_off = raws.first().map_or(0.0, |r| r.joints_off);
    let models = raws.into_iter().map(|raw| {
        let spread = fewer(&raw.misfit, channels).sqrt();
        let wide = |e: Estimate| Estimate { sd: e.sd / spread, ..e };
        ModelFit {
            model: raw.model,
            youngs_modulus: wide(raw.modulus),
            damping: raw.damping.map(wide),
            rms: (squares(&raw) / all).sqrt(),
            log_evidence: evidence(&raw) - best,
            predicted: raw.predicted,
        }
    });
    MeasuredFit { kind, rows: measured.len(), independent, models: models.collect(), failed, joints_off }
}

/// What part of misfits counts as independent; they stand channel by channel.
fn fewer(misfit: &[f64], channels: usize) -> f64 {
    let (mut along, mut whole) = (0.0, f64::MIN_POSITIVE);
    for channel in misfit.chunks(misfit.len().div_ceil(channels).max(1)) {
        along += channel.windows(2).map(|w| w[0] * w[1]).sum::<f64>();
        whole += channel.iter().map(|v| v * v).sum::<f64>();
    }
    let r = (along / whole).clamp(0.0, MAX_CORRELATION);
    (1.0 - r) / (1.0 + r)
}

/// Least squares of force = E g + c d' over presses, g the force of a modulus of 1 Pa.
fn presses(scene: &Scene, model: FingertipModel, points: &[ForcePoint]) -> Result<Raw, String> {
    let unit = tip_of(&crate::types::Fingertip { youngs_modulus: 1.0, ..scene.fingertip.clone() }, model);
    let radius = scene.fingertip.radius;
    let mut rows = Vec::with_capacity(points.len());
    for (i, p) in points.iter().enumerate() {
        let tilt = Tilt::of(p.tilt);
        if p.d != 0.0 && !in_range(radius, p.d, tilt.sin) {
            return Err(format!(
                "row {} is out of the model's range: d {:.3} mm at {:.1} degrees on a radius of {:.1} mm",
                i + 1,
                1e3 * p.d,
                p.tilt.to_degrees(),
                1e3 * radius
            ));
        }
        let d_t = if model == FingertipModel::Parallel { p.d_t.unwrap_or(0.0) } else { 0.0 };
        let normal = unit.gradient(p.d, d_t, tilt).normal;
        // Along the back plate's normal; radial springs know no plate.
        let along = if model == FingertipModel::Radial { normal } else { tilt.cos * normal };
        rows.push([along, p.rate.unwrap_or(0.0)]);
    }
    let (mut m, mut b) = ([[0.0; 2]; 2], [0.0; 2]);
    for (row, p) in rows.iter().zip(points) {
        for i in 0..2 {
            b[i] += row[i] * p.force;
            (0..2).for_each(|j| m[i][j] += row[i] * row[j]);
        }
    }
    let damped = m[1][1] > 0.0;
    let det = m[0][0] * m[1][1] - m[0][1] * m[0][1];
    let none = || "the table has no press that gives a force".to_string();
    if m[0][0] <= 0.0 || (damped && det <= 1e-12 * m[0][0] * m[1][1]) {
        return Err(none());
    }
    let [e, c, inverse_e, inverse_c] = if damped {
        let solved = [(b[0] * m[1][1] - b[1] * m[0][1]) / det, (b[1] * m[0][0] - b[0] * m[0][1]) / det];
        [solved[0], solved[1], m[1][1] / det, m[0][0] / det]
    } else {
        [b[0] / m[0][0], 0.0, 1.0 / m[0][0], 0.0]
    };
    let predicted: Vec<[f64; 3]> = rows.iter().map(|r| [e * r[0] + c * r[1], 0.0, 0.0]).collect();
    let misfit: Vec<f64> = points.iter().zip(&predicted).map(|(p, f)| p.force - f[0]).collect();
    let parameters = 1 + usize::from(damped);
    let free = points.len().saturating_sub(parameters).max(1) as f64;
    let noise = misfit.iter().map(|v| v * v).sum::<f64>() / free;
    Ok(Raw {
        model: model.name(),
        modulus: Estimate { value: e, sd: (noise * inverse_e).sqrt() },
        damping: damped.then(|| Estimate { value: c, sd: (noise * inverse_c).sqrt() }),
        misfit,
        parameters,
        predicted,
        joints_off: 0.0,
    })
}

/// The state of a run at `time` (s), between its samples.
fn at(run: &GraspRun, time: f64) -> Option<Sample> {
    let after = run.samples.partition_point(|s| s.time < time - 1e-9);
    let next = run.samples.get(after)?;
    let Some(before) = after.checked_sub(1).map(|i| run.samples[i]) else { return Some(*next) };
    let part = ((time - before.time) / (next.time - before.time)).clamp(0.0, 1.0);
    let between = |a: f64, b: f64| a + part * (b - a);
    Some(Sample {
        time,
        pose: [0, 1, 2].map(|k| between(before.pose[k], next.pose[k])),
        joints: [0, 1].map(|k| between(before.joints[k], next.joints[k])),
        ..*next
    })
}

/// The states of a scene's run at the times of measurement.
fn simulated(mut scene: Scene, points: &[CoursePoint]) -> Result<Vec<Sample>, String> {
    let run = match simulate(&scene, &|_| {}) {
        // What is tried on the way may be stiffer than the scene's step allows.
        Err(GraspError::BadStep { stable, .. }) => {
            scene.integrator.step = 0.5 * stable;
            simulate(&scene, &|_| {})
        }
        other => other,
    };
    let run = run.map_err(|e| e.to_string())?;
    let state = |p: &CoursePoint| {
        at(&run, p.time).ok_or_else(|| {
            let ended = run.flaw().map_or(String::new(), |e| format!(": {} at {:.2} s", e.kind.name(), e.time));
            format!("the run ends before the measurement at {} s{ended}", p.time)
        })
    };
    points.iter().map(state).collect()
}

/// Least squares of the object's pose over the logarithms of modulus and damping, whose c_t keeps
/// its part of c_n (Levenberg and Marquardt).
fn course(scene: &Scene, model: FingertipModel, points: &[CoursePoint]) -> Result<Raw, String> {
    let mut scene = scene.with_model(model);
    scene.integrator.output_every = SAMPLE_INTERVAL_S.max(scene.integrator.step);
    scene.object.friction = None;
    let a = scene.fingertip.radius;
    let start = [scene.fingertip.youngs_modulus, scene.fingertip.damping[0]];
    let damped = start[1] > 0.0;
    let with = |p: [f64; 2]| {
        let mut scene = scene.clone();
        scene.fingertip.youngs_modulus *= p[0].exp();
        scene.fingertip.damping = scene.fingertip.damping.map(|c| c * p[1].exp());
        simulated(scene, points)
    };
    let misfit = |states: &[Sample]| -> Vec<f64> {
        let scale = [1.0, 1.0, a];
        let one = |k: usize| states.iter().zip(points).map(move |(s, p)| scale[k] * (p.pose[k] - s.pose[k]));
        (0..3).flat_map(one).collect()
    };
    let squares = |r: &[f64]| r.iter().map(|v| v * v).sum::<f64>();
    let parameters = 1 + usize::from(damped);
    let (mut p, mut states) = ([0.0; 2], with([0.0; 2])?);
    let (mut r, mut weight) = (misfit(&states), 1e-3);
    let mut normal = [[0.0; 2]; 2];
    for _ in 0..FIT.max_iterations {
        let mut columns: Vec<Vec<f64>> = Vec::new();
        for k in 0..parameters {
            let moved = |sign: f64| {
                let mut q = p;
                q[k] += sign * FIT.difference_step;
                with(q).map(|s| misfit(&s))
            };
            let (up, down) = (moved(1.0)?, moved(-1.0)?);
            columns.push(up.iter().zip(&down).map(|(u, d)| (u - d) / (2.0 * FIT.difference_step)).collect());
        }
        let dot = |x: &[f64], y: &[f64]| x.iter().zip(y).map(|(a, b)| a * b).sum::<f64>();
        let mut b = [0.0; 2];
        for i in 0..parameters {
            b[i] = -dot(&columns[i], &r);
            (0..parameters).for_each(|j| normal[i][j] = dot(&columns[i], &columns[j]));
        }
        let mut settled = false;
        loop {
            let m = std::array::from_fn(|i| {
                std::array::from_fn(|j| match (i < parameters && j < parameters, i == j) {
                    (true, true) => normal[i][j] * (1.0 + weight),
                    (true, false) => normal[i][j],
                    (false, same) => f64::from(u8::from(same)),
                })
            });
            let Some(step) = crate::numerics::dense::solve::<2>(&m, &b) else { break };
            let size = step.iter().fold(0.0, |l: f64, v| l.max(v.abs()));
            let part = (0.5 / size).min(1.0);
            let next = [p[0] + part * step[0], p[1] + part * step[1]];
            let better = with(next).ok().map(|s| (misfit(&s), s)).filter(|(m, _)| squares(m) <= squares(&r));
            settled = size < FIT.tolerance;
            if let Some((misfit, s)) = better {
                (p, r, states, weight) = (next, misfit, s, weight * 0.1);
                break;
            }
            weight *= 10.0;
            if weight > 1e6 || settled {
                settled = true;
                break;
            }
        }
        if settled {
            break;
        }
    }
    let free = r.len().saturating_sub(parameters).max(1) as f64;
    let noise = squares(&r) / free;
    let det = normal[0][0] * normal[1][1] - normal[0][1] * normal[0][1];
    let variance = if damped { [normal[1][1] / det, normal[0][0] / det] } else { [1.0 / normal[0][0], 0.0] };
    let estimate = |k: usize| {
        let value = start[k] * p[k].exp();
        Estimate { value, sd: value * (noise * variance[k]).sqrt() }
    };
    let off = |s: &Sample, p: &CoursePoint| (0..2).map(|i| (s.joints[i] - p.joints[i]).abs()).fold(0.0, f64::max);
    Ok(Raw {
        model: model.name(),
        modulus: estimate(0),
        damping: damped.then(|| estimate(1)),
        joints_off: states.iter().zip(points).map(|(s, p)| off(s, p)).fold(0.0, f64::max),
        predicted: states.iter().map(|s| s.pose).collect(),
        misfit: r,
        parameters,
    })
}
