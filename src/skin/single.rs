//! One layer in place of several whose elements are not alike: the element of the richest kind
//! among them whose response to the scene's load is nearest to the column's.
//!
//! Layers that are alike have a mean of each part ([`SkinScene::without_layers`]); for a mix there
//! is none. Least squares (Levenberg and Marquardt) over the logarithms of the element's parts, of
//! the stress while the load is on, over its largest, and of the depth after it, over the
//! indentation.

use crate::numerics::dense::solve;
use crate::skin::column;
use crate::types::skin::{ElementKind, Layer, SkinSample, SkinScene};

/// Most parameters of an element: spring or second branch, dashpots, and the factor of unloading.
const MAX_PARAMETERS: usize = 6;
/// Levenberg-Marquardt fit of the parameters' logarithms.
struct FitControl {
    /// Most iterations.
    max_iterations: usize,
    /// Step at which the fit has converged.
    tolerance: f64,
    /// Step of the central differences.
    difference_step: f64,
    /// Largest step of an iteration.
    max_step: f64,
}

const FIT: FitControl = FitControl { max_iterations: 60, tolerance: 1e-6, difference_step: 1e-4, max_step: 1.0 };

/// The scene with one layer, as thick as all.
pub fn fitted(scene: &SkinScene) -> SkinScene {
    let stays = scene.layers.iter().any(|l| l.e0 == 0.0);
    let dual = scene.layers.iter().any(|l| !l.c_unload.is_empty());
    let thickness = scene.thickness();
    // Of the layers that have the part: that of the stack in series, were it theirs alone.
    let series = |part: &dyn Fn(&Layer) -> f64, otherwise: f64| {
        let some: Vec<&Layer> = scene.layers.iter().filter(|l| part(l) > 0.0).collect();
        let compliance: f64 = some.iter().map(|l| l.thickness / part(l)).sum();
        if some.is_empty() { otherwise } else { some.iter().map(|l| l.thickness).sum::<f64>() / compliance }
    };
    let branch = |l: &Layer, i: usize, k: usize| l.maxwell.get(i).map_or(0.0, |b| b[k]);
    let spring = series(&|l| l.e0, 0.0);
    let first = [0, 1].map(|k| series(&|l| branch(l, 0, k), 0.0));
    let stiff = if first[0] > 0.0 { first[0] } else { spring };
    let slow = if first[1] > 0.0 { first[1] } else { stiff * scene.load.hold.max(scene.load.ramp) };
    let c0 = series(&|l| l.c0, 0.01 * stiff * scene.load.ramp);
    let one = |p: &[f64; MAX_PARAMETERS]| {
        let [a, c0, e1, c1, c2, unload] = p.map(f64::exp);
        let (element, e0, maxwell) = if stays {
            (ElementKind::FiveElement, 0.0, vec![[e1, c1], [a, c2]])
        } else {
            (ElementKind::StandardLinearSolid, a, vec![[e1, c1]])
        };
        let all: Vec<f64> = std::iter::once(c0).chain(maxwell.iter().map(|b| b[1])).collect();
        let c_unload = if dual { all.iter().map(|c| c * unload).collect() } else { Vec::new() };
        let layer = Layer { name: "one layer".into(), thickness, element, e0, c0, maxwell, c_unload };
        SkinScene { layers: vec![layer], ..scene.clone() }
    };
    let times = column::times(scene);
    let truth = column::respond_at(scene, &times);
    let top = truth.iter().map(|s| s.stress.abs()).fold(f64::MIN_POSITIVE, f64::max);
    let unload = scene.load.ramp + scene.load.hold;
    let off = |p: &[f64; MAX_PARAMETERS]| -> Vec<f64> {
        let of = |(a, b): (&SkinSample, &SkinSample)| {
            // The rate of the ramp is a step, which dashpots answer at once: its first sample says
            // nothing of the rest.
            let loaded = a.time < unload || a.stress != 0.0;
            if loaded {
                (b.stress - a.stress) / top
            } else {
                (b.displacement - a.displacement) / scene.load.displacement
            }
        };
        truth.iter().zip(&column::respond_at(&one(p), &times)).map(of).collect()
    };
    let squares = |r: &[f64]| r.iter().map(|v| v * v).sum::<f64>();
    let start = if stays { [stiff, c0, stiff, 0.1 * slow, slow, 1.0] } else { [spring, c0, stiff, slow, 1.0, 1.0] };
    let mut p = start.map(|v: f64| v.max(f64::MIN_POSITIVE).ln());
    let used: Vec<usize> =
        (0..MAX_PARAMETERS).filter(|k| (*k < 4) || (*k == 4 && stays) || (*k == 5 && dual)).collect();
    let (mut r, mut weight) = (off(&p), 1e-2);
    for _ in 0..FIT.max_iterations {
        let mut columns = vec![Vec::new(); MAX_PARAMETERS];
        for &k in &used {
            let moved = |sign: f64| {
                let mut q = p;
                q[k] += sign * FIT.difference_step;
                off(&q)
            };
            columns[k] =
                moved(1.0).iter().zip(moved(-1.0)).map(|(u, d)| (u - d) / (2.0 * FIT.difference_step)).collect();
        }
        let dot = |x: &[f64], y: &[f64]| x.iter().zip(y).map(|(a, b)| a * b).sum::<f64>();
        let mut settled = true;
        for _ in 0..12 {
            let matrix = std::array::from_fn(|i| {
                std::array::from_fn(|j| match (used.contains(&i) && used.contains(&j), i == j) {
                    (true, true) => dot(&columns[i], &columns[i]) * (1.0 + weight) + f64::MIN_POSITIVE,
                    (true, false) => dot(&columns[i], &columns[j]),
                    (false, same) => f64::from(u8::from(same)),
                })
            });
            let right = std::array::from_fn(|i| if used.contains(&i) { -dot(&columns[i], &r) } else { 0.0 });
            let Some(step) = solve::<MAX_PARAMETERS>(&matrix, &right) else { break };
            let size = step.iter().fold(0.0, |l: f64, v| l.max(v.abs()));
            let part = (FIT.max_step / size.max(f64::MIN_POSITIVE)).min(1.0);
            let next: [f64; MAX_PARAMETERS] = std::array::from_fn(|k| p[k] + part * step[k]);
            let found = off(&next);
            if squares(&found) < squares(&r) {
                (p, r, weight, settled) = (next, found, (0.1 * weight).max(1e-9), size < FIT.tolerance);
                break;
            }
            weight *= 10.0;
        }
        if settled {
            break;
        }
    }
    one(&p)
}
