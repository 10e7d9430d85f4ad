//! Strain from a displacement field: gauge, strain, deviation, regions, in order.

use crate::error::{FieldError, StrainError};
use crate::field::jacobian;
use crate::numerics::statistics::{median, noise_sigma};
use crate::pipeline::clock::Clock;
use crate::pipeline::field::{FieldResult, Progress};
use crate::pipeline::uncertainty::{SAMPLED_VOXELS, evenly};
use crate::strain::StrainField;
use crate::strain::deviation::{COMPONENTS, Draws, Gradients, StrainDeviation, apart, components};
use crate::strain::directions::Directions;
use crate::strain::gauge::{Gauge, map_gradients};
use crate::strain::measure;
use crate::strain::statistics::moments;
use crate::types::{
    DenseField, ErrorSamples, GaugeTrial, Grid, Mask, RegionStrain, StrainMeasure, StrainSummary, Trust, WorldPoint,
};
use rayon::prelude::*;

/// What strain is taken from.
#[derive(Debug, Clone, Copy)]
pub struct StrainInput<'a> {
    /// The displacement (mm, RAS).
    pub field: &'a DenseField,
    /// The body of each voxel, from 1; 0 outside the tissue. No displacement of one body enters the
    /// strain of another.
    pub bodies: &'a Mask,
    /// Regions whose strain is summed up; the bodies without.
    pub labels: Option<&'a Mask>,
    /// Errors that the field may have, where they are known.
    pub samples: Option<&'a ErrorSamples>,
    /// How far the field is to be relied on, where that is known.
    pub trust: Option<Trust>,
}

impl<'a> StrainInput<'a> {
    /// A measured field with all that is known of it, its bodies as regions.
    pub fn of(result: &'a FieldResult) -> Self {
        Self {
            field: &result.displacement,
            bodies: &result.bodies,
            labels: None,
            samples: Some(&result.samples),
            trust: Some(result.summary.expected.trust()),
        }
    }
}

/// What is asked for.
#[derive(Debug, Clone, Default)]
pub struct StrainParams {
    /// Gauge length (mm); none: chosen from the noise.
    pub gauge_mm: Option<f64>,
    /// Which strain.
    pub measure: StrainMeasure,
    /// Directions of the tissue.
    pub directions: Directions,
}

/// The strain, its deviation and what they add up to.
#[derive(Debug, Clone, PartialEq)]
pub struct StrainResult {
    /// The strain (1).
    pub strain: StrainField,
    /// Its standard deviation (1).
    pub deviation: StrainDeviation,
    /// The rest.
    pub summary: StrainSummary,
}

/// Gauge lengths that are tried, in units of the shortest, which reaches a voxel's neighbours.
const GAUGE_MULTIPLES: [usize; 4] = [1, 2, 4, 8];

