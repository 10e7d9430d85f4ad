//! The plane that points lie in, with orthonormal axes.

use crate::error::MeshError;
use crate::types::WorldPoint;
use crate::types::space::{cross, dot};

/// Width over extent up to which points are collinear: two hundred times the rounding of an oblique
/// line's coordinates.
const COLLINEARITY_TOLERANCE: f64 = 1e-13;

/// A plane anywhere in space.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plane {
    origin: WorldPoint,
    axes: [[f64; 3]; 2],
    normal: [f64; 3],
}

impl Plane {
    /// The plane through three far points of a coplanar set (mm, RAS). Its axes are those of the
    /// world where the plane is parallel to two of them; the largest component of the normal is
    /// positive.
    ///
    /// # Errors
    /// [`MeshError::NotFinite`]; [`MeshError::TooFew`] under three distinct points;
    /// [`MeshError::Collinear`].
    ///
    /// ```
    /// use palpate::WorldPoint;
    /// use palpate::mesh::plane::Plane;
    /// let at = |x, y| WorldPoint([x, y, 7.0]);
    /// let plane = Plane::through(&[at(0.0, 0.0), at(4.0, 0.0), at(0.0, 3.0)])?;
    /// assert_eq!(plane.normal(), [0.0, 0.0, 1.0]);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn through(points: &[WorldPoint]) -> Result<Self, MeshError> {
        if let Some(node) = points.iter().position(|p| p.0.iter().any(|v| !v.is_finite())) {
            return Err(MeshError::NotFinite { node });
        }
        let Some(&origin) = points.first() else {
            return Err(MeshError::TooFew { found: 0, needed: 3 });
        };
        // Scaled by the largest coordinate difference, so that no square overflows or vanishes.
        let extent = points.iter().flat_map(|p| p.minus(origin)).fold(0.0, |m: f64, v| m.max(v.abs()));
        if extent == 0.0 {
            return Err(MeshError::TooFew { found: 1, needed: 3 });
        }
        let offset = |p: &WorldPoint| p.minus(origin).map(|v| v / extent);
        let far = farthest(points.iter().map(offset));
        let along = far.map(|v| v / dot(far, far).sqrt());
        let across = farthest(points.iter().map(|p| cross(along, offset(p))));
        let width = dot(across, across).sqrt();
        if width <= COLLINEARITY_TOLERANCE {
            let distinct = points.iter().any(|p| offset(p) != [0.0; 3] && offset(p) != far);
            return Err(if distinct { MeshError::Collinear } else { MeshError::TooFew { found: 2, needed: 3 } });
        }
        let largest = across.iter().fold(0.0, |m: f64, &v| if v.abs() > m.abs() { v } else { m });
        let normal = across.map(|v| v / width.copysign(largest));
        let mut first = [0.0; 3];
        let flattest = (0..3).fold(0, |k, a| if normal[a].abs() < normal[k].abs() { a } else { k });
        first[flattest] = 1.0;
        let lean = dot(first, normal);
        let level: [f64; 3] = std::array::from_fn(|a| first[a] - lean * normal[a]);
        let axis = level.map(|v| v / dot(level, level).sqrt());
        Ok(Self { origin, axes: [axis, cross(normal, axis)], normal })
    }

    /// The unit normal.
    pub fn normal(&self) -> [f64; 3] {
        self.normal
    }

    /// Coordinates in the plane (mm) of a point's foot on it.
    pub fn project(&self, p: WorldPoint) -> [f64; 2] {
        let offset = p.minus(self.origin);
        self.axes.map(|axis| dot(axis, offset))
    }
}

/// The longest of some vectors, the first of equals.
fn farthest(vectors: impl Iterator<Item = [f64; 3]>) -> [f64; 3] {
    vectors.fold([0.0; 3], |m, v| if dot(v, v) > dot(m, m) { v } else { m })
}
