//! Displacement gradients by least squares over a gauge length.
//!
//! The gradient at a voxel is the slope of the plane that fits the displacements in a cube about it
//! best, from the voxels of its own body. This is the window method of digital image correlation
//! (Pan et al. 2009, Optics and Lasers in Engineering 47:865); the side of the cube is the gauge
//! length, there called the virtual strain gauge (iDICs Good Practices Guide 2018, section 5.4).
//! Sums over the cube run along one axis after the other, so that a long gauge costs no more than a
//! short one.

use crate::numerics::symmetric3::cholesky_solve;
use crate::types::Displacement;
use crate::types::space::{Grid, Matrix3};
use rayon::prelude::*;

/// The cube of voxels over which a gradient is taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Gauge {
    /// Voxels to either side of the centre along each axis; 0 along a flat one.
    pub half: [usize; 3],
}

impl Gauge {
    /// The cube of about this side (mm), at least the neighbours of a voxel.
    ///
    /// ```
    /// use palpate::strain::gauge::Gauge;
    /// use palpate::{Affine, Grid};
    /// let grid = Grid::new([64, 64, 20], Affine::scaled([1.0, 1.0, 5.0], [0.0; 3])?)?;
    /// let gauge = Gauge::of_length(&grid, 6.0);
    /// assert_eq!(gauge.half, [3, 3, 1]);
    /// assert_eq!(gauge.length_mm(&grid), [6.0, 6.0, 10.0]);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn of_length(grid: &Grid, length_mm: f64) -> Self {
        let (shape, spacing) = (grid.shape(), grid.spacing());
        let half = |a: usize| ((length_mm / (2.0 * spacing[a])).round() as usize).clamp(1, shape[a]);
        Self { half: std::array::from_fn(|a| if shape[a] > 1 { half(a) } else { 0 }) }
    }

    /// A voxel and its neighbours.
    pub fn shortest(grid: &Grid) -> Self {
        Self::of_length(grid, 0.0)
    }

    /// Its side along each axis (mm); 0 along a flat one.
    pub fn length_mm(&self, grid: &Grid) -> [f64; 3] {
        let spacing = grid.spacing();
        std::array::from_fn(|a| 2.0 * self.half[a] as f64 * spacing[a])
    }

    /// Its side along the finest thick axis (mm).
    pub(crate) fn finest_mm(&self, grid: &Grid) -> f64 {
        let sides = self.length_mm(grid);
        (0..3).filter(|&a| self.half[a] > 0).map(|a| sides[a]).fold(f64::INFINITY, f64::min)
    }

    /// Voxels in the cube.
    pub fn voxels(&self) -> usize {
        self.half.iter().map(|h| 2 * h + 1).product()
    }

    /// Standard deviation of a slope along an axis (1/mm), over that of white noise in the values:
    /// of the axis where it is largest.
    pub(crate) fn slope_noise(&self, grid: &Grid) -> f64 {
        let spacing = grid.spacing();
        let along = |a: usize| {
            let h = self.half[a] as f64;
            1.0 / (spacing[a] * (self.voxels() as f64 * h * (h + 1.0) / 3.0).sqrt())
        };
        (0..3).filter(|&a| self.half[a] > 0).map(along).fold(0.0, f64::max)
    }
}

/// Sums over a plane's window: of 1, x, y, xx, yy, xy, then of u, xu, yu for each component.
const PLANE_SUMS: usize = 15;
/// The same with z: 1, x, y, z, xx, yy, zz, xy, xz, yz, then u, xu, yu, zu for each component.
const CUBE_SUMS: usize = 22;
/// Planes processed by one thread at a time.
const PLANES_PER_TASK: usize = 8;

