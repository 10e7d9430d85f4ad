//! A bicubic spline over a rectangle, with its first and second derivatives.
//!
//! Interpolates values on a regular grid by cubic B-splines (Unser 1999): constant and linear data
//! come back exactly, smooth data to fourth order inside. Ends along the first axis and the far end
//! along the second are natural (no curvature); at 0 along the second the surface is mirrored, for
//! functions that are even there.

/// Value, first derivatives (x, y) and second derivatives (xx, xy, yy).
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Jet {
    /// The value.
    pub value: f64,
    /// Derivatives by x and y.
    pub slope: [f64; 2],
    /// Derivatives by xx, xy and yy.
    pub bend: [f64; 3],
}

/// A surface over [0, end x] times [0, end y].
#[derive(Debug, Clone, PartialEq)]
pub struct Surface {
    step: [f64; 2],
    count: [usize; 2],
    /// With one more on each side, x fastest.
    coefficients: Vec<f64>,
}

impl Surface {
    /// Through `value(x, y)` at `count` places along each axis (4 at least) up to `end`.
    pub fn new(end: [f64; 2], count: [usize; 2], value: impl Fn(f64, f64) -> f64) -> Self {
        let [nx, ny] = count.map(|n| n.max(4));
        let step = [end[0] / (nx - 1) as f64, end[1] / (ny - 1) as f64];
        let width = nx + 2;
        let mut coefficients = vec![0.0; width * (ny + 2)];
        for j in 0..ny {
            let row: Vec<f64> = (0..nx).map(|i| value(i as f64 * step[0], j as f64 * step[1])).collect();
            coefficients[(j + 1) * width..(j + 2) * width].copy_from_slice(&fit(&row, false));
        }
        for i in 0..width {
            let column: Vec<f64> = (0..ny).map(|j| coefficients[(j + 1) * width + i]).collect();
            fit(&column, true).iter().enumerate().for_each(|(j, c)| coefficients[j * width + i] = *c);
        }
        Self { step, count: [nx, ny], coefficients }
    }

    /// At (x, |y|); beyond the ends the surface goes on as it leaves them.
    pub fn at(&self, x: f64, y: f64) -> Jet {
        let cell = |v: f64, a: usize| {
            let at = (v / self.step[a]).clamp(0.0, (self.count[a] - 1) as f64);
            let i = (at as usize).min(self.count[a] - 2);
            (i, basis(at - i as f64))
        };
        let ((i, wx), (j, wy)) = (cell(x, 0), cell(y.abs(), 1));
        let width = self.count[0] + 2;
        let sum = |kx: usize, ky: usize| -> f64 {
            let row = |b: usize| -> f64 {
                let start = (j + b) * width + i;
                self.coefficients[start..start + 4].iter().zip(wx[kx]).map(|(c, w)| c * w).sum()
            };
            let total: f64 = (0..4).map(|b| wy[ky][b] * row(b)).sum();
            total / (self.step[0].powi(kx as i32) * self.step[1].powi(ky as i32))
        };
        let sign = if y < 0.0 { -1.0 } else { 1.0 };
        Jet { value: sum(0, 0), slope: [sum(1, 0), sign * sum(0, 1)], bend: [sum(2, 0), sign * sum(1, 1), sum(0, 2)] }
    }
}

/// Weights of four coefficients at `t` in 0 to 1 past the second: for value, slope and curvature.
fn basis(t: f64) -> [[f64; 4]; 3] {
    let s = 1.0 - t;
    let value =
        [s * s * s / 6.0, 2.0 / 3.0 - t * t * (1.0 - t / 2.0), 2.0 / 3.0 - s * s * (1.0 - s / 2.0), t * t * t / 6.0];
    let slope = [-s * s / 2.0, t * (1.5 * t - 2.0), s * (2.0 - 1.5 * s), t * t / 2.0];
    [value, slope, [s, 3.0 * t - 2.0, 3.0 * s - 2.0, t]]
}

/// The coefficients, one more on each side, that interpolate `values`: (c[i-1] + 4 c[i] + c[i+1]) /
/// 6 = v[i].
fn fit(values: &[f64], mirrored: bool) -> Vec<f64> {
    let n = values.len();
    // A natural end has c = v there; a mirrored one 4 c[0] + 2 c[1] = 6 v[0].
    let (mut upper, mut c) = (vec![0.0; n], vec![0.0; n]);
    let row = |i: usize| match i {
        0 if mirrored => (0.0, 4.0, 2.0, 6.0),
        0 => (0.0, 1.0, 0.0, 1.0),
        i if i == n - 1 => (0.0, 1.0, 0.0, 1.0),
        _ => (1.0, 4.0, 1.0, 6.0),
    };
    for i in 0..n {
        let (low, middle, high, right) = row(i);
        let (before, previous) = if i > 0 { (upper[i - 1], c[i - 1]) } else { (0.0, 0.0) };
        let pivot = middle - low * before;
        upper[i] = high / pivot;
        c[i] = (right * values[i] - low * previous) / pivot;
    }
    for i in (0..n - 1).rev() {
        c[i] -= upper[i] * c[i + 1];
    }
    let first = if mirrored { c[1] } else { 2.0 * c[0] - c[1] };
    let last = 2.0 * c[n - 1] - c[n - 2];
    [&[first][..], &c, &[last]].concat()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn smooth_surfaces_come_back_with_their_derivatives() {
        let f = |x: f64, y: f64| (1.3 * x).sin() * (0.9 * y).cos();
        let surface = Surface::new([2.0, 1.5], [65, 65], f);
        for (x, y) in [(0.7, 0.4), (1.21, -0.83), (1.0, 0.0)] {
            let jet = surface.at(x, y);
            assert!((jet.value - f(x, y)).abs() < 1e-6);
            assert!((jet.slope[0] - 1.3 * (1.3 * x).cos() * (0.9 * y).cos()).abs() < 1e-4);
            assert!((jet.slope[1] + 0.9 * (1.3 * x).sin() * (0.9 * y).sin()).abs() < 1e-4);
            assert!((jet.bend[0] + 1.69 * f(x, y)).abs() < 3e-3);
            assert!((jet.bend[1] + 1.17 * (1.3 * x).cos() * (0.9 * y).sin()).abs() < 3e-3);
            assert!((jet.bend[2] + 0.81 * f(x, y)).abs() < 3e-3);
        }
    }

    #[test]
    fn constants_are_exact() {
        let jet = Surface::new([1.0, 1.0], [9, 7], |_, _| 3.7).at(0.313, -0.77);
        assert!((jet.value - 3.7).abs() < 1e-14);
        assert!(jet.slope.iter().chain(&jet.bend).all(|v| v.abs() < 1e-11));
    }
}
