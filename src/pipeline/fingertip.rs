//! A stiffness map of a finger pad to a fingertip model.

use crate::error::{FingertipError, ParamError, StiffnessError};
use crate::fingertip::{against_plate, columns, force, reduce};
use crate::mesh::tetrahedral::{Fineness, mesh_labels};
use crate::pipeline::stiffness::Progress;
use crate::stiffness::contact::{Press, base};
use crate::stiffness::fem_body::Body;
use crate::stiffness::fields;
use crate::types::fingertip::{Column, PadReduction, StiffnessFolder, StiffnessRegion};
use crate::types::stiffness::Side;
use crate::types::{Mask, Volume};

/// Largest angle between the pressed side and a voxel axis (degrees).
const MAX_TILT_DEGREES: f64 = 10.0;

/// Depth to which forces are compared at least, over the tissue's thickness.
const MIN_DEPTH_FRACTION: f64 = 0.2;

/// Depths at which the finite elements are solved.
const DEPTH_COUNT: u32 = 12;

/// Nodes of the finite elements of a map, about: forces on a fingertip change by 1 % up to eight
/// times as many.
pub const NODES: usize = 2000;

/// Checks a number of nodes for the finite elements: 0 for none.
///
/// # Errors
/// [`ParamError`] where it is out of range.
pub(crate) fn check_nodes(nodes: usize) -> Result<(), ParamError> {
    match nodes {
        0 | 500..=200_000 => Ok(()),
        _ => Err(ParamError { name: "nodes", value: nodes as f64, range: "0, or 500 to 200,000" }),
    }
}

/// Most classes of modulus in the finite elements.
const MAX_MODULUS_CLASSES: usize = 48;

/// Parts that hold as a back plate.
struct HardParts {
    /// Modulus of bone over that of the stiffest tissue in the finite elements.
    bone_modulus_ratio: f64,
    /// Modulus over that of the softest region, from which a region holds.
    min_modulus_ratio: f64,
}

const HARD_PARTS: HardParts = HardParts { bone_modulus_ratio: 100.0, min_modulus_ratio: 20.0 };

/// What a pad was reduced to, and its force at the press that was measured.
#[derive(Debug, Clone, PartialEq)]
pub struct PadOutcome {
    /// The model.
    pub pad: PadReduction,
    /// Indentation that was measured (mm), and there the force (N) of the finite elements, or of
    /// the columns without them.
    pub at_press: Option<[f64; 2]>,
    /// Why there are no finite elements, where they were asked for.
    pub failure: Option<StiffnessError>,
    columns: Vec<Column>,
}

impl PadOutcome {
    /// Radius of the hemisphere (mm): the surface's, or the tissue's thickness where that is flat.
    pub fn radius_mm(&self) -> f64 {
        if self.pad.radius_mm.is_finite() { self.pad.radius_mm } else { self.pad.thickness_mm }
    }

    /// The measured force (N) over the model's at the same press (1); 1 where one of them is not
    /// known.
    pub(crate) fn calibration(&self, force_n: Option<f64>) -> f64 {
        self.at_press.zip(force_n).map_or(1.0, |([_, model], measured)| measured / model)
    }

    /// Force of the columns at the press that was measured (N).
    pub fn columns_at_press(&self) -> Option<f64> {
        self.at_press.map(|[depth, _]| force(&self.columns, depth))
    }

    /// Warnings about it: tissue of `folder` that is known by a bound alone, and elements
    /// that could not be solved.
    pub fn warnings(&self, folder: &StiffnessFolder) -> Vec<String> {
        let vague = vague(folder).into_iter().map(|name| {
            format!("only a bound of {name}'s modulus is known, and the tip is made with that: press it further")
        });
        let alone = |why: &StiffnessError| format!("no finite elements of the map, the columns stand alone: {why}");
        let flat = (self.radius_mm() > 2.0 * self.pad.thickness_mm)
            .then(|| "the pad is flat: a hemisphere is a poor picture of it".into());
        vague.chain(self.failure.iter().map(alone)).chain(flat).collect()
    }

