//! Rows of pictures: one quantity, cut in each plane, with its scale.

use crate::error::ReportError;
use crate::report::colormap::ColorMap;
use crate::report::picture::Picture;
use crate::report::scale::Scale;
use crate::report::section::Section;
use crate::report::statistics::{quantile, sample};
use crate::types::{DenseField, Mask, VoxelPoint, Voxels, WorldPoint};

/// One quantity in each plane.
#[derive(Debug, Clone, PartialEq)]
pub struct Panel {
    /// What is shown.
    pub title: String,
    /// What to look for, in a sentence; may be empty.
    pub note: String,
    /// Values and colours, where there are colours.
    pub scale: Option<Scale>,
    /// One a plane.
    pub pictures: Vec<Picture>,
}

impl Panel {
    /// The `value` at each voxel offset in gray, black at `range[0]` and white at `range[1]`.
    ///
    /// # Errors
    /// [`ReportError`] when a picture cannot be encoded.
    pub fn gray(
        title: &str,
        sections: &[Section],
        value: impl Fn(usize) -> f32,
        range: [f64; 2],
    ) -> Result<Self, ReportError> {
        let pictures = sections.iter().map(|s| Picture::gray(s, &value, range)).collect::<Result<_, _>>()?;
        Ok(Self { title: title.into(), note: String::new(), scale: None, pictures })
    }

    /// `value` in colour inside the mask (everywhere without one), the volume in gray around it.
    ///
    /// # Errors
    /// As [`Panel::gray`].
    pub(crate) fn coloured(
        title: &str,
        sections: &[Section],
        base: (&Voxels<'_>, [f64; 2]),
        mask: Option<&Mask>,
        scale: Scale,
        value: impl Fn(usize) -> f32,
    ) -> Result<Self, ReportError> {
        let gray = base.0.as_slice();
        let mask = mask.map(Mask::as_slice);
        let inside = |o: usize| mask.is_none_or(|m| m[o] > 0);
        let picture = |s| Picture::overlay(s, |o| gray[o], base.1, |o| inside(o).then(|| value(o)), &scale);
        let pictures = sections.iter().map(picture).collect::<Result<_, _>>()?;
        Ok(Self { title: title.into(), note: String::new(), scale: Some(scale), pictures })
    }

    /// With a sentence on what to look for.
    pub(crate) fn with_note(mut self, note: impl Into<String>) -> Self {
        self.note = note.into();
        self
    }
}

/// Gray levels for a volume: its 0.5th to its 99.7th percentile.
pub(crate) fn gray_range(volume: &Voxels<'_>) -> [f64; 2] {
    let values = volume.as_slice();
    let picked = sample(values.len(), None);
    let at = |q| quantile(picked.iter().map(|&o| f64::from(values[o])), q);
    let (low, high) = (at(0.005), at(0.997));
    [low, if high > low { high } else { low + 1.0 }]
}

/// Displacement magnitude at a voxel offset (mm).
pub fn length(field: &DenseField, offset: usize) -> f32 {
    field.at(offset).iter().map(|v| v * v).sum::<f32>().sqrt()
}

/// Where to cut: the centre of the motion inside the mask (weights are squared lengths), the grid's
/// middle when nothing moves.
pub(crate) fn centre_of_motion(field: &DenseField, mask: Option<&Mask>) -> WorldPoint {
    let grid = field.grid();
    let (mut sum, mut weight) = ([0.0; 3], 0.0);
    for o in sample(grid.len(), mask) {
        let w = f64::from(length(field, o)).powi(2);
        if w.is_finite() {
            let at = grid.voxel(o);
            (0..3).for_each(|a| sum[a] += w * at[a] as f64);
            weight += w;
        }
    }
    let middle = grid.shape().map(|n| (n - 1) as f64 / 2.0);
    let voxel = if weight > 1e-12 { sum.map(|v| v / weight) } else { middle };
    grid.affine().to_world(VoxelPoint(voxel))
}

/// The pictures of a synthetic pair: both volumes and the exact motion between them.
///
/// # Errors
/// As [`Panel::gray`].
pub(crate) fn synthetic_pair(
    initial: &Voxels<'_>,
    deformed: &Voxels<'_>,
    truth: &DenseField,
    mask: Option<&Mask>,
) -> Result<Vec<Panel>, ReportError> {
    let sections = Section::through(initial.grid(), centre_of_motion(truth, mask));
    let range = gray_range(initial);
    let (first, second) = (initial.as_slice(), deformed.as_slice());
    let most = quantile(sample(truth.grid().len(), mask).into_iter().map(|o| length(truth, o).into()), 0.999);
    let scale = Scale::from_zero(most, "mm", ColorMap::Viridis);
    Ok(vec![
        Panel::gray("initial", &sections, |o| first[o], range)?,
        Panel::gray("deformed", &sections, |o| second[o], range)?,
        Panel::coloured("true displacement", &sections, (initial, range), mask, scale, |o| length(truth, o))?,
    ])
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::types::{Affine, Grid, Volume};

    #[test]
    fn the_cut_goes_where_the_motion_is() {
        let grid = Grid::new([21, 21, 21], Affine::scaled([2.0; 3], [-20.0; 3]).unwrap()).unwrap();
        assert_eq!(centre_of_motion(&DenseField::zeros(grid), None), WorldPoint([0.0; 3]));
        let press =
            DenseField::from_fn(grid, |p| [if p == WorldPoint([10.0, -4.0, 6.0]) { 5.0 } else { 0.0 }, 0.0, 0.0]);
        assert_eq!(centre_of_motion(&press, None), WorldPoint([10.0, -4.0, 6.0]));
        let elsewhere = Mask::filled(grid, 0);
        assert_eq!(centre_of_motion(&press, Some(&elsewhere)), WorldPoint([0.0; 3]));
    }

    #[test]
    fn gray_levels_ignore_outliers_and_survive_a_constant_volume() {
        let grid = Grid::new([10, 10, 10], Affine::scaled([1.0; 3], [0.0; 3]).unwrap()).unwrap();
        let mut values: Vec<f32> = (0..1000).map(|i| i as f32).collect();
        values[500] = 1e9;
        let [low, high] = gray_range(&Volume::from_vec(grid, values).unwrap());
        assert!(low < 10.0 && (990.0..1000.0).contains(&high));
        assert_eq!(gray_range(&Volume::filled(grid, 4.0)), [4.0, 5.0]);
    }
}
