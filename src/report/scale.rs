//! Which value has which colour, and the bar that says so.

use crate::report::colormap::ColorMap;

/// A linear map from values to colours.
#[derive(Debug, Clone, PartialEq)]
pub struct Scale {
    /// Value of the table's lower end.
    pub low: f64,
    /// Value of its upper end.
    pub high: f64,
    /// Unit, "mm" say; empty for plain numbers.
    pub unit: &'static str,
    /// The table.
    pub map: ColorMap,
}

impl Scale {
    /// 0 to a round number at or above `high`.
    pub fn from_zero(high: f64, unit: &'static str, map: ColorMap) -> Self {
        Self { low: 0.0, high: round_up(high), unit, map }
    }

    /// Symmetric about `middle`, with a round half-width of at least `half`.
    pub fn about(middle: f64, half: f64, unit: &'static str) -> Self {
        let half = round_up(half);
        Self { low: middle - half, high: middle + half, unit, map: ColorMap::Diverging }
    }

    /// Where `value` lies, 0 to 1 and beyond.
    pub fn position(&self, value: f64) -> f64 {
        (value - self.low) / (self.high - self.low)
    }

    /// The colour of `value` as `#rrggbb`.
    pub fn hex(&self, value: f64) -> String {
        self.map.hex(self.position(value))
    }

    /// Lower end, middle and upper end in words.
    pub fn ticks(&self) -> [String; 3] {
        [self.low, (self.low + self.high) / 2.0, self.high].map(short)
    }

    /// Nine colours from the lower to the upper end.
    pub(crate) fn stops(&self) -> [String; 9] {
        std::array::from_fn(|i| self.map.hex(i as f64 / 8.0))
    }
}

/// The smallest of 1, 1.5, 2, 3, 4, 5, 6, 8 times a power of ten that is at or above `v` (1e-3 at
/// least).
///
/// ```
/// use palpate::report::scale::round_up;
/// assert_eq!(round_up(7.3), 8.0);
/// ```
pub fn round_up(v: f64) -> f64 {
    let v = if v.is_finite() { v.max(1e-3) } else { 1.0 };
    let power = 10f64.powf(v.log10().floor());
    let step = [1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0].into_iter().find(|s| s * power >= v * (1.0 - 1e-9));
    step.unwrap_or(10.0) * power
}

/// A number with three digits at most after the point and no trailing zeros.
///
/// ```
/// use palpate::report::scale::short;
/// assert_eq!([0.25, 2.0, -0.0, 1234.4].map(short), ["0.25", "2", "0", "1234"]);
/// ```
pub fn short(v: f64) -> String {
    let digits = if v.abs() >= 100.0 { 0 } else { 3 };
    let s = format!("{v:.digits$}");
    let s = if s.contains('.') { s.trim_end_matches('0').trim_end_matches('.') } else { &s };
    if s == "-0" { "0".into() } else { s.into() }
}

/// A number rounded to three digits that count: 0.00146, 2.80, 26700; below a thousandth as
/// 1.46e-4.
///
/// ```
/// use palpate::report::scale::significant;
/// assert_eq!([0.001_46, 26_670.0, 1e-7].map(significant), ["0.00146", "26700", "1.00e-7"]);
/// ```
pub fn significant(v: f64) -> String {
    match v.abs() {
        a if a == 0.0 || !a.is_finite() => short(v),
        a if a < 1e-3 => format!("{v:.2e}"),
        a => {
            let decimals = 2 - a.log10().floor() as i32;
            let unit = 10f64.powi(decimals.min(0).abs());
            format!("{:.*}", decimals.max(0) as usize, if unit > 1.0 { (v / unit).round() * unit } else { v })
        }
    }
}

/// A part as a percentage, as [`significant`] has it.
pub fn percent(v: f64) -> String {
    significant(100.0 * v)
}

/// 1234567 as 1,234,567.
///
/// ```
/// use palpate::report::scale::thousands;
/// assert_eq!(thousands(1_234_567), "1,234,567");
/// ```
pub fn thousands(n: usize) -> String {
    let digits = n.to_string();
    let mut out = String::with_capacity(digits.len() + digits.len() / 3);
    for (i, c) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            out.push(',');
        }
        out.push(c);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn three_digits_count_whatever_the_size() {
        let shown = [0.001_46, 0.0028, 2.8, 9.999, 26_670.0, 123.45, 1e-7, 0.012_345, 0.0, -4.32].map(significant);
        let wanted = ["0.00146", "0.00280", "2.80", "10.00", "26700", "123", "1.00e-7", "0.0123", "0", "-4.32"];
        assert_eq!(shown, wanted);
    }

    #[test]
    fn round_numbers_are_at_or_above() {
        assert_eq!(
            [0.07, 1.0, 7.3, 8.1, 123.0, 0.0].map(|v| short(round_up(v))),
            ["0.08", "1", "8", "10", "150", "0.001"]
        );
        assert_eq!(round_up(f64::NAN), 1.0);
    }

    #[test]
    fn numbers_in_words() {
        assert_eq!([0.25, -0.0, 2.0, 1234.5].map(short), ["0.25", "0", "2", "1234"]);
        assert_eq!([7, 1000, 13020, 1234567].map(thousands), ["7", "1,000", "13,020", "1,234,567"]);
    }

    #[test]
    fn the_neutral_colour_is_the_middle_value() {
        let s = Scale::about(1.0, 0.13, "");
        assert_eq!((s.low, s.high), (0.85, 1.15));
        assert_eq!(s.hex(1.0), "#f7f7f7");
    }
}
