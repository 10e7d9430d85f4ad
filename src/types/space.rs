//! Frames: voxel indices, world millimetres (RAS), and the affine between them.
//!
//! The two kinds of point are different types, so that one cannot be used for the other. A
//! *displacement* points from the initial to the deformed place of the same tissue. A plain
//! `[f64; 3]` is a displacement in world millimetres; one along the axes of a lattice is a
//! [`GridVector`], which [`Grid::vector_to_world`] turns into the former.

use crate::error::SpaceError;

/// A position in voxels: the centre of voxel `(i, j, k)` is `[i, j, k]`; fractions lie between
/// centres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VoxelPoint(pub [f64; 3]);

impl VoxelPoint {
    /// The middle of a voxel.
    pub(crate) fn of(voxel: [usize; 3]) -> Self {
        Self(voxel.map(|v| v as f64))
    }

    /// The same place in mm along the axes, from the first voxel's middle; voxels have edges of
    /// `spacing` (mm).
    pub(crate) fn in_mm(self, spacing: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|a| self.0[a] * spacing[a])
    }

    /// This place moved by `d`, on a grid whose voxels have edges of `spacing` (mm).
    pub(crate) fn moved(self, d: GridVector, spacing: [f64; 3]) -> Self {
        Self(std::array::from_fn(|a| self.0[a] + d.0[a] / spacing[a]))
    }
}

/// A position in world millimetres, RAS: x grows to the patient's right, y to the front, z to the
/// head.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WorldPoint(pub [f64; 3]);

impl WorldPoint {
    /// This point moved by `d` (mm).
    ///
    /// ```
    /// use palpate::WorldPoint;
    /// let (before, after) = (WorldPoint([1.0, 2.0, 3.0]), WorldPoint([1.5, 2.0, 1.0]));
    /// let u = after.minus(before);
    /// assert_eq!(u, [0.5, 0.0, -2.0]);
    /// assert_eq!(before.moved(u), after);
    /// ```
    pub fn moved(self, d: [f64; 3]) -> WorldPoint {
        WorldPoint([self.0[0] + d[0], self.0[1] + d[1], self.0[2] + d[2]])
    }

    /// The vector from `other` to this point (mm).
    pub fn minus(self, other: WorldPoint) -> [f64; 3] {
        [self.0[0] - other.0[0], self.0[1] - other.0[1], self.0[2] - other.0[2]]
    }
}

/// A displacement in millimetres along the axes of a grid: matching works in this frame.
///
/// It equals the world displacement only where the grid's axes run right, anterior and superior.
/// [`Grid::vector_to_world`] converts it.
///
/// A field does not take it for a displacement in world mm:
///
/// ```compile_fail
/// use palpate::{DenseField, Grid, GridVector};
/// fn field(grid: Grid, found: GridVector) -> DenseField {
///     DenseField::from_fn(grid, |_| found)
/// }
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GridVector(pub [f64; 3]);

impl GridVector {
    /// No displacement.
    pub(crate) const ZERO: Self = Self([0.0; 3]);

    /// Both displacements, one after the other.
    pub(crate) fn plus(self, other: Self) -> Self {
        Self(std::array::from_fn(|a| self.0[a] + other.0[a]))
    }

    /// What leads from `other` to this one.
    pub(crate) fn minus(self, other: Self) -> Self {
        Self(std::array::from_fn(|a| self.0[a] - other.0[a]))
    }
}

/// A 3 x 3 matrix, row by row.
pub type Matrix3 = [[f64; 3]; 3];

/// The invertible affine map from voxels to world millimetres: `world = linear * voxel + origin`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Affine {
    linear: Matrix3,
    origin: [f64; 3],
    inverse: Matrix3,
}

/// The determinant of `m`.
pub fn determinant(m: &Matrix3) -> f64 {
    m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1]) - m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0])
        + m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0])
}

/// The scalar product of two vectors.
#[inline]
pub fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// The vector product of two vectors.
#[inline]
pub fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// The length of a vector.
#[inline]
pub fn length(v: [f64; 3]) -> f64 {
    dot(v, v).sqrt()
}

