//! A background of one value that a cut through tissue made: a mask, a skull taken off, a volume
//! resampled past its end. Its edge is none of the tissue and moves with the cut, so what lies
//! behind it is not seen. The value is 0, or the least one where 0 was moved.

use crate::numerics::statistics::{quantile, sampled};
use crate::numerics::{ablation, pyramid};
use crate::types::{Grid, Voxels};
use rayon::prelude::*;

/// Smallest part of a volume that a background of one value fills.
const MIN_BACKGROUND_FRACTION: f64 = 0.02;

/// How a background that was cut from tissue differs from air.
struct CutDetection {
    /// Part of the voxels beside the background that are as bright as tissue, beyond which all of
    /// it was cut: 0.1 to 0.25 beside padding, 0.48 to 0.91 where a mask cut tissue.
    min_lit_fraction: f64,
    /// The same about one place, beyond which the background was cut there.
    min_local_lit_fraction: f64,
    /// Part of the border at such places beyond which some was cut: 0.06 to 0.27 where a side was
    /// set to 0, 0.003 to 0.02 where air was 0 before.
    min_border_fraction: f64,
    /// Intensity of a voxel as bright as tissue, over the tissue's median.
    tissue_intensity: f32,
    /// Edge of the blocks in which a cut is detected (finest voxels); three along each axis are a
    /// place.
    block_voxels: f64,
}

const CUT_DETECTION: CutDetection = CutDetection {
    min_lit_fraction: 0.4,
    min_local_lit_fraction: 0.6,
    min_border_fraction: 0.004,
    tissue_intensity: 0.5,
    block_voxels: 8.0,
};

/// A background of one value that was cut.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cut {
    /// The part of the voxels beside it that is as bright as tissue.
    lit: f64,
    /// The part of its border at places where most of it is.
    places: f64,
}

impl Cut {
    /// What of a volume's background of one value, if it has one, tells of a cut.
    pub fn of(volume: &Voxels<'_>, empty: f32) -> Option<Self> {
        let values = volume.as_slice();
        let blocks = Blocks::of(volume.grid());
        let border = blocks.border(values, empty, bright(values, empty)?);
        let sum = |which: &dyn Fn(usize) -> u32| (0..border.len()).map(|b| f64::from(which(b))).sum::<f64>();
        let all = sum(&|b| border[b][1]).max(1.0);
        let lit = sum(&|b| border[b][0]) / all;
        let places = sum(&|b| if blocks.is_cut(&border, b) { border[b][1] } else { 0 }) / all;
        ((lit > CUT_DETECTION.min_lit_fraction || places > CUT_DETECTION.min_border_fraction) && ablation::is_on("cut"))
            .then_some(Self { lit, places })
    }
}

/// The one value of a volume's background, if it has such: 0, or the volume's `least` value if more
/// voxels hold that.
pub fn empty(volume: &Voxels<'_>, least: f32) -> Option<f32> {
    let values = volume.as_slice();
    let [zeros, others] = [held(values, 0.0), if least == 0.0 { 0 } else { held(values, least) }];
    let value = if zeros >= others { 0.0 } else { least };
    filled_with(volume.as_slice(), value).then_some(value)
}

/// Whether enough voxels hold a value to be a background.
pub(crate) fn filled_with(values: &[f32], value: f32) -> bool {
    held(values, value) as f64 >= MIN_BACKGROUND_FRACTION * values.len() as f64
}

fn held(values: &[f32], value: f32) -> usize {
    values.par_chunks(1 << 16).map(|part| part.iter().filter(|v| **v == value).count()).sum()
}

