//! Directions of the tissue, along which strain has components of its own.

use crate::numerics::dense::symmetric_eigen;
use crate::types::space::{Matrix3, cross, dot, length};
use crate::types::{DenseField, Mask, WorldPoint};

/// Directions of the tissue.
#[derive(Debug, Clone, PartialEq, Default)]
pub enum Directions {
    /// None are known.
    #[default]
    Unknown,
    /// Fibres by voxel, vectors of any length (RAS); 0 where there are none.
    Fibres(DenseField),
    /// One direction of fibres for each of these labels (RAS).
    ByLabel(Vec<(u8, [f64; 3])>),
    /// Tubes: radial, circumferential and axial directions.
    Tubes(Vec<Tube>),
}

/// A label that is a tube about a straight axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tube {
    /// The label.
    pub label: u8,
    /// A place on the axis.
    pub centre: WorldPoint,
    /// Unit vector along it (RAS).
    pub axis: [f64; 3],
}

impl Tube {
    /// The tube of a label: its axis runs through the centre of its voxels, the way that they
    /// extend most. None when it has no voxels or extends nowhere.
    pub fn of(label: u8, labels: &Mask) -> Option<Self> {
        let grid = labels.grid();
        let own: Vec<[f64; 3]> =
            (0..grid.len()).filter(|&at| labels.as_slice()[at] == label).map(|at| grid.centre(at).0).collect();
        let n = own.len().max(1) as f64;
        let centre: [f64; 3] = std::array::from_fn(|a| own.iter().map(|p| p[a]).sum::<f64>() / n);
        let spread: Matrix3 = std::array::from_fn(|r| {
            std::array::from_fn(|c| own.iter().map(|p| (p[r] - centre[r]) * (p[c] - centre[c])).sum::<f64>() / n)
        });
        let pairs = symmetric_eigen(&spread);
        let (most, axis) = pairs.into_iter().max_by(|a, b| a.0.total_cmp(&b.0))?;
        (most > 0.0).then_some(Self { label, centre: WorldPoint(centre), axis })
    }

    /// Unit vectors outward from the axis, around it and along it; none on the axis itself.
    fn frame(&self, place: WorldPoint) -> Option<Matrix3> {
        let from = place.minus(self.centre);
        let along = dot(from, self.axis);
        let outward: [f64; 3] = std::array::from_fn(|a| from[a] - along * self.axis[a]);
        let radial = unit(outward)?;
        Some([radial, cross(self.axis, radial), self.axis])
    }
}

/// A vector at length 1; none of one that has no length.
pub fn unit(v: [f64; 3]) -> Option<[f64; 3]> {
    let size = length(v);
    (size > 1e-9 && size.is_finite()).then(|| v.map(|x| x / size))
}

impl Directions {
    /// What its components are called.
    pub fn names(&self) -> &'static [&'static str] {
        match self {
            Self::Unknown => &[],
            Self::Fibres(_) | Self::ByLabel(_) => &["fibre"],
            Self::Tubes(_) => &["radial", "circumferential", "axial"],
        }
    }

    /// A unit vector for each of the names at a voxel (offset, label and place), where it has them.
    pub fn at(&self, offset: usize, label: u8, place: WorldPoint) -> Option<Matrix3> {
        let alone = |v: [f64; 3]| unit(v).map(|v| [v, [0.0; 3], [0.0; 3]]);
        match self {
            Self::Unknown => None,
            Self::Fibres(field) => alone(field.at(offset).map(f64::from)),
            Self::ByLabel(known) => known.iter().find(|k| k.0 == label).and_then(|k| alone(k.1)),
            Self::Tubes(tubes) => tubes.iter().find(|t| t.label == label).and_then(|t| t.frame(place)),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::types::{Affine, Grid};

    #[test]
    fn a_tilted_tube_has_its_axis_and_frame() {
        let grid = Grid::new([40; 3], Affine::scaled([1.0; 3], [0.0; 3]).unwrap()).unwrap();
        let axis = unit([1.0, 2.0, 2.0]).unwrap();
        let inside = |p: WorldPoint| {
            let from = p.minus(WorldPoint([20.0; 3]));
            let along = dot(from, axis);
            let off: f64 = dot(from, from) - along * along;
            along.abs() < 16.0 && (9.0..36.0).contains(&off)
        };
        let labels = Mask::from_voxels(grid, |_, p| if inside(p) { 7 } else { 0 });
        let tube = Tube::of(7, &labels).unwrap();
        assert!(dot(tube.axis, axis).abs() > 0.9999);
        let [radial, around, along] = tube.frame(WorldPoint([26.0, 17.0, 20.0])).unwrap();
        for (a, b) in [(radial, around), (radial, along), (around, along)] {
            assert!(dot(a, b).abs() < 1e-9);
        }
        assert!(Tube::of(3, &labels).is_none() && tube.frame(tube.centre).is_none());
    }
}
