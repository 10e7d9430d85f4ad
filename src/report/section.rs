//! A plane cut through a grid, in the nearest canonical orientation.
//!
//! The voxel axis that lies closest to each of right, front and up stands for it, with its sign, so
//! that any affine, oblique or flipped, is shown the same way up. Pixels keep the voxels'
//! proportions; nothing is interpolated.

use crate::types::{Grid, VoxelPoint, WorldPoint};

/// Pixels along the longer side at most; longer sides are averaged down.
const MAX_PIXELS: usize = 320;

/// The three orthogonal planes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Plane {
    /// Right (x) to the right, front (y) up.
    Axial,
    /// Right (x) to the right, head (z) up.
    Coronal,
    /// Front (y) to the right, head (z) up.
    Sagittal,
}

impl Plane {
    /// The world axes (0 = x, 1 = y, 2 = z) to the right, up, and through the picture.
    fn axes(self) -> [usize; 3] {
        match self {
            Plane::Axial => [0, 1, 2],
            Plane::Coronal => [0, 2, 1],
            Plane::Sagittal => [1, 2, 0],
        }
    }

    /// Its name in lower case.
    pub fn name(self) -> &'static str {
        match self {
            Plane::Axial => "axial",
            Plane::Coronal => "coronal",
            Plane::Sagittal => "sagittal",
        }
    }

    /// What lies to the left, right, top and bottom: L, R, A, P, S or I.
    pub fn labels(self) -> [&'static str; 4] {
        const ENDS: [[&str; 2]; 3] = [["L", "R"], ["P", "A"], ["I", "S"]];
        let [h, v, _] = self.axes();
        [ENDS[h][0], ENDS[h][1], ENDS[v][1], ENDS[v][0]]
    }
}

/// A voxel axis that stands for a world axis.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Axis {
    /// 0, 1 or 2.
    voxel: usize,
    /// Whether it runs against the world axis.
    reversed: bool,
    /// Voxels along it.
    len: usize,
    /// Millimetres a voxel.
    spacing: f64,
}

impl Axis {
    /// Position along the world direction, from a position in voxels.
    fn canonical(&self, voxel: f64) -> f64 {
        if self.reversed { (self.len - 1) as f64 - voxel } else { voxel }
    }
}

/// The voxel axes nearest to right, front and up.
fn canonical_axes(grid: &Grid) -> [Axis; 3] {
    const ORDERS: [[usize; 3]; 6] = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];
    let (linear, spacing, shape) = (grid.affine().linear(), grid.spacing(), grid.shape());
    let alignment = |o: &[usize; 3]| (0..3).map(|w| linear[w][o[w]].abs() / spacing[o[w]]).sum::<f64>();
    let best =
        ORDERS.into_iter().fold(ORDERS[0], |best, o| if alignment(&o) > alignment(&best) + 1e-9 { o } else { best });
    std::array::from_fn(|w| {
        let voxel = best[w];
        Axis { voxel, reversed: linear[w][voxel] < 0.0, len: shape[voxel], spacing: spacing[voxel] }
    })
}

/// A grid seen along right, front and up: places are mm from its first corner along the voxel axes
/// nearest to these.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Canonical {
    grid: Grid,
    axes: [Axis; 3],
}

impl Canonical {
    /// Of `grid`.
    pub fn of(grid: &Grid) -> Self {
        Self { grid: *grid, axes: canonical_axes(grid) }
    }

    /// Voxels to the right, front and up.
    pub fn shape(&self) -> [usize; 3] {
        self.axes.map(|a| a.len)
    }

    /// Their size (mm).
    pub fn spacing(&self) -> [f64; 3] {
        self.axes.map(|a| a.spacing)
    }

    /// The whole extent (mm).
    pub(crate) fn extent_mm(&self) -> [f64; 3] {
        self.axes.map(|a| a.len as f64 * a.spacing)
    }

    /// Voxel offset (x fastest on disk) of the voxel `at` along right, front and up.
    pub fn offset(&self, at: [usize; 3]) -> usize {
        let mut voxel = [0; 3];
        for (a, at) in self.axes.iter().zip(at) {
            voxel[a.voxel] = if a.reversed { a.len - 1 - at } else { at };
        }
        self.grid.index(voxel[0], voxel[1], voxel[2])
    }

    /// A place (mm, RAS) as mm from the first corner.
    pub fn place(&self, p: WorldPoint) -> [f64; 3] {
        let voxel = self.grid.affine().to_voxel(p).0;
        self.axes.map(|a| (a.canonical(voxel[a.voxel]) + 0.5) * a.spacing)
    }

    /// A displacement (mm, RAS) along the three axes (mm).
    pub fn direct(&self, d: [f64; 3]) -> [f64; 3] {
        let voxel = self.grid.affine().vector_to_voxel(d);
        self.axes.map(|a| voxel[a.voxel] * a.spacing * if a.reversed { -1.0 } else { 1.0 })
    }

