//! A stiffness map of a finger pad reduced to a fingertip model: springs on a hard back plate.
//!
//! The parallel distributed model (Inoue & Hirai 2006) with springs that are not alike: each column
//! of tissue between the surface and the back plate (the bone) is a spring whose compliance is the
//! sum of its layers', `sum dz / E` for each unit of area. A plate pressed in by d shortens a
//! column that lies `gap` behind the foremost one by d - gap, so
//! `F(d) = sum A (d - gap)+ / sum(dz / E)`. For a uniform hemisphere this is `pi E d^2`.

use crate::error::FingertipError;
use crate::numerics::dense::dot;
use crate::types::Volume;
use crate::types::fingertip::{Column, PadModel, PadReduction, PlateCurve};

/// Fewest columns of a pad.
const MIN_COLUMNS: usize = 20;

/// The columns of a pad under its surface, along the voxel axis that faces the contact.
///
/// `modulus` is Young's modulus (kPa; 0 outside), `bone` tells it from tissue by its offset. The
/// contact comes from the end of `axis` (0, 1 or 2) that `from_end` names. Columns that pass the
/// bone end at the depth where it begins nearest to the contact: the back plate is thought to go on
/// there.
///
/// # Errors
/// [`FingertipError`] when no column meets bone, or too few have tissue.
///
/// ```
/// use palpate::fingertip::columns;
/// use palpate::{Affine, Grid, Volume};
/// // Tissue of 40 kPa, 8 mm thick, under it bone.
/// let grid = Grid::new([10, 10, 12], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let map = Volume::from_voxels(grid, |_, p| if p.0[2] < 8.0 { 40.0 } else { 15_000.0 });
/// let columns = columns(&map, |o| map.as_slice()[o] > 10_000.0, 2, false)?;
/// assert_eq!(columns.len(), 100);
/// assert!(
///     (columns[0].length - 8.0).abs() < 1e-9 && (columns[0].compliance - 8.0 / 40.0).abs() < 1e-9
/// );
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn columns(
    modulus: &Volume,
    bone: impl Fn(usize) -> bool,
    axis: usize,
    from_end: bool,
) -> Result<Vec<Column>, FingertipError> {
    let grid = modulus.grid();
    let (shape, spacing, values) = (grid.shape(), grid.spacing(), modulus.as_slice());
    let [u, v] = [(axis + 1) % 3, (axis + 2) % 3];
    let n = shape[axis];
    let at = |i: usize, j: usize, depth: usize| {
        let mut voxel = [0; 3];
        (voxel[u], voxel[v]) = (i, j);
        voxel[axis] = if from_end { n - 1 - depth } else { depth };
        grid.index(voxel[0], voxel[1], voxel[2])
    };
    let lines = || (0..shape[v]).flat_map(|j| (0..shape[u]).map(move |i| (i, j)));
    let surface = |i: usize, j: usize| (0..n).find(|&d| values[at(i, j, d)] > 0.0);
    let bone_at = |i: usize, j: usize, from: usize| (from..n).find(|&d| bone(at(i, j, d)));
    let starts: Vec<(usize, usize, usize, Option<usize>)> =
        lines().filter_map(|(i, j)| surface(i, j).map(|s| (i, j, s, bone_at(i, j, s)))).collect();
    let plate = starts.iter().filter_map(|c| c.3).min().ok_or(FingertipError::NoBone)?;
    let foremost = starts.iter().map(|c| c.2).min().unwrap_or(0);
    let thick = spacing[axis];
    let area = spacing[u] * spacing[v];
    let mut out = Vec::new();
    for (i, j, start, bone) in starts {
        let end = bone.unwrap_or(plate.max(start));
        let tissue: Vec<f64> = (start..end).map(|d| f64::from(values[at(i, j, d)])).take_while(|e| *e > 0.0).collect();
        if tissue.is_empty() {
            continue;
        }
        out.push(Column {
            place: [i as f64 * spacing[u], j as f64 * spacing[v]],
            area,
            gap: (start - foremost) as f64 * thick,
            length: tissue.len() as f64 * thick,
            compliance: tissue.iter().map(|e| thick / e).sum(),
        });
    }
    if out.len() < MIN_COLUMNS {
        return Err(FingertipError::TooFew { found: out.len(), needed: MIN_COLUMNS });
    }
    Ok(out)
}

/// Force of the columns on a plate pressed in by `depth` mm (N, with moduli in kPa).
///
/// ```
/// use palpate::fingertip::{columns, force};
/// use palpate::{Affine, Grid, Volume};
/// // Tissue of 40 kPa, 8 mm thick, under it bone.
/// let grid = Grid::new([10, 10, 12], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let map = Volume::from_voxels(grid, |_, p| if p.0[2] < 8.0 { 40.0 } else { 15_000.0 });
/// let columns = columns(&map, |o| map.as_slice()[o] > 10_000.0, 2, false)?;
/// // 100 mm^2 at a strain of 1/8: 40 kPa * 1e-4 m^2 / 8 = 0.5 N.
/// assert!((force(&columns, 1.0) - 0.5).abs() < 1e-9);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn force(columns: &[Column], depth: f64) -> f64 {
    columns.iter().map(|c| 1e-3 * c.area * (depth - c.gap).max(0.0) / c.compliance).sum()
}

