//! Whether the field of a frame of a sequence is confirmed: by the frames before and after it, or
//! by its own image.
//!
//! A void, an artefact or a wrong match moves tissue where no frame beside it has it, and the pair
//! alone cannot tell. A jerk does so too, but then the image agrees better with the frame's own
//! field than with the middle of its neighbours'. Tissue where neither holds earns a warning; where
//! there is no texture there is no answer.

use crate::numerics::sampling::{Stencil, inside};
use crate::numerics::statistics::noise_sigma;
use crate::types::space::length;
use crate::types::{Displacement, Mask, Voxels};
use rayon::prelude::*;

/// The blocks of tissue that are compared in time.
struct BlockSampling {
    /// Distance of the samples (voxels of the finest axis).
    step_voxels: usize,
    /// Samples along each axis of a block, 64 in all; twice as many in one slice.
    samples_per_edge: usize,
    /// Fewest samples of a block in the mask.
    min_samples: usize,
    /// Least variation of the reference in a block over its noise.
    min_contrast_to_noise: f64,
}

const BLOCKS: BlockSampling =
    BlockSampling { step_voxels: 2, samples_per_edge: 4, min_samples: 16, min_contrast_to_noise: 2.0 };

/// When a block of a frame is an outlier, and a frame earns a warning.
struct OutlierTest {
    /// Distance from the motion that the neighbours in time interpolate (voxel edges).
    min_distance_voxels: f64,
    /// The same in standard deviations of the difference.
    min_distance_sd: f64,
    /// Misfit (1 - correlation^2) under the frame's own field over that under its neighbours', up
    /// to which its image confirms its field.
    max_misfit_ratio: f64,
    /// Part of the tissue in unconfirmed outliers that earns a warning.
    min_tissue_fraction: f64,
    /// Part of the outliers that must be unconfirmed.
    min_outlier_fraction: f64,
}

const OUTLIER: OutlierTest = OutlierTest {
    min_distance_voxels: 0.5,
    min_distance_sd: 4.0,
    max_misfit_ratio: 0.8,
    min_tissue_fraction: 0.03,
    min_outlier_fraction: 0.2,
};

/// A frame at the voxels that are looked at.
struct Seen {
    number: usize,
    /// Displacement (mm, RAS) and its standard deviation (mm).
    moved: Vec<([f32; 3], f32)>,
}

/// What is not confirmed in a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct OutOfLine {
    /// Part of the tissue (1).
    pub share: f64,
    /// Mean distance from where the frames beside it have it (mm).
    pub apart_mm: f64,
    /// The frames beside it: the one before, and the one after unless it is the last.
    pub beside: (usize, Option<usize>),
}

/// The frames in one direction from the reference, as they come.
pub(super) struct Course<'a, 'v> {
    reference: &'a Voxels<'a>,
    /// Offsets of the voxels of each block.
    blocks: Vec<Vec<usize>>,
    origin: usize,
    before: Seen,
    last: Option<(Seen, Voxels<'v>)>,
}

impl<'a, 'v> Course<'a, 'v> {
    /// `reference` is number `origin`; `mask` lies on its grid.
    pub fn new(reference: &'a Voxels<'a>, mask: &Mask, origin: usize) -> Self {
        let mut blocks = blocks(mask);
        let values = reference.as_slice();
        let noise = f64::from(noise_sigma(values, reference.grid().shape(), |o| mask.as_slice()[o] != 0));
        // Where there is no texture any field looks alike.
        blocks.retain(|block| {
            let mean = block.iter().map(|&o| f64::from(values[o])).sum::<f64>() / block.len() as f64;
            let square = block.iter().map(|&o| (f64::from(values[o]) - mean).powi(2)).sum::<f64>() / block.len() as f64;
            square.sqrt() > BLOCKS.min_contrast_to_noise * noise
        });
        let before = still(origin, &blocks);
        Self { reference, blocks, origin, before, last: None }
    }

    /// Takes a frame, and says of the one before it what its number is and what is not confirmed
    /// there.
    pub fn add(
        &mut self,
        number: usize,
        field: &Displacement<'_>,
        uncertainty: &dyn Fn(usize) -> f32,
        volume: Voxels<'v>,
    ) -> Option<(usize, OutOfLine)> {
        let moved = self.blocks.iter().flatten().map(|&at| (field.at(at), uncertainty(at))).collect();
        let next = Seen { number, moved };
        let said = self.judge(Some(&next));
        if let Some((last, _)) = self.last.replace((next, volume)) {
            self.before = last;
        }
        said
    }

    /// The same of the last frame, by the one before it alone; and begins again beside the
    /// reference.
    pub fn end(&mut self) -> Option<(usize, OutOfLine)> {
        let said = self.judge(None);
        self.before = still(self.origin, &self.blocks);
        self.last = None;
        said
    }

