//! Telling a label map from an image by its values.

use crate::numerics::sampling::beside;
use crate::types::Voxels;
use std::collections::{BTreeMap, btree_map::Entry};

/// Whole numbers beyond this cannot all be told apart in single precision.
const WHOLE: f32 = 16_777_216.0;
/// A region three voxels across, the smallest that counts, has so many voxels.
const REGION: usize = 27;
/// Most different values of a label map; brain atlases have some thousand.
const MOST: usize = 1 << 16;

/// Whether the values are those of a label map: whole numbers that form plateaus.
///
/// Two values are a mask. Of more, the commonest is the background, and there must be at most one
/// value for every 27 other voxels, and half of the pairs of face neighbours (but those within the
/// background) must be equal. A cube of n voxels a side has (n - 1) / (n + 1) equal pairs, so half
/// stands for regions three voxels across. Two measurements of one tissue with noise of s gray
/// levels are equal with probability 0.28 / s: an image passes only where its noise is under about
/// half a gray level.
pub fn is_label_map(volume: &Voxels<'_>) -> bool {
    let Some(counts) = whole_values(volume.as_slice()) else { return false };
    if counts.len() <= 2 {
        return counts.len() == 2;
    }
    let background = counts.iter().max_by_key(|(_, n)| **n).map_or(0, |(v, _)| *v) as f32;
    let (values, shape) = (volume.as_slice(), volume.grid().shape());
    let tissue = values.iter().filter(|v| **v != background).count();
    if counts.len() > 1 + tissue / REGION {
        return false;
    }
    let (mut equal, mut pairs) = (0usize, 0usize);
    for (at, &v) in values.iter().enumerate() {
        for next in beside(shape, at).filter(|next| *next > at) {
            let both = v == background && values[next] == background;
            pairs += usize::from(!both);
            equal += usize::from(!both && v == values[next]);
        }
    }
    2 * equal >= pairs
}

/// How often each value occurs; none when one is no whole number, or there are too many.
fn whole_values(values: &[f32]) -> Option<BTreeMap<i32, usize>> {
    let mut counts = BTreeMap::new();
    for line in values.chunk_by(|a, b| a == b) {
        let v = line[0];
        if !(v.abs() <= WHOLE && v.fract() == 0.0) {
            return None;
        }
        let many = counts.len() >= MOST;
        match counts.entry(v as i32) {
            Entry::Occupied(mut count) => *count.get_mut() += line.len(),
            Entry::Vacant(_) if many => return None,
            Entry::Vacant(place) => drop(place.insert(line.len())),
        }
    }
    Some(counts)
}
