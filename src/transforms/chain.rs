//! A chain of transforms.

use crate::numerics::inversion::{origin_of, residual};
use crate::numerics::sampling::{displacement, inside};
use crate::types::space::length;
use crate::types::{AffineMap, DenseField, Grid, Transform, WorldPoint};

/// How near the inverse of a field comes to the place that it looks for (mm).
const TOLERANCE_MM: f64 = 1e-8;
/// Further off than this (mm) there is no inverse: the field ends, or folds.
const LOST_MM: f64 = 1e-3;

/// Transforms in the order in which a point travels: the first one comes first. An empty chain
/// moves nothing.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Chain(pub Vec<Transform>);

impl Chain {
    /// Where the point `p` of the initial volume lies in the deformed one (world mm).
    ///
    /// A field says nothing outside its grid or where it is not finite, its inverse nothing where
    /// no point of the grid leads: there it is `None`. (ITK leaves such points where they are.)
    ///
    /// ```
    /// use palpate::transforms::Chain;
    /// use palpate::types::Transform;
    /// use palpate::{Affine, AffineMap, DenseField, Grid, WorldPoint};
    /// let shift =
    ///     AffineMap::new([[1.0, 0.0, 0.0, 2.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])?;
    /// let grid = Grid::new([8; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
    /// let field = DenseField::from_fn(grid, |p| [0.0, p.0[0], 0.0]);
    /// let chain = Chain(vec![Transform::Affine(shift), Transform::Field(field)]);
    /// assert_eq!(chain.at(WorldPoint([1.0, 1.0, 1.0])), Some(WorldPoint([3.0, 4.0, 1.0])));
    /// // The shift leads out of the field.
    /// assert_eq!(chain.at(WorldPoint([7.0, 1.0, 1.0])), None);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn at(&self, p: WorldPoint) -> Option<WorldPoint> {
        self.0.iter().try_fold(p, step)
    }

    /// [`Chain::at`] of the centre of a voxel of `grid`, by its offset (x fastest): a field on that
    /// grid is read there as it is.
    pub(super) fn at_voxel(&self, grid: &Grid, offset: usize) -> Option<WorldPoint> {
        let x = grid.centre(offset);
        match &self.0[..] {
            [Transform::Field(field), rest @ ..] if field.grid() == grid => {
                finite(x.moved(field.at(offset).map(f64::from))).and_then(|p| rest.iter().try_fold(p, step))
            }
            all => all.iter().try_fold(x, step),
        }
    }

    /// As [`Chain::at`], but outside its grid a field holds the value of its nearest edge: a motion
    /// to start from, everywhere.
    pub fn held_at(&self, p: WorldPoint) -> WorldPoint {
        self.0.iter().fold(p, |p, transform| match transform {
            Transform::Affine(map) => map.at(p),
            Transform::Field(field) => p.moved(displacement(field, p)),
            Transform::Inverse(field) => origin_of(field, p, TOLERANCE_MM),
        })
    }

    /// The chain from the deformed to the initial volume: each transform inverted, last one first.
    ///
    /// ```
    /// use palpate::transforms::Chain;
    /// use palpate::types::Transform;
    /// use palpate::types::space::length;
    /// use palpate::{Affine, DenseField, Grid, WorldPoint};
    /// let grid = Grid::new([16; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
    /// let field = DenseField::from_fn(grid, |p| [0.1 * p.0[1], 0.05 * p.0[0], 0.0]);
    /// let chain = Chain(vec![Transform::Field(field)]);
    /// let start = WorldPoint([5.0, 6.0, 7.0]);
    /// let end = chain.at(start).ok_or("outside")?;
    /// let back = chain.inverse().at(end).ok_or("outside")?;
    /// assert!(length(back.minus(start)) < 1e-6);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn inverse(self) -> Self {
        Self(self.0.into_iter().rev().map(Transform::inverse).collect())
    }

    /// The displacement (mm) of the whole chain at each voxel centre of `grid`; NaN where
    /// [`Chain::at`] gives nothing.
    pub fn to_field(&self, grid: &Grid) -> DenseField {
        DenseField::from_voxels(*grid, |at, x| self.at_voxel(grid, at).map_or([f64::NAN; 3], |y| y.minus(x)))
    }

    /// The chain as one affine map, when all its transforms are affine.
    pub fn affine(&self) -> Option<AffineMap> {
        self.0.iter().try_fold(AffineMap::IDENTITY, |before, transform| match transform {
            Transform::Affine(map) => Some(before.then(map)),
            _ => None,
        })
    }

    /// The grid of the first field in the chain, if there is one.
    pub fn grid(&self) -> Option<&Grid> {
        self.0.iter().find_map(|transform| match transform {
            Transform::Affine(_) => None,
            Transform::Field(field) | Transform::Inverse(field) => Some(field.grid()),
        })
    }
}

/// Where one transform takes a point.
fn step(p: WorldPoint, transform: &Transform) -> Option<WorldPoint> {
    match transform {
        Transform::Affine(map) => Some(map.at(p)),
        Transform::Field(field) => within(field, p).then(|| p.moved(displacement(field, p))).and_then(finite),
        Transform::Inverse(field) => {
            let x = origin_of(field, p, TOLERANCE_MM);
            (within(field, x) && length(residual(field, x, p)) < LOST_MM).then_some(x)
        }
    }
}

/// A field without a number says nothing.
fn finite(p: WorldPoint) -> Option<WorldPoint> {
    p.0.iter().all(|v| v.is_finite()).then_some(p)
}

/// Whether `p` (world mm) lies in a voxel of the field's grid.
fn within(field: &DenseField, p: WorldPoint) -> bool {
    inside(field.grid().shape(), field.grid().affine().to_voxel(p))
}