    /// The hemispheres fitted to the forces on a flat plate that presses the finite elements of the
    /// map; as it is where these cannot be solved, with the reason.
    fn pressed(mut self, elements: &Elements<'_>, progress: Progress<'_>) -> Self {
        let deepest = self.pad.curve.last().map_or(0.0, |c| c[0]);
        let depths: Vec<f64> = (1..=DEPTH_COUNT).map(|i| deepest * f64::from(i) / f64::from(DEPTH_COUNT)).collect();
        match elements.forces(&depths, progress) {
            Ok((curve, nodes)) => {
                let pad = against_plate(self.pad.clone(), &self.columns, curve, nodes);
                let press = self.at_press.map(|[depth, _]| (depth, pad.plate.as_ref().and_then(|p| p.at(depth))));
                match press {
                    // What ends before the press cannot be compared with the force that was
                    // measured there.
                    Some((_, None)) => self.failure = Some(StiffnessError::NoEquilibrium),
                    Some((depth, Some(force))) => (self.at_press, self.pad) = (Some([depth, force]), pad),
                    None => self.pad = pad,
                }
            }
            Err(why) => self.failure = Some(why),
        }
        self
    }
}

/// The finite elements of a map and the flat plate that presses them.
struct Elements<'a> {
    map: &'a Volume,
    /// Poisson's ratio of tissue of a modulus (kPa).
    poisson: &'a dyn Fn(f64) -> f64,
    bone: &'a (dyn Fn(usize) -> bool + Sync),
    /// What is held; the bone where it is not a side.
    held: Option<Side>,
    outward: [f64; 3],
    nodes: usize,
}

impl Elements<'_> {
    /// Indentation (mm) and force (N) at about each depth (mm), and nodes of the mesh.
    fn forces(&self, depths: &[f64], progress: Progress<'_>) -> Result<(Vec<[f64; 2]>, usize), StiffnessError> {
        progress("mesh", 0.0);
        let (labels, moduli) = classes(self.map, self.bone);
        let mesh = mesh_labels(&labels, &Fineness::for_nodes(fields::volume(&labels), self.nodes))?;
        let body = Body::new(&mesh)?;
        let of_class: Vec<f64> = body.labels.iter().map(|&l| moduli[l as usize - 1]).collect();
        let side = self.held.map(|side| base(&body, side, self.map.grid().least_spacing()));
        let hard = || body.nodes_in(|r| usize::from(body.labels[r]) == moduli.len());
        let held = side.filter(|nodes| !nodes.is_empty()).unwrap_or_else(hard);
        let poisson: Vec<f64> = of_class.iter().map(|&e| (self.poisson)(e)).collect();
        let press = Press { body: &body, moduli: &of_class, poisson: &poisson, held, outward: self.outward };
        let forces = press.forces(depths, &|f| progress("press", f))?;
        Ok((forces, mesh.nodes().len()))
    }
}

/// Labels from 1 of the values of a map's tissue, and the modulus of each: a class a value, or of
/// like logarithm where these are too many. The last is the bone, a hard back plate whatever bound
/// of its modulus is known.
fn classes(map: &Volume, bone: &(dyn Fn(usize) -> bool + Sync)) -> (Mask, Vec<f64>) {
    let tissue = map.as_slice().iter().enumerate().filter(|(o, v)| **v > 0.0 && !bone(*o));
    let mut values: Vec<f32> = tissue.map(|(_, v)| *v).collect();
    values.sort_unstable_by(f32::total_cmp);
    values.dedup();
    let mut moduli: Vec<f64> = values.iter().map(|v| f64::from(*v)).collect();
    if let [low, .., high] = moduli[..]
        && moduli.len() > MAX_MODULUS_CLASSES
    {
        let step = (high / low).ln() / MAX_MODULUS_CLASSES as f64;
        moduli = (0..MAX_MODULUS_CLASSES).map(|k| low * ((k as f64 + 0.5) * step).exp()).collect();
    }
    let (values, hard) = (map.as_slice(), moduli.len() as u8 + 1);
    let apart = |k: usize, v: f32| (moduli[k] / f64::from(v)).ln().abs();
    let class = |v: f32| {
        let after = moduli.partition_point(|m| *m < f64::from(v));
        let around = [after.saturating_sub(1), after.min(moduli.len() - 1)];
        1 + if apart(around[0], v) < apart(around[1], v) { around[0] } else { around[1] } as u8
    };
    let label = |o: usize, _| match values[o] > 0.0 {
        false => 0,
        true if bone(o) => hard,
        true => class(values[o]),
    };
    let labels = Mask::from_voxels(*map.grid(), label);
    let stiffest = moduli.last().copied().unwrap_or(1.0);
    moduli.push(HARD_PARTS.bone_modulus_ratio * stiffest);
    (labels, moduli)
}

