//! A flat plate without friction against a surface, and force over depth of a body of known moduli
//! under one.
//!
//! Where the surface would go through the plate, a pressure that grows with how far it does holds
//! it back (Wriggers, Computational Contact Mechanics, 2006, ch. 6), at points within each facet,
//! so that the contact grows evenly. The plate is as soft as Newton's method needs it, and its own
//! squeeze, the mean penetration by force, is taken off the depth. The curve ends where no
//! equilibrium is found.

use crate::error::StiffnessError;
use crate::stiffness::boundary_conditions::end_facets;
use crate::stiffness::fem_body::{Body, ELEMENT_UNKNOWNS, Facet, sorted};
use crate::stiffness::forward::{Problem, Tie};
use crate::stiffness::law::Material;
use crate::types::space::dot;
use crate::types::stiffness::{Law, Side};

/// Pressure for a penetration of one element's size over the shear modulus of what is touched (of a
/// press: the softest part).
pub(crate) const PENALTY_STIFFNESS: f64 = 50.0;
/// Penetration over which a plate reaches its stiffness (parts of an element's size).
const ONSET_FRACTION: f64 = 0.02;
/// Continuation of a solution over the depth of the press.
struct Continuation {
    /// Last Newton step of a solution (mm): the error left is about a tenth of it.
    tolerance_mm: f64,
    /// Shortest step that is tried, over the way between two depths.
    min_step_fraction: f64,
}

const CONTINUATION: Continuation = Continuation { tolerance_mm: 1e-3, min_step_fraction: 0.05 };

/// Largest modulus over the softest: a part beyond it is as good as rigid.
const MAX_MODULUS_RATIO: f64 = 500.0;
/// Contact points of a facet: three in each of its quarters.
const POINTS_PER_FACET: usize = 12;

/// A facet that the plate may touch.
#[derive(Debug, Clone)]
struct Spot {
    element: usize,
    /// Its nodes among the element's.
    local: [usize; 6],
    nodes: [u32; 6],
    /// Area of a point (mm^2).
    area: f64,
}

/// A plate at a height, and what of a body's surface faces it.
#[derive(Debug, Clone)]
pub struct Plate {
    /// Unit normal, out of the body (RAS).
    pub outward: [f64; 3],
    /// Height of its plane along that (mm), at the origin.
    pub height: f64,
    /// How that rises with the place before (1).
    pub tilt: [f64; 3],
    /// Pressure over penetration (kPa/mm), from `onset` on.
    pub stiffness: f64,
    /// Penetration up to which that rises (mm).
    pub onset: f64,
    spots: Vec<Spot>,
}

/// The six shape functions at the points of a facet.
fn shapes() -> [[f64; 6]; POINTS_PER_FACET] {
    // Corners of the quarters.
    const NODES: [[f64; 3]; 6] =
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5]];
    const QUARTERS: [[usize; 3]; 4] = [[0, 3, 5], [1, 4, 3], [2, 5, 4], [3, 4, 5]];
    std::array::from_fn(|p| {
        let corners = QUARTERS[p / 3];
        let weight = |i: usize| if i == p % 3 { 2.0 / 3.0 } else { 1.0 / 6.0 };
        let l: [f64; 3] = std::array::from_fn(|a| (0..3).map(|i| weight(i) * NODES[corners[i]][a]).sum());
        let corner = |a: usize| l[a] * (2.0 * l[a] - 1.0);
        [corner(0), corner(1), corner(2), 4.0 * l[0] * l[1], 4.0 * l[1] * l[2], 4.0 * l[2] * l[0]]
    })
}

