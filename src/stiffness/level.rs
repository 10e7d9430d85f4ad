//! One mesh with everything that is read onto it.

use crate::error::StiffnessError;
use crate::numerics::neighbours::Neighbours;
use crate::numerics::tetrahedron::shapes;
use crate::stiffness::body::Body;
use crate::stiffness::elements::Mapping;
use crate::stiffness::geometry::Edge;
use crate::stiffness::identify::{Setup, State};
use crate::stiffness::observations::{Observation, find, from_field, from_matches, readings};
use crate::stiffness::patches::{self, Patch, Place, SurfaceMotion};
use crate::stiffness::rim::Outline;
use crate::types::stiffness::Law;
use crate::types::{Displacement, Grid, Mask, QuadraticMesh, SparseField, WorldPoint};

/// Error of the finite elements on smooth fields (voxels): a few micrometres at half a millimetre.
const FLOOR: f64 = 0.005;
/// Observations needed for each parameter, at least.
const NEEDED: usize = 100;

/// A mesh with patches and observations.
#[derive(Debug)]
pub struct Level {
    /// The body.
    pub body: Body,
    /// What was measured inside.
    pub observations: Vec<Observation>,
    /// Voxels along the edge of an averaged block; 0 for matches.
    pub block: usize,
    /// Held and loaded.
    pub patches: [Patch; 2],
    /// Typical standard error of the motion of a surface node (mm).
    pub surface_error: f64,
    /// The same, read from nearer voxels (mm).
    pub sharp_error: f64,
    /// Voxels around a surface node that are read for it.
    pub near: f64,
    /// Least voxel size (mm).
    pub voxel: f64,
    /// The voxels.
    pub grid: Grid,
    /// The edge of a punch, and how far it has been moved outwards (voxels).
    pub edge: Option<(Edge, f64)>,
    /// Labels of regions that the data do not show: they are taken to be as stiff as the reference.
    pub hidden: Vec<u8>,
    /// Node places before the edge was moved (mm, RAS).
    unmoved: Vec<[f64; 3]>,
    /// Whether the order of elimination was settled for its contact.
    ordered: bool,
}

impl Level {
    /// Noise of a sample, a mean over its block, in a field that is rough by `noise` a voxel (mm,
    /// one component).
    pub fn sample_noise(&self, noise: f64) -> f64 {
        noise / (self.block.max(1) as f64).powf(1.5)
    }

    /// Reads field (and matches, where given) onto a mesh of `labels`.
    ///
    /// # Errors
    /// [`StiffnessError`] for a patch without surface or motion, and too few samples.
    pub fn new(
        mesh: &QuadraticMesh,
        field: &Displacement<'_>,
        matches: Option<&SparseField>,
        labels: &Mask,
        held: &Place,
        load: &Place,
        outline: Option<&Outline>,
    ) -> Result<Self, StiffnessError> {
        let body = Body::new(mesh)?;
        let voxel = field.grid().least_spacing();
        let motion = SurfaceMotion::new(&body, field, labels);
        let patches = patches::find(&body, &motion, held, load, outline, voxel)?;
        let (observations, block) = match matches {
            Some(m) => (from_matches(&body, field, m), 0),
            None => from_field(&body, field, labels),
        };
        if observations.len() < NEEDED {
            return Err(StiffnessError::TooFew { found: observations.len(), needed: NEEDED });
        }
        let mut out = Self {
            unmoved: body.places.clone(),
            grid: *field.grid(),
            edge: None,
            hidden: Vec::new(),
            ordered: false,
            body,
            observations,
            block,
            patches,
            surface_error: motion.error,
            sharp_error: motion.sharp_error,
            near: motion.near,
            voxel,
        };
        out.find_edge();
        Ok(out)
    }

    /// How near to a plate's plane counts as on it (mm).
    pub fn tolerance(&self) -> f64 {
        patches::on_plane(self.voxel, self.sharp_error)
    }

    /// Moves the edge of the punch: `outwards` voxels from where the surface's motion put it.
    pub fn move_edge(&mut self, outwards: f64) {
        let Some((edge, moved)) = &mut self.edge else { return };
        *moved = outwards;
        let place = |p: &[f64; 3]| edge.widened(*p, outwards * self.voxel);
        self.body = self.body.with_places(self.unmoved.iter().map(place).collect());
        let found = readings(&self.body, &self.observations);
        for (o, found) in self.observations.iter_mut().zip(found) {
            // What is within rounding of the surface stays in its element.
            if let Some(readings) = found {
                o.readings = readings;
            }
        }
    }

    /// Makes both meshes of a body agree on which patches are curved: the one with more nodes there
    /// knows better, as a coarse mesh rounds the rim of a flat face. Unknowns are numbered anew
    /// where a plate presses a curved one.
    ///
    /// # Errors
    /// As [`Body::new`].
    pub fn agree_on_shape(&mut self, other: &mut Level) -> Result<(), StiffnessError> {
        for (a, b) in self.patches.iter_mut().zip(&mut other.patches) {
            if a.nodes.len() > b.nodes.len() { b.bend_like(a) } else { a.bend_like(b) }
        }
        self.settle_shape()?;
        other.settle_shape()
    }

