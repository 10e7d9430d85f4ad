//! A column of layers in series: they share the stress, and their compressions add up to the
//! indentation.
//!
//! With d_i the dashpot strain of a Maxwell branch, s_i = E_i (e - d_i) and d_i' = s_i / c_i. A
//! layer with a lone dashpot has its strain as a state, e' = (sigma - e0 e - sum s_i) / c0; one
//! without has e = (sigma + sum E_i d_i) / (e0 + sum E_i). Under a given indentation the stress
//! follows from sum h_j e_j = u (or from its rate, where every layer has a dashpot); let go, it is
//! zero. In each phase of the load this is linear with constant coefficients, so `exp(A h)` takes
//! it from any time to any other without a step error.

use crate::numerics::dense::dot;
use crate::skin::exponential::{exponential, rounding};
use crate::types::skin::{Layer, SkinLoad, SkinSample, SkinScene};

/// Samples during the ramp, the hold and the time after.
const PHASE_SAMPLES: [usize; 3] = [40, 80, 120];

/// A layer in one phase, with the places of its states.
struct Part {
    thickness: f64,
    e0: f64,
    c0: f64,
    branches: Vec<[f64; 2]>,
    /// State of the first branch's dashpot; the others follow.
    first: usize,
    /// State of the strain, of a layer with a lone dashpot.
    strain: Option<usize>,
}

/// The linear system of one phase. After the states come the indentation, the impulse and the
/// number 1.
struct Phase {
    parts: Vec<Part>,
    /// Rows of A.
    matrix: Vec<f64>,
    /// The stress as a row.
    stress: Vec<f64>,
    size: usize,
}

impl Phase {
    /// `rate` of the indentation (m/s), none when let go.
    fn new(layers: &[Layer], unloaded: bool, rate: Option<f64>) -> Self {
        let mut states = 0;
        let parts: Vec<Part> = layers
            .iter()
            .map(|l| {
                let (c0, branches) = l.dashpots(unloaded);
                let first = states;
                states += branches.len();
                let strain = (c0 > 0.0).then_some(states);
                states += usize::from(c0 > 0.0);
                Part { thickness: l.thickness, e0: l.e0, c0, branches, first, strain }
            })
            .collect();
        let size = states + 3;
        let mut phase = Self { parts, matrix: vec![0.0; size * size], stress: vec![0.0; size], size };
        if let Some(rate) = rate {
            phase.stress = phase.stress_under(rate);
        }
        phase.fill(rate.unwrap_or(0.0));
        phase
    }

    /// The pull of a layer's spring and branches at strain `e` less that of its dashpots: (factor
    /// of e, factors of d).
    fn spring(part: &Part) -> f64 {
        part.e0 + part.branches.iter().map(|b| b[0]).sum::<f64>()
    }

    /// sigma as a row, under a given indentation.
    fn stress_under(&self, rate: f64) -> Vec<f64> {
        let (n, mut row) = (self.size, vec![0.0; self.size]);
        let mut compliance = 0.0;
        if self.parts.iter().all(|p| p.strain.is_some()) {
            // sum h e' = rate.
            row[n - 1] = rate;
            for p in &self.parts {
                let share = p.thickness / p.c0;
                compliance += share;
                if let Some(at) = p.strain {
                    row[at] += share * Self::spring(p);
                }
                p.branches.iter().enumerate().for_each(|(i, b)| row[p.first + i] -= share * b[0]);
            }
        } else {
            // sum h e = u.
            row[n - 3] = 1.0;
            for p in &self.parts {
                match p.strain {
                    Some(at) => row[at] -= p.thickness,
                    None => {
                        let share = p.thickness / Self::spring(p);
                        compliance += share;
                        p.branches.iter().enumerate().for_each(|(i, b)| row[p.first + i] -= share * b[0]);
                    }
                }
            }
        }
        row.iter().map(|v| v / compliance).collect()
    }