    /// Three rows of the matrix from a place to the world (mm, RAS).
    pub fn to_world(self) -> [[f64; 4]; 3] {
        let affine = self.grid.affine();
        let mut first = [0.0; 3];
        for a in &self.axes {
            first[a.voxel] = if a.reversed { a.len as f64 - 0.5 } else { -0.5 };
        }
        let corner = affine.to_world(VoxelPoint(first)).0;
        let along = self.axes.map(|a| {
            let mut step = [0.0; 3];
            step[a.voxel] = if a.reversed { -1.0 } else { 1.0 } / a.spacing;
            affine.vector_to_world(step)
        });
        std::array::from_fn(|r| [along[0][r], along[1][r], along[2][r], corner[r]])
    }

    /// The planes that are more than one voxel wide and high.
    pub(crate) fn planes(&self) -> Vec<Plane> {
        let thick = |p: &Plane| p.axes()[..2].iter().all(|&w| self.axes[w].len > 1);
        [Plane::Axial, Plane::Coronal, Plane::Sagittal].into_iter().filter(thick).collect()
    }

    /// Extent of a plane to the right and down (mm).
    pub(crate) fn size_mm(&self, plane: Plane) -> [f64; 2] {
        let [h, v, _] = plane.axes();
        [h, v].map(|w| self.extent_mm()[w])
    }
}

/// One plane of voxels, as a picture: pixel (0, 0) is its upper left corner.
#[derive(Debug, Clone, PartialEq)]
pub struct Section {
    /// Which plane.
    pub plane: Plane,
    /// Pixels to the right.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    grid: Grid,
    /// To the right, up, through.
    axes: [Axis; 3],
    /// Voxel number along the third axis.
    index: usize,
    /// Voxels a pixel.
    step: usize,
}

impl Section {
    /// The planes through the voxel nearest to `centre` (mm); only those more than one voxel wide
    /// and high.
    pub fn through(grid: &Grid, centre: WorldPoint) -> Vec<Section> {
        let axes = canonical_axes(grid);
        let at = grid.affine().to_voxel(centre).0;
        let cut = |plane: Plane| {
            let axes = plane.axes().map(|w| axes[w]);
            let step = axes[0].len.max(axes[1].len).div_ceil(MAX_PIXELS);
            let index = at[axes[2].voxel].round().clamp(0.0, (axes[2].len - 1) as f64) as usize;
            let [width, height] = [axes[0], axes[1]].map(|a| a.len.div_ceil(step));
            Section { plane, width, height, grid: *grid, axes, index, step }
        };
        let planes = [Plane::Axial, Plane::Coronal, Plane::Sagittal].map(cut);
        planes.into_iter().filter(|s| s.axes[0].len > 1 && s.axes[1].len > 1).collect()
    }

    /// Extent to the right and down (mm).
    pub(crate) fn size_mm(&self) -> [f64; 2] {
        let pixels = [self.width, self.height];
        [0, 1].map(|i| (pixels[i] * self.step) as f64 * self.axes[i].spacing)
    }

    /// Voxel offset (x fastest) at a distance of `right` and `down` voxels from the upper left
    /// corner.
    fn offset(&self, right: usize, down: usize) -> usize {
        let [h, v, n] = self.axes;
        let mut voxel = [0; 3];
        voxel[h.voxel] = if h.reversed { h.len - 1 - right } else { right };
        voxel[v.voxel] = if v.reversed { down } else { v.len - 1 - down };
        voxel[n.voxel] = self.index;
        self.grid.index(voxel[0], voxel[1], voxel[2])
    }

    /// One number a pixel, row by row: the mean of `value` over the pixel's voxels that have one.
    pub fn sample(&self, value: impl Fn(usize) -> Option<f32>) -> Vec<Option<f32>> {
        let [w, h] = [self.axes[0].len, self.axes[1].len];
        let span = |at: usize, len: usize| at * self.step..((at + 1) * self.step).min(len);
        let mean = |px: usize, py: usize| {
            let (mut sum, mut count) = (0.0f64, 0u32);
            for down in span(py, h) {
                for right in span(px, w) {
                    if let Some(v) = value(self.offset(right, down)).filter(|v| v.is_finite()) {
                        sum += f64::from(v);
                        count += 1;
                    }
                }
            }
            (count > 0).then(|| (sum / f64::from(count)) as f32)
        };
        (0..self.height).flat_map(|py| (0..self.width).map(move |px| (px, py))).map(|(px, py)| mean(px, py)).collect()
    }

