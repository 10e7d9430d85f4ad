//! A dense displacement field.

use crate::error::SpaceError;
use crate::types::space::{Grid, WorldPoint};
use ndarray::{ArrayView4, ShapeBuilder};
use rayon::prelude::*;
use std::borrow::Cow;

/// Displacements on the initial volume's grid, in world mm, RAS components, initial to deformed.
///
/// The array has shape (nx, ny, nz, 3) with x fastest, so each component is one contiguous volume.
/// (On disk the components are LPS; `io` converts.)
#[derive(Debug, Clone, PartialEq)]
pub struct Displacement<'a> {
    grid: Grid,
    values: Cow<'a, [f32]>,
}

/// Displacements of its own on the initial volume's grid.
pub type DenseField = Displacement<'static>;

impl DenseField {
    /// No motion.
    ///
    /// ```
    /// use palpate::{Affine, DenseField, Grid};
    /// let field = DenseField::zeros(Grid::new([4; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?);
    /// assert_eq!(field.as_slice().len(), 3 * 64);
    /// assert_eq!(field.at(17), [0.0; 3]);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn zeros(grid: Grid) -> Self {
        Self { grid, values: vec![0.0; 3 * grid.len()].into() }
    }

    /// From the three components one after the other, each x fastest (mm, RAS).
    ///
    /// # Errors
    /// [`SpaceError::Length`] when the length is not three times the grid's.
    pub fn from_vec(grid: Grid, values: Vec<f32>) -> Result<Self, SpaceError> {
        Self::of(grid, values.into())
    }

    /// The displacement (mm) that `f` gives for each voxel centre.
    ///
    /// ```
    /// use palpate::{Affine, DenseField, Grid};
    /// let grid = Grid::new([8; 3], Affine::scaled([2.0; 3], [0.0; 3])?)?;
    /// // Tissue is compressed by a tenth along z.
    /// let field = DenseField::from_fn(grid, |p| [0.0, 0.0, -0.1 * p.0[2]]);
    /// assert_eq!(field.at(grid.index(0, 0, 5)), [0.0, 0.0, -1.0]);
    /// assert_eq!(field.component(2)[grid.index(3, 3, 5)], -1.0);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn from_fn(grid: Grid, mut f: impl FnMut(WorldPoint) -> [f64; 3]) -> Self {
        let mut out = Self::zeros(grid);
        let s = grid.shape();
        let n = grid.len();
        let values = out.as_mut_slice();
        for k in 0..s[2] {
            for j in 0..s[1] {
                for i in 0..s[0] {
                    let d = f(grid.world(i, j, k));
                    let at = grid.index(i, j, k);
                    for c in 0..3 {
                        values[c * n + at] = d[c] as f32;
                    }
                }
            }
        }
        out
    }

    /// The same in parallel; `f` also gets the voxel's x-fastest offset, and must not depend on the
    /// order of calls.
    pub fn from_voxels(grid: Grid, f: impl Fn(usize, WorldPoint) -> [f64; 3] + Sync) -> Self {
        let mut out = Self::zeros(grid);
        let [nx, ny, _] = grid.shape();
        let (x, rest) = out.as_mut_slice().split_at_mut(grid.len());
        let (y, z) = rest.split_at_mut(grid.len());
        let rows = x.par_chunks_mut(nx).zip(y.par_chunks_mut(nx)).zip(z.par_chunks_mut(nx));
        rows.enumerate().for_each(|(row, ((x, y), z))| {
            for i in 0..nx {
                let d = f(row * nx + i, grid.world(i, row % ny, row / ny));
                (x[i], y[i], z[i]) = (d[0] as f32, d[1] as f32, d[2] as f32);
            }
        });
        out
    }
}

impl<'a> Displacement<'a> {
    /// On components that stay where they are, one after the other, each x fastest (mm, RAS).
    ///
    /// # Errors
    /// [`SpaceError::Length`] when the length is not three times the grid's.
    pub fn lent(grid: Grid, values: &'a [f32]) -> Result<Self, SpaceError> {
        Self::of(grid, values.into())
    }

    fn of(grid: Grid, values: Cow<'a, [f32]>) -> Result<Self, SpaceError> {
        let (expected, found) = (3 * grid.len(), values.len());
        if expected != found {
            return Err(SpaceError::Length { expected, found });
        }
        Ok(Self { grid, values })
    }

    /// The lattice (the initial volume's).
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// The (nx, ny, nz, 3) array.
    pub fn array(&self) -> ArrayView4<'_, f32> {
        let [nx, ny, nz] = self.grid.shape();
        ArrayView4::from_shape((nx, ny, nz, 3).f(), &self.values)
            .unwrap_or_else(|_| unreachable!("the length is the grid's"))
    }

    /// All three components, one after the other, x fastest.
    pub fn as_slice(&self) -> &[f32] {
        &self.values
    }

    /// The same, to be changed in place (in a copy, when they are lent).
    pub fn as_mut_slice(&mut self) -> &mut [f32] {
        self.values.to_mut()
    }

    /// Component `c` (0 = right, 1 = front, 2 = up), x fastest.
    pub fn component(&self, c: usize) -> &[f32] {
        let n = self.grid.len();
        &self.as_slice()[c * n..(c + 1) * n]
    }

    /// The displacement at one voxel, by its x-fastest offset (mm).
    #[inline]
    pub fn at(&self, index: usize) -> [f32; 3] {
        let (v, n) = (self.as_slice(), self.grid.len());
        [v[index], v[n + index], v[2 * n + index]]
    }

    /// The three components, x fastest (a copy, when they are lent).
    pub fn into_vec(self) -> Vec<f32> {
        self.values.into_owned()
    }
}
