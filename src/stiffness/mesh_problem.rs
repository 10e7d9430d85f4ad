//! One mesh with everything that is read onto it.

use crate::error::StiffnessError;
use crate::numerics::neighbours::Neighbours;
use crate::numerics::tetrahedron::shapes;
use crate::stiffness::border;
use crate::stiffness::boundary_conditions::{self, Patch, Place, SurfaceMotion, deformation};
use crate::stiffness::elements::Mapping;
use crate::stiffness::fem_body::Body;
use crate::stiffness::fields;
use crate::stiffness::geometry::Part;
use crate::stiffness::identify::{Estimate, Setup, State};
use crate::stiffness::indenter_outline::Outline;
use crate::stiffness::observations::{Observation, find, from_field, from_matches, readings};
use crate::stiffness::punch_edge::Edge;
use crate::stiffness::verdict::Misfit;
use crate::types::stiffness::{Law, StiffnessParams};
use crate::types::{Displacement, Grid, Mask, QuadraticMesh, SparseField, WorldPoint};

/// Error of the finite elements on smooth fields (voxels): a few micrometres at half a millimetre.
pub(super) const MESH_ERROR_VOXELS: f64 = 0.005;
/// Fewest observations of a body.
pub(crate) const MIN_OBSERVATIONS: usize = 100;

/// One standard deviation of a plate's motion about the fitted one (mm), where that of a surface
/// node is known to `error` mm and voxels are `voxel` mm wide.
pub(crate) fn plate_prior(voxel: f64, error: f64) -> f64 {
    // The surface motion is extrapolated by half a voxel; the plate may be off by as much of the
    // motion's change.
    0.25 * voxel + 3.0 * error
}

/// A mesh with patches and observations.
#[derive(Debug)]
pub struct Level {
    /// The body.
    pub body: Body,
    /// What was measured inside.
    pub observations: Vec<Observation>,
    /// Voxels along the edge of an averaged block; 0 for matches.
    pub block: usize,
    /// Held and loaded, then the cut where the body ends with the volume, if it does.
    pub patches: Vec<Patch>,
    /// Typical standard error of the motion of a surface node (mm).
    pub surface_error: f64,
    /// The same, read from nearer voxels (mm).
    pub sharp_error: f64,
    /// Voxels around a surface node that are read for it.
    pub near: f64,
    /// Noise of a sample (mm, one component), from the field's own roughness.
    pub noise: f64,
    /// Least voxel size (mm).
    pub voxel: f64,
    /// The voxels.
    pub grid: Grid,
    /// The edge of a punch.
    edge: Option<Edge>,
    /// One standard deviation of the borders between labels (voxels); 0 where they are known.
    label_sd: f64,
    /// Parts of the shape that are open, the edge of a punch first, and how far each has been moved
    /// outwards (voxels).
    open: Vec<(Part, f64)>,
    /// Whether moving them further was found to explain the data worse.
    pub settled: bool,
    /// Labels of regions that the data do not show: they are taken to be as stiff as the reference.
    pub hidden: Vec<u8>,
    /// ln(mu / mu_reference) of the labels whose modulus is given.
    pub known: Vec<(u8, f64)>,
    /// Node places before the open parts were moved (mm, RAS).
    unmoved: Vec<[f64; 3]>,
    /// Whether the order of elimination was settled for its contact.
    ordered: bool,
}

