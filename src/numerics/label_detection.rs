//! Telling a label map from an image by its values.

use crate::numerics::sampling::beside;
use crate::types::Voxels;
use rayon::prelude::*;

/// Largest value that is considered as a label.
const MAX_LABEL: f32 = 1_048_576.0;
/// Voxels of the smallest region that counts: three voxels across.
const MIN_REGION_VOXELS: usize = 27;

/// Whether the values are those of a label map: whole numbers that form plateaus.
///
/// Two values are a mask. Of more, the commonest is the background, and there must be at most one
/// value for every 27 other voxels, and half of the pairs of face neighbours (but those within the
/// background) must be equal. A cube of n voxels a side has (n - 1) / (n + 1) equal pairs, so half
/// stands for regions three voxels across. Two measurements of one tissue with noise of s gray
/// levels are equal with probability 0.28 / s: an image passes only where its noise is under about
/// half a gray level.
pub fn is_label_map(volume: &Voxels<'_>) -> bool {
    let (values, shape) = (volume.as_slice(), volume.grid().shape());
    let Some((different, background, common)) = whole_values(values) else { return false };
    if different <= 2 {
        return different == 2;
    }
    if different > 1 + (values.len() - common) / MIN_REGION_VOXELS {
        return false;
    }
    let plane = shape[0] * shape[1];
    let of_plane = |k: usize| {
        let (mut equal, mut pairs) = (0usize, 0usize);
        for at in k * plane..(k + 1) * plane {
            for next in beside(shape, at).filter(|next| *next > at) {
                let both = values[at] == background && values[next] == background;
                pairs += usize::from(!both);
                equal += usize::from(!both && values[at] == values[next]);
            }
        }
        (equal, pairs)
    };
    let sum = |a: (usize, usize), b: (usize, usize)| (a.0 + b.0, a.1 + b.1);
    let (equal, pairs) = (0..shape[2]).into_par_iter().map(of_plane).reduce(|| (0, 0), sum);
    2 * equal >= pairs
}

/// How many values there are, the commonest one and how often it occurs; none when one is no whole
/// number up to the largest label.
fn whole_values(values: &[f32]) -> Option<(usize, f32, usize)> {
    if !values.iter().all(|v| v.abs() <= MAX_LABEL && v.fract() == 0.0) {
        return None;
    }
    let (low, high) = values.iter().fold((MAX_LABEL, -MAX_LABEL), |(l, h), &v| (l.min(v), h.max(v)));
    let mut counts = vec![0usize; (high - low).max(0.0) as usize + 1];
    values.iter().for_each(|v| counts[(v - low) as usize] += 1);
    let different = counts.iter().filter(|n| **n > 0).count();
    let (at, common) = counts.iter().enumerate().max_by_key(|(_, n)| **n)?;
    Some((different, low + at as f32, *common))
}
