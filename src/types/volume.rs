//! A scalar volume on a grid, and masks and label maps of the same form.

use crate::error::SpaceError;
use crate::types::space::{Grid, WorldPoint};
use ndarray::{Array3, ArrayView3, ShapeBuilder};
use rayon::prelude::*;
use std::borrow::Cow;

/// Values on a [`Grid`], its own or lent to it; the array has shape (nx, ny, nz) and lies in memory
/// with x fastest (NIfTI's order).
#[derive(Debug, Clone, PartialEq)]
pub struct Voxels<'a, T: Clone = f32> {
    grid: Grid,
    values: Cow<'a, [T]>,
}

/// Values of its own on a [`Grid`].
pub type Volume<T = f32> = Voxels<'static, T>;

/// A mask (0 = outside) or a label map (one number a region).
pub type Mask = Volume<u8>;

impl<T: Clone> Volume<T> {
    /// From values with x fastest; the length must be the grid's.
    ///
    /// # Errors
    /// [`SpaceError::Length`] when it is not.
    ///
    /// ```
    /// use palpate::{Affine, Grid, SpaceError, Volume};
    /// let grid = Grid::new([3, 2, 1], Affine::scaled([1.0; 3], [0.0; 3])?)?;
    /// let volume = Volume::from_vec(grid, vec![0.0f32, 1.0, 2.0, 3.0, 4.0, 5.0])?;
    /// // The array is indexed by x, y, z.
    /// assert_eq!(volume.array()[[2, 1, 0]], 5.0);
    /// let short = Volume::from_vec(grid, vec![0.0f32; 5]);
    /// assert_eq!(short.unwrap_err(), SpaceError::Length { expected: 6, found: 5 });
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn from_vec(grid: Grid, values: Vec<T>) -> Result<Self, SpaceError> {
        Self::of(grid, values.into())
    }

    /// From an (nx, ny, nz) array in any memory order (copied when not already x-fastest).
    ///
    /// # Errors
    /// [`SpaceError::Length`] when the shape is not the grid's.
    pub fn from_array(grid: Grid, array: Array3<T>) -> Result<Self, SpaceError> {
        let s = grid.shape();
        if array.dim() != (s[0], s[1], s[2]) {
            return Err(SpaceError::Length { expected: grid.len(), found: array.len() });
        }
        let values = array.t().iter().cloned().collect();
        Self::from_vec(grid, values)
    }

    /// The value that `f` gives for each voxel's x-fastest offset and centre, in parallel: `f` must
    /// not depend on the order of calls.
    ///
    /// ```
    /// use palpate::{Affine, Grid, Mask};
    /// let grid = Grid::new([20; 3], Affine::scaled([1.0; 3], [-9.5; 3])?)?;
    /// let ball =
    ///     Mask::from_voxels(grid, |_, p| u8::from(p.0.iter().map(|x| x * x).sum::<f64>() < 64.0));
    /// assert_eq!(ball.as_slice()[grid.index(10, 10, 10)], 1);
    /// assert_eq!(ball.as_slice()[0], 0);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn from_voxels(grid: Grid, f: impl Fn(usize, WorldPoint) -> T + Sync) -> Self
    where
        T: Send + Sync + Default,
    {
        let [nx, ny, _] = grid.shape();
        Self::by_rows(grid, |row, line| {
            for (i, v) in line.iter_mut().enumerate() {
                *v = f(row * nx + i, grid.world(i, row % ny, row / ny));
            }
        })
    }

    /// What `f` fills each row of voxels with, by its number (`j + ny k`), in parallel: `f` must
    /// not depend on the order of calls.
    pub fn by_rows(grid: Grid, f: impl Fn(usize, &mut [T]) + Sync) -> Self
    where
        T: Send + Sync + Default,
    {
        let mut out = Self::filled(grid, T::default());
        out.as_mut_slice().par_chunks_mut(grid.shape()[0]).enumerate().for_each(|(row, line)| f(row, line));
        out
    }

    /// The same value everywhere.
    pub fn filled(grid: Grid, value: T) -> Self {
        Self { grid, values: vec![value; grid.len()].into() }
    }
}

impl<'a, T: Clone> Voxels<'a, T> {
    /// On values that stay where they are, x fastest; the length must be the grid's.
    ///
    /// # Errors
    /// [`SpaceError::Length`] when it is not.
    ///
    /// ```
    /// use palpate::{Affine, Grid, Voxels};
    /// let values = vec![7.0f32; 8];
    /// let grid = Grid::new([2; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
    /// let volume = Voxels::lent(grid, &values)?;
    /// // Nothing is copied.
    /// assert!(std::ptr::eq(volume.as_slice(), values.as_slice()));
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn lent(grid: Grid, values: &'a [T]) -> Result<Self, SpaceError> {
        Self::of(grid, values.into())
    }

    /// The same, on these values.
    pub fn view(&self) -> Voxels<'_, T> {
        Voxels { grid: self.grid, values: self.as_slice().into() }
    }

    fn of(grid: Grid, values: Cow<'a, [T]>) -> Result<Self, SpaceError> {
        let (expected, found) = (grid.len(), values.len());
        if expected != found {
            return Err(SpaceError::Length { expected, found });
        }
        Ok(Self { grid, values })
    }

    /// The lattice.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// The (nx, ny, nz) array.
    pub fn array(&self) -> ArrayView3<'_, T> {
        let [nx, ny, nz] = self.grid.shape();
        ArrayView3::from_shape((nx, ny, nz).f(), &self.values)
            .unwrap_or_else(|_| unreachable!("the length is the grid's"))
    }

    /// All values, x fastest.
    pub fn as_slice(&self) -> &[T] {
        &self.values
    }

    /// All values, x fastest, to be changed in place (in a copy, when they are lent).
    pub fn as_mut_slice(&mut self) -> &mut [T] {
        self.values.to_mut()
    }

    /// The values, x fastest (a copy, when they are lent).
    pub fn into_vec(self) -> Vec<T> {
        self.values.into_owned()
    }

    /// The same values on another grid of the same shape.
    ///
    /// # Errors
    /// [`SpaceError::Length`] when it has another number of voxels.
    pub fn placed(self, grid: Grid) -> Result<Self, SpaceError> {
        Self::of(grid, self.values)
    }

    /// With values of its own (a copy, when they are lent).
    pub fn into_volume(self) -> Volume<T> {
        Voxels { grid: self.grid, values: self.values.into_owned().into() }
    }
}

impl Voxels<'_, u8> {
    /// The first and the last voxel along each axis of those that are not 0; none of an empty mask.
    ///
    /// ```
    /// use palpate::{Affine, Grid, Mask};
    /// let grid = Grid::new([9; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
    /// let mut mask = Mask::filled(grid, 0);
    /// assert_eq!(mask.bounds(), None);
    /// mask.as_mut_slice()[grid.index(2, 3, 4)] = 1;
    /// mask.as_mut_slice()[grid.index(5, 3, 1)] = 1;
    /// assert_eq!(mask.bounds(), Some([[2, 3, 1], [5, 3, 4]]));
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn bounds(&self) -> Option<[[usize; 3]; 2]> {
        let (mut low, mut high) = ([usize::MAX; 3], [0; 3]);
        for (at, _) in self.as_slice().iter().enumerate().filter(|(_, v)| **v != 0) {
            let v = self.grid.voxel(at);
            (0..3).for_each(|a| (low[a], high[a]) = (low[a].min(v[a]), high[a].max(v[a])));
        }
        (low[0] != usize::MAX).then_some([low, high])
    }
}
