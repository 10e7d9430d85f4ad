//! Transforms of world points: from the initial (fixed) volume to the deformed (moving) one.

use crate::error::SpaceError;
use crate::types::field::DenseField;
use crate::types::space::{Affine, Grid, VoxelPoint, WorldPoint};

/// Largest entry of the linear part of a transform, and of its shift (mm).
const MAX_ENTRY_AND_SHIFT: [f64; 2] = [1e4, 1e6];

/// An invertible affine map of world points (mm, RAS), initial to deformed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AffineMap(Affine);

impl AffineMap {
    /// Nothing moves.
    pub const IDENTITY: Self = Self(Affine::IDENTITY);

    /// From the upper three rows of the homogeneous matrix (the last column is the shift, mm).
    ///
    /// # Errors
    /// [`SpaceError::Transform`] when an entry is not finite or absurdly large, or the linear part
    /// is singular.
    pub fn new(rows: [[f64; 4]; 3]) -> Result<Self, SpaceError> {
        let fault = |what: String| SpaceError::Transform { what };
        if rows.iter().flatten().any(|v| !v.is_finite()) {
            return Err(fault("holds a value that is not finite".into()));
        }
        let large = |v: &f64, c: usize| v.abs() > MAX_ENTRY_AND_SHIFT[usize::from(c == 3)];
        if let Some(v) = rows.iter().flat_map(|r| r.iter().enumerate()).find(|(c, v)| large(v, *c)) {
            return Err(fault(format!("holds {}, which is no motion of tissue", v.1)));
        }
        Affine::new(rows).map(Self).map_err(|_| fault("is singular: it maps all tissue to a plane".into()))
    }

    /// The upper three rows of the homogeneous matrix (the last column is the shift, mm).
    pub fn rows(&self) -> [[f64; 4]; 3] {
        self.0.rows()
    }

    /// Where the point `p` goes (world mm).
    #[inline]
    pub fn at(&self, p: WorldPoint) -> WorldPoint {
        self.0.to_world(VoxelPoint(p.0))
    }

    /// Where a grid goes.
    ///
    /// # Errors
    /// [`SpaceError`] when it has no place there.
    pub fn grid(&self, grid: &Grid) -> Result<Grid, SpaceError> {
        Grid::new(grid.shape(), grid.affine().then(&self.0))
    }

    /// The map that undoes this one.
    pub fn inverse(&self) -> Self {
        Self(self.0.inverted())
    }

    /// This map, then `next`.
    ///
    /// ```
    /// use palpate::{AffineMap, WorldPoint};
    /// let shift =
    ///     AffineMap::new([[1.0, 0.0, 0.0, 5.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])?;
    /// let twice =
    ///     AffineMap::new([[2.0, 0.0, 0.0, 0.0], [0.0, 2.0, 0.0, 0.0], [0.0, 0.0, 2.0, 0.0]])?;
    /// let both = shift.then(&twice);
    /// assert_eq!(both.at(WorldPoint([1.0, 1.0, 0.0])), WorldPoint([12.0, 2.0, 0.0]));
    /// assert_eq!(both.inverse().at(WorldPoint([12.0, 2.0, 0.0])), WorldPoint([1.0, 1.0, 0.0]));
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn then(&self, next: &Self) -> Self {
        Self(self.0.then(&next.0))
    }
}

/// A map of world points (mm, RAS), initial to deformed.
#[derive(Debug, Clone, PartialEq)]
pub enum Transform {
    /// The same affine map everywhere.
    Affine(AffineMap),
    /// x goes to x + u(x), u trilinear.
    Field(DenseField),
    /// y goes to the x with x + u(x) = y: the exact inverse of [`Transform::Field`].
    Inverse(DenseField),
}

impl Transform {
    /// The transform that undoes this one.
    pub fn inverse(self) -> Self {
        match self {
            Self::Affine(map) => Self::Affine(map.inverse()),
            Self::Field(field) => Self::Inverse(field),
            Self::Inverse(field) => Self::Field(field),
        }
    }
}
