//! Whether a stated uncertainty tells the truth.

use crate::numerics::filters;
use crate::numerics::statistics::noise_sigma;
use crate::types::{DenseField, Mask, Volume};
use rayon::prelude::*;

/// Half width of the band that holds 95 % of a normal distribution, in standard deviations.
pub const BAND: f64 = 1.959_964;

/// Width of the window in which texture is looked for (voxels, one standard deviation of a
/// Gaussian).
const WINDOW: f64 = 2.0;

/// Texture must stand out of the noise by this.
const STANDS_OUT: f32 = 2.0;

/// The voxels of `mask` about which `volume` shows texture: its standard deviation in a Gaussian
/// window of two voxels is twice that of the noise or more.
pub fn textured(volume: &Volume, mask: &Mask) -> Mask {
    let (data, shape) = (volume.as_slice(), volume.grid().shape());
    let inside = mask.as_slice();
    let noise = noise_sigma(data, shape, |i| inside[i] != 0);
    let squares: Vec<f32> = data.iter().map(|v| v * v).collect();
    let sigma = std::array::from_fn(|a| if shape[a] > 1 { WINDOW } else { 0.0 });
    let mean = filters::gaussian(data, shape, sigma);
    let square = filters::gaussian(&squares, shape, sigma);
    let least = (STANDS_OUT * noise).powi(2);
    Mask::from_voxels(*volume.grid(), |at, _| u8::from(inside[at] != 0 && square[at] - mean[at] * mean[at] >= least))
}

/// The share of displacement components over `mask` whose error is inside 1.96 of `sigma` (mm, one
/// standard deviation along an axis, by voxel); none for an empty mask. The axis across a single
/// slice does not count.
pub fn coverage(
    field: &DenseField,
    truth: &DenseField,
    sigma: &(dyn Fn(usize) -> f32 + Sync),
    mask: &Mask,
) -> Option<f64> {
    let inside = mask.as_slice();
    let flat = field.grid().is_single_slice();
    let (good, all) = (0..inside.len())
        .into_par_iter()
        .filter(|&at| inside[at] != 0)
        .map(|at| {
            let (u, t) = (field.at(at), truth.at(at));
            let band = BAND * f64::from(sigma(at));
            let counted = |c: &usize| !(flat && u[*c] == 0.0 && t[*c] == 0.0);
            let axes = (0..3).filter(counted).count();
            let good = (0..3).filter(counted).filter(|&c| f64::from((u[c] - t[c]).abs()) <= band).count();
            (good, axes)
        })
        .reduce(|| (0, 0), |a, b| (a.0 + b.0, a.1 + b.1));
    (all > 0).then(|| good as f64 / all as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::numerics::random::Random;
    use crate::types::{Affine, Grid};

    #[test]
    fn normal_errors_fill_the_band_as_normal_errors_do() {
        let affine = Affine::scaled([1.0; 3], [0.0; 3]).unwrap_or_else(|e| panic!("{e}"));
        let grid = Grid::new([40, 40, 20], affine).unwrap_or_else(|e| panic!("{e}"));
        let truth = DenseField::zeros(grid);
        let mut random = Random::new(7, 0);
        let mut field = DenseField::zeros(grid);
        field.as_mut_slice().iter_mut().for_each(|v| *v = 0.5 * random.normals()[0] as f32);
        let all = Mask::filled(grid, 1);
        let share = |sigma: f32| coverage(&field, &truth, &|_| sigma, &all).unwrap_or(f64::NAN);
        assert!((share(0.5) - 0.95).abs() < 0.003, "{}", share(0.5));
        assert!((share(0.25) - 0.6729).abs() < 0.006, "{}", share(0.25));
        assert_eq!(coverage(&field, &truth, &|_| 1.0, &Mask::filled(grid, 0)), None);
    }

    #[test]
    fn only_what_stands_out_of_the_noise_is_texture() {
        let affine = Affine::scaled([1.0; 3], [0.0; 3]).unwrap_or_else(|e| panic!("{e}"));
        let grid = Grid::new([48, 24, 24], affine).unwrap_or_else(|e| panic!("{e}"));
        let noise = |at: usize| Random::new(3, at as u64).normals()[0];
        let volume = Volume::from_voxels(grid, |at, p| {
            let wave = if p.0[0] < 24.0 { 100.0 * (p.0[0] * 0.9).sin() * (p.0[1] * 0.7).cos() } else { 0.0 };
            (500.0 + wave + 10.0 * noise(at)) as f32
        });
        let found = textured(&volume, &Mask::filled(grid, 1));
        let share = |low: usize, high: usize| {
            let voxels = (0..grid.len()).filter(|&at| (low..high).contains(&grid.voxel(at)[0]));
            let (n, all) = voxels.fold((0, 0), |s, at| (s.0 + usize::from(found.as_slice()[at]), s.1 + 1));
            n as f64 / f64::from(all)
        };
        assert!(share(0, 20) > 0.95 && share(32, 48) < 0.02, "{} {}", share(0, 20), share(32, 48));
    }
}
