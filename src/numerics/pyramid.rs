//! Coarser copies of a volume.

use rayon::prelude::*;
use std::borrow::Cow;

/// The smallest voxel edge (mm) of the axes with more than one voxel.
pub fn finest(shape: [usize; 3], spacing: [f64; 3]) -> f64 {
    (0..3).filter(|&a| shape[a] > 1).map(|a| spacing[a]).fold(f64::INFINITY, f64::min)
}

/// Voxels along each axis after averaging blocks of `factor` voxels (a last, partial block counts).
pub fn reduced_shape(shape: [usize; 3], factor: [usize; 3]) -> [usize; 3] {
    std::array::from_fn(|a| shape[a].div_ceil(factor[a]))
}

/// Block averages. Voxel `i` of the result is centred at `(i + 0.5) * factor - 0.5` of the input.
pub fn reduce(data: &[f32], shape: [usize; 3], factor: [usize; 3]) -> Cow<'_, [f32]> {
    if factor == [1, 1, 1] {
        return Cow::Borrowed(data);
    }
    Cow::Owned(blocks(data, shape, factor, |v| v, |mean| mean))
}

/// Blocks of which at least half the voxels are set.
pub(crate) fn reduce_mask(mask: &[u8], shape: [usize; 3], factor: [usize; 3]) -> Cow<'_, [u8]> {
    if factor == [1, 1, 1] {
        return Cow::Borrowed(mask);
    }
    Cow::Owned(blocks(mask, shape, factor, |m| f32::from(u8::from(m != 0)), |share| u8::from(share >= 0.5)))
}

/// The part of each block's voxels that are `marked`.
pub fn share(marks: &[u8], shape: [usize; 3], factor: [usize; 3], marked: impl Fn(u8) -> bool + Sync) -> Vec<f32> {
    blocks(marks, shape, factor, |m| f32::from(u8::from(marked(m))), |mean| mean)
}

/// `result` of the mean `value` of each block of voxels.
fn blocks<T: Copy + Sync, U: Clone + Default + Send>(
    data: &[T],
    shape: [usize; 3],
    factor: [usize; 3],
    value: impl Fn(T) -> f32 + Sync,
    result: impl Fn(f32) -> U + Sync,
) -> Vec<U> {
    let [nx, ny, _] = shape;
    let s = reduced_shape(shape, factor);
    let mut out = vec![U::default(); s.iter().product()];
    out.par_chunks_mut(s[0] * s[1]).enumerate().for_each(|(k, plane)| {
        let mut sums = vec![0.0f32; nx];
        for (j, row) in plane.chunks_exact_mut(s[0]).enumerate() {
            sums.fill(0.0);
            let (ks, js) = (span(k, factor[2], shape[2]), span(j, factor[1], shape[1]));
            let rows = ks.len() * js.len();
            for kk in ks {
                for jj in js.clone() {
                    let from = nx * (jj + ny * kk);
                    for (sum, v) in sums.iter_mut().zip(&data[from..from + nx]) {
                        *sum += value(*v);
                    }
                }
            }
            for (i, o) in row.iter_mut().enumerate() {
                let r = span(i, factor[0], nx);
                let n = (rows * r.len()) as f32;
                *o = result(sums[r].iter().sum::<f32>() / n);
            }
        }
    });
    out
}

/// The input voxels of block `at`.
fn span(at: usize, factor: usize, n: usize) -> std::ops::Range<usize> {
    at * factor..((at + 1) * factor).min(n)
}