/// The strain of a displacement field.
///
/// # Errors
/// [`StrainError`] when the field is not finite or folds in the tissue, grids differ, the gauge
/// does not fit or directions are missing.
///
/// ```
/// use palpate::pipeline::strain::run;
/// use palpate::{Affine, DenseField, Grid, Mask, StrainInput, StrainMeasure, StrainParams};
/// let grid = Grid::new([16; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let field = DenseField::from_fn(grid, |p| [0.03 * p.0[0], 0.0, 0.0]);
/// let bodies = Mask::filled(grid, 1);
/// let input =
///     StrainInput { field: &field, bodies: &bodies, labels: None, samples: None, trust: None };
/// let params = StrainParams { measure: StrainMeasure::Small, ..StrainParams::default() };
/// let found = run(input, &params, &|_, _| {})?;
/// assert!((found.strain.principal(grid.index(8, 8, 8))[0] - 0.03).abs() < 1e-5);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn run(input: StrainInput<'_>, params: &StrainParams, progress: Progress<'_>) -> Result<StrainResult, StrainError> {
    progress("check", 0.0);
    let mut clock = Clock::start();
    let StrainInput { field, bodies, labels, samples, trust } = input;
    let grid = *field.grid();
    check(input, params)?;
    clock.book("check");

    progress("gauge", 0.1);
    let inside = bodies.as_slice();
    let draws = samples.map(|s| Draws::new(field, inside, s)).transpose().map_err(FieldError::from)?;
    let noise_mm = if draws.is_some() { 0.0 } else { white_noise(field, inside) };
    let (gauge, mut gauges) = match (params.gauge_mm, &draws) {
        (Some(asked), _) => (Gauge::of_length(&grid, asked), Vec::new()),
        (None, Some(_)) => (Gauge::shortest(&grid), Vec::new()),
        (None, None) => choose_white(field, bodies, noise_mm),
    };
    let gradients = draws.as_ref().map(|draws| draws.gradients(gauge, usize::MAX));
    if let Some((draws, gradients)) = draws.as_ref().zip(gradients.as_ref()).filter(|_| params.gauge_mm.is_none()) {
        gauges = by_draws(bodies, draws, gradients);
    }
    clock.book("gauge");

    progress("strain", 0.5);
    let strain = StrainField::of(field, inside, gauge, params.measure);
    clock.book("strain");

    progress("deviation", 0.7);
    let deviation = match draws.as_ref().zip(gradients.as_ref()) {
        Some((draws, gradients)) => StrainDeviation::drawn(draws, gradients, params.measure),
        None => StrainDeviation::White(noise_mm * gauge.slope_noise(&grid)),
    };
    clock.book("deviation");

    progress("regions", 0.9);
    let regions = regions(&strain, labels.unwrap_or(bodies), bodies, params, draws.as_ref().zip(gradients.as_ref()));
    let [noise, size] = sizes(&strain, &deviation, bodies);
    clock.book("regions");
    progress("done", 1.0);

    // Of a field without draws only a part of the error is known.
    let known_best = if samples.is_some() { Trust::High } else { Trust::Moderate };
    let own = Trust::of(noise / size.max(f64::MIN_POSITIVE)).max(known_best);
    let field_trust = trust.map(|t| format!("trust in the field is {}", t.name()));
    let ratio = match noise / size.max(f64::MIN_POSITIVE) {
        share if share < 1.0 => format!("the deviation of a normal strain is {:.1} % of the strain", 100.0 * share),
        _ => "the deviation of a normal strain is as large as the strain".into(),
    };
    let in_part = samples.is_none().then(|| "errors that run over several voxels are not known".to_string());
    let known = match samples {
        Some(_) => "draws of the field's error",
        None => "differences between neighbouring voxels: noise that runs over several voxels is not in it",
    };
    Ok(StrainResult {
        strain,
        deviation,
        summary: StrainSummary {
            measure: params.measure,
            gauge_mm: gauge.finest_mm(&grid),
            gauge_axes_mm: gauge.length_mm(&grid),
            gauge_asked: params.gauge_mm.is_some(),
            gauges,
            noise,
            strain: size,
            drawn: samples.is_some(),
            deviation_from: known,
            regions,
            trust: trust.map_or(own, |field| field.max(own)),
            trust_reasons: field_trust.into_iter().chain([ratio]).chain(in_part).collect(),
            seconds: clock.0,
            warnings: Vec::new(),
        },
    })
}

