//! Small dense matrices as arrays of rows: solving, rank, eigenvalues.

/// A square matrix, `m[row][column]`.
pub type Square<const N: usize> = [[f64; N]; N];

/// The scalar product of two vectors of one length.
pub fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Solves `a x = b` by Gauss elimination with row pivots; none when a pivot vanishes against the
/// largest entry.
pub fn solve<const N: usize>(a: &Square<N>, b: &[f64; N]) -> Option<[f64; N]> {
    let (mut m, mut x) = (*a, *b);
    let largest = m.iter().flatten().fold(0.0, |l: f64, v| l.max(v.abs()));
    for k in 0..N {
        let pivot = (k..N).max_by(|&i, &j| m[i][k].abs().total_cmp(&m[j][k].abs()))?;
        let vanishes = m[pivot][k].abs() <= 1e-14 * largest;
        if vanishes || !m[pivot][k].is_finite() {
            return None;
        }
        m.swap(k, pivot);
        x.swap(k, pivot);
        for i in k + 1..N {
            let factor = m[i][k] / m[k][k];
            for j in k..N {
                m[i][j] -= factor * m[k][j];
            }
            x[i] -= factor * x[k];
        }
    }
    for k in (0..N).rev() {
        for j in k + 1..N {
            x[k] -= m[k][j] * x[j];
        }
        x[k] /= m[k][k];
    }
    x.iter().all(|v| v.is_finite()).then_some(x)
}

/// Rank of the matrix whose rows are `rows`: directions left by Gram-Schmidt with row pivots that
/// are longer than `tolerance` times the longest row.
pub fn rank<const N: usize>(rows: &[[f64; N]], tolerance: f64) -> usize {
    let mut rest: Vec<[f64; N]> = rows.to_vec();
    let length = |r: &[f64; N]| r.iter().map(|v| v * v).sum::<f64>().sqrt();
    let longest = rest.iter().map(length).fold(0.0, f64::max);
    let mut found = 0;
    while let Some(at) = (0..rest.len()).max_by(|&i, &j| length(&rest[i]).total_cmp(&length(&rest[j]))) {
        let taken = rest.swap_remove(at);
        let norm = length(&taken);
        if norm <= tolerance * longest || norm == 0.0 {
            break;
        }
        found += 1;
        for row in &mut rest {
            let along = (0..N).map(|k| row[k] * taken[k]).sum::<f64>() / (norm * norm);
            for k in 0..N {
                row[k] -= along * taken[k];
            }
        }
    }
    found
}

/// Eigenvalues of a symmetric matrix in rising order, with their unit vectors (Jacobi rotations;
/// Golub and Van Loan, Matrix Computations, 8.5).
pub fn symmetric_eigen<const N: usize>(a: &Square<N>) -> [(f64, [f64; N]); N] {
    let mut m = *a;
    let mut v = [[0.0; N]; N];
    for k in 0..N {
        v[k][k] = 1.0;
    }
    for _ in 0..60 {
        let off: f64 = (0..N).flat_map(|i| (0..i).map(move |j| (i, j))).map(|(i, j)| m[i][j] * m[i][j]).sum();
        let diagonal: f64 = (0..N).map(|i| m[i][i] * m[i][i]).sum();
        if off <= 1e-34 * diagonal || !off.is_finite() {
            break;
        }
        for p in 0..N {
            for q in p + 1..N {
                if m[p][q] == 0.0 {
                    continue;
                }
                let tau = (m[q][q] - m[p][p]) / (2.0 * m[p][q]);
                let t = if tau == 0.0 { 1.0 } else { tau.signum() / (tau.abs() + (1.0 + tau * tau).sqrt()) };
                let c = 1.0 / (1.0 + t * t).sqrt();
                let s = t * c;
                for k in 0..N {
                    (m[k][p], m[k][q]) = (c * m[k][p] - s * m[k][q], s * m[k][p] + c * m[k][q]);
                }
                for k in 0..N {
                    (m[p][k], m[q][k]) = (c * m[p][k] - s * m[q][k], s * m[p][k] + c * m[q][k]);
                    (v[k][p], v[k][q]) = (c * v[k][p] - s * v[k][q], s * v[k][p] + c * v[k][q]);
                }
            }
        }
    }
    let mut pairs: [(f64, [f64; N]); N] = std::array::from_fn(|k| (m[k][k], std::array::from_fn(|i| v[i][k])));
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
    pairs
}

