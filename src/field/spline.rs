//! A spline lattice as a dense field.

use crate::error::{FieldError, SpaceError};
use crate::field::jacobian;
use crate::numerics::bspline::Lattice;
use crate::numerics::orientation::Orientation;
use crate::numerics::simd::dispatch;
use crate::numerics::unfold;
use crate::types::{DenseField, Grid, Mask, Volume};
use rayon::prelude::*;

/// Evaluates `coefficients` (mm along `grid`'s axes, planar) at every voxel and turns them into world mm (RAS).
///
/// The lattice must lie over `grid`'s shape.
pub fn dense(grid: &Grid, lattice: &Lattice, coefficients: &[f32]) -> DenseField {
    let [nx, ny, _] = grid.shape();
    let axes = axes(grid).map(|row| row.map(|v| v as f32));
    let mut out = DenseField::zeros(*grid);
    let n = grid.len();
    let (x, rest) = out.as_mut_slice().split_at_mut(n);
    let (y, z) = rest.split_at_mut(n);
    let plane = nx * ny;
    let planes = (x.par_chunks_mut(plane), y.par_chunks_mut(plane), z.par_chunks_mut(plane));
    planes.into_par_iter().enumerate().for_each(|(k, (x, y, z))| {
        let slice = lattice.slice(coefficients, k);
        let mut nodes = vec![0.0; lattice.nodes[0]];
        let mut d: [Vec<f32>; 3] = std::array::from_fn(|_| vec![0.0; nx]);
        dispatch(
            #[inline(always)]
            || {
                for j in 0..ny {
                    for (c, d) in d.iter_mut().enumerate() {
                        lattice.row(&slice, c, j, &mut nodes, d);
                    }
                    for i in 0..nx {
                        let v = [d[0][i], d[1][i], d[2][i]];
                        let world = |r: usize| axes[r][0] * v[0] + axes[r][1] * v[1] + axes[r][2] * v[2];
                        (x[j * nx + i], y[j * nx + i], z[j * nx + i]) = (world(0), world(1), world(2));
                    }
                }
            },
        );
    });
    out
}

/// Unit vectors along the grid's axes, one a column (world RAS).
pub fn axes(grid: &Grid) -> [[f64; 3]; 3] {
    let (spacing, linear) = (grid.spacing(), grid.affine().linear());
    std::array::from_fn(|r| std::array::from_fn(|a| linear[r][a] / spacing[a]))
}

/// Gives voxels of a field that was made by [`dense`] the displacement of another place, `(voxel, place)` in voxels; returns
/// by how much each changed (mm).
pub fn follow(
    field: &mut DenseField,
    lattice: &Lattice,
    coefficients: &[f32],
    places: &[([usize; 3], [f64; 3])],
) -> Vec<f32> {
    let grid = *field.grid();
    let (shape, axes, n) = (grid.shape(), axes(&grid), grid.len());
    let values = field.as_mut_slice();
    let own = &values;
    let found: Vec<([f32; 3], f32)> = places
        .par_iter()
        .map(|([i, j, k], p)| {
            let d = lattice.at(coefficients, std::array::from_fn(|a| p[a].clamp(0.0, (shape[a] - 1) as f64)));
            let world: [f32; 3] = std::array::from_fn(|r| (0..3).map(|a| axes[r][a] * d[a]).sum::<f64>() as f32);
            let at = grid.index(*i, *j, *k);
            let change = (0..3).map(|c| (world[c] - own[c * n + at]).powi(2)).sum::<f32>().sqrt();
            (world, change)
        })
        .collect();
    for (([i, j, k], _), (d, _)) in places.iter().zip(&found) {
        for (c, d) in d.iter().enumerate() {
            values[c * n + grid.index(*i, *j, *k)] = *d;
        }
    }
    found.into_iter().map(|(_, change)| change).collect()
}

/// Times that what still folds between the knots of a lattice is smoothed.
const UNFOLDED: usize = 20;

/// A displacement field as its B-spline coefficients, and the voxels beside a jump that move as another place does: all that a dense one is worked
/// out from, and much smaller.
#[derive(Debug, Clone, PartialEq)]
pub struct FieldSpline {
    grid: Grid,
    /// Nodes over the grid.
    pub(crate) lattice: Lattice,
    /// Displacement (mm along the grid's axes), planar.
    pub(crate) coefficients: Vec<f32>,
    places: Vec<([usize; 3], [f64; 3])>,
    /// The grid it is asked for on, where that one's axes run otherwise.
    stored: Option<(Grid, Orientation)>,
}

impl FieldSpline {
    /// From coefficients (mm along `grid`'s axes, planar) on the nodes of a lattice that lies over its shape; `places` are those of [`follow`].
    pub fn new(grid: Grid, (lattice, coefficients): (Lattice, Vec<f32>), places: Vec<([usize; 3], [f64; 3])>) -> Self {
        Self { grid, lattice, coefficients, places, stored: None }
    }

