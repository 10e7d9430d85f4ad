//! Where the body is held and pressed, found on its surface from the measured motion, and what is
//! prescribed there.
//!
//! A **held** base is the flat end of the undeformed body on that side. A **loaded** patch is what
//! comes to lie on one plane: the surface that is pushed in the furthest gives the plane, by least
//! squares on its deformed places, and the patch is the surface that ends within a tolerance of it.
//! On a curved body that is where the contact is looked for first only: a plate that nothing goes
//! through, and that pulls nothing, finds it with the solution (`crate::stiffness::contact`). The
//! displacement of a patch is that of a plate, six numbers fitted to all its nodes, and these are
//! fitted again with the moduli: no node's own noise is imposed on the solution.

use crate::error::StiffnessError;
use crate::numerics::dense::{solve, symmetric_eigen};
use crate::numerics::statistics::percentile;
use crate::stiffness::contact;
use crate::stiffness::fem_body::{Body, Facet, sorted};
use crate::stiffness::forward::Tie;
use crate::stiffness::indenter_outline::Outline;
use crate::stiffness::observations::{SURFACE_REACH_VOXELS, at_surface};
use crate::stiffness::patch_motion::Smoothed;
use crate::types::space::{cross, dot};
use crate::types::stiffness::{Contact, Side};
use crate::types::{Displacement, Grid, Mask, VoxelPoint, WorldPoint};
use rayon::prelude::*;
use std::collections::HashSet;

/// The reading of a surface's motion that tells whether a node touches the plate.
struct SharpReading {
    /// Reach (voxels): short, as the edge of a punch is sharp.
    reach_voxels: f64,
    /// Noise (voxels) beyond which the longer reach is used.
    max_noise_voxels: f64,
}

const SHARP_READING: SharpReading = SharpReading { reach_voxels: 1.8, max_noise_voxels: 0.1 };

/// Least error of a displacement that is read from the field (voxels).
const MIN_READING_ERROR_VOXELS: f64 = 0.001;

/// Cosine of the angle to a side within which a facet faces it.
const MIN_FACING_COSINE: f64 = 0.3;

/// Least area of a patch (voxel faces): enough to determine its six rigid motions.
const MIN_PATCH_VOXELS: f64 = 9.0;

/// Facets that end further beyond the plane of a plate (voxels) pass beside it.
const MAX_BEYOND_PLATE_VOXELS: f64 = 1.0;

/// Where a patch is.
#[derive(Debug, Clone, PartialEq)]
pub enum Place {
    /// On a side of the body.
    Side(Side),
    /// Inside a mask on the initial grid, given by its name.
    Mask(Box<Mask>, String),
}

impl Place {
    /// As on the command line.
    pub fn name(&self) -> String {
        match self {
            Place::Side(side) => side.name(),
            Place::Mask(_, name) => name.clone(),
        }
    }
}

/// The measured displacement of the surface nodes (by node number) and its typical standard error
/// (mm).
#[derive(Debug, Clone)]
pub struct SurfaceMotion {
    /// Displacement (mm, RAS); none where the field gives nothing.
    pub displacement: Vec<Option<[f64; 3]>>,
    /// Median standard error of one component (mm).
    pub error: f64,
    /// The displacement read from nearer voxels, where there are enough: noisier and sharper.
    pub sharp: Vec<Option<[f64; 3]>>,
    /// Median standard error of one component of that (mm).
    pub sharp_error: f64,
    /// Voxels around a node that are read for it.
    pub near: f64,
}

impl SurfaceMotion {
    /// Reads the field at the surface of a body.
    pub fn new(body: &Body, field: &Displacement<'_>, mask: &Mask) -> Self {
        let nodes = body.nodes_on(0..body.surface.len());
        let all = |reach: f64| {
            let read = |&n: &u32| at_surface(field, mask, body.places[n as usize], reach);
            let values: Vec<_> = nodes.par_iter().map(read).collect();
            let mut displacement = vec![None; body.places.len()];
            let mut errors: Vec<f64> = values.iter().flatten().map(|v| v.1).collect();
            nodes.iter().zip(&values).for_each(|(&n, v)| displacement[n as usize] = v.map(|v| v.0));
            (displacement, percentile(&mut errors, 50.0))
        };
        let (displacement, error) = all(SURFACE_REACH_VOXELS);
        let (read, sharp_error) = all(SHARP_READING.reach_voxels);
        if sharp_error > SHARP_READING.max_noise_voxels * field.grid().least_spacing() {
            return Self {
                sharp: displacement.clone(),
                displacement,
                error,
                sharp_error: error,
                near: SURFACE_REACH_VOXELS,
            };
        }
        let sharp = read.into_iter().zip(&displacement).map(|(n, d)| n.or(*d)).collect();
        Self { displacement, error, sharp, sharp_error, near: SHARP_READING.reach_voxels }
    }
}

