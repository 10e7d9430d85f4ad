//! A background of one value that a cut through tissue made: a mask, a skull taken off, a volume
//! resampled past its end. Its edge is none of the tissue and moves with the cut, so what lies
//! behind it is not seen. The value is 0, or the least one where 0 was moved.

use crate::numerics::statistics::{quantile, sampled};
use crate::numerics::{ablation, pyramid};
use crate::types::{Grid, Voxels};
use rayon::prelude::*;

/// Part of a volume that a background of one value takes at least.
const BACKGROUND: f64 = 0.02;

/// Part of the voxels beside such a background that is as bright as tissue from which all of it was
/// cut: where tissue ends in air it is 0 in phantoms without noise and 0.1 to 0.25 beside padding,
/// where a mask cut through tissue 0.48 to 0.91.
const CUT: f64 = 0.4;

/// The same about one place from which it was cut there, and the part of the border at such places
/// from which some was. Of volumes of which a box, an end or what lies past an oblique plane was
/// set to 0 such places hold 0.06 to 0.27 of the border, 0.003 to 0.02 where their air was 0
/// before; of scans whose air was set to 0 up to a twentieth of the brightest 0.0002, up to a tenth
/// 0.008 (where it costs next to nothing).
const CUT_HERE: f64 = 0.6;
const PLACES: f64 = 0.004;

/// Part of the tissue's median intensity that is as bright as tissue.
const BRIGHT: f32 = 0.5;

/// Edge of the blocks by which a cut is looked for, in the finest voxels; three of them along each
/// axis are one place.
const BLOCK: f64 = 8.0;

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
        ((lit > CUT || places > PLACES) && ablation::is_on("cut")).then_some(Self { lit, places })
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
pub fn filled_with(values: &[f32], value: f32) -> bool {
    held(values, value) as f64 >= BACKGROUND * values.len() as f64
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
pub fn why_unseen(cut: [Option<Cut>; 2]) -> Option<String> {
    let of = |(cut, volume): (Option<Cut>, &str)| {
        cut.map(|Cut { lit, places }| match lit > CUT {
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
    (!shown.is_empty()).then(|| empty + BRIGHT * (quantile(&mut shown, 0.5) - empty))
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
        let edge = spacing.map(|s| ((BLOCK * finest / s).round() as usize).max(2));
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
        f64::from(sums[0]) > CUT_HERE * f64::from(sums[1])
    }
}
