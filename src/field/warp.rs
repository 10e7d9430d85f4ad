//! Images, labels and points carried along a displacement field.
//!
//! An image is resampled at x + u(x), so the deformed volume comes to look like the initial one; a
//! point moves to p + u(p), so it goes from the initial to the deformed place. The image may lie on
//! any grid. Where x lies outside the field's grid the field says nothing: such voxels get the
//! background value, such points `None`.

use crate::error::FieldError;
use crate::numerics::cubic::LANES;
use crate::numerics::sampling::{Interpolation, Sampler, displacement, inside, nearest};
use crate::numerics::simd::dispatch;
use crate::types::{Displacement, Grid, Mask, Volume, Voxels, WorldPoint};

/// `image` at x + u(x) for each x of `reference` (the field's own grid when `None`); `background`
/// outside the image.
///
/// ```
/// use palpate::field::warp::warp_image;
/// use palpate::numerics::sampling::Interpolation;
/// use palpate::{Affine, DenseField, Grid, Volume};
/// let grid = Grid::new([8; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let deformed = Volume::from_voxels(grid, |_, p| p.0[0] as f32);
/// let field = DenseField::from_fn(grid, |_| [2.0, 0.0, 0.0]);
/// let warped = warp_image(&deformed, &field, None, Interpolation::Linear, -1.0);
/// assert_eq!(warped.as_slice()[grid.index(3, 4, 4)], 5.0);
/// // Two voxels further there is no image.
/// assert_eq!(warped.as_slice()[grid.index(7, 4, 4)], -1.0);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn warp_image(
    image: &Voxels<'_>,
    field: &Displacement<'_>,
    reference: Option<&Grid>,
    interpolation: Interpolation,
    background: f32,
) -> Volume {
    let sampler = Sampler::new(image, interpolation, background);
    let affine = *image.grid().affine();
    if reference.is_none_or(|r| r == field.grid()) {
        return warp_sampled(&sampler, image.grid(), field);
    }
    warp_with(field, reference, background, |target| sampler.at(affine.to_voxel(target)))
}

/// As [`warp_image`] on the field's own grid, of an image on the grid `image` that is ready to be
/// sampled.
pub(crate) fn warp_sampled(sampler: &Sampler<'_>, image: &Grid, field: &Displacement<'_>) -> Volume {
    Volume::by_rows(*field.grid(), |first, out| warp_rows(sampler, image, field, first, out))
}

/// [`warp_sampled`] at whole rows of voxels, from row `first` of the field's grid on (`j + ny k`).
pub(crate) fn warp_rows(sampler: &Sampler<'_>, image: &Grid, field: &Displacement<'_>, first: usize, out: &mut [f32]) {
    let grid = field.grid();
    let [nx, ny, _] = grid.shape();
    let components: [&[f32]; 3] = std::array::from_fn(|c| field.component(c));
    let inverse = image.affine().inverse_linear();
    let place = |i, j, k| image.affine().to_voxel(grid.world(i, j, k)).0;
    for (row, out) in (first..).zip(out.chunks_exact_mut(nx)) {
        let (j, k) = (row % ny, row / ny);
        let (start, next) = (place(0, j, k), place(1, j, k));
        dispatch(
            #[inline(always)]
            || {
                for (block, out) in out.chunks_mut(LANES).enumerate() {
                    let from = row * nx + block * LANES;
                    let mut d = [[0.0f64; LANES]; 3];
                    for (d, c) in d.iter_mut().zip(&components) {
                        d.iter_mut().zip(&c[from..from + out.len()]).for_each(|(d, c)| *d = f64::from(*c));
                    }
                    let p: [[f64; LANES]; 3] = std::array::from_fn(|a| {
                        std::array::from_fn(|l| {
                            let moved = inverse[a][0] * d[0][l] + inverse[a][1] * d[1][l] + inverse[a][2] * d[2][l];
                            start[a] + (block * LANES + l) as f64 * (next[a] - start[a]) + moved
                        })
                    });
                    sampler.block(&p, out);
                }
            },
        );
    }
}

/// [`warp_sampled`] at one voxel offset (x fastest).
pub(crate) fn warped_at(sampler: &Sampler<'_>, image: &Grid, field: &Displacement<'_>, offset: usize) -> f32 {
    let [i, j, k] = field.grid().voxel(offset);
    let to = field.grid().world(i, j, k).moved(field.at(offset).map(f64::from));
    sampler.at(image.affine().to_voxel(to))
}

