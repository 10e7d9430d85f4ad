//! One mesh with everything that is read onto it.

use crate::error::StiffnessError;
use crate::numerics::neighbours::Neighbours;
use crate::stiffness::body::Body;
use crate::stiffness::identify::{Setup, State};
use crate::stiffness::observations::{Observation, find, from_field, from_matches};
use crate::stiffness::patches::{self, Patch, Place, SurfaceMotion};
use crate::types::stiffness::Law;
use crate::types::{DenseField, Mask, QuadraticMesh, SparseField};

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
    /// Least voxel size (mm).
    pub voxel: f64,
}

impl Level {
    /// Reads field (and matches, where given) onto a mesh of `labels`.
    ///
    /// # Errors
    /// [`StiffnessError`] for a patch without surface or motion, and too few samples.
    pub fn new(
        mesh: &QuadraticMesh,
        field: &DenseField,
        matches: Option<&SparseField>,
        labels: &Mask,
        held: &Place,
        load: &Place,
    ) -> Result<Self, StiffnessError> {
        let body = Body::new(mesh)?;
        let voxel = field.grid().spacing().iter().fold(f64::INFINITY, |m: f64, &v| m.min(v));
        let motion = SurfaceMotion::new(&body, field, labels);
        let patches = patches::find(&body, &motion, held, load, voxel)?;
        let (observations, block) = match matches {
            Some(m) => (from_matches(&body, m), 0),
            None => from_field(&body, field, labels),
        };
        if observations.len() < NEEDED {
            return Err(StiffnessError::TooFew { found: observations.len(), needed: NEEDED });
        }
        Ok(Self {
            body,
            observations,
            block,
            patches,
            surface_error: motion.error,
            sharp_error: motion.sharp_error,
            voxel,
        })
    }

    /// How near to a plate's plane counts as on it (mm).
    pub fn tolerance(&self) -> f64 {
        patches::on_plane(self.voxel, self.sharp_error)
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
            // The surface motion is extrapolated by half a voxel; the plate may be off by as much of the motion's change.
            plate_prior: 0.25 * self.voxel + 3.0 * self.surface_error,
            floor: if self.block > 0 { FLOOR * self.voxel } else { 0.05 },
            pinned: None,
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
            let mut x = vec![0.0; self.body.pattern.unknowns()];
            for (n, f) in found.into_iter().enumerate() {
                let u = match f {
                    Some((e, w)) => {
                        let nodes = &from.body.cells[e as usize];
                        let mut u = [0.0; 3];
                        for (&m, w) in nodes.iter().zip(w) {
                            let v = from.body.displacement(old, m);
                            (0..3).for_each(|a| u[a] += w * v[a]);
                        }
                        u
                    }
                    None => near
                        .within(self.body.places[n], f64::INFINITY, 1)
                        .first()
                        .map_or([0.0; 3], |&m| from.body.displacement(old, m as u32)),
                };
                let at = self.body.pattern.first(n as u32);
                x[at..at + 3].copy_from_slice(&u);
            }
            x
        });
        State { theta, plates: state.plates.clone(), x }
    }
}
