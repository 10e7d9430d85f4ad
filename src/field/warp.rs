//! Images, labels and points carried along a displacement field.
//!
//! An image is resampled at x + u(x), so the deformed volume comes to look like the initial one; a point moves to
//! p + u(p), so it goes from the initial to the deformed place. The image may lie on any grid. Where x lies outside
//! the field's grid the field says nothing: such voxels get the background value, such points `None`.

use crate::numerics::sampling::{Interpolation, Sampler, displacement, inside, nearest};
use crate::types::{DenseField, Grid, Volume, WorldPoint};

/// `image` at x + u(x) for each x of `reference` (the field's own grid when `None`); `background` outside the image.
pub fn warp_image(
    image: &Volume,
    field: &DenseField,
    reference: Option<&Grid>,
    interpolation: Interpolation,
    background: f32,
) -> Volume {
    let sampler = Sampler::new(image, interpolation, background);
    let affine = *image.grid().affine();
    warp_with(field, reference, background, |target| sampler.at(affine.to_voxel(target)))
}

/// As [`warp_image`] by nearest neighbour, for labels or masks: no value appears that was not there.
pub fn warp_labels<T: Copy + Default + Send + Sync>(
    labels: &Volume<T>,
    field: &DenseField,
    reference: Option<&Grid>,
    background: T,
) -> Volume<T> {
    let (grid, values) = (*labels.grid(), labels.as_slice());
    warp_with(field, reference, background, |target| {
        nearest(grid.shape(), grid.affine().to_voxel(target)).map_or(background, |at| values[at])
    })
}

/// p + u(p) with u trilinear at each point (world mm), `None` for a point outside the field's grid.
pub fn warp_points(points: &[WorldPoint], field: &DenseField) -> Vec<Option<WorldPoint>> {
    points.iter().map(|&p| warp_point(p, field)).collect()
}

fn warp_point(p: WorldPoint, field: &DenseField) -> Option<WorldPoint> {
    let grid = field.grid();
    inside(grid.shape(), grid.affine().to_voxel(p)).then(|| p.moved(displacement(field, p)))
}

/// `value` at x + u(x) for each x of the output grid.
fn warp_with<T: Copy + Default + Send + Sync>(
    field: &DenseField,
    reference: Option<&Grid>,
    background: T,
    value: impl Fn(WorldPoint) -> T + Sync,
) -> Volume<T> {
    let grid = *reference.unwrap_or(field.grid());
    let own = grid == *field.grid();
    let [dx, dy, dz] = std::array::from_fn(|c| field.component(c));
    Volume::from_voxels(grid, |at, x| {
        let target = if own { Some(x.moved([dx[at], dy[at], dz[at]].map(f64::from))) } else { warp_point(x, field) };
        target.map_or(background, &value)
    })
}
