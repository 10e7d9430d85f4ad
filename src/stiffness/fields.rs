//! Results back on voxels and nodes.

use crate::numerics::statistics::noise_sigma;
use crate::stiffness::boundary_conditions::border_of;
use crate::stiffness::fem_body::{Body, sorted};
use crate::stiffness::forward::Tie;
use crate::stiffness::identify::{Setup, State};
use crate::stiffness::mesh_problem::Level;
use crate::stiffness::observations::Observation;
use crate::stiffness::summary::{Hidden, MIN_LOAD_SHARE};
use crate::stiffness::verdict::Misfit;
use crate::types::stiffness::{Contact, LeftOver, Prescribed, RegionStiffness, StiffnessParams};
use crate::types::{Displacement, Mask, Trust, Volume, WorldPoint};
use std::collections::BTreeSet;

/// Volume of the voxels that are not 0 (mm^3).
///
/// ```
/// use palpate::stiffness::fields::volume;
/// use palpate::{Affine, Grid, Mask};
/// let grid = Grid::new([10; 3], Affine::scaled([2.0, 2.0, 5.0], [0.0; 3])?)?;
/// assert_eq!(volume(&Mask::filled(grid, 1)), 20_000.0);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn volume(labels: &Mask) -> f64 {
    let voxel = crate::types::space::determinant(labels.grid().affine().linear()).abs();
    labels.as_slice().iter().filter(|&&v| v > 0).count() as f64 * voxel
}

/// The value of each voxel's region; 0 outside.
pub(crate) fn by_label(labels: &Mask, known: &[u8], value: &dyn Fn(usize) -> f64) -> Volume {
    let mut table = [0.0f32; 256];
    for (r, &label) in known.iter().enumerate() {
        table[label as usize] = value(r) as f32;
    }
    let mut out = Volume::filled(*labels.grid(), 0.0);
    out.as_mut_slice().iter_mut().zip(labels.as_slice()).for_each(|(v, &l)| *v = table[l as usize]);
    out
}

/// Length of the residual (mm): over the block of each sample, or at the voxel of each match.
pub fn residual(labels: &Mask, observations: &[Observation], residuals: &[[f64; 3]], block: usize) -> Volume {
    let grid = *labels.grid();
    let mut out = Volume::filled(grid, 0.0f32);
    let values = out.as_mut_slice();
    let side = block.max(1);
    for (o, r) in observations.iter().zip(residuals) {
        let at = grid.affine().to_voxel(WorldPoint(o.place)).0;
        let length = r.iter().map(|v| v * v).sum::<f64>().sqrt() as f32;
        let first = at.map(|v| (v - 0.5 * (side - 1) as f64).round().max(0.0) as usize);
        for c in 0..side * side * side {
            let v = [first[0] + c % side, first[1] + c / side % side, first[2] + c / (side * side)];
            if (0..3).all(|a| v[a] < grid.shape()[a]) {
                values[grid.index(v[0], v[1], v[2])] = length;
            }
        }
    }
    out
}

/// Standard deviation of what is rough in a field (mm, a component), the mean over the components.
pub fn noise(field: &Displacement<'_>, labels: &Mask) -> f64 {
    let shape = field.grid().shape();
    let inside = labels.as_slice();
    let stride = [1, shape[0], shape[0] * shape[1]];
    let keep = |o: usize| {
        let near = |s: usize| inside[o.saturating_sub(s)] > 0 && inside[(o + s).min(inside.len() - 1)] > 0;
        inside[o] > 0 && stride.iter().all(|&s| near(s))
    };
    (0..3).map(|c| f64::from(noise_sigma(field.component(c), shape, keep))).sum::<f64>() / 3.0
}

/// The model's displacement of each node (mm, RAS).
pub fn node_displacement(body: &Body, state: &State) -> Vec<[f64; 3]> {
    let Some(x) = &state.x else { return vec![[0.0; 3]; body.places.len()] };
    (0..body.places.len() as u32).map(|n| body.displacement(x, n)).collect()
}

