//! The measured motion of a patch, smoothed by no more than its noise asks for.
//!
//! Polynomials of the place in the patch's own axes are fitted by least squares. Their degree is
//! the one of least Bayesian information criterion (Schwarz 1978). What they leave over is kept in
//! the part that stands out of the error of a reading (Wiener 1949): a sharp field keeps the edge
//! of a probe, a noisy one does not keep its noise.

use crate::numerics::dense::symmetric_eigen;
use crate::types::space::dot;

/// Highest polynomial degree: 84 functions in space, 28 on a plane.
const MAX_DEGREE: usize = 6;
/// Part of a function that is orthogonal to those before it, from which it counts as another one.
const MIN_INDEPENDENT_FRACTION: f64 = 1e-3;

/// Displacements at the nodes of a patch.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Smoothed {
    /// Displacement of each node (mm, RAS).
    pub values: Vec<[f64; 3]>,
    /// Functions that each component took.
    pub functions: usize,
}

impl Smoothed {
    /// From what was read at the nodes (mm, RAS; none where nothing was), with the least and the
    /// typical error of a reading (mm, one component), and how many of the readings are
    /// independent.
    pub fn new(places: &[[f64; 3]], read: &[Option<[f64; 3]>], [least, error]: [f64; 2], independent: f64) -> Self {
        let seen = read.iter().flatten().count();
        let independent = independent.clamp(1.0, seen.max(1) as f64);
        let mut rest: Vec<[f64; 3]> = read.iter().map(|r| r.unwrap_or_default()).collect();
        let mut fit = vec![[0.0; 3]; places.len()];
        let mean_square = |rest: &[[f64; 3]]| {
            let all = rest.iter().zip(read).filter(|(_, r)| r.is_some());
            all.map(|(v, _)| dot(*v, *v)).sum::<f64>() / (3.0 * seen.max(1) as f64)
        };
        let score = |rest: &[[f64; 3]], functions: usize| {
            3.0 * (independent * (mean_square(rest) + least * least).ln()
                + functions as f64 * independent.max(2.0).ln())
        };
        let mut best = (score(&rest, 0), fit.clone(), rest.clone(), 0);
        let mut basis: Vec<Vec<f64>> = Vec::new();
        for functions in degrees(places) {
            for f in functions {
                let Some(f) = orthonormal(f, &basis, read) else { continue };
                let along: [f64; 3] = std::array::from_fn(|a| inner(&f, read, |i| rest[i][a]));
                for (i, f) in f.iter().enumerate() {
                    (0..3)
                        .for_each(|a| (fit[i][a], rest[i][a]) = (fit[i][a] + along[a] * f, rest[i][a] - along[a] * f));
                }
                basis.push(f);
            }
            if 2.0 * basis.len() as f64 > independent {
                break;
            }
            let now = score(&rest, basis.len());
            if now < best.0 {
                best = (now, fit.clone(), rest.clone(), basis.len());
            }
        }
        let (_, mut values, rest, functions) = best;
        let left = mean_square(&rest);
        let kept = (1.0 - error * error / left.max(f64::MIN_POSITIVE)).max(0.0);
        for ((v, rest), read) in values.iter_mut().zip(&rest).zip(read) {
            if read.is_some() {
                (0..3).for_each(|a| v[a] += kept * rest[a]);
            }
        }
        Self { values, functions }
    }
}

fn inner(f: &[f64], read: &[Option<[f64; 3]>], g: impl Fn(usize) -> f64) -> f64 {
    (0..f.len()).filter(|&i| read[i].is_some()).map(|i| f[i] * g(i)).sum()
}

/// What `f` has besides the basis, of length 1 over what was read; none where that is next to
/// nothing.
fn orthonormal(mut f: Vec<f64>, basis: &[Vec<f64>], read: &[Option<[f64; 3]>]) -> Option<Vec<f64>> {
    let whole = inner(&f, read, |i| f[i]).sqrt();
    // Twice is enough (Parlett 1980).
    for b in basis.iter().chain(basis) {
        let along = inner(&f, read, |i| b[i]);
        f.iter_mut().zip(b).for_each(|(f, b)| *f -= along * b);
    }
    let length = inner(&f, read, |i| f[i]).sqrt();
    (length > MIN_INDEPENDENT_FRACTION * whole && length > 0.0).then(|| f.iter().map(|v| v / length).collect())
}