/// The same with one modulus (kPa) everywhere.
fn uniform_force(columns: &[Column], modulus: f64, depth: f64) -> f64 {
    columns.iter().map(|c| 1e-3 * c.area * (depth - c.gap).max(0.0) * modulus / c.length).sum()
}

/// One modulus, layers, or the whole map: the smallest that gives the map's forces.
///
/// `deepest` is the indentation up to which they are compared (mm). Layered means that all columns
/// have the compliance of a mean column of their length, `length * p + q`: a surface layer of one
/// thickness over a uniform rest.
///
/// ```
/// use palpate::fingertip::{columns, reduce};
/// use palpate::types::fingertip::PadModel;
/// use palpate::{Affine, Grid, Volume};
/// // Tissue of 40 kPa, 8 mm thick, under it bone.
/// let grid = Grid::new([10, 10, 12], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let map = Volume::from_voxels(grid, |_, p| if p.0[2] < 8.0 { 40.0 } else { 15_000.0 });
/// let columns = columns(&map, |o| map.as_slice()[o] > 10_000.0, 2, false)?;
/// let pad = reduce(&columns, 2.0);
/// assert_eq!(pad.model, PadModel::Uniform);
/// assert!((pad.effective_kpa - 40.0).abs() < 1e-6);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn reduce(columns: &[Column], deepest: f64) -> PadReduction {
    let depths: Vec<f64> = (1..=24).map(|i| deepest * f64::from(i) / 24.0).collect();
    let map: Vec<f64> = depths.iter().map(|&d| force(columns, d)).collect();
    let residual = |model: &[f64]| distance(model, &map);
    let one: Vec<f64> = depths.iter().map(|&d| uniform_force(columns, 1.0, d)).collect();
    let effective = dot(&one, &map) / dot(&one, &one).max(f64::MIN_POSITIVE);
    let uniform: Vec<f64> = one.iter().map(|f| effective * f).collect();
    // Least squares of compliance against length, weighted by area and what the deepest press asks
    // of a column.
    let (mut a, mut b) = ([[0.0; 2]; 2], [0.0; 2]);
    for c in columns {
        let w = c.area * (deepest - c.gap).max(0.0);
        for (r, x) in [c.length, 1.0].into_iter().enumerate() {
            b[r] += w * x * c.compliance;
            for (s, y) in [c.length, 1.0].into_iter().enumerate() {
                a[r][s] += w * x * y;
            }
        }
    }
    let det = a[0][0] * a[1][1] - a[0][1] * a[1][0];
    let flat = det.abs() <= 1e-12 * a[0][0].abs() * a[1][1].abs();
    let [p, q] = match flat {
        true => [b[0] / a[0][0].max(f64::MIN_POSITIVE), 0.0],
        false => [(b[0] * a[1][1] - b[1] * a[0][1]) / det, (a[0][0] * b[1] - a[1][0] * b[0]) / det],
    };
    let mean: Vec<Column> =
        columns.iter().map(|c| Column { compliance: (p * c.length + q).max(1e-12), ..*c }).collect();
    let layered: Vec<f64> = depths.iter().map(|&d| force(&mean, d)).collect();
    let residuals = [residual(&uniform), residual(&layered), 0.0];
    let model = match residuals {
        [r, ..] if r <= MAX_FORCE_RESIDUAL => PadModel::Uniform,
        [_, r, _] if r <= MAX_FORCE_RESIDUAL => PadModel::Layered,
        _ => PadModel::Map,
    };
    let radius_mm = radius(columns, deepest);
    let tip = tip(&depths, &map, radius_mm.is_finite());
    PadReduction {
        model,
        effective_kpa: effective,
        hemisphere_kpa: tip.hemisphere_kpa,
        hemisphere_residual: tip.hemisphere_residual,
        radius_mm,
        thickness_mm: columns.iter().filter(|c| c.gap == 0.0).map(|c| c.length).fold(0.0, f64::max),
        residuals,
        curve: depths.iter().zip(&map).zip(&uniform).map(|((d, m), u)| [*d, *m, *u]).collect(),
        columns: columns.len(),
        deviation: 0.0,
        bounds: None,
        profile: tip.profile,
        profile_residual: tip.profile_residual,
        plate: None,
    }
}