/// The product of a matrix with a vector.
#[inline]
pub(crate) fn matvec(a: &Matrix3, b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|r| a[r][0] * b[0] + a[r][1] * b[1] + a[r][2] * b[2])
}

/// The identity.
const UNIT: Matrix3 = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

/// The product of two matrices.
#[inline]
pub(crate) fn matmul(a: &Matrix3, b: &Matrix3) -> Matrix3 {
    std::array::from_fn(|r| std::array::from_fn(|c| a[r][0] * b[0][c] + a[r][1] * b[1][c] + a[r][2] * b[2][c]))
}

impl Affine {
    /// From the upper three rows of the homogeneous 4 x 4 matrix (mm a voxel, mm).
    ///
    /// # Errors
    /// [`SpaceError`] when an entry is not finite or the linear part is singular (relative
    /// determinant under 1e-9).
    pub fn new(rows: [[f64; 4]; 3]) -> Result<Self, SpaceError> {
        if rows.iter().flatten().any(|v| !v.is_finite()) {
            return Err(SpaceError::NotFinite);
        }
        let m: Matrix3 = std::array::from_fn(|r| [rows[r][0], rows[r][1], rows[r][2]]);
        let det = determinant(&m);
        let scale: f64 = (0..3).map(|c| (0..3).map(|r| m[r][c] * m[r][c]).sum::<f64>().sqrt()).product();
        // `<=` also catches a zero column, where both sides are zero.
        if !det.is_finite() || det.abs() <= 1e-9 * scale || scale == 0.0 {
            return Err(SpaceError::Singular { determinant: det });
        }
        let inverse: Matrix3 = std::array::from_fn(|r| {
            std::array::from_fn(|c| {
                let (a, b) = ((c + 1) % 3, (c + 2) % 3);
                let (p, q) = ((r + 1) % 3, (r + 2) % 3);
                (m[a][p] * m[b][q] - m[a][q] * m[b][p]) / det
            })
        });
        Ok(Self { linear: m, origin: std::array::from_fn(|r| rows[r][3]), inverse })
    }

    /// The same numbers in both frames.
    pub(super) const IDENTITY: Self = Self { linear: UNIT, origin: [0.0; 3], inverse: UNIT };

    /// The affine that undoes this one. (Its frames are the same two, the other way round.)
    pub(super) fn inverted(&self) -> Self {
        let origin = matvec(&self.inverse, self.origin).map(|v| 0.0 - v);
        Self { linear: self.inverse, origin, inverse: self.linear }
    }

    /// This affine, then `next`.
    pub(super) fn then(&self, next: &Self) -> Self {
        let origin = WorldPoint(matvec(&next.linear, self.origin)).moved(next.origin).0;
        Self { linear: matmul(&next.linear, &self.linear), origin, inverse: matmul(&self.inverse, &next.inverse) }
    }

    /// Axis-aligned: `spacing` mm a voxel, the first voxel's centre at `origin` (mm).
    ///
    /// # Errors
    /// As [`Affine::new`].
    ///
    /// ```
    /// use palpate::{Affine, VoxelPoint, WorldPoint};
    /// let affine = Affine::scaled([1.5, 1.5, 5.0], [-70.0, -60.0, 0.0])?;
    /// assert_eq!(affine.to_world(VoxelPoint([10.0, 0.0, 2.0])), WorldPoint([-55.0, -60.0, 10.0]));
    /// assert_eq!(affine.to_voxel(WorldPoint([-55.0, -60.0, 10.0])), VoxelPoint([10.0, 0.0, 2.0]));
    /// // An axis without length has no inverse.
    /// assert!(Affine::scaled([1.0, 1.0, 0.0], [0.0; 3]).is_err());
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn scaled(spacing: [f64; 3], origin: [f64; 3]) -> Result<Self, SpaceError> {
        let mut rows = [[0.0; 4]; 3];
        for a in 0..3 {
            rows[a][a] = spacing[a];
            rows[a][3] = origin[a];
        }
        Self::new(rows)
    }