/// Products of Legendre polynomials of the places in their principal axes, degree by degree.
fn degrees(places: &[[f64; 3]]) -> Vec<Vec<Vec<f64>>> {
    let n = places.len().max(1) as f64;
    let middle: [f64; 3] = std::array::from_fn(|a| places.iter().map(|p| p[a]).sum::<f64>() / n);
    let from: Vec<[f64; 3]> = places.iter().map(|p| std::array::from_fn(|a| p[a] - middle[a])).collect();
    let moment = |a: usize, b: usize| from.iter().map(|d| d[a] * d[b]).sum::<f64>() / n;
    let axes = symmetric_eigen(&std::array::from_fn(|a| std::array::from_fn(|b| moment(a, b)))).map(|e| e.1);
    // One scale for all axes: the thickness of an almost flat patch shall not decide.
    let reach = from.iter().map(|d| dot(*d, *d)).fold(0.0, f64::max).sqrt().max(f64::MIN_POSITIVE);
    let tables: [Vec<[f64; MAX_DEGREE + 1]>; 3] =
        axes.map(|axis| from.iter().map(|d| legendre(dot(*d, axis) / reach)).collect());
    let product = |powers: [usize; 3]| -> Vec<f64> {
        (0..places.len()).map(|i| (0..3).map(|a| tables[a][i][powers[a]]).product()).collect()
    };
    let of_degree = |degree: usize| {
        let all = (0..=degree).flat_map(move |i| (0..=degree - i).map(move |j| [degree - i - j, j, i]));
        all.map(product).collect()
    };
    (0..=MAX_DEGREE).map(of_degree).collect()
}

fn legendre(x: f64) -> [f64; MAX_DEGREE + 1] {
    let mut p = [1.0; MAX_DEGREE + 1];
    p[1] = x;
    for k in 1..MAX_DEGREE {
        let n = k as f64;
        p[k + 1] = ((2.0 * n + 1.0) * x * p[k] - n * p[k - 1]) / (n + 1.0);
    }
    p
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::numerics::random::Random;

    fn places() -> Vec<[f64; 3]> {
        (0..900).map(|i| [f64::from(i % 30), f64::from(i / 30), 7.0]).collect()
    }

    fn cap(p: &[f64; 3]) -> [f64; 3] {
        let r2 = (p[0] - 14.0).powi(2) + (p[1] - 15.0).powi(2);
        [0.01 * p[1], 0.0, -1.0 + 0.002 * r2]
    }

    #[test]
    fn a_rounded_probe_is_read_through_noise() {
        let mut random = Random::new(3, 0);
        let (places, noise) = (places(), 0.05);
        let read: Vec<_> = places
            .iter()
            .map(|p| {
                let n = [random.normals(), random.normals()].concat();
                Some(std::array::from_fn(|a| cap(p)[a] + noise * n[a]))
            })
            .collect();
        let found = Smoothed::new(&places, &read, [1e-4, noise], 900.0);
        assert_eq!(found.functions, 6);
        let off = found.values.iter().zip(&places).map(|(v, p)| (v[2] - cap(p)[2]).powi(2)).sum::<f64>() / 900.0;
        assert!(off.sqrt() < 0.3 * noise, "{}", off.sqrt());
    }

    #[test]
    fn what_is_sharp_and_without_noise_is_kept() {
        let places = places();
        let step = |p: &[f64; 3]| [0.0, 0.0, if p[0] < 12.5 { -1.0 } else { 0.0 }];
        let read: Vec<_> = places.iter().map(|p| Some(step(p))).collect();
        let found = Smoothed::new(&places, &read, [1e-4, 1e-3], 900.0);
        let worst = found.values.iter().zip(&places).map(|(v, p)| (v[2] - step(p)[2]).abs()).fold(0.0, f64::max);
        assert!(worst < 1e-3, "{worst}");
    }

    #[test]
    fn noise_alone_takes_no_function_and_a_missing_reading_is_filled_in() {
        let mut random = Random::new(4, 0);
        let places = places();
        let mut noise = || {
            let n = random.normals();
            Some(std::array::from_fn(|a| if a < 2 { 0.1 * n[a] } else { 0.0 }))
        };
        let read: Vec<_> = places.iter().map(|_| noise()).collect();
        assert_eq!(Smoothed::new(&places, &read, [1e-4, 0.1], 900.0).functions, 0);
        let read: Vec<_> = places.iter().enumerate().map(|(i, p)| (i % 5 > 0).then(|| cap(p))).collect();
        let found = Smoothed::new(&places, &read, [1e-4, 1e-4], 700.0);
        let worst = found.values.iter().zip(&places).map(|(v, p)| (v[2] - cap(p)[2]).abs()).fold(0.0, f64::max);
        assert!(worst < 1e-9, "{worst}");
        assert_eq!(Smoothed::new(&[], &[], [1e-4, 0.1], 0.0), Smoothed::default());
    }
}