/// A patch of the surface and the motion of the plate on it.
#[derive(Debug, Clone)]
pub struct Patch {
    /// As given.
    pub name: String,
    /// Facets (numbers in [`Body::surface`]).
    pub facets: Vec<usize>,
    /// Nodes, ascending.
    pub nodes: Vec<u32>,
    /// Outward unit normal of the plate's plane.
    pub normal: [f64; 3],
    /// Middle of the patch (mm, RAS).
    pub middle: [f64; 3],
    /// Root mean square distance of its nodes from the middle (mm).
    pub radius: f64,
    /// Translation and rotation (both mm; rotations times `radius`) of the plate.
    pub rigid: [f64; 6],
    /// How it touches.
    pub contact: Contact,
    /// For each node the measured motion besides the rigid one, smoothed (mm); used by
    /// [`Contact::Guided`] along the plane and by [`Contact::Measured`].
    measured: Smoothed,
    /// For each node the motion besides the plate's (mm) of one that lies a little inside of a flat
    /// face, on its rounded rim.
    rim: Vec<[f64; 3]>,
    /// Root mean square distance of the nodes' motion from rigid along the normal and across (mm).
    pub residual: [f64; 2],
    /// What it comes to lie on; none where that was not looked for.
    landing: Option<Landing>,
    /// Whether it takes more than the plate's motion to bring it there.
    bends: bool,
    /// Area (mm^2) of the surface beside a patch given by a mask that lies on its plane and moves
    /// with it.
    pub beside: f64,
}

/// The plane onto which a patch comes.
#[derive(Debug, Clone)]
struct Landing {
    /// Where it is.
    plane: Plane,
    /// Facets that may touch it (numbers in [`Body::surface`]): what was not seen to pass beside
    /// it.
    facets: Vec<usize>,
}

impl Patch {
    /// Number of plate parameters.
    pub fn parameters(&self) -> usize {
        if self.contact == Contact::Sliding { 3 } else { 6 }
    }

    /// The plate's fitted motion (mm) at `p`.
    pub fn motion(&self, p: [f64; 3]) -> [f64; 3] {
        rigid_motion(&self.rigid, self.middle, self.radius, p)
    }

    /// The displacement (mm) at `p` for a unit of plate parameter `k`.
    pub(crate) fn basis(&self, k: usize, p: [f64; 3]) -> [f64; 3] {
        let r: [f64; 3] = std::array::from_fn(|a| (p[a] - self.middle[a]) / self.radius);
        let mut e = [0.0; 3];
        if self.contact == Contact::Sliding {
            let [u, v] = tangents(self.normal);
            return match k {
                0 => self.normal,
                1 => cross(u, r),
                _ => cross(v, r),
            };
        }
        e[k % 3] = 1.0;
        if k < 3 { e } else { cross(e, r) }
    }

    /// The ties for plate parameters `change` from the fitted motion: where the patch is curved,
    /// what holds it along the [plate](Self::plate) only.
    pub fn ties(&self, body: &Body, change: &[f64]) -> Vec<Tie> {
        let directions: &[Option<[f64; 3]>] = match (self.contact, self.curved()) {
            (Contact::Sticking | Contact::Measured, _) | (Contact::Guided, false) => &[None],
            (Contact::Sliding, false) => &[Some(self.normal)],
            (Contact::Sliding, true) => &[],
            (Contact::Guided, true) => &tangents(self.normal).map(Some),
        };
        let one = |(i, &node): (usize, &u32)| {
            let p = body.places[node as usize];
            let mut u = self.motion(p);
            for (k, c) in change.iter().enumerate() {
                let b = self.basis(k, p);
                (0..3).for_each(|a| u[a] += c * b[a]);
            }
            let measured = self.measured.values[i];
            match self.contact {
                Contact::Guided => {
                    let across = dot(measured, self.normal);
                    (0..3).for_each(|a| u[a] += measured[a] - across * self.normal[a]);
                }
                Contact::Measured => (0..3).for_each(|a| u[a] += measured[a]),
                Contact::Sticking | Contact::Sliding => {}
            }
            if !self.curved() && self.contact != Contact::Measured {
                (0..3).for_each(|a| u[a] += self.rim[i][a]);
            }
            directions.iter().map(move |&direction| Tie { node, direction, target: u, strength: 1.0 })
        };
        self.nodes.iter().enumerate().flat_map(one).collect()
    }

    /// The plate that a curved patch slides along, for plate parameters `change` from the fitted
    /// motion; none where the patch is flat or sticks. `modulus` (kPa) is the shear modulus of an
    /// element.
    pub fn plate(&self, body: &Body, change: &[f64], modulus: impl Fn(usize) -> f64) -> Option<contact::Plate> {
        let Landing { plane: (q, _), facets } = self.landed().filter(|_| self.slides())?;
        let stiffness = contact::PENALTY_STIFFNESS * self.backing(body, modulus) / self.area(body);
        let facing = facets.iter().map(|&f| &body.surface[f]);
        let mut out = contact::Plate::touching(body, facing, self.normal, stiffness);
        let height = |p: [f64; 3]| {
            let moved = change.iter().enumerate().map(|(k, c)| c * dot(self.basis(k, p), self.normal));
            dot(*q, self.normal) + moved.sum::<f64>()
        };
        out.height = height([0.0; 3]);
        out.tilt = std::array::from_fn(|a| height(std::array::from_fn(|b| f64::from(u8::from(a == b)))) - out.height);
        Some(out)
    }