    /// Takes over from another mesh of the body how the patches touch, and whether they are curved.
    ///
    /// # Errors
    /// As [`Body::new`].
    pub fn contact_like(&mut self, other: &Level) -> Result<(), StiffnessError> {
        for (own, theirs) in self.patches.iter_mut().zip(&other.patches) {
            own.bend_like(theirs);
            own.contact = theirs.contact;
        }
        self.settle_shape()
    }

    /// What follows from a loaded patch that is flat or curved: the edge of a punch, or the order
    /// of elimination (unknowns are numbered anew).
    ///
    /// # Errors
    /// As [`Body::new`].
    pub fn settle_shape(&mut self) -> Result<(), StiffnessError> {
        self.find_edge();
        if let Some(nodes) = self.patches[1].near_contact(&self.body).filter(|_| !self.ordered) {
            self.body.eliminate_last(&nodes)?;
            self.ordered = true;
        }
        Ok(())
    }

    /// The edge of the punch where it lies before it is moved; none where the loaded patch is
    /// curved.
    fn find_edge(&mut self) {
        self.edge = Edge::of(&self.patches[1], &self.body, self.voxel).map(|edge| (edge, 0.0));
    }

    /// Takes over how the body touches the plates from another mesh, and, as facets end elsewhere,
    /// an edge of the punch that makes the patch as large.
    ///
    /// # Errors
    /// As [`Body::new`].
    pub fn touch_like(&mut self, other: &Level) -> Result<(), StiffnessError> {
        self.contact_like(other)?;
        let [own, asked] = [&*self, other].map(|l| l.patches[1].area(&l.body));
        if let Some((edge, _)) = self.edge {
            self.move_edge(edge.radius() / self.voxel * ((asked / own).sqrt() - 1.0));
        }
        Ok(())
    }

    /// The mesh as the edge was moved.
    pub fn moved(&self, mesh: QuadraticMesh) -> Result<QuadraticMesh, StiffnessError> {
        match self.edge {
            Some((_, moved)) if moved != 0.0 => {
                let nodes = self.body.places.iter().map(|p| WorldPoint(*p)).collect();
                Ok(QuadraticMesh::new(nodes, mesh.tetrahedra().to_vec(), mesh.labels().to_vec())?)
            }
            _ => Ok(mesh),
        }
    }

    /// The identification on this mesh.
    pub fn setup(&self, law: Law, poisson: f64, reference: usize) -> Setup<'_> {
        Setup {
            body: &self.body,
            law,
            poisson,
            patches: self.patches.clone(),
            observations: &self.observations,
            reference,
            // The surface motion is extrapolated by half a voxel; the plate may be off by as much
            // of the motion's change.
            plate_prior: 0.25 * self.voxel + 3.0 * self.surface_error,
            floor: if self.block > 0 { FLOOR * self.voxel } else { 0.05 },
            edge: self.edge,
            pinned: (0..self.body.labels.len())
                .filter(|&r| self.hidden.contains(&self.body.labels[r]))
                .map(|r| (r, 0.0))
                .collect(),
        }
    }

    /// The region of largest volume.
    pub fn largest(&self) -> usize {
        let v = &self.body.volumes;
        (0..v.len()).fold(0, |m, r| if v[r] > v[m] { r } else { m })
    }

    /// A state of another mesh carried to this one: moduli by label, displacement interpolated.
    pub fn carry(&self, from: &Level, state: &State) -> State {
        let theta_of = |label: &u8| {
            let at = from.body.labels.iter().position(|l| l == label);
            at.map_or(0.0, |r| state.theta[r])
        };
        let theta = self.body.labels.iter().map(theta_of).collect();
        let x = state.x.as_ref().map(|old| {
            let found = find(&from.body, &self.body.places);
            let near = Neighbours::new(&from.body.places);
            let mut holder = vec![0u32; from.body.places.len()];
            for (e, nodes) in from.body.cells.iter().enumerate() {
                nodes.iter().for_each(|&m| holder[m as usize] = e as u32);
            }
            // Beside the body an element at the nearest node is carried on.
            let beside = |p: [f64; 3]| {
                let &m = near.within(p, f64::INFINITY, 1).first()?;
                let nodes = &from.body.cells[holder[m] as usize];
                let nodes = nodes.map(|n| from.body.places[n as usize]);
                let l = Mapping::of(&nodes).locate(p)?;
                Some((holder[m], shapes(l))).filter(|_| l.iter().all(|v| *v > -1.0))
            };
            let mut x = vec![0.0; self.body.pattern.unknowns()];
            for (n, f) in found.into_iter().enumerate() {
                let Some((e, w)) = f.or_else(|| beside(self.body.places[n])) else { continue };
                let mut u = [0.0; 3];
                for (&m, w) in from.body.cells[e as usize].iter().zip(w) {
                    let v = from.body.displacement(old, m);
                    (0..3).for_each(|a| u[a] += w * v[a]);
                }
                let at = self.body.pattern.first(n as u32);
                x[at..at + 3].copy_from_slice(&u);
            }
            x
        });
        State { theta, plates: state.plates.clone(), x }
    }
}