/// Refuses what has no strain.
fn check(input: StrainInput<'_>, params: &StrainParams) -> Result<(), StrainError> {
    let StrainInput { field, bodies, labels, samples, .. } = input;
    let grid = field.grid();
    for (what, mask) in [Some(("the bodies", bodies)), labels.map(|l| ("the labels", l))].into_iter().flatten() {
        if !mask.grid().same_as(grid) {
            return Err(FieldError::GridMismatch {
                what: what.into(),
                found: mask.grid().shape(),
                reference: "the field".into(),
                expected: grid.shape(),
            }
            .into());
        }
    }
    let tissue: Vec<usize> = (0..grid.len()).filter(|&at| bodies.as_slice()[at] != 0).collect();
    if tissue.is_empty() {
        let (what, hint) = ("is empty".into(), "give one that is 1 in the tissue".into());
        return Err(FieldError::Volume { volume: "mask", what, hint }.into());
    }
    let bad = tissue.par_iter().filter(|&&at| field.at(at).iter().any(|v| !v.is_finite())).count();
    if bad > 0 {
        return Err(StrainError::NotFinite { voxels: bad });
    }
    if labels.is_some_and(|l| !tissue.iter().any(|&at| l.as_slice()[at] != 0)) {
        return Err(StrainError::NoLabel);
    }
    if samples.is_some_and(|s| !lies_over(s.nodes(), grid)) {
        return Err(StrainError::Samples);
    }
    let extent = extent(bodies);
    let voxels = (0..3).filter(|&a| grid.shape()[a] > 1).map(|a| extent[a]).min().unwrap_or(0);
    if voxels < 2 {
        return Err(StrainError::Thin { voxels });
    }
    if let Some(asked) = params.gauge_mm {
        let least = Gauge::shortest(grid).finest_mm(grid);
        if asked.is_nan() || asked < least * (1.0 - 1e-6) {
            return Err(StrainError::ShortGauge { asked, least });
        }
        let width = width(bodies);
        if asked > width {
            return Err(StrainError::WideGauge { asked, width });
        }
    }
    let folded = jacobian::count_folds(field, Some(bodies))?;
    if folded > 0 {
        return Err(StrainError::Folds { voxels: folded });
    }
    let regions = labels.unwrap_or(bodies).as_slice();
    if let Directions::Fibres(fibres) = &params.directions {
        let known = |at: &&usize| params.directions.at(**at, regions[**at], WorldPoint([0.0; 3])).is_some();
        if fibres.grid().same_as(grid) && !tissue.iter().any(|at| known(&at)) {
            return Err(StrainError::Directions {
                what: "every fibre in the tissue has length 0".into(),
                hint: "give vectors along the fibres, on the field's grid".into(),
            });
        }
    }
    Ok(())
}

/// Whether the nodes of a spline reach over a grid, a node about it to each side and no more than
/// two.
fn lies_over(nodes: &Grid, grid: &Grid) -> bool {
    let corners = (0..8).map(|c| {
        let [i, j, k] = std::array::from_fn(|a| if c >> a & 1 == 1 { grid.shape()[a] - 1 } else { 0 });
        nodes.affine().to_voxel(grid.world(i, j, k)).0
    });
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for p in corners {
        (0..3).for_each(|a| (low[a], high[a]) = (low[a].min(p[a]), high[a].max(p[a])));
    }
    (0..3).all(|a| match nodes.shape()[a] {
        1 => low[a].abs().max(high[a].abs()) < 0.5,
        n => (low[a] - 1.0).abs() < 1e-3 && (n as f64 - 4.0..n as f64 - 1.0).contains(&(high[a] + 1e-3)),
    })
}

/// Voxels of the tissue along each axis.
fn extent(tissue: &Mask) -> [usize; 3] {
    tissue.bounds().map_or([0; 3], |[low, high]| std::array::from_fn(|a| high[a] + 1 - low[a]))
}

/// Least extent of the tissue along a thick axis (mm).
fn width(tissue: &Mask) -> f64 {
    let (grid, extent) = (tissue.grid(), extent(tissue));
    let along = |a: usize| extent[a] as f64 * grid.spacing()[a];
    (0..3).filter(|&a| grid.shape()[a] > 1).map(along).fold(f64::INFINITY, f64::min)
}

/// Gauges to try: those of [`GAUGE_MULTIPLES`] that are shorter than half of the tissue.
fn tried(tissue: &Mask) -> Vec<Gauge> {
    let grid = tissue.grid();
    let (least, width) = (Gauge::shortest(grid).finest_mm(grid), width(tissue));
    let lengths = GAUGE_MULTIPLES.into_iter().map(|times| times as f64 * least);
    lengths.filter(|&l| l == least || l < width / 2.0).map(|l| Gauge::of_length(grid, l)).collect()
}