    /// Where a place is drawn, in mm to the right and down from the upper left corner, and how far
    /// it lies behind the plane (mm, signed).
    pub fn place(&self, p: WorldPoint) -> ([f64; 2], f64) {
        let voxel = self.grid.affine().to_voxel(p).0;
        let [h, v, n] = self.axes;
        let right = (h.canonical(voxel[h.voxel]) + 0.5) * h.spacing;
        let down = ((v.len - 1) as f64 - v.canonical(voxel[v.voxel]) + 0.5) * v.spacing;
        ([right, down], (voxel[n.voxel] - self.index as f64) * n.spacing)
    }

    /// A displacement (mm, RAS) as drawn: mm to the right and down, the part out of the plane left
    /// out.
    pub fn direct(&self, d: [f64; 3]) -> [f64; 2] {
        let voxel = self.grid.affine().vector_to_voxel(d);
        let along = |a: &Axis| voxel[a.voxel] * a.spacing * if a.reversed { -1.0 } else { 1.0 };
        [along(&self.axes[0]), -along(&self.axes[1])]
    }

    /// Voxel offsets on an even lattice with about `across` nodes along the longer side, and the
    /// lattice's step (mm).
    pub fn lattice(&self, across: usize) -> (Vec<usize>, f64) {
        let (columns, step_mm) = self.columns(across);
        (columns.concat(), step_mm)
    }

    /// The same, column by column from the left, each from the top.
    pub fn columns(&self, across: usize) -> (Vec<Vec<usize>>, f64) {
        let [h, v, _] = self.axes;
        let step_mm = (h.len as f64 * h.spacing).max(v.len as f64 * v.spacing) / across.max(1) as f64;
        let stride = |a: &Axis| ((step_mm / a.spacing).round() as usize).max(1);
        let (sh, sv) = (stride(&h), stride(&v));
        let column = |right| (sv / 2..v.len).step_by(sv).map(|down| self.offset(right, down)).collect();
        ((sh / 2..h.len).step_by(sh).map(column).collect(), step_mm)
    }

    /// Thickness of the plane (mm).
    pub(crate) fn thickness_mm(&self) -> f64 {
        self.axes[2].spacing
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::types::Affine;

    /// World x runs along -k, world y along -i, world z along +j, as in many sagittal scans.
    fn flipped() -> Grid {
        let rows = [[0.0, 0.0, -3.0, 9.0], [-2.0, 0.0, 0.0, 6.0], [0.0, 1.0, 0.0, 0.0]];
        Grid::new([4, 5, 4], Affine::new(rows).unwrap()).unwrap()
    }

    #[test]
    fn pixels_run_right_and_down_whatever_the_affine() {
        let grid = flipped();
        let sections = Section::through(&grid, WorldPoint([3.0, 2.0, 1.0]));
        assert_eq!(sections.len(), 3);
        for s in &sections {
            let [h, v, n] = s.plane.axes();
            for (at, &value) in [h, v].iter().enumerate() {
                let world = |o: usize| grid.world(o % 4, o / 4 % 5, o / 20).0;
                let picture = s.sample(|o| Some(world(o)[value] as f32));
                let first = picture[0].unwrap();
                let next = if at == 0 { picture[1].unwrap() } else { picture[s.width].unwrap() };
                assert_eq!(next > first, at == 0, "{:?}: right grows, down falls", s.plane);
                assert!(s.sample(|o| Some(world(o)[n] as f32)).iter().all(|v| *v == Some([3.0, 2.0, 1.0][n])));
            }
        }
        assert_eq!(sections[0].size_mm(), [12.0, 8.0]);
        assert_eq!(sections[1].size_mm(), [12.0, 5.0]);
    }

    #[test]
    fn a_place_is_drawn_where_its_voxel_is() {
        let grid = flipped();
        let s = &Section::through(&grid, WorldPoint([3.0, 2.0, 1.0]))[0];
        // Highest y, lowest x is the upper left pixel: its centre lies half a voxel in.
        let (at, behind) = s.place(WorldPoint([0.0, 6.0, 1.0]));
        assert_eq!(at, [1.5, 1.0]);
        assert_eq!(behind, 0.0);
        assert_eq!(s.direct([1.0, 2.0, 3.0]), [1.0, -2.0]);
    }

    #[test]
    fn one_slice_gives_one_plane_and_large_ones_are_averaged_down() {
        let grid = Grid::new([700, 500, 1], Affine::scaled([0.5, 0.5, 5.0], [0.0; 3]).unwrap()).unwrap();
        let s = Section::through(&grid, WorldPoint([0.0; 3]));
        assert_eq!(s.len(), 1);
        assert_eq!((s[0].plane, s[0].width, s[0].height), (Plane::Axial, 234, 167));
        assert_eq!(s[0].sample(|_| Some(2.0)), vec![Some(2.0); 234 * 167]);
        assert_eq!(s[0].plane.labels(), ["L", "R", "A", "P"]);
    }
}
