//! How a grid's axes lie in space, and the same voxels stored with axes that run right, forward and
//! up.

use crate::error::SpaceError;
use crate::types::{Affine, DenseField, Grid, Volume, VoxelPoint, Voxels};
use rayon::prelude::*;

/// Which stored axis runs nearest along each world axis (right, anterior, superior), and which of
/// them run backwards.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Orientation {
    axis: [usize; 3],
    backwards: [bool; 3],
}

/// The orders of three axes.
const AXIS_ORDERS: [[usize; 3]; 6] = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];

impl Orientation {
    /// Of a grid: the order of axes whose directions are nearest to the world's, by the sum of
    /// their cosines.
    pub fn of(grid: &Grid) -> Self {
        let (linear, spacing) = (grid.affine().linear(), grid.spacing());
        let cosine = |world: usize, stored: usize| linear[world][stored] / spacing[stored];
        let along = |order: &[usize; 3]| (0..3).map(|a| cosine(a, order[a]).abs()).sum::<f64>();
        // A margin, so that rounding does not choose between axes that lie between two of the
        // world's.
        let nearest = |best: [usize; 3], order| if along(&order) > along(&best) + 1e-6 { order } else { best };
        let axis = AXIS_ORDERS.into_iter().reduce(nearest).unwrap_or([0, 1, 2]);
        Self { axis, backwards: std::array::from_fn(|a| cosine(a, axis[a]) < 0.0) }
    }

    /// Whether the axes run right, anterior and superior, in this order, as they are stored.
    pub(crate) fn is_canonical(&self) -> bool {
        *self == Self { axis: [0, 1, 2], backwards: [false; 3] }
    }

    /// The grid of the same voxels with canonical axes.
    pub(crate) fn canonical(&self, stored: &Grid) -> Grid {
        let shape = stored.shape();
        let backwards = self.inverse().backwards;
        let first = [0, 1, 2].map(|s| if backwards[s] { (shape[s] - 1) as f64 } else { 0.0 });
        let (linear, origin) = (stored.affine().linear(), stored.affine().to_world(VoxelPoint(first)).0);
        let rows = std::array::from_fn(|r| {
            let column = |a: usize| linear[r][self.axis[a]] * if self.backwards[a] { -1.0 } else { 1.0 };
            [column(0), column(1), column(2), origin[r]]
        });
        // As invertible and as large as the stored one.
        let affine = Affine::new(rows).unwrap_or(*stored.affine());
        Grid::new(self.axis.map(|s| shape[s]), affine).unwrap_or(*stored)
    }

    /// What takes the canonical grid for the stored one and back.
    fn inverse(&self) -> Self {
        let from = |s| self.axis.iter().position(|&x| x == s).unwrap_or(s);
        let axis = [0, 1, 2].map(from);
        Self { axis, backwards: axis.map(|a| self.backwards[a]) }
    }

    /// Where the canonical voxel 0 lies among those of the `stored` shape, and the steps between
    /// them along canonical axes.
    fn steps(&self, stored: [usize; 3]) -> (isize, [isize; 3]) {
        let stride = [1, stored[0], stored[0] * stored[1]].map(|s| s as isize);
        let mut first = 0;
        let steps = std::array::from_fn(|a| {
            let s = self.axis[a];
            if self.backwards[a] {
                first += stride[s] * (stored[s] as isize - 1);
                -stride[s]
            } else {
                stride[s]
            }
        });
        (first, steps)
    }

    /// Where the stored voxel 0 lies among the canonical ones, and the steps between them along
    /// stored axes.
    fn back(&self, stored: [usize; 3]) -> (isize, [isize; 3]) {
        self.inverse().steps(self.axis.map(|s| stored[s]))
    }

    /// The canonical axis along which the stored rows (x) run, and whether they run backwards.
    pub(crate) fn along_rows(&self) -> (usize, bool) {
        let Self { axis, backwards } = self.inverse();
        (axis[0], backwards[0])
    }

    /// As [`Orientation::turned`], of a volume that is let go.
    pub fn turn(&self, stored: Volume) -> Volume {
        if self.is_canonical() { stored } else { self.turned(&stored).into_volume() }
    }

