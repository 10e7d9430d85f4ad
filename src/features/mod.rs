//! Distinct places of a volume: the 3D Harris corner measure with an even spread.
//!
//! Needs texture: a constant volume has no features, which the caller must report. Positions are
//! sub-voxel.

mod harris;

mod suppression;

pub use harris::{HarrisParams, block_response, response};
pub use suppression::{Corner, corners, spread};

use crate::error::SpaceError;
use crate::types::{FeaturePoint, Mask, Voxels};

/// At most `wanted` corners of a volume, the strongest first, in voxels and in world mm.
///
/// Joins [`response`] and [`spread`] with the default scales. The corners lie where the mask, on
/// the volume's grid, is not 0.
///
/// # Errors
/// [`SpaceError::Length`] when the mask has not as many voxels as the volume.
///
/// ```
/// use palpate::features::detect;
/// use palpate::{Affine, Grid, Volume};
/// // One bright cube in the dark, in voxels of 2 mm.
/// let grid = Grid::new([24, 24, 24], Affine::scaled([2.0; 3], [0.0; 3])?)?;
/// let bright = |o| grid.voxel(o).iter().all(|v| (8..16).contains(v));
/// let cube =
///     Volume::from_vec(grid, (0..grid.len()).map(|o| f32::from(u8::from(bright(o)))).collect())?;
/// let corners = detect(&cube, None, 8)?;
/// assert_eq!(corners.len(), 8);
/// // They are the cube's eight corners, between voxels 7 and 8 or 15 and 16.
/// let near = |x: f64| (x - 15.0).abs() < 4.5 || (x - 31.0).abs() < 4.5;
/// assert!(corners.iter().all(|c| c.world.0.iter().all(|&x| near(x))));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn detect(volume: &Voxels<'_>, mask: Option<&Mask>, wanted: usize) -> Result<Vec<FeaturePoint>, SpaceError> {
    let grid = volume.grid();
    let (shape, spacing) = (grid.shape(), grid.spacing());
    if let Some(found) = mask.map(|m| m.grid().len()).filter(|&found| found != grid.len()) {
        return Err(SpaceError::Length { expected: grid.len(), found });
    }
    let measure = response(volume.as_slice(), shape, spacing, HarrisParams::default());
    let found = spread(&measure, shape, spacing, mask.map(|m| m.as_slice()), wanted, 0.0);
    let point =
        |c: Corner| FeaturePoint { voxel: c.voxel, world: grid.affine().to_world(c.voxel), response: c.response };
    Ok(found.into_iter().map(point).collect())
}
