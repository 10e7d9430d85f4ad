//! One motion after another.

use crate::numerics::sampling::displacement;
use crate::types::DenseField;

/// The field of `first`, then `second`: w(x) = a(x) + b(x + a(x)), on the grid of `first` (mm).
///
/// `second` is sampled trilinearly; outside its grid it is held at the value of its nearest edge.
///
/// ```
/// use palpate::field::composition::compose;
/// use palpate::{Affine, DenseField, Grid};
/// let grid = Grid::new([8; 3], Affine::scaled([1.0; 3], [0.0; 3])?)?;
/// let first = DenseField::from_fn(grid, |_| [1.0, 0.0, 0.0]);
/// let second = DenseField::from_fn(grid, |p| [0.0, 0.5 * p.0[0], 0.0]);
/// // The tissue at x = 3 is at x = 4 when the second motion begins.
/// assert_eq!(compose(&first, &second).at(grid.index(3, 0, 0)), [1.0, 2.0, 0.0]);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn compose(first: &DenseField, second: &DenseField) -> DenseField {
    DenseField::from_voxels(*first.grid(), |at, x| {
        let a = first.at(at).map(f64::from);
        let b = displacement(second, x.moved(a));
        [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
    })
}