    fn judge(&self, next: Option<&Seen>) -> Option<(usize, OutOfLine)> {
        let (own, volume) = self.last.as_ref()?;
        let before = &self.before;
        // Where steady motion from the one before to the next has it; lost frames are passed over.
        let t =
            next.map_or(0.0, |n| own.number.abs_diff(before.number) as f32 / n.number.abs_diff(before.number) as f32);
        let after = next.unwrap_or(before);
        let middle: Vec<([f32; 3], f32)> = before
            .moved
            .iter()
            .zip(&after.moved)
            .map(|((u, s), (v, r))| (std::array::from_fn(|a| u[a] + t * (v[a] - u[a])), s.max(*r)))
            .collect();
        let starts: Vec<usize> =
            self.blocks.iter().scan(0, |at, b| Some(std::mem::replace(at, *at + b.len()))).collect();
        let edge = self.reference.grid().spacing().iter().product::<f64>().cbrt();
        let one = |(block, &from): (&Vec<usize>, &usize)| {
            let part = from..from + block.len();
            let (here, there) = (&own.moved[part.clone()], &middle[part]);
            let mean = |of: &dyn Fn(usize) -> f64| (0..block.len()).map(of).sum::<f64>() / block.len() as f64;
            let off: [f64; 3] = std::array::from_fn(|a| mean(&|i| f64::from(here[i].0[a] - there[i].0[a])));
            let sigma = mean(&|i| f64::from(here[i].1.hypot(there[i].1)));
            let apart = length(off);
            if !(apart > OUTLIER.min_distance_voxels * edge && apart > OUTLIER.min_distance_sd * sigma) {
                return (block.len(), None);
            }
            let [own, beside] = [here, there].map(|moved| self.misfit(block, moved, volume));
            (block.len(), own.zip(beside).map(|(own, beside)| (apart, own > OUTLIER.max_misfit_ratio * beside)))
        };
        let tested: Vec<(usize, Option<(f64, bool)>)> = self.blocks.par_iter().zip(&starts).map(one).collect();
        let count = |keep: &dyn Fn(&Option<(f64, bool)>) -> bool| -> f64 {
            tested.iter().filter(|t| keep(&t.1)).map(|t| t.0 as f64).sum()
        };
        let (all, out) = (count(&|_| true), count(&Option::is_some));
        let alone = |t: &Option<(f64, bool)>| t.is_some_and(|t| t.1);
        let unconfirmed = count(&alone);
        let least = (OUTLIER.min_tissue_fraction * all).max(OUTLIER.min_outlier_fraction * out);
        (unconfirmed > least).then(|| {
            let sum: f64 = tested.iter().filter(|t| alone(&t.1)).filter_map(|t| Some(t.0 as f64 * t.1?.0)).sum();
            let beside = (before.number, next.map(|n| n.number));
            (own.number, OutOfLine { share: unconfirmed / all, apart_mm: sum / unconfirmed, beside })
        })
    }