/// What the patches prescribe: the ties, and of the nodes with which a curved patch touches its
/// plate the solution. `touching` are these for each patch.
pub fn prescribed(setup: &Setup<'_>, state: &State, touching: &[Option<&[u32]>]) -> Vec<Prescribed> {
    let mut out = Vec::new();
    for (number, patch) in (0u8..).zip(&setup.patches) {
        let Some(Some(nodes)) = touching.get(number as usize) else {
            let tied = patch.ties(setup.body, &state.plates[number as usize]);
            let one =
                |t: Tie| Prescribed { node: t.node, patch: number, direction: t.direction, displacement: t.target };
            out.extend(tied.into_iter().map(one));
            continue;
        };
        let guided: &[u32] = if patch.contact == Contact::Guided { &patch.nodes } else { &[] };
        let direction = guided.is_empty().then_some(patch.normal);
        let moved = |n| state.x.as_ref().map_or([0.0; 3], |x| setup.body.displacement(x, n));
        let one = |node| Prescribed { node, patch: number, direction, displacement: moved(node) };
        out.extend(sorted(nodes.iter().chain(guided).copied()).into_iter().map(one));
    }
    out
}

/// What earns a warning.
struct Warnings {
    /// Excess of the whole force over its part across the plate.
    leaning_force: f64,
    /// Part of the surface on the volume's border.
    cut_fraction: f64,
    /// Held over loaded area, below which they may have been mistaken for each other.
    area_ratio: f64,
    /// Area beside a patch that moves with it over the patch's: the rim is known to a voxel.
    beside_fraction: f64,
    /// Thickness (voxels) below which a measured field does not resolve a region: two lattice
    /// steps.
    region_voxels: usize,
}

const WARN: Warnings =
    Warnings { leaning_force: 0.01, cut_fraction: 0.02, area_ratio: 0.1, beside_fraction: 0.07, region_voxels: 8 };

/// Says so where the plate also pushes the body sideways, so that it matters which force is known;
/// `whole` is it over its part across the plate.
pub(crate) fn leaning(force_n: f64, whole: f64) -> Option<String> {
    (whole > 1.0 + WARN.leaning_force).then(|| {
        format!(
            "the plate pushes sideways as well: {force_n} N are taken for the whole force, of which {:.4} N act across the plate; if a load cell along \
             its axis read {force_n} N, moduli are {:.1} % higher",
            force_n / whole,
            100.0 * (whole - 1.0)
        )
    })
}

/// Says so where one region leaves more than noise, and more than a badly known surface explains.
pub fn left_over(left: LeftOver) -> Option<String> {
    (!left.may_be_surface()).then(|| {
        format!(
            "one modulus leaves {:.4} mm beyond the noise and no second region could be made out: that may be something softer or stiffer, \
             or noise that is smooth over several voxels; the modulus is off by more than stated if anything is hidden there",
            left.misfit_mm
        )
    })
}

/// What of the field was left out, and whether the model leaves over much more than its noise.
pub(crate) fn unfit(field: &Displacement<'_>, labels: &Mask, misfit: &Misfit) -> Vec<String> {
    let mut out = Vec::new();
    let body = labels.as_slice().iter().enumerate().filter(|(_, l)| **l > 0);
    let empty = body.filter(|(o, _)| field.at(*o).iter().any(|v| !v.is_finite())).count();
    if empty > 0 {
        out.push(format!(
            "{empty} voxels of the body hold no finite displacement; they were left out: check the field, or leave them out of \
             the mask"
        ));
    }
    let part = 100.0 * misfit.share();
    let left = format!(
        "the model leaves over {:.3} mm beyond the noise of the field, {part:.1} % of the deformation:",
        misfit.mm
    );
    match misfit.trust() {
        Trust::High => {}
        Trust::Moderate => out.push(format!(
            "{left} body, labels, patches, Poisson's ratio or law are not quite as assumed, or noise is smooth over several voxels; \
             the deviations count it as an error that is everywhere at once"
        )),
        Trust::Low => out.push(format!(
            "{left} body, patches or law do not fit the field, or it is too noisy; no modulus is given. Check --held and --load, the labels, \
             and where the residual map is large"
        )),
    }
    out
}

