//! How much of a wave a field returns, by its wavelength.

use crate::types::{DenseField, Mask};

/// What a row of one wavelength says: what was found of the true wave, and what there was of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Row {
    /// Wavelength (mm).
    pub wavelength: f64,
    /// Projection of the found displacement on the true wave (mm^2, summed over the row).
    pub found: f64,
    /// That of the true wave on itself.
    pub there: f64,
}

/// Part of a wave that a row of a mask must span to tell its amplitude (1).
const MIN_ROW_WAVELENGTHS: f64 = 0.75;

/// Voxels of a row that tell its amplitude, at least.
const MIN_ROW_VOXELS: usize = 30;

/// The rows of voxel axis `grow`, within `mask`, of a motion along voxel axis `moves` in waves
/// along `wave`. `fields` are averaged; `wavelength` gives that of a row (mm).
pub fn rows(
    fields: &[&DenseField],
    truth: &DenseField,
    mask: &Mask,
    [wave, grow, moves]: [usize; 3],
    wavelength: impl Fn(f64) -> f64,
) -> Vec<Row> {
    let grid = truth.grid();
    let (shape, spacing, linear) = (grid.shape(), grid.spacing(), grid.affine().linear());
    let along = |u: [f32; 3]| (0..3).map(|r| f64::from(u[r]) * linear[r][moves] / spacing[moves]).sum::<f64>();
    let mut by_row: Vec<Vec<usize>> = vec![Vec::new(); shape[grow]];
    for at in (0..grid.len()).filter(|&at| mask.as_slice()[at] != 0) {
        by_row[grid.voxel(at)[grow]].push(at);
    }
    let row = |(j, own): (usize, &Vec<usize>)| {
        let places = || own.iter().map(|&at| grid.voxel(at)[wave]);
        let span = (places().max()? + 1 - places().min()?) as f64 * spacing[wave];
        let wavelength = wavelength(j as f64);
        if own.len() < MIN_ROW_VOXELS || span < MIN_ROW_WAVELENGTHS * wavelength {
            return None;
        }
        let mean = own.iter().map(|&at| along(truth.at(at))).sum::<f64>() / own.len() as f64;
        let (mut found, mut there) = (0.0, 0.0);
        for &at in own {
            let c = along(truth.at(at)) - mean;
            found += c * fields.iter().map(|f| along(f.at(at))).sum::<f64>() / fields.len() as f64;
            there += c * c;
        }
        Some(Row { wavelength, found, there })
    };
    by_row.iter().enumerate().filter_map(row).collect()
}

/// Wavelengths in an octave at which a gain is given.
const GAINS_PER_OCTAVE: f64 = 4.0;

/// The gain at evenly spaced wavelengths (mm, on a logarithmic scale): the share of the true
/// amplitude that was found.
pub fn gains(rows: &[Row]) -> Vec<[f64; 2]> {
    let mut bins: Vec<(i64, f64, f64, f64)> = Vec::new();
    for row in rows {
        let bin = (GAINS_PER_OCTAVE * row.wavelength.log2()).round() as i64;
        match bins.iter_mut().find(|b| b.0 == bin) {
            Some(b) => (b.1, b.2, b.3) = (b.1 + row.found, b.2 + row.there, b.3 + row.there * row.wavelength),
            None => bins.push((bin, row.found, row.there, row.there * row.wavelength)),
        }
    }
    bins.sort_by_key(|b| b.0);
    bins.iter().filter(|b| b.2 > 0.0).map(|b| [b.3 / b.2, b.1 / b.2]).collect()
}

/// The wavelength (mm) where the best rising fit of the gain (isotonic, pool adjacent violators)
/// reaches `level`: none where it does not, the first where it is above from the start.
pub(crate) fn cut_off(gains: &[[f64; 2]], level: f64) -> Option<f64> {
    let mut blocks: Vec<(f64, usize)> = Vec::new();
    for &[_, gain] in gains {
        blocks.push((gain, 1));
        while let [.., (a, n), (b, m)] = blocks[..] {
            if a <= b {
                break;
            }
            blocks.truncate(blocks.len() - 2);
            blocks.push(((a * n as f64 + b * m as f64) / (n + m) as f64, n + m));
        }
    }
    let rising: Vec<f64> = blocks.iter().flat_map(|&(gain, n)| std::iter::repeat_n(gain, n)).collect();
    let first = rising.iter().position(|&g| g >= level)?;
    let wavelength = |i: usize| gains[i][0];
    match first {
        0 => Some(wavelength(0)),
        i => {
            let t = (level - rising[i - 1]) / (rising[i] - rising[i - 1]);
            Some(wavelength(i - 1) + t * (wavelength(i) - wavelength(i - 1)))
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_gain_that_rises_is_cut_where_it_crosses() {
        let gains = [[4.0, 0.0], [8.0, 0.4], [16.0, 0.8], [32.0, 1.0]];
        assert_eq!(cut_off(&gains, 0.5), Some(10.0));
        assert_eq!(cut_off(&gains, 0.9), Some(24.0));
        assert_eq!(cut_off(&gains[..3], 0.9), None);
        assert_eq!(cut_off(&gains[2..], 0.5), Some(16.0));
        assert_eq!(cut_off(&[], 0.5), None);
    }

    #[test]
    fn a_dip_is_evened_out() {
        let gains = [[4.0, 0.2], [8.0, 0.7], [16.0, 0.3], [32.0, 1.0]];
        assert_eq!(cut_off(&gains, 0.5), Some(8.0));
        assert!(cut_off(&gains, 0.75).unwrap() > 16.0);
    }
}
