//! Generalised minimal residuals (Saad and Schultz, SIAM J. Sci. Stat. Comput. 7, 1986) for several
//! right-hand sides in lockstep, each with a space of its own.
//!
//! A block of vectors keeps the numbers of all sides beside each other: a matrix is read once for
//! all of them. Numbers are in single precision, sums in double precision and in a fixed order.

use crate::numerics::simd::dispatch;

/// Most vectors of one Krylov space: bounds their memory and the work of orthogonalisation.
const MAX_VECTORS: usize = 30;
/// Numbers summed in single precision before they are added in double precision.
const SINGLE_PRECISION_TERMS: usize = 32;

/// `L` vectors, interleaved.
pub type Block<const L: usize> = Vec<[f32; L]>;

/// Inner products under `weights`, side by side.
fn products<const L: usize>(weights: &[f32], a: &[[f32; L]], b: &[[f32; L]]) -> [f64; L] {
    dispatch(
        #[inline(always)]
        || {
            let mut out = [0.0f64; L];
            for ((w, a), b) in weights
                .chunks(SINGLE_PRECISION_TERMS)
                .zip(a.chunks(SINGLE_PRECISION_TERMS))
                .zip(b.chunks(SINGLE_PRECISION_TERMS))
            {
                let mut part = [0.0f32; L];
                for ((w, a), b) in w.iter().zip(a).zip(b) {
                    (0..L).for_each(|l| part[l] += w * a[l] * b[l]);
                }
                (0..L).for_each(|l| out[l] += f64::from(part[l]));
            }
            out
        },
    )
}

/// Norms under `weights`, side by side.
pub(crate) fn norms<const L: usize>(weights: &[f32], a: &[[f32; L]]) -> [f64; L] {
    products(weights, a, a).map(f64::sqrt)
}

/// Adds `by` times `b` to `a`.
fn add<const L: usize>(a: &mut [[f32; L]], by: [f64; L], b: &[[f32; L]]) {
    let by = by.map(|v| v as f32);
    dispatch(
        #[inline(always)]
        || a.iter_mut().zip(b).for_each(|(a, b)| (0..L).for_each(|l| a[l] += by[l] * b[l])),
    );
}

/// Divides by norms; what vanishes stays.
fn scale<const L: usize>(a: &mut [[f32; L]], by: [f64; L]) {
    let by = by.map(|v| if v > f64::from(f32::MIN_POSITIVE) { (1.0 / v) as f32 } else { 0.0 });
    a.iter_mut().for_each(|a| (0..L).for_each(|l| a[l] *= by[l]));
}

/// One side's least-squares problem, kept triangular by rotations.
#[derive(Default)]
struct Triangle {
    columns: Vec<Vec<f64>>,
    rotations: Vec<[f64; 2]>,
    right: Vec<f64>,
}

impl Triangle {
    /// Takes the next column of the Hessenberg matrix; the norm of what is left.
    fn push(&mut self, mut column: Vec<f64>) -> f64 {
        let k = self.columns.len();
        for (i, [c, s]) in self.rotations.iter().enumerate() {
            (column[i], column[i + 1]) = (c * column[i] + s * column[i + 1], c * column[i + 1] - s * column[i]);
        }
        let size = column[k].hypot(column[k + 1]);
        let [c, s] = if size > 0.0 { [column[k] / size, column[k + 1] / size] } else { [1.0, 0.0] };
        column[k] = size;
        let last = self.right[k];
        self.right[k] = c * last;
        self.right.push(-s * last);
        self.rotations.push([c, s]);
        self.columns.push(column);
        (s * last).abs()
    }

    fn solved(&self) -> Vec<f64> {
        let n = self.columns.len();
        let mut y = vec![0.0; n];
        for i in (0..n).rev() {
            let rest = self.right[i] - (i + 1..n).map(|k| self.columns[k][i] * y[k]).sum::<f64>();
            y[i] = if self.columns[i][i] > 0.0 { rest / self.columns[i][i] } else { 0.0 };
        }
        y
    }
}

/// What `apply` takes to `right`, to `goals` (norms of what is left, side by side), or as near as
/// one space comes.
pub fn solve<const L: usize>(
    mut right: Block<L>,
    weights: &[f32],
    goals: [f64; L],
    mut apply: impl FnMut(&[[f32; L]]) -> Block<L>,
) -> Block<L> {
    let sizes = norms(weights, &right);
    scale(&mut right, sizes);
    let mut triangles: Vec<Triangle> =
        sizes.iter().map(|&size| Triangle { right: vec![size], ..Triangle::default() }).collect();
    let mut space = vec![right];
    loop {
        let mut next = apply(&space[space.len() - 1]);
        let mut column = Vec::with_capacity(space.len() + 1);
        for v in &space {
            let along = products(weights, v, &next);
            add(&mut next, along.map(|a| -a), v);
            column.push(along);
        }
        let size = norms(weights, &next);
        column.push(size);
        let left: [f64; L] = std::array::from_fn(|l| triangles[l].push(column.iter().map(|c| c[l]).collect()));
        if space.len() == MAX_VECTORS || (0..L).all(|l| left[l] <= goals[l]) || left.iter().any(|v| !v.is_finite()) {
            break;
        }
        scale(&mut next, size);
        space.push(next);
    }
    let parts: Vec<Vec<f64>> = triangles.iter().map(Triangle::solved).collect();
    let mut out = vec![[0.0; L]; weights.len()];
    for (k, v) in space.iter().enumerate() {
        add(&mut out, std::array::from_fn(|l| parts[l][k]), v);
    }
    out
}