/// Says so where the field is one affine map and there are regions to distinguish.
pub(crate) fn one_map(is_affine: bool, regions: usize) -> Option<String> {
    (is_affine && regions > 1).then(|| {
        "the displacement field is one affine map: either all regions are equally stiff, or the registration was limited to affine maps \
         and shows no contrast. Measure with a free field"
            .into()
    })
}

/// Says so where the body ends with the volume, away from the held and the loaded patch.
fn cut_off(level: &Level, labels: &Mask) -> Option<String> {
    let cut = level.patches.get(2)?;
    let (body, grid) = (&level.body, labels.grid());
    let side = |&f: &usize| border_of(grid, body.surface[f].centre).map(|(a, last)| BORDER_NAMES[a][usize::from(last)]);
    let sides: BTreeSet<&str> = cut.facets.iter().filter_map(side).collect();
    let all: f64 = body.surface.iter().map(|f| f.area).sum();
    let part = cut.area(body) / all;
    (part > WARN.cut_fraction).then(|| {
        format!(
            "the body ends at the volume's border ({} along the voxels' axes, {:.0} % of its surface) and is taken to go on beyond: there \
             it moves as measured; if it does end there, leave a voxel of background around it",
            sides.into_iter().collect::<Vec<_>>().join(", "),
            100.0 * part
        )
    })
}

/// Names of the borders of a volume, by axis.
const BORDER_NAMES: [[&str; 2]; 3] = [["first x", "last x"], ["first y", "last y"], ["first z", "last z"]];

/// How the sentence on a region without a modulus begins.
pub(crate) fn not_determined(name: &str) -> String {
    format!("the data do not determine the modulus of {name}:")
}

/// What to know before trusting the moduli. `area` is that of the loaded patch (mm^2).
pub fn warnings(
    level: &Level,
    labels: &Mask,
    regions: &[RegionStiffness],
    mesh_change: &[f64],
    area: f64,
    params: &StiffnessParams,
) -> Vec<String> {
    let mut out = Vec::new();
    for (r, voxels) in regions.iter().filter(|r| r.identifiable).map(|r| (r, thickness(labels, r.label))) {
        if voxels < WARN.region_voxels {
            out.push(format!(
                "{} is {voxels} voxels thick: a displacement measured from images does not resolve its strain, and its \
                 modulus may be off by far more than stated; trust it only where the displacement is known better",
                r.name
            ));
        }
    }
    for r in regions.iter().filter(|r| !r.identifiable) {
        let value = match r.bound {
            Some("unknown") => "no value is given",
            Some("upper") => "its value is an upper bound",
            _ => "its value is a lower bound",
        };
        out.push(format!("{} {value}", not_determined(&r.name)));
    }
    for (r, change) in regions.iter().zip(mesh_change).filter(|(r, c)| r.identifiable && c.abs() > 0.15) {
        let percent = 100.0 * change.exp_m1();
        out.push(format!("the modulus of {} changes by {percent:.0} % with the mesh; try more --nodes", r.name));
    }
    if area < 100.0 * level.voxel * level.voxel {
        out.push(format!("the loaded patch is small ({area:.1} mm^2), so absolute moduli hang on its edge"));
    }
    let areas = [0, 1].map(|p| level.patches[p].area(&level.body));
    if areas[0] < WARN.area_ratio * areas[1] {
        out.push(format!(
            "the body is held at {:.1} mm^2 and loaded at {:.0} mm^2: is it the other way round? --held and --load say which side is which",
            areas[0], areas[1]
        ));
    }
    for (patch, which) in level.patches.iter().zip(["held", "loaded"]) {
        let part = patch.beside / patch.area(&level.body);
        if part > WARN.beside_fraction {
            out.push(format!(
                "the surface beside the {which} patch moves with it, over {:.0} mm^2 or {:.0} % of its area: if that is {which} \
                 as well, widen the mask; moduli come out wrong otherwise",
                patch.beside,
                100.0 * part
            ));
        }
    }
    out.extend(cut_off(level, labels));
    for (of, nu) in params
        .poisson_of
        .iter()
        .map(|(label, nu)| (format!(" of label {label}"), *nu))
        .chain([(String::new(), params.poisson)])
    {
        if nu < 0.4 {
            out.push(format!("Poisson's ratio{of}, {nu}, is low for soft tissue, which is nearly incompressible"));
        }
    }
    out
}