    /// Sum over its facets of their area (mm^2) times a value of the element behind.
    pub(crate) fn backing(&self, body: &Body, value: impl Fn(usize) -> f64) -> f64 {
        self.facets.iter().map(|&f| value(body.surface[f].element as usize) * body.surface[f].area).sum()
    }

    /// By how much the measured motion, smoothed, misses that of a rigid plate along its normal
    /// (mm, root mean square).
    pub fn bulge(&self) -> f64 {
        let all = self.measured.values.iter().map(|v| dot(*v, self.normal).powi(2));
        (all.sum::<f64>() / self.nodes.len().max(1) as f64).sqrt()
    }

    /// Whether a plate may slide along it.
    fn slides(&self) -> bool {
        matches!(self.contact, Contact::Sliding | Contact::Guided)
    }

    /// Whether it is curved before it is pressed.
    pub fn curved(&self) -> bool {
        self.landed().is_some()
    }

    /// What it comes to lie on, where it is curved.
    fn landed(&self) -> Option<&Landing> {
        self.landing.as_ref().filter(|_| self.bends)
    }

    /// Nodes that may touch the plate, where it is curved: those that were seen to, and of the
    /// facets beside them (ascending).
    pub(crate) fn near_contact(&self, body: &Body) -> Option<Vec<u32>> {
        let Landing { facets, .. } = self.landed()?;
        let touches = |n: &u32| self.nodes.binary_search(n).is_ok();
        let beside = facets.iter().map(|&f| body.surface[f].nodes).filter(|nodes| nodes.iter().any(touches));
        Some(sorted(self.nodes.iter().copied().chain(beside.flatten())))
    }

    /// Takes over from the same patch of another mesh whether it is curved: near the limit, facets
    /// that end elsewhere say otherwise, and the two would solve different problems.
    pub(crate) fn bend_like(&mut self, other: &Self) {
        self.bends = other.curved();
    }

    /// How far inwards its foremost place goes (mm): the largest motion of its nodes against the
    /// normal.
    pub(crate) fn travelled(&self, body: &Body) -> f64 {
        let inward = |p: [f64; 3]| match self.landed() {
            Some(Landing { plane: (q, normal), .. }) => dot(sub(p, *q), *normal),
            None => -dot(self.motion(p), self.normal),
        };
        let all = self.nodes.iter().map(|&n| inward(body.places[n as usize]));
        all.fold(f64::NEG_INFINITY, f64::max)
    }

    /// Area of its facets (mm^2).
    pub fn area(&self, body: &Body) -> f64 {
        self.backing(body, |_| 1.0)
    }
}

/// Two unit vectors across `n` and each other.
fn tangents(n: [f64; 3]) -> [[f64; 3]; 2] {
    let least = (0..3).fold(0, |m, a| if n[a].abs() < n[m].abs() { a } else { m });
    let mut e = [0.0; 3];
    e[least] = 1.0;
    let u = cross(n, e);
    let length = dot(u, u).sqrt();
    let u = u.map(|v| v / length);
    [u, cross(n, u)]
}

/// Small rotations are taken as exact ones, so that large tilts of a plate do not stretch it.
fn rigid_motion(rigid: &[f64; 6], middle: [f64; 3], radius: f64, p: [f64; 3]) -> [f64; 3] {
    let w = [rigid[3] / radius, rigid[4] / radius, rigid[5] / radius];
    let angle = dot(w, w).sqrt();
    let r: [f64; 3] = std::array::from_fn(|a| p[a] - middle[a]);
    let turn = cross(w, r);
    let (s, c) = if angle < 1e-8 { (1.0, 0.5) } else { (angle.sin() / angle, (1.0 - angle.cos()) / (angle * angle)) };
    let twice = cross(w, turn);
    std::array::from_fn(|a| rigid[a] + s * turn[a] + c * twice[a])
}

/// What is wrong with a patch, and what to try.
fn refuse(which: &'static str, place: &Place, what: &str, hint: &str) -> StiffnessError {
    StiffnessError::Patch { which, name: place.name(), what: what.into(), hint: hint.into() }
}

/// How the loaded patch moves against the held one (mm).
pub fn travel(patches: &[Patch]) -> [f64; 3] {
    std::array::from_fn(|a| patches[1].rigid[a] - patches[0].rigid[a])
}

/// How far the loaded patch must go in against the held one to count as pressed (mm), where the
/// motion of a surface node is known to `error` mm and voxels are `voxel` mm wide.
pub(crate) fn least_travel(error: f64, voxel: f64) -> f64 {
    (4.0 * error).max(0.02 * voxel)
}

