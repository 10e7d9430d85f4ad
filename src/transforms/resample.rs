//! Images carried along a chain in one interpolation.

use crate::numerics::cubic::LANES;
use crate::numerics::sampling::{Interpolation, Sampler, inside};
use crate::transforms::Chain;
use crate::types::{Grid, Volume, Voxels};
use std::sync::atomic::{AtomicUsize, Ordering};

/// An image on another grid.
#[derive(Debug, Clone, PartialEq)]
pub struct Resampled {
    /// The image at the place to which the chain leads from each voxel centre.
    pub image: Volume,
    /// Voxels that the chain leads out of the image, or for which it says nothing: they have the
    /// background value.
    pub outside: usize,
}

/// `image`, on any grid, at [`Chain::at`] of each voxel centre of `grid`; `background` outside.
///
/// ```
/// use palpate::numerics::sampling::Interpolation;
/// use palpate::transforms::{Chain, resample::resample};
/// use palpate::{Affine, Grid, Volume};
/// let fine = Grid::new([8; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let coarse = Grid::new([4; 3], Affine::scaled([2.0; 3], [0.5; 3])?)?;
/// let image = Volume::from_voxels(fine, |_, p| p.0[2] as f32);
/// // An empty chain moves nothing.
/// let out = resample(&image, &Chain::default(), &coarse, Interpolation::Linear, 0.0);
/// assert_eq!(out.image.as_slice()[coarse.index(1, 1, 3)], 6.5);
/// assert_eq!(out.outside, 0);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn resample(
    image: &Voxels<'_>,
    chain: &Chain,
    grid: &Grid,
    interpolation: Interpolation,
    background: f32,
) -> Resampled {
    let sampler = Sampler::new(image, interpolation, background);
    let (affine, shape) = (*image.grid().affine(), image.grid().shape());
    let [nx, ..] = grid.shape();
    let outside = AtomicUsize::new(0);
    let image = Volume::by_rows(*grid, |row, line| {
        let mut lost = 0;
        for (block, out) in line.chunks_mut(LANES).enumerate() {
            let mut places = [[f64::NAN; LANES]; 3];
            for lane in 0..out.len() {
                let offset = row * nx + block * LANES + lane;
                match chain.at_voxel(grid, offset).map(|y| affine.to_voxel(y)).filter(|p| inside(shape, *p)) {
                    Some(p) => (0..3).for_each(|a| places[a][lane] = p.0[a]),
                    None => lost += 1,
                }
            }
            sampler.block(&places, out);
        }
        outside.fetch_add(lost, Ordering::Relaxed);
    });
    Resampled { image, outside: outside.into_inner() }
}