    /// A layer's strain as a row.
    fn strain(&self, part: &Part) -> Vec<f64> {
        let mut row = vec![0.0; self.size];
        match part.strain {
            Some(at) => row[at] = 1.0,
            None => {
                let spring = Self::spring(part);
                row.iter_mut().zip(&self.stress).for_each(|(r, s)| *r = s / spring);
                part.branches.iter().enumerate().for_each(|(i, b)| row[part.first + i] += b[0] / spring);
            }
        }
        row
    }

    fn fill(&mut self, rate: f64) {
        let n = self.size;
        for p in &self.parts {
            let strain = self.strain(p);
            for (i, [modulus, dashpot]) in p.branches.iter().enumerate() {
                let row = &mut self.matrix[(p.first + i) * n..][..n];
                row.iter_mut().zip(&strain).for_each(|(r, e)| *r = modulus / dashpot * e);
                row[p.first + i] -= modulus / dashpot;
            }
            if let Some(at) = p.strain {
                let row = &mut self.matrix[at * n..][..n];
                row.iter_mut().zip(&self.stress).for_each(|(r, s)| *r = s / p.c0);
                row[at] -= Self::spring(p) / p.c0;
                p.branches.iter().enumerate().for_each(|(i, b)| row[p.first + i] += b[0] / p.c0);
            }
        }
        self.matrix[(n - 3) * n + n - 1] = rate;
        self.matrix[(n - 2) * n..(n - 1) * n].copy_from_slice(&self.stress);
    }

    /// The state `h` seconds later.
    fn after(&self, state: &[f64], h: f64) -> Vec<f64> {
        let step = exponential(&self.matrix, self.size, h);
        step.chunks_exact(self.size).map(|row| dot(row, state)).collect()
    }

    fn sample(&self, time: f64, state: &[f64]) -> SkinSample {
        let strain: Vec<f64> = self.parts.iter().map(|p| dot(&self.strain(p), state)).collect();
        SkinSample {
            time,
            stress: dot(&self.stress, state),
            displacement: self.parts.iter().zip(&strain).map(|(p, e)| p.thickness * e).sum(),
            strain,
            impulse: state[self.size - 2],
        }
    }
}

/// Part of the largest value by which rounding alone may be off at the end of the longest phase of
/// the load (1): it grows with how much faster the fastest layer is.
pub fn precision(scene: &SkinScene) -> f64 {
    let SkinLoad { ramp, hold, end, .. } = scene.load;
    let loaded = Phase::new(&scene.layers, false, Some(0.0));
    let free = Phase::new(&scene.layers, true, None);
    [(&loaded, ramp.max(hold)), (&free, end - ramp - hold)]
        .map(|(phase, h)| rounding(&phase.matrix, phase.size, h))
        .into_iter()
        .fold(0.0, f64::max)
}

/// The response of a column to the scene's load; exact at each sample. A scene must have been
/// checked.
///
/// ```
/// use palpate::skin::column::respond;
/// use palpate::types::skin::{ElementKind, Layer, SkinBlock, SkinLoad, SkinScene};
/// let layer = Layer {
///     name: "dermis".into(),
///     thickness: 2e-3,
///     element: ElementKind::ThreeElement,
///     e0: 0.0,
///     c0: 400.0,
///     maxwell: vec![[2e4, 2e5]],
///     c_unload: Vec::new(),
/// };
/// let load = SkinLoad { displacement: 2e-4, ramp: 1.0, hold: 2.0, end: 8.0 };
/// let block = SkinBlock { width: 2e-2, indenter: 5e-3, poisson: 0.45 };
/// let scene = SkinScene { load, layers: vec![layer], block };
/// let response = respond(&scene);
/// // A tenth of the thickness is pressed in, and without a lone spring some of it stays.
/// let deepest = response.iter().map(|s| s.strain[0]).fold(0.0, f64::max);
/// let last = response.last().ok_or("no sample")?.strain[0];
/// assert!((deepest - 0.1).abs() < 1e-6 && last > 0.0 && last < deepest);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn respond(scene: &SkinScene) -> Vec<SkinSample> {
    respond_at(scene, &times(scene))
}