/// Says which regions' moduli leave no trace in the field.
pub(crate) fn not_shown(hidden: &[Hidden], regions: &[RegionStiffness], reference: usize) -> Vec<String> {
    let one = |h: &Hidden| {
        let name = regions.iter().find(|r| r.label == h.label).map_or("a region", |r| &r.name);
        let why = match h.share {
            share if share < MIN_LOAD_SHARE => "it bears next to nothing of the load".to_string(),
            _ => format!(
                "it lies beside what else bears the load and gives way with it, so only their mean is known; label it together with {}",
                regions[reference].name
            ),
        };
        format!(
            "whatever the modulus of {name}, the field is all but the same (one e times as large moves it by {:.4} mm): {why}",
            h.moved
        )
    };
    hidden.iter().map(one).collect()
}

/// Thickness of a region where it is thickest (voxels): of each of its voxels the shortest run
/// through it along an axis of the grid.
fn thickness(labels: &Mask, label: u8) -> usize {
    let (shape, inside) = (labels.grid().shape(), labels.as_slice());
    let mut shortest = vec![u16::MAX; inside.len()];
    for a in (0..3).filter(|&a| shape[a] > 1) {
        let stride: usize = shape[..a].iter().product();
        let starts = (0..inside.len())
            .filter(|&i| inside[i] == label && ((i / stride).is_multiple_of(shape[a]) || inside[i - stride] != label));
        for start in starts.collect::<Vec<_>>() {
            let room = shape[a] - start / stride % shape[a];
            let run = (0..room).take_while(|k| inside[start + k * stride] == label).count();
            for v in (0..run).map(|k| start + k * stride) {
                shortest[v] = shortest[v].min(run as u16);
            }
        }
    }
    let of_region = shortest.into_iter().zip(inside).filter(|(_, l)| **l == label);
    of_region.map(|(run, _)| usize::from(run)).max().unwrap_or(0)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::types::{Affine, Grid};

    /// What was said of region 10 was dropped where another frame determined region 1.
    #[test]
    fn a_region_is_not_taken_for_one_whose_name_is_longer() {
        assert!(!not_determined("region 10").starts_with(&not_determined("region 1")));
    }

    #[test]
    fn a_layer_is_as_thick_as_it_is() {
        let grid = Grid::new([20, 18, 16], Affine::scaled([0.5; 3], [0.0; 3]).unwrap()).unwrap();
        let layers = Mask::from_voxels(grid, |at, _| match grid.voxel(at) {
            [3..17, 3..15, 2..6] => 1,
            [3..17, 3..15, 6..14] => 2,
            _ => 0,
        });
        assert_eq!([1, 2, 3].map(|label| thickness(&layers, label)), [4, 8, 0]);
        let films = Mask::from_voxels(grid, |at, _| u8::from((4..7).contains(&grid.voxel(at)[1])));
        assert_eq!(thickness(&films, 1), 3);
    }
}