/// What `f` makes of the displacement gradient at each voxel (rows: components of u, columns: world
/// axes; 1), x fastest. `bodies` holds a label for each voxel; it is the default value where that
/// is 0, and one body everywhere when empty. Along an axis that a body has one voxel of, the
/// gradient is 0.
pub fn map_gradients<T: Clone + Default + Send + Sync>(
    field: &Displacement<'_>,
    bodies: &[u8],
    gauge: Gauge,
    f: impl Fn(usize, &Matrix3) -> T + Sync,
) -> Vec<T> {
    let grid = *field.grid();
    let [nx, ny, _] = grid.shape();
    let plane = nx * ny;
    let mut seen = [false; 256];
    bodies.iter().for_each(|&l| seen[usize::from(l)] = true);
    let labels: Vec<u8> = (1..=255).filter(|&l| seen[usize::from(l)]).collect();
    let one = bodies.is_empty().then_some(1);
    let mut out = vec![T::default(); grid.len()];
    out.par_chunks_mut(PLANES_PER_TASK * plane).enumerate().for_each(|(slab, out)| {
        for label in one.iter().chain(&labels) {
            let mut sums = Sums::new(field, bodies, *label, gauge);
            for (at, out) in out.chunks_exact_mut(plane).enumerate() {
                sums.go_to(slab * PLANES_PER_TASK + at);
                sums.each(|within, gradient| out[within] = f((slab * PLANES_PER_TASK + at) * plane + within, gradient));
            }
        }
    });
    out
}

/// The sums over the cube about each voxel of a plane, moved from plane to plane.
struct Sums<'a> {
    field: &'a Displacement<'a>,
    bodies: &'a [u8],
    label: u8,
    gauge: Gauge,
    /// The plane at hand, once there is one.
    plane: Option<usize>,
    cube: Vec<[f64; CUBE_SUMS]>,
}

impl<'a> Sums<'a> {
    fn new(field: &'a Displacement<'a>, bodies: &'a [u8], label: u8, gauge: Gauge) -> Self {
        Self { field, bodies, label, gauge, plane: None, cube: Vec::new() }
    }

    fn belongs(&self, at: usize) -> bool {
        self.bodies.is_empty() || self.bodies[at] == self.label
    }

    /// Moves the cubes to those about plane `k`, from the plane below where that is at hand.
    fn go_to(&mut self, k: usize) {
        let [nx, ny, nz] = self.field.grid().shape();
        let half = self.gauge.half[2];
        match self.plane {
            Some(before) if before + 1 == k => {
                if k > half {
                    self.add(k - half - 1, -1.0);
                }
                if k + half < nz {
                    self.add(k + half, 1.0);
                }
            }
            _ => {
                self.cube = vec![[0.0; CUBE_SUMS]; nx * ny];
                (k.saturating_sub(half)..(k + half + 1).min(nz)).for_each(|k| self.add(k, 1.0));
            }
        }
        self.plane = Some(k);
    }

    /// Adds the windows of plane `k` to the cubes, or takes them away.
    fn add(&mut self, k: usize, sign: f64) {
        let [nx, ny, _] = self.field.grid().shape();
        let from = k * nx * ny;
        if !(from..from + nx * ny).any(|at| self.belongs(at)) {
            return;
        }
        let [hx, hy, _] = self.gauge.half;
        let rows: Vec<Vec<[f64; PLANE_SUMS]>> = (0..ny).map(|j| self.row(from + j * nx, j, hx)).collect();
        let z = k as f64;
        let mut window = vec![[0.0; PLANE_SUMS]; nx];
        rows[..hy.min(ny)].iter().for_each(|row| add_row(&mut window, row, 1.0));
        for j in 0..ny {
            if j + hy < ny {
                add_row(&mut window, &rows[j + hy], 1.0);
            }
            if j > hy {
                add_row(&mut window, &rows[j - hy - 1], -1.0);
            }
            for (cube, w) in self.cube[j * nx..(j + 1) * nx].iter_mut().zip(&window) {
                let [m, x, y, xx, yy, xy] = [w[0], w[1], w[2], w[3], w[4], w[5]];
                let shape = [m, x, y, z * m, xx, yy, z * z * m, xy, z * x, z * y];
                cube.iter_mut().zip(shape).for_each(|(c, v)| *c += sign * v);
                for c in 0..3 {
                    let [u, xu, yu] = [w[6 + 3 * c], w[7 + 3 * c], w[8 + 3 * c]];
                    cube[10 + 4 * c..].iter_mut().zip([u, xu, yu, z * u]).for_each(|(c, v)| *c += sign * v);
                }
            }
        }
    }

