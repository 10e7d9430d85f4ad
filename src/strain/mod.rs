//! Strain from a displacement field, with its standard deviation.
//!
//! A displacement gradient is the slope of the least-squares plane through the displacements in a
//! cube about a voxel, the gauge ([`gauge`]). Its strain measures ([`measure`]) have a deviation
//! that follows from random draws of the field's error ([`deviation`]). Directions of the tissue
//! give components of their own ([`directions`]).

pub mod deviation;

pub mod directions;

pub mod gauge;

pub mod measure;

pub mod statistics;

use crate::numerics::symmetric3::eigenvalues;
use crate::types::space::{Grid, Matrix3};
use crate::types::{DenseField, StrainMeasure};

/// Strain at every voxel, axes in RAS.
#[derive(Debug, Clone, PartialEq)]
pub struct StrainField {
    grid: Grid,
    measure: StrainMeasure,
    /// xx, yy, zz, xy, xz, yz, one voxel after the other, x fastest.
    values: Vec<[f32; 6]>,
}

impl StrainField {
    /// Of a displacement field within `bodies` (a label for each voxel, 0 outside, where strain is
    /// 0; empty: one body everywhere): no displacement of one body enters the strain of another.
    ///
    /// ```
    /// use palpate::strain::{StrainField, gauge::Gauge};
    /// use palpate::{Affine, DenseField, Grid, StrainMeasure};
    /// let grid = Grid::new([8; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
    /// let field = DenseField::from_fn(grid, |p| [0.02 * p.0[0], 0.0, -0.01 * p.0[2]]);
    /// let strain = StrainField::of(&field, &[], Gauge::shortest(&grid), StrainMeasure::Small);
    /// let [largest, middle, smallest] = strain.principal(grid.index(4, 4, 4));
    /// assert!(
    ///     (largest - 0.02).abs() < 1e-5 && middle.abs() < 1e-5 && (smallest + 0.01).abs() < 1e-5
    /// );
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn of(field: &DenseField, bodies: &[u8], gauge: gauge::Gauge, measure: StrainMeasure) -> Self {
        let strain = |_: usize, g: &Matrix3| measure::tensor(measure, g).map(|v| v as f32);
        Self { grid: *field.grid(), measure, values: gauge::map_gradients(field, bodies, gauge, strain) }
    }

    /// The lattice.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// Which strain it is.
    pub fn measure(&self) -> StrainMeasure {
        self.measure
    }

    /// The tensors, x fastest: xx, yy, zz, xy, xz, yz (1).
    pub fn tensors(&self) -> &[[f32; 6]] {
        &self.values
    }

    /// The tensor at a voxel offset (1).
    pub fn at(&self, offset: usize) -> [f64; 6] {
        self.values[offset].map(f64::from)
    }

    /// Principal strains at a voxel offset, largest first (1).
    pub fn principal(&self, offset: usize) -> [f64; 3] {
        eigenvalues(&self.at(offset))
    }
}