    /// The same voxels on the canonical grid, where they lie if that is theirs already.
    pub fn turned<'a, T: Copy + Default + Send + Sync + 'static>(&self, stored: &'a Voxels<'_, T>) -> Voxels<'a, T> {
        if self.is_canonical() {
            return stored.view();
        }
        let grid = self.canonical(stored.grid());
        let mut out = Volume::filled(grid, T::default());
        gather(stored.as_slice(), out.as_mut_slice(), grid.shape(), self.steps(stored.grid().shape()));
        out
    }

    /// Voxels of the canonical grid, as they are stored on `grid`.
    pub fn stored<T: Copy + Default + Send + Sync>(&self, canonical: &Volume<T>, grid: &Grid) -> Volume<T> {
        let mut out = Volume::filled(*grid, T::default());
        gather(canonical.as_slice(), out.as_mut_slice(), grid.shape(), self.back(grid.shape()));
        out
    }

    /// A field of the canonical grid, as it is stored on `grid`; its components are along the
    /// world's axes on both. Each is turned where it is, so that no second field is held.
    ///
    /// # Errors
    /// [`SpaceError`] when the grids have different numbers of voxels.
    pub(crate) fn stored_field(&self, canonical: DenseField, grid: &Grid) -> Result<DenseField, SpaceError> {
        let mut values = canonical.into_vec();
        for part in values.chunks_exact_mut(grid.len()) {
            let before = part.to_vec();
            gather(&before, part, grid.shape(), self.back(grid.shape()));
        }
        DenseField::from_vec(*grid, values)
    }

    /// The canonical offset of a stored voxel.
    pub fn offset(&self, stored: [usize; 3], voxel: [usize; 3]) -> usize {
        let (first, steps) = self.back(stored);
        (first + (0..3).map(|a| voxel[a] as isize * steps[a]).sum::<isize>()) as usize
    }
}

/// `out[i, j, k] = from[first + i steps[0] + j steps[1] + k steps[2]]`.
fn gather<T: Copy + Send + Sync>(from: &[T], out: &mut [T], shape: [usize; 3], (first, steps): (isize, [isize; 3])) {
    let [nx, ny, _] = shape;
    out.par_chunks_mut(nx).enumerate().for_each(|(row, line)| {
        let start = first + (row % ny) as isize * steps[1] + (row / ny) as isize * steps[2];
        for (i, v) in line.iter_mut().enumerate() {
            *v = from[(start + i as isize * steps[0]) as usize];
        }
    });
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// All 48 ways to store a grid's voxels: an order of its axes and the ways they run.
    fn ways() -> impl Iterator<Item = ([usize; 3], [bool; 3])> {
        AXIS_ORDERS.into_iter().flat_map(|order| (0..8).map(move |f| (order, [0, 1, 2].map(|a| f >> a & 1 == 1))))
    }

    #[test]
    fn all_48_orientations_come_to_one_and_back() {
        let rows = [[0.9, 0.1, -0.2, 3.0], [-0.15, 1.9, 0.3, -4.0], [0.25, -0.2, 2.8, 5.0]];
        let base = Grid::new([3, 4, 5], Affine::new(rows).unwrap()).unwrap();
        let canonical = Volume::from_voxels(base, |at, _| at as f32);
        assert!(Orientation::of(&base).is_canonical());
        for (axis, backwards) in ways() {
            let made = Orientation { axis, backwards };
            // The stored grid of which `base` is the canonical one.
            let mut shape = [0; 3];
            let mut columns = [[0.0; 3]; 3];
            let mut first = [0.0; 3];
            for a in 0..3 {
                shape[axis[a]] = base.shape()[a];
                let sign = if backwards[a] { -1.0 } else { 1.0 };
                columns[axis[a]] = [0, 1, 2].map(|r| sign * rows[r][a]);
                first[a] = if backwards[a] { (base.shape()[a] - 1) as f64 } else { 0.0 };
            }
            let origin = base.affine().to_world(VoxelPoint(first)).0;
            let rows = std::array::from_fn(|r| [columns[0][r], columns[1][r], columns[2][r], origin[r]]);
            let grid = Grid::new(shape, Affine::new(rows).unwrap()).unwrap();
            let found = Orientation::of(&grid);
            assert_eq!(found, made);
            let stored = found.stored(&canonical, &grid);
            let back = found.turned(&stored);
            assert_eq!(back.as_slice(), canonical.as_slice());
            assert!(back.grid().same_as(&base));
            for at in 0..grid.len() {
                let v = grid.voxel(at);
                let there = found.offset(shape, v);
                assert_eq!(stored.as_slice()[at], there as f32);
                let [c, s] = [base.voxel(there), v].map(|v| v.map(|i| i as f64));
                let apart = base.affine().to_world(VoxelPoint(c)).minus(grid.affine().to_world(VoxelPoint(s)));
                assert!(apart.iter().all(|d| d.abs() < 1e-12), "{apart:?}");
            }
        }
    }
}