impl Plate {
    /// A plate that just touches those facets of the body that face it. `stiffness`: pressure for a
    /// penetration of one element's size (kPa).
    pub fn touching<'a>(
        body: &'a Body,
        facets: impl Iterator<Item = &'a Facet>,
        outward: [f64; 3],
        stiffness: f64,
    ) -> Self {
        let spot = |f: &Facet| {
            let cell = &body.cells[f.element as usize];
            let local = f.nodes.map(|n| cell.iter().position(|c| *c == n).unwrap_or(0));
            Spot { element: f.element as usize, local, nodes: f.nodes, area: f.area / POINTS_PER_FACET as f64 }
        };
        let spots = facets.filter(|f| dot(f.normal, outward) > 0.0).map(spot).collect();
        let size = body.element_size();
        let mut out = Self {
            outward,
            height: 0.0,
            tilt: [0.0; 3],
            stiffness: stiffness / size,
            onset: ONSET_FRACTION * size,
            spots,
        };
        out.height = out.first_touch(body);
        out
    }

    /// Height at which it touches the body as it was (mm).
    fn first_touch(&self, body: &Body) -> f64 {
        let heights = self.spots.iter().flat_map(|s| s.nodes).map(|n| dot(body.places[n as usize], self.outward));
        heights.fold(f64::NEG_INFINITY, f64::max)
    }

    /// Displacements under which the nodes of `touching` (ascending) touch it, and no others that
    /// face it: what contact is sought from.
    pub(super) fn guess(&self, body: &Body, touching: &[u32]) -> Vec<f64> {
        let mut x = vec![0.0; body.pattern.unknowns()];
        for n in sorted(self.spots.iter().flat_map(|s| s.nodes)) {
            let (p, at) = (body.places[n as usize], body.pattern.first(n));
            let beyond = if touching.binary_search(&n).is_ok() { self.onset } else { -self.onset };
            let up = self.height + dot(self.tilt, p) + beyond - dot(p, self.outward);
            (0..3).for_each(|a| x[at + a] = up * self.outward[a]);
        }
        x
    }

    /// The plate `part` of the way from its first touch.
    pub(super) fn approaching(&self, body: &Body, part: f64) -> Self {
        let height = self.first_touch(body);
        Self { height: height + part * (self.height - height), tilt: self.tilt.map(|t| part * t), ..self.clone() }
    }

    /// Calls `pushed` with each facet that touches: its element, its nodes among the element's, and
    /// of each point in touch the shape functions, the penetration (mm), the pressure times its
    /// area (kPa mm^2) and the derivative of that (kPa mm).
    fn touched(&self, body: &Body, x: &[f64], mut pushed: impl FnMut(&Spot, &[f64; 6], [f64; 3])) {
        let shapes = shapes();
        for spot in &self.spots {
            let heights = spot.nodes.map(|n| {
                let (p, u) = (body.places[n as usize], body.displacement(x, n));
                dot(p, self.outward) + dot(u, self.outward) - self.height - dot(self.tilt, p)
            });
            // A quadratic lies at most by the spread of its nodes above them.
            let (low, high) =
                heights.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), h| (a.min(*h), b.max(*h)));
            if high + (high - low) < 0.0 {
                continue;
            }
            for shape in &shapes {
                let beyond: f64 = (0..6).map(|k| shape[k] * heights[k]).sum();
                if beyond > 0.0 {
                    let (k, rise) = (self.stiffness * spot.area, beyond / self.onset);
                    let [force, slope] =
                        if rise < 1.0 { [0.5 * rise * beyond, rise] } else { [beyond - 0.5 * self.onset, 1.0] };
                    pushed(spot, shape, [beyond, k * force, k * slope]);
                }
            }
        }
    }

    /// Adds what the plate pushes with to the residual.
    pub(super) fn push(&self, body: &Body, x: &[f64], residual: &mut [f64]) {
        self.touched(body, x, |spot, shape, [_, force, _]| {
            let mut out = [0.0; ELEMENT_UNKNOWNS];
            for k in 0..6 {
                (0..3).for_each(|a| out[3 * spot.local[k] + a] += force * shape[k] * self.outward[a]);
            }
            body.scatter(residual, spot.element, &out);
        });
    }

    /// Calls `add` with an element and what the plate adds to its tangent.
    pub(super) fn stiffen(&self, body: &Body, x: &[f64], mut add: impl FnMut(usize, &[f64])) {
        self.touched(body, x, |spot, shape, [_, _, slope]| {
            let mut out = [0.0; ELEMENT_UNKNOWNS * ELEMENT_UNKNOWNS];
            for (k, a) in (0..6).flat_map(|k| (0..3).map(move |a| (k, a))) {
                for (m, b) in (0..6).flat_map(|m| (0..3).map(move |b| (m, b))) {
                    out[(3 * spot.local[k] + a) * ELEMENT_UNKNOWNS + 3 * spot.local[m] + b] +=
                        slope * shape[k] * shape[m] * self.outward[a] * self.outward[b];
                }
            }
            add(spot.element, &out);
        });
    }

    /// Forces on the body's nodes for a plate that moves along its normal by `motion` (mm) of the
    /// place.
    pub(super) fn moved(&self, body: &Body, x: &[f64], motion: impl Fn([f64; 3]) -> f64) -> Vec<f64> {
        let mut out = vec![0.0; body.pattern.unknowns()];
        self.touched(body, x, |spot, shape, [_, _, slope]| {
            let moved: f64 = (0..6).map(|k| shape[k] * motion(body.places[spot.nodes[k] as usize])).sum();
            for (n, s) in spot.nodes.iter().zip(shape) {
                let at = body.pattern.first(*n);
                (0..3).for_each(|a| out[at + a] += slope * s * moved * self.outward[a]);
            }
        });
        out
    }

    /// Nodes of the facets that touch, ascending, and the area of the contact (mm^2).
    pub fn contact(&self, body: &Body, x: &[f64]) -> (Vec<u32>, f64) {
        let (mut nodes, mut area) = (Vec::new(), 0.0);
        self.touched(body, x, |spot, _, _| {
            nodes.extend(spot.nodes);
            area += spot.area;
        });
        (sorted(nodes.into_iter()), area)
    }

    /// Force of the plate (kPa mm^2), and its squeeze: the mean penetration by force (mm).
    fn force(&self, body: &Body, x: &[f64]) -> [f64; 2] {
        let (mut sum, mut work) = (0.0, 0.0);
        self.touched(body, x, |_, _, [beyond, force, _]| {
            sum += force;
            work += force * beyond;
        });
        [sum, work / sum.max(f64::MIN_POSITIVE)]
    }
}

