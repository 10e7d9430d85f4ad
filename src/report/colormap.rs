//! Colour tables, computed from a few numbers each.

/// A colour table over 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ColorMap {
    /// Black to white.
    Gray,
    /// Matplotlib's viridis, dark blue to yellow.
    Viridis,
    /// Matplotlib's magma, black to pale yellow.
    Magma,
    /// Blue, white, red; the middle is the neutral value (ColorBrewer RdBu).
    Diverging,
}

/// Sixth-degree polynomial fits of the two Matplotlib tables, lowest power first (M. Zucker, public
/// domain, shadertoy.com/view/WlfXRN).
const VIRIDIS: [[f64; 3]; 7] = [
    [0.277_727, 0.005_407, 0.334_100],
    [0.105_093, 1.404_614, 1.384_590],
    [-0.330_862, 0.214_848, 0.095_095],
    [-4.634_230, -5.799_101, -19.332_441],
    [6.228_270, 14.179_933, 56.690_553],
    [4.776_385, -13.745_145, -65.353_033],
    [-5.435_456, 4.645_853, 26.312_435],
];
const MAGMA: [[f64; 3]; 7] = [
    [-0.002_136, -0.000_750, -0.005_386],
    [0.251_661, 0.677_523, 2.494_027],
    [8.353_717, -3.577_720, 0.314_468],
    [-27.668_733, 14.264_731, -13.649_213],
    [52.176_140, -27.943_606, 12.944_169],
    [-50.768_525, 29.046_583, 4.234_153],
    [18.655_705, -11.489_774, -5.601_962],
];
const DIVERGING: [[f64; 3]; 5] =
    [[33.0, 102.0, 172.0], [146.0, 197.0, 222.0], [247.0, 247.0, 247.0], [244.0, 165.0, 130.0], [178.0, 24.0, 43.0]];

impl ColorMap {
    /// The sRGB colour at `t`; outside 0 to 1 it is that of the nearer end, and NaN gives the lower
    /// end.
    pub fn rgb(self, t: f64) -> [u8; 3] {
        let t = if t.is_nan() { 0.0 } else { t.clamp(0.0, 1.0) };
        let byte = |v: f64| (255.0 * v.clamp(0.0, 1.0)).round() as u8;
        let polynomial =
            |c: &[[f64; 3]; 7]| std::array::from_fn(|k| byte(c.iter().rfold(0.0, |v, row| v * t + row[k])));
        match self {
            ColorMap::Gray => [byte(t); 3],
            ColorMap::Viridis => polynomial(&VIRIDIS),
            ColorMap::Magma => polynomial(&MAGMA),
            ColorMap::Diverging => {
                let at = t * 4.0;
                let i = (at as usize).min(3);
                let f = at - i as f64;
                std::array::from_fn(|k| byte((DIVERGING[i][k] * (1.0 - f) + DIVERGING[i + 1][k] * f) / 255.0))
            }
        }
    }

    /// The same as `#rrggbb`.
    ///
    /// ```
    /// use palpate::report::colormap::ColorMap;
    /// assert_eq!(ColorMap::Gray.hex(1.0), "#ffffff");
    /// // The middle of the diverging map is neutral.
    /// assert_eq!(ColorMap::Diverging.hex(0.5), "#f7f7f7");
    /// ```
    pub fn hex(self, t: f64) -> String {
        let [r, g, b] = self.rgb(t);
        format!("#{r:02x}{g:02x}{b:02x}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_tables_agree_with_matplotlib() {
        // matplotlib 3.8: cm.viridis(t), cm.magma(t) in bytes.
        let known = [
            (ColorMap::Viridis, 0.0, [68, 1, 84]),
            (ColorMap::Viridis, 0.5, [33, 145, 140]),
            (ColorMap::Viridis, 1.0, [253, 231, 37]),
            (ColorMap::Magma, 0.0, [0, 0, 4]),
            (ColorMap::Magma, 0.5, [183, 55, 121]),
            (ColorMap::Magma, 1.0, [252, 253, 191]),
            (ColorMap::Diverging, 0.5, [247, 247, 247]),
            (ColorMap::Gray, 1.0, [255, 255, 255]),
        ];
        for (map, t, expected) in known {
            let found = map.rgb(t);
            assert!((0..3).all(|k| found[k].abs_diff(expected[k]) <= 6), "{map:?} at {t}: {found:?}, {expected:?}");
        }
    }

    #[test]
    fn values_outside_the_range_take_the_nearer_end() {
        assert_eq!(ColorMap::Viridis.rgb(7.0), ColorMap::Viridis.rgb(1.0));
        assert_eq!(ColorMap::Viridis.rgb(f64::NAN), ColorMap::Viridis.rgb(0.0));
        assert_eq!(ColorMap::Diverging.hex(0.5), "#f7f7f7");
    }
}