/// Reduces a map (kPa; 0 outside) that was pressed against `outward` (unit vector of the pressed
/// side, RAS), by `indentation` mm where that is known.
///
/// # Errors
/// [`FingertipError`] when the grid is askew, no bone lies under the pad, or there is hardly any
/// tissue.
///
/// ```
/// use palpate::pipeline::fingertip::run;
/// use palpate::{Affine, Grid, Volume};
/// // Tissue of 40 kPa, 8 mm thick, under it bone.
/// let grid = Grid::new([10, 10, 12], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let map = Volume::from_voxels(grid, |_, p| if p.0[2] < 8.0 { 40.0 } else { 15_000.0 });
/// let found = run(&map, |o| map.as_slice()[o] > 10_000.0, [0.0, 0.0, -1.0], Some(1.0))?;
/// assert!((found.pad.effective_kpa - 40.0).abs() < 1e-6);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn run(
    map: &Volume,
    bone: impl Fn(usize) -> bool,
    outward: [f64; 3],
    indentation: Option<f64>,
) -> Result<PadOutcome, FingertipError> {
    let (linear, spacing) = (map.grid().affine().linear(), map.grid().spacing());
    let along = |a: usize| (0..3).map(|r| linear[r][a] * outward[r]).sum::<f64>() / spacing[a];
    let axis = (1..3).fold(0, |best, a| if along(a).abs() > along(best).abs() { a } else { best });
    let degrees = along(axis).abs().min(1.0).acos().to_degrees();
    if degrees > MAX_TILT_DEGREES {
        return Err(FingertipError::Askew { degrees });
    }
    let columns = columns(map, bone, axis, along(axis) > 0.0)?;
    let thickness = columns.iter().filter(|c| c.gap == 0.0).map(|c| c.length).fold(0.0, f64::max);
    let known = indentation.filter(|d| *d > 0.0 && *d < thickness);
    let pad = reduce(&columns, known.unwrap_or(0.0).max(MIN_DEPTH_FRACTION * thickness));
    Ok(PadOutcome { at_press: known.map(|d| [d, force(&columns, d)]), pad, failure: None, columns })
}

/// Names of hard parts.
const BONE_NAMES: [&str; 4] = ["bone", "plate", "phalanx", "nail"];

/// The unit vector out of the pressed side.
fn outward(folder: &StiffnessFolder) -> [f64; 3] {
    let mut out = [0.0; 3];
    if let Some((axis, sign)) = folder.load.split_at_checked(1)
        && let (Some(axis), "+" | "-") = (["x", "y", "z"].iter().position(|a| *a == axis), sign)
    {
        out[axis] = if sign == "+" { 1.0 } else { -1.0 };
        return out;
    }
    // A patch given as a mask: against the way it went.
    let [moved, held] = folder.translation;
    let d: [f64; 3] = std::array::from_fn(|a| held[a] - moved[a]);
    let length = d.iter().map(|v| v * v).sum::<f64>().sqrt().max(1e-12);
    d.map(|v| v / length)
}

/// Regions that stand for bone or a back plate: by name; where none is so named, those known by a
/// lower bound; and those far stiffer than the softest.
fn hard(folder: &StiffnessFolder) -> Vec<&StiffnessRegion> {
    let named = |r: &StiffnessRegion| BONE_NAMES.iter().any(|b| r.name.to_lowercase().contains(b));
    let some_named = folder.regions.iter().any(named);
    // Thin skin is often known by a bound alone, and is no bone for that.
    let known = |r: &StiffnessRegion| named(r) || (!some_named && r.bound.as_deref() == Some("lower"));
    // A bound says nothing of how soft the softest is.
    let tissue = folder.regions.iter().filter(|r| !known(r) && r.bound.is_none());
    let softest = tissue.map(|r| r.youngs_modulus).fold(f64::INFINITY, f64::min);
    folder.regions.iter().filter(|r| known(r) || r.youngs_modulus >= HARD_PARTS.min_modulus_ratio * softest).collect()
}

/// Names of the tissue of which only a bound is known: the map has that in place of its modulus.
fn vague(folder: &StiffnessFolder) -> Vec<&str> {
    let bones: Vec<&str> = hard(folder).iter().map(|r| r.name.as_str()).collect();
    let tissue = folder.regions.iter().filter(|r| r.bound.is_some() && !bones.contains(&r.name.as_str()));
    tissue.map(|r| r.name.as_str()).collect()
}

/// Relative deviation of the force at a press of known travel: the elements' forces are the
/// phantom's to 3 % (docs/reference/fingertip.md).
const TRAVEL_FORCE_ERROR: f64 = 0.03;

