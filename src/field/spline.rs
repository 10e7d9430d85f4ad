//! A spline lattice as a dense field.

use crate::error::SpaceError;
use crate::field::jacobian;
use crate::numerics::bspline::Lattice;
use crate::numerics::orientation::Orientation;
use crate::numerics::sampling::{beside, nearest};
use crate::numerics::simd::dispatch;
use crate::types::{Affine, AffineMap, DenseField, Grid, GridVector, Mask, Volume, VoxelPoint, WorldPoint};
use rayon::prelude::*;

/// A spline lattice over a grid's voxels, and displacements (mm along the grid's axes, planar) at
/// its nodes.
pub type Spline = (Lattice, Vec<f32>);

/// Evaluates the spline of each voxel's body at every voxel and turns it into world mm (RAS);
/// `labels` may be empty where there is one.
///
/// The lattices must lie over `grid`'s shape.
fn evaluated(grid: &Grid, bodies: &[Spline], labels: &[u8]) -> DenseField {
    let [nx, ny, _] = grid.shape();
    let axes = grid.axes().map(|row| row.map(|v| v as f32));
    let mut out = DenseField::zeros(*grid);
    let n = grid.len();
    let (x, rest) = out.as_mut_slice().split_at_mut(n);
    let (y, z) = rest.split_at_mut(n);
    let plane = nx * ny;
    let planes = (x.par_chunks_mut(plane), y.par_chunks_mut(plane), z.par_chunks_mut(plane));
    planes.into_par_iter().enumerate().for_each(|(k, (x, y, z))| {
        let own = labels.get(k * plane..(k + 1) * plane);
        for (b, (lattice, coefficients)) in bodies.iter().enumerate() {
            let is_own = |at: usize| own.is_none_or(|labels| usize::from(labels[at]) == b);
            if !(0..plane).any(is_own) {
                continue;
            }
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
                        for i in (0..nx).filter(|i| is_own(j * nx + i)) {
                            let v = [d[0][i], d[1][i], d[2][i]];
                            let world = |r: usize| axes[r][0] * v[0] + axes[r][1] * v[1] + axes[r][2] * v[2];
                            (x[j * nx + i], y[j * nx + i], z[j * nx + i]) = (world(0), world(1), world(2));
                        }
                    }
                },
            );
        }
    });
    out
}

/// The nodes of a lattice over `grid` as a grid of their own.
///
/// # Errors
/// [`SpaceError`] when they have no place.
pub(crate) fn node_grid(grid: &Grid, lattice: &Lattice) -> Result<Grid, SpaceError> {
    let linear = grid.affine().linear();
    // The only node of a flat axis lies in its plane.
    let VoxelPoint(place) = lattice.place(0);
    let first = std::array::from_fn(|a| if lattice.shape[a] > 1 { place[a] } else { 0.0 });
    let WorldPoint(first) = grid.affine().to_world(VoxelPoint(first));
    let row = |r: usize| {
        let [x, y, z] = std::array::from_fn(|a| linear[r][a] * lattice.step[a] as f64);
        [x, y, z, first[r]]
    };
    Grid::new(lattice.nodes, Affine::new(std::array::from_fn(row))?)
}

/// The place (voxels of `grid`) of a voxel offset of the grid that a spline is asked for on.
fn place(grid: &Grid, stored: &Option<(Grid, Orientation)>, offset: usize) -> VoxelPoint {
    let offset = match stored {
        Some((asked, orientation)) => orientation.offset(asked.shape(), asked.voxel(offset)),
        None => offset,
    };
    VoxelPoint::of(grid.voxel(offset))
}

/// A displacement field as its B-spline coefficients, one lattice a body that slides along others:
/// all that a dense one is worked out from, and much smaller.
#[derive(Debug, Clone, PartialEq)]
pub struct FieldSpline {
    grid: Grid,
    bodies: Vec<Spline>,
    /// The body of each voxel; empty where there is one.
    labels: Vec<u8>,
    /// Where nothing may fold (not 0); empty: everywhere.
    tissue: Vec<u8>,
    /// The grid it is asked for on, where that one's axes run otherwise.
    stored: Option<(Grid, Orientation)>,
}

impl FieldSpline {
    /// From the spline of each body over `grid`, the body of each voxel and where nothing may fold
    /// (not 0); neither where there is one body.
    pub fn new(grid: Grid, bodies: Vec<Spline>, labels: Vec<u8>, tissue: Vec<u8>) -> Self {
        Self { grid, bodies, labels, tissue, stored: None }
    }

    /// The same, to be asked for on the grid `stored` of the same voxels.
    pub(crate) fn stored_on(self, stored: Grid, orientation: Orientation) -> Self {
        Self { stored: Some((stored, orientation)), ..self }
    }