    /// The sums of a row's windows along x.
    fn row(&self, from: usize, j: usize, half: usize) -> Vec<[f64; PLANE_SUMS]> {
        let nx = self.field.grid().shape()[0];
        let y = j as f64;
        let of = |i: usize| {
            let mut out = [0.0; PLANE_SUMS];
            if self.belongs(from + i) {
                let x = i as f64;
                let u = self.field.at(from + i).map(f64::from);
                out[..6].copy_from_slice(&[1.0, x, y, x * x, y * y, x * y]);
                (0..3).for_each(|c| out[6 + 3 * c..9 + 3 * c].copy_from_slice(&[u[c], x * u[c], y * u[c]]));
            }
            out
        };
        let single: Vec<[f64; PLANE_SUMS]> = (0..nx).map(of).collect();
        let mut window = [0.0; PLANE_SUMS];
        single[..half.min(nx)].iter().for_each(|values| add_to(&mut window, values, 1.0));
        let mut out = Vec::with_capacity(nx);
        for i in 0..nx {
            if i + half < nx {
                add_to(&mut window, &single[i + half], 1.0);
            }
            if i > half {
                add_to(&mut window, &single[i - half - 1], -1.0);
            }
            out.push(window);
        }
        out
    }

    /// Calls `f` with the place in the plane and the gradient at each voxel of the body.
    fn each(&self, mut f: impl FnMut(usize, &Matrix3)) {
        let Some(k) = self.plane else { return };
        let grid = self.field.grid();
        let inverse = grid.affine().inverse_linear();
        let from = k * self.cube.len();
        for (within, s) in self.cube.iter().enumerate().filter(|(within, _)| self.belongs(from + within)) {
            let slopes = slopes(s);
            let gradient = slopes
                .map(|by_voxel| std::array::from_fn(|w| (0..3).map(|a| by_voxel[a] * inverse[a][w]).sum::<f64>()));
            f(within, &gradient);
        }
    }
}

fn add_to(window: &mut [f64; PLANE_SUMS], values: &[f64; PLANE_SUMS], sign: f64) {
    window.iter_mut().zip(values).for_each(|(w, v)| *w += sign * v);
}

fn add_row(window: &mut [[f64; PLANE_SUMS]], row: &[[f64; PLANE_SUMS]], sign: f64) {
    window.iter_mut().zip(row).for_each(|(w, v)| add_to(w, v, sign));
}

/// The slopes of each component along the voxel axes (mm a voxel).
fn slopes(s: &[f64; CUBE_SUMS]) -> Matrix3 {
    let n = s[0].max(1.0);
    let [x, y, z] = [s[1] / n, s[2] / n, s[3] / n];
    let spread = [s[4] / n - x * x, s[5] / n - y * y, s[6] / n - z * z];
    let [xy, xz, yz] = [s[7] / n - x * y, s[8] / n - x * z, s[9] / n - y * z];
    // An axis without spread has no slope; a small ridge leaves it at 0.
    let ridge = 1e-9 * spread.iter().sum::<f64>() + 1e-12;
    let matrix = [[spread[0] + ridge, xy, xz], [xy, spread[1] + ridge, yz], [xz, yz, spread[2] + ridge]];
    std::array::from_fn(|c| {
        let [u, xu, yu, zu] = std::array::from_fn(|q| s[10 + 4 * c + q] / n);
        cholesky_solve(matrix, [xu - x * u, yu - y * u, zu - z * u]).unwrap_or([0.0; 3])
    })
}