    /// 1 - correlation^2 of a block of the reference and what a frame shows of it; none where that
    /// is not in view.
    fn misfit(&self, block: &[usize], moved: &[([f32; 3], f32)], volume: &Voxels<'_>) -> Option<f64> {
        let (grid, there) = (self.reference.grid(), volume.grid());
        let pairs: Vec<[f64; 2]> = block
            .iter()
            .zip(moved)
            .filter_map(|(&at, (u, _))| {
                let [i, j, k] = grid.voxel(at);
                let p = there.affine().to_voxel(grid.world(i, j, k).moved(u.map(f64::from)));
                let seen = inside(there.shape(), p).then(|| Stencil::new(there.shape(), p).of(volume.as_slice()))?;
                Some([f64::from(self.reference.as_slice()[at]), seen])
            })
            .filter(|p| p.iter().all(|v| v.is_finite()))
            .collect();
        (2 * pairs.len() >= block.len() && pairs.len() >= 2).then(|| 1.0 - correlation(&pairs).max(0.0).powi(2))
    }
}

impl OutOfLine {
    /// In words, for a frame's warnings.
    pub fn why(&self) -> String {
        let beside = match self.beside {
            (before, Some(after)) => format!("frames {before} and {after} have"),
            (before, None) => format!("frame {before} has"),
        };
        format!(
            "{:.0} % of the tissue lies {:.1} mm on the mean from where {beside} it, and the image does not bear that out there: a void, an \
             artefact or blur; do not trust this frame there",
            (100.0 * self.share).max(1.0),
            self.apart_mm,
        )
    }
}

fn still(number: usize, blocks: &[Vec<usize>]) -> Seen {
    Seen { number, moved: vec![([0.0; 3], 0.0); blocks.iter().map(Vec::len).sum()] }
}

/// Of pairs of values (-1 to 1; 0 where either is constant).
fn correlation(pairs: &[[f64; 2]]) -> f64 {
    let mean: [f64; 2] = std::array::from_fn(|a| pairs.iter().map(|p| p[a]).sum::<f64>() / pairs.len() as f64);
    let moment = |a: usize, b: usize| pairs.iter().map(|p| (p[a] - mean[a]) * (p[b] - mean[b])).sum::<f64>();
    let size = (moment(0, 0) * moment(1, 1)).sqrt();
    if size > 0.0 { moment(0, 1) / size } else { 0.0 }
}

/// Blocks of the mask.
fn blocks(mask: &Mask) -> Vec<Vec<usize>> {
    let grid = mask.grid();
    let (shape, spacing) = (grid.shape(), grid.spacing());
    let step = spacing.map(|s| ((BLOCKS.step_voxels as f64 * grid.least_spacing() / s).round() as usize).max(1));
    let along = if grid.is_single_slice() { 2 * BLOCKS.samples_per_edge } else { BLOCKS.samples_per_edge };
    let side = step.map(|s| s * along);
    let count: [usize; 3] = std::array::from_fn(|a| shape[a].div_ceil(side[a]));
    let mut all = vec![Vec::new(); count.iter().product()];
    let along = |a: usize| (0..shape[a]).step_by(step[a]);
    for (k, j) in along(2).flat_map(|k| along(1).map(move |j| (k, j))) {
        for i in along(0) {
            let at = grid.index(i, j, k);
            if mask.as_slice()[at] != 0 {
                all[i / side[0] + count[0] * (j / side[1] + count[1] * (k / side[2]))].push(at);
            }
        }
    }
    all.retain(|block| block.len() >= BLOCKS.min_samples);
    all
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::types::{Affine, DenseField, Grid, Volume, WorldPoint};

    fn grid() -> Grid {
        Grid::new([40, 36, 32], Affine::scaled([1.0, 1.0, 1.25], [3.0, -4.0, 5.0]).unwrap()).unwrap()
    }

    /// Waves of 5 to 9 mm.
    fn texture(p: WorldPoint) -> f64 {
        let [x, y, z] = p.0;
        100.0 + 20.0 * ((1.1 * x + 0.3 * y).sin() + (0.9 * y - 0.4 * z).sin() + (0.8 * z + 0.5 * x).cos())
    }

    fn ball(p: WorldPoint) -> bool {
        p.minus(grid().world(20, 18, 16)).iter().map(|d| d * d).sum::<f64>() < 100.0
    }

    /// What is told of frame 3 of frames 2 to 4, where all moved by 1 mm a frame along x, but in
    /// frame 3 a ball by 3 more along y; the image of frame 3 shows the ball there, where it was
    /// without that, or not at all.
    fn told(shows: Option<f64>) -> Option<(usize, OutOfLine)> {
        let g = grid();
        let reference = Volume::from_voxels(g, |_, p| texture(p) as f32);
        let field = |x: f64, y: f64| DenseField::from_fn(g, |p| [x, if ball(p) { y } else { 0.0 }, 0.0]);
        let seen = Volume::from_voxels(g, |at, p| {
            let there = p.moved([-3.0, -shows.unwrap_or(0.0), 0.0]);
            let still = p.moved([-3.0, 0.0, 0.0]);
            match (ball(there) || ball(still), shows) {
                (false, _) => texture(still) as f32,
                (true, Some(_)) => texture(there) as f32,
                (true, None) => ((at * 7919) % 50) as f32,
            }
        });
        let all = Mask::filled(g, 1);
        let mut course = Course::new(&reference, &all, 0);
        let sigma = |_: usize| 0.1;
        assert_eq!(course.add(2, &field(2.0, 0.0), &sigma, reference.view()), None);
        let second = course.add(3, &field(3.0, 3.0), &sigma, seen.view());
        assert!(second.is_none_or(|s| s.0 == 2));
        let fourth = Volume::from_voxels(g, |_, p| texture(p.moved([-4.0, 0.0, 0.0])) as f32);
        let said = course.add(4, &field(4.0, 0.0), &sigma, fourth);
        // The last frame is borne out by its image alone, and the first on the other side begins
        // again.
        assert_eq!(course.end(), None);
        assert_eq!(course.end(), None);
        said
    }

    #[test]
    fn where_there_is_no_texture_nothing_is_said() {
        let g = grid();
        let noisy = |seed: usize| Volume::from_voxels(g, move |at, _| ((at + seed) * 7919 % 101) as f32);
        let (reference, seen) = (noisy(0), noisy(5));
        let all = Mask::filled(g, 1);
        let mut course = Course::new(&reference, &all, 0);
        let field = DenseField::from_fn(g, |_| [3.0, 0.0, 0.0]);
        assert_eq!(course.add(1, &field, &|_| 0.1, seen), None);
        assert_eq!(course.end(), None);
    }

    #[test]
    fn what_the_image_does_not_bear_out_is_told() {
        for shows in [None, Some(0.0)] {
            let (frame, said) = told(shows).unwrap();
            // The ball is 4.2 of 58 ml, and in blocks more.
            assert!(frame == 3 && (0.05..0.15).contains(&said.share), "{shows:?} {said:?}");
            // Blocks at its rim have a part of it.
            assert!((1.2..3.1).contains(&said.apart_mm), "{shows:?} {said:?}");
            assert!(said.why().contains("frames 2 and 4"), "{}", said.why());
        }
        assert_eq!(told(Some(3.0)), None);
    }
}
