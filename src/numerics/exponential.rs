//! Exponential and logarithm in single precision, without branches, so that inner loops over them
//! are vectorised; the same bits on every machine.

/// Terms of a series from the highest power down (Horner).
#[inline(always)]
fn series<const N: usize>(x: f32, terms: [f32; N]) -> f32 {
    let mut sum = 0.0;
    for t in terms {
        sum = sum * x + t;
    }
    sum
}

/// 1.5 * 2^23: adding it rounds a small number to an integer, which then stands in the lowest bits.
pub(crate) const ROUND_TO_INTEGER: f32 = 12_582_912.0;

/// ln 2 as a sum of two: the first has so few digits that its products with exponents are exact.
const LN_2_PARTS: [f32; 2] = [0.693_359_4, -2.121_944_4e-4];

/// `e^x` within 2e-7 of itself, for x held to -87 to 88 (what single precision holds); NaN for NaN.
///
/// The power of two next to it times the Taylor series of what remains, |r| <= ln 2 / 2, to r^7
/// (5e-9).
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    let x = x.clamp(-87.0, 88.0);
    let shifted = x * std::f32::consts::LOG2_E + ROUND_TO_INTEGER;
    let n = shifted - ROUND_TO_INTEGER;
    let r = (x - n * LN_2_PARTS[0]) - n * LN_2_PARTS[1];
    let terms = [1.0 / 5040.0, 1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0];
    let power = f32::from_bits(shifted.to_bits().wrapping_shl(23).wrapping_add(127 << 23));
    series(r, terms) * power
}

/// ln x within 1.5e-7 of the larger of itself and 1, for positive x that single precision holds at
/// full length; what is less, and NaN, counts as the least of these.
///
/// With x = 2^n m, m from sqrt(1/2) to sqrt(2): n ln 2 + 2 artanh s, s = (m - 1) / (m + 1), its
/// series to s^9 (7e-10).
#[inline(always)]
pub fn ln(x: f32) -> f32 {
    let bits = x.max(f32::MIN_POSITIVE).to_bits();
    // So that the mantissa's half above sqrt(2) carries into the exponent.
    let above = bits.wrapping_sub(std::f32::consts::FRAC_1_SQRT_2.to_bits()) as i32 >> 23;
    let m = f32::from_bits(bits.wrapping_sub((above << 23) as u32));
    let (n, s) = (above as f32, (m - 1.0) / (m + 1.0));
    let odd = series(s * s, [2.0 / 9.0, 2.0 / 7.0, 2.0 / 5.0, 2.0 / 3.0, 2.0]);
    n * LN_2_PARTS[0] + (n * LN_2_PARTS[1] + s * odd)
}

#[cfg(test)]
mod tests {
    use super::{exp, ln};

    #[test]
    fn as_in_double_precision() {
        for i in -870_000..=880_000 {
            let x = i as f32 * 1e-4;
            let exact = f64::from(x).exp();
            assert!((f64::from(exp(x)) / exact - 1.0).abs() < 2e-7, "exp {x}");
        }
        assert_eq!((exp(0.0), ln(1.0)), (1.0, 0.0));
        let mut x = f32::MIN_POSITIVE;
        while x < 3e38 {
            let exact = f64::from(x).ln();
            assert!((f64::from(ln(x)) - exact).abs() < 1.5e-7 * exact.abs().max(1.0), "ln {x}");
            x *= 1.000_1;
        }
    }

    #[test]
    fn past_what_single_precision_holds() {
        assert_eq!((exp(1e9), exp(-1e9)), (exp(88.0), exp(-87.0)));
        assert!(exp(f32::NAN).is_nan() && exp(88.0).is_finite() && exp(-87.0) > 0.0);
        assert_eq!((ln(0.0), ln(-3.0)), (ln(f32::MIN_POSITIVE), ln(f32::MIN_POSITIVE)));
    }
}