/// Finds the held and the loaded patch, and the cut where the body ends with the volume. `outline`
/// is that of a punch on the loaded side, where it is known.
///
/// # Errors
/// [`StiffnessError::Patch`] for a patch without surface, [`StiffnessError::NoLoad`] when they do
/// not move against each other.
pub fn find(
    body: &Body,
    motion: &SurfaceMotion,
    held: &Place,
    load: &Place,
    outline: Option<&Outline>,
    grid: &Grid,
) -> Result<Vec<Patch>, StiffnessError> {
    let voxel = grid.least_spacing();
    if held == load {
        return Err(refuse("loaded", load, "is the held one", "choose two different sides"));
    }
    let hint_held = "name the side where the tissue is fixed, as x-, x+ ... z+, or give a mask that covers it";
    let base = match held {
        Place::Side(side) => end_facets(body, *side, voxel).0,
        Place::Mask(mask, _) => masked_facets(body, mask),
    };
    let area: f64 = base.iter().map(|&f| body.surface[f].area).sum();
    if base.is_empty() || area < MIN_PATCH_VOXELS * voxel * voxel {
        return Err(refuse("held", held, "is empty: no surface of the body lies there", hint_held));
    }
    let mut held_patch = build(body, motion, held.name(), base, None, voxel)
        .ok_or_else(|| refuse("held", held, "holds no measured motion", "check that the field covers it"))?;
    let against = |n: u32| {
        let p = body.places[n as usize];
        let plate = rigid_motion(&held_patch.rigid, held_patch.middle, held_patch.radius, p);
        motion.displacement[n as usize].map(|u| -> [f64; 3] { std::array::from_fn(|a| u[a] - plate[a]) })
    };
    let hint_load = "name the side that the plate presses, or give a mask that covers the patch";
    let (facets, plane, moved) = match load {
        Place::Side(side) => {
            let (facets, plane, moved) = pressed_facets(body, motion, &against, *side, voxel)
                .ok_or_else(|| refuse("loaded", load, "is empty: no surface faces that way", hint_load))?;
            let under = outline.map(|o| facets_within(body, *side, o)).filter(|under| !under.is_empty());
            (under.unwrap_or(facets), plane, moved)
        }
        Place::Mask(mask, _) => {
            let facets = masked_facets(body, mask);
            if facets.is_empty() {
                return Err(refuse("loaded", load, "is empty: no surface of the body lies there", hint_load));
            }
            let mut moved: Vec<f64> = facets
                .iter()
                .filter_map(|&f| {
                    let facet = &body.surface[f];
                    against(facet.nodes[0]).map(|u| -dot(u, facet.normal))
                })
                .collect();
            let moved = percentile(&mut moved, 50.0);
            (facets, None, if moved.is_finite() { moved } else { 0.0 })
        }
    };
    let noise = least_travel(motion.error, voxel);
    if moved.is_nan() || moved <= noise {
        return Err(StiffnessError::NoLoad { moved, noise });
    }
    if facets.is_empty() {
        let hint = "the pressed surface does not come to lie on one plane: give a mask that covers the patch";
        return Err(refuse("loaded", load, "is empty", hint));
    }
    if facets.iter().any(|f| held_patch.facets.contains(f)) {
        return Err(refuse("loaded", load, "overlaps the held one", "choose two different sides"));
    }
    let mut load_patch = build(body, motion, load.name(), facets, plane, voxel)
        .ok_or_else(|| refuse("loaded", load, "holds no measured motion", "check that the field covers it"))?;
    for (patch, place) in [(&mut held_patch, held), (&mut load_patch, load)] {
        if matches!(place, Place::Mask(..)) {
            patch.beside = moving_with(body, motion, patch, voxel);
        }
    }
    let before = held_patch.clone();
    round_rim(body, &mut held_patch, &load_patch, voxel);
    round_rim(body, &mut load_patch, &before, voxel);
    let mut out = vec![held_patch, load_patch];
    out.extend(cut(body, motion, &out, grid));
    Ok(out)
}

/// The surface of the body on the volume's border that no patch holds: tissue goes on beyond it,
/// and it moves as measured.
fn cut(body: &Body, motion: &SurfaceMotion, patches: &[Patch], grid: &Grid) -> Option<Patch> {
    let taken: HashSet<usize> = patches.iter().flat_map(|p| p.facets.iter().copied()).collect();
    let beyond = |f: &usize| !taken.contains(f) && border_of(grid, body.surface[*f].centre).is_some();
    let facets: Vec<usize> = (0..body.surface.len()).filter(beyond).collect();
    let voxel = grid.least_spacing();
    if facets.iter().map(|&f| body.surface[f].area).sum::<f64>() < MIN_PATCH_VOXELS * voxel * voxel {
        return None;
    }
    let mut out = build(body, motion, "cut".into(), facets, None, voxel)?;
    // What another patch holds stays with it.
    let taken: HashSet<u32> = patches.iter().flat_map(|p| p.nodes.iter().copied()).collect();
    let free: Vec<bool> = out.nodes.iter().map(|n| !taken.contains(n)).collect();
    let mut keep = free.iter();
    out.nodes.retain(|_| *keep.next().unwrap_or(&true));
    out.measured.values = kept_of(&out.measured.values, &free);
    out.rim = kept_of(&out.rim, &free);
    out.contact = Contact::Measured;
    (out.nodes.len() >= 3).then_some(out)
}

fn kept_of<T: Copy>(all: &[T], keep: &[bool]) -> Vec<T> {
    all.iter().zip(keep).filter(|(_, keep)| **keep).map(|(v, _)| *v).collect()
}