/// What is pressed.
#[derive(Debug, Clone)]
pub struct Press<'a> {
    /// The body.
    pub body: &'a Body,
    /// Young's modulus of each region of the body (kPa).
    pub moduli: &'a [f64],
    /// Poisson's ratio of each.
    pub poisson: &'a [f64],
    /// Nodes that do not move.
    pub held: Vec<u32>,
    /// Unit normal of the plate, out of the body (RAS).
    pub outward: [f64; 3],
}

/// Nodes of the flat end of a body on a side; `voxel` (mm) is the least of what it was meshed from.
pub fn base(body: &Body, side: Side, voxel: f64) -> Vec<u32> {
    body.nodes_on(end_facets(body, side, voxel).0)
}

impl Press<'_> {
    /// Indentation (mm) and force (N) of the plate at about each of `depths` (mm, rising) beyond
    /// its first touch, by the neo-Hookean law; fewer where the body is pressed further than an
    /// equilibrium is found.
    ///
    /// # Errors
    /// [`StiffnessError`] when not even the first depth can be solved.
    pub fn forces(&self, depths: &[f64], progress: &dyn Fn(f64)) -> Result<Vec<[f64; 2]>, StiffnessError> {
        let body = self.body;
        let softest = self.moduli.iter().copied().filter(|e| *e > 0.0).fold(f64::INFINITY, f64::min);
        let of = |r: usize| {
            Material::of_youngs_modulus(self.moduli[r].clamp(softest, MAX_MODULUS_RATIO * softest), self.poisson[r])
        };
        let still = |&node: &u32| Tie { node, direction: None, target: [0.0; 3], strength: 1.0 };
        let materials: Vec<Material> = body.region.iter().map(|&r| of(usize::from(r))).collect();
        let least = materials.iter().map(|m| m.mu).fold(f64::INFINITY, f64::min);
        let plate = Plate::touching(body, body.surface.iter(), self.outward, PENALTY_STIFFNESS * least);
        let top = plate.height;
        let held = self.held.iter().map(still).collect();
        let mut problem = Problem { plate: Some(plate), ..Problem::new(body, Law::NeoHookean, materials, held) };
        let (mut x, mut out) = (vec![0.0; body.pattern.unknowns()], Vec::new());
        let (mut reached, mut squeeze) = (0.0, 0.0);
        let mut before: Option<(Vec<f64>, f64)> = None;
        for (k, &depth) in depths.iter().enumerate() {
            progress(k as f64 / depths.len() as f64);
            let goal = depth + squeeze;
            let whole = goal - reached;
            let mut step = whole;
            while reached < goal {
                let next = if reached + 1.5 * step < goal { reached + step } else { goal };
                let lowered = problem.lowered(top - next);
                // As it went on before, so it may go on.
                let ahead = before.as_ref().and_then(|(y, from)| {
                    let part = (next - reached) / (reached - from);
                    let ahead: Vec<f64> = x.iter().zip(y).map(|(x, y)| x + part * (x - y)).collect();
                    lowered.near(&ahead, CONTINUATION.tolerance_mm).ok()
                });
                match ahead.map_or_else(|| lowered.near(&x, CONTINUATION.tolerance_mm), Ok) {
                    Ok(found) => {
                        before = Some((std::mem::replace(&mut x, found), reached));
                        reached = next;
                    }
                    Err(error) if step < CONTINUATION.min_step_fraction * whole => {
                        return if out.is_empty() { Err(error) } else { Ok(out) };
                    }
                    Err(_) => step *= 0.5,
                }
            }
            let force;
            [force, squeeze] = problem.plate.as_ref().map_or([0.0; 2], |p| p.force(body, &x));
            out.push([reached - squeeze, 1e-3 * force]);
        }
        Ok(out)
    }
}