/// As [`warp_image`] by nearest neighbour, for labels or masks: no value appears that was not
/// there.
///
/// ```
/// use palpate::field::warp::warp_labels;
/// use palpate::{Affine, DenseField, Grid, Mask};
/// let grid = Grid::new([8; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let labels = Mask::from_voxels(grid, |_, p| if p.0[0] < 4.0 { 3 } else { 9 });
/// let field = DenseField::from_fn(grid, |_| [1.4, 0.0, 0.0]);
/// let warped = warp_labels(&labels, &field, None, 0);
/// assert_eq!([2, 3].map(|i| warped.as_slice()[grid.index(i, 0, 0)]), [3, 9]);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn warp_labels<T: Copy + Default + Send + Sync>(
    labels: &Volume<T>,
    field: &Displacement<'_>,
    reference: Option<&Grid>,
    background: T,
) -> Volume<T> {
    warp_with(field, reference, background, |target| label_at(labels, target).unwrap_or(background))
}

/// The label of the voxel that holds a place.
fn label_at<T: Copy>(labels: &Volume<T>, place: WorldPoint) -> Option<T> {
    let grid = labels.grid();
    nearest(grid.shape(), grid.affine().to_voxel(place)).map(|at| labels.as_slice()[at])
}

/// A label map (`what`) on the grid of `reference`, by nearest neighbour in world space. Where the
/// grids differ, a note says so, and which labels fall between the voxels.
///
/// # Errors
/// [`FieldError::Elsewhere`] when no label lands on the grid.
///
/// ```
/// use palpate::field::warp::labels_onto;
/// use palpate::{Affine, Grid, Mask};
/// let fine = Grid::new([8; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let coarse = Grid::new([4; 3], Affine::scaled([2.0; 3], [0.0; 3])?)?;
/// let labels = Mask::from_voxels(fine, |_, p| if p.0 == [3.0; 3] { 7 } else { 1 });
/// let (on_coarse, note) = labels_onto(labels, &coarse, ["labels", "the field"])?;
/// assert_eq!(on_coarse.grid(), &coarse);
/// assert!(note.unwrap().contains("label 7 is lost"));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn labels_onto(
    labels: Mask,
    grid: &Grid,
    [what, reference]: [&str; 2],
) -> Result<(Mask, Option<String>), FieldError> {
    if grid.same_as(labels.grid()) {
        return Ok((labels, None));
    }
    let placed = Mask::from_voxels(*grid, |_, place| label_at(&labels, place).unwrap_or(0));
    let within = |map: &Mask| {
        map.as_slice().iter().fold([false; 256], |mut held, l| {
            held[usize::from(*l)] = true;
            held
        })
    };
    let (before, after) = (within(&labels), within(&placed));
    if after[1..].iter().all(|held| !held) {
        return Err(FieldError::Elsewhere { what: what.into(), reference: reference.into() });
    }
    let mut note =
        format!("{what}: lies on another grid than {reference}; it was resampled onto that by nearest neighbour");
    let lost: Vec<String> = (1..256).filter(|&l| before[l] && !after[l]).map(|l| l.to_string()).collect();
    match &lost[..] {
        [] => (),
        [one] => note.push_str(&format!(", and label {one} is lost")),
        _ => note.push_str(&format!(", and labels {} are lost", lost.join(", "))),
    }
    Ok((placed, Some(note)))
}

/// p + u(p) with u trilinear at each point (world mm), `None` for a point outside the field's grid.
///
/// ```
/// use palpate::field::warp::warp_points;
/// use palpate::{Affine, DenseField, Grid, WorldPoint};
/// let grid = Grid::new([8; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let field = DenseField::from_fn(grid, |p| [0.0, 0.0, p.0[0]]);
/// let moved = warp_points(&[WorldPoint([2.5, 1.0, 1.0]), WorldPoint([99.0, 0.0, 0.0])], &field);
/// assert_eq!(moved, [Some(WorldPoint([2.5, 1.0, 3.5])), None]);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn warp_points(points: &[WorldPoint], field: &Displacement<'_>) -> Vec<Option<WorldPoint>> {
    points.iter().map(|&p| warp_point(p, field)).collect()
}

fn warp_point(p: WorldPoint, field: &Displacement<'_>) -> Option<WorldPoint> {
    let grid = field.grid();
    inside(grid.shape(), grid.affine().to_voxel(p)).then(|| p.moved(displacement(field, p)))
}

/// `value` at x + u(x) for each x of the output grid.
fn warp_with<T: Copy + Default + Send + Sync>(
    field: &Displacement<'_>,
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