/// The side of the volume that a place of the surface (mm, RAS) lies on: voxel axis, and whether it
/// is the last one along it.
pub(super) fn border_of(grid: &Grid, p: [f64; 3]) -> Option<(usize, bool)> {
    let at = grid.affine().to_voxel(WorldPoint(p)).0;
    (0..3).filter(|&a| grid.shape()[a] > 1).find_map(|a| {
        let last = (grid.shape()[a] - 1) as f64;
        (at[a] < 0.0 || at[a] > last).then_some((a, at[a] > 0.0))
    })
}

/// Area (mm^2) of the surface on the plane of a patch that is not of it and moves as it does.
fn moving_with(body: &Body, motion: &SurfaceMotion, patch: &Patch, voxel: f64) -> f64 {
    let tolerance = on_plane(voxel, motion.error);
    let with = |n: u32| {
        let p = body.places[n as usize];
        motion.displacement[n as usize].is_some_and(|u| square(sub(u, patch.motion(p))) < tolerance * tolerance)
    };
    // A part of its nodes: those on a rim lie inside of the plane.
    let part = |facet: &Facet| {
        let on = dot(facet.normal, patch.normal) > 0.7
            && dot(sub(facet.centre, patch.middle), patch.normal).abs() < 2.0 * voxel;
        if on { facet.nodes.iter().filter(|n| with(**n)).count() as f64 / facet.nodes.len() as f64 } else { 0.0 }
    };
    let own: HashSet<usize> = patch.facets.iter().copied().collect();
    let others = body.surface.iter().enumerate().filter(|(f, _)| !own.contains(f)).map(|(_, facet)| facet);
    others.map(|facet| facet.area * part(facet)).sum()
}

/// The mesh rounds the rim of a flat face by a part of a voxel, so its nodes lie inside of the
/// plate's plane. They do not move as the plate but as tissue at that depth, to first order:
/// between the two plates in proportion.
fn round_rim(body: &Body, patch: &mut Patch, other: &Patch, voxel: f64) {
    let height = |p: [f64; 3]| dot(sub(p, patch.middle), patch.normal);
    let mut all: Vec<f64> = patch.nodes.iter().map(|&n| height(body.places[n as usize])).collect();
    let face = percentile(&mut all, 75.0);
    let apart = face - height(other.middle);
    let lag = |&n: &u32| {
        let p = body.places[n as usize];
        let depth = face - height(p);
        if !(0.0..3.0 * voxel).contains(&depth) || apart < 4.0 * voxel {
            return [0.0; 3];
        }
        let own = rigid_motion(&patch.rigid, patch.middle, patch.radius, p);
        let far = rigid_motion(&other.rigid, other.middle, other.radius, p);
        std::array::from_fn(|a| depth / apart * (far[a] - own[a]))
    };
    patch.rim = patch.nodes.iter().map(lag).collect();
}

/// Part of the area facing a side at the body's end, beyond which the end is a flat face: a sixth
/// of a ball of 20 voxels lies within a voxel of its end.
const MIN_FLAT_FRACTION: f64 = 0.6;

/// Cosine of the angle to a side within which a facet belongs to the face at its end.
const MIN_FACE_COSINE: f64 = 0.7;

/// Facets within a voxel of the end of the undeformed body at a side, and whether the end is a flat
/// face. Of a flat face half of a facet's nodes suffice: a body askew in its voxels has round rims.
pub(crate) fn end_facets(body: &Body, side: Side, voxel: f64) -> (Vec<usize>, bool) {
    let d = side.direction();
    let facing: Vec<usize> =
        (0..body.surface.len()).filter(|&f| dot(body.surface[f].normal, d) > MIN_FACE_COSINE).collect();
    let height = |n: u32| dot(body.places[n as usize], d);
    let heights = facing.iter().flat_map(|&f| body.surface[f].nodes).map(height);
    let end = heights.fold(f64::NEG_INFINITY, f64::max);
    let within = |f: usize| body.surface[f].nodes.iter().filter(|&&n| height(n) > end - voxel).count();
    let of = |least: usize| facing.iter().copied().filter(|&f| within(f) >= least).collect::<Vec<_>>();
    let area = |facets: &[usize]| facets.iter().map(|&f| body.surface[f].area).sum::<f64>();
    let half = of(3);
    let is_flat = area(&half) > MIN_FLAT_FRACTION * area(&facing);
    (if is_flat { half } else { of(6) }, is_flat)
}

/// Facets whose middle, or a place just inside of it, lies in a mask.
fn masked_facets(body: &Body, mask: &Mask) -> Vec<usize> {
    let grid = mask.grid();
    let step = grid.least_spacing();
    let inside = |p: [f64; 3]| {
        let v = grid.affine().to_voxel(WorldPoint(p));
        crate::numerics::sampling::nearest(grid.shape(), VoxelPoint(v.0)).is_some_and(|o| mask.as_slice()[o] > 0)
    };
    let covered = |f: &usize| {
        let facet = &body.surface[*f];
        [0.5, -0.5, 0.0].iter().any(|s| inside(std::array::from_fn(|a| facet.centre[a] + s * step * facet.normal[a])))
    };
    (0..body.surface.len()).filter(covered).collect()
}