    /// The upper three rows of the homogeneous matrix.
    pub fn rows(&self) -> [[f64; 4]; 3] {
        std::array::from_fn(|r| [self.linear[r][0], self.linear[r][1], self.linear[r][2], self.origin[r]])
    }

    /// The linear part (mm a voxel).
    pub fn linear(&self) -> &Matrix3 {
        &self.linear
    }

    /// The inverse of the linear part (voxels a mm).
    pub fn inverse_linear(&self) -> &Matrix3 {
        &self.inverse
    }

    /// World position of the centre of voxel `(0, 0, 0)` (mm).
    pub fn origin(&self) -> WorldPoint {
        WorldPoint(self.origin)
    }

    /// Lengths of the voxel's edges (mm).
    pub fn spacing(&self) -> [f64; 3] {
        std::array::from_fn(|c| (0..3).map(|r| self.linear[r][c] * self.linear[r][c]).sum::<f64>().sqrt())
    }

    /// Voxel to world (mm).
    pub fn to_world(&self, p: VoxelPoint) -> WorldPoint {
        WorldPoint(matvec(&self.linear, p.0)).moved(self.origin)
    }

    /// World (mm) to voxel.
    pub fn to_voxel(&self, p: WorldPoint) -> VoxelPoint {
        VoxelPoint(matvec(&self.inverse, p.minus(self.origin())))
    }

    /// A displacement in voxels as one in world mm (the origin plays no part).
    pub fn vector_to_world(&self, d: [f64; 3]) -> [f64; 3] {
        matvec(&self.linear, d)
    }

    /// A displacement in world mm as one in voxels.
    pub fn vector_to_voxel(&self, d: [f64; 3]) -> [f64; 3] {
        matvec(&self.inverse, d)
    }
}

/// The lattice of a volume: how many voxels along each axis, and where they are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Grid {
    shape: [usize; 3],
    affine: Affine,
}

impl Grid {
    /// A lattice of `shape` voxels placed by `affine`.
    ///
    /// # Errors
    /// [`SpaceError::Empty`] when a side is zero, [`SpaceError::TooLarge`] past 2^31 voxels.
    ///
    /// ```
    /// use palpate::{Affine, Grid, SpaceError};
    /// let affine = Affine::scaled([2.0; 3], [0.0; 3])?;
    /// assert_eq!(Grid::new([64, 64, 20], affine)?.len(), 81_920);
    /// assert!(matches!(Grid::new([64, 0, 20], affine), Err(SpaceError::Empty { .. })));
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn new(shape: [usize; 3], affine: Affine) -> Result<Self, SpaceError> {
        if shape.contains(&0) {
            return Err(SpaceError::Empty { shape });
        }
        match shape.iter().try_fold(1usize, |n, &s| n.checked_mul(s)) {
            Some(n) if n <= 1 << 31 => Ok(Self { shape, affine }),
            _ => Err(SpaceError::TooLarge { shape }),
        }
    }

    /// Voxels along x, y, z.
    pub fn shape(&self) -> [usize; 3] {
        self.shape
    }

    /// Voxel-to-world affine.
    pub fn affine(&self) -> &Affine {
        &self.affine
    }

    /// Edge lengths of a voxel (mm).
    pub fn spacing(&self) -> [f64; 3] {
        self.affine.spacing()
    }

    /// Unit vectors along the grid's axes, one a column (world RAS).
    pub fn axes(&self) -> Matrix3 {
        let (spacing, linear) = (self.spacing(), self.affine.linear());
        std::array::from_fn(|r| std::array::from_fn(|a| linear[r][a] / spacing[a]))
    }

