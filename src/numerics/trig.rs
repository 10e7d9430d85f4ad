//! Sine and cosine of a few angles at once, for inner loops.

/// Coefficients of fdlibm's `__kernel_sin` and `__kernel_cos` (Sun Microsystems 1993), from the
/// lowest power up; for angles to pi/4 both are within one unit in the last place.
const SIN: [f64; 6] = [
    -1.666_666_666_666_663_2e-1,
    8.333_333_333_322_49e-3,
    -1.984_126_982_985_795e-4,
    2.755_731_370_707_006_8e-6,
    -2.505_076_025_340_686_3e-8,
    1.589_690_995_211_55e-10,
];
const COS: [f64; 6] = [
    4.166_666_666_666_66e-2,
    -1.388_888_888_887_411e-3,
    2.480_158_728_947_673e-5,
    -2.755_731_435_139_066_3e-7,
    2.087_572_321_298_175e-9,
    -1.135_964_755_778_819_5e-11,
];

/// Sines and cosines of `angles` (rad). Odd and even to the last bit, within 2e-16 of the exact
/// values.
#[inline(always)]
pub fn sin_cos<const N: usize>(angles: [f64; N]) -> ([f64; N], [f64; N]) {
    let small = angles.iter().all(|v| v.abs() <= std::f64::consts::FRAC_PI_4);
    if !small {
        return (angles.map(f64::sin), angles.map(f64::cos));
    }
    let (mut sines, mut cosines) = ([0.0; N], [0.0; N]);
    for i in 0..N {
        let x = angles[i];
        let z = x * x;
        let odd = SIN[1] + z * (SIN[2] + z * (SIN[3] + z * (SIN[4] + z * SIN[5])));
        sines[i] = x + z * x * (SIN[0] + z * odd);
        let even = z * (COS[0] + z * (COS[1] + z * (COS[2] + z * (COS[3] + z * (COS[4] + z * COS[5])))));
        let half = 0.5 * z;
        let near = 1.0 - half;
        cosines[i] = near + ((1.0 - near) - half + z * even);
    }
    (sines, cosines)
}

#[cfg(test)]
mod tests {
    use super::sin_cos;

    #[test]
    fn as_the_standard_library_on_both_sides_of_the_switch() {
        for i in -4000..=4000 {
            let x = f64::from(i) * 1e-3;
            let ([s], [c]) = sin_cos([x]);
            assert!((s - x.sin()).abs() < 2.3e-16 && (c - x.cos()).abs() < 2.3e-16, "{x}: {s}, {c}");
            let ([s_minus], [c_minus]) = sin_cos([-x]);
            assert_eq!((s_minus, c_minus), (-s, c));
        }
        assert!(sin_cos([f64::NAN]).0[0].is_nan());
    }
}