/// The same at the times (s) of each phase: ramp, hold, after. Where a phase begins with a time of
/// its own, that time is sampled on both sides of the corner.
pub fn respond_at(scene: &SkinScene, times: &[Vec<f64>; 3]) -> Vec<SkinSample> {
    let load = &scene.load;
    let phases = [
        (0.0, Phase::new(&scene.layers, false, Some(load.displacement / load.ramp))),
        (load.ramp, Phase::new(&scene.layers, false, Some(0.0))),
        (load.ramp + load.hold, Phase::new(&scene.layers, true, None)),
    ];
    let ends = [load.ramp, load.ramp + load.hold, load.end];
    let mut out = Vec::new();
    let mut state = vec![0.0; phases[0].1.size];
    state[phases[0].1.size - 1] = 1.0;
    for (((start, phase), times), end) in phases.iter().zip(times).zip(ends) {
        let (mut at, mut now) = (*start, state.clone());
        for &time in times {
            now = if time > at { phase.after(&now, time - at) } else { now };
            at = time;
            out.push(phase.sample(time, &now));
        }
        state = phase.after(&state, end - start);
    }
    out
}

/// Even in the ramp; close after each corner, where things go fast, in the hold and after.
pub fn times(scene: &SkinScene) -> [Vec<f64>; 3] {
    let load = &scene.load;
    let fastest = scene
        .layers
        .iter()
        .flat_map(|l| {
            let spring = l.e0 + l.maxwell.iter().map(|b| b[0]).sum::<f64>();
            [false, true].into_iter().flat_map(move |unloaded| {
                let (c0, branches) = l.dashpots(unloaded);
                branches.into_iter().map(|[e, c]| c / e).chain((c0 > 0.0).then_some(c0 / spring))
            })
        })
        .fold(load.ramp, f64::min);
    let growing = |start: f64, span: f64, n: usize| -> Vec<f64> {
        if span <= 0.0 {
            return Vec::new();
        }
        let first = (0.2 * fastest).min(span / n as f64);
        let ratio = (span / first).powf(1.0 / (n - 1) as f64);
        let inner = (0..n - 1).map(|i| start + first * ratio.powi(i as i32));
        std::iter::once(start).chain(inner).chain([start + span]).collect()
    };
    let ramp = (0..=PHASE_SAMPLES[0]).map(|i| load.ramp * i as f64 / PHASE_SAMPLES[0] as f64).collect();
    let unload = load.ramp + load.hold;
    [ramp, growing(load.ramp, load.hold, PHASE_SAMPLES[1]), growing(unload, load.end - unload, PHASE_SAMPLES[2])]
}

/// The strain that stays after all time in a layer without a lone spring: the integral of the
/// stress over the sum of its dashpots; none where a spring brings it back, or where the dashpots
/// change.
///
/// ```
/// use palpate::skin::column::residual;
/// use palpate::types::skin::{ElementKind, Layer};
/// let mut layer = Layer {
///     name: "fat".into(),
///     thickness: 2e-3,
///     element: ElementKind::ThreeElement,
///     e0: 0.0,
///     c0: 100.0,
///     maxwell: vec![[2e4, 900.0]],
///     c_unload: Vec::new(),
/// };
/// // An impulse of 50 Pa s over dashpots of 1000 Pa s.
/// assert_eq!(residual(&layer, 50.0), Some(0.05));
/// layer.e0 = 1e4;
/// assert_eq!(residual(&layer, 50.0), None);
/// ```
pub fn residual(layer: &Layer, impulse: f64) -> Option<f64> {
    let constant = layer.e0 == 0.0 && layer.c_unload.is_empty();
    constant.then(|| impulse / (layer.c0 + layer.maxwell.iter().map(|b| b[1]).sum::<f64>()))
}