/// Modulus over its only bound, at the far end: so stiff or soft that its springs no longer count.
const UNBOUNDED_MODULUS_RATIO: f64 = 1e3;

/// The deviation of the tip's modulus and its bounds, both over it: each tissue's modulus is moved
/// by its deviation, or to the far end of its bound, and the columns reduced again by `reduced`.
/// Where the force of the press was measured, all are scaled to it.
fn deviation(
    folder: &StiffnessFolder,
    out: &PadOutcome,
    reduced: &dyn Fn(&Volume) -> Option<PadOutcome>,
) -> (f64, Option<[f64; 2]>) {
    let bones: Vec<&str> = hard(folder).iter().map(|r| r.name.as_str()).collect();
    let tip = |out: &PadOutcome| out.pad.hemisphere_kpa * out.calibration(folder.force_n);
    let own = tip(out);
    let with = |region: &StiffnessRegion, factor: f64| {
        let near = |v: f32| (f64::from(v) / region.youngs_modulus - 1.0).abs() < 1e-4;
        let values = folder.map.as_slice().iter().map(|v| if near(*v) { v * factor as f32 } else { *v }).collect();
        let moved = Volume::from_vec(*folder.map.grid(), values).ok()?;
        reduced(&moved).map(|o| tip(&o) / own)
    };
    let known = out.at_press.is_some() && folder.force_n.is_some();
    let mut square = if known { TRAVEL_FORCE_ERROR * TRAVEL_FORCE_ERROR } else { 0.0 };
    let mut bounds: Option<[f64; 2]> = None;
    for region in folder.regions.iter().filter(|r| !bones.contains(&r.name.as_str()) && r.youngs_modulus > 0.0) {
        if let Some(bound) = region.bound.as_deref() {
            let far = if bound == "lower" { UNBOUNDED_MODULUS_RATIO } else { 1.0 / UNBOUNDED_MODULUS_RATIO };
            if let Some(part) = with(region, far) {
                let [low, high] = bounds.unwrap_or([1.0; 2]);
                bounds = Some([low * part.min(1.0), high * part.max(1.0)]);
            }
        } else if region.sd > 0.0 {
            let factor = (region.sd / region.youngs_modulus).min(1.0).exp();
            if let (Some(up), Some(down)) = (with(region, factor), with(region, 1.0 / factor)) {
                square += (0.5 * (up - down)).powi(2);
            }
        }
    }
    (square.sqrt(), bounds)
}

/// Reduces what `palpate stiffness` found to a fingertip, bone and pressed side as it names them.
/// Its hemispheres press as the map's finite elements do, on about `nodes` nodes; as the columns do
/// where that is 0.
///
/// # Errors
/// [`FingertipError`] when `nodes` is out of range or the moduli are ratios, and as [`run`].
pub fn of_map(folder: &StiffnessFolder, nodes: usize, progress: Progress<'_>) -> Result<PadOutcome, FingertipError> {
    check_nodes(nodes)?;
    if !folder.absolute {
        return Err(FingertipError::NotAbsolute);
    }
    let (bones, values) = (hard(folder), folder.map.as_slice());
    // Files keep 16 bits of a number.
    let bone = |o: usize| bones.iter().any(|b| (f64::from(values[o]) / b.youngs_modulus - 1.0).abs() < 1e-4);
    let side = outward(folder);
    let [moved, held] = folder.translation;
    let along = |u: [f64; 3]| (0..3).map(|a| u[a] * side[a]).sum::<f64>();
    // Of a curved pad that is pressed flat the middle goes less far than the plate.
    let indentation = folder.travel_mm.unwrap_or(-along(moved)) + along(held);
    let mut out = run(&folder.map, bone, side, Some(indentation))?;
    (out.pad.deviation, out.pad.bounds) = deviation(folder, &out, &|map| run(map, bone, side, Some(indentation)).ok());
    if nodes == 0 {
        return Ok(out);
    }
    let poisson = |modulus: f64| {
        let apart = |r: &&StiffnessRegion| (r.youngs_modulus / modulus).ln().abs();
        let known = folder.regions.iter().filter(|r| r.youngs_modulus > 0.0);
        let nearest = known.min_by(|a, b| apart(a).total_cmp(&apart(b)));
        nearest.and_then(|r| r.poisson).unwrap_or(folder.poisson)
    };
    let held = Side::parse(&folder.held);
    let elements = Elements { map: &folder.map, poisson: &poisson, bone: &bone, held, outward: side, nodes };
    Ok(out.pressed(&elements, progress))
}
