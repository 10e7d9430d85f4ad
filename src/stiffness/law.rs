//! Residual and tangent of one element for either law.
//!
//! Both are the stationary point of a functional of displacement u and pressure p (mixed form;
//! lambda = 2 mu nu / (1 - 2 nu)):
//!
//! ```text
//! linear:       int mu eps:eps + p div u - p^2 / (2 lambda)
//! neo-Hookean:  int mu/2 (F:F - 3) - mu ln J + p ln J - p^2 / (2 lambda)
//! ```
//!
//! so the tangent is symmetric. Eliminating p gives W = mu/2 (I1 - 3) - mu ln J + lambda/2 (ln J)^2
//! (Bonet and Wood, Nonlinear Continuum Mechanics, 2008, eq. 6.27).

use crate::numerics::dense::symmetric_eigen;
use crate::stiffness::elements::Point;
use crate::stiffness::fem_body::ELEMENT_UNKNOWNS;
use crate::types::space::{Matrix3, determinant};
use crate::types::stiffness::Law;

/// Shear modulus (kPa) and Poisson's ratio of an element.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Material {
    /// kPa.
    pub mu: f64,
    /// 0 to below 0.5.
    pub poisson: f64,
}

impl Material {
    /// Of Young's modulus `e` (kPa).
    ///
    /// ```
    /// use palpate::stiffness::law::Material;
    /// let muscle = Material::of_youngs_modulus(30.0, 0.5 - 1e-9);
    /// // Nearly incompressible tissue has a shear modulus of a third of Young's.
    /// assert!((muscle.mu - 10.0).abs() < 1e-6);
    /// ```
    pub fn of_youngs_modulus(e: f64, poisson: f64) -> Self {
        Self { mu: e / (2.0 * (1.0 + poisson)), poisson }
    }

    /// 1 / lambda (1/kPa).
    fn compliance(self) -> f64 {
        (1.0 - 2.0 * self.poisson) / (2.0 * self.mu * self.poisson.max(1e-9))
    }
}

/// The displacement gradient at a quadrature point.
fn gradient(q: &Point, x: &[f64; ELEMENT_UNKNOWNS]) -> Matrix3 {
    let mut g = [[0.0; 3]; 3];
    for k in 0..10 {
        for i in 0..3 {
            for j in 0..3 {
                g[i][j] += x[3 * k + i] * q.gradient[k][j];
            }
        }
    }
    g
}

/// What a law gives at a quadrature point.
struct State {
    /// The stress that comes with mu (P without the pressure's part), over mu.
    shear: Matrix3,
    /// What the pressure works on: I or F^-T.
    volume: Matrix3,
    /// div u or ln J.
    dilatation: f64,
}