/// Relative distance of the forces of a model from `truth` (1).
fn distance(model: &[f64], truth: &[f64]) -> f64 {
    let off: Vec<f64> = model.iter().zip(truth).map(|(m, f)| m - f).collect();
    (dot(&off, &off) / dot(truth, truth).max(f64::MIN_POSITIVE)).sqrt()
}

/// The hemispheres, of one modulus and of unlike springs, whose force is nearest to `force` (N) at
/// `depths` (mm).
struct Tip {
    hemisphere_kpa: f64,
    hemisphere_residual: f64,
    profile: Vec<[f64; 2]>,
    profile_residual: f64,
}

fn tip(depths: &[f64], force: &[f64], curved: bool) -> Tip {
    let square: Vec<f64> = depths.iter().map(|d| 1e-3 * std::f64::consts::PI * d * d).collect();
    let hemisphere_kpa = dot(&square, force) / dot(&square, &square).max(f64::MIN_POSITIVE);
    let profile = profile(depths, force, hemisphere_kpa, curved);
    let unlike: Vec<f64> = depths.iter().map(|&d| profile_force(&profile, d)).collect();
    Tip {
        hemisphere_kpa,
        hemisphere_residual: distance(&square.iter().map(|f| hemisphere_kpa * f).collect::<Vec<_>>(), force),
        profile_residual: distance(&unlike, force),
        profile,
    }
}

/// The reduction of `columns` with its hemispheres fitted to the finite element forces `curve` (mm,
/// N) of the same map, which was solved on `nodes` nodes.
pub(crate) fn against_plate(
    mut pad: PadReduction,
    columns: &[Column],
    curve: Vec<[f64; 2]>,
    nodes: usize,
) -> PadReduction {
    let (depths, forces): (Vec<f64>, Vec<f64>) = curve.iter().map(|c| (c[0], c[1])).unzip();
    let springs: Vec<f64> = depths.iter().map(|&d| force(columns, d)).collect();
    let factor = dot(&springs, &forces) / dot(&springs, &springs).max(f64::MIN_POSITIVE);
    let scaled: Vec<f64> = springs.iter().map(|f| factor * f).collect();
    let Tip { hemisphere_kpa, hemisphere_residual, profile, profile_residual } =
        tip(&depths, &forces, pad.radius_mm.is_finite());
    pad.plate = Some(PlateCurve { residual: distance(&scaled, &forces), factor, nodes, curve });
    PadReduction { hemisphere_kpa, hemisphere_residual, profile, profile_residual, ..pad }
}

/// Knots of a profile.
const KNOTS: usize = 7;
/// How the moduli of a profile are fitted to forces.
struct ProfileFit {
    /// Weight of second differences over that of the misfit: enough to hide the steps of voxels.
    bending_weight: f64,
    /// Least modulus over the mean.
    min_modulus_ratio: f64,
}

const PROFILE_FIT: ProfileFit = ProfileFit { bending_weight: 1e-4, min_modulus_ratio: 0.02 };

/// Force (N) at `depth` (mm) of a hemisphere with moduli (kPa) by the depth at which its springs
/// are reached: `F = int 2 pi E(s) (d - s) ds`, whatever its radius.
///
/// ```
/// use palpate::fingertip::profile_force;
/// // A constant modulus of 30 kPa presses as pi E d^2.
/// let flat = [[0.0, 30.0], [4.0, 30.0]];
/// let exact = 1e-3 * std::f64::consts::PI * 30.0 * 2.0 * 2.0;
/// assert!((profile_force(&flat, 2.0) / exact - 1.0).abs() < 1e-3);
/// ```
pub fn profile_force(profile: &[[f64; 2]], depth: f64) -> f64 {
    (0..profile.len()).map(|k| profile[k][1] * hat_force(profile, k, depth)).sum()
}

/// The part of knot `k` for a modulus of 1 kPa.
fn hat_force(profile: &[[f64; 2]], k: usize, depth: f64) -> f64 {
    const QUADRATURE_STEPS: usize = 200;
    let step = depth / QUADRATURE_STEPS as f64;
    let hat = |s: f64| {
        let at = profile[k][0];
        match (k.checked_sub(1).map(|i| profile[i][0]), profile.get(k + 1).map(|p| p[0])) {
            (Some(low), _) if s < at => ((s - low) / (at - low)).max(0.0),
            (_, Some(high)) if s > at => ((high - s) / (high - at)).max(0.0),
            _ => 1.0,
        }
    };
    let all = (0..QUADRATURE_STEPS).map(|i| (i as f64 + 0.5) * step);
    all.map(|s| 2e-3 * std::f64::consts::PI * hat(s) * (depth - s) * step).sum()
}