/// The volume with its background as voxels that are not finite.
pub fn hidden(mut volume: Voxels<'_>, empty: f32) -> Voxels<'_> {
    volume.as_mut_slice().par_iter_mut().filter(|v| **v == empty).for_each(|v| *v = f32::NAN);
    volume
}

/// What to say of backgrounds that were cut.
pub(crate) fn why_unseen(cut: [Option<Cut>; 2]) -> Option<String> {
    let of = |(cut, volume): (Option<Cut>, &str)| {
        cut.map(|Cut { lit, places }| match lit > CUT_DETECTION.min_lit_fraction {
            true => format!("{:.0} % of what borders on it in the {volume} volume is as bright as tissue", 100.0 * lit),
            false => format!(
                "{:.0} % of its border in the {volume} volume lies where most of what borders on it is as bright as tissue",
                100.0 * places
            ),
        })
    };
    let parts: Vec<String> = cut.into_iter().zip(["initial", "deformed"]).filter_map(of).collect();
    (!parts.is_empty())
        .then(|| format!("background: of one value by a cut through tissue, taken as not seen ({})", parts.join("; ")))
}

/// The intensity from which a voxel is as bright as tissue; none where nothing stands out.
fn bright(values: &[f32], empty: f32) -> Option<f32> {
    let mut shown = sampled(values);
    let [low, high] = [0.02, 0.98].map(|q| quantile(&mut shown, q));
    shown.retain(|v| *v > low + 0.1 * (high - low));
    (!shown.is_empty()).then(|| empty + CUT_DETECTION.tissue_intensity * (quantile(&mut shown, 0.5) - empty))
}

/// A volume in blocks.
struct Blocks {
    shape: [usize; 3],
    /// Voxels along a block's edges.
    edge: [usize; 3],
    /// Blocks along each axis.
    count: [usize; 3],
}

impl Blocks {
    fn of(grid: &Grid) -> Self {
        let (shape, spacing) = (grid.shape(), grid.spacing());
        let finest = pyramid::finest(shape, spacing);
        let edge = spacing.map(|s| ((CUT_DETECTION.block_voxels * finest / s).round() as usize).max(2));
        Self { shape, edge, count: pyramid::reduced_shape(shape, edge) }
    }

    /// Of each block the pairs of neighbours of which one is `empty` and the other not: those with
    /// one as bright as tissue, and all.
    fn border(&self, values: &[f32], empty: f32, bright: f32) -> Vec<[u32; 2]> {
        let [nx, ny, nz] = self.shape;
        let layer = self.count[0] * self.count[1];
        let mut border = vec![[0; 2]; layer * self.count[2]];
        border.par_chunks_mut(layer).enumerate().for_each(|(z, border)| {
            for k in z * self.edge[2]..((z + 1) * self.edge[2]).min(nz) {
                for j in 0..ny {
                    let from = nx * (j + ny * k);
                    for i in from..from + nx {
                        let along = [(i + 1 < from + nx, 1), (j + 1 < ny, nx), (k + 1 < nz, nx * ny)];
                        for (_, step) in along.into_iter().filter(|a| a.0) {
                            let (a, b) = (values[i], values[i + step]);
                            if (a == empty) != (b == empty) {
                                let here = &mut border[(i - from) / self.edge[0] + self.count[0] * (j / self.edge[1])];
                                here[0] += u32::from(a.max(b) > bright);
                                here[1] += 1;
                            }
                        }
                    }
                }
            }
        });
        border
    }

    /// Whether a block holds the border of a cut, by what it and the blocks around it hold.
    fn is_cut(&self, border: &[[u32; 2]], block: usize) -> bool {
        if border[block][1] == 0 {
            return false;
        }
        let [nx, ny, _] = self.count;
        let p = [block % nx, block / nx % ny, block / (nx * ny)];
        let [x, y, z]: [_; 3] = std::array::from_fn(|a| p[a].saturating_sub(1)..(p[a] + 2).min(self.count[a]));
        let mut sums = [0; 2];
        for k in z {
            for j in y.clone() {
                for b in &border[nx * (j + ny * k)..][x.clone()] {
                    sums = [sums[0] + b[0], sums[1] + b[1]];
                }
            }
        }
        f64::from(sums[0]) > CUT_DETECTION.min_local_lit_fraction * f64::from(sums[1])
    }
}