    /// A displacement along the grid's axes (mm) as one in world mm (RAS).
    ///
    /// ```
    /// use palpate::{Affine, Grid, GridVector};
    /// // Voxels stored from right to left: their first axis points to the patient's left.
    /// let flipped =
    ///     Affine::new([[-1.0, 0.0, 0.0, 31.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])?;
    /// let grid = Grid::new([32, 32, 32], flipped)?;
    /// assert_eq!(grid.vector_to_world(GridVector([2.0, 0.5, 0.0])), [-2.0, 0.5, 0.0]);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn vector_to_world(&self, d: GridVector) -> [f64; 3] {
        let axes = self.axes();
        std::array::from_fn(|r| (0..3).map(|a| axes[r][a] * d.0[a]).sum())
    }

    /// A displacement in world mm (RAS) as one along the grid's axes (mm).
    ///
    /// ```
    /// use palpate::{Affine, Grid};
    /// let grid = Grid::new([8, 8, 4], Affine::scaled([1.0, 1.0, 2.5], [0.0; 3])?)?;
    /// let along = grid.vector_from_world([1.0, 0.0, 5.0]);
    /// assert_eq!(along.0, [1.0, 0.0, 5.0]);
    /// assert_eq!(grid.vector_to_world(along), [1.0, 0.0, 5.0]);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn vector_from_world(&self, d: [f64; 3]) -> GridVector {
        let (voxels, spacing) = (self.affine.vector_to_voxel(d), self.spacing());
        GridVector(std::array::from_fn(|a| voxels[a] * spacing[a]))
    }

    /// Shortest voxel edge (mm).
    pub fn least_spacing(&self) -> f64 {
        self.spacing().into_iter().fold(f64::INFINITY, f64::min)
    }

    /// Number of voxels.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Never true: a grid has at least one voxel.
    pub fn is_empty(&self) -> bool {
        false
    }

    /// Whether the volume is one slice, that is one voxel thick along some axis.
    pub fn is_single_slice(&self) -> bool {
        self.shape.contains(&1)
    }

    /// Offset of voxel `(i, j, k)` in x-fastest order (NIfTI's order on disk).
    ///
    /// ```
    /// use palpate::{Affine, Grid};
    /// let grid = Grid::new([4, 3, 2], Affine::scaled([1.0; 3], [0.0; 3])?)?;
    /// assert_eq!(grid.index(1, 2, 1), 1 + 4 * (2 + 3));
    /// assert_eq!(grid.voxel(grid.index(1, 2, 1)), [1, 2, 1]);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    #[inline]
    pub fn index(&self, i: usize, j: usize, k: usize) -> usize {
        i + self.shape[0] * (j + self.shape[1] * k)
    }

    /// The voxel `[i, j, k]` at an x-fastest offset.
    #[inline]
    pub fn voxel(&self, index: usize) -> [usize; 3] {
        let [nx, ny, _] = self.shape;
        [index % nx, index / nx % ny, index / (nx * ny)]
    }

    /// World position of a voxel's centre (mm).
    pub fn world(&self, i: usize, j: usize, k: usize) -> WorldPoint {
        self.affine.to_world(VoxelPoint([i as f64, j as f64, k as f64]))
    }

    /// The centre of the voxel at an offset (x fastest), in world mm.
    #[inline]
    pub fn centre(&self, offset: usize) -> WorldPoint {
        let [i, j, k] = self.voxel(offset);
        self.world(i, j, k)
    }

    /// Whether the two grids have the same shape and their corners coincide to 1e-3 of a voxel
    /// (NIfTI stores float32).
    ///
    /// ```
    /// use palpate::{Affine, Grid};
    /// let at = |x| Grid::new([8; 3], Affine::scaled([1.0; 3], [x, 0.0, 0.0])?);
    /// let grid = at(0.0)?;
    /// assert!(grid.same_as(&at(1e-5)?));
    /// assert!(!grid.same_as(&at(0.5)?));
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn same_as(&self, other: &Grid) -> bool {
        let far = |g: &Grid, c: usize| {
            let s = self.shape;
            let at = |a: usize| if c >> a & 1 == 1 { (s[a] - 1) as f64 } else { 0.0 };
            g.affine.to_world(VoxelPoint([at(0), at(1), at(2)]))
        };
        let tolerance = 1e-3 * self.least_spacing();
        self.shape == other.shape
            && (0..8).all(|c| far(self, c).minus(far(other, c)).iter().all(|d| d.abs() <= tolerance))
    }
}