fn state(law: Law, g: &Matrix3) -> Option<State> {
    let mut identity = [[0.0; 3]; 3];
    (0..3).for_each(|i| identity[i][i] = 1.0);
    match law {
        Law::Linear => Some(State {
            shear: std::array::from_fn(|i| std::array::from_fn(|j| g[i][j] + g[j][i])),
            volume: identity,
            dilatation: g[0][0] + g[1][1] + g[2][2],
        }),
        Law::NeoHookean => {
            let f: Matrix3 = std::array::from_fn(|i| std::array::from_fn(|j| g[i][j] + identity[i][j]));
            let det = determinant(&f);
            if det.is_nan() || det <= 0.02 {
                return None;
            }
            // Cofactors over the determinant: F^-T.
            let inverse: Matrix3 = std::array::from_fn(|i| {
                std::array::from_fn(|j| {
                    let (a, b, c, d) = ((i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3);
                    (f[a][c] * f[b][d] - f[a][d] * f[b][c]) / det
                })
            });
            let shear = std::array::from_fn(|i| std::array::from_fn(|j| f[i][j] - inverse[i][j]));
            Some(State { shear, volume: inverse, dilatation: det.ln() })
        }
    }
}

/// The element's residual; none where the material turns inside out.
pub fn residual(
    law: Law,
    points: &[Point; 4],
    m: Material,
    x: &[f64; ELEMENT_UNKNOWNS],
) -> Option<[f64; ELEMENT_UNKNOWNS]> {
    let mut r = [0.0; ELEMENT_UNKNOWNS];
    for q in points {
        let s = state(law, &gradient(q, x))?;
        let p: f64 = (0..4).map(|i| q.pressure[i] * x[30 + i]).sum();
        for k in 0..10 {
            for i in 0..3 {
                let stress = |j: usize| m.mu * s.shear[i][j] + p * s.volume[i][j];
                r[3 * k + i] += q.weight * (0..3).map(|j| stress(j) * q.gradient[k][j]).sum::<f64>();
            }
        }
        let rest = s.dilatation - p * m.compliance();
        (0..4).for_each(|i| r[30 + i] += q.weight * q.pressure[i] * rest);
    }
    Some(r)
}

/// The derivative of the residual with respect to ln mu at fixed Poisson's ratio.
pub fn residual_by_modulus(
    law: Law,
    points: &[Point; 4],
    m: Material,
    x: &[f64; ELEMENT_UNKNOWNS],
) -> Option<[f64; ELEMENT_UNKNOWNS]> {
    let mut r = [0.0; ELEMENT_UNKNOWNS];
    for q in points {
        let s = state(law, &gradient(q, x))?;
        let p: f64 = (0..4).map(|i| q.pressure[i] * x[30 + i]).sum();
        for k in 0..10 {
            for i in 0..3 {
                r[3 * k + i] += q.weight * m.mu * (0..3).map(|j| s.shear[i][j] * q.gradient[k][j]).sum::<f64>();
            }
        }
        (0..4).for_each(|i| r[30 + i] += q.weight * q.pressure[i] * p * m.compliance());
    }
    Some(r)
}

/// The element's tangent, row by row, symmetric.
pub fn tangent(
    law: Law,
    points: &[Point; 4],
    m: Material,
    x: &[f64; ELEMENT_UNKNOWNS],
) -> Option<Box<[f64; ELEMENT_UNKNOWNS * ELEMENT_UNKNOWNS]>> {
    let mut k = Box::new([0.0; ELEMENT_UNKNOWNS * ELEMENT_UNKNOWNS]);
    for q in points {
        let s = state(law, &gradient(q, x))?;
        let p: f64 = match law {
            Law::Linear => 0.0,
            Law::NeoHookean => (0..4).map(|i| q.pressure[i] * x[30 + i]).sum(),
        };
        let h: [[f64; 3]; 10] =
            q.gradient.map(|g| std::array::from_fn(|i| (0..3).map(|j| s.volume[i][j] * g[j]).sum()));
        let (one, two) = (q.weight * m.mu, q.weight * (m.mu - p));
        for a in 0..10 {
            for b in 0..=a {
                let (ga, gb) = (&q.gradient[a], &q.gradient[b]);
                let along = one * (ga[0] * gb[0] + ga[1] * gb[1] + ga[2] * gb[2]);
                for i in 0..3 {
                    let row = &mut k[(3 * a + i) * ELEMENT_UNKNOWNS + 3 * b..][..3];
                    for j in 0..3 {
                        row[j] += two * h[b][i] * h[a][j];
                    }
                    row[i] += along;
                }
            }
        }
        for i in 0..4 {
            let w = q.weight * q.pressure[i];
            for b in 0..10 {
                for j in 0..3 {
                    k[(30 + i) * ELEMENT_UNKNOWNS + 3 * b + j] += w * h[b][j];
                }
            }
            for j in 0..=i {
                k[(30 + i) * ELEMENT_UNKNOWNS + 30 + j] -= w * q.pressure[j] * m.compliance();
            }
        }
    }
    for r in 0..ELEMENT_UNKNOWNS {
        for c in r + 1..ELEMENT_UNKNOWNS {
            k[r * ELEMENT_UNKNOWNS + c] = k[c * ELEMENT_UNKNOWNS + r];
        }
    }
    Some(k)
}

/// The largest principal strain (1) at a point of the element, of the symmetric part of the
/// displacement's gradient, by size.
pub(crate) fn largest_principal_strain(q: &Point, x: &[f64; ELEMENT_UNKNOWNS]) -> f64 {
    let g = gradient(q, x);
    let strain: Matrix3 = std::array::from_fn(|i| std::array::from_fn(|j| 0.5 * (g[i][j] + g[j][i])));
    symmetric_eigen(&strain).iter().map(|e| e.0.abs()).fold(0.0, f64::max)
}