    /// The same, to be asked for on the grid `stored` of the same voxels.
    pub fn stored_on(self, stored: Grid, orientation: Orientation) -> Self {
        Self { stored: Some((stored, orientation)), ..self }
    }

    /// The lattice, and the coefficients on it.
    pub(crate) fn parts(&self) -> (&Lattice, &[f32]) {
        (&self.lattice, &self.coefficients)
    }

    /// The displacement at every voxel (mm, RAS).
    ///
    /// # Errors
    /// [`SpaceError`] where the grid it is asked for on is not one of the same voxels.
    pub fn dense(&self) -> Result<DenseField, SpaceError> {
        let (field, _) = self.with_changes();
        match &self.stored {
            Some((grid, orientation)) => orientation.stored_field(field, grid),
            None => Ok(field),
        }
    }

    /// Smooths the coefficients about voxels of `mask` that fold, until none does but for jumps, [`UNFOLDED`] times at most; the
    /// displacement on its own grid and by how much jumps change it, as [`Self::with_changes`].
    ///
    /// # Errors
    /// [`FieldError::GridMismatch`] when the mask has another shape.
    pub(crate) fn unfold(&mut self, mask: &Mask) -> Result<(DenseField, Vec<([usize; 3], f32)>), FieldError> {
        let mut field = dense(&self.grid, &self.lattice, &self.coefficients);
        for _ in 0..UNFOLDED {
            let folds = jacobian::folds(&field, Some(mask))?;
            if folds.is_empty() {
                break;
            }
            let voxels = folds.into_iter().map(|at| self.grid.voxel(at));
            unfold::smooth_about(&self.lattice, &mut self.coefficients, voxels);
            field = dense(&self.grid, &self.lattice, &self.coefficients);
        }
        Ok(self.changed(field))
    }

    /// The displacement on its own grid, and by how much each voxel beside a jump is moved from the smooth field (mm) with its index.
    pub(crate) fn with_changes(&self) -> (DenseField, Vec<([usize; 3], f32)>) {
        self.changed(dense(&self.grid, &self.lattice, &self.coefficients))
    }

    /// The same from the smooth field.
    fn changed(&self, mut field: DenseField) -> (DenseField, Vec<([usize; 3], f32)>) {
        let changes = follow(&mut field, &self.lattice, &self.coefficients, &self.places);
        (field, self.places.iter().map(|(v, _)| *v).zip(changes).collect())
    }
}

/// A smooth scalar over a grid, kept as its B-spline coefficients: small, and worked out where it is asked for.
#[derive(Debug, Clone, PartialEq)]
pub struct ScalarSpline {
    grid: Grid,
    lattice: Lattice,
    values: Vec<f32>,
    /// The grid it is asked for on, where that one's axes run otherwise.
    stored: Option<(Grid, Orientation)>,
}

impl ScalarSpline {
    /// From coefficients on the nodes of a lattice that lies over `grid`'s shape.
    pub fn new(grid: Grid, lattice: Lattice, values: Vec<f32>) -> Self {
        Self { grid, lattice, values, stored: None }
    }

    /// The same, to be asked for on the grid `stored` of the same voxels.
    pub fn stored_on(self, stored: Grid, orientation: Orientation) -> Self {
        Self { stored: Some((stored, orientation)), ..self }
    }

    /// The value at a voxel offset (x fastest).
    pub fn at(&self, offset: usize) -> f32 {
        let offset = match &self.stored {
            Some((grid, orientation)) => orientation.offset(grid.shape(), grid.voxel(offset)),
            None => offset,
        };
        self.at_place(self.grid.voxel(offset).map(|i| i as f64))
    }

    /// The value at a place of the canonical grid (voxels).
    pub(crate) fn at_place(&self, place: [f64; 3]) -> f32 {
        let mut sum = 0.0;
        self.lattice.for_each_tap(place, |node, w| sum += w * self.values[node]);
        sum
    }

    /// The grid it is asked for on.
    pub fn grid(&self) -> &Grid {
        self.stored.as_ref().map_or(&self.grid, |(grid, _)| grid)
    }

    /// The values of whole rows of voxels, from row `first` of the grid on (`j + ny k`).
    pub fn rows(&self, first: usize, out: &mut [f32]) {
        let [nx, ny, _] = self.grid().shape();
        let (axis, backwards) = self.stored.as_ref().map_or((0, false), |(_, orientation)| orientation.along_rows());
        let mut nodes = Vec::new();
        for (row, out) in (first..).zip(out.chunks_exact_mut(nx)) {
            let start = [0, row % ny, row / ny];
            let voxel = self
                .stored
                .as_ref()
                .map_or(start, |(grid, orientation)| self.grid.voxel(orientation.offset(grid.shape(), start)));
            self.lattice.line(&self.values, axis, voxel, &mut nodes, out);
            if backwards {
                out.reverse();
            }
        }
    }

    /// The value at every voxel.
    pub fn volume(&self) -> Volume {
        Volume::by_rows(*self.grid(), |first, out| self.rows(first, out))
    }
}
