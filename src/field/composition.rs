//! One motion after another.

use crate::numerics::sampling::displacement;
use crate::types::DenseField;

/// The field of `first`, then `second`: w(x) = a(x) + b(x + a(x)), on the grid of `first` (mm).
///
/// `second` is sampled trilinearly; outside its grid it is held at the value of its nearest edge.
pub fn compose(first: &DenseField, second: &DenseField) -> DenseField {
    DenseField::from_voxels(*first.grid(), |at, x| {
        let a = first.at(at).map(f64::from);
        let b = displacement(second, x.moved(a));
        [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
    })
}