/// The moduli whose forces are nearest to `force` at `depths`: least squares with a small weight on
/// bends, by coordinate descent. The first two are one where the pad is `curved`: a face touches it
/// in a point, and what forces say of the springs there is the surface's step of a voxel. A flat
/// pad is touched all over, and its first springs are the stiffest.
fn profile(depths: &[f64], force: &[f64], mean: f64, curved: bool) -> Vec<[f64; 2]> {
    let deepest = depths.last().copied().unwrap_or(1.0);
    let mut out: Vec<[f64; 2]> = (0..KNOTS).map(|k| [deepest * k as f64 / (KNOTS - 1) as f64, mean]).collect();
    let rows: Vec<Vec<f64>> = depths.iter().map(|&d| (0..KNOTS).map(|k| hat_force(&out, k, d)).collect()).collect();
    let (mut a, mut b) = ([[0.0; KNOTS]; KNOTS], [0.0; KNOTS]);
    for (row, f) in rows.iter().zip(force) {
        for i in 0..KNOTS {
            b[i] += row[i] * f;
            (0..KNOTS).for_each(|j| a[i][j] += row[i] * row[j]);
        }
    }
    let weight = PROFILE_FIT.bending_weight * (0..KNOTS).map(|i| a[i][i]).sum::<f64>();
    for i in 1..KNOTS - 1 {
        let bend = [(i - 1, 1.0), (i, -2.0), (i + 1, 1.0)];
        for (r, x) in bend {
            bend.iter().for_each(|&(s, y)| a[r][s] += weight * x * y);
        }
    }
    let first = usize::from(curved);
    if curved {
        // Both share their rows and columns, kept in the second place.
        b[1] += b[0];
        for i in 0..KNOTS {
            a[i][1] += a[i][0];
        }
        for j in 0..KNOTS {
            a[1][j] += a[0][j];
        }
        (0..KNOTS).for_each(|i| (a[i][0], a[0][i]) = (0.0, 0.0));
    }
    for _ in 0..2000 {
        for i in first..KNOTS {
            let rest: f64 = (0..KNOTS).filter(|&j| j != i).map(|j| a[i][j] * out[j][1]).sum();
            out[i][1] = ((b[i] - rest) / a[i][i].max(f64::MIN_POSITIVE)).max(PROFILE_FIT.min_modulus_ratio * mean);
        }
    }
    out[0][1] = out[first][1];
    out
}

/// Relative residual of the forces up to which a smaller model is sufficient.
const MAX_FORCE_RESIDUAL: f64 = 0.02;

/// Iterations of the fit of a sphere.
const SPHERE_FIT_ITERATIONS: usize = 20;

/// Radius (mm) of the sphere whose surface is nearest to that of the columns which a press of
/// `deepest` mm touches: least squares of the gap along the press, from the paraboloid's on (Gauss
/// and Newton). A paraboloid alone would give R less half of the deepest gap.
fn radius(columns: &[Column], deepest: f64) -> f64 {
    let near: Vec<&Column> = columns.iter().filter(|c| c.gap <= deepest).collect();
    let n = near.len().max(1) as f64;
    let middle = [0, 1].map(|a| near.iter().map(|c| c.place[a]).sum::<f64>() / n);
    // gap = g + k s^2 / (1 + w) with s the distance from (x, y), w^2 = 1 - k^2 s^2 and k = 1 / R; w
    // is 1 at first.
    let (mut k, mut at, mut g) = (0.0f64, [0.0; 2], 0.0);
    for round in 0..SPHERE_FIT_ITERATIONS {
        let (mut m, mut rhs) = ([[0.0; 4]; 4], [0.0; 4]);
        for c in &near {
            let [x, y] = [0, 1].map(|a| c.place[a] - middle[a] - at[a]);
            let square = x * x + y * y;
            let w = (1.0 - k * k * square).max(0.05).sqrt();
            let off = c.gap - g - k * square / (1.0 + w);
            // At first k is 0, and the place's terms those of a linear slope.
            let row = if round == 0 {
                [0.5 * square, x, y, 1.0]
            } else {
                [square / (w * (1.0 + w)), -k * x / w, -k * y / w, 1.0]
            };
            for r in 0..4 {
                rhs[r] += row[r] * off;
                (0..4).for_each(|s| m[r][s] += row[r] * row[s]);
            }
        }
        let Some(step) = crate::numerics::dense::solve(&m, &rhs) else { break };
        if round == 0 {
            // A slope is a place beside the middle.
            k = step[0];
            if k <= 0.0 {
                return f64::INFINITY;
            }
            at = [-step[1] / k, -step[2] / k];
            g = step[3] - 0.5 * k * (at[0] * at[0] + at[1] * at[1]);
            continue;
        }
        (k, g) = ((k + step[0]).max(0.5 * k), g + step[3]);
        at = [at[0] + step[1], at[1] + step[2]];
        if step[0].abs() < 1e-9 * k {
            break;
        }
    }
    if k > 0.0 { 1.0 / k } else { f64::INFINITY }
}
