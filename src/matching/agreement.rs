//! How well two volumes agree, place by place, so that it shows where a warp no longer explains what is seen.

use crate::matching::gain::GainField;
use crate::matching::pair::Pair;
use crate::matching::residual::{CAUCHY, residual_sigma};
use rayon::prelude::*;

/// Edge of a block (voxels).
const BLOCK: usize = 8;

/// Voxels of the mask that a block needs to be judged.
const FEWEST: f32 = 64.0;

/// Robust misfit of two volumes under a warp, in blocks of 8 voxels.
#[derive(Debug, Clone, PartialEq)]
pub struct Agreement {
    /// Robust standard deviation of the residual (intensity), the unit of the misfit.
    sigma: f32,
    /// Mean of `c^2 ln(1 + r^2 / (c sigma)^2)` over each block's voxels inside the mask; none where there are too few.
    blocks: Vec<Option<f32>>,
}

impl Agreement {
    /// Of the initial volume and the warped one; in units of `sigma` (intensity), of the residual's own robust spread
    /// without it.
    pub fn measure(pair: &Pair<'_>, warped: &[f32], sigma: Option<f32>) -> Self {
        let gain = GainField::measure(pair, warped);
        let sigma = sigma.unwrap_or_else(|| residual_sigma(pair, warped, &gain)).max(f32::MIN_POSITIVE);
        let [nx, ny, nz] = pair.shape;
        let [bx, by, bz] = pair.shape.map(|n| n.div_ceil(BLOCK));
        let cut = 1.0 / (CAUCHY * sigma);
        let mut blocks = vec![None; bx * by * bz];
        blocks.par_chunks_mut(bx).enumerate().for_each(|(row, blocks)| {
            let [from_j, from_k] = [row % by, row / by].map(|b| b * BLOCK);
            let (mut a, mut b) = (vec![0.0; nx], vec![0.0; nx]);
            let mut sums = vec![[0.0f32; 2]; bx];
            for (j, k) in
                (from_k..(from_k + BLOCK).min(nz)).flat_map(|k| (from_j..(from_j + BLOCK).min(ny)).map(move |j| (j, k)))
            {
                gain.row(j, k, &mut a, &mut b);
                let from = nx * (j + ny * k);
                for i in pair.spans.row(j, k) {
                    let r = pair.fixed_smooth[from + i] - (a[i] * warped[from + i] + b[i]);
                    if pair.mask[from + i] != 0 && r.is_finite() {
                        let [cost, count] = &mut sums[i / BLOCK];
                        *cost += CAUCHY * CAUCHY * (cut * r).powi(2).ln_1p();
                        *count += 1.0;
                    }
                }
            }
            for (block, [cost, count]) in blocks.iter_mut().zip(sums) {
                if count >= FEWEST {
                    *block = Some(cost / count);
                }
            }
        });
        Self { sigma, blocks }
    }

    /// Its unit (intensity).
    pub fn sigma(&self) -> f32 {
        self.sigma
    }

    /// By how much the misfit of the worst block has grown since `before` (in that one's unit, squared), NaN without any
    /// block.
    pub fn worsened(&self, before: &Self) -> f32 {
        let grown = |(now, then): (&Option<f32>, &Option<f32>)| Some((*now)? - (*then)?);
        self.blocks.iter().zip(&before.blocks).filter_map(grown).fold(f32::NAN, f32::max)
    }
}