/// Draws that give the noise of a gauge that is not chosen.
const REJECTED_GAUGE_DRAWS: usize = 2;

/// What each gauge would give, by draws of the field's error; `shortest` are the gradients of the
/// first. The shortest has the least error to expect: the field is the mean of its posterior
/// distribution, so a longer gauge adds what it smooths away, though its own noise falls.
fn by_draws(tissue: &Mask, draws: &Draws, shortest: &Gradients) -> Vec<GaugeTrial> {
    let grid = tissue.grid();
    let noise = |all: &Gradients| {
        let drawn = all[1..].iter().map(|drawn| apart(drawn, &all[0])).sum::<f64>();
        drawn / (all.len() - 1).max(1) as f64
    };
    let least = noise(shortest);
    let longer = |&gauge: &Gauge| {
        let own = draws.gradients(gauge, REJECTED_GAUGE_DRAWS);
        let error = (apart(&own[0], &shortest[0]) + least).sqrt();
        GaugeTrial { gauge_mm: gauge.finest_mm(grid), noise: noise(&own).sqrt(), error }
    };
    let gauges = tried(tissue);
    let first = GaugeTrial { gauge_mm: gauges[0].finest_mm(grid), noise: least.sqrt(), error: least.sqrt() };
    [first].into_iter().chain(gauges[1..].iter().map(longer)).collect()
}

/// The same where only white noise of the displacement is known (mm).
fn choose_white(field: &DenseField, tissue: &Mask, noise_mm: f64) -> (Gauge, Vec<GaugeTrial>) {
    let (grid, bodies) = (field.grid(), tissue.as_slice());
    let gauges = tried(tissue);
    let normal = |gauge| map_gradients(field, bodies, gauge, |_, g| [g[0][0], g[1][1], g[2][2]].map(|v| v as f32));
    let shortest = normal(gauges[0]);
    let first = (noise_mm * gauges[0].slope_noise(grid)).powi(2);
    let inside = bodies.iter().filter(|l| **l != 0).count().max(1) as f64;
    let trial = |&gauge: &Gauge| {
        let own = (noise_mm * gauge.slope_noise(grid)).powi(2);
        let apart = |(a, b): (&[f32; 3], &[f32; 3])| (0..3).map(|c| f64::from(a[c] - b[c]).powi(2)).sum::<f64>();
        let lost = normal(gauge).iter().zip(&shortest).map(apart).sum::<f64>() / (3.0 * inside);
        // A slope over a longer gauge holds all that the shorter one shares with it.
        let error = (lost - (first - own) + own).max(0.0).sqrt();
        GaugeTrial { gauge_mm: gauge.finest_mm(grid), noise: own.sqrt(), error }
    };
    best(&gauges, gauges.iter().map(trial).collect())
}

/// The gauge of the least error.
fn best(gauges: &[Gauge], trials: Vec<GaugeTrial>) -> (Gauge, Vec<GaugeTrial>) {
    let least = (0..trials.len()).min_by(|&a, &b| trials[a].error.total_cmp(&trials[b].error));
    (gauges[least.unwrap_or(0)], trials)
}

/// Standard deviation of white noise in the components of a field (mm).
fn white_noise(field: &DenseField, bodies: &[u8]) -> f64 {
    let of = |c: usize| f64::from(noise_sigma(field.component(c), field.grid().shape(), |at| bodies[at] != 0)).powi(2);
    ((0..3).map(of).sum::<f64>() / 3.0).sqrt()
}