/// Facets on a side whose middle lies within the outline of a punch.
fn facets_within(body: &Body, side: Side, outline: &Outline) -> Vec<usize> {
    let d = side.direction();
    let under =
        |f: &usize| dot(body.surface[*f].normal, d) > MIN_FACING_COSINE && outline.holds(body.surface[*f].centre);
    (0..body.surface.len()).filter(under).collect()
}

/// What displacements at places have besides the nearest rigid motion: root mean square (mm, one
/// component).
pub fn deformation(seen: &[([f64; 3], [f64; 3])]) -> f64 {
    let n = seen.len().max(1) as f64;
    let middle: [f64; 3] = std::array::from_fn(|a| seen.iter().map(|s| s.0[a]).sum::<f64>() / n);
    let radius = (seen.iter().map(|s| square(sub(s.0, middle))).sum::<f64>() / n).sqrt();
    let rigid = fit_rigid(seen, middle, radius.max(f64::MIN_POSITIVE)).unwrap_or_default();
    let rest = |(p, u): &([f64; 3], [f64; 3])| square(sub(*u, rigid_motion(&rigid, middle, radius, *p)));
    (seen.iter().map(rest).sum::<f64>() / (3.0 * n)).sqrt()
}

/// A plane: a point (mm) and its outward unit normal.
type Plane = ([f64; 3], [f64; 3]);

/// Least trimmed squares fit of a plane (Rousseeuw and Van Driessen 1999).
struct ConcentrationSteps {
    /// Most concentration steps.
    max_steps: usize,
    /// Part of the nodes that each step keeps.
    kept_fraction: f64,
}

const CONCENTRATION: ConcentrationSteps = ConcentrationSteps { max_steps: 5, kept_fraction: 0.75 };

/// The facets that come to lie on the plane of those pushed in the furthest, that plane, and how
/// far they went in (mm).
fn pressed_facets(
    body: &Body,
    motion: &SurfaceMotion,
    against: &impl Fn(u32) -> Option<[f64; 3]>,
    side: Side,
    voxel: f64,
) -> Option<(Vec<usize>, Option<Plane>, f64)> {
    let d = side.direction();
    let facing: Vec<usize> =
        (0..body.surface.len()).filter(|&f| dot(body.surface[f].normal, d) > MIN_FACING_COSINE).collect();
    let mut nodes = body.nodes_on(facing.iter().copied());
    nodes.retain(|&n| against(n).is_some());
    if nodes.len() < 6 {
        return None;
    }
    let inward = |n: u32| against(n).map_or(f64::NEG_INFINITY, |u| -dot(u, d));
    let mut all: Vec<f64> = nodes.iter().map(|&n| inward(n)).collect();
    let most = percentile(&mut all, 98.0);
    let ended = |n: u32| -> Option<[f64; 3]> {
        let (p, u) = (body.places[n as usize], motion.sharp[n as usize]?);
        Some(std::array::from_fn(|a| p[a] + u[a]))
    };
    let mut chosen: Vec<u32> = nodes.iter().copied().filter(|&n| inward(n) > 0.8 * most).collect();
    if chosen.len() < 6 {
        return Some((Vec::new(), None, most));
    }
    let tolerance = on_plane(voxel, motion.sharp_error);
    // A rounded rim ends far below a face that is coarsely meshed, and draws the plane down with
    // it: then what lies together comes first.
    for _ in 0..CONCENTRATION.max_steps {
        let ends: Vec<[f64; 3]> = chosen.iter().filter_map(|&n| ended(n)).collect();
        let found = fit_plane(&ends, d)?;
        let height = |q: [f64; 3]| dot(sub(q, found.0), found.1);
        let near = ends.iter().filter(|q| height(**q).abs() < 2.0 * tolerance).count();
        if 2 * near > ends.len() {
            break;
        }
        let middle = percentile(&mut ends.iter().map(|q| height(*q)).collect::<Vec<f64>>(), 50.0);
        let off = |n: &u32| ended(*n).map_or(f64::INFINITY, |q| (height(q) - middle).abs());
        chosen.sort_by(|a, b| off(a).total_cmp(&off(b)));
        chosen.truncate((CONCENTRATION.kept_fraction * chosen.len() as f64) as usize);
        if chosen.len() < 6 {
            break;
        }
    }
    let mut plane = None;
    for round in 0..8 {
        let ends: Vec<[f64; 3]> = chosen.iter().filter_map(|&n| ended(n)).collect();
        let found = fit_plane(&ends, d)?;
        let limit = tolerance * if round < 3 { 2.0 } else { 1.0 };
        let distance = |n: u32| ended(n).map_or(f64::INFINITY, |q| dot(sub(q, found.0), found.1).abs());
        chosen = nodes.iter().copied().filter(|&n| distance(n) < limit && inward(n) > 0.2 * most).collect();
        plane = Some(found);
        if chosen.len() < 6 {
            return Some((Vec::new(), None, most));
        }
    }
    // The rim of a flat face is rounded in the mesh: it ends a little short of the plane, but moves
    // with the plate.
    let (middle, count) = (mean_place(body, &chosen), chosen.len() as f64);
    let spread: f64 = chosen.iter().map(|&n| square(sub(body.places[n as usize], middle))).sum::<f64>() / count;
    let radius = spread.sqrt().max(voxel);
    let seen: Vec<([f64; 3], [f64; 3])> =
        chosen.iter().filter_map(|&n| motion.displacement[n as usize].map(|u| (body.places[n as usize], u))).collect();
    let (plate, at) = (fit_rigid(&seen, middle, radius)?, plane?);
    for &n in &nodes {
        let (Some(end), Some(u)) = (ended(n), motion.sharp[n as usize]) else { continue };
        let with = sub(u, rigid_motion(&plate, middle, radius, body.places[n as usize]));
        let short = -dot(sub(end, at.0), at.1);
        if short.abs() < voxel && dot(with, at.1).abs() < tolerance {
            chosen.push(n);
        }
    }
    chosen.sort_unstable();
    chosen.dedup();
    let on = |n: &u32| chosen.binary_search(n).is_ok();
    // On a coarse mesh hardly a facet of a small contact lies on the plane as a whole; what to add
    // and to let go shows later.
    let with = |least: usize| -> Vec<usize> {
        let enough = |f: &usize| body.surface[*f].nodes.iter().filter(|n| on(n)).count() >= least;
        facing.iter().copied().filter(enough).collect()
    };
    let facets = [5, 4, 3].into_iter().map(with).find(|f| !f.is_empty()).unwrap_or_default();
    Some((facets, plane, most))
}