/// Spectral radius of a square matrix: the growth of its powers, by repeated squaring (Gelfand's
/// formula at the power 2^24, so a factor K that powers keep is felt as `K^(1/2^24)`). Infinite
/// where the matrix holds NaN or infinity.
pub(crate) fn spectral_radius<const N: usize>(a: &Square<N>) -> f64 {
    const SQUARINGS: i32 = 24;
    let mut m = *a;
    let mut log = 0.0;
    for k in 0..=SQUARINGS {
        if !m.iter().flatten().all(|v| v.is_finite()) {
            return f64::INFINITY;
        }
        let norm = m.iter().flatten().fold(0.0, |l: f64, v| l.max(v.abs()));
        if norm == 0.0 {
            return 0.0;
        }
        log += norm.ln() / f64::from(k).exp2();
        if k == SQUARINGS {
            break;
        }
        let unit = m.map(|row| row.map(|v| v / norm));
        let mut square = [[0.0; N]; N];
        for i in 0..N {
            for k in 0..N {
                let f = unit[i][k];
                for j in 0..N {
                    square[i][j] += f * unit[k][j];
                }
            }
        }
        m = square;
    }
    log.exp()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_system_is_solved_and_a_singular_one_is_not() {
        let a = [[0.0, 2.0, 1.0], [1.0, -1.0, 0.0], [3.0, 0.0, -2.0]];
        let x = [0.5, -2.0, 4.0];
        let b = a.map(|row| (0..3).map(|k| row[k] * x[k]).sum());
        let found = solve(&a, &b).unwrap();
        assert!((0..3).all(|k| (found[k] - x[k]).abs() < 1e-14), "{found:?}");
        assert!(solve(&[[1.0, 2.0], [2.0, 4.0]], &[1.0, 1.0]).is_none());
        assert!(solve(&[[f64::NAN, 0.0], [0.0, 1.0]], &[1.0, 1.0]).is_none());
    }

    #[test]
    fn ranks_are_counted() {
        assert_eq!(rank(&[[1.0, 0.0, 0.0], [1.0, 1e-3, 0.0], [2.0, 5.0, 0.0]], 1e-9), 2);
        assert_eq!(rank(&[[1.0, 2.0], [2.0, 4.0]], 1e-9), 1);
        assert_eq!(rank(&[[0.0, 0.0]], 1e-9), 0);
    }

    #[test]
    fn eigenvalues_rise_and_vectors_belong_to_them() {
        let a = [[4.0, 1.0, -2.0], [1.0, 2.0, 0.0], [-2.0, 0.0, 3.0]];
        let pairs = symmetric_eigen(&a);
        assert!(pairs[0].0 <= pairs[1].0 && pairs[1].0 <= pairs[2].0);
        for (value, vector) in pairs {
            for i in 0..3 {
                let row: f64 = (0..3).map(|k| a[i][k] * vector[k]).sum();
                assert!((row - value * vector[i]).abs() < 1e-13);
            }
        }
        assert!((pairs.iter().map(|p| p.0).sum::<f64>() - 9.0).abs() < 1e-13);
    }

    #[test]
    fn the_spectral_radius_of_a_rotation_a_decay_and_a_shear() {
        let (s, c) = 0.3f64.sin_cos();
        let near = |m: Square<2>, r: f64| assert!((spectral_radius(&m) - r).abs() < 3e-6, "{}", spectral_radius(&m));
        near([[c, -s], [s, c]], 1.0);
        near([[0.9 * c, -0.9 * s], [0.9 * s, 0.9 * c]], 0.9);
        near([[1.0, 100.0], [0.0, 1.0]], 1.0);
        near([[0.0, 4.0], [1.0, 0.0]], 2.0);
        assert_eq!(spectral_radius(&[[0.0, 1.0], [0.0, 0.0]]), 0.0);
        assert_eq!(spectral_radius(&[[f64::NAN, 1.0], [0.0, 0.0]]), f64::INFINITY);
    }
}
