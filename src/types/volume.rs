//! A scalar volume on a grid, and masks and label maps of the same form.

use crate::error::SpaceError;
use crate::types::space::{Grid, WorldPoint};
use ndarray::{Array3, ShapeBuilder};
use rayon::prelude::*;

/// Values on a [`Grid`]; the array has shape (nx, ny, nz) and lies in memory with x fastest (NIfTI's order).
#[derive(Debug, Clone, PartialEq)]
pub struct Volume<T = f32> {
    grid: Grid,
    data: Array3<T>,
}

/// A mask (0 = outside) or a label map (one number a region).
pub type Mask = Volume<u8>;

impl<T: Clone> Volume<T> {
    /// From values with x fastest; the length must be the grid's.
    ///
    /// # Errors
    /// [`SpaceError::Length`] when it is not.
    pub fn from_vec(grid: Grid, values: Vec<T>) -> Result<Self, SpaceError> {
        let (expected, found) = (grid.len(), values.len());
        let s = grid.shape();
        let data = Array3::from_shape_vec((s[0], s[1], s[2]).f(), values)
            .map_err(|_| SpaceError::Length { expected, found })?;
        Ok(Self { grid, data })
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

    /// The value that `f` gives for each voxel's x-fastest offset and centre, in parallel: `f` must not depend on the
    /// order of calls.
    pub fn from_voxels(grid: Grid, f: impl Fn(usize, WorldPoint) -> T + Sync) -> Self
    where
        T: Send + Sync + Default,
    {
        let mut out = Self::filled(grid, T::default());
        let [nx, ny, _] = grid.shape();
        out.as_mut_slice().par_chunks_mut(nx).enumerate().for_each(|(row, line)| {
            for (i, v) in line.iter_mut().enumerate() {
                *v = f(row * nx + i, grid.world(i, row % ny, row / ny));
            }
        });
        out
    }

    /// The same value everywhere.
    pub fn filled(grid: Grid, value: T) -> Self {
        let s = grid.shape();
        Self { grid, data: Array3::from_elem((s[0], s[1], s[2]).f(), value) }
    }

    /// The lattice.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// The (nx, ny, nz) array.
    pub fn array(&self) -> &Array3<T> {
        &self.data
    }

    /// All values, x fastest.
    pub fn as_slice(&self) -> &[T] {
        self.data.as_slice_memory_order().unwrap_or_default()
    }

    /// All values, x fastest, to be changed in place.
    pub fn as_mut_slice(&mut self) -> &mut [T] {
        self.data.as_slice_memory_order_mut().unwrap_or_default()
    }

    /// The values, x fastest.
    pub fn into_vec(self) -> Vec<T> {
        self.data.into_raw_vec_and_offset().0
    }
}