/// How near to the plane counts as on it (mm).
pub(super) fn on_plane(voxel: f64, error: f64) -> f64 {
    (0.15 * voxel).max(3.0 * error)
}

/// Where a node of the surface ends (mm, RAS).
fn ended(body: &Body, motion: &SurfaceMotion, n: u32) -> Option<[f64; 3]> {
    let (p, u) = (body.places[n as usize], motion.displacement[n as usize]?);
    Some(std::array::from_fn(|a| p[a] + u[a]))
}

fn square(v: [f64; 3]) -> f64 {
    dot(v, v)
}

fn mean_place(body: &Body, nodes: &[u32]) -> [f64; 3] {
    std::array::from_fn(|a| nodes.iter().map(|&n| body.places[n as usize][a]).sum::<f64>() / nodes.len() as f64)
}

fn sub(p: [f64; 3], q: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|a| p[a] - q[a])
}

/// The plane through places by least squares, its normal on the side of `d`.
fn fit_plane(places: &[[f64; 3]], d: [f64; 3]) -> Option<Plane> {
    if places.len() < 3 {
        return None;
    }
    let n = places.len() as f64;
    let mean: [f64; 3] = std::array::from_fn(|a| places.iter().map(|p| p[a]).sum::<f64>() / n);
    let mut m = [[0.0; 3]; 3];
    for p in places {
        let r = sub(*p, mean);
        for a in 0..3 {
            for b in 0..3 {
                m[a][b] += r[a] * r[b] / n;
            }
        }
    }
    let eigen = symmetric_eigen(&m);
    let normal = eigen[0].1;
    let sign = if dot(normal, d) < 0.0 { -1.0 } else { 1.0 };
    // A patch too small to tell its tilt keeps the direction asked for.
    if eigen[1].0 < 25.0 * eigen[0].0 || dot(normal, d).abs() < 0.8 {
        return Some((mean, d));
    }
    Some((mean, normal.map(|v| sign * v)))
}

