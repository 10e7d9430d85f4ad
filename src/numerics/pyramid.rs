//! Coarser copies of a volume.

use rayon::prelude::*;
use std::borrow::Cow;

/// Voxels along each axis after averaging blocks of `factor` voxels (a last, partial block counts).
pub fn reduced_shape(shape: [usize; 3], factor: [usize; 3]) -> [usize; 3] {
    std::array::from_fn(|a| shape[a].div_ceil(factor[a]))
}

/// Block averages. Voxel `i` of the result is centred at `(i + 0.5) * factor - 0.5` of the input.
pub fn reduce(data: &[f32], shape: [usize; 3], factor: [usize; 3]) -> Cow<'_, [f32]> {
    if factor == [1, 1, 1] {
        return Cow::Borrowed(data);
    }
    let [nx, ny, _] = shape;
    let s = reduced_shape(shape, factor);
    let mut out = vec![0.0f32; s.iter().product()];
    out.par_chunks_mut(s[0] * s[1]).enumerate().for_each(|(k, plane)| {
        let mut sums = vec![0.0f32; nx];
        for (j, row) in plane.chunks_exact_mut(s[0]).enumerate() {
            sums.fill(0.0);
            let (ks, js) = (span(k, factor[2], shape[2]), span(j, factor[1], shape[1]));
            let rows = ks.len() * js.len();
            for kk in ks {
                for jj in js.clone() {
                    let from = nx * (jj + ny * kk);
                    for (a, v) in sums.iter_mut().zip(&data[from..from + nx]) {
                        *a += v;
                    }
                }
            }
            for (i, o) in row.iter_mut().enumerate() {
                let r = span(i, factor[0], nx);
                let n = (rows * r.len()) as f32;
                *o = sums[r].iter().sum::<f32>() / n;
            }
        }
    });
    Cow::Owned(out)
}

/// Blocks of which at least half the voxels are set.
pub fn reduce_mask(mask: &[u8], shape: [usize; 3], factor: [usize; 3]) -> Vec<u8> {
    if factor == [1, 1, 1] {
        return mask.to_vec();
    }
    let [nx, ny, _] = shape;
    let s = reduced_shape(shape, factor);
    let mut out = vec![0u8; s.iter().product()];
    out.par_chunks_mut(s[0] * s[1]).enumerate().for_each(|(k, plane)| {
        let mut sums = vec![0u16; nx];
        for (j, row) in plane.chunks_exact_mut(s[0]).enumerate() {
            sums.fill(0);
            let (ks, js) = (span(k, factor[2], shape[2]), span(j, factor[1], shape[1]));
            let rows = ks.len() * js.len();
            for (kk, jj) in ks.flat_map(|kk| js.clone().map(move |jj| (kk, jj))) {
                let from = nx * (jj + ny * kk);
                for (a, v) in sums.iter_mut().zip(&mask[from..from + nx]) {
                    *a += u16::from(*v != 0);
                }
            }
            for (i, o) in row.iter_mut().enumerate() {
                let r = span(i, factor[0], nx);
                let all = rows * r.len();
                *o = u8::from(2 * sums[r].iter().map(|&v| usize::from(v)).sum::<usize>() >= all);
            }
        }
    });
    out
}

/// The input voxels of block `at`.
fn span(at: usize, factor: usize, n: usize) -> std::ops::Range<usize> {
    at * factor..((at + 1) * factor).min(n)
}