    /// The same field, followed by an affine map of the world (mm, RAS).
    #[must_use]
    pub(crate) fn followed_by(mut self, map: &AffineMap) -> Self {
        let grid = self.grid;
        for (lattice, coefficients) in &mut self.bodies {
            let n = lattice.len();
            // Cubic B-splines through the values of a linear field are that field.
            for m in 0..n {
                let VoxelPoint(place) = lattice.place(m);
                let place = std::array::from_fn(|a| if lattice.shape[a] > 1 { place[a] } else { 0.0 });
                let here = grid.affine().to_world(VoxelPoint(place));
                let along = GridVector([0, 1, 2].map(|c| f64::from(coefficients[c * n + m])));
                let moved = map.at(here.moved(grid.vector_to_world(along))).minus(here);
                let GridVector(moved) = grid.vector_from_world(moved);
                (0..3).for_each(|c| coefficients[c * n + m] = moved[c] as f32);
            }
        }
        self
    }

    /// The spline of all voxels, where there is one body.
    pub(crate) fn only(&self) -> Option<&Spline> {
        self.bodies.first().filter(|_| self.bodies.len() == 1)
    }

    /// The same, to be changed.
    pub(crate) fn only_mut(&mut self) -> Option<&mut Spline> {
        let one = self.bodies.len() == 1;
        self.bodies.first_mut().filter(|_| one)
    }

    /// The displacement at every voxel (mm, RAS). What folds, between the knots of a lattice or at
    /// a border between bodies, is opened (`jacobian::unfold`).
    ///
    /// # Errors
    /// [`SpaceError`] where the grid it is asked for on is not one of the same voxels.
    pub fn dense(&self) -> Result<DenseField, SpaceError> {
        let mut field = evaluated(&self.grid, &self.bodies, &self.labels);
        jacobian::unfold(&mut field, &self.tissue);
        match &self.stored {
            Some((grid, orientation)) => orientation.stored_field(field, grid),
            None => Ok(field),
        }
    }

    /// The displacement at a place of the canonical grid.
    pub(crate) fn along_axes(&self, place: VoxelPoint) -> GridVector {
        let body = match self.labels.is_empty() {
            true => 0,
            false => nearest(self.grid.shape(), place).map_or(0, |at| usize::from(self.labels[at])),
        };
        let (lattice, coefficients) = &self.bodies[body];
        lattice.at(coefficients, place)
    }

    /// The displacement (mm, RAS) at a place of the canonical grid.
    pub(crate) fn at_place(&self, place: VoxelPoint) -> [f64; 3] {
        self.grid.vector_to_world(self.along_axes(place))
    }

    /// The displacement (mm, RAS) at a voxel offset (x fastest) of the grid it is asked for on,
    /// before folds are opened.
    pub fn at(&self, offset: usize) -> [f64; 3] {
        self.at_place(place(&self.grid, &self.stored, offset))
    }

    /// Voxels of `mask` beside another body, and how far that one moves from where the voxel's own
    /// does (mm).
    pub(crate) fn jumps(&self, mask: &Mask) -> Vec<([usize; 3], f32)> {
        let (shape, inside) = (self.grid.shape(), mask.as_slice());
        let at_border = |at: usize| {
            let v = self.grid.voxel(at);
            let own = usize::from(self.labels[at]);
            let is_other = |&o: &usize| inside[o] != 0 && usize::from(self.labels[o]) != own;
            let other = beside(shape, at).find(is_other)?;
            let at = |b: usize| self.bodies[b].0.at(&self.bodies[b].1, VoxelPoint::of(v));
            let apart = at(own).minus(at(self.labels[other].into()));
            Some((v, apart.0.iter().map(|d| d.powi(2)).sum::<f64>().sqrt() as f32))
        };
        (0..self.labels.len()).into_par_iter().filter(|&at| inside[at] != 0).filter_map(at_border).collect()
    }
}

/// A smooth scalar over a grid, kept as its B-spline coefficients: small, and worked out where it
/// is asked for.
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
    pub(crate) fn stored_on(self, stored: Grid, orientation: Orientation) -> Self {
        Self { stored: Some((stored, orientation)), ..self }
    }

    /// The same, times a factor.
    #[must_use]
    pub(crate) fn scaled(mut self, factor: f32) -> Self {
        self.values.iter_mut().for_each(|v| *v *= factor);
        self
    }

    /// The value at a voxel offset (x fastest).
    pub fn at(&self, offset: usize) -> f32 {
        self.at_place(place(&self.grid, &self.stored, offset))
    }

    /// The value at a place of the canonical grid.
    pub(crate) fn at_place(&self, place: VoxelPoint) -> f32 {
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