/// Fits the plate's motion to the patch's nodes.
fn build(
    body: &Body,
    motion: &SurfaceMotion,
    name: String,
    facets: Vec<usize>,
    plane: Option<Plane>,
    voxel: f64,
) -> Option<Patch> {
    let nodes = body.nodes_on(facets.iter().copied());
    let middle = mean_place(body, &nodes);
    let spread: f64 = nodes.iter().map(|&n| square(sub(body.places[n as usize], middle))).sum();
    let radius = (spread / nodes.len() as f64).sqrt().max(voxel);
    let total: f64 = facets.iter().map(|&f| body.surface[f].area).sum();
    let mean: [f64; 3] = std::array::from_fn(|a| {
        facets.iter().map(|&f| body.surface[f].area * body.surface[f].normal[a]).sum::<f64>() / total
    });
    let length = dot(mean, mean).sqrt().max(1e-9);
    let normal = plane.map_or(mean.map(|v| v / length), |p| p.1);
    let seen: Vec<([f64; 3], [f64; 3])> =
        nodes.iter().filter_map(|&n| motion.displacement[n as usize].map(|u| (body.places[n as usize], u))).collect();
    if seen.len() < 3 {
        return None;
    }
    let rigid = fit_rigid(&seen, middle, radius)?;
    let rest: Vec<([f64; 3], [f64; 3])> =
        seen.iter().map(|&(p, u)| (p, sub(u, rigid_motion(&rigid, middle, radius, p)))).collect();
    let part = |along: bool| {
        let one = |(_, r): &([f64; 3], [f64; 3])| {
            let n = dot(*r, normal);
            if along { n * n } else { 0.5 * (dot(*r, *r) - n * n) }
        };
        (rest.iter().map(one).sum::<f64>() / rest.len() as f64).sqrt()
    };
    let residual = [part(true), part(false)];
    let places: Vec<[f64; 3]> = nodes.iter().map(|&n| body.places[n as usize]).collect();
    let independent = total / (motion.near * voxel).powi(2);
    let besides =
        |(p, n): (&[f64; 3], &u32)| motion.sharp[*n as usize].map(|u| sub(u, rigid_motion(&rigid, middle, radius, *p)));
    let read: Vec<Option<[f64; 3]>> = places.iter().zip(&nodes).map(besides).collect();
    let least = MIN_READING_ERROR_VOXELS * voxel;
    let measured = Smoothed::new(&places, &read, [least, motion.sharp_error.max(least)], independent);
    let landing = plane.map(|plane| Landing { plane, facets: facets_before(body, motion, plane, voxel) });
    let bends = plane
        .is_some_and(|plane| bent(body, motion, &nodes, |p| rigid_motion(&rigid, middle, radius, p), plane, voxel));
    let (contact, rim) = (Contact::Sticking, vec![[0.0; 3]; nodes.len()]);
    Some(Patch {
        name,
        facets,
        nodes,
        normal,
        middle,
        radius,
        rigid,
        contact,
        measured,
        rim,
        residual,
        landing,
        bends,
        beside: 0.0,
    })
}

/// Height (mm) over a plane at which a node ends.
fn beyond(body: &Body, motion: &SurfaceMotion, plane: Plane, n: u32) -> Option<f64> {
    let (q, normal) = plane;
    ended(body, motion, n).map(|end| dot(sub(end, q), normal))
}

/// Whether it takes more than the plate's motion to bring nodes onto a plane.
fn bent(
    body: &Body,
    motion: &SurfaceMotion,
    nodes: &[u32],
    rigid: impl Fn([f64; 3]) -> [f64; 3],
    plane: Plane,
    voxel: f64,
) -> bool {
    let (q, normal) = plane;
    let tolerance = on_plane(voxel, motion.error);
    let bend = |&n: &u32| {
        let p = body.places[n as usize];
        // The rim of a flat face is rounded in the mesh: it ends short of the plane and moves with
        // the plate as it is.
        let on = beyond(body, motion, plane, n).is_some_and(|h| h.abs() < tolerance);
        if on { dot(sub(sub(q, p), rigid(p)), normal).abs() } else { 0.0 }
    };
    let mut bends: Vec<f64> = nodes.iter().map(bend).collect();
    percentile(&mut bends, 75.0) >= (0.1 * voxel).max(2.0 * motion.error)
}

/// Facets that may touch a plane: what was not seen to pass beside it.
fn facets_before(body: &Body, motion: &SurfaceMotion, plane: Plane, voxel: f64) -> Vec<usize> {
    let may = |n: &u32| beyond(body, motion, plane, *n).is_none_or(|h| h < MAX_BEYOND_PLATE_VOXELS * voxel);
    (0..body.surface.len()).filter(|&f| body.surface[f].nodes.iter().all(may)).collect()
}

/// Translation and rotation by least squares (Gauss-Newton on the exact rotation), far outliers
/// weighted down.
fn fit_rigid(seen: &[([f64; 3], [f64; 3])], middle: [f64; 3], radius: f64) -> Option<[f64; 6]> {
    let mut rigid = [0.0; 6];
    for _ in 0..8 {
        let rest: Vec<[f64; 3]> = seen.iter().map(|(p, u)| sub(*u, rigid_motion(&rigid, middle, radius, *p))).collect();
        let mut sizes: Vec<f64> = rest.iter().map(|r| dot(*r, *r).sqrt()).collect();
        let scale = percentile(&mut sizes, 50.0).max(1e-9);
        let (mut m, mut b) = ([[0.0; 6]; 6], [0.0; 6]);
        for ((p, u), r) in seen.iter().zip(&rest) {
            let size = dot(*r, *r).sqrt();
            let w = if size > 2.5 * scale { 2.5 * scale / size } else { 1.0 };
            let moved: [f64; 3] = std::array::from_fn(|a| (p[a] + u[a] - r[a] - middle[a] - rigid[a]) / radius);
            let rows: [[f64; 3]; 6] = std::array::from_fn(|k| {
                let mut e = [0.0; 3];
                e[k % 3] = 1.0;
                if k < 3 { e } else { cross(e, moved) }
            });
            for i in 0..6 {
                b[i] += w * dot(rows[i], *r);
                for j in 0..6 {
                    m[i][j] += w * dot(rows[i], rows[j]);
                }
            }
        }
        (0..6).for_each(|i| m[i][i] *= 1.0 + 1e-9);
        let step = solve(&m, &b)?;
        (0..6).for_each(|i| rigid[i] += step[i]);
        if step.iter().all(|s| s.abs() < 1e-9) {
            break;
        }
    }
    Some(rigid)
}