impl Level {
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
        let patches = boundary_conditions::find(&body, &motion, held, load, outline, field.grid())?;
        let (observations, block) = match matches {
            Some(m) => (from_matches(&body, field, m), 0),
            None => from_field(&body, field, labels),
        };
        if observations.len() < MIN_OBSERVATIONS {
            return Err(StiffnessError::TooFew { found: observations.len(), needed: MIN_OBSERVATIONS });
        }
        let mut out = Self {
            unmoved: body.places.clone(),
            grid: *field.grid(),
            edge: None,
            label_sd: 0.0,
            open: Vec::new(),
            settled: false,
            hidden: Vec::new(),
            known: Vec::new(),
            ordered: false,
            body,
            observations,
            block,
            patches,
            surface_error: motion.error,
            sharp_error: motion.sharp_error,
            near: motion.near,
            noise: fields::noise(field, labels) / (block.max(1) as f64).powf(1.5),
            voxel,
        };
        out.open_parts();
        Ok(out)
    }

    /// How near to a plate's plane counts as on it (mm).
    pub fn tolerance(&self) -> f64 {
        boundary_conditions::on_plane(self.voxel, self.sharp_error)
    }

    /// Opens the borders between labels, known to one standard deviation of `sd` voxels.
    pub fn open_borders(&mut self, sd: f64) {
        self.label_sd = sd;
        self.open_parts();
    }

    /// How far each open part has been moved outwards (voxels).
    pub fn offsets(&self) -> Vec<f64> {
        self.open.iter().map(|o| o.1).collect()
    }

    /// The penalty of all offsets under their prior: squared standard deviations.
    pub fn penalty(&self) -> f64 {
        self.open.iter().map(|(part, offset)| part.penalty(*offset)).sum()
    }

    /// Moves the open parts, each by its offset in voxels outwards from where the voxels put it.
    pub(crate) fn move_to(&mut self, offsets: &[f64]) {
        if self.offsets() == offsets {
            return;
        }
        let mut places = self.unmoved.clone();
        for ((part, moved), offset) in self.open.iter_mut().zip(offsets) {
            *moved = *offset;
            part.shift(&mut places, *offset);
        }
        self.body = self.body.with_places(places);
        let found = readings(&self.body, &self.observations);
        for (o, found) in self.observations.iter_mut().zip(found) {
            // What is within rounding of the surface stays in its element.
            if let Some(readings) = found {
                o.readings = readings;
            }
        }
    }

    /// Moves the open parts back to where the voxels put them.
    pub(crate) fn move_back(&mut self) {
        self.move_to(&vec![0.0; self.open.len()]);
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
    pub(crate) fn contact_like(&mut self, other: &Level) -> Result<(), StiffnessError> {
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
    pub(crate) fn settle_shape(&mut self) -> Result<(), StiffnessError> {
        self.open_parts();
        if let Some(nodes) = self.patches[1].near_contact(&self.body).filter(|_| !self.ordered) {
            self.body.eliminate_last(&nodes)?;
            self.ordered = true;
        }
        Ok(())
    }

    /// The open parts where they lie before they are moved; a loaded patch that is curved has no
    /// edge.
    fn open_parts(&mut self) {
        self.move_back();
        self.edge = Edge::of(&self.patches[1], &self.body, self.voxel);
        let edge = self.edge.iter().map(|edge| Part::edge(edge, &self.body, self.voxel));
        let borders = if self.label_sd > 0.0 { border::all(&self.body) } else { Vec::new() };
        let borders = borders.into_iter().map(|b| Part::border(b, self.label_sd, self.voxel));
        self.open = edge.chain(borders).map(|part| (part, 0.0)).collect();
    }

    /// Takes over how the body touches the plates from another mesh, where it has moved its
    /// borders, and, as facets end elsewhere, an edge of the punch that makes the patch as large.
    ///
    /// # Errors
    /// As [`Body::new`].
    pub(crate) fn touch_like(&mut self, other: &Level) -> Result<(), StiffnessError> {
        self.contact_like(other)?;
        let [own, asked] = [&*self, other].map(|l| l.patches[1].area(&l.body));
        let of = |part: &Part| other.open.iter().find(|(p, _)| p.name == part.name).map_or(0.0, |o| o.1);
        let mut offsets: Vec<f64> = self.open.iter().map(|(part, _)| of(part)).collect();
        if let (Some(edge), Some(offset)) = (&self.edge, offsets.first_mut()) {
            *offset = edge.radius() / self.voxel * ((asked / own).sqrt() - 1.0);
        }
        self.move_to(&offsets);
        Ok(())
    }

    /// The mesh as its open parts were moved.
    pub fn moved(&self, mesh: QuadraticMesh) -> Result<QuadraticMesh, StiffnessError> {
        match self.offsets().iter().any(|offset| *offset != 0.0) {
            true => {
                let nodes = self.body.places.iter().map(|p| WorldPoint(*p)).collect();
                Ok(QuadraticMesh::new(nodes, mesh.tetrahedra().to_vec(), mesh.labels().to_vec())?)
            }
            false => Ok(mesh),
        }
    }

    /// The identification on this mesh.
    pub fn setup(&self, law: Law, params: &StiffnessParams, reference: usize) -> Setup<'_> {
        Setup {
            body: &self.body,
            law,
            poisson: self.body.labels.iter().map(|&label| params.poisson_of(label)).collect(),
            patches: self.patches.clone(),
            observations: &self.observations,
            reference,
            plate_prior: plate_prior(self.voxel, self.surface_error),
            floor: if self.block > 0 { MESH_ERROR_VOXELS * self.voxel } else { 0.05 },
            noise: (self.block > 0).then_some(self.noise),
            open: &self.open,
            settled: self.settled,
            pinned: (0..self.body.labels.len()).filter_map(|r| Some((r, self.pinned(self.body.labels[r])?))).collect(),
        }
    }

    /// ln(mu / mu_reference) of a label that is not free.
    fn pinned(&self, label: u8) -> Option<f64> {
        let known = self.known.iter().find(|k| k.0 == label).map(|k| k.1);
        known.or(self.hidden.contains(&label).then_some(0.0))
    }

    /// What the model leaves over of the field.
    pub fn misfit(&self, estimate: &Estimate) -> Misfit {
        let own = self.noise;
        let seen: Vec<_> = self.observations.iter().map(|o| (o.place, o.displacement)).collect();
        Misfit {
            mm: (estimate.rms * estimate.rms - own * own).max(0.0).sqrt(),
            noise_mm: own,
            deformation_mm: deformation(&seen),
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