/// Median deviation and root mean square of a normal strain over the tissue.
fn sizes(strain: &StrainField, deviation: &StrainDeviation, bodies: &Mask) -> [f64; 2] {
    let grid = strain.grid();
    let inside = bodies.as_slice();
    let picked: Vec<usize> = evenly(grid.len(), |at| inside[at] != 0, SAMPLED_VOXELS).collect();
    let thick = (0..3).filter(|&a| grid.shape()[a] > 1).count().max(1) as f64;
    let normal = |e: [f64; 6]| (e[..3].iter().map(|v| v * v).sum::<f64>() / thick).sqrt();
    let mut noise: Vec<f32> = picked.iter().map(|&at| normal(deviation.at(grid.centre(at))) as f32).collect();
    let square = picked.iter().map(|&at| normal(strain.at(at)).powi(2)).sum::<f64>() / picked.len().max(1) as f64;
    let noise = if noise.is_empty() { 0.0 } else { f64::from(median(&mut noise)) };
    [noise, square.sqrt()]
}

/// Every component in every region, with what the draws say of it.
fn regions(
    strain: &StrainField,
    labels: &Mask,
    bodies: &Mask,
    params: &StrainParams,
    drawn: Option<(&Draws, &Gradients)>,
) -> Vec<RegionStrain> {
    let grid = strain.grid();
    let names: Vec<&'static str> = COMPONENTS.iter().chain(params.directions.names()).copied().collect();
    let inside = |at: usize| bodies.as_slice()[at] != 0;
    let frame = |at: usize| params.directions.at(at, labels.as_slice()[at], grid.centre(at));
    let mut by_label: Vec<(u8, Vec<usize>)> = (1..=255).map(|l| (l, Vec::new())).collect();
    for at in (0..grid.len()).filter(|&at| inside(at) && labels.as_slice()[at] != 0) {
        by_label[usize::from(labels.as_slice()[at]) - 1].1.push(at);
    }
    by_label.retain(|(_, own)| !own.is_empty());
    let one = |(label, own): (u8, Vec<usize>)| {
        let all: Vec<[f64; 14]> =
            own.par_iter().map(|&at| components(params.measure, &strain.at(at), frame(at).as_ref())).collect();
        // The same of each draw, at its places in the region.
        let places: Vec<(usize, usize)> = drawn.map_or(Vec::new(), |(draws, _)| {
            let on_grid = (0..draws.grid().len()).map(|p| (p, draws.offset(grid, p)));
            on_grid.filter(|&(_, at)| inside(at) && labels.as_slice()[at] == label).collect()
        });
        let of_draw = |gradients: &Vec<Option<[[f64; 3]; 3]>>| -> Vec<[f64; 14]> {
            let of = |&(p, at): &(usize, usize)| {
                let e = measure::tensor(params.measure, &gradients[p]?);
                Some(components(params.measure, &e, frame(at).as_ref()))
            };
            places.iter().filter_map(of).collect()
        };
        let mut each: Vec<Vec<[f64; 14]>> =
            drawn.map_or(Vec::new(), |(_, gradients)| gradients.iter().map(of_draw).collect());
        let measured = if each.is_empty() { Vec::new() } else { each.remove(0) };
        let of_component = |(c, &component): (usize, &&'static str)| {
            let values = |all: &[[f64; 14]]| all.iter().map(|v| v[c]).filter(|v| v.is_finite()).collect::<Vec<f64>>();
            let found = values(&all);
            let voxels = found.len();
            // Noise stretches and shortens: about the estimate itself, what it shifts counts too.
            let own = moments(values(&measured));
            let by_draw: Vec<[f64; 4]> = each.iter().map(|all| moments(values(all))).collect();
            let apart = |k: usize| by_draw.iter().map(|m| (m[k] - own[k]).powi(2)).sum::<f64>() / by_draw.len() as f64;
            let errors = [0, 1, 2, 3].map(|k| if by_draw.is_empty() { f64::NAN } else { apart(k).sqrt() });
            RegionStrain { label, voxels, component, values: moments(found), errors }
        };
        names.iter().enumerate().map(of_component).filter(|r| r.voxels > 0).collect::<Vec<_>>()
    };
    by_label.into_iter().flat_map(one).collect()
}
