//! The edge of a flat punch, beside which the surface is free.

use crate::stiffness::boundary_conditions::Patch;
use crate::stiffness::fem_body::Body;
use crate::stiffness::interface::fade;
use crate::types::space::{dot, length};

/// Least free surface beside a punch (voxels).
const MIN_FREE_SURFACE_VOXELS: f64 = 3.0;

/// The edge of a flat punch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Edge {
    middle: [f64; 3],
    normal: [f64; 3],
    /// Of the punch (mm): of a round one, or between the half side and the half diagonal of a
    /// square one.
    radius: f64,
    /// Distance from the edge over which the surface beside it gives way (mm).
    beside: f64,
}

impl Edge {
    /// None where a patch is curved, or reaches to the end of its side. `voxel` is the least voxel
    /// size (mm).
    pub fn of(patch: &Patch, body: &Body, voxel: f64) -> Option<Self> {
        if patch.curved() {
            return None;
        }
        let mut edge =
            Self { middle: patch.middle, normal: patch.normal, radius: 2f64.sqrt() * patch.radius, beside: 0.0 };
        let upright = body.surface.iter().filter(|f| dot(f.normal, patch.normal).abs() < 0.5);
        let near = |p: &[f64; 3]| edge.apart(*p).1.abs() < edge.radius;
        let places = upright.flat_map(|f| f.nodes).map(|n| body.places[n as usize]).filter(near);
        let end = places.map(|p| length(edge.apart(p).0)).fold(f64::INFINITY, f64::min);
        edge.beside = (end - edge.radius).min(edge.radius);
        (edge.beside > MIN_FREE_SURFACE_VOXELS * voxel).then_some(edge)
    }

    /// Of the punch (mm).
    pub fn radius(&self) -> f64 {
        self.radius
    }

    /// Across and along the normal from the middle of the patch (mm).
    fn apart(&self, p: [f64; 3]) -> ([f64; 3], f64) {
        let d: [f64; 3] = std::array::from_fn(|a| p[a] - self.middle[a]);
        let height = dot(d, self.normal);
        (std::array::from_fn(|a| d[a] - height * self.normal[a]), height)
    }

    /// Where `p` comes to lie when the punch is wider by `offset` (mm) all around: what is below
    /// moves less and less.
    pub(crate) fn widened(&self, p: [f64; 3], offset: f64) -> [f64; 3] {
        let (across, height) = self.apart(p);
        let beyond = ((length(across) - self.radius) / self.beside).max(0.0);
        let below = (height.abs() / self.radius).min(1.0);
        let part = fade(beyond) * (1.0 - below).powi(2);
        std::array::from_fn(|a| p[a] + offset * part * across[a] / self.radius)
    }
}
