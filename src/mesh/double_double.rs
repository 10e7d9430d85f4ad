//! Numbers of twice the precision of f64: an unevaluated sum of two.
//!
//! Source: M. Joldes, J.-M. Muller, V. Popescu, "Tight and rigorous error bounds for basic building
//! blocks of double-word arithmetic", ACM TOMS 44 (2017): with u = 2^-53, a sum errs by at most
//! about 3 u^2 of itself (`AccurateDWPlusDW`), a product by 5 u^2 (`DWTimesDW1`).

use std::ops::{Add, Mul, Neg, Sub};

/// `high + low`, where `low` is at most half a unit in the last place of `high`.
#[derive(Clone, Copy)]
pub(super) struct DoubleDouble {
    high: f64,
    low: f64,
}

impl DoubleDouble {
    /// `a - b`, exactly.
    pub(super) fn difference(a: f64, b: f64) -> Self {
        two_sum(a, -b)
    }

    /// The nearest f64.
    pub(super) fn rounded(self) -> f64 {
        self.high
    }
}

/// `a + b` exactly, for any two.
fn two_sum(a: f64, b: f64) -> DoubleDouble {
    let high = a + b;
    let part = high - a;
    DoubleDouble { high, low: (a - (high - part)) + (b - part) }
}

/// `a + b` exactly, where `a` is the larger.
fn fast_two_sum(a: f64, b: f64) -> DoubleDouble {
    let high = a + b;
    DoubleDouble { high, low: b - (high - a) }
}

/// `a b` exactly (Dekker; a fused multiply-add is not on every machine).
fn two_product(a: f64, b: f64) -> DoubleDouble {
    let split = |v: f64| {
        let c = 134_217_729.0 * v;
        let high = c - (c - v);
        (high, v - high)
    };
    let ((p, q), (r, s)) = (split(a), split(b));
    let high = a * b;
    DoubleDouble { high, low: q * s - (((high - p * r) - q * r) - p * s) }
}

impl Add for DoubleDouble {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        let (s, t) = (two_sum(self.high, other.high), two_sum(self.low, other.low));
        let v = fast_two_sum(s.high, s.low + t.high);
        fast_two_sum(v.high, v.low + t.low)
    }
}

impl Neg for DoubleDouble {
    type Output = Self;

    fn neg(self) -> Self {
        Self { high: -self.high, low: -self.low }
    }
}

impl Sub for DoubleDouble {
    type Output = Self;

    fn sub(self, other: Self) -> Self {
        self + -other
    }
}

impl Mul for DoubleDouble {
    type Output = Self;

    fn mul(self, other: Self) -> Self {
        let p = two_product(self.high, other.high);
        fast_two_sum(p.high, p.low + (self.high * other.low + self.low * other.high))
    }
}
